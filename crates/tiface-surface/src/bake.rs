//! Bakes the field's color into texels, either as the final texture or as the start of the fit to
//! photographs.
//!
//! Every texel that a chart covers has several samples (`cover`); each sample moves onto the
//! field's true surface, is seen by the training cameras that nothing hides from it, and takes the
//! mean of what they see in linear light (`light`), or those of them that look most directly. What
//! the cameras see differently can be kept as a few lobes a texel (`light`), and the field's normal
//! as a picture of normals ([`tangent_space()`]). Gaps are filled; color and lobes are then made to
//! agree along seams by [`Seams`].
//!
//! The picture is baked in bands of rows, so that samples never lie in memory together: twelve
//! bytes a texel for color, normals and each lobe are what it takes.

mod carry;
mod cover;
mod fill;
mod grain;
mod light;
mod lobes;
mod materials;
mod seams;
mod smooth;
mod tangent_space;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
mod trust;
mod unseen;

pub(crate) use carry::bilinear;
pub use carry::{CarriedTexture, Original};
pub(crate) use cover::Bands;
pub use light::seen_colors;
pub use seams::Seams;
pub use tangent_space::tangent_space;
pub use trust::{Seen, seen_map, seen_shares};
pub use unseen::{FittedTexture, TexelTrust, UnseenReport, complete_unseen_vertices};

use crate::files::LOBE_TEXEL;
use crate::setting;
use cover::Sample;
use fill::fill;
use glam::{Mat3, Vec3};
use light::{Shades, SurfacePoints, ViewDirections, Visibility, shade, snap_to_surface};
use serde::{Deserialize, Serialize};
use std::time::Instant;
use tiface_base::geom::sphharm::functions;
use tiface_base::geom::{Atlas, Bvh, Camera, Harmonics, Mesh, SdfField, area_vector};
use tiface_base::image::{Image, linear_from_srgb, srgb_from_linear};
use tiface_base::{Monitor, Result};

/// Options of baking. Lengths are in the mesh's units.
#[derive(Clone, Debug, PartialEq)]
pub struct BakeConfig {
    /// Samples along each side of a texel, 1..=8.
    pub side: u32,
    /// Texels that repeat a chart's border around it.
    pub gutter_px: u32,
    /// Maximum distance of a sample from the true surface: the simplification's error and half a
    /// cell.
    pub reach: f32,
    /// Maximum number of cameras per sample: the ones that view it most directly.
    pub views: usize,
    /// Degree of the lobes, 1 or 2; 0 for none.
    pub lobes: u32,
    /// Also bake the field's normals.
    pub normals: bool,
    /// Turns directions of the mesh's coordinates into the coordinates that the lobes are kept in.
    pub turned: Mat3,
}

/// A baked texture; every picture has the atlas's size.
#[derive(Clone, Debug)]
pub struct Baked {
    /// Linear color, 3 channels.
    pub color: Image,
    /// Lobes, 3 channels each, sRGB-coded differences; one picture a function.
    pub lobes: Vec<Image>,
    /// Unit normals of the field in the mesh's coordinates, 3 channels.
    pub normal: Option<Image>,
    /// A report of baking.
    pub report: BakeReport,
}

/// A report of baking.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BakeReport {
    /// Texels across and down.
    pub size: [u32; 2],
    /// Share of texels that a chart covers, 0..=1.
    pub covered: f64,
    /// Number of samples on the surface.
    pub samples: usize,
    /// Share of the samples that at least one camera sees.
    pub seen: f64,
    /// Mean number of cameras that see a sample, over the samples that any camera sees.
    pub views: f64,
    /// Mean distance by which samples moved onto the true surface, mesh units.
    pub moved: f64,
    /// Duration of baking.
    pub seconds: f64,
}

/// Bakes a texture for `mesh` with normals, laid out by `atlas`, from the field it was extracted
/// from.
///
/// ```
/// use glam::{Mat3, Vec3};
/// use tiface_base::geom::Mesh;
/// use tiface_surface::bake::{BakeConfig, bake};
/// use tiface_surface::{AtlasConfig, atlas};
///
/// let mesh = Mesh {
///     positions: vec![Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z],
///     normals: vec![Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z],
///     triangles: vec![
///         [0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5],
///     ],
///     ..Mesh::default()
/// };
/// let config = AtlasConfig { size_px: 64, gutter_px: 2, ..AtlasConfig::default() };
/// let (atlas, _) = atlas(&mesh, &config, &tiface_base::Quiet)?;
/// // a ball that shows sRGB-coded 0.5 from everywhere
/// let ball = |p: Vec3| p.length() - 1.0;
/// let config = BakeConfig {
///     side: 2, gutter_px: 2, reach: 0.5, views: 8,
///     lobes: 0, normals: false, turned: Mat3::IDENTITY,
/// };
/// let baked = bake(&mesh, &atlas, &ball, &[], &config, &tiface_base::Quiet)?;
/// assert!(baked.color.data.iter().all(|v| (v - 0.2140).abs() < 1e-3)); // linear
/// # Ok::<(), tiface_base::Error>(())
/// ```
///
/// # Errors
///
/// A side of no or too many samples, a request to stop.
pub fn bake(
    mesh: &Mesh,
    atlas: &Atlas,
    field: &dyn SdfField,
    cameras: &[Camera],
    config: &BakeConfig,
    monitor: &dyn Monitor,
) -> Result<Baked> {
    let begin = Instant::now();
    setting((1..=8).contains(&config.side), "BakeConfig::side", "1..=8", config.side)?;
    let count = if config.lobes == 0 { 0 } else { functions(config.lobes.min(2)) };
    let mut texels = Texels::new(atlas, count, config.normals);
    let mut totals = SampleTotals::default();
    let bvh = Bvh::new(mesh);
    let visibility =
        Visibility { cameras, bvh: &bvh, clearance: 0.5 * config.reach, max_cameras: config.views };
    let bands = Bands::new(atlas, config.side);
    for band in 0..bands.len() {
        let own = &bands.samples(atlas, band, config.side);
        monitor.check_stop()?;
        let flat = on_triangles(mesh, own);
        let points = snap_to_surface(&flat, config.reach, field);
        let seen = visibility.directions(&points, &flat);
        totals.add(&flat, &points, &seen);
        let shades = shade(&points, seen, field, count, config.turned);
        texels.put_means(own, &points, &shades);
        monitor.step(band as u64 + 1, bands.len() as u64, &[("texels", totals.samples as f64)]);
    }
    texels.fill(&Seams::new(mesh, atlas), config.gutter_px);
    let share = |a: f64, b: usize| if b > 0 { a / b as f64 } else { 0.0 };
    let Texels { color, lobes, normal, covered } = texels;
    let SampleTotals { samples, visible, views, moved } = totals;
    let report = BakeReport {
        size: [atlas.width, atlas.height],
        covered: share(covered.iter().filter(|&&c| c).count() as f64, covered.len()),
        samples,
        seen: share(visible as f64, samples),
        views: share(views as f64, visible),
        moved: share(moved, samples),
        seconds: begin.elapsed().as_secs_f64(),
    };
    Ok(Baked { color, lobes, normal, report })
}

/// Sums over all samples.
#[derive(Default)]
struct SampleTotals {
    samples: usize,
    /// Samples that some camera sees.
    visible: usize,
    /// Cameras that see a sample.
    views: usize,
    /// Distances by which samples moved.
    moved: f64,
}

impl SampleTotals {
    /// Adds the samples of a band, on the triangles and on the surface.
    fn add(&mut self, flat: &SurfacePoints, points: &SurfacePoints, seen: &ViewDirections) {
        self.samples += flat.positions.len();
        for (_, &count) in seen.known.iter().zip(&seen.counts).filter(|(known, _)| **known) {
            self.visible += 1;
            self.views += count as usize;
        }
        let ways = flat.positions.iter().zip(&points.positions).map(|(a, b)| f64::from(a.distance(*b)));
        self.moved += ways.sum::<f64>();
    }
}

/// The pictures of an atlas while they are made, as in [`Baked`].
struct Texels {
    color: Image,
    lobes: Vec<Image>,
    normal: Option<Image>,
    /// Which of the texels have samples.
    covered: Vec<bool>,
}

impl Texels {
    fn new(atlas: &Atlas, lobes: usize, has_normals: bool) -> Texels {
        let (width, height) = (atlas.width, atlas.height);
        Texels {
            color: Image::new(width, height, 3),
            lobes: vec![Image::new(width, height, 3); lobes],
            normal: has_normals.then(|| Image::new(width, height, 3)),
            covered: vec![false; width as usize * height as usize],
        }
    }

    /// Gives texels the mean of their samples, which are sorted by texel. If some samples of a
    /// texel are visible, the invisible ones are ignored.
    fn put_means(&mut self, samples: &[Sample], points: &SurfacePoints, shades: &Shades) {
        let count = self.lobes.len();
        let mut i = 0;
        for texel in samples.chunk_by(|a, b| a.texel == b.texel) {
            let at = texel[0].texel as usize;
            self.covered[at] = true;
            let all = i..i + texel.len();
            let any = shades.seen[all.clone()].contains(&true);
            let counts = |s: usize| if any && !shades.seen[s] { 0.0 } else { 1.0 };
            let total: f32 = all.clone().map(counts).sum();
            let mean = |value: &dyn Fn(usize) -> [f32; 3]| -> [f32; 3] {
                let mut sum = [0f32; 3];
                for s in all.clone() {
                    let w = counts(s) / total;
                    value(s).iter().zip(&mut sum).for_each(|(v, sum)| *sum += w * v);
                }
                sum
            };
            let put = |image: &mut Image, v: [f32; 3]| image.data[3 * at..3 * at + 3].copy_from_slice(&v);
            put(&mut self.color, mean(&|s| shades.linear[s]));
            for (k, image) in self.lobes.iter_mut().enumerate() {
                put(image, mean(&|s| shades.lobes[s * count + k]));
            }
            if let Some(image) = &mut self.normal {
                let n = Vec3::from(mean(&|s| points.normals[s].to_array()));
                put(image, n.normalize_or(points.normals[all.start]).to_array());
            }
            i = all.end;
        }
    }

    /// Fills the pictures between the charts, and makes color and lobes agree along the seams.
    fn fill(&mut self, seams: &Seams, gutter_px: u32) {
        fill(&mut self.color, &self.covered, gutter_px);
        seams.even(&mut self.color, srgb_from_linear, linear_from_srgb);
        self.lobes.iter_mut().for_each(|l| complete(l, &self.covered, gutter_px, seams));
        if let Some(normal) = &mut self.normal {
            fill(normal, &self.covered, gutter_px);
        }
    }
}

/// Fills a picture of 3 channels between its charts, of which the `known` texels lie in one, and
/// makes it agree along seams.
pub fn complete(image: &mut Image, known: &[bool], gutter_px: u32, seams: &Seams) {
    fill(image, known, gutter_px);
    seams.even(image, |v| v, |v| v);
}

/// Draws harmonics at the vertices of a mesh into coarse texels of its atlas, each of
/// [`LOBE_TEXEL`] of the atlas's along a side: a picture a function, complete. `gutter_px` counts
/// texels of the atlas.
pub fn bake_harmonics(mesh: &Mesh, atlas: &Atlas, harmonics: &Harmonics, gutter_px: u32) -> Vec<Image> {
    let coarse = |px: u32| (px / LOBE_TEXEL).max(1);
    let atlas = &Atlas { width: coarse(atlas.width), height: coarse(atlas.height), ..atlas.clone() };
    let gutter_px = coarse(gutter_px);
    let (width, height, count) = (atlas.width, atlas.height, harmonics.functions);
    let mut pictures = vec![Image::new(width, height, 3); count];
    let mut known = vec![false; width as usize * height as usize];
    let bands = Bands::new(atlas, 1);
    for sample in (0..bands.len()).flat_map(|band| bands.samples(atlas, band, 1)) {
        let at = sample.texel as usize;
        known[at] = true;
        for (k, picture) in pictures.iter_mut().enumerate() {
            let own = |vertex: u32| Vec3::from(harmonics.coefficients[vertex as usize * count + k]);
            let sum = sample.hit().mix(mesh.triangles[sample.triangle as usize].map(own));
            picture.data[3 * at..3 * at + 3].copy_from_slice(&sum.to_array());
        }
    }
    let seams = Seams::new(mesh, atlas);
    pictures.iter_mut().for_each(|p| complete(p, &known, gutter_px, &seams));
    pictures
}

/// Positions and interpolated normals of samples.
fn on_triangles(mesh: &Mesh, samples: &[Sample]) -> SurfacePoints {
    let face = |s: &Sample| area_vector(mesh.corners(s.triangle)).normalize_or(Vec3::Z);
    let normal = |s: &Sample| mesh.normal_at(&s.hit()).unwrap_or_else(|| face(s));
    SurfacePoints {
        positions: samples.iter().map(|s| mesh.point_at(&s.hit())).collect(),
        normals: samples.iter().map(normal).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::Painted;
    use glam::Vec2;
    use tiface_base::Quiet;

    /// Returns a latitude-longitude sphere of radius 0.5 (coarse), with a seam.
    fn sphere(width: u32, height: u32) -> (Mesh, Atlas) {
        let (nu, nv) = (24u32, 12u32);
        let mut mesh = Mesh::default();
        let mut atlas = Atlas { width, height, ..Atlas::default() };
        for j in 0..=nv {
            for i in 0..=nu {
                let (lon, lat) = (i as f32 / nu as f32 * std::f32::consts::TAU, j as f32 / nv as f32);
                let theta = (0.02 + 0.96 * lat) * std::f32::consts::PI;
                let n = Vec3::new(theta.sin() * lon.cos(), theta.cos(), theta.sin() * lon.sin());
                mesh.positions.push(0.5 * n);
                mesh.normals.push(n);
                let margin = 2.0 / width as f32;
                let x = margin + (1.0 - 2.0 * margin) * i as f32 / nu as f32;
                atlas.uvs.push(Vec2::new(x, margin + (1.0 - 2.0 * margin) * lat));
            }
        }
        for j in 0..nv {
            for i in 0..nu {
                let at = |i: u32, j: u32| j * (nu + 1) + i;
                mesh.triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                mesh.triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        atlas.triangles = mesh.triangles.clone();
        (mesh, atlas)
    }

    fn sphere_sdf(p: Vec3) -> f32 {
        p.length() - 0.5
    }

    fn ring() -> Vec<Camera> {
        let mut cameras = Vec::new();
        for k in 0..8 {
            let a = k as f64 / 8.0 * std::f64::consts::TAU;
            let rotation = glam::DMat3::from_rotation_y(a);
            let position = rotation * glam::DVec3::new(0.0, 0.0, 3.0);
            cameras.push(Camera { rotation, position, ..Camera::above(200, 200, 300.0, 0.0) });
        }
        cameras
    }

    fn config() -> BakeConfig {
        BakeConfig {
            side: 2,
            gutter_px: 4,
            reach: 0.02,
            views: usize::MAX,
            lobes: 0,
            normals: false,
            turned: Mat3::IDENTITY,
        }
    }

    #[test]
    fn every_texel_has_the_color_of_its_point_on_the_true_surface() {
        let (mesh, atlas) = sphere(128, 64);
        let paint = |p: Vec3| (0.5 + 0.8 * p).to_array();
        let colors = |p: &[Vec3], _: &[Vec3], counts: &[u32], _: &[Vec3]| -> Vec<[f32; 3]> {
            p.iter().zip(counts).flat_map(|(p, &n)| std::iter::repeat_n(paint(*p), n as usize)).collect()
        };
        let learned = Painted { shape: sphere_sdf, paint: colors };
        let config = BakeConfig { normals: true, ..config() };
        let baked = bake(&mesh, &atlas, &learned, &ring(), &config, &Quiet).unwrap();
        assert!(baked.report.covered > 0.9 && baked.report.seen > 0.7, "{:?}", baked.report);
        assert!(baked.report.moved > 1e-4 && baked.report.views > 1.5);
        let normal = baked.normal.unwrap();
        for y in 4..60 {
            for x in 4..124 {
                let n = Vec3::from_slice(normal.pixel(x, y));
                // painted at the sphere's own point, not at the flat triangle's: 0.5 n
                let want = paint(0.5 * n).map(linear_from_srgb);
                let got = baked.color.pixel(x, y);
                assert!((0..3).all(|k| (got[k] - want[k]).abs() < 4e-3), "{x} {y} {got:?} {want:?}");
                let lon = (x as f32 + 0.5) / 128.0 * std::f32::consts::TAU;
                assert!(n.x * lon.cos() + n.z * lon.sin() > 0.97 * n.x.hypot(n.z));
            }
        }
    }

    #[test]
    fn both_sides_of_a_seam_show_the_same_edge_of_paint() {
        let (mut mesh, mut atlas) = sphere(256, 128);
        // longitude 0 has vertices at both ends of a row: as one, it is a seam of two sides
        for j in 0..=12 {
            let (first, last) = (j * 25, j * 25 + 24);
            mesh.triangles.iter_mut().flatten().filter(|i| **i == last).for_each(|i| *i = first);
        }
        // and the two sides lie apart by a part of a texel, too
        atlas.uvs.iter_mut().filter(|uv| uv.x < 0.5).for_each(|uv| uv.y += 0.3 / 128.0);
        let colors = |p: &[Vec3], _: &[Vec3], counts: &[u32], _: &[Vec3]| -> Vec<[f32; 3]> {
            let paint = |p: &Vec3| if (20.0 * p.y).rem_euclid(2.0) < 1.0 { [0.1; 3] } else { [0.9; 3] };
            p.iter().zip(counts).flat_map(|(p, &n)| std::iter::repeat_n(paint(p), n as usize)).collect()
        };
        let learned = Painted { shape: sphere_sdf, paint: colors };
        let baked = bake(&mesh, &atlas, &learned, &ring(), &config(), &Quiet).unwrap();
        let step = Seams::new(&mesh, &atlas).step(&baked.color.encoded());
        // the hardest possible paint; 12.7 without
        assert!(step < 4.0, "{step}");
    }

    #[test]
    fn lobes_keep_what_the_mean_loses() {
        let (mesh, atlas) = sphere(64, 32);
        // brighter towards +x
        let colors = |_: &[Vec3], _: &[Vec3], _: &[u32], away: &[Vec3]| -> Vec<[f32; 3]> {
            away.iter().map(|d| [0.5 - 0.2 * d.x, 0.5, 0.5]).collect()
        };
        let learned = Painted { shape: sphere_sdf, paint: colors };
        let config = BakeConfig { lobes: 1, ..config() };
        let baked = bake(&mesh, &atlas, &learned, &ring(), &config, &Quiet).unwrap();
        assert_eq!(baked.lobes.len(), 4);
        // at longitude 90° (+z), seen by three cameras from −45° to 45°
        let (x, y) = (16, 16);
        let base = tiface_base::image::srgb_from_linear(baked.color.pixel(x, y)[0]);
        let l: Vec<[f32; 3]> = baked.lobes.iter().map(|i| i.pixel(x, y).try_into().unwrap()).collect();
        for side in [-0.6f32, 0.0, 0.6] {
            let d = Vec3::new(side, 0.0, 1.0).normalize();
            let truth = 0.5 + 0.2 * d.x;
            let with = base + tiface_base::geom::sphharm::combine(&l, d.to_array())[0];
            assert!(
                (with - truth).abs() <= 0.3 * (base - truth).abs() + 0.01,
                "{side}: {with} {base} {truth}"
            );
        }
    }

    #[test]
    fn a_mirrored_atlas_gives_the_mirrored_picture_and_charts_may_end_at_the_border() {
        let (width, height) = (64u32, 32u32);
        let (mesh, mut atlas) = sphere(width, height);
        let margin = 2.0 / width as f32;
        for uv in &mut atlas.uvs {
            *uv = ((*uv - margin) / (1.0 - 2.0 * margin)).clamp(Vec2::ZERO, Vec2::ONE);
        }
        let colors = |p: &[Vec3], _: &[Vec3], counts: &[u32], _: &[Vec3]| -> Vec<[f32; 3]> {
            p.iter().zip(counts).flat_map(|(p, &n)| vec![(0.5 + 0.8 * *p).to_array(); n as usize]).collect()
        };
        let learned = Painted { shape: sphere_sdf, paint: colors };
        let mut turned = atlas.clone();
        turned.uvs.iter_mut().for_each(|uv| uv.x = 1.0 - uv.x);
        let [plain, mirrored] =
            [&atlas, &turned].map(|a| bake(&mesh, a, &learned, &ring(), &config(), &Quiet).unwrap());
        assert_eq!((plain.report.covered, mirrored.report.covered), (1.0, 1.0));
        for y in 0..height {
            for x in 0..width {
                let (a, b) = (plain.color.pixel(x, y), mirrored.color.pixel(width - 1 - x, y));
                assert!((0..3).all(|k| (a[k] - b[k]).abs() < 0.01), "{x} {y}: {a:?} {b:?}");
            }
        }
        // the first texel of a row half way down: longitude half a texel, latitude 16.5 of 32 rows
        let (lon, theta) =
            (std::f32::consts::TAU * 0.5 / 64.0, std::f32::consts::PI * (0.02 + 0.96 * 16.5 / 32.0));
        let p = 0.5 * Vec3::new(theta.sin() * lon.cos(), theta.cos(), theta.sin() * lon.sin());
        for (found, coded) in plain.color.pixel(0, 16).iter().zip((0.5 + 0.8 * p).to_array()) {
            assert!((found - tiface_base::image::linear_from_srgb(coded)).abs() < 0.02, "{found} {coded}");
        }
    }

    #[test]
    fn without_cameras_views_are_straight_and_texel_sized_textures_work() {
        let (mesh, mut atlas) = sphere(8, 4);
        atlas.uvs.iter_mut().for_each(|uv| *uv = uv.clamp(Vec2::ZERO, Vec2::ONE));
        let colors = |_: &[Vec3], n: &[Vec3], counts: &[u32], away: &[Vec3]| -> Vec<[f32; 3]> {
            assert!(counts.iter().all(|&c| c == 1));
            n.iter().zip(away).map(|(n, d)| [n.dot(-*d), 0.0, 0.0]).collect()
        };
        let learned = Painted { shape: sphere_sdf, paint: colors };
        for (width, height) in [(8, 4), (1, 1)] {
            let atlas = Atlas { width, height, ..atlas.clone() };
            let baked = bake(&mesh, &atlas, &learned, &[], &config(), &Quiet).unwrap();
            assert!(baked.color.data.chunks(3).all(|c| (c[0] - 1.0).abs() < 1e-4));
            assert_eq!(baked.report.seen, 0.0);
        }
        let bad = BakeConfig { side: 0, ..config() };
        assert!(bake(&mesh, &atlas, &learned, &[], &bad, &Quiet).is_err());
    }
}

//! Soft layers around the mesh where the field is softer than a surface: the outline of hair.
//!
//! The field's opacity falls from one to none over a few lengths `1 / s` of its local sharpness
//! `s`: a ray that comes as near as `f` to its level set is stopped to the share `σ(−f · s)` (Wang
//! et al., NeuS, 2021). The mesh stands at `f = 0` and shows nothing of what is outside. Layers at
//! `f = q / s` do, the opacity of each what rays lose between the middles to its neighbors:
//!
//! ```text
//! α_k = 1 − σ(q_low) / σ(q_high)
//! ```
//!
//! One Gauss-Newton step on the logits of the opacities, at the vertices of each layer, then brings
//! the outline closer to the masks' ([`Photograph::mask`]). Both are evaluated on photographs that
//! were left out, and the layers are dropped if they gain nothing. The mesh itself stays as it is:
//! inside of it nothing is transparent.

use super::appearance::{Nodes, Photograph};
use glam::Vec2;
use rayon::prelude::*;
use serde::Serialize;
use tiface_base::geom::{Bvh, Camera, Hit, Mesh, ShellCaster, ShellLayer, Shells};
use tiface_base::math::cg::{conjugate_gradients, dot};
use tiface_base::math::rank::median;
use tiface_base::{Monitor, Result};

/// Distances of the layers, in lengths `1 / s`. Two would say nearly as much, but show as steps
/// before a bright wall.
const LAYERS: [f32; 4] = [0.5, 1.5, 3.0, 5.0];

/// Softness `1 / s` from which on a vertex has layers, in pixels of the nearest camera:
/// antialiasing shows the rest. From twice this softness on they have their full opacity.
const MIN_SOFTNESS_PX: f32 = 0.5;

/// Rounds in which the softness of vertices takes the mean with its neighbors.
const ROUNDS: usize = 10;

/// Width of the band on each side of a mask's outline whose pixels are compared.
const BAND_PX: usize = 6;

/// Approximate maximum number of compared pixels.
const MAX_PIXELS: usize = 400_000;

/// Rays along each side of a pixel.
const RAYS_PER_SIDE: usize = 2;

/// Rays of a pixel.
const RAYS_PER_PIXEL: usize = RAYS_PER_SIDE * RAYS_PER_SIDE;

/// Every n-th photograph is left out, to validate the layers.
const VALIDATION_STRIDE: usize = 6;

/// Minimum share of the squared error of left-out outlines that layers must remove.
const MIN_GAIN: f64 = 0.05;

/// Weights of squared logits, and of squared differences along an edge, against the square of one
/// pixel's error.
const RIDGE: f64 = 0.01;
const SMOOTH: f64 = 0.05;

/// Maximum number of steps of conjugate gradients.
const STEPS: usize = 60;

/// A report of the layers.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ShellsReport {
    /// Triangles that have layers.
    pub triangles: usize,
    /// Median softness of the vertices that have, in pixels.
    pub softness_px: f32,
    /// Root mean square error of opacity near the outlines of left-out photographs: without layers,
    /// with those of the field, with fitted ones.
    pub left_out: [f64; 3],
    /// Whether the layers are kept.
    pub kept: bool,
}

/// Returns layers around a mesh whose vertices have normals, of the local `sharpness` of the field
/// at its vertices. Returns `None` if the masks carry no information, nothing is soft, or left-out
/// photographs do not look better.
///
/// # Errors
///
/// A request to stop.
pub fn fit(
    mesh: &Mesh,
    sharpness: &[f32],
    photographs: &[Photograph],
    monitor: &dyn Monitor,
) -> Result<(Option<Shells>, ShellsReport)> {
    let mut report = ShellsReport::default();
    let nodes = Nodes::vertices(mesh);
    let Some(field) = from_field(mesh, &nodes, sharpness, photographs) else { return Ok((None, report)) };
    let (field, soft) = field;
    report.triangles = mesh.triangles.iter().filter(|t| field.layers[0].has(t)).count();
    report.softness_px = soft;
    let outlines = Outlines::new(mesh, &field, photographs, monitor)?;
    if outlines.rows() == 0 {
        return Ok((None, report));
    }
    // of a few photographs the last
    let every = VALIDATION_STRIDE.min(photographs.len());
    let left_out = |view: u32| every > 1 && view as usize % every == every - 1;
    let first = outlines.fit(&field, &nodes, &|view| !left_out(view));
    let errors = [None, Some(&field), Some(&first)].map(|s| outlines.error(s, &left_out));
    report.left_out = errors;
    let best = errors[1].min(errors[2]);
    report.kept = best * best < (1.0 - MIN_GAIN) * errors[0] * errors[0];
    if !report.kept {
        return Ok((None, report));
    }
    let shells = if errors[2] < errors[1] { outlines.fit(&field, &nodes, &|_| true) } else { field };
    Ok((Some(shells), report))
}

/// Returns the layers of the field itself, and the median softness of their vertices, in pixels.
fn from_field(
    mesh: &Mesh,
    nodes: &Nodes,
    sharpness: &[f32],
    photographs: &[Photograph],
) -> Option<(Shells, f32)> {
    let pixel = |v: usize| {
        let size = |p: &Photograph| {
            let camera = p.camera;
            let depth = (mesh.positions[v] - camera.position.as_vec3()).length();
            depth / camera.fx.abs().max(camera.fy.abs()) as f32
        };
        photographs.iter().filter(|p| p.mask.is_some()).map(size).reduce(f32::min)
    };
    let mut width: Vec<f32> = sharpness.iter().map(|s| 1.0 / s).collect();
    for _ in 0..ROUNDS {
        let mean = |v: usize| {
            let near = nodes.near(v);
            (width[v] + near.iter().map(|&n| width[n as usize]).sum::<f32>()) / (1 + near.len()) as f32
        };
        width = (0..width.len()).into_par_iter().map(mean).collect();
    }
    let pixels: Vec<f32> = (0..width.len()).into_par_iter().map(pixel).collect::<Option<_>>()?;
    let share: Vec<f32> = width
        .iter()
        .zip(&pixels)
        .map(|(w, p)| ((w / p - MIN_SOFTNESS_PX) / MIN_SOFTNESS_PX).clamp(0.0, 1.0))
        .collect();
    let mut soft: Vec<f32> =
        (0..width.len()).filter(|&v| share[v] > 0.0).map(|v| width[v] / pixels[v]).collect();
    let median = median(&mut soft, f32::total_cmp)?;
    let mut layers = Vec::new();
    for (k, q) in LAYERS.into_iter().enumerate() {
        let low = 0.5 * (q + if k == 0 { 0.0 } else { LAYERS[k - 1] });
        let high = LAYERS.get(k + 1).map_or(1.0, |next| sigmoid(0.5 * (q + next)));
        let alpha = 1.0 - sigmoid(low) / high;
        layers.push(ShellLayer {
            offsets: width.iter().zip(&share).map(|(w, share)| q * w * share).collect(),
            alphas: share.iter().map(|share| alpha * share).collect(),
        });
    }
    Some((Shells { layers }, median))
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// The hits of the rays of pixels near the outlines.
#[derive(Default)]
struct Outlines {
    /// Photograph of each row.
    view: Vec<u32>,
    /// Its mask, 0..=1.
    target: Vec<f32>,
    /// Rays of each row that meet the mesh.
    whole: Vec<usize>,
    /// The other rays of each row: their layers in `met`, outermost first.
    rays: Vec<[Layers; RAYS_PER_PIXEL]>,
    /// Vertices of the triangles of the mesh.
    triangles: Vec<[u32; 3]>,
}

/// The layers that a ray meets, outermost first, and where.
type Layers = Vec<(usize, Hit)>;

/// Returns the number of a pixel's rays that hit the mesh, and the layers that the others hit.
fn look(
    camera: &Camera,
    (x, y): (usize, usize),
    bvh: &Bvh,
    caster: &ShellCaster,
) -> (usize, [Layers; RAYS_PER_PIXEL]) {
    let (mut whole, mut rays) = (0, [const { Layers::new() }; RAYS_PER_PIXEL]);
    for (k, layers) in rays.iter_mut().enumerate() {
        let sub = |at: usize, k: usize| at as f32 + (k as f32 + 0.5) / RAYS_PER_SIDE as f32;
        let Some(ray) = camera.ray(Vec2::new(sub(x, k % RAYS_PER_SIDE), sub(y, k / RAYS_PER_SIDE))) else {
            continue;
        };
        if bvh.any_hit(&ray) {
            whole += 1;
        } else {
            caster.cast(&ray, f32::INFINITY, |layer, hit, _| layers.push((layer, hit)));
        }
    }
    (whole, rays)
}

impl Outlines {
    fn new(
        mesh: &Mesh,
        shells: &Shells,
        photographs: &[Photograph],
        monitor: &dyn Monitor,
    ) -> Result<Outlines> {
        let (bvh, caster) = (Bvh::new(mesh), ShellCaster::new(mesh, shells));
        let mut all = Outlines { triangles: mesh.triangles.clone(), ..Outlines::default() };
        let bands: Vec<Vec<usize>> = photographs.par_iter().map(|p| p.outline(BAND_PX)).collect();
        let stride = bands.iter().map(Vec::len).sum::<usize>().div_ceil(MAX_PIXELS).max(1);
        for ((v, photograph), band) in photographs.iter().enumerate().zip(bands) {
            monitor.check_stop()?;
            let Some(mask) = photograph.mask else { continue };
            let some: Vec<usize> = band.into_iter().step_by(stride).collect();
            let row = |&at: &usize| {
                let target = f32::from(mask.values[at]) / 255.0;
                let (x, y) = (at % mask.width as usize, at / mask.width as usize);
                let (whole, rays) = look(photograph.camera, (x, y), &bvh, &caster);
                // pixels without opacity in render and mask, and opaque ones, carry no information
                let says = whole < RAYS_PER_PIXEL && (target > 0.0 || rays.iter().any(|l| !l.is_empty()));
                says.then_some((target, whole, rays))
            };
            for (target, whole, rays) in some.par_iter().filter_map(row).collect::<Vec<_>>() {
                all.view.push(v as u32);
                all.target.push(target);
                all.whole.push(whole);
                all.rays.push(rays);
            }
        }
        Ok(all)
    }

    fn rows(&self) -> usize {
        self.view.len()
    }

    /// Opacity of a row, and its derivatives by the logits of the opacities, `vertices` a layer.
    fn opacity(&self, row: usize, shells: Option<&Shells>, slopes: Option<&mut Vec<(u32, f32)>>) -> f32 {
        let mut opacity = self.whole[row] as f32;
        let mut slopes = slopes;
        for layers in &self.rays[row] {
            let Some(shells) = shells else { break };
            let mut through = 1.0;
            let alphas: Vec<f32> = layers
                .iter()
                .map(|(layer, hit)| {
                    let alpha = shells.layers[*layer].alpha(hit, self.triangles[hit.triangle as usize]);
                    through *= 1.0 - alpha;
                    alpha
                })
                .collect();
            opacity += 1.0 - through;
            if let Some(slopes) = slopes.as_deref_mut() {
                for (k, (layer, hit)) in layers.iter().enumerate() {
                    let others =
                        (0..alphas.len()).filter(|&o| o != k).map(|o| 1.0 - alphas[o]).product::<f32>();
                    let own = &shells.layers[*layer].alphas;
                    for (v, w) in self.triangles[hit.triangle as usize].into_iter().zip(hit.weights()) {
                        let alpha = own[v as usize];
                        let slope = others * w * alpha * (1.0 - alpha) / RAYS_PER_PIXEL as f32;
                        let at = (layer * own.len()) as u32 + v;
                        match slopes.iter_mut().find(|s| s.0 == at) {
                            Some(s) => s.1 += slope,
                            None => slopes.push((at, slope)),
                        }
                    }
                }
            }
        }
        opacity / RAYS_PER_PIXEL as f32
    }

    /// Root mean square error of the opacity of the rows that `keep` names (by photograph).
    fn error(&self, shells: Option<&Shells>, keep: &dyn Fn(u32) -> bool) -> f64 {
        let rows: Vec<usize> = (0..self.rows()).filter(|&row| keep(self.view[row])).collect();
        let square = |&row: &usize| f64::from(self.opacity(row, shells, None) - self.target[row]).powi(2);
        (rows.iter().map(square).sum::<f64>() / rows.len().max(1) as f64).sqrt()
    }

    /// One Gauss-Newton step from the opacities of `shells`, to the rows that `keep` names (by
    /// photograph).
    fn fit(&self, shells: &Shells, nodes: &Nodes, keep: &dyn Fn(u32) -> bool) -> Shells {
        let vertices = nodes.len();
        let unknowns = vertices * shells.layers.len();
        let rows: Vec<usize> = (0..self.rows()).filter(|&row| keep(self.view[row])).collect();
        let equations: Vec<(f32, Vec<(u32, f32)>)> = rows
            .par_iter()
            .map(|&row| {
                let mut slopes = Vec::new();
                let opacity = self.opacity(row, Some(shells), Some(&mut slopes));
                (self.target[row] - opacity, slopes)
            })
            .collect();
        let mut right = vec![0f64; unknowns];
        let mut diagonal = vec![RIDGE; unknowns];
        for (rest, slopes) in &equations {
            for &(at, slope) in slopes {
                right[at as usize] += f64::from(slope * rest);
                diagonal[at as usize] += f64::from(slope).powi(2);
            }
        }
        for (i, d) in diagonal.iter_mut().enumerate() {
            *d += SMOOTH * nodes.near(i % vertices).len() as f64;
        }
        let apply = |x: &[f64], out: &mut [f64]| {
            for (i, out) in out.iter_mut().enumerate() {
                let base = i / vertices * vertices;
                let near = nodes.near(i - base).iter().map(|&n| x[i] - x[base + n as usize]).sum::<f64>();
                *out = RIDGE * x[i] + SMOOTH * near;
            }
            for (_, slopes) in &equations {
                let sum: f64 = slopes.iter().map(|&(at, slope)| f64::from(slope) * x[at as usize]).sum();
                slopes.iter().for_each(|&(at, slope)| out[at as usize] += f64::from(slope) * sum);
            }
        };
        let precondition = |r: &[f64], z: &mut [f64]| {
            z.iter_mut().zip(r).zip(&diagonal).for_each(|((z, r), d)| *z = r / d);
        };
        let first = dot(&right, &right);
        let mut x = vec![0f64; unknowns];
        let done = |round: usize, r: &[f64]| round >= STEPS || dot(r, r) <= 1e-8 * first;
        conjugate_gradients(&mut x, right, apply, precondition, done);
        let mut fitted = shells.clone();
        for (layer, x) in fitted.layers.iter_mut().zip(x.chunks(vertices)) {
            for (alpha, x) in layer.alphas.iter_mut().zip(x) {
                if *alpha > 0.0 {
                    *alpha = sigmoid((*alpha / (1.0 - *alpha)).ln() + *x as f32);
                }
            }
        }
        fitted
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Volume, marching};
    use glam::{DMat3, DVec3, Vec3};
    use tiface_base::Quiet;
    use tiface_base::image::{Gray, Photo};

    const SIZE: u32 = 48;

    /// Returns a ball of triangles of radius 0.5 around the origin.
    fn ball() -> Mesh {
        const N: usize = 33;
        let at = |i: usize| i as f32 / (N - 1) as f32 * 2.0 - 1.0;
        let value = |i: usize| Vec3::new(at(i % N), at(i / N % N), at(i / (N * N))).length() - 0.5;
        let values: Vec<f32> = (0..N * N * N).map(value).collect();
        let spacing = Vec3::splat(2.0 / (N - 1) as f32);
        let volume = Volume { dims: [N; 3], values: &values, origin: Vec3::NEG_ONE, spacing };
        let surface = marching(&volume, true).unwrap().mesh;
        let normals = surface.positions.iter().map(|p| p.normalize()).collect();
        Mesh { normals, ..surface }
    }

    /// Cameras around it, three units away.
    fn cameras() -> Vec<Camera> {
        let camera = |k: usize| {
            let rotation = DMat3::from_rotation_y(k as f64 * std::f64::consts::TAU / 12.0);
            Camera {
                position: rotation * DVec3::new(0.0, 0.0, 3.0),
                rotation,
                ..Camera::above(SIZE, SIZE, 100.0, 3.0)
            }
        };
        (0..12).map(camera).collect()
    }

    /// Returns the mask of a ball whose opacity falls from 1 to 0 as that of a field of this
    /// sharpness does, seen by a camera: a ray that comes as near as `f` to the surface has σ(−f ·
    /// sharpness).
    fn mask(camera: &Camera, sharpness: f32) -> Gray {
        let value = |i: u32| {
            let ray = camera.ray(Vec2::new((i % SIZE) as f32 + 0.5, (i / SIZE) as f32 + 0.5)).unwrap();
            let nearest = ray.origin.cross(ray.direction).length() - 0.5;
            (sigmoid(-nearest * sharpness) * 255.0 + 0.5) as u8
        };
        Gray { width: SIZE, height: SIZE, values: (0..SIZE * SIZE).map(value).collect() }
    }

    fn black() -> Photo {
        Photo { width: SIZE, height: SIZE, rgb: vec![[0; 3]; (SIZE * SIZE) as usize], alpha: None }
    }

    fn run(field: f32, masks: f32) -> (Option<Shells>, ShellsReport) {
        let mesh = ball();
        let photo = black();
        let cameras = cameras();
        let masks: Vec<Gray> = cameras.iter().map(|c| mask(c, masks)).collect();
        let view = |(camera, mask)| Photograph { camera, photo: &photo, mask: Some(mask), valid: None };
        let photographs: Vec<Photograph> = cameras.iter().zip(&masks).map(view).collect();
        let sharpness = vec![field; mesh.positions.len()];
        fit(&mesh, &sharpness, &photographs, &Quiet).unwrap()
    }

    #[test]
    fn a_soft_ball_gets_layers_as_soft_as_its_masks() {
        // 1 / s is 0.05, and a pixel 0.03
        let (shells, report) = run(20.0, 20.0);
        let shells = shells.unwrap();
        assert!((report.softness_px - 0.05 / 0.025).abs() < 0.1, "{report:?}");
        let [none, field, fitted] = report.left_out;
        assert!(field < 0.5 * none && fitted <= field * 1.02, "{report:?}");
        assert!(shells.layers[0].offsets.iter().all(|o| (o - 0.025).abs() < 1e-3));
        assert!(shells.layers[3].offsets.iter().all(|o| (o - 0.25).abs() < 1e-3));
    }

    #[test]
    fn the_field_says_how_much_rays_lose_between_layers() {
        let (mesh, camera) = (ball(), &cameras()[0]);
        let (photo, mask) = (black(), mask(camera, 20.0));
        let photographs = [Photograph { camera, photo: &photo, mask: Some(&mask), valid: None }];
        let sharpness = vec![20.0; mesh.positions.len()];
        let (shells, _) = from_field(&mesh, &Nodes::vertices(&mesh), &sharpness, &photographs).unwrap();
        // the first two of layers at ½, 3/2 and 3: 1 − σ(¼) / σ(1) = 1 − 0.56218 / 0.73106, and 1 −
        // σ(1) / σ(9/4) = 1 − 0.73106 / 0.90465; the last, at 5 after 3: 1 − σ(4)
        let first: Vec<f32> = shells.layers.iter().map(|layer| layer.alphas[0]).collect();
        assert!((first[0] - 0.23101).abs() < 1e-4 && (first[1] - 0.19189).abs() < 1e-4, "{first:?}");
        assert!((first[3] - 0.01799).abs() < 1e-4, "{first:?}");
    }

    #[test]
    fn masks_softer_than_the_field_make_outer_layers_denser() {
        let alpha = |masks: f32| {
            let layer = run(20.0, masks).0.unwrap().layers.swap_remove(2);
            layer.alphas.iter().sum::<f32>() / layer.alphas.len() as f32
        };
        assert!(alpha(10.0) > alpha(20.0) + 0.02, "{} {}", alpha(10.0), alpha(20.0));
    }

    #[test]
    fn there_are_no_layers_around_a_hard_ball_or_where_masks_are_hard() {
        // a hundredth of a pixel
        assert_eq!(run(4000.0, 4000.0), (None, ShellsReport::default()));
        let (none, report) = run(20.0, 4000.0);
        assert!(none.is_none() && !report.kept && report.triangles > 0, "{report:?}");
    }

    #[test]
    fn slopes_are_those_of_differences() {
        let mesh = ball();
        let camera = &cameras()[3];
        let mask = mask(camera, 20.0);
        let photo = black();
        let photographs = [Photograph { camera, photo: &photo, mask: Some(&mask), valid: None }];
        let nodes = Nodes::vertices(&mesh);
        let (shells, _) = from_field(&mesh, &nodes, &vec![20.0; mesh.positions.len()], &photographs).unwrap();
        let outlines = Outlines::new(&mesh, &shells, &photographs, &Quiet).unwrap();
        let row = (0..outlines.rows()).find(|&r| outlines.rays[r].iter().any(|l| l.len() == 2)).unwrap();
        let mut slopes = Vec::new();
        outlines.opacity(row, Some(&shells), Some(&mut slopes));
        let (vertices, h) = (mesh.positions.len(), 0.05);
        for (at, slope) in slopes {
            let moved = |by: f32| {
                let mut moved = shells.clone();
                let alpha = &mut moved.layers[at as usize / vertices].alphas[at as usize % vertices];
                *alpha = sigmoid((*alpha / (1.0 - *alpha)).ln() + by);
                outlines.opacity(row, Some(&moved), None)
            };
            let difference = (moved(h) - moved(-h)) / (2.0 * h);
            assert!((difference - slope).abs() < 1e-3 * slope.abs() + 1e-5, "{difference} {slope}");
        }
    }
}

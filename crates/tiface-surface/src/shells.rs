//! Soft layers around the mesh where the field is softer than a surface: the outline of hair.
//!
//! The field's opacity falls from one to none over a few lengths `1 / s` of its local sharpness
//! `s`: a ray that comes as near as `f` to its level set is stopped to the share `σ(−f · s)` (Wang
//! et al., NeuS, 2021). The mesh stands at `f = 0` and shows nothing of what is outside. Layers at
//! `f = q / s` do, and below them what is opaque lies as deep as hair is not. The opacity of each
//! is what rays lose between the middles to its neighbors:
//!
//! ```text
//! (1 − α_k)² = σ(q_low) / σ(q_high)
//! ```
//!
//! squared, since a ray along the outline meets both sides of a layer. Layers are frayed: their
//! distances to what is opaque are multiplied by random factors around 1, while these opacities are
//! those of even ones; the fit makes up for the difference.
//!
//! From there the opacities at the vertices of each layer are fitted to the outlines of the masks
//! ([`Photograph::mask`]): strands reach farther than the field says, and where no outline is soft
//! nothing remains. Both are evaluated on photographs that were left out, against the mesh alone,
//! and the layers are dropped if they gain nothing. So are those of all designs but the best of a
//! few.
//!
//! Of each layer only the triangles that one sees remain. At the border of what remains the opacity
//! has fallen to nothing: vertices that have none take part in the fit as neighbors.

mod outlines;

use super::appearance::{Nodes, Photograph};
use super::moves::{EXTRACTED, move_to};
use super::simplify::without_crossings;
use glam::Vec3;
use outlines::Outlines;
use rayon::prelude::*;
use serde::Serialize;
use tiface_base::geom::{Mesh, ShellLayer, Shells};
use tiface_base::image::quantize;
use tiface_base::math::{rank::median, rng};
use tiface_base::{Monitor, Result};

/// Where layers lie, in lengths `1 / s`.
struct Design {
    /// Depth of what is opaque below the mesh.
    depth: f32,
    /// Mean distances of the layers to the mesh.
    layers: &'static [f32],
}

/// The designs that are tried. Path tracers stop at the eighth transparent face, and a ray meets
/// each layer twice: five layers say no more than four. Where hair was not learned well, the
/// surface is closer to the outlines than anything below it.
const DESIGNS: [Design; 2] =
    [Design { depth: 2.0, layers: &[-1.0, 0.5, 2.5, 6.0] }, Design { depth: 0.0, layers: &[2.0, 5.0] }];

/// Factor of the cost of simplification where layers have their full distance: a third to a half of
/// the triangles remain there.
const MIN_IMPORTANCE: f32 = 1.0 / 200.0;

/// Standard deviation of the distances of the layers' vertices to what is opaque, relative to their
/// mean, before they are clamped to two deviations from it. A frayed layer ends in tufts; an even
/// one ends in a ring that is visible before white.
const FRAY: f32 = 0.3;

/// Rounds in which the noise of the distances takes the mean with its neighbors: without them
/// folds stand so close that they hide each other where only the nearest is drawn.
const NOISE_ROUNDS: usize = 2;

/// Softness `1 / s` from which on a vertex has layers, in pixels of the nearest camera, at least
/// and at most: antialiasing shows the rest. It is the least for which all layers together have no
/// more than [`MAX_SHARE`] of the mesh's triangles.
const SOFTNESS_PX: [f32; 2] = [0.85, 1.2];

/// Softness beyond that from which on layers have their full distance and opacity, in pixels.
const FULL_SOFTNESS_PX: f32 = 0.3;

/// Number of triangles of all layers together that is aimed at, as a share of the mesh's.
const MAX_SHARE: f64 = 0.8;

/// Opacity from which on a vertex of a layer is seen: the least of 8 bits above 1/50. A triangle
/// without such a vertex is left out.
const MIN_ALPHA: f32 = 6.0 / 255.0;

/// Rounds in which the softness of vertices takes the mean with its neighbors.
const ROUNDS: usize = 10;

/// Every n-th photograph is left out, to validate the layers.
const VALIDATION_STRIDE: usize = 6;

/// Minimum share of the squared error of left-out outlines that layers must remove.
const MIN_GAIN: f64 = 0.05;

/// A report of the layers.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ShellsReport {
    /// Number of layers that left-out photographs like best, whether they are kept or not.
    pub layers: usize,
    /// Triangles of the field's layers, all together.
    pub triangles: usize,
    /// Triangles of the layers that are kept.
    pub kept_triangles: usize,
    /// Median softness of the vertices that have, in pixels.
    pub softness_px: f32,
    /// Root mean square error of opacity near the outlines of left-out photographs: without layers,
    /// with those of the field, with fitted ones.
    pub left_out: [f64; 3],
    /// Whether the layers are kept.
    pub kept: bool,
}

impl ShellsReport {
    /// Returns the error of opacity with layers.
    fn error(&self) -> f64 {
        self.left_out[1].min(self.left_out[2])
    }
}

/// Layers that were fitted to photographs.
#[derive(Clone, Debug, PartialEq)]
pub struct FittedShells {
    /// The layers.
    pub shells: Shells,
    /// The same with the opacities of the field, from which a fit begins.
    field: Shells,
    /// Whether left-out photographs look better with fitted opacities than with the field's.
    is_better: bool,
}

impl FittedShells {
    /// Returns the layers fitted anew, to these pictures, and the number of triangles of all of
    /// them together. Where fits are worse than what the field says, that stays.
    ///
    /// # Errors
    ///
    /// A request to stop.
    pub fn refit(
        self,
        mesh: &Mesh,
        pictures: &[Photograph],
        monitor: &dyn Monitor,
    ) -> Result<(Shells, usize)> {
        let shells = match self.is_better {
            true => {
                let outlines = Outlines::new(mesh, &self.field, pictures, monitor)?;
                confine(outlines.fit(&self.field, &Nodes::vertices(mesh), &|_| true))
            }
            false => self.shells,
        };
        let triangles = triangles(&shells, mesh);
        Ok((shells, triangles))
    }
}

/// Returns layers around a mesh whose vertices have normals, of the local `sharpness` of the field
/// at its vertices, and how deep below it the mesh is opaque. Returns `None` if the masks carry no
/// information, nothing is soft, or left-out photographs do not look better.
///
/// # Errors
///
/// A request to stop.
pub fn fit(
    mesh: &Mesh,
    sharpness: &[f32],
    photographs: &[Photograph],
    monitor: &dyn Monitor,
) -> Result<(Option<FittedShells>, ShellsReport)> {
    let nodes = Nodes::vertices(mesh);
    let mut best: Option<Candidate> = None;
    for design in &DESIGNS {
        let count = Some(design.layers.len());
        let Some(softness) = Softness::new(mesh, &nodes, sharpness, photographs, count) else {
            continue;
        };
        let candidate = Candidate::new(mesh, &nodes, design, &softness, photographs, monitor)?;
        if best.as_ref().is_none_or(|best| candidate.report.error() < best.report.error()) {
            best = Some(candidate);
        }
    }
    let Some(Candidate { field, outlines, mut report }) = best else {
        return Ok((None, ShellsReport::default()));
    };
    if !report.kept {
        return Ok((None, report));
    }
    let [_, seen, fitted] = report.left_out;
    let is_better = fitted < seen;
    let shells = if is_better { outlines.fit(&field, &nodes, &|_| true) } else { field.clone() };
    let shells = confine(shells);
    report.kept_triangles = triangles(&shells, mesh);
    Ok((Some(FittedShells { shells, field, is_better }), report))
}

/// Layers of a design as the field has them, and how they are judged.
struct Candidate {
    field: Shells,
    outlines: Outlines,
    report: ShellsReport,
}

impl Candidate {
    /// Judges the layers of a design by photographs that are left out of a first fit.
    fn new(
        mesh: &Mesh,
        nodes: &Nodes,
        design: &Design,
        softness: &Softness,
        photographs: &[Photograph],
        monitor: &dyn Monitor,
    ) -> Result<Candidate> {
        let field = from_field(mesh, nodes, design, softness);
        let outlines = Outlines::new(mesh, &field, photographs, monitor)?;
        // of a few photographs the last
        let every = VALIDATION_STRIDE.min(photographs.len());
        let left_out = |view: u32| every > 1 && view as usize % every == every - 1;
        let fitted = confine(outlines.fit(&field, nodes, &|view| !left_out(view)));
        let seen = confine(field.clone());
        let mut report = ShellsReport {
            layers: design.layers.len(),
            triangles: triangles(&field, mesh),
            softness_px: softness.median,
            left_out: [None, Some(&seen), Some(&fitted)].map(|s| outlines.error(s, &left_out)),
            ..ShellsReport::default()
        };
        let [none, ..] = report.left_out;
        report.kept = report.error().powi(2) < (1.0 - MIN_GAIN) * none * none;
        Ok(Candidate { field, outlines, report })
    }
}

/// Returns the factor of the cost of changes around each vertex of a mesh that is to be simplified
/// and then to have layers: where it will have them, it is hidden, and every triangle counts once
/// more for each layer. Returns none if nothing is soft.
pub fn importance(mesh: &Mesh, sharpness: &[f32], photographs: &[Photograph]) -> Vec<f32> {
    let softness = Softness::new(mesh, &Nodes::vertices(mesh), sharpness, photographs, None);
    let share = softness.map(|softness| softness.share).unwrap_or_default();
    share.into_iter().map(|share| MIN_IMPORTANCE.powf(share)).collect()
}

/// Returns the number of triangles of all layers together.
fn triangles(shells: &Shells, mesh: &Mesh) -> usize {
    shells.layers.iter().map(|layer| mesh.triangles.iter().filter(|t| layer.has(t)).count()).sum()
}

/// Returns the layers where one sees them: a vertex of less than [`MIN_ALPHA`] gets no opacity. The
/// others' are multiples of 1/255, as files keep them.
fn confine(mut shells: Shells) -> Shells {
    let seen = |alpha: f32| if alpha < MIN_ALPHA { 0.0 } else { f32::from(quantize(alpha)) / 255.0 };
    shells.layers.iter_mut().flat_map(|layer| &mut layer.alphas).for_each(|alpha| *alpha = seen(*alpha));
    shells
}

/// How soft the field is at the vertices of a mesh.
struct Softness {
    /// Its length `1 / s`, smooth over the mesh.
    width: Vec<f32>,
    /// Share of their full distance and opacity that layers have, 0..=1.
    share: Vec<f32>,
    /// Median softness of the vertices that have layers, in pixels.
    median: f32,
}

impl Softness {
    /// Returns the softness at the vertices of a mesh that is to have this number of layers, with
    /// no more triangles than [`MAX_SHARE`], if the number is known. Returns `None` if there are no
    /// masks or nothing is soft.
    fn new(
        mesh: &Mesh,
        nodes: &Nodes,
        sharpness: &[f32],
        photographs: &[Photograph],
        layers: Option<usize>,
    ) -> Option<Softness> {
        let pixel = |v: usize| {
            let size = |p: &Photograph| {
                let camera = p.camera;
                let depth = (mesh.positions[v] - camera.position.as_vec3()).length();
                depth / camera.fx.abs().max(camera.fy.abs()) as f32
            };
            photographs.iter().filter(|p| p.mask.is_some()).map(size).reduce(f32::min)
        };
        let width = nodes.smoothed(sharpness.iter().map(|s| 1.0 / s).collect(), ROUNDS);
        let pixels: Vec<f32> = (0..width.len()).into_par_iter().map(pixel).collect::<Option<_>>()?;
        let softness: Vec<f32> = width.iter().zip(&pixels).map(|(w, p)| w / p).collect();
        let least = layers.map_or(SOFTNESS_PX[0], |layers| least_softness(mesh, &softness, layers));
        let share = softness.iter().map(|soft| ((soft - least) / FULL_SOFTNESS_PX).clamp(0.0, 1.0)).collect();
        let mut soft: Vec<f32> = softness.into_iter().filter(|soft| *soft > least).collect();
        let median = median(&mut soft, f32::total_cmp)?;
        Some(Softness { width, share, median })
    }
}

/// Returns the layers of the field itself.
fn from_field(mesh: &Mesh, nodes: &Nodes, design: &Design, softness: &Softness) -> Shells {
    let (Design { depth, layers: distances }, Softness { width, share, .. }) = (design, softness);
    let depths = if *depth > 0.0 { depths(mesh, *depth, width, share) } else { Vec::new() };
    let fray = frays(nodes);
    let mut layers = Vec::new();
    for (k, &q) in distances.iter().enumerate() {
        let low = 0.5 * (q + if k == 0 { -depth } else { distances[k - 1] });
        let high = distances.get(k + 1).map_or(1.0, |next| sigmoid(0.5 * (q + next)));
        let alpha = 1.0 - (sigmoid(low) / high).sqrt();
        // as far above what is opaque as its depth was reached
        let offset = |v: usize| {
            let (full, reached) = (width[v] * share[v], depths.get(v).copied().unwrap_or(0.0));
            let inside = q < 0.0 && full > 0.0;
            let distance = if inside { q * reached / depth } else { q * full };
            fray[v] * (distance + reached) - reached
        };
        layers.push(ShellLayer {
            offsets: (0..width.len()).map(offset).collect(),
            alphas: share.iter().map(|share| alpha * share).collect(),
        });
    }
    Shells { layers, depths }
}

/// Returns the depth of the opaque mesh below each vertex: `depth` lengths `1 / s` where layers
/// have their full distance, less where triangles would be spoiled or meet others.
fn depths(mesh: &Mesh, depth: f32, width: &[f32], share: &[f32]) -> Vec<f32> {
    let target = |v: usize| mesh.positions[v] - mesh.normals[v] * (depth * width[v] * share[v]);
    let targets: Vec<Vec3> = (0..width.len()).map(target).collect();
    let mut positions = mesh.positions.clone();
    move_to(&mut positions, &mesh.triangles, &targets, &EXTRACTED);
    without_crossings(&mut positions, &mesh.triangles, &mesh.positions);
    let moved = |v: usize| (mesh.positions[v] - positions[v]).dot(mesh.normals[v]);
    (0..width.len()).map(moved).collect()
}

/// Returns random factors of the distances of all layers at a vertex, with a mean of about 1: see
/// [`FRAY`]. Layers share them, and so never cross.
fn frays(nodes: &Nodes) -> Vec<f32> {
    let noise = (0..nodes.len() as u64).map(|v| 2.0 * rng::uniform(0, 0, v) - 1.0).collect();
    let noise = nodes.smoothed(noise, NOISE_ROUNDS);
    let square = noise.iter().map(|n| n * n).sum::<f32>() / noise.len().max(1) as f32;
    let unit = FRAY / square.sqrt().max(f32::MIN_POSITIVE);
    noise.iter().map(|n| 1.0 + (n * unit).clamp(-2.0 * FRAY, 2.0 * FRAY)).collect()
}

/// Returns the softness from which on vertices have layers, in pixels, so that this number of
/// them has no more triangles than [`MAX_SHARE`].
fn least_softness(mesh: &Mesh, softness: &[f32], layers: usize) -> f32 {
    let of = |t: &[u32; 3]| t.iter().map(|&v| softness[v as usize]).fold(0.0, f32::max);
    let mut softest: Vec<f32> = mesh.triangles.iter().map(of).collect();
    softest.sort_by(|a, b| b.total_cmp(a));
    let most = (MAX_SHARE * softest.len() as f64) as usize / layers;
    softest.get(most).map_or(SOFTNESS_PX[0], |soft| soft.clamp(SOFTNESS_PX[0], SOFTNESS_PX[1]))
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{SIZE, ball, ball_mask, cameras};
    use tiface_base::Quiet;
    use tiface_base::geom::Camera;
    use tiface_base::image::{Gray, Photo};

    /// Black photographs of a ball with soft masks.
    struct Photos {
        photo: Photo,
        cameras: Vec<Camera>,
        masks: Vec<Gray>,
    }

    impl Photos {
        fn new(sharpness: f32) -> Photos {
            let cameras = cameras();
            let masks = cameras.iter().map(|c| ball_mask(c, 0.5, sharpness)).collect();
            let rgb = vec![[0; 3]; (SIZE * SIZE) as usize];
            Photos { photo: Photo { width: SIZE, height: SIZE, rgb, alpha: None }, cameras, masks }
        }

        fn photographs(&self) -> Vec<Photograph<'_>> {
            let views = self.cameras.iter().zip(&self.masks);
            let view = |(camera, mask)| Photograph {
                camera,
                photo: &self.photo,
                mask: Some(mask),
                valid: None,
                rendered: false,
            };
            views.map(view).collect()
        }
    }

    fn run(field: f32, masks: f32) -> (Option<FittedShells>, ShellsReport) {
        let mesh = ball(0.5);
        let sharpness = vec![field; mesh.positions.len()];
        fit(&mesh, &sharpness, &Photos::new(masks).photographs(), &Quiet).unwrap()
    }

    fn of_field(mesh: &Mesh, sharpness: &[f32], photographs: &[Photograph]) -> Shells {
        let nodes = Nodes::vertices(mesh);
        let softness = Softness::new(mesh, &nodes, sharpness, photographs, None).unwrap();
        from_field(mesh, &nodes, &DESIGNS[0], &softness)
    }

    #[test]
    fn a_soft_ball_gets_layers_as_soft_as_its_masks() {
        // 1 / s is 0.05, and a pixel 0.025 at the nearest vertex
        let (shells, report) = run(20.0, 20.0);
        let shells = shells.unwrap().shells;
        assert!((report.softness_px - 0.05 / 0.025).abs() < 0.1, "{report:?}");
        assert_eq!((report.layers, shells.layers.len()), (4, 4));
        let [none, _, fitted] = report.left_out;
        assert!(fitted < 0.5 * none, "{report:?}");
        // frayed to both sides alike, above what is opaque
        assert!(shells.depths.iter().all(|depth| (depth - 0.1).abs() < 1e-3), "{:?}", shells.depths);
        for (layer, distance) in shells.layers.iter().zip([0.05, 0.125, 0.225, 0.4]) {
            let parts: Vec<f32> = layer.offsets.iter().map(|o| (o + 0.1) / distance).collect();
            let mean = parts.iter().sum::<f32>() / parts.len() as f32;
            let spread = parts.iter().map(|p| (p - mean).powi(2)).sum::<f32>() / parts.len() as f32;
            assert!((mean - 1.0).abs() < 0.05 && (spread.sqrt() - FRAY).abs() < 0.03, "{mean} {spread}");
            assert!(parts.iter().all(|p| (p - 1.0).abs() < 2.0 * FRAY + 1e-3));
        }
        for pair in shells.layers.windows(2) {
            assert!(pair[0].offsets.iter().zip(&pair[1].offsets).all(|(a, b)| a <= b));
        }
        // opacities are those of files, and none is too small to be seen
        for alpha in shells.layers.iter().flat_map(|layer| &layer.alphas) {
            assert_eq!(f32::from(quantize(*alpha)) / 255.0, *alpha);
            assert!(*alpha == 0.0 || *alpha >= MIN_ALPHA - 1e-6, "{alpha}");
        }
        assert_eq!(report.kept_triangles, triangles(&shells, &ball(0.5)));
    }

    #[test]
    fn the_field_says_how_much_rays_lose_between_layers() {
        let (mesh, photos) = (ball(0.5), Photos::new(20.0));
        let sharpness = vec![20.0; mesh.positions.len()];
        let shells = of_field(&mesh, &sharpness, &photos.photographs()[..1]);
        // layers at -1 and 1/2 above what is opaque at -2: 1 − √(σ(-3/2) / σ(-1/4)) =
        // 1 − √(0.18243 / 0.43782); and the last, from 17/4 on: 1 − √0.98594
        let most = |layer: &ShellLayer| layer.alphas.iter().copied().fold(0.0, f32::max);
        let (first, last) = (most(&shells.layers[0]), most(&shells.layers[3]));
        assert!((first - 0.35450).abs() < 1e-4 && (last - 0.00706).abs() < 1e-4, "{first} {last}");
    }

    #[test]
    fn masks_softer_than_the_field_make_outer_layers_denser() {
        let alpha = |masks: f32| {
            let layer = run(20.0, masks).0.unwrap().shells.layers.swap_remove(2);
            layer.alphas.iter().sum::<f32>() / layer.alphas.len() as f32
        };
        assert!(alpha(10.0) > alpha(20.0) + 0.02, "{} {}", alpha(10.0), alpha(20.0));
    }

    #[test]
    fn rendered_views_change_opacities_where_they_are_valid() {
        let (mesh, photos, denser) = (ball(0.5), Photos::new(20.0), Photos::new(10.0));
        let opacity = |views: Vec<Photograph>| {
            let pictures: Vec<Photograph> = photos.photographs().into_iter().chain(views).collect();
            let (shells, triangles) = run(20.0, 20.0).0.unwrap().refit(&mesh, &pictures, &Quiet).unwrap();
            assert_eq!(triangles, super::triangles(&shells, &mesh));
            shells.layers[2].alphas.iter().sum::<f32>() / mesh.positions.len() as f32
        };
        let rendered = |valid| -> Vec<Photograph> {
            let views = denser.photographs().into_iter();
            views.map(|p| Photograph { rendered: true, valid: Some(valid), ..p }).collect()
        };
        let all = |value: u8| Gray { values: vec![value; (SIZE * SIZE) as usize], ..denser.masks[0].clone() };
        let (some, none) = (opacity(rendered(&all(255))), opacity(rendered(&all(0))));
        assert_eq!(none, opacity(Vec::new()));
        assert!(some > none + 0.01, "{some} {none}");
    }

    #[test]
    fn there_are_no_layers_around_a_hard_ball_or_where_masks_are_hard() {
        // a hundredth of a pixel
        assert_eq!(run(4000.0, 4000.0), (None, ShellsReport::default()));
        let (none, report) = run(20.0, 4000.0);
        assert!(none.is_none() && !report.kept && report.triangles > 0, "{report:?}");
    }

    #[test]
    fn layers_stay_where_the_mesh_is_softest() {
        // from 0.9 pixels below to 1.2 above
        let mesh = ball(0.5);
        let softness: Vec<f32> = mesh.positions.iter().map(|p| 1.05 + 0.3 * p.z).collect();
        let least = least_softness(&mesh, &softness, 4);
        let more = |t: &&[u32; 3]| t.iter().any(|&v| softness[v as usize] > least);
        let share = mesh.triangles.iter().filter(more).count() as f64 / mesh.triangles.len() as f64;
        assert!((0.9..1.2).contains(&least) && (share - MAX_SHARE / 4.0).abs() < 0.02, "{least} {share}");
        assert_eq!(least_softness(&mesh, &vec![2.0; mesh.positions.len()], 4), 1.2);
        assert_eq!(least_softness(&mesh, &vec![0.2; mesh.positions.len()], 4), 0.85);
    }

    #[test]
    fn a_layer_ends_where_one_does_not_see_it() {
        // opacity falls evenly from 1/2 above to nothing at the equator, and is none below
        let mesh = ball(0.5);
        let alphas: Vec<f32> = mesh.positions.iter().map(|p| p.z.max(0.0)).collect();
        let layer = ShellLayer { offsets: vec![0.1; mesh.positions.len()], alphas: alphas.clone() };
        let layer = confine(Shells { layers: vec![layer], ..Shells::default() }).layers.swap_remove(0);
        for (before, after) in alphas.iter().zip(&layer.alphas) {
            let kept = if *before < MIN_ALPHA { 0.0 } else { *before };
            assert!((kept - after).abs() <= 0.5 / 255.0 + 1e-6, "{before} {after}");
        }
        for triangle in mesh.triangles.iter().filter(|t| layer.has(t)) {
            let most = triangle.iter().map(|&v| alphas[v as usize]).fold(0.0, f32::max);
            assert!(most >= 1.0 / 50.0, "{most}");
        }
    }

    #[test]
    fn the_surface_stays_opaque_where_that_is_closer_to_left_out_masks() {
        // strands of the field reach farther than those of the masks
        let (shells, report) = run(20.0, 60.0);
        let shells = shells.unwrap().shells;
        assert_eq!((report.layers, shells.layers.len(), shells.depths.len()), (2, 2, 0));
    }

    #[test]
    fn what_will_have_layers_is_simplified_more() {
        // pixels are 0.025 at the nearest vertex: half a pixel above, two below
        let (mesh, photos) = (ball(0.5), Photos::new(20.0));
        let photographs = photos.photographs();
        let sharpness: Vec<f32> =
            mesh.positions.iter().map(|p| if p.z > 0.0 { 80.0 } else { 20.0 }).collect();
        let importance = importance(&mesh, &sharpness, &photographs);
        let above = |mesh: &Mesh| {
            let z = |t: &[u32; 3]| t.iter().map(|&v| mesh.positions[v as usize].z).sum::<f32>();
            mesh.triangles.iter().filter(|t| z(t) > 0.0).count() as f64 / mesh.triangles.len() as f64
        };
        let simplified = |importance: Vec<f32>| {
            let mut simpler = mesh.clone();
            let triangles = mesh.triangles.len() / 4;
            let config = crate::SimplifyConfig { triangles, importance, ..Default::default() };
            crate::simplify(&mut simpler, None, &config, &Quiet).unwrap();
            above(&simpler)
        };
        let (even, more) = (simplified(Vec::new()), simplified(importance));
        assert!((even - 0.5).abs() < 0.05 && more > 0.65, "{even} {more}");
        assert!(super::importance(&mesh, &vec![4000.0; mesh.positions.len()], &photographs).is_empty());
    }

    #[test]
    fn opacity_falls_towards_where_no_layer_is() {
        // masks are soft all around, but the field below is hard
        let (mesh, photos) = (ball(0.5), Photos::new(20.0));
        let sharpness: Vec<f32> =
            mesh.positions.iter().map(|p| if p.y > 0.0 { 20.0 } else { 4000.0 }).collect();
        let shells = fit(&mesh, &sharpness, &photos.photographs(), &Quiet).unwrap().0.unwrap().shells;
        let nodes = Nodes::vertices(&mesh);
        let layer = &shells.layers[3];
        // as does the depth of what is opaque
        let parts = shells.depths.iter().zip(&layer.offsets);
        assert!(parts.clone().all(|(depth, offset)| *offset != 0.0 || *depth == 0.0));
        let ring = |v: usize| nodes.near(v).iter().any(|&n| layer.offsets[n as usize] == 0.0);
        // of all layers together
        let opacity = |v: usize| 1.0 - shells.layers.iter().map(|l| 1.0 - l.alphas[v]).product::<f32>();
        let mean = |of: &dyn Fn(usize) -> bool| {
            let some: Vec<f32> = (0..mesh.positions.len())
                .filter(|&v| layer.offsets[v] != 0.0 && of(v))
                .map(opacity)
                .collect();
            some.iter().sum::<f32>() / some.len() as f32
        };
        let (border, inside) = (mean(&ring), mean(&|v| mesh.positions[v].y > 0.2));
        assert!(border < 0.75 * inside, "{border} {inside}");
    }

    #[test]
    fn slopes_are_those_of_differences() {
        let (mesh, photos) = (ball(0.5), Photos::new(20.0));
        let photographs = &photos.photographs()[3..4];
        let shells = of_field(&mesh, &vec![20.0; mesh.positions.len()], photographs);
        let outlines = Outlines::new(&mesh, &shells, photographs, &Quiet).unwrap();
        let row = (0..outlines.rows()).find(|&r| outlines.rays[r].iter().any(|l| l.len() == 8)).unwrap();
        let mut slopes = Vec::new();
        outlines.opacity(row, Some(&shells), Some(&mut slopes));
        let (vertices, h) = (mesh.positions.len(), 1e-2);
        for (at, slope) in slopes {
            let moved = |by: f32| {
                let mut moved = shells.clone();
                moved.layers[at as usize / vertices].alphas[at as usize % vertices] += by;
                outlines.opacity(row, Some(&moved), None)
            };
            let difference = (moved(h) - moved(-h)) / (2.0 * h);
            assert!((difference - slope).abs() < 1e-2 * slope.abs() + 2e-5, "{difference} {slope}");
        }
    }
}

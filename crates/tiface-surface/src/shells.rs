//! Soft layers around the mesh where the field is softer than a surface: the outline of hair.
//!
//! The field's opacity falls from one to none over a few lengths `1 / s` of its local sharpness
//! `s`: a ray that comes as near as `f` to its level set is stopped to the share `σ(−f · s)` (Wang
//! et al., NeuS, 2021). The mesh stands at `f = 0` and shows nothing of what is outside. Layers at
//! `f = q / s` do, the opacity of each what rays lose between the middles to its neighbors:
//!
//! ```text
//! (1 − α_k)² = σ(q_low) / σ(q_high)
//! ```
//!
//! squared, since a ray along the outline meets both sides of a layer. Layers are frayed: their
//! distances are `q / s` times random factors around 1, while these opacities are those at `q / s`;
//! the fit makes up for the difference.
//!
//! From there the opacities at the vertices of each layer are fitted to the outlines of the masks
//! ([`Photograph::mask`]): strands reach farther than the field says, and where no outline is soft
//! nothing remains. Both are evaluated on photographs that were left out, and the layers are
//! dropped if they gain nothing. The mesh itself stays as it is: inside of it nothing is
//! transparent.
//!
//! Of each layer only the triangles that one sees remain. At the border of what remains the opacity
//! has fallen to nothing: vertices that have none take part in the fit as neighbors.

mod outlines;

use super::appearance::{Nodes, Photograph};
use outlines::Outlines;
use rayon::prelude::*;
use serde::Serialize;
use tiface_base::geom::{Mesh, ShellLayer, Shells};
use tiface_base::image::quantize;
use tiface_base::math::{rank::median, rng};
use tiface_base::{Monitor, Result};

/// Mean distances of the layers, in lengths `1 / s`. A ray meets each of them twice, and more often
/// where they are folded, and path tracers stop at the eighth transparent face. Three layers would
/// say little more than two of the same number of triangles.
const LAYERS: [f32; 2] = [2.0, 5.0];

/// Standard deviation of the distances of the layers' vertices relative to their mean, before they
/// are clamped to two deviations from it. A frayed layer ends in tufts; an even one ends in a ring
/// that is visible before white.
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
    report.triangles = triangles(&field, mesh);
    report.softness_px = soft;
    let outlines = Outlines::new(mesh, &field, photographs, monitor)?;
    if outlines.rows() == 0 {
        return Ok((None, report));
    }
    // of a few photographs the last
    let every = VALIDATION_STRIDE.min(photographs.len());
    let left_out = |view: u32| every > 1 && view as usize % every == every - 1;
    let fitted = |keep: &dyn Fn(u32) -> bool| confine(outlines.fit(&field, &nodes, keep));
    let first = fitted(&|view| !left_out(view));
    let seen = confine(field.clone());
    let errors = [None, Some(&seen), Some(&first)].map(|s| outlines.error(s, &left_out));
    report.left_out = errors;
    let best = errors[1].min(errors[2]);
    report.kept = best * best < (1.0 - MIN_GAIN) * errors[0] * errors[0];
    if !report.kept {
        return Ok((None, report));
    }
    let shells = if errors[2] < errors[1] { fitted(&|_| true) } else { seen };
    report.kept_triangles = triangles(&shells, mesh);
    Ok((Some(shells), report))
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
    let width = nodes.smoothed(sharpness.iter().map(|s| 1.0 / s).collect(), ROUNDS);
    let pixels: Vec<f32> = (0..width.len()).into_par_iter().map(pixel).collect::<Option<_>>()?;
    let softness: Vec<f32> = width.iter().zip(&pixels).map(|(w, p)| w / p).collect();
    let least = least_softness(mesh, &softness);
    let share: Vec<f32> =
        softness.iter().map(|soft| ((soft - least) / FULL_SOFTNESS_PX).clamp(0.0, 1.0)).collect();
    let mut soft: Vec<f32> = softness.into_iter().filter(|soft| *soft > least).collect();
    let median = median(&mut soft, f32::total_cmp)?;
    let fray = frays(nodes);
    let mut layers = Vec::new();
    for (k, q) in LAYERS.into_iter().enumerate() {
        let low = 0.5 * (q + if k == 0 { 0.0 } else { LAYERS[k - 1] });
        let high = LAYERS.get(k + 1).map_or(1.0, |next| sigmoid(0.5 * (q + next)));
        let alpha = 1.0 - (sigmoid(low) / high).sqrt();
        layers.push(ShellLayer {
            offsets: (0..width.len()).map(|v| fray[v] * q * width[v] * share[v]).collect(),
            alphas: share.iter().map(|share| alpha * share).collect(),
        });
    }
    Some((Shells { layers }, median))
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

/// Returns the softness from which on vertices of this softness have layers, in pixels.
fn least_softness(mesh: &Mesh, softness: &[f32]) -> f32 {
    let of = |t: &[u32; 3]| t.iter().map(|&v| softness[v as usize]).fold(0.0, f32::max);
    let mut softest: Vec<f32> = mesh.triangles.iter().map(of).collect();
    softest.sort_by(|a, b| b.total_cmp(a));
    let most = (MAX_SHARE * softest.len() as f64) as usize / LAYERS.len();
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
    use tiface_base::image::{Gray, Photo};

    fn black() -> Photo {
        Photo { width: SIZE, height: SIZE, rgb: vec![[0; 3]; (SIZE * SIZE) as usize], alpha: None }
    }

    fn run(field: f32, masks: f32) -> (Option<Shells>, ShellsReport) {
        let mesh = ball(0.5);
        let photo = black();
        let cameras = cameras();
        let masks: Vec<Gray> = cameras.iter().map(|c| ball_mask(c, 0.5, masks)).collect();
        let view = |(camera, mask)| Photograph { camera, photo: &photo, mask: Some(mask), valid: None };
        let photographs: Vec<Photograph> = cameras.iter().zip(&masks).map(view).collect();
        let sharpness = vec![field; mesh.positions.len()];
        fit(&mesh, &sharpness, &photographs, &Quiet).unwrap()
    }

    #[test]
    fn a_soft_ball_gets_layers_as_soft_as_its_masks() {
        // 1 / s is 0.05, and a pixel 0.025 at the nearest vertex
        let (shells, report) = run(20.0, 20.0);
        let shells = shells.unwrap();
        assert!((report.softness_px - 0.05 / 0.025).abs() < 0.1, "{report:?}");
        let [none, _, fitted] = report.left_out;
        assert!(fitted < 0.5 * none, "{report:?}");
        // frayed to both sides alike
        for (layer, distance) in shells.layers.iter().zip([0.1, 0.25]) {
            let parts: Vec<f32> = layer.offsets.iter().map(|o| o / distance).collect();
            let mean = parts.iter().sum::<f32>() / parts.len() as f32;
            let spread = parts.iter().map(|p| (p - mean).powi(2)).sum::<f32>() / parts.len() as f32;
            assert!((mean - 1.0).abs() < 0.05 && (spread.sqrt() - FRAY).abs() < 0.03, "{mean} {spread}");
            assert!(parts.iter().all(|p| (p - 1.0).abs() < 2.0 * FRAY + 1e-3));
        }
        assert!(shells.layers[0].offsets.iter().zip(&shells.layers[1].offsets).all(|(a, b)| a <= b));
        // opacities are those of files, and none is too small to be seen
        for alpha in shells.layers.iter().flat_map(|layer| &layer.alphas) {
            assert_eq!(f32::from(quantize(*alpha)) / 255.0, *alpha);
            assert!(*alpha == 0.0 || *alpha >= MIN_ALPHA - 1e-6, "{alpha}");
        }
        assert_eq!(report.kept_triangles, triangles(&shells, &ball(0.5)));
    }

    #[test]
    fn the_field_says_how_much_rays_lose_between_layers() {
        let (mesh, camera) = (ball(0.5), &cameras()[0]);
        let (photo, mask) = (black(), ball_mask(camera, 0.5, 20.0));
        let photographs = [Photograph { camera, photo: &photo, mask: Some(&mask), valid: None }];
        let sharpness = vec![20.0; mesh.positions.len()];
        let (shells, _) = from_field(&mesh, &Nodes::vertices(&mesh), &sharpness, &photographs).unwrap();
        // layers at 2 and 5: 1 − √(σ(1) / σ(7/2)) = 1 − √(0.73106 / 0.97069), and the last:
        // 1 − √σ(7/2)
        let most = |layer: &ShellLayer| layer.alphas.iter().copied().fold(0.0, f32::max);
        let first: Vec<f32> = shells.layers.iter().map(most).collect();
        assert!((first[0] - 0.13217).abs() < 1e-4 && (first[1] - 0.01477).abs() < 1e-4, "{first:?}");
    }

    #[test]
    fn masks_softer_than_the_field_make_outer_layers_denser() {
        let alpha = |masks: f32| {
            let layer = run(20.0, masks).0.unwrap().layers.swap_remove(1);
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
    fn layers_stay_where_the_mesh_is_softest() {
        // from 0.9 pixels below to 1.2 above
        let mesh = ball(0.5);
        let softness: Vec<f32> = mesh.positions.iter().map(|p| 1.05 + 0.3 * p.z).collect();
        let least = least_softness(&mesh, &softness);
        let more = |t: &&[u32; 3]| t.iter().any(|&v| softness[v as usize] > least);
        let share = mesh.triangles.iter().filter(more).count() as f64 / mesh.triangles.len() as f64;
        assert!((0.9..1.2).contains(&least) && (share - MAX_SHARE / 2.0).abs() < 0.02, "{least} {share}");
        assert_eq!(least_softness(&mesh, &vec![2.0; mesh.positions.len()]), 1.2);
        assert_eq!(least_softness(&mesh, &vec![0.2; mesh.positions.len()]), 0.85);
    }

    #[test]
    fn a_layer_ends_where_one_does_not_see_it() {
        // opacity falls evenly from 1/2 above to nothing at the equator, and is none below
        let mesh = ball(0.5);
        let alphas: Vec<f32> = mesh.positions.iter().map(|p| p.z.max(0.0)).collect();
        let layer = ShellLayer { offsets: vec![0.1; mesh.positions.len()], alphas: alphas.clone() };
        let layer = confine(Shells { layers: vec![layer] }).layers.swap_remove(0);
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
    fn opacity_falls_towards_where_no_layer_is() {
        // masks are soft all around, but the field below is hard
        let (mesh, photo, cameras) = (ball(0.5), black(), cameras());
        let masks: Vec<Gray> = cameras.iter().map(|c| ball_mask(c, 0.5, 20.0)).collect();
        let view = |(camera, mask)| Photograph { camera, photo: &photo, mask: Some(mask), valid: None };
        let photographs: Vec<Photograph> = cameras.iter().zip(&masks).map(view).collect();
        let sharpness: Vec<f32> =
            mesh.positions.iter().map(|p| if p.y > 0.0 { 20.0 } else { 4000.0 }).collect();
        let shells = fit(&mesh, &sharpness, &photographs, &Quiet).unwrap().0.unwrap();
        let nodes = Nodes::vertices(&mesh);
        let layer = &shells.layers[0];
        let ring = |v: usize| nodes.near(v).iter().any(|&n| layer.offsets[n as usize] == 0.0);
        let mean = |of: &dyn Fn(usize) -> bool| {
            let some: Vec<f32> = (0..mesh.positions.len())
                .filter(|&v| layer.offsets[v] > 0.0 && of(v))
                .map(|v| layer.alphas[v])
                .collect();
            some.iter().sum::<f32>() / some.len() as f32
        };
        let (border, inside) = (mean(&ring), mean(&|v| mesh.positions[v].y > 0.2));
        assert!(border < 0.75 * inside, "{border} {inside}");
    }

    #[test]
    fn slopes_are_those_of_differences() {
        let mesh = ball(0.5);
        let camera = &cameras()[3];
        let mask = ball_mask(camera, 0.5, 20.0);
        let photo = black();
        let photographs = [Photograph { camera, photo: &photo, mask: Some(&mask), valid: None }];
        let nodes = Nodes::vertices(&mesh);
        let (shells, _) = from_field(&mesh, &nodes, &vec![20.0; mesh.positions.len()], &photographs).unwrap();
        let outlines = Outlines::new(&mesh, &shells, &photographs, &Quiet).unwrap();
        let row = (0..outlines.rows()).find(|&r| outlines.rays[r].iter().any(|l| l.len() == 4)).unwrap();
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

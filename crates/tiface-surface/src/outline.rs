//! Moves of a surface to its outlines in photographs.
//!
//! The mesh of a learned field ends 0.1 to 0.2 pixels inside of the masks that the field was
//! trained on: a ray along the outline meets several bumps, each of which stops a part of it, so
//! that the field shows more than its zero set; and smoothing takes away the bumps that made the
//! outline of the mesh. Masks say where the outline is, to a fraction of a pixel where they are
//! sharp. So each vertex `v` moves along its normal by an offset `δ_v`, and all together minimize,
//! by steps of Gauss and Newton,
//!
//! ```text
//! Σ_i w_i (d_i − Σ_v s_iv δ_v)² + smooth Σ_{edges vw} (δ_v − δ_w)² + ridge Σ_v δ_v²
//! ```
//!
//! over points `i` of the mesh's outlines before the background: `d` is the distance to where the
//! mask's opacity is one half, `s` by how much the outline moves with a vertex, and the weight `w`
//! is the length of outline times the share of the mask's opacity that falls within a pixel, so
//! that hair says little. Every step finds the outlines of the moved mesh again.

mod silhouette;

use super::appearance::{Nodes, Photograph};
use super::moves::{EXTRACTED, move_to};
use super::regularized::{Equation, Prior, step};
use super::simplify::without_crossings;
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use silhouette::{Edge, OutlinePoint, Shown, edges};
use tiface_base::geom::Mesh;
use tiface_base::math::rank::median;
use tiface_base::{Monitor, Result};

/// Against the square of a pixel's distance on a pixel's length of outline. With a third of this
/// ridge outlines are hardly closer, and the surface lies 0.03 pixels outside.
const PRIOR: Prior = Prior { ridge: 0.3, smooth: 1.0 };

/// Distance beyond which a point counts linearly, pixels: the mask shows something else there.
const KNEE: f32 = 1.0;

/// Maximum offset, pixels.
const LIMIT: f64 = 1.0;

/// Gauss-Newton steps. Later ones change little.
const ROUNDS: usize = 3;

/// Maximum number of steps of conjugate gradients in each.
const STEPS: usize = 100;

/// Every n-th photograph is left out, to validate the offsets.
const VALIDATION_STRIDE: usize = 6;

/// A report of the moves.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OutlineReport {
    /// Root mean square distance of the mask's outline from the mesh's in photographs that were
    /// left out, in pixels, before and after: by weight, and without points that have none within
    /// reach.
    pub left_out_px: [f64; 2],
    /// Mean distance in them before, pixels; positive if the mesh was too small.
    pub mean_px: f64,
    /// Whether the surface was moved: it is if the photographs that were left out agree.
    pub kept: bool,
    /// Mean distance by which vertices moved, in units of the positions.
    pub mean_move: f64,
    /// Largest distance.
    pub largest_move: f32,
    /// Vertices that moved less than asked, because a triangle would have been spoiled or would
    /// have crossed another.
    pub held_back: usize,
}

/// Moves the surface to the outlines of the masks of photographs. Vertices that are `fixed` stay.
/// Normals become angle-weighted; colors stay with their vertices. No triangle turns by 80 degrees
/// or more, becomes a sliver, or crosses another that it did not cross before.
///
/// Returns `None` if no photograph has a mask; with a single one that has, nothing moves. The same
/// bytes for any number of threads.
///
/// # Errors
///
/// A request to stop; the mesh is then as it was.
pub fn fit(
    mesh: &mut Mesh,
    fixed: &[bool],
    photographs: &[Photograph],
    monitor: &dyn Monitor,
) -> Result<Option<OutlineReport>> {
    let masked: Vec<&Photograph> = photographs.iter().filter(|p| p.mask.is_some()).collect();
    let Some(unit) = pixel(mesh, &masked) else { return Ok(None) };
    let outlines = Outlines {
        edges: edges(&mesh.triangles),
        nodes: Nodes::vertices(mesh),
        normals: mesh.angle_weighted_normals(),
        unit,
        mesh: &*mesh,
        fixed,
    };
    // of a few photographs the last
    let every = VALIDATION_STRIDE.min(masked.len());
    let (left_out, others): (Vec<_>, Vec<_>) =
        masked.iter().enumerate().partition(|(view, _)| every > 1 && view % every == every - 1);
    let [left_out, others] = [left_out, others].map(|v| v.into_iter().map(|(_, p)| *p).collect::<Vec<_>>());
    let none = vec![0.0; mesh.positions.len()];
    let before = outlines.points(&none, &left_out);
    let first = outlines.fitted(&others, 1, monitor)?;
    let mut report = OutlineReport {
        left_out_px: [root_mean_square(&before), root_mean_square(&outlines.points(&first, &left_out))],
        mean_px: weighted_mean(&before, |p| p.rest.into()),
        ..OutlineReport::default()
    };
    report.kept = report.left_out_px[1] < report.left_out_px[0];
    if !report.kept {
        return Ok(Some(report));
    }
    let targets = outlines.moved(&outlines.fitted(&masked, ROUNDS, monitor)?).positions;
    let start = mesh.positions.clone();
    report.held_back = move_to(&mut mesh.positions, &mesh.triangles, &targets, &EXTRACTED)
        + without_crossings(&mut mesh.positions, &mesh.triangles, &start);
    mesh.normals = mesh.angle_weighted_normals();
    let moves = || mesh.positions.iter().zip(&start).map(|(p, from)| p.distance(*from));
    report.mean_move = moves().map(f64::from).sum::<f64>() / start.len() as f64;
    report.largest_move = moves().fold(0.0, f32::max);
    Ok(Some(report))
}

/// Returns the size of a pixel in the middle of a mesh, the median of photographs.
fn pixel(mesh: &Mesh, photographs: &[&Photograph]) -> Option<f32> {
    let middle = (!mesh.triangles.is_empty()).then(|| mesh.bounds().center())?;
    let size = |p: &&Photograph| {
        let camera = p.camera;
        middle.distance(camera.position.as_vec3()) / camera.fx.abs().max(camera.fy.abs()) as f32
    };
    let mut sizes: Vec<f32> = photographs.iter().map(size).collect();
    median(&mut sizes, f32::total_cmp).filter(|size| size.is_finite() && *size > 0.0)
}

/// A surface whose vertices move along their normals.
struct Outlines<'a> {
    mesh: &'a Mesh,
    fixed: &'a [bool],
    normals: Vec<Vec3>,
    edges: Vec<Edge>,
    nodes: Nodes,
    /// Length that offsets count.
    unit: f32,
}

impl Outlines<'_> {
    /// Returns the surface with its vertices moved by offsets.
    fn moved(&self, offsets: &[f64]) -> Mesh {
        let place = |((p, n), by): ((&Vec3, &Vec3), &f64)| *p + *by as f32 * self.unit * *n;
        let positions = self.mesh.positions.iter().zip(&self.normals).zip(offsets).map(place).collect();
        Mesh { positions, triangles: self.mesh.triangles.clone(), ..Mesh::default() }
    }

    /// Returns the points of the moved surface's outlines in photographs.
    fn points(&self, offsets: &[f64], photographs: &[&Photograph]) -> Vec<OutlinePoint> {
        let mesh = self.moved(offsets);
        let shown = Shown::new(&mesh, &self.normals, self.unit);
        photographs.iter().flat_map(|p| shown.outline(&self.edges, p)).collect()
    }

    /// Returns the offsets that bring the outlines closest to those of the photographs' masks.
    fn fitted(&self, photographs: &[&Photograph], rounds: usize, monitor: &dyn Monitor) -> Result<Vec<f64>> {
        let mut offsets = vec![0.0; self.mesh.positions.len()];
        let moves = |v: usize, _: f64| !self.fixed.get(v).copied().unwrap_or(false);
        for _ in 0..rounds {
            monitor.check_stop()?;
            let points = self.points(&offsets, photographs);
            let equations: Vec<Equation> = points.par_iter().map(equation).collect();
            let by = step(&equations, &self.nodes, &offsets, PRIOR, moves, STEPS);
            offsets.iter_mut().zip(by).for_each(|(o, by)| *o = (*o + by).clamp(-LIMIT, LIMIT));
        }
        Ok(offsets)
    }
}

/// Returns the equation that a point adds: times the root of its weight.
fn equation(point: &OutlinePoint) -> Equation {
    let root = (point.weight * (KNEE / point.rest.abs()).min(1.0)).sqrt();
    (root * point.rest, point.slopes.iter().map(|&(v, slope)| (v, root * slope)).collect())
}

/// Returns the mean of a value of points, by weight; 0 of none.
fn weighted_mean(points: &[OutlinePoint], value: impl Fn(&OutlinePoint) -> f64) -> f64 {
    let total: f64 = points.iter().map(|p| f64::from(p.weight)).sum();
    let sum: f64 = points.iter().map(|p| f64::from(p.weight) * value(p)).sum();
    if total > 0.0 { sum / total } else { 0.0 }
}

fn root_mean_square(points: &[OutlinePoint]) -> f64 {
    weighted_mean(points, |p| f64::from(p.rest).powi(2)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::check;
    use crate::fixtures::{SIZE, Stopping, ball, ball_mask, cameras};
    use tiface_base::Quiet;
    use tiface_base::image::{Gray, Photo};

    /// Fits a ball of radius 0.485, half a pixel too small, to masks of balls of these radii.
    fn fitted(
        radius: impl Fn(usize) -> f32,
        fixed: &[bool],
        monitor: &dyn Monitor,
    ) -> (Mesh, Result<Option<OutlineReport>>) {
        let (mut mesh, cameras) = (ball(0.485), cameras());
        let photo =
            Photo { width: SIZE, height: SIZE, rgb: vec![[0; 3]; (SIZE * SIZE) as usize], alpha: None };
        // a ramp of about a pixel
        let masks: Vec<Gray> =
            cameras.iter().enumerate().map(|(k, camera)| ball_mask(camera, radius(k), 130.0)).collect();
        let view = |(camera, mask)| Photograph {
            camera,
            photo: &photo,
            mask: Some(mask),
            valid: None,
            rendered: false,
        };
        let photographs: Vec<Photograph> = cameras.iter().zip(&masks).map(view).collect();
        let report = fit(&mut mesh, fixed, &photographs, monitor);
        (mesh, report)
    }

    /// Returns the mean radius of vertices and their mean distance from `radius`.
    fn radii(mesh: &Mesh, radius: f32) -> (f32, f32) {
        let mean = |of: &dyn Fn(f32) -> f32| {
            mesh.positions.iter().map(|p| of(p.length())).sum::<f32>() / mesh.positions.len() as f32
        };
        (mean(&|r| r), mean(&|r| (r - radius).abs()))
    }

    #[test]
    fn a_ball_that_is_too_small_grows_to_its_outlines() {
        let (mesh, report) = fitted(|_| 0.5, &[], &Quiet);
        let report = report.unwrap().unwrap();
        let (mean, off) = radii(&mesh, 0.5);
        assert!((mean - 0.5).abs() < 0.004 && off < 0.005, "{mean} {off} {report:?}");
        assert!(report.kept && (report.mean_px - 0.5).abs() < 0.1, "{report:?}");
        let [before, after] = report.left_out_px;
        assert!(after < 0.5 * before, "{report:?}");
        assert_eq!(mesh.normals, mesh.angle_weighted_normals());
        let found = check(&mesh, 1.0);
        assert!(mesh.is_closed() && found.self_intersections == 0);
    }

    #[test]
    fn no_vertex_moves_farther_than_a_pixel() {
        let (mesh, report) = fitted(|_| 0.56, &[], &Quiet);
        let farthest = mesh.positions.iter().map(|p| p.length()).fold(0.0, f32::max);
        assert!((0.51..0.517).contains(&farthest), "{farthest} {report:?}");
    }

    #[test]
    fn fixed_vertices_stay() {
        let fixed: Vec<bool> = ball(0.485).positions.iter().map(|p| p.y > 0.2).collect();
        let (mesh, _) = fitted(|_| 0.5, &fixed, &Quiet);
        for ((p, from), fixed) in mesh.positions.iter().zip(&ball(0.485).positions).zip(&fixed) {
            assert!(p == from || !fixed, "{from} {p}");
        }
        assert!(mesh.positions.iter().filter(|p| p.y < 0.0).all(|p| p.length() > 0.488));
    }

    #[test]
    fn photographs_that_were_left_out_must_agree() {
        let start = ball(0.485);
        let (mesh, report) = fitted(|view| if view % 6 == 5 { 0.47 } else { 0.5 }, &[], &Quiet);
        let report = report.unwrap().unwrap();
        assert!(!report.kept && report.left_out_px[1] > report.left_out_px[0], "{report:?}");
        assert_eq!(mesh, start);
    }

    #[test]
    fn without_masks_and_when_asked_to_stop_nothing_moves() {
        let mut mesh = ball(0.485);
        assert_eq!(fit(&mut mesh, &[], &[], &Quiet).unwrap(), None);
        assert_eq!(fit(&mut Mesh::default(), &[], &[], &Quiet).unwrap(), None);
        let (stopped, report) = fitted(|_| 0.5, &[], &Stopping);
        assert!(report.is_err());
        assert_eq!([&mesh, &stopped], [&ball(0.485); 2]);
    }

    #[test]
    fn the_number_of_threads_changes_no_byte() {
        let made = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let (mesh, report) = fitted(|_| 0.5, &[], &Quiet);
                (mesh, report.unwrap())
            })
        };
        assert_eq!(made(1), made(3));
    }
}

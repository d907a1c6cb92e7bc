//! Dense extraction: the two-pass method of the published code.
//!
//! instant-nsr-pl's `isosurface` runs marching cubes over `resolution`³ nodes of the box, then once more over as many
//! nodes of the surface's own box, grown by a tenth of its size on every side. Nothing is closed, cleaned, moved or
//! left out: a surface that leaves the box is open at its border.
//!
//! The dense grid also measures what the sparse extraction misses.

use super::marching::{Volume, marching};
use super::{MeshReport, NodeGrid, off_surface};
use crate::geom::{Aabb, Mesh, topology};
use crate::mesh::input::{check_len, setting};
use crate::{Error, Monitor, Result};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// How much the surface's box grows on each side, as a share of its size.
const MARGIN: f32 = 0.1;

/// Meshes the zero level set of `sdf` (negative inside) on all nodes of a grid of `resolution`³ nodes, first over
/// `bounds` and then over the box of the surface found. Needs four bytes a node. The closures are those of
/// [`extract`](super::extract), `batch` is the maximum number of points per call.
///
/// # Errors
///
/// Fails for a resolution outside 2..=2048, a field without a surface, values of the wrong length, or a request to
/// stop.
pub fn extract_dense(
    sdf: impl Fn(&[Vec3]) -> Vec<f32>,
    sdf_gradient: impl Fn(&[Vec3]) -> (Vec<f32>, Vec<Vec3>),
    color: impl Fn(&[Vec3], &[Vec3]) -> Vec<[f32; 3]>,
    bounds: Aabb,
    (resolution, batch): (usize, usize),
    monitor: &dyn Monitor,
) -> Result<(Mesh, MeshReport)> {
    let begin = Instant::now();
    setting((2..=2048).contains(&resolution), "mesh.resolution", "2..=2048", resolution)?;
    NodeGrid::fit(bounds, resolution)?; // says what is wrong with the box
    let steps = 2 * resolution as u64;
    let layers = |pass: u64, inside: Aabb| -> Result<(Vec<f32>, Vec3)> {
        let spacing = inside.size() / (resolution - 1) as f32;
        let mut values = Vec::with_capacity(resolution.pow(3));
        let mut points = Vec::with_capacity(resolution * resolution);
        for z in 0..resolution {
            monitor.step(pass * resolution as u64 + z as u64, steps, &[]);
            monitor.check_stop()?;
            points.clear();
            let node = |i: usize| Vec3::new((i % resolution) as f32, (i / resolution) as f32, z as f32);
            points.extend((0..resolution * resolution).map(|i| inside.min + node(i) * spacing));
            for points in points.chunks(batch.max(1)) {
                let found = sdf(points);
                check_len("signed distance", points.len(), found.len())?;
                values.extend(found);
            }
        }
        Ok((values, spacing))
    };
    let mut inside = bounds;
    let mut report = MeshReport::default();
    let mut mesh = Mesh::default();
    for pass in 0..2 {
        let (values, spacing) = layers(pass, inside)?;
        let volume = Volume { dims: [resolution; 3], values: &values, origin: inside.min, spacing };
        let found = marching(&volume, false)?;
        if found.triangles.is_empty() {
            let (nodes, size) = (values.len(), inside.size());
            return Err(Error::no_surface(
                format!("the field does not change its sign at {nodes} nodes of {size:.3}"),
                "train longer, or check that the box holds the head (`capture.box`)",
            ));
        }
        report.cells = [resolution - 1; 3];
        report.cell_size = spacing.max_element();
        report.grid = [inside.min.to_array(), inside.max.to_array()];
        report.nodes_evaluated += values.len();
        report.share_evaluated = 1.0;
        report.non_finite = found.non_finite;
        mesh = found.into_mesh();
        let surface = mesh.bounds();
        let margin = MARGIN * surface.size();
        inside =
            Aabb { min: (surface.min - margin).max(bounds.min), max: (surface.max + margin).min(bounds.max) };
    }
    mesh.normals = mesh.angle_weighted_normals();
    let (mut values, mut gradients) = (Vec::new(), Vec::new());
    let vertices = mesh.positions.chunks(batch.max(1)).zip(mesh.normals.chunks_mut(batch.max(1)));
    for (points, normals) in vertices {
        let (value, gradient) = sdf_gradient(points);
        check_len("gradient", points.len(), gradient.len())?;
        for (normal, g) in normals.iter_mut().zip(&gradient) {
            *normal = g.try_normalize().unwrap_or(*normal);
        }
        let colors = color(points, normals);
        check_len("color", points.len(), colors.len())?;
        let tame = |c: f32| if c.is_finite() { c.clamp(0.0, 1.0) } else { 0.0 };
        mesh.colors.extend(colors.iter().map(|c| c.map(tame)));
        values.extend(value);
        gradients.extend(gradient);
    }
    let nowhere = vec![false; mesh.positions.len()];
    report.off_surface_before = off_surface(&values, &gradients, &nowhere, report.cell_size);
    report.off_surface_after = report.off_surface_before;
    report.topology = topology(&mesh.positions, &mesh.triangles);
    report.clean.pieces = report.topology.pieces;
    report.clean.kept = report.clean.pieces;
    report.handles.left = report.topology.genus.map_or(0, |g| g as usize);
    report.volume = mesh.signed_volume();
    report.seconds = begin.elapsed().as_secs_f64();
    Ok((mesh, report))
}

/// The sparse extraction compared with the dense one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Verified {
    /// Triangles of the dense grid's surface.
    pub dense_triangles: usize,
    /// Triangles of the sparse extraction, before cleaning.
    pub sparse_triangles: usize,
}

/// Evaluates every node of `grid` and counts the triangles of its surface. Needs four bytes a node.
pub(super) fn dense_triangles(
    sdf: &dyn Fn(&[Vec3]) -> Vec<f32>,
    inside_hull: Option<&dyn Fn(Vec3) -> bool>,
    grid: &NodeGrid,
    batch: usize,
    monitor: &dyn Monitor,
) -> Result<usize> {
    let [nx, ny, _] = grid.dims;
    let mut values = vec![grid.spacing; grid.nodes()];
    let mut nodes = (0..values.len())
        .map(|i| (i, grid.point([i % nx, i / nx % ny, i / (nx * ny)])))
        .filter(|&(_, p)| inside_hull.is_none_or(|inside| inside(p)));
    loop {
        monitor.check_stop()?;
        let (places, points): (Vec<usize>, Vec<Vec3>) = nodes.by_ref().take(batch).unzip();
        if points.is_empty() {
            break;
        }
        places.into_iter().zip(sdf(&points)).for_each(|(i, f)| values[i] = f);
    }
    let spacing = Vec3::splat(grid.spacing);
    let volume = Volume { dims: grid.dims, values: &values, origin: grid.point([0; 3]), spacing };
    Ok(marching(&volume, true)?.triangles.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Quiet;
    use crate::geom::Aabb;
    use crate::mesh::{ExtractOptions, extract};
    use glam::Vec3;

    /// A ball of 0.3 at (0.2, 0, 0), and a crumb of 0.03 far from it.
    fn sdf(points: &[Vec3]) -> Vec<f32> {
        let ball = |p: &Vec3| (*p - 0.2 * Vec3::X).length() - 0.3;
        points.iter().map(|p| ball(p).min((*p - Vec3::new(-0.6, -0.6, 0.0)).length() - 0.03)).collect()
    }

    fn gradient(points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        (sdf(points), points.iter().map(|p| (*p - 0.2 * Vec3::X).normalize_or_zero()).collect())
    }

    fn color(points: &[Vec3], _: &[Vec3]) -> Vec<[f32; 3]> {
        vec![[0.5; 3]; points.len()]
    }

    #[test]
    fn the_second_grid_lies_around_what_the_first_found_and_no_piece_is_dropped() {
        let (mesh, report) = extract_dense(sdf, gradient, color, Aabb::SCENE, (65, 1000), &Quiet).unwrap();
        // x from −0.63 to 0.5, grown by 0.113; y and z from −0.63 or −0.3 to 0.3: not cubes but a third of the box
        let [low, high] = report.grid;
        assert!((low[0] + 0.743).abs() < 0.01 && (high[0] - 0.613).abs() < 0.01, "{report:?}");
        assert!((low[2] + 0.36).abs() < 0.01 && (high[2] - 0.36).abs() < 0.01, "{report:?}");
        assert_eq!((report.nodes_evaluated, report.topology.pieces), (2 * 65 * 65 * 65, 2));
        assert!(mesh.is_closed() && mesh.colors.len() == mesh.positions.len());
        let volume = 4.0 / 3.0 * std::f64::consts::PI * (0.3f64.powi(3) + 0.03f64.powi(3));
        assert!((report.volume / volume - 1.0).abs() < 0.01, "{}", report.volume);
    }

    #[test]
    fn a_surface_that_leaves_the_box_is_open_there_and_none_is_an_error() {
        let bounds = Aabb { min: Vec3::splat(-0.25), max: Vec3::splat(0.25) };
        let ball = |points: &[Vec3]| points.iter().map(|p| p.length() - 0.3).collect::<Vec<f32>>();
        let (mesh, report) = extract_dense(ball, gradient, color, bounds, (33, 1 << 16), &Quiet).unwrap();
        assert!(!mesh.is_closed() && report.grid == [[-0.25; 3], [0.25; 3]], "{report:?}");
        let nothing = |points: &[Vec3]| vec![1.0; points.len()];
        let e = extract_dense(nothing, gradient, color, bounds, (9, 10), &Quiet).unwrap_err();
        assert!(e.to_string().starts_with("no surface"), "{e}");
    }

    #[test]
    fn a_ball_has_the_same_triangles_either_way_and_a_lost_piece_shows() {
        let ball = |c: Vec3, r: f32| move |p: &Vec3| (*p - c).length() - r;
        let (big, small) = (ball(Vec3::ZERO, 0.6), ball(Vec3::splat(0.9), 0.009));
        let config = ExtractOptions { resolution: 128, verify: true, ..ExtractOptions::default() };
        let run = |sdf: &(dyn Fn(&Vec3) -> f32 + Sync)| {
            let values = |p: &[Vec3]| p.iter().map(sdf).collect::<Vec<f32>>();
            let gradient = |p: &[Vec3]| (values(p), p.iter().map(|p| p.normalize_or_zero()).collect());
            let color = |p: &[Vec3], _: &[Vec3]| vec![[0.5; 3]; p.len()];
            extract(values, gradient, color, Aabb::SCENE, None, &config, &Quiet).unwrap().1.verified.unwrap()
        };
        let same = run(&big);
        assert!(same.dense_triangles > 1000 && same.dense_triangles == same.sparse_triangles);
        // a speck of one cell between the coarse nodes is the known price of few evaluations
        let both = run(&|p| big(p).min(small(p)));
        assert!(
            both.dense_triangles >= both.sparse_triangles && both.sparse_triangles >= same.sparse_triangles
        );
    }
}

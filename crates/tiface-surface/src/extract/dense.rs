//! Extraction from all nodes of a grid, the two-pass method of the published code.
//!
//! instant-nsr-pl's `isosurface` runs marching cubes over `resolution`³ nodes of the box, then once
//! more over as many nodes of the surface's own box, grown by a tenth of its size on every side.
//! Nothing is closed, cleaned, moved or left out: a surface that leaves the box is open at its
//! border.

use super::marching::{Volume, marching};
use super::node_grid::check_resolution;
use super::{BATCH, MeshReport, NodeGrid, colors_along_normals, no_surface, off_surface};
use crate::{check_len, evaluate};
use glam::Vec3;
use std::time::Instant;
use tiface_base::error::Cause;
use tiface_base::geom::{Aabb, Mesh, SdfField};
use tiface_base::{Monitor, Result};

/// Margin around the surface's box on each side, as a share of its size.
const MARGIN: f32 = 0.1;

/// Meshes the zero level set of a field on all nodes of a grid of `resolution`³ nodes, first over
/// `bounds` and then over the box of the surface found. Needs four bytes a node.
///
/// # Errors
///
/// Fails for a resolution outside 2..=2048, a field without a surface, values of the wrong length,
/// or a request to stop.
pub fn extract_dense(
    field: &dyn SdfField,
    bounds: Aabb,
    resolution: usize,
    monitor: &dyn Monitor,
) -> Result<(Mesh, MeshReport)> {
    let begin = Instant::now();
    check_resolution(resolution, 2048)?;
    NodeGrid::fit(bounds, resolution)?; // refuses an invalid box
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
            for points in points.chunks(BATCH) {
                let found = field.sdf(points);
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
        if found.mesh.triangles.is_empty() {
            let (nodes, size) = (values.len(), inside.size());
            let how = format!("the field does not change its sign at {nodes} nodes of {size:.3}");
            return Err(no_surface(Cause::AllOutside, how));
        }
        report.cells = [resolution - 1; 3];
        report.cell_size = spacing.max_element();
        report.grid = [inside.min.to_array(), inside.max.to_array()];
        report.nodes_evaluated += values.len();
        report.share_evaluated = 1.0;
        report.non_finite = found.non_finite;
        mesh = found.mesh;
        let surface = mesh.bounds();
        let margin = MARGIN * surface.size();
        inside =
            Aabb { min: (surface.min - margin).max(bounds.min), max: (surface.max + margin).min(bounds.max) };
    }
    mesh.normals = mesh.angle_weighted_normals();
    let (values, gradients) = evaluate(field, &mesh.positions, BATCH, monitor)?;
    for (normal, g) in mesh.normals.iter_mut().zip(&gradients) {
        *normal = g.try_normalize().unwrap_or(*normal);
    }
    mesh.colors = colors_along_normals(&mesh, field)?;
    let nowhere = vec![false; mesh.positions.len()];
    report.off_surface_before = off_surface(&values, &gradients, &nowhere, report.cell_size);
    report.off_surface_after = report.off_surface_before;
    report.measure(&mesh, begin);
    report.clean.pieces = report.topology.pieces;
    Ok((mesh, report))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::Quiet;

    /// Returns a ball of 0.3 at (0.2, 0, 0), and a crumb of 0.03 far from it.
    fn sdf(p: Vec3) -> f32 {
        let ball = (p - 0.2 * Vec3::X).length() - 0.3;
        ball.min((p - Vec3::new(-0.6, -0.6, 0.0)).length() - 0.03)
    }

    #[test]
    fn the_second_grid_lies_around_what_the_first_found_and_no_piece_is_dropped() {
        let (mesh, report) = extract_dense(&sdf, Aabb::SCENE, 65, &Quiet).unwrap();
        // x from −0.63 to 0.5, grown by 0.113; y and z from −0.63 or −0.3 to 0.3: not cubes but a
        // third of the box
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
        let (mesh, report) = extract_dense(&|p: Vec3| p.length() - 0.3, bounds, 33, &Quiet).unwrap();
        assert!(!mesh.is_closed() && report.grid == [[-0.25; 3], [0.25; 3]], "{report:?}");
        let e = extract_dense(&|_: Vec3| 1.0, bounds, 9, &Quiet).unwrap_err();
        assert!(e.to_string().starts_with("no surface"), "{e}");
    }
}

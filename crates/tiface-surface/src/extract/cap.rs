//! The cap that closes a surface where the box ends: neck and shoulders that the frames cut.
//!
//! The learned color within the body is no color of anything, so the cap is painted from the skin
//! around it: inverse-distance weights (Shepard 1968) of the ring where it begins, which meets the
//! skin without an edge.

use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::{Aabb, Mesh};

/// Skin vertices kept of a ring: enough for one every few millimeters.
const RING: usize = 512;

/// The cap of a surface: its box and the colors of its rim.
#[derive(Clone, Debug, PartialEq)]
pub struct Cap {
    /// The box of the extraction.
    pub bounds: Aabb,
    /// Maximum distance of the cap's vertices from the box's face.
    pub near: f32,
    /// Skin around the cap.
    pub ring: Vec<RimVertex>,
}

/// A point of the skin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RimVertex {
    /// Its position.
    pub position: Vec3,
    /// Unit normal, pointing out; zero where none is known.
    pub normal: Vec3,
    /// sRGB-coded.
    pub color: [f32; 3],
}

impl Cap {
    /// Returns a cap without a ring, for queries of where it lies.
    pub(super) fn bare(bounds: Aabb, cell: f32) -> Cap {
        Cap { bounds, near: cell / 256.0, ring: Vec::new() }
    }

    /// Returns the cap of a mesh extracted within `bounds` with cells of `cell`, if it has one.
    pub fn find(mesh: &Mesh, bounds: Aabb, cell: f32) -> Option<Cap> {
        let cap = Cap::bare(bounds, cell);
        let capped: Vec<bool> = mesh.positions.iter().map(|&p| cap.holds(p)).collect();
        let mut on_ring = vec![false; mesh.positions.len()];
        let mut any = false;
        for t in &mesh.triangles {
            let of_cap = t.map(|i| capped[i as usize]);
            if of_cap.contains(&true) && of_cap.contains(&false) {
                t.iter().filter(|&&i| !capped[i as usize]).for_each(|&i| on_ring[i as usize] = true);
            }
            any |= of_cap == [true; 3];
        }
        if !any {
            return None;
        }
        let all: Vec<usize> = (0..on_ring.len()).filter(|&i| on_ring[i]).collect();
        let step = all.len().div_ceil(RING).max(1);
        let skin = |i: usize| RimVertex {
            position: mesh.positions[i],
            normal: mesh.normals.get(i).copied().unwrap_or(Vec3::ZERO),
            color: mesh.colors.get(i).copied().unwrap_or([0.5; 3]),
        };
        let ring = all.into_iter().step_by(step).map(skin).collect();
        Some(Cap { ring, ..cap })
    }

    /// Returns whether a point lies on the box's faces.
    pub fn holds(&self, p: Vec3) -> bool {
        (p - self.bounds.min).min_element() < self.near || (self.bounds.max - p).min_element() < self.near
    }

    /// Returns the color of a point of the cap.
    pub fn color(&self, p: Vec3) -> [f32; 3] {
        let (mut sum, mut total) = ([0f64; 3], 0f64);
        for RimVertex { position, color, .. } in &self.ring {
            // the fourth power keeps the middle from being gray of everything
            let w = 1.0 / f64::from(position.distance_squared(p)).max(1e-18).powi(2);
            total += w;
            (0..3).for_each(|k| sum[k] += w * f64::from(color[k]));
        }
        if total > 0.0 { sum.map(|s| (s / total) as f32) } else { [0.5; 3] }
    }

    /// Paints the mesh's cap.
    pub fn paint(&self, mesh: &mut Mesh) {
        self.recolor(&mesh.positions, &mut mesh.colors);
    }

    /// Gives the ring other colors, made from its points and their normals.
    pub fn shade(&mut self, colors: impl FnOnce(&[Vec3], &[Vec3]) -> Vec<[f32; 3]>) {
        let (points, normals): (Vec<Vec3>, Vec<Vec3>) =
            self.ring.iter().map(|s| (s.position, s.normal)).unzip();
        let colors = colors(&points, &normals);
        self.ring.iter_mut().zip(colors).for_each(|(skin, color)| skin.color = color);
    }

    /// Gives the points that lie on the cap its color instead.
    pub fn recolor(&self, points: &[Vec3], colors: &mut [[f32; 3]]) {
        let on_cap = points.par_iter().zip(colors).filter(|(p, _)| self.holds(**p));
        on_cap.for_each(|(p, color)| *color = self.color(*p));
    }

    /// Moves vertices beyond the box onto its faces: simplification pushes the edge of a cut out,
    /// to make up for the chords of its triangles, and a cut is flat.
    pub fn flatten(&self, mesh: &mut Mesh) {
        mesh.positions.iter_mut().for_each(|p| *p = p.clamp(self.bounds.min, self.bounds.max));
    }

    /// Removes the cap, for callers that fit something to the opening. Returns the triangles
    /// removed.
    pub fn open(&self, mesh: &mut Mesh) -> usize {
        let before = mesh.triangles.len();
        let capped: Vec<bool> = mesh.positions.iter().map(|&p| self.holds(p)).collect();
        mesh.triangles.retain(|t| !t.iter().all(|&i| capped[i as usize]));
        let removed = before - mesh.triangles.len();
        mesh.drop_unused_vertices();
        removed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::Painted;
    use crate::{ExtractOptions, extract};
    use tiface_base::Quiet;

    /// Returns a column through the floor of the scene's box, red to the left and green to the
    /// right.
    fn column() -> (Mesh, Cap) {
        let f = |p: Vec3| (p.x.hypot(p.z) - 0.3).max(p.y - 0.5);
        let paint = |p: &[Vec3], _: &[Vec3], _: &[u32], _: &[Vec3]| {
            p.iter().map(|p| if p.x < 0.0 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] }).collect()
        };
        let options = ExtractOptions { resolution: 48, ..ExtractOptions::default() };
        let (mut mesh, report) =
            extract(&Painted { shape: f, paint }, Aabb::SCENE, &options, &Quiet).unwrap();
        let cap = Cap::find(&mesh, report.bounds(), report.cell_size).unwrap();
        cap.paint(&mut mesh);
        (mesh, cap)
    }

    #[test]
    fn the_cap_takes_the_colors_of_the_skin_around_it() {
        let (mesh, cap) = column();
        let on: Vec<usize> = (0..mesh.positions.len()).filter(|&i| cap.holds(mesh.positions[i])).collect();
        assert!(on.len() > 100);
        for i in on {
            let (p, c) = (mesh.positions[i], mesh.colors[i]);
            assert!((c[0] + c[1] - 1.0).abs() < 1e-4 && c[2] == 0.0);
            if p.x.abs() > 0.15 {
                assert!(c[usize::from(p.x > 0.0)] > 0.8, "{p} {c:?}");
            }
        }
    }

    #[test]
    fn a_ring_of_another_color_colors_the_cap_and_nothing_else() {
        let (_, mut cap) = column();
        cap.shade(|points, normals| {
            assert!(normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-3 && n.y.abs() < 0.1));
            vec![[0.0, 0.0, 1.0]; points.len()]
        });
        let points = [Vec3::new(0.1, -1.0, 0.0), Vec3::new(0.3, -0.9, 0.0)];
        let mut colors = [[0.5; 3]; 2];
        cap.recolor(&points, &mut colors);
        assert!((colors[0][2] - 1.0).abs() < 1e-6 && colors[0][0] == 0.0, "{colors:?}");
        assert_eq!(colors[1], [0.5; 3]);
    }

    #[test]
    fn without_it_there_is_one_opening() {
        let (mut mesh, cap) = column();
        assert!(mesh.is_closed());
        let removed = cap.open(&mut mesh);
        assert!(removed > 100 && !mesh.is_closed());
        let topology = tiface_base::geom::topology(&mesh.positions, &mesh.triangles);
        // a disc: V − E + F = 1
        assert_eq!((topology.pieces, topology.euler), (1, 1));
    }

    #[test]
    fn a_simplified_column_ends_flat() {
        let (mut mesh, cap) = column();
        let config = crate::SimplifyConfig { triangles: 800, ..Default::default() };
        let f = |p: Vec3| (p.x.hypot(p.z) - 0.3).max(p.y - 0.5).max(-1.0 - p.y);
        let field = |p: Vec3| f(p);
        crate::simplify(&mut mesh, Some(&field), &config, &Quiet).unwrap();
        let sides = mesh.positions.iter().filter(|p| p.y > -0.9).copied().collect::<Vec<_>>();
        cap.flatten(&mut mesh);
        assert!(mesh.is_closed() && mesh.positions.iter().all(|p| p.y >= -1.0));
        // what is not at the cut stays
        assert!(sides.iter().all(|p| mesh.positions.contains(p)));
    }

    #[test]
    fn a_whole_surface_has_no_cap() {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        let bounds = Aabb { min: Vec3::splat(-2.0), max: Vec3::splat(2.0) };
        assert!(Cap::find(&mesh, bounds, 0.1).is_none());
    }
}

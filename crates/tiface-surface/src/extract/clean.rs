//! Cleaning of an extracted surface.
//!
//! Loose pieces and inner shells do not belong to the head. They are removed as a whole, by their
//! signed volume, so a closed mesh stays closed.

use serde::{Deserialize, Serialize};
use tiface_base::geom::{Mesh, Sets};
use tiface_base::{Error, Result};

/// The result of [`clean`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CleanReport {
    /// Pieces found.
    pub pieces: usize,
    /// Pieces dropped for being smaller than the largest.
    pub dust: usize,
    /// Pieces dropped because they bound a hollow.
    pub inner_shells: usize,
    /// Triangles dropped with pieces.
    pub dropped_triangles: usize,
    /// Volume of dropped pieces, each taken positive, in units of the positions cubed.
    pub dropped_volume: f64,
    /// Whether the mesh was inside out and has been turned.
    pub turned: bool,
}

/// Keeps the piece of largest volume of a closed mesh, wound outward: a head is one solid. Normals
/// and colors, if any, follow their vertices.
///
/// # Errors
///
/// No piece has a volume.
pub fn clean(mesh: &mut Mesh) -> Result<CleanReport> {
    // Pieces in order of their lowest vertex: volume and number of triangles.
    let mut sets = Sets::of_pieces(mesh.positions.len(), &mesh.triangles);
    let mut number = vec![u32::MAX; mesh.positions.len()];
    let mut pieces: Vec<(f64, usize)> = Vec::new();
    let center = mesh.bounds().center().as_dvec3();
    let mut piece_of = Vec::with_capacity(mesh.triangles.len());
    for t in &mesh.triangles {
        let root = sets.find(t[0]) as usize;
        if number[root] == u32::MAX {
            number[root] = pieces.len() as u32;
            pieces.push((0.0, 0));
        }
        piece_of.push(number[root] as usize);
        let [a, b, c] = t.map(|i| mesh.positions[i as usize].as_dvec3() - center);
        let (volume, triangles) = &mut pieces[number[root] as usize];
        *volume += a.dot(b.cross(c)) / 6.0;
        *triangles += 1;
    }
    let largest = (0..pieces.len()).max_by(|&a, &b| pieces[a].0.abs().total_cmp(&pieces[b].0.abs()));
    let Some(largest) = largest.filter(|&i| pieces[i].0.abs() > 0.0) else {
        let count = pieces.len();
        let message =
            format!("cleaning removed every one of the {count} pieces: none encloses a positive volume");
        return Err(Error::cannot(message, "the field may be inverted: negative must be inside"));
    };
    // A hollow is smaller than the piece around it, so the largest volume decides which way is out.
    let turned = pieces[largest].0 < 0.0;
    if turned {
        mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        mesh.normals.iter_mut().for_each(|n| *n = -*n);
    }
    let mut report = CleanReport { pieces: pieces.len(), turned, ..CleanReport::default() };
    pieces.remove(largest);
    for (volume, triangles) in pieces {
        let inside_out = if turned { volume >= 0.0 } else { volume <= 0.0 };
        report.inner_shells += usize::from(inside_out);
        report.dust += usize::from(!inside_out);
        report.dropped_triangles += triangles;
        report.dropped_volume += volume.abs();
    }
    let mut of = piece_of.iter();
    mesh.triangles.retain(|_| of.next().is_some_and(|&p| p == largest));
    mesh.drop_unused_vertices();
    Ok(report)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use tiface_base::geom::topology;

    /// A cube of edge 2 r: volume 8 r³, wound outward, or inward for a shell.
    fn cube(mesh: &mut Mesh, center: Vec3, r: f32, outward: bool) {
        let n = mesh.positions.len() as u32;
        for c in 0..8u8 {
            let side = |axis: u8| if c >> axis & 1 == 1 { r } else { -r };
            mesh.positions.push(center + Vec3::new(side(0), side(1), side(2)));
        }
        for q in [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]] {
            for t in [[q[0], q[1], q[2]], [q[0], q[2], q[3]]] {
                let t: [u32; 3] = t.map(|i: u32| n + i);
                mesh.triangles.push(if outward { t } else { [t[0], t[2], t[1]] });
            }
        }
    }

    #[test]
    fn dust_and_the_inner_shell_of_a_hollow_head_go() {
        let mut m = Mesh::default();
        cube(&mut m, Vec3::splat(5.0), 0.1, true);
        cube(&mut m, Vec3::ZERO, 1.0, true);
        cube(&mut m, Vec3::ZERO, 0.5, false);
        let r = clean(&mut m).unwrap();
        assert_eq!((r.pieces, r.dust, r.inner_shells, r.dropped_triangles), (3, 1, 1, 24));
        // 8 · 0.1³ + 8 · 0.5³
        assert!((r.dropped_volume - 1.008).abs() < 1e-6);
        assert!((m.signed_volume() - 8.0).abs() < 1e-6);
        assert_eq!(m.positions.len(), 8);
    }

    #[test]
    fn twenty_specks_of_one_to_four_cells_and_a_ball_within_a_hollow_go() {
        // cells of 1, the head around the middle node; each speck is about a node, so none slips
        // through
        let n = 49;
        let specks: Vec<(Vec3, f32)> = (0..20)
            .map(|i| {
                let (y, turn) = (1.0 - (2 * i + 1) as f32 / 20.0, 2.4 * i as f32);
                let across = (1.0 - y * y).sqrt();
                let p = 19.0 * Vec3::new(across * turn.cos(), y, across * turn.sin());
                (p.round(), 0.5 + 1.5 * i as f32 / 19.0)
            })
            .collect();
        let f = |p: Vec3| {
            let head = (p.length() - 12.0).max(8.0 - p.length()).min(p.length() - 5.0);
            specks.iter().map(|(c, r)| p.distance(*c) - r).fold(head, f32::min)
        };
        let node = |i: usize| Vec3::new((i % n) as f32, (i / n % n) as f32, (i / n / n) as f32) - 24.0;
        let values: Vec<f32> = (0..n * n * n).map(|i| f(node(i))).collect();
        let volume = crate::Volume { dims: [n; 3], values: &values, origin: Vec3::ZERO, spacing: Vec3::ONE };
        let mut m = crate::marching(&volume, true).unwrap().mesh;
        let r = clean(&mut m).unwrap();
        // the specks, the head, its hollow and the piece inside that
        assert_eq!((r.pieces, r.dust + r.inner_shells), (23, 22));
        let t = topology(&m.positions, &m.triangles);
        assert_eq!((t.pieces, t.euler), (1, 2));
        // 4/3 π 12³ = 7238, filled; inscribed, so a little less
        assert!((7150.0..7238.0).contains(&m.signed_volume()), "{}", m.signed_volume());
    }

    #[test]
    fn a_mesh_inside_out_is_turned() {
        let mut m = Mesh::default();
        cube(&mut m, Vec3::ZERO, 1.0, false);
        assert!(clean(&mut m).unwrap().turned);
        assert!((m.signed_volume() - 8.0).abs() < 1e-6);
    }

    #[test]
    fn no_volume_is_an_error() {
        assert!(clean(&mut Mesh::default()).is_err());
        let mut flat = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        let error = clean(&mut flat).unwrap_err().to_string();
        assert!(error.contains("every one of the 1 pieces"), "{error}");
    }
}

//! Removal of everything that does not belong to the head: loose pieces, inner shells, doubled faces, touching
//! vertices.
//!
//! Order: faces without three vertices and doubled faces; vertices whose triangles form several fans
//! become several; small holes are closed; then whole pieces by their signed volume. Nothing here opens a closed
//! mesh of sound pieces: only whole pieces, or faces that cancel, are removed.

use super::holes::fill_holes;
use crate::geom::{Mesh, Sets, fans, sorted_sides};
use crate::{Error, Result};
use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

/// The result of [`clean`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CleanReport {
    /// Pieces found.
    pub pieces: usize,
    /// Pieces kept.
    pub kept: usize,
    /// Pieces dropped for being small.
    pub dust: usize,
    /// Pieces dropped because they bound a hollow or lie in one.
    pub inner_shells: usize,
    /// Triangles dropped with pieces.
    pub dropped_triangles: usize,
    /// Volume of dropped pieces, each taken positive, in units of the positions cubed.
    pub dropped_volume: f64,
    /// Faces dropped for a repeated vertex.
    pub degenerate: usize,
    /// Faces dropped because another covers the same three vertices.
    pub duplicate: usize,
    /// Vertices added where fans only touched.
    pub split_vertices: usize,
    /// Small holes that were closed.
    #[serde(default)]
    pub filled_holes: usize,
    /// Triangles that closed them.
    #[serde(default)]
    pub filled_triangles: usize,
    /// The mesh was inside out and has been turned.
    pub turned: bool,
}

/// Cleans a mesh in place; normals and colors, if any, follow their vertices.
///
/// Keeps the piece of largest volume and, besides it, pieces of at least `keep_share` of its volume
/// (1 keeps only the largest) unless they lie within a kept one. Inner shells, of negative volume, always
/// go: a head is solid.
///
/// # Errors
///
/// No piece has a volume.
pub fn clean(mesh: &mut Mesh, keep_share: f64) -> Result<CleanReport> {
    let mut report = CleanReport::default();
    drop_faces(mesh, &mut report);
    split_fans(mesh, &mut report);
    (report.filled_holes, report.filled_triangles) = fill_holes(mesh);

    // Pieces in order of their lowest vertex.
    let mut sets = Sets::of_pieces(mesh.positions.len(), &mesh.triangles);
    let mut number = vec![u32::MAX; mesh.positions.len()];
    let mut pieces: Vec<Piece> = Vec::new();
    let center = mesh.bounds().center().as_dvec3();
    let mut piece_of = Vec::with_capacity(mesh.triangles.len());
    for t in &mesh.triangles {
        let root = sets.find(t[0]) as usize;
        if number[root] == u32::MAX {
            number[root] = pieces.len() as u32;
            pieces.push(Piece { volume: 0.0, triangles: 0, vertex: t[0] });
        }
        piece_of.push(number[root]);
        let [a, b, c] = t.map(|i| mesh.positions[i as usize].as_dvec3() - center);
        let piece = &mut pieces[number[root] as usize];
        piece.volume += a.dot(b.cross(c)) / 6.0;
        piece.triangles += 1;
    }
    report.pieces = pieces.len();

    let largest =
        (0..pieces.len()).max_by(|&a, &b| pieces[a].volume.abs().total_cmp(&pieces[b].volume.abs()));
    let Some(largest) = largest.filter(|&i| pieces[i].volume.abs() > 0.0) else {
        let count = pieces.len();
        let message =
            format!("cleaning removed every one of the {count} pieces: none encloses a positive volume");
        return Err(Error::cannot(message, "the field may be inverted: negative must be inside"));
    };
    if pieces[largest].volume < 0.0 {
        // A hollow is smaller than the piece around it, so the largest volume tells which way is out.
        report.turned = true;
        mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        mesh.normals.iter_mut().for_each(|n| *n = -*n);
        pieces.iter_mut().for_each(|p| p.volume = -p.volume);
    }
    let size = pieces[largest].volume;

    let mut keep = vec![false; pieces.len()];
    let mut by_size: Vec<usize> = (0..pieces.len()).collect();
    by_size.sort_by(|&a, &b| pieces[b].volume.total_cmp(&pieces[a].volume));
    for i in by_size {
        let p = &pieces[i];
        let large = i == largest || (keep_share < 1.0 && p.volume >= keep_share * size);
        if p.volume > 0.0 && large {
            let point = mesh.positions[p.vertex as usize];
            keep[i] = i == largest || !is_within(point, mesh, &piece_of, &keep);
        }
        if keep[i] {
            report.kept += 1;
            continue;
        }
        if p.volume <= 0.0 || large {
            report.inner_shells += 1
        } else {
            report.dust += 1
        }
        report.dropped_triangles += p.triangles;
        report.dropped_volume += p.volume.abs();
    }
    let mut of = piece_of.iter();
    mesh.triangles.retain(|_| of.next().is_some_and(|&p| keep[p as usize]));
    mesh.drop_unused_vertices();
    Ok(report)
}

struct Piece {
    volume: f64,
    triangles: usize,
    vertex: u32,
}

/// Removes faces with a repeated vertex, and of faces over the same three vertices: pairs that face
/// each other go both, copies go but one.
fn drop_faces(mesh: &mut Mesh, report: &mut CleanReport) {
    let before = mesh.triangles.len();
    mesh.triangles.retain(|t| t[0] != t[1] && t[1] != t[2] && t[2] != t[0]);
    report.degenerate = before - mesh.triangles.len();

    // Sorted vertices, is the order an even permutation of them, which face.
    let mut keys: Vec<([u32; 3], bool, usize)> = mesh
        .triangles
        .iter()
        .enumerate()
        .map(|(i, t)| {
            let mut key = *t;
            key.sort_unstable();
            let first = t.iter().position(|&v| v == key[0]).unwrap_or(0);
            (key, t[(first + 1) % 3] == key[1], i)
        })
        .collect();
    keys.sort_unstable();
    let mut keep = vec![true; mesh.triangles.len()];
    for run in keys.chunk_by(|a, b| a.0 == b.0).filter(|run| run.len() > 1) {
        let even = run.iter().filter(|k| k.1).count();
        let odd = run.len() - even;
        let survivor = (even != odd).then(|| run.iter().find(|k| k.1 == (even > odd))).flatten();
        for k in run {
            keep[k.2] = survivor.is_some_and(|s| s.2 == k.2);
        }
    }
    let mut kept = keep.iter();
    let before = mesh.triangles.len();
    mesh.triangles.retain(|_| *kept.next().unwrap_or(&true));
    report.duplicate = before - mesh.triangles.len();
}

/// Gives every fan its own vertex.
fn split_fans(mesh: &mut Mesh, report: &mut CleanReport) {
    let sides = sorted_sides(&mesh.triangles);
    let mut fans = fans(&mesh.triangles, &sides);
    let n = mesh.positions.len();
    // The first fan met keeps the vertex.
    let mut first = vec![u32::MAX; n];
    let mut copies: Vec<(u32, u32)> = Vec::new();
    for corner in 0..3 * mesh.triangles.len() as u32 {
        let v = mesh.triangles[corner as usize / 3][corner as usize % 3];
        let fan = fans.find(corner);
        if first[v as usize] == u32::MAX {
            first[v as usize] = fan;
        }
        if first[v as usize] == fan {
            continue;
        }
        // `fan` is its lowest corner, met before any other of the same fan.
        let copy = if fan == corner {
            copies.push((fan, v));
            n + copies.len() - 1
        } else {
            n + copies.binary_search_by_key(&fan, |c| c.0).unwrap_or_else(|i| i)
        };
        mesh.triangles[corner as usize / 3][corner as usize % 3] = copy as u32;
    }
    report.split_vertices = copies.len();
    for (_, v) in copies {
        let v = v as usize;
        mesh.positions.push(mesh.positions[v]);
        if let Some(&normal) = mesh.normals.get(v) {
            mesh.normals.push(normal);
        }
        if let Some(&color) = mesh.colors.get(v) {
            mesh.colors.push(color);
        }
    }
}

/// Whether the point lies within the kept pieces, by its winding number: the sum of solid angles over 4π.
fn is_within(point: Vec3, mesh: &Mesh, piece_of: &[u32], keep: &[bool]) -> bool {
    let p = point.as_dvec3();
    let angle: f64 = mesh
        .triangles
        .iter()
        .zip(piece_of)
        .filter(|(_, piece)| keep[**piece as usize])
        .map(|(t, _)| {
            // Van Oosterom, Strackee 1983.
            let [a, b, c]: [DVec3; 3] = t.map(|i| mesh.positions[i as usize].as_dvec3() - p);
            let (la, lb, lc) = (a.length(), b.length(), c.length());
            let below = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
            2.0 * a.dot(b.cross(c)).atan2(below)
        })
        .sum();
    angle.abs() > std::f64::consts::TAU
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geom::topology;

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
        let r = clean(&mut m, 1.0).unwrap();
        assert_eq!((r.pieces, r.kept, r.dust, r.inner_shells, r.dropped_triangles), (3, 1, 1, 1, 24));
        // 8 · 0.1³ + 8 · 0.5³
        assert!((r.dropped_volume - 1.008).abs() < 1e-6);
        assert!((m.signed_volume() - 8.0).abs() < 1e-6);
        assert_eq!(m.positions.len(), 8);
    }

    #[test]
    fn twenty_specks_of_one_to_four_cells_and_a_ball_within_a_hollow_go() {
        // cells of 1, the head around the middle node; each speck is about a node, so none slips through
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
        let volume =
            crate::mesh::Volume { dims: [n; 3], values: &values, origin: Vec3::ZERO, spacing: Vec3::ONE };
        let found = crate::mesh::marching(&volume, true).unwrap();
        let mut m = Mesh { positions: found.positions, triangles: found.triangles, ..Mesh::default() };
        let r = clean(&mut m, 1.0).unwrap();
        // the specks, the head, its hollow and the piece inside that
        assert_eq!((r.pieces, r.kept, r.dust + r.inner_shells), (23, 1, 22));
        let t = topology(&m.positions, &m.triangles);
        assert_eq!((t.pieces, t.euler), (1, 2));
        // 4/3 π 12³ = 7238, filled; inscribed, so a little less
        assert!((7150.0..7238.0).contains(&m.signed_volume()), "{}", m.signed_volume());
    }

    #[test]
    fn a_share_keeps_large_pieces_beside_the_head_but_not_one_nested_in_it() {
        let mut m = Mesh::default();
        cube(&mut m, Vec3::ZERO, 1.0, true);
        cube(&mut m, Vec3::ZERO, 0.8, false);
        cube(&mut m, Vec3::ZERO, 0.6, true);
        cube(&mut m, Vec3::splat(3.0), 0.6, true);
        let r = clean(&mut m, 0.1).unwrap();
        assert_eq!((r.kept, r.inner_shells, r.dust), (2, 2, 0));
    }

    #[test]
    fn a_mesh_inside_out_is_turned() {
        let mut m = Mesh::default();
        cube(&mut m, Vec3::ZERO, 1.0, false);
        assert!(clean(&mut m, 1.0).unwrap().turned);
        assert!((m.signed_volume() - 8.0).abs() < 1e-6);
    }

    #[test]
    fn cubes_that_share_an_edge_or_a_vertex_come_apart() {
        for offset in [Vec3::new(2.0, 2.0, 0.0), Vec3::splat(2.0)] {
            let mut m = Mesh::default();
            cube(&mut m, Vec3::ZERO, 1.0, true);
            cube(&mut m, offset, 1.0, true);
            // weld equal corners
            for i in 8..16u32 {
                let at = m.positions[..8].iter().position(|p| *p == m.positions[i as usize]);
                if let Some(j) = at {
                    m.triangles.iter_mut().flatten().filter(|v| **v == i).for_each(|v| *v = j as u32);
                }
            }
            assert!(!topology(&m.positions, &m.triangles).manifold);
            let r = clean(&mut m, 0.0).unwrap();
            assert_eq!((r.kept, r.split_vertices > 0), (2, true));
            let t = topology(&m.positions, &m.triangles);
            assert!(t.is_solid(), "{t:?}");
            assert_eq!(t.pieces, 2);
        }
    }

    #[test]
    fn doubled_and_collapsed_faces_go_and_a_fin_cancels() {
        let mut m = Mesh::default();
        cube(&mut m, Vec3::ZERO, 1.0, true);
        let copy = m.triangles[3];
        m.triangles.extend([copy, [0, 0, 1], [0, 3, 7], [7, 3, 0]]);
        let r = clean(&mut m, 1.0).unwrap();
        assert_eq!((r.degenerate, r.duplicate), (1, 3));
        assert!(topology(&m.positions, &m.triangles).is_solid());
    }

    #[test]
    fn no_volume_is_an_error() {
        assert!(clean(&mut Mesh::default(), 1.0).is_err());
        let mut flat = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        let error = clean(&mut flat, 1.0).unwrap_err().to_string();
        assert!(error.contains("every one of the 1 pieces"), "{error}");
    }
}

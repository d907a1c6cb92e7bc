//! Smoothing of an extracted surface: the noise of a learned field goes, edges stay.
//!
//! On a hash grid the features of levels finer than a cell differ at random from vertex to vertex,
//! and so do the zero set and its gradient. First the normals of triangles become means of those
//! around them, by area, number of common corners and likeness (the bilateral filter of Zheng, Fu,
//! Au, Tai 2011):
//!
//! ```text
//! n_i ← Σ_j w_ij n_j / |Σ_j w_ij n_j|,   w_ij = c_ij A_j exp(−|n_i − n_j|² / 2σ²)
//! ```
//!
//! so that a lid, the seam of the lips or a nostril, which turn by more than σ between triangles,
//! keep their normals, while noise is averaged. Then vertices follow, each along the normals of the
//! triangles around it, whose middles are `m_t` (Sun, Rosin, Martin, Langbein 2007):
//!
//! ```text
//! p ← p + Σ_t n_t n_t · (m_t − p) / number of triangles
//! ```
//!
//! That moves nothing within a plane, and hardly changes the volume. Volume-preserving Laplacian
//! smoothing (Vollmer, Mencl, Müller 1999) moves vertices four times as far for normals that are no
//! better, and rounds edges.

use crate::moves::{EXTRACTED, move_to};
use crate::simplify::without_crossings;
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tiface_base::geom::{Mesh, area_vector};

/// Rounds of averaging normals. With `SIGMA` and `MOVES` by the angle to the true normals of skin
/// and the distance to the true skin, of three heads.
const ROUNDS: usize = 4;
/// Normals `σ` apart count for 0.6 of equal ones: 10 degrees. The field's noise turns adjacent
/// triangles by 2 degrees (median).
const SIGMA: f32 = 0.174_533;
/// Rounds of moving vertices after their triangles' normals.
const MOVES: usize = 10;

/// The result of [`smooth`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SmoothReport {
    /// Mean distance by which vertices moved, in units of the positions.
    pub mean_move: f64,
    /// Largest distance.
    pub largest_move: f32,
    /// Vertices that moved less than their normals asked, because a triangle would have been
    /// spoiled or would have crossed another.
    pub held_back: usize,
}

/// Smooths a mesh in place. Vertices that are `fixed`, on a border, or where the mesh is no
/// manifold, stay. Normals become angle-weighted; colors stay with their vertices. No triangle
/// turns by 80 degrees or more, becomes a sliver, or crosses another that it did not cross before.
///
/// The same bytes for any number of threads.
pub fn smooth(mesh: &mut Mesh, fixed: &[bool]) -> SmoothReport {
    let fans = Fans::new(mesh.positions.len(), &mesh.triangles);
    let stays: Vec<bool> = (0..mesh.positions.len())
        .into_par_iter()
        .map(|v| fixed.get(v).copied().unwrap_or(false) || !fans.is_closed(v as u32, &mesh.triangles))
        .collect();
    let normals = filtered_normals(mesh, &fans);
    let targets = followed(mesh, &fans, &normals, &stays);
    let start = mesh.positions.clone();
    let held_back = move_to(&mut mesh.positions, &mesh.triangles, &targets, &EXTRACTED)
        + without_crossings(&mut mesh.positions, &mesh.triangles, &start);
    mesh.normals = mesh.angle_weighted_normals();
    let moves = || mesh.positions.iter().zip(&start).map(|(p, from)| p.distance(*from));
    let sum: f64 = moves().map(f64::from).sum();
    SmoothReport {
        mean_move: sum / start.len().max(1) as f64,
        largest_move: moves().fold(0.0, f32::max),
        held_back,
    }
}

/// The triangles around each vertex, in the order of the mesh.
struct Fans {
    /// Where the triangles of each vertex begin, and the end of the last.
    first: Vec<u32>,
    triangles: Vec<u32>,
}

impl Fans {
    fn new(vertices: usize, triangles: &[[u32; 3]]) -> Fans {
        let mut first = vec![0u32; vertices + 1];
        triangles.iter().flatten().for_each(|&v| first[v as usize + 1] += 1);
        (0..vertices).for_each(|v| first[v + 1] += first[v]);
        let mut next = first.clone();
        let mut of = vec![0u32; 3 * triangles.len()];
        for (t, corners) in triangles.iter().enumerate() {
            for &v in corners {
                of[next[v as usize] as usize] = t as u32;
                next[v as usize] += 1;
            }
        }
        Fans { first, triangles: of }
    }

    fn around(&self, v: u32) -> &[u32] {
        &self.triangles[self.first[v as usize] as usize..self.first[v as usize + 1] as usize]
    }

    /// Returns whether the triangles around a vertex are one closed fan.
    fn is_closed(&self, v: u32, triangles: &[[u32; 3]]) -> bool {
        // each triangle leads from a neighbor to the next one
        let lead = |t: u32| {
            let corners = triangles[t as usize];
            let k = corners.iter().position(|&c| c == v).unwrap_or(0);
            (corners[(k + 1) % 3], corners[(k + 2) % 3])
        };
        let fan = self.around(v);
        let Some(&begin) = fan.first() else { return false };
        let (start, mut at) = lead(begin);
        for steps in 1..=fan.len() {
            if at == start {
                return steps == fan.len();
            }
            let mut onwards = fan.iter().map(|&t| lead(t)).filter(|&(from, _)| from == at);
            match (onwards.next(), onwards.next()) {
                (Some((_, to)), None) => at = to,
                _ => return false,
            }
        }
        false
    }
}

/// Returns the filtered unit normals of the triangles; zero for those without area.
fn filtered_normals(mesh: &Mesh, fans: &Fans) -> Vec<Vec3> {
    let area_vectors: Vec<Vec3> =
        mesh.triangles.par_iter().map(|t| area_vector(t.map(|v| mesh.positions[v as usize]))).collect();
    let areas: Vec<f32> = area_vectors.iter().map(|a| a.length()).collect();
    let mut normals: Vec<Vec3> = area_vectors.iter().map(|a| a.normalize_or_zero()).collect();
    for _ in 0..ROUNDS {
        normals = mesh
            .triangles
            .par_iter()
            .enumerate()
            .map(|(i, corners)| {
                // a triangle with two common corners comes twice, the triangle itself three times
                let around = corners.iter().flat_map(|&v| fans.around(v));
                let mean = |sum: Vec3, &t: &u32| {
                    let n = normals[t as usize];
                    let unlike = n.distance_squared(normals[i]) / (2.0 * SIGMA * SIGMA);
                    sum + areas[t as usize] * (-unlike).exp() * n
                };
                around.fold(Vec3::ZERO, mean).normalize_or(normals[i])
            })
            .collect();
    }
    normals
}

/// Returns where the vertices are after they followed the normals of their triangles.
fn followed(mesh: &Mesh, fans: &Fans, normals: &[Vec3], stays: &[bool]) -> Vec<Vec3> {
    let mut positions = mesh.positions.clone();
    for _ in 0..MOVES {
        positions = (0..positions.len())
            .into_par_iter()
            .map(|v| {
                let p = positions[v];
                let fan = fans.around(v as u32);
                if stays[v] {
                    return p;
                }
                let step: Vec3 = fan
                    .iter()
                    .map(|&t| {
                        let corners = mesh.triangles[t as usize].map(|v| positions[v as usize] - p);
                        let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
                        normals[t as usize] * normals[t as usize].dot(middle)
                    })
                    .sum();
                let moved = p + step / fan.len() as f32;
                if moved.is_finite() { moved } else { p }
            })
            .collect();
    }
    positions
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::check;
    use crate::{ExtractOptions, extract};
    use tiface_base::Quiet;
    use tiface_base::geom::{Aabb, topology};
    use tiface_base::math::rng::uniform;

    const RADIUS: f32 = 0.7;
    const CELL: f32 = 2.0 / 48.0;

    /// Returns the surface of a field with each vertex moved along its normal by up to `noise`.
    fn rough(f: impl Fn(Vec3) -> f32 + Sync, noise: f32) -> Mesh {
        let options = ExtractOptions { resolution: 48, ..ExtractOptions::default() };
        let mut mesh = extract(&f, Aabb::SCENE, &options, &Quiet).unwrap().0;
        shake(&mut mesh, noise, |_| true);
        mesh
    }

    fn shake(mesh: &mut Mesh, noise: f32, which: impl Fn(usize) -> bool) {
        for v in (0..mesh.positions.len()).filter(|&v| which(v)) {
            mesh.positions[v] += (2.0 * uniform(1, 0, v as u64) - 1.0) * noise * mesh.normals[v];
        }
        mesh.normals = mesh.angle_weighted_normals();
    }

    /// Returns the mean angle between a mesh's normals and those of a ball around 0, degrees.
    fn off_ball(mesh: &Mesh) -> f32 {
        let angle = |(p, n): (&Vec3, &Vec3)| n.angle_between(p.normalize()).to_degrees();
        mesh.positions.iter().zip(&mesh.normals).map(angle).sum::<f32>() / mesh.positions.len() as f32
    }

    /// Two squares of 16 × 16 cells that meet in a ridge of 90 degrees along y at x = 0.
    fn roof() -> Mesh {
        let mut mesh = Mesh::default();
        for y in 0..17u32 {
            for x in 0..33u32 {
                let at = x as f32 - 16.0;
                mesh.positions.push(Vec3::new(at, y as f32 * 2f32.sqrt(), -at.abs()));
                if x < 32 && y < 16 {
                    let v = y * 33 + x;
                    mesh.triangles.extend([[v, v + 1, v + 34], [v, v + 34, v + 33]]);
                }
            }
        }
        mesh.normals = mesh.angle_weighted_normals();
        mesh
    }

    #[test]
    fn a_noisy_ball_becomes_true_and_keeps_its_volume() {
        let mut mesh = rough(|p| p.length() - RADIUS, 0.05 * CELL);
        let (angle, volume) = (off_ball(&mesh), mesh.signed_volume());
        let report = smooth(&mut mesh, &[]);
        assert!(angle > 1.5 && off_ball(&mesh) < 0.5 * angle, "{angle} {}", off_ball(&mesh));
        assert!((mesh.signed_volume() / volume - 1.0).abs() < 1e-3, "{}", mesh.signed_volume() / volume);
        assert!(report.largest_move < 0.2 * CELL && report.mean_move > 0.0, "{report:?}");
        assert!(mesh.is_closed());
        let off = mesh.positions.iter().map(|p| (p.length() - RADIUS).abs()).fold(0.0, f32::max);
        assert!(off < 0.05 * CELL, "{off}");
    }

    #[test]
    fn a_ridge_stays_while_the_slopes_beside_it_become_flat() {
        let on_ridge = |v: usize| v % 33 == 16;
        let inside = |v: usize| (1..32).contains(&(v % 33)) && (1..16).contains(&(v / 33));
        let mut mesh = roof();
        let exact = mesh.positions.clone();
        shake(&mut mesh, 0.05, |v| inside(v) && !on_ridge(v));
        // from the slope's plane, along its normal (±1, 0, 1) / √2
        let off = |mesh: &Mesh| -> f32 {
            let plane = |p: &Vec3| (p.z + p.x.abs()).abs() / 2f32.sqrt();
            let slopes = (0..exact.len()).filter(|&v| inside(v) && !on_ridge(v));
            slopes.map(|v| plane(&mesh.positions[v])).sum::<f32>() / (30 * 15) as f32
        };
        let before = off(&mesh);
        smooth(&mut mesh, &[]);
        assert!(before > 0.02 && off(&mesh) < 0.6 * before, "{before} {}", off(&mesh));
        // the mean of a ridge vertex's neighbors lies 2/3 of a cell below it
        for v in (0..exact.len()).filter(|&v| on_ridge(v)) {
            assert!(mesh.positions[v].distance(exact[v]) < 0.05, "{v} {}", mesh.positions[v]);
        }
    }

    #[test]
    fn borders_and_fixed_vertices_stay() {
        let mut mesh = roof();
        shake(&mut mesh, 0.05, |_| true);
        let before = mesh.positions.clone();
        let fixed: Vec<bool> = (0..before.len()).map(|v| v % 7 == 0).collect();
        smooth(&mut mesh, &fixed);
        let border = |v: usize| [0, 32].contains(&(v % 33)) || [0, 16].contains(&(v / 33));
        for v in 0..before.len() {
            assert_eq!(mesh.positions[v] == before[v], border(v) || fixed[v], "{v}");
        }
    }

    #[test]
    fn a_vertex_of_two_fans_or_of_an_open_one_is_not_closed() {
        let tetrahedron = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        let closed = |triangles: &[[u32; 3]], v: u32| Fans::new(8, triangles).is_closed(v, triangles);
        assert!((0..4).all(|v| closed(&tetrahedron, v)));
        assert!(!closed(&tetrahedron, 7));
        assert!(!closed(&tetrahedron[1..], 0) && closed(&tetrahedron[1..], 3));
        // a second one that shares vertex 3
        let shifted = tetrahedron.map(|t| t.map(|v| v + 3));
        let both = [tetrahedron, shifted].concat();
        assert!(!closed(&both, 3) && closed(&both, 0) && closed(&both, 6));
        // a triangle twice
        assert!(!closed(&[&tetrahedron[..], &tetrahedron[..1]].concat(), 0));
    }

    #[test]
    fn a_leaf_thinner_than_its_noise_stays_closed_and_crosses_nothing() {
        // 1.2 cells thick in the middle, with an edge around
        let f = |p: Vec3| ((p * Vec3::new(1.0, 1.0, 24.0)).length() - 0.6) / 24.0;
        let mut mesh = rough(f, 0.25 * CELL);
        let before = check(&mesh, 1.0).self_intersections;
        smooth(&mut mesh, &[]);
        assert!(check(&mesh, 1.0).self_intersections <= before, "{before}");
        let shape = topology(&mesh.positions, &mesh.triangles);
        assert!(shape.is_solid() && shape.genus == Some(0), "{shape:?}");
    }

    #[test]
    fn the_number_of_threads_changes_no_byte() {
        let made = |threads: usize| {
            let mut mesh = rough(|p| p.length() - RADIUS, 0.2 * CELL);
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let report = pool.install(|| smooth(&mut mesh, &[]));
            (mesh, report)
        };
        assert_eq!(made(1), made(3));
    }

    #[test]
    fn nothing_and_flat_triangles_are_no_reason_to_fail() {
        assert_eq!(smooth(&mut Mesh::default(), &[]), SmoothReport::default());
        let point = Mesh { positions: vec![Vec3::ONE; 4], ..Mesh::default() };
        let mut mesh = Mesh { triangles: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], ..point };
        smooth(&mut mesh, &[]);
        assert_eq!(mesh.positions, [Vec3::ONE; 4]);
    }
}

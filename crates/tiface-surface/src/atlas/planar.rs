//! Flat pieces of a surface, such as the cap under a bust: laid out as they are, in one chart each.

use super::chart::Flat;
use super::patches::NONE;
use glam::{DVec2, DVec3};
use tiface_base::geom::Mesh;

/// Share of the surface from which a flat piece is worth a chart of its own.
const SHARE: f64 = 0.01;

/// Maximum distance of a vertex from the plane, relative to the surface's extent.
const MAX_PLANE_DISTANCE: f64 = 5e-4;

/// Cosine of the angle by which a triangle may lean.
const MIN_PLANE_COSINE: f64 = 0.999;

/// Returns the flat pieces of at least a hundredth of the surface, starting from the largest
/// triangles.
pub(super) fn planar(mesh: &Mesh, adjacent: &[[u32; 3]]) -> Vec<Flat> {
    let count = mesh.triangles.len();
    let corners = |t: u32| mesh.corners(t).map(|p| p.as_dvec3());
    let across: Vec<DVec3> = (0..count as u32)
        .map(|t| {
            let [a, b, c] = corners(t);
            0.5 * (b - a).cross(c - a)
        })
        .collect();
    let areas: Vec<f64> = across.iter().map(|n| n.length()).collect();
    let whole: f64 = areas.iter().sum();
    let extent = f64::from(mesh.bounds().size().max_element());
    let off = MAX_PLANE_DISTANCE * extent;
    let mut seeds: Vec<u32> = (0..count as u32).collect();
    seeds.sort_by(|&a, &b| areas[b as usize].total_cmp(&areas[a as usize]).then(a.cmp(&b)));
    let mut piece = vec![NONE; count];
    let mut found = Vec::new();
    // a flat piece that large has large triangles, or very many of a size: some hundred seeds find
    // it
    for seed in seeds.into_iter().take(512) {
        if piece[seed as usize] != NONE || areas[seed as usize] == 0.0 {
            continue;
        }
        let n = across[seed as usize] / areas[seed as usize];
        let at = corners(seed)[0];
        let (mut open, mut members, mut area) = (vec![seed], vec![], 0.0);
        piece[seed as usize] = seed;
        while let Some(t) = open.pop() {
            members.push(t);
            area += areas[t as usize];
            for k in adjacent[t as usize] {
                if k == NONE || piece[k as usize] != NONE {
                    continue;
                }
                let lies = corners(k).iter().all(|p| (*p - at).dot(n).abs() <= off);
                if lies && across[k as usize].dot(n) >= MIN_PLANE_COSINE * areas[k as usize] {
                    piece[k as usize] = seed;
                    open.push(k);
                }
            }
        }
        if area < SHARE * whole {
            continue;
        }
        members.sort_unstable();
        found.push(projected(mesh, &members, n));
    }
    found
}

/// Triangles of one plane, seen along its normal `n`.
fn projected(mesh: &Mesh, triangles: &[u32], n: DVec3) -> Flat {
    let right = n.any_orthonormal_vector();
    let up = n.cross(right);
    let mut number = vec![NONE; mesh.positions.len()];
    let mut flat = Flat { triangles: triangles.to_vec(), ..Flat::default() };
    for &t in triangles {
        flat.corners.push(mesh.triangles[t as usize].map(|v| {
            let slot = &mut number[v as usize];
            if *slot == NONE {
                *slot = flat.points.len() as u32;
                let p = mesh.positions[v as usize].as_dvec3();
                flat.points.push(DVec2::new(p.dot(right), p.dot(up)));
            }
            *slot
        }));
    }
    flat
}

#[cfg(test)]
mod tests {
    use super::super::chart::twice_area;
    use super::super::patches::neighbors;
    use super::*;
    use glam::Vec3;

    /// Returns a dome of latitude rings on a flat disc at z = 0, closed.
    fn bust() -> Mesh {
        let (rings, around) = (12u32, 40u32);
        let mut mesh = Mesh { positions: vec![Vec3::Z, Vec3::ZERO], ..Mesh::default() };
        for i in 1..=rings {
            for j in 0..around {
                let (polar, turn) = (
                    std::f32::consts::FRAC_PI_2 * i as f32 / rings as f32,
                    std::f32::consts::TAU * j as f32 / around as f32,
                );
                mesh.positions.push(Vec3::new(
                    polar.sin() * turn.cos(),
                    polar.sin() * turn.sin(),
                    polar.cos(),
                ));
            }
        }
        mesh.positions[2 + ((rings - 1) * around) as usize..].iter_mut().for_each(|p| p.z = 0.0);
        let at = |i: u32, j: u32| 2 + i * around + j % around;
        for j in 0..around {
            mesh.triangles.extend([[0, at(0, j), at(0, j + 1)], [1, at(rings - 1, j + 1), at(rings - 1, j)]]);
            for i in 0..rings - 1 {
                mesh.triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                mesh.triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        mesh
    }

    #[test]
    fn the_disc_under_a_dome_is_one_chart_of_its_own_size() {
        let mesh = bust();
        assert!(mesh.is_closed());
        let found = planar(&mesh, &neighbors(&mesh));
        assert_eq!(found.iter().map(|f| f.triangles.len()).collect::<Vec<_>>(), [40]);
        assert!((0..40).all(|k| twice_area(found[0].at(k)) > 0.0));
        // 40 triangles of a regular polygon: 20 · sin(2π / 40)
        assert!((found[0].area() - 20.0 * (std::f64::consts::TAU / 40.0).sin()).abs() < 1e-5);
    }

    #[test]
    fn a_round_surface_has_no_flat_piece() {
        let mut mesh = bust();
        mesh.triangles.retain(|t| !t.contains(&1));
        assert!(planar(&mesh, &neighbors(&mesh)).is_empty());
    }
}

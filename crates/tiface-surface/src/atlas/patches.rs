//! Patches of a surface: which triangles lie beside each other, parts as meshes of their own, and
//! smooth borders between regions.

use tiface_base::geom::{Mesh, sorted_sides};

/// Marks a missing triangle, vertex or number.
pub(super) const NONE: u32 = u32::MAX;

/// Returns the `wanted` triangles and their indices.
pub(super) fn part(mesh: &Mesh, wanted: impl Fn(u32) -> bool) -> (Mesh, Vec<u32>) {
    let number: Vec<u32> = (0..mesh.triangles.len() as u32).filter(|&t| wanted(t)).collect();
    let mut vertex = vec![NONE; mesh.positions.len()];
    let mut part = Mesh::default();
    for &t in &number {
        part.triangles.push(mesh.triangles[t as usize].map(|v| {
            let n = &mut vertex[v as usize];
            if *n == NONE {
                *n = part.positions.len() as u32;
                part.positions.push(mesh.positions[v as usize]);
            }
            *n
        }));
    }
    (part, number)
}

/// Returns the triangle across the side from corner k to k + 1 of each triangle; [`NONE`] if not
/// exactly one other shares it.
pub(super) fn neighbors(mesh: &Mesh) -> Vec<[u32; 3]> {
    let mut beside = vec![[NONE; 3]; mesh.triangles.len()];
    for run in sorted_sides(&mesh.triangles).chunk_by(|a, b| a.0 == b.0) {
        if let [(_, a), (_, b)] = *run {
            beside[a as usize / 3][a as usize % 3] = b / 3;
            beside[b as usize / 3][b as usize % 3] = a / 3;
        }
    }
    beside
}

/// Smooths the borders of regions: a triangle with two neighbors in one other region joins it.
pub(super) fn straighten<L: Copy + PartialEq>(beside: &[[u32; 3]], region: &mut [L]) {
    for _ in 0..4 {
        for t in 0..beside.len() {
            let of = beside[t].map(|n| (n != NONE).then(|| region[n as usize]));
            for (a, b) in [(0, 1), (1, 2), (2, 0)] {
                if let (Some(one), Some(other)) = (of[a], of[b])
                    && one == other
                {
                    region[t] = one;
                }
            }
        }
    }
}

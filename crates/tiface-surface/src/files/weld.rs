//! Equal positions of a mesh, merged: files with a texture repeat vertices at seams.

use glam::Vec3;
use std::collections::HashMap;
use tiface_base::geom::Mesh;

/// Returns for each vertex the index of its unique position, in order of first use, and these
/// positions: files with a texture repeat vertices at seams. −0 equals 0.
pub(super) fn weld_map(mesh: &Mesh) -> (Vec<u32>, Vec<Vec3>) {
    let mut numbers: HashMap<[u32; 3], u32> = HashMap::with_capacity(mesh.positions.len());
    let mut welded = Vec::new();
    let number = |p: &Vec3| {
        let p = p + Vec3::ZERO; // −0 + 0 is 0
        *numbers.entry(p.to_array().map(f32::to_bits)).or_insert_with(|| {
            welded.push(p);
            welded.len() as u32 - 1
        })
    };
    let map = mesh.positions.iter().map(number).collect();
    (map, welded)
}

/// Returns the mesh with equal positions merged, where −0 equals 0. Triangles keep their number and
/// order, so an atlas stays parallel to them; degenerate ones are kept too.
///
/// A merged vertex has the color and the number of cameras of its first copy, and their common
/// normal; copies that disagree, as on creases, get the unit of their sum.
pub fn weld(mesh: &Mesh) -> Mesh {
    let (new, positions) = weld_map(mesh);
    let mut creased = vec![false; positions.len()];
    let mut out = Mesh { positions, ..Mesh::default() };
    let mut first = 0;
    for (i, &number) in new.iter().enumerate() {
        let number = number as usize;
        if number == first {
            first += 1;
            out.colors.extend(mesh.colors.get(i));
            out.normals.extend(mesh.normals.get(i));
            out.seen_by.extend(mesh.seen_by.get(i));
        } else if let Some(&n) = mesh.normals.get(i)
            && (creased[number] || out.normals[number] != n)
        {
            out.normals[number] += n;
            creased[number] = true;
        }
    }
    for (normal, _) in out.normals.iter_mut().zip(creased).filter(|(_, creased)| *creased) {
        *normal = normal.normalize_or_zero();
    }
    out.triangles = mesh.triangles.iter().map(|t| t.map(|i| new[i as usize])).collect();
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_become_one_and_creases_share_a_normal() {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, -Vec3::ZERO, Vec3::Y, Vec3::X],
            normals: vec![Vec3::Z, Vec3::Z, Vec3::X, Vec3::Z, Vec3::Y, Vec3::Z],
            colors: (0..6).map(|i| [i as f32; 3]).collect(),
            seen_by: vec![0, 1, 2, 3, 4, 5],
            triangles: vec![[0, 1, 2], [3, 4, 5]],
        };
        let welded = weld(&mesh);
        assert_eq!(welded.positions, [Vec3::ZERO, Vec3::X, Vec3::Y]);
        assert_eq!(welded.triangles, [[0, 1, 2], [0, 2, 1]]);
        assert_eq!(welded.colors, [[0.0; 3], [1.0; 3], [2.0; 3]]);
        assert_eq!(welded.seen_by, [0, 1, 2]);
        // x + y, normalized
        let half = std::f32::consts::FRAC_1_SQRT_2;
        assert_eq!(&welded.normals[..2], [Vec3::Z; 2]);
        assert!(welded.normals[2].distance(Vec3::new(half, half, 0.0)) < 1e-6);
        assert!(welded.is_closed());
    }
}

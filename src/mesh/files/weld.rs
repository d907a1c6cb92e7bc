//! Closing seams: vertices of equal position become one.

use crate::geom::Mesh;
use glam::Vec3;
use std::collections::HashMap;

/// For each vertex the number of its position, in order of first use, and how many there are: files with a
/// texture repeat vertices at seams. −0 is 0.
pub(super) fn places(mesh: &Mesh) -> (Vec<u32>, usize) {
    let mut numbers: HashMap<[u32; 3], u32> = HashMap::with_capacity(mesh.positions.len());
    let place = |p: &Vec3| {
        let next = numbers.len() as u32;
        // −0 + 0 is 0
        *numbers.entry((p + Vec3::ZERO).to_array().map(f32::to_bits)).or_insert(next)
    };
    let places = mesh.positions.iter().map(place).collect();
    (places, numbers.len())
}

/// The mesh with equal positions merged, −0 being 0. Triangles keep their number and order, so an atlas
/// stays parallel to them; those that fold are kept too.
///
/// A merged vertex has the colour of its first copy, and their common normal; copies that disagree, as
/// on creases, get the unit of their sum.
pub fn weld(mesh: &Mesh) -> Mesh {
    let (new, _) = places(mesh);
    let mut out = Mesh::default();
    let mut creased = Vec::new();
    for (i, &number) in new.iter().enumerate() {
        if number as usize == out.positions.len() {
            out.positions.push(mesh.positions[i] + Vec3::ZERO);
            out.colors.extend(mesh.colors.get(i));
            out.normals.extend(mesh.normals.get(i));
            creased.push(false);
        } else if let Some(&n) = mesh.normals.get(i) {
            let (sum, creased) = (&mut out.normals[number as usize], &mut creased[number as usize]);
            if *creased || *sum != n {
                *sum += n;
                *creased = true;
            }
        }
    }
    for (normal, creased) in out.normals.iter_mut().zip(creased) {
        if creased {
            *normal = normal.normalize_or_zero();
        }
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
            triangles: vec![[0, 1, 2], [3, 4, 5]],
        };
        let welded = weld(&mesh);
        assert_eq!(welded.positions, [Vec3::ZERO, Vec3::X, Vec3::Y]);
        assert_eq!(welded.triangles, [[0, 1, 2], [0, 2, 1]]);
        assert_eq!(welded.colors, [[0.0; 3], [1.0; 3], [2.0; 3]]);
        // x + y, normalised
        let half = std::f32::consts::FRAC_1_SQRT_2;
        assert_eq!(&welded.normals[..2], [Vec3::Z; 2]);
        assert!(welded.normals[2].distance(Vec3::new(half, half, 0.0)) < 1e-6);
        assert!(welded.is_closed());
    }
}

//! A head that tests share.

use super::{HeadMesh, HeadTexture, Lobes};
use glam::{DMat3, DVec3, Mat3, Vec2, Vec3};
use tiface_base::geom::{Atlas, Harmonics, Mesh, ShellLayer, Shells, Similarity};
use tiface_base::image::Photo;

/// Returns a tetrahedron far away, with everything.
pub fn tetrahedron() -> HeadMesh {
    let at = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)];
    let mesh = Mesh {
        positions: at.map(|(x, y, z)| Vec3::new(x, y, z)).to_vec(),
        normals: vec![Vec3::Z; 4],
        colors: vec![[0.5; 3]; 4],
        seen_by: vec![0, 1, 2, 255],
        triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
    };
    let photo = |b: u8| Photo { width: 8, height: 8, rgb: vec![[b, 1, 2]; 64], alpha: None };
    let coarse = |b: u8| Photo { width: 4, height: 4, rgb: vec![[b, 1, 2]; 16], alpha: None };
    let atlas = Atlas {
        uvs: vec![Vec2::ZERO, Vec2::X, Vec2::ONE],
        triangles: vec![[0, 1, 2]; 4],
        width: 8,
        height: 8,
    };
    let lobes = Lobes {
        pictures: (0..4).map(|k| coarse(100 + k)).collect(),
        scale: vec![0.1, 0.2, 0.3, 0.4],
        turned: Mat3::from_rotation_x(0.5),
    };
    let texture = HeadTexture { atlas, color: photo(9), normal: Some(photo(128)), lobes: Some(lobes) };
    let world_from_scene = Similarity {
        scale: 0.125,
        rotation: DMat3::from_rotation_x(0.3),
        translation: DVec3::new(5e6, -3e6, 2e5),
    };
    let coefficients = (0..16).map(|i| [0.1 * i as f32, -0.2, 0.3]).collect();
    let harmonics = Some(Harmonics { functions: 4, coefficients, turned: Mat3::from_rotation_y(0.2) });
    let layer = ShellLayer { offsets: vec![0.1, 0.2, 0.3, 0.0], alphas: vec![0.5, 0.25, 1.0, 0.0] };
    let shells = Some(Shells {
        layers: vec![layer.clone(), ShellLayer { offsets: vec![0.5; 4], ..layer }],
        depths: vec![0.25; 4],
    });
    HeadMesh { mesh, world_from_scene, texture: Some(texture), harmonics, shells }
}

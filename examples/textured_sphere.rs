//! Writes a textured ball, 20 cm across, as a GLB, an OBJ and a PLY, and as GLBs with everything
//! else.
//!
//! `cargo run --example textured_sphere -- FOLDER`
//!
//! A map of the world: u runs around, v from pole to pole, so one meridian is a seam.
//! `tools/readers` opens all of them with other people's programs.

use glam::{Mat3, Vec2, Vec3};
use std::f32::consts::{PI, TAU};
use tiface::geom::{Atlas, Mesh, ShellLayer, Shells};
use tiface::image::Photo;
use tiface::mesh::files::{ExportOptions, HeadTexture, Lobes, to_glb, to_obj, to_ply};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::path::PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| ".".into()));
    let (mesh, atlas) = globe(32, 0.1, Vec3::new(0.3, -0.2, 1.6));
    let color = picture(|x, y| [x as u8, 2 * y as u8, if (x / 16 + y / 16) % 2 == 0 { 40 } else { 220 }]);
    let (flat, gloss) = (picture(|_, _| [128, 128, 255]), picture(|x, _| [(x / 4) as u8; 3]));
    let options =
        ExportOptions { name: "globe".into(), stem: "globe".into(), up: Vec3::Z, ..ExportOptions::default() };
    let plain = HeadTexture::new(atlas, color);
    let lobes = Lobes { pictures: vec![gloss], scale: vec![0.5], turned: Mat3::IDENTITY };
    let rich = HeadTexture { normal: Some(flat), lobes: Some(lobes), ..plain.clone() };
    let mut files = to_obj(&mesh, Some(&plain), &options)?.files;
    files.extend(to_ply(&mesh, Some(&plain), &options)?.files);
    files.push(("globe.glb".into(), to_glb(&mesh, Some(&plain), None, &options)?));
    files.push(("globe_rich.glb".into(), to_glb(&mesh, Some(&rich), None, &options)?));
    // two layers, a hundredth and a thirtieth of the ball outside, around its equator
    let equator: Vec<f32> = mesh.normals.iter().map(|n| (1.0 - 4.0 * n.z.abs()).max(0.0)).collect();
    let layer = |offset: f32, alpha: f32| ShellLayer {
        offsets: equator.iter().map(|e| offset * e).collect(),
        alphas: equator.iter().map(|e| alpha * e).collect(),
    };
    let soft = Shells { layers: vec![layer(0.001, 0.6), layer(0.003, 0.3)], ..Shells::default() };
    files.push(("globe_soft.glb".into(), to_glb(&mesh, Some(&plain), Some(&soft), &options)?));
    std::fs::create_dir_all(&folder)?;
    Ok(files.iter().try_for_each(|(name, bytes)| std::fs::write(folder.join(name), bytes))?)
}

fn picture(texel: impl Fn(u32, u32) -> [u8; 3]) -> Photo {
    Photo {
        width: 256,
        height: 128,
        rgb: (0..256 * 128).map(|i| texel(i % 256, i / 256)).collect(),
        alpha: None,
    }
}

/// A sphere whose upper half is longer, so that a wrong turn shows in its box. Folded triangles at
/// the poles are left to the export, which drops them.
fn globe(rings: u32, radius: f32, center: Vec3) -> (Mesh, Atlas) {
    let (n, mut mesh) = (2 * rings, Mesh::default());
    let mut atlas = Atlas { width: 256, height: 128, ..Atlas::default() };
    for (ring, i) in (0..=rings).flat_map(|ring| (0..=n).map(move |i| (ring, i))) {
        let at = Vec2::new(i as f32 / n as f32, ring as f32 / rings as f32);
        atlas.uvs.push(at);
        if i == 0 || (ring % rings != 0 && i < n) {
            let ((sin, z), (y, x)) = ((at.y * PI).sin_cos(), (at.x * TAU).sin_cos());
            let stretch = if z > 0.0 { 1.3 } else { 1.0 };
            mesh.positions.push(center + radius * Vec3::new(sin * x, sin * y, z * stretch));
            mesh.normals.push(Vec3::new(sin * x, sin * y, z / stretch).normalize());
        }
    }
    // poles and the seam: one vertex, several texture coordinates
    let last = mesh.positions.len() as u32 - 1;
    let vertex =
        |uv: u32| if uv <= n { 0 } else { (1 + (uv / (n + 1) - 1) * n + uv % (n + 1) % n).min(last) };
    for a in (0..rings * (n + 1)).filter(|a| a % (n + 1) < n) {
        atlas.triangles.extend([[a, a + n + 1, a + n + 2], [a, a + n + 2, a + 1]]);
    }
    mesh.triangles = atlas.triangles.iter().map(|t| t.map(vertex)).collect();
    (mesh, atlas)
}

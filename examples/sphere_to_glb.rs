//! Writes a colored ball, 20 cm across, as sphere.glb, sphere.obj and sphere.ply.
//!
//! `cargo run --example sphere_to_glb -- FOLDER`
//!
//! Its world is +Z up, as many captures' are: GLB and OBJ stand it upright, PLY leaves it as it is.
//! `tools/readers` opens all three with other people's programs and compares.

use glam::Vec3;
use std::path::PathBuf;
use tiface::geom::Mesh;
use tiface::mesh::files::{ExportOptions, check, to_glb, to_obj, to_ply};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| ".".into()));
    let mesh = ball(64, 0.1, Vec3::new(0.3, -0.2, 1.6));
    let options = ExportOptions {
        name: "sphere".into(),
        stem: "sphere".into(),
        up: Vec3::Z,
        ..ExportOptions::default()
    };
    std::fs::create_dir_all(&folder)?;
    std::fs::write(folder.join("sphere.glb"), to_glb(&mesh, None, None, &options)?)?;
    for (name, bytes) in
        [to_obj(&mesh, None, &options)?, to_ply(&mesh, None, &options)?].iter().flat_map(|e| &e.files)
    {
        std::fs::write(folder.join(name), bytes)?;
    }
    print!("{}", check(&mesh, 1.0));
    Ok(())
}

/// Rings between two poles; color is where a point lies. The top is a little longer, so that a
/// wrong turn shows in the box.
fn ball(rings: u32, radius: f32, center: Vec3) -> Mesh {
    let around = 2 * rings;
    let mut mesh = Mesh::default();
    let mut point = |d: Vec3| {
        let stretch = if d.z > 0.0 { 1.3 } else { 1.0 };
        mesh.positions.push(center + radius * Vec3::new(d.x, d.y, d.z * stretch));
        mesh.normals.push(Vec3::new(d.x, d.y, d.z / stretch).normalize());
        mesh.colors.push([0.5 + 0.5 * d.x, 0.5 + 0.5 * d.y, 0.5 + 0.5 * d.z]);
    };
    point(Vec3::Z);
    for ring in 1..rings {
        let polar = std::f32::consts::PI * ring as f32 / rings as f32;
        for i in 0..around {
            let turn = std::f32::consts::TAU * i as f32 / around as f32;
            point(Vec3::new(polar.sin() * turn.cos(), polar.sin() * turn.sin(), polar.cos()));
        }
    }
    point(-Vec3::Z);
    let (at, south) = (|ring: u32, i: u32| 1 + (ring - 1) * around + i % around, 1 + (rings - 1) * around);
    for i in 0..around {
        mesh.triangles.extend([[0, at(1, i), at(1, i + 1)], [south, at(rings - 1, i + 1), at(rings - 1, i)]]);
        for ring in 1..rings - 1 {
            let [a, b, c, d] = [at(ring, i), at(ring + 1, i), at(ring + 1, i + 1), at(ring, i + 1)];
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}

//! Ray casts views around the mesh of a file, colored by its normals.
//!
//! `cargo run --release -p tiface-surface --example ray_cast -- FILE FOLDER`

use glam::{DMat3, DVec3};
use std::path::PathBuf;
use tiface_base::geom::{Bvh, Camera, Distortion};
use tiface_base::image::quantize;
use tiface_base::io::write_png_rgb;
use tiface_surface::files::read;
use tiface_surface::render::{RaycastOptions, raycast};

const SIDE: u32 = 512;
const VIEWS: u32 = 8;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let (Some(file), Some(folder)) = (arguments.next(), arguments.next()) else {
        return Err("name a mesh file and a folder for the views".into());
    };
    let mesh = read(&std::fs::read(&file)?, &file)?;
    let bounds = mesh.bounds();
    let center = (0.5 * (bounds.min + bounds.max)).as_dvec3();
    let distance = 1.5 * f64::from((bounds.max - bounds.min).length());
    let bvh = Bvh::new(&mesh);

    std::fs::create_dir_all(&folder)?;
    for view in 0..VIEWS {
        // +Y is up; columns are right, up and backwards
        let rotation = DMat3::from_rotation_y(f64::from(view) / f64::from(VIEWS) * std::f64::consts::TAU);
        let camera = Camera {
            width: SIDE,
            height: SIDE,
            fx: 1.4 * f64::from(SIDE),
            fy: 1.4 * f64::from(SIDE),
            cx: 0.5 * f64::from(SIDE),
            cy: 0.5 * f64::from(SIDE),
            distortion: Distortion::default(),
            rotation,
            position: center + distance * (rotation * DVec3::Z),
        };
        let shown = raycast(&bvh, &mesh, None, &camera, &RaycastOptions::default(), |hits| {
            hits.normals.iter().map(|n| (0.5 + 0.5 * *n).to_array()).collect()
        });
        let rgb: Vec<[u8; 3]> =
            shown.color.data.as_chunks::<4>().0.iter().map(|c| [0, 1, 2].map(|k| quantize(c[k]))).collect();
        write_png_rgb(&folder.join(format!("{view:02}.png")), SIDE, SIDE, &rgb)?;
    }
    Ok(())
}

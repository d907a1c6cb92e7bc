//! Prints the camera of every view of a capture, whatever the format of its camera files.
//!
//! `cargo run --release -p tiface-capture --example list_cameras -- CAPTURE`

use std::path::PathBuf;
use tiface_capture::{CaptureOptions, ViewMask, open};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = PathBuf::from(std::env::args_os().nth(1).ok_or("name the folder of a capture")?);
    let capture = open(&folder, &CaptureOptions::default())?;
    println!("{}: {}, {} views, up {:.3}", capture.name, capture.format, capture.views.len(), capture.up);
    for view in &capture.views {
        let c = &view.camera;
        // OpenGL's axes: x right, y up, and the camera looks along −z
        let forward = -c.rotation.z_axis;
        let lens = if c.distortion.is_none() { "pinhole" } else { "with distortion" };
        let mask = match &view.mask {
            ViewMask::None => "no mask".to_string(),
            ViewMask::Alpha => "alpha".to_string(),
            ViewMask::File(file) => file.display().to_string(),
        };
        println!("{} ({:?}): {} × {} pixels, {lens}, {mask}", view.name, view.split, c.width, c.height);
        println!("    focal {:.2} {:.2}, center {:.2} {:.2}", c.fx, c.fy, c.cx, c.cy);
        println!("    at {:.4}, towards {forward:.4}", c.position);
    }
    capture.warnings.iter().for_each(|warning| println!("warning: {warning}"));
    Ok(())
}

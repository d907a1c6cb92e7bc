//! Writes a copy of a capture whose cameras are COLMAP's model: `images/`, `masks/`, `sparse/0`.
//!
//! `cargo run --release -p tiface-capture --example to_colmap -- CAPTURE FOLDER`

use std::path::PathBuf;
use tiface_capture::convert::{CameraFormat, convert};
use tiface_capture::{CaptureOptions, open};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let (Some(from), Some(to)) = (arguments.next(), arguments.next()) else {
        return Err("name the folder of a capture and a new one".into());
    };
    let done = convert(&open(&from, &CaptureOptions::default())?, CameraFormat::Colmap, &to)?;
    done.warnings.iter().for_each(|warning| println!("warning: {warning}"));
    println!("{}: {} views, {} masks", done.folder.display(), done.views, done.masks);
    Ok(())
}

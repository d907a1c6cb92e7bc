//! Makes a small capture of an analytic head: known cameras, masks and surface.
//!
//! `cargo run --release --example synthetic_head -- FOLDER`

use std::{path::PathBuf, time::Instant};
use tiface::capture::synthetic::{SyntheticOptions, write_capture};

fn main() -> tiface::Result<()> {
    let dir = PathBuf::from(std::env::args_os().nth(1).unwrap_or_else(|| "synthetic_head".into()));
    let options = SyntheticOptions::default();
    let start = Instant::now();
    write_capture(&dir, &options)?;
    println!(
        "{} views in {} ({:.1} s)",
        options.train + options.test,
        dir.display(),
        start.elapsed().as_secs_f32()
    );
    Ok(())
}

//! Says whether the mesh of a GLB, OBJ, PLY or STL file is closed, in one piece and free of
//! self-intersections.
//!
//! `cargo run --release -p tiface-surface --example check_file -- FILE`

use std::path::PathBuf;
use tiface_surface::files::{check, read};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = PathBuf::from(std::env::args().nth(1).ok_or("name a mesh file")?);
    let mesh = read(&std::fs::read(&path)?, &path)?;
    let report = check(&mesh, 1.0);
    print!("{report}");
    report.require(&["watertight", "one-piece", "no-self-intersections"])?;
    Ok(())
}

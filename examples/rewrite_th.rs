//! Reads a published T-Face or TensoRF checkpoint, says what it holds, and writes it again:
//! `cargo run --example rewrite_th -- IN.th OUT.th`

use std::path::PathBuf;
use tiface::io::{self, Limits};
use tiface::tface::th;

fn main() -> anyhow::Result<()> {
    let paths: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [from, to] = &paths[..] else { anyhow::bail!("expected two paths: IN.th OUT.th") };
    let field = th::read_th(from, &Limits::default())?;
    println!("box {:?}, {:?} nodes", field.aabb, field.grid_size);
    println!("ranks {:?} of density, {:?} of color", field.density_rank, field.color_rank);
    match &field.mask {
        Some(mask) => println!("mask of {:?} nodes (z, y, x)", mask.shape),
        None => println!("no mask"),
    }
    io::write_atomic(to, &th::th_bytes(&field))?;
    Ok(())
}

//! The largest error of some two hundred hard cases, and its bound; a line that begins with `!` is
//! beyond it.
//!
//!     cargo bench --bench stability

#[path = "../tests/support/stability/mod.rs"]
mod stability;

fn main() -> tiface::Result<()> {
    let dir = tempfile::tempdir().expect("a scratch folder can be made");
    for case in stability::stability(dir.path(), stability::Breadth::All)? {
        println!("{} {case}", if case.holds() { ' ' } else { '!' });
    }
    Ok(())
}

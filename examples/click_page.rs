//! Writes the page to click on, for a capture or, without one, for a small analytic head.
//!
//! `cargo run --release --example click_page -- PAGE.html [CAPTURE]`
//!
//! Clicks that lie in the capture already (`prompts.json`) are shown.

use std::path::PathBuf;
use tiface::capture::synthetic::{SyntheticOptions, write_capture};
use tiface::capture::{self, CaptureOptions};
use tiface::io::{self, Limits};
use tiface::mask::pages::page_of;
use tiface::mask::prompts::{Prompts, read_prompts};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut paths = std::env::args_os().skip(1).map(PathBuf::from);
    let out = paths.next().unwrap_or_else(|| "page.html".into());
    let folder = match paths.next() {
        Some(folder) => folder,
        None => {
            let folder = out.with_extension("capture");
            write_capture(&folder, &SyntheticOptions { train: 6, test: 1, ..Default::default() })?;
            folder
        }
    };
    let limits = Limits::default();
    let capture = capture::open(&folder, &CaptureOptions::default())?;
    let clicks = folder.join("prompts.json");
    let prompts = if io::is_file(&clicks) { read_prompts(&clicks, &limits)? } else { Prompts::default() };
    let page = page_of(&capture, &prompts, &limits)?;
    io::write_atomic(&out, page.as_bytes())?;
    println!("{}: {} photographs, {} bytes", out.display(), capture.views.len(), page.len());
    Ok(())
}

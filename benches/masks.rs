//! Masks from three clicked views of the shared captures: overlap with the true masks, and CPU
//! seconds.
//!
//! ```text
//! cargo bench --bench masks                  both captures
//! cargo bench --bench masks -- large         the same enlarged to 3072 × 4096, for the memory
//! ```
//!
//! CPU time (user + system of the process) does not depend on what else the machine does.

#[path = "../tests/support/clicked.rs"]
mod clicked;
mod process;

use clicked::{Clicked, mean_worst, overlap, read};
use process::{cpu_s, peak_gib};
use tiface::geom::Camera;
use tiface::image::Photo;
use tiface::mask::Click;
use tiface::mask::consistency::{ConsistencyView, check_consistency};
use tiface::mask::grabcut::grabcut;
use tiface::mask::propagate::{PropagateView, propagate};

fn main() {
    let times = if std::env::args().any(|a| a == "large") { 8 } else { 1 };
    println!("                          IoU mean   worst   CPU s a view");
    for name in ["lps", "nefertiti"] {
        if let Some(c) = read(name) {
            table(name, &c, times);
        }
    }
    println!("peak memory {:.2} GiB", peak_gib());
}

fn table(name: &str, c: &Clicked, times: u32) {
    let row = |what: &str, overlaps: &[f64], s: f64| {
        let (mean, worst) = mean_worst(overlaps);
        println!("{name:10} {what:14}  {mean:.4}  {worst:.4}   {:.2}", s / overlaps.len() as f64);
    };
    let start = cpu_s();
    let alone: Vec<f64> = (0..c.views.len())
        .filter(|&i| !c.clicks[i].is_empty())
        .map(|i| {
            let cut = grabcut(&c.views[i].name, &c.photos[i], &c.clicks[i]).expect("a mask");
            overlap(&cut.mask, &c.truth[i])
        })
        .collect();
    row("clicked alone", &alone, cpu_s() - start);

    let cameras: Vec<Camera> =
        c.views.iter().map(|v| v.camera.resized(times * v.camera.width, times * v.camera.height)).collect();
    let scaled = |v: f32| (v + 0.5) * times as f32 - 0.5;
    let moved = |k: &Click| Click { x: scaled(k.x), y: scaled(k.y), head: k.head };
    let clicks: Vec<Vec<Click>> = c.clicks.iter().map(|k| k.iter().map(moved).collect()).collect();
    let views: Vec<PropagateView> = (0..c.views.len())
        .map(|i| PropagateView {
            name: &c.views[i].name,
            camera: &cameras[i],
            clicks: &clicks[i],
            votes: true,
        })
        .collect();
    let start = cpu_s();
    let load = |i: usize| Ok(enlarged(&c.photos[i], times));
    let masks = propagate(&views, load).expect("masks");
    let s = cpu_s() - start;
    let overlaps: Vec<f64> = masks.masks.iter().zip(&c.truth).map(|(m, t)| overlap(m, t)).collect();
    row("all views", &overlaps, s);
    assert!(overlaps.iter().all(|o| *o > 0.8), "{name}: a mask is not the head");
    masks.warnings.iter().for_each(|w| println!("  {w}"));

    let start = cpu_s();
    let check: Vec<ConsistencyView> = (c.views.iter().zip(&masks.masks))
        .map(|(v, m)| ConsistencyView { name: &v.name, camera: &v.camera, mask: Some(m) })
        .collect();
    let found = check_consistency(&check).expect("a comparison");
    println!("{name:10} check          {} conflicts, {:.2} CPU s", found.conflicts.len(), cpu_s() - start);
}

/// Each pixel `times` × `times` times.
fn enlarged(photo: &Photo, times: u32) -> Photo {
    let (width, height) = (photo.width * times, photo.height * times);
    let at = |i: u32| ((i / width / times) * photo.width + i % width / times) as usize;
    Photo { width, height, rgb: (0..width * height).map(|i| photo.rgb[at(i)]).collect(), alpha: None }
}

//! Devices that tests share, and how their results are compared.

use super::{Adapter, Atomics, Device};
use std::cell::Cell;

pub use super::evaluate::planes;

/// Returns a device to test on, a software one too, or says that there is none.
pub fn device() -> Option<Device> {
    let found = Adapter::all().first().map(|adapter| Device::open(adapter).expect("the adapter opens"));
    if found.is_none() {
        println!("skipped: kernels on a GPU, for no adapter is here (Mesa's lavapipe would do)");
    }
    found
}

thread_local! {
    /// Readbacks that this thread's devices still answer.
    static ANSWERS: Cell<usize> = const { Cell::new(usize::MAX) };
}

/// Lets the devices of this thread answer so many readbacks and fail after that.
pub fn lose_after(readbacks: usize) {
    ANSWERS.set(readbacks);
}

/// Counts a readback; fails if no more are answered.
pub(super) fn answer() -> Result<(), &'static str> {
    let left = ANSWERS.get();
    ANSWERS.set(if left == usize::MAX { left } else { left.saturating_sub(1) });
    if left > 0 { Ok(()) } else { Err("device lost (of a test)") }
}

/// Returns the device with every way of adding that it has.
pub fn devices() -> Vec<Device> {
    let ways = [Atomics::Native, Atomics::Exchange, Atomics::Fixed];
    let has = |d: &Device, way: Atomics| way != Atomics::Native || d.atomics() == way;
    ways.into_iter().filter_map(|way| device().filter(|d| has(d, way)).map(|d| d.with_atomics(way))).collect()
}

/// Asserts that two arrays agree to `tolerance` of the larger of a value and the mean magnitude.
pub fn agree(what: &str, got: &[f32], want: &[f32], tolerance: f32) {
    assert_eq!(got.len(), want.len(), "{what}");
    let worst = worst(got, want);
    println!("{what}: {worst:.1e} of {tolerance:.0e}");
    assert!(worst <= tolerance, "{what}: {worst:.1e}");
}

/// Runs an ignored test in a process of its own: what is noted of one device fails the next read of
/// any, and all take of the same memory.
pub fn alone(name: &str) {
    let this = std::env::current_exe().unwrap();
    let run = std::process::Command::new(this).args(["--ignored", "--exact", name]).output().unwrap();
    let text = String::from_utf8_lossy(&run.stdout).into_owned() + &String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success() && text.contains("1 passed"), "{text}");
    println!("{text}");
}

/// Returns the largest error of an array, as a part of the larger of a value and the mean
/// magnitude.
pub fn worst(got: &[f32], want: &[f32]) -> f32 {
    let mean = want.iter().map(|v| v.abs()).sum::<f32>() / want.len().max(1) as f32;
    let error = |(g, w): (&f32, &f32)| (g - w).abs() / w.abs().max(mean).max(f32::MIN_POSITIVE);
    got.iter().zip(want).map(error).fold(0f32, |a, b| if b > a || b.is_nan() { b } else { a })
}

//! The `tiface` binary: parse, run, exit code; nothing else.

use mimalloc::MiMalloc;
use std::alloc::{GlobalAlloc, Layout};

/// Training allocates and frees the same large blocks every step; mimalloc returns them to the
/// system late. If memory runs out, the process ends with an error message instead of an abort.
struct Allocator;

#[global_allocator]
static ALLOCATOR: Allocator = Allocator;

// SAFETY: every call is mimalloc's own, and what it returns is handed on as it is.
unsafe impl GlobalAlloc for Allocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as the caller promises.
        check_alloc(unsafe { MiMalloc.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as the caller promises.
        check_alloc(unsafe { MiMalloc.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, place: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as the caller promises.
        check_alloc(unsafe { MiMalloc.realloc(place, layout, size) }, size)
    }

    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        // SAFETY: as the caller promises.
        unsafe { MiMalloc.dealloc(place, layout) }
    }
}

unsafe extern "C" {
    /// Part of mimalloc: gives the free memory of the calling thread back to the system.
    fn mi_collect(force: bool);
}

/// Gives the allocator's free memory back to the system.
fn give_memory_back() {
    // SAFETY: mimalloc allows it in any thread at any time; memory in use is not touched.
    let collect = || unsafe { mi_collect(true) };
    // each thread has free memory of its own
    rayon::broadcast(|_| collect());
    collect();
}

#[inline]
fn check_alloc(place: *mut u8, bytes: usize) -> *mut u8 {
    if place.is_null() {
        tiface::cli::out_of_memory(bytes);
    }
    place
}

fn main() -> std::process::ExitCode {
    // On machines without a desktop, a library of the graphics drivers prints a warning per adapter
    // on stderr.
    #[cfg(all(feature = "wgpu", unix))]
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: no other thread runs yet.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
    tiface::cli::main(give_memory_back)
}

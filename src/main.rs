//! The `tiface` binary: parse, run, exit code; nothing else.

/// Training allocates and frees the same large blocks every step; this returns them to the system late.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    // a library below the graphics drivers complains on stderr, once an adapter, where there is no desktop
    #[cfg(all(feature = "wgpu", unix))]
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: no other thread runs yet.
        unsafe { std::env::set_var("XDG_RUNTIME_DIR", std::env::temp_dir()) };
    }
    tiface::cli::main()
}

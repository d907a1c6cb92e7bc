//! The `tiface` binary: parse, run, exit code; nothing else.

/// Training allocates and frees the same large blocks every step; this returns them to the system late.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    tiface::cli::main()
}

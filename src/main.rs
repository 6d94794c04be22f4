#[cfg(not(feature = "race"))]
use std::alloc::System as Allocator;

/// Counts what the rivals of `bench-bvh` allocate.
#[cfg(feature = "race")]
use peak_alloc::PeakAlloc as Allocator;

/// Notes when the system refuses memory, so that the program can tell why it aborts.
#[global_allocator]
static MEMORY: lasertrace::cli::Noting<Allocator> = lasertrace::cli::Noting(Allocator);

fn main() -> std::process::ExitCode {
    lasertrace::cli::run().into()
}

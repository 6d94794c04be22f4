#[cfg(not(feature = "race"))]
use std::alloc::System as Allocator;

/// Measures the memory allocated by the competitors of `bench-bvh`.
#[cfg(feature = "race")]
use peak_alloc::PeakAlloc as Allocator;

/// Records when the system refuses memory, so that the cause of an abort is known.
#[global_allocator]
static MEMORY: lasertrace::cli::Noting<Allocator> = lasertrace::cli::Noting(Allocator);

fn main() -> std::process::ExitCode {
    lasertrace::cli::run().into()
}

/// Counts what the rivals of `bench-bvh` allocate.
#[cfg(feature = "race")]
#[global_allocator]
static MEMORY: peak_alloc::PeakAlloc = peak_alloc::PeakAlloc;

fn main() -> std::process::ExitCode {
    lasertrace::cli::run().into()
}

//! Check that a mesh fits in memory, made before allocation. The system kills a program that takes
//! too much, without a message.

use super::{control_groups, format_detection};
use crate::error::{Error, Result, printable};
use std::path::Path;
use sysinfo::{MemoryRefreshKind, RefreshKind, System};

/// Bytes per triangle for reading and welding a binary STL.
///
/// The file takes 50, indices 12, positions 12, and hash tables the rest. Measured: 83 in total.
/// Files with large index distances between neighbouring triangles need more.
const LOAD_STL: u64 = 95;

/// Returns the number of bytes that may still be allocated.
///
/// The bound is the memory that the system can free without swapping, within the limits of the
/// control groups and of the process (`ulimit -v`, `ulimit -d`). Returns `None` if the system does
/// not report it.
pub fn available() -> Option<u64> {
    let of_the_groups = control_groups::available(Path::new("/"));
    [
        system_memory_available(),
        process_memory_limit(),
        of_the_groups,
    ]
    .into_iter()
    .flatten()
    .min()
}

/// Returns the remaining address space of the process. Both limits count all mapped memory; the
/// part that is not data (the program itself) is small.
fn process_memory_limit() -> Option<u64> {
    use rustix::process::{Resource, getrlimit};
    let limits = [Resource::As, Resource::Data].map(|resource| getrlimit(resource).current);
    let limit = limits.into_iter().flatten().min()?;
    let pages = std::fs::read_to_string("/proc/self/statm").ok()?;
    let taken: u64 = pages.split(' ').next()?.parse().ok()?;
    Some(limit.saturating_sub(taken * rustix::param::page_size() as u64))
}

fn system_memory_available() -> Option<u64> {
    let memory = RefreshKind::nothing().with_memory(MemoryRefreshKind::nothing().with_ram());
    let system = System::new_with_specifics(memory);
    // sysinfo returns 0 on systems it does not support.
    Some(system.available_memory()).filter(|&bytes| bytes > 0)
}

/// Refuses `work` that takes `need` bytes if fewer are `available`.
///
/// # Errors
/// Returns `Error::Memory` if memory is insufficient.
pub fn require(work: String, need: u64, available: Option<u64>) -> Result<()> {
    match available {
        Some(available) if need > available => Err(Error::Memory {
            work,
            need,
            available,
        }),
        _ => Ok(()),
    }
}

/// Refuses a file of `size` bytes that would not fit in memory once read. `head` contains its first
/// bytes.
pub(super) fn require_for_file(
    path: &Path,
    head: &[u8],
    size: u64,
    available: Option<u64>,
) -> Result<()> {
    let path = printable::path(path);
    match format_detection::stl_count(head) {
        Some(count) if format_detection::fills(count, size) => {
            let work = format!("{path}: reading {count} triangles at {LOAD_STL} bytes each");
            require(work, count * LOAD_STL, available)
        }
        _ => {
            let work = format!("{path}: reading {size} bytes, and as many for the mesh,");
            require(work, 2 * size, available)
        }
    }
}

/// Returns free memory to the system if the C library supports it. Without this, a long run of
/// different pieces holds the memory of the largest piece.
pub(crate) fn give_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: `malloc_trim` takes no pointer, and any thread may call it at any time.
    #[allow(unsafe_code)]
    unsafe {
        libc::malloc_trim(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::read_within;

    /// Tests a header of 4294967295 triangles, 215 GB, in a sparse file without content.
    #[test]
    fn a_mesh_that_does_not_fit_is_refused_with_the_arithmetic() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut header = [0; 84];
        header[80..].copy_from_slice(&[0xff; 4]);
        std::fs::write(&file, header).unwrap();
        let size = 84 + 50 * u64::from(u32::MAX);
        file.as_file().set_len(size).unwrap();
        let error = read_within(file.path(), Some(16_000_000_000), &|_| Ok(())).unwrap_err();
        let words = "reading 4294967295 triangles at 95 bytes each takes 408.02 GB, and 16.00 GB";
        assert!(error.to_string().contains(words), "{error}");
        assert_eq!(error.exit_code(), 75);
        // An equal count in a file without these triangles is a mistake in the file.
        file.as_file().set_len(1084).unwrap();
        let bytes = read_within(file.path(), Some(2168), &|_| Ok(())).unwrap();
        let error = crate::mesh::parse(file.path(), &bytes, 1.0).unwrap_err();
        assert_eq!(error.exit_code(), 65, "{error}");
        let error = read_within(file.path(), Some(2167), &|_| Ok(())).unwrap_err();
        assert!(error.to_string().contains("reading 1084 bytes"), "{error}");
    }

    #[test]
    fn the_machine_has_some_memory_and_not_all_there_is() {
        if let Some(bytes) = available() {
            assert!((1 << 20..1 << 50).contains(&bytes), "{bytes}");
            require(String::new(), bytes, Some(bytes)).unwrap();
        }
    }
}

//! Whether a mesh fits the machine's memory, asked before it is taken: the system
//! ends a program that takes too much without a word.

use super::{control_groups, sniff};
use crate::error::{Error, Result, printable};
use std::path::Path;
use sysinfo::{MemoryRefreshKind, RefreshKind, System};

/// Bytes a triangle takes while a binary STL is read and welded: 50 of the file, 12
/// of indices, 12 of positions, and of the weld. Measured: 83 in all; in a file whose
/// neighbours lie far apart more.
const LOAD_STL: u64 = 95;

/// Bytes that may still be taken: what the system can free without swapping, within
/// the limits of the control groups and of the process (`ulimit -v`, `ulimit -d`).
/// `None` where the system does not say.
pub fn available() -> Option<u64> {
    let of_the_groups = control_groups::available(Path::new("/"));
    [of_the_machine(), of_the_process(), of_the_groups]
        .into_iter()
        .flatten()
        .min()
}

/// What is left of the address space the process may have. Both limits count all that
/// is mapped; of what is not data (the program itself) there is little.
fn of_the_process() -> Option<u64> {
    use rustix::process::{Resource, getrlimit};
    let limits = [Resource::As, Resource::Data].map(|resource| getrlimit(resource).current);
    let limit = limits.into_iter().flatten().min()?;
    let pages = std::fs::read_to_string("/proc/self/statm").ok()?;
    let taken: u64 = pages.split(' ').next()?.parse().ok()?;
    Some(limit.saturating_sub(taken * rustix::param::page_size() as u64))
}

fn of_the_machine() -> Option<u64> {
    let memory = RefreshKind::nothing().with_memory(MemoryRefreshKind::nothing().with_ram());
    let system = System::new_with_specifics(memory);
    // 0 is what it says of systems it cannot ask.
    Some(system.available_memory()).filter(|&bytes| bytes > 0)
}

/// Refuses `work` that takes `need` bytes if fewer are `available`.
///
/// # Errors
/// `Error::Memory`.
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

/// Refuses a file of `size` bytes, of which `head` are the first, that would not
/// fit once it is read.
pub(super) fn require_for_file(
    path: &Path,
    head: &[u8],
    size: u64,
    available: Option<u64>,
) -> Result<()> {
    let path = printable::path(path);
    match sniff::stl_count(head) {
        Some(count) if sniff::fills(count, size) => {
            let work = format!("{path}: reading {count} triangles at {LOAD_STL} bytes each");
            require(work, count * LOAD_STL, available)
        }
        _ => {
            let work = format!("{path}: reading {size} bytes, and as many for the mesh,");
            require(work, 2 * size, available)
        }
    }
}

/// Gives free memory back to the system, where the C library is one that can: else a long run of
/// pieces that differ holds as much as the largest so far took.
pub(crate) fn give_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: it takes no pointer, and any thread may call it at any time.
    #[allow(unsafe_code)]
    unsafe {
        libc::malloc_trim(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::read_within;

    /// 4294967295 triangles, 215 GB, in a file with nothing in it.
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
        // The same number in a file that has no such triangles is a mistake in it.
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

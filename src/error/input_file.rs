//! Input files: regular files up to a given size. Pipes and devices are refused, since they may be
//! endless.

use super::{Error, InputError, Place, Result};
use rustix::fs::OFlags;
use std::fs::{File, Metadata};
use std::io::Read;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Largest scene, sensor, recipe, sweep or calibration file, bytes.
pub const LARGEST_TEXT: u64 = 16 << 20;
/// Largest pose table, image or data set index, bytes.
pub const LARGEST_DATA: u64 = 1 << 30;

/// Opens a regular file for reading.
///
/// # Errors
/// Returns `Error::Input` for a folder, a pipe, a device or a socket, which are not opened. Returns
/// `Error::Io` if reading fails.
pub fn open(path: &Path, expected: &str) -> Result<(File, Metadata)> {
    let regular = |kind: &Metadata| {
        let found = match kind {
            kind if kind.is_file() => return Ok(()),
            kind if kind.is_dir() => "a folder",
            _ => "something that is not a regular file",
        };
        Err(Error::from(InputError::new(
            path,
            Place::File,
            found,
            expected,
        )))
    };
    // Checked before opening, because opening a device may change its state.
    regular(&path.metadata().map_err(Error::io("read", path))?)?;
    let file = File::options()
        .read(true)
        // Does not block if a pipe has replaced the file in the meantime.
        .custom_flags(OFlags::NONBLOCK.bits() as i32)
        .open(path)
        .map_err(Error::io("read", path))?;
    let kind = file.metadata().map_err(Error::io("read", path))?;
    regular(&kind)?;
    Ok((file, kind))
}

/// Returns the bytes of a regular file of at most `largest` bytes.
///
/// # Errors
/// Returns the errors of [`open`], and `Error::Input` for a larger file. At most one byte above the
/// limit is read.
pub fn read(path: &Path, largest: u64, expected: &str) -> Result<Vec<u8>> {
    let (file, kind) = open(path, expected)?;
    let too_large = || {
        let found = format!("more than {largest} bytes");
        Error::from(InputError::new(path, Place::File, found, expected))
    };
    if kind.len() > largest {
        return Err(too_large());
    }
    let mut bytes = Vec::new();
    // Files in /proc have length 0, and a file may grow while it is read.
    let read = file.take(largest + 1).read_to_end(&mut bytes);
    read.map_err(Error::io("read", path))?;
    match bytes.len() as u64 > largest {
        true => Err(too_large()),
        false => Ok(bytes),
    }
}

/// Returns the text of a regular file of at most `largest` bytes.
///
/// # Errors
/// Returns the errors of [`read`], and `Error::Input` for bytes that are not UTF-8.
pub fn read_text(path: &Path, largest: u64, expected: &str) -> Result<String> {
    String::from_utf8(read(path, largest, expected)?).map_err(|error| {
        let place = Place::Byte(error.utf8_error().valid_up_to() as u64);
        InputError::new(path, place, "bytes that are not UTF-8", expected).into()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_up_to_the_stated_size_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "12345").unwrap();
        assert_eq!(read(&file, 5, "x").unwrap(), b"12345");
        for (path, largest, found) in [
            (file.as_path(), 4, "more than 4 bytes"),
            (folder.path(), 4, "a folder"),
            ("/dev/zero".as_ref(), 4, "not a regular file"),
        ] {
            let error = read(path, largest, "x").unwrap_err();
            assert!(error.to_string().contains(found), "{error}");
            assert_eq!(error.exit_code(), 65);
        }
        // A file of reported length 0 that contains bytes.
        assert!(
            !read("/proc/self/status".as_ref(), 1 << 20, "x")
                .unwrap()
                .is_empty()
        );
        let error = read("/proc/self/status".as_ref(), 4, "x").unwrap_err();
        assert!(error.to_string().contains("more than 4 bytes"), "{error}");
    }
}

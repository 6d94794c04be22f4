//! Output files appear whole or not at all.

use crate::error::{Error, InputError, Place, Result};
use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, Image, WritableImage};
use rustix::fs::OFlags;
use serde::de::DeserializeOwned;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

pub fn create_folder(path: &Path) -> Result<()> {
    fs::create_dir_all(path).map_err(Error::io("create folder", path))
}

/// The bytes of a file that ends: a pipe or a device is refused.
pub fn read_regular(path: &Path, expected: &str) -> Result<Vec<u8>> {
    let kind = fs::metadata(path).map_err(Error::io("read", path))?;
    if !kind.is_file() {
        let found = "something that is not a regular file";
        return Err(InputError::new(path, Place::File, found, expected).into());
    }
    fs::read(path).map_err(Error::io("read", path))
}

/// What the JSON text of a file says; an error names the line.
pub fn parse_json<T: DeserializeOwned>(path: &Path, text: &[u8], expected: &str) -> Result<T> {
    serde_json::from_slice(text).map_err(|error| {
        let place = match error.line() {
            0 => Place::File,
            line => Place::Line(line),
        };
        InputError::new(path, place, error.to_string(), expected).into()
    })
}

/// A folder in one of ours: a symbolic link in its place is refused, for what is written
/// through it lands, and what is removed is lost, somewhere else.
pub fn create_own_folder(path: &Path) -> Result<()> {
    let made = match fs::create_dir(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => check_own_folder(path),
        other => other,
    };
    made.map_err(Error::io("create folder", path))
}

fn check_own_folder(path: &Path) -> io::Result<()> {
    match fs::symlink_metadata(path)? {
        kind if kind.is_symlink() => Err(link()),
        kind if kind.is_dir() => Ok(()),
        _ => Err(io::Error::from(io::ErrorKind::NotADirectory)),
    }
}

/// Opens a file for reading and writing, empty if it is new.
pub fn open_own_file(path: &Path) -> io::Result<File> {
    // What the system says of a link ("too many levels") is of another case.
    if path.is_symlink() {
        return Err(link());
    }
    File::options()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .custom_flags(OFlags::NOFOLLOW.bits() as i32)
        .open(path)
}

fn link() -> io::Error {
    io::Error::other(
        "it is a symbolic link, and links in an output folder are not followed; remove it",
    )
}

/// A file that was not there before: through a link laid in its place another would be
/// overwritten.
fn create_new(path: &Path) -> io::Result<File> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => File::create_new(path),
    }
}

/// The end of the name of a file that one run alone writes, before it is whole.
pub const PART: &str = ".part";

/// The name under which a file is written before it is whole.
fn unfinished(path: &Path, end: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(end);
    path.with_file_name(name)
}

/// Writes beside `path`, then renames. On an error nothing is left, and after a loss
/// of power the file is whole or not there.
pub fn write(
    path: &Path,
    content: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<()> {
    replace(path, PART, |out| {
        content(out)?;
        out.flush()?;
        out.get_ref().sync_data()
    })
}

/// The same without waiting for the disk, for files by the thousand whose checksum
/// is kept elsewhere. `part` ends the name of the file that is not whole: where several runs may write
/// the same file at once, each needs another.
pub fn write_checked_later(path: &Path, bytes: &[u8], part: &str) -> Result<()> {
    replace(path, part, |out| out.write_all(bytes))
}

fn replace(
    path: &Path,
    part: &str,
    content: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<()> {
    in_place_of(path, part, |out| {
        content(out).map_err(Error::io("write", path))
    })
}

/// As [`write`], of content that may fail to come about; `part` as for [`write_checked_later`].
pub fn write_in_steps<T>(
    path: &Path,
    part: &str,
    content: impl FnOnce(&mut BufWriter<File>) -> Result<T>,
) -> Result<T> {
    in_place_of(path, part, |out| {
        let done = content(out)?;
        let synced = out.flush().and_then(|()| out.get_ref().sync_data());
        synced.map_err(Error::io("write", path))?;
        Ok(done)
    })
}

fn in_place_of<T>(
    path: &Path,
    part: &str,
    content: impl FnOnce(&mut BufWriter<File>) -> Result<T>,
) -> Result<T> {
    let failed = || Error::io("write", path);
    let part = unfinished(path, part);
    let file = create_new(&part).map_err(failed())?;
    let mut out = BufWriter::with_capacity(1 << 18, file);
    let written = content(&mut out).and_then(|done| {
        out.flush().map_err(failed())?;
        std::fs::rename(&part, path).map_err(failed())?;
        Ok(done)
    });
    if written.is_err() {
        // Best effort: the first error is the one to report.
        let _ = fs::remove_file(&part);
    }
    written
}

pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<()> {
    write(path, |out| out.write_all(bytes))
}

pub fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<()> {
    write(path, |out| {
        serde_json::to_writer_pretty(&mut *out, value)?;
        out.write_all(b"\n")
    })
}

/// Writes an EXR of `size` (columns, rows) with these channels.
pub fn write_exr<'a>(
    path: &Path,
    size: (usize, usize),
    channels: impl IntoIterator<Item = (&'a str, FlatSamples)>,
) -> Result<()> {
    let channels = channels
        .into_iter()
        .map(|(name, samples)| AnyChannel::new(name, samples))
        .collect();
    let image = Image::from_channels(size, AnyChannels::sort(channels));
    write(path, |file| {
        image
            .write()
            .to_buffered(file)
            .map_err(|error| match error {
                exr::error::Error::Io(io) => io,
                other => io::Error::other(other),
            })
    })
}

/// Removes a file of an earlier run, if there is one.
pub fn remove(path: &Path) -> Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(Error::io("remove", path)(error))
        }
        _ => Ok(()),
    }
}

/// Removes the files with such names that an earlier run left in `folder`.
pub fn remove_all(folder: &Path, is_one: impl Fn(&str) -> bool) -> Result<()> {
    let entries = match check_own_folder(folder).and_then(|()| fs::read_dir(folder)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        other => other.map_err(Error::io("read folder", folder))?,
    };
    for entry in entries {
        let entry = entry.map_err(Error::io("read folder", folder))?;
        if is_one(&entry.file_name().to_string_lossy()) {
            remove(&entry.path())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_neither_file_nor_fragment() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.bin");
        let error = write(&path, |out| {
            out.write_all(b"half")?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        });
        assert_eq!(error.unwrap_err().exit_code(), 75);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
        write_bytes(&path, b"whole").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"whole");
    }
}

//! Atomic output files: a file appears complete or not at all.

use crate::error::{Error, InputError, Place, Result};
use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, Image, WritableImage};
use rustix::fs::OFlags;
use serde::de::DeserializeOwned;
use std::ffi::OsString;
use std::fs::{self, File, TryLockError};
use std::io::{self, BufWriter, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// Largest number of attempts at a system call that signals interrupt.
const TRIES: usize = 1000;

/// Repeats a system call while a signal interrupts it.
pub fn again<T>(mut call: impl FnMut() -> io::Result<T>) -> io::Result<T> {
    for _ in 1..TRIES {
        match call() {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            done => return done,
        }
    }
    call()
}

pub fn create_folder(path: &Path) -> Result<()> {
    again(|| fs::create_dir_all(path)).map_err(Error::io("create folder", path))
}

/// Parses the JSON text of a file. An error states the line.
pub fn parse_json<T: DeserializeOwned>(path: &Path, text: &[u8], expected: &str) -> Result<T> {
    serde_json::from_slice(text).map_err(|error| {
        let place = match error.line() {
            0 => Place::File,
            line => Place::Line(line),
        };
        InputError::new(path, place, error.to_string(), expected).into()
    })
}

/// Creates a folder in an output folder. An existing symbolic link is refused, because writes and
/// removals through it would affect another location.
pub fn create_own_folder(path: &Path) -> Result<()> {
    let made = match again(|| fs::create_dir(path)) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => check_own_folder(path),
        other => other.and_then(|()| sync_folder_of(path)),
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

/// Opens a file for reading and writing. A new file is empty.
pub fn open_own_file(path: &Path) -> io::Result<File> {
    // The system's message for a link ("too many levels") describes a different case.
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

/// Creates a file that is locked while it is open. Removes a file or a link of the same name; a
/// link is not followed.
pub fn create_locked(path: &Path) -> io::Result<File> {
    loop {
        remove_if_there(path)?;
        let file = File::create_new(path)?;
        // Another process may have removed the file before the lock.
        if lock(&file)? && is_at(&file, path) {
            return Ok(file);
        }
    }
}

/// Locks a file while it is open. Returns whether no other process has locked it. Returns `true` on
/// network file systems without locks.
pub fn lock(file: &File) -> io::Result<bool> {
    match try_lock(file) {
        Err(error) if error.kind() == io::ErrorKind::Unsupported => Ok(true),
        locked => locked,
    }
}

fn try_lock(file: &File) -> io::Result<bool> {
    again(|| match file.try_lock() {
        Ok(()) => Ok(true),
        Err(TryLockError::WouldBlock) => Ok(false),
        Err(TryLockError::Error(error)) => Err(error),
    })
}

/// Returns whether `path` refers to this file, and not to a file that replaced it.
pub fn is_at(file: &File, path: &Path) -> bool {
    let number = |kind: fs::Metadata| (kind.dev(), kind.ino());
    let at_path = fs::symlink_metadata(path).map(number).ok();
    at_path.is_some() && at_path == file.metadata().map(number).ok()
}

/// Removes an unfinished file whose writer has died. A living writer holds its lock. Does nothing
/// if the lock cannot be tested.
pub fn remove_if_unlocked(path: &Path) -> Result<()> {
    let opened = File::options()
        .read(true)
        .write(true)
        .custom_flags((OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32)
        .open(path);
    match opened {
        Ok(file) if try_lock(&file).unwrap_or(false) && is_at(&file, path) => remove(path),
        _ => Ok(()),
    }
}

fn remove_if_there(path: &Path) -> io::Result<()> {
    match again(|| fs::remove_file(path)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// Renames a complete file. After a loss of power, `to` holds either this file or its earlier
/// content.
pub fn rename(file: &File, from: &Path, to: &Path) -> io::Result<()> {
    let mut interrupted = false;
    let renamed = again(|| {
        let renamed = fs::rename(from, to);
        interrupted |= matches!(&renamed, Err(e) if e.kind() == io::ErrorKind::Interrupted);
        renamed
    });
    match renamed {
        // On some file systems an interrupted call may still have taken effect.
        Err(error) if interrupted && error.kind() == io::ErrorKind::NotFound => {
            if is_at(file, to) {
                Ok(())
            } else {
                Err(error)
            }
        }
        renamed => renamed,
    }
}

/// Waits until the names in the folder of `path` are on the disk.
pub fn sync_folder_of(path: &Path) -> io::Result<()> {
    let folder = match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    match File::open(folder).and_then(|folder| folder.sync_all()) {
        // Some file systems do not support this, and some folders are writable but not readable.
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::InvalidInput | io::ErrorKind::PermissionDenied
            ) =>
        {
            Ok(())
        }
        synced => synced,
    }
}

/// Waits until all files on the file system of `folder` are on the disk, including files from
/// [`write_checked_later`].
pub fn sync_all(folder: &Path) -> Result<()> {
    let synced = File::open(folder).and_then(|file| again(|| Ok(rustix::fs::syncfs(&file)?)));
    synced.map_err(Error::io("write", folder))
}

/// Suffix of unfinished files that only one run writes.
pub const PART: &str = ".part";

/// Returns the name of a file while it is unfinished.
pub fn unfinished(path: &Path, end: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(end);
    path.with_file_name(name)
}

/// Writes to a temporary file in the folder of `path`, then renames it. An error leaves no file.
/// After a loss of power the file is complete or absent.
pub fn write(
    path: &Path,
    content: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<()> {
    in_place_of(path, PART, true, |out| {
        content(out).map_err(Error::io("write", path))
    })
}

/// Writes a file like [`write`], but without waiting for the disk. It is for thousands of files
/// whose checksum is stored elsewhere, or that [`sync_all`] waits for. `part` is the suffix of the
/// unfinished file. It must differ between runs that may write the file concurrently.
pub fn write_checked_later(path: &Path, bytes: &[u8], part: &str) -> Result<()> {
    in_place_of(path, part, false, |out| {
        out.write_all(bytes).map_err(Error::io("write", path))
    })
}

/// Writes a file like [`write`] with fallible content; `part` as for [`write_checked_later`].
pub fn write_in_steps<T>(
    path: &Path,
    part: &str,
    content: impl FnOnce(&mut BufWriter<File>) -> Result<T>,
) -> Result<T> {
    in_place_of(path, part, true, content)
}

fn in_place_of<T>(
    path: &Path,
    part: &str,
    wait: bool,
    content: impl FnOnce(&mut BufWriter<File>) -> Result<T>,
) -> Result<T> {
    let failed = || Error::io("write", path);
    let part = unfinished(path, part);
    let file = create_locked(&part).map_err(failed())?;
    let mut out = BufWriter::with_capacity(1 << 18, file);
    let written = content(&mut out).and_then(|done| {
        let finish = |out: &mut BufWriter<File>| {
            out.flush()?;
            if wait {
                out.get_ref().sync_data()?;
            }
            rename(out.get_ref(), &part, path)?;
            if wait { sync_folder_of(path) } else { Ok(()) }
        };
        finish(&mut out).map_err(failed())?;
        Ok(done)
    });
    if written.is_err() {
        // Best effort, because the first error is the one to report.
        let _ = remove_if_there(&part);
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

/// Writes an EXR file of `size` (columns, rows) with these channels.
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

/// Removes a file of an earlier run, if it exists.
pub fn remove(path: &Path) -> Result<()> {
    remove_if_there(path).map_err(Error::io("remove", path))
}

/// Returns the names in a folder. The result is empty if the folder does not exist.
///
/// # Errors
/// The path is a symbolic link.
pub fn names_in(folder: &Path) -> Result<Vec<OsString>> {
    let read = || -> io::Result<Vec<OsString>> {
        check_own_folder(folder)?;
        again(|| fs::read_dir(folder))?
            .map(|entry| Ok(entry?.file_name()))
            .collect()
    };
    match read() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Vec::new()),
        names => names.map_err(Error::io("read folder", folder)),
    }
}

/// Removes the files of an earlier run in `folder` whose names satisfy `is_one`.
#[cfg(feature = "service")]
pub fn remove_all(folder: &Path, is_one: impl Fn(&str) -> bool) -> Result<()> {
    for name in names_in(folder)? {
        if is_one(&name.to_string_lossy()) {
            remove(&folder.join(name))?;
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

    #[test]
    fn interrupted_calls_are_made_again_and_not_for_ever() {
        let interrupted = || io::Error::from(io::ErrorKind::Interrupted);
        for interruptions in [0, 1, TRIES - 1] {
            let mut calls = 0;
            let done = again(|| {
                calls += 1;
                if calls > interruptions {
                    Ok(calls)
                } else {
                    Err(interrupted())
                }
            });
            assert_eq!(done.unwrap(), interruptions + 1);
        }
        let mut calls = 0;
        let done = again(|| -> io::Result<()> {
            calls += 1;
            Err(interrupted())
        });
        assert_eq!(done.unwrap_err().kind(), io::ErrorKind::Interrupted);
        assert_eq!(calls, TRIES);
        let other = again(|| -> io::Result<()> { Err(io::ErrorKind::NotFound.into()) });
        assert_eq!(other.unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn a_file_in_the_making_goes_when_its_writer_has_died() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.part");
        let file = create_locked(&path).unwrap();
        remove_if_unlocked(&path).unwrap();
        assert!(path.exists(), "its writer lives");
        drop(file);
        remove_if_unlocked(&path).unwrap();
        assert!(!path.exists());
        // Covers an absent file, and a link to another location.
        remove_if_unlocked(&path).unwrap();
        fs::write(folder.path().join("mine"), "mine").unwrap();
        std::os::unix::fs::symlink("mine", &path).unwrap();
        remove_if_unlocked(&path).unwrap();
        drop(create_locked(&path).unwrap());
        assert_eq!(fs::read(folder.path().join("mine")).unwrap(), b"mine");
    }
}

//! Folder of the store: files by hash, and folders of jobs. Its file names are hashes and numbers
//! generated or validated by the service. Text from a client never becomes a path.

use super::job_folder::JobFolder;
use crate::error::{Error, Result};
use crate::run::files;
use crate::run::output_folder::LISTS;
use rustix::fs::{Mode, OFlags};
use std::ffi::OsStr;
use std::fs::{self, File, TryLockError};
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// Validated SHA-256 in lower-case hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
pub struct Hash(String);

impl Hash {
    /// Parses a hash. Returns `None` if the text is not a hash.
    pub fn parse(text: &str) -> Option<Hash> {
        let digit = |byte: u8| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
        (text.len() == 64 && text.bytes().all(digit)).then(|| Hash(text.to_owned()))
    }

    pub fn of(digest: &[u8]) -> Hash {
        Hash(digest.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// Returns the name by which scenes refer to the file.
    pub fn name(&self) -> String {
        format!("{PREFIX}{}", self.0)
    }

    pub fn digits(&self) -> &str {
        &self.0
    }
}

/// Prefix of a hash in a file name of a scene.
pub const PREFIX: &str = "sha256:";

/// Result file of a job.
#[derive(Debug, serde::Serialize, utoipa::ToSchema)]
pub struct ResultFile {
    /// Path relative to the results folder.
    #[schema(example = "cloud.ply")]
    pub name: String,
    /// Length in bytes.
    pub bytes: u64,
}

/// Folder of all data of the service.
pub struct Store {
    folder: PathBuf,
    /// Held for the lifetime of the service.
    _lock: File,
}

impl Store {
    /// Opens the store.
    ///
    /// # Errors
    /// `Error::Busy` if another service uses it.
    pub fn open(folder: &Path) -> Result<Store> {
        files::create_folder(folder)?;
        // Scenes and parts may be confidential, so only the user of the service has access.
        let own = fs::Permissions::from_mode(0o700);
        fs::set_permissions(folder, own).map_err(Error::io("protect", folder))?;
        let path = folder.join("lock");
        let lock = files::open_own_file(&path).map_err(Error::io("open", &path))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(Error::Busy(folder.to_owned())),
            Err(TryLockError::Error(error)) => return Err(Error::io("lock", &path)(error)),
        }
        files::create_own_folder(&folder.join("files"))?;
        files::create_own_folder(&folder.join("jobs"))?;
        // Incomplete uploads to an earlier service.
        files::remove_all(&folder.join("files"), |name| name.ends_with(files::PART))?;
        Ok(Store {
            folder: folder.to_owned(),
            _lock: lock,
        })
    }

    /// Returns the path of a file, whether or not it exists.
    pub fn file(&self, hash: &Hash) -> PathBuf {
        self.folder.join("files").join(hash.digits())
    }

    pub fn job(&self, id: &str) -> JobFolder {
        JobFolder(self.folder.join("jobs").join(id))
    }

    /// Reserves disk space for the tables of the service, which it must write when jobs have filled
    /// the disk. Best effort: the space is reserved again as soon as there is enough.
    pub fn reserve_disk(&self) {
        let path = self.folder.join("room");
        if !path.exists() {
            let _ = files::write_bytes(&path, &[1; 1 << 20]);
        }
    }

    /// Releases the reserved space, so that the service can write to a full disk.
    pub fn release_disk(&self) {
        let _ = files::remove(&self.folder.join("room"));
    }

    /// Returns the free disk space in bytes; `None` if the system does not report it.
    pub fn free(&self) -> Option<u64> {
        let all = rustix::fs::statvfs(&self.folder).ok()?;
        Some(all.f_bavail * all.f_frsize)
    }

    /// Creates the folder of a job with its inputs. `text` becomes the file `name`. The files that
    /// the job reads are linked by hash and by the names given by the client.
    pub fn make_job(
        &self,
        id: &str,
        name: &Path,
        text: &[u8],
        files_read: &[Hash],
        named: &[(String, Hash)],
    ) -> Result<()> {
        let job = self.job(id);
        files::create_own_folder(&job.0)?;
        files::create_own_folder(&job.inputs())?;
        files::write_bytes(name, text)?;
        let by_hash = files_read.iter().map(|hash| (hash.name(), hash));
        let by_name = named.iter().map(|(name, hash)| (name.clone(), hash));
        for (name, hash) in by_hash.chain(by_name) {
            let path = job.inputs().join(name);
            match fs::hard_link(self.file(hash), &path) {
                Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
                    return Err(Error::io("link", &path)(error));
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Opens a result file of a job. The path is resolved component by component without following
    /// links.
    pub fn open_result(&self, id: &str, path: &str) -> io::Result<File> {
        let wrong =
            |name: &str| name.is_empty() || name == "." || name == ".." || name.contains('\0');
        let names: Vec<&str> = path.split('/').collect();
        if names.iter().any(|name| wrong(name)) {
            return Err(io::ErrorKind::NotFound.into());
        }
        let mut at = File::open(self.job(id).out())?;
        for (i, name) in names.iter().enumerate() {
            let kind = match i + 1 < names.len() {
                true => OFlags::DIRECTORY,
                // Opening a pipe would block.
                false => OFlags::NONBLOCK,
            };
            let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::CLOEXEC | kind;
            at = rustix::fs::openat(&at, OsStr::new(name), flags, Mode::empty())?.into();
        }
        match at.metadata()?.is_file() {
            true => Ok(at),
            false => Err(io::ErrorKind::NotFound.into()),
        }
    }

    /// Returns the complete result files of a job, sorted by name.
    pub fn results(&self, id: &str) -> Vec<ResultFile> {
        let mut found = Vec::new();
        list(&self.job(id).out(), "", &mut found);
        found.sort_by(|a, b| a.name.cmp(&b.name));
        found
    }
}

fn list(folder: &Path, before: &str, found: &mut Vec<ResultFile>) {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    for entry in entries {
        let (Ok(kind), Ok(name)) = (entry.file_type(), entry.file_name().into_string()) else {
            continue;
        };
        if name == LISTS {
            continue;
        }
        let name = format!("{before}{name}");
        if kind.is_dir() {
            list(&entry.path(), &format!("{name}/"), found);
        } else if kind.is_file() && !name.ends_with(files::PART) {
            let bytes = entry.metadata().map_or(0, |data| data.len());
            found.push(ResultFile { name, bytes });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_below_the_results_are_opened_and_no_links() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let out = store.job("1").out();
        fs::create_dir_all(out.join("frames")).unwrap();
        fs::write(out.join("frames/a.png"), "a").unwrap();
        fs::create_dir(store.job("1").inputs()).unwrap();
        fs::write(store.job("1").scene(), "secret").unwrap();
        std::os::unix::fs::symlink("../in/scene.toml", out.join("link")).unwrap();
        std::os::unix::fs::symlink("..", out.join("up")).unwrap();
        assert!(store.open_result("1", "frames/a.png").is_ok());
        for path in [
            "../in/scene.toml",
            "frames/../../in/scene.toml",
            "link",
            "up/in/scene.toml",
            "frames",
            "",
            "/etc/passwd",
            "frames//a.png",
            "./frames/a.png",
            "a\0b",
        ] {
            assert!(store.open_result("1", path).is_err(), "{path:?}");
        }
        let names: Vec<String> = store.results("1").into_iter().map(|f| f.name).collect();
        assert_eq!(names, ["frames/a.png"]);
    }

    #[test]
    fn only_its_user_may_look_into_a_store() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("store");
        fs::create_dir(&path).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        let _store = Store::open(&path).unwrap();
        assert_eq!(
            fs::metadata(&path).unwrap().permissions().mode() & 0o777,
            0o700
        );
    }

    #[test]
    fn a_hash_is_64_lower_case_digits() {
        let good = "0123456789abcdef".repeat(4);
        assert_eq!(Hash::parse(&good).unwrap().name(), format!("sha256:{good}"));
        for bad in [
            "",
            "../../etc/passwd",
            &good[1..],
            &good.to_uppercase(),
            &format!("{good}0"),
        ] {
            assert!(Hash::parse(bad).is_none(), "{bad}");
        }
    }

    #[test]
    fn a_store_has_one_service() {
        let folder = tempfile::tempdir().unwrap();
        let first = Store::open(folder.path()).unwrap();
        assert!(matches!(Store::open(folder.path()), Err(Error::Busy(_))));
        drop(first);
        Store::open(folder.path()).unwrap();
    }
}

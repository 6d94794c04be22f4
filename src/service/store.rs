//! The store's folder: files by their hash, folders of jobs. Names in it are hashes and numbers that the
//! service made or checked; nothing that a client wrote becomes a path.

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

/// A SHA-256 in lower-case hexadecimal digits, checked.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
pub struct Hash(String);

impl Hash {
    /// `None`: the text is none.
    pub fn parse(text: &str) -> Option<Hash> {
        let digit = |byte: u8| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
        (text.len() == 64 && text.bytes().all(digit)).then(|| Hash(text.to_owned()))
    }

    pub fn of(digest: &[u8]) -> Hash {
        Hash(digest.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// How a scene names the file.
    pub fn name(&self) -> String {
        format!("{PREFIX}{}", self.0)
    }

    pub fn digits(&self) -> &str {
        &self.0
    }
}

/// Before the hash in the name of a file.
pub const PREFIX: &str = "sha256:";

/// A file of a job's results.
#[derive(Debug, serde::Serialize, utoipa::ToSchema)]
pub struct ResultFile {
    /// Path below the results.
    #[schema(example = "cloud.ply")]
    pub name: String,
    /// Length.
    pub bytes: u64,
}

/// The folder of all that the service keeps.
pub struct Store {
    folder: PathBuf,
    /// Held while the service lives.
    _lock: File,
}

impl Store {
    /// # Errors
    /// `Error::Busy`: another service has it.
    pub fn open(folder: &Path) -> Result<Store> {
        files::create_folder(folder)?;
        // Scenes and parts may be confidential: only the service's user reads them.
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
        // What was being sent when an earlier service ended.
        files::remove_all(&folder.join("files"), |name| name.ends_with(files::PART))?;
        Ok(Store {
            folder: folder.to_owned(),
            _lock: lock,
        })
    }

    /// Where a file is, or will be.
    pub fn file(&self, hash: &Hash) -> PathBuf {
        self.folder.join("files").join(hash.digits())
    }

    pub fn job(&self, id: &str) -> JobFolder {
        JobFolder(self.folder.join("jobs").join(id))
    }

    /// Keeps some room for what the service itself must write when jobs have filled the disk. Best effort: it
    /// is kept again as soon as there is some.
    pub fn keep_room(&self) {
        let path = self.folder.join("room");
        if !path.exists() {
            let _ = files::write_bytes(&path, &[1; 1 << 20]);
        }
    }

    /// Lets the service write, now that the disk is full.
    pub fn give_room(&self) {
        let _ = files::remove(&self.folder.join("room"));
    }

    /// Bytes that may still be written; `None` where the system does not say.
    pub fn free(&self) -> Option<u64> {
        let all = rustix::fs::statvfs(&self.folder).ok()?;
        Some(all.f_bavail * all.f_frsize)
    }

    /// Makes a job's folder with its inputs: `text` as the file `name`, and links to the files that it
    /// reads, by hash and by the names that the client gave to them.
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

    /// Opens a file of a job's results, whose path has only names, step by step and through no link.
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
                // A pipe would wait.
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

    /// The files of a job's results that are whole, by name.
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

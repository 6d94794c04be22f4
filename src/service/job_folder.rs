//! A job's folder: what the service and the process that does the job say to each other. Files alone, so that
//! a service that was killed finds, when it starts again, what became of its jobs.
//!
//! ```text
//! job.json       what to run, with which limits
//! lock           locked while the job's process lives, whose number it holds
//! progress.json  how far it is
//! result.json    what the command prints with --json
//! outcome.json   how it ended; not there if it died
//! in/            the scene and the files that it names: all that its process may read
//! out/           what the command writes
//! ```

use crate::error::{Error, Result};
use crate::run::files;
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::fs::{self, File, TryLockError};
use std::io::Write;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::thread::sleep;
use std::time::Duration;

/// What a job may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Limits {
    /// Bytes of address space.
    pub memory: u64,
    /// Seconds from its start, and as many of each thread's work.
    pub seconds: u64,
    /// Bytes of a file it writes.
    pub file: u64,
    /// Threads.
    pub threads: u16,
}

/// What a job's process is to do.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Task {
    /// Of the command line, without the program's name.
    pub arguments: Vec<String>,
    /// On all of it.
    pub limits: Limits,
}

/// How a job's process ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Outcome {
    /// As the command line gives it.
    pub exit_code: u8,
    /// Whether it was only interrupted, or found the disk full, and is to go on later.
    pub again: bool,
    /// The disk was full.
    pub full: bool,
    /// What a limit says; else result.json says it.
    pub message: Option<String>,
}

/// How far a job is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Progress {
    /// Steps that are done.
    pub done: u64,
    /// Steps there are.
    pub of: u64,
    /// What a step is.
    #[schema(example = "frames")]
    pub what: String,
}

/// A job's folder.
#[derive(Debug, Clone)]
pub struct JobFolder(pub PathBuf);

/// Bytes of a command's result that a job's page shows: lists have a hundred of them.
const LARGEST_RESULT: u64 = 64 << 10;
/// Bytes kept for the outcome while there is room on the disk.
const OUTCOME_BYTES: usize = 1024;

impl JobFolder {
    /// Folder of the files that the client sent; a path in one of them leads nowhere else.
    pub fn inputs(&self) -> PathBuf {
        self.0.join("in")
    }

    pub fn scene(&self) -> PathBuf {
        self.inputs().join("scene.toml")
    }

    pub fn rays(&self) -> PathBuf {
        self.0.join("rays.json")
    }

    pub fn out(&self) -> PathBuf {
        self.0.join("out")
    }

    /// Folder of the live view of the job's scene.
    pub fn view(&self) -> JobFolder {
        JobFolder(self.0.join("view"))
    }

    pub fn result_file(&self) -> PathBuf {
        self.0.join("result.json")
    }

    pub fn log_file(&self) -> PathBuf {
        self.0.join("log.txt")
    }

    pub fn write_task(&self, task: &Task) -> Result<()> {
        files::write_json(&self.0.join("job.json"), task)
    }

    pub fn task(&self) -> Result<Task> {
        let path = self.0.join("job.json");
        let bytes = fs::read(&path).map_err(Error::io("read", &path))?;
        serde_json::from_slice(&bytes)
            .map_err(|error| Error::Usage(format!("{}: {error}", path.display())))
    }

    /// Returns the output of the command; `None` if it has more than 64 KiB.
    pub fn result(&self) -> Option<serde_json::Value> {
        let length = fs::metadata(self.result_file()).ok()?.len();
        (length <= LARGEST_RESULT).then(|| self.read("result.json"))?
    }

    pub fn progress(&self) -> Option<Progress> {
        self.read("progress.json")
    }

    pub fn write_progress(&self, progress: &Progress) {
        let bytes = serde_json::to_vec(progress).expect("progress is JSON");
        // It is only looked at: a job does not fail for it.
        let _ = files::write_checked_later(&self.0.join("progress.json"), &bytes, files::PART);
    }

    pub fn outcome(&self) -> Option<Outcome> {
        self.read("outcome.json")
    }

    fn read<T: DeserializeOwned>(&self, name: &str) -> Option<T> {
        serde_json::from_slice(&fs::read(self.0.join(name)).ok()?).ok()
    }

    pub fn forget_outcome(&self) -> Result<()> {
        files::remove(&self.0.join("outcome.json"))
    }

    /// Room for the outcome, taken before the work so that a full disk can be said.
    pub fn reserve_outcome(&self) -> Result<File> {
        let path = self.0.join("outcome.json.part");
        let failed = || Error::io("write", &path);
        files::remove(&path)?;
        let mut file = File::create_new(&path).map_err(failed())?;
        file.write_all(&[b' '; OUTCOME_BYTES]).map_err(failed())?;
        file.sync_data().map_err(failed())?;
        Ok(file)
    }

    /// Into the room that [`Self::reserve_outcome`] took.
    pub fn write_outcome(&self, reserved: &File, outcome: &Outcome) {
        let text = serde_json::to_string(outcome).expect("an outcome is JSON");
        let padded = format!("{text:<OUTCOME_BYTES$}");
        let written = reserved
            .write_all_at(padded.as_bytes(), 0)
            .and_then(|()| reserved.sync_data());
        if written.is_ok() {
            let (part, whole) = ("outcome.json.part", "outcome.json");
            // Without it the job is taken for one that died, and runs again.
            let _ = fs::rename(self.0.join(part), self.0.join(whole));
        }
    }

    /// Locks the folder for this process as long as the file lives.
    ///
    /// # Errors
    /// `Error::Busy`: another process does the job.
    pub fn lock(&self) -> Result<File> {
        let path = self.0.join("lock");
        let file = files::open_own_file(&path).map_err(Error::io("open", &path))?;
        // More than once: who only asks holds it for a moment.
        for last in [false, false, false, false, true] {
            match file.try_lock() {
                Ok(()) => break,
                Err(TryLockError::WouldBlock) if last => return Err(Error::Busy(self.0.clone())),
                Err(TryLockError::WouldBlock) => sleep(Duration::from_millis(50)),
                Err(TryLockError::Error(error)) => return Err(Error::io("lock", &path)(error)),
            }
        }
        let number = format!("{:>10}", std::process::id());
        let written = file.write_all_at(number.as_bytes(), 0);
        written.map_err(Error::io("write", &path))?;
        Ok(file)
    }

    /// Whether a process does the job.
    pub fn is_locked(&self) -> bool {
        let Ok(file) = File::open(self.0.join("lock")) else {
            return false;
        };
        // Shared, so that asking is never taken for the job's own lock.
        matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
    }

    /// Sends a signal to the process that does the job, if there is one.
    pub fn signal(&self, signal: Signal) {
        let number = fs::read_to_string(self.0.join("lock")).ok();
        let number = number.and_then(|text| text.trim().parse().ok());
        let Some(process) = number.and_then(Pid::from_raw) else {
            return;
        };
        let Ok(process) = pidfd_open(process, PidfdFlags::empty()) else {
            return;
        };
        // Still locked: the number was not given to another process in between.
        if self.is_locked() {
            let _ = pidfd_send_signal(process, signal);
        }
    }

    /// Removes the folder and all in it.
    pub fn remove(&self) -> Result<()> {
        match fs::remove_dir_all(&self.0) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(Error::io("remove", &self.0)(error))
            }
            _ => Ok(()),
        }
    }
}

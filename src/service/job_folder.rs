//! Folder of a job: the interface between the service and the process that executes the job. It
//! consists of files only, so a service that restarts after a crash finds the state of its jobs.
//!
//! ```text
//! job.json       command to run and its limits
//! lock           locked while the job's process lives; contains its process id
//! progress.json  progress
//! result.json    output of the command with --json
//! outcome.json   how the process ended; missing if it crashed
//! in/            the scene and its files: all that the process may read
//! out/           output of the command
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

/// Resource limits of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobLimits {
    /// Address space, bytes.
    pub memory: u64,
    /// Wall-clock time from the start, s. The CPU time is limited to this value times the number of
    /// threads.
    pub seconds: u64,
    /// Size of an output file, bytes.
    pub file: u64,
    /// Number of threads.
    pub threads: u16,
}

/// Task of a job's process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobTask {
    /// Command-line arguments without the program name.
    pub arguments: Vec<String>,
    /// Limits for the complete task.
    pub limits: JobLimits,
}

/// Outcome of a job's process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobOutcome {
    /// Exit code of the command.
    pub exit_code: u8,
    /// True if the job was interrupted or found the disk full, and is to continue later.
    pub again: bool,
    /// True if the disk was full.
    pub full: bool,
    /// Message if a limit was reached or the disk was full; otherwise result.json contains the
    /// message.
    pub message: Option<String>,
}

/// Progress of a job.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Progress {
    /// Number of completed steps.
    pub done: u64,
    /// Total number of steps.
    pub of: u64,
    /// Unit of a step.
    #[schema(example = "frames")]
    pub what: String,
}

/// Folder of a job.
#[derive(Debug, Clone)]
pub struct JobFolder(pub PathBuf);

/// Maximum size of a command's result on the page of a job, bytes. A list contains up to a hundred
/// of them.
const LARGEST_RESULT: u64 = 64 << 10;
/// Bytes reserved on disk for the outcome.
const OUTCOME_BYTES: usize = 1024;

impl JobFolder {
    /// Returns the folder of the files sent by the client. Paths in these files cannot leave the
    /// folder.
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

    /// Returns the folder of the live view of the job's scene.
    pub fn view(&self) -> JobFolder {
        JobFolder(self.0.join("view"))
    }

    pub fn result_file(&self) -> PathBuf {
        self.0.join("result.json")
    }

    pub fn log_file(&self) -> PathBuf {
        self.0.join("log.txt")
    }

    pub fn write_task(&self, task: &JobTask) -> Result<()> {
        files::write_json(&self.0.join("job.json"), task)
    }

    pub fn task(&self) -> Result<JobTask> {
        let path = self.0.join("job.json");
        let bytes = fs::read(&path).map_err(Error::io("read", &path))?;
        serde_json::from_slice(&bytes)
            .map_err(|error| Error::Usage(format!("{}: {error}", path.display())))
    }

    /// Returns the output of the command; `None` if it exceeds 64 KiB.
    pub fn result(&self) -> Option<serde_json::Value> {
        let length = fs::metadata(self.result_file()).ok()?.len();
        (length <= LARGEST_RESULT).then(|| self.read("result.json"))?
    }

    pub fn progress(&self) -> Option<Progress> {
        self.read("progress.json")
    }

    pub fn write_progress(&self, progress: &Progress) {
        let bytes = serde_json::to_vec(progress).expect("progress is JSON");
        // Progress is informational, so a job does not fail if it cannot be written.
        let _ = files::write_checked_later(&self.0.join("progress.json"), &bytes, files::PART);
    }

    pub fn outcome(&self) -> Option<JobOutcome> {
        self.read("outcome.json")
    }

    fn read<T: DeserializeOwned>(&self, name: &str) -> Option<T> {
        serde_json::from_slice(&fs::read(self.0.join(name)).ok()?).ok()
    }

    pub fn forget_outcome(&self) -> Result<()> {
        files::remove(&self.0.join("outcome.json"))
    }

    /// Reserves disk space for the outcome before the work starts, so that a full disk can be
    /// reported.
    pub fn reserve_outcome(&self) -> Result<File> {
        let path = self.0.join("outcome.json.part");
        let failed = || Error::io("write", &path);
        files::remove(&path)?;
        let mut file = File::create_new(&path).map_err(failed())?;
        file.write_all(&[b' '; OUTCOME_BYTES]).map_err(failed())?;
        file.sync_data().map_err(failed())?;
        Ok(file)
    }

    /// Writes the outcome into the space reserved by [`Self::reserve_outcome`].
    pub fn write_outcome(&self, reserved: &File, outcome: &JobOutcome) {
        let text = serde_json::to_string(outcome).expect("an outcome is JSON");
        let padded = format!("{text:<OUTCOME_BYTES$}");
        let written = reserved
            .write_all_at(padded.as_bytes(), 0)
            .and_then(|()| reserved.sync_data());
        if written.is_ok() {
            let (part, whole) = ("outcome.json.part", "outcome.json");
            // Without this file, the process is regarded as crashed and the job runs again.
            let _ = fs::rename(self.0.join(part), self.0.join(whole));
        }
    }

    /// Locks the folder for this process for the lifetime of the returned file.
    ///
    /// # Errors
    /// `Error::Busy` if another process executes the job.
    pub fn lock(&self) -> Result<File> {
        let path = self.0.join("lock");
        let file = files::open_own_file(&path).map_err(Error::io("open", &path))?;
        // Retried, because a process that checks the lock holds it for a moment.
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

    /// Returns true if a process executes the job.
    pub fn is_locked(&self) -> bool {
        let Ok(file) = File::open(self.0.join("lock")) else {
            return false;
        };
        // A shared lock, so that this check is never taken for the lock of the job.
        matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
    }

    /// Sends a signal to the process that executes the job, if there is one.
    pub fn signal(&self, signal: Signal) {
        let number = fs::read_to_string(self.0.join("lock")).ok();
        let number = number.and_then(|text| text.trim().parse().ok());
        let Some(process) = number.and_then(Pid::from_raw) else {
            return;
        };
        let Ok(process) = pidfd_open(process, PidfdFlags::empty()) else {
            return;
        };
        // The folder is still locked, so the process id has not been reused.
        if self.is_locked() {
            let _ = pidfd_send_signal(process, signal);
        }
    }

    /// Removes the folder and its contents.
    pub fn remove(&self) -> Result<()> {
        match fs::remove_dir_all(&self.0) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(Error::io("remove", &self.0)(error))
            }
            _ => Ok(()),
        }
    }
}

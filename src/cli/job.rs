//! Process of a job of the service. It executes a command of the command line under resource limits
//! and writes the outcome to the folder of the job.

use super::{Cli, say};
use crate::error::{Error, Result};
use crate::service::{JobFolder, JobLimits, JobOutcome, Progress};
use clap::Parser;
use indicatif::ProgressBar;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use signal_hook::low_level;
use std::fs::File;
use std::io::ErrorKind::{QuotaExceeded, StorageFull};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// Progress bars of the command and the units of their steps; `None` if the process is not a job.
static BARS: Mutex<Option<Vec<(ProgressBar, String)>>> = Mutex::new(None);

/// Interval between updates of the progress file.
const LOOK: Duration = Duration::from_millis(200);

/// Reports the progress of this bar as the progress of the job, if the process is a job.
pub fn follow(bar: &ProgressBar, of: &str) {
    if let Some(bars) = &mut *BARS.lock().unwrap_or_else(PoisonError::into_inner) {
        bars.push((bar.clone(), of.to_owned()));
    }
}

/// Executes the job in the current folder. Returns the exit code of its command.
pub fn run() -> u8 {
    let folder = JobFolder(".".into());
    let done = folder.lock().and_then(|lock| {
        let code = work(&folder)?;
        drop(lock);
        Ok(code)
    });
    done.unwrap_or_else(|error| {
        say(&error.to_string());
        error.exit_code()
    })
}

fn work(folder: &JobFolder) -> Result<u8> {
    let reserved = folder.reserve_outcome()?;
    let task = folder.task()?;
    limit(&task.limits)?;
    let arguments = ["lasertrace", "--json"].map(str::to_owned);
    let arguments = arguments.into_iter().chain(task.arguments);
    *BARS.lock().unwrap_or_else(PoisonError::into_inner) = Some(Vec::new());
    let end = Instant::now() + Duration::from_secs(task.limits.seconds);
    let (watched, reserved_too) = (folder.clone(), reserved.try_clone());
    let reserved_too = reserved_too.map_err(Error::io("open", &folder.0))?;
    let watch = thread::Builder::new().name("watch".to_owned());
    watch
        .spawn(move || watch_over(&watched, &reserved_too, end, task.limits.seconds))
        .map_err(|error| Error::Exhausted(format!("cannot start: {error}")))?;
    let outcome = match Cli::try_parse_from(arguments) {
        Ok(cli) => {
            let done = super::dispatch(cli);
            let full = matches!(&done, Err(Some(Error::Io { source, .. }))
                if matches!(source.kind(), StorageFull | QuotaExceeded));
            JobOutcome {
                exit_code: super::exit_code(&done),
                again: full || matches!(done, Err(Some(Error::Interrupted | Error::Busy(_)))),
                full,
                // The error output of the command may be missing on a full disk.
                message: match &done {
                    Err(Some(error)) if full => Some(error.to_string()),
                    _ => None,
                },
            }
        }
        Err(error) => JobOutcome {
            exit_code: 64,
            again: false,
            full: false,
            message: error.to_string().lines().next().map(str::to_owned),
        },
    };
    write(folder, &reserved, &outcome);
    Ok(outcome.exit_code)
}

/// Writes the outcome of the job; only the first call has an effect.
fn write(folder: &JobFolder, reserved: &File, outcome: &JobOutcome) {
    static ONCE: Mutex<bool> = Mutex::new(false);
    let mut written = ONCE.lock().unwrap_or_else(PoisonError::into_inner);
    if !*written {
        *written = true;
        folder.write_outcome(reserved, outcome);
    }
}

/// Writes the progress of the job periodically. Ends the process when the time limit is reached.
fn watch_over(folder: &JobFolder, reserved: &File, end: Instant, seconds: u64) {
    let mut noted = None;
    while Instant::now() < end {
        thread::sleep(LOOK.min(end.saturating_duration_since(Instant::now())));
        let progress = progress();
        if progress != noted
            && let Some(progress) = &progress
        {
            folder.write_progress(progress);
        }
        noted = progress.or(noted);
    }
    let outcome = JobOutcome {
        exit_code: 75,
        again: false,
        full: false,
        message: Some(format!(
            "the job took longer than the {seconds} s that it may"
        )),
    };
    write(folder, reserved, &outcome);
    low_level::exit(75);
}

/// Returns the progress of the last active bar.
fn progress() -> Option<Progress> {
    let bars = BARS.lock().unwrap_or_else(PoisonError::into_inner);
    let moves = |(bar, _): &&(ProgressBar, String)| !bar.is_finished() && bar.position() > 0;
    let (bar, what) = bars.as_ref()?.iter().rfind(moves)?;
    Some(Progress {
        done: bar.position(),
        of: bar.length()?,
        what: what.clone(),
    })
}

/// Applies resource limits to this process, and therefore to the job.
fn limit(limits: &JobLimits) -> Result<()> {
    let work = limits.seconds.saturating_mul(limits.threads.into());
    let values = [
        (Resource::As, limits.memory),
        (Resource::Cpu, work),
        (Resource::Fsize, limits.file),
        (Resource::Core, 0),
    ];
    for (resource, value) in values {
        // Limits cannot exceed the maximum that the system grants to this user.
        let granted = getrlimit(resource).maximum.unwrap_or(u64::MAX);
        let value = Some(value.min(granted));
        let limit = Rlimit {
            current: value,
            maximum: value,
        };
        setrlimit(resource, limit)
            .map_err(|error| Error::io("limit", "this process".as_ref())(error.into()))?;
    }
    Ok(())
}

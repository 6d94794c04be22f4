//! Executes queued jobs, a limited number in parallel, each in a separate process. The result is
//! read from the folder of the job, so a restarted service continues with its jobs.

use super::job_folder::{JobFolder, JobOutcome, JobTask};
use super::jobs::{Job, JobState, Kind};
use super::refusal::HttpError;
use super::shared::Service;
use super::slots::ROOM;
use super::upload::on_disk;
use crate::error::{Error, Result};
use rustix::process::Signal;
use std::fs::File;
use std::future::Future;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;
use tokio::process::{Child, Command};
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::sleep;
use tracing::{info, warn};

/// Number of processes of a job that may end without an outcome before the job counts as failed.
const DEATHS: u32 = 3;
/// Time after its limit in which the process of a job must end on its own.
const GRACE: Duration = Duration::from_secs(10);
/// Polling interval for a process that is not a child of this one.
const LOOK: Duration = Duration::from_millis(100);
/// Environment variable with the token.
pub const TOKEN_VARIABLE: &str = "LASERTRACE_TOKEN";

/// Starts jobs for the lifetime of the service. First it resumes the jobs that were running when an
/// earlier service ended.
pub async fn schedule(service: Arc<Service>) {
    let cancelled = again(|| service.jobs.in_state(JobState::Cancelled)).await;
    let running = again(|| service.jobs.in_state(JobState::Running)).await;
    for job in cancelled.into_iter().chain(running) {
        info!(job = job.id, "taken up again");
        let slot = service.slots.places.clone().acquire_owned().await;
        tokio::spawn(work(
            service.clone(),
            job,
            slot.expect("slots are not closed"),
        ));
    }
    loop {
        let slot = service.slots.places.clone().acquire_owned().await;
        let slot = slot.expect("slots are not closed");
        let job = loop {
            let stopping = service.slots.stopping.load(Relaxed);
            if !stopping && service.slots.has_room(service.store.free()) {
                service.store.reserve_disk();
                match service.jobs.take().await {
                    Ok(Some(job)) => break job,
                    Ok(None) => {}
                    Err(refusal) => warn!("cannot take a job: {}", refusal.message),
                }
            }
            tokio::select! {
                () = service.slots.news.notified() => {}
                () = sleep(Duration::from_secs(1)) => {}
            }
        };
        tokio::spawn(work(service.clone(), job, slot));
    }
}

/// Repeats an operation on the table until the disk permits it.
async fn again<T, F: Future<Output = std::result::Result<T, HttpError>>>(ask: impl Fn() -> F) -> T {
    loop {
        match ask().await {
            Ok(done) => return done,
            Err(refusal) => warn!("the table of jobs: {}", refusal.message),
        }
        sleep(Duration::from_secs(1)).await;
    }
}

/// How the process of a job ended.
enum Left {
    Outcome(JobOutcome),
    /// The process ended without an outcome. The exit status is known if it was a child of this
    /// service.
    Died(Option<std::process::ExitStatus>),
    /// Killed because it exceeded its time limit.
    Killed,
}

/// Executes a job until it ends or returns to the queue.
async fn work(service: Arc<Service>, job: Job, slot: OwnedSemaphorePermit) {
    let folder = service.store.job(&job.id);
    let left = match job.state {
        JobState::Cancelled => {
            stop(&folder).await;
            None
        }
        _ => Some(run(&service, &job, &folder).await),
    };
    // A service that shuts down does not change the state of the job. The next service reads the
    // outcome.
    if service.slots.stopping.load(Relaxed) {
        return;
    }
    let kept = match left {
        None => false,
        Some(left) => conclude(&service, &job, &folder, left).await,
    };
    if !kept {
        info!(job = job.id, "deleted");
        remove(&folder).await;
        again(|| service.jobs.remove(&job.id)).await;
    }
    drop(slot);
    service.slots.wake();
}

/// Removes the folder of a job; ends a view of its scene first.
pub async fn remove(folder: &JobFolder) {
    stop(&folder.view()).await;
    let folder = folder.clone();
    if let Err(error) = on_disk(move || folder.remove()).await {
        warn!("{error}");
    }
}

async fn run(service: &Arc<Service>, job: &Job, folder: &JobFolder) -> Result<Left> {
    // A process started by an earlier service may still run or may have ended.
    while folder.is_locked() {
        sleep(LOOK).await;
    }
    if let Some(outcome) = folder.outcome().filter(|outcome| !outcome.again) {
        return Ok(Left::Outcome(outcome));
    }
    let body = again(|| service.jobs.body(&job.id)).await;
    let task = task(service, &job.request);
    let limits = task.limits;
    {
        let (service, job) = (service.clone(), job.clone());
        on_disk(move || prepare(&service, &job, &body)).await?;
    }
    let mut child = start(service, folder, &task, false)?;
    service.slots.started.fetch_add(1, Relaxed);
    let starts = again(|| service.jobs.count(&job.id, false)).await;
    info!(job = job.id, kind = ?job.request.kind, starts, process = child.id(), "started");
    // The job was deleted before it had a process that could receive a signal.
    if again(|| service.jobs.get(&job.id))
        .await
        .is_none_or(|job| job.state == JobState::Cancelled)
    {
        let _ = child.start_kill();
    }
    let longest = Duration::from_secs(limits.seconds) + GRACE;
    let status = match tokio::time::timeout(longest, child.wait()).await {
        Ok(status) => status.ok(),
        Err(_) => {
            let _ = child.kill().await;
            return Ok(Left::Killed);
        }
    };
    Ok(match folder.outcome() {
        Some(outcome) => Left::Outcome(outcome),
        None => Left::Died(status),
    })
}

/// Creates the folder of the job with its inputs.
fn prepare(service: &Service, job: &Job, body: &[u8]) -> Result<()> {
    let folder = service.store.job(&job.id);
    let text = match job.request.kind {
        Kind::Rays => folder.rays(),
        _ => folder.scene(),
    };
    service
        .store
        .make_job(&job.id, &text, body, &job.request.files, &job.request.named)
}

/// Starts a process that executes a task in its folder. Its output goes to files there. If
/// `ends_with_service`, the process is killed when the service ends.
pub fn start(
    service: &Service,
    folder: &JobFolder,
    task: &JobTask,
    ends_with_service: bool,
) -> Result<Child> {
    folder.forget_outcome()?;
    folder.write_task(task)?;
    let open = |path: PathBuf| {
        crate::run::files::remove(&path)?;
        File::create_new(&path).map_err(Error::io("write", &path))
    };
    let program = service.settings.program.clone();
    Command::new(&program)
        .arg("job")
        .current_dir(&folder.0)
        .stdin(Stdio::null())
        .stdout(open(folder.result_file())?)
        .stderr(open(folder.log_file())?)
        .env_remove(TOKEN_VARIABLE)
        .kill_on_drop(ends_with_service)
        .spawn()
        .map_err(Error::io("start", program.as_ref()))
}

/// Returns the task of a job: the command that a user would run in the folder of the job.
fn task(service: &Service, request: &super::jobs::Request) -> JobTask {
    let words = |text: &str| text.split(' ').map(str::to_owned).collect::<Vec<String>>();
    let mut arguments = match request.kind {
        Kind::Frame => words(&format!(
            "render in/scene.toml --frame {} -o out",
            request.frame
        )),
        Kind::Scan => words("scan in/scene.toml -o out --resume"),
        Kind::Profiles => words("scan in/scene.toml -o out --resume --geometry-only"),
        Kind::Sweep => words("sweep in/scene.toml -o out"),
        Kind::Rays => {
            let (mesh, unit) = request.mesh.as_ref().expect("rays have a mesh");
            let mut arguments = words(&format!("rays in/{} rays.json -o out", mesh.name()));
            arguments.extend(unit.iter().map(|unit| format!("--unit={unit}")));
            arguments
        }
    };
    if let Some(frames) = &request.frames {
        arguments.push(format!("--frames={}..{}", frames.start, frames.end));
    }
    if !request.also.is_empty() {
        arguments.push(format!("--also={}", request.also.join(",")));
    }
    let limits = service.settings.limits;
    arguments.push(format!("--threads={}", limits.threads));
    JobTask { arguments, limits }
}

/// Records the outcome of a job. Returns false if the job was deleted meanwhile.
async fn conclude(service: &Service, job: &Job, folder: &JobFolder, left: Result<Left>) -> bool {
    let (state, code, message) = match left {
        Ok(Left::Outcome(outcome)) if outcome.again => {
            let said = outcome.message.or_else(|| said(folder));
            waits(service, said, outcome.full)
        }
        Ok(Left::Outcome(outcome)) => {
            let state = match outcome.exit_code {
                0 => JobState::Done,
                _ => JobState::Failed,
            };
            let message = outcome.message.or_else(|| said(folder));
            (state, Some(outcome.exit_code), message)
        }
        // The process ends this way if the disk has no space even for its outcome.
        Ok(Left::Died(Some(status))) if status.code() == Some(75) && is_full(service) => {
            waits(service, None, true)
        }
        // The system refused memory. A retry would fail again, so the job is marked as failed.
        Ok(Left::Died(Some(status))) if status.code() == Some(75) && said(folder).is_none() => {
            let megabytes = service.settings.limits.memory / 1_000_000;
            let message =
                format!("the job took more than the {megabytes} MB of memory that it may");
            (JobState::Failed, Some(75), Some(message))
        }
        Ok(Left::Died(Some(status))) if status.signal() == Some(Signal::XCPU.as_raw()) => overdue(),
        Ok(Left::Died(status)) => {
            service.slots.died.fetch_add(1, Relaxed);
            let deaths = again(|| service.jobs.count(&job.id, true)).await;
            let how = match status {
                Some(status) => format!("the job's process ended with {status}"),
                None => "the job's process ended without a word".to_owned(),
            };
            match deaths < DEATHS {
                true => (JobState::Queued, None, Some(format!("{how}; it goes on"))),
                false => (
                    JobState::Failed,
                    Some(70),
                    Some(format!("{how}, {DEATHS} times")),
                ),
            }
        }
        Ok(Left::Killed) => overdue(),
        Err(error) => match error.exit_code() {
            75 => {
                service.store.release_disk();
                service.slots.found_full(service.store.free());
                (
                    JobState::Queued,
                    None,
                    Some(format!("{error}; it goes on when there is room")),
                )
            }
            code => (JobState::Failed, Some(code), Some(error.to_string())),
        },
    };
    let kept = again(|| {
        service
            .jobs
            .finish_or_requeue(&job.id, state, code, message.clone())
    })
    .await;
    if kept {
        info!(job = job.id, ?state, exit_code = code, message, "left");
    }
    kept
}

fn overdue() -> (JobState, Option<u8>, Option<String>) {
    let message = "the job took longer than it may, and was ended";
    (JobState::Failed, Some(75), Some(message.to_owned()))
}

fn is_full(service: &Service) -> bool {
    service.store.free().is_some_and(|free| free < ROOM)
}

/// Returns a job that was interrupted or found the disk full to the queue.
fn waits(
    service: &Service,
    said: Option<String>,
    full: bool,
) -> (JobState, Option<u8>, Option<String>) {
    if full {
        service.store.release_disk();
        service.slots.found_full(service.store.free());
    }
    let said = said.unwrap_or_else(|| "the disk is full".to_owned());
    (
        JobState::Queued,
        None,
        Some(format!("{said}; it goes on by itself")),
    )
}

/// Returns the error message of the command.
pub fn said(folder: &JobFolder) -> Option<String> {
    let result = folder.result()?;
    Some(result.get("error")?.get("message")?.as_str()?.to_owned())
}

/// Terminates the process of a job; SIGTERM first, then SIGKILL.
pub async fn stop(folder: &JobFolder) {
    folder.signal(Signal::TERM);
    for _ in 0..40 {
        if !folder.is_locked() {
            return;
        }
        sleep(LOOK).await;
    }
    folder.signal(Signal::KILL);
    while folder.is_locked() {
        sleep(LOOK).await;
    }
}

/// Terminates the process of a deleted job until the job is removed.
pub async fn cancel(service: Arc<Service>, id: String) {
    let folder = service.store.job(&id);
    // Repeated, because a process that has just started does not handle the signal yet.
    while matches!(service.jobs.get(&id).await, Ok(Some(_))) {
        stop(&folder).await;
        sleep(LOOK).await;
    }
}

/// Sends SIGTERM to all jobs, which then end in a resumable state. The next service continues them.
pub async fn stop_all(service: &Service) {
    service.slots.stopping.store(true, Relaxed);
    let running = service
        .jobs
        .in_state(JobState::Running)
        .await
        .unwrap_or_default();
    for job in running {
        service.store.job(&job.id).signal(Signal::TERM);
    }
}

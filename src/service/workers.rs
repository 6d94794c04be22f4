//! Jobs one after the other, so many at once, each in a process of its own. The service waits, and the
//! job's folder tells what came of it: so a service that was killed goes on where it was.

use super::job_folder::{JobFolder, Outcome, Task};
use super::jobs::{Job, Kind, State};
use super::refusal::Refusal;
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

/// Processes of a job that may die without a word before it counts as failed.
const DEATHS: u32 = 3;
/// Time after its limit in which a job's process ends by itself.
const GRACE: Duration = Duration::from_secs(10);
/// Time between two looks at a process that is not this one's child.
const LOOK: Duration = Duration::from_millis(100);
/// The environment's variable with the token.
pub const TOKEN_VARIABLE: &str = "LASERTRACE_TOKEN";

/// Starts jobs for as long as the service lives; first it takes up those that ran when it ended.
pub async fn schedule(service: Arc<Service>) {
    let cancelled = again(|| service.jobs.in_state(State::Cancelled)).await;
    let running = again(|| service.jobs.in_state(State::Running)).await;
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
                service.store.keep_room();
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

/// What must be written some time, as soon as the disk lets it.
async fn again<T, F: Future<Output = std::result::Result<T, Refusal>>>(ask: impl Fn() -> F) -> T {
    loop {
        match ask().await {
            Ok(done) => return done,
            Err(refusal) => warn!("the table of jobs: {}", refusal.message),
        }
        sleep(Duration::from_secs(1)).await;
    }
}

/// How a job's process left.
enum Left {
    Outcome(Outcome),
    /// Without an outcome; how, if it was this service's child.
    Died(Option<std::process::ExitStatus>),
    /// It took longer than its limit and did not end.
    Killed,
}

/// Does a job to its end, or until it waits again.
async fn work(service: Arc<Service>, job: Job, slot: OwnedSemaphorePermit) {
    let folder = service.store.job(&job.id);
    let left = match job.state {
        State::Cancelled => {
            stop(&folder).await;
            None
        }
        _ => Some(run(&service, &job, &folder).await),
    };
    // A service that ends leaves the job as it is; the next one finds the outcome.
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
        again(|| service.jobs.forget(&job.id)).await;
    }
    drop(slot);
    service.slots.wake();
}

/// Removes a job's folder; a view of its scene ends first.
pub async fn remove(folder: &JobFolder) {
    stop(&folder.view()).await;
    let folder = folder.clone();
    if let Err(error) = on_disk(move || folder.remove()).await {
        warn!("{error}");
    }
}

async fn run(service: &Arc<Service>, job: &Job, folder: &JobFolder) -> Result<Left> {
    // One that an earlier service started may still live, or have ended meanwhile.
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
    // Deleted before there was a process that could be told.
    if again(|| service.jobs.get(&job.id))
        .await
        .is_none_or(|job| job.state == State::Cancelled)
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

/// Makes the job's folder, with what it reads.
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

/// Starts a process that does a task in its folder, where files take what it prints; it ends with the service or
/// outlives it.
pub fn start(
    service: &Service,
    folder: &JobFolder,
    task: &Task,
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

/// What the job's process is told: the command that a user would type in the job's folder.
fn task(service: &Service, request: &super::jobs::Request) -> Task {
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
    Task { arguments, limits }
}

/// Writes down what became of a job; false if it was deleted meanwhile.
async fn conclude(service: &Service, job: &Job, folder: &JobFolder, left: Result<Left>) -> bool {
    let (state, code, message) = match left {
        Ok(Left::Outcome(outcome)) if outcome.again => {
            let said = outcome.message.or_else(|| said(folder));
            waits(service, said, outcome.full)
        }
        Ok(Left::Outcome(outcome)) => {
            let state = match outcome.exit_code {
                0 => State::Done,
                _ => State::Failed,
            };
            let message = outcome.message.or_else(|| said(folder));
            (state, Some(outcome.exit_code), message)
        }
        // So a process ends that finds no room even for its outcome.
        Ok(Left::Died(Some(status))) if status.code() == Some(75) && is_full(service) => {
            waits(service, None, true)
        }
        // The system refused memory: it was no mistake of the job's to be tried again.
        Ok(Left::Died(Some(status))) if status.code() == Some(75) && said(folder).is_none() => {
            let megabytes = service.settings.limits.memory / 1_000_000;
            let message =
                format!("the job took more than the {megabytes} MB of memory that it may");
            (State::Failed, Some(75), Some(message))
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
                true => (State::Queued, None, Some(format!("{how}; it goes on"))),
                false => (
                    State::Failed,
                    Some(70),
                    Some(format!("{how}, {DEATHS} times")),
                ),
            }
        }
        Ok(Left::Killed) => overdue(),
        Err(error) => match error.exit_code() {
            75 => {
                service.store.give_room();
                service.slots.found_full(service.store.free());
                (
                    State::Queued,
                    None,
                    Some(format!("{error}; it goes on when there is room")),
                )
            }
            code => (State::Failed, Some(code), Some(error.to_string())),
        },
    };
    let kept = again(|| service.jobs.leave(&job.id, state, code, message.clone())).await;
    if kept {
        info!(job = job.id, ?state, exit_code = code, message, "left");
    }
    kept
}

fn overdue() -> (State, Option<u8>, Option<String>) {
    let message = "the job took longer than it may, and was ended";
    (State::Failed, Some(75), Some(message.to_owned()))
}

fn is_full(service: &Service) -> bool {
    service.store.free().is_some_and(|free| free < ROOM)
}

/// A job that was interrupted, or found the disk full, waits.
fn waits(
    service: &Service,
    said: Option<String>,
    full: bool,
) -> (State, Option<u8>, Option<String>) {
    if full {
        service.store.give_room();
        service.slots.found_full(service.store.free());
    }
    let said = said.unwrap_or_else(|| "the disk is full".to_owned());
    (
        State::Queued,
        None,
        Some(format!("{said}; it goes on by itself")),
    )
}

/// The message of the command's error.
pub fn said(folder: &JobFolder) -> Option<String> {
    let result = folder.result()?;
    Some(result.get("error")?.get("message")?.as_str()?.to_owned())
}

/// Ends a job's process: first it is asked to.
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

/// Ends the process of a job that was deleted, until the job is gone.
pub async fn cancel(service: Arc<Service>, id: String) {
    let folder = service.store.job(&id);
    // More than once: a process that has only begun does not hear it yet.
    while matches!(service.jobs.get(&id).await, Ok(Some(_))) {
        stop(&folder).await;
        sleep(LOOK).await;
    }
}

/// Tells all jobs to stop where they can go on later; the next service takes them up.
pub async fn stop_all(service: &Service) {
    service.slots.stopping.store(true, Relaxed);
    let running = service
        .jobs
        .in_state(State::Running)
        .await
        .unwrap_or_default();
    for job in running {
        service.store.job(&job.id).signal(Signal::TERM);
    }
}

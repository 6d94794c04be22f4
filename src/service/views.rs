//! Live views of the scenes of jobs. Each view is the command `view` in a separate process with the
//! limits of a job, in the folder `view` of the job. The service itself opens no scene. It forwards
//! requests through a Unix socket in that folder.

use super::job_folder::{JobFolder, JobTask};
use super::refusal::HttpError;
use super::shared::Service;
use super::workers::{said, start};
use crate::error::Result;
use axum::body::Body;
use axum::http::{Request, StatusCode, header};
use axum::response::{IntoResponse, Response};
use hyper::client::conn::http1;
use hyper_util::rt::TokioIo;
use std::fs::File;
use std::os::fd::AsRawFd;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::UnixStream;
use tokio::task::JoinHandle;
use tokio::time::sleep;
use tracing::info;

/// Polling interval while a view is being built.
const LOOK: Duration = Duration::from_millis(50);
const SOCKET: &str = "view.sock";

/// Forwards a request for `page`, including its query string, to the view of a job's scene. Starts
/// the view if necessary.
///
/// # Errors
/// 409: the job has no scene, or none yet. 422: the scene cannot be viewed. 429: too many views are
/// open.
pub async fn ask(
    service: &Arc<Service>,
    job: &JobFolder,
    page: &str,
) -> std::result::Result<Response, HttpError> {
    let failed = |error: hyper::Error| {
        let message = format!("the view does not answer: {error}; open it again");
        HttpError::new(StatusCode::BAD_GATEWAY, message)
    };
    let stream = TokioIo::new(connected(service, job).await?);
    let (mut sender, connection) = http1::handshake(stream).await.map_err(failed)?;
    tokio::spawn(connection);
    let request = Request::get(format!("/{page}"))
        .header(header::HOST, "localhost")
        .body(Body::empty());
    let request = request.map_err(|error| {
        HttpError::new(StatusCode::BAD_REQUEST, format!("the address: {error}"))
    })?;
    let answer = sender.send_request(request).await.map_err(failed)?;
    Ok(answer.map(Body::new).into_response())
}

/// Connects to the view of the job and waits until its scene is built.
async fn connected(
    service: &Arc<Service>,
    job: &JobFolder,
) -> std::result::Result<UnixStream, HttpError> {
    let view = job.view();
    if let Some(stream) = connect(&view).await {
        return Ok(stream);
    }
    let opened = {
        // Serialised, so that no scene is built twice.
        let _turn = service.views.turn.lock().await;
        match view.is_locked() {
            // Opened by another request, or by a service that was killed.
            true => None,
            false => {
                let opened = open(service, job, &view)?;
                // From then on, other requests find the view locked.
                while !view.is_locked() && !opened.is_finished() {
                    sleep(LOOK).await;
                }
                Some(opened)
            }
        }
    };
    loop {
        if let Some(stream) = connect(&view).await {
            return Ok(stream);
        }
        let ended = match &opened {
            Some(child) => child.is_finished(),
            None => !view.is_locked(),
        };
        if ended {
            let outcome = view.outcome().and_then(|outcome| outcome.message);
            let message = outcome.or_else(|| said(&view));
            let message = message.unwrap_or_else(|| "the view has ended; open it again".to_owned());
            return Err(HttpError::new(StatusCode::UNPROCESSABLE_ENTITY, message));
        }
        sleep(LOOK).await;
    }
}

/// Connects to the socket of a view, if it exists.
///
/// The address of a Unix socket is limited to 107 bytes, which the path of a store may exceed. A
/// path relative to the opened folder is short.
async fn connect(view: &JobFolder) -> Option<UnixStream> {
    let folder = File::open(&view.0).ok()?;
    let path = format!("/proc/self/fd/{}/{SOCKET}", folder.as_raw_fd());
    UnixStream::connect(path).await.ok()
}

fn open(
    service: &Arc<Service>,
    job: &JobFolder,
    view: &JobFolder,
) -> std::result::Result<JoinHandle<()>, HttpError> {
    if !job.scene().exists() {
        let message =
            "this job has no scene to view, or waits for its turn: open the view once it has begun";
        return Err(HttpError::new(StatusCode::CONFLICT, message));
    }
    let place = service.views.places.clone().try_acquire_owned();
    let place = place.map_err(|_| {
        let message = "as many live views are open as jobs may run at once (--jobs); each ends ten minutes after its \
                       page was closed";
        HttpError::new(StatusCode::TOO_MANY_REQUESTS, message)
    })?;
    let mut child = begin(service, view)?;
    info!(folder = %view.0.display(), process = child.id(), "view opened");
    let view = view.clone();
    Ok(tokio::spawn(async move {
        let _ = child.wait().await;
        drop(place);
        info!(folder = %view.0.display(), "view ended");
    }))
}

/// Starts the process of a view. It ends with the service, or on its own after a period without
/// requests.
fn begin(service: &Service, view: &JobFolder) -> Result<tokio::process::Child> {
    crate::run::files::create_own_folder(&view.0)?;
    let limits = service.settings.limits;
    let threads = format!("--threads={}", limits.threads);
    let arguments = ["view", "../in/scene.toml", "--socket", SOCKET, &threads];
    let task = JobTask {
        arguments: arguments.map(str::to_owned).to_vec(),
        limits,
    };
    start(service, view, &task, true)
}

//! HTTP endpoints of the service: one function per endpoint, with its OpenAPI description.

use super::connections::Peer;
use super::job_folder::Progress;
use super::jobs::{self, Job, JobState, Kind, Request, SubmitResult};
use super::quota::Permit;
use super::refusal::{HttpError, RefusalBody};
use super::scene_files;
use super::shared::Service;
use super::store::{Hash, PREFIX, ResultFile};
use super::{metrics, upload, views, workers};
use crate::error::{Error, printable};
use crate::run::Export;
use crate::scene::Unit;
use askama::Template;
use axum::body::{Body, Bytes};
use axum::extract::rejection::QueryRejection;
use axum::extract::{self, Path, Query};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Redirect, Response};
use axum::{Json, Router};
use futures_util::stream::{Stream, unfold};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::convert::Infallible;
use std::fs::{File, Metadata};
use std::net::Ipv4Addr;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::sync::Arc;
use std::time::{Duration, Instant};
use utoipa::{IntoParams, OpenApi, ToSchema};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Size limits of a scene and of a ray file, bytes.
const LARGEST_SCENE: u64 = 1 << 20;
const LARGEST_RAYS: u64 = 4 << 20;
/// Maximum number of jobs in a list.
const LISTED: u32 = 100;
/// Polling interval for a watched job.
const LOOK: Duration = Duration::from_millis(200);
/// Maximum duration of an event stream. A client that does not read would otherwise hold it
/// forever.
const LONGEST_STREAM: Duration = Duration::from_secs(600);
/// Number of bytes returned from the end of a job's log.
const SHOWN_LOG: u64 = 1 << 16;
/// Chunk size for reading files, bytes.
const PIECE: u64 = 1 << 18;
/// Free disk space below which the service reports that it is not ready, bytes.
const LEAST_FREE: u64 = 1 << 20;

type Shared = extract::State<Arc<Service>>;
type ServiceResult<T> = Result<T, HttpError>;

/// Simulates laser-triangulation sensors. Files are addressed by their hash; simulations run as
/// jobs.
#[derive(OpenApi)]
#[openapi(info(title = "lasertrace"))]
struct Api;

pub fn router(service: Arc<Service>) -> Router {
    let (pages, mut api) = OpenApiRouter::with_openapi(Api::openapi())
        .routes(routes!(put_file, file_there, delete_file))
        .routes(routes!(post_job, list_jobs))
        .routes(routes!(get_job, delete_job))
        .routes(routes!(events))
        .routes(routes!(log))
        .routes(routes!(list_results))
        .routes(routes!(get_result))
        .routes(routes!(view))
        .routes(routes!(healthz))
        .routes(routes!(readyz))
        .routes(routes!(metrics_page))
        .split_for_parts();
    // Axum's wildcard syntax for a multi-segment path is not valid in OpenAPI.
    let paths = std::mem::take(&mut api.paths.paths).into_iter();
    let plain = paths.map(|(path, item)| (path.replace("{*", "{"), item));
    api.paths.paths = plain.collect();
    api.info.version = env!("CARGO_PKG_VERSION").to_owned();
    let page = Bytes::from(api.to_pretty_json().expect("the description is JSON"));
    let json = [(header::CONTENT_TYPE, "application/json")];
    let slash = async |Path(id): Path<String>| Redirect::permanent(&format!("/v1/jobs/{id}/view/"));
    pages
        .route("/", axum::routing::get(index))
        .route("/v1/jobs/{id}/view", axum::routing::get(slash))
        .route("/v1/jobs/{id}/view/{*page}", axum::routing::get(view_page))
        .route(
            "/v1/openapi.json",
            axum::routing::get(async move || (json, page)),
        )
        .fallback(async || {
            HttpError::new(
                StatusCode::NOT_FOUND,
                "there is no such page; see /v1/openapi.json",
            )
        })
        .layer(from_fn_with_state(service.clone(), logged))
        .with_state(service)
}

/// Counts and logs every request.
async fn logged(
    extract::State(service): Shared,
    request: extract::Request,
    next: Next,
) -> Response {
    let start = Instant::now();
    let method = request.method().clone();
    let path: String = request.uri().path().chars().take(200).collect();
    let response = next.run(request).await;
    let took = start.elapsed();
    let status = response.status().as_u16();
    service.metrics.answered(status, took);
    tracing::info!(%method, path, status, ms = took.as_secs_f64() * 1e3, "request");
    response
}

/// A job as returned to clients.
#[derive(Serialize, ToSchema)]
struct JobPage {
    /// Identifier of the job in other requests.
    id: String,
    kind: Kind,
    state: JobState,
    /// Time of submission, from the clock of the service (RFC 3339).
    created: String,
    /// Time of the first start.
    started: Option<String>,
    /// Time of completion.
    finished: Option<String>,
    /// Number of processes started for the job; more than one if the job was interrupted.
    starts: u32,
    /// Exit code of the command: 0 success, 64 usage error, 65 invalid scene or mesh, 70 internal
    /// error, 74 input/output error, 75 limit reached.
    exit_code: Option<u8>,
    /// Reason for a failure or for waiting.
    message: Option<String>,
    /// Progress of the job.
    progress: Option<Progress>,
    /// Output of the command with --json. For an error in a scene: file, line, key, the value found
    /// and the value expected.
    result: Option<serde_json::Value>,
}

async fn page(service: &Service, job: Job) -> JobPage {
    let folder = service.store.job(&job.id);
    let (progress, result) = upload::on_disk(move || match job.state {
        JobState::Running => (folder.progress(), None),
        JobState::Done | JobState::Failed => (None, folder.result()),
        JobState::Queued | JobState::Cancelled => (None, None),
    })
    .await;
    JobPage {
        id: job.id,
        kind: job.request.kind,
        state: job.state,
        created: job.created,
        started: job.started,
        finished: job.finished,
        starts: job.starts,
        exit_code: job.exit_code,
        message: job.message,
        progress,
        result,
    }
}

async fn found(service: &Service, id: &str) -> ServiceResult<Job> {
    service
        .jobs
        .get(id)
        .await?
        .ok_or_else(|| HttpError::no_job(id))
}

fn hash(digits: &str) -> ServiceResult<Hash> {
    Hash::parse(digits).ok_or_else(|| {
        let expected = "a SHA-256: 64 digits, 0 to 9 and a to f, as sha256sum prints";
        HttpError::new(
            StatusCode::BAD_REQUEST,
            format!("found {digits:?}, expected {expected}"),
        )
    })
}

/// Uploads a file to which scenes refer: a mesh, sensor, poses or calibration.
///
/// The file is stored under its SHA-256; scenes refer to it as `sha256:…`. A file that exists does
/// not have to be uploaded again.
#[utoipa::path(put, path = "/v1/files/{sha256}", params(("sha256" = String, Path)),
    request_body(content = [u8], content_type = "application/octet-stream"),
    responses((status = 201, description = "It is there now"), (status = 200, description = "It was there"),
        (status = 408, body = RefusalBody), (status = 413, body = RefusalBody),
        (status = 422, description = "The bytes have another hash", body = RefusalBody),
        (status = 507, description = "The disk is full", body = RefusalBody)))]
async fn put_file(
    extract::State(service): Shared,
    Path(digits): Path<String>,
    headers: HeaderMap,
    body: Body,
) -> ServiceResult<StatusCode> {
    let hash = hash(&digits)?;
    if service.store.file(&hash).exists() {
        return Ok(StatusCode::OK);
    }
    let largest = service.settings.largest_file;
    upload::file(
        body,
        upload::length(&headers),
        largest,
        hash,
        &service.store,
    )
    .await?;
    Ok(StatusCode::CREATED)
}

/// Checks whether a file exists.
#[utoipa::path(head, path = "/v1/files/{sha256}", params(("sha256" = String, Path)),
    responses((status = 200), (status = 404)))]
async fn file_there(
    extract::State(service): Shared,
    Path(digits): Path<String>,
) -> ServiceResult<StatusCode> {
    Ok(match service.store.file(&hash(&digits)?).exists() {
        true => StatusCode::OK,
        false => StatusCode::NOT_FOUND,
    })
}

/// Deletes a file. Finished jobs keep their own links to the files they read.
#[utoipa::path(delete, path = "/v1/files/{sha256}", params(("sha256" = String, Path)),
    responses((status = 204), (status = 404, body = RefusalBody),
        (status = 409, description = "A job that is not done reads it", body = RefusalBody)))]
async fn delete_file(
    extract::State(service): Shared,
    Path(digits): Path<String>,
) -> ServiceResult<StatusCode> {
    let hash = hash(&digits)?;
    // No job is accepted between the check and the removal.
    let _files = service.files.write().await;
    if service.jobs.reads(&hash).await? {
        let message = "a job that is not done reads this file";
        return Err(HttpError::new(StatusCode::CONFLICT, message));
    }
    let path = service.store.file(&hash);
    match std::fs::remove_file(&path) {
        Ok(()) => Ok(StatusCode::NO_CONTENT),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Err(HttpError::new(
            StatusCode::NOT_FOUND,
            "there is no such file",
        )),
        Err(error) => Err(Error::io("remove", &path)(error).into()),
    }
}

/// Parameters of a job in addition to its scene.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
struct JobQuery {
    /// Kind of computation.
    kind: Kind,
    /// For a frame: its index, default 0.
    frame: Option<u32>,
    /// For scans and profiles: range of frames, from A to B − 1.
    #[param(example = "10..20")]
    frames: Option<String>,
    /// For scans and profiles: additional formats of the point cloud, such as `csv,e57,pcd`.
    also: Option<String>,
    /// Files to which a file of the scene refers, such as the buffers of a glTF file:
    /// `NAME=SHA256`, separated by commas.
    #[param(example = "part.bin=0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef")]
    files: Option<String>,
    /// For rays: the mesh, `sha256:…`.
    mesh: Option<String>,
    /// For rays: unit of the mesh file if the file does not specify it: um, mm, cm, m or inch.
    #[param(value_type = Option<String>)]
    unit: Option<Unit>,
}

impl JobQuery {
    fn frames(&self) -> ServiceResult<Option<std::ops::Range<u32>>> {
        let wrong = |message: String| HttpError::new(StatusCode::UNPROCESSABLE_ENTITY, message);
        match &self.frames {
            None => Ok(None),
            Some(text) => {
                let range = text.split_once("..");
                let range = range.and_then(|(a, b)| Some(a.parse().ok()?..b.parse().ok()?));
                let expected = || {
                    wrong(format!(
                        "frames: found {text:?}, expected A..B as in 10..20"
                    ))
                };
                range.ok_or_else(expected).map(Some)
            }
        }
    }

    /// Returns the files of the parameter `files`. Returns an error if one is missing in the store.
    fn named(&self, service: &Service) -> ServiceResult<Vec<(String, Hash)>> {
        let wrong = |message: String| HttpError::new(StatusCode::UNPROCESSABLE_ENTITY, message);
        // A file name without folders; the name of the scene is reserved.
        let plain = |name: &str| {
            let known = |c: char| c.is_alphanumeric() || matches!(c, '.' | '_' | '-' | ' ');
            (1..=200).contains(&name.len())
                && !name.starts_with('.')
                && name != "scene.toml"
                && name.chars().all(known)
        };
        let pairs = self.files.iter().flat_map(|text| text.split(','));
        pairs
            .map(|pair| {
                let named = pair.rsplit_once('=').filter(|(name, _)| plain(name));
                let named = named.and_then(|(name, digits)| {
                    let digits = digits.strip_prefix(PREFIX).unwrap_or(digits);
                    Some((name.to_owned(), Hash::parse(digits)?))
                });
                let (name, hash) = named.ok_or_else(|| {
                    let expected = "NAME=SHA256: a file name without folders, and 64 digits 0 to 9 and a to f";
                    wrong(format!("files: found {pair:?}, expected {expected}"))
                })?;
                match service.store.file(&hash).exists() {
                    true => Ok((name, hash)),
                    false => {
                        let digits = hash.digits();
                        Err(wrong(format!(
                            "files: {name}: there is no such file; send it first: PUT /v1/files/{digits}"
                        )))
                    }
                }
            })
            .collect()
    }

    fn request(&self, service: &Service, body: &[u8]) -> ServiceResult<Request> {
        let wrong = |message: String| HttpError::new(StatusCode::UNPROCESSABLE_ENTITY, message);
        let beside = [
            ("frame", self.frame.is_some(), self.kind == Kind::Frame),
            (
                "frames",
                self.frames.is_some(),
                matches!(self.kind, Kind::Scan | Kind::Profiles),
            ),
            (
                "also",
                self.also.is_some(),
                matches!(self.kind, Kind::Scan | Kind::Profiles),
            ),
            ("mesh", self.mesh.is_some(), self.kind == Kind::Rays),
            ("unit", self.unit.is_some(), self.kind == Kind::Rays),
        ];
        if let Some((name, ..)) = beside.iter().find(|(_, given, taken)| *given && !taken) {
            return Err(wrong(format!("{name}: a job of this kind has none")));
        }
        let frames = self.frames()?;
        let also: Vec<String> = self
            .also
            .iter()
            .flat_map(|text| text.split(','))
            .map(str::to_owned)
            .collect();
        let forms = Export::ALL.map(Export::name);
        if let Some(form) = also.iter().find(|form| !forms.contains(&form.as_str())) {
            let expected = forms.join(", ");
            return Err(wrong(format!(
                "also: found {form:?}, expected of {expected}"
            )));
        }
        let mut request = Request {
            kind: self.kind,
            frame: self.frame.unwrap_or(0),
            frames,
            also,
            mesh: None,
            files: Vec::new(),
            named: self.named(service)?,
        };
        match self.kind {
            Kind::Rays => {
                let mesh = self.mesh.as_deref().unwrap_or_default();
                let mesh = mesh
                    .strip_prefix(PREFIX)
                    .and_then(Hash::parse)
                    .ok_or_else(|| {
                        wrong(format!(
                            "mesh: found {mesh:?}, expected {PREFIX} and 64 digits of its SHA-256"
                        ))
                    })?;
                if !service.store.file(&mesh).exists() {
                    let digits = mesh.digits();
                    return Err(wrong(format!(
                        "mesh: there is no such file; send it first: PUT /v1/files/{digits}"
                    )));
                }
                request.files = vec![mesh.clone()];
                request.mesh = Some((mesh, self.unit));
            }
            _ => request.files = scene_files::files_of(body, &service.store)?,
        }
        let named = request.named.iter().map(|(_, hash)| hash.clone());
        request.files.extend(named);
        Ok(request)
    }
}

/// Starts a job. The body is the scene (TOML) in the format of the command line, with files given
/// by hash. For rays the body is JSON: `{"rays": [[x, y, z, dx, dy, dz], …]}` in mm.
///
/// With the header Idempotency-Key, a request can be repeated safely, for example after a lost
/// response. The job is not started twice.
#[utoipa::path(post, path = "/v1/jobs",
    params(JobQuery, ("idempotency-key" = Option<String>, Header)),
    request_body(content((String = "application/toml"), (serde_json::Value = "application/json"))),
    responses((status = 202, description = "It waits for its turn", body = JobPage),
        (status = 200, description = "It was sent before, with this key", body = JobPage),
        (status = 413, body = RefusalBody), (status = 415, body = RefusalBody),
        (status = 422, description = "The scene, a file or the key is wrong", body = RefusalBody),
        (status = 429, description = "Too many jobs wait", body = RefusalBody),
        (status = 507, description = "The disk is full", body = RefusalBody)))]
async fn post_job(
    extract::State(service): Shared,
    asked: Result<Query<JobQuery>, QueryRejection>,
    headers: HeaderMap,
    body: Body,
) -> ServiceResult<Response> {
    let asked =
        asked.map_err(|error| HttpError::new(StatusCode::BAD_REQUEST, error.body_text()))?;
    let (media, largest) = match asked.kind {
        Kind::Rays => ("application/json", LARGEST_RAYS),
        _ => ("application/toml", LARGEST_SCENE),
    };
    // A form on a page of a different site cannot be sent with one of these content types.
    let found = headers
        .get(header::CONTENT_TYPE)
        .and_then(|value| value.to_str().ok());
    if found.and_then(|text| text.split(';').next()).map(str::trim) != Some(media) {
        let message = format!(
            "found the content type {:?}, expected {media}",
            found.unwrap_or("")
        );
        return Err(HttpError::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, message));
    }
    let key = match headers.get("idempotency-key").map(HeaderValue::to_str) {
        None => None,
        Some(Ok(key)) if (1..=255).contains(&key.len()) => Some(key.to_owned()),
        Some(_) => {
            let message = "Idempotency-Key: expected 1 to 255 ASCII characters";
            return Err(HttpError::new(StatusCode::BAD_REQUEST, message));
        }
    };
    let body = upload::whole(body, upload::length(&headers), largest).await?;
    // The files of the job are not removed until the job is in the table.
    let _files = service.files.read().await;
    let (request, body) = {
        let service = service.clone();
        upload::on_disk(move || {
            asked
                .request(&service, &body)
                .map(|request| (request, body))
        })
        .await?
    };
    let mut sum = Sha256::new();
    sum.update(serde_json::to_vec(&request).expect("a request is JSON"));
    sum.update(&body);
    let sum = Hash::of(&sum.finalize()).digits().to_owned();
    let longest = service.settings.longest_queue;
    let (status, job) = match service.jobs.add(key, sum, request, body, longest).await? {
        SubmitResult::New(job) => (StatusCode::ACCEPTED, job),
        SubmitResult::Before(job) => (StatusCode::OK, job),
        SubmitResult::OtherJob => {
            let message = "this Idempotency-Key was sent with another job; take a new one";
            return Err(HttpError::new(StatusCode::UNPROCESSABLE_ENTITY, message));
        }
        SubmitResult::Full(waiting) => {
            let message = format!("{waiting} jobs wait already; send it again later");
            return Err(HttpError::new(StatusCode::TOO_MANY_REQUESTS, message));
        }
    };
    service.slots.wake();
    let place = [(header::LOCATION, format!("/v1/jobs/{}", job.id))];
    Ok((status, place, Json(page(&service, job).await)).into_response())
}

/// Returns the last hundred jobs, newest first.
#[utoipa::path(get, path = "/v1/jobs", responses((status = 200, body = Vec<JobPage>)))]
async fn list_jobs(extract::State(service): Shared) -> ServiceResult<Json<Vec<JobPage>>> {
    let mut pages = Vec::new();
    for job in service.jobs.last(LISTED).await? {
        pages.push(page(&service, job).await);
    }
    Ok(Json(pages))
}

/// Returns the state, progress and result of a job.
#[utoipa::path(get, path = "/v1/jobs/{id}", params(("id" = String, Path)),
    responses((status = 200, body = JobPage), (status = 404, body = RefusalBody)))]
async fn get_job(
    extract::State(service): Shared,
    Path(id): Path<String>,
) -> ServiceResult<Json<JobPage>> {
    let job = found(&service, &id).await?;
    Ok(Json(page(&service, job).await))
}

/// Deletes a job and its results. A running job is stopped first.
#[utoipa::path(delete, path = "/v1/jobs/{id}", params(("id" = String, Path)),
    responses((status = 204, description = "It is gone"), (status = 202, description = "It is being stopped"),
        (status = 404, body = RefusalBody)))]
async fn delete_job(
    extract::State(service): Shared,
    Path(id): Path<String>,
) -> ServiceResult<StatusCode> {
    let deleted = match service.jobs.delete(&id).await {
        // The disk is too full to record the deletion. Removing the results frees space for it.
        Err(refusal) if refusal.status == StatusCode::INSUFFICIENT_STORAGE => {
            service.store.release_disk();
            if service.jobs.rests(&id).await? {
                workers::remove(&service.store.job(&id)).await;
            }
            service.jobs.delete(&id).await?
        }
        other => other?,
    };
    match deleted {
        None => Err(HttpError::no_job(&id)),
        Some(JobState::Running | JobState::Cancelled) => {
            tokio::spawn(workers::cancel(service, id));
            Ok(StatusCode::ACCEPTED)
        }
        Some(_) => {
            workers::remove(&service.store.job(&id)).await;
            // The pages are free in any case. If this call cannot return them to the file system,
            // the next deletion does.
            if let Err(refusal) = service.jobs.shrink().await {
                tracing::warn!("the table of jobs: {}", refusal.message);
            }
            service.slots.wake();
            Ok(StatusCode::NO_CONTENT)
        }
    }
}

/// Returns a job whenever it changes, as server-sent events `job`. The last event is `end`, when
/// the job has finished, has failed or was deleted.
///
/// A stream ends after ten minutes. Browsers reconnect automatically.
#[utoipa::path(get, path = "/v1/jobs/{id}/events", params(("id" = String, Path)),
    responses((status = 200, description = "Events with a job each", content_type = "text/event-stream"),
        (status = 404, body = RefusalBody),
        (status = 429, description = "Too many streams are open", body = RefusalBody)))]
async fn events(
    extract::State(service): Shared,
    peer: Option<extract::Extension<Peer>>,
    Path(id): Path<String>,
) -> ServiceResult<Sse<impl Stream<Item = Result<Event, Infallible>>>> {
    found(&service, &id).await?;
    let address = peer.map_or(Ipv4Addr::UNSPECIFIED.into(), |peer| peer.0.0.ip());
    let permit = service.events.take(address).ok_or_else(|| {
        let message =
            "too many event streams are open; close some, or ask GET /v1/jobs/ID from time to time";
        HttpError::new(StatusCode::TOO_MANY_REQUESTS, message)
    })?;
    let watched = Watched {
        service,
        id,
        shown: String::new(),
        end: Instant::now() + LONGEST_STREAM,
        _permit: permit,
    };
    let events = unfold(Some(watched), async |watched| {
        let mut watched = watched?;
        let event = watched.next().await?;
        Some((Ok(event.0), event.1.then_some(watched)))
    });
    // A closed connection is detected when a keep-alive message cannot be sent.
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(Duration::from_secs(10))))
}

/// State of an event stream of a job.
struct Watched {
    service: Arc<Service>,
    id: String,
    /// Last job state sent to the client.
    shown: String,
    end: Instant,
    _permit: Permit,
}

impl Watched {
    /// Waits for the next event. Returns it and whether more events follow; `None` when the maximum
    /// duration is reached.
    async fn next(&mut self) -> Option<(Event, bool)> {
        while Instant::now() < self.end {
            let job = self.service.jobs.get(&self.id).await.ok().flatten();
            let Some(job) = job else {
                return Some((Event::default().event("end").data("null"), false));
            };
            let ended = matches!(job.state, JobState::Done | JobState::Failed);
            let page = page(&self.service, job).await;
            let text = serde_json::to_string(&page).expect("a job is JSON");
            if ended {
                return Some((Event::default().event("end").data(text), false));
            }
            if text != self.shown {
                let event = Event::default().event("job").data(&text);
                self.shown = text;
                return Some((event, true));
            }
            tokio::time::sleep(LOOK).await;
        }
        None
    }
}

/// Lists the complete result files of a job, also while it runs.
#[utoipa::path(get, path = "/v1/jobs/{id}/files", params(("id" = String, Path)),
    responses((status = 200, body = Vec<ResultFile>), (status = 404, body = RefusalBody)))]
async fn list_results(
    extract::State(service): Shared,
    Path(id): Path<String>,
) -> ServiceResult<Json<Vec<ResultFile>>> {
    found(&service, &id).await?;
    Ok(Json(
        upload::on_disk(move || service.store.results(&id)).await,
    ))
}

/// Returns a result file of a job, or the part given by the header Range.
#[utoipa::path(get, path = "/v1/jobs/{id}/files/{*path}",
    params(("id" = String, Path), ("path" = String, Path, description = "As the list of files has it"),
        ("range" = Option<String>, Header), ("if-range" = Option<String>, Header),
        ("if-none-match" = Option<String>, Header)),
    responses((status = 200, content_type = "application/octet-stream"),
        (status = 206, content_type = "application/octet-stream"),
        (status = 304, description = "The client has this version, by its ETag"),
        (status = 404, body = RefusalBody), (status = 416)))]
async fn get_result(
    extract::State(service): Shared,
    Path((id, path)): Path<(String, String)>,
    method: Method,
    headers: HeaderMap,
) -> ServiceResult<Response> {
    found(&service, &id).await?;
    let kind = media_type(&path);
    let opened = upload::on_disk(move || {
        let file = service.store.open_result(&id, &path)?;
        let data = file.metadata()?;
        std::io::Result::Ok((file, data.len(), entity_tag(&data)))
    });
    let (file, length, tag) = opened.await.map_err(|_| {
        HttpError::new(
            StatusCode::NOT_FOUND,
            "there is no such file among the job's results",
        )
    })?;
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
    let names_tag = |list: &str| {
        list.split(',')
            .any(|one| one.trim().trim_start_matches("W/") == tag)
    };
    if text(header::IF_NONE_MATCH).is_some_and(|list| list.trim() == "*" || names_tag(list)) {
        let known = [(header::ETAG, tag)];
        return Ok((StatusCode::NOT_MODIFIED, known).into_response());
    }
    // A range of a different file version must not be combined with the client's data (RFC 9110,
    // 13.1.5).
    let same = text(header::IF_RANGE).is_none_or(|known| known.trim() == tag);
    let range = text(header::RANGE).filter(|_| same);
    let mut response = Response::builder()
        .header(header::CONTENT_TYPE, kind)
        .header(header::ACCEPT_RANGES, "bytes")
        .header(header::ETAG, &tag)
        .header(header::X_CONTENT_TYPE_OPTIONS, "nosniff")
        // Reports contain a script. The sandbox prevents it from sending requests to the service.
        .header(header::CONTENT_SECURITY_POLICY, "sandbox allow-scripts");
    let part = match range.map_or(ByteRange::All, |text| wanted(text, length)) {
        ByteRange::All => 0..length,
        ByteRange::Part(part) => {
            let content = format!("bytes {}-{}/{length}", part.start, part.end - 1);
            response = response
                .status(StatusCode::PARTIAL_CONTENT)
                .header(header::CONTENT_RANGE, content);
            part
        }
        ByteRange::Nothing => {
            let content = format!("bytes */{length}");
            let response = response.status(StatusCode::RANGE_NOT_SATISFIABLE);
            let response = response
                .header(header::CONTENT_RANGE, content)
                .body(Body::empty());
            return Ok(response.expect("headers are ASCII"));
        }
    };
    let response = response.header(header::CONTENT_LENGTH, part.end - part.start);
    let body = match method {
        Method::HEAD => Body::empty(),
        _ => Body::from_stream(pieces(file, part)),
    };
    Ok(response.body(body).expect("headers are ASCII"))
}

/// Returns the ETag of a version of a file.
///
/// A new version replaces the file by a rename, so its inode differs.
fn entity_tag(data: &Metadata) -> String {
    let (seconds, nanoseconds) = (data.mtime(), data.mtime_nsec());
    format!(
        "\"{:x}-{seconds:x}-{nanoseconds:x}-{:x}\"",
        data.ino(),
        data.len()
    )
}

/// Returns the messages that a job's process wrote to stderr: the last 64 KiB.
#[utoipa::path(get, path = "/v1/jobs/{id}/log", params(("id" = String, Path)),
    responses((status = 200, content_type = "text/plain"), (status = 404, body = RefusalBody)))]
async fn log(extract::State(service): Shared, Path(id): Path<String>) -> ServiceResult<Response> {
    found(&service, &id).await?;
    let path = service.store.job(&id).log_file();
    let text = upload::on_disk(move || {
        let file = File::open(&path)?;
        let length = file.metadata()?.len();
        let first = length.saturating_sub(SHOWN_LOG);
        let mut bytes = vec![0; (length - first) as usize];
        file.read_exact_at(&mut bytes, first)?;
        std::io::Result::Ok(String::from_utf8_lossy(&bytes).into_owned())
    });
    // A job that has not started has no log.
    let text = text.await.unwrap_or_default();
    let kind = [(header::CONTENT_TYPE, "text/plain; charset=utf-8")];
    Ok((kind, printable::lines(&text)).into_response())
}

/// Returns an HTML page with the last jobs and their results.
async fn index(extract::State(service): Shared) -> ServiceResult<Response> {
    let jobs = service.jobs.last(LISTED).await?;
    let html = upload::on_disk(move || {
        let rows = jobs.into_iter().map(|job| IndexRow {
            kind: job.request.kind.name(),
            state: jobs::word(job.state),
            report: service
                .store
                .job(&job.id)
                .out()
                .join("report.html")
                .exists(),
            scene: service.store.job(&job.id).scene().exists(),
            message: job
                .message
                .as_deref()
                .map(printable::line)
                .unwrap_or_default(),
            id: job.id,
            created: job.created,
        });
        let page = IndexPage {
            version: env!("CARGO_PKG_VERSION"),
            jobs: rows.collect(),
        };
        page.render().expect("writing to a string does not fail")
    });
    let headers = [
        (header::CONTENT_TYPE, "text/html; charset=utf-8"),
        (header::CACHE_CONTROL, "no-store"),
        (
            header::CONTENT_SECURITY_POLICY,
            "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'",
        ),
    ];
    Ok((headers, html.await).into_response())
}

/// HTML page at `/`.
#[derive(Template)]
#[template(path = "service.html")]
struct IndexPage {
    version: &'static str,
    jobs: Vec<IndexRow>,
}

/// Row of a job on the page at `/`.
struct IndexRow {
    id: String,
    kind: &'static str,
    state: &'static str,
    created: String,
    message: String,
    /// True if there is a report.
    report: bool,
    /// True if there is a scene to view.
    scene: bool,
}

/// Returns a stream of the chunks of a part of a file.
fn pieces(file: File, part: std::ops::Range<u64>) -> impl Stream<Item = std::io::Result<Bytes>> {
    unfold((Arc::new(file), part), async |(file, part)| {
        if part.is_empty() {
            return None;
        }
        let end = part.end.min(part.start + PIECE);
        let read = {
            let file = file.clone();
            upload::on_disk(move || {
                let mut bytes = vec![0; (end - part.start) as usize];
                file.read_exact_at(&mut bytes, part.start)
                    .map(|()| bytes.into())
            })
        };
        let read = read.await;
        // The stream ends after an error.
        let next = if read.is_ok() { end } else { part.end };
        Some((read, (file, next..part.end)))
    })
}

/// Evaluated header Range.
#[derive(Debug, PartialEq)]
enum ByteRange {
    /// All bytes; also for a header that is not understood (RFC 9110).
    All,
    Part(std::ops::Range<u64>),
    Nothing,
}

/// Parses a header Range with a single range for a file of `length` bytes. Several ranges are
/// answered with the complete file.
fn wanted(text: &str, length: u64) -> ByteRange {
    let Some((first, last)) = text
        .strip_prefix("bytes=")
        .and_then(|text| text.trim().split_once('-'))
    else {
        return ByteRange::All;
    };
    let part = match (first.parse::<u64>(), last.parse::<u64>()) {
        (Ok(first), Ok(last)) if first <= last => first..length.min(last.saturating_add(1)),
        (Ok(first), Err(_)) if last.is_empty() => first..length,
        (Err(_), Ok(last)) if first.is_empty() => length.saturating_sub(last)..length,
        _ => return ByteRange::All,
    };
    match part.is_empty() {
        true => ByteRange::Nothing,
        false => ByteRange::Part(part),
    }
}

fn media_type(path: &str) -> &'static str {
    match path.rsplit('.').next().unwrap_or("") {
        "html" => "text/html; charset=utf-8",
        "json" => "application/json",
        "csv" => "text/csv; charset=utf-8",
        "png" => "image/png",
        "svg" => "image/svg+xml",
        _ => "application/octet-stream",
    }
}

/// Returns the live view of a job's scene: an HTML page and the resources that it requests.
///
/// The sliders change the view only, not the job. "Save as scene" returns a scene that can be
/// submitted as a job. The view ends ten minutes after the last request.
#[utoipa::path(get, path = "/v1/jobs/{id}/view/", params(("id" = String, Path)),
    responses((status = 200, content_type = "text/html"), (status = 404, body = RefusalBody),
        (status = 409, description = "The job has no scene, or waits for its turn", body = RefusalBody),
        (status = 422, description = "The scene cannot be viewed", body = RefusalBody),
        (status = 429, description = "Too many views are open", body = RefusalBody)))]
async fn view(
    extract::State(service): Shared,
    Path(id): Path<String>,
    uri: Uri,
) -> ServiceResult<Response> {
    found(&service, &id).await?;
    let all = uri.path_and_query().map_or("", |path| path.as_str());
    let page = all.split_once("/view/").map_or("", |(_, page)| page);
    views::ask(&service, &service.store.job(&id), page).await
}

async fn view_page(
    service: Shared,
    Path((id, _)): Path<(String, String)>,
    uri: Uri,
) -> ServiceResult<Response> {
    view(service, Path(id), uri).await
}

/// Liveness probe of the service.
#[utoipa::path(get, path = "/healthz", responses((status = 200)))]
async fn healthz() -> &'static str {
    "ok\n"
}

/// Readiness probe: checks that the job table is writable and that the disk has free space.
#[utoipa::path(get, path = "/readyz", responses((status = 200), (status = 503, body = RefusalBody)))]
async fn readyz(extract::State(service): Shared) -> ServiceResult<&'static str> {
    let not = |message: String| HttpError::new(StatusCode::SERVICE_UNAVAILABLE, message);
    if let Some(free) = service.store.free().filter(|&free| free < LEAST_FREE) {
        return Err(not(format!(
            "the store's disk is full: {free} bytes are free"
        )));
    }
    if service.slots.is_full() {
        return Err(not(
            "a job found the store's disk full; jobs wait for room".to_owned()
        ));
    }
    let written = service.jobs.write_nothing().await;
    written.map_err(|refusal| not(refusal.message))?;
    Ok("ready\n")
}

/// Returns metrics in the Prometheus text format.
#[utoipa::path(get, path = "/metrics", responses((status = 200, content_type = "text/plain")))]
async fn metrics_page(extract::State(service): Shared) -> ServiceResult<Response> {
    let kind = [(header::CONTENT_TYPE, "text/plain; version=0.0.4")];
    let jobs = service.jobs.counts().await?;
    let free = service.store.free();
    let page = metrics::page(&service.metrics, &service.slots, &jobs, free);
    Ok((kind, page).into_response())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_those_of_rfc_9110() {
        for (text, expected) in [
            ("bytes=0-9", ByteRange::Part(0..10)),
            ("bytes=10-", ByteRange::Part(10..100)),
            ("bytes=-10", ByteRange::Part(90..100)),
            ("bytes=-1000", ByteRange::Part(0..100)),
            ("bytes=90-200", ByteRange::Part(90..100)),
            ("bytes=0-18446744073709551615", ByteRange::Part(0..100)),
            ("bytes=100-", ByteRange::Nothing),
            ("bytes=-0", ByteRange::Nothing),
            ("bytes=9-3", ByteRange::All),
            ("bytes=0-1,5-6", ByteRange::All),
            ("lines=0-1", ByteRange::All),
            ("bytes=99999999999999999999-", ByteRange::All),
        ] {
            assert_eq!(wanted(text, 100), expected, "{text}");
        }
        assert_eq!(wanted("bytes=0-0", 0), ByteRange::Nothing);
    }
}

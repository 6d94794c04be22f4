//! The pages of the service: one function a page, each with its lines for OpenAPI.

use super::connections::Peer;
use super::job_folder::Progress;
use super::jobs::{self, Accepted, Job, Kind, Request, State};
use super::quota::Permit;
use super::refusal::{Refusal, RefusalBody};
use super::scene_files;
use super::shared::Service;
use super::store::{Hash, PREFIX, ResultFile};
use super::{metrics, upload, views, workers};
use crate::error::{Error, printable};
use crate::report::formats::Format;
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

/// Bytes of a scene, or of rays.
const LARGEST_SCENE: u64 = 1 << 20;
const LARGEST_RAYS: u64 = 4 << 20;
/// Jobs in a list.
const LISTED: u32 = 100;
/// Time between two looks at a job that is watched.
const LOOK: Duration = Duration::from_millis(200);
/// Time after which an event stream ends: a client that does not read would hold it for ever.
const LONGEST_STREAM: Duration = Duration::from_secs(600);
/// Bytes at the end of a job's log that are shown.
const SHOWN_LOG: u64 = 1 << 16;
/// Bytes of a file that are read at once.
const PIECE: u64 = 1 << 18;
/// Bytes below which the store is not ready.
const LEAST_FREE: u64 = 1 << 20;

type Shared = extract::State<Arc<Service>>;
type Answer<T> = Result<T, Refusal>;

/// Simulates laser-triangulation sensors: files by their hash, and jobs.
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
    // Axum's sign for a path of several names is none of OpenAPI's.
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
            Refusal::new(
                StatusCode::NOT_FOUND,
                "there is no such page; see /v1/openapi.json",
            )
        })
        .layer(from_fn_with_state(service.clone(), logged))
        .with_state(service)
}

/// Counts and logs each request.
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

/// A job, as clients see it.
#[derive(Serialize, ToSchema)]
struct JobPage {
    /// Its name in the other pages.
    id: String,
    kind: Kind,
    state: State,
    /// When it was sent, by the service's clock (RFC 3339).
    created: String,
    /// When it first ran.
    started: Option<String>,
    /// When it ended.
    finished: Option<String>,
    /// How often a process was started for it: more than once if one was interrupted.
    starts: u32,
    /// Of the command: 0 done, 64 usage, 65 bad scene or mesh, 70 internal, 74 input/output, 75 a limit.
    exit_code: Option<u8>,
    /// Why it failed, or why it waits.
    message: Option<String>,
    /// How far it is.
    progress: Option<Progress>,
    /// What the command prints with --json; of a mistake in a scene its file, line, key, what was found
    /// and expected.
    result: Option<serde_json::Value>,
}

async fn page(service: &Service, job: Job) -> JobPage {
    let folder = service.store.job(&job.id);
    let (progress, result) = upload::on_disk(move || match job.state {
        State::Running => (folder.progress(), None),
        State::Done | State::Failed => (None, folder.result()),
        State::Queued | State::Cancelled => (None, None),
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

async fn found(service: &Service, id: &str) -> Answer<Job> {
    service
        .jobs
        .get(id)
        .await?
        .ok_or_else(|| Refusal::no_job(id))
}

fn hash(digits: &str) -> Answer<Hash> {
    Hash::parse(digits).ok_or_else(|| {
        let expected = "a SHA-256: 64 digits, 0 to 9 and a to f, as sha256sum prints";
        Refusal::new(
            StatusCode::BAD_REQUEST,
            format!("found {digits:?}, expected {expected}"),
        )
    })
}

/// Sends a file that scenes name: a mesh, a sensor, poses, a calibration.
///
/// It is kept under its SHA-256, and a scene names it `sha256:…`. A file that is there is not sent again.
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
) -> Answer<StatusCode> {
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

/// Whether a file is there.
#[utoipa::path(head, path = "/v1/files/{sha256}", params(("sha256" = String, Path)),
    responses((status = 200), (status = 404)))]
async fn file_there(
    extract::State(service): Shared,
    Path(digits): Path<String>,
) -> Answer<StatusCode> {
    Ok(match service.store.file(&hash(&digits)?).exists() {
        true => StatusCode::OK,
        false => StatusCode::NOT_FOUND,
    })
}

/// Removes a file; jobs that are done keep what they read.
#[utoipa::path(delete, path = "/v1/files/{sha256}", params(("sha256" = String, Path)),
    responses((status = 204), (status = 404, body = RefusalBody),
        (status = 409, description = "A job that is not done reads it", body = RefusalBody)))]
async fn delete_file(
    extract::State(service): Shared,
    Path(digits): Path<String>,
) -> Answer<StatusCode> {
    let hash = hash(&digits)?;
    // No job is accepted between the check and the removal.
    let _files = service.files.write().await;
    if service.jobs.reads(&hash).await? {
        let message = "a job that is not done reads this file";
        return Err(Refusal::new(StatusCode::CONFLICT, message));
    }
    let path = service.store.file(&hash);
    match std::fs::remove_file(&path) {
        Ok(()) => Ok(StatusCode::NO_CONTENT),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            Err(Refusal::new(StatusCode::NOT_FOUND, "there is no such file"))
        }
        Err(error) => Err(Error::io("remove", &path)(error).into()),
    }
}

/// What is asked of a job beside its scene.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
struct Asked {
    /// What to compute.
    kind: Kind,
    /// Of a frame: its number, default 0.
    frame: Option<u32>,
    /// Of a scan and of profiles: the frames from A to B − 1.
    #[param(example = "10..20")]
    frames: Option<String>,
    /// Other formats of the cloud of a scan or of profiles, as `csv,e57,pcd`.
    also: Option<String>,
    /// Files that a file of the scene names, as a glTF file its buffers: `NAME=SHA256`, separated by commas.
    #[param(example = "part.bin=0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef")]
    files: Option<String>,
    /// Of rays: the mesh, `sha256:…`.
    mesh: Option<String>,
    /// Of rays: the mesh file's unit, where the file does not say it: um, mm, cm, m or inch.
    #[param(value_type = Option<String>)]
    unit: Option<Unit>,
}

impl Asked {
    fn frames(&self) -> Answer<Option<std::ops::Range<u32>>> {
        let wrong = |message: String| Refusal::new(StatusCode::UNPROCESSABLE_ENTITY, message);
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

    /// The files of the parameter `files`, each of which is in the store.
    fn named(&self, service: &Service) -> Answer<Vec<(String, Hash)>> {
        let wrong = |message: String| Refusal::new(StatusCode::UNPROCESSABLE_ENTITY, message);
        // A name without folders; the scene's name is taken.
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

    fn request(&self, service: &Service, body: &[u8]) -> Answer<Request> {
        let wrong = |message: String| Refusal::new(StatusCode::UNPROCESSABLE_ENTITY, message);
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
        let forms = Format::ALL.map(Format::ending);
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

/// Starts a job: the body is the scene (TOML) as the command line takes it, whose files are named by
/// hash; of rays it is JSON, `{"rays": [[x, y, z, dx, dy, dz], …]}` in mm.
///
/// With the header Idempotency-Key the same job can be sent again, as after a lost answer: it is not
/// done twice.
#[utoipa::path(post, path = "/v1/jobs",
    params(Asked, ("idempotency-key" = Option<String>, Header)),
    request_body(content((String = "application/toml"), (serde_json::Value = "application/json"))),
    responses((status = 202, description = "It waits for its turn", body = JobPage),
        (status = 200, description = "It was sent before, with this key", body = JobPage),
        (status = 413, body = RefusalBody), (status = 415, body = RefusalBody),
        (status = 422, description = "The scene, a file or the key is wrong", body = RefusalBody),
        (status = 429, description = "Too many jobs wait", body = RefusalBody),
        (status = 507, description = "The disk is full", body = RefusalBody)))]
async fn post_job(
    extract::State(service): Shared,
    asked: Result<Query<Asked>, QueryRejection>,
    headers: HeaderMap,
    body: Body,
) -> Answer<Response> {
    let asked = asked.map_err(|error| Refusal::new(StatusCode::BAD_REQUEST, error.body_text()))?;
    let (media, largest) = match asked.kind {
        Kind::Rays => ("application/json", LARGEST_RAYS),
        _ => ("application/toml", LARGEST_SCENE),
    };
    // A form of another site's page cannot be sent with one of these.
    let found = headers
        .get(header::CONTENT_TYPE)
        .and_then(|value| value.to_str().ok());
    if found.and_then(|text| text.split(';').next()).map(str::trim) != Some(media) {
        let message = format!(
            "found the content type {:?}, expected {media}",
            found.unwrap_or("")
        );
        return Err(Refusal::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, message));
    }
    let key = match headers.get("idempotency-key").map(HeaderValue::to_str) {
        None => None,
        Some(Ok(key)) if (1..=255).contains(&key.len()) => Some(key.to_owned()),
        Some(_) => {
            let message = "Idempotency-Key: expected 1 to 255 ASCII characters";
            return Err(Refusal::new(StatusCode::BAD_REQUEST, message));
        }
    };
    let body = upload::whole(body, upload::length(&headers), largest).await?;
    // Until the job is in the table, none of its files is removed.
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
        Accepted::New(job) => (StatusCode::ACCEPTED, job),
        Accepted::Before(job) => (StatusCode::OK, job),
        Accepted::OtherJob => {
            let message = "this Idempotency-Key was sent with another job; take a new one";
            return Err(Refusal::new(StatusCode::UNPROCESSABLE_ENTITY, message));
        }
        Accepted::Full(waiting) => {
            let message = format!("{waiting} jobs wait already; send it again later");
            return Err(Refusal::new(StatusCode::TOO_MANY_REQUESTS, message));
        }
    };
    service.slots.wake();
    let place = [(header::LOCATION, format!("/v1/jobs/{}", job.id))];
    Ok((status, place, Json(page(&service, job).await)).into_response())
}

/// The last hundred jobs, the newest first.
#[utoipa::path(get, path = "/v1/jobs", responses((status = 200, body = Vec<JobPage>)))]
async fn list_jobs(extract::State(service): Shared) -> Answer<Json<Vec<JobPage>>> {
    let mut pages = Vec::new();
    for job in service.jobs.last(LISTED).await? {
        pages.push(page(&service, job).await);
    }
    Ok(Json(pages))
}

/// A job: where it is, how far, and what came of it.
#[utoipa::path(get, path = "/v1/jobs/{id}", params(("id" = String, Path)),
    responses((status = 200, body = JobPage), (status = 404, body = RefusalBody)))]
async fn get_job(extract::State(service): Shared, Path(id): Path<String>) -> Answer<Json<JobPage>> {
    let job = found(&service, &id).await?;
    Ok(Json(page(&service, job).await))
}

/// Removes a job with its results; one that runs is stopped first.
#[utoipa::path(delete, path = "/v1/jobs/{id}", params(("id" = String, Path)),
    responses((status = 204, description = "It is gone"), (status = 202, description = "It is being stopped"),
        (status = 404, body = RefusalBody)))]
async fn delete_job(extract::State(service): Shared, Path(id): Path<String>) -> Answer<StatusCode> {
    let deleted = match service.jobs.delete(&id).await {
        // The table cannot record the deletion: removing the results makes room for it.
        Err(refusal) if refusal.status == StatusCode::INSUFFICIENT_STORAGE => {
            service.store.give_room();
            if service.jobs.rests(&id).await? {
                workers::remove(&service.store.job(&id)).await;
            }
            service.jobs.delete(&id).await?
        }
        other => other?,
    };
    match deleted {
        None => Err(Refusal::no_job(&id)),
        Some(State::Running | State::Cancelled) => {
            tokio::spawn(workers::cancel(service, id));
            Ok(StatusCode::ACCEPTED)
        }
        Some(_) => {
            workers::remove(&service.store.job(&id)).await;
            // The pages are free in any case; the next deletion returns them if this one cannot.
            if let Err(refusal) = service.jobs.shrink().await {
                tracing::warn!("the table of jobs: {}", refusal.message);
            }
            service.slots.wake();
            Ok(StatusCode::NO_CONTENT)
        }
    }
}

/// A job whenever it changes, as server-sent events `job`; the last one is `end`, when it is done, has
/// failed or was deleted.
///
/// A stream ends after ten minutes. Browsers open it again.
#[utoipa::path(get, path = "/v1/jobs/{id}/events", params(("id" = String, Path)),
    responses((status = 200, description = "Events with a job each", content_type = "text/event-stream"),
        (status = 404, body = RefusalBody),
        (status = 429, description = "Too many streams are open", body = RefusalBody)))]
async fn events(
    extract::State(service): Shared,
    peer: Option<extract::Extension<Peer>>,
    Path(id): Path<String>,
) -> Answer<Sse<impl Stream<Item = Result<Event, Infallible>>>> {
    found(&service, &id).await?;
    let address = peer.map_or(Ipv4Addr::UNSPECIFIED.into(), |peer| peer.0.0.ip());
    let permit = service.events.take(address).ok_or_else(|| {
        let message =
            "too many event streams are open; close some, or ask GET /v1/jobs/ID from time to time";
        Refusal::new(StatusCode::TOO_MANY_REQUESTS, message)
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
    // A client that has gone is noticed when it takes nothing.
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(Duration::from_secs(10))))
}

/// A job that a client follows.
struct Watched {
    service: Arc<Service>,
    id: String,
    /// The page that the client got last.
    shown: String,
    end: Instant,
    _permit: Permit,
}

impl Watched {
    /// Waits for the next event, and returns with it whether more follow. `None` at the end of the time.
    async fn next(&mut self) -> Option<(Event, bool)> {
        while Instant::now() < self.end {
            let job = self.service.jobs.get(&self.id).await.ok().flatten();
            let Some(job) = job else {
                return Some((Event::default().event("end").data("null"), false));
            };
            let ended = matches!(job.state, State::Done | State::Failed);
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

/// The files of a job's results that are whole, also while it runs.
#[utoipa::path(get, path = "/v1/jobs/{id}/files", params(("id" = String, Path)),
    responses((status = 200, body = Vec<ResultFile>), (status = 404, body = RefusalBody)))]
async fn list_results(
    extract::State(service): Shared,
    Path(id): Path<String>,
) -> Answer<Json<Vec<ResultFile>>> {
    found(&service, &id).await?;
    Ok(Json(
        upload::on_disk(move || service.store.results(&id)).await,
    ))
}

/// A file of a job's results, or the part of it that the header Range names.
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
) -> Answer<Response> {
    found(&service, &id).await?;
    let kind = media_type(&path);
    let opened = upload::on_disk(move || {
        let file = service.store.open_result(&id, &path)?;
        let data = file.metadata()?;
        std::io::Result::Ok((file, data.len(), entity_tag(&data)))
    });
    let (file, length, tag) = opened.await.map_err(|_| {
        Refusal::new(
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
    // A part of another version of the file would not fit what the client has (RFC 9110, 13.1.5).
    let same = text(header::IF_RANGE).is_none_or(|known| known.trim() == tag);
    let range = text(header::RANGE).filter(|_| same);
    let mut response = Response::builder()
        .header(header::CONTENT_TYPE, kind)
        .header(header::ACCEPT_RANGES, "bytes")
        .header(header::ETAG, &tag)
        .header(header::X_CONTENT_TYPE_OPTIONS, "nosniff")
        // A report runs its own script, and cannot ask the service anything.
        .header(header::CONTENT_SECURITY_POLICY, "sandbox allow-scripts");
    let part = match range.map_or(Wanted::All, |text| wanted(text, length)) {
        Wanted::All => 0..length,
        Wanted::Part(part) => {
            let content = format!("bytes {}-{}/{length}", part.start, part.end - 1);
            response = response
                .status(StatusCode::PARTIAL_CONTENT)
                .header(header::CONTENT_RANGE, content);
            part
        }
        Wanted::Nothing => {
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

/// The messages that a job's process wrote to stderr: the last 64 KiB.
#[utoipa::path(get, path = "/v1/jobs/{id}/log", params(("id" = String, Path)),
    responses((status = 200, content_type = "text/plain"), (status = 404, body = RefusalBody)))]
async fn log(extract::State(service): Shared, Path(id): Path<String>) -> Answer<Response> {
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

/// A page for browsers: the last jobs, with their results.
async fn index(extract::State(service): Shared) -> Answer<Response> {
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

/// The page at `/`.
#[derive(Template)]
#[template(path = "service.html")]
struct IndexPage {
    version: &'static str,
    jobs: Vec<IndexRow>,
}

/// A job in the page at `/`.
struct IndexRow {
    id: String,
    kind: &'static str,
    state: &'static str,
    created: String,
    message: String,
    /// Whether there is a report.
    report: bool,
    /// Whether there is a scene to view.
    scene: bool,
}

/// The bytes of a part of a file, a piece at a time.
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
        // After an error there is nothing more.
        let next = if read.is_ok() { end } else { part.end };
        Some((read, (file, next..part.end)))
    })
}

/// What a header Range asks for.
#[derive(Debug, PartialEq)]
enum Wanted {
    /// Also where it is not understood, as RFC 9110 has it.
    All,
    Part(std::ops::Range<u64>),
    Nothing,
}

/// One range of bytes, of a file of `length`; several are answered with all.
fn wanted(text: &str, length: u64) -> Wanted {
    let Some((first, last)) = text
        .strip_prefix("bytes=")
        .and_then(|text| text.trim().split_once('-'))
    else {
        return Wanted::All;
    };
    let part = match (first.parse::<u64>(), last.parse::<u64>()) {
        (Ok(first), Ok(last)) if first <= last => first..length.min(last.saturating_add(1)),
        (Ok(first), Err(_)) if last.is_empty() => first..length,
        (Err(_), Ok(last)) if first.is_empty() => length.saturating_sub(last)..length,
        _ => return Wanted::All,
    };
    match part.is_empty() {
        true => Wanted::Nothing,
        false => Wanted::Part(part),
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

/// The live view of a job's scene, for a browser: a page, and what it asks for.
///
/// Its sliders change what is seen, not the job; "save as scene" gives a scene that can be sent as a job. The view ends ten minutes after the last
/// request.
#[utoipa::path(get, path = "/v1/jobs/{id}/view/", params(("id" = String, Path)),
    responses((status = 200, content_type = "text/html"), (status = 404, body = RefusalBody),
        (status = 409, description = "The job has no scene, or waits for its turn", body = RefusalBody),
        (status = 422, description = "The scene cannot be viewed", body = RefusalBody),
        (status = 429, description = "Too many views are open", body = RefusalBody)))]
async fn view(
    extract::State(service): Shared,
    Path(id): Path<String>,
    uri: Uri,
) -> Answer<Response> {
    found(&service, &id).await?;
    let all = uri.path_and_query().map_or("", |path| path.as_str());
    let page = all.split_once("/view/").map_or("", |(_, page)| page);
    views::ask(&service, &service.store.job(&id), page).await
}

async fn view_page(
    service: Shared,
    Path((id, _)): Path<(String, String)>,
    uri: Uri,
) -> Answer<Response> {
    view(service, Path(id), uri).await
}

/// Whether the service lives.
#[utoipa::path(get, path = "/healthz", responses((status = 200)))]
async fn healthz() -> &'static str {
    "ok\n"
}

/// Whether it can take jobs: its table can be written, and the disk has room.
#[utoipa::path(get, path = "/readyz", responses((status = 200), (status = 503, body = RefusalBody)))]
async fn readyz(extract::State(service): Shared) -> Answer<&'static str> {
    let not = |message: String| Refusal::new(StatusCode::SERVICE_UNAVAILABLE, message);
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

/// Counts, as Prometheus reads them.
#[utoipa::path(get, path = "/metrics", responses((status = 200, content_type = "text/plain")))]
async fn metrics_page(extract::State(service): Shared) -> Answer<Response> {
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
            ("bytes=0-9", Wanted::Part(0..10)),
            ("bytes=10-", Wanted::Part(10..100)),
            ("bytes=-10", Wanted::Part(90..100)),
            ("bytes=-1000", Wanted::Part(0..100)),
            ("bytes=90-200", Wanted::Part(90..100)),
            ("bytes=0-18446744073709551615", Wanted::Part(0..100)),
            ("bytes=100-", Wanted::Nothing),
            ("bytes=-0", Wanted::Nothing),
            ("bytes=9-3", Wanted::All),
            ("bytes=0-1,5-6", Wanted::All),
            ("lines=0-1", Wanted::All),
            ("bytes=99999999999999999999-", Wanted::All),
        ] {
            assert_eq!(wanted(text, 100), expected, "{text}");
        }
        assert_eq!(wanted("bytes=0-0", 0), Wanted::Nothing);
    }
}

//! HTTP interface of a session.

use super::refused::{HttpResult, ViewError};
use super::session::{Picture, Session};
use super::values::SliderValues;
use crate::error::{Error, Result};
use crate::report::live::{self, LivePage};
use crate::service::RequestGuard;
use axum::Router;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, Request, State};
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::{map_request_with_state, map_response};
use axum::response::{IntoResponse, Json, Response};
use axum::routing::get;
use std::mem::replace;
use std::net::TcpListener;
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::spawn_blocking;

/// Maximum number of pending requests. A page has at most two.
const MOST_WAITING: usize = 32;
/// Interval between checks of the stop flag.
const ASKED_EVERY: Duration = Duration::from_millis(50);

/// Time without a request after which a view started by the service ends.
const LEFT_ALONE: Duration = Duration::from_secs(600);

/// Source of the requests to a view.
pub enum Listener {
    /// Browsers on this machine.
    Browsers(TcpListener),
    /// The service, which authorises requests.
    Service(UnixListener),
}

/// State that all requests share.
#[derive(Clone)]
struct ViewState {
    session: Arc<Session>,
    waiting: Arc<Semaphore>,
    /// Permits for one draft and one final image at a time. They are separate, since the ladder
    /// must not delay drafts.
    drafts: Arc<Semaphore>,
    finals: Arc<Semaphore>,
    /// Stop flag of the most recently requested draft.
    latest: Arc<Mutex<Arc<AtomicBool>>>,
}

/// Cancels a draft when its request ends, either after the response or when the client disconnects.
struct Requested(Arc<AtomicBool>);

impl Drop for Requested {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

type ViewQuery = std::result::Result<Query<SliderValues>, QueryRejection>;

/// Returns the router of a session: the page and its requests, at addresses relative to a base that
/// ends with "/". Authorisation is the task of an outer layer.
fn router(session: Arc<Session>) -> Router {
    let view = ViewState {
        session,
        waiting: Arc::new(Semaphore::new(MOST_WAITING)),
        drafts: Arc::new(Semaphore::new(1)),
        finals: Arc::new(Semaphore::new(1)),
        latest: Arc::default(),
    };
    Router::new()
        .route("/", get(page))
        .route("/live.js", get(|| file("text/javascript", live::SCRIPT)))
        .route("/viewer.js", get(|| file("text/javascript", live::VIEWER)))
        .route("/live.css", get(|| file("text/css", live::STYLE)))
        .route("/draft", get(draft))
        .route("/final", get(last))
        .route("/check", get(check))
        .route("/picture.png", get(png))
        .route("/scene.toml", get(scene))
        .with_state(view)
        .layer(map_response(headers))
}

/// Serves requests on a listener until `stop`. Browser requests are accepted only from this machine
/// and from the page itself.
///
/// # Errors
/// Returns an error if the system provides no threads or closes the listener.
pub fn serve(session: Arc<Session>, listener: Listener, stop: &'static AtomicBool) -> Result<()> {
    let failed = |error: std::io::Error| Error::Exhausted(format!("cannot answer: {error}"));
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .map_err(failed)?;
    let done = runtime.block_on(async move {
        let pages = router(session);
        let stopped = async {
            while !stop.load(Ordering::Relaxed) {
                tokio::time::sleep(ASKED_EVERY).await;
            }
        };
        // Shutdown does not wait for the pages, because they keep their connections open.
        match listener {
            Listener::Browsers(listener) => {
                let guard = RequestGuard::new(listener.local_addr()?, None, &[]);
                let pages = guard.map_err(std::io::Error::other)?.around(pages);
                listener.set_nonblocking(true)?;
                let listener = tokio::net::TcpListener::from_std(listener)?;
                tokio::select! {
                    done = axum::serve(listener, pages) => done,
                    () = stopped => Ok(()),
                }
            }
            Listener::Service(listener) => {
                let asked = Arc::new(Mutex::new(Instant::now()));
                let pages = pages.layer(map_request_with_state(asked.clone(), noted));
                listener.set_nonblocking(true)?;
                let listener = tokio::net::UnixListener::from_std(listener)?;
                tokio::select! {
                    done = axum::serve(listener, pages) => done,
                    () = stopped => Ok(()),
                    () = left_alone(&asked) => Ok(()),
                }
            }
        }
    });
    // The result of a computation in progress is no longer needed.
    runtime.shutdown_background();
    done.map_err(Error::io("listen on", Path::new("the address")))
}

/// Records the time of a request.
async fn noted(State(asked): State<Arc<Mutex<Instant>>>, request: Request) -> Request {
    *asked.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
    request
}

async fn left_alone(asked: &Mutex<Instant>) {
    while asked
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
        .elapsed()
        < LEFT_ALONE
    {
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
}

/// Runs work on a session when it has a permit. The work is not started if the client has
/// disconnected.
async fn work<T: Send + 'static>(
    view: ViewState,
    turn: Arc<Semaphore>,
    work: impl FnOnce(&Session) -> HttpResult<T> + Send + 'static,
) -> HttpResult<T> {
    let waiting = admitted(&view)?;
    work_of_admitted(view, waiting, turn, work).await
}

/// Returns an error if the maximum number of requests is pending.
fn admitted(view: &ViewState) -> HttpResult<OwnedSemaphorePermit> {
    let waiting = view.waiting.clone().try_acquire_owned();
    waiting.map_err(|_| ViewError::busy())
}

async fn work_of_admitted<T: Send + 'static>(
    view: ViewState,
    waiting: OwnedSemaphorePermit,
    turn: Arc<Semaphore>,
    work: impl FnOnce(&Session) -> HttpResult<T> + Send + 'static,
) -> HttpResult<T> {
    let turn = turn.acquire_owned().await.expect("it is never closed");
    let done = spawn_blocking(move || {
        // The permits are released when the work ends, even if the client has disconnected.
        let _held = (waiting, turn);
        view.session.install(|| work(&view.session))
    });
    done.await.unwrap_or_else(|_| Err(ViewError::fault()))
}

async fn page(State(view): State<ViewState>) -> HttpResult<Response> {
    let turn = view.finals.clone();
    let html = work(view, turn, |session| {
        let scene = session.scene();
        let page = LivePage {
            title: scene.path.display().to_string(),
            part: scene.part.clone(),
            sliders: session.sliders(),
            viewer: session.viewer(),
        };
        Ok(page.html())
    });
    Ok((
        [(header::CONTENT_TYPE, "text/html; charset=utf-8")],
        html.await?,
    )
        .into_response())
}

async fn file(kind: &'static str, content: &'static str) -> Response {
    (
        [(header::CONTENT_TYPE, format!("{kind}; charset=utf-8"))],
        content,
    )
        .into_response()
}

async fn draft(State(view): State<ViewState>, asked: ViewQuery) -> HttpResult<Response> {
    let Query(values) = asked?;
    let turn = view.drafts.clone();
    // A rejected request cancels no draft. Otherwise many simultaneous requests would produce no
    // draft.
    let waiting = admitted(&view)?;
    let stop = Arc::new(AtomicBool::new(false));
    let requested = Requested(stop.clone());
    let before = replace(
        &mut *view.latest.lock().unwrap_or_else(PoisonError::into_inner),
        stop.clone(),
    );
    before.store(true, Ordering::Relaxed);
    let draft = move |session: &Session| session.preview(&values, &stop);
    let picture = work_of_admitted(view, waiting, turn, draft).await;
    drop(requested);
    Ok(packed(&picture?))
}

async fn last(State(view): State<ViewState>, asked: ViewQuery) -> HttpResult<Response> {
    let Query(values) = asked?;
    let turn = view.finals.clone();
    let picture = work(view, turn, move |session| session.last(&values));
    Ok(packed(&picture.await?))
}

async fn check(State(view): State<ViewState>, asked: ViewQuery) -> HttpResult<Response> {
    let Query(values) = asked?;
    let turn = view.finals.clone();
    let page = work(view, turn, move |session| session.check(&values));
    Ok(Json(page.await?).into_response())
}

async fn png(State(view): State<ViewState>, asked: ViewQuery) -> HttpResult<Response> {
    let Query(values) = asked?;
    let turn = view.finals.clone();
    let name = format!("frame-{:06}.png", values.frame);
    let png = work(view, turn, move |session| session.png(&values));
    Ok(download("image/png", &name, png.await?))
}

async fn scene(State(view): State<ViewState>, asked: ViewQuery) -> HttpResult<Response> {
    let Query(values) = asked?;
    let turn = view.drafts.clone();
    let text = work(view, turn, move |session| session.scene_file(&values));
    Ok(download(
        "application/toml",
        "scene.toml",
        text.await?.into_bytes(),
    ))
}

fn download(kind: &'static str, name: &str, content: Vec<u8>) -> Response {
    let save = format!("attachment; filename=\"{name}\"");
    let headers = [
        (header::CONTENT_TYPE, kind.to_owned()),
        (header::CONTENT_DISPOSITION, save),
    ];
    (headers, content).into_response()
}

/// Encodes the header length (four bytes, little-endian), the header as JSON, and the image.
fn packed(picture: &Picture) -> Response {
    let head = serde_json::to_vec(picture).expect("a picture's head is JSON");
    let mut bytes = (head.len() as u32).to_le_bytes().to_vec();
    bytes.extend(head);
    bytes.extend(&picture.image);
    ([(header::CONTENT_TYPE, "application/octet-stream")], bytes).into_response()
}

/// Adds headers that prevent loading from other origins, framing by other pages, and cross-origin
/// reads.
async fn headers(mut response: Response) -> Response {
    const HEADERS: [(HeaderName, &str); 5] = [
        (header::CACHE_CONTROL, "no-store"),
        (
            header::CONTENT_SECURITY_POLICY,
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
             base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        ),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (
            HeaderName::from_static("cross-origin-resource-policy"),
            "same-origin",
        ),
    ];
    for (name, value) in HEADERS {
        let all = response.headers_mut();
        all.insert(name, HeaderValue::from_static(value));
    }
    response
}

impl From<QueryRejection> for ViewError {
    fn from(rejection: QueryRejection) -> ViewError {
        ViewError {
            key: None,
            message: rejection.body_text(),
            status: 400,
        }
    }
}

impl IntoResponse for ViewError {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).expect("these are HTTP's");
        (status, Json(self)).into_response()
    }
}

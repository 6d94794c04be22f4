//! HTTP service: files addressed by hash and jobs in SQLite. Each job runs in a separate process
//! that executes a command of the command line in a separate folder.
//!
//! ```text
//! STORE/jobs.db        the jobs (SQLite)
//! STORE/files/HASH     meshes and other files of scenes, by SHA-256
//! STORE/jobs/ID/       folder of a job: in/ with scene.toml and links to its files, out/
//! ```
//!
//! The service itself parses no mesh. Files from clients are opened by the job's process, which has
//! resource limits. Permissions are documented in `docs/security.md`.

mod api;
mod connections;
mod drain;
mod guard;
mod job_folder;
mod jobs;
mod metrics;
mod quota;
mod refusal;
mod scene_files;
mod shared;
mod slots;
mod store;
mod upload;
mod views;
mod workers;

pub use connections::accept;
pub use guard::RequestGuard;
pub use job_folder::JobLimits;
pub(crate) use job_folder::{JobFolder, JobOutcome, Progress};
pub use refusal::HttpError;
pub use shared::{Service, Settings};
pub use workers::TOKEN_VARIABLE;

use crate::error::{Error, Result};
use axum::middleware::from_fn_with_state;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Minimum number of bytes read from the body of a rejected request, because clients finish sending
/// before they read the response.
const LEAST_DISCARDED: u64 = 1 << 30;

/// Returns the routes of the service.
pub fn router(service: Arc<Service>) -> axum::Router {
    api::router(service)
}

/// Serves `pages` and runs jobs until `stop` is set. Calls `listening` with the bound address.
///
/// # Errors
/// `Error::Usage` for a non-loopback address without a token; an address that cannot be bound.
pub fn serve(
    service: Arc<Service>,
    pages: axum::Router,
    listening: impl FnOnce(SocketAddr) -> Result<()>,
    stop: &AtomicBool,
) -> Result<()> {
    let settings = &service.settings;
    let guard = RequestGuard::new(settings.listen, settings.token.as_deref(), &settings.hosts)?;
    let pages = guard.around(pages);
    let discarded = LEAST_DISCARDED.max(settings.largest_file.saturating_mul(2));
    let pages = pages.layer(from_fn_with_state(discarded, drain::discard_rest));
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .max_blocking_threads(16)
        .enable_all()
        .build()
        .map_err(|error| Error::Exhausted(format!("cannot start the service: {error}")))?;
    let done = runtime.block_on(async {
        let address = settings.listen;
        let listener = tokio::net::TcpListener::bind(address).await;
        let failed = || Error::io("listen on", address.to_string().as_ref());
        let listener = listener.map_err(failed())?;
        listening(listener.local_addr().map_err(failed())?)?;
        tokio::spawn(workers::schedule(service.clone()));
        tokio::spawn(connections::accept(listener, pages));
        while !stop.load(std::sync::atomic::Ordering::Relaxed) {
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
        workers::stop_all(&service).await;
        Ok(())
    });
    runtime.shutdown_timeout(std::time::Duration::from_millis(500));
    done
}

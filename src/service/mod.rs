//! Jobs over HTTP: files by their hash, jobs in SQLite, each in a process of its own that does what the
//! command line does, in a folder as the command line writes it.
//!
//! ```text
//! STORE/jobs.db        the jobs (SQLite)
//! STORE/files/HASH     meshes and whatever else a scene names, by SHA-256
//! STORE/jobs/ID/       a job's folder: in/ with scene.toml and links to its files, out/
//! ```
//!
//! The service itself reads no mesh: what a client sends is opened by the job's process, which has limits.
//! `docs/security.md` says who may do what.

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
pub use guard::Guard;
pub use job_folder::Limits;
pub(crate) use job_folder::{JobFolder, Outcome, Progress};
pub use refusal::Refusal;
pub use shared::{Service, Settings};
pub use workers::TOKEN_VARIABLE;

use crate::error::{Error, Result};
use axum::middleware::from_fn_with_state;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Bytes that are read of a body which is refused, at least: a client finishes sending before it reads why.
const LEAST_DISCARDED: u64 = 1 << 30;

/// The service's pages.
pub fn router(service: Arc<Service>) -> axum::Router {
    api::router(service)
}

/// Serves `pages` and runs jobs until `stop`. `listening` hears where.
///
/// # Errors
/// `Error::Usage` for an address beyond loopback without a token; an address that cannot be listened on.
pub fn serve(
    service: Arc<Service>,
    pages: axum::Router,
    listening: impl FnOnce(SocketAddr) -> Result<()>,
    stop: &AtomicBool,
) -> Result<()> {
    let settings = &service.settings;
    let guard = Guard::new(settings.listen, settings.token.as_deref(), &settings.hosts)?;
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

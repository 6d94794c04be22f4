//! Components of a service.

use super::job_folder::JobLimits;
use super::jobs::Jobs;
use super::metrics::Metrics;
use super::quota::Quota;
use super::slots::Slots;
use super::store::Store;
use crate::error::Result;
use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use tokio::sync::{Mutex, RwLock, Semaphore};

/// Free disk space below which the reserved space is released at startup, bytes.
const LEAST_ROOM: u64 = 1 << 16;
/// Maximum number of simultaneous event streams; at most half of them for one address.
const EVENT_STREAMS: usize = 64;

/// Settings of a service.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Address to listen on; port 0 selects a free port.
    pub listen: SocketAddr,
    /// Folder of files and jobs.
    pub store: PathBuf,
    /// Token that clients must send. `None` requires no token and allows loopback addresses only.
    pub token: Option<String>,
    /// Host names, in addition to `localhost`, by which clients may call the service.
    pub hosts: Vec<String>,
    /// Program whose command `job` executes a job.
    pub program: OsString,
    /// Number of jobs that run in parallel.
    pub jobs_at_once: usize,
    /// Maximum number of waiting jobs.
    pub longest_queue: u32,
    /// Maximum size of an uploaded file, bytes.
    pub largest_file: u64,
    /// Limits of each job.
    pub limits: JobLimits,
}

/// State shared by the request handlers.
pub struct Service {
    pub(super) settings: Settings,
    pub(super) store: Store,
    pub(super) jobs: Jobs,
    pub(super) slots: Slots,
    pub(super) views: Views,
    pub(super) metrics: Metrics,
    /// Read-locked while a job is accepted, write-locked while a file is removed.
    pub(super) files: RwLock<()>,
    /// Clients that follow a job by events.
    pub(super) events: Quota,
}

/// Live views.
pub struct Views {
    /// One permit for each open view.
    pub places: Arc<Semaphore>,
    /// Held while a view is opened.
    pub turn: Mutex<()>,
}

impl Service {
    /// Opens the store with exclusive access.
    ///
    /// # Errors
    /// `Error::Busy`; errors of the file system and of SQLite.
    pub fn open(settings: Settings) -> Result<Arc<Service>> {
        let store = Store::open(&settings.store)?;
        // Opening the table may need to write. On a full disk, the reserved space is released for
        // it.
        if store.free().is_some_and(|free| free < LEAST_ROOM) {
            store.release_disk();
        }
        let jobs = Jobs::open(&settings.store.join("jobs.db"))?;
        Ok(Arc::new(Service {
            slots: Slots::new(settings.jobs_at_once),
            views: Views {
                places: Arc::new(Semaphore::new(settings.jobs_at_once)),
                turn: Mutex::default(),
            },
            metrics: Metrics::default(),
            files: RwLock::default(),
            events: Quota::new(EVENT_STREAMS, EVENT_STREAMS / 2),
            settings,
            store,
            jobs,
        }))
    }
}

//! What a service is made of.

use super::job_folder::Limits;
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

/// Bytes of free room below which the reserved room is released at the start.
const LEAST_ROOM: u64 = 1 << 16;
/// Event streams at the same time; one address has half of them at most.
const EVENT_STREAMS: usize = 64;

/// What a service is started with.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Where to listen; port 0 takes a free one.
    pub listen: SocketAddr,
    /// Folder of the jobs.
    pub store: PathBuf,
    /// What a client must send; `None`: nothing, and only a loopback address may be listened on.
    pub token: Option<String>,
    /// Names beside `localhost` by which clients may call the service.
    pub hosts: Vec<String>,
    /// The program whose command `job` runs a job.
    pub program: OsString,
    /// Jobs that run at the same time.
    pub jobs_at_once: usize,
    /// Jobs that may wait.
    pub longest_queue: u32,
    /// Bytes of a file that is sent.
    pub largest_file: u64,
    /// Of each job.
    pub limits: Limits,
}

/// All that the handlers of requests share.
pub struct Service {
    pub(super) settings: Settings,
    pub(super) store: Store,
    pub(super) jobs: Jobs,
    pub(super) slots: Slots,
    pub(super) views: Views,
    pub(super) metrics: Metrics,
    /// Read while a job is accepted, written while a file is removed.
    pub(super) files: RwLock<()>,
    /// Clients that follow a job by events.
    pub(super) events: Quota,
}

/// Live views.
pub struct Views {
    /// One for each view that may be open.
    pub places: Arc<Semaphore>,
    /// Of the one that opens a view.
    pub turn: Mutex<()>,
}

impl Service {
    /// Opens the store, which no other service may have open.
    ///
    /// # Errors
    /// `Error::Busy`; what the file system or SQLite refuse.
    pub fn open(settings: Settings) -> Result<Arc<Service>> {
        let store = Store::open(&settings.store)?;
        // Opening the table may need to write: on a full disk, the room that is reserved for it.
        if store.free().is_some_and(|free| free < LEAST_ROOM) {
            store.give_room();
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

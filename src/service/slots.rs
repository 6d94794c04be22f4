//! Slots for jobs that run in parallel.

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{Notify, Semaphore};

/// Bytes that must become free before a job that found the disk full continues.
pub const ROOM: u64 = 4 << 20;
/// Time after which such a job is retried in any case, because another process may have used the
/// freed space.
const FULL: Duration = Duration::from_secs(60);
/// Slots for jobs, and conditions that delay them.
pub struct Slots {
    /// One permit for each job that may run.
    pub places: Arc<Semaphore>,
    /// Notified when a job arrives.
    pub news: Notify,
    /// True if the service is shutting down.
    pub stopping: AtomicBool,
    full: Mutex<Option<Full>>,
    /// Number of started processes.
    pub started: AtomicU64,
    /// Number of processes that ended without an outcome.
    pub died: AtomicU64,
}

/// State of the disk when it was found full.
struct Full {
    since: Instant,
    free: u64,
}

impl Slots {
    pub fn new(at_once: usize) -> Slots {
        Slots {
            places: Arc::new(Semaphore::new(at_once)),
            news: Notify::new(),
            stopping: AtomicBool::new(false),
            full: Mutex::new(None),
            started: AtomicU64::new(0),
            died: AtomicU64::new(0),
        }
    }

    pub fn wake(&self) {
        self.news.notify_one();
    }

    /// Returns true if jobs wait for disk space.
    pub fn is_full(&self) -> bool {
        self.full
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .is_some()
    }

    pub fn found_full(&self, free: Option<u64>) {
        let free = free.unwrap_or(0);
        let since = Instant::now();
        *self.full.lock().unwrap_or_else(PoisonError::into_inner) = Some(Full { since, free });
    }

    /// Returns true if the free disk space permits a job to start.
    pub fn has_room(&self, free: Option<u64>) -> bool {
        let mut full = self.full.lock().unwrap_or_else(PoisonError::into_inner);
        let room = full.as_ref().is_none_or(|full| {
            let more = free.is_none_or(|free| free >= full.free + ROOM);
            more || full.since.elapsed() > FULL
        });
        if room {
            *full = None;
        }
        room
    }
}

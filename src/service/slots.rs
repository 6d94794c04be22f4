//! Places for jobs that run at the same time.

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{Notify, Semaphore};

/// Bytes that must have become free before a job that found the disk full goes on.
pub const ROOM: u64 = 4 << 20;
/// Time after which it is tried again all the same: another process may have taken the room.
const FULL: Duration = Duration::from_secs(60);
/// Places for jobs, and what holds them up.
pub struct Slots {
    /// One for each job that may run.
    pub places: Arc<Semaphore>,
    /// A job came.
    pub news: Notify,
    /// The service ends.
    pub stopping: AtomicBool,
    full: Mutex<Option<Full>>,
    /// Processes that were started.
    pub started: AtomicU64,
    /// Those that died without a word.
    pub died: AtomicU64,
}

/// The disk was full.
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

    /// Whether jobs wait for room.
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

    /// Whether a job may start, as far as the disk goes.
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

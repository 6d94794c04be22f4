//! Runs work on worker threads while Python threads continue; Ctrl-C cancels the work.

use crate::Error;
use pyo3::prelude::*;
use rayon::ThreadPool;
use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use std::time::Duration;

/// Interval between checks for Ctrl-C.
const LISTENS: Duration = Duration::from_millis(50);

type Pools = HashMap<(u32, usize), Arc<ThreadPool>>;

/// Thread pools by process id and number of threads. They are shared and never end. A forked
/// process has none of its parent's threads and creates separate pools.
static POOLS: LazyLock<Mutex<Pools>> = LazyLock::new(Mutex::default);

/// Returns the requested number of threads, limited by the number available; all available ones for
/// `None`.
pub fn wanted(threads: Option<&Bound<'_, PyAny>>) -> PyResult<usize> {
    let granted = std::thread::available_parallelism().map_or(1, usize::from);
    let Some(given) = threads else {
        return Ok(granted);
    };
    let count = given.extract::<usize>().ok().filter(|&count| count > 0);
    match count {
        Some(count) => Ok(count.min(granted)),
        None => {
            let found = given.repr()?;
            let message = format!("threads: found {found}, expected a whole number from 1");
            Err(Error::new_err(message))
        }
    }
}

/// Returns a pool with the given number of threads.
///
/// The lock is only taken with the GIL held, and `fork` also holds the GIL. No child process
/// therefore finds it locked by a thread that does not exist there.
fn pool(_: Python<'_>, threads: usize) -> PyResult<Arc<ThreadPool>> {
    let mut pools = POOLS.lock().unwrap_or_else(PoisonError::into_inner);
    let key = (std::process::id(), threads);
    if let Some(pool) = pools.get(&key) {
        return Ok(pool.clone());
    }
    let built = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = built.map_err(|error| {
        Error::new_err(format!(
            "cannot start {threads} threads: {error}; take fewer threads"
        ))
    })?;
    Ok(pools.entry(key).or_insert(Arc::new(pool)).clone())
}

/// Runs `work` on a pool with the given number of threads, without the GIL. Ctrl-C sets the flag
/// passed to `work`, and its result is then discarded. Returns KeyboardInterrupt or an exception
/// raised by another signal handler.
pub fn run<T: Send>(
    py: Python<'_>,
    threads: usize,
    work: impl FnOnce(&AtomicBool) -> T + Send,
) -> PyResult<T> {
    run_telling(py, threads, || Ok(()), work)
}

/// Runs `work` as [`run`] does and calls `tell` on this thread at every check for Ctrl-C. An
/// exception raised by `tell` cancels the work too.
pub fn run_telling<T: Send>(
    py: Python<'_>,
    threads: usize,
    tell: impl Fn() -> PyResult<()>,
    work: impl FnOnce(&AtomicBool) -> T + Send,
) -> PyResult<T> {
    let pool = pool(py, threads)?;
    let (stop, mut result) = (AtomicBool::new(false), None);
    let heard = pool.in_place_scope(|scope| {
        let (sender, mut done) = mpsc::channel::<()>();
        scope.spawn(|_| {
            let _sender = sender; // dropped at the end, after a panic too
            result = Some(work(&stop));
        });
        let mut heard = Ok(());
        loop {
            let waited;
            (done, waited) = py.detach(move || {
                let waited = done.recv_timeout(LISTENS);
                (done, waited)
            });
            if waited != Err(RecvTimeoutError::Timeout) {
                return heard;
            }
            if heard.is_ok() {
                heard = py.check_signals().and_then(|()| tell());
                stop.store(heard.is_err(), Relaxed);
            }
        }
    });
    heard.map(|()| result.expect("a scope ends after its work"))
}

//! Handling of signals: termination, file size limit, and aborts for lack of memory.

use super::STOP;
use super::error_output::ErrorPrinter;
use super::refused;
use crate::error::{Error, Result};
use signal_hook::consts::{SIGABRT, SIGHUP, SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::iterator::Signals;
use signal_hook::{flag, low_level};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

/// Time for the work to end in order after a request to stop. After it the process exits
/// immediately. Files are written atomically and the journal tolerates a kill, so nothing is
/// corrupted. Frames that are not yet in the journal are lost.
const GRACE: Duration = Duration::from_secs(2);

/// Exit code for temporary failures (BSD `sysexits.h`): run again.
const TEMPORARY: i32 = 75;

/// Installs the signal handlers; `complaints` reports the termination. Returns an error if no
/// thread can be started.
pub fn listen(complaints: ErrorPrinter) -> Result<()> {
    let failed = |error: std::io::Error| Error::Exhausted(format!("cannot start: {error}"));
    // Without a handler, exceeding the file size limit kills the process. With one, the write fails
    // and is reported.
    flag::register(SIGXFSZ, Arc::default()).map_err(failed)?;
    // An abort because the system refuses memory is temporary. Every other abort is a bug,
    // including one after a panic. The signal then kills the process, as it does without a handler.
    let refused = refused::flag();
    refused::note_at_abort().map_err(failed)?;
    flag::register_conditional_shutdown(SIGABRT, TEMPORARY, refused.clone()).map_err(failed)?;
    let always = Arc::new(AtomicBool::new(true));
    flag::register_conditional_default(SIGABRT, always).map_err(failed)?;
    let tell = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        refused.store(false, Ordering::Relaxed);
        tell(panic);
    }));
    let signals = Signals::new([SIGINT, SIGTERM, SIGHUP]).map_err(failed)?;
    let listener = thread::Builder::new().name("signals".to_owned());
    listener
        .spawn(move || stop_on(signals, complaints))
        .map_err(failed)?;
    Ok(())
}

/// Requests an orderly end at the first signal. Exits immediately at a second signal or after
/// [`GRACE`].
fn stop_on(mut signals: Signals, complaints: ErrorPrinter) {
    while signals.wait().next().is_none() {}
    STOP.store(true, Ordering::Relaxed);
    let end = Instant::now() + GRACE;
    while Instant::now() < end && signals.pending().next().is_none() {
        thread::sleep(Duration::from_millis(10));
    }
    complaints.say(&Error::Interrupted);
    low_level::exit(TEMPORARY);
}

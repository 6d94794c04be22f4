//! What the system tells the program: to stop, that a file grows too large, that there is
//! no more memory.

use super::STOP;
use super::complaint::Complaints;
use super::refused;
use crate::error::{Error, Result};
use signal_hook::consts::{SIGABRT, SIGHUP, SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::iterator::Signals;
use signal_hook::{flag, low_level};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

/// Time that work which was told to stop may take to end in order; after it the program
/// ends where it is. Files appear whole and the journal bears a kill, so nothing is
/// broken, but frames that are not yet in the journal are lost.
const GRACE: Duration = Duration::from_secs(2);

/// Temporary, after BSD `sysexits.h`: run again.
const TEMPORARY: i32 = 75;

/// Starts to listen; `complaints` say that it ends. Errors: the system gives no thread for it.
pub fn listen(complaints: Complaints) -> Result<()> {
    let failed = |error: std::io::Error| Error::Exhausted(format!("cannot start: {error}"));
    // Without a handler a file that grows too large ends the program; with one the write
    // fails and is reported.
    flag::register(SIGXFSZ, Arc::default()).map_err(failed)?;
    // An abort because the system refuses memory is temporary. Every
    // other abort is a fault of the program, and so is one after a panic: the signal ends
    // the program, as it does without a handler.
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

/// The first signal asks for an orderly end; after a second, or when that takes too long,
/// the program ends at once.
fn stop_on(mut signals: Signals, complaints: Complaints) {
    while signals.wait().next().is_none() {}
    STOP.store(true, Ordering::Relaxed);
    let end = Instant::now() + GRACE;
    while Instant::now() < end && signals.pending().next().is_none() {
        thread::sleep(Duration::from_millis(10));
    }
    complaints.say(&Error::Interrupted);
    low_level::exit(TEMPORARY);
}

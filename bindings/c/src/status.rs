//! Result of a call: a status code, and a message for the user.

use crate::environment;
use lasertrace_core::Error;
use std::any::Any;
use std::cell::RefCell;
use std::ffi::{CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Status of a call.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum lasertrace_status {
    /// Success.
    Ok = 0,
    /// Invalid argument: NULL, a wrong length or an invalid ray.
    Argument = 1,
    /// Invalid handle: freed, of a different type, or never created.
    Handle = 2,
    /// Error in a scene or mesh file; the message contains file, line and key.
    Input = 3,
    /// File system error.
    File = 4,
    /// Insufficient memory or threads.
    Resources = 5,
    /// Stopped by the progress function.
    Stopped = 6,
    /// Error of Embree or a bug of this library; please report it.
    Internal = 7,
}

/// Reason for the failure of a call.
pub struct Failure {
    pub status: lasertrace_status,
    pub message: String,
}

pub type Outcome<T = ()> = Result<T, Failure>;

impl Failure {
    pub fn argument(message: impl Into<String>) -> Failure {
        Failure {
            status: lasertrace_status::Argument,
            message: message.into(),
        }
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Failure {
        let status = match &error {
            Error::Usage(_) => lasertrace_status::Argument,
            Error::Input(_) | Error::Warned(_) => lasertrace_status::Input,
            Error::Io { .. } | Error::OtherRun { .. } | Error::Occupied { .. } | Error::Busy(_) => {
                lasertrace_status::File
            }
            Error::Memory { .. } | Error::Exhausted(_) => lasertrace_status::Resources,
            Error::Interrupted => lasertrace_status::Stopped,
            Error::Embree(_) => lasertrace_status::Internal,
        };
        Failure {
            status,
            message: error.to_string(),
        }
    }
}

impl From<rayon::ThreadPoolBuildError> for Failure {
    fn from(error: rayon::ThreadPoolBuildError) -> Failure {
        Failure {
            status: lasertrace_status::Resources,
            message: format!("threads cannot be started: {error}"),
        }
    }
}

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}

/// Runs the body of a function and stores the error message. A panic is converted to a status. The
/// floating-point environment of the caller does not affect the computation and is restored at the
/// end.
pub fn enter(function: &str, body: impl FnOnce() -> Outcome) -> lasertrace_status {
    // A panic may leave only the caller's buffers incomplete, which the status indicates.
    let body = || environment::same_process().and_then(|()| body());
    let done = environment::shielded(|| catch_unwind(AssertUnwindSafe(body)));
    let failure = match done {
        Ok(Ok(())) => return lasertrace_status::Ok,
        Ok(Err(failure)) => failure,
        Err(panic) => Failure {
            status: lasertrace_status::Internal,
            message: format!("a defect of this library: {}", said(&*panic)),
        },
    };
    // Messages do not contain NUL, which would truncate them in C.
    let text = format!("{function}: {}", failure.message).replace('\0', "\u{fffd}");
    // The thread-local variable may already be destroyed in a thread that is ending.
    let _ = LAST.try_with(|last| {
        *last.borrow_mut() = CString::new(text).unwrap_or_default();
    });
    failure.status
}

fn said(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or(panic.downcast_ref::<&str>().copied())
        .unwrap_or("a panic without a message")
}

/// Returns the message of the last failed call of this thread in UTF-8, preceded by the name of the
/// function. Returns "" if no call has failed. The string is valid until the next failed call of
/// this thread.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_last_error() -> *const c_char {
    LAST.try_with(|last| last.borrow().as_ptr())
        .unwrap_or(c"".as_ptr())
}

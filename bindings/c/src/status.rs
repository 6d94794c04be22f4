//! How a call went: a status for the program, a sentence for the person.

use crate::environment;
use lasertrace_core::Error;
use std::any::Any;
use std::cell::RefCell;
use std::ffi::{CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// How a call went.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum lasertrace_status {
    /// Done.
    Ok = 0,
    /// An argument is wrong: NULL, a number that does not fit, a ray that is none.
    Argument = 1,
    /// A handle is not live: freed, of another kind, or made up.
    Handle = 2,
    /// A scene or mesh file is wrong; the message names file, line and key.
    Input = 3,
    /// The file system refused.
    File = 4,
    /// Too little memory, or no thread to be had.
    Resources = 5,
    /// The progress function asked to stop.
    Stopped = 6,
    /// A failure of Embree, or a defect of this library: please report it.
    Internal = 7,
}

/// Why a call did not do what was asked.
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

/// Runs the body of a function and stores the error message; a panic becomes a status. The
/// caller's floating-point environment has no effect on the work and is restored at its end.
pub fn enter(function: &str, body: impl FnOnce() -> Outcome) -> lasertrace_status {
    // What a panic may leave half done are the caller's buffers, and a status says so.
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
    // A message never holds a NUL of its own; C would see less of it.
    let text = format!("{function}: {}", failure.message).replace('\0', "\u{fffd}");
    // A thread that is about to end may have lost its place for it.
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

/// What was wrong with the last call of this thread that failed, in UTF-8, with the name of
/// the function before it; "" if none has. Lives until the next call of this thread that
/// fails.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_last_error() -> *const c_char {
    LAST.try_with(|last| last.borrow().as_ptr())
        .unwrap_or(c"".as_ptr())
}

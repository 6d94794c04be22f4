//! Protection against changes of the process: the floating-point environment of the caller's
//! thread, and `fork`.

use crate::status::{Failure, Outcome, lasertrace_status};
use std::ffi::c_int;
use std::sync::atomic::{AtomicU32, Ordering};

/// A copy of C's floating-point environment: rounding mode, traps, flags, and the treatment of
/// denormal numbers. (C's `fenv_t` takes 8 to 32 bytes on Linux.)
#[repr(C, align(16))]
#[derive(Clone, Copy)]
pub struct Environment([u64; 8]);

// C11, 7.6.4; in libm.
unsafe extern "C" {
    fn fegetenv(environment: *mut Environment) -> c_int;
    fn fesetenv(environment: *const Environment) -> c_int;
}

/// `FE_DFL_ENV` of glibc and musl: round to nearest, no traps, denormal numbers kept.
const DEFAULT: *const Environment = std::ptr::without_provenance(usize::MAX);

impl Environment {
    /// Returns the environment of this thread.
    pub fn current() -> Environment {
        let mut environment = Environment([0; 8]);
        // SAFETY: the buffer is as large and aligned as any `fenv_t`.
        unsafe { fegetenv(&mut environment) };
        environment
    }

    /// Calls a function of the caller's in this environment.
    pub fn during<T>(&self, function: impl FnOnce() -> T) -> T {
        // SAFETY: `current` filled it.
        unsafe { during(self, function) }
    }
}

/// Does something in the default environment, and restores the one before. A thread that is
/// started meanwhile inherits the default, as Linux copies the environment of the thread that
/// starts it.
pub fn shielded<T>(body: impl FnOnce() -> T) -> T {
    // SAFETY: the value that the C library defines for its default.
    unsafe { during(DEFAULT, body) }
}

/// # Safety
/// `environment` leads to an environment that `fegetenv` filled, or is `DEFAULT`.
unsafe fn during<T>(environment: *const Environment, body: impl FnOnce() -> T) -> T {
    let before = Environment::current();
    // SAFETY: by the caller's word.
    unsafe { fesetenv(environment) };
    // No panic leaves it: `enter` catches those of the library, and C has none.
    let result = body();
    // SAFETY: filled above.
    unsafe { fesetenv(&before) };
    result
}

/// Refuses a call in a child of the process that first called the library: `fork` copies only
/// the thread that calls it, so the child would wait without end for the others.
pub fn same_process() -> Outcome {
    /// The process of the first call; 0 before it.
    static FIRST: AtomicU32 = AtomicU32::new(0);
    let here = std::process::id();
    match FIRST.compare_exchange(0, here, Ordering::Relaxed, Ordering::Relaxed) {
        Err(first) if first != here => Err(Failure {
            status: lasertrace_status::Resources,
            message: format!(
                "found process {here}, a fork of {first}, which called this library before; \
                 its threads are not in the child: fork before the first call, or call exec"
            ),
        }),
        _ => Ok(()),
    }
}

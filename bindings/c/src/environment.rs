//! Protection against process state of the caller: the floating-point environment of the calling
//! thread, and `fork`.

use crate::status::{Failure, Outcome, lasertrace_status};
use std::ffi::c_int;
use std::sync::atomic::{AtomicU32, Ordering};

/// Copy of C's floating-point environment: rounding mode, traps, flags and the treatment of
/// denormal numbers. C's `fenv_t` takes 8 to 32 bytes on Linux.
#[repr(C, align(16))]
#[derive(Clone, Copy)]
pub struct Environment([u64; 8]);

// C11, 7.6.4; in libm.
unsafe extern "C" {
    fn fegetenv(environment: *mut Environment) -> c_int;
    fn fesetenv(environment: *const Environment) -> c_int;
}

/// `FE_DFL_ENV` of glibc and musl: round to nearest, no traps, denormal numbers enabled.
const DEFAULT: *const Environment = std::ptr::without_provenance(usize::MAX);

impl Environment {
    /// Returns the environment of this thread.
    pub fn current() -> Environment {
        let mut environment = Environment([0; 8]);
        // SAFETY: the buffer is at least as large and as aligned as any `fenv_t`.
        unsafe { fegetenv(&mut environment) };
        environment
    }

    /// Calls a function of the caller in this environment.
    pub fn during<T>(&self, function: impl FnOnce() -> T) -> T {
        // SAFETY: `current` initialised the environment.
        unsafe { during(self, function) }
    }
}

/// Runs `body` in the default environment and restores the previous one. Threads started meanwhile
/// inherit the default, because Linux copies the environment of the starting thread.
pub fn shielded<T>(body: impl FnOnce() -> T) -> T {
    // SAFETY: `DEFAULT` is the value that the C library defines for its default.
    unsafe { during(DEFAULT, body) }
}

/// Runs `body` in the given environment.
///
/// # Safety
/// `environment` must point to an environment initialised by `fegetenv`, or be `DEFAULT`.
unsafe fn during<T>(environment: *const Environment, body: impl FnOnce() -> T) -> T {
    let before = Environment::current();
    // SAFETY: guaranteed by the caller.
    unsafe { fesetenv(environment) };
    // No panic leaves `body`: `enter` catches panics of the library, and C has none.
    let result = body();
    // SAFETY: initialised above.
    unsafe { fesetenv(&before) };
    result
}

/// Rejects a call in a forked child of the process that first called the library. `fork` copies
/// only the calling thread, so the child would wait forever for the others.
pub fn same_process() -> Outcome {
    /// Id of the process of the first call; 0 before it.
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

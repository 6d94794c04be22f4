//! Protection against changes of the process: the floating-point environment of a thread, and
//! `fork`.

use crate::status::{Failure, Outcome, lasertrace_status};
use std::cell::Cell;
use std::ffi::c_int;
use std::sync::OnceLock;

/// C's `fenv_t`, which takes 8 to 32 bytes on Linux.
#[repr(C, align(16))]
#[derive(Clone, Copy)]
struct Environment([u64; 8]);

// C11, 7.6.4; in libm.
unsafe extern "C" {
    fn fegetenv(environment: *mut Environment) -> c_int;
    fn fesetenv(environment: *const Environment) -> c_int;
}

/// `FE_DFL_ENV` of glibc and musl: round to nearest, no traps, denormal numbers kept.
const DEFAULT: *const Environment = std::ptr::without_provenance(usize::MAX);

thread_local! {
    /// The caller's environment while this thread works for it.
    static CALLERS: Cell<Option<Environment>> = const { Cell::new(None) };
}

fn get() -> Environment {
    let mut environment = Environment([0; 8]);
    // SAFETY: the buffer is as large and aligned as any `fenv_t`.
    unsafe { fegetenv(&mut environment) };
    environment
}

fn set(environment: &Environment) {
    // SAFETY: what `get` filled.
    unsafe { fesetenv(environment) };
}

/// Sets an environment again at its end, also after a panic.
struct Restored(Environment, Option<Environment>);

impl Drop for Restored {
    fn drop(&mut self) {
        let _ = CALLERS.try_with(|callers| callers.set(self.1));
        set(&self.0);
    }
}

/// Does something in the default floating-point environment and restores the caller's. Threads
/// that are started meanwhile inherit the default.
pub fn shielded<T>(body: impl FnOnce() -> T) -> T {
    let callers = get();
    let before = CALLERS.try_with(|kept| kept.replace(Some(callers)));
    let _restored = Restored(callers, before.ok().flatten());
    // SAFETY: the address that the C library documents for its default.
    unsafe { fesetenv(DEFAULT) };
    body()
}

/// Calls a function of the caller's in its own environment.
pub fn as_caller<T>(function: impl FnOnce() -> T) -> T {
    let callers = CALLERS.try_with(Cell::get).ok().flatten();
    let _restored = Restored(get(), callers);
    if let Some(callers) = callers {
        set(&callers);
    }
    function()
}

/// Refuses a call in a child of the process that first called the library: `fork` copies no
/// thread, so the child would wait for ever for those that work.
pub fn same_process() -> Outcome {
    static FIRST: OnceLock<u32> = OnceLock::new();
    let (first, here) = (*FIRST.get_or_init(std::process::id), std::process::id());
    match first == here {
        true => Ok(()),
        false => Err(Failure {
            status: lasertrace_status::Resources,
            message: format!(
                "found process {here}, a fork of {first}, which called this library before; \
                 its threads are not in the child: fork before the first call, or call exec"
            ),
        }),
    }
}

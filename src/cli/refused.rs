//! Detection of aborts caused by a lack of memory. They are temporary; every other abort, such as a
//! failed assertion of Embree, is a bug.

#![allow(unsafe_code)]

use rustix::mm::{MapFlags, ProtFlags, mmap_anonymous};
use rustix::process::{Resource, getrlimit};
use signal_hook::consts::SIGABRT;
use std::alloc::{GlobalAlloc, Layout};
use std::ptr::null_mut;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

static REFUSED: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Returns the flag that is set when an allocation fails.
pub(super) fn flag() -> &'static Arc<AtomicBool> {
    REFUSED.get_or_init(Arc::default)
}

/// Records that memory was refused. In most cases, the standard library then calls `abort`.
#[cold]
fn note() {
    if let Some(refused) = REFUSED.get() {
        refused.store(true, Ordering::Relaxed);
    }
}

/// Registers a handler that records, at an abort, whether the address space is nearly exhausted.
/// Embree and TBB abort if the system refuses memory, without a call to the program's allocator.
pub(super) fn note_at_abort() -> std::io::Result<()> {
    let look = || {
        let Some(limit) = getrlimit(Resource::As).current else {
            return;
        };
        // SAFETY: the mapping is new and not used by other code.
        let mapped = unsafe {
            let size = (limit / 4) as usize;
            mmap_anonymous(null_mut(), size, ProtFlags::empty(), MapFlags::PRIVATE)
        };
        if mapped.is_err() {
            note();
        }
    };
    // SAFETY: the action only makes system calls and stores to an atomic, which is safe in a signal
    // handler.
    unsafe { signal_hook::low_level::register(SIGABRT, look) }.map(drop)
}

/// Allocator that records failures of the wrapped allocator. It is the program's global allocator.
pub struct Noting<A>(pub A);

// SAFETY: each function passes its arguments to `A` and returns the result unchanged, so the
// guarantees of `A` hold.
unsafe impl<A: GlobalAlloc> GlobalAlloc for Noting<A> {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller upholds the contract of `alloc`.
        noted(unsafe { self.0.alloc(layout) })
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller upholds the contract of `alloc_zeroed`.
        noted(unsafe { self.0.alloc_zeroed(layout) })
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: the caller upholds the contract of `realloc`.
        noted(unsafe { self.0.realloc(memory, layout, size) })
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller upholds the contract of `dealloc`.
        unsafe { self.0.dealloc(memory, layout) }
    }
}

#[inline]
fn noted(memory: *mut u8) -> *mut u8 {
    if memory.is_null() {
        note();
    }
    memory
}

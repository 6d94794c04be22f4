//! Whether the system refused memory. An abort for lack of memory is temporary; every other
//! abort, such as a failed assertion of Embree, is a fault of the program.

#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

static REFUSED: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Returns the flag that is set when an allocation fails.
pub(super) fn flag() -> &'static Arc<AtomicBool> {
    REFUSED.get_or_init(Arc::default)
}

/// Notes that an allocation failed. The standard library aborts after most of them.
#[cold]
fn note() {
    if let Some(refused) = REFUSED.get() {
        refused.store(true, Ordering::Relaxed);
    }
}

/// An allocator that notes when the one within it fails. The program's global allocator.
pub struct Noting<A>(pub A);

// SAFETY: each function passes its arguments on and returns the answer unchanged, so the
// promises of `A` hold.
unsafe impl<A: GlobalAlloc> GlobalAlloc for Noting<A> {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller keeps the contract of `alloc`.
        noted(unsafe { self.0.alloc(layout) })
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller keeps the contract of `alloc_zeroed`.
        noted(unsafe { self.0.alloc_zeroed(layout) })
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: the caller keeps the contract of `realloc`.
        noted(unsafe { self.0.realloc(memory, layout, size) })
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`.
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

//! Handles for C. They are numbers, not addresses, so an invalid or freed handle is detected and
//! never dereferenced.

use crate::status::{Failure, Outcome, lasertrace_status};
use std::any::Any;
use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock, RwLock};

type Live = HashMap<usize, Arc<dyn Any + Send + Sync>>;

static LIVE: LazyLock<RwLock<Live>> = LazyLock::new(RwLock::default);

/// Number of the next handle; numbers are not reused.
static NEXT: AtomicUsize = AtomicUsize::new(1);

/// Type of the object referenced by a handle.
pub trait Handle {
    type Object: Send + Sync + 'static;
    /// Name of the type in messages.
    const NAME: &'static str;
}

/// Creates a handle for an object.
pub fn give<H: Handle>(object: H::Object) -> *mut H {
    // Multiples of 16, because a program may expect the alignment of pointers.
    let number = NEXT.fetch_add(1, Ordering::Relaxed) * 16;
    let mut live = LIVE.write().unwrap_or_else(|p| p.into_inner());
    live.insert(number, Arc::new(object));
    std::ptr::without_provenance_mut(number)
}

/// Returns the object of a handle and keeps it alive during use.
pub fn find<H: Handle>(handle: *const H) -> Outcome<Arc<H::Object>> {
    let live = LIVE.read().unwrap_or_else(|p| p.into_inner());
    let object = live.get(&handle.addr()).cloned();
    let object = object.and_then(|object| object.downcast().ok());
    object.ok_or_else(|| not_live(handle))
}

/// Frees a handle. NULL is ignored, as by C's `free`.
pub fn free<H: Handle>(handle: *mut H) -> Outcome {
    if handle.is_null() {
        return Ok(());
    }
    // A handle of a different type is not freed.
    find(handle)?;
    let mut live = LIVE.write().unwrap_or_else(|p| p.into_inner());
    let object = live.remove(&handle.addr());
    drop(live);
    // Another thread may have freed the handle meanwhile.
    object.map(drop).ok_or_else(|| not_live(handle))
}

fn not_live<H: Handle>(handle: *const H) -> Failure {
    let found = match handle.is_null() {
        true => "NULL".to_owned(),
        false => format!("{handle:p}, which is freed, of another kind or made up"),
    };
    Failure {
        status: lasertrace_status::Handle,
        message: format!("found {found}, expected a live {}", H::NAME),
    }
}

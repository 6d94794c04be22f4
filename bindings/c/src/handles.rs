//! Handles that C holds: numbers, not addresses, so that one that is freed or made up is
//! looked for, not found, and never followed.

use crate::status::{Failure, Outcome, lasertrace_status};
use std::any::Any;
use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock, RwLock};

type Live = HashMap<usize, Arc<dyn Any + Send + Sync>>;

static LIVE: LazyLock<RwLock<Live>> = LazyLock::new(RwLock::default);

/// The number of the next handle: none is given twice.
static NEXT: AtomicUsize = AtomicUsize::new(1);

/// What a handle `H` stands for.
pub trait Handle {
    type Object: Send + Sync + 'static;
    /// In messages.
    const NAME: &'static str;
}

/// A handle for an object.
pub fn give<H: Handle>(object: H::Object) -> *mut H {
    // Spread as addresses are, which a program may expect of pointers.
    let number = NEXT.fetch_add(1, Ordering::Relaxed) * 16;
    let mut live = LIVE.write().unwrap_or_else(|p| p.into_inner());
    live.insert(number, Arc::new(object));
    std::ptr::without_provenance_mut(number)
}

/// What a handle stands for, kept alive as long as it is used.
pub fn find<H: Handle>(handle: *const H) -> Outcome<Arc<H::Object>> {
    let live = LIVE.read().unwrap_or_else(|p| p.into_inner());
    let object = live.get(&handle.addr()).cloned();
    let object = object.and_then(|object| object.downcast().ok());
    object.ok_or_else(|| not_live(handle))
}

/// Takes a handle back. NULL is none, as for C's `free`.
pub fn free<H: Handle>(handle: *mut H) -> Outcome {
    if handle.is_null() {
        return Ok(());
    }
    // Of another kind it stays.
    find(handle)?;
    let mut live = LIVE.write().unwrap_or_else(|p| p.into_inner());
    let object = live.remove(&handle.addr());
    drop(live);
    // Another thread may have been faster.
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

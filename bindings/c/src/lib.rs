//! The C library of lasertrace: a thin way to its rays and its simulator.
//!
//! What C sees is in `include/lasertrace.h`, made from this source by cbindgen; the comments
//! here are its manual. A function here checks what it is given, calls the core, and says how
//! that went; `status::enter` is around each, so that nothing unwinds into C.

// What every pointer must be stands once, at the head of C's header.
#![allow(clippy::missing_safety_doc)]

mod buffers;
mod cast;
// cbindgen would declare the functions of C that this module calls.
/// cbindgen:ignore
mod environment;
mod handles;
mod simulate;
mod status;

use std::ffi::c_char;

/// Version of this header. A program may compare it with lasertrace_version(): as long as the
/// first number is 0, the first two must be the same.
pub const LASERTRACE_VERSION_MAJOR: u32 = 0;
/// See LASERTRACE_VERSION_MAJOR.
pub const LASERTRACE_VERSION_MINOR: u32 = 2;
/// See LASERTRACE_VERSION_MAJOR.
pub const LASERTRACE_VERSION_PATCH: u32 = 0;

/// Version of the library that is loaded, as "0.2.0". Lives as long as the program.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_version() -> *const c_char {
    const TEXT: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    TEXT.as_ptr().cast()
}

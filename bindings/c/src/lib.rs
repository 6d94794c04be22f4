//! C interface of lasertrace: ray casting and simulation.
//!
//! The header `include/lasertrace.h` is generated from this source by cbindgen; doc comments here
//! become its documentation. Each function checks its arguments, calls the core and returns a
//! status. `status::enter` wraps every function, so that no panic unwinds into C.

// The requirements for all pointers are documented once, at the top of the C header.
#![allow(clippy::missing_safety_doc)]

mod buffers;
mod cast;
// cbindgen would otherwise declare the C functions that this module calls.
/// cbindgen:ignore
mod environment;
mod features;
mod handles;
mod simulate;
mod status;

use std::ffi::c_char;

/// Version of this header, to be compared with lasertrace_version(). While the major version is 0,
/// the first two numbers must be equal.
pub const LASERTRACE_VERSION_MAJOR: u32 = 0;
/// See LASERTRACE_VERSION_MAJOR.
pub const LASERTRACE_VERSION_MINOR: u32 = 3;
/// See LASERTRACE_VERSION_MAJOR.
pub const LASERTRACE_VERSION_PATCH: u32 = 0;

/// Returns the version of the loaded library, for example "0.3.0". The string is valid for the
/// lifetime of the program.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_version() -> *const c_char {
    const TEXT: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    TEXT.as_ptr().cast()
}

//! Embree device, its errors, and the version of the loaded library.

#![allow(unsafe_code)]

use crate::error::{Error, Result};
use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char, c_void};
use std::sync::{Arc, Mutex, Weak};

#[allow(
    dead_code,
    non_camel_case_types,
    non_snake_case,
    non_upper_case_globals,
    clippy::all
)]
pub(super) mod ffi {
    include!(concat!(env!("OUT_DIR"), "/embree.rs"));
}

/// Formats 31305 as "3.13.5".
fn version_string(version: u32) -> String {
    format!(
        "{}.{}.{}",
        version / 10000,
        version / 100 % 100,
        version % 100
    )
}

/// Returns the version of Embree for which this program was compiled.
pub fn version() -> String {
    // SAFETY: returns a constant.
    version_string(unsafe { ffi::lt_header_version() })
}

thread_local! {
    /// First error that Embree reported to this thread during [`reported`], with its code.
    ///
    /// Embree calls the error function on the thread that called Embree, even if the error arose on
    /// a worker. Threads that share a device therefore never receive each other's errors.
    static FIRST: RefCell<Option<(ffi::RTCError, String)>> = const { RefCell::new(None) };
}

/// Devices in use, each with its number of threads.
///
/// Hierarchies share a device, since each device occupies one of the 1024 keys that Linux has for
/// thread-local storage: about 1018 hierarchies exhausted them. An interrupted build does not
/// affect other builds, because Embree stores progress functions per scene and reports errors per
/// thread. The functions that Embree stores per device (errors, memory) are set before the device
/// is shared.
static DEVICES: Mutex<Vec<(usize, Weak<Device>)>> = Mutex::new(Vec::new());

fn error(code: ffi::RTCError, text: &str) -> Error {
    let text = format!("{text} (error {code})");
    match code {
        ffi::RTC_ERROR_OUT_OF_MEMORY => Error::Exhausted(format!("Embree: {text}")),
        _ => Error::Embree(text),
    }
}

unsafe extern "C" fn record_error(_: *mut c_void, code: ffi::RTCError, text: *const c_char) {
    let text = if text.is_null() {
        "no text".into()
    } else {
        // SAFETY: `text` is a C string of Embree, which outlives the call.
        unsafe { CStr::from_ptr(text) }.to_string_lossy()
    };
    // A thread that is ending has destroyed the storage and reads no more errors.
    let _ = FIRST.try_with(|first| {
        let mut first = first.borrow_mut();
        first.get_or_insert_with(|| (code, text.into_owned()));
    });
}

/// Calls Embree and returns its result, or the error that it reported during the call. Errors of
/// earlier calls on this thread, such as an interrupted build, are discarded.
pub(super) fn reported<T>(call: impl FnOnce() -> T) -> Result<T> {
    FIRST.take();
    let result = call();
    match FIRST.take() {
        None => Ok(result),
        Some((code, text)) => Err(error(code, &text)),
    }
}

pub(super) struct Device {
    pub(super) handle: ffi::RTCDevice,
    /// Number of rays that are traced together.
    pub(super) packet: u32,
}

// SAFETY: Embree devices may be used from any thread, and their reference counts are atomic.
unsafe impl Send for Device {}
// SAFETY: as above. Many threads may create objects of one device concurrently.
unsafe impl Sync for Device {}

impl Device {
    /// Returns the device that builds with `threads` threads: the device in use, or a new one.
    pub(super) fn common(threads: usize) -> Result<Arc<Device>> {
        // More threads than the machine has only slow a build down, and each number of threads
        // needs a device.
        let most = std::thread::available_parallelism().map_or(usize::MAX, usize::from);
        let threads = threads.min(most);
        if let Some(device) = Device::in_use(threads, None) {
            return Ok(device);
        }
        // Created while the list is unlocked. A child process from a concurrent `fork` has a copy
        // of the list but no thread that would unlock it.
        let device = Arc::new(Device::configured(&format!("threads={threads}"))?);
        Ok(Device::in_use(threads, Some(&device)).unwrap_or(device))
    }

    /// Returns the device in use with this number of threads. If no such device exists, `new`
    /// becomes this device.
    fn in_use(threads: usize, new: Option<&Arc<Device>>) -> Option<Arc<Device>> {
        let mut devices = DEVICES.lock().unwrap_or_else(|p| p.into_inner());
        devices.retain(|(_, device)| device.strong_count() > 0);
        let mut same = devices.iter().filter(|(number, _)| *number == threads);
        let found = same.find_map(|(_, device)| device.upgrade());
        if let (None, Some(new)) = (&found, new) {
            devices.push((threads, Arc::downgrade(new)));
        }
        found
    }

    /// Creates a device with the settings string of `rtcNewDevice`.
    pub(super) fn configured(settings: &str) -> Result<Device> {
        let config = CString::new(settings).expect("no NUL in it");
        let mut code = 0;
        // SAFETY: both pointers are valid for the call.
        let handle = unsafe { ffi::lt_device_new(config.as_ptr(), &mut code) };
        if handle.is_null() {
            return Err(error(code, "cannot start"));
        }
        // SAFETY: the handle is a live device; `record_error` does not use the pointer.
        let (header, library, packet) = unsafe {
            ffi::lt_device_on_error(handle, Some(record_error), std::ptr::null_mut());
            let packet = ffi::lt_packet_width(handle);
            (
                ffi::lt_header_version(),
                ffi::lt_library_version(handle),
                packet,
            )
        };
        let device = Device { handle, packet };
        check_versions(header, library)?;
        Ok(device)
    }
}

/// Checks that major and minor versions agree, because struct layouts change between minor versions
/// (RTCHit grew in 4.3).
fn check_versions(header: u32, library: u32) -> Result<()> {
    if header / 100 == library / 100 {
        return Ok(());
    }
    Err(Error::Embree(format!(
        "built against {}, but {} is loaded: rebuild lasertrace on this machine",
        version_string(header),
        version_string(library)
    )))
}

impl Drop for Device {
    fn drop(&mut self) {
        // SAFETY: the handle is live and released only here.
        unsafe { ffi::lt_device_release(self.handle) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_minor_version_of_the_library_is_refused() {
        assert!(check_versions(31305, 31306).is_ok());
        let message = check_versions(40200, 40303).unwrap_err().to_string();
        assert!(
            message.contains("4.2.0") && message.contains("4.3.3"),
            "{message}"
        );
    }

    /// Tests that hierarchies built with equal numbers of threads share one device.
    #[test]
    fn hierarchies_use_one_device() {
        let devices = [1, 1, 1].map(|threads| Device::common(threads).unwrap());
        assert!(devices.iter().all(|d| Arc::ptr_eq(d, &devices[0])));
        let many = [usize::MAX, 1 << 20].map(|threads| Device::common(threads).unwrap());
        assert!(Arc::ptr_eq(&many[0], &many[1]));
    }

    #[test]
    fn an_error_of_embree_becomes_an_error() {
        let out_of_memory = || {
            // SAFETY: the text is a C string.
            unsafe { record_error(std::ptr::null_mut(), 4, c"out of memory".as_ptr()) }
        };
        let error = reported(out_of_memory).unwrap_err();
        assert!(error.to_string().contains("out of memory"), "{error}");
        assert_eq!(error.exit_code(), 75);
        // Errors from a different thread or from an earlier call must not be returned.
        out_of_memory();
        let other = || std::thread::scope(|scope| scope.spawn(out_of_memory).join().unwrap());
        assert!(reported(other).is_ok());
        // A mesh that exceeds any memory: Embree must report the error.
        let device = Device::common(1).unwrap();
        let (mut v, t) = (std::ptr::null_mut(), [0; 3]);
        // SAFETY: the device is live, the out-pointer is valid, and so is the triangle.
        let scene = reported(|| unsafe {
            ffi::lt_mesh_scene_new(device.handle, true, 1 << 50, &mut v, false, 1, t.as_ptr())
        });
        assert!(scene.is_err());
    }
}

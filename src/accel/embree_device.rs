//! Embree's device, its errors, and the version that is loaded.

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

/// "3.13.5" from 31305.
fn version_string(version: u32) -> String {
    format!(
        "{}.{}.{}",
        version / 10000,
        version / 100 % 100,
        version % 100
    )
}

/// Version of the Embree this program was compiled against.
pub fn version() -> String {
    // SAFETY: returns a constant.
    version_string(unsafe { ffi::lt_header_version() })
}

thread_local! {
    /// The first error that Embree reported to this thread during [`reported`], and its code.
    ///
    /// Embree calls the error function on the thread that called Embree, also if the error
    /// arose on a worker. Threads that use one device at a time therefore never see each
    /// other's errors.
    static FIRST: RefCell<Option<(ffi::RTCError, String)>> = const { RefCell::new(None) };
}

/// Devices in use, each with its number of threads.
///
/// Hierarchies use a device in common, since each device occupies one of the 1024 keys that
/// Linux has for storage per thread: about 1018 hierarchies exhausted them. An interrupted
/// build has no effect on another one, as Embree holds progress functions per scene and
/// reports errors per thread. The functions that Embree holds per device (errors, memory) are
/// set before anyone else sees the device.
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
        // SAFETY: a C string of Embree's, which outlives the call.
        unsafe { CStr::from_ptr(text) }.to_string_lossy()
    };
    // A thread that ends has destroyed the storage, and reads no error any more.
    let _ = FIRST.try_with(|first| {
        let mut first = first.borrow_mut();
        first.get_or_insert_with(|| (code, text.into_owned()));
    });
}

/// Calls Embree and returns its result, or the error that it reported during the call. An
/// error of an earlier call on this thread, such as a build that was interrupted, is not
/// mistaken for one of this call.
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
    /// Rays that are traced together.
    pub(super) packet: u32,
}

// SAFETY: Embree's devices may be used from any thread, and their references are counted
// atomically.
unsafe impl Send for Device {}
// SAFETY: as above. Many threads may make objects of one device at once.
unsafe impl Sync for Device {}

impl Device {
    /// Returns the device that builds with `threads` threads: the one in use, or a new one.
    pub(super) fn common(threads: usize) -> Result<Arc<Device>> {
        // Threads in excess of the machine's only slow a build down, and each number of
        // threads takes a device.
        let most = std::thread::available_parallelism().map_or(usize::MAX, usize::from);
        let threads = threads.min(most);
        if let Some(device) = Device::in_use(threads, None) {
            return Ok(device);
        }
        // Made while the list is unlocked: a child made by `fork` meanwhile has a copy of the
        // list, and no thread that would unlock it.
        let device = Arc::new(Device::configured(&format!("threads={threads}"))?);
        Ok(Device::in_use(threads, Some(&device)).unwrap_or(device))
    }

    /// Returns the device in use with this number of threads. If there is none, `new` becomes
    /// that device.
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

    /// With settings as `rtcNewDevice` takes them.
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

/// Struct layouts change between minor versions (RTCHit grew in 4.3).
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

    /// Hierarchies built with one number of threads use one device.
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
        // Neither an error of another thread nor one before the call.
        out_of_memory();
        let other = || std::thread::scope(|scope| scope.spawn(out_of_memory).join().unwrap());
        assert!(reported(other).is_ok());
        // A mesh no machine has memory for: Embree's own report.
        let device = Device::common(1).unwrap();
        let (mut v, t) = (std::ptr::null_mut(), [0; 3]);
        // SAFETY: the device is live, the out-pointer valid, and so is the triangle.
        let scene = reported(|| unsafe {
            ffi::lt_mesh_scene_new(device.handle, true, 1 << 50, &mut v, false, 1, t.as_ptr())
        });
        assert!(scene.is_err());
    }
}

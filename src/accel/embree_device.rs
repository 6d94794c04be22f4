//! Embree's device, its errors, and the version that is loaded.

#![allow(unsafe_code)]

use crate::error::{Error, Result};
use std::cell::RefCell;
use std::ffi::{CStr, CString, c_char, c_void};
use std::sync::{Arc, Mutex, TryLockError, Weak};

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
    /// The first error that Embree reported to this thread since [`Device::check`], and its
    /// code. Embree reports an error on the thread that called it, so threads that use one
    /// device do not see each other's errors.
    static FIRST: RefCell<Option<(ffi::RTCError, String)>> = const { RefCell::new(None) };
}

/// The devices in use, each with its process and its number of threads. Embree reserves
/// storage in every thread for each device, which runs out at about a thousand devices. The
/// threads of a device are not in a child made by `fork`, which gets devices of its own.
static DEVICES: Mutex<Vec<(DeviceKey, Weak<Device>)>> = Mutex::new(Vec::new());

/// Process and number of threads.
type DeviceKey = (u32, usize);

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
    // A thread that is about to end has nothing left to report to.
    let _ = FIRST.try_with(|first| {
        let mut first = first.borrow_mut();
        first.get_or_insert_with(|| (code, text.into_owned()));
    });
}

pub(super) struct Device {
    pub(super) handle: ffi::RTCDevice,
    /// Rays that are traced together.
    pub(super) packet: u32,
}

// SAFETY: Embree's devices may be used from any thread, and counts their references itself.
unsafe impl Send for Device {}
// SAFETY: as above: objects of one device may be made by many threads at once.
unsafe impl Sync for Device {}

impl Device {
    /// Returns the device that builds with `threads` threads: the one in use, or a new one.
    pub(super) fn shared(threads: usize) -> Result<Arc<Device>> {
        // More than the machine has are never used.
        let most = std::thread::available_parallelism().map_or(usize::MAX, usize::from);
        let key = (std::process::id(), threads.min(most));
        let made = || Device::configured(&format!("threads={}", key.1)).map(Arc::new);
        // Not waited for: in a child by `fork` the thread that holds it may be absent.
        let mut devices = match DEVICES.try_lock() {
            Ok(devices) => devices,
            Err(TryLockError::Poisoned(devices)) => devices.into_inner(),
            Err(TryLockError::WouldBlock) => return made(),
        };
        devices.retain(|(_, device)| device.strong_count() > 0);
        let mut same = devices.iter().filter(|(other, _)| *other == key);
        if let Some(device) = same.find_map(|(_, device)| device.upgrade()) {
            return Ok(device);
        }
        let device = made()?;
        devices.push((key, Arc::downgrade(&device)));
        Ok(device)
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
        // SAFETY: the handle is a live device; `record_error` reads nothing of the pointer.
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

    /// Takes the error that Embree reported to this thread, if any.
    pub(super) fn check(&self) -> Result<()> {
        match FIRST.take() {
            None => Ok(()),
            Some((code, text)) => Err(error(code, &text)),
        }
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

    /// Hierarchies built with the same number of threads use one device.
    #[test]
    fn hierarchies_use_one_device() {
        let devices = [1, 1, 1].map(|threads| Device::shared(threads).unwrap());
        assert!(
            devices
                .iter()
                .all(|device| Arc::ptr_eq(device, &devices[0]))
        );
        let many = [usize::MAX, 1 << 20].map(|threads| Device::shared(threads).unwrap());
        assert!(Arc::ptr_eq(&many[0], &many[1]));
    }

    #[test]
    fn an_error_of_embree_becomes_an_error() {
        let device = Device::shared(1).unwrap();
        assert!(device.check().is_ok());
        // SAFETY: the text is a C string.
        unsafe { record_error(std::ptr::null_mut(), 4, c"out of memory".as_ptr()) };
        std::thread::scope(|scope| {
            let other = scope.spawn(|| device.check().is_ok());
            assert!(other.join().unwrap(), "an error of another thread");
        });
        let error = device.check().unwrap_err();
        assert!(error.to_string().contains("out of memory"), "{error}");
        assert_eq!(error.exit_code(), 75);
        // A mesh no machine has memory for: Embree's own report.
        let (mut v, t) = (std::ptr::null_mut(), [0; 3]);
        // SAFETY: the device is live, the out-pointer valid, and so is the triangle.
        let scene = unsafe {
            ffi::lt_mesh_scene_new(device.handle, true, 1 << 50, &mut v, false, 1, t.as_ptr())
        };
        assert!(scene.is_null());
        assert!(device.check().is_err());
    }
}

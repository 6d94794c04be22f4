//! Embree's device, its errors, and the version that is loaded.

#![allow(unsafe_code)]

use crate::error::{Error, Result};
use std::ffi::{CStr, CString, c_char, c_void};
use std::sync::{Arc, Mutex};

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

/// The first error Embree reported since it was last asked, and its code.
type ErrorSlot = Mutex<Option<(ffi::RTCError, String)>>;

fn error(code: ffi::RTCError, text: &str) -> Error {
    let text = format!("{text} (error {code})");
    match code {
        ffi::RTC_ERROR_OUT_OF_MEMORY => Error::Exhausted(format!("Embree: {text}")),
        _ => Error::Embree(text),
    }
}

unsafe extern "C" fn record_error(slot: *mut c_void, code: ffi::RTCError, text: *const c_char) {
    // SAFETY: `slot` is the ErrorSlot given to lt_device_on_error, which lives as
    // long as the device and is only read through shared references; `text` is NULL or a C string of Embree's.
    let (slot, text) = unsafe {
        let text = if text.is_null() {
            "no text".into()
        } else {
            CStr::from_ptr(text).to_string_lossy()
        };
        (&*(slot as *const ErrorSlot), text)
    };
    let mut first = slot.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    first.get_or_insert_with(|| (code, text.into_owned()));
}

pub(super) struct Device {
    pub(super) handle: ffi::RTCDevice,
    /// Rays that are traced together.
    pub(super) packet: u32,
    // Not a box: Embree holds a pointer to it, and to move a box claims that no one does.
    error: Arc<ErrorSlot>,
}

impl Device {
    pub(super) fn new(threads: usize) -> Result<Device> {
        Device::configured(&format!("threads={threads}"))
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
        let slot = Arc::new(ErrorSlot::default());
        let user = Arc::as_ptr(&slot) as *mut c_void;
        // SAFETY: the handle is a live device; the slot stays where it is as long as
        // the device holds it, which `drop` releases before the slot.
        let (header, library, packet) = unsafe {
            ffi::lt_device_on_error(handle, Some(record_error), user);
            let packet = ffi::lt_packet_width(handle);
            (
                ffi::lt_header_version(),
                ffi::lt_library_version(handle),
                packet,
            )
        };
        let device = Device {
            handle,
            packet,
            error: slot,
        };
        check_versions(header, library)?;
        Ok(device)
    }

    /// What Embree reported, if anything.
    pub(super) fn check(&self) -> Result<()> {
        let mut first = self
            .error
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        match first.take() {
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

    #[test]
    fn an_error_of_embree_becomes_an_error() {
        let device = Device::new(1).unwrap();
        assert!(device.check().is_ok());
        let slot = Arc::as_ptr(&device.error) as *mut c_void;
        // SAFETY: the slot is alive and the text a C string.
        unsafe { record_error(slot, 4, c"out of memory".as_ptr()) };
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

//! Memory that is asked for before it is read.

#![allow(unsafe_code)]

/// Asks for the memory of an element that is read soon, and does not wait for it.
#[inline(always)]
pub(super) fn ask_for<T>(of: &[T], at: u32) {
    #[cfg(target_arch = "x86_64")]
    if let Some(place) = of.get(at as usize) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // Its ends, since it may lie in two lines of the cache.
        let ends: [*const T; 2] = [place, std::ptr::from_ref(place).wrapping_add(1)];
        // SAFETY: it reads nothing that anyone could see, whatever the address is.
        unsafe {
            _mm_prefetch::<_MM_HINT_T0>(ends[0].cast());
            _mm_prefetch::<_MM_HINT_T0>(ends[1].cast::<i8>().wrapping_sub(1));
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (of, at);
}

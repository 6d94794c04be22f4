//! Prefetching of memory.

#![allow(unsafe_code)]

/// Prefetches the memory of an element that will be read soon, without waiting for it.
#[inline(always)]
pub(super) fn prefetch<T>(of: &[T], at: u32) {
    #[cfg(target_arch = "x86_64")]
    if let Some(place) = of.get(at as usize) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // Both ends, since the element may lie in two cache lines.
        let ends: [*const T; 2] = [place, std::ptr::from_ref(place).wrapping_add(1)];
        // SAFETY: a prefetch has no observable effect on memory, for any address.
        unsafe {
            _mm_prefetch::<_MM_HINT_T0>(ends[0].cast());
            _mm_prefetch::<_MM_HINT_T0>(ends[1].cast::<i8>().wrapping_sub(1));
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (of, at);
}

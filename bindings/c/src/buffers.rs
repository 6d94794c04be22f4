//! Checked conversion of the caller's memory into slices.

use crate::status::{Failure, Outcome};
use std::ffi::{CStr, c_char};
use std::ops::Range;

/// A number type, or a struct of numbers, for which any bit pattern is valid.
///
/// # Safety
/// Every bit pattern of this size must be a valid value of the type.
pub unsafe trait Plain: Copy {}

// SAFETY: numbers and arrays of numbers have no invalid bit patterns.
unsafe impl Plain for u8 {}
// SAFETY: as above.
unsafe impl Plain for u16 {}
// SAFETY: as above.
unsafe impl Plain for u64 {}
// SAFETY: as above.
unsafe impl Plain for usize {}
// SAFETY: as above.
unsafe impl Plain for f32 {}
// SAFETY: as above.
unsafe impl Plain for f64 {}
// SAFETY: as above.
unsafe impl Plain for [f32; 3] {}
// SAFETY: as above.
unsafe impl Plain for [f64; 3] {}
// SAFETY: as above.
unsafe impl Plain for [f64; 12] {}
// SAFETY: as above.
unsafe impl Plain for [u32; 3] {}

fn check<T>(name: &str, pointer: *const T, count: usize) -> Outcome {
    let wrong = |found: String| {
        let (size, each) = (size_of::<T>(), align_of::<T>());
        Err(Failure::argument(format!(
            "{name}: found {found}, expected the address of {count} times {size} bytes, a multiple \
             of {each}"
        )))
    };
    if pointer.is_null() {
        return wrong("NULL".into());
    }
    if !pointer.is_aligned() {
        return wrong(format!("{pointer:p}"));
    }
    let bytes = count.checked_mul(size_of::<T>());
    let end = bytes.and_then(|bytes| pointer.addr().checked_add(bytes));
    match bytes {
        Some(bytes) if bytes <= isize::MAX as usize && end.is_some() => Ok(()),
        _ => wrong("a number of elements beyond all memory".into()),
    }
}

/// Returns the caller's buffer as a slice; an empty slice if `count` is 0.
///
/// # Safety
/// Unless it is NULL, `pointer` must point to `count` elements that are not written during 'a.
pub unsafe fn read<'a, T: Plain>(name: &str, pointer: *const T, count: usize) -> Outcome<&'a [T]> {
    if count == 0 {
        return Ok(&[]);
    }
    check(name, pointer, count)?;
    // SAFETY: the pointer is aligned, not NULL, and the size does not exceed memory. The caller
    // guarantees that the elements exist and are not written.
    Ok(unsafe { std::slice::from_raw_parts(pointer, count) })
}

/// Returns the caller's buffer as a mutable slice; an empty slice if `count` is 0.
///
/// # Safety
/// Unless it is NULL, `pointer` must point to `count` elements that are not accessed by other code
/// during 'a.
pub unsafe fn write<'a, T: Plain>(
    name: &str,
    pointer: *mut T,
    count: usize,
) -> Outcome<&'a mut [T]> {
    if count == 0 {
        return Ok(&mut []);
    }
    check(name, pointer, count)?;
    // SAFETY: the pointer is aligned, not NULL, and the size does not exceed memory. The caller
    // guarantees that the elements exist and are accessed only here. Any bit pattern is a valid T.
    Ok(unsafe { std::slice::from_raw_parts_mut(pointer, count) })
}

/// Returns an input buffer and an output buffer of equal length. A buffer is given by name, address
/// and length.
///
/// # Safety
/// As for [`read`] and [`write`].
pub unsafe fn pair<'a, Q: Plain, A: Plain>(
    questions: (&str, *const Q, usize),
    answers: (&str, *mut A, usize),
) -> Outcome<(&'a [Q], &'a mut [A])> {
    let ((name, from, count), (answer_name, to, answer_count)) = (questions, answers);
    same_number(&format!("number of {answer_name}"), answer_count, count)?;
    check_disjoint(&[
        (name, addresses(from, count)),
        (answer_name, addresses(to, count)),
    ])?;
    // SAFETY: guaranteed by the caller, and the buffers do not overlap.
    unsafe { Ok((read(name, from, count)?, write(answer_name, to, count)?)) }
}

/// Returns a reference to the caller's struct.
///
/// # Safety
/// A `pointer` that is not NULL must point to a T that is not written during 'a. Every bit pattern
/// of T must be valid.
pub unsafe fn one<'a, T>(name: &str, pointer: *const T) -> Outcome<&'a T> {
    check(name, pointer, 1)?;
    // SAFETY: the pointer is aligned and not NULL. The caller guarantees that the value exists and
    // is not written.
    Ok(unsafe { &*pointer })
}

/// Writes a value to the caller's memory.
///
/// # Safety
/// As for [`write`] with one element.
pub unsafe fn set<T>(name: &str, out: *mut T, value: T) -> Outcome {
    check(name, out, 1)?;
    // SAFETY: the pointer is aligned and not NULL. The caller guarantees that the memory exists and
    // is accessed only here. The previous value belongs to C and needs no drop.
    unsafe { out.write(value) };
    Ok(())
}

/// Returns a UTF-8 C string.
///
/// # Safety
/// Unless it is NULL, `text` must point to a NUL-terminated string that is not written during 'a.
pub unsafe fn text<'a>(name: &str, text: *const c_char) -> Outcome<&'a str> {
    check(name, text, 1)?;
    // SAFETY: the pointer is not NULL, and the caller guarantees that it points to a string.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map_err(|error| {
        Failure::argument(format!("{name}: found bytes that are not UTF-8 ({error})"))
    })
}

/// Rejects overlapping buffers, because one of them would change while another is read.
pub fn check_disjoint(buffers: &[(&str, Range<usize>)]) -> Outcome {
    for (i, (name, one)) in buffers.iter().enumerate() {
        for (other_name, other) in &buffers[..i] {
            if one.start < other.end && other.start < one.end {
                return Err(Failure::argument(format!(
                    "{other_name} and {name}: found buffers that overlap, expected two that do \
                     not"
                )));
            }
        }
    }
    Ok(())
}

/// Returns the address range of a buffer; it saturates at the end of the address space.
pub fn addresses<T>(pointer: *const T, count: usize) -> Range<usize> {
    let bytes = count.saturating_mul(size_of::<T>());
    pointer.addr()..pointer.addr().saturating_add(bytes)
}

/// Rejects a buffer whose length differs from the expected one.
pub fn same_number(name: &str, found: usize, expected: usize) -> Outcome {
    match found == expected {
        true => Ok(()),
        false => Err(Failure::argument(format!(
            "{name}: found {found}, expected {expected}"
        ))),
    }
}

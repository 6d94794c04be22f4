//! The caller's memory as slices, as far as it can be checked.

use crate::status::{Failure, Outcome};
use std::ffi::{CStr, c_char};
use std::ops::Range;

/// A number type or a struct of such, for which any bytes are a value.
///
/// # Safety
/// No bytes of this size may be anything but a value of the type.
pub unsafe trait Plain: Copy {}

// SAFETY: numbers and arrays of them have no bytes that are not a value.
unsafe impl Plain for u8 {}
// SAFETY: as above.
unsafe impl Plain for u16 {}
// SAFETY: as above.
unsafe impl Plain for f32 {}
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

/// What the caller lets be read; nothing if there are none of it.
///
/// # Safety
/// Unless it is NULL, `pointer` leads to `count` elements that nobody writes during 'a.
pub unsafe fn read<'a, T: Plain>(name: &str, pointer: *const T, count: usize) -> Outcome<&'a [T]> {
    if count == 0 {
        return Ok(&[]);
    }
    check(name, pointer, count)?;
    // SAFETY: it is aligned, not NULL, no larger than memory, and by the caller's word
    // there and left alone.
    Ok(unsafe { std::slice::from_raw_parts(pointer, count) })
}

/// What the caller lets be written; nothing if there are none of it.
///
/// # Safety
/// Unless it is NULL, `pointer` leads to `count` elements that nobody else reads or writes
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
    // SAFETY: it is aligned, not NULL, no larger than memory, and by the caller's word
    // there and ours alone; what stands in it, whatever that is, is a value of T.
    Ok(unsafe { std::slice::from_raw_parts_mut(pointer, count) })
}

/// Questions and the places for as many answers; a buffer is its name, address and number.
///
/// # Safety
/// As for [`read`] and [`write`].
pub unsafe fn pair<'a, Q: Plain, A: Plain>(
    questions: (&str, *const Q, usize),
    answers: (&str, *mut A, usize),
) -> Outcome<(&'a [Q], &'a mut [A])> {
    let ((name, from, count), (answer_name, to, answer_count)) = (questions, answers);
    same_number(&format!("number of {answer_name}"), answer_count, count)?;
    apart(&[
        (name, addresses(from, count)),
        (answer_name, addresses(to, count)),
    ])?;
    // SAFETY: by the caller's word, and they do not overlap.
    unsafe { Ok((read(name, from, count)?, write(answer_name, to, count)?)) }
}

/// A struct of the caller's.
///
/// # Safety
/// Unless it is NULL, `pointer` leads to a T that nobody writes during 'a, and of T all bytes
/// are values.
pub unsafe fn one<'a, T>(name: &str, pointer: *const T) -> Outcome<&'a T> {
    check(name, pointer, 1)?;
    // SAFETY: it is aligned, not NULL, and by the caller's word there and left alone.
    Ok(unsafe { &*pointer })
}

/// The place for one answer.
///
/// # Safety
/// As for [`write`], of one element.
pub unsafe fn set<T>(name: &str, out: *mut T, value: T) -> Outcome {
    check(name, out, 1)?;
    // SAFETY: it is aligned, not NULL, and by the caller's word there and ours alone; what
    // stood there is C's, and needs no drop.
    unsafe { out.write(value) };
    Ok(())
}

/// A C string in UTF-8.
///
/// # Safety
/// Unless it is NULL, `text` leads to a string that ends with a NUL and that nobody writes
/// during 'a.
pub unsafe fn text<'a>(name: &str, text: *const c_char) -> Outcome<&'a str> {
    check(name, text, 1)?;
    // SAFETY: it is not NULL, and by the caller's word a string.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map_err(|error| {
        Failure::argument(format!("{name}: found bytes that are not UTF-8 ({error})"))
    })
}

/// Refuses buffers that overlap: one of them would change while another is read.
pub fn apart(buffers: &[(&str, Range<usize>)]) -> Outcome {
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

/// The addresses of a buffer; of more than memory, all above.
pub fn addresses<T>(pointer: *const T, count: usize) -> Range<usize> {
    let bytes = count.saturating_mul(size_of::<T>());
    pointer.addr()..pointer.addr().saturating_add(bytes)
}

/// Refuses a number of elements that is not the one the answer takes.
pub fn same_number(name: &str, found: usize, expected: usize) -> Outcome {
    match found == expected {
        true => Ok(()),
        false => Err(Failure::argument(format!(
            "{name}: found {found}, expected {expected}"
        ))),
    }
}

//! Tells what a file is from its content.

use super::text::{Lines, quote, words};
use super::{Source, obj};
use crate::error::{Error, Place};

pub const EXPECTED: &str = "an STL, OBJ or PLY mesh";

#[derive(Debug, PartialEq)]
pub enum Format {
    BinaryStl,
    AsciiStl,
    Ply,
    Obj,
}

/// Bytes looked at to tell text from binary: a binary STL has, in its first
/// dozen triangles, a zero byte in an attribute word if nowhere else.
const PROBE: usize = 1024;

/// Starts of files that get mistaken for meshes (lower case), with their name
/// and what to do about it.
const STRANGERS: [(&[u8], &str, &str); 18] = [
    (
        b"version https://git-lfs",
        "a Git LFS pointer",
        "the mesh it stands for (git lfs pull)",
    ),
    (b"<!doctype html", "an HTML page", EXPECTED),
    (b"<html", "an HTML page", EXPECTED),
    (b"<?xml", "an XML document", EXPECTED),
    (
        b"pk\x03\x04",
        "a ZIP archive or 3MF file",
        "an STL, OBJ or PLY mesh, unpacked",
    ),
    (
        b"iso-10303-21",
        "a STEP file",
        "its tessellation as STL, OBJ or PLY",
    ),
    (
        b"start ",
        "an IGES file",
        "its tessellation as STL, OBJ or PLY",
    ),
    (b"\xff\xfe", "UTF-16 text", "ASCII or UTF-8 text"),
    (b"\xfe\xff", "UTF-16 text", "ASCII or UTF-8 text"),
    (
        b"\x1f\x8b",
        "a gzip archive",
        "an STL, OBJ or PLY mesh, unpacked",
    ),
    (
        b"7z\xbc\xaf",
        "a 7z archive",
        "an STL, OBJ or PLY mesh, unpacked",
    ),
    (b"gltf", "a glTF binary", EXPECTED),
    (b"{", "a JSON document", EXPECTED),
    (b"off", "an OFF mesh", EXPECTED),
    (b"%pdf", "a PDF document", EXPECTED),
    (b"\x89png", "a PNG image", EXPECTED),
    (b"#vrml", "a VRML scene", EXPECTED),
    (b"kaydara fbx", "an FBX scene", EXPECTED),
];

/// The format of `source`, or an error that names what it looks like instead.
pub fn format(source: &Source) -> Result<Format, Error> {
    let bytes = source.bytes;
    if bytes.is_empty() {
        return Err(source.error(Place::File, "an empty file", EXPECTED));
    }
    if bytes.starts_with(b"ply") && bytes.get(3).is_none_or(u8::is_ascii_whitespace) {
        return Ok(Format::Ply);
    }
    // Before anything is made of its text: a binary STL may well begin with
    // "solid" or any other word.
    if is_whole_binary_stl(bytes) {
        return Ok(Format::BinaryStl);
    }
    let head = bytes[..bytes.len().min(PROBE)].to_ascii_lowercase();
    let trimmed = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&head);
    let trimmed = trimmed.trim_ascii_start();
    for (start, name, expected) in STRANGERS {
        if trimmed.starts_with(start) {
            return Err(source.error(Place::File, name, expected));
        }
    }
    if looks_utf16(&head) {
        return Err(source.error(Place::File, "UTF-16 text", "ASCII or UTF-8 text"));
    }
    let blank = |b: u8| matches!(b, b'\t' | b'\n' | b'\r' | 0x0b | 0x0c);
    if head.iter().any(|&b| b < b' ' && !blank(b)) {
        // Its reader says how the sizes disagree.
        return Ok(Format::BinaryStl);
    }
    match first_word(bytes) {
        Some(word) if word.eq_ignore_ascii_case(b"solid") => Ok(Format::AsciiStl),
        Some(word) if obj::is_statement(word) => Ok(Format::Obj),
        Some(word) => Err(source.error(
            Place::File,
            format!("{} bytes of text beginning with {}", bytes.len(), quote(word)),
            "an STL (\"solid …\", or a binary header of 84 bytes), OBJ (\"v …\") or PLY (\"ply\") mesh",
        )),
        None => Err(source.error(Place::File, "blanks and comments only", EXPECTED)),
    }
}

/// Triangles a binary STL header announces.
pub fn stl_count(bytes: &[u8]) -> Option<u64> {
    let count = bytes.get(80..84)?.try_into().ok()?;
    Some(u64::from(u32::from_le_bytes(count)))
}

/// Whether the announced triangles fill the file to within a fraction of one.
fn is_whole_binary_stl(bytes: &[u8]) -> bool {
    stl_count(bytes).is_some_and(|count| fills(count, bytes.len() as u64))
}

/// Whether that many triangles of a binary STL make a file of this size (bytes).
pub fn fills(count: u64, size: u64) -> bool {
    let end = 84 + 50 * count;
    count > 0 && (end..end + 50).contains(&size)
}

/// UTF-16 without byte order mark: every other byte of Latin text is zero.
fn looks_utf16(head: &[u8]) -> bool {
    let zeros = |from: usize| {
        head.iter()
            .skip(from)
            .step_by(2)
            .filter(|&&b| b == 0)
            .count()
    };
    let half = head.len() / 2;
    let (even, odd) = (zeros(0), zeros(1));
    half >= 8 && (even * 10 > half * 9 && odd == 0 || odd * 10 > half * 9 && even == 0)
}

fn first_word(bytes: &[u8]) -> Option<&[u8]> {
    Lines::new(bytes).find_map(|line| words(line).next())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn told(bytes: &[u8]) -> Result<Format, String> {
        let source = Source {
            path: Path::new("part.stl"),
            bytes,
            unit_mm: 1.0,
        };
        format(&source).map_err(|e| e.to_string())
    }

    #[test]
    fn formats_are_told_by_content() {
        assert_eq!(told(b"ply\r\n"), Ok(Format::Ply));
        assert_eq!(told(b"\xef\xbb\xbf  SOLID x\n"), Ok(Format::AsciiStl));
        assert_eq!(told(b"# made by\n\nmtllib a.mtl\n"), Ok(Format::Obj));
        let mut binary = b"solid but binary".to_vec();
        binary.resize(84, b' ');
        binary[80..].copy_from_slice(&[1, 0, 0, 0]);
        binary.resize(134, 0);
        assert_eq!(told(&binary), Ok(Format::BinaryStl));
    }

    #[test]
    fn strangers_are_named() {
        let utf16: Vec<u8> = "solid part\n facet".bytes().flat_map(|b| [b, 0]).collect();
        for (bytes, name) in [
            (b"".as_slice(), "empty file"),
            (b"  \n# x", "blanks"),
            (b"<HTML><body>solid", "HTML"),
            (
                b"version https://git-lfs.github.com/spec/v1\n",
                "git lfs pull",
            ),
            (b"PK\x03\x04....", "3MF"),
            (b"ISO-10303-21;\nHEADER;", "STEP"),
            (b"\xff\xfes\0o\0", "UTF-16"),
            (&utf16, "UTF-16"),
            (b"{\"asset\":{}}", "JSON"),
            (b"hello world", "\"hello\""),
            (b"plywood", "\"plywood\""),
        ] {
            let error = told(bytes).unwrap_err();
            assert!(error.contains(name), "{error} lacks {name}");
        }
    }
}

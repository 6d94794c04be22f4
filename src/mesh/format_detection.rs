//! Detection of the file format from the content.

use super::text::{self, Lines, quote, words};
use super::{MeshInput, obj};
use crate::error::{Error, Place};
use file_format::{FileFormat, Kind};
use std::path::Path;

pub const EXPECTED: &str = "an STL, OBJ, PLY, glTF or 3MF mesh";

#[derive(Debug, PartialEq)]
pub enum MeshFormat {
    BinaryStl,
    AsciiStl,
    Ply,
    Obj,
    Gltf,
    ThreeMf,
}

/// Number of bytes examined to distinguish text from binary. A binary STL has a zero byte within
/// its first dozen triangles, at the latest in an attribute word.
const PROBE: usize = 1024;

const TESSELLATED: &str = "its surface as triangles, exported as STL, OBJ, PLY, glTF or 3MF";
const CONVERTED: &str = "its surface as triangles: `examples/step/step.sh PART.stp PART.stl 5` converts it to an STL in \
                         mm, within 5 µm";
const UNPACKED: &str = "an STL, OBJ, PLY, glTF or 3MF mesh, unpacked";
const PLAIN_TEXT: &str = "ASCII or UTF-8 text";

/// Prefixes (lower case) of text files that are mistaken for meshes, with their format name and the
/// expected input. The crate `file_format` detects formats with a signature.
const FOREIGN_FORMATS: [(&[u8], &str, &str); 17] = [
    (
        b"version https://git-lfs",
        "a Git LFS pointer",
        "the mesh it stands for (git lfs pull)",
    ),
    (b"<!doctype html", "an HTML page", EXPECTED),
    (b"<html", "an HTML page", EXPECTED),
    (b"iso-10303-21", "a STEP file", CONVERTED),
    (b"\xff\xfe", "UTF-16 text", PLAIN_TEXT),
    (b"\xfe\xff", "UTF-16 text", PLAIN_TEXT),
    (b"off", "an OFF mesh", TESSELLATED),
    (b"coff", "an OFF mesh", TESSELLATED),
    (b"noff", "an OFF mesh", TESSELLATED),
    (b"# vtk datafile", "a VTK file", TESSELLATED),
    (b"$meshformat", "a Gmsh mesh", TESSELLATED),
    (b"*heading", "an Abaqus mesh", TESSELLATED),
    (b"*node", "an Abaqus mesh", TESSELLATED),
    (b"#vrml", "a VRML scene", TESSELLATED),
    (b"; fbx", "an FBX scene", TESSELLATED),
    (b"foamfile", "an OpenFOAM file", TESSELLATED),
    (b"dbrep_drawable", "a BREP file", TESSELLATED),
];

/// Returns the name of a file format that is not a supported mesh, and the expected input.
fn foreign_format(head: &[u8]) -> Option<(String, &'static str)> {
    let named = |name: &str, expected| Some((name.to_owned(), expected));
    let mut start = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head);
    start = start.trim_ascii_start();
    // STEP may begin with comments.
    while let Some(comment) = start.strip_prefix(b"/*") {
        let end = comment.windows(2).position(|pair| pair == b"*/");
        start = comment[end.map_or(comment.len(), |end| end + 2)..].trim_ascii_start();
    }
    for (word, name, expected) in FOREIGN_FORMATS {
        if start.starts_with(word) {
            return named(name, expected);
        }
    }
    // IGES: lines of 80 columns; column 73 names the section, and the rest is a line number.
    let number = |digits: &[u8]| digits.iter().all(|b| matches!(b, b' ' | b'0'..=b'9'));
    if let [_text @ .., b's', a, b, c, d, e, f, g] = head.get(..80).unwrap_or_default()
        && number(&[*a, *b, *c, *d, *e, *f, *g])
        && head.get(80).is_none_or(|b| b.is_ascii_whitespace())
    {
        return named("an IGES file", TESSELLATED);
    }
    // DXF: pairs of a code and a value; 999 is a comment.
    let mut lines = Lines::new(head);
    while let (Some(code), Some(value)) = (lines.next(), lines.next()) {
        match (code.trim_ascii(), value.trim_ascii()) {
            (b"0", b"section") => return named("a DXF drawing", TESSELLATED),
            (b"999", _) => {}
            _ => break,
        }
    }
    if start.starts_with(b"{") {
        return named("a JSON document", EXPECTED);
    }
    if looks_utf16(head) {
        return named("UTF-16 text", PLAIN_TEXT);
    }
    None
}

/// Returns the name of a format with a signature, and the expected input.
fn signed(bytes: &[u8]) -> Option<(String, &'static str)> {
    let format = FileFormat::from(bytes);
    let expected = match format.kind() {
        // A truncated archive: its directory was at the end.
        _ if format == FileFormat::ArbitraryBinaryData && bytes.starts_with(b"PK\x03\x04") => {
            return Some(("a ZIP archive that is cut off".to_owned(), UNPACKED));
        }
        // The readers of supported formats report the mistake themselves.
        _ if matches!(
            format,
            FileFormat::ArbitraryBinaryData
                | FileFormat::StereolithographyAscii
                | FileFormat::PolygonAscii
                | FileFormat::PolygonBinary
        ) =>
        {
            return None;
        }
        Kind::Archive | Kind::Compressed => UNPACKED,
        Kind::Model => TESSELLATED,
        _ => EXPECTED,
    };
    let short = format.short_name().unwrap_or(format.extension());
    Some((format!("a file of the format {format} ({short})"), expected))
}

/// Returns the format of the bytes of a file, or an error that names the detected format.
pub fn format(path: &Path, bytes: &[u8]) -> Result<MeshFormat, Error> {
    let source = MeshInput {
        path,
        bytes,
        unit_mm: 1.0,
    };
    if bytes.is_empty() {
        return Err(source.error(Place::File, "an empty file", EXPECTED));
    }
    // Precedes all text checks: a binary STL may begin with "solid", "ply" or any other word.
    if is_whole_binary_stl(bytes) {
        return Ok(MeshFormat::BinaryStl);
    }
    let start = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    if start.starts_with(b"ply") && start.get(3).is_none_or(u8::is_ascii_whitespace) {
        return Ok(MeshFormat::Ply);
    }
    if bytes.starts_with(b"glTF") || is_json_gltf(bytes) {
        return Ok(MeshFormat::Gltf);
    }
    // A 3MF archive may have its signature anywhere, since the directory is at the end.
    if bytes.starts_with(b"PK\x03\x04")
        && FileFormat::from(bytes) == FileFormat::ThreeDimensionalManufacturingFormat
    {
        return Ok(MeshFormat::ThreeMf);
    }
    if is_package(bytes) {
        return Ok(MeshFormat::ThreeMf);
    }
    let head = text::without_end_mark(bytes);
    let head = head[..head.len().min(PROBE)].to_ascii_lowercase();
    let refused = |(name, expected): (String, &str)| source.error(Place::File, name, expected);
    if let Some(other) = foreign_format(&head) {
        return Err(refused(other));
    }
    let blank = |b: u8| matches!(b, b'\t' | b'\n' | b'\r' | 0x0b | 0x0c);
    let is_text = head.iter().all(|&b| b >= b' ' || blank(b));
    // Some programs pad text files with NULs.
    let end = head
        .iter()
        .rposition(|&b| b != 0 && !b.is_ascii_whitespace());
    let written = &head[..end.map_or(0, |end| end + 1)];
    let may_be_text = written.iter().all(|&b| b >= b' ' || blank(b));
    match first_word(bytes).filter(|_| may_be_text) {
        Some(word) if word.eq_ignore_ascii_case(b"solid") => return Ok(MeshFormat::AsciiStl),
        Some(word) if obj::is_statement(word) => return Ok(MeshFormat::Obj),
        _ => {}
    }
    if let Some(other) = signed(bytes) {
        return Err(refused(other));
    }
    if is_text && has_vertex(bytes) {
        return Ok(MeshFormat::Obj);
    }
    match first_word(bytes) {
        // The reader reports the size mismatch.
        _ if !is_text => Ok(MeshFormat::BinaryStl),
        Some(word) => Err(source.error(
            Place::File,
            format!("{} bytes of text beginning with {}", bytes.len(), quote(word)),
            "an STL (\"solid …\", or a binary header of 84 bytes), OBJ (\"v …\") or PLY (\"ply\") mesh",
        )),
        None => Err(source.error(Place::File, "blanks and comments only", EXPECTED)),
    }
}

/// True if an archive has the relationships of 3MF but no other sign of the format. Some programs
/// write entry names with a leading slash or with `\`.
fn is_package(bytes: &[u8]) -> bool {
    let is_zip = bytes.starts_with(b"PK\x03\x04") && FileFormat::from(bytes) == FileFormat::Zip;
    is_zip
        && bytes
            .windows(11)
            .any(|name| name == b"_rels/.rels" || name == b"_rels\\.rels")
}

/// True for a JSON object with the key `asset`, which glTF requires, at any position.
fn is_json_gltf(bytes: &[u8]) -> bool {
    let start = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let is_object = start.trim_ascii_start().starts_with(b"{");
    is_object && bytes.windows(7).any(|word| word == b"\"asset\"")
}

/// Returns the number of triangles that a binary STL header announces.
pub fn stl_count(bytes: &[u8]) -> Option<u64> {
    let count = bytes.get(80..84)?.try_into().ok()?;
    Some(u64::from(u32::from_le_bytes(count)))
}

/// True if the announced triangles fill the file to within less than one triangle.
fn is_whole_binary_stl(bytes: &[u8]) -> bool {
    stl_count(bytes).is_some_and(|count| fills(count, bytes.len() as u64))
}

/// True if `count` triangles of a binary STL make a file of `size` bytes.
pub fn fills(count: u64, size: u64) -> bool {
    let end = 84 + 50 * count;
    count > 0 && (end..end + 50).contains(&size)
}

/// True for UTF-16 without byte order mark: every second byte of Latin text is zero.
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

/// Returns the first word outside comments.
fn first_word(bytes: &[u8]) -> Option<&[u8]> {
    let is_comment = |word: &[u8]| word.starts_with(b";") || word.starts_with(b"//");
    Lines::new(bytes).find_map(|line| words(line).next().filter(|word| !is_comment(word)))
}

/// True if one of the first lines is a vertex of OBJ; the first line may be free text.
fn has_vertex(bytes: &[u8]) -> bool {
    const LINES: usize = 100;
    let is_vertex = |line: &[u8]| {
        let mut words = words(line);
        let is_v = words.next() == Some(b"v");
        is_v && words.filter(|word| text::number(word).is_ok()).count() >= 3
    };
    Lines::new(bytes).take(LINES).any(is_vertex)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn format_of(bytes: &[u8]) -> Result<MeshFormat, String> {
        format(Path::new("part.stl"), bytes).map_err(|e| e.to_string())
    }

    #[test]
    fn formats_are_told_by_content() {
        assert_eq!(format_of(b"ply\r\n"), Ok(MeshFormat::Ply));
        assert_eq!(
            format_of(b"\xef\xbb\xbf  SOLID x\n"),
            Ok(MeshFormat::AsciiStl)
        );
        assert_eq!(
            format_of(b"# made by\n\nmtllib a.mtl\n"),
            Ok(MeshFormat::Obj)
        );
        let mut binary = b"solid but binary".to_vec();
        binary.resize(84, b' ');
        binary[80..].copy_from_slice(&[1, 0, 0, 0]);
        binary.resize(134, 0);
        assert_eq!(format_of(&binary), Ok(MeshFormat::BinaryStl));
        for name in [
            &b"ply\n"[..],
            b"ply format ascii 1.0",
            b"PK\x03\x04",
            b"OFF",
        ] {
            binary[..name.len()].copy_from_slice(name);
            assert_eq!(format_of(&binary), Ok(MeshFormat::BinaryStl), "{name:?}");
        }
        assert_eq!(format_of(b"v 0 0 0\n\x1a"), Ok(MeshFormat::Obj));
    }

    #[test]
    fn strangers_are_named() {
        let utf16: Vec<u8> = "solid part\n facet".bytes().flat_map(|b| [b, 0]).collect();
        let iges = format!("{:72}S      1\n{:72}G      1\n", "made by", "1H,,1H;;");
        for (bytes, name) in [
            (b"".as_slice(), "empty file"),
            (b"  \n# x", "blanks"),
            (b"<HTML><body>solid", "HTML"),
            (
                b"version https://git-lfs.github.com/spec/v1\n",
                "git lfs pull",
            ),
            (b"PK\x03\x04....", "ZIP"),
            (b"ISO-10303-21;\nHEADER;", "STEP"),
            (b"/* made by */\n/**/ ISO-10303-21;\n", "STEP"),
            (iges.as_bytes(), "IGES"),
            (b"999\r\nmade by\r\n  0\r\nSECTION\r\n", "DXF"),
            (b"0\nSECTION\n", "DXF"),
            (b"OFF\n8 6 12\n", "OFF"),
            (b"COFF\n8 6 12\n", "OFF"),
            (b"# vtk DataFile Version 3.0\n", "VTK"),
            (b"<?xml version=\"1.0\"?>\n<VTKFile>", "XML"),
            (b"<?xml version=\"1.0\"?>\n<COLLADA>", "COLLADA"),
            (b"Kaydara FBX Binary  \0", "FBX"),
            (b"\x1f\x8b\x08\0", "gzip"),
            (b"7z\xbc\xaf\x27\x1c", "7-Zip"),
            (b"Rar!\x1a\x07\x01\0", "RAR"),
            (b"\x89PNG\r\n\x1a\n", "PNG"),
            (b"\xff\xd8\xff\xe0", "JPEG"),
            (b"II*\0\x08\0\0\0", "TIFF"),
            (b"%PDF-1.7\n", "PDF"),
            (b"\xff\xfes\0o\0", "UTF-16"),
            (&utf16, "UTF-16"),
            (b"{\"a\":{}}", "JSON"),
            (b"hello world", "\"hello\""),
            (b"plywood", "\"plywood\""),
        ] {
            let error = format_of(bytes).unwrap_err();
            assert!(error.contains(name), "{error} lacks {name}");
        }
    }
}

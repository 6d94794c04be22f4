//! PLY header: the elements that follow and their encoding.

use crate::error::{Error, Place};
use crate::mesh::MeshInput;
use crate::mesh::text::{Lines, quote};
use std::collections::HashSet;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Encoding {
    Ascii,
    Little,
    Big,
}

impl Encoding {
    fn named(name: &[u8]) -> Option<Encoding> {
        Some(match name {
            b"ascii" => Encoding::Ascii,
            b"binary_little_endian" => Encoding::Little,
            b"binary_big_endian" => Encoding::Big,
            _ => return None,
        })
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    pub fn named(name: &[u8]) -> Option<Scalar> {
        Some(match name {
            b"char" | b"int8" => Scalar::I8,
            b"uchar" | b"uint8" => Scalar::U8,
            b"short" | b"int16" => Scalar::I16,
            b"ushort" | b"uint16" => Scalar::U16,
            b"int" | b"int32" => Scalar::I32,
            b"uint" | b"uint32" => Scalar::U32,
            b"float" | b"float32" => Scalar::F32,
            b"double" | b"float64" => Scalar::F64,
            _ => return None,
        })
    }

    pub fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    pub fn is_integer(self) -> bool {
        !matches!(self, Scalar::F32 | Scalar::F64)
    }

    /// Returns the value of `size()` bytes in little-endian order; exact for every type.
    pub fn value(self, bytes: [u8; 8]) -> f64 {
        let raw = u64::from_le_bytes(bytes);
        match self {
            Scalar::I8 => f64::from(raw as i8),
            Scalar::U8 => f64::from(raw as u8),
            Scalar::I16 => f64::from(raw as i16),
            Scalar::U16 => f64::from(raw as u16),
            Scalar::I32 => f64::from(raw as i32),
            Scalar::U32 => f64::from(raw as u32),
            Scalar::F32 => f64::from(f32::from_bits(raw as u32)),
            Scalar::F64 => f64::from_bits(raw),
        }
    }
}

pub struct Property<'a> {
    pub name: &'a [u8],
    /// Type of the count of a list property.
    pub count: Option<Scalar>,
    pub item: Scalar,
}

pub struct PlyElement<'a> {
    pub name: &'a [u8],
    pub count: u64,
    pub properties: Vec<Property<'a>>,
    pub line: usize,
}

impl PlyElement<'_> {
    /// Returns the smallest size of one such element, bytes.
    pub fn least(&self, encoding: Encoding) -> u64 {
        match encoding {
            // A digit and a separator for each property.
            Encoding::Ascii => 2 * self.properties.len() as u64,
            _ => (self.properties.iter())
                .map(|p| p.count.unwrap_or(p.item).size() as u64)
                .sum(),
        }
    }

    pub fn property(&self, name: &str) -> Option<usize> {
        self.properties
            .iter()
            .position(|p| p.name == name.as_bytes())
    }
}

/// Reads the header; `lines` is then at the start of the data.
pub fn read<'a>(
    source: &MeshInput<'a>,
    lines: &mut Lines<'a>,
) -> Result<(Encoding, Vec<PlyElement<'a>>), Error> {
    let mut encoding = None;
    let mut elements: Vec<PlyElement> = Vec::new();
    // A header may be as long as the file, hence the hash sets.
    let mut names = HashSet::new();
    let mut properties = HashSet::new();
    while let Some(line) = lines.next() {
        let place = Place::Line(lines.number);
        let words: Vec<&[u8]> = line
            .split(u8::is_ascii_whitespace)
            .filter(|w| !w.is_empty())
            .collect();
        match words[..] {
            [b"ply"] if lines.number == 1 => {}
            [] | [b"comment" | b"obj_info", ..] => {}
            [b"format", name, b"1.0"] if encoding.is_none() => {
                encoding = Encoding::named(name);
                if encoding.is_none() {
                    let expected = "ascii, binary_little_endian or binary_big_endian";
                    return Err(source.error(place, quote(name), expected));
                }
            }
            [b"element", name, count] => {
                let parsed = std::str::from_utf8(count).ok().and_then(|c| c.parse().ok());
                let Some(count) = parsed else {
                    return Err(source.error(place, quote(count), "a count"));
                };
                if !names.insert(name) {
                    let found = format!("a second element {}", quote(name));
                    return Err(source.error(place, found, "each element once"));
                }
                properties.clear();
                elements.push(PlyElement {
                    name,
                    count,
                    properties: Vec::new(),
                    line: lines.number,
                });
            }
            [b"property", ref rest @ ..] => {
                let (property, element) = property(rest)
                    .zip(elements.last_mut())
                    .ok_or_else(|| source.error(place, quote(line), PROPERTY))?;
                if !properties.insert(property.name) {
                    return Err(source.error(
                        place,
                        second(&property, element),
                        "each property once",
                    ));
                }
                element.properties.push(property);
            }
            [b"end_header"] => {
                return match encoding {
                    Some(encoding) => Ok((encoding, elements)),
                    None => Err(source.error(place, "a header without format", "\"format … 1.0\"")),
                };
            }
            _ => return Err(source.error(place, quote(line), "a PLY header line")),
        }
    }
    let end = Place::Line(lines.number);
    Err(source.error(end, "the end of the file (is it cut off?)", "end_header"))
}

const PROPERTY: &str = "\"property TYPE NAME\" or \"property list TYPE TYPE NAME\" of an element";

fn second(property: &Property, element: &PlyElement) -> String {
    let [property, element] = [property.name, element.name].map(quote);
    format!("a second property {property} of element {element}")
}

fn property<'a>(words: &[&'a [u8]]) -> Option<Property<'a>> {
    let (count, item, name) = match *words {
        [b"list", count, item, name] => (Some(Scalar::named(count)?), item, name),
        [item, name] => (None, item, name),
        _ => return None,
    };
    if count.is_some_and(|c| !c.is_integer()) {
        return None;
    }
    Some(Property {
        name,
        count,
        item: Scalar::named(item)?,
    })
}

/// Refuses counts that exceed the size of the file, before memory is allocated.
pub fn check_counts(
    source: &MeshInput,
    encoding: Encoding,
    elements: &[PlyElement],
    body: usize,
) -> Result<(), Error> {
    // The last line of a text may lack its line end.
    let mut left = (source.bytes.len() - body) as u128 + 1;
    for element in elements {
        let needed = u128::from(element.count) * u128::from(element.least(encoding));
        if needed > left {
            return Err(source.error(
                Place::Line(element.line),
                format!(
                    "{} elements {}, at least {needed} bytes",
                    element.count,
                    quote(element.name)
                ),
                format!(
                    "no more than the {} bytes left of the file",
                    left.saturating_sub(1)
                ),
            ));
        }
        left -= needed;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use crate::mesh::parse;
    use std::path::Path;

    const GOOD: &str = "ply\r\nformat ascii 1.0\r\ncomment \u{fc}\r\nelement vertex 3\r\nproperty float x\r\n\
                        property float y\r\nproperty float z\r\nelement face 1\r\n\
                        property list uchar int vertex_index\r\nend_header\r\n0 0 0\n1 0 0\n\n0 1 0\n3 0 1 2\n";

    #[test]
    #[expect(clippy::too_many_lines, reason = "a table of one row a case")]
    fn header_mistakes_are_placed_on_their_line() {
        assert!(parse(Path::new("a.ply"), GOOD.as_bytes(), 1.0).is_ok());
        for (from, to, words) in [
            (
                "format ascii 1.0\r\n",
                "",
                "a.ply:9: found a header without format",
            ),
            ("ascii", "ebcdic", "a.ply:2: found \"ebcdic\""),
            (
                "vertex 3",
                "vertex -3",
                "a.ply:4: found \"-3\", expected a count",
            ),
            (
                "vertex 3",
                "vertex 99999999999999999999",
                "expected a count",
            ),
            (
                "vertex 3",
                "vertex 18446744073709551615",
                "a.ply:4: found 18446744073709551615 elements \"vertex\", at least 110680464442257309690 bytes",
            ),
            (
                "element face",
                "element vertex",
                "a.ply:8: found a second element",
            ),
            (
                "float y",
                "float x",
                "a.ply:6: found a second property \"x\" of element \"vertex\", expected each",
            ),
            ("float y", "half y", "a.ply:6: found \"property half y\""),
            (
                "float y",
                "float why",
                "a.ply:4: found vertices without x, y or z",
            ),
            ("list uchar", "list float", "a.ply:9"),
            (
                "vertex_index",
                "corners",
                "a.ply:8: found faces without a list",
            ),
            (
                "end_header",
                "end",
                "a.ply:10: found \"end\", expected a PLY header line",
            ),
            (
                "element face 1",
                "element face 0",
                "no triangles (a PLY of 3 vertex, 0 face; not read: 8 bytes after the last element)",
            ),
            (
                "3 0 1 2",
                "3 0 1 2 9",
                "a.ply:15: found \"9\", expected the end of the line",
            ),
            ("3 0 1 2", "3 0 1", "a.ply:15: found the end of the line"),
            ("3 0 1 2", "3 0 1 1.5", "expected an integer"),
            ("3 0 1 2", "-1 0 1", "a list of -1 items"),
            (
                "3 0 1 2",
                "3 0 1 3",
                "a.ply:15: found face 0 with vertex 3, expected one of the 3",
            ),
            ("3 0 1 2", "3 0 1 -1", "vertex -1"),
            (
                "1 0 0",
                "nan 0 0",
                "found face 0 with vertex 1 at (NaN, 0, 0)",
            ),
        ] {
            let error = parse(
                Path::new("a.ply"),
                GOOD.replacen(from, to, 1).as_bytes(),
                1.0,
            );
            let error = error.unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}

//! PLY (Turk, 1994), ASCII and binary in either byte order.
//!
//! The reader uses `x`, `y`, `z` of element `vertex`, and the list `vertex_indices` (or
//! `vertex_index`) of the elements `face`, `tristrips` and `trifans`. The integer `material_index`
//! of a face becomes its name. In strips and fans, −1 begins a new one.
//!
//! Faces of one or two corners have no area and are skipped. Other elements and bytes after the
//! last element are listed.

use header::{Encoding, PlyElement, Scalar};

use super::groups::{Groups, NONE, Namer};
use super::ignored::Collector;
use super::polygon::{MOST_CORNERS, TOO_MUCH, Triangulator};
use super::text::{self, Lines, quote, words};
use super::{Mesh, MeshInput};
use crate::error::{Error, Place};
use crate::math::DVec3;

mod header;

/// Rule that converts a list of vertices to triangles.
#[derive(Clone, Copy, PartialEq)]
enum FaceRule {
    Face,
    Strip,
    Fan,
}

impl FaceRule {
    fn of(element: &PlyElement) -> Option<FaceRule> {
        Some(match element.name {
            b"face" => FaceRule::Face,
            b"tristrips" => FaceRule::Strip,
            b"trifans" => FaceRule::Fan,
            _ => return None,
        })
    }
}

pub fn read(source: &MeshInput, ignored: &mut Collector) -> Result<(Mesh, Groups), Error> {
    let (mut body, elements) = Body::open(source)?;
    let mut positions = Vec::new();
    let mut triangles = Vec::new();
    let mut namer = Namer::default();
    // Faces that precede the vertices, and their positions in the file.
    let mut early = Vec::new();
    for (i, element) in elements.iter().enumerate() {
        let vertices_follow = || elements[i..].iter().any(|e| e.name == b"vertex");
        match (element.name, FaceRule::of(element)) {
            (b"vertex", _) => body.vertices(element, &mut positions)?,
            (_, Some(_)) if element.count == 0 => {}
            (_, Some(kind)) if vertices_follow() => {
                early.push((kind, element, body.offset, body.lines.clone()));
                body.skip(element)?;
            }
            (_, Some(kind)) => {
                body.faces(kind, element, &positions, &mut triangles, &mut namer)?;
            }
            _ => {
                if element.count > 0 {
                    let has_list = element.properties.iter().any(|p| p.count.is_some());
                    let name = format!("the element {} ({})", quote(element.name), element.count);
                    // The list may contain vertex indices, for example of a grid.
                    ignored.add(&name, has_list, str::to_owned);
                }
                body.skip(element)?;
            }
        }
    }
    body.end(ignored);
    for (kind, element, offset, lines) in early {
        (body.offset, body.lines) = (offset, lines);
        body.faces(kind, element, &positions, &mut triangles, &mut namer)?;
    }
    if triangles.is_empty() {
        let names: Vec<_> = (elements.iter())
            .map(|e| format!("{} {}", e.count, String::from_utf8_lossy(e.name)))
            .collect();
        let instead = format!("a PLY of {}", names.join(", "));
        return Err(source.no_triangles_but(&instead, ignored));
    }
    let mesh = source.mesh(&positions, &triangles)?;
    Ok((mesh, namer.finish(triangles.len())))
}

/// Reads the positions of the vertices, in the unit of the file.
pub fn read_points(source: &MeshInput) -> Result<Vec<DVec3>, Error> {
    let (mut body, elements) = Body::open(source)?;
    let mut positions = Vec::new();
    for element in &elements {
        match element.name {
            b"vertex" => body.vertices(element, &mut positions)?,
            _ => body.skip(element)?,
        }
    }
    Ok(positions)
}

/// Data after the header.
struct Body<'a> {
    source: &'a MeshInput<'a>,
    encoding: Encoding,
    /// Offset of the next value in a binary file.
    offset: usize,
    lines: Lines<'a>,
    /// Remaining words of the current element in an ASCII file, in reverse order.
    words: Vec<&'a [u8]>,
}

impl<'a> Body<'a> {
    /// Reads the header. Returns the data after it and the elements of the data.
    fn open(source: &'a MeshInput<'a>) -> Result<(Body<'a>, Vec<PlyElement<'a>>), Error> {
        let mut lines = Lines::new(source.bytes);
        let (encoding, elements) = header::read(source, &mut lines)?;
        header::check_counts(source, encoding, &elements, lines.offset)?;
        let body = Body {
            source,
            encoding,
            offset: lines.offset,
            lines,
            words: Vec::new(),
        };
        Ok((body, elements))
    }

    fn place(&self) -> Place {
        match self.encoding {
            Encoding::Ascii => Place::Line(self.lines.number),
            _ => Place::Byte(self.offset as u64),
        }
    }

    fn cut_off(&self, expected: &str) -> Error {
        let found = "the end of the file (is it cut off?)";
        self.source.error(self.place(), found, expected)
    }

    /// Advances to the next element: in ASCII, to the next line that is not blank.
    fn start(&mut self) -> Result<(), Error> {
        while self.encoding == Encoding::Ascii && self.words.is_empty() {
            let Some(line) = self.lines.next() else {
                return Err(self.cut_off("the elements that the header announces"));
            };
            self.words.extend(words(line));
            self.words.reverse();
        }
        Ok(())
    }

    /// Checks that the line of an element has no surplus words.
    fn finish(&mut self) -> Result<(), Error> {
        match self.words.last() {
            Some(word) => Err(self
                .source
                .error(self.place(), quote(word), "the end of the line")),
            None => Ok(()),
        }
    }

    fn scalar(&mut self, kind: Scalar) -> Result<f64, Error> {
        const EXPECTED: &str = "a value of every property";
        if self.encoding == Encoding::Ascii {
            let Some(word) = self.words.pop() else {
                return Err(self
                    .source
                    .error(self.place(), "the end of the line", EXPECTED));
            };
            return match text::number(word) {
                Ok(value) if kind.is_integer() && value.fract() != 0.0 => {
                    Err(self.source.error(self.place(), quote(word), "an integer"))
                }
                Ok(value) => Ok(value),
                Err(found) => Err(self.source.error(self.place(), found, text::NUMBER)),
            };
        }
        let size = kind.size();
        let Some(bytes) = self.source.bytes.get(self.offset..self.offset + size) else {
            return Err(self.cut_off(EXPECTED));
        };
        self.offset += size;
        let mut low_first = [0; 8];
        low_first[..size].copy_from_slice(bytes);
        if self.encoding == Encoding::Big {
            low_first[..size].reverse();
        }
        Ok(kind.value(low_first))
    }

    /// Reads one element. Stores its scalars in `values` by property, and the list of property
    /// `wanted` in `list`.
    fn element(
        &mut self,
        element: &PlyElement,
        values: &mut [f64],
        wanted: Option<(usize, FaceRule)>,
        list: &mut Vec<f64>,
    ) -> Result<(), Error> {
        self.start()?;
        list.clear();
        for (i, property) in element.properties.iter().enumerate() {
            let Some(kind) = property.count else {
                values[i] = self.scalar(property.item)?;
                continue;
            };
            let place = self.place();
            let count = self.scalar(kind)?;
            // Other lists may have any length that fits the file.
            let most = match wanted {
                Some((wanted, FaceRule::Face)) if wanted == i => MOST_CORNERS as f64,
                _ => f64::from(u32::MAX),
            };
            let is_wanted = wanted.is_some_and(|(wanted, _)| wanted == i);
            if !(0.0..=most).contains(&count) {
                let found = format!("a list of {count} items");
                return Err(self.source.error(place, found, format!("0 to {most}")));
            }
            for _ in 0..count as u64 {
                let item = self.scalar(property.item)?;
                if is_wanted {
                    list.push(item);
                }
            }
        }
        self.finish()
    }

    fn skip(&mut self, element: &PlyElement) -> Result<(), Error> {
        // An element without properties takes no bytes, for any count.
        if element.properties.is_empty() {
            return Ok(());
        }
        let mut values = vec![0.0; element.properties.len()];
        for _ in 0..element.count {
            self.element(element, &mut values, None, &mut Vec::new())?;
        }
        Ok(())
    }

    fn vertices(&mut self, element: &PlyElement, positions: &mut Vec<DVec3>) -> Result<(), Error> {
        let axis = |name| {
            element
                .property(name)
                .filter(|&i| element.properties[i].count.is_none())
        };
        let (Some(x), Some(y), Some(z)) = (axis("x"), axis("y"), axis("z")) else {
            let line = Place::Line(element.line);
            return Err(self
                .source
                .error(line, "vertices without x, y or z", "all three"));
        };
        // The count fits the file: header::check_counts().
        positions.reserve_exact(element.count as usize);
        let mut values = vec![0.0; element.properties.len()];
        let mut list = Vec::new();
        for _ in 0..element.count {
            self.element(element, &mut values, None, &mut list)?;
            positions.push(DVec3::new(values[x], values[y], values[z]));
        }
        Ok(())
    }

    fn faces(
        &mut self,
        kind: FaceRule,
        element: &PlyElement,
        positions: &[DVec3],
        triangles: &mut Vec<[u32; 3]>,
        namer: &mut Namer,
    ) -> Result<(), Error> {
        let corners = element
            .property("vertex_indices")
            .or(element.property("vertex_index"));
        let is_list = |&i: &usize| {
            element.properties[i].count.is_some() && element.properties[i].item.is_integer()
        };
        let Some(corners) = corners.filter(is_list) else {
            let line = Place::Line(element.line);
            let found = "faces without a list of whole numbers vertex_indices or vertex_index";
            return Err(self.source.error(line, found, "one of the two"));
        };
        let is_number = |&i: &usize| {
            element.properties[i].count.is_none() && element.properties[i].item.is_integer()
        };
        let material = element.property("material_index").filter(is_number);
        let mut named = None;
        triangles.reserve_exact(element.count as usize);
        let mut values = vec![0.0; element.properties.len()];
        let (mut list, mut face) = (Vec::new(), Vec::new());
        let mut cutter = Triangulator::default();
        for number in 0..element.count {
            let start = self.offset;
            self.element(element, &mut values, Some((corners, kind)), &mut list)?;
            let place = match self.encoding {
                Encoding::Ascii => self.place(),
                _ => Place::Byte(start as u64),
            };
            if kind != FaceRule::Face {
                for part in list.split(|&vertex| vertex == -1.0) {
                    self.corners(part, number, place, positions, &mut face)?;
                    triangles.extend(of_strip(kind, &face));
                }
                continue;
            }
            if list.len() < 3 {
                continue;
            }
            self.corners(&list, number, place, positions, &mut face)?;
            let name = material.map(|material| values[material]);
            if let Some(number) = name.filter(|_| name != named) {
                let list = namer.list(vec![number.to_string()]);
                namer.begin(triangles.len(), [list, NONE, NONE]);
                named = name;
            }
            if !cutter.triangulate(positions, &face, triangles) {
                return Err(self.source.error(place, TOO_MUCH[0], TOO_MUCH[1]));
            }
        }
        Ok(())
    }

    /// Returns the corners of a face as indices of valid vertices.
    fn corners(
        &self,
        list: &[f64],
        number: u64,
        place: Place,
        positions: &[DVec3],
        face: &mut Vec<u32>,
    ) -> Result<(), Error> {
        face.clear();
        for &corner in list {
            let position = (corner >= 0.0)
                .then(|| positions.get(corner as usize))
                .flatten();
            let Some(&position) = position.filter(|_| corner < f64::from(u32::MAX)) else {
                return Err(self.source.error(
                    place,
                    format!("face {number} with vertex {corner}"),
                    format!("one of the {} vertices, counted from 0", positions.len()),
                ));
            };
            if !self.source.usable(position) {
                let what = format!("face {number} with vertex {corner}");
                return Err(self.source.unusable(place, &what, position));
            }
            face.push(corner as u32);
        }
        Ok(())
    }

    /// Lists data after the elements that the header announces.
    fn end(&mut self, ignored: &mut Collector) {
        let offset = match self.encoding {
            Encoding::Ascii => self.lines.offset,
            _ => self.offset,
        };
        let rest = &self.source.bytes[offset..];
        if rest.is_empty() || self.encoding == Encoding::Ascii && rest.trim_ascii().is_empty() {
            return;
        }
        let bytes = text::count(rest.len(), "byte");
        let name = format!("{bytes} after the last element");
        match text::is_padding(text::without_end_mark(rest)) {
            true => ignored.harmless(name),
            false => ignored.shape(name),
        }
    }
}

/// Returns the triangles of a strip or a fan.
fn of_strip(kind: FaceRule, corners: &[u32]) -> impl Iterator<Item = [u32; 3]> {
    let triangles = corners.len().saturating_sub(2);
    (0..triangles).map(move |i| match kind {
        FaceRule::Fan => [corners[0], corners[i + 1], corners[i + 2]],
        // Every second triangle of a strip is reversed.
        _ if i % 2 == 1 => [corners[i + 1], corners[i], corners[i + 2]],
        _ => [corners[i], corners[i + 1], corners[i + 2]],
    })
}

#[cfg(test)]
mod tests {
    use crate::mesh::{Contents, parse_whole};
    use std::path::Path;

    fn read(text: &[u8]) -> Contents {
        parse_whole(Path::new("a.ply"), text, 1.0).unwrap()
    }

    fn header(format: &str, rest: &str) -> String {
        format!(
            "ply\nformat {format} 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\n{rest}end_header\n"
        )
    }

    /// Tests strips and fans of random vertices, with separators, against triangles from the
    /// definition. Covers faces before and after the vertices, in text and binary form.
    #[test]
    fn strips_and_fans_are_triangles() {
        for seed in 1..40u64 {
            let mut state = seed;
            let mut number = |below: u64| {
                state = state
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) % below
            };
            let is_fan = number(2) == 1;
            let list: Vec<i32> = (0..30).map(|_| number(10) as i32 - 1).collect();
            let mut expected = Vec::new();
            for run in list.split(|&v| v < 0) {
                for i in 2..run.len() {
                    expected.push(match (is_fan, i % 2) {
                        (true, _) => [run[0], run[i - 1], run[i]],
                        (false, 0) => [run[i - 2], run[i - 1], run[i]],
                        (false, _) => [run[i - 1], run[i - 2], run[i]],
                    });
                }
            }
            if expected.is_empty() {
                continue;
            }
            let name = if is_fan { "trifans" } else { "tristrips" };
            let element = format!("element {name} 1\nproperty list int int vertex_indices\n");
            let at = |v: i32| [v * v, v, 0];
            let words = |numbers: &mut dyn Iterator<Item = i32>| {
                numbers.map(|n| format!("{n} ")).collect::<String>()
            };
            let vertices: String = (0..9)
                .map(|v| words(&mut at(v).into_iter()) + "\n")
                .collect();
            let faces = format!("30 {}\n", words(&mut list.iter().copied()));
            let after = header("ascii", &element) + &vertices + &faces;
            let before = header("ascii", "").replacen(
                "element vertex",
                &(element.clone() + "element vertex"),
                1,
            ) + &faces
                + &vertices;
            let mut binary = header("binary_little_endian", &element).into_bytes();
            binary.extend((0..9).flat_map(at).flat_map(|x| (x as f32).to_le_bytes()));
            binary.extend([30].iter().chain(&list).flat_map(|x| x.to_le_bytes()));
            for bytes in [after.into_bytes(), before.into_bytes(), binary] {
                let contents = read(&bytes);
                assert_eq!(contents.ignored, []);
                let found: Vec<[i32; 3]> = (0..contents.mesh.triangles.len())
                    .map(|i| contents.mesh.triangle(i).map(|p| p.y as i32))
                    .collect();
                assert_eq!(found, expected, "seed {seed}");
            }
        }
    }

    #[test]
    fn other_data_is_listed() {
        let faces = "element face 1\nproperty list uchar int vertex_indices\n";
        let vertices = "0 0 0\n1 0 0\n0 1 0\n".repeat(3);
        let good = header("ascii", faces) + &vertices + "3 0 1 2\n";
        assert_eq!(read(good.as_bytes()).ignored, []);
        let edges = header(
            "ascii",
            &format!("{faces}element edge 2\nproperty int vertex1\nproperty int vertex2\n"),
        );
        let grid = header(
            "ascii",
            &format!("{faces}element grid 1\nproperty list uchar int vertex_indices\n"),
        );
        for (text, name, changes_shape) in [
            (
                format!("{good}\0\0\0"),
                "3 bytes after the last element",
                false,
            ),
            (
                format!("{good}3 0 1 2\n"),
                "8 bytes after the last element",
                true,
            ),
            (
                format!("{edges}{vertices}3 0 1 2\n0 1\n1 2\n"),
                "the element \"edge\" (2)",
                false,
            ),
            (
                format!("{grid}{vertices}3 0 1 2\n1 0\n"),
                "the element \"grid\" (1)",
                true,
            ),
        ] {
            let contents = read(text.as_bytes());
            assert_eq!(contents.mesh.triangles.len(), 1);
            let ignored = &contents.ignored;
            assert_eq!(ignored.len(), 1, "{ignored:?}");
            assert_eq!(
                (ignored[0].name.as_str(), ignored[0].changes_shape),
                (name, changes_shape)
            );
        }
        let with_mark = [b"\xef\xbb\xbf", good.as_bytes()].concat();
        assert_eq!(read(&with_mark), read(good.as_bytes()));
    }
}

//! PLY (Turk, 1994), ASCII and binary of either byte order.
//!
//! Wanted are `x`, `y`, `z` of element `vertex` and the list `vertex_indices`
//! (or `vertex_index`) of element `face`, and of its whole numbers `material_index`, which names the face; everything
//! else is stepped over. Faces of one or two corners have no area and are passed over. After
//! the last element blank lines (ASCII) or too few bytes for one more of it
//! (binary) are ignored; more is refused, since then the counts are wrong.

use header::{Element, Encoding, Scalar};

use super::groups::{Groups, NONE, Namer};
use super::polygon::{Cutter, MOST_CORNERS, TOO_MUCH};
use super::text::{self, Lines, quote, words};
use super::{Mesh, Source};
use crate::error::{Error, Place};
use crate::math::DVec3;

mod header;

pub fn read(source: &Source) -> Result<(Mesh, Groups), Error> {
    let mut lines = Lines::new(source.bytes);
    let (encoding, elements) = header::read(source, &mut lines)?;
    header::check_counts(source, encoding, &elements, lines.offset)?;
    let mut body = Body {
        source,
        encoding,
        offset: lines.offset,
        lines,
        words: Vec::new(),
    };
    let mut positions = Vec::new();
    let mut triangles = Vec::new();
    let mut namer = Namer::default();
    // Faces that stand before the vertices, and where.
    let mut early = None;
    for (i, element) in elements.iter().enumerate() {
        let vertices_follow = || elements[i..].iter().any(|e| e.name == b"vertex");
        match element.name {
            b"vertex" => body.vertices(element, &mut positions)?,
            b"face" if vertices_follow() => {
                early = Some((element, body.offset, body.lines.clone()));
                body.skip(element)?;
            }
            b"face" => body.faces(element, &positions, &mut triangles, &mut namer)?,
            _ => body.skip(element)?,
        }
    }
    body.end(elements.last().map_or(0, |e| e.least(encoding)))?;
    if let Some((element, offset, lines)) = early {
        (body.offset, body.lines) = (offset, lines);
        body.faces(element, &positions, &mut triangles, &mut namer)?;
    }
    if triangles.is_empty() {
        let names: Vec<_> = (elements.iter())
            .map(|e| format!("{} {}", e.count, String::from_utf8_lossy(e.name)))
            .collect();
        return Err(source.no_triangles(&format!("a PLY of {}", names.join(", "))));
    }
    let mesh = source.mesh(&positions, &triangles)?;
    Ok((mesh, namer.finish(triangles.len())))
}

/// The data after the header.
struct Body<'a> {
    source: &'a Source<'a>,
    encoding: Encoding,
    /// Of the next value, in a binary file.
    offset: usize,
    lines: Lines<'a>,
    /// Of the current element, in an ASCII file, last first.
    words: Vec<&'a [u8]>,
}

impl<'a> Body<'a> {
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

    /// Goes to the next element: in ASCII, the next line that is not blank.
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

    /// Checks that an element's line holds no more than the element.
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

    /// Reads one element: its scalars to `values` by property, the list of
    /// property `wanted` to `list`.
    fn element(
        &mut self,
        element: &Element,
        values: &mut [f64],
        wanted: Option<usize>,
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
            // Of other lists any length that the file holds will do.
            let most = if wanted == Some(i) {
                MOST_CORNERS as f64
            } else {
                f64::from(u32::MAX)
            };
            if !(0.0..=most).contains(&count) {
                let found = format!("a list of {count} items");
                return Err(self.source.error(place, found, format!("0 to {most}")));
            }
            for _ in 0..count as u64 {
                let item = self.scalar(property.item)?;
                if wanted == Some(i) {
                    list.push(item);
                }
            }
        }
        self.finish()
    }

    fn skip(&mut self, element: &Element) -> Result<(), Error> {
        // One without properties takes no bytes, however many there are.
        if element.properties.is_empty() {
            return Ok(());
        }
        let mut values = vec![0.0; element.properties.len()];
        for _ in 0..element.count {
            self.element(element, &mut values, None, &mut Vec::new())?;
        }
        Ok(())
    }

    fn vertices(&mut self, element: &Element, positions: &mut Vec<DVec3>) -> Result<(), Error> {
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
        element: &Element,
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
        let mut cutter = Cutter::default();
        for number in 0..element.count {
            let start = self.offset;
            self.element(element, &mut values, Some(corners), &mut list)?;
            let place = match self.encoding {
                Encoding::Ascii => self.place(),
                _ => Place::Byte(start as u64),
            };
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
            if !cutter.cut(positions, &face, triangles) {
                return Err(self.source.error(place, TOO_MUCH[0], TOO_MUCH[1]));
            }
        }
        Ok(())
    }

    /// The corners of a face as indices of usable vertices.
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

    /// Refuses data that the header does not announce.
    fn end(&mut self, least: u64) -> Result<(), Error> {
        let surplus = match self.encoding {
            Encoding::Ascii => self.lines.by_ref().any(|line| words(line).next().is_some()),
            _ => (self.source.bytes.len() - self.offset) as u64 >= least.max(1),
        };
        if surplus {
            let expected = "the end of the file after the elements that the header announces";
            return Err(self.source.error(self.place(), "more data", expected));
        }
        Ok(())
    }
}

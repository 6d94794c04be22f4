//! STL, binary and ASCII.
//!
//! Stored normals are ignored: they are often zero, NaN or stale, and the corner order defines the
//! orientation.
//!
//! Deviations from the format are handled as follows:
//! - Binary: fewer than 50 bytes (one triangle) after the last triangle are ignored and listed. A
//!   count that omits complete triangles is refused.
//! - ASCII: accepts any case, blanks and line ends, comments (`#`, `;`, `//`), lines of colours,
//!   several solids including empty ones, `end loop` for `endloop`, and facets without a normal. A
//!   missing `endsolid` and text after the last solid give a warning, because a file truncated
//!   between two facets looks alike.

use super::ignored::Collector;
use super::text::{self, quote};
use super::{Mesh, MeshInput, format_detection, weld};
use crate::error::{Error, Place};
use crate::math::DVec3;
use rayon::prelude::*;

/// Size of the header and triangle count, bytes.
const HEADER: usize = 84;
/// Size of a normal, three corners (f32 each) and an attribute word, bytes.
const RECORD: usize = 50;

/// Reads a binary STL: an 80-byte header, a count, and 50 bytes per triangle.
pub fn binary(source: &MeshInput, ignored: &mut Collector) -> Result<Mesh, Error> {
    let records = records(source)?;
    let rest = &source.bytes[HEADER + records.len() * RECORD..];
    if !rest.is_empty() {
        let (bytes, count) = (text::count(rest.len(), "byte"), records.len());
        let name = format!("{bytes} after the {count} triangles that the file announces");
        ignored.shape(name);
    }
    // −0 and +0 are one coordinate.
    let coordinate = |b: &[u8; 4]| match u32::from_le_bytes(*b) {
        0x8000_0000 => 0,
        bits => bits,
    };
    let welded = weld::triangles(records.len(), |t| {
        let (corners, _) = records[t][12..48].as_chunks::<12>();
        [0, 1, 2].map(|c| {
            let (xyz, _) = corners[c].as_chunks::<4>();
            [0, 1, 2].map(|i| coordinate(&xyz[i]))
        })
    });
    let position = |key: &[u32; 3]| DVec3::from_array(key.map(|c| f64::from(f32::from_bits(c))));
    let bad = |key: &[u32; 3]| !source.usable(position(key));
    if let Some(bad) = welded.keys.par_iter().position_first(bad) {
        let corners = welded.triangles.as_flattened();
        let corner = corners.iter().position(|&v| v as usize == bad).unwrap();
        let byte = HEADER + corner / 3 * RECORD + 12 * (1 + corner % 3);
        let what = format!("triangle {} with a corner", corner / 3);
        return Err(source.unusable(Place::Byte(byte as u64), &what, position(&welded.keys[bad])));
    }
    Ok(Mesh {
        positions: (welded.keys.par_iter())
            .map(|key| position(key) * source.unit_mm)
            .collect(),
        triangles: welded.triangles,
    })
}

/// Returns the bytes of the triangles after checking that the count fits the file.
fn records<'a>(source: &MeshInput<'a>) -> Result<&'a [[u8; RECORD]], Error> {
    let Some(count) = format_detection::stl_count(source.bytes) else {
        return Err(source.error(
            Place::File,
            format!("{} bytes of binary data", source.bytes.len()),
            "a binary STL (84 bytes and 50 a triangle), or an OBJ or PLY mesh",
        ));
    };
    let (records, rest) = source.bytes[HEADER..].as_chunks::<RECORD>();
    if count == 0 && source.bytes.len() < HEADER + RECORD {
        return Err(source.no_triangles("a binary STL that announces none"));
    }
    if count != records.len() as u64 {
        let partial = match rest.len() {
            0 => String::new(),
            n => format!(" and {n} bytes of another"),
        };
        return Err(source.error(
            Place::Byte(80),
            format!(
                "binary data which, as STL, announces {count} triangles and holds {}{partial}",
                records.len()
            ),
            "the number of triangles the file holds",
        ));
    }
    Ok(records)
}

/// Reads an ASCII STL.
pub fn ascii(source: &MeshInput, ignored: &mut Collector) -> Result<Mesh, Error> {
    let mut reader = Ascii {
        source,
        ignored,
        lines: text::Lines::new(source.bytes),
        words: Vec::new(),
        next: 0,
        corners: Vec::new(),
    };
    let mut solids = 0;
    while reader.advance() {
        if !reader.next_is("solid") {
            reader.surplus()?;
            continue;
        }
        while reader.solid()? {
            solids += 1;
        }
        solids += 1;
    }
    if reader.corners.is_empty() {
        return Err(source.no_triangles(&format!("{solids} empty solids")));
    }
    let count = reader.corners.len() / 3;
    let welded = weld::triangles(count, |t| {
        [0, 1, 2].map(|c| weld::bits(reader.corners[3 * t + c]))
    });
    Ok(Mesh {
        positions: (welded.keys.iter())
            .map(|key| DVec3::from_array(key.map(f64::from_bits)) * source.unit_mm)
            .collect(),
        triangles: welded.triangles,
    })
}

/// Parser that reads word by word; line ends matter only after the name of a solid.
struct Ascii<'a> {
    source: &'a MeshInput<'a>,
    lines: text::Lines<'a>,
    /// Words of the current line, including the next one to be read.
    words: Vec<&'a [u8]>,
    next: usize,
    /// Three corners per triangle, in the unit of the file.
    corners: Vec<DVec3>,
    ignored: &'a mut Collector,
}

impl<'a> Ascii<'a> {
    /// Advances to the next word, on a later line if necessary. Returns false at the end.
    fn advance(&mut self) -> bool {
        while self.next == self.words.len() {
            let Some(line) = self.lines.next() else {
                return false;
            };
            self.words.clear();
            self.next = 0;
            let mut words = text::words(line);
            let Some(first) = words.next() else {
                continue;
            };
            if first.starts_with(b";") || first.starts_with(b"//") {
                self.ignored.harmless("comments");
            } else if [&b"color"[..], b"colour"].contains(&&*first.to_ascii_lowercase()) {
                self.ignored.harmless("colours");
            } else {
                self.words.push(first);
                self.words.extend(words);
            }
        }
        true
    }

    /// True if the next word of the line equals `keyword`.
    fn next_is(&self, keyword: &str) -> bool {
        is(self.words.get(self.next), keyword)
    }

    /// Skips text after a solid.
    fn surplus(&mut self) -> Result<(), Error> {
        let word = self.words[self.next];
        if self.corners.is_empty() {
            return Err(self.error(quote(word), "solid"));
        }
        match self.words[self.next..]
            .iter()
            .all(|word| text::is_padding(word))
        {
            true => self.ignored.harmless("NUL bytes after the last solid"),
            false => {
                let line = self.lines.number;
                let name = |_: &str| format!("text after a solid, first on line {line}");
                self.ignored.add("text after a solid", true, name);
            }
        }
        self.next = self.words.len();
        Ok(())
    }

    /// Returns the next word, which should be `expected`.
    fn word(&mut self, expected: &str) -> Result<&'a [u8], Error> {
        if !self.advance() {
            return Err(self.error("the end of the file (is it cut off?)", expected));
        }
        self.next += 1;
        Ok(self.words[self.next - 1])
    }

    fn error(&self, found: impl Into<String>, expected: &str) -> Error {
        let line = Place::Line(self.lines.number.max(1));
        self.source.error(line, found, expected)
    }

    fn expect(&mut self, keyword: &str) -> Result<(), Error> {
        let word = self.word(keyword)?;
        if word.eq_ignore_ascii_case(keyword.as_bytes()) {
            return Ok(());
        }
        // "end loop" for "endloop".
        if let Some(rest) = keyword.strip_prefix("end")
            && word.eq_ignore_ascii_case(b"end")
        {
            return self.expect(rest);
        }
        Err(self.error(quote(word), keyword))
    }

    /// Skips the name of a solid, free text in any encoding, up to the next statement, which
    /// `begins` detects. A complete file may be one line.
    fn skip_name(&mut self, begins: impl Fn(&[&[u8]]) -> bool) {
        let rest = &self.words[self.next..];
        let name = (0..rest.len()).find(|&i| begins(&rest[i..]));
        self.next += name.unwrap_or(rest.len());
    }

    /// Reads a solid. Returns true if another one begins where its end is missing.
    fn solid(&mut self) -> Result<bool, Error> {
        const NEXT: &str = "facet or endsolid";
        self.expect("solid")?;
        let is_facet = |words: &[&[u8]]| {
            let at = |i: usize, keyword: &str| is(words.get(i), keyword);
            at(0, "facet") && at(1, "normal") && at(5, "outer") && at(6, "loop")
        };
        self.skip_name(is_facet);
        loop {
            if !self.advance() || self.next_is("solid") {
                // A file truncated within a facet is refused in `facet`.
                let line = self.lines.number;
                let name = |_: &str| {
                    format!("the end of a solid, missing at line {line} (is the file cut off?)")
                };
                self.ignored.add("the end of a solid", true, name);
                return Ok(self.next < self.words.len());
            }
            let word = self.word(NEXT)?;
            let ends = word.eq_ignore_ascii_case(b"endsolid");
            if ends || word.eq_ignore_ascii_case(b"end") && self.next_is("solid") {
                self.next += usize::from(!ends);
                self.skip_name(|words| {
                    is(words.first(), "solid") && (1..words.len()).any(|i| is_facet(&words[i..]))
                });
                return Ok(false);
            }
            if !word.eq_ignore_ascii_case(b"facet") {
                return Err(self.error(quote(word), NEXT));
            }
            self.facet()?;
        }
    }

    fn facet(&mut self) -> Result<(), Error> {
        const NORMAL: &str = "normal or outer";
        // Skipped with any content: normals like "-nan(ind)" are common, and some programs write
        // none.
        if self.advance() && !self.next_is("outer") {
            self.expect("normal")?;
            for _ in 0..3 {
                if self.advance() && !self.next_is("outer") {
                    self.word(NORMAL)?;
                }
            }
        }
        self.expect("outer")?;
        self.expect("loop")?;
        for _ in 0..3 {
            self.expect("vertex")?;
            let corner = DVec3::new(self.number()?, self.number()?, self.number()?);
            if !self.source.usable(corner) {
                let place = Place::Line(self.lines.number);
                return Err(self.source.unusable(place, "a vertex", corner));
            }
            self.corners.push(corner);
        }
        self.expect("endloop")?;
        self.expect("endfacet")
    }

    fn number(&mut self) -> Result<f64, Error> {
        let word = self.word(text::NUMBER)?;
        text::number(word).map_err(|found| self.error(found, text::NUMBER))
    }
}

fn is(word: Option<&&[u8]>, keyword: &str) -> bool {
    word.is_some_and(|word| word.eq_ignore_ascii_case(keyword.as_bytes()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{parse, parse_whole};
    use proptest::prelude::*;
    use std::path::Path;

    /// Returns a binary STL of these triangles.
    fn encode(triangles: &[[[f32; 3]; 3]]) -> Vec<u8> {
        let mut bytes = b"solid whatever".to_vec();
        bytes.resize(80, 0);
        bytes.extend((triangles.len() as u32).to_le_bytes());
        for triangle in triangles {
            bytes.extend([0; 12]);
            bytes.extend((triangle.as_flattened().iter()).flat_map(|c| c.to_le_bytes()));
            bytes.extend([0; 2]);
        }
        bytes
    }

    const TRIANGLE: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [1.0, 0.0, -0.0], [0.0, 1.0, 0.5]];

    fn fails(bytes: &[u8]) -> String {
        parse(Path::new("a.stl"), bytes, 1.0)
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn less_than_a_triangle_may_trail_but_no_whole_one() {
        let mut bytes = encode(&[TRIANGLE; 2]);
        let mesh = parse(Path::new("a"), &bytes, 1.0).unwrap();
        assert_eq!(mesh.triangles, [[0, 1, 2]; 2]);
        bytes.extend([b'x'; 49]);
        assert_eq!(parse(Path::new("a"), &bytes, 1.0).unwrap(), mesh);
        bytes.push(b'x');
        assert!(fails(&bytes).contains("announces 2 triangles and holds 3"));
        assert!(fails(&bytes[..183]).contains("holds 1 and 49 bytes"));
    }

    #[test]
    fn a_bad_corner_is_placed() {
        let mut bytes = encode(&[
            TRIANGLE,
            TRIANGLE,
            [TRIANGLE[0], [f32::NAN, 0.0, 1.0], TRIANGLE[1]],
        ]);
        // Header, two records, normal, one corner.
        assert!(fails(&bytes).contains("byte 208: found triangle 2 with a corner at (NaN, 0, 1)"));
        bytes[208..212].copy_from_slice(&f32::MAX.to_le_bytes());
        assert!(fails(&bytes).contains("1e12 mm"));
    }

    #[test]
    fn ascii_mistakes_are_placed_on_their_line() {
        let good = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n\
                    vertex 0 1 0\nendloop\nendfacet\nendsolid a\n";
        assert_eq!(
            parse(Path::new("a"), good.as_bytes(), 1.0)
                .unwrap()
                .triangles,
            [[0, 1, 2]]
        );
        for (from, to, words) in [
            (
                "vertex 1 0 0",
                "vertex 1,5 0 0",
                "a.stl:5: found \"1,5\" with a comma",
            ),
            ("vertex 1 0 0", "vertex 1 0", "a.stl:6: found \"vertex\""),
            (
                "vertex 1 0 0",
                "vertex nan 0 0",
                "a.stl:5: found a vertex at (NaN, 0, 0)",
            ),
            (
                "endloop",
                "vertex 1 1 0\nendloop",
                "a.stl:7: found \"vertex\", expected endloop",
            ),
            (
                "endfacet\nendsolid a\n",
                "",
                "a.stl:7: found the end of the file",
            ),
            (
                "endfacet\nendsolid a\n",
                "endfacet\nrubbish\nendsolid a\n",
                "a.stl:9: found \"rubbish\"",
            ),
            (
                "endloop",
                "end facet",
                "a.stl:7: found \"facet\", expected loop",
            ),
        ] {
            let error = fails(good.replace(from, to).as_bytes());
            assert!(error.contains(words), "{error}");
        }
    }

    /// Tests deviations from the format at random positions: none of them changes the triangles.
    #[test]
    fn loose_files_are_read_and_what_is_left_out_is_listed() {
        let good = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n\
                    vertex 0 1 0\nendloop\nendfacet\nfacet normal 0 0 1\nouter loop\nvertex 1 0 0\nvertex 1 1 0\n\
                    vertex 0 1 0\nendloop\nendfacet\nendsolid a\n";
        let read =
            |bytes: &[u8]| parse_whole(Path::new("a.stl"), bytes, 1.0).map_err(|e| e.to_string());
        let plain = read(good.as_bytes()).unwrap();
        assert_eq!(plain.ignored, []);
        let lines: Vec<&str> = good.lines().collect();
        for seed in 0..200usize {
            let at = 1 + seed * 7919 % (lines.len() - 1);
            let inserted = |line: &str| {
                let mut lines = lines.clone();
                lines.insert(at, line);
                lines.join("\n")
            };
            let tail = "\0".repeat(1 + seed % 50);
            for (text, name, changes_shape) in [
                (inserted("color 0.5 0.5 1"), "colours", false),
                (inserted("  COLOUR 1 2 3"), "colours", false),
                (inserted("; made by"), "comments", false),
                (inserted("// vertex 1 2 3"), "comments", false),
                (good.replace("endloop", "end loop"), "", false),
                (good.replace("endfacet", "END FACET"), "", false),
                (good.replace("endsolid", "end solid"), "", false),
                (good.replace("normal 0 0 1", ""), "", false),
                (good.replace('\n', " "), "", false),
                (format!("{good}{tail}"), "NUL bytes", false),
                (
                    format!("{good}\nExported by {seed}\n"),
                    "text after a solid, first on line 18",
                    true,
                ),
                (good.replace("endsolid a\n", ""), "the end of a solid", true),
                (format!("; head\n// head\n{good}"), "comments", false),
            ] {
                let contents =
                    read(text.as_bytes()).unwrap_or_else(|error| panic!("{error}: {text}"));
                assert_eq!(contents.mesh, plain.mesh, "{text}");
                let names: Vec<_> = contents
                    .ignored
                    .iter()
                    .map(|i| (i.name.as_str(), i.changes_shape))
                    .collect();
                match name {
                    "" => assert_eq!(names, [], "{text}"),
                    name => assert!(
                        names.len() == 1
                            && names[0].0.contains(name)
                            && names[0].1 == changes_shape,
                        "{names:?}"
                    ),
                }
            }
        }
        // Consecutive solids without an end.
        let open = good.replace("endsolid a\n", "");
        let three = read(open.repeat(3).as_bytes()).unwrap();
        assert_eq!((three.mesh.triangles.len(), three.ignored[0].count), (6, 3));
        let mut binary = encode(&[TRIANGLE; 3]);
        binary.extend([0; 17]);
        let names = read(&binary).unwrap().ignored;
        assert_eq!(
            names[0].name,
            "17 bytes after the 3 triangles that the file announces"
        );
        assert!(names[0].changes_shape);
    }

    proptest! {
        #[test]
        fn binary_and_ascii_say_the_same(corners in prop::collection::vec(any::<[[i16; 3]; 3]>(), 1..40)) {
            let triangles: Vec<_> = corners.iter().map(|t| t.map(|p| p.map(|c| f32::from(c) / 7.0))).collect();
            let mut text = String::from("solid\n");
            for t in &triangles {
                text += "facet normal 0 0 0 outer loop ";
                t.iter().for_each(|p| text += &format!("vertex {:?} {:?} {:?} ", f64::from(p[0]), f64::from(p[1]), f64::from(p[2])));
                text += "endloop endfacet\n";
            }
            text += "endsolid";
            let binary = parse(Path::new("b"), &encode(&triangles), 0.1).unwrap();
            prop_assert_eq!(&binary, &parse(Path::new("a"), text.as_bytes(), 0.1).unwrap());
            for (i, t) in triangles.iter().enumerate() {
                let expected = t.map(|p| DVec3::from_array(p.map(f64::from)) * 0.1);
                prop_assert_eq!(binary.triangle(i), expected);
            }
        }
    }
}

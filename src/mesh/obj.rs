//! Wavefront OBJ, through `tobj`.
//!
//! `tobj` stands behind a reader that hands it plain `v x y z` and `f i j k …`
//! lines only, because on its own it gives no line numbers, takes a polyline
//! (`l`) for a face, divides by a fourth coordinate, panics on some texture
//! indices, knows no continuation lines and wants UTF-8.
//!
//! Faces of one or two corners have no area and are passed over, as are
//! materials, normals, texture coordinates and free-form surfaces. An unknown
//! statement is refused: a misspelt `v` would shift all later indices. OBJ has
//! no end mark: a file cut off between two lines cannot be told from a whole one
//! (its missing faces show as boundary edges in the report).

use std::collections::HashMap;
use std::io::{self, BufRead, Read};

use super::polygon::{Cutter, MOST_CORNERS, TOO_MUCH};
use super::text::{self, Lines, quote};
use super::{Mesh, Source};
use crate::error::{Error, Place};
use crate::math::DVec3;

/// The statements of the format (Wavefront, Advanced Visualizer manual,
/// appendix B1), current and superseded.
const STATEMENTS: &str = "v vt vn vp vc f fo l p o g s mg mtllib usemtl usemat maplib usemap \
    cstype deg bmat step curv curv2 surf parm trim hole scrv sp end con bevel c_interp d_interp \
    lod shadow_obj trace_obj ctech stech call csh";

pub fn is_statement(word: &[u8]) -> bool {
    STATEMENTS.split(' ').any(|s| s.as_bytes() == word)
}

/// Faces after which `tobj` is made to start a new object: it keeps 104 bytes a
/// face until then.
const FACES_AT_ONCE: usize = 1 << 16;

pub fn read(source: &Source) -> Result<Mesh, Error> {
    let mut plain = Plain::new(source);
    let options = tobj::LoadOptions::default();
    let no_materials = |_: &std::path::Path| Err(tobj::LoadError::GenericFailure);
    let result = tobj::load_obj_buf(&mut plain, &options, no_materials);
    if let Some(failure) = plain.failure {
        return Err(failure);
    }
    let (furthest, line) = plain.furthest;
    if furthest > plain.vertices {
        return Err(source.error(
            Place::Line(line),
            format!("a face with vertex {furthest}"),
            format!("one of the file's {} vertices", plain.vertices),
        ));
    }
    let (models, _) = result.map_err(|e| {
        source.error(
            Place::Line(plain.lines.number),
            e.to_string(),
            "an OBJ mesh",
        )
    })?;
    let mut positions = Vec::new();
    let mut triangles = Vec::new();
    let mut cutter = Cutter::default();
    for model in models {
        if !append(model.mesh, &mut cutter, &mut positions, &mut triangles) {
            return Err(source.error(Place::File, TOO_MUCH[0], TOO_MUCH[1]));
        }
    }
    // Vertices first referred to before they stood in the file.
    for t in &triangles {
        if let Some(&v) = t.iter().find(|&&v| !source.usable(positions[v as usize])) {
            return Err(source.unusable(Place::File, "a vertex", positions[v as usize]));
        }
    }
    if triangles.is_empty() {
        let instead = format!("an OBJ with {} vertices and no face", plain.vertices);
        return Err(source.no_triangles(&instead));
    }
    source.mesh(&positions, &triangles)
}

/// Adds the faces of one of `tobj`'s models, cut to triangles. False if that
/// is too much work.
fn append(
    mesh: tobj::Mesh,
    cutter: &mut Cutter,
    positions: &mut Vec<DVec3>,
    triangles: &mut Vec<[u32; 3]>,
) -> bool {
    let first = u32::try_from(positions.len()).expect("an OBJ of more than 2³² vertices");
    let (xyz, _) = mesh.positions.as_chunks::<3>();
    positions.extend(xyz.iter().map(|p| DVec3::from_array(*p)));
    let mut corners = mesh.indices;
    corners.iter_mut().for_each(|i| *i += first);
    if mesh.face_arities.is_empty() {
        triangles.extend(corners.as_chunks::<3>().0);
        return true;
    }
    let mut rest = corners.as_slice();
    mesh.face_arities.iter().all(|&arity| {
        let (face, others) = rest.split_at(arity as usize);
        rest = others;
        cutter.cut(positions, face, triangles)
    })
}

/// The file as `tobj` gets it, made line by line.
struct Plain<'a> {
    source: &'a Source<'a>,
    lines: Lines<'a>,
    /// The line being handed over, and how much of it has been.
    out: Vec<u8>,
    taken: usize,
    vertices: usize,
    faces: usize,
    /// Largest vertex number in a face, and its line.
    furthest: (usize, usize),
    /// Vertices that no face may use, with their lines.
    unusable: HashMap<usize, (usize, DVec3)>,
    failure: Option<Error>,
}

impl<'a> Plain<'a> {
    fn new(source: &'a Source<'a>) -> Plain<'a> {
        Plain {
            source,
            lines: Lines::new(source.bytes),
            out: Vec::new(),
            taken: 0,
            vertices: 0,
            faces: 0,
            furthest: (0, 0),
            unusable: HashMap::new(),
            failure: None,
        }
    }

    /// Makes the next line. False at the end.
    fn line(&mut self) -> Result<bool, Error> {
        let Some(line) = self.lines.next() else {
            return Ok(false);
        };
        let place = self.lines.number;
        let mut words: Vec<&[u8]> = text::words(line).collect();
        // A backslash joins the next line, except at the end of a comment,
        // where it is more likely a Windows path.
        let mut end = line;
        while end.trim_ascii_end().ends_with(b"\\")
            && words.last().is_some_and(|w| w.ends_with(b"\\"))
        {
            let last = words.pop().unwrap_or_default();
            words.extend(last.strip_suffix(b"\\").filter(|w| !w.is_empty()));
            end = self.lines.next().unwrap_or_default();
            words.extend(text::words(end));
        }
        match words.split_first() {
            Some((&b"v", coordinates)) => self.vertex(coordinates, place)?,
            Some((&b"f" | &b"fo", corners)) => self.face(corners, place)?,
            Some((statement, _)) if !is_statement(statement) => {
                let line = Place::Line(place);
                return Err(self
                    .source
                    .error(line, quote(statement), "an OBJ statement"));
            }
            _ => {}
        }
        Ok(true)
    }

    /// `x y z`, then perhaps a weight of 1 or a colour.
    fn vertex(&mut self, words: &[&[u8]], line: usize) -> Result<(), Error> {
        let error = |found: String, expected| self.source.error(Place::Line(line), found, expected);
        let number = |word: &[u8]| text::number(word).map_err(|f| error(f, text::NUMBER));
        let (xyz, more) = match words {
            [x, y, z, more @ ..] if more.len() != 2 => ([*x, *y, *z], more),
            _ => {
                return Err(error(
                    format!("a vertex of {} numbers", words.len()),
                    "x y z",
                ));
            }
        };
        if let [w] = more
            && number(w)? != 1.0
        {
            // The format means it for curves only; some readers divide by it.
            return Err(error(
                format!("a vertex of weight {}", quote(w)),
                "no weight, or 1",
            ));
        }
        let position = DVec3::new(number(xyz[0])?, number(xyz[1])?, number(xyz[2])?);
        self.vertices += 1;
        if !self.source.usable(position) {
            self.unusable.insert(self.vertices, (line, position));
        }
        self.out.push(b'v');
        for word in xyz {
            self.out.push(b' ');
            match text::fortran(word) {
                Some(word) => self.out.extend(word.as_bytes()),
                None => self.out.extend(word),
            }
        }
        self.out.push(b'\n');
        Ok(())
    }

    /// `v`, `v/vt`, `v//vn` or `v/vt/vn` a corner; counted from 1, or from −1
    /// backwards.
    fn face(&mut self, words: &[&[u8]], line: usize) -> Result<(), Error> {
        let place = Place::Line(line);
        if words.len() < 3 {
            return Ok(());
        }
        if words.len() > MOST_CORNERS {
            let found = format!("a face of {} corners", words.len());
            let most = format!("at most {MOST_CORNERS}");
            return Err(self.source.error(place, found, most));
        }
        if self.faces == FACES_AT_ONCE && self.furthest.0 <= self.vertices {
            self.out.extend(b"o\n");
            self.faces = 0;
        }
        self.faces += 1;
        self.out.push(b'f');
        for word in words {
            let first = word.split(|&b| b == b'/').next().unwrap_or_default();
            let index = std::str::from_utf8(first)
                .ok()
                .and_then(|i| i.parse::<i64>().ok());
            let vertex = match index {
                Some(i) if i > 0 => Some(i as usize),
                Some(i) if i < 0 => (self.vertices as i64)
                    .checked_add(i + 1)
                    .filter(|&v| v > 0)
                    .map(|v| v as usize),
                _ => None,
            };
            let Some(vertex) = vertex else {
                let found = format!("a face with vertex {}", quote(word));
                let range = match self.vertices {
                    0 => "a vertex to come before it".into(),
                    n => format!("1 to {n} or -1 to -{n}"),
                };
                return Err(self.source.error(place, found, range));
            };
            if let Some(&(at, position)) = self.unusable.get(&vertex) {
                let what = format!("vertex {vertex}, used by the face of line {line},");
                return Err(self.source.unusable(Place::Line(at), &what, position));
            }
            if vertex > self.furthest.0 {
                self.furthest = (vertex, line);
            }
            self.out.extend(format!(" {vertex}").as_bytes());
        }
        self.out.push(b'\n');
        Ok(())
    }
}

impl BufRead for Plain<'_> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        while self.taken == self.out.len() {
            self.taken = 0;
            self.out.clear();
            match self.line() {
                Ok(true) => {}
                Ok(false) => break,
                Err(failure) => {
                    self.failure = Some(failure);
                    return Err(io::Error::from(io::ErrorKind::InvalidData));
                }
            }
        }
        Ok(&self.out[self.taken..])
    }

    fn consume(&mut self, amount: usize) {
        self.taken += amount;
    }
}

impl Read for Plain<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let amount = self.fill_buf()?.read(into)?;
        self.consume(amount);
        Ok(amount)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::parse;
    use std::path::Path;

    const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

    fn read(faces: &str) -> Result<Mesh, String> {
        let text = format!("{SQUARE}{faces}");
        parse(Path::new("a.obj"), text.as_bytes(), 1.0).map_err(|e| e.to_string())
    }

    #[test]
    fn all_ways_to_write_a_face_mean_the_same() {
        let plain = read("f 1 2 3\nf 1 3 4\n").unwrap();
        for faces in [
            "f 1/1/1 2/9999999/-77 3//4\nf 1// 3// 4/ \n",
            "f -4 -3 -2\r\nf -4 -2 -1",
            "f 1 \\\n2 3\nf 1 3\\\n4\n",
            "# c:\\temp\\\nf 1 2 3 # comment \\\nf 1 3 4\n",
            "g a b\nusemtl\ns off\nf 1 2 3\no Zahnr\u{e4}der\nusemtl x\nf 1 3 4\nl 1 2 3 4\np 1\nf 1 2\nf\n",
            "v 7 7 7 1.0\nv nan nan nan\nv 5 5 5 nan nan 0.5\nvt x\nvn\nf 1 2 3\nf 1 3 4\n",
        ] {
            assert_eq!(read(faces).as_ref(), Ok(&plain), "{faces}");
        }
        // Before the vertices they name.
        let early = format!("f 1 2 3\nf 1 3 4\n{SQUARE}");
        assert_eq!(parse(Path::new("a"), early.as_bytes(), 1.0).unwrap(), plain);
        let fortran = format!("f 1 2 3\nf 1 3 4\n{}", SQUARE.replace("1 ", "1.0D0 "));
        assert_eq!(
            parse(Path::new("a"), fortran.as_bytes(), 1.0).unwrap(),
            plain
        );
    }

    #[test]
    fn mistakes_are_placed_on_their_line() {
        for (faces, words) in [
            (
                "f 1 2 5",
                "a.obj:5: found a face with vertex 5, expected one of the file's 4",
            ),
            (
                "f 1 2 0",
                "a.obj:5: found a face with vertex \"0\", expected 1 to 4",
            ),
            ("\nf -5 2 1", "a.obj:6: found a face with vertex \"-5\""),
            ("f 1 2 9223372036854775808", "a.obj:5"),
            ("f 1 2 -9223372036854775808", "a.obj:5"),
            ("f 1.5 2 3", "\"1.5\""),
            (
                "f 1 2 3\nw 1 2 3",
                "a.obj:6: found \"w\", expected an OBJ statement",
            ),
            ("v 1 2", "a.obj:5: found a vertex of 2 numbers"),
            ("v 1 2 3 4 5", "a.obj:5: found a vertex of 5 numbers"),
            ("v 1 2 3 0.5", "weight"),
            ("v 1,5 2 3", "comma"),
            (
                "v inf 2 3\n\nf 1 2 5",
                "a.obj:5: found vertex 5, used by the face of line 7, at (inf, 2, 3)",
            ),
            ("f 1 2 5\nv inf 2 3", "a vertex at (inf, 2, 3)"),
            (
                "l 1 2 3",
                "no triangles (an OBJ with 4 vertices and no face)",
            ),
        ] {
            let error = read(faces).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
        let many = "f".to_string() + &" 1 2 3".repeat(MOST_CORNERS);
        assert!(read(&many).unwrap_err().contains("corners"));
    }

    #[test]
    fn more_faces_than_are_handed_over_at_once() {
        let n = FACES_AT_ONCE * 2 + 10;
        let mesh = read(&"f 1 2 3\nf 1 3 4\n".repeat(n / 2)).unwrap();
        assert_eq!((mesh.triangles.len(), mesh.positions.len()), (n, 4));
    }
}

//! Wavefront OBJ.
//!
//! Faces of one or two corners have no area and are skipped, as are normals and texture
//! coordinates. A triangle has the names of its groups (`g`), its object (`o`) and its material
//! (`usemtl`). Material definitions are not read. Free-form surfaces, other files, levels of detail
//! and unknown statements are skipped with a warning, since a misspelt `v` would shift all later
//! indices.
//!
//! OBJ has no end mark, so a file truncated between two lines looks complete. Its missing faces
//! appear as boundary edges in the report.

use super::groups::{Groups, Lists, NONE, Namer};
use super::ignored::Collector;
use super::polygon::{MOST_CORNERS, TOO_MUCH, Triangulator};
use super::text::{self, Lines, quote};
use super::{Mesh, MeshInput};
use crate::error::{Error, Place};
use crate::math::DVec3;

/// Statements of the format, current and superseded (Wavefront, Advanced Visualizer manual,
/// appendix B1).
const STATEMENTS: &str = "v vt vn vp vc f fo l p o g s mg mtllib usemtl usemat maplib usemap \
    cstype deg bmat step curv curv2 surf parm trim hole scrv sp end con bevel c_interp d_interp \
    lod shadow_obj trace_obj ctech stech call csh";

pub fn is_statement(word: &[u8]) -> bool {
    STATEMENTS.split(' ').any(|s| s.as_bytes() == word)
}

pub fn read(source: &MeshInput, ignored: &mut Collector) -> Result<(Mesh, Groups), Error> {
    let mut positions = Vec::new();
    // Corners of all faces in sequence, and the number of corners of each face. A face may precede
    // its vertices, so triangulation follows at the end.
    let mut corners: Vec<u32> = Vec::new();
    let mut arities: Vec<u16> = Vec::new();
    let mut lines = Lines::new(source.bytes);
    let mut words = Vec::new();
    let mut names = GroupNames::new();
    while let Some(line) = statement(&mut lines, &mut words) {
        match words.split_first() {
            Some((&b"v", words)) => positions.push(vertex(source, words, line)?),
            Some(_) if is_face(&words) => {
                face(source, &words[1..], line, positions.len(), &mut corners)?;
                arities.push(words.len() as u16 - 1);
            }
            Some((&(b"g" | b"o" | b"usemtl"), _)) => names.change(&words, arities.len()),
            Some((&(b"f" | b"fo"), corners)) => {
                face(source, corners, line, positions.len(), &mut Vec::new())?;
                ignored.harmless("faces of fewer than three corners");
            }
            Some((word, _)) if text::is_padding(word) => ignored.harmless("NUL bytes"),
            Some((word, _)) => ignore(word, line, ignored),
            None => {}
        }
    }
    if arities.is_empty() {
        let instead = format!("an OBJ with {} vertices and no face", positions.len());
        return Err(source.no_triangles_but(&instead, ignored));
    }
    let mut triangles = Vec::with_capacity(arities.len());
    let mut cutter = Triangulator::default();
    let mut rest = corners.as_slice();
    let mut namer = names.namer;
    let mut changes = names.changes.into_iter().peekable();
    for (k, &arity) in arities.iter().enumerate() {
        while let Some((_, names)) = changes.next_if(|&(face, _)| face <= k) {
            namer.begin(triangles.len(), names);
        }
        let (face, others) = rest.split_at(arity as usize);
        rest = others;
        for &corner in face {
            let number = corner as usize + 1;
            match positions.get(corner as usize) {
                Some(&position) if source.usable(position) => {}
                Some(&position) => {
                    let line = line_of(source, number - 1, |words| words[0] == b"v");
                    let face = line_of(source, k, is_face);
                    let what = format!("vertex {number}, used by the face of line {face},");
                    return Err(source.unusable(Place::Line(line), &what, position));
                }
                None => {
                    return Err(source.error(
                        Place::Line(line_of(source, k, is_face)),
                        format!("a face with vertex {number}"),
                        format!("one of the file's {} vertices", positions.len()),
                    ));
                }
            }
        }
        if !cutter.triangulate(&positions, face, &mut triangles) {
            return Err(source.error(Place::File, TOO_MUCH[0], TOO_MUCH[1]));
        }
    }
    let mesh = source.mesh(&positions, &triangles)?;
    Ok((mesh, namer.finish(triangles.len())))
}

/// Lists a skipped statement. Appearance and settings of free-form geometry are not listed.
fn ignore(word: &[u8], line: usize, ignored: &mut Collector) {
    let (changes_shape, what) = match word {
        b"surf" => (true, "free-form surfaces"),
        b"call" | b"csh" => (true, "commands and other files"),
        b"lod" => (true, "levels of detail, whose faces are all read"),
        b"curv" | b"curv2" => (false, "free-form curves"),
        b"l" => (false, "lines"),
        b"p" => (false, "points"),
        word if is_statement(word) => return,
        _ => (true, "an unknown statement"),
    };
    let word = quote(word);
    ignored.add(&word, changes_shape, |word| {
        format!("{what}: {word}, first on line {line}")
    });
}

/// Names of the following faces.
struct GroupNames {
    namer: Namer,
    /// Groups, object and material.
    now: Lists,
    /// First face and names of each run.
    changes: Vec<(usize, Lists)>,
}

impl GroupNames {
    fn new() -> GroupNames {
        GroupNames {
            namer: Namer::default(),
            now: [NONE; 3],
            changes: Vec::new(),
        }
    }

    /// Applies a naming statement that precedes the face of this index.
    fn change(&mut self, words: &[&[u8]], face: usize) {
        let text = |word: &[u8]| String::from_utf8_lossy(word).into_owned();
        let (at, names) = match (words[0], &words[1..]) {
            (b"g", names) => (0, names.iter().map(|word| text(word)).collect()),
            (_, []) => (usize::from(words[0] != b"o") + 1, Vec::new()),
            (word, names) => (
                usize::from(word != b"o") + 1,
                vec![text(&names.join(&b' '))],
            ),
        };
        self.now[at] = self.namer.list(names);
        // No face followed the previous statement.
        let _ = self.changes.pop_if(|(first, _)| *first == face);
        self.changes.push((face, self.now));
    }
}

/// True if the statement is a face with an area.
fn is_face(words: &[&[u8]]) -> bool {
    matches!(words[0], b"f" | b"fo") && words.len() > 3
}

/// Returns the line of the statement of this kind that follows `nth` others. The file is read
/// again, since only errors need this.
fn line_of(source: &MeshInput, nth: usize, kind: fn(&[&[u8]]) -> bool) -> usize {
    let mut lines = Lines::new(source.bytes);
    let mut words = Vec::new();
    std::iter::from_fn(|| {
        let line = statement(&mut lines, &mut words)?;
        Some((line, !words.is_empty() && kind(&words)))
    })
    .filter_map(|(line, of_kind)| of_kind.then_some(line))
    .nth(nth)
    .expect("it was read before")
}

/// Reads the words of the next statement, none for an empty line. Returns its line number, `None`
/// at the end.
fn statement<'a>(lines: &mut Lines<'a>, words: &mut Vec<&'a [u8]>) -> Option<usize> {
    words.clear();
    let mut line = lines.next()?;
    let number = lines.number;
    words.extend(text::words(line));
    // A backslash joins the next line, with two exceptions. At the end of a comment it is probably
    // part of a Windows path; before a statement it is part of a name.
    while line.trim_ascii_end().ends_with(b"\\")
        && let Some(last) = words.pop_if(|w| w.ends_with(b"\\"))
    {
        words.extend(last.strip_suffix(b"\\").filter(|w| !w.is_empty()));
        let next = lines.clone().next().unwrap_or_default();
        if text::words(next).next().is_some_and(is_statement) {
            break;
        }
        line = lines.next().unwrap_or_default();
        words.extend(text::words(line));
    }
    Some(number)
}

/// Parses `x y z`, optionally followed by a weight of 1 or a colour.
fn vertex(source: &MeshInput, words: &[&[u8]], line: usize) -> Result<DVec3, Error> {
    let error = |found: String, expected| source.error(Place::Line(line), found, expected);
    let number = |word: &[u8]| text::number(word).map_err(|f| error(f, text::NUMBER));
    let (x, y, z, more) = match words {
        [x, y, z, more @ ..] if more.len() != 2 => (x, y, z, more),
        _ => {
            let found = format!("a vertex of {} numbers", words.len());
            return Err(error(found, "x y z"));
        }
    };
    if let [w] = more
        && number(w)? != 1.0
    {
        // The format defines the weight for curves only; some readers divide by it.
        let found = format!("a vertex of weight {}", quote(w));
        return Err(error(found, "no weight, or 1"));
    }
    Ok(DVec3::new(number(x)?, number(y)?, number(z)?))
}

/// Parses a face with corners `v`, `v/vt`, `v//vn` or `v/vt/vn`. Indices count from 1, or backwards
/// from −1.
fn face(
    source: &MeshInput,
    words: &[&[u8]],
    line: usize,
    vertices: usize,
    corners: &mut Vec<u32>,
) -> Result<(), Error> {
    let place = Place::Line(line);
    if words.len() > MOST_CORNERS {
        let found = format!("a face of {} corners", words.len());
        return Err(source.error(place, found, format!("at most {MOST_CORNERS}")));
    }
    for word in words {
        let first = word.split(|&b| b == b'/').next().unwrap_or_default();
        let index = std::str::from_utf8(first).ok();
        let corner = match index.and_then(|i| i.parse::<i64>().ok()) {
            Some(i) if i > 0 => u32::try_from(i - 1).ok(),
            Some(i) if i < 0 => u32::try_from(vertices as i64 + i).ok(),
            _ => None,
        };
        let Some(corner) = corner else {
            let found = format!("a face with vertex {}", quote(word));
            let range = match vertices {
                0 => "a vertex to come before it".into(),
                n => format!("1 to {n} or -1 to -{n}"),
            };
            return Err(source.error(place, found, range));
        };
        corners.push(corner);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{parse, parse_whole};
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
        // Faces before the vertices they reference.
        let early = format!("f 1 2 3\nf 1 3 4\n{SQUARE}");
        assert_eq!(parse(Path::new("a"), early.as_bytes(), 1.0).unwrap(), plain);
        let fortran = format!("f 1 2 3\nf 1 3 4\n{}", SQUARE.replace("1 ", "1.0D0 "));
        assert_eq!(
            parse(Path::new("a"), fortran.as_bytes(), 1.0).unwrap(),
            plain
        );
    }

    /// Tests unknown statements at each line: the faces are unchanged, and each statement is
    /// listed.
    #[test]
    fn unknown_statements_are_listed() {
        let text = format!("{SQUARE}f 1 2 3\nf 1 3 4\n");
        let plain = parse(Path::new("a.obj"), text.as_bytes(), 1.0).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        for at in 0..=lines.len() {
            for (line, name, changes_shape) in [
                ("Exported by Foo 1.2", "\"Exported\"", true),
                ("; comment", "\";\"", true),
                ("newmtl steel", "\"newmtl\"", true),
                ("vcolor 1 1 1", "\"vcolor\"", true),
                ("call other.obj", "other files: \"call\"", true),
                ("surf 0 1 0 1 1 2 3 4", "free-form surfaces: \"surf\"", true),
                ("lod 1", "levels of detail", true),
                ("l 1 2", "lines: \"l\"", false),
                ("f", "faces of fewer than three corners", false),
                ("g a\\", "", false),
                ("bevel off", "", false),
            ] {
                let mut lines = lines.clone();
                lines.insert(at, line);
                let text = lines.join("\n");
                let contents = parse_whole(Path::new("a.obj"), text.as_bytes(), 1.0);
                let contents = contents.unwrap_or_else(|error| panic!("{error}: {text}"));
                assert_eq!(contents.mesh, plain, "{text}");
                let names: Vec<_> = (contents.ignored.iter())
                    .map(|i| (i.name.as_str(), i.changes_shape))
                    .collect();
                match name {
                    "" => assert_eq!(names, []),
                    name => {
                        assert_eq!(names.len(), 1, "{names:?}");
                        assert!(names[0].0.contains(name) && names[0].1 == changes_shape);
                    }
                }
            }
        }
        assert!(
            read("f 1,2,3\nf 1 2 3")
                .unwrap_err()
                .contains("a.obj:5: found a face with vertex")
        );
    }

    /// Tests groups, objects and materials of triangles and of triangulated polygons.
    #[test]
    fn faces_keep_their_names() {
        let faces = "f 1 2 3\ng\nusemtl brushed steel\no lid\nf 1 2 3 4\ng top side\nf 1 2\nf 1 3 4\nusemtl\n\
             usemtl paint\nf 1 2 4\n";
        let text = format!("{SQUARE}{faces}");
        let read = parse_whole(Path::new("a.obj"), text.as_bytes(), 1.0).unwrap();
        let (mesh, groups) = (read.mesh, read.groups);
        assert_eq!(mesh.triangles.len(), 5);
        for (name, expected) in [
            ("brushed steel", [0, 1, 1, 1, 0]),
            ("lid", [0, 1, 1, 1, 1]),
            ("top", [0, 0, 0, 1, 1]),
            ("side", [0, 0, 0, 1, 1]),
            ("paint", [0, 0, 0, 0, 1]),
        ] {
            let found = groups.numbers(5, &[(name, 1)].into());
            assert_eq!(found, Ok(expected.to_vec()), "{name}");
        }
        assert_eq!(groups.names().len(), 5);
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
            ("v 1 2", "a.obj:5: found a vertex of 2 numbers"),
            ("v 1 2 3 4 5", "a.obj:5: found a vertex of 5 numbers"),
            ("v 1 2 3 0.5", "weight"),
            ("v 1,5 2 3", "comma"),
            (
                "v inf 2 3\n\nf 1 2 5",
                "a.obj:5: found vertex 5, used by the face of line 7, at (inf, 2, 3)",
            ),
            (
                "f 1 2 5\nv inf 2 3",
                "a.obj:6: found vertex 5, used by the face of line 5, at (inf, 2, 3)",
            ),
            (
                "f 1 \\\n2 3\nf 1 2\nf 1 2 3 4 6\nv 1 2 3",
                "a.obj:8: found a face with vertex 6, expected one of the file's 5",
            ),
            (
                "l 1 2 3",
                "no triangles (an OBJ with 4 vertices and no face)",
            ),
            (
                "surf 0 1 0 1 1 2 3 4",
                "no face; not read: free-form surfaces: \"surf\", first on line 5)",
            ),
        ] {
            let error = read(faces).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
        let many = "f".to_string() + &" 1 2 3".repeat(MOST_CORNERS);
        assert!(read(&many).unwrap_err().contains("corners"));
    }
}

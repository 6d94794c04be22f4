//! Triangle meshes: read from STL, OBJ, PLY, glTF and 3MF files, checked, or made from
//! analytic shapes.
//!
//! Every mesh comes out of one weld: corners whose coordinates are the same
//! numbers (−0 = +0) become one vertex, vertices stand in the order in which
//! the triangles first use them, and vertices no triangle uses are dropped.
//! The indexed formats are welded too, because their writers split vertices
//! where normals or texture coordinates jump, and the rays and the edge report
//! are about the surface, not about shading. Nothing is welded by tolerance:
//! that would hide the cracks the report exists to show.

use std::io::Read;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use crate::error::input_file;
use crate::error::{Error, InputError, Place};
use crate::math::{Aabb, DVec3};
use ignored::Collector;

pub mod check;
mod control_groups;
mod gltf;
mod groups;
mod ignored;
pub mod memory;
mod obj;
mod ply;
mod polygon;
pub mod shapes;
mod shell;
mod sniff;
mod stars;
mod stl;
mod text;
mod three_mf;
mod weld;

pub use check::{MeshReport, Orientation, has_area, report};
pub use groups::Groups;
pub use ignored::Ignored;
pub use shell::Shell;

/// Largest coordinate taken (mm), a million kilometres. It keeps areas and
/// volumes finite, and a flipped exponent bit from passing as a part.
pub const LARGEST_MM: f64 = 1e12;

/// Hears how far slow work on a mesh is, from 0 to 1 and from any thread; its error
/// ends the work.
pub type Watch<'a> = dyn Fn(f64) -> Result<(), Error> + Sync + 'a;

/// Triangles over shared vertices. Positions are in millimetres in the part's
/// own frame; every index is below `positions.len()`, every position is
/// finite, and there is at least one triangle.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    /// Vertices, mm.
    pub positions: Vec<DVec3>,
    /// Three indices into `positions`, in the file's order: counter-clockwise seen from outside
    /// where the file keeps that convention.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// A mesh from vertices (mm) and triangles of three of them each; both keep their numbers,
    /// and nothing is welded. A vertex that no triangle uses is put where the first triangle
    /// begins, so that it does not widen the box. Triangles may be without area.
    ///
    /// # Errors
    /// `Error::Usage`, with the number of the vertex or triangle, for a vertex that is not
    /// finite or beyond 10¹² mm and for an index without a vertex; for no triangle, or
    /// 2³² − 1 and more.
    pub fn from_triangles(
        vertices: impl IntoIterator<Item = DVec3>,
        triangles: impl IntoIterator<Item = [u32; 3]>,
    ) -> Result<Mesh, Error> {
        let mut positions: Vec<DVec3> = vertices.into_iter().collect();
        let triangles: Vec<[u32; 3]> = triangles.into_iter().collect();
        let usable = |p: &DVec3| !p.is_nan() && p.abs().max_element() <= LARGEST_MM;
        if let Some(wrong) = positions.iter().position(|p| !usable(p)) {
            return Err(Error::Usage(format!(
                "vertex {wrong} is {:?}, expected finite coordinates within 1e12 mm",
                positions[wrong].to_array()
            )));
        }
        let mut used = vec![false; positions.len()];
        for (i, triangle) in triangles.iter().enumerate() {
            for &vertex in triangle {
                let Some(used) = used.get_mut(vertex as usize) else {
                    return Err(Error::Usage(format!(
                        "triangle {i} uses vertex {vertex}, expected a number below {}, that of \
                         the vertices",
                        positions.len()
                    )));
                };
                *used = true;
            }
        }
        if triangles.is_empty() || triangles.len() >= u32::MAX as usize {
            return Err(Error::Usage(format!(
                "{} triangles, expected 1 to 4294967294",
                triangles.len()
            )));
        }
        let first = positions[triangles[0][0] as usize];
        for (position, used) in positions.iter_mut().zip(used) {
            if !used {
                *position = first;
            }
        }
        Ok(Mesh {
            positions,
            triangles,
        })
    }

    /// Smallest box around all vertices (mm).
    pub fn bounds(&self) -> Aabb {
        Aabb::of(self.positions.iter().copied())
    }

    /// Corners of triangle `i` (mm), in the file's order.
    pub fn triangle(&self, i: usize) -> [DVec3; 3] {
        // Not `map`, which the compiler leaves a call in the hot loop.
        let [a, b, c] = self.triangles[i];
        let at = |v: u32| self.positions[v as usize];
        [at(a), at(b), at(c)]
    }

    /// Welds triangles over `corners` (millimetres, finite); a triangle is
    /// three indices into it.
    fn welded(corners: &[DVec3], triangles: &[[u32; 3]]) -> Mesh {
        let welded = weld::triangles(triangles.len(), |t| {
            triangles[t].map(|v| weld::bits(corners[v as usize]))
        });
        Mesh {
            positions: welded
                .keys
                .iter()
                .map(|key| DVec3::from_array(key.map(f64::from_bits)))
                .collect(),
            triangles: welded.triangles,
        }
    }
}

/// Reads an STL (binary or ASCII), OBJ, PLY (ASCII, either byte order), glTF 2.0 (JSON or
/// binary) or 3MF file whose unit of length is `unit_mm` millimetres. The format is told
/// from the content; the extension is not looked at. `None`, where the file says its unit
/// (see [`unit_by`]): that is taken.
///
/// Of glTF and 3MF all that the file's scene or build shows is one mesh, each part where it is placed.
///
/// # Errors
/// `Error::Io` when the file cannot be read; `Error::Input`, with the line or
/// byte, for whatever is not a whole mesh: another kind of file, cut off, a
/// count or an index that does not fit, a vertex that is not a number or lies
/// beyond 10¹² mm, no triangle at all; no unit, or one that a 3MF file contradicts.
///
/// `Error::Memory` for a file that would not fit the machine's. It takes 2 times the
/// file for usual STL and at most 6 times, 30 times for OBJ and PLY (their shortest
/// statements are a few bytes long; usual files need 2 to 5). glTF and 3MF place the
/// same shape as often as they like, and 3MF is compressed: what is needed is asked for
/// before it is taken.
///
/// # Panics
/// If `unit_mm` is not a positive number: the scene has checked it.
pub fn load(path: &Path, unit_mm: impl Into<Option<f64>>) -> Result<Mesh, Error> {
    parse(path, &read(path, &|_| Ok(()))?, unit_mm)
}

/// The bytes of a mesh file. Errors: as `load`'s, for what is not a regular file,
/// would not fit or cannot be read; `watch`'s.
pub fn read(path: &Path, watch: &Watch) -> Result<Vec<u8>, Error> {
    read_within(path, memory::available(), watch)
}

/// `read` with so many bytes of memory, if that is known.
fn read_within(path: &Path, available: Option<u64>, watch: &Watch) -> Result<Vec<u8>, Error> {
    const PIECE: usize = 1 << 24;
    let (file, kind) = input_file::open(path, sniff::EXPECTED)?;
    let mut head = Vec::new();
    let read = (&file).take(84).read_to_end(&mut head);
    read.map_err(Error::io("read", path))?;
    memory::require_for_file(path, &head, kind.len(), available)?;
    let mut bytes = vec![0; kind.len() as usize];
    let done = AtomicU64::new(0);
    (bytes.par_chunks_mut(PIECE).enumerate()).try_for_each(|(i, piece)| {
        let read = file.read_exact_at(piece, (i * PIECE) as u64);
        read.map_err(Error::io("read", path))?;
        let piece = piece.len() as u64;
        watch((done.fetch_add(piece, Relaxed) + piece) as f64 / kind.len() as f64)
    })?;
    Ok(bytes)
}

/// The files that a mesh file needs in its folder or below it, relative to the folder: the buffers of glTF.
#[doc(hidden)]
pub fn files_needed(path: &Path, bytes: &[u8]) -> Result<Vec<PathBuf>, Error> {
    Ok(match sniff::format(path, bytes)? {
        sniff::Format::Gltf => gltf::buffer_files(bytes),
        _ => Vec::new(),
    })
}

/// `load` for bytes already in memory; `path` names them in errors, and a glTF file's buffers are
/// beside it.
pub fn parse(path: &Path, bytes: &[u8], unit_mm: impl Into<Option<f64>>) -> Result<Mesh, Error> {
    parse_whole(path, bytes, unit_mm).map(|contents| contents.mesh)
}

/// The contents of a mesh file.
#[doc(hidden)]
#[derive(Debug, Clone, PartialEq)]
pub struct Contents {
    pub mesh: Mesh,
    /// Names that OBJ, PLY and glTF give to triangles.
    pub groups: Groups,
    /// Content that was not used, such that changes the shape first.
    pub ignored: Vec<Ignored>,
}

/// Parses a mesh with the names of its triangles and a list of what was not used.
#[doc(hidden)]
pub fn parse_whole(
    path: &Path,
    bytes: &[u8],
    unit_mm: impl Into<Option<f64>>,
) -> Result<Contents, Error> {
    let unit_mm = unit_mm.into();
    assert!(
        unit_mm.is_none_or(|unit| unit.is_finite() && unit > 0.0),
        "unit of {unit_mm:?} mm reached the mesh reader"
    );
    let format = sniff::format(path, bytes)?;
    let usual = (format == sniff::Format::Gltf).then_some(gltf::METRE);
    let source = Source {
        path,
        bytes,
        unit_mm: unit_mm.or(usual).unwrap_or(1.0),
    };
    let nameless = |mesh: Mesh| (mesh, Groups::default());
    let mut ignored = Collector::default();
    let (mesh, groups) = match format {
        sniff::Format::ThreeMf => three_mf::read(&source, unit_mm, &mut ignored).map(nameless),
        sniff::Format::Gltf => gltf::read(&source, &mut ignored),
        _ if unit_mm.is_none() => {
            let found = "coordinates without a unit";
            Err(source.error(Place::File, found, "a unit beside the file's name"))
        }
        sniff::Format::BinaryStl => stl::binary(&source, &mut ignored).map(nameless),
        sniff::Format::AsciiStl => stl::ascii(&source, &mut ignored).map(nameless),
        sniff::Format::Ply => ply::read(&source, &mut ignored),
        sniff::Format::Obj => obj::read(&source, &mut ignored),
    }?;
    Ok(Contents {
        mesh,
        groups,
        ignored: ignored.finish(),
    })
}

/// Who says the unit of a file's coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnitBy {
    /// Nobody: it must be said beside the file's name.
    User,
    /// The format, glTF: metres, though programs are known that write others.
    Metres,
    /// The file itself, 3MF.
    File,
}

/// Who says the unit of a mesh file's coordinates.
///
/// # Errors
/// `Error::Input` for what is no mesh.
pub fn unit_by(path: &Path, bytes: &[u8]) -> Result<UnitBy, Error> {
    Ok(match sniff::format(path, bytes)? {
        sniff::Format::Gltf => UnitBy::Metres,
        sniff::Format::ThreeMf => UnitBy::File,
        _ => UnitBy::User,
    })
}

/// A mesh file in memory.
#[derive(Clone, Copy)]
struct Source<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    unit_mm: f64,
}

impl Source<'_> {
    fn error(&self, place: Place, found: impl Into<String>, expected: impl Into<String>) -> Error {
        InputError::new(self.path, place, found, expected).into()
    }

    /// Whether a position, in the file's unit, can be part of a mesh.
    fn usable(&self, position: DVec3) -> bool {
        // Written so that NaN fails.
        (position * self.unit_mm).abs().max_element() <= LARGEST_MM && !position.is_nan()
    }

    fn unusable(&self, place: Place, what: &str, p: DVec3) -> Error {
        self.error(
            place,
            format!("{what} at ({}, {}, {})", p.x, p.y, p.z),
            "finite coordinates within 1e12 mm",
        )
    }

    /// The mesh of indexed positions in the file's unit, all already found
    /// usable where a triangle uses them.
    fn mesh(&self, positions: &[DVec3], triangles: &[[u32; 3]]) -> Result<Mesh, Error> {
        if triangles.is_empty() {
            return Err(self.no_triangles(&format!("{} vertices", positions.len())));
        }
        let mut mesh = Mesh::welded(positions, triangles);
        for position in &mut mesh.positions {
            *position *= self.unit_mm;
        }
        Ok(mesh)
    }

    /// The error of a file without triangles, which names the shapes in it that are not read.
    fn no_triangles_but(&self, instead: &str, ignored: &Collector) -> Error {
        let shapes: String = ignored
            .shapes()
            .map(|shape| format!("; not read: {shape}"))
            .collect();
        self.no_triangles(&format!("{instead}{shapes}"))
    }

    fn no_triangles(&self, instead: &str) -> Error {
        self.error(
            Place::File,
            format!("no triangles ({instead})"),
            "a mesh of at least one triangle",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse_text(text: &str, unit_mm: f64) -> Result<Mesh, Error> {
        parse(Path::new("part"), text.as_bytes(), unit_mm)
    }

    #[test]
    fn vertices_are_scaled_welded_and_in_order_of_first_use() {
        // Vertex 1 is unused, 5 is 2 again with a minus zero.
        let mesh = parse_text(
            "v 9 9 9\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 1 -0 0\nf 4 3 2\nf 5 3 4\n",
            25.4,
        )
        .unwrap();
        assert_eq!(
            mesh.positions,
            [DVec3::Z * 25.4, DVec3::Y * 25.4, DVec3::X * 25.4]
        );
        assert_eq!(mesh.triangles, [[0, 1, 2], [2, 1, 0]]);
        assert_eq!(mesh.triangle(1)[0], DVec3::X * 25.4);
        assert_eq!(mesh.bounds(), Aabb::new(DVec3::ZERO, DVec3::splat(25.4)));
    }

    #[test]
    fn coordinates_are_judged_in_millimetres() {
        let far = "v 1e10 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n";
        assert!(parse_text(far, 1.0).is_ok());
        let error = parse_text(far, 1000.0).unwrap_err().to_string();
        assert!(error.contains("1e12 mm"), "{error}");
    }

    #[test]
    fn a_folder_is_not_read() {
        let error = load(Path::new(env!("CARGO_MANIFEST_DIR")), 1.0).unwrap_err();
        assert!(error.to_string().contains("found a folder"), "{error}");
        assert_eq!(error.exit_code(), 65);
        let error = load(Path::new("no such mesh.stl"), 1.0).unwrap_err();
        assert_eq!(error.exit_code(), 74);
    }
}

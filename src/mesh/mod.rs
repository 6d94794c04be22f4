//! Triangle meshes: read from STL, OBJ, PLY, glTF and 3MF files, checked, or generated from
//! analytic shapes.
//!
//! Every mesh is welded in one way. Corners with equal coordinates (−0 = +0) become one vertex.
//! Vertices are in the order in which the triangles first use them, and unused vertices are
//! dropped.
//!
//! The indexed formats are welded too, because their writers split vertices at discontinuities of
//! normals or texture coordinates. Ray tracing and the edge report need the surface, not its
//! shading. No tolerance is applied, since it would hide the cracks that the report must show.

use std::io::Read;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use crate::error::input_file;
use crate::error::{Error, InputError, Place};
use crate::math::{Aabb, DVec3, Rigid};
use ignored::Collector;

pub mod check;
mod control_groups;
pub mod deform;
pub mod face;
mod format_detection;
mod gltf;
mod groups;
mod ignored;
pub mod memory;
mod obj;
mod ply;
mod polygon;
mod pseudonormals;
pub mod shapes;
mod stl;
mod text;
mod three_mf;
mod vertex_edges;
mod weld;

pub use check::{MeshReport, Orientation, has_area, report};
pub use groups::Groups;
pub use ignored::Ignored;
pub use pseudonormals::Pseudonormals;

/// Largest accepted coordinate (mm), a million kilometres. It keeps areas and volumes finite, and
/// rejects coordinates with a flipped exponent bit.
pub const MAX_COORDINATE_MM: f64 = 1e12;

/// Progress callback of slow work on a mesh. It receives the progress from 0 to 1, from any thread;
/// returning an error stops the work.
pub type ProgressFn<'a> = dyn Fn(f64) -> Result<(), Error> + Sync + 'a;

/// Triangles over shared vertices.
///
/// Positions are in millimetres in the frame of the part. Every index is below `positions.len()`,
/// every position is finite, and there is at least one triangle.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    /// Vertex positions, mm.
    pub positions: Vec<DVec3>,
    /// Three indices into `positions`, in file order: counter-clockwise as viewed from outside if
    /// the file follows that convention.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Creates a mesh from vertices (mm) and triangles of three vertex indices each.
    ///
    /// Nothing is welded, and both keep their indices. An unused vertex is moved to the first
    /// corner of the first triangle, so that it does not extend the bounding box. Triangles may
    /// have zero area.
    ///
    /// # Errors
    /// Returns `Error::Usage`, with the index of the vertex or triangle, in these cases:
    ///
    /// * a vertex is not finite or beyond 10¹² mm;
    /// * an index refers to no vertex;
    /// * there is no triangle, or there are 2³² − 1 or more.
    pub fn from_triangles(
        vertices: impl IntoIterator<Item = DVec3>,
        triangles: impl IntoIterator<Item = [u32; 3]>,
    ) -> Result<Mesh, Error> {
        let mut positions: Vec<DVec3> = vertices.into_iter().collect();
        let triangles: Vec<[u32; 3]> = triangles.into_iter().collect();
        check_positions(&positions)?;
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

    /// Appends the triangles of a mesh at a pose.
    pub(crate) fn append(&mut self, other: &Mesh, pose: &Rigid) {
        let first = self.positions.len() as u32;
        let moved = other.positions.iter().map(|&p| pose.point(p));
        self.positions.extend(moved);
        let triangles = other.triangles.iter().map(|t| t.map(|i| i + first));
        self.triangles.extend(triangles);
    }

    /// Returns the smallest box around all vertices (mm).
    pub fn bounds(&self) -> Aabb {
        Aabb::of(self.positions.iter().copied())
    }

    /// Returns the corners of triangle `i` (mm), in file order.
    pub fn triangle(&self, i: usize) -> [DVec3; 3] {
        // Not `map`: the compiler does not inline it in the hot loop.
        let [a, b, c] = self.triangles[i];
        let at = |v: u32| self.positions[v as usize];
        [at(a), at(b), at(c)]
    }

    /// Welds triangles over `corners` (mm, finite); a triangle is three indices into `corners`.
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

/// Checks that vertices have finite coordinates within [`MAX_COORDINATE_MM`].
///
/// # Errors
/// Returns `Error::Usage` with the index of the first vertex that has not.
pub(crate) fn check_positions(positions: &[DVec3]) -> Result<(), Error> {
    let usable = |p: &DVec3| !p.is_nan() && p.abs().max_element() <= MAX_COORDINATE_MM;
    match positions.iter().position(|p| !usable(p)) {
        None => Ok(()),
        Some(wrong) => Err(Error::Usage(format!(
            "vertex {wrong} is {:?}, expected finite coordinates within 1e12 mm",
            positions[wrong].to_array()
        ))),
    }
}

/// Reads an STL (binary or ASCII), OBJ, PLY (ASCII, either byte order), glTF 2.0 (JSON or binary)
/// or 3MF file whose unit of length is `unit_mm` millimetres.
///
/// The format is detected from the content; the file extension is ignored. `None` selects the unit
/// that the file or format states (see [`unit_by`]).
///
/// The scene of a glTF file, or the build of a 3MF file, becomes one mesh, with each part at its
/// pose.
///
/// # Errors
/// Returns `Error::Io` if the file cannot be read. Returns `Error::Input`, with the line or byte,
/// if the content is not a complete mesh:
///
/// * a different kind of file, or a truncated file;
/// * an inconsistent count or index;
/// * a vertex that is not a number or lies beyond 10¹² mm;
/// * no triangle;
/// * no unit, or a unit that a 3MF file contradicts.
///
/// Returns `Error::Memory` if the file would not fit in memory. Usual STL files need twice the file
/// size, and at most 6 times. OBJ and PLY need up to 30 times, because their shortest statements
/// have a few bytes; usual files need 2 to 5 times. glTF and 3MF can instance a shape any number of
/// times, and 3MF is compressed. Their memory is therefore estimated before allocation.
///
/// # Panics
/// Panics if `unit_mm` is not a positive number; the scene has checked it.
pub fn load(path: &Path, unit_mm: impl Into<Option<f64>>) -> Result<Mesh, Error> {
    parse(path, &read(path, &|_| Ok(()))?, unit_mm)
}

/// Returns the bytes of a mesh file.
///
/// # Errors
/// Returns the errors of `load` for a file that is not regular, does not fit in memory or cannot be
/// read, and the errors of `watch`.
pub fn read(path: &Path, watch: &ProgressFn) -> Result<Vec<u8>, Error> {
    read_within(path, memory::available(), watch)
}

/// Reads a file as `read` does, with `available` bytes of memory if known.
fn read_within(path: &Path, available: Option<u64>, watch: &ProgressFn) -> Result<Vec<u8>, Error> {
    const PIECE: usize = 1 << 24;
    let (file, kind) = input_file::open(path, format_detection::EXPECTED)?;
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

/// Returns the additional files that a mesh file needs, relative to its folder: the buffers of
/// glTF.
#[doc(hidden)]
pub fn files_needed(path: &Path, bytes: &[u8]) -> Result<Vec<PathBuf>, Error> {
    Ok(match format_detection::format(path, bytes)? {
        format_detection::MeshFormat::Gltf => gltf::buffer_files(bytes),
        _ => Vec::new(),
    })
}

/// Parses a mesh as `load` does, from bytes in memory. `path` names the file in errors; the buffers
/// of a glTF file are relative to its folder.
pub fn parse(path: &Path, bytes: &[u8], unit_mm: impl Into<Option<f64>>) -> Result<Mesh, Error> {
    parse_whole(path, bytes, unit_mm).map(|contents| contents.mesh)
}

/// Contents of a mesh file.
#[doc(hidden)]
#[derive(Debug, Clone, PartialEq)]
pub struct Contents {
    pub mesh: Mesh,
    /// Names that OBJ, PLY and glTF assign to triangles.
    pub groups: Groups,
    /// Unused content; content that changes the shape comes first.
    pub ignored: Vec<Ignored>,
}

/// Parses a mesh with the names of its triangles and a list of unused content.
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
    let format = format_detection::format(path, bytes)?;
    let usual = (format == format_detection::MeshFormat::Gltf).then_some(gltf::METRE);
    let source = MeshInput {
        path,
        bytes,
        unit_mm: unit_mm.or(usual).unwrap_or(1.0),
    };
    let nameless = |mesh: Mesh| (mesh, Groups::default());
    let mut ignored = Collector::default();
    let (mesh, groups) = match format {
        format_detection::MeshFormat::ThreeMf => {
            three_mf::read(&source, unit_mm, &mut ignored).map(nameless)
        }
        format_detection::MeshFormat::Gltf => gltf::read(&source, &mut ignored),
        _ if unit_mm.is_none() => {
            let found = "coordinates without a unit";
            Err(source.error(Place::File, found, "a unit beside the file's name"))
        }
        format_detection::MeshFormat::BinaryStl => stl::binary(&source, &mut ignored).map(nameless),
        format_detection::MeshFormat::AsciiStl => stl::ascii(&source, &mut ignored).map(nameless),
        format_detection::MeshFormat::Ply => ply::read(&source, &mut ignored),
        format_detection::MeshFormat::Obj => obj::read(&source, &mut ignored),
    }?;
    Ok(Contents {
        mesh,
        groups,
        ignored: ignored.finish(),
    })
}

/// Source of the unit of the coordinates of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnitSource {
    /// User: the file format has no unit, so it must be given with the file name.
    User,
    /// Format (glTF): metres, although some programs write other units.
    Metres,
    /// File itself (3MF).
    File,
}

/// Returns the source of the unit of the coordinates of a mesh file.
///
/// # Errors
/// Returns `Error::Input` if the content is not a mesh.
pub fn unit_by(path: &Path, bytes: &[u8]) -> Result<UnitSource, Error> {
    Ok(match format_detection::format(path, bytes)? {
        format_detection::MeshFormat::Gltf => UnitSource::Metres,
        format_detection::MeshFormat::ThreeMf => UnitSource::File,
        _ => UnitSource::User,
    })
}

/// Reads the points of a PLY file in memory, in the unit of the file. `path` is only used in errors.
pub(crate) fn points_of_ply(path: &Path, bytes: &[u8]) -> Result<Vec<DVec3>, Error> {
    ply::read_points(&MeshInput {
        path,
        bytes,
        unit_mm: 1.0,
    })
}

/// Mesh file in memory.
#[derive(Clone, Copy)]
struct MeshInput<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    unit_mm: f64,
}

impl MeshInput<'_> {
    fn error(&self, place: Place, found: impl Into<String>, expected: impl Into<String>) -> Error {
        InputError::new(self.path, place, found, expected).into()
    }

    /// True if a position, in the unit of the file, is valid for a mesh.
    fn usable(&self, position: DVec3) -> bool {
        // Written so that NaN fails.
        (position * self.unit_mm).abs().max_element() <= MAX_COORDINATE_MM && !position.is_nan()
    }

    fn unusable(&self, place: Place, what: &str, p: DVec3) -> Error {
        self.error(
            place,
            format!("{what} at ({}, {}, {})", p.x, p.y, p.z),
            "finite coordinates within 1e12 mm",
        )
    }

    /// Creates the mesh from indexed positions in the unit of the file. The caller has checked that
    /// all positions used by triangles are valid.
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

    /// Creates the error for a file without triangles. It names the unsupported shapes in the file.
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
        // Vertex 1 is unused; vertex 5 equals vertex 2 except for a minus zero.
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

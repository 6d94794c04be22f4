//! Intersection of the rays in a file with a mesh.

use super::output_folder::{Names, OutputFolder};
use super::{RunControl, files, memory_estimate};
use crate::accel::{Accel, Backend, Ray, SurfacePoint};
use crate::error::{Error, InputError, Place, Result};
use crate::error::{input_file, printable};
use crate::math::DVec3;
use crate::mesh::Mesh;
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Memory per ray, bytes: its six numbers, the ray, and its hit.
const RAY: u64 = 6 * 8 + 64 + 56;
/// Minimum number of characters per ray in the file: `[0,0,0,0,0,0],`.
const MIN_BYTES_PER_RAY: u64 = 14;

/// File of rays: origin and direction of each, mm, in the mesh's frame.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RaysFile {
    rays: Vec<[f64; 6]>,
}

/// Summary of the rays and path of the hits.
#[derive(Debug, Serialize)]
pub struct RaysSummary {
    /// Number of rays.
    pub rays: usize,
    /// Number of rays that hit the mesh.
    pub hits: usize,
    /// Number of triangles of the mesh.
    pub triangles: usize,
    /// Intersection library and its version.
    pub accel: String,
    /// Path of the hits, in the order of the rays.
    #[serde(serialize_with = "printable::in_json")]
    pub file: PathBuf,
}

/// A hit in the output file.
#[derive(Serialize)]
struct HitEntry {
    distance: f64,
    point_mm: [f64; 3],
    triangle: u32,
    barycentric: [f64; 2],
}

/// Intersects the rays of a JSON file with a mesh and writes `hits.json` to `out`. The file is
/// `{"rays": [[x, y, z, dx, dy, dz], …]}` in mm, and `unit_mm` is the unit of the mesh.
///
/// The entry of a ray without a hit is `null`. Other entries contain `distance` in lengths of the
/// direction, `point_mm`, `triangle` (index in the mesh file) and `barycentric`, as in
/// [`SurfacePoint`].
///
/// # Errors
/// A file that cannot be read or is invalid; invalid rays; too little memory.
pub fn cast_rays<'a>(
    mesh: &Path,
    unit_mm: Option<f64>,
    rays: &Path,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<RaysSummary> {
    let expected = "{\"rays\": [[x, y, z, dx, dy, dz], …]}, numbers in mm";
    let (_, kind) = input_file::open(rays, expected)?;
    let count = kind.len() / MIN_BYTES_PER_RAY;
    memory_estimate::require_rays(count, RAY)?;
    let bytes = input_file::read(rays, kind.len(), expected)?;
    let file: RaysFile = files::parse_json(rays, &bytes, expected)?;
    drop(bytes);
    let inputs = [mesh.to_owned(), rays.to_owned()];
    let out = out.into().claim(&inputs, &Names::of(["hits.json"]))?.path;
    let mesh: Mesh = crate::mesh::load(mesh, unit_mm)?;
    control.check()?;
    let triangles = mesh.triangles.len();
    let backend = Backend::default();
    let accel = Accel::build(&mesh.into(), 1)?;
    control.check()?;
    let ray = |i: usize| {
        let [x, y, z, dx, dy, dz] = file.rays[i];
        Ray {
            origin: DVec3::new(x, y, z),
            direction: DVec3::new(dx, dy, dz),
            t_max: f64::INFINITY,
        }
    };
    let mut hits = vec![SurfacePoint::MISS; file.rays.len()];
    accel
        .closest_hits(ray, &mut hits)
        .map_err(|error| match error {
            // The invalid numbers are in the file.
            Error::Usage(message) => {
                let expected = "finite origins, and directions of a length from 1e-100 to 1e100";
                InputError::new(rays, Place::File, message, expected).into()
            }
            other => other,
        })?;
    (control.progress)(hits.len() as u64);
    let path = out.join("hits.json");
    files::write(&path, |file| {
        file.write_all(b"{\"hits\":[")?;
        for (i, hit) in hits.iter().enumerate() {
            file.write_all(if i == 0 { b"\n" } else { b",\n" })?;
            let entry = hit.is_some().then_some(HitEntry {
                distance: hit.distance,
                point_mm: hit.point,
                triangle: hit.triangle,
                barycentric: hit.barycentric,
            });
            serde_json::to_writer(&mut *file, &entry)?;
        }
        file.write_all(b"\n]}\n")
    })?;
    Ok(RaysSummary {
        rays: hits.len(),
        hits: hits.iter().filter(|hit| hit.is_some()).count(),
        triangles,
        accel: backend.version(),
        file: path,
    })
}

//! What rays of a file meet on a mesh.

use super::output_folder::{Names, OutputFolder};
use super::{Control, files, need};
use crate::accel::{Accel, Backend, Ray, SurfacePoint};
use crate::error::{Error, InputError, Place, Result};
use crate::error::{input_file, printable};
use crate::math::DVec3;
use crate::mesh::Mesh;
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Bytes a ray takes: its six numbers as they are read, the ray, and what it meets.
const RAY: u64 = 6 * 8 + 64 + 56;
/// Characters of a ray in the file at least: `[0,0,0,0,0,0],`.
const SHORTEST: u64 = 14;

/// A file of rays: origin and direction of each, mm, in the mesh's frame.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RaysFile {
    rays: Vec<[f64; 6]>,
}

/// What was cast, and where the answers are.
#[derive(Debug, Serialize)]
pub struct RaysSummary {
    /// That were cast.
    pub rays: usize,
    /// That met the mesh.
    pub hits: usize,
    /// Of the mesh.
    pub triangles: usize,
    /// What found the triangles that rays met.
    pub accel: String,
    /// The answers, in the order of the rays.
    #[serde(serialize_with = "printable::in_json")]
    pub file: PathBuf,
}

/// An answer in the file.
#[derive(Serialize)]
struct HitEntry {
    distance: f64,
    point_mm: [f64; 3],
    triangle: u32,
    barycentric: [f64; 2],
}

/// Casts the rays of a JSON file, `{"rays": [[x, y, z, dx, dy, dz], …]}` in mm, against a mesh whose unit is
/// `unit_mm`, and writes `hits.json` to `out`: for each ray `null`, or `distance` in lengths of its
/// direction, `point_mm`, `triangle` (its number in the mesh's file) and `barycentric`, as
/// [`SurfacePoint`] has them.
///
/// # Errors
/// A file that cannot be read or is wrong; rays that are none; what would not fit memory.
pub fn cast_rays<'a>(
    mesh: &Path,
    unit_mm: Option<f64>,
    rays: &Path,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<RaysSummary> {
    let expected = "{\"rays\": [[x, y, z, dx, dy, dz], …]}, numbers in mm";
    let (_, kind) = input_file::open(rays, expected)?;
    let count = kind.len() / SHORTEST;
    need::require_rays(count, RAY)?;
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
    let mut hits = vec![SurfacePoint::NOTHING; file.rays.len()];
    accel
        .closest_hits(ray, &mut hits)
        .map_err(|error| match error {
            // The numbers stand in the file.
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

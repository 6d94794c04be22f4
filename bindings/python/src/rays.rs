//! `RayCaster`: intersections of rays and nearest points on triangle meshes.

use crate::arrays::{Answer, Rows, View, of_points, places, room, shaped, triangles, writable};
use crate::scene::go_on;
use crate::{Error, raised, threads};
use lasertrace::accel::{Accel, Backend, CAST_ALONE, Ray};
use lasertrace::math::{DVec3, Rigid};
use lasertrace::mesh::Mesh;
use numpy::PyArray1;
use pyo3::prelude::*;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// Return name and version of a ray-tracing backend ("embree" or "rust").
#[pyfunction]
#[pyo3(signature = (backend = "embree"))]
pub fn engine(backend: &str) -> PyResult<String> {
    Ok(self::backend(backend)?.version())
}

fn backend(name: &str) -> PyResult<Backend> {
    match name {
        "embree" => Ok(Backend::Embree),
        "rust" => Ok(Backend::Rust),
        _ => Err(Error::new_err(format!(
            "backend: found {name:?}, expected \"embree\" or \"rust\""
        ))),
    }
}

/// Triangle mesh for ray casting; see lasertrace.RayCaster.
#[pyclass(frozen, subclass, module = "lasertrace")]
pub struct RayCaster {
    accel: Accel,
    threads: usize,
}

/// Invalid ray that replaces the remaining rays after Ctrl-C. The cast then ends with an error,
/// which is replaced by the exception.
const NO_RAY: Ray = Ray {
    origin: DVec3::NAN,
    direction: DVec3::NAN,
    t_max: 0.0,
};

#[pymethods]
impl RayCaster {
    #[new]
    #[pyo3(signature = (vertices, triangles, *, instances = None, backend = "embree", threads = None))]
    fn new(
        py: Python<'_>,
        vertices: &Bound<'_, PyAny>,
        triangles: &Bound<'_, PyAny>,
        instances: Option<&Bound<'_, PyAny>>,
        backend: &str,
        threads: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<RayCaster> {
        let backend = self::backend(backend)?;
        let threads = threads::wanted(threads)?;
        let (vertices, _) = Rows::read(vertices, "vertices", 3)?;
        let triangles = self::triangles(triangles)?;
        let poses = instances.map(self::poses).transpose()?;
        let vertices = vertices.view();
        let built = threads::run(py, threads, |stop| {
            let places = (0..vertices.len()).map(|i| DVec3::from_array(vertices.row(i)));
            let mesh = Arc::new(Mesh::from_triangles(places, triangles)?);
            let accel = Accel::build_with(backend, &mesh, threads, &|_| go_on(stop))?;
            match poses {
                None => Ok(accel),
                Some(poses) => accel.with_copies(poses),
            }
        });
        let accel = built?.map_err(raised)?;
        Ok(RayCaster { accel, threads })
    }

    /// Return the first hit of each ray.
    ///
    /// `rays` is an array (..., 6), float32 or float64: origin and direction. The direction may
    /// have any length; distances and `t_max`, the end of the rays, are in units of this length.
    ///
    /// Returns a structured array of shape (...), one record per ray: `distance` (inf if there is
    /// no hit), `point` (x, y, z), `barycentric` (u, v), `triangle` and `instance`
    /// (lasertrace.MISS if there is no hit). Distance and point are computed in float64, also if
    /// Embree finds the triangle in float32.
    ///
    /// `out` is an array returned by an earlier call for the same number of rays. It is overwritten
    /// and returned instead of a new array, which saves up to a tenth of the time. After an error
    /// it contains no hits.
    #[pyo3(signature = (rays, *, t_max = f64::INFINITY, out = None))]
    fn cast<'py>(
        &self,
        rays: &Bound<'py, PyAny>,
        t_max: f64,
        out: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        self.answers(rays, ("rays", 6), out, |rays, hits, stop| {
            let ray = |i| ray(&rays, i, t_max, stop);
            self.accel.closest_hits(ray, places(hits))
        })
    }

    /// Return whether each ray hits the mesh, as a bool array of shape (...).
    ///
    /// `rays`, `t_max` and `out` are as in `cast`.
    #[pyo3(signature = (rays, *, t_max = f64::INFINITY, out = None))]
    fn any_hit<'py>(
        &self,
        rays: &Bound<'py, PyAny>,
        t_max: f64,
        out: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        self.answers(rays, ("rays", 6), out, |rays, hits, stop| {
            let ray = |i| ray(&rays, i, t_max, stop);
            self.accel.occluded_batch(ray, hits)
        })
    }

    /// Return the point of the mesh nearest to each point of an array (..., 3).
    ///
    /// The records and `out` are as in `cast`.
    #[pyo3(signature = (points, *, out = None))]
    fn nearest<'py>(
        &self,
        points: &Bound<'py, PyAny>,
        out: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        self.answers(points, ("points", 3), out, |points, nearest, stop| {
            let point = |i| point(&points, i, stop);
            self.accel.nearest_points(point, places(nearest))
        })
    }

    /// Return all hits of each ray of an array (..., 6), in order of distance.
    ///
    /// Returns a tuple of three arrays: `hits`, records as in `cast`; `starts`, the index of the
    /// first hit of each ray followed by the number of hits; and `entering`, True where a ray hits
    /// the front of a triangle (corners counter-clockwise). The hits of ray i in C order are
    /// hits[starts[i]:starts[i + 1]].
    ///
    /// Each surface is hit once, also at a common edge or vertex of several triangles. A ray that
    /// touches the outline of a closed mesh enters and leaves at one distance or has no hit.
    /// `limit` is the largest number of hits per ray. Both backends return equal results.
    #[pyo3(signature = (rays, *, t_max = f64::INFINITY, limit = None))]
    fn all_hits<'py>(
        &self,
        rays: &Bound<'py, PyAny>,
        t_max: f64,
        limit: Option<usize>,
    ) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let py = rays.py();
        let (rows, _) = Rows::read(rays, "rays", 6)?;
        let rows = rows.view();
        let limit = limit.unwrap_or(usize::MAX);
        let found = threads::run(py, self.threads, |stop| {
            let ray = |i| ray(&rows, i, t_max, stop);
            self.accel.all_hits(ray, rows.len(), limit)
        })?;
        let found = found.map_err(raised)?;
        let starts = found.starts.into_iter().map(|start| start as i64);
        Ok((
            of_points(py, found.points).into_any(),
            PyArray1::from_iter(py, starts).into_any(),
            PyArray1::from_vec(py, found.entering).into_any(),
        ))
    }

    /// Return the number of hits of each ray, as a uint64 array of shape (...).
    ///
    /// `rays` and `t_max` are as in `cast`, and the hits as in `all_hits`.
    #[pyo3(signature = (rays, *, t_max = f64::INFINITY))]
    fn count_hits<'py>(&self, rays: &Bound<'py, PyAny>, t_max: f64) -> PyResult<Bound<'py, PyAny>> {
        self.answers(rays, ("rays", 6), None, |rays, counts: &mut [u64], stop| {
            self.accel
                .count_hits(|i| ray(&rays, i, t_max, stop), counts)
        })
    }

    /// Return the thickness of the part along each ray, as a float64 array of shape (...).
    ///
    /// It is the length of the first section of the ray inside the closed mesh, in units of the
    /// length of the direction; 0 if there is no such section. `rays` and `t_max` are as in `cast`.
    #[pyo3(signature = (rays, *, t_max = f64::INFINITY))]
    fn thickness<'py>(&self, rays: &Bound<'py, PyAny>, t_max: f64) -> PyResult<Bound<'py, PyAny>> {
        self.answers(
            rays,
            ("rays", 6),
            None,
            |rays, lengths: &mut [f64], stop| {
                self.accel
                    .thicknesses(|i| ray(&rays, i, t_max, stop), lengths)
            },
        )
    }

    /// Return whether each point of an array (..., 3) is inside the closed mesh, as a bool array.
    ///
    /// The parity of the hits of a ray decides, therefore the winding of the triangles has no
    /// effect. An open mesh is an error; `winding_number` accepts it.
    fn contains_points<'py>(&self, points: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        self.answers(
            points,
            ("points", 3),
            None,
            |points, inside: &mut [bool], stop| {
                self.accel
                    .contains_points(|i| point(&points, i, stop), inside)
            },
        )
    }

    /// Return the generalised winding number around each point of an array (..., 3), as float64.
    ///
    /// It is the sum of the solid angles of all triangles, divided by 4π: 1 inside and 0 outside a
    /// closed mesh wound outward, and a fraction for an open mesh. The time per point is
    /// proportional to the number of triangles.
    fn winding_number<'py>(&self, points: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        self.answers(
            points,
            ("points", 3),
            None,
            |points, numbers: &mut [f64], stop| {
                self.accel
                    .winding_numbers(|i| point(&points, i, stop), numbers)
            },
        )
    }

    /// Return the distance from each point of an array (..., 3) to the closed mesh, as float64.
    ///
    /// It is negative inside, as `contains_points` decides.
    fn signed_distance<'py>(&self, points: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        self.answers(
            points,
            ("points", 3),
            None,
            |points, distances: &mut [f64], stop| {
                self.accel
                    .signed_distances(|i| point(&points, i, stop), distances)
            },
        )
    }

    /// Number of triangles of the mesh.
    #[getter]
    fn triangle_count(&self) -> usize {
        self.accel.mesh().triangles.len()
    }

    /// Number of instances of the mesh.
    #[getter]
    fn instance_count(&self) -> usize {
        self.accel.poses().len()
    }

    fn __repr__(&self) -> String {
        let (triangles, instances) = (self.triangle_count(), self.instance_count());
        format!("<lasertrace.RayCaster: {triangles} triangles, {instances} instances>")
    }
}

impl RayCaster {
    /// Computes an array with one result per row of `width` numbers, in the shape of the rows. The
    /// result is written to `out` or to a new array.
    fn answers<'py, T: Answer>(
        &self,
        given: &Bound<'py, PyAny>,
        (name, width): (&str, usize),
        out: Option<&Bound<'py, PyAny>>,
        cast: impl FnOnce(View, &mut [T], &AtomicBool) -> lasertrace::Result<()> + Send,
    ) -> PyResult<Bound<'py, PyAny>> {
        let py = given.py();
        let (rows, shape) = Rows::read(given, name, width)?;
        let rows = rows.view();
        let array = room::<T>(py, out, &shape)?;
        let mut memory = writable(&array)?;
        let answers = memory.as_slice_mut()?;
        let done = match rows.len() <= CAST_ALONE {
            true => py.detach(|| cast(rows, answers, &AtomicBool::new(false))),
            false => threads::run(py, self.threads, |stop| cast(rows, answers, stop))?,
        };
        done.map_err(raised)?;
        match out {
            Some(out) => Ok(out.clone()),
            None => shaped(array.as_any(), &shape),
        }
    }
}

fn ray(rays: &View, i: usize, t_max: f64, stop: &AtomicBool) -> Ray {
    if stop.load(Relaxed) {
        return NO_RAY;
    }
    let [ox, oy, oz, dx, dy, dz] = rays.row(i);
    Ray {
        origin: DVec3::new(ox, oy, oz),
        direction: DVec3::new(dx, dy, dz),
        t_max,
    }
}

/// Returns a point, or an invalid one after Ctrl-C.
fn point(points: &View, i: usize, stop: &AtomicBool) -> DVec3 {
    match stop.load(Relaxed) {
        true => DVec3::NAN,
        false => DVec3::from_array(points.row(i)),
    }
}

/// Reads poses from an array of shape (n, 4, 4).
fn poses(given: &Bound<'_, PyAny>) -> PyResult<Vec<Rigid>> {
    let (rows, shape) = Rows::read(given, "instances", 4)?;
    let rows = rows.view();
    if shape.len() != 2 || shape[1] != 4 {
        let message = "expected an array of shape (n, 4, 4), one matrix an instance";
        return Err(Error::new_err(format!(
            "instances: found {shape:?} rows of 4, {message}"
        )));
    }
    let pose = |i: usize| {
        let below = rows.row::<4>(4 * i + 3);
        match below == [0.0, 0.0, 0.0, 1.0] {
            true => Rigid::from_rows(std::array::from_fn(|k| rows.row(4 * i + k))),
            false => Err(format!(
                "found {below:?} as last row, expected [0, 0, 0, 1]"
            )),
        }
    };
    let poses = (0..shape[0])
        .map(|i| pose(i).map_err(|message| Error::new_err(format!("instance {i}: {message}"))));
    poses.collect()
}

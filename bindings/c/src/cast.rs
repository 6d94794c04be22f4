//! Ray casting against triangles.

use crate::buffers::{Plain, addresses, check_disjoint, one, pair, read, same_number, set, write};
use crate::handles::{self, Handle};
use crate::status::{Failure, Outcome, enter, lasertrace_status};
use lasertrace_core::accel::{Accel, Backend, CAST_ALONE, Ray, SurfacePoint};
use lasertrace_core::math::{DVec3, Rigid};
use lasertrace_core::mesh::Mesh;
use rayon::ThreadPool;
use std::mem::offset_of;
use std::sync::Arc;

/// Triangle mesh prepared for ray casting. Owns its data; the arrays it was created from may be
/// freed.
pub struct lasertrace_caster {
    _opaque: (),
}

/// Object referenced by a [`lasertrace_caster`].
pub struct Caster {
    accel: Accel,
    pool: ThreadPool,
}

impl Handle for lasertrace_caster {
    type Object = Caster;
    const NAME: &'static str = "lasertrace_caster";
}

/// Default ray-tracing backend: Embree, if the library is built with it.
pub const LASERTRACE_BACKEND_DEFAULT: u32 = 0;
/// Embree in 32-bit floats; every hit is recomputed in 64-bit floats.
pub const LASERTRACE_BACKEND_EMBREE: u32 = 1;
/// Rust implementation in 64-bit floats. It is slower and has no misses at vertices of open meshes.
pub const LASERTRACE_BACKEND_RUST: u32 = 2;

/// Options of a caster. All fields zero selects the defaults.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_caster_options {
    /// Ray-tracing backend: LASERTRACE_BACKEND_...
    pub backend: u32,
    /// Number of threads, at most 1024; 0 selects one per core.
    pub threads: u32,
    /// 12 numbers for each instance of the mesh: the first three rows of the 4 x 4 matrix from the
    /// mesh frame to the common frame. It is a rotation and a translation (mm) without scaling or
    /// reflection. NULL: a single instance with the identity transform.
    pub instances: *const f64,
    /// Number of instances; 0 if `instances` is NULL.
    pub instance_count: usize,
}

/// Ray from `origin` along `direction`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_ray {
    /// Origin, mm; coordinates within +-1e12.
    pub origin: [f64; 3],
    /// Direction; its length may be 1e-100 to 1e100.
    pub direction: [f64; 3],
    /// End of the ray in units of the length of `direction`: 0 to INFINITY.
    pub t_max: f64,
}

// SAFETY: seven f64.
unsafe impl Plain for lasertrace_ray {}

/// Value of `triangle` and `instance` if there is no hit.
pub const LASERTRACE_MISS: u32 = u32::MAX;

/// Point on the surface. Without a hit or nearest point: distance INFINITY, triangle and instance
/// LASERTRACE_MISS, all other fields 0.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_surface_point {
    /// For a ray, the parameter t >= 0 of the hit origin + t * direction; it is in mm if the
    /// direction has length 1. For a point, the distance to the surface, mm.
    pub distance: f64,
    /// Coordinates, mm.
    pub point: [f64; 3],
    /// Barycentric coordinates u and v, with u, v >= 0 and u + v <= 1. For corners a, b and c, the
    /// point is (1 - u - v) * a + u * b + v * c.
    pub barycentric: [f64; 2],
    /// Index of the triangle.
    pub triangle: u32,
    /// Index of the instance; 0 for a mesh without instances.
    pub instance: u32,
}

// SAFETY: numbers without padding, as the assertions below verify.
unsafe impl Plain for SurfacePoint {}

/// `lasertrace_surface_point` repeats the layout of `SurfacePoint` for the header.
const _: () = {
    type Ours = lasertrace_surface_point;
    assert!(LASERTRACE_MISS == SurfacePoint::MISS.triangle);
    assert!(size_of::<Ours>() == 56 && size_of::<SurfacePoint>() == 56);
    assert!(align_of::<Ours>() == align_of::<SurfacePoint>());
    assert!(offset_of!(Ours, distance) == offset_of!(SurfacePoint, distance));
    assert!(offset_of!(Ours, point) == offset_of!(SurfacePoint, point));
    assert!(offset_of!(Ours, barycentric) == offset_of!(SurfacePoint, barycentric));
    assert!(offset_of!(Ours, triangle) == offset_of!(SurfacePoint, triangle));
    assert!(offset_of!(Ours, instance) == offset_of!(SurfacePoint, instance));
};

/// Creates a pool with the given number of threads; 0 selects one per core.
pub fn pool(threads: u32) -> Outcome<ThreadPool> {
    if threads > 1024 {
        return Err(Failure::argument(format!(
            "threads: found {threads}, expected 0 (one a core) to 1024"
        )));
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads as usize);
    Ok(pool.build()?)
}

fn backend(number: u32) -> Outcome<Backend> {
    match number {
        LASERTRACE_BACKEND_DEFAULT => return Ok(Backend::default()),
        LASERTRACE_BACKEND_RUST => return Ok(Backend::Rust),
        // The first backend that is built in, if it is an Embree version.
        LASERTRACE_BACKEND_EMBREE => {
            if let Some(&embree) = Backend::ALL.iter().find(|&&b| b != Backend::Rust) {
                return Ok(embree);
            }
        }
        _ => {}
    }
    Err(Failure::argument(format!(
        "backend: found {number}, expected 0 (default), 1 (Embree, if built in) or 2 (Rust)"
    )))
}

/// Creates a caster from triangles. `vertices` are `vertex_count` times three 64-bit floats (mm).
/// `triangles` are `triangle_count` times three vertex indices. All data is copied. `options` may
/// be NULL. Triangles without area are kept: no ray hits them, but they can be nearest to a point.
///
/// Returns LASERTRACE_STATUS_ARGUMENT in four cases: a vertex is not finite or beyond 1e12 mm, an
/// index is out of range, a matrix is not a rotation, or there are no triangles. The message
/// contains the index of the invalid element. Returns LASERTRACE_STATUS_RESOURCES if memory is
/// insufficient. In both cases `*out` is NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_caster_new(
    vertices: *const f64,
    vertex_count: usize,
    triangles: *const u32,
    triangle_count: usize,
    options: *const lasertrace_caster_options,
    out: *mut *mut lasertrace_caster,
) -> lasertrace_status {
    enter("lasertrace_caster_new", || {
        // SAFETY: guaranteed by the caller.
        unsafe {
            set("out", out, std::ptr::null_mut())?;
            let vertices = read::<[f64; 3]>("vertices", vertices.cast(), vertex_count)?;
            let vertices = vertices.iter().map(|&v| DVec3::from_array(v));
            set(
                "out",
                out,
                new(vertices, triangles, triangle_count, options)?,
            )
        }
    })
}

/// Creates a caster as lasertrace_caster_new() from vertices that are 32-bit floats.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_caster_new_f32(
    vertices: *const f32,
    vertex_count: usize,
    triangles: *const u32,
    triangle_count: usize,
    options: *const lasertrace_caster_options,
    out: *mut *mut lasertrace_caster,
) -> lasertrace_status {
    enter("lasertrace_caster_new_f32", || {
        // SAFETY: guaranteed by the caller.
        unsafe {
            set("out", out, std::ptr::null_mut())?;
            let vertices = read::<[f32; 3]>("vertices", vertices.cast(), vertex_count)?;
            let vertices = vertices
                .iter()
                .map(|&v| DVec3::from_array(v.map(f64::from)));
            set(
                "out",
                out,
                new(vertices, triangles, triangle_count, options)?,
            )
        }
    })
}

/// Creates a caster.
///
/// # Safety
/// Pointers must point to the given number of elements.
unsafe fn new(
    vertices: impl Iterator<Item = DVec3>,
    triangles: *const u32,
    triangle_count: usize,
    options: *const lasertrace_caster_options,
) -> Outcome<*mut lasertrace_caster> {
    // SAFETY: guaranteed by the caller. Options consist of numbers and an address, for which every
    // bit pattern is valid.
    let (triangles, options, instances) = unsafe {
        let triangles = read::<[u32; 3]>("triangles", triangles.cast(), triangle_count)?;
        let options = match options.is_null() {
            true => None,
            false => Some(one("options", options)?),
        };
        let instances = match options {
            Some(o) => read::<[f64; 12]>("instances", o.instances.cast(), o.instance_count)?,
            None => &[],
        };
        (triangles, options, instances)
    };
    let backend = backend(options.map_or(LASERTRACE_BACKEND_DEFAULT, |o| o.backend))?;
    let pool = pool(options.map_or(0, |o| o.threads))?;
    let pose = |(i, m): (usize, &[f64; 12])| {
        let rows = std::array::from_fn(|row| std::array::from_fn(|k| m[4 * row + k]));
        Rigid::from_rows(rows).map_err(|what| Failure::argument(format!("instance {i}: {what}")))
    };
    let poses: Vec<Rigid> = (instances.iter().enumerate().map(pose)).collect::<Outcome<_>>()?;
    let mesh = Arc::new(Mesh::from_triangles(vertices, triangles.iter().copied())?);
    let accel = pool.install(|| {
        let threads = rayon::current_num_threads();
        Accel::build_with(backend, &mesh, threads, &|_| Ok(()))
    })?;
    let accel = match poses.is_empty() {
        true => accel,
        false => accel.with_copies(poses)?,
    };
    Ok(handles::give(Caster { accel, pool }))
}

/// Frees a caster. NULL is ignored and returns LASERTRACE_STATUS_OK.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_caster_free(caster: *mut lasertrace_caster) -> lasertrace_status {
    enter("lasertrace_caster_free", || handles::free(caster))
}

/// Casts `ray_count` rays and writes the first hit of each to `hits`. `hit_count` must equal
/// `ray_count`.
///
/// Both sides of a triangle are hit. If two triangles are at the same distance, the result depends
/// on the 16 rays traced together, never on the number of threads. LIMITS.md describes hits that
/// may be missed: at the boundaries of open meshes, and on surfaces closer to the origin of a ray
/// than 2^-20 of the part size.
///
/// Returns LASERTRACE_STATUS_ARGUMENT for an invalid ray (NaN, a direction of length 0). The
/// message contains the index of the ray, and all hits are LASERTRACE_MISS.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_closest_hits(
    caster: *const lasertrace_caster,
    rays: *const lasertrace_ray,
    ray_count: usize,
    hits: *mut lasertrace_surface_point,
    hit_count: usize,
) -> lasertrace_status {
    enter("lasertrace_closest_hits", || {
        let caster = handles::find(caster)?;
        let hits: *mut SurfacePoint = hits.cast();
        // SAFETY: guaranteed by the caller.
        let (rays, hits) = unsafe { pair(("rays", rays, ray_count), ("hits", hits, hit_count))? };
        caster.work(ray_count, || {
            Ok(caster.accel.closest_hits(|i| ray(&rays[i]), hits)?)
        })
    })
}

/// Casts `ray_count` rays and writes 1 to `hit` for each ray that hits the mesh, otherwise 0. The
/// result is consistent with lasertrace_closest_hits().
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_any_hits(
    caster: *const lasertrace_caster,
    rays: *const lasertrace_ray,
    ray_count: usize,
    hit: *mut u8,
    hit_count: usize,
) -> lasertrace_status {
    enter("lasertrace_any_hits", || {
        let caster = handles::find(caster)?;
        // SAFETY: guaranteed by the caller. Zero bytes are valid values of bool, which has the size
        // of u8.
        let (rays, hit) = unsafe {
            let (rays, hit) = pair(("rays", rays, ray_count), ("hit", hit, hit_count))?;
            hit.fill(0);
            let hit = std::slice::from_raw_parts_mut(hit.as_mut_ptr().cast::<bool>(), hit.len());
            (rays, hit)
        };
        caster.work(ray_count, || {
            Ok(caster.accel.occluded_batch(|i| ray(&rays[i]), hit)?)
        })
    })
}

/// Writes to `nearest` the surface point nearest to each of `point_count` points. A point consists
/// of three 64-bit floats (mm, within +-1e12). Errors are the errors of lasertrace_closest_hits().
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_nearest_points(
    caster: *const lasertrace_caster,
    points: *const f64,
    point_count: usize,
    nearest: *mut lasertrace_surface_point,
    nearest_count: usize,
) -> lasertrace_status {
    enter("lasertrace_nearest_points", || {
        let caster = handles::find(caster)?;
        let points: *const [f64; 3] = points.cast();
        let nearest: *mut SurfacePoint = nearest.cast();
        // SAFETY: guaranteed by the caller.
        let (points, nearest) = unsafe {
            pair(
                ("points", points, point_count),
                ("nearest", nearest, nearest_count),
            )?
        };
        caster.work(point_count, || {
            let point = |i: usize| DVec3::from_array(points[i]);
            Ok(caster.accel.nearest_points(point, nearest)?)
        })
    })
}

/// Counts all hits of `ray_count` rays, as lasertrace_all_hits() finds them. `count_count` must
/// equal `ray_count`. Errors are the errors of lasertrace_closest_hits(); all counts are then 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_count_hits(
    caster: *const lasertrace_caster,
    rays: *const lasertrace_ray,
    ray_count: usize,
    counts: *mut u64,
    count_count: usize,
) -> lasertrace_status {
    enter("lasertrace_count_hits", || {
        let caster = handles::find(caster)?;
        // SAFETY: guaranteed by the caller.
        let (rays, counts) =
            unsafe { pair(("rays", rays, ray_count), ("counts", counts, count_count))? };
        caster.work(ray_count, || {
            Ok(caster.accel.count_hits(|i| ray(&rays[i]), counts)?)
        })
    })
}

/// Finds all hits of `ray_count` rays, at most `limit` per ray, ordered by ray and then by
/// distance. Hit k of ray i is `hits[starts[i] + k]`; `starts[ray_count]` is the number of all
/// hits, therefore `start_count` must be `ray_count` + 1. `entering` is 1 for a hit on the front of
/// a triangle, on which its corners are counter-clockwise, otherwise 0.
///
/// Each surface is hit once, also at a common edge or vertex of triangles. A ray that touches the
/// outline of a closed mesh enters and leaves at one distance, or has no hit. Both backends give
/// equal results. The first call with Embree builds a second hierarchy.
///
/// `hits` and `entering` have room for `hit_count` hits each. If there are more hits, returns
/// LASERTRACE_STATUS_ARGUMENT and writes only `starts`, so that a call with `hit_count` 0 returns
/// the room that is required. Returns the errors of lasertrace_closest_hits(), and
/// LASERTRACE_STATUS_RESOURCES if memory for the hits is insufficient; `starts` are then 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_all_hits(
    caster: *const lasertrace_caster,
    rays: *const lasertrace_ray,
    ray_count: usize,
    limit: usize,
    starts: *mut usize,
    start_count: usize,
    hits: *mut lasertrace_surface_point,
    entering: *mut u8,
    hit_count: usize,
) -> lasertrace_status {
    enter("lasertrace_all_hits", || {
        let caster = handles::find(caster)?;
        let hits: *mut SurfacePoint = hits.cast();
        same_number("number of starts", start_count, ray_count.saturating_add(1))?;
        check_disjoint(&[
            ("rays", addresses(rays, ray_count)),
            ("starts", addresses(starts, start_count)),
            ("hits", addresses(hits, hit_count)),
            ("entering", addresses(entering, hit_count)),
        ])?;
        // SAFETY: guaranteed by the caller; the buffers do not overlap.
        let (rays, starts, hits, entering) = unsafe {
            (
                read("rays", rays, ray_count)?,
                write("starts", starts, start_count)?,
                write("hits", hits, hit_count)?,
                write("entering", entering, hit_count)?,
            )
        };
        starts.fill(0);
        caster.work(ray_count, || {
            let all = (caster.accel).all_hits(|i| ray(&rays[i]), ray_count, limit)?;
            starts.copy_from_slice(&all.starts);
            let found = all.points.len();
            if found > hit_count {
                return Err(Failure::argument(format!(
                    "number of hits: found room for {hit_count}, expected room for {found}"
                )));
            }
            hits[..found].copy_from_slice(&all.points);
            for (to, from) in entering.iter_mut().zip(all.entering) {
                *to = u8::from(from);
            }
            Ok(())
        })
    })
}

/// Writes 1 to `inside` for each of `point_count` points inside the closed mesh, otherwise 0. The
/// parity of the hits along a ray decides, therefore winding has no effect.
///
/// Returns LASERTRACE_STATUS_ARGUMENT for an open mesh and for an invalid point; all of `inside` is
/// then 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_contains_points(
    caster: *const lasertrace_caster,
    points: *const f64,
    point_count: usize,
    inside: *mut u8,
    inside_count: usize,
) -> lasertrace_status {
    enter("lasertrace_contains_points", || {
        let caster = handles::find(caster)?;
        // SAFETY: guaranteed by the caller. Zero bytes are valid values of bool, which has the size
        // of u8.
        let (points, inside) = unsafe {
            let points = ("points", points.cast::<[f64; 3]>(), point_count);
            let (points, inside) = pair(points, ("inside", inside, inside_count))?;
            inside.fill(0);
            let first = inside.as_mut_ptr().cast::<bool>();
            (points, std::slice::from_raw_parts_mut(first, inside.len()))
        };
        caster.work(point_count, || {
            let point = |i: usize| DVec3::from_array(points[i]);
            Ok(caster.accel.contains_points(point, inside)?)
        })
    })
}

/// Writes the generalised winding number around each of `point_count` points: the sum of the solid
/// angles of all triangles, divided by 4 pi. It is 1 inside and 0 outside a closed mesh that is
/// wound outward, and a fraction for an open mesh. The time per point is proportional to the number
/// of triangles.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_winding_numbers(
    caster: *const lasertrace_caster,
    points: *const f64,
    point_count: usize,
    numbers: *mut f64,
    number_count: usize,
) -> lasertrace_status {
    enter("lasertrace_winding_numbers", || {
        let caster = handles::find(caster)?;
        let points = ("points", points.cast::<[f64; 3]>(), point_count);
        // SAFETY: guaranteed by the caller.
        let (points, numbers) = unsafe { pair(points, ("numbers", numbers, number_count))? };
        caster.pool.install(|| {
            let point = |i: usize| DVec3::from_array(points[i]);
            Ok(caster.accel.winding_numbers(point, numbers)?)
        })
    })
}

/// Writes the distance from each of `point_count` points to the closed mesh, mm: negative inside,
/// as lasertrace_contains_points() decides. Errors are the errors of that function; all distances
/// are then INFINITY.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_signed_distances(
    caster: *const lasertrace_caster,
    points: *const f64,
    point_count: usize,
    distances: *mut f64,
    distance_count: usize,
) -> lasertrace_status {
    enter("lasertrace_signed_distances", || {
        let caster = handles::find(caster)?;
        let points = ("points", points.cast::<[f64; 3]>(), point_count);
        // SAFETY: guaranteed by the caller.
        let (points, distances) =
            unsafe { pair(points, ("distances", distances, distance_count))? };
        caster.work(point_count, || {
            let point = |i: usize| DVec3::from_array(points[i]);
            Ok(caster.accel.signed_distances(point, distances)?)
        })
    })
}

/// Writes the thickness of the part along each of `ray_count` rays: the length of the first section
/// inside the closed mesh, in units of the length of `direction`; 0 without such a section.
///
/// Returns LASERTRACE_STATUS_ARGUMENT for an open mesh and for an invalid ray; all thicknesses are
/// then 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_thicknesses(
    caster: *const lasertrace_caster,
    rays: *const lasertrace_ray,
    ray_count: usize,
    thicknesses: *mut f64,
    thickness_count: usize,
) -> lasertrace_status {
    enter("lasertrace_thicknesses", || {
        let caster = handles::find(caster)?;
        let out = ("thicknesses", thicknesses, thickness_count);
        // SAFETY: guaranteed by the caller.
        let (rays, out) = unsafe { pair(("rays", rays, ray_count), out)? };
        caster.work(ray_count, || {
            Ok(caster.accel.thicknesses(|i| ray(&rays[i]), out)?)
        })
    })
}

impl Caster {
    /// Runs the work on the threads of the caster, or on the calling thread if the work is small.
    fn work(&self, count: usize, work: impl FnOnce() -> Outcome + Send) -> Outcome {
        match count <= CAST_ALONE {
            true => work(),
            false => self.pool.install(work),
        }
    }
}

fn ray(given: &lasertrace_ray) -> Ray {
    Ray {
        origin: DVec3::from_array(given.origin),
        direction: DVec3::from_array(given.direction),
        t_max: given.t_max,
    }
}

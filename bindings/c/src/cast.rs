//! Rays against triangles.

use crate::buffers::{Plain, one, pair, read, set};
use crate::handles::{self, Handle};
use crate::status::{Failure, Outcome, enter, lasertrace_status};
use lasertrace_core::accel::{Accel, Backend, CAST_ALONE, Ray, SurfacePoint};
use lasertrace_core::math::{DVec3, Rigid};
use lasertrace_core::mesh::Mesh;
use rayon::ThreadPool;
use std::mem::offset_of;
use std::sync::Arc;

/// Triangles made ready for rays. Owns all it needs: what it was made of may be freed.
pub struct lasertrace_caster {
    _opaque: (),
}

/// What a [`lasertrace_caster`] stands for.
pub struct Caster {
    accel: Accel,
    pool: ThreadPool,
}

impl Handle for lasertrace_caster {
    type Object = Caster;
    const NAME: &'static str = "lasertrace_caster";
}

/// What finds the triangles: Embree, where this library is built with it.
pub const LASERTRACE_BACKEND_DEFAULT: u32 = 0;
/// Embree in 32-bit floats, each hit settled in 64.
pub const LASERTRACE_BACKEND_EMBREE: u32 = 1;
/// A tree in Rust in 64-bit floats: slower, and without a miss at vertices of open meshes.
pub const LASERTRACE_BACKEND_RUST: u32 = 2;

/// How a caster is made. All zero is the default.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_caster_options {
    /// LASERTRACE_BACKEND_...
    pub backend: u32,
    /// Threads that cast: 0 for one a core, at most 1024.
    pub threads: u32,
    /// 12 numbers for each instance of the mesh: the first three rows of the 4 x 4 matrix
    /// that takes its points to the common frame, a rotation and a translation (mm) without
    /// scale or mirror. NULL: the mesh itself, once and unmoved.
    pub instances: *const f64,
    /// Number of instances; 0 if `instances` is NULL.
    pub instance_count: usize,
}

/// The half-line from `origin` along `direction`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_ray {
    /// mm, within 1e12.
    pub origin: [f64; 3],
    /// Of any length from 1e-100 to 1e100.
    pub direction: [f64; 3],
    /// Where it ends, in lengths of `direction`: from 0 to INFINITY.
    pub t_max: f64,
}

// SAFETY: seven f64.
unsafe impl Plain for lasertrace_ray {}

/// What `triangle` and `instance` are where there is nothing.
pub const LASERTRACE_NOTHING: u32 = u32::MAX;

/// A place on the surface. Where there is none: distance INFINITY, triangle and instance
/// LASERTRACE_NOTHING, all else 0.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_surface_point {
    /// Of a ray, t from 0, where the place is origin + t * direction: mm if the direction is
    /// of length 1. Of a point, its distance, mm.
    pub distance: f64,
    /// mm.
    pub point: [f64; 3],
    /// u and v from 0, u + v at most 1: the place (1 - u - v) * a + u * b + v * c of a triangle
    /// with corners a, b and c.
    pub barycentric: [f64; 2],
    /// Number of the triangle.
    pub triangle: u32,
    /// Number of the instance; 0 for a mesh without instances.
    pub instance: u32,
}

// SAFETY: numbers without gaps, as the assertions below hold.
unsafe impl Plain for SurfacePoint {}

/// Said again for the header; the core writes its own.
const _: () = {
    type Ours = lasertrace_surface_point;
    assert!(LASERTRACE_NOTHING == SurfacePoint::NOTHING.triangle);
    assert!(size_of::<Ours>() == 56 && size_of::<SurfacePoint>() == 56);
    assert!(align_of::<Ours>() == align_of::<SurfacePoint>());
    assert!(offset_of!(Ours, distance) == offset_of!(SurfacePoint, distance));
    assert!(offset_of!(Ours, point) == offset_of!(SurfacePoint, point));
    assert!(offset_of!(Ours, barycentric) == offset_of!(SurfacePoint, barycentric));
    assert!(offset_of!(Ours, triangle) == offset_of!(SurfacePoint, triangle));
    assert!(offset_of!(Ours, instance) == offset_of!(SurfacePoint, instance));
};

/// So many threads; 0 for one a core.
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
        // The first of those built in, if it is one.
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

/// Makes a caster of triangles whose vertices are 64-bit floats (mm), `vertex_count` times
/// three; a triangle is three numbers of vertices, `triangle_count` times three. Everything
/// is copied. `options` may be NULL. Triangles without area are kept: no ray meets them, but
/// they can be nearest to a point.
///
/// LASERTRACE_STATUS_ARGUMENT for a vertex that is not finite or beyond 1e12 mm, an index
/// without a vertex, a matrix that is no rotation (the message has the number of each), or
/// no triangle; LASERTRACE_STATUS_RESOURCES for too little memory. `*out` is then NULL.
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
        // SAFETY: by the caller's word.
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

/// lasertrace_caster_new() for vertices that are 32-bit floats.
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
        // SAFETY: by the caller's word.
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

/// # Safety
/// Pointers lead to as many elements as is said.
unsafe fn new(
    vertices: impl Iterator<Item = DVec3>,
    triangles: *const u32,
    triangle_count: usize,
    options: *const lasertrace_caster_options,
) -> Outcome<*mut lasertrace_caster> {
    // SAFETY: by the caller's word; options are numbers and an address, of which all bytes
    // are values.
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

/// Frees a caster. NULL is nothing to free, and LASERTRACE_STATUS_OK.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_caster_free(caster: *mut lasertrace_caster) -> lasertrace_status {
    enter("lasertrace_caster_free", || handles::free(caster))
}

/// Casts `ray_count` rays and writes to `hits`, `hit_count` of them, what each meets first. The
/// two numbers must be the same.
///
/// Both sides of a triangle are met. Which of two triangles at the same distance is met
/// depends on the 15 rays beside it, never on the number of threads. LIMITS.md says what may
/// be lost at outlines of open meshes and within a 2^20th of the part's size of the origin.
///
/// LASERTRACE_STATUS_ARGUMENT for a ray that is none (NaN, a direction of length 0); the
/// message has its number, and all hits are LASERTRACE_NOTHING then.
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
        // SAFETY: by the caller's word.
        let (rays, hits) = unsafe { pair(("rays", rays, ray_count), ("hits", hits, hit_count))? };
        caster.work(ray_count, || {
            Ok(caster.accel.closest_hits(|i| ray(&rays[i]), hits)?)
        })
    })
}

/// Casts `ray_count` rays and writes 1 to `hit` for each that meets something, else 0: just
/// where lasertrace_closest_hits() finds something.
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
        // SAFETY: by the caller's word. Bytes that are all 0 are values of bool, which is as
        // large as u8.
        let (rays, hit) = unsafe {
            let (rays, hit) = pair(("rays", rays, ray_count), ("hit", hit, hit_count))?;
            hit.fill(0);
            let hit = std::slice::from_raw_parts_mut(hit.as_mut_ptr().cast::<bool>(), hit.len());
            (rays, hit)
        };
        caster.work(ray_count, || {
            Ok(caster.accel.any_hits(|i| ray(&rays[i]), hit)?)
        })
    })
}

/// Writes to `nearest` the place of the surface nearest to each of `point_count` points, three
/// 64-bit floats each (mm, within 1e12). Errors as of lasertrace_closest_hits().
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
        // SAFETY: by the caller's word.
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

impl Caster {
    /// On the caster's threads, or on this one alone where that is as fast.
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

//! Rays and frames a second through the shared library, over those of the core in the same
//! process: medians of interleaved pairs, on one thread and on all. Answers are compared.
//!
//!     cargo build --release -p lasertrace-c && cargo bench -p lasertrace-c

#[path = "../../../benches/pairs/mod.rs"]
mod pairs;
#[path = "../../../benches/pairs/subject.rs"]
mod subject;

use lasertrace::accel::{Accel, SurfacePoint};
use lasertrace::{Scene, Simulation};
use lasertrace_core as lasertrace;
use pairs::{print_ratio, seconds};
use rayon::prelude::*;
use std::ffi::{CString, c_char, c_int, c_void};
use std::ptr::{null, null_mut};
use subject::{FRAMES, PAIRS, RAYS, rays, scene_path};

unsafe extern "C" {
    fn dlopen(file: *const c_char, flags: c_int) -> *mut c_void;
    fn dlsym(library: *mut c_void, name: *const c_char) -> *mut c_void;
}

/// As in lasertrace.h.
#[repr(C)]
struct COptions {
    backend: u32,
    threads: u32,
    instances: *const f64,
    instance_count: usize,
}

#[repr(C)]
struct CRay {
    origin: [f64; 3],
    direction: [f64; 3],
    t_max: f64,
}

#[repr(C)]
struct CFrames {
    images: *mut u16,
    image_length: usize,
    depths: *mut f32,
    depth_length: usize,
    profiles: *mut c_void,
    profile_length: usize,
}

type Handle = *mut c_void;
type NewCaster = unsafe extern "C" fn(
    *const f64,
    usize,
    *const u32,
    usize,
    *const COptions,
    *mut Handle,
) -> c_int;
type Hits = unsafe extern "C" fn(Handle, *const CRay, usize, *mut SurfacePoint, usize) -> c_int;
type Load = unsafe extern "C" fn(*const c_char, *mut Handle) -> c_int;
type NewSimulation = unsafe extern "C" fn(Handle, u32, *mut Handle) -> c_int;
type TakeFrames =
    unsafe extern "C" fn(Handle, u32, u32, *const CFrames, *const c_void, *mut c_void) -> c_int;

struct Library(*mut c_void);

impl Library {
    fn open() -> Library {
        let bench = std::env::current_exe().unwrap();
        let file = bench.ancestors().nth(2).unwrap().join("liblasertrace.so");
        let name = CString::new(file.to_str().unwrap()).unwrap();
        // SAFETY: a string; 2 is RTLD_NOW. Its initialisers are those of Rust's runtime.
        let library = unsafe { dlopen(name.as_ptr(), 2) };
        assert!(
            !library.is_null(),
            "{}: cargo build --release -p lasertrace-c",
            file.display()
        );
        Library(library)
    }

    /// # Safety
    /// F is the type of the function of that name.
    unsafe fn get<F: Copy>(&self, name: &str) -> F {
        let name = CString::new(name).unwrap();
        // SAFETY: the library is open, and stays so.
        let found = unsafe { dlsym(self.0, name.as_ptr()) };
        assert!(!found.is_null(), "{name:?}");
        assert_eq!(size_of::<F>(), size_of::<*mut c_void>());
        // SAFETY: an address of a function, of the type that the caller says.
        unsafe { std::mem::transmute_copy(&found) }
    }
}

fn cast(library: &Library, scene: &Scene, threads: usize) {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap();
    let accel = pool.install(|| Accel::build(&scene.mesh, threads)).unwrap();
    let rays = rays(&accel);
    let c_rays: Vec<CRay> = (rays.iter())
        .map(|ray| CRay {
            origin: ray.origin.to_array(),
            direction: ray.direction.to_array(),
            t_max: ray.t_max,
        })
        .collect();
    let options = COptions {
        backend: 0,
        threads: threads as u32,
        instances: null(),
        instance_count: 0,
    };
    let vertices: Vec<f64> = scene
        .mesh
        .positions
        .iter()
        .flat_map(|p| p.to_array())
        .collect();
    let triangles = scene.mesh.triangles.as_flattened();
    let mut caster = null_mut();
    // SAFETY: the types are those of the header; arrays are as long as is said.
    let hits = unsafe {
        let new: NewCaster = library.get("lasertrace_caster_new");
        let status = new(
            vertices.as_ptr(),
            vertices.len() / 3,
            triangles.as_ptr(),
            triangles.len() / 3,
            &options,
            &mut caster,
        );
        assert_eq!(status, 0);
        library.get::<Hits>("lasertrace_closest_hits")
    };
    let mut ours = vec![SurfacePoint::MISS; RAYS];
    let mut through_c = ours.clone();
    let name = format!("rays a second through C over the core's, {threads} threads");
    print_ratio(&name, PAIRS, |_| {
        let core = seconds(|| {
            pool.install(|| accel.closest_hits(|i| rays[i], &mut ours))
                .unwrap()
        });
        let c = seconds(|| {
            // SAFETY: the caster is live; both arrays are RAYS long.
            let status =
                unsafe { hits(caster, c_rays.as_ptr(), RAYS, through_c.as_mut_ptr(), RAYS) };
            assert_eq!(status, 0);
        });
        core / c
    });
    assert!(ours == through_c);
}

fn frames(library: &Library, threads: usize) {
    let scene = Scene::load(&scene_path()).unwrap();
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap();
    let simulation = pool.install(|| Simulation::new(&scene)).unwrap();
    let path = CString::new(scene_path().to_str().unwrap()).unwrap();
    let (mut c_scene, mut c_simulation) = (null_mut(), null_mut());
    // SAFETY: the types are those of the header.
    let take = unsafe {
        let load: Load = library.get("lasertrace_scene_load");
        assert_eq!(load(path.as_ptr(), &mut c_scene), 0);
        let new: NewSimulation = library.get("lasertrace_simulation_new");
        assert_eq!(new(c_scene, threads as u32, &mut c_simulation), 0);
        library.get::<TakeFrames>("lasertrace_simulation_frames")
    };
    let first = scene.scan.frames / 2;
    let pixels = scene.camera.sensor.resolution.element_product() as usize;
    let mut images = vec![0; pixels * FRAMES as usize];
    let wanted = CFrames {
        images: images.as_mut_ptr(),
        image_length: images.len(),
        depths: null_mut(),
        depth_length: 0,
        profiles: null_mut(),
        profile_length: 0,
    };
    let mut ours = Vec::new();
    let name = format!("frames a second through C over the core's, {threads} threads");
    print_ratio(&name, PAIRS, |_| {
        let numbers = first..first + FRAMES;
        let core = seconds(|| {
            let taken = || {
                numbers
                    .into_par_iter()
                    .map(|k| simulation.image(k).to_rows())
            };
            ours = pool.install(|| taken().collect::<Vec<_>>());
        });
        let c = seconds(|| {
            // SAFETY: the simulation is live, the buffer as long as is said, nobody else's.
            let status = unsafe { take(c_simulation, first, FRAMES, &wanted, null(), null_mut()) };
            assert_eq!(status, 0);
        });
        core / c
    });
    assert!(ours.concat() == images);
}

fn main() {
    let library = Library::open();
    let scene = Scene::load(&scene_path()).unwrap();
    for threads in [1, std::thread::available_parallelism().unwrap().get()] {
        cast(&library, &scene, threads);
        frames(&library, threads);
    }
}

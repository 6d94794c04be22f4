//! The guards around Embree's structs, its instructions, and quads for triangles.

use super::*;
use crate::accel::Hit;
use crate::accel::hierarchy::tests::{rays_at, soup};
use crate::accel::refine::refine;
use crate::math::DVec2;
use std::path::Path;
use std::sync::Arc;

/// A hierarchy by a device with these settings.
fn built(settings: &str, mesh: &Mesh, quads: Option<Quads>, part: &PartBox) -> Tree {
    let device = Arc::new(Device::configured(settings).unwrap());
    let tree = Tree::filled(device, &Arc::new(mesh.clone()), quads, part, true).unwrap();
    tree.commit(&|_| Ok(())).unwrap();
    tree
}

/// The hierarchy that a larger mesh would have.
pub fn of_quads(mesh: &Mesh, part: &PartBox) -> Tree {
    built("threads=1", mesh, Some(Quads::pair(mesh)), part)
}

/// The bytes behind the structs stay as they were: had the header another
/// RTCHit than the library, Embree would write past the end.
#[test]
fn embree_writes_nothing_past_its_structs() {
    #[repr(C, align(64))]
    struct Guarded<T> {
        value: T,
        guard: [u8; 1024],
    }
    let mesh = soup();
    let part = PartBox::new(mesh.bounds());
    let tree = Tree::build(&mesh.clone().into(), &part, 1, &|_| Ok(())).unwrap();
    let rays = Lanes::new(&rays_at(&mesh, WIDTH as u64));
    // SAFETY: all-zero bytes are valid floats and integers.
    let mut ray: ffi::RTCRay16 = unsafe { std::mem::zeroed() };
    let valid = Tree::pack(&rays.inside(&part, None), u16::MAX, &mut ray);
    let mut closest = Guarded {
        value: ffi::RTCRayHit16 {
            ray,
            // SAFETY: all-zero bytes are valid floats and integers.
            hit: unsafe { std::mem::zeroed() },
        },
        guard: [0xA5; 1024],
    };
    closest.value.hit.geomID = [ffi::LT_NO_GEOMETRY; WIDTH];
    let mut occluded = Guarded {
        value: ray,
        guard: [0xA5; 1024],
    };
    let width = tree.device.packet;
    // SAFETY: scene live and committed, structs aligned to 64 bytes.
    unsafe {
        for coherent in [true, false] {
            ffi::lt_intersect16(
                tree.scene,
                coherent,
                width,
                valid.0.as_ptr(),
                &mut closest.value,
            );
        }
        ffi::lt_occluded16(
            tree.scene,
            true,
            width,
            valid.0.as_ptr(),
            &mut occluded.value,
        );
    }
    assert!(closest.value.hit.geomID.contains(&0), "no ray hit");
    assert_eq!(closest.guard, [0xA5; 1024]);
    assert_eq!(occluded.guard, [0xA5; 1024]);
}

/// Embree takes the widest instructions the processor has. With narrower ones rays at
/// a triangle's inside meet the same triangle, at a distance that differs in f32 and,
/// refined in f64, not at all. Of 20 000 rays at 300 triangles of edge 1 mm 0.1 are
/// expected within f32's 2e-6 mm of an edge, as against brute force.
#[test]
fn other_instructions_meet_the_same_triangles() {
    let mesh = soup();
    let part = PartBox::new(mesh.bounds());
    let rays = rays_at(&mesh, 20_000);
    let met = |settings: &str| {
        let tree = built(settings, &mesh, None, &part);
        let mut met = vec![(None, 0.0); rays.len()];
        for (packet, rays) in rays.chunks(WIDTH).enumerate() {
            tree.closest(
                &Lanes::new(rays),
                u16::MAX,
                &part,
                |i, triangle, t, side| {
                    met[packet * WIDTH + i] = (Some((triangle, side)), t);
                },
            );
        }
        met
    };
    let own = met("threads=1");
    assert!(own.iter().filter(|(met, _)| met.is_some()).count() > 5_000);
    for isa in ["sse2", "avx", "avx2"] {
        let other = met(&format!("threads=1,isa={isa}"));
        let both = || own.iter().zip(&other);
        let others = both().filter(|(a, b)| a.0 != b.0).count();
        let moved = both().filter(|(a, b)| a.1 != b.1).count();
        println!("{isa}: {others} other triangles, {moved} other distances");
        assert!(others <= 2, "{isa}: {others}");
    }
}

/// What the rays of a frame and points near the part meet.
struct Answers {
    /// Triangle, its side and distance (mm), if any.
    hits: Vec<Option<(u32, Side, f64)>>,
    /// The same in f64.
    refined: Vec<Option<Hit>>,
    shadows: Vec<u16>,
    nearest: Vec<Nearest>,
}

/// 40 960 coherent rays at the demo's part.
struct Demo {
    mesh: Mesh,
    rays: Vec<Ray>,
}

impl Demo {
    fn new() -> Demo {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/bracket.stl");
        let eye = DVec3::new(0.0, -126.0, 233.2);
        let ray = |i| Ray::between(eye, eye + (Demo::at(i) - eye) * 1.2).unwrap();
        Demo {
            mesh: crate::mesh::load(&file, 1.0).unwrap(),
            rays: (0..320 * 128).map(ray).collect(),
        }
    }

    fn at(i: usize) -> DVec3 {
        let share = DVec2::new((i % 320) as f64 / 320.0, (i / 320) as f64 / 128.0) - 0.5;
        DVec3::new(64.0 * share.x, 44.0 * share.y, 15.0)
    }

    /// Of the rays, as many shadows, and 2000 nearest points.
    fn answers(&self, settings: &str, quads: Option<Quads>) -> Answers {
        let part = PartBox::new(self.mesh.bounds());
        let tree = built(settings, &self.mesh, quads, &part);
        let mut hits = vec![None; self.rays.len()];
        let mut refined = vec![None; self.rays.len()];
        for (packet, rays) in self.rays.chunks(WIDTH).enumerate() {
            tree.closest(
                &Lanes::new(rays),
                u16::MAX,
                &part,
                |i, triangle, t, side| {
                    hits[packet * WIDTH + i] = Some((triangle, side, t));
                    let corners = self.mesh.triangle(triangle as usize);
                    let hit = refine(&rays[i], triangle, corners, t, part.tolerance());
                    refined[packet * WIDTH + i] = hit.hit();
                },
            );
        }
        let packets = self.rays.chunks(WIDTH);
        let far = Nearest {
            distance: f64::INFINITY,
            point: DVec3::ZERO,
            face: Face::of_mesh(0),
        };
        Answers {
            hits,
            refined,
            shadows: packets
                .map(|rays| tree.occluded(&Lanes::new(rays), &part))
                .collect(),
            nearest: (0..2000)
                .map(|i| tree.nearest(Demo::at(i * 20), &part, far))
                .collect(),
        }
    }
}

/// A frame is a function of the hits in f64, shadows and nearest points of its rays, and
/// these are the same to the bit with AVX2 as with the widest instructions of the processor.
/// What differs is the distance in f32, from which f64 does not start.
#[test]
fn a_frames_rays_are_the_same_with_avx2() {
    let demo = Demo::new();
    let [own, narrow] = ["threads=1", "threads=1,isa=avx2"].map(|s| demo.answers(s, None));
    assert!(own.refined.iter().flatten().count() > 30_000);
    let hits = || own.hits.iter().zip(&narrow.hits);
    println!("{} other distances", hits().filter(|(a, b)| a != b).count());
    let met = |hit: &Option<(u32, Side, f64)>| hit.map(|(triangle, side, _)| (triangle, side));
    assert!(hits().all(|(own, narrow)| met(own) == met(narrow)));
    assert!(own.refined == narrow.refined && own.shadows == narrow.shadows);
    assert!(own.nearest == narrow.nearest);
}

/// Quads meet the same triangles from the same sides, at distances that differ by f32's
/// rounding only. Some 1e-5 of the rays are expected within it of a side.
#[test]
fn quads_meet_the_triangles_they_are_of() {
    let demo = Demo::new();
    let quads = Quads::pair(&demo.mesh);
    assert!(3 * quads.len() < 2 * demo.mesh.triangles.len());
    let single = demo.answers("threads=1", None);
    let paired = demo.answers("threads=1", Some(quads));
    assert!(single.nearest == paired.nearest && single.shadows == paired.shadows);
    let resolution = PartBox::new(demo.mesh.bounds()).resolution();
    let mut others = 0;
    for (single, paired) in single.hits.iter().zip(&paired.hits) {
        match (single, paired) {
            (Some((a, a_side, t)), Some((b, b_side, u))) => {
                assert!((t - u).abs() < resolution, "{t} {u}");
                others += usize::from((a, a_side) != (b, b_side));
            }
            _ => assert!(single == paired),
        }
    }
    println!("{others} other triangles of {}", single.hits.len());
    assert!(others <= 4, "{others}");
}

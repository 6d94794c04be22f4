//! Tests of the memory guards around Embree structs, of its instruction sets, and of quads against
//! triangles.

use super::*;
use crate::accel::Hit;
use crate::accel::hierarchy::tests::{rays_at, soup};
use crate::accel::refine::refine;
use crate::math::DVec2;
use std::path::Path;
use std::sync::Arc;

/// Returns a hierarchy built by a device with these settings.
fn built(settings: &str, mesh: &Mesh, quads: Option<Quads>, part: &PartBounds) -> EmbreeScene {
    let device = Arc::new(Device::configured(settings).unwrap());
    let tree = EmbreeScene::filled(device, &Arc::new(mesh.clone()), quads, part, true).unwrap();
    tree.commit(&|_| Ok(())).unwrap();
    tree
}

/// Returns the hierarchy of quads, as built for larger meshes.
pub fn of_quads(mesh: &Mesh, part: &PartBounds) -> EmbreeScene {
    built("threads=1", mesh, Some(Quads::pair(mesh)), part)
}

/// Tests that the bytes behind the structs are unchanged. If the RTCHit of the header differed from
/// the library, Embree would write past the end.
#[test]
fn embree_writes_nothing_past_its_structs() {
    #[repr(C, align(64))]
    struct Guarded<T> {
        value: T,
        guard: [u8; 1024],
    }
    let mesh = soup();
    let part = PartBounds::new(mesh.bounds());
    let tree = EmbreeScene::build(&mesh.clone().into(), &part, 1, &|_| Ok(())).unwrap();
    let rays = RayPacketSoA::new(&rays_at(&mesh, WIDTH as u64));
    // SAFETY: all-zero bytes are valid floats and integers.
    let mut ray: ffi::RTCRay16 = unsafe { std::mem::zeroed() };
    let valid = EmbreeScene::pack(&rays.inside(&part, None), u16::MAX, &mut ray);
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
    // SAFETY: the scene is live and committed, and the structs are aligned to 64 bytes.
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

/// Tests different instruction sets; Embree uses the widest that the processor supports.
///
/// With narrower instructions, rays at the interior of a triangle hit the same triangle. The
/// distances differ in f32, but not after refinement in f64. Of 20 000 rays at 300 triangles of
/// edge 1 mm, 0.1 are expected within the f32 resolution of 2e-6 mm of an edge, as in the test
/// against brute force.
#[test]
fn other_instructions_meet_the_same_triangles() {
    let mesh = soup();
    let part = PartBounds::new(mesh.bounds());
    let rays = rays_at(&mesh, 20_000);
    let met = |settings: &str| {
        let tree = built(settings, &mesh, None, &part);
        let mut met = vec![(None, 0.0); rays.len()];
        for (packet, rays) in rays.chunks(WIDTH).enumerate() {
            tree.closest(
                &RayPacketSoA::new(rays),
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

/// Results for the rays of a frame and for points near the part.
struct Answers {
    /// Triangle, its side and the distance (mm), or `None`.
    hits: Vec<Option<(u32, Facing, f64)>>,
    /// Hits refined in f64.
    refined: Vec<Option<Hit>>,
    shadows: Vec<u16>,
    nearest: Vec<Nearest>,
}

/// Test case of 40 960 coherent rays at the demo part.
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

    /// Returns the hits and shadows of all rays, and 2000 nearest points.
    fn answers(&self, settings: &str, quads: Option<Quads>) -> Answers {
        let part = PartBounds::new(self.mesh.bounds());
        let tree = built(settings, &self.mesh, quads, &part);
        let mut hits = vec![None; self.rays.len()];
        let mut refined = vec![None; self.rays.len()];
        for (packet, rays) in self.rays.chunks(WIDTH).enumerate() {
            tree.closest(
                &RayPacketSoA::new(rays),
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
            face: TriangleId::of_mesh(0),
        };
        Answers {
            hits,
            refined,
            shadows: packets
                .map(|rays| tree.occluded(&RayPacketSoA::new(rays), &part))
                .collect(),
            nearest: (0..2000)
                .map(|i| tree.nearest(Demo::at(i * 20), &part, far))
                .collect(),
        }
    }
}

/// Tests that hits in f64, shadows and nearest points have identical bits with AVX2 and with the
/// widest instructions of the processor. A frame depends only on these results.
///
/// Only the f32 distances differ, and the refinement in f64 does not start from them.
#[test]
fn a_frames_rays_are_the_same_with_avx2() {
    let demo = Demo::new();
    let [own, narrow] = ["threads=1", "threads=1,isa=avx2"].map(|s| demo.answers(s, None));
    assert!(own.refined.iter().flatten().count() > 30_000);
    let hits = || own.hits.iter().zip(&narrow.hits);
    println!("{} other distances", hits().filter(|(a, b)| a != b).count());
    let met = |hit: &Option<(u32, Facing, f64)>| hit.map(|(triangle, side, _)| (triangle, side));
    assert!(hits().all(|(own, narrow)| met(own) == met(narrow)));
    assert!(own.refined == narrow.refined && own.shadows == narrow.shadows);
    assert!(own.nearest == narrow.nearest);
}

/// Tests that quads give the same triangles and sides, at distances that differ by f32 rounding
/// only. About 1e-5 of the rays are expected within this rounding of a side.
#[test]
fn quads_meet_the_triangles_they_are_of() {
    let demo = Demo::new();
    let quads = Quads::pair(&demo.mesh);
    assert!(3 * quads.len() < 2 * demo.mesh.triangles.len());
    let single = demo.answers("threads=1", None);
    let paired = demo.answers("threads=1", Some(quads));
    assert!(single.nearest == paired.nearest && single.shadows == paired.shadows);
    let resolution = PartBounds::new(demo.mesh.bounds()).resolution();
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

/// Tests packets of 1 to 16 rays with every instruction set of the processor. Embree refuses to start
/// with a set that is absent.
#[test]
#[cfg(target_arch = "x86_64")]
fn lanes_without_a_ray_report_no_hit() {
    let mesh = soup();
    let part = PartBounds::new(mesh.bounds());
    let rays = rays_at(&mesh, 3 * WIDTH as u64);
    let has_avx512 = is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512cd")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512vl");
    for (isa, is_present) in [
        ("sse2", true),
        ("sse4.2", is_x86_feature_detected!("sse4.2")),
        ("avx", is_x86_feature_detected!("avx")),
        ("avx2", is_x86_feature_detected!("avx2")),
        ("avx512", has_avx512),
    ] {
        if !is_present {
            eprintln!("SKIPPED {isa}: this processor does not have it");
            continue;
        }
        let tree = built(&format!("threads=1,isa={isa}"), &mesh, None, &part);
        let mut hits = 0;
        for (rays, count) in rays
            .chunks(WIDTH)
            .flat_map(|rays| (1..=WIDTH).map(move |n| (rays, n)))
        {
            let packet = RayPacketSoA::new(&rays[..count]);
            tree.closest(&packet, u16::MAX, &part, |ray, _, _, _| {
                assert!(ray < count, "{isa}: ray {ray} of {count}");
                hits += 1;
            });
            let occluded = tree.occluded(&packet, &part);
            assert_eq!(occluded & !packet.there(), 0, "{isa}: {count}");
        }
        assert!(hits > 0, "{isa}");
    }
}

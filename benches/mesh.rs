//! Load, weld, build and trace on the demo part with each triangle divided in four
//! again and again: 202 k and 809 k triangles, and 12.9 M if LASERTRACE_BENCH_LARGE
//! is set (minutes, 3 GB). Load, weld and build use all threads, rays one. Each
//! answer is checked against the part as it was: division does not change its shape.

use criterion::{
    BenchmarkId, Criterion, SamplingMode, Throughput, criterion_group, criterion_main,
};
use lasertrace::accel::{Accel, Hit, Ray, TriangleClusters, WIDTH};
use lasertrace::math::DVec3;
use lasertrace::math::rng::{Purpose, RngKey};
use lasertrace::mesh::{self, Mesh};
use std::f64::consts::TAU;
use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Rays a side of the camera's picture.
const SIDE: usize = 256;

type Triangle = [[f32; 3]; 3];

fn demo_part() -> Mesh {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    mesh::load(&root.join("scenes/bracket/bracket.stl"), 1.0).unwrap()
}

/// Each triangle cut at the middles of its sides.
fn divided(triangles: &[Triangle]) -> Vec<Triangle> {
    // a + b = b + a, so neighbours agree on the middle to the bit.
    let middle = |a: [f32; 3], b: [f32; 3]| std::array::from_fn(|i| (a[i] + b[i]) / 2.0);
    let four = |&[a, b, c]: &Triangle| {
        let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
        [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    };
    triangles.iter().flat_map(four).collect()
}

/// Binary STL of the part, divided so many times.
fn stl(part: &Mesh, times: u32) -> Vec<u8> {
    let corners = |i| part.triangle(i).map(|p| p.as_vec3().to_array());
    let mut triangles: Vec<Triangle> = (0..part.triangles.len()).map(corners).collect();
    for _ in 0..times {
        triangles = divided(&triangles);
    }
    let mut bytes = vec![0; 80];
    bytes.extend((triangles.len() as u32).to_le_bytes());
    for triangle in &triangles {
        bytes.extend([0; 12]);
        bytes.extend((triangle.as_flattened().iter()).flat_map(|c| c.to_le_bytes()));
        bytes.extend([0; 2]);
    }
    bytes
}

/// Rays as a simulation traces them, neighbours next to each other.
struct Rays {
    camera: Vec<Ray>,
    sheet: Vec<Ray>,
    shadow: Vec<Ray>,
    diffuse: Vec<Ray>,
}

impl Rays {
    /// Rays at the part that `accel` is of.
    fn new(accel: &Accel) -> Rays {
        let (middle, reach) = (
            accel.bounds().center(),
            accel.bounds().size().length() / 2.0,
        );
        let eye = middle + DVec3::new(0.3, -0.55, 0.78).normalize() * 4.0 * reach;
        let lamp = middle + DVec3::new(-0.1, 0.05, 1.0).normalize() * 3.0 * reach;
        let at = |i: usize, of: usize| ((i as f64 + 0.5) / of as f64 * 2.0 - 1.0) * reach;
        let right = (middle - eye).cross(DVec3::Z).normalize();
        let up = right.cross((middle - eye).normalize());
        let pixel = |k| middle + right * at(k % SIDE, SIDE) - up * at(k / SIDE, SIDE);
        let fan = |k| middle + DVec3::new(at(k / SIDE, SIDE), at(k % SIDE, SIDE), 0.0);
        let towards = |from: DVec3, to: DVec3| Ray {
            t_max: f64::INFINITY,
            ..Ray::between(from, to).expect("the lamp is far away")
        };
        let camera: Vec<Ray> = (0..SIDE * SIDE).map(|k| towards(eye, pixel(k))).collect();
        let seen: Vec<Hit> = closest(accel, &camera).into_iter().flatten().collect();
        let start = |hit: &Hit| hit.point + hit.normal * (8.0 * accel.resolution());
        let key = RngKey::new(1, Purpose::RaceRays);
        Rays {
            shadow: (seen.iter().filter_map(|hit| Ray::between(start(hit), lamp))).collect(),
            diffuse: (seen.iter().enumerate())
                .map(|(i, hit)| Ray {
                    origin: start(hit),
                    direction: diffuse(hit.normal, key.with(i as u64)),
                    t_max: f64::INFINITY,
                })
                .collect(),
            sheet: (0..SIDE * SIDE).map(|k| towards(lamp, fan(k))).collect(),
            camera,
        }
    }
}

/// By the cosine law: a point of the unit sphere on top of the normal.
fn diffuse(normal: DVec3, key: RngKey) -> DVec3 {
    let z = 2.0 * key.uniform(0) - 1.0;
    let (sin, cos) = (TAU * key.uniform(1)).sin_cos();
    let on_sphere = DVec3::new(cos, sin, 0.0) * (1.0 - z * z).sqrt() + DVec3::Z * z;
    (normal + on_sphere).normalize()
}

fn closest(accel: &Accel, rays: &[Ray]) -> Vec<Option<Hit>> {
    (rays.chunks(WIDTH))
        .flat_map(|rays| {
            accel
                .closest(rays, |_, _| true)
                .into_iter()
                .take(rays.len())
        })
        .collect()
}

fn count_hits(accel: &Accel, rays: &[Ray]) -> usize {
    let packet = |rays| accel.closest(rays, |_, _| true).iter().flatten().count();
    rays.chunks(WIDTH).map(packet).sum()
}

fn count_blocked(accel: &Accel, rays: &[Ray]) -> usize {
    let packet = |rays| accel.occluded(rays).count_ones() as usize;
    rays.chunks(WIDTH).map(packet).sum()
}

/// Hits of each kind of rays: of the part as it was.
struct Answers {
    camera: Vec<Option<Hit>>,
    sheet: usize,
    shadow: usize,
    diffuse: usize,
}

fn trace(c: &mut Criterion, size: &str, accel: &Accel, rays: &Rays, known: &Answers) {
    // Middles are rounded to 4e-6 mm, so only a ray past an edge may meet something
    // else; a thousandth of the rays is ten times as many as were seen to.
    let few = SIDE * SIDE / 1000;
    let near = |a: &Hit, b: &Hit| (a.t - b.t).abs() < 1e-2;
    let same = |a: &Option<Hit>, b: &Option<Hit>| match (a, b) {
        (Some(a), Some(b)) => near(a, b),
        (a, b) => a.is_none() == b.is_none(),
    };
    let hits = closest(accel, &rays.camera);
    let others = hits
        .iter()
        .zip(&known.camera)
        .filter(|(a, b)| !same(a, b))
        .count();
    assert!(others <= few, "{others} camera rays meet something else");
    let mut group = c.benchmark_group("trace");
    group.sample_size(20);
    let camera = hits.iter().flatten().count();
    type Count = fn(&Accel, &[Ray]) -> usize;
    for (kind, rays, expected, count) in [
        ("camera", &rays.camera, camera, count_hits as Count),
        ("sheet", &rays.sheet, known.sheet, count_hits),
        ("shadow", &rays.shadow, known.shadow, count_blocked),
        ("diffuse", &rays.diffuse, known.diffuse, count_hits),
    ] {
        group.throughput(Throughput::Elements(rays.len() as u64));
        group.bench_function(BenchmarkId::new(kind, size), |b| {
            b.iter(|| {
                let found = count(accel, rays);
                assert!(
                    found.abs_diff(expected) <= few,
                    "{kind}: {found}, not {expected}"
                );
            })
        });
    }
    group.finish();
}

/// Memory the process holds, bytes; 0 where the system does not say.
fn resident() -> f64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:"));
    let kilobytes = line.and_then(|l| l.split_whitespace().next()?.parse::<f64>().ok());
    kilobytes.unwrap_or(0.0) * 1024.0
}

/// One run of everything, with the memory it leaves taken.
fn once(file: &Path, size: &str) {
    let before = resident();
    let start = Instant::now();
    let mesh = Arc::new(mesh::load(file, 1.0).unwrap());
    let loaded = start.elapsed().as_secs_f64();
    let accel = Accel::build(&mesh, rayon::current_num_threads()).unwrap();
    let built = start.elapsed().as_secs_f64();
    let bytes = |since: f64| (resident() - since) / mesh.triangles.len() as f64;
    let (taken, held) = (bytes(before), resident());
    let clusters = TriangleClusters::new(&mesh);
    let clustered = start.elapsed().as_secs_f64();
    let more = bytes(held);
    let report = mesh::report(&mesh);
    println!(
        "{size}: load {loaded:.2} s, build {:.2} s, then {taken:.0} bytes a triangle resident; \
         clusters {:.2} s, {more:.0} bytes more; mesh report {:.2} s",
        built - loaded,
        clustered - built,
        start.elapsed().as_secs_f64() - clustered
    );
    assert_eq!(report.triangles, mesh.triangles.len());
    drop((clusters, accel));
}

fn meshes(c: &mut Criterion) {
    let part = Arc::new(demo_part());
    let base = Accel::build(&part, 1).unwrap();
    let rays = Rays::new(&base);
    let known = Answers {
        camera: closest(&base, &rays.camera),
        sheet: count_hits(&base, &rays.sheet),
        shadow: count_blocked(&base, &rays.shadow),
        diffuse: count_hits(&base, &rays.diffuse),
    };
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("part.stl");
    let large = std::env::var_os("LASERTRACE_BENCH_LARGE").is_some();
    for (times, size) in [(3, "202 k"), (4, "809 k"), (6, "12.9 M")] {
        if times == 6 && !large {
            continue;
        }
        fs::write(&file, stl(&part, times)).unwrap();
        once(&file, size);
        let bytes = fs::read(&file).unwrap();
        let mesh = Arc::new(mesh::parse(&file, &bytes, 1.0).unwrap());
        let triangles = mesh.triangles.len();
        assert_eq!(triangles, part.triangles.len() << (2 * times));
        // Euler's number: division adds a vertex for each edge.
        let half = |mesh: &Mesh| mesh.positions.len() as i64 - mesh.triangles.len() as i64 / 2;
        assert_eq!(half(&mesh), half(&part));
        let mut group = c.benchmark_group("mesh");
        group.sample_size(10).sampling_mode(SamplingMode::Flat);
        group.throughput(Throughput::Elements(triangles as u64));
        group.bench_function(BenchmarkId::new("load", size), |b| {
            b.iter(|| assert_eq!(mesh::load(&file, 1.0).unwrap().triangles.len(), triangles))
        });
        group.bench_function(BenchmarkId::new("weld", size), |b| {
            b.iter(|| {
                let welded = mesh::parse(&file, &bytes, 1.0).unwrap();
                assert_eq!(welded.positions.len(), mesh.positions.len());
            })
        });
        let threads = rayon::current_num_threads();
        group.bench_function(BenchmarkId::new("build", size), |b| {
            b.iter(|| {
                assert_eq!(
                    Accel::build(&mesh, threads).unwrap().bounds(),
                    mesh.bounds()
                )
            })
        });
        group.finish();
        drop(bytes);
        trace(
            c,
            size,
            &Accel::build(&mesh, threads).unwrap(),
            &rays,
            &known,
        );
    }
}

criterion_group!(benches, meshes);
criterion_main!(benches);

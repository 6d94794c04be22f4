//! What a thousand copies cost: memory and building against one copy, a frame against
//! that of one copy and of the same assembly as one mesh. Answers are checked; ratios
//! are medians of interleaved pairs.

#[path = "../tests/common/flattened.rs"]
mod flattened;
mod pairs;

use criterion::{Criterion, criterion_group, criterion_main};
use flattened::flattened;
use lasertrace::accel::{Accel, TriangleClusters};
use lasertrace::math::{DVec3, Rigid};
use lasertrace::mesh::{Mesh, shapes};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use pairs::{print_ratio, seconds};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Balls of 1.8 mm, 2.2 mm apart, on 40 × 25 places: 88 × 55 mm, a little bowed.
fn poses() -> Vec<Rigid> {
    let place = |i: usize| {
        let (x, y) = (2.2 * (i % 40) as f64 - 42.9, 2.2 * (i / 40) as f64 - 26.4);
        Rigid::from_euler_xyz(DVec3::new(x, y, 1.0), DVec3::new(x, y, 1e-3 * x * y))
    };
    (0..1000).map(place).collect()
}

/// The demo's sensor over a mesh and copies of it.
fn scene(mesh: Mesh, copies: &[Rigid]) -> Scene {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/scene.toml");
    Scene {
        mesh: mesh.into(),
        copies: copies.into(),
        ..Scene::load(&path).unwrap()
    }
}

/// Resident bytes of this program, where the system says it in Linux's way.
fn resident() -> f64 {
    let text = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages = text.split(' ').nth(1).and_then(|n| n.parse::<f64>().ok());
    pages.unwrap_or(f64::NAN) * 4096.0
}

/// Seconds and resident bytes of what is built over a mesh and its copies.
fn built(mesh: &Arc<Mesh>, poses: &[Rigid]) -> (f64, f64) {
    let before = resident();
    let start = Instant::now();
    let accel = Accel::build(mesh, 1).unwrap().with_copies(poses).unwrap();
    let clusters = TriangleClusters::new(mesh);
    let taken = (start.elapsed().as_secs_f64(), resident() - before);
    std::hint::black_box((accel, clusters));
    taken
}

fn assembly(c: &mut Criterion) {
    rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build_global()
        .unwrap();
    let (one, thousand) = ([Rigid::IDENTITY], poses());
    let large = Arc::new(shapes::sphere(0.9, 1e-5).unwrap());
    for (copies, poses) in [(1, &one[..]), (1000, &thousand)] {
        let (seconds, bytes) = built(&large, poses);
        let (triangles, ms, mb) = (large.triangles.len(), seconds * 1e3, bytes / 1e6);
        println!("{copies} of {triangles} triangles: built in {ms:.0} ms, {mb:.1} MB");
    }
    print_ratio("building a thousand copies / one", 9, |_| {
        built(&large, &thousand).0 / built(&large, &one).0
    });
    let ball = shapes::sphere(0.9, 1e-3).unwrap();
    let triangles = ball.triangles.len() * thousand.len();
    let flat = scene(flattened(&ball, &thousand), &one);
    let copies = scene(ball, &thousand);
    let [flat, copies] = [&flat, &copies].map(|scene| Simulation::new(scene).unwrap());
    let lit = |simulation: &Simulation, frame: u32| {
        let image = simulation.irradiance(frame);
        (0..image.rows())
            .flat_map(|row| image.row(row))
            .filter(|(_, e)| *e > 0.0)
            .count()
    };
    let mut group = c.benchmark_group("assembly");
    group.sample_size(20);
    let [a, b] = [&copies, &flat].map(|s| lit(s, 110));
    assert!(a > 2_000 && a.abs_diff(b) < a / 100, "{a} {b}");
    group.bench_function("light on 1000 copies", |b| b.iter(|| lit(&copies, 110)));
    group.bench_function(format!("light on {triangles} triangles"), |b| {
        b.iter(|| lit(&flat, 110))
    });
    print_ratio(
        "light on a thousand copies / on one mesh of them",
        41,
        |i| {
            let frame = 80 + i as u32;
            seconds(|| lit(&copies, frame)) / seconds(|| lit(&flat, frame))
        },
    );
    group.finish();
}

criterion_group!(benches, assembly);
criterion_main!(benches);

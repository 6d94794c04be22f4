//! How fast frames are taken at 2048 × 1088 with speckle, and what limits it: sizes
//! of mesh, stages, threads, the footprint against every pixel, the integrator
//! against a bare Embree loop (`--features race`), geometry alone. Each answer is
//! checked. `LASERTRACE_TRIANGLES=1e7` adds a mesh of that size to 1e5 and 1e6: ten
//! million take 3 GB.
//!
//! Single figures move with the machine's load; ratios are medians of interleaved
//! pairs.

mod pairs;
mod waves;

use criterion::{Criterion, criterion_group, criterion_main};
use lasertrace::accel::TriangleClusters;
use lasertrace::frame::{LaserPlaneSampler, Sampling, TracedRegion, irradiance};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use pairs::{print_ratio, seconds};
use rayon::ThreadPoolBuilder;
use rayon::prelude::*;

/// Columns and rows of pixels.
const SENSOR: [usize; 2] = [2048, 1088];

/// A frame as a scan takes it, but for its files: number of points.
fn frame(simulation: &Simulation, frame: u32) -> usize {
    simulation.profile(frame).1.len()
}

/// Frames taken together, as in a scan.
const TOGETHER: u32 = 16;

fn batch(simulation: &Simulation) -> usize {
    let frames = (0..TOGETHER).into_par_iter();
    frames.map(|i| frame(simulation, 470 + i)).sum()
}

fn throughput(c: &mut Criterion) {
    ThreadPoolBuilder::new()
        .num_threads(1)
        .build_global()
        .unwrap();
    let two_threads = ThreadPoolBuilder::new().num_threads(2).build().unwrap();
    let large = std::env::var("LASERTRACE_TRIANGLES").ok();
    let large = large.map(|n| n.parse().expect("a number of triangles"));
    let sizes = [1e5, 1e6].into_iter().chain(large);
    let scenes: Vec<Scene> = sizes.map(waves::waves).collect();
    let made = |scene| Simulation::new(scene).unwrap();
    let simulations: Vec<Simulation> = scenes.iter().map(made).collect();
    let mut group = c.benchmark_group("throughput");
    group.sample_size(20);
    for simulation in &simulations {
        let triangles = simulation.scene.mesh.triangles.len();
        assert!(frame(simulation, 480) > SENSOR[0] / 2);
        group.bench_function(format!("frame, {triangles} triangles"), |b| {
            b.iter(|| frame(simulation, 480))
        });
    }
    for larger in &simulations[1..] {
        let triangles = larger.scene.mesh.triangles.len();
        let name = format!("frame, {triangles} triangles / 100 000");
        print_ratio(&name, 31, |i| {
            let number = 450 + i as u32;
            seconds(|| frame(larger, number)) / seconds(|| frame(&simulations[0], number))
        });
    }
    let simulation = &simulations[1];
    let clusters = TriangleClusters::new(&simulation.scene.mesh);
    let view = simulation.view(480);
    let light = irradiance(&view, &TracedRegion::Lit(&clusters));
    let near = simulation.counts_near_light(480, &light);
    let whole = simulation.counts(480, &light);
    group.bench_function("light", |b| {
        b.iter(|| irradiance(&view, &TracedRegion::Lit(&clusters)))
    });
    let mut dull = simulation.view(480);
    dull.speckle = None;
    group.bench_function("light without speckle", |b| {
        b.iter(|| irradiance(&dull, &TracedRegion::Lit(&clusters)))
    });
    group.bench_function("counts", |b| {
        b.iter(|| simulation.counts_near_light(480, &light))
    });
    group.bench_function("counts of a whole image", |b| {
        b.iter(|| simulation.counts(480, &light))
    });
    group.bench_function("peaks", |b| b.iter(|| simulation.peaks(&near)));
    group.bench_function("peaks in a whole image", |b| {
        b.iter(|| simulation.peaks(&whole))
    });
    group.bench_function("peaks, points, deviation", |b| {
        b.iter(|| simulation.measure_near_light(480, &near))
    });
    geometry(&mut group, &simulation.scene);
    against_all(simulation, &clusters);
    #[cfg(feature = "race")]
    bare::against_integrator(simulation);
    let found = batch(simulation);
    print_ratio("frames a second, two threads / one", 5, |_| {
        let one = seconds(|| assert_eq!(batch(simulation), found));
        let two = seconds(|| assert_eq!(two_threads.install(|| batch(simulation)), found));
        println!("two threads: {:.1} frames a second", TOGETHER as f64 / two);
        one / two
    });
    group.finish();
}

/// The footprint against every pixel, and against a ray for every sample of them.
fn against_all(simulation: &Simulation, clusters: &TriangleClusters) {
    let view = simulation.view(480);
    let light = irradiance(&view, &TracedRegion::Lit(clusters));
    for (name, sampling) in [
        ("every pixel / footprint", Sampling::Planes),
        ("every sample / footprint", Sampling::Rays),
    ] {
        let mut all = simulation.view(480);
        all.sampling = sampling;
        if sampling == view.sampling {
            assert_eq!(irradiance(&all, &TracedRegion::All).dense(), light.dense());
        }
        print_ratio(name, 3, |_| {
            seconds(|| irradiance(&all, &TracedRegion::All))
                / seconds(|| irradiance(&view, &TracedRegion::Lit(clusters)))
        });
    }
}

/// Laser rays without images, by the profile: the rays of a sheet.
fn geometry(
    group: &mut criterion::BenchmarkGroup<criterion::measurement::WallTime>,
    scene: &Scene,
) {
    let simulation = Simulation::geometry(scene).unwrap();
    let camera_from_laser = scene.head_from_camera.inverse() * scene.head_from_laser;
    let fan = scene.laser.fan.as_ref().unwrap();
    let sheet = LaserPlaneSampler::new(fan, &scene.camera, &camera_from_laser);
    let view = simulation.view(480);
    assert!(sheet.profile(&view).len() > SENSOR[0] / 2);
    group.throughput(criterion::Throughput::Elements(sheet.rays() as u64));
    group.bench_function("geometry alone, laser rays", |b| {
        b.iter(|| sheet.profile(&view))
    });
}

#[cfg(feature = "race")]
mod bare {
    //! The rays through the centres of all pixels, packed beforehand, by Embree
    //! alone: no shading, no f64, and no shadow rays, of which there are few.

    use super::*;
    use lasertrace::accel::WIDTH;
    use lasertrace::accel::embree_race::{BareEmbree, FlatHit, FlatRay};
    use lasertrace::math::DVec2;

    pub fn against_integrator(simulation: &Simulation) {
        let mut view = simulation.view(480);
        (view.grid, view.speckle) = (
            lasertrace::frame::PixelQuadrature::Gauss { per_side: 1 },
            None,
        );
        let mesh = &simulation.scene.mesh;
        let embree = BareEmbree::build(mesh, true, 1).unwrap();
        let eye = view.part_from_camera.translation;
        let ray = |i: usize| {
            let pixel = DVec2::new((i % SENSOR[0]) as f64 + 0.5, (i / SENSOR[0]) as f64 + 0.5);
            let direction = view.part_from_camera.vector(view.camera.direction(pixel));
            FlatRay {
                origin: eye.as_vec3().to_array(),
                direction: direction.as_vec3().to_array(),
                t_max: f32::INFINITY,
            }
        };
        let rays: Vec<FlatRay> = (0..SENSOR[0] * SENSOR[1]).map(ray).collect();
        let mut hits = vec![FlatHit::NONE; rays.len()];
        let mut trace = || {
            for (rays, hits) in rays.chunks(WIDTH).zip(hits.chunks_mut(WIDTH)) {
                embree.closest16(rays, true, hits);
            }
        };
        print_ratio("rays a second, integrator / bare Embree", 5, |_| {
            let bare = seconds(&mut trace);
            let whole = seconds(|| irradiance(&view, &TracedRegion::All));
            let rate = rays.len() as f64 / whole * 1e-6;
            println!("integrator: {rate:.2} Mrays/s");
            bare / whole
        });
        let met = hits.iter().filter(|hit| **hit != FlatHit::NONE).count();
        assert!(met > rays.len() / 2, "{met}");
    }
}

criterion_group!(benches, throughput);
criterion_main!(benches);

//! What one frame of the demo scene costs, stage by stage, on one thread. Each
//! answer is checked.

use criterion::{Criterion, criterion_group, criterion_main};
use lasertrace::accel::TriangleClusters;
use lasertrace::frame::{Irradiance, TracedRegion, irradiance};
use lasertrace::report::picture::encode_counts;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::path::Path;
use std::time::Instant;

/// A frame that crosses a counterbored hole, the step and a rib.
const FRAME: u32 = 50;

fn stages(c: &mut Criterion) {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1);
    one_thread.build_global().unwrap();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/scene.toml");
    let scene = Scene::load(&path).unwrap();
    let simulation = Simulation::new(&scene).unwrap();
    let clusters = TriangleClusters::new(&scene.mesh);
    let speckled = simulation.view(FRAME);
    let mut plain = simulation.view(FRAME);
    plain.speckle = None;

    let image = irradiance(&speckled, &TracedRegion::Lit(&clusters));
    let counts = simulation.counts(FRAME, &image);
    let columns = scene.camera.sensor.resolution.x as usize;
    let (_, points) = simulation.measure(FRAME, &counts);
    assert_eq!(image, simulation.irradiance(FRAME));
    assert!(points.len() > columns / 2, "{} points", points.len());
    // Speckle has mean 1 over ~3000 grains of the line: 5 standard deviations.
    let light = |image: &Irradiance| image.dense().iter().map(|&e| e as f64).sum::<f64>();
    let ratio = light(&image) / light(&irradiance(&plain, &TracedRegion::Lit(&clusters)));
    assert!((ratio - 1.0).abs() < 0.1, "{ratio}");

    let mut group = c.benchmark_group("frame");
    group.sample_size(30);
    group.bench_function("light without speckle", |b| {
        b.iter(|| irradiance(&plain, &TracedRegion::Lit(&clusters)))
    });
    group.bench_function("light with speckle", |b| {
        b.iter(|| irradiance(&speckled, &TracedRegion::Lit(&clusters)))
    });
    let near = simulation.counts_near_light(FRAME, &image);
    assert_eq!(simulation.measure_near_light(FRAME, &near).1, points);
    group.bench_function("counts", |b| {
        b.iter(|| simulation.counts_near_light(FRAME, &image))
    });
    group.bench_function("counts of a whole image", |b| {
        b.iter(|| simulation.counts(FRAME, &image))
    });
    group.bench_function("peaks, points, deviation", |b| {
        b.iter(|| simulation.measure_near_light(FRAME, &near))
    });
    group.bench_function("png", |b| b.iter(|| encode_counts(&counts, 1023)));
    group.finish();
    let frame = |view| {
        let start = Instant::now();
        let light = irradiance(view, &TracedRegion::Lit(&clusters));
        simulation.measure_near_light(FRAME, &simulation.counts_near_light(FRAME, &light));
        start.elapsed().as_secs_f64()
    };
    // Interleaved, so that the machine's load falls on both alike.
    let mut ratios: Vec<f64> = (0..101).map(|_| frame(&speckled) / frame(&plain)).collect();
    ratios.sort_by(f64::total_cmp);
    println!(
        "frame with speckle / without: {:.3} (median of 101 pairs; quartiles {:.3}, {:.3})",
        ratios[50], ratios[25], ratios[75]
    );
}

criterion_group!(benches, stages);
criterion_main!(benches);

//! What the peaks of one frame of the demo scene cost, by finder, on one thread. Each
//! answer is checked.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use lasertrace::profile::{PeakFinder, PeakSettings, find_peaks};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::path::Path;

/// A frame that crosses a counterbored hole, the step and a rib.
const FRAME: u32 = 50;

fn finders(c: &mut Criterion) {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1);
    one_thread.build_global().unwrap();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/scene.toml");
    let scene = Scene::load(&path).unwrap();
    let simulation = Simulation::new(&scene).unwrap();
    let counts = simulation.counts(FRAME, &simulation.irradiance(FRAME));
    let columns = counts.columns();
    let default = simulation.peak_settings();
    let found = find_peaks(&counts, &default).len();
    assert!(found > columns / 2, "{found} peaks");

    let mut group = c.benchmark_group("peaks");
    group.throughput(Throughput::Elements(columns as u64));
    for finder in PeakFinder::ALL {
        let settings = PeakSettings { finder, ..default };
        group.bench_function(format!("{finder:?}"), |b| {
            // Which lines there are is decided before any finder places them.
            b.iter(|| assert_eq!(find_peaks(&counts, &settings).len(), found))
        });
    }
    group.finish();
}

criterion_group!(benches, finders);
criterion_main!(benches);

//! Cost of one speckle reading, per method, along a row of the demo's samples (a
//! third of a pixel apart, 1.25 texels); of making a frame's field; and of making
//! a ring of slices. Each answer is checked.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use lasertrace::math::DVec2;
use lasertrace::speckle::frame_field::{FrameFields, PupilPlace, Rows};
use lasertrace::speckle::lookup::{Coherence, Coordinate, Lookup, Method};
use lasertrace::speckle::pattern::PatternSpec;
use std::hint::black_box;

/// Three samples to each of the demo's columns.
const SAMPLES: usize = 3 * 1280;
const STEP: f64 = 1.25;

/// Sum of the readings along a row at `t`, which rises a little as on a tilted
/// sensor; four at a time, as pixels take them.
#[inline(always)]
fn row_sum(t: f64, read: impl Fn([DVec2; 4]) -> [f32; 4]) -> f64 {
    let place = |i: usize| DVec2::new(STEP * i as f64, t + 0.003 * i as f64);
    (0..SAMPLES)
        .step_by(4)
        .map(|i| {
            let read = read([i, i + 1, i + 2, i + 3].map(place));
            read.iter().sum::<f32>() as f64
        })
        .sum()
}

fn readings<F: Fn([DVec2; 4]) -> [f32; 4]>(c: &mut Criterion, name: &str, read: F) {
    // 256 rows hold 9e5 readings of some 6e4 independent grains: their mean strays
    // from 1 by 0.004 (one standard deviation, contrast 1).
    let rows = (0..256).map(|row| row_sum(4.03 * row as f64, &read));
    let mean = rows.sum::<f64>() / (256 * SAMPLES) as f64;
    assert!((mean - 1.0).abs() < 0.02, "{name}: mean {mean}");
    let mut group = c.benchmark_group("lookup");
    group.throughput(Throughput::Elements(SAMPLES as u64));
    let mut t = 0.0;
    group.bench_function(name, |b| {
        b.iter(|| {
            t += 1.25;
            row_sum(black_box(t), black_box(&read))
        })
    });
    group.finish();
}

const PLACE: PupilPlace = PupilPlace {
    shift: DVec2::new(31.4, -2.7),
    defocus: 3.0,
};

fn rows(spec: &PatternSpec, count: usize) -> Rows {
    let mut rows = Rows::none(spec);
    rows.insert(0.0, count as f64);
    rows
}

fn lookups(c: &mut Criterion) {
    let spec = PatternSpec {
        slices: 32,
        ..PatternSpec::default()
    };
    let fields = FrameFields::new(&spec, Coherence::FULL).unwrap();
    let field = fields.field(&PLACE, rows(&spec, spec.size));
    readings(c, "field of a frame", |at| at.map(|at| field.intensity(at)));
    for (name, method) in [
        ("ring, trilinear", Method::Trilinear),
        ("ring, field", Method::Field),
        ("ring, prefiltered", Method::Prefiltered { q: 1.0 }),
    ] {
        let lookup = Lookup::new(&spec, method, Coherence::FULL).unwrap();
        println!("{name}: {} MB", lookup.memory() / 1_000_000);
        readings(c, name, |at| {
            at.map(|DVec2 { x: s, y: t }| lookup.intensity(Coordinate { s, t, u: 7.9 }))
        });
    }
}

fn preprocessing(c: &mut Criterion) {
    let spec = PatternSpec::default();
    let fields = FrameFields::new(&spec, Coherence::FULL).unwrap();
    let at = DVec2::splat(0.5);
    let mut group = c.benchmark_group("preprocessing");
    group.sample_size(10);
    let expected = fields.field(&PLACE, rows(&spec, spec.size)).intensity(at);
    for (name, count) in [("a quarter of", 255), ("all of", 1024)] {
        group.bench_function(format!("{name} a frame's field"), |b| {
            b.iter(|| {
                let field = fields.field(black_box(&PLACE), rows(&spec, count));
                assert_eq!(field.intensity(at), expected);
            })
        });
    }
    let at = Coordinate {
        s: 0.5,
        t: 0.5,
        u: 0.5,
    };
    let ring = || Lookup::new(black_box(&spec), Method::Field, Coherence::FULL).unwrap();
    let expected = ring().intensity(at);
    group.bench_function("ring, field", |b| {
        b.iter(|| assert_eq!(ring().intensity(at), expected))
    });
}

criterion_group!(benches, lookups, preprocessing);
criterion_main!(benches);

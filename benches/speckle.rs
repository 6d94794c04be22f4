//! Cost of one speckle lookup, per method, along a coherent row of pixels of
//! the default pattern (2048 pixels one grain apart, u drifting by a quarter
//! slice), and of making the pattern. Each answer is checked.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use lasertrace::speckle::lookup::{Coherence, Coordinate, Lookup, Method};
use lasertrace::speckle::pattern::PatternSpec;
use std::hint::black_box;

const PIXELS: usize = 2048;

fn row_sum(lookup: &Lookup, t: f64) -> f64 {
    (0..PIXELS)
        .map(|i| {
            let x = i as f64;
            lookup.intensity(Coordinate {
                s: 4.03 * x,
                t: t + 0.01 * x,
                u: 7.9 + x / 8192.0,
            }) as f64
        })
        .sum()
}

fn lookups(c: &mut Criterion) {
    let spec = PatternSpec::default();
    let methods = [
        ("trilinear", Method::Trilinear),
        ("field", Method::Field),
        ("prefiltered", Method::Prefiltered { q: 1.0 }),
    ];
    let mut group = c.benchmark_group("lookup");
    group.throughput(Throughput::Elements(PIXELS as u64));
    for (name, method) in methods {
        let lookup = Lookup::new(&spec, method, Coherence::FULL).unwrap();
        println!("{name}: {} MB", lookup.memory() / 1_000_000);
        // 64 rows hold 2^17 lookups of at least 3e4 independent grains: the
        // mean strays from 1 by 0.006 (one standard deviation, contrast 1).
        let rows = (0..64).map(|row| row_sum(&lookup, 16.3 * row as f64));
        let mean = rows.sum::<f64>() / (64 * PIXELS) as f64;
        assert!((mean - 1.0).abs() < 0.03, "{name}: mean {mean}");
        let mut t = 0.0;
        group.bench_function(name, |b| {
            b.iter(|| {
                t += 1.37;
                row_sum(black_box(&lookup), black_box(t))
            })
        });
    }
}

fn preprocessing(c: &mut Criterion) {
    let spec = PatternSpec::default();
    let at = Coordinate {
        s: 0.5,
        t: 0.5,
        u: 0.5,
    };
    let expected = Lookup::new(&spec, Method::Field, Coherence::FULL)
        .unwrap()
        .intensity(at);
    let mut group = c.benchmark_group("preprocessing");
    group.sample_size(10);
    group.bench_function("field", |b| {
        b.iter(|| {
            let lookup = Lookup::new(black_box(&spec), Method::Field, Coherence::FULL).unwrap();
            assert_eq!(lookup.intensity(at), expected);
        })
    });
}

criterion_group!(benches, lookups, preprocessing);
criterion_main!(benches);

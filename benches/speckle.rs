//! Cost of one speckle reading, per method, over the samples of a band of the demo's
//! pixels, two by two a pixel and tile by tile, as frames read them; of making a
//! frame's field; and of making a ring of slices. Each answer is checked.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use lasertrace::math::Aperture;
use lasertrace::math::DVec2;
use lasertrace::speckle::frame_field::{FrameFields, PupilPosition, field_spec};
use lasertrace::speckle::lookup::{Coherence, Coordinate, Method, SpeckleTexture};
use lasertrace::speckle::pattern::PatternSpec;
use std::hint::black_box;

/// The demo's pixels in a row.
const PIXELS: usize = 1280;
/// Texels of a ring between a pixel and the next.
const PITCH: f64 = 3.75;
const SAMPLES: usize = 4;

/// Side of a tile, pixels.
const TILE: usize = 4;

/// Sum of the readings of a band of tiles at `t`, which rises a little as on a tilted
/// sensor; `read` adds up a pixel's.
#[inline(always)]
fn band_sum(t: f64, read: impl Fn(DVec2) -> f32) -> f64 {
    let mut sum = 0.0;
    for first in (0..PIXELS).step_by(TILE) {
        for i in 0..TILE * TILE {
            let (column, row) = ((first + i % TILE) as f64, (i / TILE) as f64);
            sum += read(DVec2::new(PITCH * column, t + PITCH * row + 0.01 * column)) as f64;
        }
    }
    sum
}

fn readings(c: &mut Criterion, name: &str, read: impl Fn(DVec2) -> f32) {
    // 64 bands hold 1e6 readings of some 6e4 independent grains (2e4 of a frame's
    // field): their mean strays from 1 by 0.007 (one standard deviation, contrast 1).
    let bands = (0..64).map(|band| band_sum(16.12 * band as f64, &read));
    let mean = bands.sum::<f64>() / (64 * TILE * PIXELS * SAMPLES) as f64;
    assert!((mean - 1.0).abs() < 0.02, "{name}: mean {mean}");
    let mut group = c.benchmark_group("lookup");
    group.throughput(Throughput::Elements((TILE * PIXELS * SAMPLES) as u64));
    let mut t = 0.0;
    group.bench_function(name, |b| {
        b.iter(|| {
            t += TILE as f64 * PITCH;
            band_sum(black_box(t), black_box(&read))
        })
    });
    group.finish();
}

/// The place of a pixel's sample from its centre, texels of a ring: the nodes of
/// Gauss–Legendre quadrature.
fn offset(i: usize) -> DVec2 {
    let side = |bit: usize| if bit == 0 { -0.288_675 } else { 0.288_675 };
    DVec2::new(side(i & 1), side(i >> 1)) * PITCH
}

const PLACE: PupilPosition = PupilPosition {
    shift: DVec2::new(31.4, -2.7),
    defocus: 3.0,
};

fn frame_fields() -> FrameFields {
    FrameFields::new(&field_spec(0, Aperture::Circle), Coherence::FULL).unwrap()
}

fn lookups(c: &mut Criterion) {
    let spec = PatternSpec {
        slices: 32,
        ..PatternSpec::default()
    };
    let fields = frame_fields();
    let field = fields.field(&PLACE);
    let map = fields.map(4.0, 1.0);
    readings(c, "field of a frame, each", |at| {
        let at = map.displacement(at);
        let read = |i| field.intensity(at + map.displacement(offset(i)));
        (0..SAMPLES).map(read).sum()
    });
    let places = [0, 1, 2, 3].map(|i| map.displacement(offset(i)).as_vec2());
    let (s, t) = (places.map(|p| p.x).into(), places.map(|p| p.y).into());
    readings(c, "field of a frame", |at| {
        field
            .around(map.displacement(at), s, t, SAMPLES)
            .reduce_add()
    });
    for (name, method) in [
        ("ring, trilinear", Method::Trilinear),
        ("ring, field", Method::Field),
    ] {
        let lookup = SpeckleTexture::new(&spec, method, Coherence::FULL).unwrap();
        println!("{name}: {} MB", lookup.memory() / 1_000_000);
        readings(c, name, |at| {
            let read = |i| {
                let DVec2 { x: s, y: t } = at + offset(i);
                lookup.intensity(Coordinate { s, t, u: 7.9 })
            };
            (0..SAMPLES).map(read).sum()
        });
    }
}

fn preprocessing(c: &mut Criterion) {
    let spec = PatternSpec::default();
    let fields = frame_fields();
    let at = DVec2::splat(0.5);
    let mut group = c.benchmark_group("preprocessing");
    group.sample_size(10);
    let expected = fields.field(&PLACE).intensity(at);
    group.bench_function("a frame's field", |b| {
        b.iter(|| assert_eq!(fields.field(black_box(&PLACE)).intensity(at), expected))
    });
    let at = Coordinate {
        s: 0.5,
        t: 0.5,
        u: 0.5,
    };
    let ring = || SpeckleTexture::new(black_box(&spec), Method::Field, Coherence::FULL).unwrap();
    let expected = ring().intensity(at);
    group.bench_function("ring, field", |b| {
        b.iter(|| assert_eq!(ring().intensity(at), expected))
    });
}

criterion_group!(benches, lookups, preprocessing);
criterion_main!(benches);

//! Patterns against real speckle: a digital hologram of a rough object,
//! reconstructed through square apertures of three sizes, and the pattern of
//! the same aperture, both put through the same estimators.

use lasertrace::math::Aperture;
use lasertrace::math::DVec2;
use lasertrace::speckle::pattern::{PatternSpec, PhasorPlane};
use rayon::prelude::*;
use rustfft::FftPlanner;
use rustfft::num_complex::Complex32;
use std::ops::Range;
use std::path::PathBuf;

const WAVELENGTH_MM: f64 = 633e-6;
const PIXEL_MM: f64 = 5e-3;
const DISTANCE_MM: f64 = 450.0;

/// Texels per grain, of the reconstruction and of the pattern.
const TEXELS: usize = 4;

/// The evenly lit part of the object, as shares of the reconstructed field.
const REGION: [Range<f64>; 2] = [0.262..0.359, -0.305..-0.168];

/// Side of the square whose mean is taken for the local mean, texels: large
/// enough to hold 64 grains, small against the object's shading.
const WINDOW: usize = 8 * TEXELS;

struct Hologram {
    size: [usize; 2],
    /// Interference, without its mean.
    signal: Vec<f64>,
}

/// Part of an intensity picture.
struct Picture {
    size: [usize; 2],
    intensity: Vec<f64>,
}

/// Contrast, width of the autocovariance (texels) and P(I > 2⟨I⟩).
type Figures = [f64; 3];

#[test]
fn patterns_lie_within_the_band_of_a_real_hologram() {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../shared/data/speckle/pyDHM_horse_hologram.bmp");
    let Ok(bytes) = std::fs::read(&path) else {
        eprintln!(
            "\n*** NOT TESTED: {} is absent, no real speckle to compare with ***\n",
            path.display()
        );
        return;
    };
    let hologram = equalised(read_bmp(&bytes));
    // (aperture in pixels, blocks the region is cut into)
    for (aperture, blocks) in [(1024, 4), (512, 2), (256, 1)] {
        let real = real_figures(&hologram, aperture, blocks);
        let region = REGION.map(|r| ((r.end - r.start) * (TEXELS * aperture) as f64) as usize);
        let ours = pattern_figures(region, blocks);
        let side = aperture as f64 * PIXEL_MM;
        let texel_um = 1e3 * WAVELENGTH_MM * DISTANCE_MM / (side * TEXELS as f64);
        println!(
            "aperture {side:.2} mm: {} real and {} simulated samples",
            real.len(),
            ours.len()
        );
        let names = ["contrast", "autocovariance FWHM, um", "P(I > 2<I>)"];
        for (i, scale) in [1.0, texel_um, 1.0].into_iter().enumerate() {
            let figure = |samples: &[Figures]| mean_and_error(samples.iter().map(|s| s[i] * scale));
            let ((real, real_error), (ours, our_error)) = (figure(&real), figure(&ours));
            // The band: four standard errors of the difference, from the
            // scatter of the samples. Samples are apart in the object or seen
            // through apertures apart: their grains are independent.
            let band = 4.0 * real_error.hypot(our_error);
            println!(
                "  {}: real {real:.4}, pattern {ours:.4}, band ±{band:.4}",
                names[i]
            );
            assert!(
                (ours - real).abs() <= band,
                "{side} mm, {}: {ours}, not {real} ± {band}",
                names[i]
            );
            // A band wide enough for anything would prove nothing.
            assert!(
                band < 0.15 * real,
                "{side} mm, {}: ±{band} of {real}",
                names[i]
            );
        }
    }
}

/// Header by header: 8 bits a pixel, uncompressed, grey palette. Rows are kept
/// as stored, bottom first: the mirrored picture has the same statistics.
fn read_bmp(bytes: &[u8]) -> Hologram {
    let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!(&bytes[..2], b"BM");
    let (data, header) = (u32_at(10), u32_at(14));
    let size = [u32_at(18), u32_at(22)];
    assert_eq!(
        u16::from_le_bytes([bytes[28], bytes[29]]),
        8,
        "bits a pixel"
    );
    assert_eq!(u32_at(30), 0, "compression");
    let palette = &bytes[14 + header..data];
    let grey = |(i, entry): (usize, &[u8])| entry[..3] == [i as u8; 3];
    assert!(palette.chunks_exact(4).enumerate().all(grey));
    let stride = size[0].next_multiple_of(4);
    let rows = bytes[data..].chunks_exact(stride).take(size[1]);
    let pixels: Vec<u8> = rows.flat_map(|row| &row[..size[0]]).copied().collect();
    assert_eq!(pixels.len(), size[0] * size[1]);
    let level = pixels.iter().map(|p| *p as f64).sum::<f64>() / pixels.len() as f64;
    let signal = pixels.iter().map(|p| *p as f64 - level).collect();
    Hologram { size, signal }
}

/// The fringes are 2.5 times stronger in power in one corner than in the
/// opposite one; unequal transmission makes grains larger, by 2 % for 5.12 mm.
/// The pattern's pupil transmits evenly, so the fringes are evened out: by the
/// plane through the logarithm of the power that small apertures collect from
/// the region.
fn equalised(mut hologram: Hologram) -> Hologram {
    let side = 128;
    let [width, height] = hologram.size;
    let [columns, rows] = hologram.size.map(|n| n / side);
    let centre = |i: usize, count: usize| i as f64 - (count as f64 - 1.0) / 2.0;
    let [mut along, mut across] = [[0.0; 2]; 2];
    for (i, j) in (0..columns * rows).map(|i| (i % columns, i / columns)) {
        let picture = reconstruct(&hologram, [i * side, j * side], side);
        let power = picture.intensity.iter().sum::<f64>().ln();
        let (x, y) = (centre(i, columns), centre(j, rows));
        along = [along[0] + x * power, along[1] + x * x];
        across = [across[0] + y * power, across[1] + y * y];
    }
    let [along, across] = [along, across].map(|[product, square]| product / square);
    for (i, value) in hologram.signal.iter_mut().enumerate() {
        let (x, y) = (centre(i % width, width), centre(i / width, height));
        *value *= (-0.5 * (along * x + across * y) / side as f64).exp();
    }
    hologram
}

/// Figures of the region seen through every aperture of `side` pixels that
/// fits into the hologram beside the others.
fn real_figures(hologram: &Hologram, side: usize, blocks: usize) -> Vec<Figures> {
    let [columns, rows] = hologram.size.map(|n| n / side);
    (0..columns * rows)
        .into_par_iter()
        .flat_map_iter(|i| {
            let corner = [i % columns * side, i / columns * side];
            figures(&reconstruct(hologram, corner, side), blocks)
        })
        .collect()
}

/// Intensity in the region by the Fresnel transform of one aperture: the
/// hologram times the chirp exp(iπr²/λz), Fourier transformed with TEXELS
/// samples per λz/side.
fn reconstruct(hologram: &Hologram, corner: [usize; 2], side: usize) -> Picture {
    let n = TEXELS * side;
    let [width, height] = hologram.size;
    let chirp = |x: usize, y: usize| {
        let r = DVec2::new(
            x as f64 - width as f64 / 2.0,
            y as f64 - height as f64 / 2.0,
        ) * PIXEL_MM;
        let phase = std::f64::consts::PI * r.length_squared() / (WAVELENGTH_MM * DISTANCE_MM);
        DVec2::from_angle(phase % std::f64::consts::TAU)
    };
    let fft = FftPlanner::new().plan_fft_forward(n);
    let indices = REGION.map(|r| {
        let index =
            move |i: usize| ((r.start * n as f64) as i64 + i as i64).rem_euclid(n as i64) as usize;
        (0..((r.end - r.start) * n as f64) as usize)
            .map(index)
            .collect::<Vec<usize>>()
    });
    // Along x for every row of the aperture, of which only the region's
    // columns are kept; then along y for each of those.
    let mut columns = vec![vec![Complex32::ZERO; n]; indices[0].len()];
    for y in 0..side {
        let mut line = vec![Complex32::ZERO; n];
        for (x, value) in line[..side].iter_mut().enumerate() {
            let (x, y) = (corner[0] + x, corner[1] + y);
            let field = chirp(x, y) * hologram.signal[y * width + x];
            *value = Complex32::new(field.x as f32, field.y as f32);
        }
        fft.process(&mut line);
        for (column, &x) in columns.iter_mut().zip(&indices[0]) {
            column[y] = line[x];
        }
    }
    for column in &mut columns {
        fft.process(column);
    }
    let size = [indices[0].len(), indices[1].len()];
    let rows = indices[1].iter();
    let intensity = rows.flat_map(|&y| columns.iter().map(move |c| c[y].norm_sqr() as f64));
    Picture {
        size,
        intensity: intensity.collect(),
    }
}

/// The same figures of our pattern of a square pupil, from pictures of the
/// same size.
fn pattern_figures(region: [usize; 2], blocks: usize) -> Vec<Figures> {
    let spec = |seed| PatternSpec {
        size: 1024,
        texels_per_speckle: TEXELS as f64,
        aperture: Aperture::Square,
        seed,
        ..PatternSpec::default()
    };
    let pictures = |seed| {
        let pattern = PhasorPlane::new(&spec(seed)).pattern(DVec2::ZERO);
        let [columns, rows] = region.map(|n| pattern.size / n);
        let cut = move |i: usize| {
            let (x0, y0) = (i % columns * region[0], i / columns * region[1]);
            let texels = (0..region[1]).flat_map(|y| (0..region[0]).map(move |x| (x, y)));
            let at = |(x, y): (usize, usize)| {
                pattern.field[(y0 + y) * pattern.size + x0 + x].norm_sqr() as f64
            };
            Picture {
                size: region,
                intensity: texels.map(at).collect(),
            }
        };
        (0..columns * rows)
            .map(cut)
            .flat_map(|picture| figures(&picture, blocks))
            .collect::<Vec<_>>()
    };
    (0..8).into_par_iter().flat_map_iter(pictures).collect()
}

/// Figures of blocks × blocks parts of a picture divided by its local mean.
fn figures(picture: &Picture, blocks: usize) -> Vec<Figures> {
    let flat = flattened(picture);
    let [width, height] = flat.size.map(|n| n / blocks);
    let block = |i: usize| {
        let (x0, y0) = (i % blocks * width, i / blocks * height);
        let rows = (0..height).map(|y| &flat.intensity[(y0 + y) * flat.size[0] + x0..][..width]);
        block_figures(&rows.collect::<Vec<_>>())
    };
    (0..blocks * blocks).map(block).collect()
}

/// Intensity over the mean of the WINDOW² texels about it, where they all lie
/// in the picture.
fn flattened(picture: &Picture) -> Picture {
    let [width, height] = picture.size;
    let mut sums = vec![0.0; (width + 1) * (height + 1)];
    for y in 0..height {
        let mut row = 0.0;
        for x in 0..width {
            row += picture.intensity[y * width + x];
            sums[(y + 1) * (width + 1) + x + 1] = sums[y * (width + 1) + x + 1] + row;
        }
    }
    let size = picture.size.map(|n| n - WINDOW);
    let at = |x: usize, y: usize| sums[y * (width + 1) + x];
    let ratio = |(x, y): (usize, usize)| {
        let (right, below) = (x + WINDOW, y + WINDOW);
        let sum = at(right, below) - at(x, below) - at(right, y) + at(x, y);
        let centre = picture.intensity[(y + WINDOW / 2) * width + x + WINDOW / 2];
        centre * (WINDOW * WINDOW) as f64 / sum
    };
    let points = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (x, y)));
    Picture {
        size,
        intensity: points.map(ratio).collect(),
    }
}

fn block_figures(rows: &[&[f64]]) -> Figures {
    let count = (rows.len() * rows[0].len()) as f64;
    let all = || rows.iter().flat_map(|row| row.iter());
    let mean = all().sum::<f64>() / count;
    let bright = all().filter(|i| **i > 2.0 * mean).count() as f64 / count;
    // Mean covariance of texels `lag` apart along rows and along columns.
    let covariance = |lag: usize| {
        let product = |(a, b): (&f64, &f64)| (a - mean) * (b - mean);
        let along: f64 = rows
            .iter()
            .flat_map(|row| row.iter().zip(&row[lag..]))
            .map(product)
            .sum();
        let across = rows.iter().zip(&rows[lag..]);
        let across: f64 = across
            .flat_map(|(a, b)| a.iter().zip(b.iter()))
            .map(product)
            .sum();
        let lost = (lag * rows.len()) as f64;
        let lost_across = (lag * rows[0].len()) as f64;
        (along / (count - lost) + across / (count - lost_across)) / 2.0
    };
    let variance = covariance(0);
    let values: Vec<f64> = (0..TEXELS).map(|lag| covariance(lag) / variance).collect();
    let beyond = values
        .iter()
        .position(|c| *c < 0.5)
        .expect("grains of four texels");
    let (above, below) = (values[beyond - 1], values[beyond]);
    let half_width = (beyond - 1) as f64 + (above - 0.5) / (above - below);
    [variance.sqrt() / mean, 2.0 * half_width, bright]
}

fn mean_and_error(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let values: Vec<f64> = values.collect();
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt())
}

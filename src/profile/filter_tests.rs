use super::*;
use crate::camera::CameraModel;
use crate::math::rng::{KeyStream, Purpose, RngKey};
use crate::math::{DVec3, Rigid};
use glam::UVec2;
use rand_distr::{Distribution, StandardNormal};

const COLUMNS: usize = 1000;
const PROFILES: u64 = 48;
/// Correlation of white noise filtered with the weights 1, 2, 1.
const RHO: [f64; 3] = [1.0, 4.0 / 6.0, 1.0 / 6.0];
/// Speckle change between frames: half of the speckle variance is independent in every frame.
const FRAMES: [FrameStep; 4] = [FrameStep {
    across: 0.0,
    kept: 0.5,
}; 4];
const SPECKLE: f64 = 0.2;
const NOISE: f64 = 0.1;

/// Returns a camera that views the laser plane perpendicularly, 0.1 mm per pixel.
fn calibration() -> Calibration {
    let camera = CameraModel {
        resolution: UVec2::new(COLUMNS as u32, 1000),
        pixel_pitch: 5e-3,
        principal_distance: 50.0,
        principal_point: DVec2::splat(500.0),
        tilt: DVec2::ZERO,
        distortion: None,
    };
    Calibration::perfect(camera, Rigid::IDENTITY, DVec3::Z * 1000.0, DVec3::Z)
}

fn filter(filters: Filters) -> ProfileFilter {
    let share = NOISE.powi(2) / (NOISE.powi(2) + SPECKLE.powi(2));
    ProfileFilter::new(filters, RHO.to_vec(), FRAMES.to_vec(), share, calibration())
}

fn speckle(stream: &mut KeyStream) -> Vec<f64> {
    let white: Vec<f64> = (0..COLUMNS + 2)
        .map(|_| StandardNormal.sample(stream))
        .collect();
    let sum = |w: &[f64]| (w[0] + 2.0 * w[1] + w[2]) / 6f64.sqrt();
    white.windows(3).map(sum).collect()
}

/// Returns simulated frames of a profile with true rows `truth` and the stated errors.
fn drawn(profile: u64, frames: usize, truth: impl Fn(f64) -> f64) -> Vec<Vec<MeasuredRow>> {
    let key = RngKey::new(profile, Purpose::SensorNoise);
    let stays = speckle(&mut key.with(1000).counter_stream());
    let frame = |frame: usize| {
        let mut stream = key.with(frame as u64).counter_stream();
        let anew = speckle(&mut stream);
        let half = if frames == 1 { 0.0 } else { 0.5f64.sqrt() };
        let row = |column: usize| {
            let noise: f64 = StandardNormal.sample(&mut stream);
            let rest = (1.0 - half * half).sqrt();
            let speckle = half * stays[column] + rest * anew[column];
            MeasuredRow {
                column: column as u32,
                row: truth(column as f64) + SPECKLE * speckle + NOISE * noise,
                speckle: SPECKLE,
                noise: NOISE,
                pattern: 0.0,
                width: 1.0,
                drift: Drift::FINE,
                averaged: 1.0,
            }
        };
        (0..COLUMNS).map(row).collect()
    };
    (0..frames).map(frame).collect()
}

/// Number of 95 % intervals, number of intervals that contain the truth, and effective number of
/// independent intervals.
#[derive(Default)]
struct Held {
    all: f64,
    held: f64,
    independent: f64,
}

impl Held {
    fn add(&mut self, row: &DeliveredRow, truth: impl Fn(f64) -> f64) {
        let error = row.place.y - truth(row.place.x - 0.5);
        self.all += 1.0;
        self.held += f64::from(u8::from(error.abs() <= 1.96 * row.speckle.hypot(row.noise)));
        self.independent += 1.0 / row.correlation_length_columns.max(1.0);
    }

    /// Asserts that 95 % of the intervals contain the truth.
    ///
    /// The tolerance is four binomial standard deviations (exceeded by 1 of 16 000 samples) plus
    /// the effect of the stated variance error. A relative error e of the variance changes the
    /// fraction by 2·1.96·φ(1.96)·e/2 = 0.115 e.
    fn assert_95(&self, name: &str, variance_error: f64) {
        let share = self.held / self.all;
        let tolerance = 4.0 * (0.95 * 0.05 / self.independent).sqrt() + 0.115 * variance_error;
        let text = format!("{name}: {share:.4} of {} ± {tolerance:.4}", self.all);
        println!("{text}");
        assert!((share - 0.95).abs() <= tolerance, "{text}");
    }
}

fn held(
    filters: Filters,
    truth: impl Fn(f64) -> f64 + Copy,
    change: impl Fn(&mut Vec<MeasuredRow>),
    of: impl Fn(&DeliveredRow) -> bool,
) -> Held {
    let filter = filter(filters);
    let mut held = Held::default();
    for profile in 0..PROFILES {
        let mut frames = drawn(profile, filters.average_frames as usize, truth);
        frames.iter_mut().for_each(&change);
        let rows = filter.apply(&frames);
        rows.iter()
            .filter(|row| of(row))
            .for_each(|row| held.add(row, truth));
    }
    held
}

/// Means over frames keep errors of the pixel pattern where the lines of all frames cover equal
/// pixels, and average them where the lines are far apart. √2 line widths apart, the correlation
/// exp(−u²/4)·(1 − u²/2) is 0; 2 widths apart it is −1/e.
#[test]
fn pixel_patterns_remain_in_means_over_frames_of_equal_rows() {
    let filters = Filters {
        average_frames: 2,
        ..NONE
    };
    let filter = filter(filters);
    let correlations = [
        (0.0, 1.0),
        (2f64.sqrt(), 0.0),
        (2.0, -1f64.exp().recip()),
        (40.0, 0.0),
    ];
    for (apart, correlation) in correlations {
        let frames = [0.0, apart].map(|widths| {
            vec![MeasuredRow {
                column: 5,
                row: 100.0 + 3.0 * widths,
                speckle: 0.0,
                noise: 0.4,
                pattern: 0.3,
                width: 3.0,
                drift: Drift::FINE,
                averaged: 1.0,
            }]
        });
        let row = filter.apply(&frames)[0];
        let expected = 0.09 * (1.0 + correlation) / 2.0;
        assert!(
            (row.pattern.powi(2) - expected).abs() < 1e-12,
            "{apart}: {}",
            row.pattern
        );
        assert!((row.noise.powi(2) - 0.16 / 2.0).abs() < 1e-12);
        assert!(row.speckle < 1e-9);
    }
}

fn nothing(_: &mut Vec<MeasuredRow>) {}
fn all(_: &DeliveredRow) -> bool {
    true
}
fn slope(column: f64) -> f64 {
    100.0 + 0.3 * column
}

/// Removes three of every twenty columns.
fn with_gaps(rows: &mut Vec<MeasuredRow>) {
    rows.retain(|row| row.column % 20 > 2);
}

const NONE: Filters = Filters {
    outlier: None,
    average_frames: 1,
    fill: None,
    smooth: None,
    resample: None,
};

#[test]
fn intervals_hold_the_truth_of_planes_after_each_linear_filter() {
    held(NONE, slope, nothing, all).assert_95("as measured", 0.0);
    let mean = Filters {
        smooth: Some(Smooth::Mean(7)),
        ..NONE
    };
    held(mean, slope, nothing, all).assert_95("mean of 7", 0.0);
    held(mean, slope, with_gaps, all).assert_95("mean of 7 beside gaps", 0.0);
    let average = Filters {
        average_frames: 4,
        ..NONE
    };
    held(average, slope, nothing, all).assert_95("4 frames", 0.0);
    let fill = Filters {
        fill: Some(0.5),
        ..NONE
    };
    let filled = held(fill, slope, with_gaps, |row| row.filled);
    assert_eq!(filled.all, (PROFILES * 3 * 49) as f64);
    filled.assert_95("filled", 0.0);
    let resample = Filters {
        resample: Some(0.073),
        ..NONE
    };
    held(resample, slope, nothing, all).assert_95("resampled", 0.0);
    let every = Filters {
        outlier: Some(0.5),
        average_frames: 4,
        fill: Some(0.5),
        smooth: Some(Smooth::Mean(5)),
        resample: Some(0.25),
    };
    held(every, slope, with_gaps, all).assert_95("all of them", 0.0);
}

/// The variance ratio of the median is simulated to 2 %, and the slope lies between tabulated
/// slopes. The measured slope is uncertain too. The total variance error is 5 %.
#[test]
fn intervals_hold_the_truth_of_planes_after_a_median() {
    let median = Filters {
        smooth: Some(Smooth::Median(7)),
        ..NONE
    };
    held(median, |_| 400.0, nothing, all).assert_95("median of 7, level", 0.05);
    held(median, |c| 100.0 + 0.05 * c, nothing, all).assert_95("median of 7, gentle", 0.05);
    held(median, slope, nothing, all).assert_95("median of 7, steep", 0.05);
    let resampled = Filters {
        resample: Some(0.1),
        ..median
    };
    // Resampling combines two medians with the correlation of means.
    held(resampled, slope, nothing, all).assert_95("and resampled", 0.1);
}

/// The remaining errors are truncated at the limit, so at least 95 % of the intervals contain the
/// truth.
#[test]
fn outliers_go_and_nothing_else() {
    let spoil = |rows: &mut Vec<MeasuredRow>| {
        rows[10..]
            .iter_mut()
            .step_by(37)
            .for_each(|row| row.row += 30.0);
    };
    let outlier = Filters {
        outlier: Some(0.15),
        ..NONE
    };
    let found = held(outlier, slope, spoil, all);
    // 27 of 1000 columns are outliers. A limit of 1.5 px is six standard deviations of the
    // difference.
    assert_eq!(found.all, (PROFILES * (1000 - 27)) as f64);
    found.assert_95("without outliers", 0.0);
}

/// The stated Σ_k ρ_k of delivered rows agrees with the scatter of means over many columns.
#[test]
fn the_correlation_is_what_means_over_columns_say() {
    for (name, smooth) in [
        ("none", None),
        ("mean", Some(Smooth::Mean(5))),
        ("median", Some(Smooth::Median(5))),
        ("gaussian", Some(Smooth::Gaussian(1.5))),
    ] {
        let filter = filter(Filters { smooth, ..NONE });
        const TOGETHER: usize = 100;
        let (mut squares, mut predicted, mut count) = (0.0, 0.0, 0.0);
        for profile in 0..6 * PROFILES {
            let rows = filter.apply(&drawn(profile, 1, |_| 400.0));
            for rows in rows.chunks_exact(TOGETHER) {
                let mean =
                    rows.iter().map(|row| row.place.y - 400.0).sum::<f64>() / TOGETHER as f64;
                let row = rows[TOGETHER / 2];
                squares += mean * mean;
                let variance = row.speckle.powi(2) + row.noise.powi(2);
                predicted += variance * row.correlation_length_columns / TOGETHER as f64;
                count += 1.0;
            }
        }
        let ratio = squares / predicted;
        // With 2880 means, 4·√(2/2880) = 0.11. The ends of a block reduce the sum by
        // 2·Σ|k|ρ_k/100/n_c < 0.05.
        println!("{name}: {ratio:.3} of {count}");
        assert!((ratio - 1.0).abs() < 0.16, "{name}: {ratio}");
    }
}

/// Intervals contain the truth at a distance of half a window from a step of 8 σ. Within half a
/// window, points are smeared, and shifts greater than noise explains are flagged.
#[test]
fn smoothing_over_a_step_is_told() {
    let step = |column: f64| if column < 500.0 { 400.0 } else { 410.0 };
    for (name, smooth) in [("mean", Smooth::Mean(7)), ("median", Smooth::Median(7))] {
        let filters = Filters {
            smooth: Some(smooth),
            ..NONE
        };
        let near = |row: &DeliveredRow| (row.place.x - 500.0).abs() < 3.0;
        held(filters, step, nothing, |row| !near(row)).assert_95(name, 0.05);
        let smeared = held(filters, step, nothing, |row| near(row) && !row.moved);
        let told = held(filters, step, nothing, |row| near(row) && row.moved);
        println!(
            "{name}, within half a window of a step: {} told, of the {} others {:.3} hold",
            told.all,
            smeared.all,
            smeared.held / smeared.all.max(1.0)
        );
        match smooth {
            // Six columns per profile have at least one seventh of the weight on the other side:
            // 1.4 px, 6.4 σ.
            Smooth::Mean(_) => assert!(told.all >= 0.99 * 6.0 * PROFILES as f64),
            // A median selects a row of the correct side, at worst the uppermost of them.
            _ => assert!(told.all == 0.0 && smeared.held > 0.7 * smeared.all),
        }
    }
    // On a plane, no point is flagged except by chance (1 in 16 000).
    let mean = Filters {
        smooth: Some(Smooth::Mean(7)),
        ..NONE
    };
    let told = held(mean, slope, nothing, |row| row.moved);
    assert!(told.all < 20.0, "{}", told.all);
}

#[test]
fn resampled_points_lie_at_even_places() {
    let filter = filter(Filters {
        resample: Some(0.25),
        ..NONE
    });
    let rows = filter.apply(&drawn(1, 1, slope));
    for row in &rows {
        let along = filter.along(row.place).unwrap() / 0.25;
        assert!((along - along.round()).abs() < 1e-9);
    }
    // The points extend from −49.95 to 49.95 mm.
    assert_eq!(rows.len(), 399);
    assert!(filter.apply(&[Vec::new()]).is_empty());
}

/// The scatter of a median under constant speckle and independent noise agrees with the stated
/// `noise`.
///
/// The noise ranges from a tenth of the speckle, where the median has the noise of one row, to
/// values above the speckle. The sample has 8 pairs of profiles of 1000 columns, a quarter of them
/// independent. The ratio of the two variances then has a standard error of √(2/2000) = 0.03. The
/// tolerance of 0.16 is four standard errors plus 4 % for the simulated ratios.
#[test]
fn a_median_repeats_as_stated() {
    for (i, noise) in [0.02, 0.05, 0.1, 0.4].into_iter().enumerate() {
        for columns in [3, 7, 11] {
            let share = noise * noise / (noise * noise + SPECKLE.powi(2));
            let filters = Filters {
                smooth: Some(Smooth::Median(columns)),
                ..NONE
            };
            let filter =
                ProfileFilter::new(filters, RHO.to_vec(), FRAMES.to_vec(), share, calibration());
            let (mut squares, mut stated) = (0.0, 0.0);
            for profile in 0..8 {
                let key = RngKey::new(profile, Purpose::SensorNoise).with(i as u64);
                let stays = speckle(&mut key.with(9).counter_stream());
                let rows = [0, 1].map(|image| {
                    let mut stream = key.with(image).counter_stream();
                    let row = |column: usize| {
                        let drawn: f64 = StandardNormal.sample(&mut stream);
                        MeasuredRow {
                            column: column as u32,
                            row: 400.0
                                + 0.01 * column as f64
                                + SPECKLE * stays[column]
                                + noise * drawn,
                            speckle: SPECKLE,
                            noise,
                            pattern: 0.0,
                            width: 1.0,
                            drift: Drift::FINE,
                            averaged: 1.0,
                        }
                    };
                    filter.apply(&[(0..COLUMNS).map(row).collect()])
                });
                for (a, b) in rows[0].iter().zip(&rows[1]) {
                    squares += (a.place.y - b.place.y).powi(2) / 2.0;
                    stated += (a.noise.powi(2) + b.noise.powi(2)) / 2.0;
                }
            }
            let ratio = squares / stated;
            println!("noise {noise}, median of {columns}: {ratio:.3}");
            assert!((ratio - 1.0).abs() < 0.16, "{noise}, {columns}: {ratio}");
        }
    }
}

//! What sensors do to profiles before they deliver them, and what is then known of their errors.
//!
//! Each delivered row is a sum of measured ones, Σ w_i·y_i. Its variance is
//! Σ w_i·w_j·s_i·s_j·ρ(|c_i − c_j|) + Σ w_i²·n_i², s the part of a row's standard uncertainty that is alike in
//! neighbouring columns (speckle; and what edges and bends do), ρ its correlation over columns, and n the noise of each by itself.

use super::Calibration;
use super::median_variance::MedianVariance;
use crate::math::DVec2;
use serde::Serialize;

/// What is done to profiles, in this order. Lengths in mm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Filters {
    /// Takes out rows whose point lies further than this from the median of the [`OUTLIER_COLUMNS`] around.
    pub outlier: Option<f64>,
    /// Frames whose profiles make one, column by column.
    pub average_frames: u32,
    /// Fills gaps along the profile up to this length by the line between the points on either side.
    pub fill: Option<f64>,
    /// Along the profile.
    pub smooth: Option<Smooth>,
    /// Distance of the points along the profile, which then lie at whole multiples of it.
    pub resample: Option<f64>,
}

impl Default for Filters {
    fn default() -> Filters {
        Filters {
            outlier: None,
            average_frames: 1,
            fill: None,
            smooth: None,
            resample: None,
        }
    }
}

/// Over so many columns, an odd number. A column counts if the one as far off on the other side is there too, so that a
/// straight line stays where it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Smooth {
    /// The mean.
    Mean(u32),
    /// The value in the middle.
    Median(u32),
}

impl Smooth {
    fn half(self) -> u32 {
        let (Smooth::Mean(columns) | Smooth::Median(columns)) = self;
        columns / 2
    }
}

/// Columns around a row that say whether it is an outlier, itself left out.
pub const OUTLIER_COLUMNS: u32 = 8;
/// Standard uncertainties of the two rows by which smoothing may move a row for its noise: by more, the window holds an
/// edge or a bend. Of Gaussian errors 1 in 16 000 does.
const MOVED_SIGMAS: f64 = 4.0;

/// A row as it was measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProfileRow {
    /// Column of the image.
    pub column: u32,
    /// The line's row there, px.
    pub row: f64,
    /// Standard uncertainty but for noise, px.
    pub speckle: f64,
    /// What each image draws anew, px.
    pub noise: f64,
    /// How `speckle` correlates with that of frames in which the surface lies elsewhere.
    pub drift: Drift,
    /// Mean variance of the frames' rows over that of their mean; 1 for a single frame.
    pub averaged: f64,
}

/// How errors by speckle correlate while the surface moves across the laser sheet.
///
/// A pattern that moves by u standard deviations of the line under the line gives rows that correlate by
/// exp(−a·u²)·(1 − c·u²). For grains much finer than the line a = ¼ and c = ½.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// a.
    pub decay: f64,
    /// c.
    pub turn: f64,
}

impl Drift {
    /// The limit of grains much finer than the line.
    pub const FINE: Drift = Drift {
        decay: 0.25,
        turn: 0.5,
    };

    /// Correlation of the errors of one place in two frames.
    pub fn correlation(&self, step: &FrameStep) -> f64 {
        let square = step.across.powi(2);
        step.kept * (-self.decay * square).exp() * (1.0 - self.turn * square)
    }
}

/// Change of speckle from one frame to another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameStep {
    /// Way of the surface across the laser sheet, in standard deviations of its light.
    pub across: f64,
    /// Correlation of the light that remains where the surface does not move across the sheet.
    pub kept: f64,
}

/// A row as it is delivered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeliveredRow {
    /// (column, row) on the sensor; between columns where profiles are resampled.
    pub place: DVec2,
    /// As of a [`ProfileRow`].
    pub speckle: f64,
    /// As of a [`ProfileRow`].
    pub noise: f64,
    /// Σ_k ρ_k over the correlation of delivered errors k columns apart.
    pub correlated_columns: f64,
    /// As of a [`ProfileRow`].
    pub averaged: f64,
    /// Whether it fills a gap.
    pub filled: bool,
    /// Whether smoothing moved it further than noise does.
    pub moved: bool,
}

/// Filters with what they must know of errors.
#[derive(Debug, Clone)]
pub struct ProfileFilter {
    filters: Filters,
    /// Correlation of `speckle` over columns, from 0 apart on.
    columns: Vec<f64>,
    /// From frames 0 apart on.
    frames: Vec<FrameStep>,
    median: Option<MedianVariance>,
    calibration: Calibration,
}

/// A row in the making.
#[derive(Debug, Clone)]
struct Sample {
    place: DVec2,
    /// Of the averaged rows, by index, in rising order.
    weights: Vec<(usize, f64)>,
    /// Variance, noise, and sum of covariances over all lags, each over the value for the weighted sum.
    inflation: f64,
    noise_inflation: f64,
    long_run: f64,
    filled: bool,
    moved: bool,
}

impl Sample {
    fn column(&self) -> u32 {
        self.place.x as u32
    }
}

/// The variances of a weighted sum, px².
struct Spread {
    speckle: f64,
    noise: f64,
}

impl ProfileFilter {
    /// `columns`: correlation of a row's `speckle` with rows at lags of 0, 1, … columns; 0 beyond the last. `frames`: the ways
    /// to frames at lags of 0, 1, …; no speckle remains beyond the last.
    /// `noise_share`: typical fraction of a row's variance that is noise.
    pub fn new(
        filters: Filters,
        columns: Vec<f64>,
        frames: Vec<FrameStep>,
        noise_share: f64,
        calibration: Calibration,
    ) -> ProfileFilter {
        let median = match filters.smooth {
            Some(Smooth::Median(count)) => {
                Some(MedianVariance::new(count as usize, &columns, noise_share))
            }
            _ => None,
        };
        ProfileFilter {
            filters,
            columns,
            frames,
            median,
            calibration,
        }
    }

    /// The profile that is delivered of those of some frames in turn, each in the order of its columns.
    pub fn apply(&self, frames: &[Vec<ProfileRow>]) -> Vec<DeliveredRow> {
        let kept: Vec<Vec<ProfileRow>> = frames.iter().map(|rows| self.inliers(rows)).collect();
        let rows = self.averaged(&kept);
        let samples = rows.iter().enumerate().map(|(i, row)| Sample {
            place: DVec2::new(f64::from(row.column) + 0.5, row.row),
            weights: vec![(i, 1.0)],
            inflation: 1.0,
            noise_inflation: 1.0,
            long_run: 1.0,
            filled: false,
            moved: false,
        });
        let samples = self.filled(samples.collect());
        let samples = self.smoothed(&rows, samples);
        let samples = self.resampled(samples);
        let delivered = samples.iter().map(|sample| self.delivered(&rows, sample));
        delivered.collect()
    }

    /// The rows near the median of those around; of a row without two pairs around it nothing is said.
    fn inliers(&self, rows: &[ProfileRow]) -> Vec<ProfileRow> {
        let Some(limit) = self.filters.outlier else {
            return rows.to_vec();
        };
        let columns: Vec<u32> = rows.iter().map(|row| row.column).collect();
        let is_near = |i: &usize| {
            let pairs = pairs(&columns, *i, OUTLIER_COLUMNS / 2);
            if pairs.len() < 2 {
                return true;
            }
            let mut around: Vec<f64> = pairs
                .iter()
                .flat_map(|&(a, b)| [rows[a].row, rows[b].row])
                .collect();
            around.sort_by(f64::total_cmp);
            let middle = (around[around.len() / 2 - 1] + around[around.len() / 2]) / 2.0;
            let place = DVec2::new(f64::from(columns[*i]) + 0.5, rows[*i].row);
            let point = |row: f64| self.calibration.point_at(place.with_y(row));
            match (point(place.y), point(middle)) {
                (Some(point), Some(middle)) => point.distance(middle) <= limit,
                _ => true,
            }
        };
        (0..rows.len()).filter(is_near).map(|i| rows[i]).collect()
    }

    /// The mean of each column that half of the frames or more have.
    fn averaged(&self, frames: &[Vec<ProfileRow>]) -> Vec<ProfileRow> {
        if let [rows] = frames {
            return rows.clone();
        }
        let mut all: Vec<(u32, usize, &ProfileRow)> = Vec::new();
        for (frame, rows) in frames.iter().enumerate() {
            all.extend(rows.iter().map(|row| (row.column, frame, row)));
        }
        all.sort_by_key(|&(column, frame, _)| (column, frame));
        let of_column = all.chunk_by(|a, b| a.0 == b.0);
        let enough = of_column.filter(|rows| 2 * rows.len() >= frames.len());
        let mean = |rows: &[(u32, usize, &ProfileRow)]| {
            let n = rows.len() as f64;
            let drift = Drift {
                decay: rows.iter().map(|row| row.2.drift.decay).sum::<f64>() / n,
                turn: rows.iter().map(|row| row.2.drift.turn).sum::<f64>() / n,
            };
            let alike = |a: usize, b: usize| match self.frames.get(a.abs_diff(b)) {
                Some(_) if a == b => 1.0,
                Some(step) => drift.correlation(step),
                None => 0.0,
            };
            let speckle: f64 = rows
                .iter()
                .flat_map(|a| rows.iter().map(move |b| (a, b)))
                .map(|(a, b)| a.2.speckle * b.2.speckle * alike(a.1, b.1))
                .sum();
            let noise: f64 = rows.iter().map(|row| row.2.noise.powi(2)).sum();
            let singles = noise + rows.iter().map(|row| row.2.speckle.powi(2)).sum::<f64>();
            ProfileRow {
                column: rows[0].0,
                row: rows.iter().map(|row| row.2.row).sum::<f64>() / n,
                speckle: speckle.max(0.0).sqrt() / n,
                noise: noise.sqrt() / n,
                drift,
                averaged: match speckle.max(0.0) + noise > 0.0 {
                    true => n * singles / (speckle.max(0.0) + noise),
                    false => 1.0,
                },
            }
        };
        enough.map(mean).collect()
    }

    /// Where a place's point lies along the profile, mm.
    fn along(&self, place: DVec2) -> Option<f64> {
        let normal = self.calibration.plane_normal;
        let axis = glam::DVec3::X
            .reject_from_normalized(normal)
            .normalize_or_zero();
        Some(self.calibration.point_at(place)?.dot(axis))
    }

    fn filled(&self, samples: Vec<Sample>) -> Vec<Sample> {
        let Some(most) = self.filters.fill else {
            return samples;
        };
        let mut all: Vec<Sample> = Vec::with_capacity(samples.len());
        for after in samples {
            if let Some(before) = all.last().cloned() {
                let gap = after.column() - before.column();
                let length = (self.along(after.place)).zip(self.along(before.place));
                if gap > 1 && length.is_some_and(|(b, a)| (b - a).abs() <= most) {
                    let share = |k: u32| f64::from(k) / f64::from(gap);
                    all.extend((1..gap).map(|k| Sample {
                        filled: true,
                        ..between(&before, &after, share(k))
                    }));
                }
            }
            all.push(after);
        }
        all
    }

    fn smoothed(&self, rows: &[ProfileRow], samples: Vec<Sample>) -> Vec<Sample> {
        let Some(smooth) = self.filters.smooth else {
            return samples;
        };
        let columns: Vec<u32> = samples.iter().map(Sample::column).collect();
        let of = |i: usize| {
            let own = &samples[i];
            let pairs = pairs(&columns, i, smooth.half());
            let count = 1 + 2 * pairs.len();
            let used = std::iter::once(i).chain(pairs.iter().flat_map(|&(a, b)| [a, b]));
            let parts = used.clone().flat_map(|i| samples[i].weights.iter());
            let weights = merged(parts.map(|&(i, w)| (i, w / count as f64)).collect());
            let total = |spread: &Spread| spread.speckle + spread.noise;
            let own_spread = self.spread(rows, &own.weights);
            let mean_spread = self.spread(rows, &weights);
            let (own_variance, mean) = (total(&own_spread), total(&mean_spread));
            let (row, [inflation, noise_inflation], long_run) = match (smooth, &self.median) {
                (Smooth::Median(_), Some(median)) => {
                    let mut values: Vec<f64> = used.map(|i| samples[i].place.y).collect();
                    let middle = values.len() / 2;
                    let row = *values.select_nth_unstable_by(middle, f64::total_cmp).1;
                    // Less what errors alone make of it.
                    let climb = pairs.last().map_or(0.0, |&(a, b)| {
                        let rows = samples[b].place.y - samples[a].place.y;
                        let square = rows * rows / own_variance - 2.0;
                        square.max(0.0).sqrt() / f64::from(columns[b] - columns[a])
                    });
                    // Steep lines keep the row in the middle.
                    let most = |own: f64, mean: f64| {
                        if mean > 0.0 {
                            (own / mean).max(1.0)
                        } else {
                            1.0
                        }
                    };
                    let share = own_spread.noise / own_variance.max(f64::MIN_POSITIVE);
                    let [all, noise] = median.over_mean(climb, share);
                    let all = all.min(most(own_variance, mean));
                    let noise = noise.min(most(own_spread.noise, mean_spread.noise));
                    match count {
                        1 => (row, [1.0; 2], 1.0),
                        _ => (row, [all, noise], median.long_run(climb)),
                    }
                }
                _ => {
                    let sum: f64 = used.map(|i| samples[i].place.y).sum();
                    (sum / count as f64, [1.0; 2], 1.0)
                }
            };
            let limit = MOVED_SIGMAS * (own_variance + mean * inflation).sqrt();
            Sample {
                place: own.place.with_y(row),
                weights,
                inflation,
                noise_inflation,
                long_run,
                filled: own.filled,
                moved: (row - own.place.y).abs() > limit,
            }
        };
        (0..samples.len()).map(of).collect()
    }

    fn resampled(&self, samples: Vec<Sample>) -> Vec<Sample> {
        let Some(step) = self.filters.resample else {
            return samples;
        };
        let along: Vec<Option<f64>> = samples.iter().map(|s| self.along(s.place)).collect();
        let mut even = Vec::new();
        for (pair, along) in samples.windows(2).zip(along.windows(2)) {
            let (Some(from), Some(to)) = (along[0], along[1]) else {
                continue;
            };
            if pair[0].column() + 1 != pair[1].column() || to <= from {
                continue;
            }
            let (first, last) = ((from / step).ceil() as i64, (to / step).ceil() as i64);
            let share = |k: i64| (k as f64 * step - from) / (to - from);
            even.extend((first..last).map(|k| between(&pair[0], &pair[1], share(k))));
        }
        even
    }

    fn spread(&self, rows: &[ProfileRow], weights: &[(usize, f64)]) -> Spread {
        let mut spread = Spread {
            speckle: 0.0,
            noise: 0.0,
        };
        for (k, &(i, w)) in weights.iter().enumerate() {
            let own = w * rows[i].speckle;
            spread.noise += (w * rows[i].noise).powi(2);
            spread.speckle += own * own;
            for &(j, v) in &weights[k + 1..] {
                let apart = (rows[j].column - rows[i].column) as usize;
                let Some(rho) = self.columns.get(apart) else {
                    break;
                };
                spread.speckle += 2.0 * own * v * rows[j].speckle * rho;
            }
        }
        spread
    }

    fn delivered(&self, rows: &[ProfileRow], sample: &Sample) -> DeliveredRow {
        let Spread { speckle, noise } = self.spread(rows, &sample.weights);
        let mean = |of: &dyn Fn(&ProfileRow) -> f64| -> f64 {
            sample
                .weights
                .iter()
                .map(|&(i, w)| w * of(&rows[i]).powi(2))
                .sum()
        };
        // A filter that keeps straight lines keeps the sum of its rows' covariances over all distances.
        let over_all =
            mean(&|row| row.speckle) * sum_of_both_sides(&self.columns) + mean(&|row| row.noise);
        let variance = (speckle + noise).max(0.0) * sample.inflation;
        let noise = (noise * sample.noise_inflation).min(variance);
        DeliveredRow {
            place: sample.place,
            speckle: (variance - noise).sqrt(),
            noise: noise.sqrt(),
            correlated_columns: if variance > 0.0 {
                over_all * sample.long_run / variance
            } else {
                1.0
            },
            averaged: sample
                .weights
                .iter()
                .map(|&(i, w)| w * rows[i].averaged)
                .sum(),
            filled: sample.filled,
            moved: sample.moved,
        }
    }
}

/// Σ_k ρ_k over both signs of k.
pub fn sum_of_both_sides(correlation: &[f64]) -> f64 {
    2.0 * correlation.iter().sum::<f64>() - correlation[0]
}

/// Indices of the rows 1, 2, … columns to both sides of one, up to so many, where both are there.
fn pairs(columns: &[u32], i: usize, half: u32) -> Vec<(usize, usize)> {
    let (mut before, mut after) = (i, i);
    let mut pairs = Vec::with_capacity(half as usize);
    for apart in 1..=half {
        while before > 0 && columns[i] - columns[before] < apart {
            before -= 1;
        }
        while after + 1 < columns.len() && columns[after] - columns[i] < apart {
            after += 1;
        }
        if columns[i] - columns[before] == apart && columns[after] - columns[i] == apart {
            pairs.push((before, after));
        }
    }
    pairs
}

/// On the line from one row to another.
fn between(a: &Sample, b: &Sample, share: f64) -> Sample {
    let of = |sample: &Sample, share: f64| -> Vec<(usize, f64)> {
        sample
            .weights
            .iter()
            .map(|&(i, w)| (i, w * share))
            .collect()
    };
    Sample {
        place: a.place.lerp(b.place, share),
        weights: merged([of(a, 1.0 - share), of(b, share)].concat()),
        inflation: a.inflation * (1.0 - share) + b.inflation * share,
        noise_inflation: a.noise_inflation * (1.0 - share) + b.noise_inflation * share,
        long_run: a.long_run * (1.0 - share) + b.long_run * share,
        filled: a.filled || b.filled,
        moved: a.moved || b.moved,
    }
}

/// Weights of the same row as one, in the order of rows.
fn merged(mut weights: Vec<(usize, f64)>) -> Vec<(usize, f64)> {
    weights.sort_by_key(|&(i, _)| i);
    weights.dedup_by(|next, kept| {
        let same = next.0 == kept.0;
        if same {
            kept.1 += next.1;
        }
        same
    });
    weights
}

#[cfg(test)]
#[path = "filter_tests.rs"]
mod tests;

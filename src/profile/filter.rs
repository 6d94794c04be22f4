//! Profile filters of sensors, and the propagation of uncertainty through them.
//!
//! Every delivered row is a weighted sum of measured rows, Σ w_i·y_i. Its variance is Σ
//! w_i·w_j·s_i·s_j·ρ(|c_i − c_j|) + Σ w_i²·(n_i² + p_i²). Here s is the component of the standard
//! uncertainty that is correlated between adjacent columns (speckle, edges and bends). ρ is its
//! correlation over columns. n is the noise, which is independent for each row. p is the component
//! due to the different responses of pixels, which is independent for each column and correlated
//! between frames whose lines cover equal pixels.

use super::Calibration;
use super::median_variance::MedianVariance;
use crate::math::DVec2;
use serde::Serialize;

/// Filters applied to profiles, in this order. Lengths in mm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Filters {
    /// Maximum distance of a point from the median of the surrounding [`OUTLIER_COLUMNS`] columns.
    /// Rows beyond it are removed.
    pub outlier: Option<f64>,
    /// Number of frames whose profiles are averaged column by column.
    pub average_frames: u32,
    /// Maximum length of gaps along the profile that are filled by linear interpolation.
    pub fill: Option<f64>,
    /// Smoothing along the profile.
    pub smooth: Option<Smooth>,
    /// Spacing of the resampled points along the profile. The points are at integer multiples of
    /// it.
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

/// Smoothing over an odd number of columns. A column contributes only if the column at the same
/// distance on the other side is present, so that a straight line is unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Smooth {
    /// Moving average over a number of columns.
    Mean(u32),
    /// Moving median over a number of columns.
    Median(u32),
    /// Weighted average whose weights are a normal distribution with this standard deviation in
    /// columns, up to [`GAUSSIAN_REACH`] standard deviations.
    Gaussian(f64),
}

/// Distance in standard deviations beyond which the weights of [`Smooth::Gaussian`] are 0. Their
/// sum is below 1e-4.
pub const GAUSSIAN_REACH: f64 = 4.0;

impl Smooth {
    fn half(self) -> u32 {
        match self {
            Smooth::Mean(columns) | Smooth::Median(columns) => columns / 2,
            Smooth::Gaussian(sigma) => (GAUSSIAN_REACH * sigma).ceil() as u32,
        }
    }

    /// Returns the weight of a column at a distance, relative to the central column.
    fn weight(self, columns: u32) -> f64 {
        match self {
            Smooth::Mean(_) | Smooth::Median(_) => 1.0,
            Smooth::Gaussian(sigma) => (-0.5 * (f64::from(columns) / sigma).powi(2)).exp(),
        }
    }
}

/// Number of surrounding columns, without the column itself, that decide whether a row is an
/// outlier.
pub const OUTLIER_COLUMNS: u32 = 8;
/// Limit for the shift of a row by smoothing, in combined standard uncertainties of the original
/// and the smoothed row. A greater shift indicates an edge or a bend in the window. Gaussian errors
/// exceed the limit in 1 of 16 000 rows.
const MOVED_SIGMAS: f64 = 4.0;

/// Measured row of a profile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredRow {
    /// Column of the image.
    pub column: u32,
    /// Row of the line in this column, px.
    pub row: f64,
    /// Standard uncertainty without noise and pixel pattern, px.
    pub speckle: f64,
    /// Standard deviation of the noise, which differs in each image, px.
    pub noise: f64,
    /// Standard deviation due to the pixel pattern (PRNU and DSNU), px.
    pub pattern: f64,
    /// Standard deviation of the line, px. Two frames whose rows differ by as much cover different
    /// pixels.
    pub width: f64,
    /// Correlation of the `speckle` errors with errors of frames at other surface positions.
    pub drift: Drift,
    /// Mean variance of the rows of the averaged frames relative to the variance of their mean; 1
    /// for a single frame.
    pub averaged: f64,
}

/// Correlation of speckle errors while the surface moves across the laser plane.
///
/// If the pattern moves by u standard deviations of the line, the errors of the rows have a
/// correlation of exp(−a·u²)·(1 − c·u²). For grains much finer than the line, a = ¼ and c = ½.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// Coefficient a.
    pub decay: f64,
    /// Coefficient c.
    pub turn: f64,
}

impl Drift {
    /// Limit of grains much finer than the line.
    pub const FINE: Drift = Drift {
        decay: 0.25,
        turn: 0.5,
    };

    /// Returns the correlation of the errors at one position in two frames.
    pub fn correlation(&self, step: &FrameStep) -> f64 {
        let square = step.across.powi(2);
        step.kept * (-self.decay * square).exp() * (1.0 - self.turn * square)
    }
}

/// Change of the speckle pattern between two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameStep {
    /// Motion of the surface across the laser plane, in standard deviations of the laser line.
    pub across: f64,
    /// Remaining correlation of the light without motion across the laser plane.
    pub kept: f64,
}

/// Delivered row of a profile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeliveredRow {
    /// Sensor coordinates (column, row); fractional columns occur in resampled profiles.
    pub place: DVec2,
    /// See [`MeasuredRow`].
    pub speckle: f64,
    /// See [`MeasuredRow`].
    pub noise: f64,
    /// See [`MeasuredRow`].
    pub pattern: f64,
    /// Sum Σ_k ρ_k, where ρ_k is the correlation of delivered errors at a lag of k columns.
    pub correlation_length_columns: f64,
    /// See [`MeasuredRow`].
    pub averaged: f64,
    /// True if the row is interpolated in a gap.
    pub filled: bool,
    /// True if smoothing moved the row by more than noise explains.
    pub moved: bool,
}

/// Filters together with the error correlations they require.
#[derive(Debug, Clone)]
pub struct ProfileFilter {
    filters: Filters,
    /// Correlation of `speckle` at lags of 0, 1, … columns.
    columns: Vec<f64>,
    /// Speckle change at lags of 0, 1, … frames.
    frames: Vec<FrameStep>,
    median: Option<MedianVariance>,
    calibration: Calibration,
}

/// Intermediate row of the filter chain.
#[derive(Debug, Clone)]
struct FilteredRow {
    place: DVec2,
    /// Weights of the averaged rows: (index, weight), in ascending order.
    weights: Vec<(usize, f64)>,
    /// Ratios of variance, noise variance and long-run variance to the values of the weighted sum.
    variance_ratio: f64,
    noise_inflation: f64,
    long_run_variance_ratio: f64,
    filled: bool,
    moved: bool,
}

impl FilteredRow {
    fn column(&self) -> u32 {
        self.place.x as u32
    }
}

/// Variances of a weighted sum, px².
struct RowVariance {
    speckle: f64,
    noise: f64,
    pattern: f64,
}

impl RowVariance {
    /// Returns the variance that is independent between columns.
    fn independent(&self) -> f64 {
        self.noise + self.pattern
    }

    fn total(&self) -> f64 {
        self.speckle + self.independent()
    }
}

impl ProfileFilter {
    /// Creates a filter.
    ///
    /// `columns` is the correlation of `speckle` at lags of 0, 1, … columns, 0 beyond the last.
    /// `frames` is the speckle change at lags of 0, 1, … frames; no speckle correlation remains
    /// beyond the last. `noise_share` is the typical fraction of the variance of a row that is
    /// noise.
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

    /// Returns the delivered profile of consecutive frames. The rows of each frame are in the order
    /// of columns.
    pub fn apply(&self, frames: &[Vec<MeasuredRow>]) -> Vec<DeliveredRow> {
        let kept: Vec<Vec<MeasuredRow>> = frames.iter().map(|rows| self.inliers(rows)).collect();
        let rows = self.averaged(&kept);
        let samples = rows.iter().enumerate().map(|(i, row)| FilteredRow {
            place: DVec2::new(f64::from(row.column) + 0.5, row.row),
            weights: vec![(i, 1.0)],
            variance_ratio: 1.0,
            noise_inflation: 1.0,
            long_run_variance_ratio: 1.0,
            filled: false,
            moved: false,
        });
        let samples = self.filled(samples.collect());
        let samples = self.smoothed(&rows, samples);
        let samples = self.resampled(samples);
        let delivered = samples
            .iter()
            .map(|sample| self.filtered_points(&rows, sample));
        delivered.collect()
    }

    /// Returns the rows close to the median of their surroundings. Rows with fewer than two
    /// surrounding pairs are retained.
    fn inliers(&self, rows: &[MeasuredRow]) -> Vec<MeasuredRow> {
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

    /// Returns the mean of each column that is present in at least half of the frames.
    fn averaged(&self, frames: &[Vec<MeasuredRow>]) -> Vec<MeasuredRow> {
        if let [rows] = frames {
            return rows.clone();
        }
        let mut all: Vec<(u32, usize, &MeasuredRow)> = Vec::new();
        for (frame, rows) in frames.iter().enumerate() {
            all.extend(rows.iter().map(|row| (row.column, frame, row)));
        }
        all.sort_by_key(|&(column, frame, _)| (column, frame));
        let of_column = all.chunk_by(|a, b| a.0 == b.0);
        let enough = of_column.filter(|rows| 2 * rows.len() >= frames.len());
        let mean = |rows: &[(u32, usize, &MeasuredRow)]| {
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
            let width = rows.iter().map(|row| row.2.width).sum::<f64>() / n;
            // Errors from independent pixels decrease with the distance of two lines as those from
            // infinitely fine grains do.
            let of_pixels = |a: &MeasuredRow, b: &MeasuredRow| {
                Drift::FINE.correlation(&FrameStep {
                    across: (a.row - b.row) / width,
                    kept: 1.0,
                })
            };
            let pattern: f64 = rows
                .iter()
                .flat_map(|a| rows.iter().map(move |b| (a.2, b.2)))
                .map(|(a, b)| a.pattern * b.pattern * of_pixels(a, b))
                .sum();
            let together = speckle.max(0.0) + noise + pattern.max(0.0);
            let single =
                |row: &MeasuredRow| row.speckle.powi(2) + row.noise.powi(2) + row.pattern.powi(2);
            let singles: f64 = rows.iter().map(|row| single(row.2)).sum();
            MeasuredRow {
                column: rows[0].0,
                row: rows.iter().map(|row| row.2.row).sum::<f64>() / n,
                speckle: speckle.max(0.0).sqrt() / n,
                noise: noise.sqrt() / n,
                pattern: pattern.max(0.0).sqrt() / n,
                width,
                drift,
                averaged: match together > 0.0 {
                    true => n * singles / together,
                    false => 1.0,
                },
            }
        };
        enough.map(mean).collect()
    }

    /// Returns the coordinate of the point at `place` along the profile, mm.
    fn along(&self, place: DVec2) -> Option<f64> {
        let normal = self.calibration.plane_normal;
        let axis = glam::DVec3::X
            .reject_from_normalized(normal)
            .normalize_or_zero();
        Some(self.calibration.point_at(place)?.dot(axis))
    }

    fn filled(&self, samples: Vec<FilteredRow>) -> Vec<FilteredRow> {
        let Some(most) = self.filters.fill else {
            return samples;
        };
        let mut all: Vec<FilteredRow> = Vec::with_capacity(samples.len());
        for after in samples {
            if let Some(before) = all.last().cloned() {
                let gap = after.column() - before.column();
                let length = (self.along(after.place)).zip(self.along(before.place));
                if gap > 1 && length.is_some_and(|(b, a)| (b - a).abs() <= most) {
                    let share = |k: u32| f64::from(k) / f64::from(gap);
                    all.extend((1..gap).map(|k| FilteredRow {
                        filled: true,
                        ..between(&before, &after, share(k))
                    }));
                }
            }
            all.push(after);
        }
        all
    }

    fn smoothed(&self, rows: &[MeasuredRow], samples: Vec<FilteredRow>) -> Vec<FilteredRow> {
        let Some(smooth) = self.filters.smooth else {
            return samples;
        };
        let columns: Vec<u32> = samples.iter().map(FilteredRow::column).collect();
        let of = |i: usize| {
            let own = &samples[i];
            let pairs = pairs(&columns, i, smooth.half());
            let weighted = pairs.iter().flat_map(|&(a, b)| {
                let weight = smooth.weight(columns[b] - columns[i]);
                [(a, weight), (b, weight)]
            });
            let used: Vec<(usize, f64)> = std::iter::once((i, 1.0)).chain(weighted).collect();
            let total: f64 = used.iter().map(|(_, weight)| weight).sum();
            let parts = used.iter().flat_map(|&(i, weight)| {
                let weights = samples[i].weights.iter();
                weights.map(move |&(i, w)| (i, w * weight / total))
            });
            let weights = merged(parts.collect());
            let own_spread = self.variance(rows, &own.weights);
            let mean_spread = self.variance(rows, &weights);
            let (own_variance, mean) = (own_spread.total(), mean_spread.total());
            let (row, [inflation, noise_inflation], long_run) = match (smooth, &self.median) {
                (Smooth::Median(_), Some(median)) => {
                    let mut values: Vec<f64> =
                        used.iter().map(|&(i, _)| samples[i].place.y).collect();
                    let middle = values.len() / 2;
                    let row = *values.select_nth_unstable_by(middle, f64::total_cmp).1;
                    // The expected contribution of errors is subtracted.
                    let climb = pairs.last().map_or(0.0, |&(a, b)| {
                        let rows = samples[b].place.y - samples[a].place.y;
                        let square = rows * rows / own_variance - 2.0;
                        square.max(0.0).sqrt() / f64::from(columns[b] - columns[a])
                    });
                    // On steep lines, the median is the row at the centre of the window.
                    let most = |own: f64, mean: f64| {
                        if mean > 0.0 {
                            (own / mean).max(1.0)
                        } else {
                            1.0
                        }
                    };
                    let share = own_spread.independent() / own_variance.max(f64::MIN_POSITIVE);
                    let [all, noise] = median.over_mean(climb, share);
                    let all = all.min(most(own_variance, mean));
                    let independent = [&own_spread, &mean_spread].map(RowVariance::independent);
                    let noise = noise.min(most(independent[0], independent[1]));
                    match used.len() {
                        1 => (row, [1.0; 2], 1.0),
                        _ => (row, [all, noise], median.long_run_variance_ratio(climb)),
                    }
                }
                _ => {
                    let rows = used.iter().map(|&(i, weight)| weight * samples[i].place.y);
                    (rows.sum::<f64>() / total, [1.0; 2], 1.0)
                }
            };
            let limit = MOVED_SIGMAS * (own_variance + mean * inflation).sqrt();
            FilteredRow {
                place: own.place.with_y(row),
                weights,
                variance_ratio: inflation,
                noise_inflation,
                long_run_variance_ratio: long_run,
                filled: own.filled,
                moved: (row - own.place.y).abs() > limit,
            }
        };
        (0..samples.len()).map(of).collect()
    }

    fn resampled(&self, samples: Vec<FilteredRow>) -> Vec<FilteredRow> {
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

    fn variance(&self, rows: &[MeasuredRow], weights: &[(usize, f64)]) -> RowVariance {
        let mut spread = RowVariance {
            speckle: 0.0,
            noise: 0.0,
            pattern: 0.0,
        };
        for (k, &(i, w)) in weights.iter().enumerate() {
            let own = w * rows[i].speckle;
            spread.noise += (w * rows[i].noise).powi(2);
            spread.pattern += (w * rows[i].pattern).powi(2);
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

    fn filtered_points(&self, rows: &[MeasuredRow], sample: &FilteredRow) -> DeliveredRow {
        let spread = self.variance(rows, &sample.weights);
        let mean = |of: &dyn Fn(&MeasuredRow) -> f64| -> f64 {
            sample
                .weights
                .iter()
                .map(|&(i, w)| w * of(&rows[i]).powi(2))
                .sum()
        };
        // A filter that preserves straight lines preserves the sum of covariances over all lags.
        let over_all = mean(&|row| row.speckle) * sum_of_both_sides(&self.columns)
            + mean(&|row| row.noise.hypot(row.pattern));
        let variance = spread.total().max(0.0) * sample.variance_ratio;
        let independent = (spread.independent() * sample.noise_inflation).min(variance);
        let noise = match spread.noise > 0.0 {
            true => independent * spread.noise / spread.independent(),
            false => 0.0,
        };
        DeliveredRow {
            place: sample.place,
            speckle: (variance - independent).max(0.0).sqrt(),
            noise: noise.sqrt(),
            pattern: (independent - noise).max(0.0).sqrt(),
            correlation_length_columns: if variance > 0.0 {
                over_all * sample.long_run_variance_ratio / variance
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

/// Returns Σ_k ρ_k over both signs of k.
pub fn sum_of_both_sides(correlation: &[f64]) -> f64 {
    2.0 * correlation.iter().sum::<f64>() - correlation[0]
}

/// Returns the index pairs of rows at distances of 1, 2, …, `half` columns on both sides of row
/// `i`, if both rows are present.
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

/// Returns the linear interpolation between two rows.
fn between(a: &FilteredRow, b: &FilteredRow, share: f64) -> FilteredRow {
    let of = |sample: &FilteredRow, share: f64| -> Vec<(usize, f64)> {
        sample
            .weights
            .iter()
            .map(|&(i, w)| (i, w * share))
            .collect()
    };
    FilteredRow {
        place: a.place.lerp(b.place, share),
        weights: merged([of(a, 1.0 - share), of(b, share)].concat()),
        variance_ratio: a.variance_ratio * (1.0 - share) + b.variance_ratio * share,
        noise_inflation: a.noise_inflation * (1.0 - share) + b.noise_inflation * share,
        long_run_variance_ratio: a.long_run_variance_ratio * (1.0 - share)
            + b.long_run_variance_ratio * share,
        filled: a.filled || b.filled,
        moved: a.moved || b.moved,
    }
}

/// Sums the weights of equal rows and sorts by row.
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

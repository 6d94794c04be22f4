//! What is measured of a line's speckled image, column by column: the same for waves and for
//! rendered frames.

/// Part of a line's image that shares no speckle with other parts: columns beside each other, the
/// line's ideal middle in the middle of their middle row.
#[derive(Debug, Clone, PartialEq)]
pub struct Block {
    /// Rows, an odd number.
    pub rows: usize,
    /// Mean intensity over each pixel, column after column, in one unit for all blocks.
    pub light: Vec<f64>,
}

/// A value with its standard error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Of all blocks.
    pub value: f64,
    /// Standard error by leaving out one block at a time (Tukey 1958).
    pub error: f64,
}

impl Measured {
    /// This over another that shares nothing with it; errors to first order.
    pub fn over(&self, other: &Measured) -> Measured {
        let value = self.value / other.value;
        let relative = (self.error / self.value).hypot(other.error / other.value);
        Measured {
            value,
            error: value.abs() * relative,
        }
    }
}

/// Where a line is measured, pixels from its ideal middle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Window {
    /// The centroid is that of the light in rows so far to each side.
    pub reach: usize,
    /// Contrast and grains are means over rows so far to each side of the middle.
    pub middle: usize,
    /// Contrast beside the middle is taken so far to both sides of it.
    pub beside: usize,
    /// Longest lag at which intensities are compared, pixels.
    pub lags: usize,
}

/// A line in speckle. Lengths in pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct LineFigures {
    /// Standard deviation of the centroid, about its mean, over all columns.
    pub noise: Measured,
    /// The same over columns with at least half of the mean column's light: on a line thinner than a
    /// grain the few dark columns, whose centroid is of almost no light, decide about all of them.
    pub noise_bright: Measured,
    /// Contrast of the intensity in the middle.
    pub contrast: Measured,
    /// Contrast beside the middle.
    pub contrast_beside: Measured,
    /// Full width at half maximum of the intensity's autocovariance in the middle, along the line
    /// (from column to column).
    pub grain_along: Measured,
    /// The same across the line: of pairs of places at equal distances from the middle.
    pub grain_across: Measured,
    /// Mean light of the middle row.
    pub light: Measured,
    /// Mean light of each row of the window.
    pub mean: Vec<f64>,
}

/// Figures of independent blocks.
///
/// Covariances are normalised by the mean of their two rows: ⟨I·I'⟩/(⟨I⟩·⟨I'⟩) − 1, of lag 0 the square
/// of the contrast. Where they sink to half of that, their logarithm is taken as linear in the lag's
/// square, as it is for a Gaussian.
///
/// # Panics
/// Fewer than two blocks, or rows that do not hold the window.
pub fn line_figures(blocks: &[Block], window: &Window) -> LineFigures {
    assert!(blocks.len() >= 2, "one block has no standard error");
    let columns = blocks.iter().map(|b| b.light.len() / b.rows).sum::<usize>();
    let light = blocks.iter().map(|b| in_window(b, window)).sum::<f64>();
    let dim = 0.5 * light / columns as f64;
    let parts: Vec<Sums> = blocks.iter().map(|b| Sums::of(b, window, dim)).collect();
    let mut all = parts[0].clone();
    for part in &parts[1..] {
        all.add(part, 1.0);
    }
    let without = parts.iter().map(|part| {
        let mut others = all.clone();
        others.add(part, -1.0);
        others.figures(window)
    });
    let measured = measured(all.figures(window), without);
    LineFigures {
        noise: measured[0],
        noise_bright: measured[1],
        contrast: measured[2],
        contrast_beside: measured[3],
        grain_along: measured[4],
        grain_across: measured[5],
        light: measured[6],
        mean: all.light.iter().map(|sum| sum / all.columns).collect(),
    }
}

/// How the centroids of a line's columns follow from those before the surface moved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MovedFigures {
    /// Way along the line at which they correlate best, pixels: the vertex of a parabola through the
    /// highest correlation and its neighbours.
    pub way: Measured,
    /// The correlation there.
    pub correlation: Measured,
}

/// Figures of independent pairs of blocks, before and after; ways of up to `furthest` pixels are searched.
///
/// # Panics
/// As [`line_figures`]; blocks of fewer columns than `furthest` + 2.
pub fn moved_figures(pairs: &[[Block; 2]], window: &Window, furthest: usize) -> MovedFigures {
    let centroids: Vec<[Vec<f64>; 2]> = (pairs.iter())
        .map(|pair| [0, 1].map(|k| centroids(&pair[k], window)))
        .collect();
    let mean = [0, 1].map(|k| {
        let all = || centroids.iter().flat_map(|pair| &pair[k]);
        all().sum::<f64>() / all().count() as f64
    });
    let span = furthest as isize + 1;
    // Of each pair: count and sum of products by way, and the squares of both.
    let sums = |pair: &[Vec<f64>; 2]| {
        let off = [0, 1].map(|k| pair[k].iter().map(|c| c - mean[k]).collect::<Vec<_>>());
        let square = |k: usize| off[k].iter().map(|c| c * c).sum::<f64>();
        let by_way = (-span..=span).flat_map(|way| {
            let [before, after] = [(-way).max(0), way.max(0)].map(|skip| skip as usize);
            let both = off[0].iter().skip(before).zip(off[1].iter().skip(after));
            [
                (off[0].len() as f64 - way.abs() as f64),
                both.map(|(a, b)| a * b).sum(),
            ]
        });
        let squares = [off[0].len() as f64, square(0), square(1)];
        squares.into_iter().chain(by_way).collect::<Vec<f64>>()
    };
    let parts: Vec<Vec<f64>> = centroids.iter().map(sums).collect();
    let all: Vec<f64> = (0..parts[0].len())
        .map(|i| parts.iter().map(|part| part[i]).sum())
        .collect();
    let correlation = |sums: &[f64], i: usize| {
        let products = sums[3 + 2 * i + 1] / sums[3 + 2 * i];
        products / (sums[1] * sums[2]).sqrt() * sums[0]
    };
    let best = (1..=2 * furthest + 1)
        .max_by(|&a, &b| correlation(&all, a).total_cmp(&correlation(&all, b)))
        .expect("a way of 0");
    let vertex = |sums: &[f64]| {
        let [low, top, high] = [best - 1, best, best + 1].map(|i| correlation(sums, i));
        let bend = low + high - 2.0 * top;
        let way = best as f64 - span as f64 + 0.5 * (low - high) / bend;
        [way, top - 0.125 * (low - high).powi(2) / bend]
    };
    let values = vertex(&all);
    let without = parts.iter().map(|part| {
        let others: Vec<f64> = all.iter().zip(part).map(|(a, p)| a - p).collect();
        vertex(&others)
    });
    let [way, correlation] = measured(values, without);
    MovedFigures { way, correlation }
}

/// Values with their errors, from those of all blocks but one.
fn measured<const N: usize>(
    values: [f64; N],
    without: impl ExactSizeIterator<Item = [f64; N]>,
) -> [Measured; N] {
    let n = without.len() as f64;
    let mut squares = [0.0; N];
    for others in without {
        (0..N).for_each(|k| squares[k] += (others[k] - values[k]).powi(2));
    }
    std::array::from_fn(|k| Measured {
        value: values[k],
        error: (squares[k] * (n - 1.0) / n).sqrt(),
    })
}

/// Centroid of each column's light in the window, pixels from the middle.
fn centroids(block: &Block, window: &Window) -> Vec<f64> {
    let middle = block.rows / 2;
    let centroid = |column: &[f64]| {
        let rows = middle - window.reach..=middle + window.reach;
        let (light, moment) = rows.fold((0.0, 0.0), |(light, moment), row| {
            let off = row as f64 - middle as f64;
            (light + column[row], moment + off * column[row])
        });
        moment / light
    };
    block.light.chunks_exact(block.rows).map(centroid).collect()
}

/// Light of a block's columns in the window.
fn in_window(block: &Block, window: &Window) -> f64 {
    let middle = block.rows / 2;
    let columns = block.light.chunks_exact(block.rows);
    columns
        .flat_map(|c| &c[middle - window.reach..=middle + window.reach])
        .sum()
}

/// Sums over columns, of which figures are functions.
#[derive(Clone)]
struct Sums {
    columns: f64,
    /// Of each row of the window, the intensity and its square.
    light: Vec<f64>,
    squares: Vec<f64>,
    /// Number, sum and sum of squares of centroids, of all columns and of bright ones.
    centroids: [[f64; 3]; 2],
    /// Number of pairs of columns by lag, and their products in each middle row.
    pairs: Vec<f64>,
    along: Vec<Vec<f64>>,
    /// Products of two rows so far apart, about the middle.
    across: Vec<f64>,
}

impl Sums {
    fn of(block: &Block, window: &Window, dim: f64) -> Sums {
        let first = block.rows / 2 - window.reach;
        let rows = 2 * window.reach + 1;
        let columns: Vec<&[f64]> = (block.light.chunks_exact(block.rows))
            .map(|column| &column[first..first + rows])
            .collect();
        let count = columns.len();
        let mut sums = Sums {
            columns: count as f64,
            light: vec![0.0; rows],
            squares: vec![0.0; rows],
            centroids: [[0.0; 3]; 2],
            pairs: (0..=window.lags)
                .map(|lag| count.saturating_sub(lag) as f64)
                .collect(),
            along: vec![vec![0.0; window.lags + 1]; 2 * window.middle + 1],
            across: vec![0.0; window.lags + 1],
        };
        for (i, column) in columns.iter().enumerate() {
            let (mut light, mut moment) = (0.0, 0.0);
            for (row, &value) in column.iter().enumerate() {
                sums.light[row] += value;
                sums.squares[row] += value * value;
                light += value;
                moment += value * (row as f64 - window.reach as f64);
            }
            let centroid = moment / light;
            for (k, least) in [0.0, dim].into_iter().enumerate() {
                if light > least {
                    let powers = [1.0, centroid, centroid * centroid];
                    (0..3).for_each(|p| sums.centroids[k][p] += powers[p]);
                }
            }
            for (row, products) in middle_rows(window).zip(&mut sums.along) {
                for (product, other) in products.iter_mut().zip(&columns[i..]) {
                    *product += column[row] * other[row];
                }
            }
            for (lag, product) in sums.across.iter_mut().enumerate() {
                let [a, b] = about_middle(window, lag);
                *product += column[a] * column[b];
            }
        }
        sums
    }

    /// Adds `times` another.
    fn add(&mut self, other: &Sums, times: f64) {
        let add = |a: &mut [f64], b: &[f64]| {
            for (a, b) in a.iter_mut().zip(b) {
                *a += times * b;
            }
        };
        self.columns += times * other.columns;
        add(&mut self.light, &other.light);
        add(&mut self.squares, &other.squares);
        add(&mut self.pairs, &other.pairs);
        add(&mut self.across, &other.across);
        for k in 0..2 {
            add(&mut self.centroids[k], &other.centroids[k]);
        }
        for (a, b) in self.along.iter_mut().zip(&other.along) {
            add(a, b);
        }
    }

    /// In the order of [`LineFigures`].
    fn figures(&self, window: &Window) -> [f64; 7] {
        let mean = |row: usize| self.light[row] / self.columns;
        let deviation = |[n, sum, square]: [f64; 3]| (square / n - (sum / n).powi(2)).sqrt();
        let variance = |row: usize| self.squares[row] / self.columns / mean(row).powi(2) - 1.0;
        let over = |rows: &mut dyn Iterator<Item = usize>| {
            let (sum, n) = rows.fold((0.0, 0.0), |(sum, n), row| (sum + variance(row), n + 1.0));
            sum / n
        };
        let middle = over(&mut middle_rows(window));
        let sides = [window.reach - window.beside, window.reach + window.beside];
        let along = (0..=window.lags).map(|lag| {
            let rows = middle_rows(window).zip(&self.along);
            let of_row = |(row, products): (usize, &Vec<f64>)| {
                products[lag] / self.pairs[lag] / mean(row).powi(2) - 1.0
            };
            rows.map(of_row).sum::<f64>() / self.along.len() as f64
        });
        let across = self.across.iter().enumerate().map(|(lag, product)| {
            let [a, b] = about_middle(window, lag);
            product / self.columns / (mean(a) * mean(b)) - 1.0
        });
        [
            deviation(self.centroids[0]),
            deviation(self.centroids[1]),
            middle.sqrt(),
            over(&mut sides.into_iter()).sqrt(),
            width_at_half(&along.collect::<Vec<_>>()),
            width_at_half(&across.collect::<Vec<_>>()),
            mean(window.reach),
        ]
    }
}

/// Rows of the window that are in the middle.
fn middle_rows(window: &Window) -> impl Iterator<Item = usize> {
    window.reach - window.middle..=window.reach + window.middle
}

/// Two rows of the window that are `lag` apart, at equal distances from the middle or, where the lag is
/// odd, the one below half a row nearer than the other.
fn about_middle(window: &Window, lag: usize) -> [usize; 2] {
    let low = window.reach - lag / 2;
    [low, low + lag]
}

/// Twice the lag at which a covariance sinks to half of that at lag 0; infinite where it does not.
fn width_at_half(covariance: &[f64]) -> f64 {
    let half = covariance[0] / 2.0;
    let Some(after) = covariance.iter().position(|&c| c < half) else {
        return f64::INFINITY;
    };
    let logarithm = |lag: usize| (covariance[lag].max(1e-9 * half) / half).ln();
    let (high, low) = (logarithm(after - 1), logarithm(after));
    let share = high / (high - low);
    let square = |lag: usize| (lag * lag) as f64;
    2.0 * (square(after - 1) * (1.0 - share) + square(after) * share).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Key, Purpose};

    /// Columns of independent pixels of exponential light under a Gaussian line: contrast 1, no
    /// covariance at a lag of one, and the centroid's variance Σy²m²/(Σm)² (the ratio's next
    /// order is relative 3·Σm²/(Σm)², 4 %). 40 000 columns: the contrast of 120 000 pixels to 0.3 %, noise
    /// to 0.5 % (0.4 % were it Gaussian). Four standard errors.
    #[test]
    fn figures_of_independent_pixels() {
        let (rows, sigma) = (81, 12.0);
        let line = |row: usize| (-0.5 * ((row as f64 - 40.0) / sigma).powi(2)).exp();
        let block = |k: u64| {
            let key = Key::new(k, Purpose::SpecklePattern);
            let light =
                (0..400 * rows).map(|i| -line(i % rows) * (1.0 - key.uniform(i as u64)).ln());
            Block {
                rows,
                light: light.collect(),
            }
        };
        let blocks: Vec<Block> = (0..100).map(block).collect();
        let window = Window {
            reach: 40,
            middle: 1,
            beside: 12,
            lags: 3,
        };
        let figures = line_figures(&blocks, &window);
        let moment = |f: &dyn Fn(f64) -> f64, power: i32| {
            (0..rows)
                .map(|row| f(row as f64 - 40.0) * line(row).powi(power))
                .sum::<f64>()
        };
        let all = moment(&|_| 1.0, 1);
        let noise = moment(&|y| y * y, 2).sqrt() / all;
        let next = moment(&|_| 1.0, 2) / (all * all);
        let found = figures.noise;
        assert!(
            (found.error / found.value - 0.004).abs() < 0.002,
            "{found:?}"
        );
        let order = found.value / noise - 1.0;
        assert!(order > -0.02 && order < 3.0 * next, "{found:?} {noise}");
        for contrast in [figures.contrast, figures.contrast_beside] {
            assert!(
                (contrast.value - 1.0).abs() < 4.0 * contrast.error,
                "{contrast:?}"
            );
            assert!(contrast.error < 0.006, "{contrast:?}");
        }
        // Between lags 0 and 1, and far nearer to 0 than to 1.
        for grain in [figures.grain_along, figures.grain_across] {
            assert!(grain.value > 0.0 && grain.value < 1.2, "{grain:?}");
        }
        for (row, mean) in figures.mean.iter().enumerate() {
            assert!(
                (mean / line(row) - 1.0).abs() < 5.0 / 200.0,
                "{row}: {mean}"
            );
        }
    }

    #[test]
    fn a_gaussian_covariance_is_measured_exactly() {
        for deviation in [0.8, 2.3, 4.0] {
            let covariance: Vec<f64> = (0..16)
                .map(|lag| 0.9 * (-0.5 * (lag as f64 / deviation).powi(2)).exp())
                .collect();
            let expected = 2.0 * (2.0 * 2f64.ln()).sqrt() * deviation;
            assert!((width_at_half(&covariance) - expected).abs() < 1e-9);
        }
        assert_eq!(width_at_half(&[1.0, 0.9, 0.8]), f64::INFINITY);
    }
}

//! Fit of images of a line.

use super::model::mean_and_error;
use super::{Findings, FittedUnit, FittedValue, HalfStatistic, interval_of_jackknife};
use crate::error::Result;
use crate::profile::{Flags, Peak, PeakFinder, PeakSettings};
use crate::study::line_image::{BLOCK, FREEDOM, highest, lines_by_column, without_parabola};
use crate::study::peak_image::GreyImage;
use crate::study::recording::RecordedImages;
use std::path::Path;

/// Distance from the line beyond which pixels are dark, in standard deviations of the line.
const DARK_SIGMAS: f64 = 8.0;
/// Distance from the line within which pixels are lit, in standard deviations of the line.
const LIT_SIGMAS: f64 = 3.0;
/// Fraction of full scale above which noise may be clipped.
const CLIPPED: f64 = 0.9;
/// Fraction of columns with saturation or a second line above which the model is wrong.
const WRONG_COLUMNS: f64 = 0.02;

/// Name of the mean height of the line above the background.
pub const HEIGHT: &str = "height of the line";

/// Line and noise of one column.
struct Column {
    peak: Option<Peak>,
    /// Standard deviation of the Gaussian line that fits the counts, px. Noise biases the width of
    /// the centroid's window by a standard error or more, and that of the fit by far less.
    sigma: Option<f64>,
    lines: usize,
    /// Mean count of the dark pixels.
    dark: Option<f64>,
    /// Pairs of mean count and variance between images.
    noise: Vec<[f64; 2]>,
}

/// Fits the images of one pose.
///
/// # Errors
/// Returns `Error::Input` for images without a line in a fifth of the columns.
pub(super) fn fit_images(RecordedImages { paths, images }: &RecordedImages) -> Result<Findings> {
    let columns = columns(&paths[0], images)?;
    let halves = [0, 1].map(|half| {
        let blocks = columns
            .chunks(BLOCK)
            .enumerate()
            .filter(|(i, _)| i % 2 == half);
        blocks.map(|(_, block)| block).collect::<Vec<&[Column]>>()
    });
    let mut fit = Findings {
        misfits: misfits(&columns),
        ..Findings::default()
    };
    let path = &paths[0];
    fit.black_level(path, &halves);
    fit.noise(path, &halves, images);
    let saturated = fraction(&columns, |peak| peak.flags.contains(Flags::SATURATED));
    fit.statistics.push(HalfStatistic {
        name: "columns with saturation, fraction",
        fitted_half: Some(saturated),
        other_half: None,
        predicted: 0.0,
    });
    match saturated > WRONG_COLUMNS {
        true => fit.inseparable.push(
            "Line width, speckle contrast and saturation: the height of a saturated line is unknown.".to_owned(),
        ),
        false => {
            fit.shape(path, &halves, columns.len());
            fit.variations(path, &halves);
        }
    }
    fit.inseparable.push(
        "Laser power, reflectance, exposure time and quantum efficiency: only their product determines the counts."
            .to_owned(),
    );
    fit.inseparable.push(
        "Width of the laser beam and blur of the lens: only the width of the image of the line."
            .to_owned(),
    );
    Ok(fit)
}

/// Finds the line in the first image, and the noise between pairs of images.
fn columns(path: &Path, images: &[GreyImage]) -> Result<Vec<Column>> {
    let first = &images[0];
    let settings = PeakSettings {
        finder: PeakFinder::Centroid,
        ..PeakSettings::new(first.saturation_dn)
    };
    let of_column = lines_by_column(path, &first.counts, &settings)?;
    let settings = PeakSettings {
        finder: PeakFinder::GaussianFit,
        ..settings
    };
    let fits = lines_by_column(path, &first.counts, &settings)?;
    let sigmas = fits
        .iter()
        .map(|lines| highest(lines).map(|peak| peak.sigma));
    let columns = of_column.iter().zip(sigmas).enumerate();
    let columns =
        columns.map(|(number, (lines, sigma))| column(number, (&lines[..], sigma), images));
    Ok(columns.collect())
}

fn column(number: usize, (lines, sigma): (&[Peak], Option<f64>), images: &[GreyImage]) -> Column {
    let peak = highest(lines).copied();
    let first = images[0].counts.column(number);
    let reach = |sigmas: f64| {
        peak.as_ref()
            .map(|peak| (peak.row, sigmas * peak.sigma.max(0.5)))
    };
    let distance = |row: usize, line: f64| (row as f64 + 0.5 - line).abs();
    let is_dark = |row: usize| {
        lines
            .iter()
            .all(|line| distance(row, line.row) > DARK_SIGMAS * line.sigma.max(0.5) + 2.0)
    };
    let dark: Vec<f64> = (0..first.len())
        .filter(|&row| is_dark(row))
        .map(|row| f64::from(first[row]))
        .collect();
    let is_lit =
        |row: usize| reach(LIT_SIGMAS).is_some_and(|(line, reach)| distance(row, line) < reach);
    let clipped = CLIPPED * f64::from(images[0].saturation_dn);
    let mut noise = Vec::new();
    for pair in images.chunks_exact(2) {
        let [a, b] = [0, 1].map(|i| pair[i].counts.column(number));
        // One dark row in eight limits the number of pixels.
        let rows = (0..first.len()).filter(|&row| is_lit(row) || (row % 8 == 0 && is_dark(row)));
        for row in rows {
            let [a, b] = [a[row], b[row]].map(f64::from);
            if (a + b) / 2.0 < clipped {
                noise.push([(a + b) / 2.0, (a - b).powi(2) / 2.0]);
            }
        }
    }
    Column {
        sigma,
        lines: lines.len(),
        dark: (!dark.is_empty()).then(|| dark.iter().sum::<f64>() / dark.len() as f64),
        peak,
        noise,
    }
}

fn fraction(columns: &[Column], of: impl Fn(&Peak) -> bool) -> f64 {
    let peaks = columns.iter().filter_map(|column| column.peak.as_ref());
    peaks.clone().filter(|peak| of(peak)).count() as f64 / peaks.count().max(1) as f64
}

fn misfits(columns: &[Column]) -> Vec<String> {
    let mut misfits = Vec::new();
    let saturated = fraction(columns, |peak| peak.flags.contains(Flags::SATURATED));
    if saturated > WRONG_COLUMNS {
        misfits.push(format!(
            "The line is saturated in {:.0} % of the columns: record with a shorter exposure.",
            100.0 * saturated
        ));
    }
    let second =
        columns.iter().filter(|column| column.lines > 1).count() as f64 / columns.len() as f64;
    if second > WRONG_COLUMNS {
        misfits.push(format!(
            "{:.0} % of the columns have a second line: reflections or a second laser, which the model does not have.",
            100.0 * second
        ));
    }
    misfits
}

/// Returns the blocks without the one that is left out.
fn used<'a>(
    blocks: &'a [&'a [Column]],
    left_out: Option<usize>,
) -> impl Iterator<Item = &'a Column> + Clone {
    let blocks = blocks
        .iter()
        .enumerate()
        .filter(move |(i, _)| Some(*i) != left_out);
    blocks.flat_map(|(_, block)| block.iter())
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

impl Findings {
    fn add(
        &mut self,
        (name, key, unit): (&'static str, Option<&'static str>, FittedUnit),
        path: &Path,
        halves: &[Vec<&[Column]>; 2],
        of: impl Fn(&[&[Column]], Option<usize>) -> f64,
    ) {
        let value = interval_of_jackknife(halves[0].len(), |left_out| of(&halves[0], left_out));
        if value.iter().all(|v| v.is_finite()) {
            self.values
                .push(FittedValue::new(name, key, unit, value, path));
            let other = of(&halves[1], None);
            self.statistics.push(HalfStatistic {
                name,
                fitted_half: Some(value[0]),
                other_half: other.is_finite().then_some(other),
                predicted: value[0],
            });
        }
    }

    fn black_level(&mut self, path: &Path, halves: &[Vec<&[Column]>; 2]) {
        let name = ("black level", Some("camera.black_level_dn"), FittedUnit::Dn);
        self.add(name, path, halves, |blocks, left_out| {
            mean(used(blocks, left_out).filter_map(|column| column.dark))
        });
    }

    /// Adds gain and read noise from the variance between images, if the gain predicts the variance
    /// of the other half better than constant noise.
    fn noise(&mut self, path: &Path, halves: &[Vec<&[Column]>; 2], images: &[GreyImage]) {
        if images.len() < 2 {
            self.inseparable.push(
                "Gain and read noise: two images of the same pose or more are required. They differ only in noise."
                    .to_owned(),
            );
            return;
        }
        let black = mean(used(&halves[0], None).filter_map(|column| column.dark));
        let line = |left_out| photon_transfer(&halves[0], left_out, black);
        let [dark, gain] = line(None);
        let all = used(&halves[0], None).flat_map(|column| &column.noise);
        let constant = mean(all.map(|[_, variance]| *variance));
        let gains: Vec<f64> = halves[1]
            .iter()
            .map(|block| {
                let pairs = block.iter().flat_map(|column| &column.noise);
                let of_pair = |&[count, variance]: &[f64; 2]| {
                    let predicted = (dark + gain * (count - black)).max(1e-6);
                    // The logarithmic score of a χ² variable with one degree of freedom.
                    let score = |expected: f64| expected.ln() + variance / expected;
                    score(constant.max(1e-6)) - score(predicted)
                };
                mean(pairs.map(of_pair))
            })
            .collect();
        let (improvement, error) = mean_and_error(&gains);
        if !(improvement > 2.0 * error && gain > 0.0) {
            self.inseparable.push(
                "Gain and read noise: the noise does not increase with the counts.".to_owned(),
            );
            return;
        }
        let name = ("gain", Some("camera.gain_dn_per_e"), FittedUnit::DnPerE);
        self.add(name, path, halves, |blocks, left_out| {
            photon_transfer(blocks, left_out, black)[1]
        });
        let name = ("read noise", Some("camera.read_noise_e"), FittedUnit::E);
        self.add(name, path, halves, |blocks, left_out| {
            let [dark, gain] = photon_transfer(blocks, left_out, black);
            // Rounding to counts has a variance of 1/12.
            (dark - 1.0 / 12.0).max(0.0).sqrt() / gain
        });
    }

    /// Adds width and height of the line.
    fn shape(&mut self, path: &Path, halves: &[Vec<&[Column]>; 2], columns: usize) {
        // The first and the last column are at −1 and 1.
        let half = (columns - 1) as f64 / 2.0;
        let names = [
            ("standard deviation of the line, first column", -1.0),
            ("standard deviation of the line, middle column", 0.0),
            ("standard deviation of the line, last column", 1.0),
        ];
        for (name, at) in names {
            self.add(
                (name, None, FittedUnit::Px),
                path,
                halves,
                |blocks, left_out| {
                    let points = used(blocks, left_out).filter_map(|column| {
                        let x = f64::from(valid(column)?.column) / half - 1.0;
                        Some([x, column.sigma?, 1.0])
                    });
                    let [constant, slope] = straight_line(points);
                    constant + slope * at
                },
            );
        }
        let name = (HEIGHT, None, FittedUnit::Dn);
        self.add(name, path, halves, |blocks, left_out| {
            let valid = used(blocks, left_out).filter_map(valid);
            mean(valid.map(|peak| peak.height))
        });
    }

    /// Adds scatter and brightness of the line.
    fn variations(&mut self, path: &Path, halves: &[Vec<&[Column]>; 2]) {
        let rest = |blocks: &[&[Column]], left_out: Option<usize>, of: fn(&Peak) -> f64| {
            let blocks = blocks
                .iter()
                .enumerate()
                .filter(|(i, _)| Some(*i) != left_out);
            let rests = blocks.map(|(_, block)| {
                let values = block
                    .iter()
                    .map(|column| valid(column).map_or(f64::NAN, of));
                without_parabola(&values.collect::<Vec<f64>>())
            });
            rests.collect::<Vec<Vec<f64>>>()
        };
        let covariance = |rests: &[Vec<f64>], lag: usize| {
            let products = rests.iter().flat_map(|rest| rest.iter().zip(&rest[lag..]));
            mean(
                products
                    .map(|(a, b)| a * b)
                    .filter(|product| product.is_finite()),
            )
        };
        let name = ("scatter of the detected row", None, FittedUnit::Px);
        self.add(name, path, halves, |blocks, left_out| {
            (FREEDOM * covariance(&rest(blocks, left_out, |peak| peak.row), 0)).sqrt()
        });
        let name = (
            "correlation of detected rows of adjacent columns",
            None,
            FittedUnit::One,
        );
        self.add(name, path, halves, |blocks, left_out| {
            let rests = rest(blocks, left_out, |peak| peak.row);
            covariance(&rests, 1) / covariance(&rests, 0)
        });
        let name = ("speckle contrast of the line", None, FittedUnit::One);
        self.add(name, path, halves, |blocks, left_out| {
            let valid = used(blocks, left_out).filter_map(valid);
            let level = mean(valid.map(|peak| peak.intensity));
            (FREEDOM * covariance(&rest(blocks, left_out, |peak| peak.intensity), 0)).sqrt() / level
        });
        let name = (
            "correlation of the brightness of adjacent columns",
            None,
            FittedUnit::One,
        );
        self.add(name, path, halves, |blocks, left_out| {
            let rests = rest(blocks, left_out, |peak| peak.intensity);
            covariance(&rests, 1) / covariance(&rests, 0)
        });
    }
}

/// Returns the peak of a column that has one unsaturated line.
fn valid(column: &Column) -> Option<&Peak> {
    let peak = column.peak.as_ref()?;
    let single = column.lines == 1
        && !peak
            .flags
            .intersects(Flags::SATURATED | Flags::IMAGE_BORDER);
    single.then_some(peak)
}

/// Fits the variance between images as dark variance plus gain times signal. Returns both.
///
/// The squared difference of two counts has a χ² distribution with one degree of freedom. The
/// weights are therefore inverse squares of the expected variance, from the previous iteration.
fn photon_transfer(blocks: &[&[Column]], left_out: Option<usize>, black: f64) -> [f64; 2] {
    let pairs = || used(blocks, left_out).flat_map(|column| &column.noise);
    let mut line = [mean(pairs().map(|[_, variance]| *variance)), 0.0];
    for _ in 0..6 {
        let [dark, gain] = line;
        let points = pairs().map(|&[count, variance]| {
            let signal = count - black;
            let expected = (dark + gain * signal.max(0.0)).max(1.0 / 12.0);
            [signal, variance, expected.powi(-2)]
        });
        line = straight_line(points);
    }
    line
}

/// Returns constant and slope of the straight line through points [x, y, weight].
fn straight_line(points: impl Iterator<Item = [f64; 3]>) -> [f64; 2] {
    let mut sums = [0.0; 5];
    for [x, y, weight] in points {
        let terms = [1.0, x, x * x, y, x * y];
        sums.iter_mut()
            .zip(terms)
            .for_each(|(sum, term)| *sum += weight * term);
    }
    let [n, x, xx, y, xy] = sums;
    let slope = (n * xy - x * y) / (n * xx - x * x);
    [(y - slope * x) / n, slope]
}

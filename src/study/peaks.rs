//! Bias and noise of the peak finders, plotted for lines at known positions.

use super::synthetic::{BLACK, LineCondition, MAX_COUNT, PHASES};
use crate::error::{Result, printable};
use crate::profile::{PeakFinder, PeakSettings, find_peaks};
use crate::report::axes::{Axes, Axis, ChartPoint, legend};
use crate::report::svg::Svg;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::{RunControl, files};
use crate::speckle::lookup::{Coherence, Method, SpeckleTexture};
use crate::speckle::pattern::PatternSpec;
use crate::speckle::theory::centroid_noise;
use rayon::prelude::*;
use serde::Serialize;
use std::path::PathBuf;

/// Content of `peaks.json`.
#[derive(Debug, Serialize)]
pub struct PeakChart {
    /// Base condition; each axis changes one quantity.
    pub base: LineCondition,
    /// Results for each quantity that is changed.
    pub axes: Vec<ChartAxis>,
    /// Path of the plot.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// Errors of the finders as a function of one quantity.
#[derive(Debug, Serialize)]
pub struct ChartAxis {
    /// Heading.
    pub title: &'static str,
    /// Name of the quantity, with its unit.
    pub quantity: &'static str,
    /// Values of the quantity in ascending order.
    pub values: Vec<f64>,
    /// Complete condition at each value.
    pub conditions: Vec<LineCondition>,
    /// Errors by finder and value.
    pub finders: Vec<(PeakFinder, Vec<Option<FinderError>>)>,
    /// Centroid noise of a Gaussian line according to the speckle formula, px.
    pub speckle_law_px: Option<Vec<f64>>,
}

/// Errors of a finder's row relative to the centroid of the light, px.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct FinderError {
    /// Root mean square of the mean error over sub-pixel positions, minus the contribution of noise
    /// in a finite number of trials. It is 0 if noise explains it within four standard deviations.
    pub bias_px: f64,
    /// Standard deviation about the mean errors.
    pub noise_px: f64,
    /// Fraction of lines that were found.
    pub found: f64,
}

const BASE: LineCondition = LineCondition {
    sigma: 1.5,
    skewness: 0.0,
    height: 600.0,
    noise: 6.0,
    speckle_px: 0.0,
};

/// Number of trials per sub-pixel position.
const TRIALS: usize = 300;

/// Axis of the chart: title, quantity, values, and the condition for a value.
type Variation = (
    &'static str,
    &'static str,
    &'static [f64],
    fn(f64) -> LineCondition,
);

const AXES: [Variation; 5] = [
    (
        "Width",
        "σ of the line, px",
        &[0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6],
        |sigma| LineCondition { sigma, ..BASE },
    ),
    (
        "Skew",
        "skewness of the line",
        &[0.0, 0.1, 0.2, 0.4, 0.6, 0.8],
        |skewness| LineCondition { skewness, ..BASE },
    ),
    (
        "Saturation",
        "height of the line / full scale",
        &[0.5, 0.9, 1.2, 1.5, 2.0, 4.0, 8.0, 16.0],
        |share| LineCondition {
            height: share * (MAX_COUNT as f64 - BLACK),
            ..BASE
        },
    ),
    (
        "Noise",
        "height of the line / noise of a pixel",
        &[8.0, 12.0, 20.0, 50.0, 100.0, 300.0, 1000.0],
        |snr| {
            let height = (BASE.noise * snr).min(BASE.height);
            LineCondition {
                height,
                noise: height / snr,
                ..BASE
            }
        },
    ),
    (
        "Speckle",
        "speckle size h, px",
        &[0.25, 0.5, 1.0, 1.5, 2.0, 4.0],
        |speckle_px| LineCondition {
            speckle_px,
            height: 200.0,
            noise: 2.0,
            ..BASE
        },
    ),
];

/// Returns the number of conditions of [`peak_chart`].
pub fn chart_conditions() -> usize {
    AXES.iter().map(|axis| axis.2.len()).sum()
}

/// Writes `peaks.json` and `peaks.svg`.
pub fn peak_chart<'a>(
    seed: u64,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<PeakChart> {
    let names = Names::of(["peaks.json", "peaks.svg"]);
    let out = out.into().claim(&[], &names)?.path;
    let spec = PatternSpec {
        slices: 32,
        seed,
        ..PatternSpec::default()
    };
    let lookup = SpeckleTexture::new(&spec, Method::Field, Coherence::FULL)?;
    let done = std::sync::atomic::AtomicU64::new(0);
    let axes = AXES
        .par_iter()
        .map(|&(title, quantity, values, condition)| {
            let random = matches!(title, "Noise" | "Speckle");
            let conditions: Vec<LineCondition> = values.iter().map(|&x| condition(x)).collect();
            let rows = conditions
                .par_iter()
                .map(|condition| {
                    control.check()?;
                    let row = PeakFinder::ALL
                        .map(|finder| errors(condition, random, finder, &lookup, seed));
                    let n = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                    (control.progress)(n + 1);
                    Ok(row)
                })
                .collect::<Result<Vec<_>>>()?;
            let of = |k: usize| rows.iter().map(|row| row[k]).collect();
            let law = |c: &LineCondition| centroid_noise(c.speckle_px, c.sigma, 1.0);
            Ok(ChartAxis {
                title,
                quantity,
                values: values.to_vec(),
                finders: PeakFinder::ALL.into_iter().zip((0..4).map(of)).collect(),
                speckle_law_px: (title == "Speckle").then(|| conditions.iter().map(law).collect()),
                conditions,
            })
        })
        .collect::<Result<Vec<_>>>()?;
    let chart = PeakChart {
        base: BASE,
        axes,
        picture: out.join("peaks.svg"),
    };
    files::write_bytes(&chart.picture, drawing(&chart).as_bytes())?;
    files::write_json(&out.join("peaks.json"), &chart)?;
    Ok(chart)
}

/// Returns the errors of `finder` for lines of this condition; `None` if it finds fewer than half.
/// The bias is estimated without noise, unless the light itself is `random`.
fn errors(
    condition: &LineCondition,
    random: bool,
    finder: PeakFinder,
    lookup: &SpeckleTexture,
    seed: u64,
) -> Option<FinderError> {
    let noisy = spread(condition, finder, TRIALS, lookup, seed)?;
    let silent = LineCondition {
        noise: 0.0,
        ..*condition
    };
    let bias = match random {
        true => noisy,
        false => spread(&silent, finder, 1, lookup, seed)?,
    };
    Some(FinderError {
        bias_px: bias.bias_px,
        ..noisy
    })
}

/// Returns the errors over `trials` lines per sub-pixel position.
fn spread(
    condition: &LineCondition,
    finder: PeakFinder,
    trials: usize,
    lookup: &SpeckleTexture,
    seed: u64,
) -> Option<FinderError> {
    let settings = PeakSettings {
        finder,
        ..PeakSettings::new(MAX_COUNT)
    };
    let image = condition.image(PHASES * trials, lookup, seed);
    let mut by_phase = vec![Vec::new(); PHASES];
    for peak in find_peaks(&image, &settings) {
        let column = peak.column as usize;
        by_phase[column % PHASES].push(peak.row - condition.truth(column));
    }
    let found = by_phase.iter().map(Vec::len).sum::<usize>() as f64;
    if by_phase.iter().any(|errors| 2 * errors.len() < trials) {
        return None;
    }
    let phases = PHASES as f64;
    let (mut means, mut variances, mut by_chance) = (0.0, 0.0, 0.0);
    for errors in &by_phase {
        let n = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / n;
        let squares: f64 = errors.iter().map(|e| (e - mean).powi(2)).sum();
        let variance = squares / (n - 1.0).max(1.0);
        means += mean * mean / phases;
        variances += variance / phases;
        by_chance += variance / n / phases;
    }
    // The mean square of `phases` normal numbers has a relative standard deviation of √(2/phases).
    let excess = means - by_chance;
    let is_chance = excess < 4.0 * by_chance * (2.0 / phases).sqrt();
    Some(FinderError {
        bias_px: if is_chance { 0.0 } else { excess.sqrt() },
        noise_px: variances.sqrt(),
        found: found / image.columns() as f64,
    })
}

const COLORS: [&str; 4] = ["#c0392b", "#2471a3", "#1e8449", "#b7950b"];
const LAW: &str = "stroke='#333' stroke-width='1.6' stroke-dasharray='5 3'";

fn drawing(chart: &PeakChart) -> String {
    let mut svg = Svg::file([1390.0, 690.0], 12.0);
    let title = "How far off each way to find the laser line is";
    svg.text([60.0, 26.0], "font-size='17' font-weight='bold'", title);
    let fills = COLORS.map(|color| format!("fill='{color}'"));
    let mut marks: Vec<_> = (0..4)
        .map(|k| (ChartPoint::Dot, &fills[k][..], NAMES[k]))
        .collect();
    marks.push((
        ChartPoint::Line,
        LAW,
        "law of speckle for the centroid, 0.39·√(hσ), pixels ≪ h",
    ));
    legend(&mut svg, [60.0, 52.0], [175.0, 0.0], &marks);
    for (column, axis) in chart.axes.iter().enumerate() {
        let values: Vec<String> = axis.values.iter().map(f64::to_string).collect();
        for (row, (what, of)) in QUANTITIES.into_iter().enumerate() {
            let left = 70.0 + 265.0 * column as f64;
            let panel = Axes {
                frame: [left, 95.0 + 280.0 * row as f64, 205.0, 190.0],
                beyond: [0.0; 2],
                title: &format!("{}: {what}, px", axis.title),
                x: Axis::named(axis.quantity, &values),
                y: Axis::logarithmic("", [1e-4, 1.0]),
            };
            panel.draw(&mut svg);
            for (k, (_, errors)) in axis.finders.iter().enumerate() {
                let value =
                    |(i, e): (usize, &Option<FinderError>)| Some((i as f64, of(e.as_ref()?)));
                let found: Vec<_> = errors.iter().enumerate().filter_map(value).collect();
                let style = format!("stroke='{}' stroke-width='1.6'", COLORS[k]);
                // A value without results interrupts the curve.
                for run in found.chunk_by(|a, b| b.0 == a.0 + 1.0) {
                    panel.curve(&mut svg, run.iter().copied(), &style);
                }
                for (x, y) in found {
                    svg.circle(panel.at(x, y), 2.6, &fills[k]);
                }
            }
            if let (1, Some(law)) = (row, &axis.speckle_law_px) {
                let law = law.iter().enumerate().map(|(i, &y)| (i as f64, y));
                panel.curve(&mut svg, law, LAW);
            }
        }
    }
    caption(&mut svg);
    svg.finish()
}

const NAMES: [&str; 4] = [
    "centroid",
    "log-parabola",
    "Gaussian fit",
    "zero of the derivative",
];

/// Quantities of the two rows of panels.
const QUANTITIES: [ErrorQuantity; 2] = [("bias", |e| e.bias_px), ("noise", |e| e.noise_px)];

type ErrorQuantity = (&'static str, fn(&FinderError) -> f64);

fn caption(svg: &mut Svg) {
    let lines = [
        format!(
            "Bias: mean error against the light's centre of gravity, rms over {PHASES} positions in \
             the pixel; noise: standard deviation about it. {TRIALS} lines per position. On the \
             lowest line: less than 0.0001 px, or no bias beyond chance."
        ),
        format!(
            "Where a panel does not say otherwise: σ = {} px, {} counts high on {BLACK} on a scale of \
             {MAX_COUNT}, noise of a pixel {} counts; with speckle (contrast 1) 200 counts high on average, \
             noise 2 counts.",
            BASE.sigma, BASE.height, BASE.noise
        ),
    ];
    for (i, line) in lines.iter().enumerate() {
        svg.text([60.0, 645.0 + 18.0 * i as f64], "fill='#444'", line);
    }
}

//! Plots of the wave-optics experiments as SVG text.

use super::axes::{Axes, Axis, ChartPoint, legend};
use super::svg::Svg;
use crate::speckle::motion::overlap_correlation;
use crate::wave::centroid::CentroidRow;
use crate::wave::correlation::MeanEstimate;
use crate::wave::motion::MotionRow;

const WAVES: &str = "#c0392b";
const WAVES_OTHER: &str = "#2471a3";
const THEORY: &str = "stroke='#222' stroke-width='1.5'";
const LIMIT: &str = "stroke='#222' stroke-width='1.5' stroke-dasharray='5 4'";
const PREDICTION: &str = "fill='none' stroke='#222'";

/// Draws the function `of` over the horizontal axis up to `end`.
fn law(axes: &Axes, svg: &mut Svg, end: f64, style: &str, of: impl Fn(f64) -> f64) {
    let places = (0..=200).map(|i| end * f64::from(i) / 200.0);
    axes.curve(svg, places.map(|x| (x, of(x))), style);
}

/// Draws a dot with an error bar over its interval.
fn estimate(axes: &Axes, svg: &mut Svg, x: f64, e: &MeanEstimate, color: &str) {
    let stroke = format!("stroke='{color}'");
    let [low, high] = [e.low, e.high].map(|y| axes.at(x, y));
    svg.line(low, high, &stroke);
    for [x, y] in [low, high] {
        svg.line([x - 3.0, y], [x + 3.0, y], &stroke);
    }
    ChartPoint::Dot.draw(svg, axes.at(x, e.value), &format!("fill='{color}'"));
}

/// Draws correlation and displacement of [`MotionRow`]s.
///
/// - Left: γ against δ from wave optics with 95 % intervals, the overlap law as a curve, and
///   diamonds for the prediction with defocus.
/// - Centre and right: measured minus predicted γ and displacement (µm on the sensor) of each row.
///   γ is also shown for the speckle fields used by a scan (`textures`, one per row).
/// - Bottom: names of the rows.
pub fn motion_plot(rows: &[MotionRow], textures: &[f64]) -> String {
    assert_eq!(rows.len(), textures.len(), "one texture a row");
    let names_top = 490.0;
    let half = rows.len().div_ceil(2);
    let mut svg = Svg::file([1180.0, names_top + 20.0 * half as f64 + 20.0], 12.0);
    correlation(&mut svg, rows);
    let gamma = |k: usize| {
        let (row, value) = (&rows[k], textures[k]);
        let texture = MeanEstimate {
            value,
            low: value,
            high: value,
        };
        Some([&row.waves.gamma, &texture].map(|e| minus(e, row.gamma_defocused)))
    };
    let titles = ["Correlation: waves minus prediction", "γ"];
    let names = ["waves", "scan's fields"];
    residual_panel(&mut svg, 460.0, titles, names, rows.len(), gamma);
    let titles = [
        "Displacement: waves minus tensor formula",
        "µm on the sensor",
    ];
    let names = ["along x", "along y"];
    residual_panel(&mut svg, 850.0, titles, names, rows.len(), |k| {
        let row = &rows[k];
        let found = row.waves.displacement?;
        let axis = |k: usize| minus(&found[k].scaled(1e3), row.displacement_um[k]);
        Some([axis(0), axis(1)])
    });
    for (k, row) in rows.iter().enumerate() {
        let (column, line) = ((k / half) as f64, (k % half) as f64);
        let place = [70.0 + 550.0 * column, names_top + 20.0 * line];
        svg.text(place, "", &format!("{}: {}", k + 1, row.name));
    }
    svg.finish()
}

/// Draws γ against δ: wave optics, law and prediction.
fn correlation(svg: &mut Svg, rows: &[MotionRow]) {
    let deltas = rows.iter().map(|r| r.delta);
    let end = (deltas.fold(0.4, f64::max) * 1.1).min(1.1);
    let axes = Axes {
        frame: [70.0, 50.0, 300.0, 360.0],
        beyond: [0.0; 2],
        title: "Correlation of the speckle intensity",
        x: Axis::linear(
            "δ = |A_p|/D, shift across the pupil in diameters",
            [0.0, end],
        ),
        y: Axis::linear("γ", [0.0, 1.0]),
    };
    axes.draw(svg);
    law(&axes, svg, end, THEORY, overlap_correlation);
    for row in rows {
        let place = axes.at(row.delta, row.gamma_defocused);
        ChartPoint::Diamond.draw(svg, place, PREDICTION);
        estimate(&axes, svg, row.delta, &row.waves.gamma, WAVES);
    }
    let marks = [
        (ChartPoint::Line, THEORY, "overlap law γ(δ)"),
        (ChartPoint::Diamond, PREDICTION, "prediction with defocus"),
        (
            ChartPoint::Dot,
            &format!("fill='{WAVES}'")[..],
            "waves, 95 % interval",
        ),
    ];
    legend(svg, [180.0, 70.0], [0.0, 18.0], &marks);
}

fn minus(e: &MeanEstimate, value: f64) -> MeanEstimate {
    MeanEstimate {
        value: e.value - value,
        low: e.low - value,
        high: e.high - value,
    }
}

/// Draws the two values of `residuals` for each row, named `names`, against the row number.
fn residual_panel(
    svg: &mut Svg,
    left: f64,
    [title, unit]: [&str; 2],
    names: [&str; 2],
    rows: usize,
    residuals: impl Fn(usize) -> Option<[MeanEstimate; 2]>,
) {
    let found: Vec<(f64, [MeanEstimate; 2])> = (0..rows)
        .filter_map(|k| Some(((k + 1) as f64, residuals(k)?)))
        .collect();
    let bounds = found.iter().flat_map(|(_, r)| r);
    let reach = bounds.fold(0.01, |m: f64, e| m.max(-e.low).max(e.high)) * 1.1;
    let axes = Axes {
        frame: [left, 50.0, 300.0, 360.0],
        beyond: [0.0; 2],
        title,
        x: Axis::linear("row", [0.0, rows as f64 + 1.0]),
        y: Axis::linear(unit, [-reach, reach]),
    };
    axes.draw(svg);
    axes.curve(svg, [(0.0, 0.0), (rows as f64 + 1.0, 0.0)], THEORY);
    for (k, [one, other]) in &found {
        estimate(&axes, svg, k - 0.15, one, WAVES);
        estimate(&axes, svg, k + 0.15, other, WAVES_OTHER);
    }
    let fills = [WAVES, WAVES_OTHER].map(|color| format!("fill='{color}'"));
    let marks = [0, 1].map(|k| (ChartPoint::Dot, &fills[k][..], names[k]));
    legend(svg, [left + 190.0, 70.0], [0.0, 18.0], &marks);
}

/// Plots centroid noise against line width, both in units of the speckle size: wave optics with 95
/// % intervals over all rows and over bright ones. Curves are the law 0.3905·√(hσ) for a Gaussian
/// line with fully developed speckle, and the limit h/π of a diffraction-limited spot (Dorsch,
/// Häusler & Herrmann 1994).
pub fn centroid_plot(rows: &[CentroidRow]) -> String {
    let widest = rows.iter().map(|r| r.width).fold(1.0, f64::max) * 1.08;
    let highest = rows.iter().map(|r| r.waves.high.max(r.law));
    let axes = Axes {
        frame: [80.0, 50.0, 520.0, 360.0],
        beyond: [0.0; 2],
        title: "Noise of a laser line's centroid",
        x: Axis::linear("w/h: 1/e² radius of the line in grains", [0.0, widest]),
        y: Axis::linear(
            "standard deviation of the centroid in grains",
            [0.0, highest.fold(0.4, f64::max) * 1.1],
        ),
    };
    let mut svg = Svg::file([640.0, 480.0], 12.0);
    axes.draw(&mut svg);
    law(&axes, &mut svg, widest, THEORY, |w| {
        0.3905 * (w / 2.0).sqrt()
    });
    law(&axes, &mut svg, widest, LIMIT, |_| {
        std::f64::consts::FRAC_1_PI
    });
    for row in rows {
        estimate(&axes, &mut svg, row.width, &row.waves, WAVES);
        estimate(&axes, &mut svg, row.width, &row.waves_bright, WAVES_OTHER);
    }
    let fills = [WAVES, WAVES_OTHER].map(|color| format!("fill='{color}'"));
    let marks = [
        (ChartPoint::Line, THEORY, "0.3905·√(h·σ), σ = w/2"),
        (ChartPoint::Line, LIMIT, "h/π, spot (Dorsch 1994)"),
        (ChartPoint::Dot, &fills[0], "waves, all rows, 95 % interval"),
        (
            ChartPoint::Dot,
            &fills[1],
            "waves, rows over half the mean light",
        ),
    ];
    legend(&mut svg, [330.0, 320.0], [0.0, 18.0], &marks);
    svg.finish()
}

#[cfg(test)]
mod tests;

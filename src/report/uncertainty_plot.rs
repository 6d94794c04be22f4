//! Plot of predicted uncertainties and Monte Carlo results along the columns.

use super::axes::{Axes, Axis, ChartPoint, legend};
use super::svg::Svg;
use crate::inspect::uncertainty::ColumnUncertainty;

/// Number of columns combined into one dot of the coverage plot.
const TOGETHER: usize = 16;
const PREDICTED: &str = "stroke='#222' stroke-width='1.6'";
const FOUND: &str = "fill='#c0392b'";
const EXPECTED: &str = "fill='#d6dbdf'";

/// Plots the predicted and the Monte Carlo standard uncertainty of each column's point, µm, above.
/// Plots the fraction of 95 % intervals that contain the true value below.
pub fn uncertainty_plot(rows: &[ColumnUncertainty], columns: u32, headline: [&str; 2]) -> String {
    let mut svg = Svg::file([1100.0, 660.0], 12.0);
    svg.text(
        [80.0, 30.0],
        "font-size='17' font-weight='bold'",
        headline[0],
    );
    svg.text([80.0, 52.0], "", headline[1]);
    let marks = [
        (ChartPoint::Line, PREDICTED, "predicted from the scene"),
        (
            ChartPoint::Area,
            EXPECTED,
            "where 95 of 100 dots should lie",
        ),
        (
            ChartPoint::Dot,
            FOUND,
            "Monte Carlo: scatter of the simulated measurements",
        ),
    ];
    legend(&mut svg, [80.0, 80.0], [250.0, 0.0], &marks);
    sigmas(&mut svg, rows, columns);
    coverage(&mut svg, rows, columns);
    svg.finish()
}

fn sigmas(svg: &mut Svg, rows: &[ColumnUncertainty], columns: u32) {
    let predicted = |r: &ColumnUncertainty| r.predicted_px * r.um_per_px;
    let found = |r: &ColumnUncertainty| r.monte_carlo_px * r.um_per_px;
    let highest = rows.iter().map(|r| predicted(r).max(found(r)));
    let axes = Axes {
        frame: [80.0, 110.0, 980.0, 260.0],
        beyond: [0.0; 2],
        title: "Standard uncertainty of each column's point, µm",
        x: Axis::linear("", [0.0, columns as f64]),
        y: Axis::linear("", [0.0, 1.1 * highest.fold(1e-3, f64::max)]),
    };
    let middle = |r: &ColumnUncertainty| r.column as f64 + 0.5;
    let runs = || rows.chunk_by(|a, b| b.column == a.column + 1);
    // 95 % interval of estimates from this number of seeds.
    for run in runs() {
        let edge = |sign: f64| -> Vec<(f64, f64)> {
            let place = |r: &ColumnUncertainty| {
                let spread = 1.96 / (2.0 * (r.seeds.max(2) - 1) as f64).sqrt();
                (middle(r), predicted(r) * (1.0 + sign * spread))
            };
            run.iter().map(place).collect()
        };
        axes.band(svg, &edge(1.0), &edge(-1.0), EXPECTED);
    }
    axes.draw(svg);
    for r in rows {
        svg.circle(axes.at(middle(r), found(r)), 1.4, FOUND);
    }
    for run in runs() {
        axes.curve(
            svg,
            run.iter().map(|r| (middle(r), predicted(r))),
            PREDICTED,
        );
    }
}

fn coverage(svg: &mut Svg, rows: &[ColumnUncertainty], columns: u32) {
    let title = format!(
        "Share of the 95 % intervals that hold the truth, {TOGETHER} columns a dot, % \
         (grey: 94 to 96)"
    );
    let columns = columns as f64;
    let axes = Axes {
        frame: [80.0, 450.0, 980.0, 150.0],
        beyond: [0.0; 2],
        title: &title,
        x: Axis::linear("column of the sensor, px", [0.0, columns]),
        y: Axis::linear("", [80.0, 100.0]),
    };
    let flat = |y| [(0.0, y), (columns, y)];
    axes.band(svg, &flat(96.0), &flat(94.0), EXPECTED);
    axes.draw(svg);
    for rows in rows.chunks(TOGETHER) {
        let seeds: usize = rows.iter().map(|r| r.seeds).sum();
        let covered: usize = rows.iter().map(|r| r.covered).sum();
        let middle = rows[rows.len() / 2].column as f64 + 0.5;
        let share = 100.0 * covered as f64 / seeds.max(1) as f64;
        ChartPoint::Dot.draw(svg, axes.at(middle, share), FOUND);
    }
}

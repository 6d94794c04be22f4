//! Predicted uncertainties beside those of a Monte Carlo run, along the columns.

use super::cloud::CloudPoint;
use crate::report::chart::short;
use serde::Serialize;
use std::fmt::Write;

/// What many seeds say of one column.
#[derive(Debug, Clone, Serialize)]
pub struct ColumnUncertainty {
    /// Column of the image.
    pub column: u32,
    /// Row of the line without speckle and noise, px.
    pub true_row_px: f64,
    /// Seeds in which the column's peak was found, without a flag.
    pub seeds: usize,
    /// Predicted standard uncertainty, root mean square over the seeds, px.
    pub predicted_px: f64,
    /// Standard deviation of the row over the seeds, px.
    pub monte_carlo_px: f64,
    /// Mean error of the row, px.
    pub bias_px: f64,
    /// Seeds whose 95 % interval, ±1.96 predicted uncertainties, holds the truth.
    pub covered: usize,
    /// Movement of the point for a row more, µm.
    pub um_per_px: f64,
}

/// A cloud's uncertainties, and how its deviations compare with them.
#[derive(Debug, Clone, Serialize)]
pub struct UncertaintyStatistics {
    /// Points without a flag; the others do not count.
    pub points: usize,
    /// Median of their positions' standard uncertainties, µm.
    pub median_sigma_um: f64,
    /// Share whose deviation is within 1.96 times its own standard uncertainty: 0.95
    /// of a part that is as its CAD says, less of any other.
    pub within_95: f64,
}

impl UncertaintyStatistics {
    /// `None` without such points.
    pub fn of(points: &[CloudPoint]) -> Option<UncertaintyStatistics> {
        let points = || points.iter().filter(|p| p.flags.is_empty());
        let mut sigmas: Vec<f64> = points().map(|p| p.sigma * 1e3).collect();
        sigmas.sort_by(f64::total_cmp);
        let within = points().filter(|p| p.deviation.abs() <= 1.96 * p.deviation_sigma);
        Some(UncertaintyStatistics {
            points: sigmas.len(),
            median_sigma_um: *sigmas.get(sigmas.len() / 2)?,
            within_95: within.count() as f64 / sigmas.len() as f64,
        })
    }
}

/// Left, top, width and height of the panels, px.
const ABOVE: [f64; 4] = [80.0, 110.0, 980.0, 260.0];
const BELOW: [f64; 4] = [80.0, 450.0, 980.0, 150.0];
/// Columns whose share of covered truths is one dot.
const TOGETHER: usize = 16;
const PREDICTED: &str = "#222";
const FOUND: &str = "#c0392b";

/// A rectangle with linear axes from the first to the second value.
struct Axes {
    frame: [f64; 4],
    x: (f64, f64),
    y: (f64, f64),
}

impl Axes {
    fn at(&self, x: f64, y: f64) -> (f64, f64) {
        let [left, top, width, height] = self.frame;
        let share = |v: f64, (from, to): (f64, f64)| (v - from) / (to - from);
        let y = share(y, self.y).clamp(0.0, 1.0);
        (left + width * share(x, self.x), top + height * (1.0 - y))
    }

    fn draw(&self, svg: &mut String, x_step: f64, y_step: f64, title: &str) {
        let [left, top, width, height] = self.frame;
        let (right, bottom) = (left + width, top + height);
        for i in 0..=(self.x.1 / x_step) as usize {
            let x = self.at(i as f64 * x_step, 0.0).0;
            let _ = write!(
                svg,
                "<text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
                bottom + 17.0,
                i as f64 * x_step
            );
        }
        for i in (self.y.0 / y_step).ceil() as usize..=(self.y.1 / y_step * 1.000_001) as usize {
            let y = self.at(0.0, i as f64 * y_step).1;
            let _ = write!(
                svg,
                "<path d=\"M{left} {y:.1}H{right}\" stroke=\"#ddd\"/>\
                 <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                left - 6.0,
                y + 4.0,
                short(i as f64 * y_step)
            );
        }
        let _ = write!(
            svg,
            "<rect x=\"{left}\" y=\"{top}\" width=\"{width}\" height=\"{height}\" fill=\"none\" \
             stroke=\"#333\"/><text x=\"{left}\" y=\"{}\" font-weight=\"bold\">{title}</text>",
            top - 8.0
        );
    }

    /// Area between two curves.
    fn band(&self, svg: &mut String, upper: &[(f64, f64)], lower: &[(f64, f64)], color: &str) {
        let points = upper.iter().chain(lower.iter().rev());
        let points: String = points
            .map(|&(x, y)| self.at(x, y))
            .map(|(x, y)| format!("{x:.1},{y:.1} "))
            .collect();
        let _ = write!(svg, "<polygon points=\"{points}\" fill=\"{color}\"/>");
    }

    fn dots(&self, svg: &mut String, points: impl Iterator<Item = (f64, f64)>, radius: f64) {
        let _ = write!(svg, "<g fill=\"{FOUND}\">");
        for (x, y) in points.map(|(x, y)| self.at(x, y)) {
            let _ = write!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\"/>");
        }
        svg.push_str("</g>");
    }
}

/// 1, 2 or 5 times a power of ten that divides `span` into four to ten.
fn step(span: f64) -> f64 {
    let power = 10f64.powf((span / 10.0).log10().floor());
    let fits = |m: &f64| span / (m * power) <= 10.0;
    power * [1.0, 2.0, 5.0].into_iter().find(fits).unwrap_or(10.0)
}

/// The drawing: above, predicted and Monte Carlo standard uncertainty of each
/// column's point, µm; below, the share of 95 % intervals that hold the truth.
pub fn drawing(rows: &[ColumnUncertainty], columns: u32, headline: [&str; 2]) -> String {
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 1100 660\" width=\"1100\" \
         font-family=\"sans-serif\" font-size=\"12\" fill=\"#222\"><rect width=\"100%\" \
         height=\"100%\" fill=\"white\"/><text x=\"80\" y=\"30\" font-size=\"17\" \
         font-weight=\"bold\">{}</text><text x=\"80\" y=\"52\">{}</text>",
        headline[0], headline[1]
    );
    let highest = rows
        .iter()
        .map(|r| r.monte_carlo_px.max(r.predicted_px) * r.um_per_px)
        .fold(1e-3, f64::max);
    let x = (0.0, columns as f64);
    let x_step = step(x.1);
    let above = Axes {
        frame: ABOVE,
        x,
        y: (0.0, 1.1 * highest),
    };
    let title = "Standard uncertainty of each column's point, µm";
    // Where chance lets 95 of 100 estimates from so many seeds lie.
    for run in rows.chunk_by(|a, b| b.column == a.column + 1) {
        let edge = |sign: f64| -> Vec<(f64, f64)> {
            run.iter()
                .map(|r| {
                    let spread = 1.96 / (2.0 * (r.seeds.max(2) - 1) as f64).sqrt();
                    let um = r.predicted_px * r.um_per_px;
                    (r.column as f64 + 0.5, um * (1.0 + sign * spread))
                })
                .collect()
        };
        above.band(&mut svg, &edge(1.0), &edge(-1.0), "#d6dbdf");
    }
    above.draw(&mut svg, x_step, step(above.y.1), title);
    let found = |r: &ColumnUncertainty| (r.column as f64 + 0.5, r.monte_carlo_px * r.um_per_px);
    above.dots(&mut svg, rows.iter().map(found), 1.4);
    for run in rows.chunk_by(|a, b| b.column == a.column + 1) {
        let points: String = run
            .iter()
            .map(|r| above.at(r.column as f64 + 0.5, r.predicted_px * r.um_per_px))
            .map(|(x, y)| format!("{x:.1},{y:.1} "))
            .collect();
        let _ = write!(
            svg,
            "<polyline points=\"{points}\" fill=\"none\" stroke=\"{PREDICTED}\" \
             stroke-width=\"1.6\"/>"
        );
    }
    legend(&mut svg);
    coverage(&mut svg, rows, x, x_step);
    svg + "</svg>\n"
}

fn legend(svg: &mut String) {
    let _ = write!(
        svg,
        "<path d=\"M80 76h24\" stroke=\"{PREDICTED}\" stroke-width=\"1.6\"/>\
         <text x=\"110\" y=\"80\">predicted from the scene</text>\
         <rect x=\"310\" y=\"70\" width=\"24\" height=\"12\" fill=\"#d6dbdf\"/>\
         <text x=\"340\" y=\"80\">where 95 of 100 dots should lie</text>\
         <circle cx=\"560\" cy=\"76\" r=\"3\" fill=\"{FOUND}\"/>\
         <text x=\"570\" y=\"80\">Monte Carlo: scatter of the simulated measurements</text>"
    );
}

fn coverage(svg: &mut String, rows: &[ColumnUncertainty], x: (f64, f64), x_step: f64) {
    let axes = Axes {
        frame: BELOW,
        x,
        y: (80.0, 100.0),
    };
    let flat = |y| [(x.0, y), (x.1, y)];
    axes.band(svg, &flat(96.0), &flat(94.0), "#d6dbdf");
    let title = format!(
        "Share of the 95 % intervals that hold the truth, {TOGETHER} columns a dot, % \
         (grey: 94 to 96)"
    );
    axes.draw(svg, x_step, 5.0, &title);
    let share = |rows: &[ColumnUncertainty]| {
        let seeds: usize = rows.iter().map(|r| r.seeds).sum();
        let covered: usize = rows.iter().map(|r| r.covered).sum();
        let middle = rows[rows.len() / 2].column as f64 + 0.5;
        (middle, 100.0 * covered as f64 / seeds.max(1) as f64)
    };
    axes.dots(svg, rows.chunks(TOGETHER).map(share), 3.0);
    let _ = write!(
        svg,
        "<text x=\"{:.1}\" y=\"{}\" text-anchor=\"middle\">column of the sensor, px</text>",
        BELOW[0] + BELOW[2] / 2.0,
        BELOW[1] + BELOW[3] + 38.0
    );
}

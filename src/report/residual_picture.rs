//! Plot of the residuals of a calibration as SVG text.

use super::axes::{Axes, Axis};
use super::svg::Svg;
use crate::profile::{Adjustment, Observations};

const LEFT: f64 = 70.0;
const WIDTH: f64 = 900.0;
/// Space above each chart, px.
const SPACE: f64 = 60.0;
/// Height of the chart of the laser line, px.
const CHART: f64 = 220.0;
const PAPER: &str = "fill='#f6f6f6'";

/// Draws the residuals of the target dots as arrows over the sensor, and the residuals of the laser
/// line over the columns.
pub fn residual_picture(observations: &Observations, adjustment: &Adjustment) -> String {
    let size = adjustment.calibration.camera.resolution.as_dvec2();
    let height = size.y * WIDTH / size.x;
    let below = height + 2.4 * SPACE;
    let mut svg = Svg::file([LEFT + WIDTH + 30.0, below + CHART + SPACE], 14.0);
    let columns = [0.0, size.x];

    let residuals = &adjustment.dot_residuals;
    let squares: f64 = residuals.iter().map(|r| r.length_squared() / 2.0).sum();
    let rms = (squares / residuals.len().max(1) as f64).sqrt();
    // The arrow of a residual equal to the rms per axis is 12 px long.
    let magnified = 12.0 / rms.max(1e-9);
    let longer = magnified * size.x / WIDTH;
    let axes = Axes {
        frame: [LEFT, SPACE, WIDTH, height],
        beyond: [0.0; 2],
        title: &format!(
            "Residuals of the target's dots over the sensor, all views; rms {rms:.4} px a \
             coordinate, errors drawn {longer:.0} times too long"
        ),
        x: Axis::linear("column", columns),
        y: Axis::linear("row", [size.y, 0.0]),
    };
    svg.rect(axes.frame, PAPER);
    axes.draw(&mut svg);
    for (dot, residual) in observations.dots.iter().zip(residuals) {
        let at = axes.at(dot.pixel.x, dot.pixel.y);
        let to = [
            at[0] + residual.x * magnified,
            at[1] + residual.y * magnified,
        ];
        svg.circle(at, 1.6, "fill='#24508f'");
        svg.line(at, to, "stroke='#c0392b'");
    }

    let sigma = adjustment.line_sigma_px;
    let axes = Axes {
        frame: [LEFT, below, WIDTH, CHART],
        beyond: [0.0; 2],
        title: &format!(
            "Residuals of the laser line over the columns, all views; σ = {sigma:.4} px, \
             3σ dashed"
        ),
        x: Axis::linear("column", columns),
        y: Axis::linear("residual / σ", [5.0, -5.0]),
    };
    svg.rect(axes.frame, PAPER);
    axes.draw(&mut svg);
    for limit in [3.0, -3.0] {
        let across = columns.map(|column| (column, limit));
        axes.curve(&mut svg, across, "stroke='#888' stroke-dasharray='6 4'");
    }
    for (point, residual) in observations.line.iter().zip(&adjustment.line_residuals) {
        let place = axes.at(point.pixel.x, residual / sigma);
        svg.circle(place, 1.6, "fill='#c0392b' fill-opacity='.6'");
    }
    svg.finish()
}

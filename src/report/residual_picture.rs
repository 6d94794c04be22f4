//! What a calibration leaves unexplained, as SVG text.

use crate::profile::{Adjustment, Observations};
use std::fmt::Write;

const WIDTH: f64 = 900.0;
const MARGIN: f64 = 60.0;
/// Height of the chart of the laser line.
const CHART: f64 = 220.0;

/// The residuals of the dots as arrows over the sensor, and those of the laser line
/// over the columns.
pub fn residual_picture(observations: &Observations, adjustment: &Adjustment) -> String {
    let size = adjustment.calibration.camera.resolution.as_dvec2();
    let scale = WIDTH / size.x;
    let height = size.y * scale;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" \
         font-family=\"sans-serif\" font-size=\"14\">\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>",
        WIDTH + 2.0 * MARGIN,
        height + CHART + 3.4 * MARGIN
    );
    dots(&mut svg, observations, adjustment, scale, height);
    line(
        &mut svg,
        observations,
        adjustment,
        scale,
        height + 2.2 * MARGIN,
    );
    svg + "</svg>"
}

fn rms(squares: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = squares.fold((0.0, 0usize), |(sum, n), s| (sum + s, n + 1));
    (sum / n.max(1) as f64).sqrt()
}

fn dots(
    svg: &mut String,
    observations: &Observations,
    adjustment: &Adjustment,
    scale: f64,
    height: f64,
) {
    let rms = rms(adjustment
        .dot_residuals
        .iter()
        .map(|r| r.length_squared() / 2.0));
    // A typical residual is drawn 12 units long.
    let magnified = 12.0 / rms.max(1e-9);
    let _ = write!(
        svg,
        "<text x=\"{MARGIN}\" y=\"{}\">residuals of the target's dots over the sensor, all views; \
         rms {rms:.4} px a coordinate, errors drawn {:.0} times too long</text>\
         <rect x=\"{MARGIN}\" y=\"{MARGIN}\" width=\"{WIDTH}\" height=\"{height:.1}\" \
         fill=\"#f6f6f6\" stroke=\"#333\"/>",
        MARGIN - 16.0,
        magnified / scale
    );
    for (dot, r) in observations.dots.iter().zip(&adjustment.dot_residuals) {
        let at = dot.pixel * scale + MARGIN;
        let to = at + *r * magnified;
        let _ = write!(
            svg,
            "<circle cx=\"{0:.1}\" cy=\"{1:.1}\" r=\"1.6\" fill=\"#24508f\"/>\
             <line x1=\"{0:.1}\" y1=\"{1:.1}\" x2=\"{2:.1}\" y2=\"{3:.1}\" stroke=\"#c0392b\"/>",
            at.x, at.y, to.x, to.y
        );
    }
}

fn line(
    svg: &mut String,
    observations: &Observations,
    adjustment: &Adjustment,
    scale: f64,
    top: f64,
) {
    let sigma = adjustment.line_sigma_px;
    let middle = top + CHART / 2.0;
    let per_sigma = CHART / 10.0;
    let _ = write!(
        svg,
        "<text x=\"{MARGIN}\" y=\"{}\">residuals of the laser line over the columns, all views; \
         σ = {sigma:.4} px</text>\
         <rect x=\"{MARGIN}\" y=\"{top}\" width=\"{WIDTH}\" height=\"{CHART}\" \
         fill=\"#f6f6f6\" stroke=\"#333\"/>",
        top - 16.0
    );
    for sigmas in [-3.0, 0.0, 3.0] {
        let y = middle + sigmas * per_sigma;
        let _ = write!(
            svg,
            "<line x1=\"{MARGIN}\" y1=\"{y:.1}\" x2=\"{}\" y2=\"{y:.1}\" stroke=\"#999\"/>\
             <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            MARGIN + WIDTH,
            MARGIN - 6.0,
            y + 5.0,
            if sigmas == 0.0 {
                "0".into()
            } else {
                format!("{sigmas:+}σ")
            }
        );
    }
    for (point, r) in observations.line.iter().zip(&adjustment.line_residuals) {
        let away = (r / sigma).clamp(-5.0, 5.0);
        let _ = write!(
            svg,
            "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1.6\" fill=\"#c0392b\" fill-opacity=\".6\"/>",
            point.pixel.x * scale + MARGIN,
            middle + away * per_sigma
        );
    }
    let columns = adjustment.calibration.camera.resolution.x;
    for (column, anchor) in [(0, "start"), (columns, "end")] {
        let _ = write!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\">column {column}</text>",
            column as f64 * scale + MARGIN,
            top + CHART + 20.0
        );
    }
}

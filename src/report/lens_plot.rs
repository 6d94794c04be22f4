//! Plot of defocused lines: rendered results relative to wave optics.

use super::axes::{Axes, Axis, ChartPoint, legend};
use super::svg::Svg;
use crate::wave::line_statistics::MeanWithError;

/// Result of one line.
#[derive(Debug, Clone)]
pub struct LensPoint {
    /// Width of the ideal line relative to the speckle size, σ/h.
    pub sigma: f64,
    /// Defocus blur relative to the line width, b/σ.
    pub blur: f64,
    /// Centroid noise relative to wave optics: for the complex field through the lens, and for a
    /// speckle texture times the blurred mean.
    pub noise: [MeanWithError; 2],
    /// Speckle contrast at the line centre for the complex field through the lens; 1 for fully
    /// developed speckle.
    pub contrast: MeanWithError,
    /// Speckle size across the line relative to wave optics, for the complex field through the
    /// lens.
    pub across: MeanWithError,
}

const COLORS: [&str; 5] = ["#7d3c98", "#2471a3", "#1e8449", "#b9770e", "#c0392b"];
const EVEN: &str = "stroke='#222' stroke-width='1.2'";
const GOAL: &str = "stroke='#222' stroke-dasharray='5 4'";

/// Plots noise, contrast and speckle size against b/σ, with one colour per σ, as an SVG file. Error
/// bars are 95 % intervals of ±1.96 standard errors.
///
/// # Panics
/// If there are more than five values of σ.
pub fn lens_plot(points: &[LensPoint]) -> String {
    let mut sigmas: Vec<f64> = points.iter().map(|p| p.sigma).collect();
    sigmas.sort_by(f64::total_cmp);
    sigmas.dedup();
    let mut svg = Svg::file([1230.0, 500.0], 12.0);
    let mut panel =
        |left: f64, title, y, ends, goal: f64, of: &dyn Fn(&LensPoint) -> MeanWithError| {
            let axes = Axes {
                frame: [left, 50.0, 320.0, 340.0],
                beyond: [0.0; 2],
                title,
                x: Axis::linear("b/σ: diameter of the blur over the line's σ", [-0.5, 8.5]),
                y: Axis::linear(y, ends),
            };
            axes.draw(&mut svg);
            for (height, style) in [(1.0, EVEN), (1.0 - goal, GOAL), (1.0 + goal, GOAL)] {
                axes.curve(&mut svg, [(-0.5, height), (8.5, height)], style);
            }
            for point in points {
                let i = sigmas
                    .iter()
                    .position(|s| *s == point.sigma)
                    .expect("its own σ");
                let (value, color) = (of(point), COLORS[i]);
                let x = point.blur + 0.12 * (i as f64 - 2.0);
                let bar = [-1.96, 1.96].map(|times| axes.at(x, value.value + times * value.error));
                svg.line(bar[0], bar[1], &format!("stroke='{color}'"));
                ChartPoint::Dot.draw(
                    &mut svg,
                    axes.at(x, value.value),
                    &format!("fill='{color}'"),
                );
            }
            axes
        };
    let axes = panel(
        70.0,
        "Centroid noise",
        "over that of waves",
        [0.5, 1.1],
        0.03,
        &|p| p.noise[0],
    );
    panel(
        480.0,
        "Contrast, field through the lens",
        "contrast",
        [0.9, 1.1],
        0.02,
        &|p| p.contrast,
    );
    let title = "Grains across the line, field through the lens";
    panel(
        890.0,
        title,
        "over those of waves",
        [0.9, 1.1],
        0.03,
        &|p| p.across,
    );
    for (sigma, color) in sigmas.iter().zip(COLORS) {
        let own = points.iter().filter(|p| p.sigma == *sigma);
        let stroke = format!("stroke='{color}' stroke-width='1.6'");
        axes.curve(&mut svg, own.map(|p| (p.blur, p.noise[1].value)), &stroke);
    }
    below(&mut svg, &sigmas);
    svg.finish()
}

/// Draws the legend.
fn below(svg: &mut Svg, sigmas: &[f64]) {
    let styles = COLORS.map(|color| format!("fill='{color}'"));
    let names: Vec<String> = sigmas.iter().map(|s| format!("σ = {s} h")).collect();
    let marks = names.iter().zip(&styles);
    let marks: Vec<_> = marks
        .map(|(name, style)| (ChartPoint::Dot, &style[..], &name[..]))
        .collect();
    legend(svg, [70.0, 460.0], [90.0, 0.0], &marks);
    let others = [
        (
            ChartPoint::Line,
            "stroke='#888' stroke-width='1.6'",
            "texture × blurred mean",
        ),
        (ChartPoint::Line, GOAL, "goal"),
    ];
    legend(svg, [560.0, 460.0], [190.0, 0.0], &others);
    svg.text(
        [850.0, 460.0],
        "",
        "dots: field through the lens, 95 % intervals",
    );
}

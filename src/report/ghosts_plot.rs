//! Plot of the detection of spurious points from reflections: detection rate against the
//! false-alarm rate of valid points, and the spurious points that are the only line in their
//! column.

use super::axes::{Axes, Axis, ChartPoint, legend};
use super::svg::Svg;

/// Results for scenes of one shape and metal, in %; `None` if there are no such points.
#[derive(Debug, Clone)]
pub struct GhostsPoint {
    /// Shape of the reflecting surface.
    pub shape: &'static str,
    /// Metal of the surface.
    pub metal: &'static str,
    /// Detected fraction of the spurious points, %.
    pub found: Option<f64>,
    /// Flagged fraction of the valid points, %.
    pub flagged: Option<f64>,
    /// Fraction of the spurious points that are the only line in their column, %.
    pub alone: Option<f64>,
    /// Detected fraction of the spurious points counted in `alone`, %.
    pub alone_found: Option<f64>,
}

const COLORS: [&str; 4] = ["#2471a3", "#1e8449", "#b9770e", "#c0392b"];

/// Returns the plot as an SVG file. Each shape has a colour; the first letters of the metal are
/// next to each dot.
///
/// # Panics
/// If there are more than four shapes.
pub fn ghosts_plot(points: &[GhostsPoint], set: &str) -> String {
    let mut shapes: Vec<&str> = points.iter().map(|point| point.shape).collect();
    shapes.dedup();
    let styles: Vec<String> = (COLORS.iter().zip(&shapes))
        .map(|(color, _)| format!("fill='{color}'"))
        .collect();
    let most_flagged = points.iter().filter_map(|p| p.flagged).fold(1.0, f64::max);
    let mut svg = Svg::file([900.0, 470.0], 12.0);
    let mut panel = |left: f64,
                     title,
                     [x, y]: [&str; 2],
                     highest,
                     of: &dyn Fn(&GhostsPoint) -> Option<[f64; 2]>| {
        let axes = Axes {
            frame: [left, 50.0, 350.0, 320.0],
            beyond: [12.0; 2],
            title,
            x: Axis::linear(x, [-4.0, 104.0]),
            y: Axis::linear(y, [0.0, highest]),
        };
        axes.draw(&mut svg);
        for point in points {
            let shape = shapes.iter().position(|shape| *shape == point.shape);
            let Some([x, y]) = of(point) else { continue };
            let at = axes.at(x, y);
            ChartPoint::Dot.draw(&mut svg, at, &styles[shape.expect("its own shape")]);
            svg.text(
                [at[0] + 5.0, at[1] - 4.0],
                "font-size='10'",
                &point.metal[..2],
            );
        }
    };
    let found = "reflections found, %";
    panel(
        70.0,
        "All reflections",
        [found, "good points flagged, %"],
        most_flagged,
        &|p| Some([p.found?, p.flagged?]),
    );
    let title = "Reflections that are the only line of their column";
    panel(
        510.0,
        title,
        ["of them found, %", "share of all reflections, %"],
        100.0,
        &|p| Some([p.alone_found?, p.alone?]),
    );
    let marks: Vec<_> = (shapes.iter().zip(&styles))
        .map(|(shape, style)| (ChartPoint::Dot, &style[..], *shape))
        .collect();
    legend(&mut svg, [70.0, 445.0], [90.0, 0.0], &marks);
    svg.text([510.0, 445.0], "", &format!("{set} scenes"));
    svg.finish()
}

//! Plots of the errors of methods near their limits of validity, one panel per method.

use super::axes::{Axes, Axis, ChartPoint, legend};
use super::svg::Svg;

/// A curve and its name.
pub struct LimitsCurve {
    /// Name in the legend.
    pub label: &'static str,
    /// Condition and error, both positive.
    pub points: Vec<(f64, f64)>,
}

/// Errors of a method as a function of the condition that invalidates it.
pub struct LimitsPanel {
    /// Heading.
    pub title: &'static str,
    /// Title of the horizontal axis, the condition.
    pub x: &'static str,
    /// Title of the vertical axis, the error.
    pub y: &'static str,
    /// Powers of ten that limit the vertical axis. Smaller errors are plotted at the lower end.
    pub powers: (i32, i32),
    /// At most three curves.
    pub curves: Vec<LimitsCurve>,
}

const COLUMNS: usize = 4;
const SIZE: [f64; 2] = [250.0, 200.0];
/// Offset between the corners of neighbouring panels, px.
const VALUE_STEP: [f64; 2] = [345.0, 350.0];
const COLORS: [&str; 3] = ["#c0392b", "#2471a3", "#1e8449"];

/// Draws the panels in rows of four, as an SVG file.
pub fn limits_plot(panels: &[LimitsPanel]) -> String {
    let rows = panels.len().div_ceil(COLUMNS) as f64;
    let mut svg = Svg::file(
        [
            VALUE_STEP[0] * COLUMNS as f64 + 40.0,
            VALUE_STEP[1] * rows + 60.0,
        ],
        12.0,
    );
    let heading = "font-size='17' font-weight='bold'";
    svg.text(
        [70.0, 30.0],
        heading,
        "Errors as the limit of each method is approached",
    );
    let foot = "What is less than a panel's foot, none included, is drawn on it.";
    svg.text([70.0, 48.0], "", foot);
    for (i, panel) in panels.iter().enumerate() {
        let (row, column) = ((i / COLUMNS) as f64, (i % COLUMNS) as f64);
        panel.draw(
            &mut svg,
            [70.0 + VALUE_STEP[0] * column, 90.0 + VALUE_STEP[1] * row],
        );
    }
    svg.finish()
}

impl LimitsPanel {
    fn draw(&self, svg: &mut Svg, [left, top]: [f64; 2]) {
        let powers = self
            .curves
            .iter()
            .flat_map(|c| &c.points)
            .map(|p| p.0.log10());
        let (low, high) = powers.fold((f64::MAX, f64::MIN), |(l, h), x| (l.min(x), h.max(x)));
        let tens = |low: f64, high: f64| [low, high].map(|power| 10f64.powf(power));
        let axes = Axes {
            frame: [left, top, SIZE[0], SIZE[1]],
            beyond: [0.0; 2],
            title: self.title,
            x: Axis::logarithmic(self.x, tens((low + 1e-9).floor(), (high - 1e-9).ceil())),
            y: Axis::logarithmic(self.y, tens(self.powers.0.into(), self.powers.1.into())),
        };
        axes.draw(svg);
        let below = [left, top + SIZE[1] + 58.0];
        for (i, (curve, color)) in self.curves.iter().zip(COLORS).enumerate() {
            let stroke = format!("stroke='{color}' stroke-width='1.6'");
            axes.curve(svg, curve.points.iter().copied(), &stroke);
            let dot = format!("fill='{color}'");
            for &(x, y) in &curve.points {
                ChartPoint::Dot.draw(svg, axes.at(x, y), &dot);
            }
            let at = [below[0], below[1] + 14.0 * i as f64];
            legend(svg, at, [0.0; 2], &[(ChartPoint::Dot, &dot, curve.label)]);
        }
    }
}

//! Small panels of curves over logarithmic axes, as SVG text.

use super::chart::short;
use std::fmt::Write;

/// What all curves of a panel share.
pub struct Panel<'a> {
    /// Left, top, width, height, px.
    pub frame: [f64; 4],
    /// Heading.
    pub title: &'a str,
    /// Name of the horizontal axis, with its unit.
    pub x_title: &'a str,
    /// Ticks in their order; they stand at equal distances, whatever their values.
    pub x: &'a [f64],
    /// Powers of ten at which the vertical axis begins and ends.
    pub y_powers: (i32, i32),
}

impl Panel<'_> {
    fn px(&self, i: usize) -> f64 {
        let [left, _, width, _] = self.frame;
        left + width * (i as f64 + 0.5) / self.x.len() as f64
    }

    /// Values off the axis lie on its end.
    fn py(&self, y: f64) -> f64 {
        let [_, top, _, height] = self.frame;
        let (low, high) = (self.y_powers.0 as f64, self.y_powers.1 as f64);
        let share = (y.max(1e-300).log10().clamp(low, high) - low) / (high - low);
        top + height * (1.0 - share)
    }

    /// Frame, grid, ticks and titles.
    pub fn axes(&self, svg: &mut String) {
        let [left, top, width, height] = self.frame;
        for power in self.y_powers.0..=self.y_powers.1 {
            let y = self.py(10f64.powi(power));
            let _ = write!(
                svg,
                "<line x1=\"{left}\" x2=\"{}\" y1=\"{y:.1}\" y2=\"{y:.1}\" stroke=\"#ddd\"/>\
                 <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                left + width,
                left - 5.0,
                y + 4.0,
                short(10f64.powi(power))
            );
        }
        for (i, &x) in self.x.iter().enumerate() {
            let _ = write!(
                svg,
                "<text x=\"{:.1}\" y=\"{}\" text-anchor=\"middle\" font-size=\"11\">{x}</text>",
                self.px(i),
                top + height + 16.0
            );
        }
        let _ = write!(
            svg,
            "<rect x=\"{left}\" y=\"{top}\" width=\"{width}\" height=\"{height}\" fill=\"none\" \
             stroke=\"#333\"/><text x=\"{left}\" y=\"{}\" font-weight=\"bold\">{}</text>\
             <text x=\"{:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
            top - 8.0,
            self.title,
            left + width / 2.0,
            top + height + 34.0,
            self.x_title
        );
    }

    /// Joins a value at each tick; a tick without one interrupts the curve.
    pub fn curve(&self, svg: &mut String, values: &[Option<f64>], color: &str, dash: &str) {
        let mut begun = false;
        let mut path = String::new();
        for (i, value) in values.iter().enumerate() {
            let Some(value) = value else {
                begun = false;
                continue;
            };
            let letter = if begun { 'L' } else { 'M' };
            let _ = write!(path, "{letter}{:.1} {:.1}", self.px(i), self.py(*value));
            begun = true;
            if dash.is_empty() {
                let _ = write!(
                    svg,
                    "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"2.6\" fill=\"{color}\"/>",
                    self.px(i),
                    self.py(*value)
                );
            }
        }
        let _ = write!(
            svg,
            "<path d=\"{path}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.6\" \
             stroke-dasharray=\"{dash}\"/>"
        );
    }
}

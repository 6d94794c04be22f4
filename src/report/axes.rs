//! Axes of all plots: scales, ticks, grid, titles and data elements.

use super::svg::{END, MIDDLE, Svg};

/// Minimum distance of ticks on a horizontal and on a vertical axis, px.
const CLOSEST: [f64; 2] = [50.0, 28.0];

enum AxisScale<'a> {
    Linear,
    /// Logarithmic; the limits are stored as powers of ten.
    Logarithmic,
    /// The values 0, 1, 2, … with these names.
    Named(&'a [String]),
}

/// Axis from its first to its last value. Values outside are clamped to the ends.
pub struct Axis<'a> {
    title: &'a str,
    ends: [f64; 2],
    scale: AxisScale<'a>,
}

impl<'a> Axis<'a> {
    pub fn linear(title: &'a str, ends: [f64; 2]) -> Axis<'a> {
        Axis {
            title,
            ends,
            scale: AxisScale::Linear,
        }
    }

    /// Creates a logarithmic axis between two positive values.
    pub fn logarithmic(title: &'a str, ends: [f64; 2]) -> Axis<'a> {
        Axis {
            title,
            ends: ends.map(f64::log10),
            scale: AxisScale::Logarithmic,
        }
    }

    /// Creates an axis with the equidistant values 0, 1, 2, … and their names.
    pub fn named(title: &'a str, names: &'a [String]) -> Axis<'a> {
        Axis {
            title,
            ends: [-0.5, names.len() as f64 - 0.5],
            scale: AxisScale::Named(names),
        }
    }

    /// Returns the relative position of a value, from 0 at the first end to 1 at the last.
    fn share(&self, value: f64) -> f64 {
        let value = match self.scale {
            AxisScale::Logarithmic => value.max(f64::MIN_POSITIVE).log10(),
            _ => value,
        };
        let [from, to] = self.ends;
        ((value - from) / (to - from)).clamp(0.0, 1.0)
    }

    /// Returns the tick values and their labels; at most `most` steps on a linear axis.
    fn ticks(&self, most: f64) -> Vec<(f64, String)> {
        let [low, high] = [
            self.ends[0].min(self.ends[1]),
            self.ends[0].max(self.ends[1]),
        ];
        match self.scale {
            AxisScale::Linear => multiples([low, high], round_step(high - low, most))
                .map(|value| (value, plain(value)))
                .collect(),
            AxisScale::Logarithmic => {
                // Multiples of each power of ten; a longer axis has fewer.
                let every = ((high - low) / most).ceil().max(1.0) as usize;
                let factors: &[f64] = match high - low {
                    short if short <= 1.0 => &[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0],
                    medium if medium <= 3.0 => &[1.0, 2.0, 5.0],
                    _ => &[1.0],
                };
                ((low - 1e-9).floor() as i32..=high.ceil() as i32)
                    .filter(|power| power.rem_euclid(every as i32) == 0)
                    .flat_map(|power| factors.iter().map(move |f| (f * 10f64.powi(power), power)))
                    .filter(|(value, _)| (low - 1e-9..=high + 1e-9).contains(&value.log10()))
                    .map(|(value, power)| match power {
                        -4..=4 => (value, plain(value)),
                        _ => (value, power_of_ten(power)),
                    })
                    .collect()
            }
            AxisScale::Named(names) => {
                let names = names.iter().enumerate();
                names.map(|(i, name)| (i as f64, name.clone())).collect()
            }
        }
    }
}

/// Rectangle with two axes.
pub struct Axes<'a> {
    /// Left, top, width and height, px.
    pub frame: [f64; 4],
    /// Margins of the frame above and below the vertical axis, px.
    pub beyond: [f64; 2],
    pub title: &'a str,
    pub x: Axis<'a>,
    pub y: Axis<'a>,
}

impl Axes<'_> {
    pub fn at(&self, x: f64, y: f64) -> [f64; 2] {
        let [left, top, width, height] = self.frame;
        let [above, below] = self.beyond;
        let y = (height - above - below) * (1.0 - self.y.share(y));
        [left + width * self.x.share(x), top + above + y]
    }

    /// Draws frame, grid, ticks and titles.
    pub fn draw(&self, svg: &mut Svg) {
        let [left, top, width, height] = self.frame;
        let (right, bottom) = (left + width, top + height);
        let grid = "stroke='#ddd'";
        for (value, name) in self.x.ticks((width / CLOSEST[0]).clamp(4.0, 10.0)) {
            let x = left + width * self.x.share(value);
            svg.line([x, top], [x, bottom], grid);
            svg.text([x, bottom + 17.0], MIDDLE, &name);
        }
        for (value, name) in self.y.ticks((height / CLOSEST[1]).min(10.0)) {
            let y = self.at(0.0, value)[1];
            svg.line([left, y], [right, y], grid);
            svg.text([left - 7.0, y + 4.0], END, &name);
        }
        svg.rect(self.frame, "fill='none' stroke='#333'");
        let middle = [left + width / 2.0, top + height / 2.0];
        svg.text([left, top - 10.0], "font-weight='bold'", self.title);
        svg.text([middle[0], bottom + 37.0], MIDDLE, self.x.title);
        svg.text_upwards([left - 46.0, middle[1]], self.y.title);
    }

    pub fn curve(&self, svg: &mut Svg, values: impl IntoIterator<Item = (f64, f64)>, style: &str) {
        svg.polyline(values.into_iter().map(|(x, y)| self.at(x, y)), style);
    }

    /// Draws the area between two curves.
    pub fn band(&self, svg: &mut Svg, upper: &[(f64, f64)], lower: &[(f64, f64)], style: &str) {
        let around = upper.iter().chain(lower.iter().rev());
        svg.polygon(around.map(|&(x, y)| self.at(x, y)), style);
    }
}

/// Symbol of a quantity in a plot and in its legend.
#[derive(Clone, Copy)]
pub enum ChartPoint {
    Line,
    Dot,
    Diamond,
    Area,
}

impl ChartPoint {
    pub fn draw(self, svg: &mut Svg, [x, y]: [f64; 2], style: &str) {
        match self {
            ChartPoint::Line => svg.line([x - 12.0, y], [x + 12.0, y], style),
            ChartPoint::Dot => svg.circle([x, y], 3.0, style),
            ChartPoint::Diamond => {
                let corners = [[x, y - 5.0], [x + 5.0, y], [x, y + 5.0], [x - 5.0, y]];
                svg.polygon(corners, style);
            }
            ChartPoint::Area => svg.rect([x - 12.0, y - 6.0, 24.0, 12.0], style),
        }
    }
}

/// Draws a legend of symbols, each with its style and name. The first entry is at `at`, the others
/// follow at intervals of `step`.
pub fn legend(svg: &mut Svg, at: [f64; 2], step: [f64; 2], entries: &[(ChartPoint, &str, &str)]) {
    for (k, (mark, style, name)) in entries.iter().enumerate() {
        let [x, y] = [0, 1].map(|axis| at[axis] + step[axis] * k as f64);
        mark.draw(svg, [x + 12.0, y - 4.0], style);
        svg.text([x + 30.0, y], "", name);
    }
}

/// Returns the smallest of 1, 2 and 5 times a power of ten that divides `span` into at most `most`
/// steps.
pub fn round_step(span: f64, most: f64) -> f64 {
    let power = 10f64.powf((span / most).log10().floor());
    let fits = |m: &f64| span / (m * power) <= most;
    power * [1.0, 2.0, 5.0].into_iter().find(fits).unwrap_or(10.0)
}

/// Returns the multiples of `step` between two values.
fn multiples([low, high]: [f64; 2], step: f64) -> impl Iterator<Item = f64> {
    let slack = 1e-9 * step;
    let first = ((low - slack) / step).ceil() as i64;
    let last = ((high + slack) / step).floor() as i64;
    (first..=last).map(move |k| k as f64 * step)
}

/// Formats a round number without binary rounding errors.
fn plain(value: f64) -> String {
    format!("{}", (value * 1e9).round() / 1e9 + 0.0)
}

/// Formats a power of ten, such as 10⁻⁵.
fn power_of_ten(power: i32) -> String {
    const DIGITS: [char; 10] = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    let raised = |c: char| c.to_digit(10).map_or('⁻', |digit| DIGITS[digit as usize]);
    let power: String = power.to_string().chars().map(raised).collect();
    format!("10{power}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_numbers() {
        assert_eq!(
            [1.0, 5.4, 37.0].map(|span| round_step(span, 10.0)),
            [0.1, 1.0, 5.0]
        );
        let labels: Vec<String> = multiples([-0.25, 0.3], 0.1).map(plain).collect();
        assert_eq!(labels, ["-0.2", "-0.1", "0", "0.1", "0.2", "0.3"]);
        let labels = |axis: Axis, most: f64| -> Vec<String> {
            axis.ticks(most).into_iter().map(|(_, name)| name).collect()
        };
        assert_eq!(
            labels(Axis::logarithmic("", [0.5, 20.0]), 6.0),
            ["0.5", "1", "2", "5", "10", "20"]
        );
        assert_eq!(
            labels(Axis::logarithmic("", [3.8, 17.0]), 6.0),
            ["4", "5", "6", "8", "10", "15"]
        );
        assert_eq!(
            labels(Axis::logarithmic("", [1e-12, 1.0]), 6.0),
            ["10⁻¹²", "10⁻¹⁰", "10⁻⁸", "10⁻⁶", "0.0001", "0.01", "1"]
        );
    }

    #[test]
    fn values_lie_where_the_axes_say_and_on_their_ends_beyond() {
        let axes = Axes {
            frame: [10.0, 20.0, 100.0, 70.0],
            beyond: [4.0, 6.0],
            title: "",
            x: Axis::logarithmic("", [1.0, 100.0]),
            y: Axis::linear("", [-1.0, 1.0]),
        };
        let close = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) < 1e-9;
        assert!(close(axes.at(10.0, 0.5), [60.0, 39.0]));
        assert!(close(axes.at(0.0, -9.0), [10.0, 84.0]));
        // An axis is reversed if its first end is the larger one.
        let down = Axes {
            y: Axis::linear("", [1.0, -1.0]),
            ..axes
        };
        assert!(close(down.at(1e9, 0.5), [110.0, 69.0]));
    }
}

//! The axes of all plots: scales, ticks, grid, titles, and what is drawn over them.

use super::svg::{END, MIDDLE, Svg};

/// Closest ticks of a horizontal and of a vertical axis, px.
const CLOSEST: [f64; 2] = [50.0, 28.0];

enum Scale<'a> {
    Linear,
    /// Its ends are powers of ten.
    Logarithmic,
    /// 0, 1, 2, … have these names.
    Named(&'a [String]),
}

/// An axis from its first to its last value; what lies beyond is drawn on its end.
pub struct Axis<'a> {
    title: &'a str,
    ends: [f64; 2],
    scale: Scale<'a>,
}

impl<'a> Axis<'a> {
    pub fn linear(title: &'a str, ends: [f64; 2]) -> Axis<'a> {
        Axis {
            title,
            ends,
            scale: Scale::Linear,
        }
    }

    /// From one value above 0 to another.
    pub fn logarithmic(title: &'a str, ends: [f64; 2]) -> Axis<'a> {
        Axis {
            title,
            ends: ends.map(f64::log10),
            scale: Scale::Logarithmic,
        }
    }

    /// The values 0, 1, 2, … at equal distances, with their names.
    pub fn named(title: &'a str, names: &'a [String]) -> Axis<'a> {
        Axis {
            title,
            ends: [-0.5, names.len() as f64 - 0.5],
            scale: Scale::Named(names),
        }
    }

    /// Where a value lies, from 0 at the first end to 1 at the last.
    fn share(&self, value: f64) -> f64 {
        let value = match self.scale {
            Scale::Logarithmic => value.max(f64::MIN_POSITIVE).log10(),
            _ => value,
        };
        let [from, to] = self.ends;
        ((value - from) / (to - from)).clamp(0.0, 1.0)
    }

    /// Values to mark and their names; `most` steps on a linear axis.
    fn ticks(&self, most: f64) -> Vec<(f64, String)> {
        let [low, high] = [
            self.ends[0].min(self.ends[1]),
            self.ends[0].max(self.ends[1]),
        ];
        match self.scale {
            Scale::Linear => multiples([low, high], round_step(high - low, most))
                .map(|value| (value, plain(value)))
                .collect(),
            Scale::Logarithmic => {
                // Factors of each power of ten: the fewer, the longer the axis.
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
            Scale::Named(names) => {
                let names = names.iter().enumerate();
                names.map(|(i, name)| (i as f64, name.clone())).collect()
            }
        }
    }
}

/// A rectangle with two axes.
pub struct Axes<'a> {
    /// Left, top, width, height.
    pub frame: [f64; 4],
    /// Parts of the frame above and below the vertical axis that its values do not reach.
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

    /// Frame, grid, ticks and titles.
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

    /// The area between two curves.
    pub fn band(&self, svg: &mut Svg, upper: &[(f64, f64)], lower: &[(f64, f64)], style: &str) {
        let around = upper.iter().chain(lower.iter().rev());
        svg.polygon(around.map(|&(x, y)| self.at(x, y)), style);
    }
}

/// What stands for a quantity, in a plot and in its legend.
#[derive(Clone, Copy)]
pub enum Mark {
    Line,
    Dot,
    Diamond,
    Area,
}

impl Mark {
    pub fn draw(self, svg: &mut Svg, [x, y]: [f64; 2], style: &str) {
        match self {
            Mark::Line => svg.line([x - 12.0, y], [x + 12.0, y], style),
            Mark::Dot => svg.circle([x, y], 3.0, style),
            Mark::Diamond => {
                let corners = [[x, y - 5.0], [x + 5.0, y], [x, y + 5.0], [x - 5.0, y]];
                svg.polygon(corners, style);
            }
            Mark::Area => svg.rect([x - 12.0, y - 6.0, 24.0, 12.0], style),
        }
    }
}

/// Marks, each with its style, and what they stand for, from `at` on in steps.
pub fn legend(svg: &mut Svg, at: [f64; 2], step: [f64; 2], entries: &[(Mark, &str, &str)]) {
    for (k, (mark, style, name)) in entries.iter().enumerate() {
        let [x, y] = [0, 1].map(|axis| at[axis] + step[axis] * k as f64);
        mark.draw(svg, [x + 12.0, y - 4.0], style);
        svg.text([x + 30.0, y], "", name);
    }
}

/// The least of 1, 2 and 5 times powers of ten of which `most` reach over `span`.
pub fn round_step(span: f64, most: f64) -> f64 {
    let power = 10f64.powf((span / most).log10().floor());
    let fits = |m: &f64| span / (m * power) <= most;
    power * [1.0, 2.0, 5.0].into_iter().find(fits).unwrap_or(10.0)
}

/// Multiples of `step` from one end to the other.
fn multiples([low, high]: [f64; 2], step: f64) -> impl Iterator<Item = f64> {
    let slack = 1e-9 * step;
    let first = ((low - slack) / step).ceil() as i64;
    let last = ((high + slack) / step).floor() as i64;
    (first..=last).map(move |k| k as f64 * step)
}

/// A round number, without what binary fractions add to it.
fn plain(value: f64) -> String {
    format!("{}", (value * 1e9).round() / 1e9 + 0.0)
}

/// As 10⁻⁵.
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
        // Downwards where the first end is the larger.
        let down = Axes {
            y: Axis::linear("", [1.0, -1.0]),
            ..axes
        };
        assert!(close(down.at(1e9, 0.5), [110.0, 69.0]));
    }
}

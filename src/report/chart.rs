//! Charts as SVG text.

use super::axes::{Axes, Axis};
use super::color::{Rgb, css};
use super::svg::{MIDDLE, Svg};

/// Histogram of values over an axis.
pub struct HistogramPlot<'a> {
    /// Heading.
    pub title: &'a str,
    /// Values to count; values outside the axis are counted in the outermost bins.
    pub values: &'a [f64],
    /// Left end of the axis.
    pub low: f64,
    /// Right end of the axis, above `low`.
    pub high: f64,
    /// Colour of the bin at a value.
    pub color: &'a dyn Fn(f64) -> Rgb,
    /// Expected count in a bin between two values.
    pub expected: Option<&'a dyn Fn(f64, f64) -> f64>,
}

impl HistogramPlot<'_> {
    /// Returns the chart as SVG. The title states the number of values outside the axis.
    pub fn svg(&self) -> String {
        const BINS: usize = 81;
        let mut bins = [0usize; BINS];
        let mut beyond = 0;
        for &value in self.values {
            let share = (value - self.low) / (self.high - self.low);
            match (0.0..=1.0).contains(&share) {
                true => bins[((share * BINS as f64) as usize).min(BINS - 1)] += 1,
                false => beyond += 1,
            }
        }
        let edge = |i: usize| self.low + (self.high - self.low) * i as f64 / BINS as f64;
        let expected: Vec<f64> = self.expected.map_or(Vec::new(), |expected| {
            (0..BINS).map(|i| expected(edge(i), edge(i + 1))).collect()
        });
        let most = bins.iter().copied().max().unwrap_or(0).max(1) as f64;
        let highest = expected.iter().copied().fold(most, f64::max);
        let title = format!("{} ({beyond} of {} beyond)", self.title, self.values.len());
        let axes = Axes {
            frame: [0.0, 0.0, 345.0, 150.0],
            beyond: [0.0; 2],
            title: "",
            x: Axis::linear(&title, [self.low, self.high]),
            y: Axis::linear("", [0.0, highest]),
        };
        let mut svg = Svg::part([-55.0, -10.0, 415.0, 205.0], "", self.title);
        axes.draw(&mut svg);
        for (i, &count) in bins.iter().enumerate() {
            let color = css((self.color)((edge(i) + edge(i + 1)) / 2.0));
            let [left, top] = axes.at(edge(i), count as f64);
            let [right, bottom] = axes.at(edge(i + 1), 0.0);
            svg.rect(
                [left, top, right - left, bottom - top],
                &format!("fill='{color}' stroke='#555' stroke-width='.4'"),
            );
        }
        if !expected.is_empty() {
            let middle = |i: usize| (edge(i) + edge(i + 1)) / 2.0;
            let counts = expected.iter().enumerate();
            let style = "stroke='#111' stroke-width='1.5'";
            axes.curve(&mut svg, counts.map(|(i, &n)| (middle(i), n)), style);
        }
        svg.finish()
    }
}

/// Returns a colour bar from `low` to `high` with `unit` at its centre.
pub fn color_bar(low: f64, high: f64, unit: &str, color: &dyn Fn(f64) -> Rgb) -> String {
    let label = format!("colours from {} to {} {unit}", short(low), short(high));
    let mut svg = Svg::part([-20.0, 0.0, 480.0, 44.0], "class='bar'", &label);
    for i in 0..100 {
        let fill = css(color(low + (high - low) * (i as f64 + 0.5) / 100.0));
        let x = 20.0 + 4.0 * i as f64;
        svg.rect([x, 0.0, 4.2, 18.0], &format!("fill='{fill}'"));
    }
    for (x, value) in [(20.0, low), (220.0, (low + high) / 2.0), (420.0, high)] {
        svg.text([x, 36.0], MIDDLE, &format!("{} {unit}", short(value)));
    }
    svg.finish()
}

/// Returns a stacked bar of parts with name, fraction and colour.
pub fn share_bar(title: &str, parts: &[(&str, f64, Rgb)]) -> String {
    let mut svg = Svg::part([0.0, 0.0, 720.0, 30.0], "class='shares'", title);
    let mut x = 0.0;
    for (name, share, color) in parts {
        let width = 720.0 * share;
        let style = format!("fill='{}'", css(*color));
        svg.group(
            &style,
            &format!("{name}: {} of 100", short(100.0 * share)),
            |svg| {
                svg.rect([x, 0.0, width, 30.0], "");
            },
        );
        x += width;
    }
    svg.finish()
}

/// Returns the number of decimals of a value, not 0, with this number of significant digits.
fn decimals(value: f64, significant: i32) -> i32 {
    significant - 1 - value.abs().log10().floor() as i32
}

/// Formats a number with three significant digits, at most four decimals and no exponent.
pub fn short(value: f64) -> String {
    if value.abs() < 5e-5 {
        return "0".into();
    }
    let digits = decimals(value, 3).clamp(0, 4) as usize;
    format!("{value:.digits$}")
}

/// Formats an uncertainty with two significant digits, at least four and at most nine decimals.
pub fn uncertainty(value: f64) -> String {
    let digits = match value > 0.0 {
        true => decimals(value, 2).clamp(4, 9) as usize,
        false => 4,
    };
    format!("{value:.digits$}")
}

/// Formats a value and the ends of its interval with two significant digits of the interval's width,
/// at most six decimals. Without a width, formats as [`short`] does.
pub fn with_interval(values: [f64; 3]) -> [String; 3] {
    let width = values[2] - values[1];
    if !(width > 0.0 && width.is_finite()) {
        return values.map(short);
    }
    let digits = decimals(width, 2).clamp(0, 6) as usize;
    values.map(|value| format!("{value:.digits$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_have_two_digits() {
        let texts = with_interval([11.25834, 11.1966, 11.5041]);
        assert_eq!(texts, ["11.26", "11.20", "11.50"]);
        assert_eq!(with_interval([4512.3, 4400.0, 4700.0])[0], "4512");
        assert_eq!(with_interval([1.0; 3])[0], "1.00");
    }

    #[test]
    fn short_numbers_keep_three_digits() {
        let texts = [0.0, -1e-12, 12345.6, 1.5, -0.01234].map(short);
        assert_eq!(texts, ["0", "0", "12346", "1.50", "-0.0123"]);
    }

    #[test]
    fn a_histogram_counts_what_lies_beyond() {
        let histogram = HistogramPlot {
            title: "x",
            values: &[0.0, 0.1, -0.1, 9.0],
            low: -1.0,
            high: 1.0,
            color: &|_| [0, 0, 0],
            expected: Some(&|_, _| 0.5),
        };
        let svg = histogram.svg();
        assert!(svg.contains("(1 of 4 beyond)"), "{svg}");
        assert!(svg.contains("<polyline") && !svg.contains("NaN"));
    }

    #[test]
    fn a_bar_of_shares_is_as_long_as_their_sum() {
        let svg = share_bar("t", &[("a", 0.25, [1, 2, 3]), ("b", 0.75, [4, 5, 6])]);
        assert!(svg.contains("x=\"180\"") && svg.contains("width=\"540\""));
    }
}

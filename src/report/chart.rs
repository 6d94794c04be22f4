//! Charts as SVG text.

use super::color::{Rgb, css};
use std::fmt::Write;

/// A histogram: what is counted, and where its axis ends.
pub struct Histogram<'a> {
    /// Heading.
    pub title: &'a str,
    /// What is counted; values beyond the axis count in its last bins.
    pub values: &'a [f64],
    /// Left end of the axis.
    pub low: f64,
    /// Right end of the axis, above `low`.
    pub high: f64,
    /// Colour of the bin about a value.
    pub color: &'a dyn Fn(f64) -> Rgb,
    /// Expected count in a bin from one value to another.
    pub expected: Option<&'a dyn Fn(f64, f64) -> f64>,
}

const WIDTH: f64 = 400.0;
const HEIGHT: f64 = 170.0;

impl Histogram<'_> {
    /// What lies beyond the axis is counted in the title.
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
        let bar = WIDTH / BINS as f64;
        let mut svg = format!(
            "<svg viewBox=\"-50 -10 {} {}\" role=\"img\" aria-label=\"{}\">",
            WIDTH + 70.0,
            HEIGHT + 60.0,
            self.title
        );
        for (i, &count) in bins.iter().enumerate() {
            let color = css((self.color)((edge(i) + edge(i + 1)) / 2.0));
            let height = HEIGHT * count as f64 / highest;
            let _ = write!(
                svg,
                "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{bar:.1}\" height=\"{height:.1}\" \
                 fill=\"{color}\" stroke=\"#555\" stroke-width=\".4\"/>",
                i as f64 * bar,
                HEIGHT - height,
            );
        }
        if !expected.is_empty() {
            svg.push_str("<polyline fill=\"none\" stroke=\"#111\" stroke-width=\"1.5\" points=\"");
            for (i, &count) in expected.iter().enumerate() {
                let y = HEIGHT * (1.0 - count / highest);
                let _ = write!(svg, "{:.1},{y:.1} ", (i as f64 + 0.5) * bar);
            }
            svg.push_str("\"/>");
        }
        self.axis(&mut svg, highest, beyond);
        svg
    }

    fn axis(&self, svg: &mut String, highest: f64, beyond: usize) {
        let _ = write!(
            svg,
            "<line x1=\"0\" y1=\"{HEIGHT}\" x2=\"{WIDTH}\" y2=\"{HEIGHT}\" stroke=\"#333\"/>"
        );
        for i in 0..=4 {
            let share = i as f64 / 4.0;
            let _ = write!(
                svg,
                "<text x=\"{:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
                share * WIDTH,
                HEIGHT + 18.0,
                short(self.low + share * (self.high - self.low))
            );
        }
        let _ = write!(
            svg,
            "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{} \
             ({beyond} of {} points lie beyond)</text>\
             <text x=\"-6\" y=\"10\" text-anchor=\"end\">{highest:.0}</text>\
             <text x=\"-6\" y=\"{HEIGHT}\" text-anchor=\"end\">0</text></svg>",
            WIDTH / 2.0,
            HEIGHT + 40.0,
            self.title,
            self.values.len()
        );
    }
}

/// Bar of the colours from `low` to `high`, with `unit` at its middle.
pub fn color_bar(low: f64, high: f64, unit: &str, color: &dyn Fn(f64) -> Rgb) -> String {
    let mut svg = format!(
        "<svg viewBox=\"-20 0 480 44\" class=\"bar\" role=\"img\" \
         aria-label=\"colours from {} to {} {unit}\">",
        short(low),
        short(high)
    );
    for i in 0..100 {
        let fill = css(color(low + (high - low) * (i as f64 + 0.5) / 100.0));
        let x = 20 + 4 * i;
        let _ = write!(
            svg,
            "<rect x=\"{x}\" y=\"0\" width=\"4.2\" height=\"18\" fill=\"{fill}\"/>"
        );
    }
    for (x, value) in [(20.0, low), (220.0, (low + high) / 2.0), (420.0, high)] {
        let _ = write!(
            svg,
            "<text x=\"{x}\" y=\"36\" text-anchor=\"middle\">{} {unit}</text>",
            short(value),
        );
    }
    svg.push_str("</svg>");
    svg
}

/// One bar of parts: name, share of the whole, colour.
pub fn share_bar(title: &str, parts: &[(&str, f64, Rgb)]) -> String {
    let mut svg = format!(
        "<svg viewBox=\"0 0 720 30\" class=\"shares\" role=\"img\" aria-label=\"{title}\">"
    );
    let mut x = 0.0;
    for (name, share, color) in parts {
        let _ = write!(
            svg,
            "<rect x=\"{x:.2}\" y=\"0\" width=\"{:.2}\" height=\"30\" fill=\"{}\">\
             <title>{name}: {} of 100</title></rect>",
            720.0 * share,
            css(*color),
            short(100.0 * share)
        );
        x += 720.0 * share;
    }
    svg.push_str("</svg>");
    svg
}

/// Three significant digits, four decimals at the most, without an exponent.
pub fn short(value: f64) -> String {
    if value.abs() < 5e-5 {
        return "0".into();
    }
    let digits = (2 - value.abs().log10().floor() as i32).clamp(0, 4) as usize;
    format!("{value:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_numbers_keep_three_digits() {
        let texts = [0.0, -1e-12, 12345.6, 1.5, -0.01234].map(short);
        assert_eq!(texts, ["0", "0", "12346", "1.50", "-0.0123"]);
    }

    #[test]
    fn a_histogram_counts_what_lies_beyond() {
        let histogram = Histogram {
            title: "x",
            values: &[0.0, 0.1, -0.1, 9.0],
            low: -1.0,
            high: 1.0,
            color: &|_| [0, 0, 0],
            expected: Some(&|_, _| 0.5),
        };
        let svg = histogram.svg();
        assert!(svg.contains("(1 of 4 points lie beyond)"), "{svg}");
        assert!(svg.contains("<polyline") && !svg.contains("NaN"));
    }

    #[test]
    fn a_bar_of_shares_is_as_long_as_their_sum() {
        let svg = share_bar("t", &[("a", 0.25, [1, 2, 3]), ("b", 0.75, [4, 5, 6])]);
        assert!(svg.contains("x=\"180.00\"") && svg.contains("width=\"540.00\""));
    }
}

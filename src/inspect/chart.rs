//! Charts as SVG text.

use super::picture::diverging_color;
use std::fmt::Write;

/// Histogram of deviations (µm) within ±`limit`; what lies beyond is counted in
/// the caption.
pub fn deviation_histogram(deviations_um: &[f64], limit: f64) -> String {
    const BINS: usize = 81;
    const WIDTH: f64 = 720.0;
    const HEIGHT: f64 = 220.0;
    let mut bins = [0usize; BINS];
    let mut beyond = 0;
    for &d in deviations_um {
        if d.abs() > limit {
            beyond += 1;
        } else {
            let share = (d + limit) / (2.0 * limit);
            bins[((share * BINS as f64) as usize).min(BINS - 1)] += 1;
        }
    }
    let highest = bins.iter().copied().max().unwrap_or(0).max(1);
    let bar = WIDTH / BINS as f64;
    let mut svg = format!(
        "<svg viewBox=\"-60 -10 {} {}\" role=\"img\" aria-label=\"histogram of deviations\">",
        WIDTH + 80.0,
        HEIGHT + 60.0
    );
    for (i, &count) in bins.iter().enumerate() {
        let value = ((i as f64 + 0.5) / BINS as f64 * 2.0 - 1.0) * limit;
        let [r, g, b] = diverging_color(value, limit);
        let height = HEIGHT * count as f64 / highest as f64;
        let _ = write!(
            svg,
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" \
             fill=\"rgb({r},{g},{b})\" stroke=\"#555\" stroke-width=\".4\"/>",
            i as f64 * bar,
            HEIGHT - height,
            bar,
            height
        );
    }
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
            short((share * 2.0 - 1.0) * limit)
        );
    }
    let _ = write!(
        svg,
        "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">deviation from CAD, µm \
         ({beyond} of {} points lie beyond)</text>\
         <text x=\"-6\" y=\"10\" text-anchor=\"end\">{highest}</text>\
         <text x=\"-6\" y=\"{HEIGHT}\" text-anchor=\"end\">0</text></svg>",
        WIDTH / 2.0,
        HEIGHT + 40.0,
        deviations_um.len()
    );
    svg
}

/// Colour bar for the deviations of a cloud picture.
pub fn color_bar(limit_um: f64) -> String {
    let mut svg = String::from(
        "<svg viewBox=\"0 0 420 48\" class=\"bar\" role=\"img\" aria-label=\"colour bar\">",
    );
    for i in 0..100 {
        let [r, g, b] = diverging_color((i as f64 + 0.5) / 50.0 - 1.0, 1.0);
        let _ = write!(
            svg,
            "<rect x=\"{}\" y=\"0\" width=\"4.2\" height=\"18\" fill=\"rgb({r},{g},{b})\"/>",
            10 + 4 * i
        );
    }
    for (x, value) in [(10.0, -limit_um), (210.0, 0.0), (410.0, limit_um)] {
        let anchor = match x as u32 {
            10 => "start",
            210 => "middle",
            _ => "end",
        };
        let _ = write!(
            svg,
            "<text x=\"{x}\" y=\"36\" text-anchor=\"{anchor}\">{}{}</text>",
            short(value),
            if value == 0.0 { " µm" } else { "" }
        );
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
        let svg = deviation_histogram(&[0.0, 0.1, -0.1, 9.0], 1.0);
        assert!(svg.contains("(1 of 4 points lie beyond)"), "{svg}");
        assert!(!svg.contains("NaN"));
    }
}

//! Plots of the figures of a sweep against the varied values.

use super::axes::{Axes, Axis, ChartPoint, legend};
use super::color::css;
use super::svg::Svg;

/// One plot.
pub struct SweepPanel<'a> {
    /// Name of the figure in the table.
    pub title: &'a str,
    /// Title of the horizontal axis: a varied key or another figure.
    pub x: &'a str,
    /// Title of the vertical axis, the figure.
    pub y: &'a str,
    /// Names of the values 0, 1, 2, … if the varied value is not a number.
    pub words: Vec<String>,
    /// True if the points of a curve are joined by lines.
    pub joined: bool,
    pub curves: Vec<SweepCurve>,
}

/// Points with equal other values, ordered by x.
pub struct SweepCurve {
    pub name: String,
    pub points: Vec<(f64, f64)>,
    /// Positions on the horizontal axis without a figure.
    pub gaps: Vec<f64>,
}

/// Colours that are distinguishable with red-green colour blindness (Wong 2011).
const COLOURS: [[u8; 3]; 7] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [204, 121, 167],
    [86, 180, 233],
    [230, 159, 0],
    [0, 0, 0],
];
const NONE: &str = "fill='none' stroke='#888' stroke-width='1.5'";
const WIDTH: f64 = 820.0;
const HEIGHT: f64 = 240.0;
const LINE: f64 = 18.0;

/// Draws all panels below each other.
pub fn sweep_plot(headline: [&str; 2], panels: &[SweepPanel]) -> String {
    let heights = panels
        .iter()
        .map(|panel| HEIGHT + 90.0 + LINE * entries(panel).len() as f64);
    let height = 70.0 + heights.sum::<f64>();
    let mut svg = Svg::file([WIDTH + 120.0, height], 12.0);
    svg.text(
        [80.0, 30.0],
        "font-size='17' font-weight='bold'",
        headline[0],
    );
    svg.text([80.0, 50.0], "", headline[1]);
    let mut top = 90.0;
    for panel in panels {
        draw(&mut svg, panel, top);
        let entries = entries(panel);
        let shown: Vec<(ChartPoint, &str, &str)> = entries
            .iter()
            .map(|(mark, style, name)| (*mark, style.as_str(), name.as_str()))
            .collect();
        legend(&mut svg, [80.0, top + HEIGHT + 60.0], [0.0, LINE], &shown);
        top += HEIGHT + 90.0 + LINE * shown.len() as f64;
    }
    svg.finish()
}

/// Returns the colour of a curve; grey if there are more curves than distinguishable colours.
fn colour(panel: &SweepPanel, i: usize) -> String {
    match panel.curves.len() <= COLOURS.len() {
        true => css(COLOURS[i]),
        false => "#557".to_owned(),
    }
}

fn entries(panel: &SweepPanel) -> Vec<(ChartPoint, String, String)> {
    let named = (2..=COLOURS.len()).contains(&panel.curves.len());
    let curves = panel.curves.iter().enumerate().filter(|_| named);
    let mut entries: Vec<(ChartPoint, String, String)> = curves
        .map(|(i, curve)| {
            (
                ChartPoint::Dot,
                format!("fill='{}'", colour(panel, i)),
                curve.name.clone(),
            )
        })
        .collect();
    if panel.curves.iter().any(|curve| !curve.gaps.is_empty()) {
        let about = format!("no {}: refused, or nothing measured", panel.y);
        entries.push((ChartPoint::Diamond, NONE.to_owned(), about));
    }
    entries
}

fn draw(svg: &mut Svg, panel: &SweepPanel, top: f64) {
    let points = || panel.curves.iter().flat_map(|curve| &curve.points);
    let gaps = panel.curves.iter().flat_map(|curve| &curve.gaps);
    let mut xs: Vec<f64> = points().map(|&(x, _)| x).chain(gaps.copied()).collect();
    xs.sort_by(f64::total_cmp);
    xs.dedup();
    let ys: Vec<f64> = points().map(|&(_, y)| y).collect();
    let axes = Axes {
        frame: [80.0, top, WIDTH, HEIGHT],
        beyond: [0.0; 2],
        title: panel.title,
        x: match panel.words.is_empty() {
            false => Axis::named(panel.x, &panel.words),
            true if geometric(&xs) => {
                let margin = (xs[xs.len() - 1] / xs[0]).powf(0.03);
                Axis::logarithmic(panel.x, [xs[0] / margin, xs[xs.len() - 1] * margin])
            }
            true => Axis::linear(panel.x, ends(&xs, false)),
        },
        y: Axis::linear(panel.y, ends(&ys, true)),
    };
    axes.draw(svg);
    for (i, curve) in panel.curves.iter().enumerate() {
        let colour = colour(panel, i);
        if panel.joined {
            let style = format!("stroke='{colour}' stroke-width='1.5'");
            axes.curve(svg, curve.points.iter().copied(), &style);
        }
        for &(x, y) in &curve.points {
            ChartPoint::Dot.draw(svg, axes.at(x, y), &format!("fill='{colour}'"));
        }
        for &x in &curve.gaps {
            let at = [axes.at(x, 0.0)[0], top + HEIGHT];
            ChartPoint::Diamond.draw(svg, at, NONE);
        }
    }
}

/// Returns true if sorted numbers are spaced by ratios rather than by differences.
fn geometric(xs: &[f64]) -> bool {
    let [first, .., last] = xs else { return false };
    let middle = xs[xs.len() / 2];
    let [even, by_ratio] = [(first + last) / 2.0, (first * last).max(0.0).sqrt()];
    xs.len() > 2 && *first > 0.0 && last / first >= 3.0 && middle < (even + by_ratio) / 2.0
}

/// Returns the ends of an axis for these values. The axis starts at 0 if `from_zero` is set and 0
/// is close to the values.
fn ends(values: &[f64], from_zero: bool) -> [f64; 2] {
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if low > high {
        return [0.0, 1.0];
    }
    let margin = match high - low {
        0.0 => 0.5 * high.abs().max(1e-9),
        span => 0.06 * span,
    };
    match from_zero && low >= 0.0 && low < 0.7 * high {
        true => [0.0, high + margin],
        false => [low - margin, high + margin],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_follow_how_numbers_are_spread() {
        assert!(geometric(&[4.0, 5.6, 8.0, 11.0, 16.0]));
        assert!(!geometric(&[10.0, 20.0, 30.0, 40.0]) && !geometric(&[-1.0, 1.0, 9.0]));
        assert!(!geometric(&[1.0, 9.0]) && !geometric(&[]));
        assert_eq!(ends(&[1.0, 3.0], true), [0.0, 3.12]);
        assert_eq!(ends(&[], true), [0.0, 1.0]);
        assert_eq!(ends(&[4.0], false), [2.0, 6.0]);
    }

    /// Special characters in names cannot break the image.
    #[test]
    fn each_point_and_gap_is_drawn_and_names_are_escaped() {
        let curve = |name: &str, gaps: &[f64]| SweepCurve {
            name: name.into(),
            points: vec![(1.0, 2.0), (2.0, 3.0)],
            gaps: gaps.to_vec(),
        };
        let panel = SweepPanel {
            title: "deviation.std_um",
            x: "camera.f_number",
            y: "deviation, µm",
            words: vec![],
            joined: true,
            curves: vec![curve("a <b>", &[]), curve("c", &[3.0])],
        };
        let svg = sweep_plot(["scene", "4 places"], &[panel]);
        // Four points and two entries of the legend; one gap and its entry.
        assert_eq!(svg.matches("<circle").count(), 6);
        assert_eq!(svg.matches("<polygon").count(), 2);
        assert_eq!(svg.matches("<polyline").count(), 2);
        let names = ["deviation.std_um", "deviation, µm", "camera.f_number"];
        assert!(
            names
                .iter()
                .all(|name| svg.contains(&format!(">{name}</text>")))
        );
        // Round numbers on both axes.
        assert!(
            [">2.5</text>", ">1.5</text>"]
                .iter()
                .all(|tick| svg.contains(tick))
        );
        assert!(!svg.contains("<b>"), "{svg}");
    }
}

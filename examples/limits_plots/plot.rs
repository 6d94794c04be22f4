//! Small multiples on logarithmic axes, as SVG text.

use std::fmt::Write;

pub struct Curve {
    pub label: &'static str,
    pub points: Vec<(f64, f64)>,
}

/// One method: its error over the condition that makes it fail.
pub struct Panel {
    pub title: &'static str,
    pub x: &'static str,
    pub y: &'static str,
    /// Powers of ten between which y is drawn; what is below is drawn at the foot.
    pub powers: (i32, i32),
    pub curves: Vec<Curve>,
}

const COLUMNS: usize = 4;
const WIDTH: f64 = 250.0;
const HEIGHT: f64 = 200.0;
/// From one panel's corner to the next one's.
const STEP: (f64, f64) = (335.0, 350.0);
const COLORS: [&str; 3] = ["#c0392b", "#2471a3", "#1e8449"];

impl Panel {
    /// Powers of ten around the x of all curves.
    fn x_powers(&self) -> (f64, f64) {
        let xs = self
            .curves
            .iter()
            .flat_map(|c| &c.points)
            .map(|p| p.0.log10());
        let (low, high) = xs.fold((f64::MAX, f64::MIN), |(l, h), x| (l.min(x), h.max(x)));
        ((low + 1e-9).floor(), (high - 1e-9).ceil())
    }

    fn svg(&self, left: f64, top: f64) -> String {
        let (low, high) = self.x_powers();
        let (foot, head) = (self.powers.0 as f64, self.powers.1 as f64);
        let x = |value: f64| left + WIDTH * (value.log10() - low) / (high - low);
        let y = |value: f64| {
            let power = value.max(1e-99).log10().clamp(foot, head);
            top + HEIGHT * (head - power) / (head - foot)
        };
        let mut svg = format!(
            "<text x=\"{left}\" y=\"{}\" font-weight=\"bold\">{}</text>\
             <rect x=\"{left}\" y=\"{top}\" width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"none\" \
             stroke=\"#888\"/>",
            top - 32.0,
            self.title
        );
        let every = |span: f64| (span / 6.0).ceil().max(1.0) as usize;
        for power in (low as i32..=high as i32).step_by(every(high - low)) {
            let at = x(10f64.powi(power));
            let _ = write!(
                svg,
                "<path d=\"M{at:.1} {top}v{HEIGHT}\" stroke=\"#eee\"/><text x=\"{at:.1}\" \
                 y=\"{}\" text-anchor=\"middle\">{}</text>",
                top + HEIGHT + 16.0,
                ten(power)
            );
        }
        for power in (self.powers.0..=self.powers.1).step_by(every(head - foot)) {
            let at = y(10f64.powi(power));
            let _ = write!(
                svg,
                "<path d=\"M{left} {at:.1}h{WIDTH}\" stroke=\"#eee\"/><text x=\"{}\" \
                 y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                left - 5.0,
                at + 4.0,
                ten(power)
            );
        }
        let _ = write!(
            svg,
            "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{}</text><text x=\"{left}\" \
             y=\"{}\" fill=\"#444\">{}</text>",
            left + WIDTH / 2.0,
            top + HEIGHT + 34.0,
            self.x,
            top - 15.0,
            self.y
        );
        self.draw_curves(&mut svg, (left, top), &x, &y);
        svg
    }

    fn draw_curves(
        &self,
        svg: &mut String,
        (left, top): (f64, f64),
        x: &dyn Fn(f64) -> f64,
        y: &dyn Fn(f64) -> f64,
    ) {
        for (i, (curve, color)) in self.curves.iter().zip(COLORS).enumerate() {
            let places = curve.points.iter().map(|&(a, b)| (x(a), y(b)));
            let line: String = places
                .clone()
                .map(|(x, y)| format!("{x:.1},{y:.1} "))
                .collect();
            let _ = write!(
                svg,
                "<polyline points=\"{line}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.6\"/>"
            );
            for (x, y) in places {
                let _ = write!(
                    svg,
                    "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.5\" fill=\"{color}\"/>"
                );
            }
            let _ = write!(
                svg,
                "<text x=\"{left}\" y=\"{}\" fill=\"{color}\">{}</text>",
                top + HEIGHT + 52.0 + 14.0 * i as f64,
                curve.label
            );
        }
    }
}

/// 10 with a power written above it.
fn ten(power: i32) -> String {
    match power {
        0 => "1".into(),
        1 => "10".into(),
        _ => format!("10<tspan dy=\"-4\" font-size=\"8\">{power}</tspan>"),
    }
}

pub fn drawing(panels: &[Panel]) -> String {
    let rows = panels.len().div_ceil(COLUMNS) as f64;
    let (width, height) = (STEP.0 * COLUMNS as f64 + 40.0, STEP.1 * rows + 60.0);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" \
         width=\"{width}\" font-family=\"sans-serif\" font-size=\"12\" fill=\"#222\">\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/><text x=\"60\" y=\"30\" \
         font-size=\"17\" font-weight=\"bold\">Errors as the limit of each method is \
         approached</text><text x=\"60\" y=\"48\">What is less than a panel's foot, none \
         included, is drawn on it.</text>"
    );
    for (i, panel) in panels.iter().enumerate() {
        let (row, column) = (i / COLUMNS, i % COLUMNS);
        svg += &panel.svg(60.0 + STEP.0 * column as f64, 110.0 + STEP.1 * row as f64);
    }
    svg + "</svg>\n"
}

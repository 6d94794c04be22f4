//! Plots of the wave-optics experiments as SVG text.

use crate::speckle::motion::overlap_correlation;
use crate::wave::centroid::CentroidRow;
use crate::wave::correlation::Estimate;
use crate::wave::motion::MotionRow;
use std::fmt::Write;

const WAVES: &str = "#c0392b";
const WAVES_OTHER: &str = "#2471a3";
const THEORY: &str = "#222";

/// A rectangle of the drawing with its axes' ranges.
struct Panel {
    /// Left, top, width, height (px).
    frame: [f64; 4],
    x: (f64, f64),
    y: (f64, f64),
}

impl Panel {
    fn px(&self, x: f64) -> f64 {
        self.frame[0] + self.frame[2] * (x - self.x.0) / (self.x.1 - self.x.0)
    }

    fn py(&self, y: f64) -> f64 {
        self.frame[1] + self.frame[3] * (self.y.1 - y) / (self.y.1 - self.y.0)
    }

    /// Frame, grid, tick labels at `steps`, axis titles and the panel's title.
    fn axes(&self, svg: &mut String, steps: [f64; 2], titles: [&str; 3]) {
        let [left, top, width, height] = self.frame;
        let [title, x_title, y_title] = titles;
        for x in ticks(self.x, steps[0]) {
            let px = self.px(x);
            line(svg, [px, top, px, top + height], "#ddd", "");
            text(svg, [px, top + height + 18.0], "middle", &tick_label(x));
        }
        for y in ticks(self.y, steps[1]) {
            let py = self.py(y);
            line(svg, [left, py, left + width, py], "#ddd", "");
            text(svg, [left - 8.0, py + 4.0], "end", &tick_label(y));
        }
        put(
            svg,
            format_args!(
                r##"<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="none" stroke="#222"/>"##
            ),
        );
        let middle = left + width / 2.0;
        text(svg, [middle, top + height + 40.0], "middle", x_title);
        let (x, y) = (left - 48.0, top + height / 2.0);
        put(
            svg,
            format_args!(
                r#"<text text-anchor="middle" transform="translate({x:.1} {y:.1}) rotate(-90)">{}</text>"#,
                escaped(y_title)
            ),
        );
        put(
            svg,
            format_args!(
                r#"<text text-anchor="start" font-weight="bold" x="{left}" y="{:.1}">{}</text>"#,
                top - 10.0,
                escaped(title)
            ),
        );
    }

    fn curve(&self, svg: &mut String, dash: &str, f: impl Fn(f64) -> f64) {
        let mut points = String::new();
        for i in 0..=200 {
            let x = self.x.0 + (self.x.1 - self.x.0) * f64::from(i) / 200.0;
            write_to(
                &mut points,
                format_args!("{:.1},{:.1} ", self.px(x), self.py(f(x))),
            );
        }
        put(
            svg,
            format_args!(
                r#"<polyline points="{}" fill="none" stroke="{THEORY}" stroke-width="1.5" stroke-dasharray="{dash}"/>"#,
                points.trim_end()
            ),
        );
    }

    /// A dot with a bar over its interval.
    fn estimate(&self, svg: &mut String, x: f64, e: &Estimate, colour: &str) {
        let px = self.px(x);
        line(svg, [px, self.py(e.low), px, self.py(e.high)], colour, "");
        for y in [e.low, e.high] {
            let py = self.py(y);
            line(svg, [px - 3.0, py, px + 3.0, py], colour, "");
        }
        dot(svg, [px, self.py(e.value)], colour);
    }
}

/// Correlation and displacement of [`MotionRow`]s, one drawing: left, γ over δ by
/// waves with 95 % intervals, the overlap law as a curve, and a diamond where the
/// prediction with defocus lies; middle and right, measured minus predicted γ and
/// displacement (µm on the sensor) of each row, γ also of the fields a scan reads
/// (`textures`, one a row); below, the names of the rows.
pub fn motion_plot(rows: &[MotionRow], textures: &[f64]) -> String {
    assert_eq!(rows.len(), textures.len(), "one texture a row");
    let deltas = rows.iter().map(|r| r.delta);
    let correlation = Panel {
        frame: [70.0, 50.0, 300.0, 360.0],
        x: (0.0, (deltas.fold(0.4, f64::max) * 1.1).min(1.1)),
        y: (0.0, 1.0),
    };
    let names_top = 490.0;
    let half = rows.len().div_ceil(2);
    let mut svg = opened(1180.0, names_top + 20.0 * half as f64 + 20.0);
    let titles = [
        "Correlation of the speckle intensity",
        "δ = |A_p|/D, shift across the pupil in diameters",
        "γ",
    ];
    correlation.axes(&mut svg, [0.1, 0.1], titles);
    correlation.curve(&mut svg, "", overlap_correlation);
    for row in rows {
        let (x, y) = (row.delta, row.gamma_defocused);
        diamond(&mut svg, [correlation.px(x), correlation.py(y)]);
        correlation.estimate(&mut svg, x, &row.waves.gamma, WAVES);
    }
    correlation_legend(&mut svg, [180.0, 70.0]);

    let gamma = |k: usize| {
        let (row, value) = (&rows[k], textures[k]);
        let texture = Estimate {
            value,
            low: value,
            high: value,
        };
        Some([&row.waves.gamma, &texture].map(|e| minus(e, row.gamma_defocused)))
    };
    let titles = ["Correlation: waves minus prediction", "row", "γ"];
    residual_panel(&mut svg, 460.0, titles, rows.len(), gamma);
    let titles = [
        "Displacement: waves minus tensor formula",
        "row",
        "µm on the sensor",
    ];
    residual_panel(&mut svg, 850.0, titles, rows.len(), |k| {
        let row = &rows[k];
        let found = row.waves.displacement?;
        let axis = |k: usize| minus(&found[k].scaled(1e3), row.displacement_um[k]);
        Some([axis(0), axis(1)])
    });
    residual_legend(&mut svg, 665.0, ["waves", "scan's fields"]);
    residual_legend(&mut svg, 1070.0, ["along x", "along y"]);
    for (k, row) in rows.iter().enumerate() {
        let place = [
            70.0 + 550.0 * (k / half) as f64,
            names_top + 20.0 * (k % half) as f64,
        ];
        text(
            &mut svg,
            place,
            "start",
            &format!("{}: {}", k + 1, row.name),
        );
    }
    svg + "</svg>\n"
}

fn minus(e: &Estimate, value: f64) -> Estimate {
    Estimate {
        value: e.value - value,
        low: e.low - value,
        high: e.high - value,
    }
}

/// What `residuals` gives for each row, over the row's number.
fn residual_panel<const N: usize>(
    svg: &mut String,
    left: f64,
    titles: [&str; 3],
    rows: usize,
    residuals: impl Fn(usize) -> Option<[Estimate; N]>,
) {
    let found: Vec<(f64, [Estimate; N])> = (0..rows)
        .filter_map(|k| Some(((k + 1) as f64, residuals(k)?)))
        .collect();
    let bounds = found.iter().flat_map(|(_, r)| r);
    let reach = bounds.fold(0.01, |m: f64, e| m.max(-e.low).max(e.high)) * 1.1;
    let panel = Panel {
        frame: [left, 50.0, 300.0, 360.0],
        x: (0.0, rows as f64 + 1.0),
        y: (-reach, reach),
    };
    let row_step = nice_step(panel.x.1).max(1.0);
    panel.axes(svg, [row_step, nice_step(2.0 * reach)], titles);
    let zero = panel.py(0.0);
    line(svg, [left, zero, left + 300.0, zero], THEORY, "");
    for (k, estimates) in &found {
        for (side, e) in estimates.iter().enumerate() {
            let beside = 0.3 * (side as f64 - (N - 1) as f64 / 2.0);
            panel.estimate(svg, k + beside, e, [WAVES, WAVES_OTHER][side]);
        }
    }
}

fn residual_legend(svg: &mut String, x: f64, names: [&str; 2]) {
    for (k, (colour, name)) in [WAVES, WAVES_OTHER].into_iter().zip(names).enumerate() {
        let y = 70.0 + 18.0 * k as f64;
        dot(svg, [x, y - 4.0], colour);
        text(svg, [x + 10.0, y], "start", name);
    }
}

fn correlation_legend(svg: &mut String, [x, y]: [f64; 2]) {
    line(svg, [x, y - 4.0, x + 16.0, y - 4.0], THEORY, "");
    text(svg, [x + 24.0, y], "start", "overlap law γ(δ)");
    diamond(svg, [x + 8.0, y + 14.0]);
    text(
        svg,
        [x + 24.0, y + 18.0],
        "start",
        "prediction with defocus",
    );
    dot(svg, [x + 8.0, y + 32.0], WAVES);
    text(svg, [x + 24.0, y + 36.0], "start", "waves, 95 % interval");
}

/// Centroid noise over line width, both in grains: waves with 95 % intervals over
/// all rows and over bright ones, the law 0.3905·√(hσ) of a Gaussian line times
/// fully developed speckle, and the limit h/π of a diffraction-limited spot
/// (Dorsch, Häusler & Herrmann 1994).
pub fn centroid_plot(rows: &[CentroidRow]) -> String {
    let widest = rows.iter().map(|r| r.width).fold(1.0, f64::max);
    let highest = rows
        .iter()
        .map(|r| r.waves.high.max(r.law))
        .fold(0.4, f64::max);
    let panel = Panel {
        frame: [80.0, 50.0, 520.0, 360.0],
        x: (0.0, widest * 1.08),
        y: (0.0, highest * 1.1),
    };
    let mut svg = opened(640.0, 480.0);
    let titles = [
        "Noise of a laser line's centroid",
        "w/h: 1/e² radius of the line in grains",
        "standard deviation of the centroid in grains",
    ];
    panel.axes(
        &mut svg,
        [nice_step(panel.x.1), nice_step(panel.y.1)],
        titles,
    );
    panel.curve(&mut svg, "", |w| 0.3905 * (w / 2.0).sqrt());
    panel.curve(&mut svg, "5 4", |_| std::f64::consts::FRAC_1_PI);
    for row in rows {
        panel.estimate(&mut svg, row.width, &row.waves, WAVES);
        panel.estimate(&mut svg, row.width, &row.waves_bright, WAVES_OTHER);
    }
    let (x, y) = (330.0, 320.0);
    line(&mut svg, [x, y - 4.0, x + 16.0, y - 4.0], THEORY, "");
    text(&mut svg, [x + 24.0, y], "start", "0.3905·√(h·σ), σ = w/2");
    line(&mut svg, [x, y + 14.0, x + 16.0, y + 14.0], THEORY, "5 4");
    text(
        &mut svg,
        [x + 24.0, y + 18.0],
        "start",
        "h/π, spot (Dorsch 1994)",
    );
    dot(&mut svg, [x + 8.0, y + 32.0], WAVES);
    text(
        &mut svg,
        [x + 24.0, y + 36.0],
        "start",
        "waves, all rows, 95 % interval",
    );
    dot(&mut svg, [x + 8.0, y + 50.0], WAVES_OTHER);
    text(
        &mut svg,
        [x + 24.0, y + 54.0],
        "start",
        "waves, rows over half the mean light",
    );
    svg + "</svg>\n"
}

fn opened(width: f64, height: f64) -> String {
    format!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" font-family="sans-serif" font-size="12" fill="#222">
<rect width="{width}" height="{height}" fill="white"/>
"##
    )
}

/// Multiples of `step` within the range.
fn ticks(range: (f64, f64), step: f64) -> impl Iterator<Item = f64> {
    let slack = 1e-9 * step;
    let first = ((range.0 - slack) / step).ceil() as i64;
    let last = ((range.1 + slack) / step).floor() as i64;
    (first..=last).map(move |k| k as f64 * step)
}

/// 1, 2 or 5 times a power of ten that divides `span` into four to ten.
fn nice_step(span: f64) -> f64 {
    let power = 10f64.powf((span / 10.0).log10().floor());
    let fits = |m: &&f64| span / (**m * power) <= 10.0;
    power * [1.0, 2.0, 5.0].iter().find(fits).unwrap_or(&10.0)
}

fn tick_label(value: f64) -> String {
    let rounded = (value * 1e6).round() / 1e6;
    format!("{}", if rounded == 0.0 { 0.0 } else { rounded })
}

fn line(svg: &mut String, [x1, y1, x2, y2]: [f64; 4], colour: &str, dash: &str) {
    put(
        svg,
        format_args!(
            r#"<line x1="{x1:.1}" y1="{y1:.1}" x2="{x2:.1}" y2="{y2:.1}" stroke="{colour}" stroke-dasharray="{dash}"/>"#
        ),
    );
}

fn dot(svg: &mut String, [x, y]: [f64; 2], colour: &str) {
    put(
        svg,
        format_args!(r#"<circle cx="{x:.1}" cy="{y:.1}" r="3" fill="{colour}"/>"#),
    );
}

fn diamond(svg: &mut String, [x, y]: [f64; 2]) {
    put(
        svg,
        format_args!(
            r#"<path d="M{x:.1} {:.1}l5 5l-5 5l-5 -5z" fill="none" stroke="{THEORY}"/>"#,
            y - 5.0
        ),
    );
}

fn text(svg: &mut String, [x, y]: [f64; 2], anchor: &str, content: &str) {
    put(
        svg,
        format_args!(
            r#"<text x="{x:.1}" y="{y:.1}" text-anchor="{anchor}">{}</text>"#,
            escaped(content)
        ),
    );
}

fn escaped(content: &str) -> String {
    content.replace('&', "&amp;").replace('<', "&lt;")
}

fn put(svg: &mut String, element: std::fmt::Arguments) {
    write_to(svg, element);
    svg.push('\n');
}

fn write_to(text: &mut String, content: std::fmt::Arguments) {
    text.write_fmt(content).expect("a String takes any text");
}

#[cfg(test)]
mod tests;

//! Accuracy against speed as SVG text: points over logarithmic axes, numbered, and
//! a table of what they are.

use super::chart::short;
use super::page::escape;
use std::fmt::Write;

/// One way of doing the frames.
pub struct Mark {
    /// What stands beside it.
    pub name: String,
    /// Quartiles of the time of a frame.
    pub ms: [f64; 3],
    /// Times as fast as the full model.
    pub speed_up: f64,
    /// Error of height; `None` where points are lost.
    pub within_um: Option<f64>,
    /// Systematic part of the error.
    pub bias_um: f64,
    /// Random part of the error.
    pub noise_um: f64,
    /// Share of points of the full model that it does not find.
    pub lost: f64,
    /// Random error against geometry; `None` for a point laser.
    pub scatter_um: Option<f64>,
    /// Standard deviation of the line, px; `None` without images.
    pub sigma_px: Option<f64>,
    /// Contrast of the light along the line; `None` without images.
    pub contrast: Option<f64>,
    /// Time per million samples.
    pub ms_per_million: Option<f64>,
    /// What it holds in memory, MB.
    pub memory_mb: f64,
    /// No other is both faster and more accurate.
    pub on_front: bool,
    /// What the scene's runs use.
    pub chosen: bool,
    /// Its error is not a method's but a draw's.
    pub hollow: bool,
}

/// Error against speed, one mark for each way of doing the frames.
pub struct AccuracyChart {
    /// Heading.
    pub title: String,
    /// Lines under the title.
    pub lead: Vec<String>,
    /// The scene's tolerance, if it states one.
    pub tolerance_um: Option<f64>,
    /// What speckle alone does to heights, if that is beyond the tolerance.
    pub limit_um: Option<f64>,
    /// In the order of the table.
    pub marks: Vec<Mark>,
}

const LEFT: f64 = 86.0;
const TOP: f64 = 142.0;
const WIDTH: f64 = 930.0;
const HEIGHT: f64 = 380.0;
/// Of the strip below the axis for those without error.
const STRIP: f64 = 26.0;
const ROW: f64 = 21.0;

/// Heads of the table's columns, in two lines, and where they end.
const COLUMNS: [([&str; 2], f64); 11] = [
    (["ms a", "frame"], 460.0),
    (["times", "as fast"], 514.0),
    (["ms per", "million"], 570.0),
    (["", "MB"], 620.0),
    (["99 of", "100, µm"], 684.0),
    (["bias,", "µm"], 742.0),
    (["noise,", "µm"], 796.0),
    (["lost,", "%"], 844.0),
    (["scatter,", "µm"], 904.0),
    (["width σ,", "px"], 966.0),
    (["contrast", ""], 1032.0),
];

const BLUE: &str = "#2166ac";
const ORANGE: &str = "#d95f02";
const GREY: &str = "#8a8a8a";

/// Logarithmic axis from one power of ten to another, over pixels.
struct Axis {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Axis {
    /// Over whole steps of 1, 2, 5 that hold all values.
    fn over(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Axis {
        let (low, high) = values.fold((f64::INFINITY, 0.0f64), |(low, high), v| {
            (low.min(v), high.max(v))
        });
        let (low, high) = if low <= high {
            (low, high)
        } else {
            (1.0, 10.0)
        };
        Axis {
            low: (low * 0.8).log10(),
            high: (high * 1.25).log10(),
            from,
            to,
        }
    }

    fn at(&self, value: f64) -> f64 {
        let share = (value.log10() - self.low) / (self.high - self.low);
        self.from + (self.to - self.from) * share.clamp(0.0, 1.0)
    }

    /// 1, 2 and 5 times each power of ten within; only the powers on a long axis.
    fn ticks(&self) -> Vec<f64> {
        let long = self.high - self.low > 3.0;
        let powers = self.low.floor() as i32..=self.high.ceil() as i32;
        let steps: &[f64] = if long { &[1.0] } else { &[1.0, 2.0, 5.0] };
        powers
            .flat_map(|power| steps.iter().map(move |s| s * 10f64.powi(power)))
            .filter(|v| (self.low..=self.high).contains(&v.log10()))
            .collect()
    }
}

impl AccuracyChart {
    /// The chart and its table as one SVG.
    pub fn svg(&self) -> String {
        let table_top = TOP + HEIGHT + STRIP + 92.0;
        let height = table_top + ROW * (self.marks.len() as f64 + 1.0) + 72.0;
        let width = LEFT + WIDTH + 30.0;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height:.0}\" \
             width=\"{width}\" height=\"{height:.0}\" font-family=\"sans-serif\" font-size=\"13\" \
             role=\"img\" aria-label=\"accuracy against speed\">\
             <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\
             <text x=\"24\" y=\"32\" font-size=\"18\" font-weight=\"bold\">{}</text>",
            escape(&self.title)
        );
        let lines = self.lead.iter().flat_map(|line| wrapped(line));
        for (i, line) in lines.enumerate() {
            let y = 54 + 18 * i;
            let _ = write!(
                svg,
                "<text x=\"24\" y=\"{y}\" fill=\"#444\">{}</text>",
                escape(&line)
            );
        }
        let speeds = self.marks.iter().map(|m| 1e3 / m.ms[1]);
        let x = Axis::over(speeds, LEFT, LEFT + WIDTH);
        let errors = self.marks.iter().filter_map(|m| m.within_um);
        let lines = [self.tolerance_um, self.limit_um].into_iter().flatten();
        let y = Axis::over(
            errors.filter(|&um| um > 0.0).chain(lines),
            TOP + HEIGHT,
            TOP + 22.0,
        );
        self.axes(&mut svg, &x, &y);
        self.limits(&mut svg, &y);
        self.front(&mut svg, &x, &y);
        self.points(&mut svg, &x, &y);
        self.table(&mut svg, table_top);
        svg.push_str("</svg>\n");
        svg
    }

    fn axes(&self, svg: &mut String, x: &Axis, y: &Axis) {
        let bottom = TOP + HEIGHT + STRIP;
        for value in x.ticks() {
            let at = x.at(value);
            let _ = write!(
                svg,
                "<line x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{TOP}\" y2=\"{bottom}\" \
                 stroke=\"#e4e4e4\"/><text x=\"{at:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
                bottom + 17.0,
                plain(value)
            );
        }
        for value in y.ticks() {
            let at = y.at(value);
            let _ = write!(
                svg,
                "<line x1=\"{LEFT}\" x2=\"{}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#e4e4e4\"/>\
                 <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                LEFT + WIDTH,
                LEFT - 7.0,
                at + 4.5,
                plain(value)
            );
        }
        let _ = write!(
            svg,
            "<rect x=\"{LEFT}\" y=\"{TOP}\" width=\"{WIDTH}\" height=\"{}\" fill=\"none\" \
             stroke=\"#333\"/><line x1=\"{LEFT}\" x2=\"{}\" y1=\"{y0}\" y2=\"{y0}\" stroke=\"#999\" \
             stroke-dasharray=\"2 3\"/>\
             <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">exact</text>\
             <text x=\"{}\" y=\"{}\" text-anchor=\"middle\">frames a second on one core \
             (faster →)</text>\
             <text transform=\"translate(22 {}) rotate(-90)\" text-anchor=\"middle\">error of \
             99 in 100 heights, µm (← better)</text>",
            HEIGHT + STRIP,
            LEFT + WIDTH,
            LEFT - 7.0,
            TOP + HEIGHT + STRIP / 2.0 + 4.5,
            LEFT + WIDTH / 2.0,
            bottom + 38.0,
            TOP + (HEIGHT + STRIP) / 2.0,
            y0 = TOP + HEIGHT,
        );
    }

    fn limits(&self, svg: &mut String, y: &Axis) {
        let mut line = |um: Option<f64>, text: &str, color: &str| {
            let Some(um) = um else { return };
            let at = y.at(um);
            let _ = write!(
                svg,
                "<line x1=\"{LEFT}\" x2=\"{}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"{color}\" \
                 stroke-width=\"1.5\" stroke-dasharray=\"7 4\"/>\
                 <text x=\"{}\" y=\"{:.1}\" fill=\"{color}\">{text} {} µm</text>",
                LEFT + WIDTH,
                LEFT + 8.0,
                at - 5.0,
                short(um)
            );
        };
        line(self.tolerance_um, "tolerance", ORANGE);
        let text = "what speckle itself does to a point:";
        line(self.limit_um, text, GREY);
    }

    fn y(mark: &Mark, axis: &Axis) -> f64 {
        match mark.within_um {
            None => TOP + 10.0,
            Some(0.0) => TOP + HEIGHT + STRIP / 2.0,
            Some(um) => axis.at(um),
        }
    }

    fn front(&self, svg: &mut String, x: &Axis, y: &Axis) {
        let on_front = self.marks.iter().filter(|m| m.on_front);
        let mut places: Vec<(f64, f64)> = on_front
            .map(|m| (x.at(1e3 / m.ms[1]), Self::y(m, y)))
            .collect();
        places.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut path = String::new();
        for (i, (px, py)) in places.iter().enumerate() {
            let letter = if i == 0 { 'M' } else { 'L' };
            let _ = write!(path, "{letter}{px:.1} {py:.1}");
        }
        let _ = write!(
            svg,
            "<path d=\"{path}\" fill=\"none\" stroke=\"{BLUE}\" stroke-width=\"2\" opacity=\".5\"/>"
        );
    }

    fn points(&self, svg: &mut String, x: &Axis, y: &Axis) {
        let mut taken: Vec<(f64, f64)> = Vec::new();
        let places: Vec<(f64, f64)> = self
            .marks
            .iter()
            .map(|m| (x.at(1e3 / m.ms[1]), Self::y(m, y)))
            .collect();
        for (i, (mark, &(px, py))) in self.marks.iter().zip(&places).enumerate() {
            let color = match (mark.chosen, mark.on_front) {
                (true, _) => ORANGE,
                (_, true) => BLUE,
                _ => GREY,
            };
            let [slow, fast] = [mark.ms[2], mark.ms[0]].map(|ms| x.at(1e3 / ms));
            let fill = if mark.hollow { "#fff" } else { color };
            let radius = if mark.chosen { 8.0 } else { 5.0 };
            let _ = write!(
                svg,
                "<line x1=\"{slow:.1}\" x2=\"{fast:.1}\" y1=\"{py:.1}\" y2=\"{py:.1}\" \
                 stroke=\"{color}\"/><circle cx=\"{px:.1}\" cy=\"{py:.1}\" r=\"{radius}\" \
                 fill=\"{fill}\" stroke=\"{color}\" stroke-width=\"1.6\"><title>{}</title></circle>",
                escape(&mark.name)
            );
            let (tx, ty) = free_place((px, py), &places, &taken);
            taken.push((tx, ty));
            let _ = write!(
                svg,
                "<line x1=\"{px:.1}\" y1=\"{py:.1}\" x2=\"{tx:.1}\" y2=\"{ty:.1}\" \
                 stroke=\"{color}\" stroke-width=\".5\"/>\
                 <text x=\"{tx:.1}\" y=\"{:.1}\" text-anchor=\"middle\" font-weight=\"bold\" \
                 fill=\"{color}\" stroke=\"#fff\" stroke-width=\"3\" paint-order=\"stroke\">{}</text>",
                ty + 4.5,
                i + 1
            );
        }
    }

    fn table(&self, svg: &mut String, top: f64) {
        let cell = |svg: &mut String, x: f64, y: f64, anchor: &str, style: &str, text: &str| {
            let text = escape(text);
            let _ = write!(
                svg,
                "<text x=\"{x}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" {style}>{text}</text>"
            );
        };
        let bold = "font-weight=\"bold\" font-size=\"12\"";
        for (titles, x) in COLUMNS {
            for (line, title) in titles.into_iter().enumerate() {
                let y = top - 15.0 * (1.0 - line as f64);
                cell(svg, x, y, "end", bold, title);
            }
        }
        for (i, mark) in self.marks.iter().enumerate() {
            let y = top + ROW * (i as f64 + 1.0);
            let style = match (mark.chosen, mark.on_front) {
                (true, _) => format!("fill=\"{ORANGE}\" font-weight=\"bold\""),
                (_, true) => format!("fill=\"{BLUE}\""),
                _ => "fill=\"#444\"".into(),
            };
            cell(svg, 42.0, y, "end", &style, &(i + 1).to_string());
            cell(
                svg,
                52.0,
                y,
                "start",
                &format!("{style} font-size=\"12\""),
                &mark.name,
            );
            let lost = |um: Option<f64>, none: &str| um.map_or(none.to_owned(), short);
            let cells = [
                short(mark.ms[1]),
                short(mark.speed_up),
                lost(mark.ms_per_million, "–"),
                short(mark.memory_mb),
                lost(mark.within_um, "lost"),
                short(mark.bias_um),
                short(mark.noise_um),
                short(100.0 * mark.lost),
                lost(mark.scatter_um, "–"),
                lost(mark.sigma_px, "–"),
                lost(mark.contrast, "–"),
            ];
            for ((_, x), text) in COLUMNS.iter().zip(cells) {
                cell(svg, *x, y, "end", &style, &text);
            }
        }
        let y = top + ROW * (self.marks.len() as f64 + 1.0) + 8.0;
        let notes = [
            "Orange: chosen. Blue: none is both faster and more accurate. Hollow: speckle with \
             other grains; its error is how far two draws differ, its scatter how well it does.",
            "99 of 100, bias, noise, lost: heights against 1, point by point. Scatter: against \
             geometry, what the sensor itself would show.",
            "ms per million: samples, each a ray but on planes. MB: hierarchy, speckle, one \
             frame. Contrast: of columns' light along the line.",
        ];
        for (i, note) in notes.into_iter().enumerate() {
            let style = "fill=\"#666\" font-size=\"11.5\"";
            cell(svg, 24.0, y + 16.0 * i as f64, "start", style, note);
        }
    }
}

/// A long line as several of some 140 characters.
fn wrapped(line: &str) -> Vec<String> {
    let mut lines = vec![String::new()];
    for word in line.split(' ') {
        let last = lines.last_mut().expect("there is one");
        match last.chars().count() + word.chars().count() < 140 {
            true if last.is_empty() => last.push_str(word),
            true => {
                last.push(' ');
                last.push_str(word);
            }
            false => lines.push(word.to_owned()),
        }
    }
    lines
}

/// Beside a mark, where neither marks nor other numbers are.
fn free_place((x, y): (f64, f64), marks: &[(f64, f64)], numbers: &[(f64, f64)]) -> (f64, f64) {
    let room = |&(px, py): &(f64, f64)| {
        let gap = |others: &[(f64, f64)]| {
            let gaps = others.iter().map(|(ox, oy)| (ox - px).hypot(oy - py));
            gaps.fold(f64::INFINITY, f64::min)
        };
        let inside = (LEFT + 8.0..LEFT + WIDTH - 8.0).contains(&px)
            && (TOP + 6.0..TOP + HEIGHT + STRIP - 6.0).contains(&py);
        (gap(marks).min(14.0) + gap(numbers).min(18.0)) * inside as u8 as f64
    };
    let around = (0..48).map(|i| {
        let (sin, cos) = ((i % 16) as f64 * std::f64::consts::TAU / 16.0 - 1.0).sin_cos();
        let away = 16.0 + 10.0 * (i / 16) as f64;
        (x + away * cos, y + away * sin)
    });
    let mut best = (x, y - 16.0);
    let mut most = room(&best);
    for place in around {
        if room(&place) > most + 0.5 {
            most = room(&place);
            best = place;
        }
    }
    best
}

fn plain(value: f64) -> String {
    match value >= 1.0 {
        true => format!("{value:.0}"),
        false => format!("{}", (value * 1e9).round() / 1e9),
    }
}

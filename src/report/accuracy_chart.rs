//! Chart of accuracy against speed as SVG: numbered points on logarithmic axes and a table of their
//! data.

use super::axes::{Axes, Axis};
use super::chart::short;
use super::svg::{END, MIDDLE, Svg};

/// Result of one configuration.
pub struct Mark {
    /// Name in the table.
    pub name: String,
    /// Quartiles of the time per frame, ms.
    pub ms: [f64; 3],
    /// Speed relative to the reference model.
    pub speed_up: f64,
    /// 99th percentile of the height error, µm; `None` if points are missing.
    pub percentile_99_um: Option<f64>,
    /// Systematic part of the height error, µm.
    pub median_error_um: f64,
    /// Random part of the height error, µm.
    pub half_width_68_um: f64,
    /// Fraction of the points of the reference model that are missing.
    pub lost: f64,
    /// Random error relative to the true geometry, µm; `None` for a point laser.
    pub scatter_um: Option<f64>,
    /// Standard deviation of the line, px; `None` without images.
    pub sigma_px: Option<f64>,
    /// Contrast of the light along the line; `None` without images.
    pub contrast: Option<f64>,
    /// Time per million samples, ms.
    pub ms_per_million: Option<f64>,
    /// Memory, MB.
    pub memory_mb: Option<f64>,
    /// True if no other configuration is both faster and more accurate.
    pub pareto_optimal: bool,
    /// True for the configuration that the scene uses.
    pub chosen: bool,
    /// True if the difference results from a different speckle realisation, not from the method.
    pub is_hollow: bool,
    /// True for the result of an external program.
    pub other: bool,
}

/// Chart of error against speed with one mark per configuration.
pub struct AccuracyChart {
    /// Heading.
    pub title: String,
    /// Lines below the title.
    pub lead: Vec<String>,
    /// Tolerance of the scene, µm; `None` if it states none.
    pub tolerance_um: Option<f64>,
    /// Height error due to speckle only, µm, if it exceeds the tolerance.
    pub speckle_limited_error_um: Option<f64>,
    /// Marks in the order of the table.
    pub marks: Vec<Mark>,
}

const LEFT: f64 = 86.0;
const TOP: f64 = 142.0;
const WIDTH: f64 = 930.0;
const HEIGHT: f64 = 406.0;
/// Margins of the frame, above for marks with missing points and below for marks without error, px.
const BEYOND: [f64; 2] = [22.0, 26.0];
const ROW: f64 = 21.0;

/// Headings of the table columns, in two lines, and right ends of the columns, px.
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

/// Number of characters of a name that fit next to the figures at full size.
const NAME: f64 = 64.0;

const BLUE: &str = "#2166ac";
const ORANGE: &str = "#d95f02";
const GREEN: &str = "#1b7837";
const GREY: &str = "#8a8a8a";

/// Returns the colour of a highlighted mark.
fn color(mark: &Mark) -> Option<&'static str> {
    match mark {
        Mark { chosen: true, .. } => Some(ORANGE),
        Mark { other: true, .. } => Some(GREEN),
        Mark {
            pareto_optimal: true,
            ..
        } => Some(BLUE),
        _ => None,
    }
}

/// Returns an interval slightly larger than the range of the values.
fn around(values: impl Iterator<Item = f64>) -> [f64; 2] {
    let ends = values.fold([f64::INFINITY, 0.0], |[low, high], v| {
        [v.min(low), v.max(high)]
    });
    let [low, high] = if ends[0] <= ends[1] {
        ends
    } else {
        [1.0, 10.0]
    };
    [low * 0.8, high * 1.25]
}

impl AccuracyChart {
    /// Returns the chart and its table as one SVG.
    pub fn svg(&self) -> String {
        let table_top = TOP + HEIGHT + 92.0;
        let height = table_top + ROW * (self.marks.len() as f64 + 1.0) + 88.0;
        let mut svg = Svg::file([LEFT + WIDTH + 30.0, height], 13.0);
        svg.text(
            [24.0, 32.0],
            "font-size='18' font-weight='bold'",
            &self.title,
        );
        let lines = self.lead.iter().flat_map(|line| wrapped(line));
        for (i, line) in lines.enumerate() {
            svg.text([24.0, 54.0 + 18.0 * i as f64], "fill='#444'", &line);
        }
        let errors = self.marks.iter().filter_map(|m| m.percentile_99_um);
        let limits = [self.tolerance_um, self.speckle_limited_error_um]
            .into_iter()
            .flatten();
        let axes = Axes {
            frame: [LEFT, TOP, WIDTH, HEIGHT],
            beyond: BEYOND,
            title: "",
            x: Axis::logarithmic(
                "frames a second on one core (faster →)",
                around(self.marks.iter().map(|m| 1e3 / m.ms[1])),
            ),
            y: Axis::logarithmic(
                "error of 99 in 100 heights, µm (← better)",
                around(errors.filter(|&um| um > 0.0).chain(limits)),
            ),
        };
        axes.draw(&mut svg);
        let [above, below] = [TOP + BEYOND[0] / 2.0, TOP + HEIGHT - BEYOND[1] / 2.0];
        let y = below - BEYOND[1] / 2.0;
        let dotted = "stroke='#999' stroke-dasharray='2 3'";
        svg.line([LEFT, y], [LEFT + WIDTH, y], dotted);
        svg.text([LEFT - 7.0, below + 4.5], END, "exact");
        self.limits(&mut svg, &axes);
        let place = |mark: &Mark| {
            let [x, y] = axes.at(1e3 / mark.ms[1], mark.percentile_99_um.unwrap_or(1.0));
            match mark.percentile_99_um {
                None => [x, above],
                Some(0.0) => [x, below],
                Some(_) => [x, y],
            }
        };
        let places: Vec<[f64; 2]> = self.marks.iter().map(place).collect();
        let pareto_optimal = self.marks.iter().filter(|m| m.pareto_optimal);
        let mut front: Vec<[f64; 2]> = pareto_optimal.map(place).collect();
        front.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let style = format!("stroke='{BLUE}' stroke-width='2' opacity='.5'");
        svg.polyline(front, &style);
        self.points(&mut svg, &axes, &places);
        self.table(&mut svg, table_top);
        svg.finish()
    }

    fn limits(&self, svg: &mut Svg, axes: &Axes) {
        let mut line = |um: Option<f64>, text: &str, color: &str| {
            let Some(um) = um else { return };
            let y = axes.at(1.0, um)[1];
            let style = format!("stroke='{color}' stroke-width='1.5' stroke-dasharray='7 4'");
            svg.line([LEFT, y], [LEFT + WIDTH, y], &style);
            let text = format!("{text} {} µm", short(um));
            svg.text([LEFT + 8.0, y - 5.0], &format!("fill='{color}'"), &text);
        };
        line(self.tolerance_um, "tolerance", ORANGE);
        let text = "height error due to speckle only:";
        line(self.speckle_limited_error_um, text, GREY);
    }

    fn points(&self, svg: &mut Svg, axes: &Axes, places: &[[f64; 2]]) {
        let mut taken = Vec::new();
        for (i, (mark, &place)) in self.marks.iter().zip(places).enumerate() {
            let color = color(mark).unwrap_or(GREY);
            let [slow, fast] = [mark.ms[2], mark.ms[0]].map(|ms| axes.at(1e3 / ms, 1.0)[0]);
            let stroke = format!("stroke='{color}'");
            svg.line([slow, place[1]], [fast, place[1]], &stroke);
            let fill = if mark.is_hollow { "#fff" } else { color };
            let radius = if mark.chosen { 8.0 } else { 5.0 };
            let style = format!("fill='{fill}' {stroke} stroke-width='1.6'");
            svg.group(&style, &mark.name, |svg| svg.circle(place, radius, ""));
            let [x, y] = free_place(place, places, &taken);
            taken.push([x, y]);
            svg.line(place, [x, y], &format!("{stroke} stroke-width='.5'"));
            let style = format!(
                "{MIDDLE} font-weight='bold' fill='{color}' stroke='#fff' stroke-width='3' \
                 paint-order='stroke'"
            );
            svg.text([x, y + 4.5], &style, &(i + 1).to_string());
        }
    }

    fn table(&self, svg: &mut Svg, top: f64) {
        let head = format!("{END} font-weight='bold' font-size='12'");
        for (titles, x) in COLUMNS {
            for (line, title) in titles.into_iter().enumerate() {
                svg.text([x, top - 15.0 * (1.0 - line as f64)], &head, title);
            }
        }
        for (i, mark) in self.marks.iter().enumerate() {
            let y = top + ROW * (i as f64 + 1.0);
            let bold = if mark.chosen {
                " font-weight='bold'"
            } else {
                ""
            };
            let color = format!("fill='{}'{bold}", color(mark).unwrap_or("#444"));
            let style = format!("{END} {color}");
            svg.text([42.0, y], &style, &(i + 1).to_string());
            let size = 12.0 * (NAME / mark.name.chars().count() as f64).min(1.0);
            let sized = format!("{color} font-size='{size:.1}'");
            svg.text([52.0, y], &sized, &mark.name);
            let or = |value: Option<f64>, none: &str| value.map_or(none.to_owned(), short);
            let cells = [
                short(mark.ms[1]),
                short(mark.speed_up),
                or(mark.ms_per_million, "–"),
                or(mark.memory_mb, "–"),
                or(mark.percentile_99_um, "lost"),
                short(mark.median_error_um),
                short(mark.half_width_68_um),
                short(100.0 * mark.lost),
                or(mark.scatter_um, "–"),
                or(mark.sigma_px, "–"),
                or(mark.contrast, "–"),
            ];
            for ((_, x), text) in COLUMNS.iter().zip(cells) {
                svg.text([*x, y], &style, &text);
            }
        }
        let y = top + ROW * (self.marks.len() as f64 + 1.0) + 8.0;
        let notes = [
            "Orange: chosen. Blue: none is both faster and more accurate. Green: another program.",
            "Hollow: speckle with other grains; its error is how far two draws differ, its scatter \
             how well it does.",
            "99 of 100, bias, noise, lost: heights against 1, point by point. Scatter: against \
             geometry, what the sensor itself would show.",
            "ms per million: samples, each a ray but on planes. MB: hierarchy, speckle, one \
             frame. Contrast: of columns' light along the line.",
        ];
        for (i, note) in notes.into_iter().enumerate() {
            let style = "fill='#666' font-size='11.5'";
            svg.text([24.0, y + 16.0 * i as f64], style, note);
        }
    }
}

/// Wraps a line at about 140 characters.
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

/// Returns a label position next to a mark that avoids other marks and labels.
fn free_place([x, y]: [f64; 2], marks: &[[f64; 2]], numbers: &[[f64; 2]]) -> [f64; 2] {
    let room = |&[px, py]: &[f64; 2]| {
        let gap = |others: &[[f64; 2]]| {
            let gaps = others.iter().map(|[ox, oy]| (ox - px).hypot(oy - py));
            gaps.fold(f64::INFINITY, f64::min)
        };
        let inside = (LEFT + 8.0..LEFT + WIDTH - 8.0).contains(&px)
            && (TOP + 6.0..TOP + HEIGHT - 6.0).contains(&py);
        (gap(marks).min(14.0) + gap(numbers).min(18.0)) * inside as u8 as f64
    };
    let around = (0..48).map(|i| {
        let (sin, cos) = ((i % 16) as f64 * std::f64::consts::TAU / 16.0 - 1.0).sin_cos();
        let away = 16.0 + 10.0 * (i / 16) as f64;
        [x + away * cos, y + away * sin]
    });
    let mut best = [x, y - 16.0];
    let mut most = room(&best);
    for place in around {
        if room(&place) > most + 0.5 {
            most = room(&place);
            best = place;
        }
    }
    best
}

//! HTML page of a comparison of a simulation with a recording.

use super::axes::{Axes, Axis, ChartPoint};
use super::chart::with_interval;
use super::picture::data_url;
use super::svg::Svg;
use askama::Template;

/// Statistic of both sides.
pub struct Row {
    pub name: &'static str,
    /// Value and 95 % interval.
    pub measured: [f64; 3],
    /// Value and 95 % interval.
    pub simulated: [f64; 3],
    pub differs: bool,
    /// Terms of sensor and surface that determine the statistic.
    pub terms: &'static str,
}

/// Picture of one side.
pub enum ComparedPicture {
    /// Heights of the middle profile, mm; NaN for missing ones.
    Profile(Vec<f64>),
    /// Image of the line as PNG, and its columns and rows.
    Image { png: Vec<u8>, size: [usize; 2] },
}

/// Contents of the page.
#[derive(Template)]
#[template(path = "compare.html")]
pub struct ComparePage {
    /// Path of the recorded map or image.
    pub recording: String,
    /// Definition of the statistics.
    pub definition: &'static str,
    /// Probability of a false difference, percent.
    pub level_percent: f64,
    pub rows: Vec<Row>,
    /// Measured and simulated side.
    pub views: [ComparedPicture; 2],
}

const CSS: &str = include_str!("page.css");
const COLORS: [&str; 2] = ["#2471a3", "#c0392b"];

impl ComparePage {
    /// Returns the page as one file with embedded plots and styles.
    pub fn html(&self) -> String {
        // The template calls no fallible functions, and writing to memory does not fail.
        self.render().expect("a page writes into memory")
    }

    /// Returns the names of the statistics that differ.
    fn lead(&self) -> String {
        let differ: Vec<&str> = self
            .rows
            .iter()
            .filter(|row| row.differs)
            .map(|row| row.name)
            .collect();
        match &differ[..] {
            [] => "No difference exceeds the sampling error.".to_owned(),
            names => format!(
                "Differences exceed the sampling error in: {}.",
                names.join(", ")
            ),
        }
    }

    /// Draws the values and 95 % intervals of one statistic.
    fn plot(&self, row: &Row) -> String {
        let mut svg = Svg::part([0.0, 0.0, 360.0, 150.0], "", row.name);
        let names = ["measured", "simulated"].map(str::to_owned);
        let both = [row.measured, row.simulated];
        let ends = both.iter().flatten().copied();
        let [low, high] = [ends.clone().fold(0.0, f64::min), ends.fold(0.0, f64::max)];
        let margin = 0.08 * (high - low).max(1e-12);
        let axes = Axes {
            frame: [90.0, 24.0, 250.0, 80.0],
            beyond: [0.0; 2],
            title: row.name,
            x: Axis::linear("", [low - margin, high + margin]),
            y: Axis::named("", &names),
        };
        axes.draw(&mut svg);
        for (i, ([value, low, high], color)) in both.into_iter().zip(COLORS).enumerate() {
            let [from, to] = [low, high].map(|x| axes.at(x, i as f64));
            svg.line(from, to, &format!("stroke='{color}' stroke-width='2'"));
            ChartPoint::Dot.draw(
                &mut svg,
                axes.at(value, i as f64),
                &format!("fill='{color}'"),
            );
        }
        svg.finish()
    }

    /// Draws one side.
    fn view(&self, index: usize) -> String {
        let side = ["Measured", "Simulated"][index];
        match &self.views[index] {
            ComparedPicture::Profile(heights) => {
                profile(&format!("{side}: middle profile"), heights, COLORS[index])
            }
            ComparedPicture::Image { png, size } => format!(
                "<figcaption>{side}: {} by {} pixels</figcaption><img alt='{side} image of the line' src='{}' width='560'>",
                size[0],
                size[1],
                data_url(png)
            ),
        }
    }
}

/// Draws a profile.
fn profile(name: &str, heights: &[f64], color: &str) -> String {
    let mut svg = Svg::part([0.0, 0.0, 560.0, 220.0], "", name);
    let valid = heights.iter().copied().filter(|height| height.is_finite());
    let [low, high] = [
        valid.clone().fold(f64::INFINITY, f64::min),
        valid.fold(f64::NEG_INFINITY, f64::max),
    ];
    let [low, high] = if low <= high { [low, high] } else { [0.0, 0.0] };
    let margin = 0.05 * (high - low).max(1e-6);
    let axes = Axes {
        frame: [86.0, 30.0, 454.0, 150.0],
        beyond: [0.0; 2],
        title: name,
        x: Axis::linear("column", [0.0, heights.len() as f64]),
        y: Axis::linear("height, mm", [low - margin, high + margin]),
    };
    axes.draw(&mut svg);
    let points = heights
        .iter()
        .enumerate()
        .map(|(x, &height)| (x as f64, height));
    let points: Vec<(f64, f64)> = points.collect();
    for run in points.split(|point| !point.1.is_finite()) {
        let style = format!("fill='none' stroke='{}' stroke-width='1'", color);
        axes.curve(&mut svg, run.iter().copied(), &style);
    }
    svg.finish()
}

/// Returns the table cells of a value and its interval.
pub(super) fn cells(values: [f64; 3]) -> String {
    let [value, low, high] = with_interval(values);
    format!("<td class=\"n\">{value}</td><td class=\"n\">{low} to {high}</td>")
}

mod filters {
    use crate::report::chart;
    use askama::{Result, Values, filter_fn};

    #[filter_fn]
    pub fn short(value: &f64, _: &dyn Values) -> Result<String> {
        Ok(chart::short(*value))
    }

    #[filter_fn]
    pub fn cells(values: &[f64; 3], _: &dyn Values) -> Result<String> {
        Ok(super::cells(*values))
    }
}

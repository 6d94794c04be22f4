//! `report.html`, a self-contained page with the results of a scan.

use super::chart::share_bar;
use super::color::Rgb;
use super::feature_plot::feature_picture;
use super::svg::Svg;
use super::viewer::Viewer;
use crate::inspect::coverage::{Fate, SurfaceCoverage};
use crate::inspect::deviation::DeviationStatistics;
use crate::inspect::features::{FeatureResult, Quantity};
use crate::inspect::flags::FlagCount;
use crate::inspect::tolerance::{AreaFractions, RegionVerdict, Verdict};
use askama::Template;

/// Contents of a report, in order.
#[derive(Template)]
#[template(path = "page.html")]
pub struct Report {
    /// Heading, the name of the scene.
    pub title: String,
    /// Summary of the result in a sentence.
    pub lead: String,
    /// Name and value.
    pub facts: Vec<(&'static str, String)>,
    /// 3D view; `None` if part and cloud are not shown in 3D.
    pub viewer: Option<Viewer>,
    /// Colour maps, for example of deviation and uncertainty; may be empty.
    pub maps: Vec<ColorMap>,
    /// Statistics of the valid points; `None` if there are no valid points.
    pub statistics: Option<DeviationStatistics>,
    /// Caption and SVG.
    pub histograms: Vec<(String, String)>,
    /// Verdicts per tolerance region; empty without tolerances.
    pub tolerance: Vec<RegionVerdict>,
    /// Values and verdicts of the features; empty without features.
    pub features: Vec<FeatureResult>,
    /// Flags that occur, with their counts.
    pub flags: Vec<FlagCount>,
    /// Coverage of the part's surface; `None` if it was not requested.
    pub coverage: Option<SurfaceCoverage>,
    /// Caption and SVG.
    pub setup: Vec<(&'static str, String)>,
    /// Images of frames; may be empty.
    pub frames: Vec<SampleFrame>,
    /// Rows of the plan: effect, modelled, method, reason, and an optional column.
    pub plan: Vec<[String; 5]>,
    /// Statement of the plan on the tolerance of the scene.
    pub accuracy: Option<String>,
    /// Name and path of files in the same folder.
    pub files: Vec<(&'static str, &'static str)>,
    /// Data of the run: name and value.
    pub run: Vec<(&'static str, String)>,
}

/// A quantity shown as colours on the part.
pub struct ColorMap {
    /// Heading.
    pub title: &'static str,
    /// Colour bar, SVG.
    pub bar: String,
    /// Label of the colour bar.
    pub legend: &'static str,
    /// Caption and PNG.
    pub views: Vec<(&'static str, Vec<u8>)>,
}

/// A frame of the scan with the extracted line.
pub struct SampleFrame {
    /// Index of the frame.
    pub number: u32,
    /// Reason for the selection of the frame.
    pub why: &'static str,
    /// The image as a PNG file.
    pub png: Vec<u8>,
    /// Image width, px.
    pub width: u32,
    /// Image height, px.
    pub height: u32,
    /// Line positions (column, row), px.
    pub line: Vec<(f64, f64)>,
}

const CSS: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("viewer.js");

impl Report {
    /// Returns the report as one file with embedded images, styles and script.
    pub fn html(&self) -> String {
        // The template calls no fallible functions, and writing to memory does not fail.
        self.render().expect("a page writes into memory")
    }

    /// Returns the number of columns of the plan's table. The last is present if any effect has a
    /// value for it.
    fn plan_columns(&self) -> usize {
        match self.plan.iter().any(|row| !row[4].is_empty()) {
            true => 5,
            false => 4,
        }
    }
}

mod filters {
    use super::{Fate, explained, of_fate};
    use crate::report::{chart, color, picture};
    use askama::{Result, Values, filter_fn};

    #[filter_fn]
    pub fn short(value: &f64, _: &dyn Values) -> Result<String> {
        Ok(chart::short(*value))
    }

    #[filter_fn]
    pub fn data_url(png: &[u8], _: &dyn Values) -> Result<String> {
        Ok(picture::data_url(png))
    }

    #[filter_fn]
    pub fn fate_colour(fate: &Fate, _: &dyn Values) -> Result<String> {
        Ok(color::css(of_fate(*fate)))
    }

    #[filter_fn]
    pub fn percent(fraction: &f64, _: &dyn Values) -> Result<String> {
        Ok(format!("{:.1} %", 100.0 * fraction))
    }

    #[filter_fn]
    pub fn fate_name(fate: &Fate, _: &dyn Values) -> Result<&'static str> {
        Ok(explained(*fate).0)
    }

    #[filter_fn]
    pub fn fate_meaning(fate: &Fate, _: &dyn Values) -> Result<&'static str> {
        Ok(explained(*fate).1)
    }
}

/// Returns the colour of a coverage class.
pub fn of_fate(fate: Fate) -> Rgb {
    match fate {
        Fate::Measured => [27, 158, 119],
        Fate::WeakSignal => [230, 171, 2],
        Fate::HiddenFromCamera => [117, 112, 179],
        Fate::HiddenFromLaser => [120, 120, 120],
        Fate::OutsideScan => [205, 205, 205],
    }
}

/// Returns the colour of a verdict; `None` means that a point has no verdict.
pub fn of_verdict(verdict: Option<Verdict>) -> Rgb {
    match verdict {
        Some(Verdict::Pass) => [0, 114, 178],
        Some(Verdict::Fail) => [213, 94, 0],
        Some(Verdict::Unsure) => [240, 228, 66],
        None => [205, 205, 205],
    }
}

/// Returns the cells of a value: quantity, unit, nominal and measured value, deviation, expanded
/// uncertainty, tolerance, verdict, U/T, smallest tolerance and budget.
fn feature_cells(value: &Quantity) -> [String; 11] {
    let (name, unit) = value.name.rsplit_once('_').unwrap_or((value.name, ""));
    let number = |x: f64| format!("{x:.4}");
    let limits = value.tolerance;
    let sources = value.sources.iter();
    let sources = sources.map(|s| format!("{} {:.5}", s.name, s.standard_uncertainty));
    [
        name.to_owned(),
        unit.to_owned(),
        number(value.nominal),
        number(value.measured),
        format!("{:+.4}", value.deviation),
        number(value.expanded_uncertainty),
        limits.map_or("–".to_owned(), |[a, b]| format!("{a} to {b}")),
        value
            .conformance
            .map_or("–", |verdict| verdict.text())
            .to_owned(),
        value
            .u_over_t
            .map_or("–".to_owned(), |ratio| format!("{ratio:.2}")),
        number(value.smallest_tolerance),
        sources.collect::<Vec<_>>().join(", "),
    ]
}

/// Returns a bar of the area fractions of a region.
fn area_bar(name: &str, area: &AreaFractions) -> String {
    let parts = [
        ("within", area.within, Verdict::Pass),
        ("across", area.across, Verdict::Unsure),
        ("beyond", area.beyond, Verdict::Fail),
    ];
    let parts = parts.map(|(name, part, verdict)| (name, part, of_verdict(Some(verdict))));
    share_bar(&format!("area of {name}"), &parts)
}

/// Returns the name and the explanation of a coverage class.
fn explained(fate: Fate) -> (&'static str, &'static str) {
    match fate {
        Fate::Measured => ("measured", "a valid point lies within two point spacings"),
        Fate::WeakSignal => (
            "weak signal",
            "lit and in view, but without a valid point: too dark, saturated, or at grazing light",
        ),
        Fate::HiddenFromCamera => (
            "hidden from the camera",
            "lit, but behind something or facing away from the camera",
        ),
        Fate::HiddenFromLaser => (
            "hidden from the laser",
            "behind something or facing away from the laser",
        ),
        Fate::OutsideScan => (
            "outside the scan",
            "the laser plane passed it outside the fan or the sensor, or never",
        ),
    }
}

/// Returns a bar of the coverage of the surface.
fn shares(coverage: &SurfaceCoverage) -> String {
    let shares = coverage.shares.iter();
    let parts: Vec<(&str, f64, Rgb)> = shares
        .map(|&(fate, share)| (explained(fate).0, share, of_fate(fate)))
        .collect();
    share_bar("coverage of the CAD surface", &parts)
}

impl SampleFrame {
    /// Draws the frame and the line. The line is interrupted where columns are missing or the row
    /// jumps.
    fn svg(&self) -> String {
        let view = [0.0, 0.0, self.width.into(), self.height.into()];
        let mut svg = Svg::part(view, "", &format!("sensor frame {}", self.number));
        svg.image(view, &self.png);
        let joined = |a: &(f64, f64), b: &(f64, f64)| b.0 - a.0 <= 1.5 && (b.1 - a.1).abs() <= 5.0;
        for run in self.line.chunk_by(joined) {
            svg.polyline(run.iter().map(|&(x, y)| [x, y]), "stroke='#00c8ff'");
        }
        svg.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_stands_alone_and_escapes_what_it_is_given() {
        let report = Report {
            title: "a <b> & c".into(),
            lead: "5 < 6".into(),
            facts: vec![("scene", "x<y>.toml".into())],
            viewer: None,
            maps: vec![],
            statistics: None,
            histograms: vec![],
            tolerance: vec![],
            features: vec![],
            flags: vec![],
            coverage: None,
            setup: vec![],
            frames: vec![SampleFrame {
                number: 3,
                why: "some",
                png: vec![1, 2, 3],
                width: 10,
                height: 5,
                line: vec![(0.5, 1.0), (1.5, 1.2), (4.5, 1.0)],
            }],
            plan: vec![],
            accuracy: None,
            files: vec![("scene", "scene.toml")],
            run: vec![],
        };
        let html = report.html();
        assert!(html.contains("a &#60;b&#62; &#38; c") && html.contains("x&#60;y&#62;.toml"));
        assert_eq!(
            html.matches("<polyline").count(),
            2,
            "a gap breaks the line"
        );
        assert!(html.contains("<a href=\"scene.toml\">scene</a>"));
        assert!(!html.contains("http"), "nothing is loaded from elsewhere");
    }
}

//! `report.html`: one page that stands alone, for people who would rather look
//! than read.

use super::chart::{share_bar, short};
use super::color::{Rgb, css};
use super::picture::data_url;
use super::svg::Svg;
use super::viewer::Viewer;
use crate::inspect::coverage::{Fate, SurfaceCoverage};
use crate::inspect::deviation::DeviationStatistics;
use crate::inspect::flags::FlagCount;
use std::fmt::Write;

/// What a report shows, in its order.
pub struct Report {
    /// Heading, the scene's name.
    pub title: String,
    /// The result in a sentence.
    pub lead: String,
    /// Name and value.
    pub facts: Vec<(&'static str, String)>,
    /// `None`: the part and the cloud are not shown in 3D.
    pub viewer: Option<Viewer>,
    /// Of deviation, uncertainty and the like; may be empty.
    pub maps: Vec<ColorMap>,
    /// Of valid points; `None` if there is none.
    pub statistics: Option<DeviationStatistics>,
    /// Caption and SVG.
    pub histograms: Vec<(String, String)>,
    /// Those that some point carries.
    pub flags: Vec<FlagCount>,
    /// What became of the part's surface; `None` if nobody asked for it.
    pub coverage: Option<SurfaceCoverage>,
    /// Caption and SVG.
    pub setup: Vec<(&'static str, String)>,
    /// Pictures of frames; may be empty.
    pub frames: Vec<SampleFrame>,
    /// Effect, modelled, method, reason.
    pub plan: Vec<[String; 6]>,
    /// What the plan says of the scene's tolerance.
    pub accuracy: Option<String>,
    /// What the run was: name and value.
    pub run: Vec<(&'static str, String)>,
}

/// A quantity as colours on the part.
pub struct ColorMap {
    /// Heading.
    pub title: &'static str,
    /// SVG.
    pub bar: String,
    /// What stands at the bar.
    pub legend: &'static str,
    /// Caption and PNG.
    pub views: Vec<(&'static str, Vec<u8>)>,
}

/// A frame of the scan with the line that was extracted from it.
pub struct SampleFrame {
    /// Number of the frame.
    pub number: u32,
    /// Why it is shown, in words.
    pub why: &'static str,
    /// The image as a PNG file.
    pub png: Vec<u8>,
    /// Of the image, px.
    pub width: u32,
    /// Of the image, px.
    pub height: u32,
    /// (column, row) in pixels.
    pub line: Vec<(f64, f64)>,
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

impl Report {
    /// One file: pictures, styles and script are in it.
    pub fn html(&self) -> String {
        let title = escape(&self.title);
        let mut html = format!(
            "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width\">\
             <title>{title}</title><style>{}</style></head><body><h1>{title}</h1>\
             <p class=\"lead\">{}</p>",
            include_str!("page.css"),
            escape(&self.lead)
        );
        html.push_str("<div class=\"facts\">");
        for (name, value) in &self.facts {
            let _ = write!(html, "<div><b>{name}</b>{}</div>", escape(value));
        }
        html.push_str("</div>");
        if let Some(viewer) = &self.viewer {
            viewer.figure(&mut html);
        }
        for map in &self.maps {
            map.section(&mut html);
        }
        self.distribution(&mut html);
        self.flag_table(&mut html);
        if let Some(coverage) = &self.coverage {
            coverage_section(coverage, &mut html);
        }
        html.push_str("<h2>Sensor and part</h2>");
        figures(
            &mut html,
            "wide",
            self.setup.iter().map(|(c, svg)| (*c, svg.as_str())),
        );
        html.push_str(
            "<p>Red: laser. Blue: the camera's field of view. Green: where it meets the laser \
             plane. Dashed: the laser's path.</p>",
        );
        self.frame_section(&mut html);
        self.plan_table(&mut html);
        table(&mut html, "The run", &self.run);
        html.push_str("</body></html>\n");
        html
    }

    fn distribution(&self, html: &mut String) {
        html.push_str("<h2>Distribution</h2>");
        let Some(s) = &self.statistics else {
            html.push_str("<p>No valid point, so nothing to show.</p>");
            return;
        };
        let histograms = self.histograms.iter();
        figures(
            html,
            "wide",
            histograms.map(|(c, svg)| (c.as_str(), svg.as_str())),
        );
        let _ = write!(
            html,
            "<table><tr><th>points</th><td>{}</td></tr>\
             <tr><th>mean</th><td>{} µm</td></tr><tr><th>standard deviation</th><td>{} µm</td></tr>\
             <tr><th>smallest, largest</th><td>{} µm, {} µm</td></tr><tr><th>percentiles</th><td>",
            s.points,
            short(s.mean_um),
            short(s.std_um),
            short(s.min_um),
            short(s.max_um)
        );
        for (percent, value) in &s.percentiles_um {
            let _ = write!(html, "{percent} %: {} µm &ensp; ", short(*value));
        }
        html.push_str("</td></tr></table>");
    }

    fn flag_table(&self, html: &mut String) {
        html.push_str("<h2>Flags</h2><table><tr><th>flag</th><th>points</th><th>meaning</th></tr>");
        for flag in &self.flags {
            let _ = write!(
                html,
                "<tr><td>{}</td><td class=\"n\">{}</td><td>{}</td></tr>",
                flag.name, flag.points, flag.meaning
            );
        }
        html.push_str("</table>");
    }

    fn frame_section(&self, html: &mut String) {
        if self.frames.is_empty() {
            return;
        }
        html.push_str(
            "<h2>Sensor frames</h2><input type=\"checkbox\" id=\"line\" checked>\
             <label for=\"line\"> extracted line</label><div class=\"frames\">",
        );
        for frame in &self.frames {
            frame.figure(html);
        }
        html.push_str("</div>");
    }

    fn plan_table(&self, html: &mut String) {
        html.push_str(
            "<h2>What was modelled</h2>\
             <table class=\"plan\"><tr><th>effect</th><th>modelled</th><th>how</th><th>why</th>",
        );
        // Only a plan for a tolerance has these numbers.
        let numbers = self.plan.iter().any(|row| row[4..] != ["", ""]);
        if numbers {
            html.push_str("<th>moves height by, µm</th><th>costs, ms a frame</th>");
        }
        html.push_str("</tr>");
        for row in &self.plan {
            html.push_str("<tr>");
            for cell in &row[..if numbers { 6 } else { 4 }] {
                let _ = write!(html, "<td>{}</td>", escape(cell));
            }
            html.push_str("</tr>");
        }
        html.push_str("</table>");
        if let Some(accuracy) = &self.accuracy {
            let _ = write!(html, "<p>{}</p>", escape(accuracy));
        }
    }
}

fn figures<'a>(html: &mut String, class: &str, content: impl Iterator<Item = (&'a str, &'a str)>) {
    let _ = write!(html, "<div class=\"views {class}\">");
    for (caption, svg) in content {
        let _ = write!(
            html,
            "<figure>{svg}<figcaption>{}</figcaption></figure>",
            escape(caption)
        );
    }
    html.push_str("</div>");
}

fn table(html: &mut String, title: &str, rows: &[(&str, String)]) {
    let _ = write!(html, "<h2>{title}</h2><table>");
    for (name, value) in rows {
        let _ = write!(html, "<tr><th>{name}</th><td>{}</td></tr>", escape(value));
    }
    html.push_str("</table>");
}

impl ColorMap {
    fn section(&self, html: &mut String) {
        let _ = write!(
            html,
            "<h2>{}</h2>{}<p>{}</p>",
            self.title, self.bar, self.legend
        );
        html.push_str("<div class=\"views\">");
        for (caption, png) in &self.views {
            let _ = write!(
                html,
                "<figure><img alt=\"{caption}\" src=\"{}\"><figcaption>{caption}</figcaption></figure>",
                data_url(png)
            );
        }
        html.push_str("</div>");
    }
}

/// The colour of a fate.
pub fn of_fate(fate: Fate) -> Rgb {
    match fate {
        Fate::Measured => [27, 158, 119],
        Fate::WeakSignal => [230, 171, 2],
        Fate::HiddenFromCamera => [117, 112, 179],
        Fate::HiddenFromLaser => [120, 120, 120],
        Fate::OutsideScan => [205, 205, 205],
    }
}

/// What a fate is called, and what it means.
fn explained(fate: Fate) -> (&'static str, &'static str) {
    match fate {
        Fate::Measured => ("measured", "a point lies within two point spacings"),
        Fate::WeakSignal => (
            "weak signal",
            "lit and in view, but no line was found: too dark, or at grazing light",
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

fn coverage_section(coverage: &SurfaceCoverage, html: &mut String) {
    let parts: Vec<(&str, f64, Rgb)> = coverage
        .shares
        .iter()
        .map(|&(fate, share)| (explained(fate).0, share, of_fate(fate)))
        .collect();
    let _ = write!(
        html,
        "<h2>Coverage of the CAD surface</h2>{}\
         <table><tr><th>area</th><th>mm²</th><th>%</th><th>meaning</th></tr>",
        share_bar("coverage of the CAD surface", &parts)
    );
    for &(fate, share) in &coverage.shares {
        let (name, meaning) = explained(fate);
        let _ = write!(
            html,
            "<tr><td><span class=\"key\" style=\"background:{}\"></span>{name}</td>\
             <td class=\"n\">{}</td><td class=\"n\">{}</td><td>{meaning}</td></tr>",
            css(of_fate(fate)),
            short(share * coverage.area_mm2),
            short(100.0 * share)
        );
    }
    let density = coverage.points_per_mm2.map_or(String::new(), |density| {
        format!(
            " Where it was measured it has {} points per mm².",
            short(density)
        )
    });
    let _ = write!(
        html,
        "</table><p>From {} places spread evenly over the whole mesh, its inside faces too.\
         {density}</p>",
        coverage.samples
    );
}

impl SampleFrame {
    /// The frame with the line over it; breaks in the line where columns are
    /// missing or the row jumps.
    fn figure(&self, html: &mut String) {
        let view = [0.0, 0.0, self.width.into(), self.height.into()];
        let mut svg = Svg::part(view, "", &format!("sensor frame {}", self.number));
        svg.image(view, &self.png);
        let joined = |a: &(f64, f64), b: &(f64, f64)| b.0 - a.0 <= 1.5 && (b.1 - a.1).abs() <= 5.0;
        for run in self.line.chunk_by(joined) {
            svg.polyline(run.iter().map(|&(x, y)| [x, y]), "stroke='#00c8ff'");
        }
        let _ = write!(
            html,
            "<figure class=\"frame\">{}<figcaption>Frame {}, {}: counts, brightened (gamma 2.2), with the extracted \
             line in blue.</figcaption></figure>",
            svg.finish(),
            self.number,
            self.why
        );
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
            run: vec![],
        };
        let html = report.html();
        assert!(html.contains("a &lt;b&gt; &amp; c") && html.contains("x&lt;y&gt;.toml"));
        assert_eq!(
            html.matches("<polyline").count(),
            2,
            "a gap breaks the line"
        );
        assert!(!html.contains("http"), "nothing is loaded from elsewhere");
    }
}

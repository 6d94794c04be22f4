//! `report.html`: one page that stands alone, for people who would rather look
//! than read.

use super::chart::{color_bar, deviation_histogram, short};
use super::deviation::DeviationStatistics;
use base64::Engine;
use std::fmt::Write;

/// What a report shows.
pub struct Report<'a> {
    pub title: &'a str,
    /// Rows of the table of facts.
    pub facts: Vec<(&'a str, String)>,
    pub frame: Option<SampleFrame>,
    /// Caption and PNG of each view of the cloud.
    pub views: Vec<(&'a str, Vec<u8>)>,
    /// Deviation (µm) at which the colours of the views end.
    pub color_limit_um: f64,
    pub deviations_um: Vec<f64>,
    pub statistics: Option<DeviationStatistics>,
    /// Effect, modelled, method, reason.
    pub plan: Vec<[String; 4]>,
}

/// A frame of the scan with the line that was extracted from it.
pub struct SampleFrame {
    pub number: u32,
    pub png: Vec<u8>,
    pub width: u32,
    pub height: u32,
    /// (column, row) in pixels.
    pub line: Vec<(f64, f64)>,
}

const STYLE: &str = "\
body{font:15px/1.5 system-ui,sans-serif;color:#222;max-width:1080px;margin:2rem auto;padding:0 1rem}\
h1{font-size:1.6rem;margin-bottom:.2rem}h2{font-size:1.15rem;margin-top:2rem;border-bottom:1px solid #ccc}\
table{border-collapse:collapse}td,th{padding:.2rem .8rem .2rem 0;text-align:left;vertical-align:top}\
th{font-weight:600}.views{display:flex;gap:1rem;flex-wrap:wrap}figure{margin:.5rem 0;flex:1 1 30rem}\
img,svg{width:100%;height:auto}svg text{font-size:12px;fill:#333}.bar{max-width:26rem}\
figcaption{color:#555}.frame image{image-rendering:pixelated}\
#line:not(:checked)~figure polyline{display:none}\
@media print{body{max-width:none;margin:0}h2{break-after:avoid}figure{break-inside:avoid}}";

fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

fn data_url(png: &[u8]) -> String {
    let base64 = base64::engine::general_purpose::STANDARD.encode(png);
    format!("data:image/png;base64,{base64}")
}

impl Report<'_> {
    pub fn html(&self) -> String {
        let title = escape(self.title);
        let mut html = format!(
            "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width\">\
             <title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>"
        );
        self.facts_table(&mut html);
        self.deviation(&mut html);
        if let Some(frame) = &self.frame {
            frame.figure(&mut html);
        }
        self.plan_table(&mut html);
        html.push_str("</body></html>\n");
        html
    }

    fn facts_table(&self, html: &mut String) {
        html.push_str("<table>");
        for (name, value) in &self.facts {
            let _ = write!(
                html,
                "<tr><th>{}</th><td>{}</td></tr>",
                escape(name),
                escape(value)
            );
        }
        html.push_str("</table>");
    }

    fn deviation(&self, html: &mut String) {
        html.push_str("<h2>Deviation from the CAD surface</h2>");
        let Some(statistics) = &self.statistics else {
            html.push_str("<p>No point was measured: no line was found in any frame.</p>");
            return;
        };
        html.push_str("<div class=\"views\">");
        for (caption, png) in &self.views {
            let _ = write!(
                html,
                "<figure><img alt=\"{0}\" src=\"{1}\"><figcaption>{0}</figcaption></figure>",
                escape(caption),
                data_url(png)
            );
        }
        let _ = write!(html, "</div>{}", color_bar(self.color_limit_um));
        html.push_str(&deviation_histogram(
            &self.deviations_um,
            self.color_limit_um,
        ));
        let s = statistics;
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

    fn plan_table(&self, html: &mut String) {
        html.push_str(
            "<h2>What was modelled</h2>\
             <table><tr><th>effect</th><th>modelled</th><th>how</th><th>why</th></tr>",
        );
        for row in &self.plan {
            html.push_str("<tr>");
            for cell in row {
                let _ = write!(html, "<td>{}</td>", escape(cell));
            }
            html.push_str("</tr>");
        }
        html.push_str("</table>");
    }
}

impl SampleFrame {
    /// The frame with the line over it; breaks in the line where columns are
    /// missing or the row jumps.
    fn figure(&self, html: &mut String) {
        let _ = write!(
            html,
            "<h2>Frame {}</h2><input type=\"checkbox\" id=\"line\" checked>\
             <label for=\"line\"> extracted line</label><figure class=\"frame\">\
             <svg viewBox=\"0 0 {w} {h}\" role=\"img\" aria-label=\"sensor frame\">\
             <image href=\"{}\" width=\"{w}\" height=\"{h}\"/>",
            self.number,
            data_url(&self.png),
            w = self.width,
            h = self.height
        );
        let joined = |a: &(f64, f64), b: &(f64, f64)| b.0 - a.0 <= 1.5 && (b.1 - a.1).abs() <= 5.0;
        for run in self.line.chunk_by(joined) {
            html.push_str(
                "<polyline fill=\"none\" stroke=\"#00c8ff\" stroke-width=\"1\" points=\"",
            );
            for (column, row) in run {
                let _ = write!(html, "{column:.1},{row:.2} ");
            }
            html.push_str("\"/>");
        }
        html.push_str(
            "</svg><figcaption>Counts, brightened (gamma 2.2), with the extracted line in blue.\
             </figcaption></figure>",
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_stands_alone_and_escapes_what_it_is_given() {
        let report = Report {
            title: "a <b> & c",
            facts: vec![("scene", "x<y>.toml".into())],
            frame: Some(SampleFrame {
                number: 3,
                png: vec![1, 2, 3],
                width: 10,
                height: 5,
                line: vec![(0.5, 1.0), (1.5, 1.2), (4.5, 1.0)],
            }),
            views: vec![],
            color_limit_um: 1.0,
            deviations_um: vec![],
            statistics: None,
            plan: vec![],
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

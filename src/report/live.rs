//! HTML page of the live view.

use super::viewer::Viewer;
use askama::Template;

/// Script of the page.
pub const SCRIPT: &str = include_str!("live.js");
/// Script of the 3D view, shared with the report.
pub const VIEWER: &str = include_str!("viewer.js");
/// Style sheet of the page.
pub const STYLE: &str = include_str!("live.css");

/// Page of the live view; its script requests the remaining data.
#[derive(Template)]
#[template(path = "live.html")]
pub struct LivePage {
    /// Name of the scene file.
    pub title: String,
    /// Description of the part.
    pub part: String,
    /// Sliders in display order.
    pub sliders: Vec<Slider>,
    /// 3D view of the part.
    pub viewer: Viewer,
}

/// A value that can be changed with a slider.
#[derive(Debug, Clone)]
pub struct Slider {
    /// Name of the query parameter.
    pub key: &'static str,
    /// Label on the page.
    pub label: &'static str,
    /// Value of the scene.
    pub start: f64,
    /// Limits of the slider; typed values may be outside.
    pub ends: [f64; 2],
    /// True if equal distances on the slider are equal ratios.
    pub ratios: bool,
}

impl LivePage {
    /// Returns the page.
    pub fn html(&self) -> String {
        // The template calls no fallible functions, and writing to memory does not fail.
        self.render().expect("a page writes into memory")
    }
}

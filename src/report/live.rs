//! The page of the live view.

use super::viewer::Viewer;
use askama::Template;

/// What the page asks for and shows.
pub const SCRIPT: &str = include_str!("live.js");
/// Its 3D view, the report's.
pub const VIEWER: &str = include_str!("viewer.js");
/// How it looks.
pub const STYLE: &str = include_str!("live.css");

/// The page; the rest comes with what it asks for.
#[derive(Template)]
#[template(path = "live.html")]
pub struct LivePage {
    /// The scene file.
    pub title: String,
    /// The part in words.
    pub part: String,
    /// In their order.
    pub sliders: Vec<Slider>,
    /// The part in 3D.
    pub viewer: Viewer,
}

/// A value that may be dragged.
#[derive(Debug, Clone)]
pub struct Slider {
    /// Its name in what the page asks.
    pub key: &'static str,
    /// What the page calls it.
    pub label: &'static str,
    /// What the scene has.
    pub start: f64,
    /// Least and greatest of the slider; what is typed may lie beyond.
    pub ends: [f64; 2],
    /// Whether equal ways of the slider are equal ratios.
    pub ratios: bool,
}

impl LivePage {
    /// The whole page.
    pub fn html(&self) -> String {
        // The template calls nothing that fails, and memory has no limit here.
        self.render().expect("a page writes into memory")
    }
}

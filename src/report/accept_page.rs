//! HTML page of an acceptance test.

use super::accept_plot::characteristic_plot;
use crate::inspect::acceptance::{Characteristic, Decision};
use askama::Template;

/// Contents of the page, in order.
#[derive(Template)]
#[template(path = "accept.html")]
pub struct AcceptPage<'a> {
    /// Purpose and limits of the test.
    pub nature: &'a str,
    /// Decision rule.
    pub rule: &'a str,
    /// Name and value.
    pub facts: Vec<(&'static str, String)>,
    /// Warnings; may be empty.
    pub warnings: &'a [String],
    /// Drawing of the artefact positions, SVG.
    pub positions: String,
    /// Results.
    pub characteristics: &'a [Characteristic],
}

const CSS: &str = include_str!("page.css");

impl AcceptPage<'_> {
    /// Returns the page as one file with embedded images and styles.
    pub fn html(&self) -> String {
        // The template calls no fallible functions, and writing to memory does not fail.
        self.render().expect("a page writes into memory")
    }

    /// Returns a sentence with the number of characteristics that conform.
    fn lead(&self) -> String {
        let count = |decision| {
            let same = self
                .characteristics
                .iter()
                .filter(|c| c.decision == decision);
            same.count()
        };
        format!(
            "{} of {} characteristics conform, {} do not, {} are undecided, {} have no limit, {} were not measured.",
            count(Decision::Conforms),
            self.characteristics.len(),
            count(Decision::DoesNotConform),
            count(Decision::Undecided),
            count(Decision::NoLimit),
            count(Decision::NotMeasured)
        )
    }
}

mod filters {
    use crate::report::chart;
    use askama::{Result, Values, filter_fn};

    #[filter_fn]
    pub fn short(value: &f64, _: &dyn Values) -> Result<String> {
        Ok(chart::short(*value))
    }
}

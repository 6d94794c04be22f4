//! The page of an acceptance test.

use super::accept_plot::characteristic_plot;
use crate::inspect::acceptance::{Characteristic, Decision};
use askama::Template;

/// What the page shows, in its order.
#[derive(Template)]
#[template(path = "accept.html")]
pub struct AcceptPage<'a> {
    /// What the test is and is not.
    pub nature: &'a str,
    /// How it decides.
    pub rule: &'a str,
    /// Name and value.
    pub facts: Vec<(&'static str, String)>,
    /// May be empty.
    pub warnings: &'a [String],
    /// Where artefacts stand, SVG.
    pub positions: String,
    /// What was found.
    pub characteristics: &'a [Characteristic],
}

const CSS: &str = include_str!("page.css");

impl AcceptPage<'_> {
    /// One file: pictures and styles are in it.
    pub fn html(&self) -> String {
        // The template calls nothing that fails, and memory has no limit here.
        self.render().expect("a page writes into memory")
    }

    /// How many conform, of how many.
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

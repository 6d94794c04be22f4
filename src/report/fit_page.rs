//! HTML page of a fit of a sensor model to recordings.

use askama::Template;

/// Fitted value.
pub struct ValueRow {
    pub name: &'static str,
    /// Dotted key, or a dash.
    pub key: &'static str,
    pub unit: &'static str,
    /// Value and 95 % interval.
    pub value: [f64; 3],
    /// Path of the recorded file.
    pub source: String,
}

/// Statistic of the fitted half, of the other half, and as predicted.
pub struct StatisticRow {
    pub name: &'static str,
    pub values: [Option<f64>; 3],
}

/// Contents of the page.
#[derive(Template)]
#[template(path = "fit.html")]
pub struct FitPage<'a> {
    pub values: Vec<ValueRow>,
    pub statistics: Vec<StatisticRow>,
    pub misfits: &'a [String],
    pub inseparable: &'a [String],
}

const CSS: &str = include_str!("page.css");

impl FitPage<'_> {
    /// Returns the page as one file with embedded styles.
    pub fn html(&self) -> String {
        // The template calls no fallible functions, and writing to memory does not fail.
        self.render().expect("a page writes into memory")
    }

    fn lead(&self) -> String {
        match self.misfits {
            [] => format!(
                "The data determine {} values and do not contradict the model.",
                self.values.len()
            ),
            misfits => format!("Misfit: {}", misfits.join(" ")),
        }
    }
}

mod filters {
    use crate::report::{chart, compare_page};
    use askama::{Result, Values, filter_fn};

    #[filter_fn]
    pub fn cells(values: &[f64; 3], _: &dyn Values) -> Result<String> {
        Ok(compare_page::cells(*values))
    }

    #[filter_fn]
    pub fn cell(value: &Option<f64>, _: &dyn Values) -> Result<String> {
        Ok(value.map_or("–".to_owned(), chart::short))
    }
}

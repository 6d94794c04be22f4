//! Table of a sweep, and plots of its figures.

use super::places::SweepRuns;
use super::record::{RunOutcome, RunRecord};
use crate::error::{Error, Result};
use crate::report::sweep_plot::{SweepCurve, SweepPanel, sweep_plot};
use crate::run::files;
use crate::run::recipe::{Values, one_number};
use crate::run::shards::unfinished;
use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use toml::Value;

/// A plot: a figure over a key that varies, or over another figure.
#[derive(Debug, Clone)]
pub struct Plot {
    /// Name of a figure.
    pub figure: String,
    /// Name of a key or of a figure.
    pub over: String,
}

/// Figures that are plotted by default, and the titles of their axes.
const DEFAULT: [(&str, &str); 4] = [
    ("deviation.std_um", "standard deviation from the CAD, µm"),
    (
        "uncertainty.median_sigma_um",
        "median stated uncertainty, µm",
    ),
    ("valid_fraction", "fraction of points that are valid"),
    (
        "coverage.shares.measured",
        "fraction of the surface measured",
    ),
];
/// Maximum number of default plots.
const MOST_DEFAULT: usize = 12;

fn title_of(figure: &str) -> &str {
    let found = DEFAULT.iter().find(|(name, _)| *name == figure);
    found.map_or(figure, |(_, words)| words)
}

/// A run with its values.
pub struct SweepRow<'a> {
    values: Values,
    record: &'a RunRecord,
}

pub fn rows<'a>(places: &SweepRuns, records: &[&'a RunRecord]) -> Vec<SweepRow<'a>> {
    let row = |record: &&'a RunRecord| SweepRow {
        values: places.values(record.place),
        record,
    };
    records.iter().map(row).collect()
}

/// Returns the names of all figures in the rows.
fn names<'a>(rows: &'a [SweepRow]) -> BTreeSet<&'a str> {
    let all = rows.iter().flat_map(|row| row.record.figures.keys());
    all.map(String::as_str).collect()
}

fn written(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

/// Writes one line per run: its number, values, result, figures and message.
pub fn write_csv(path: &Path, places: &SweepRuns, rows: &[SweepRow]) -> Result<()> {
    let (keys, names) = (places.keys(), names(rows));
    let failed = |error: csv::Error| Error::io("write", path)(error.into());
    files::write_in_steps(path, &unfinished(), |file| {
        let mut out = csv::Writer::from_writer(file);
        let head = ["run"].into_iter().chain(keys.iter().copied());
        let head = head.chain(["result"]).chain(names.iter().copied());
        out.write_record(head.chain(["message"])).map_err(failed)?;
        for row in rows {
            let mut line = vec![row.record.place.to_string()];
            line.extend(keys.iter().map(|key| written(&row.values[*key])));
            let result = match row.record.outcome {
                RunOutcome::Good => "ok",
                RunOutcome::Warned => "warning",
                RunOutcome::Refused => "error",
            };
            line.push(result.to_owned());
            let figure = |name: &&str| row.record.figures.get(*name);
            line.extend(
                names
                    .iter()
                    .map(|name| figure(name).map_or(String::new(), f64::to_string)),
            );
            line.push(row.record.message.clone());
            out.write_record(line).map_err(failed)?;
        }
        out.flush().map_err(Error::io("write", path))
    })
}

/// Writes the plots, or default plots if `plots` is empty; `None` if there is nothing to plot.
pub fn write_plots(
    path: &Path,
    places: &SweepRuns,
    rows: &[SweepRow],
    plots: &[Plot],
) -> Result<Option<PathBuf>> {
    let names = names(rows);
    let keys = places.keys();
    let known = |name: &str| names.contains(name) || keys.contains(&name);
    for plot in plots {
        for name in [&plot.figure, &plot.over] {
            if !known(name) {
                let all = keys
                    .iter()
                    .chain(&names)
                    .copied()
                    .collect::<Vec<_>>()
                    .join(", ");
                return Err(Error::Usage(format!(
                    "no {name} to plot: expected FIGURE:KEY of {all}"
                )));
            }
        }
    }
    let plots = match plots {
        [] => &by_default(&keys, &names)[..],
        chosen => chosen,
    };
    if plots.is_empty() {
        return Ok(None);
    }
    let panels: Vec<SweepPanel> = plots.iter().map(|plot| panel(places, rows, plot)).collect();
    let refused = rows
        .iter()
        .filter(|row| row.record.outcome == RunOutcome::Refused);
    let about = match refused.count() {
        0 => format!("{} runs", rows.len()),
        refused => format!("{} runs, {refused} of them refused", rows.len()),
    };
    let text = sweep_plot([&places.scene, &about], &panels);
    files::write_in_steps(path, &unfinished(), |file| {
        file.write_all(text.as_bytes())
            .map_err(Error::io("write", path))
    })?;
    Ok(Some(path.to_owned()))
}

fn by_default(keys: &[&str], names: &BTreeSet<&str>) -> Vec<Plot> {
    let default = DEFAULT.map(|(figure, _)| figure);
    let figures = || default.into_iter().filter(|figure| names.contains(figure));
    let of = |key: &&str| {
        let over = (*key).to_owned();
        let plot = move |figure: &str| Plot {
            figure: figure.to_owned(),
            over: over.clone(),
        };
        figures().map(plot).collect::<Vec<_>>()
    };
    keys.iter().flat_map(of).take(MOST_DEFAULT).collect()
}

/// Returns a number of a row by name.
fn number(row: &SweepRow, name: &str) -> Option<f64> {
    match row.values.get(name) {
        Some(value) => one_number(value),
        None => row.record.figures.get(name).copied(),
    }
}

fn panel<'a>(places: &SweepRuns, rows: &[SweepRow], plot: &'a Plot) -> SweepPanel<'a> {
    let keys = places.keys();
    let is_key = |name: &str| keys.contains(&name);
    // Values other than numbers are arranged along the axis in order of occurrence.
    let mut words: Vec<String> = Vec::new();
    let of_key = |row: &&SweepRow| row.values.get(&plot.over).map(written);
    if is_key(&plot.over) && rows.iter().any(|row| number(row, &plot.over).is_none()) {
        for word in rows.iter().filter_map(|row| of_key(&row)) {
            if !words.contains(&word) {
                words.push(word);
            }
        }
    }
    let x = |row: &SweepRow| match words.is_empty() {
        true => number(row, &plot.over),
        false => {
            let word = of_key(&row)?;
            words
                .iter()
                .position(|other| *other == word)
                .map(|i| i as f64)
        }
    };
    let joined = is_key(&plot.over) && keys.iter().all(|key| !places.is_drawn(key));
    // There is one curve per combination of the other values. Values that change together with the
    // abscissa are excluded.
    let is_other = |key: &str| {
        joined && key != plot.over && !(places.is_listed(key) && places.is_listed(&plot.over))
    };
    let mut curves: Vec<SweepCurve> = Vec::new();
    for row in rows {
        let others = row.values.iter().filter(|(key, _)| is_other(key));
        let name: Vec<String> = others
            .map(|(key, value)| format!("{key} = {}", written(value)))
            .collect();
        let name = name.join(", ");
        let i = curves.iter().position(|curve| curve.name == name);
        let i = i.unwrap_or_else(|| {
            curves.push(SweepCurve {
                name,
                points: Vec::new(),
                gaps: Vec::new(),
            });
            curves.len() - 1
        });
        match (x(row), number(row, &plot.figure)) {
            (Some(x), Some(y)) => curves[i].points.push((x, y)),
            (Some(x), None) => curves[i].gaps.push(x),
            _ => {}
        }
    }
    for curve in &mut curves {
        curve.points.sort_by(|a, b| a.0.total_cmp(&b.0));
    }
    SweepPanel {
        title: &plot.figure,
        x: title_of(&plot.over),
        y: title_of(&plot.figure),
        words,
        joined,
        curves,
    }
}

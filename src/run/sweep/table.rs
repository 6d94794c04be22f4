//! The table of a sweep, and plots of its figures.

use super::places::Places;
use super::record::{Outcome, Record};
use crate::error::{Error, Result};
use crate::report::sweep_plot::{Curve, Panel, sweep_plot};
use crate::run::files;
use crate::run::recipe::{Values, one_number};
use crate::run::shards::unfinished;
use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use toml::Value;

/// What to plot: a figure over a key that varies, or over another figure.
#[derive(Debug, Clone)]
pub struct Plot {
    /// Name of a figure.
    pub figure: String,
    /// A key, or the name of a figure.
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
/// Number of plots by default.
const MOST_DEFAULT: usize = 12;

fn title_of(figure: &str) -> &str {
    let found = DEFAULT.iter().find(|(name, _)| *name == figure);
    found.map_or(figure, |(_, words)| words)
}

/// A place with its values.
pub struct Row<'a> {
    values: Values,
    record: &'a Record,
}

pub fn rows<'a>(places: &Places, records: &[&'a Record]) -> Vec<Row<'a>> {
    let row = |record: &&'a Record| Row {
        values: places.values(record.place),
        record,
    };
    records.iter().map(row).collect()
}

/// All figures that some row has.
fn names<'a>(rows: &'a [Row]) -> BTreeSet<&'a str> {
    let all = rows.iter().flat_map(|row| row.record.figures.keys());
    all.map(String::as_str).collect()
}

fn written(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

/// One line a place: its number, its values, what became of it, its figures, why.
pub fn write_csv(path: &Path, places: &Places, rows: &[Row]) -> Result<()> {
    let (keys, names) = (places.keys(), names(rows));
    let failed = |error: csv::Error| Error::io("write", path)(error.into());
    files::write_in_steps(path, &unfinished(), |file| {
        let mut out = csv::Writer::from_writer(file);
        let head = ["place"].into_iter().chain(keys.iter().copied());
        let head = head.chain(["result"]).chain(names.iter().copied());
        out.write_record(head.chain(["message"])).map_err(failed)?;
        for row in rows {
            let mut line = vec![row.record.place.to_string()];
            line.extend(keys.iter().map(|key| written(&row.values[*key])));
            let result = match row.record.outcome {
                Outcome::Good => "good",
                Outcome::Warned => "warned",
                Outcome::Refused => "refused",
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

/// Writes the plots, or those that nobody chose; `None` if there is nothing to plot.
pub fn write_plots(
    path: &Path,
    places: &Places,
    rows: &[Row],
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
    let panels: Vec<Panel> = plots.iter().map(|plot| panel(places, rows, plot)).collect();
    let refused = rows
        .iter()
        .filter(|row| row.record.outcome == Outcome::Refused);
    let about = match refused.count() {
        0 => format!("{} places", rows.len()),
        refused => format!("{} places, {refused} of them refused", rows.len()),
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

/// A number of a row by name.
fn number(row: &Row, name: &str) -> Option<f64> {
    match row.values.get(name) {
        Some(value) => one_number(value),
        None => row.record.figures.get(name).copied(),
    }
}

fn panel<'a>(places: &Places, rows: &[Row], plot: &'a Plot) -> Panel<'a> {
    let keys = places.keys();
    let is_key = |name: &str| keys.contains(&name);
    // Values that are no numbers stand side by side.
    let mut words: Vec<String> = Vec::new();
    let of_key = |row: &&Row| row.values.get(&plot.over).map(written);
    if is_key(&plot.over) && rows.iter().any(|row| number(row, &plot.over).is_none()) {
        for word in rows.iter().filter_map(|row| of_key(&row)) {
            if !words.contains(&word) {
                words.push(word);
            }
        }
    }
    let x = |row: &Row| match words.is_empty() {
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
    // A curve for each choice of the other values, but of those that change with this one.
    let is_other = |key: &str| {
        joined && key != plot.over && !(places.is_listed(key) && places.is_listed(&plot.over))
    };
    let mut curves: Vec<Curve> = Vec::new();
    for row in rows {
        let others = row.values.iter().filter(|(key, _)| is_other(key));
        let name: Vec<String> = others
            .map(|(key, value)| format!("{key} = {}", written(value)))
            .collect();
        let name = name.join(", ");
        let i = curves.iter().position(|curve| curve.name == name);
        let i = i.unwrap_or_else(|| {
            curves.push(Curve {
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
    Panel {
        title: &plot.figure,
        x: title_of(&plot.over),
        y: title_of(&plot.figure),
        words,
        joined,
        curves,
    }
}

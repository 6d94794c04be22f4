//! Configurations of a sweep: a scene, and its values in each run.

use crate::error::Result;
use crate::run::recipe::{Draws, SampleTable, TomlFile, ValueScale, Values, one_number, part_key};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use toml::{Spanned, Value};

/// File of the sweep.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SweepFile {
    scene: String,
    frames: Option<Spanned<String>>,
    #[serde(default)]
    grid: BTreeMap<String, Spanned<Value>>,
    #[serde(default)]
    cases: Vec<Spanned<Values>>,
    #[serde(default)]
    sample: BTreeMap<String, Spanned<SampleTable>>,
    samples: Option<u64>,
    #[serde(default)]
    seed: u64,
}

/// Uniformly spaced numbers.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Even {
    from: f64,
    to: f64,
    count: u32,
    #[serde(default)]
    scale: ValueScale,
}

const MOST_PLACES: u64 = 1_000_000;

/// Configurations of a sweep: the product of grid, list and draws.
pub struct SweepRuns {
    pub written: TomlFile,
    /// Path of the scene file as written in the sweep file.
    pub scene: String,
    pub frames: Option<Range<u32>>,
    grid: Vec<(String, Vec<Value>)>,
    list: Vec<Values>,
    draws: Draws,
    draws_count: u64,
}

impl SweepRuns {
    /// Reads a sweep file. Errors: the file cannot be read, or has a mistake, reported with its
    /// line.
    pub fn read(path: &Path) -> Result<SweepRuns> {
        let expected = "a sweep: scene = \"scene.toml\", and [grid] \"camera.f_number\" = [4, 8], \
                        [[list]] or [draw]";
        let (written, file) = TomlFile::read::<SweepFile>(path, expected)?;
        let frames = match &file.frames {
            None => None,
            Some(text) => {
                let number = |text: &str| text.parse::<u32>().ok();
                let ends = text.get_ref().split_once("..");
                let range = ends.and_then(|(a, b)| Some(number(a)?..number(b)?));
                let range = range.filter(|range| !range.is_empty());
                let wrong = || {
                    let (at, found) = (text.span().start, format!("{:?}", text.get_ref()));
                    written.input_error(
                        Some(at),
                        Some("frames"),
                        &found,
                        "two frame numbers, the first less than the second: \"10..20\"",
                    )
                };
                Some(range.ok_or_else(wrong)?)
            }
        };
        let mut grid = Vec::new();
        for (key, axis) in file.grid {
            let at = axis.span().start;
            let values = along(axis.into_inner()).map_err(|(found, expected)| {
                written.input_error(Some(at), Some(&key), &found, expected)
            })?;
            grid.push((key, values));
        }
        let mut list = Vec::new();
        for entry in file.cases {
            let at = entry.span().start;
            let first = list.first().unwrap_or(entry.get_ref());
            if first.keys().ne(entry.get_ref().keys()) {
                let found = "other keys than in the first";
                let expected = "the same keys in every [[cases]]";
                return Err(written.input_error(Some(at), Some("cases"), found, expected));
            }
            list.push(entry.into_inner());
        }
        let draws = Draws::of(&written, file.seed, file.sample, |_| None)?;
        let drawn = draws.keys().next().is_some();
        if drawn != file.samples.is_some() {
            let found = if drawn {
                "none"
            } else {
                "samples without [sample]"
            };
            let expected = "a number of samples and their ranges: samples = 100, [sample] …";
            return Err(written.input_error(None, Some("samples"), found, expected));
        }
        let places = SweepRuns {
            scene: file.scene,
            frames,
            grid,
            list,
            draws,
            draws_count: file.samples.unwrap_or(1),
            written,
        };
        places.check()?;
        Ok(places)
    }

    fn check(&self) -> Result<()> {
        let wrong = |key: &str, found: &str, expected: &str| {
            Err(self.written.input_error(None, Some(key), found, expected))
        };
        let keys = self.keys();
        if let Some(pair) = keys.windows(2).find(|pair| pair[0] == pair[1]) {
            return wrong(
                pair[0],
                "it twice",
                "each key once in [grid], [[cases]] and [sample]",
            );
        }
        if keys.is_empty() {
            let expected = "[grid] \"camera.f_number\" = [4, 8], [[cases]] or [sample]";
            return wrong("grid", "nothing to vary", expected);
        }
        let counts = self.grid.iter().map(|(_, values)| values.len() as u64);
        let counts = counts.chain([self.list.len().max(1) as u64, self.draws_count]);
        let all = counts.fold(1u64, u64::saturating_mul);
        if !(1..=MOST_PLACES).contains(&all) {
            return wrong("grid", &format!("{all} runs"), "from 1 to 1e6 runs");
        }
        Ok(())
    }

    /// Returns all keys that vary, in alphabetical order.
    pub fn keys(&self) -> Vec<&str> {
        let grid = self.grid.iter().map(|(key, _)| key);
        let list = self.list.first().into_iter().flat_map(Values::keys);
        let mut keys: Vec<&str> = grid
            .chain(list)
            .chain(self.draws.keys())
            .map(String::as_str)
            .collect();
        keys.sort_unstable();
        keys
    }

    /// Returns whether a key has random values, which never repeat.
    pub fn is_drawn(&self, key: &str) -> bool {
        self.draws.keys().any(|drawn| drawn == key)
    }

    /// Returns whether a key is in the list, so that it changes together with other keys.
    pub fn is_listed(&self, key: &str) -> bool {
        self.list
            .first()
            .is_some_and(|first| first.contains_key(key))
    }

    pub fn count(&self) -> u64 {
        let grid: u64 = self.grid.iter().map(|(_, v)| v.len() as u64).product();
        grid * self.list.len().max(1) as u64 * self.draws_count
    }

    /// Returns the values of a run. Draws vary fastest, then the list, then the grid from its last
    /// key to its first.
    pub fn values(&self, place: u64) -> Values {
        let mut values = self.draws.values(place % self.draws_count);
        let mut rest = place / self.draws_count;
        let mut digit = |count: usize| {
            let digit = rest % count as u64;
            rest /= count as u64;
            digit as usize
        };
        if !self.list.is_empty() {
            values.extend(self.list[digit(self.list.len())].clone());
        }
        for (key, axis) in self.grid.iter().rev() {
            values.insert(key.clone(), axis[digit(axis.len())].clone());
        }
        values
    }
}

/// Returns the values that change the part.
pub fn of_part(values: &Values) -> Values {
    let part = values.iter().filter(|(key, _)| part_key(key).is_some());
    part.map(|(key, value)| (key.clone(), value.clone()))
        .collect()
}

/// Returns the values along one axis of the grid. Errors: the found and the expected value.
fn along(axis: Value) -> std::result::Result<Vec<Value>, (String, &'static str)> {
    const KINDS: &str = "a list of values, [4, 5.6, 8], or { from = 1, to = 20, count = 8 }, with scale = \"log\" \
                         for even ratios";
    let whole = |value: &Value| one_number(value).is_some_and(|number| number.fract() == 0.0);
    let written = axis.to_string();
    let even: Even = match axis {
        Value::Array(values) if !values.is_empty() => return Ok(values),
        Value::Table(_) => axis.try_into().map_err(|_| (written.clone(), KINDS))?,
        _ => return Err((written, KINDS)),
    };
    let Even {
        from,
        to,
        count,
        scale,
    } = even;
    let finite = (to - from).is_finite() && from < to && (2..=100_000).contains(&count);
    if !finite || scale == ValueScale::Log && from <= 0.0 {
        let expected =
            "from below to, finite, above 0 for scale = \"log\", and count from 2 to 1e5";
        return Err((written, expected));
    }
    let value = |i: u32| {
        let number = scale.between(from, to, f64::from(i) / f64::from(count - 1));
        // Some keys accept only integers.
        let value = Value::Integer(number as i64);
        match whole(&Value::Float(number)) && number.abs() < 1e15 {
            true => value,
            false => Value::Float(number),
        }
    };
    Ok((0..count).map(value).collect())
}

//! Common parts of data sets and sweeps: a file that names a scene and the values that differ.
//! Values are set by dotted key or sampled at random.

use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, InputError, Place, Result};
use crate::math::rng::{Purpose, RngKey};
use crate::scene::set_value;
use crate::scene::{FileKind, backslash_hint, file_kind};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use toml::{Spanned, Value};

/// Values of a scene by dotted key.
pub type Values = BTreeMap<String, Value>;

/// Keys that determine the hierarchy and the parts of it that are read.
const PART: [&str; 9] = [
    "part.mesh",
    "part.plane",
    "part.sphere",
    "part.cylinder",
    "part.step_block",
    "part.instances",
    "inspect.nominal",
    "object",
    "model.ray_backend",
];

/// Returns the part key that equals `key`, contains it or lies below it.
pub fn part_key(key: &str) -> Option<&'static str> {
    let below = |a: &str, b: &str| {
        let rest = a.strip_prefix(b);
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    PART.into_iter()
        .find(|part| below(key, part) || below(part, key))
}

/// A file and its text, to locate mistakes.
pub struct TomlFile {
    pub path: PathBuf,
    pub text: String,
}

impl TomlFile {
    /// Reads a TOML file. Errors: it cannot be read; it differs from the `expected` kind.
    pub fn read<T: DeserializeOwned>(path: &Path, expected: &str) -> Result<(TomlFile, T)> {
        let text = input_file::read_text(path, LARGEST_TEXT, expected)?;
        let path = path.to_owned();
        let written = TomlFile { path, text };
        match toml::from_str(&written.text) {
            Ok(file) => Ok((written, file)),
            Err(error) => Err(written.explain(&error, expected)),
        }
    }

    /// Explains an error of the TOML parser.
    fn explain(&self, error: &toml::de::Error, expected: &str) -> Error {
        let table = self.text.parse::<toml::Table>().ok();
        let has = |key: &str| table.as_ref().is_some_and(|table| table.contains_key(key));
        let kind = file_kind(has);
        if let Some(kind @ (FileKind::Scene | FileKind::Sensor)) = kind {
            return self.input_error(None, None, kind.name(), expected);
        }
        let at = error.span().map(|span| span.start);
        let found = error.message().replace('\n', "; ");
        let before = self.text.get(..at.unwrap_or(0)).unwrap_or_default();
        let start = before.rfind('\n').map_or(0, |n| n + 1);
        let line = self.text[start..].lines().next().unwrap_or_default();
        match (self.input_error(at, None, &found, expected), table) {
            (Error::Input(mut mistake), None) => {
                mistake.hint = backslash_hint(line).map(str::to_owned);
                Error::Input(mistake)
            }
            (error, _) => error,
        }
    }

    /// Returns an error for a mistake at a byte of the file.
    pub fn input_error(
        &self,
        at: Option<usize>,
        key: Option<&str>,
        found: &str,
        expected: &str,
    ) -> Error {
        let line = |at: usize| {
            let before = self.text.as_bytes().iter().take(at);
            Place::Line(1 + before.filter(|&&byte| byte == b'\n').count())
        };
        let place = at.map_or(Place::File, line);
        let mut error = InputError::new(&self.path, place, found, expected);
        error.key = key.map(str::to_owned);
        error.into()
    }

    /// Returns the path of a file that this file names.
    pub fn sibling_path(&self, file: impl AsRef<Path>) -> PathBuf {
        self.path.parent().unwrap_or(Path::new("")).join(file)
    }

    /// Returns the text of a scene with other values. Errors: a value that cannot be set.
    pub fn text_with<'a>(
        &self,
        scene: &Value,
        values: impl IntoIterator<Item = (&'a String, &'a Value)>,
    ) -> Result<String> {
        let mut changed = scene.clone();
        for (key, value) in values {
            set_value(&mut changed, key, Some(value.clone())).map_err(|message| {
                let found = message
                    .strip_prefix(&format!("{key}: "))
                    .unwrap_or(&message);
                let found = found.strip_prefix("found ").unwrap_or(found);
                self.input_error(None, Some(key), found, "a key of the scene")
            })?;
        }
        Ok(toml::to_string(&changed).expect("a scene was TOML"))
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SampleTable {
    from: Option<Value>,
    to: Option<Value>,
    #[serde(default)]
    scale: ValueScale,
    choice: Option<Vec<Value>>,
}

/// Scale on which numbers are uniformly spaced.
#[derive(Deserialize, Clone, Copy, Default, PartialEq)]
#[serde(rename_all = "lowercase")]
pub enum ValueScale {
    #[default]
    Linear,
    Log,
}

impl ValueScale {
    /// Returns the number at a fraction of the interval between two numbers.
    pub fn between(self, from: f64, to: f64, share: f64) -> f64 {
        let between = match self {
            ValueScale::Linear => from + share * (to - from),
            ValueScale::Log => from * (to / from).powf(share),
        };
        between.clamp(from, to)
    }
}

/// Random distributions of values of a scene.
pub struct Draws {
    seed: u64,
    draws: BTreeMap<String, ValueDistribution>,
}

impl Draws {
    /// Reads the distributions. Errors: a mistake in a table, with its line; a key that `refused`
    /// rejects. `refused` returns the found and the expected value.
    pub fn of(
        written: &TomlFile,
        seed: u64,
        tables: BTreeMap<String, Spanned<SampleTable>>,
        refused: impl Fn(&str) -> Option<(String, &'static str)>,
    ) -> Result<Draws> {
        let mut draws = BTreeMap::new();
        for (key, table) in tables {
            let at = table.span().start;
            let draw = match refused(&key) {
                Some(refused) => Err(refused),
                None => ValueDistribution::of(table.into_inner()),
            };
            let draw = draw.map_err(|(found, expected)| {
                written.input_error(Some(at), Some(&key), &found, expected)
            })?;
            draws.insert(key, draw);
        }
        Ok(Draws { seed, draws })
    }

    pub fn keys(&self) -> impl Iterator<Item = &String> {
        self.draws.keys()
    }

    /// Returns the random key of `name` in a sample. It does not depend on other distributions.
    pub fn key(&self, sample: u64, name: &str) -> RngKey {
        let key = RngKey::new(self.seed, Purpose::Samples).with(sample);
        name.bytes().fold(key, |key, byte| key.with(byte.into()))
    }

    /// Returns the values of a sample.
    pub fn values(&self, sample: u64) -> Values {
        let draws = self.draws.iter();
        let drawn = draws.map(|(key, draw)| {
            let of = self.key(sample, key);
            (key.clone(), draw.at(|i| of.uniform(i)))
        });
        drawn.collect()
    }

    /// Returns the values at the lower and upper ends of all distributions.
    pub fn ends(&self) -> [Values; 2] {
        [0.0, 1.0].map(|place| {
            let draws = self.draws.iter();
            let at = draws.map(|(key, draw)| (key.clone(), draw.at(|_| place)));
            at.collect()
        })
    }
}

/// Distribution of one value of the scene.
enum ValueDistribution {
    OneOf(Vec<Value>),
    /// Uniform between two numbers, or between corresponding numbers of two lists.
    Between {
        ends: Vec<(f64, f64)>,
        list: bool,
        scale: ValueScale,
    },
}

impl ValueDistribution {
    /// Reads a distribution. Errors: the found and the expected value.
    fn of(table: SampleTable) -> std::result::Result<ValueDistribution, (String, &'static str)> {
        const KINDS: &str = "{ from = 1, to = 2 }, with numbers or lists of as many numbers, or \
                             { choice = [1, 2] }";
        match (table.from, table.to, table.choice) {
            (None, None, Some(values)) if !values.is_empty() => {
                Ok(ValueDistribution::OneOf(values))
            }
            (Some(from), Some(to), None) => {
                let list = from.is_array();
                let alike = list == to.is_array();
                let written = format!("from = {from}, to = {to}");
                let (from, to) = match (numbers(&from), numbers(&to)) {
                    (Some(from), Some(to)) if alike && from.len() == to.len() => (from, to),
                    _ => return Err((written, KINDS)),
                };
                let ends: Vec<(f64, f64)> = from.into_iter().zip(to).collect();
                if ends
                    .iter()
                    .any(|&(from, to)| !(from <= to && (to - from).is_finite()))
                {
                    return Err((written, "finite numbers, from not above to"));
                }
                let scale = table.scale;
                if scale == ValueScale::Log && ends.iter().any(|&(from, _)| from <= 0.0) {
                    return Err((written, "numbers above 0 for scale = \"log\""));
                }
                Ok(ValueDistribution::Between { ends, list, scale })
            }
            _ => Err(("other keys".to_owned(), KINDS)),
        }
    }

    /// Returns the value for uniform random numbers between 0 and 1.
    fn at(&self, uniform: impl Fn(u64) -> f64) -> Value {
        let (ends, list, scale) = match self {
            ValueDistribution::OneOf(values) => {
                let i = (uniform(0) * values.len() as f64) as usize;
                return values[i.min(values.len() - 1)].clone();
            }
            ValueDistribution::Between { ends, list, scale } => (ends, list, scale),
        };
        let number = |(i, &(from, to)): (usize, &(f64, f64))| {
            let share = uniform(i as u64);
            Value::Float(scale.between(from, to, share))
        };
        let mut numbers = ends.iter().enumerate().map(number);
        match list {
            true => Value::Array(numbers.collect()),
            false => numbers.next().expect("a number has one"),
        }
    }
}

/// Returns a number as a list, or the numbers of a list.
fn numbers(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Array(list) => list.iter().map(one_number).collect(),
        one => Some(vec![one_number(one)?]),
    }
}

pub fn one_number(value: &Value) -> Option<f64> {
    value.as_float().or(value.as_integer().map(|i| i as f64))
}

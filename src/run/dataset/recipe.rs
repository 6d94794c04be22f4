//! What a data set is made of: a scene, and which of its values are drawn anew for each sample.

use crate::error::{Error, InputError, Place, Result};
use crate::math::rng::{Key, Purpose};
use crate::scene::set_value;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use toml::{Spanned, Value};

/// The recipe's file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RecipeFile {
    scene: String,
    samples: u64,
    #[serde(default)]
    seed: u64,
    #[serde(default = "samples_per_file")]
    samples_per_file: u64,
    #[serde(default)]
    draw: BTreeMap<String, Spanned<DrawTable>>,
}

fn samples_per_file() -> u64 {
    1000
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct DrawTable {
    from: Option<Value>,
    to: Option<Value>,
    #[serde(default)]
    scale: Scale,
    one_of: Option<Vec<Value>>,
}

/// In what numbers are spread evenly.
#[derive(Deserialize, Clone, Copy, Default, PartialEq)]
#[serde(rename_all = "lowercase")]
enum Scale {
    #[default]
    Linear,
    Log,
}

/// How one value of the scene is drawn.
enum Draw {
    OneOf(Vec<Value>),
    /// Evenly between two numbers, or between those of two lists in their order.
    Between {
        ends: Vec<(f64, f64)>,
        list: bool,
        scale: Scale,
    },
}

/// Keys that all samples have from the scene: they share one part, and each has an image.
const FIXED: [&str; 9] = [
    "seed",
    "write_frames",
    "plan.accel",
    "part.mesh",
    "part.plane",
    "part.sphere",
    "part.cylinder",
    "part.step_block",
    "part.copies",
];

/// A data set's recipe, validated but for what the scene says of the values drawn.
pub struct Recipe {
    pub path: PathBuf,
    pub text: String,
    pub scene: PathBuf,
    pub samples: u64,
    pub samples_per_file: u64,
    seed: u64,
    draws: BTreeMap<String, Draw>,
}

/// The values drawn for a sample, by dotted key.
pub type Values = BTreeMap<String, Value>;

impl Recipe {
    /// Errors: a file that cannot be read; a mistake in it, with its place.
    pub fn read(path: &Path) -> Result<Recipe> {
        let text = std::fs::read_to_string(path).map_err(Error::io("read", path))?;
        let line = |at: usize| {
            let before = text.as_bytes().iter().take(at);
            Place::Line(1 + before.filter(|&&byte| byte == b'\n').count())
        };
        let wrong = |place, key: Option<&str>, found: &str, expected: &str| -> Error {
            let mut error = InputError::new(path, place, found, expected);
            error.key = key.map(str::to_owned);
            error.into()
        };
        let file: RecipeFile = toml::from_str(&text).map_err(|error| {
            let expected = "a recipe: scene = \"scene.toml\", samples = 1000, and \
                            [draw] \"camera.f_number\" = { from = 4, to = 11 }";
            let place = error.span().map_or(Place::File, |span| line(span.start));
            wrong(place, None, &error.message().replace('\n', "; "), expected)
        })?;
        for (key, number) in [
            ("samples", file.samples),
            ("samples_per_file", file.samples_per_file),
        ] {
            // Their numbers have six digits in names.
            if !(1..=1_000_000_000).contains(&number) {
                let expected = "a whole number from 1 to 1e9";
                return Err(wrong(Place::File, Some(key), &number.to_string(), expected));
            }
        }
        let mut draws = BTreeMap::new();
        for (key, table) in file.draw {
            let place = line(table.span().start);
            let draw = Draw::of(&key, table.into_inner())
                .map_err(|(found, expected)| wrong(place, Some(&key), &found, expected))?;
            draws.insert(key, draw);
        }
        Ok(Recipe {
            path: path.to_owned(),
            scene: path.parent().unwrap_or(Path::new("")).join(file.scene),
            samples: file.samples,
            samples_per_file: file.samples_per_file,
            seed: file.seed,
            draws,
            text,
        })
    }

    /// Of what is called `name` in a sample; what else is drawn does not change it.
    fn key(&self, sample: u64, name: &str) -> Key {
        let key = Key::new(self.seed, Purpose::Samples).with(sample);
        name.bytes().fold(key, |key, byte| key.with(byte.into()))
    }

    /// The values of a sample.
    pub fn values(&self, sample: u64) -> Values {
        let draws = self.draws.iter();
        let drawn = draws.map(|(key, draw)| (key.clone(), draw.at(self.uniforms(sample, key))));
        drawn.collect()
    }

    fn uniforms(&self, sample: u64, name: &str) -> impl Fn(u64) -> f64 + use<> {
        let key = self.key(sample, name);
        move |i| key.uniform(i)
    }

    /// Which of so many frames a sample is.
    pub fn frame(&self, sample: u64, frames: u32) -> u32 {
        (self.key(sample, "frame").uniform(0) * frames as f64) as u32
    }

    /// The seed of a sample's speckle and noise; TOML has whole numbers of 63 bits.
    pub fn seed(&self, sample: u64) -> u64 {
        self.key(sample, "seed").bits(0) >> 1
    }

    /// The values at the lower and the upper ends of what is drawn.
    pub fn ends(&self) -> [Values; 2] {
        [0.0, 1.0].map(|place| {
            let draws = self.draws.iter();
            let at = draws.map(|(key, draw)| (key.clone(), draw.at(|_| place)));
            at.collect()
        })
    }

    /// The text of a scene with other values.
    pub fn text_with(&self, scene: &Value, values: &Values, seed: u64) -> Result<String> {
        let mut changed = scene.clone();
        let own = [
            ("seed", Value::Integer(seed as i64)),
            ("write_frames", Value::Boolean(true)),
        ];
        let own = own.map(|(key, value)| (key.to_owned(), value));
        for (key, value) in values.clone().into_iter().chain(own) {
            set_value(&mut changed, &key, Some(value)).map_err(|message| {
                let mut error =
                    InputError::new(&self.path, Place::File, message, "a key of the scene");
                error.key = Some("draw".to_owned());
                error
            })?;
        }
        Ok(toml::to_string(&changed).expect("a scene was TOML"))
    }
}

impl Draw {
    /// Errors: what was found and what was expected.
    fn of(key: &str, table: DrawTable) -> std::result::Result<Draw, (String, &'static str)> {
        let fixed = |name: &&&str| {
            let rest = key.strip_prefix(**name);
            rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        if let Some(name) = FIXED.iter().find(fixed) {
            let expected =
                "a value that may differ between samples, which share part and hierarchy";
            return Err(((*name).to_owned(), expected));
        }
        const KINDS: &str = "{ from = 1, to = 2 }, with numbers or lists of as many numbers, or \
                             { one_of = [1, 2] }";
        match (table.from, table.to, table.one_of) {
            (None, None, Some(values)) if !values.is_empty() => Ok(Draw::OneOf(values)),
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
                if scale == Scale::Log && ends.iter().any(|&(from, _)| from <= 0.0) {
                    return Err((written, "numbers above 0 for scale = \"log\""));
                }
                Ok(Draw::Between { ends, list, scale })
            }
            _ => Err(("other keys".to_owned(), KINDS)),
        }
    }

    /// The value for uniform numbers from 0 to 1.
    fn at(&self, uniform: impl Fn(u64) -> f64) -> Value {
        let (ends, list, scale) = match self {
            Draw::OneOf(values) => {
                let i = (uniform(0) * values.len() as f64) as usize;
                return values[i.min(values.len() - 1)].clone();
            }
            Draw::Between { ends, list, scale } => (ends, list, scale),
        };
        let number = |(i, &(from, to)): (usize, &(f64, f64))| {
            let share = uniform(i as u64);
            let between = match scale {
                Scale::Linear => from + share * (to - from),
                Scale::Log => from * (to / from).powf(share),
            };
            Value::Float(between.clamp(from, to))
        };
        let mut numbers = ends.iter().enumerate().map(number);
        match list {
            true => Value::Array(numbers.collect()),
            false => numbers.next().expect("a number has one"),
        }
    }
}

/// A number, or the numbers of a list.
fn numbers(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Array(list) => list.iter().map(one_number).collect(),
        one => Some(vec![one_number(one)?]),
    }
}

fn one_number(value: &Value) -> Option<f64> {
    value.as_float().or(value.as_integer().map(|i| i as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recipe(text: &str) -> Result<Recipe> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("set.toml");
        std::fs::write(&path, text).unwrap();
        Recipe::read(&path)
    }

    const HEAD: &str = "scene = \"scene.toml\"\nsamples = 9\n[draw]\n";

    /// Mean and variance of 10⁴ draws lie within 5 standard errors of a uniform number's: one run in
    /// 10⁶ would not. A log-uniform one is uniform by its logarithm.
    #[test]
    fn draws_are_uniform_and_do_not_depend_on_each_other() {
        let text = "a.b = { from = 2, to = 4 }\nc = { from = [1, 10], to = [10, 100], scale = \"log\" }\n\
                    d = { one_of = [\"x\", \"y\"] }\n";
        let text = text.replace("a.b", "\"a.b\"");
        let both = recipe(&format!("{HEAD}{text}")).unwrap();
        let n = 10_000;
        let values: Vec<Values> = (0..n).map(|k| both.values(k)).collect();
        let uniform = |of: &dyn Fn(&Values) -> f64| {
            let (mut sum, mut squares) = (0.0, 0.0);
            for value in &values {
                let x = of(value);
                assert!((0.0..=1.0).contains(&x), "{x}");
                sum += x - 0.5;
                squares += (x - 0.5).powi(2);
            }
            let n = n as f64;
            assert!((sum / n).abs() < 5.0 / (12.0 * n).sqrt(), "{sum}");
            // The fourth moment of a uniform number is 1/80.
            let error = ((1.0 / 80.0 - 1.0 / 144.0) / n).sqrt();
            assert!((squares / n - 1.0 / 12.0).abs() < 5.0 * error, "{squares}");
        };
        let float = |value: &Value| value.as_float().unwrap();
        uniform(&|v| (float(&v["a.b"]) - 2.0) / 2.0);
        uniform(&|v| float(&v["c"][0]).log10());
        uniform(&|v| float(&v["c"][1]).log10() - 1.0);
        let x = values
            .iter()
            .filter(|v| v["d"].as_str() == Some("x"))
            .count() as f64;
        assert!((x - 5000.0).abs() < 250.0, "{x}");
        let alone = recipe(&format!("{HEAD}\"a.b\" = {{ from = 2, to = 4 }}")).unwrap();
        assert_eq!(alone.values(7)["a.b"], both.values(7)["a.b"]);
        assert!((0..n).all(|k| both.frame(k, 3) < 3));
    }

    #[test]
    fn a_wrong_recipe_is_refused_with_line_key_found_and_expected() {
        for (line, words) in [
            (
                "x = { from = 1 }",
                "set.toml:4: x: found other keys, expected { from = 1, to = 2 }",
            ),
            (
                "x = { from = 2, to = 1 }",
                "from = 2, to = 1, expected finite numbers, from not above to",
            ),
            (
                "x = { from = [1], to = 2 }",
                "set.toml:4: x: found from = [1], to = 2",
            ),
            (
                "x = { from = 0, to = 2, scale = \"log\" }",
                "numbers above 0",
            ),
            ("x = { from = 0, to = nan }", "finite numbers"),
            ("x = { one_of = [] }", "found other keys"),
            (
                "seed = { one_of = [1] }",
                "set.toml:4: seed: found seed, expected a value that may differ",
            ),
            (
                "\"part.mesh.file\" = { one_of = [\"a.stl\"] }",
                "part.mesh.file: found part.mesh",
            ),
            (
                "x = { form = 1, to = 2 }",
                "set.toml:4: found unknown field `form`",
            ),
        ] {
            let error = recipe(&format!("{HEAD}{line}\n")).err().expect(line);
            assert!(error.to_string().contains(words), "{line}: {error}");
        }
        let error = recipe("scene = \"a\"\nsamples = 0\n").err().unwrap();
        assert!(
            error.to_string().contains("samples: found 0, expected"),
            "{error}"
        );
    }
}

//! Recipe of a data set: a scene, and the values that are sampled for each sample.

use crate::error::Result;
use crate::run::recipe::{Draws, SampleTable, TomlFile, Values, part_key};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use toml::{Spanned, Value};

/// Content of the recipe file.
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
    sample: BTreeMap<String, Spanned<SampleTable>>,
}

fn samples_per_file() -> u64 {
    1000
}

/// Validated recipe of a data set. Constraints of the scene on sampled values are not yet checked.
pub struct Recipe {
    pub written: TomlFile,
    pub scene: PathBuf,
    pub samples: u64,
    pub samples_per_file: u64,
    pub draws: Draws,
}

impl Recipe {
    /// Reads a recipe. Errors: the file cannot be read, or has a mistake, reported with its line.
    pub fn read(path: &Path) -> Result<Recipe> {
        let expected = "a recipe: scene = \"scene.toml\", samples = 1000, and \
                        [draw] \"camera.f_number\" = { from = 4, to = 11 }";
        let (written, file) = TomlFile::read::<RecipeFile>(path, expected)?;
        for (key, number) in [
            ("samples", file.samples),
            ("samples_per_file", file.samples_per_file),
        ] {
            // File names contain these numbers with six digits.
            if !(1..=1_000_000_000).contains(&number) {
                let expected = "a whole number from 1 to 1e9";
                return Err(written.input_error(None, Some(key), &number.to_string(), expected));
            }
        }
        // All samples take these values from the scene, because they have one part and each has an
        // image.
        let fixed = |key: &str| {
            let own = ["seed", "save_images"].into_iter().find(|own| *own == key);
            let expected =
                "a value that may differ between samples, which share part and hierarchy";
            Some((own.or(part_key(key))?.to_owned(), expected))
        };
        Ok(Recipe {
            scene: written.sibling_path(&file.scene),
            samples: file.samples,
            samples_per_file: file.samples_per_file,
            draws: Draws::of(&written, file.seed, file.sample, fixed)?,
            written,
        })
    }

    /// Returns the frame of a sample, one of `frames`.
    pub fn frame(&self, sample: u64, frames: u32) -> u32 {
        (self.draws.key(sample, "frame").uniform(0) * frames as f64) as u32
    }

    /// Returns the seed of speckle and noise of a sample. TOML integers have 63 bits plus sign.
    pub fn seed(&self, sample: u64) -> u64 {
        self.draws.key(sample, "seed").bits(0) >> 1
    }

    /// Returns the text of a scene with other values.
    pub fn text_with(&self, scene: &Value, values: &Values, seed: u64) -> Result<String> {
        let own = [
            ("seed", Value::Integer(seed as i64)),
            ("save_images", Value::Boolean(true)),
        ];
        let own = own.map(|(key, value)| (key.to_owned(), value));
        let all = values
            .iter()
            .chain(own.iter().map(|(key, value)| (key, value)));
        self.written.text_with(scene, all)
    }
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

    const HEAD: &str = "scene = \"scene.toml\"\nsamples = 9\n[sample]\n";

    /// Mean and variance of 10⁴ samples are within 5 standard errors of a uniform distribution. One
    /// run in 10⁶ exceeds this limit. The logarithm of a log-uniform number is uniform.
    #[test]
    fn draws_are_uniform_and_do_not_depend_on_each_other() {
        let text = "a.b = { from = 2, to = 4 }\nc = { from = [1, 10], to = [10, 100], scale = \"log\" }\n\
                    d = { choice = [\"x\", \"y\"] }\n";
        let text = text.replace("a.b", "\"a.b\"");
        let both = recipe(&format!("{HEAD}{text}")).unwrap();
        let n = 10_000;
        let values: Vec<Values> = (0..n).map(|k| both.draws.values(k)).collect();
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
        assert_eq!(alone.draws.values(7)["a.b"], both.draws.values(7)["a.b"]);
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
            ("x = { choice = [] }", "found other keys"),
            (
                "seed = { choice = [1] }",
                "set.toml:4: seed: found seed, expected a value that may differ",
            ),
            (
                "\"part.mesh.file\" = { choice = [\"a.stl\"] }",
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

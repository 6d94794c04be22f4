//! Fit of a sensor model to recordings.
//!
//! Every second block of profiles or columns is fitted, and the other blocks evaluate the fit. A
//! term is accepted if it improves the prediction of the other blocks.

mod line;
mod map;
mod model;
mod moments;
mod part;

use super::recording::{RecordedMap, RecordedPart, Recording};
use crate::error::{Error, Result, printable};
use crate::math::{Z95, students_quantile};
use crate::report::fit_page::{FitPage, StatisticRow, ValueRow};
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::recipe::TomlFile;
use crate::run::{RunControl, files};
use crate::scene::{SensorFile, set_value};
use serde::Serialize;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use toml::Value;

/// Step of x in the output if the data determine only the step of z, µm.
const FINE_X_UM: f64 = 1e-3;

/// Unit of a fitted value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FittedUnit {
    /// Number without a unit.
    One,
    /// Micrometres.
    Um,
    /// Millimetres.
    Mm,
    /// Pixels.
    Px,
    /// Columns of a profile.
    Columns,
    /// Counts.
    Dn,
    /// Counts per electron.
    DnPerE,
    /// Electrons.
    E,
}

impl Serialize for FittedUnit {
    fn serialize<S: serde::Serializer>(
        &self,
        serializer: S,
    ) -> std::result::Result<S::Ok, S::Error> {
        serializer.serialize_str(self.symbol())
    }
}

impl FittedUnit {
    /// Returns the symbol.
    pub fn symbol(self) -> &'static str {
        match self {
            FittedUnit::One => "",
            FittedUnit::Um => "µm",
            FittedUnit::Mm => "mm",
            FittedUnit::Px => "px",
            FittedUnit::Columns => "columns",
            FittedUnit::Dn => "DN",
            FittedUnit::DnPerE => "DN/e",
            FittedUnit::E => "e",
        }
    }
}

/// Value that the recordings determine.
#[derive(Debug, Clone, Serialize)]
pub struct FittedValue {
    /// Name of the quantity.
    pub name: &'static str,
    /// Dotted key of scene or sensor; `None` for a quantity that no single key determines.
    pub key: Option<&'static str>,
    /// Unit of value and interval.
    pub unit: FittedUnit,
    /// Value.
    pub value: f64,
    /// 95 % interval.
    pub interval: [f64; 2],
    /// Path of the recorded file.
    #[serde(serialize_with = "printable::in_json")]
    pub source: PathBuf,
}

impl FittedValue {
    fn new(
        name: &'static str,
        key: Option<&'static str>,
        unit: FittedUnit,
        [value, low, high]: [f64; 3],
        source: &Path,
    ) -> FittedValue {
        FittedValue {
            name,
            key,
            unit,
            value,
            interval: [low, high],
            source: source.to_owned(),
        }
    }
}

/// Statistic of both halves of the data.
#[derive(Debug, Clone, Serialize)]
pub struct HalfStatistic {
    /// Name of the statistic.
    pub name: &'static str,
    /// Value in the half that was fitted; `None` if it has too few data.
    pub fitted_half: Option<f64>,
    /// Value in the half that evaluates the fit; `None` if it has too few data.
    pub other_half: Option<f64>,
    /// Value that the fit predicts.
    pub predicted: f64,
}

/// Results of height maps, or of images of a line.
#[derive(Default)]
struct Findings {
    values: Vec<FittedValue>,
    statistics: Vec<HalfStatistic>,
    misfits: Vec<String>,
    inseparable: Vec<String>,
}

impl Findings {
    /// Adds the mean of a quantity over every second block, if it predicts the other blocks better
    /// than the value of a model without the quantity does.
    fn add_mean(
        &mut self,
        (name, key, unit): (&'static str, Option<&'static str>, FittedUnit),
        path: &Path,
        blocks: &[f64],
        without: f64,
    ) {
        let half = |first: usize| blocks.iter().skip(first).step_by(2).copied();
        let [fitted, other] = [0, 1].map(|first| half(first).collect::<Vec<f64>>());
        let mean = |left_out: Option<usize>| {
            let used = fitted
                .iter()
                .enumerate()
                .filter(|(i, _)| Some(*i) != left_out);
            let used: Vec<f64> = used.map(|(_, value)| *value).collect();
            used.iter().sum::<f64>() / used.len() as f64
        };
        let value = interval_of_jackknife(fitted.len(), mean);
        let gains = other
            .iter()
            .map(|v| (v - without).powi(2) - (v - value[0]).powi(2));
        let (gain, error) = model::mean_and_error(&gains.collect::<Vec<f64>>());
        if value.iter().all(|v| v.is_finite()) && gain > 2.0 * error {
            self.values
                .push(FittedValue::new(name, key, unit, value, path));
            self.statistics.push(HalfStatistic {
                name,
                fitted_half: Some(value[0]),
                other_half: Some(other.iter().sum::<f64>() / other.len() as f64),
                predicted: value[0],
            });
        }
    }
}

/// Content of `fit.json`.
#[derive(Debug, Serialize)]
pub struct FitSummary {
    /// Values that the data determine.
    pub values: Vec<FittedValue>,
    /// Statistics of both halves of the data.
    pub statistics: Vec<HalfStatistic>,
    /// Ways in which the data contradict the model; empty for a sufficient model.
    pub misfits: Vec<String>,
    /// Combinations of quantities that the data do not separate.
    pub inseparable: Vec<String>,
    /// Path of the sensor file.
    #[serde(serialize_with = "printable::in_json")]
    pub sensor: PathBuf,
    /// Path of the keys of part and surface; `None` if the data determine none.
    #[serde(serialize_with = "printable::some_in_json")]
    pub surface: Option<PathBuf>,
    /// Path of the page.
    #[serde(serialize_with = "printable::in_json")]
    pub page: PathBuf,
}

/// Fits the keys of a sensor file to recordings. Writes `sensor.toml`, `surface.toml` if the data
/// determine a topography, `fit.json` and `fit.html`.
///
/// # Errors
/// Returns `Error::Input` for an invalid sensor file or recording, and for data that are too few.
pub fn fit<'a>(
    sensor: &Path,
    recordings: &[PathBuf],
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<FitSummary> {
    let expected = "a sensor file";
    let (written, _) = TomlFile::read::<SensorFile>(sensor, expected)?;
    let table = written.text.parse().expect("a sensor file is a table");
    let read = recordings.iter().map(|path| Recording::read(path));
    let read: Vec<Recording> = read.collect::<Result<_>>()?;
    let mut inputs = vec![written.path.clone()];
    inputs.extend(recordings.iter().cloned());
    inputs.extend(
        read.iter()
            .flat_map(|recording| recording.paths().iter().cloned()),
    );
    let names = Names::of(["sensor.toml", "surface.toml", "fit.json", "fit.html"]);
    let out = out.into().claim(&inputs, &names)?.path;
    let mut summary = FitSummary {
        values: Vec::new(),
        statistics: Vec::new(),
        misfits: Vec::new(),
        inseparable: Vec::new(),
        sensor: out.join("sensor.toml"),
        surface: None,
        page: out.join("fit.html"),
    };
    summary.add_all(&read, control)?;
    let (sensor, surface) = summary.files(table)?;
    files::write_bytes(&summary.sensor, sensor.as_bytes())?;
    if let Some(surface) = surface {
        let path = out.join("surface.toml");
        files::write_bytes(&path, surface.as_bytes())?;
        summary.surface = Some(path);
    }
    files::write_bytes(&summary.page, summary.page().as_bytes())?;
    files::write_json(&out.join("fit.json"), &summary)?;
    Ok(summary)
}

impl FitSummary {
    fn add_all(&mut self, recordings: &[Recording], control: &RunControl) -> Result<()> {
        let mut flat: Vec<&RecordedMap> = Vec::new();
        for recording in recordings {
            control.check()?;
            match recording {
                Recording::Images(images) => self.extend(line::fit_images(images)?),
                Recording::Map(map) => match map.part {
                    None | Some(RecordedPart::Plane) => flat.push(map),
                    Some(part) => self.extend(part::fit_part(map, part)?),
                },
            }
        }
        self.add_threshold();
        if flat.is_empty() {
            return Ok(());
        }
        self.extend(map::fit_maps(&flat)?);
        let planes = flat.iter().filter(|map| map.part.is_some()).copied();
        self.extend(map::residual_errors(&planes.collect::<Vec<_>>()));
        Ok(())
    }

    /// Adds the threshold in counts, if both its ratio to the height of the line and this height
    /// are known. The relative uncertainties of the factors are independent.
    fn add_threshold(&mut self) {
        let of = |name: &str| self.values.iter().find(|value| value.name == name);
        let (Some(ratio), Some(height)) = (of(part::RELATIVE_THRESHOLD), of(line::HEIGHT)) else {
            return;
        };
        let relative = |value: &FittedValue| (value.interval[1] - value.value) / value.value;
        let value = ratio.value * height.value;
        let half = value * relative(ratio).hypot(relative(height));
        let name = "detection threshold";
        let interval = [value, value - half, value + half];
        let key = Some("measure.threshold_dn");
        let fitted = FittedValue::new(name, key, FittedUnit::Dn, interval, &ratio.source);
        self.values.push(fitted);
    }

    fn extend(&mut self, found: Findings) {
        self.values.extend(found.values);
        self.statistics.extend(found.statistics);
        self.misfits.extend(found.misfits);
        self.inseparable.extend(found.inseparable);
    }

    /// Returns the text of the sensor file and the text of the surface keys.
    fn files(&self, sensor: toml::Table) -> Result<(String, Option<String>)> {
        let mut sensor = Value::Table(sensor);
        let mut surface = Value::Table(toml::Table::new());
        let mut sources = [String::new(), String::new()];
        for fitted in &self.values {
            let Some(key) = fitted.key else { continue };
            let (file, source) = match key.starts_with("part.") {
                true => (&mut surface, &mut sources[1]),
                false => (&mut sensor, &mut sources[0]),
            };
            let value = match fitted.unit {
                FittedUnit::Columns => Value::Integer(fitted.value as i64),
                _ if key == "measure.point_steps_um" => {
                    Value::Array(vec![FINE_X_UM.into(), rounded(fitted.value).into()])
                }
                _ => rounded(fitted.value).into(),
            };
            set_value(file, key, Some(value)).map_err(Error::Usage)?;
            let [low, high] = fitted.interval.map(rounded);
            let name = printable::path(&fitted.source);
            let _ = writeln!(source, "# {key}: {} to {} (95 %), from {name}", low, high);
        }
        let text = |value: &Value, sources: &str| {
            format!(
                "# Written by lasertrace fit. Fitted keys with their intervals:\n{sources}\n{}",
                toml::to_string(value).expect("keys of a TOML file")
            )
        };
        let [of_sensor, of_surface] = sources;
        let has_surface = !of_surface.is_empty();
        Ok((
            text(&sensor, &of_sensor),
            has_surface.then(|| text(&surface, &of_surface)),
        ))
    }

    fn page(&self) -> String {
        let values = self.values.iter().map(|fitted| ValueRow {
            name: fitted.name,
            key: fitted.key.unwrap_or("–"),
            unit: fitted.unit.symbol(),
            value: [fitted.value, fitted.interval[0], fitted.interval[1]],
            source: printable::path(&fitted.source).to_string(),
        });
        let statistics = self.statistics.iter().map(|statistic| StatisticRow {
            name: statistic.name,
            values: [
                statistic.fitted_half,
                statistic.other_half,
                Some(statistic.predicted),
            ],
        });
        let page = FitPage {
            values: values.collect(),
            statistics: statistics.collect(),
            misfits: &self.misfits,
            inseparable: &self.inseparable,
        };
        page.html()
    }
}

/// Returns a number with five significant digits, which is far finer than any interval.
fn rounded(value: f64) -> f64 {
    format!("{value:.4e}").parse().unwrap_or(value)
}

/// Returns a statistic and its 95 % interval from the values without one of `n` groups (jackknife,
/// Tukey 1958). `of` returns the statistic without a group, or of all groups.
fn interval_of_jackknife(n: usize, of: impl Fn(Option<usize>) -> f64) -> [f64; 3] {
    let value = of(None);
    let without: Vec<f64> = (0..n).map(|group| of(Some(group))).collect();
    let n = n as f64;
    let mean = without.iter().sum::<f64>() / n;
    let squares: f64 = without.iter().map(|value| (value - mean).powi(2)).sum();
    let error = (squares * (n - 1.0) / n).sqrt();
    let half = students_quantile(Z95, n - 1.0) * error;
    [value, value - half, value + half]
}

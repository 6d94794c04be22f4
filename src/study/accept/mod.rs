//! Prediction of the acceptance test of a sensor: spheres, ball bars and plates in the measuring
//! volume are measured in simulated scans with many seeds.

mod layout;

pub use layout::{Artefact, Artefacts, Placing, Volume};

use super::sensor_scene::SensorScene;
use crate::error::{Result, printable};
use crate::inspect::acceptance::{Characteristic, CharacteristicSpec};
use crate::inspect::artefact::{Cap, Sphere, plane_residuals, shortest_interval};
use crate::inspect::cloud::CloudPoint;
use crate::math::{DVec3, Rigid};
use crate::report::accept_page::AcceptPage;
use crate::report::accept_plot::{self, PlacedArtefact};
use crate::report::chart::short;
use crate::run::memory_estimate::require_study;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::sensor_figures::{FURTHEST_MM, range_that_ends};
use crate::run::simulation::Simulation;
use crate::run::{RunControl, SensorFigures, SystematicBudget, TraceMode, files, setup};
use crate::scene::{LimitsTable, MovingBody, PathMotion, ScanPath, Scene};
use layout::PLATE_MARGIN;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use toml::{Table, Value};

/// Chordal deviation of a sphere's triangles, relative to its radius. It is the largest distance of
/// the mesh from the sphere.
pub const RELATIVE_CHORD: f64 = 2e-5;
/// Number of seeds from which the 95 % interval no longer ends at the extreme values.
pub const ENOUGH_SEEDS: u64 = 50;
/// Half angle of the evaluated cap relative to the measured cap. The outermost of the 25
/// representative points average their surroundings, which requires a margin.
const BEYOND: f64 = 1.05;
/// Minimum number of points of a sphere or plate.
const LEAST_POINTS: usize = 25;

/// Acceptance test that is laid out for a sensor.
pub struct Acceptance {
    /// Path of the sensor file or scene.
    pub sensor: PathBuf,
    /// Measuring volume.
    pub volume: Volume,
    /// Artefacts and counts.
    pub artefacts: Artefacts,
    /// Artefacts at all positions: spheres, in pairs of a ball bar; plates; heights.
    pub placings: Vec<Placing>,
    /// Maximum permissible errors, as given in the file.
    pub limits: LimitsTable,
    sphere: Part,
    plate: Part,
}

/// Artefact in front of the sensor.
struct Part {
    /// Scene; its exposure may be automatic at each position.
    scene: Scene,
    simulation: Simulation,
}

/// Content of `accept.json`.
#[derive(Debug, Serialize)]
pub struct AcceptSummary {
    /// Path of the sensor file or scene.
    #[serde(serialize_with = "printable::in_json")]
    pub sensor: PathBuf,
    /// Statement on the validity of the results.
    pub nature: &'static str,
    /// Decision rule of the characteristics.
    pub rule: String,
    /// Number of seeds. Each has independent speckle, noise and pixel patterns.
    pub seeds: u64,
    /// First seed.
    pub first_seed: u64,
    /// Measuring volume.
    pub volume: Volume,
    /// Artefacts and counts.
    pub artefacts: Artefacts,
    /// Artefacts at all positions, in the order of the results.
    pub placings: Vec<Placing>,
    /// Systematic errors of the sensor and the stage. Without them, the results are lower bounds.
    pub systematic: SystematicBudget,
    /// Results of the test.
    pub characteristics: Vec<Characteristic>,
    /// Conditions that reduce the validity of the results; empty if there are no such conditions.
    pub warnings: Vec<String>,
    /// Path of the report page.
    #[serde(serialize_with = "printable::in_json")]
    pub report: PathBuf,
}

/// Statement on the validity of the results.
const NATURE: &str =
    "A prediction from the sensor's description, not a test of a sensor, and no certificate.";

/// Results of one seed at one position, mm.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct SeedResult {
    /// Centre of the sphere, laser frame.
    center: Option<DVec3>,
    size: Option<f64>,
    form: Option<f64>,
    form_d95: Option<f64>,
    flatness: Option<f64>,
    linearity: Option<f64>,
    repeatability: Option<f64>,
}

impl Acceptance {
    /// Lays out a test for the sensor of a sensor file, or of a scene with its surface, calibration
    /// and speckle.
    ///
    /// # Errors
    /// Returns an error if the file is not a sensor file or a scene. Other errors are artefacts
    /// that do not fit the measuring volume, and a camera that sees no laser light.
    pub fn of(sensor: &Path, seed: Option<u64>, control: &RunControl) -> Result<Acceptance> {
        Acceptance::with(sensor, seed, control, |_| {})
    }

    /// Lays out a test as [`Self::of`] does, for a sensor that is modified by `change`.
    pub fn with(
        sensor: &Path,
        seed: Option<u64>,
        control: &RunControl,
        change: impl Fn(&mut Scene),
    ) -> Result<Acceptance> {
        let base = SensorScene::read(sensor)?;
        let made = |shape, numbers: Table| -> Result<Part> {
            let mut scene = base.with_part(shape, Value::Table(numbers))?;
            scene.seed = seed.unwrap_or(scene.seed);
            change(&mut scene);
            require_study(&scene)?;
            let simulation = setup::simulation(&scene, TraceMode::Footprint, control)?;
            Ok(Part { scene, simulation })
        };
        let square = |side: f64| {
            Table::from_iter([(
                "size_mm".to_owned(),
                Value::Array(vec![Value::Float(side); 2]),
            )])
        };
        // The visible range of the laser light does not depend on the part.
        let bare = made("plane", square(1.0))?;
        let table = bare.scene.accept.clone();
        let figures = SensorFigures::of_simulation(&bare.simulation);
        let far = figures.as_ref().map_or(0.0, |figures| figures.ends()[1]);
        if far > FURTHEST_MM {
            let found = format!("one that sees light up to {far:.3e} mm from the laser");
            return Err(base.wrong("camera.look_at_mm", found, range_that_ends()));
        }
        let volume = figures.and_then(|figures| Volume::of(&figures, &table));
        let volume = volume.ok_or_else(|| {
            let expected = "a line laser whose light the camera sees over some range: look at the sensor with check";
            base.wrong("camera.look_at_mm", "one that sees none", expected)
        })?;
        let artefacts = Artefacts::of(&volume, &table)
            .map_err(|(key, found, expected)| base.wrong(key, format!("{found}"), expected))?;
        let radius = artefacts.sphere_diameter_mm / 2.0;
        let of_sphere = Table::from_iter([
            ("radius_mm".to_owned(), Value::Float(radius)),
            (
                "chordal_deviation_um".to_owned(),
                Value::Float(radius * RELATIVE_CHORD * 1e3),
            ),
        ]);
        Ok(Acceptance {
            sensor: sensor.to_owned(),
            placings: artefacts.placings(&volume),
            limits: table.mpe_um,
            sphere: made("sphere", of_sphere)?,
            plate: made("plane", square(artefacts.plate_side_mm * PLATE_MARGIN))?,
            volume,
            artefacts,
        })
    }

    /// Returns the number of profiles that a run with this number of seeds takes.
    pub fn steps(&self, seeds: u64) -> u64 {
        let of_placing = |placing: &Placing| match placing.artefact {
            Artefact::Height => self.artefacts.repeats,
            _ => placing.frames,
        };
        let of_seed = self.placings.iter().map(of_placing).map(u64::from);
        seeds * of_seed.sum::<u64>()
    }

    /// Runs the test with `seeds` consecutive seeds, starting at the sensor's seed. Writes
    /// `accept.json` and `report.html`.
    pub fn run<'a>(
        &self,
        seeds: u64,
        out: impl Into<OutputFolder<'a>>,
        control: &RunControl,
    ) -> Result<AcceptSummary> {
        let inputs = [
            &self.plate.scene.inputs[..],
            std::slice::from_ref(&self.sensor),
        ]
        .concat();
        let names = Names::of(["accept.json", "report.html"]);
        let out = out.into().claim(&inputs, &names)?.path;
        let characteristics = self.characteristics(seeds, control)?;
        let summary = AcceptSummary {
            sensor: self.sensor.clone(),
            nature: NATURE,
            rule: self.rule(),
            seeds,
            first_seed: self.plate.scene.seed,
            volume: self.volume,
            artefacts: self.artefacts.clone(),
            placings: self.placings.clone(),
            warnings: self.warnings(seeds, &characteristics),
            systematic: SystematicBudget::of(&self.plate.simulation),
            characteristics,
            report: out.join("report.html"),
        };
        let page = self.page(&summary).html();
        files::write_bytes(&summary.report, page.as_bytes())?;
        files::write_json(&out.join("accept.json"), &summary)?;
        Ok(summary)
    }

    /// Returns the characteristics of the test over all seeds.
    pub fn characteristics(&self, seeds: u64, control: &RunControl) -> Result<Vec<Characteristic>> {
        let first = self.plate.scene.seed;
        let done = AtomicU64::new(0);
        let taken = || {
            (control.progress)(done.fetch_add(1, Ordering::Relaxed) + 1);
            control.check()
        };
        let mut by_place = Vec::new();
        for placing in &self.placings {
            control.check()?;
            let placed = self.instances(placing)?;
            let of_seed = |k| {
                control.check()?;
                let simulation = placed.with_seed(first.wrapping_add(k))?;
                self.measure(placing, &simulation, &taken)
            };
            let by_seed = (0..seeds).into_par_iter().map(of_seed);
            by_place.push(by_seed.collect::<Result<Vec<_>>>()?);
        }
        Ok(self.of_values(&by_place))
    }

    /// Returns the simulation of the artefact's scan at its position.
    fn instances(&self, placing: &Placing) -> Result<Simulation> {
        let of_kind = match placing.artefact {
            Artefact::Sphere => &self.sphere,
            Artefact::Plate | Artefact::Height => &self.plate,
        };
        let base = &of_kind.scene;
        let along = base.head_from_laser.rotation.y_axis;
        let [_, middle, _] = placing.middle_mm;
        let half = 0.5 * placing.step_mm * f64::from(placing.frames - 1);
        let step = along * placing.step_mm;
        let mut scene = base.clone();
        scene.part_at_rest = base.head_from_laser * placing.laser_from_artefact;
        scene.scan = ScanPath {
            frames: placing.frames,
            moves: MovingBody::Head,
            motion: PathMotion::Linear { step },
            start: along * (middle - half),
            ..base.scan.clone()
        };
        of_kind.simulation.reusing_part(&scene)
    }

    /// Measures an artefact. `taken` is called after each profile; its error ends the measurement.
    fn measure(
        &self,
        placing: &Placing,
        simulation: &Simulation,
        taken: &AfterProfile,
    ) -> Result<SeedResult> {
        Ok(match placing.artefact {
            Artefact::Sphere => self.sphere(placing, valid_points(simulation, taken)?),
            Artefact::Plate => SeedResult {
                flatness: self.flatness(valid_points(simulation, taken)?),
                ..SeedResult::default()
            },
            Artefact::Height => self.height(simulation, taken)?,
        })
    }

    fn sphere(&self, placing: &Placing, points: Vec<DVec3>) -> SeedResult {
        let (radius, cap) = (
            self.artefacts.sphere_diameter_mm / 2.0,
            self.artefacts.cap(),
        );
        // The cap is centred at the measured sphere, since a real measurement does not know the
        // true sphere.
        let found = Sphere::fit_cap(&points, DVec3::ZERO, DVec3::Z, (BEYOND * cap).min(1.5));
        let found = found.filter(|found| found.points.len() >= LEAST_POINTS);
        let Some(Cap { sphere, points }) = found else {
            return SeedResult::default();
        };
        let representative = sphere.representative(&points, DVec3::Z, cap);
        let representative: Option<Vec<DVec3>> = representative.into_iter().collect();
        let residuals = |sphere: &Sphere, points: &[DVec3]| -> Vec<f64> {
            points.iter().map(|&p| sphere.residual(p)).collect()
        };
        let of_25 = representative.and_then(|points| {
            let sphere = Sphere::fit(&points)?;
            shortest_interval(residuals(&sphere, &points), 1.0)
        });
        SeedResult {
            center: Some(placing.laser_from_artefact.point(sphere.center)),
            size: Some(2.0 * (sphere.radius - radius)),
            form: of_25,
            form_d95: shortest_interval(residuals(&sphere, &points), 0.95),
            ..SeedResult::default()
        }
    }

    fn flatness(&self, mut points: Vec<DVec3>) -> Option<f64> {
        points.retain(|p| self.on_plate(p));
        if points.len() < LEAST_POINTS {
            return None;
        }
        let share = 1.0 - self.artefacts.excluded_percent / 100.0;
        shortest_interval(plane_residuals(&points)?, share)
    }

    /// Whether the point is in the evaluated area along the line. Along the scan, the path limits
    /// the area.
    fn on_plate(&self, point: &DVec3) -> bool {
        point.x.abs() <= self.artefacts.plate_side_mm / 2.0
    }

    /// Measures a profile of a level plate repeatedly, without motion.
    fn height(&self, simulation: &Simulation, taken: &AfterProfile) -> Result<SeedResult> {
        let light = simulation.irradiance(0);
        let repeats: Vec<BTreeMap<u32, f64>> = (0..self.artefacts.repeats)
            .into_par_iter()
            .map(|repeat| {
                let image = simulation.counts_near_light(repeat, &light);
                let (_, points) = simulation.measure_near_light(0, &image);
                let valid = points
                    .iter()
                    .filter(|p| p.is_valid() && self.on_plate(&p.position));
                taken()?;
                Ok(valid.map(|p| (p.column, p.position.z)).collect())
            })
            .collect::<Result<_>>()?;
        let heights = || repeats[0].values();
        if heights().len() < LEAST_POINTS {
            return Ok(SeedResult::default());
        }
        let n = repeats.len() as f64;
        let variances = repeats[0].keys().filter_map(|column| {
            let of_column = repeats.iter().map(|profile| profile.get(column).copied());
            let of_column: Vec<f64> = of_column.collect::<Option<_>>()?;
            let mean = of_column.iter().sum::<f64>() / n;
            Some(of_column.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / (n - 1.0))
        });
        let variances: Vec<f64> = variances.collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        Ok(SeedResult {
            linearity: Some(heights().sum::<f64>() / heights().len() as f64),
            repeatability: (!variances.is_empty()).then(|| mean(&variances).sqrt()),
            ..SeedResult::default()
        })
    }

    /// Computes the characteristics from the results by position and seed.
    fn of_values(&self, by_place: &[Vec<SeedResult>]) -> Vec<Characteristic> {
        let limits = &self.limits;
        let named = |name, symbol, mpe_um| CharacteristicSpec {
            name,
            symbol,
            mpe_um,
            guard_um: self.artefacts.artefact_expanded_uncertainty_um,
        };
        let of =
            |named: CharacteristicSpec, artefact, value: &dyn Fn(&SeedResult) -> Option<f64>| {
                let places = self.placings.iter().zip(by_place);
                let places = places.filter(|(placing, _)| placing.artefact == artefact);
                let values = places.map(|(placing, by_seed)| {
                    let values = by_seed.iter().map(value).collect();
                    (placing.place.clone(), values)
                });
                Characteristic::of(named, values.collect())
            };
        let spheres = self.placings.iter().zip(by_place);
        let spheres = spheres.filter(|(placing, _)| placing.artefact == Artefact::Sphere);
        let spheres: Vec<_> = spheres.collect();
        let spacings = spheres.chunks(2).map(|bar| {
            let [(a, first), (_, second)] = [bar[0], bar[1]];
            let spacing = |(a, b): (&SeedResult, &SeedResult)| {
                Some(a.center?.distance(b.center?) - self.artefacts.ball_bar_length_mm)
            };
            let name = a.place.trim_end_matches(", first").to_owned();
            (name, first.iter().zip(second).map(spacing).collect())
        });
        let form = named("probing form, 25 points", "P_F", limits.probing_form);
        let name = "probing form, 95 % of all points";
        let form_d95 = named(name, "P_F D95%", limits.probing_form_d95);
        let size = named("probing size", "P_S", limits.probing_size);
        let spacing = named("sphere spacing", "SD", limits.sphere_spacing);
        let flatness = named("flatness", "F", limits.flatness);
        let linearity = named("indicated minus true height", "Linearity", limits.linearity);
        let name = "standard deviation of a height";
        let repeatability = CharacteristicSpec {
            // Repeatability does not depend on the calibrated value of an artefact, so it has no
            // guard band.
            guard_um: 0.0,
            ..named(name, "Z repeatability", limits.z_repeatability)
        };
        vec![
            of(form, Artefact::Sphere, &|m| m.form),
            of(form_d95, Artefact::Sphere, &|m| m.form_d95),
            of(size, Artefact::Sphere, &|m| m.size),
            Characteristic::of(spacing, spacings.collect()),
            of(flatness, Artefact::Plate, &|m| m.flatness),
            of(linearity, Artefact::Height, &|m| m.linearity),
            of(repeatability, Artefact::Height, &|m| m.repeatability),
        ]
    }

    fn rule(&self) -> String {
        format!(
            "ISO 14253-1: the largest magnitude over all positions, in the interval of 95 % of the seeds, conforms if its upper end \
             and {} µm, the expanded uncertainty of the artefacts, are within the limit; it does not if its lower end less that is \
             beyond; else it is undecided. Repeatability has no guard band. \
             Without a limit in accept.mpe_um there is no verdict.",
            self.artefacts.artefact_expanded_uncertainty_um
        )
    }

    fn warnings(&self, seeds: u64, characteristics: &[Characteristic]) -> Vec<String> {
        let mut warnings = Vec::new();
        if seeds < ENOUGH_SEEDS {
            warnings.push(format!(
                "{seeds} seeds are few: the interval of 95 % ends with the outermost of them. Take {ENOUGH_SEEDS} or more."
            ));
        }
        for characteristic in characteristics {
            let short = characteristic
                .places
                .iter()
                .filter(|place| place.seeds < seeds as usize);
            let short: Vec<&str> = short.map(|place| place.place.as_str()).collect();
            if let Some(first) = short.first() {
                warnings.push(format!(
                    "{} has no value for every seed at {} of {} positions, for example at \"{first}\": too few valid points, or of 25 \
                     directions some without any. Take more profiles, a smaller cap_half_angle_deg or a larger artefact, or look at the light with check.",
                    characteristic.symbol,
                    short.len(),
                    characteristic.places.len(),
                ));
            }
        }
        warnings
    }

    fn page<'a>(&self, summary: &'a AcceptSummary) -> AcceptPage<'a> {
        let AcceptSummary { volume, .. } = summary;
        let mut facts = vec![
            ("sensor", self.sensor.display().to_string()),
            (
                "seeds",
                format!("{}, from {} on", summary.seeds, summary.first_seed),
            ),
        ];
        let [near, far] = volume.range_mm;
        let [left, right] = volume.width_mm;
        let a = &self.artefacts;
        facts.extend([
            (
                "measuring volume",
                format!(
                    "{:.4} × {:.4} × {:.4} mm",
                    right - left,
                    volume.travel_mm,
                    far - near
                ),
            ),
            (
                "spheres",
                format!(
                    "{:.4} mm, cap of {}°",
                    a.sphere_diameter_mm, a.cap_half_angle_deg
                ),
            ),
            ("ball bar", format!("{:.4} mm", a.ball_bar_length_mm)),
            (
                "plate",
                format!(
                    "{:.4} mm, tilted by {:.4}°",
                    a.plate_side_mm, a.plate_tilt_deg
                ),
            ),
            (
                "profiles of a sphere and of a plate",
                a.profiles.to_string(),
            ),
            (
                "heights",
                format!("{}, {} times each", a.height_steps, a.repeats),
            ),
        ]);
        facts.push(("systematic errors", systematic_fact(&summary.systematic)));
        AcceptPage {
            nature: summary.nature,
            rule: &summary.rule,
            facts,
            warnings: &summary.warnings,
            positions: self.drawing(),
            characteristics: &summary.characteristics,
        }
    }

    fn drawing(&self) -> String {
        let marks = self.placings.iter().map(|placing| {
            let half = match placing.artefact {
                Artefact::Sphere => self.artefacts.sphere_diameter_mm / 2.0,
                _ => self.artefacts.plate_side_mm / 2.0,
            };
            let pose: &Rigid = &placing.laser_from_artefact;
            PlacedArtefact {
                is_sphere: placing.artefact == Artefact::Sphere,
                is_level: placing.artefact == Artefact::Height,
                middle: pose.translation,
                half,
                ends: [DVec3::X, DVec3::Y].map(|axis| pose.rotation * axis * half),
            }
        });
        let volume = &self.volume;
        let bounds = [
            volume.width_mm,
            [-volume.travel_mm / 2.0, volume.travel_mm / 2.0],
            volume.range_mm,
        ];
        accept_plot::positions(&marks.collect::<Vec<_>>(), bounds)
    }
}

/// Returns the systematic errors of a mean of 100 points.
fn systematic_fact(budget: &SystematicBudget) -> String {
    let sources = budget.sources.iter();
    let sources = sources.map(|s| format!("{} {} µm", s.name, short(s.mean_100_um)));
    match budget.lower_bound {
        true => "none: the results are lower bounds".to_owned(),
        false => format!(
            "of the mean height of 100 points: {}",
            sources.collect::<Vec<_>>().join(", ")
        ),
    }
}

/// Callback that counts a profile. It returns an error if the test is cancelled.
type AfterProfile<'a> = dyn Fn() -> Result<()> + Sync + 'a;

/// Returns the valid points of all frames, in the artefact frame.
fn valid_points(simulation: &Simulation, taken: &AfterProfile) -> Result<Vec<DVec3>> {
    let frames = 0..simulation.scene.scan.frames;
    let profiles = frames.clone().into_par_iter().map(|frame| {
        let profile = simulation.profile(frame).1;
        taken()?;
        Ok(profile)
    });
    let mut points: Vec<CloudPoint> = profiles.collect::<Result<Vec<_>>>()?.concat();
    simulation.apply_cross_frame_flags(frames, &mut points);
    let valid = points.iter().filter(|point| point.is_valid());
    Ok(valid.map(|point| point.position).collect())
}

impl AcceptSummary {
    /// Returns the results as text, one line per characteristic.
    pub fn text(&self) -> String {
        let mut text = format!("{}\n", self.nature);
        text += &format!("systematic errors:\n{}", self.systematic.text());
        for warning in &self.warnings {
            text += &format!("warning: {warning}\n");
        }
        text += &format!(
            "{:<18} {:>12} {:>21} {:>10}\n",
            "", "mean, µm", "95 % of tests, µm", "limit, µm"
        );
        for c in &self.characteristics {
            let found = match &c.largest {
                Some(s) => format!("{:>12.3} {:>10.3} {:>10.3}", s.mean_um, s.low_um, s.high_um),
                None => format!("{:>12} {:>10} {:>10}", "–", "–", "–"),
            };
            let limit = c
                .mpe_um
                .map_or("–".to_owned(), |limit| format!("{limit:.3}"));
            text += &format!(
                "{:<18} {found} {limit:>10}  {}\n",
                c.symbol,
                c.decision.words()
            );
        }
        text
    }
}

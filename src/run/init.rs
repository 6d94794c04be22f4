//! Generator of a first scene for a part and a sensor, in a folder with all required files. The
//! path consists of passes that bring all of the part into the measuring range.

use super::files::PART;
use super::goal_path::{GoalPath, PathGoal, PathSummary, pose_table};
use super::output_folder::{Names, OutputFolder};
use super::sensor_figures::SensorFigures;
use super::setup::hierarchy_watched;
use super::simulation::Simulation;
use super::warning_kind::{Warning, WarningKind};
use super::warnings::{PreScanCheck, foreseen_of, unit_doubtful};
use super::{RunControl, files};
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, Result, printable};
use crate::math::{DMat3, DVec3, Rigid};
use crate::mesh::{self, UnitSource, unit_by};
use crate::scene::{Scene, Unit};
use serde::Serialize;
use std::fs;
use std::path::{Path, PathBuf};

/// Fraction of the measuring range and of the field that passes use. The remainder overlaps.
const USED: f64 = 0.9;
/// Number of frames of a first scan. A small part has fewer, because steps are not finer than
/// columns.
const FRAMES: f64 = 2000.0;
/// Ratio of part size to field above which another unit is suggested, and below whose inverse. A
/// part that fills the field gets a ratio of 1000 or 1/1000 if metres and millimetres are confused.
/// The limit is √1000, the midpoint on a logarithmic scale.
const UNIT_RATIO: f64 = 31.6;
/// Names of the files in the folder.
const SCENE: &str = "scene.toml";
const PATH: &str = "path.csv";
const SENSOR: &str = "sensor.toml";

/// Axis of the part's file that points up, towards the sensor.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum Up {
    /// +x.
    #[cfg_attr(feature = "cli", value(name = "x"))]
    X,
    /// −x.
    #[cfg_attr(feature = "cli", value(name = "-x"))]
    MinusX,
    /// +y.
    #[cfg_attr(feature = "cli", value(name = "y"))]
    Y,
    /// −y.
    #[cfg_attr(feature = "cli", value(name = "-y"))]
    MinusY,
    /// +z.
    #[default]
    #[cfg_attr(feature = "cli", value(name = "z"))]
    Z,
    /// −z.
    #[cfg_attr(feature = "cli", value(name = "-z"))]
    MinusZ,
}

impl Up {
    /// Returns the key that rotates the part. A part with a planned path is not rotated.
    fn rotation_key(self, is_planned: bool) -> String {
        match self {
            Up::Z => String::new(),
            _ if is_planned => String::new(),
            up => format!("rotation_deg = {:?}\n", up.rotation_deg()),
        }
    }

    /// Returns the axis in the part's file.
    fn axis(self) -> DVec3 {
        match self {
            Up::X => DVec3::X,
            Up::MinusX => DVec3::NEG_X,
            Up::Y => DVec3::Y,
            Up::MinusY => DVec3::NEG_Y,
            Up::Z => DVec3::Z,
            Up::MinusZ => DVec3::NEG_Z,
        }
    }

    /// Returns the rotation about x, y and z that turns the axis up, degrees.
    fn rotation_deg(self) -> [i32; 3] {
        match self {
            Up::X => [0, -90, 0],
            Up::MinusX => [0, 90, 0],
            Up::Y => [90, 0, 0],
            Up::MinusY => [-90, 0, 0],
            Up::Z => [0, 0, 0],
            Up::MinusZ => [180, 0, 0],
        }
    }
}

/// Summary of a new scene.
#[derive(Debug, Clone, Serialize)]
pub struct InitialScene {
    /// Path of the scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Number of frames on the path.
    pub frames: usize,
    /// Number of adjacent passes per layer, and number of layers.
    pub passes: [usize; 2],
    /// Size of the rotated part, mm.
    pub size_mm: [f64; 3],
    /// Distance between consecutive frames, mm.
    pub step_mm: f64,
    /// Warnings of the path, and of a unit or a range that does not fit the part.
    pub warnings: Vec<Warning>,
    /// Planned path; `null` without a goal.
    pub path: Option<PathSummary>,
}

/// Writes a scene (`scene.toml`) and the poses of its path (`path.csv`) to a folder. The folder
/// also gets copies of the part file and of the sensor file (`sensor.toml`), so it can be moved.
///
/// The sensor looks down at the part, whose axis `up` points to it. Its line is along x, and it
/// moves along y. `unit` is the unit of the part file. `None` selects the unit in the file, or mm.
/// With a `goal`, the part is not rotated, and the path is planned. A sensor with several cameras
/// has the path of its first camera.
///
/// # Errors
/// A part or sensor that cannot be read; a camera that sees no laser light; a file that exists
/// already.
pub fn begin<'a>(
    part: &Path,
    sensor: &Path,
    (unit, up): (Option<Unit>, Up),
    goal: Option<&PathGoal>,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<InitialScene> {
    let copies = Copies::of(part, sensor, control)?;
    let chosen = unit.or(match unit_by(part, &copies.part)? {
        UnitSource::User => Some(Unit::Millimetre),
        UnitSource::Metres | UnitSource::File => None,
    });
    let turned = up.rotation_key(goal.is_some());
    let unit_key = chosen.map_or(String::new(), |unit| format!(", unit = \"{unit}\""));
    let quoted = |text: &str| toml::Value::String(text.to_owned()).to_string();
    let text = |sensor: &str, part: &str| {
        format!(
            "seed = 1\nspeckle = true\nsensor = {}\n\n[part]\nmesh = {{ file = {}{unit_key} }}\n{turned}\
             reflectance = 0.5\n\n[scan]\n",
            quoted(sensor),
            quoted(part)
        )
    };
    let at_rest = format!(
        "{}frames = 1\nstep_mm = 0\ndirection = [0, 1, 0]\n",
        text(&whole(sensor)?, &whole(part)?)
    );
    let mut scene = Scene::parse(&at_rest, Path::new(""))?.of_first_camera();
    let (figures, accel) = {
        let (scene, accel) = hierarchy_watched(&scene, control)?;
        (SensorFigures::of_sensor(&scene, &accel), accel)
    };
    let features = goal.map_or(Ok(String::new()), |goal| goal.feature_tables(&accel))?;
    if let Some(goal) = goal.filter(|_| !features.is_empty()) {
        scene = with_features(&scene, at_rest, &features, goal)?;
    }
    let figures = figures.ok_or_else(|| {
        Error::Usage("the camera of this sensor sees nothing of the laser's light; `lasertrace check` says more".to_owned())
    })?;
    let watch = |share| control.prepared(share);
    let planned =
        goal.map(|goal| GoalPath::new((&scene, &accel), &figures, goal, up.axis(), &watch));
    let mut planned = planned.transpose()?;
    let path = ScanPasses::over(&scene, &figures);
    let mut inputs = scene.inputs.to_vec();
    inputs.extend([part, sensor].map(Path::to_owned));
    let out = copies.write(out.into(), &inputs)?;
    let text = |path: &str| {
        let scan = format!("poses = {}\n{features}", quoted(path));
        text(SENSOR, &copies.name) + &scan
    };
    let draft = Draft {
        out,
        text: &text,
        control,
    };
    // The path over the part is checked without images.
    let simulation = match &mut planned {
        None => Simulation::geometry_only(&draft.write(&path.csv())?, accel)?,
        Some(planned) => {
            planned.refined(&scene, accel, &|csv: String| draft.write(&csv), control)?
        }
    };
    let file = draft.finish()?;
    let layers = path.deeper_than_range(&figures);
    let layers = layers.filter(|_| goal.is_none());
    let passes = planned.as_ref().map(|p| [p.path.passes.len(), 1]);
    Ok(InitialScene {
        frames: simulation.scene.scan.frames as usize,
        passes: passes.unwrap_or(path.passes),
        size_mm: path.size.to_array(),
        step_mm: goal.map_or(path.step, |goal| goal.spacing_mm),
        path: planned.map(GoalPath::summary),
        warnings: warnings((&scene, &simulation), &figures, unit.is_some(), layers),
        scene: file,
    })
}

/// Returns a scene with the tables of features after its text `at_rest`.
fn with_features(scene: &Scene, at_rest: String, features: &str, goal: &PathGoal) -> Result<Scene> {
    let lines_before = at_rest.lines().count() + 1;
    let scene = scene.reusing_part(at_rest + features);
    let scene = scene.map_err(|error| goal.in_feature_file(error, lines_before));
    scene.map(Scene::of_first_camera)
}

/// Scene and path before the last refinement, in files with the names of unfinished files.
struct Draft<'a> {
    out: &'a Path,
    /// Text of the scene with a path file.
    text: &'a dyn Fn(&str) -> String,
    control: &'a RunControl<'a>,
}

impl Draft<'_> {
    fn file(&self, name: &str) -> PathBuf {
        self.out.join(format!("{name}{PART}"))
    }

    /// Writes a path and returns the scene with it.
    fn write(&self, csv: &str) -> Result<Scene> {
        files::write_bytes(&self.file(PATH), csv.as_bytes())?;
        let text = (self.text)(&format!("{PATH}{PART}"));
        files::write_bytes(&self.file(SCENE), text.as_bytes())?;
        let scene = Scene::load_watched(&self.file(SCENE), &|_| self.control.check());
        scene.map(Scene::of_first_camera)
    }

    /// Writes the files with their final names and returns the scene file.
    fn finish(&self) -> Result<PathBuf> {
        let draft = self.file(PATH);
        let csv = fs::read(&draft).map_err(Error::io("read", &draft))?;
        let file = self.out.join(SCENE);
        files::write_bytes(&self.out.join(PATH), &csv)?;
        files::write_bytes(&file, (self.text)(PATH).as_bytes())?;
        files::remove(&draft)?;
        files::remove(&self.file(SCENE))?;
        Ok(file)
    }
}

/// Returns the warnings of a path, and of a part whose unit or depth does not fit the sensor.
fn warnings(
    (scene, simulation): (&Scene, &Simulation),
    figures: &SensorFigures,
    unit_is_given: bool,
    layers: Option<WarningKind>,
) -> Vec<Warning> {
    let frames = 0..simulation.scene.scan.frames;
    let PreScanCheck { warnings, .. } = foreseen_of(simulation, frames);
    let width = figures.width_at_center().filter(|_| !unit_is_given);
    let doubtful = width.and_then(|mm| unit_doubtful(scene, &simulation.accel, mm, UNIT_RATIO));
    let is_unit = |warning: &Warning| matches!(warning.reason, WarningKind::UnitDoubtful { .. });
    let foreseen = warnings
        .into_iter()
        .filter(|warning| doubtful.is_none() || !is_unit(warning));
    let of_part = doubtful.iter().cloned().chain(layers);
    of_part.map(Warning::from).chain(foreseen).collect()
}

/// Files that are copied to the folder.
struct Copies {
    /// Name of the part file.
    name: String,
    part: Vec<u8>,
    sensor: Vec<u8>,
    /// Files that the part file needs in its folder, by relative path.
    needed: Vec<(PathBuf, Vec<u8>)>,
}

impl Copies {
    fn of(part: &Path, sensor: &Path, control: &RunControl) -> Result<Copies> {
        let read = |path: &Path| mesh::read(path, &|_| control.check());
        let bytes = read(part)?;
        let names = mesh::files_needed(part, &bytes)?;
        let folder = part.parent().unwrap_or(Path::new(""));
        let needed = names.into_iter().map(|name| {
            let bytes = read(&folder.join(&name))?;
            Ok((name, bytes))
        });
        let name = part.file_name().and_then(|name| name.to_str());
        let name = name.filter(|name| ![SCENE, PATH, SENSOR].contains(name));
        let name = name.map(str::to_owned).ok_or_else(|| {
            Error::Usage(format!(
                "{}: the file of the part is copied with its name; expected a UTF-8 name other than {SCENE}, {PATH} and \
                 {SENSOR}; rename the file",
                printable::path(part)
            ))
        })?;
        Ok(Copies {
            name,
            part: bytes,
            sensor: input_file::read(sensor, LARGEST_TEXT, "the file of a sensor (TOML)")?,
            needed: needed.collect::<Result<_>>()?,
        })
    }

    /// Writes the copies and returns the folder. Errors: a scene or a path exists already, or a copy
    /// with other contents, unless `out` may replace it.
    fn write<'a>(&self, out: OutputFolder<'a>, inputs: &[PathBuf]) -> Result<&'a Path> {
        let needed = self.needed.iter().map(|(name, _)| name.to_string_lossy());
        let names: Vec<String> = [SCENE, PATH, SENSOR, &self.name]
            .map(str::to_owned)
            .into_iter()
            .chain(needed.map(Into::into))
            .collect();
        // The user may have changed a file since an earlier run wrote it. An interrupted run leaves
        // equal copies.
        let needed = self
            .needed
            .iter()
            .map(|(name, bytes)| (name.as_path(), bytes));
        let copies = [
            (Path::new(&self.name), &self.part),
            (Path::new(SENSOR), &self.sensor),
        ];
        let changed = |&(name, bytes): &(&Path, &Vec<u8>)| {
            let file = out.path.join(name);
            fs::metadata(&file).is_ok_and(|found| {
                !found.is_file()
                    || found.len() != bytes.len() as u64
                    || fs::read(&file).ok().as_ref() != Some(bytes)
            })
        };
        let written = [SCENE, PATH].map(Path::new).into_iter();
        let written = written.filter(|name| out.path.join(name).exists());
        let copied = copies.into_iter().chain(needed).filter(changed);
        let there = written.chain(copied.map(|(name, _)| name)).next();
        if let Some(name) = there.filter(|_| !out.force) {
            return Err(Error::Usage(format!(
                "{} is there already: name another folder",
                printable::path(&out.path.join(name))
            )));
        }
        let out = out.claim(inputs, &Names::of(names))?.path;
        for (name, bytes) in &self.needed {
            let file = out.join(name);
            files::create_folder(file.parent().unwrap_or(out))?;
            files::write_bytes(&file, bytes)?;
        }
        files::write_bytes(&out.join(&self.name), &self.part)?;
        files::write_bytes(&out.join(SENSOR), &self.sensor)?;
        Ok(out)
    }
}

/// Returns the absolute path of a file.
fn whole(path: &Path) -> Result<String> {
    let whole = path.canonicalize().map_err(Error::io("read", path))?;
    let text = whole.to_str().map(str::to_owned);
    text.ok_or_else(|| {
        Error::Usage(format!(
            "{}: the path is not UTF-8, and scene files contain UTF-8 paths only; rename the file or its folder, or copy it \
             to a folder with a UTF-8 path",
            printable::path(&whole)
        ))
    })
}

/// Passes along y over a part, adjacent and in layers.
struct ScanPasses {
    passes: [usize; 2],
    /// Size of the part in the world, mm.
    size: DVec3,
    /// Number of frames per pass.
    steps: usize,
    step: f64,
    /// Centre of the measuring range in the first frame, mm.
    first: DVec3,
    /// Distance between adjacent passes and between layers, mm.
    lateral_step_mm: f64,
    below: f64,
    rotation: DMat3,
    /// Centre of the measuring range in the head's frame.
    in_head: DVec3,
}

impl ScanPasses {
    fn over(scene: &Scene, figures: &SensorFigures) -> ScanPasses {
        let part = scene.bounds().moved(&scene.part_at_rest);
        let (size, center) = (part.size(), part.center());
        let [near, far] = figures.ends();
        let fields = figures.places.iter().map(|place| place.field_mm);
        let narrowest = fields
            .reduce(|a, b| [a[0].max(b[0]), a[1].min(b[1])])
            .unwrap_or_default();
        let (wide, deep) = (USED * (narrowest[1] - narrowest[0]), USED * (far - near));
        let count = |length: f64, of: f64| (length / of).ceil().max(1.0);
        let (beside, below) = (count(size.x, wide), count(size.z, deep));
        let column = figures.places[figures.places.len() / 2].um_per_px[0] * 1e-3;
        let step = column.max(size.y * beside * below / FRAMES);
        let of_range = DVec3::new((narrowest[0] + narrowest[1]) / 2.0, 0.0, (near + far) / 2.0);
        // The beam points down, and the line is along x.
        let world_from_laser = DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z);
        // Passes are distributed uniformly over the part. A single pass is at its centre.
        let first = center
            + DVec3::new(
                -(beside - 1.0) / 2.0 * size.x / beside,
                -size.y / 2.0,
                (below - 1.0) / 2.0 * size.z / below,
            );
        ScanPasses {
            passes: [beside as usize, below as usize],
            size,
            steps: (size.y / step).floor() as usize + 1,
            step,
            first,
            lateral_step_mm: size.x / beside,
            below: size.z / below,
            rotation: world_from_laser * scene.head_from_laser.rotation.transpose(),
            in_head: scene.head_from_laser.point(of_range),
        }
    }

    /// Returns the problem of a part that needs several layers.
    fn deeper_than_range(&self, figures: &SensorFigures) -> Option<WarningKind> {
        let [near, far] = figures.ends();
        let layers = self.passes[1];
        (layers > 1).then(|| WarningKind::DeeperThanRange {
            part_mm: self.size.z,
            range_mm: far - near,
            layers,
            lowered_mm: self.below * (layers - 1) as f64,
        })
    }

    fn csv(&self) -> String {
        let mut poses = Vec::new();
        for below in 0..self.passes[1] {
            for beside in 0..self.passes[0] {
                for step in 0..self.steps {
                    let by = DVec3::new(
                        self.lateral_step_mm * beside as f64,
                        self.step * step as f64,
                        -self.below * below as f64,
                    );
                    poses.push(Rigid {
                        rotation: self.rotation,
                        translation: self.first + by - self.rotation * self.in_head,
                    });
                }
            }
        }
        pose_table(poses)
    }
}

//! A first scene of a part under a sensor: the part as its file has it, and passes that bring all of it into the measuring range.

use super::output_folder::{Names, OutputFolder};
use super::ready::hierarchy_watched;
use super::sensor_figures::SensorFigures;
use super::{Control, files};
use crate::error::{Error, Result, printable};
use crate::math::{DMat3, DVec3, Rigid};
use crate::mesh::{self, UnitBy, unit_by};
use crate::scene::{Scene, Unit};
use glam::DQuat;
use serde::Serialize;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Share of the measuring range and of the field that passes use: what is left overlaps.
const USED: f64 = 0.9;
/// Frames of a first scan, unless the part is so small that its steps would be finer than the sensor's columns.
const FRAMES: f64 = 2000.0;

/// What was made.
#[derive(Debug, Clone, Serialize)]
pub struct Begun {
    /// The scene.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Of its path.
    pub frames: usize,
    /// How many ways along the part lie side by side, and how many layers of these one below the other.
    pub passes: [usize; 2],
    /// Of the part, mm.
    pub size_mm: [f64; 3],
    /// From one frame to the next, mm.
    pub step_mm: f64,
}

/// Writes `scene.toml` and the poses of its path, `path.csv`, to a folder. The sensor looks down along the part's z axis with its line
/// along x, and moves along y. `unit` is that of the part's file; `None`: mm, or what the file states.
///
/// # Errors
/// A part or a sensor that cannot be read; a camera that sees nothing of the laser's light; a file that is there already.
pub fn begin<'a>(
    part: &Path,
    sensor: &Path,
    unit: Option<Unit>,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<Begun> {
    let [part, sensor] = [part, sensor].map(|path| {
        let whole = path.canonicalize().map_err(Error::io("read", path))?;
        let text = whole.to_str().map(str::to_owned);
        text.ok_or_else(|| {
            Error::Usage(format!(
                "{}: a scene names files in UTF-8",
                printable::path(&whole)
            ))
        })
    });
    let (part, sensor) = (part?, sensor?);
    let file = Path::new(&part);
    let bytes = mesh::read(file, &|_| control.check())?;
    let unit = unit.or(match unit_by(file, &bytes)? {
        UnitBy::User => Some(Unit::Millimetre),
        UnitBy::Metres | UnitBy::File => None,
    });
    let unit = unit.map_or(String::new(), |unit| format!(", unit = \"{unit}\""));
    let quoted = |text: String| toml::Value::String(text).to_string();
    let text = format!(
        "seed = 1\nspeckle = true\nsensor = {}\n\n[part]\nmesh = {{ file = {}{unit} }}\nreflectance = 0.5\n\n[scan]\n",
        quoted(sensor),
        quoted(part)
    );
    let at_rest = format!("{text}frames = 1\nstep_mm = 0\ndirection = [0, 1, 0]\n");
    let scene = Scene::parse(&at_rest, Path::new(""))?;
    let figures = {
        let (scene, accel) = hierarchy_watched(&scene, control)?;
        SensorFigures::of_sensor(&scene, &accel)
    };
    let figures = figures.ok_or_else(|| {
        Error::Usage("the camera of this sensor sees nothing of the laser's light; `lasertrace check` says more".to_owned())
    })?;
    let path = Passes::over(&scene, &figures);
    let out = out.into();
    let file = out.path.join("scene.toml");
    // The user may have changed it since an earlier run wrote it.
    if file.exists() && !out.force {
        return Err(Error::Usage(format!(
            "{} is there already: name another folder",
            printable::path(&file)
        )));
    }
    let names = Names::of(["scene.toml", "path.csv"]);
    let out = out.claim(&scene.inputs, &names)?.path;
    files::write_bytes(&out.join("path.csv"), path.csv().as_bytes())?;
    files::write_bytes(&file, format!("{text}poses = \"path.csv\"\n").as_bytes())?;
    Ok(Begun {
        scene: file,
        frames: path.frames(),
        passes: path.passes,
        size_mm: scene.bounds().size().to_array(),
        step_mm: path.step,
    })
}

/// Ways along y over a part, side by side and one below the other.
struct Passes {
    passes: [usize; 2],
    /// Frames of a pass.
    steps: usize,
    step: f64,
    /// Of the first pass's middle: where the middle of the measuring range is, mm.
    first: DVec3,
    /// From one pass to the next beside it, and to that below.
    aside: f64,
    below: f64,
    rotation: DMat3,
    /// The middle of the measuring range in the head.
    in_head: DVec3,
}

impl Passes {
    fn over(scene: &Scene, figures: &SensorFigures) -> Passes {
        let part = scene.bounds();
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
        // The beam goes down, the line along x.
        let world_from_laser = DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z);
        // Spread evenly, a single one in the middle.
        let first = center
            + DVec3::new(
                -(beside - 1.0) / 2.0 * size.x / beside,
                -size.y / 2.0,
                (below - 1.0) / 2.0 * size.z / below,
            );
        Passes {
            passes: [beside as usize, below as usize],
            steps: (size.y / step).floor() as usize + 1,
            step,
            first,
            aside: size.x / beside,
            below: size.z / below,
            rotation: world_from_laser * scene.head_from_laser.rotation.transpose(),
            in_head: scene.head_from_laser.point(of_range),
        }
    }

    fn frames(&self) -> usize {
        self.steps * self.passes[0] * self.passes[1]
    }

    fn csv(&self) -> String {
        let turn = DQuat::from_mat3(&self.rotation).normalize();
        let [w, x, y, z] = [turn.w, turn.x, turn.y, turn.z];
        let mut text = "x_mm,y_mm,z_mm,qw,qx,qy,qz\n".to_owned();
        for below in 0..self.passes[1] {
            for beside in 0..self.passes[0] {
                for step in 0..self.steps {
                    let by = DVec3::new(
                        self.aside * beside as f64,
                        self.step * step as f64,
                        -self.below * below as f64,
                    );
                    let pose = Rigid {
                        rotation: self.rotation,
                        translation: self.first + by - self.rotation * self.in_head,
                    };
                    let at = pose.translation;
                    let _ = writeln!(text, "{:.6},{:.6},{:.6},{w},{x},{y},{z}", at.x, at.y, at.z);
                }
            }
        }
        text
    }
}

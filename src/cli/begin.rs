use super::{ForceArguments, Output, STOP, show};
use crate::error::printable::path;
use crate::error::{Error, Result};
use crate::inspect::features::FeatureResult;
use crate::run::{
    InitialScene, PathGoal, PathPurpose, PathSummary, RunControl, Up, begin, warning_lines,
};
use crate::scene::Unit;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Mesh of the part (STL, OBJ, PLY, glTF, 3MF)
    part: PathBuf,
    /// Sensor file (TOML)
    sensor: PathBuf,
    /// Length unit of the mesh file [default: the unit stated in the file, otherwise mm]
    #[arg(long, value_enum)]
    unit: Option<Unit>,
    /// Axis of the mesh file that points towards the sensor
    #[arg(long, value_enum, default_value = "z", allow_hyphen_values = true)]
    up: Up,
    /// Plan a short path that measures the features of a TOML file with [[feature]] tables; without
    /// FILE, the largest planes, cylinders, spheres and cones of the part, with ± the tolerance
    #[arg(long, value_name = "FILE")]
    features: Option<Option<PathBuf>>,
    /// Plan a short path over the complete surface, for points with an expanded uncertainty of at
    /// most MM; with --features, the tolerance of the features [default: 0.1]
    #[arg(long, value_name = "MM", value_parser = positive)]
    tolerance: Option<f64>,
    /// Distance between frames of a planned path, µm
    #[arg(long, value_name = "UM", default_value_t = 100.0, value_parser = positive)]
    spacing: f64,
    /// Largest angle between the beam of a planned path and the axis that points up, degrees; 180
    /// allows all directions
    #[arg(long, value_name = "DEG", default_value_t = 45.0, value_parser = tilt)]
    max_tilt: f64,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: &Arguments, output: &Output) -> Result<()> {
    let building = output.share("prepared");
    let control = RunControl {
        progress: &|_| {},
        setup_progress: Some(&|share| show(&building, share)),
        notice: None,
        stop: &STOP,
    };
    let Arguments {
        part,
        sensor,
        unit,
        up,
        features,
        tolerance,
        spacing,
        max_tilt,
        output: folder,
        force,
    } = arguments;
    let purpose = match (features, tolerance) {
        (Some(None), tolerance) => Some(PathPurpose::Faces(tolerance.unwrap_or(0.1))),
        (Some(Some(file)), None) => Some(PathPurpose::Features(file.clone())),
        (Some(Some(file)), Some(_)) => {
            return Err(Error::Usage(format!(
                "--tolerance with --features {}: the file has the tolerances; expected one of them",
                path(file)
            )));
        }
        (None, tolerance) => tolerance.map(PathPurpose::Surface),
    };
    let goal = purpose.map(|purpose| PathGoal {
        purpose,
        spacing_mm: spacing * 1e-3,
        max_tilt_deg: *max_tilt,
    });
    let folder = force.folder(folder);
    let begun = begin(part, sensor, (*unit, *up), goal.as_ref(), folder, &control);
    building.finish_and_clear();
    let begun = begun?;
    let text = match &begun.path {
        Some(plan) => planned(&begun, plan),
        None => passes(&begun),
    };
    let text = format!(
        "{}{text}scene:  {}\nLook at it with lasertrace check, and then run lasertrace scan.\n",
        warning_lines(&begun.warnings),
        path(&begun.scene)
    );
    output.result(&begun, &text)
}

fn positive(text: &str) -> std::result::Result<f64, String> {
    let value = text
        .parse()
        .ok()
        .filter(|v: &f64| *v > 0.0 && v.is_finite());
    value.ok_or_else(|| "expected a finite number > 0".to_owned())
}

fn tilt(text: &str) -> std::result::Result<f64, String> {
    let value = text.parse().ok().filter(|v| (0.0..=180.0).contains(v));
    value.ok_or_else(|| "expected an angle from 0 to 180".to_owned())
}

fn passes(begun: &InitialScene) -> String {
    let [x, y, z] = begun.size_mm;
    let [across, down] = begun.passes;
    format!(
        "part of {x:.4} × {y:.4} × {z:.4} mm, seen from above; {across} × {down} passes across and along the range; {} frames, \
         {:.4} mm apart\n",
        begun.frames, begun.step_mm
    )
}

/// Returns the lines of a planned path.
fn planned(begun: &InitialScene, path: &PathSummary) -> String {
    let mut text = format!(
        "{} passes, {} frames, path of {:.1} mm with the links between passes\n",
        begun.passes[0], begun.frames, path.length_mm
    );
    for target in &path.targets {
        let name = target.feature.as_deref().unwrap_or("surface");
        text += &format!(
            "{name}: {:.2} of {:.2} mm² measured\n",
            target.measured_mm2, target.area_mm2
        );
        for hidden in &target.hidden {
            text += &format!("  {:.2} mm² {}\n", hidden.area_mm2, hidden.reason);
        }
    }
    text += &path.features.iter().map(predicted).collect::<String>();
    if let Some(fraction) = path.sufficient_fraction {
        text += &format!(
            "{:.1} % of the points are expected to have the required uncertainty\n",
            100.0 * fraction
        );
    }
    text
}

/// Returns the lines of a feature with its predicted uncertainty.
fn predicted(feature: &FeatureResult) -> String {
    if let Some(problem) = &feature.problem {
        return format!("{}: no value. {problem}\n", feature.name);
    }
    let of = |q: &crate::inspect::features::Quantity| {
        let (name, unit) = q.name.rsplit_once('_').unwrap_or((q.name, ""));
        let proven = q.tolerance.map_or(String::new(), |[lower, upper]| {
            let is_proven = q.smallest_tolerance <= upper - lower;
            let verdict = if is_proven {
                "can be proven"
            } else {
                "cannot be proven"
            };
            format!(", tolerance of {:.4} {unit} {verdict}", upper - lower)
        });
        format!(
            "{} {name}: {} points, U {:.4} {unit} expected{proven}\n",
            feature.name, feature.points, q.expanded_uncertainty
        )
    };
    feature.quantities.iter().map(of).collect()
}

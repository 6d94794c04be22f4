use super::{ForceArguments, Output, STOP, show};
use crate::error::Result;
use crate::error::printable::path;
use crate::run::{RunControl, Up, begin, warning_lines};
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
        stop: &STOP,
    };
    let Arguments {
        part,
        sensor,
        unit,
        up,
        output: folder,
        force,
    } = arguments;
    let begun = begin(part, sensor, (*unit, *up), force.folder(folder), &control);
    building.finish_and_clear();
    let begun = begun?;
    let [x, y, z] = begun.size_mm;
    let [beside, below] = begun.passes;
    let text = format!(
        "{}A part of {x:.4} × {y:.4} × {z:.4} mm, seen from above in {beside} × {below} passes, side by side and one below the other: {} frames, \
         {:.4} mm apart.\nscene:  {}\nLook at it with lasertrace check, and then run lasertrace scan.\n",
        warning_lines(&begun.warnings),
        begun.frames,
        begun.step_mm,
        path(&begun.scene)
    );
    output.result(&begun, &text)
}

//! The sensors of `sensors/` measured as data sheets measure them. Writes `sensors.md` and a picture of each to a folder.
//!
//!     cargo run --release --example sensors -- docs

use lasertrace::run::RunControl;
use lasertrace::scene::Scene;
use lasertrace::study::sheet;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

static STOP: AtomicBool = AtomicBool::new(false);

const LEAD: &str = "# Sensors, as data sheets measure them

Made by `cargo run --release --example sensors -- docs`; `lasertrace uncertainty sensors/NAME.toml -o DIR` makes one of them. A matt plane that
reflects half of the light, square to the beam, stands at nine distances over the measuring range. Standard deviations of heights of single points,
found and as stated of each point from optics and image alone:

- *repeatability*: the same place again, nothing moved: shot noise, read noise, rounding. Speckle stays.
- *place to place*: the plane moved in itself, speckle in it; *closed form*: 0.3905·√(hσ)·C in height, and the noise (round pupil, pixels finer than grains).
- *n_c*: columns within which errors are alike. Means over 100 columns fall as √(n_c/100), over 10 profiles of different places as √(1/10).
- *linearity*: indicated less true height, mean over all columns and 20 places, ± two standard uncertainties. The sensor is calibrated exactly: what is
  left is the finder's and the optics' own.
- *edge*: distance from 10 to 90 % of a step along the line that is low compared with the line's width, without speckle and noise; mean over 16 positions of the step within a column.

A maker's sheet prints the first of these, often of a mean over many points or profiles; points of a part that moves scatter by the second.
";

fn main() {
    let folder = PathBuf::from(std::env::args().nth(1).expect("a folder to write to"));
    let sensors = Path::new(env!("CARGO_MANIFEST_DIR")).join("sensors");
    let files = std::fs::read_dir(&sensors).expect("the folder of sensors");
    let files = files.map(|file| file.expect("a file of it").path());
    let mut files: Vec<PathBuf> = files
        .filter(|file| file.extension().is_some_and(|kind| kind == "toml"))
        .collect();
    files.sort_by_key(|file| field(file));
    let mut page = LEAD.to_owned();
    for file in files {
        let name = file
            .file_stem()
            .expect("a name")
            .to_string_lossy()
            .into_owned();
        eprintln!("{name}");
        let scene = Scene::of_sensor(&file)
            .expect("a sensor")
            .expect("a sensor");
        let control = RunControl {
            progress: &|_| {},
            setup_progress: None,
            stop: &STOP,
        };
        let out = std::env::temp_dir().join(format!("lasertrace-{}-{name}", std::process::id()));
        let found = sheet(scene, &out, &control).expect("a sensor that can be measured");
        let picture = format!("sensor-{name}.svg");
        std::fs::copy(&found.picture, folder.join(&picture)).expect("a folder to write to");
        std::fs::remove_dir_all(&out).expect("its own folder");
        let [first, _] = found.headline();
        let _ = write!(
            page,
            "\n## {name}\n\n{first}.\n\n![scatter, linearity, resolution and correlation over the range]({picture})\n\n\
             | mm | µm/px along, in height | repeatability, µm: found | stated | place to place: found | stated | closed form | n_c: found | stated \
             | mean of 100 columns: found | stated | mean of 10 profiles: found | stated | linearity, µm | ± | edge, µm |\n\
             |---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n"
        );
        for row in found.rows() {
            let _ = writeln!(
                page,
                "| {} | {}, {} | {} |",
                row[0],
                row[1],
                row[2],
                row[3..].join(" | ")
            );
        }
    }
    std::fs::write(folder.join("sensors.md"), page).expect("a folder to write to");
}

/// Millimetres in a name as "generic-20mm-405nm".
fn field(file: &Path) -> u64 {
    let name = file.to_string_lossy();
    let digits = name.split("mm").next().unwrap_or("").chars().rev();
    let digits: String = digits.take_while(char::is_ascii_digit).collect();
    digits
        .chars()
        .rev()
        .collect::<String>()
        .parse()
        .unwrap_or(0)
}

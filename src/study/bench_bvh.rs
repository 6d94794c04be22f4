//! The race of hierarchies on a mesh file.

use crate::error::{Result, printable};
use crate::mesh::Mesh;
use crate::race::{self, Effort, Race};
use crate::report::race_plot::plot;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::{Control, files};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// `bench.json`.
#[derive(Debug, Serialize)]
pub struct BvhBench {
    /// The mesh file.
    #[serde(serialize_with = "printable::in_json")]
    pub mesh: PathBuf,
    /// What each racer did.
    #[serde(flatten)]
    pub race: Race,
    /// Where this was written.
    #[serde(serialize_with = "printable::in_json")]
    pub json: PathBuf,
    /// Where the picture was written.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// Races on `mesh`, read from `path`, and writes `bench.json` and `bench.svg` to
/// `out`; `forecast` is told how many seconds it takes at most, before it starts.
pub fn bench_bvh<'a>(
    path: &Path,
    mesh: &Mesh,
    effort: Effort,
    out: impl Into<OutputFolder<'a>>,
    forecast: &dyn Fn(f64),
    control: &Control,
) -> Result<BvhBench> {
    let names = Names::of(["bench.json", "bench.svg"]);
    let out = out.into().claim(&[path.to_owned()], &names)?.path;
    let done = AtomicU64::new(0);
    let step = || {
        (control.progress)(1 + done.fetch_add(1, Ordering::Relaxed));
        control.check()
    };
    let bench = BvhBench {
        mesh: path.to_owned(),
        race: race::race(mesh, effort, forecast, &step)?,
        json: out.join("bench.json"),
        picture: out.join("bench.svg"),
    };
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let svg = plot(&bench.race, &name);
    files::write_bytes(&bench.picture, svg.as_bytes())?;
    files::write_json(&bench.json, &bench)?;
    Ok(bench)
}

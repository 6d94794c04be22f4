//! Benchmark of acceleration structures on a mesh file.

use crate::error::{Result, printable};
use crate::mesh::Mesh;
use crate::race::{self, BackendBenchmark, BenchmarkBudget};
use crate::report::race_plot::plot;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::{RunControl, files};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Content of `bench.json`.
#[derive(Debug, Serialize)]
pub struct BvhBench {
    /// Path of the mesh file.
    #[serde(serialize_with = "printable::in_json")]
    pub mesh: PathBuf,
    /// Results of the race.
    #[serde(flatten)]
    pub race: BackendBenchmark,
    /// Path of the JSON file.
    #[serde(serialize_with = "printable::in_json")]
    pub json: PathBuf,
    /// Path of the plot.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// Runs the race on `mesh`, read from `path`, and writes `bench.json` and `bench.svg` to `out`.
/// Before the race, `forecast` is called with the maximum duration in seconds.
pub fn bench_bvh<'a>(
    path: &Path,
    mesh: &Mesh,
    effort: BenchmarkBudget,
    out: impl Into<OutputFolder<'a>>,
    forecast: &dyn Fn(f64),
    control: &RunControl,
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

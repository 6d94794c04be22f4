//! Command line; each command has its own file.

mod accept;
mod begin;
mod bench_bvh;
mod calibrate;
mod chart;
mod check;
mod compare;
mod dataset;
mod deform;
mod emva;
mod error_output;
mod fit;
#[cfg(feature = "service")]
mod job;
mod manual;
mod merge;
mod peaks;
#[cfg(feature = "service")]
mod rays;
mod refused;
mod render;
mod scan;
#[cfg(feature = "service")]
mod serve;
mod signals;
mod speckle;
mod sweep;
mod threads;
mod uncertainty;
#[cfg(feature = "service")]
mod view;
mod wave;

pub use refused::Noting;

use crate::accel::Backend;
use crate::error::{Error, Result, printable};
use crate::run::{OutputFolder, TraceMode};
use clap::{Parser, Subcommand};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{IsTerminal, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

static STOP: AtomicBool = AtomicBool::new(false);

#[derive(Parser)]
#[command(
    version = version(),
    about,
    after_help = "Exit codes: 0 done, 64 usage, 65 bad input data or scene, \
    70 internal, 74 input/output, 75 temporary (disk or memory full, interrupted): run again,\n\
    a scan with --resume."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Number of threads, limited by the number available [default: all available]
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Do not show a progress bar
    #[arg(long, global = true)]
    quiet: bool,
    /// Print one JSON object on stdout instead of text, also for errors
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Subcommand)]
enum Command {
    /// Create an initial scene for a part and a sensor, with a scan path that covers the entire
    /// part
    Begin(begin::Arguments),
    /// Validate a scene; print the resolved scene, mesh report and plan
    Check(check::Arguments),
    /// Compare a simulated scan with a height map that a sensor recorded: scatter and correlation
    Compare(compare::Arguments),
    /// Fit the keys of a sensor to recordings: height maps or images of the line
    Fit(fit::Arguments),
    /// Render one frame: sensor counts (PNG), irradiance and ground truth (EXR)
    Render(render::Arguments),
    /// Run a complete scan: point cloud, deviation from CAD, report
    Scan(scan::Arguments),
    /// Combine the frames of all shards of a scan (scan --shard) into one result
    Merge(merge::Arguments),
    /// Create a training data set: frames of a randomised scene with ground truth
    Dataset(dataset::Arguments),
    /// Scan a scene repeatedly with varied values; write one table and plots
    Sweep(sweep::Arguments),
    /// Calibrate camera and laser plane from simulated views of a target
    Calibrate(calibrate::Arguments),
    /// Chart accuracy against speed for each combination of methods, on frames of the scene
    Chart(chart::Arguments),
    /// Generate a speckle pattern and compare its statistics with theory
    Speckle(speckle::Arguments),
    /// Run the wave-optics reference for standard motions and line widths, or for one patch of a
    /// scene
    Wave(wave::Arguments),
    /// Chart the errors of each peak finder, or apply all of them to an image
    Peaks(peaks::Arguments),
    /// Show a scene in the browser and update the image while values are changed
    #[cfg(feature = "service")]
    View(view::Arguments),
    /// Compare predicted uncertainties with Monte Carlo results, or measure the data-sheet figures
    /// of a sensor
    Uncertainty(uncertainty::Arguments),
    /// Predict the acceptance test of a sensor: probing form and size errors, sphere distance,
    /// flatness, linearity
    Accept(accept::Arguments),
    /// Write an actual part: a nominal mesh with stated dents, bends, shifted faces and wear
    Deform(deform::Arguments),
    /// Simulate image sets of a sensor for evaluation by the EMVA 1288 tool
    Emva(emva::Arguments),
    /// Run jobs submitted over HTTP: scenes and meshes in, result files out
    #[cfg(feature = "service")]
    Serve(serve::Arguments),
    /// Execute the service job in the current folder
    #[cfg(feature = "service")]
    #[command(hide = true)]
    Job,
    /// Cast the rays of a file against a mesh
    #[cfg(feature = "service")]
    #[command(hide = true)]
    Rays(rays::Arguments),
    /// Compare Embree with Rust ray-tracing crates on a mesh: speed, memory, missed rays
    BenchBvh(bench_bvh::Arguments),
    /// Print the JSON Schema of scene files or of sensor files
    Schema {
        /// Print the schema of sensor files
        #[arg(long)]
        sensor: bool,
    },
    /// Print a completion script for a shell
    Completions(manual::Completions),
    /// Print the manual page of the program or of a command
    Man(manual::Man),
}

/// Returns the versions of the program and of its ray-tracing backend.
fn version() -> &'static str {
    static VERSION: LazyLock<String> = LazyLock::new(|| {
        let program = env!("CARGO_PKG_VERSION");
        format!("{program} ({})", Backend::default().version())
    });
    &VERSION
}

#[derive(clap::Args)]
struct SceneArguments {
    /// Scene file (TOML)
    scene: PathBuf,
    /// Random seed [default: the seed of the scene]
    #[arg(long, value_name = "S")]
    seed: Option<u64>,
    /// Number of the camera, for a scene of several cameras [default: all cameras in scan and check]
    #[arg(long, value_name = "N")]
    camera: Option<u32>,
    #[command(flatten)]
    accel: AccelArguments,
}

impl SceneArguments {
    fn load(&self, output: &Output) -> Result<crate::scene::Scene> {
        let bar = output.share("of the mesh read");
        let scene = crate::scene::Scene::load_watched(&self.scene, &|share| {
            show(&bar, share);
            match STOP.load(Ordering::Relaxed) {
                true => Err(Error::Interrupted),
                false => Ok(()),
            }
        });
        self.changed(scene?)
    }

    /// Returns the given options as arguments of a command.
    fn options(&self) -> String {
        let mut text = String::new();
        if let Some(seed) = self.seed {
            text += &format!(" --seed {seed}");
        }
        if let Some(camera) = self.camera {
            text += &format!(" --camera {camera}");
        }
        if let Some(accel) = self.accel.accel {
            let name = clap::ValueEnum::to_possible_value(&accel);
            text += &format!(
                " --accel {}",
                name.expect("no variant is skipped").get_name()
            );
        }
        text
    }

    /// Returns the scene with the values of the command line applied. Errors: no camera has the given
    /// number.
    fn changed(&self, scene: crate::scene::Scene) -> Result<crate::scene::Scene> {
        let set = |scene: crate::scene::Scene| crate::scene::Scene {
            seed: self.seed.unwrap_or(scene.seed),
            accel: self.accel.accel.unwrap_or(scene.accel),
            ..scene
        };
        let mut scene = set(scene);
        scene.cameras = scene.cameras.iter().cloned().map(set).collect();
        match self.camera {
            Some(number) => scene.of_camera_number(number),
            None => Ok(scene),
        }
    }
}

#[derive(clap::Args)]
struct AccelArguments {
    /// Ray-tracing backend [default: model.ray_backend of the scene]
    #[arg(long, value_enum)]
    accel: Option<Backend>,
}

#[derive(clap::Args)]
struct ForceArguments {
    /// Write to a non-empty folder; existing files with equal names are replaced, except inputs
    #[arg(long)]
    force: bool,
}

impl ForceArguments {
    fn folder<'a>(&self, path: &'a Path) -> OutputFolder<'a> {
        OutputFolder {
            path,
            force: self.force,
        }
    }
}

#[derive(clap::Args)]
struct CoverageArguments {
    /// Trace all samples, including those without light; slower, with identical results
    #[arg(long)]
    exhaustive: bool,
}

impl CoverageArguments {
    fn coverage(&self) -> TraceMode {
        match self.exhaustive {
            true => TraceMode::Exhaustive,
            false => TraceMode::Footprint,
        }
    }
}

/// Output options common to all commands.
struct Output {
    quiet: bool,
    json: bool,
}

impl Output {
    /// Creates a progress bar, visible if stderr is a terminal.
    fn progress(&self, steps: u64, of: &str) -> ProgressBar {
        let bar = self.bar(steps, of, &format!("{{pos}}/{{len}} {of}, {{eta}} left"));
        #[cfg(feature = "service")]
        job::follow(&bar, of);
        bar
    }

    /// Creates a progress bar for a fraction from 0 to 1, to be updated with `show`.
    fn share(&self, of: &str) -> ProgressBar {
        let thousandths = format!("thousandths {of}");
        let bar = self.bar(
            1000,
            &thousandths,
            &format!("{{percent}} % {of}, {{eta}} left"),
        );
        #[cfg(feature = "service")]
        job::follow(&bar, &thousandths);
        bar
    }

    fn bar(&self, steps: u64, of: &str, text: &str) -> ProgressBar {
        let bar = ProgressBar::new(steps);
        let terminal = std::io::stderr().is_terminal();
        if self.quiet || !terminal {
            bar.set_draw_target(ProgressDrawTarget::hidden());
        }
        if !(self.quiet || self.json || terminal) {
            say_now_and_then(&bar, of);
        }
        let style = ProgressStyle::with_template(&format!("{{bar:40}} {text}"));
        bar.with_style(style.expect("the template is valid"))
    }

    /// Prints a line on stderr unless `--quiet` is set.
    fn say(&self, text: &str) {
        if !self.quiet {
            let _ = writeln!(std::io::stderr(), "{text}");
        }
    }

    /// Prints the result on stdout: `value` as JSON, or `text`.
    fn result(&self, value: &impl serde::Serialize, text: &str) -> Result<()> {
        let text = match self.json {
            true => printable::json(&serde_json::to_string(value).expect("results are JSON")),
            false => printable::lines(text.trim_end()),
        };
        match writeln!(std::io::stdout(), "{text}") {
            // A reader may close the pipe early. The output files are complete.
            Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
            result => result.map_err(Error::io("write to", "stdout".as_ref())),
        }
    }
}

/// Interval between two lines of [`say_now_and_then`].
const SAID_EVERY: Duration = Duration::from_secs(30);

/// Prints the position of a progress bar periodically until it is finished, for log files.
fn say_now_and_then(bar: &ProgressBar, of: &str) {
    let (bar, of) = (bar.downgrade(), of.to_owned());
    let lines = move || {
        loop {
            thread::sleep(SAID_EVERY);
            let Some(bar) = bar.upgrade().filter(|bar| !bar.is_finished()) else {
                return;
            };
            say(&format!(
                "{} of {} {of}",
                bar.position(),
                bar.length().unwrap_or(0)
            ));
        }
    };
    // If no thread can be started, the command continues without these lines.
    let _ = thread::Builder::new()
        .name("progress".to_owned())
        .spawn(lines);
}

/// Sets a progress bar to a fraction from 0 to 1; at 1 the bar is removed.
fn show(bar: &ProgressBar, share: f64) {
    bar.set_position((1e3 * share) as u64);
    if share >= 1.0 {
        bar.finish_and_clear();
    }
}

/// Parses the arguments, runs the command and returns the exit code.
pub fn run() -> u8 {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) if error.use_stderr() => {
            // Repeats the parse error with arguments that are safe to print.
            let shown = std::env::args_os().map(|text| printable::short(&text.to_string_lossy()));
            let shown = Cli::try_parse_from(shown).err().unwrap_or(error);
            error_output::print_usage_error(&shown);
            return 64;
        }
        Err(help) => {
            // Help and version are not errors; they go to stdout.
            let _ = help.print();
            return 0;
        }
    };
    #[cfg(feature = "service")]
    if matches!(cli.command, Command::Job) {
        return job::run();
    }
    exit_code(&dispatch(cli))
}

/// Runs the command and reports its errors. `Err(None)` is an internal error of the program.
fn dispatch(cli: Cli) -> std::result::Result<(), Option<Error>> {
    let complaints = error_output::ErrorPrinter {
        json: cli.json,
        retry: match &cli.command {
            Command::Scan(scan) if !scan.is_shard() => error_output::Again::Resumes,
            Command::Dataset(_) | Command::Sweep(_) => error_output::Again::GoesOn,
            _ => error_output::Again::StartsAnew,
        },
    };
    // The panic message has already been printed on stderr.
    match catch_unwind(AssertUnwindSafe(|| execute(cli, complaints))) {
        Ok(Ok(())) => Ok(()),
        Ok(Err(error)) => {
            complaints.say(&error);
            Err(Some(error))
        }
        Err(_) => {
            say("this is a fault of the program; please report it with the lines above");
            Err(None)
        }
    }
}

fn exit_code(done: &std::result::Result<(), Option<Error>>) -> u8 {
    match done {
        Ok(()) => 0,
        Err(Some(error)) => error.exit_code(),
        Err(None) => 70,
    }
}

/// Prints a line on stderr.
fn say(text: &str) {
    // A closed stderr must not hide the exit code.
    let _ = writeln!(std::io::stderr(), "lasertrace: {}", printable::line(text));
}

fn execute(cli: Cli, complaints: error_output::ErrorPrinter) -> Result<()> {
    signals::listen(complaints)?;
    let output = Output {
        quiet: cli.quiet,
        json: cli.json,
    };
    let (pool, cut) = threads::pool(cli.threads)?;
    if let Some(cut) = cut.filter(|_| !cli.quiet) {
        say(&cut);
    }
    // The view waits for requests outside the thread pool and uses the pool for its computations.
    #[cfg(feature = "service")]
    if let Command::View(arguments) = cli.command {
        return view::run(arguments, &output, pool);
    }
    pool.install(|| match cli.command {
        Command::Begin(arguments) => begin::run(&arguments, &output),
        Command::Check(arguments) => check::run(arguments, &output),
        Command::Render(arguments) => render::run(arguments, &output),
        Command::Scan(arguments) => scan::run(arguments, &output),
        Command::Merge(arguments) => merge::run(arguments, &output),
        Command::Dataset(arguments) => dataset::run(arguments, &output),
        Command::Sweep(arguments) => sweep::run(arguments, &output),
        Command::Calibrate(arguments) => calibrate::run(arguments, &output),
        Command::Chart(arguments) => chart::run(arguments, &output),
        Command::Speckle(arguments) => speckle::run(arguments, &output),
        Command::Wave(arguments) => wave::run(arguments, &output),
        Command::Peaks(arguments) => peaks::run(arguments, &output),
        #[cfg(feature = "service")]
        Command::View(_) => unreachable!("it was run above"),
        Command::Uncertainty(arguments) => uncertainty::run(arguments, &output),
        Command::Accept(arguments) => accept::run(arguments, &output),
        Command::Compare(arguments) => compare::run(&arguments, &output),
        Command::Fit(arguments) => fit::run(&arguments, &output),
        Command::Deform(arguments) => deform::run(&arguments, &output),
        Command::Emva(arguments) => emva::run(arguments, &output),
        Command::BenchBvh(arguments) => bench_bvh::run(arguments, &output),
        #[cfg(feature = "service")]
        Command::Serve(arguments) => serve::run(arguments, &output),
        #[cfg(feature = "service")]
        Command::Job => unreachable!("a job is no command of another"),
        #[cfg(feature = "service")]
        Command::Rays(arguments) => rays::run(arguments, &output),
        Command::Completions(arguments) => manual::completions(arguments, &output),
        Command::Man(arguments) => manual::man(arguments, &output),
        Command::Schema { sensor } => {
            let schema = match sensor {
                true => crate::scene::sensor_schema(),
                false => crate::scene::schema(),
            };
            let value: serde_json::Value =
                serde_json::from_str(&schema).expect("the schema is JSON");
            output.result(&value, &schema)
        }
    })
}

//! Rays and frames a second through the Python package, over those of the core: medians of
//! pairs in turn with a Python process, on one thread and on all. Answers are compared.
//!
//!     bindings/python/bench.sh

extern crate lasertrace;

#[path = "../../../benches/pairs/mod.rs"]
mod pairs;
#[path = "../../../benches/pairs/subject.rs"]
mod subject;

use lasertrace::accel::{Accel, SurfacePoint};
use lasertrace::{Scene, Simulation};
use pairs::{print_ratio, seconds};
use rayon::prelude::*;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use subject::{FRAMES, PAIRS, RAYS, rays, scene_path};

/// The program bench_laps.py.
struct Python {
    process: Child,
    asks: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Python {
    fn start(python: &str, folder: &Path, first: u32, threads: usize) -> Python {
        let program = Path::new(env!("CARGO_MANIFEST_DIR")).join("bench_laps.py");
        let mut process = Command::new(python)
            .arg(program)
            .args([folder, &scene_path()])
            .args([first as usize, FRAMES as usize, threads].map(|number| number.to_string()))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let asks = process.stdin.take().unwrap();
        let answers = BufReader::new(process.stdout.take().unwrap());
        let mut python = Python {
            process,
            asks,
            answers,
        };
        assert_eq!(python.line(), "ready");
        python
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        self.answers.read_line(&mut line).unwrap();
        line.trim_end().to_owned()
    }

    /// Seconds that it takes for what is asked.
    fn seconds(&mut self, what: &str) -> f64 {
        writeln!(self.asks, "{what}").unwrap();
        self.line().parse().unwrap()
    }

    fn end(mut self) {
        drop(self.asks);
        assert!(self.process.wait().unwrap().success());
    }
}

fn write(folder: &Path, name: &str, numbers: impl Iterator<Item = Vec<u8>>) {
    std::fs::write(folder.join(name), numbers.collect::<Vec<_>>().concat()).unwrap();
}

fn compare(python: &str, folder: &Path, threads: usize) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
    let pool = pool.build().unwrap();
    let scene = Scene::load(&scene_path()).unwrap();
    let accel = pool.install(|| Accel::build(&scene.mesh, threads)).unwrap();
    let simulation = pool.install(|| Simulation::new(&scene)).unwrap();
    let rays = rays(&accel);
    let bytes = |p: lasertrace::math::DVec3| p.to_array().map(f64::to_ne_bytes).concat();
    write(
        folder,
        "vertices",
        scene.mesh.positions.iter().map(|&p| bytes(p)),
    );
    let corners = scene.mesh.triangles.as_flattened().iter();
    write(folder, "triangles", corners.map(|i| i.to_ne_bytes().into()));
    let both = rays
        .iter()
        .map(|ray| [ray.origin, ray.direction].map(bytes).concat());
    write(folder, "rays", both);

    let first = scene.scan.frames / 2;
    let mut process = Python::start(python, folder, first, threads);
    let mut hits = vec![SurfacePoint::MISS; RAYS];
    for (what, how) in [("cast", ""), ("into", " into one array")] {
        let name = format!("rays a second through Python{how} over the core's, {threads} threads");
        print_ratio(&name, PAIRS, |_| {
            let cast = || accel.closest_hits(|i| rays[i], &mut hits).unwrap();
            let core = seconds(|| pool.install(cast));
            core / process.seconds(what)
        });
    }
    let mut frames = Vec::new();
    let name = format!("frames a second through Python over the core's, {threads} threads");
    print_ratio(&name, PAIRS, |_| {
        let numbers = (first..first + FRAMES).into_par_iter();
        let core = seconds(|| {
            let taken = || numbers.map(|k| simulation.take(k));
            frames = pool.install(|| taken().collect::<Vec<_>>());
        });
        core / process.seconds("frames")
    });
    process.end();
    let images = frames
        .into_iter()
        .map(|(image, ..)| image.unwrap().to_rows());
    let images = images.flatten().flat_map(u16::to_ne_bytes);
    assert!(images.eq(std::fs::read(folder.join("images")).unwrap()));
    let hits = hits.iter().flat_map(|hit| {
        let numbers = [&[hit.distance], &hit.point[..], &hit.barycentric].concat();
        let numbers = numbers.into_iter().flat_map(f64::to_ne_bytes);
        numbers.chain(
            [hit.triangle, hit.instance]
                .into_iter()
                .flat_map(u32::to_ne_bytes),
        )
    });
    assert!(hits.eq(std::fs::read(folder.join("hits")).unwrap()));
}

fn main() {
    let Ok(python) = std::env::var("LASERTRACE_PYTHON") else {
        println!(
            "SKIPPED: LASERTRACE_PYTHON names no Python with the package: bindings/python/bench.sh"
        );
        return;
    };
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("through_python");
    std::fs::create_dir_all(&folder).unwrap();
    for threads in [1, std::thread::available_parallelism().unwrap().get()] {
        compare(&python, &folder, threads);
    }
}

//! Comparison of ray-tracing crates: Embree and the BVH in Rust against other crates, with one mesh
//! and one set of f32 rays. It requires the cargo feature `race`, so the other crates are not
//! dependencies of the program.

pub(crate) mod aimed;
mod forecast;
mod laps;
pub mod racers;
mod rays;
pub(crate) mod table;

pub use table::table;

use crate::accel::embree_race::FlatHit;
use crate::accel::{Accel, Backend, brute};
use crate::error::Result;
use crate::mesh::Mesh;
use aimed::{AimedRays, MissCount};
use laps::{RayAnswers, all_threads, one_thread};
use peak_alloc::PeakAlloc;
use racers::{BackendEntry, BenchBackend};
use rayon::prelude::*;
use rays::{RaySet, exact};
use serde::Serialize;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Counter of Rust allocations. It counts only if the program uses `PeakAlloc` as global allocator.
const MEMORY: PeakAlloc = PeakAlloc;

/// Extent of the measurement.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct BenchmarkBudget {
    /// Number of rays of each kind.
    pub rays: usize,
    /// Number of builds and timings of each racer.
    pub rounds: usize,
    /// Time limit of each racer, s. A build is never interrupted, so a build with a longer
    /// predicted time does not start.
    pub seconds: f64,
}

impl BenchmarkBudget {
    /// Returns the maximum number of calls of [`race`]'s `step`.
    pub fn steps(&self) -> usize {
        racers::entrants().len() * (self.rounds + 2) + 1
    }
}

/// Median and quartiles.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Quartiles {
    /// Lower quartile.
    pub low: f64,
    /// Median.
    pub median: f64,
    /// Upper quartile.
    pub high: f64,
}

impl Quartiles {
    /// Computes the quartiles of finite values; `None` for an empty list.
    fn of(mut values: Vec<f64>) -> Option<Quartiles> {
        if values.is_empty() {
            return None;
        }
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        Some(Quartiles {
            low: at(0.25),
            median: at(0.5),
            high: at(0.75),
        })
    }
}

/// Results of one racer for one kind of rays.
#[derive(Debug, Serialize)]
pub struct RayKindResult {
    /// Description of the rays.
    pub kind: &'static str,
    /// Million rays per second of processor time with one thread; `null` without a lap.
    pub one_thread: Option<Quartiles>,
    /// Million rays per second of wall time with all threads; `null` without a lap.
    pub all_threads: Option<Quartiles>,
    /// Number of checked rays whose result differs from brute force in f64. Either only one of the
    /// two hits, or the distances differ by more than 10⁻⁴ of the mesh's diagonal.
    pub wrong: usize,
}

/// Results of a racer.
#[derive(Debug, Serialize)]
pub struct BackendResult {
    /// Name of the library.
    pub name: &'static str,
    /// Version of the library.
    pub version: String,
    /// Number of rounds that were started, each with a build.
    pub rounds: usize,
    /// Description of the work that exceeded the time limit; `null` if all rounds were completed.
    pub out_of_time: Option<String>,
    /// Build time from the indexed mesh, s, with all threads if the library supports it; `null` if
    /// it was not built.
    pub build_s: Option<Quartiles>,
    /// Bytes per triangle after the build and at the peak of the build, without the indexed mesh;
    /// `null` if unknown.
    pub bytes_per_triangle: Option<[f64; 2]>,
    /// Results for each kind of rays.
    pub laps: Vec<RayKindResult>,
    /// Number of rays aimed at edges, and number of them that missed.
    pub edges: MissCount,
    /// Number of rays aimed at vertices, and number of them that missed.
    pub vertices: MissCount,
}

/// Content of `bench.json`.
#[derive(Debug, Serialize)]
pub struct BackendBenchmark {
    /// Number of triangles of the mesh.
    pub triangles: usize,
    /// Number of vertices of the mesh after welding.
    pub vertices: usize,
    /// Number of threads of the laps with all threads.
    pub threads: usize,
    /// Requested extent of the measurement.
    pub effort: BenchmarkBudget,
    /// Number of rays of each kind that were checked by brute force.
    pub checked: usize,
    /// Number of rays aimed at edges.
    pub aimed_at_edges: usize,
    /// Number of rays aimed at vertices.
    pub aimed_at_vertices: usize,
    /// Results of each library.
    pub racers: Vec<BackendResult>,
}

/// Maximum number of triangle tests by brute force; they take about five seconds.
const BRUTE_TESTS: usize = 1_000_000_000;
const MOST_CHECKED: usize = 4096;
/// Minimum number of checked rays of each kind, for any mesh size.
const LEAST_CHECKED: usize = 16;

/// Input of all racers, and the reference results.
struct BenchmarkSetup {
    mesh: Arc<Mesh>,
    effort: BenchmarkBudget,
    sets: [RaySet; 4],
    /// Reference results of each ray set.
    truth: Vec<BruteForceHits>,
    aimed: AimedRays,
    /// Largest difference between distances that count as equal, mm.
    tolerance: f64,
}

/// Runs the race. `forecast` is called before the first round, with the maximum duration, s.
/// `step` is called after each build of a part of the mesh and after each round of a racer. It is
/// called at most [`BenchmarkBudget::steps`] times, and may stop the race. Only one racer is in
/// memory at a time. Returns the errors of Embree and `step`.
pub fn race(
    mesh: &Mesh,
    effort: BenchmarkBudget,
    forecast: &dyn Fn(f64),
    step: &dyn Fn() -> Result<()>,
) -> Result<BackendBenchmark> {
    let mesh = &Arc::new(centred(mesh));
    let builds = forecast::builds(mesh, effort.seconds, step)?;
    forecast(longest(&builds, effort));
    let course = BenchmarkSetup::new(mesh, effort)?;
    step()?;
    let entrants = racers::entrants().into_iter().zip(builds);
    let mut runs: Vec<RacerRun> = entrants
        .map(|(entrant, build)| RacerRun::new(entrant, build))
        .collect();
    for round in 0..effort.rounds {
        for i in 0..runs.len() {
            // The first racer of a round changes from round to round.
            let racers = runs.len();
            runs[(i + round) % racers].round(&course)?;
            step()?;
        }
    }
    Ok(BackendBenchmark {
        triangles: mesh.triangles.len(),
        vertices: mesh.positions.len(),
        threads: rayon::current_num_threads(),
        effort,
        checked: course.truth.iter().map(Vec::len).max().unwrap_or(0),
        aimed_at_edges: course.aimed.edges.rays.len(),
        aimed_at_vertices: course.aimed.vertices.rays.len(),
        racers: runs.into_iter().map(|run| run.finish(&course)).collect(),
    })
}

/// Returns the maximum duration of a race, s. Each racer contributes its time limit, or its builds
/// plus half of its limit for rays, whichever is less. The tree that positions the rays is added.
fn longest(builds: &[f64], effort: BenchmarkBudget) -> f64 {
    let rounds = effort.rounds as f64;
    let racer = |&build: &f64| match build > effort.seconds {
        true => 0.0,
        false => (rounds * build + effort.seconds / 2.0).min(effort.seconds),
    };
    let tree = builds
        .iter()
        .copied()
        .fold(0.0, f64::max)
        .min(effort.seconds);
    builds.iter().map(racer).sum::<f64>() + tree
}

impl BenchmarkSetup {
    fn new(mesh: &Arc<Mesh>, effort: BenchmarkBudget) -> Result<BenchmarkSetup> {
        let threads = rayon::current_num_threads();
        let reference = Accel::build_with(Backend::Rust, mesh, threads, &|_| Ok(()))?;
        let sets = rays::sets(&reference, effort.rays);
        drop(reference);
        let checked = BRUTE_TESTS / sets.len() / mesh.triangles.len();
        let checked = checked.clamp(LEAST_CHECKED, MOST_CHECKED);
        Ok(BenchmarkSetup {
            mesh: mesh.clone(),
            effort,
            truth: sets.iter().map(|set| truth(mesh, set, checked)).collect(),
            sets,
            aimed: aimed::rays(mesh, effort.rays),
            tolerance: 1e-4 * mesh.bounds().size().length(),
        })
    }
}

/// State of a racer during the race.
struct RacerRun {
    entrant: BackendEntry,
    /// Predicted build time, then the longest measured build time, s.
    build: f64,
    /// Time of all rounds, s.
    spent: f64,
    builds: Vec<f64>,
    bytes: Option<[usize; 2]>,
    /// Rates by kind of rays, with one thread and with all threads.
    rates: [[Vec<f64>; 2]; 4],
    wrong: [usize; 4],
    asked: [MissCount; 2],
    out_of_time: Option<String>,
}

impl RacerRun {
    fn new(entrant: BackendEntry, build: f64) -> RacerRun {
        RacerRun {
            entrant,
            build,
            spent: 0.0,
            builds: Vec::new(),
            bytes: None,
            rates: Default::default(),
            wrong: [0; 4],
            asked: Default::default(),
            out_of_time: None,
        }
    }

    /// Builds the racer, measures its rates and, in one round, checks its results, unless its time
    /// limit is exceeded.
    fn round(&mut self, course: &BenchmarkSetup) -> Result<()> {
        let left = course.effort.seconds - self.spent;
        if self.build > left {
            let taken = self.builds.len();
            self.out_of_time = Some(match taken {
                0 => format!("not built, which would take about {:.0} s", self.build),
                _ => format!("{taken} of {} rounds", course.effort.rounds),
            });
            return Ok(());
        }
        let start = Instant::now();
        let racer = self.built(course)?;
        // The time that remains after the builds is divided between rounds, kinds of rays and
        // thread settings. The check has half of a round's time.
        let rounds = course.effort.rounds as f64;
        let for_rays =
            (course.effort.seconds - rounds * self.build).max(0.1 * course.effort.seconds);
        let share = Duration::from_secs_f64(for_rays / (rounds + 0.5) / 8.0);
        let mut in_time = true;
        for (set, rates) in course.sets.iter().zip(&mut self.rates) {
            let laps = [
                one_thread(&*racer, set, share),
                all_threads(&*racer, set, share),
            ];
            for (lap, rates) in laps.into_iter().zip(rates) {
                rates.extend((lap.rays > 0).then_some(lap.rate));
                in_time &= lap.rays == set.rays.len();
            }
        }
        if !in_time {
            self.a_part();
        }
        if self.builds.len() == 1 {
            self.check(course, &*racer, 2 * share);
        }
        drop(racer);
        self.spent += start.elapsed().as_secs_f64();
        Ok(())
    }

    fn built(&mut self, course: &BenchmarkSetup) -> Result<Box<dyn BenchBackend>> {
        let before = MEMORY.current_usage();
        MEMORY.reset_peak_usage();
        let start = Instant::now();
        let racer = (self.entrant.build)(&course.mesh)?;
        let seconds = start.elapsed().as_secs_f64();
        let rust = [MEMORY.current_usage(), MEMORY.peak_usage()];
        let rust = rust.map(|bytes| bytes.saturating_sub(before));
        if self.builds.is_empty() {
            let foreign = racer.foreign_bytes().filter(|_| before > 0);
            self.bytes = foreign.map(|foreign| [rust[0] + foreign[0], rust[1] + foreign[1]]);
        }
        self.builds.push(seconds);
        self.build = self.builds.iter().copied().fold(0.0, f64::max);
        Ok(racer)
    }

    fn check(&mut self, course: &BenchmarkSetup, racer: &dyn BenchBackend, each: Duration) {
        let judged = course.sets.iter().zip(&course.truth);
        for (count, (set, truth)) in self.wrong.iter_mut().zip(judged) {
            *count = wrong(racer, set, truth, course.tolerance);
        }
        let AimedRays { edges, vertices } = &course.aimed;
        self.asked = [edges, vertices]
            .map(|aimed| aimed.missed_by(racer, course.tolerance, Instant::now() + each));
        if self.asked.map(|asked| asked.rays) != [edges.rays.len(), vertices.rays.len()] {
            self.a_part();
        }
    }

    fn a_part(&mut self) {
        self.out_of_time
            .get_or_insert_with(|| "a part of the rays".into());
    }

    fn finish(self, course: &BenchmarkSetup) -> BackendResult {
        let laps = course.sets.iter().zip(self.rates).zip(self.wrong);
        let triangles = course.mesh.triangles.len() as f64;
        BackendResult {
            name: self.entrant.name,
            version: self.entrant.version,
            rounds: self.builds.len(),
            out_of_time: self.out_of_time,
            build_s: Quartiles::of(self.builds),
            bytes_per_triangle: self.bytes.map(|bytes| bytes.map(|b| b as f64 / triangles)),
            laps: laps
                .map(|((set, [one, all]), wrong)| RayKindResult {
                    kind: set.kind,
                    one_thread: Quartiles::of(one),
                    all_threads: Quartiles::of(all),
                    wrong,
                })
                .collect(),
            edges: self.asked[0],
            vertices: self.asked[1],
        }
    }
}

/// Centres the mesh at the origin and rounds its coordinates to f32, so all racers have equal
/// input.
fn centred(mesh: &Mesh) -> Mesh {
    let center = mesh.bounds().center();
    let positions = mesh.positions.iter();
    Mesh {
        positions: positions
            .map(|&p| (p - center).as_vec3().as_dvec3())
            .collect(),
        triangles: mesh.triangles.clone(),
    }
}

/// Index of every n-th ray, and its hit distance by brute force.
type BruteForceHits = Vec<(usize, Option<f64>)>;

fn truth(mesh: &Mesh, set: &RaySet, count: usize) -> BruteForceHits {
    let stride = (set.rays.len() / count).max(1);
    let picked: Vec<usize> = (0..set.rays.len()).step_by(stride).take(count).collect();
    let hit = |i: usize| brute::closest(mesh, &exact(&set.rays[i])).map(|hit| hit.t);
    picked.into_par_iter().map(|i| (i, hit(i))).collect()
}

fn wrong(racer: &dyn BenchBackend, set: &RaySet, truth: &BruteForceHits, tolerance: f64) -> usize {
    let asked = RaySet {
        rays: truth.iter().map(|&(i, _)| set.rays[i]).collect(),
        ..*set
    };
    let answers = RayAnswers::all(racer, &asked);
    let agrees = |&(i, (_, t)): &(usize, &(usize, Option<f64>))| match &answers {
        RayAnswers::Blocked(blocked) => blocked[i] == t.is_some(),
        RayAnswers::Hits(hits) => match t {
            None => hits[i] == FlatHit::NONE,
            Some(t) => (hits[i].t as f64 - t).abs() <= tolerance,
        },
    };
    truth.len() - truth.iter().enumerate().filter(agrees).count()
}

#[cfg(test)]
mod tests;

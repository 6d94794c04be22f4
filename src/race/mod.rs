//! The race: Embree and the tree in Rust against other crates, on one mesh and
//! the same rays in f32. It is built with the cargo feature `race` only, so that
//! the rivals are none of the program's dependencies.

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
use aimed::{AimedRays, Asked};
use laps::{Answers, all_threads, one_thread};
use peak_alloc::PeakAlloc;
use racers::{Entrant, Racer};
use rayon::prelude::*;
use rays::{RaySet, exact};
use serde::Serialize;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What Rust allocates, where the program counts it: `PeakAlloc` is its global allocator.
const MEMORY: PeakAlloc = PeakAlloc;

/// How much is measured.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Effort {
    /// Rays of each kind.
    pub rays: usize,
    /// Times each is built and timed.
    pub rounds: usize,
    /// Longest time for each racer, s. A build that has begun is not stopped: one that is
    /// expected to take longer does not begin.
    pub seconds: f64,
}

impl Effort {
    /// Calls of [`race`]'s `step` at most.
    pub fn steps(&self) -> usize {
        racers::entrants().len() * (self.rounds + 2) + 1
    }
}

/// Median and quartiles.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Spread {
    /// Lower quartile.
    pub low: f64,
    /// Median.
    pub median: f64,
    /// Upper quartile.
    pub high: f64,
}

impl Spread {
    /// Of finite values; `None` of none.
    fn of(mut values: Vec<f64>) -> Option<Spread> {
        if values.is_empty() {
            return None;
        }
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        Some(Spread {
            low: at(0.25),
            median: at(0.5),
            high: at(0.75),
        })
    }
}

/// One racer on one kind of rays.
#[derive(Debug, Serialize)]
pub struct Laps {
    /// Which rays, in words.
    pub kind: &'static str,
    /// Million rays per second of processor time, one thread; `null` without a lap.
    pub one_thread: Option<Spread>,
    /// Million rays per second of wall time, all threads; `null` without a lap.
    pub all_threads: Option<Spread>,
    /// Of the rays checked, those with another answer than brute force in f64: hit
    /// for miss or the reverse, or further off than 10⁻⁴ of the mesh's diagonal.
    pub wrong: usize,
}

/// What a racer did.
#[derive(Debug, Serialize)]
pub struct Finish {
    /// Name of the library.
    pub name: &'static str,
    /// Its version.
    pub version: String,
    /// Rounds that were begun, each with a build.
    pub rounds: usize,
    /// What its time was too short for; `null` if it was not.
    pub out_of_time: Option<String>,
    /// Seconds from the indexed mesh to being ready, all threads where it can; `null` if it
    /// was not built.
    pub build_s: Option<Spread>,
    /// Bytes held per triangle when ready, without the indexed mesh, and at the most
    /// during the build; `null` if not known.
    pub bytes_per_triangle: Option<[f64; 2]>,
    /// One for each kind of rays.
    pub laps: Vec<Laps>,
    /// Of rays aimed at edges and at vertices, those that met nothing there.
    pub edges: Asked,
    /// The same at vertices.
    pub vertices: Asked,
}

/// `bench.json`.
#[derive(Debug, Serialize)]
pub struct Race {
    /// Triangles of the mesh.
    pub triangles: usize,
    /// Its vertices, welded.
    pub vertices: usize,
    /// Threads of the laps that use all.
    pub threads: usize,
    /// What was asked for.
    pub effort: Effort,
    /// Rays of each kind that were checked by brute force.
    pub checked: usize,
    /// Rays aimed at edges.
    pub aimed_at_edges: usize,
    /// Rays aimed at vertices.
    pub aimed_at_vertices: usize,
    /// One for each library.
    pub racers: Vec<Finish>,
}

/// Triangles brute force tests in all: some five seconds.
const BRUTE_TESTS: usize = 1_000_000_000;
const MOST_CHECKED: usize = 4096;
/// Rays of each kind that are checked, however large the mesh.
const LEAST_CHECKED: usize = 16;

/// What all racers are asked and judged by.
struct Course {
    mesh: Arc<Mesh>,
    effort: Effort,
    sets: [RaySet; 4],
    /// Of the first set, of the second, …
    truth: Vec<Truth>,
    aimed: AimedRays,
    /// Distances that differ by no more are the same.
    tolerance: f64,
}

/// Runs the race. `forecast` is told, before it starts, how many seconds it takes at most;
/// `step` is called after each build of a part of the mesh and each round of a racer, at
/// most [`Effort::steps`] times in all, and may stop it. One racer is in memory at a time.
/// Errors: what Embree reports, and what `step` does.
pub fn race(
    mesh: &Mesh,
    effort: Effort,
    forecast: &dyn Fn(f64),
    step: &dyn Fn() -> Result<()>,
) -> Result<Race> {
    let mesh = &Arc::new(centred(mesh));
    let builds = forecast::builds(mesh, effort.seconds, step)?;
    forecast(longest(&builds, effort));
    let course = Course::new(mesh, effort)?;
    step()?;
    let entrants = racers::entrants().into_iter().zip(builds);
    let mut runs: Vec<RacerRun> = entrants
        .map(|(entrant, build)| RacerRun::new(entrant, build))
        .collect();
    for round in 0..effort.rounds {
        for i in 0..runs.len() {
            // Another one starts each round.
            let racers = runs.len();
            runs[(i + round) % racers].round(&course)?;
            step()?;
        }
    }
    Ok(Race {
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

/// Seconds a race takes at most: of each racer its time, or the builds and half of its time
/// for rays, whichever is less, and what the tree that places the rays takes.
fn longest(builds: &[f64], effort: Effort) -> f64 {
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

impl Course {
    fn new(mesh: &Arc<Mesh>, effort: Effort) -> Result<Course> {
        let threads = rayon::current_num_threads();
        let reference = Accel::build_with(Backend::Rust, mesh, threads, &|_| Ok(()))?;
        let sets = rays::sets(&reference, effort.rays);
        drop(reference);
        let checked = BRUTE_TESTS / sets.len() / mesh.triangles.len();
        let checked = checked.clamp(LEAST_CHECKED, MOST_CHECKED);
        Ok(Course {
            mesh: mesh.clone(),
            effort,
            truth: sets.iter().map(|set| truth(mesh, set, checked)).collect(),
            sets,
            aimed: aimed::rays(mesh, effort.rays),
            tolerance: 1e-4 * mesh.bounds().size().length(),
        })
    }
}

/// A racer on its way.
struct RacerRun {
    entrant: Entrant,
    /// Seconds a build is expected to take, and then those of the longest.
    build: f64,
    /// Of all its rounds.
    spent: f64,
    builds: Vec<f64>,
    bytes: Option<[usize; 2]>,
    /// By kind of rays: one thread, all threads.
    rates: [[Vec<f64>; 2]; 4],
    wrong: [usize; 4],
    asked: [Asked; 2],
    out_of_time: Option<String>,
}

impl RacerRun {
    fn new(entrant: Entrant, build: f64) -> RacerRun {
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

    /// Builds it, times it and, once, checks its answers, unless its time is over.
    fn round(&mut self, course: &Course) -> Result<()> {
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
        // Rays have what builds leave, shared out over rounds, kinds and threads, and half
        // as much again for the check.
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

    fn built(&mut self, course: &Course) -> Result<Box<dyn Racer>> {
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

    fn check(&mut self, course: &Course, racer: &dyn Racer, each: Duration) {
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

    fn finish(self, course: &Course) -> Finish {
        let laps = course.sets.iter().zip(self.rates).zip(self.wrong);
        let triangles = course.mesh.triangles.len() as f64;
        Finish {
            name: self.entrant.name,
            version: self.entrant.version,
            rounds: self.builds.len(),
            out_of_time: self.out_of_time,
            build_s: Spread::of(self.builds),
            bytes_per_triangle: self.bytes.map(|bytes| bytes.map(|b| b as f64 / triangles)),
            laps: laps
                .map(|((set, [one, all]), wrong)| Laps {
                    kind: set.kind,
                    one_thread: Spread::of(one),
                    all_threads: Spread::of(all),
                    wrong,
                })
                .collect(),
            edges: self.asked[0],
            vertices: self.asked[1],
        }
    }
}

/// The mesh about its own middle in coordinates f32 holds: the same for all.
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

/// Every n-th ray, and the distance at which brute force meets the mesh.
type Truth = Vec<(usize, Option<f64>)>;

fn truth(mesh: &Mesh, set: &RaySet, count: usize) -> Truth {
    let stride = (set.rays.len() / count).max(1);
    let picked: Vec<usize> = (0..set.rays.len()).step_by(stride).take(count).collect();
    let hit = |i: usize| brute::closest(mesh, &exact(&set.rays[i])).map(|hit| hit.t);
    picked.into_par_iter().map(|i| (i, hit(i))).collect()
}

fn wrong(racer: &dyn Racer, set: &RaySet, truth: &Truth, tolerance: f64) -> usize {
    let asked = RaySet {
        rays: truth.iter().map(|&(i, _)| set.rays[i]).collect(),
        ..*set
    };
    let answers = Answers::all(racer, &asked);
    let agrees = |&(i, (_, t)): &(usize, &(usize, Option<f64>))| match &answers {
        Answers::Blocked(blocked) => blocked[i] == t.is_some(),
        Answers::Hits(hits) => match t {
            None => hits[i] == FlatHit::NONE,
            Some(t) => (hits[i].t as f64 - t).abs() <= tolerance,
        },
    };
    truth.len() - truth.iter().enumerate().filter(agrees).count()
}

#[cfg(test)]
mod tests;

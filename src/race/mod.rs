//! The race: Embree and the tree in Rust against other crates, on one mesh and
//! the same rays in f32. It is built with the cargo feature `race` only, so that
//! the rivals are none of the program's dependencies.

mod aimed;
mod plot;
mod racers;
mod rays;
mod table;

pub use plot::plot;
pub use table::table;

use crate::accel::embree_race::{FlatHit, FlatRay};
use crate::accel::{Accel, Backend, Ray, brute};
use crate::error::Result;
use crate::math::DVec3;
use crate::mesh::Mesh;
use cpu_time::ThreadTime;
use peak_alloc::PeakAlloc;
pub use racers::RACERS;
use racers::Racer;
use rayon::prelude::*;
use rays::RaySet;
use serde::Serialize;
use std::time::Instant;

/// Counts what Rust allocates.
#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// How much is measured.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Effort {
    /// Rays of each kind.
    pub rays: usize,
    /// Times each is timed.
    pub rounds: usize,
}

/// Median and quartiles.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Spread {
    pub low: f64,
    pub median: f64,
    pub high: f64,
}

impl Spread {
    /// Of at least one finite value.
    fn of(mut values: Vec<f64>) -> Spread {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        Spread {
            low: at(0.25),
            median: at(0.5),
            high: at(0.75),
        }
    }
}

/// One racer on one kind of rays.
#[derive(Debug, Serialize)]
pub struct Laps {
    pub kind: &'static str,
    /// Million rays per second of processor time, one thread.
    pub one_thread: Spread,
    /// Million rays per second of wall time, all threads.
    pub all_threads: Spread,
    /// Of the rays checked, those with another answer than brute force in f64: hit
    /// for miss or the reverse, or further off than 10⁻⁴ of the mesh's diagonal.
    pub wrong: usize,
}

/// What a racer did.
#[derive(Debug, Serialize)]
pub struct Finish {
    pub name: &'static str,
    pub version: String,
    /// Seconds from the indexed mesh to being ready, all threads where it can.
    pub build_s: Spread,
    /// Bytes held per triangle when ready, without the indexed mesh, and at the most
    /// during the build; `null` if not known.
    pub bytes_per_triangle: Option<[f64; 2]>,
    pub laps: Vec<Laps>,
    /// Of the rays aimed at edges and at vertices, those that met nothing there.
    pub missed_edges: usize,
    pub missed_vertices: usize,
}

/// `bench.json`.
#[derive(Debug, Serialize)]
pub struct Race {
    pub triangles: usize,
    pub vertices: usize,
    pub threads: usize,
    pub effort: Effort,
    /// Rays of each kind that were checked by brute force.
    pub checked: usize,
    pub aimed_at_edges: usize,
    pub aimed_at_vertices: usize,
    pub racers: Vec<Finish>,
}

/// Triangles brute force tests in all: some ten seconds.
const BRUTE_TESTS: usize = 2_000_000_000;
const MOST_CHECKED: usize = 4096;
/// Rays a thread takes at a time.
const CHUNK: usize = 512;

/// Runs the race; `step` is called after each build and each round, `RACERS + 1`
/// times a round in all, and may stop it. Errors: what Embree reports, and what
/// `step` does.
pub fn race(mesh: &Mesh, effort: Effort, step: &dyn Fn() -> Result<()>) -> Result<Race> {
    let mesh = centred(mesh);
    let (mut racers, builds) = build_all(&mesh, effort, step)?;
    let threads = rayon::current_num_threads();
    let reference = Accel::build_with(Backend::Rust, &mesh, threads, &|_| Ok(()))?;
    let sets = rays::sets(&reference, effort.rays);
    let checked = (BRUTE_TESTS / sets.len() / mesh.triangles.len()).clamp(16, MOST_CHECKED);
    let truth: Vec<_> = sets.iter().map(|set| truth(&mesh, set, checked)).collect();
    let aimed = aimed::rays(&mesh, effort.rays);
    drop(reference);
    let mut laps: Vec<Vec<[Vec<f64>; 2]>> =
        vec![vec![Default::default(); sets.len()]; racers.len()];
    for round in 0..effort.rounds {
        for (k, set) in sets.iter().enumerate() {
            for i in 0..racers.len() {
                // Another one starts each round.
                let i = (i + round) % racers.len();
                laps[i][k][0].push(one_thread(&*racers[i], set));
                laps[i][k][1].push(all_threads(&*racers[i], set));
            }
        }
        step()?;
    }
    let diagonal = mesh.bounds().size().length();
    let finishes = racers.iter_mut().zip(builds).zip(laps);
    let finishes = finishes.map(|((racer, built), laps)| Finish {
        name: built.name,
        version: built.version,
        build_s: Spread::of(built.seconds),
        bytes_per_triangle: built
            .bytes
            .map(|bytes| bytes.map(|b| b as f64 / mesh.triangles.len() as f64)),
        laps: (sets.iter().zip(laps).zip(&truth))
            .map(|((set, [one, all]), truth)| Laps {
                kind: set.kind,
                one_thread: Spread::of(one),
                all_threads: Spread::of(all),
                wrong: wrong(&**racer, set, truth, 1e-4 * diagonal),
            })
            .collect(),
        missed_edges: aimed.edges.missed_by(&**racer, 1e-4 * diagonal),
        missed_vertices: aimed.vertices.missed_by(&**racer, 1e-4 * diagonal),
    });
    Ok(Race {
        triangles: mesh.triangles.len(),
        vertices: mesh.positions.len(),
        threads: rayon::current_num_threads(),
        effort,
        checked: checked.min(effort.rays),
        aimed_at_edges: aimed.edges.rays.len(),
        aimed_at_vertices: aimed.vertices.rays.len(),
        racers: finishes.collect(),
    })
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

struct Build {
    name: &'static str,
    version: String,
    seconds: Vec<f64>,
    /// Held, and at the most.
    bytes: Option<[usize; 2]>,
}

type Racers<'m> = Vec<Box<dyn Racer + 'm>>;

/// Builds every racer `effort.rounds` times, in turn, and keeps the last of each.
fn build_all<'m>(
    mesh: &'m Mesh,
    effort: Effort,
    step: &dyn Fn() -> Result<()>,
) -> Result<(Racers<'m>, Vec<Build>)> {
    let entrants = racers::entrants();
    let mut racers = Racers::new();
    let mut builds: Vec<Build> = Vec::new();
    for round in 0..effort.rounds {
        for (i, entrant) in entrants.iter().enumerate() {
            let before = MEMORY.current_usage();
            MEMORY.reset_peak_usage();
            let start = Instant::now();
            let racer = (entrant.build)(mesh)?;
            let seconds = start.elapsed().as_secs_f64();
            let rust =
                [MEMORY.current_usage(), MEMORY.peak_usage()].map(|b| b.saturating_sub(before));
            let foreign = racer.foreign_bytes();
            if round == 0 {
                builds.push(Build {
                    name: entrant.name,
                    version: entrant.version.clone(),
                    seconds: Vec::new(),
                    bytes: foreign.map(|foreign| [rust[0] + foreign[0], rust[1] + foreign[1]]),
                });
            }
            builds[i].seconds.push(seconds);
            if round + 1 == effort.rounds {
                racers.push(racer);
            }
            step()?;
        }
    }
    Ok((racers, builds))
}

/// Million rays per second of this thread's processor time.
fn one_thread(racer: &dyn Racer, set: &RaySet) -> f64 {
    let mut answers = Answers::new(set);
    let start = ThreadTime::now();
    answers.fill(racer, set);
    let seconds = start.elapsed().as_secs_f64();
    std::hint::black_box(&answers);
    set.rays.len() as f64 / seconds * 1e-6
}

/// Million rays per second of wall time.
fn all_threads(racer: &dyn Racer, set: &RaySet) -> f64 {
    let mut answers = Answers::new(set);
    let start = Instant::now();
    let chunks = set.rays.par_chunks(CHUNK);
    match &mut answers {
        Answers::Hits(hits) => (chunks.zip(hits.par_chunks_mut(CHUNK)))
            .for_each(|(rays, hits)| racer.closest(rays, set.coherent, hits)),
        Answers::Blocked(blocked) => (chunks.zip(blocked.par_chunks_mut(CHUNK)))
            .for_each(|(rays, blocked)| racer.occluded(rays, set.coherent, blocked)),
    }
    let seconds = start.elapsed().as_secs_f64();
    std::hint::black_box(&answers);
    set.rays.len() as f64 / seconds * 1e-6
}

enum Answers {
    Hits(Vec<FlatHit>),
    Blocked(Vec<bool>),
}

impl Answers {
    fn new(set: &RaySet) -> Answers {
        match set.any_hit {
            false => Answers::Hits(vec![FlatHit::NONE; set.rays.len()]),
            true => Answers::Blocked(vec![false; set.rays.len()]),
        }
    }

    fn fill(&mut self, racer: &dyn Racer, set: &RaySet) {
        let chunks = set.rays.chunks(CHUNK);
        match self {
            Answers::Hits(hits) => (chunks.zip(hits.chunks_mut(CHUNK)))
                .for_each(|(rays, hits)| racer.closest(rays, set.coherent, hits)),
            Answers::Blocked(blocked) => (chunks.zip(blocked.chunks_mut(CHUNK)))
                .for_each(|(rays, blocked)| racer.occluded(rays, set.coherent, blocked)),
        }
    }
}

/// A ray with the numbers of `flat`, which f64 holds.
fn exact(flat: &FlatRay) -> Ray {
    let wide = |v: [f32; 3]| DVec3::from_array(v.map(f64::from));
    Ray {
        origin: wide(flat.origin),
        direction: wide(flat.direction),
        t_max: flat.t_max.into(),
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
    let mut answers = Answers::new(set);
    answers.fill(racer, set);
    let agrees = |&&(i, t): &&(usize, Option<f64>)| match &answers {
        Answers::Blocked(blocked) => blocked[i] == t.is_some(),
        Answers::Hits(hits) => match t {
            None => hits[i] == FlatHit::NONE,
            Some(t) => (hits[i].t as f64 - t).abs() <= tolerance,
        },
    };
    truth.len() - truth.iter().filter(agrees).count()
}

#[cfg(test)]
mod tests;

//! Timed ray queries.

use super::racers::BenchBackend;
use super::rays::RaySet;
use crate::accel::embree_race::{FlatHit, FlatRay};
use cpu_time::ThreadTime;
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Number of rays that a thread traces between two checks of the clock.
pub const CHUNK: usize = 128;

/// One lap: the rate, and the number of rays that were traced in time.
#[derive(Debug, Clone, Copy)]
pub struct TimedRun {
    /// Million rays per second.
    pub rate: f64,
    pub rays: usize,
}

/// Measures the rate of one thread, in processor time.
pub fn one_thread(racer: &dyn BenchBackend, set: &RaySet, most: Duration) -> TimedRun {
    let mut answers = RayAnswers::new(set);
    let end = Instant::now() + most;
    let start = ThreadTime::now();
    let rays = answers.fill(racer, set, Some(end));
    let seconds = start.elapsed().as_secs_f64();
    std::hint::black_box(&answers);
    TimedRun {
        rate: rays as f64 / seconds * 1e-6,
        rays,
    }
}

/// Measures the rate of all threads, in wall time.
pub fn all_threads(racer: &dyn BenchBackend, set: &RaySet, most: Duration) -> TimedRun {
    let mut answers = RayAnswers::new(set);
    let done = AtomicUsize::new(0);
    let start = Instant::now();
    let in_time = |rays: usize| {
        let time_left = start.elapsed() < most;
        done.fetch_add(if time_left { rays } else { 0 }, Ordering::Relaxed);
        time_left
    };
    let chunks = set.rays.par_chunks(CHUNK);
    match &mut answers {
        RayAnswers::Hits(hits) => (chunks.zip(hits.par_chunks_mut(CHUNK)))
            .filter(|(rays, _)| in_time(rays.len()))
            .for_each(|(rays, hits)| racer.closest(rays, set.coherent, hits)),
        RayAnswers::Blocked(blocked) => (chunks.zip(blocked.par_chunks_mut(CHUNK)))
            .filter(|(rays, _)| in_time(rays.len()))
            .for_each(|(rays, blocked)| racer.occluded(rays, set.coherent, blocked)),
    }
    let seconds = start.elapsed().as_secs_f64();
    std::hint::black_box(&answers);
    let rays = done.into_inner();
    TimedRun {
        rate: rays as f64 / seconds * 1e-6,
        rays,
    }
}

pub enum RayAnswers {
    Hits(Vec<FlatHit>),
    Blocked(Vec<bool>),
}

impl RayAnswers {
    fn new(set: &RaySet) -> RayAnswers {
        match set.any_hit {
            false => RayAnswers::Hits(vec![FlatHit::NONE; set.rays.len()]),
            true => RayAnswers::Blocked(vec![false; set.rays.len()]),
        }
    }

    pub fn all(racer: &dyn BenchBackend, set: &RaySet) -> RayAnswers {
        let mut answers = RayAnswers::new(set);
        answers.fill(racer, set, None);
        answers
    }

    /// Traces the rays in order, until `end` if it is given. Returns the number of traced rays.
    fn fill(&mut self, racer: &dyn BenchBackend, set: &RaySet, end: Option<Instant>) -> usize {
        let mut done = 0;
        let in_time = |_: &&[FlatRay]| end.is_none_or(|end| Instant::now() < end);
        let chunks = set.rays.chunks(CHUNK).take_while(in_time);
        match self {
            RayAnswers::Hits(hits) => {
                for (rays, hits) in chunks.zip(hits.chunks_mut(CHUNK)) {
                    racer.closest(rays, set.coherent, hits);
                    done += rays.len();
                }
            }
            RayAnswers::Blocked(blocked) => {
                for (rays, blocked) in chunks.zip(blocked.chunks_mut(CHUNK)) {
                    racer.occluded(rays, set.coherent, blocked);
                    done += rays.len();
                }
            }
        }
        done
    }
}

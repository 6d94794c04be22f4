//! Number of threads of the program.

use crate::error::{Error, Result};
use std::env;
use std::thread::available_parallelism;

/// Returns the number of available threads: the cores of the CPU affinity mask, limited by the
/// control-group quota and by the Slurm allocation of the task.
fn available_threads() -> usize {
    let cores = available_parallelism().map_or(1, usize::from);
    let task = env::var("SLURM_CPUS_PER_TASK").ok();
    let task = task.and_then(|text| text.parse::<usize>().ok());
    within(cores, task)
}

fn within(cores: usize, task: Option<usize>) -> usize {
    cores.min(task.filter(|&cpus| cpus > 0).unwrap_or(cores))
}

/// Creates a pool with the requested number of threads, by default all available ones. Also returns
/// a message if fewer are used. Returns an error if no thread can be started.
pub fn pool(wanted: Option<u16>) -> Result<(rayon::ThreadPool, Option<String>)> {
    let granted = available_threads();
    let wanted = wanted.map_or(granted, usize::from);
    let used = wanted.min(granted);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(used)
        .build()
        .map_err(|error| Error::Exhausted(format!("cannot start {used} threads: {error}")))?;
    let cut = (used < wanted).then(|| {
        format!(
            "--threads {wanted}: {used} used, which is all that cores, control group and Slurm \
             grant this program"
        )
    });
    Ok((pool, cut))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn never_more_threads_than_are_granted() {
        assert_eq!(within(8, None), 8);
        assert_eq!(within(8, Some(3)), 3);
        assert_eq!(within(8, Some(64)), 8);
        assert_eq!(within(8, Some(0)), 8, "0 says nothing");
        let (pool, cut) = pool(Some(u16::MAX)).unwrap();
        assert!(pool.current_num_threads() <= available_parallelism().unwrap().get());
        assert!(cut.unwrap().starts_with("--threads 65535: "));
        assert_eq!(super::pool(Some(1)).unwrap().1, None);
    }
}

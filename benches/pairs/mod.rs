//! Ratios of interleaved pairs of measurements.

use std::time::Instant;

/// Seconds that `run` takes.
pub fn seconds<T>(run: impl FnOnce() -> T) -> f64 {
    let start = Instant::now();
    std::hint::black_box(run());
    start.elapsed().as_secs_f64()
}

/// Prints the median and the quartiles of `n` ratios.
#[allow(dead_code, reason = "one bench prints a table of its own")]
pub fn print_ratio(name: &str, n: usize, ratio: impl FnMut(usize) -> f64) {
    let mut ratios: Vec<f64> = (0..n).map(ratio).collect();
    ratios.sort_by(f64::total_cmp);
    let [low, middle, high] = [1, 2, 3].map(|quarter| ratios[quarter * (n - 1) / 4]);
    println!("{name}: {middle:.3} (median of {n} pairs; quartiles {low:.3}, {high:.3})");
}

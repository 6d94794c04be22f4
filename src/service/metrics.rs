//! Metrics in the Prometheus text format.

use super::slots::Slots;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;

/// Upper bounds of the response-time histogram, s.
const ENDS: [f64; 8] = [0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0];

/// Request counters.
#[derive(Default)]
pub struct Metrics {
    /// Number of responses per status class (first digit).
    statuses: [AtomicU64; 6],
    /// Number of responses per histogram bucket, not cumulative.
    times: [AtomicU64; ENDS.len()],
    microseconds: AtomicU64,
}

impl Metrics {
    /// Counts an answered request.
    pub fn answered(&self, status: u16, took: Duration) {
        let class = usize::from(status / 100).min(self.statuses.len() - 1);
        self.statuses[class].fetch_add(1, Relaxed);
        let end = ENDS.iter().position(|end| took.as_secs_f64() <= *end);
        if let Some(end) = end {
            self.times[end].fetch_add(1, Relaxed);
        }
        self.microseconds
            .fetch_add(took.as_micros() as u64, Relaxed);
    }

    fn requests(&self, page: &mut String) -> std::fmt::Result {
        head(
            page,
            "lasertrace_requests_total",
            "counter",
            "Requests that were answered.",
        )?;
        for (class, count) in self.statuses.iter().enumerate().skip(1) {
            let count = count.load(Relaxed);
            writeln!(
                page,
                "lasertrace_requests_total{{status=\"{class}xx\"}} {count}"
            )?;
        }
        let name = "lasertrace_request_seconds";
        head(page, name, "histogram", "Time to the start of the answer.")?;
        let mut up_to = 0;
        for (end, count) in ENDS.iter().zip(&self.times) {
            up_to += count.load(Relaxed);
            writeln!(page, "{name}_bucket{{le=\"{end}\"}} {up_to}")?;
        }
        let all: u64 = self.statuses.iter().map(|count| count.load(Relaxed)).sum();
        writeln!(page, "{name}_bucket{{le=\"+Inf\"}} {all}")?;
        let seconds = self.microseconds.load(Relaxed) as f64 * 1e-6;
        writeln!(page, "{name}_sum {seconds}\n{name}_count {all}")
    }
}

fn head(page: &mut String, name: &str, kind: &str, help: &str) -> std::fmt::Result {
    writeln!(page, "# HELP {name} {help}\n# TYPE {name} {kind}")
}

/// Returns the metrics page for Prometheus.
pub fn page(
    metrics: &Metrics,
    slots: &Slots,
    jobs: &BTreeMap<String, u32>,
    free: Option<u64>,
) -> String {
    let mut page = String::new();
    let written = (|| {
        metrics.requests(&mut page)?;
        head(&mut page, "lasertrace_jobs", "gauge", "Jobs in each state.")?;
        for state in ["queued", "running", "done", "failed", "cancelled"] {
            let count = jobs.get(state).unwrap_or(&0);
            writeln!(page, "lasertrace_jobs{{state=\"{state}\"}} {count}")?;
        }

        for (name, help, count) in [
            (
                "started",
                "Processes that were started for jobs.",
                &slots.started,
            ),
            (
                "died",
                "Processes of jobs that died without a word.",
                &slots.died,
            ),
        ] {
            let name = format!("lasertrace_processes_{name}_total");
            head(&mut page, &name, "counter", help)?;
            writeln!(page, "{name} {}", count.load(Relaxed))?;
        }
        if let Some(free) = free {
            let name = "lasertrace_store_free_bytes";
            head(&mut page, name, "gauge", "Room on the store's disk.")?;
            writeln!(page, "{name} {free}")?;
        }
        if let Some(pages) = resident_pages() {
            let name = "process_resident_memory_bytes";
            head(&mut page, name, "gauge", "Memory of the service itself.")?;
            writeln!(page, "{name} {}", pages * rustix::param::page_size() as u64)?;
        }
        std::fmt::Result::Ok(())
    })();
    written.expect("writing to a string does not fail");
    page
}

fn resident_pages() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/statm").ok()?;
    text.split(' ').nth(1)?.parse().ok()
}

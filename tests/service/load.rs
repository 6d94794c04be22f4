//! Many jobs from many clients, over loopback, so many and no more.

use super::client::Served;
use super::program::{PLANE, scene};
use std::collections::BTreeSet;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::thread::{scope, sleep};
use std::time::{Duration, Instant};

const CLIENTS: usize = 16;

/// Every job is sent twice with its key, by another client each time.
#[expect(
    clippy::too_many_lines,
    reason = "clients, and what is counted of them"
)]
fn load(jobs: usize) {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--jobs", "2"]);
    let text = scene(PLANE);
    let ids = Mutex::new(BTreeSet::new());
    let next = AtomicUsize::new(0);
    let times = Mutex::new(Vec::new());
    let timed = |ask: &dyn Fn() -> super::client::Answer| {
        let start = Instant::now();
        let answer = ask();
        times.lock().unwrap().push(start.elapsed());
        answer
    };
    let memory = || served.metric("process_resident_memory_bytes");
    let mut early = None;
    let end = Instant::now() + Duration::from_secs(1200);
    scope(|scope| {
        for _ in 0..CLIENTS {
            scope.spawn(|| {
                loop {
                    let sent = next.fetch_add(1, Relaxed);
                    if sent >= 2 * jobs {
                        break;
                    }
                    let (key, frame) = ((sent % jobs).to_string(), sent % jobs % 3);
                    let post = || {
                        served.post(
                            &format!("kind=frame&frame={frame}"),
                            &[("Idempotency-Key", &key)],
                            &text,
                        )
                    };
                    let answer = timed(&post);
                    assert!(matches!(answer.status, 200 | 202), "{answer:?}");
                    let id = answer.json()["id"].as_str().unwrap().to_owned();
                    assert_eq!(timed(&|| served.get(&format!("/v1/jobs/{id}"))).status, 200);
                    ids.lock().unwrap().insert(id);
                }
            });
        }
        loop {
            let done = served.metric("lasertrace_jobs{state=\"done\"}") as usize;
            if early.is_none() && done >= jobs / 5 && next.load(Relaxed) >= 2 * jobs {
                early = Some(memory());
            }
            if done >= jobs && early.is_some() {
                break;
            }
            assert!(Instant::now() < end, "{done} of {jobs} are done");
            sleep(Duration::from_millis(50));
        }
    });
    let grown = memory() - early.unwrap();
    let ids = ids.into_inner().unwrap();
    assert_eq!(ids.len(), jobs, "a job was lost or taken twice");
    let mut bytes = 0;
    for id in &ids {
        let job = served.state(id);
        assert_eq!(
            (&job["state"], &job["starts"]),
            (&"done".into(), &1.into()),
            "{job}"
        );
        let files = served.get(&format!("/v1/jobs/{id}/files")).json();
        let sizes = files
            .as_array()
            .unwrap()
            .iter()
            .map(|file| file["bytes"].as_u64().unwrap());
        bytes += sizes.sum::<u64>();
    }
    assert_eq!(
        served.metric("lasertrace_processes_started_total") as usize,
        jobs
    );
    let mut times = times.into_inner().unwrap();
    times.sort();
    let p99 = times[times.len() * 99 / 100];
    println!(
        "{jobs} jobs from {CLIENTS} clients, each sent twice: none lost, none twice; p99 of {} requests \
         {:.1} ms; memory grew by {:.0} kB after a fifth of them, four fifths of the results are {:.0} kB",
        times.len(),
        p99.as_secs_f64() * 1e3,
        grown / 1e3,
        0.8 * bytes as f64 / 1e3
    );
    // What passes through does not stay: a tenth of the results would show it.
    // Of few jobs it would not show beside what the first requests take.
    assert!(
        jobs < 500 || grown < 0.08 * bytes as f64,
        "{grown} of {bytes}"
    );
}

#[test]
fn jobs_of_many_clients_are_done_once_each() {
    load(48);
}

/// `--nocapture` prints its figures.
#[test]
#[ignore = "half a minute; run by tests/verify.sh"]
fn five_hundred_jobs_of_sixteen_clients() {
    load(500);
}

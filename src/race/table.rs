//! Results of the race as text.

use super::{BackendBenchmark, Quartiles};
use std::fmt::Write;

/// Formats the median and half the interquartile range, such as "12.3 ±0.4".
fn spread(s: Option<Quartiles>) -> String {
    s.map_or("-".into(), |s| {
        format!("{:.2} ±{:.2}", s.median, (s.high - s.low) / 2.0)
    })
}

/// Returns one line for every racer that exceeded its time limit.
pub fn out_of_time(race: &BackendBenchmark) -> Vec<String> {
    let late = race.racers.iter().filter_map(|racer| {
        let what = racer.out_of_time.as_ref()?;
        Some(format!(
            "{}: out of its {} s: {what}",
            racer.name, race.effort.seconds
        ))
    });
    late.collect()
}

/// Formats a table of all results, with an explanation of its columns below.
pub fn table(race: &BackendBenchmark) -> String {
    let mut text = format!(
        "{} triangles, {} rays of each kind, {} rounds\n\nMrays/s, one thread (processor time)\n",
        race.triangles, race.effort.rays, race.effort.rounds
    );
    speeds(&mut text, race, |laps| laps.0);
    let _ = write!(text, "\nMrays/s, {} threads (wall time)\n", race.threads);
    speeds(&mut text, race, |laps| laps.1);
    let _ = write!(
        text,
        "\n{:<26} {:>14} {:>10} {:>10} {:>9} {:>9} {:>9}\n",
        "", "build, s", "B/triangle", "peak", "wrong", "edges", "vertices"
    );
    for racer in &race.racers {
        let bytes = match racer.bytes_per_triangle {
            Some([held, peak]) => format!("{held:>10.0} {peak:>10.0}"),
            None => format!("{:>10} {:>10}", "-", "-"),
        };
        let wrong: usize = racer.laps.iter().map(|laps| laps.wrong).sum();
        let build = spread(racer.build_s);
        let found = match racer.rounds {
            0 => format!("{:>9} {:>9} {:>9}", "-", "-", "-"),
            _ => format!(
                "{wrong:>9} {:>9} {:>9}",
                racer.edges.missed, racer.vertices.missed
            ),
        };
        let _ = writeln!(text, "{:<26} {build:>14} {bytes} {found}", racer.name);
    }
    for line in out_of_time(race) {
        let _ = write!(text, "\n{line}");
    }
    if race.racers.iter().any(|racer| racer.out_of_time.is_some()) {
        text.push('\n');
    }
    let kinds = race.racers.first().map_or(0, |racer| racer.laps.len());
    let _ = write!(
        text,
        "\n±: half the distance between the quartiles of {} rounds, racers taking turns\n\
         wrong: of {} rays, other than brute force in f64 says\n\
         edges, vertices: misses of {} and {} rays aimed at them\n",
        race.effort.rounds,
        kinds * race.checked,
        race.aimed_at_edges,
        race.aimed_at_vertices
    );
    text
}

fn speeds(
    text: &mut String,
    race: &BackendBenchmark,
    which: impl Fn((Option<Quartiles>, Option<Quartiles>)) -> Option<Quartiles>,
) {
    let _ = write!(text, "{:<26}", "");
    for laps in race.racers.iter().take(1).flat_map(|racer| &racer.laps) {
        let _ = write!(text, " {:>14}", laps.kind);
    }
    text.push('\n');
    for racer in &race.racers {
        let _ = write!(text, "{:<26}", racer.name);
        for laps in &racer.laps {
            let rate = which((laps.one_thread, laps.all_threads));
            let _ = write!(text, " {:>14}", spread(rate));
        }
        text.push('\n');
    }
}

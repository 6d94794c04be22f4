//! The race as a picture: a row a racer, a column a question.

use crate::race::aimed::Asked;
use crate::race::table::out_of_time;
use crate::race::{Finish, Race, Spread};
use std::fmt::Write;

const ROW: f64 = 34.0;
const TOP: f64 = 118.0;
const NAMES: f64 = 210.0;
/// Of the text below.
const LINE: f64 = 18.0;
const COLUMN: f64 = 170.0;
/// Longest bar; the rest of a column is for its number.
const BAR: f64 = 108.0;
const ONE: &str = "#1f5f8b";
const ALL: &str = "#a9cbe0";
const BAD: &str = "#b5482a";

/// What a racer shows in a column.
enum Cell {
    /// One thread, all threads.
    Speeds(Spread, Spread),
    Seconds(Spread),
    Number(f64),
    /// Edges, vertices: misses per million.
    Misses(f64, f64),
    Unknown,
    /// Its time was over before.
    OutOfTime,
}

impl Cell {
    fn largest(&self) -> f64 {
        match self {
            Cell::Speeds(one, all) => one.high.max(all.high),
            Cell::Seconds(s) => s.high,
            Cell::Number(n) => *n,
            Cell::Misses(edges, vertices) => edges.max(*vertices),
            Cell::Unknown | Cell::OutOfTime => 0.0,
        }
    }
}

/// SVG of a race on the mesh called `name`.
pub fn plot(race: &Race, name: &str) -> String {
    let columns = columns(race);
    let width = NAMES + COLUMN * columns.len() as f64 + 20.0;
    let late = out_of_time(race).len() as f64;
    let height = TOP + ROW * race.racers.len() as f64 + 84.0 + LINE * late;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" \
         font-family=\"sans-serif\" font-size=\"12\" fill=\"#222\">\
         <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\
         <text x=\"16\" y=\"30\" font-size=\"18\" font-weight=\"bold\">Ray–mesh intersection on {}: \
         {} triangles</text>",
        escaped(name),
        race.triangles
    );
    let bottom = TOP + ROW * race.racers.len() as f64;
    for (i, racer) in race.racers.iter().enumerate() {
        let y = TOP + ROW * i as f64;
        if i % 2 == 0 {
            let _ = write!(
                svg,
                "<rect x=\"0\" y=\"{y}\" width=\"{width}\" height=\"{ROW}\" fill=\"#f4f4f4\"/>"
            );
        }
        let weight = if racer.name.starts_with("lasertrace") {
            "bold"
        } else {
            "normal"
        };
        let _ = write!(
            svg,
            "<text x=\"16\" y=\"{}\" font-weight=\"{weight}\">{}</text>",
            y + ROW / 2.0 + 4.0,
            escaped(racer.name)
        );
    }
    for (c, (title, unit, cell)) in columns.iter().enumerate() {
        let x = NAMES + COLUMN * c as f64;
        let cells: Vec<Cell> = race.racers.iter().map(cell).collect();
        let largest = cells.iter().map(Cell::largest).fold(1e-12, f64::max);
        let _ = write!(
            svg,
            "<text x=\"{x}\" y=\"{}\" font-weight=\"bold\">{title}</text>\
             <text x=\"{x}\" y=\"{}\" fill=\"#666\">{unit}</text>\
             <line x1=\"{x}\" x2=\"{x}\" y1=\"{TOP}\" y2=\"{bottom}\" stroke=\"#999\"/>",
            TOP - 28.0,
            TOP - 12.0
        );
        for (i, cell) in cells.iter().enumerate() {
            draw(&mut svg, cell, [x, TOP + ROW * i as f64], BAR / largest);
        }
    }
    legend(&mut svg, race, bottom);
    svg + "</svg>\n"
}

type Column<'r> = (String, &'static str, Box<dyn Fn(&Finish) -> Cell + 'r>);

fn columns(race: &Race) -> Vec<Column<'_>> {
    let kinds = race.racers.first().map_or(0, |racer| racer.laps.len());
    let mut columns: Vec<Column> = Vec::new();
    for k in 0..kinds {
        let title = format!("{} rays", race.racers[0].laps[k].kind);
        columns.push((
            title,
            "Mrays/s, more is better",
            Box::new(move |racer| {
                let laps = &racer.laps[k];
                let speeds = laps.one_thread.zip(laps.all_threads);
                speeds.map_or(Cell::OutOfTime, |(one, all)| Cell::Speeds(one, all))
            }),
        ));
    }
    let million = |asked: Asked| 1e6 * asked.missed as f64 / asked.rays.max(1) as f64;
    columns.push((
        "build".into(),
        "s, less is better",
        Box::new(|racer| racer.build_s.map_or(Cell::OutOfTime, Cell::Seconds)),
    ));
    columns.push((
        "memory".into(),
        "bytes per triangle",
        Box::new(|racer| match racer.bytes_per_triangle {
            _ if racer.rounds == 0 => Cell::OutOfTime,
            None => Cell::Unknown,
            Some([held, _]) => Cell::Number(held),
        }),
    ));
    columns.push((
        "misses at edges, vertices".into(),
        "per million rays aimed there",
        Box::new(move |racer| match racer.rounds {
            0 => Cell::OutOfTime,
            _ => Cell::Misses(million(racer.edges), million(racer.vertices)),
        }),
    ));
    columns
}

fn draw(svg: &mut String, cell: &Cell, [x, y]: [f64; 2], scale: f64) {
    let thick = ROW / 2.0 - 5.0;
    let (upper, lower) = (y + 4.0, y + ROW / 2.0 + 1.0);
    match cell {
        Cell::Speeds(one, all) => {
            spread_bar(svg, [x, upper, thick], one, scale, ONE);
            spread_bar(svg, [x, lower, thick], all, scale, ALL);
        }
        Cell::Seconds(s) => spread_bar(svg, [x, upper + 6.0, thick], s, scale, ALL),
        Cell::Number(n) => {
            bar(
                svg,
                [x, upper + 6.0, thick],
                [n * scale, 0.0],
                ALL,
                &short(*n),
            );
        }
        Cell::Misses(edges, vertices) => {
            for (y, n) in [(upper, edges), (lower, vertices)] {
                bar(svg, [x, y, thick], [n * scale, 0.0], BAD, &short(*n));
            }
        }
        Cell::Unknown => bar(svg, [x, upper + 6.0, thick], [0.0; 2], ALL, "as Embree's"),
        Cell::OutOfTime => bar(svg, [x, upper + 6.0, thick], [0.0; 2], BAD, "out of time"),
    }
}

/// A bar to the median, with a line from quartile to quartile.
fn spread_bar(svg: &mut String, at: [f64; 3], s: &Spread, scale: f64, color: &str) {
    let [x, y, thick] = at;
    let lengths = [s.median * scale, s.high * scale];
    bar(svg, at, lengths, color, &short(s.median));
    let (low, high, y) = (x + s.low * scale, x + lengths[1], y + thick / 2.0);
    let _ = write!(
        svg,
        "<line x1=\"{low:.1}\" x2=\"{high:.1}\" y1=\"{y}\" y2=\"{y}\" stroke=\"#222\" stroke-width=\"2\"/>"
    );
}

/// A bar; its label stands behind `clear`, to where a whisker may reach.
fn bar(
    svg: &mut String,
    [x, y, thick]: [f64; 3],
    [length, clear]: [f64; 2],
    color: &str,
    label: &str,
) {
    let _ = write!(
        svg,
        "<rect x=\"{x}\" y=\"{y:.1}\" width=\"{length:.1}\" height=\"{thick}\" fill=\"{color}\"/>\
         <text x=\"{:.1}\" y=\"{:.1}\" font-size=\"11\">{label}</text>",
        x + length.max(clear) + 6.0,
        y + thick - 2.0
    );
}

fn legend(svg: &mut String, race: &Race, bottom: f64) {
    for (x, color, label) in [
        (16.0, ONE, "one thread, processor time".to_owned()),
        (230.0, ALL, format!("{} threads, wall time", race.threads)),
    ] {
        let _ = write!(
            svg,
            "<rect x=\"{x}\" y=\"48\" width=\"14\" height=\"12\" fill=\"{color}\"/>\
             <text x=\"{}\" y=\"58\">{label}</text>",
            x + 20.0
        );
    }
    let lines = [
        format!(
            "Bars are medians of {} rounds in which all took turns; black lines reach from quartile to quartile. \
             Every kind has {} rays.",
            race.effort.rounds, race.effort.rays
        ),
        "Camera: a picture of the part. Sheet: the laser's fans. Shadow: from what the camera sees to the laser, any hit. \
         Diffuse: from there in random directions."
            .into(),
        "A miss is a ray aimed at an edge (upper bar) or a vertex (lower bar) of triangles that face it, which meets nothing there."
            .into(),
    ];
    let late = out_of_time(race);
    for (i, line) in lines.iter().chain(&late).enumerate() {
        let (y, line) = (bottom + 26.0 + LINE * i as f64, escaped(line));
        let _ = write!(svg, "<text x=\"16\" y=\"{y}\" fill=\"#444\">{line}</text>");
    }
}

/// Three digits.
fn short(value: f64) -> String {
    let digits = match value {
        v if v == 0.0 || v >= 100.0 => 0,
        v if v >= 10.0 => 1,
        v if v >= 1.0 => 2,
        _ => 3,
    };
    format!("{value:.digits$}")
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;")
}

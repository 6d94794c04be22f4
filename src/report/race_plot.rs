//! Plot of the ray-tracing benchmark: one row per competitor, one column per measurement.

use super::axes::{ChartPoint, legend};
use super::svg::Svg;
use crate::race::aimed::MissCount;
use crate::race::table::out_of_time;
use crate::race::{BackendBenchmark, BackendResult, Quartiles};

const ROW: f64 = 34.0;
const TOP: f64 = 118.0;
const NAMES: f64 = 210.0;
/// Line height of the text below the plot, px.
const LINE: f64 = 18.0;
const COLUMN: f64 = 170.0;
/// Length of the longest bar, px; the rest of a column is for its number.
const BAR: f64 = 108.0;
/// Thickness of a bar, px.
const THICK: f64 = ROW / 2.0 - 5.0;
const ONE: &str = "fill='#1f5f8b'";
const ALL: &str = "fill='#a9cbe0'";
const BAD: &str = "fill='#b5482a'";
const BOLD: &str = "font-weight='bold'";

/// Content of a table cell.
enum Cell {
    /// With one thread and with all threads.
    Speeds(Quartiles, Quartiles),
    Seconds(Quartiles),
    Number(f64),
    /// Misses per million at edges and at vertices.
    Misses(f64, f64),
    Unknown,
    /// The time limit was reached before this measurement.
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

/// Returns the SVG of a benchmark on the mesh called `name`.
pub fn plot(race: &BackendBenchmark, name: &str) -> String {
    let columns = columns(race);
    let width = NAMES + COLUMN * columns.len() as f64 + 20.0;
    let late = out_of_time(race).len() as f64;
    let height = TOP + ROW * race.racers.len() as f64 + 84.0 + LINE * late;
    let mut svg = Svg::file([width, height], 12.0);
    let title = format!(
        "Ray–mesh intersection on {name}: {} triangles",
        race.triangles
    );
    svg.text([16.0, 30.0], "font-size='18' font-weight='bold'", &title);
    let bottom = TOP + ROW * race.racers.len() as f64;
    for (i, racer) in race.racers.iter().enumerate() {
        let y = TOP + ROW * i as f64;
        if i % 2 == 0 {
            svg.rect([0.0, y, width, ROW], "fill='#f4f4f4'");
        }
        let style = match racer.name.starts_with("lasertrace") {
            true => BOLD,
            false => "",
        };
        svg.text([16.0, y + ROW / 2.0 + 4.0], style, racer.name);
    }
    for (c, (title, unit, cell)) in columns.iter().enumerate() {
        let x = NAMES + COLUMN * c as f64;
        let cells: Vec<Cell> = race.racers.iter().map(cell).collect();
        let largest = cells.iter().map(Cell::largest).fold(1e-12, f64::max);
        svg.text([x, TOP - 28.0], BOLD, title);
        svg.text([x, TOP - 12.0], "fill='#666'", unit);
        svg.line([x, TOP], [x, bottom], "stroke='#999'");
        for (i, cell) in cells.iter().enumerate() {
            draw(&mut svg, cell, [x, TOP + ROW * i as f64], BAR / largest);
        }
    }
    notes(&mut svg, race, bottom);
    svg.finish()
}

type PlottedColumn<'r> = (
    String,
    &'static str,
    Box<dyn Fn(&BackendResult) -> Cell + 'r>,
);

fn columns(race: &BackendBenchmark) -> Vec<PlottedColumn<'_>> {
    let kinds = race.racers.first().map_or(0, |racer| racer.laps.len());
    let mut columns: Vec<PlottedColumn> = Vec::new();
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
    let million = |asked: MissCount| 1e6 * asked.missed as f64 / asked.rays.max(1) as f64;
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

fn draw(svg: &mut Svg, cell: &Cell, [x, y]: [f64; 2], scale: f64) {
    let [upper, lower] = [y + 4.0, y + ROW / 2.0 + 1.0].map(|y| [x, y]);
    let middle = [x, y + 10.0];
    let number = |svg: &mut Svg, at, n: f64, style| {
        bar(svg, at, [n * scale, 0.0], style, &short(n));
    };
    match cell {
        Cell::Speeds(one, all) => {
            spread_bar(svg, upper, one, scale, ONE);
            spread_bar(svg, lower, all, scale, ALL);
        }
        Cell::Seconds(s) => spread_bar(svg, middle, s, scale, ALL),
        Cell::Number(n) => number(svg, middle, *n, ALL),
        Cell::Misses(edges, vertices) => {
            number(svg, upper, *edges, BAD);
            number(svg, lower, *vertices, BAD);
        }
        Cell::Unknown => bar(svg, middle, [0.0; 2], ALL, "as Embree's"),
        Cell::OutOfTime => bar(svg, middle, [0.0; 2], BAD, "out of time"),
    }
}

/// Draws a bar to the median with a line between the quartiles.
fn spread_bar(svg: &mut Svg, [x, y]: [f64; 2], s: &Quartiles, scale: f64, style: &str) {
    let lengths = [s.median * scale, s.high * scale];
    bar(svg, [x, y], lengths, style, &short(s.median));
    let y = y + THICK / 2.0;
    let quartiles = [[x + s.low * scale, y], [x + lengths[1], y]];
    svg.line(quartiles[0], quartiles[1], "stroke='#222' stroke-width='2'");
}

/// Draws a bar; its label is placed behind `clear`, the end of a possible quartile line.
fn bar(svg: &mut Svg, [x, y]: [f64; 2], [length, clear]: [f64; 2], style: &str, label: &str) {
    svg.rect([x, y, length, THICK], style);
    let place = [x + length.max(clear) + 6.0, y + THICK - 2.0];
    svg.text(place, "font-size='11'", label);
}

fn notes(svg: &mut Svg, race: &BackendBenchmark, bottom: f64) {
    let all = format!("{} threads, wall time", race.threads);
    let marks = [
        (ChartPoint::Area, ONE, "one thread, processor time"),
        (ChartPoint::Area, ALL, &all),
    ];
    legend(svg, [16.0, 58.0], [230.0, 0.0], &marks);
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
        svg.text([16.0, bottom + 26.0 + LINE * i as f64], "fill='#444'", line);
    }
}

/// Formats a number with about three significant digits.
fn short(value: f64) -> String {
    let digits = match value {
        v if v == 0.0 || v >= 100.0 => 0,
        v if v >= 10.0 => 1,
        v if v >= 1.0 => 2,
        _ => 3,
    };
    format!("{value:.digits$}")
}

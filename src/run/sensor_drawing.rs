//! Drawing of a sensor to scale: laser, camera, measuring range, and the part in it.

use super::sensor_figures::{PartSections, SensorFigures};
use crate::report::axes::{Axes, Axis, ChartPoint, legend};
use crate::report::svg::Svg;

const LIGHT: &str = "stroke='#c0392b' stroke-width='1.5'";
const SIGHT: &str = "stroke='#2471a3' stroke-width='1.2'";
const FIELD: &str = "fill='#1e8449' fill-opacity='0.15' stroke='#1e8449'";
const HOUSING: &str = "stroke='#7d3c98' stroke-width='1.5'";
const PART: &str = "stroke='#222' stroke-width='2'";
/// Maximum width of the file and height of a view, px. In the narrowest column of the live view,
/// 358 px on a phone, text of 13 px is 11 px high.
const ROOM: [f64; 2] = [420.0, 460.0];
/// Left and right margin of a view for ticks and titles, px.
const MARGINS: [f64; 2] = [70.0, 20.0];
/// Distance between the views for ticks and titles, px.
const BETWEEN: f64 = 90.0;
const DISTANCE: &str = "from the laser along the beam, mm";

/// Returns an SVG file with a view along the line and, below it, a view across it. Both have one
/// scale.
pub fn sensor_drawing(figures: &SensorFigures, cuts: &PartSections) -> String {
    let [near, far] = figures.ends();
    let [_, eye_y, eye_z] = figures.camera_mm;
    let [along, across] = [&cuts.along_line, &cuts.across_line].map(|cut| {
        let met = cut.iter().copied().filter(|(_, z)| z.is_finite());
        met.collect::<Vec<_>>()
    });
    let deepest = along.iter().chain(&across).map(|&(_, z)| z);
    // A part may be far deeper or wider than the measuring range.
    let bottom = deepest.fold(far, f64::max).min(far + (far - near)) + 0.05 * far;
    let housing = figures.housing_bounds_mm;
    let housing_from = housing.map_or(0.0, |[min, _]| min[2]);
    let top = eye_z.min(housing_from).min(0.0) - 0.03 * far;
    let aside = |axis: usize| housing.map(|ends| ends.map(|corner| corner[axis]));
    let line = wide(&along, half_field(figures));
    let side = wide(&across, 0.3 * far).max(0.0);
    let [from, to] = aside(1).unwrap_or_default();
    let beside = [
        (-side).min(1.15 * eye_y).min(1.05 * from),
        side.max(1.15 * eye_y).max(1.05 * to),
    ];
    let widths = [beside[1] - beside[0], 2.0 * line];
    let widest = widths[0].max(widths[1]);
    let scale = ((ROOM[0] - MARGINS[0] - MARGINS[1]) / widest).min(ROOM[1] / (bottom - top));
    let height = scale * (bottom - top);
    let tops = [40.0, 40.0 + height + BETWEEN];
    let end = tops[1] + height + 75.0;
    let mut svg = Svg::file([ROOM[0], end + 30.0], 13.0);
    let axes = |below: f64, names, ends: [f64; 2]| {
        let width = scale * (ends[1] - ends[0]);
        view(
            [MARGINS[0], below, width, height],
            names,
            [ends, [bottom, top]],
        )
    };
    let names = ["Seen along the line", "across the line, mm"];
    let seen = axes(tops[0], names, beside);
    draw_side(&mut svg, &seen, figures, bottom);
    let names = ["Seen across the line", "along the line, mm"];
    let front = axes(tops[1], names, [-line, line]);
    draw_front(&mut svg, &front, figures);
    let of_part = [
        (&seen, &cuts.across_line, beside),
        (&front, &cuts.along_line, [-line, line]),
    ];
    for (axes, cut, ends) in of_part {
        draw_cut(axes, &mut svg, cut, ends, [top, bottom]);
        ChartPoint::Dot.draw(&mut svg, axes.at(0.0, 0.0), "fill='#c0392b'");
    }
    let mut entries = vec![
        (ChartPoint::Line, LIGHT, "laser"),
        (ChartPoint::Line, SIGHT, "camera"),
        (ChartPoint::Area, FIELD, "measured"),
        (ChartPoint::Line, PART, "part, mid scan"),
    ];
    if let Some([min, max]) = housing {
        for (axes, axis) in [(&seen, 1), (&front, 0)] {
            let ([a, b], [c, d]) = ([min[axis], max[axis]], [min[2], max[2]]);
            let corners = [(a, c), (b, c), (b, d), (a, d), (a, c)];
            axes.curve(&mut svg, corners, HOUSING);
        }
        entries.push((ChartPoint::Line, HOUSING, "housing"));
    }
    draw_legend(&mut svg, end, &entries);
    svg.finish()
}

/// Draws the legend in lines of three entries.
fn draw_legend(svg: &mut Svg, top: f64, entries: &[(ChartPoint, &str, &str)]) {
    for (line, entries) in entries.chunks(3).enumerate() {
        let at = [20.0, top + 20.0 * line as f64];
        legend(svg, at, [130.0, 0.0], entries);
    }
}

/// Returns a view with its titles.
fn view(frame: [f64; 4], [title, x]: [&'static str; 2], ends: [[f64; 2]; 2]) -> Axes<'static> {
    Axes {
        frame,
        beyond: [0.0; 2],
        title,
        x: Axis::linear(x, ends[0]),
        y: Axis::linear(DISTANCE, ends[1]),
    }
}

/// Returns half the width of field and housing along the line.
fn half_field(figures: &SensorFigures) -> f64 {
    let field = figures.places.iter().flat_map(|place| place.field_mm);
    let housing = figures.housing_bounds_mm.into_iter().flatten();
    let ends = field.chain(housing.map(|corner| corner[0]));
    ends.fold(0.0, |most: f64, x| most.max(x.abs()))
}

/// Returns half the width that shows a cross-section, at least `least`.
fn wide(cut: &[(f64, f64)], least: f64) -> f64 {
    let most = cut.iter().fold(0.0, |most: f64, &(x, _)| most.max(x.abs()));
    1.1 * least.max(most.min(2.0 * least))
}

/// Draws the laser beam and the camera's view, viewed along the line.
fn draw_side(svg: &mut Svg, seen: &Axes, figures: &SensorFigures, bottom: f64) {
    let [near, far] = figures.ends();
    let [_, eye_y, eye_z] = figures.camera_mm;
    seen.draw(svg);
    seen.curve(svg, [(0.0, 0.0), (0.0, bottom)], LIGHT);
    for end in [near, far] {
        seen.curve(svg, [(eye_y, eye_z), (0.0, end)], SIGHT);
    }
    let across = |z: f64| [(-0.004 * far, z), (0.004 * far, z)];
    seen.band(svg, &across(near), &across(far), FIELD);
    ChartPoint::Dot.draw(svg, seen.at(eye_y, eye_z), "fill='#2471a3'");
}

/// Draws the beam from the front, and the measuring field.
fn draw_front(svg: &mut Svg, front: &Axes, figures: &SensorFigures) {
    let [_, far] = figures.ends();
    front.draw(svg);
    for side in [0, 1] {
        let slopes = figures
            .places
            .iter()
            .map(|place| place.field_mm[side] / place.distance_mm);
        let widest = slopes.max_by(|a, b| a.abs().total_cmp(&b.abs()));
        let x = widest.map_or(0.0, |slope| slope * far);
        front.curve(svg, [(0.0, 0.0), (x, far)], LIGHT);
    }
    let side = |i: usize| {
        figures
            .places
            .iter()
            .map(move |place| (place.field_mm[i], place.distance_mm))
    };
    let [left, right] = [0, 1].map(|i| side(i).collect::<Vec<_>>());
    front.band(svg, &left, &right, FIELD);
}

/// Draws the pieces of a cross-section that are inside the view.
fn draw_cut(axes: &Axes, svg: &mut Svg, cut: &[(f64, f64)], x: [f64; 2], z: [f64; 2]) {
    let inside =
        |&(at, depth): &(f64, f64)| (x[0]..=x[1]).contains(&at) && (z[0]..=z[1]).contains(&depth);
    for piece in cut
        .split(|place| !inside(place))
        .filter(|piece| piece.len() > 1)
    {
        axes.curve(svg, piece.iter().copied(), PART);
    }
}

//! Plots of an acceptance test: positions of the artefacts and statistics of the characteristics.

use super::axes::{Axes, Axis, ChartPoint, legend};
use super::svg::{END, Svg};
use crate::inspect::acceptance::Characteristic;
use crate::math::DVec3;

const VOLUME: &str = "fill='#1e8449' fill-opacity='0.08' stroke='#1e8449'";
const SPHERE: &str = "fill='#2471a3' fill-opacity='0.25' stroke='#2471a3'";
const BAR: &str = "stroke='#2471a3' stroke-dasharray='4 3'";
const PLATE: &str = "stroke='#c0392b' stroke-width='2'";
const HEIGHT: &str = "stroke='#999'";
const SPREAD: &str = "stroke='#2471a3' stroke-width='5'";
const MEAN: &str = "fill='#c0392b'";
const LIMIT: &str = "stroke='#c0392b' stroke-dasharray='6 4'";

/// An artefact in the laser frame, mm.
pub struct PlacedArtefact {
    /// True for a sphere, false for a plate.
    pub is_sphere: bool,
    /// True for a plate in front of a stationary sensor.
    pub is_level: bool,
    /// Centre of the artefact.
    pub middle: DVec3,
    /// Radius of a sphere, or half the side length of a plate.
    pub half: f64,
    /// Vectors from the centre of a plate to its sides.
    pub ends: [DVec3; 2],
}

/// Draws the artefacts in the measuring volume (limits of x, y and z, mm). The views are along the
/// scan, along the line and along the beam, with equal scale. Pairs of spheres are connected by a
/// bar.
pub fn positions(placed: &[PlacedArtefact], bounds: [[f64; 2]; 3]) -> String {
    let views = [
        ("Along the scan", 0, 2),
        ("Along the line", 1, 2),
        ("From the laser", 0, 1),
    ];
    let names = [
        "along the line, mm",
        "along the scan, mm",
        "from the laser, mm",
    ];
    // Spheres and plates extend beyond the measuring volume; spheres by up to their diameter.
    let margin = placed
        .iter()
        .filter(|one| one.is_sphere)
        .fold(0.0, |most: f64, one| most.max(2.0 * one.half));
    let ends = bounds.map(|[low, high]| {
        let margin = margin.max(0.1 * (high - low));
        [low - margin, high + margin]
    });
    let length = |axis: usize| ends[axis][1] - ends[axis][0];
    let wide = views
        .iter()
        .map(|&(_, across, _)| length(across))
        .sum::<f64>();
    let high = length(2).max(length(1));
    let scale = (880.0 / wide).min(420.0 / high);
    let mut svg = Svg::file([scale * wide + 310.0, scale * high + 130.0], 12.0);
    let mut left = 70.0;
    for (title, across, down) in views {
        let y = [ends[down][1], ends[down][0]];
        // In the view from the laser, the scan direction points upwards.
        let y = if down == 1 { [y[1], y[0]] } else { y };
        let axes = Axes {
            frame: [left, 40.0, scale * length(across), scale * length(down)],
            beyond: [0.0; 2],
            title,
            x: Axis::linear(names[across], ends[across]),
            y: Axis::linear(names[down], y),
        };
        axes.draw(&mut svg);
        let at = |p: DVec3| (p[across], p[down]);
        let corners = |k: usize| bounds[down].map(|y| (bounds[across][k], y));
        let [[a, b], [c, d]] = [corners(0), corners(1)];
        axes.band(&mut svg, &[a, c], &[b, d], VOLUME);
        let spheres: Vec<&PlacedArtefact> = placed.iter().filter(|one| one.is_sphere).collect();
        for bar in spheres.chunks(2) {
            axes.curve(&mut svg, bar.iter().map(|one| at(one.middle)), BAR);
        }
        for one in placed {
            if one.is_sphere {
                let (x, y) = at(one.middle);
                svg.circle(axes.at(x, y), scale * one.half, SPHERE);
                continue;
            }
            let style = if one.is_level { HEIGHT } else { PLATE };
            let [x, y] = one.ends;
            let corners = [x + y, x - y, -x - y, y - x, x + y].map(|end| at(one.middle + end));
            axes.curve(&mut svg, corners, style);
        }
        left += scale * length(across) + 100.0;
    }
    let entries = [
        (ChartPoint::Area, VOLUME, "measuring volume"),
        (ChartPoint::Area, SPHERE, "spheres, two a bar"),
        (ChartPoint::Line, PLATE, "plates that are scanned"),
        (ChartPoint::Line, HEIGHT, "heights"),
    ];
    let below = scale * high + 110.0;
    legend(&mut svg, [70.0, below], [190.0, 0.0], &entries);
    svg.finish()
}

/// Draws mean and 95 % interval over the seeds for each position, µm, with the limits.
pub fn characteristic_plot(characteristic: &Characteristic) -> String {
    let Characteristic { places, mpe_um, .. } = characteristic;
    let spreads = || places.iter().filter_map(|place| place.spread);
    let lowest = spreads().fold(0.0, |least: f64, spread| least.min(spread.low_um));
    let highest = spreads().fold(0.0, |most: f64, spread| most.max(spread.high_um));
    // Limits far outside the data are omitted, because they would compress the plot.
    let reach = highest.max(-lowest);
    let limits: Vec<f64> = mpe_um.iter().flat_map(|limit| [*limit, -limit]).collect();
    let shown = |limit: &&f64| limit.abs() <= 3.0 * reach && (**limit > 0.0 || lowest < 0.0);
    let (mut low, mut high) = (lowest, highest);
    for limit in limits.iter().filter(shown) {
        (low, high) = (low.min(1.1 * limit), high.max(1.1 * limit));
    }
    let room = (0.1 * (high - low)).max(1e-6);
    let row = 20.0;
    let height = row * places.len() as f64;
    let axes = Axes {
        frame: [170.0, 10.0, 560.0, height],
        beyond: [0.0; 2],
        title: "",
        x: Axis::linear(
            "µm",
            [if low < 0.0 { low - room } else { 0.0 }, high + room],
        ),
        // Labels are written next to the axis.
        y: Axis::named("", &[]),
    };
    let mut svg = Svg::part([0.0, 0.0, 760.0, height + 60.0], "", characteristic.name);
    axes.draw(&mut svg);
    for (k, place) in places.iter().enumerate() {
        let y = 10.0 + row * (k as f64 + 0.5);
        svg.text([160.0, y + 4.0], END, &place.place);
        if let Some(spread) = place.spread {
            let x = |value: f64| axes.at(value, 0.0)[0];
            svg.line([x(spread.low_um), y], [x(spread.high_um), y], SPREAD);
            ChartPoint::Diamond.draw(&mut svg, [x(spread.mean_um), y], MEAN);
        }
    }
    for &limit in limits.iter().filter(shown) {
        let x = axes.at(limit, 0.0)[0];
        svg.line([x, 10.0], [x, 10.0 + height], LIMIT);
    }
    svg.finish()
}

//! Plots of data-sheet figures of a sensor over its measuring range.

use super::axes::{Axes, Axis, ChartPoint, legend};
use super::svg::Svg;

/// Measured and predicted values at one distance from the laser, µm.
pub struct PlottedPlace {
    pub distance_mm: f64,
    pub repeatability: Option<[f64; 2]>,
    pub spatial_std: Option<[f64; 2]>,
    pub moving_average_100_columns: Option<[f64; 2]>,
    pub mean_of_profiles: Option<[f64; 2]>,
    pub correlation_length_columns: Option<[f64; 2]>,
    /// Mean error and its standard uncertainty.
    pub linearity: Option<[f64; 2]>,
    pub column_um: f64,
    pub edge_um: Option<f64>,
}

type PlottedValues = fn(&PlottedPlace) -> Option<[f64; 2]>;

const COLORS: [&str; 4] = ["#c0392b", "#2471a3", "#1e8449", "#b9770e"];
const SIDE: [f64; 2] = [430.0, 260.0];

/// Plots random error, linearity, resolution along the line and correlation length against
/// distance. Dots are measured, lines are predicted.
pub fn sheet_plot(places: &[PlottedPlace], headline: &[String; 2]) -> String {
    let mut svg = Svg::file([1100.0, 780.0], 12.0);
    svg.text(
        [80.0, 30.0],
        "font-size='16' font-weight='bold'",
        &headline[0],
    );
    svg.text([80.0, 52.0], "", &headline[1]);
    let distances = || places.iter().map(|p| p.distance_mm);
    let [near, far] = [
        distances().fold(f64::INFINITY, f64::min),
        distances().fold(0.0, f64::max),
    ];
    let margin = 0.04 * (far - near);
    let x = || Axis::linear("distance from the laser, mm", [near - margin, far + margin]);
    scatter(&mut svg, places, x());
    let limits = places.iter().filter_map(|p| p.linearity);
    let most = limits.fold(1e-3, |most: f64, [mean, u]| most.max(mean.abs() + 2.0 * u));
    let axes = Axes {
        frame: [620.0, 90.0, SIDE[0], SIDE[1]],
        beyond: [0.0; 2],
        title: "Linearity: indicated less true height, µm (bars: ± 2 u)",
        x: x(),
        y: Axis::linear("", [-1.1 * most, 1.1 * most]),
    };
    axes.draw(&mut svg);
    for place in places {
        if let Some([mean, u]) = place.linearity {
            let ends = [-2.0, 2.0].map(|k| axes.at(place.distance_mm, mean + k * u));
            svg.line(ends[0], ends[1], "stroke='#222' stroke-width='1.4'");
            ChartPoint::Dot.draw(&mut svg, axes.at(place.distance_mm, mean), "fill='#c0392b'");
        }
    }
    let series: [(&str, PlottedValues); 2] = [
        ("edge of a low step, 10 to 90 %", |p| {
            p.edge_um.map(|um| [um, um])
        }),
        ("distance of two columns", |p| Some([p.column_um; 2])),
    ];
    panel(
        &mut svg,
        places,
        [80.0, 460.0],
        "Resolution along the line, µm",
        x(),
        &series,
    );
    let series: [(&str, PlottedValues); 1] = [("n_c", |p| p.correlation_length_columns)];
    let title = "Columns within which errors are alike, n_c";
    panel(&mut svg, places, [620.0, 460.0], title, x(), &series);
    svg.finish()
}

fn scatter(svg: &mut Svg, places: &[PlottedPlace], x: Axis) {
    let series: [(&str, PlottedValues); 4] = [
        ("spatial, with speckle", |p| p.spatial_std),
        ("repeatability (static)", |p| p.repeatability),
        ("mean of 100 columns", |p| p.moving_average_100_columns),
        ("mean of 10 profiles", |p| p.mean_of_profiles),
    ];
    let all = || {
        series
            .iter()
            .flat_map(|(_, of)| places.iter().filter_map(of).flatten())
    };
    let positive = || all().filter(|&v| v > 0.0);
    let least = 10f64.powf(positive().fold(1.0, f64::min).log10().floor());
    let most = 10f64.powf(positive().fold(least * 10.0, f64::max).log10().ceil());
    let axes = Axes {
        frame: [80.0, 90.0, SIDE[0], SIDE[1]],
        beyond: [0.0; 2],
        title: "Standard deviation of a height, µm: found (dots), predicted (lines)",
        x,
        y: Axis::logarithmic("", [least, most]),
    };
    axes.draw(svg);
    drawn(svg, &axes, places, &series);
}

fn panel(
    svg: &mut Svg,
    places: &[PlottedPlace],
    at: [f64; 2],
    title: &str,
    x: Axis,
    series: &[(&str, PlottedValues)],
) {
    let all = series
        .iter()
        .flat_map(|(_, of)| places.iter().filter_map(of).flatten());
    let axes = Axes {
        frame: [at[0], at[1], SIDE[0], SIDE[1]],
        beyond: [0.0; 2],
        title,
        x,
        y: Axis::linear("", [0.0, 1.2 * all.fold(1e-3, f64::max)]),
    };
    axes.draw(svg);
    drawn(svg, &axes, places, series);
}

fn drawn(svg: &mut Svg, axes: &Axes, places: &[PlottedPlace], series: &[(&str, PlottedValues)]) {
    let mut marks = Vec::new();
    let styles: Vec<[String; 2]> = COLORS
        .iter()
        .map(|color| {
            [
                format!("fill='{color}'"),
                format!("stroke='{color}' stroke-width='1.6'"),
            ]
        })
        .collect();
    for ((name, of), [dot, line]) in series.iter().zip(&styles) {
        let values = || {
            places
                .iter()
                .filter_map(|p| of(p).map(|v| (p.distance_mm, v)))
        };
        axes.curve(
            svg,
            values().map(|(x, [_, predicted])| (x, predicted)),
            line,
        );
        for (x, [found, _]) in values() {
            ChartPoint::Dot.draw(svg, axes.at(x, found), dot);
        }
        marks.push((ChartPoint::Dot, dot.as_str(), *name));
    }
    // Legends are below the axis titles of the upper plots and inside the lower plots.
    let [left, top, _, height] = axes.frame;
    let step = 14.0;
    let first = match marks.len() {
        4 => {
            for (k, mark) in marks.iter().enumerate() {
                let place = [
                    left + 230.0 * (k % 2) as f64,
                    top + height + 52.0 + step * (k / 2) as f64,
                ];
                legend(svg, place, [0.0, step], &[*mark]);
            }
            return;
        }
        n => top + height - 8.0 - step * (n - 1) as f64,
    };
    legend(svg, [left + 8.0, first], [0.0, step], &marks);
}

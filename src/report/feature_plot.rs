//! Picture of the points and residuals of a feature as SVG text.

use super::axes::{Axes, Axis};
use super::color::{css, diverging};
use super::svg::Svg;
use crate::inspect::features::{FeatureResult, PlottedResidual};

/// Draws the points of a feature on its element, coloured by their residuals. Returns `None`
/// without points.
pub fn feature_picture(feature: &FeatureResult) -> Option<String> {
    let points = &feature.picture;
    let ends = |of: &dyn Fn(&PlottedResidual) -> f64| {
        let values = points.iter().map(of);
        let [low, high] = values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| {
            [low.min(v), high.max(v)]
        });
        let margin = 0.03 * (high - low).max(1e-6);
        [low - margin, high + margin]
    };
    let mut sizes: Vec<f64> = points.iter().map(|p| p.residual.abs() * 1e3).collect();
    sizes.sort_by(f64::total_cmp);
    // 99 % of the residuals are inside the colour scale.
    let limit = sizes.get((sizes.len() * 99 / 100).min(sizes.len().checked_sub(1)?))?;
    let limit = limit.max(1e-6);
    let is_round = matches!(feature.kind, "circle" | "cylinder" | "cone");
    let (x, y) = match is_round {
        true => ("angle, degrees", "along the axis, mm"),
        false => ("x, mm", "y, mm"),
    };
    let style = "font-family='sans-serif' font-size='12' fill='#222'";
    let mut svg = Svg::part([0.0, 0.0, 620.0, 380.0], style, &feature.name);
    let title = format!(
        "{}: residuals of {} points, blue −{limit:.2} µm to red {limit:.2} µm",
        feature.name, feature.points
    );
    let axes = Axes {
        frame: [70.0, 40.0, 520.0, 280.0],
        beyond: [0.0; 2],
        title: &title,
        x: Axis::linear(x, ends(&|p| p.at[0])),
        y: Axis::linear(y, ends(&|p| p.at[1])),
    };
    axes.draw(&mut svg);
    for point in points {
        let color = css(diverging(point.residual * 1e3, limit));
        let at = axes.at(point.at[0], point.at[1]);
        svg.circle(at, 1.5, &format!("fill='{color}'"));
    }
    Some(svg.finish())
}

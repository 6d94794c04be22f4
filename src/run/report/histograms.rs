//! Histograms of the measured quantities.

use super::{ColorLimits, ReportInput};
use crate::report::chart::HistogramPlot;
use crate::report::color::{diverging, sequential};

impl ReportInput<'_> {
    pub(super) fn histograms(&self, limits: &ColorLimits) -> Vec<(String, String)> {
        let deviations: Vec<f64> = self.valid().map(|p| p.deviation * 1e3).collect();
        let sigmas: Vec<f64> = self.valid().map(|p| p.u_deviation * 1e3).collect();
        let ratios: Vec<f64> = self
            .valid()
            .filter(|p| p.u_deviation > 0.0)
            .map(|p| p.deviation / p.u_deviation)
            .collect();
        let n = ratios.len() as f64;
        let normal = |low: f64, high: f64| {
            let cdf = |x: f64| 0.5 * (1.0 + libm::erf(x / std::f64::consts::SQRT_2));
            n * (cdf(high) - cdf(low))
        };
        let deviation_color = |d: f64| diverging(d, limits.deviation_um);
        let sigma_color = |s: f64| sequential(s, limits.sigma_um);
        let histogram = |title, values, low, high, color, expected| HistogramPlot {
            title,
            values,
            low,
            high,
            color,
            expected,
        };
        let (d, s) = (limits.deviation_um, limits.sigma_um);
        vec![
            (
                "Signed distance to the CAD.".into(),
                histogram(
                    "deviation from CAD, µm",
                    &deviations,
                    -d,
                    d,
                    &deviation_color,
                    None,
                )
                .svg(),
            ),
            (
                "Predicted standard uncertainty.".into(),
                histogram(
                    "standard uncertainty, µm",
                    &sigmas,
                    0.0,
                    s,
                    &sigma_color,
                    None,
                )
                .svg(),
            ),
            (
                "If the uncertainty is right and nothing else is off, this is the normal \
                 distribution (line)."
                    .into(),
                histogram(
                    "deviation / its standard uncertainty",
                    &ratios,
                    -4.0,
                    4.0,
                    &|_| [170, 190, 210],
                    Some(&normal),
                )
                .svg(),
            ),
        ]
    }
}

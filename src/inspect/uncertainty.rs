//! Predicted uncertainties beside what many seeds or the CAD say of them.

use super::cloud::CloudPoint;
use serde::Serialize;

/// What many seeds say of one column.
#[derive(Debug, Clone, Serialize)]
pub struct ColumnUncertainty {
    /// Column of the image.
    pub column: u32,
    /// Row of the line without speckle and noise, px.
    pub true_row_px: f64,
    /// Seeds in which the column's peak was found, without a flag.
    pub seeds: usize,
    /// Predicted standard uncertainty, root mean square over the seeds, px.
    pub predicted_px: f64,
    /// Standard deviation of the row over the seeds, px.
    pub monte_carlo_px: f64,
    /// Mean error of the row, px.
    pub bias_px: f64,
    /// Seeds whose 95 % interval, ±1.96 predicted uncertainties, holds the truth.
    pub covered: usize,
    /// Movement of the point for a row more, µm.
    pub um_per_px: f64,
}

/// A cloud's uncertainties, and how its deviations compare with them.
#[derive(Debug, Clone, Serialize)]
pub struct UncertaintyStatistics {
    /// Points without a flag; the others do not count.
    pub points: usize,
    /// Median of their positions' standard uncertainties, µm: from place to place, speckle in them, and of the calibration.
    pub median_sigma_um: f64,
    /// Median of what the same place measured again scatters by, nothing moved, µm: noise alone.
    pub median_repeatability_um: f64,
    /// Median of the lengths along the profile within which errors are alike, µm.
    pub median_correlation_length_um: f64,
    /// Median of the same lengths along the scan, µm.
    pub median_scan_correlation_length_um: f64,
    /// Correlations of the errors of a place in profiles 0, 1, 2, … apart, for a typical point, noise included. The mean over n
    /// neighbouring profiles has the variance of one times Σ_ij ρ_|i−j|/n².
    pub correlation_over_profiles: Vec<f64>,
    /// Share whose deviation is within 1.96 times its own standard uncertainty: 0.95
    /// of a part that is as its CAD says, less of any other.
    pub within_95: f64,
}

impl UncertaintyStatistics {
    /// `None` without such points.
    pub fn of(
        points: &[CloudPoint],
        correlation_over_profiles: Vec<f64>,
    ) -> Option<UncertaintyStatistics> {
        let points = || points.iter().filter(|p| p.flags.is_empty());
        let median = |of: &dyn Fn(&CloudPoint) -> f64| {
            let mut values: Vec<f64> = points().map(|p| of(p) * 1e3).collect();
            let middle = values.len() / 2;
            (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
        };
        let within = points().filter(|p| p.deviation.abs() <= 1.96 * p.deviation_sigma);
        Some(UncertaintyStatistics {
            points: points().count(),
            median_sigma_um: median(&|p| p.sigma)?,
            median_repeatability_um: median(&|p| p.repeatability)?,
            median_correlation_length_um: median(&|p| p.correlation_length)?,
            median_scan_correlation_length_um: median(&|p| p.scan_correlation_length)?,
            correlation_over_profiles,
            within_95: within.count() as f64 / points().count() as f64,
        })
    }
}

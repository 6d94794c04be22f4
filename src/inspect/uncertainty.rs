//! Predicted uncertainties compared with Monte Carlo results and with deviations from the CAD
//! surface.

use super::cloud::CloudPoint;
use serde::Serialize;

/// Monte Carlo statistics of one column over many seeds.
#[derive(Debug, Clone, Serialize)]
pub struct ColumnUncertainty {
    /// Column of the image.
    pub column: u32,
    /// Row of the line without speckle and noise, px.
    pub true_row_px: f64,
    /// Number of seeds with a peak without flags in the column.
    pub seeds: usize,
    /// Predicted standard uncertainty, root mean square over the seeds, px.
    pub predicted_px: f64,
    /// Standard deviation of the row over the seeds, px.
    pub monte_carlo_px: f64,
    /// Mean error of the row, px.
    pub bias_px: f64,
    /// Number of seeds whose 95 % interval, ±1.96 predicted uncertainties, contains the true row.
    pub covered: usize,
    /// Displacement of the point per row, µm/px.
    pub um_per_px: f64,
}

/// Uncertainties of a cloud, compared with its deviations.
#[derive(Debug, Clone, Serialize)]
pub struct UncertaintyStatistics {
    /// Number of points without a flag; only these are used.
    pub points: usize,
    /// Median standard uncertainty of the positions, µm, including speckle and calibration.
    pub median_sigma_um: f64,
    /// Median repeatability standard deviation, µm, by noise only.
    pub median_repeatability_um: f64,
    /// Median correlation length of the errors along the profile, µm.
    pub median_correlation_length_um: f64,
    /// Median correlation length of the errors along the scan, µm.
    pub median_scan_correlation_length_um: f64,
    /// Error correlations at lags of 0, 1, 2, … profiles for a typical point, including noise. The
    /// variance of the mean over n consecutive profiles is Σ_ij ρ_|i−j|/n² times the variance of
    /// one.
    pub correlation_over_profiles: Vec<f64>,
    /// Fraction of the points whose deviation is within 1.96 of its standard uncertainties. It is
    /// 0.95 for a part that agrees with its CAD model and lower for other parts.
    pub coverage_95: f64,
}

impl UncertaintyStatistics {
    /// Returns the statistics, or `None` if no point is without a flag.
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
        let within = points().filter(|p| p.deviation.abs() <= 1.96 * p.u_deviation);
        Some(UncertaintyStatistics {
            points: points().count(),
            median_sigma_um: median(&|p| p.u_position)?,
            median_repeatability_um: median(&|p| p.repeatability)?,
            median_correlation_length_um: median(&|p| p.correlation_length)?,
            median_scan_correlation_length_um: median(&|p| p.scan_correlation_length)?,
            correlation_over_profiles,
            coverage_95: within.count() as f64 / points().count() as f64,
        })
    }
}

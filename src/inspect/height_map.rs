//! Heights over a regular grid.

/// Heights of the profiles of a scan, over a regular grid.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightMap {
    /// Number of points per profile.
    pub columns: usize,
    /// Number of profiles.
    pub rows: usize,
    /// Distance of adjacent points of a profile, mm.
    pub x_step: f64,
    /// Distance of adjacent profiles, mm.
    pub y_step: f64,
    /// Heights row by row, mm; NaN where there is no point.
    pub heights: Vec<f64>,
}

impl HeightMap {
    /// Returns the fraction of the grid with a height.
    pub fn valid_fraction(&self) -> f64 {
        let valid = self.heights.iter().filter(|height| height.is_finite());
        valid.count() as f64 / self.heights.len() as f64
    }
}

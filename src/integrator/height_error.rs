//! Errors of height, and how many of them are beyond a limit.

/// Share of points that may differ from the full model by more than the tolerance.
const PROMISED_SHARE: f64 = 0.01;

/// An error of height: a bias and a standard deviation, µm; infinite if the point is
/// lost.
#[derive(Debug, Clone, Copy)]
pub struct HeightError {
    pub bias: f64,
    pub variance: f64,
}

impl HeightError {
    pub fn random(deviation: f64) -> HeightError {
        HeightError {
            bias: 0.0,
            variance: deviation * deviation,
        }
    }

    pub fn bias(bias: Option<f64>) -> HeightError {
        HeightError {
            bias: bias.map_or(f64::INFINITY, f64::abs),
            variance: 0.0,
        }
    }

    /// Biases add up at worst; what is random is independent.
    pub(super) fn and(self, other: HeightError) -> HeightError {
        HeightError {
            bias: self.bias + other.bias,
            variance: self.variance + other.variance,
        }
    }

    /// Probability that it is beyond ± `limit`, if normal.
    fn beyond(&self, limit: f64) -> f64 {
        if self.variance == 0.0 || self.bias == f64::INFINITY {
            return (self.bias > limit) as u8 as f64;
        }
        let spread = (2.0 * self.variance).sqrt();
        let tail = |z: f64| 0.5 * libm::erfc(z / spread);
        tail(limit - self.bias) + tail(limit + self.bias)
    }
}

/// Expected share of these errors beyond ± `limit`.
pub(super) fn share_beyond(errors: &[HeightError], limit: f64) -> f64 {
    errors.iter().map(|e| e.beyond(limit)).sum::<f64>() / errors.len().max(1) as f64
}

/// The limit that 99 of 100 keep; `None` if more are lost.
pub fn quantile(errors: &[HeightError]) -> Option<f64> {
    let largest = errors.iter().filter(|e| e.bias.is_finite());
    let mut high = largest.fold(0.0f64, |most, e| most.max(e.bias + 6.0 * e.variance.sqrt()));
    if share_beyond(errors, high) > PROMISED_SHARE {
        return None;
    }
    let mut low = 0.0;
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        match share_beyond(errors, middle) > PROMISED_SHARE {
            true => low = middle,
            false => high = middle,
        }
    }
    Some(high)
}

//! Errors of height, and how many of them are beyond a limit.

/// Share of points that may differ from the full model by more than the tolerance.
const PROMISED_SHARE: f64 = 0.01;

/// An error of height: a bias and a standard deviation, µm; infinite if the point is
/// lost.
#[derive(Debug, Clone, Copy)]
pub struct HeightError {
    pub bias: f64,
    pub variance: f64,
    /// What comes rarely: its variance when it comes, and how often that is.
    pub rare: f64,
    pub share: f64,
}

impl HeightError {
    pub fn random(deviation: f64) -> HeightError {
        HeightError {
            variance: deviation * deviation,
            ..HeightError::bias(Some(0.0))
        }
    }

    pub fn bias(bias: Option<f64>) -> HeightError {
        HeightError {
            bias: bias.map_or(f64::INFINITY, f64::abs),
            variance: 0.0,
            rare: 0.0,
            share: 0.0,
        }
    }

    /// Of this `variance` in all, from `expected` events.
    pub fn rare(variance: f64, expected: f64) -> HeightError {
        let share = expected.clamp(1e-9, 1.0);
        HeightError {
            rare: variance / share,
            share,
            ..HeightError::bias(Some(0.0))
        }
    }

    /// The same in another unit.
    pub(super) fn times(self, factor: f64) -> HeightError {
        HeightError {
            bias: self.bias * factor,
            variance: self.variance * factor.powi(2),
            rare: self.rare * factor.powi(2),
            share: self.share,
        }
    }

    /// Biases add up at worst; what is random is independent.
    pub(super) fn and(self, other: HeightError) -> HeightError {
        let share = self.share + other.share - self.share * other.share;
        HeightError {
            bias: self.bias + other.bias,
            variance: self.variance + other.variance,
            rare: match share > 0.0 {
                true => (self.rare * self.share + other.rare * other.share) / share,
                false => 0.0,
            },
            share,
        }
    }

    /// Probability that it is beyond ± `limit`, if both variances are normal.
    fn beyond(&self, limit: f64) -> f64 {
        let with = |variance: f64| {
            if variance == 0.0 || self.bias == f64::INFINITY {
                return (self.bias > limit) as u8 as f64;
            }
            let spread = (2.0 * variance).sqrt();
            let tail = |z: f64| 0.5 * libm::erfc(z / spread);
            tail(limit - self.bias) + tail(limit + self.bias)
        };
        let mut sum = 0.0;
        if self.share < 1.0 {
            sum += (1.0 - self.share) * with(self.variance);
        }
        if self.share > 0.0 {
            sum += self.share * with(self.variance + self.rare);
        }
        sum
    }
}

/// Expected share of these errors beyond ± `limit`.
pub(super) fn share_beyond(errors: &[HeightError], limit: f64) -> f64 {
    errors.iter().map(|e| e.beyond(limit)).sum::<f64>() / errors.len().max(1) as f64
}

/// The limit that 99 of 100 keep; `None` if more are lost.
pub fn quantile(errors: &[HeightError]) -> Option<f64> {
    let largest = errors.iter().filter(|e| e.bias.is_finite());
    let most = |e: &HeightError| e.bias + 6.0 * (e.variance + e.rare).sqrt();
    let mut high = largest.map(most).fold(0.0, f64::max);
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

//! Random height errors that are independent between points.

/// Number of standard deviations within which 99 % of normally distributed values lie.
pub const SIGMAS_OF_99: f64 = 2.575_829;

/// Maximum fraction of points whose error may exceed the stated limit.
pub const PROMISED_SHARE: f64 = 0.01;

/// Normally distributed height error.
#[derive(Debug, Clone, Copy)]
pub struct HeightError {
    /// Standard deviation, µm.
    pub deviation: f64,
}

impl HeightError {
    /// Returns an error of mean 0 and standard deviation `deviation`, µm.
    pub fn random(deviation: f64) -> HeightError {
        HeightError { deviation }
    }

    /// Returns the error multiplied by `factor`, for unit conversion.
    pub(super) fn scaled(self, factor: f64) -> HeightError {
        HeightError::random(self.deviation * factor)
    }
}

/// Returns the limit that 99 % of the errors of all points do not exceed; `None` without points.
pub fn quantile(errors: &[HeightError]) -> Option<f64> {
    let largest = errors.iter().map(|e| e.deviation).fold(0.0, f64::max);
    let beyond = |limit: f64, deviation: f64| match deviation > 0.0 {
        true => libm::erfc(limit / (deviation * 2f64.sqrt())),
        false => 0.0,
    };
    let share = |limit: f64| {
        let sum: f64 = errors.iter().map(|e| beyond(limit, e.deviation)).sum();
        sum / errors.len() as f64
    };
    let (mut low, mut high) = (0.0, SIGMAS_OF_99 * largest);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        match share(middle) > PROMISED_SHARE {
            true => low = middle,
            false => high = middle,
        }
    }
    (!errors.is_empty()).then_some(high)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 99 % of normally distributed errors are within 2.5758 standard deviations. For errors of two
    /// sizes, the mean fraction beyond the limit is 1 %.
    #[test]
    fn the_limit_holds_99_of_100() {
        let one = quantile(&[HeightError::random(2.0)]).unwrap();
        assert!((one - 2.0 * SIGMAS_OF_99).abs() < 1e-5, "{one}");
        let mixed = quantile(&[1.0, 4.0].map(HeightError::random)).unwrap();
        let share = 0.5 * (libm::erfc(mixed / 2f64.sqrt()) + libm::erfc(mixed / 4.0 / 2f64.sqrt()));
        assert!((share - 0.01).abs() < 1e-6, "{mixed} {share}");
        assert_eq!(quantile(&[]), None);
    }
}

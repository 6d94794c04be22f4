//! Measured line profile: power along the fan and width across it, as functions of the fan angle.

/// Profile of a line laser, linear between the angles of the samples.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct MeasuredProfile {
    /// Fan angles φ, rad, ascending and symmetric about 0 at the ends.
    angles: Vec<f64>,
    /// Fraction of the beam power per radian, 1/rad; its integral is 1.
    per_radian: Vec<f64>,
    /// Integral of `per_radian` up to each angle, 0 to 1.
    cumulative: Vec<f64>,
    /// 1/e² radius relative to the beam.
    widths: Vec<f64>,
    /// See [`super::Laser::constant_angle`].
    constant_angle: f64,
}

impl MeasuredProfile {
    /// Creates a profile from the fan angles, rad, the relative powers per radian, and the 1/e² radii
    /// relative to the beam. The powers are normalised.
    ///
    /// # Panics
    /// Panics unless there are at least two ascending angles, finite powers ≥ 0 with a positive
    /// integral, and as many widths > 0.
    pub fn new(angles: Vec<f64>, powers: &[f64], widths: Vec<f64>) -> MeasuredProfile {
        assert!(angles.len() >= 2 && angles.is_sorted_by(|a, b| a < b));
        assert!(powers.len() == angles.len() && widths.len() == angles.len());
        assert!(powers.iter().all(|p| p.is_finite() && *p >= 0.0));
        assert!(widths.iter().all(|w| w.is_finite() && *w > 0.0));
        // The largest power is 1, so that sums do not overflow.
        let largest = powers.iter().copied().fold(0.0, f64::max);
        let mut per_radian: Vec<f64> = powers.iter().map(|power| power / largest).collect();
        let mut cumulative = vec![0.0];
        for i in 1..angles.len() {
            let area = 0.5 * (per_radian[i] + per_radian[i - 1]) * (angles[i] - angles[i - 1]);
            cumulative.push(cumulative[i - 1] + area);
        }
        let integral = cumulative[angles.len() - 1];
        assert!(integral > 0.0, "a profile without power");
        per_radian.iter_mut().for_each(|power| *power /= integral);
        cumulative.iter_mut().for_each(|power| *power /= integral);
        MeasuredProfile {
            constant_angle: constant_angle(&angles, &per_radian)
                .min(constant_angle(&angles, &widths)),
            angles,
            per_radian,
            cumulative,
            widths,
        }
    }

    /// Returns the fraction of the power per radian, 1/rad; 0 outside the measured angles.
    pub fn power_per_radian(&self, phi: f64) -> f64 {
        let ends = [self.angles[0], self.angles[self.angles.len() - 1]];
        match (ends[0]..=ends[1]).contains(&phi) {
            true => self.interpolated(&self.per_radian, phi),
            false => 0.0,
        }
    }

    /// Returns the greatest fraction of the power per radian, 1/rad, relative to the width. The ratio of
    /// linear functions is monotonic between the samples.
    pub(super) fn greatest_peak_per_radian(&self) -> f64 {
        let ratios = self.per_radian.iter().zip(&self.widths).map(|(p, w)| p / w);
        ratios.fold(0.0, f64::max)
    }

    /// Returns the 1/e² radius relative to the beam.
    pub(super) fn width_ratio(&self, phi: f64) -> f64 {
        self.interpolated(&self.widths, phi)
    }

    /// Returns the greatest 1/e² radius relative to the beam.
    pub(super) fn greatest_width_ratio(&self) -> f64 {
        self.widths.iter().copied().fold(0.0, f64::max)
    }

    /// Returns the angle over which the power is treated as constant, rad.
    pub(super) fn constant_angle(&self) -> f64 {
        self.constant_angle
    }

    /// Returns the fraction of the power at smaller fan angles, 0 to 1.
    pub(super) fn cumulative(&self, phi: f64) -> f64 {
        let (i, fraction) = self.position(phi);
        let step = fraction * (self.angles[i + 1] - self.angles[i]);
        let here = self.per_radian[i] + fraction * (self.per_radian[i + 1] - self.per_radian[i]);
        let below = self.cumulative[i] + 0.5 * step * (self.per_radian[i] + here);
        below.clamp(0.0, 1.0)
    }

    /// Returns the fan angle below which a fraction of the power lies, rad; the inverse of
    /// [`Self::cumulative`].
    pub(super) fn quantile(&self, fraction: f64) -> f64 {
        let above = self.cumulative.partition_point(|&below| below <= fraction);
        let i = above.clamp(1, self.angles.len() - 1) - 1;
        let [low, high] = [self.per_radian[i], self.per_radian[i + 1]];
        let step = self.angles[i + 1] - self.angles[i];
        let wanted = (fraction - self.cumulative[i]).max(0.0);
        // Solution of low·x + (high − low)·x²/(2·step) = wanted without cancellation.
        let root = (low * low + 2.0 * (high - low) / step * wanted).max(0.0);
        let offset = 2.0 * wanted / (low + root.sqrt()).max(f64::MIN_POSITIVE);
        self.angles[i] + offset.min(step)
    }

    fn interpolated(&self, values: &[f64], phi: f64) -> f64 {
        let (i, fraction) = self.position(phi);
        values[i] + fraction * (values[i + 1] - values[i])
    }

    /// Returns the interval of an angle, and the position within it from 0 to 1.
    fn position(&self, phi: f64) -> (usize, f64) {
        let above = self.angles.partition_point(|&angle| angle <= phi);
        let i = above.clamp(1, self.angles.len() - 1) - 1;
        let fraction = (phi - self.angles[i]) / (self.angles[i + 1] - self.angles[i]);
        (i, fraction.clamp(0.0, 1.0))
    }
}

/// Returns the angle over which the mean of the values differs from the central value by less than
/// 1 % of it, or of a tenth of the greatest value where it is less.
///
/// At a sample where the slope changes by k, the mean over an angle a differs by at most k·a/8.
fn constant_angle(angles: &[f64], values: &[f64]) -> f64 {
    let greatest = values.iter().copied().fold(0.0, f64::max);
    let slope = |i: usize| (values[i + 1] - values[i]) / (angles[i + 1] - angles[i]);
    (1..angles.len() - 1)
        .map(|i| {
            let bend = (slope(i) - slope(i - 1)).abs();
            0.01 * 8.0 * values[i].max(0.1 * greatest) / bend
        })
        .fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Triangle from 0 at −1 rad to 1 at 0 and 0 at 1: the integral is 1, and half of the power lies
    /// below 0. Below −1 + x, the fraction is x²/2.
    #[test]
    fn a_triangle_has_the_closed_form() {
        let profile =
            MeasuredProfile::new(vec![-1.0, 0.0, 1.0], &[0.0, 7.0, 0.0], vec![1.0, 2.0, 1.0]);
        for x in [0.0f64, 0.1, 0.5, 1.0] {
            assert!((profile.power_per_radian(x - 1.0) - x).abs() < 1e-12);
            assert!((profile.cumulative(x - 1.0) - x * x / 2.0).abs() < 1e-12);
            assert!(
                (profile.quantile(x * x / 2.0) - (x - 1.0)).abs() < 1e-12,
                "{x}"
            );
            assert!((profile.cumulative(1.0 - x) - (1.0 - x * x / 2.0)).abs() < 1e-12);
        }
        assert!((profile.quantile(1.0) - 1.0).abs() < 1e-12);
        assert_eq!(profile.power_per_radian(1.1), 0.0);
        assert!((profile.width_ratio(0.25) - 1.75).abs() < 1e-12);
        assert_eq!(profile.greatest_width_ratio(), 2.0);
        // The slope of the power changes by 2 at the maximum of 1, and the slope of the width by 2 at 2.
        assert!((profile.constant_angle() - 0.04).abs() < 1e-12);
    }

    /// Intervals without power are skipped, and angles with equal cumulative power are valid.
    #[test]
    fn dark_intervals_have_no_samples() {
        let angles = vec![-2.0, -1.0, 0.0, 1.0, 2.0];
        let profile = MeasuredProfile::new(angles, &[1.0, 0.0, 0.0, 0.0, 1.0], vec![1.0; 5]);
        for i in 0..=100 {
            let phi = profile.quantile(f64::from(i) / 100.0);
            assert!((1.0 - 1e-9..=2.0).contains(&phi.abs()), "{i}: {phi}");
            assert!((profile.cumulative(phi) - f64::from(i) / 100.0).abs() < 1e-9);
        }
    }
}

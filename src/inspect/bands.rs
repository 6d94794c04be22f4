//! Tolerance bands: which points lie within the deviation that the part may have, as surely as
//! their uncertainty lets one say.
//!
//! The rule is that of ISO 14253-1 with the expanded uncertainty as guard band: a point passes if its deviation
//! lies within the band by two of its standard uncertainties or more, fails if it lies outside by more than two, and
//! is unsure between. Of points whose error is normal at most 5 of 100 pass whose true deviation lies outside,
//! and at most 5 of 100 fail whose true one lies within, however narrow the band.

use super::cloud::CloudPoint;
use crate::math::{Aabb, DVec3};
use crate::profile::Flags;
use serde::Serialize;

/// Standard uncertainties by which a deviation must lie within its band to pass, or outside to fail.
pub const GUARD: f64 = 2.0;

/// Deviations that a region of the part may have.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Band {
    /// What results call the region.
    pub name: String,
    /// Where it is, in the part's frame, mm; `None`: all that no other region has.
    pub within: Option<Aabb>,
    /// Lower and upper limit of the deviation, mm.
    pub limits: [f64; 2],
}

/// What is said of a point or a region.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// Within the band, by its guard.
    Pass,
    /// Outside, by its guard.
    Fail,
    /// Too near to a limit for its uncertainty, or of unknown uncertainty.
    Unsure,
}

impl Verdict {
    /// As in `cloud.ply`; 0 is none.
    pub fn number(verdict: Option<Verdict>) -> i32 {
        match verdict {
            None => 0,
            Some(Verdict::Pass) => 1,
            Some(Verdict::Fail) => 2,
            Some(Verdict::Unsure) => 3,
        }
    }
}

/// How the points of a region lie in their band.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RegionVerdict {
    /// The region's name.
    pub name: String,
    /// Lower and upper limit of the deviation, µm.
    pub limits_um: [f64; 2],
    /// `Fail` if a point fails; `Pass` if there are points and all pass; else `Unsure`.
    pub verdict: Verdict,
    /// Points that pass.
    pub pass: usize,
    /// Points that fail.
    pub fail: usize,
    /// Points of which neither is sure.
    pub unsure: usize,
}

impl Band {
    /// What is said of a valid point in this region.
    fn verdict(&self, point: &CloudPoint) -> Verdict {
        let [lower, upper] = self.limits;
        // The expanded uncertainty of one that is not stated has no end.
        let stated = !point.flags.contains(Flags::OUTSIDE) && point.deviation_sigma.is_finite();
        let guard = GUARD * point.deviation_sigma;
        let d = point.deviation;
        match () {
            () if !stated => Verdict::Unsure,
            () if lower + guard <= d && d <= upper - guard => Verdict::Pass,
            () if d < lower - guard || d > upper + guard => Verdict::Fail,
            () => Verdict::Unsure,
        }
    }
}

/// The region of a point and what is said of it there: the smallest box that holds the place on the CAD that the
/// point belongs to, its deviation back along the normal, or the rest of the part. `None`: a flagged point, or one
/// of no region.
pub fn judge(bands: &[Band], point: &CloudPoint) -> Option<(usize, Verdict)> {
    if !point.is_valid() {
        return None;
    }
    let foot = point.position - point.deviation * point.normal.as_dvec3();
    let volume = |band: &Band| {
        band.within
            .map_or(f64::INFINITY, |b| b.size().element_product())
    };
    let holding = bands
        .iter()
        .enumerate()
        .filter(|(_, band)| holds(band, foot));
    let (i, band) = holding.min_by(|(_, a), (_, b)| volume(a).total_cmp(&volume(b)))?;
    Some((i, band.verdict(point)))
}

fn holds(band: &Band, place: DVec3) -> bool {
    band.within
        .is_none_or(|inside| inside.min.cmple(place).all() && place.cmple(inside.max).all())
}

/// What is said of each region.
pub fn sum_up(bands: &[Band], points: &[CloudPoint]) -> Vec<RegionVerdict> {
    let mut regions: Vec<RegionVerdict> = bands
        .iter()
        .map(|band| RegionVerdict {
            name: band.name.clone(),
            limits_um: band.limits.map(|limit| limit * 1e3),
            verdict: Verdict::Unsure,
            pass: 0,
            fail: 0,
            unsure: 0,
        })
        .collect();
    for (i, verdict) in points.iter().filter_map(|point| judge(bands, point)) {
        match verdict {
            Verdict::Pass => regions[i].pass += 1,
            Verdict::Fail => regions[i].fail += 1,
            Verdict::Unsure => regions[i].unsure += 1,
        }
    }
    for region in &mut regions {
        region.verdict = match (region.pass, region.fail, region.unsure) {
            (_, 1.., _) => Verdict::Fail,
            (1.., 0, 0) => Verdict::Pass,
            _ => Verdict::Unsure,
        };
    }
    regions
}

/// How many regions pass, fail and are unsure, and which fail.
pub fn in_words(regions: &[RegionVerdict]) -> String {
    let of = |verdict| {
        regions
            .iter()
            .filter(move |region| region.verdict == verdict)
    };
    let names: Vec<&str> = of(Verdict::Fail)
        .map(|region| region.name.as_str())
        .collect();
    let failing = match names.is_empty() {
        true => String::new(),
        false => format!(" ({})", names.join(", ")),
    };
    format!(
        "of {} regions {} pass, {} are unsure, {} fail{failing}",
        regions.len(),
        of(Verdict::Pass).count(),
        of(Verdict::Unsure).count(),
        names.len(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Key, Purpose};

    fn point(x: f64, deviation: f64, deviation_sigma: f64) -> CloudPoint {
        CloudPoint {
            position: DVec3::new(x, 0.0, deviation),
            deviation,
            sigma: deviation_sigma,
            deviation_sigma,
            repeatability: 0.0,
            correlation_length: 0.0,
            direct: 1.0,
            intensity: 100.0,
            frame: 0,
            column: 0,
            row: 0.0,
            width: 1.0,
            flags: Flags::empty(),
            normal: glam::Vec3::Z,
        }
    }

    fn band(name: &str, within: Option<[f64; 2]>, limits: [f64; 2]) -> Band {
        Band {
            name: name.into(),
            within: within.map(|[from, to]| {
                Aabb::of([DVec3::new(from, -1.0, -1.0), DVec3::new(to, 1.0, 1.0)])
            }),
            limits,
        }
    }

    #[test]
    fn a_point_passes_or_fails_by_two_uncertainties() {
        let bands = [band("all", None, [-0.02, 0.03])];
        let verdict = |deviation, sigma| judge(&bands, &point(0.0, deviation, sigma)).unwrap().1;
        for (deviation, expected) in [
            (0.0, Verdict::Pass),
            (0.0099, Verdict::Pass),
            (0.0101, Verdict::Unsure),
            (0.0499, Verdict::Unsure),
            (0.0501, Verdict::Fail),
            (-0.0001, Verdict::Unsure),
            (-0.0401, Verdict::Fail),
        ] {
            assert_eq!(verdict(deviation, 0.01), expected, "{deviation}");
        }
        // A band narrower than its guards passes nothing.
        assert_eq!(verdict(0.005, 0.013), Verdict::Unsure);
        assert_eq!(verdict(0.0, f64::NAN), Verdict::Unsure);
        let mut outside = point(0.0, 0.0, 0.001);
        outside.flags = Flags::OUTSIDE;
        assert_eq!(judge(&bands, &outside), Some((0, Verdict::Unsure)));
        outside.flags = Flags::SATURATED;
        assert_eq!(judge(&bands, &outside), None);
    }

    /// Of a part whose true deviation is μ, measured with normal errors of σ, shares pass and fail as the
    /// normal distribution says. 40 000 points: each share is within 5 of its standard errors, √(p(1 − p)/n), in
    /// all but one run of 10⁶; the seed is fixed.
    #[test]
    fn shares_follow_the_normal_distribution() {
        let normal = |x: f64| 0.5 * (1.0 + libm::erf(x / std::f64::consts::SQRT_2));
        let [lower, upper, sigma, n] = [-0.03, 0.02, 0.01, 40_000.0];
        let bands = [band("all", None, [lower, upper])];
        for (k, mean) in [0.0, 0.02, 0.045].into_iter().enumerate() {
            let key = Key::new(k as u64, Purpose::Samples);
            let draw = |i: u64| {
                let (radius, turn) = (key.uniform(2 * i), key.uniform(2 * i + 1));
                let normal =
                    (-2.0 * (1.0 - radius).ln()).sqrt() * (std::f64::consts::TAU * turn).cos();
                point(0.0, mean + sigma * normal, sigma)
            };
            let points: Vec<CloudPoint> = (0..n as u64).map(draw).collect();
            let found = &sum_up(&bands, &points)[0];
            let at = |limit: f64| normal((limit - mean) / sigma);
            let pass = at(upper - 2.0 * sigma) - at(lower + 2.0 * sigma);
            let fail = at(lower - 2.0 * sigma) + 1.0 - at(upper + 2.0 * sigma);
            for (count, p) in [(found.pass, pass), (found.fail, fail)] {
                let error = (p * (1.0 - p) / n).sqrt().max(1.0 / n);
                assert!(
                    (count as f64 / n - p).abs() < 5.0 * error,
                    "{mean}: {count} {p}"
                );
            }
            assert_eq!(found.pass + found.fail + found.unsure, n as usize);
        }
    }

    #[test]
    fn a_point_belongs_to_the_smallest_region_that_holds_its_place_on_the_cad() {
        let bands = [
            band("rest", None, [-1.0, 1.0]),
            band("wide", Some([0.0, 9.0]), [-0.1, 0.1]),
            band("inner", Some([2.0, 3.0]), [0.2, 0.3]),
            band("empty", Some([20.0, 30.0]), [0.2, 0.3]),
        ];
        // The last is 5 mm above its place, and outside all boxes itself.
        let points = [-1.0, 1.0, 2.5, 4.0].map(|x| point(x, 0.0, 0.01));
        let points = [&points[..], &[point(2.5, 5.0, 0.01)]].concat();
        let regions = points.iter().map(|p| judge(&bands, p).unwrap().0);
        assert!(regions.eq([0, 1, 2, 1, 2]));
        let found = sum_up(&bands, &points);
        let verdicts = found.iter().map(|region| region.verdict);
        assert!(verdicts.eq([Verdict::Pass, Verdict::Pass, Verdict::Fail, Verdict::Unsure]));
        assert_eq!(found[2].fail, 2);
        assert_eq!(judge(&bands[1..], &point(-1.0, 0.0, 0.01)), None);
    }
}

//! Tolerance verdicts: whether the deviation of a point is within the tolerance, given its
//! uncertainty.
//!
//! The rule is ISO 14253-1 with the expanded uncertainty (k = 2) as guard band. A point passes if
//! its deviation is inside the limits by at least two standard uncertainties. It fails if its
//! deviation is outside by more than two. Otherwise, it is unsure. For normal errors, at most 5 %
//! of the points with a true deviation outside pass. At most 5 % of the points with a true
//! deviation inside fail. This holds for any width of the tolerance.

use super::cloud::CloudPoint;
use super::coverage::{Fate, SurfaceCoverage};
use crate::math::{Aabb, DVec3};
use crate::profile::Flags;
use serde::Serialize;
use std::collections::HashMap;

/// Guard band in standard uncertainties (coverage factor).
pub const GUARD_BAND_K: f64 = 2.0;

/// Tolerance for a region of the part.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ToleranceBand {
    /// Name of the region in results.
    pub name: String,
    /// Bounds of the region in the part frame, mm; `None` for the remainder of the part.
    pub within: Option<Aabb>,
    /// Lower and upper limit of the deviation, mm.
    pub limits: [f64; 2],
}

/// Verdict on a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// Inside the limits by at least the guard band.
    Pass,
    /// Outside the limits by more than the guard band.
    Fail,
    /// Closer to a limit than the guard band, or of unknown uncertainty.
    Unsure,
}

impl Verdict {
    /// Returns the code used in `cloud.ply`; 0 for no verdict.
    pub fn number(verdict: Option<Verdict>) -> i32 {
        match verdict {
            None => 0,
            Some(Verdict::Pass) => 1,
            Some(Verdict::Fail) => 2,
            Some(Verdict::Unsure) => 3,
        }
    }
}

/// Numbers of points and area fractions of a region by verdict. A region has no verdict, because
/// one noisy point in thousands would decide it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RegionVerdict {
    /// Name of the region.
    pub name: String,
    /// Lower and upper limit of the deviation, µm.
    pub limits_um: [f64; 2],
    /// Fractions of the area; `None` if no area of the region has a point without a flag.
    pub area: Option<AreaFractions>,
    /// Number of points that pass.
    pub pass: usize,
    /// Number of points that fail.
    pub fail: usize,
    /// Number of points with neither verdict.
    pub unsure: usize,
}

/// Fractions of the CAD area by the interval of the deviation, d ± [`GUARD_BAND_K`] standard
/// uncertainties, of the nearest point without a flag. The first three sum to 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AreaFractions {
    /// The interval is within the limits.
    pub within: f64,
    /// The interval is outside the limits.
    pub beyond: f64,
    /// The interval contains a limit.
    pub across: f64,
    /// Area that these fractions refer to, mm².
    pub judged_mm2: f64,
    /// Area of the region, mm²; the rest has no point without a flag.
    pub area_mm2: f64,
}

impl ToleranceBand {
    /// Returns the verdict on a valid point in this region.
    fn verdict(&self, point: &CloudPoint) -> Verdict {
        let [lower, upper] = self.limits;
        // A point without a stated uncertainty has an unbounded expanded uncertainty.
        let stated =
            !point.flags.contains(Flags::UNCERTAINTY_NOT_VALID) && point.u_deviation.is_finite();
        let guard = GUARD_BAND_K * point.u_deviation;
        let d = point.deviation;
        match () {
            () if !stated => Verdict::Unsure,
            () if lower + guard <= d && d <= upper - guard => Verdict::Pass,
            () if d < lower - guard || d > upper + guard => Verdict::Fail,
            () => Verdict::Unsure,
        }
    }
}

/// Returns the region of a point, and the verdict.
///
/// The region is the smallest one that contains the position on the CAD surface. This position is
/// the point moved back along the normal by its deviation. Returns `None` for flagged points and
/// for points outside all regions.
pub fn classify_point(bands: &[ToleranceBand], point: &CloudPoint) -> Option<(usize, Verdict)> {
    if !point.is_valid() {
        return None;
    }
    let region = region_of(bands, on_cad(point))?;
    Some((region, bands[region].verdict(point)))
}

/// Returns the position on the CAD surface that corresponds to a point.
fn on_cad(point: &CloudPoint) -> DVec3 {
    point.position - point.deviation * point.normal.as_dvec3()
}

/// Returns the smallest region that contains a position on the CAD surface.
fn region_of(bands: &[ToleranceBand], position: DVec3) -> Option<usize> {
    let volume = |band: &ToleranceBand| {
        band.within
            .map_or(f64::INFINITY, |b| b.size().element_product())
    };
    let holding = (0..bands.len()).filter(|&i| holds(&bands[i], position));
    holding.min_by(|&a, &b| volume(&bands[a]).total_cmp(&volume(&bands[b])))
}

fn holds(band: &ToleranceBand, place: DVec3) -> bool {
    band.within
        .is_none_or(|inside| inside.min.cmple(place).all() && place.cmple(inside.max).all())
}

/// Counts the points of each region by verdict, and computes its area fractions.
pub fn summarise_regions(
    bands: &[ToleranceBand],
    points: &[CloudPoint],
    coverage: Option<&SurfaceCoverage>,
) -> Vec<RegionVerdict> {
    let mut regions: Vec<RegionVerdict> = bands
        .iter()
        .map(|band| RegionVerdict {
            name: band.name.clone(),
            limits_um: band.limits.map(|limit| limit * 1e3),
            area: None,
            pass: 0,
            fail: 0,
            unsure: 0,
        })
        .collect();
    for (i, verdict) in points
        .iter()
        .filter_map(|point| classify_point(bands, point))
    {
        match verdict {
            Verdict::Pass => regions[i].pass += 1,
            Verdict::Fail => regions[i].fail += 1,
            Verdict::Unsure => regions[i].unsure += 1,
        }
    }
    let areas = coverage.map(|coverage| areas(bands, points, coverage));
    for (region, area) in regions.iter_mut().zip(areas.into_iter().flatten()) {
        region.area = area;
    }
    regions
}

/// Distance within which a point represents the surface, in mean point distances. The distance
/// between frames is often greater than the distance between columns.
const REPRESENTED: f64 = 4.0;

/// Returns the area fractions of each region. The samples of the coverage represent equal areas,
/// and each has the verdict of the nearest point without a flag.
fn areas(
    bands: &[ToleranceBand],
    points: &[CloudPoint],
    coverage: &SurfaceCoverage,
) -> Vec<Option<AreaFractions>> {
    let mut samples = vec![0usize; bands.len()];
    let mut measured: Vec<(DVec3, usize)> = Vec::new();
    for &(position, fate) in &coverage.places {
        let Some(region) = region_of(bands, position) else {
            continue;
        };
        samples[region] += 1;
        if fate == Fate::Measured {
            measured.push((position, region));
        }
    }
    let nearest = nearest_points(&measured, points, coverage.points_per_mm2);
    let mut verdicts = vec![[0usize; 3]; bands.len()];
    for (&(_, region), point) in measured.iter().zip(nearest) {
        if let Some(point) = point {
            verdicts[region][bands[region].verdict(point) as usize] += 1;
        }
    }
    let mm2 = coverage.area_mm2 / coverage.places.len().max(1) as f64;
    let fractions = |(verdicts, samples): ([usize; 3], usize)| {
        let judged = verdicts.iter().sum::<usize>();
        let fraction = |verdict: Verdict| verdicts[verdict as usize] as f64 / judged as f64;
        (judged > 0).then(|| AreaFractions {
            within: fraction(Verdict::Pass),
            beyond: fraction(Verdict::Fail),
            across: fraction(Verdict::Unsure),
            judged_mm2: mm2 * judged as f64,
            area_mm2: mm2 * samples as f64,
        })
    };
    verdicts.into_iter().zip(samples).map(fractions).collect()
}

/// Returns the nearest point without a flag for each position on the CAD surface. An entry is
/// `None` if no point is within [`REPRESENTED`] mean point distances.
fn nearest_points<'a>(
    positions: &[(DVec3, usize)],
    points: &'a [CloudPoint],
    points_per_mm2: Option<f64>,
) -> Vec<Option<&'a CloudPoint>> {
    let mut nearest = vec![(f64::INFINITY, None); positions.len()];
    let Some(density) = points_per_mm2.filter(|density| *density > 0.0) else {
        return vec![None; positions.len()];
    };
    let radius = REPRESENTED / density.sqrt();
    // The cell size equals the radius, so neighbours of a point are in its cell and the 26 adjacent
    // cells.
    let cell = |p: DVec3| (p / radius).floor().as_i64vec3();
    let mut cells: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
    for (i, (position, _)) in positions.iter().enumerate() {
        let at = cell(*position);
        for k in 0..27 {
            let by = glam::I64Vec3::new(k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1);
            cells.entry((at + by).to_array()).or_default().push(i);
        }
    }
    for point in points.iter().filter(|point| point.flags.is_empty()) {
        let on_cad = on_cad(point);
        for &i in cells.get(&cell(on_cad).to_array()).into_iter().flatten() {
            let distance = positions[i].0.distance(on_cad);
            if distance < nearest[i].0 && distance <= radius {
                nearest[i] = (distance, Some(point));
            }
        }
    }
    nearest.into_iter().map(|(_, point)| point).collect()
}

/// Maximum number of regions listed in a text.
const LISTED: usize = 4;

/// Returns the area fractions of each region as text. A long list is reduced to the regions with
/// the largest fraction outside the limits.
pub fn to_text(regions: &[RegionVerdict]) -> String {
    let mut sorted: Vec<&RegionVerdict> = regions.iter().collect();
    if sorted.len() > LISTED {
        let beyond = |region: &RegionVerdict| region.area.map_or(-1.0, |area| area.beyond);
        sorted.sort_by(|a, b| beyond(b).total_cmp(&beyond(a)));
    }
    let percent = |fraction: f64| format!("{:.1} %", 100.0 * fraction);
    let region = |region: &&RegionVerdict| match region.area {
        None => format!("{} has no measured area", region.name),
        Some(area) => format!(
            "{} of the measured area of {} is within its limits, {} beyond, {} across",
            percent(area.within),
            region.name,
            percent(area.beyond),
            percent(area.across)
        ),
    };
    let listed: Vec<String> = sorted.iter().take(LISTED).map(region).collect();
    let more = match sorted.len().saturating_sub(LISTED) {
        0 => String::new(),
        more => format!("; {more} more regions"),
    };
    listed.join("; ") + &more
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    fn point(x: f64, deviation: f64, u_deviation: f64) -> CloudPoint {
        CloudPoint {
            position: DVec3::new(x, 0.0, deviation),
            deviation,
            u_position: u_deviation,
            u_deviation,
            repeatability: 0.0,
            correlation_length: 0.0,
            scan_correlation_length: 0.0,
            direct_fraction: 1.0,
            intensity: 100.0,
            frame: 0,
            column: 0,
            row: 0.0,
            line_sigma_px: 1.0,
            flags: Flags::empty(),
            normal: glam::Vec3::Z,
        }
    }

    fn band(name: &str, within: Option<[f64; 2]>, limits: [f64; 2]) -> ToleranceBand {
        ToleranceBand {
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
        let verdict = |deviation, sigma| {
            classify_point(&bands, &point(0.0, deviation, sigma))
                .unwrap()
                .1
        };
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
        // A tolerance narrower than the guard bands passes no point.
        assert_eq!(verdict(0.005, 0.013), Verdict::Unsure);
        assert_eq!(verdict(0.0, f64::NAN), Verdict::Unsure);
        let mut outside = point(0.0, 0.0, 0.001);
        outside.flags = Flags::UNCERTAINTY_NOT_VALID;
        assert_eq!(classify_point(&bands, &outside), Some((0, Verdict::Unsure)));
        outside.flags = Flags::SATURATED;
        assert_eq!(classify_point(&bands, &outside), None);
    }

    /// For normal errors of σ, the fractions of points that pass and fail follow the normal
    /// distribution.
    ///
    /// Each fraction of 40 000 points is within 5 standard errors, √(p(1 − p)/n), in all but one of
    /// 10⁶ runs. The seed is fixed.
    #[test]
    fn shares_follow_the_normal_distribution() {
        let normal = |x: f64| 0.5 * (1.0 + libm::erf(x / std::f64::consts::SQRT_2));
        let [lower, upper, sigma, n] = [-0.03, 0.02, 0.01, 40_000.0];
        let bands = [band("all", None, [lower, upper])];
        for (k, mean) in [0.0, 0.02, 0.045].into_iter().enumerate() {
            let key = RngKey::new(k as u64, Purpose::Samples);
            let draw = |i: u64| {
                let (radius, turn) = (key.uniform(2 * i), key.uniform(2 * i + 1));
                let normal =
                    (-2.0 * (1.0 - radius).ln()).sqrt() * (std::f64::consts::TAU * turn).cos();
                point(0.0, mean + sigma * normal, sigma)
            };
            let points: Vec<CloudPoint> = (0..n as u64).map(draw).collect();
            let found = &summarise_regions(&bands, &points, None)[0];
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
        // The last point is 5 mm above its position on the CAD surface and outside all regions.
        let points = [-1.0, 1.0, 2.5, 4.0].map(|x| point(x, 0.0, 0.01));
        let points = [&points[..], &[point(2.5, 5.0, 0.01)]].concat();
        let regions = points.iter().map(|p| classify_point(&bands, p).unwrap().0);
        assert!(regions.eq([0, 1, 2, 1, 2]));
        let found = summarise_regions(&bands, &points, None);
        let counts = found
            .iter()
            .map(|region| [region.pass, region.fail, region.unsure]);
        assert!(counts.eq([[1, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 0]]));
        assert_eq!(classify_point(&bands[1..], &point(-1.0, 0.0, 0.01)), None);
    }

    /// The fractions refer to area and not to points.
    ///
    /// A surface of 40 × 10 mm has 4000 samples. It is measured with 100 points per mm² for x < 20
    /// and with 1 point per mm² elsewhere. The deviation exceeds the limit for x > 30, which is a
    /// quarter of the area and 1 % of the points. One point in a hundred is flagged and has a large
    /// deviation. No interval contains a limit. Positions at the border between both areas may have
    /// the verdict of the other area. The tolerance is the distance of points there, 1 mm of 40.
    #[test]
    fn fractions_are_of_area_and_not_of_points() {
        for seed in [1, 2, 3] {
            let key = RngKey::new(seed, Purpose::Samples);
            let at = |i: u64, x: f64| {
                let deviation = if x > 30.0 {
                    0.1
                } else {
                    0.001 * key.uniform(3 * i + 1)
                };
                let mut point = point(x, deviation, 0.005);
                point.position.y = 10.0 * key.uniform(3 * i);
                if i.is_multiple_of(100) {
                    (point.flags, point.deviation) = (Flags::SATURATED, 5.0);
                }
                point
            };
            let dense = (0..20_000).map(|i| at(i, 20.0 * key.uniform(3 * i + 2)));
            let sparse = (20_000..20_200).map(|i| at(i, 20.0 + 20.0 * key.uniform(3 * i + 2)));
            let points: Vec<CloudPoint> = dense.chain(sparse).collect();
            let sample = |i: usize| {
                let (x, y) = (i % 400, i / 400);
                (
                    DVec3::new((x as f64 + 0.5) / 10.0, y as f64 + 0.5, 0.0),
                    Fate::Measured,
                )
            };
            let coverage = SurfaceCoverage {
                area_mm2: 400.0,
                shares: Vec::new(),
                // The density of the sparse half; the mean density would leave positions without a
                // point.
                points_per_mm2: Some(1.0),
                samples: 4000,
                places: (0..4000).map(sample).collect(),
            };
            let bands = [band("all", None, [-0.02, 0.02])];
            let found = summarise_regions(&bands, &points, Some(&coverage))[0]
                .area
                .unwrap();
            assert!((found.beyond - 0.25).abs() < 0.025, "{seed}: {found:?}");
            assert!((found.within - 0.75).abs() < 0.025, "{seed}: {found:?}");
            assert_eq!(found.across, 0.0);
            assert!((found.area_mm2 - 400.0).abs() < 1e-9 && found.judged_mm2 > 390.0);
            let wide = [band("all", None, [-10.0, 10.0])];
            let found = summarise_regions(&wide, &points, Some(&coverage))[0]
                .area
                .unwrap();
            assert_eq!(found.within, 1.0);
        }
    }
}

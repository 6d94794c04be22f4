//! Radius, ends and deviations of the profiles of a cylinder or a sphere.

use super::sampled::{SampledStatistics, Statistic, median};
use crate::math::DVec3;
use nalgebra::{DMatrix, DVector};
use std::collections::BTreeMap;

/// Fewest points of a profile: the ends of shorter arcs are uncertain.
const MIN_POINTS: usize = 20;
/// Fewest profiles: two for each block.
pub const MIN_PROFILES: usize = 2 * BLOCKS;
/// Number of blocks of the bootstrap.
const BLOCKS: usize = 16;
/// Steps of the fit. Points are excluded after [`STEPS_WITH_ALL`] of them.
const STEPS: usize = 15;
const STEPS_WITH_ALL: usize = 4;
/// Deviation beyond which a point does not belong to the part, in standard deviations that follow
/// from the median deviation. A normal error exceeds it once in two million points.
const OUTLIER_SIGMAS: f64 = 5.0;
/// Standard deviation of a normal error, in units of the median of its magnitude.
const SIGMA_PER_MEDIAN: f64 = 1.4826;
/// Least cosine of the slope (87°) at which the deviation of a point is a difference of heights. The
/// height of a steeper point is not determined by its position.
const MIN_COSINE: f64 = 0.05;

const FORM: &str = "form of the part, residual calibration error, topography";

/// Statistics of the profiles of a round part.
pub const STATISTICS: [Statistic; 7] = [
    Statistic {
        name: "radius_mm",
        terms: "size of the part, scale of x and z, residual calibration error",
    },
    Statistic {
        name: "end_slope_deg",
        terms: "detection threshold relative to the brightness of the line, reflectance at grazing incidence",
    },
    Statistic {
        name: "missing_fraction",
        terms: "detection threshold relative to the brightness of the line, occlusion, gap filter",
    },
    Statistic {
        name: "residual_um",
        terms: FORM,
    },
    Statistic {
        name: "residual_correlation",
        terms: FORM,
    },
    Statistic {
        name: "residual_without_common_part_um",
        terms: "noise of a height, topography, error of the drive",
    },
    Statistic {
        name: "correlation_without_common_part",
        terms: "grain of the speckle, filters along the profile, resampling, topography",
    },
];

/// Shape of a round part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoundShape {
    /// Cylinder whose axis is the direction of motion. Each profile has its own circle.
    Cylinder,
    /// Sphere.
    Sphere,
}

/// Points of a profile by column: x along the profile, y along the motion, z upwards, mm.
pub type Profile = Vec<(i64, DVec3)>;

/// Points of one profile compared with the fitted shape.
#[derive(Debug)]
pub struct Arc {
    /// Radius of the shape, mm.
    pub radius: f64,
    /// Slopes of the shape at both ends of the profile, rad.
    pub end_slopes: [f64; 2],
    /// Length of the chord of the shape in the plane of the profile, mm.
    chord: f64,
    /// Length of the chord with points in adjacent columns, mm.
    covered: f64,
    /// Distances from the shape by column, µm.
    residuals: Vec<(i64, f64)>,
}

/// Circle in the x–z plane, or sphere.
struct Round {
    center: DVec3,
    radius: f64,
    /// Largest distance of a point of the part from the shape, mm.
    limit: f64,
}

impl Round {
    /// Returns the distance of a point from the shape.
    fn distance(&self, point: DVec3) -> f64 {
        (point - self.center).length() - self.radius
    }

    /// Returns the deviation of a point from the shape, and the normal of the shape to which it
    /// refers.
    ///
    /// A profile sensor measures the height z at a given x. The deviation is therefore the difference
    /// of heights times the cosine of the slope. A height error e changes the distance by
    /// e·cos θ + e²·sin²θ/(2r), whose second term has a mean that displaces the fit. Beyond
    /// [`MIN_COSINE`], the deviation is the distance.
    fn deviation(&self, point: DVec3) -> (f64, DVec3) {
        let from_center = point - self.center;
        let height = (self.radius.powi(2) - from_center.with_z(0.0).length_squared())
            .max(0.0)
            .sqrt();
        let cosine = height / self.radius;
        match from_center.z > 0.0 && cosine > MIN_COSINE {
            true => (
                (from_center.z - height) * cosine,
                from_center.with_z(height) / self.radius,
            ),
            false => (self.distance(point), from_center.normalize_or_zero()),
        }
    }

    /// Fits the shape by least squares of the deviations (Gauss–Newton), without outliers. Returns
    /// `None` if the points do not determine it.
    fn fitted(points: &[DVec3]) -> Option<Round> {
        let mut round = Round::algebraic(points)?;
        for step in 0..STEPS {
            let kept = points
                .iter()
                .filter(|&&p| round.distance(p).abs() <= round.limit);
            let kept: Vec<DVec3> = kept.copied().collect();
            let rows = kept.iter().map(|&p| {
                let (deviation, normal) = round.deviation(p);
                ([-normal.x, -normal.y, -normal.z, -1.0], -deviation)
            });
            let [x, y, z, radius] = solution(rows)?;
            round.center += DVec3::new(x, y, z);
            round.radius += radius;
            if step >= STEPS_WITH_ALL {
                let deviations = kept.iter().map(|&p| round.distance(p).abs());
                // The bound lets the points of perfect data remain, whose deviations are rounding
                // errors.
                let sigma = SIGMA_PER_MEDIAN * median(deviations.collect());
                round.limit = (OUTLIER_SIGMAS * sigma).max(1e-9 * round.radius);
            }
        }
        let valid = round.radius > 0.0 && round.radius.is_finite() && round.center.is_finite();
        valid.then_some(round)
    }

    /// Fits |p|² = 2·c·p + d, which is linear in c and d (Kåsa 1976).
    fn algebraic(points: &[DVec3]) -> Option<Round> {
        let rows = points
            .iter()
            .map(|p| ([2.0 * p.x, 2.0 * p.y, 2.0 * p.z, 1.0], p.length_squared()));
        let [x, y, z, d] = solution(rows)?;
        let center = DVec3::new(x, y, z);
        let radius = (d + center.length_squared()).sqrt();
        radius.is_finite().then_some(Round {
            center,
            radius,
            limit: f64::INFINITY,
        })
    }
}

/// Returns the least-squares solution of four unknowns. It is 0 for unknowns without effect.
fn solution(rows: impl Iterator<Item = ([f64; 4], f64)>) -> Option<[f64; 4]> {
    let (mut matrix, mut right) = (DMatrix::zeros(4, 4), DVector::zeros(4));
    for (row, value) in rows {
        let row = DVector::from_row_slice(&row);
        right += &row * value;
        matrix += &row * row.transpose();
    }
    for i in 0..4 {
        if matrix[(i, i)] == 0.0 {
            matrix[(i, i)] = 1.0;
        }
    }
    let solution = matrix.cholesky()?.solve(&right);
    Some(std::array::from_fn(|i| solution[i]))
}

/// Fits the shape to blocks of profiles. A block of a cylinder has adjacent profiles; the blocks of
/// a sphere have every sixteenth profile, so that each determines the sphere.
///
/// # Errors
/// Returns the number of usable profiles if there are fewer than [`MIN_PROFILES`].
pub fn arcs(shape: RoundShape, profiles: Vec<Profile>) -> Result<Vec<Vec<Arc>>, usize> {
    let long = profiles.into_iter().filter(|p| p.len() >= MIN_POINTS);
    let profiles: Vec<Profile> = long.collect();
    let count = profiles.len();
    if count < MIN_PROFILES {
        return Err(count);
    }
    let block_of = |i: usize| match shape {
        RoundShape::Cylinder => i * BLOCKS / count,
        RoundShape::Sphere => i % BLOCKS,
    };
    let mut blocks: Vec<Vec<Profile>> = vec![Vec::new(); BLOCKS];
    for (i, profile) in profiles.into_iter().enumerate() {
        blocks[block_of(i)].push(profile);
    }
    let of_block = |block: Vec<Profile>| -> Vec<Arc> {
        match shape {
            RoundShape::Cylinder => {
                let in_plane = |profile: Profile| -> Profile {
                    let flat = |(column, p): (i64, DVec3)| (column, DVec3::new(p.x, 0.0, p.z));
                    profile.into_iter().map(flat).collect()
                };
                let planar = block.into_iter().map(in_plane);
                planar
                    .filter_map(|profile| arc(&fitted(&[&profile])?, &profile))
                    .collect()
            }
            RoundShape::Sphere => {
                let round = fitted(&block.iter().collect::<Vec<_>>());
                let of_profile = |profile: &Profile| arc(round.as_ref()?, profile);
                block.iter().filter_map(of_profile).collect()
            }
        }
    };
    let blocks: Vec<Vec<Arc>> = blocks.into_iter().map(of_block).collect();
    match blocks.iter().all(|block| !block.is_empty()) {
        true => Ok(blocks),
        false => Err(blocks.iter().map(Vec::len).sum()),
    }
}

fn fitted(profiles: &[&Profile]) -> Option<Round> {
    let points = profiles.iter().flat_map(|profile| profile.iter());
    Round::fitted(&points.map(|&(_, point)| point).collect::<Vec<_>>())
}

/// Compares the points of a profile with the shape; `None` for fewer than [`MIN_POINTS`] points on
/// it.
fn arc(round: &Round, profile: &Profile) -> Option<Arc> {
    let on_part = |point: DVec3| {
        let distance = round.distance(point);
        point.z > round.center.z && distance.abs() <= round.limit
    };
    let kept = profile.iter().filter(|&&(_, point)| on_part(point));
    let kept: Vec<(i64, DVec3)> = kept.copied().collect();
    if kept.len() < MIN_POINTS {
        return None;
    }
    let steps = kept.windows(2).map(|pair| {
        let columns = (pair[1].0 - pair[0].0) as f64;
        (pair[1].1.x - pair[0].1.x).abs() / columns
    });
    let half_step = median(steps.collect()) / 2.0;
    // A profile ends between its last point and the next column, so half a step beyond the point.
    let slope = |[last, previous]: [usize; 2]| {
        let (last, previous) = (kept[last].1, kept[previous].1);
        let mut from_axis = last - round.center;
        from_axis.x += (last.x - previous.x).signum() * half_step;
        (from_axis.with_z(0.0).length() / round.radius)
            .min(1.0)
            .asin()
    };
    let adjacent = kept.windows(2).filter(|pair| pair[1].0 - pair[0].0 == 1);
    let covered = adjacent.map(|pair| (pair[1].1.x - pair[0].1.x).abs()).sum();
    let off_axis = kept[0].1.y - round.center.y;
    let half_chord = (round.radius.powi(2) - off_axis.powi(2)).max(0.0).sqrt();
    Some(Arc {
        radius: round.radius,
        end_slopes: [[0, 1], [kept.len() - 1, kept.len() - 2]].map(slope),
        chord: 2.0 * half_chord,
        covered,
        residuals: kept
            .iter()
            .map(|&(column, point)| (column, 1e3 * round.distance(point)))
            .collect(),
    })
}

/// Sums over pairs of points, for mean squares and correlations.
#[derive(Debug, Clone, Copy, Default)]
struct PointPairSums {
    squares: [f64; 2],
    products: [f64; 2],
}

impl PointPairSums {
    fn of(residuals: &[(i64, f64)]) -> PointPairSums {
        let squares = residuals.iter().map(|(_, r)| r * r).sum();
        let adjacent = residuals
            .windows(2)
            .filter(|pair| pair[1].0 - pair[0].0 == 1);
        let (mut product, mut scale) = (0.0, 0.0);
        for pair in adjacent {
            product += pair[0].1 * pair[1].1;
            scale += (pair[0].1.powi(2) + pair[1].1.powi(2)) / 2.0;
        }
        PointPairSums {
            squares: [squares, residuals.len() as f64],
            products: [product, scale],
        }
    }

    fn add(&mut self, other: &PointPairSums) {
        for i in 0..2 {
            self.squares[i] += other.squares[i];
            self.products[i] += other.products[i];
        }
    }

    /// Returns the root mean square, and the correlation of adjacent points.
    fn values(&self) -> [f64; 2] {
        [
            (self.squares[0] / self.squares[1]).sqrt(),
            self.products[0] / self.products[1].max(f64::MIN_POSITIVE),
        ]
    }
}

/// Computes the statistics of the profiles of a round part. `seed` selects the bootstrap samples.
///
/// # Errors
/// Returns the errors of [`arcs`].
pub fn round_statistics(
    shape: RoundShape,
    profiles: Vec<Profile>,
    seed: u64,
) -> Result<SampledStatistics, usize> {
    let blocks = arcs(shape, profiles)?;
    let arcs = blocks.iter().flatten();
    let count = arcs.clone().count();
    let mut by_column: BTreeMap<i64, [f64; 2]> = BTreeMap::new();
    for &(column, residual) in arcs.flat_map(|arc| &arc.residuals) {
        let [sum, number] = by_column.entry(column).or_default();
        *sum += residual;
        *number += 1.0;
    }
    // Most profiles have the columns that are compared. The mean of n values has 1/n of their
    // variance.
    let own = |&(column, residual): &(i64, f64)| {
        let [sum, number] = by_column[&column];
        let factor = (number / (number - 1.0).max(1.0)).sqrt();
        (number > count as f64 / 2.0).then_some((column, factor * (residual - sum / number)))
    };
    let evaluated = |arc: Arc| {
        let of_all = PointPairSums::of(&arc.residuals);
        let rest: Vec<(i64, f64)> = arc.residuals.iter().filter_map(own).collect();
        (arc, of_all, PointPairSums::of(&rest))
    };
    let blocks: Vec<Vec<(Arc, PointPairSums, PointPairSums)>> = blocks
        .into_iter()
        .map(|block| block.into_iter().map(evaluated).collect())
        .collect();
    let values = |blocks: &[&Vec<(Arc, PointPairSums, PointPairSums)>]| {
        let arcs = || blocks.iter().flat_map(|block| block.iter());
        let ends = arcs().flat_map(|(arc, ..)| arc.end_slopes);
        let covered: f64 = arcs().map(|(arc, ..)| arc.covered).sum();
        let chords: f64 = arcs().map(|(arc, ..)| arc.chord).sum();
        let (mut all, mut rest) = (PointPairSums::default(), PointPairSums::default());
        for (_, of_all, of_rest) in arcs() {
            all.add(of_all);
            rest.add(of_rest);
        }
        let [[residual, correlation], [own, own_correlation]] = [all.values(), rest.values()];
        vec![
            median(arcs().map(|(arc, ..)| arc.radius).collect()),
            median(ends.map(f64::to_degrees).collect()),
            1.0 - covered / chords,
            residual,
            correlation,
            own,
            own_correlation,
        ]
    };
    Ok(SampledStatistics::of(&blocks, count, seed, values))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};
    use rand_distr::{Distribution, Normal};

    /// Errors of heights do not bias the radius.
    ///
    /// The mean over 200 fits is compared with the true radius at a false-alarm rate of 0.001 (3.3
    /// standard errors of the mean).
    #[test]
    fn height_errors_do_not_bias_the_radius() {
        let (radius, fits) = (5.0, 200);
        let noise = Normal::new(0.0, 0.2).unwrap();
        let mut stream = RngKey::new(5, Purpose::Bootstrap).counter_stream();
        let grid =
            (-45..=45).flat_map(|i| (-45..=45).map(move |j| [i, j].map(|i| 0.1 * f64::from(i))));
        let within = grid.filter(|[x, y]| x.hypot(*y) < radius * 70f64.to_radians().sin());
        let grid: Vec<[f64; 2]> = within.collect();
        let errors: Vec<f64> = (0..fits)
            .map(|_| {
                let height = |&[x, y]: &[f64; 2]| (radius * radius - x * x - y * y).sqrt();
                let point = |at: &[f64; 2]| {
                    DVec3::new(at[0], at[1], height(at) + noise.sample(&mut stream))
                };
                let points: Vec<DVec3> = grid.iter().map(point).collect();
                Round::fitted(&points).unwrap().radius - radius
            })
            .collect();
        let mean = errors.iter().sum::<f64>() / f64::from(fits);
        let squares: f64 = errors.iter().map(|e| (e - mean).powi(2)).sum();
        let standard_error = squares.sqrt() / f64::from(fits);
        assert!(
            mean.abs() < 3.3 * standard_error,
            "{mean} ± {standard_error}"
        );
    }
}

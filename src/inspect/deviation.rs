//! Deviations of measured points from the CAD surface.

use crate::accel::{Accel, TriangleId, facing_normal};
use crate::math::DVec3;
use rayon::prelude::*;
use serde::Serialize;

/// Returns the signed distance (mm) from `point` to the nearest point of the part, and the unit
/// normal there towards `eye`. The distance is positive outside the material.
///
/// An error of the point along the normal is an error of the distance. For a closed mesh with
/// consistent winding, outward or inward, the mesh defines the outside. For other meshes, the
/// outside is the side visible from `eye`, which is wrong for points beyond the silhouette. `close`
/// is a triangle close to the point, if known, and is set to the nearest triangle.
pub fn signed_distance(
    accel: &Accel,
    point: DVec3,
    eye: DVec3,
    close: &mut Option<TriangleId>,
) -> (f64, DVec3) {
    let nearest = accel.nearest(point, *close);
    *close = Some(nearest.face);
    let corners = accel.corners(nearest.face);
    let seen = facing_normal(corners, nearest.point - eye).unwrap_or(DVec3::ZERO);
    let outward = accel.outward(nearest.face, nearest.point).unwrap_or(seen);
    let sign = match outward.dot(point - nearest.point) < 0.0 {
        true => -1.0,
        false => 1.0,
    };
    (sign * nearest.distance, seen)
}

/// Statistics of signed deviations, µm.
#[derive(Debug, Clone, Serialize)]
pub struct DeviationStatistics {
    /// Number of points.
    pub points: usize,
    /// Arithmetic mean.
    pub mean_um: f64,
    /// Standard deviation about the mean.
    pub std_um: f64,
    /// Root mean square.
    pub rms_um: f64,
    /// Minimum.
    pub min_um: f64,
    /// Maximum.
    pub max_um: f64,
    /// Pairs of percentile and deviation.
    pub percentiles_um: Vec<(f64, f64)>,
}

impl DeviationStatistics {
    /// Returns the statistics, or `None` without points.
    pub fn of(deviations_mm: impl IntoIterator<Item = f64>) -> Option<DeviationStatistics> {
        let mut sorted: Vec<f64> = deviations_mm.into_iter().map(|d| d * 1e3).collect();
        sorted.par_sort_unstable_by(f64::total_cmp);
        let (&min_um, &max_um) = (sorted.first()?, sorted.last()?);
        let n = sorted.len() as f64;
        let mean = sorted.iter().sum::<f64>() / n;
        let variance = sorted.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / n;
        // Nearest rank.
        let at = |p: f64| sorted[((p / 100.0 * n).ceil() as usize).clamp(1, sorted.len()) - 1];
        Some(DeviationStatistics {
            points: sorted.len(),
            mean_um: mean,
            std_um: variance.sqrt(),
            rms_um: (variance + mean * mean).sqrt(),
            min_um,
            max_um,
            percentiles_um: [1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0]
                .map(|p| (p, at(p)))
                .to_vec(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Mesh;

    #[test]
    fn the_sign_of_an_open_mesh_follows_the_eye_whatever_the_winding() {
        for triangle in [[0, 1, 2], [0, 2, 1]] {
            let mesh = Mesh {
                positions: vec![DVec3::ZERO, DVec3::X, DVec3::Y],
                triangles: vec![triangle],
            };
            let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
            let above = DVec3::new(0.2, 0.2, 0.01);
            let eye = DVec3::new(0.0, 0.0, 50.0);
            let (distance, normal) = signed_distance(&accel, above, eye, &mut None);
            assert!((distance - 0.01).abs() < 1e-12 && (normal - DVec3::Z).length() < 1e-12);
            let (distance, normal) = signed_distance(&accel, above, -eye, &mut None);
            assert!((distance + 0.01).abs() < 1e-12 && (normal + DVec3::Z).length() < 1e-12);
        }
    }

    #[test]
    fn statistics_of_one_to_a_hundred() {
        let s = DeviationStatistics::of((1..=100).map(|i| i as f64 * 1e-3)).unwrap();
        assert_eq!((s.points, s.min_um, s.max_um), (100, 1.0, 100.0));
        assert!((s.mean_um - 50.5).abs() < 1e-9);
        assert!((s.std_um - (9999.0f64 / 12.0).sqrt()).abs() < 1e-9);
        assert_eq!(s.percentiles_um[3], (50.0, 50.0));
        assert!(DeviationStatistics::of([]).is_none());
    }
}

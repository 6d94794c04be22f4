//! Points that the sensor delivers: measured points filtered along the profile and over frames.

use super::RunControl;
use super::measure::trace;
use super::scan::check_averaged;
use super::simulation::Simulation;
use crate::error::Result;
use crate::inspect::align::{Alignment, best_fit};
use crate::inspect::cloud::CloudPoint;
use crate::inspect::deviation::signed_distance;
use crate::inspect::features::FeatureResult;
use crate::math::{DVec2, DVec3};
use crate::profile::{
    DeliveredRow, Filters, Flags, MeasuredRow, PointJacobian, ProfileFilter, Smooth,
};
use crate::run::scan_speckle::frame_steps;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// A measured point and the error components of its row.
struct MeasuredPoint<'a> {
    point: &'a CloudPoint,
    row: MeasuredRow,
    jacobian: PointJacobian,
    /// Variance of the position due to the calibration and systematic errors, mm².
    common: f64,
}

impl Simulation {
    /// Simulates all frames and returns the points that a scan delivers, before alignment. The
    /// progress is the number of frames.
    #[doc(hidden)]
    pub fn scanned_points(&self, control: &RunControl) -> Result<Vec<CloudPoint>> {
        let frames = 0..self.scene.scan.frames;
        let done = AtomicU64::new(0);
        let profiles = frames.clone().into_par_iter().map(|frame| {
            control.check()?;
            let points = self.profile(frame).1;
            (control.progress)(1 + done.fetch_add(1, Ordering::Relaxed));
            Ok(points)
        });
        let points = profiles.collect::<Result<Vec<_>>>()?.concat();
        self.scan_points(&frames, points, |frame| Ok(self.profile(frame).1))
    }

    /// Simulates all frames and evaluates the features, with the alignment of the scene. The results
    /// are those of a scan. The progress is the number of frames.
    #[doc(hidden)]
    pub fn scanned_features(&self, control: &RunControl) -> Result<Vec<FeatureResult>> {
        Ok(self.features(&self.aligned_points(control)?))
    }

    /// Simulates all frames and returns the points of the scan, with the alignment of the scene.
    pub(crate) fn aligned_points(&self, control: &RunControl) -> Result<Vec<CloudPoint>> {
        let mut points = self.scanned_points(control)?;
        self.align(&mut points);
        Ok(points)
    }

    /// Aligns the cloud with the CAD surface if the scene requests it. Flagged points are moved, but
    /// do not affect the fit.
    pub(super) fn align(&self, points: &mut [CloudPoint]) -> Option<Alignment> {
        match self.scene.measure.align {
            true => self.fit_to_cad(points),
            false => None,
        }
    }

    /// Aligns the cloud with the CAD surface.
    pub(super) fn fit_to_cad(&self, points: &mut [CloudPoint]) -> Option<Alignment> {
        let valid = points.iter().filter(|p| p.is_valid());
        let positions: Vec<DVec3> = valid.map(|p| p.position).collect();
        let fit = best_fit(self.accel.nominal(), &positions)?;
        points
            .par_iter_mut()
            .for_each(|point| *point = self.moved(point, &fit.part_from_measured));
        Some(fit)
    }

    /// Returns the points that a scan of these frames delivers, before alignment. `points` are the
    /// measured points of all frames, and `measured` returns the points of another frame. Errors:
    /// frames that do not form complete profiles.
    #[doc(hidden)]
    pub fn scan_points(
        &self,
        frames: &Range<u32>,
        mut points: Vec<CloudPoint>,
        measured: impl Fn(u32) -> Result<Vec<CloudPoint>> + Sync,
    ) -> Result<Vec<CloudPoint>> {
        check_averaged(&self.scene, frames)?;
        self.compare_piece(frames, &mut points, measured)?;
        Ok(self.filtered_points(points))
    }

    /// Returns the filtered points. `points` are sorted by frame, then column, and contain complete
    /// groups of averaged frames. Flagged points are unchanged and do not affect other points.
    #[doc(hidden)]
    pub fn filtered_points(&self, points: Vec<CloudPoint>) -> Vec<CloudPoint> {
        let filters = self.scene.measure.filters;
        if filters == Filters::default() {
            return points;
        }
        let count = filters.average_frames;
        // Only a median requires the share.
        let noise_share = match filters.smooth {
            Some(Smooth::Median(_)) => self.noise_share(&points),
            _ => 0.0,
        };
        let filter = ProfileFilter::new(
            filters,
            self.column_correlation().to_vec(),
            frame_steps(&self.scene, (0..count).map(f64::from)),
            noise_share,
            self.calibration.clone(),
        );
        let groups: Vec<&[CloudPoint]> = points
            .chunk_by(|a, b| a.frame / count == b.frame / count)
            .collect();
        let delivered = groups
            .par_iter()
            .map(|group| self.group(&filter, group, count));
        delivered.collect::<Vec<_>>().concat()
    }

    /// Returns the median fraction of the variance of a row that is independent between columns.
    fn noise_share(&self, points: &[CloudPoint]) -> f64 {
        let share = |m: MeasuredPoint| {
            let independent = m.row.noise.powi(2) + m.row.pattern.powi(2);
            independent / (independent + m.row.speckle.powi(2)).max(f64::MIN_POSITIVE)
        };
        let valid = points.iter().filter(|p| p.is_valid() && p.u_position > 0.0);
        let mut shares: Vec<f64> = valid
            .filter_map(|point| self.measured(point).map(share))
            .collect();
        shares.sort_by(f64::total_cmp);
        shares.get(shares.len() / 2).copied().unwrap_or(0.0)
    }

    /// Returns the correlations of the errors of one position between profiles at a lag of 0, 1, 2,
    /// …. They include noise and apply to a typical delivered point. The list ends at the last
    /// value above 0.001; it is empty without points.
    #[doc(hidden)]
    pub fn correlation_over_profiles(&self, points: &[CloudPoint]) -> Vec<f64> {
        let Some((typical, correlation)) = self.typical_over_profiles(points) else {
            return Vec::new();
        };
        let speckle = 1.0
            - (typical.repeatability / typical.u_position)
                .powi(2)
                .min(1.0);
        let correlation = correlation.into_iter().enumerate();
        let with_noise = correlation.map(|(lag, rho)| if lag == 0 { 1.0 } else { speckle * rho });
        truncated(with_noise.collect())
    }

    /// Returns the correlations of the speckle errors of one position between profiles, as
    /// [`Self::correlation_over_profiles`] does, without noise.
    pub(super) fn speckle_over_profiles(&self, points: &[CloudPoint]) -> Vec<f64> {
        let typical = self.typical_over_profiles(points);
        typical.map_or(vec![1.0], |(_, correlation)| truncated(correlation))
    }

    /// Returns a point of typical width, and the correlations of its speckle error between
    /// profiles.
    fn typical_over_profiles<'a>(
        &self,
        points: &'a [CloudPoint],
    ) -> Option<(&'a CloudPoint, Vec<f64>)> {
        let mut valid: Vec<&CloudPoint> = points
            .iter()
            .filter(|p| p.is_valid() && p.u_position > 0.0)
            .collect();
        if valid.is_empty() {
            return None;
        }
        let middle = valid.len() / 2;
        let (_, typical, _) = valid
            .select_nth_unstable_by(middle, |a, b| a.line_sigma_px.total_cmp(&b.line_sigma_px));
        let place = DVec2::new(f64::from(typical.column) + 0.5, typical.row);
        let drift = self.errors.drift(place, typical.line_sigma_px);
        let (steps, _) = self.scan_steps();
        let of_frames = |apart: u32| match apart.checked_sub(1) {
            None => 1.0,
            Some(i) => (steps.get(i as usize)).map_or(0.0, |step| drift.correlation(step)),
        };
        let count = self.scene.measure.filters.average_frames;
        let of_groups = |apart: u32| -> f64 {
            let pairs = (0..count).flat_map(|a| (0..count).map(move |b| (a, apart * count + b)));
            pairs.map(|(a, b)| of_frames(a.abs_diff(b))).sum()
        };
        let all = of_groups(0);
        let last = steps.len() as u32 / count + 1;
        let mut correlation = vec![1.0];
        if all > 0.0 {
            correlation.extend((1..=last).map(|apart| of_groups(apart) / all));
        }
        Some((typical, correlation))
    }

    /// Filters the points of the frames that form one profile.
    fn group(&self, filter: &ProfileFilter, points: &[CloudPoint], count: u32) -> Vec<CloudPoint> {
        let (valid, doubtful): (Vec<&CloudPoint>, Vec<&CloudPoint>) =
            points.iter().partition(|p| p.is_valid());
        let mut frames: Vec<Vec<MeasuredRow>> = vec![Vec::new(); count as usize];
        let first = points[0].frame - points[0].frame % count;
        // The last group of a scan may have fewer frames.
        let last = self.scene.scan.frames.min(first + count);
        frames.truncate((last - first) as usize);
        let mut by_column: Vec<MeasuredPoint> = Vec::new();
        for measured in valid.iter().filter_map(|point| self.measured(point)) {
            frames[(measured.point.frame - first) as usize].push(measured.row);
            by_column.push(measured);
        }
        by_column.sort_by_key(|m| (m.point.column, m.point.frame));
        let middle = f64::from(first) + (f64::from(last - first) - 1.0) / 2.0;
        let mut all: Vec<CloudPoint> = filter
            .apply(&frames)
            .iter()
            .filter_map(|row| self.delivered_point(row, middle, &by_column))
            .collect();
        let mut doubtful: Vec<CloudPoint> = doubtful.into_iter().copied().collect();
        doubtful.sort_by_key(|p| (p.column, p.frame));
        doubtful.dedup_by_key(|p| p.column);
        let columns: Vec<u32> = all.iter().map(|p| p.column).collect();
        let missing = doubtful
            .into_iter()
            .filter(|p| columns.binary_search(&p.column).is_err());
        all.extend(missing.map(|p| CloudPoint {
            frame: middle as u32,
            ..p
        }));
        all.sort_by_key(|p| p.column);
        all
    }

    fn measured<'a>(&self, point: &'a CloudPoint) -> Option<MeasuredPoint<'a>> {
        let place = DVec2::new(f64::from(point.column) + 0.5, point.row);
        let jacobian = self.calibration.point_jacobian(place)?;
        let of_calibration = match self.calibration.is_exact() {
            true => 0.0,
            false => trace(&self.calibration.point_covariance(&jacobian)),
        };
        let part_from_head = self.scene.part_from_head(point.frame);
        let frame = f64::from(point.frame);
        let systematic = self.systematic_covariance(place, &jacobian, frame, &part_from_head);
        let common = of_calibration + systematic.map_or(0.0, |covariance| trace(&covariance));
        let per_row = jacobian.by_pixel[1].length();
        let noise = point.repeatability / per_row;
        let of_row = (point.u_position.powi(2) - common).max(0.0) / per_row.powi(2);
        let constant = (of_row - noise * noise).max(0.0);
        let pattern = self.pattern_variance(place, point).min(constant);
        let row = MeasuredRow {
            column: point.column,
            row: point.row,
            speckle: (constant - pattern).sqrt(),
            noise,
            pattern: pattern.sqrt(),
            width: point.line_sigma_px,
            drift: self.errors.drift(place, point.line_sigma_px),
            averaged: 1.0,
        };
        Some(MeasuredPoint {
            point,
            row,
            jacobian,
            common,
        })
    }

    /// Returns the variance of a point's row due to the pixel pattern, px².
    fn pattern_variance(&self, place: DVec2, point: &CloudPoint) -> f64 {
        let sensor = &self.scene.camera.sensor;
        let dark_pattern_dn = sensor.fixed_dark_noise_e() * sensor.gain_dn_per_e;
        let of_dark = dark_pattern_dn / point.intensity;
        self.errors
            .pattern_variance(place, point.line_sigma_px, of_dark)
    }

    /// Returns the delivered point for the head at a path position. Contributions to the deviation
    /// uncertainty other than the row (calibration, systematic errors, chords, walls, edges) are
    /// unchanged.
    fn delivered_point(
        &self,
        delivered: &DeliveredRow,
        at: f64,
        measured: &[MeasuredPoint],
    ) -> Option<CloudPoint> {
        let column = delivered.place.x as u32;
        let after = measured.partition_point(|m| m.point.column < column);
        let nearest = [after.checked_sub(1), Some(after)].into_iter().flatten();
        let nearest = nearest.filter_map(|i| measured.get(i));
        let nearest = nearest.min_by_key(|m| m.point.column.abs_diff(column))?;
        let jacobian = self.calibration.point_jacobian(delivered.place)?;
        let part_from_head = self.scene.part_from_head_at(at);
        let in_head = match &self.systematic {
            None => jacobian.point,
            Some(errors) => jacobian.point + errors.field_shift(&jacobian),
        };
        let position = part_from_head.point(self.rounded_point(in_head));
        let eye = part_from_head.point(self.calibration.head_from_camera.translation);
        let (deviation, normal) = signed_distance(self.accel.nominal(), position, eye, &mut None);
        let (by_column, by_row) = (jacobian.by_pixel[0], jacobian.by_pixel[1]);
        let sigma_row = (delivered.speckle.hypot(delivered.noise)).hypot(delivered.pattern);
        let before = &nearest.row;
        let across = |normal: glam::DVec3, by_row: glam::DVec3, sigma: f64| {
            part_from_head.inverse().vector(normal).dot(by_row) * sigma
        };
        let was = across(
            nearest.point.normal.as_dvec3(),
            nearest.jacobian.by_pixel[1],
            before.speckle.hypot(before.noise).hypot(before.pattern),
        );
        let rest = (nearest.point.u_deviation.powi(2) - was * was).max(0.0);
        let mut flags = nearest.point.flags;
        flags.set(Flags::INTERPOLATED, delivered.filled);
        if delivered.moved {
            flags.insert(Flags::DISCONTINUITY);
        }
        Some(CloudPoint {
            position,
            deviation,
            u_position: (by_row.length() * sigma_row).hypot(nearest.common.sqrt()),
            repeatability: by_row.length() * delivered.noise,
            correlation_length: by_column.length() * delivered.correlation_length_columns,
            scan_correlation_length: nearest.point.scan_correlation_length * delivered.averaged,
            u_deviation: across(normal, by_row, sigma_row).hypot(rest.sqrt()),
            frame: at as u32,
            column,
            row: delivered.place.y,
            flags,
            normal: normal.as_vec3(),
            ..*nearest.point
        })
    }
}

/// Returns the correlations up to the last one above 0.001.
fn truncated(mut correlation: Vec<f64>) -> Vec<f64> {
    const MIN_CORRELATION: f64 = 1e-3;
    let kept = correlation
        .iter()
        .rposition(|rho| rho.abs() >= MIN_CORRELATION);
    correlation.truncate(kept.map_or(0, |last| last + 1));
    correlation
}

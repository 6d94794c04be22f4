//! Measurement of points on the part from a frame's image, or from geometry only.

use super::error_model::camera_from_laser;
use super::scan_speckle::frame_steps;
use super::simulation::{Pose, Simulation};
use super::surface_view::surface_view;
use crate::camera::{Camera, Counts, ImageColumns, SparseImage};
use crate::error::Result;
use crate::frame::{Blur, IdealProfilePoint, Irradiance};
use crate::inspect::cloud::CloudPoint;
use crate::inspect::continuity::{apply_cross_frame_flags, frames_beside};
use crate::inspect::coverage::SensorPose;
use crate::inspect::deviation::signed_distance;
use crate::inspect::line_of_sight::compare_lines_of_sight;
use crate::math::{DMat3, DVec2, DVec3, Rigid};
use crate::profile::{
    Flags, FrameStep, Peak, PeakFinder, PeakSettings, PointJacobian, RowUncertainty,
    compare_neighbours, detection_sigmas, find_peaks, least_height, sum_of_both_sides,
    update_flags_from_uncertainty,
};
use crate::scene::Scene;
use crate::speckle::theory::AIRY_SIGMA;
use rayon::prelude::*;
use std::ops::Range;

/// Smallest fraction of a point's uncertainty that is normal to the surface. Below it, errors are
/// parallel to the surface, as on a steep wall. The part of the light that the wall catches then
/// moves the point as much, and next to a wall the point may lie on another face.
///
/// The exception is a line that visibly runs along the wall. For a wall nearly parallel to the
/// laser plane (sine of the angle below this limit), the slope of the line is not conclusive.
const MIN_NORMAL_FRACTION: f64 = 0.15;

/// Ratio of the root mean square distance of an arc from its chord to the largest distance:
/// √(8/15), for a parabola.
const CHORD_RMS_RATIO: f64 = 0.730_296_743_340_221_5;

impl Simulation {
    /// Returns the settings of peak detection in this scene's images.
    #[doc(hidden)]
    pub fn peak_settings(&self) -> PeakSettings {
        let Scene {
            measure, camera, ..
        } = &self.scene;
        PeakSettings {
            finder: measure.finder,
            choice: measure.choice,
            threshold: measure.threshold_dn,
            max_count: camera.sensor.saturation_count(),
            expected_sigma: self.plan.line_half_width_px / 2.0,
            lens_sigma: match self.plan.blur {
                Blur::None => 0.0,
                _ if self.plan.geometry_only => 0.0,
                _ => AIRY_SIGMA * self.plan.grain.speckle_extent_px[1],
            },
        }
    }

    /// Returns the lines of an image and the errors of their rows.
    #[doc(hidden)]
    pub fn peaks(&self, image: &dyn ImageColumns) -> (Vec<Peak>, Vec<RowUncertainty>) {
        self.peaks_by(self.scene.measure.finder, image)
    }

    /// Returns the result of [`Self::peaks`] with another estimator.
    pub(crate) fn peaks_by(
        &self,
        finder: PeakFinder,
        image: &dyn ImageColumns,
    ) -> (Vec<Peak>, Vec<RowUncertainty>) {
        self.peaks_at(finder, image, None)
    }

    /// Returns the result of [`Self::peaks_by`]. With a pose, the rows contain the topography of
    /// the surface.
    fn peaks_at(
        &self,
        finder: PeakFinder,
        image: &dyn ImageColumns,
        pose: Option<&Pose>,
    ) -> (Vec<Peak>, Vec<RowUncertainty>) {
        let settings = PeakSettings {
            finder,
            ..self.peak_settings()
        };
        let mut peaks = find_peaks(image, &settings);
        let errors = self.errors.row_errors(&peaks, image.columns());
        update_flags_from_uncertainty(&mut peaks, &errors);
        if finder == PeakFinder::Centroid {
            let laser = camera_from_laser(&self.scene).translation;
            for (peak, error) in peaks.iter_mut().zip(&errors) {
                peak.row -= self.perspective_shift(peak, error, laser).unwrap_or(0.0);
            }
        }
        if let Some(pose) = pose {
            self.displace_by_topography(pose, &mut peaks);
        }
        let measured = peaks.into_iter().zip(errors);
        measured
            .map(|(peak, error)| self.rounded_row(peak, error))
            .filter(|(peak, _)| self.is_in_field(peak.place()))
            .unzip()
    }

    /// Returns a peak with its row rounded to the resolution of the detector. The uncertainty of
    /// the row includes the rounding.
    fn rounded_row(&self, peak: Peak, mut error: RowUncertainty) -> (Peak, RowUncertainty) {
        if let Some(steps) = self.scene.measure.row_steps_per_px {
            let rounding = 1.0 / (12f64.sqrt() * f64::from(steps));
            error.noise = error.noise.hypot(rounding);
            error.sigma = error.sigma.hypot(rounding);
        }
        (self.rounded(peak), error)
    }

    /// Returns a peak with its row rounded to the resolution of the detector.
    pub(super) fn rounded(&self, mut peak: Peak) -> Peak {
        if let Some(steps) = self.scene.measure.row_steps_per_px {
            let steps = f64::from(steps);
            peak.row = (peak.row * steps).round() / steps;
        }
        peak
    }

    /// Returns a point (head frame) with x and z of the laser frame rounded to the steps of the
    /// output.
    pub(super) fn rounded_point(&self, in_head: DVec3) -> DVec3 {
        let Some([x, z]) = self.scene.measure.point_steps else {
            return in_head;
        };
        let head_from_laser = &self.scene.head_from_laser;
        let p = head_from_laser.inverse().point(in_head);
        let steps = DVec3::new((p.x / x).round() * x, p.y, (p.z / z).round() * z);
        head_from_laser.point(steps)
    }

    /// Returns the covariance of a point by the rounding of x and z, head frame, mm²; `None`
    /// without rounding.
    fn rounding_covariance(&self) -> Option<DMat3> {
        let [x, z] = self.scene.measure.point_steps?;
        let rotation = self.scene.head_from_laser.rotation;
        Some((outer(rotation.x_axis * x) + outer(rotation.z_axis * z)) * (1.0 / 12.0))
    }

    /// Returns the shift of a centroid that the inclination of the surface causes, px; `None` for
    /// lines of unknown width.
    ///
    /// A column sees a plane under a projective map. A viewing ray that intersects the laser plane
    /// at x, measured towards the laser, intersects the surface at the distance d = D·x/(x + M)
    /// from the laser plane. D is the distance of the camera from the laser plane. M < 0 depends on
    /// the inclination of the surface and follows from σ = |M·s/(D·g)|, where s = w/2 and σ is the
    /// standard deviation of the line in rows. To first order in σ, the centroid shifts by
    ///
    /// ```text
    /// σ²·(3g/M − 3h/g + c + (g·D/M)·(a + 3b))
    /// ```
    ///
    /// - x = g·v + h·v² at v rows from the line.
    /// - c is the relative change of the pupil's solid angle per row.
    /// - a and b are the relative changes of the irradiance and of w per distance d.
    ///
    /// On a surface along which the range r changes by r′, a = -2b - r′/r for a fan and a = -3b for
    /// a round beam. The irradiance decreases with the radii and with the cosine of the divergent
    /// rays. The inclination along the fan and the gradient of a glossy lobe are neglected.
    ///
    /// `laser` is the origin of the laser, camera frame.
    fn perspective_shift(&self, peak: &Peak, error: &RowUncertainty, laser: DVec3) -> Option<f64> {
        let sigma = error.sheet_sigma;
        if sigma <= 0.0 {
            return None;
        }
        let pixels = [-1.0, 0.0, 1.0].map(|rows| peak.place() + DVec2::new(0.0, rows));
        let [before, point, after] = pixels.map(|pixel| self.calibration.point_at(pixel));
        let (before, point, after) = (before?, point?, after?);
        let [before_pupil, after_pupil] =
            [pixels[0], pixels[2]].map(|pixel| self.scene.camera.pupil_solid_angle(pixel));
        let by_row = (after - before) / 2.0;
        let bend = (after - 2.0 * point + before) / 2.0;
        let from_laser = point - laser;
        let range = from_laser.length();
        let beam = self.scene.laser.beam.shape(range);
        let laser_from_head = self.scene.head_from_laser.inverse();
        let in_laser = laser_from_head.point(self.calibration.head_from_camera.point(point));
        let sheet = beam.radius * self.scene.laser.width_ratio(in_laser) / 2.0;
        let camera_distance = (self.calibration.plane_normal)
            .dot(self.calibration.plane_point)
            .abs();
        // In the camera's frame, the surface runs along q per unit of d.
        let to_laser = -by_row.dot(from_laser).signum();
        let q = -(by_row * (to_laser * sigma / sheet) + point / camera_distance);
        let range_by_d = q.dot(from_laser) / range;
        let radius_by_d = range_by_d * beam.slope;
        let of_light = match self.scene.laser.fan {
            Some(_) => radius_by_d - range_by_d / range,
            None => 0.0,
        };
        let of_surface = to_laser * sheet * (3.0 / camera_distance + of_light);
        let of_camera = 3.0 * bend.dot(by_row) / by_row.length_squared()
            - (after_pupil / before_pupil).ln() / 2.0;
        Some(-sigma * (of_surface + sigma * of_camera))
    }

    /// Returns whether the point of a pixel is in the measuring field. Without a field of view all
    /// points are.
    pub(crate) fn is_in_field(&self, pixel: DVec2) -> bool {
        let Some(field) = &self.scene.field_of_view else {
            return true;
        };
        let laser_from_camera =
            self.scene.head_from_laser.inverse() * self.calibration.head_from_camera;
        let point = self.calibration.point_at(pixel);
        point.is_some_and(|point| field.contains(laser_from_camera.point(point)))
    }

    /// Returns the profile in an image and its points on the part.
    pub fn measure(&self, frame: u32, counts: &Counts) -> (Vec<Peak>, Vec<CloudPoint>) {
        self.measure_at(&self.pose(frame), counts, || {
            self.direct_and_indirect(frame)
        })
    }

    /// Measures an image that was simulated only near its light.
    #[doc(hidden)]
    pub fn measure_near_light(
        &self,
        frame: u32,
        image: &SparseImage,
    ) -> (Vec<Peak>, Vec<CloudPoint>) {
        self.measure_at(&self.pose(frame), image, || self.direct_and_indirect(frame))
    }

    /// Measures an image. `shares` returns the mean direct and the mean indirect light of the frame. It
    /// is called if the plan simulates indirect light.
    pub(crate) fn measure_at(
        &self,
        pose: &Pose,
        image: &dyn ImageColumns,
        shares: impl FnOnce() -> [Irradiance; 2],
    ) -> (Vec<Peak>, Vec<CloudPoint>) {
        let (peaks, errors) = self.peaks_at(self.scene.measure.finder, image, Some(pose));
        let mut points = self.points(pose, &peaks, &errors);
        if self.plan.reflections.is_some() && !points.is_empty() {
            set_direct_fraction(&mut points, &shares());
        }
        (peaks, points)
    }

    /// Simulates and measures a frame. The image is `None` if the plan is geometric.
    ///
    /// ```
    /// use lasertrace::{Scene, Simulation};
    ///
    /// let text = include_str!("../../scenes/plane/scene.toml");
    /// let simulation = Simulation::new(&Scene::parse(text, "".as_ref())?)?;
    /// let (image, peaks, points) = simulation.take(4);
    /// assert_eq!(image, Some(simulation.image(4)));
    /// assert_eq!((peaks.len(), points.len()), (640, 640));
    /// // Without noise and speckle, the only error is the rounding of the counts.
    /// assert!(points.iter().all(|point| point.deviation.abs() < 1e-3));
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn take(&self, frame: u32) -> (Option<Counts>, Vec<Peak>, Vec<CloudPoint>) {
        let (image, peaks, points) = self.taken(frame);
        (image.map(SparseImage::into_counts), peaks, points)
    }

    /// Simulates a frame like [`Self::take`] and returns it without the image.
    #[doc(hidden)]
    pub fn profile(&self, frame: u32) -> (Vec<Peak>, Vec<CloudPoint>) {
        let (_, peaks, points) = self.taken(frame);
        (peaks, points)
    }

    /// Simulates a frame like [`Self::take`], with the image only near its light.
    pub(crate) fn taken(&self, frame: u32) -> (Option<SparseImage>, Vec<Peak>, Vec<CloudPoint>) {
        let pose = self.pose(frame);
        if self.plan.geometry_only {
            let (peaks, points) = self.geometric_at(&pose);
            return (None, peaks, points);
        }
        let indirect = self.indirect(frame);
        let image = self.image_with(&pose, &indirect);
        let shares = || self.direct_and_indirect_with(&pose, &indirect);
        let (peaks, points) = self.measure_at(&pose, &image, shares);
        (Some(image), peaks, points)
    }

    /// Returns the profile of an ideal image and its points. It follows from laser rays and their
    /// visibility. The stated uncertainty still applies to peaks of real images. The result is
    /// empty unless the plan is geometric.
    #[doc(hidden)]
    pub fn geometric(&self, frame: u32) -> (Vec<Peak>, Vec<CloudPoint>) {
        self.geometric_at(&self.pose(frame))
    }

    fn geometric_at(&self, pose: &Pose) -> (Vec<Peak>, Vec<CloudPoint>) {
        let (peaks, errors) = self.geometric_peaks_at(pose, true);
        let points = self.points(pose, &peaks, &errors);
        (peaks, points)
    }

    /// Returns the peaks of a geometric profile and the errors of their rows.
    pub(crate) fn geometric_peaks(&self, pose: &Pose) -> (Vec<Peak>, Vec<RowUncertainty>) {
        self.geometric_peaks_at(pose, false)
    }

    /// Returns the result of [`Self::geometric_peaks`], with or without the topography of the
    /// surface.
    fn geometric_peaks_at(
        &self,
        pose: &Pose,
        topography: bool,
    ) -> (Vec<Peak>, Vec<RowUncertainty>) {
        let Some(sheet) = &self.sheet else {
            return (Vec::new(), Vec::new());
        };
        let line = sheet.profile(&self.view_of(pose));
        let mut peaks: Vec<Peak> = line.iter().map(|point| self.ideal_peak(point)).collect();
        let settings = self.peak_settings();
        let resolution = self.scene.camera.sensor.resolution.as_usizevec2();
        let columns = resolution.x;
        // A line that noise and rounding hide in an image has no row and no uncertainty.
        let sigmas = detection_sigmas(resolution.element_product());
        peaks.retain(|peak| {
            let least = || least_height(sigmas, peak.noise);
            peak.height > 0.0 && peak.height >= settings.threshold.unwrap_or_else(least)
        });
        peaks.retain(|peak| self.is_in_field(peak.place()));
        compare_neighbours(&mut peaks, columns, &settings);
        let errors = self.errors.row_errors(&peaks, columns);
        update_flags_from_uncertainty(&mut peaks, &errors);
        if topography {
            self.displace_by_topography(pose, &mut peaks);
        }
        let measured = peaks.into_iter().zip(errors);
        measured
            .map(|(peak, error)| self.rounded_row(peak, error))
            .unzip()
    }

    /// Returns the ideal peak of a line point. Its counts are the expected counts of the sensor for
    /// the line width of plan and lens.
    fn ideal_peak(&self, point: &IdealProfilePoint) -> Peak {
        let Camera { sensor, .. } = &self.scene.camera;
        let pixel = DVec2::new(point.column as f64 + 0.5, point.row);
        let irradiance = point.radiance * self.scene.camera.pupil_solid_angle(pixel);
        let wavelength = self.scene.laser.beam.wavelength;
        let electrons = irradiance * sensor.electrons_per_irradiance(wavelength);
        let of_laser = self.plan.line_half_width_px / 2.0;
        let sigma = self.errors.measured(pixel, of_laser);
        let full = f64::from(sensor.saturation_count()) - sensor.black_level_dn;
        let height = (electrons * of_laser / sigma * sensor.gain_dn_per_e).min(full);
        let dark = sensor.dark_noise_e() * sensor.gain_dn_per_e;
        Peak {
            column: point.column,
            row: point.row,
            intensity: height * sigma * std::f64::consts::TAU.sqrt(),
            height,
            sigma,
            noise: dark.hypot(1.0 / 12f64.sqrt()),
            flags: Flags::empty(),
        }
    }

    /// Returns the points of a frame's peaks, with the errors of their rows.
    fn points(&self, pose: &Pose, peaks: &[Peak], errors: &[RowUncertainty]) -> Vec<CloudPoint> {
        let &Pose {
            frame,
            part_from_head,
        } = pose;
        let eye = part_from_head.point(self.calibration.head_from_camera.translation);
        let sheet = self.scene.head_from_laser.rotation.y_axis;
        let measured = peaks.iter().zip(errors);
        let rounding = self.rounding_covariance();
        let rounding_variance = rounding.as_ref().map_or(0.0, trace);
        // The triangle nearest to the point of the previous column.
        let mut close = None;
        let points = measured.filter_map(|(peak, error)| {
            let pixel = peak.place();
            let jacobian = self.calibration.point_jacobian(pixel)?;
            let (in_head, covariance) = self.point(&jacobian, error.sigma);
            let covariance = rounding.map_or(covariance, |rounding| covariance + rounding);
            let in_head = match &self.systematic {
                None => in_head,
                Some(errors) => in_head + errors.field_shift(&jacobian),
            };
            let in_head = self.rounded_point(in_head);
            let systematic =
                self.systematic_covariance(pixel, &jacobian, f64::from(frame), &part_from_head);
            let position = part_from_head.point(in_head);
            if self.is_on_object(position) {
                return None;
            }
            let (deviation, seen) =
                signed_distance(self.accel.nominal(), position, eye, &mut close);
            let normal = part_from_head.inverse().vector(seen);
            let across = |c: &DMat3| normal.dot(*c * normal).max(0.0).sqrt();
            let in_all = |c: &DMat3| trace(c).max(0.0).sqrt();
            let by_systematic = |of: &dyn Fn(&DMat3) -> f64| systematic.as_ref().map_or(0.0, of);
            let wall = is_wall(across(&covariance).powi(2), trace(&covariance));
            let within_sheet = normal.cross(sheet).length() < MIN_NORMAL_FRACTION;
            let mut to_cad = covariance;
            if wall && (within_sheet || !self.matches_wall_slope(peak, error.slope, normal)) {
                to_cad += self.partial_light_covariance(pixel, in_head);
            }
            // Next to an edge, either of two surfaces may be the nearest.
            let u_deviation = match error.near_edge {
                true => in_all(&to_cad),
                false => across(&to_cad),
            };
            let u_deviation =
                u_deviation
                    .hypot(self.chord_variance().sqrt())
                    .hypot(match error.near_edge {
                        true => by_systematic(&in_all),
                        false => by_systematic(&|c| seen.dot(*c * seen).max(0.0).sqrt()),
                    });
            Some(CloudPoint {
                position,
                deviation,
                // The uncertainty of the position does not use the CAD surface.
                u_position: in_all(&covariance).hypot(by_systematic(&in_all)),
                repeatability: (jacobian.by_pixel[1].length() * error.noise)
                    .hypot(rounding_variance.sqrt()),
                correlation_length: jacobian.by_pixel[0].length()
                    * self.correlation_length_columns(error),
                scan_correlation_length: self.along_scan(error),
                u_deviation,
                intensity: peak.intensity,
                frame,
                column: peak.column,
                row: peak.row,
                line_sigma_px: peak.sigma,
                flags: peak.flags,
                normal: seen.as_vec3(),
                direct_fraction: 1.0,
            })
        });
        points.collect()
    }

    /// Returns whether the surface nearest to a position of the part frame belongs to an object
    /// that is not inspected.
    fn is_on_object(&self, position: DVec3) -> bool {
        let part = self.scene.part_triangles;
        part.is_some_and(|count| self.accel.nearest(position, None).face.triangle >= count)
    }

    /// Returns the covariance of a pixel's point by systematic errors, part frame, mm²; `None` if
    /// the scene has none.
    pub(super) fn systematic_covariance(
        &self,
        pixel: DVec2,
        jacobian: &PointJacobian,
        place: f64,
        part_from_head: &Rigid,
    ) -> Option<DMat3> {
        let errors = self.systematic.as_deref()?;
        Some(errors.covariance(pixel, jacobian, place, part_from_head))
    }

    /// Returns a pixel's point and its covariance, head's frame, mm and mm².
    fn point(&self, jacobian: &PointJacobian, row_sigma: f64) -> (DVec3, DMat3) {
        let from_row = outer(jacobian.by_pixel[1] * row_sigma);
        let covariance = match self.calibration.is_exact() {
            true => from_row,
            false => from_row + self.calibration.point_covariance(jacobian),
        };
        (jacobian.point, covariance)
    }

    /// Returns the correlation of speckle errors between columns at a lag of 0, 1, …, for the
    /// narrowest line.
    pub(crate) fn column_correlation(&self) -> &[f64] {
        let of_line = || {
            self.errors
                .column_correlation(self.plan.line_half_width_px / 2.0)
        };
        self.column_correlation.get_or_init(of_line)
    }

    /// Returns the steps to frames at increasing distance from the first, while speckle is
    /// correlated, and the distance of two frames, mm.
    pub(crate) fn scan_steps(&self) -> &(Vec<FrameStep>, f64) {
        // Beyond six standard deviations of the line, two frames have no light in common.
        const MOST_ACROSS: f64 = 12.0;
        const MIN_KEPT: f64 = 1e-3;
        let steps = || {
            let frames = self.scene.scan.frames.min(1000);
            let all = frame_steps(&self.scene, (0..frames).map(f64::from));
            let alike =
                |step: &FrameStep| step.across.abs() <= MOST_ACROSS && step.kept >= MIN_KEPT;
            let steps = all.into_iter().skip(1).take_while(alike).collect();
            let view = surface_view(&self.scene, None);
            let at = |frame: f64| self.scene.part_from_head_at(frame).point(view.point);
            let distance = if frames > 1 {
                at(0.0).distance(at(1.0))
            } else {
                0.0
            };
            (steps, distance)
        };
        self.scan_steps.get_or_init(steps)
    }

    /// Returns the frame distance times Σ_k ρ_k, where ρ_k is the error correlation at a lag of k
    /// frames, mm.
    fn along_scan(&self, error: &RowUncertainty) -> f64 {
        let (steps, distance) = self.scan_steps();
        let alike: f64 = steps.iter().map(|step| error.drift.correlation(step)).sum();
        let noise = (error.noise / error.sigma).powi(2).min(1.0);
        distance * (noise + (1.0 - noise) * (1.0 + 2.0 * alike).max(0.0))
    }

    /// Returns Σ_k ρ_k, where ρ_k is the error correlation at a lag of k columns. Noise is
    /// uncorrelated.
    fn correlation_length_columns(&self, error: &RowUncertainty) -> f64 {
        let noise = (error.noise / error.sigma).powi(2).min(1.0);
        noise + (1.0 - noise) * sum_of_both_sides(self.column_correlation())
    }

    /// Returns the diameter of the lens blur at a peak's point, px.
    pub(crate) fn defocus_blur_px(&self, peak: &Peak) -> Option<f64> {
        let camera = &self.scene.camera;
        let blur = camera.defocus_blur(self.calibration.point(peak)?)?;
        Some(blur / camera.sensor.pixel_pitch)
    }

    /// Returns whether the slope of the line, in rows per column, is that on a plane of this normal
    /// (head's frame). The tolerance is half of the column term.
    fn matches_wall_slope(&self, peak: &Peak, slope: f64, normal: DVec3) -> bool {
        let pixel = DVec2::new(peak.column as f64 + 0.5, peak.row);
        let jacobian = self.calibration.point_jacobian(pixel);
        jacobian.is_some_and(|j| {
            let [by_column, by_row] = j.by_pixel.map(|by| normal.dot(by));
            (by_row * slope + by_column).abs() <= by_column.abs() / 2.0
        })
    }

    /// Returns the variance of deviations by the chordal deviation that the scene states, mm².
    pub(super) fn chord_variance(&self) -> f64 {
        (CHORD_RMS_RATIO * self.scene.chord).powi(2)
    }

    /// Returns the covariance of a pixel's point on a wall that catches only part of the light,
    /// head's frame, mm². The point then deviates from the laser plane by w/2, the standard
    /// deviation of the light, along the camera ray. It also deviates from the centre of the
    /// column's light by 1/√12 of a column, for light at one position.
    pub(super) fn partial_light_covariance(&self, pixel: DVec2, in_head: DVec3) -> DMat3 {
        let scene = &self.scene;
        let from_laser = scene.head_from_laser.inverse().point(in_head);
        let half = scene.laser.radius(from_laser) / 2.0;
        let normal = scene.head_from_laser.rotation.y_axis;
        let ray = in_head - self.calibration.head_from_camera.translation;
        let off_sheet = ray * (half / ray.dot(normal));
        let by_column = self
            .calibration
            .point_jacobian(pixel)
            .map(|j| j.by_pixel[0]);
        let off_column = by_column.unwrap_or_default() / 12f64.sqrt();
        outer(off_sheet) + outer(off_column)
    }

    /// Sets and clears [`Flags::DISCONTINUITY`] by the surface in other frames
    /// ([`apply_cross_frame_flags`]). Sets [`Flags::SUSPECTED_REFLECTION`] by the surface that all
    /// frames of the scan show behind a point ([`compare_lines_of_sight`]). `frames` are all
    /// measured frames in order, and `points` their points.
    pub fn apply_cross_frame_flags(
        &self,
        frames: impl Iterator<Item = u32>,
        points: &mut [CloudPoint],
    ) {
        let scanned: Vec<_> = frames.map(|frame| (frame, self.head_pose(frame))).collect();
        apply_cross_frame_flags(points, &scanned, &self.scene.laser);
        // Geometric profiles contain no indirect light.
        if scanned.len() as u32 == self.scene.scan.frames && !self.plan.geometry_only {
            compare_lines_of_sight(points, &scanned, &self.scene.laser);
        }
    }

    /// Compares the frames of a piece of the scan. The `points` of all its frames get the flags of
    /// the complete scan. `measured` returns the points of a frame next to the piece that shows the
    /// surface. All languages use the flags that this function sets.
    #[doc(hidden)]
    pub fn compare_piece(
        &self,
        piece: &Range<u32>,
        points: &mut Vec<CloudPoint>,
        measured: impl Fn(u32) -> Result<Vec<CloudPoint>> + Sync,
    ) -> Result<()> {
        let (scene, pose) = (&self.scene, |frame| self.head_pose(frame));
        let beside = frames_beside(piece, scene.scan.frames, points, pose, &scene.laser);
        if beside.is_empty() {
            self.apply_cross_frame_flags(piece.clone(), points);
            return Ok(());
        }
        let (before, after): (Vec<u32>, Vec<u32>) = beside.iter().partition(|&&f| f < piece.start);
        let of = |frames: &[u32]| -> Result<Vec<CloudPoint>> {
            let frames = frames.par_iter().map(|&frame| measured(frame));
            Ok(frames.collect::<Result<Vec<_>>>()?.concat())
        };
        let (first, own) = (of(&before)?, points.len());
        let mut all = [first, std::mem::take(points), of(&after)?].concat();
        let frames = before.iter().copied().chain(piece.clone());
        self.apply_cross_frame_flags(frames.chain(after.iter().copied()), &mut all);
        let others = all.partition_point(|point| point.frame < piece.start);
        *points = all.drain(others..others + own).collect();
        Ok(())
    }

    /// Returns the poses of laser and camera in a frame.
    pub(crate) fn head_pose(&self, frame: u32) -> SensorPose {
        let part_from_head = self.scene.part_from_head(frame);
        SensorPose {
            part_from_laser: part_from_head * self.scene.head_from_laser,
            part_from_camera: part_from_head * self.scene.head_from_camera,
        }
    }

    /// Returns a point after a rigid motion, with its deviation computed again.
    pub(crate) fn moved(&self, point: &CloudPoint, motion: &Rigid) -> CloudPoint {
        let part_from_head = self.scene.part_from_head(point.frame);
        let eye = part_from_head.point(self.calibration.head_from_camera.translation);
        let position = motion.point(point.position);
        let (deviation, normal) = signed_distance(self.accel.nominal(), position, eye, &mut None);
        CloudPoint {
            position,
            deviation,
            normal: normal.as_vec3(),
            ..*point
        }
    }
}

/// Sets the true fraction of direct light of each point of a frame, from the [direct, indirect]
/// light. The light is summed within two line widths of the point.
fn set_direct_fraction(points: &mut [CloudPoint], shares: &[Irradiance; 2]) {
    const WIDTHS: f64 = 2.0;
    let columns = shares[0].columns();
    let [direct, more] = shares.each_ref().map(Irradiance::dense);
    for point in points {
        let reach = (WIDTHS * point.line_sigma_px).max(0.5);
        let first = (point.row - reach).max(0.0) as usize;
        let last = ((point.row + reach).max(0.0) as usize).min(shares[0].rows() - 1);
        let light = |image: &[f32]| {
            let rows = first.min(last)..=last;
            let pixels = rows.map(|row| image[row * columns + point.column as usize]);
            pixels.map(f64::from).sum::<f64>()
        };
        let (direct, more) = (light(&direct), light(&more));
        if direct + more > 0.0 {
            point.direct_fraction = (direct / (direct + more)) as f32;
        }
    }
}

fn outer(v: DVec3) -> DMat3 {
    DMat3::from_cols(v * v.x, v * v.y, v * v.z)
}

/// Returns whether errors of a point are parallel to the surface, from the variances of the
/// position along the normal and in all directions.
pub(super) fn is_wall(normal_variance: f64, variance: f64) -> bool {
    normal_variance.sqrt() < MIN_NORMAL_FRACTION * variance.sqrt()
}

pub(super) fn trace(m: &DMat3) -> f64 {
    m.x_axis.x + m.y_axis.y + m.z_axis.z
}

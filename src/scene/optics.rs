//! Validation of the laser, camera and speckle of a scene file.

use super::file::{
    AutoExposure, BinningMode, CameraTable, DistortionTable, Focus, LaserTable, ProfileName,
    ScanTable, SceneFile, SpeckleMethod,
};
use super::line_profile;
use super::resolve::SpeckleModel;
use super::resolver::Resolver;
use crate::camera::{Camera, Distortion, Lens, Noise, Sensor, TELECENTRIC_PUPIL_DISTANCE};
use crate::error::Result;
use crate::laser::{Beam, Fan, FanProfile, Laser};
use crate::math::{Aperture, DVec2, DVec3, Rigid};
use crate::speckle::lookup::{Coherence, Method};
use crate::surface::Materials;
use glam::UVec2;

/// Returns the distance along the axis from the pupil to `position_mm`, mm.
fn pupil_setback(table: &CameraTable) -> f64 {
    match table.telecentric {
        Some(_) => TELECENTRIC_PUPIL_DISTANCE,
        None => 0.0,
    }
}

impl Resolver<'_> {
    pub(super) fn laser(&self, table: &LaserTable) -> Result<Laser> {
        let beam = Beam {
            wavelength: self.positive(table.wavelength_nm, "laser.wavelength_nm")? * 1e-6,
            power_mw: table.power_mw,
            waist_radius: self.positive(table.waist_radius_um, "laser.waist_radius_um")? * 1e-3,
            waist_distance: table.waist_distance_mm,
            m_squared: table.m_squared,
        };
        self.within(table.wavelength_nm, "laser.wavelength_nm", [1.0, 1e6])?;
        self.lengths([table.waist_distance_mm], "laser.waist_distance_mm")?;
        self.check(
            table.power_mw.is_finite() && table.power_mw >= 0.0,
            "laser.power_mw",
            "a finite number >= 0",
        )?;
        self.within(table.power_mw, "laser.power_mw", [0.0, 1e12])?;
        self.check(
            table.m_squared.is_finite() && table.m_squared >= 1.0,
            "laser.m_squared",
            "a finite number >= 1",
        )?;
        let smallest = 2.0 * beam.m_squared * beam.wavelength / std::f64::consts::PI * 1e3;
        self.check(
            beam.divergence() <= 0.5,
            "laser.waist_radius_um",
            &format!(
                "at least {smallest:.4}: below, the beam spreads by more than 0.5 rad and \
                 is not paraxial"
            ),
        )?;
        let Some(line) = &table.line else {
            return Ok(Laser { beam, fan: None });
        };
        self.check(
            line.fan_deg > 0.0 && line.fan_deg < 180.0,
            "laser.line.fan_deg",
            "an angle above 0 and below 180",
        )?;
        let fan = Fan {
            angle: line.fan_deg.to_radians(),
            profile: match &line.profile {
                ProfileName::Uniform => FanProfile::Uniform,
                ProfileName::Gaussian => FanProfile::Gaussian,
                ProfileName::File(name) => {
                    let key = "laser.line.profile";
                    let base = self.source.file_of(key);
                    let file = self.file_beside(base, name, key, "a CSV file of a line profile")?;
                    FanProfile::Measured(line_profile::read(&file, line.fan_deg)?)
                }
            },
        };
        Ok(Laser {
            beam,
            fan: Some(fan),
        })
    }

    /// Returns the pose of the laser. A point laser defines no line direction, so its measuring
    /// plane contains the beam and the camera's column direction.
    pub(super) fn laser_pose(&self, table: &LaserTable, head_from_camera: &Rigid) -> Result<Rigid> {
        let origin = self.lengths(table.position_mm, "laser.position_mm")?;
        let z = self.direction(table.direction, "laser.direction")?;
        let (line, key) = match &table.line {
            Some(line) => (
                self.direction(line.direction, "laser.line.direction")?,
                "laser.line.direction",
            ),
            None => (head_from_camera.rotation.x_axis, "laser.direction"),
        };
        Rigid::from_z_and_x(origin.into(), z, line).ok_or_else(|| {
            self.source.input_error(
                key,
                "the line (a point laser: the camera's columns) not to be along the beam",
            )
        })
    }

    /// Returns the speckle model. It is validated even if speckle is disabled. Its contrast is
    /// computed for the surface with the highest contrast.
    pub(super) fn speckle(
        &self,
        file: &SceneFile,
        camera: &Camera,
        surfaces: &Materials,
    ) -> Result<Option<SpeckleModel>> {
        let degrees = surfaces
            .kinds()
            .iter()
            .map(|kind| kind.degree_of_polarisation);
        let polarisation_degree = degrees.fold(f64::NAN, f64::max);
        self.check(
            (0.0..=1.0).contains(&polarisation_degree),
            "part.polarisation_degree",
            "a number from 0 to 1",
        )?;
        let patterns = file.laser.incoherent_modes;
        self.check(
            (1..=64).contains(&patterns),
            "laser.incoherent_modes",
            "from 1 to 64",
        )?;
        let method = match file.speckle_method {
            SpeckleMethod::Field => Method::Field,
            SpeckleMethod::Trilinear => Method::Trilinear,
        };
        let by_field = method == Method::Field || !surfaces.polarisation_differs();
        self.check(
            by_field || !file.speckle,
            "speckle_method",
            "field, as surfaces differ in polarisation; or part.polarisation_degree for all",
        )?;
        Ok(file.speckle.then_some(SpeckleModel {
            method,
            coherence: Coherence {
                polarisation_degree,
                incoherent_modes: patterns as usize,
            },
            aperture: camera.lens.aperture,
        }))
    }

    /// Returns the target of an automatic exposure, as a fraction of full scale.
    pub(super) fn auto_exposure(&self, table: &CameraTable) -> Result<Option<f64>> {
        let share = table.auto_exposure_target.unwrap_or(0.5);
        self.check(
            share > 0.0 && share <= 1.0,
            "camera.auto_exposure_target",
            "a share above 0 and at most 1",
        )?;
        let one = table.exposure_ms.is_some() || table.exposure.is_some();
        let alone = table.hdr_exposures_ms.is_none() || !one;
        let expected = "hdr_exposures_ms alone, without exposure_ms and exposure";
        self.check(alone, "camera.hdr_exposures_ms", expected)?;
        match (table.exposure_ms, table.exposure) {
            (Some(_), Some(AutoExposure::Auto)) => {
                let expected = "exposure_ms or exposure = \"auto\", not both";
                Err(self.source.input_error("camera.exposure", expected))
            }
            (_, exposure) => Ok(exposure.map(|AutoExposure::Auto| share)),
        }
    }

    /// Returns the focus distance, mm, and the tilt of the sensor, rad.
    fn focus(&self, table: &CameraTable, camera_from_laser: &Rigid) -> Result<(f64, DVec2)> {
        let Some(Focus::LaserPlane) = table.focus else {
            let distance = table.focus_distance_mm;
            let distance =
                distance.ok_or_else(|| self.source.missing("camera.focus_distance_mm"))?;
            let tilt = table.tilt_deg.unwrap_or_default();
            self.check(
                tilt.iter().all(|t| t.abs() <= 80.0),
                "camera.tilt_deg",
                "angles from -80 to 80",
            )?;
            let tilt = DVec2::from(tilt).map(f64::to_radians);
            let distance = self.positive(distance, "camera.focus_distance_mm")?;
            return Ok((distance + pupil_setback(table), tilt));
        };
        let alone = table.focus_distance_mm.is_none() && table.tilt_deg.is_none();
        let expected = "focus = \"laser-plane\", or focus_distance_mm and tilt_deg, not both";
        self.check(alone, "camera.focus", expected)?;
        let plane = (
            camera_from_laser.translation,
            camera_from_laser.rotation.y_axis,
        );
        // The focus distance is not known yet. It changes the focal length of a telecentric lens by a
        // relative 1e-6 per 100 mm.
        let f = self.lens(table, pupil_setback(table))?.focal_length;
        let found = Camera::focused_on_plane(f, plane).filter(|(distance, tilt)| {
            distance.is_finite() && *distance > f && tilt.abs().max_element() <= 80f64.to_radians()
        });
        found.ok_or_else(|| {
            let expected = "a camera whose axis meets the laser plane in front of it, beyond the focal length, so \
                            that a tilt below 80° brings that plane into focus";
            self.source.input_error("camera.focus", expected)
        })
    }

    /// Returns the lens without distortion.
    fn lens(&self, table: &CameraTable, focus_distance: f64) -> Result<Lens> {
        let positive = |value: Option<f64>, name: &str| {
            let key = format!("camera.{name}");
            self.positive(value.ok_or_else(|| self.source.missing(&key))?, &key)
        };
        let (focal_length, f_number) = match &table.telecentric {
            None => {
                let f_number = positive(table.f_number, "f_number")?;
                self.within(f_number, "camera.f_number", [0.1, 1e4])?;
                (
                    positive(table.focal_length_mm, "focal_length_mm")?,
                    f_number,
                )
            }
            Some(of) => {
                let alone = table.focal_length_mm.is_none() && table.f_number.is_none();
                let expected = "telecentric, or focal_length_mm and f_number, not both";
                self.check(alone, "camera.telecentric", expected)?;
                let without = table.distortion.is_none();
                let expected = "no distortion with camera.telecentric";
                self.check(without, "camera.distortion", expected)?;
                let key = "camera.telecentric.magnification";
                self.within(of.magnification, key, [1e-3, 1e3])?;
                let key = "camera.telecentric.numerical_aperture";
                self.within(of.numerical_aperture, key, [1e-4, 0.5])?;
                let half_angle = of.numerical_aperture.asin();
                let focal_length = focus_distance * of.magnification / (1.0 + of.magnification);
                let pupil = 2.0 * focus_distance * half_angle.tan();
                (focal_length, focal_length / pupil)
            }
        };
        Ok(Lens {
            focal_length,
            f_number,
            focus_distance,
            telecentric: table.telecentric.is_some(),
            aperture: table.aperture_shape,
            distortion: None,
        })
    }

    pub(super) fn camera(
        &self,
        table: &CameraTable,
        scan: &ScanTable,
        camera_from_laser: &Rigid,
    ) -> Result<Camera> {
        let (focus_distance, tilt) = self.focus(table, camera_from_laser)?;
        let lens = self.lens(table, focus_distance)?;
        if let Aperture::Ellipse(ratio) = lens.aperture {
            // A narrower pupil contains too few phasors for fully developed speckle.
            self.check(
                (0.1..=1.0).contains(&ratio),
                "camera.aperture_shape",
                "an ellipse with height / width from 0.1 to 1",
            )?;
        }
        self.check(
            lens.focus_distance > lens.focal_length,
            "camera.focus_distance_mm",
            "a distance beyond the focal length",
        )?;
        let sensor = self.sensor(table, scan.frame_rate_hz)?;
        let mut camera = Camera { lens, sensor, tilt };
        let Some(reach) = camera.model().reach() else {
            let expected = "a tilt at which the sensor's corners stay behind the lens";
            return Err(self.source.input_error("camera.tilt_deg", expected));
        };
        if let Some(DistortionTable { k1, k2, k3, p1, p2 }) = table.distortion {
            let distortion = Distortion::new([k1, k2, k3], [p1, p2], reach)
                .map_err(|expected| self.source.input_error("camera.distortion", &expected))?;
            camera.lens.distortion = Some(distortion);
        }
        Ok(camera)
    }

    /// Returns the sensor. `frame_rate_hz` limits the start value of an automatic exposure.
    fn sensor(&self, table: &CameraTable, frame_rate_hz: Option<f64>) -> Result<Sensor> {
        let positive = |value, key: &str| self.positive(value, &format!("camera.{key}"));
        let [columns, all_rows] = table.resolution_px;
        self.check(
            (1..=65_536).contains(&columns) && (1..=65_536).contains(&all_rows),
            "camera.resolution_px",
            "from 1 to 65536 columns and rows",
        )?;
        let [first_row, rows] = table.roi_rows.unwrap_or([0, all_rows]);
        let inside = rows > 0
            && first_row
                .checked_add(rows)
                .is_some_and(|end| end <= all_rows);
        let expected = format!(
            "the first row and their number, within the sensor's {all_rows} rows: [64, 128]"
        );
        self.check(inside, "camera.roi_rows", &expected)?;
        let frame_ms = match table.max_full_frame_rate_hz {
            None => 0.0,
            Some(rate) => 1e3 / positive(rate, "max_full_frame_rate_hz")?,
        };
        let efficiency = positive(table.quantum_efficiency, "quantum_efficiency")?;
        self.check(
            efficiency <= 1.0,
            "camera.quantum_efficiency",
            "a number above 0 and at most 1",
        )?;
        self.check(
            (8..=16).contains(&table.bit_depth),
            "camera.bit_depth",
            "from 8 to 16",
        )?;
        let several = self.exposures(table)?;
        let exposure_ms = several.first().copied().or(table.exposure_ms);
        let exposure_ms = match (exposure_ms, table.exposure, frame_rate_hz) {
            (Some(exposure_ms), ..) => positive(exposure_ms, "exposure_ms")?,
            (None, Some(AutoExposure::Auto), rate) => match rate {
                Some(rate) if rate > 0.0 => (1e3 / rate).min(1.0),
                _ => 1.0,
            },
            (None, None, _) => return Err(self.source.missing("camera.exposure_ms")),
        };
        let first = f64::from(first_row) + f64::from(rows) / 2.0;
        let sensor = Sensor {
            resolution: UVec2::new(columns, rows),
            off_middle: DVec2::new(f64::from(columns) / 2.0, first)
                - self.principal_point(table)?,
            readout_ms: frame_ms * f64::from(rows) / f64::from(all_rows),
            pixel_pitch: positive(table.pixel_pitch_um, "pixel_pitch_um")? * 1e-3,
            exposure_ms,
            shorter: several.iter().skip(1).map(|ms| exposure_ms / ms).collect(),
            quantum_efficiency: efficiency,
            gain_dn_per_e: positive(table.gain_dn_per_e, "gain_dn_per_e")?,
            bit_depth: table.bit_depth,
            full_well_e: positive(table.full_well_e, "full_well_e")?,
            black_level_dn: self.not_negative(table.black_level_dn, "black_level_dn")?,
            noise: self.noise(table)?,
        };
        self.shows_light(&sensor)?;
        let sensor = self.binned(sensor, table)?;
        let full = (sensor.full_scale() - sensor.black_level_dn) * sensor.hdr_ratio()
            + sensor.black_level_dn;
        let expected = format!(
            "a shortest exposure at which full scale stays below 65536: with these it is {full:.0}"
        );
        self.check(full < 65_536.0, "camera.hdr_exposures_ms", &expected)?;
        Ok(sensor)
    }

    /// Returns the principal point, px, on the sensor with all rows.
    fn principal_point(&self, table: &CameraTable) -> Result<DVec2> {
        let size = table.resolution_px.map(f64::from);
        let center = table.principal_point_px.unwrap_or(size.map(|n| n / 2.0));
        // Distortion and defocus are expanded about the optical axis, which may be outside.
        let is_near = |i: usize| (-size[i]..=2.0 * size[i]).contains(&center[i]);
        let expected = "a column and a row at most the size of the sensor outside it";
        let key = "camera.principal_point_px";
        self.check(is_near(0) && is_near(1), key, expected)?;
        Ok(center.into())
    }

    /// Rejects a sensor whose saturated pixels have the counts of dark pixels, because no image
    /// would show light.
    fn shows_light(&self, sensor: &Sensor) -> Result<()> {
        let highest = f64::from(2u32.pow(sensor.bit_depth) - 1);
        let expected = format!("a level below the highest count, {highest}");
        let below = sensor.black_level_dn + 0.5 < highest;
        self.check(below, "camera.black_level_dn", &expected)?;
        let expected = format!(
            "a gain by which {:?} e, the full well, are at least 1 count",
            sensor.full_well_e
        );
        let dark = (sensor.black_level_dn + 0.5).floor();
        self.check(
            sensor.full_scale() > dark,
            "camera.gain_dn_per_e",
            &expected,
        )
    }

    /// Returns the HDR exposure times in descending order. The list is empty for a single or
    /// automatic exposure.
    fn exposures(&self, table: &CameraTable) -> Result<Vec<f64>> {
        let mut all = table.hdr_exposures_ms.clone().unwrap_or_default();
        for &exposure in &all {
            self.positive(exposure, "camera.hdr_exposures_ms")?;
        }
        all.sort_by(|a, b| b.total_cmp(a));
        all.dedup();
        let expected = "2 to 4 different exposures";
        let holds = table.hdr_exposures_ms.is_none() || (2..=4).contains(&all.len());
        self.check(holds, "camera.hdr_exposures_ms", expected)?;
        Ok(all)
    }

    /// Returns the coherence length, mm; `None`: longer than all light paths.
    pub(super) fn coherence_length(&self, table: &LaserTable) -> Result<Option<f64>> {
        let length = table.coherence_length_mm;
        let checked = |length| self.positive(length, "laser.coherence_length_mm");
        length.map(checked).transpose()
    }

    /// Returns the sensor with binned pixels.
    fn binned(&self, sensor: Sensor, table: &CameraTable) -> Result<Sensor> {
        let side = table.binning.unwrap_or(1);
        let key = "camera.binning";
        self.check((1..=4).contains(&side), key, "from 1 to 4")?;
        let by_counts = table.binning_mode == Some(BinningMode::Digital);
        let whole = sensor.resolution % side == UVec2::ZERO;
        let UVec2 {
            x: columns,
            y: rows,
        } = sensor.resolution;
        let expected = format!("a divisor of the {columns} columns and {rows} rows that are read");
        self.check(whole, key, &expected)?;
        let binned = if by_counts {
            sensor.binned_counts(side)
        } else {
            sensor.binned_charge(side)
        };
        let expected = format!(
            "fewer pixels or bits: their sum has {} bits, and counts at most 16",
            binned.bit_depth
        );
        self.check(binned.bit_depth <= 16, key, &expected)?;
        Ok(binned)
    }

    /// Checks that a value of the camera is finite and not negative.
    fn not_negative(&self, value: f64, key: &str) -> Result<f64> {
        let holds = value.is_finite() && value >= 0.0;
        let key = format!("camera.{key}");
        self.check(holds, &key, "a finite number >= 0")?;
        self.within(value, &key, [0.0, 1e12])
    }

    fn noise(&self, table: &CameraTable) -> Result<Option<Noise>> {
        let beside_read_noise = [
            (table.dark_current_e_per_s, "dark_current_e_per_s"),
            (table.prnu_percent, "prnu_percent"),
            (table.dsnu_e, "dsnu_e"),
        ];
        let mut further = [0.0; 3];
        for ((value, key), further) in beside_read_noise.into_iter().zip(&mut further) {
            let Some(value) = value else { continue };
            let expected =
                "read_noise_e too, 0 without read noise: without this key counts have no noise";
            self.check(
                table.read_noise_e.is_some(),
                &format!("camera.{key}"),
                expected,
            )?;
            *further = self.not_negative(value, key)?;
        }
        let [dark_current_e_per_s, prnu_percent, dsnu_e] = further;
        let share = "a number from 0 to 25";
        self.check(prnu_percent <= 25.0, "camera.prnu_percent", share)?;
        let Some(read_noise_e) = table.read_noise_e else {
            return Ok(None);
        };
        Ok(Some(Noise {
            read_noise_e: self.not_negative(read_noise_e, "read_noise_e")?,
            dark_current_e_per_s,
            prnu: prnu_percent * 1e-2,
            dsnu_e,
            ambient_e_per_s: 0.0,
        }))
    }

    pub(super) fn camera_pose(&self, table: &CameraTable) -> Result<Rigid> {
        let origin: DVec3 = self
            .lengths(table.position_mm, "camera.position_mm")?
            .into();
        let target: DVec3 = self.lengths(table.look_at_mm, "camera.look_at_mm")?.into();
        let columns = self.direction(table.column_axis, "camera.column_axis")?;
        let z = (target - origin).try_normalize().ok_or_else(|| {
            self.source
                .input_error("camera.look_at_mm", "another point than camera.position_mm")
        })?;
        let pupil = origin - z * pupil_setback(table);
        Rigid::from_z_and_x(pupil, z, columns).ok_or_else(|| {
            self.source.input_error(
                "camera.column_axis",
                "a direction that is not the optical axis",
            )
        })
    }

    /// Checks the geometry of the triangulation. Height is visible in a column only if the camera
    /// is outside the laser plane. A column contains one point of the line only if the line crosses
    /// it.
    pub(super) fn triangulation(
        &self,
        table: &CameraTable,
        head_from_laser: &Rigid,
        head_from_camera: &Rigid,
    ) -> Result<()> {
        let normal = head_from_laser.rotation.y_axis;
        let offset = normal.dot(head_from_camera.translation - head_from_laser.translation);
        self.check(
            offset.abs() > 1e-3,
            "camera.position_mm",
            "a point off the laser plane (by more than 1 µm): in it, height does not show",
        )?;
        let axis = normal.dot(head_from_camera.rotation.z_axis);
        self.check(
            table.telecentric.is_none() || axis.abs() > 1e-5,
            "camera.look_at_mm",
            "a telecentric view that crosses the laser plane: parallel to it, height does not show",
        )?;
        let columns = head_from_camera.rotation.x_axis;
        let line = head_from_laser.rotation.x_axis;
        self.check(
            columns.dot(line).abs() > 0.5f64.sqrt(),
            "camera.column_axis",
            "a direction within 45° of the laser line, so that each column sees one point of it",
        )
    }
}

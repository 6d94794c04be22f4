//! The file format `calibration.json`.

use super::calibration::{Calibration, Covariance, PARAMETERS, coefficients};
use crate::camera::{CameraModel, Distortion};
use crate::error::{Error, InputError, Place, Result};
use crate::math::{DMat3, DVec2, DVec3, Rigid, rotation_vector};
use glam::{DQuat, UVec2};
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize, Serializer};
use std::path::Path;

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CalibrationFile {
    camera: CameraFile,
    head_from_camera: PoseFile,
    laser_plane: PlaneFile,
    /// `None` if all parameters are exact.
    #[serde(skip_serializing_if = "Option::is_none")]
    uncertainty: Option<UncertaintyFile>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraFile {
    resolution_px: [u32; 2],
    pixel_pitch_um: f64,
    principal_distance_mm: f64,
    principal_point_px: [f64; 2],
    tilt_deg: [f64; 2],
    #[serde(skip_serializing_if = "Option::is_none")]
    distortion: Option<DistortionFile>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DistortionFile {
    k1: f64,
    k2: f64,
    k3: f64,
    p1: f64,
    p2: f64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseFile {
    /// Rotation axis times angle.
    rotation_vector_rad: [f64; 3],
    position_mm: [f64; 3],
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PlaneFile {
    /// Point in the camera frame.
    point_mm: [f64; 3],
    normal: [f64; 3],
}

/// Uncertainty of the [`PARAMETERS`] that are not exact.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct UncertaintyFile {
    parameters: Vec<String>,
    /// Standard uncertainties, in the units of the parameters.
    standard: Vec<f64>,
    correlation: Vec<Vec<f64>>,
}

impl Serialize for Calibration {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        CalibrationFile::from(self).serialize(serializer)
    }
}

impl From<&Calibration> for CalibrationFile {
    fn from(calibration: &Calibration) -> CalibrationFile {
        let camera = &calibration.camera;
        let pose = &calibration.head_from_camera;
        let turn = rotation_vector(&pose.rotation);
        CalibrationFile {
            camera: CameraFile {
                resolution_px: camera.resolution.to_array(),
                pixel_pitch_um: camera.pixel_pitch * 1e3,
                principal_distance_mm: camera.principal_distance,
                principal_point_px: camera.principal_point.to_array(),
                tilt_deg: camera.tilt.to_array().map(f64::to_degrees),
                distortion: camera.distortion.map(|_| {
                    let [k1, k2, k3, p1, p2] = coefficients(camera);
                    DistortionFile { k1, k2, k3, p1, p2 }
                }),
            },
            head_from_camera: PoseFile {
                rotation_vector_rad: turn.to_array(),
                position_mm: pose.translation.to_array(),
            },
            laser_plane: PlaneFile {
                point_mm: calibration.plane_point.to_array(),
                normal: calibration.plane_normal.to_array(),
            },
            uncertainty: uncertainty(calibration),
        }
    }
}

fn uncertainty(calibration: &Calibration) -> Option<UncertaintyFile> {
    let standard = calibration.standard_uncertainties();
    let free: Vec<usize> = (0..PARAMETERS.len())
        .filter(|&i| standard[i] > 0.0)
        .collect();
    let correlation = |i: usize, j: usize| match i == j {
        true => 1.0,
        false => (calibration.covariance[i][j] / (standard[i] * standard[j])).clamp(-1.0, 1.0),
    };
    (!free.is_empty()).then(|| UncertaintyFile {
        parameters: free.iter().map(|&i| PARAMETERS[i].to_owned()).collect(),
        standard: free.iter().map(|&i| standard[i]).collect(),
        correlation: free
            .iter()
            .map(|&i| free.iter().map(|&j| correlation(i, j)).collect())
            .collect(),
    })
}

/// Largest length (mm) and pixel coordinate. Products of two such values stay finite.
const LARGEST: f64 = 1e12;

/// Converts and validates the contents of a file.
struct CalibrationReader<'a> {
    file: &'a Path,
}

impl CalibrationReader<'_> {
    fn input_error(&self, key: &str, found: impl std::fmt::Debug, expected: &str) -> Error {
        let found = format!("{found:?}");
        let mut error = InputError::new(self.file, Place::File, found, expected);
        error.key = Some(key.to_owned());
        error.into()
    }

    fn positive(&self, key: &str, value: f64) -> Result<f64> {
        match value > 0.0 && value <= LARGEST {
            true => Ok(value),
            false => Err(self.input_error(key, value, "a finite number > 0")),
        }
    }

    fn finite<const N: usize>(&self, key: &str, value: [f64; N]) -> Result<[f64; N]> {
        match value.iter().all(|v| v.abs() <= LARGEST) {
            true => Ok(value),
            false => Err(self.input_error(key, value, "numbers within 1e12")),
        }
    }

    fn camera(&self, file: &CameraFile) -> Result<CameraModel> {
        let resolution = UVec2::from(file.resolution_px);
        let [columns, rows] = file.resolution_px;
        if !(1..=65_536).contains(&columns) || !(1..=65_536).contains(&rows) {
            let expected = "from 1 to 65536 columns and rows";
            return Err(self.input_error("camera.resolution_px", file.resolution_px, expected));
        }
        let tilt = DVec2::from(file.tilt_deg);
        let mut camera = CameraModel {
            resolution,
            pixel_pitch: self.positive("camera.pixel_pitch_um", file.pixel_pitch_um)? * 1e-3,
            principal_distance: self
                .positive("camera.principal_distance_mm", file.principal_distance_mm)?,
            principal_point: self
                .finite("camera.principal_point_px", file.principal_point_px)?
                .into(),
            tilt: tilt.map(f64::to_radians),
            distortion: None,
        };
        let behind = camera
            .reach()
            .filter(|_| tilt.abs().cmple(DVec2::splat(80.0)).all());
        let Some(reach) = behind else {
            let expected = "angles from -80 to 80 at which the sensor stays behind the lens";
            return Err(self.input_error("camera.tilt_deg", file.tilt_deg, expected));
        };
        if let Some(DistortionFile { k1, k2, k3, p1, p2 }) = file.distortion {
            let lens = Distortion::new([k1, k2, k3], [p1, p2], reach);
            let wrong = |expected: String| {
                self.input_error("camera.distortion", [k1, k2, k3, p1, p2], &expected)
            };
            camera.distortion = Some(lens.map_err(wrong)?);
        }
        Ok(camera)
    }

    fn plane(&self, file: &PlaneFile) -> Result<(DVec3, DVec3)> {
        let point = self.finite("laser_plane.point_mm", file.point_mm)?.into();
        let n = DVec3::from(file.normal);
        if !((n.length() - 1.0).abs() < 1e-6 && n.x.abs() < 0.99) {
            let expected = "a vector of length 1 that is not along the camera's x axis";
            return Err(self.input_error("laser_plane.normal", file.normal, expected));
        }
        if n.dot(point) == 0.0 {
            let expected = "a plane that does not hold the camera's pupil, the origin";
            return Err(self.input_error("laser_plane.point_mm", file.point_mm, expected));
        }
        // A normalised vector is returned without change, bit by bit.
        let unit = (n.length() - 1.0).abs() < 1e-14;
        Ok((point, if unit { n } else { n.normalize() }))
    }

    fn covariance(&self, file: &UncertaintyFile) -> Result<Box<Covariance>> {
        let mut indices = Vec::new();
        for name in &file.parameters {
            match PARAMETERS.iter().position(|p| p == name) {
                Some(i) if !indices.contains(&i) => indices.push(i),
                _ => {
                    let expected = format!("each once of {}", PARAMETERS.join(", "));
                    return Err(self.input_error("uncertainty.parameters", name, &expected));
                }
            }
        }
        let n = indices.len();
        let standard = &file.standard;
        if standard.len() != n || !standard.iter().all(|s| (0.0..=LARGEST).contains(s)) {
            let expected = format!("{n} numbers >= 0");
            return Err(self.input_error("uncertainty.standard", standard, &expected));
        }
        let rho = &file.correlation;
        let square = rho.len() == n && rho.iter().all(|row| row.len() == n);
        let holds = |i: usize, j: usize| match i == j {
            true => rho[i][j] == 1.0,
            false => rho[i][j] == rho[j][i] && rho[i][j].abs() <= 1.0,
        };
        // Estimates whose correlation is 1 up to rounding are accepted.
        let lifted = |i: usize, j: usize| rho[i][j] + if i == j { 1e-9 } else { 0.0 };
        let definite = || DMatrix::from_fn(n, n, lifted).cholesky().is_some();
        if !square || !(0..n * n).all(|k| holds(k / n, k % n)) || !definite() {
            let expected = format!(
                "a symmetric, positive definite matrix of {n} × {n} with ones on its diagonal"
            );
            return Err(self.input_error("uncertainty.correlation", rho, &expected));
        }
        let mut covariance = Box::new([[0.0; PARAMETERS.len()]; PARAMETERS.len()]);
        for (a, &i) in indices.iter().enumerate() {
            for (b, &j) in indices.iter().enumerate() {
                covariance[i][j] = standard[a] * standard[b] * rho[a][b];
            }
        }
        Ok(covariance)
    }
}

impl Calibration {
    /// Parses the contents of a `calibration.json`. `file` is named in errors, together with the
    /// key.
    pub fn parse(file: &Path, bytes: &[u8]) -> Result<Calibration> {
        let mut json = serde_json::Deserializer::from_slice(bytes);
        let read: CalibrationFile =
            serde_path_to_error::deserialize(&mut json).map_err(|error| {
                let key = error.path().to_string();
                let error = error.into_inner();
                let place = match error.line() {
                    0 => Place::File,
                    line => Place::Line(line),
                };
                let text = error.to_string();
                // serde_json appends the position, which `place` already contains.
                let text = text.split(" at line ").next().unwrap_or_default();
                let (found, expected) = text
                    .split_once(", expected ")
                    .unwrap_or((text, "a calibration as `lasertrace calibrate` writes it"));
                let mut wrong = InputError::new(file, place, found, expected);
                wrong.key = (key != ".").then_some(key);
                wrong
            })?;
        let reader = CalibrationReader { file };
        let pose = &read.head_from_camera;
        let turn = reader.finite(
            "head_from_camera.rotation_vector_rad",
            pose.rotation_vector_rad,
        )?;
        let (plane_point, plane_normal) = reader.plane(&read.laser_plane)?;
        let mut calibration = Calibration::perfect(
            reader.camera(&read.camera)?,
            Rigid {
                rotation: DMat3::from_quat(DQuat::from_scaled_axis(turn.into())),
                translation: reader
                    .finite("head_from_camera.position_mm", pose.position_mm)?
                    .into(),
            },
            plane_point,
            plane_normal,
        );
        if let Some(uncertainty) = &read.uncertainty {
            calibration.covariance = reader.covariance(uncertainty)?;
        }
        Ok(calibration)
    }
}

//! Camera parameters in the conventions of OpenCV.

use super::opencv_table::OpenCvTable;
use super::toml_source::TomlSource;
use crate::error::Error;
use crate::math::{DMat3, DVec3};
use serde::Deserialize;
use std::fmt::Write;
use std::path::Path;

/// Largest displacement at the corners of the sensor by the difference of fx and fy, px.
const MAX_DISPLACEMENT_PX: f64 = 0.1;

/// Keys of `camera` that follow from the table.
const KEYS: [&str; 6] = [
    "camera.focal_length_mm",
    "camera.principal_point_px",
    "camera.distortion",
    "camera.position_mm",
    "camera.look_at_mm",
    "camera.column_axis",
];

/// Values of the camera that the conversion requires.
#[derive(Deserialize)]
struct Tables {
    camera: Option<CameraKeys>,
}

#[derive(Deserialize)]
struct CameraKeys {
    opencv: Option<OpenCvTable>,
    pixel_pitch_um: Option<f64>,
    focus_distance_mm: Option<f64>,
    resolution_px: Option<[u32; 2]>,
}

/// Returns the source with the keys of `camera` that follow from `camera.opencv`, or unchanged
/// without this table.
///
/// # Errors
/// Returns `Error::Input` for a matrix or coefficients that the camera model does not represent, and
/// for keys that contradict the table.
pub(super) fn take_opencv(source: TomlSource, file: &Path) -> Result<TomlSource, Error> {
    let Some(camera) = source.values::<Tables>()?.camera else {
        return Ok(source);
    };
    let Some(table) = &camera.opencv else {
        return Ok(source);
    };
    let others = ["camera.focus", "camera.tilt_deg", "camera.telecentric"];
    for key in KEYS.into_iter().chain(others) {
        if source.has(key) {
            let expected = "no such key with [camera.opencv], which defines the camera";
            return Err(source.input_error(key, expected));
        }
    }
    let required = |value: Option<f64>, key: &str| value.ok_or_else(|| source.missing(key));
    let pitch_mm = required(camera.pixel_pitch_um, "camera.pixel_pitch_um")? * 1e-3;
    let focus_mm = required(camera.focus_distance_mm, "camera.focus_distance_mm")?;
    let resolution = camera.resolution_px;
    let resolution = resolution.ok_or_else(|| source.missing("camera.resolution_px"))?;
    let text = table.to_keys(pitch_mm, focus_mm, resolution.map(f64::from));
    let text = text.map_err(|(key, expected)| {
        source.input_error(&format!("camera.opencv.{key}"), &expected)
    })?;
    Ok(source.overlay(file, &text, true))
}

impl OpenCvTable {
    /// Returns the keys of the camera as TOML. `size`: columns and rows of the sensor. The error is
    /// the name of a wrong key and the expected value.
    fn to_keys(
        &self,
        pitch_mm: f64,
        focus_mm: f64,
        size: [f64; 2],
    ) -> Result<String, (&'static str, String)> {
        let [[fx, skew, cx], [low, fy, cy], last] = self.camera_matrix;
        let form = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy > 0";
        let finite = [fx, fy, cx, cy].iter().all(|value| value.is_finite());
        let has_form = finite && skew == 0.0 && low == 0.0 && last == [0.0, 0.0, 1.0];
        if !has_form || fx <= 0.0 || fy <= 0.0 {
            return Err(("camera_matrix", form.to_owned()));
        }
        let mean = (fx + fy) / 2.0;
        // Distance of the corners from the principal point along both axes.
        let reach = [(cx, size[0]), (cy, size[1])]
            .map(|(center, size)| (center + 0.5).abs().max((size - center - 0.5).abs()));
        let moved = reach[0].max(reach[1]) * (fx - fy).abs() / 2.0 / mean;
        if moved > MAX_DISPLACEMENT_PX {
            let expected = format!(
                "square pixels: fx and fy differ by {moved:.2} px at the corners of the sensor; calibrate with \
                 CALIB_FIX_ASPECT_RATIO"
            );
            return Err(("camera_matrix", expected));
        }
        let [k1, k2, p1, p2, k3] = match *self.distortion_coefficients {
            [] => [0.0; 5],
            [k1, k2, p1, p2] => [k1, k2, p1, p2, 0.0],
            [k1, k2, p1, p2, k3] => [k1, k2, p1, p2, k3],
            _ => {
                let expected = "4 or 5 numbers [k1, k2, p1, p2, k3]; rational, thin-prism and tilted models of OpenCV \
                                are not supported";
                return Err(("distortion_coefficients", expected.to_owned()));
            }
        };
        for (key, vector) in [("rvec", self.rvec), ("tvec_mm", self.tvec_mm)] {
            if !vector.iter().all(|value| value.is_finite()) {
                return Err((key, "finite numbers".to_owned()));
            }
        }
        // Thin lens: the principal distance is the image distance of the plane in focus.
        let image_mm = mean * pitch_mm;
        let focal = image_mm * focus_mm / (image_mm + focus_mm);
        let rotation = DMat3::from_quat(glam::DQuat::from_scaled_axis(self.rvec.into()));
        let head_from_camera = rotation.transpose();
        let position = -(head_from_camera * DVec3::from(self.tvec_mm));
        let look_at = position + head_from_camera.z_axis * focus_mm;
        let mut text = String::new();
        let mut key = |name: &str, value: String| {
            let _ = writeln!(text, "camera.{name} = {value}");
        };
        key("focal_length_mm", format!("{focal:?}"));
        key(
            "principal_point_px",
            format!("[{:?}, {:?}]", cx + 0.5, cy + 0.5),
        );
        key("position_mm", format!("{:?}", position.to_array()));
        key("look_at_mm", format!("{:?}", look_at.to_array()));
        let columns = head_from_camera.x_axis.to_array();
        key("column_axis", format!("{columns:?}"));
        if [k1, k2, p1, p2, k3] != [0.0; 5] {
            let all =
                format!("{{ k1 = {k1:?}, k2 = {k2:?}, k3 = {k3:?}, p1 = {p1:?}, p2 = {p2:?} }}");
            key("distortion", all);
        }
        Ok(text)
    }
}

#[cfg(test)]
mod tests {
    use crate::math::{DVec2, DVec3};
    use crate::scene::Scene;

    const PLANE: &str = include_str!("../../scenes/plane/scene.toml");

    /// Returns the scene of a plane whose camera is described by an OpenCV table.
    fn scene(table: &str, others: &str) -> crate::error::Result<Scene> {
        let mut values: toml::Table = PLANE.parse().unwrap();
        let camera = values["camera"].as_table_mut().unwrap();
        for key in super::KEYS {
            camera.remove(key.trim_start_matches("camera."));
        }
        let extra: toml::Table = others.parse().unwrap();
        camera.extend(extra);
        camera.insert(
            "opencv".to_owned(),
            toml::Value::Table(table.parse().unwrap()),
        );
        Scene::parse(&toml::to_string(&values).unwrap(), "".as_ref())
    }

    /// Rodrigues' formula and the projection of OpenCV's documentation.
    fn projected(
        p: DVec3,
        [rvec, tvec]: [DVec3; 2],
        [fx, fy, cx, cy]: [f64; 4],
        [k1, k2, p1, p2, k3]: [f64; 5],
    ) -> DVec2 {
        let (angle, axis) = (rvec.length(), rvec.normalize());
        let turned = p * angle.cos()
            + axis.cross(p) * angle.sin()
            + axis * axis.dot(p) * (1.0 - angle.cos());
        let q = turned + tvec;
        let (x, y) = (q.x / q.z, q.y / q.z);
        let r2 = x * x + y * y;
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2 + k3 * r2 * r2 * r2;
        let u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        DVec2::new(fx * u + cx, fy * v + cy)
    }

    /// Points in front of the camera have the pixel coordinates of OpenCV plus half a pixel, for
    /// three cameras. Rounding of the pose and of the focal length is below 1e-9 px.
    #[test]
    fn points_have_the_pixels_of_opencv() {
        let original = Scene::parse(PLANE, "".as_ref()).unwrap();
        let camera_from_head = original.head_from_camera.inverse();
        let turn = crate::math::rotation_vector(&camera_from_head.rotation);
        let shift = camera_from_head.translation;
        let size = original.camera.sensor.resolution.as_dvec2();
        for (f, [cx, cy], [k1, k2, p1, p2, k3], by) in [
            (4000.0, [30.0, 25.0], [0.0; 5], DVec3::ZERO),
            (
                3000.0,
                [0.4, 12.3],
                [-0.2, 0.1, 1e-3, -2e-3, 0.0],
                DVec3::new(0.02, -0.01, 0.03),
            ),
            (
                5000.0,
                [size.x * 0.6, size.y * 0.45],
                [0.3, -0.2, -1e-3, 1e-3, 0.05],
                DVec3::new(-0.03, 0.01, 0.1),
            ),
        ] {
            let [rvec, tvec] = [turn + by, shift + by * 10.0];
            let coefficients = [k1, k2, p1, p2, k3];
            let table = format!(
                "camera_matrix = [[{f:?}, 0, {cx:?}], [0, {f:?}, {cy:?}], [0, 0, 1]]\n\
                 distortion_coefficients = {coefficients:?}\nrvec = {:?}\ntvec_mm = {:?}",
                rvec.to_array(),
                tvec.to_array()
            );
            let scene = scene(&table, "").unwrap();
            let model = scene.camera.model();
            let camera_from_head = scene.head_from_camera.inverse();
            for p in [
                DVec3::ZERO,
                DVec3::new(1.0, 2.0, -0.5),
                DVec3::new(-2.0, 0.3, 1.0),
            ] {
                let expected = projected(p, [rvec, tvec], [f, f, cx, cy], coefficients);
                let found = model.project(camera_from_head.point(p)).unwrap();
                let error = (found - expected - 0.5).length();
                assert!(error < 1e-7, "{found} {expected}");
            }
        }
    }

    #[test]
    fn wrong_tables_name_their_key() {
        let rest = "rvec = [0.1, 0, 0]\ntvec_mm = [0, 0, 200]";
        let good = format!("camera_matrix = [[4000, 0, 30], [0, 4000, 20], [0, 0, 1]]\n{rest}");
        let with = |from: &str, to: &str| good.replace(from, to);
        for (table, others, key) in [
            (
                with("[0, 4000, 20]", "[0, 4100, 20]"),
                "",
                "camera.opencv.camera_matrix",
            ),
            (
                with("[4000, 0, 30]", "[4000, 0.1, 30]"),
                "",
                "camera.opencv.camera_matrix",
            ),
            (
                with("[0, 0, 1]", "[0, 0, 2]"),
                "",
                "camera.opencv.camera_matrix",
            ),
            (
                format!("distortion_coefficients = [0, 0, 0, 0, 0, 1]\n{good}"),
                "",
                "camera.opencv.distortion_coefficients",
            ),
            (
                with("rvec = [0.1, 0, 0]", "rvec = [nan, 0, 0]"),
                "",
                "camera.opencv.rvec",
            ),
            (
                good.clone(),
                "focal_length_mm = 50",
                "camera.focal_length_mm",
            ),
            (good.clone(), "tilt_deg = [1, 0]", "camera.tilt_deg"),
        ] {
            let Err(crate::Error::Input(mistake)) = scene(&table, others) else {
                panic!("{table}");
            };
            assert_eq!(mistake.key.as_deref(), Some(key), "{table}");
        }
    }
}

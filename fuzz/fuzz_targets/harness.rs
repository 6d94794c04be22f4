//! What must hold of any bytes, for the targets and for tests/limits_mutated.rs.

// Each target uses one of them.
#![allow(dead_code)]

use lasertrace::error::Error;
use lasertrace::math::DVec2;
use lasertrace::mesh;
use lasertrace::profile::{Calibration, PeakFinder};
use lasertrace::scene::{Scene, parse_poses};
use lasertrace::study::{Channel, LineAlong, parse_image};
use std::path::Path;

/// Whether bytes are a mesh, which then is valid and has a finite report; else the
/// error is as [`refused`] has it.
pub fn is_mesh(bytes: &[u8]) -> bool {
    match mesh::parse(Path::new("part"), bytes, 1.0) {
        Ok(mesh) => {
            let vertices = mesh.positions.len();
            assert!(!mesh.triangles.is_empty());
            let corners = mesh.triangles.as_flattened();
            assert!(corners.iter().all(|&v| (v as usize) < vertices));
            assert!(mesh.positions.iter().all(|p| p.is_finite()));
            let report = mesh::report(&mesh);
            assert!(report.volume_mm3.is_finite());
            assert!(!report.to_string().contains("NaN"));
            true
        }
        Err(error) => refused(&error),
    }
}

/// Whether bytes, written to `path`, are a scene, whose poses then are finite.
pub fn is_scene(path: &Path, bytes: &[u8]) -> bool {
    std::fs::write(path, bytes).unwrap();
    match Scene::load(path) {
        Ok(scene) => {
            assert!(!scene.mesh.triangles.is_empty());
            assert!(scene.mesh.positions.iter().all(|p| p.is_finite()));
            for frame in [0, scene.scan.frames - 1] {
                let pose = scene.part_from_head(frame);
                assert!(pose.translation.is_finite() && pose.rotation.is_finite());
            }
            true
        }
        Err(error) => refused(&error),
    }
}

/// Whether bytes are a list of poses, which then are rigid.
pub fn is_poses(bytes: &[u8]) -> bool {
    match parse_poses(Path::new("poses"), bytes) {
        Ok(poses) => {
            assert!(!poses.is_empty());
            for pose in poses {
                assert!(pose.translation.is_finite());
                assert!((pose.rotation.determinant() - 1.0).abs() < 1e-12);
            }
            true
        }
        Err(error) => refused(&error),
    }
}

/// Whether bytes are a calibration, which then gives finite points or none, and writes
/// itself in numbers.
pub fn is_calibration(bytes: &[u8]) -> bool {
    match Calibration::parse(Path::new("calibration"), bytes) {
        Ok(calibration) => {
            let size = calibration.camera.resolution.as_dvec2();
            for at in [DVec2::ZERO, DVec2::splat(0.5), DVec2::ONE] {
                if let Some(found) = calibration.point_jacobian(at * size) {
                    assert!(found.point.is_finite());
                }
            }
            let text = serde_json::to_string(&calibration).unwrap();
            // How JSON has what is no number.
            assert!(!text.contains("null"), "{text}");
            true
        }
        Err(error) => refused(&error),
    }
}

/// Whether bytes are an image, in which lines then are found by finite rows.
pub fn is_image(bytes: &[u8]) -> bool {
    match parse_image(
        Path::new("image"),
        bytes,
        LineAlong::Columns,
        Channel::Brightest,
    ) {
        Ok(image) => {
            for finder in PeakFinder::ALL {
                for peak in image.peaks(finder) {
                    assert!(peak.row.is_finite() && peak.sigma.is_finite());
                }
            }
            true
        }
        Err(error) => refused(&error),
    }
}

/// False; the error is of the input, in one line that says what was expected.
fn refused(error: &Error) -> bool {
    let text = error.to_string();
    assert!(
        text.contains("expected") && text.lines().count() == 1,
        "{text}"
    );
    assert_eq!(error.exit_code(), 65, "{text}");
    false
}

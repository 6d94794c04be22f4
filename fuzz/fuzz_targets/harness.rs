//! What must hold of any bytes, for the targets and for tests/geometry/limits_mutated.rs.

// Each target uses one of them.
#![allow(dead_code)]

use lasertrace::error::Error;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::math::{DVec2, DVec3};
use lasertrace::mesh;
use lasertrace::profile::{Calibration, Flags, PeakFinder};
use lasertrace::report::formats;
use lasertrace::run::untrusted;
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

/// Whether bytes, written to `path`, are a scan's journal with points, which then are finite: as they are, and with
/// checksums that are right.
pub fn is_journal(path: &Path, bytes: &[u8]) -> bool {
    [bytes.to_vec(), mended(bytes)].into_iter().any(|bytes| {
        std::fs::write(path, bytes).unwrap();
        match untrusted::journal_points(path) {
            Ok(points) => points.is_some_and(|points| are_finite(&points)),
            Err(error) => refused(&error),
        }
    })
}

/// The same of a shard's journal.
pub fn is_shard(path: &Path, bytes: &[u8]) -> bool {
    [bytes.to_vec(), mended(bytes)].into_iter().any(|bytes| {
        std::fs::write(path, bytes).unwrap();
        match untrusted::shard_points(path) {
            Ok(shard) => shard.is_some_and(|(_, points)| are_finite(&points)),
            Err(error) => refused(&error),
        }
    })
}

/// Whether there are points; all are finite.
fn are_finite(points: &[CloudPoint]) -> bool {
    for point in points {
        let numbers = [
            point.deviation,
            point.u_position,
            point.repeatability,
            point.correlation_length,
            point.scan_correlation_length,
            point.u_deviation,
            point.intensity,
            point.row,
            point.line_sigma_px,
        ];
        assert!(point.position.is_finite() && point.normal.is_finite());
        assert!(numbers.iter().all(|number| number.is_finite()), "{point:?}");
    }
    !points.is_empty()
}

/// A journal whose records have their CRC: without it few changes get past the first check.
fn mended(bytes: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    let mut at = 0;
    while let Some(head) = bytes.get(at..at + 8) {
        let length = u32::from_le_bytes(head[..4].try_into().unwrap()) as usize;
        let Some(content) = bytes.get(at + 8..(at + 8).saturating_add(length)) else {
            break;
        };
        let sum = crc32fast::hash(content).to_le_bytes();
        bytes[at + 4..at + 8].copy_from_slice(&sum);
        at += 8 + length;
    }
    bytes
}

/// Whether bytes are a list of an output folder, or the index of a tar file.
pub fn is_manifest(bytes: &[u8]) -> bool {
    for file in ["cloud.ply", "frames/frame-000001.png", "cloud.ply.part", ""] {
        untrusted::list_names(bytes, file);
    }
    untrusted::list_names(bytes, "summary.json").is_some() || untrusted::is_tar_index(bytes)
}

/// Whether bytes have a point's numbers, of which an NPY file is then written that has them, whatever they are.
pub fn is_npy(bytes: &[u8]) -> bool {
    const NUMBERS: usize = 13;
    let points: Vec<CloudPoint> = bytes
        .chunks_exact(8 * NUMBERS)
        .map(|bytes| {
            let numbers: Vec<f64> = (bytes.chunks_exact(8))
                .map(|number| f64::from_le_bytes(number.try_into().unwrap()))
                .collect();
            CloudPoint {
                position: DVec3::new(numbers[0], numbers[1], numbers[2]),
                deviation: numbers[3],
                u_position: numbers[4],
                repeatability: numbers[5],
                correlation_length: numbers[6],
                scan_correlation_length: numbers[7],
                u_deviation: numbers[8],
                intensity: numbers[9],
                frame: numbers[10] as u32,
                column: numbers[10] as u32,
                row: numbers[11],
                line_sigma_px: numbers[12],
                flags: Flags::empty(),
                normal: DVec3::Z.as_vec3(),
                direct_fraction: 1.0,
            }
        })
        .collect();
    let mut npy = Vec::new();
    formats::npy(&mut npy, &points).unwrap();
    // NumPy's format 1.0: magic, length of the header, header.
    assert_eq!(&npy[..8], b"\x93NUMPY\x01\x00");
    let header = usize::from(u16::from_le_bytes([npy[8], npy[9]]));
    let (head, values) = npy[10..].split_at(header);
    assert_eq!((10 + header) % 64, 0);
    let shape = format!("'shape': ({},)", points.len());
    assert!(std::str::from_utf8(head).unwrap().contains(&shape));
    assert_eq!(values.len(), 106 * points.len());
    for (point, bytes) in points.iter().zip(values.chunks_exact(106)) {
        // Row, after frame and column.
        assert_eq!(bytes[8..16], point.row.to_le_bytes());
    }
    !points.is_empty()
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

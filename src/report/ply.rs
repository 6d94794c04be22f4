//! The point cloud as a PLY file, `cloud.ply`.

use super::color::diverging;
use crate::inspect::cloud::CloudPoint;
use crate::inspect::tolerance::{ToleranceBand, Verdict, classify_point};
use std::io::{self, Write};

/// Returns the deviation at the ends of the colour scale, µm: the 98th percentile of the valid
/// points. The minimum is one nanometre. Without valid points the value is one micrometre.
pub fn color_limit_um(points: &[CloudPoint], value: impl Fn(&CloudPoint) -> f64) -> f64 {
    let valid = points.iter().filter(|p| p.is_valid());
    let mut values: Vec<f64> = valid.map(|p| value(p).abs() * 1e3).collect();
    if values.is_empty() {
        return 1.0;
    }
    let most = values.len() * 98 / 100;
    (values.select_nth_unstable_by(most, f64::total_cmp).1).max(1e-3)
}

/// Writes a binary PLY with the following properties:
///
/// - x, y, z (double, mm, frame of the part), nx, ny, nz (float);
/// - red, green, blue (uchar), the deviation as in the report;
/// - deviation, u_position, u_deviation, repeatability, correlation_length and
///   scan_correlation_length (float, mm);
/// - intensity (float, counts);
/// - frame, column and flags (int, the bits of [`Flags`](crate::profile::Flags));
/// - with `bands`, verdict (int: 0 none, 1 pass, 2 fail, 3 unsure) and region (int: index of the
///   band, -1 none);
/// - if indirect light is modelled, direct (float).
///
/// CloudCompare reads a property as a scalar field only if it is called `intensity` or its name
/// begins with `scalar_`. MeshLab deletes points by a property called `flags`. All names that PLY
/// itself does not define therefore have this prefix.
pub fn write_ply(
    mut out: impl Write,
    points: &[CloudPoint],
    bands: &[ToleranceBand],
) -> io::Result<()> {
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\n\
         comment lasertrace: millimetres, frame of the part\n\
         element vertex {}\n\
         property double x\nproperty double y\nproperty double z\n\
         property float nx\nproperty float ny\nproperty float nz\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\n\
         property float scalar_deviation\nproperty float scalar_u_position\n\
         property float scalar_u_deviation\nproperty float intensity\n\
         property float scalar_repeatability\nproperty float scalar_correlation_length\n\
         property float scalar_scan_correlation_length\n\
         property int scalar_frame\nproperty int scalar_column\nproperty int scalar_flags\n{}",
        points.len(),
        match bands {
            [] => "",
            _ => "property int scalar_verdict\nproperty int scalar_region\n",
        }
    )?;
    let reflections = points.iter().any(|point| point.direct_fraction != 1.0);
    if reflections {
        out.write_all(b"property float scalar_direct_fraction\n")?;
    }
    out.write_all(b"end_header\n")?;
    let limit = color_limit_um(points, |p| p.deviation);
    for point in points {
        for coordinate in point.position.to_array() {
            out.write_all(&coordinate.to_le_bytes())?;
        }
        for component in point.normal.to_array() {
            out.write_all(&component.to_le_bytes())?;
        }
        out.write_all(&diverging(point.deviation * 1e3, limit))?;
        let CloudPoint {
            deviation,
            u_position,
            u_deviation,
            intensity,
            repeatability,
            correlation_length,
            scan_correlation_length,
            ..
        } = *point;
        for value in [
            deviation,
            u_position,
            u_deviation,
            intensity,
            repeatability,
            correlation_length,
            scan_correlation_length,
        ] {
            out.write_all(&(value as f32).to_le_bytes())?;
        }
        // Frames and columns are far below 2³¹.
        for number in [point.frame, point.column, point.flags.bits().into()] {
            out.write_all(&number.to_le_bytes())?;
        }
        if !bands.is_empty() {
            let judged = classify_point(bands, point);
            let verdict = Verdict::number(judged.map(|(_, verdict)| verdict));
            let region = judged.map_or(-1, |(region, _)| region as i32);
            out.write_all(&verdict.to_le_bytes())?;
            out.write_all(&region.to_le_bytes())?;
        }
        if reflections {
            out.write_all(&point.direct_fraction.to_le_bytes())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::DVec3;
    use crate::profile::Flags;
    use glam::Vec3;

    /// The file has the length and the values described by its header.
    #[test]
    fn a_ply_holds_what_its_header_names() {
        let point = |i: u32| CloudPoint {
            position: DVec3::new(i as f64, 2.0, 3.0),
            deviation: 0.01,
            u_position: 0.02,
            u_deviation: 0.015,
            repeatability: 0.003,
            correlation_length: 0.1,
            scan_correlation_length: 0.1,
            intensity: 900.0,
            frame: 70_000 + i,
            column: 7,
            row: 31.25,
            line_sigma_px: 1.5,
            flags: Flags::LOW_SIGNAL | Flags::DISCONTINUITY,
            normal: Vec3::Y,
            direct_fraction: 1.0,
        };
        let points = [point(0), point(1)];
        let mut bytes = Vec::new();
        write_ply(&mut bytes, &points, &[]).unwrap();
        let end = b"end_header\n";
        let header = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
        let text = std::str::from_utf8(&bytes[..header]).unwrap();
        let sizes = [("double", 8), ("float", 4), ("uchar", 1), ("int", 4)];
        let size = |line: &str| {
            let kind = line.strip_prefix("property ")?.split(' ').next()?;
            sizes.iter().find(|s| s.0 == kind).map(|s| s.1)
        };
        let record: usize = text.lines().filter_map(size).sum();
        assert_eq!(text.matches("property").count(), 19);
        assert_eq!(bytes.len() - header, 2 * record);
        let second = &bytes[header + record..];
        let int = |at: usize| u32::from_le_bytes(second[at..at + 4].try_into().unwrap());
        assert_eq!(second[..8], 1f64.to_le_bytes());
        assert_eq!(second[28..32], 1f32.to_le_bytes());
        assert_eq!(second[36..39], diverging(10.0, 10.0));
        let flags = (Flags::LOW_SIGNAL | Flags::DISCONTINUITY).bits();
        assert_eq!([67, 71, 75].map(int), [70_001, 7, flags.into()]);
        // With indirect light, each point has its direct fraction.
        let ghost = CloudPoint {
            direct_fraction: 0.25,
            ..point(1)
        };
        let mut bytes = Vec::new();
        write_ply(&mut bytes, &[point(0), ghost], &[]).unwrap();
        assert_eq!(bytes[bytes.len() - 4..], 0.25f32.to_le_bytes());
        assert_eq!(
            bytes[bytes.len() - 4 - record - 4..][..4],
            1f32.to_le_bytes()
        );
    }
}

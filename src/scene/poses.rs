//! A list of poses as robots and tracking systems write them: CSV.

use crate::error::{Error, InputError, Place, Result};
use crate::math::{DMat3, DVec3, Rigid};
use crate::mesh::LARGEST_MM;
use csv::{ErrorKind, ReaderBuilder, StringRecord, Trim};
use glam::DQuat;
use std::path::Path;

const EULER: [&str; 6] = ["x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg"];
const QUATERNION: [&str; 7] = ["x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"];

/// The poses of a CSV file in the order of its lines: a header, either
/// `x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg` (rotations about the fixed x, then y, then
/// z axis) or `x_mm,y_mm,z_mm,qw,qx,qy,qz` (unit quaternion, real part first); then
/// numbers. Errors name file, line and column.
pub fn parse(file: &Path, bytes: &[u8]) -> Result<Vec<Rigid>> {
    let mut reader = ReaderBuilder::new()
        .trim(Trim::All)
        .flexible(true)
        .from_reader(bytes);
    let header = reader.headers().map_err(|e| unreadable(file, &e))?.clone();
    let columns: &[&str] = match () {
        () if header == EULER[..] => &EULER,
        () if header == QUATERNION[..] => &QUATERNION,
        () => {
            let found = header.iter().collect::<Vec<_>>().join(",");
            let expected = format!("the header {} or {}", EULER.join(","), QUATERNION.join(","));
            let place = place(bytes, &header);
            return Err(InputError::new(file, place, format!("{found:?}"), expected).into());
        }
    };
    let poses = reader
        .records()
        .map(|record| {
            let record = record.map_err(|e| unreadable(file, &e))?;
            pose(columns, &record).map_err(|(column, found, expected)| {
                let mut error = InputError::new(file, place(bytes, &record), found, expected);
                error.key = column.map(str::to_owned);
                error.into()
            })
        })
        .collect::<Result<Vec<_>>>()?;
    if poses.is_empty() || poses.len() > u32::MAX as usize {
        let found = format!("{} poses", poses.len());
        let error = InputError::new(file, Place::File, found, "from 1 to 4294967295");
        return Err(error.into());
    }
    Ok(poses)
}

/// Where a record stands. The reader's own position is before the blank lines that it
/// skips.
fn place(bytes: &[u8], record: &StringRecord) -> Place {
    let start = record.position().map_or(0, |at| at.byte() as usize);
    let blank = |b: &&u8| matches!(b, b'\r' | b'\n');
    let skipped = bytes[start..].iter().take_while(blank).count();
    let before = &bytes[..start + skipped];
    Place::Line(1 + before.iter().filter(|&&b| b == b'\n').count())
}

fn unreadable(file: &Path, error: &csv::Error) -> Error {
    let place = match error.position() {
        Some(at) => Place::Line(at.line() as usize),
        None => Place::File,
    };
    let found = match error.kind() {
        ErrorKind::Utf8 { .. } => "bytes that are not UTF-8".to_owned(),
        _ => error.to_string(),
    };
    InputError::new(file, place, found, "CSV text").into()
}

/// A line's pose, or the column at fault, what it holds and what was expected.
fn pose<'a>(
    columns: &[&'a str],
    record: &StringRecord,
) -> std::result::Result<Rigid, (Option<&'a str>, String, String)> {
    if record.len() != columns.len() {
        let expected = format!("{}, one a column", columns.len());
        return Err((None, format!("{} values", record.len()), expected));
    }
    let mut values = [0.0; 7];
    for ((value, text), &column) in values.iter_mut().zip(record).zip(columns) {
        let (limit, expected) = match column {
            _ if column.ends_with("_mm") => (LARGEST_MM, "a number within 1e12 mm"),
            _ if column.ends_with("_deg") => (360.0, "an angle from -360 to 360"),
            _ => (1.01, "a number from -1 to 1"),
        };
        // Not a number fails as NaN does.
        *value = text.parse().unwrap_or(f64::NAN);
        let holds = value.abs() <= limit;
        if !holds {
            return Err((Some(column), format!("{text:?}"), expected.to_owned()));
        }
    }
    let [x, y, z, a, b, c, d] = values;
    let position = DVec3::new(x, y, z);
    if columns.len() == EULER.len() {
        let angles = DVec3::new(a, b, c).map(f64::to_radians);
        return Ok(Rigid::from_euler_xyz(angles, position));
    }
    let quaternion = DQuat::from_xyzw(b, c, d, a);
    let length = quaternion.length();
    // Room for three digits; past that the four numbers are something else.
    if (length - 1.0).abs() > 0.01 {
        let found = format!("a quaternion of length {length:.4}");
        return Err((None, found, "length 1".to_owned()));
    }
    Ok(Rigid {
        rotation: DMat3::from_quat(quaternion.normalize()),
        translation: position,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n";
    const TURNED: &str = "x_mm,y_mm,z_mm,qw,qx,qy,qz\n";

    fn parsed(text: &str) -> Result<Vec<Rigid>> {
        parse(Path::new("path.csv"), text.as_bytes())
    }

    #[test]
    fn angles_and_quaternions_say_the_same() {
        // As programs write it: byte-order mark, CR LF, spaces, quotes, blank lines.
        let angles = format!(
            "\u{feff}{}\r\n1, 2,-3e1,0,0,90\r\n\r\n\"4\",5,6,0,0,0",
            HEADER.trim()
        );
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let turned = format!("{TURNED}1,2,-30,{half},0,0,{half}\n4,5,6,-1,0,0,0\n");
        let (a, b) = (parsed(&angles).unwrap(), parsed(&turned).unwrap());
        assert_eq!((a.len(), b.len()), (2, 2));
        for (a, b) in a.iter().zip(&b) {
            assert_eq!(a.translation, b.translation);
            assert!((a.vector(DVec3::X) - b.vector(DVec3::X)).length() < 1e-15);
            assert!((a.vector(DVec3::Y) - b.vector(DVec3::Y)).length() < 1e-15);
        }
        assert!((a[0].vector(DVec3::X) - DVec3::Y).length() < 1e-15);
    }

    #[test]
    fn a_mistake_is_named_with_line_and_column() {
        let body = |lines: &str| format!("{HEADER}{lines}");
        let turned = |lines: &str| format!("{TURNED}{lines}");
        for (text, message) in [
            (
                "".into(),
                "path.csv:1: found \"\", expected the header x_mm,",
            ),
            (
                "1,2,3,0,0,0\n".into(),
                "path.csv:1: found \"1,2,3,0,0,0\", expected the header",
            ),
            (HEADER.into(), "path.csv: found 0 poses, expected from 1"),
            (
                body("1,2,3,0,0,0\n1,2,3,0,0\n"),
                "path.csv:3: found 5 values, expected 6",
            ),
            (
                body("1,2,3,0,0,0,7\n"),
                "path.csv:2: found 7 values, expected 6",
            ),
            (
                body("1,two,3,0,0,0\n"),
                "path.csv:2: y_mm: found \"two\", expected a number",
            ),
            (
                body("1,2,,0,0,0\n"),
                "path.csv:2: z_mm: found \"\", expected a number",
            ),
            (
                body("\n\nnan,2,3,0,0,0\n"),
                "path.csv:4: x_mm: found \"nan\"",
            ),
            (body("inf,2,3,0,0,0\n"), "path.csv:2: x_mm: found \"inf\""),
            (
                body("1e13,2,3,0,0,0\n"),
                "path.csv:2: x_mm: found \"1e13\", expected a number within",
            ),
            (
                body("1,2,3,0,361,0\n"),
                "path.csv:2: ry_deg: found \"361\", expected an angle",
            ),
            (
                turned("1,2,3,1,1.5,0,0\n"),
                "path.csv:2: qx: found \"1.5\", expected a number from",
            ),
            (
                turned("1,2,3,1,0,0,0\n1,2,3,0.5,0,0,0\n"),
                "path.csv:3: found a quaternion of length 0.5000",
            ),
            (body("1;2;3;0;0;0\n"), "path.csv:2: found 1 values"),
        ] {
            let error = parsed(&text).unwrap_err();
            assert_eq!(error.exit_code(), 65);
            let error = error.to_string();
            assert!(error.starts_with(message), "{text:?}: {error}");
        }
        let error = parse(Path::new("path.csv"), b"x_mm,\xff\n1").unwrap_err();
        assert!(error.to_string().contains("UTF-8"), "{error}");
    }
}

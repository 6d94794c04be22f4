//! Files of measured line profiles.

use super::poses::{place, unreadable};
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, InputError, Place, Result};
use crate::laser::MeasuredProfile;
use csv::{ReaderBuilder, Trim};
use serde::Deserialize;
use std::path::Path;

const EXPECTED: &str = "CSV text with the header angle_deg,power or angle_deg,power,width";

/// Largest difference of the first and the last angle from half the fan angle, degrees. Files state
/// angles in decimals.
const ANGLE_TOLERANCE_DEG: f64 = 1e-3;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ProfileSample {
    angle_deg: f64,
    power: f64,
    width: Option<f64>,
}

/// Returns the value of a sample that is not valid, and the expected value. `last` is the angle of the
/// sample before, and `half` is half of the fan angle, degrees.
fn mistake(sample: &ProfileSample, last: Option<f64>, half: f64) -> Option<(String, String)> {
    let angle = sample.angle_deg;
    let found = format!("{angle} degrees");
    match last {
        None if angle.is_nan() || (angle + half).abs() > ANGLE_TOLERANCE_DEG => {
            let expected = format!("{} degrees, half of laser.line.fan_deg, at first", -half);
            return Some((found, expected));
        }
        Some(last) if !angle.is_finite() || angle <= last => {
            let expected = format!("an angle above {last} degrees, the angle of the line before");
            return Some((found, expected));
        }
        _ => {}
    }
    if !(0.0..=1e30).contains(&sample.power) {
        let expected = "a power from 0 to 1e30".to_owned();
        return Some((sample.power.to_string(), expected));
    }
    let width = sample.width.unwrap_or(1.0);
    if !(0.01..=100.0).contains(&width) {
        let expected = "a width from 0.01 to 100, relative to the beam".to_owned();
        return Some((width.to_string(), expected));
    }
    None
}

/// Reads the profile of a fan with the full angle `fan_deg`, degrees.
///
/// # Errors
/// Returns `Error::Input` with the line for text that is not a number, angles that do not ascend from
/// −`fan_deg`/2 to `fan_deg`/2, negative powers, widths that are not positive, and a profile without
/// power.
pub(super) fn read(path: &Path, fan_deg: f64) -> Result<MeasuredProfile> {
    let text = input_file::read_text(path, LARGEST_TEXT, EXPECTED)?;
    let wrong = |place: Place, found: String, expected: &str| -> Error {
        InputError::new(path, place, found, expected).into()
    };
    let bytes = text.trim_start_matches('\u{feff}').as_bytes();
    let mut reader = ReaderBuilder::new()
        .trim(Trim::All)
        .comment(Some(b'#'))
        .from_reader(bytes);
    let headers = reader.headers().map_err(|error| unreadable(path, &error))?;
    let headers = headers.clone();
    let half = fan_deg / 2.0;
    let mut angles: Vec<f64> = Vec::new();
    let (mut powers, mut widths) = (Vec::new(), Vec::new());
    let mut end = Place::File;
    for record in reader.records() {
        let record = record.map_err(|error| unreadable(path, &error))?;
        end = place(bytes, &record);
        let sample: ProfileSample = record
            .deserialize(Some(&headers))
            .map_err(|error| wrong(end, error.to_string(), EXPECTED))?;
        if let Some((found, expected)) = mistake(&sample, angles.last().copied(), half) {
            return Err(wrong(end, found, &expected));
        }
        angles.push(sample.angle_deg);
        powers.push(sample.power);
        widths.push(sample.width.unwrap_or(1.0));
    }
    match angles[..] {
        [_, .., last] if (last - half).abs() <= ANGLE_TOLERANCE_DEG => {}
        [_, .., last] => {
            let expected = format!("{half} degrees, half of laser.line.fan_deg, at last");
            return Err(wrong(end, format!("{last} degrees"), &expected));
        }
        _ => {
            let found = format!("{} samples", angles.len());
            return Err(wrong(
                Place::File,
                found,
                &format!("two or more; {EXPECTED}"),
            ));
        }
    }
    if powers.iter().all(|&power| power <= 0.0) {
        let found = "a power of 0 at every angle".to_owned();
        return Err(wrong(Place::File, found, "a power above 0"));
    }
    let radians = angles.into_iter().map(f64::to_radians).collect();
    Ok(MeasuredProfile::new(radians, &powers, widths))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_text(text: &str) -> Result<MeasuredProfile> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("line.csv");
        std::fs::write(&file, text).unwrap();
        read(&file, 20.0)
    }

    #[test]
    fn widths_and_comments_are_optional() {
        let text = "# measured at 150 mm\nangle_deg, power\n-10, 1\n0, 3\n10, 1\n";
        let profile = read_text(text).unwrap();
        let middle = profile.power_per_radian(0.0);
        // The mean of the powers is 2.
        assert!(
            (middle * 20f64.to_radians() - 1.5).abs() < 1e-12,
            "{middle}"
        );
        assert_eq!(profile.power_per_radian(0.2), 0.0);
    }

    #[test]
    fn mistakes_have_a_line_and_a_remedy() {
        for (text, parts) in [
            ("", "0 samples"),
            ("angle_deg,power\n-10,1\n", "1 samples"),
            ("angle,power\n-10,1\n10,1\n", "angle_deg,power"),
            (
                "angle_deg,power\n-9,1\n10,1\n",
                ":2:|-9 degrees|-10 degrees",
            ),
            ("angle_deg,power\n-10,1\n9,1\n", ":3:|9 degrees|10 degrees"),
            ("angle_deg,power\n-10,1\n-10,1\n10,1\n", ":3:|above -10"),
            ("angle_deg,power\n-10,1\nNaN,1\n10,1\n", ":3:|NaN"),
            (
                "angle_deg,power\n-10,1\n0,-1\n10,1\n",
                ":3:|-1|power from 0",
            ),
            ("angle_deg,power\n-10,1\n0,x\n10,1\n", ":3:|float"),
            (
                "angle_deg,power,width\n-10,1,1\n0,1,0\n10,1,1\n",
                ":3:|width from 0.01",
            ),
            (
                "# x\nangle_deg,power\n\n-10,1\n# y\n-10,1\n10,1\n",
                ":6:|above -10",
            ),
            ("angle_deg,power\n-10,0\n10,0\n", "power of 0"),
        ] {
            let error = read_text(text).unwrap_err().to_string();
            for part in parts.split('|') {
                assert!(error.contains(part), "{text:?}: {error}");
            }
        }
    }
}

//! Data sheet of a sensor, and the laser and camera that are derived from it.
//!
//! The origin of the sensor frame is on the laser axis at the centre of the measuring range. The z
//! axis points towards the laser, and the x axis is along the line. The camera is at negative y.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt::Write;

/// Data sheet of a profile sensor, from which laser and camera are derived. The fields of view
/// determine the lens. Its position and direction follow from the range filling the sensor. The
/// sensor is tilted to bring the complete laser plane into focus. The origin of the head frame is
/// then at the centre of the measuring range, with z towards the laser and x along the line.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DataSheet {
    /// Distance from the laser's exit to the near end of the measuring range, along the beam (also
    /// "clearance distance", "start of measuring range"). If a data sheet states the distance to
    /// the centre of the range, subtract half the range.
    pub stand_off_mm: f64,
    /// Height of the measuring range.
    pub measuring_range_mm: f64,
    /// Measured width at the near end.
    pub field_near_mm: f64,
    /// Measured width at the far end.
    pub field_far_mm: f64,
    /// Points per profile, equal to the number of sensor columns.
    pub points_per_profile: u32,
    /// Triangulation angle between the laser axis and the line from the centre of the range to the
    /// lens.
    pub triangulation_deg: Option<f64>,
    /// Distance of the lens from the laser axis, perpendicular to it. If two angles have this
    /// baseline, the smaller angle is used.
    pub baseline_mm: Option<f64>,
    /// Wavelength of the laser. Default: 660.
    pub wavelength_nm: Option<f64>,
    /// Power of the laser. Default: 10.
    pub power_mw: Option<f64>,
    /// Full width (1/e²) of the line at the centre of the range. Default: the width that minimises
    /// the line width at the ends of the range.
    pub line_width_um: Option<f64>,
    /// F-number of the lens. Default: 5.6.
    pub f_number: Option<f64>,
    /// Pixel pitch of the sensor. Default: 5.5.
    pub pixel_pitch_um: Option<f64>,
    /// Number of sensor rows. Default: the number of rows that the range requires.
    pub rows: Option<u32>,
}

/// Origin of a value of a solved sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Origin {
    /// The value is in the data sheet.
    Given,
    /// The value is derived from the data sheet.
    Solved,
    /// The value is a default.
    Assumed,
}

/// A key of laser or camera with its value.
#[derive(Debug, Clone, Serialize)]
pub struct SolvedValue {
    /// Dotted key.
    pub key: &'static str,
    /// Value in TOML notation.
    pub value: String,
    /// Origin of the value.
    pub origin: Origin,
}

/// Contradiction in a data sheet: the key and the expected value.
pub type InconsistentValue = (&'static str, String);

/// Optics in the plane perpendicular to the line.
struct SolvedOptics {
    focal_length: f64,
    /// Position of the pupil, mm: distance from the laser axis, and height above the centre of the
    /// range.
    pupil: [f64; 2],
    /// Height at which the optical axis intersects the laser axis, mm.
    aim: f64,
    /// Length between the images of the range's ends on the sensor, along the columns, mm.
    extent: f64,
}

/// Fraction of the sensor rows that the range fills, if the data sheet does not determine the
/// angle.
const FILLED: f64 = 0.95;
/// Largest triangulation angle, degrees.
const STEEPEST: f64 = 75.0;

impl DataSheet {
    /// Returns all values of laser and camera. Returns an error if the data sheet contradicts
    /// itself.
    #[expect(clippy::too_many_lines, reason = "a table of one row a value")]
    pub fn solve(&self) -> Result<Vec<SolvedValue>, InconsistentValue> {
        self.check()?;
        let [near, far] = [self.field_near_mm, self.field_far_mm];
        let (range, stand_off) = (self.measuring_range_mm, self.stand_off_mm);
        let pitch = self.pixel_pitch_um.unwrap_or(5.5);
        let angle = self.angle(pitch * 1e-3)?;
        let optics = self
            .optics(angle, pitch * 1e-3)
            .expect("the angle was found with these optics");
        let rows = self.rows_for(&optics, angle, pitch * 1e-3)?;
        let exit = stand_off + range / 2.0;
        let [baseline, height] = optics.pupil;
        if height < exit {
            let expected = format!(
                "fields that a lens behind the laser's exit can see: those of {near} and {far} mm with the range \
                 of {range} mm put it {:.1} mm before the exit, which stands {stand_off} mm off",
                exit - height
            );
            return Err(("data_sheet.field_far_mm", expected));
        }
        let wavelength = self.wavelength_nm.unwrap_or(660.0);
        // The width at the ends of the range is smallest for a Rayleigh length of half the range.
        let least = (wavelength * 1e-6 * range / 2.0 / std::f64::consts::PI).sqrt() * 1e3;
        let waist = self.line_width_um.map_or(least, |width| width / 2.0);
        let fan = (far / 2.0 / (stand_off + range)).max(near / 2.0 / stand_off);
        use Origin::{Assumed, Given, Solved};
        let or = |given: bool| if given { Given } else { Assumed };
        let mut values = Vec::new();
        let mut value =
            |key, value: String, origin| values.push(SolvedValue { key, value, origin });
        value(
            "laser.wavelength_nm",
            number(wavelength),
            or(self.wavelength_nm.is_some()),
        );
        value(
            "laser.power_mw",
            number(self.power_mw.unwrap_or(10.0)),
            or(self.power_mw.is_some()),
        );
        value(
            "laser.waist_radius_um",
            number(waist),
            match self.line_width_um {
                Some(_) => Given,
                None => Assumed,
            },
        );
        value("laser.waist_distance_mm", number(exit), Assumed);
        value("laser.position_mm", list([0.0, 0.0, exit]), Given);
        value("laser.direction", list([0.0, 0.0, -1.0]), Given);
        value(
            "laser.line.fan_deg",
            number(2.0 * fan.atan().to_degrees()),
            Solved,
        );
        value("laser.line.profile", "\"uniform\"".to_owned(), Assumed);
        value("laser.line.direction", list([1.0, 0.0, 0.0]), Given);
        value(
            "camera.focal_length_mm",
            number(optics.focal_length),
            Solved,
        );
        value(
            "camera.f_number",
            number(self.f_number.unwrap_or(5.6)),
            or(self.f_number.is_some()),
        );
        value("camera.focus", "\"laser-plane\"".to_owned(), Solved);
        let resolution = format!("[{}, {rows}]", self.points_per_profile);
        value(
            "camera.resolution_px",
            resolution,
            if self.rows.is_some() { Given } else { Solved },
        );
        value(
            "camera.pixel_pitch_um",
            number(pitch),
            or(self.pixel_pitch_um.is_some()),
        );
        value("camera.position_mm", list([0.0, -baseline, height]), Solved);
        value("camera.look_at_mm", list([0.0, 0.0, optics.aim]), Solved);
        value("camera.columns", list([1.0, 0.0, 0.0]), Given);
        value("camera.exposure", "\"auto\"".to_owned(), Assumed);
        value(
            "camera.quantum_efficiency",
            number(if wavelength < 500.0 { 0.4 } else { 0.5 }),
            Assumed,
        );
        // The full well corresponds to full scale.
        value("camera.full_well_e", number(10_000.0), Assumed);
        value("camera.gain_dn_per_e", number(0.1), Assumed);
        value("camera.bit_depth", "10".to_owned(), Assumed);
        value("camera.black_level_dn", number(8.0), Assumed);
        value("camera.read_noise_e", number(10.0), Assumed);
        Ok(values)
    }

    fn check(&self) -> Result<(), InconsistentValue> {
        let lengths = [
            ("data_sheet.stand_off_mm", Some(self.stand_off_mm)),
            (
                "data_sheet.measuring_range_mm",
                Some(self.measuring_range_mm),
            ),
            ("data_sheet.field_near_mm", Some(self.field_near_mm)),
            ("data_sheet.field_far_mm", Some(self.field_far_mm)),
            ("data_sheet.baseline_mm", self.baseline_mm),
            ("data_sheet.pixel_pitch_um", self.pixel_pitch_um),
            ("data_sheet.line_width_um", self.line_width_um),
            ("data_sheet.wavelength_nm", self.wavelength_nm),
        ];
        for (key, length) in lengths {
            if !length.is_none_or(|length| (1e-3..=1e6).contains(&length)) {
                return Err((key, "a number from 1e-3 to 1e6".to_owned()));
            }
        }
        if self.field_near_mm >= self.field_far_mm * 0.999 {
            let expected = format!(
                "more than field_near_mm = {}: a camera sees more of what is farther",
                self.field_near_mm
            );
            return Err(("data_sheet.field_far_mm", expected));
        }
        let pixels = [
            (
                "data_sheet.points_per_profile",
                Some(self.points_per_profile),
            ),
            ("data_sheet.rows", self.rows),
        ];
        for (key, count) in pixels {
            if !count.is_none_or(|count| (8..=65_536).contains(&count)) {
                return Err((key, "a whole number from 8 to 65536".to_owned()));
            }
        }
        let angle = self.triangulation_deg;
        if !angle.is_none_or(|angle| (1.0..=STEEPEST).contains(&angle)) {
            return Err((
                "data_sheet.triangulation_deg",
                format!("an angle from 1 to {STEEPEST}"),
            ));
        }
        Ok(())
    }

    /// Returns the triangulation angle, rad.
    fn angle(&self, pitch: f64) -> Result<f64, InconsistentValue> {
        match (self.triangulation_deg, self.baseline_mm, self.rows) {
            (Some(angle), given, _) => {
                let Some(optics) = self.optics(angle.to_radians(), pitch) else {
                    let expected = format!(
                        "an angle at which a lens sees {} and {} mm at the ends of measuring_range_mm = {}",
                        self.field_near_mm, self.field_far_mm, self.measuring_range_mm
                    );
                    return Err(("data_sheet.triangulation_deg", expected));
                };
                let follows = optics.pupil[0];
                match given {
                    Some(given) if (given / follows - 1.0).abs() >= 0.01 => {
                        let expected = format!(
                            "{follows:.2}, which triangulation_deg = {angle} makes of these fields, or one of the \
                             two left out"
                        );
                        Err(("data_sheet.baseline_mm", expected))
                    }
                    _ => Ok(angle.to_radians()),
                }
            }
            (None, Some(given), _) => self
                .angle_where(pitch, given, |optics| optics.pupil[0])
                .map_err(|most| {
                    let expected = format!("at most {most:.2}, the most that these fields allow");
                    ("data_sheet.baseline_mm", expected)
                }),
            (None, None, Some(given)) => {
                let filled = |optics: &SolvedOptics| optics.extent / pitch / FILLED;
                self.angle_where(pitch, given.into(), filled).map_err(|most| {
                    let expected = format!(
                        "triangulation_deg or baseline_mm beside it, or at most {most:.0} rows, the most that the \
                         range of {} mm fills",
                        self.measuring_range_mm
                    );
                    ("data_sheet.rows", expected)
                })
            }
            (None, None, None) => {
                let expected =
                    "triangulation_deg or baseline_mm, or rows, so that the range fills them";
                Err(("data_sheet", expected.to_owned()))
            }
        }
    }

    /// Returns the smallest angle (rad) at which `of` equals `wanted`. Two angles have the same
    /// baseline; at the larger one the lens is close to the part. The error is the maximum of `of`.
    fn angle_where(
        &self,
        pitch: f64,
        wanted: f64,
        of: impl Fn(&SolvedOptics) -> f64,
    ) -> Result<f64, f64> {
        let at = |angle: f64| {
            self.optics(angle, pitch)
                .map_or(f64::NAN, |optics| of(&optics))
        };
        // The function rises once and falls once, so steps of half a degree locate the rise.
        let angles = (0..=2 * STEEPEST as u32).map(|i| (0.01 + f64::from(i) / 2.0).to_radians());
        let places: Vec<[f64; 2]> = angles.map(|angle| [angle, at(angle)]).collect();
        let rise = places
            .windows(2)
            .find(|two| two[0][1] <= wanted && wanted <= two[1][1]);
        match rise.and_then(|two| root([two[0][0], two[1][0]], |angle| at(angle) - wanted)) {
            Some(angle) => Ok(angle),
            None => Err(places.iter().fold(0.0, |most, place| place[1].max(most))),
        }
    }

    /// Returns the number of sensor rows. Returns an error if the sensor has too few.
    fn rows_for(
        &self,
        optics: &SolvedOptics,
        angle: f64,
        pitch: f64,
    ) -> Result<u32, InconsistentValue> {
        let needed = optics.extent / pitch;
        match self.rows {
            Some(rows) if needed > f64::from(rows) => {
                let expected = format!(
                    "at least {needed:.0}, which measuring_range_mm = {} takes at a triangulation angle of {:.2}°",
                    self.measuring_range_mm,
                    angle.to_degrees()
                );
                Err(("data_sheet.rows", expected))
            }
            Some(rows) => Ok(rows),
            // Sensors usually have a multiple of eight rows.
            None => Ok((needed / FILLED / 8.0).ceil() as u32 * 8),
        }
    }

    /// Computes the optics at a triangulation angle (rad), for square pixels of `pitch` mm. Returns
    /// `None` if no solution exists.
    ///
    /// With the laser plane in focus, a point at distance Z along the optical axis has the
    /// magnification f/(Z − f). For a sensor of width w, the field of view thus has the width
    /// w·(Z − f)/f. Over the range R, Z changes by R·cos α, where α is the angle between the
    /// optical axis and the laser axis. The two fields of view determine f and Z. The angle α is
    /// chosen to image both ends at equal distances from the sensor centre.
    fn optics(&self, angle: f64, pitch: f64) -> Option<SolvedOptics> {
        let half = self.measuring_range_mm / 2.0;
        let width = f64::from(self.points_per_profile) * pitch;
        let [near, far] = [self.field_near_mm, self.field_far_mm];
        let lens = |axis: f64| {
            let focal = width * 2.0 * half * axis.cos() / (far - near);
            let to_near = focal * (1.0 + near / width);
            let distance = (to_near + half * axis.cos()) / (angle - axis).cos();
            // Coordinates of the range's ends perpendicular to the optical axis, and their
            // magnifications.
            let across = [half, -half].map(|z| distance * (angle - axis).sin() + z * axis.sin());
            let scale = [near, far].map(|field| width / field);
            (
                focal,
                distance,
                [across[0] * scale[0], across[1] * scale[1]],
            )
        };
        let uneven = |axis: f64| {
            let (_, _, [near, far]) = lens(axis);
            near + far
        };
        // The near end has the larger magnification, so the axis passes between it and the centre.
        let axis = root([angle, (angle + 0.5).min(1.55)], uneven)?;
        let (focal, distance, [near, far]) = lens(axis);
        let aim = -distance * (angle - axis).sin() / axis.sin();
        let to_aim = distance * (angle - axis).cos() - aim * axis.cos();
        // Scheimpflug: tangent of the sensor tilt.
        let tilt = focal / (to_aim - focal) / axis.tan();
        Some(SolvedOptics {
            focal_length: focal,
            pupil: [distance * angle.sin(), distance * angle.cos()],
            aim,
            extent: (near - far) * tilt.hypot(1.0),
        })
    }
}

/// Returns a sign change of `f` between two arguments, by bisection to machine precision.
fn root([mut low, mut high]: [f64; 2], f: impl Fn(f64) -> f64) -> Option<f64> {
    let rising = f(low) <= 0.0;
    if rising == (f(high) <= 0.0) {
        return None;
    }
    for _ in 0..100 {
        let middle = (low + high) / 2.0;
        match (f(middle) <= 0.0) == rising {
            true => low = middle,
            false => high = middle,
        }
    }
    Some((low + high) / 2.0)
}

/// Formats a number, rounded to 1e-6 (in mm, a nanometre).
fn number(value: f64) -> String {
    format!("{:?}", (value * 1e6).round() / 1e6)
}

fn list(values: [f64; 3]) -> String {
    format!("[{}]", values.map(number).join(", "))
}

/// Returns the values as TOML of a sensor file.
pub fn as_toml(values: &[SolvedValue]) -> String {
    let mut text = String::new();
    for SolvedValue { key, value, .. } in values {
        // Dotted keys do not require tables in order.
        let _ = writeln!(text, "{key} = {value}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sheet() -> DataSheet {
        DataSheet {
            stand_off_mm: 160.0,
            measuring_range_mm: 90.0,
            field_near_mm: 82.0,
            field_far_mm: 118.0,
            points_per_profile: 1280,
            triangulation_deg: Some(25.0),
            baseline_mm: None,
            wavelength_nm: None,
            power_mw: None,
            line_width_um: None,
            f_number: None,
            pixel_pitch_um: None,
            rows: None,
        }
    }

    fn refused(sheet: &DataSheet) -> String {
        let (key, expected) = sheet.solve().unwrap_err();
        format!("{key}: {expected}")
    }

    #[test]
    fn the_baseline_that_follows_gives_the_angle_back() {
        let optics = sheet().optics(25f64.to_radians(), 5.5e-3).unwrap();
        let by_baseline = DataSheet {
            triangulation_deg: None,
            baseline_mm: Some(optics.pupil[0]),
            ..sheet()
        };
        let angle = by_baseline.angle(5.5e-3).unwrap();
        assert!((angle.to_degrees() - 25.0).abs() < 1e-9, "{angle}");
    }

    #[test]
    fn rows_alone_are_filled_by_the_range() {
        let by_rows = DataSheet {
            triangulation_deg: None,
            rows: Some(512),
            ..sheet()
        };
        let angle = by_rows.angle(5.5e-3).unwrap();
        let filled = by_rows.optics(angle, 5.5e-3).unwrap().extent / 5.5e-3 / 512.0;
        assert!((filled - FILLED).abs() < 1e-9, "{filled}");
    }

    #[test]
    fn what_contradicts_is_refused_with_both_values() {
        let both = DataSheet {
            baseline_mm: Some(70.0),
            ..sheet()
        };
        let said = refused(&both);
        assert!(
            said.starts_with("data_sheet.baseline_mm") && said.contains("triangulation_deg = 25"),
            "{said}"
        );
        let few = DataSheet {
            rows: Some(200),
            ..sheet()
        };
        let said = refused(&few);
        assert!(
            said.starts_with("data_sheet.rows") && said.contains("measuring_range_mm = 90"),
            "{said}"
        );
        let narrow = DataSheet {
            field_far_mm: 60.0,
            ..sheet()
        };
        let said = refused(&narrow);
        assert!(
            said.starts_with("data_sheet.field_far_mm") && said.contains("field_near_mm = 82"),
            "{said}"
        );
        let before = DataSheet {
            stand_off_mm: 400.0,
            ..sheet()
        };
        assert!(refused(&before).contains("before the exit"));
        let steep = DataSheet {
            triangulation_deg: Some(70.0),
            ..sheet()
        };
        let said = refused(&steep);
        assert!(
            said.starts_with("data_sheet.triangulation_deg")
                && said.contains("measuring_range_mm = 90"),
            "{said}"
        );
        let far_off = DataSheet {
            triangulation_deg: None,
            baseline_mm: Some(200.0),
            ..sheet()
        };
        assert!(refused(&far_off).starts_with("data_sheet.baseline_mm: at most 1"));
        let open = DataSheet {
            triangulation_deg: None,
            ..sheet()
        };
        assert!(refused(&open).contains("triangulation_deg or baseline_mm, or rows"));
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e7] {
            let bad = DataSheet {
                stand_off_mm: bad,
                ..sheet()
            };
            assert!(refused(&bad).starts_with("data_sheet.stand_off_mm"));
        }
    }
}

//! Data sheet of a sensor, and the laser and camera that are derived from it.
//!
//! The origin of the sensor frame is on the laser axis at the centre of the measuring range. The z
//! axis points towards the laser, and the x axis is along the line. The camera is at negative y.

use super::camera_geometry::{CameraGeometry, CameraOptics, STEEPEST, root};
use super::printed::{PrintedRange, rounding};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt::Write;

/// Data sheet of a profile sensor as printed, from which laser and camera are derived. The
/// measuring field is the polygon of the printed fields of view; the camera sees at least this
/// field. The sensor is tilted to bring the complete laser plane into focus. The origin of the head
/// frame is at the centre of the measuring range, with z towards the laser and x along the line.
/// Every key is optional if the quantity follows from others or can be estimated.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DataSheet {
    /// Distance from the laser's exit to the near end of the measuring range, along the beam (also
    /// "clearance distance", "start of measuring range").
    pub stand_off_mm: Option<f64>,
    /// Distance from the laser's exit to the reference position, along the beam. Without
    /// `stand_off_mm` the reference position is the centre of the measuring range.
    pub reference_distance_mm: Option<f64>,
    /// Height of the measuring range.
    pub measuring_range_mm: Option<f64>,
    /// Half the measuring range, for a range printed as ±. Replaces `measuring_range_mm`.
    pub half_range_mm: Option<f64>,
    /// Near and far end of the measuring range as distances from the laser's exit. Replaces
    /// `stand_off_mm` and `measuring_range_mm`.
    pub range_from_to_mm: Option<PrintedRange>,
    /// Measured width at the near end.
    pub field_near_mm: Option<f64>,
    /// Measured width at the reference position.
    pub field_reference_mm: Option<f64>,
    /// Measured width at the far end.
    pub field_far_mm: Option<f64>,
    /// Points per profile, equal to the number of sensor columns.
    pub points_per_profile: Option<u32>,
    /// Interval of the points along the line: a number for the reference position, or a list of the
    /// values at the near and the far end.
    pub x_interval_um: Option<PrintedRange>,
    /// Height resolution: a number, or a list of the values at the near and the far end. A
    /// resolution of 1/16 pixel is assumed where the triangulation angle is estimated from it.
    pub z_resolution_um: Option<PrintedRange>,
    /// Triangulation angle between the laser axis and the line from the centre of the range to the
    /// lens.
    pub triangulation_deg: Option<f64>,
    /// Distance of the lens from the laser axis, perpendicular to it. If two angles have this
    /// baseline, the smaller angle is used.
    pub baseline_mm: Option<f64>,
    /// Wavelength of the laser. Default: 660.
    pub wavelength_nm: Option<f64>,
    /// Power of the laser. Default: estimated from `laser_class`, otherwise 10.
    pub power_mw: Option<f64>,
    /// Laser class (IEC 60825-1).
    pub laser_class: Option<LaserClass>,
    /// Full width (1/e²) of the line at the reference position. Default: the width that minimises
    /// the line width at the ends of the range.
    pub line_width_um: Option<f64>,
    /// Profiles per second: a number, or a list of the lowest and the highest rate. The lowest rate
    /// is the frame rate with all rows.
    pub profile_rate_hz: Option<PrintedRange>,
    /// F-number of the lens. Default: 5.6.
    pub f_number: Option<f64>,
    /// Focal length of the lens. Default: the longest with which the camera sees the fields of view.
    pub focal_length_mm: Option<f64>,
    /// Pixel pitch of the sensor. Default: 5.5.
    pub pixel_pitch_um: Option<f64>,
    /// Number of sensor rows. Default: the number of rows that the range requires.
    pub rows: Option<u32>,
    /// Printed repeatability in height. It does not change the model; it documents the sheet.
    pub repeatability_um: Option<f64>,
    /// Printed linearity, ± percent of the measuring range. It does not change the model; it
    /// documents the sheet.
    pub linearity_percent: Option<f64>,
}

/// Laser class.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema)]
pub enum LaserClass {
    #[serde(rename = "1")]
    C1,
    #[serde(rename = "1M")]
    C1M,
    #[serde(rename = "2")]
    C2,
    #[serde(rename = "2M")]
    C2M,
    #[serde(rename = "3R")]
    C3R,
    #[serde(rename = "3B")]
    C3B,
    #[serde(rename = "4")]
    C4,
}

/// Origin of a value of a solved sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Origin {
    /// The value is in the data sheet.
    Given,
    /// The value is derived from the data sheet.
    Solved,
    /// The value is derived from the data sheet and from estimated quantities.
    Estimated,
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

/// A quantity that the data sheet does not contain.
#[derive(Debug, Clone, Serialize)]
pub struct SheetEstimate {
    /// Key in `[data_sheet]` that fixes the quantity.
    pub key: &'static str,
    /// Estimate.
    pub value: f64,
    /// Smallest and largest likely value.
    pub interval: [f64; 2],
    /// Quantities and assumptions on which the estimate is based.
    pub basis: String,
}

/// Values derived from a data sheet.
#[derive(Debug, Clone, Default, Serialize)]
pub struct SolvedSensor {
    /// Values of laser, camera and measuring field.
    pub values: Vec<SolvedValue>,
    /// Estimated quantities.
    pub estimates: Vec<SheetEstimate>,
}

/// Contradiction in a data sheet: the key and the expected value.
pub type InconsistentValue = (&'static str, String);

/// Fraction of the sensor rows that the range fills, if the data sheet does not determine the
/// angle.
const FILLED: f64 = 0.95;
/// Default of the pixel pitch (µm) and the pitches of common area sensors with a global shutter.
const PITCH_UM: (f64, [f64; 2]) = (5.5, [3.4, 8.0]);
/// Default of the f-number, and its common values.
const F_NUMBER: (f64, [f64; 2]) = (5.6, [2.8, 11.0]);
/// Default of the triangulation angle (degrees), and its common values.
const ANGLE_DEG: (f64, [f64; 2]) = (25.0, [15.0, 45.0]);
/// Default of the number of columns, and its common values.
const COLUMNS: (u32, [f64; 2]) = (1280, [640.0, 4096.0]);
/// Assumed height resolution, px, with its likely values. Common peak detectors return the row in
/// units of 1/16 px.
const RESOLUTION_PX: (f64, [f64; 2]) = (1.0 / 16.0, [1.0 / 32.0, 1.0 / 8.0]);
/// Greatest relative difference of two printed values of one length.
const AGREE: f64 = 0.01;

/// Measuring range as distances from the laser's exit, mm.
#[derive(Debug, Clone, Copy)]
struct RangeDistances {
    near: f64,
    range: f64,
    reference: f64,
}

impl RangeDistances {
    fn far(&self) -> f64 {
        self.near + self.range
    }

    /// Returns the height above the centre of the range of a distance from the exit.
    fn height(&self, distance: f64) -> f64 {
        self.near + self.range / 2.0 - distance
    }
}

/// Printed field of view: its key, distance from the exit and width, mm.
type PrintedField = (&'static str, f64, f64);

impl DataSheet {
    /// Returns all values of laser and camera. Returns an error if the data sheet contradicts
    /// itself or contains too little.
    pub fn solve(&self) -> Result<SolvedSensor, InconsistentValue> {
        self.check()?;
        let mut estimates = Vec::new();
        let range = self.range(&mut estimates)?;
        let fields = self.fields(&range);
        let mut geometry = self.geometry(&range, &fields)?;
        let (pitch, angle) =
            self.pitch_and_angle(&mut geometry, &range, &fields, &mut estimates)?;
        let optics = self.optics(&geometry, angle, pitch)?;
        let rows = self.rows_for(&geometry, &optics, (angle, pitch))?;
        self.lens_estimates(&geometry, (angle, pitch), (&optics, rows), &mut estimates);
        let field = field_polygon(&range, &fields, &optics, angle);
        let mut values = self.laser(&range, &field, &mut estimates);
        let origin = match estimates.iter().any(|estimate| estimate.key != "power_mw") {
            true => Origin::Estimated,
            false => Origin::Solved,
        };
        values.extend(self.camera(&geometry, (&optics, pitch, rows), origin));
        let nodes: Vec<String> = field
            .iter()
            .map(|[distance, width]| format!("[{}, {}]", number(*distance), number(*width)))
            .collect();
        values.push(SolvedValue {
            key: "field_of_view_mm",
            value: format!("[{}]", nodes.join(", ")),
            origin: match fields.len() {
                0 => origin,
                _ => Origin::Solved,
            },
        });
        Ok(SolvedSensor { values, estimates })
    }

    /// Returns the values of the laser for the nodes of the measuring field.
    fn laser(
        &self,
        range: &RangeDistances,
        field: &[[f64; 2]],
        estimates: &mut Vec<SheetEstimate>,
    ) -> Vec<SolvedValue> {
        use Origin::{Assumed, Given, Solved};
        let or = |given: bool| if given { Given } else { Assumed };
        let wavelength = self.wavelength_nm.unwrap_or(660.0);
        // The width at the ends of the range is smallest for a Rayleigh length of half the range.
        let least = (wavelength * 1e-6 * range.range / 2.0 / std::f64::consts::PI).sqrt() * 1e3;
        let waist = self.line_width_um.map_or(least, |width| width / 2.0);
        let slopes = field.iter().map(|[distance, width]| width / 2.0 / distance);
        let fan = slopes.fold(0.0, f64::max);
        let power = match (self.power_mw, self.laser_class) {
            (Some(power), _) => power,
            (None, None) => 10.0,
            (None, Some(class)) => {
                let estimate = class.power(200.0 * fan);
                let value = estimate.value;
                estimates.push(estimate);
                value
            }
        };
        let exit = range.near + range.range / 2.0;
        let value = |key, value: String, origin| SolvedValue { key, value, origin };
        vec![
            value(
                "laser.wavelength_nm",
                number(wavelength),
                or(self.wavelength_nm.is_some()),
            ),
            value("laser.power_mw", number(power), or(self.power_mw.is_some())),
            value(
                "laser.waist_radius_um",
                number(waist),
                or(self.line_width_um.is_some()),
            ),
            value("laser.waist_distance_mm", number(range.reference), Assumed),
            value("laser.position_mm", list([0.0, 0.0, exit]), Given),
            value("laser.direction", list([0.0, 0.0, -1.0]), Given),
            value(
                "laser.line.fan_deg",
                number(2.0 * fan.atan().to_degrees()),
                Solved,
            ),
            value("laser.line.profile", "\"uniform\"".to_owned(), Assumed),
            value("laser.line.direction", list([1.0, 0.0, 0.0]), Given),
        ]
    }

    /// Returns the values of the camera. `geometric` is the origin of values that depend on angle,
    /// pixel pitch and columns.
    fn camera(
        &self,
        geometry: &CameraGeometry,
        (optics, pitch, rows): (&CameraOptics, f64, u32),
        geometric: Origin,
    ) -> Vec<SolvedValue> {
        use Origin::{Assumed, Given, Solved};
        let or = |given: bool, other| if given { Given } else { other };
        let wavelength = self.wavelength_nm.unwrap_or(660.0);
        let [baseline, height] = optics.pupil;
        let pitch_from_lens = self.focal_length_mm.is_some();
        let rate = self.profile_rate_hz.map(|rate| rate.least());
        let values = [
            (
                "camera.focal_length_mm",
                number(optics.focal_length),
                or(self.focal_length_mm.is_some(), geometric),
            ),
            (
                "camera.f_number",
                number(self.f_number.unwrap_or(F_NUMBER.0)),
                or(self.f_number.is_some(), Assumed),
            ),
            ("camera.focus", "\"laser-plane\"".to_owned(), Solved),
            (
                "camera.resolution_px",
                format!("[{}, {rows}]", geometry.columns),
                or(self.rows.is_some(), geometric),
            ),
            (
                "camera.pixel_pitch_um",
                number(pitch * 1e3),
                or(
                    self.pixel_pitch_um.is_some(),
                    if pitch_from_lens { geometric } else { Assumed },
                ),
            ),
            (
                "camera.position_mm",
                list([0.0, -baseline, height]),
                geometric,
            ),
            ("camera.look_at_mm", list([0.0, 0.0, optics.aim]), geometric),
            ("camera.column_axis", list([1.0, 0.0, 0.0]), Given),
            ("camera.exposure", "\"auto\"".to_owned(), Assumed),
            (
                "camera.quantum_efficiency",
                number(if wavelength < 500.0 { 0.4 } else { 0.5 }),
                Assumed,
            ),
            // The full well corresponds to full scale.
            ("camera.full_well_e", number(10_000.0), Assumed),
            ("camera.gain_dn_per_e", number(0.1), Assumed),
            ("camera.bit_depth", "10".to_owned(), Assumed),
            ("camera.black_level_dn", number(8.0), Assumed),
            ("camera.read_noise_e", number(10.0), Assumed),
        ];
        let rate = rate.map(|rate| ("camera.max_full_frame_rate_hz", number(rate), Given));
        let values = values.into_iter().chain(rate);
        values
            .map(|(key, value, origin)| SolvedValue { key, value, origin })
            .collect()
    }

    fn check(&self) -> Result<(), InconsistentValue> {
        let ends = |range: Option<PrintedRange>| {
            range.map_or([None, None], |range| [Some(range.first), Some(range.last)])
        };
        let [from, to] = ends(self.range_from_to_mm);
        let [x_near, x_far] = ends(self.x_interval_um);
        let [z_near, z_far] = ends(self.z_resolution_um);
        let [slow, fast] = ends(self.profile_rate_hz);
        let numbers = [
            ("data_sheet.stand_off_mm", self.stand_off_mm),
            (
                "data_sheet.reference_distance_mm",
                self.reference_distance_mm,
            ),
            ("data_sheet.measuring_range_mm", self.measuring_range_mm),
            ("data_sheet.half_range_mm", self.half_range_mm),
            ("data_sheet.range_from_to_mm", from),
            ("data_sheet.range_from_to_mm", to),
            ("data_sheet.field_near_mm", self.field_near_mm),
            ("data_sheet.field_reference_mm", self.field_reference_mm),
            ("data_sheet.field_far_mm", self.field_far_mm),
            ("data_sheet.x_interval_um", x_near),
            ("data_sheet.x_interval_um", x_far),
            ("data_sheet.z_resolution_um", z_near),
            ("data_sheet.z_resolution_um", z_far),
            ("data_sheet.profile_rate_hz", slow),
            ("data_sheet.profile_rate_hz", fast),
            ("data_sheet.baseline_mm", self.baseline_mm),
            ("data_sheet.focal_length_mm", self.focal_length_mm),
            ("data_sheet.pixel_pitch_um", self.pixel_pitch_um),
            ("data_sheet.line_width_um", self.line_width_um),
            ("data_sheet.wavelength_nm", self.wavelength_nm),
            ("data_sheet.repeatability_um", self.repeatability_um),
            ("data_sheet.linearity_percent", self.linearity_percent),
        ];
        for (key, number) in numbers {
            if !number.is_none_or(|number| (1e-3..=1e6).contains(&number)) {
                return Err((key, "a number from 1e-3 to 1e6".to_owned()));
            }
        }
        let pixels = [
            ("data_sheet.points_per_profile", self.points_per_profile),
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
        if let Some(range) = self.range_from_to_mm
            && range.first >= range.last
        {
            let expected = "a list of the near end and the far end, which is the larger distance";
            return Err(("data_sheet.range_from_to_mm", expected.to_owned()));
        }
        Ok(())
    }

    /// Returns the near end that follows from the reference position and the range.
    fn near_of_reference(
        &self,
        range: Option<(&'static str, f64)>,
    ) -> Result<Option<(&'static str, f64)>, InconsistentValue> {
        let (Some(reference), Some((key, range))) = (self.reference_distance_mm, range) else {
            return Ok(None);
        };
        if reference <= range / 2.0 {
            let expected = format!(
                "more than {}: half the range, {key} = {}, is in front of the reference position",
                range / 2.0,
                self.printed(key)
            );
            return Err(("data_sheet.reference_distance_mm", expected));
        }
        Ok(Some(("reference_distance_mm", reference - range / 2.0)))
    }

    /// Returns the measuring range. A missing range or stand-off is estimated from the fields of
    /// view for a lens next to the laser's exit.
    fn range(
        &self,
        estimates: &mut Vec<SheetEstimate>,
    ) -> Result<RangeDistances, InconsistentValue> {
        let from_to = self.range_from_to_mm;
        let range = consistent_value([
            ("measuring_range_mm", self.measuring_range_mm, 1.0),
            ("half_range_mm", self.half_range_mm, 2.0),
            ("range_from_to_mm", from_to.map(|r| r.last - r.first), 1.0),
        ])?;
        let near = consistent_value([
            ("stand_off_mm", self.stand_off_mm, 1.0),
            ("range_from_to_mm", from_to.map(|r| r.first), 1.0),
            ("", None, 1.0),
        ])?;
        let near = match near {
            Some(near) => Some(near),
            None => self.near_of_reference(range)?,
        };
        let growing = match (self.field_near_mm, self.field_far_mm) {
            (Some(near), Some(far)) if near < far => Some(far / near - 1.0),
            _ => None,
        };
        let basis = "the fields of view, for a lens at the height of the laser's exit";
        let mut estimate = |key, value: f64| {
            estimates.push(SheetEstimate {
                key,
                value,
                interval: [value / 2.0, value * 2.0],
                basis: basis.to_owned(),
            });
            value
        };
        let (near, range) = match (near, range, growing) {
            (Some((_, near)), Some((_, range)), _) => (near, range),
            (Some((_, near)), None, Some(growth)) => {
                (near, estimate("measuring_range_mm", near * growth))
            }
            (None, Some((_, range)), Some(growth)) => {
                (estimate("stand_off_mm", range / growth), range)
            }
            (None, None, Some(growth)) if self.reference_distance_mm.is_some() => {
                let reference = self.reference_distance_mm.unwrap_or_default();
                let near = reference / (1.0 + growth / 2.0);
                (near, estimate("measuring_range_mm", near * growth))
            }
            (None, ..) => {
                let expected = "the distance of the range: stand_off_mm, reference_distance_mm or range_from_to_mm";
                return Err(("data_sheet", expected.to_owned()));
            }
            (_, None, _) => {
                let expected = "the height of the range: measuring_range_mm, half_range_mm or range_from_to_mm";
                return Err(("data_sheet", expected.to_owned()));
            }
        };
        let reference = self.reference_distance_mm.unwrap_or(near + range / 2.0);
        let tolerance = AGREE * range;
        if reference < near - tolerance || reference > near + range + tolerance {
            let expected = format!(
                "a distance within the measuring range, from {near} to {}",
                near + range
            );
            return Err(("data_sheet.reference_distance_mm", expected));
        }
        Ok(RangeDistances {
            near,
            range,
            reference: reference.clamp(near, near + range),
        })
    }

    /// Returns a printed length in mm for messages.
    fn printed(&self, key: &str) -> f64 {
        let value = match key {
            "half_range_mm" => self.half_range_mm,
            "range_from_to_mm" => self.range_from_to_mm.map(|range| range.last - range.first),
            _ => self.measuring_range_mm,
        };
        value.unwrap_or_default()
    }

    fn fields(&self, range: &RangeDistances) -> Vec<PrintedField> {
        let fields = [
            ("field_near_mm", range.near, self.field_near_mm),
            (
                "field_reference_mm",
                range.reference,
                self.field_reference_mm,
            ),
            ("field_far_mm", range.far(), self.field_far_mm),
        ];
        let printed = fields.into_iter();
        printed
            .filter_map(|(key, distance, width)| Some((key, distance, width?)))
            .collect()
    }

    /// Returns the requirements on the camera.
    fn geometry(
        &self,
        range: &RangeDistances,
        fields: &[PrintedField],
    ) -> Result<CameraGeometry, InconsistentValue> {
        let mut seen: Vec<[f64; 2]> = fields
            .iter()
            .map(|&(_, distance, width)| [range.height(distance), width])
            .collect();
        let mut ends = [self.field_near_mm, self.field_far_mm];
        if let (Some(points), Some(interval)) = (self.points_per_profile, self.x_interval_um) {
            let positions = match interval.is_single() {
                true => vec![(range.reference, interval.first)],
                false => vec![(range.near, interval.first), (range.far(), interval.last)],
            };
            for (distance, interval) in positions {
                let width = f64::from(points) * interval * 1e-3;
                let least = width_at(fields, distance);
                if let Some((key, least)) = &least {
                    let most = f64::from(points) * (interval + rounding(interval)) * 1e-3;
                    if most < least - rounding(*least) {
                        let expected = format!(
                            "at least {:.4}, with which points_per_profile = {points} cover {key}",
                            least * 1e3 / f64::from(points)
                        );
                        return Err(("data_sheet.x_interval_um", expected));
                    }
                }
                let width = width.max(least.map_or(0.0, |(_, width)| width));
                seen.push([range.height(distance), width]);
                if distance == range.near {
                    ends[0] = Some(width);
                } else if distance == range.far() {
                    ends[1] = Some(width);
                }
            }
        }
        if seen.is_empty() {
            let expected = "a width of the field: field_near_mm, field_reference_mm or field_far_mm, or \
                            points_per_profile with x_interval_um";
            return Err(("data_sheet", expected.to_owned()));
        }
        let widest = seen
            .iter()
            .fold(0.0, |widest: f64, [_, width]| widest.max(*width));
        let columns = match (self.points_per_profile, self.x_interval_um) {
            (Some(points), _) => points,
            (None, None) => COLUMNS.0,
            (None, Some(interval)) => {
                let widths = [(range.near, interval.first), (range.far(), interval.last)];
                let columns = widths.map(|(distance, interval)| {
                    let width = width_at(fields, distance).map_or(widest, |(_, width)| width);
                    width * 1e3 / interval
                });
                columns_of("data_sheet.x_interval_um", columns[0].max(columns[1]))?
            }
        };
        Ok(CameraGeometry {
            exit: range.near + range.range / 2.0,
            half_range: range.range / 2.0,
            columns,
            fields: seen,
            ends: match ends {
                [Some(near), Some(far)] => Some([near, far]),
                _ => None,
            },
            distance: match (self.triangulation_deg, self.baseline_mm) {
                (Some(angle), Some(baseline)) => Some(baseline / angle.to_radians().sin()),
                _ => None,
            },
            focal_length: self.focal_length_mm,
        })
    }

    /// Returns pixel pitch (mm) and triangulation angle (rad). If only the interval of the points
    /// is printed, the number of columns is set for this interval at the reference position.
    fn pitch_and_angle(
        &self,
        geometry: &mut CameraGeometry,
        range: &RangeDistances,
        fields: &[PrintedField],
        estimates: &mut Vec<SheetEstimate>,
    ) -> Result<(f64, f64), InconsistentValue> {
        let mut pitch = self.pixel_pitch_um.unwrap_or(PITCH_UM.0) * 1e-3;
        if self.pixel_pitch_um.is_none()
            && let Some(focal) = self.focal_length_mm
        {
            pitch = self.pitch_of(geometry, focal)?;
        }
        let mut angle = self.angle(geometry, pitch)?;
        match (self.points_per_profile, self.x_interval_um) {
            (None, Some(interval)) => {
                if interval.is_single() {
                    // The width depends on the columns by the focal length in Z − f only.
                    for _ in 0..4 {
                        let optics = self.optics(geometry, angle.radians, pitch)?;
                        let width = optics.width_at(angle.radians, range.height(range.reference));
                        let columns = width * 1e3 / interval.first;
                        geometry.columns = columns_of("data_sheet.x_interval_um", columns)?;
                        angle = self.angle(geometry, pitch)?;
                    }
                }
                let widest = fields
                    .iter()
                    .fold(0.0, |most: f64, field| most.max(field.2));
                let columns = f64::from(geometry.columns);
                let most = (widest * 1e3 / interval.least()).ceil().max(columns);
                estimates.push(SheetEstimate {
                    key: "points_per_profile",
                    value: columns,
                    interval: [columns, most],
                    basis: "x_interval_um and the fields of view".to_owned(),
                });
            }
            (None, None) => estimates.push(SheetEstimate {
                key: "points_per_profile",
                value: COLUMNS.0.into(),
                interval: COLUMNS.1,
                basis: "common sensors".to_owned(),
            }),
            (Some(_), _) => {}
        }
        if let Some(basis) = angle.estimated_from {
            let key = "triangulation_deg";
            estimates.push(SheetEstimate {
                key,
                value: angle.radians.to_degrees(),
                interval: angle.interval.map(f64::to_degrees),
                basis,
            });
        }
        Ok((pitch, angle.radians))
    }

    /// Returns the pixel pitch (mm) with which a lens of this focal length sees the fields.
    fn pitch_of(&self, geometry: &CameraGeometry, focal: f64) -> Result<f64, InconsistentValue> {
        let free = CameraGeometry {
            focal_length: None,
            ..geometry.clone()
        };
        let at = |pitch: f64| {
            let angle = self.angle(&free, pitch).ok()?;
            Some(free.optics(angle.radians, pitch)?.focal_length)
        };
        const PITCHES_MM: [f64; 2] = [0.2e-3, 0.2];
        let excess = |log: f64| at(log.exp()).map_or(f64::NAN, |found| found - focal);
        root(PITCHES_MM.map(f64::ln), excess)
            .map(f64::exp)
            .ok_or_else(|| {
                let [least, most] = PITCHES_MM.map(|pitch| at(pitch).unwrap_or(f64::NAN));
                let expected = format!(
                    "from {least:.3} to {most:.3}, with which pixels of 0.2 to 200 µm see the fields of view"
                );
                ("data_sheet.focal_length_mm", expected)
            })
    }

    /// Returns the optics. Returns an error if a given focal length is too long for the fields.
    fn optics(
        &self,
        geometry: &CameraGeometry,
        angle: f64,
        pitch: f64,
    ) -> Result<CameraOptics, InconsistentValue> {
        let optics = geometry.optics(angle, pitch).ok_or_else(|| {
            let key = match (self.triangulation_deg, self.baseline_mm) {
                (Some(_), _) => "data_sheet.triangulation_deg",
                (None, Some(_)) => "data_sheet.baseline_mm",
                (None, None) => "data_sheet",
            };
            let expected = format!(
                "a lens in front of which the range of {} mm lies: here the triangulation angle is {:.1}°",
                2.0 * geometry.half_range,
                angle.to_degrees()
            );
            (key, expected)
        })?;
        if let Some(given) = self.focal_length_mm
            && optics.focal_length < given * (1.0 - 1e-6)
        {
            let widths = geometry.fields.iter().map(|[_, width]| width.to_string());
            let expected = format!(
                "at most {:.3}, with which {} columns of {} µm see fields of {} mm",
                optics.focal_length,
                geometry.columns,
                number(pitch * 1e3),
                widths.collect::<Vec<_>>().join(" and ")
            );
            return Err(("data_sheet.focal_length_mm", expected));
        }
        Ok(optics)
    }

    /// Returns the triangulation angle.
    fn angle(
        &self,
        geometry: &CameraGeometry,
        pitch: f64,
    ) -> Result<SheetAngle, InconsistentValue> {
        let given = |radians| SheetAngle {
            radians,
            interval: [radians; 2],
            estimated_from: None,
        };
        match (self.triangulation_deg, self.baseline_mm, self.rows) {
            (Some(angle), baseline, _) => {
                let least = geometry.exit * angle.to_radians().tan();
                if let Some(baseline) = baseline
                    && baseline < least * (1.0 - AGREE)
                {
                    let expected = format!(
                        "at least {least:.2}: with triangulation_deg = {angle} and a smaller baseline the lens is in \
                         front of the laser's exit"
                    );
                    return Err(("data_sheet.baseline_mm", expected));
                }
                Ok(given(angle.to_radians()))
            }
            (None, Some(baseline), _) => geometry
                .angle_where(pitch, baseline, |optics| optics.pupil[0])
                .map(given)
                .map_err(|[least, most]| {
                    let expected = format!(
                        "from {least:.2} to {most:.2}, which are triangulation angles up to {STEEPEST}°"
                    );
                    ("data_sheet.baseline_mm", expected)
                }),
            (None, None, Some(rows)) => {
                let filled = |optics: &CameraOptics| optics.extent / pitch / FILLED;
                geometry
                    .angle_where(pitch, rows.into(), filled)
                    .map(given)
                    .map_err(|[least, most]| {
                        let expected = format!(
                            "from {least:.0} to {most:.0} rows, which the range of {} mm fills",
                            2.0 * geometry.half_range
                        );
                        ("data_sheet.rows", expected)
                    })
            }
            (None, None, None) => Ok(self.estimated_angle(geometry, pitch)),
        }
    }

    /// Returns the angle at which the printed height resolution is the assumed fraction of a pixel.
    /// The angle is within the common values. Without a printed resolution, it is a common value.
    fn estimated_angle(&self, geometry: &CameraGeometry, pitch: f64) -> SheetAngle {
        let [least, most] = ANGLE_DEG.1.map(f64::to_radians);
        let Some(resolution) = self.z_resolution_um else {
            return SheetAngle {
                radians: ANGLE_DEG.0.to_radians(),
                interval: [least, most],
                estimated_from: Some("common sensors".to_owned()),
            };
        };
        let resolution = (resolution.first * resolution.last).sqrt() * 1e-3;
        let [least, most] =
            [ANGLE_FROM_RESOLUTION_DEG[0], ANGLE_FROM_RESOLUTION_DEG[1]].map(f64::to_radians);
        let rows = |angle: f64| {
            let optics = geometry.optics(angle, pitch);
            optics.map_or(f64::NAN, |optics| optics.extent / pitch)
        };
        let at = |fraction: f64| {
            let wanted = 2.0 * geometry.half_range * fraction / resolution;
            let found = root([least, most], |angle| rows(angle) - wanted);
            found.unwrap_or(if rows(least) >= wanted { least } else { most })
        };
        let (fraction, interval) = RESOLUTION_PX;
        SheetAngle {
            radians: at(fraction),
            interval: interval.map(at),
            estimated_from: Some(
                "z_resolution_um, for a resolution of 1/16 px (1/32 to 1/8)".to_owned(),
            ),
        }
    }

    /// Returns the number of sensor rows. Returns an error if the sensor has too few.
    fn rows_for(
        &self,
        geometry: &CameraGeometry,
        optics: &CameraOptics,
        (angle, pitch): (f64, f64),
    ) -> Result<u32, InconsistentValue> {
        let needed = optics.extent / pitch;
        match self.rows {
            Some(rows) if needed > f64::from(rows) => {
                let expected = format!(
                    "at least {needed:.0}, which the measuring range of {} mm takes at a triangulation angle of {:.2}°",
                    2.0 * geometry.half_range,
                    angle.to_degrees()
                );
                Err(("data_sheet.rows", expected))
            }
            Some(rows) => Ok(rows),
            None => match all_rows(needed) {
                rows if rows <= 65_536.0 => Ok(rows as u32),
                rows => {
                    let key = match (self.triangulation_deg, self.baseline_mm) {
                        (Some(_), _) => "data_sheet.triangulation_deg",
                        (None, Some(_)) => "data_sheet.baseline_mm",
                        (None, None) => "data_sheet",
                    };
                    let expected =
                        format!("a range that fills at most 65536 rows; it fills {rows:.0}");
                    Err((key, expected))
                }
            },
        }
    }

    /// Adds the estimates of the quantities that depend on the angle and the pixel pitch. Their
    /// intervals are the values at the ends of the intervals of both.
    fn lens_estimates(
        &self,
        geometry: &CameraGeometry,
        (angle, pitch): (f64, f64),
        (optics, rows): (&CameraOptics, u32),
        estimates: &mut Vec<SheetEstimate>,
    ) {
        let of_angle = estimates.iter().find(|e| e.key == "triangulation_deg");
        let angles = of_angle.map_or([angle; 2], |e| e.interval.map(f64::to_radians));
        let estimated = of_angle.is_some();
        let pitch_given = self.pixel_pitch_um.is_some() || self.focal_length_mm.is_some();
        let pitches = match pitch_given {
            true => [pitch; 2],
            false => PITCH_UM.1.map(|um| um * 1e-3),
        };
        let corners =
            angles.map(|angle| pitches.map(|pitch| (geometry.optics(angle, pitch), pitch)));
        let interval = |value: f64, of: &dyn Fn(&CameraOptics, f64) -> f64| {
            let all = corners.iter().flatten();
            let all = all.filter_map(|(optics, pitch)| Some(of(optics.as_ref()?, *pitch)));
            all.fold([value; 2], |[least, most], value| {
                [least.min(value), most.max(value)]
            })
        };
        let mut add = |key, value, interval, basis: &str| {
            estimates.push(SheetEstimate {
                key,
                value,
                interval,
                basis: basis.to_owned(),
            });
        };
        let from_angle = "the triangulation angle and the measuring field";
        let baseline = optics.pupil[0];
        if estimated {
            let interval = interval(baseline, &|optics, _| optics.pupil[0]);
            add("baseline_mm", baseline, interval, from_angle);
        }
        if !pitch_given {
            add("pixel_pitch_um", PITCH_UM.0, PITCH_UM.1, "common sensors");
        }
        if self.focal_length_mm.is_none() && (estimated || !pitch_given) {
            let focal = optics.focal_length;
            let interval = interval(focal, &|optics, _| optics.focal_length);
            let basis = "the measuring field and the pixel pitch";
            add("focal_length_mm", focal, interval, basis);
        }
        if self.rows.is_none() && estimated {
            let rows_of = |optics: &CameraOptics, pitch| all_rows(optics.extent / pitch);
            let interval = interval(rows.into(), &rows_of);
            add("rows", rows.into(), interval, from_angle);
        }
        if self.f_number.is_none() {
            add("f_number", F_NUMBER.0, F_NUMBER.1, "common lenses");
        }
    }
}

/// Triangulation angles (degrees) that are estimated from a height resolution.
const ANGLE_FROM_RESOLUTION_DEG: [f64; 2] = [5.0, 60.0];

/// Triangulation angle of a data sheet.
struct SheetAngle {
    radians: f64,
    /// Smallest and largest likely value, rad.
    interval: [f64; 2],
    /// Basis of an estimate.
    estimated_from: Option<String>,
}

impl LaserClass {
    /// Returns the estimated power of a visible line laser whose line is `length` mm long at a
    /// distance of 100 mm.
    ///
    /// The accessible emission limit of IEC 60825-1 applies to the power through an aperture of
    /// 7 mm at this distance: 0.39 mW (class 1), 1 mW (class 2), 5 mW (class 3R), 500 mW
    /// (class 3B). A longer line may have more power in proportion to its length. Five sheets with
    /// a printed power of class 2 and 2M have 0.6 to 3.3 times this limit.
    fn power(self, length: f64) -> SheetEstimate {
        let through_aperture = (length / 7.0).max(1.0);
        let of_limit = |limit: f64| {
            let most = limit * through_aperture;
            (most, [most / 4.0, most * 4.0])
        };
        let (value, interval) = match self {
            LaserClass::C1 | LaserClass::C1M => of_limit(0.39),
            LaserClass::C2 | LaserClass::C2M => of_limit(1.0),
            LaserClass::C3R => of_limit(5.0),
            LaserClass::C3B => (50.0, [5.0, 500.0]),
            LaserClass::C4 => (500.0, [500.0, 5000.0]),
        };
        SheetEstimate {
            key: "power_mw",
            value,
            interval,
            basis: "laser_class and the length of the line".to_owned(),
        }
    }
}

/// Returns the first given value, multiplied by its factor, with its key. Returns an error if
/// another given value differs.
fn consistent_value(
    values: [(&'static str, Option<f64>, f64); 3],
) -> Result<Option<(&'static str, f64)>, InconsistentValue> {
    let mut given = values
        .into_iter()
        .filter_map(|(key, value, factor)| Some((key, value? * factor, factor)));
    let Some((first, value, first_factor)) = given.next() else {
        return Ok(None);
    };
    for (key, other, factor) in given {
        if (other / value - 1.0).abs() >= AGREE {
            let expected = format!(
                "{}, which follows from {first} = {}, or only one of the two",
                value / factor,
                value / first_factor
            );
            let key = match key {
                "half_range_mm" => "data_sheet.half_range_mm",
                _ => "data_sheet.range_from_to_mm",
            };
            return Err((key, expected));
        }
    }
    Ok(Some((first, value)))
}

/// Returns the printed width at a distance, and the description of the keys from which it follows.
/// Between two fields of view the width is interpolated.
fn width_at(fields: &[PrintedField], distance: f64) -> Option<(String, f64)> {
    if let Some((key, _, width)) = fields.iter().find(|field| field.1 == distance) {
        return Some((format!("{key} = {width}"), *width));
    }
    let pair = fields
        .windows(2)
        .find(|pair| pair[0].1 < distance && distance < pair[1].1)?;
    let [near, far] = [pair[0], pair[1]];
    let fraction = (distance - near.1) / (far.1 - near.1);
    let keys = format!("{} = {} and {} = {}", near.0, near.2, far.0, far.2);
    Some((keys, near.2 + (far.2 - near.2) * fraction))
}

/// Returns the nodes of the measuring field: distances from the laser's exit and widths, mm. An end
/// without a printed width has the width that the camera sees.
fn field_polygon(
    range: &RangeDistances,
    fields: &[PrintedField],
    optics: &CameraOptics,
    angle: f64,
) -> Vec<[f64; 2]> {
    let seen = |distance: f64| optics.width_at(angle, range.height(distance));
    let mut nodes: Vec<[f64; 2]> = fields
        .iter()
        .map(|&(_, distance, width)| [distance, width])
        .collect();
    for end in [range.near, range.far()] {
        if nodes.iter().all(|[distance, _]| *distance != end) {
            nodes.push([end, seen(end)]);
        }
    }
    nodes.sort_by(|a, b| a[0].total_cmp(&b[0]));
    nodes.dedup_by(|b, a| b[0] == a[0]);
    nodes
}

/// Returns a number of columns that follows from a key.
fn columns_of(key: &'static str, columns: f64) -> Result<u32, InconsistentValue> {
    let columns = columns.round();
    match (8.0..=65_536.0).contains(&columns) {
        true => Ok(columns as u32),
        false => {
            let expected = format!(
                "an interval with 8 to 65536 points over the field of view; it has {columns:.0}"
            );
            Err((key, expected))
        }
    }
}

/// Returns the number of rows of a sensor whose rows the range fills.
fn all_rows(needed: f64) -> f64 {
    // Sensors usually have a multiple of eight rows.
    (needed / FILLED / 8.0).ceil() * 8.0
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
            stand_off_mm: Some(160.0),
            measuring_range_mm: Some(90.0),
            field_near_mm: Some(82.0),
            field_far_mm: Some(118.0),
            points_per_profile: Some(1280),
            triangulation_deg: Some(25.0),
            ..DataSheet::default()
        }
    }

    fn parts(sheet: &DataSheet) -> (CameraGeometry, SheetAngle) {
        let range = sheet.range(&mut Vec::new()).unwrap();
        let geometry = sheet.geometry(&range, &sheet.fields(&range)).unwrap();
        let angle = sheet.angle(&geometry, 5.5e-3).unwrap();
        (geometry, angle)
    }

    fn refused(sheet: &DataSheet) -> String {
        let (key, expected) = sheet.solve().unwrap_err();
        format!("{key}: {expected}")
    }

    #[test]
    fn the_baseline_that_follows_gives_the_angle_back() {
        let (geometry, _) = parts(&sheet());
        let optics = geometry.optics(25f64.to_radians(), 5.5e-3).unwrap();
        let by_baseline = DataSheet {
            triangulation_deg: None,
            baseline_mm: Some(optics.pupil[0]),
            ..sheet()
        };
        let (_, angle) = parts(&by_baseline);
        let found = angle.radians.to_degrees();
        assert!((found - 25.0).abs() < 1e-9, "{found}");
    }

    #[test]
    fn rows_alone_are_filled_by_the_range() {
        let by_rows = DataSheet {
            triangulation_deg: None,
            rows: Some(512),
            ..sheet()
        };
        let (geometry, angle) = parts(&by_rows);
        let optics = geometry.optics(angle.radians, 5.5e-3).unwrap();
        let filled = optics.extent / 5.5e-3 / 512.0;
        assert!((filled - FILLED).abs() < 1e-9, "{filled}");
    }

    /// Fields that no lens behind the laser's exit sees exactly are within those that it sees.
    #[test]
    fn printed_fields_are_inside_the_cameras() {
        for [near, reference, far] in [[8.0, 14.0, 8.0], [16.0; 3], [82.0, 100.0, 118.0]] {
            for angle in [3.0, 25.0, 60.0] {
                let sheet = DataSheet {
                    field_near_mm: Some(near),
                    field_reference_mm: Some(reference),
                    field_far_mm: Some(far),
                    stand_off_mm: Some(47.0),
                    measuring_range_mm: Some(15.2),
                    triangulation_deg: Some(angle),
                    ..DataSheet::default()
                };
                let (geometry, _) = parts(&sheet);
                let angle = angle.to_radians();
                let optics = geometry.optics(angle, 5.5e-3).unwrap();
                for [z, width] in &geometry.fields {
                    let seen = optics.width_at(angle, *z);
                    assert!(seen >= width * (1.0 - 1e-9), "{seen} {width}");
                }
                assert!(optics.pupil[1] >= geometry.exit * (1.0 - 1e-9));
            }
        }
    }

    #[test]
    fn an_estimate_is_inside_its_interval() {
        let sheet = DataSheet {
            triangulation_deg: None,
            x_interval_um: Some(PrintedRange {
                first: 66.0,
                last: 95.0,
            }),
            z_resolution_um: Some(PrintedRange {
                first: 9.0,
                last: 16.0,
            }),
            ..sheet()
        };
        let solved = sheet.solve().unwrap();
        let keys: Vec<&str> = solved.estimates.iter().map(|e| e.key).collect();
        for key in [
            "triangulation_deg",
            "baseline_mm",
            "pixel_pitch_um",
            "focal_length_mm",
            "rows",
            "f_number",
        ] {
            assert!(keys.contains(&key), "{keys:?}");
        }
        for SheetEstimate {
            key,
            value,
            interval: [least, most],
            ..
        } in solved.estimates
        {
            assert!(least <= value && value <= most && least < most, "{key}");
        }
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
        assert!(refused(&few).starts_with("data_sheet.rows: at least"));
        let narrow = DataSheet {
            x_interval_um: Some(PrintedRange {
                first: 50.0,
                last: 80.0,
            }),
            ..sheet()
        };
        let said = refused(&narrow);
        assert!(
            said.starts_with("data_sheet.x_interval_um")
                && said.contains("points_per_profile = 1280")
                && said.contains("field_near_mm = 82"),
            "{said}"
        );
        let twice = DataSheet {
            half_range_mm: Some(40.0),
            ..sheet()
        };
        let said = refused(&twice);
        assert!(
            said.starts_with("data_sheet.half_range_mm: 45") && said.contains("measuring_range_mm"),
            "{said}"
        );
        let in_front = DataSheet {
            stand_off_mm: None,
            reference_distance_mm: Some(40.0),
            ..sheet()
        };
        let said = refused(&in_front);
        assert!(
            said.starts_with("data_sheet.reference_distance_mm: more than 45")
                && said.contains("measuring_range_mm = 90"),
            "{said}"
        );
        let long = DataSheet {
            pixel_pitch_um: Some(5.5),
            focal_length_mm: Some(50.0),
            ..sheet()
        };
        assert!(refused(&long).starts_with("data_sheet.focal_length_mm: at most 15.8"));
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e7] {
            let bad = DataSheet {
                stand_off_mm: Some(bad),
                ..sheet()
            };
            assert!(refused(&bad).starts_with("data_sheet.stand_off_mm"));
        }
    }
}

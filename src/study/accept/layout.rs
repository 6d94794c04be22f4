//! Positions of the artefacts of an acceptance test in the measuring volume of a sensor.

use crate::math::{DMat3, DVec3, Rigid};
use crate::run::SensorFigures;
use crate::scene::AcceptTable;
use serde::Serialize;

/// Fraction of the measuring range and of the field of view that is the measuring volume. The
/// margin keeps the artefacts inside the range.
const INSIDE: f64 = 0.95;
/// Ratio of the plate's side to the side of the evaluated area.
pub const PLATE_MARGIN: f64 = 1.1;

/// Measuring volume as a box in the laser frame: x along the line, y perpendicular to it along the
/// scan, z along the beam.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Volume {
    /// Smallest and largest distance from the laser along the beam, mm.
    pub range_mm: [f64; 2],
    /// Ends along the line, mm; they are the ends of the field of view at the near end.
    pub width_mm: [f64; 2],
    /// Length along the scan, mm.
    pub travel_mm: f64,
}

/// Artefacts and counts of the test, with defaults resolved.
#[derive(Debug, Clone, Serialize)]
pub struct Artefacts {
    /// Diameter of the spheres, mm.
    pub sphere_diameter_mm: f64,
    /// Distance between the two sphere centres of a ball bar, mm.
    pub ball_bar_length_mm: f64,
    /// Side length of the plate, mm.
    pub plate_side_mm: f64,
    /// Tilt of the plate, degrees.
    pub plate_tilt_deg: f64,
    /// Half angle of the measured spherical cap, degrees.
    pub cap_half_angle_deg: f64,
    /// Number of profiles across a spherical cap and across a plate.
    pub profiles: u32,
    /// Number of heights over the measuring range.
    pub height_steps: u32,
    /// Number of measurements per height.
    pub repeats: u32,
    /// Percentage of the points that flatness excludes.
    pub excluded_percent: f64,
    /// Expanded uncertainty of the artefacts, which is the guard band, µm.
    pub artefact_expanded_uncertainty_um: f64,
}

/// Artefact at a position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Artefact {
    /// Sphere.
    Sphere,
    /// Plate that is scanned.
    Plate,
    /// Plate in front of a sensor at rest.
    Height,
}

/// Artefact with its pose and scan.
#[derive(Debug, Clone, Serialize)]
pub struct Placing {
    /// Name of the position.
    pub place: String,
    /// Artefact at the position.
    pub artefact: Artefact,
    /// Pose of the artefact frame, whose z axis points to the laser, in the laser frame at the
    /// midpoint of the scan.
    #[serde(skip)]
    pub laser_from_artefact: Rigid,
    /// Centre of the artefact in the laser frame, mm.
    pub middle_mm: [f64; 3],
    /// Number of frames of the scan.
    pub frames: u32,
    /// Displacement between frames along y, mm.
    pub step_mm: f64,
}

/// Value that does not fit the volume: key in `[accept]`, found value, and expected value.
pub type VolumeError = (&'static str, f64, String);

impl Volume {
    /// Returns the measuring volume of the sensor; `None` if it is empty.
    pub fn of(figures: &SensorFigures, table: &AcceptTable) -> Option<Volume> {
        let [near, far] = figures.ends();
        let cut = (1.0 - INSIDE) / 2.0 * (far - near);
        let range_mm = [near + cut, far - cut];
        let fields = figures.places.iter().map(|place| place.field_mm);
        let [left, right] = fields.reduce(|a, b| [a[0].max(b[0]), a[1].min(b[1])])?;
        let (middle, half) = ((left + right) / 2.0, INSIDE * (right - left) / 2.0);
        if !(half > 0.0 && far > near) {
            return None;
        }
        Some(Volume {
            range_mm,
            width_mm: [middle - half, middle + half],
            travel_mm: table.travel_mm.unwrap_or(2.0 * half),
        })
    }

    fn depth(&self) -> f64 {
        self.range_mm[1] - self.range_mm[0]
    }

    fn width(&self) -> f64 {
        self.width_mm[1] - self.width_mm[0]
    }

    /// Returns the centre and half sides of the box of possible sphere centres. The measured cap
    /// stays in the volume.
    fn centers(&self, sphere_diameter_mm: f64, cap: f64) -> [DVec3; 2] {
        let radius = sphere_diameter_mm / 2.0;
        let [near, far] = self.range_mm;
        let across = radius * cap.sin();
        let (first, last) = (near + radius, far + radius * cap.cos());
        let middle = DVec3::new(
            (self.width_mm[0] + self.width_mm[1]) / 2.0,
            0.0,
            (first + last) / 2.0,
        );
        let half = DVec3::new(
            self.width() / 2.0 - across,
            self.travel_mm / 2.0 - across,
            (last - first) / 2.0,
        );
        [middle, half]
    }
}

/// Ball bars: name, direction in half sides of the volume, and centre along the beam. Two bars are
/// along the line (near and far), one is along the scan, and four are diagonal.
const BARS: [(&str, [f64; 3], f64); 7] = [
    ("across, near", [1.0, 0.0, 0.0], -1.0),
    ("across, far", [1.0, 0.0, 0.0], 1.0),
    ("along the scan", [0.0, 1.0, 0.0], 0.0),
    ("level diagonal", [1.0, 1.0, 0.0], 0.0),
    ("rising across", [1.0, 0.0, -1.0], 0.0),
    ("falling across", [1.0, 0.0, 1.0], 0.0),
    ("space diagonal", [1.0, 1.0, 1.0], 0.0),
];

impl Artefacts {
    /// Resolves the artefacts. Returns an error for a value that does not fit the volume.
    pub fn of(volume: &Volume, table: &AcceptTable) -> Result<Artefacts, VolumeError> {
        let cap_half_angle_deg = table.cap_half_angle_deg.unwrap_or(45.0);
        let cap = cap_half_angle_deg.to_radians();
        let (depth, width) = (volume.depth(), volume.width());
        let across = width.min(volume.travel_mm);
        let diagonal = DVec3::new(width, volume.travel_mm, depth).length();
        let fits = |key, found: f64, most: f64, why: &str| match found <= most * (1.0 + 1e-9) {
            true => Ok(found),
            false => Err((key, found, format!("at most {most:.4}, {why}"))),
        };
        let of_volume = format!(
            "as the measuring volume is {width:.4} mm wide, {:.4} mm long and {depth:.4} mm deep",
            volume.travel_mm
        );
        let most_sphere = (2.0 * depth).min(across / 2.0);
        let sphere_diameter_mm = table
            .sphere_diameter_mm
            .unwrap_or((0.15 * diagonal).min(most_sphere / 2.0));
        fits(
            "accept.sphere_diameter_mm",
            sphere_diameter_mm,
            most_sphere,
            &of_volume,
        )?;
        let [_, half] = volume.centers(sphere_diameter_mm, cap);
        let most_spacing = 2.0 * half.x.min(half.y);
        let ball_bar_length_mm = table.ball_bar_length_mm.unwrap_or(0.9 * most_spacing);
        let of_spheres = format!("{of_volume} and the spheres have {sphere_diameter_mm:.4} mm");
        fits(
            "accept.ball_bar_length_mm",
            ball_bar_length_mm,
            most_spacing,
            &of_spheres,
        )?;
        if ball_bar_length_mm < sphere_diameter_mm {
            let expected =
                format!("at least {sphere_diameter_mm:.4}, the diameter of the two spheres");
            return Err(("accept.ball_bar_length_mm", ball_bar_length_mm, expected));
        }
        let plate_side_mm = table.plate_side_mm.unwrap_or(0.8 * across);
        fits("accept.plate_side_mm", plate_side_mm, across, &of_volume)?;
        let most_tilt = (0.9 * depth / plate_side_mm).min(1.0).asin().to_degrees();
        let plate_tilt_deg = table.plate_tilt_deg.unwrap_or(most_tilt.min(20.0));
        let of_plate = format!("{of_volume} and the plate has {plate_side_mm:.4} mm");
        fits(
            "accept.plate_tilt_deg",
            plate_tilt_deg,
            most_tilt,
            &of_plate,
        )?;
        Ok(Artefacts {
            sphere_diameter_mm,
            ball_bar_length_mm,
            plate_side_mm,
            plate_tilt_deg,
            cap_half_angle_deg,
            profiles: table.profiles.unwrap_or(25),
            height_steps: table.height_steps.unwrap_or(11),
            repeats: table.repeats.unwrap_or(10),
            excluded_percent: table.excluded_percent.unwrap_or(0.3),
            artefact_expanded_uncertainty_um: table.artefact_expanded_uncertainty_um.unwrap_or(1.0),
        })
    }

    /// Returns the half angle of the cap, rad.
    pub fn cap(&self) -> f64 {
        self.cap_half_angle_deg.to_radians()
    }

    /// Returns all positions: fourteen spheres, in pairs of a ball bar; five plates; and the
    /// heights.
    pub fn placings(&self, volume: &Volume) -> Vec<Placing> {
        let [near, far] = volume.range_mm;
        let depth = volume.depth();
        let center = DVec3::X * ((volume.width_mm[0] + volume.width_mm[1]) / 2.0);
        // A rotation of 180° about the line faces the artefact towards the laser.
        let facing = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let mut placings = Vec::new();
        let mut place =
            |place: String, artefact, middle: DVec3, turn: DMat3, along: f64, frames| {
                placings.push(Placing {
                    place,
                    artefact,
                    laser_from_artefact: Rigid {
                        rotation: facing * turn,
                        translation: middle,
                    },
                    middle_mm: middle.to_array(),
                    frames,
                    step_mm: along / f64::from((frames - 1).max(1)),
                });
            };
        let level = DMat3::IDENTITY;
        let [middle, half] = volume.centers(self.sphere_diameter_mm, self.cap());
        let cap_mm = self.sphere_diameter_mm * self.cap().sin();
        for (name, direction, along_beam) in BARS {
            let arm = (DVec3::from(direction) * half).normalize() * self.ball_bar_length_mm / 2.0;
            let middle = middle + DVec3::Z * along_beam * half.z;
            for (end, sign) in [("first", -1.0), ("second", 1.0)] {
                let name = format!("{name}, {end}");
                let at = middle + sign * arm;
                place(name, Artefact::Sphere, at, level, cap_mm, self.profiles);
            }
        }
        let tilt = self.plate_tilt_deg.to_radians();
        let drop = depth / 2.0;
        let middle = center + DVec3::Z * (near + far) / 2.0;
        for (name, along_beam, turn) in [
            ("near", -1.0, level),
            ("middle", 0.0, level),
            ("far", 1.0, level),
            ("tilted across", 0.0, DMat3::from_rotation_y(tilt)),
            ("tilted along the scan", 0.0, DMat3::from_rotation_x(tilt)),
        ] {
            let at = middle + DVec3::Z * along_beam * drop;
            // The scan covers only the evaluated length of a tilted plate.
            let along = self.plate_side_mm * (turn * DVec3::Y).y;
            let name = name.to_owned();
            place(name, Artefact::Plate, at, turn, along, self.profiles);
        }
        for i in 0..self.height_steps {
            let distance = near + depth * f64::from(i) / f64::from(self.height_steps - 1);
            let name = format!("{:.4} mm", distance);
            let at = center + DVec3::Z * distance;
            place(name, Artefact::Height, at, level, 0.0, 1);
        }
        placings
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    fn volume() -> Volume {
        Volume {
            range_mm: [160.0, 250.0],
            width_mm: [-40.0, 42.0],
            travel_mm: 80.0,
        }
    }

    /// Spherical caps, plates and heights are in the volume, and the spheres of a bar have the
    /// specified distance.
    #[test]
    fn artefacts_lie_in_the_volume() {
        let volume = volume();
        let artefacts = Artefacts::of(&volume, &AcceptTable::default()).unwrap();
        let placings = artefacts.placings(&volume);
        assert_eq!(placings.len(), 14 + 5 + 11);
        let inside = |p: DVec3| {
            let slack = 1e-9;
            assert!(p.x >= -40.0 - slack && p.x <= 42.0 + slack, "{p}");
            assert!(p.y.abs() <= 40.0 + slack, "{p}");
            assert!(p.z >= 160.0 - slack && p.z <= 250.0 + slack, "{p}");
        };
        for placing in &placings {
            let pose = &placing.laser_from_artefact;
            match placing.artefact {
                Artefact::Sphere => {
                    let radius = artefacts.sphere_diameter_mm / 2.0;
                    for turn in 0..8 {
                        let turn = f64::from(turn) * PI / 4.0;
                        let (sin, cos) = artefacts.cap().sin_cos();
                        let rim = DVec3::new(sin * turn.cos(), sin * turn.sin(), cos);
                        inside(pose.point(rim * radius));
                    }
                    inside(pose.point(DVec3::Z * radius));
                }
                _ => {
                    let half = artefacts.plate_side_mm / 2.0;
                    for (x, y) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
                        inside(pose.point(DVec3::new(x * half, y * half, 0.0)));
                    }
                }
            }
        }
        for pair in placings[..14].chunks(2) {
            let [a, b] = [0, 1].map(|i| DVec3::from(pair[i].middle_mm));
            assert!((a.distance(b) - artefacts.ball_bar_length_mm).abs() < 1e-9);
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let refused = |table: AcceptTable| Artefacts::of(&volume(), &table).unwrap_err();
        let table = AcceptTable::default;
        let (key, ..) = refused(AcceptTable {
            sphere_diameter_mm: Some(60.0),
            ..table()
        });
        assert_eq!(key, "accept.sphere_diameter_mm");
        for spacing in [5.0, 79.0] {
            let (key, ..) = refused(AcceptTable {
                ball_bar_length_mm: Some(spacing),
                ..table()
            });
            assert_eq!(key, "accept.ball_bar_length_mm");
        }
        let (key, ..) = refused(AcceptTable {
            plate_side_mm: Some(81.0),
            ..table()
        });
        assert_eq!(key, "accept.plate_side_mm");
        let shallow = Volume {
            range_mm: [100.0, 110.0],
            ..volume()
        };
        let tilted = AcceptTable {
            plate_tilt_deg: Some(30.0),
            ..table()
        };
        assert_eq!(
            Artefacts::of(&shallow, &tilted).unwrap_err().0,
            "accept.plate_tilt_deg"
        );
    }
}

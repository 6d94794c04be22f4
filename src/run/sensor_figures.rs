//! Sensor properties as in a data sheet: measuring range, field and resolution.

use super::light_survey::{InField, LightSurvey, MeasuringRange, RayResult};
use super::simulation::Simulation;
use crate::accel::{Accel, Ray, WIDTH};
use crate::camera::Projector;
use crate::math::{DVec2, DVec3, Rigid};
use crate::scene::Scene;
use serde::Serialize;
use std::f64::consts::FRAC_PI_2;

/// Number of distances over the measuring range, including its near and far end.
const PLACES: usize = 9;

/// Largest far end of a measuring range in which studies position targets: 10 km, in mm. A camera
/// that looks along the beam sees its light to infinity.
pub(crate) const FURTHEST_MM: f64 = 1e7;

/// Describes the measuring range that a study expects.
pub(crate) fn range_that_ends() -> String {
    format!("at most {FURTHEST_MM:e} mm: turn the camera towards the beam, or read fewer rows")
}

/// Data sheet of the sensor.
#[derive(Debug, Clone, Serialize)]
pub struct SensorFigures {
    /// Angle between the laser's axis and the line from the centre of the range to the camera,
    /// degrees.
    pub triangulation_deg: f64,
    /// Distance from the laser's axis to the camera, perpendicular to the axis, mm.
    pub baseline_mm: f64,
    /// Camera position in the laser's frame (x along the line, z along the beam), mm.
    pub camera_mm: [f64; 3],
    /// Properties at distances from the near to the far end of the measuring range.
    pub places: Vec<SensorPlace>,
    /// Distances from the laser between which the blur is narrower than the line, mm; `None` if the
    /// blur is wider in the entire range.
    pub depth_of_field_mm: Option<[f64; 2]>,
    /// Maximum frame rate, Hz. Exposure and readout overlap.
    pub profiles_per_second: f64,
    /// Bounding box of the housing in the laser's frame, mm; `None` if it is unknown.
    pub housing_bounds_mm: Option<[[f64; 3]; 2]>,
    /// Fractions of the light outside the field along the path; `None` if no light hits the part.
    pub in_field: Option<InField>,
    /// Expected counts on this part; `None` if the camera sees no lit surface of it.
    pub light: Option<PeakCounts>,
}

/// Properties of the sensor at one distance from the laser, on its axis.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct SensorPlace {
    /// Distance from the laser along the beam, mm.
    pub distance_mm: f64,
    /// Ends of the lit and visible field along the line, mm.
    pub field_mm: [f64; 2],
    /// Scale along the line and along the beam, µm per pixel.
    pub um_per_px: [f64; 2],
    /// Full width (1/e²) of the light across the line, µm.
    pub line_um: f64,
    /// Full width (1/e²) of the line in the image, for a surface perpendicular to the beam, px.
    pub line_px: f64,
    /// Diameter of the lens blur, px.
    pub blur_px: f64,
}

/// Expected counts above black at the centre of the line, without speckle and blur. The statistics
/// cover the lit positions that the camera sees along the path.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct PeakCounts {
    /// Median.
    pub median: f64,
    /// 95 % quantile.
    pub bright: f64,
    /// Counts of a saturated pixel.
    pub full_scale: f64,
    /// Fraction of the positions with more counts than a saturated pixel.
    pub saturated_fraction: f64,
}

impl SensorFigures {
    /// Returns the near and far end of the measuring range, mm along the beam from the laser.
    pub fn ends(&self) -> [f64; 2] {
        let ends = [self.places.first(), self.places.last()];
        ends.map(|place| place.map_or(0.0, |place| place.distance_mm))
    }

    /// Returns the width of the field at a distance (mm) from the laser, interpolated linearly;
    /// `None` outside the range.
    pub fn field_at(&self, distance: f64) -> Option<f64> {
        let beside = self
            .places
            .windows(2)
            .find(|pair| (pair[0].distance_mm..=pair[1].distance_mm).contains(&distance))?;
        let width = |place: &SensorPlace| place.field_mm[1] - place.field_mm[0];
        let share =
            (distance - beside[0].distance_mm) / (beside[1].distance_mm - beside[0].distance_mm);
        Some(width(&beside[0]) * (1.0 - share) + width(&beside[1]) * share)
    }

    /// Returns the width of the field at the centre of the measuring range, mm.
    pub(crate) fn width_at_center(&self) -> Option<f64> {
        let [near, far] = self.ends();
        self.field_at((near + far) / 2.0)
    }

    /// Returns the properties of the sensor, independent of the part's position.
    pub(crate) fn of_sensor(scene: &Scene, accel: &Accel) -> Option<SensorFigures> {
        SensorFigures::of(scene, &LightSurvey::of(scene, accel, 0..1))
    }

    /// Returns [`SensorPlace::um_per_px`] at a distance (mm) from the laser; `None` if the camera
    /// does not see the beam there.
    pub(crate) fn um_per_px(scene: &Scene, distance: f64) -> Option<[f64; 2]> {
        SensorGeometry::new(scene)
            .place(distance)
            .map(|place| place.um_per_px)
    }

    /// Returns the properties for a prepared scene; `None` as for [`Self::of`].
    pub(crate) fn of_simulation(simulation: &Simulation) -> Option<SensorFigures> {
        let scene = &simulation.scene;
        let survey = LightSurvey::of(scene, &simulation.accel, 0..scene.scan.frames);
        SensorFigures::of(scene, &survey)
    }

    /// Returns the properties for a survey; `None` if the camera sees no laser light at any
    /// distance.
    pub(crate) fn of(scene: &Scene, survey: &LightSurvey) -> Option<SensorFigures> {
        let sensor = SensorGeometry::new(scene);
        let MeasuringRange { near_mm, far_mm } = survey.range?;
        let at = |i: usize| {
            let at = near_mm + (far_mm - near_mm) * i as f64 / (PLACES - 1) as f64;
            at.min(far_mm)
        };
        let places: Vec<SensorPlace> = (0..PLACES).filter_map(|i| sensor.place(at(i))).collect();
        let laser_from_camera = sensor.camera_from_laser.inverse();
        let eye = laser_from_camera.point(scene.camera.position());
        let middle = (near_mm + far_mm) / 2.0;
        let fine = (0..=1000).map(|i| near_mm + (far_mm - near_mm) * f64::from(i) / 1000.0);
        let sharp = fine.filter(|&t| sensor.place(t).is_some_and(|p| p.blur_px <= p.line_px));
        Some(SensorFigures {
            triangulation_deg: (DVec3::Z * middle - laser_from_camera.translation)
                .angle_between(DVec3::Z)
                .to_degrees(),
            baseline_mm: eye.truncate().length(),
            camera_mm: eye.to_array(),
            depth_of_field_mm: sharp.fold(None, |ends: Option<[f64; 2]>, t| {
                Some([ends.map_or(t, |[first, _]| first), t])
            }),
            places,
            profiles_per_second: {
                let sensor = &scene.camera.sensor;
                let readouts = (1 + sensor.shorter.len()) as f64;
                1e3 / sensor.total_exposure_ms().max(readouts * sensor.readout_ms)
            },
            housing_bounds_mm: scene.housing.map(|housing| {
                let housing = housing.moved(&scene.head_from_laser.inverse());
                [housing.min.to_array(), housing.max.to_array()]
            }),
            in_field: survey.in_field,
            light: PeakCounts::of(scene, survey),
        })
    }
}

impl PeakCounts {
    pub(crate) fn of(scene: &Scene, survey: &LightSurvey) -> Option<PeakCounts> {
        let seen = survey.lit.iter().filter_map(|lit| match lit.fate {
            RayResult::Seen(line) if line.counts > 0.0 => Some(line.counts),
            _ => None,
        });
        let mut seen: Vec<f64> = seen.collect();
        seen.sort_by(f64::total_cmp);
        let quantile = |share: f64| seen.get((seen.len() as f64 * share) as usize).copied();
        let sensor = &scene.camera.sensor;
        let full_scale = f64::from(sensor.saturation_count()) - sensor.black_level_dn;
        let saturated = seen.iter().filter(|&&counts| counts > full_scale).count();
        Some(PeakCounts {
            median: quantile(0.5)?,
            bright: quantile(0.95)?,
            full_scale,
            saturated_fraction: saturated as f64 / seen.len() as f64,
        })
    }
}

/// Cross-sections of the part in one frame, along the laser plane and along the perpendicular plane
/// through the beam. Values are lateral positions and distances along the beam, mm. `NaN` marks
/// gaps in a section.
#[derive(Debug, Clone)]
pub struct PartSections {
    pub along_line: Vec<(f64, f64)>,
    pub across_line: Vec<(f64, f64)>,
}

/// Returns the cross-sections of the frame at the midpoint of the path.
pub(crate) fn cuts(scene: &Scene, accel: &Accel) -> PartSections {
    const RAYS: usize = 800;
    let part_from_laser = scene.part_from_head(scene.scan.frames / 2) * scene.head_from_laser;
    let laser_from_part = part_from_laser.inverse();
    let corners = accel
        .bounds()
        .corners()
        .map(|corner| laser_from_part.point(corner));
    let reach = corners
        .iter()
        .fold(0.0, |reach: f64, c| reach.max(c.truncate().length()));
    let cut = |axis: DVec3| {
        let offsets: Vec<f64> = (0..RAYS)
            .map(|i| (2.0 * i as f64 / (RAYS - 1) as f64 - 1.0) * reach)
            .collect();
        let rays: Vec<Ray> = offsets
            .iter()
            .map(|&offset| Ray {
                origin: part_from_laser.point(axis * offset),
                direction: part_from_laser.vector(DVec3::Z),
                t_max: f64::INFINITY,
            })
            .collect();
        let hits = rays
            .chunks(WIDTH)
            .flat_map(|rays| accel.closest(rays, |_, _| true)[..rays.len()].to_vec());
        let met = offsets.iter().zip(hits);
        met.map(|(&offset, hit)| (offset, hit.map_or(f64::NAN, |hit| hit.t)))
            .collect()
    };
    PartSections {
        along_line: cut(DVec3::X),
        across_line: cut(DVec3::Y),
    }
}

/// Laser and camera in the laser's frame.
struct SensorGeometry<'a> {
    scene: &'a Scene,
    camera_from_laser: Rigid,
    projector: Projector,
    /// Tangent of half the fan angle.
    fan: f64,
}

impl SensorGeometry<'_> {
    fn new(scene: &Scene) -> SensorGeometry<'_> {
        let fan = scene.laser.fan.as_ref();
        SensorGeometry {
            scene,
            camera_from_laser: scene.head_from_camera.inverse() * scene.head_from_laser,
            projector: scene.camera.model().projector(),
            fan: fan.map_or(0.0, |fan| (fan.angle / 2.0).min(FRAC_PI_2 - 1e-6).tan()),
        }
    }

    fn pixel(&self, place: DVec3) -> Option<DVec2> {
        self.projector.project(self.camera_from_laser.point(place))
    }

    /// Returns the properties at a distance; `None` if the camera does not see the axis there.
    fn place(&self, distance: f64) -> Option<SensorPlace> {
        let place = DVec3::Z * distance;
        let camera = &self.scene.camera;
        let radius = self.scene.laser.radius(place);
        // The scale varies with the distance from the camera. The distance from the laser may be
        // far longer.
        let from_camera = self.camera_from_laser.point(place) - camera.position();
        let step = 1e-4 * from_camera.length();
        let per_mm = |direction: DVec3| {
            let [low, high] = [-step, step].map(|by| self.pixel(place + direction * by));
            Some((high? - low?).length() / (2.0 * step))
        };
        let field = self.scene.field_of_view.as_ref();
        let reach = match field {
            Some(field) => field
                .half_width(distance)
                .unwrap_or(0.0)
                .min(distance * self.fan),
            None => distance * self.fan,
        };
        let end = |sign: f64| self.seen_to(place, DVec3::X * sign * reach);
        let line =
            self.pixel(place + DVec3::Y * radius)? - self.pixel(place - DVec3::Y * radius)?;
        let blur = camera.defocus_blur(self.camera_from_laser.point(place))?;
        let um_per_px = [1e3 / per_mm(DVec3::X)?, 1e3 / per_mm(DVec3::Z)?];
        if !DVec2::from(um_per_px).is_finite() {
            return None;
        }
        Some(SensorPlace {
            distance_mm: distance,
            field_mm: [-1.0, 1.0].map(end),
            um_per_px,
            line_um: 2e3 * radius,
            line_px: line.length(),
            blur_px: blur / camera.sensor.pixel_pitch,
        })
    }

    /// Returns the end of the visible light, mm along x, from a position on the axis towards the
    /// end of the fan.
    fn seen_to(&self, place: DVec3, whole: DVec3) -> f64 {
        // The ends of the range are imaged at the sensor's border, so only the columns decide
        // visibility.
        let columns = f64::from(self.scene.camera.sensor.resolution.x);
        let seen = |share: f64| {
            let pixel = self.pixel(place + whole * share);
            pixel.is_some_and(|p| (0.0..=columns).contains(&p.x))
        };
        let (mut inside, mut outside) = (0.0, 1.0);
        if seen(outside) {
            return whole.x;
        }
        for _ in 0..50 {
            let middle = (inside + outside) / 2.0;
            match seen(middle) {
                true => inside = middle,
                false => outside = middle,
            }
        }
        whole.x * inside
    }
}

//! A sensor in the words of data sheets: what it measures where, and how finely.

use super::simulation::Simulation;
use super::survey::{Fate, InField, MeasuringRange, Survey};
use crate::accel::{Accel, Ray, WIDTH};
use crate::camera::Projector;
use crate::math::{DVec2, DVec3, Rigid};
use crate::scene::Scene;
use serde::Serialize;
use std::f64::consts::FRAC_PI_2;

/// Places over the measuring range, from its near to its far end.
const PLACES: usize = 9;

/// Furthest end of a measuring range in which studies place targets, mm: ten kilometres. A camera that looks along the
/// beam sees its light without end.
pub(crate) const FURTHEST_MM: f64 = 1e7;

/// States what a study expects of a measuring range.
pub(crate) fn range_that_ends() -> String {
    format!("at most {FURTHEST_MM:e} mm: turn the camera towards the beam, or read fewer rows")
}

/// What a data sheet of the sensor says.
#[derive(Debug, Clone, Serialize)]
pub struct SensorFigures {
    /// Between the laser's axis and the line from the middle of the range to the camera, degrees.
    pub triangulation_deg: f64,
    /// From the laser's axis to the camera, across it, mm.
    pub baseline_mm: f64,
    /// The camera in the laser's frame (x along the line, z along the beam), mm.
    pub camera_mm: [f64; 3],
    /// From the near to the far end of the measuring range.
    pub places: Vec<SensorPlace>,
    /// Distances from the laser between which the blur is narrower than the line, mm; `None`: it is nowhere in the range.
    pub in_focus_mm: Option<[f64; 2]>,
    /// Frames a second that exposure and readout, which go on at once, let the camera take.
    pub profiles_per_second: f64,
    /// Box around the housing in the laser's frame, mm; `None`: nobody says where it is.
    pub housing_mm: Option<[[f64; 3]; 2]>,
    /// Whether the part leaves the field along the path; `None`: no light meets it.
    pub in_field: Option<InField>,
    /// Of this part; `None`: the camera sees nothing of it.
    pub light: Option<PeakCounts>,
}

/// What the sensor does at one distance from the laser, on its axis.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct SensorPlace {
    /// Along the beam from the laser, mm.
    pub distance_mm: f64,
    /// Ends of what is lit and seen along the line, mm.
    pub field_mm: [f64; 2],
    /// Along the line, and along the beam: µm of the scene for one pixel.
    pub um_per_px: [f64; 2],
    /// Full width (1/e²) of the light across the line, µm.
    pub line_um: f64,
    /// The same on a surface square to the beam, in the image, px.
    pub line_px: f64,
    /// Diameter of the lens's blur, px.
    pub blur_px: f64,
}

/// Expected counts above black in the line's middle, without speckle and blur, over the lit places that the camera sees along the
/// path.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct PeakCounts {
    /// Half of the places have less.
    pub median: f64,
    /// 95 of 100 have less.
    pub bright: f64,
    /// Of a full pixel.
    pub full_scale: f64,
    /// Share of the places that have more than a full pixel.
    pub saturated_share: f64,
}

impl SensorFigures {
    /// Near and far end of the measuring range, mm along the beam from the laser.
    pub fn ends(&self) -> [f64; 2] {
        let ends = [self.places.first(), self.places.last()];
        ends.map(|place| place.map_or(0.0, |place| place.distance_mm))
    }

    /// Width of the field at a distance (mm) from the laser, between the two places beside it; `None` out of the range.
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

    /// Width of the field at the centre of the measuring range, mm.
    pub(crate) fn width_at_center(&self) -> Option<f64> {
        let [near, far] = self.ends();
        self.field_at((near + far) / 2.0)
    }

    /// Of the sensor, wherever the part is.
    pub(crate) fn of_sensor(scene: &Scene, accel: &Accel) -> Option<SensorFigures> {
        SensorFigures::of(scene, &Survey::of(scene, accel, 0..1))
    }

    /// [`SensorPlace::um_per_px`] at a distance (mm) from the laser; `None` where the camera does not see the beam.
    pub(crate) fn um_per_px(scene: &Scene, distance: f64) -> Option<[f64; 2]> {
        Sensor::new(scene)
            .place(distance)
            .map(|place| place.um_per_px)
    }

    /// Of a scene made ready; `None` as for [`Self::of`].
    pub(crate) fn of_simulation(simulation: &Simulation) -> Option<SensorFigures> {
        let scene = &simulation.scene;
        let survey = Survey::of(scene, &simulation.accel, 0..scene.scan.frames);
        SensorFigures::of(scene, &survey)
    }

    /// `None` if the camera sees nothing of the laser's light, wherever it falls.
    pub(crate) fn of(scene: &Scene, survey: &Survey) -> Option<SensorFigures> {
        let sensor = Sensor::new(scene);
        let MeasuringRange { near_mm, far_mm } = survey.range?;
        let at = |i: usize| near_mm + (far_mm - near_mm) * i as f64 / (PLACES - 1) as f64;
        let places: Vec<SensorPlace> = (0..PLACES).filter_map(|i| sensor.place(at(i))).collect();
        let eye = sensor.camera_from_laser.inverse().translation;
        let baseline = eye.truncate().length();
        let middle = (near_mm + far_mm) / 2.0;
        let fine = (0..=1000).map(|i| near_mm + (far_mm - near_mm) * f64::from(i) / 1000.0);
        let sharp = fine.filter(|&t| sensor.place(t).is_some_and(|p| p.blur_px <= p.line_px));
        Some(SensorFigures {
            triangulation_deg: baseline.atan2(middle - eye.z).to_degrees(),
            baseline_mm: baseline,
            camera_mm: eye.to_array(),
            in_focus_mm: sharp.fold(None, |ends: Option<[f64; 2]>, t| {
                Some([ends.map_or(t, |[first, _]| first), t])
            }),
            places,
            profiles_per_second: {
                let sensor = &scene.camera.sensor;
                let readouts = (1 + sensor.shorter.len()) as f64;
                1e3 / sensor.all_exposures_ms().max(readouts * sensor.readout_ms)
            },
            housing_mm: scene.housing.map(|housing| {
                let housing = housing.moved(&scene.head_from_laser.inverse());
                [housing.min.to_array(), housing.max.to_array()]
            }),
            in_field: survey.in_field,
            light: PeakCounts::of(scene, survey),
        })
    }
}

impl PeakCounts {
    pub(crate) fn of(scene: &Scene, survey: &Survey) -> Option<PeakCounts> {
        let seen = survey.lit.iter().filter_map(|lit| match lit.fate {
            Fate::Seen(line) if line.counts > 0.0 => Some(line.counts),
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
            saturated_share: saturated as f64 / seen.len() as f64,
        })
    }
}

/// The part as the light meets it in one frame, cut by the laser plane and by the plane square to it along the
/// beam: places beside the axis and distances along the beam, mm; `NaN` where a cut has gaps.
#[derive(Debug, Clone)]
pub struct Cuts {
    pub along_line: Vec<(f64, f64)>,
    pub across_line: Vec<(f64, f64)>,
}

/// Of the frame in the middle of the path.
pub(crate) fn cuts(scene: &Scene, accel: &Accel) -> Cuts {
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
    Cuts {
        along_line: cut(DVec3::X),
        across_line: cut(DVec3::Y),
    }
}

/// Laser and camera in the laser's frame.
struct Sensor<'a> {
    scene: &'a Scene,
    camera_from_laser: Rigid,
    projector: Projector,
    /// Tangent of half the fan.
    fan: f64,
}

impl Sensor<'_> {
    fn new(scene: &Scene) -> Sensor<'_> {
        let fan = scene.laser.fan.as_ref();
        Sensor {
            scene,
            camera_from_laser: scene.head_from_camera.inverse() * scene.head_from_laser,
            projector: scene.camera.model().projector(),
            fan: fan.map_or(0.0, |fan| (fan.angle / 2.0).min(FRAC_PI_2 - 1e-6).tan()),
        }
    }

    fn pixel(&self, place: DVec3) -> Option<DVec2> {
        self.projector.project(self.camera_from_laser.point(place))
    }

    /// `None` if the camera does not see the axis there.
    fn place(&self, distance: f64) -> Option<SensorPlace> {
        let place = DVec3::Z * distance;
        let camera = &self.scene.camera;
        let radius = self.scene.laser.beam.radius(distance);
        // The scale changes with the distance from the camera; that from the laser may be far longer.
        let step = 1e-4 * self.camera_from_laser.point(place).length();
        let per_mm = |direction: DVec3| {
            let [low, high] = [-step, step].map(|by| self.pixel(place + direction * by));
            Some((high? - low?).length() / (2.0 * step))
        };
        let reach = distance * self.fan;
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

    /// How far (mm along x) light is seen from a place on towards `whole`.
    fn seen_to(&self, place: DVec3, whole: DVec3) -> f64 {
        // The ends of the range lie on the sensor's edge: what is seen beside them shows by the columns alone.
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

//! Where a sample's light was seen in another pose of the path.

use super::rays::{Lit, Plane};
use crate::camera::Camera;
use crate::math::{DVec2, DVec3, Rigid};
use crate::speckle::anchor::rotation_vector;
use crate::speckle::coordinate::GrainMap;
use crate::speckle::motion::{Motion, Source, SurfaceView, shift_on_pupil};
use crate::speckle::strips::Strip;

/// The strips that a frame's pupil stands on, and the poses that they refer to; see
/// [`strips`](crate::speckle::strips).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strips {
    /// Where the pupil stands on the plane of phasors, and the direction of its way:
    /// diameters, along the sensor's columns and rows.
    pub pupil: DVec2,
    /// Unit vector.
    pub along: DVec2,
    /// The view at which the laser's wavefront is taken, in the camera's frame.
    pub view: SurfaceView,
    /// The two strips that the pupil stands on.
    pub strips: [Reference; 2],
}

/// A strip and the pose it refers to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reference {
    /// The strip as it is read.
    pub strip: Strip,
    /// From where the part is, in the camera's frame, to where it was.
    pub then_from_now: Rigid,
    /// Added to where a point was seen, (columns, rows) in mm on the sensor.
    pub displacement: DVec2,
}

/// What a sample of a pixel sees.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Seen {
    /// Of the surface, along the camera's axis, mm.
    pub depth: f64,
    /// Unit normal of the surface, in the laser's frame.
    pub normal: DVec3,
}

impl Seen {
    pub fn new(light: &Lit, plane: &Plane) -> Seen {
        Seen {
            depth: light.depth,
            normal: plane.normal,
        }
    }
}

/// Finds where strips are to be read.
pub(super) struct References {
    focal_length: f64,
    /// From the lens to the sensor's pixel (0, 0), and by column and row.
    corner: DVec3,
    steps: [DVec3; 2],
    view: SurfaceView,
    /// Where the part was, and its turn since then.
    strips: [(Rigid, Motion); 2],
    /// Texels to add.
    pub offsets: [DVec2; 2],
    camera_from_laser: Rigid,
}

impl References {
    pub fn new(
        strips: &Strips,
        map: GrainMap,
        camera: &Camera,
        camera_from_laser: Rigid,
    ) -> References {
        let at = |x: f64, y: f64| camera.sensor_point(DVec2::new(x, y));
        References {
            focal_length: camera.lens.focal_length,
            corner: at(0.0, 0.0),
            steps: [at(1.0, 0.0), at(0.0, 1.0)].map(|next| next - at(0.0, 0.0)),
            view: strips.view,
            strips: strips.strips.map(|reference| {
                let now_from_then = reference.then_from_now.inverse();
                let motion = Motion {
                    rotation: rotation_vector(&now_from_then.rotation),
                    ..Motion::default()
                };
                (reference.then_from_now, motion)
            }),
            offsets: (strips.strips).map(|reference| map.displacement(reference.displacement)),
            camera_from_laser,
        }
    }

    /// For each strip, the direction cosines under which the surface point was seen in the
    /// strip's reference whose light now reaches `place` through the strip's middle.
    ///
    /// That middle has shifted since by A_p, which is that of the very point: of its
    /// own way, normal, viewing ray and light. The point that the chief ray meets lies
    /// 1 − L_o/L_f of the way to a point of the pupil beside the one whose light comes
    /// through that; beyond ±1 the blur is wider than the pupil and the formula is out of
    /// its domain. The lens's distortion turns the rays behind it against those before it;
    /// points are taken to lie, now and then, where the rays behind it point.
    pub fn cosines(&self, place: DVec2, seen: Seen) -> [DVec2; 2] {
        let [by_column, by_row] = self.steps;
        let behind = self.corner + by_column * place.x + by_row * place.y;
        let point = behind * (seen.depth / behind.z);
        let normal = self.camera_from_laser.vector(seen.normal);
        let focused_on = 1.0 / self.focal_length - 1.0 / behind.z;
        let aside = (1.0 - focused_on * seen.depth).clamp(-1.0, 1.0);
        self.strips.map(|(then_from_now, motion)| {
            let mut from = point;
            if aside != 0.0 {
                // The shift is that of the point sought. It changes from there to here by
                // a small share of itself, so twice is enough.
                for _ in 0..2 {
                    let shift = self.shift(from, normal, &then_from_now, &motion);
                    from = point + shift * (aside * self.view.pupil_diameter);
                }
            }
            then_from_now.point(from).normalize_or_zero().truncate()
        })
    }

    /// A_p of a point (camera's frame) since the reference, in pupil diameters.
    fn shift(&self, point: DVec3, normal: DVec3, then_from_now: &Rigid, motion: &Motion) -> DVec3 {
        let source = match self.view.source {
            Source::Wavefront {
                direction,
                curvature_per_mm,
            } => Source::Wavefront {
                direction: direction + curvature_per_mm * (point - self.view.point),
                curvature_per_mm,
            },
            source => source,
        };
        let part = point - then_from_now.point(point);
        let view = SurfaceView {
            point,
            normal,
            source,
            ..self.view
        };
        shift_on_pupil(&view, &Motion { part, ..*motion }, DVec3::Z)
    }
}

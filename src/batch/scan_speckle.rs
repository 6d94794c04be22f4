//! Speckle of a scan: the patterns, how they lie over the sensor, and how they
//! follow the part.

use crate::error::Result;
use crate::integrator::plan::SpeckleStep;
use crate::integrator::{Patterns, Slip, Speckle};
use crate::math::{DVec2, DVec3, Rigid};
use crate::scene::{Motion, Moves, Scene, SpeckleModel};
use crate::speckle::anchor::{PoseAnchor, ScanCoordinate};
use crate::speckle::coordinate::GrainMap;
use crate::speckle::frame_field::{FrameFields, field_spec};
use crate::speckle::lookup::{Lookup, Method};
use crate::speckle::motion::{Source, SurfaceView, overlap_correlation_defocused};
use crate::speckle::path::PathAnchor;
use crate::speckle::pattern::{Aperture, PatternSpec};

pub struct ScanSpeckle {
    source: PatternSource,
    map: GrainMap,
    anchor: Anchor,
}

enum PatternSource {
    Frame {
        fields: FrameFields,
        slip: Option<Slip>,
    },
    Ring {
        lookup: Lookup,
        per_pixel: bool,
    },
}

enum Anchor {
    /// Nothing turns: exact over any length.
    Pose(Box<PoseAnchor>),
    Path(PathAnchor),
}

impl Anchor {
    /// `place` is that of the pose on the path.
    fn coordinate(&self, place: f64, part_from_head: &Rigid) -> ScanCoordinate {
        match self {
            Anchor::Pose(anchor) => anchor.coordinate(part_from_head),
            Anchor::Path(anchor) => anchor.coordinate(place),
        }
    }

    /// How the pattern slips on a surface out of focus; not modelled on a path that
    /// turns.
    fn slip(&self) -> Option<Slip> {
        match self {
            Anchor::Pose(anchor) => anchor.slip().map(|slip| Slip {
                along: anchor.along(),
                per_diameter: on_sensor(slip),
            }),
            Anchor::Path(_) => None,
        }
    }
}

/// The patterns of a scan as a ring, ten slices a pupil diameter.
fn ring_spec(seed: u64, aperture: Aperture) -> PatternSpec {
    PatternSpec {
        slices: 32,
        aperture,
        seed,
        ..PatternSpec::default()
    }
}

impl ScanSpeckle {
    /// `slips`: the patterns are read out of focus.
    pub fn new(scene: &Scene, model: &SpeckleModel, slips: bool) -> Result<ScanSpeckle> {
        let wavelength = scene.laser.beam.wavelength;
        let grain = scene.camera.speckle_angle(wavelength);
        let distance = scene.camera.lens.image_distance();
        let anchor = anchor(scene, slips);
        let (source, map) = match model.method {
            Method::Field => {
                let spec = field_spec(scene.seed, model.aperture);
                let fields = FrameFields::new(&spec, model.coherence)?;
                let map = fields.map(grain, distance);
                let slip = anchor.slip().filter(|_| slips);
                (PatternSource::Frame { fields, slip }, map)
            }
            Method::Trilinear | Method::Prefiltered { .. } => {
                let spec = ring_spec(scene.seed, model.aperture);
                let source = PatternSource::Ring {
                    lookup: Lookup::new(&spec, model.method, model.coherence)?,
                    per_pixel: model.method != Method::Trilinear,
                };
                let map = GrainMap::new(spec.texels_per_speckle, grain, distance);
                (source, map)
            }
        };
        Ok(ScanSpeckle {
            source,
            map,
            anchor,
        })
    }

    /// Bytes of the patterns that reading takes.
    pub fn memory(&self) -> usize {
        match &self.source {
            PatternSource::Ring { lookup, .. } => lookup.memory(),
            PatternSource::Frame { fields, slip } => {
                let strips = if slip.is_some() { 2 } else { 1 };
                strips * fields.field_memory()
            }
        }
    }

    pub fn at(&self, place: f64, part_from_head: &Rigid) -> Speckle<'_> {
        let at = self.anchor.coordinate(place, part_from_head);
        let patterns = match &self.source {
            PatternSource::Frame { fields, slip } => Patterns::Frame {
                fields,
                place: at.pupil,
                slip: *slip,
            },
            PatternSource::Ring { lookup, per_pixel } => Patterns::Ring {
                lookup,
                slice: at.u * lookup.slices_per_diameter(),
                per_pixel: *per_pixel,
            },
        };
        Speckle {
            patterns,
            map: self.map,
            displacement: on_sensor(at.sensor),
        }
    }
}

/// A displacement as (columns, rows): a view's second axis points up, the sensor's
/// rows go down.
fn on_sensor(displacement: DVec2) -> DVec2 {
    DVec2::new(displacement.x, -displacement.y)
}

/// What ties the patterns to the part along the scene's path; `slips` if it is read
/// out of focus.
fn anchor(scene: &Scene, slips: bool) -> Anchor {
    let mut view = surface_view(scene, None);
    if slips {
        view.magnification = scene.camera.lens.magnification();
    }
    let scan = &scene.scan;
    let wavelength = scene.laser.beam.wavelength;
    let first = scene.part_from_head(0);
    let ways = |frame| {
        first
            .inverse()
            .vector(scene.part_from_head(frame).translation - first.translation)
    };
    let direction = match &scan.motion {
        _ if scan.turns() => {
            // A rotary table turns alike from each frame to the next.
            let frames = match scan.motion {
                Motion::Rotary { .. } => 2,
                _ => scan.frames,
            };
            let poses = (0..frames).map(|frame| scene.part_from_head(frame));
            return Anchor::Path(PathAnchor::new(view, poses, wavelength));
        }
        Motion::Linear { step } if scan.moves == Moves::Head => *step,
        Motion::Linear { step } => -*step,
        // The farthest from the first: the last may be there again.
        _ => (0..scan.frames)
            .map(ways)
            .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))
            .unwrap_or(DVec3::ZERO),
    };
    Anchor::Pose(Box::new(PoseAnchor::new(
        view, &first, direction, wavelength,
    )))
}

/// What a step of the scan does to speckle in the middle of the field; `field`
/// whether the method reads fields, which alone can slip.
pub fn step_of_speckle(scene: &Scene, field: bool) -> SpeckleStep {
    let anchor = anchor(scene, true);
    let poses = [0.0, 1.0].map(|place| scene.part_from_head_at(place));
    let [from, to] = [0, 1].map(|i| anchor.coordinate(i as f64, &poses[i]).pupil);
    let delta = (to.shift - from.shift).length();
    let grain = scene.camera.speckle_size(scene.laser.beam.wavelength);
    let slip = anchor.slip().filter(|_| field);
    let point = surface_view(scene, None).point;
    let way = poses[0]
        .inverse()
        .vector(poses[1].point(point) - poses[0].point(point));
    SpeckleStep {
        across_sheet: way.dot(scene.head_from_laser.rotation.y_axis),
        gamma: overlap_correlation_defocused(delta, to.defocus - from.defocus),
        slip_grains: slip.map(|slip| slip.per_diameter.length() * delta / grain),
    }
}

/// The view of `point` (head's frame) on a surface across the beam; by default the
/// point in the middle of the field, where the optical axis meets the laser plane
/// (the plane of focus, if nowhere).
pub(super) fn surface_view(scene: &Scene, point: Option<DVec3>) -> SurfaceView {
    let camera = &scene.head_from_camera;
    let laser = &scene.head_from_laser;
    let (eye, axis) = (camera.translation, camera.rotation.z_axis);
    let normal = laser.rotation.y_axis;
    let distance = normal.dot(laser.translation - eye) / normal.dot(axis);
    let lens = &scene.camera.lens;
    let point =
        point.unwrap_or_else(
            || match distance.is_finite() && distance > lens.focal_length {
                true => eye + axis * distance,
                false => eye + axis * lens.focus_distance,
            },
        );
    let wave = scene.laser.wavefront(laser.inverse().point(point));
    let turn = laser.rotation;
    SurfaceView {
        point,
        normal: -laser.rotation.z_axis,
        source: Source::Wavefront {
            direction: turn * wave.direction,
            curvature_per_mm: turn * wave.curvature_per_mm * turn.transpose(),
        },
        pupil_centre: eye,
        pupil_diameter: lens.pupil_diameter(),
        image_x: camera.rotation.x_axis,
        focus_distance: lens.focus_distance,
        magnification: lens.image_distance() / (point - eye).length(),
    }
}

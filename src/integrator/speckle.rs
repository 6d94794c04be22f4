//! The speckle of one frame, and how its samples read it.

use super::pixels::Pixels;
use crate::accel::WIDTH;
use crate::camera::Camera;
use crate::math::DVec2;
use crate::speckle::coordinate::{Coordinate, GrainMap};
use crate::speckle::frame_field::{FrameField, FrameFields, PupilPlace, Rows, SlippingField};
use crate::speckle::lookup::Lookup;

/// Speckle patterns, and how they lie over the sensor in one frame.
#[derive(Clone, Copy)]
pub struct Speckle<'a> {
    pub patterns: Patterns<'a>,
    pub map: GrainMap,
    /// a_I of the seed: displacement on the sensor at which the pattern is read,
    /// (columns, rows), mm.
    pub displacement: DVec2,
}

/// Where the intensities come from.
#[derive(Clone, Copy)]
pub enum Patterns<'a> {
    /// The field made for the frame's own place of the pupil.
    Frame {
        fields: &'a FrameFields,
        place: PupilPlace,
        slip: Option<Slip>,
    },
    /// A ring of slices made beforehand.
    Ring {
        lookup: &'a Lookup,
        /// u, in slices.
        slice: f64,
        /// The patterns are integrated over the pixel: they are read at its centre.
        per_pixel: bool,
    },
}

/// How the pattern of a surface out of focus slips on it; see
/// [`PoseAnchor`](crate::speckle::anchor::PoseAnchor).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slip {
    /// Direction in which the pupil shifts over the field through the scan.
    pub along: DVec2,
    /// Displacement at which the pattern is read, (columns, rows) in mm, for a
    /// shift by one pupil diameter and a defocus 1 − L_f/L_o of one.
    pub per_diameter: DVec2,
}

/// A frame's speckle, ready to be read.
pub(super) struct Reader<'a> {
    camera: &'a Camera,
    map: GrainMap,
    displacement: DVec2,
    source: Source<'a>,
}

enum Source<'a> {
    InFocus(FrameField),
    OutOfFocus {
        field: Box<SlippingField>,
        /// Texels a diameter, for a defocus of one.
        slip: DVec2,
        focus: Focus,
    },
    Ring {
        lookup: &'a Lookup,
        slice: f64,
        per_pixel: bool,
    },
}

impl<'a> Reader<'a> {
    /// For reading the samples of `pixels`.
    pub fn new(speckle: &Speckle<'a>, camera: &'a Camera, pixels: &Pixels) -> Reader<'a> {
        let Speckle {
            patterns,
            map,
            displacement,
        } = *speckle;
        let source = match patterns {
            Patterns::Ring {
                lookup,
                slice,
                per_pixel,
            } => Source::Ring {
                lookup,
                slice,
                per_pixel,
            },
            Patterns::Frame {
                fields,
                place,
                slip: None,
            } => {
                let t = |pixel: DVec2| map.position(camera.screen(pixel), displacement).y;
                Source::InFocus(fields.field(&place, rows_of(fields, pixels, t)))
            }
            Patterns::Frame {
                fields,
                place,
                slip: Some(slip),
            } => Source::OutOfFocus {
                field: Box::new(fields.slipping(&place, slip.along)),
                slip: map.displacement(slip.per_diameter),
                focus: Focus::new(camera),
            },
        };
        Reader {
            camera,
            map,
            displacement,
            source,
        }
    }

    /// Speckle intensity, mean 1, at a place (column, row) on the sensor that sees
    /// a point `depth` mm from the lens along its axis.
    #[inline(always)]
    pub fn intensity(&self, place: DVec2, depth: f64) -> f64 {
        let at = |place: DVec2| {
            let screen = self.camera.screen(place);
            self.map.position(screen, self.displacement)
        };
        let intensity = match &self.source {
            Source::InFocus(field) => field.intensity(at(place)),
            Source::OutOfFocus { field, slip, focus } => {
                field.intensity(at(place), *slip * focus.defocus(place, depth))
            }
            &Source::Ring {
                lookup,
                slice: u,
                per_pixel,
            } => {
                let place = if per_pixel {
                    place.floor() + 0.5
                } else {
                    place
                };
                let DVec2 { x: s, y: t } = at(place);
                lookup.intensity(Coordinate { s, t, u })
            }
        };
        intensity as f64
    }
}

/// The rows of a field that the samples of `pixels` read; `t` gives the row of a
/// place on the sensor.
fn rows_of(fields: &FrameFields, pixels: &Pixels, t: impl Fn(DVec2) -> f64) -> Rows {
    let mut rows = Rows::none(fields.spec());
    for row in 0..pixels.rows {
        for first in pixels.blocks(row, 0) {
            // Within sixteen pixels a tilted sensor's rows bend by 1e-3 texel.
            let corner = |i: usize| {
                let (x, y) = (first + i % 2 * WIDTH, row + i / 2);
                t(DVec2::new(x as f64, y as f64))
            };
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            for t in (0..4).map(corner) {
                (low, high) = (low.min(t), high.max(t));
            }
            rows.insert(low, high);
        }
    }
    rows
}

/// What depth is in focus where on the sensor.
struct Focus {
    focal_length: f64,
    /// Distance of the sensor's plane from the lens along the axis: at pixel (0, 0),
    /// and by column and row.
    sensor: f64,
    slope: DVec2,
}

impl Focus {
    fn new(camera: &Camera) -> Focus {
        let z = |x: f64, y: f64| camera.sensor_point(DVec2::new(x, y)).z;
        Focus {
            focal_length: camera.lens.focal_length,
            sensor: z(0.0, 0.0),
            slope: DVec2::new(z(1.0, 0.0), z(0.0, 1.0)) - z(0.0, 0.0),
        }
    }

    /// 1 − L_f/L_o, within ±1: beyond that the blur is wider than the pupil's own
    /// image and the formula is out of its domain.
    fn defocus(&self, place: DVec2, depth: f64) -> f64 {
        let image_distance = self.sensor + self.slope.dot(place);
        let focused_on = 1.0 / self.focal_length - 1.0 / image_distance;
        (1.0 - 1.0 / (focused_on * depth)).clamp(-1.0, 1.0)
    }
}

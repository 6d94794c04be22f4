//! The speckle of one frame, and how its samples read it.

use crate::camera::{Camera, ChiefRays};
use crate::math::DVec2;
use crate::speckle::coordinate::{Coordinate, GrainMap};
use crate::speckle::frame_field::{FrameField, FrameFields, PupilPlace, SlippingField};
use crate::speckle::lookup::Lookup;
use glam::Vec2;
use wide::f32x4;

/// Speckle patterns, and how they lie over the sensor in one frame.
#[derive(Clone, Copy)]
pub struct Speckle<'a> {
    pub patterns: Patterns<'a>,
    pub map: GrainMap,
    /// a_I of the seed: displacement in the middle of an untilted sensor at which the
    /// pattern is read, (columns, rows), mm.
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
    rays: ChiefRays,
    map: GrainMap,
    /// Texels.
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
    pub fn new(speckle: &Speckle<'a>, camera: &Camera) -> Reader<'a> {
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
            } => Source::InFocus(fields.field(&place)),
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
            rays: camera.model().chief_rays(),
            map,
            displacement: map.displacement(displacement),
            source,
        }
    }

    /// Speckle intensity, mean 1, at a place (column, row) on the sensor that sees
    /// a point `depth` mm from the lens along its axis.
    pub fn intensity(&self, place: DVec2, depth: f64) -> f64 {
        let at = self.at(place);
        let intensity = match &self.source {
            Source::InFocus(field) => field.intensity(at),
            Source::OutOfFocus { field, slip, focus } => {
                field.intensity(at, *slip * focus.defocus(place, depth))
            }
            &Source::Ring {
                lookup,
                slice: u,
                per_pixel,
            } => {
                let at = match per_pixel {
                    true => self.at(place.floor() + 0.5),
                    false => at,
                };
                lookup.intensity(Coordinate {
                    s: at.x,
                    t: at.y,
                    u,
                })
            }
        };
        intensity as f64
    }

    /// (s, t) of a place on the sensor.
    #[inline(always)]
    fn at(&self, place: DVec2) -> DVec2 {
        self.displacement + self.map.texels(self.rays.cosines(place))
    }

    /// For reading within the pixel around `centre`.
    #[inline(always)]
    pub fn pixel(&self, centre: DVec2) -> PixelReader<'_> {
        let (cosines, slopes) = self.rays.around(centre);
        let at = self.displacement + self.map.texels(cosines);
        let steps = [slopes.x_axis, slopes.y_axis].map(|slope| self.map.texels(slope));
        let extent = steps[0].abs() + steps[1].abs();
        PixelReader {
            reader: self,
            field: match &self.source {
                Source::InFocus(field) if extent.max_element() <= 2.0 * FrameField::REACH => {
                    Some(field)
                }
                _ => None,
            },
            centre,
            at,
            steps: steps.map(|step| step.as_vec2()),
        }
    }
}

/// Speckle within a pixel, over which the pattern is not bent.
pub(super) struct PixelReader<'a> {
    reader: &'a Reader<'a>,
    /// One in focus, of a pixel within its reach.
    field: Option<&'a FrameField>,
    centre: DVec2,
    at: DVec2,
    /// Texels by column and by row.
    steps: [Vec2; 2],
}

impl PixelReader<'_> {
    /// Intensities, mean 1, at the first `count` of four places so many columns and rows
    /// (up to ½) from the pixel's centre, which see points `depths` mm from the lens along
    /// its axis; what others give is of no use.
    #[inline(always)]
    pub fn four(&self, columns: f32x4, rows: f32x4, depths: [f64; 4], count: usize) -> f32x4 {
        let Some(field) = self.field else {
            let (columns, rows) = (columns.to_array(), rows.to_array());
            let off = |i: usize| DVec2::new(columns[i] as f64, rows[i] as f64);
            let read = |i| self.reader.intensity(self.centre + off(i), depths[i]) as f32;
            return [0, 1, 2, 3].map(read).into();
        };
        let [by_column, by_row] = self.steps;
        let s = columns * by_column.x + rows * by_row.x;
        let t = columns * by_column.y + rows * by_row.y;
        field.around(self.at, s, t, count)
    }
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

//! The speckle of one frame, and how its samples read it.

use super::reference::{References, Seen, Strips};
use crate::camera::{Camera, ChiefRays};
use crate::math::{DVec2, Rigid};
use crate::speckle::coordinate::{Coordinate, GrainMap};
use crate::speckle::frame_field::{FrameField, FrameFields, PupilPlace};
use crate::speckle::lookup::Lookup;
use crate::speckle::strips::StripField;
use glam::Vec2;
use wide::f32x4;

/// Speckle patterns, and how they lie over the sensor in one frame.
#[derive(Clone)]
pub struct Speckle<'a> {
    /// Speckle intensities of mean 1.
    pub patterns: Patterns<'a>,
    /// From places on the sensor to places in the pattern.
    pub map: GrainMap,
    /// a_I of the seed: displacement in the middle of an untilted sensor at which the
    /// pattern is read, (columns, rows), mm.
    pub displacement: DVec2,
}

/// Where the intensities come from.
#[derive(Clone)]
pub enum Patterns<'a> {
    /// The field made for the frame's own place of the pupil.
    Frame {
        /// Fields of the whole scan.
        fields: &'a FrameFields,
        /// Where the frame's pupil stands on the plane of phasors.
        place: PupilPlace,
    },
    /// The same in strips, each read where the surface was seen in a pose of its own.
    Strips {
        /// Fields of the whole scan.
        fields: &'a FrameFields,
        /// Those of this frame.
        strips: Box<Strips>,
    },
    /// A ring of slices made beforehand.
    Ring {
        /// The slices.
        lookup: &'a Lookup,
        /// u, in slices.
        slice: f64,
        /// The patterns are integrated over the pixel: they are read at its centre.
        per_pixel: bool,
    },
}

impl Patterns<'_> {
    /// Whether they are read where the surface was seen.
    pub(super) fn read_surface(&self) -> bool {
        matches!(self, Patterns::Strips { .. })
    }
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
    Frame(FrameField),
    Strips {
        field: Box<StripField>,
        references: Box<References>,
    },
    Ring {
        lookup: &'a Lookup,
        slice: f64,
        per_pixel: bool,
    },
}

impl<'a> Reader<'a> {
    pub fn new(speckle: &Speckle<'a>, camera: &Camera, camera_from_laser: Rigid) -> Reader<'a> {
        let map = speckle.map;
        let source = match &speckle.patterns {
            &Patterns::Ring {
                lookup,
                slice,
                per_pixel,
            } => Source::Ring {
                lookup,
                slice,
                per_pixel,
            },
            Patterns::Frame { fields, place } => Source::Frame(fields.field(place)),
            Patterns::Strips { fields, strips } => {
                let both = strips.strips.map(|reference| reference.strip);
                Source::Strips {
                    field: Box::new(fields.strips(strips.pupil, strips.along, &both)),
                    references: Box::new(References::new(strips, map, camera, camera_from_laser)),
                }
            }
        };
        Reader {
            rays: camera.model().chief_rays(),
            map,
            displacement: map.displacement(speckle.displacement),
            source,
        }
    }

    /// Speckle intensity, mean 1, at a place (column, row) on the sensor.
    pub fn intensity(&self, place: DVec2, seen: Seen) -> f64 {
        let at = self.at(place);
        let intensity = match &self.source {
            Source::Frame(field) => field.intensity(at),
            Source::Strips { field, references } => {
                let cosines = references.cosines(place, seen);
                let texels = |i: usize| self.map.texels(cosines[i]) + references.offsets[i];
                field.intensity([texels(0), texels(1)])
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
                Source::Frame(field) if extent.max_element() <= 2.0 * FrameField::REACH => {
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
    /// (up to ½) from the pixel's centre; what others give is of no use.
    #[inline(always)]
    pub fn four(&self, columns: f32x4, rows: f32x4, seen: [Seen; 4], count: usize) -> f32x4 {
        let Some(field) = self.field else {
            let (columns, rows) = (columns.to_array(), rows.to_array());
            let off = |i: usize| DVec2::new(columns[i] as f64, rows[i] as f64);
            let read = |i| self.reader.intensity(self.centre + off(i), seen[i]) as f32;
            return [0, 1, 2, 3].map(read).into();
        };
        let [by_column, by_row] = self.steps;
        let s = columns * by_column.x + rows * by_row.x;
        let t = columns * by_column.y + rows * by_row.y;
        field.around(self.at, s, t, count)
    }
}

//! The speckle of one frame, and how its samples read it.

use super::View;
use super::reference::{Around, References, Seen, Strips};
use crate::camera::{Camera, ChiefRays};
use crate::math::{DVec2, Rigid};
use crate::speckle::coordinate::{Coordinate, GrainMap};
use crate::speckle::frame_field::{FrameField, FrameFields, PupilPlace};
use crate::speckle::lookup::Lookup;
use crate::speckle::strips::StripField;
use glam::Vec2;
use rustfft::num_complex::Complex32;
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
    /// `Some`: fields on the surface, which the lens defocuses, of a pupil so many times as wide as the
    /// lens's; `None`: fields on the sensor.
    pub wider: Option<f64>,
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
    },
}

/// Way (pupil diameters, across any path) to phasors that no pupil of a scan meets.
const ELSEWHERE: DVec2 = DVec2::new(8192.0, -8192.0);

impl<'a> Speckle<'a> {
    /// A pattern of its own with the same grains, of the same motion, for light of other paths.
    pub(super) fn elsewhere(&self, view: &View) -> Speckle<'a> {
        let far = |fields, shift| {
            let shift = shift + ELSEWHERE;
            Patterns::Frame {
                fields,
                place: PupilPlace {
                    shift,
                    defocus: 0.0,
                },
            }
        };
        let patterns = match &self.patterns {
            Patterns::Frame { fields, place } => far(*fields, place.shift),
            Patterns::Strips { fields, strips } => far(*fields, strips.pupil),
            ring => ring.clone(),
        };
        let map = match &patterns {
            // Fields of a wider pupil, read as if of the lens's.
            Patterns::Frame { fields, .. } => {
                let camera = view.camera;
                let grain = camera.speckle_angle(view.laser.beam.wavelength);
                fields.map(grain, camera.lens.image_distance())
            }
            _ => self.map,
        };
        let sensor = view.camera.sensor.resolution.as_dvec2() * view.camera.sensor.pixel_pitch;
        Speckle {
            patterns,
            map,
            // A ring has one pattern: of its part that the sensor does not see.
            displacement: self.displacement + sensor,
            wider: None,
        }
    }
}

impl Patterns<'_> {
    /// Whether they are read where the surface was seen.
    pub(super) fn read_surface(&self) -> bool {
        matches!(self, Patterns::Strips { .. })
    }
}

const NO_FIELD: &str =
    "a plan with a coherent lens, or surfaces of different polarisation, has speckle by field";

/// Power of one of the independent patterns in light of this degree of polarisation, over that in unpolarised
/// light: they are pairs of one polarisation and the other (Goodman 2007, section 3.4).
pub(super) fn power(pattern: usize, polarised: f32) -> f32 {
    match pattern.is_multiple_of(2) {
        true => 1.0 + polarised,
        false => 1.0 - polarised,
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
    },
}

impl<'a> Reader<'a> {
    pub fn new(speckle: &Speckle<'a>, camera: &Camera, camera_from_laser: Rigid) -> Reader<'a> {
        let map = speckle.map;
        let source = match &speckle.patterns {
            &Patterns::Ring { lookup, slice } => Source::Ring { lookup, slice },
            Patterns::Frame { fields, place } => Source::Frame(fields.field(place)),
            Patterns::Strips { fields, strips } => {
                let both = strips.strips.map(|reference| reference.strip);
                Source::Strips {
                    field: Box::new(fields.strips(strips.pupil, strips.along, &both)),
                    references: Box::new(References::new(
                        &speckle.map,
                        speckle.wider.unwrap_or(0.0),
                        strips,
                        camera,
                        camera_from_laser,
                    )),
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
                self.of_strips(field, references, references.cosines(place, seen))
            }
            &Source::Ring { lookup, slice: u } => lookup.intensity(Coordinate {
                s: at.x,
                t: at.y,
                u,
            }),
        };
        intensity as f64
    }

    /// The same of light of this degree of polarisation, of patterns made for unpolarised light.
    pub fn intensity_of(&self, place: DVec2, seen: Seen, polarised: f32) -> f32 {
        let sum = |weights: &mut dyn Iterator<Item = f32>, field: &dyn Fn(usize) -> Complex32| {
            let pattern = |(k, weight)| weight * power(k, polarised) * field(k).norm_sqr();
            weights.enumerate().map(pattern).sum()
        };
        match &self.source {
            Source::Frame(field) => {
                let at = self.at(place);
                sum(&mut field.weights(), &|k| field.amplitude_of(k, at))
            }
            // What sees nothing lit has no light.
            Source::Strips { .. } if seen == Seen::default() => 0.0,
            Source::Strips { field, references } => {
                let cosines = references.cosines(place, seen);
                let at = [0, 1].map(|i| self.map.texels(cosines[i]) + references.offsets[i]);
                sum(&mut field.weights(), &|k| field.amplitude_of(k, at))
            }
            Source::Ring { .. } => unreachable!("{NO_FIELD}"),
        }
    }

    /// Weights of the independent patterns of a frame's own field.
    pub fn weights(&self) -> Vec<f32> {
        match &self.source {
            Source::Frame(field) => field.weights().collect(),
            Source::Strips { field, .. } => field.weights().collect(),
            Source::Ring { .. } => unreachable!("{NO_FIELD}"),
        }
    }

    /// Amplitude of the field in one of them, of mean square 1, at a place (column, row) on the
    /// sensor.
    pub fn amplitude(&self, pattern: usize, place: DVec2, seen: Seen) -> Complex32 {
        match &self.source {
            Source::Frame(field) => field.amplitude_of(pattern, self.at(place)),
            Source::Strips { field, references } => {
                let cosines = references.cosines(place, seen);
                let at = [0, 1].map(|i| self.map.texels(cosines[i]) + references.offsets[i]);
                field.amplitude_of(pattern, at)
            }
            Source::Ring { .. } => unreachable!("{NO_FIELD}"),
        }
    }

    /// Intensity of strips that are read under these direction cosines.
    #[inline(always)]
    fn of_strips(&self, field: &StripField, references: &References, at: [DVec2; 2]) -> f32 {
        field.intensity([0, 1].map(|i| self.map.texels(at[i]) + references.offsets[i]))
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
            around: None,
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
    /// Where strips are read on the plane that the last sample saw.
    around: Option<Around>,
}

impl PixelReader<'_> {
    /// Intensities, mean 1, at the first `count` of four places so many columns and rows
    /// (up to ½) from the pixel's centre; what others give is of no use.
    #[inline(always)]
    pub fn four(&mut self, columns: f32x4, rows: f32x4, seen: &[Seen], count: usize) -> f32x4 {
        let Some(field) = self.field else {
            let (columns, rows) = (columns.to_array(), rows.to_array());
            let mut values = [0.0; 4];
            for i in 0..count {
                let off = DVec2::new(columns[i] as f64, rows[i] as f64);
                let seen = seen.get(i).copied().unwrap_or_default();
                values[i] = self.one(self.centre + off, seen);
            }
            return values.into();
        };
        let [by_column, by_row] = self.steps;
        let s = columns * by_column.x + rows * by_row.x;
        let t = columns * by_column.y + rows * by_row.y;
        field.around(self.at, s, t, count)
    }

    fn one(&mut self, place: DVec2, seen: Seen) -> f32 {
        let Source::Strips { field, references } = &self.reader.source else {
            return self.reader.intensity(place, seen) as f32;
        };
        if seen == Seen::default() {
            return 0.0;
        }
        let known = |around: &Around| around.cosines(place, seen);
        let cosines = self.around.as_ref().and_then(known).or_else(|| {
            self.around = references.around(self.centre, seen);
            self.around.as_ref().and_then(known)
        });
        let cosines = cosines.unwrap_or_else(|| references.cosines(place, seen));
        self.reader.of_strips(field, references, cosines)
    }
}

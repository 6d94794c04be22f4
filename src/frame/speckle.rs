//! The speckle of one frame, and how its samples read it.

use super::View;
use super::reference::{Around, References, Seen, Strips};
use crate::camera::{Camera, ChiefRays};
use crate::math::{DVec2, Rigid};
use crate::speckle::coordinate::{Coordinate, GrainMap};
use crate::speckle::frame_field::{FrameField, FrameFields, PupilPlace};
use crate::speckle::lookup::Lookup;
use crate::speckle::strips::StripField;
use glam::{DMat2, Vec2};
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
    fn intensity(&self, place: DVec2, seen: Seen) -> f32 {
        let at = self.at(place);
        match &self.source {
            Source::Frame(field) => field.intensity(at),
            Source::Strips { .. } if seen == Seen::default() => 0.0,
            Source::Strips { field, references } => {
                field.intensity(self.texels(references, references.cosines(place, seen)))
            }
            &Source::Ring { lookup, slice: u } => lookup.intensity(Coordinate {
                s: at.x,
                t: at.y,
                u,
            }),
        }
    }

    /// The same of light of this degree of polarisation, of patterns made for unpolarised light.
    fn intensity_of(&self, place: DVec2, seen: Seen, polarised: f32) -> f32 {
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
                let at = self.texels(references, references.cosines(place, seen));
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
                let at = self.texels(references, references.cosines(place, seen));
                field.amplitude_of(pattern, at)
            }
            Source::Ring { .. } => unreachable!("{NO_FIELD}"),
        }
    }

    /// Where strips are read under these direction cosines, texels.
    #[inline(always)]
    fn texels(&self, references: &References, cosines: [DVec2; 2]) -> [DVec2; 2] {
        [0, 1].map(|i| self.map.texels(cosines[i]) + references.offsets[i])
    }

    /// (s, t) of a place on the sensor.
    #[inline(always)]
    fn at(&self, place: DVec2) -> DVec2 {
        self.displacement + self.map.texels(self.rays.cosines(place))
    }

    /// For reading within the pixel around `centre`; `nearby` is what was found in pixels above it, whatever
    /// they saw.
    #[inline(always)]
    pub fn pixel<'r>(&'r self, centre: DVec2, nearby: &'r mut Nearby) -> PixelReader<'r> {
        PixelReader {
            reader: self,
            own: match &self.source {
                Source::Frame(field) => {
                    let (cosines, slopes) = self.rays.around(centre);
                    let at = self.displacement + self.map.texels(cosines);
                    self.steps(slopes).map(|steps| (field, at, steps))
                }
                _ => None,
            },
            centre,
            nearby,
        }
    }

    /// Intensities, mean 1, in the middles of four pixels side by side, of which the first has this centre and all
    /// see what is `seen`; over them the pattern is not bent. `nearby` is what was found in fours above. `None` for
    /// rings, or if four pixels are not within a field's reach.
    #[inline(always)]
    pub fn side_by_side(&self, first: DVec2, seen: Seen, nearby: &mut Nearby) -> Option<[f32; 4]> {
        let off = f32x4::from([-1.5, -0.5, 0.5, 1.5]);
        let along = |[by_column, _]: [Vec2; 2]| {
            let is_within = 1.5 * by_column.abs().max_element() <= FrameField::REACH as f32;
            is_within.then(|| [off * by_column.x, off * by_column.y])
        };
        let mut reader = self.pixel(first + DVec2::new(1.5, 0.0), nearby);
        let four = if let Some((field, at, steps)) = reader.own {
            let [s, t] = along(steps)?;
            field.around(at, s, t, 4)
        } else {
            let (field, at, [before, after]) = reader.of_strips(&[seen], 1)?;
            field.around(at, [along(before)?, along(after)?], 4)
        };
        Some(four.to_array())
    }

    /// Texels by column and by row; `None` if a pixel is not within a field's reach.
    #[inline(always)]
    fn steps(&self, slopes: DMat2) -> Option<[Vec2; 2]> {
        let steps = [slopes.x_axis, slopes.y_axis].map(|slope| self.map.texels(slope));
        let extent = steps[0].abs() + steps[1].abs();
        let is_within = extent.max_element() <= 2.0 * FrameField::REACH;
        is_within.then(|| steps.map(|step| step.as_vec2()))
    }
}

/// Where strips are read on the plane that the last sample saw.
pub(super) struct Nearby(Option<Around>);

impl Nearby {
    /// Nothing was read.
    pub const NONE: Nearby = Nearby(None);

    /// Around the pixel with this centre that sees a plane.
    #[inline(always)]
    fn around(&mut self, references: &References, centre: DVec2, seen: Seen) -> Option<&Around> {
        let known = self.0.as_ref().and_then(|around| around.to(centre, seen));
        if known.is_none() {
            self.0 = references.around(centre, seen);
        }
        self.0.as_ref()
    }
}

/// Speckle within a pixel, over which the pattern is not bent.
pub(super) struct PixelReader<'a> {
    reader: &'a Reader<'a>,
    /// The frame's one field, where the middle reads it, and texels by column and by row.
    own: Option<(&'a FrameField, DVec2, [Vec2; 2])>,
    centre: DVec2,
    nearby: &'a mut Nearby,
}

/// The strips that samples of a pixel read, where its middle does, and texels by column and by row, of each strip.
type OfStrips<'a> = (&'a StripField, [DVec2; 2], [[Vec2; 2]; 2]);

impl<'a> PixelReader<'a> {
    /// Intensity, mean 1, in the pixel's middle.
    #[inline(always)]
    pub fn middle(&mut self, seen: Seen) -> f32 {
        self.four(f32x4::ZERO, f32x4::ZERO, &[seen], 1).to_array()[0]
    }

    /// Intensities, mean 1, at the first `count` of four places so many columns and rows
    /// (up to ½) from the pixel's centre; what others give is of no use.
    #[inline(always)]
    pub fn four(&mut self, columns: f32x4, rows: f32x4, seen: &[Seen], count: usize) -> f32x4 {
        let along = |[by_column, by_row]: [Vec2; 2]| {
            [
                columns * by_column.x + rows * by_row.x,
                columns * by_column.y + rows * by_row.y,
            ]
        };
        if let Some((field, at, steps)) = self.own {
            let [s, t] = along(steps);
            return field.around(at, s, t, count);
        }
        if let Some((field, at, steps)) = self.of_strips(seen, count) {
            return field.around(at, steps.map(along), count);
        }
        let (columns, rows) = (columns.to_array(), rows.to_array());
        let mut values = [0.0; 4];
        for i in 0..count {
            let off = DVec2::new(columns[i] as f64, rows[i] as f64);
            let seen = seen.get(i).copied().unwrap_or_default();
            values[i] = self.reader.intensity(self.centre + off, seen);
        }
        values.into()
    }

    /// Intensity, mean 1, so far (columns, rows) from the pixel's centre, of light of this degree of polarisation.
    pub fn one_of(&self, off: DVec2, seen: Seen, polarised: f32) -> f32 {
        self.reader.intensity_of(self.centre + off, seen, polarised)
    }

    /// The strips that all of these samples read, where the middle does, and texels by column and by row.
    /// `None` if they see different planes, or none.
    #[inline(always)]
    fn of_strips(&mut self, seen: &[Seen], count: usize) -> Option<OfStrips<'a>> {
        let Source::Strips { field, references } = &self.reader.source else {
            return None;
        };
        let (&first, others) = seen.get(..count)?.split_first()?;
        if first == Seen::default() || !others.iter().all(|seen| seen.is_on(first)) {
            return None;
        }
        let around = self.nearby.around(references, self.centre, first)?;
        let off = self.centre - around.centre;
        let cosines = [0, 1].map(|i| around.at[i] + around.slopes[i] * off);
        let [first, second] = around.slopes.map(|slopes| self.reader.steps(slopes));
        Some((
            field,
            self.reader.texels(references, cosines),
            [first?, second?],
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::super::reference::{MISSED, Reference};
    use super::*;
    use crate::camera::fixture;
    use crate::math::{Aperture, DVec3};
    use crate::speckle::frame_field::field_spec;
    use crate::speckle::lookup::Coherence;
    use crate::speckle::motion::{self, SurfaceView};
    use crate::speckle::strips::Strip;

    const DEPTH: f64 = 240.0;

    /// The strips of a pupil that has gone some way since their references.
    fn strips(fields: &FrameFields, camera: &Camera) -> Strips {
        let (way, width) = (0.4, fields.strip_width());
        let moved = DVec3::new(0.3, -0.2, 0.1);
        Strips {
            pupil: DVec2::X * way,
            along: DVec2::X,
            view: SurfaceView {
                point: DVec3::Z * DEPTH,
                normal: DVec3::NEG_Z,
                source: motion::Source::Point(DVec3::new(0.0, 120.0, 20.0)),
                pupil_centre: DVec3::ZERO,
                pupil_diameter: camera.lens.pupil_diameter(),
                image_x: DVec3::X,
                focus_distance: camera.lens.focus_distance,
                magnification: camera.lens.image_distance() / DEPTH,
            },
            strips: Strip::numbers(way, width).map(|number| Reference {
                strip: Strip {
                    number,
                    reference: DVec2::X * Strip::middle(number, width),
                    defocus: 0.0,
                    aside: DVec2::ZERO,
                },
                then_from_now: Rigid::from_euler_xyz(DVec3::splat(1e-4), moved),
                displacement: DVec2::ZERO,
            }),
        }
    }

    /// Four pixels side by side, row by row, are read as each place is by itself: of one field, and of strips where
    /// the surface is tilted. A place is missed by up to [`MISSED`] texels along either axis, r = √2
    /// times that in grains, which changes intensities by 2·(1 − μ²) in the mean square, 1 − μ² = (πr)²/4 for a
    /// round pupil and so small an r.
    #[test]
    fn four_pixels_side_by_side_are_read_as_each_by_itself() {
        let camera = fixture();
        let spec = field_spec(1, Aperture::Circle);
        let fields = FrameFields::new(&spec, Coherence::FULL).unwrap();
        let grain = camera.speckle_angle(660e-6);
        let map = fields.map(grain, camera.lens.image_distance());
        let missed = MISSED * 2f64.sqrt() / spec.texels_per_speckle;
        // 2·(πr)²/4.
        let limit = ((std::f64::consts::PI * missed).powi(2) / 2.0) as f32;
        let place = PupilPlace {
            shift: DVec2::new(0.4, 0.0),
            defocus: 0.0,
        };
        let fields = &fields;
        let of_strips = Patterns::Strips {
            fields,
            strips: Box::new(strips(fields, &camera)),
        };
        let normal = DVec3::new(0.2, 0.4, -1.0).normalize();
        let seen = Seen {
            normal,
            distance: normal.z * DEPTH,
        };
        for patterns in [Patterns::Frame { fields, place }, of_strips] {
            let speckle = Speckle {
                patterns,
                map,
                displacement: DVec2::ZERO,
                wider: None,
            };
            let reader = Reader::new(&speckle, &camera, Rigid::IDENTITY);
            let (mut missed_by, mut apart) = (0.0, 0.0);
            let (fours, rows) = (20, 50);
            for four in 0..fours {
                let mut nearby = Nearby::NONE;
                for row in 0..rows {
                    let first = DVec2::new(4.0 * four as f64, row as f64) + 0.5;
                    let found = reader.side_by_side(first, seen, &mut nearby).unwrap();
                    let alone = |i: usize| reader.intensity(first + DVec2::X * i as f64, seen);
                    for (i, found) in found.into_iter().enumerate() {
                        missed_by += (found - alone(i)).powi(2);
                        apart += (found - alone(i + 1)).powi(2);
                    }
                }
            }
            let count = (4 * fours * rows) as f32;
            assert!(missed_by / count <= limit, "{} {limit}", missed_by / count);
            assert!(apart / count > 10.0 * limit, "{}", apart / count);
        }
    }
}

//! Speckle of one frame, and how samples read it.

use super::PoseView;
use super::speckle_strips::{StripCache, StripLocator, StripReferences, TangentPlane};
use crate::camera::{Camera, ChiefRays};
use crate::math::{DVec2, Rigid};
use crate::speckle::coordinate::{Coordinate, GrainMap};
use crate::speckle::frame_field::{FrameField, FrameFields, PupilPosition};
use crate::speckle::lookup::SpeckleTexture;
use crate::speckle::strips::StripField;
use glam::{DMat2, Vec2};
use rustfft::num_complex::Complex32;
use wide::f32x4;

/// Speckle patterns of one frame, and their mapping to the sensor.
#[derive(Clone)]
pub struct Speckle<'a> {
    /// Speckle intensities of mean 1.
    pub patterns: SpeckleSource<'a>,
    /// Map from sensor positions to pattern positions.
    pub map: GrainMap,
    /// Displacement of the pattern at the centre of an untilted sensor, (columns, rows), mm: a_I of
    /// Bergmann et al. (2016).
    pub displacement: DVec2,
    /// Ratio of the pupil width of the fields to the pupil width of the lens. `Some`: the fields
    /// are on the surface, and the lens defocuses them. `None`: the fields are on the sensor.
    pub pupil_scale: Option<f64>,
}

/// Source of the speckle intensities.
#[derive(Clone)]
pub enum SpeckleSource<'a> {
    /// Field for the frame's pupil position.
    Frame {
        /// Fields of the complete scan.
        fields: &'a FrameFields,
        /// Position of the frame's pupil on the phasor plane.
        place: PupilPosition,
    },
    /// Field in strips. Each strip is read at the image of the surface point in a separate
    /// reference pose.
    Strips {
        /// Fields of the complete scan.
        fields: &'a FrameFields,
        /// Strips of this frame.
        strips: Box<StripReferences>,
    },
    /// Precomputed ring of slices.
    Ring {
        /// Slices of the ring.
        lookup: &'a SpeckleTexture,
        /// Coordinate u, in slices.
        slice: f64,
    },
}

/// Offset from every path of the pupil to phasors that no frame of a scan uses, pupil diameters.
const INDEPENDENT_PATTERN_OFFSET: DVec2 = DVec2::new(8192.0, -8192.0);

impl<'a> Speckle<'a> {
    /// Returns an independent pattern with equal grains and motion, for indirect light.
    pub(super) fn independent_copy(&self, view: &PoseView) -> Speckle<'a> {
        let far = |fields, shift| {
            let shift = shift + INDEPENDENT_PATTERN_OFFSET;
            SpeckleSource::Frame {
                fields,
                place: PupilPosition {
                    shift,
                    defocus: 0.0,
                },
            }
        };
        let patterns = match &self.patterns {
            SpeckleSource::Frame { fields, place } => far(*fields, place.shift),
            SpeckleSource::Strips { fields, strips } => far(*fields, strips.pupil),
            ring => ring.clone(),
        };
        let map = match &patterns {
            // Fields of a wider pupil are read like fields of the lens's pupil.
            SpeckleSource::Frame { fields, .. } => {
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
            // A ring has only one pattern; its part outside the sensor is used.
            displacement: self.displacement + sensor,
            pupil_scale: None,
        }
    }
}

impl SpeckleSource<'_> {
    /// Returns true if reading requires the surface at each sample.
    pub(super) fn read_surface(&self) -> bool {
        matches!(self, SpeckleSource::Strips { .. })
    }
}

const NO_FIELD: &str =
    "a plan with a coherent lens, or surfaces of different polarisation, has speckle by field";

/// Returns the power of an independent pattern, relative to its power in unpolarised light.
/// `polarised` is the degree of polarisation. Patterns come in pairs of orthogonal polarisation
/// (Goodman 2007, section 3.4).
pub(super) fn power(pattern: usize, polarised: f32) -> f32 {
    match pattern.is_multiple_of(2) {
        true => 1.0 + polarised,
        false => 1.0 - polarised,
    }
}

/// Speckle of a frame, prepared for reading.
pub(super) struct SpeckleSampler<'a> {
    rays: ChiefRays,
    map: GrainMap,
    /// Displacement of the pattern, texels.
    displacement: DVec2,
    source: SamplerSource<'a>,
}

enum SamplerSource<'a> {
    Frame(FrameField),
    Strips {
        field: Box<StripField>,
        references: Box<StripLocator>,
    },
    Ring {
        lookup: &'a SpeckleTexture,
        slice: f64,
    },
}

impl<'a> SpeckleSampler<'a> {
    pub fn new(
        speckle: &Speckle<'a>,
        camera: &Camera,
        camera_from_laser: Rigid,
    ) -> SpeckleSampler<'a> {
        let map = speckle.map;
        let source = match &speckle.patterns {
            &SpeckleSource::Ring { lookup, slice } => SamplerSource::Ring { lookup, slice },
            SpeckleSource::Frame { fields, place } => SamplerSource::Frame(fields.field(place)),
            SpeckleSource::Strips { fields, strips } => {
                let both = strips.strips.map(|reference| reference.strip);
                SamplerSource::Strips {
                    field: Box::new(fields.strips(strips.pupil, strips.along, &both)),
                    references: Box::new(StripLocator::new(
                        &speckle.map,
                        speckle.pupil_scale.unwrap_or(0.0),
                        strips,
                        camera,
                        camera_from_laser,
                    )),
                }
            }
        };
        SpeckleSampler {
            rays: camera.model().chief_rays(),
            map,
            displacement: map.displacement(speckle.displacement),
            source,
        }
    }

    /// Returns the speckle intensity, mean 1, at a sensor position (column, row).
    fn intensity(&self, place: DVec2, seen: TangentPlane) -> f32 {
        let at = self.at(place);
        match &self.source {
            SamplerSource::Frame(field) => field.intensity(at),
            SamplerSource::Strips { .. } if seen == TangentPlane::default() => 0.0,
            SamplerSource::Strips { field, references } => {
                field.intensity(self.texels(references, references.cosines(place, seen)))
            }
            &SamplerSource::Ring { lookup, slice: u } => lookup.intensity(Coordinate {
                s: at.x,
                t: at.y,
                u,
            }),
        }
    }

    /// Returns the speckle intensity for partially polarised light with the given degree of
    /// polarisation. The patterns are simulated for unpolarised light.
    fn intensity_of(&self, place: DVec2, seen: TangentPlane, polarised: f32) -> f32 {
        let sum = |weights: &mut dyn Iterator<Item = f32>, field: &dyn Fn(usize) -> Complex32| {
            let pattern = |(k, weight)| weight * power(k, polarised) * field(k).norm_sqr();
            weights.enumerate().map(pattern).sum()
        };
        match &self.source {
            SamplerSource::Frame(field) => {
                let at = self.at(place);
                sum(&mut field.weights(), &|k| field.amplitude_of(k, at))
            }
            // Samples without a lit surface have no light.
            SamplerSource::Strips { .. } if seen == TangentPlane::default() => 0.0,
            SamplerSource::Strips { field, references } => {
                let at = self.texels(references, references.cosines(place, seen));
                sum(&mut field.weights(), &|k| field.amplitude_of(k, at))
            }
            SamplerSource::Ring { .. } => unreachable!("{NO_FIELD}"),
        }
    }

    /// Returns the weights of the frame field's independent patterns.
    pub fn weights(&self) -> Vec<f32> {
        match &self.source {
            SamplerSource::Frame(field) => field.weights().collect(),
            SamplerSource::Strips { field, .. } => field.weights().collect(),
            SamplerSource::Ring { .. } => unreachable!("{NO_FIELD}"),
        }
    }

    /// Returns the field amplitude of one pattern, of mean square 1, at a sensor position (column,
    /// row).
    pub fn amplitude(&self, pattern: usize, place: DVec2, seen: TangentPlane) -> Complex32 {
        match &self.source {
            SamplerSource::Frame(field) => field.amplitude_of(pattern, self.at(place)),
            SamplerSource::Strips { field, references } => {
                let at = self.texels(references, references.cosines(place, seen));
                field.amplitude_of(pattern, at)
            }
            SamplerSource::Ring { .. } => unreachable!("{NO_FIELD}"),
        }
    }

    /// Returns the reading positions of the strips for the given direction cosines, texels.
    #[inline(always)]
    fn texels(&self, references: &StripLocator, cosines: [DVec2; 2]) -> [DVec2; 2] {
        [0, 1].map(|i| self.map.texels(cosines[i]) + references.offsets[i])
    }

    /// Returns the pattern coordinates (s, t) of a sensor position.
    #[inline(always)]
    fn at(&self, place: DVec2) -> DVec2 {
        self.displacement + self.map.texels(self.rays.cosines(place))
    }

    /// Returns a reader for the pixel around `centre`. `nearby` caches the strip positions of the
    /// pixels above, for any surface.
    #[inline(always)]
    pub fn pixel<'r>(&'r self, centre: DVec2, nearby: &'r mut StripCacheSlot) -> PixelReader<'r> {
        PixelReader {
            reader: self,
            own: match &self.source {
                SamplerSource::Frame(field) => {
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

    /// Returns the speckle intensities, mean 1, at the centres of four adjacent pixels. `first` is
    /// the centre of the first pixel, and all four see the plane `seen`. The pattern coordinates
    /// are linearised over the four pixels. `nearby` caches the strip positions of the groups
    /// above. `None` for rings, or if four pixels exceed the reading range of a field.
    #[inline(always)]
    pub fn side_by_side(
        &self,
        first: DVec2,
        seen: TangentPlane,
        nearby: &mut StripCacheSlot,
    ) -> Option<[f32; 4]> {
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

    /// Returns the texels per column and per row. `None` if a pixel exceeds the reading range of a
    /// field.
    #[inline(always)]
    fn steps(&self, slopes: DMat2) -> Option<[Vec2; 2]> {
        let steps = [slopes.x_axis, slopes.y_axis].map(|slope| self.map.texels(slope));
        let extent = steps[0].abs() + steps[1].abs();
        let is_within = extent.max_element() <= 2.0 * FrameField::REACH;
        is_within.then(|| steps.map(|step| step.as_vec2()))
    }
}

/// Cached strip positions for the plane of the previous sample.
pub(super) struct StripCacheSlot(Option<StripCache>);

impl StripCacheSlot {
    /// Empty cache.
    pub const NONE: StripCacheSlot = StripCacheSlot(None);

    /// Returns the strip positions around the pixel with this centre, which sees the plane `seen`.
    #[inline(always)]
    fn around(
        &mut self,
        references: &StripLocator,
        centre: DVec2,
        seen: TangentPlane,
    ) -> Option<&StripCache> {
        let known = self.0.as_ref().and_then(|around| around.to(centre, seen));
        if known.is_none() {
            self.0 = references.around(centre, seen);
        }
        self.0.as_ref()
    }
}

/// Speckle within a pixel. The pattern coordinates are linearised over the pixel.
pub(super) struct PixelReader<'a> {
    reader: &'a SpeckleSampler<'a>,
    /// Field of the frame, its reading position at the pixel centre, and texels per column and per
    /// row.
    own: Option<(&'a FrameField, DVec2, [Vec2; 2])>,
    centre: DVec2,
    nearby: &'a mut StripCacheSlot,
}

/// Strip field of a pixel, reading position of each strip at the pixel centre, and texels per
/// column and per row.
type StripSample<'a> = (&'a StripField, [DVec2; 2], [[Vec2; 2]; 2]);

impl<'a> PixelReader<'a> {
    /// Returns the intensity, mean 1, at the pixel centre.
    #[inline(always)]
    pub fn middle(&mut self, seen: TangentPlane) -> f32 {
        self.four(f32x4::ZERO, f32x4::ZERO, &[seen], 1).to_array()[0]
    }

    /// Returns the intensities, mean 1, at the first `count` of four positions. `columns` and
    /// `rows` (up to ½) are relative to the pixel centre. The other lanes of the result are
    /// undefined.
    #[inline(always)]
    pub fn four(
        &mut self,
        columns: f32x4,
        rows: f32x4,
        seen: &[TangentPlane],
        count: usize,
    ) -> f32x4 {
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

    /// Returns the intensity, mean 1, at the offset `off` (columns, rows) from the pixel centre,
    /// for light with this degree of polarisation.
    pub fn intensity_at_offset(&self, off: DVec2, seen: TangentPlane, polarised: f32) -> f32 {
        self.reader.intensity_of(self.centre + off, seen, polarised)
    }

    /// Returns the strip field of these samples, its reading positions at the pixel centre, and
    /// texels per column and per row. `None` if the samples see different planes or no plane.
    #[inline(always)]
    fn of_strips(&mut self, seen: &[TangentPlane], count: usize) -> Option<StripSample<'a>> {
        let SamplerSource::Strips { field, references } = &self.reader.source else {
            return None;
        };
        let (&first, others) = seen.get(..count)?.split_first()?;
        if first == TangentPlane::default() || !others.iter().all(|seen| seen.is_on(first)) {
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
    use super::super::speckle_strips::{POSITION_TOLERANCE_TEXELS, StripReference};
    use super::*;
    use crate::camera::fixture;
    use crate::math::{Aperture, DVec3};
    use crate::speckle::frame_field::field_spec;
    use crate::speckle::lookup::Coherence;
    use crate::speckle::motion::{self, SurfaceView};
    use crate::speckle::strips::PupilStrip;

    const DEPTH: f64 = 240.0;

    /// Returns the strips of a pupil that has moved since their reference poses.
    fn strips(fields: &FrameFields, camera: &Camera) -> StripReferences {
        let (way, width) = (0.4, fields.strip_width());
        let moved = DVec3::new(0.3, -0.2, 0.1);
        StripReferences {
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
            strips: PupilStrip::numbers(way, width).map(|number| StripReference {
                strip: PupilStrip {
                    number,
                    reference: DVec2::X * PupilStrip::middle(number, width),
                    defocus: 0.0,
                    phasor_offset: DVec2::ZERO,
                },
                then_from_now: Rigid::from_euler_xyz(DVec3::splat(1e-4), moved),
                displacement: DVec2::ZERO,
            }),
        }
    }

    /// Groups of four adjacent pixels are read like separate positions, for one field and for
    /// strips on a tilted surface. The reading position has an error of up to
    /// [`POSITION_TOLERANCE_TEXELS`] texels along either axis, or r = √2 times that in grains. The
    /// mean-square error of intensities is 2·(1 − μ²), where 1 − μ² = (πr)²/4 for a round pupil and
    /// small r.
    #[test]
    fn four_pixels_side_by_side_are_read_as_each_by_itself() {
        let camera = fixture();
        let spec = field_spec(1, Aperture::Circle);
        let fields = FrameFields::new(&spec, Coherence::FULL).unwrap();
        let grain = camera.speckle_angle(660e-6);
        let map = fields.map(grain, camera.lens.image_distance());
        let missed = POSITION_TOLERANCE_TEXELS * 2f64.sqrt() / spec.texels_per_speckle;
        // 2·(πr)²/4.
        let limit = ((std::f64::consts::PI * missed).powi(2) / 2.0) as f32;
        let place = PupilPosition {
            shift: DVec2::new(0.4, 0.0),
            defocus: 0.0,
        };
        let fields = &fields;
        let of_strips = SpeckleSource::Strips {
            fields,
            strips: Box::new(strips(fields, &camera)),
        };
        let normal = DVec3::new(0.2, 0.4, -1.0).normalize();
        let seen = TangentPlane {
            normal,
            distance: normal.z * DEPTH,
        };
        for patterns in [SpeckleSource::Frame { fields, place }, of_strips] {
            let speckle = Speckle {
                patterns,
                map,
                displacement: DVec2::ZERO,
                pupil_scale: None,
            };
            let reader = SpeckleSampler::new(&speckle, &camera, Rigid::IDENTITY);
            let (mut missed_by, mut apart) = (0.0, 0.0);
            let (fours, rows) = (20, 50);
            for four in 0..fours {
                let mut nearby = StripCacheSlot::NONE;
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

//! Direct light at the samples, without speckle. The stages are: camera ray, first hit, laser light
//! at the hit, shadow ray to the aperture point of that light, BRDF, and solid angle of the pupil.

use super::PoseView;
use super::defocus::{self, DefocusMap};
use super::irradiance::Irradiance;
use super::pinhole::PinholeGeometry;
use super::pixel_mask::{PixelMask, PixelNumbering, SIDE, middle};
use super::pixel_quadrature::{PixelQuadrature, QuadratureNodes};
use super::planar_pixel::PlanarBeamProfile;
use super::rays::{BeamSample, CameraRayCaster, PixelHit, Rays, SurfaceElement};
use super::speckle_strips::TangentPlane;
use super::tile_classification::{TileClassification, TileHitCache};
use crate::accel::WIDTH;
use crate::math::{DVec2, DVec3};
use rayon::prelude::*;
use std::f64::consts::SQRT_2;
use std::ops::Range;

/// Sampling strategy: how the samples of a pixel find the visible surface.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema,
)]
#[serde(rename_all = "kebab-case")]
pub enum Sampling {
    /// One ray per sample; the reference for the other strategy.
    #[serde(rename = "per-sample")]
    Rays,
    /// One ray per pixel where the surface is planar, otherwise one ray per sample.
    ///
    /// A pixel is planar if the rays through its centre and its eight neighbours' centres hit one
    /// plane under the same illumination. Surface and laser must also be constant over the pixel.
    /// The samples then lie on that plane, and their light differs only by the laser profile across
    /// the line.
    ///
    /// A pixel is dark if none of the nine rays hits lit surface. In addition, they must not hit
    /// surface beyond the cut-off on both sides of the laser plane. Details thinner than a pixel
    /// are lost if all nine rays miss them.
    #[serde(rename = "planar")]
    Planes,
    /// Exact rows of every facet in the laser light, at one or more column positions of each column.
    /// Rays only determine which rows are visible.
    ///
    /// It requires a line laser, a lens without distortion, and diffuse surfaces with one degree of
    /// polarisation. Columns with more than ten facets per lit pixel, columns nearly parallel to the
    /// line, and views with surface behind the lens are sampled as `planar`.
    PlaneCut,
}

/// Mean laser light on the sensor without speckle, at the samples of the pixels that may be lit.
pub struct DirectIrradiance {
    pub(super) rows: PixelNumbering,
    pub(super) nodes: QuadratureNodes,
    /// Irradiance, mW/mm², pixel by pixel and sample by sample.
    pub(super) irradiance: Vec<f32>,
    /// Plane hit by each sample, or by each pixel; empty if speckle does not depend on it.
    pub(super) surface: Vec<TangentPlane>,
    /// β of the surface at each sample, which determines its blur (see
    /// [`super::blur`](super::blur())); empty without blur.
    pub(super) blur: Vec<f32>,
    /// Offset of each sample by [`super::pupil_centroid_shift`](super::skew()), columns and rows;
    /// empty without offsets.
    pub(super) pupil_centroid_shift: Vec<[f32; 2]>,
    /// Degree of polarisation of each sample; empty if it is constant.
    pub(super) degree_of_polarisation: Vec<f32>,
}

impl DirectIrradiance {
    /// Returns the mean irradiance (mW/mm²) at a pixel's samples; pixels are numbered row by row.
    pub(super) fn samples(&self, pixel: usize) -> &[f32] {
        let count = self.nodes.places().len();
        &self.irradiance[count * pixel..count * (pixel + 1)]
    }

    /// Returns the planes of a pixel's samples, or its single plane; empty if speckle does not
    /// depend on them.
    pub(super) fn tangent_planes(&self, pixel: usize) -> &[TangentPlane] {
        let count = self.surface.len() / self.rows.total().max(1);
        self.surface
            .get(count * pixel..count * (pixel + 1))
            .unwrap_or(&[])
    }

    /// Returns the degrees of polarisation of a pixel's samples; empty if all light has the same.
    pub(super) fn degree_of_polarisation(&self, pixel: usize) -> &[f32] {
        let count = self.nodes.places().len();
        self.degree_of_polarisation
            .get(count * pixel..count * (pixel + 1))
            .unwrap_or(&[])
    }

    /// Returns β of a pixel's samples; see [`super::blur`](super::blur()).
    pub(super) fn blur(&self, pixel: usize) -> &[f32] {
        let count = self.nodes.places().len();
        &self.blur[count * pixel..count * (pixel + 1)]
    }

    /// Builds blurred light at the `nodes` of these pixels, sample by sample, with the given
    /// planes.
    pub(super) fn from_blurred(
        rows: PixelNumbering,
        nodes: QuadratureNodes,
        irradiance: Vec<f32>,
        surface: Vec<TangentPlane>,
    ) -> DirectIrradiance {
        DirectIrradiance {
            rows,
            nodes,
            irradiance,
            surface,
            blur: Vec::new(),
            pupil_centroid_shift: Vec::new(),
            degree_of_polarisation: Vec::new(),
        }
    }

    /// Returns column, row, and mean irradiance (mW/mm²) at the samples of every pixel that may be
    /// lit, row by row.
    pub fn pixels(&self) -> impl Iterator<Item = (usize, usize, &[f32])> {
        let rows = (0..self.rows.pixels.rows).flat_map(|row| {
            let columns = self.rows.pixels.of(row).zip(self.rows.start(row)..);
            columns.map(move |(column, pixel)| (column, row, pixel))
        });
        rows.map(|(column, row, pixel)| (column, row, self.samples(pixel)))
    }

    /// Replaces the values of the pixels of `other`, which has the same samples. Pixels that are not
    /// in `self` are ignored.
    pub(super) fn replace(&mut self, other: &DirectIrradiance) {
        let count = self.nodes.places().len();
        for row in 0..other.rows.pixels.rows {
            for (column, from) in other.rows.pixels.of(row).zip(other.rows.start(row)..) {
                let Some(to) = self.rows.number(row, column) else {
                    continue;
                };
                self.irradiance[count * to..count * (to + 1)].copy_from_slice(other.samples(from));
                let planes = other.tangent_planes(from);
                let size = planes.len();
                self.surface[size * to..size * (to + 1)].copy_from_slice(planes);
                if !self.blur.is_empty() {
                    self.blur[count * to..count * (to + 1)].copy_from_slice(other.blur(from));
                }
            }
        }
    }

    /// Builds light that is uniform within each pixel.
    pub(super) fn even(mean: &Irradiance, grid: PixelQuadrature) -> DirectIrradiance {
        let nodes = QuadratureNodes::new(grid);
        let count = nodes.places().len();
        let values = mean.values().iter();
        let irradiance = values.flat_map(|&e| std::iter::repeat_n(e, count));
        DirectIrradiance::from_blurred(mean.rows.clone(), nodes, irradiance.collect(), Vec::new())
    }

    /// Adds blurred indirect light, given as the mean irradiance of each pixel (mW/mm²). Pixels
    /// without direct light may have indirect light.
    pub fn with_indirect(self, indirect: &Irradiance) -> DirectIrradiance {
        debug_assert!(self.blur.is_empty());
        let count = self.nodes.places().len();
        let mut pixels = self.rows.pixels.clone();
        for row in 0..pixels.rows {
            for (column, _) in indirect.row(row) {
                pixels.insert(row, column, column);
            }
        }
        let rows = PixelNumbering::new(pixels);
        let mut irradiance = vec![0.0; count * rows.total()];
        let of_surface = self.surface.len() / self.rows.total().max(1);
        let mut surface = vec![TangentPlane::default(); rows.total() * of_surface];
        let mut polarised = vec![
            0.0;
            if self.degree_of_polarisation.is_empty() {
                0
            } else {
                irradiance.len()
            }
        ];
        for row in 0..rows.pixels.rows {
            let mut direct = self
                .rows
                .pixels
                .of(row)
                .zip(self.rows.start(row)..)
                .peekable();
            let mut more = indirect.row(row).peekable();
            for (column, pixel) in rows.pixels.of(row).zip(rows.start(row)..) {
                let samples = count * pixel..count * (pixel + 1);
                if let Some((_, from)) = direct.next_if(|&(c, _)| c == column) {
                    irradiance[samples.clone()].copy_from_slice(self.samples(from));
                    if !surface.is_empty() {
                        let seen = of_surface * pixel..of_surface * (pixel + 1);
                        surface[seen].copy_from_slice(self.tangent_planes(from));
                    }
                    if !polarised.is_empty() {
                        polarised[samples.clone()]
                            .copy_from_slice(self.degree_of_polarisation(from));
                    }
                }
                if let Some((_, e)) = more.next_if(|&(c, _)| c == column) {
                    irradiance[samples]
                        .iter_mut()
                        .for_each(|sample| *sample += e);
                }
            }
        }
        DirectIrradiance {
            rows,
            irradiance,
            surface,
            degree_of_polarisation: polarised,
            ..self
        }
    }
}

/// Tile rows per task. The cost of two additional rows at the ends is then small, and there are
/// enough tasks for all threads.
const BANDS_PER_TASK: usize = 32;

/// Computes the light at the samples of these pixels. Each sample is computed independently, so the
/// result is byte-identical for any number of threads.
pub fn light(view: &PoseView, pixels: PixelMask) -> DirectIrradiance {
    let sight = PinholeGeometry::new(view.camera, &view.part_from_camera);
    let speckle = view.speckle.as_ref();
    let spread = DefocusMap::new(view);
    let frame = LightFrame {
        rays: CameraRayCaster::new(view, &sight, spread.is_some()),
        rows: PixelNumbering::new(pixels),
        nodes: QuadratureNodes::new(defocus::grid(view)),
        reads_surface: speckle.is_some_and(|speckle| speckle.patterns.read_surface()),
        spread,
    };
    let count = frame.nodes.places().len();
    let mut irradiance = vec![0.0; count * frame.rows.total()];
    let of_surface = count * usize::from(frame.reads_surface);
    let mut surface = vec![TangentPlane::default(); of_surface * frame.rows.total()];
    let of_blur = count * usize::from(frame.spread.is_some());
    let mut blur = vec![0.0; of_blur * frame.rows.total()];
    let skewed = frame.spread.is_some() && frame.rays.is_glossy();
    let of_skew = count * usize::from(skewed);
    let mut skew = vec![[0.0; 2]; of_skew * frame.rows.total()];
    let of_polarised =
        count * usize::from(speckle.is_some() && view.surface.polarisation_differs());
    let mut polarised = vec![0.0; of_polarised * frame.rows.total()];
    let mut tasks = Vec::new();
    let (mut irradiance_left, mut surface_left) = (&mut irradiance[..], &mut surface[..]);
    let (mut blur_left, mut skew_left) = (&mut blur[..], &mut skew[..]);
    let mut polarised_left = &mut polarised[..];
    for first in (0..frame.rows.pixels.bands()).step_by(BANDS_PER_TASK) {
        let rows = frame.rows_of(first);
        let pixels = frame.rows.range(rows.start).start..frame.rows.start(rows.end);
        let (mine, others) = irradiance_left.split_at_mut(count * pixels.len());
        let (my_surface, other_surface) = surface_left.split_at_mut(of_surface * pixels.len());
        let (my_blur, other_blur) = blur_left.split_at_mut(of_blur * pixels.len());
        let (my_skew, other_skew) = skew_left.split_at_mut(of_skew * pixels.len());
        (irradiance_left, surface_left) = (others, other_surface);
        (blur_left, skew_left) = (other_blur, other_skew);
        let my_polarised;
        (my_polarised, polarised_left) = polarised_left.split_at_mut(of_polarised * pixels.len());
        tasks.push(BandTask {
            first_band: first,
            first_pixel: pixels.start,
            irradiance: mine,
            surface: my_surface,
            blur: my_blur,
            pupil_centroid_shift: my_skew,
            degree_of_polarisation: my_polarised,
        });
    }
    tasks
        .into_par_iter()
        .for_each_init(TileHitCache::default, |window, task| {
            frame.render(task, window)
        });
    DirectIrradiance {
        irradiance,
        surface,
        blur,
        pupil_centroid_shift: skew,
        degree_of_polarisation: polarised,
        rows: frame.rows,
        nodes: frame.nodes,
    }
}

/// Tile rows, and the slices for their results.
struct BandTask<'a> {
    first_band: usize,
    /// Index of the first pixel.
    first_pixel: usize,
    /// Irradiance of the samples, initially zero.
    irradiance: &'a mut [f32],
    surface: &'a mut [TangentPlane],
    blur: &'a mut [f32],
    pupil_centroid_shift: &'a mut [[f32; 2]],
    degree_of_polarisation: &'a mut [f32],
}

/// View with values that its pixels have in common.
struct LightFrame<'a> {
    rays: CameraRayCaster<'a>,
    rows: PixelNumbering,
    nodes: QuadratureNodes,
    /// True if speckle depends on the surface at each sample.
    reads_surface: bool,
    /// Defocus of the samples; `None` without blur.
    spread: Option<DefocusMap>,
}

/// Pixel to be sampled.
#[derive(Clone, Copy)]
struct PixelTask {
    centre: DVec2,
    number: usize,
}

/// Half side of a pixel, pixels.
const HALF_A_PIXEL: f64 = 0.5;

/// Columns and rows of pixels whose samples are traced together if there are few samples per pixel.
const BLOCK: usize = 2;

impl LightFrame<'_> {
    fn bands_of(&self, first: usize) -> Range<usize> {
        first..(first + BANDS_PER_TASK).min(self.rows.pixels.bands())
    }

    fn rows_of_band(&self, band: usize) -> Range<usize> {
        SIDE * band..(SIDE * (band + 1)).min(self.rows.pixels.rows)
    }

    /// Returns the rows of the task that begins with this tile row.
    fn rows_of(&self, first: usize) -> Range<usize> {
        SIDE * first..self.rows_of_band(self.bands_of(first).end - 1).end
    }

    fn render(&self, mut task: BandTask, window: &mut TileHitCache) {
        if task.irradiance.is_empty() {
            return;
        }
        let pixels = &self.rows.pixels;
        // Number of neighbouring pixels whose centre rays affect a pixel.
        let around = match (self.rays.view.sampling, self.nodes.places().len()) {
            (_, 1) => 0,
            (Sampling::Planes | Sampling::PlaneCut, _) => 1,
            (Sampling::Rays, _) => {
                for row in self.rows_of(task.first_band) {
                    self.rays.view.unwind_if_stopped();
                    for (column, number) in pixels.of(row).zip(self.rows.start(row)..) {
                        let centre = middle(column, row);
                        self.sampled(&[PixelTask { centre, number }], 1, &mut task);
                    }
                }
                return;
            }
        };
        let bands = self.bands_of(task.first_band);
        let mut next = bands.start.saturating_sub(around);
        for band in bands {
            self.rays.view.unwind_if_stopped();
            while next <= band + around && next < pixels.bands() {
                let tiles = pixels.tiles(next, around);
                window.fill(next, tiles, |first, tile| {
                    let wanted = pixels.near_in_tile(next, first, around);
                    self.rays.centers(next, first, wanted, HALF_A_PIXEL, tile)
                });
                next += 1;
            }
            // Index of the next pixel of each row.
            let mut numbers = [0; SIDE];
            for (number, row) in numbers.iter_mut().zip(self.rows_of_band(band)) {
                *number = self.rows.start(row);
            }
            for first in pixels.tiles(band, 0) {
                self.tile(band, first, around, window, &mut numbers, &mut task);
            }
        }
    }

    /// Computes the light of a tile's pixels. `next` holds the index of the next pixel of each row
    /// and is advanced.
    fn tile(
        &self,
        band: usize,
        first: usize,
        around: usize,
        window: &TileHitCache,
        next: &mut [usize; SIDE],
        task: &mut BandTask,
    ) {
        let wanted = self.rows.pixels.near_in_tile(band, first, 0);
        let size = [self.rows.pixels.columns, self.rows.pixels.rows];
        let TileClassification { dark, flat } = match around {
            0 => TileClassification {
                dark: 0,
                flat: wanted,
            },
            _ => {
                let is_sheet = self.rays.view.laser.fan.is_some();
                let turn = self.rays.max_normal_change_rad();
                let mut sorted = window.sorted(band, first, size, wanted, is_sheet, turn);
                if self.rays.are_mixed() {
                    sorted.flat = window.of_one_kind(band, first, size, sorted.flat);
                }
                sorted
            }
        };
        let pixels: [PixelTask; WIDTH] = std::array::from_fn(|i| {
            let number = next[i / SIDE];
            next[i / SIDE] += usize::from(wanted >> i & 1);
            PixelTask {
                centre: middle(first + i % SIDE, SIDE * band + i / SIDE),
                number,
            }
        });
        let met = window.tile(band, first);
        let mut apart = wanted & !(dark | flat);
        for i in (0..WIDTH).filter(|i| flat >> i & 1 == 1) {
            match &met[i] {
                PixelHit::Lit(lit, plane) => {
                    let is_done = self.shade_planar_pixel(pixels[i], lit, plane, around > 0, task);
                    apart |= u16::from(!is_done) << i;
                }
                PixelHit::NeedsSubsampling(_) => apart |= 1 << i,
                _ => {}
            }
        }
        self.trace_each_sample(&pixels, apart, task);
    }

    /// Computes the light of a pixel on a plane from its centre ray. If `asked`, returns false
    /// where surface and laser are not constant over the pixel.
    fn shade_planar_pixel(
        &self,
        pixel: PixelTask,
        lit: &BeamSample,
        plane: &SurfaceElement,
        asked: bool,
        task: &mut BandTask,
    ) -> bool {
        let Some(profile) = PlanarBeamProfile::new(pixel.centre, lit.radius, plane, &self.rays)
        else {
            return true;
        };
        if asked && !profile.is_constant(plane, &self.rays) {
            return false;
        }
        let own = self.samples(pixel, task);
        let irradiance = lit.irradiance as f32;
        let samples = &mut task.irradiance[own.clone()];
        if profile.steepness() > self.nodes.steepest {
            for (sample, cell) in samples.iter_mut().zip(self.nodes.cells()) {
                *sample = profile.mean(cell.centre, cell) * irradiance;
            }
        } else {
            for (four, samples) in self.nodes.quads().iter().zip(samples.chunks_mut(4)) {
                let shares = profile.profile_weights(four) * irradiance;
                samples.copy_from_slice(&shares.to_array()[..samples.len()]);
            }
        }
        if self.reads_surface {
            task.surface[own.clone()].fill(TangentPlane::new(plane));
        }
        if let Some(spread) = &self.spread {
            task.blur[own.clone()].fill(spread.blur(
                &self.rays.pinhole_in_laser,
                pixel.centre,
                plane,
            ));
        }
        if !task.degree_of_polarisation.is_empty() {
            task.degree_of_polarisation[own.clone()].fill(self.rays.degree_of_polarisation(plane));
        }
        if let (Some(gloss), false) = (self.rays.gloss(plane), task.pupil_centroid_shift.is_empty())
        {
            task.pupil_centroid_shift[own]
                .fill(gloss.pupil_centroid_shift(pixel.centre, [plane.point, plane.normal]));
        }
        true
    }

    /// Returns the light at a sample with a separate ray, relative to the light on the beam axis.
    ///
    /// The sample has the position `place`, which is at `off` from the pixel's centre, and the
    /// index `number` in the pixel. If the profile is too steep for a point sample, the result is
    /// the mean over the cell of the sample.
    fn profile_mean(
        &self,
        place: DVec2,
        off: DVec2,
        towards: DVec3,
        (lit, plane): (&BeamSample, &SurfaceElement),
        number: usize,
    ) -> f64 {
        // The bound holds for a pinhole. A distorting lens stretches the image by a factor below
        // two.
        let distance = plane
            .point
            .distance(self.rays.pinhole_in_laser.camera_center);
        let change =
            2.0 * SQRT_2 * distance * self.rays.max_beam_offset_gradient(plane, towards, 1.0);
        if change <= self.nodes.steepest as f64 * lit.radius {
            return lit.share();
        }
        match PlanarBeamProfile::new(place, lit.radius, plane, &self.rays) {
            Some(profile) if profile.steepness() > self.nodes.steepest => {
                let cell = &self.nodes.cells()[number];
                profile.mean(cell.centre - off, cell) as f64
            }
            _ => lit.share(),
        }
    }

    /// Returns the range of a pixel's samples in a task.
    fn samples(&self, pixel: PixelTask, task: &BandTask) -> Range<usize> {
        let count = self.nodes.places().len();
        let first = count * (pixel.number - task.first_pixel);
        first..first + count
    }

    /// Computes the light of the `wanted` pixels (bit mask) of a tile with one ray per sample. Like
    /// tiles, packets do not depend on which pixels are wanted.
    fn trace_each_sample(&self, tile: &[PixelTask; WIDTH], wanted: u16, task: &mut BandTask) {
        let side = match self.nodes.places().len() * BLOCK * BLOCK <= WIDTH {
            true => BLOCK,
            false => 1,
        };
        let on_sensor = self.rays.view.camera.sensor.resolution.as_dvec2();
        let corners = (0..WIDTH)
            .filter(|i| (i % SIDE).is_multiple_of(side) && (i / SIDE).is_multiple_of(side));
        for corner in corners {
            let mut block = [tile[corner]; BLOCK * BLOCK];
            let (mut count, mut bits) = (0, 0);
            for i in (0..side * side).map(|i| corner + i / side * SIDE + i % side) {
                if tile[i].centre.cmplt(on_sensor).all() {
                    block[count] = tile[i];
                    bits |= (wanted >> i & 1) << count;
                    count += 1;
                }
            }
            if bits != 0 {
                self.sampled(&block[..count], bits, task);
            }
        }
    }

    /// Redirects rays of samples outside the beam cut-off to the brightest position of their cells,
    /// if the cell may receive light.
    ///
    /// Samples are numbered from `first`. The light is then evaluated with a separate ray, which
    /// determines surface and shadow.
    fn aim_at_beam(
        &self,
        first: usize,
        pixels: &[PixelTask],
        places: &mut [DVec2; WIDTH],
        rays: &mut Rays,
        met: &mut [PixelHit],
    ) {
        let count = self.nodes.places().len();
        let mut aimed = 0;
        for i in 0..met.len() {
            let PixelHit::NeedsSubsampling(plane) = &met[i] else {
                continue;
            };
            let cell = &self.nodes.cells()[(first + i) % count];
            let middle = pixels[(first + i) / count].centre + cell.centre;
            // The radius scales the profile without moving its axis.
            let radius = self.rays.view.laser.beam.waist_radius;
            if let Some(profile) = PlanarBeamProfile::new(places[i], radius, plane, &self.rays) {
                places[i] += profile.brightest(middle - places[i], cell.half);
                let mut bend = DVec2::ZERO;
                let to_sensor = self.rays.pinhole.to_sensor(places[i]);
                rays[i] = self
                    .rays
                    .ray(self.rays.pinhole.towards(to_sensor, &mut bend));
                aimed |= 1 << i;
            }
        }
        if aimed == 0 {
            return;
        }
        let mut seen = [const { PixelHit::Nothing }; WIDTH];
        (self.rays).trace_packet(&places[..met.len()], rays, aimed, 0.0, &mut seen);
        for i in (0..met.len()).filter(|i| aimed >> i & 1 == 1) {
            met[i] = seen[i];
        }
    }

    /// Computes the light of the `wanted` pixels (bit mask) among up to [`BLOCK`]² pixels, with one
    /// ray per sample.
    fn sampled(&self, pixels: &[PixelTask], wanted: u16, task: &mut BandTask) {
        let sight = self.rays.pinhole;
        let samples = self.nodes.places();
        let reach = self.nodes.reach();
        let all = samples.len() * pixels.len();
        let mut bend = DVec2::ZERO;
        // Iterates over the samples of all pixels in sequence.
        for first in (0..all).step_by(WIDTH) {
            let chunk = first..(first + WIDTH).min(all);
            let mut places = [DVec2::ZERO; WIDTH];
            let mut rays = Rays::new();
            let mut rays_wanted = 0;
            for (i, ray) in chunk.clone().enumerate() {
                let (pixel, sample) = (ray / samples.len(), ray % samples.len());
                if sample == 0 {
                    bend = DVec2::ZERO;
                }
                places[i] = pixels[pixel].centre + samples[sample];
                let towards = sight.towards(sight.to_sensor(places[i]), &mut bend);
                rays.push(self.rays.ray(towards));
                rays_wanted |= (wanted >> pixel & 1) << i;
            }
            let mut met = [const { PixelHit::Nothing }; WIDTH];
            (self.rays).trace_packet(&places[..chunk.len()], &rays, rays_wanted, reach, &mut met);
            self.aim_at_beam(
                first,
                pixels,
                &mut places,
                &mut rays,
                &mut met[..chunk.len()],
            );
            for (ray, met) in chunk.zip(&met) {
                if let PixelHit::Lit(lit, plane) = met {
                    let pixel = pixels[ray / samples.len()];
                    let number = ray % samples.len();
                    let sample = self.samples(pixel, task).start + number;
                    let (place, towards) = (places[ray - first], rays[ray - first].direction);
                    let off = place - pixel.centre;
                    let share = self.profile_mean(place, off, towards, (lit, plane), number);
                    task.irradiance[sample] = (lit.irradiance * share) as f32;
                    if self.reads_surface {
                        task.surface[sample] = TangentPlane::new(plane);
                    }
                    if let Some(spread) = &self.spread {
                        task.blur[sample] =
                            spread.blur(&self.rays.pinhole_in_laser, places[ray - first], plane);
                    }
                    if !task.degree_of_polarisation.is_empty() {
                        task.degree_of_polarisation[sample] =
                            self.rays.degree_of_polarisation(plane);
                    }
                    if let (Some(gloss), false) =
                        (self.rays.gloss(plane), task.pupil_centroid_shift.is_empty())
                    {
                        task.pupil_centroid_shift[sample] = gloss
                            .pupil_centroid_shift(places[ray - first], [plane.point, plane.normal]);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::accel::Accel;
    use crate::camera::fixture;
    use crate::frame::{DefocusSettings, TracedRegion, blur, expose, footprint};
    use crate::laser::{Beam, CUTOFF_RADII, Fan, FanProfile, Laser};
    use crate::math::{DVec3, Rigid};
    use crate::mesh::shapes;
    use crate::surface::Lambert;
    use rustfft::FftPlanner;
    use rustfft::num_complex::Complex;

    /// Position of the camera.
    const BESIDE: DVec3 = DVec3::new(0.0, -120.0, 208.0);

    /// Calls `then` with a view of a laser line on a plane that the camera sees at 30° to the beam.
    fn line(grid: PixelQuadrature, sampling: Sampling, then: impl FnOnce(&PoseView)) {
        line_on(DVec3::Z, grid, sampling, CUTOFF_RADII, then);
    }

    /// Calls `then` with a view of a laser line on a plane with this normal.
    fn line_on(
        normal: DVec3,
        grid: PixelQuadrature,
        sampling: Sampling,
        beam_cutoff_radii: f64,
        then: impl FnOnce(&PoseView),
    ) {
        let turn = Rigid::from_z_and_x(DVec3::ZERO, normal, DVec3::Y).unwrap();
        let mesh = shapes::plane(DVec2::splat(60.0)).unwrap();
        let accel = Accel::build(&mesh.into(), 1).unwrap();
        let laser = Laser {
            beam: Beam {
                wavelength: 660e-6,
                power_mw: 5.0,
                waist_radius: 0.2,
                waist_distance: 200.0,
                m_squared: 1.0,
            },
            fan: Some(Fan {
                angle: 0.3,
                profile: FanProfile::Uniform,
            }),
        };
        let looking =
            |from: DVec3| turn.inverse() * Rigid::from_z_and_x(from, -from, DVec3::X).unwrap();
        then(&PoseView {
            accel: &accel,
            surface: Lambert { reflectance: 0.5 }.into(),
            laser: &laser,
            part_from_laser: looking(DVec3::Z * 200.0),
            camera: &fixture(),
            part_from_camera: looking(BESIDE),
            speckle: None,
            grid,
            sampling,
            beam_cutoff_radii,
            lens: DefocusSettings::NONE,
            indirect: None,
            stop: None,
        });
    }

    /// A line is found if it lies between two pixel centres that are both outside the cut-off. The
    /// camera sees the wall at grazing angles of 2° to 3°. Light ignored beyond two radii is at
    /// most e^(−2·1.75²) of the brightest sample for each of 18 samples, 0.04 in total. At least
    /// three samples of the brightest row have half of the brightest value. The error is therefore
    /// below 0.03 of the light in that row.
    #[test]
    fn a_line_between_two_centres_is_seen() {
        for angle in [0.035, 0.0525] {
            let wall = DVec3::X + BESIDE.normalize() * angle;
            let rows = |sampling| {
                let mut sums = Vec::new();
                line_on(
                    wall,
                    PixelQuadrature::Gauss { per_side: 3 },
                    sampling,
                    2.0,
                    |view| {
                        let light = light(view, footprint(view, &TracedRegion::All));
                        sums = vec![0.0; light.rows.pixels.rows];
                        for (_, row, samples) in light.pixels() {
                            sums[row] += samples.iter().map(|&e| e as f64).sum::<f64>();
                        }
                    },
                );
                sums
            };
            let (planes, rays) = (rows(Sampling::Planes), rows(Sampling::Rays));
            let brightest = rays.iter().copied().fold(0.0, f64::max);
            let lit = rays.iter().filter(|&&sum| sum > 0.1 * brightest);
            assert!(lit.count() > 100);
            for (a, b) in planes.iter().zip(&rays) {
                assert!((a - b).abs() < 0.03 * brightest, "{angle}: {a} {b}");
            }
        }
    }

    /// Returns the leftmost samples of each pixel in one column of pixels, row by row.
    fn along_column(light: &DirectIrradiance, column: usize, per_side: usize) -> Vec<f64> {
        let pixels = light.pixels().filter(|&(c, _, _)| c == column);
        let of_pixel = |samples: &[f32]| -> Vec<f64> {
            let column = samples.chunks(per_side).map(|row| row[0] as f64);
            column.collect()
        };
        pixels
            .flat_map(|(_, _, samples)| of_pixel(samples))
            .collect()
    }

    /// Returns the maximum of the spectrum above `from` cycles per pixel, as a fraction of its
    /// global maximum.
    fn above(values: &[f64], per_pixel: usize, from: f64) -> f64 {
        let mut spectrum: Vec<Complex<f64>> = values.iter().map(|&v| v.into()).collect();
        FftPlanner::new()
            .plan_fft_forward(values.len())
            .process(&mut spectrum);
        let half = &spectrum[..values.len() / 2];
        let first = (from * values.len() as f64 / per_pixel as f64).ceil() as usize;
        let most = half[first..].iter().map(|c| c.norm()).fold(0.0, f64::max);
        most / half[0].norm()
    }

    /// A uniform grid has no aliases at one cycle per pixel. The spectrum of a Gaussian with
    /// standard deviation σ pixels falls to exp(−2π²σ²f²) at f cycles per pixel. At one cycle, it
    /// is below the resolution of f32 for σ > 1 if samples are uniform across pixels.
    /// Gauss–Legendre nodes are not uniform. Treated as uniform, they produce a spectrum of the
    /// order of their displacement.
    #[test]
    fn an_even_grid_can_be_transformed() {
        let per_side = 4;
        let column = 320;
        for (grid, even) in [
            (PixelQuadrature::Even { per_side }, true),
            (PixelQuadrature::Gauss { per_side }, false),
        ] {
            for sampling in [Sampling::Planes, Sampling::Rays] {
                line(grid, sampling, |view| {
                    let light = light(view, footprint(view, &TracedRegion::All));
                    let values = along_column(&light, column, per_side as usize);
                    let mean = values.iter().sum::<f64>();
                    let centre = |power: i32| {
                        let moment = |(i, v): (usize, &f64)| v * (i as f64).powi(power);
                        values.iter().enumerate().map(moment).sum::<f64>() / mean
                    };
                    let sigma = (centre(2) - centre(1).powi(2)).sqrt() / per_side as f64;
                    assert!((1.0..8.0).contains(&sigma), "{sigma}");
                    let share = above(&values, per_side as usize, 0.9);
                    // For significant light, the exponent is up to 10. It is rounded in f32, which
                    // gives a relative error of 10·2⁻²⁴.
                    assert_eq!(share < 1e-6, even, "{grid:?} {sampling:?} {share}");
                });
            }
        }
    }

    /// Both kinds of grid integrate the line to equal light, and simulation without blur preserves
    /// it.
    #[test]
    fn all_grids_have_the_same_light() {
        let total = |grid, sampling| {
            let mut sum = 0.0;
            line(grid, sampling, |view| {
                let light = blur(
                    light(view, footprint(view, &TracedRegion::All)),
                    view,
                    &TracedRegion::All,
                );
                let image = expose(light, view).dense();
                sum = image.iter().map(|&e| e as f64).sum::<f64>();
            });
            sum
        };
        let full = total(PixelQuadrature::Gauss { per_side: 6 }, Sampling::Rays);
        for (grid, sampling) in [
            (PixelQuadrature::Gauss { per_side: 3 }, Sampling::Planes),
            (PixelQuadrature::Even { per_side: 4 }, Sampling::Planes),
            (PixelQuadrature::Even { per_side: 4 }, Sampling::Rays),
        ] {
            // Tolerance: f32 rounding of up to 16 samples and of their sum.
            let ratio = total(grid, sampling) / full;
            assert!((ratio - 1.0).abs() < 1e-5, "{grid:?} {sampling:?} {ratio}");
        }
    }

    /// Indirect light is added pixel by pixel, also where there is no direct light.
    #[test]
    fn indirect_light_is_added_by_pixel() {
        let grid = PixelQuadrature::Gauss { per_side: 2 };
        line(grid, Sampling::Planes, |view| {
            let resolution = view.camera.sensor.resolution;
            let mut pixels = PixelMask::none(resolution);
            pixels.insert(3, 5, 6);
            let middle = (resolution / 2).as_usizevec2();
            pixels.insert(middle.y, middle.x, middle.x);
            let more = Irradiance::new(PixelNumbering::new(pixels), vec![1.0, 2.0, 3.0]);
            let direct = || light(view, footprint(view, &TracedRegion::All));
            let alone = expose(direct(), view).dense();
            let both = expose(direct().with_indirect(&more), view).dense();
            let more = more.dense();
            for ((both, alone), more) in both.iter().zip(&alone).zip(&more) {
                assert!((both - (alone + more)).abs() <= 4.0 * f32::EPSILON * both);
            }
            assert_eq!(more.iter().filter(|&&e| e > 0.0).count(), 3);
        });
    }
}

//! Light that goes laser → surface → camera, sample by sample: camera ray, closest hit,
//! laser light there, shadow ray to the aperture point it came from, reflection, pupil
//! solid angle. No speckle yet.

use super::View;
use super::defocus::{self, Spread};
use super::flat::Profile;
use super::grid::{Grid, Nodes};
use super::irradiance::Irradiance;
use super::pixels::{Pixels, Rows, SIDE, middle};
use super::rays::{Lit, LitRays, Met, Plane, Rays};
use super::reference::Seen;
use super::sight::Sight;
use super::window::{Sorted, Window};
use crate::accel::WIDTH;
use crate::math::{DVec2, DVec3};
use rayon::prelude::*;
use std::f64::consts::SQRT_2;
use std::ops::Range;

/// How the samples of a pixel come by the surface they see.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Sampling {
    /// A ray for each: the oracle of the other.
    Rays,
    /// Where the rays through the centres of a pixel and its eight neighbours meet
    /// one plane under the same light, and surface and laser say that they are constant
    /// over the pixel, the samples lie on that plane, and the light is the centre's but
    /// for the laser's profile across the line; where none of them meets lit surface, nor surface beyond the
    /// light on both sides of the laser's sheet, there is none; elsewhere a ray for each. So the middle of
    /// a flat piece costs one ray a pixel. What is thinner than a pixel and missed by nine
    /// centres is not seen.
    Planes,
}

/// Mean laser light on the sensor before any speckle, at the samples of the pixels that may be
/// lit.
pub struct Light {
    pub(super) rows: Rows,
    pub(super) nodes: Nodes,
    /// mW/mm², pixel by pixel and sample by sample.
    pub(super) irradiance: Vec<f32>,
    /// The plane that each sample sees, or each pixel; empty where no one reads it.
    pub(super) surface: Vec<Seen>,
    /// β of each sample's surface, by which the lens spreads it (see [`super::blur`](super::blur()));
    /// empty where nothing is spread.
    pub(super) blur: Vec<f32>,
    /// By how many columns and rows [`super::skew`](super::skew()) moves each; empty where nothing is.
    pub(super) skew: Vec<[f32; 2]>,
    /// Degree of polarisation of each; empty where all light has the same.
    pub(super) polarised: Vec<f32>,
}

impl Light {
    /// Mean irradiance (mW/mm²) at a pixel's samples; pixels are numbered row by row.
    pub(super) fn samples(&self, pixel: usize) -> &[f32] {
        let count = self.nodes.places().len();
        &self.irradiance[count * pixel..count * (pixel + 1)]
    }

    /// What its samples see, or all of them; empty where no one reads it.
    pub(super) fn seen(&self, pixel: usize) -> &[Seen] {
        let count = self.surface.len() / self.rows.total().max(1);
        self.surface
            .get(count * pixel..count * (pixel + 1))
            .unwrap_or(&[])
    }

    /// Degrees of polarisation of its samples; empty where all light has the same.
    pub(super) fn polarised(&self, pixel: usize) -> &[f32] {
        let count = self.nodes.places().len();
        self.polarised
            .get(count * pixel..count * (pixel + 1))
            .unwrap_or(&[])
    }

    /// β of its samples; see [`super::blur`](super::blur()).
    pub(super) fn blur(&self, pixel: usize) -> &[f32] {
        let count = self.nodes.places().len();
        &self.blur[count * pixel..count * (pixel + 1)]
    }

    /// Light at the `nodes` of these pixels, sample by sample, which see what is `seen`.
    pub(super) fn spread(
        rows: Rows,
        nodes: Nodes,
        irradiance: Vec<f32>,
        surface: Vec<Seen>,
    ) -> Light {
        Light {
            rows,
            nodes,
            irradiance,
            surface,
            blur: Vec::new(),
            skew: Vec::new(),
            polarised: Vec::new(),
        }
    }

    /// Of every pixel that may be lit: column, row, and mean irradiance (mW/mm²) at its samples,
    /// row by row.
    pub fn pixels(&self) -> impl Iterator<Item = (usize, usize, &[f32])> {
        let rows = (0..self.rows.pixels.rows).flat_map(|row| {
            let columns = self.rows.pixels.of(row).zip(self.rows.start(row)..);
            columns.map(move |(column, pixel)| (column, row, pixel))
        });
        rows.map(|(column, row, pixel)| (column, row, self.samples(pixel)))
    }

    /// Light that is the same all over each pixel.
    pub(super) fn even(mean: &Irradiance, grid: Grid) -> Light {
        let nodes = Nodes::new(grid);
        let count = nodes.places().len();
        let values = mean.values().iter();
        let irradiance = values.flat_map(|&e| std::iter::repeat_n(e, count));
        Light::spread(mean.rows.clone(), nodes, irradiance.collect(), Vec::new())
    }

    /// The same with light that was reflected more than once, as the lens has spread it: its mean irradiance over
    /// each pixel (mW/mm²), which may be lit where this is not.
    pub fn with_indirect(self, indirect: &Irradiance) -> Light {
        debug_assert!(self.blur.is_empty());
        let count = self.nodes.places().len();
        let mut pixels = self.rows.pixels.clone();
        for row in 0..pixels.rows {
            for (column, _) in indirect.row(row) {
                pixels.insert(row, column, column);
            }
        }
        let rows = Rows::new(pixels);
        let mut irradiance = vec![0.0; count * rows.total()];
        let of_surface = self.surface.len() / self.rows.total().max(1);
        let mut surface = vec![Seen::default(); rows.total() * of_surface];
        let mut polarised = vec![
            0.0;
            if self.polarised.is_empty() {
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
                        surface[seen].copy_from_slice(self.seen(from));
                    }
                    if !polarised.is_empty() {
                        polarised[samples.clone()].copy_from_slice(self.polarised(from));
                    }
                }
                if let Some((_, e)) = more.next_if(|&(c, _)| c == column) {
                    irradiance[samples]
                        .iter_mut()
                        .for_each(|sample| *sample += e);
                }
            }
        }
        Light {
            rows,
            irradiance,
            surface,
            polarised,
            ..self
        }
    }
}

/// Bands of a task: enough that two more at its ends cost little, and few enough
/// that there are some to share out.
const BANDS_PER_TASK: usize = 32;

/// The light that these pixels see. The same bytes for any number of threads: each sample is
/// computed by itself.
pub fn light(view: &View, pixels: Pixels) -> Light {
    let sight = Sight::new(view.camera, &view.part_from_camera);
    let speckle = view.speckle.as_ref();
    let spread = Spread::new(view);
    let frame = Frame {
        rays: LitRays::new(view, &sight, spread.is_some()),
        rows: Rows::new(pixels),
        nodes: Nodes::new(defocus::grid(view)),
        reads_surface: speckle.is_some_and(|speckle| speckle.patterns.read_surface()),
        spread,
    };
    let count = frame.nodes.places().len();
    let mut irradiance = vec![0.0; count * frame.rows.total()];
    let of_surface = count * usize::from(frame.reads_surface);
    let mut surface = vec![Seen::default(); of_surface * frame.rows.total()];
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
        tasks.push(Task {
            first_band: first,
            first_pixel: pixels.start,
            irradiance: mine,
            surface: my_surface,
            blur: my_blur,
            skew: my_skew,
            polarised: my_polarised,
        });
    }
    tasks
        .into_par_iter()
        .for_each_init(Window::default, |window, task| frame.render(task, window));
    Light {
        irradiance,
        surface,
        blur,
        skew,
        polarised,
        rows: frame.rows,
        nodes: frame.nodes,
    }
}

/// Bands of pixels and where their light goes.
struct Task<'a> {
    first_band: usize,
    /// Its number.
    first_pixel: usize,
    /// Of their samples; zeros.
    irradiance: &'a mut [f32],
    surface: &'a mut [Seen],
    blur: &'a mut [f32],
    skew: &'a mut [[f32; 2]],
    polarised: &'a mut [f32],
}

/// A view with what its pixels share computed once.
struct Frame<'a> {
    rays: LitRays<'a>,
    rows: Rows,
    nodes: Nodes,
    /// Whether speckle depends on the surface that a sample sees.
    reads_surface: bool,
    /// `None`: the lens spreads nothing.
    spread: Option<Spread>,
}

/// A pixel to be sampled.
#[derive(Clone, Copy)]
struct Pixel {
    centre: DVec2,
    number: usize,
}

/// Reach of a pixel around its centre, pixels.
const HALF_A_PIXEL: f64 = 0.5;

/// Columns and rows of pixels whose samples are traced together where they are few.
const BLOCK: usize = 2;

impl Frame<'_> {
    fn bands_of(&self, first: usize) -> Range<usize> {
        first..(first + BANDS_PER_TASK).min(self.rows.pixels.bands())
    }

    fn rows_of_band(&self, band: usize) -> Range<usize> {
        SIDE * band..(SIDE * (band + 1)).min(self.rows.pixels.rows)
    }

    /// Rows of the task that begins at this band.
    fn rows_of(&self, first: usize) -> Range<usize> {
        SIDE * first..self.rows_of_band(self.bands_of(first).end - 1).end
    }

    fn render(&self, mut task: Task, window: &mut Window) {
        if task.irradiance.is_empty() {
            return;
        }
        let pixels = &self.rows.pixels;
        // How far around a pixel centres matter to it.
        let around = match (self.rays.view.sampling, self.nodes.places().len()) {
            (_, 1) => 0,
            (Sampling::Planes, _) => 1,
            (Sampling::Rays, _) => {
                for row in self.rows_of(task.first_band) {
                    self.rays.view.unwind_if_stopped();
                    for (column, number) in pixels.of(row).zip(self.rows.start(row)..) {
                        let centre = middle(column, row);
                        self.sampled(&[Pixel { centre, number }], 1, &mut task);
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
            // Numbers of the next pixel of each row.
            let mut numbers = [0; SIDE];
            for (number, row) in numbers.iter_mut().zip(self.rows_of_band(band)) {
                *number = self.rows.start(row);
            }
            for first in pixels.tiles(band, 0) {
                self.tile(band, first, around, window, &mut numbers, &mut task);
            }
        }
    }

    /// The light of a tile's pixels, whose numbers go on from `next` in each row.
    fn tile(
        &self,
        band: usize,
        first: usize,
        around: usize,
        window: &Window,
        next: &mut [usize; SIDE],
        task: &mut Task,
    ) {
        let wanted = self.rows.pixels.near_in_tile(band, first, 0);
        let size = [self.rows.pixels.columns, self.rows.pixels.rows];
        let Sorted { dark, flat } = match around {
            0 => Sorted {
                dark: 0,
                flat: wanted,
            },
            _ => {
                let is_sheet = self.rays.view.laser.fan.is_some();
                let turn = self.rays.constant_turn();
                let mut sorted = window.sorted(band, first, size, wanted, is_sheet, turn);
                if self.rays.are_mixed() {
                    sorted.flat = window.of_one_kind(band, first, size, sorted.flat);
                }
                sorted
            }
        };
        let pixels: [Pixel; WIDTH] = std::array::from_fn(|i| {
            let number = next[i / SIDE];
            next[i / SIDE] += usize::from(wanted >> i & 1);
            Pixel {
                centre: middle(first + i % SIDE, SIDE * band + i / SIDE),
                number,
            }
        });
        let met = window.tile(band, first);
        let mut apart = wanted & !(dark | flat);
        for i in (0..WIDTH).filter(|i| flat >> i & 1 == 1) {
            match &met[i] {
                Met::Lit(lit, plane) => {
                    let is_done = self.flat(pixels[i], lit, plane, around > 0, task);
                    apart |= u16::from(!is_done) << i;
                }
                Met::Beside(_) => apart |= 1 << i,
                _ => {}
            }
        }
        self.apart(&pixels, apart, task);
    }

    /// The light of a pixel that sees a plane, from the ray of its centre; false where that is
    /// not enough, if `asked`.
    fn flat(&self, pixel: Pixel, lit: &Lit, plane: &Plane, asked: bool, task: &mut Task) -> bool {
        let Some(profile) = Profile::new(pixel.centre, lit.radius, plane, &self.rays) else {
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
            for (four, samples) in self.nodes.fours().iter().zip(samples.chunks_mut(4)) {
                let shares = profile.shares(four) * irradiance;
                samples.copy_from_slice(&shares.to_array()[..samples.len()]);
            }
        }
        if self.reads_surface {
            task.surface[own.clone()].fill(Seen::new(plane));
        }
        if let Some(spread) = &self.spread {
            task.blur[own.clone()].fill(spread.blur(&self.rays.from_laser, pixel.centre, plane));
        }
        if !task.polarised.is_empty() {
            task.polarised[own.clone()].fill(self.rays.polarised(plane));
        }
        if let (Some(gloss), false) = (self.rays.gloss(plane), task.skew.is_empty()) {
            task.skew[own].fill(gloss.skew(pixel.centre, [plane.point, plane.normal]));
        }
        true
    }

    /// Returns the fraction of the light on the beam's axis at a sample with its own ray.
    ///
    /// The sample is given by its `place`, which lies `off` from the pixel's centre, and its `number` in the pixel. The result is the mean over its cell if the
    /// profile changes there by more than a value at a point resolves.
    fn share(
        &self,
        place: DVec2,
        off: DVec2,
        towards: DVec3,
        (lit, plane): (&Lit, &Plane),
        number: usize,
    ) -> f64 {
        // The bound holds for a pinhole. A lens that distorts stretches the image by less than twice.
        let distance = plane.point.distance(self.rays.from_laser.eye);
        let change = 2.0 * SQRT_2 * distance * self.rays.moves_across(plane, towards, 1.0);
        if change <= self.nodes.steepest as f64 * lit.radius {
            return lit.share();
        }
        match Profile::new(place, lit.radius, plane, &self.rays) {
            Some(profile) if profile.steepness() > self.nodes.steepest => {
                let cell = &self.nodes.cells()[number];
                profile.mean(cell.centre - off, cell) as f64
            }
            _ => lit.share(),
        }
    }

    /// Where a pixel's samples are in a task.
    fn samples(&self, pixel: Pixel, task: &Task) -> Range<usize> {
        let count = self.nodes.places().len();
        let first = count * (pixel.number - task.first_pixel);
        first..first + count
    }

    /// The light of those pixels of a tile that are `wanted` (as bits), by a ray for each
    /// sample. Packets are the same whichever pixels are wanted, as tiles are.
    fn apart(&self, tile: &[Pixel; WIDTH], wanted: u16, task: &mut Task) {
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

    /// Aims the rays of samples beyond the light whose cells may see light at the brightest place of their cells.
    ///
    /// Samples are numbered from `first` on. The light then is seen by a ray of its own, at which surface and shadow are
    /// known.
    fn aim(
        &self,
        first: usize,
        pixels: &[Pixel],
        places: &mut [DVec2; WIDTH],
        rays: &mut Rays,
        met: &mut [Met],
    ) {
        let count = self.nodes.places().len();
        let mut aimed = 0;
        for i in 0..met.len() {
            let Met::Beside(plane) = &met[i] else {
                continue;
            };
            let cell = &self.nodes.cells()[(first + i) % count];
            let middle = pixels[(first + i) / count].centre + cell.centre;
            // The radius scales the profile and does not move its axis.
            let radius = self.rays.view.laser.beam.waist_radius;
            if let Some(profile) = Profile::new(places[i], radius, plane, &self.rays) {
                places[i] += profile.brightest(middle - places[i], cell.half);
                let mut bend = DVec2::ZERO;
                let to_sensor = self.rays.sight.to_sensor(places[i]);
                rays[i] = self.rays.ray(self.rays.sight.towards(to_sensor, &mut bend));
                aimed |= 1 << i;
            }
        }
        if aimed == 0 {
            return;
        }
        let mut seen = [const { Met::Nothing }; WIDTH];
        (self.rays).look(&places[..met.len()], rays, aimed, 0.0, &mut seen);
        for i in (0..met.len()).filter(|i| aimed >> i & 1 == 1) {
            met[i] = seen[i];
        }
    }

    /// The light of those of up to [`BLOCK`]² pixels that are `wanted` (as bits), by a ray for
    /// each sample.
    fn sampled(&self, pixels: &[Pixel], wanted: u16, task: &mut Task) {
        let sight = self.rays.sight;
        let samples = self.nodes.places();
        let reach = self.nodes.reach();
        let all = samples.len() * pixels.len();
        let mut bend = DVec2::ZERO;
        // Of all samples of all pixels, one after the other.
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
            let mut met = [const { Met::Nothing }; WIDTH];
            (self.rays).look(&places[..chunk.len()], &rays, rays_wanted, reach, &mut met);
            self.aim(
                first,
                pixels,
                &mut places,
                &mut rays,
                &mut met[..chunk.len()],
            );
            for (ray, met) in chunk.zip(&met) {
                if let Met::Lit(lit, plane) = met {
                    let pixel = pixels[ray / samples.len()];
                    let number = ray % samples.len();
                    let sample = self.samples(pixel, task).start + number;
                    let (place, towards) = (places[ray - first], rays[ray - first].direction);
                    let off = place - pixel.centre;
                    let share = self.share(place, off, towards, (lit, plane), number);
                    task.irradiance[sample] = (lit.irradiance * share) as f32;
                    if self.reads_surface {
                        task.surface[sample] = Seen::new(plane);
                    }
                    if let Some(spread) = &self.spread {
                        task.blur[sample] =
                            spread.blur(&self.rays.from_laser, places[ray - first], plane);
                    }
                    if !task.polarised.is_empty() {
                        task.polarised[sample] = self.rays.polarised(plane);
                    }
                    if let (Some(gloss), false) = (self.rays.gloss(plane), task.skew.is_empty()) {
                        task.skew[sample] =
                            gloss.skew(places[ray - first], [plane.point, plane.normal]);
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
    use crate::frame::{LensBlur, Region, blur, expose, footprint};
    use crate::laser::{Beam, CUTOFF_RADII, Fan, FanProfile, Laser};
    use crate::math::{DVec3, Rigid};
    use crate::mesh::shapes;
    use crate::surface::Lambert;
    use rustfft::FftPlanner;
    use rustfft::num_complex::Complex;

    /// Where the camera stands.
    const BESIDE: DVec3 = DVec3::new(0.0, -120.0, 208.0);

    /// A sheet on a plane that the camera sees from 30° beside it.
    fn line(grid: Grid, sampling: Sampling, then: impl FnOnce(&View)) {
        line_on(DVec3::Z, grid, sampling, CUTOFF_RADII, then);
    }

    /// The same on a plane of this normal.
    fn line_on(
        normal: DVec3,
        grid: Grid,
        sampling: Sampling,
        cutoff_radii: f64,
        then: impl FnOnce(&View),
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
        then(&View {
            accel: &accel,
            surface: Lambert { reflectance: 0.5 }.into(),
            laser: &laser,
            part_from_laser: looking(DVec3::Z * 200.0),
            camera: &fixture(),
            part_from_camera: looking(BESIDE),
            speckle: None,
            grid,
            sampling,
            cutoff_radii,
            lens: LensBlur::NONE,
            indirect: None,
            stop: None,
        });
    }

    /// On a wall that the camera sees at 2° to 3° the middle of the line passes between the centres of two columns in
    /// some rows, both of which lie beyond the light. What one ray a pixel leaves out, and a ray for each sample beyond
    /// two radii, is at most e^(−2·1.75²) of the brightest sample for each of 18 samples, 0.04 of it in all; three of
    /// the brightest row have half of it or more: less than 0.03 of that row's light.
    #[test]
    fn a_line_between_two_centres_is_seen() {
        for angle in [0.035, 0.0525] {
            let wall = DVec3::X + BESIDE.normalize() * angle;
            let rows = |sampling| {
                let mut sums = Vec::new();
                line_on(wall, Grid::Gauss { per_side: 3 }, sampling, 2.0, |view| {
                    let light = light(view, footprint(view, &Region::All));
                    sums = vec![0.0; light.rows.pixels.rows];
                    for (_, row, samples) in light.pixels() {
                        sums[row] += samples.iter().map(|&e| e as f64).sum::<f64>();
                    }
                });
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

    /// Samples of one column of pixels, those that lie furthest left in it, from row to row.
    fn along_column(light: &Light, column: usize, per_side: usize) -> Vec<f64> {
        let pixels = light.pixels().filter(|&(c, _, _)| c == column);
        let of_pixel = |samples: &[f32]| -> Vec<f64> {
            let column = samples.chunks(per_side).map(|row| row[0] as f64);
            column.collect()
        };
        pixels
            .flat_map(|(_, _, samples)| of_pixel(samples))
            .collect()
    }

    /// Share of the spectrum's greatest value that is found above `from` cycles a pixel.
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

    /// A Gaussian of standard deviation σ pixels has exp(−2π²σ²f²) of its spectrum at f cycles a
    /// pixel: at one cycle nothing is left that f32 shows (σ > 1), if samples are even from
    /// pixel to pixel. Gauss–Legendre nodes are not, and taken for even they put a share of the
    /// order of their displacement there.
    #[test]
    fn an_even_grid_can_be_transformed() {
        let per_side = 4;
        let column = 320;
        for (grid, even) in [
            (Grid::Even { per_side }, true),
            (Grid::Gauss { per_side }, false),
        ] {
            for sampling in [Sampling::Planes, Sampling::Rays] {
                line(grid, sampling, |view| {
                    let light = light(view, footprint(view, &Region::All));
                    let values = along_column(&light, column, per_side as usize);
                    let mean = values.iter().sum::<f64>();
                    let centre = |power: i32| {
                        let moment = |(i, v): (usize, &f64)| v * (i as f64).powi(power);
                        values.iter().enumerate().map(moment).sum::<f64>() / mean
                    };
                    let sigma = (centre(2) - centre(1).powi(2)).sqrt() / per_side as f64;
                    assert!((1.0..8.0).contains(&sigma), "{sigma}");
                    let share = above(&values, per_side as usize, 0.9);
                    // Where light counts the exponent is up to 10, rounded in f32 like the rest:
                    // 10·2⁻²⁴ of a value.
                    assert_eq!(share < 1e-6, even, "{grid:?} {sampling:?} {share}");
                });
            }
        }
    }

    /// Both grids integrate the line to the same light, and no blur is the same light.
    #[test]
    fn all_grids_have_the_same_light() {
        let total = |grid, sampling| {
            let mut sum = 0.0;
            line(grid, sampling, |view| {
                let light = blur(
                    light(view, footprint(view, &Region::All)),
                    view,
                    &Region::All,
                );
                let image = expose(light, view).dense();
                sum = image.iter().map(|&e| e as f64).sum::<f64>();
            });
            sum
        };
        let full = total(Grid::Gauss { per_side: 6 }, Sampling::Rays);
        for (grid, sampling) in [
            (Grid::Gauss { per_side: 3 }, Sampling::Planes),
            (Grid::Even { per_side: 4 }, Sampling::Planes),
            (Grid::Even { per_side: 4 }, Sampling::Rays),
        ] {
            // f32 rounds each of up to 16 samples, and their sum.
            let ratio = total(grid, sampling) / full;
            assert!((ratio - 1.0).abs() < 1e-5, "{grid:?} {sampling:?} {ratio}");
        }
    }

    /// Light reflected more than once is added pixel by pixel, also where there is no direct
    /// light.
    #[test]
    fn indirect_light_is_added_by_pixel() {
        let grid = Grid::Gauss { per_side: 2 };
        line(grid, Sampling::Planes, |view| {
            let resolution = view.camera.sensor.resolution;
            let mut pixels = Pixels::none(resolution);
            pixels.insert(3, 5, 6);
            let middle = (resolution / 2).as_usizevec2();
            pixels.insert(middle.y, middle.x, middle.x);
            let more = Irradiance::new(Rows::new(pixels), vec![1.0, 2.0, 3.0]);
            let direct = || light(view, footprint(view, &Region::All));
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

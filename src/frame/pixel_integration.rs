//! Product of speckle and light, integrated over each pixel.

use super::PoseView;
use super::defocus::Blur;
use super::direct_light::DirectIrradiance;
use super::irradiance::Irradiance;
use super::pixel_mask::{BLOCK, middle};
use super::pixel_quadrature::{QuadratureNodes, SampleQuad};
use super::speckle::{PixelReader, SpeckleSampler, StripCacheSlot};
use super::speckle_strips::TangentPlane;
use crate::math::DVec2;
use rayon::prelude::*;
use std::ops::Range;
use wide::f32x4;

/// Low-light threshold: fraction of the peak irradiance of the contiguous lit run in the column.
const LOW_LIGHT_FRACTION: f32 = 1.0 / 64.0;

/// Number of pixels below which averaging uses a single thread.
const LEAST_MEANS: usize = 4096;

/// Rows per task.
const ROWS_PER_TASK: usize = 128;

/// Computes the mean irradiance of each pixel, mW/mm². It is the weighted sum of irradiance times
/// speckle over the samples of the grid. Speckle is read at the sample positions, but at the pixel
/// centre for low-light pixels.
pub fn expose(light: DirectIrradiance, view: &PoseView) -> Irradiance {
    let camera_from_laser = view.part_from_camera.inverse() * view.part_from_laser;
    // Light that passed the lens as a field already includes speckle.
    let speckle = view
        .speckle
        .as_ref()
        .filter(|_| view.lens.blur != Blur::Coherent);
    let reader =
        speckle.map(|speckle| SpeckleSampler::new(speckle, view.camera, camera_from_laser));
    let rows = &light.rows;
    let mut values = vec![0.0; rows.total()];
    let all = values.par_iter_mut().with_min_len(LEAST_MEANS).enumerate();
    all.for_each(|(pixel, value)| *value = mean(&light, pixel));
    if let Some(reader) = &reader {
        let faint = LowLightPixels::new(&light, &values, reader);
        let mut tasks = Vec::new();
        let mut left = &mut values[..];
        for first in (0..rows.pixels.rows).step_by(ROWS_PER_TASK) {
            let end = (first + ROWS_PER_TASK).min(rows.pixels.rows);
            let mine;
            (mine, left) = left.split_at_mut(rows.start(end) - rows.start(first));
            tasks.push((first..end, mine));
        }
        let tasks = tasks.into_par_iter();
        if view.lens.blur == Blur::Mean {
            let nodes = QuadratureNodes::new(view.grid);
            let spread = BlurredLight { faint, nodes };
            tasks.for_each(|(task, values)| {
                view.unwind_if_stopped();
                spread.expose(task, values);
            });
        } else {
            tasks.for_each(|(task, values)| {
                view.unwind_if_stopped();
                expose_samples(&faint, task, values);
            });
        }
    }
    Irradiance::new(light.rows, values)
}

/// Returns irradiance times weight of four samples of a pixel.
#[inline(always)]
fn weighted(four: &SampleQuad, irradiance: &[f32]) -> f32x4 {
    let mut lanes = [0.0; 4];
    lanes[..irradiance.len()].copy_from_slice(irradiance);
    four.weights * f32x4::from(lanes)
}

/// Returns the mean irradiance of a pixel before speckle.
fn mean(light: &DirectIrradiance, pixel: usize) -> f32 {
    let fours = light.nodes.quads().iter();
    let fours = fours.zip(light.samples(pixel).chunks(4));
    let sum: f32x4 = fours.map(|(four, samples)| weighted(four, samples)).sum();
    sum.reduce_add()
}

/// Applies speckle at each sample to the pixels of these rows. `values` already hold the means.
fn expose_samples(faint: &LowLightPixels, task: Range<usize>, values: &mut [f32]) {
    let (light, reader) = (faint.light, faint.reader);
    let rows = &light.rows;
    let first = rows.start(task.start);
    // Index of the next pixel of each row. Blocks of columns keep the speckle texels of one row in
    // the cache for the next.
    let mut next: Vec<usize> = task.clone().map(|row| rows.start(row)).collect();
    for block in 0..rows.pixels.blocks() {
        let mut nearby = [const { StripCacheSlot::NONE }; BLOCK];
        let mut fours = QuadCache::NONE;
        for (row, pixel) in task.clone().zip(&mut next) {
            for column in rows.pixels.in_block(row, block) {
                let (i, number) = (column % BLOCK, *pixel);
                let value = &mut values[number - first];
                *pixel += 1;
                if *value == 0.0 {
                    continue;
                }
                *value = match faint.speckle([column, row], number, *value, &mut fours) {
                    Some(speckle) => *value * speckle,
                    None => {
                        let reader = reader.pixel(middle(column, row), &mut nearby[i]);
                        pixel_irradiance(light, number, reader)
                    }
                };
            }
        }
    }
}

/// Returns the irradiance of a pixel with the speckle from `reader`.
#[inline(always)]
fn pixel_irradiance(light: &DirectIrradiance, pixel: usize, mut reader: PixelReader) -> f32 {
    let (samples, seen) = (light.samples(pixel), light.tangent_planes(pixel));
    if !light.degree_of_polarisation(pixel).is_empty() {
        let of = (light.nodes.places().iter()).zip(light.nodes.weights());
        let of = of.zip(samples.iter().zip(light.degree_of_polarisation(pixel)));
        let read = |(i, ((&place, weight), (irradiance, &polarised)))| {
            let seen = seen.get(i).or(seen.first()).copied().unwrap_or_default();
            weight * irradiance * reader.intensity_at_offset(place, seen, polarised)
        };
        return of.enumerate().map(read).sum();
    }
    let fours = light.nodes.quads().iter().zip(samples.chunks(4));
    let read = |(i, (four, irradiance)): (usize, (&SampleQuad, &[f32]))| {
        let seen = seen.get(4 * i..).unwrap_or(&[]);
        let speckle = reader.four(four.columns, four.rows, seen, four.count);
        weighted(four, irradiance) * speckle
    };
    let sum: f32x4 = fours.enumerate().map(read).sum();
    sum.reduce_add()
}

/// Low-light pixels. Speckle is sampled once per pixel, at its centre, for four adjacent pixels
/// that share the first one's tangent plane. These pixels are in the faint tails of the line. Their
/// effect on the centroid variance is below 1 %.
struct LowLightPixels<'a> {
    light: &'a DirectIrradiance,
    reader: &'a SpeckleSampler<'a>,
    /// Mean irradiance below which each pixel counts as low-light, mW/mm².
    below: Vec<f32>,
}

/// Speckle cache of a block: strip positions of each group of four, and the latest group with its
/// row and index.
struct QuadCache {
    near: [StripCacheSlot; BLOCK / 4],
    last: ([usize; 2], Option<[f32; 4]>),
}

impl QuadCache {
    const NONE: QuadCache = QuadCache {
        near: [const { StripCacheSlot::NONE }; BLOCK / 4],
        last: ([usize::MAX; 2], None),
    };
}

impl<'a> LowLightPixels<'a> {
    /// Determines the low-light thresholds from the mean irradiance of all pixels.
    fn new(
        light: &'a DirectIrradiance,
        means: &[f32],
        reader: &'a SpeckleSampler<'a>,
    ) -> LowLightPixels<'a> {
        let rows = &light.rows;
        let mut below = means.to_vec();
        let mut last = vec![(usize::MAX, 0.0); rows.pixels.columns];
        let mut along = |row: usize| {
            for (column, pixel) in rows.pixels.of(row).zip(rows.start(row)..) {
                let (before, most) = last[column];
                if means[pixel] > 0.0 && before.abs_diff(row) == 1 && most > below[pixel] {
                    below[pixel] = most;
                }
                last[column] = (row, below[pixel]);
            }
        };
        (0..rows.pixels.rows).for_each(&mut along);
        (0..rows.pixels.rows).rev().for_each(along);
        below
            .iter_mut()
            .for_each(|most| *most *= LOW_LIGHT_FRACTION);
        LowLightPixels {
            light,
            reader,
            below,
        }
    }

    /// Returns the speckle of a pixel (column, row) with this mean. `None` if it is not a low-light
    /// pixel, or if groups of four cannot be read.
    #[inline(always)]
    fn speckle(
        &self,
        [column, row]: [usize; 2],
        pixel: usize,
        mean: f32,
        fours: &mut QuadCache,
    ) -> Option<f32> {
        if mean >= self.below[pixel] || !self.light.degree_of_polarisation.is_empty() {
            return None;
        }
        let (four, i) = (column % BLOCK / 4, column % 4);
        if fours.last.0 != [row, four] {
            let first = middle(column - i, row);
            let read =
                self.reader
                    .side_by_side(first, self.tangent_planes(pixel), &mut fours.near[four]);
            fours.last = ([row, four], read);
        }
        fours.last.1.map(|speckle| speckle[i])
    }

    /// Returns the first lit plane among the samples of a pixel.
    fn tangent_planes(&self, pixel: usize) -> TangentPlane {
        let lit = |seen: &&TangentPlane| **seen != TangentPlane::default();
        (self.light.tangent_planes(pixel).iter().find(lit).copied()).unwrap_or_default()
    }
}

/// Exposure of blurred light, which is given as the mean of each pixel.
struct BlurredLight<'a> {
    /// Low-light pixels; their light comes from the complete blur.
    faint: LowLightPixels<'a>,
    /// Sample positions at which speckle is read in other pixels.
    nodes: QuadratureNodes,
}

/// Means of a row's pixels in a block and one more at each end (0 if absent), and the index of the
/// block's first pixel.
type RowWindow = ([f32; BLOCK + 2], usize);

impl BlurredLight<'_> {
    /// Computes the irradiance of the pixels of these rows.
    fn expose(&self, task: Range<usize>, values: &mut [f32]) {
        let LowLightPixels { light, reader, .. } = self.faint;
        let rows = &light.rows;
        let first = rows.start(task.start);
        // Index of the next pixel of these rows, and of the rows above and below.
        let all = task.start.saturating_sub(1)..(task.end + 1).min(rows.pixels.rows);
        let mut next: Vec<usize> = all.clone().map(|row| rows.start(row)).collect();
        for block in 0..rows.pixels.blocks() {
            let mut nearby = [const { StripCacheSlot::NONE }; BLOCK];
            let mut fours = QuadCache::NONE;
            let mut near = |row: usize| match all.contains(&row) {
                true => self.near(row, block, &mut next[row - all.start]),
                false => ([0.0; BLOCK + 2], 0),
            };
            let mut above = near(task.start.wrapping_sub(1));
            let mut here = near(task.start);
            for row in task.clone() {
                let below = near(row + 1);
                let lit = rows.pixels.in_block(row, block).zip(here.1..);
                for (column, pixel) in lit {
                    let i = column % BLOCK;
                    let mean = here.0[i + 1];
                    if mean == 0.0 {
                        continue;
                    }
                    let speckle = self.faint.speckle([column, row], pixel, mean, &mut fours);
                    if let Some(speckle) = speckle {
                        values[pixel - first] = mean * speckle;
                        continue;
                    }
                    let beside = [[here.0[i], here.0[i + 2]], [above.0[i + 1], below.0[i + 1]]];
                    let reader = reader.pixel(middle(column, row), &mut nearby[i]);
                    values[pixel - first] = match mean < self.faint.below[pixel] {
                        true => self.in_the_middle(pixel, mean, reader),
                        false => self.pixel_irradiance(pixel, mean, beside, reader),
                    };
                }
                (above, here) = (here, below);
            }
        }
    }

    /// Returns the means of a row in a block. `next` is the index of the block's first pixel, and
    /// is advanced past its last one.
    fn near(&self, row: usize, block: usize, next: &mut usize) -> RowWindow {
        let (rows, all) = (&self.faint.light.rows, &self.faint.light.irradiance);
        let mut means = [0.0; BLOCK + 2];
        let first = *next;
        for column in rows.pixels.in_block(row, block) {
            means[column % BLOCK + 1] = all[*next];
            *next += 1;
        }
        let columns = BLOCK * block..BLOCK * (block + 1);
        if columns.start > 0 && rows.pixels.contains(row, columns.start - 1) {
            means[0] = all[first - 1];
        }
        if rows.pixels.contains(row, columns.end) {
            means[BLOCK + 1] = all[*next];
        }
        (means, first)
    }

    /// Returns the irradiance of a low-light pixel.
    #[inline(always)]
    fn in_the_middle(&self, pixel: usize, mean: f32, mut reader: PixelReader) -> f32 {
        let seen = self.faint.tangent_planes(pixel);
        mean * match self.faint.light.degree_of_polarisation(pixel) {
            [polarised] => reader.intensity_at_offset(DVec2::ZERO, seen, *polarised),
            _ => reader.middle(seen),
        }
    }

    /// Returns the irradiance of a pixel. Within the pixel, light is a parabola along columns and
    /// rows. It is interpolated from the means of the pixel and of its neighbours [left, right] and
    /// [above, below].
    #[inline(always)]
    fn pixel_irradiance(
        &self,
        pixel: usize,
        mean: f32,
        beside: [[f32; 2]; 2],
        mut reader: PixelReader,
    ) -> f32 {
        let slopes = beside.map(|[before, after]| (after - before) / 2.0);
        let bends = beside.map(|[before, after]| (before + after) / 2.0 - mean);
        let seen = self.faint.tangent_planes(pixel);
        let of_four = |four: &SampleQuad| {
            let along = |i: usize, place: f32x4| {
                place * slopes[i] + (place * place - 1.0 / 12.0) * bends[i]
            };
            let light = along(0, four.columns) + along(1, four.rows) + mean;
            four.weights * light.max(f32x4::ZERO)
        };
        let fours = self.nodes.quads().iter();
        let sum: f32x4 = match self.faint.light.degree_of_polarisation(pixel) {
            &[polarised] => {
                let places = self.nodes.places().chunks(4);
                let read = |(four, places): (&SampleQuad, &[DVec2])| {
                    let mut speckle = [0.0; 4];
                    for (speckle, &place) in speckle.iter_mut().zip(places) {
                        *speckle = reader.intensity_at_offset(place, seen, polarised);
                    }
                    of_four(four) * f32x4::from(speckle)
                };
                fours.zip(places).map(read).sum()
            }
            _ => {
                let all = [seen; 4];
                let read = |four: &SampleQuad| {
                    let speckle = reader.four(four.columns, four.rows, &all, four.count);
                    of_four(four) * speckle
                };
                fours.map(read).sum()
            }
        };
        sum.reduce_add()
    }
}

#[cfg(test)]
mod tests {
    use super::super::pixel_mask::{PixelMask, PixelNumbering};
    use super::super::pixel_quadrature::PixelQuadrature;
    use super::super::speckle::{Speckle, SpeckleSource};
    use super::*;
    use crate::camera::fixture;
    use crate::math::{Aperture, Rigid};
    use crate::speckle::frame_field::{FrameFields, PupilPosition, field_spec};
    use crate::speckle::lookup::Coherence;
    use glam::UVec2;

    /// Returns the light of a slanted line with 1/e² half width `w` pixels, cut off at 2.6 `w`.
    fn line(w: f64, size: UVec2) -> DirectIrradiance {
        let centre = |x: f64| size.y as f64 / 2.0 + 0.05 * x;
        let mut pixels = PixelMask::none(size);
        for column in 0..size.x as usize {
            let y = centre(column as f64);
            for row in (y - 2.6 * w) as usize..=(y + 2.6 * w) as usize {
                pixels.insert(row, column, column);
            }
        }
        let rows = PixelNumbering::new(pixels);
        let nodes = QuadratureNodes::new(PixelQuadrature::Gauss { per_side: 3 });
        let mut irradiance = Vec::new();
        for row in 0..rows.pixels.rows {
            for column in rows.pixels.of(row) {
                irradiance.extend(nodes.places().iter().map(|&place| {
                    let at = middle(column, row) + place;
                    (-2.0 * ((at.y - centre(at.x)) / w).powi(2)).exp() as f32
                }));
            }
        }
        DirectIrradiance::from_blurred(rows, nodes, irradiance, Vec::new())
    }

    /// Returns the centroid of each column.
    fn centroids(rows: &PixelNumbering, values: &[f32]) -> Vec<f64> {
        let mut sums = vec![[0.0; 2]; rows.pixels.columns];
        for row in 0..rows.pixels.rows {
            for (column, &value) in rows.pixels.of(row).zip(&values[rows.range(row)]) {
                sums[column][0] += value as f64;
                sums[column][1] += value as f64 * row as f64;
            }
        }
        sums.into_iter().map(|[sum, moment]| moment / sum).collect()
    }

    /// Compares low-light sampling with speckle read at each sample, for lines of one grain and
    /// wider. Other pixels are identical. The mean-square change of centroids is below 1 % of their
    /// speckle variance, which is half a percent of their standard deviation.
    #[test]
    fn faint_pixels_read_in_their_middle_move_no_centroid() {
        let camera = fixture();
        let fields = FrameFields::new(&field_spec(1, Aperture::Circle), Coherence::FULL).unwrap();
        let grain = camera.speckle_angle(660e-6);
        let speckle = Speckle {
            patterns: SpeckleSource::Frame {
                fields: &fields,
                place: PupilPosition {
                    shift: DVec2::ZERO,
                    defocus: 0.0,
                },
            },
            map: fields.map(grain, camera.lens.image_distance()),
            displacement: DVec2::ZERO,
            pupil_scale: None,
        };
        let reader = SpeckleSampler::new(&speckle, &camera, Rigid::IDENTITY);
        let grain_px = camera.speckle_size(660e-6) / camera.sensor.pixel_pitch;
        for w in [1.0, 1.5, 3.0].map(|grains| grains * grain_px) {
            let light = line(w, UVec2::new(600, 100));
            let rows = &light.rows;
            let means: Vec<f32> = (0..rows.total()).map(|i| mean(&light, i)).collect();
            let mut faint = LowLightPixels::new(&light, &means, &reader);
            let exposed = |faint: &LowLightPixels| {
                let mut values = means.clone();
                expose_samples(faint, 0..rows.pixels.rows, &mut values);
                values
            };
            let found = exposed(&faint);
            let below = std::mem::replace(&mut faint.below, vec![0.0; means.len()]);
            let expected = exposed(&faint);
            let is_faint = |i: usize| means[i] < below[i];
            let count = (0..means.len()).filter(|&i| is_faint(i)).count();
            assert!(3 * count > means.len(), "{count} of {}", means.len());
            assert!((0..means.len()).all(|i| is_faint(i) || found[i] == expected[i]));
            let [smooth, found, expected] =
                [&means, &found, &expected].map(|values| centroids(rows, values));
            let square = |a: &[f64], b: &[f64]| -> f64 {
                a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
            };
            let (moved, strayed) = (square(&found, &expected), square(&expected, &smooth));
            println!("{w} {count} {} {moved} {strayed}", means.len());
            assert!(
                moved > 0.0 && moved < 0.01 * strayed,
                "{w}: {moved} {strayed}"
            );
        }
    }
}

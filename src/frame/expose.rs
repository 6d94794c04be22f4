//! Speckle times light, integrated over each pixel.

use super::View;
use super::defocus::Blur;
use super::grid::{Four, Nodes};
use super::irradiance::Irradiance;
use super::light::Light;
use super::pixels::{BLOCK, middle};
use super::reference::Seen;
use super::speckle::{Nearby, PixelReader, Reader};
use crate::math::DVec2;
use rayon::prelude::*;
use std::ops::Range;
use wide::f32x4;

/// Share of a line's brightest light in a column that is faint: what is lit without a dark pixel between.
const FAINT: f32 = 1.0 / 64.0;

/// Pixels below which it takes no other thread to average their samples.
const LEAST_MEANS: usize = 4096;

/// Rows of a task.
const ROWS_PER_TASK: usize = 128;

/// Mean irradiance of each pixel of the light, mW/mm²: over the samples of its grid the
/// weighted sum of irradiance times speckle, which is read where the sample lies, but of faint
/// pixels in their middle.
pub fn expose(light: Light, view: &View) -> Irradiance {
    let camera_from_laser = view.part_from_camera.inverse() * view.part_from_laser;
    // Light that went through the lens as a field has its speckle.
    let speckle = view
        .speckle
        .as_ref()
        .filter(|_| view.lens.blur != Blur::Coherent);
    let reader = speckle.map(|speckle| Reader::new(speckle, view.camera, camera_from_laser));
    let rows = &light.rows;
    let mut values = vec![0.0; rows.total()];
    let all = values.par_iter_mut().with_min_len(LEAST_MEANS).enumerate();
    all.for_each(|(pixel, value)| *value = mean(&light, pixel));
    if let Some(reader) = &reader {
        let faint = Faint::new(&light, &values, reader);
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
            let nodes = Nodes::new(view.grid);
            let spread = Spread { faint, nodes };
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

/// Irradiance times weight of four of a pixel's samples.
#[inline(always)]
fn weighted(four: &Four, irradiance: &[f32]) -> f32x4 {
    let mut lanes = [0.0; 4];
    lanes[..irradiance.len()].copy_from_slice(irradiance);
    four.weights * f32x4::from(lanes)
}

/// Mean irradiance of a pixel, by its number, before any speckle.
fn mean(light: &Light, pixel: usize) -> f32 {
    let fours = light.nodes.fours().iter();
    let fours = fours.zip(light.samples(pixel).chunks(4));
    let sum: f32x4 = fours.map(|(four, samples)| weighted(four, samples)).sum();
    sum.reduce_add()
}

/// Gives the pixels of these rows, which have their mean, the speckle at each of their samples.
fn expose_samples(faint: &Faint, task: Range<usize>, values: &mut [f32]) {
    let (light, reader) = (faint.light, faint.reader);
    let rows = &light.rows;
    let first = rows.start(task.start);
    // Numbers of the next pixel of each row. By blocks of columns, so that what is read of speckle
    // in one row is at hand in the next.
    let mut next: Vec<usize> = task.clone().map(|row| rows.start(row)).collect();
    for block in 0..rows.pixels.blocks() {
        let mut nearby = [const { Nearby::NONE }; BLOCK];
        let mut fours = Fours::NONE;
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
                        exposed(light, number, reader)
                    }
                };
            }
        }
    }
}

/// Irradiance of a pixel, by its number, with the speckle that `reader` has there.
#[inline(always)]
fn exposed(light: &Light, pixel: usize, mut reader: PixelReader) -> f32 {
    let (samples, seen) = (light.samples(pixel), light.seen(pixel));
    if !light.polarised(pixel).is_empty() {
        let of = (light.nodes.places().iter()).zip(light.nodes.weights());
        let of = of.zip(samples.iter().zip(light.polarised(pixel)));
        let read = |(i, ((&place, weight), (irradiance, &polarised)))| {
            let seen = seen.get(i).or(seen.first()).copied().unwrap_or_default();
            weight * irradiance * reader.one_of(place, seen, polarised)
        };
        return of.enumerate().map(read).sum();
    }
    let fours = light.nodes.fours().iter().zip(samples.chunks(4));
    let read = |(i, (four, irradiance)): (usize, (&Four, &[f32]))| {
        let seen = seen.get(4 * i..).unwrap_or(&[]);
        let speckle = reader.four(four.columns, four.rows, seen, four.count);
        weighted(four, irradiance) * speckle
    };
    let sum: f32x4 = fours.enumerate().map(read).sum();
    sum.reduce_add()
}

/// Where speckle is read in the middle of a pixel alone, four pixels side by side, and of the plane that the
/// first of them sees: in the wide and faint tails of a line, which move no centroid.
struct Faint<'a> {
    light: &'a Light,
    reader: &'a Reader<'a>,
    /// Of each pixel the mean light (mW/mm²) below which it is faint.
    below: Vec<f32>,
}

/// What was read of a block: where the fours' strips are read, and the last four with its row and number.
struct Fours {
    near: [Nearby; BLOCK / 4],
    last: ([usize; 2], Option<[f32; 4]>),
}

impl Fours {
    const NONE: Fours = Fours {
        near: [const { Nearby::NONE }; BLOCK / 4],
        last: ([usize::MAX; 2], None),
    };
}

impl<'a> Faint<'a> {
    /// For light of these means.
    fn new(light: &'a Light, means: &[f32], reader: &'a Reader<'a>) -> Faint<'a> {
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
        below.iter_mut().for_each(|most| *most *= FAINT);
        Faint {
            light,
            reader,
            below,
        }
    }

    /// Speckle of a pixel (column, row), by its number, with this mean; `None` if it is not faint, or cannot be read
    /// so.
    #[inline(always)]
    fn speckle(
        &self,
        [column, row]: [usize; 2],
        pixel: usize,
        mean: f32,
        fours: &mut Fours,
    ) -> Option<f32> {
        if mean >= self.below[pixel] || !self.light.polarised.is_empty() {
            return None;
        }
        let (four, i) = (column % BLOCK / 4, column % 4);
        if fours.last.0 != [row, four] {
            let first = middle(column - i, row);
            let read = self
                .reader
                .side_by_side(first, self.seen(pixel), &mut fours.near[four]);
            fours.last = ([row, four], read);
        }
        fours.last.1.map(|speckle| speckle[i])
    }

    /// The first lit plane that a pixel sees, by its number.
    fn seen(&self, pixel: usize) -> Seen {
        let lit = |seen: &&Seen| **seen != Seen::default();
        (self.light.seen(pixel).iter().find(lit).copied()).unwrap_or_default()
    }
}

/// Light that the lens has spread, of which each pixel's mean is known, and its speckle.
struct Spread<'a> {
    /// What reaches a faint pixel comes from all that lies within the blur.
    faint: Faint<'a>,
    /// Where speckle is read in other pixels.
    nodes: Nodes,
}

/// Means of a row's pixels in a block and of one more at each end, 0 where there is none, and the number of
/// the block's first pixel.
type Near = ([f32; BLOCK + 2], usize);

impl Spread<'_> {
    /// The pixels of these rows.
    fn expose(&self, task: Range<usize>, values: &mut [f32]) {
        let Faint { light, reader, .. } = self.faint;
        let rows = &light.rows;
        let first = rows.start(task.start);
        // Numbers of the next pixel of these rows and of those above and below.
        let all = task.start.saturating_sub(1)..(task.end + 1).min(rows.pixels.rows);
        let mut next: Vec<usize> = all.clone().map(|row| rows.start(row)).collect();
        for block in 0..rows.pixels.blocks() {
            let mut nearby = [const { Nearby::NONE }; BLOCK];
            let mut fours = Fours::NONE;
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
                        false => self.exposed(pixel, mean, beside, reader),
                    };
                }
                (above, here) = (here, below);
            }
        }
    }

    /// `next` is the number of the block's first pixel, and of the first after them then.
    fn near(&self, row: usize, block: usize, next: &mut usize) -> Near {
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

    /// Light of a faint pixel, by its number.
    #[inline(always)]
    fn in_the_middle(&self, pixel: usize, mean: f32, mut reader: PixelReader) -> f32 {
        let seen = self.faint.seen(pixel);
        mean * match self.faint.light.polarised(pixel) {
            [polarised] => reader.one_of(DVec2::ZERO, seen, *polarised),
            _ => reader.middle(seen),
        }
    }

    /// Light of a pixel, by its number: in it as if it were a parabola along either side, from the means over it
    /// and its neighbours, left and right, above and below.
    #[inline(always)]
    fn exposed(
        &self,
        pixel: usize,
        mean: f32,
        beside: [[f32; 2]; 2],
        mut reader: PixelReader,
    ) -> f32 {
        let slopes = beside.map(|[before, after]| (after - before) / 2.0);
        let bends = beside.map(|[before, after]| (before + after) / 2.0 - mean);
        let seen = self.faint.seen(pixel);
        let of_four = |four: &Four| {
            let along = |i: usize, place: f32x4| {
                place * slopes[i] + (place * place - 1.0 / 12.0) * bends[i]
            };
            let light = along(0, four.columns) + along(1, four.rows) + mean;
            four.weights * light.max(f32x4::ZERO)
        };
        let fours = self.nodes.fours().iter();
        let sum: f32x4 = match self.faint.light.polarised(pixel) {
            &[polarised] => {
                let places = self.nodes.places().chunks(4);
                let read = |(four, places): (&Four, &[DVec2])| {
                    let mut speckle = [0.0; 4];
                    for (speckle, &place) in speckle.iter_mut().zip(places) {
                        *speckle = reader.one_of(place, seen, polarised);
                    }
                    of_four(four) * f32x4::from(speckle)
                };
                fours.zip(places).map(read).sum()
            }
            _ => {
                let all = [seen; 4];
                let read = |four: &Four| {
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
    use super::super::grid::Grid;
    use super::super::pixels::{Pixels, Rows};
    use super::super::speckle::{Patterns, Speckle};
    use super::*;
    use crate::camera::fixture;
    use crate::math::{Aperture, Rigid};
    use crate::speckle::frame_field::{FrameFields, PupilPlace, field_spec};
    use crate::speckle::lookup::Coherence;
    use glam::UVec2;

    /// Light of a slanted line, 1/e² half width `w` pixels, to 2.6 of these.
    fn line(w: f64, size: UVec2) -> Light {
        let centre = |x: f64| size.y as f64 / 2.0 + 0.05 * x;
        let mut pixels = Pixels::none(size);
        for column in 0..size.x as usize {
            let y = centre(column as f64);
            for row in (y - 2.6 * w) as usize..=(y + 2.6 * w) as usize {
                pixels.insert(row, column, column);
            }
        }
        let rows = Rows::new(pixels);
        let nodes = Nodes::new(Grid::Gauss { per_side: 3 });
        let mut irradiance = Vec::new();
        for row in 0..rows.pixels.rows {
            for column in rows.pixels.of(row) {
                irradiance.extend(nodes.places().iter().map(|&place| {
                    let at = middle(column, row) + place;
                    (-2.0 * ((at.y - centre(at.x)) / w).powi(2)).exp() as f32
                }));
            }
        }
        Light::spread(rows, nodes, irradiance, Vec::new())
    }

    /// Centroids, by column.
    fn centroids(rows: &Rows, values: &[f32]) -> Vec<f64> {
        let mut sums = vec![[0.0; 2]; rows.pixels.columns];
        for row in 0..rows.pixels.rows {
            for (column, &value) in rows.pixels.of(row).zip(&values[rows.range(row)]) {
                sums[column][0] += value as f64;
                sums[column][1] += value as f64 * row as f64;
            }
        }
        sums.into_iter().map(|[sum, moment]| moment / sum).collect()
    }

    /// Against speckle read at each sample, for lines of one grain and more: pixels that are not faint are the
    /// same, and where centroids lie changes by less than a hundredth of the variance that speckle gives
    /// them, half a percent of what they stray.
    #[test]
    fn faint_pixels_read_in_their_middle_move_no_centroid() {
        let camera = fixture();
        let fields = FrameFields::new(&field_spec(1, Aperture::Circle), Coherence::FULL).unwrap();
        let grain = camera.speckle_angle(660e-6);
        let speckle = Speckle {
            patterns: Patterns::Frame {
                fields: &fields,
                place: PupilPlace {
                    shift: DVec2::ZERO,
                    defocus: 0.0,
                },
            },
            map: fields.map(grain, camera.lens.image_distance()),
            displacement: DVec2::ZERO,
            wider: None,
        };
        let reader = Reader::new(&speckle, &camera, Rigid::IDENTITY);
        let grain_px = camera.speckle_size(660e-6) / camera.sensor.pixel_pitch;
        for w in [1.0, 1.5, 3.0].map(|grains| grains * grain_px) {
            let light = line(w, UVec2::new(600, 100));
            let rows = &light.rows;
            let means: Vec<f32> = (0..rows.total()).map(|i| mean(&light, i)).collect();
            let mut faint = Faint::new(&light, &means, &reader);
            let exposed = |faint: &Faint| {
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

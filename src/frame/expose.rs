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

/// Share of a column's brightest light that is faint.
const FAINT: f32 = 1.0 / 64.0;

/// Rows of a task.
const ROWS_PER_TASK: usize = 128;

/// Mean irradiance of each pixel of the light, mW/mm²: over the samples of its grid the
/// weighted sum of irradiance times speckle, which is read where the sample lies.
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
    let mut tasks = Vec::new();
    let mut left = &mut values[..];
    for first in (0..rows.pixels.rows).step_by(ROWS_PER_TASK) {
        let end = (first + ROWS_PER_TASK).min(rows.pixels.rows);
        let mine;
        (mine, left) = left.split_at_mut(rows.start(end) - rows.start(first));
        tasks.push((first..end, mine));
    }
    match &reader {
        Some(reader) if view.lens.blur == Blur::Mean => {
            let spread = Spread::new(&light, view, reader);
            let tasks = tasks.into_par_iter();
            tasks.for_each(|(task, values)| spread.expose(task, values));
        }
        _ => tasks
            .into_par_iter()
            .for_each(|(task, values)| expose_samples(&light, reader.as_ref(), task, values)),
    }
    Irradiance::new(light.rows, values)
}

/// The pixels of these rows, by light at each of their samples.
fn expose_samples(light: &Light, reader: Option<&Reader>, task: Range<usize>, values: &mut [f32]) {
    let rows = &light.rows;
    let first = rows.start(task.start);
    // Numbers of the next pixel of each row. By blocks of columns, so that what is read of speckle
    // in one row is at hand in the next.
    let mut next: Vec<usize> = task.clone().map(|row| rows.start(row)).collect();
    for block in 0..rows.pixels.blocks() {
        let mut nearby = [const { Nearby::NONE }; BLOCK];
        for (row, pixel) in task.clone().zip(&mut next) {
            for column in rows.pixels.in_block(row, block) {
                let near = &mut nearby[column % BLOCK];
                let reader = reader.map(|reader| reader.pixel(middle(column, row), near));
                values[*pixel - first] = exposed(light, *pixel, reader);
                *pixel += 1;
            }
        }
    }
}

/// Mean irradiance of a pixel, by its number, with the speckle that `reader` has there.
#[inline(always)]
fn exposed(light: &Light, pixel: usize, reader: Option<PixelReader>) -> f32 {
    let samples = light.samples(pixel);
    let fours = light.nodes.fours().iter().zip(samples.chunks(4));
    let weighted = |(four, irradiance): (&Four, &[f32])| {
        let mut lanes = [0.0; 4];
        lanes[..irradiance.len()].copy_from_slice(irradiance);
        four.weights * f32x4::from(lanes)
    };
    let sum: f32x4 = match reader {
        None => fours.map(weighted).sum(),
        Some(_) if samples.iter().all(|&irradiance| irradiance == 0.0) => return 0.0,
        Some(reader) if !light.polarised(pixel).is_empty() => {
            let seen = light.seen(pixel);
            let of = (light.nodes.places().iter()).zip(light.nodes.weights());
            let of = of.zip(samples.iter().zip(light.polarised(pixel)));
            let read = |(i, ((&place, weight), (irradiance, &polarised)))| {
                let seen = seen.get(i).or(seen.first()).copied().unwrap_or_default();
                weight * irradiance * reader.one_of(place, seen, polarised)
            };
            return of.enumerate().map(read).sum();
        }
        Some(mut reader) => {
            let seen = light.seen(pixel);
            let read = |(i, (four, irradiance)): (usize, (&Four, &[f32]))| {
                let seen = seen.get(4 * i..).unwrap_or(&[]);
                let speckle = reader.four(four.columns, four.rows, seen, four.count);
                weighted((four, irradiance)) * speckle
            };
            fours.enumerate().map(read).sum()
        }
    };
    sum.reduce_add()
}

/// Light that the lens has spread, of which each pixel's mean is known, and its speckle.
struct Spread<'a> {
    light: &'a Light,
    reader: &'a Reader<'a>,
    /// Where speckle is read in a pixel.
    nodes: Nodes,
    /// In each column the light up to which speckle is read in the middle of the pixel alone, and of the plane that the
    /// first of four pixels sees: spread light has wide and faint tails, which move no centroid, and what reaches a
    /// pixel there comes from all that lies within the blur.
    faint: Vec<f32>,
}

/// Means of a row's pixels in a block and of one more at each end, 0 where there is none, and the number of
/// the block's first pixel.
type Near = ([f32; BLOCK + 2], usize);

impl<'a> Spread<'a> {
    fn new(light: &'a Light, view: &View, reader: &'a Reader<'a>) -> Spread<'a> {
        let pixels = &light.rows.pixels;
        let mut faint = vec![0.0; BLOCK * pixels.blocks()];
        for row in 0..pixels.rows {
            let means = &light.irradiance[light.rows.range(row)];
            for (column, &mean) in pixels.of(row).zip(means) {
                faint[column] = mean.max(faint[column]);
            }
        }
        faint.iter_mut().for_each(|most| *most *= FAINT);
        Spread {
            light,
            reader,
            nodes: Nodes::new(view.grid),
            faint,
        }
    }

    /// The pixels of these rows.
    fn expose(&self, task: Range<usize>, values: &mut [f32]) {
        let rows = &self.light.rows;
        let first = rows.start(task.start);
        // Numbers of the next pixel of these rows and of those above and below.
        let all = task.start.saturating_sub(1)..(task.end + 1).min(rows.pixels.rows);
        let mut next: Vec<usize> = all.clone().map(|row| rows.start(row)).collect();
        for block in 0..rows.pixels.blocks() {
            let mut nearby = [const { Nearby::NONE }; BLOCK];
            let mut near_fours = [const { Nearby::NONE }; BLOCK / 4];
            let mut near = |row: usize| match all.contains(&row) {
                true => self.near(row, block, &mut next[row - all.start]),
                false => ([0.0; BLOCK + 2], 0),
            };
            let mut above = near(task.start.wrapping_sub(1));
            let mut here = near(task.start);
            for row in task.clone() {
                let below = near(row + 1);
                let lit = rows.pixels.in_block(row, block).zip(here.1..);
                let mut of_four = (usize::MAX, None);
                for (column, pixel) in lit {
                    let i = column % BLOCK;
                    let mean = here.0[i + 1];
                    if mean == 0.0 {
                        continue;
                    }
                    if mean < self.faint[column] && self.light.polarised.is_empty() {
                        if of_four.0 != i / 4 {
                            let first = middle(column / 4 * 4, row);
                            let (seen, near) = (self.seen(pixel), &mut near_fours[i / 4]);
                            of_four = (i / 4, self.reader.side_by_side(first, seen, near));
                        }
                        if let Some(speckle) = &of_four.1 {
                            values[pixel - first] = mean * speckle[i % 4];
                            continue;
                        }
                    }
                    let beside = [[here.0[i], here.0[i + 2]], [above.0[i + 1], below.0[i + 1]]];
                    let reader = self.reader.pixel(middle(column, row), &mut nearby[i]);
                    values[pixel - first] = match mean < self.faint[column] {
                        true => self.in_the_middle(pixel, mean, reader),
                        false => self.exposed(pixel, mean, beside, reader),
                    };
                }
                (above, here) = (here, below);
            }
        }
    }

    /// What a pixel sees, by its number.
    fn seen(&self, pixel: usize) -> Seen {
        self.light.seen(pixel).first().copied().unwrap_or_default()
    }

    /// `next` is the number of the block's first pixel, and of the first after them then.
    fn near(&self, row: usize, block: usize, next: &mut usize) -> Near {
        let (rows, all) = (&self.light.rows, &self.light.irradiance);
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
        let seen = self.seen(pixel);
        mean * match self.light.polarised(pixel) {
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
        let seen = self.seen(pixel);
        let of_four = |four: &Four| {
            let along = |i: usize, place: f32x4| {
                place * slopes[i] + (place * place - 1.0 / 12.0) * bends[i]
            };
            let light = along(0, four.columns) + along(1, four.rows) + mean;
            four.weights * light.max(f32x4::ZERO)
        };
        let fours = self.nodes.fours().iter();
        let sum: f32x4 = match self.light.polarised(pixel) {
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

//! Speckle times light, integrated over each pixel.

use super::View;
use super::defocus::Blur;
use super::irradiance::Irradiance;
use super::light::Light;
use super::pixels::{BLOCK, middle};
use super::speckle::{Nearby, PixelReader, Reader};
use rayon::prelude::*;
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
    let faint = faint(&light, view);
    tasks.into_par_iter().for_each(|(task, values)| {
        let first = rows.start(task.start);
        // Numbers of the next pixel of each row. By blocks of columns, so that what is read of speckle
        // in one row is at hand in the next.
        let mut next: Vec<usize> = task.clone().map(|row| rows.start(row)).collect();
        for block in 0..rows.pixels.blocks() {
            let mut nearby = [const { Nearby::NONE }; BLOCK];
            for (row, pixel) in task.clone().zip(&mut next) {
                for column in rows.pixels.in_block(row, block) {
                    let near = &mut nearby[column % BLOCK];
                    let reader = reader.as_ref();
                    let reader = reader.map(|reader| reader.pixel(middle(column, row), near));
                    values[*pixel - first] = exposed(&light, *pixel, reader, faint[column]);
                    *pixel += 1;
                }
            }
        }
    });
    Irradiance::new(light.rows, values)
}

/// In each column the light up to which speckle is read in the middle of the pixel alone. It is none in a
/// sharp image; one whose light is spread has wide and faint tails, which move no centroid.
fn faint(light: &Light, view: &View) -> Vec<f32> {
    let mut faint = vec![0.0; light.rows.pixels.columns];
    if view.lens.blur == Blur::Mean {
        for (column, _, samples) in light.pixels() {
            faint[column] = samples.iter().fold(faint[column], |most, &e| e.max(most));
        }
        faint.iter_mut().for_each(|most| *most *= FAINT);
    }
    faint
}

/// Mean irradiance of a pixel, by its number, with the speckle that `reader` has there; see [`faint`].
#[inline(always)]
fn exposed(light: &Light, pixel: usize, reader: Option<PixelReader>, faint: f32) -> f32 {
    let samples = light.samples(pixel);
    let fours = light.nodes.fours().iter().zip(samples.chunks(4));
    let weighted = |(four, irradiance): (&super::grid::Four, &[f32])| {
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
        Some(mut reader) if samples.iter().all(|&irradiance| irradiance < faint) => {
            let seen = light.seen(pixel).first().copied().unwrap_or_default();
            fours.map(weighted).sum::<f32x4>() * reader.middle(seen)
        }
        Some(mut reader) => {
            let seen = light.seen(pixel);
            let all = [seen.first().copied().unwrap_or_default(); 4];
            let read = |(i, (four, irradiance)): (usize, (&super::grid::Four, &[f32]))| {
                let seen = match seen.len() {
                    1 => &all,
                    _ => seen.get(4 * i..).unwrap_or(&[]),
                };
                let speckle = reader.four(four.columns, four.rows, seen, four.count);
                weighted((four, irradiance)) * speckle
            };
            fours.enumerate().map(read).sum()
        }
    };
    sum.reduce_add()
}

//! Speckle times light, integrated over each pixel.

use super::View;
use super::irradiance::Irradiance;
use super::light::Light;
use super::pixels::middle;
use super::speckle::Reader;
use rayon::prelude::*;
use wide::f32x4;

/// Rows of a task.
const ROWS_PER_TASK: usize = 128;

/// Mean irradiance of each pixel of the light, mW/mm²: over the samples of its grid the
/// weighted sum of irradiance times speckle, which is read where the sample lies.
pub fn expose(light: Light, view: &View) -> Irradiance {
    let camera_from_laser = view.part_from_camera.inverse() * view.part_from_laser;
    let speckle = view.speckle.as_ref();
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
    tasks.into_par_iter().for_each(|(task, values)| {
        let first = rows.start(task.start);
        for row in task {
            for (column, pixel) in rows.pixels.of(row).zip(rows.start(row)..) {
                let reader = reader.as_ref().map(|reader| (reader, column, row));
                values[pixel - first] = exposed(&light, pixel, reader);
            }
        }
    });
    Irradiance::new(light.rows, values)
}

/// Mean irradiance of a pixel, by its number, with the speckle that `reader` has in this
/// column and row.
#[inline(always)]
fn exposed(light: &Light, pixel: usize, reader: Option<(&Reader, usize, usize)>) -> f32 {
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
        Some((reader, column, row)) => {
            let mut reader = reader.pixel(middle(column, row));
            let seen = light.seen(pixel);
            let read = |(i, (four, irradiance)): (usize, (&super::grid::Four, &[f32]))| {
                let seen = seen.get(4 * i..).unwrap_or(&[]);
                let speckle = reader.four(four.columns, four.rows, seen, four.count);
                weighted((four, irradiance)) * speckle
            };
            fours.enumerate().map(read).sum()
        }
    };
    sum.reduce_add()
}

//! Speckle times light, integrated over each pixel.

use super::View;
use super::irradiance::Irradiance;
use super::light::Light;
use super::pixels::middle;
use super::reference::Seen;
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
    let rows = (0..light.rows.pixels.rows).into_par_iter();
    let values = rows.step_by(ROWS_PER_TASK).map(|first| {
        let end = (first + ROWS_PER_TASK).min(light.rows.pixels.rows);
        let rows = first..end;
        let mut values = Vec::with_capacity(rows.clone().map(|row| light.rows.count(row)).sum());
        for row in rows {
            let columns = light.rows.pixels.of(row).zip(light.rows.start(row)..);
            values.extend(columns.map(|(column, pixel)| {
                exposed(
                    &light,
                    pixel,
                    reader.as_ref().map(|reader| (reader, column, row)),
                )
            }));
        }
        values
    });
    let values = values.collect::<Vec<Vec<f32>>>().concat();
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
            let reader = reader.pixel(middle(column, row));
            let seen = light.seen(pixel);
            let read = |(i, (four, irradiance)): (usize, (&super::grid::Four, &[f32]))| {
                let surface = |k| seen.get(4 * i + k).copied().unwrap_or(Seen::default());
                let surface = [0, 1, 2, 3].map(surface);
                let speckle = reader.four(four.columns, four.rows, surface, four.count);
                weighted((four, irradiance)) * speckle
            };
            fours.enumerate().map(read).sum()
        }
    };
    sum.reduce_add()
}

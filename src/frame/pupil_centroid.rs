//! Moves the light of a surface that illuminates the pupil non-uniformly to the centroid of its
//! blur.
//!
//! A lobe that sends light through one side of the pupil moves the centroid of the blur by
//! (b/2)·⟨u⟩. Here b is the diameter of the blur and ⟨u⟩ the light-weighted mean pupil point in
//! pupil radii (Seitz & Tiziani 1993). From there, the lens spreads the light as for a uniformly
//! filled pupil. The centroid is exact, and the shape of the blur is the shape for a full pupil.

use super::direct_light::DirectIrradiance;
use super::pixel_mask::PixelNumbering;
use super::speckle_strips::TangentPlane;

/// Fraction of a sample's light and its new position.
struct Moved {
    /// Index of the source sample.
    from: usize,
    /// Column and row of the target sample.
    to: [usize; 2],
    irradiance: f32,
}

/// Returns the light after the move. Light that is moved beyond the sensor is lost. If nothing is
/// skewed, the input is returned unchanged.
pub fn pupil_centroid_shift(light: DirectIrradiance) -> DirectIrradiance {
    if light.pupil_centroid_shift.is_empty() {
        return light;
    }
    let side = light.nodes.side();
    let moved = moved(&light, side);
    let mut pixels = light.rows.pixels.clone();
    for Moved { to: [x, y], .. } in &moved {
        pixels.insert(y / side, x / side, x / side);
    }
    let rows = PixelNumbering::new(pixels);
    // Columns of the pixels of each row, and their indices.
    let numbers: Vec<Vec<_>> = (0..rows.pixels.rows)
        .map(|row| rows.pixels.of(row).zip(rows.start(row)..).collect())
        .collect();
    let samples = side * side * rows.total();
    let (mut irradiance, mut blur) = (vec![0.0; samples], vec![0.0; samples]);
    let mut brightest = vec![0.0; samples];
    let mut polarised = vec![
        0.0;
        if light.degree_of_polarisation.is_empty() {
            0
        } else {
            samples
        }
    ];
    let mut surface =
        vec![TangentPlane::default(); if light.surface.is_empty() { 0 } else { samples }];
    for part in moved {
        let [x, y] = part.to;
        let row: &[(usize, usize)] = &numbers[y / side];
        let at = row.partition_point(|&(column, _)| column < x / side);
        let to = side * side * row[at].1 + y % side * side + x % side;
        irradiance[to] += part.irradiance;
        blur[to] += part.irradiance * light.blur[part.from];
        if let Some(polarised) = polarised.get_mut(to) {
            *polarised += part.irradiance * light.degree_of_polarisation[part.from];
        }
        if let Some(seen) = surface.get_mut(to)
            && part.irradiance > brightest[to]
        {
            *seen = light.surface[part.from];
            brightest[to] = part.irradiance;
        }
    }
    for means in [&mut blur, &mut polarised] {
        for (mean, &irradiance) in means.iter_mut().zip(&irradiance) {
            if irradiance > 0.0 {
                *mean /= irradiance;
            }
        }
    }
    DirectIrradiance {
        rows,
        irradiance,
        surface,
        blur,
        pupil_centroid_shift: Vec::new(),
        degree_of_polarisation: polarised,
        ..light
    }
}

/// Returns the light of all lit samples, distributed bilinearly over the samples around the new
/// position.
fn moved(light: &DirectIrradiance, side: usize) -> Vec<Moved> {
    let (columns, rows) = (light.rows.pixels.columns, light.rows.pixels.rows);
    let on_sensor = [(columns * side) as f32, (rows * side) as f32];
    let mut moved = Vec::new();
    for row in 0..rows {
        for (column, pixel) in light.rows.pixels.of(row).zip(light.rows.start(row)..) {
            for (i, &irradiance) in light.samples(pixel).iter().enumerate() {
                let from = side * side * pixel + i;
                let [by_x, by_y] =
                    light.pupil_centroid_shift[from].map(|pixels| pixels * side as f32);
                let x = (column * side + i % side) as f32 + by_x;
                let y = (row * side + i / side) as f32 + by_y;
                for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
                    let (to_x, to_y) = (x.floor() + dx, y.floor() + dy);
                    let share = (1.0 - (x - to_x).abs()) * (1.0 - (y - to_y).abs());
                    let inside =
                        (0.0..on_sensor[0]).contains(&to_x) && (0.0..on_sensor[1]).contains(&to_y);
                    if inside && share * irradiance > 0.0 {
                        moved.push(Moved {
                            from,
                            to: [to_x as usize, to_y as usize],
                            irradiance: share * irradiance,
                        });
                    }
                }
            }
        }
    }
    moved
}

//! Predicted build times of a race, extrapolated from builds of parts of the mesh. A build in an
//! external crate cannot be stopped, so a build that would take too long must not start.

use super::racers;
use crate::error::Result;
use crate::mesh::Mesh;
use std::sync::Arc;
use std::time::Instant;

/// Number of triangles below which a build takes less time than its prediction.
const SMALL: usize = 200_000;
/// Subsampling factors of the parts: every n-th triangle of the mesh.
const STEPS: [usize; 2] = [64, 16];

/// Returns the predicted time of one build of every racer, s, in the order of
/// [`entrants`](racers::entrants). If the smaller part already predicts more than `limit`, the
/// larger part is not built. Small meshes give zeros. `step` is called after each build and may
/// stop it. Returns the errors of `step` and Embree.
pub fn builds(mesh: &Mesh, limit: f64, step: &dyn Fn() -> Result<()>) -> Result<Vec<f64>> {
    let entrants = racers::entrants();
    if mesh.triangles.len() < SMALL {
        return Ok(vec![0.0; entrants.len()]);
    }
    let parts = STEPS.map(|every| Arc::new(part(mesh, every)));
    let mut forecasts = Vec::new();
    for entrant in entrants {
        let mut times = Vec::new();
        for part in &parts {
            let start = Instant::now();
            drop((entrant.build)(part)?);
            times.push(start.elapsed().as_secs_f64());
            step()?;
            // The time of the larger part grows at least in proportion to its size.
            if times[0] * STEPS[0] as f64 > limit {
                break;
            }
        }
        forecasts.push(whole(&times));
    }
    Ok(forecasts)
}

/// Extrapolates the build time of the complete mesh from the times of its parts. The time is
/// modelled as a power of the size, with an exponent from 1 to 2.
fn whole(times: &[f64]) -> f64 {
    let (last, every) = (times[times.len() - 1], STEPS[times.len() - 1]);
    let power = match times {
        [few, many] => (many / few).ln() / ((STEPS[0] / STEPS[1]) as f64).ln(),
        _ => 1.0,
    };
    last * (every as f64).powf(power.clamp(1.0, 2.0))
}

/// Returns every n-th triangle, with its vertices.
fn part(mesh: &Mesh, every: usize) -> Mesh {
    let mut new = vec![u32::MAX; mesh.positions.len()];
    let mut positions = Vec::new();
    let mut vertex = |old: u32| {
        let new = &mut new[old as usize];
        if *new == u32::MAX {
            *new = positions.len() as u32;
            positions.push(mesh.positions[old as usize]);
        }
        *new
    };
    let triangles = mesh.triangles.iter().step_by(every);
    let triangles = triangles.map(|corners| corners.map(&mut vertex)).collect();
    Mesh {
        positions,
        triangles,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::shapes;

    #[test]
    fn a_forecast_follows_the_growth_of_the_parts() {
        assert!((whole(&[1.0, 4.0]) - 64.0).abs() < 1e-9);
        assert!((whole(&[1.0, 16.0]) - 16.0 * 256.0).abs() < 1e-6);
        // The exponent is limited to 1 to 2, so noise cannot reverse or inflate the growth.
        assert!((whole(&[1.0, 0.5]) - 8.0).abs() < 1e-9);
        assert!((whole(&[1e-9, 1.0]) - 256.0).abs() < 1e-9);
        assert!((whole(&[3.0]) - 192.0).abs() < 1e-9);
    }

    #[test]
    fn a_part_holds_the_same_triangles() {
        let mesh = shapes::sphere(5.0, 0.1).unwrap();
        let part = part(&mesh, 16);
        assert_eq!(part.triangles.len(), mesh.triangles.len().div_ceil(16));
        for i in 0..part.triangles.len() {
            assert_eq!(part.triangle(i), mesh.triangle(16 * i));
        }
    }
}

//! Laser light at the part: first vertices of light paths, and the irradiance at a given point.

use super::PoseView;
use super::random_walk::PathVertex;
use crate::accel::{Hit, Ray, WIDTH};
use crate::laser::gaussian;
use crate::math::{DVec2, DVec3, Rigid};
use smallvec::SmallVec;

/// Fraction of the starts that is uniformly distributed.
const UNIFORM_FRACTION: f64 = 0.25;

/// Distribution of the starts of light paths along the fan.
pub(super) struct FanImportance {
    /// Cumulative probability before each bin, followed by 1.
    first: Vec<f64>,
}

impl FanImportance {
    /// Builds a distribution proportional to `needs`, one value for each of equally wide bins,
    /// mixed with the uniform one.
    pub fn new(needs: &[f64]) -> FanImportance {
        let all: f64 = needs.iter().sum();
        let even = 1.0 / needs.len() as f64;
        let mut first = vec![0.0];
        for (part, need) in needs.iter().enumerate() {
            let share = if all > 0.0 { need / all } else { even };
            let share = UNIFORM_FRACTION * even + (1.0 - UNIFORM_FRACTION) * share;
            first.push(first[part] + share);
        }
        FanImportance { first }
    }

    fn bins(&self) -> usize {
        self.first.len() - 1
    }

    /// Maps a uniform random number in 0 to 1 to a position in 0 to 1, and returns its probability
    /// density.
    fn drawn(&self, u: f64) -> (f64, f64) {
        let bins = self.bins();
        let part = self.first[1..bins].partition_point(|&first| first <= u);
        let share = self.first[part + 1] - self.first[part];
        let within = ((u - self.first[part]) / share).clamp(0.0, 1.0 - f64::EPSILON);
        ((part as f64 + within) / bins as f64, share * bins as f64)
    }

    /// Returns the probability density at a position in 0 to 1.
    pub fn density(&self, position: f64) -> f64 {
        let bins = self.bins();
        let part = ((position * bins as f64) as usize).min(bins - 1);
        (self.first[part + 1] - self.first[part]) * bins as f64
    }
}

/// Laser of a view.
pub(super) struct LaserEmitter<'a> {
    pub view: &'a PoseView<'a>,
    pub laser_from_part: Rigid,
    pub starts: FanImportance,
}

impl<'a> LaserEmitter<'a> {
    /// Creates the emitter with uniform starts.
    pub fn new(view: &'a PoseView<'a>) -> LaserEmitter<'a> {
        LaserEmitter {
            view,
            laser_from_part: view.part_from_laser.inverse(),
            starts: FanImportance::new(&[1.0]),
        }
    }

    /// Traces up to a packet of light paths to their first vertices. Uniform `numbers` of the unit
    /// square are distributed as [`Self::starts`].
    pub fn first_vertices(&self, numbers: &[DVec2]) -> SmallVec<[Option<PathVertex>; WIDTH]> {
        let view = self.view;
        let to_part = &view.part_from_laser;
        let center = self.laser_from_part.point(view.accel.bounds().center());
        // A part behind the laser has no valid distance.
        let middle = view.laser.distance(center).max(1.0);
        let mut far = [middle; WIDTH];
        let mut hits = [None; WIDTH];
        let drawn = |u: &DVec2| {
            let (along, density) = self.starts.drawn(u.x);
            (view.laser.sample_ray(DVec2::new(along, u.y)), density)
        };
        let streams: SmallVec<[_; WIDTH]> = numbers.iter().map(drawn).collect();
        // Flow lines are only slightly curved. The second chord ends at the distance of the first
        // hit and therefore follows the light.
        for _ in 0..2 {
            let mut rays = [Ray::between(DVec3::ZERO, DVec3::Z).expect("a length"); WIDTH];
            for (i, (stream, _)) in streams.iter().enumerate() {
                let [aperture, aim] = [0.0, far[i]].map(|far| to_part.point(stream.at(far)));
                if let Some(ray) = Ray::between(aperture, aim) {
                    rays[i] = Ray {
                        t_max: f64::INFINITY,
                        ..ray
                    };
                }
            }
            hits = view.accel.closest(&rays[..numbers.len()], |_, _| true);
            for (far, hit) in far.iter_mut().zip(&hits) {
                if let Some(hit) = hit {
                    *far = view.laser.distance(self.laser_from_part.point(hit.point));
                }
            }
        }
        let vertex = |(hit, (_, density)): (&Option<Hit>, &(_, f64))| {
            let hit = hit.as_ref()?;
            let (_, vertex) = self.lit(hit.point, hit.normal, hit.face.triangle)?;
            // The weights of sampling strategies assume uniform starts.
            Some(PathVertex {
                beta: vertex.beta / density,
                ..vertex
            })
        };
        hits.iter().zip(&streams).map(vertex).collect()
    }

    /// Returns the received irradiance (mW/mm²) at a point lit by the laser, and the first vertex
    /// of a light path there.
    pub fn lit(&self, point: DVec3, normal: DVec3, triangle: u32) -> Option<(f64, PathVertex)> {
        let laser = self.view.laser;
        let seen = self.laser_from_part.point(point);
        let section = laser.section(seen)?;
        let flux = self.view.part_from_laser.vector(section.flux);
        let share = gaussian(laser.off_middle(seen).length_squared(), section.radius);
        let received = -flux.dot(normal) * share;
        let vertex = PathVertex {
            point,
            normal,
            triangle,
            from: -flux.normalize_or_zero(),
            beta: laser.beam.power_mw,
            pdf_fwd: received / laser.beam.power_mw,
            pdf_rev: 0.0,
            is_delta: false,
        };
        (received > 0.0).then_some((received, vertex))
    }
}

//! Paths of light followed from surface to surface, from the laser or from the camera.

use super::View;
use crate::accel::{Hit, Ray, WIDTH};
use crate::math::{DVec2, DVec3, Sequence};
use crate::surface::Scatter;

/// Where a path meets the part.
#[derive(Clone, Copy)]
pub(super) struct Vertex {
    /// Part's frame, mm.
    pub point: DVec3,
    /// On the side from which it was met.
    pub normal: DVec3,
    /// Of the mesh.
    pub triangle: u32,
    /// Towards where the path came from, unit.
    pub from: DVec3,
    /// What the path carries to here: mW from the laser; from the camera irradiance on the sensor per
    /// radiance, sr.
    pub carried: f64,
    /// How likely the path comes here, 1/mm².
    pub forward: f64,
    /// How likely one that goes the other way would; known when the path has gone on by two.
    pub backward: f64,
    /// Whether it went on by a mirror.
    pub mirrored: bool,
}

impl Vertex {
    pub fn scatter<'a>(&self, view: &'a View) -> Scatter<'a> {
        let surface = view.surface.of(self.triangle);
        surface.scatter(self.point, self.normal, self.from)
    }

    /// Where rays from it start, off the surface.
    pub fn start(&self, view: &View) -> DVec3 {
        self.point + self.normal * view.accel.resolution()
    }

    /// From solid angle at `from` to area here, 1/mm².
    pub fn angle_per_area(&self, from: DVec3) -> f64 {
        let way = from - self.point;
        let far2 = way.length_squared();
        (way.dot(self.normal) / far2.sqrt()).max(0.0) / far2
    }
}

/// Random numbers of a path: one pair of dimensions for its start, one for the pupil, three for each vertex.
pub(super) struct Numbers<'a> {
    pub sequence: &'a Sequence,
    pub index: u32,
    /// The first dimension.
    pub first: u32,
}

/// Pairs of dimensions that a vertex takes.
const OF_VERTEX: u32 = 3;

impl Numbers<'_> {
    pub fn start(&self) -> DVec2 {
        self.sequence.pair(self.index, self.first)
    }

    pub fn pupil(&self, vertex: usize) -> DVec2 {
        self.of(vertex, 0)
    }

    fn of(&self, vertex: usize, which: u32) -> DVec2 {
        let dimension = self.first + 1 + OF_VERTEX * vertex as u32 + which;
        self.sequence.pair(self.index, dimension)
    }
}

/// Reflections after which a path may end by chance.
const SURE: usize = 2;

/// Lets up to a packet of paths go on, each of which has one vertex or none, to at most `most` vertices.
pub(super) fn walk(view: &View, paths: &mut [Vec<Vertex>], numbers: &[Numbers], most: usize) {
    for depth in 1..most {
        let (mut rays, mut of) = ([None; WIDTH], [0; WIDTH]);
        let mut count = 0;
        let mut densities = [None; WIDTH];
        for (i, path) in paths.iter_mut().enumerate() {
            if path.len() != depth {
                continue;
            }
            let last = path[depth - 1];
            let [way, u] = [1, 2].map(|which| numbers[i].of(depth - 1, which));
            let Some(drawn) = last.scatter(view).draw(way.x, u) else {
                continue;
            };
            // Russian roulette: what goes on carries as much.
            let chance = match depth < SURE {
                true => 1.0,
                false => drawn.share.clamp(0.05, 1.0),
            };
            if way.y >= chance || drawn.direction.dot(last.normal) <= 0.0 {
                continue;
            }
            let last = &mut path[depth - 1];
            last.mirrored = drawn.density.is_none();
            let carried = last.carried * drawn.share / chance;
            rays[count] = Some(Ray {
                origin: last.start(view),
                direction: drawn.direction,
                t_max: f64::INFINITY,
            });
            densities[count] = Some((drawn.density.unwrap_or(1.0), carried));
            of[count] = i;
            count += 1;
        }
        if count == 0 {
            return;
        }
        let packet: Vec<Ray> = rays.iter().flatten().copied().collect();
        let hits: [Option<Hit>; WIDTH] = view.accel.closest(&packet, |_, _| true);
        for k in 0..count {
            let (Some(hit), Some((density, carried))) = (&hits[k], densities[k]) else {
                continue;
            };
            let path = &mut paths[of[k]];
            let last = path[depth - 1];
            let from = -packet[k].direction;
            let mut vertex = Vertex {
                point: hit.point,
                normal: hit.normal,
                triangle: hit.face.triangle,
                from,
                carried,
                forward: 0.0,
                backward: 0.0,
                mirrored: false,
            };
            vertex.forward = density * vertex.angle_per_area(last.point);
            // A ray along the surface meets nothing that counts.
            if vertex.forward <= 0.0 || !vertex.forward.is_finite() {
                continue;
            }
            if depth >= 2 {
                let back = match last.mirrored {
                    true => 1.0,
                    false => last.scatter(view).density_back(-from),
                };
                let before = &mut path[depth - 2];
                before.backward = back * before.angle_per_area(last.point);
            }
            path.push(vertex);
        }
    }
}

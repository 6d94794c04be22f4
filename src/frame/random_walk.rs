//! Random walks of light paths from surface to surface, from the laser or from the camera.

use super::PoseView;
use crate::accel::{Hit, Ray, WIDTH};
use crate::math::{DVec2, DVec3, Sequence};
use crate::surface::Scatter;
use std::ops::Range;

/// Vertex of a path on the part.
#[derive(Clone, Copy)]
pub(super) struct PathVertex {
    /// Position in the part's frame, mm.
    pub point: DVec3,
    /// Unit normal on the side that the path hits.
    pub normal: DVec3,
    /// Triangle index in the mesh.
    pub triangle: u32,
    /// Unit vector towards the previous vertex.
    pub from: DVec3,
    /// Path throughput β up to this vertex. Light paths: power, mW. Camera paths: sensor irradiance
    /// per radiance, sr.
    pub beta: f64,
    /// Area density of the forward path at this vertex, mm⁻².
    pub pdf_fwd: f64,
    /// Area density of the reverse path at this vertex, mm⁻². It is known once the path has two
    /// more vertices.
    pub pdf_rev: f64,
    /// True if the path continues from here by specular reflection.
    pub is_delta: bool,
}

impl PathVertex {
    pub fn scatter<'a>(&self, view: &'a PoseView) -> Scatter<'a> {
        let surface = view.surface.of(self.triangle);
        surface.scatter(self.point, self.normal, self.from)
    }

    /// Returns the origin of rays that leave this vertex, offset from the surface.
    pub fn start(&self, view: &PoseView) -> DVec3 {
        self.point + self.normal * view.accel.resolution()
    }

    /// Returns the conversion factor from solid angle at `from` to area at this vertex, 1/mm².
    pub fn solid_angle_to_area(&self, from: DVec3) -> f64 {
        let way = from - self.point;
        let far2 = way.length_squared();
        (way.dot(self.normal) / far2.sqrt()).max(0.0) / far2
    }
}

/// Random numbers of a path: one pair of dimensions for its start, one for the pupil, three for
/// each vertex.
pub(super) struct PathSampler<'a> {
    pub sequence: &'a Sequence,
    pub index: u32,
    /// First dimension of the path.
    pub first: u32,
}

/// Pairs of dimensions per vertex.
const DIMENSION_PAIRS_PER_VERTEX: u32 = 3;

impl PathSampler<'_> {
    pub fn start(&self) -> DVec2 {
        self.sequence.pair(self.index, self.first)
    }

    pub fn pupil(&self, vertex: usize) -> DVec2 {
        self.of(vertex, 0)
    }

    fn of(&self, vertex: usize, which: u32) -> DVec2 {
        let dimension = self.first + 1 + DIMENSION_PAIRS_PER_VERTEX * vertex as u32 + which;
        self.sequence.pair(self.index, dimension)
    }
}

/// Number of bounces before Russian roulette may terminate a path.
const RR_START_BOUNCE: usize = 2;

/// Extends up to a packet of paths by one vertex per number in `depths`, the number of vertices that
/// a path has before. Other paths are not extended.
pub(super) fn random_walk(
    view: &PoseView,
    paths: &mut [Vec<PathVertex>],
    numbers: &[PathSampler],
    depths: Range<usize>,
) {
    for depth in depths {
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
            // Russian roulette: surviving paths are weighted by 1/chance, so the estimate is
            // unbiased.
            let chance = match depth < RR_START_BOUNCE {
                true => 1.0,
                false => drawn.share.clamp(0.05, 1.0),
            };
            if way.y >= chance || drawn.direction.dot(last.normal) <= 0.0 {
                continue;
            }
            let last = &mut path[depth - 1];
            last.is_delta = drawn.pdf.is_none();
            let carried = last.beta * drawn.share / chance;
            rays[count] = Some(Ray {
                origin: last.start(view),
                direction: drawn.direction,
                t_max: f64::INFINITY,
            });
            densities[count] = Some((drawn.pdf.unwrap_or(1.0), carried));
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
            let mut vertex = PathVertex {
                point: hit.point,
                normal: hit.normal,
                triangle: hit.face.triangle,
                from,
                beta: carried,
                pdf_fwd: 0.0,
                pdf_rev: 0.0,
                is_delta: false,
            };
            vertex.pdf_fwd = density * vertex.solid_angle_to_area(last.point);
            // Rays along the surface have zero or infinite density and are ignored.
            if vertex.pdf_fwd <= 0.0 || !vertex.pdf_fwd.is_finite() {
                continue;
            }
            if depth >= 2 {
                let back = match last.is_delta {
                    true => 1.0,
                    false => last.scatter(view).pdf_reverse(-from),
                };
                let before = &mut path[depth - 2];
                before.pdf_rev = back * before.solid_angle_to_area(last.point);
            }
            path.push(vertex);
        }
    }
}

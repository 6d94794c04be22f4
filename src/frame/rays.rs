//! What rays of the camera see: nothing, surface, lit surface.

use super::View;
use super::gloss::Gloss;
use super::pixels::{SIDE, middle};
use super::sight::Sight;
use crate::accel::{Hit, Ray, WIDTH};
use crate::laser::gaussian;
use crate::math::{DVec2, DVec3, Rigid};
use crate::surface::{Kind, Surface};
use smallvec::SmallVec;
use std::cell::Cell;

/// How far (beam radii) neighbours may lie beside the plane of a pixel, along its
/// ray, for its samples to be taken from that plane: so much the line would seem
/// moved a pixel off, and a ninth of it within the pixel if the surface is curved.
const PLANE_TOLERANCE: f64 = 0.01;
/// Cosine of the greatest angle between their normals, 3°: across an edge between
/// facets the light received changes by 5 % where it falls at 45°.
pub(super) const NORMAL_TOLERANCE: f32 = 0.9986;

/// Distance (beam radii) by which the part of the sensor around a place must overlap the light for the place to be
/// lit, if the place itself is beyond the light.
///
/// A choice: places left out have at most e^c times the light at its end, c radii from the axis.
const COARSE: f64 = 0.25;

/// Longest footprint of a pixel on a surface seen nearly edge-on, over one face-on, whose light is computed. 20 is
/// reached at 87.1°. A choice of speed: longer ones are computed too where their centre is near the sheet.
const LONG: f64 = 20.0;

/// What a ray meets.
#[derive(Clone, Copy)]
pub(super) enum Met {
    Nothing,
    /// Surface that is too far from the laser's sheet to be looked at, on its upper or lower side.
    Far {
        above: bool,
    },
    /// Beyond the end of the light, with all of the sensor's part around it.
    Dark(Plane),
    /// Beyond the end of the light, but the sensor's part around it may see light.
    Beside(Plane),
    /// Facing away from the laser, hidden from it or outside its fan.
    Unlit(Plane),
    Lit(Lit, Plane),
}

/// The surface that a ray meets, in the laser's frame.
#[derive(Clone, Copy)]
pub(super) struct Plane {
    pub point: DVec3,
    pub normal: DVec3,
    /// Greatest distance (mm) from it of neighbours that count as on it.
    pub tolerance: f32,
    /// Number of the surface's kind.
    pub kind: u32,
}

impl Plane {
    /// How the point that a ray meets moves, of each length of the ray, as its direction changes by each of these
    /// steps, to first order; and n·step/n·direction, by which that grows: see [`Profile`](super::flat::Profile).
    pub fn moves(&self, direction: DVec3, steps: [DVec3; 2]) -> ([DVec3; 2], [f64; 2]) {
        let along = self.normal.dot(direction);
        let ratios = steps.map(|step| self.normal.dot(step) / along);
        let moves = [0, 1].map(|i| steps[i] - direction * ratios[i]);
        (moves, ratios)
    }
}

/// Lit surface that a ray meets.
#[derive(Clone, Copy)]
pub(super) struct Lit {
    /// Irradiance on the sensor (mW/mm²) were this the middle of the beam.
    pub irradiance: f64,
    /// Square of the distance from that middle, mm².
    pub off2: f64,
    /// 1/e² radius of the beam there, mm.
    pub radius: f64,
}

impl Lit {
    /// What the beam's profile leaves of it.
    pub fn share(&self) -> f64 {
        gaussian(self.off2, self.radius)
    }
}

/// Up to a packet of rays.
pub(super) type Rays = SmallVec<[Ray; WIDTH]>;

/// A kind of surface.
struct Scatters<'a> {
    /// BRDF of one that is Lambert's, 1/sr.
    matt: f64,
    /// Of one that is not.
    gloss: Option<Gloss<'a>>,
    polarised: f32,
}

impl<'a> Scatters<'a> {
    fn new(view: &'a View<'a>, kind: &'a Kind, skewed: bool) -> Scatters<'a> {
        Scatters {
            matt: match &kind.surface {
                Surface::Lambert(lambert) => lambert.bsdf(),
                Surface::Glossy(_) => 0.0,
            },
            gloss: (kind.surface.glossy()).map(|glossy| Gloss::new(view, glossy, skewed)),
            polarised: kind.polarised as f32,
        }
    }
}

/// A view's rays.
pub(super) struct LitRays<'a> {
    pub view: &'a View<'a>,
    pub sight: &'a Sight,
    /// The same in the laser's frame.
    pub from_laser: Sight,
    /// See [`Sight::steps`]; in the laser's frame.
    steps: [DVec3; 2],
    laser_from_part: Rigid,
    /// The kinds of surface.
    kinds: Vec<Scatters<'a>>,
    /// Normal of the laser's sheet.
    across: DVec3,
    /// Hits further from the sheet than this (mm) are not looked at: they are dark.
    far: f64,
}

impl<'a> LitRays<'a> {
    /// `skewed`: whether it matters where in the pupil light passes.
    pub fn new(view: &'a View<'a>, sight: &'a Sight, skewed: bool) -> LitRays<'a> {
        let laser_from_part = view.part_from_laser.inverse();
        let laser_from_camera = laser_from_part * view.part_from_camera;
        let corners = view.accel.bounds().corners();
        let corners = corners.map(|corner| laser_from_part.point(corner));
        let nearest = corners.iter().map(|p| p.z).fold(f64::INFINITY, f64::min);
        let furthest = corners.iter().map(|p| p.length()).fold(0.0, f64::max);
        let cutoff = view.cutoff_radii;
        let widest = view.laser.reach(nearest.max(0.0), furthest, cutoff);
        let from_laser = Sight::new(view.camera, &laser_from_camera);
        let steps = from_laser.steps();
        let depth = corners.iter().map(|p| p.distance(from_laser.eye));
        let pixel = steps[0].length().max(steps[1].length()) * depth.fold(0.0, f64::max);
        LitRays {
            view,
            sight,
            steps,
            from_laser,
            laser_from_part,
            kinds: (view.surface.kinds().iter())
                .map(|kind| Scatters::new(view, kind, skewed))
                .collect(),
            across: view.part_from_laser.rotation.y_axis,
            far: 2.0 * widest.y + LONG * pixel + view.accel.refinement(),
        }
    }

    /// The surface there, unless it is Lambert's.
    #[inline(always)]
    pub fn gloss(&self, plane: &Plane) -> Option<&Gloss<'a>> {
        self.kinds[plane.kind as usize].gloss.as_ref()
    }

    /// Degree of polarisation of the light from there.
    pub fn polarised(&self, plane: &Plane) -> f32 {
        self.kinds[plane.kind as usize].polarised
    }

    /// Whether there are several kinds of surface.
    pub fn are_mixed(&self) -> bool {
        self.kinds.len() > 1
    }

    /// Whether some surface is not Lambert's.
    pub fn is_glossy(&self) -> bool {
        self.kinds.iter().any(|kind| kind.gloss.is_some())
    }

    /// Greatest difference of unit normals over which all surfaces are the same; `None`: any.
    pub fn constant_turn(&self) -> Option<f32> {
        let glossy = self.kinds.iter().filter_map(|kind| kind.gloss.as_ref());
        glossy.map(Gloss::constant_turn).reduce(f32::min)
    }

    /// Whether over a pixel, within which a plane is seen to move by `moves` (laser's frame, mm) as
    /// the direction to it turns by `steps`, surface and laser say that they are constant.
    #[inline(always)]
    pub fn is_constant_over(
        &self,
        plane: &Plane,
        moves: [DVec3; 2],
        steps: [DVec3; 2],
        direction: DVec3,
    ) -> bool {
        let limit = self.view.laser.constant_angle();
        let along = moves.map(|step| step.x.abs());
        let even = limit == f64::INFINITY || along[0].max(along[1]) <= limit * plane.point.z;
        even && self.gloss(plane).is_none_or(|gloss| {
            let turns = steps.map(|step| step.length() / direction.length());
            gloss.is_constant_over([plane.point, plane.normal], moves, turns)
        })
    }

    /// What the centres of those pixels of a tile that are `wanted` (as bits) see, row by
    /// row. `around`: see [`Self::look`].
    pub fn centers(
        &self,
        band: usize,
        first: usize,
        wanted: u16,
        around: f64,
        centers: &mut [Met; WIDTH],
    ) {
        let resolution = self.view.camera.sensor.resolution;
        let (mut pixels, mut count) = ([0; WIDTH], 0);
        let mut rays_wanted = 0;
        let mut places = [DVec2::ZERO; WIDTH];
        let mut rays = Rays::new();
        let mut bend = DVec2::ZERO;
        for pixel in 0..WIDTH {
            let (column, row) = (first + pixel % SIDE, SIDE * band + pixel / SIDE);
            if column < resolution.x as usize && row < resolution.y as usize {
                let place = middle(column, row);
                let to_sensor = self.sight.to_sensor(place);
                rays.push(self.ray(self.sight.towards(to_sensor, &mut bend)));
                (pixels[count], places[count]) = (pixel, place);
                rays_wanted |= (wanted >> pixel & 1) << count;
                count += 1;
            }
        }
        self.look(&places[..count], &rays, rays_wanted, around, centers);
        if count == WIDTH {
            return;
        }
        // At the sensor's border a tile has less than sixteen.
        centers[count..].fill(Met::Nothing);
        for (i, &pixel) in pixels[..count].iter().enumerate().rev() {
            centers.swap(i, pixel);
        }
    }

    /// From the eye in this direction, of any length.
    pub fn ray(&self, towards: DVec3) -> Ray {
        Ray {
            origin: self.sight.eye,
            direction: towards.normalize(),
            t_max: f64::INFINITY,
        }
    }

    /// What rays from the eye see, up to 16, that come from these places on the sensor;
    /// those that are not `wanted` (as bits) nothing. `around`: the
    /// half side of the sensor's part around each place, pixels.
    pub fn look(
        &self,
        places: &[DVec2],
        rays: &[Ray],
        wanted: u16,
        around: f64,
        centers: &mut [Met],
    ) {
        // Rays that meet something too far from the sheet, as bits, by its side.
        let far = [const { Cell::new(0u16) }; 2];
        let near_sheet = |i: usize, t: f64| {
            let climb = self.across.dot(rays[i].direction);
            let height = self.from_laser.eye.y + t * climb;
            let is_near = height.abs() <= self.far;
            if !is_near {
                let side = &far[usize::from(height > 0.0)];
                side.set(side.get() | 1 << i);
            }
            is_near
        };
        let hits = self.view.accel.closest_some(rays, wanted, near_sheet);
        let mut shadow_rays = Rays::new();
        let mut lit = [0; WIDTH];
        for (i, ray) in rays.iter().enumerate() {
            centers[i] = match &hits[i] {
                None => match far.each_ref().map(|side| side.get() >> i & 1 == 1) {
                    [true, false] => Met::Far { above: false },
                    [false, true] => Met::Far { above: true },
                    _ => Met::Nothing,
                },
                Some(hit) => {
                    let (center, shadow_ray) = self.seen(hit, ray.direction, places[i], around);
                    if let Some(ray) = shadow_ray {
                        lit[shadow_rays.len()] = i;
                        shadow_rays.push(ray);
                    }
                    center
                }
            };
        }
        if shadow_rays.is_empty() {
            return;
        }
        let blocked = self.view.accel.occluded(&shadow_rays);
        for (bit, &i) in lit[..shadow_rays.len()].iter().enumerate() {
            if let (1, Met::Lit(_, plane)) = (blocked >> bit & 1, centers[i]) {
                centers[i] = Met::Unlit(plane);
            }
        }
    }

    /// A hit, and if it may be lit the ray on which the light may be blocked.
    fn seen(&self, hit: &Hit, direction: DVec3, place: DVec2, around: f64) -> (Met, Option<Ray>) {
        let laser = self.view.laser;
        let point = self.laser_from_part.point(hit.point);
        let section = laser.section(point);
        let normal = self.laser_from_part.vector(hit.normal);
        let radius = section.map_or(laser.beam.waist_radius, |section| section.radius);
        let plane = Plane {
            point,
            normal,
            tolerance: (PLANE_TOLERANCE * radius * direction.dot(hit.normal).abs()) as f32,
            kind: self.view.surface.number(hit.face.triangle) as u32,
        };
        let Some(section) = section else {
            return (Met::Unlit(plane), None);
        };
        let r2 = laser.off_middle(point).length_squared();
        if r2 > (self.view.cutoff_radii * radius).powi(2) {
            let nearest = || r2.sqrt() - hit.t * self.moves_across(&plane, direction, around);
            let is_near = around > 0.0 && nearest() < (self.view.cutoff_radii - COARSE) * radius;
            return match is_near {
                true => (Met::Beside(plane), None),
                false => (Met::Dark(plane), None),
            };
        }
        let received = -section.flux.dot(normal);
        let start = hit.point + hit.normal * self.view.accel.resolution();
        let aperture = self.view.part_from_laser.point(section.aperture_point);
        // At grazing light the local direction may come from the front and the
        // chord from behind: then the surface itself is in the way.
        let shadow_ray = Ray::between(start, aperture)
            .filter(|ray| received > 0.0 && ray.direction.dot(hit.normal) > 0.0);
        let Some(shadow_ray) = shadow_ray else {
            return (Met::Unlit(plane), None);
        };
        let kind = &self.kinds[plane.kind as usize];
        let bsdf = match &kind.gloss {
            None => kind.matt,
            Some(gloss) => {
                let flux = section.flux.normalize_or_zero();
                let towards_light = -self.view.part_from_laser.vector(flux);
                gloss.bsdf(hit.point, hit.normal, towards_light)
            }
        };
        let radiance = bsdf * received;
        let light = Lit {
            irradiance: radiance * self.sight.solid_angle(place, direction),
            off2: r2,
            radius,
        };
        (Met::Lit(light, plane), Some(shadow_ray))
    }

    /// By how much the distance from the middle of the beam changes at most on a plane that a ray meets, mm for
    /// each mm of the ray, up to so many pixels `around` it in column and in row. Far too much where the plane is
    /// seen edge-on.
    pub fn moves_across(&self, plane: &Plane, direction: DVec3, around: f64) -> f64 {
        let direction = self.laser_from_part.vector(direction);
        let (moves, ratios) = plane.moves(direction, self.steps);
        let across = moves.map(|step| self.view.laser.off_middle(step).length());
        let turned: f64 = ratios.iter().map(|ratio| ratio.abs()).sum();
        around * across.iter().sum::<f64>() / (1.0 - around * turned).max(f64::MIN_POSITIVE)
    }
}

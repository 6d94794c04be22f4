//! Camera rays and their classification: no hit, unlit surface or lit surface.

use super::PoseView;
use super::pinhole::PinholeGeometry;
use super::pixel_mask::{SIDE, middle};
use super::pupil_brdf::PupilAveragedBrdf;
use crate::accel::{Hit, Ray, WIDTH};
use crate::laser::gaussian;
use crate::math::{DVec2, DVec3, Rigid};
use crate::surface::{Material, Surface};
use smallvec::SmallVec;
use std::cell::Cell;

/// Maximum distance of neighbouring hits from the plane of a pixel, along its ray, in beam radii.
/// If all neighbours are nearer, the samples of the pixel are taken from the plane. At one pixel
/// from the centre, the error of the line is then at most this distance. Within the pixel, a curved
/// surface causes a ninth of that error.
const PLANE_TOLERANCE: f64 = 0.01;
/// Cosine of the maximum angle between the normals of neighbouring hits, 3°. Across an edge between
/// facets with this angle, the received light changes by 5 % at 45° incidence.
pub(super) const NORMAL_TOLERANCE: f32 = 0.9986;

/// Minimum overlap between light and the sensor area around a position, beam radii. With this
/// overlap, a position beyond the cut-off still counts as lit.
///
/// Chosen: ignored positions have at most e^c times the light at the cut-off of c radii.
const SUBSAMPLING_MARGIN_RADII: f64 = 0.25;

/// Maximum length of a pixel's footprint, relative to perpendicular view, for which light is
/// computed. The length of 20 is reached at 87.1°. The limit affects mainly speed: longer
/// footprints are computed if their centre is near the laser plane.
const LONG: f64 = 20.0;

/// First hit of a camera ray, classified by its illumination.
#[derive(Clone, Copy)]
pub(super) enum PixelHit {
    Nothing,
    /// Surface too far from the laser plane to be evaluated, above or below the plane.
    BeyondBeam {
        above: bool,
    },
    /// Hit outside the beam cut-off, including the sensor area around the position.
    OutsideBeam(SurfaceElement),
    /// Hit outside the beam cut-off; the sensor area around the position may still receive light.
    NeedsSubsampling(SurfaceElement),
    /// Hit on a surface that faces away from the laser, is occluded, or is outside the fan.
    Shadowed(SurfaceElement),
    Lit(BeamSample, SurfaceElement),
}

/// Tangent plane at the hit of a camera ray, in the laser's frame.
#[derive(Clone, Copy)]
pub(super) struct SurfaceElement {
    pub point: DVec3,
    pub normal: DVec3,
    /// Maximum distance of neighbouring hits that count as coplanar, mm.
    pub tolerance: f32,
    /// Index of the material.
    pub material_id: u32,
}

impl SurfaceElement {
    /// Returns the Jacobian of the hit point with respect to the two direction steps, per unit ray
    /// length, to first order. The second result is n·step/n·direction, the relative increase of
    /// that Jacobian; see [`Profile`](super::planar_pixel::Profile).
    pub fn image_jacobian(&self, direction: DVec3, steps: [DVec3; 2]) -> ([DVec3; 2], [f64; 2]) {
        let along = self.normal.dot(direction);
        let ratios = steps.map(|step| self.normal.dot(step) / along);
        let moves = [0, 1].map(|i| steps[i] - direction * ratios[i]);
        (moves, ratios)
    }
}

/// Illuminated hit of a camera ray.
#[derive(Clone, Copy)]
pub(super) struct BeamSample {
    /// Sensor irradiance that this hit would produce on the beam axis, mW/mm².
    pub irradiance: f64,
    /// Squared distance from the beam axis, mm².
    pub beam_offset_squared_mm2: f64,
    /// 1/e² radius of the beam at the hit, mm.
    pub radius: f64,
}

impl BeamSample {
    /// Returns the beam profile at the hit, relative to the beam axis.
    pub fn share(&self) -> f64 {
        gaussian(self.beam_offset_squared_mm2, self.radius)
    }
}

/// Rays of up to one packet.
pub(super) type Rays = SmallVec<[Ray; WIDTH]>;

/// Scattering model of one material.
struct MaterialBrdf<'a> {
    /// Lambertian BRDF ρ/π, sr⁻¹; zero for glossy materials.
    matt: f64,
    /// Pupil-averaged BRDF; `None` for Lambertian materials.
    gloss: Option<PupilAveragedBrdf<'a>>,
    degree_of_polarisation: f32,
}

impl<'a> MaterialBrdf<'a> {
    fn new(view: &'a PoseView<'a>, kind: &'a Material, skewed: bool) -> MaterialBrdf<'a> {
        MaterialBrdf {
            matt: match &kind.surface {
                Surface::Lambert(lambert) => lambert.bsdf(),
                Surface::Layered(_) => 0.0,
            },
            gloss: (kind.surface.glossy())
                .map(|glossy| PupilAveragedBrdf::new(view, glossy, skewed)),
            degree_of_polarisation: kind.degree_of_polarisation as f32,
        }
    }
}

/// Camera rays of a view.
pub(super) struct CameraRayCaster<'a> {
    pub view: &'a PoseView<'a>,
    pub pinhole: &'a PinholeGeometry,
    /// Viewing geometry in the laser's frame.
    pub pinhole_in_laser: PinholeGeometry,
    /// Bounds on the change of ray direction per pixel (see [`PinholeGeometry::steps`]), in the laser's
    /// frame.
    steps: [DVec3; 2],
    laser_from_part: Rigid,
    /// Scattering models of the materials.
    kinds: Vec<MaterialBrdf<'a>>,
    /// Normal of the laser plane.
    sheet_normal: DVec3,
    /// Distance from the laser plane beyond which hits are not evaluated and count as dark, mm.
    far: f64,
}

impl<'a> CameraRayCaster<'a> {
    /// Prepares the rays. `skewed`: true if the centroid of the light in the pupil is needed.
    pub fn new(
        view: &'a PoseView<'a>,
        sight: &'a PinholeGeometry,
        skewed: bool,
    ) -> CameraRayCaster<'a> {
        let laser_from_part = view.part_from_laser.inverse();
        let laser_from_camera = laser_from_part * view.part_from_camera;
        let corners = view.accel.bounds().corners();
        let corners = corners.map(|corner| laser_from_part.point(corner));
        let nearest = corners.iter().map(|p| p.z).fold(f64::INFINITY, f64::min);
        let furthest = corners.iter().map(|p| p.length()).fold(0.0, f64::max);
        let cutoff = view.beam_cutoff_radii;
        let widest = view.laser.reach(nearest.max(0.0), furthest, cutoff);
        let from_laser = PinholeGeometry::new(view.camera, &laser_from_camera);
        let steps = from_laser.steps();
        let depth = corners.iter().map(|p| p.distance(from_laser.camera_center));
        let pixel = steps[0].length().max(steps[1].length()) * depth.fold(0.0, f64::max);
        CameraRayCaster {
            view,
            pinhole: sight,
            steps,
            pinhole_in_laser: from_laser,
            laser_from_part,
            kinds: (view.surface.kinds().iter())
                .map(|kind| MaterialBrdf::new(view, kind, skewed))
                .collect(),
            sheet_normal: view.part_from_laser.rotation.y_axis,
            far: 2.0 * widest.y + LONG * pixel + view.accel.refinement(),
        }
    }

    /// Returns the pupil-averaged BRDF of the material at the hit; `None` for Lambertian materials.
    #[inline(always)]
    pub fn gloss(&self, plane: &SurfaceElement) -> Option<&PupilAveragedBrdf<'a>> {
        self.kinds[plane.material_id as usize].gloss.as_ref()
    }

    /// Returns the degree of polarisation of the light from the hit.
    pub fn degree_of_polarisation(&self, plane: &SurfaceElement) -> f32 {
        self.kinds[plane.material_id as usize].degree_of_polarisation
    }

    /// Returns true if there are several materials.
    pub fn are_mixed(&self) -> bool {
        self.kinds.len() > 1
    }

    /// Returns true if any material is not Lambertian.
    pub fn is_glossy(&self) -> bool {
        self.kinds.iter().any(|kind| kind.gloss.is_some())
    }

    /// Returns the maximum difference of unit normals over which all BRDFs count as constant.
    /// `None`: no limit.
    pub fn max_normal_change_rad(&self) -> Option<f32> {
        let glossy = self.kinds.iter().filter_map(|kind| kind.gloss.as_ref());
        glossy
            .map(PupilAveragedBrdf::max_normal_change_rad)
            .reduce(f32::min)
    }

    /// Returns true if surface and laser are constant over a pixel. Across the pixel, the hit moves
    /// by `moves` (laser's frame, mm) and the direction turns by `steps`.
    #[inline(always)]
    pub fn is_constant_over(
        &self,
        plane: &SurfaceElement,
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

    /// Traces the centre rays of the `wanted` pixels (bit mask) of a tile, row by row. `around`:
    /// see [`Self::trace_packet`].
    pub fn centers(
        &self,
        band: usize,
        first: usize,
        wanted: u16,
        around: f64,
        centers: &mut [PixelHit; WIDTH],
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
                let to_sensor = self.pinhole.to_sensor(place);
                rays.push(self.ray(self.pinhole.towards(to_sensor, &mut bend)));
                (pixels[count], places[count]) = (pixel, place);
                rays_wanted |= (wanted >> pixel & 1) << count;
                count += 1;
            }
        }
        self.trace_packet(&places[..count], &rays, rays_wanted, around, centers);
        if count == WIDTH {
            return;
        }
        // Tiles at the sensor border have fewer than sixteen pixels.
        centers[count..].fill(PixelHit::Nothing);
        for (i, &pixel) in pixels[..count].iter().enumerate().rev() {
            centers.swap(i, pixel);
        }
    }

    /// Returns the ray from the eye in this direction; the direction may have any length.
    pub fn ray(&self, towards: DVec3) -> Ray {
        Ray {
            origin: self.pinhole.camera_center,
            direction: towards.normalize(),
            t_max: f64::INFINITY,
        }
    }

    /// Traces up to 16 rays from the eye that belong to these sensor positions. Rays that are not
    /// `wanted` (bit mask) have no hit. `around`: half side of the sensor area around each
    /// position, pixels.
    pub fn trace_packet(
        &self,
        places: &[DVec2],
        rays: &[Ray],
        wanted: u16,
        around: f64,
        centers: &mut [PixelHit],
    ) {
        // Bit masks of rays that hit surface too far from the laser plane, one per side.
        let far = [const { Cell::new(0u16) }; 2];
        let near_sheet = |i: usize, t: f64| {
            let climb = self.sheet_normal.dot(rays[i].direction);
            let height = self.pinhole_in_laser.camera_center.y + t * climb;
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
                    [true, false] => PixelHit::BeyondBeam { above: false },
                    [false, true] => PixelHit::BeyondBeam { above: true },
                    _ => PixelHit::Nothing,
                },
                Some(hit) => {
                    let (center, shadow_ray) =
                        self.classify_hit(hit, ray.direction, places[i], around);
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
            if let (1, PixelHit::Lit(_, plane)) = (blocked >> bit & 1, centers[i]) {
                centers[i] = PixelHit::Shadowed(plane);
            }
        }
    }

    /// Classifies a hit. Returns the shadow ray if the hit may be lit.
    fn classify_hit(
        &self,
        hit: &Hit,
        direction: DVec3,
        place: DVec2,
        around: f64,
    ) -> (PixelHit, Option<Ray>) {
        let laser = self.view.laser;
        let point = self.laser_from_part.point(hit.point);
        let section = laser.section(point);
        let normal = self.laser_from_part.vector(hit.normal);
        let radius = section.map_or(laser.beam.waist_radius, |section| section.radius);
        let plane = SurfaceElement {
            point,
            normal,
            tolerance: (PLANE_TOLERANCE * radius * direction.dot(hit.normal).abs()) as f32,
            material_id: self.view.surface.number(hit.face.triangle) as u32,
        };
        let Some(section) = section else {
            return (PixelHit::Shadowed(plane), None);
        };
        let r2 = laser.off_middle(point).length_squared();
        if r2 > (self.view.beam_cutoff_radii * radius).powi(2) {
            let nearest =
                || r2.sqrt() - hit.t * self.max_beam_offset_gradient(&plane, direction, around);
            let is_near = around > 0.0
                && nearest() < (self.view.beam_cutoff_radii - SUBSAMPLING_MARGIN_RADII) * radius;
            return match is_near {
                true => (PixelHit::NeedsSubsampling(plane), None),
                false => (PixelHit::OutsideBeam(plane), None),
            };
        }
        let received = -section.flux.dot(normal);
        let start = hit.point + hit.normal * self.view.accel.resolution();
        let aperture = self.view.part_from_laser.point(section.aperture_point);
        // At grazing incidence, the local direction of light may come from the front but the chord
        // from behind. The surface is then self-occluding.
        let shadow_ray = Ray::between(start, aperture)
            .filter(|ray| received > 0.0 && ray.direction.dot(hit.normal) > 0.0);
        let Some(shadow_ray) = shadow_ray else {
            return (PixelHit::Shadowed(plane), None);
        };
        let kind = &self.kinds[plane.material_id as usize];
        let bsdf = match &kind.gloss {
            None => kind.matt,
            Some(gloss) => {
                let flux = section.flux.normalize_or_zero();
                let towards_light = -self.view.part_from_laser.vector(flux);
                gloss.bsdf(hit.point, hit.normal, towards_light)
            }
        };
        let radiance = bsdf * received;
        let light = BeamSample {
            irradiance: radiance * self.pinhole.solid_angle(place, direction),
            beam_offset_squared_mm2: r2,
            radius,
        };
        (PixelHit::Lit(light, plane), Some(shadow_ray))
    }

    /// Returns an upper bound of the change of distance from the beam axis on the tangent plane, mm
    /// per mm of ray length. It holds up to `around` pixels away in column and row. For planes that
    /// are nearly edge-on, the bound is much too large.
    pub fn max_beam_offset_gradient(
        &self,
        plane: &SurfaceElement,
        direction: DVec3,
        around: f64,
    ) -> f64 {
        let direction = self.laser_from_part.vector(direction);
        let (moves, ratios) = plane.image_jacobian(direction, self.steps);
        let across = moves.map(|step| self.view.laser.off_middle(step).length());
        let turned: f64 = ratios.iter().map(|ratio| ratio.abs()).sum();
        around * across.iter().sum::<f64>() / (1.0 - around * turned).max(f64::MIN_POSITIVE)
    }
}

//! Gaussian laser beams: a round beam (point laser) or a fan (line laser), as a vector field of
//! radiant flux.
//!
//! The origin of the laser frame is at the aperture. The z axis is along the beam, x along the
//! line, and y perpendicular to the laser plane (mm).

mod beam;
mod beam_ray;
mod line;
mod measured_profile;

pub use beam::Beam;
pub use beam_ray::BeamRay;
pub use line::{Fan, FanProfile};
pub use measured_profile::MeasuredProfile;

use crate::math::{DMat3, DVec2, DVec3};

/// Light of the laser at a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IncidentLight {
    /// Vector irradiance, mW/mm². A surface with unit normal n towards the light receives -flux·n.
    /// This equals E/cosψ·|d·n| in Bergmann et al. (2016), without the division; ψ is the angle
    /// between the axis and the local direction d.
    pub flux: DVec3,
    /// Point of the aperture from which this light originates: equal relative radius and equal
    /// azimuth (Bergmann et al. 2016). Visibility is tested along the chord to this point.
    pub aperture_point: DVec3,
}

/// Laser in the laser frame: a point laser, or a line laser if it has a fan.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Laser {
    /// Beam before the expansion into a fan.
    pub beam: Beam,
    /// `None` for a point laser.
    pub fan: Option<Fan>,
}

/// Local wavefront. It propagates along `direction` (unit vector).
/// `curvature_per_mm` = ∂(direction)/∂x is symmetric, with eigenvalues 1/R along its axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wavefront {
    /// Unit vector.
    pub direction: DVec3,
    /// Curvature, 1/mm, symmetric; zero for a plane wave.
    pub curvature_per_mm: DMat3,
}

/// Beam properties at a point, without the Gaussian profile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BeamCrossSection {
    /// Flux ([`IncidentLight::flux`]) on the beam axis or in the laser plane, with the direction of
    /// the light at the point itself.
    pub flux: DVec3,
    /// 1/e² radius w at this distance, mm.
    pub radius: f64,
    /// See [`IncidentLight`].
    pub aperture_point: DVec3,
}

/// Returns the irradiance relative to its maximum, exp(-2r²/w²). `r2` is the squared distance from
/// the axis or laser plane, mm², and `radius` is the 1/e² radius w, mm.
pub fn gaussian(r2: f64, radius: f64) -> f64 {
    (-2.0 * r2 / (radius * radius)).exp()
}

/// Distance from the axis or laser plane, in beam radii, at which the beam is truncated. There, the
/// irradiance is e⁻³² = 1.3e-14 of its maximum. It is not visible in exposures below 1e9 times
/// saturation.
pub const CUTOFF_RADII: f64 = 4.0;

impl Laser {
    /// Returns the light at `p` (laser frame). Returns `None` behind the aperture, at more than
    /// [`CUTOFF_RADII`] from the axis or laser plane, and outside a bounded fan.
    ///
    /// ```
    /// use lasertrace::Scene;
    /// use lasertrace::math::DVec3;
    ///
    /// let scene = Scene::parse(include_str!("../../scenes/plane/scene.toml"), "".as_ref())?;
    /// // 30 µm from the laser plane, at the waist, the flux is exp(−2) of its maximum.
    /// let flux = |y| scene.laser.at(DVec3::new(0.0, y, 150.0)).map(|light| light.flux);
    /// let [middle, beside] = [0.0, 0.03].map(|y| flux(y).expect("lit").length());
    /// assert!((beside / middle - (-2.0_f64).exp()).abs() < 1e-9);
    /// assert!(flux(1.0).is_none());
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn at(&self, p: DVec3) -> Option<IncidentLight> {
        let section = self.section(p)?;
        let r2 = self.off_middle(p).length_squared();
        let lit = r2 <= (CUTOFF_RADII * section.radius).powi(2);
        lit.then(|| IncidentLight {
            flux: section.flux * gaussian(r2, section.radius),
            aperture_point: section.aperture_point,
        })
    }

    /// Returns the beam properties at `p` (laser frame). Returns `None` behind the aperture and
    /// outside a bounded fan.
    #[inline]
    pub fn section(&self, p: DVec3) -> Option<BeamCrossSection> {
        match &self.fan {
            None => self.beam.round(p),
            Some(fan) => fan.sheet(&self.beam, p),
        }
    }

    /// Returns the 1/e² radius, mm, at the distance of `p` (laser frame) from the aperture, and at its
    /// angle in a fan.
    pub fn radius(&self, p: DVec3) -> f64 {
        self.beam.radius(self.distance(p)) * self.width_ratio(p)
    }

    /// Returns the radius at `p` relative to the radius of the beam at this distance.
    pub(crate) fn width_ratio(&self, p: DVec3) -> f64 {
        self.fan.as_ref().map_or(1.0, |fan| fan.width_ratio(p))
    }

    /// Returns the transverse offset (x, y) of `p` from the beam axis, or from the laser plane of a
    /// line laser, mm, laser frame. The offset is linear in `p`.
    pub fn off_middle(&self, p: DVec3) -> DVec2 {
        match &self.fan {
            None => DVec2::new(p.x, p.y),
            Some(_) => DVec2::new(0.0, p.y),
        }
    }

    /// Returns the largest angle (rad) along the line over which the irradiance is treated as
    /// constant. The mean over the angle agrees with the central value to 1 %.
    ///
    /// The relative curvature of a Gaussian profile is greatest at u = [`CUTOFF_RADII`] from its
    /// centre. The value there is (16u² - 4)/Φ² with Φ the half angle at 1/e². The mean over an
    /// angle a deviates by a²/24 times the curvature. For a uniform profile and a point laser, the
    /// angle is infinite.
    pub fn constant_angle(&self) -> f64 {
        let Some(fan) = &self.fan else {
            return f64::INFINITY;
        };
        match &fan.profile {
            FanProfile::Uniform => f64::INFINITY,
            FanProfile::Gaussian => {
                let bend = 16.0 * CUTOFF_RADII * CUTOFF_RADII - 4.0;
                fan.angle / 2.0 * (0.01 * 24.0 / bend).sqrt()
            }
            FanProfile::Measured(profile) => profile.constant_angle(),
        }
    }

    /// Returns the wavefront at the point of the axis or laser plane that is nearest to `p`. Across
    /// the laser plane, the curvature is 1/R(z) = z/(z² + z_R²) (Siegman 1986, ch. 17), which is
    /// zero at the waist. Along the line of a fan, it is 1/ρ.
    pub fn wavefront(&self, p: DVec3) -> Wavefront {
        let outer = |v: DVec3| DMat3::from_cols(v * v.x, v * v.y, v * v.z);
        if self.fan.is_none() {
            let bend = self.beam.shape(p.z).slope;
            return Wavefront {
                direction: DVec3::Z,
                curvature_per_mm: (outer(DVec3::X) + outer(DVec3::Y)) * bend,
            };
        }
        let rho = p.x.hypot(p.z);
        let direction = DVec3::new(p.x / rho, 0.0, p.z / rho);
        let bend = self.beam.shape(rho).slope;
        Wavefront {
            direction,
            curvature_per_mm: outer(DVec3::Y.cross(direction)) * rho.recip()
                + outer(DVec3::Y) * bend,
        }
    }

    /// Returns the half extents in x and y, mm, of a box around the z axis. The box contains the
    /// light at distances `from` to `to` from the aperture. The beam is truncated at `cutoff` beam
    /// radii.
    pub fn reach(&self, from: f64, to: f64, cutoff: f64) -> DVec2 {
        // w(z) is convex, so the maximum is at an end.
        let radius = self.beam.radius(from).max(self.beam.radius(to));
        let widest = match self.fan.as_ref().map(|fan| &fan.profile) {
            Some(FanProfile::Measured(profile)) => profile.greatest_width_ratio(),
            _ => 1.0,
        };
        let y = cutoff * radius * widest;
        DVec2::new(if self.fan.is_some() { f64::INFINITY } else { y }, y)
    }
}

//! Gaussian laser beams: a round beam (point laser) and a fanned sheet (line
//! laser), as the field of radiant flux they send through space.
//!
//! Laser frame: origin at the aperture, z along the beam, x along the line, y
//! across the sheet (mm).

mod beam;
mod line;
mod stream;

pub use beam::Beam;
pub use line::{Fan, FanProfile};
pub use stream::Stream;

use crate::math::{DMat3, DVec2, DVec3};

/// Light of the laser at a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Illumination {
    /// Vector irradiance (mW/mm²): a surface with unit normal n towards the light
    /// receives -flux·n. This is the seed's E/cosψ·|d·n| with ψ the angle between
    /// axis and local direction d, without the division.
    pub flux: DVec3,
    /// Where on the aperture this light came from: same relative radius, same
    /// azimuth (Bergmann et al. 2016). The chord to it is what visibility uses.
    pub aperture_point: DVec3,
}

/// A laser in its own frame: a spot, or a line if it has a fan.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Laser {
    /// Its section across the axis, before any fan.
    pub beam: Beam,
    /// `None` for a point laser.
    pub fan: Option<Fan>,
}

/// The wave at a point: it travels along `direction` (unit), and
/// `curvature_per_mm` = ∂(direction)/∂x (symmetric) is 1/R along its axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wavefront {
    /// Unit vector.
    pub direction: DVec3,
    /// 1/mm, symmetric; zero for a plane wave.
    pub curvature_per_mm: DMat3,
}

/// The beam around a point, but for its Gaussian profile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Section {
    /// As [`Illumination::flux`] were the point in the middle of the beam, in the
    /// direction that light has at the point itself.
    pub flux: DVec3,
    /// 1/e² radius w at this distance, mm.
    pub radius: f64,
    /// As in [`Illumination`].
    pub aperture_point: DVec3,
}

/// Irradiance at the square `r2` (mm²) of a distance from the axis or sheet of a beam
/// of 1/e² `radius` w, as a share of that in the middle: exp(-2r²/w²).
pub fn gaussian(r2: f64, radius: f64) -> f64 {
    (-2.0 * r2 / (radius * radius)).exp()
}

/// Where light is taken to end, in beam radii from the axis or sheet: there the
/// irradiance is e⁻³² = 1.3e-14 of its maximum, which no exposure short of 1e9
/// times saturation can show.
pub const CUTOFF_RADII: f64 = 4.0;

impl Laser {
    /// Light at `p` (laser frame). `None` behind the aperture, further than
    /// [`CUTOFF_RADII`] from the axis or sheet, or outside a uniform fan.
    ///
    /// ```
    /// use lasertrace::Scene;
    /// use lasertrace::math::DVec3;
    ///
    /// let scene = Scene::parse(include_str!("../../scenes/plane/scene.toml"), "".as_ref())?;
    /// // Across the sheet at its waist, 30 µm from the middle: exp(−2) of the flux there.
    /// let flux = |y| scene.laser.at(DVec3::new(0.0, y, 150.0)).map(|light| light.flux);
    /// let [middle, beside] = [0.0, 0.03].map(|y| flux(y).expect("lit").length());
    /// assert!((beside / middle - (-2.0_f64).exp()).abs() < 1e-9);
    /// assert!(flux(1.0).is_none());
    /// # Ok::<(), lasertrace::Error>(())
    /// ```
    pub fn at(&self, p: DVec3) -> Option<Illumination> {
        let section = self.section(p)?;
        let r2 = self.off_middle(p).length_squared();
        let lit = r2 <= (CUTOFF_RADII * section.radius).powi(2);
        lit.then(|| Illumination {
            flux: section.flux * gaussian(r2, section.radius),
            aperture_point: section.aperture_point,
        })
    }

    /// The beam around `p` (laser frame). `None` behind the aperture and outside a
    /// uniform fan.
    #[inline]
    pub fn section(&self, p: DVec3) -> Option<Section> {
        match &self.fan {
            None => self.beam.round(p),
            Some(fan) => fan.sheet(&self.beam, p),
        }
    }

    /// From the axis, or from the sheet of a fan, to `p` (laser frame), (x, y) in mm;
    /// linear in `p`.
    pub fn off_middle(&self, p: DVec3) -> DVec2 {
        match &self.fan {
            None => DVec2::new(p.x, p.y),
            Some(_) => DVec2::new(0.0, p.y),
        }
    }

    /// Greatest angle (rad) along the line over which the irradiance may be taken as constant:
    /// its mean over the angle is that of the middle to 1 %. A Gaussian profile bends most at
    /// [`CUTOFF_RADII`] u from its middle, by (16u² - 4)/Φ² of itself with Φ its 1/e² angle;
    /// the mean over an angle a differs by a²/24 times as much. Elsewhere there is no such angle.
    pub fn constant_angle(&self) -> f64 {
        match self.fan {
            Some(fan) if fan.profile == FanProfile::Gaussian => {
                let bend = 16.0 * CUTOFF_RADII * CUTOFF_RADII - 4.0;
                fan.angle / 2.0 * (0.01 * 24.0 / bend).sqrt()
            }
            _ => f64::INFINITY,
        }
    }

    /// Wavefront on the axis or the sheet at the point of it nearest to `p`: 1/R(z)
    /// = z/(z² + z_R²) across (Siegman 1986, ch. 17; zero at the waist), and 1/ρ
    /// along the line of a fan.
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

    /// Half extents in x and y of a box around the z axis outside which there is
    /// no light at distances `from` to `to` from the aperture, mm, if it ends at
    /// `cutoff` beam radii.
    pub fn reach(&self, from: f64, to: f64, cutoff: f64) -> DVec2 {
        // w(z) is convex: it is greatest at an end.
        let radius = self.beam.radius(from).max(self.beam.radius(to));
        let y = cutoff * radius;
        DVec2::new(if self.fan.is_some() { f64::INFINITY } else { y }, y)
    }
}

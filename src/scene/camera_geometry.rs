//! Geometry of the camera that sees the fields of view of a data sheet.
//!
//! The optics are in the plane perpendicular to the line. Heights are relative to the centre of the
//! measuring range.

/// Requirements on the camera: fields of view at heights of the measuring range.
#[derive(Debug, Clone)]
pub(super) struct CameraGeometry {
    /// Height of the laser's exit, mm.
    pub exit: f64,
    /// Half the measuring range, mm.
    pub half_range: f64,
    /// Number of sensor columns.
    pub columns: u32,
    /// Heights (mm) and the widths (mm) that the camera sees there at least.
    pub fields: Vec<[f64; 2]>,
    /// Widths at the near and the far end from which the lens's distance follows, mm.
    pub ends: Option<[f64; 2]>,
    /// Given distance of the lens from the centre of the range, mm.
    pub distance: Option<f64>,
    /// Given focal length, mm.
    pub focal_length: Option<f64>,
}

/// Optics in the plane perpendicular to the line.
#[derive(Debug, Clone)]
pub(super) struct CameraOptics {
    pub focal_length: f64,
    /// Position of the pupil, mm: distance from the laser axis, and height.
    pub pupil: [f64; 2],
    /// Height at which the optical axis intersects the laser axis, mm.
    pub aim: f64,
    /// Length between the images of the range's ends on the sensor, along the columns, mm.
    pub extent: f64,
    /// Distance of the lens from the centre of the range, mm.
    distance: f64,
    /// Angle between the optical axis and the laser axis, rad.
    axis: f64,
    /// Width of the sensor, mm.
    width: f64,
}

/// Largest triangulation angle, degrees.
pub(super) const STEEPEST: f64 = 75.0;

impl CameraOptics {
    /// Returns the width of the field of view at a height, mm.
    pub fn width_at(&self, angle: f64, z: f64) -> f64 {
        let depth = self.distance * (angle - self.axis).cos() - z * self.axis.cos();
        self.width * (depth / self.focal_length - 1.0)
    }
}

impl CameraGeometry {
    /// Computes the optics at a triangulation angle (rad), for square pixels of `pitch` mm. Returns
    /// `None` if no solution exists.
    ///
    /// With the laser plane in focus, a point at distance Z along the optical axis has the
    /// magnification f/(Z − f). For a sensor of width w, the field of view thus has the width
    /// w·(Z − f)/f. Over the range R, Z changes by R·cos α, where α is the angle between the
    /// optical axis and the laser axis. The fields of view at both ends determine f and Z. The
    /// angle α is chosen to image both ends at equal distances from the sensor centre.
    ///
    /// A printed field may be smaller than the camera's. If a lens with exactly these fields would
    /// be in front of the laser's exit, or if one of them is unknown, the lens is at the height of
    /// the exit. The focal length is then the largest at which the camera sees all fields.
    pub fn optics(&self, angle: f64, pitch: f64) -> Option<CameraOptics> {
        let width = f64::from(self.columns) * pitch;
        let given = self.distance;
        let fitted = self
            .ends
            .filter(|[near, far]| given.is_none() && *near < far * 0.999);
        let fitted = fitted.and_then(|[near, far]| {
            self.aimed(angle, width, |axis| {
                let depth = 2.0 * self.half_range * axis.cos();
                let focal = width * depth / (far - near);
                let to_near = focal * (1.0 + near / width);
                (to_near + depth / 2.0) / (angle - axis).cos()
            })
        });
        fitted
            .filter(|optics| optics.pupil[1] >= self.exit)
            .or_else(|| {
                let distance = given.unwrap_or(self.exit / angle.cos());
                self.aimed(angle, width, |_| distance)
            })
    }

    /// Returns the optics for a sensor of `width` mm. `distance` is the distance of the lens from
    /// the centre of the range for an angle of the optical axis.
    fn aimed(&self, angle: f64, width: f64, distance: impl Fn(f64) -> f64) -> Option<CameraOptics> {
        let half = self.half_range;
        let lens = |axis: f64| {
            let distance = distance(axis);
            let depth = |z: f64| distance * (angle - axis).cos() - z * axis.cos();
            let fields = self.fields.iter();
            let focal = fields
                .map(|[z, field]| width * depth(*z) / (field + width))
                .chain(self.focal_length)
                .fold(f64::INFINITY, f64::min);
            // Coordinates of the range's ends perpendicular to the optical axis, and their
            // magnifications.
            let image = |z: f64| {
                let across = distance * (angle - axis).sin() + z * axis.sin();
                across * focal / (depth(z) - focal)
            };
            (focal, distance, [image(half), image(-half)])
        };
        let uneven = |axis: f64| {
            let (_, _, [near, far]) = lens(axis);
            near + far
        };
        // The near end has the larger magnification, so the axis passes between it and the centre.
        let axis = root([angle, (angle + 0.5).min(1.55)], uneven)
            .or_else(|| root([angle, 1.55], uneven))?;
        let (focal, distance, [near, far]) = lens(axis);
        let aim = -distance * (angle - axis).sin() / axis.sin();
        let to_aim = distance * (angle - axis).cos() - aim * axis.cos();
        // Scheimpflug: tangent of the sensor tilt.
        let tilt = focal / (to_aim - focal) / axis.tan();
        let found = CameraOptics {
            focal_length: focal,
            pupil: [distance * angle.sin(), distance * angle.cos()],
            aim,
            extent: (near - far) * tilt.hypot(1.0),
            distance,
            axis,
            width,
        };
        let valid = focal > 0.0 && found.extent.is_finite() && found.extent > 0.0;
        (valid && found.width_at(angle, half) > 0.0).then_some(found)
    }

    /// Returns the smallest angle (rad) at which `of` equals `wanted`. The error contains the
    /// smallest and the largest value of `of`.
    pub fn angle_where(
        &self,
        pitch: f64,
        wanted: f64,
        of: impl Fn(&CameraOptics) -> f64,
    ) -> Result<f64, [f64; 2]> {
        let at = |angle: f64| {
            self.optics(angle, pitch)
                .map_or(f64::NAN, |optics| of(&optics))
        };
        // Steps of half a degree locate the first rise to the wanted value.
        let angles = (0..=2 * STEEPEST as u32).map(|i| (0.01 + f64::from(i) / 2.0).to_radians());
        let samples: Vec<[f64; 2]> = angles.map(|angle| [angle, at(angle)]).collect();
        let rise = samples
            .windows(2)
            .find(|two| two[0][1] <= wanted && wanted <= two[1][1]);
        match rise.and_then(|two| root([two[0][0], two[1][0]], |angle| at(angle) - wanted)) {
            Some(angle) => Ok(angle),
            None => {
                let values = samples.iter().map(|sample| sample[1]);
                Err([
                    values.clone().fold(f64::INFINITY, f64::min),
                    values.fold(0.0, f64::max),
                ])
            }
        }
    }
}

/// Returns a sign change of `f` between two arguments, by bisection to machine precision.
pub(super) fn root([mut low, mut high]: [f64; 2], f: impl Fn(f64) -> f64) -> Option<f64> {
    let rising = f(low) <= 0.0;
    if rising == (f(high) <= 0.0) {
        return None;
    }
    for _ in 0..100 {
        let middle = (low + high) / 2.0;
        match (f(middle) <= 0.0) == rising {
            true => low = middle,
            false => high = middle,
        }
    }
    Some((low + high) / 2.0)
}

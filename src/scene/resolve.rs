//! From the scene file to validated values in internal units (mm, rad).

use super::file::{
    ApertureShape, CameraTable, LaserTable, PartTable, ProfileName, SceneFile, SpeckleMethod, Unit,
};
use super::locate::Source;
use crate::camera::{Aperture, Camera, Lens, Noise, Sensor};
use crate::error::Result;
use crate::laser::{Beam, Fan, FanProfile, Laser};
use crate::math::{DVec2, DVec3, Rigid};
use crate::mesh::{self, Mesh, shapes};
use crate::speckle::lookup::{Coherence, Method};
use crate::speckle::pattern;
use crate::surface::Lambert;
use glam::UVec2;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// Positions of the scan head along a straight line, turned nowhere.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct LinearScan {
    pub start: DVec3,
    /// From one frame to the next.
    pub step: DVec3,
    pub frames: u32,
}

/// How speckle is modelled.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpeckleModel {
    pub method: Method,
    pub coherence: Coherence,
    pub aperture: pattern::Aperture,
}

/// A validated scene: the world at rest and the head's way through it.
#[derive(serde::Serialize)]
pub struct Scene {
    pub path: PathBuf,
    /// SHA-256 of the scene file and of the mesh file it names, hexadecimal.
    pub hash: String,
    pub seed: u64,
    /// `None`: laser light is taken as incoherent.
    pub speckle: Option<SpeckleModel>,
    pub write_frames: bool,
    #[serde(skip)]
    pub mesh: Mesh,
    pub surface: Lambert,
    pub world_from_part: Rigid,
    pub laser: Laser,
    pub head_from_laser: Rigid,
    pub camera: Camera,
    pub head_from_camera: Rigid,
    pub scan: LinearScan,
}

impl Scene {
    /// Reads and validates a scene file and the mesh it names.
    pub fn load(path: &Path) -> Result<Scene> {
        let source = Source::read(path)?;
        let file: SceneFile =
            toml::from_str(source.text()).map_err(|error| source.explain(&error))?;
        Resolver { source, path }.scene(file)
    }

    pub fn world_from_head(&self, frame: u32) -> Rigid {
        Rigid::translation(self.scan.start + self.scan.step * frame as f64)
    }

    pub fn part_from_head(&self, frame: u32) -> Rigid {
        self.world_from_part.inverse() * self.world_from_head(frame)
    }
}

struct Resolver<'a> {
    source: Source,
    path: &'a Path,
}

impl Resolver<'_> {
    fn check(&self, holds: bool, key: &str, expected: &str) -> Result<()> {
        if holds {
            Ok(())
        } else {
            Err(self.source.wrong(key, expected))
        }
    }

    fn positive(&self, value: f64, key: &str) -> Result<f64> {
        let holds = value.is_finite() && value > 0.0;
        self.check(holds, key, "a finite number > 0")
            .map(|()| value)
    }

    /// Lengths (mm) of either sign. The bound keeps their products finite.
    fn lengths<const N: usize>(&self, value: [f64; N], key: &str) -> Result<[f64; N]> {
        // Written so that NaN fails.
        let holds = value.iter().all(|v| v.abs() <= mesh::LARGEST_MM);
        self.check(holds, key, "finite numbers within 1e12 mm")
            .map(|()| value)
    }

    fn direction(&self, value: [f64; 3], key: &str) -> Result<DVec3> {
        DVec3::from(value)
            .try_normalize()
            .ok_or_else(|| self.source.wrong(key, "a vector of finite length > 0"))
    }

    fn scene(self, file: SceneFile) -> Result<Scene> {
        let (mesh, mesh_hash) = self.mesh(&file.part)?;
        let reflectance = file.part.reflectance;
        self.check(
            (0.0..=1.0).contains(&reflectance),
            "part.reflectance",
            "a number from 0 to 1",
        )?;
        let rotation = file.part.rotation_deg;
        self.check(
            rotation.iter().all(|r| r.abs() <= 360.0),
            "part.rotation_deg",
            "angles from -360 to 360",
        )?;
        let rotation = DVec3::from(rotation).map(f64::to_radians);
        let position = self.lengths(file.part.position_mm, "part.position_mm")?;
        let camera = self.camera(&file.camera)?;
        let head_from_camera = self.camera_pose(&file.camera)?;
        let laser = self.laser(&file.laser)?;
        let head_from_laser = self.laser_pose(&file.laser, &head_from_camera)?;
        self.triangulation(&head_from_laser, &head_from_camera)?;
        let direction = self.direction(file.scan.direction, "scan.direction")?;
        let [step] = self.lengths([file.scan.step_mm], "scan.step_mm")?;
        self.check(file.scan.frames > 0, "scan.frames", "at least 1")?;
        let speckle = self.speckle(&file, &laser, &camera)?;
        let mut hash = Sha256::new();
        hash.update(self.source.text());
        hash.update(mesh_hash);
        Ok(Scene {
            path: self.path.to_owned(),
            hash: hash.finalize().iter().map(|b| format!("{b:02x}")).collect(),
            seed: file.seed,
            speckle,
            write_frames: file.write_frames,
            mesh,
            surface: Lambert { reflectance },
            world_from_part: Rigid::from_euler_xyz(rotation, position.into()),
            laser,
            head_from_laser,
            camera,
            head_from_camera,
            scan: LinearScan {
                start: self.lengths(file.scan.start_mm, "scan.start_mm")?.into(),
                step: direction * step,
                frames: file.scan.frames,
            },
        })
    }

    /// The part's mesh, and the bytes that stand for a mesh file in the hash.
    fn mesh(&self, part: &PartTable) -> Result<(Mesh, Vec<u8>)> {
        let kinds = [
            part.mesh.is_some(),
            part.plane.is_some(),
            part.sphere.is_some(),
            part.cylinder.is_some(),
            part.step_block.is_some(),
        ];
        self.check(
            kinds.iter().filter(|&&given| given).count() == 1,
            "part",
            "exactly one of mesh, plane, sphere, cylinder and step_block",
        )?;
        let shape = |key: &str, shape: std::result::Result<Mesh, String>| match shape {
            Ok(mesh) => Ok((mesh, Vec::new())),
            Err(expected) => Err(self.source.wrong(key, &expected)),
        };
        if let Some(table) = &part.mesh {
            let folder = self.path.parent().unwrap_or(Path::new(""));
            let file = folder.join(&table.file);
            if !file.exists() {
                let expected = format!("a mesh file; there is none at {}", file.display());
                return Err(self.source.wrong("part.mesh.file", &expected));
            }
            let bytes = mesh::read(&file)?;
            let mesh = mesh::parse(&file, &bytes, unit_mm(table.unit))?;
            return Ok((mesh, Sha256::digest(&bytes).to_vec()));
        }
        if let Some(table) = &part.plane {
            return shape("part.plane.size_mm", shapes::plane(table.size_mm.into()));
        }
        if let Some(table) = &part.sphere {
            let chord = table.chord_um * 1e-3;
            return shape("part.sphere", shapes::sphere(table.radius_mm, chord));
        }
        if let Some(table) = &part.cylinder {
            let chord = table.chord_um * 1e-3;
            return shape(
                "part.cylinder",
                shapes::cylinder(table.radius_mm, table.length_mm, chord),
            );
        }
        let table = part.step_block.as_ref().expect("one of them is given");
        shape(
            "part.step_block",
            shapes::step_block(table.size_mm.into(), table.step_mm),
        )
    }

    fn laser(&self, table: &LaserTable) -> Result<Laser> {
        let beam = Beam {
            wavelength: self.positive(table.wavelength_nm, "laser.wavelength_nm")? * 1e-6,
            power_mw: table.power_mw,
            waist_radius: self.positive(table.waist_radius_um, "laser.waist_radius_um")? * 1e-3,
            waist_distance: table.waist_distance_mm,
            m_squared: table.m_squared,
        };
        self.lengths([table.waist_distance_mm], "laser.waist_distance_mm")?;
        self.check(
            table.power_mw.is_finite() && table.power_mw >= 0.0,
            "laser.power_mw",
            "a finite number >= 0",
        )?;
        self.check(
            table.m_squared.is_finite() && table.m_squared >= 1.0,
            "laser.m_squared",
            "a finite number >= 1",
        )?;
        let smallest = 2.0 * beam.m_squared * beam.wavelength / std::f64::consts::PI * 1e3;
        self.check(
            beam.divergence() <= 0.5,
            "laser.waist_radius_um",
            &format!(
                "at least {smallest:.4}: below, the beam spreads by more than 0.5 rad and \
                 is not paraxial"
            ),
        )?;
        let Some(line) = &table.line else {
            return Ok(Laser { beam, fan: None });
        };
        self.check(
            line.fan_deg > 0.0 && line.fan_deg < 180.0,
            "laser.line.fan_deg",
            "an angle above 0 and below 180",
        )?;
        let fan = Fan {
            angle: line.fan_deg.to_radians(),
            profile: match line.profile {
                ProfileName::Uniform => FanProfile::Uniform,
                ProfileName::Gaussian => FanProfile::Gaussian,
            },
        };
        Ok(Laser {
            beam,
            fan: Some(fan),
        })
    }

    /// A point laser has no line direction of its own: its measuring plane is the
    /// one through the beam along the camera's columns.
    fn laser_pose(&self, table: &LaserTable, head_from_camera: &Rigid) -> Result<Rigid> {
        let origin = self.lengths(table.position_mm, "laser.position_mm")?;
        let z = self.direction(table.direction, "laser.direction")?;
        let (line, key) = match &table.line {
            Some(line) => (
                self.direction(line.direction, "laser.line.direction")?,
                "laser.line.direction",
            ),
            None => (head_from_camera.rotation.x_axis, "laser.direction"),
        };
        Rigid::from_z_and_x(origin.into(), z, line).ok_or_else(|| {
            self.source.wrong(
                key,
                "the line (a point laser: the camera's columns) not to be along the beam",
            )
        })
    }

    /// Checked whether speckle is on or off: a mistake is one either way.
    fn speckle(
        &self,
        file: &SceneFile,
        laser: &Laser,
        camera: &Camera,
    ) -> Result<Option<SpeckleModel>> {
        let polarisation_degree = file.part.polarisation_degree;
        self.check(
            (0.0..=1.0).contains(&polarisation_degree),
            "part.polarisation_degree",
            "a number from 0 to 1",
        )?;
        let patterns = file.laser.independent_patterns;
        self.check(
            (1..=64).contains(&patterns),
            "laser.independent_patterns",
            "from 1 to 64",
        )?;
        let q = camera.sensor.pixel_pitch / camera.speckle_size(laser.beam.wavelength);
        let method = match file.speckle_method {
            SpeckleMethod::Field => Method::Field,
            SpeckleMethod::Trilinear => Method::Trilinear,
            SpeckleMethod::Prefiltered => {
                self.check(
                    (0.5..=32.0).contains(&q),
                    "speckle_method",
                    &format!("field: a pixel is {q:.2} grains wide, prefiltered takes 0.5 to 32"),
                )?;
                Method::Prefiltered { q }
            }
        };
        Ok(file.speckle.then_some(SpeckleModel {
            method,
            coherence: Coherence {
                polarisation_degree,
                independent_patterns: patterns as usize,
            },
            aperture: match camera.lens.aperture {
                Aperture::Circle => pattern::Aperture::Circle,
                Aperture::Ellipse(ratio) => pattern::Aperture::Ellipse { ratio },
                Aperture::Square => pattern::Aperture::Square,
            },
        }))
    }

    fn camera(&self, table: &CameraTable) -> Result<Camera> {
        let positive = |value, key: &str| self.positive(value, &format!("camera.{key}"));
        let lens = Lens {
            focal_length: positive(table.focal_length_mm, "focal_length_mm")?,
            f_number: positive(table.f_number, "f_number")?,
            focus_distance: positive(table.focus_distance_mm, "focus_distance_mm")?,
            aperture: match table.aperture {
                ApertureShape::Circle => Aperture::Circle,
                ApertureShape::Ellipse(ratio) => Aperture::Ellipse(ratio),
                ApertureShape::Square => Aperture::Square,
            },
        };
        if let Aperture::Ellipse(ratio) = lens.aperture {
            // Narrower, a pattern holds too few phasors to be fully developed.
            self.check(
                (0.1..=1.0).contains(&ratio),
                "camera.aperture",
                "an ellipse with height / width from 0.1 to 1",
            )?;
        }
        self.check(
            lens.focus_distance > lens.focal_length,
            "camera.focus_distance_mm",
            "a distance beyond the focal length",
        )?;
        let sensor = self.sensor(table)?;
        let tilt = table.tilt_deg;
        self.check(
            tilt.iter().all(|t| t.abs() <= 80.0),
            "camera.tilt_deg",
            "angles from -80 to 80",
        )?;
        let camera = Camera {
            lens,
            sensor,
            tilt: DVec2::from(tilt).map(f64::to_radians),
        };
        // A tilted sensor must stay in front of the lens it is drawn before.
        let [columns, rows] = table.resolution_px;
        let corners = [[0, 0], [columns, 0], [0, rows], [columns, rows]];
        self.check(
            corners
                .iter()
                .all(|&c| camera.sensor_point(UVec2::from(c).as_dvec2()).z > 0.0),
            "camera.tilt_deg",
            "a tilt at which the sensor's corners stay behind the lens",
        )?;
        Ok(camera)
    }

    fn sensor(&self, table: &CameraTable) -> Result<Sensor> {
        let positive = |value, key: &str| self.positive(value, &format!("camera.{key}"));
        let [columns, rows] = table.resolution_px;
        self.check(
            (1..=65_536).contains(&columns) && (1..=65_536).contains(&rows),
            "camera.resolution_px",
            "from 1 to 65536 columns and rows",
        )?;
        let efficiency = positive(table.quantum_efficiency, "quantum_efficiency")?;
        self.check(
            efficiency <= 1.0,
            "camera.quantum_efficiency",
            "a number above 0 and at most 1",
        )?;
        self.check(
            (8..=16).contains(&table.bit_depth),
            "camera.bit_depth",
            "from 8 to 16",
        )?;
        let not_negative = |value: f64, key: &str| {
            let holds = value.is_finite() && value >= 0.0;
            self.check(holds, &format!("camera.{key}"), "a finite number >= 0")
                .map(|()| value)
        };
        let noise = match table.read_noise_e {
            Some(e) => Some(Noise {
                read_noise_e: not_negative(e, "read_noise_e")?,
            }),
            None => None,
        };
        Ok(Sensor {
            resolution: UVec2::new(columns, rows),
            pixel_pitch: positive(table.pixel_pitch_um, "pixel_pitch_um")? * 1e-3,
            exposure_ms: positive(table.exposure_ms, "exposure_ms")?,
            quantum_efficiency: efficiency,
            gain_dn_per_e: positive(table.gain_dn_per_e, "gain_dn_per_e")?,
            bit_depth: table.bit_depth,
            full_well_e: positive(table.full_well_e, "full_well_e")?,
            black_level_dn: not_negative(table.black_level_dn, "black_level_dn")?,
            noise,
        })
    }

    fn camera_pose(&self, table: &CameraTable) -> Result<Rigid> {
        let origin: DVec3 = self
            .lengths(table.position_mm, "camera.position_mm")?
            .into();
        let target: DVec3 = self.lengths(table.look_at_mm, "camera.look_at_mm")?.into();
        let columns = self.direction(table.columns, "camera.columns")?;
        let z = (target - origin).try_normalize().ok_or_else(|| {
            self.source
                .wrong("camera.look_at_mm", "another point than camera.position_mm")
        })?;
        Rigid::from_z_and_x(origin, z, columns).ok_or_else(|| {
            self.source
                .wrong("camera.columns", "a direction that is not the optical axis")
        })
    }

    /// Height shows in a column as far as the camera stands off the laser plane,
    /// and a column holds one point of a line only if the line crosses it.
    fn triangulation(&self, head_from_laser: &Rigid, head_from_camera: &Rigid) -> Result<()> {
        let normal = head_from_laser.rotation.y_axis;
        let offset = normal.dot(head_from_camera.translation - head_from_laser.translation);
        self.check(
            offset.abs() > 1e-3,
            "camera.position_mm",
            "a point off the laser plane (by more than 1 µm): in it, height does not show",
        )?;
        let columns = head_from_camera.rotation.x_axis;
        let line = head_from_laser.rotation.x_axis;
        self.check(
            columns.dot(line).abs() > 0.5f64.sqrt(),
            "camera.columns",
            "a direction within 45° of the laser line, so that each column sees one point of it",
        )
    }
}

fn unit_mm(unit: Unit) -> f64 {
    match unit {
        Unit::Micrometre => 1e-3,
        Unit::Millimetre => 1.0,
        Unit::Centimetre => 10.0,
        Unit::Metre => 1000.0,
        Unit::Inch => 25.4,
    }
}

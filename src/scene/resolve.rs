//! Conversion of the scene file to validated values in internal units (mm, rad).

use super::accept_table::AcceptTable;
use super::ambient::Ambient;
use super::data_sheet::SolvedSensor;
use super::field_of_view::FieldOfView;
use super::file::{ModelTable, NominalTable, PartTable, SceneFile};
use super::path::ScanPath;
use super::resolver::Resolver;
use super::surface::degree_of_polarisation;
use super::systematic::Systematic;
use super::toml_source::TomlSource;
use super::unit::Unit;
use super::values::{LINE_PROFILE, at as value_at};
use super::warnings_table::WarningsTable;
use crate::accel::Backend;
use crate::camera::Camera;
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, InputError, Place, Result, printable};
use crate::frame::{self, Sampling};
use crate::inspect::features::FeatureSpec;
use crate::inspect::tolerance::ToleranceBand;
use crate::laser::{FanProfile, Laser};
use crate::math::{Aabb, Aperture, DVec3, Rigid};
use crate::mesh::shapes::{self, InvalidDimension};
use crate::mesh::{self, Contents, Groups, Ignored, Mesh, ProgressFn};
use crate::profile::{Calibration, Filters, PeakFinder, PeakSelection};
use crate::speckle::lookup::{Coherence, Method};
use crate::surface::{LayeredBrdf, Materials};
use sha2::{Digest, Sha256};
use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Speckle model.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpeckleModel {
    /// Method by which patterns are generated and interpolated.
    pub method: Method,
    /// Contrast reduction by the wavelengths and polarisation of the light.
    pub coherence: Coherence,
    /// Shape of the lens pupil.
    pub aperture: Aperture,
}

/// Detection of the laser line in the image, and profile filters.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Measure {
    /// Estimator of the line's row.
    pub finder: PeakFinder,
    /// Selection rule for columns with several lines.
    pub choice: PeakSelection,
    /// Minimum height of a line's brightest pixel above the background, counts; `None`: computed
    /// from the noise.
    pub threshold_dn: Option<f64>,
    /// Whether the cloud is aligned to the CAD by a best fit before deviations are computed.
    pub align: bool,
    /// Fraction of a pixel to which rows are rounded, as its inverse; `None`: not rounded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub row_steps_per_px: Option<u32>,
    /// Steps of x and z of the laser frame to which points are rounded, mm; `None`: not rounded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub point_steps: Option<[f64; 2]>,
    /// Filters that are applied to profiles before output.
    pub filters: Filters,
}

/// A validated scene: the objects at rest and the path of the scan. It is cheap to clone because
/// mesh, instances and poses are shared.
#[derive(Clone, serde::Serialize)]
pub struct Scene {
    /// Path of the scene file, used in errors and summaries.
    #[serde(serialize_with = "printable::in_json")]
    pub path: PathBuf,
    /// Paths of the scene file and the files it names; outputs must not overwrite them.
    #[doc(hidden)]
    #[serde(skip)]
    pub inputs: Arc<[PathBuf]>,
    /// All values by key, from the scene file, the sensor file and the data sheet.
    #[doc(hidden)]
    #[serde(skip)]
    pub values: Arc<toml::Table>,
    /// SHA-256 of the scene file and the files it names, hexadecimal.
    #[doc(hidden)]
    pub hash: String,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Speckle model; `None`: laser light is treated as incoherent.
    #[doc(hidden)]
    pub speckle: Option<SpeckleModel>,
    /// Whether a scan writes its images.
    #[doc(hidden)]
    pub save_images: bool,
    /// Implementation of ray–mesh intersection.
    pub accel: Backend,
    /// Height error that the simulation may add, µm; `None`: every effect is simulated.
    pub tolerance_um: Option<f64>,
    /// Methods that the scene sets explicitly.
    #[doc(hidden)]
    pub methods: ModelTable,
    /// Description of the part: the mesh file and its unit, or the shape and its size.
    #[doc(hidden)]
    pub part: String,
    /// Mesh of the part in its own frame, mm. For an assembly, the mesh that the instances repeat.
    #[serde(skip)]
    pub mesh: Arc<Mesh>,
    /// Group names of the triangles in the mesh file.
    #[serde(skip)]
    #[doc(hidden)]
    pub groups: Arc<Groups>,
    /// Content of the mesh file that was ignored.
    #[serde(serialize_with = "each")]
    pub mesh_ignored: Arc<[Ignored]>,
    /// Unit of the mesh file; `None`: the file states its unit, or the mesh is a shape that the
    /// scene defines.
    #[doc(hidden)]
    pub mesh_unit: Option<Unit>,
    /// Largest distance between the true surface and the triangles of the mesh file, mm; 0: not
    /// given.
    #[doc(hidden)]
    pub chord: f64,
    /// Nominal geometry; `None`: the part is its own reference.
    #[doc(hidden)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nominal: Option<Nominal>,
    /// Number of triangles of the part, before the triangles of objects that are not inspected;
    /// `None` without objects.
    #[doc(hidden)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub part_triangles: Option<u32>,
    /// Poses of the instances of the mesh in the part (part_from_copy); at least one. Serialized as
    /// their number.
    #[serde(serialize_with = "number")]
    pub copies: Arc<[Rigid]>,
    /// Light scattering of the part's surfaces.
    #[doc(hidden)]
    pub surface: Materials,
    /// Pose of the part at rest.
    pub part_at_rest: Rigid,
    /// Laser in its own frame.
    pub laser: Laser,
    /// Coherence length λ²/Δλ of the laser, mm; `None`: longer than all light paths.
    #[doc(hidden)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coherence_length_mm: Option<f64>,
    /// Pose of the laser in the head frame.
    pub head_from_laser: Rigid,
    /// Camera in its own frame.
    pub camera: Camera,
    /// Pose of the camera in the head frame.
    pub head_from_camera: Rigid,
    /// Number of the camera, from 1.
    #[doc(hidden)]
    #[serde(skip)]
    pub camera_number: u32,
    /// Scenes of the cameras, if there are several; this scene then has the first camera. Scenes of
    /// one camera have an empty list.
    #[serde(skip)]
    pub cameras: Arc<[Scene]>,
    /// Bounding box of the sensor's housing in the head frame, mm; `None`: not given.
    #[doc(hidden)]
    pub housing: Option<Aabb>,
    /// Target of the automatic exposure as a fraction of full scale; `None`: the exposure time is
    /// given.
    #[doc(hidden)]
    pub auto_exposure: Option<f64>,
    /// Measuring field in the laser's frame; `None`: the field that the camera sees.
    #[doc(hidden)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field_of_view: Option<FieldOfView>,
    /// Values derived from a data sheet, with their origin; empty without a data sheet.
    #[doc(hidden)]
    pub sensor: SolvedSensor,
    /// Detection of lines and processing of profiles.
    #[doc(hidden)]
    pub measure: Measure,
    /// Tolerances of the regions of the part; empty if none are given.
    #[doc(hidden)]
    pub bands: Vec<ToleranceBand>,
    /// Features of the part; empty if none are given.
    #[doc(hidden)]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub features: Vec<FeatureSpec>,
    /// Motion of the moving body and timing of the frames.
    pub scan: ScanPath,
    /// Calibration that the measurement uses; `None`: the true parameters of the sensor.
    #[doc(hidden)]
    pub calibration: Option<Calibration>,
    /// Ambient light.
    #[doc(hidden)]
    #[serde(skip_serializing_if = "Ambient::is_unknown")]
    pub ambient: Ambient,
    /// Systematic errors of sensor and stage; empty if none are given.
    #[doc(hidden)]
    #[serde(skip_serializing_if = "Systematic::is_none")]
    pub systematic: Systematic,
    /// Acceptance test of the sensor, as given in the file.
    #[doc(hidden)]
    pub accept: AcceptTable,
    /// Thresholds of the warnings.
    #[doc(hidden)]
    pub warnings: WarningsTable,
}

impl Scene {
    /// Reads and validates a scene file and the files it names. Returns an error if a file cannot
    /// be read or contains a mistake; the error names the source location.
    pub fn load(path: &Path) -> Result<Scene> {
        Scene::load_watched(path, &|_| Ok(()))
    }

    /// Loads a scene as [`Self::load`] does, and reports the progress of the mesh reader to
    /// `watch`.
    #[doc(hidden)]
    pub fn load_watched(path: &Path, watch: &ProgressFn) -> Result<Scene> {
        let source = TomlSource::read(path)?;
        source.require_scene()?;
        Scene::resolved(source, path, watch, None)
    }

    /// Returns a scene for a separate sensor file: the sensor in front of a diffuse (Lambertian)
    /// plane of reflectance 0.5 in the head's xy plane. Returns `None` if the file is a scene or is
    /// not recognised. Returns an error for mistakes in a sensor file.
    #[doc(hidden)]
    pub fn of_sensor(path: &Path) -> Result<Option<Scene>> {
        let text = input_file::read_text(path, LARGEST_TEXT, "a sensor's file (TOML)").ok();
        let table = text.and_then(|text| text.parse::<toml::Table>().ok());
        let has = |key: &str| table.as_ref().is_some_and(|table| table.contains_key(key));
        let describes = ["data_sheet", "laser", "camera"].into_iter().any(has);
        if !describes || ["part", "scan", "sensor"].into_iter().any(has) {
            return Ok(None);
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let sensor = toml::Value::String(name.into_owned());
        let scene = format!(
            "seed = 1\nspeckle = true\nsensor = {sensor}\n[part]\nplane = {{ size_mm = [1000, 1000] }}\n\
             reflectance = 0.5\n[scan]\nframes = 1\nstep_mm = 1\ndirection = [0, 1, 0]\n"
        );
        let source = TomlSource::parse(path, scene)?;
        Scene::resolved(source, path, &|_| Ok(()), None).map(Some)
    }

    /// Parses and validates a scene from TOML text. File names are relative to `folder`. Messages
    /// name the source `scene text`, in `folder`.
    ///
    /// ```
    /// use lasertrace::{Error, Scene};
    ///
    /// let text = include_str!("../../scenes/plane/scene.toml");
    /// let scene = Scene::parse(text, "folder-of-its-files".as_ref())?;
    /// assert_eq!((scene.scan.frames, scene.mesh.triangles.len()), (9, 2));
    ///
    /// let wrong = text.replace("f_number = 8", "f_number = 0");
    /// let Err(Error::Input(mistake)) = Scene::parse(&wrong, "".as_ref()) else {
    ///     panic!("a lens needs an aperture");
    /// };
    /// assert_eq!(mistake.key.as_deref(), Some("camera.f_number"));
    /// # Ok::<(), Error>(())
    /// ```
    pub fn parse(text: &str, folder: &Path) -> Result<Scene> {
        let path = folder.join("scene text");
        let source = TomlSource::parse(&path, text.to_owned())?;
        Scene::resolved(source, &path, &|_| Ok(()), None)
    }

    /// Parses another scene text with an unchanged part. The mesh and instances are shared, not
    /// read again.
    pub(crate) fn reusing_part(&self, text: String) -> Result<Scene> {
        let source = TomlSource::parse(&self.path, text)?;
        Scene::resolved(source, &self.path, &|_| Ok(()), Some(self))
    }

    /// Parses another scene text at the path of this scene, with a different part.
    pub(crate) fn of_other_part(&self, text: String, watch: &ProgressFn) -> Result<Scene> {
        let source = TomlSource::parse(&self.path, text)?;
        Scene::resolved(source, &self.path, watch, None)
    }

    /// Returns the scene with this exposure time (ms), limited by the frame period.
    pub(crate) fn with_exposure(&self, exposure_ms: f64) -> Scene {
        let mut scene = self.clone();
        let before = self.camera.sensor.exposure_ms;
        let longest = self
            .scan
            .exposure_share
            .map_or(f64::INFINITY, |share| before / share);
        scene.camera.sensor.exposure_ms = exposure_ms.min(longest);
        scene.scan.exposure_share = self
            .scan
            .exposure_share
            .map(|share| share * scene.camera.sensor.exposure_ms / before);
        scene.auto_exposure = None;
        scene
    }

    /// Resolves the scenes of all cameras.
    fn resolved(
        source: TomlSource,
        path: &Path,
        watch: &ProgressFn,
        like: Option<&Scene>,
    ) -> Result<Scene> {
        let (first, source_of_first) = Scene::of_camera(source.clone(), path, watch, like)?;
        let count = source_of_first.cameras();
        let calibrations = source_of_first.calibrations();
        if calibrations.unwrap_or(count) != count
            || count > 1 && first.calibration.is_some() && calibrations.is_none()
        {
            let expected = match count {
                1 => "one file".to_owned(),
                _ => format!("a list of {count} files, one per camera"),
            };
            return Err(source.input_error("measure.calibration", &expected));
        }
        if count == 1 {
            return Ok(first);
        }
        let mut cameras = vec![first.clone()];
        for camera in 1..count {
            let source = source.with_camera(camera);
            let (scene, source) = Scene::of_camera(source, path, watch, Some(&first))?;
            if cameras
                .iter()
                .any(|c| c.camera_number == scene.camera_number)
            {
                return Err(source.input_error("camera.number", "another number for each camera"));
            }
            cameras.push(scene);
        }
        // The cloud of all cameras is aligned.
        for scene in &mut cameras {
            scene.inputs = first.inputs.clone();
            scene.measure.align = false;
        }
        let tables = cameras
            .iter()
            .filter_map(|c| c.values.get("camera").cloned());
        let mut values = toml::Table::clone(&first.values);
        values.insert("camera".to_owned(), tables.collect::<Vec<_>>().into());
        let key = "measure.calibration";
        let file = |c: &Scene| value_at(&mut toml::Table::clone(&c.values), key).cloned();
        let files: Option<Vec<toml::Value>> = cameras.iter().map(file).collect();
        if let (Some(files), Some(value)) = (files, value_at(&mut values, key)) {
            *value = files.into();
        }
        Ok(Scene {
            values: values.into(),
            cameras: cameras.into(),
            ..first
        })
    }

    /// Returns the scene of each camera; the scene itself if it has one camera.
    pub(crate) fn each_camera(&self) -> &[Scene] {
        match &*self.cameras {
            [] => std::slice::from_ref(self),
            cameras => cameras,
        }
    }

    /// Returns the scene of the first camera.
    pub(crate) fn of_first_camera(self) -> Scene {
        self.cameras.first().cloned().unwrap_or(self)
    }

    /// Returns the scene of the camera with this number. Errors: no camera has the number.
    pub fn of_camera_number(&self, number: u32) -> Result<Scene> {
        let all = self.each_camera();
        let found = all.iter().find(|scene| scene.camera_number == number);
        let numbers = || {
            let numbers = all.iter().map(|scene| scene.camera_number.to_string());
            numbers.collect::<Vec<_>>().join(", ")
        };
        found.cloned().ok_or_else(|| {
            Error::Usage(format!(
                "{}: found camera {number}, expected one of {}",
                printable::path(&self.path),
                numbers()
            ))
        })
    }

    /// Returns the seed of speckle, noise and fixed patterns.
    pub(crate) fn camera_seed(&self) -> u64 {
        // The high bits differ from all seeds below 2⁴⁸.
        self.seed ^ (u64::from(self.camera_number - 1) << 48)
    }

    /// Returns an error for a scene of several cameras.
    pub(crate) fn require_one_camera(&self) -> Result<()> {
        match self.cameras.len() {
            0 => Ok(()),
            n => Err(Error::Usage(format!(
                "{}: found {n} cameras, expected one: select it with --camera N, or from Scene.cameras in Rust and Python",
                printable::path(&self.path)
            ))),
        }
    }

    /// Resolves the scene of the selected camera. Also returns the source with all of its files.
    fn of_camera(
        source: TomlSource,
        path: &Path,
        watch: &ProgressFn,
        like: Option<&Scene>,
    ) -> Result<(Scene, TomlSource)> {
        let mut resolver = Resolver {
            source,
            path,
            watch,
            inputs: RefCell::new(vec![path.to_owned()]),
        };
        let solved = resolver.take_sensor()?;
        let file: SceneFile = resolver.source.values()?;
        let derived: Vec<&str> = solved.values.iter().map(|value| value.key).collect();
        let source = resolver.source.clone();
        let scene = resolver
            .scene(file, solved, like)
            .map_err(|error| in_data_sheet(error, &derived))?;
        Ok((scene, source))
    }

    /// Returns whether indirect light is considered. Diffuse parts have indirect light only if the
    /// scene requests it.
    pub(crate) fn considers_indirect_light(&self) -> bool {
        self.surface.glossy().next().is_some() || self.methods.max_bounces.is_some()
    }

    /// Returns the bounding box of the part, in the part's frame.
    pub fn bounds(&self) -> Aabb {
        let mesh = self.mesh.bounds();
        let copies = self.copies.iter().map(|pose| mesh.moved(pose));
        copies.fold(Aabb::EMPTY, |all, one| all.with(&one))
    }

    /// Returns the pose of the head in a frame.
    pub fn world_from_head(&self, frame: u32) -> Rigid {
        self.scan.world_from_head(frame as f64)
    }

    /// Returns the pose of the part in a frame.
    pub fn world_from_part(&self, frame: u32) -> Rigid {
        self.scan.world_from_part(frame as f64, &self.part_at_rest)
    }

    /// Returns the pose of the head in the part's frame, at the midpoint of a frame's exposure.
    pub fn part_from_head(&self, frame: u32) -> Rigid {
        self.part_from_head_at(frame as f64)
    }

    /// Returns the pose of the head in the part's frame at a fractional frame number. Beyond both
    /// ends the path is extrapolated.
    pub fn part_from_head_at(&self, place: f64) -> Rigid {
        let part = self.scan.world_from_part(place, &self.part_at_rest);
        part.inverse() * self.scan.world_from_head(place)
    }
}

/// Nominal geometry (CAD) of a part whose actual geometry is scanned.
#[derive(Clone, serde::Serialize)]
pub struct Nominal {
    /// Mesh in its own frame, mm.
    #[serde(skip)]
    pub mesh: Arc<Mesh>,
    /// Group names of the triangles in the mesh file.
    #[serde(skip)]
    pub groups: Arc<Groups>,
    /// Pose of the mesh in the part, or in each instance of an assembly.
    pub part_from_nominal: Rigid,
}

/// Converts a mistake in a value that is derived from a data sheet to a mistake of the data sheet,
/// since the file does not contain the value.
fn in_data_sheet(error: Error, derived: &[&str]) -> Error {
    let Error::Input(mut mistake) = error else {
        return error;
    };
    if let Some(key) = &mistake.key
        && mistake.place == Place::File
        && derived.contains(&key.as_str())
    {
        mistake.expected = format!(
            "other values: from these, {key} follows as {}, which is not {}",
            mistake.found, mistake.expected
        );
        mistake.found = "[data_sheet]".to_owned();
        mistake.key = Some("data_sheet".to_owned());
    }
    Error::Input(mistake)
}

fn number<S: serde::Serializer>(
    copies: &[Rigid],
    serializer: S,
) -> std::result::Result<S::Ok, S::Error> {
    serializer.serialize_u64(copies.len() as u64)
}

fn each<S: serde::Serializer>(
    ignored: &[Ignored],
    serializer: S,
) -> std::result::Result<S::Ok, S::Error> {
    serializer.collect_seq(ignored)
}

/// Triangles of a part.
pub(super) struct PartMesh {
    pub mesh: Arc<Mesh>,
    groups: Arc<Groups>,
    ignored: Arc<[Ignored]>,
    /// Bytes that represent the mesh file in the scene's hash.
    pub hash: Vec<u8>,
    /// Unit of the file, if the file does not state one.
    unit: Option<Unit>,
}

impl PartMesh {
    fn new(contents: Contents, hash: Vec<u8>, unit: Option<Unit>) -> PartMesh {
        PartMesh {
            mesh: Arc::new(contents.mesh),
            groups: Arc::new(contents.groups),
            ignored: contents.ignored.into(),
            hash,
            unit,
        }
    }

    /// Returns the part of an existing scene.
    fn of(scene: &Scene) -> PartMesh {
        PartMesh {
            mesh: scene.mesh.clone(),
            groups: scene.groups.clone(),
            ignored: scene.mesh_ignored.clone(),
            hash: Vec::from(&*scene.hash),
            unit: scene.mesh_unit,
        }
    }
}

/// Scanned triangles of a scene with objects.
pub(super) struct SceneMesh {
    pub mesh: Arc<Mesh>,
    pub surface: Materials,
    pub nominal: Option<Nominal>,
    /// Number of triangles of the part; `None` without objects.
    pub part_triangles: Option<u32>,
    /// Bytes that represent the files of the objects in the scene's hash.
    pub hash: Vec<u8>,
}

impl Resolver<'_> {
    /// Builds the scene. `like` is a scene with the same part, whose mesh is reused.
    #[expect(
        clippy::too_many_lines,
        reason = "one table of the scene after the other"
    )]
    fn scene(self, file: SceneFile, sensor: SolvedSensor, like: Option<&Scene>) -> Result<Scene> {
        let PartMesh {
            mesh,
            groups,
            ignored: mesh_ignored,
            hash: mesh_hash,
            unit: mesh_unit,
        } = match like.filter(|_| file.object.is_empty()) {
            Some(scene) => PartMesh::of(scene),
            None => self.mesh(&file.part)?,
        };
        let (nominal, nominal_hash) = self.nominal(file.inspect.nominal.as_ref(), like)?;
        let chord = match &file.inspect.nominal {
            None => self.chord(
                file.part
                    .mesh
                    .as_ref()
                    .and_then(|table| table.chordal_deviation_um),
                "part.mesh.chordal_deviation_um",
            )?,
            Some(table) => self.chord(
                table.chordal_deviation_um,
                "inspect.nominal.chordal_deviation_um",
            )?,
        };
        let part = file.part.to_text();
        let (copies, copies_hash) = self.copies(&file.part, like)?;
        let part_at_rest = self.pose(file.part.position_mm, file.part.rotation_deg, "part")?;
        let head_from_camera = self.camera_pose(&file.camera)?;
        let camera_number = file.camera.number.unwrap_or(self.source.camera_number());
        let is_number = (1..=64).contains(&camera_number);
        self.check(is_number, "camera.number", "a whole number from 1 to 64")?;
        let laser = self.laser(&file.laser)?;
        let line_profile = match laser.fan.as_ref().map(|fan| &fan.profile) {
            Some(FanProfile::Measured(profile)) => serde_json::to_vec(profile),
            _ => Ok(Vec::new()),
        };
        let line_profile_hash = line_profile.expect("a profile has finite numbers only");
        let coherence_length_mm = self.coherence_length(&file.laser)?;
        let head_from_laser = self.laser_pose(&file.laser, &head_from_camera)?;
        self.triangulation(&file.camera, &head_from_laser, &head_from_camera)?;
        let housing = self.housing(file.housing_bounds_mm)?;
        let field_of_view = self.field_of_view(file.field_of_view_mm.as_ref())?;
        let named = (&*groups, mesh.triangles.len());
        let polarised = |glossy: &LayeredBrdf| {
            degree_of_polarisation(glossy, &head_from_laser, &head_from_camera)
        };
        let light = (file.laser.wavelength_nm, file.seed);
        let surface = self.surfaces(&file.part, light, named, polarised)?;
        let groups_of_cad = nominal.as_ref().map_or(&groups, |nominal| &nominal.groups);
        let features = self.features(&file.feature, &groups_of_cad.names())?;
        let without_objects = SceneMesh {
            mesh,
            surface,
            nominal,
            part_triangles: None,
            hash: Vec::new(),
        };
        let SceneMesh {
            mesh,
            surface,
            nominal,
            part_triangles,
            hash: objects_hash,
        } = match file.object.is_empty() {
            true => without_objects,
            false => {
                let expected = "no [[object]]; only a part without instances may have objects";
                self.check(file.part.instances.is_none(), "part.instances", expected)?;
                let merged = like.map(|scene| scene.mesh.clone());
                self.with_objects(
                    &file.object,
                    (without_objects, &groups),
                    merged,
                    light,
                    &polarised,
                )?
            }
        };
        let auto_exposure = self.auto_exposure(&file.camera)?;
        let camera_from_laser = head_from_camera.inverse() * head_from_laser;
        let mut camera = self.camera(&file.camera, &file.scan, &camera_from_laser)?;
        let ambient = self.ambient(&file, &surface, mesh.triangles.len(), &mut camera)?;
        let (scan, poses_hash) = self.scan(&file.scan, camera.sensor.exposure_ms)?;
        let speckle = self.speckle(&file, &camera, &surface)?;
        let measure = self.measure(&file.measure, &camera, scan.frames)?;
        let (calibration, calibration_hash) = self.calibration(&file, &camera)?;
        let by_field = speckle.is_some_and(|s| s.method == Method::Field);
        self.accept(&file.accept)?;
        let systematic = self.systematic(&file, laser.fan.as_ref().map(|fan| fan.angle))?;
        let methods = self.methods(
            &file.model,
            (file.save_images, laser.fan.is_some()),
            by_field,
        )?;
        if let (Some(Sampling::PlaneCut), Some(required)) = (
            methods.pixel_sampling,
            frame::unmet_plane_cut_requirement(&laser, &camera, &surface),
        ) {
            let expected =
                format!("\"planar\" or \"per-sample\"; \"plane-cut\" requires {required}");
            self.check(false, "model.pixel_sampling", &expected)?;
        }
        let mut values: toml::Table = self.source.values()?;
        if let Some(toml::Value::String(name)) = value_at(&mut values, LINE_PROFILE) {
            *name = self.in_scene_folder(name, self.source.file_of("laser.line.profile"));
        }
        values.remove("sensor");
        values.remove("data_sheet");
        if let Some(camera) = values.get_mut("camera").and_then(toml::Value::as_table_mut) {
            camera.remove("opencv");
            if camera_number > 1 {
                camera.insert("number".to_owned(), i64::from(camera_number).into());
            }
        }
        Ok(Scene {
            path: self.path.to_owned(),
            values: values.into(),
            inputs: self.inputs.take().into(),
            hash: self.hash(&[
                mesh_hash,
                copies_hash,
                poses_hash,
                calibration_hash,
                nominal_hash,
                objects_hash,
                line_profile_hash,
            ]),
            seed: file.seed,
            speckle,
            save_images: file.save_images,
            accel: methods.ray_backend.unwrap_or_default(),
            tolerance_um: self.tolerance(&file.accuracy)?,
            methods,
            part,
            mesh,
            groups,
            mesh_ignored,
            mesh_unit,
            chord,
            nominal,
            part_triangles,
            copies,
            surface,
            part_at_rest,
            laser,
            coherence_length_mm,
            head_from_laser,
            camera,
            head_from_camera,
            camera_number,
            cameras: [].into(),
            housing,
            field_of_view,
            auto_exposure,
            sensor,
            measure,
            bands: self.bands(&file.inspect)?,
            features,
            scan,
            calibration,
            ambient,
            systematic,
            accept: file.accept,
            warnings: self.warnings(&file.warnings)?,
        })
    }

    /// Returns a file name that is relative to the file `base`, relative to the folder of the scene.
    fn in_scene_folder(&self, name: &str, base: &Path) -> String {
        let [own, other] = [self.path, base].map(|path| path.parent().unwrap_or(Path::new("")));
        let file = other.join(name);
        let file = file.strip_prefix(own).unwrap_or(&file);
        file.to_string_lossy().into_owned()
    }

    /// Returns the SHA-256 of the scene's text and of the bytes that represent its files.
    fn hash(&self, files: &[Vec<u8>]) -> String {
        let mut hash = Sha256::new();
        hash.update(self.source.text());
        if self.source.camera_number() > 1 {
            hash.update(self.source.camera_number().to_le_bytes());
        }
        files.iter().for_each(|bytes| hash.update(bytes));
        let bytes = hash.finalize();
        bytes.iter().map(|b| format!("{b:02x}")).collect()
    }

    fn housing(&self, corners: Option<[[f64; 3]; 2]>) -> Result<Option<Aabb>> {
        let Some([lower, upper]) = corners else {
            return Ok(None);
        };
        self.lengths(lower, "housing_bounds_mm")?;
        self.lengths(upper, "housing_bounds_mm")?;
        let expected = "a lower corner and an upper one: [[-50, -120, 100], [50, 20, 180]]";
        let ordered = lower.iter().zip(&upper).all(|(a, b)| a < b);
        self.check(ordered, "housing_bounds_mm", expected)?;
        Ok(Some(Aabb::of([lower, upper].map(DVec3::from))))
    }

    /// Returns the chordal deviation of the triangles from the part, mm.
    fn chord(&self, chordal_deviation_um: Option<f64>, key: &str) -> Result<f64> {
        match chordal_deviation_um {
            Some(chordal_deviation_um) => Ok(self.positive(chordal_deviation_um, key)? * 1e-3),
            None => Ok(0.0),
        }
    }

    /// Returns the nominal geometry, and the bytes that represent it in the hash.
    fn nominal(
        &self,
        table: Option<&NominalTable>,
        like: Option<&Scene>,
    ) -> Result<(Option<Nominal>, Vec<u8>)> {
        let Some(table) = table else {
            return Ok((None, Vec::new()));
        };
        if let Some(nominal) = like.and_then(|scene| scene.nominal.clone()) {
            return Ok((Some(nominal), Vec::new()));
        }
        let part_from_nominal =
            self.pose(table.position_mm, table.rotation_deg, "inspect.nominal")?;
        let found = self.mesh_of_file(&table.file, table.unit, "inspect.nominal")?;
        let nominal = Nominal {
            mesh: found.mesh,
            groups: found.groups,
            part_from_nominal,
        };
        Ok((Some(nominal), found.hash))
    }

    /// Returns the pose given by the keys `position_mm` and `rotation_deg` of a table.
    pub(super) fn pose(
        &self,
        position: [f64; 3],
        rotation: [f64; 3],
        table: &str,
    ) -> Result<Rigid> {
        self.check(
            rotation.iter().all(|r| r.abs() <= 360.0),
            &format!("{table}.rotation_deg"),
            "angles from -360 to 360",
        )?;
        let position = self.lengths(position, &format!("{table}.position_mm"))?;
        let rotation = DVec3::from(rotation).map(f64::to_radians);
        Ok(Rigid::from_euler_xyz(rotation, position.into()))
    }

    /// Returns the poses of the instances, and the hash of the file that contains them.
    fn copies(&self, part: &PartTable, like: Option<&Scene>) -> Result<(Arc<[Rigid]>, Vec<u8>)> {
        match (like, &part.instances) {
            (Some(scene), _) => Ok((scene.copies.clone(), Vec::new())),
            (None, None) => Ok((vec![Rigid::IDENTITY].into(), Vec::new())),
            (None, Some(file)) => {
                let (_, list, hash) = self.poses(file, "part.instances", None)?;
                Ok((list.poses.into(), hash))
            }
        }
    }

    /// Returns the calibration that the scene names, and the bytes that represent it in the hash.
    fn calibration(
        &self,
        file: &SceneFile,
        camera: &Camera,
    ) -> Result<(Option<Calibration>, Vec<u8>)> {
        let Some(name) = &file.measure.calibration else {
            return Ok((None, Vec::new()));
        };
        let path = self.file(name, "measure.calibration", "a calibration")?;
        let bytes = input_file::read(&path, LARGEST_TEXT, "a calibration (JSON)")?;
        let calibration = Calibration::parse(&path, &bytes)?;
        let [columns, rows] = camera.sensor.resolution.to_array();
        self.check(
            calibration.camera.resolution == camera.sensor.resolution,
            "measure.calibration",
            &format!("a calibration of a sensor of {columns} × {rows} pixels"),
        )?;
        Ok((Some(calibration), Sha256::digest(&bytes).to_vec()))
    }

    /// Reads a mesh file. `table` is the key of the table that names it.
    pub(super) fn mesh_of_file(
        &self,
        name: &str,
        given: Option<Unit>,
        table: &str,
    ) -> Result<PartMesh> {
        let file = self.file(name, &format!("{table}.file"), "a mesh file")?;
        let bytes = mesh::read(&file, self.watch)?;
        let unit_by = mesh::unit_by(&file, &bytes)?;
        let unit = match unit_by {
            _ if given.is_some() => given,
            mesh::UnitSource::User => return Err(self.source.missing(&format!("{table}.unit"))),
            mesh::UnitSource::Metres => Some(Unit::Metre),
            mesh::UnitSource::File => None,
        };
        let (contents, hash) = rayon::join(
            || mesh::parse_whole(&file, &bytes, unit.map(Unit::mm)),
            || Sha256::digest(&bytes).to_vec(),
        );
        let (contents, mut hash) = (contents?, hash);
        let mesh = &contents.mesh;
        if unit_by == mesh::UnitSource::Metres {
            // The numbers of this format may be stored in separate files, so they are hashed too.
            let numbers = mesh
                .positions
                .iter()
                .flat_map(|p| p.to_array().map(f64::to_le_bytes));
            let numbers: Vec<u8> = numbers.flatten().collect();
            hash.extend(Sha256::digest(numbers));
        }
        if !mesh::has_area(mesh) {
            let found = format!("{} triangles, all without area", mesh.triangles.len());
            let expected = "a mesh with a surface";
            return Err(InputError::new(&file, Place::File, found, expected).into());
        }
        Ok(PartMesh::new(contents, hash, unit))
    }

    fn mesh(&self, part: &PartTable) -> Result<PartMesh> {
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
        let shape = |table: &str, shape: std::result::Result<Mesh, InvalidDimension>| match shape {
            Ok(mesh) => {
                let contents = Contents {
                    mesh,
                    groups: Groups::default(),
                    ignored: Vec::new(),
                };
                Ok(PartMesh::new(contents, Vec::new(), None))
            }
            Err(wrong) => {
                let key = format!("{table}.{}", wrong.argument);
                Err(self.source.input_error(&key, &wrong.expected))
            }
        };
        if let Some(table) = &part.mesh {
            return self.mesh_of_file(&table.file, table.unit, "part.mesh");
        }
        if let Some(table) = &part.plane {
            return shape("part.plane", shapes::plane(table.size_mm.into()));
        }
        if let Some(table) = &part.sphere {
            let chord = table.chordal_deviation_um * 1e-3;
            return shape("part.sphere", shapes::sphere(table.radius_mm, chord));
        }
        if let Some(table) = &part.cylinder {
            let chord = table.chordal_deviation_um * 1e-3;
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
}

//! From the scene file to validated values in internal units (mm, rad).

use super::accept_table::AcceptTable;
use super::data_sheet::SolvedValue;
use super::file::{MeshTable, PartTable, PlanTable, SceneFile};
use super::locate::Source;
use super::path::ScanPath;
use super::resolver::Resolver;
use super::surface::polarised;
use super::unit::Unit;
use super::warnings_table::WarningsTable;
use crate::accel::Backend;
use crate::camera::Camera;
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{InputError, Place, Result, printable};
use crate::inspect::bands::Band;
use crate::laser::Laser;
use crate::math::{Aabb, Aperture, DVec3, Rigid};
use crate::mesh::shapes::{self, WrongSize};
use crate::mesh::{self, Contents, Groups, Ignored, Mesh, Watch};
use crate::profile::{Calibration, Choice, Filters, PeakFinder};
use crate::speckle::lookup::{Coherence, Method};
use crate::surface::Surfaces;
use sha2::{Digest, Sha256};
use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// How speckle is modelled.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpeckleModel {
    /// How patterns are made and read.
    pub method: Method,
    /// What the light's wavelengths and polarisation leave of contrast.
    pub coherence: Coherence,
    /// Shape of the lens's pupil.
    pub aperture: Aperture,
}

/// How the laser line is found in the image.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Measure {
    /// How the line's row is found.
    pub finder: PeakFinder,
    /// Which line of several in a column.
    pub choice: Choice,
    /// Counts above the background that a line's highest pixel has at least; `None`: from the noise.
    pub threshold_dn: Option<f64>,
    /// Best fit of the cloud to the CAD before deviations are taken.
    pub align: bool,
    /// What is done to profiles before they are delivered.
    pub filters: Filters,
}

/// A validated scene: the world at rest and the head's way through it. Cheap to clone:
/// mesh, copies and poses are shared.
#[derive(Clone, serde::Serialize)]
pub struct Scene {
    /// The scene file; what errors and summaries name.
    #[serde(serialize_with = "printable::in_json")]
    pub path: PathBuf,
    /// The scene file and the files it names, which no output may replace.
    #[doc(hidden)]
    #[serde(skip)]
    pub inputs: Arc<[PathBuf]>,
    /// All values by key, from the file, from the sensor that it names, and from a data sheet.
    #[doc(hidden)]
    #[serde(skip)]
    pub values: Arc<toml::Table>,
    /// SHA-256 of the scene file and of the files it names, hexadecimal.
    #[doc(hidden)]
    pub hash: String,
    /// Of everything random.
    pub seed: u64,
    /// `None`: laser light is taken as incoherent.
    #[doc(hidden)]
    pub speckle: Option<SpeckleModel>,
    /// Whether a scan writes its images.
    #[doc(hidden)]
    pub write_frames: bool,
    /// What finds the triangles rays meet.
    pub accel: Backend,
    /// Error of height (µm) that the simulation may add; `None`: nothing is left out.
    pub tolerance_um: Option<f64>,
    /// Methods the scene names.
    #[doc(hidden)]
    pub methods: PlanTable,
    /// The part in words: the mesh file and its unit, or the shape and its size.
    #[doc(hidden)]
    pub part: String,
    /// The part, mm, in its own frame; or what the copies repeat.
    #[serde(skip)]
    pub mesh: Arc<Mesh>,
    /// Names that the mesh's file gives to its triangles.
    #[serde(skip)]
    #[doc(hidden)]
    pub groups: Arc<Groups>,
    /// Content of the mesh's file that was not used.
    #[serde(serialize_with = "each")]
    pub mesh_ignored: Arc<[Ignored]>,
    /// Unit of the mesh's file; `None`: the file states it, or the mesh is a shape of the scene's.
    #[doc(hidden)]
    pub mesh_unit: Option<Unit>,
    /// Largest distance (mm) of the true surface from the mesh file's triangles; 0: not stated.
    #[doc(hidden)]
    pub chord: f64,
    /// Where copies of the mesh are in the part: part_from_copy; at least one. Written
    /// as their number.
    #[serde(serialize_with = "number")]
    pub copies: Arc<[Rigid]>,
    /// How the part scatters light.
    #[doc(hidden)]
    pub surface: Surfaces,
    /// Where the part is unless the path moves it.
    pub part_at_rest: Rigid,
    /// In its own frame.
    pub laser: Laser,
    /// λ²/Δλ of the laser, mm; `None`: longer than all paths of light.
    #[doc(hidden)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coherence_length_mm: Option<f64>,
    /// Where the laser stands in the head.
    pub head_from_laser: Rigid,
    /// In its own frame.
    pub camera: Camera,
    /// Where the camera stands in the head.
    pub head_from_camera: Rigid,
    /// Box of the sensor's housing in the head's frame, mm; `None`: nobody says.
    #[doc(hidden)]
    pub housing: Option<Aabb>,
    /// Share of full scale at which the exposure is still to be set; `None`: it is as given.
    #[doc(hidden)]
    pub auto_exposure: Option<f64>,
    /// What was worked out from a data sheet, with why; empty without one.
    #[doc(hidden)]
    pub sensor: Vec<SolvedValue>,
    /// From image to points.
    #[doc(hidden)]
    pub measure: Measure,
    /// Which deviations regions of the part may have; empty where nobody says.
    #[doc(hidden)]
    pub bands: Vec<Band>,
    /// How the body moves, and how often a frame is taken.
    pub scan: ScanPath,
    /// What the measurement takes the sensor for; `None`: what it is.
    #[doc(hidden)]
    pub calibration: Option<Calibration>,
    /// The acceptance test of the sensor, as written.
    #[doc(hidden)]
    pub accept: AcceptTable,
    /// Limits of the warnings.
    #[doc(hidden)]
    pub warnings: WarningsTable,
}

impl Scene {
    /// Reads and validates a scene file and the files it names. Errors: a file that cannot
    /// be read; a mistake in one, with its place.
    pub fn load(path: &Path) -> Result<Scene> {
        Scene::load_watched(path, &|_| Ok(()))
    }

    /// The same; `watch` hears how much of the mesh is read.
    #[doc(hidden)]
    pub fn load_watched(path: &Path, watch: &Watch) -> Result<Scene> {
        let source = Source::read(path)?;
        source.require_scene()?;
        Scene::resolved(source, path, watch, None)
    }

    /// A scene of the sensor that a file of its own describes: before it, in the head's xy plane, a matt plane that
    /// reflects half of the light. `None`: the file is a scene, or nothing that is known. Errors: mistakes in a sensor's file.
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
        let source = Source::parse(path, scene)?;
        Scene::resolved(source, path, &|_| Ok(()), None).map(Some)
    }

    /// The same of a scene given as text (TOML), whose files are sought in `folder`.
    /// Messages call it `scene text` there.
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
        let source = Source::parse(&path, text.to_owned())?;
        Scene::resolved(source, &path, &|_| Ok(()), None)
    }

    /// The scene of another text with the same part, whose mesh and copies are shared and not read again.
    pub(crate) fn of_same_part(&self, text: String) -> Result<Scene> {
        let source = Source::parse(&self.path, text)?;
        Scene::resolved(source, &self.path, &|_| Ok(()), Some(self))
    }

    /// The scene of another text in the same place, with a part of its own.
    pub(crate) fn of_other_part(&self, text: String, watch: &Watch) -> Result<Scene> {
        let source = Source::parse(&self.path, text)?;
        Scene::resolved(source, &self.path, watch, None)
    }

    /// The scene with this exposure (ms), or as long a one as the frame rate lets it have.
    pub(crate) fn exposed(&self, exposure_ms: f64) -> Scene {
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

    fn resolved(source: Source, path: &Path, watch: &Watch, like: Option<&Scene>) -> Result<Scene> {
        let mut resolver = Resolver {
            source,
            path,
            watch,
            inputs: RefCell::new(vec![path.to_owned()]),
        };
        let solved = resolver.take_sensor()?;
        let file: SceneFile = resolver.source.values()?;
        resolver.scene(file, solved, like)
    }

    /// A box around the part, in its frame.
    pub fn bounds(&self) -> Aabb {
        let mesh = self.mesh.bounds();
        let copies = self.copies.iter().map(|pose| mesh.moved(pose));
        copies.fold(Aabb::EMPTY, |all, one| all.with(&one))
    }

    /// Pose of the head in a frame.
    pub fn world_from_head(&self, frame: u32) -> Rigid {
        self.scan.world_from_head(frame as f64)
    }

    /// Pose of the part in a frame.
    pub fn world_from_part(&self, frame: u32) -> Rigid {
        self.scan.world_from_part(frame as f64, &self.part_at_rest)
    }

    /// Pose of the head in the part's frame in a frame's middle.
    pub fn part_from_head(&self, frame: u32) -> Rigid {
        self.part_from_head_at(frame as f64)
    }

    /// The same between frames, and beyond the ends as the path goes on.
    pub fn part_from_head_at(&self, place: f64) -> Rigid {
        let part = self.scan.world_from_part(place, &self.part_at_rest);
        part.inverse() * self.scan.world_from_head(place)
    }
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

/// A part's triangles.
struct PartMesh {
    mesh: Arc<Mesh>,
    groups: Arc<Groups>,
    ignored: Arc<[Ignored]>,
    /// What stands for a mesh file in the scene's hash.
    hash: Vec<u8>,
    /// If the file does not state one itself.
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

    /// That of a scene.
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

impl Resolver<'_> {
    /// `like` is a scene with the same part.
    #[expect(
        clippy::too_many_lines,
        reason = "one table of the scene after the other"
    )]
    fn scene(
        self,
        file: SceneFile,
        sensor: Vec<SolvedValue>,
        like: Option<&Scene>,
    ) -> Result<Scene> {
        let PartMesh {
            mesh,
            groups,
            ignored: mesh_ignored,
            hash: mesh_hash,
            unit: mesh_unit,
        } = match like {
            Some(scene) => PartMesh::of(scene),
            None => self.mesh(&file.part)?,
        };
        let chord = self.chord(&file.part)?;
        let part = file.part.in_words();
        let (copies, copies_hash) = self.copies(&file.part, like)?;
        let part_at_rest = self.part_at_rest(&file.part)?;
        let head_from_camera = self.camera_pose(&file.camera)?;
        let laser = self.laser(&file.laser)?;
        let coherence_length_mm = self.coherence_length(&file.laser)?;
        let head_from_laser = self.laser_pose(&file.laser, &head_from_camera)?;
        self.triangulation(&head_from_laser, &head_from_camera)?;
        let housing = self.housing(file.housing_mm)?;
        let named = (&*groups, mesh.triangles.len());
        let surface = self.surfaces(&file.part, file.laser.wavelength_nm, named, |glossy| {
            polarised(glossy, &head_from_laser, &head_from_camera)
        })?;
        let auto_exposure = self.auto_exposure(&file.camera)?;
        let camera_from_laser = head_from_camera.inverse() * head_from_laser;
        let camera = self.camera(&file.camera, &file.scan, &camera_from_laser)?;
        let (scan, poses_hash) = self.scan(&file.scan, camera.sensor.exposure_ms)?;
        let speckle = self.speckle(&file, &camera, &surface)?;
        let measure = self.measure(&file.measure, &camera, scan.frames)?;
        let (calibration, calibration_hash) = self.calibration(&file, &camera)?;
        let by_field = speckle.is_some_and(|s| s.method == Method::Field);
        self.accept(&file.accept)?;
        let methods = self.methods(
            &file.plan,
            (file.write_frames, laser.fan.is_some()),
            by_field,
        )?;
        let mut values: toml::Table = self.source.values()?;
        values.remove("sensor");
        values.remove("data_sheet");
        Ok(Scene {
            path: self.path.to_owned(),
            values: values.into(),
            inputs: self.inputs.take().into(),
            hash: self.hash(&[mesh_hash, copies_hash, poses_hash, calibration_hash]),
            seed: file.seed,
            speckle,
            write_frames: file.write_frames,
            accel: methods.accel.unwrap_or_default(),
            tolerance_um: self.tolerance(&file.accuracy)?,
            methods,
            part,
            mesh,
            groups,
            mesh_ignored,
            mesh_unit,
            chord,
            copies,
            surface,
            part_at_rest,
            laser,
            coherence_length_mm,
            head_from_laser,
            camera,
            head_from_camera,
            housing,
            auto_exposure,
            sensor,
            measure,
            bands: self.bands(&file.inspect)?,
            scan,
            calibration,
            accept: file.accept,
            warnings: self.warnings(&file.warnings)?,
        })
    }

    /// Of the scene's text and what stands for its files.
    fn hash(&self, files: &[Vec<u8>]) -> String {
        let mut hash = Sha256::new();
        hash.update(self.source.text());
        files.iter().for_each(|bytes| hash.update(bytes));
        let bytes = hash.finalize();
        bytes.iter().map(|b| format!("{b:02x}")).collect()
    }

    fn housing(&self, corners: Option<[[f64; 3]; 2]>) -> Result<Option<Aabb>> {
        let Some([lower, upper]) = corners else {
            return Ok(None);
        };
        self.lengths(lower, "housing_mm")?;
        self.lengths(upper, "housing_mm")?;
        let expected = "a lower corner and an upper one: [[-50, -120, 100], [50, 20, 180]]";
        let ordered = lower.iter().zip(&upper).all(|(a, b)| a < b);
        self.check(ordered, "housing_mm", expected)?;
        Ok(Some(Aabb::of([lower, upper].map(DVec3::from))))
    }

    /// How far the triangles may be off the part, mm.
    fn chord(&self, part: &PartTable) -> Result<f64> {
        match part.mesh.as_ref().and_then(|table| table.chord_um) {
            Some(chord_um) => Ok(self.positive(chord_um, "part.mesh.chord_um")? * 1e-3),
            None => Ok(0.0),
        }
    }

    /// Where the copies of the mesh stand, and the hash of the file that says so.
    fn copies(&self, part: &PartTable, like: Option<&Scene>) -> Result<(Arc<[Rigid]>, Vec<u8>)> {
        match (like, &part.copies) {
            (Some(scene), _) => Ok((scene.copies.clone(), Vec::new())),
            (None, None) => Ok((vec![Rigid::IDENTITY].into(), Vec::new())),
            (None, Some(file)) => {
                let (_, list, hash) = self.poses(file, "part.copies", None)?;
                Ok((list.poses.into(), hash))
            }
        }
    }

    fn part_at_rest(&self, part: &PartTable) -> Result<Rigid> {
        let rotation = part.rotation_deg;
        self.check(
            rotation.iter().all(|r| r.abs() <= 360.0),
            "part.rotation_deg",
            "angles from -360 to 360",
        )?;
        let position = self.lengths(part.position_mm, "part.position_mm")?;
        let rotation = DVec3::from(rotation).map(f64::to_radians);
        Ok(Rigid::from_euler_xyz(rotation, position.into()))
    }

    /// The calibration that the scene names, and the bytes that stand for it in the
    /// hash.
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

    fn mesh_of_file(&self, table: &MeshTable) -> Result<PartMesh> {
        let file = self.file(&table.file, "part.mesh.file", "a mesh file")?;
        let bytes = mesh::read(&file, self.watch)?;
        let unit_by = mesh::unit_by(&file, &bytes)?;
        let unit = match unit_by {
            _ if table.unit.is_some() => table.unit,
            mesh::UnitBy::User => return Err(self.source.missing("part.mesh.unit")),
            mesh::UnitBy::Metres => Some(Unit::Metre),
            mesh::UnitBy::File => None,
        };
        let (contents, hash) = rayon::join(
            || mesh::parse_whole(&file, &bytes, unit.map(Unit::mm)),
            || Sha256::digest(&bytes).to_vec(),
        );
        let (contents, mut hash) = (contents?, hash);
        let mesh = &contents.mesh;
        if unit_by == mesh::UnitBy::Metres {
            // Its numbers may stand in other files.
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
        let shape = |table: &str, shape: std::result::Result<Mesh, WrongSize>| match shape {
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
                Err(self.source.wrong(&key, &wrong.expected))
            }
        };
        if let Some(table) = &part.mesh {
            return self.mesh_of_file(table);
        }
        if let Some(table) = &part.plane {
            return shape("part.plane", shapes::plane(table.size_mm.into()));
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
}

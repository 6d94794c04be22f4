//! Structure of the scene file (TOML). Lengths are in millimetres unless the key names another
//! unit.
//!
//! The doc comments of this module become the descriptions in the JSON Schema.

use super::accept_table::AcceptTable;
use super::ambient_table::AmbientTable;
use super::arrays::{array, optional_array};
use super::data_sheet::DataSheet;
use super::feature_table::FeatureTable;
use super::object_table::ObjectTable;
use super::opencv_table::OpenCvTable;
use super::surface_table::{SurfaceTable, one};
use super::systematic_table::{StageErrorsTable, SystematicTable};
use super::unit::Unit;
use super::warnings_table::WarningsTable;
use crate::accel::Backend;
use crate::frame::{Blur, Sampling};
use crate::math::Aperture;
use crate::profile::{PeakFinder, PeakSelection};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// A laser-triangulation scan of one part. The world frame is right-handed, in millimetres.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "lasertrace scene")]
pub struct SceneFile {
    /// Random seed of sensor noise and speckle.
    pub seed: u64,
    /// Whether laser light is simulated with speckle.
    pub speckle: bool,
    /// Method by which speckle patterns are interpolated. Default: field.
    #[serde(default)]
    pub speckle_method: SpeckleMethod,
    /// Whether a scan also writes every frame as frames/frame-KKKKKK.png. Default: false.
    #[serde(default)]
    pub save_images: bool,
    /// Sensor file (TOML) with `laser` and `camera`, or a `data_sheet`. The path is relative to the
    /// scene file. Values in the scene override values in the sensor file. Default: the scene
    /// contains all values.
    pub sensor: Option<String>,
    /// Data sheet of the sensor, from which `laser` and `camera` are derived.
    pub data_sheet: Option<DataSheet>,
    /// Lower and upper corner of a box that encloses the sensor's housing, in the head frame.
    /// `check` reports where the box touches the part. Default: none.
    pub housing_bounds_mm: Option<[[f64; 3]; 2]>,
    /// Measuring field in the laser plane: a list of distances from the laser along the beam and
    /// widths there, at least two, by increasing distance. Between them the width changes linearly.
    /// Points outside this polygon are not output. Default: the field that the camera sees.
    pub field_of_view_mm: Option<Vec<[f64; 2]>>,
    /// Inspected part.
    pub part: PartTable,
    /// Laser that illuminates the part.
    pub laser: LaserTable,
    /// Camera that records the images.
    pub camera: CameraTable,
    /// Motion of the sensor or the part between frames.
    pub scan: ScanTable,
    /// Ambient light on the part. Default: none.
    pub ambient: Option<AmbientTable>,
    /// Systematic errors of the sensor. Default: none; averaged uncertainties are lower bounds.
    pub systematic: Option<SystematicTable>,
    /// Line detection in the images and processing of the resulting profiles.
    #[serde(default)]
    pub measure: MeasureTable,
    /// Tolerances of the part's deviations from the CAD.
    #[serde(default)]
    pub inspect: InspectTable,
    /// Objects that are not inspected.
    #[serde(default)]
    pub object: Vec<ObjectTable>,
    /// Features of the part, with tolerances.
    #[serde(default)]
    pub feature: Vec<FeatureTable>,
    /// Permitted error of the simulation.
    #[serde(default)]
    pub accuracy: AccuracyTable,
    /// Methods that replace the automatically chosen methods.
    #[serde(default)]
    pub model: ModelTable,
    /// Acceptance test of the sensor.
    #[serde(default)]
    pub accept: AcceptTable,
    /// Thresholds of the warnings.
    #[serde(default)]
    pub warnings: WarningsTable,
}

/// Method by which speckle patterns are interpolated.
#[derive(Debug, Clone, Copy, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SpeckleMethod {
    /// The complex field is interpolated, which preserves the contrast.
    #[default]
    Field,
    /// The intensity is interpolated (Bergmann et al. 2016), which reduces the contrast.
    Trilinear,
}

/// Inspected part: exactly one of `mesh`, `plane`, `sphere`, `cylinder` and `step_block`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PartTable {
    pub mesh: Option<MeshTable>,
    pub plane: Option<PlaneTable>,
    pub sphere: Option<SphereTable>,
    pub cylinder: Option<CylinderTable>,
    pub step_block: Option<StepBlockTable>,
    /// CSV file of poses at which the shape is repeated, which makes the part an assembly. Every
    /// line is one pose in the part's frame, in the format of scan.poses. The path is relative to
    /// the scene file. Default: one instance at the part's origin.
    pub instances: Option<String>,
    /// Lambertian (diffuse) reflectance, 0 to 1. Required unless `surface` is given.
    pub reflectance: Option<f64>,
    /// Metal, paint or a mixture; replaces `reflectance`.
    pub surface: Option<SurfaceTable>,
    /// Surfaces of triangle groups, by group name. In OBJ files this is a group (`g`), object (`o`)
    /// or material (`usemtl`). In PLY files it is a value of the face property `material_index`. In
    /// glTF files it is a material. All other triangles have `surface` or `reflectance`.
    #[serde(default)]
    pub surfaces: BTreeMap<String, SurfaceTable>,
    /// Degree of polarisation of the reflected light, 0 (paint) to 1 (metal). It lowers speckle
    /// contrast by √((1 + 𝒫²)/2). Default without `surface`: 1. Default with `surface`: the
    /// fraction of the reflected light that did not enter the part, for a surface perpendicular to
    /// the beam on the optical axis.
    pub polarisation_degree: Option<f64>,
    /// Position of the part's origin in the world. Default: the world origin.
    #[serde(default, deserialize_with = "array")]
    pub position_mm: [f64; 3],
    /// Rotation about the world's x, then y, then z axis. Default: none.
    #[serde(default, deserialize_with = "array")]
    pub rotation_deg: [f64; 3],
}

/// Mesh file: STL, OBJ, PLY, glTF or 3MF.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MeshTable {
    /// Path of the file, relative to the scene file.
    pub file: String,
    /// Unit of the file's coordinates. STL, OBJ and PLY files do not state a unit; 3MF files do.
    /// Default for glTF: metres.
    pub unit: Option<Unit>,
    /// Chordal deviation: largest distance between the true surface of the part and the triangles,
    /// as set in the program that wrote the file. It enters the uncertainty of deviations. Default:
    /// none.
    pub chordal_deviation_um: Option<f64>,
}

/// A rectangle in the part's xy plane that faces +z, centred on the part's origin.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlaneTable {
    #[serde(deserialize_with = "array")]
    pub size_mm: [f64; 2],
}

/// A sphere centred on the part's origin.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SphereTable {
    pub radius_mm: f64,
    /// Chordal deviation: largest distance between the sphere and its triangles.
    pub chordal_deviation_um: f64,
}

/// A cylinder whose axis is the part's y axis, centred on the part's origin.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CylinderTable {
    pub radius_mm: f64,
    pub length_mm: f64,
    /// Chordal deviation: largest distance between the cylinder and its triangles.
    pub chordal_deviation_um: f64,
}

/// A block, centred in x and y, with its bottom at z = 0. The top is lower by `step_mm` for x < 0.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StepBlockTable {
    #[serde(deserialize_with = "array")]
    pub size_mm: [f64; 3],
    pub step_mm: f64,
}

/// The laser, in the frame of the scan head.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LaserTable {
    pub wavelength_nm: f64,
    pub power_mw: f64,
    /// 1/e² radius of the irradiance at the waist.
    pub waist_radius_um: f64,
    /// Distance of the waist from the aperture along the beam. Negative: upstream of the aperture.
    pub waist_distance_mm: f64,
    /// Beam quality factor M². Default: 1, an ideal Gaussian beam.
    #[serde(default = "one")]
    pub m_squared: f64,
    /// Number N of wavelengths or sources with independent speckle patterns. They lower the
    /// contrast by √N. Default: 1.
    #[serde(default = "one_pattern")]
    pub incoherent_modes: u32,
    /// Coherence length λ²/Δλ. Light of paths whose lengths differ by less adds as fields; other
    /// light adds as intensities. It is metres for a single-mode laser and 1 mm or less for a
    /// multimode diode. Default: longer than all paths.
    pub coherence_length_mm: Option<f64>,
    /// Centre of the laser's aperture.
    #[serde(deserialize_with = "array")]
    pub position_mm: [f64; 3],
    /// Direction of the beam; any length.
    #[serde(deserialize_with = "array")]
    pub direction: [f64; 3],
    /// Fan of a line laser. Without this table the laser is a point laser.
    pub line: Option<LineTable>,
}

/// Fan of a line laser.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LineTable {
    /// Full angle of the fan. For a gaussian profile it is measured between the 1/e² points.
    pub fan_deg: f64,
    /// Power profile along the line: `uniform` (Powell lens), `gaussian` (cylindrical lens), or
    /// `{ file = "line.csv" }`, a measured profile. The path is relative to the file of this key. The header
    /// of the file is `angle_deg,power` or `angle_deg,power,width`: the angle from the beam in the
    /// direction of the line, from −fan_deg/2 to fan_deg/2, the relative power per angle, and the width
    /// of the line relative to the beam.
    pub profile: ProfileName,
    /// Direction of the line. Its component along the beam is ignored.
    #[serde(deserialize_with = "array")]
    pub direction: [f64; 3],
}

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ProfileName {
    Uniform,
    Gaussian,
    /// CSV file of a measured profile.
    File(String),
}

/// Telecentric lens: magnification and numerical aperture do not depend on the distance. Chief rays
/// are parallel to within 1 µrad at 100 mm from the optical axis. `distortion` is not supported.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TelecentricTable {
    /// Size of the image divided by the size of the object.
    pub magnification: f64,
    /// Numerical aperture on the object side, below 1: the sine of half the angle of the cone of
    /// light.
    pub numerical_aperture: f64,
}

/// The camera, in the frame of the scan head. Several cameras are a list, `[[camera]]`. A single
/// `[camera]` of the scene and a list in the sensor file have values for all cameras.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraTable {
    /// Number of the camera, 1 to 64. Cameras of other numbers have other speckle, noise and fixed
    /// patterns. Default: position in the list, 1 for a single camera.
    pub number: Option<u32>,
    /// Focal length. Required unless `telecentric` is given.
    pub focal_length_mm: Option<f64>,
    /// Focal length divided by the width of the aperture. Required unless `telecentric` is given.
    pub f_number: Option<f64>,
    /// Lens that is telecentric on the object side. It replaces `focal_length_mm` and `f_number`.
    pub telecentric: Option<TelecentricTable>,
    /// Shape of the lens aperture: `circle`, `square`, or `{ ellipse = r }` with r = height /
    /// width. The width of the aperture is the focal length divided by the f-number. Default:
    /// circle.
    #[serde(default)]
    pub aperture_shape: Aperture,
    /// Distance from `position_mm` to the plane in focus, along the optical axis. Required unless
    /// `focus` is given.
    pub focus_distance_mm: Option<f64>,
    /// Scheimpflug condition, `laser-plane`: the sensor is tilted to bring the complete laser plane
    /// into focus. Replaces `focus_distance_mm` and `tilt_deg`.
    pub focus: Option<Focus>,
    /// Number of columns and rows.
    #[serde(deserialize_with = "array")]
    pub resolution_px: [u32; 2],
    pub pixel_pitch_um: f64,
    /// Region of interest: first row that is read, counted from 0, and number of rows. Default: all
    /// rows.
    #[serde(default, deserialize_with = "optional_array")]
    pub roi_rows: Option<[u32; 2]>,
    /// Binning: number of pixels along each side of a square that is read as one pixel, 1 to 4.
    /// Default: 1.
    pub binning: Option<u32>,
    /// Binning mode: quantity that is added over the pixels of a square. Default: charge.
    pub binning_mode: Option<BinningMode>,
    /// Maximum frame rate for readout of all rows. With fewer rows it increases in proportion.
    /// Default: readout does not limit the frame rate.
    pub max_full_frame_rate_hz: Option<f64>,
    /// Intersection of the optical axis with the sensor: column and row in pixels from the outer
    /// corner of the first pixel, before binning. Rows outside `roi_rows` count. Default: centre of
    /// the sensor.
    #[serde(default, deserialize_with = "optional_array")]
    pub principal_point_px: Option<[f64; 2]>,
    /// Parameters in the conventions of OpenCV. Default: none.
    #[serde(rename = "opencv")]
    #[schemars(with = "Option<OpenCvTable>")]
    _opencv: Option<IgnoredAny>,
    /// Centre of the lens pupil. With `telecentric`, any point on the optical axis: reports show
    /// the camera there, and systematic errors rotate the camera about it.
    #[serde(deserialize_with = "array")]
    pub position_mm: [f64; 3],
    /// A point on the optical axis.
    #[serde(deserialize_with = "array")]
    pub look_at_mm: [f64; 3],
    /// Direction of increasing columns. Its component along the optical axis is ignored. The laser
    /// line must run along this direction.
    #[serde(deserialize_with = "array")]
    pub column_axis: [f64; 3],
    /// Scheimpflug tilt of the sensor about the column axis and the row axis of the image. Default:
    /// none, or the tilt required by `focus`.
    #[serde(default, deserialize_with = "optional_array")]
    pub tilt_deg: Option<[f64; 2]>,
    /// Lens distortion. Default: none.
    pub distortion: Option<DistortionTable>,
    /// Exposure time. Required unless `exposure` or `hdr_exposures_ms` is given.
    pub exposure_ms: Option<f64>,
    /// HDR: 2 to 4 different exposure times of every frame; replaces `exposure_ms`. Where a longer
    /// exposure is saturated, the pixel has the count of the next shorter one times the ratio of
    /// the exposure times.
    pub hdr_exposures_ms: Option<Vec<f64>>,
    /// Automatic exposure, `auto`; replaces `exposure_ms`. The peak of the line reaches
    /// `auto_exposure_target` of full scale where the part is bright.
    pub exposure: Option<AutoExposure>,
    /// Target of `exposure = "auto"` as a fraction of full scale, above 0 and at most 1. The line
    /// peak is at or below the target at 95 % of the lit points. Default: 0.5.
    pub auto_exposure_target: Option<f64>,
    /// Electrons per photon, 0 to 1.
    pub quantum_efficiency: f64,
    /// Counts per electron.
    pub gain_dn_per_e: f64,
    /// Bits per pixel, 8 to 16.
    pub bit_depth: u32,
    pub full_well_e: f64,
    /// Count without light. Default: 0.
    #[serde(default)]
    pub black_level_dn: f64,
    /// Width of the passband of the camera's optical filter, centred on the laser wavelength.
    /// Required with `ambient`.
    pub filter_nm: Option<f64>,
    /// Standard deviation of the read noise in electrons. With this key, counts have shot noise and
    /// read noise. Without it, counts are the rounded expected values.
    pub read_noise_e: Option<f64>,
    /// Dark current in electrons per second, with shot noise. Default: 0.
    pub dark_current_e_per_s: Option<f64>,
    /// Standard deviation of the photo response of the pixels, in percent of the mean (EMVA 1288
    /// PRNU). The pattern is equal in all frames. Default: 0.
    pub prnu_percent: Option<f64>,
    /// Standard deviation of the dark signal of the pixels, in electrons (EMVA 1288 DSNU). The
    /// pattern is equal in all frames. Default: 0.
    pub dsnu_e: Option<f64>,
}

/// Quantity that is added over binned pixels.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum BinningMode {
    /// Electrons are added before readout. Full well, read noise, gain and bit depth apply to the
    /// sum.
    #[default]
    Charge,
    /// Counts are added. Full well, read noise and bit depth apply to a single pixel.
    Digital,
}

/// Surface that is brought into focus.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Focus {
    LaserPlane,
}

/// Method that sets the exposure time.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum AutoExposure {
    Auto,
}

/// Brown–Conrady distortion. It applies to coordinates divided by the distance along the optical
/// axis, before the tilt of the sensor. Default of every coefficient: 0.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DistortionTable {
    /// Radial coefficient of r². Negative values give barrel distortion.
    pub k1: f64,
    /// Radial coefficient of r⁴.
    pub k2: f64,
    /// Radial coefficient of r⁶.
    pub k3: f64,
    /// Tangential (decentring) coefficient. At radius r it displaces the image across the rows by
    /// p1·r² or more.
    pub p1: f64,
    /// Tangential (decentring) coefficient. At radius r it displaces the image across the columns
    /// by p2·r² or more.
    pub p2: f64,
}

/// Path of the scan: linear (`step_mm` and `direction`), or one of `rotary` and `poses`. In frame k
/// the pose of the moving body is motion(k) · its pose at rest. At rest the head is at `start_mm`
/// without rotation, and the part is at its position and rotation.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ScanTable {
    /// Number of frames. Not allowed with `poses`, whose number of lines is the number of frames.
    pub frames: Option<u32>,
    /// Body that moves; the other body rests. Default: head.
    #[serde(default)]
    pub moving_body: MovingBody,
    /// Displacement between consecutive frames.
    pub step_mm: Option<f64>,
    /// Direction of motion in the world; any length.
    #[serde(default, deserialize_with = "optional_array")]
    pub direction: Option<[f64; 3]>,
    /// Position of the head at rest. Default: the world origin.
    #[serde(default, deserialize_with = "array")]
    pub start_mm: [f64; 3],
    pub rotary: Option<RotaryTable>,
    /// File of poses, one per frame, relative to the scene file: a header line, then one line of
    /// numbers per frame. The header names the columns in any order:
    /// - `x_mm,y_mm,z_mm` or `x_m,y_m,z_m`;
    /// - `rx_deg,ry_deg,rz_deg` (as part.rotation_deg), `a_deg,b_deg,c_deg` (about z, then the new
    ///   y, then the new x axis) or `qx,qy,qz,qw`;
    /// - optionally `time_s` or `time_ms`.
    ///
    /// Values are separated by commas, semicolons, tabs or spaces. A line that begins with # is a
    /// comment.
    pub poses: Option<String>,
    /// Names of the columns of `poses`, for a file without such a header. A column named `-` is
    /// ignored.
    pub poses_columns: Option<Vec<String>>,
    /// Pose of the head relative to the robot's flange, if `poses` are poses of the flange.
    /// Default: `poses` are poses of the head.
    pub hand_eye: Option<HandEyeTable>,
    /// File of the times of the frames, relative to the scene file: a header line `time_s` or
    /// `time_ms`, then one number per line. Poses are interpolated at these times, which must be
    /// within the times of `poses`. Default: one frame at each pose.
    pub frame_times: Option<String>,
    /// Frames per second. It determines the displacement during one exposure.
    pub frame_rate_hz: Option<f64>,
    /// Motion blur: number of poses during one exposure whose light is averaged, 1 to 64. They are
    /// uniformly distributed about the pose of the frame. Default: 1, no motion during the
    /// exposure.
    #[serde(default = "one_pose")]
    pub motion_samples: u32,
    /// Systematic errors of the stage. Default: none; averaged uncertainties are lower bounds.
    pub systematic: Option<StageErrorsTable>,
}

/// Pose of the head in the frame of the robot's flange.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HandEyeTable {
    #[serde(default, deserialize_with = "array")]
    pub position_mm: [f64; 3],
    /// Rotation about the flange's x, then y, then z axis.
    #[serde(default, deserialize_with = "array")]
    pub rotation_deg: [f64; 3],
}

/// Body that moves between frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum MovingBody {
    /// The head: laser and camera together.
    #[default]
    Head,
    /// The part; the sensor rests.
    Part,
}

/// Rotary table: right-handed rotation about an axis fixed in the world.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RotaryTable {
    /// A point on the axis.
    #[serde(deserialize_with = "array")]
    pub axis_point_mm: [f64; 3],
    /// Direction of the axis; any length.
    #[serde(deserialize_with = "array")]
    pub axis_direction: [f64; 3],
    /// Rotation between consecutive frames.
    pub step_deg: f64,
    /// Rotation in frame 0. Default: 0.
    #[serde(default)]
    pub start_deg: f64,
}

/// Measurement of points in the images.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MeasureTable {
    /// Estimator of the line's row with sub-pixel resolution. Default: centroid.
    pub peak_estimator: PeakFinder,
    /// Selection rule for columns with several lines. Default: strongest.
    pub peak_selection: PeakSelection,
    /// Detection threshold: minimum height of a line's brightest pixel above the background, in
    /// counts. Default: the height that noise reaches once in 1000 frames.
    pub threshold_dn: Option<f64>,
    /// Calibration file (calibration.json), as written by `lasertrace calibrate`. With several
    /// cameras, a list of one file per camera. Paths are relative to the scene file. Default: the
    /// true values of camera and laser plane.
    #[schemars(schema_with = "file_or_list")]
    pub calibration: Option<String>,
    /// Whether the cloud is aligned to the CAD by a best fit before deviations are computed.
    /// Default: false.
    pub best_fit_alignment: bool,
    /// Resolution of the line detector: rows are rounded to this fraction of a pixel, such as 16
    /// for 1/16 px. Default: not rounded.
    pub row_steps_per_px: Option<u32>,
    /// Resolution of the output: steps of x and z in the laser frame, µm, to which points are
    /// rounded. Default: not rounded.
    #[serde(deserialize_with = "optional_array")]
    pub point_steps_um: Option<[f64; 2]>,
    /// First filter. Removes points farther than this from the median of the eight surrounding
    /// columns. Default: no point is removed.
    pub outlier_threshold_um: Option<f64>,
    /// Second filter. Number of frames whose profiles are averaged column by column, 1 to 1000.
    /// Default: 1.
    pub average_frames: u32,
    /// Third filter. Gaps along the profile up to this length are filled by linear interpolation
    /// between the adjacent points. Default: no gap is filled.
    pub max_gap_mm: Option<f64>,
    /// Fourth filter. Moving average along the profile over this odd number of columns, 3 to 101.
    /// Default: none.
    pub moving_average_columns: Option<u32>,
    /// Fourth filter. Moving median along the profile, instead of the moving average, over this odd
    /// number of columns. Default: none.
    pub median_filter_columns: Option<u32>,
    /// Fourth filter. Gaussian filter along the profile, instead of the moving average, with this
    /// standard deviation in columns, 0.3 to 25. Default: none.
    pub gaussian_filter_columns: Option<f64>,
    /// Last filter. Spacing of the points along the profile, which then lie at integer multiples of
    /// it. Default: one point per column.
    pub resample_spacing_um: Option<f64>,
}

impl Default for MeasureTable {
    fn default() -> MeasureTable {
        MeasureTable {
            peak_estimator: PeakFinder::default(),
            peak_selection: PeakSelection::default(),
            threshold_dn: None,
            calibration: None,
            best_fit_alignment: false,
            row_steps_per_px: None,
            point_steps_um: None,
            outlier_threshold_um: None,
            average_frames: 1,
            max_gap_mm: None,
            moving_average_columns: None,
            median_filter_columns: None,
            gaussian_filter_columns: None,
            resample_spacing_um: None,
        }
    }
}

/// Tolerances of deviations. A point conforms or fails if its distance from the limits is at least
/// two standard uncertainties. Otherwise its verdict is unsure.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct InspectTable {
    /// Lower and upper limit of the deviation outside all regions. Default: none.
    #[serde(deserialize_with = "optional_array")]
    pub tolerance_mm: Option<[f64; 2]>,
    /// Regions by name. Where boxes overlap, the smallest box applies.
    pub regions: BTreeMap<String, RegionTable>,
    /// Nominal geometry (CAD) that the measured points are compared with. Deviations, coverage,
    /// regions and features refer to it. Light is simulated on `part`, the actual geometry.
    /// Default: `part` is also the nominal geometry.
    pub nominal: Option<NominalTable>,
}

/// Mesh file of the nominal geometry, and its pose in the part's frame.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NominalTable {
    /// Path of the file, relative to the scene file.
    pub file: String,
    /// Unit of the file's coordinates, as for `part.mesh.unit`.
    pub unit: Option<Unit>,
    /// Chordal deviation of the nominal triangles, as for `part.mesh.chordal_deviation_um`. It enters the
    /// uncertainty of deviations instead of the value for the part. Default: none.
    pub chordal_deviation_um: Option<f64>,
    /// Position of the nominal origin in the part's frame. Default: the part's origin.
    #[serde(default, deserialize_with = "array")]
    pub position_mm: [f64; 3],
    /// Rotation about the part's x, then y, then z axis. Default: none.
    #[serde(default, deserialize_with = "array")]
    pub rotation_deg: [f64; 3],
}

/// A region of the part.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegionTable {
    /// Lower and upper corner of an axis-aligned box in the part's frame.
    #[serde(deserialize_with = "array")]
    pub bounds_mm: [[f64; 3]; 2],
    /// Lower and upper limit of the deviation. Default: the limits in `inspect`.
    #[serde(default, deserialize_with = "optional_array")]
    pub tolerance_mm: Option<[f64; 2]>,
}

fn one_pattern() -> u32 {
    1
}

fn one_pose() -> u32 {
    1
}

/// A separate sensor file. It contains a data sheet, or laser and camera as in a scene, or both.
/// With both, values of laser and camera in the file override the values derived from the data
/// sheet.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "lasertrace sensor")]
pub struct SensorFile {
    /// Data sheet of the sensor.
    #[serde(rename = "data_sheet")]
    #[schemars(with = "Option<DataSheet>")]
    _data_sheet: Option<IgnoredAny>,
    /// Table `laser`, as in a scene.
    #[serde(rename = "laser")]
    #[schemars(with = "Option<LaserTable>")]
    _laser: Option<IgnoredAny>,
    /// Table `camera`, as in a scene.
    #[serde(rename = "camera")]
    #[schemars(with = "Option<CameraTable>")]
    _camera: Option<IgnoredAny>,
    /// Box that encloses the housing, as in a scene.
    #[serde(rename = "housing_bounds_mm")]
    #[schemars(with = "Option<[[f64; 3]; 2]>")]
    _housing: Option<IgnoredAny>,
    /// Measuring field, as in a scene.
    #[serde(rename = "field_of_view_mm")]
    #[schemars(with = "Option<Vec<[f64; 2]>>")]
    _field_of_view: Option<IgnoredAny>,
    /// Table `accept`, as in a scene.
    #[serde(rename = "accept")]
    #[schemars(with = "Option<AcceptTable>")]
    _accept: Option<IgnoredAny>,
    /// Table `systematic`, as in a scene.
    #[serde(rename = "systematic")]
    #[schemars(with = "Option<SystematicTable>")]
    _systematic: Option<IgnoredAny>,
    /// Table `measure`, as in a scene: filters and resolution of the sensor's output.
    #[serde(rename = "measure")]
    #[schemars(with = "Option<MeasureTable>")]
    _measure: Option<IgnoredAny>,
}

/// Returns the JSON Schema of the scene file, pretty-printed.
pub fn schema() -> String {
    pretty(schema_value())
}

/// Returns the JSON Schema of the sensor file, pretty-printed.
pub fn sensor_schema() -> String {
    pretty(divided(schemars::schema_for!(SensorFile).to_value()))
}

pub(super) fn schema_value() -> Value {
    let mut schema = divided(schemars::schema_for!(SceneFile).to_value());
    // The sensor file may contain the other required tables.
    schema["required"] = json!(["seed", "speckle", "part", "scan"]);
    schema
}

/// Removes `required` from the tables whose keys may be split between scene and sensor file.
fn divided(mut schema: Value) -> Value {
    for table in ["LaserTable", "CameraTable", "LineTable", "DataSheet"] {
        if let Some(table) = schema["$defs"][table].as_object_mut() {
            table.remove("required");
        }
    }
    if let Some(camera) = schema["properties"].get_mut("camera") {
        let one = json!({ "$ref": "#/$defs/CameraTable" });
        let description = camera["description"].clone();
        *camera = json!({ "anyOf": [one, { "type": "array", "items": one, "minItems": 1 }] });
        if description.is_string() {
            camera["description"] = description;
        }
    }
    schema
}

fn file_or_list(_: &mut SchemaGenerator) -> Schema {
    json_schema!({
        "anyOf": [
            { "type": ["string", "null"] },
            { "type": "array", "items": { "type": "string" }, "minItems": 1 }
        ]
    })
}

fn pretty(schema: Value) -> String {
    // `Schema` orders the keys as they are read, which `Value` does not.
    let schema = Schema::try_from(schema).expect("a schema is a table");
    serde_json::to_string_pretty(&schema).expect("a schema is JSON") + "\n"
}

/// Permitted deviation of results from the reference model. Without it, every effect of the scene
/// is simulated.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AccuracyTable {
    /// Largest height error, µm, that the simulation may add to 99 % of the single points. The
    /// error is the variation between points, including speckle. Effects that change heights by
    /// less are not simulated, and each remaining effect uses the cheapest sufficient method.
    pub max_height_error_um: Option<f64>,
}

/// Methods that override the automatic choice. Default of every key: chosen automatically.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ModelTable {
    /// Whether profiles are computed from laser rays and their projection into the camera, without
    /// images.
    pub geometry_only: Option<bool>,
    /// Whether speckle is modelled, if the scene has speckle.
    pub speckle: Option<bool>,
    /// Motion of the speckle pattern. `true`: it moves with every surface point, which includes its
    /// motion relative to a defocused or rotating surface. `false`: it moves with the centre of the
    /// view. `true` requires `speckle_method = "field"`.
    pub local_speckle_motion: Option<bool>,
    /// Whether sensor noise is modelled, if the scene has noise.
    pub noise: Option<bool>,
    /// Samples along each side of a pixel, 1 to 16.
    pub samples_per_side: Option<u32>,
    /// Sampling of the surface within a pixel:
    /// - `planar`: one ray per pixel on a planar surface, else one ray per sample.
    /// - `per-sample`: one ray per sample.
    /// - `plane-cut`: exact rows of every facet in the laser light. It requires a line laser, a lens
    ///   without distortion and diffuse surfaces.
    pub pixel_sampling: Option<Sampling>,
    /// Distance from the beam axis at which the beam is cut off, in beam radii, 1 to 4.
    pub beam_cutoff_radii: Option<f64>,
    /// Model of the lens's defocus blur.
    /// - `none`: no blur.
    /// - `incoherent`: the mean light is blurred and multiplied by speckle.
    /// - `coherent`: the field is blurred, which gives the correct speckle. It requires
    ///   `speckle_method = "field"`.
    pub defocus_model: Option<Blur>,
    /// Maximum number of reflections between laser and camera, 1 (direct light only) to 64.
    /// Default: 1 for diffuse (Lambertian) surfaces and where no reflected light hits the part
    /// again; otherwise chosen automatically.
    pub max_bounces: Option<u32>,
    /// Implementation of ray–mesh intersection.
    pub ray_backend: Option<Backend>,
}

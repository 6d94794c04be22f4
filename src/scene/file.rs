//! The scene file as written: TOML, millimetres unless the key says otherwise.
//! The doc comments here become the descriptions in the JSON Schema.

use super::accept_table::AcceptTable;
use super::data_sheet::DataSheet;
use super::unit::Unit;
use super::warnings_table::WarningsTable;
use crate::accel::Backend;
use crate::frame::{Blur, Sampling};
use crate::math::Aperture;
use crate::profile::{Choice, PeakFinder};
use schemars::JsonSchema;
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// A laser-triangulation scan of one part. World frame right-handed,
/// millimetres.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "lasertrace scene")]
pub struct SceneFile {
    /// Seed of everything random: sensor noise and speckle.
    pub seed: u64,
    /// Whether laser light shows speckle.
    pub speckle: bool,
    /// How speckle patterns are read. Default: field.
    #[serde(default)]
    pub speckle_method: SpeckleMethod,
    /// Also write each frame of a scan as frames/frame-KKKKKK.png.
    #[serde(default)]
    pub write_frames: bool,
    /// File of a sensor (TOML): `laser` and `camera`, or a `data_sheet`; path relative to the scene file.
    /// What the scene itself says of them is laid over it. Default: the scene has all.
    pub sensor: Option<String>,
    /// The sensor as its maker describes it: `laser` and `camera` follow from it.
    pub data_sheet: Option<DataSheet>,
    /// Lower and upper corner of a box that holds the sensor's housing, in the head's frame. `check` says where it
    /// touches the part. Default: none.
    pub housing_mm: Option<[[f64; 3]; 2]>,
    /// What is measured.
    pub part: PartTable,
    /// What lights it.
    pub laser: LaserTable,
    /// What takes the images.
    pub camera: CameraTable,
    /// How sensor or part moves from frame to frame.
    pub scan: ScanTable,
    /// How the line is found in an image, and points from it.
    #[serde(default)]
    pub measure: MeasureTable,
    /// Which deviations from the CAD the part may have.
    #[serde(default)]
    pub inspect: InspectTable,
    /// How exact the simulation is to be.
    #[serde(default)]
    pub accuracy: AccuracyTable,
    /// Methods to use instead of those the program would choose.
    #[serde(default)]
    pub plan: PlanTable,
    /// The acceptance test of the sensor.
    #[serde(default)]
    pub accept: AcceptTable,
    /// Limits of the warnings.
    #[serde(default)]
    pub warnings: WarningsTable,
}

/// How speckle patterns are read.
#[derive(Debug, Clone, Copy, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SpeckleMethod {
    /// The complex field, interpolated: no contrast is lost.
    #[default]
    Field,
    /// The intensity, interpolated (Bergmann et al. 2016): loses contrast.
    Trilinear,
}

/// What is inspected: exactly one of `mesh`, `plane`, `sphere`, `cylinder` and
/// `step_block`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PartTable {
    pub mesh: Option<MeshTable>,
    pub plane: Option<PlaneTable>,
    pub sphere: Option<SphereTable>,
    pub cylinder: Option<CylinderTable>,
    pub step_block: Option<StepBlockTable>,
    /// The part as an assembly of copies of its shape, each at a pose of its own in the
    /// part's frame: a CSV file of one line a copy, written as that of scan.poses; path
    /// relative to the scene file. Default: one copy, unmoved.
    pub copies: Option<String>,
    /// Share of light reflected, diffusely (Lambert), 0 to 1. Without `surface` it must be given.
    pub reflectance: Option<f64>,
    /// Metal, paint or a mix, in place of `reflectance`.
    pub surface: Option<SurfaceTable>,
    /// Surfaces of groups of the mesh's triangles, by the group's name: a group (`g`), object (`o`) or material (`usemtl`)
    /// of OBJ, a number of PLY's face property `material_index`, a material of glTF. All other triangles have
    /// `surface` or `reflectance`.
    #[serde(default)]
    pub surfaces: BTreeMap<String, SurfaceTable>,
    /// Degree of polarisation of the reflected light, 0 (paint) to 1 (metal);
    /// lowers speckle contrast by √((1 + 𝒫²)/2). Default: 1; with `surface` the share of light that
    /// is reflected without entering the part, where laser and camera look at a surface across the beam.
    pub polarisation_degree: Option<f64>,
    /// Where the part's origin lies in the world. Default: the world's origin.
    #[serde(default, deserialize_with = "array")]
    pub position_mm: [f64; 3],
    /// Rotation about the world's x, then y, then z axis. Default: none.
    #[serde(default, deserialize_with = "array")]
    pub rotation_deg: [f64; 3],
}

/// What the surface is: `metal`, `coat`, `matt` or `mirror`, or more than one of them, each on its `share` of it.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SurfaceTable {
    pub metal: Option<MetalTable>,
    pub coat: Option<CoatTable>,
    pub matt: Option<MattTable>,
    pub mirror: Option<MirrorTable>,
    pub lay: Option<LayTable>,
}

/// Rough bare metal: GGX microfacets (Walter et al. 2007). Its refractive index is that of `name`, or `n` and `k`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MetalTable {
    /// aluminium, copper, iron or titanium, at the laser's wavelength.
    pub name: Option<String>,
    /// Real part of the refractive index.
    pub n: Option<f64>,
    /// Imaginary part of the refractive index.
    pub k: Option<f64>,
    /// α, 0.01 (nearly a mirror) to 1: half of the facets are less steep than this slope.
    pub roughness: f64,
    /// α across the lay, where `roughness` is that along it. Default: the same.
    pub roughness_across: Option<f64>,
    /// Share of the surface. Default: 1.
    #[serde(default = "one")]
    pub share: f64,
}

/// A clear coat over a diffuse base: paint, varnish, coloured anodising.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CoatTable {
    /// Refractive index of the coat, 1.05 to 3.
    pub index: f64,
    /// α of the coat, as of metal.
    pub roughness: f64,
    /// α across the lay. Default: the same.
    pub roughness_across: Option<f64>,
    /// Share of light that the base reflects, as it would be without the coat, 0 to 1.
    pub reflectance: f64,
    /// Share of the surface. Default: 1.
    #[serde(default = "one")]
    pub share: f64,
}

/// Light scattered evenly (Lambert).
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MattTable {
    /// Share of light reflected, 0 to 1.
    pub reflectance: f64,
    /// Share of the surface. Default: 1.
    #[serde(default = "one")]
    pub share: f64,
}

/// A perfect mirror: seen by what it reflects of other surface.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MirrorTable {
    /// Share of light reflected, 0 to 1.
    pub reflectance: f64,
    /// Share of the surface. Default: 1.
    #[serde(default = "one")]
    pub share: f64,
}

/// Where the tool's grooves run, in the part's frame: along `direction` (milled, ground), or in circles about an
/// axis (turned).
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LayTable {
    /// Of milling, any length.
    #[serde(default, deserialize_with = "optional_array")]
    pub direction: Option<[f64; 3]>,
    /// A point on the axis of turning. Default: the part's origin.
    #[serde(default, deserialize_with = "array")]
    pub axis_point_mm: [f64; 3],
    /// Direction of the axis of turning, any length.
    #[serde(default, deserialize_with = "optional_array")]
    pub axis_direction: Option<[f64; 3]>,
}

/// A mesh file: STL, OBJ, PLY, glTF or 3MF.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MeshTable {
    /// Path, relative to the scene file.
    pub file: String,
    /// Unit of the file's coordinates. STL, OBJ and PLY do not say it; 3MF does, and glTF is in
    /// metres if nothing else is said here.
    pub unit: Option<Unit>,
    /// Largest distance between the part's true surface and the file's triangles, which its converter was
    /// told. It is in the uncertainty of deviations. Default: none.
    pub chord_um: Option<f64>,
}

/// A rectangle in the part's xy plane, facing +z, centred on its origin.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlaneTable {
    #[serde(deserialize_with = "array")]
    pub size_mm: [f64; 2],
}

/// A sphere about the part's origin.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SphereTable {
    pub radius_mm: f64,
    /// Largest distance between the sphere and its triangles.
    pub chord_um: f64,
}

/// A cylinder with its axis along the part's y axis, centred on its origin.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CylinderTable {
    pub radius_mm: f64,
    pub length_mm: f64,
    /// Largest distance between the cylinder and its triangles.
    pub chord_um: f64,
}

/// A block, centred in x and y with its bottom at z = 0, whose top is lower by
/// `step_mm` where x < 0.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StepBlockTable {
    #[serde(deserialize_with = "array")]
    pub size_mm: [f64; 3],
    pub step_mm: f64,
}

/// The laser, in the scan head's frame.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LaserTable {
    pub wavelength_nm: f64,
    pub power_mw: f64,
    /// 1/e² radius of irradiance at the waist.
    pub waist_radius_um: f64,
    /// Distance of the waist from the aperture; negative: before it.
    pub waist_distance_mm: f64,
    /// Beam quality factor M². Default: 1, a perfect Gaussian beam.
    #[serde(default = "one")]
    pub m_squared: f64,
    /// Wavelengths or sources whose speckle patterns are independent; N of them
    /// lower the contrast by √N. Default: 1.
    #[serde(default = "one_pattern")]
    pub independent_patterns: u32,
    /// λ²/Δλ: light of paths that differ by less adds as fields, of others as intensities. Metres for a laser
    /// of one mode, 1 mm or less for a diode of several. Default: longer than all paths.
    pub coherence_length_mm: Option<f64>,
    /// Centre of the laser's aperture.
    #[serde(deserialize_with = "array")]
    pub position_mm: [f64; 3],
    /// Where the beam goes; any length.
    #[serde(deserialize_with = "array")]
    pub direction: [f64; 3],
    /// A line laser; without this table it is a point laser.
    pub line: Option<LineTable>,
}

/// The fan of a line laser.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LineTable {
    /// Full angle of the fan; for a gaussian profile between the 1/e² points.
    pub fan_deg: f64,
    /// `uniform` (Powell lens) or `gaussian` (cylindrical lens).
    pub profile: ProfileName,
    /// Direction of the line; its part along the beam is ignored.
    #[serde(deserialize_with = "array")]
    pub direction: [f64; 3],
}

#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ProfileName {
    Uniform,
    Gaussian,
}

/// The camera, in the scan head's frame.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraTable {
    pub focal_length_mm: f64,
    pub f_number: f64,
    /// Shape of the lens aperture: `circle`, `square`, or `{ ellipse = r }` with r =
    /// height / width. Its width is the focal length over the f-number. Default:
    /// circle.
    #[serde(default)]
    pub aperture: Aperture,
    /// Distance along the axis from the lens to the plane in focus. Without `focus` it must be given.
    pub focus_distance_mm: Option<f64>,
    /// `laser-plane`, in place of `focus_distance_mm` and `tilt_deg`: the sensor is tilted so that the whole
    /// laser plane is in focus (Scheimpflug).
    pub focus: Option<Focus>,
    /// Columns, rows.
    #[serde(deserialize_with = "array")]
    pub resolution_px: [u32; 2],
    pub pixel_pitch_um: f64,
    /// The region of interest: the first row that is read, from 0, and how many. Default: all.
    #[serde(default, deserialize_with = "optional_array")]
    pub read_rows: Option<[u32; 2]>,
    /// Pixels along each side of a square that are read as one, 1 to 4. Default: 1.
    pub binning: Option<u32>,
    /// What of such pixels is added. Default: charge.
    pub binning_of: Option<BinningOf>,
    /// Frames a second that the sensor reads of all its rows; of fewer, more in proportion. Default: the readout
    /// limits nothing.
    pub full_frame_rate_hz: Option<f64>,
    /// Centre of the lens's pupil.
    #[serde(deserialize_with = "array")]
    pub position_mm: [f64; 3],
    /// A point on the optical axis.
    #[serde(deserialize_with = "array")]
    pub look_at_mm: [f64; 3],
    /// Direction of increasing columns; its part along the axis is ignored. The
    /// laser line must run along the columns.
    #[serde(deserialize_with = "array")]
    pub columns: [f64; 3],
    /// Scheimpflug tilt of the sensor about the image's column axis and row axis.
    /// Default: none, or what `focus` says.
    #[serde(default, deserialize_with = "optional_array")]
    pub tilt_deg: Option<[f64; 2]>,
    /// Distortion of the lens. Default: none.
    pub distortion: Option<DistortionTable>,
    /// Without `exposure` it must be given.
    pub exposure_ms: Option<f64>,
    /// Several exposures of one place, in place of `exposure_ms`: where a longer one is full a pixel has the count of the next shorter one, times
    /// their ratio.
    pub exposures_ms: Option<Vec<f64>>,
    /// `auto`, in place of `exposure_ms`: such that the line's middle reaches `exposure_share` of full scale
    /// where the part is bright.
    pub exposure: Option<AutoExposure>,
    /// Share of full scale that `exposure = "auto"` aims at, in 95 of 100 lit places or fewer. Default: 0.5.
    pub exposure_share: Option<f64>,
    /// Electrons per photon, 0 to 1.
    pub quantum_efficiency: f64,
    /// Counts per electron.
    pub gain_dn_per_e: f64,
    /// Bits per pixel, 8 to 16.
    pub bit_depth: u32,
    pub full_well_e: f64,
    /// Counts without light. Default: 0.
    #[serde(default)]
    pub black_level_dn: f64,
    /// Standard deviation of the read noise in electrons. With this key counts
    /// have shot and read noise; without it they are the rounded expectation.
    pub read_noise_e: Option<f64>,
    /// Electrons a second that come without light, with shot noise. Default: 0.
    pub dark_current_e_per_s: Option<f64>,
    /// Standard deviation of the pixels' responses to light, in percent of their mean (EMVA 1288 PRNU), the same in
    /// every frame. Default: 0.
    pub prnu_percent: Option<f64>,
    /// Standard deviation of the pixels' dark signals in electrons (EMVA 1288 DSNU), the same in every frame.
    /// Default: 0.
    pub dsnu_e: Option<f64>,
}

/// What is added of pixels that are read as one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum BinningOf {
    /// Their electrons, before they are read: full well, read noise, gain and bits are those of the sum.
    #[default]
    Charge,
    /// Their counts: full well, read noise and bits are those of one pixel.
    Counts,
}

/// What is in focus.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Focus {
    LaserPlane,
}

/// How the exposure is found.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum AutoExposure {
    Auto,
}

/// Brown–Conrady distortion, of coordinates divided by the distance along the
/// axis, before the tilt of the sensor. Coefficients left out are 0.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DistortionTable {
    /// Radial, with r². Negative: barrel.
    pub k1: f64,
    /// Radial, with r⁴.
    pub k2: f64,
    /// Radial, with r⁶.
    pub k3: f64,
    /// Tangential (decentring): moves images at radius r by p1·r² across the rows
    /// and more.
    pub p1: f64,
    /// The same across the columns.
    pub p2: f64,
}

/// The path of the scan: straight (`step_mm` and `direction`), or one of `rotary`
/// and `poses`. In frame k the moving body stands at motion(k) · its pose at rest:
/// the head at `start_mm`, unturned; the part at its position and rotation.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ScanTable {
    /// Number of frames; not with `poses`, whose lines say it.
    pub frames: Option<u32>,
    /// Which body moves; the other rests. Default: head.
    #[serde(default)]
    pub moves: Moves,
    /// Way from one frame to the next.
    pub step_mm: Option<f64>,
    /// Direction of motion in the world; any length.
    #[serde(default, deserialize_with = "optional_array")]
    pub direction: Option<[f64; 3]>,
    /// Position of the head at rest. Default: the world's origin.
    #[serde(default, deserialize_with = "array")]
    pub start_mm: [f64; 3],
    pub rotary: Option<RotaryTable>,
    /// File of one pose a frame, relative to the scene file: a header line, then one line of
    /// numbers a frame. The header names the columns in any order: `x_mm,y_mm,z_mm` or
    /// `x_m,y_m,z_m`; `rx_deg,ry_deg,rz_deg` (as part.rotation_deg), `a_deg,b_deg,c_deg` (about
    /// z, then the new y, then the new x axis) or `qx,qy,qz,qw`; and `time_s` or `time_ms` if there are times.
    /// Commas, semicolons, tabs or spaces separate values; a line that begins with # is a comment.
    pub poses: Option<String>,
    /// Names of the columns of `poses` where the file has no such header; `-` is a column that is
    /// not read.
    pub poses_columns: Option<Vec<String>>,
    /// Pose of the head on the robot's flange, if `poses` are poses of the flange. Default: they are
    /// poses of the head.
    pub hand_eye: Option<HandEyeTable>,
    /// File of the time of each frame, relative to the scene file: a header line `time_s` or
    /// `time_ms`, then a number per line. Poses are interpolated at these times, which must be within
    /// the times of `poses`. Default: a frame at each pose.
    pub frame_times: Option<String>,
    /// Frames a second: says how far the path goes in one exposure.
    pub frame_rate_hz: Option<f64>,
    /// Poses within one exposure, evenly spread about that of the frame, whose
    /// light is averaged, 1 to 64. Default: 1, at rest during the exposure.
    #[serde(default = "one_pose")]
    pub exposure_poses: u32,
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

/// What moves from frame to frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Moves {
    /// Laser and camera together.
    #[default]
    Head,
    /// The part; the sensor rests.
    Part,
}

/// A rotary table: turns about an axis of the world, right-handed.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RotaryTable {
    /// A point on the axis.
    #[serde(deserialize_with = "array")]
    pub axis_point_mm: [f64; 3],
    /// Any length.
    #[serde(deserialize_with = "array")]
    pub axis_direction: [f64; 3],
    /// Turn from one frame to the next.
    pub step_deg: f64,
    /// Turn in frame 0. Default: 0.
    #[serde(default)]
    pub start_deg: f64,
}

/// How points are measured in the images.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MeasureTable {
    /// How the line's row is found to a fraction of a pixel. Default: centroid.
    pub peak: PeakFinder,
    /// Which line of a column with several is taken. Default: strongest.
    pub choose: Choice,
    /// Detection threshold: counts above the background that the highest pixel of a line has at least.
    /// Default: the height that noise reaches once in 1000 frames.
    pub threshold_dn: Option<f64>,
    /// A calibration.json, as `lasertrace calibrate` writes it; path relative to the
    /// scene file. Default: the true values of camera and laser plane.
    pub calibration: Option<String>,
    /// Bring the cloud onto the CAD by a best fit before deviations are taken.
    /// Default: false.
    pub align: bool,
    /// Takes out points that lie further than this from the median of the eight columns around. First of what is done to
    /// profiles. Default: none is taken out.
    pub outlier_um: Option<f64>,
    /// Frames whose profiles are averaged, column by column, to make one, 1 to 1000. Second. Default: 1.
    pub average_frames: u32,
    /// Fills gaps along the profile up to this length by the line between the points on either side. Third. Default: none is filled.
    pub fill_gaps_mm: Option<f64>,
    /// The mean along the profile over so many columns, an odd number from 3 to 101. Fourth. Default: none.
    pub mean_columns: Option<u32>,
    /// The median along the profile, in place of the mean.
    pub median_columns: Option<u32>,
    /// Distance of the points along the profile, which then lie at whole multiples of it. Last. Default: one point a column.
    pub resample_um: Option<f64>,
}

impl Default for MeasureTable {
    fn default() -> MeasureTable {
        MeasureTable {
            peak: PeakFinder::default(),
            choose: Choice::default(),
            threshold_dn: None,
            calibration: None,
            align: false,
            outlier_um: None,
            average_frames: 1,
            fill_gaps_mm: None,
            mean_columns: None,
            median_columns: None,
            resample_um: None,
        }
    }
}

/// Tolerance bands of deviations. A point passes or fails if it does so by two of its standard uncertainties, else it
/// is unsure.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct InspectTable {
    /// Lower and upper limit of the deviation, of all that is in no region. Default: none.
    #[serde(deserialize_with = "optional_array")]
    pub band_mm: Option<[f64; 2]>,
    /// Regions by name; where boxes overlap the smallest counts.
    pub regions: BTreeMap<String, RegionTable>,
}

/// A region of the part.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegionTable {
    /// A box along the axes of the part's frame: its lower and its upper corner.
    #[serde(deserialize_with = "array")]
    pub box_mm: [[f64; 3]; 2],
    /// Lower and upper limit of the deviation. Default: those of `inspect`.
    #[serde(default, deserialize_with = "optional_array")]
    pub band_mm: Option<[f64; 2]>,
}

/// An array of exactly `N`: serde itself takes the first `N` of a longer one.
fn array<'de, D, T, const N: usize>(deserializer: D) -> Result<[T; N], D::Error>
where
    D: serde::Deserializer<'de>,
    T: Deserialize<'de>,
{
    let values = Vec::<T>::deserialize(deserializer)?;
    let length = values.len();
    let expected = format!("an array of length {N}");
    values
        .try_into()
        .map_err(|_| serde::de::Error::invalid_length(length, &expected.as_str()))
}

fn optional_array<'de, D, T, const N: usize>(deserializer: D) -> Result<Option<[T; N]>, D::Error>
where
    D: serde::Deserializer<'de>,
    T: Deserialize<'de>,
{
    array(deserializer).map(Some)
}

fn one() -> f64 {
    1.0
}

fn one_pattern() -> u32 {
    1
}

fn one_pose() -> u32 {
    1
}

/// A sensor in a file of its own: a data sheet, or laser and camera as a scene has them, or both, where what
/// the file says of laser and camera is not in the data sheet.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "lasertrace sensor")]
pub struct SensorFile {
    /// As its maker describes it.
    #[serde(rename = "data_sheet")]
    #[schemars(with = "Option<DataSheet>")]
    _data_sheet: Option<IgnoredAny>,
    /// Of `laser` in a scene.
    #[serde(rename = "laser")]
    #[schemars(with = "Option<LaserTable>")]
    _laser: Option<IgnoredAny>,
    /// Of `camera` in a scene.
    #[serde(rename = "camera")]
    #[schemars(with = "Option<CameraTable>")]
    _camera: Option<IgnoredAny>,
    /// As in a scene.
    #[serde(rename = "housing_mm")]
    #[schemars(with = "Option<[[f64; 3]; 2]>")]
    _housing: Option<IgnoredAny>,
    /// Of `accept` in a scene.
    #[serde(rename = "accept")]
    #[schemars(with = "Option<AcceptTable>")]
    _accept: Option<IgnoredAny>,
}

/// JSON Schema of the scene file, as pretty-printed text.
pub fn schema() -> String {
    pretty(schema_value())
}

/// The same of a sensor's file.
pub fn sensor_schema() -> String {
    pretty(divided(schemars::schema_for!(SensorFile).to_value()))
}

pub(super) fn schema_value() -> Value {
    let mut schema = divided(schemars::schema_for!(SceneFile).to_value());
    // Another file may have them.
    schema["required"] = json!(["seed", "speckle", "part", "scan"]);
    schema
}

/// Tables that may be divided between files need not be whole in any.
fn divided(mut schema: Value) -> Value {
    for table in ["LaserTable", "CameraTable", "LineTable", "DataSheet"] {
        if let Some(table) = schema["$defs"][table].as_object_mut() {
            table.remove("required");
        }
    }
    schema
}

fn pretty(schema: Value) -> String {
    // A `Schema` has its keys in the order in which they are read.
    let schema = schemars::Schema::try_from(schema).expect("a schema is a table");
    serde_json::to_string_pretty(&schema).expect("a schema is JSON") + "\n"
}

/// How far results may be from those of the full model. Without it nothing that the
/// scene asks for is left out.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AccuracyTable {
    /// Greatest error of height, µm, that the simulation may add in 99 of 100 single points from place to place, speckle in them:
    /// what moves heights by less is left out, and the cheapest methods that are good
    /// enough are taken.
    pub height_um: Option<f64>,
}

/// Methods to use whatever the plan would choose. Default: the plan chooses.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanTable {
    /// Profiles from laser rays and what the camera sees of them, without images.
    pub geometry_only: Option<bool>,
    /// Whether speckle is modelled if the scene has it.
    pub speckle: Option<bool>,
    /// Whether the pattern moves with each place of the surface, which slips out of focus
    /// and turns, or with the middle of the view; takes speckle by field.
    pub speckle_slips: Option<bool>,
    /// Whether the sensor's noise is modelled if the scene has it.
    pub noise: Option<bool>,
    /// Samples along each side of a pixel, 1 to 16.
    pub samples_per_side: Option<u32>,
    /// Where the samples of a pixel come from: `planes` (one ray where the surface is
    /// flat) or `rays` (one for each).
    pub sampling: Option<Sampling>,
    /// Beam radii at which light is taken to end, 1 to 4.
    pub cutoff_radii: Option<f64>,
    /// What is done of the lens's blur: `none`, `mean` (light is spread, speckle is multiplied into
    /// it) or `coherent` (the field is spread: speckle as the blur makes it; takes speckle by
    /// field).
    pub blur: Option<Blur>,
    /// Most reflections of light on its way from laser to camera, 1 (direct light alone) to 64. Default: 1 for matt
    /// surfaces and where no light meets the part again, else as many as matter.
    pub reflections: Option<u32>,
    /// What finds the triangles rays meet.
    pub accel: Option<Backend>,
}

//! Tables of the features of a scene file.

use super::arrays::{array, optional_array};
use crate::inspect::features::{Relation, Shape};
use schemars::JsonSchema;
use serde::Deserialize;
use std::collections::BTreeMap;

/// Feature of the part that is evaluated from the measured points.
///
/// An element or a profile has a CAD face, selected by `point_mm`, `bounds_mm` or `group`, or by
/// several of them. A relation names two other features in `between`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FeatureTable {
    /// Name in the results. Names are unique.
    pub name: String,
    /// Kind of the feature.
    pub kind: FeatureKindName,
    /// Point of the CAD surface, in the part's frame. The face grows from it over edges up to
    /// `crease_deg`.
    #[serde(default, deserialize_with = "optional_array")]
    pub point_mm: Option<[f64; 3]>,
    /// Angle between neighbouring triangles at which the face ends. Default: 1 for planes and
    /// lines, 30 for other kinds.
    pub crease_deg: Option<f64>,
    /// Lower and upper corner of a box in the part's frame that contains the triangles.
    #[serde(default, deserialize_with = "optional_array")]
    pub bounds_mm: Option<[[f64; 3]; 2]>,
    /// Group of the triangles, as in `part.surfaces`.
    pub group: Option<String>,
    /// Smallest distance of the points from the edges of the face and of shadows. Default: the sum
    /// of two beam radii (1/e²) and the column spacing, both on the surface.
    pub margin_mm: Option<f64>,
    /// Percentage of the points that is excluded as outliers: the points with the largest
    /// residuals. Default: 0.
    #[serde(default)]
    pub outlier_percent: f64,
    /// Whether the form (flatness, straightness, roundness, cylindricity) is evaluated by the
    /// minimum zone. Default: false, or true if `tolerance` contains `form_mm`.
    #[serde(default)]
    pub form: bool,
    /// Normal of the section plane of a line through `point_mm`.
    #[serde(default, deserialize_with = "optional_array")]
    pub section_normal: Option<[f64; 3]>,
    /// Width of the section of a line. Default: 1.
    pub section_width_mm: Option<f64>,
    /// Names of the two features of a relation: the reference first.
    #[serde(default, deserialize_with = "optional_array")]
    pub between: Option<[String; 2]>,
    /// Lower and upper limit of the deviation from the CAD, by quantity: for example `diameter_mm =
    /// [-0.05, 0.05]`. Default: none.
    #[serde(default)]
    pub tolerance: BTreeMap<String, Limits>,
}

/// Lower and upper limit.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
pub struct Limits(#[serde(deserialize_with = "array")] pub [f64; 2]);

/// Kind of a feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FeatureKindName {
    /// Plane: `offset_mm`, `tilt_deg`, `form_mm`.
    Plane,
    /// Line in a section of a plane: `offset_mm`, `tilt_deg`, `form_mm`.
    Line,
    /// Circle through the wall of a hole or a shaft: `diameter_mm`, `x_mm`, `y_mm`, `z_mm`,
    /// `displacement_mm`, `form_mm`.
    Circle,
    /// Cylinder: as circle, and `tilt_deg`.
    Cylinder,
    /// Sphere: as circle.
    Sphere,
    /// Cone: as cylinder, with the apex angle `angle_deg` instead of the diameter.
    Cone,
    /// Profile of a surface: `profile_mm`.
    Profile,
    /// Height of the second plane above the first: `height_mm`.
    StepHeight,
    /// Distance of two features: `distance_mm`.
    Distance,
    /// Angle between two features: `angle_deg`.
    Angle,
    /// Gap between two faces, and height of the second above the first: `gap_mm`, `flush_mm`.
    GapFlush,
}

impl FeatureKindName {
    /// Returns the shape of an element.
    pub fn shape(self) -> Option<Shape> {
        Some(match self {
            FeatureKindName::Plane => Shape::Plane,
            FeatureKindName::Line => Shape::Line,
            FeatureKindName::Circle => Shape::Circle,
            FeatureKindName::Cylinder => Shape::Cylinder,
            FeatureKindName::Sphere => Shape::Sphere,
            FeatureKindName::Cone => Shape::Cone,
            _ => return None,
        })
    }

    /// Returns the relation of two features.
    pub fn relation(self) -> Option<Relation> {
        Some(match self {
            FeatureKindName::StepHeight => Relation::StepHeight,
            FeatureKindName::Distance => Relation::Distance,
            FeatureKindName::Angle => Relation::Angle,
            FeatureKindName::GapFlush => Relation::GapFlush,
            _ => return None,
        })
    }
}

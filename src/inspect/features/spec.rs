//! Features as stated in the scene, their results, and the input of their evaluation.

use super::element::{Element, Shape};
use super::propagation::{FeaturePoint, SpeckleCorrelation, SystematicShift};
use super::quantity::Quantity;
use crate::accel::Accel;
use crate::inspect::cloud::CloudPoint;
use crate::math::{Aabb, DVec3};
use crate::mesh::Groups;
use crate::profile::Covariance;
use serde::Serialize;
use std::collections::BTreeMap;

/// Feature as stated in the scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FeatureSpec {
    /// Name.
    pub name: String,
    /// Element, profile or relation.
    pub kind: FeatureKind,
    /// Lower and upper limits of the deviation from the nominal value, by quantity, in the unit of
    /// the quantity.
    pub tolerance: BTreeMap<String, [f64; 2]>,
}

/// Element, profile of a surface, or relation of two other features.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub enum FeatureKind {
    /// Element fitted to the points of a face.
    Element {
        /// Shape.
        shape: Shape,
        /// Face and points.
        selection: Selection,
        /// Section of a line.
        section: Option<Section>,
        /// Whether the form is evaluated.
        form: bool,
    },
    /// Profile of a surface: the zone about the CAD face that contains the points.
    Profile {
        /// Face and points.
        selection: Selection,
    },
    /// Relation of two other features: the reference, and the other.
    Relation {
        /// Relation.
        relation: Relation,
        /// Indices of the two features.
        of: [usize; 2],
    },
}

/// Relation of two features.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Relation {
    /// Height of the centre of the second plane above the first plane.
    StepHeight,
    /// Distance of two features.
    Distance,
    /// Angle between two features.
    Angle,
    /// Gap between two faces along the first plane, and height of the second face there.
    GapFlush,
}

/// Selection of a CAD face and of the measured points on it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Selection {
    /// Point from which the smooth face grows.
    pub point: Option<DVec3>,
    /// Angle between neighbouring triangles at which the face ends, rad.
    pub crease: f64,
    /// Bounds of the triangles.
    pub bounds: Option<Aabb>,
    /// Group of the triangles.
    pub group: Option<String>,
    /// Smallest distance of points from the edges of the face, mm; `None`: [`PointErrors::edge_margin`].
    pub margin: Option<f64>,
    /// Fraction of the points with the largest residuals that is excluded.
    pub outliers: f64,
}

/// Section plane of a line.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Section {
    /// Point of the plane.
    pub point: DVec3,
    /// Normal of the plane.
    pub normal: DVec3,
    /// Width of the section, mm.
    pub width: f64,
}

/// Result of a feature.
#[derive(Debug, Clone, Serialize)]
pub struct FeatureResult {
    /// Name.
    pub name: String,
    /// Kind, as in the scene file.
    pub kind: &'static str,
    /// Number of points that the values use.
    pub points: usize,
    /// Number of points on the face that have a flag.
    pub flagged: usize,
    /// Number of points on the face that are too close to an edge of the face or of a shadow.
    pub near_edge: usize,
    /// Number of points excluded as outliers.
    pub outliers: usize,
    /// Reason why there are no values; `null` with values.
    pub problem: Option<String>,
    /// True if the uncertainties are lower bounds, because the scene has no systematic errors of
    /// sensor and stage.
    pub lower_bound: bool,
    /// Values; empty with a problem.
    pub quantities: Vec<Quantity>,
    /// Points and residuals for the picture.
    #[serde(skip)]
    pub picture: Vec<PlottedResidual>,
}

/// Point of a picture: coordinates on the element and residual, mm.
#[derive(Debug, Clone, Copy)]
pub struct PlottedResidual {
    /// Position in the plane, or along the arc and the axis.
    pub at: [f64; 2],
    /// Residual, or deviation from the CAD for a profile.
    pub residual: f64,
}

/// Errors of measured points.
pub trait PointErrors: Sync {
    /// Returns a point with the sources of its error.
    fn of_point(&self, point: &CloudPoint) -> Option<FeaturePoint>;
    /// Returns the correlation of speckle errors between points of a typical width.
    fn correlation(&self, points: &[CloudPoint]) -> SpeckleCorrelation;
    /// Returns the distance from an edge of the surface, mm, within which a point may contain light
    /// from beyond the edge.
    fn edge_margin(&self, point: &CloudPoint) -> f64;
    /// Returns whether the surface within `distance` (mm) of a point is visible from laser and camera.
    /// Otherwise the point may have the light of a part of the line.
    fn is_open(&self, _point: &CloudPoint, _distance: f64) -> bool {
        true
    }
    /// Returns the error of a point along the normal (mm) that the curvature of the element within the
    /// width of the laser line causes.
    fn curvature_error(&self, _point: &CloudPoint, _element: &Element) -> f64 {
        0.0
    }
    /// Returns the covariance of the calibration parameters.
    fn calibration_covariance(&self) -> &Covariance;
    /// Returns the displacements of a point by systematic errors of sensor and stage.
    fn systematic(&self, _: &CloudPoint) -> Vec<SystematicShift> {
        Vec::new()
    }
    /// Returns whether systematic errors are modelled. Without them, uncertainties are lower bounds.
    fn has_systematic(&self) -> bool {
        false
    }
}

/// Nominal geometry of the features.
pub struct NominalPart<'a> {
    /// Hierarchy of the nominal mesh.
    pub accel: &'a Accel,
    /// Groups of its triangles.
    pub groups: &'a Groups,
    /// Whether the scanned part has the same triangles.
    pub is_scanned: bool,
}

impl FeatureKind {
    /// Returns the name in the scene file.
    pub fn name(&self) -> &'static str {
        match self {
            FeatureKind::Element { shape, .. } => shape.name(),
            FeatureKind::Profile { .. } => "profile",
            FeatureKind::Relation { relation, .. } => match relation {
                Relation::StepHeight => "step-height",
                Relation::Distance => "distance",
                Relation::Angle => "angle",
                Relation::GapFlush => "gap-flush",
            },
        }
    }

    /// Returns the names of the quantities.
    pub fn quantities(&self) -> &'static [&'static str] {
        match self {
            FeatureKind::Element { shape, .. } => match shape {
                Shape::Plane | Shape::Line => &["offset_mm", "tilt_deg", "form_mm"],
                Shape::Circle | Shape::Sphere => &[
                    "diameter_mm",
                    "x_mm",
                    "y_mm",
                    "z_mm",
                    "displacement_mm",
                    "form_mm",
                ],
                Shape::Cylinder => &[
                    "diameter_mm",
                    "x_mm",
                    "y_mm",
                    "z_mm",
                    "displacement_mm",
                    "tilt_deg",
                    "form_mm",
                ],
                Shape::Cone => &[
                    "angle_deg",
                    "x_mm",
                    "y_mm",
                    "z_mm",
                    "displacement_mm",
                    "tilt_deg",
                    "form_mm",
                ],
            },
            FeatureKind::Profile { .. } => &["profile_mm"],
            FeatureKind::Relation { relation, .. } => match relation {
                Relation::StepHeight => &["height_mm"],
                Relation::Distance => &["distance_mm"],
                Relation::Angle => &["angle_deg"],
                Relation::GapFlush => &["gap_mm", "flush_mm"],
            },
        }
    }
}

/// Returns a result without values.
pub fn empty(feature: &FeatureSpec, problem: &str) -> FeatureResult {
    FeatureResult {
        name: feature.name.clone(),
        kind: feature.kind.name(),
        points: 0,
        flagged: 0,
        near_edge: 0,
        outliers: 0,
        problem: Some(problem.to_owned()),
        lower_bound: true,
        quantities: Vec::new(),
        picture: Vec::new(),
    }
}

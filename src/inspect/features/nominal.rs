//! Nominal elements from faces of the CAD.

use super::element::{Element, Shape, width};
use super::spec::{Section, Selection};
use crate::accel::{Accel, TriangleId};
use crate::math::{Aabb, DMat3, DVec3, Rigid};
use crate::mesh::face::{boundary, smooth_face, to_segment};
use crate::mesh::{Groups, Mesh};
use nalgebra::{Matrix3, SymmetricEigen};
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Largest distance of the CAD vertices from the nominal element, relative to the size of the face.
/// Files with six digits round by less.
const VERTEX_TOLERANCE: f64 = 1e-4;

/// Triangles of a feature in one instance of the nominal mesh.
pub struct NominalFace {
    /// Index of the instance.
    pub copy: u32,
    /// Triangles, in ascending order.
    pub triangles: Vec<u32>,
    /// Outer edges, part frame.
    boundary: Vec<[DVec3; 2]>,
    /// Bounds, part frame.
    pub bounds: Aabb,
}

impl NominalFace {
    /// Selects the triangles of a feature.
    ///
    /// # Errors
    /// Returns a sentence if no triangle is selected.
    pub fn select(
        accel: &Accel,
        groups: &Groups,
        selection: &Selection,
    ) -> Result<NominalFace, String> {
        let mesh = accel.mesh();
        let mut copy = 0;
        let mut chosen: BTreeSet<u32> = match selection.point {
            Some(point) => {
                let nearest = accel.nearest(point, None);
                let reach = REACH * accel.bounds().size().length();
                if nearest.distance > reach {
                    return Err(format!(
                        "point_mm is {:.4} mm from the CAD surface, expected at most {reach:.4} mm",
                        nearest.distance
                    ));
                }
                copy = nearest.face.copy;
                let face = smooth_face(mesh, nearest.face.triangle, selection.crease);
                face.into_iter().collect()
            }
            None => (0..mesh.triangles.len() as u32).collect(),
        };
        let pose = accel.poses()[copy as usize];
        if let Some(bounds) = selection.bounds {
            let inside = |p: DVec3| bounds.min.cmple(p).all() && p.cmple(bounds.max).all();
            chosen.retain(|&i| {
                let corners = mesh.triangle(i as usize);
                corners.iter().all(|&p| inside(pose.point(p)))
            });
        }
        if let Some(group) = &selection.group {
            let numbers = groups
                .numbers(mesh.triangles.len(), &[(group.as_str(), 1)].into())
                .expect("one name has one number");
            chosen.retain(|&i| numbers[i as usize] == 1);
        }
        if chosen.is_empty() {
            return Err(
                "no triangle of the CAD is selected; check point_mm, group and bounds_mm, which \
                 must contain whole triangles"
                    .to_owned(),
            );
        }
        Ok(NominalFace::of(accel, copy, chosen.into_iter().collect()))
    }

    /// Creates a face from its triangles, in ascending order.
    pub fn of(accel: &Accel, copy: u32, triangles: Vec<u32>) -> NominalFace {
        let pose = accel.poses()[copy as usize];
        let boundary = boundary(accel.mesh(), &triangles);
        let boundary = boundary.iter().map(|ends| ends.map(|p| pose.point(p)));
        let mut face = NominalFace {
            copy,
            boundary: boundary.collect(),
            triangles,
            bounds: Aabb::EMPTY,
        };
        face.bounds = Aabb::of(face.vertices(accel));
        face
    }

    /// True if the face contains a triangle.
    pub fn contains(&self, face: TriangleId) -> bool {
        face.copy == self.copy && self.triangles.binary_search(&face.triangle).is_ok()
    }

    /// Returns the distance of a point on the face from the outer edges, mm.
    pub fn edge_distance(&self, point: DVec3) -> f64 {
        let edges = self.boundary.iter();
        let distances = edges.map(|&ends| to_segment(point, ends).distance(point));
        distances.fold(f64::INFINITY, f64::min)
    }

    /// Returns the ends of the outer edges.
    pub fn edge_points(&self) -> impl Iterator<Item = DVec3> + '_ {
        self.boundary.iter().flatten().copied()
    }

    /// Returns the direction of the outer edge that is nearest to a point.
    pub fn nearest_edge(&self, point: DVec3) -> Option<DVec3> {
        let distance = |ends: &[DVec3; 2]| to_segment(point, *ends).distance(point);
        let edges = self.boundary.iter();
        let edge = edges.min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
        (edge[1] - edge[0]).try_normalize()
    }

    /// Returns the vertices of the face, part frame.
    pub fn vertices(&self, accel: &Accel) -> Vec<DVec3> {
        let (mesh, pose) = (accel.mesh(), accel.poses()[self.copy as usize]);
        let used: BTreeSet<u32> = self
            .triangles
            .iter()
            .flat_map(|&i| mesh.triangles[i as usize])
            .collect();
        used.into_iter()
            .map(|i| pose.point(mesh.positions[i as usize]))
            .collect()
    }

    /// Returns the nominal element of the face.
    ///
    /// # Errors
    /// Returns a sentence if the vertices are not on one element of the shape.
    pub fn element(
        &self,
        accel: &Accel,
        shape: Shape,
        section: Option<&Section>,
    ) -> Result<Element, String> {
        let name = shape.name();
        let facets = Facets::of(accel.mesh(), &accel.poses()[self.copy as usize], self);
        let vertices = self.vertices(accel);
        // The axis of a circle is the axis of the cylinder through its wall.
        let surface = match shape {
            Shape::Circle => Shape::Cylinder,
            Shape::Line => Shape::Plane,
            other => other,
        };
        let no = || format!("the selected CAD triangles do not determine a {name}");
        let start = facets.initial(surface, &vertices).ok_or_else(no)?;
        let mut element = start.fitted(&vertices, None).ok_or_else(no)?;
        element = element.anchored(&start);
        let size = self.bounds.size().length();
        let off = width(&element.distances(&vertices));
        if off > VERTEX_TOLERANCE * size {
            return Err(format!(
                "the {} selected CAD triangles are not one {}: their vertices deviate from it by \
                 {off:.4} mm, expected at most {:.4} mm. Select one face by point_mm, bounds_mm or \
                 group, or lower crease_deg",
                self.triangles.len(),
                surface.name(),
                VERTEX_TOLERANCE * size
            ));
        }
        element.shape = shape;
        if let (Shape::Line, Some(section)) = (shape, section) {
            let z = element.frame.rotation.z_axis;
            let y = section.normal - z * z.dot(section.normal);
            let y = y.try_normalize().ok_or(
                "section_normal is perpendicular to the face, expected a direction along it",
            )?;
            let origin = section.point;
            element.frame = Rigid {
                rotation: DMat3::from_cols(y.cross(z), y, z),
                translation: origin - z * z.dot(origin - element.frame.translation),
            };
        }
        Ok(element)
    }
}

/// Distance from the surface within which a point selects a face, relative to the size of the part.
const REACH: f64 = 1e-3;

/// Centres, unit normals and areas of triangles.
struct Facets(Vec<(DVec3, DVec3, f64)>);

impl Facets {
    fn of(mesh: &Mesh, pose: &Rigid, face: &NominalFace) -> Facets {
        let facets = face.triangles.par_iter().filter_map(|&i| {
            let [a, b, c] = mesh.triangle(i as usize).map(|p| pose.point(p));
            let doubled = (b - a).cross(c - a);
            let normal = doubled.try_normalize()?;
            Some(((a + b + c) / 3.0, normal, doubled.length() / 2.0))
        });
        Facets(facets.collect())
    }

    /// Returns an initial element from the normals of the triangles.
    fn initial(&self, shape: Shape, vertices: &[DVec3]) -> Option<Element> {
        let area: f64 = self.0.iter().map(|(_, _, area)| area).sum();
        let sum = |of: &dyn Fn(&(DVec3, DVec3, f64)) -> DVec3| -> DVec3 {
            self.0.iter().map(of).sum::<DVec3>() / area
        };
        let center = sum(&|&(p, _, area)| p * area);
        let normal = sum(&|&(_, n, area)| n * area);
        let element = |z: DVec3, origin: DVec3, radius: f64, half_angle: f64| {
            let x = z.any_orthonormal_vector();
            Some(Element {
                shape,
                frame: Rigid::from_z_and_x(origin, z, x)?,
                radius,
                half_angle,
            })
        };
        match shape {
            Shape::Plane | Shape::Line => element(normal.try_normalize()?, center, 0.0, 0.0),
            Shape::Sphere => {
                let origin = self.center(DVec3::ZERO)?;
                let mean = vertices.iter().map(|p| p.distance(origin)).sum::<f64>();
                element(DVec3::Z, origin, mean / vertices.len() as f64, 0.0)
            }
            Shape::Circle | Shape::Cylinder | Shape::Cone => {
                // Normals of a cone have a constant component along the axis.
                let mean = match shape {
                    Shape::Cone => normal,
                    _ => DVec3::ZERO,
                };
                let mut moments = Matrix3::zeros();
                for (_, n, area) in &self.0 {
                    let d = *n - mean;
                    let d = nalgebra::Vector3::new(d.x, d.y, d.z);
                    moments += d * d.transpose() * *area;
                }
                let eigen = SymmetricEigen::new(moments);
                let axis = eigen.eigenvectors.column(eigen.eigenvalues.imin());
                let mut axis = DVec3::new(axis[0], axis[1], axis[2]).try_normalize()?;
                // The sign is the direction closest to a positive coordinate axis.
                let largest = axis.to_array().into_iter();
                let largest = largest.max_by(|a, b| a.abs().total_cmp(&b.abs()))?;
                if largest < 0.0 {
                    axis = -axis;
                }
                let foot = self.center(axis)?;
                let along: Vec<f64> = vertices.iter().map(|&p| axis.dot(p - foot)).collect();
                let low = along.iter().copied().fold(f64::INFINITY, f64::min);
                let high = along.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let middle = (low + high) / 2.0;
                let origin = foot + axis * middle;
                let radii: Vec<f64> = vertices
                    .iter()
                    .map(|&p| (p - origin).reject_from(axis).length())
                    .collect();
                let mean = radii.iter().sum::<f64>() / radii.len() as f64;
                if shape != Shape::Cone {
                    return element(axis, origin, mean, 0.0);
                }
                let centre = along.iter().sum::<f64>() / along.len() as f64;
                let (mut cross, mut squares) = (0.0, 0.0);
                for (z, r) in along.iter().zip(&radii) {
                    cross += (z - centre) * (r - mean);
                    squares += (z - centre).powi(2);
                }
                let slope = cross / squares;
                let radius = mean + slope * (middle - centre);
                match slope < 0.0 {
                    true => element(-axis, origin, radius, (-slope).atan()),
                    false => element(axis, origin, radius, slope.atan()),
                }
            }
        }
    }

    /// Returns the point nearest to the normal lines of all triangles. The lines are projected along
    /// `axis` unless it is zero.
    fn center(&self, axis: DVec3) -> Option<DVec3> {
        let mut matrix = Matrix3::zeros();
        let mut right = nalgebra::Vector3::zeros();
        let vector = |v: DVec3| nalgebra::Vector3::new(v.x, v.y, v.z);
        let along = vector(axis);
        let mean = self.0.iter().map(|(p, ..)| *p).sum::<DVec3>() / self.0.len() as f64;
        for &(p, n, area) in &self.0 {
            let n = n - axis * axis.dot(n);
            let n = vector(n.try_normalize()?);
            let off = Matrix3::identity() - n * n.transpose() - along * along.transpose();
            matrix += off * area;
            right += off * vector(p - mean) * area;
        }
        // The position along the axis is undetermined; it stays at the mean.
        matrix += along * along.transpose() * matrix.trace();
        let found = matrix.lu().solve(&right)?;
        let found = mean + DVec3::new(found[0], found[1], found[2]);
        found.is_finite().then_some(found)
    }
}

//! Faces of the CAD that are planes, cylinders, spheres or cones.

use super::element::Shape;
use super::nominal::NominalFace;
use crate::accel::Accel;
use crate::math::DVec3;
use crate::mesh::face::EdgeTriangles;

/// Smallest area of a face relative to the area of the mesh.
const MIN_AREA_FRACTION: f64 = 0.005;
/// Maximum number of faces.
const MAX_FACES: usize = 24;

/// Face of the CAD with the shape of an element.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FoundFace {
    /// Shape of the element.
    pub shape: Shape,
    /// Point of the face from which it grows.
    pub point: DVec3,
    area: f64,
}

/// Returns the largest faces with the shape of an element, the largest first. Faces end at the
/// default crease angle of their kind.
pub(crate) fn faces(accel: &Accel) -> Vec<FoundFace> {
    let mesh = accel.mesh();
    let area = |i: u32| {
        let [a, b, c] = mesh.triangle(i as usize);
        (b - a).cross(c - a).length() / 2.0
    };
    let areas: Vec<f64> = (0..mesh.triangles.len() as u32).map(area).collect();
    let least = MIN_AREA_FRACTION * areas.iter().sum::<f64>();
    let mut seeds: Vec<u32> = (0..areas.len() as u32).collect();
    seeds.sort_by(|&a, &b| areas[b as usize].total_cmp(&areas[a as usize]));
    let edges = EdgeTriangles::of(mesh);
    let mut visited = vec![false; areas.len()];
    let mut found = Vec::new();
    let pose = accel.poses()[0];
    for seed in seeds {
        if visited[seed as usize] {
            continue;
        }
        visited[seed as usize] = true;
        let point = pose.point(mesh.triangle(seed as usize).iter().sum::<DVec3>() / 3.0);
        let grown = |shape: Shape| edges.smooth_face(seed, shape.crease_deg().to_radians());
        let (flat, smooth) = (grown(Shape::Plane), grown(Shape::Cylinder));
        // Facets of a round face are planes, too.
        let round = [Shape::Cylinder, Shape::Sphere, Shape::Cone];
        let round = round.into_iter().filter(|_| smooth.len() > flat.len());
        let fit = round.chain([Shape::Plane]).find_map(|shape| {
            let triangles = if shape == Shape::Plane {
                &flat
            } else {
                &smooth
            };
            let area: f64 = triangles.iter().map(|&i| areas[i as usize]).sum();
            let face = NominalFace::of(accel, 0, triangles.clone());
            let fits = area >= least && face.element(accel, shape, None).is_ok();
            fits.then_some((FoundFace { shape, point, area }, triangles))
        });
        // A face that is none of the shapes is not a seed again.
        let done = fit.map_or(&smooth, |(_, triangles)| triangles);
        done.iter().for_each(|&i| visited[i as usize] = true);
        found.extend(fit.map(|(face, _)| face));
    }
    found.sort_by(|a, b| b.area.total_cmp(&a.area));
    found.truncate(MAX_FACES);
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::shapes;
    use std::sync::Arc;

    /// A step block has eight planes, a cylinder a side and two ends, and a sphere one face.
    #[test]
    fn faces_of_shapes_are_found() {
        let block = shapes::step_block(DVec3::new(20.0, 10.0, 6.0), 2.0).unwrap();
        let cylinder = shapes::cylinder(5.0, 12.0, 0.01).unwrap();
        let sphere = shapes::sphere(5.0, 0.01).unwrap();
        for (mesh, expected) in [
            (block, vec![Shape::Plane; 8]),
            (cylinder, vec![Shape::Cylinder, Shape::Plane, Shape::Plane]),
            (sphere, vec![Shape::Sphere]),
        ] {
            let accel = Accel::build(&Arc::new(mesh), 1).unwrap();
            let found: Vec<Shape> = faces(&accel).iter().map(|face| face.shape).collect();
            assert_eq!(found, expected);
        }
    }
}

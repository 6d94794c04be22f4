//! Scale drawings of the sensor and the part: along the laser line (triangulation plane), and
//! perpendicular to it (laser fan).

use super::axes::round_step;
use super::picture::{ParallelView, part_picture};
use super::svg::Svg;
use crate::accel::Accel;
use crate::camera::Camera;
use crate::inspect::coverage::SensorPose;
use crate::laser::Laser;
use crate::math::{DVec2, DVec3};

/// Longer side of the drawing, px.
const LONGEST: f64 = 600.0;

/// Objects of the drawings, all in the part frame.
pub struct Setup<'a> {
    /// The part.
    pub accel: &'a Accel,
    /// Laser whose fan is plotted.
    pub laser: &'a Laser,
    /// Camera whose field of view is plotted.
    pub camera: &'a Camera,
    /// Pose of the sensor head.
    pub pose: SensorPose,
    /// Positions of the laser aperture along the scan.
    pub path: &'a [DVec3],
}

impl Setup<'_> {
    /// Returns the two drawings with their captions.
    pub fn drawings(&self) -> [(&'static str, String); 2] {
        let laser = &self.pose.part_from_laser.rotation;
        let camera_side = laser
            .y_axis
            .dot(self.eye() - self.pose.part_from_laser.translation);
        // The camera is on the right, and the beam points downwards.
        let right = laser.y_axis * if camera_side < 0.0 { -1.0 } else { 1.0 };
        [
            (
                "Along the laser line: beam, field of view, and where they meet.",
                self.drawing(right),
            ),
            (
                "Across the laser plane: the fan over the part.",
                self.drawing(laser.x_axis),
            ),
        ]
    }

    /// Returns the position of the camera, part frame.
    fn eye(&self) -> DVec3 {
        self.pose.part_from_camera.point(self.camera.position())
    }

    fn drawing(&self, right: DVec3) -> String {
        let down = self.pose.part_from_laser.rotation.z_axis;
        let view = ParallelView { right, down };
        let part = part_picture(self.accel, [], &|_| [0; 3], view, (500, 0.0));
        let flat = |p: DVec3| DVec2::new(p.dot(right), p.dot(down));
        let mut low = DVec2::new(part.left, part.top);
        let mut high = low + DVec2::new(part.width, part.height);
        let aperture = flat(self.pose.part_from_laser.translation);
        let eye = flat(self.eye());
        let path: Vec<DVec2> = self.path.iter().map(|&p| flat(p)).collect();
        for &p in path.iter().chain([&aperture, &eye]) {
            (low, high) = (low.min(p), high.max(p));
        }
        let px_per_mm = LONGEST / (high - low).max_element();
        let place = |p: DVec2| (px_per_mm * (p - low)).to_array();
        let [width, height] = place(high);
        // Margins around the drawing for labels to the right of the objects.
        let view = [-60.0, -60.0, width + 160.0, height + 120.0];
        let style = "class='setup' font-size='16'";
        let mut svg = Svg::part(view, style, "the sensor and the part");
        let [x, y] = place(DVec2::new(part.left, part.top));
        let size = [part.width, part.height].map(|mm| px_per_mm * mm);
        svg.image([x, y, size[0], size[1]], &part.png);
        self.rays(&mut svg, &|p| flat(p), &place, part.top + part.height);
        if path.len() > 1 {
            let style = "stroke='#555' stroke-width='1.2' stroke-dasharray='5'";
            svg.polyline(path.iter().map(|&p| place(p)), style);
        }
        for (at, color, name) in [(aperture, "#c00", "laser"), (eye, "#06c", "camera")] {
            let fill = format!("fill='{color}'");
            let [x, y] = place(at);
            svg.circle([x, y], 7.0, &fill);
            svg.text([x + 10.0, y - 8.0], &fill, name);
        }
        // Scale bar of a round length.
        let mm = round_step(view[2] / px_per_mm, 8.0);
        let [x, y] = [view[0] + 10.0, view[1] + view[3] - 10.0];
        let end = [x + px_per_mm * mm, y];
        svg.line([x, y], end, "stroke='#222' stroke-width='3'");
        svg.text([x, y - 8.0], "", &format!("{mm} mm"));
        svg.finish()
    }

    /// Draws the beam down to `depth`, the camera's field of view up to the laser plane, and the
    /// common part of the plane.
    fn rays(
        &self,
        svg: &mut Svg,
        flat: &dyn Fn(DVec3) -> DVec2,
        place: &dyn Fn(DVec2) -> [f64; 2],
        depth: f64,
    ) {
        let laser = &self.pose.part_from_laser;
        let (source, beam) = (flat(laser.translation), flat(laser.rotation.z_axis));
        let reach = (depth - source.y).max(0.0) / beam.y.max(1e-9);
        let half = self.laser.fan.as_ref().map_or(0.0, |fan| fan.angle / 2.0);
        let ends = [-half, half].map(|phi| {
            let direction = DVec3::new(phi.tan(), 0.0, 1.0);
            flat(laser.point(direction * reach))
        });
        svg.polygon(
            [source, ends[0], ends[1]].map(place),
            "fill='#f00' fill-opacity='.18' stroke='#c00' stroke-width='1.5'",
        );
        let camera = &self.pose.part_from_camera;
        let resolution = self.camera.sensor.resolution.as_dvec2();
        let normal = laser.rotation.y_axis;
        // The ray through a corner may miss the laser plane. The field of view then ends at four times
        // the distance between laser and camera.
        let far = 4.0 * (laser.translation - self.eye()).length();
        let sides = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| {
            let direction = self.camera.direction(resolution * DVec2::new(x, y));
            // Rays begin at the position of the camera, which is beyond the pupil of a telecentric lens.
            let start = camera.point(direction * (self.camera.position().z / direction.z));
            let direction = camera.vector(direction);
            let t = normal.dot(laser.translation - start) / normal.dot(direction);
            let t = if t > 0.0 { t.min(far) } else { far };
            [start, start + direction * t].map(|p| place(flat(p)))
        });
        for (i, &[start, corner]) in sides.iter().enumerate() {
            let [next_start, next] = sides[(i + 1) % 4];
            svg.polygon(
                [start, corner, next, next_start],
                "fill='#06c' fill-opacity='.05'",
            );
            svg.line(start, corner, "stroke='#06c' stroke-width='.8'");
        }
        let corners = sides.map(|[_, corner]| corner);
        svg.polygon(corners, "fill='none' stroke='#093' stroke-width='2.5'");
    }
}

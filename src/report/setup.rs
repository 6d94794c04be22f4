//! The sensor drawn with the part, to scale: along the laser line, where one sees
//! the triangulation, and across it, where one sees the fan.

use super::color::Rgb;
use super::page::data_url;
use super::picture::{ParallelView, part_picture};
use crate::accel::Accel;
use crate::camera::Camera;
use crate::inspect::coverage::HeadPose;
use crate::laser::Laser;
use crate::math::{DVec2, DVec3};
use std::fmt::Write;

/// What is drawn, all in the part's frame.
pub struct Setup<'a> {
    /// The part.
    pub accel: &'a Accel,
    /// Its fan is drawn.
    pub laser: &'a Laser,
    /// Its field of view is drawn.
    pub camera: &'a Camera,
    /// Where the head is drawn.
    pub pose: HeadPose,
    /// The laser's aperture along the scan.
    pub path: &'a [DVec3],
}

impl Setup<'_> {
    /// The two drawings, with what each shows.
    pub fn drawings(&self) -> [(&'static str, String); 2] {
        let laser = &self.pose.part_from_laser.rotation;
        let camera_side = laser
            .y_axis
            .dot(self.pose.part_from_camera.translation - self.pose.part_from_laser.translation);
        // The camera to the right, and beside the beam always downwards.
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

    fn drawing(&self, right: DVec3) -> String {
        let down = self.pose.part_from_laser.rotation.z_axis;
        let view = ParallelView { right, down };
        let part = part_picture(self.accel, std::iter::empty::<(DVec3, Rgb)>(), view, 500);
        let flat = |p: DVec3| DVec2::new(p.dot(right), p.dot(down));
        let mut low = DVec2::new(part.left, part.top);
        let mut high = low + DVec2::new(part.width, part.height);
        let aperture = flat(self.pose.part_from_laser.translation);
        let eye = flat(self.pose.part_from_camera.translation);
        let path: Vec<DVec2> = self.path.iter().map(|&p| flat(p)).collect();
        for &p in path.iter().chain([&aperture, &eye]) {
            (low, high) = (low.min(p), high.max(p));
        }
        let unit = (high - low).max_element() / 60.0;
        low -= 6.0 * unit;
        // Room for names to the right of what they name.
        high += DVec2::new(10.0, 6.0) * unit;
        let size = high - low;
        let mut svg = format!(
            "<svg class=\"setup\" viewBox=\"{:.3} {:.3} {:.3} {:.3}\" role=\"img\" \
             aria-label=\"the sensor and the part\" font-size=\"{:.3}\">\
             <image href=\"{}\" x=\"{:.3}\" y=\"{:.3}\" width=\"{:.3}\" height=\"{:.3}\"/>",
            low.x,
            low.y,
            size.x,
            size.y,
            1.6 * unit,
            data_url(&part.png),
            part.left,
            part.top,
            part.width,
            part.height
        );
        let depth = part.top + part.height;
        self.rays(&mut svg, &flat, depth, unit);
        let thin = 0.12 * unit;
        if path.len() > 1 {
            let _ = write!(
                svg,
                "<polyline points=\"{}\" fill=\"none\" stroke=\"#555\" stroke-width=\"{thin:.3}\" \
                 stroke-dasharray=\"{:.3}\"/>",
                points(&path),
                0.5 * unit
            );
        }
        for (at, color, name) in [(aperture, "#c00", "laser"), (eye, "#06c", "camera")] {
            let _ = write!(
                svg,
                "<circle cx=\"{:.3}\" cy=\"{:.3}\" r=\"{:.3}\" fill=\"{color}\"/>\
                 <text x=\"{:.3}\" y=\"{:.3}\" fill=\"{color}\">{name}</text>",
                at.x,
                at.y,
                0.7 * unit,
                at.x + unit,
                at.y - 0.8 * unit
            );
        }
        self.scale(&mut svg, low, high, unit);
        svg.push_str("</svg>");
        svg
    }

    /// The beam down to `depth`, the camera's field of view to the laser plane, and
    /// the part of that plane both share.
    fn rays(&self, svg: &mut String, flat: &dyn Fn(DVec3) -> DVec2, depth: f64, unit: f64) {
        let laser = &self.pose.part_from_laser;
        let (source, beam) = (flat(laser.translation), flat(laser.rotation.z_axis));
        let reach = (depth - source.y).max(0.0) / beam.y.max(1e-9);
        let half = self.laser.fan.map_or(0.0, |fan| fan.angle / 2.0);
        let ends = [-half, half].map(|phi| {
            let direction = DVec3::new(phi.tan(), 0.0, 1.0);
            flat(laser.point(direction * reach))
        });
        let _ = write!(
            svg,
            "<polygon points=\"{}\" fill=\"#f00\" fill-opacity=\".18\" stroke=\"#c00\" \
             stroke-width=\"{:.3}\"/>",
            points(&[source, ends[0], ends[1]]),
            0.15 * unit
        );
        let camera = &self.pose.part_from_camera;
        let resolution = self.camera.sensor.resolution.as_dvec2();
        let normal = laser.rotation.y_axis;
        let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| {
            let pixel = resolution * DVec2::new(x, y);
            let direction = camera.vector(self.camera.direction(pixel));
            let t = normal.dot(laser.translation - camera.translation) / normal.dot(direction);
            // Where a corner never meets the plane the field ends at four times
            // the standoff.
            let far = 4.0 * (laser.translation - camera.translation).length();
            let t = if t > 0.0 { t.min(far) } else { far };
            flat(camera.translation + direction * t)
        });
        let eye = flat(camera.translation);
        for (i, &corner) in corners.iter().enumerate() {
            let next = corners[(i + 1) % 4];
            let _ = write!(
                svg,
                "<polygon points=\"{}\" fill=\"#06c\" fill-opacity=\".05\"/>\
                 <line x1=\"{:.3}\" y1=\"{:.3}\" x2=\"{:.3}\" y2=\"{:.3}\" stroke=\"#06c\" \
                 stroke-width=\"{:.3}\"/>",
                points(&[eye, corner, next]),
                eye.x,
                eye.y,
                corner.x,
                corner.y,
                0.08 * unit
            );
        }
        let _ = write!(
            svg,
            "<polygon points=\"{}\" fill=\"none\" stroke=\"#093\" stroke-width=\"{:.3}\"/>",
            points(&corners),
            0.25 * unit
        );
    }

    /// A bar of a round length.
    fn scale(&self, svg: &mut String, low: DVec2, high: DVec2, unit: f64) {
        let about = (high.x - low.x) / 5.0;
        let power = 10f64.powf(about.log10().floor());
        let round = [5.0, 2.0, 1.0].map(|n| n * power);
        let length = *round.iter().find(|&&l| l <= about).unwrap_or(&power);
        let (x, y) = (low.x + unit, high.y - unit);
        let _ = write!(
            svg,
            "<path d=\"M{x:.3} {y:.3}h{length:.3}\" stroke=\"#222\" stroke-width=\"{:.3}\"/>\
             <text x=\"{x:.3}\" y=\"{:.3}\" fill=\"#222\">{length} mm</text>",
            0.3 * unit,
            y - 0.8 * unit
        );
    }
}

fn points(of: &[DVec2]) -> String {
    let mut text = String::new();
    for p in of {
        let _ = write!(text, "{:.3},{:.3} ", p.x, p.y);
    }
    text
}

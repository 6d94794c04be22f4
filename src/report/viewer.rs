//! The cloud and the covered surface to turn round by hand: points in a WebGL
//! canvas, drawn by a script of the report's own.

use super::color::Rgb;
use super::picture::base64;
use crate::math::{Aabb, DVec3};
use std::fmt::Write;

/// Points of one kind, each drawn in the colours of several modes.
pub struct Layer {
    pub positions: Vec<DVec3>,
    pub modes: Vec<Mode>,
}

pub struct Mode {
    pub name: &'static str,
    pub caption: String,
    /// One for each position.
    pub colors: Vec<Rgb>,
}

pub struct Viewer {
    pub bounds: Aabb,
    /// Heading and height of the first look, rad: along part x·sin + y·cos of the
    /// heading, from above by the height.
    pub look: [f64; 2],
    pub layers: Vec<Layer>,
}

impl Viewer {
    pub(crate) fn figure(&self, html: &mut String) {
        let size = self.bounds.size().max(DVec3::splat(f64::MIN_POSITIVE));
        let shown = size / size.max_element();
        let places: Vec<String> = self.layers.iter().map(|l| self.packed(l)).collect();
        let modes: Vec<serde_json::Value> = self
            .layers
            .iter()
            .enumerate()
            .flat_map(|(i, layer)| layer.modes.iter().map(move |mode| (i, mode)))
            .map(|(i, mode)| {
                serde_json::json!({
                    "name": mode.name,
                    "caption": mode.caption,
                    "colors": base64(mode.colors.as_flattened()),
                    "places": i,
                })
            })
            .collect();
        let data = serde_json::json!({
            "size": shown.to_array(),
            "yaw": self.look[0],
            "pitch": self.look[1],
            "places": places,
            "modes": modes,
        });
        // In a script element `<` could end it.
        let data = data.to_string().replace('<', "\\u003c");
        let _ = write!(
            html,
            "<div id=\"viewer\"><label>Colours: <select></select></label>\
             <label>Seen from: below <input type=\"range\" min=\"-1.6\" max=\"1.6\" step=\"any\"> above</label>\
             <canvas tabindex=\"0\" aria-label=\"the points in 3D\"></canvas><p></p>\
             <p>Mouse: drag to turn, wheel to zoom, Shift and drag to move. Touch: one finger sideways \
             turns, two fingers zoom and move. Keys: arrows turn, + and - zoom.</p></div>\
             <script type=\"application/json\" id=\"viewer-data\">{data}</script>\
             <script>{}</script>",
            include_str!("viewer.js")
        );
    }

    /// Positions as shares of the box, three little-endian u16 each.
    fn packed(&self, layer: &Layer) -> String {
        let size = self.bounds.size().max(DVec3::splat(f64::MIN_POSITIVE));
        let bytes: Vec<u8> = layer
            .positions
            .iter()
            .flat_map(|&p| {
                let share = (p - self.bounds.min) / size * 65535.0;
                // Casts saturate: what lies outside the box is drawn on it.
                share.to_array().map(|x| (x.round() as u16).to_le_bytes())
            })
            .flatten()
            .collect();
        base64(&bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_fill_the_box_and_text_cannot_end_the_script() {
        let viewer = Viewer {
            bounds: Aabb::new(DVec3::ZERO, DVec3::new(2.0, 1.0, 0.0)),
            look: [0.0, 0.5],
            layers: vec![Layer {
                positions: vec![DVec3::ZERO, DVec3::new(2.0, 0.5, 0.0)],
                modes: vec![Mode {
                    name: "m",
                    caption: "</script>".into(),
                    colors: vec![[1, 2, 3], [4, 5, 6]],
                }],
            }],
        };
        let packed = viewer.packed(&viewer.layers[0]);
        let expected = [0, 0, 0, 0, 0, 0, 255, 255, 0, 128, 0, 0];
        assert_eq!(packed, base64(&expected));
        let mut html = String::new();
        viewer.figure(&mut html);
        assert_eq!(html.matches("</script>").count(), 2);
    }
}

//! The cloud and the covered surface to turn round by hand: points in a WebGL
//! canvas, drawn by a script of the report's own.

use super::color::Rgb;
use super::picture::base64;
use crate::math::{Aabb, DVec3};
use serde_json::{Value, json};

/// Points of one kind, each drawn in the colours of several modes.
pub struct Layer {
    /// mm, in the part's frame.
    pub positions: Vec<DVec3>,
    /// What a reader can switch between.
    pub modes: Vec<Mode>,
}

/// A way to colour the points of a layer.
pub struct Mode {
    /// What the switch shows.
    pub name: &'static str,
    /// What the colours mean.
    pub caption: String,
    /// One for each position.
    pub colors: Vec<Rgb>,
}

/// What points are drawn over, in their frame.
pub struct Under {
    /// Corners of triangles, three each; or places of a surface of too many.
    pub corners: Vec<(DVec3, Rgb)>,
    /// Whether they are triangles.
    pub triangles: bool,
    /// Fills the view; points outside of it are not drawn.
    pub bounds: Aabb,
}

/// Points that a reader turns with the mouse.
pub struct Viewer {
    /// Drawn with every layer; `None`: each layer fills the view by itself.
    pub under: Option<Under>,
    /// Heading and height of the first look, rad: along part x·sin + y·cos of the
    /// heading, from above by the height.
    pub look: [f64; 2],
    /// Drawn over each other in this order.
    pub layers: Vec<Layer>,
}

impl Viewer {
    /// What its script reads: JSON that cannot end a script element.
    pub(super) fn data(&self) -> String {
        let bounds = self.under.as_ref().map(|under| under.bounds);
        let mut data = layers(&self.layers, bounds);
        data["yaw"] = self.look[0].into();
        data["pitch"] = self.look[1].into();
        data["under"] = self.under.as_ref().map(Under::packed).into();
        data.to_string().replace('<', "\\u003c")
    }
}

/// Layers as the script reads them: places as shares of `bounds`, or of the box round each layer.
pub(crate) fn layers(layers: &[Layer], bounds: Option<Aabb>) -> Value {
    let places: Vec<Value> = layers.iter().map(|layer| layer.packed(bounds)).collect();
    let modes = layers
        .iter()
        .enumerate()
        .flat_map(|(i, layer)| layer.modes.iter().map(move |mode| (i, mode)));
    let modes: Vec<Value> = modes
        .map(|(i, mode)| {
            json!({
                "name": mode.name,
                "caption": mode.caption,
                "colors": base64(mode.colors.as_flattened()),
                "places": i,
            })
        })
        .collect();
    json!({ "places": places, "modes": modes })
}

impl Under {
    fn packed(&self) -> Value {
        let positions: Vec<DVec3> = self.corners.iter().map(|(p, _)| *p).collect();
        let mut packed = packed(&positions, self.bounds);
        let colors: Vec<Rgb> = self.corners.iter().map(|(_, color)| *color).collect();
        packed["colors"] = base64(colors.as_flattened()).into();
        packed["triangles"] = self.triangles.into();
        packed
    }
}

impl Layer {
    /// What is looked at fills the view, however small a piece of the part it is, if nobody says otherwise.
    fn packed(&self, bounds: Option<Aabb>) -> Value {
        let own = || Aabb::of(self.positions.iter().copied());
        packed(&self.positions, bounds.unwrap_or_else(own))
    }
}

/// Positions as shares of a box, three little-endian u16 each, and the sides of the box as shares of the
/// longest.
fn packed(positions: &[DVec3], bounds: Aabb) -> Value {
    let size = bounds.size().max(DVec3::splat(f64::MIN_POSITIVE));
    let share = |&p: &DVec3| ((p - bounds.min) / size * 65535.0).to_array();
    let bytes: Vec<u8> = (positions.iter().flat_map(share))
        .flat_map(|x| (x.round() as u16).to_le_bytes())
        .collect();
    json!({
        "at": base64(&bytes),
        "size": (size / size.max_element()).to_array(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_fill_the_box_and_text_cannot_end_the_script() {
        let viewer = Viewer {
            look: [0.0, 0.5],
            under: None,
            layers: vec![Layer {
                positions: vec![DVec3::ZERO, DVec3::new(2.0, 1.0, 0.0), DVec3::Y * 0.5],
                modes: vec![Mode {
                    name: "m",
                    caption: "</script>".into(),
                    colors: vec![[1, 2, 3]; 3],
                }],
            }],
        };
        let packed = viewer.layers[0].packed(None);
        let (full, half) = (u16::MAX, 1 << 15);
        let expected = [[0; 3], [full, full, 0], [0, half, 0]];
        let expected = expected.as_flattened().iter();
        let expected: Vec<u8> = expected.flat_map(|x: &u16| x.to_le_bytes()).collect();
        assert_eq!(packed["at"], base64(&expected));
        let size: Vec<f64> = serde_json::from_value(packed["size"].clone()).unwrap();
        assert_eq!(size[..2], [1.0, 0.5]);
        assert!((0.0..1e-300).contains(&size[2]));
        assert!(!viewer.data().contains('<'));
    }
}

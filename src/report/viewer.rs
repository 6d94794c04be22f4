//! Interactive 3D view of the point cloud and the covered surface. A script in the report renders
//! points in a WebGL canvas.

use super::color::Rgb;
use super::picture::base64;
use crate::accel::Accel;
use crate::inspect::coverage::sample_surface;
use crate::math::{Aabb, DVec3, Rigid};
use serde_json::{Value, json};

/// Points of one kind with several colour modes.
pub struct ViewerLayer {
    /// Positions in the part frame, mm.
    pub positions: Vec<DVec3>,
    /// Colour modes that the user can select.
    pub modes: Vec<Mode>,
    /// Values shown when a point is picked.
    pub values: Vec<PointQuantity>,
}

/// A quantity with a value for each point of a layer.
pub struct PointQuantity {
    /// Label before the value.
    pub name: &'static str,
    /// Unit after the value; empty for a dimensionless number.
    pub unit: &'static str,
    /// One value for each position.
    pub values: Vec<f32>,
}

/// Colour scale of a mode.
pub struct Bar {
    /// Value of the first colour.
    pub low: f64,
    /// Value of the last colour.
    pub high: f64,
    /// Unit of both values.
    pub unit: &'static str,
    /// Colours at equal steps from `low` to `high`.
    pub colors: Vec<Rgb>,
}

impl Bar {
    /// Samples `color` between `low` and `high`.
    pub fn new(low: f64, high: f64, unit: &'static str, color: impl Fn(f64) -> Rgb) -> Bar {
        const STEPS: u8 = 16;
        let at = |i: u8| low + (high - low) * f64::from(i) / f64::from(STEPS);
        Bar {
            low,
            high,
            unit,
            colors: (0..=STEPS).map(|i| color(at(i))).collect(),
        }
    }
}

/// Colour mode of the points of a layer.
pub struct Mode {
    /// Name in the selection.
    pub name: &'static str,
    /// Meaning of the colours.
    pub caption: String,
    /// Colour scale; `None` if the colours do not represent numbers.
    pub bar: Option<Bar>,
    /// One colour for each position.
    pub colors: Vec<Rgb>,
}

/// Background geometry below the points, in the frame of the points.
pub struct Under {
    /// Corners of triangles, three each; or points on the surface if there are too many triangles.
    pub corners: Vec<(DVec3, Rgb)>,
    /// True if the corners form triangles.
    pub triangles: bool,
    /// Bounds that fill the view; points outside are not drawn.
    pub bounds: Aabb,
}

/// Interactive 3D view.
pub struct Viewer {
    /// Geometry drawn with every layer; if `None`, each layer fills the view separately.
    pub under: Option<Under>,
    /// Heading and elevation of the initial view, rad. The heading is along x·sin + y·cos of the
    /// part frame; the elevation is from above.
    pub look: [f64; 2],
    /// Layers in drawing order.
    pub layers: Vec<ViewerLayer>,
}

impl Viewer {
    /// Returns the data for the script, as JSON that cannot end a script element.
    pub(super) fn data(&self) -> String {
        let bounds = self.under.as_ref().map(|under| under.bounds);
        let mut data = layers(&self.layers, bounds);
        data["yaw"] = self.look[0].into();
        data["pitch"] = self.look[1].into();
        data["under"] = self.under.as_ref().map(Under::packed).into();
        data.to_string().replace('<', "\\u003c")
    }
}

/// Returns layers in the format of the script, with positions relative to `bounds` or to the
/// bounding box of each layer.
pub(crate) fn layers(layers: &[ViewerLayer], bounds: Option<Aabb>) -> Value {
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
                "bar": mode.bar.as_ref().map(|bar| {
                    json!({ "low": bar.low, "high": bar.high, "unit": bar.unit, "colors": bar.colors })
                }),
                "colors": base64(mode.colors.as_flattened()),
                "places": i,
            })
        })
        .collect();
    json!({ "places": places, "modes": modes })
}

impl Under {
    /// Returns the shaded triangles of the part. A part with more than `most` triangles is
    /// represented by `most` points on its surface.
    pub fn part(accel: &Accel, most: usize, bounds: Aabb) -> Under {
        let shade = |normal: DVec3| -> Rgb {
            // Light from the upper left of the viewer, on both sides of a surface.
            let light = DVec3::new(-0.4, -0.5, 0.75).normalize();
            [(110.0 + 110.0 * normal.dot(light).abs()) as u8; 3]
        };
        let mesh = accel.mesh();
        let triangles = mesh.triangles.len() * accel.poses().len() <= most;
        let corners = match triangles {
            true => {
                let of_copy = |pose: &Rigid| {
                    let pose = *pose;
                    (0..mesh.triangles.len()).flat_map(move |i| {
                        let corners = mesh.triangle(i).map(|p| pose.point(p));
                        let [a, b, c] = corners;
                        let color = shade((b - a).cross(c - a).normalize_or_zero());
                        corners.map(|p| (p, color))
                    })
                };
                accel.poses().iter().flat_map(of_copy).collect()
            }
            false => {
                let places = sample_surface(accel, most).map_or(Vec::new(), |places| places.points);
                let shaded = places.into_iter().map(|(p, normal)| (p, shade(normal)));
                shaded.collect()
            }
        };
        Under {
            corners,
            triangles,
            bounds,
        }
    }

    fn packed(&self) -> Value {
        let positions: Vec<DVec3> = self.corners.iter().map(|(p, _)| *p).collect();
        let mut packed = packed(&positions, self.bounds);
        let colors: Vec<Rgb> = self.corners.iter().map(|(_, color)| *color).collect();
        packed["colors"] = base64(colors.as_flattened()).into();
        packed["triangles"] = self.triangles.into();
        packed
    }
}

impl ViewerLayer {
    /// A layer fills the view if `bounds` is `None`, however small it is.
    fn packed(&self, bounds: Option<Aabb>) -> Value {
        let own = || Aabb::of(self.positions.iter().copied());
        let mut packed = packed(&self.positions, bounds.unwrap_or_else(own));
        let values = self.values.iter().map(|quantity| {
            let numbers: Vec<u8> = (quantity.values.iter())
                .flat_map(|x| x.to_le_bytes())
                .collect();
            json!({ "name": quantity.name, "unit": quantity.unit, "numbers": base64(&numbers) })
        });
        packed["values"] = values.collect();
        packed
    }
}

/// Encodes positions relative to a box as three little-endian u16 each, and the box sides relative
/// to the longest side.
fn packed(positions: &[DVec3], bounds: Aabb) -> Value {
    let size = bounds.size().max(DVec3::splat(f64::MIN_POSITIVE));
    let share = |&p: &DVec3| ((p - bounds.min) / size * 65535.0).to_array();
    let bytes: Vec<u8> = (positions.iter().flat_map(share))
        .flat_map(|x| (x.round() as u16).to_le_bytes())
        .collect();
    json!({
        "at": base64(&bytes),
        "size": (size / size.max_element()).to_array(),
        "from": bounds.min.to_array(),
        "to": bounds.max.to_array(),
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
            layers: vec![ViewerLayer {
                positions: vec![DVec3::ZERO, DVec3::new(2.0, 1.0, 0.0), DVec3::Y * 0.5],
                values: Vec::new(),
                modes: vec![Mode {
                    name: "m",
                    caption: "</script>".into(),
                    bar: None,
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

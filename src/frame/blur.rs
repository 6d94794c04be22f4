//! What the lens spreads of the light.

use super::light::Light;

/// The light behind the lens. A pinhole spreads nothing, so it is the same light, and costs
/// nothing; a lens takes it on an even [`Grid`](super::Grid), with the depth of each sample.
pub fn blur(light: Light) -> Light {
    light
}

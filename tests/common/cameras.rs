//! A camera for tests that need one without a scene.

use glam::UVec2;
use lasertrace::camera::{Camera, Lens, Sensor};
use lasertrace::math::Aperture;
use lasertrace::math::DVec2;

/// 800 × 600 pixels of 5.5 µm behind a lens of 25 mm, f/8, that looks at 240 mm; no
/// tilt, no noise.
pub fn camera() -> Camera {
    Camera {
        lens: Lens {
            focal_length: 25.0,
            f_number: 8.0,
            focus_distance: 240.0,
            aperture: Aperture::Circle,
            telecentric: false,
            distortion: None,
        },
        sensor: Sensor {
            resolution: UVec2::new(800, 600),
            off_middle: lasertrace::math::DVec2::ZERO,
            readout_ms: 0.0,
            pixel_pitch: 0.0055,
            exposure_ms: 1.0,
            shorter: Vec::new(),
            quantum_efficiency: 0.5,
            gain_dn_per_e: 0.1,
            bit_depth: 12,
            full_well_e: 20_000.0,
            black_level_dn: 0.0,
            noise: None,
        },
        tilt: DVec2::ZERO,
    }
}

//! Ladder of methods for a height tolerance, in a fixed order from cheap to full.

use super::accuracy::geometry_only;
use super::config::ModelConfig;
use crate::frame::{Blur, Sampling};

/// Number of samples along each side of a pixel.
#[derive(Debug, Clone, Copy)]
enum SampleCount {
    /// Half the number of the rules, rounded up.
    HalfOfRules,
    /// Number of the rules.
    Rules,
    /// Half the number of the reference model.
    Full,
}

/// Methods of one rung.
#[derive(Debug)]
pub struct Rung {
    /// Name in outputs and in the key of a run.
    pub name: &'static str,
    /// True for profiles without images. The other methods then have no effect.
    geometry_only: bool,
    /// True if speckle, sensor noise and lens blur are simulated as in the rules.
    randomness: bool,
    samples: SampleCount,
    sampling: Sampling,
    /// Maximum beam cut-off, beam radii.
    beam_cutoff_radii: f64,
}

/// Rungs from cheap to full. Each rung is at least as fine as the rung before it in every method.
pub const LADDER: [Rung; 7] = [
    Rung {
        name: "geometry",
        geometry_only: true,
        randomness: false,
        samples: SampleCount::HalfOfRules,
        sampling: Sampling::Planes,
        beam_cutoff_radii: 1.5,
    },
    Rung {
        name: "mean light",
        geometry_only: false,
        randomness: false,
        samples: SampleCount::HalfOfRules,
        sampling: Sampling::Planes,
        beam_cutoff_radii: 1.5,
    },
    Rung {
        name: "coarse",
        geometry_only: false,
        randomness: true,
        samples: SampleCount::HalfOfRules,
        sampling: Sampling::Planes,
        beam_cutoff_radii: 1.5,
    },
    Rung {
        name: "rules",
        geometry_only: false,
        randomness: true,
        samples: SampleCount::Rules,
        sampling: Sampling::Planes,
        beam_cutoff_radii: f64::INFINITY,
    },
    Rung {
        name: "fine",
        geometry_only: false,
        randomness: true,
        samples: SampleCount::Full,
        sampling: Sampling::Planes,
        beam_cutoff_radii: f64::INFINITY,
    },
    Rung {
        name: "cut",
        geometry_only: false,
        randomness: true,
        samples: SampleCount::Full,
        sampling: Sampling::PlaneCut,
        beam_cutoff_radii: f64::INFINITY,
    },
    Rung {
        name: "full",
        geometry_only: false,
        randomness: true,
        samples: SampleCount::Full,
        sampling: Sampling::Rays,
        beam_cutoff_radii: f64::INFINITY,
    },
];

impl Rung {
    /// Returns the configuration of this rung. `base` is the configuration of the rules, and
    /// `full_samples` is half the number of samples per side of the reference model.
    pub fn config(&self, base: &ModelConfig, full_samples: u32) -> ModelConfig {
        let config = ModelConfig {
            speckle: base.speckle.filter(|_| self.randomness),
            noise: base.noise && self.randomness,
            blur: match self.randomness {
                true => base.blur,
                false => Blur::None,
            },
            samples_per_side: match self.samples {
                SampleCount::HalfOfRules => base.samples_per_side.div_ceil(2),
                SampleCount::Rules => base.samples_per_side,
                SampleCount::Full => full_samples,
            },
            sampling: self.sampling,
            beam_cutoff_radii: base.beam_cutoff_radii.min(self.beam_cutoff_radii),
            ..base.clone()
        };
        match self.geometry_only {
            true => geometry_only(config),
            false => config,
        }
    }

    /// Returns whether this rung omits anything that the rules simulate.
    pub fn omits(&self) -> bool {
        self.geometry_only || !self.randomness || matches!(self.samples, SampleCount::HalfOfRules)
    }

    /// Returns whether the light comes from the cut of the part with the beam.
    pub fn is_plane_cut(&self) -> bool {
        self.sampling == Sampling::PlaneCut
    }

    /// Returns whether profiles come from images.
    pub fn takes_images(&self) -> bool {
        !self.geometry_only
    }
}

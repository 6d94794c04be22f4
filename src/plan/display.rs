//! Text form of configurations.

use super::config::ModelConfig;
use crate::frame::{Blur, Sampling};
use crate::speckle::lookup::Method;

/// Returns the values of a configuration as text.
pub fn to_text(plan: &ModelConfig) -> String {
    words(plan).join(", ")
}

/// Returns the choices of a configuration as separate texts.
pub fn words(plan: &ModelConfig) -> Vec<String> {
    if plan.geometry_only {
        return vec!["geometry only, no image".into()];
    }
    let n = plan.samples_per_side;
    let sampling = match plan.sampling {
        Sampling::PlaneCut => format!("{n} × {n} samples a pixel from the cut of the beam"),
        _ if n == 1 => "1 ray a pixel".to_owned(),
        Sampling::Planes => format!("{n} × {n} samples a pixel"),
        Sampling::Rays => format!("{n} × {n} rays a pixel"),
    };
    let speckle = match plan.speckle {
        None => "no speckle",
        Some(Method::Field) if plan.local_speckle_motion => {
            "speckle by field that slips out of focus"
        }
        Some(Method::Field) => "speckle by field",
        Some(Method::Trilinear) => "speckle trilinear",
    };
    let noise = if plan.noise { "noise" } else { "no noise" };
    let light = format!("light to {:.2} beam radii", plan.beam_cutoff_radii);
    let mut words = vec![sampling, speckle.into(), noise.into(), light];
    match plan.blur {
        Blur::None => words.push("sharp image".into()),
        Blur::Mean => words.push("light blurred".into()),
        Blur::Coherent => words.push("field blurred".into()),
    }
    if let Some(reflections) = &plan.reflections {
        words.push(format!("up to {} reflections", reflections.most));
    }
    words
}

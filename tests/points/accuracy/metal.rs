//! Parts of metal drawn at random: plates that reflect light onto themselves, and convex parts that do not.

use super::assemble;
use super::generated::{COLUMNS, Optics, part};
use crate::plates::{SHAPES, plate};
use crate::random::Random;
use lasertrace::math::rng::{Purpose, RngKey};
use std::fs;
use std::path::Path;

/// What scenes take in turn: two of three are of [`SHAPES`], the others of `generated::part`, some of them convex.
const KINDS: [&str; 12] = [
    "corner", "pocket", "step", "ribs", "bore", "sphere", "pocket", "corner", "cylinder", "bore",
    "ribs", "block",
];

pub fn kind(number: u64) -> &'static str {
    KINDS[number as usize % KINDS.len()]
}

/// Side of the field in which plates of `plates::plate` are as large as they should be, mm.
const FIELD: f64 = 20.0;

/// A scene of such a part; a mesh that it names is written to the folder. The same for the same number.
pub fn scene_text(number: u64, folder: &Path) -> String {
    let random = &mut Random::new(9000 + number);
    let optics = Optics::random(random);
    let size = COLUMNS * optics.object_px() * 1e-3;
    let kind = kind(number);
    let surface = surface(random);
    let part = match SHAPES.contains(&kind) {
        true => {
            let key = RngKey::new(9000 + number, Purpose::PlanRays);
            let text = plate(kind, key, size / FIELD);
            fs::write(folder.join("part.obj"), text).unwrap();
            let [x, y] = [0, 1].map(|_| random.between(-10.0, 10.0));
            let turn = random.between(0.0, 360.0);
            format!(
                "mesh = {{ file = \"part.obj\", unit = \"mm\" }}\nrotation_deg = [{x}, {y}, {turn}]"
            )
        }
        false => part(random, kind, size),
    };
    assemble(number, random, &optics, (&part, Some(&surface)), size)
}

/// Bare metal, ground or milled along a lay, or under a coat in part.
fn surface(random: &mut Random) -> String {
    let name = match random.choice(4) {
        // Steel has no name (docs/metals.md).
        0 => "n = 2.5, k = 3.4".to_owned(),
        i => format!("name = {:?}", ["aluminium", "iron", "titanium"][i - 1]),
    };
    let roughness = random.scale(0.08, 0.5);
    match random.choice(3) {
        0 => format!("metal = {{ {name}, roughness = {roughness} }}"),
        1 => {
            let across = roughness * random.between(1.0, 3.0);
            let along = random.between(-1.0, 1.0);
            format!(
                "metal = {{ {name}, roughness = {roughness}, roughness_v = {across} }}\n\
                 lay = {{ direction = [{along}, 1, 0] }}",
                across = across.min(1.0)
            )
        }
        _ => {
            let share = random.between(0.3, 0.9);
            format!(
                "metal = {{ {name}, roughness = {roughness}, weight = {share} }}\n\
                 coated_diffuse = {{ index = 1.5, roughness = {}, reflectance = {}, weight = {} }}",
                random.scale(0.08, 0.5),
                random.between(0.2, 0.8),
                1.0 - share
            )
        }
    }
}

//! Light that is reflected more than once, from scene files: the number that `scenes/corner` must give, and where the
//! plan follows it.

use lasertrace::Scene;
use lasertrace::frame::Irradiance;
use lasertrace::plan::ModelConfig;
use lasertrace::plan::rules::EffectKind;
use lasertrace::run::{Simulation, scene_plan};
use std::path::Path;

fn text(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/corner");
    let text = std::fs::read_to_string(path.join(name)).unwrap();
    // One small image.
    text.replace("resolution_px = [640, 480]", "resolution_px = [320, 240]")
        .replace("pixel_pitch_um = 11", "pixel_pitch_um = 22")
}

fn scene(text: &str) -> Scene {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/corner");
    Scene::parse(text, &folder).unwrap()
}

fn reflections(plan: &ModelConfig) -> (bool, &str) {
    let effect = plan
        .effects
        .iter()
        .find(|e| e.effect == EffectKind::Reflections);
    let effect = effect.expect("it is said");
    assert_eq!(plan.reflections.is_some(), effect.modelled);
    (effect.modelled, &effect.why)
}

/// Radiosity has 0.1364 of the light reflected once for up to three reflections (of a pinhole's image of even radiance; the
/// lens's cos⁴ weighs both alike to 10⁻³), here of one image's noise, 1/√n of its paths that reach the sensor: below
/// 0.5 % as the plan has it. Without the key matt parts have none.
#[test]
fn the_corner_has_the_light_it_must_have() {
    let text = text("scene.toml");
    let simulation = Simulation::new(&scene(&text)).unwrap();
    let sum = |light: &Irradiance| light.dense().iter().map(|&e| e as f64).sum::<f64>();
    let [direct, ghosts] = simulation.direct_and_indirect(1);
    let ratio = sum(&ghosts) / sum(&direct);
    println!("{ratio:.4}");
    assert!((ratio / 0.1364 - 1.0).abs() < 0.02, "{ratio}");
    // Together they are the frame.
    let both = sum(&simulation.irradiance(1));
    assert!((both / (sum(&direct) + sum(&ghosts)) - 1.0).abs() < 1e-3);
    assert!(reflections(&simulation.plan).0);
    let alone = scene_plan(&scene(&text.replace("max_bounces = 3", ""))).unwrap();
    assert!(!reflections(&alone).0);
}

/// Metal that sees itself has reflections, and a tolerance takes images for them; a plate, which does not, pays nothing.
#[test]
fn the_plan_follows_light_where_it_meets_the_part_again() {
    let metal = "[part.surface]\nmetal = { name = \"aluminium\", roughness = 0.3 }\n[laser]";
    let text = text("scene.toml")
        .replace("reflectance = 0.5\n", "")
        .replace("[laser]", metal)
        .replace("max_bounces = 3", "");
    let plan = scene_plan(&scene(&text)).unwrap();
    let (modelled, why) = reflections(&plan);
    assert!(modelled && plan.reflections.unwrap().most > 3, "{why}");
    let plate = text.replace(
        "mesh = { file = \"corner.stl\", unit = \"mm\" }",
        "plane = { size_mm = [40, 40] }",
    );
    let plan = scene_plan(&scene(&plate)).unwrap();
    let (modelled, why) = reflections(&plan);
    assert!(!modelled && why.contains("no light"), "{why}");
}

//! Text output of `check`.

use super::assessment::{Assessment, LightFractions};
use super::check::CheckReport;
use super::forecast::ResourceEstimate;
use super::report::lens_text;
use super::sensor_figures::SensorFigures;
use super::warning_kind::Warning;
use crate::camera::{Camera, Sensor};
use crate::error::printable;
use crate::laser::FanProfile;
use crate::mesh::{self, MeshReport};
use crate::plan::rules::{Effect, ModelConfig};
use crate::report::chart::short;
use crate::scene::{MovingBody, Origin, PathMotion, Scene, SolvedValue};
use crate::surface::{Ggx, Lobe, Surface, Topography};
use indicatif::{DecimalBytes, HumanDuration};
use std::fmt::Write;
use std::time::Duration;

/// Returns one line per warning.
pub fn warning_lines(warnings: &[Warning]) -> String {
    let line = |warning: &Warning| format!("warning: {}\n", warning.message);
    warnings.iter().map(line).collect()
}

/// Returns the text of a checked scene.
pub fn check_text(checked: &CheckReport) -> String {
    let scene = &checked.scene;
    let mut text = format!("{}\n\n", scene.path.display());
    text += &match checked.warnings.as_slice() {
        [] => "No warnings: the sensor measures the part on this path.\n".to_owned(),
        warnings => warning_lines(warnings),
    };
    let _ = write!(text, "\nPart\n{}", part(scene, &mesh::report(&scene.mesh)));
    let _ = write!(text, "\nSensor\n{}", sensor(scene, checked));
    let _ = write!(text, "\nScan\n{}", path(scene));
    let _ = write!(
        text,
        "\nMeasured on this path\n{}",
        measured(&checked.assessment)
    );
    let _ = write!(
        text,
        "\nThe whole scan, about\n{}",
        whole_scan(&checked.forecast)
    );
    text.push_str("\nWhat is simulated\n");
    for effect in &checked.plan.effects {
        text += &effect_lines(effect);
    }
    if let Some(accuracy) = &checked.plan.accuracy {
        text += &line(
            "accuracy",
            &format!(
                "tolerance {} µm, method \"{}\": {}",
                accuracy.tolerance_um, accuracy.rung, accuracy.statement
            ),
        );
    }
    text + &sheet(checked.sensor.as_ref(), scene)
        + &systematic(checked)
        + &from_data_sheet(scene)
        + &scheimpflug(scene, &checked.plan)
}

/// Returns the effect of ambient light and the contributions of systematic errors.
fn systematic(checked: &CheckReport) -> String {
    let ambient = &checked.ambient;
    let doubling = match (ambient.doubling_lx, ambient.saturating_lx) {
        (Some(lx), _) => format!("{} lx double the repeatability", short(lx)),
        (None, Some(0.0)) => "the line saturates without ambient light".to_owned(),
        (None, Some(lx)) => format!("the line saturates at {} lx", short(lx)),
        (None, None) => {
            let scene = &checked.scene;
            let cause = if scene.ambient.e_per_s_per_lx.is_none() {
                "camera.filter_nm is not set"
            } else if scene.camera.sensor.noise.is_none() {
                "camera.read_noise_e is not set"
            } else {
                "no light on the part"
            };
            format!("effect on the repeatability unknown: {cause}")
        }
    };
    let light = format!(
        "{} lx, {} electrons per pixel; {doubling}",
        short(ambient.illuminance_lx),
        short(ambient.background_e)
    );
    line("ambient light", &light) + &format!("\nSystematic errors\n{}", checked.systematic.text())
}

/// Returns the text of a sensor file: the properties that follow from it.
pub fn sensor_text(checked: &CheckReport) -> String {
    let scene = &checked.scene;
    let mut text = format!(
        "{}\n\nThe file is a sensor's. Its target here is a diffuse plane of reflectance 0.5 at the centre of the \
         measuring range.\n",
        scene.path.display()
    );
    text += &warning_lines(&checked.warnings);
    let _ = write!(text, "\nSensor\n{}", sensor(scene, checked));
    text + &sheet(checked.sensor.as_ref(), scene)
        + &systematic(checked)
        + &from_data_sheet(scene)
        + &scheimpflug(scene, &checked.plan)
}

fn line(name: &str, value: &str) -> String {
    format!("  {name:<18}{value}\n")
}

fn part(scene: &Scene, mesh: &MeshReport) -> String {
    let mut text = String::new();
    for row in mesh.to_string().lines() {
        let _ = writeln!(text, "  {row}");
    }
    if let Some(unit) = scene.mesh_unit {
        text += &line("unit of the file", &unit.to_string());
    }
    for ignored in scene.mesh_ignored.iter() {
        text += &line("not read", &ignored.to_string());
    }
    if scene.copies.len() > 1 {
        let size = scene.bounds().size();
        let [x, y, z] = size.to_array().map(short);
        let copies = scene.copies.len();
        text += &line(
            "instances",
            &format!("{copies}, together {x} × {y} × {z} mm"),
        );
    }
    let kinds = scene.surface.kinds().iter();
    let counts = scene.surface.counts(mesh.triangles);
    for (kind, count) in kinds.zip(counts) {
        if scene.surface.kinds().len() > 1 {
            let name = kind
                .name
                .as_deref()
                .map_or("all others".to_owned(), printable::short);
            text += &line("triangles", &format!("{count} of {name}, whose surface is"));
        }
        text += &surface(&kind.surface);
        if let Some(topography) = &kind.topography {
            text += &line("topography", &topography_text(topography));
        }
    }
    text
}

fn topography_text(topography: &Topography) -> String {
    let (sq, [along, across]) = topography.parameters();
    let across_text = short(across);
    let length = match along == across {
        true => format!("{across_text} mm"),
        false => format!(
            "{} mm along the lay, {across_text} mm across it",
            short(along)
        ),
    };
    format!("Sq {} µm, autocorrelation length {length}", short(sq * 1e3))
}

fn surface(surface: &Surface) -> String {
    let glossy = match surface {
        Surface::Lambert(diffuse) => return line("reflectance", &short(diffuse.reflectance)),
        Surface::Layered(glossy) => glossy,
    };
    let rough = |facets: &Ggx| match facets.is_isotropic() {
        true => format!("roughness {}", short(facets.alpha_u)),
        false => {
            let (along, across) = (short(facets.alpha_u), short(facets.alpha_v));
            format!("roughness {along} along the lay, {across} across it")
        }
    };
    let words = |(share, lobe): &(f64, Lobe)| {
        let what = match lobe {
            Lobe::Diffuse(diffuse) => {
                format!("diffuse, reflectance {}", short(diffuse.reflectance))
            }
            Lobe::Metal(metal) => {
                let (n, k) = (short(metal.n), short(metal.k));
                format!("metal of n = {n}, k = {k}, {}", rough(&metal.facets))
            }
            Lobe::Mirror(mirror) => format!("mirror, reflectance {}", short(mirror.reflectance)),
            Lobe::CoatedDiffuse(coat) => {
                let (index, reflectance) = (short(coat.index), short(coat.reflectance));
                let rough = rough(&coat.facets);
                format!("coat of n = {index}, {rough}, over reflectance {reflectance}")
            }
        };
        line("surface", &format!("{} of {what}", short(*share)))
    };
    glossy.lobes.iter().map(words).collect()
}

fn sensor(scene: &Scene, checked: &CheckReport) -> String {
    let Camera { sensor, lens, .. } = &scene.camera;
    let beam = &scene.laser.beam;
    let shape = match &scene.laser.fan {
        None => "a point".to_owned(),
        Some(fan) => format!(
            "a line of {}°, {}",
            short(fan.angle.to_degrees()),
            match &fan.profile {
                FanProfile::Uniform => "uniform",
                FanProfile::Gaussian => "Gaussian",
                FanProfile::Measured(_) => "with a measured profile",
            }
        ),
    };
    let laser = format!(
        "{} nm, {} mW, {shape}; waist of {} µm (1/e² radius) at {} mm",
        short(beam.wavelength * 1e6),
        short(beam.power_mw),
        short(beam.waist_radius * 1e3),
        short(beam.waist_distance)
    );
    let camera = format!(
        "{} × {} pixels of {} µm; {}, focused at {} mm; exposure {} ms",
        sensor.resolution.x,
        sensor.resolution.y,
        short(sensor.pixel_pitch * 1e3),
        lens_text(lens, short),
        short(lens.focus_distance - lens.position()),
        exposures(sensor)
    );
    let plan = &checked.plan;
    line("laser", &laser)
        + &line("camera", &camera)
        + &line(
            "height per pixel",
            &format!("{} µm", short(1e3 / plan.px_per_mm)),
        )
        + &line(
            "laser line",
            &format!(
                "{} px wide (1/e²) in the image; speckle grain {}",
                short(2.0 * plan.line_half_width_px),
                plan.grain
            ),
        )
}

/// Returns the exposure times, from the longest to the shortest.
fn exposures(sensor: &Sensor) -> String {
    let shorter = sensor
        .shorter
        .iter()
        .map(|ratio| sensor.exposure_ms / ratio);
    let all: Vec<String> = std::iter::once(sensor.exposure_ms)
        .chain(shorter)
        .map(short)
        .collect();
    all.join(", ")
}

fn path(scene: &Scene) -> String {
    let scan = &scene.scan;
    let mover = match scan.moves {
        MovingBody::Head => "the sensor",
        MovingBody::Part => "the part",
    };
    let path = match &scan.motion {
        PathMotion::Linear { step } => {
            let step = step.length();
            let way = step * f64::from(scan.frames - 1);
            let (step, way) = (short(step), short(way));
            format!("{mover} moves {step} mm from frame to frame, {way} mm in all")
        }
        PathMotion::Rotary { step_deg, .. } => {
            format!("{mover} turns by {}° from frame to frame", short(*step_deg))
        }
        PathMotion::Poses { file, .. } => format!("{mover} follows {}", file.display()),
    };
    line("frames", &scan.frames.to_string())
        + &line("path", &path)
        + &line("seed", &scene.seed.to_string())
}

/// Returns the assessment from which the warnings follow.
fn measured(assessment: &Assessment) -> String {
    let percent = |fraction: f64| format!("{} %", short(100.0 * fraction));
    let mut text = String::new();
    text += &match &assessment.light {
        None => line("light", "none in the field"),
        Some(light) => line("light", &of_light(light)),
    };
    if let Some(surface) = &assessment.surface {
        let measurable = format!(
            "{} of the part's surface, seen from the sensor as it is turned on this path",
            percent(surface.measurable)
        );
        text += &line("measurable", &measurable);
        let measured = format!(
            "{} of the measurable surface has valid points; {} is in the field, {} outside it, {} is not on the path",
            percent(surface.measured),
            percent(surface.in_field),
            percent(surface.beside_field),
            percent(surface.not_passed)
        );
        text += &line("surface", &measured);
    }
    let path = &assessment.path;
    let passes = match path.passes {
        1 => "one pass".to_owned(),
        n => format!("{n} passes"),
    };
    let travel = path
        .travel_mm
        .map_or(String::new(), |mm| format!(", {} mm long", short(mm)));
    let duration = format!(
        "{passes}{travel}, {} s at {} Hz; {} of the frames see nothing of the part",
        short(path.duration_s),
        short(path.frame_rate_hz),
        percent(path.empty_frames)
    );
    text += &line("passes", &duration);
    if let Some(gap) = path.gap {
        let gap = format!(
            "up to {} mm, where the field is {} mm wide",
            short(gap.spacing_mm),
            short(gap.field_mm)
        );
        text += &line("pass spacing", &gap);
    }
    text
}

/// Returns the fractions of the light on surface that faces the camera.
fn of_light(light: &LightFractions) -> String {
    let percent = |fraction: f64| format!("{} %", short(100.0 * fraction));
    let losses = [
        (light.too_near.fraction, "too near"),
        (light.too_far.fraction, "too far"),
        (light.occluded.fraction, "occluded"),
        (light.too_dark.fraction, "too dark"),
        (light.saturated.fraction, "saturated"),
        (light.out_of_focus.fraction, "out of focus"),
    ];
    let losses = losses.iter().filter(|(fraction, _)| *fraction > 0.0);
    let losses: Vec<String> = losses
        .map(|(fraction, cause)| format!("{} {cause}", percent(*fraction)))
        .collect();
    let losses = match losses.is_empty() {
        true => "nothing".to_owned(),
        false => losses.join(", "),
    };
    format!(
        "{} of it gives valid points; lost: {losses}. Not counted: {} on surface that faces away from the camera, {} \
         where the part hides it from every position",
        percent(light.valid),
        percent(light.facing_away),
        percent(light.hidden)
    )
}

fn effect_lines(effect: &Effect) -> String {
    let modelled = match effect.modelled {
        true => "simulated",
        false => "omitted",
    };
    let moves = effect.height_effect_um.map_or(String::new(), |um| {
        format!(" (moves heights by {} µm)", short(um))
    });
    format!(
        "  {:<32}{modelled:<11}{}{moves}\n{:>45}{}\n",
        effect.effect.name(),
        effect.method,
        "",
        effect.why
    )
}

/// Returns the data sheet of the sensor.
fn sheet(figures: Option<&SensorFigures>, scene: &Scene) -> String {
    let mut text = "\nDerived sensor properties\n".to_owned();
    let Some(figures) = figures else {
        return text
            + &line(
                "measuring range",
                "none: no laser light in the field of view",
            );
    };
    let [near, far] = figures.ends();
    text += &line(
        "stand-off",
        &format!("{} mm, to the near end of the measuring range", short(near)),
    );
    text += &line(
        "measuring range",
        &format!("{} mm, to {} mm", short(far - near), short(far)),
    );
    let angle = format!(
        "{}°, camera {} mm from the laser axis",
        short(figures.triangulation_deg),
        short(figures.baseline_mm)
    );
    text += &line("triangulation", &angle);
    text += &line("depth of field", &in_focus(figures));
    text += &match &figures.light {
        None => line("light on the part", "none in the field of view"),
        Some(light) => line(
            "light on the part",
            &format!(
                "{} counts in the line's middle (95 % below {}), {} are full: {} % of it saturates",
                short(light.median),
                short(light.bright),
                short(light.full_scale),
                short(100.0 * light.saturated_fraction)
            ),
        ),
    };
    text += &line("part in the field", &in_field(figures));
    let (rate, limit) = (
        short(figures.profiles_per_second),
        slowest(&scene.camera.sensor),
    );
    text += &line("profiles", &format!("at most {rate} a second, by {limit}"));
    text += "\n  from the laser, mm    field, mm    µm/px in x    µm/px in z    line, µm    line, px    blur, px\n";
    for place in figures.places.iter().step_by(2) {
        let [left, right] = place.field_mm;
        let [x, z] = place.um_per_px.map(short);
        let _ = writeln!(
            text,
            "  {:>18}{:>13}{x:>14}{z:>14}{:>12}{:>12}{:>12}",
            short(place.distance_mm),
            short(right - left),
            short(place.line_um),
            short(place.line_px),
            short(place.blur_px)
        );
    }
    text
}

fn in_focus(figures: &SensorFigures) -> String {
    let [near, far] = figures.ends();
    match figures.depth_of_field_mm {
        None => "nowhere in the range: the lens's blur is wider than the line".to_owned(),
        Some([first, last]) if first <= near && last >= far => {
            "the whole range: the lens's blur is narrower than the line".to_owned()
        }
        Some([first, last]) => format!(
            "from {} to {} mm the lens's blur is narrower than the line",
            short(first),
            short(last)
        ),
    }
}

/// Returns the process that limits the profile rate.
fn slowest(sensor: &Sensor) -> String {
    let readouts = 1 + sensor.shorter.len();
    let by_readout = readouts as f64 * sensor.readout_ms > sensor.total_exposure_ms();
    match (by_readout, readouts) {
        (false, 1) => "the exposure".to_owned(),
        (false, n) => format!("{n} exposures"),
        (true, n) => format!("reading {} rows", n * sensor.resolution.y as usize),
    }
}

/// Returns the description of the part's position relative to the field along the path.
fn in_field(figures: &SensorFigures) -> String {
    let Some(found) = figures.in_field else {
        return "no light meets it".to_owned();
    };
    let Some((frame, most)) = found.worst else {
        return "all that the light meets, in all frames".to_owned();
    };
    let ends = [
        (found.nearer, "nearer than the measuring range"),
        (found.beyond, "beyond it"),
        (found.beside, "outside the field"),
    ];
    let ends = ends.iter().filter(|(share, _)| *share > 0.0);
    let ends: Vec<String> = ends
        .map(|(share, place)| format!("{} % {place}", short(100.0 * share)))
        .collect();
    format!(
        "of the light on it ends {}; most in frame {frame}, {} %",
        ends.join(", "),
        short(100.0 * most)
    )
}

/// Returns the values derived from a data sheet, with their origin.
fn from_data_sheet(scene: &Scene) -> String {
    let mut text = String::new();
    for value in &scene.sensor.values {
        let SolvedValue { key, value, origin } = value;
        let why = match origin {
            Origin::Given => "given",
            Origin::Solved => "follows from the data sheet",
            Origin::Estimated => "estimated",
            Origin::Assumed => "ASSUMED",
        };
        text += &format!("  {why:<28}{key} = {value}\n");
    }
    if text.is_empty() {
        return text;
    }
    text.insert_str(
        0,
        "\nFrom the data sheet, where scene and sensor say nothing else\n",
    );
    if !scene.sensor.estimates.is_empty() {
        text +=
            "\nEstimated, as the data sheet does not contain it; [data_sheet] can fix each key\n";
    }
    for estimate in &scene.sensor.estimates {
        let [least, most] = estimate.interval.map(short);
        text += &format!(
            "  {:<20}{:>8} ({least} to {most}), from {}\n",
            estimate.key,
            short(estimate.value),
            estimate.basis
        );
    }
    text
}

fn scheimpflug(scene: &Scene, plan: &ModelConfig) -> String {
    let (Some([x, y]), Some(distance)) = (plan.scheimpflug_tilt_deg, plan.laser_plane_distance_mm)
    else {
        return String::new();
    };
    let Camera { lens, tilt, .. } = &scene.camera;
    let off = tilt.to_array().map(f64::to_degrees);
    let focused = (0..2).all(|i| (off[i] - [x, y][i]).abs() < 1e-3);
    let focus = lens.focus_distance - lens.position();
    if focused && (focus / distance - 1.0).abs() < 1e-5 {
        return "\nThe whole laser plane is in focus.\n".to_owned();
    }
    // A tilt of the order of rounding errors counts as zero.
    let [x, y] = [x, y].map(|tilt| if tilt.abs() < 5e-5 { 0.0 } else { tilt });
    format!(
        "\nTo have the whole laser plane in focus: camera.focus = \"laser-plane\", which is camera.tilt_deg = \
         [{x:.4}, {y:.4}] and camera.focus_distance_mm = {distance:.3}\n"
    )
}

/// Returns the resources that the entire scan takes.
fn whole_scan(forecast: &ResourceEstimate) -> String {
    let bytes = |bytes: u64| DecimalBytes(bytes).to_string();
    let free = match forecast.memory_available_bytes {
        Some(available) if forecast.fits() => format!(" ({} are free)", bytes(available)),
        Some(available) => format!(": MORE THAN THE {} THAT ARE FREE", bytes(available)),
        None => String::new(),
    };
    let time =
        HumanDuration(Duration::try_from_secs_f64(forecast.seconds).unwrap_or(Duration::MAX));
    let time = format!("{time} with threads: {}", forecast.threads);
    line("memory", &format!("{}{free}", bytes(forecast.memory_bytes)))
        + &line("disk", &bytes(forecast.disk_bytes))
        + &line("time", &time)
}

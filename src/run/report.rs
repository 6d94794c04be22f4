//! Content of a scan's report.

mod frames;
mod histograms;

use super::simulation::Simulation;
use super::summary::ScanSummary;
use super::surface_view::surface_view;
use super::{RunControl, features, resolved};
use crate::camera::{Camera, Lens};
use crate::error::Result;
use crate::frame::Blur;
use crate::inspect::cloud::CloudPoint;
use crate::inspect::coverage::{Fate, SensorPose};
use crate::inspect::features::MeanUncertainty;
use crate::inspect::flags::count_flags;
use crate::inspect::tolerance::{Verdict, classify_point, to_text};
use crate::inspect::uncertainty::UncertaintyStatistics;
use crate::laser::Laser;
use crate::math::{Aabb, DVec3};
use crate::plan::rules::Effect;
use crate::profile::{Filters, Smooth};
use crate::report::chart::{color_bar, short};
use crate::report::color::{Rgb, diverging, sequential};
use crate::report::page::{ColorMap, Report, of_fate, of_verdict};
use crate::report::picture::{ParallelView, part_picture};
use crate::report::ply::color_limit_um;
use crate::report::setup::Setup;
use crate::report::viewer::{Bar, Mode, PointQuantity, Under, Viewer, ViewerLayer};
use crate::scene::Scene;
use crate::surface::{Lobe, Surface};
use std::fmt::Display;

/// Maximum number of points in the viewer, about half a megabyte.
const MOST_IN_VIEWER: usize = 60_000;

/// Maximum number of triangles of the part in the viewer, about one megabyte.
const MOST_TRIANGLES: usize = 40_000;

/// Longer side of the images of the part, px.
const PICTURE_SIZE: usize = 900;

/// Verdicts in the order for the median in an image.
const ORDERED: [Verdict; 3] = [Verdict::Pass, Verdict::Unsure, Verdict::Fail];

const TOLERANCE: &str = "Blue: pass. Red: fail. Yellow: unsure. Grey: flagged, or of no region.";

const FLAGGED: Rgb = [200, 0, 120];
const UNFLAGGED: Rgb = [150, 190, 200];

pub struct ReportInput<'a> {
    pub simulation: &'a Simulation,
    /// Points of `frames`, in order of frames, then columns.
    pub points: &'a [CloudPoint],
    pub frames: std::ops::Range<u32>,
    pub poses: &'a [SensorPose],
    /// Whether images were simulated.
    pub images: bool,
    pub summary: &'a ScanSummary,
    pub run: Vec<(&'static str, String)>,
}

/// Returns the uncertainty of a mean, with the contributions of its sources.
fn mean_fact(mean: &MeanUncertainty) -> (&'static str, String) {
    let sources = mean.sources.iter();
    let sources = sources.filter(|source| source.standard_uncertainty > 0.0);
    let sources: Vec<String> = sources
        .map(|s| format!("{} {}", s.name, short(s.standard_uncertainty)))
        .collect();
    let least = match mean.lower_bound {
        true => "; lower bound, as the scene has no systematic errors",
        false => "",
    };
    let text = format!(
        "{} µm for {} points ({}){least}",
        short(mean.standard_uncertainty_um),
        mean.points,
        sources.join(", ")
    );
    ("standard uncertainty of the mean deviation", text)
}

/// Returns a row of the table of modelled effects.
fn plan_row(effect: &Effect) -> [String; 5] {
    let modelled = if effect.modelled { "yes" } else { "no" };
    let number = |n: Option<f64>| n.map_or(String::new(), short);
    [
        effect.effect.name().into(),
        modelled.into(),
        effect.method.clone(),
        effect.why.clone(),
        number(effect.height_effect_um),
    ]
}

impl ReportInput<'_> {
    pub fn report(self, control: &RunControl) -> Result<Report> {
        let plan = &self.simulation.plan;
        let limits = ColorLimits::of(self.points);
        let maps = match self.summary.deviation {
            Some(_) => self.maps(&limits, control)?,
            None => Vec::new(),
        };
        Ok(Report {
            title: "Laser-triangulation scan".into(),
            lead: self.lead(),
            facts: self.facts(),
            viewer: Some(self.viewer(&limits)),
            maps,
            statistics: self.summary.deviation.clone(),
            histograms: match self.summary.deviation {
                Some(_) => self.histograms(&limits),
                None => Vec::new(),
            },
            tolerance: self.summary.tolerance.clone(),
            features: self.summary.features.clone(),
            flags: count_flags(self.points),
            setup: self.setup(),
            frames: match self.images {
                true => self.sample_frames(),
                false => Vec::new(),
            },
            plan: plan.effects.iter().map(plan_row).collect(),
            accuracy: plan.accuracy.as_ref().map(|a| a.statement.clone()),
            coverage: self.summary.coverage.clone(),
            files: self.files(),
            run: self.run,
        })
    }

    /// Returns the names and paths of files in the folder of the report.
    fn files(&self) -> Vec<(&'static str, &'static str)> {
        let mut files = vec![
            ("resolved scene", resolved::SCENE),
            ("resolved sensor", resolved::SENSOR),
        ];
        if !self.summary.features.is_empty() {
            files.push(("features", features::TABLE));
        }
        files
    }

    fn facts(&self) -> Vec<(&'static str, String)> {
        let scene = &self.simulation.scene;
        let plan = &self.simulation.plan;
        let size = self.simulation.accel.bounds().size();
        let [x, y, z] = size.to_array().map(short);
        let part = format!("{}: {} triangles", scene.part, scene.mesh.triangles.len());
        let part = match scene.copies.len() {
            1 => part,
            copies => format!("{copies} instances of {part}"),
        };
        let (travel, passes) = travel(self.poses);
        let passes = match passes {
            1 => String::new(),
            passes => format!(" in {passes} passes"),
        };
        let mut facts = vec![
            ("scene", scene.path.display().to_string()),
            ("part", format!("{part}; {x} × {y} × {z} mm")),
            ("laser", laser(&scene.laser)),
            ("camera", camera(&scene.camera)),
            ("exposure", exposure(&scene.camera)),
            ("material", material(scene)),
            ("stand-off and angle", self.stand_off()),
            (
                "frames",
                format!(
                    "{}, the laser moves {} mm{passes}",
                    self.frames.len(),
                    short(travel)
                ),
            ),
            (
                "sensor columns with a point",
                format!("{} %", short(self.summary.measured_fraction * 100.0)),
            ),
            (
                "points out of focus",
                match self.summary.defocused_fraction {
                    None => "no points".into(),
                    Some(share) => format!(
                        "{} % have a blur wider than two standard deviations of their line{}",
                        short(share * 100.0),
                        match plan.blur {
                            Blur::None => "; it is not modelled",
                            Blur::Mean => "; speckle moves it less than it does",
                            Blur::Coherent => "",
                        }
                    ),
                },
            ),
            (
                "height per pixel",
                format!("{} µm", short(1e3 / plan.px_per_mm)),
            ),
            ("speckle size", plan.grain.to_string()),
            (
                "repeatability (static)",
                self.uncertainty(|u| u.median_repeatability_um),
            ),
            (
                "standard deviation over positions: speckle, noise and calibration",
                self.uncertainty(|u| u.median_sigma_um),
            ),
            (
                "errors are alike along the profile over",
                self.uncertainty(|u| u.median_correlation_length_um),
            ),
            ("done to profiles", filters(&scene.measure.filters)),
        ];
        facts.extend(self.summary.means.iter().map(mean_fact));
        facts
    }

    /// Returns the distance from the laser to the field centre, and the angle between laser and
    /// camera there.
    fn stand_off(&self) -> String {
        let scene = &self.simulation.scene;
        let point = surface_view(scene, None).point;
        let [laser, camera] =
            [&scene.head_from_laser, &scene.head_from_camera].map(|pose| pose.translation - point);
        format!(
            "{} mm from laser to measured surface, {}° between laser and camera",
            short(laser.length()),
            short(laser.angle_between(camera).to_degrees())
        )
    }

    /// Returns a median over points without a flag.
    fn uncertainty(&self, of: impl Fn(&UncertaintyStatistics) -> f64) -> String {
        let found = self.summary.uncertainty.as_ref();
        found.map_or("no points".into(), |u| {
            format!("{} µm (median)", short(of(u)))
        })
    }

    fn maps(&self, limits: &ColorLimits, control: &RunControl) -> Result<Vec<ColorMap>> {
        let views = self.views();
        control.check()?;
        let mut maps = vec![self.map(
            "Deviation from the CAD surface",
            color_bar(-limits.deviation_um, limits.deviation_um, "µm", &|d| {
                diverging(d, limits.deviation_um)
            }),
            "Red: outside the material. Blue: inside. Median of the valid points in each pixel.",
            &views,
            &|p| p.is_valid().then_some(p.deviation * 1e3),
            &|um| diverging(um, limits.deviation_um),
        )];
        control.check()?;
        maps.push(self.map(
            "Standard uncertainty of the deviation",
            color_bar(0.0, limits.sigma_um, "µm", &|s| {
                sequential(s, limits.sigma_um)
            }),
            "Predicted for each point from speckle, noise and calibration; not stated for \
             those flagged outside. Median of the valid points in each pixel.",
            &views[..2],
            &|p| p.is_valid().then_some(p.u_deviation * 1e3),
            &|um| sequential(um, limits.sigma_um),
        ));
        control.check()?;
        if let Some(coverage) = &self.summary.coverage {
            let places = || {
                coverage
                    .places
                    .iter()
                    .map(|(p, fate)| (*p, f32::from(*fate as u8)))
            };
            let spacing = (coverage.area_mm2 / coverage.places.len().max(1) as f64).sqrt();
            let paint = |median: f64| {
                let order = median.round() as usize;
                let fate = Fate::ALL.into_iter().find(|&fate| fate as usize == order);
                of_fate(fate.unwrap_or(Fate::OutsideScan))
            };
            maps.push(ColorMap {
                title: "Coverage of the CAD surface",
                bar: String::new(),
                legend: "Green: measured. Other colours: why it is not, as in the table of coverage below.",
                views: (views.iter())
                    .map(|&(caption, view)| {
                        let picture = part_picture(self.simulation.accel.nominal(), places(), &paint, view, (PICTURE_SIZE, spacing));
                        (caption, picture.png)
                    })
                    .collect(),
            });
            control.check()?;
        }
        let bands = &self.simulation.scene.bands;
        if !bands.is_empty() {
            maps.push(self.map(
                "Within tolerance",
                String::new(),
                TOLERANCE,
                &views,
                &|p| {
                    let verdict = self.verdict(p)?;
                    let order = ORDERED.iter().position(|&other| other == verdict)?;
                    Some(order as f64)
                },
                &|median| of_verdict(Some(ORDERED[(median.round() as usize).min(2)])),
            ));
            control.check()?;
        }
        Ok(maps)
    }

    fn verdict(&self, point: &CloudPoint) -> Option<Verdict> {
        classify_point(&self.simulation.scene.bands, point).map(|(_, verdict)| verdict)
    }

    fn valid(&self) -> impl Iterator<Item = &CloudPoint> + Clone {
        self.points.iter().filter(|p| p.is_valid())
    }

    fn lead(&self) -> String {
        let warnings = self.summary.warnings.iter().map(|w| w.message.as_str());
        let warnings = warnings.collect::<Vec<_>>().join(" ");
        let Some(d) = &self.summary.deviation else {
            return warnings;
        };
        let warnings = match warnings.as_str() {
            "" => String::new(),
            warnings => format!(" Warning: {warnings}"),
        };
        let tolerance = match &self.summary.tolerance[..] {
            [] => String::new(),
            regions => format!(" Tolerance: {}.", to_text(regions)),
        };
        format!(
            "{} of {} points are valid. Their deviation from the CAD has a mean of {} µm and a \
             standard deviation of {} µm; 98 % of them are between {} and {} µm.{tolerance}{warnings}",
            d.points,
            self.points.len(),
            short(d.mean_um),
            short(d.std_um),
            short(d.percentiles_um[0].1),
            short(d.percentiles_um[6].1)
        )
    }

    fn map(
        &self,
        title: &'static str,
        bar: String,
        legend: &'static str,
        views: &[(&'static str, ParallelView)],
        value: &dyn Fn(&CloudPoint) -> Option<f64>,
        color: &dyn Fn(f64) -> Rgb,
    ) -> ColorMap {
        let views = views.iter().map(|&(caption, view)| {
            // Each point uses its position on the CAD surface, so an error does not move it to
            // another pixel.
            let points = self
                .points
                .iter()
                .filter_map(|p| Some((on_cad(p), value(p)? as f32)));
            let picture = part_picture(
                self.simulation.accel.nominal(),
                points,
                color,
                view,
                (PICTURE_SIZE, 0.0),
            );
            (caption, picture.png)
        });
        ColorMap {
            title,
            bar,
            legend,
            views: views.collect(),
        }
    }

    fn middle(&self) -> SensorPose {
        self.poses[self.poses.len() / 2]
    }

    /// Returns the views of the part: along the laser beam, and obliquely from the camera's side,
    /// from the other side and along the line.
    fn views(&self) -> Vec<(&'static str, ParallelView)> {
        let SensorPose {
            part_from_laser,
            part_from_camera,
        } = self.middle();
        let right = part_from_laser.rotation.x_axis;
        let beam = part_from_laser.rotation.z_axis;
        let camera = part_from_camera.rotation.z_axis;
        let away = camera
            - 2.0 * part_from_laser.rotation.y_axis * camera.dot(part_from_laser.rotation.y_axis);
        let looking = |into: DVec3, hint: DVec3| {
            let right = (hint - into * hint.dot(into)).normalize();
            // The laser is above.
            let upside_down = into.cross(right).dot(beam) < -1e-9;
            let right = if upside_down { -right } else { right };
            ParallelView {
                right,
                down: into.cross(right),
            }
        };
        // The direction is tilted towards the line, to show walls.
        let oblique = |from: DVec3, side: f64| (from + side * right + 0.3 * beam).normalize();
        vec![
            ("along the laser beam", looking(beam, right)),
            (
                "from the camera's side",
                looking(oblique(camera, -0.6), right),
            ),
            ("from the other side", looking(oblique(away, 0.6), right)),
            (
                "from one end of the line",
                looking(
                    (right + 0.5 * beam).normalize(),
                    part_from_laser.rotation.y_axis,
                ),
            ),
        ]
    }

    fn viewer(&self, limits: &ColorLimits) -> Viewer {
        // Bounding box of the part and of all valid points. Flagged points may have large errors.
        let part = self.simulation.accel.nominal().bounds();
        let of_points = self.valid().map(|p| p.position);
        let bounds = Aabb::of(of_points.chain([part.min, part.max]));
        let inside = |p: &&CloudPoint| {
            let [low, high] = [bounds.min, bounds.max];
            p.position.cmpge(low).all() && p.position.cmple(high).all()
        };
        let stride = self.points.len().div_ceil(MOST_IN_VIEWER).max(1);
        let shown: Vec<&CloudPoint> = self.points.iter().step_by(stride).filter(inside).collect();
        let mut cloud = ViewerLayer {
            // Points inside the material would be hidden by the part, and only those outside would
            // be visible.
            positions: shown
                .iter()
                .map(|p| if p.is_valid() { on_cad(p) } else { p.position })
                .collect(),
            values: point_values(&shown),
            modes: point_modes(&shown, limits),
        };
        if !self.simulation.scene.bands.is_empty() {
            cloud.modes.push(Mode {
                name: "tolerance",
                caption: TOLERANCE.into(),
                bar: None,
                colors: shown.iter().map(|p| of_verdict(self.verdict(p))).collect(),
            });
        }
        let any = self.summary.deviation.is_some();
        let mut layers: Vec<ViewerLayer> = any.then_some(cloud).into_iter().collect();
        layers.extend(self.summary.coverage.as_ref().map(|coverage| ViewerLayer {
            positions: coverage.places.iter().map(|(p, _)| *p).collect(),
            values: Vec::new(),
            modes: vec![Mode {
                    name: "coverage of the CAD",
                    caption: "Places on the CAD: green measured, yellow weak signal, violet hidden \
                              from the camera, grey hidden from the laser, light grey outside."
                        .into(),
                    bar: None,
                    colors: coverage.places.iter().map(|(_, f)| of_fate(*f)).collect(),
                }],
        }));
        Viewer {
            look: [0.6, 0.6],
            under: Some(Under::part(
                self.simulation.accel.nominal(),
                MOST_TRIANGLES,
                bounds,
            )),
            layers,
        }
    }

    fn setup(&self) -> Vec<(&'static str, String)> {
        let scene = &self.simulation.scene;
        let path: Vec<DVec3> = self
            .poses
            .iter()
            .step_by(self.poses.len().div_ceil(200))
            .map(|pose| pose.part_from_laser.translation)
            .collect();
        let setup = Setup {
            accel: &self.simulation.accel,
            laser: &scene.laser,
            camera: &scene.camera,
            pose: self.middle(),
            path: &path,
        };
        setup.drawings().into()
    }
}

/// Returns the position of a point on the CAD surface.
fn on_cad(point: &CloudPoint) -> DVec3 {
    point.position - point.deviation * point.normal.as_dvec3()
}

/// Returns the surfaces of the part, with their names.
fn material(scene: &Scene) -> String {
    let lobe = |lobe: &Lobe| match lobe {
        Lobe::Diffuse(diffuse) => {
            format!("diffuse, reflectance {}", short(given(diffuse.reflectance)))
        }
        Lobe::Metal(metal) => format!("metal, roughness {}", short(given(metal.facets.least()))),
        Lobe::CoatedDiffuse(coat) => format!(
            "coated, roughness {}, reflectance below {}",
            short(given(coat.facets.least())),
            short(given(coat.reflectance))
        ),
        Lobe::Mirror(mirror) => format!("mirror, reflectance {}", short(given(mirror.reflectance))),
    };
    let surface = |surface: &Surface| match surface {
        Surface::Lambert(diffuse) => lobe(&Lobe::Diffuse(*diffuse)),
        Surface::Layered(glossy) => match &glossy.lobes[..] {
            [(_, only)] => lobe(only),
            lobes => {
                let parts = lobes
                    .iter()
                    .map(|(weight, one)| format!("{} of {}", short(*weight), lobe(one)));
                parts.collect::<Vec<_>>().join(" + ")
            }
        },
    };
    let kinds = scene.surface.kinds().iter().map(|kind| match &kind.name {
        Some(name) => format!("{name}: {}", surface(&kind.surface)),
        None => surface(&kind.surface),
    });
    kinds.collect::<Vec<_>>().join("; ")
}

/// Returns the exposure time as text.
fn exposure(camera: &Camera) -> String {
    format!("{} ms", short(given(camera.sensor.exposure_ms)))
}

/// Length above which a step between frames is a jump between passes, in median steps.
const JUMP: f64 = 5.0;

/// Returns the distance that the laser moves over the part within passes, mm, and the number of
/// passes.
fn travel(poses: &[SensorPose]) -> (f64, usize) {
    let step = |pair: &[SensorPose]| {
        let [from, to] = [pair[0], pair[1]].map(|pose| pose.part_from_laser.translation);
        from.distance(to)
    };
    let steps: Vec<f64> = poses.windows(2).map(step).collect();
    let mut sorted = steps.clone();
    sorted.sort_by(f64::total_cmp);
    let longest = JUMP * sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    // A head that is stationary in most frames has no typical step.
    let jump = |step: &&f64| longest > 0.0 && **step > longest;
    let jumps = steps.iter().filter(jump);
    let (jumped, count) = jumps.fold((0.0, 0), |(sum, n), step| (sum + step, n + 1));
    (steps.iter().sum::<f64>() - jumped, count + 1)
}

/// Rounds a number of the scene to remove digits from unit conversion.
fn given(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}

fn laser(laser: &Laser) -> String {
    let (power, wavelength) = (laser.beam.power_mw, given(laser.beam.wavelength * 1e6));
    let shape = laser.fan.as_ref().map_or("a spot".into(), |fan| {
        format!("a line of {}°", given(fan.angle.to_degrees()))
    });
    format!("{wavelength} nm, {} mW, {shape}", given(power))
}

/// Returns the filters in the order of their application.
fn filters(filters: &Filters) -> String {
    let um = |mm: f64| short(given(mm * 1e3));
    let steps = [
        filters
            .outlier
            .map(|limit| format!("outliers by more than {} µm out", um(limit))),
        (filters.average_frames > 1).then(|| format!("mean of {} frames", filters.average_frames)),
        filters
            .fill
            .map(|length| format!("gaps up to {} µm filled", um(length))),
        filters.smooth.map(|smooth| match smooth {
            Smooth::Mean(columns) => format!("mean of {columns} columns"),
            Smooth::Median(columns) => format!("median of {columns} columns"),
            Smooth::Gaussian(sigma) => format!("Gaussian of {} columns", short(sigma)),
        }),
        filters
            .resample
            .map(|step| format!("a point every {} µm", um(step))),
    ];
    let steps: Vec<String> = steps.into_iter().flatten().collect();
    match steps.is_empty() {
        true => "nothing".into(),
        false => steps.join(", then "),
    }
}

/// Returns the description of a lens, with numbers as `text` represents them.
pub(super) fn lens_text<T: Display>(lens: &Lens, text: impl Fn(f64) -> T) -> String {
    match lens.telecentric {
        true => format!(
            "telecentric, magnification {}, NA {}",
            text(lens.magnification()),
            text(lens.numerical_aperture())
        ),
        false => format!("{} mm f/{}", text(lens.focal_length), text(lens.f_number)),
    }
}

fn camera(camera: &Camera) -> String {
    let (lens, sensor) = (&camera.lens, &camera.sensor);
    format!(
        "{} × {} pixels of {} µm, lens {}",
        sensor.resolution.x,
        sensor.resolution.y,
        given(sensor.pixel_pitch * 1e3),
        lens_text(lens, given)
    )
}

/// Returns the colour modes of points: deviation, uncertainty, flags.
pub(crate) fn point_modes(points: &[&CloudPoint], limits: &ColorLimits) -> Vec<Mode> {
    let mode = |name, caption: String, bar, color: &dyn Fn(&CloudPoint) -> Rgb| Mode {
        name,
        caption,
        bar,
        colors: points.iter().map(|p| color(p)).collect(),
    };
    let (d, s) = (limits.deviation_um, limits.sigma_um);
    vec![
        mode(
            "deviation",
            "Deviation from the CAD surface: red outside the material, blue inside. Valid points are drawn on the surface.".into(),
            Some(Bar::new(-d, d, "µm", |x| diverging(x, d))),
            &|p| diverging(p.deviation * 1e3, d),
        ),
        mode(
            "standard uncertainty",
            "Standard uncertainty of the deviation.".into(),
            Some(Bar::new(0.0, s, "µm", |x| sequential(x, s))),
            &|p| sequential(p.u_deviation * 1e3, s),
        ),
        mode(
            "flags",
            "Valid points grey-blue; points with a flag other than \"outside\" magenta.".into(),
            None,
            &|p| {
                if p.is_valid() { UNFLAGGED } else { FLAGGED }
            },
        ),
    ]
}

/// Returns the values that the viewer shows for a selected point.
pub(crate) fn point_values(points: &[&CloudPoint]) -> Vec<PointQuantity> {
    let quantity = |name, unit, of: &dyn Fn(&CloudPoint) -> f64| PointQuantity {
        name,
        unit,
        values: points.iter().map(|p| of(p) as f32).collect(),
    };
    vec![
        quantity("deviation", "µm", &|p| 1e3 * p.deviation),
        quantity("standard uncertainty", "µm", &|p| 1e3 * p.u_deviation),
        quantity("frame", "", &|p| p.frame.into()),
        quantity("column", "", &|p| p.column.into()),
    ]
}

/// Limits of the colour scales ([`color_limit_um`]).
pub(crate) struct ColorLimits {
    deviation_um: f64,
    sigma_um: f64,
}

impl ColorLimits {
    pub(crate) fn of(points: &[CloudPoint]) -> ColorLimits {
        ColorLimits {
            deviation_um: color_limit_um(points, |p| p.deviation),
            sigma_um: color_limit_um(points, |p| p.u_deviation),
        }
    }
}

//! What a scan's report shows.

mod frames;
mod histograms;

use super::scan::ScanSummary;
use super::{Control, Simulation};
use crate::error::Result;
use crate::inspect::chart::{color_bar, short};
use crate::inspect::cloud::CloudPoint;
use crate::inspect::color::{Rgb, diverging, of_fate, sequential};
use crate::inspect::coverage::HeadPose;
use crate::inspect::flags::count_flags;
use crate::inspect::picture::{ParallelView, part_picture};
use crate::inspect::report::{ColorMap, Report};
use crate::inspect::setup::Setup;
use crate::inspect::viewer::{Layer, Mode, Viewer};
use crate::integrator::plan::Effect;
use crate::math::DVec3;

/// Points and places in the viewer: what half a megabyte holds.
const MOST_IN_VIEWER: usize = 60_000;

/// Width of the pictures of the part, px.
const PICTURE_WIDTH: usize = 900;

const FLAGGED: Rgb = [200, 0, 120];
const UNFLAGGED: Rgb = [150, 190, 200];

pub struct Shown<'a> {
    pub simulation: &'a Simulation<'a>,
    /// Those of `frames`, in order of frames, then columns.
    pub points: &'a [CloudPoint],
    pub frames: std::ops::Range<u32>,
    pub poses: &'a [HeadPose],
    /// Whether frames were taken.
    pub images: bool,
    pub summary: &'a ScanSummary,
    pub run: Vec<(&'static str, String)>,
}

/// A row of the report's table of what was modelled.
fn plan_row(effect: &Effect) -> [String; 6] {
    let modelled = if effect.modelled { "yes" } else { "no" };
    let number = |n: Option<f64>| n.map_or(String::new(), short);
    [
        effect.effect.into(),
        modelled.into(),
        effect.method.clone(),
        effect.why.clone(),
        number(effect.influence_um),
        number(effect.cost_ms),
    ]
}

impl Shown<'_> {
    pub fn report(self, control: &Control) -> Result<Report> {
        let plan = &self.simulation.plan;
        let limits = Limits::of(self.points);
        let maps = self.maps(&limits, control)?;
        Ok(Report {
            title: "Laser-triangulation scan".into(),
            lead: self.lead(),
            facts: self.facts(),
            viewer: Some(self.viewer(&limits)),
            maps,
            statistics: self.summary.deviation.clone(),
            histograms: self.histograms(&limits),
            flags: count_flags(self.points),
            setup: self.setup(),
            frames: match self.images {
                true => self.sample_frames(),
                false => Vec::new(),
            },
            plan: plan.effects.iter().map(plan_row).collect(),
            accuracy: plan.accuracy.as_ref().map(|a| a.statement.clone()),
            coverage: self.summary.coverage.clone(),
            run: self.run,
        })
    }

    fn facts(&self) -> Vec<(&'static str, String)> {
        let scene = self.simulation.scene;
        let plan = &self.simulation.plan;
        let part = format!("{} triangles", scene.mesh.triangles.len());
        let part = match scene.copies.len() {
            1 => part,
            copies => format!("{copies} copies of {part}"),
        };
        let [across, along] = [self.poses.first(), self.poses.last()]
            .map(|pose| pose.map_or(DVec3::ZERO, |pose| pose.part_from_laser.translation));
        vec![
            ("scene", scene.path.display().to_string()),
            ("part", part),
            (
                "frames",
                format!(
                    "{}, over {} mm",
                    self.frames.len(),
                    short((along - across).length())
                ),
            ),
            (
                "columns with a point",
                format!("{} of 100", short(self.summary.measured_share * 100.0)),
            ),
            (
                "1 px along the beam",
                format!("{} µm", short(1e3 / plan.px_per_mm)),
            ),
            ("speckle size", plan.grain.to_string()),
        ]
    }

    fn maps(&self, limits: &Limits, control: &Control) -> Result<Vec<ColorMap>> {
        let views = self.views();
        control.check()?;
        let mut maps = vec![self.map(
            "Deviation from the CAD surface",
            color_bar(-limits.deviation_um, limits.deviation_um, "µm", &|d| {
                diverging(d, limits.deviation_um)
            }),
            "Red: outside the material. Blue: inside. Sound points.",
            &views,
            &|p| diverging(p.deviation * 1e3, limits.deviation_um),
            &|p| p.is_sound(),
        )];
        control.check()?;
        maps.push(self.map(
            "Standard uncertainty of the deviation",
            color_bar(0.0, limits.sigma_um, "µm", &|s| {
                sequential(s, limits.sigma_um)
            }),
            "Predicted for each point from speckle, noise and calibration; not stated for \
             those flagged outside. Sound points.",
            &views[..2],
            &|p| sequential(p.deviation_sigma * 1e3, limits.sigma_um),
            &|p| p.is_sound(),
        ));
        control.check()?;
        Ok(maps)
    }

    fn sound(&self) -> impl Iterator<Item = &CloudPoint> + Clone {
        self.points.iter().filter(|p| p.is_sound())
    }

    fn lead(&self) -> String {
        let Some(d) = &self.summary.deviation else {
            return "No point was measured: no line was found in any frame.".into();
        };
        format!(
            "{} sound points of {}. They lie {} ± {} µm from the CAD (mean and standard \
             deviation); 98 of 100 within {} to {} µm.",
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
        color: &dyn Fn(&CloudPoint) -> Rgb,
        shown: &dyn Fn(&CloudPoint) -> bool,
    ) -> ColorMap {
        let views = views.iter().map(|&(caption, view)| {
            let points = self.points.iter().filter(|p| shown(p));
            let points = points.map(|p| (p.position, color(p)));
            let picture = part_picture(&self.simulation.accel, points, view, PICTURE_WIDTH);
            (caption, picture.png)
        });
        ColorMap {
            title,
            bar,
            legend,
            views: views.collect(),
        }
    }

    fn middle(&self) -> HeadPose {
        self.poses[self.poses.len() / 2]
    }

    /// The part as the laser sees it, and obliquely from the camera's side, from
    /// the other and along the line.
    fn views(&self) -> Vec<(&'static str, ParallelView)> {
        let HeadPose {
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
        // Between a way of looking and the line itself, so that walls show.
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

    fn viewer(&self, limits: &Limits) -> Viewer {
        let stride = self.points.len().div_ceil(MOST_IN_VIEWER).max(1);
        let shown: Vec<&CloudPoint> = self.points.iter().step_by(stride).collect();
        let mode = |name, caption: String, color: &dyn Fn(&CloudPoint) -> Rgb| Mode {
            name,
            caption,
            colors: shown.iter().map(|p| color(p)).collect(),
        };
        let (d, s) = (limits.deviation_um, limits.sigma_um);
        let mut layers = vec![Layer {
            positions: shown.iter().map(|p| p.position).collect(),
            modes: vec![
                mode(
                    "deviation",
                    format!("Deviation: blue {} µm, red {} µm.", short(-d), short(d)),
                    &|p| diverging(p.deviation * 1e3, d),
                ),
                mode(
                    "standard uncertainty",
                    format!("Standard uncertainty: yellow 0, dark blue {} µm.", short(s)),
                    &|p| sequential(p.deviation_sigma * 1e3, s),
                ),
                mode(
                    "flags",
                    "Doubtful points (with a flag other than outside) in magenta, others in grey-blue.".into(),
                    &|p| {
                        if p.is_sound() {
                            UNFLAGGED
                        } else {
                            FLAGGED
                        }
                    },
                ),
            ],
        }];
        layers.extend(self.summary.coverage.as_ref().map(|coverage| Layer {
            positions: coverage.places.iter().map(|(p, _)| *p).collect(),
            modes: vec![Mode {
                    name: "coverage of the CAD",
                    caption: "Places on the CAD: green measured, yellow weak signal, violet hidden \
                              from the camera, grey hidden from the laser, light grey outside."
                        .into(),
                    colors: coverage.places.iter().map(|(_, f)| of_fate(*f)).collect(),
                }],
        }));
        Viewer {
            bounds: self.simulation.accel.bounds(),
            look: [0.6, 0.6],
            layers,
        }
    }

    fn setup(&self) -> Vec<(&'static str, String)> {
        let scene = self.simulation.scene;
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

/// Where the colours end: 98 of 100 sound points lie within; a nanometre where
/// all is exact.
struct Limits {
    deviation_um: f64,
    sigma_um: f64,
}

impl Limits {
    fn of(points: &[CloudPoint]) -> Limits {
        let most = |value: &dyn Fn(&CloudPoint) -> f64| {
            let sound = points.iter().filter(|p| p.is_sound());
            let mut values: Vec<f64> = sound.map(|p| value(p).abs() * 1e3).collect();
            values.sort_by(f64::total_cmp);
            let at = values.get(values.len() * 98 / 100);
            at.map_or(1.0, |&d| d.max(1e-3))
        };
        Limits {
            deviation_um: most(&|p| p.deviation),
            sigma_um: most(&|p| p.deviation_sigma),
        }
    }
}

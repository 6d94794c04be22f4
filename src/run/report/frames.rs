//! Frames that a report shows.

use super::ReportInput;
use crate::report::page::SampleFrame;
use crate::report::picture::encode_for_eyes;

impl ReportInput<'_> {
    /// Returns the frame with the largest depth variation, the frame with most flagged points, and
    /// the central frame of the path.
    pub(super) fn sample_frames(&self) -> Vec<SampleFrame> {
        let by_frame = |frame: u32| {
            let start = self.points.partition_point(|p| p.frame < frame);
            let end = self.points.partition_point(|p| p.frame <= frame);
            &self.points[start..end]
        };
        let spread = |frame: u32| {
            let pose = &self.poses[(frame - self.frames.start) as usize];
            let beam = pose.part_from_laser.rotation.z_axis;
            let depths: Vec<f64> = by_frame(frame)
                .iter()
                .map(|p| p.position.dot(beam))
                .collect();
            let mean = depths.iter().sum::<f64>() / depths.len().max(1) as f64;
            depths.iter().map(|d| (d - mean).powi(2)).sum::<f64>()
        };
        let doubts = |frame: u32| {
            let flagged = by_frame(frame).iter().filter(|p| !p.is_valid());
            flagged.count() as f64
        };
        let most = |of: &dyn Fn(u32) -> f64| {
            let scored = self.frames.clone().map(|frame| (frame, of(frame)));
            let some = scored.filter(|(_, score)| *score > 0.0);
            let best = some.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
            best.map(|(frame, _)| frame)
        };
        let middle = self.frames.start + self.frames.len() as u32 / 2;
        let chosen = [
            (most(&spread), "the one with the greatest spread of depth"),
            (most(&doubts), "the one with the most flags"),
            (Some(middle), "the middle one"),
        ];
        let chosen = chosen
            .into_iter()
            .filter_map(|(frame, why)| Some((frame?, why)));
        let mut chosen: Vec<(u32, &str)> = chosen.collect();
        let mut seen = Vec::new();
        chosen.retain(|(frame, _)| {
            let new = !seen.contains(frame);
            seen.push(*frame);
            new
        });
        chosen
            .into_iter()
            .map(|(frame, why)| self.sample_frame(frame, why))
            .collect()
    }

    fn sample_frame(&self, frame: u32, why: &'static str) -> SampleFrame {
        let simulation = self.simulation;
        let sensor = &simulation.scene.camera.sensor;
        let counts = simulation.image(frame);
        let (peaks, _) = simulation.measure(frame, &counts);
        SampleFrame {
            number: frame,
            why,
            png: encode_for_eyes(&counts.to_rows(), counts.columns(), sensor.max_count()),
            width: sensor.resolution.x,
            height: sensor.resolution.y,
            line: peaks
                .iter()
                .map(|p| (p.column as f64 + 0.5, p.row))
                .collect(),
        }
    }
}

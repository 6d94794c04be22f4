//! Frames rendered by another program, for comparison in the chart.

use super::image_file::Channel;
use super::peak_image::{GreyImage, LineAlong, read_image};
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{InputError, Place, Result};
use crate::run::files;
use crate::scene::Scene;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Images of frames of a scene by another program, in sensor counts, with their rendering times.
#[derive(Debug)]
pub struct ExternalRender {
    /// Name of the program in the chart.
    pub name: String,
    /// Frames in the order of the scan.
    pub frames: Vec<BesideFrame>,
    path: PathBuf,
    /// Paths of the JSON file and its images.
    pub(super) inputs: Vec<PathBuf>,
}

/// One frame by another program.
#[derive(Debug)]
pub struct BesideFrame {
    /// Frame number in the scan.
    pub frame: u32,
    /// Rendering times on one core, ms.
    pub ms: Vec<f64>,
    /// Image of the frame.
    pub image: GreyImage,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ExternalFile {
    name: String,
    frames: Vec<FileFrame>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FileFrame {
    frame: u32,
    ms: Vec<f64>,
    /// Path relative to the JSON file.
    image: PathBuf,
}

impl ExternalRender {
    /// Reads `{"name": "…", "frames": [{"frame": 3, "ms": [20.1, 20.3], "image": "3.png"}, …]}`.
    /// Frames are in ascending order, each with an image in sensor counts.
    pub fn read(path: &Path) -> Result<ExternalRender> {
        let expected = "{\"name\": …, \"frames\": [{\"frame\": …, \"ms\": […], \"image\": …}, …]}";
        let bytes = input_file::read(path, LARGEST_TEXT, expected)?;
        let file: ExternalFile = files::parse_json(path, &bytes, expected)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let frame = |frame: FileFrame| {
            let image = read_image(
                &folder.join(&frame.image),
                LineAlong::Columns,
                Channel::Brightest,
            )?;
            Ok(BesideFrame {
                frame: frame.frame,
                ms: frame.ms,
                image,
            })
        };
        let images = file.frames.iter().map(|frame| folder.join(&frame.image));
        let inputs = images.chain([path.to_owned()]).collect();
        Ok(ExternalRender {
            inputs,
            frames: file.frames.into_iter().map(frame).collect::<Result<_>>()?,
            name: file.name,
            path: path.to_owned(),
        })
    }

    /// Checks that the images may be images of the scene's frames.
    pub(super) fn check(&self, scene: &Scene) -> Result<()> {
        let wrong = |found: String, expected: String| {
            Err(InputError::new(&self.path, Place::File, found, expected).into())
        };
        let numbers: Vec<u32> = self.frames.iter().map(|frame| frame.frame).collect();
        let frames = scene.scan.frames;
        let rise = numbers.is_sorted_by(|a, b| a < b);
        if numbers.last().is_none_or(|&last| last >= frames) || !rise {
            let expected = format!("some frames from 0 to {}, in rising order", frames - 1);
            return wrong(format!("frames {numbers:?}"), expected);
        }
        for BesideFrame { frame, ms, image } in &self.frames {
            if ms.is_empty() || !ms.iter().all(|&ms| ms > 0.0 && ms.is_finite()) {
                let found = format!("ms = {ms:?} of frame {frame}");
                return wrong(found, "times above 0 ms, at least one".into());
            }
            let size = [image.counts.columns(), image.counts.rows()].map(|n| n as u32);
            let sensor = scene.camera.sensor.resolution.to_array();
            if size != sensor {
                let found = format!("an image of {size:?} pixels of frame {frame}");
                return wrong(found, format!("{sensor:?}, as the scene's sensor has"));
            }
        }
        Ok(())
    }
}

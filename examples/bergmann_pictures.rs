//! The pictures of docs/bergmann-2016.md, and the figures that stand under them.
//!
//! ```sh
//! cargo run --release --example bergmann_pictures -- docs/bergmann
//! ```

use image::{GrayImage, Luma};
use lasertrace::camera::Counts;
use lasertrace::math::Aperture;
use lasertrace::speckle::motion::overlap_correlation;
use lasertrace::speckle::pattern::PatternSpec;
use lasertrace::speckle::slices::Slices;
use lasertrace::speckle::theory::integrated_contrast;
use lasertrace::{Scene, Simulation};
use std::error::Error;
use std::path::{Path, PathBuf};

/// Pixels between the pictures of a row.
const GAP: usize = 4;

/// Grey values in rows, 1 being white.
struct Picture {
    columns: usize,
    rows: usize,
    values: Vec<f64>,
}

impl Picture {
    /// Counts as a share of the `highest`.
    fn of(counts: &Counts, highest: f64) -> Picture {
        let values = counts.to_rows();
        Picture {
            columns: counts.columns(),
            rows: counts.rows(),
            values: values.iter().map(|&n| f64::from(n) / highest).collect(),
        }
    }

    /// Rows as columns.
    fn turned(&self) -> Picture {
        let column = |x: usize| self.values[x..].iter().step_by(self.columns).copied();
        Picture {
            columns: self.rows,
            rows: self.columns,
            values: (0..self.columns).flat_map(column).collect(),
        }
    }

    /// The rectangle of this size below and to the right of a pixel.
    fn cut(&self, [left, top]: [usize; 2], [columns, rows]: [usize; 2]) -> Picture {
        let row = |y: usize| &self.values[self.columns * y + left..][..columns];
        Picture {
            columns,
            rows,
            values: (top..top + rows).flat_map(row).copied().collect(),
        }
    }

    /// Standard deviation over mean.
    fn contrast(&self) -> f64 {
        let n = self.values.len() as f64;
        let mean = self.values.iter().sum::<f64>() / n;
        let variance = self.values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
        variance.sqrt() / mean
    }

    /// Pearson's correlation with a picture of the same size.
    fn correlation(&self, other: &Picture) -> f64 {
        let n = self.values.len() as f64;
        let [a, b] = [self, other].map(|p| p.values.iter().sum::<f64>() / n);
        let pairs = || {
            self.values
                .iter()
                .zip(&other.values)
                .map(|(x, y)| (x - a, y - b))
        };
        let sum = |f: fn((f64, f64)) -> f64| pairs().map(f).sum::<f64>();
        sum(|(x, y)| x * y) / (sum(|(x, _)| x * x) * sum(|(_, y)| y * y)).sqrt()
    }
}

/// Writes pictures of one height side by side, as sRGB shows them: grey is value^(1/2.2).
fn save(path: PathBuf, pictures: &[Picture]) -> Result<(), image::ImageError> {
    let columns: usize = pictures.iter().map(|p| p.columns + GAP).sum();
    let size = [columns - GAP, pictures[0].rows].map(|n| n as u32);
    let mut image = GrayImage::from_pixel(size[0], size[1], Luma([255]));
    let mut left = 0;
    for picture in pictures {
        for (i, value) in picture.values.iter().enumerate() {
            let grey = 255.0 * value.clamp(0.0, 1.0).powf(1.0 / 2.2);
            let (x, y) = (left + i % picture.columns, i / picture.columns);
            image.put_pixel(x as u32, y as u32, Luma([grey.round() as u8]));
        }
        left += picture.columns + GAP;
    }
    image.save(path)
}

fn white(scene: &Scene) -> f64 {
    f64::from(scene.camera.sensor.max_count())
}

#[expect(clippy::too_many_lines, reason = "one picture after the other")]
fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::args().nth(1).unwrap_or("docs/bergmann".into());
    let folder = Path::new(&folder);
    let text = |name: &str| std::fs::read_to_string(folder.join(name));
    let parse = |text: &str| Scene::parse(text, folder);

    let at_the_plane = text("point.toml")?;
    let before_it = at_the_plane.replace("waist_distance_mm = 50", "waist_distance_mm = 40");
    let mut pictures = Vec::new();
    for text in [at_the_plane, before_it] {
        let scene = parse(&text)?;
        let image = Simulation::new(&scene)?.image(0);
        pictures.push(Picture::of(&image, white(&scene)).turned());
    }
    save(folder.join("point.png"), &pictures)?;

    let scene = parse(&text("translated.toml")?)?;
    let simulation = Simulation::new(&scene)?;
    let lens = &scene.camera.lens;
    let place = |k| scene.part_from_head(k).translation;
    let step = (place(1) - place(0)).length();
    let pixels = lens.magnification() * step / scene.camera.sensor.pixel_pitch;
    let frame = |k: u32| {
        // The surface runs to lower columns as the head runs to higher ones.
        let left = 220 - (f64::from(k) * pixels).round() as usize;
        Picture::of(&simulation.image(k), white(&scene)).cut([left, 8], [800, 496])
    };
    let frames: Vec<Picture> = (0..scene.scan.frames).map(frame).collect();
    println!("| δ, pupil diameters | correlation with the first | overlap law |");
    println!("|---|---|---|");
    for (k, frame) in frames.iter().enumerate() {
        let delta = k as f64 * step / lens.pupil_diameter();
        let found = frame.correlation(&frames[0]);
        println!(
            "| {delta:.3} | {found:.3} | {:.3} |",
            overlap_correlation(delta)
        );
    }
    let cut = |frame: &Picture| frame.cut([0, 0], [192, 192]);
    save(
        folder.join("translated.png"),
        &frames.iter().map(cut).collect::<Vec<_>>(),
    )?;

    println!("\n| f-number | grain h, µm | pixels | contrast of the image | closed form |");
    println!("|---|---|---|---|---|");
    let f_11 = text("f-number.toml")?;
    let f_45 = f_11
        .replace("f_number = 11", "f_number = 45")
        .replace("exposure_ms = 0.5", "exposure_ms = 8.37");
    for (name, text) in [("f-11.png", f_11), ("f-45.png", f_45)] {
        let scene = parse(&text)?;
        let lens = &scene.camera.lens;
        let grain = scene.laser.beam.wavelength * lens.image_distance() / lens.pupil_diameter();
        let picture = Picture::of(&Simulation::new(&scene)?.image(0), white(&scene));
        let pixels = grain / scene.camera.sensor.pixel_pitch;
        let (f, h, contrast) = (lens.f_number, 1e3 * grain, picture.contrast());
        let law = integrated_contrast(Aperture::Circle, 1.0 / pixels);
        println!("| {f} | {h:.1} | {pixels:.2} | {contrast:.3} | {law:.3} |");
        save(folder.join(name), &[picture])?;
    }

    println!("\n| slices apart | correlation with the first | overlap law of their chord |");
    println!("|---|---|---|");
    let spec = PatternSpec {
        size: 512,
        slices: 32,
        ..PatternSpec::default()
    };
    let slices = Slices::new(&spec);
    let slice = |k: usize| Picture {
        columns: spec.size,
        rows: spec.size,
        // Speckle brighter than five times its mean is white.
        values: slices
            .pattern(k)
            .intensity()
            .map(|v| f64::from(v) / 5.0)
            .collect(),
    };
    let first = slice(0);
    let apart = [0, 1, 2, 4, 8];
    let mut cuts = Vec::new();
    for k in apart {
        let whole = slice(k);
        let found = whole.correlation(&first);
        println!("| {k} | {found:.3} | {:.3} |", slices.overlap_law(0, k));
        cuts.push(whole.cut([0, 0], [160, 160]));
    }
    save(folder.join("slices.png"), &cuts)?;
    Ok(())
}

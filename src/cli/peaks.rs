use super::{ForceArguments, Output, STOP};
use crate::run::RunControl;
use crate::study;

use crate::error::Result;
use crate::error::printable::path;
use crate::report::chart::short;
use crate::study::PeakChart;
use crate::study::{Channel, ImageSummary, LineAlong};
use std::fmt::Write;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Image of a real laser line (PNG, JPEG, TIFF, BMP or PGM), to which all peak finders are
    /// applied [default: chart their errors on synthetic lines]
    #[arg(long, value_name = "FILE")]
    image: Option<PathBuf>,
    /// Direction of the line in the image
    #[arg(long, value_enum, default_value_t = Along::Columns, requires = "image")]
    line_along: Along,
    /// Channel of a colour image in which the line is detected
    #[arg(long, value_enum, default_value_t = Color::Brightest, requires = "image")]
    channel: Color,
    /// Seed of noise and speckle
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Along {
    Columns,
    Rows,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Color {
    Brightest,
    Red,
    Green,
    Blue,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let bar = output.progress(study::chart_conditions() as u64, "conditions");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let Some(image) = &arguments.image else {
        let chart = study::peak_chart(
            arguments.seed,
            arguments.force.folder(&arguments.output),
            &control,
        );
        bar.finish_and_clear();
        let chart = chart?;
        return output.result(&chart, &chart_text(&chart));
    };
    bar.finish_and_clear();
    let along = match arguments.line_along {
        Along::Columns => LineAlong::Columns,
        Along::Rows => LineAlong::Rows,
    };
    let channel = match arguments.channel {
        Color::Brightest => Channel::Brightest,
        Color::Red => Channel::Red,
        Color::Green => Channel::Green,
        Color::Blue => Channel::Blue,
    };
    let summary = study::peaks_of_image(
        image,
        along,
        channel,
        arguments.force.folder(&arguments.output),
        &control,
    )?;
    output.result(&summary, &image_text(&summary))
}

fn chart_text(chart: &PeakChart) -> String {
    let mut text = format!("{:<48}{:>40}\n", "", "bias and noise, 1/1000 px");
    for axis in &chart.axes {
        let names = axis.finders.iter().map(|(f, _)| f.to_string());
        let names: String = names.map(|name| format!("{name:>17}")).collect();
        let _ = writeln!(text, "{:<40}{names}", axis.quantity);
        for (i, value) in axis.values.iter().enumerate() {
            let _ = write!(text, "{value:<40}");
            for (_, errors) in &axis.finders {
                let cell = errors[i].map_or("–".into(), |e| {
                    format!("{} {:>7}", short(e.bias_px * 1e3), short(e.noise_px * 1e3))
                });
                let _ = write!(text, "{cell:>17}");
            }
            text.push('\n');
        }
    }
    text + &format!("\n{}\n", path(&chart.picture))
}

fn image_text(summary: &ImageSummary) -> String {
    let mut text = String::new();
    for line in &summary.finders {
        let _ = writeln!(
            text,
            "{:<16} {} points in {} columns, {} flagged, σ {} px (median)",
            line.finder,
            line.points,
            summary.columns,
            line.flagged,
            short(line.median_sigma_px)
        );
    }
    let channel = summary
        .channel
        .map(|channel| format!(" of the {channel} channel"));
    let (channel, saturation) = (channel.unwrap_or_default(), summary.saturation_dn);
    let _ = writeln!(text, "pixels{channel} saturate at {saturation} counts");
    let (table, picture) = (path(&summary.table), path(&summary.picture));
    text + &format!("\n{table}\n{picture}\n")
}

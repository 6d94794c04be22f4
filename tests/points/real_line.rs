//! A real laser frame, heavily saturated and with a halo, beside the line that its
//! authors' program extracted (../shared/data/laser; not part of this project).

use lasertrace::profile::PeakFinder;
use lasertrace::study::{Channel, LineAlong, read_image};
use std::path::{Path, PathBuf};

/// Half thickness of the light in the frame at full scale, px, at its thinnest:
/// the authors' line runs along the middle of a band 50 to 90 px thick.
const HALF_BAND: f64 = 25.0;

fn file(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../shared/data/laser")
        .join(name);
    if !path.exists() {
        println!("SKIPPED: no {}", path.display());
    }
    path.exists().then_some(path)
}

/// Row of the authors' line in each column, the mean of its pixels.
fn authors_line(path: &Path) -> Vec<(u32, f64)> {
    let line = read_image(path, LineAlong::Columns, Channel::Brightest).unwrap();
    (0..line.counts.columns())
        .filter_map(|column| {
            let counts = line.counts.column(column).iter().enumerate();
            let lit = counts.filter(|&(_, &count)| count > 127);
            let lit: Vec<f64> = lit.map(|(row, _)| row as f64 + 0.5).collect();
            let mean = lit.iter().sum::<f64>() / lit.len() as f64;
            (!lit.is_empty()).then_some((column as u32, mean))
        })
        .collect()
}

#[test]
fn finders_agree_with_the_authors_of_a_real_frame() {
    let (Some(image), Some(line)) = (
        file("linescan_live-original.png"),
        file("linescan_live-line.png"),
    ) else {
        return;
    };
    let image = read_image(&image, LineAlong::Columns, Channel::Brightest).unwrap();
    let authors = authors_line(&line);
    assert!(authors.len() > 300, "{}", authors.len());
    for finder in PeakFinder::ALL {
        let peaks = image.peaks(finder);
        let mut off: Vec<f64> = authors
            .iter()
            .filter_map(|&(column, row)| {
                let peak = peaks.iter().find(|p| p.column == column)?;
                Some((peak.row - row).abs())
            })
            .collect();
        off.sort_by(f64::total_cmp);
        let found = off.len() as f64 / authors.len() as f64;
        let median = off[off.len() / 2];
        let share = |limit| off.iter().filter(|&&d| d <= limit).count() as f64 / off.len() as f64;
        println!(
            "{finder:?}: {:.3} of the authors' columns, median |difference| {median:.2} px, \
             {:.3} within 1 px, {:.3} within the band",
            found,
            share(1.0),
            share(HALF_BAND)
        );
        assert!(found > 0.95, "{finder:?}: {found}");
        assert!(share(HALF_BAND) > 0.9, "{finder:?}");
        // The middle between the flanks of a saturated top, as the authors take it,
        // to the thickness of their line.
        assert!(finder != PeakFinder::LogParabola || median < 1.0);
    }
}

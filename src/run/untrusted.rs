//! Reads files of earlier runs like resuming and merging do. The files are untrusted: the fuzz
//! targets and tests/geometry/limits_mutated.rs call these functions with arbitrary bytes.

use super::dataset::TarIndex;
use super::journal::{FrameRecord, Records, RunKey};
use super::output_folder::Names;
use super::shards::{Shard, ShardKey};
use crate::error::Result;
use crate::inspect::cloud::CloudPoint;
use serde::de::DeserializeOwned;
use std::path::Path;

/// Returns the points of a scan's journal up to its end or first damage; `None` without a header.
pub fn journal_points(path: &Path) -> Result<Option<Vec<CloudPoint>>> {
    Ok(points::<RunKey>(path)?.map(|(_, points)| points))
}

/// Returns the shard and the points of a shard's journal; `None` without a header.
pub fn shard_points(path: &Path) -> Result<Option<(Shard, Vec<CloudPoint>)>> {
    Ok(points::<ShardKey>(path)?.map(|(key, points)| (key.shard, points)))
}

fn points<T: DeserializeOwned>(path: &Path) -> Result<Option<(T, Vec<CloudPoint>)>> {
    let mut records = Records::open(path)?;
    let Some(header) = records.header()? else {
        return Ok(None);
    };
    let mut points = Vec::new();
    while let Some(record) = records.next::<FrameRecord>()? {
        points.extend(record.points);
    }
    Ok(Some((header, points)))
}

/// Returns whether the list of an output folder names a file; `None` if the bytes are not a list.
pub fn list_names(list: &[u8], file: &str) -> Option<bool> {
    let names = serde_json::from_slice::<Names>(list).ok()?;
    Some(names.has_part(file))
}

/// Returns whether bytes are the index of a tar file of a data set.
pub fn is_tar_index(bytes: &[u8]) -> bool {
    serde_json::from_slice::<TarIndex>(bytes).is_ok()
}

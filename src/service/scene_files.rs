//! Files to which a submitted scene refers. Only references by hash are allowed.

use super::refusal::HttpError;
use super::store::{Hash, PREFIX, Store};
use axum::http::StatusCode;
use std::collections::BTreeSet;
use std::fs;

/// Key components whose value is a file.
const FILE_KEYS: [&str; 7] = [
    "sensor",
    "scene",
    "file",
    "instances",
    "poses",
    "frame_times",
    "calibration",
];
/// Keys of files that may refer to further files.
const SCENE_KEYS: [&str; 2] = ["sensor", "scene"];
/// Maximum size of a sensor or scene file, bytes.
const LARGEST_SCENE: u64 = 1 << 20;
/// Maximum nesting depth of scenes that refer to scenes.
const DEEPEST: usize = 3;

/// Returns the files that the scene reads. All of them exist in the store.
///
/// # Errors
/// Invalid TOML; a reference other than by hash; a missing file. Any string that contains a slash
/// is rejected, so no path reaches the file system, whatever keys a scene has.
pub fn files_of(text: &[u8], store: &Store) -> Result<Vec<Hash>, HttpError> {
    let mut found = BTreeSet::new();
    collect(text, "the scene", store, DEEPEST, &mut found)?;
    Ok(found.into_iter().collect())
}

fn wrong(message: String) -> HttpError {
    HttpError::new(StatusCode::UNPROCESSABLE_ENTITY, message)
}

fn collect(
    text: &[u8],
    what: &str,
    store: &Store,
    deeper: usize,
    found: &mut BTreeSet<Hash>,
) -> Result<(), HttpError> {
    let text = std::str::from_utf8(text).map_err(|error| wrong(format!("{what}: {error}")))?;
    let table: toml::Table = text
        .parse()
        .map_err(|error: toml::de::Error| wrong(format!("{what} is not TOML: {error}")))?;
    let mut texts = Vec::new();
    strings("", &toml::Value::Table(table), &mut texts);
    for (key, value) in texts {
        let last = key.rsplit('.').next().unwrap_or(&key);
        let Some(digits) = value.strip_prefix(PREFIX) else {
            // Also for nested keys such as `part.mesh.file.choice`.
            if key.split('.').any(|part| FILE_KEYS.contains(&part)) {
                return Err(wrong(format!(
                    "{what}: {key}: found {value:?}, expected \"{PREFIX}…\", the SHA-256 of a file that was \
                     sent by PUT /v1/files/…"
                )));
            }
            if value.contains(['/', '\\', '\0']) {
                return Err(wrong(format!(
                    "{what}: {key}: found {value:?}, expected a word without slashes: no path reaches the \
                     service's files"
                )));
            }
            continue;
        };
        let hash = Hash::parse(digits).ok_or_else(|| {
            let expected = "64 digits of SHA-256, 0 to 9 and a to f";
            wrong(format!(
                "{what}: {key}: found {value:?}, expected {expected}"
            ))
        })?;
        let path = store.file(&hash);
        let size = fs::metadata(&path).map(|data| data.len()).map_err(|_| {
            let digits = hash.digits();
            wrong(format!(
                "{what}: {key}: there is no file {value}; send it first: PUT /v1/files/{digits}"
            ))
        })?;
        if found.insert(hash) && SCENE_KEYS.contains(&last) {
            if size > LARGEST_SCENE || deeper == 0 {
                let found = format!("{size} bytes, scenes in scenes");
                return Err(wrong(format!("{what}: {key}: {value}: {found}")));
            }
            let text = fs::read(&path).map_err(crate::error::Error::io("read", &path))?;
            collect(&text, &value, store, deeper - 1, found)?;
        }
    }
    Ok(())
}

/// Collects all strings with their dotted keys.
fn strings(key: &str, value: &toml::Value, found: &mut Vec<(String, String)>) {
    match value {
        toml::Value::String(text) => found.push((key.to_owned(), text.clone())),
        toml::Value::Array(values) => values.iter().for_each(|value| strings(key, value, found)),
        toml::Value::Table(table) => {
            for (name, value) in table {
                let key = match key {
                    "" => name.clone(),
                    _ => format!("{key}.{name}"),
                };
                strings(&key, value, found);
            }
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_named_by_hash_alone() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let [mesh, sensor] = ["a", "b"].map(|digit| Hash::parse(&digit.repeat(64)).unwrap());
        fs::write(store.file(&mesh), "mesh").unwrap();
        fs::write(store.file(&sensor), "[camera]\nx = \"../a\"").unwrap();
        let files = |text: &str| files_of(text.as_bytes(), &store);
        let good = format!(
            "seed = 1\n[part]\nmesh = {{ file = \"{}\", unit = \"mm\" }}",
            mesh.name()
        );
        assert_eq!(files(&good).unwrap(), std::slice::from_ref(&mesh));
        for (bad, word) in [
            ("[part]\nmesh.file = \"/etc/passwd\"", "part.mesh.file"),
            ("[part]\nmesh.file = \"part.stl\"", "expected \"sha256:"),
            ("scan = { poses = \"../poses.csv\" }", "scan.poses"),
            (
                "[random]\n\"part.mesh.file\" = { choice = [\"job.json\"] }",
                "expected \"sha256:",
            ),
            (
                "[part]\ninstances = \"\\u002e\\u002e\\u002fx\"",
                "part.instances",
            ),
            ("new_key = [[\"a/b\"]]", "without slashes"),
            ("\"a.b\" = { \"c\" = \"..\\\\x\" }", "without slashes"),
            ("[measure]\ncalibration = \"sha256:../x\"", "64 digits"),
            (
                "sensor = \"sha256:cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc\"",
                "send it first",
            ),
            ("seed = ", "not TOML"),
        ] {
            let refusal = files(bad).unwrap_err();
            assert_eq!(refusal.status, StatusCode::UNPROCESSABLE_ENTITY);
            assert!(refusal.message.contains(word), "{bad}: {}", refusal.message);
        }
        // An uploaded file must fulfil the same conditions.
        let refusal = files(&format!("sensor = \"{}\"", sensor.name())).unwrap_err();
        assert!(
            refusal.message.contains("without slashes"),
            "{}",
            refusal.message
        );
    }
}

//! Keys that a scene file may contain, from its schema.

use super::file::schema_value;
use serde_json::Value;
use std::sync::LazyLock;

static KEYS: LazyLock<Vec<String>> = LazyLock::new(|| {
    let schema = schema_value();
    let mut keys = Vec::new();
    collect(&schema, &schema, "", &mut keys);
    keys
});

/// Returns all dotted keys; a table precedes its content.
pub(super) fn all() -> impl Iterator<Item = &'static str> {
    KEYS.iter().map(String::as_str)
}

/// Returns the keys inside the table `key`; empty if `key` is not a table.
pub(super) fn inside(key: &str) -> impl Iterator<Item = &'static str> {
    all().filter(move |known| {
        known
            .strip_prefix(key)
            .is_some_and(|rest| rest.starts_with('.'))
    })
}

fn collect(root: &Value, schema: &Value, prefix: &str, keys: &mut Vec<String>) {
    // The schema of an optional table is a choice between the table and null.
    for choice in schema["anyOf"].as_array().into_iter().flatten() {
        collect(root, choice, prefix, keys);
    }
    if let Some(name) = schema["$ref"].as_str() {
        let table = root.pointer(name.trim_start_matches('#'));
        collect(root, table.unwrap_or(&Value::Null), prefix, keys);
    }
    for (name, inner) in schema["properties"].as_object().into_iter().flatten() {
        let key = match prefix {
            "" => name.clone(),
            _ => format!("{prefix}.{name}"),
        };
        keys.push(key.clone());
        collect(root, inner, &key, keys);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_hold_keys_and_values_do_not() {
        let inside = |key| inside(key).count();
        assert!(all().any(|key| key == "laser.line.fan_deg"));
        assert!(all().any(|key| key == "seed"));
        for table in ["part", "part.sphere", "scan.rotary", "camera.distortion"] {
            assert!(inside(table) > 1, "{table}");
        }
        for value in [
            "seed",
            "camera.resolution_px",
            "camera.aperture_shape",
            "las",
        ] {
            assert_eq!(inside(value), 0, "{value}");
        }
    }
}

//! Access to the values of a scene by dotted key.

use toml::{Table, Value};

/// Keys whose values are file names, in addition to the files of objects.
const FILE_KEYS: [&str; 7] = [
    "part.mesh.file",
    "inspect.nominal.file",
    "part.instances",
    "scan.poses",
    "scan.frame_times",
    "measure.calibration",
    LINE_PROFILE,
];
/// File of a measured line profile.
pub const LINE_PROFILE: &str = "laser.line.profile.file";

/// Calls `change` with each file name of a scene.
pub fn change_files(table: &mut Table, change: &mut dyn FnMut(&mut String)) {
    for key in FILE_KEYS {
        let names = match at(table, key) {
            Some(Value::Array(names)) => names.iter_mut().collect(),
            one => Vec::from_iter(one),
        };
        for name in names {
            if let Value::String(name) = name {
                change(name);
            }
        }
    }
    let objects = table.get_mut("object").and_then(Value::as_array_mut);
    let objects = objects.into_iter().flatten();
    for object in objects.filter_map(Value::as_table_mut) {
        if let Some(Value::String(name)) = object.get_mut("file") {
            change(name);
        }
    }
}

/// Returns the value of a dotted key.
pub fn at<'a>(table: &'a mut Table, key: &str) -> Option<&'a mut Value> {
    match key.split_once('.') {
        None => table.get_mut(key),
        Some((first, rest)) => at(table.get_mut(first)?.as_table_mut()?, rest),
    }
}

/// Sets the value at a dotted key. A number in the key is the index of a list element
/// ("camera.resolution_px.0"). `None` removes the key. The error describes why the value cannot be
/// set.
pub fn set(root: &mut Value, key: &str, new: Option<Value>) -> Result<(), String> {
    let (tables, name) = key.rsplit_once('.').unwrap_or(("", key));
    let mut inside = root;
    let mut passed = String::new();
    for part in tables.split('.').filter(|_| !tables.is_empty()) {
        inside = match inside {
            Value::Table(table) => table
                .entry(part)
                .or_insert_with(|| Value::Table(Table::new())),
            Value::Array(list) => element(list, part, key)?,
            other => return Err(no_table(key, &passed, other)),
        };
        passed = part.to_owned();
    }
    match (inside, new) {
        (Value::Table(table), Some(new)) => {
            table.insert(name.to_owned(), new);
        }
        (Value::Table(table), None) => {
            if table.remove(name).is_none() {
                return Err(format!(
                    "{key}: found None, which takes a key out, but the scene does not have it"
                ));
            }
        }
        (Value::Array(list), Some(new)) => *element(list, name, key)? = new,
        (Value::Array(_), None) => {
            return Err(format!("{key}: found None, expected a value for the list"));
        }
        (other, _) => return Err(no_table(key, &passed, other)),
    }
    Ok(())
}

fn element<'a>(list: &'a mut [Value], part: &str, key: &str) -> Result<&'a mut Value, String> {
    let count = list.len();
    let found = part.parse().ok().and_then(|i: usize| list.get_mut(i));
    found.ok_or_else(|| {
        format!("{key}: found {part:?}, expected a whole number below {count}, the list's length")
    })
}

fn no_table(key: &str, passed: &str, value: &Value) -> String {
    let kind = value.type_str();
    format!("{key}: {passed} is a value ({kind}), expected a table or a list")
}

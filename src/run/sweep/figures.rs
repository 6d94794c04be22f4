//! Numbers of a summary by name.

use serde::Serialize;
use serde_json::Value;
use std::collections::BTreeMap;

/// Figures by dotted name, for example `deviation.std_um`.
pub type Figures = BTreeMap<String, f64>;

/// Returns all numbers of a value in its JSON form. For pairs in a list, the first element becomes
/// part of the name. For tables with a name, this name becomes part of it.
pub fn figures(of: &impl Serialize) -> Figures {
    let mut figures = Figures::new();
    let value = serde_json::to_value(of).expect("a summary is JSON");
    add(&mut figures, "", &value);
    figures
}

fn add(figures: &mut Figures, name: &str, value: &Value) {
    let below = |part: &str| match name {
        "" => part.to_owned(),
        _ => format!("{name}.{part}"),
    };
    match value {
        Value::Number(number) => {
            figures.extend(number.as_f64().map(|number| (name.to_owned(), number)));
        }
        Value::Object(table) => {
            let own = table.iter().filter(|(key, _)| *key != "name");
            own.for_each(|(key, value)| add(figures, &below(key), value));
        }
        Value::Array(list) => {
            for item in list {
                match (item, item.as_array().map(Vec::as_slice)) {
                    (_, Some([Value::String(label), value])) => add(figures, &below(label), value),
                    (_, Some([Value::Number(label), value])) => {
                        add(
                            figures,
                            &below(&label.as_f64().unwrap_or(0.0).to_string()),
                            value,
                        );
                    }
                    (Value::Object(table), _) => {
                        if let Some(Value::String(label)) = table.get("name") {
                            add(figures, &below(label), item);
                        }
                    }
                    _ => {}
                }
            }
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn numbers_are_found_by_name() {
        let found = figures(&json!({
            "scene": "x.toml", "none": null, "points": 3, "deviation": { "mean_um": -0.25 },
            "percentiles": [[1.0, 2.5], [99.5, 3.5]], "shares": [["weak-signal", 0.5]],
            "regions": [{ "name": "boss", "fail": 2 }], "plain": [1, 2, 3]
        }));
        let expected = [
            ("deviation.mean_um", -0.25),
            ("percentiles.1", 2.5),
            ("percentiles.99.5", 3.5),
            ("points", 3.0),
            ("regions.boss.fail", 2.0),
            ("shares.weak-signal", 0.5),
        ];
        let expected = expected.map(|(name, value)| (name.to_owned(), value));
        assert_eq!(found, Figures::from(expected));
    }
}

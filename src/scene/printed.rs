//! Printed numbers of a data sheet.

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Deserialize, Deserializer, Error, SeqAccess, Visitor};
use std::borrow::Cow;
use std::fmt;

/// Printed value that may be a range: a number, or a list of two numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PrintedRange {
    /// First number; the only number of a single value.
    pub first: f64,
    /// Second number; equal to the first for a single value.
    pub last: f64,
}

impl PrintedRange {
    pub fn is_single(&self) -> bool {
        self.first == self.last
    }

    /// Returns the smaller number.
    pub fn least(&self) -> f64 {
        self.first.min(self.last)
    }
}

/// Returns half a unit in the last decimal of a printed number.
pub fn rounding(value: f64) -> f64 {
    let text = format!("{value}");
    let decimals = text
        .split_once('.')
        .map_or(0, |(_, decimals)| decimals.len());
    0.5 * 10f64.powi(-(decimals as i32))
}

impl<'de> Deserialize<'de> for PrintedRange {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<PrintedRange, D::Error> {
        deserializer.deserialize_any(PrintedRangeVisitor)
    }
}

struct PrintedRangeVisitor;

impl<'de> Visitor<'de> for PrintedRangeVisitor {
    type Value = PrintedRange;

    fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
        formatter.write_str("a number or a list of two numbers")
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<PrintedRange, E> {
        self.visit_f64(value as f64)
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<PrintedRange, E> {
        self.visit_f64(value as f64)
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<PrintedRange, E> {
        Ok(PrintedRange {
            first: value,
            last: value,
        })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<PrintedRange, A::Error> {
        let mut numbers = Vec::new();
        while let Some(number) = list.next_element::<f64>()? {
            numbers.push(number);
        }
        match numbers[..] {
            [first, last] => Ok(PrintedRange { first, last }),
            _ => Err(A::Error::invalid_length(numbers.len(), &self)),
        }
    }
}

impl JsonSchema for PrintedRange {
    fn schema_name() -> Cow<'static, str> {
        "PrintedRange".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "description": "Printed value: a number, or a list of two numbers.",
            "anyOf": [
                { "type": "number" },
                { "type": "array", "items": { "type": "number" }, "minItems": 2, "maxItems": 2 }
            ]
        })
    }
}

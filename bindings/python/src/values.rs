//! Values of a scene: conversion from Python to TOML, and access by dotted key.

use crate::Error;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple};
use toml::{Table, Value};

/// Maximum nesting depth of tables: more than any scene needs, and safe for the stack.
const DEEPEST: usize = 16;

/// Converts a dict to a table and omits keys with the value None.
pub fn table(dict: &Bound<'_, PyDict>) -> PyResult<Table> {
    match value(dict.as_any(), "", DEEPEST)? {
        Some(Value::Table(table)) => Ok(table),
        _ => unreachable!("a dict gives a table"),
    }
}

/// Sets values at dotted keys; a number is the index of a list element ("camera.resolution_px.0").
/// None removes a value.
pub fn change(table: Table, values: &Bound<'_, PyDict>) -> PyResult<Table> {
    let mut root = Value::Table(table);
    for (key, given) in values {
        let key = text(&key, "a key")?;
        let new = value(&given, &key, DEEPEST)?;
        lasertrace::scene::set_value(&mut root, &key, new).map_err(Error::new_err)?;
    }
    match root {
        Value::Table(table) => Ok(table),
        _ => unreachable!("nothing takes the place of the root"),
    }
}

/// Converts a Python value; None becomes `None`.
fn value(given: &Bound<'_, PyAny>, key: &str, depth: usize) -> PyResult<Option<Value>> {
    let Some(deeper) = depth.checked_sub(1) else {
        let message = format!("{key}: found tables and lists more than {DEEPEST} deep");
        return Err(Error::new_err(message));
    };
    Ok(Some(if given.is_none() {
        return Ok(None);
    } else if let Ok(is) = given.cast::<PyBool>() {
        Value::Boolean(is.is_true())
    } else if let Ok(number) = given.cast::<PyInt>() {
        Value::Integer(number.extract().map_err(|_| {
            let message = "expected a whole number that fits 64 bits";
            Error::new_err(format!("{key}: found an int beyond that, {message}"))
        })?)
    } else if let Ok(number) = given.cast::<PyFloat>() {
        Value::Float(number.extract()?)
    } else if given.is_instance_of::<PyString>() {
        Value::String(text(given, key)?)
    } else if let Ok(dict) = given.cast::<PyDict>() {
        let mut table = Table::new();
        for (name, inner) in dict {
            let name = text(&name, &format!("a key in {key:?}"))?;
            let inside = match key {
                "" => name.clone(),
                _ => format!("{key}.{name}"),
            };
            if let Some(inner) = value(&inner, &inside, deeper)? {
                table.insert(name, inner);
            }
        }
        Value::Table(table)
    } else if given.is_instance_of::<PyList>() || given.is_instance_of::<PyTuple>() {
        let elements = given.try_iter()?.enumerate().map(|(i, inner)| {
            let inside = format!("{key}.{i}");
            value(&inner?, &inside, deeper)?
                .ok_or_else(|| Error::new_err(format!("{inside}: found None, expected a value")))
        });
        Value::Array(elements.collect::<PyResult<_>>()?)
    } else if given.hasattr("tolist")? {
        // NumPy arrays and scalars.
        return value(&given.call_method0("tolist")?, key, deeper);
    } else if given.hasattr("__fspath__")? {
        Value::String(text(&given.call_method0("__fspath__")?, key)?)
    } else {
        let found = given.get_type().name()?;
        return Err(Error::new_err(format!(
            "{key}: found a value of type {found}, expected a number, bool, text, list, dict or \
             NumPy array"
        )));
    }))
}

fn text(given: &Bound<'_, PyAny>, what: &str) -> PyResult<String> {
    given.extract::<String>().map_err(|_| {
        let found = given.get_type();
        Error::new_err(format!("{what}: found a {found}, expected text (str)"))
    })
}

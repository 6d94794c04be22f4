//! Native part of the Python package `lasertrace`, a thin layer over the simulator.
//!
//! The documentation for Python users is in the doc comments of the classes and, with types, in
//! python/lasertrace/_core.pyi.

mod arrays;
mod rays;
mod recent;
mod scene;
mod simulation;
mod threads;
mod values;

use pyo3::prelude::*;

pyo3::create_exception!(
    lasertrace,
    Error,
    pyo3::exceptions::PyValueError,
    "What cannot be done: the message says what was found, what was expected and what to do."
);

/// Converts an error of the simulator to a Python exception.
fn raised(error: lasertrace::Error) -> PyErr {
    let message = error.to_string();
    match error {
        lasertrace::Error::Memory { .. } | lasertrace::Error::Exhausted(_) => {
            pyo3::exceptions::PyMemoryError::new_err(message)
        }
        _ => Error::new_err(message),
    }
}

#[pymodule]
fn _core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    arrays::prepare(module.py())?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("Error", module.py().get_type::<Error>())?;
    module.add("FLAGS", simulation::flags())?;
    module.add_class::<scene::Scene>()?;
    module.add_class::<simulation::Simulation>()?;
    module.add_class::<simulation::Frames>()?;
    module.add_class::<simulation::Frame>()?;
    module.add_class::<rays::RayCaster>()?;
    module.add_function(wrap_pyfunction!(rays::engine, module)?)
}

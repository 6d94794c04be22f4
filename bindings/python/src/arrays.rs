//! NumPy arrays: numeric input without copies, and structured arrays as output.

use crate::Error;
use lasertrace::accel::SurfacePoint;
use numpy::ndarray::ArrayView2;
use numpy::{
    Element, PyArray1, PyArrayDescr, PyArrayDescrMethods, PyArrayMethods, PyReadonlyArray2,
    PyReadwriteArray1, PyUntypedArray, PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyDict, PyTuple};
use std::mem::offset_of;

/// Rows of float32 or float64 numbers. They are copied only if NumPy cannot provide a view as rows.
pub enum Rows<'py> {
    Single(PyReadonlyArray2<'py, f32>),
    Double(PyReadonlyArray2<'py, f64>),
}

impl<'py> Rows<'py> {
    /// Reads an array of shape (..., `width`). Returns its rows and its shape without the last
    /// axis.
    pub fn read(
        given: &Bound<'py, PyAny>,
        name: &str,
        width: usize,
    ) -> PyResult<(Rows<'py>, Vec<usize>)> {
        let (rows, shape) = rows(given, name, width, "float32 or float64")?;
        if let Ok(array) = rows.extract() {
            return Ok((Rows::Double(array), shape));
        }
        let array = rows
            .extract()
            .map_err(|_| unlike(given, name, width, "float32 or float64"));
        Ok((Rows::Single(array?), shape))
    }

    pub fn view(&self) -> View<'_> {
        match self {
            Rows::Single(array) => View::Single(array.as_array()),
            Rows::Double(array) => View::Double(array.as_array()),
        }
    }
}

/// View of [`Rows`] that can be used without the GIL.
#[derive(Clone, Copy)]
pub enum View<'a> {
    Single(ArrayView2<'a, f32>),
    Double(ArrayView2<'a, f64>),
}

impl View<'_> {
    pub fn len(&self) -> usize {
        match self {
            View::Single(rows) => rows.nrows(),
            View::Double(rows) => rows.nrows(),
        }
    }

    /// Returns N numbers of a row.
    pub fn row<const N: usize>(&self, i: usize) -> [f64; N] {
        match self {
            View::Single(rows) => numbers(rows, i),
            View::Double(rows) => numbers(rows, i),
        }
    }
}

fn numbers<T: Copy + Into<f64>, const N: usize>(rows: &ArrayView2<T>, i: usize) -> [f64; N] {
    let row = rows.row(i);
    // Checks the strides once for all numbers.
    match row.to_slice().and_then(|row| row.first_chunk::<N>()) {
        Some(row) => row.map(Into::into),
        None => std::array::from_fn(|k| row[k].into()),
    }
}

/// Reads triangles: rows of three integers of any type.
pub fn triangles(given: &Bound<'_, PyAny>) -> PyResult<Vec<[u32; 3]>> {
    const KINDS: &str = "whole numbers (int32, int64, uint32 or uint64)";
    let (rows, _) = rows(given, "triangles", 3, KINDS)?;
    macro_rules! of_type {
        ($($number:ty),*) => {$(
            if let Ok(array) = rows.extract::<PyReadonlyArray2<$number>>() {
                return array.as_array().rows().into_iter().enumerate().map(|(i, row)| {
                    let mut triangle = [0; 3];
                    for (to, &from) in triangle.iter_mut().zip(row) {
                        *to = u32::try_from(from).map_err(|_| Error::new_err(format!(
                            "triangle {i} uses vertex {from}, expected a number from 0"
                        )))?;
                    }
                    Ok(triangle)
                }).collect();
            }
        )*};
    }
    of_type!(i64, i32, u32, u64);
    Err(unlike(given, "triangles", 3, KINDS))
}

/// Returns an array of shape (..., `width`) reshaped to two axes, and its shape without the last
/// axis. Memory is copied only if its layout requires it.
fn rows<'py>(
    given: &Bound<'py, PyAny>,
    name: &str,
    width: usize,
    kinds: &str,
) -> PyResult<(Bound<'py, PyAny>, Vec<usize>)> {
    let wrong = || unlike(given, name, width, kinds);
    given.cast::<PyUntypedArray>().map_err(|_| wrong())?;
    // A subclass of ndarray may override methods, so it is converted to a plain array.
    let array = given
        .py()
        .import("numpy")?
        .call_method1("asarray", (given,))?;
    let array = array.cast::<PyUntypedArray>().map_err(|_| wrong())?;
    let Some((&last, shape)) = array.shape().split_last() else {
        return Err(wrong());
    };
    if last != width {
        return Err(wrong());
    }
    let rows = array.call_method1("reshape", ((shape.iter().product::<usize>(), width),))?;
    // Numbers in packed records may be misaligned.
    let whole = {
        let rows = rows.cast::<PyUntypedArray>().map_err(|_| wrong())?;
        let size = rows.dtype().itemsize().max(1) as isize;
        let aligned = rows.getattr("flags")?.getattr("aligned")?.is_truthy()?;
        aligned && rows.strides().iter().all(|stride| stride % size == 0)
    };
    match whole {
        true => Ok((rows, shape.to_vec())),
        false => Ok((rows.call_method0("copy")?, shape.to_vec())),
    }
}

fn found(given: &Bound<'_, PyAny>) -> String {
    match given.cast::<PyUntypedArray>() {
        Ok(array) => format!(
            "an array of {} and shape {:?}",
            array.dtype(),
            array.shape()
        ),
        Err(_) => format!("a {}", given.get_type()),
    }
}

fn unlike(given: &Bound<'_, PyAny>, name: &str, width: usize, kinds: &str) -> PyErr {
    let found = found(given);
    Error::new_err(format!(
        "{name}: found {found}, expected a NumPy array of {kinds} and shape (..., {width}); \
         numpy.asarray and .astype make one"
    ))
}

/// A measured point with the layout of the NumPy record.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Point {
    pub position: [f64; 3],
    pub u_position: f64,
    pub deviation: f64,
    pub u_deviation: f64,
    pub repeatability: f64,
    pub correlation_length: f64,
    pub scan_correlation_length: f64,
    pub intensity: f64,
    pub row: f64,
    pub normal: [f32; 3],
    pub column: u32,
    pub frame: u32,
    pub flags: u32,
}

// SAFETY: the record lists every field of `Point` with its offset and size. There is no padding
// between fields, and the record contains no Python object.
unsafe impl Element for Point {
    const IS_COPY: bool = true;

    fn get_dtype(py: Python<'_>) -> Bound<'_, PyArrayDescr> {
        POINT.of(py)
    }

    fn clone_ref(&self, _: Python<'_>) -> Self {
        *self
    }
}

/// A point on the mesh with the layout of the NumPy record.
#[repr(transparent)]
#[derive(Clone, Copy)]
pub struct Place(SurfacePoint);

// SAFETY: as for `Point`. `Place` has the memory layout of `SurfacePoint`, which is `repr(C)`
// without padding.
unsafe impl Element for Place {
    const IS_COPY: bool = true;

    fn get_dtype(py: Python<'_>) -> Bound<'_, PyArrayDescr> {
        PLACE.of(py)
    }

    fn clone_ref(&self, _: Python<'_>) -> Self {
        *self
    }
}

/// NumPy dtype of a record. NumPy creates it in Python code, where Ctrl-C and other signal handlers
/// raise exceptions. It is therefore created once, at import of the module.
struct Record {
    fields: &'static [(&'static str, &'static str, usize)],
    size: usize,
    made: PyOnceLock<Py<PyArrayDescr>>,
}

static POINT: Record = Record {
    fields: &[
        ("position", "3f8", offset_of!(Point, position)),
        ("u_position", "f8", offset_of!(Point, u_position)),
        ("deviation", "f8", offset_of!(Point, deviation)),
        ("u_deviation", "f8", offset_of!(Point, u_deviation)),
        ("repeatability", "f8", offset_of!(Point, repeatability)),
        (
            "correlation_length",
            "f8",
            offset_of!(Point, correlation_length),
        ),
        (
            "scan_correlation_length",
            "f8",
            offset_of!(Point, scan_correlation_length),
        ),
        ("intensity", "f8", offset_of!(Point, intensity)),
        ("row", "f8", offset_of!(Point, row)),
        ("normal", "3f4", offset_of!(Point, normal)),
        ("column", "u4", offset_of!(Point, column)),
        ("frame", "u4", offset_of!(Point, frame)),
        ("flags", "u4", offset_of!(Point, flags)),
    ],
    size: size_of::<Point>(),
    made: PyOnceLock::new(),
};

static PLACE: Record = Record {
    fields: &[
        ("distance", "f8", offset_of!(SurfacePoint, distance)),
        ("point", "3f8", offset_of!(SurfacePoint, point)),
        ("barycentric", "2f8", offset_of!(SurfacePoint, barycentric)),
        ("triangle", "u4", offset_of!(SurfacePoint, triangle)),
        ("instance", "u4", offset_of!(SurfacePoint, instance)),
    ],
    size: size_of::<Place>(),
    made: PyOnceLock::new(),
};

impl Record {
    fn make<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDescr>> {
        let dict = PyDict::new(py);
        let [mut names, mut formats, mut offsets] = [const { Vec::new() }; 3];
        for &(name, format, offset) in self.fields {
            names.push(name.into_pyobject(py)?.into_any());
            formats.push(format.into_pyobject(py)?.into_any());
            offsets.push(offset.into_pyobject(py)?.into_any());
        }
        dict.set_item("names", names)?;
        dict.set_item("formats", formats)?;
        dict.set_item("offsets", offsets)?;
        dict.set_item("itemsize", self.size)?;
        PyArrayDescr::new(py, dict)
    }

    fn of<'py>(&self, py: Python<'py>) -> Bound<'py, PyArrayDescr> {
        let made = self.made.get(py).expect("the module was imported");
        made.bind(py).clone()
    }
}

/// Runs Python code that NumPy executes on first use, so that it is not interrupted later.
pub fn prepare(py: Python<'_>) -> PyResult<()> {
    for record in [&POINT, &PLACE] {
        let made = || record.make(py).map(Bound::unbind);
        record.made.get_or_try_init(py, made)?;
    }
    // Loads NumPy's C API and its registry of borrowed arrays.
    let array = PyArray1::<bool>::zeros(py, 1, false);
    drop(writable(&array)?);
    Ok(())
}

/// Returns the output array: `out` if given, otherwise a new array with the given shape. The memory
/// of a new array is first touched by the threads that fill it. Returns an error if memory is
/// insufficient or if `out` is not suitable.
pub fn room<'py, T: Answer>(
    py: Python<'py>,
    out: Option<&Bound<'py, PyAny>>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArray1<T>>> {
    let count = shape.iter().product::<usize>();
    let Some(out) = out else {
        use lasertrace::mesh::memory;
        let bytes = (count as u64).saturating_mul(size_of::<T>() as u64);
        memory::require(
            format!("an array of {count} answers"),
            bytes,
            memory::available(),
        )
        .map_err(crate::raised)?;
        let array = py
            .import("numpy")?
            .call_method1(T::MADE_BY, (count, T::get_dtype(py)))?;
        return Ok(array.cast_into()?);
    };
    let fits = |array: &Bound<'_, PyUntypedArray>| {
        // NumPy regards records at any address as aligned, so the address is checked here.
        let address = array.getattr("ctypes")?.getattr("data")?;
        let aligned = address.extract::<usize>()? % align_of::<T>() == 0;
        let writeable = array.getattr("flags")?.getattr("writeable")?.is_truthy()?;
        let same = array.dtype().is_equiv_to(&T::get_dtype(py)) && array.shape() == shape;
        PyResult::Ok(same && aligned && writeable && array.is_c_contiguous())
    };
    match out.cast::<PyUntypedArray>() {
        Ok(array) if fits(array)? => {
            let row = array.call_method1("reshape", ((count,),))?;
            Ok(row.cast_into()?)
        }
        _ => Err(Error::new_err(format!(
            "out: found {}, expected an array as an earlier call returned it for shape {shape:?}: \
             writable, without gaps",
            found(out)
        ))),
    }
}

/// Type of a result for rays and points.
pub trait Answer: Element {
    /// NumPy function that creates an array: "empty", which uses large pages, if any bit pattern is
    /// valid, otherwise "zeros".
    const MADE_BY: &str;
}

impl Answer for bool {
    const MADE_BY: &str = "zeros";
}

impl Answer for Place {
    const MADE_BY: &str = "empty";
}

impl Answer for f64 {
    const MADE_BY: &str = "empty";
}

impl Answer for u64 {
    const MADE_BY: &str = "empty";
}

/// Returns an array of points.
pub fn of_points(py: Python<'_>, points: Vec<SurfacePoint>) -> Bound<'_, PyArray1<Place>> {
    let points: Vec<Place> = points.into_iter().map(Place).collect();
    PyArray1::from_vec(py, points)
}

/// Returns the memory of an array created by [`room`]. Returns an error if another thread accesses
/// the memory, or if it overlaps the input.
pub fn writable<'py, T: Element>(
    array: &Bound<'py, PyArray1<T>>,
) -> PyResult<PyReadwriteArray1<'py, T>> {
    array.try_readwrite().map_err(|_| {
        let why = "it shares memory with what is read, or another thread writes to it";
        Error::new_err(format!(
            "out: found an array in use ({why}), expected one of its own"
        ))
    })
}

/// Returns the memory as the type that the simulator writes.
pub fn places(places: &mut [Place]) -> &mut [SurfacePoint] {
    // SAFETY: `Place` is a transparent wrapper of `SurfacePoint`; address and length are unchanged.
    unsafe { std::slice::from_raw_parts_mut(places.as_mut_ptr().cast(), places.len()) }
}

/// Reshapes an array with one result per ray to the shape of the rays.
pub fn shaped<'py>(array: &Bound<'py, PyAny>, shape: &[usize]) -> PyResult<Bound<'py, PyAny>> {
    array.call_method1("reshape", (PyTuple::new(array.py(), shape)?,))
}

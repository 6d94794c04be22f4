//! Extent of long tests.

/// Returns `all` if the environment variable `LASERTRACE_LONG_TESTS` is set, as in `make verify`, and
/// `few` otherwise.
pub fn extent<T>(few: T, all: T) -> T {
    match std::env::var_os("LASERTRACE_LONG_TESTS") {
        Some(_) => all,
        None => few,
    }
}

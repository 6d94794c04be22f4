//! Deserialization of arrays of a fixed length.

use serde::Deserialize;

/// Deserializes an array of exactly `N` elements. The implementation in serde accepts a longer
/// array and takes its first `N` elements.
pub(super) fn array<'de, D, T, const N: usize>(deserializer: D) -> Result<[T; N], D::Error>
where
    D: serde::Deserializer<'de>,
    T: Deserialize<'de>,
{
    let values = Vec::<T>::deserialize(deserializer)?;
    let length = values.len();
    let expected = format!("an array of length {N}");
    values
        .try_into()
        .map_err(|_| serde::de::Error::invalid_length(length, &expected.as_str()))
}

pub(super) fn optional_array<'de, D, T, const N: usize>(
    deserializer: D,
) -> Result<Option<[T; N]>, D::Error>
where
    D: serde::Deserializer<'de>,
    T: Deserialize<'de>,
{
    array(deserializer).map(Some)
}

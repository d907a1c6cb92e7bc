//! Checkpoints: safetensors with the checks the format leaves to us.
//!
//! Layout: u64 header length, JSON header (names, types, shapes, offsets, `__metadata__`), raw
//! little-endian data. The header is written here, sorted, because the crate's writer takes a hash
//! map and so gives other bytes each time; on reading, the crate checks offsets and we check what
//! it accepts: duplicate names, NaN, and headers that take seconds.

use super::json::parse_json;
use super::limits::Limits;
use super::read::read_bytes;
use super::read_error::ReadError;
use super::write::{WriteError, write_atomic};
use safetensors::{Dtype, SafeTensors};
use std::collections::BTreeMap;
use std::path::Path;

const MAX_HEADER: u64 = 1 << 20;
const MAX_NAMES: usize = 10_000;

/// The values of one tensor, row-major.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub enum TensorValues {
    F32(Vec<f32>),
    F64(Vec<f64>),
    U32(Vec<u32>),
    U64(Vec<u64>),
}

impl TensorValues {
    /// Returns the number of values.
    pub fn len(&self) -> usize {
        match self {
            TensorValues::F32(v) => v.len(),
            TensorValues::F64(v) => v.len(),
            TensorValues::U32(v) => v.len(),
            TensorValues::U64(v) => v.len(),
        }
    }

    fn dtype(&self) -> (&'static str, usize) {
        match self {
            TensorValues::F32(_) => ("F32", 4),
            TensorValues::F64(_) => ("F64", 8),
            TensorValues::U32(_) => ("U32", 4),
            TensorValues::U64(_) => ("U64", 8),
        }
    }

    /// Returns the first value that is NaN or infinite.
    fn not_finite(&self) -> Option<usize> {
        match self {
            TensorValues::F32(v) => v.iter().position(|x| !x.is_finite()),
            TensorValues::F64(v) => v.iter().position(|x| !x.is_finite()),
            _ => None,
        }
    }

    fn append_to(&self, out: &mut Vec<u8>) {
        match self {
            TensorValues::F32(v) => v.iter().for_each(|x| out.extend(x.to_le_bytes())),
            TensorValues::F64(v) => v.iter().for_each(|x| out.extend(x.to_le_bytes())),
            TensorValues::U32(v) => v.iter().for_each(|x| out.extend(x.to_le_bytes())),
            TensorValues::U64(v) => v.iter().for_each(|x| out.extend(x.to_le_bytes())),
        }
    }
}

/// The content of a checkpoint: tensors by name, and `__metadata__`.
pub type Tensors = (BTreeMap<String, (Vec<usize>, TensorValues)>, BTreeMap<String, String>);

/// Writes a safetensors file in one step; the same content gives the same bytes, in whatever order
/// the tensors come. Refused: a name given twice, a shape that does not fit its values, NaN and
/// Inf.
pub fn write_tensors(
    path: &Path,
    tensors: &[(String, Vec<usize>, TensorValues)],
    metadata: &BTreeMap<String, String>,
) -> Result<(), WriteError> {
    let bytes = tensor_bytes(tensors, metadata).map_err(|problem| WriteError::content(path, problem))?;
    write_atomic(path, &bytes)
}

/// Returns the bytes [`write_tensors`] writes, or what is wrong with the content.
pub fn tensor_bytes(
    tensors: &[(String, Vec<usize>, TensorValues)],
    metadata: &BTreeMap<String, String>,
) -> Result<Vec<u8>, String> {
    let mut sorted: Vec<_> = tensors.iter().collect();
    // wide values first keeps every tensor aligned to its own width
    sorted.sort_by(|a, b| (b.2.dtype().1, &a.0).cmp(&(a.2.dtype().1, &b.0)));
    let mut header = serde_json::Map::new();
    if !metadata.is_empty() {
        header.insert("__metadata__".into(), serde_json::json!(metadata));
    }
    let mut end = 0;
    for (name, shape, values) in &sorted {
        let count = shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
        if count != Some(values.len()) {
            return Err(format!("tensor `{name}` has shape {shape:?} but {} values", values.len()));
        }
        if let Some(i) = values.not_finite() {
            return Err(format!("tensor `{name}` is not finite at index {i}"));
        }
        let (dtype, width) = values.dtype();
        let begin = end;
        end += values.len() * width;
        let entry = serde_json::json!({"dtype": dtype, "shape": shape, "data_offsets": [begin, end]});
        if name == "__metadata__" || header.insert(name.clone(), entry).is_some() {
            return Err(format!("the name `{name}` cannot be given (again) to a tensor"));
        }
    }
    // serde_json's map is sorted by key, so the text is the same every time
    let mut text = serde_json::Value::Object(header).to_string().into_bytes();
    text.resize(text.len().next_multiple_of(8), b' ');
    if text.len() as u64 > MAX_HEADER || sorted.len() > MAX_NAMES {
        return Err(format!("{} tensors with a header of {} bytes are too many", sorted.len(), text.len()));
    }
    let mut out = Vec::with_capacity(8 + text.len() + end);
    out.extend((text.len() as u64).to_le_bytes());
    out.extend(text);
    for (_, _, values) in &sorted {
        values.append_to(&mut out);
    }
    Ok(out)
}

/// Reads a whole checkpoint or nothing: see [`parse_tensors`].
pub fn read_tensors(path: &Path, limits: &Limits) -> Result<Tensors, ReadError> {
    parse_tensors(path, &read_bytes(path, limits)?, limits)
}

/// Tensors and metadata in `bytes`; `path` is only for messages. Refused: headers over 1 MiB or 10
/// 000 names, duplicate names, overlaps and holes, types other than F32, F64, U32, U64, NaN and
/// Inf.
pub fn parse_tensors(path: &Path, bytes: &[u8], limits: &Limits) -> Result<Tensors, ReadError> {
    let bad = |offset: Option<u64>, problem: String| ReadError::damaged(path, "safetensors", offset, problem);
    let Some(length) = bytes.first_chunk::<8>().map(|b| u64::from_le_bytes(*b)) else {
        return Err(bad(Some(bytes.len() as u64), "it ends inside its header length".into()));
    };
    if length > MAX_HEADER {
        // a flipped bit in the first bytes gives such a length: damage, not a large file
        return Err(bad(Some(0), format!("its header claims {length} bytes, the limit is {MAX_HEADER}")));
    }
    let Some(header) = bytes.get(8..8 + length as usize) else {
        return Err(bad(Some(bytes.len() as u64), "it ends inside its header".into()));
    };
    // the JSON reader refuses what appears twice; the crate would keep the last
    let names = parse_json(path, header, limits)?.as_object().map_or(0, |o| o.len());
    if names > MAX_NAMES + 1 {
        return Err(ReadError::too_large(path, "the number of tensors", names as u64, MAX_NAMES as u64));
    }
    let file = SafeTensors::deserialize(bytes).map_err(|e| bad(None, e.to_string()))?;
    let (_, about) = SafeTensors::read_metadata(bytes).map_err(|e| bad(None, e.to_string()))?;
    let metadata = about.metadata().iter().flatten().map(|(k, v)| (k.clone(), v.clone())).collect();
    let mut tensors = BTreeMap::new();
    for (name, view) in file.tensors() {
        let data = view.data();
        let values = match view.dtype() {
            Dtype::F32 => TensorValues::F32(numbers(data, f32::from_le_bytes)),
            Dtype::F64 => TensorValues::F64(numbers(data, f64::from_le_bytes)),
            Dtype::U32 => TensorValues::U32(numbers(data, u32::from_le_bytes)),
            Dtype::U64 => TensorValues::U64(numbers(data, u64::from_le_bytes)),
            other => {
                let hint = "checkpoints hold F32, F64, U32 and U64; this one was not written by tiface";
                return Err(ReadError::unsupported(path, format!("tensor `{name}` of type {other:?}"), hint));
            }
        };
        if let Some(i) = values.not_finite() {
            return Err(bad(None, format!("tensor `{name}` is not finite at index {i}")));
        }
        tensors.insert(name, (view.shape().to_vec(), values));
    }
    Ok((tensors, metadata))
}

fn numbers<T, const N: usize>(data: &[u8], from: fn([u8; N]) -> T) -> Vec<T> {
    data.as_chunks::<N>().0.iter().map(|&c| from(c)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Vec<(String, Vec<usize>, TensorValues)> {
        vec![
            ("table".into(), vec![2, 2], TensorValues::F32(vec![1.0, -2.0, 3.5, 0.0])),
            ("random".into(), vec![1], TensorValues::U64(vec![u64::MAX])),
            ("index".into(), vec![3], TensorValues::U32(vec![1, 2, 3])),
            ("pose".into(), vec![], TensorValues::F64(vec![0.1])),
        ]
    }

    fn metadata() -> BTreeMap<String, String> {
        [("step", "7"), ("format", "1"), ("ä \"x\"", "\n")].map(|(k, v)| (k.into(), v.into())).into()
    }

    #[test]
    fn tensors_and_metadata_come_back_as_they_were() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("c.safetensors");
        write_tensors(&path, &sample(), &metadata()).unwrap();
        let (tensors, meta) = read_tensors(&path, &Limits::default()).unwrap();
        assert_eq!(meta, metadata());
        for (name, shape, values) in sample() {
            assert_eq!(tensors[&name], (shape, values));
        }
    }

    #[test]
    fn the_same_content_gives_the_same_bytes_in_any_order() {
        let mut turned = sample();
        turned.reverse();
        let a = tensor_bytes(&sample(), &metadata()).unwrap();
        assert_eq!(a, tensor_bytes(&turned, &metadata()).unwrap());
        // data starts at a multiple of 8
        assert_eq!((8 + u64::from_le_bytes(*a.first_chunk().unwrap())) % 8, 0);
    }

    #[test]
    fn what_could_not_be_read_back_is_not_written() {
        let nan = vec![("w".to_string(), vec![2], TensorValues::F32(vec![1.0, f32::NAN]))];
        assert!(tensor_bytes(&nan, &metadata()).unwrap_err().contains("index 1"));
        let mut twice = sample();
        twice.push(twice[0].clone());
        assert!(tensor_bytes(&twice, &metadata()).unwrap_err().contains("`table`"));
        let short = vec![("w".to_string(), vec![3], TensorValues::F32(vec![1.0]))];
        assert!(tensor_bytes(&short, &metadata()).is_err());
    }
}

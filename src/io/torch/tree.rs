//! From the objects of a pickle to a tree of values; here the numbers are read from their storages.

use super::super::{Limits, ReadError};
use super::objects::{Heap, Id, NumberType, NumpyArray, NumpyType, PickleObject, StridedTensor};
use super::pickle::MAX_VALUES;
use super::zip::Archive;
use super::{FORMAT, TorchNumbers, TorchTensor, TorchValue, shown};
use std::borrow::Cow;
use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::sync::Arc;

/// Nesting of lists, tuples and dictionaries; a checkpoint has four.
const MAX_DEPTH: usize = 64;
/// The widest reading: one byte of the pickle becomes an i64, and is counted itself.
const MAX_GROWTH: u64 = 9;

/// The tree below the pickle's result.
pub(super) fn build(
    path: &Path,
    (heap, root): (&Heap, Id),
    archive: &Archive,
    limits: &Limits,
) -> Result<TorchValue, ReadError> {
    let bytes_left = limits.decoded_bytes.min(archive.unpacked().saturating_mul(MAX_GROWTH));
    // torch writes the order of its machine since 2.1; before, only little-endian machines wrote
    let big = archive.get("byteorder") == Some(b"big");
    let seen = HashMap::new();
    let mut builder = Builder { path, heap, archive, big, seen, values: 0, bytes_left };
    builder.value(root, 0)
}

struct Builder<'a> {
    path: &'a Path,
    heap: &'a Heap<'a>,
    archive: &'a Archive,
    big: bool,
    /// What was decoded, by node: a shared object is one here too.
    seen: HashMap<Id, TorchValue>,
    values: usize,
    bytes_left: u64,
}

impl<'a> Builder<'a> {
    fn bad(&self, problem: impl Into<String>) -> ReadError {
        ReadError::damaged(self.path, FORMAT, None, problem)
    }

    fn value(&mut self, id: Id, depth: usize) -> Result<TorchValue, ReadError> {
        self.values += 1;
        if self.values > MAX_VALUES {
            return Err(self.bad(format!("shared objects unfold to more than {MAX_VALUES} values")));
        }
        if depth > MAX_DEPTH {
            return Err(self.bad(format!("its objects are nested deeper than {MAX_DEPTH}")));
        }
        let heap = self.heap;
        Ok(match heap.get(id) {
            PickleObject::None => TorchValue::None,
            PickleObject::Bool(value) => TorchValue::Bool(*value),
            PickleObject::Int(value) => TorchValue::Int(*value),
            PickleObject::Float(value) => TorchValue::Float(*value),
            PickleObject::List(items) => TorchValue::List(self.items(items, depth)?),
            PickleObject::Tuple(items) => TorchValue::Tuple(self.items(items, depth)?),
            PickleObject::Dict { ordered, pairs } => {
                let mut keys = HashSet::new();
                let mut out = Vec::new();
                for &(key, value) in pairs {
                    let TorchValue::Str(key) = self.value(key, depth + 1)? else {
                        return Err(self.bad("a dictionary has a key that is not text"));
                    };
                    if !keys.insert(key.clone()) {
                        let key = shown(key.as_bytes());
                        return Err(self.bad(format!("a dictionary has the key `{key}` twice")));
                    }
                    out.push((key, self.value(value, depth + 1)?));
                }
                if *ordered { TorchValue::OrderedDict(out) } else { TorchValue::Dict(out) }
            }
            PickleObject::Global(_) | PickleObject::Storage { .. } | PickleObject::Dtype(_) => {
                return Err(self.bad("a class, a storage or a type stands where a value should"));
            }
            PickleObject::Array(None) => return Err(self.bad("a numpy array without its values")),
            leaf => {
                if let Some(value) = self.seen.get(&id) {
                    return Ok(value.clone());
                }
                let value = self.leaf(leaf)?;
                self.seen.insert(id, value.clone());
                value
            }
        })
    }

    fn items(&mut self, items: &[Id], depth: usize) -> Result<Vec<TorchValue>, ReadError> {
        items.iter().map(|&id| self.value(id, depth + 1)).collect()
    }

    fn leaf(&mut self, node: &PickleObject) -> Result<TorchValue, ReadError> {
        match node {
            PickleObject::Str(range) => {
                self.spend(range.len())?;
                let text = std::str::from_utf8(&self.heap.pickle[range.clone()]);
                Ok(TorchValue::Str(text.map_err(|e| self.bad(e.to_string()))?.into()))
            }
            PickleObject::Tensor(view) => Ok(TorchValue::Tensor(Arc::new(self.tensor(view)?))),
            PickleObject::Array(Some(array)) => Ok(TorchValue::Array(Arc::new(self.array(array)?))),
            PickleObject::Scalar(number, data) => self.scalar(*number, *data),
            other => {
                let bytes = self.bytes(other)?;
                Ok(TorchValue::Bytes(bytes.into()))
            }
        }
    }

    fn spend(&mut self, bytes: usize) -> Result<(), ReadError> {
        match self.bytes_left.checked_sub(bytes as u64) {
            Some(left) => {
                self.bytes_left = left;
                Ok(())
            }
            None => Err(self.bad("its tensors share storages so often that they would not fit in memory")),
        }
    }

    /// The bytes of a bytes object.
    fn bytes(&mut self, node: &PickleObject) -> Result<Cow<'a, [u8]>, ReadError> {
        let pickle = self.heap.pickle;
        match node {
            PickleObject::Bytes(range) => {
                self.spend(range.len())?;
                Ok(Cow::Borrowed(&pickle[range.clone()]))
            }
            PickleObject::Latin1(range) => {
                self.spend(range.len())?;
                let text = std::str::from_utf8(&pickle[range.clone()]).unwrap_or_default();
                let narrow: Result<Vec<u8>, _> = text.chars().map(|c| u8::try_from(c as u32)).collect();
                narrow.map(Cow::Owned).map_err(|_| self.bad("bytes hold a character above 255"))
            }
            _ => Err(self.bad("something else stands where bytes should")),
        }
    }

    fn tensor(&mut self, view: &StridedTensor) -> Result<TorchTensor, ReadError> {
        let PickleObject::Storage { kind, key, count } = self.heap.get(view.storage) else {
            return Err(self.bad("a tensor without a storage"));
        };
        let name = shown(&self.heap.pickle[key.clone()]);
        let entry = format!("data/{}", String::from_utf8_lossy(&self.heap.pickle[key.clone()]));
        let Some(data) = self.archive.get(&entry) else {
            return Err(self.bad(format!("the storage `data/{name}` is missing")));
        };
        if count.checked_mul(kind.size()) != Some(data.len()) {
            let size = kind.size();
            let found = data.len();
            return Err(self.bad(format!(
                "the storage `data/{name}` should hold {count} values of {size} bytes and has {found} bytes"
            )));
        }
        let shape = &view.shape;
        let values = shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
        let last = shape.iter().zip(&view.strides).try_fold(view.offset, |last, (&size, &stride)| {
            last.checked_add(size.saturating_sub(1).checked_mul(stride)?)
        });
        let fits = |values: usize| values == 0 || (values <= *count && last.is_some_and(|l| l < *count));
        let Some(values) = values.filter(|&n| fits(n)) else {
            return Err(self.bad(format!(
                "a tensor of shape {shape:?} from value {} on does not fit its storage `data/{name}` of {count} \
                 values",
                view.offset
            )));
        };
        self.spend(values.saturating_mul(decoded_size(*kind)))?;
        let number = NumpyType { kind: *kind, big: self.big };
        let values = if values == 0 {
            read(&[], number)
        } else if is_row_major(shape, &view.strides) {
            let start = view.offset * kind.size();
            read(&data[start..start + values * kind.size()], number)
        } else {
            gather(data, number, view, values)
        };
        Ok(TorchTensor { shape: shape.clone(), values })
    }

    fn array(&mut self, array: &NumpyArray) -> Result<TorchTensor, ReadError> {
        let data = self.bytes(self.heap.get(array.data))?;
        let shape = &array.shape;
        let size = array.number.kind.size();
        let count = shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
        let Some(count) = count.filter(|n| n.checked_mul(size) == Some(data.len())) else {
            let found = data.len();
            return Err(self.bad(format!(
                "a numpy array of shape {shape:?} and {size} bytes per value has {found} bytes"
            )));
        };
        self.spend(count.saturating_mul(decoded_size(array.number.kind)))?;
        let values = if array.fortran && count > 0 {
            // the first index runs fastest
            let mut strides = vec![1; shape.len()];
            for k in 1..shape.len() {
                strides[k] = strides[k - 1] * shape[k - 1];
            }
            let view = StridedTensor { storage: 0, offset: 0, shape: shape.clone(), strides };
            gather(&data, array.number, &view, count)
        } else {
            read(&data, array.number)
        };
        Ok(TorchTensor { shape: shape.clone(), values })
    }

    fn scalar(&mut self, number: NumpyType, data: Id) -> Result<TorchValue, ReadError> {
        let data = self.bytes(self.heap.get(data))?;
        if data.len() != number.kind.size() {
            return Err(self.bad(format!("a numpy number has {} bytes", data.len())));
        }
        if number.kind == NumberType::F64 {
            return Ok(TorchValue::Float(double(&data, number.big)));
        }
        Ok(match read(&data, number) {
            TorchNumbers::F32(v) => TorchValue::Float(v[0] as f64),
            TorchNumbers::I64(v) => TorchValue::Int(v[0]),
            TorchNumbers::U8(v) => TorchValue::Int(v[0] as i64),
            TorchNumbers::Bool(v) => TorchValue::Bool(v[0]),
        })
    }
}

fn decoded_size(kind: NumberType) -> usize {
    match kind {
        NumberType::F16 | NumberType::F32 | NumberType::F64 => 4,
        NumberType::U8 | NumberType::Bool => 1,
        _ => 8,
    }
}

/// Are the values next to each other in reading order? Strides of extents 1 do not matter.
fn is_row_major(shape: &[usize], strides: &[usize]) -> bool {
    let mut expected = 1usize;
    shape.iter().zip(strides).rev().all(|(&size, &stride)| {
        let fits = size == 1 || stride == expected;
        expected = expected.saturating_mul(size);
        fits
    })
}

/// The values of a view in reading order; every index was proved to be inside.
fn gather(data: &[u8], number: NumpyType, view: &StridedTensor, count: usize) -> TorchNumbers {
    let size = number.kind.size();
    let mut ordered = Vec::with_capacity(count * size);
    let mut index = vec![0; view.shape.len()];
    let mut at = view.offset;
    for _ in 0..count {
        ordered.extend_from_slice(&data[at * size..(at + 1) * size]);
        for axis in (0..index.len()).rev() {
            index[axis] += 1;
            at += view.strides[axis];
            if index[axis] < view.shape[axis] {
                break;
            }
            at -= view.strides[axis] * view.shape[axis];
            index[axis] = 0;
        }
    }
    read(&ordered, number)
}

/// Every number in `data`.
fn read(data: &[u8], number: NumpyType) -> TorchNumbers {
    let big = number.big;
    match number.kind {
        NumberType::F16 => TorchNumbers::F32(each(data, big, |b| half::f16::from_le_bytes(b).to_f32())),
        NumberType::F32 => TorchNumbers::F32(each(data, big, f32::from_le_bytes)),
        NumberType::F64 => TorchNumbers::F32(each(data, big, |b| f64::from_le_bytes(b) as f32)),
        NumberType::I8 => TorchNumbers::I64(each(data, big, |b| i8::from_le_bytes(b) as i64)),
        NumberType::I16 => TorchNumbers::I64(each(data, big, |b| i16::from_le_bytes(b) as i64)),
        NumberType::I32 => TorchNumbers::I64(each(data, big, |b| i32::from_le_bytes(b) as i64)),
        NumberType::I64 => TorchNumbers::I64(each(data, big, i64::from_le_bytes)),
        NumberType::U16 => TorchNumbers::I64(each(data, big, |b| u16::from_le_bytes(b) as i64)),
        NumberType::U32 => TorchNumbers::I64(each(data, big, |b| u32::from_le_bytes(b) as i64)),
        NumberType::U8 => TorchNumbers::U8(data.to_vec()),
        NumberType::Bool => TorchNumbers::Bool(data.iter().map(|&b| b != 0).collect()),
    }
}

fn double(data: &[u8], big: bool) -> f64 {
    each(data, big, f64::from_le_bytes).first().copied().unwrap_or_default()
}

fn each<T, const N: usize>(data: &[u8], big: bool, from: impl Fn([u8; N]) -> T) -> Vec<T> {
    let words = data.as_chunks::<N>().0.iter();
    if !big {
        return words.map(|&word| from(word)).collect();
    }
    words
        .map(|&(mut word)| {
            word.reverse();
            from(word)
        })
        .collect()
}

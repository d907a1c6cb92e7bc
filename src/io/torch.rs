//! PyTorch checkpoints (`.th`, `.pt`, `.pth`): a zip archive with a Python pickle and one entry per storage.
//!
//! A pickle is a program for a stack machine that may call any Python function. This reader knows the
//! opcodes `torch.save` writes and a closed list of names ([`objects`]), each of which has a fixed meaning
//! here; everything else is an error that says which name stood at which byte. Nothing is ever executed.
//! What comes out is bounded by what is in the file: a tensor has at most as many values as its storage,
//! shared objects are decoded once, and values, depth and bytes are counted.

mod objects;
mod pickle;
mod tree;
mod zip;

use super::{Limits, ReadError, read_bytes};
use std::path::Path;
use std::sync::Arc;

const FORMAT: &str = "torch checkpoint";
/// `torch.save` before 1.6: a pickle of this number stands first.
const LEGACY: &[u8] = b"\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19";

/// What a checkpoint holds, as far as it is data.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub enum TorchValue {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Str(Arc<str>),
    Bytes(Arc<[u8]>),
    List(Vec<TorchValue>),
    Tuple(Vec<TorchValue>),
    /// Keys are text and unique, in the order of the file.
    Dict(Vec<(Arc<str>, TorchValue)>),
    /// A `collections.OrderedDict`, as `state_dict()` gives.
    OrderedDict(Vec<(Arc<str>, TorchValue)>),
    /// A torch tensor.
    Tensor(Arc<TorchTensor>),
    /// A numpy array.
    Array(Arc<TorchTensor>),
}

/// Values in row-major order, whatever strides the file had.
#[derive(Clone, Debug, PartialEq)]
pub struct TorchTensor {
    /// Extents; empty for a single value.
    pub shape: Vec<usize>,
    /// The values.
    pub values: TorchNumbers,
}

/// The values of a [`TorchTensor`].
#[derive(Clone, Debug, PartialEq)]
pub enum TorchNumbers {
    /// From float16, float32 and, rounded, float64. May hold NaN and Inf.
    F32(Vec<f32>),
    /// From the integers other than uint8.
    I64(Vec<i64>),
    /// From uint8.
    U8(Vec<u8>),
    /// From bool.
    Bool(Vec<bool>),
}

impl TorchNumbers {
    /// How many values there are.
    pub fn len(&self) -> usize {
        match self {
            TorchNumbers::F32(v) => v.len(),
            TorchNumbers::I64(v) => v.len(),
            TorchNumbers::U8(v) => v.len(),
            TorchNumbers::Bool(v) => v.len(),
        }
    }

    /// Is there none?
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl TorchValue {
    /// The entry `key` of either kind of dictionary.
    pub fn get(&self, key: &str) -> Option<&TorchValue> {
        match self {
            TorchValue::Dict(pairs) | TorchValue::OrderedDict(pairs) => {
                pairs.iter().find(|(k, _)| &**k == key).map(|(_, v)| v)
            }
            _ => None,
        }
    }
}

/// Reads a checkpoint written by `torch.save`: see [`parse_torch`].
pub fn read_torch(path: &Path, limits: &Limits) -> Result<TorchValue, ReadError> {
    parse_torch(path, &read_bytes(path, limits)?, limits)
}

/// The object in `bytes`; `path` is only for messages. Storages of any device are read alike.
///
/// Refused: names and opcodes that are not on the list, files of torch before 1.6, tensors that reach
/// beyond their storage or have more values than it, entries that overlap, appear twice, fail their check
/// sum or unpack to over [`Limits::decoded_bytes`].
pub fn parse_torch(path: &Path, bytes: &[u8], limits: &Limits) -> Result<TorchValue, ReadError> {
    if !bytes.starts_with(b"PK\x03\x04") {
        if bytes[..bytes.len().min(64)].windows(LEGACY.len()).any(|w| w == LEGACY) {
            return Err(ReadError::Unsupported {
                path: path.into(),
                what: "a checkpoint in the format torch wrote before version 1.6".into(),
                hint: "where you trust the file: `torch.save(torch.load(OLD), NEW)` with a newer torch"
                    .into(),
            });
        }
        let problem = "it does not begin with `PK\\x03\\x04` as a zip archive does";
        return Err(ReadError::damaged(path, FORMAT, 0, problem));
    }
    let archive = zip::Archive::open(path, bytes, limits)?;
    let Some(pickle) = archive.get("data.pkl") else {
        return Err(ReadError::damaged(path, FORMAT, None, "the archive holds no `data.pkl`"));
    };
    let (heap, root) = pickle::run(path, pickle)?;
    tree::build(path, (&heap, root), &archive, limits)
}

/// Bytes from a file as they may stand in a message: short, and without control characters.
fn shown(bytes: &[u8]) -> String {
    let text: String = String::from_utf8_lossy(&bytes[..bytes.len().min(80)]).escape_debug().collect();
    if bytes.len() > 80 { text + "…" } else { text }
}

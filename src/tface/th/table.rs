//! Entries of a checkpoint's dictionaries, each taken as what it must be or named in an error.

use crate::io::{TorchNumbers, TorchTensor, TorchValue};
use crate::{Error, Result};
use std::path::Path;

/// Grid sizes, ranks, widths and frequencies beyond this are nonsense.
pub(super) const MAX_COUNT: usize = 1 << 16;

/// A dictionary of the checkpoint, with what a message about it must say.
pub(super) struct Table<'a> {
    pub(super) path: &'a Path,
    pub(super) name: &'a str,
    pub(super) values: &'a TorchValue,
}

impl<'a> Table<'a> {
    pub(super) fn wrong(&self, key: &str, found: String, expected: &str) -> Error {
        let key = if self.name.is_empty() { key.to_string() } else { format!("{}.{key}", self.name) };
        Error::cannot(
            format!("`{}`: `{key}` is {found}, expected {expected}", self.path.display()),
            "give a `.th` file as `TensorVMSplit.save` writes it; other checkpoints have other entries",
        )
    }

    pub(super) fn get(&self, key: &str) -> Result<&'a TorchValue> {
        self.values.get(key).ok_or_else(|| self.wrong(key, "missing".into(), "an entry"))
    }

    pub(super) fn keys(&self) -> impl Iterator<Item = &'a str> {
        let pairs: &[_] = match self.values {
            TorchValue::Dict(pairs) | TorchValue::OrderedDict(pairs) => pairs,
            _ => &[],
        };
        pairs.iter().map(|(key, _)| &**key)
    }

    pub(super) fn table(&self, key: &'a str) -> Result<Table<'a>> {
        match self.get(key)? {
            values @ (TorchValue::Dict(_) | TorchValue::OrderedDict(_)) => {
                Ok(Table { path: self.path, name: key, values })
            }
            other => Err(self.wrong(key, about(other), "a dictionary")),
        }
    }

    pub(super) fn text(&self, key: &str) -> Result<&'a str> {
        match self.get(key)? {
            TorchValue::Str(text) => Ok(text),
            other => Err(self.wrong(key, about(other), "text")),
        }
    }

    pub(super) fn items(&self, key: &str) -> Result<&'a [TorchValue]> {
        match self.get(key)? {
            TorchValue::List(items) | TorchValue::Tuple(items) => Ok(items),
            other => Err(self.wrong(key, about(other), "a list")),
        }
    }

    pub(super) fn number(&self, key: &str, least: f32) -> Result<f32> {
        let value = self.get(key)?;
        match float(value) {
            Some(x) if x.is_finite() && x >= least => Ok(x),
            Some(x) => Err(self.wrong(key, x.to_string(), &format!("a finite number from {least:e} on"))),
            None => Err(self.wrong(key, about(value), "a number")),
        }
    }

    pub(super) fn count(&self, key: &str, least: usize) -> Result<usize> {
        let value = self.get(key)?;
        integer(value)
            .filter(|n| (least..=MAX_COUNT).contains(n))
            .ok_or_else(|| self.wrong(key, about(value), &format!("an integer from {least} to {MAX_COUNT}")))
    }

    pub(super) fn counts(&self, key: &str, least: usize) -> Result<[usize; 3]> {
        let items = self.items(key)?;
        let counts: Option<Vec<usize>> =
            items.iter().map(|v| integer(v).filter(|n| (least..=MAX_COUNT).contains(n))).collect();
        counts.and_then(|c| <[usize; 3]>::try_from(c).ok()).ok_or_else(|| {
            let found = items.iter().take(8).map(about).collect::<Vec<_>>().join(", ");
            let expected = format!("three integers from {least} to {MAX_COUNT}");
            self.wrong(key, format!("[{found}]"), &expected)
        })
    }

    pub(super) fn near_far(&self, key: &str) -> Result<[f32; 2]> {
        let items = self.items(key)?;
        match items.iter().map(float).collect::<Option<Vec<f32>>>().as_deref() {
            Some(&[near, far]) if near >= 0.0 && near < far && far.is_finite() => Ok([near, far]),
            other => Err(self.wrong(key, format!("{other:?}"), "[near, far] with 0 ≤ near < far")),
        }
    }

    pub(super) fn aabb(&self, key: &str) -> Result<[[f32; 3]; 2]> {
        let values = self.floats(key, &[2, 3])?;
        let corners = [[0, 1, 2], [3, 4, 5]].map(|corner| corner.map(|i: usize| values[i]));
        if (0..3).all(|axis| corners[0][axis] < corners[1][axis]) {
            return Ok(corners);
        }
        Err(self.wrong(key, format!("{corners:?}"), "a lower corner and a higher one"))
    }

    /// Finite values of a tensor of exactly this shape.
    pub(super) fn floats(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let expected = || format!("a tensor of floats of shape {shape:?}");
        let tensor = match self.get(key)? {
            TorchValue::Tensor(tensor) | TorchValue::Array(tensor) => tensor,
            other => return Err(self.wrong(key, about(other), &expected())),
        };
        match &tensor.values {
            TorchNumbers::F32(values) if tensor.shape == shape => {
                match values.iter().position(|x| !x.is_finite()) {
                    None => Ok(values.clone()),
                    Some(i) => Err(self.wrong(key, format!("{} at index {i}", values[i]), "finite numbers")),
                }
            }
            _ => Err(self.wrong(key, about_tensor(tensor), &expected())),
        }
    }
}

fn float(value: &TorchValue) -> Option<f32> {
    match value {
        TorchValue::Float(x) => Some(*x as f32),
        TorchValue::Int(i) => Some(*i as f32),
        TorchValue::Tensor(t) | TorchValue::Array(t) => match &t.values {
            TorchNumbers::F32(v) if v.len() == 1 => Some(v[0]),
            TorchNumbers::I64(v) if v.len() == 1 => Some(v[0] as f32),
            _ => None,
        },
        _ => None,
    }
}

pub(super) fn integer(value: &TorchValue) -> Option<usize> {
    match value {
        TorchValue::Int(i) => usize::try_from(*i).ok(),
        TorchValue::Tensor(t) | TorchValue::Array(t) => match &t.values {
            TorchNumbers::I64(v) if v.len() == 1 => usize::try_from(v[0]).ok(),
            _ => None,
        },
        _ => None,
    }
}

/// A value as a message names it.
pub(super) fn about(value: &TorchValue) -> String {
    match value {
        TorchValue::None => "None".into(),
        TorchValue::Bool(b) => b.to_string(),
        TorchValue::Int(i) => i.to_string(),
        TorchValue::Float(x) => x.to_string(),
        TorchValue::Str(_) => "text".into(),
        TorchValue::Bytes(_) => "bytes".into(),
        TorchValue::List(items) | TorchValue::Tuple(items) => format!("a list of {}", items.len()),
        TorchValue::Dict(_) | TorchValue::OrderedDict(_) => "a dictionary".into(),
        TorchValue::Tensor(tensor) | TorchValue::Array(tensor) => about_tensor(tensor),
    }
}

pub(super) fn about_tensor(tensor: &TorchTensor) -> String {
    let kind = match tensor.values {
        TorchNumbers::F32(_) => "floats",
        TorchNumbers::I64(_) => "integers",
        TorchNumbers::U8(_) => "bytes",
        TorchNumbers::Bool(_) => "booleans",
    };
    format!("a tensor of {kind} of shape {:?}", tensor.shape)
}

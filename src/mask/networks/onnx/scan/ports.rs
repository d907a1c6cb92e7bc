//! The inputs and outputs of a network, as its file declares them.

use super::numbers::{FLOAT, FLOAT16, INT64};
use super::{Broken, MAX_RANK, Message, once, shown};
use std::fmt;

/// What numbers an input or output holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// 32-bit floats.
    F32,
    /// 16-bit floats.
    F16,
    /// 64-bit integers.
    I64,
    /// 8-bit unsigned integers.
    U8,
    /// Another ONNX type, by its number.
    Other(i64),
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Kind::F32 => f.write_str("float32"),
            Kind::F16 => f.write_str("float16"),
            Kind::I64 => f.write_str("int64"),
            Kind::U8 => f.write_str("uint8"),
            Kind::Other(n) => write!(f, "ONNX type {n}"),
        }
    }
}

/// An input or output of a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Port {
    /// Its name.
    pub name: String,
    /// Its numbers.
    pub kind: Kind,
    /// Its extents, `None` where any will do; `None` as a whole when not even the number of axes is said.
    pub dims: Option<Vec<Option<u64>>>,
}

impl Port {
    /// `[1, 3, ?, ?]`.
    pub fn shape_in_words(&self) -> String {
        match &self.dims {
            None => "of any shape".into(),
            Some(dims) => {
                let each: Vec<String> =
                    dims.iter().map(|d| d.map_or("?".into(), |d| d.to_string())).collect();
                format!("[{}]", each.join(", "))
            }
        }
    }

    /// Extent of one axis, where it is fixed.
    pub fn extent(&self, axis: usize) -> Option<u64> {
        self.dims.as_ref().and_then(|d| d.get(axis).copied().flatten())
    }
}

/// What a file takes and gives.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Interface {
    /// Inputs that must be fed, in the file's order.
    pub inputs: Vec<Port>,
    /// Outputs, in the file's order.
    pub outputs: Vec<Port>,
    /// Weights by the bits of their number: 32 (or 64), 16, 8 (or fewer).
    pub(in crate::mask::networks::onnx) weights: [u64; 3],
}

impl Interface {
    /// `a [1, 3] → b [?]`, cut where it gets long.
    pub fn in_words(&self) -> String {
        let side = |ports: &[Port]| {
            let each: Vec<String> = ports
                .iter()
                .take(8)
                .map(|p| format!("{} {}", shown(&p.name), p.shape_in_words()))
                .chain((ports.len() > 8).then(|| format!("{} more", ports.len() - 8)))
                .collect();
            if each.is_empty() { "nothing".into() } else { each.join(", ") }
        };
        format!("{} → {}", side(&self.inputs), side(&self.outputs))
    }

    /// Are most weights float32?
    pub fn is_float32(&self) -> bool {
        self.weights[0] >= self.weights[1].max(self.weights[2])
    }
}

/// Name and description of an input or output.
pub(super) fn port(message: Message<'_>) -> Result<(&str, Port), Broken> {
    let mut name = "";
    let mut about = None;
    for field in message.fields() {
        let field = field?;
        match field.number {
            1 => name = field.text()?,
            2 => once(&mut about, field.message()?, &field)?,
            _ => {}
        }
    }
    let mut found = Port { name: name.into(), kind: Kind::Other(0), dims: None };
    let mut tensor = None;
    for field in about.into_iter().flat_map(Message::fields) {
        let field = field?;
        if field.number == 1 {
            once(&mut tensor, field.message()?, &field)?;
        }
    }
    let mut shape = None;
    for field in tensor.into_iter().flat_map(Message::fields) {
        let field = field?;
        match field.number {
            1 => {
                found.kind = match field.integer()? {
                    FLOAT => Kind::F32,
                    FLOAT16 => Kind::F16,
                    INT64 => Kind::I64,
                    2 => Kind::U8,
                    other => Kind::Other(other),
                }
            }
            2 => once(&mut shape, field.message()?, &field)?,
            _ => {}
        }
    }
    let Some(shape) = shape else { return Ok((name, found)) };
    let mut dims = Vec::new();
    for field in shape.fields() {
        let field = field?;
        if field.number != 1 {
            continue;
        }
        let mut extent = None;
        for part in field.message()?.fields() {
            let part = part?;
            if part.number == 1 {
                extent = u64::try_from(part.integer()?).ok().filter(|&d| d > 0);
            }
        }
        if dims.len() >= MAX_RANK {
            return Err(Broken::new(field.at, format!("`{}` has more than {MAX_RANK} axes", shown(name))));
        }
        dims.push(extent);
    }
    found.dims = Some(dims);
    Ok((name, found))
}

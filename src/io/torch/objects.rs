//! The Python names a checkpoint may use, and what each of them means here. Whatever is not in
//! [`Global::named`] does not exist.

use super::super::ReadError;
use super::pickle::{Id, Machine};
use std::ops::Range;

/// Dimensions of one tensor, where fields use five, and arguments of one call, where numpy uses nine.
const MAX_RANK: usize = 16;

/// One object of a pickle. Text and bytes are places in it.
#[derive(Debug)]
pub(super) enum Node {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Str(Range<usize>),
    Bytes(Range<usize>),
    /// Bytes written as text of code points 0 to 255, as protocol 2 has no bytes.
    Latin1(Range<usize>),
    List(Vec<Id>),
    Tuple(Vec<Id>),
    Dict {
        ordered: bool,
        pairs: Vec<(Id, Id)>,
    },
    Global(Global),
    Storage {
        kind: Kind,
        key: Range<usize>,
        count: usize,
    },
    Tensor(Box<View>),
    Dtype(NumpyType),
    /// A numpy array, before and after its state was set.
    Array(Option<Box<Array>>),
    /// A numpy number: its type and its bytes.
    Scalar(NumpyType, Id),
}

/// A tensor as the pickle describes it, in values, not bytes.
#[derive(Debug)]
pub(super) struct View {
    pub(super) storage: Id,
    pub(super) offset: usize,
    pub(super) shape: Vec<usize>,
    pub(super) strides: Vec<usize>,
}

/// A numpy array as the pickle describes it.
#[derive(Debug)]
pub(super) struct Array {
    pub(super) shape: Vec<usize>,
    pub(super) number: NumpyType,
    pub(super) fortran: bool,
    pub(super) data: Id,
}

/// A numpy dtype with its byte order.
#[derive(Clone, Copy, Debug)]
pub(super) struct NumpyType {
    pub(super) kind: Kind,
    pub(super) big: bool,
}

/// How one number is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub(super) enum Kind {
    F16,
    F32,
    F64,
    I8,
    I16,
    I32,
    I64,
    U8,
    U16,
    U32,
    Bool,
}

impl Kind {
    /// Bytes of one number.
    pub(super) fn size(self) -> usize {
        match self {
            Kind::I8 | Kind::U8 | Kind::Bool => 1,
            Kind::F16 | Kind::I16 | Kind::U16 => 2,
            Kind::F32 | Kind::I32 | Kind::U32 => 4,
            Kind::F64 | Kind::I64 => 8,
        }
    }

    fn of_numpy(code: &[u8]) -> Option<Kind> {
        Some(match code {
            b"f2" => Kind::F16,
            b"f4" => Kind::F32,
            b"f8" => Kind::F64,
            b"i1" => Kind::I8,
            b"i2" => Kind::I16,
            b"i4" => Kind::I32,
            b"i8" => Kind::I64,
            b"u1" => Kind::U8,
            b"u2" => Kind::U16,
            b"u4" => Kind::U32,
            b"b1" => Kind::Bool,
            _ => return None,
        })
    }
}

/// A name on the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Global {
    Storage(Kind),
    RebuildTensor,
    RebuildParameter,
    OrderedDict,
    Size,
    Reconstruct,
    FromBuffer,
    NdArray,
    Dtype,
    Scalar,
    Encode,
}

impl Global {
    pub(super) fn named(module: &[u8], name: &[u8]) -> Option<Global> {
        Some(match (module, name) {
            (b"torch._utils", b"_rebuild_tensor_v2") => Global::RebuildTensor,
            (b"torch._utils", b"_rebuild_parameter") => Global::RebuildParameter,
            (b"torch", b"HalfStorage") => Global::Storage(Kind::F16),
            (b"torch", b"FloatStorage") => Global::Storage(Kind::F32),
            (b"torch", b"DoubleStorage") => Global::Storage(Kind::F64),
            (b"torch", b"CharStorage") => Global::Storage(Kind::I8),
            (b"torch", b"ShortStorage") => Global::Storage(Kind::I16),
            (b"torch", b"IntStorage") => Global::Storage(Kind::I32),
            (b"torch", b"LongStorage") => Global::Storage(Kind::I64),
            (b"torch", b"ByteStorage") => Global::Storage(Kind::U8),
            (b"torch", b"BoolStorage") => Global::Storage(Kind::Bool),
            (b"torch", b"Size") => Global::Size,
            (b"collections", b"OrderedDict") => Global::OrderedDict,
            (b"numpy.core.multiarray" | b"numpy._core.multiarray", b"_reconstruct") => Global::Reconstruct,
            (b"numpy.core.multiarray" | b"numpy._core.multiarray", b"scalar") => Global::Scalar,
            (b"numpy.core.numeric" | b"numpy._core.numeric", b"_frombuffer") => Global::FromBuffer,
            (b"numpy", b"ndarray") => Global::NdArray,
            (b"numpy", b"dtype") => Global::Dtype,
            (b"_codecs", b"encode") => Global::Encode,
            _ => return None,
        })
    }
}

impl Machine<'_, '_> {
    /// What calling `callable` with `arguments` would give, as data.
    pub(super) fn reduce(&mut self, callable: Id, arguments: Id) -> Result<Id, ReadError> {
        let &Node::Global(global) = self.node(callable) else {
            return Err(self.bad("something is called that is no function".into()));
        };
        let Node::Tuple(given) = self.node(arguments) else {
            return Err(self.bad(format!("{global:?} is called without a tuple of arguments")));
        };
        if given.len() > MAX_RANK {
            return Err(self.bad(format!("{global:?} is called with {} arguments", given.len())));
        }
        let given = given.clone();
        let made = match (global, &given[..]) {
            (Global::RebuildTensor, [storage, offset, shape, strides, ..]) => {
                self.tensor(*storage, *offset, *shape, *strides)
            }
            (Global::RebuildParameter, [data, ..]) if matches!(self.node(*data), Node::Tensor(_)) => {
                return Ok(*data);
            }
            (Global::OrderedDict, []) => Some(Node::Dict { ordered: true, pairs: Vec::new() }),
            (Global::Size, [sizes]) => match self.node(*sizes) {
                Node::Tuple(_) => return Ok(*sizes),
                _ => None,
            },
            (Global::Reconstruct, [class, ..])
                if matches!(self.node(*class), Node::Global(Global::NdArray)) =>
            {
                Some(Node::Array(None))
            }
            (Global::FromBuffer, [data, number, shape, order]) => {
                self.array(*shape, *number, matches!(self.text_of(*order), Some(b"F")), *data)
            }
            (Global::Dtype, [code, ..]) => match self.text_of(*code).map(|c| (Kind::of_numpy(c), c)) {
                Some((Some(kind), _)) => Some(Node::Dtype(NumpyType { kind, big: false })),
                Some((None, code)) => {
                    return Err(self.bad(format!("numpy's type `{}` is not read", super::shown(code))));
                }
                None => None,
            },
            (Global::Scalar, [number, data]) => match self.node(*number) {
                Node::Dtype(number) => Some(Node::Scalar(*number, *data)),
                _ => None,
            },
            (Global::Encode, [text, coding]) => match (self.node(*text), self.text_of(*coding)) {
                (Node::Str(text), Some(b"latin1" | b"latin-1")) => Some(Node::Latin1(text.clone())),
                _ => None,
            },
            _ => None,
        };
        match made {
            Some(node) => Ok(self.add(node)),
            None => Err(self.bad(format!("{global:?} is called with arguments it does not take"))),
        }
    }

    /// Gives `target` its state, as `__setstate__` would.
    pub(super) fn build(&mut self, target: Id, state: Id) -> Result<(), ReadError> {
        let items = match self.node(state) {
            Node::Tuple(items) if items.len() <= MAX_RANK => items.clone(),
            _ => Vec::new(),
        };
        let made = match self.node(target) {
            // `_metadata`, which `state_dict()` hangs on its dictionary, says nothing about values
            Node::Dict { .. } => return Ok(()),
            Node::Array(None) => match items[..] {
                [_, shape, number, fortran, data] => {
                    self.array(shape, number, matches!(self.node(fortran), Node::Bool(true)), data)
                }
                _ => None,
            },
            Node::Dtype(number) => match items.get(1).and_then(|&order| self.text_of(order)) {
                Some(b"<" | b"|" | b"=") => Some(Node::Dtype(NumpyType { big: false, ..*number })),
                Some(b">") => Some(Node::Dtype(NumpyType { big: true, ..*number })),
                _ => None,
            },
            _ => None,
        };
        match made {
            Some(node) => {
                self.nodes[target as usize] = node;
                Ok(())
            }
            None => Err(self.bad("a state is given to what does not take it".into())),
        }
    }

    /// `('storage', class, key, device, count)`; the device does not matter here.
    pub(super) fn storage(&self, about: Id) -> Result<Node, ReadError> {
        let found = match self.node(about) {
            Node::Tuple(items) => match items[..] {
                [tag, class, key, _, count] if self.text_of(tag) == Some(b"storage") => {
                    match (self.node(class), self.node(key), self.count(count)) {
                        (&Node::Global(Global::Storage(kind)), Node::Str(key), Some(count)) => {
                            Some(Node::Storage { kind, key: key.clone(), count })
                        }
                        _ => None,
                    }
                }
                _ => None,
            },
            _ => None,
        };
        found.ok_or_else(|| self.bad("a reference to something that is no storage of numbers".into()))
    }

    fn tensor(&self, storage: Id, offset: Id, shape: Id, strides: Id) -> Option<Node> {
        let Node::Storage { .. } = self.node(storage) else { return None };
        let (shape, mut strides) = (self.counts(shape)?, self.counts(strides)?);
        // no step is ever taken along an extent of 1, so its stride may be anything
        strides.iter_mut().zip(&shape).filter(|(_, size)| **size < 2).for_each(|(stride, _)| *stride = 0);
        let offset = self.count(offset)?;
        let view = View { storage, offset, shape, strides };
        (view.shape.len() == view.strides.len()).then(|| Node::Tensor(Box::new(view)))
    }

    fn array(&self, shape: Id, number: Id, fortran: bool, data: Id) -> Option<Node> {
        let (&Node::Dtype(number), Node::Bytes(_) | Node::Latin1(_)) = (self.node(number), self.node(data))
        else {
            return None;
        };
        Some(Node::Array(Some(Box::new(Array { shape: self.counts(shape)?, number, fortran, data }))))
    }

    fn text_of(&self, id: Id) -> Option<&[u8]> {
        match self.node(id) {
            Node::Str(range) => Some(&self.pickle[range.clone()]),
            _ => None,
        }
    }

    fn count(&self, id: Id) -> Option<usize> {
        match *self.node(id) {
            Node::Int(value) => usize::try_from(value).ok(),
            _ => None,
        }
    }

    fn counts(&self, id: Id) -> Option<Vec<usize>> {
        match self.node(id) {
            Node::Tuple(items) if items.len() <= MAX_RANK => items.iter().map(|&i| self.count(i)).collect(),
            _ => None,
        }
    }
}

//! The Python names a checkpoint may use, and what each of them means here. Whatever is not in
//! [`Global::named`] does not exist.

use std::ops::Range;

/// Index of an object.
pub(super) type Id = u32;

/// Dimensions of one tensor, where fields use five, and arguments of one call, where numpy uses nine.
const MAX_RANK: usize = 16;

/// One object of a pickle. Text and bytes are places in it.
#[derive(Debug)]
pub(super) enum PickleObject {
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
        kind: NumberType,
        key: Range<usize>,
        count: usize,
    },
    Tensor(Box<StridedTensor>),
    Dtype(NumpyType),
    /// A numpy array, before and after its state was set.
    Array(Option<Box<NumpyArray>>),
    /// A numpy number: its type and its bytes.
    Scalar(NumpyType, Id),
}

/// A tensor as the pickle describes it, in values, not bytes.
#[derive(Debug)]
pub(super) struct StridedTensor {
    pub(super) storage: Id,
    pub(super) offset: usize,
    pub(super) shape: Vec<usize>,
    pub(super) strides: Vec<usize>,
}

/// A numpy array as the pickle describes it.
#[derive(Debug)]
pub(super) struct NumpyArray {
    pub(super) shape: Vec<usize>,
    pub(super) number: NumpyType,
    pub(super) fortran: bool,
    pub(super) data: Id,
}

/// A numpy dtype with its byte order.
#[derive(Clone, Copy, Debug)]
pub(super) struct NumpyType {
    pub(super) kind: NumberType,
    pub(super) big: bool,
}

/// How one number is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub(super) enum NumberType {
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

impl NumberType {
    /// Bytes of one number.
    pub(super) fn size(self) -> usize {
        match self {
            NumberType::I8 | NumberType::U8 | NumberType::Bool => 1,
            NumberType::F16 | NumberType::I16 | NumberType::U16 => 2,
            NumberType::F32 | NumberType::I32 | NumberType::U32 => 4,
            NumberType::F64 | NumberType::I64 => 8,
        }
    }

    fn of_numpy(code: &[u8]) -> Option<NumberType> {
        Some(match code {
            b"f2" => NumberType::F16,
            b"f4" => NumberType::F32,
            b"f8" => NumberType::F64,
            b"i1" => NumberType::I8,
            b"i2" => NumberType::I16,
            b"i4" => NumberType::I32,
            b"i8" => NumberType::I64,
            b"u1" => NumberType::U8,
            b"u2" => NumberType::U16,
            b"u4" => NumberType::U32,
            b"b1" => NumberType::Bool,
            _ => return None,
        })
    }
}

/// A name on the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Global {
    Storage(NumberType),
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
            (b"torch", b"HalfStorage") => Global::Storage(NumberType::F16),
            (b"torch", b"FloatStorage") => Global::Storage(NumberType::F32),
            (b"torch", b"DoubleStorage") => Global::Storage(NumberType::F64),
            (b"torch", b"CharStorage") => Global::Storage(NumberType::I8),
            (b"torch", b"ShortStorage") => Global::Storage(NumberType::I16),
            (b"torch", b"IntStorage") => Global::Storage(NumberType::I32),
            (b"torch", b"LongStorage") => Global::Storage(NumberType::I64),
            (b"torch", b"ByteStorage") => Global::Storage(NumberType::U8),
            (b"torch", b"BoolStorage") => Global::Storage(NumberType::Bool),
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

/// Every object of a pickle; they refer to each other by index.
pub(super) struct Heap<'a> {
    pub(super) pickle: &'a [u8],
    objects: Vec<PickleObject>,
}

impl<'a> Heap<'a> {
    pub(super) fn new(pickle: &'a [u8]) -> Heap<'a> {
        Heap { pickle, objects: Vec::new() }
    }

    pub(super) fn get(&self, id: Id) -> &PickleObject {
        &self.objects[id as usize] // ids are only made by `add`
    }

    pub(super) fn get_mut(&mut self, id: Id) -> &mut PickleObject {
        &mut self.objects[id as usize]
    }

    /// At most one per opcode.
    pub(super) fn add(&mut self, object: PickleObject) -> Id {
        self.objects.push(object);
        (self.objects.len() - 1) as Id
    }

    /// What calling `callable` with `arguments` would give, as data.
    pub(super) fn reduce(&mut self, callable: Id, arguments: Id) -> Result<Id, String> {
        let &PickleObject::Global(global) = self.get(callable) else {
            return Err("something is called that is no function".into());
        };
        let PickleObject::Tuple(given) = self.get(arguments) else {
            return Err(format!("{global:?} is called without a tuple of arguments"));
        };
        if given.len() > MAX_RANK {
            return Err(format!("{global:?} is called with {} arguments", given.len()));
        }
        let given = given.clone();
        let made = match (global, &given[..]) {
            (Global::RebuildTensor, [storage, offset, shape, strides, ..]) => {
                self.tensor(*storage, *offset, *shape, *strides)
            }
            (Global::RebuildParameter, [data, ..]) if matches!(self.get(*data), PickleObject::Tensor(_)) => {
                return Ok(*data);
            }
            (Global::OrderedDict, []) => Some(PickleObject::Dict { ordered: true, pairs: Vec::new() }),
            (Global::Size, [sizes]) => match self.get(*sizes) {
                PickleObject::Tuple(_) => return Ok(*sizes),
                _ => None,
            },
            (Global::Reconstruct, [class, ..])
                if matches!(self.get(*class), PickleObject::Global(Global::NdArray)) =>
            {
                Some(PickleObject::Array(None))
            }
            (Global::FromBuffer, [data, number, shape, order]) => {
                self.array(*shape, *number, matches!(self.text_of(*order), Some(b"F")), *data)
            }
            (Global::Dtype, [code, ..]) => match self.text_of(*code).map(|c| (NumberType::of_numpy(c), c)) {
                Some((Some(kind), _)) => Some(PickleObject::Dtype(NumpyType { kind, big: false })),
                Some((None, code)) => {
                    return Err(format!("numpy's type `{}` is not read", super::shown(code)));
                }
                None => None,
            },
            (Global::Scalar, [number, data]) => match self.get(*number) {
                PickleObject::Dtype(number) => Some(PickleObject::Scalar(*number, *data)),
                _ => None,
            },
            (Global::Encode, [text, coding]) => match (self.get(*text), self.text_of(*coding)) {
                (PickleObject::Str(text), Some(b"latin1" | b"latin-1")) => {
                    Some(PickleObject::Latin1(text.clone()))
                }
                _ => None,
            },
            _ => None,
        };
        match made {
            Some(object) => Ok(self.add(object)),
            None => Err(format!("{global:?} is called with arguments it does not take")),
        }
    }

    /// Gives `target` its state, as `__setstate__` would.
    pub(super) fn build(&mut self, target: Id, state: Id) -> Result<(), String> {
        let items = match self.get(state) {
            PickleObject::Tuple(items) if items.len() <= MAX_RANK => items.clone(),
            _ => Vec::new(),
        };
        let made = match self.get(target) {
            // `_metadata`, which `state_dict()` hangs on its dictionary, says nothing about values
            PickleObject::Dict { .. } => return Ok(()),
            PickleObject::Array(None) => match items[..] {
                [_, shape, number, fortran, data] => {
                    self.array(shape, number, matches!(self.get(fortran), PickleObject::Bool(true)), data)
                }
                _ => None,
            },
            PickleObject::Dtype(number) => match items.get(1).and_then(|&order| self.text_of(order)) {
                Some(b"<" | b"|" | b"=") => Some(PickleObject::Dtype(NumpyType { big: false, ..*number })),
                Some(b">") => Some(PickleObject::Dtype(NumpyType { big: true, ..*number })),
                _ => None,
            },
            _ => None,
        };
        match made {
            Some(object) => {
                *self.get_mut(target) = object;
                Ok(())
            }
            None => Err("a state is given to what does not take it".into()),
        }
    }

    /// `('storage', class, key, device, count)`; the device does not matter here.
    pub(super) fn storage(&self, about: Id) -> Result<PickleObject, String> {
        let found = match self.get(about) {
            PickleObject::Tuple(items) => match items[..] {
                [tag, class, key, _, count] if self.text_of(tag) == Some(b"storage") => {
                    match (self.get(class), self.get(key), self.count(count)) {
                        (
                            &PickleObject::Global(Global::Storage(kind)),
                            PickleObject::Str(key),
                            Some(count),
                        ) => Some(PickleObject::Storage { kind, key: key.clone(), count }),
                        _ => None,
                    }
                }
                _ => None,
            },
            _ => None,
        };
        found.ok_or_else(|| "a reference to something that is no storage of numbers".into())
    }

    fn tensor(&self, storage: Id, offset: Id, shape: Id, strides: Id) -> Option<PickleObject> {
        let PickleObject::Storage { .. } = self.get(storage) else { return None };
        let (shape, mut strides) = (self.counts(shape)?, self.counts(strides)?);
        // no step is ever taken along an extent of 1, so its stride may be anything
        strides.iter_mut().zip(&shape).filter(|(_, size)| **size < 2).for_each(|(stride, _)| *stride = 0);
        let offset = self.count(offset)?;
        let view = StridedTensor { storage, offset, shape, strides };
        (view.shape.len() == view.strides.len()).then(|| PickleObject::Tensor(Box::new(view)))
    }

    fn array(&self, shape: Id, number: Id, fortran: bool, data: Id) -> Option<PickleObject> {
        let (&PickleObject::Dtype(number), PickleObject::Bytes(_) | PickleObject::Latin1(_)) =
            (self.get(number), self.get(data))
        else {
            return None;
        };
        Some(PickleObject::Array(Some(Box::new(NumpyArray {
            shape: self.counts(shape)?,
            number,
            fortran,
            data,
        }))))
    }

    fn text_of(&self, id: Id) -> Option<&[u8]> {
        match self.get(id) {
            PickleObject::Str(range) => Some(&self.pickle[range.clone()]),
            _ => None,
        }
    }

    fn count(&self, id: Id) -> Option<usize> {
        match *self.get(id) {
            PickleObject::Int(value) => usize::try_from(value).ok(),
            _ => None,
        }
    }

    fn counts(&self, id: Id) -> Option<Vec<usize>> {
        match self.get(id) {
            PickleObject::Tuple(items) if items.len() <= MAX_RANK => {
                items.iter().map(|&i| self.count(i)).collect()
            }
            _ => None,
        }
    }
}

//! The stack machine of Python's `pickle` (protocols 2 to 5), as far as `torch.save` uses it.
//!
//! Objects live in one flat list and refer to each other by index, so lists may be filled after they were
//! remembered, as pickles do, and dropping a deep nest needs no stack. What is pushed, marked and
//! remembered is counted together: a pickle cannot make more than [`MAX_VALUES`] of it.

use super::super::ReadError;
use super::objects::{Global, Heap, Id, PickleObject};
use super::{FORMAT, shown};
use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;

/// Values of one checkpoint; a field has some hundreds.
pub(super) const MAX_VALUES: usize = 1 << 18;

/// Runs the whole pickle; gives its objects and the one that is the result.
pub(super) fn run<'a>(path: &Path, pickle: &'a [u8]) -> Result<(Heap<'a>, Id), ReadError> {
    let mut machine = Machine {
        path,
        heap: Heap::new(pickle),
        at: 0,
        opcode: 0,
        stack: Vec::new(),
        marks: Vec::new(),
        memo: HashMap::new(),
        spent: 0,
    };
    while machine.step()? {}
    let root = machine.pop()?;
    Ok((machine.heap, root))
}

struct Machine<'a, 'p> {
    path: &'p Path,
    heap: Heap<'a>,
    at: usize,
    /// Where the opcode being run stands.
    opcode: usize,
    stack: Vec<Id>,
    /// Heights of the stack.
    marks: Vec<usize>,
    memo: HashMap<u32, Id>,
    spent: usize,
}

impl<'a> Machine<'a, '_> {
    /// Runs one opcode; false at the end.
    fn step(&mut self) -> Result<bool, ReadError> {
        self.opcode = self.at;
        let opcode = self.word(1)? as u8;
        match opcode {
            0x80 => {
                let protocol = self.word(1)?;
                if !(2..=5).contains(&protocol) {
                    return Err(self.bad(format!("pickle protocol {protocol} is unknown (2 to 5 are read)")));
                }
            }
            0x95 => drop(self.take(8)?), // a frame: only a hint for buffering
            b'.' => return Ok(false),
            b'(' => {
                self.spend()?;
                self.marks.push(self.stack.len());
            }
            b'0' => drop(self.pop()?),
            b'1' => drop(self.since_mark()?),
            b'N' => self.push(PickleObject::None)?,
            0x88 => self.push(PickleObject::Bool(true))?,
            0x89 => self.push(PickleObject::Bool(false))?,
            b'K' => self.int(1)?,
            b'M' => self.int(2)?,
            b'J' => {
                let value = self.word(4)? as u32 as i32;
                self.push(PickleObject::Int(value as i64))?;
            }
            0x8a => self.long(1)?,
            0x8b => self.long(4)?,
            b'G' => {
                let bits = self.word(8)?.swap_bytes(); // big-endian, unlike all the others
                self.push(PickleObject::Float(f64::from_bits(bits)))?;
            }
            b'X' => self.text(4)?,
            0x8c => self.text(1)?,
            0x8d => self.text(8)?,
            b'B' => self.bytes(4)?,
            b'C' => self.bytes(1)?,
            0x8e | 0x96 => self.bytes(8)?,
            b'}' => self.push(PickleObject::Dict { ordered: false, pairs: Vec::new() })?,
            b']' => self.push(PickleObject::List(Vec::new()))?,
            b')' => self.push(PickleObject::Tuple(Vec::new()))?,
            b't' => {
                let items = self.since_mark()?;
                self.push(PickleObject::Tuple(items))?;
            }
            0x85..=0x87 => {
                let mut items = Vec::new();
                for _ in 0x84..opcode {
                    items.push(self.pop()?);
                }
                items.reverse();
                self.push(PickleObject::Tuple(items))?;
            }
            b'a' => {
                let item = self.pop()?;
                self.append(vec![item])?;
            }
            b'e' => {
                let items = self.since_mark()?;
                self.append(items)?;
            }
            b's' => {
                let value = self.pop()?;
                let key = self.pop()?;
                self.set(vec![key, value])?;
            }
            b'u' => {
                let items = self.since_mark()?;
                self.set(items)?;
            }
            b'q' | b'r' | 0x94 => {
                let key = match opcode {
                    b'q' => self.word(1)? as u32,
                    b'r' => self.word(4)? as u32,
                    _ => self.memo.len() as u32,
                };
                self.remember(key)?;
            }
            b'h' => self.recall(1)?,
            b'j' => self.recall(4)?,
            b'c' => {
                let module = self.line()?;
                let name = self.line()?;
                self.global(module, name)?;
            }
            0x93 => {
                let name = self.pop()?;
                let module = self.pop()?;
                let pickle = self.heap.pickle;
                let (PickleObject::Str(module), PickleObject::Str(name)) =
                    (self.heap.get(module), self.heap.get(name))
                else {
                    return Err(self.bad("the name of a Python object is not text".into()));
                };
                self.global(&pickle[module.clone()], &pickle[name.clone()])?;
            }
            b'R' => {
                let arguments = self.pop()?;
                let callable = self.pop()?;
                let result = self.heap.reduce(callable, arguments).map_err(|e| self.bad(e))?;
                self.put(result)?;
            }
            b'b' => {
                let state = self.pop()?;
                let target = self.top()?;
                self.heap.build(target, state).map_err(|e| self.bad(e))?;
            }
            b'Q' => {
                let about = self.pop()?;
                let storage = self.heap.storage(about).map_err(|e| self.bad(e))?;
                self.push(storage)?;
            }
            other => {
                let what = format!("the pickle opcode 0x{other:02x} (at byte {} of `data.pkl`)", self.opcode);
                return Err(self.unsupported(what));
            }
        }
        Ok(true)
    }

    fn bad(&self, problem: String) -> ReadError {
        let problem = format!("{problem}, at byte {} of `data.pkl`", self.opcode);
        ReadError::damaged(self.path, FORMAT, None, problem)
    }

    fn unsupported(&self, what: String) -> ReadError {
        ReadError::Unsupported {
            path: self.path.into(),
            what,
            hint:
                "a checkpoint needs only tensors, arrays, numbers and text; nothing in the file was run, and \
                   it should not be loaded with Python before its source is known"
                    .into(),
        }
    }

    /// Every push, mark and memory costs one.
    fn spend(&mut self) -> Result<(), ReadError> {
        self.spent += 1;
        if self.spent > MAX_VALUES {
            return Err(self.bad(format!("more than {MAX_VALUES} values, as no field has")));
        }
        Ok(())
    }

    fn put(&mut self, id: Id) -> Result<(), ReadError> {
        self.spend()?;
        self.stack.push(id);
        Ok(())
    }

    fn push(&mut self, object: PickleObject) -> Result<(), ReadError> {
        let id = self.heap.add(object);
        self.put(id)
    }

    fn top(&self) -> Result<Id, ReadError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.last() {
            Some(&id) if self.stack.len() > floor => Ok(id),
            _ => Err(self.bad("an opcode finds too few values".into())),
        }
    }

    fn pop(&mut self) -> Result<Id, ReadError> {
        let id = self.top()?;
        self.stack.pop();
        Ok(id)
    }

    fn since_mark(&mut self) -> Result<Vec<Id>, ReadError> {
        match self.marks.pop() {
            Some(floor) => Ok(self.stack.split_off(floor)), // `pop` never goes below a mark
            None => Err(self.bad("an opcode finds no mark".into())),
        }
    }

    fn append(&mut self, items: Vec<Id>) -> Result<(), ReadError> {
        let list = self.top()?;
        match self.heap.get_mut(list) {
            PickleObject::List(old) => old.extend(items),
            _ => return Err(self.bad("something is appended to what is no list".into())),
        }
        Ok(())
    }

    fn set(&mut self, items: Vec<Id>) -> Result<(), ReadError> {
        let dict = self.top()?;
        let (pairs, rest) = items.as_chunks::<2>();
        match self.heap.get_mut(dict) {
            PickleObject::Dict { pairs: old, .. } if rest.is_empty() => {
                old.extend(pairs.iter().map(|&[k, v]| (k, v)))
            }
            _ => return Err(self.bad("keys and values are set in what is no dictionary".into())),
        }
        Ok(())
    }

    fn remember(&mut self, key: u32) -> Result<(), ReadError> {
        self.spend()?;
        let id = self.top()?;
        self.memo.insert(key, id);
        Ok(())
    }

    fn recall(&mut self, width: usize) -> Result<(), ReadError> {
        let key = self.word(width)? as u32;
        match self.memo.get(&key) {
            Some(&id) => self.put(id),
            None => Err(self.bad(format!("value {key} is recalled but was never remembered"))),
        }
    }

    fn global(&mut self, module: &[u8], name: &[u8]) -> Result<(), ReadError> {
        match Global::named(module, name) {
            Some(global) => self.push(PickleObject::Global(global)),
            None => {
                let (module, name) = (shown(module), shown(name));
                let at = self.opcode;
                Err(self
                    .unsupported(format!("the Python object `{module}.{name}` (at byte {at} of `data.pkl`)")))
            }
        }
    }

    fn range(&mut self, length: u64) -> Result<Range<usize>, ReadError> {
        let left = self.heap.pickle.len() - self.at;
        if length > left as u64 {
            return Err(self.bad(format!("{length} bytes should follow, {left} do")));
        }
        let start = self.at;
        self.at += length as usize;
        Ok(start..self.at)
    }

    fn take(&mut self, length: u64) -> Result<&'a [u8], ReadError> {
        let range = self.range(length)?;
        Ok(&self.heap.pickle[range])
    }

    /// A little-endian number of up to 8 bytes.
    fn word(&mut self, width: usize) -> Result<u64, ReadError> {
        let bytes = self.take(width as u64)?;
        Ok(bytes.iter().rev().fold(0, |word, &b| word << 8 | b as u64))
    }

    fn line(&mut self) -> Result<&'a [u8], ReadError> {
        let rest = &self.heap.pickle[self.at..];
        match rest.iter().take(1024).position(|&b| b == b'\n') {
            Some(end) => {
                self.at += end + 1;
                Ok(&rest[..end])
            }
            None => Err(self.bad("the name of a Python object has no end".into())),
        }
    }

    fn int(&mut self, width: usize) -> Result<(), ReadError> {
        let value = self.word(width)?;
        self.push(PickleObject::Int(value as i64))
    }

    /// Two's complement of as many bytes as the file says; none is 0.
    fn long(&mut self, width: usize) -> Result<(), ReadError> {
        let length = self.word(width)? as usize;
        if length > 8 {
            return Err(self.bad(format!("an integer of {length} bytes, 8 are read")));
        }
        let spare = 64 - 8 * length as u32;
        let word = self.word(length)?;
        let value = if length == 0 { 0 } else { ((word << spare) as i64) >> spare };
        self.push(PickleObject::Int(value))
    }

    fn text(&mut self, width: usize) -> Result<(), ReadError> {
        let length = self.word(width)?;
        let range = self.range(length)?;
        if std::str::from_utf8(&self.heap.pickle[range.clone()]).is_err() {
            return Err(self.bad("text that is not UTF-8".into()));
        }
        self.push(PickleObject::Str(range))
    }

    fn bytes(&mut self, width: usize) -> Result<(), ReadError> {
        let length = self.word(width)?;
        let range = self.range(length)?;
        self.push(PickleObject::Bytes(range))
    }
}

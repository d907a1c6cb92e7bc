//! The stack machine of Python's `pickle` (protocols 2 to 5), as far as `torch.save` uses it.
//!
//! Objects live in one flat list and refer to each other by index, so lists may be filled after they were
//! remembered, as pickles do, and dropping a deep nest needs no stack. What is pushed, marked and
//! remembered is counted together: a pickle cannot make more than [`MAX_VALUES`] of it.

use super::super::ReadError;
use super::objects::{Global, Node};
use super::{FORMAT, shown};
use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;

/// Values of one checkpoint; a field has some hundreds.
pub(super) const MAX_VALUES: usize = 1 << 18;

/// Index of a node.
pub(super) type Id = u32;

/// Every object of a pickle, and the one that is the result.
pub(super) struct Graph<'a> {
    pub(super) pickle: &'a [u8],
    pub(super) nodes: Vec<Node>,
    pub(super) root: Id,
}

/// Runs the whole pickle.
pub(super) fn run<'a>(path: &Path, pickle: &'a [u8]) -> Result<Graph<'a>, ReadError> {
    let mut machine = Machine {
        path,
        pickle,
        at: 0,
        opcode: 0,
        stack: Vec::new(),
        marks: Vec::new(),
        memo: HashMap::new(),
        nodes: Vec::new(),
        spent: 0,
    };
    while machine.step()? {}
    let root = machine.pop()?;
    Ok(Graph { pickle, nodes: machine.nodes, root })
}

pub(super) struct Machine<'a, 'p> {
    path: &'p Path,
    pub(super) pickle: &'a [u8],
    at: usize,
    /// Where the opcode being run stands.
    opcode: usize,
    stack: Vec<Id>,
    /// Heights of the stack.
    marks: Vec<usize>,
    memo: HashMap<u32, Id>,
    pub(super) nodes: Vec<Node>,
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
            b'N' => self.push(Node::None)?,
            0x88 => self.push(Node::Bool(true))?,
            0x89 => self.push(Node::Bool(false))?,
            b'K' => self.int(1)?,
            b'M' => self.int(2)?,
            b'J' => {
                let value = self.word(4)? as u32 as i32;
                self.push(Node::Int(value as i64))?;
            }
            0x8a => self.long(1)?,
            0x8b => self.long(4)?,
            b'G' => {
                let bits = self.word(8)?.swap_bytes(); // big-endian, unlike all the others
                self.push(Node::Float(f64::from_bits(bits)))?;
            }
            b'X' => self.text(4)?,
            0x8c => self.text(1)?,
            0x8d => self.text(8)?,
            b'B' => self.bytes(4)?,
            b'C' => self.bytes(1)?,
            0x8e | 0x96 => self.bytes(8)?,
            b'}' => self.push(Node::Dict { ordered: false, pairs: Vec::new() })?,
            b']' => self.push(Node::List(Vec::new()))?,
            b')' => self.push(Node::Tuple(Vec::new()))?,
            b't' => {
                let items = self.since_mark()?;
                self.push(Node::Tuple(items))?;
            }
            0x85..=0x87 => {
                let mut items = Vec::new();
                for _ in 0x84..opcode {
                    items.push(self.pop()?);
                }
                items.reverse();
                self.push(Node::Tuple(items))?;
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
            b'q' => self.remember(1)?,
            b'r' => self.remember(4)?,
            0x94 => {
                let key = self.memo.len() as u32;
                self.remember_as(key)?;
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
                let (Node::Str(module), Node::Str(name)) = (self.node(module), self.node(name)) else {
                    return Err(self.bad("the name of a Python object is not text".into()));
                };
                self.global(&self.pickle[module.clone()], &self.pickle[name.clone()])?;
            }
            b'R' => {
                let arguments = self.pop()?;
                let callable = self.pop()?;
                let made = self.reduce(callable, arguments)?;
                self.put(made)?;
            }
            b'b' => {
                let state = self.pop()?;
                let target = self.top()?;
                self.build(target, state)?;
            }
            b'Q' => {
                let about = self.pop()?;
                let storage = self.storage(about)?;
                self.push(storage)?;
            }
            other => {
                let what = format!("the pickle opcode 0x{other:02x} (at byte {} of `data.pkl`)", self.opcode);
                return Err(self.unsupported(what));
            }
        }
        Ok(true)
    }

    pub(super) fn bad(&self, problem: String) -> ReadError {
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

    pub(super) fn node(&self, id: Id) -> &Node {
        &self.nodes[id as usize] // ids are only made by `push`
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

    pub(super) fn push(&mut self, node: Node) -> Result<(), ReadError> {
        let id = self.add(node);
        self.put(id)
    }

    /// A node that is not on the stack; at most one per opcode.
    pub(super) fn add(&mut self, node: Node) -> Id {
        self.nodes.push(node);
        (self.nodes.len() - 1) as Id
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
        match &mut self.nodes[list as usize] {
            Node::List(old) => old.extend(items),
            _ => return Err(self.bad("something is appended to what is no list".into())),
        }
        Ok(())
    }

    fn set(&mut self, items: Vec<Id>) -> Result<(), ReadError> {
        let dict = self.top()?;
        let (pairs, rest) = items.as_chunks::<2>();
        match &mut self.nodes[dict as usize] {
            Node::Dict { pairs: old, .. } if rest.is_empty() => {
                old.extend(pairs.iter().map(|&[k, v]| (k, v)))
            }
            _ => return Err(self.bad("keys and values are set in what is no dictionary".into())),
        }
        Ok(())
    }

    fn remember(&mut self, width: usize) -> Result<(), ReadError> {
        let key = self.word(width)? as u32;
        self.remember_as(key)
    }

    fn remember_as(&mut self, key: u32) -> Result<(), ReadError> {
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
            Some(global) => self.push(Node::Global(global)),
            None => {
                let (module, name) = (shown(module), shown(name));
                let at = self.opcode;
                Err(self
                    .unsupported(format!("the Python object `{module}.{name}` (at byte {at} of `data.pkl`)")))
            }
        }
    }

    fn range(&mut self, length: u64) -> Result<Range<usize>, ReadError> {
        let left = self.pickle.len() - self.at;
        if length > left as u64 {
            return Err(self.bad(format!("{length} bytes should follow, {left} do")));
        }
        let start = self.at;
        self.at += length as usize;
        Ok(start..self.at)
    }

    fn take(&mut self, length: u64) -> Result<&'a [u8], ReadError> {
        let range = self.range(length)?;
        Ok(&self.pickle[range])
    }

    /// A little-endian number of up to 8 bytes.
    fn word(&mut self, width: usize) -> Result<u64, ReadError> {
        let bytes = self.take(width as u64)?;
        Ok(bytes.iter().rev().fold(0, |word, &b| word << 8 | b as u64))
    }

    fn line(&mut self) -> Result<&'a [u8], ReadError> {
        let rest = &self.pickle[self.at..];
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
        self.push(Node::Int(value as i64))
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
        self.push(Node::Int(value))
    }

    fn text(&mut self, width: usize) -> Result<(), ReadError> {
        let length = self.word(width)?;
        let range = self.range(length)?;
        if std::str::from_utf8(&self.pickle[range.clone()]).is_err() {
            return Err(self.bad("text that is not UTF-8".into()));
        }
        self.push(Node::Str(range))
    }

    fn bytes(&mut self, width: usize) -> Result<(), ReadError> {
        let length = self.word(width)?;
        let range = self.range(length)?;
        self.push(Node::Bytes(range))
    }
}

//! A look through an ONNX file before an engine sees it: what it takes and gives, and whether it is sane.
//!
//! Engines reserve what a file claims, follow the names of other files, and trust that a graph is one. So
//! the file is walked once in place ([`wire`](super::wire)), nothing reserved, and refused when
//!
//! - weights lie in another file (absolute, relative or missing: nothing else is ever opened),
//! - a tensor does not hold exactly as many numbers as its extents promise,
//! - a weight is NaN, or infinite outside a single constant (−∞ is a usual filler of attention masks),
//! - a node uses what is made later or nowhere (a cycle, or no order), or graphs nest too deeply,
//! - constants ask for an array beyond [`MAX_ELEMENTS`],
//! - it holds functions, training graphs or sparse weights, which no file of these networks does.
//!
//! Constants are followed through the few operators that extents are computed with. What depends on the
//! picture's shape is not: the built-in engine bounds that once it knows every shape of the graph.

use super::wire::{Broken, Field, Message, Value};
use std::collections::{HashMap, HashSet};
use std::fmt;

/// Graphs inside graphs (`If`, `Loop`). Public files have one level.
const MAX_DEPTH: usize = 8;
/// Nodes of all graphs together. Public files have under 3000.
const MAX_NODES: usize = 100_000;
/// Axes of a tensor.
const MAX_RANK: usize = 8;
/// Names, attributes and tensors of all graphs together: each costs an engine far more than its bytes here.
const MAX_PARTS: usize = 2_000_000;
/// Bytes of what no engine needs: remarks on shapes, metadata.
const MAX_ASIDE: usize = 64 << 20;
/// Elements of one array that constants may ask for: 1 GiB of float32.
pub(super) const MAX_ELEMENTS: f64 = (1u64 << 28) as f64;

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
    pub(super) weights: [u64; 3],
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

/// Why a file is not handed to an engine.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// Not the bytes of an ONNX file.
    Broken(Broken),
    /// Understood, and refused: what, and the way out.
    Refused(String, &'static str),
}

impl From<Broken> for Fault {
    fn from(broken: Broken) -> Fault {
        Fault::Broken(broken)
    }
}

const HINT_EXPORT: &str = "take the single float32 file that the network's publisher offers";
const HINT_EXTERNAL: &str =
    "take a file that holds its weights itself; `onnx.save(onnx.load(FILE), NEW)` in Python makes one";
const HINT_DAMAGED: &str = "take the file from its publisher again; this one is damaged or made to harm";

fn refused<T>(problem: impl Into<String>, hint: &'static str) -> Result<T, Fault> {
    Err(Fault::Refused(problem.into(), hint))
}

/// Text of a file as it may be shown: no control characters, not endless.
fn shown(text: &str) -> String {
    let mut short: String = text.chars().take(80).flat_map(char::escape_debug).collect();
    if text.chars().nth(80).is_some() {
        short.push('…');
    }
    short
}

/// Walks the whole file.
pub(super) fn scan(bytes: &[u8]) -> Result<Interface, Fault> {
    let mut walk = Walk::default();
    let mut graph = None;
    for field in (Message { bytes, at: 0 }).fields() {
        let field = field?;
        match field.number {
            7 => once(&mut graph, field.message()?, &field)?,
            14 => walk.aside(&field)?,
            20 => return refused("it holds a training graph", HINT_EXPORT),
            25 => return refused("it holds functions of its own", HINT_EXPORT),
            _ => {}
        }
    }
    let Some(graph) = graph else {
        return Err(Broken::new(0, "it holds no graph").into());
    };
    walk.graph(graph, &mut Vec::new())?;
    let Walk { inputs, outputs, weights, .. } = walk;
    Ok(Interface { inputs, outputs, weights })
}

/// A field that may stand only once: engines would merge the two, and see what was not looked at.
fn once<T>(slot: &mut Option<T>, value: T, field: &Field<'_>) -> Result<(), Broken> {
    match slot.replace(value) {
        None => Ok(()),
        Some(_) => Err(Broken::new(field.at, format!("field {} stands twice", field.number))),
    }
}

#[derive(Default)]
struct Walk<'a> {
    inputs: Vec<Port>,
    outputs: Vec<Port>,
    weights: [u64; 3],
    nodes: usize,
    parts: usize,
    aside: usize,
    /// Factor by which `Tile` and `Resize` with constant factors may have grown arrays so far.
    growth: f64,
    /// Small constants by name: what sizes are made of.
    small: HashMap<&'a str, Vec<f64>>,
}

/// What is said of one tensor.
#[derive(Default)]
struct Tensor<'a> {
    name: &'a str,
    /// Its numbers, when they are few.
    small: Option<Vec<f64>>,
}

#[derive(Default)]
struct Node<'a> {
    inputs: Vec<&'a str>,
    outputs: Vec<&'a str>,
    name: &'a str,
    op: &'a str,
    attributes: Vec<Message<'a>>,
}

impl<'a> Walk<'a> {
    fn part(&mut self) -> Result<(), Fault> {
        self.parts += 1;
        if self.parts > MAX_PARTS {
            return refused(format!("it has more than {MAX_PARTS} parts"), HINT_DAMAGED);
        }
        Ok(())
    }

    fn aside(&mut self, field: &Field<'_>) -> Result<(), Fault> {
        self.aside += field.message()?.bytes.len() + 16;
        if self.aside > MAX_ASIDE {
            return refused(format!("it holds more than {} MiB of remarks", MAX_ASIDE >> 20), HINT_DAMAGED);
        }
        Ok(())
    }

    fn graph(&mut self, graph: Message<'a>, outer: &mut Vec<HashSet<&'a str>>) -> Result<(), Fault> {
        if outer.len() >= MAX_DEPTH {
            return refused(format!("its graphs nest deeper than {MAX_DEPTH}"), HINT_DAMAGED);
        }
        let (mut nodes, mut inputs, mut outputs) = (Vec::new(), Vec::new(), Vec::new());
        let mut here = HashSet::new();
        let mut initialised = HashSet::new();
        for field in graph.fields() {
            let field = field?;
            match field.number {
                1 => {
                    self.nodes += 1;
                    if self.nodes > MAX_NODES {
                        return refused(format!("it has more than {MAX_NODES} nodes"), HINT_DAMAGED);
                    }
                    nodes.push(field.message()?);
                }
                5 => {
                    let tensor = self.tensor(field.message()?)?;
                    initialised.insert(tensor.name);
                    here.insert(tensor.name);
                    if let Some(small) = tensor.small {
                        self.small.insert(tensor.name, small);
                    }
                }
                11 => {
                    self.part()?;
                    inputs.push(field.message()?);
                }
                12 => {
                    self.part()?;
                    outputs.push(field.message()?);
                }
                13 | 14 | 16 => self.aside(&field)?,
                15 => return refused("it holds sparse weights", HINT_EXPORT),
                _ => {}
            }
        }
        let top = outer.is_empty();
        for message in inputs {
            let (name, port) = port(message)?;
            here.insert(name);
            // older files list their weights among the inputs
            if top && !initialised.contains(name) {
                self.inputs.push(port);
            }
        }
        let nodes: Vec<Node<'a>> = nodes.into_iter().map(|m| self.node(m)).collect::<Result<_, _>>()?;
        let made: HashSet<&str> = nodes.iter().flat_map(|n| n.outputs.iter().copied()).collect();
        outer.push(here);
        for node in &nodes {
            for name in node.inputs.iter().filter(|n| !n.is_empty()) {
                if !outer.iter().any(|scope| scope.contains(name)) {
                    let (node, name, later) = (shown(node.name), shown(name), made.contains(name));
                    let why = if later {
                        "which is made after it: the graph runs in a circle or is out of order"
                    } else {
                        "which nothing makes"
                    };
                    return refused(format!("its node `{node}` uses `{name}`, {why}"), HINT_DAMAGED);
                }
            }
            for attribute in &node.attributes {
                self.attribute(*attribute, node, outer)?;
            }
            self.follow(node);
            self.sizes(node)?;
            let scope = outer.last_mut().expect("pushed above");
            for name in node.outputs.iter().filter(|n| !n.is_empty()) {
                if !scope.insert(name) {
                    return refused(format!("`{}` is made twice", shown(name)), HINT_DAMAGED);
                }
            }
        }
        for message in outputs {
            let (name, port) = port(message)?;
            if !outer.iter().any(|scope| scope.contains(name)) {
                return refused(format!("nothing makes its output `{}`", shown(name)), HINT_DAMAGED);
            }
            if top {
                self.outputs.push(port);
            }
        }
        outer.pop();
        Ok(())
    }

    fn node(&mut self, message: Message<'a>) -> Result<Node<'a>, Fault> {
        let mut node = Node::default();
        for field in message.fields() {
            let field = field?;
            match field.number {
                1 => node.inputs.push(field.text()?),
                2 => node.outputs.push(field.text()?),
                3 => node.name = field.text()?,
                4 => node.op = field.text()?,
                5 => node.attributes.push(field.message()?),
                9 | 10 => self.aside(&field)?,
                _ => continue,
            }
            self.part()?;
        }
        // a compiled piece for some device, named by path
        if node.op == "EPContext" {
            return refused("it holds a piece compiled for one device", HINT_EXPORT);
        }
        Ok(node)
    }

    fn attribute(
        &mut self,
        message: Message<'a>,
        node: &Node<'a>,
        outer: &mut Vec<HashSet<&'a str>>,
    ) -> Result<(), Fault> {
        let mut numbers = Vec::new();
        let (mut tensor, mut graph) = (None, None);
        for field in message.fields() {
            let field = field?;
            match field.number {
                2 | 7 => {
                    let from = numbers.len();
                    floats(&field, |v| {
                        if numbers.len() < from + SMALL {
                            numbers.push(f64::from(v));
                        }
                        !v.is_nan()
                    })?;
                }
                3 => numbers.push(field.integer()? as f64),
                8 => {
                    integers(&field, |v| {
                        if numbers.len() < SMALL {
                            numbers.push(v as f64);
                        }
                    })?;
                }
                5 => {
                    once(&mut tensor, (), &field)?;
                    let found = self.tensor(field.message()?)?;
                    numbers.extend(found.small.into_iter().flatten());
                }
                6 => {
                    once(&mut graph, (), &field)?;
                    self.graph(field.message()?, outer)?;
                }
                9 => self.part()?,
                10 => {
                    self.tensor(field.message()?)?;
                }
                11 => self.graph(field.message()?, outer)?,
                14 | 15 => self.aside(&field)?,
                22 | 23 => return refused("it holds sparse weights", HINT_EXPORT),
                _ => {}
            }
        }
        if node.op == "Constant"
            && let Some(name) = node.outputs.first()
            && numbers.len() <= SMALL
        {
            self.small.insert(name, numbers);
        }
        Ok(())
    }

    /// Computes small constants from small constants, as an engine will.
    fn follow(&mut self, node: &Node<'a>) {
        let known: Option<Vec<&Vec<f64>>> = node.inputs.iter().map(|name| self.small.get(name)).collect();
        let Some(known) = known.filter(|k| !k.is_empty()) else { return };
        let each = |f: fn(f64, f64) -> f64| {
            let (a, b) = (known.first()?, known.get(1)?);
            let n = a.len().max(b.len());
            let at = |v: &[f64], i: usize| if v.len() == 1 { Some(v[0]) } else { v.get(i).copied() };
            (0..n).map(|i| Some(f(at(a, i)?, at(b, i)?))).collect::<Option<Vec<f64>>>()
        };
        let made = match node.op {
            "Identity" | "Cast" | "Unsqueeze" | "Squeeze" | "Reshape" => Some(known[0].clone()),
            "Concat" => Some(known.iter().flat_map(|v| v.iter().copied()).collect())
                .filter(|v: &Vec<f64>| v.len() <= SMALL),
            "Add" => each(|a, b| a + b),
            "Sub" => each(|a, b| a - b),
            "Mul" => each(|a, b| a * b),
            "Pow" => each(f64::powf),
            _ => None,
        };
        if let (Some(made), Some(name)) = (made, node.outputs.first()) {
            self.small.insert(name, made);
        }
    }

    /// Refuses a node whose constants ask for an array no picture needs.
    fn sizes(&mut self, node: &Node<'a>) -> Result<(), Fault> {
        let constant = |i: usize| node.inputs.get(i).and_then(|name| self.small.get(name));
        let product = |v: &Vec<f64>| v.iter().map(|x| x.abs().max(1.0)).product::<f64>();
        let asked = match node.op {
            "ConstantOfShape" => constant(0).map(product),
            "Expand" => constant(1).map(product),
            "OneHot" => constant(1).map(product),
            "Range" => {
                let ends = [0, 1].into_iter().filter_map(constant).flatten();
                let step = constant(2).and_then(|v| v.first()).map_or(1.0, |v| v.abs());
                Some(ends.fold(0.0, |a: f64, v| a.max(v.abs())) / step.max(1e-9))
            }
            "Pad" => constant(1).map(|v| v.iter().fold(0.0, |a: f64, p| a.max(p.abs()))),
            "Tile" => constant(1).map(product),
            "Resize" => {
                let scales = constant(2).filter(|v| !v.is_empty()).map(product).unwrap_or(1.0);
                let sizes = constant(3).map(product).unwrap_or(1.0);
                Some(scales.max(sizes))
            }
            _ => None,
        };
        let mut asked = asked.unwrap_or(1.0);
        if node.op == "Tile" {
            // each may be fed with what the one before has made
            self.growth = self.growth.max(1.0) * asked;
            asked = self.growth;
        }
        if asked.is_nan() || asked > MAX_ELEMENTS {
            let (op, name) = (shown(node.op), shown(node.name));
            return refused(format!("its node `{name}` ({op}) asks for {asked:.0} numbers"), HINT_DAMAGED);
        }
        Ok(())
    }

    /// Looks through one tensor; its data must be there, all of it and no more.
    fn tensor(&mut self, message: Message<'a>) -> Result<Tensor<'a>, Fault> {
        self.part()?;
        let mut name = "";
        let (mut kind, mut raw, mut place) = (None, None, None);
        let mut dims: Vec<i64> = Vec::new();
        let mut counted = 0u64;
        let mut check = Check::default();
        let mut lists = Vec::new();
        for field in message.fields() {
            let field = field?;
            match field.number {
                1 => integers(&field, |v| {
                    if dims.len() <= MAX_RANK {
                        dims.push(v);
                    }
                })?,
                2 => once(&mut kind, field.integer()?, &field)?,
                4 | 5 | 7 | 10 | 11 => lists.push(field),
                6 => {
                    self.part()?;
                    counted += 1;
                }
                8 => name = field.text()?,
                9 => once(&mut raw, field.message()?, &field)?,
                13 => return refused(elsewhere(field.message()?)?, HINT_EXTERNAL),
                14 => once(&mut place, field.integer()?, &field)?,
                16 => self.aside(&field)?,
                _ => {}
            }
        }
        if place.unwrap_or(0) != 0 {
            return refused("its weights lie in another file, which it does not name", HINT_EXTERNAL);
        }
        let kind = kind.unwrap_or(0);
        let Some(bits) = bits(kind) else {
            let problem = format!("`{}` holds numbers of the unusable ONNX type {kind}", shown(name));
            return refused(problem, HINT_EXPORT);
        };
        let count = dims
            .iter()
            .try_fold(1u64, |n, &d| u64::try_from(d).ok().and_then(|d| n.checked_mul(d)))
            .filter(|n| dims.len() <= MAX_RANK && n.checked_mul(bits).is_some());
        let Some(count) = count else {
            let problem = format!("`{}` has the impossible extents {dims:?}", shown(name));
            return refused(problem, HINT_DAMAGED);
        };
        for field in &lists {
            counted += check.list(field, kind)?;
        }
        let (promised, there, unit) = match raw {
            Some(raw) if !raw.bytes.is_empty() => {
                check.raw(raw.bytes, kind);
                (bits.saturating_mul(count).div_ceil(8), raw.bytes.len() as u64, "bytes")
            }
            _ => (count, counted, "numbers"),
        };
        if promised != there || (unit == "bytes" && counted > 0) {
            let name = shown(name);
            let problem =
                format!("`{name}` promises {promised} {unit} by its extents {dims:?}, but holds {there}");
            return refused(problem, HINT_DAMAGED);
        }
        if check.nan || (check.infinite && count > 1) {
            let what = if check.nan { "NaN" } else { "infinite" };
            return refused(format!("`{}` holds weights that are {what}", shown(name)), HINT_DAMAGED);
        }
        let class = if bits >= 32 { 0 } else { 2 - usize::from(bits == 16) };
        // sizes and indices are int64 in every file, whatever the weights are
        if kind != INT64 && kind != STRING {
            self.weights[class] += count;
        }
        Ok(Tensor { name, small: (count <= SMALL as u64).then_some(check.small) })
    }
}

/// As many numbers are remembered of a tensor: sizes are made of these.
const SMALL: usize = 16;
const FLOAT: i64 = 1;
const INT32: i64 = 6;
const INT64: i64 = 7;
const STRING: i64 = 8;
const FLOAT16: i64 = 10;
const DOUBLE: i64 = 11;
const BFLOAT16: i64 = 16;

/// Bits of one number of an ONNX type; `None` for those that no weight has.
fn bits(kind: i64) -> Option<u64> {
    Some(match kind {
        INT64 | DOUBLE | 13 => 64,
        FLOAT | INT32 | 12 => 32,
        4 | 5 | FLOAT16 | BFLOAT16 => 16,
        2 | 3 | STRING | 9 | 17..=20 => 8,
        21 | 22 => 4,
        _ => return None,
    })
}

/// What the numbers of one tensor are like.
#[derive(Default)]
struct Check {
    nan: bool,
    infinite: bool,
    small: Vec<f64>,
}

impl Check {
    fn number(&mut self, v: f64) {
        self.nan |= v.is_nan();
        self.infinite |= v.is_infinite();
        if self.small.len() < SMALL {
            self.small.push(v);
        }
    }

    /// Numbers as they lie in memory, little-endian.
    fn raw(&mut self, bytes: &[u8], kind: i64) {
        match kind {
            FLOAT => bytes.as_chunks().0.iter().for_each(|b| self.number(f64::from(f32::from_le_bytes(*b)))),
            DOUBLE => bytes.as_chunks().0.iter().for_each(|b| self.number(f64::from_le_bytes(*b))),
            FLOAT16 | BFLOAT16 => {
                bytes.as_chunks().0.iter().for_each(|b| self.number(half(u16::from_le_bytes(*b), kind)));
            }
            INT64 => bytes.as_chunks().0.iter().for_each(|b| self.number(i64::from_le_bytes(*b) as f64)),
            INT32 => bytes.as_chunks().0.iter().for_each(|b| self.number(f64::from(i32::from_le_bytes(*b)))),
            _ => {}
        }
    }

    /// Numbers as a list of the message; how many there were.
    fn list(&mut self, field: &Field<'_>, kind: i64) -> Result<u64, Broken> {
        let mut n = 0;
        match field.number {
            4 => floats(field, |v| {
                n += 1;
                self.number(f64::from(v));
                true
            })?,
            10 => match field.value {
                Value::Eight(b) => {
                    n += 1;
                    self.number(f64::from_le_bytes(b));
                }
                Value::Bytes(m) if m.bytes.len() % 8 == 0 => {
                    for b in m.bytes.as_chunks().0 {
                        n += 1;
                        self.number(f64::from_le_bytes(*b));
                    }
                }
                _ => return Err(Broken::new(field.at, "a list of doubles is cut short")),
            },
            _ => integers(field, |v| {
                n += 1;
                let halves = field.number == 5 && (kind == FLOAT16 || kind == BFLOAT16);
                self.number(if halves { half(v as u16, kind) } else { v as f64 });
            })?,
        }
        Ok(n)
    }
}

/// A 16-bit float of either kind, exactly enough to know its size and whether it is a number.
fn half(word: u16, kind: i64) -> f64 {
    if kind == BFLOAT16 {
        return f64::from(f32::from_bits(u32::from(word) << 16));
    }
    let (exponent, fraction) = (i32::from(word >> 10 & 31), f64::from(word & 1023));
    let size = match (exponent, word & 1023) {
        (31, 0) => f64::INFINITY,
        (31, _) => f64::NAN,
        (0, _) => fraction * 2f64.powi(-24),
        _ => (1.0 + fraction / 1024.0) * 2f64.powi(exponent - 15),
    };
    if word >> 15 == 1 { -size } else { size }
}

/// Calls `each` with the integers of a field, packed or one by one.
fn integers(field: &Field<'_>, mut each: impl FnMut(i64)) -> Result<(), Broken> {
    match field.value {
        Value::Number(v) => each(v as i64),
        Value::Bytes(m) => {
            let mut at = 0;
            while at < m.bytes.len() {
                let (v, next) = m.varint(at)?;
                each(v as i64);
                at = next;
            }
        }
        _ => return Err(Broken::new(field.at, "a list of integers holds something else")),
    }
    Ok(())
}

/// Calls `sound` with the floats of a field, packed or one by one; false is an error.
fn floats(field: &Field<'_>, mut sound: impl FnMut(f32) -> bool) -> Result<(), Broken> {
    let all = match field.value {
        Value::Four(b) => sound(f32::from_le_bytes(b)),
        Value::Bytes(m) if m.bytes.len() % 4 == 0 => {
            m.bytes.as_chunks().0.iter().fold(true, |ok, b| sound(f32::from_le_bytes(*b)) && ok)
        }
        _ => return Err(Broken::new(field.at, "a list of floats is cut short")),
    };
    if all { Ok(()) } else { Err(Broken::new(field.at, "a setting is NaN")) }
}

/// The sentence for weights in another file, with the file's name.
fn elsewhere(entry: Message<'_>) -> Result<String, Broken> {
    let (mut key, mut value) = ("", "");
    for field in entry.fields() {
        let field = field?;
        match field.number {
            1 => key = field.text()?,
            2 => value = field.text()?,
            _ => {}
        }
    }
    Ok(match key {
        "location" => format!("its weights lie in another file, `{}`", shown(value)),
        _ => "its weights lie in another file".into(),
    })
}

/// Name and description of an input or output.
fn port(message: Message<'_>) -> Result<(&str, Port), Broken> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixteen_bit_floats_are_read_as_their_tables_say() {
        // sign 0, exponent 15, fraction 512: 1.5; largest 65504; smallest 2⁻²⁴
        for (word, value) in [(0x3e00, 1.5), (0xbe00, -1.5), (0x7bff, 65504.0), (1, 2f64.powi(-24))] {
            assert_eq!(half(word, FLOAT16), value);
        }
        assert!(half(0x7c01, FLOAT16).is_nan() && half(0x7fc0, BFLOAT16).is_nan());
        assert_eq!(half(0xfc00, FLOAT16), f64::NEG_INFINITY);
        assert_eq!(half(0x3fc0, BFLOAT16), 1.5);
    }
}

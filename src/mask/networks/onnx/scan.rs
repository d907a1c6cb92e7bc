//! A look through an ONNX file before an engine sees it: what it takes and gives, and whether it is sane.
//!
//! Engines reserve what a file claims, follow the names of other files, and trust that a graph is one. So
//! the file is walked once in place ([`wire`](super::wire)), nothing reserved, and refused when
//!
//! - weights lie in another file (absolute, relative or missing: nothing else is ever opened),
//! - a tensor does not hold exactly as many numbers as its extents promise,
//! - a weight is NaN, or infinite outside a single constant (−∞ is a usual filler of attention masks),
//! - a node uses what is made later or nowhere (a cycle, or no order), or graphs nest too deeply,
//! - constants ask for an array beyond [`MAX_ELEMENTS`](sizes::MAX_ELEMENTS),
//! - it holds functions, training graphs or sparse weights, which no file of these networks does.
//!
//! Constants are followed through the few operators that extents are computed with. What depends on the
//! picture's shape is not: the built-in engine bounds that once it knows every shape of the graph.

mod numbers;
mod ports;
mod sizes;
mod weights;

pub use self::ports::{Interface, Kind, Port};

use self::numbers::{SMALL, floats, integers};
use self::ports::port;
use super::wire::{Broken, Field, Message};
use std::collections::{HashMap, HashSet};

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
}

//! Constants that say how large an array shall be.

use super::numbers::SMALL;
use super::{Fault, HINT_DAMAGED, Node, Walk, refused, shown};

/// Elements of one array that constants may ask for: 1 GiB of float32.
pub(in crate::mask::networks::onnx) const MAX_ELEMENTS: f64 = (1u64 << 28) as f64;

impl<'a> Walk<'a> {
    /// Computes small constants from small constants, as an engine will.
    pub(super) fn follow(&mut self, node: &Node<'a>) {
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
    pub(super) fn sizes(&mut self, node: &Node<'a>) -> Result<(), Fault> {
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
}

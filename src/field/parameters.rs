//! Trained arrays with their AdamW moments: on the host, as checkpoints hold them, and on the device that trains.
//!
//! A group is what the optimizer steps at one rate, one flat array; in checkpoints each of its parts has its own name.
//! Groups have their own learning rate and decay, the hash table updates touched rows only,
//! and the moments lie in the same safetensors checkpoint as the weights, so that a resumed run gives the same bytes.

use super::checkpoint::Checkpoint;
use super::ops::ArrayDevice;
use crate::Result;
use crate::kernel::cpu::adam::AdamStep;

/// A named array of a group.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Its name in checkpoints.
    pub name: &'static str,
    /// Its shape there.
    pub shape: Vec<usize>,
}

impl Part {
    /// How many values it has.
    pub fn count(&self) -> usize {
        self.shape.iter().product()
    }
}

/// A group on the host.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HostGroup {
    /// Its parts, one after the other.
    pub parts: Vec<Part>,
    /// Values, running mean of the gradient and that of its square.
    pub state: [Vec<f32>; 3],
}

/// Names of a group's arrays in checkpoints.
const KINDS: [&str; 3] = ["model", "first", "second"];

impl HostGroup {
    /// Returns a group of these parts and values, with zero moments.
    pub fn new(parts: Vec<Part>, values: Vec<f32>) -> HostGroup {
        assert_eq!(values.len(), parts.iter().map(Part::count).sum::<usize>());
        let zeros = vec![0.0; values.len()];
        HostGroup { parts, state: [values, zeros.clone(), zeros] }
    }

    /// Returns a group of one flat array.
    pub fn flat(name: &'static str, values: Vec<f32>) -> HostGroup {
        HostGroup::new(vec![Part { name, shape: vec![values.len()] }], values)
    }

    /// Returns the values.
    pub fn values(&self) -> &[f32] {
        &self.state[0]
    }

    /// Is every value a finite number?
    pub fn is_finite(&self) -> bool {
        self.values().iter().all(|v| v.is_finite())
    }

    /// Makes the moments zero, as before the first step.
    pub fn forget_moments(&mut self) {
        self.state[1..].iter_mut().for_each(|moment| moment.fill(0.0));
    }

    /// Puts it into a checkpoint; without the moments where no training goes on from it.
    pub fn save(&self, into: &mut Checkpoint, with_moments: bool) {
        let kinds = KINDS.into_iter().zip(&self.state).take(if with_moments { 3 } else { 1 });
        for (kind, values) in kinds {
            let mut rest = &values[..];
            for part in &self.parts {
                let own = rest.split_off(..part.count()).expect("a value for each of the parts'");
                into.put_floats(&format!("{kind}.{}", part.name), &part.shape, own.to_vec());
            }
        }
    }

    /// Takes parts of exactly these shapes out of a checkpoint, with zero moments where no training goes on from it;
    /// nothing is reserved by what the shapes say.
    pub fn restore(parts: Vec<Part>, from: &mut Checkpoint, with_moments: bool) -> Result<HostGroup> {
        let mut state = [Vec::new(), Vec::new(), Vec::new()];
        for part in &parts {
            let name = |kind: &str| format!("{kind}.{}", part.name);
            let value = from.floats(&name(KINDS[0]), &part.shape)?;
            let (first, second) = match with_moments {
                true => {
                    (from.floats(&name(KINDS[1]), &part.shape)?, from.squares(&name(KINDS[2]), &part.shape)?)
                }
                false => (vec![0.0; value.len()], vec![0.0; value.len()]),
            };
            state.iter_mut().zip([value, first, second]).for_each(|(all, own)| all.extend(own));
        }
        Ok(HostGroup { parts, state })
    }
}

/// A group on the device that trains it.
pub struct ParameterGroup<D: ArrayDevice> {
    parts: Vec<Part>,
    /// Values, running mean of the gradient and that of its square.
    state: [D::Array; 3],
    /// Zero before the backward of a step, which adds to it or writes it.
    pub gradient: D::Array,
}

impl<D: ArrayDevice> ParameterGroup<D> {
    /// Copies a group to the device.
    pub fn upload(device: &D, group: HostGroup) -> ParameterGroup<D> {
        let gradient = device.upload(vec![0.0; group.values().len()]);
        ParameterGroup { parts: group.parts, state: group.state.map(|v| device.upload(v)), gradient }
    }

    /// Waits for the device and copies the group to the host.
    pub fn download(&self, device: &D) -> Result<HostGroup> {
        let [values, first, second] = self.state.each_ref().map(|array| device.download(array));
        Ok(HostGroup { parts: self.parts.clone(), state: [values?, first?, second?] })
    }

    /// The values.
    pub fn value(&self) -> &D::Array {
        &self.state[0]
    }

    /// The values, to change them in place.
    pub fn value_mut(&mut self) -> &mut D::Array {
        &mut self.state[0]
    }

    /// Values, beside the gradient to be written.
    pub fn value_and_gradient(&mut self) -> (&D::Array, &mut D::Array) {
        (&self.state[0], &mut self.gradient)
    }

    /// Makes an optimizer step, and the gradient zero, where the gate is open.
    pub fn step(&mut self, device: &D, step: &AdamStep, gate: D::Gate<'_>) {
        device.adam(self.state.each_mut(), &mut self.gradient, step, gate);
    }
}

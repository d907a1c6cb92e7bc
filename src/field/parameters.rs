//! Trained arrays with their AdamW moments: on the host, as checkpoints hold them, and on the
//! device that trains.
//!
//! A group is one flat array of parameters with a common learning rate and weight decay; in
//! checkpoints each of its parts has its own name. The hash table updates touched rows only.
//! Checkpoints store the moments beside the weights, so that a resumed run gives the same bytes.

use super::checkpoint::Checkpoint;
use super::ops::ArrayDevice;
use tiface_base::Result;
use tiface_kernels::cpu::adam::AdamStep;

/// A named array of a group.
#[derive(Clone, Debug, PartialEq)]
pub struct ParameterPart {
    /// Name in checkpoints.
    pub name: &'static str,
    /// Shape in checkpoints.
    pub shape: Vec<usize>,
}

impl ParameterPart {
    /// Returns the number of values.
    pub fn count(&self) -> usize {
        self.shape.iter().product()
    }
}

/// A group on the host.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HostGroup {
    /// Parts, concatenated in this order.
    pub parts: Vec<ParameterPart>,
    /// Values, running mean of the gradient, and running mean of its square.
    pub state: [Vec<f32>; 3],
}

/// Prefixes of a group's arrays in checkpoints.
const PREFIXES: [&str; 3] = ["model", "first", "second"];

impl HostGroup {
    /// Creates a group from parts and values, with zero moments.
    pub fn new(parts: Vec<ParameterPart>, values: Vec<f32>) -> HostGroup {
        assert_eq!(values.len(), parts.iter().map(ParameterPart::count).sum::<usize>());
        let zeros = vec![0.0; values.len()];
        HostGroup { parts, state: [values, zeros.clone(), zeros] }
    }

    /// Creates a group with a single part, a flat array.
    pub fn flat(name: &'static str, values: Vec<f32>) -> HostGroup {
        HostGroup::new(vec![ParameterPart { name, shape: vec![values.len()] }], values)
    }

    /// Returns the values.
    pub fn values(&self) -> &[f32] {
        &self.state[0]
    }

    /// Returns whether every value is finite.
    pub fn is_finite(&self) -> bool {
        self.values().iter().all(|v| v.is_finite())
    }

    /// Resets the moments to zero, as before the first step.
    pub fn reset_moments(&mut self) {
        self.state[1..].iter_mut().for_each(|moment| moment.fill(0.0));
    }

    /// Writes the group into a checkpoint, without moments if no training will resume from it.
    pub fn save(&self, into: &mut Checkpoint, with_moments: bool) {
        let prefixes = PREFIXES.into_iter().zip(&self.state).take(if with_moments { 3 } else { 1 });
        for (kind, values) in prefixes {
            let mut rest = &values[..];
            for part in &self.parts {
                let part_values = rest.split_off(..part.count()).expect("a value for each of the parts'");
                into.put_floats(&format!("{kind}.{}", part.name), &part.shape, part_values.to_vec());
            }
        }
    }

    /// Reads parts of exactly these shapes from a checkpoint. Without `with_moments` the moments
    /// are zero. Memory is allocated only for tensors that the file really holds, independent of
    /// the claimed shapes.
    pub fn restore(
        parts: Vec<ParameterPart>,
        from: &mut Checkpoint,
        with_moments: bool,
    ) -> Result<HostGroup> {
        let mut state = [Vec::new(), Vec::new(), Vec::new()];
        for part in &parts {
            let name = |kind: &str| format!("{kind}.{}", part.name);
            let value = from.floats(&name(PREFIXES[0]), &part.shape)?;
            let (first, second) = match with_moments {
                true => (
                    from.floats(&name(PREFIXES[1]), &part.shape)?,
                    from.squares(&name(PREFIXES[2]), &part.shape)?,
                ),
                false => (vec![0.0; value.len()], vec![0.0; value.len()]),
            };
            state.iter_mut().zip([value, first, second]).for_each(|(group, part)| group.extend(part));
        }
        Ok(HostGroup { parts, state })
    }
}

/// A group on the device that trains it.
pub struct ParameterGroup<D: ArrayDevice> {
    parts: Vec<ParameterPart>,
    /// Values, running mean of the gradient, and running mean of its square.
    state: [D::Array; 3],
    /// Gradient; zero before the backward pass of a step, which adds to it or overwrites it.
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

    /// Returns the values.
    pub fn value(&self) -> &D::Array {
        &self.state[0]
    }

    /// Returns the values for changes in place.
    pub fn value_mut(&mut self) -> &mut D::Array {
        &mut self.state[0]
    }

    /// Returns the values, and the gradient for writing.
    pub fn value_and_gradient(&mut self) -> (&D::Array, &mut D::Array) {
        (&self.state[0], &mut self.gradient)
    }

    /// Makes an optimizer step and zeroes the gradient, if the gate is open.
    pub fn step(&mut self, device: &D, step: &AdamStep, gate: D::Gate<'_>) {
        device.adam(self.state.each_mut(), &mut self.gradient, step, gate);
    }
}

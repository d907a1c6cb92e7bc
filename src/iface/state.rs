//! What a training of I-Face keeps between steps, and how it lies in a checkpoint.

use super::model::SdfModel;
use super::occupancy::Occupancy;
use crate::Result;
use crate::config::iface::IfaceConfig;
use crate::field::checkpoint::Checkpoint;
use crate::kernel::march::Bitmask;
use burn::tensor::Device;

/// Version of the checkpoints' layout.
pub const FORMAT: &str = "tiface-iface-1";

/// Training between two steps.
pub struct SdfState {
    /// Parameters with the optimizer's moments.
    pub model: SdfModel,
    /// Cells to march through.
    pub occupancy: Occupancy,
    /// Rays of the next step.
    pub rays: usize,
}

impl SdfState {
    /// Returns the state before the first step.
    pub fn new(config: &IfaceConfig, seed: u64, hull: Option<&Bitmask>, device: &Device) -> SdfState {
        SdfState {
            model: SdfModel::new(config, seed, device),
            occupancy: Occupancy::new(config, hull),
            rays: config.rays,
        }
    }

    /// Puts the state into a checkpoint.
    pub fn save(&self, into: &mut Checkpoint) {
        self.model.0.iter().for_each(|p| p.save(into, true));
        let o = &self.occupancy;
        into.put_words("occupancy.occupied", o.occupied.bits.clone());
        into.put_words("occupancy.solid", o.solid.bits.clone());
        if !o.history.is_empty() {
            into.put_floats("occupancy.history", &[o.history.len()], o.history.clone());
        }
        into.set("rays", self.rays);
    }

    /// Takes the state out of a checkpoint; names, shapes and types must be exactly the configured model's.
    pub fn restore(
        config: &IfaceConfig,
        hull: Option<&Bitmask>,
        from: &mut Checkpoint,
        device: &Device,
    ) -> Result<SdfState> {
        let model = SdfModel::restore(config, from, device)?;
        let mut occupancy = Occupancy::new(config, hull);
        if !occupancy.history.is_empty() {
            occupancy.history = from.floats("occupancy.history", &[occupancy.history.len()])?;
        }
        for (name, mask) in
            [("occupancy.occupied", &mut occupancy.occupied), ("occupancy.solid", &mut occupancy.solid)]
        {
            let bits = from.words(name)?;
            if bits.len() != mask.bits.len() {
                return Err(from.wrong(format!("tensor `{name}` has another size")));
            }
            mask.bits = bits;
        }
        let most = config.rays.max(config.max_rays) as u64;
        Ok(SdfState { model, occupancy, rays: from.number("rays", 1..=most)? as usize })
    }
}

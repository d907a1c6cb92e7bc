//! What a training of I-Face keeps between steps, and how it lies in a checkpoint.

use super::model::SdfModel;
use super::occupancy::Occupancy;
use super::stereo::SurfacePoint;
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
    /// Points on which photographs agree, once they are found.
    pub stereo: Vec<SurfacePoint>,
}

impl SdfState {
    /// Returns the state before the first step.
    pub fn new(config: &IfaceConfig, seed: u64, hull: Option<&Bitmask>, device: &Device) -> SdfState {
        SdfState {
            model: SdfModel::new(config, seed, device),
            occupancy: Occupancy::new(config, hull),
            rays: config.rays,
            stereo: Vec::new(),
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
        if !self.stereo.is_empty() {
            let rows = self.stereo.iter().flat_map(|p| p.row()).collect();
            into.put_floats("stereo", &[self.stereo.len(), SurfacePoint::WIDTH], rows);
            into.set("stereo", self.stereo.len());
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
            *mask = Bitmask::of(mask.resolution, bits)
                .ok_or_else(|| from.wrong(format!("tensor `{name}` has another size")))?;
        }
        let most = config.rays.max(config.max_rays) as u64;
        let mut stereo = Vec::new();
        if from.has("stereo") {
            let count = from.number("stereo", 1..=1 << 32)? as usize;
            let rows = from.floats("stereo", &[count, SurfacePoint::WIDTH])?;
            stereo.extend(rows.chunks_exact(SurfacePoint::WIDTH).map(SurfacePoint::of_row));
        }
        Ok(SdfState { model, occupancy, rays: from.number("rays", 1..=most)? as usize, stereo })
    }
}

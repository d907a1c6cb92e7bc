//! `[baseline]`: where the field that T-Face is compared with differs from it.

use super::table::table;
use super::{MaskLoss, MaskUse, VmBackground, VmConfig};

table! {
    /// Settings of the stage `baseline`: T-Face's but for these, one field, and no masks.
    pub struct BaselineConfig;
    keys {
        /// A published checkpoint to take instead of training, converted by tools/reference/th_to_safetensors.py; empty
        /// to train.
        import: String => String::new();
        /// Optimizer steps.
        steps: u64, 1.0..=1e7 => 1500, 2000, 50_000;
        /// Rays per step: fewer than T-Face has, for whole frames cost several times a head.
        rays: usize, 1.0..=1_048_576.0 => 4096, 8192, 4096;
    }
}

impl BaselineConfig {
    /// `tface` without masks, of one field.
    ///
    /// Over black, where T-Face is over random colors: without a mask a target has no hole, and any color behind the
    /// head but the photographs' own asks for matter in front of it (19.8 instead of 23.6 dB inside the mask in a
    /// light stage all around the head).
    pub fn field(&self, tface: &VmConfig) -> VmConfig {
        VmConfig {
            import: self.import.clone(),
            steps: self.steps,
            rays: self.rays,
            fields: 1,
            masks: MaskUse::None,
            mask_loss: MaskLoss::None,
            background: match tface.background {
                VmBackground::Random => VmBackground::Black,
                other => other,
            },
            ..tface.clone()
        }
    }
}

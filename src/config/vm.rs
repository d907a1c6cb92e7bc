//! `[baseline]` and `[tface]`: TensoRF's vector-matrix radiance field and its training. Both stages are the
//! same code; they differ in what masks do, and T-Face may be the mean of several fields.

use super::Preset;
use super::iface::Foreground;
use serde::{Deserialize, Serialize};

/// What masks do to the photographs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskUse {
    /// Nothing: the field learns the whole frame, stage included.
    None,
    /// Every pixel that is a little head is head (published).
    Binary,
    /// Soft alpha.
    Soft,
}

/// How the accumulated opacity is held to the mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskLoss {
    /// Not at all.
    None,
    /// Mean of opacity² over rays that are all background (T-Face).
    L2,
    /// Binary cross entropy of opacity and mask over all rays (the paper's ablation).
    Ce,
}

/// What is behind the head while training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VmBackground {
    /// The published training: half of the batches are rendered over white against a target over black.
    Reference,
    /// Black for both.
    Black,
    /// One random colour per ray, the same for both.
    Random,
}

/// Which cells may hold anything at the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VmStart {
    /// The whole box (published).
    Box,
    /// The masks' visual hull; the box where there is none, or where masks are not used.
    Hull,
}

/// From a feature to a density.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DensityActivation {
    /// max(f, 0).
    Relu,
    /// ln(1 + exp(f + density_shift)).
    Softplus,
}

/// Rows of the paper's ablation: what of T-Face is switched on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ablation {
    /// No masks.
    Baseline,
    /// Photographs cut out by a hard mask.
    MaskBinary,
    /// Photographs cut out by a soft mask.
    MaskSoft,
    /// And cross entropy of opacity and mask.
    MaskCe,
    /// And the squared opacity of background rays: T-Face.
    MaskL2,
}

/// Settings of a vector-matrix field. Lengths are in scene units: the head's box is within [-1, 1]³.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VmConfig {
    /// A published `.th` checkpoint to take instead of training; empty to train.
    pub import: String,
    /// Length of a dataset unit in the imported checkpoint's world.
    pub import_scale: f64,
    /// Fields learned one after the other from different random numbers; their mean is what is seen. One, where it
    /// comes from a file.
    pub fields: usize,
    /// Optimiser steps of each field.
    pub steps: u64,
    /// Rays per step.
    pub rays: usize,
    /// What masks do to the photographs.
    pub masks: MaskUse,
    /// What a pixel with a soft mask should look like.
    pub foreground: Foreground,
    /// How opacity is held to the mask.
    pub mask_loss: MaskLoss,
    /// Weight of the mask loss.
    pub mask_weight: f64,
    /// What is behind the head while training.
    pub background: VmBackground,
    /// Cells at the start.
    pub start: VmStart,
    /// Draw any pixel of the frames (published), not only those near the masks.
    pub whole_frame: bool,
    /// Voxels at the start.
    pub voxels_start: u64,
    /// Voxels after the last upsampling.
    pub voxels_final: u64,
    /// Steps after which the grids are made finer.
    pub upsample_steps: Vec<u64>,
    /// Steps after which the alpha mask is rebuilt.
    pub mask_steps: Vec<u64>,
    /// Smallest alpha of a grid step that is kept in the alpha mask.
    pub mask_threshold: f64,
    /// Channels of the density's three planes: xy, xz, yz.
    pub density_rank: Vec<usize>,
    /// Channels of the appearance's three planes.
    pub color_rank: Vec<usize>,
    /// Outputs of the basis matrix.
    pub features: usize,
    /// Width of the decoder's hidden layers.
    pub hidden: usize,
    /// Frequencies of the view direction's encoding.
    pub view_frequencies: usize,
    /// Frequencies of the features' encoding.
    pub feature_frequencies: usize,
    /// From a feature to a density.
    pub activation: DensityActivation,
    /// Added to the feature before softplus.
    pub density_shift: f64,
    /// Optical lengths are scene lengths times density times this.
    pub distance_scale: f64,
    /// March step as a share of the distance of vertices.
    pub step_ratio: f64,
    /// Colour is asked only of samples with more weight.
    pub weight_threshold: f64,
    /// A ray ends where less than this of its light is left.
    pub stop: f64,
    /// Learning rate of planes and lines.
    pub lr_grid: f64,
    /// Learning rate of the basis matrix and the decoder.
    pub lr_network: f64,
    /// Learning rate after `steps` steps without a reset, as a share of the first; exponential in between.
    pub lr_final: f64,
    /// Does every upsampling start the learning rates again?
    pub lr_reset: bool,
    /// Weight of the density planes' total variation (times 0.01, as published).
    pub tv_density: f64,
    /// Weight of the appearance planes' total variation (times 0.01).
    pub tv_color: f64,
    /// Weight of the density's L1 norm until the alpha mask's first update.
    pub l1_start: f64,
    /// The same afterwards.
    pub l1_rest: f64,
    /// Weight of the lines' orthogonality.
    pub ortho: f64,
    /// Seconds between checkpoints.
    pub checkpoint_s: f64,
}

impl VmConfig {
    /// T-Face's values of a preset.
    pub fn tface(preset: Preset) -> VmConfig {
        match preset {
            Preset::Draft => VmConfig::draft(),
            Preset::Standard => VmConfig::standard(),
            Preset::Paper => VmConfig::paper(),
        }
    }

    /// The baseline's values of a preset: the same training without masks, of one field.
    ///
    /// Over black, where T-Face is over random colours: without a mask a target has no hole, and any colour
    /// behind the head but the dark stage's own asks for matter in front of it (19.8 instead of 23.6 dB inside
    /// the mask on a stage all around the head).
    pub fn baseline(preset: Preset) -> VmConfig {
        let tface = VmConfig::tface(preset);
        let background = match tface.background {
            VmBackground::Random => VmBackground::Black,
            other => other,
        };
        // whole frames cost several times a head: fewer rays a step than T-Face has, but for the published recipe
        let rays = match preset {
            Preset::Draft => 4096,
            Preset::Standard => 8192,
            Preset::Paper => tface.rays,
        };
        VmConfig { background, rays, fields: 1, ..tface.with(Ablation::Baseline) }
    }

    /// How many fields there are in the end: at least one, and no more where it comes from a file.
    pub fn learned(&self) -> usize {
        if self.import.is_empty() { self.fields.max(1) } else { 1 }
    }

    /// These settings with what a row of the ablation switches on and off.
    pub fn with(self, row: Ablation) -> VmConfig {
        let (masks, mask_loss) = match row {
            Ablation::Baseline => (MaskUse::None, MaskLoss::None),
            Ablation::MaskBinary => (MaskUse::Binary, MaskLoss::None),
            Ablation::MaskSoft => (MaskUse::Soft, MaskLoss::None),
            Ablation::MaskCe => (MaskUse::Soft, MaskLoss::Ce),
            Ablation::MaskL2 => (MaskUse::Soft, MaskLoss::L2),
        };
        VmConfig { masks, mask_loss, ..self }
    }

    /// A minute or two on two cores.
    fn draft() -> VmConfig {
        VmConfig {
            steps: 1500,
            rays: 8192,
            fields: 1,
            lr_final: 0.01,
            voxels_start: 96 * 96 * 96,
            voxels_final: 192 * 192 * 192,
            upsample_steps: vec![150, 300, 500],
            mask_steps: vec![150, 500],
            ..VmConfig::standard()
        }
    }

    /// The default: better and slower.
    fn standard() -> VmConfig {
        VmConfig {
            // worth more than one field of 16,384 rays a step, in the same time (`tface/mean.rs`)
            fields: 2,
            // few steps of many rays are worth more than many of few
            steps: 2000,
            rays: 8192,
            masks: MaskUse::Soft,
            // as published: the views are compared with photographs times mask, and what the stage sheds on soft
            // hair belongs to those (I-Face, whose mesh leaves the stage, learns without it)
            foreground: Foreground::Photo,
            background: VmBackground::Random,
            start: VmStart::Hull,
            whole_frame: false,
            voxels_start: 128 * 128 * 128,
            voxels_final: 256 * 256 * 256,
            upsample_steps: vec![200, 400, 650, 1000],
            mask_steps: vec![200, 650],
            // planes of the published ranks favour one axis of one stage; a head may face any way
            density_rank: vec![8, 8, 8],
            color_rank: vec![24, 24, 24],
            hidden: 64,
            // the published 25 per unit of its world would be 40 here; denser matter sets a thinner surface,
            // and fewer samples of a ray need a colour, but from 200 on hair hardens
            distance_scale: 100.0,
            // half as many samples as published, at the same quality
            step_ratio: 1.0,
            weight_threshold: 1e-3,
            stop: 1e-3,
            // rates that end low take the noise of single batches out of the result
            lr_final: 0.003,
            ..VmConfig::paper()
        }
    }

    /// The published recipe (`islh_mask` of T-Face), for comparison.
    fn paper() -> VmConfig {
        VmConfig {
            import: String::new(),
            import_scale: 1.0 / 0.3,
            fields: 1,
            steps: 50_000,
            rays: 4096,
            masks: MaskUse::Binary,
            foreground: Foreground::Photo,
            mask_loss: MaskLoss::L2,
            mask_weight: 0.01,
            background: VmBackground::Reference,
            start: VmStart::Box,
            whole_frame: true,
            voxels_start: 2_097_156,
            voxels_final: 27_000_000,
            upsample_steps: vec![2000, 3000, 4000, 5500, 7000],
            mask_steps: vec![2000, 4000],
            mask_threshold: 1e-4,
            density_rank: vec![16, 4, 4],
            color_rank: vec![48, 12, 12],
            features: 27,
            hidden: 128,
            view_frequencies: 0,
            feature_frequencies: 0,
            activation: DensityActivation::Relu,
            density_shift: -10.0,
            // 25 in the published world, whose box is 3.3 units long; the scene's is 2
            distance_scale: 40.0,
            step_ratio: 0.5,
            weight_threshold: 1e-4,
            stop: 0.0,
            lr_grid: 0.02,
            lr_network: 0.001,
            lr_final: 0.1,
            lr_reset: true,
            tv_density: 1.0,
            tv_color: 1.0,
            l1_start: 0.0,
            l1_rest: 0.0,
            ortho: 0.0,
            checkpoint_s: 120.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_preset_has_the_published_numbers() {
        let p = VmConfig::tface(Preset::Paper);
        assert_eq!((p.steps, p.rays, p.voxels_start, p.voxels_final), (50_000, 4096, 2_097_156, 27_000_000));
        assert_eq!((p.density_rank, p.color_rank), (vec![16, 4, 4], vec![48, 12, 12]));
        assert_eq!((p.mask_weight, p.mask_loss, p.background), (0.01, MaskLoss::L2, VmBackground::Reference));
        let b = VmConfig::baseline(Preset::Paper);
        assert_eq!((b.masks, b.mask_loss, b.steps), (MaskUse::None, MaskLoss::None, 50_000));
    }

    #[test]
    fn what_comes_from_a_file_is_one_field() {
        let learned = VmConfig::tface(Preset::Standard);
        let imported = VmConfig { import: "official.th".into(), ..learned.clone() };
        assert_eq!((learned.learned(), imported.learned()), (2, 1));
        for one in [VmConfig::baseline(Preset::Standard), VmConfig::tface(Preset::Paper)] {
            assert_eq!(one.learned(), 1);
        }
    }
}

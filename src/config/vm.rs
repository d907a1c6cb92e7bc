//! `[baseline]` and `[tface]`: TensoRF's vector-matrix radiance field and its training. Both stages are the
//! same code; they differ in what masks do, and T-Face may be the mean of several fields.

use super::iface::Foreground;
use super::table::table;
use serde::{Deserialize, Serialize};

/// What masks do to the photographs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskUse {
    /// Nothing: the field learns the whole frame, background included.
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
    /// One random color per ray, the same for both.
    Random,
}

/// Which cells may hold anything at the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VmStart {
    /// The whole box (published).
    Box,
    /// The masks' visual hull; the box where there is none, or where masks are not used.
    #[default]
    Hull,
}

/// From a feature to a density.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DensityActivation {
    /// max(f, 0).
    #[default]
    Relu,
    /// ln(1 + exp(f + density_shift)).
    Softplus,
}

table! {
    /// Settings of a vector-matrix field. Lengths are in scene units: the head's box is within [-1, 1]³.
    pub struct VmConfig;
    keys {
        /// A published .th checkpoint to take instead of training; empty to train.
        import: String => String::new();
        /// Length of a dataset unit in the imported checkpoint's world (published: 1 / 0.3).
        import_scale: f64, 1e-6..=1e6 => 1.0 / 0.3;
        /// Fields learned one after the other from different random numbers; their mean is what is seen. Only one
        /// where import names a file. Two are worth more than one of twice the rays, in the same time.
        fields: usize, 1.0..=16.0 => 1, 2, 1;
        /// Optimizer steps of each field. Few steps of many rays are worth more than many of few.
        steps: u64, 1.0..=1e7 => 1500, 2000, 50_000;
        /// Rays per step.
        rays: usize, 1.0..=1_048_576.0 => 8192, 8192, 4096;
        /// What masks do to the photographs: none, binary (a little head is head) or soft.
        masks: MaskUse => MaskUse::Soft, MaskUse::Soft, MaskUse::Binary;
        /// How opacity is held to the mask: none, l2 (opacity² of background rays) or ce (cross entropy).
        mask_loss: MaskLoss => MaskLoss::L2;
        /// Weight of the mask loss.
        mask_weight: f64, 0.0..=1e6 => 0.01;
        /// Behind the head while training: random, black, or reference (published: white in half of the batches,
        /// against a black target).
        background: VmBackground => VmBackground::Random, VmBackground::Random, VmBackground::Reference;
        /// Voxels of the box at the start.
        voxels_start: u64, 8.0..=1e12 => 96 * 96 * 96, 128 * 128 * 128, 2_097_156;
        /// Voxels of the box after the last upsampling.
        voxels_final: u64, 8.0..=1e12 => 192 * 192 * 192, 256 * 256 * 256, 27_000_000;
        /// Steps after which the grids are made finer, a rising list.
        upsample_steps: Vec<u64>, 0.0..=1e7
            => vec![150, 300, 500], vec![200, 400, 650, 1000], vec![2000, 3000, 4000, 5500, 7000];
        /// Steps after which the alpha mask is rebuilt, a rising list.
        mask_steps: Vec<u64>, 0.0..=1e7 => vec![150, 500], vec![200, 650], vec![2000, 4000];
        /// Channels of the density's planes xy, xz, yz. The published ranks favour one axis of one light stage; a
        /// head may face any way.
        density_rank: Vec<usize>, 0.0..=1024.0 => vec![8, 8, 8], vec![8, 8, 8], vec![16, 4, 4];
        /// Channels of the appearance's planes xy, xz, yz.
        color_rank: Vec<usize>, 0.0..=1024.0 => vec![24, 24, 24], vec![24, 24, 24], vec![48, 12, 12];
        /// Weight of the density planes' total variation, times 0.01.
        tv_density: f64, 0.0..=1e6 => 1.0;
        /// Weight of the appearance planes' total variation, times 0.01.
        tv_color: f64, 0.0..=1e6 => 1.0;
        /// Seconds between checkpoints.
        checkpoint_s: f64, 0.05..=86_400.0 => 120.0;
    }
    constants {
        /// What a pixel with a soft mask should look like. As published: the views are compared with photographs
        /// times mask, and what the background sheds on soft hair belongs to those (I-Face, whose mesh leaves the
        /// background, learns without it).
        foreground: Foreground => Foreground::Photo;
        /// Cells at the start.
        start: VmStart => VmStart::Hull, VmStart::Hull, VmStart::Box;
        /// Draw any pixel of the frames (published), not only those near the masks.
        whole_frame: bool => false, false, true;
        /// Smallest alpha of a grid step that is kept in the alpha mask.
        mask_threshold: f64 => 1e-4;
        /// Outputs of the basis matrix.
        features: usize => 27;
        /// Width of the decoder's hidden layers, a multiple of 8.
        hidden: usize => 64, 64, 128;
        /// Frequencies of the view direction's encoding.
        view_frequencies: usize => 0;
        /// Frequencies of the features' encoding.
        feature_frequencies: usize => 0;
        /// From a feature to a density.
        activation: DensityActivation => DensityActivation::Relu;
        /// Added to the feature before softplus.
        density_shift: f64 => -10.0;
        /// Optical lengths are scene lengths times density times this. Published are 25 in a world whose box is 3.3
        /// units long; the scene's is 2. Denser matter sets a thinner surface, and fewer samples of a ray need a
        /// color, but from 200 on hair hardens.
        distance_scale: f64 => 100.0, 100.0, 40.0;
        /// March step as a share of the distance of vertices. Half as many samples as published, at the same quality.
        step_ratio: f64 => 1.0, 1.0, 0.5;
        /// Color is evaluated only of samples with more weight.
        weight_threshold: f64 => 1e-3, 1e-3, 1e-4;
        /// A ray ends where less than this of its light is left.
        stop: f64 => 1e-3, 1e-3, 0.0;
        /// Learning rate of planes and lines.
        lr_grid: f64 => 0.02;
        /// Learning rate of the basis matrix and the decoder.
        lr_network: f64 => 0.001;
        /// Learning rate after `steps` steps without a reset, as a share of the first; exponential in between. Rates
        /// that end low take the noise of single batches out of the result.
        lr_final: f64 => 0.01, 0.003, 0.1;
        /// Does every upsampling start the learning rates again?
        lr_reset: bool => true;
        /// Weight of the density's L1 norm until the alpha mask's first update.
        l1_start: f64 => 0.0;
        /// The same afterwards.
        l1_rest: f64 => 0.0;
        /// Weight of the lines' orthogonality.
        ortho: f64 => 0.0;
    }
}

impl VmConfig {
    /// How many fields there are in the end: at least one, and no more where it comes from a file.
    pub fn learned(&self) -> usize {
        if self.import.is_empty() { self.fields.max(1) } else { 1 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};

    #[test]
    fn the_paper_preset_has_the_published_numbers() {
        let paper = Config::preset(Preset::Paper);
        let p = paper.tface.clone();
        assert_eq!((p.steps, p.rays, p.voxels_start, p.voxels_final), (50_000, 4096, 2_097_156, 27_000_000));
        assert_eq!((p.density_rank, p.color_rank), (vec![16, 4, 4], vec![48, 12, 12]));
        assert_eq!((p.mask_weight, p.mask_loss, p.background), (0.01, MaskLoss::L2, VmBackground::Reference));
        let b = paper.baseline.field(&paper.tface);
        assert_eq!((b.masks, b.mask_loss, b.steps), (MaskUse::None, MaskLoss::None, 50_000));
    }

    #[test]
    fn what_comes_from_a_file_is_one_field() {
        let standard = Config::preset(Preset::Standard);
        let learned = standard.tface.clone();
        let imported = VmConfig { import: "official.th".into(), ..learned.clone() };
        assert_eq!((learned.learned(), imported.learned()), (2, 1));
        for one in [standard.baseline.field(&standard.tface), VmConfig::preset(Preset::Paper)] {
            assert_eq!(one.learned(), 1);
        }
    }
}

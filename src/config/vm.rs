//! `[baseline]` and `[tface]`: TensoRF's vector-matrix radiance field and its training. Both stages
//! are the same code; they differ in what masks do, and T-Face may be the mean of several fields.
//! `[baseline]` has only what differs from `[tface]`.

use super::iface::Foreground;
use super::table::table;
use serde::{Deserialize, Serialize};

/// How masks are applied to the photographs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskUse {
    /// Nothing: the field learns the whole frame, background included.
    None,
    /// Every pixel that is a little head is head (published).
    Binary,
    /// Every pixel that is half head is head: what a cut without matting gives.
    Hard,
    /// Soft alpha.
    Soft,
}

/// Loss between the accumulated opacity and the mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskLoss {
    /// No mask loss.
    None,
    /// Mean of opacity² over rays that are all background (T-Face).
    L2,
    /// Binary cross entropy of opacity and mask over all rays, where every pixel that is a little
    /// head is head (the paper's ablation).
    Ce,
}

/// Background while training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VmBackground {
    /// The published training: half of the batches are rendered over white against a target over
    /// black.
    Reference,
    /// Black for both.
    Black,
    /// One random color per ray, the same for both.
    Random,
}

/// Cells that are occupied at the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VmStart {
    /// The whole box (published).
    Box,
    /// The visual hull of the masks; the box without a hull, or if masks are not used.
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
    /// Settings of a vector-matrix field. Lengths are in scene units: the head's box is within [-1,
    /// 1]³.
    pub struct VmConfig;
    keys {
        /// A published checkpoint to use instead of training, converted by
        /// tools/reference/th_to_safetensors.py; empty: train.
        import: String [nothing] => String::new();
        /// Length of a dataset unit in the imported checkpoint's world (published: 1 / 0.3).
        import_scale: f64, 1e-6..=1e6 [Tface, Baseline] => 1.0 / 0.3;
        /// Number of fields, trained one after the other with different seeds; views are their
        /// mean. Always one with `import`. Two fields are better than one with twice the rays,
        /// which takes the same time.
        fields: usize, 1.0..=16.0 [Tface] => 1, 2, 1;
        /// Optimizer steps of each field. Few steps of many rays are better than many steps of few.
        steps: u64, 1.0..=1e7 [Tface] => 1500, 2000, 50_000, 360;
        /// Rays per step.
        rays: usize, 1.0..=1_048_576.0 [Tface] => 8192, 8192, 4096;
        /// How masks are applied to the photographs: none, binary (alpha > 0 is head), hard (alpha
        /// ≥ 0.5 is head) or soft.
        masks: MaskUse [Tface] => MaskUse::Soft, MaskUse::Soft, MaskUse::Binary;
        /// Mask loss: none, l2 (opacity² of background rays) or ce (cross entropy).
        mask_loss: MaskLoss [Tface] => MaskLoss::L2;
        /// Weight of the mask loss.
        mask_weight: f64, 0.0..=1e6 [Tface] => 0.01;
        /// Background while training: random, black, or reference (published: white in half of the
        /// batches, against a black target).
        background: VmBackground [Tface, Baseline]
            => VmBackground::Random, VmBackground::Random, VmBackground::Reference;
        /// Number of voxels at the start.
        voxels_start: u64, 8.0..=1e12 [Tface, Baseline] => 96 * 96 * 96, 128 * 128 * 128, 2_097_156;
        /// Number of voxels after the last upsampling.
        voxels_final: u64, 8.0..=1e12 [Tface, Baseline] => 192 * 192 * 192, 256 * 256 * 256, 27_000_000;
        /// Shares of the steps after which the grids are upsampled, an increasing list.
        upsample_at: Vec<f64>, 0.0..=1.0 [Tface, Baseline]
            => vec![0.1, 0.2, 0.33], vec![0.1, 0.2, 0.325, 0.5], vec![0.04, 0.06, 0.08, 0.11, 0.14];
        /// Shares of the steps after which the alpha mask is rebuilt, an increasing list.
        mask_at: Vec<f64>, 0.0..=1.0 [Tface, Baseline] => vec![0.1, 0.33], vec![0.1, 0.325], vec![0.04, 0.08];
        /// Channels of the density's planes xy, xz, yz. The published ranks favor one axis of one
        /// light stage; a head may face any way.
        density_rank: Vec<usize>, 0.0..=1024.0 [Tface, Baseline]
            => vec![8, 8, 8], vec![8, 8, 8], vec![16, 4, 4];
        /// Channels of the appearance's planes xy, xz, yz.
        color_rank: Vec<usize>, 0.0..=1024.0 [Tface, Baseline]
            => vec![24, 24, 24], vec![24, 24, 24], vec![48, 12, 12];
        /// Weight of the density planes' total variation, times 0.01.
        tv_density: f64, 0.0..=1e6 [Tface, Baseline] => 1.0;
        /// Weight of the appearance planes' total variation, times 0.01.
        tv_color: f64, 0.0..=1e6 [Tface, Baseline] => 1.0;
        /// Seconds between checkpoints.
        checkpoint_s: f64, 0.05..=86_400.0 [nothing] => 120.0;
    }
    constants {
        /// Target color of a pixel with a soft mask.
        foreground: Foreground => Foreground::Estimated, Foreground::Estimated, Foreground::Photo;
        /// Cells at the start.
        start: VmStart => VmStart::Hull, VmStart::Hull, VmStart::Box;
        /// Draw as published: every valid pixel of the frames whose ray meets the box, in a random
        /// order without repetition; else those near the masks, with repetition.
        whole_frame: bool => false, false, true;
        /// Draw two of five pixels where masked photographs are smooth: 0.26 and 0.27 dB more on
        /// two heads after 360 steps, for 3 and 6 % more CPU time; nothing and 0.1 dB after 1500.
        thinned: bool => false, false, false, true;
        /// Directions have depth 1, not length 1, so that steps are longer off the axis
        /// (published).
        depth_directions: bool => false, false, true;
        /// Half of the box's longest side in units of `distance_scale`, of the step that
        /// `mask_threshold` looks at and of `near` and `far`; none: all of them are scene units.
        /// Published is a fixed box, 3.34 units long.
        box_half: Option<f64> => None, None, Some(1.67);
        /// Scene units in the unit that the alpha mask's step is counted in: see
        /// [`VmConfig::placed`].
        alpha_unit: f64 => 1.0;
        /// Rays enter the box between this depth and `far`: of the published box, and of no other.
        near: f64 => 0.0, 0.0, 3.5;
        /// See `near`.
        far: f64 => 1e6, 1e6, 7.0;
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
        /// Smallest share of the rays in steps up to the last upsampling: see
        /// [`VmConfig::rays_at`].
        early_rays: f64 => 0.5, 0.5, 1.0;
        /// Optical lengths are lengths times density times this, in scene units or those of
        /// `box_half`. Denser matter sets a thinner surface, and fewer samples of a ray need a
        /// color, but from 200 on hair hardens.
        distance_scale: f64 => 100.0, 100.0, 25.0;
        /// March step as a share of the distance of vertices. At 1.3 a draft looks up a fifth fewer
        /// densities than at 1 and decodes a seventh fewer colors for 0.06 dB on a head with hair
        /// and 0.08 dB on a bust; 1.6 costs 0.1 and 0.4 dB. Published: 0.5.
        step_ratio: f64 => 1.3, 1.0, 0.5;
        /// Color is evaluated only of samples with more weight.
        weight_threshold: f64 => 1e-3, 1e-3, 1e-4;
        /// Neighboring samples of a ray share a color until their weights sum to this (published:
        /// each has its own). At 0.05 a draft decodes 0.4 times the colors, takes two thirds of the
        /// CPU time and loses 0.01 to 0.08 dB; at 0.02 it takes three quarters and is as good or
        /// 0.05 dB better.
        group_weight: f64 => 0.05, 0.02, 0.0;
        /// Steps from one gradient of the total variation to the next, each multiplied by this
        /// number (published: 1). Under Adam the effect is weaker where this gradient dominates. At
        /// 2 a training takes some 2 % less CPU time, and its views are as good; at 4 the demo head
        /// loses 0.15 dB.
        tv_every: u64 => 2, 1, 1;
        /// A ray ends where less than this of its light is left.
        stop: f64 => 1e-3, 1e-3, 0.0;
        /// Learning rate of planes and lines.
        lr_grid: f64 => 0.02;
        /// Learning rate of the basis matrix and the decoder. A short training gains by a higher
        /// one together with a higher `lr_final`: 0.3 and 0.4 dB on two heads after 450 steps,
        /// nothing after 1500.
        lr_network: f64 => 0.001, 0.001, 0.001, 0.002;
        /// Learning rate after `steps` steps without a reset, as a share of the first; exponential
        /// in between. Every upsampling starts the rates again. Rates that end low take the noise
        /// of single batches out of the result.
        lr_final: f64 => 0.01, 0.003, 0.1, 0.1;
    }
}

/// Rays up to the last upsampling that a field needs, however few its steps are: as many as preset
/// draft has with half of its rays there. Trainings of an earlier version with all of them were
/// equal on a head with hair and 0.1 dB better on a bust. Half of the rays of the demo's 800 steps
/// of 2048 cost 0.2 dB in the same comparison, those of a hundred steps 1.2 dB.
const EARLY_RAYS: f64 = 2e6;

impl VmConfig {
    /// Scene units in a unit of the optical constants, for a field in a box.
    pub fn unit(&self, bounds: [[f32; 3]; 2]) -> f64 {
        let half = (0..3).map(|a| 0.5 * f64::from(bounds[1][a] - bounds[0][a])).fold(0.0, f64::max);
        self.box_half.map_or(1.0, |of| half / of)
    }

    /// Returns the settings of a field that starts in a box, all lengths in scene units; done once,
    /// before the box shrinks.
    ///
    /// ```
    /// # use tiface::config::{Preset, VmConfig};
    /// // a box of the published shape, 1.002 dataset units long, in a scene of that unit:
    /// // 25 / 0.3 = 83.3
    /// let c = VmConfig::preset(Preset::Paper).placed([[-0.45, -0.501, -0.3], [0.45, 0.501, 0.3]]);
    /// assert!((c.distance_scale - 25.0 / 0.3).abs() < 1e-4);
    /// ```
    pub fn placed(&self, bounds: [[f32; 3]; 2]) -> VmConfig {
        let unit = self.unit(bounds);
        let published = self.box_half.is_none() || (unit - 1.0).abs() < 1e-5;
        VmConfig {
            distance_scale: self.distance_scale / unit,
            alpha_unit: unit,
            near: if published { self.near } else { 0.0 },
            far: if published { self.far } else { 1e6 },
            box_half: None,
            ..self.clone()
        }
    }

    /// Returns which entry of a list of shares of the steps is due after `step`; the last one, if a
    /// training is so short that several are.
    pub fn due(&self, shares: &[f64], step: u64) -> Option<usize> {
        shares.iter().rposition(|share| (share * self.steps as f64).round() as u64 == step)
    }

    /// Returns the number of steps up to the last upsampling. The published order of pixels counts
    /// rays of steps that all have the same, so it has none.
    fn early_steps(&self) -> f64 {
        let share = self.upsample_at.last().copied().filter(|_| !self.whole_frame);
        share.unwrap_or(0.0).min(1.0) * self.steps as f64
    }

    /// Returns the number of rays of a step. The steps up to the last upsampling, on coarse grids,
    /// have fewer, down to `early_rays` of them, as long as they are two million together: a short
    /// training needs all of its rays.
    pub fn rays_at(&self, step: u64) -> usize {
        let early_steps = self.early_steps();
        if early_steps == 0.0 || step as f64 > early_steps {
            return self.rays;
        }
        let share = (EARLY_RAYS / (early_steps * self.rays as f64)).max(self.early_rays).min(1.0);
        ((self.rays as f64 * share) as usize).max(1)
    }

    /// Returns the sum of the rays of all steps of a field's training.
    pub fn training_rays(&self) -> f64 {
        let early_steps = self.early_steps();
        early_steps * self.rays_at(0) as f64 + (self.steps as f64 - early_steps) * self.rays as f64
    }

    /// Returns how many fields there are in the end: at least one, and no more where it comes from
    /// a file.
    pub fn learned(&self) -> usize {
        if self.import.is_empty() { self.fields.max(1) } else { 1 }
    }
}

table! {
    /// Settings of the stage `baseline`: T-Face's but for these, one field, and no masks.
    pub struct BaselineConfig;
    keys {
        /// A published checkpoint to use instead of training, converted by
        /// tools/reference/th_to_safetensors.py; empty: train.
        import: String [nothing] => String::new();
        /// Optimizer steps.
        steps: u64, 1.0..=1e7 [Baseline] => 1500, 2000, 50_000;
        /// Rays per step: fewer than T-Face has, for whole frames cost several times a head.
        rays: usize, 1.0..=1_048_576.0 [Baseline] => 4096, 8192, 4096;
    }
}

impl BaselineConfig {
    /// `tface` without masks, of one field.
    ///
    /// Over black, where T-Face is over random colors: without a mask a target has no hole, and any
    /// color behind the head but the photographs' own asks for matter in front of it (19.8 instead
    /// of 23.6 dB inside the mask in a light stage all around the head).
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};
    use glam::DVec3;
    use tiface_base::geom::{Aabb, Similarity};
    use tiface_capture::scene::{Scene, SceneBox, in_box};
    use tiface_kernels::cpu::vm::{DecoderShape, Grid, samples_across, size_for, step_size, voxel_schedule};

    /// Returns the scene of `capture.box = "ilsh"` for a head around a point on the diagonal,
    /// dataset units, and its bounds.
    fn in_published_box(center: f64, half: f64) -> (Scene, [[f32; 3]; 2]) {
        let scene_from_world = Similarity::scale_translate(1.0 / half, DVec3::splat(-center / half));
        let found = Scene { scene_from_world, aabb: Aabb::SCENE, hull: None };
        let (scene, _) = in_box(|| Ok((found, Vec::new())), SceneBox::Ilsh).unwrap();
        let bounds = [scene.aabb.min.to_array(), scene.aabb.max.to_array()];
        (scene, bounds)
    }

    #[test]
    fn the_published_box_has_the_published_optics_and_grid() {
        let (scene, bounds) = in_published_box(0.02, 0.3);
        // T-Face's own numbers: 25 per unit, entry between 3.5 and 7, 141 × 157 × 94 vertices, 459
        // samples
        let c = VmConfig::preset(Preset::Paper).placed(bounds);
        assert!((c.distance_scale - 25.0).abs() < 1e-5 && (c.alpha_unit - 1.0).abs() < 1e-6, "{c:?}");
        assert_eq!((c.near, c.far), (3.5, 7.0));
        // 83.3 per dataset unit
        assert!((c.distance_scale * scene.scene_from_world.scale - 83.333).abs() < 1e-2);
        let extent = scene.aabb.size().to_array();
        let size = size_for(extent, c.voxels_start);
        assert_eq!(size, [141, 157, 94]);
        let step = step_size(extent, size, c.step_ratio as f32);
        assert_eq!(samples_across(extent, step), 459);
    }

    #[test]
    fn another_box_has_the_same_optics_for_its_size_and_no_near_nor_far() {
        let (_, bounds) = in_published_box(3.0, 0.3);
        let c = VmConfig::preset(Preset::Paper).placed(bounds);
        // 25 · 1.67 / 1: as thick across the box as in the published one
        assert!((c.distance_scale - 41.75).abs() < 1e-9 && c.near == 0.0, "{c:?}");
        // alpha of a step: 1 − exp(−σ step), the step in units of 1 / 1.67
        assert!((c.alpha_unit * 1.67 - 1.0).abs() < 1e-9);
        // and the others' constants are of the scene, whatever the box
        let c = VmConfig::preset(Preset::Draft).placed(bounds);
        assert_eq!((c.distance_scale, c.alpha_unit, c.near, c.far), (100.0, 1.0, 0.0, 1e6));
    }

    /// What follows from the published settings in the published box.
    #[test]
    fn the_paper_preset_makes_the_published_grids_and_network() {
        let paper = Config::preset(Preset::Paper);
        let p = &paper.tface;
        let extent = [3.0, 3.34, 2.0];
        let mut sizes = vec![size_for(extent, p.voxels_start)];
        let finer = voxel_schedule(p.voxels_start, p.voxels_final, p.upsample_at.len());
        sizes.extend(finer.into_iter().map(|v| size_for(extent, v)));
        assert_eq!((sizes[0], sizes[1], sizes[5]), ([141, 157, 94], [167, 186, 111], [331, 368, 220]));
        // samples of a training ray: ‖N‖ / 0.5
        let samples =
            |n: [usize; 3]| (n.iter().map(|n| (n * n) as f64).sum::<f64>().sqrt() / p.step_ratio) as usize;
        assert_eq!((samples(sizes[0]), samples(sizes[5])), (462, 1083));
        // planes of 141 × 157, 141 × 94, 157 × 94 vertices with 16, 4, 4 channels, lines of 94,
        // 157, 141
        let triple = |list: &[usize]| [list[0], list[1], list[2]];
        let density = Grid { size: sizes[0], rank: triple(&p.density_rank) };
        let planes = 22_137 * 16 + 13_254 * 4 + 14_758 * 4;
        assert_eq!(density.len(), planes + 94 * 16 + 157 * 4 + 141 * 4);
        let color = Grid { size: sizes[0], rank: triple(&p.color_rank) };
        assert_eq!(color.len(), 3 * density.len());
        // 72 → 27; 30 → 128 → 128 → 3, with biases
        let decoder = DecoderShape {
            channels: color.channels(),
            features: p.features,
            hidden: p.hidden,
            view_frequencies: p.view_frequencies,
            feature_frequencies: p.feature_frequencies,
        };
        assert_eq!(decoder.len(), 72 * 27 + (30 * 128 + 128) + (128 * 128 + 128) + (128 * 3 + 3));
        // the baseline is the same field on photographs as they are
        let b = paper.baseline.field(p);
        assert_eq!(VmConfig { masks: p.masks, mask_loss: p.mask_loss, ..b }, *p);
    }

    #[test]
    fn the_rays_of_a_training_are_the_sum_of_those_of_its_steps() {
        for preset in Preset::ALL {
            let config = VmConfig { steps: 2000, ..VmConfig::preset(preset) };
            let sum: usize = (0..config.steps).map(|step| config.rays_at(step)).sum();
            // the step at which the last upsampling is done counts among the early ones
            assert!((config.training_rays() - sum as f64).abs() <= config.rays as f64, "{preset:?}: {sum}");
        }
    }

    #[test]
    fn short_trainings_have_all_rays_from_the_first_step() {
        let draft = VmConfig::preset(Preset::Draft);
        let early = |steps: u64| VmConfig { steps, ..draft.clone() }.rays_at(0);
        // 0.33 of 1500 steps are 495: half of their rays are 2.03 million; of 600 steps 198, all of
        // their rays 1.6 million; of 900 steps 297, where 2 / 2.43 of the rays are left
        assert_eq!((early(1500), early(600), early(900)), (4096, 8192, 6734));
        assert_eq!((draft.rays_at(495), draft.rays_at(496)), (4096, 8192));
    }

    #[test]
    fn what_comes_from_a_file_is_one_field() {
        let standard = Config::preset(Preset::Standard);
        let learned = standard.tface.clone();
        let imported = VmConfig { import: "official.safetensors".into(), ..learned.clone() };
        assert_eq!((learned.learned(), imported.learned()), (2, 1));
        for one in [standard.baseline.field(&standard.tface), VmConfig::preset(Preset::Paper)] {
            assert_eq!(one.learned(), 1);
        }
    }
}

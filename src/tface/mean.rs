//! Several fields of one head, learned from different random numbers and seen as one.
//!
//! What a field makes up where photographs leave it free, in hair above all, is another thing in each training; the
//! mean of a few is nearer to the truth than any of them (Lakshminarayanan, Pritzel, Blundell 2017, "Deep
//! ensembles"). Masked PSNR of eight held-out views, 24 photographs of 384 × 512 pixels:
//!
//! | | steps × rays, voxels | one field | mean of two |
//! |---|---|---|---|
//! | a man with hair | 1500 × 8,192, 192³ (`draft`) | 32.37 | 32.58 |
//! | | 2000 × 8,192, 256³ (`standard`) | 32.46 | 32.73 |
//! | | 2000 × 16,384, 256³ | 32.49 | |
//! | a bust | 1500 × 8,192, 192³ (`draft`) | 32.82 | 33.09 |
//!
//! Decay of the weights, smaller random numbers at the start, dropped channels, rays anywhere in a pixel, a running
//! mean of the weights and stronger smoothing all leave one field where it is, or below.

use super::train::{self, TrainReport};
use super::{TFace, TfaceError, VmPixel};
use crate::Monitor;
use crate::config::VmConfig;
use crate::field::pixels::TrainView;
use crate::geom::{Aabb, Ray};
use crate::io;
use crate::kernel::march::Bitmask;
use glam::Vec3;
use std::path::{Path, PathBuf};

/// The trained fields of a stage. Positions and distances are in scene units.
pub struct FieldMean {
    fields: Vec<TFace>,
}

impl FieldMean {
    /// From the checkpoints in a stage folder.
    pub fn load(dir: &Path, count: usize) -> Result<FieldMean, TfaceError> {
        let fields = (0..count).map(|i| TFace::load(&folder(dir, i))).collect::<Result<_, _>>()?;
        Ok(FieldMean { fields })
    }

    /// Volume render of rays in scene coordinates, with unit directions, of a camera that looks along the unit
    /// vector `forward`: mean colour (premultiplied, coded) and opacity; depth by opacity.
    pub fn render(&self, rays: &[Ray], forward: Vec3) -> Vec<VmPixel> {
        let Some((first, others)) = self.fields.split_first() else { return Vec::new() };
        let mut seen = first.render(rays, forward);
        if others.is_empty() {
            return seen;
        }
        seen.iter_mut().for_each(|p| p.depth *= p.opacity);
        for other in others {
            for (sum, p) in seen.iter_mut().zip(other.render(rays, forward)) {
                (0..3).for_each(|c| sum.color[c] += p.color[c]);
                sum.opacity += p.opacity;
                sum.depth += p.depth * p.opacity;
            }
        }
        let share = 1.0 / self.fields.len() as f32;
        for p in &mut seen {
            p.depth = if p.opacity > 0.0 { p.depth / p.opacity } else { 0.0 };
            p.color = p.color.map(|c| c * share);
            p.opacity *= share;
        }
        seen
    }
}

/// Where a field lies in its stage's folder: the first in the folder itself, the others in one each.
fn folder(dir: &Path, i: usize) -> PathBuf {
    if i == 0 { dir.to_owned() } else { dir.join(format!("field_{}", i + 1)) }
}

/// Trains `config.fields` fields one after the other, saving checkpoints into the stage folder `dir` and continuing
/// from those that lie there.
///
/// `stage` is `tface` or `baseline`, the table of the settings, for messages. `views` have their cameras in scene
/// coordinates; `bounds` is the scene's tight box; `hull` the masks' visual hull over [-1, 1]³. `identity` names
/// settings and inputs: a checkpoint of another identity is refused.
pub fn train(
    stage: &'static str,
    views: &[TrainView],
    bounds: Aabb,
    hull: Option<&Bitmask>,
    config: &VmConfig,
    seed: u64,
    device: &str,
    dir: &Path,
    identity: &str,
    monitor: &dyn Monitor,
) -> Result<TrainReport, TfaceError> {
    let fields = config.learned();
    let steps = fields as u64 * config.steps;
    let mut whole: Option<TrainReport> = None;
    for i in 0..fields {
        let before = i as u64 * config.steps;
        if monitor.stop() {
            return Err(TfaceError::Stopped { step: before, steps });
        }
        let folder = folder(dir, i);
        let identity = if i == 0 { identity.to_owned() } else { format!("{identity} {}", i + 1) };
        io::create_folder(&folder)?;
        // far from the seeds that people count through
        let seed = seed ^ (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let part = Part { monitor, field: i + 1, fields, before };
        let trained =
            train::train(stage, views, bounds, hull, config, seed, device, &folder, &identity, &part);
        let mut report = trained.map_err(|e| e.of_field(i + 1, fields))?;
        if fields > 1 {
            report.warnings.iter_mut().for_each(|w| *w = format!("field {} of {fields}: {w}", i + 1));
        }
        whole = Some(match whole {
            None => report,
            Some(sum) => sum.and(report),
        });
    }
    Ok(whole.expect("at least one field is learned"))
}

/// One field's share of the stage's steps.
struct Part<'a> {
    monitor: &'a dyn Monitor,
    /// From 1.
    field: usize,
    fields: usize,
    /// Steps of the fields before it.
    before: u64,
}

impl Monitor for Part<'_> {
    fn step(&self, step: u64, steps: u64, values: &[(&str, f64)]) {
        let field = (self.fields > 1).then_some(("field", self.field as f64));
        let values: Vec<_> = values.iter().copied().chain(field).collect();
        self.monitor.step(self.before + step, self.fields as u64 * steps, &values);
    }

    fn stop(&self) -> bool {
        self.monitor.stop()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Quiet;
    use crate::config::Preset;
    use crate::field::ball::{StopAfter, hull, temporary, views};
    use std::sync::Mutex;

    const BOX: Aabb = Aabb { min: Vec3::splat(-0.8), max: Vec3::splat(0.8) };

    fn config() -> VmConfig {
        VmConfig {
            fields: 2,
            steps: 40,
            rays: 256,
            voxels_start: 1000,
            voxels_final: 4096,
            upsample_steps: vec![20],
            mask_steps: vec![20],
            ..VmConfig::preset(Preset::Draft)
        }
    }

    /// Steps and their total as a person sees them.
    #[derive(Default)]
    struct Heard(Mutex<Vec<(u64, u64)>>);

    impl Monitor for Heard {
        fn step(&self, step: u64, steps: u64, _: &[(&str, f64)]) {
            self.0.lock().unwrap().push((step, steps));
        }

        fn stop(&self) -> bool {
            false
        }
    }

    #[test]
    fn two_fields_are_seen_as_their_mean_and_counted_as_one_training() {
        let dir = temporary();
        let (views, hull, heard) = (views(), hull(), Heard::default());
        let learn = |dir: &Path, monitor: &dyn Monitor| {
            train("tface", &views, BOX, Some(&hull), &config(), 3, "cpu", dir, "ball", monitor)
        };
        let report = learn(dir.path(), &heard).unwrap();
        let heard = heard.0.into_inner().unwrap();
        assert_eq!(heard, (1..=80).map(|s| (s, 80)).collect::<Vec<_>>());
        assert_eq!((report.fields, report.steps), (2, 40));
        assert!(report.rays > 40 * 256 && report.train_psnr > 5.0);

        let rays: Vec<Ray> = (0..64)
            .map(|i| {
                let at = |k: i32| 0.02 * k as f32 - 0.07;
                let origin = Vec3::new(at(i % 8), at(i / 8), 3.0);
                Ray { origin, direction: -Vec3::Z, t_min: 0.0, t_max: f32::INFINITY }
            })
            .collect();
        let see = |fields: usize| FieldMean::load(dir.path(), fields).unwrap().render(&rays, -Vec3::Z);
        let second = TFace::load(&dir.path().join("field_2")).unwrap().render(&rays, -Vec3::Z);
        let (one, both) = (see(1), see(2));
        assert!(one != second);
        for ((a, b), mean) in one.iter().zip(&second).zip(&both) {
            for c in 0..3 {
                assert!((mean.color[c] - 0.5 * (a.color[c] + b.color[c])).abs() < 1e-6);
            }
            assert!((mean.opacity - 0.5 * (a.opacity + b.opacity)).abs() < 1e-6);
            let depth = (a.depth * a.opacity + b.depth * b.opacity) / (a.opacity + b.opacity).max(1e-9);
            assert!((mean.depth - depth).abs() < 1e-4, "{mean:?} {depth}");
        }
        assert!(both.iter().any(|p| p.opacity > 0.5));

        // nothing is learned twice
        let files = ["checkpoint.safetensors", "field_2/checkpoint.safetensors"];
        let bytes = |dir: &Path| files.map(|f| std::fs::read(dir.join(f)).unwrap());
        assert_eq!(learn(dir.path(), &Quiet).unwrap().rays, 0);
        assert!(matches!(FieldMean::load(dir.path(), 3), Err(TfaceError::Read(_))));

        // stopped in the second field, it goes on there
        let again = temporary();
        let end = learn(again.path(), &StopAfter::new(50));
        assert!(matches!(end, Err(TfaceError::Stopped { .. })));
        let rest = Heard::default();
        learn(again.path(), &rest).unwrap();
        let rest = rest.0.into_inner().unwrap();
        assert_eq!((rest[0], rest.last()), ((40, 80), Some(&(80, 80))));
        assert!(rest.len() <= 32, "{rest:?}");
        assert_eq!(bytes(again.path()), bytes(dir.path()));
    }

    #[test]
    fn a_field_in_another_ones_place_is_refused() {
        let dir = temporary();
        let (views, hull) = (views(), hull());
        let learn =
            || train("tface", &views, BOX, Some(&hull), &config(), 3, "cpu", dir.path(), "ball", &Quiet);
        learn().unwrap();
        let name = "checkpoint.safetensors";
        std::fs::copy(dir.path().join(name), dir.path().join("field_2").join(name)).unwrap();
        assert!(matches!(learn(), Err(TfaceError::Checkpoint { .. })));
    }
}

//! The mean of several fields of one head, trained with different random seeds.
//!
//! Where the photographs do not determine the field, above all in hair, each training gives a
//! different result; the mean of a few is closer to the truth than any of them (Lakshminarayanan,
//! Pritzel, Blundell 2017, "Deep ensembles"). Masked PSNR of eight held-out views, 24 photographs
//! of 384 × 512 pixels:
//!
//! | | steps × rays, voxels | one field | mean of two |
//! |---|---|---|---|
//! | a man with hair | 1500 × 8,192, 192³ (`draft`) | 32.37 | 32.58 |
//! | | 2000 × 8,192, 256³ (`standard`) | 32.46 | 32.73 |
//! | | 2000 × 16,384, 256³ | 32.49 | |
//! | a bust | 1500 × 8,192, 192³ (`draft`) | 32.82 | 33.09 |
//!
//! Weight decay, smaller initial values, channel dropout, jittered rays within a pixel, a running
//! mean of the weights and stronger smoothing all failed to improve a single field.

use super::TFace;
use super::train::{self, TfaceReport, train_one};
use crate::config::{MaskUse, VmConfig, VmStart};
use crate::field::ComputeDevice;
use crate::field::pixels::{LARGE, RaySampler};
use crate::field::training::{self, TrainingSession};
use glam::Vec3;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tiface_base::geom::{Aabb, BitGrid, Ray, RayResult};
use tiface_base::io::Lock;
use tiface_base::{Monitor, Result, io};
use tiface_capture::LoadedView;

/// The trained fields of a stage. Positions and distances are in scene units.
pub struct FieldMean {
    fields: Vec<TFace>,
    /// Lock of the GPU, held for the fields' lifetime.
    _lock: Option<Arc<Lock>>,
}

impl FieldMean {
    /// Loads `count` fields from the checkpoints in a folder of `stage`.
    pub fn load(stage: &'static str, dir: &Path, count: usize) -> Result<FieldMean> {
        let fields = (0..count).map(|i| TFace::load(stage, &folder(dir, i))).collect::<Result<_>>()?;
        Ok(FieldMean { fields, _lock: None })
    }

    /// Renders on `device` from now on, if it is a GPU that supports the fields.
    pub fn on(self, device: ComputeDevice) -> FieldMean {
        match device {
            ComputeDevice::Cpu(_) => self,
            #[cfg(feature = "wgpu")]
            ComputeDevice::Gpu(gpu) => {
                let (device, mut fields) = (Arc::new(gpu.device), self.fields);
                fields.iter_mut().for_each(|field| field.on(device.clone()));
                FieldMean { fields, _lock: gpu.lock }
            }
        }
    }

    /// Returns why the GPU is no longer used, if it failed.
    pub fn gpu_failure(&self) -> Option<&str> {
        self.fields.iter().find_map(TFace::gpu_failure)
    }

    /// Renders rays in scene coordinates, with unit directions, of a camera that looks along the
    /// unit vector `forward`. Returns the mean color (premultiplied, coded), the mean opacity, and
    /// the depth weighted by opacity.
    pub fn render(&self, rays: &[Ray], forward: Vec3) -> Vec<RayResult> {
        let Some((first, others)) = self.fields.split_first() else { return Vec::new() };
        let mut mean = first.render(rays, forward);
        if others.is_empty() {
            return mean;
        }
        mean.iter_mut().for_each(|p| p.depth *= p.opacity);
        for other in others {
            for (sum, p) in mean.iter_mut().zip(other.render(rays, forward)) {
                (0..3).for_each(|c| sum.color[c] += p.color[c]);
                sum.opacity += p.opacity;
                sum.depth += p.depth * p.opacity;
            }
        }
        let share = 1.0 / self.fields.len() as f32;
        for p in &mut mean {
            p.depth = if p.opacity > 0.0 { p.depth / p.opacity } else { 0.0 };
            p.color = p.color.map(|c| c * share);
            p.opacity *= share;
        }
        mean
    }
}

/// Returns the folder of field `i` of a stage: the stage's folder itself for the first, a subfolder
/// for each other.
fn folder(dir: &Path, i: usize) -> PathBuf {
    if i == 0 { dir.to_owned() } else { dir.join(format!("field_{}", i + 1)) }
}

/// Trains `config.fields` fields one after the other, saving checkpoints into the session's folder
/// and continuing from existing ones.
///
/// `views` have their cameras in scene coordinates; `bounds` is the scene's tight box; `hull` the
/// masks' visual hull over [-1, 1]³.
pub fn train(
    views: Vec<LoadedView>,
    bounds: Aabb,
    hull: Option<&BitGrid>,
    config: &VmConfig,
    session: &TrainingSession,
) -> Result<TfaceReport> {
    train::check(session.stage, config)?;
    let views = train::masked_as_configured(views, config.masks);
    let hull = hull.filter(|_| config.start == VmStart::Hull && config.masks != MaskUse::None);
    // rays that meet the hull, grown by the cells around it
    let reach = hull.map_or(f32::INFINITY, |h| 4.0 * 2.0 / h.resolution.min(128) as f32);
    let bounds = [bounds.min.to_array(), bounds.max.to_array()];
    let config = &config.placed(bounds);
    let sampler = match config.whole_frame {
        true => RaySampler::permuted(&views, config.foreground, bounds, config.depth_directions),
        false => {
            let volume: f32 = (0..3).map(|a| bounds[1][a] - bounds[0][a]).product();
            let cell = (volume as f64 / config.voxels_final as f64).cbrt() as f32;
            let sampler = RaySampler::new(&views, reach, 1.0, config.foreground, false)
                .with_large(LARGE.min(train::DETAIL * cell));
            if config.thinned { sampler.thinned() } else { sampler }
        }
    };
    if sampler.count() == 0 {
        return Err(training::no_pixels());
    }
    let fields = config.learned();
    let mut whole: Option<TfaceReport> = None;
    for i in 0..fields {
        let before = i as u64 * config.steps;
        if session.monitor.stop() {
            return Err(training::stopped(before, fields as u64 * config.steps));
        }
        let folder = folder(session.dir, i);
        let identity =
            if i == 0 { session.identity.into() } else { format!("{} {}", session.identity, i + 1) };
        io::create_folder(&folder)?;
        let monitor = FieldMonitor { monitor: session.monitor, field: i + 1, fields, before };
        let own = TrainingSession {
            // The offset keeps derived seeds away from the small numbers that users choose.
            seed: session.seed ^ (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15),
            dir: &folder,
            identity: &identity,
            monitor: &monitor,
            ..*session
        };
        let several = (fields > 1).then(|| format!("field {} of {fields}", i + 1));
        let trained = train_one(&sampler, bounds, hull, config, &own);
        let mut report = trained.map_err(|e| match &several {
            Some(which) if !e.kind().is_stop() => e.within(which),
            _ => e,
        })?;
        if let Some(which) = several {
            report.warnings.iter_mut().for_each(|w| *w = format!("{which}: {w}"));
        }
        match &mut whole {
            None => whole = Some(report),
            Some(whole) => whole.add(report),
        }
    }
    Ok(whole.expect("at least one field is learned"))
}

/// Reports the steps of one field as a share of the stage's steps.
struct FieldMonitor<'a> {
    monitor: &'a dyn Monitor,
    /// Number of the field, from 1.
    field: usize,
    fields: usize,
    /// Steps of the fields before it.
    before: u64,
}

impl Monitor for FieldMonitor<'_> {
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
    use crate::config::Preset;
    use crate::field::ball::{hull, views};
    use crate::field::testing::{StopAfter, session, temporary};
    use std::sync::Mutex;
    use tiface_base::Quiet;

    const BOX: Aabb = Aabb { min: Vec3::splat(-0.8), max: Vec3::splat(0.8) };

    fn config() -> VmConfig {
        VmConfig {
            fields: 2,
            steps: 40,
            rays: 256,
            voxels_start: 1000,
            voxels_final: 4096,
            upsample_at: vec![0.5],
            mask_at: vec![0.5],
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
        let (hull, heard) = (hull(), Heard::default());
        let learn = |dir: &Path, monitor: &dyn Monitor| {
            train(views(), BOX, Some(&hull), &config(), &session("tface", dir, "ball", monitor))
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
        let see =
            |fields: usize| FieldMean::load("tface", dir.path(), fields).unwrap().render(&rays, -Vec3::Z);
        let second = TFace::load("tface", &dir.path().join("field_2")).unwrap().render(&rays, -Vec3::Z);
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
        let again = Heard::default();
        assert_eq!(learn(dir.path(), &again).unwrap().counts(), report.counts());
        assert_eq!(again.0.into_inner().unwrap(), [(40, 80), (80, 80)]);
        let missing = FieldMean::load("tface", dir.path(), 3).err().unwrap().to_string();
        assert!(missing.contains("field_3") && missing.contains("cannot be read"), "{missing}");

        // A training stopped in the second field continues in that field.
        let again = temporary();
        let end = learn(again.path(), &StopAfter::new(50));
        assert!(end.unwrap_err().kind().is_stop());
        let rest = Heard::default();
        assert_eq!(learn(again.path(), &rest).unwrap().counts(), report.counts());
        let rest = rest.0.into_inner().unwrap();
        assert_eq!((rest[0], rest.last()), ((40, 80), Some(&(80, 80))));
        assert!(rest.len() <= 32, "{rest:?}");
        assert_eq!(bytes(again.path()), bytes(dir.path()));
    }

    #[test]
    fn a_field_in_another_ones_place_is_refused() {
        let dir = temporary();
        let hull = hull();
        let config = VmConfig { steps: 2, upsample_at: vec![], mask_at: vec![], ..config() };
        let learn =
            || train(views(), BOX, Some(&hull), &config, &session("tface", dir.path(), "ball", &Quiet));
        learn().unwrap();
        let name = "checkpoint.safetensors";
        std::fs::copy(dir.path().join(name), dir.path().join("field_2").join(name)).unwrap();
        let refused = learn().unwrap_err();
        assert!(refused.to_string().contains("other settings") && refused.hint().contains("--fresh tface"));
    }
}

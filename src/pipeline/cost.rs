//! What stages may cost, before they are worked on: counts of rays, samples, cells and pixels times what one of each took
//! where it was measured.

use super::line::Line;
use super::path::CameraPath;
use super::render::held_out;
use crate::Result;
use crate::config::{Config, MaskSource, Method, Preset, Stage, VmBackground, VmConfig};
use crate::run::{Cost, ESTIMATE, Estimate};

const MIB: f64 = (1u64 << 20) as f64;

impl Line<'_> {
    /// The folders of the stages that `until` needs and that are not done, with what each may cost on the processor.
    pub fn ahead(&self, until: Stage) -> Vec<(String, Cost)> {
        let order = self.order(until).into_iter().map(|stage| (stage, self.plan(stage)));
        order.filter(|(_, p)| !self.run.is_done(p)).map(|(s, p)| (p.name.into(), self.cost(s))).collect()
    }

    /// Writes what the whole line may cost into the run, where the photographs are there to count.
    pub(super) fn write_estimate(&self, idle: bool) -> Result<()> {
        if self.gone.is_some() || self.path.is_some() {
            return Ok(());
        }
        let stages = self.order(Stage::Metrics).into_iter();
        let estimate: Estimate = stages.map(|stage| (stage.word().to_owned(), self.cost(stage))).collect();
        let text = serde_json::to_string_pretty(&estimate).unwrap_or_default();
        self.write(ESTIMATE, format!("{text}\n").as_bytes(), idle)
    }

    /// What a stage may cost on the processor.
    ///
    /// The constants are those of runs of the demo head and of a bust, at 64 x 80 to 384 x 512 pixels and tiny to full
    /// settings; `docs/many-heads.md` says how far off others were.
    pub fn cost(&self, stage: Stage) -> Cost {
        let Config { iface, mesh, .. } = self.config;
        let published = self.config.preset == Preset::Paper;
        let shell = |c: &VmConfig| c.background == VmBackground::Reference;
        let all = self.pixels() as f64;
        let each = all / self.capture.views.len().max(1) as f64;
        let held_out = each * held_out(&self.capture).len() as f64;
        let shown = match &self.path {
            Some(CameraPath { cameras: Some(cameras), .. }) => each * cameras.len() as f64,
            Some(CameraPath { render, .. }) => each * f64::from(render.orbit_views),
            None => held_out,
        };
        let methods = &self.render_config().method;
        // carried to all views, and made soft
        let clicked = if self.clicks.is_some() { 2.5e-6 * all } else { 0.0 };
        // ISNet takes 4.5 s of a core a photograph with ONNX Runtime; others more or less
        let m = &self.config.mask;
        let files = [&m.sam, &m.vitmatte, &m.alpha_net].into_iter().filter(|file| !file.is_empty()).count();
        let networks = 5.0 * (files * self.capture.views.len()) as f64;
        let (cpu_s, mib) = match stage {
            Stage::Mask => (0.7 + 3e-7 * all + clicked + networks, 115.0 + 5e-6 * all),
            Stage::Baseline | Stage::Tface => {
                let c = self.config.radiance(stage);
                let rays = (c.steps as usize * c.rays * c.learned()) as f64;
                let parameters = vm_parameters(&c);
                // whole frames are mostly outside the hull, and nothing of them is skipped; nor is the shell that two
                // backgrounds leave
                let outside = match stage {
                    Stage::Baseline => 4.0,
                    _ if shell(&c) => 2.3,
                    _ => 1.0,
                };
                // samples along a ray are as dense as the grid
                let ray = outside * (5e-6 + 0.16e-6 * (c.voxels_final as f64).cbrt());
                let cpu_s = 0.1 + ray * rays + 4e-9 * parameters * (c.steps as usize * c.learned()) as f64;
                let mib = 45.0 + 25e-6 * all + 24e-6 * parameters + 0.07 * c.rays as f64;
                if c.import.is_empty() { (cpu_s, mib) } else { (1.0, mib) }
            }
            Stage::Iface => {
                let samples = (iface.steps as usize * iface.samples) as f64;
                let table = ((iface.levels as u64 * 2) << iface.log2_table.min(32)) as f64;
                let cpu_s = 3.8 + 4.7e-6 * samples + 2e-9 * table * iface.steps as f64 + 1.8e-6 * all;
                (cpu_s, 100.0 + 25e-6 * all + 20e-6 * table + 0.012 * iface.samples as f64)
            }
            Stage::Mesh => {
                let cells = f64::from(mesh.resolution).powi(2);
                let texels = (mesh.texels() * mesh.pictures()) as f64;
                (
                    0.5 + 1.3e-4 * cells + 5e-6 * texels + 1e-6 * all,
                    110.0 + 25e-6 * all + 6e-3 * cells + 5e-4 * texels,
                )
            }
            Stage::Render => {
                // through all of the box, in all of the picture
                let whole = |method: &Method| {
                    let c = self.config.radiance(method.stage());
                    let empty = if *method == Method::Baseline || shell(&c) { 0.25e-6 } else { 0.1e-6 };
                    empty * (c.voxels_final as f64).cbrt()
                };
                let pixel = |method: &Method| match method {
                    Method::Baseline | Method::Tface if published => whole(method),
                    // nothing says where there is nothing, so all of a ray is looked at
                    Method::Volume if published && self.config.mask.source == MaskSource::None => 700e-6,
                    Method::Volume if published => 90e-6,
                    Method::Baseline | Method::Tface => 8e-6,
                    Method::Volume => 20e-6,
                    _ => 2.5e-6,
                };
                let cpu_s = 0.1 + shown * methods.iter().map(pixel).sum::<f64>();
                (cpu_s, 220.0 + 25e-6 * all + 1e-4 * (shown * methods.len() as f64 + mesh.texels() as f64))
            }
            Stage::Ensemble => (0.2 + 3e-6 * held_out, 220.0 + 1e-4 * each),
            Stage::Metrics => (0.2 + 1.2e-6 * held_out * methods.len() as f64, 220.0 + 1e-4 * each),
        };
        let disk_bytes = self.plan(stage).needs_bytes;
        Cost { cpu_s, memory_bytes: (mib * MIB) as u64, disk_bytes }
    }
}

/// Numbers in the planes and lines of the last grid.
fn vm_parameters(c: &VmConfig) -> f64 {
    let channels: usize = c.density_rank.iter().chain(&c.color_rank).sum();
    let side = (c.voxels_final as f64).cbrt();
    channels as f64 * side * (side + 1.0)
}

//! The estimated cost of each stage: a number of rays, samples, cells or pixels times the measured
//! time, memory or disk space of one.
//!
//! The constants were measured on runs of the synthetic head and of a bust, at 64 x 80 to 384 x 512
//! pixels and tiny to full settings; `docs/many-heads.md` says how far off other runs were.

use super::hair_views;
use super::path::CameraPath;
use super::render::held_out;
use super::session::Session;
use crate::config::{
    ColorSource, Config, IfaceConfig, MaskSource, Method, Preset, Stage, VmBackground, VmConfig,
};
use crate::run::{Cost, ESTIMATE, Estimate};
use tiface_base::Result;
use tiface_kernels::cpu::hash;

const MIB: f64 = (1u64 << 20) as f64;

/// Memory that a stage takes on the CPU, MiB a unit of each part; `Session::cost` adds them up.
///
/// `tools/reference/estimates.py RUN...` compares these estimates with the peaks that runs
/// recorded.
mod mib {
    /// The program and what its libraries hold.
    pub const PROGRAM: f64 = 75.0;
    /// Stack and heap of a thread.
    pub const THREAD: f64 = 10.0;
    /// A pixel of a photograph in memory, with mask, validity and what is drawn from it.
    pub const PIXEL: f64 = 25e-6;
    /// A parameter of a radiance field in training: value, gradient, two moments, and a copy for a
    /// checkpoint.
    pub const VM_PARAMETER: f64 = 24e-6;
    /// A ray of a step of a radiance field, with its samples and their activations.
    pub const VM_RAY: f64 = 0.049;
    /// A float of the hash table in training.
    pub const TABLE_FLOAT: f64 = 20e-6;
    /// A sample of a step of I-Face.
    pub const SDF_SAMPLE: f64 = 0.0112;
    /// A cell of the largest slice through the box, per stage `mesh`: the grid near the surface,
    /// and the surface.
    pub const CELL: f64 = 6.2e-3;
    /// A texel while its color is fitted to photographs, while it is the network's, and that of
    /// each further picture.
    pub const FITTED_TEXEL: f64 = 1.4e-4;
    pub const TEXEL: f64 = 4e-5;
    pub const PICTURE_TEXEL: f64 = 2e-5;
    /// A head mesh with its tree, and a texel of it, in views.
    pub const SHOWN_MESH: f64 = 85.0;
    pub const SHOWN_TEXEL: f64 = 25e-6;
    /// A pixel of a view.
    pub const VIEW_PIXEL: f64 = 1.2e-4;
    /// The rays of a radiance field and of I-Face that are marched together, and a parameter of a
    /// loaded field.
    pub const RADIANCE: f64 = 180.0;
    pub const VOLUME: f64 = 300.0;
    pub const LOADED: f64 = 8e-6;
    /// A pixel of a training photograph whose residuals are kept.
    pub const RESIDUAL: f64 = 8e-6;
    /// By how much runs differ from each other.
    pub const MARGIN: f64 = 1.12;
}

/// Bytes that a stage leaves on the disk.
mod kept {
    /// Logs, records and small files of a stage.
    pub const SMALL: f64 = 1e6;
    /// A pixel of a mask, and the outline of a view on the sheet.
    pub const MASK_PIXEL: f64 = 0.12;
    pub const SHEET_VIEW: f64 = 25e3;
    /// A cell of the largest slice through the box: the extracted surface, in the run and as a
    /// file.
    pub const CELL: f64 = 300.0;
    /// A triangle of the head mesh in a file.
    pub const TRIANGLE: f64 = 120.0;
    /// Triangles of the extracted surface for each cell of the largest slice.
    pub const TRIANGLES_OF_CELL: f64 = 4.4;
    /// A texel of a picture in a file, and of the float one.
    pub const TEXEL: f64 = 2.7;
    pub const FLOAT_TEXEL: f64 = 12.0;
    /// A pixel of a view with its depth, and of a float one.
    pub const VIEW_PIXEL: f64 = 3.0;
    pub const FLOAT_PIXEL: f64 = 17.0;
    /// A pixel of a blend.
    pub const BLEND_PIXEL: f64 = 2.0;
    /// The report.
    pub const REPORT: f64 = 6e6;
    /// By how much runs differ from each other.
    pub const MARGIN: f64 = 1.15;
}

impl Session<'_> {
    /// Returns the folders of the unfinished stages that `until` needs, with the estimated cost of
    /// each on the CPU.
    pub fn ahead(&self, until: Stage) -> Vec<(String, Cost)> {
        let order = self.order(until).into_iter().map(|stage| (stage, self.plan(stage)));
        order.filter(|(_, p)| !self.run.is_done(p)).map(|(s, p)| (p.name.into(), self.cost(s))).collect()
    }

    /// Writes the estimated cost of the whole pipeline into the run, if the photographs can be
    /// counted.
    pub(super) fn write_estimate(&self, idle: bool) -> Result<()> {
        if self.inputs.missing_capture.is_some() || self.path.is_some() {
            return Ok(());
        }
        let stages = self.order(Stage::Metrics).into_iter();
        let estimate: Estimate = stages.map(|stage| (stage.as_str().to_owned(), self.cost(stage))).collect();
        let text = serde_json::to_string_pretty(&estimate).unwrap_or_default();
        self.write(ESTIMATE, format!("{text}\n").as_bytes(), idle)
    }

    /// Returns the estimated cost of a stage on the CPU.
    ///
    /// Memory is that of the whole process, disk what the stage leaves: while a field is trained,
    /// its checkpoints take up to nine times as much ([`crate::run::Plan::needs_bytes`]).
    pub fn cost(&self, stage: Stage) -> Cost {
        let work = Workload::new(self);
        let program = mib::PROGRAM + mib::THREAD * rayon::current_num_threads() as f64;
        let (cpu_s, stage_mib) = match stage {
            Stage::Mask => work.mask(),
            Stage::Baseline | Stage::Tface => work.radiance(stage),
            Stage::Iface => work.iface(),
            Stage::Mesh => work.mesh(),
            Stage::Render => work.render(),
            Stage::Ensemble => work.ensemble(),
            Stage::Metrics => work.metrics(),
        };
        let memory_bytes = (mib::MARGIN * (program + stage_mib) * MIB) as u64;
        let disk_bytes = (kept::MARGIN * work.kept_bytes(stage)) as u64;
        Cost { cpu_s, memory_bytes, disk_bytes }
    }
}

/// Numbers of pixels that costs depend on. The cost of a stage is in CPU seconds and MiB.
struct Workload<'a> {
    session: &'a Session<'a>,
    config: &'a Config,
    /// Pixels of all photographs.
    all: f64,
    /// Pixels of a photograph, on average.
    each: f64,
    /// Pixels of the held-out photographs.
    held_out: f64,
    /// Pixels of the views that the stage `render` shows.
    shown: f64,
}

/// Largest number of views that hair is fitted to, and of pixels of each.
const HAIR_VIEWS: f64 = hair_views::VIEWS as f64;
const HAIR_VIEW_PIXELS: f64 = hair_views::SIDE_PX as f64 * hair_views::SIDE_PX as f64 * 0.75;

impl<'a> Workload<'a> {
    fn new(session: &'a Session<'a>) -> Workload<'a> {
        let all = session.pixels() as f64;
        let each = all / session.capture.views.len().max(1) as f64;
        let held_out = each * held_out(&session.capture).len() as f64;
        let shown = match &session.path {
            Some(CameraPath { cameras: Some(cameras), .. }) => each * cameras.len() as f64,
            Some(CameraPath { render, .. }) => each * f64::from(render.orbit_views),
            None => held_out,
        };
        Workload { session, config: session.config, all, each, held_out, shown }
    }

    fn mask(&self) -> (f64, f64) {
        let all = self.all;
        // propagating to all views, and matting
        let clicked = if self.session.inputs.clicks.is_some() { 2.5e-6 * all } else { 0.0 };
        // ISNet takes 4.5 core seconds a photograph with ONNX Runtime; other networks differ
        let m = &self.config.mask;
        let files = [&m.sam, &m.vitmatte, &m.alpha_net].into_iter().filter(|file| !file.is_empty()).count();
        let networks = 5.0 * (files * self.session.capture.views.len()) as f64;
        (0.7 + 3e-7 * all + clicked + networks, 65.0 + 5e-6 * all)
    }

    fn radiance(&self, stage: Stage) -> (f64, f64) {
        let c = self.config.radiance(stage);
        let rays = c.training_rays() * c.learned() as f64;
        let parameters = vm_parameters(&c);
        // whole frames are mostly outside the hull, where no pixel is skipped; nor is the shell
        // left by training against two backgrounds
        let outside = match stage {
            Stage::Baseline => 4.0,
            _ if has_shell(&c) => 2.3,
            _ => 1.0,
        };
        // samples along a ray are as dense as the grid, or `step_ratio` times as far apart; many of
        // them share a color
        let sample = if c.group_weight > 0.0 { 0.036e-6 } else { 0.045e-6 } / c.step_ratio;
        let ray = outside * (3e-6 + sample * (c.voxels_final as f64).cbrt());
        let cpu_s = 0.1 + ray * rays + 4e-9 * parameters * (c.steps as usize * c.learned()) as f64;
        let trained = mib::VM_PARAMETER * parameters + mib::VM_RAY * c.rays as f64;
        match c.import.is_empty() {
            true => (cpu_s, mib::PIXEL * self.all + trained),
            false => (1.0, mib::VM_PARAMETER * parameters),
        }
    }

    fn iface(&self) -> (f64, f64) {
        let (c, all) = (&self.config.iface, self.all);
        let samples = (c.steps as usize * c.samples) as f64;
        let table = ((c.levels as u64 * 2) << c.log2_table.min(32)) as f64;
        // many samples share a color
        let sample = if c.group_weight > 0.0 { 1.3e-6 } else { 1.5e-6 };
        let cpu_s = 3.8 + sample * samples + 1.3e-9 * table * c.steps as f64 + 1.8e-6 * all;
        let trained = mib::TABLE_FLOAT * table + mib::SDF_SAMPLE * c.samples as f64;
        (cpu_s, mib::PIXEL * all + trained)
    }

    fn mesh(&self) -> (f64, f64) {
        let (c, all) = (&self.config.mesh, self.all);
        let cells = f64::from(c.resolution).powi(2);
        let (texels, pictures) = (c.texels() as f64, c.pictures() as f64);
        let texel = match c.color {
            ColorSource::Photographs => mib::FITTED_TEXEL,
            ColorSource::Network => mib::TEXEL,
        };
        // if hair is soft enough for layers, views that they are fitted to
        let (views, loaded) = match c.uses_tface() {
            true => (HAIR_VIEWS * self.each.min(HAIR_VIEW_PIXELS), self.renderers(&[Method::Tface], 0.0)),
            false => (0.0, 0.0),
        };
        (
            0.5 + 1.3e-4 * cells + 5e-6 * texels * pictures + 1e-6 * all + 5e-6 * views,
            mib::PIXEL * (all + views)
                + mib::CELL * cells
                + (texel + mib::PICTURE_TEXEL * pictures) * texels
                + loaded,
        )
    }

    fn render(&self) -> (f64, f64) {
        let published = self.config.preset == Preset::Paper;
        // the whole box, in the whole picture
        let whole = |method: &Method| {
            let c = self.config.radiance(method.stage());
            let empty = if *method == Method::Baseline || has_shell(&c) { 0.25e-6 } else { 0.1e-6 };
            empty * (c.voxels_final as f64).cbrt()
        };
        let config = self.session.render_config();
        let methods = &config.method;
        let fitted = self.config.mesh.color == ColorSource::Photographs;
        let shares_rays = fitted && methods.contains(&Method::Raycast);
        let pixel = |method: &Method| match method {
            // colors and files
            Method::Plain | Method::Textured if shares_rays => 1.5e-6,
            Method::Baseline | Method::Tface if published => whole(method),
            // no occupancy exists yet, so every sample of a ray is evaluated
            Method::Volume if published && self.config.mask.source == MaskSource::None => 700e-6,
            Method::Volume if published => 90e-6,
            Method::Baseline | Method::Tface => 8e-6,
            Method::Volume => 20e-6,
            _ => 2.5e-6,
        };
        let residuals = if config.shows_residuals(methods) { self.all } else { 0.0 };
        let cpu_s = 0.1 + self.shown * methods.iter().map(pixel).sum::<f64>() + 1e-6 * residuals;
        (cpu_s, mib::VIEW_PIXEL * self.each + self.renderers(methods, residuals))
    }

    fn ensemble(&self) -> (f64, f64) {
        let members = &self.config.ensemble.members;
        let fits = self.config.ensemble.weights.is_empty();
        let shows_residuals = fits && self.config.render.shows_residuals(members);
        let residuals = if shows_residuals { self.all } else { 0.0 };
        let rendered = if fits { self.renderers(members, residuals) } else { 0.0 };
        // the stage `render` has measured the residuals if it ran just before
        (0.2 + 3e-6 * self.held_out, mib::VIEW_PIXEL * self.each + rendered)
    }

    fn metrics(&self) -> (f64, f64) {
        let methods = self.session.render_config().method.len();
        (0.2 + 0.7e-6 * self.held_out * methods as f64, 215.0 + mib::VIEW_PIXEL * self.each)
    }

    /// Returns the memory of views by these methods besides the views themselves, MiB.
    fn renderers(&self, methods: &[Method], residuals: f64) -> f64 {
        let Config { iface, mesh, .. } = self.config;
        let shows_mesh = methods.iter().any(|method| method.stage() == Stage::Mesh);
        let texels = (mesh.texels() * mesh.pictures()) as f64;
        let shown = if shows_mesh { mib::SHOWN_MESH + mib::SHOWN_TEXEL * texels } else { 0.0 };
        // of each field its parameters and what its rays take while they are marched; the next uses
        // that again
        let field = |method: &Method| match method.stage() {
            Stage::Mesh => (0.0, 0.0),
            Stage::Iface => (hash_floats(iface), mib::VOLUME),
            stage => {
                let c = self.config.radiance(stage);
                (vm_parameters(&c) * c.learned() as f64, mib::RADIANCE)
            }
        };
        let fields: Vec<(f64, f64)> = methods.iter().map(field).collect();
        let loaded = fields.iter().map(|(parameters, _)| parameters).sum::<f64>();
        let marched = fields.iter().map(|(_, mib)| *mib).fold(0.0, f64::max);
        shown + mib::LOADED * loaded + marched + mib::RESIDUAL * residuals
    }

    /// Returns the bytes that a stage leaves on the disk.
    fn kept_bytes(&self, stage: Stage) -> f64 {
        let Config { iface, mesh, render, .. } = self.config;
        kept::SMALL
            + match stage {
                Stage::Mask => {
                    kept::MASK_PIXEL * self.all + kept::SHEET_VIEW * self.session.capture.views.len() as f64
                }
                Stage::Baseline | Stage::Tface => {
                    let c = self.config.radiance(stage);
                    4.0 * vm_parameters(&c) * c.learned() as f64
                }
                Stage::Iface => 4.0 * hash_floats(iface),
                Stage::Mesh => {
                    let (cells, texels) = (f64::from(mesh.resolution).powi(2), mesh.texels() as f64);
                    let all = kept::TRIANGLES_OF_CELL * cells;
                    let triangles = match mesh.triangles {
                        0 => all,
                        some => all.min(f64::from(some)),
                    };
                    let files = 1.0 + mesh.format.len() as f64; // with the parts
                    let pictures = files * kept::TEXEL * mesh.pictures() as f64;
                    let float = if mesh.exr { kept::FLOAT_TEXEL } else { 0.0 };
                    kept::CELL * cells + files * kept::TRIANGLE * triangles + (pictures + float) * texels
                }
                Stage::Render => {
                    let float =
                        if render.float && self.session.path.is_none() { kept::FLOAT_PIXEL } else { 0.0 };
                    self.shown * self.session.render_config().method.len() as f64 * (kept::VIEW_PIXEL + float)
                }
                Stage::Ensemble => kept::BLEND_PIXEL * self.held_out,
                Stage::Metrics => kept::REPORT,
            }
    }
}

/// Returns the number of floats in the hash table of I-Face.
fn hash_floats(c: &IfaceConfig) -> f64 {
    2.0 * hash::entries(&hash::levels(c.levels, c.base_resolution, c.growth, c.log2_table)) as f64
}

/// Returns the number of parameters in the planes and lines of the final grid.
fn vm_parameters(c: &VmConfig) -> f64 {
    let channels: usize = c.density_rank.iter().chain(&c.color_rank).sum();
    let side = (c.voxels_final as f64).cbrt();
    channels as f64 * side * (side + 1.0)
}

/// Returns whether a field keeps a shell around the head, left by training against two backgrounds.
fn has_shell(c: &VmConfig) -> bool {
    c.background == VmBackground::Reference
}

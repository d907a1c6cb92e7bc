//! The inputs and the estimated cost of each stage, known before anything runs.
//!
//! A cost is a number of rays, samples, cells or pixels times the measured time of one.

use super::ensemble::can_blend;
use super::export::is_file_key;
use super::inputs::capture_options;
use super::mask::inspect_capture;
use super::path::{CameraPath, PATHS};
use super::render::{held_out, shows_head};
use super::session::Session;
use crate::capture::View;
use crate::config::{
    ColorSource, Config, IfaceConfig, MaskSource, Method, Preset, Product, Stage, VmBackground, VmConfig, key,
};
use crate::kernel::cpu::hash;
use crate::run::{Cost, ESTIMATE, Estimate, Fingerprint, Plan, read_record, read_status};
use crate::{Error, Result, io};
use std::path::Path;

/// Version of the stages' files and of what is recorded of their settings; raised when their
/// meaning changes.
const FORMAT: u32 = 3;

impl Session<'_> {
    /// Returns `until` and the stages it needs, in pipeline order. Views along a camera path need only the stages
    /// whose results they show, not those that only the evaluation shows.
    pub fn order(&self, until: Stage) -> Vec<Stage> {
        match &self.path {
            Some(path) if until == Stage::Render => {
                let mut order = Stage::with_needs(path.render.shows(), self.config);
                order.push(Stage::Render);
                order
            }
            _ => Stage::with_needs(vec![until], self.config),
        }
    }

    /// Returns the folder of the views that this session makes, relative to the run.
    pub fn views(&self) -> &str {
        self.path.as_ref().map_or("render", |path| &path.folder)
    }

    /// Returns the state of each stage for `until`: its folder, with `None` if the stage was never completed, else
    /// the differences from the existing result (none if it is up to date). Fails if the settings contradict each
    /// other. Nothing is written.
    pub fn stage_states(&self, until: Stage) -> Result<Vec<(String, Option<Vec<String>>)>> {
        self.can_make(until)?;
        let (mut found, mut missing) = (Vec::new(), Vec::new());
        for stage in self.order(until) {
            let Plan { name, fingerprint, .. } = self.compared_plan(stage);
            // a stage whose record cannot be read counts as not done
            let record = read_record(&self.run.path(name)).ok().flatten();
            missing.extend(record.is_none().then_some(stage));
            let differences = record.map(|r| {
                let problem = r.require_products(&self.run.path(name)).err().map(|e| e.to_string());
                fingerprint.differences(&r.fingerprint).into_iter().chain(problem).collect()
            });
            found.push((name.to_string(), differences));
        }
        self.require_inputs(&missing)?;
        self.require_masks(&missing)?;
        Ok(found)
    }

    /// Refuses settings that the stage `mask` would refuse, if that stage is to run.
    fn require_masks(&self, made: &[Stage]) -> Result<()> {
        if !made.contains(&Stage::Mask) {
            return Ok(());
        }
        let inspection = inspect_capture(&self.capture.root, &capture_options(self.config));
        inspection.problems.first().map_or(Ok(()), |problem| Err(Error::from(problem)))
    }

    /// Writes the complete configuration into the run, so that the run can be repeated. Fails before anything is
    /// changed if a stage that `until` needs was made or begun with other settings, if the settings contradict each
    /// other, or if work is left without a capture.
    pub fn remember(&self, until: Stage) -> Result<()> {
        self.agrees(until, &[])?;
        let order = self.order(until).into_iter();
        let left: Vec<Stage> = order.filter(|stage| !self.run.is_done(&self.plan(*stage))).collect();
        self.require_inputs(&left)?;
        self.write_estimate(left.is_empty())?;
        self.write("config.toml", self.config.to_toml().as_bytes(), left.is_empty())
    }

    /// Returns the non-empty folders of the run that become out of date when a stage is made again, in pipeline
    /// order: its own folder, those of the stages that depend on it, and views along paths that show it. If the views
    /// of a path are made again, only their own folder is returned.
    ///
    /// A finished stage that depends on it is kept if none of its inputs is affected by the changed settings. If no
    /// setting has changed, the stage and all later ones are made again.
    pub fn out_of_date(&self, stage: Stage) -> Result<Vec<String>> {
        let mut names = vec![self.views().to_string()];
        if stage != Stage::Render || self.path.is_none() {
            let is_done = |stage: Stage| {
                let plan = self.stage_plan(stage);
                self.run.is_done(&plan) && self.run.agrees(&plan).is_ok()
            };
            let repeated = stage.learns() || is_done(stage);
            let stays = |s: &Stage| !repeated && *s != stage && is_done(*s);
            let followers = stage.followers(self.config).into_iter();
            names = followers.filter(|s| !stays(s)).map(|s| s.to_string()).collect();
            // views of a path show only the head mesh or the extracted surface
            let kept = [Product::Head, Product::Surface].map(|part| self.fingerprint(part).digest());
            let removed = names.clone();
            let is_old = |input: &String, digest: &String| {
                removed.contains(input) && (repeated || !kept.contains(digest))
            };
            for folder in io::list_folders(&self.run.path(PATHS))? {
                if may_show(&folder, &is_old) {
                    let name = folder.file_name().unwrap_or_default().to_string_lossy();
                    names.push(format!("{PATHS}/{name}"));
                }
            }
        }
        let mut holds = Vec::new();
        for name in names {
            if !self.run.files(&name)?.is_empty() {
                holds.push(name);
            }
        }
        Ok(holds)
    }

    /// Removes what becomes out of date when a stage is made again on the way to `until`, after logging it. Removes
    /// nothing if `until` would then be refused.
    pub fn fresh(&self, stage: Stage, until: Stage) -> Result<()> {
        let names = self.require(until, Some(stage))?;
        if !names.is_empty() {
            let each = names.iter().map(|name| Ok(format!("`{name}` ({})", self.contents(name)?)));
            let each = each.collect::<Result<Vec<_>>>()?.join(", ");
            self.run.warn("run", &format!("removes what is made anew or out of date: {each}"));
        }
        self.run.fresh(&names)
    }

    /// Returns the number and size of the files in a folder of the run that a stage made again would remove.
    pub fn contents(&self, name: &str) -> Result<String> {
        let files = self.run.files(name)?;
        let plural = if files.len() == 1 { "" } else { "s" };
        Ok(format!("{} file{plural}, {:.1} MB", files.len(), files.values().sum::<u64>() as f64 / 1e6))
    }

    /// Returns whether the finished mesh differs from the settings only in how its files are written.
    pub fn differs_in_files(&self) -> bool {
        let Ok(Some(record)) = read_record(&self.run.path(Stage::Mesh)) else { return false };
        let differences = self.compared_plan(Stage::Mesh).fingerprint.differences(&record.fingerprint);
        let is_file = |line: &String| line.split_once(": ").is_some_and(|(key, _)| is_file_key(key));
        !differences.is_empty() && differences.iter().all(is_file)
    }

    /// Returns the folders that are out of date for `until`, if a stage is to be made again. Nothing is written.
    ///
    /// # Errors
    ///
    /// Fails if the command would be refused before any work.
    pub fn require(&self, until: Stage, fresh: Option<Stage>) -> Result<Vec<String>> {
        let Some(stage) = fresh else { return self.agrees(until, &[]).map(|()| Vec::new()) };
        let names = self.out_of_date(stage)?;
        let made: Vec<Stage> = stage
            .followers(self.config)
            .into_iter()
            .filter(|s| *s == stage || names.iter().any(|name| name == s.as_str()))
            .collect();
        self.require_inputs(&made)?;
        self.require_masks(&made)?;
        // do not clear a finished blend whose views could not be made again
        let blended = names.iter().any(|n| n == Stage::Ensemble.as_str())
            && !self.config.ensemble.members.is_empty()
            && read_record(&self.run.path(Stage::Ensemble)).ok().flatten().is_some();
        if blended {
            can_blend(self.config)?;
        }
        self.agrees(until, &names)?;
        let mut removed = 0;
        for name in &names {
            removed += self.run.files(name)?.values().sum::<u64>();
        }
        let order = self.order(until).into_iter().filter(|stage| made.contains(stage));
        order.map(|stage| self.plan(stage)).try_for_each(|plan| self.run.require_room(&plan, removed))?;
        Ok(names)
    }

    /// Checks that the run's contents agree with the settings of `until`, except for the folders in `cleared`.
    fn agrees(&self, until: Stage, cleared: &[String]) -> Result<()> {
        self.can_make(until)?;
        let plans = self.order(until).into_iter().map(|stage| self.compared_plan(stage));
        let mut kept = plans.filter(|plan| !cleared.iter().any(|name| name == plan.name));
        kept.try_for_each(|plan| {
            self.run.agrees(&plan).map_err(|e| match plan.name == Stage::Mesh.as_str() && self.differs_in_files() {
                true => {
                    let run = self.run.dir().display();
                    let hint = format!(
                        "`tiface export {run}` writes the finished mesh with such settings, and keeps the run; or {}",
                        e.hint()
                    );
                    e.with_hint(hint)
                }
                false => e,
            })
        })
    }

    /// Checks, before any work, that the settings that `until` depends on are consistent.
    fn can_make(&self, until: Stage) -> Result<()> {
        let order = self.order(until);
        const CAMERAS: &str = key!(render.cameras);
        let cameras = &self.config.render.cameras;
        if order.contains(&Stage::Render) && cameras != "test" {
            return Err(Error::usage(
                format!("`{CAMERAS}` is {cameras}, but it is the held-out views that are blended and judged"),
                format!(
                    "set it back with `--set {CAMERAS}=test`; `tiface render RUN --cameras {cameras}` makes \
                     the others, in a folder of their own"
                ),
            ));
        }
        if order.contains(&Stage::Ensemble) { can_blend(self.config) } else { Ok(()) }
    }

    /// Returns the plan of a stage; its fingerprint includes those of the stages it needs.
    pub fn plan(&self, stage: Stage) -> Plan<'_> {
        match &self.path {
            Some(path) if stage == Stage::Render => self.path_plan(path),
            _ => self.stage_plan(stage),
        }
    }

    /// Returns the plan of a stage with the capture's digests as an earlier process recorded them.
    fn compared_plan(&self, stage: Stage) -> Plan<'_> {
        let mut plan = self.plan(stage);
        if stage == Stage::Mask {
            plan.fingerprint.changed = self.inputs.changed(self.run);
        }
        plan
    }

    /// Returns the plan of a stage; if the stage makes views, they are those of the evaluation.
    fn stage_plan(&self, stage: Stage) -> Plan<'_> {
        Plan {
            name: stage.as_str(),
            fingerprint: self.fingerprint(Product::of(stage)),
            device: &self.config.device,
            needs_bytes: (16 << 20) + self.needs_bytes(stage),
            saves: stage.learns(),
        }
    }

    /// Returns everything that affects a product: the settings that say so, and what its stage
    /// reads.
    fn fingerprint(&self, product: Product) -> Fingerprint {
        let (stage, config) = (product.stage(), self.config);
        let mut fingerprint = Fingerprint::new(FORMAT, config.settings_of(product));
        for needed in stage.needs(config) {
            fingerprint = fingerprint.input(needed.as_str(), self.input(needed, &config.render.method));
        }
        for (name, digest) in self.inputs.read_by(stage) {
            fingerprint = fingerprint.input(name, digest);
        }
        if stage == Stage::Mesh {
            fingerprint = fingerprint.setting("format of mesh/parts", crate::mesh::files::FORMAT);
        }
        fingerprint
    }

    /// Returns the digest of a stage as an input; for the mesh, the digest of the part that views
    /// by these methods show.
    fn input(&self, stage: Stage, methods: &[Method]) -> String {
        let product = match stage {
            Stage::Mesh if shows_head(self.config, methods) => Product::Head,
            Stage::Mesh => Product::Surface,
            stage => Product::of(stage),
        };
        self.fingerprint(product).digest()
    }

    /// Returns about how many bytes a stage takes on the disk while it works, beside small files.
    fn needs_bytes(&self, stage: Stage) -> u64 {
        let Config { iface, mesh, render, .. } = self.config;
        match stage {
            Stage::Mask | Stage::Metrics => 0,
            // weights and two moments, for two checkpoints and one being written
            Stage::Iface => (iface.levels as u64) << iface.log2_table.min(40) << 3 << 3,
            Stage::Baseline | Stage::Tface => vm_bytes(&self.config.radiance(stage)),
            Stage::Mesh => {
                // a few triangles per cell of a closed surface, three formats and the parts
                let surface = (mesh.resolution as u64).pow(2) * 12 * 130;
                // pictures as parts and inside the files, and the float one
                surface + mesh.texels() * (6 * mesh.pictures() + 3 + if mesh.exr { 12 } else { 0 })
            }
            Stage::Render => {
                let each = if render.float { 12 + 10 } else { 12 };
                self.pixels() * each * render.method.len().max(1) as u64 / 2
            }
            Stage::Ensemble => self.pixels() * 4,
        }
    }

    /// Returns the inputs of the views along a path.
    fn path_plan<'p>(&'p self, path: &'p CameraPath) -> Plan<'p> {
        let CameraPath { folder, render, cameras, digest } = path;
        let config = Config { render: render.clone(), ..self.config.clone() };
        let mut fingerprint = Fingerprint::new(FORMAT, config.settings_of(Product::Path));
        if let Some(digest) = digest {
            fingerprint = fingerprint.input("cameras", digest);
        }
        for stage in render.shows() {
            fingerprint = fingerprint.input(stage.as_str(), self.input(stage, &render.method));
        }
        let pixels = |c: &crate::geom::Camera| c.width as u64 * c.height as u64;
        let all = match cameras {
            Some(cameras) => cameras.iter().map(|c| pixels(&c.camera)).sum(),
            None => self.capture.views.first().map_or(0, |v| pixels(&v.camera)) * render.orbit_views as u64,
        };
        let needs_bytes = (16 << 20) + 6 * all * render.method.len().max(1) as u64;
        Plan { name: folder, fingerprint, device: &self.config.device, needs_bytes, saves: false }
    }

    /// Returns the number of pixels of all photographs.
    pub(super) fn pixels(&self) -> u64 {
        let pixels = |v: &View| v.camera.width as u64 * v.camera.height as u64;
        self.capture.views.iter().map(pixels).sum()
    }
}

/// Returns whether the views in a path's folder show an outdated stage of this digest. Views with unreadable records
/// count as such.
fn may_show(folder: &Path, is_old: &dyn Fn(&String, &String) -> bool) -> bool {
    let any = |f: &Fingerprint| f.inputs.iter().any(|(stage, digest)| is_old(stage, digest));
    match (read_status(folder), read_record(folder)) {
        (Ok(None), Ok(None)) => false,
        (Ok(Some(status)), _) => any(&status.fingerprint),
        (_, Ok(Some(record))) => any(&record.fingerprint),
        _ => true,
    }
}

/// Weights and two moments of the planes, for two checkpoints and one being written; weights of the fields before.
fn vm_bytes(c: &VmConfig) -> u64 {
    let channels: usize = c.density_rank.iter().chain(&c.color_rank).sum();
    let side = (c.voxels_final as f64).cbrt();
    (channels as f64 * side * side * (36.0 + 4.0 * (c.learned() - 1) as f64)) as u64
}

const MIB: f64 = (1u64 << 20) as f64;

/// Memory that a stage takes on the CPU, MiB; each is that of the whole process while the stage works.
///
/// `tools/reference/estimates.py RUN...` compares what these say with the peaks that runs recorded.
mod mib {
    /// The program and what its libraries hold.
    pub const PROGRAM: f64 = 75.0;
    /// Stack and heap of a thread.
    pub const THREAD: f64 = 10.0;
    /// A pixel of a photograph in memory, with mask, validity and what is drawn from it.
    pub const PIXEL: f64 = 25e-6;
    /// A parameter of a radiance field in training: value, gradient, two moments, and a copy for a checkpoint.
    pub const VM_PARAMETER: f64 = 24e-6;
    /// A ray of a step of a radiance field, with its samples and their activations.
    pub const VM_RAY: f64 = 0.049;
    /// A float of the hash table in training.
    pub const TABLE_FLOAT: f64 = 20e-6;
    /// A sample of a step of I-Face.
    pub const SDF_SAMPLE: f64 = 0.0112;
    /// A cell of the largest slice through the box, per stage `mesh`: the grid near the surface, and the surface.
    pub const CELL: f64 = 6.2e-3;
    /// A texel while its color is fitted to photographs, while it is the network's, and that of each further picture.
    pub const FITTED_TEXEL: f64 = 1.4e-4;
    pub const TEXEL: f64 = 4e-5;
    pub const PICTURE_TEXEL: f64 = 2e-5;
    /// A head mesh with its tree, and a texel of it, in views.
    pub const SHOWN_MESH: f64 = 85.0;
    pub const SHOWN_TEXEL: f64 = 25e-6;
    /// A pixel of a view.
    pub const VIEW_PIXEL: f64 = 1.2e-4;
    /// The rays of a radiance field and of I-Face that are marched together, and a parameter of a loaded field.
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
    /// A cell of the largest slice through the box: the extracted surface, in the run and as a file.
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
    pub const FLOAT_PIXEL: f64 = 14.0;
    /// A pixel of a blend.
    pub const BLEND_PIXEL: f64 = 2.0;
    /// The report.
    pub const REPORT: f64 = 6e6;
    /// By how much runs differ from each other.
    pub const MARGIN: f64 = 1.15;
}

impl Session<'_> {
    /// Returns the folders of the unfinished stages that `until` needs, with the estimated cost of each on the CPU.
    pub fn ahead(&self, until: Stage) -> Vec<(String, Cost)> {
        let order = self.order(until).into_iter().map(|stage| (stage, self.plan(stage)));
        order.filter(|(_, p)| !self.run.is_done(p)).map(|(s, p)| (p.name.into(), self.cost(s))).collect()
    }

    /// Writes the estimated cost of the whole pipeline into the run, if the photographs can be counted.
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
    /// Memory is that of the whole process, disk what the stage leaves: while a field is trained, its checkpoints take up
    /// to nine times as much ([`Plan::needs_bytes`]).
    ///
    /// The constants were measured on runs of the synthetic head and of a bust, at 64 x 80 to 384 x 512 pixels and
    /// tiny to full settings; `docs/many-heads.md` says how far off other runs were.
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
        // propagating to all views, and matting
        let clicked = if self.inputs.clicks.is_some() { 2.5e-6 * all } else { 0.0 };
        // ISNet takes 4.5 core seconds a photograph with ONNX Runtime; other networks differ
        let m = &self.config.mask;
        let files = [&m.sam, &m.vitmatte, &m.alpha_net].into_iter().filter(|file| !file.is_empty()).count();
        let networks = 5.0 * (files * self.capture.views.len()) as f64;
        let residuals = |shown: bool| if shown { all } else { 0.0 };
        // what views by these methods take beside the views themselves
        let renderers = |methods: &[Method], residuals: f64| {
            let shows_mesh = methods.iter().any(|method| method.stage() == Stage::Mesh);
            let texels = (mesh.texels() * mesh.pictures()) as f64;
            let shown = if shows_mesh { mib::SHOWN_MESH + mib::SHOWN_TEXEL * texels } else { 0.0 };
            // of each field its parameters and what its rays take while they are marched; the next uses that again
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
        };
        let program = mib::PROGRAM + mib::THREAD * rayon::current_num_threads() as f64;
        let (cpu_s, stage_mib) = match stage {
            Stage::Mask => (0.7 + 3e-7 * all + clicked + networks, 65.0 + 5e-6 * all),
            Stage::Baseline | Stage::Tface => {
                let c = self.config.radiance(stage);
                let rays = c.training_rays() * c.learned() as f64;
                let parameters = vm_parameters(&c);
                // whole frames are mostly outside the hull, where no pixel is skipped; nor is the shell left by
                // training against two backgrounds
                let outside = match stage {
                    Stage::Baseline => 4.0,
                    _ if shell(&c) => 2.3,
                    _ => 1.0,
                };
                // samples along a ray are as dense as the grid
                let ray = outside * (3e-6 + 0.09e-6 * (c.voxels_final as f64).cbrt());
                let cpu_s = 0.1 + ray * rays + 4e-9 * parameters * (c.steps as usize * c.learned()) as f64;
                let trained = mib::VM_PARAMETER * parameters + mib::VM_RAY * c.rays as f64;
                match c.import.is_empty() {
                    true => (cpu_s, mib::PIXEL * all + trained),
                    false => (1.0, mib::VM_PARAMETER * parameters),
                }
            }
            Stage::Iface => {
                let samples = (iface.steps as usize * iface.samples) as f64;
                let table = ((iface.levels as u64 * 2) << iface.log2_table.min(32)) as f64;
                let cpu_s = 3.8 + 2.5e-6 * samples + 2e-9 * table * iface.steps as f64 + 1.8e-6 * all;
                let trained = mib::TABLE_FLOAT * table + mib::SDF_SAMPLE * iface.samples as f64;
                (cpu_s, mib::PIXEL * all + trained)
            }
            Stage::Mesh => {
                let cells = f64::from(mesh.resolution).powi(2);
                let (texels, pictures) = (mesh.texels() as f64, mesh.pictures() as f64);
                let texel = match mesh.color {
                    ColorSource::Photographs => mib::FITTED_TEXEL,
                    ColorSource::Network => mib::TEXEL,
                };
                (
                    0.5 + 1.3e-4 * cells + 5e-6 * texels * pictures + 1e-6 * all,
                    mib::PIXEL * all + mib::CELL * cells + (texel + mib::PICTURE_TEXEL * pictures) * texels,
                )
            }
            Stage::Render => {
                // the whole box, in the whole picture
                let whole = |method: &Method| {
                    let c = self.config.radiance(method.stage());
                    let empty = if *method == Method::Baseline || shell(&c) { 0.25e-6 } else { 0.1e-6 };
                    empty * (c.voxels_final as f64).cbrt()
                };
                let pixel = |method: &Method| match method {
                    Method::Baseline | Method::Tface if published => whole(method),
                    // no occupancy exists yet, so every sample of a ray is evaluated
                    Method::Volume if published && self.config.mask.source == MaskSource::None => 700e-6,
                    Method::Volume if published => 90e-6,
                    Method::Baseline | Method::Tface => 8e-6,
                    Method::Volume => 20e-6,
                    _ => 2.5e-6,
                };
                let residuals = residuals(self.render_config().shows_residuals(methods));
                let cpu_s = 0.1 + shown * methods.iter().map(pixel).sum::<f64>() + 1.6e-6 * residuals;
                (cpu_s, mib::VIEW_PIXEL * each + renderers(methods, residuals))
            }
            Stage::Ensemble => {
                let members = &self.config.ensemble.members;
                let fits = self.config.ensemble.weights.is_empty();
                let residuals = residuals(fits && self.config.render.shows_residuals(members));
                let rendered = if fits { renderers(members, residuals) } else { 0.0 };
                (0.2 + 3e-6 * held_out + 1.6e-6 * residuals, mib::VIEW_PIXEL * each + rendered)
            }
            Stage::Metrics => {
                (0.2 + 1.2e-6 * held_out * methods.len() as f64, 215.0 + mib::VIEW_PIXEL * each)
            }
        };
        let memory_bytes = (mib::MARGIN * (program + stage_mib) * MIB) as u64;
        let disk_bytes = (kept::MARGIN * self.kept_bytes(stage, [all, held_out, shown])) as u64;
        Cost { cpu_s, memory_bytes, disk_bytes }
    }

    /// Returns the bytes that a stage leaves on the disk; pixels are those of all photographs, of the held-out ones and of
    /// the views that the stage `render` shows.
    fn kept_bytes(&self, stage: Stage, [all, held_out, shown]: [f64; 3]) -> f64 {
        let Config { iface, mesh, render, .. } = self.config;
        kept::SMALL
            + match stage {
                Stage::Mask => kept::MASK_PIXEL * all + kept::SHEET_VIEW * self.capture.views.len() as f64,
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
                    let float = if render.float && self.path.is_none() { kept::FLOAT_PIXEL } else { 0.0 };
                    shown * self.render_config().method.len() as f64 * (kept::VIEW_PIXEL + float)
                }
                Stage::Ensemble => kept::BLEND_PIXEL * held_out,
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

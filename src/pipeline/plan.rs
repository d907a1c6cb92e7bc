//! The inputs of each stage, known before anything runs.

use super::ensemble::can_blend;
use super::inputs::capture_options;
use super::mask::inspect_capture;
use super::path::{CameraPath, PATHS};
use super::renderer::shows_head;
use super::session::Session;
use crate::config::{Config, Method, Product, SETTINGS_FILE, Stage, VmConfig, key};
use crate::run::{Plan, read_record, read_status};
use std::path::Path;
use tiface_base::{Error, Fingerprint, Result, io};
use tiface_capture::View;

/// Version of the stages' files and of what is recorded of their settings; raised when their
/// meaning changes.
const FORMAT: u32 = 3;

impl Session<'_> {
    /// Returns `until` and the stages it needs, in pipeline order. Views along a camera path need
    /// only the stages whose results they show, not those that only the evaluation shows.
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

    /// Returns the state of each stage for `until`: its folder, with `None` if the stage was never
    /// completed, else the differences from the existing result (none if it is up to date). Fails
    /// if the settings contradict each other. Nothing is written.
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
        self.require_work(&missing)?;
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

    /// Writes the complete configuration into the run, so that the run can be repeated. Fails
    /// before anything is changed if a stage that `until` needs was made or begun with other
    /// settings, if the settings contradict each other, or if work is left without a capture.
    pub fn remember(&self, until: Stage) -> Result<()> {
        self.agrees(until, &[])?;
        let order = self.order(until).into_iter();
        let left: Vec<Stage> = order.filter(|stage| !self.run.is_done(&self.plan(*stage))).collect();
        self.require_work(&left)?;
        self.write_estimate(left.is_empty())?;
        self.write(SETTINGS_FILE, self.config.to_toml().as_bytes(), left.is_empty())
    }

    /// Returns the non-empty folders of the run that become out of date when a stage is made again,
    /// in pipeline order: its own folder, those of the stages that depend on it, and views along
    /// paths that show it. If the views of a path are made again, only their own folder is
    /// returned.
    ///
    /// A finished stage that depends on it is kept if none of its inputs is affected by the changed
    /// settings. If no setting has changed, the stage and all later ones are made again.
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

    /// Removes what becomes out of date when a stage is made again on the way to `until`, after
    /// logging it. Removes nothing if `until` would then be refused.
    pub fn fresh(&self, stage: Stage, until: Stage) -> Result<()> {
        let names = self.require(until, Some(stage))?;
        if !names.is_empty() {
            let each = names.iter().map(|name| Ok(format!("`{name}` ({})", self.contents(name)?)));
            let each = each.collect::<Result<Vec<_>>>()?.join(", ");
            self.run.warn("run", &format!("removes what is made again or out of date: {each}"));
        }
        self.run.fresh(&names)
    }

    /// Returns the number and size of the files in a folder of the run that a stage made again
    /// would remove.
    pub fn contents(&self, name: &str) -> Result<String> {
        let files = self.run.files(name)?;
        let plural = if files.len() == 1 { "" } else { "s" };
        Ok(format!("{} file{plural}, {:.1} MB", files.len(), files.values().sum::<u64>() as f64 / 1e6))
    }

    /// Returns the configured formats of the mesh, in the syntax of `--format`.
    pub fn formats(&self) -> String {
        self.config.mesh.format.iter().map(|format| format.as_str()).collect::<Vec<_>>().join(",")
    }

    /// Returns whether the finished mesh differs from the settings only in the formats of its
    /// files.
    pub fn differs_in_formats(&self) -> bool {
        let Ok(Some(record)) = read_record(&self.run.path(Stage::Mesh)) else { return false };
        let differences = self.compared_plan(Stage::Mesh).fingerprint.differences(&record.fingerprint);
        let is_format =
            |line: &String| line.split_once(": ").is_some_and(|(key, _)| key == key!(mesh.format));
        !differences.is_empty() && differences.iter().all(is_format)
    }

    /// Returns the folders that are out of date for `until`, if a stage is to be made again.
    /// Nothing is written.
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
        self.require_work(&made)?;
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

    /// Checks that the run's contents agree with the settings of `until`, except for the folders in
    /// `cleared`.
    fn agrees(&self, until: Stage, cleared: &[String]) -> Result<()> {
        self.can_make(until)?;
        let plans = self.order(until).into_iter().map(|stage| self.compared_plan(stage));
        let mut kept = plans.filter(|plan| !cleared.iter().any(|name| name == plan.name));
        kept.try_for_each(|plan| {
            self.run.agrees(&plan).map_err(|e| {
                if plan.name != Stage::Mesh.as_str() || !self.differs_in_formats() {
                    return e;
                }
                let run = self.run.dir().display();
                let hint = format!(
                    "`tiface export {run} --format {}` writes these files beside the run, and keeps it; or {}",
                    self.formats(),
                    e.hint()
                );
                e.with_hint(hint)
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
        // T-Face's views show in the layers of the head mesh alone
        let reads = |needed: &Stage| product != Product::Surface || *needed != Stage::Tface;
        for needed in stage.needs(config).into_iter().filter(reads) {
            fingerprint = fingerprint.input(needed.as_str(), self.input(needed, &config.render.method));
        }
        for (name, digest) in self.inputs.read_by(stage) {
            fingerprint = fingerprint.input(name, digest);
        }
        if stage == Stage::Mesh {
            fingerprint = fingerprint.setting("format of mesh/parts", tiface_surface::files::FORMAT);
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
                let each = if render.float { 12 + 12 } else { 12 };
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
        let pixels = |c: &tiface_base::geom::Camera| c.width as u64 * c.height as u64;
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

/// Returns whether the views in a path's folder show an outdated stage of this digest. Views with
/// unreadable records count as such.
fn may_show(folder: &Path, is_old: &dyn Fn(&String, &String) -> bool) -> bool {
    let any = |f: &Fingerprint| f.inputs.iter().any(|(stage, digest)| is_old(stage, digest));
    match (read_status(folder), read_record(folder)) {
        (Ok(None), Ok(None)) => false,
        (Ok(Some(status)), _) => any(&status.fingerprint),
        (_, Ok(Some(record))) => any(&record.fingerprint),
        _ => true,
    }
}

/// Weights and two moments of the planes, for two checkpoints and one being written; weights of the
/// fields before.
fn vm_bytes(c: &VmConfig) -> u64 {
    let channels: usize = c.density_rank.iter().chain(&c.color_rank).sum();
    let side = (c.voxels_final as f64).cbrt();
    (channels as f64 * side * side * (36.0 + 4.0 * (c.learned() - 1) as f64)) as u64
}

//! What each stage builds on, and so what shapes it: known before anything runs.

use super::{FORMAT, Line, STAGES};
use crate::capture::{Split, View};
use crate::config::{Config, Method, VmConfig};
use crate::run::{Fingerprint, Plan, read_record};
use crate::{Error, Result};

/// Keys of `[mask]` that say where something lies; what it holds is an input of the stage.
const PLACES: [&str; 8] = [
    "mask.prompts",
    "mask.point",
    "mask.view",
    "mask.sam",
    "mask.sam_decoder",
    "mask.vitmatte",
    "mask.onnxruntime",
    "mask.memory_gib",
];

/// Keys of `[mask]` that shape masks which were found.
const FOUND: [&str; 2] = ["mask.source", "mask.meaning"];

impl Line<'_> {
    /// The stages that a stage reads from. What views are made of decides what `render` needs.
    pub fn needs(&self, stage: &str) -> Vec<&'static str> {
        match stage {
            "mask" => Vec::new(),
            "baseline" | "tface" | "iface" => vec!["mask"],
            "mesh" => vec!["iface"],
            "render" => shown(&self.config.render.method),
            "ensemble" => vec!["render"],
            _ if self.config.ensemble.members.is_empty() => vec!["render"],
            _ => vec!["render", "ensemble"],
        }
    }

    /// The stages up to `until` that it needs, itself the last, in the order of the line. Views of a path need what
    /// they show, and nothing that only the evaluation shows.
    pub fn order(&self, until: &str) -> Vec<&'static str> {
        match &self.path {
            Some(path) if until == "render" => {
                let mut order = self.with_needs(shown(&path.render.method));
                order.push("render");
                order
            }
            _ => self.with_needs(vec![known(until)]),
        }
    }

    /// Stages and all that they need, in the order of the line.
    fn with_needs(&self, mut wanted: Vec<&'static str>) -> Vec<&'static str> {
        let mut next = 0;
        while next < wanted.len() {
            let more: Vec<_> = self.needs(wanted[next]).into_iter().filter(|s| !wanted.contains(s)).collect();
            wanted.extend(more);
            next += 1;
        }
        STAGES.iter().copied().filter(|s| wanted.contains(s)).collect()
    }

    /// A stage and all that build on it, in the order of the line: what is out of date when it is
    /// recomputed.
    pub fn followers(&self, stage: &str) -> Vec<&'static str> {
        STAGES.iter().copied().filter(|s| self.with_needs(vec![s]).contains(&stage)).collect()
    }

    /// What would be done for `until`: the folder of each stage with `None` if it has to be worked on, else what
    /// differs from the result that lies there (nothing, if it is done). An error if the settings contradict
    /// each other. Nothing is written.
    pub fn outlook(&self, until: &str) -> Result<Vec<(String, Option<Vec<String>>)>> {
        let look = |name: &'static str| {
            let Plan { name, fingerprint, .. } = self.plan(name);
            // a record that cannot be read is none: the stage counts as not done
            let record = read_record(&self.run.path(name)).ok().flatten();
            (name.to_string(), record.map(|r| fingerprint.differences(&r.fingerprint)))
        };
        self.can_make(until)?;
        let found: Vec<_> = self.order(until).into_iter().map(look).collect();
        if found.iter().any(|(_, record)| record.is_none()) {
            self.is_there()?;
        }
        Ok(found)
    }

    /// Writes the complete configuration into the run: what repeats it. Refused, before anything is
    /// changed, if a stage that `until` needs was made or begun with other settings, if the settings contradict
    /// each other, or if there is work left and no capture to do it on.
    pub fn remember(&self, until: &str) -> Result<()> {
        self.agrees(until, &[])?;
        let idle = self.order(until).into_iter().all(|name| self.run.is_done(&self.plan(name)));
        if !idle {
            self.is_there()?;
        }
        let written = self.run.write("config.toml", self.config.to_toml().as_bytes());
        self.unless_idle(idle, written)
    }

    /// Does what lies in the run agree with what `until` asks for, but for the folders in `cleared`?
    pub(super) fn agrees(&self, until: &str, cleared: &[String]) -> Result<()> {
        self.can_make(until)?;
        let plans = self.order(until).into_iter().map(|name| self.plan(name));
        for plan in plans.filter(|plan| !cleared.iter().any(|name| name == plan.name)) {
            self.run.agrees(&plan)?;
        }
        Ok(())
    }

    /// Do the settings go together, as far as `until` depends on them? Asked before any work.
    fn can_make(&self, until: &str) -> Result<()> {
        let order = self.order(until);
        let cameras = &self.config.render.cameras;
        if order.contains(&"render") && cameras != "test" {
            return Err(Error::usage(
                format!(
                    "`render.cameras` is {cameras}, but it is the held-out views that are blended and judged"
                ),
                format!(
                    "set it back with `--set render.cameras=test`; `tiface render RUN --cameras {cameras}` makes the \
                     others, in a folder of their own"
                ),
            ));
        }
        if order.contains(&"ensemble") { self.can_blend() } else { Ok(()) }
    }

    /// What a stage is about to do; its fingerprint holds those of the stages it needs.
    pub fn plan(&self, name: &'static str) -> Plan<'_> {
        if let ("render", Some(path)) = (name, &self.path) {
            return self.path_plan(path);
        }
        let mut settings = self.config.values(name);
        let mut needs_bytes = 16 << 20;
        let needs = self.needs(name).into_iter();
        let mut inputs: Vec<_> = needs.map(|s| (s, self.plan(s).fingerprint.digest())).collect();
        if ["baseline", "tface", "iface"].contains(&name) {
            settings.insert("capture.tiles".into(), self.config.capture.tiles.to_string());
        }
        match name {
            "mask" => {
                settings.extend(self.config.values("capture"));
                settings.remove("capture.path"); // where it lies does not matter, what it holds does
                settings.remove("capture.tiles"); // masks are of whole photographs
                inputs.push(("capture", self.digest.clone()));
                match &self.clicks {
                    // where clicks and networks lie does not matter either, nor how much memory they get
                    Some(clicks) => {
                        settings.retain(|key, _| !PLACES.contains(&key.as_str()));
                        inputs.extend(clicks.inputs.iter().cloned());
                    }
                    // how masks would be made does not shape those that were found
                    None => {
                        settings.retain(|key, _| !key.starts_with("mask.") || FOUND.contains(&key.as_str()))
                    }
                }
            }
            "iface" => {
                settings.remove("iface.checkpoint_s"); // how often is no matter of what
                settings.insert("seed".into(), self.config.seed.to_string());
                settings.insert("preset".into(), self.config.preset.name().into());
                // weights and two moments, for two checkpoints and one being written
                let c = &self.config.iface;
                needs_bytes += (c.levels as u64) << c.log2_table.min(40) << 3 << 3;
            }
            "baseline" | "tface" => {
                // the baseline's own table says only where it differs from T-Face's
                let learned = Config { tface: self.vm(name), ..self.config.clone() };
                for (key, value) in learned.values("tface") {
                    let own = key.replacen("tface", name, 1);
                    settings.insert(if settings.contains_key(&own) { own } else { key }, value);
                }
                settings.remove("tface.checkpoint_s");
                if name == "baseline" {
                    settings.remove("tface.mask_weight"); // of a loss that it has not
                }
                settings.insert("preset".into(), self.config.preset.name().into());
                settings.insert("seed".into(), self.config.seed.to_string());
                if let Some((_, digest)) = self.imports.iter().find(|(stage, _)| *stage == name) {
                    settings.retain(|key, _| !key.ends_with(".import") && key != "capture.tiles");
                    inputs.push(("import", digest.clone()));
                }
                needs_bytes += vm_bytes(&self.vm(name));
            }
            "mesh" => {
                settings.insert("capture.unit_m".into(), self.config.capture.unit_m.to_string());
                settings.insert("format of mesh/parts".into(), super::parts::FORMAT.into());
                // a few triangles per cell of a closed surface, three formats and the parts
                let c = &self.config.mesh;
                needs_bytes += (c.resolution as u64).pow(2) * 12 * 130;
                // pictures as parts and inside the files, and the float one
                needs_bytes += c.texels() * (6 * c.pictures() + 3 + if c.exr { 12 } else { 0 });
            }
            "render" => {
                // what only paths ask for shapes no held-out view
                settings.remove("render.cameras");
                settings.remove("render.orbit_views");
                let each = if self.config.render.float { 12 + 10 } else { 12 };
                let methods = self.config.render.method.len().max(1) as u64;
                needs_bytes += self.pixels() * each * methods / 2;
            }
            "ensemble" => needs_bytes += self.pixels() * 4,
            _ => {}
        }
        let mut fingerprint = Fingerprint::new(FORMAT, settings);
        for (name, digest) in inputs {
            fingerprint = fingerprint.input(name, digest);
        }
        let saves = ["baseline", "tface", "iface"].contains(&name);
        Plan { name, fingerprint, device: &self.config.device, needs_bytes, saves }
    }

    /// Settings of the stage `baseline` or `tface`.
    pub(super) fn vm(&self, stage: &str) -> VmConfig {
        let Config { baseline, tface, .. } = self.config;
        if stage == "baseline" { baseline.field(tface) } else { tface.clone() }
    }

    /// The folders of the stages that `until` needs and that are not done, with the seconds that each may take on two
    /// cores: from counts of rays, samples, cells and pixels, and what one of each took where it was measured. No more
    /// than an estimate; whoever shows it corrects it by the pace of the stage at work.
    pub fn ahead(&self, until: &str) -> Vec<(String, f64)> {
        let Config { iface, mesh, render, .. } = self.config;
        let all = self.pixels() as f64;
        let each = all / self.capture.views.len().max(1) as f64;
        let test = each * self.capture.split(Split::Test).count().max(1) as f64;
        let (shown, seen) = match &self.path {
            Some(path) => {
                let count = path.cameras.as_ref().map_or(path.render.orbit_views as usize, Vec::len);
                (&path.render, each * count as f64)
            }
            None => (render, test),
        };
        let seconds = |stage: &str| match stage {
            "mask" => 2.0 + 2e-6 * all,
            "baseline" | "tface" => {
                let c = self.vm(stage);
                // whole frames are mostly outside the hull, and nothing of them is skipped
                let ray = if stage == "baseline" { 60e-6 } else { 23e-6 };
                if c.import.is_empty() { ray * (c.steps as usize * c.rays * c.learned()) as f64 } else { 1.0 }
            }
            "iface" => 3e-6 * (iface.steps as usize * iface.samples) as f64,
            "mesh" => {
                3e-4 * f64::from(mesh.resolution).powi(2) + 5e-6 * (mesh.texels() * mesh.pictures()) as f64
            }
            "render" => 8e-6 * seen * shown.method.len() as f64,
            "ensemble" => 1e-6 * all,
            _ => 2.0 + 1e-6 * test,
        };
        let order = self.order(until).into_iter().map(|stage| (stage, self.plan(stage)));
        order.filter(|(_, p)| !self.run.is_done(p)).map(|(s, p)| (p.name.into(), seconds(s))).collect()
    }

    /// Of all photographs.
    fn pixels(&self) -> u64 {
        let pixels = |v: &View| v.camera.width as u64 * v.camera.height as u64;
        self.capture.views.iter().map(pixels).sum()
    }
}

/// Weights and two moments of the planes, for two checkpoints and one being written; weights of the fields before.
fn vm_bytes(c: &VmConfig) -> u64 {
    let channels: usize = c.density_rank.iter().chain(&c.color_rank).sum();
    let side = (c.voxels_final as f64).cbrt();
    (channels as f64 * side * side * (36.0 + 4.0 * (c.learned() - 1) as f64)) as u64
}

/// The stages whose results views by these methods show.
pub(super) fn shown(methods: &[Method]) -> Vec<&'static str> {
    let is_shown = |stage: &&str| *stage == "mask" || methods.iter().any(|m| m.stage() == *stage);
    ["mask", "baseline", "tface", "iface", "mesh"].into_iter().filter(is_shown).collect()
}

/// The word of the line; the last one for any other.
fn known(stage: &str) -> &'static str {
    STAGES.iter().copied().find(|s| *s == stage).unwrap_or(STAGES[STAGES.len() - 1])
}

//! Stage `ensemble`: the members' views become one, in float, rounded once when they are written.
//!
//! ```text
//! ensemble/NAME.png       over the background
//!          weights.json   the weights, and what they gain where they were fitted
//! ```

use super::{Fields, Line, pictures};
use crate::capture::{MaskMeaning, MaskSource};
use crate::config::{MaskUse, Method};
use crate::ensemble::{EnsembleError, Member, Members, blend};
use crate::image::Image;
use crate::io;
use crate::render::RenderedView;
use crate::run::Done;
use crate::{Error, Result};
use serde_json::{Value, json};
use std::path::Path;

impl Line<'_> {
    /// Stage `ensemble`: one picture per camera of `render`. `fields` are only asked if weights are to be fitted.
    pub fn ensemble(&self, fields: &dyn Fields) -> Result<Done> {
        self.can_blend()?;
        Ok(self.run.stage(self.plan("ensemble"), |stage| {
            let scene = self.scene_or_fail()?;
            let cameras = self.cameras(&scene)?;
            let names = self.members();
            let (weights, fitted) = match self.config.ensemble.weights.is_empty() {
                true => self.fit(stage, &scene, fields)?,
                false => (self.shares(), Value::Null),
            };
            for (i, named) in cameras.iter().enumerate() {
                let images = self.member_views(&named.name)?;
                let blended = blend(&self.checked(&images)?, &weights)?;
                self.write_blend(stage.folder(), &named.name, blended)?;
                stage.monitor().step(i as u64 + 1, cameras.len() as u64, &[]);
                self.stop_here()?;
            }
            let told = json!({"members": names, "weights": weights, "fitted": fitted});
            let file = stage.folder().join("weights.json");
            io::write_atomic(&file, format!("{told:#}\n").as_bytes())?;
            let mut summary = told;
            summary["views"] = json!(cameras.len());
            Ok(summary)
        })?)
    }

    /// Will everything be there that is to be blended? Asked before any work.
    pub(super) fn can_blend(&self) -> Result<()> {
        let c = &self.config.ensemble;
        let wrong = |key: &'static str, problem: String, hint: &str| {
            Err(Error::usage(format!("`{key}` {problem}"), hint))
        };
        if c.members.is_empty() {
            return wrong("ensemble.members", "is empty: there is nothing to blend".into(), "name members");
        }
        for (i, member) in c.members.iter().enumerate() {
            let name = member.folder();
            if c.members[..i].contains(member) {
                return wrong("ensemble.members", format!("names {name} twice"), "name every member once");
            }
            if !self.config.render.method.contains(member) {
                let problem = format!("names {name}, which render.method does not make");
                let hint = format!(
                    "render it too (`tiface render RUN --fresh render --with {}`), or blend what there is with \
                     ensemble.members and ensemble.weights; `--set ensemble.members=` blends nothing",
                    self.shown_with_members()
                );
                return wrong("ensemble.members", problem, &hint);
            }
        }
        let (found, members) = (c.weights.len(), c.members.len());
        let sum: f64 = c.weights.iter().sum();
        if found == 0 && self.config.capture.tiles <= 0.0 {
            let problem = "is empty, but there is nothing to fit them on: capture.tiles is 0".into();
            return wrong(
                "ensemble.weights",
                problem,
                "give one for each of ensemble.members, or set capture.tiles=0.04",
            );
        }
        if found != members && found > 0 {
            let problem = format!("has {found} weights for {members} members");
            let hint = "give one for each of ensemble.members, in that order, or none to have them fitted";
            return wrong("ensemble.weights", problem, hint);
        }
        if found > 0 && (sum - 1.0).abs() > 1e-3 {
            let hint = EnsembleError::WeightSum { weights: self.shares(), sum }.hint();
            return wrong("ensemble.weights", format!("sum to {sum}, expected 1"), &hint);
        }
        if !self.config.render.float {
            let problem = "is false, but members are blended in float".into();
            return wrong("render.float", problem, "set it to true, or blend nothing: ensemble.members=");
        }
        Ok(())
    }

    /// The members' words.
    pub(super) fn members(&self) -> Vec<&'static str> {
        self.config.ensemble.members.iter().map(|m| m.folder()).collect()
    }

    /// What is shown and what is blended, as `--with` takes it.
    fn shown_with_members(&self) -> String {
        let shown = &self.config.render.method;
        let more = self.config.ensemble.members.iter().filter(|m| !shown.contains(m));
        shown.iter().chain(more).map(|m| m.folder()).collect::<Vec<_>>().join(",")
    }

    /// The weights as given; alike where none are.
    pub(super) fn shares(&self) -> Vec<f32> {
        let c = &self.config.ensemble;
        match c.weights.is_empty() {
            true => vec![1.0 / c.members.len() as f32; c.members.len()],
            false => c.weights.iter().map(|w| *w as f32).collect(),
        }
    }

    /// The views of all members from one camera, in float.
    fn member_views(&self, name: &str) -> Result<Vec<Image>> {
        let members = self.config.ensemble.members.iter();
        members.map(|m| Ok(pictures::read_float(&self.member_file(*m, name)?)?)).collect()
    }

    /// The float view of a member, if it was rendered.
    fn member_file(&self, member: Method, name: &str) -> Result<std::path::PathBuf> {
        let below = format!("render/{}/{}", member.folder(), pictures::FLOAT);
        let file = pictures::float_path(&self.run.path(&below), name);
        if io::is_file(&file) {
            return Ok(file);
        }
        let (word, stage) = (member.folder(), member.stage());
        Err(Error::cannot(
            format!("member `{word}` is missing: there is no `{below}/{name}.exr`"),
            format!(
                "`tiface render RUN --fresh render --with {}` makes it from the stage `{stage}`, or leave it out of \
                 ensemble.members",
                self.shown_with_members()
            ),
        ))
    }

    /// The members of one view, checked, and cut to the head where that is asked for.
    ///
    /// Never by fitted weights: so a fit sees the members as they will be blended.
    pub(super) fn checked<'i>(&self, images: &'i [Image]) -> Result<Members<'i>> {
        let named = self.config.ensemble.members.iter().zip(images);
        let list: Vec<Member<'i>> = named
            .map(|(m, image)| Member { name: m.folder(), image, masked: self.knows_masks(*m) })
            .collect();
        let members = Members::new(&list)?;
        if self.config.ensemble.cut {
            return Ok(members.cut(&self.shares())?);
        }
        Ok(members)
    }

    /// Was the field learned with masks?
    fn knows_masks(&self, method: Method) -> bool {
        let any = self
            .capture
            .views
            .iter()
            .any(|v| v.mask != MaskSource::None && v.mask_meaning == MaskMeaning::Empty);
        let used = match method {
            Method::Baseline | Method::Tface => self.vm(method.stage()).masks != MaskUse::None,
            Method::Volume | Method::Raycast | Method::Textured => true,
        };
        any && used
    }

    fn write_blend(&self, folder: &Path, name: &str, color: Image) -> Result<()> {
        let c = &self.config.render;
        let mut view = RenderedView { color, depth: Image::new(0, 0, 1), normal: Image::new(0, 0, 3) };
        if let Some(background) = pictures::behind(c.background) {
            pictures::over(&mut view, background);
        }
        Ok(pictures::write(folder, name, &view, c.format, self.config.capture.unit_m)?)
    }
}

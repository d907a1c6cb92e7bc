//! Stage `ensemble`: the members' views become one, in float, rounded once when they are written.
//!
//! ```text
//! ensemble/NAME.png              with the weights as given
//!          fitted/NAME.png       with fitted weights, of corrected members
//!          corrected/tface/      the members as corrected
//!          weights.json          what was given, what was fitted, what it gained on the views set aside
//! ```

use super::fit::{Blend, Fitted};
use super::march::points;
use super::{Line, PipelineError, pictures};
use crate::capture::{MaskMeaning, MaskSource, Split};
use crate::config::{Fit, MaskUse, Method};
use crate::ensemble::{EnsembleError, Member, Members, blend, blend_regions};
use crate::geom::{Camera, Similarity};
use crate::image::Image;
use crate::io;
use crate::render::RenderedView;
use crate::run::{Done, Failure};
use serde_json::{Value, json};
use std::path::Path;

impl Line<'_> {
    /// Stage `ensemble`: one picture per camera of `render`; a second set where something is fitted.
    pub fn ensemble(&self) -> Result<Done, PipelineError> {
        self.can_blend()?;
        Ok(self.run.stage(self.plan("ensemble"), |stage| {
            let scene = self.scene_or_fail()?;
            let world_from_scene = scene.scene_from_world.inverse();
            let cameras = self.cameras(&scene)?;
            let fitted = self.fit(stage, &scene)?;
            let given = self.given();
            let names = self.members();
            for (i, named) in cameras.iter().enumerate() {
                let mut images = self.member_views(&named.name)?;
                let members = self.checked(&images)?;
                let plain = blend(&members, &given).map_err(ensemble_failure)?;
                self.write_blend(stage.folder(), &named.name, plain)?;
                if let Some(fitted) = &fitted {
                    for (k, map) in fitted.maps.iter().enumerate() {
                        map.apply(names[k], &mut images[k]).map_err(ensemble_failure)?;
                        let folder = stage.folder().join("corrected").join(names[k]);
                        self.write_blend(&folder, &named.name, images[k].clone())?;
                    }
                    let members = self.checked(&images)?;
                    let better = match &fitted.blend {
                        Blend::Global(weights) => blend(&members, weights),
                        Blend::Regions(regions) => {
                            let camera = named.camera.transformed(&scene.scene_from_world);
                            let shown = self.points(&named.name, &camera, &world_from_scene)?;
                            blend_regions(&members, &shown, regions)
                        }
                    };
                    let better = better.map_err(ensemble_failure)?;
                    self.write_blend(&stage.folder().join("fitted"), &named.name, better)?;
                }
                stage.monitor().step(i as u64 + 1, cameras.len() as u64, &[]);
                self.stop_here()?;
            }
            let fitted: Option<&Fitted> = fitted.as_ref();
            let all = json!({
                "members": names,
                "weights": &self.config.ensemble.weights,
                "fitted": fitted.map_or(Value::Null, |f| f.record.clone()),
            });
            let file = stage.folder().join("weights.json");
            io::write_atomic(&file, format!("{all:#}\n").as_bytes())?;
            let mut summary = json!({
                "views": cameras.len(),
                "members": names,
                "weights": &self.config.ensemble.weights,
            });
            if let Some(f) = fitted {
                summary["fitted"] = f.summary();
            }
            Ok(summary)
        })?)
    }

    /// Will everything be there that is to be blended? Asked before any work.
    pub(super) fn can_blend(&self) -> Result<(), PipelineError> {
        let c = &self.config.ensemble;
        let wrong = |key: &'static str, problem: String, hint: &str| {
            Err(PipelineError::Settings { key, problem, hint: hint.into() })
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
                    "render it too (`tiface render --fresh render --with {}`), or blend what there is with \
                     ensemble.members and ensemble.weights; `--set ensemble.members=` blends nothing",
                    self.members().join(",")
                );
                return wrong("ensemble.members", problem, &hint);
            }
        }
        let (found, members) = (c.weights.len(), c.members.len());
        if found != members {
            let problem = format!("has {found} weights for {members} members");
            return wrong(
                "ensemble.weights",
                problem,
                "give one for each of ensemble.members, in that order",
            );
        }
        let sum: f64 = c.weights.iter().sum();
        if (sum - 1.0).abs() > 1e-3 {
            let hint = EnsembleError::WeightSum { weights: self.given(), sum }.hint();
            return wrong("ensemble.weights", format!("sum to {sum}, expected 1"), &hint);
        }
        if !self.config.render.float {
            let problem = "is false, but members are blended in float".into();
            return wrong("render.float", problem, "set it to true, or blend nothing: ensemble.members=");
        }
        if c.fits() && self.capture.split(Split::Val).next().is_none() {
            let (key, what) = match c.fit {
                Fit::None => ("ensemble.correct", "a correction of colours"),
                _ => ("ensemble.fit", "a fit of weights"),
            };
            let problem = format!("asks for {what}, but no view is set aside to fit it on");
            let hint = "set `capture.fit_views=8`: every 8th training view is then learned from by no field; \
                        test views are never used";
            return wrong(key, problem, hint);
        }
        Ok(())
    }

    /// The members' words.
    pub(super) fn members(&self) -> Vec<&'static str> {
        self.config.ensemble.members.iter().map(|m| m.folder()).collect()
    }

    /// The weights as given.
    pub(super) fn given(&self) -> Vec<f32> {
        self.config.ensemble.weights.iter().map(|w| *w as f32).collect()
    }

    /// The views of all members from one camera, in float.
    pub(super) fn member_views(&self, name: &str) -> Result<Vec<Image>, Failure> {
        let members = self.config.ensemble.members.iter();
        members.map(|m| Ok(pictures::read_float(&self.member_file(*m, name)?)?)).collect()
    }

    /// The float view of a member, if it was rendered.
    fn member_file(&self, member: Method, name: &str) -> Result<std::path::PathBuf, Failure> {
        let below = format!("render/{}/{}", member.folder(), pictures::FLOAT);
        let file = pictures::float_path(&self.run.path(&below), name);
        if io::is_file(&file) {
            return Ok(file);
        }
        let (word, stage) = (member.folder(), member.stage());
        Err(Failure::cannot(
            format!("member `{word}` is missing: there is no `{below}/{name}.exr`"),
            format!(
                "`tiface render --fresh render --with {}` makes it from the stage `{stage}`, or leave it out of \
                 ensemble.members",
                self.members().join(",")
            ),
        ))
    }

    /// The members of one view, checked, and cut to the head where that is asked for.
    ///
    /// Always by the weights as given: so a fit sees the members as they will be blended.
    pub(super) fn checked<'i>(&self, images: &'i [Image]) -> Result<Members<'i>, Failure> {
        let named = self.config.ensemble.members.iter().zip(images);
        let list: Vec<Member<'i>> = named
            .map(|(m, image)| Member { name: m.folder(), image, masked: self.knows_masks(*m) })
            .collect();
        let members = Members::new(&list).map_err(ensemble_failure)?;
        if self.config.ensemble.cut {
            return members.cut(&self.given()).map_err(ensemble_failure);
        }
        Ok(members)
    }

    /// Was the field learned with masks?
    pub(super) fn knows_masks(&self, method: Method) -> bool {
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

    /// What a view's pixels show, in the scene, from the depth of the member that knows surfaces best.
    pub(super) fn points(
        &self,
        name: &str,
        camera: &Camera,
        world_from_scene: &Similarity,
    ) -> Result<Image, Failure> {
        let best = [Method::Volume, Method::Raycast, Method::Textured, Method::Tface, Method::Baseline];
        let members = &self.config.ensemble.members;
        let member = best.into_iter().find(|m| members.contains(m)).unwrap_or(Method::Volume);
        let depth = pictures::read_float_depth(&self.member_file(member, name)?)?;
        if (depth.width, depth.height) != (camera.width, camera.height) {
            return Err(another_size(name));
        }
        Ok(points(camera, &depth, world_from_scene))
    }

    fn write_blend(&self, folder: &Path, name: &str, color: Image) -> Result<(), Failure> {
        let c = &self.config.render;
        let mut view = RenderedView { color, depth: Image::new(0, 0, 1), normal: Image::new(0, 0, 3) };
        if let Some(background) = pictures::behind(c.background) {
            pictures::over(&mut view, background);
        }
        Ok(pictures::write(folder, name, &view, c.format, self.config.capture.unit_m)?)
    }
}

fn another_size(name: &str) -> Failure {
    Failure::cannot(format!("the depth of view `{name}` has another size than its camera"), "render it again")
}

pub(super) fn ensemble_failure(e: EnsembleError) -> Failure {
    let hint = e.hint();
    Failure::cannot(e, hint)
}

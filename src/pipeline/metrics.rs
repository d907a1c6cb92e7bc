//! Stage `metrics`: every view, of every member and of the blends, against its photograph.

use super::{Line, against_truth, pictures, to_value};
use crate::capture::{LoadedView, View};
use crate::config::Background;
use crate::image::{Gray, Image};
use crate::io::{self, Limits};
use crate::metrics::{Metrics, ViewMetrics, compare};
use crate::run::Done;
use crate::{Error, Result};
use rayon::prelude::*;
use serde_json::{Map, Value};
use std::path::PathBuf;

/// A mask counts as empty only where it is nothing at all.
const NOTHING: u8 = 0;

/// Pictures of one kind, one for each view.
pub(super) struct Set {
    /// What it is called in `metrics.json`: a member, or `ensemble`.
    pub name: String,
    /// Where its pictures are.
    folder: PathBuf,
}

/// A picture that has a photograph.
pub(super) struct Shown<'a> {
    /// Its view.
    pub view: &'a View,
    /// The picture.
    pub file: PathBuf,
    /// The same in float, if it is there.
    float: PathBuf,
}

/// Figures of one picture.
struct Judged {
    head: ViewMetrics,
    region: Option<ViewMetrics>,
    /// Sum of opacity² over the pixels without any head, and how many those are.
    outside: Option<(f64, u64)>,
}

impl Line<'_> {
    /// Everything that is judged, in the order of the line.
    pub(super) fn sets(&self) -> Vec<Set> {
        let c = &self.config.ensemble;
        let set = |name: &str, folder: &str| Set { name: name.into(), folder: self.run.path(folder) };
        let methods = self.config.render.method.iter().map(|m| m.folder());
        let mut sets: Vec<Set> = methods.map(|m| set(m, &format!("render/{m}"))).collect();
        if !c.members.is_empty() {
            sets.push(set("ensemble", "ensemble"));
        }
        sets
    }

    /// The pictures of a set that have a photograph.
    pub(super) fn comparable(&self, set: &Set) -> Vec<Shown<'_>> {
        let floats = set.folder.join(pictures::FLOAT);
        let shown = |view| {
            let View { name, .. }: &View = view;
            let file = pictures::path(&set.folder, name, self.config.render.format);
            Shown { view, file, float: pictures::float_path(&floats, name) }
        };
        self.capture.views.iter().map(shown).filter(|s| io::is_file(&s.file)).collect()
    }

    /// Stage `metrics`: `metrics.json`, every rendered or blended view against its photograph, inside
    /// the mask and inside the capture's region of interest; how much of it is in the way outside; and
    /// the mesh against the truth where it is known.
    pub fn metrics(&self) -> Result<Done> {
        Ok(self.run.stage(self.plan("metrics"), |stage| {
            let mut out = Map::new();
            let sets = self.sets();
            for (i, set) in sets.iter().enumerate() {
                let shown = self.comparable(set);
                let judged = shown.par_iter().map(|s| self.judge(s)).collect::<Result<Vec<_>>>()?;
                if !judged.is_empty() {
                    out.insert(set.name.clone(), entry(judged));
                }
                stage.monitor().step(i as u64 + 1, sets.len() as u64, &[]);
                self.stop_here()?;
            }
            if out.is_empty() {
                return Err(Error::cannot(
                    "there is no view to be judged",
                    "name methods in `render.method`, and make their views with `--fresh render`",
                ));
            }
            if self.synthetic && self.order("metrics").contains(&"mesh") {
                let points = self.config.metrics.surface_points as usize;
                let truth = against_truth(&self.read_mesh()?, points);
                out.insert("truth_percent_of_head".into(), to_value(&truth));
            }
            let value = Value::Object(out);
            io::write_atomic(&stage.folder().join("metrics.json"), format!("{value:#}\n").as_bytes())?;
            Ok(means(&value))
        })?)
    }

    fn judge(&self, shown: &Shown) -> Result<Judged> {
        let background = self.config.render.background;
        let loaded = shown.view.load(&Limits::default())?;
        let render = pictures::read(&shown.file, self.config.render.format)?;
        let photo = pictures::expected(&loaded.photo, loaded.mask.as_ref(), background);
        let against =
            |mask: Option<&Gray>| compare(&shown.view.name, &render, &photo, mask, loaded.valid.as_ref());
        let region = loaded.region.as_ref().map(|r| against(Some(r))).transpose()?;
        let head = against(loaded.mask.as_ref())?;
        // a picture over a background is opaque; what it was before is in the float view
        let outside = if io::is_file(&shown.float) {
            square_opacity_outside(&pictures::read_float(&shown.float)?, &loaded)
        } else if background == Background::None {
            square_opacity_outside(&render, &loaded)
        } else {
            None
        };
        Ok(Judged { head, region, outside })
    }
}

/// One set's part of the file.
fn entry(judged: Vec<Judged>) -> Value {
    let (mut heads, mut regions, mut outside) = (Vec::new(), Vec::new(), (0.0, 0));
    for j in judged {
        heads.push(j.head);
        regions.extend(j.region);
        let (sum, pixels) = j.outside.unwrap_or_default();
        outside = (outside.0 + sum, outside.1 + pixels);
    }
    let mut entry = Map::new();
    entry.insert("head".into(), to_value(&Metrics::new(heads)));
    if !regions.is_empty() {
        entry.insert("region".into(), to_value(&Metrics::new(regions)));
    }
    if outside.1 > 0 {
        entry.insert("mean_square_opacity_outside".into(), (outside.0 / outside.1 as f64).into());
    }
    Value::Object(entry)
}

/// Sum of opacity² over the valid pixels of which the mask says that no head is there, and how many
/// there are; `None` without a mask. What floats before the background shows here.
fn square_opacity_outside(render: &Image, loaded: &LoadedView) -> Option<(f64, u64)> {
    let mask = loaded.mask.as_ref()?;
    let valid = |i: usize| loaded.valid.as_ref().is_none_or(|v| v.values[i] > 0);
    let alpha = render.data.as_chunks::<4>().0.iter().map(|p| p[3] as f64);
    let counted = alpha.zip(&mask.values).enumerate().filter(|(i, (_, m))| **m == NOTHING && valid(*i));
    Some(counted.fold((0.0, 0), |(sum, n), (_, (a, _))| (sum + a * a, n + 1)))
}

/// The part of a metrics file worth a line: means, without the single views.
fn means(metrics: &Value) -> Value {
    match metrics {
        Value::Object(map) => {
            let kept = map.iter().filter(|(key, _)| *key != "views");
            Value::Object(kept.map(|(key, value)| (key.clone(), means(value))).collect())
        }
        other => other.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Photo;

    #[test]
    fn opacity_before_the_background_counts_squared_and_only_where_no_head_is() {
        let mut render = Image::new(4, 1, 4);
        for (x, a) in [0.5, 1.0, 0.1, 0.9].into_iter().enumerate() {
            render.pixel_mut(x as u32, 0)[3] = a;
        }
        let gray = |values: [u8; 4]| Some(Gray { width: 4, height: 1, values: values.to_vec() });
        let photo = Photo { width: 4, height: 1, rgb: vec![[0; 3]; 4], alpha: None };
        // a hair of head in pixel 1, pixel 3 not valid: 0.5² + 0.1² = 0.26 over two pixels
        let loaded =
            LoadedView { photo, mask: gray([0, 1, 0, 0]), valid: gray([255, 255, 255, 0]), region: None };
        let (sum, pixels) = square_opacity_outside(&render, &loaded).unwrap();
        assert!((sum - 0.26).abs() < 1e-6 && pixels == 2, "{sum} over {pixels}");
        assert_eq!(square_opacity_outside(&render, &LoadedView { mask: None, ..loaded }), None);
    }
}

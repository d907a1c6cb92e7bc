//! Stage `mask`: which pixels are the head, and where that puts it in space.

use super::{Line, PipelineError, capture_failure, scene_file};
use crate::capture::scene::{self, Scene, SceneError, SceneOptions};
use crate::capture::{self, Split};
use crate::config::MaskMeaning;
use crate::image::Gray;
use crate::io::{self, Limits};
use crate::run::{Done, Failure, Stage};
use rayon::prelude::*;
use serde_json::json;

impl Line<'_> {
    /// Stage `mask`: the masks as pictures, and the box and hull they leave (`scene.json`).
    pub fn mask(&self) -> Result<Done, PipelineError> {
        let done = self.run.stage(self.plan("mask"), |stage| {
            let limits = Limits::default();
            let total = self.capture.views.len();
            let mut masks: Vec<Option<Gray>> = Vec::with_capacity(total);
            let mut coverage = Vec::new();
            // a few at a time: decoding is what takes time, and photographs are large
            for (i, views) in self.capture.views.chunks(8).enumerate() {
                let loaded: Vec<_> = views.par_iter().map(|v| v.load_mask(&limits)).collect();
                for (view, mask) in views.iter().zip(loaded) {
                    let mask = mask.map_err(capture_failure)?;
                    if let Some(mask) = &mask {
                        let file = stage.folder().join(format!("{}.png", view.name));
                        io::create_folder(file.parent().unwrap_or(stage.folder()))?;
                        io::write_png_gray(&file, mask)?;
                        coverage.push(capture::coverage(mask));
                    }
                    masks.push(mask);
                }
                stage.monitor().step((8 * (i + 1)).min(total) as u64, total as u64, &[]);
                self.stop_here()?;
            }
            if coverage.is_empty() {
                stage.warn(
                    "no view has a head mask: there is no visual hull to start from, nothing says which pixels \
                     are background, and the box learns whatever it holds; give masks for a head on its own",
                );
            }
            let scene = self.place(stage, masks)?;
            scene_file::write_scene(&stage.folder().join("scene.json"), &scene)?;
            let covered = coverage.iter().sum::<f64>() / coverage.len().max(1) as f64;
            Ok(json!({
                "views": total,
                "masks": coverage.len(),
                "coverage": covered,
                "box": scene::world_box(&scene),
            }))
        })?;
        self.run.write("cameras.json", &scene_file::cameras_json(&self.capture, &self.scene()?))?;
        Ok(done)
    }

    /// Where the head is, from the views that are learned from; held-out ones have no say.
    fn place(&self, stage: &Stage, masks: Vec<Option<Gray>>) -> Result<Scene, Failure> {
        let (mut cameras, mut carving, mut names) = (Vec::new(), Vec::new(), Vec::new());
        for (view, mask) in self.capture.views.iter().zip(masks) {
            if view.split == Split::Train {
                cameras.push(view.camera.clone());
                // what a mask calls "not looked at" may still hold head
                carving.push(mask.filter(|_| self.config.mask.meaning == MaskMeaning::Empty));
                names.push(view.name.clone());
            }
        }
        let options = SceneOptions { names, ..SceneOptions::default() };
        let (scene, warnings) = scene::fit(&cameras, &carving, &options).map_err(|e: SceneError| {
            let hint = e.hint();
            Failure::cannot(e, hint)
        })?;
        warnings.iter().for_each(|w| stage.warn(w));
        Ok(scene)
    }
}

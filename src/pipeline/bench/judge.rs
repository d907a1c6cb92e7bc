//! How near views are to photographs that nothing was learned from.

use crate::capture::scene::Scene;
use crate::capture::{LoadedView, Split, View};
use crate::config::{Method, ViewBackground};
use crate::image::Photo;
use crate::io::Limits;
use crate::metrics::compare;
use crate::pipeline::line::Line;
use crate::pipeline::pictures;
use crate::pipeline::render::Renderer;
use crate::{Error, Result};

/// Held-out views that are looked at: each costs seconds in each choice of a sweep.
const VIEWS: usize = 4;

/// Some held-out photographs.
pub(super) struct Judge<'l> {
    views: Vec<(&'l View, LoadedView, Photo)>,
    background: ViewBackground,
}

impl<'l> Judge<'l> {
    /// Those of a line.
    pub fn new(line: &'l Line<'l>) -> Result<Judge<'l>> {
        let held_out = [Split::Test, Split::Val].map(|s| line.capture.split(s).collect::<Vec<_>>());
        let Some(all) = held_out.into_iter().find(|views| !views.is_empty()) else {
            return Err(Error::cannot(
                "no view of this capture is held out: there is nothing to judge by",
                "name some as `test` in its transforms.json",
            ));
        };
        let count = all.len().min(VIEWS);
        let background = line.config.render.background;
        let views = (0..count).map(|i| {
            let view = all[i * all.len() / count];
            let loaded = line.judged(view).load(&Limits::default())?;
            let expected = pictures::expected(&loaded.photo, loaded.mask.as_ref(), background);
            Ok((view, loaded, expected))
        });
        Ok(Judge { views: views.collect::<Result<_>>()?, background })
    }

    /// Mean PSNR of the views by a method, inside the mask (of the frame without one), dB.
    pub fn psnr(&self, scene: &Scene, renderer: &Renderer, method: Method) -> Result<Option<f64>> {
        let mut found = Vec::new();
        for (view, loaded, expected) in &self.views {
            let camera = view.camera.transformed(&scene.scene_from_world);
            let mut rendered = renderer.view(method, &camera)?.ok_or_else(|| {
                Error::cannot(format!("there is nothing to show for `{}`", method.folder()), "")
            })?;
            if let Some(background) = pictures::behind(self.background) {
                pictures::over(&mut rendered, background);
            }
            let (mask, valid) = (loaded.mask.as_ref(), loaded.valid.as_ref());
            let figures = compare(&view.name, &rendered.color, expected, mask, valid)?;
            found.extend(if mask.is_some() { figures.psnr_masked } else { figures.psnr });
        }
        Ok((!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64))
    }
}

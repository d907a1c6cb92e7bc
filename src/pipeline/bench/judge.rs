//! How near something is to what nothing was learned from.

use crate::capture::scene::Scene;
use crate::capture::synthetic::SyntheticHead;
use crate::capture::{LoadedView, Split, View};
use crate::config::{Method, ViewBackground};
use crate::geom::{Bvh, Mesh};
use crate::image::Photo;
use crate::io::Limits;
use crate::metrics::{compare, distance};
use crate::pipeline::line::Line;
use crate::pipeline::pictures;
use crate::pipeline::render::Renderer;
use crate::render::RenderedView;
use crate::{Error, Result};
use rayon::prelude::*;

/// Held-out views that are looked at: each costs seconds in each choice of a sweep.
const VIEWS: usize = 4;

/// Points of the true surface.
const POINTS: usize = 20_000;

/// Some held-out photographs, and the true surface where it is known.
pub(super) struct Judge<'l> {
    views: Vec<(&'l View, LoadedView, Photo)>,
    background: ViewBackground,
    /// In the dataset's world.
    truth: Vec<glam::Vec3>,
    mm: f64,
}

impl<'l> Judge<'l> {
    /// Of a line; `truth` in the dataset's world.
    pub fn new(line: &'l Line<'l>, truth: Option<&Mesh>) -> Result<Judge<'l>> {
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
        let truth = match truth {
            Some(mesh) => distance::sample(mesh, POINTS),
            None if line.synthetic => {
                let points = SyntheticHead.surface_points(POINTS, 1);
                points.into_iter().filter(|&p| SyntheticHead.is_head(p)).collect()
            }
            None => Vec::new(),
        };
        let mm = 1000.0 * line.config.capture.unit_m;
        Ok(Judge { views: views.collect::<Result<_>>()?, background, truth, mm })
    }

    /// How many views are looked at.
    pub fn count(&self) -> usize {
        self.views.len()
    }

    /// The views by a method, over nothing.
    pub fn render(&self, scene: &Scene, renderer: &Renderer, method: Method) -> Result<Vec<RenderedView>> {
        let view = |(view, ..): &(&View, LoadedView, Photo)| {
            let camera = view.camera.transformed(&scene.scene_from_world);
            let rendered = renderer.view(method, &camera)?;
            rendered.ok_or_else(|| {
                Error::cannot(format!("there is nothing to show for `{}`", method.folder()), "")
            })
        };
        self.views.iter().map(view).collect()
    }

    /// Mean PSNR inside the mask (of the frame without one), dB.
    pub fn psnr(&self, rendered: Vec<RenderedView>) -> Result<Option<f64>> {
        let background = pictures::behind(self.background);
        let one = |(mut rendered, (view, loaded, expected)): (RenderedView, &(&View, LoadedView, Photo))| {
            if let Some(background) = background {
                pictures::over(&mut rendered, background);
            }
            let (mask, valid) = (loaded.mask.as_ref(), loaded.valid.as_ref());
            let found = compare(&view.name, &rendered.color, expected, mask, valid)?;
            Ok(if mask.is_some() { found.psnr_masked } else { found.psnr })
        };
        let all: Vec<Option<f64>> =
            rendered.into_par_iter().zip(&self.views).map(one).collect::<Result<_>>()?;
        let found: Vec<f64> = all.into_iter().flatten().collect();
        Ok((!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64))
    }

    /// Median distance from points of the true surface to a mesh in scene coordinates, mm; `None` where the truth is
    /// not known or the mesh is empty.
    pub fn off_truth(&self, mesh: &Mesh, scene: &Scene) -> Option<f64> {
        if mesh.triangles.is_empty() {
            return None;
        }
        let bvh = Bvh::new(mesh);
        let here = |p: &glam::Vec3| Some(bvh.closest_point(scene.scene_from_world.point(*p))?.distance);
        let mut all: Vec<f32> = self.truth.par_iter().filter_map(here).collect();
        all.sort_by(f32::total_cmp);
        Some(f64::from(*all.get(all.len() / 2)?) / scene.scene_from_world.scale * self.mm)
    }
}

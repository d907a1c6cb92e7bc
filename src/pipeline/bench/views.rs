//! Ways to make a view.

use super::surface::Finisher;
use super::{Bench, meter, sweep};
use crate::Result;
use crate::config::{Hair, MeshConfig, Method, Stage};
use crate::pipeline::render::{Meshes, Renderer};
use crate::report::bench::{Measure, Row, Sweep};

impl Bench<'_> {
    /// Each method, a view.
    pub(super) fn render(&self) -> Result<Sweep> {
        let fields = self.fields(&[Stage::Iface, Stage::Tface])?;
        let c = MeshConfig { lobes: 2, hair: Hair::Shells, ..self.config().mesh.clone() };
        let head = Finisher::new(self, &fields, &c)?.finish(self, &c)?;
        let triangles = head.mesh.triangles.len();
        let meshes = Meshes::of_head(head, [true, true]);
        let samples = self.config().render.samples;
        let renderer = Renderer::new(&self.scene, &fields, &meshes, samples, self.monitor());
        let camera = &self.line.capture.views[0].camera;
        let note = format!(
            "A view of {} × {} pixels; the mesh has {triangles} triangles and view-dependent colors of degree 2.",
            camera.width, camera.height
        );
        let measures = vec![Measure::more("PSNR, dB", 2, 0.05)];
        let mut sweep = sweep("render", "Render method", note, measures);
        let methods = [Method::Tface, Method::Volume, Method::Raycast, Method::Textured, Method::Raster];
        let all = meter::in_turn(methods.len(), |i| {
            self.check_stop()?;
            self.judge.render(&self.scene, &renderer, methods[i])
        })?;
        for (method, m) in methods.into_iter().zip(all) {
            let row = m.row("", method.folder(), self.judge.count(), Vec::new());
            sweep.rows.push(Row { figures: vec![self.judge.psnr(m.result)?], ..row });
        }
        Ok(sweep)
    }
}

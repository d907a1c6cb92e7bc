//! From a surface to what an artist opens: simplification, texture.

use super::{Bench, Extracted, PSNR, timed};
use crate::Result;
use crate::capture::LoadedView;
use crate::config::{ColorSource, Hair, MeshConfig, Method, Stage};
use crate::geom::{Camera, Mesh};
use crate::mesh::files::HeadMesh;
use crate::mesh::{SimplifyConfig, simplify};
use crate::metrics::distance;
use crate::pipeline::finish::{Export, finish};
use crate::pipeline::learn;
use crate::pipeline::mesh::photographs;
use crate::pipeline::render::{Meshes, Renderer};
use crate::pipeline::surface::{ClosedSurface, Fields, Surface};
use crate::report::bench::{Measure, Row, Sweep};
use glam::Vec3;

/// Points of a mesh that are compared with the field.
const POINTS: usize = 20_000;

/// Triangles of a simplified mesh.
const TRIANGLES: [usize; 6] = [2000, 5000, 10_000, 20_000, 50_000, 100_000];

impl Bench<'_> {
    /// Median distance of a mesh to the zero of a field, to first order, mm.
    fn off_field(&self, mesh: &Mesh, gradient: &dyn Fn(&[Vec3]) -> (Vec<f32>, Vec<Vec3>)) -> Option<f64> {
        let (values, gradients) = gradient(&distance::sample(mesh, POINTS));
        let mut off: Vec<f32> =
            values.iter().zip(&gradients).map(|(f, g)| f.abs() / g.length().max(0.05)).collect();
        off.sort_by(f32::total_cmp);
        off.get(off.len() / 2).map(|d| f64::from(*d) * self.mm())
    }

    /// Fewer and fewer triangles.
    pub(super) fn triangles(&self) -> Result<Sweep> {
        let fields = self.fields(&[Stage::Iface])?;
        let c = &self.config().mesh;
        let extracted = self.extracted(&fields, c)?;
        let (mesh, closed) = (&extracted.mesh, extracted.closed(fields.surface()?));
        let note = format!(
            "From {} triangles, extracted at {} cells; distances are medians.",
            mesh.triangles.len(),
            c.resolution
        );
        let mut rows = Vec::new();
        for triangles in TRIANGLES.into_iter().filter(|n| *n < mesh.triangles.len()) {
            self.check_stop()?;
            let mut mesh = mesh.clone();
            let config = SimplifyConfig { triangles, ..SimplifyConfig::default() };
            let gradient = |points: &[Vec3]| closed.sdf_gradient(points);
            let (_, cost) = timed(|| simplify(&mut mesh, Some(&gradient), &config, self.monitor()))?;
            let figures = vec![self.off_field(&mesh, &gradient)];
            rows.push(Row { series: "", choice: triangles.to_string(), cost, figures });
        }
        let measures = vec![Measure {
            name: "off the field, mm",
            digits: 4,
            more_is_better: Some(false),
            noise: (0.0, 0.03),
        }];
        Ok(Sweep { name: "triangles", title: "Triangles after simplification", note, measures, rows })
    }

    /// Size of the texture, where its colors come from, and how they change with the view.
    pub(super) fn texture(&self) -> Result<Sweep> {
        let fields = self.fields(&[Stage::Iface])?;
        let base = &self.config().mesh;
        let finisher = Finisher::new(self, &fields, base)?;
        let note = format!(
            "`head.glb` of {} triangles as a viewer shows it, without soft layers; the time is that of laying out, baking and \
             fitting.",
            finisher.mesh.triangles.len()
        );
        let plain =
            MeshConfig { lobes: 0, hair: Hair::None, color: ColorSource::Photographs, ..base.clone() };
        let mut choices: Vec<(&'static str, String, MeshConfig)> = Vec::new();
        for texture_px in [256, 512, 1024, 2048] {
            choices.push((
                "from photographs",
                format!("{texture_px}²"),
                MeshConfig { texture_px, ..plain.clone() },
            ));
        }
        for lobes in [1, 2] {
            let word = format!("1024², degree {lobes}");
            choices.push(("view-dependent", word, MeshConfig { texture_px: 1024, lobes, ..plain.clone() }));
        }
        for samples in [1, 2] {
            let word = format!("1024², {} samples", samples * samples);
            let color = ColorSource::Network;
            let c = MeshConfig { texture_px: 1024, texture_samples: samples, color, ..plain.clone() };
            choices.push(("from the network", word, c));
        }
        let mut rows = Vec::new();
        for (series, choice, c) in choices {
            self.check_stop()?;
            let (head, cost) = timed(|| finisher.finish(self, &c))?;
            let triangles = head.mesh.triangles.len() as f64;
            let meshes = Meshes::of_head(head, [true, false]);
            let renderer = Renderer::new(&self.scene, &fields, &meshes, 2, self.monitor());
            let psnr = self.judge.psnr(&self.scene, &renderer, Method::Textured)?;
            let figures = vec![psnr, Some(triangles)];
            rows.push(Row { series, choice, cost, figures });
        }
        let count = Measure { name: "triangles", digits: 0, more_is_better: None, noise: (0.0, 0.0) };
        let measures = vec![Measure { noise: (0.05, 0.0), ..PSNR }, count];
        Ok(Sweep { name: "texture", title: "Texture", note, measures, rows })
    }
}

/// A simplified surface that is finished again and again.
pub(super) struct Finisher<'f> {
    mesh: Mesh,
    extracted: Extracted,
    fields: &'f dyn Fields,
    views: Vec<(Camera, LoadedView)>,
}

impl<'f> Finisher<'f> {
    /// Extracts and simplifies as `c` says.
    pub fn new(bench: &Bench, fields: &'f dyn Fields, c: &MeshConfig) -> Result<Finisher<'f>> {
        let mut extracted = bench.extracted(fields, c)?;
        let mut mesh = std::mem::take(&mut extracted.mesh);
        if c.triangles > 0 && (c.triangles as usize) < mesh.triangles.len() {
            let closed = extracted.closed(fields.surface()?);
            let config = SimplifyConfig { triangles: c.triangles as usize, ..SimplifyConfig::default() };
            simplify(&mut mesh, Some(&|p: &[Vec3]| closed.sdf_gradient(p)), &config, bench.monitor())?;
        }
        let views = learn::training_views(&bench.line.capture, &bench.scene, bench.config())?;
        Ok(Finisher { mesh, extracted, fields, views })
    }

    /// Lays out, bakes and fits as `c` says.
    pub fn finish(&self, bench: &Bench, c: &MeshConfig) -> Result<HeadMesh> {
        let (capture, config) = (&bench.line.capture, bench.config());
        let (export, cell) = (Export::new(capture, config), self.extracted.report.cell_size);
        let (closed, cameras) = (self.extracted.closed(self.fields.surface()?), bench.cameras());
        let photographs = photographs(&self.views);
        let c = MeshConfig { triangles: 0, max_error: 0.0, ..c.clone() };
        let scene = &bench.scene;
        let done =
            finish(&self.mesh, cell, &closed, &cameras, &photographs, scene, &export, &c, bench.monitor())?;
        Ok(done.head)
    }
}

impl Extracted {
    fn closed<'a>(&'a self, field: &'a dyn Surface) -> ClosedSurface<'a> {
        ClosedSurface { field, cap: self.cap.as_ref(), patches: self.patches.as_ref() }
    }
}

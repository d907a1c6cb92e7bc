//! From a field to what an artist opens: extraction, simplification, texture.

use super::{Bench, Extracted, meter, off_truth, sweep};
use crate::Result;
use crate::capture::LoadedView;
use crate::config::{ColorSource, Hair, MeshConfig, Method, Stage};
use crate::geom::{Camera, Mesh};
use crate::mesh::files::HeadMesh;
use crate::mesh::{NodeGrid, SimplifyConfig, Volume, clean, marching, simplify};
use crate::metrics::distance;
use crate::pipeline::export::Export;
use crate::pipeline::finish::finish;
use crate::pipeline::mesh::photographs;
use crate::pipeline::render::{Meshes, Renderer};
use crate::pipeline::surface::{ClosedSurface, Fields, Surface};
use crate::pipeline::tiles;
use crate::report::bench::{Measure, Row, Sweep};
use glam::Vec3;

/// Cells along the longest side.
const RESOLUTIONS: [u32; 5] = [64, 96, 128, 192, 256];

/// Dense grids beyond this one are for patient people.
const DENSEST: u32 = 128;

/// Points of a mesh that are compared with the field.
const POINTS: usize = 20_000;

/// Triangles of a simplified mesh.
const TRIANGLES: [usize; 6] = [2000, 5000, 10_000, 20_000, 50_000, 100_000];

impl Bench<'_> {
    /// The zero level set of the trained distance, sparsely, densely, and by another library.
    pub(super) fn extraction(&self) -> Result<Sweep> {
        let fields = self.fields(&[Stage::Iface])?;
        let field = fields.surface()?;
        let note = "Distances are medians. Ours evaluates the field near its surface and ends with Newton steps, cleaning and closing; the others \
                    evaluate every node and march. `isosurface` is that crate's marching cubes over the same values.";
        let measures =
            vec![Measure::less("off the field, mm", 4, 0.03), off_truth(), Measure::count("nodes evaluated")];
        let mut sweep = sweep("extraction", "Extraction", note.into(), measures);
        let config = |resolution| MeshConfig { resolution, ..self.config().mesh.clone() };
        let sparse = meter::in_turn(RESOLUTIONS.len(), |i| {
            self.check_stop()?;
            self.extracted(&fields, &config(RESOLUTIONS[i]))
        })?;
        let mut bounds = None;
        for (resolution, m) in RESOLUTIONS.into_iter().zip(sparse) {
            let Extracted { mesh, report, .. } = &m.result;
            bounds = Some(report.bounds());
            let figures = self.off(mesh, field, report.nodes_evaluated);
            sweep.rows.push(m.row("sparse (ours)", resolution.to_string(), 1, figures));
        }
        let Some(bounds) = bounds else { return Ok(sweep) };
        for (series, with) in
            [("dense marching", marched as fn(&Dense) -> Result<Mesh>), ("isosurface", by_isosurface)]
        {
            let dense: Vec<u32> = RESOLUTIONS.into_iter().filter(|r| *r <= DENSEST).collect();
            let all = meter::in_turn(dense.len(), |i| {
                self.check_stop()?;
                let grid = NodeGrid::fit(bounds, dense[i] as usize)?;
                let values = self.values(field, &grid);
                let mut mesh = with(&Dense { grid: &grid, values: &values })?;
                clean(&mut mesh, 1.0)?;
                Ok::<_, crate::Error>((mesh, grid.nodes()))
            })?;
            for (resolution, m) in dense.into_iter().zip(all) {
                let (mesh, nodes) = &m.result;
                let figures = self.off(mesh, field, *nodes);
                sweep.rows.push(m.row(series, resolution.to_string(), 1, figures));
            }
        }
        Ok(sweep)
    }

    /// Distance of a mesh to the field's zero and to the truth, mm, and the nodes where the field was evaluated.
    fn off(&self, mesh: &Mesh, field: &dyn Surface, nodes: usize) -> Vec<Option<f64>> {
        let off = self.off_field(mesh, &|points| field.sdf_gradient(points));
        vec![off, self.judge.off_truth(mesh, &self.scene), Some(nodes as f64)]
    }

    /// Median distance of a mesh to the zero of a field, to first order, mm.
    fn off_field(&self, mesh: &Mesh, gradient: &dyn Fn(&[Vec3]) -> (Vec<f32>, Vec<Vec3>)) -> Option<f64> {
        let (values, gradients) = gradient(&distance::sample(mesh, POINTS));
        let mut off: Vec<f32> =
            values.iter().zip(&gradients).map(|(f, g)| f.abs() / g.length().max(0.05)).collect();
        off.sort_by(f32::total_cmp);
        off.get(off.len() / 2).map(|d| f64::from(*d) * self.mm())
    }

    /// The field at every node; outside the hull it is outside.
    fn values(&self, field: &dyn Surface, grid: &NodeGrid) -> Vec<f32> {
        let [nx, ny, nz] = grid.dims;
        let mut values = Vec::with_capacity(nx * ny * nz);
        for z in 0..nz {
            let points: Vec<Vec3> =
                (0..ny).flat_map(|y| (0..nx).map(move |x| [x, y, z])).map(|node| grid.point(node)).collect();
            values.extend(field.sdf(&points).iter().zip(&points).map(|(f, p)| {
                let inside = self.scene.hull.as_ref().is_none_or(|hull| hull.contains(*p));
                if inside { *f } else { f.abs().max(grid.spacing) }
            }));
        }
        values
    }

    /// Fewer and fewer triangles.
    pub(super) fn triangles(&self) -> Result<Sweep> {
        let fields = self.fields(&[Stage::Iface])?;
        let c = &self.config().mesh;
        let Extracted { mesh, cap, patches, .. } = self.extracted(&fields, c)?;
        let closed = ClosedSurface { field: fields.surface()?, cap: cap.as_ref(), patches: patches.as_ref() };
        let note = format!(
            "From {} triangles, extracted at {} cells; distances are medians.",
            mesh.triangles.len(),
            c.resolution
        );
        let measures = vec![Measure::less("off the field, mm", 4, 0.03), off_truth()];
        let mut sweep = sweep("triangles", "Triangles after simplification", note, measures);
        let counts: Vec<usize> = TRIANGLES.into_iter().filter(|n| *n < mesh.triangles.len()).collect();
        let gradient = |points: &[Vec3]| closed.sdf_gradient(points);
        let all = meter::in_turn(counts.len(), |i| {
            self.check_stop()?;
            let mut mesh = mesh.clone();
            let config = SimplifyConfig { triangles: counts[i], ..SimplifyConfig::default() };
            simplify(&mut mesh, Some(&gradient), &config, self.monitor())?;
            Ok::<_, crate::Error>(mesh)
        })?;
        for (triangles, m) in counts.into_iter().zip(all) {
            let off = self.off_field(&m.result, &|points| closed.sdf_gradient(points));
            let figures = vec![off, self.judge.off_truth(&m.result, &self.scene)];
            sweep.rows.push(m.row("", triangles.to_string(), 1, figures));
        }
        Ok(sweep)
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
        let measures = vec![Measure::more("PSNR, dB", 2, 0.05), Measure::count("triangles")];
        let mut sweep = sweep("texture", "Texture", note, measures);
        let plain =
            MeshConfig { lobes: 0, hair: Hair::None, color: ColorSource::Photographs, ..base.clone() };
        let mut choices: Vec<(&str, String, MeshConfig)> = Vec::new();
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
        for (series, choice, c) in choices {
            self.check_stop()?;
            let m = meter::once(|| finisher.finish(self, &c)).whole()?;
            let row = m.row(series, choice, 1, Vec::new());
            let head = m.result;
            let triangles = head.mesh.triangles.len() as f64;
            let meshes = Meshes::of_head(head, [true, false]);
            let renderer = Renderer::new(&self.scene, &fields, &meshes, 2, self.monitor());
            let views = self.judge.render(&self.scene, &renderer, Method::Textured)?;
            let figures = vec![self.judge.psnr(views)?, Some(triangles)];
            sweep.rows.push(Row { figures, ..row });
        }
        Ok(sweep)
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
        let views = tiles::training_views(&bench.line.capture, &bench.scene, bench.config())?;
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

/// Values at every node.
struct Dense<'a> {
    grid: &'a NodeGrid,
    values: &'a [f32],
}

fn marched(dense: &Dense) -> Result<Mesh> {
    let NodeGrid { dims, origin, spacing } = *dense.grid;
    let volume = Volume { dims, values: dense.values, origin, spacing: Vec3::splat(spacing) };
    Ok(marching(&volume, true)?.into_mesh())
}

/// The marching cubes of the crate `isosurface`, on a cube of nodes.
fn by_isosurface(dense: &Dense) -> Result<Mesh> {
    use isosurface::MarchingCubes;
    use isosurface::distance::Signed;
    use isosurface::extractor::IndexedVertices;
    use isosurface::sampler::Sampler;
    use isosurface::source::ScalarSource;

    /// Nodes of the grid by their place in the unit cube; outside the grid is outside.
    struct Nodes<'a>(&'a Dense<'a>, usize);

    impl ScalarSource for Nodes<'_> {
        fn sample_scalar(&self, p: isosurface::math::Vec3) -> Signed {
            let Nodes(Dense { grid, values }, side) = self;
            let at = [p.x, p.y, p.z].map(|v| (v * (side - 1) as f32).round() as usize);
            let inside = (0..3).all(|a| at[a] < grid.dims[a]);
            let [x, y, z] = at;
            let border = (0..3).any(|a| at[a] == 0 || at[a] + 1 >= grid.dims[a]);
            // closed where the grid ends, as ours
            let value = if inside { values[(z * grid.dims[1] + y) * grid.dims[0] + x] } else { grid.spacing };
            Signed(if border { value.max(0.5 * grid.spacing) } else { value })
        }
    }

    let grid = dense.grid;
    let side = grid.dims.into_iter().max().unwrap_or(2);
    let (mut vertices, mut indices) = (Vec::new(), Vec::new());
    let mut extractor = IndexedVertices::new(&mut vertices, &mut indices);
    MarchingCubes::<Signed>::new(side).extract(&Sampler::new(&Nodes(dense, side)), &mut extractor);
    let scale = (side - 1) as f32 * grid.spacing;
    let position = |p: &[f32]| grid.origin + scale * Vec3::new(p[0], p[1], p[2]);
    Ok(Mesh {
        positions: vertices.chunks_exact(3).map(position).collect(),
        triangles: indices.chunks_exact(3).map(|t| [t[0], t[2], t[1]]).collect(),
        ..Mesh::default()
    })
}

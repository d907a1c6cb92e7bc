//! Stage `mesh`: the zero level set of the learned distance, closed, in the dataset's world.

use super::finish::{Closing, Finished, REACH};
use super::parts::Whole;
use super::product::Product;
use super::surface::Surface;
use super::{Line, export};
use crate::capture::scene::Scene;
use crate::capture::{self, Split};
use crate::config::{Genus, MeshConfig};
use crate::geom::{Camera, Mesh, Similarity};
use crate::io::{self, Limits};
use crate::mesh::bake::{Learned, seen_colors};
use crate::mesh::files::ReadMeshError;
use crate::mesh::{self, Cap, HandleReport, LONGEST_HANDLE, Patches, files};
use crate::run::StageDir;
use crate::{Error, Result};
use glam::{DVec3, Vec3};
use serde_json::{Value, json};

impl Line<'_> {
    /// Stage `mesh`: the whole surface as `surface.ply` in the dataset's world, and the product an artist opens
    /// in the formats asked for. `fields` are only asked if there is something to do.
    pub(super) fn mesh(&self, scene: &Scene, field: &dyn Surface, dir: &StageDir) -> Result<Value> {
        Ok((|stage: &StageDir| -> Result<Value> {
            let c = &self.config.mesh;
            let config = mesh::ExtractOptions {
                resolution: c.resolution as usize,
                coarse_step: c.coarse_step as usize,
                keep_share: c.keep_share,
                newton_steps: c.newton_steps as usize,
                relax: c.relax,
                longest_handle: if c.genus == Genus::Simple { LONGEST_HANDLE } else { 0.0 },
                verify: c.verify,
                ..mesh::ExtractOptions::default()
            };
            let hull = scene.hull.as_ref().map(|hull| |p: Vec3| hull.contains(p));
            let inside_hull = hull.as_ref().map(|f| f as &(dyn Fn(Vec3) -> bool + Sync));
            // the colour of a vertex is what is seen looking straight at it
            let color = |points: &[Vec3], normals: &[Vec3]| {
                let directions: Vec<Vec3> = normals.iter().map(|n| -*n).collect();
                field.color(points, normals, &directions)
            };
            // below the frames' border the surface is a guess: close the mesh where enough cameras look
            let cameras: Vec<Camera> = self.capture.split(Split::Train).map(|v| v.camera.clone()).collect();
            let kept = capture::well_seen(&scene, &cameras, self.capture.up);
            let extracted = mesh::extract(
                |p: &[Vec3]| field.sdf(p),
                |p: &[Vec3]| field.sdf_gradient(p),
                color,
                kept,
                inside_hull,
                &config,
                stage.monitor(),
            );
            let (mut surface, report) = extracted?;
            report.warnings(c.cap).iter().for_each(|w| stage.warn(w));
            let mm = scene.scene_from_world.inverse().scale * self.config.capture.unit_m * 1000.0;
            report.handles.warning(mm).iter().for_each(|w| stage.warn(w));
            let patches = Patches::of(&surface, &report.handles);
            let mut cap = Cap::of(&surface, report.bounds(), report.cell_size);
            if let Some(cap) = &cap {
                if c.cap {
                    cap.paint(&mut surface);
                } else {
                    cap.open(&mut surface);
                }
            }
            // what took longest is kept, whatever comes of the rest
            let bytes = files::placed_to_ply(&surface, &scene.scene_from_world.inverse())?;
            io::write_atomic(&stage.folder().join("surface.ply"), &bytes)?;
            let parts = stage.folder().join("parts");
            let surface_triangles = surface.triangles.len();
            // vertices have the colour seen straight; textures and rays that of the cameras, and so their cap
            if let Some(cap) = cap.as_mut() {
                let learned = Learned {
                    gradient: &|p| field.sdf_gradient(p),
                    colors: &|p, n, counts, d| field.colors(p, n, counts, d),
                };
                let cameras: Vec<Camera> =
                    cameras.iter().map(|c| c.transformed(&scene.scene_from_world)).collect();
                let reach = REACH * report.cell_size;
                cap.shade(|p, n| seen_colors(&surface, p, n, &learned, &cameras, reach));
            }
            let closing = Closing { cap: cap.as_ref(), patches: patches.as_ref() };
            let finished = self.finish(&surface, closing, report.cell_size, &scene, field, stage.monitor());
            let Finished { product, linear, report: steps, warnings } = finished?;
            warnings.iter().for_each(|w| stage.warn(w));

            product.save(&parts)?;
            let plain = Mesh { colors: Vec::new(), ..surface };
            Whole { mesh: plain, cap: cap.filter(|_| c.cap) }.save(&parts)?;
            if let Some(linear) = linear {
                let (w, h) = (linear.width, linear.height);
                let plane = |k: usize| linear.data.iter().skip(k).step_by(3).copied().collect::<Vec<f32>>();
                let [r, g, b] = [plane(0), plane(1), plane(2)];
                let channels = [("R", &r[..]), ("G", &g[..]), ("B", &b[..])];
                io::write_exr(&stage.folder().join("head.exr"), w, h, &channels)?;
            }
            let export = self.export();
            for &format in &c.format {
                let exported = product.files(format, &export, c, "head")?;
                exported.warnings.iter().for_each(|w| stage.warn(w));
                // the mesh names the others: it comes last
                for (name, bytes) in exported.files.iter().rev() {
                    io::write_atomic(&stage.folder().join(name), bytes)?;
                }
            }
            // without the way, which f32 may not hold
            let in_place = Similarity { translation: DVec3::ZERO, ..product.world_from_scene };
            let size =
                product.mesh.transformed(&in_place).bounds().size() * self.config.capture.unit_m as f32;
            Ok(json!({
                "vertices": product.mesh.positions.len(),
                "triangles": product.mesh.triangles.len(),
                "closed": product.mesh.is_closed(),
                "texture_px": product.pictures.as_ref().map_or(0, |p| p.color.width),
                "size_m": size.to_array(),
                "surface_triangles": surface_triangles,
                "handles": handles(&report.handles, mm),
                "report": report,
                "steps": steps,
            }))
        })(dir)?)
    }

    /// Settings of the stage.
    pub fn mesh_config(&self) -> &MeshConfig {
        &self.config.mesh
    }

    /// How meshes of this line are exported.
    pub fn export(&self) -> export::Export {
        export::Export {
            name: self.capture.name.clone(),
            up: self.capture.up,
            unit_m: self.config.capture.unit_m,
            frame: self.config.mesh.frame,
            cameras: self.capture.views.iter().map(|v| v.camera.position).collect(),
        }
    }

    /// What the stage `mesh` made for people.
    pub fn read_product(&self) -> Result<Product> {
        Product::load(&self.run.path("mesh/parts"))
    }

    /// The whole surface of the stage `mesh` in scene coordinates, as it was before it became a file.
    pub(super) fn read_whole(&self) -> Result<Whole> {
        Whole::load(&self.run.path("mesh/parts"))
    }

    /// The whole surface of the stage `mesh`, in the dataset's world.
    pub fn read_mesh(&self) -> Result<Mesh> {
        let path = self.run.path("mesh/surface.ply");
        let bytes = io::read_bytes(&path, &Limits::default())?;
        mesh::files::read(&bytes, &path).map_err(|e: ReadMeshError| {
            let hint = e.hint();
            Error::cannot(e, hint)
        })
    }
}

/// What became of handles, in millimetres around.
fn handles(report: &HandleReport, mm: f64) -> Value {
    let each = |lengths: &[f32]| lengths.iter().map(|&l| f64::from(l) * mm).collect::<Vec<_>>();
    json!({
        "cut_mm": each(&report.cut),
        "filled_mm": each(&report.filled),
        "left": report.left,
        "left_mm": report.left_length.map(|l| f64::from(l) * mm),
    })
}

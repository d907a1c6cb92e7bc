//! Stage `mesh`: the zero level set of the learned distance, closed, in the dataset's world.

use super::{Fields, Line, PipelineError, export, mesh_bytes};
use crate::capture::{self, Split};
use crate::config::MeshFormat;
use crate::geom::{Camera, Mesh};
use crate::io::{self, Limits};
use crate::mesh::read::ReadMeshError;
use crate::mesh::{self, MeshError};
use crate::run::{Done, Failure};
use glam::Vec3;
use serde_json::json;

impl Line<'_> {
    /// Stage `mesh`: the surface in the dataset's world, `head.ply` always, other formats as asked.
    /// `fields` are only asked if there is something to do.
    pub fn mesh(&self, fields: &dyn Fields) -> Result<Done, PipelineError> {
        Ok(self.run.stage(self.plan("mesh"), |stage| {
            let scene = self.scene_or_fail()?;
            let field = fields.surface()?;
            let c = &self.config.mesh;
            let config = mesh::MeshConfig {
                resolution: c.resolution as usize,
                coarse_step: c.coarse_step as usize,
                keep_share: c.keep_share,
                newton_steps: c.newton_steps as usize,
                relax: c.relax,
                verify: c.verify,
                ..mesh::MeshConfig::default()
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
            let (mesh, report) = extracted.map_err(|e| match e {
                MeshError::Stopped => Failure::stopped(self.run.stop()),
                e => {
                    let hint = e.hint().unwrap_or_default();
                    Failure::cannot(e, hint)
                }
            })?;
            report.warnings().iter().for_each(|w| stage.warn(w));
            let mesh = mesh.transformed(&scene.scene_from_world.inverse());
            let export = self.export();
            // the form that the next stages read comes last
            let formats = c.format.iter().filter(|f| **f != MeshFormat::Ply).chain([&MeshFormat::Ply]);
            for &format in formats {
                let bytes = mesh_bytes(&mesh, format, &export)?;
                io::write_atomic(&stage.folder().join(format!("head.{}", export::ending(format))), &bytes)?;
            }
            let size = mesh.bounds().size() * self.config.capture.unit_m as f32;
            Ok(json!({
                "vertices": mesh.positions.len(),
                "triangles": mesh.triangles.len(),
                "closed": mesh.is_closed(),
                "size_m": size.to_array(),
                "report": report,
            }))
        })?)
    }

    /// How meshes of this line are exported.
    pub fn export(&self) -> export::Export {
        export::Export {
            name: self.capture.name.clone(),
            up: self.capture.up,
            unit_m: self.config.capture.unit_m,
            frame: self.config.mesh.frame,
            cameras: self.capture.views.iter().map(|v| v.camera.position.as_vec3()).collect(),
        }
    }

    /// The mesh of the stage `mesh`, in the dataset's world.
    pub fn read_mesh(&self) -> Result<Mesh, Failure> {
        let path = self.run.path("mesh/head.ply");
        let bytes = io::read_bytes(&path, &Limits::default())?;
        mesh::read::read(&bytes, &path).map_err(|e: ReadMeshError| {
            let hint = e.hint();
            Failure::cannot(e, hint)
        })
    }
}

//! The mesh as files: in the dataset's world, or turned so that the face looks at the viewer.

use crate::config::{MeshFormat, MeshFrame};
use crate::geom::{Mesh, Similarity};
use crate::mesh::export::{ExportError, ExportOptions};
use crate::mesh::{gltf, obj, ply};
use crate::run::Failure;
use glam::{DMat3, DVec3, Vec3};

/// How a mesh of the dataset's world is exported.
#[derive(Clone, Debug)]
pub struct Export {
    /// What viewers call it.
    pub name: String,
    /// Up in the world.
    pub up: Vec3,
    /// Metres per dataset unit.
    pub unit_m: f64,
    /// Whose coordinates.
    pub frame: MeshFrame,
    /// Where the cameras stood, world: faces look at cameras.
    pub cameras: Vec<Vec3>,
}

/// The ending of a format's files.
pub(super) fn ending(format: MeshFormat) -> &'static str {
    match format {
        MeshFormat::Glb => "glb",
        MeshFormat::Obj => "obj",
        MeshFormat::Ply => "ply",
    }
}

/// A mesh of the dataset's world as the bytes of a file. PLY keeps the dataset's world whatever the
/// frame: it is what the later stages read.
pub fn mesh_bytes(mesh: &Mesh, format: MeshFormat, export: &Export) -> Result<Vec<u8>, Failure> {
    let options =
        ExportOptions { name: export.name.clone(), up: export.up, unit_m: export.unit_m, unlit: true };
    let bytes = match (format, export.frame) {
        (MeshFormat::Ply, _) => ply::to_ply(mesh),
        (format, frame) => {
            let (mesh, options) = match frame {
                MeshFrame::Dataset => (mesh.clone(), options),
                MeshFrame::Head => {
                    let turned = mesh.transformed(&head_from_world(mesh, export));
                    (turned, ExportOptions { up: Vec3::Y, ..options })
                }
            };
            if format == MeshFormat::Glb {
                gltf::to_glb(&mesh, &options)
            } else {
                obj::to_obj(&mesh, &options)
            }
        }
    };
    bytes.map_err(|e: ExportError| {
        let hint = e.hint();
        Failure::cannot(e, hint)
    })
}

/// +Y up through the crown, the face towards +Z, the origin at the middle of the box. Where the face
/// looks is taken to be where most cameras stand.
fn head_from_world(mesh: &Mesh, export: &Export) -> Similarity {
    let up = export.up.as_dvec3().normalize_or(DVec3::Y);
    let centre = mesh.bounds().center().as_dvec3();
    let towards: DVec3 = export
        .cameras
        .iter()
        .map(|c| (c.as_dvec3() - centre).reject_from_normalized(up).normalize_or_zero())
        .sum();
    // cameras all around say nothing: any direction across `up` will do
    let front = if towards.length() > 1e-3 { towards.normalize() } else { up.any_orthonormal_vector() };
    let world_from_head = DMat3::from_cols(up.cross(front), up, front);
    let rotation = world_from_head.transpose();
    let turned = Similarity { scale: 1.0, rotation, translation: DVec3::ZERO };
    let middle = mesh.transformed(&turned).bounds().center().as_dvec3();
    Similarity { translation: -middle, ..turned }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn in_the_head_frame_the_face_looks_along_z_and_the_crown_is_up() {
        // Z-up world, cameras at −Y: the corner of the box nearest to the cameras, at the top
        let corners: Vec<Vec3> = (0..8)
            .map(|i| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32 * 2.0, (i >> 2) as f32 * 3.0))
            .collect();
        let mesh = Mesh { positions: corners.clone(), ..Mesh::default() };
        let export = Export {
            name: "x".into(),
            up: Vec3::Z,
            unit_m: 1.0,
            frame: MeshFrame::Head,
            cameras: vec![Vec3::new(0.5, -9.0, 4.0)],
        };
        let head_from_world = head_from_world(&mesh, &export);
        // (0, 0, 3): x = 0.5 left of the middle, y = 1 towards the cameras, z = 1.5 above
        let p = head_from_world.point(Vec3::new(0.0, 0.0, 3.0));
        assert!(p.distance(Vec3::new(-0.5, 1.5, 1.0)) < 1e-5, "{p}");
    }
}

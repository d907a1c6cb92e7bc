//! The coordinates of exported files: the dataset's, or turned so that the face looks at the viewer.

use crate::config::{MeshFormat, MeshFrame};
use crate::geom::{Mesh, Similarity};
use crate::mesh::files::turn_to_y_up;
use glam::{DMat3, DVec3, Mat3, Vec3};

/// How a mesh is exported from the dataset's world.
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
    pub cameras: Vec<DVec3>,
}

/// The ending of a format's files.
pub(super) fn ending(format: MeshFormat) -> &'static str {
    match format {
        MeshFormat::Glb => "glb",
        MeshFormat::Obj => "obj",
        MeshFormat::Ply => "ply",
    }
}

impl Export {
    /// Where the face of a head at `centre` looks, a unit vector of the world across `up`: taken to be where most
    /// cameras stand. `None` where they stand all around.
    pub fn front(&self, centre: DVec3) -> Option<Vec3> {
        let up = self.up.as_dvec3().normalize_or(DVec3::Y);
        let across = |c: &DVec3| (c - centre).reject_from_normalized(up).normalize_or_zero();
        let towards: DVec3 = self.cameras.iter().map(across).sum();
        (towards.length() > 1e-3).then(|| towards.normalize().as_vec3())
    }

    /// The turn that brings up to +Y and the face of a head at `centre` towards +Z.
    fn head_from_world(&self, centre: DVec3) -> DMat3 {
        let up = self.up.as_dvec3().normalize_or(DVec3::Y);
        // cameras all around say nothing: any direction across `up` will do
        let front = self.front(centre).map_or_else(|| up.any_orthonormal_vector(), |f| f.as_dvec3());
        let front = front.reject_from_normalized(up).normalize_or(up.any_orthonormal_vector());
        DMat3::from_cols(up.cross(front), up, front).transpose()
    }

    /// +Y up through the crown, the face towards +Z, the origin at the middle of the box.
    pub(super) fn head_from_mesh(&self, mesh: &Mesh, world_from_mesh: &Similarity) -> Similarity {
        let rotation = self.head_from_world(centre(mesh, world_from_mesh));
        let turned = Similarity { rotation, ..Similarity::IDENTITY }.after(world_from_mesh);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for p in &mesh.positions {
            let q = turned.point_f64(p.as_dvec3());
            (low, high) = (low.min(q), high.max(q));
        }
        Similarity { translation: turned.translation - 0.5 * (low + high), ..turned }
    }

    /// The turn from the dataset's world to the coordinates of GLB and OBJ files.
    pub(super) fn asset_from_world(&self, mesh: &Mesh, world_from_mesh: &Similarity) -> Mat3 {
        match self.frame {
            MeshFrame::Dataset => turn_to_y_up(self.up).unwrap_or(DMat3::IDENTITY).as_mat3(),
            MeshFrame::Head => self.head_from_world(centre(mesh, world_from_mesh)).as_mat3(),
        }
    }
}

/// The middle of a mesh's box, in the world.
pub(super) fn centre(mesh: &Mesh, world_from_mesh: &Similarity) -> DVec3 {
    world_from_mesh.point_f64(mesh.bounds().center().as_dvec3())
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
            cameras: vec![DVec3::new(0.5, -9.0, 4.0)],
        };
        let head_from_world = export.head_from_mesh(&mesh, &Similarity::IDENTITY);
        // (0, 0, 3): x = 0.5 left of the middle, y = 1 towards the cameras, z = 1.5 above
        let p = head_from_world.point(Vec3::new(0.0, 0.0, 3.0));
        assert!(p.distance(Vec3::new(-0.5, 1.5, 1.0)) < 1e-5, "{p}");
    }
}

//! The coordinate frames of a head mesh: those of the dataset, or turned so that the face looks at
//! the viewer.

use glam::{DVec3, Vec3};
use tiface_base::geom::{Mesh, Similarity};

/// The coordinates that a file is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshFrame {
    /// The dataset's own world, turned to +Y up where the format demands it.
    Dataset,
    /// +Y up through the crown, face towards +Z, origin at the center of the box.
    Head,
}

/// The frames of a head mesh.
pub(super) struct Frames {
    /// From the scene to the dataset's world.
    pub world_from_scene: Similarity,
    /// From the scene to the coordinates of GLB, OBJ and USDZ files: meters, +Y up.
    pub file_from_scene: Similarity,
}

impl Frames {
    /// Returns the transform from the dataset's world to the coordinates of GLB, OBJ and USDZ
    /// files.
    pub fn file_from_world(&self) -> Similarity {
        self.file_from_scene.after(&self.world_from_scene.inverse())
    }
}

/// Returns the direction in which the face of a head at `center` looks, as a unit vector of the
/// world perpendicular to `up`: the direction in which most `cameras` stand. `None` if they stand
/// all around.
pub(super) fn front(up: Vec3, cameras: &[DVec3], center: DVec3) -> Option<Vec3> {
    let up = up.as_dvec3().normalize_or(DVec3::Y);
    let across = |c: &DVec3| (c - center).reject_from_normalized(up).normalize_or_zero();
    let towards: DVec3 = cameras.iter().map(across).sum();
    (towards.length() > 1e-3).then(|| towards.normalize().as_vec3())
}

/// Returns the center of a mesh's box, in the world.
pub(super) fn center(mesh: &Mesh, world_from_mesh: &Similarity) -> DVec3 {
    world_from_mesh.point_f64(mesh.bounds().center().as_dvec3())
}

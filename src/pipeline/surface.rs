//! What the later stages need of a learned field, and of anything else that can stand in for it.

use crate::Result;
use crate::config::Stage;
use crate::geom::{Camera, Ray, RayResult, Similarity};
use crate::mesh::{Cap, Patches};
use crate::render::RenderedView;
use glam::Vec3;

/// A colored signed distance in scene coordinates.
pub trait Surface: Sync {
    /// Signed distance, negative inside. `[n, 3]` → `[n]`.
    fn sdf(&self, points: &[Vec3]) -> Vec<f32>;

    /// Signed distance and its gradient. `[n, 3]` → `[n]`, `[n, 3]`.
    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>);

    /// Local sharpness, per scene unit: the opacity at a distance `f` outside the surface is σ(−f · sharpness).
    /// `[n, 3]` → `[n]`.
    fn sharpness(&self, points: &[Vec3]) -> Vec<f32>;

    /// sRGB-coded color of surface points `[n, 3]` with unit normals `[n, 3]`, point `i` seen along `counts[i]` unit
    /// directions, away from the camera, all in one list: one color a direction.
    fn colors(&self, points: &[Vec3], normals: &[Vec3], counts: &[u32], directions: &[Vec3])
    -> Vec<[f32; 3]>;

    /// The same, every point seen along one direction.
    fn color(&self, points: &[Vec3], normals: &[Vec3], directions: &[Vec3]) -> Vec<[f32; 3]> {
        self.colors(points, normals, &vec![1; points.len()], directions)
    }

    /// The view of a camera in scene coordinates by marching through the field itself; depth and
    /// normals in the world. `None` for what is only a surface.
    fn volume(&self, camera: &Camera, world_from_scene: &Similarity) -> Option<RenderedView>;

    /// What a person should know of its answers so far: a GPU that failed.
    fn warning(&self) -> Option<&str> {
        None
    }
}

/// A surface with what closes it where the field's own zero does not.
pub(super) struct ClosedSurface<'a> {
    pub field: &'a dyn Surface,
    /// Where the frames cut the body.
    pub cap: Option<&'a Cap>,
    /// Where handles were cut.
    pub patches: Option<&'a Patches>,
}

impl ClosedSurface<'_> {
    /// As [`Surface::sdf_gradient`]: on an open surface the field's own zero ends at the opening, which the closed
    /// one holds as well.
    pub fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        let (mut values, mut gradients) = self.field.sdf_gradient(points);
        if let Some(cap) = self.cap {
            cap.close(points, &mut values, &mut gradients);
        }
        if let Some(patches) = self.patches {
            patches.close(points, &mut values, &mut gradients);
        }
        (values, gradients)
    }

    /// As [`Surface::colors`], the cap in its own color.
    pub fn colors(
        &self,
        points: &[Vec3],
        normals: &[Vec3],
        counts: &[u32],
        directions: &[Vec3],
    ) -> Vec<[f32; 3]> {
        let mut colors = self.field.colors(points, normals, counts, directions);
        if let Some(cap) = self.cap {
            let mut rest = &mut colors[..];
            for (p, &count) in points.iter().zip(counts) {
                let (own, after) = rest.split_at_mut(count as usize);
                rest = after;
                if cap.holds(*p) {
                    own.fill(cap.color(*p));
                }
            }
        }
        colors
    }
}

/// A field that is looked at by marching rays through it.
pub trait Radiance: Sync {
    /// What rays in scene coordinates see, of a camera that looks along the unit vector `forward`; normals
    /// are not asked for. `[n]` → `[n]`.
    fn see(&self, rays: &[Ray], forward: Vec3) -> Vec<RayResult>;
}

/// The trained fields, each loaded when it is first asked for.
pub trait Fields {
    /// I-Face.
    fn surface(&self) -> Result<&dyn Surface>;

    /// The field of the stage `baseline` or `tface`.
    fn radiance(&self, stage: Stage) -> Result<&dyn Radiance>;

    /// What a person should know of their answers so far.
    fn warnings(&self) -> Vec<&str> {
        Vec::new()
    }
}

impl Surface for crate::iface::IFace {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        self.sdf(points)
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        self.sdf_gradient(points)
    }

    fn sharpness(&self, points: &[Vec3]) -> Vec<f32> {
        self.sharpness(points)
    }

    fn colors(
        &self,
        points: &[Vec3],
        normals: &[Vec3],
        counts: &[u32],
        directions: &[Vec3],
    ) -> Vec<[f32; 3]> {
        self.colors(points, normals, counts, directions)
    }

    fn volume(&self, camera: &Camera, world_from_scene: &Similarity) -> Option<RenderedView> {
        Some(super::march::march(camera, world_from_scene, true, |rays| self.render(rays)))
    }

    #[cfg(feature = "wgpu")]
    fn warning(&self) -> Option<&str> {
        self.gpu_failure()
    }
}

impl Surface for crate::iface::DensityField {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        self.sdf(points)
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        self.sdf_gradient(points)
    }

    /// None that is known.
    fn sharpness(&self, points: &[Vec3]) -> Vec<f32> {
        vec![f32::INFINITY; points.len()]
    }

    fn colors(&self, points: &[Vec3], _: &[Vec3], counts: &[u32], directions: &[Vec3]) -> Vec<[f32; 3]> {
        self.colors(points, counts, directions)
    }

    fn volume(&self, camera: &Camera, world_from_scene: &Similarity) -> Option<RenderedView> {
        Some(super::march::march(camera, world_from_scene, false, |rays| self.render(rays)))
    }
}

impl Radiance for crate::tface::FieldMean {
    fn see(&self, rays: &[Ray], forward: Vec3) -> Vec<RayResult> {
        self.render(rays, forward)
    }
}

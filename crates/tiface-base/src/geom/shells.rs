//! Translucent layers around a mesh, for parts that are softer than a surface, such as the outline
//! of hair.

use super::bvh::Bvh;
use super::mesh::Mesh;
use super::ray::{Hit, Ray};
use glam::Vec3;

/// Layers around a mesh with normals, the innermost first: they are drawn in this order, after what
/// is opaque. Both sides of them are drawn, so that a ray along the outline meets each layer twice,
/// and one that the mesh stops once.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shells {
    /// The layers.
    pub layers: Vec<ShellLayer>,
    /// Depth of what is opaque under the layers below each vertex of the mesh, along its normal, in
    /// the mesh's units; empty if it is the mesh itself.
    pub depths: Vec<f32>,
}

impl Shells {
    /// Returns what is opaque under the layers, and the layers around that.
    ///
    /// # Panics
    ///
    /// There are depths, and the mesh has no normals, or depths or offsets are not one for each
    /// vertex.
    pub fn on_core(&self, mesh: &Mesh) -> (Mesh, Shells) {
        if self.depths.is_empty() {
            return (mesh.clone(), self.clone());
        }
        let counts =
            self.layers.iter().map(|l| l.offsets.len()).chain([mesh.normals.len(), self.depths.len()]);
        counts.for_each(|count| assert_eq!(count, mesh.positions.len()));
        let moved = |((p, n), depth): ((&Vec3, &Vec3), &f32)| *p - *n * *depth;
        let positions = mesh.positions.iter().zip(&mesh.normals).zip(&self.depths).map(moved).collect();
        let layer = |layer: &ShellLayer| ShellLayer {
            offsets: layer.offsets.iter().zip(&self.depths).map(|(offset, depth)| offset + depth).collect(),
            alphas: layer.alphas.clone(),
        };
        let layers = self.layers.iter().map(layer).collect();
        (Mesh { positions, ..mesh.clone() }, Shells { layers, depths: Vec::new() })
    }
}

/// A layer: triangles of the mesh, those with a vertex that is not transparent, moved along the
/// normals of their vertices. It has the mesh's colors.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ShellLayer {
    /// Offset of each vertex of the mesh along its normal, in the mesh's units.
    pub offsets: Vec<f32>,
    /// Opacity at each vertex of the mesh, 0..=1.
    pub alphas: Vec<f32>,
}

impl ShellLayer {
    /// Returns whether a triangle of these vertices belongs to the layer.
    #[inline]
    pub fn has(&self, triangle: &[u32; 3]) -> bool {
        triangle.iter().any(|&v| self.alphas[v as usize] > 0.0)
    }

    /// Returns the opacity at a point of a triangle of these vertices.
    #[inline]
    pub fn alpha(&self, hit: &Hit, triangle: [u32; 3]) -> f32 {
        hit.mix(triangle.map(|v| self.alphas[v as usize]))
    }

    /// Returns the layer around a mesh with normals, and for each of its triangles the mesh's.
    ///
    /// # Panics
    ///
    /// The layer has not one offset and one alpha for each vertex.
    pub fn surface(&self, mesh: &Mesh) -> (Mesh, Vec<u32>) {
        let moved = |((p, n), offset): ((&Vec3, &Vec3), &f32)| *p + *n * *offset;
        let positions = mesh.positions.iter().zip(&mesh.normals).zip(&self.offsets).map(moved).collect();
        let shown = mesh.triangles.iter().enumerate().filter(|(_, t)| self.has(t));
        let (source, triangles) = shown.map(|(id, t)| (id as u32, *t)).unzip();
        (Mesh { positions, triangles, ..Mesh::default() }, source)
    }
}

/// Layers to be met by rays.
pub struct ShellCaster<'a> {
    mesh: &'a Mesh,
    layers: &'a [ShellLayer],
    /// Over the triangles of all layers, one after the other.
    bvh: Bvh,
    /// Triangle of the mesh that each of these is.
    source: Vec<u32>,
    /// The first of these of each layer.
    first: Vec<u32>,
}

impl<'a> ShellCaster<'a> {
    /// Returns the layers around a mesh with normals, ready for rays.
    ///
    /// # Panics
    ///
    /// A layer has not one offset and one alpha for each vertex.
    pub fn new(mesh: &'a Mesh, shells: &'a Shells) -> ShellCaster<'a> {
        let (mut all, mut source, mut first) = (Mesh::default(), Vec::new(), Vec::new());
        for layer in &shells.layers {
            let (surface, of_mesh) = layer.surface(mesh);
            let base = all.positions.len() as u32;
            first.push(source.len() as u32);
            all.positions.extend(surface.positions);
            all.triangles.extend(surface.triangles.iter().map(|t| t.map(|v| base + v)));
            source.extend(of_mesh);
        }
        ShellCaster { mesh, layers: &shells.layers, bvh: Bvh::new(&all), source, first }
    }

    /// Calls `meet` wherever a ray meets a layer before `end`, from either side, the nearest first:
    /// with the index of the layer, the source position on the mesh, and the opacity. Of layers
    /// that lie within rounding of each other only one counts.
    pub fn cast(&self, ray: &Ray, end: f32, mut meet: impl FnMut(usize, Hit, f32)) {
        let mut from = ray.t_min;
        for hit in self.bvh.all_hits(&Ray { t_max: ray.t_max.min(end), ..*ray }) {
            if hit.t < from {
                continue;
            }
            let layer = self.first.partition_point(|first| *first <= hit.triangle) - 1;
            let triangle = self.source[hit.triangle as usize];
            let alpha = self.layers[layer].alpha(&hit, self.mesh.triangles[triangle as usize]);
            meet(layer, Hit { triangle, ..hit }, alpha);
            // on by some steps of f32
            from = hit.t + 1e-6 * hit.t.max(1e-3);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a square in z = 0 facing +z, vertices 0..4; its last vertex is transparent in both
    /// layers.
    fn square() -> (Mesh, Shells) {
        let at = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
        let mesh = Mesh {
            positions: at.map(|(x, y)| Vec3::new(x, y, 0.0)).to_vec(),
            normals: vec![Vec3::Z; 4],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        };
        let layer = |offset: f32, alpha: f32| ShellLayer {
            offsets: vec![offset; 4],
            alphas: vec![0.0, alpha, 0.0, 0.0],
        };
        (mesh, Shells { layers: vec![layer(0.1, 0.8), layer(0.3, 0.4)], ..Shells::default() })
    }

    fn ray(from: Vec3, to: Vec3) -> Ray {
        Ray::new(from, (to - from).normalize())
    }

    #[test]
    fn a_ray_meets_the_nearest_layer_first_and_none_behind_its_end() {
        let (mesh, shells) = square();
        let caster = ShellCaster::new(&mesh, &shells);
        let met = |ray: &Ray, end: f32| {
            let mut met = Vec::new();
            caster.cast(ray, end, |layer, hit, alpha| met.push((layer, hit.triangle, hit.t, alpha)));
            met
        };
        // half way from vertex 0 to vertex 1 and a quarter up: weights 3/8, 1/2 and 1/8
        let down = ray(Vec3::new(0.25, -0.75, 1.0), Vec3::new(0.25, -0.75, 0.0));
        let all = met(&down, f32::INFINITY);
        assert_eq!(all.iter().map(|m| (m.0, m.1)).collect::<Vec<_>>(), [(1, 0), (0, 0)]);
        assert!((all[0].2 - 0.7).abs() < 1e-6 && (all[1].2 - 0.9).abs() < 1e-6, "{all:?}");
        assert!((all[0].3 - 0.4 * 0.5).abs() < 1e-6 && (all[1].3 - 0.8 * 0.5).abs() < 1e-6, "{all:?}");
        assert_eq!(met(&down, 0.8).len(), 1);
        // the other triangle has no vertex that shows
        assert!(met(&ray(Vec3::new(-0.5, 0.5, 1.0), Vec3::new(-0.5, 0.5, 0.0)), f32::INFINITY).is_empty());
        // from behind the innermost is the nearest
        let up = met(&ray(Vec3::new(0.25, -0.75, -1.0), Vec3::new(0.25, -0.75, 0.0)), f32::INFINITY);
        assert_eq!(up.iter().map(|m| m.0).collect::<Vec<_>>(), [0, 1]);
        assert!((up[0].2 - 1.1).abs() < 1e-6 && (up[1].2 - 1.3).abs() < 1e-6, "{up:?}");
    }

    #[test]
    fn layers_stay_where_they_are_around_a_deeper_mesh() {
        let (mesh, shells) = square();
        assert_eq!(shells.on_core(&mesh), (mesh.clone(), shells.clone()));
        let shells = Shells { depths: vec![0.5, 0.25, 0.0, 0.0], ..shells };
        let (core, around) = shells.on_core(&mesh);
        assert_eq!(core.positions.iter().map(|p| p.z).collect::<Vec<_>>(), [-0.5, -0.25, 0.0, 0.0]);
        assert_eq!((&core.normals, &core.triangles), (&mesh.normals, &mesh.triangles));
        for (layer, before) in around.layers.iter().zip(&shells.layers) {
            let (is, was) = (layer.surface(&core).0.positions, before.surface(&mesh).0.positions);
            assert!(is.iter().zip(&was).all(|(a, b)| a.distance(*b) < 1e-6) && layer.alphas == before.alphas);
        }
    }

    #[test]
    fn a_ray_beside_the_mesh_meets_both_sides_of_a_layer() {
        // an octahedron of radius 1 and a layer of radius 1.5 around it: at x = 1.2 a ray along z
        // meets the layer's surface |x| + |y| + |z| = 1.5 at z = 0.3 and at z = -0.3
        let axes = [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z];
        let mesh = Mesh {
            positions: axes.to_vec(),
            normals: axes.to_vec(),
            triangles: vec![
                [0, 1, 2],
                [1, 3, 2],
                [3, 4, 2],
                [4, 0, 2],
                [1, 0, 5],
                [3, 1, 5],
                [4, 3, 5],
                [0, 4, 5],
            ],
            ..Mesh::default()
        };
        let shells = Shells {
            layers: vec![ShellLayer { offsets: vec![0.5; 6], alphas: vec![0.25; 6] }],
            ..Shells::default()
        };
        let mut met = Vec::new();
        let beside = ray(Vec3::new(1.199, 0.001, 2.0), Vec3::new(1.199, 0.001, 0.0));
        ShellCaster::new(&mesh, &shells)
            .cast(&beside, f32::INFINITY, |_, hit, alpha| met.push((hit.t, alpha)));
        assert_eq!(met.len(), 2, "{met:?}");
        assert!((met[0].0 - 1.7).abs() < 1e-5 && (met[1].0 - 2.3).abs() < 1e-5, "{met:?}");
        assert!(met.iter().all(|m| (m.1 - 0.25).abs() < 1e-6), "{met:?}");
    }
}

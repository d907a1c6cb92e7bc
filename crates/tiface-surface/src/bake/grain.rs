//! Grain of a texture where no photograph shows it: strands, weave, pores.
//!
//! What nobody saw is covered with round patches that overlap. Each takes the difference between
//! texture and smooth color from the nearest place of the same material that is trusted all around,
//! turned as little as brings one tangent plane onto the other: near what it is copied from, hair
//! runs alike. Where patches overlap, their sum is scaled to the contrast of one (after Praun,
//! Finkelstein, Hoppe 2000, "Lapped textures").

use super::cover::Sample;
use super::smooth::{SmoothColors, TRUSTED};
use crate::appearance::Nodes;
use crate::mesh_distance::hit_at;
use glam::{Quat, Vec2, Vec3};
use rayon::prelude::*;
use tiface_base::geom::{Atlas, Bvh, Hit, Mesh, bilinear_taps};
use tiface_base::image::Image;

/// Radius of a patch relative to the longest side: about as wide as a few locks of hair.
const RADIUS: f32 = 0.035;

/// Distance between the middles of patches, and size of the place that a source must be surrounded
/// by, in radii.
const SPACING: f32 = 0.55;
const SURROUNDED: f32 = 0.9;

/// Share of a source's surroundings that must be trusted and of its material.
const PURE: f32 = 0.93;

/// Largest share of a material at which a vertex is of it alone.
const OWN: f32 = 0.7;

/// Distance, in radii, that each use of a source's surroundings adds to it, so that large places do
/// not repeat one patch.
const USED: f32 = 0.3;

/// Shares of a material between which its grain fades in: none where two materials meet.
const FADE: [f32; 2] = [0.5, 0.8];

/// A texture with its smooth colors and the trust in its vertices.
pub struct Grain<'a> {
    pub mesh: &'a Mesh,
    pub atlas: &'a Atlas,
    pub nodes: &'a Nodes,
    /// `[vertices]`, 0..=1.
    pub trust: &'a [f32],
    pub smooth: &'a SmoothColors<'a>,
    /// sRGB-coded, 3 channels.
    pub image: &'a Image,
    /// Points that have no grain.
    pub calm: &'a (dyn Fn(Vec3) -> bool + Sync),
}

/// Vertices near another one over the surface, found again and again.
struct Surroundings {
    /// The search that met each vertex last.
    met: Vec<u32>,
    search: u32,
}

impl Surroundings {
    fn new(vertices: usize) -> Surroundings {
        Surroundings { met: vec![0; vertices], search: 0 }
    }

    /// Returns the vertices within a distance of one that edges within it lead to, itself first.
    fn of(&mut self, mesh: &Mesh, nodes: &Nodes, vertex: u32, distance: f32) -> Vec<u32> {
        self.search += 1;
        let middle = mesh.positions[vertex as usize];
        let mut all = vec![vertex];
        self.met[vertex as usize] = self.search;
        let mut next = 0;
        while let Some(&v) = all.get(next) {
            next += 1;
            for &near in nodes.near(v as usize) {
                let met = std::mem::replace(&mut self.met[near as usize], self.search) == self.search;
                if !met && mesh.positions[near as usize].distance(middle) <= distance {
                    all.push(near);
                }
            }
        }
        all
    }
}

impl Grain<'_> {
    /// Returns the grain of samples, sRGB-coded differences; 0 where there is no trusted place of
    /// their material.
    pub fn of(&self, samples: &[Sample]) -> Vec<[f32; 3]> {
        let radius = RADIUS * self.mesh.bounds().size().max_element();
        let materials = self.smooth.of_vertices();
        let patches = self.patches(radius, &materials);
        let bvh = Bvh::new(self.mesh);
        // samples by the first corner of their triangle
        let first = |s: u32| self.mesh.triangles[samples[s as usize].triangle as usize][0];
        let mut by_vertex: Vec<u32> = (0..samples.len() as u32).collect();
        by_vertex.sort_by_key(|&s| first(s));
        let of_vertex = |v: u32| {
            let start = by_vertex.partition_point(|&s| first(s) < v);
            by_vertex[start..].iter().copied().take_while(move |&s| first(s) == v)
        };
        let mut sums = vec![[0f32; 3]; samples.len()];
        let mut squares = vec![0f32; samples.len()];
        // some at a time: a patch holds a few thousand values
        for some in patches.chunks(256) {
            let fresh = || Surroundings::new(self.mesh.positions.len());
            let one = |near: &mut Surroundings, &(middle, source): &(u32, u32)| {
                let vertices = near.of(self.mesh, self.nodes, middle, 1.2 * radius);
                let own = vertices.into_iter().flat_map(&of_vertex);
                let patch = Patch::new(self.mesh, middle, source, radius);
                own.filter_map(|s| Some((s, self.copied(&bvh, &patch, &samples[s as usize])?)))
                    .collect::<Vec<_>>()
            };
            let made: Vec<Vec<(u32, Copied)>> = some.par_iter().map_init(fresh, one).collect();
            for (s, copied) in made.into_iter().flatten() {
                squares[s as usize] += copied.weight.powi(2);
                (0..3).for_each(|k| sums[s as usize][k] += copied.weight * copied.difference[k]);
            }
        }
        let scaled = |((sample, sum), square): ((&Sample, [f32; 3]), f32)| {
            let (_, share) = self.smooth.material_at(&sample.hit());
            let fade = ((share - FADE[0]) / (FADE[1] - FADE[0])).clamp(0.0, 1.0);
            sum.map(|v| if square > 0.0 { fade * v / square.sqrt() } else { 0.0 })
        };
        samples.iter().zip(sums).zip(squares).map(scaled).collect()
    }

    /// Returns the middles of patches that cover what is not trusted, each with its source.
    fn patches(&self, radius: f32, materials: &[(usize, f32)]) -> Vec<(u32, u32)> {
        let Grain { mesh, nodes, trust, .. } = *self;
        let vertices = mesh.positions.len() as u32;
        let alone = |v: u32| trust[v as usize] > TRUSTED && materials[v as usize].1 > OWN;
        let is_source = |near: &mut Surroundings, v: u32| {
            let around = near.of(mesh, nodes, v, SURROUNDED * radius);
            let alike = |n: &&u32| {
                materials[**n as usize].0 == materials[v as usize].0 && trust[**n as usize] > TRUSTED
            };
            let count = around.iter().filter(alike).count();
            (count as f32 >= PURE * around.len() as f32).then_some(v)
        };
        let candidates: Vec<u32> = (0..vertices).filter(|&v| alone(v)).collect();
        let fresh = || Surroundings::new(mesh.positions.len());
        let sources: Vec<u32> =
            candidates.par_iter().map_init(fresh, |near, &v| is_source(near, v)).flatten().collect();
        let mut near = fresh();
        let (mut covered, mut used) = (vec![false; trust.len()], vec![0f32; trust.len()]);
        let mut patches = Vec::new();
        for v in (0..vertices).filter(|&v| trust[v as usize] < 1.0) {
            let place = mesh.positions[v as usize];
            if covered[v as usize] || (self.calm)(place) {
                continue;
            }
            let around = near.of(mesh, nodes, v, SPACING * radius);
            around.into_iter().for_each(|n| covered[n as usize] = true);
            let of_material = sources.iter().filter(|&&s| materials[s as usize].0 == materials[v as usize].0);
            let cost = |s: u32| place.distance(mesh.positions[s as usize]) + used[s as usize] * USED * radius;
            let best = of_material.map(|&s| (cost(s), s)).min_by(|a, b| a.0.total_cmp(&b.0));
            let Some((_, source)) = best else { continue };
            near.of(mesh, nodes, source, SURROUNDED * radius)
                .into_iter()
                .for_each(|n| used[n as usize] += 1.0);
            patches.push((v, source));
        }
        patches
    }

    /// Returns the grain of a sample as a patch copies it, if the patch reaches it.
    fn copied(&self, bvh: &Bvh, patch: &Patch, sample: &Sample) -> Option<Copied> {
        let hit = sample.hit();
        let (p, normal) = (self.mesh.point_at(&hit), self.mesh.shading_normal(&hit));
        let at = (p - patch.middle).length_squared() / patch.radius.powi(2);
        let weight = (1.0 - at).max(0.0).powi(2) * normal.dot(patch.normal).max(0.0);
        if weight <= 0.0 || (self.calm)(p) {
            return None;
        }
        let found = bvh.closest_point(patch.source + patch.turn * (p - patch.middle))?;
        let source = hit_at(self.mesh, found.triangle, found.point);
        let trust = source.mix(self.mesh.triangles[source.triangle as usize].map(|v| self.trust[v as usize]));
        let (shown, smooth) = (self.shown(&source), self.smooth.at(&source));
        Some(Copied { weight, difference: std::array::from_fn(|k| trust * (shown[k] - smooth[k])) })
    }

    /// Returns the texture at a point.
    fn shown(&self, hit: &Hit) -> [f32; 3] {
        let Atlas { uvs, triangles, width, height } = self.atlas;
        let uv = hit.mix(triangles[hit.triangle as usize].map(|i| uvs[i as usize]));
        let at = uv * Vec2::new(*width as f32, *height as f32) - 0.5;
        let taps = bilinear_taps(at, [*width, *height]);
        std::array::from_fn(|k| {
            taps.iter().map(|(texel, w)| w * self.image.data[3 * *texel as usize + k]).sum()
        })
    }
}

/// A round place that takes its grain from another one.
struct Patch {
    middle: Vec3,
    normal: Vec3,
    source: Vec3,
    /// Turns the normal at the middle to that at the source.
    turn: Quat,
    radius: f32,
}

impl Patch {
    fn new(mesh: &Mesh, middle: u32, source: u32, radius: f32) -> Patch {
        let [(middle, normal), (source, other)] =
            [middle, source].map(|v| (mesh.positions[v as usize], mesh.normals[v as usize]));
        Patch { middle, normal, source, turn: Quat::from_rotation_arc(normal, other), radius }
    }
}

/// Grain that a patch gives a sample, and how much of it.
struct Copied {
    weight: f32,
    difference: [f32; 3],
}

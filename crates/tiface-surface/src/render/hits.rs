//! Points of a mesh that rays met, on their way to colors of pixels.

use glam::Vec3;
use std::ops::Range;
use tiface_base::geom::Hit;

/// The hits of rays, for the color function. All `[n]`.
#[derive(Clone, Debug, Default)]
pub struct RayHits {
    /// Points, in the mesh's coordinates.
    pub points: Vec<Vec3>,
    /// Unit normals: the vertices' interpolated, or the triangle's own if the mesh has none.
    pub normals: Vec<Vec3>,
    /// Unit directions, away from the camera.
    pub directions: Vec<Vec3>,
    /// Triangle, weights of its corners and distance.
    pub hits: Vec<Hit>,
    /// The pixel of each hit, and the hit's weight in it.
    pub(super) pixels: Vec<(usize, f32)>,
}

impl RayHits {
    /// Returns the range of each ray's hits, which follow each other.
    pub(super) fn rays(&self) -> impl Iterator<Item = Range<usize>> {
        let mut end = 0;
        let of_one_ray = |a: usize, b: usize| {
            self.pixels[a].0 == self.pixels[b].0 && self.directions[a] == self.directions[b]
        };
        std::iter::from_fn(move || {
            let begin = end;
            end += 1;
            while end < self.pixels.len() && of_one_ray(begin, end) {
                end += 1;
            }
            (begin < self.pixels.len()).then_some(begin..end)
        })
    }

    /// Adds the colors of all hits to their pixels, and forgets the hits.
    pub(super) fn shade(&mut self, rgba: &mut [[f32; 4]], color: &impl Fn(&RayHits) -> Vec<[f32; 3]>) {
        self.shade_each(&mut [rgba], &|hits: &RayHits| vec![color(hits)]);
    }

    /// The same for several pictures of the same pixels; `colors` returns a list for each.
    pub(super) fn shade_each(
        &mut self,
        pictures: &mut [&mut [[f32; 4]]],
        colors: &impl Fn(&RayHits) -> Vec<Vec<[f32; 3]>>,
    ) {
        if self.pixels.is_empty() {
            return;
        }
        for (rgba, colors) in pictures.iter_mut().zip(colors(self)) {
            for (k, &(pixel, share)) in self.pixels.iter().enumerate() {
                let c = colors.get(k).unwrap_or(&[0.0; 3]).map(|c| c.clamp(0.0, 1.0));
                let p = &mut rgba[pixel];
                *p = [p[0] + share * c[0], p[1] + share * c[1], p[2] + share * c[2], p[3] + share];
            }
        }
        self.pixels.clear();
        self.points.clear();
        self.normals.clear();
        self.directions.clear();
        self.hits.clear();
    }
}

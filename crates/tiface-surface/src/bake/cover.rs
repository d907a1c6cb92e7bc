//! Which texels a triangle covers, and where on the triangle their samples lie.
//!
//! Every texel is sampled at `side × side` regularly spaced points. A texel that a triangle touches
//! without meeting any point still belongs to it (conservative rasterization): its one sample is
//! the triangle's point nearest to the texel's center. Triangles thinner than a texel are never
//! lost.

use glam::Vec2;
use std::ops::Range;
use tiface_base::geom::{Atlas, Hit};

/// Maximum numbers of rows and of samples in a band; a band has at least one row.
const ROWS: u32 = 32;
const SAMPLES: u32 = 1 << 17;

/// One sample of a texel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Row-major index of the texel.
    pub texel: u32,
    /// Index into `Mesh::triangles`.
    pub triangle: u32,
    /// Weights of the triangle's second and third vertex.
    pub u: f32,
    /// Weight of the third vertex.
    pub v: f32,
}

impl Sample {
    /// Returns the point of the triangle.
    pub fn hit(&self) -> Hit {
        Hit { t: 0.0, triangle: self.triangle, u: self.u, v: self.v }
    }
}

/// Triangles sorted into bands of rows, so that a picture is covered piece by piece in bounded
/// memory.
pub struct Bands {
    rows: u32,
    /// Triangles that touch a band.
    triangles: Vec<Vec<u32>>,
}

impl Bands {
    /// Sorts the triangles of an atlas into bands; each texel has `side` samples each way.
    pub fn new(atlas: &Atlas, side: u32) -> Bands {
        Bands::of_rows(atlas, (SAMPLES / (atlas.width * side * side).max(1)).clamp(1, ROWS))
    }

    fn of_rows(atlas: &Atlas, rows: u32) -> Bands {
        let count = atlas.height.div_ceil(rows);
        let mut triangles = vec![Vec::new(); count as usize];
        for t in 0..atlas.triangles.len() as u32 {
            let touched = texels(atlas.corners(t).map(|c| c.y), atlas.height);
            if !touched.is_empty() {
                (touched.start / rows..=(touched.end - 1) / rows).for_each(|b| triangles[b as usize].push(t));
            }
        }
        Bands { rows, triangles }
    }

    /// Returns the number of bands.
    pub fn len(&self) -> usize {
        self.triangles.len()
    }

    /// Returns the samples of one band, sorted by texel; `side` points along each side of a texel.
    ///
    /// A point that two triangles share (on a common edge) counts for both; a texel has a
    /// nearest-point sample only where no regular point of it lies in any triangle.
    pub fn samples(&self, atlas: &Atlas, band: usize, side: u32) -> Vec<Sample> {
        let first = band as u32 * self.rows;
        let rows = first..(first + self.rows).min(atlas.height);
        let mut regular = Vec::new();
        let mut touching = Vec::new();
        for &t in &self.triangles[band] {
            cover(atlas, t, rows.clone(), side, &mut regular, &mut touching);
        }
        // stable: samples of a texel stay in the order of their triangles
        regular.sort_by_key(|s: &Sample| s.texel);
        touching.sort_by(|a: &(f32, Sample), b| a.1.texel.cmp(&b.1.texel).then(a.0.total_cmp(&b.0)));
        let mut covered = regular.iter().map(|s| s.texel).peekable();
        let mut lone = Vec::new();
        for group in touching.chunk_by(|a, b| a.1.texel == b.1.texel) {
            let texel = group[0].1.texel;
            while covered.peek().is_some_and(|&c| c < texel) {
                covered.next();
            }
            if covered.peek() != Some(&texel) {
                lone.push(group[0].1);
            }
        }
        regular.extend(lone);
        regular.sort_by_key(|s| s.texel);
        regular
    }
}

/// Texels along one axis that an interval of texel coordinates touches.
fn texels(values: [f32; 3], size: u32) -> Range<u32> {
    if values.iter().any(|v| !v.is_finite()) {
        return 0..0;
    }
    let low = values[0].min(values[1]).min(values[2]).floor().clamp(0.0, size as f32) as u32;
    let high = values[0].max(values[1]).max(values[2]).ceil().clamp(0.0, size as f32) as u32;
    // a triangle that is flat along this axis, on a border between texels, still has one
    low.min(size.saturating_sub(1))..high.max(low.min(size.saturating_sub(1)) + 1).min(size)
}

/// Samples of triangle `t` in the texels of `rows`: points inside it, and its touched texels.
fn cover(
    atlas: &Atlas,
    t: u32,
    rows: Range<u32>,
    side: u32,
    regular: &mut Vec<Sample>,
    touching: &mut Vec<(f32, Sample)>,
) {
    let corners = atlas.corners(t);
    let [a, b, c] = corners.map(|p| p.as_dvec2());
    let area = (b - a).perp_dot(c - a);
    let (xs, ys) = (texels(corners.map(|p| p.x), atlas.width), texels(corners.map(|p| p.y), atlas.height));
    for y in ys.start.max(rows.start)..ys.end.min(rows.end) {
        for x in xs.clone() {
            let texel = y * atlas.width + x;
            let mut met = false;
            for k in 0..side * side {
                let offset = |i: u32| (f64::from(i) + 0.5) / f64::from(side);
                let p = glam::DVec2::new(f64::from(x) + offset(k % side), f64::from(y) + offset(k / side));
                let u = (p - a).perp_dot(c - a) / area;
                let v = (b - a).perp_dot(p - a) / area;
                // false for the NaN of a triangle without area
                if u >= 0.0 && v >= 0.0 && u + v <= 1.0 {
                    met = true;
                    regular.push(Sample { texel, triangle: t, u: u as f32, v: v as f32 });
                }
            }
            if !met {
                let center = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let (u, v) = nearest(corners, center);
                let at = corners[0] + u * (corners[1] - corners[0]) + v * (corners[2] - corners[0]);
                let off = (at - center).abs().max_element();
                // the nearest point by distance may lie just outside a touched texel: half a texel
                // of grace would color texels that nothing touches, so only those within the square
                // count
                if off <= 0.5 {
                    touching.push((off, Sample { texel, triangle: t, u, v }));
                }
            }
        }
    }
}

/// Weights of the second and third corner at the point of a triangle nearest to `p`.
fn nearest([a, b, c]: [Vec2; 3], p: Vec2) -> (f32, f32) {
    let along = |from: Vec2, to: Vec2| {
        let edge = to - from;
        let length = edge.length_squared();
        if length > 0.0 { ((p - from).dot(edge) / length).clamp(0.0, 1.0) } else { 0.0 }
    };
    let (s, t, r) = (along(a, b), along(a, c), along(b, c));
    let candidates = [(s, 0.0), (0.0, t), (1.0 - r, r)];
    let area = (b - a).perp_dot(c - a);
    let (u, v) = ((p - a).perp_dot(c - a) / area, (b - a).perp_dot(p - a) / area);
    if u >= 0.0 && v >= 0.0 && u + v <= 1.0 {
        return (u, v);
    }
    let distance = |&(u, v): &(f32, f32)| (a + u * (b - a) + v * (c - a)).distance_squared(p);
    candidates.into_iter().min_by(|x, y| distance(x).total_cmp(&distance(y))).unwrap_or((0.0, 0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(corners: [Vec2; 3], width: u32, height: u32) -> Atlas {
        let size = Vec2::new(width as f32, height as f32);
        Atlas { uvs: corners.map(|c| c / size).to_vec(), triangles: vec![[0, 1, 2]], width, height }
    }

    #[test]
    fn a_square_of_two_triangles_covers_each_point_of_its_texels_once() {
        // two halves of the square [1, 3]²; sample points never lie on the diagonal with side 2
        let uvs = [(1.0, 1.0), (3.0, 1.0), (3.0, 3.0), (1.0, 3.0)].map(|(x, y)| Vec2::new(x, y) / 4.0);
        let triangles = vec![[0, 1, 2], [0, 2, 3]];
        let atlas = Atlas { uvs: uvs.to_vec(), triangles, width: 4, height: 4 };
        let bands = Bands::of_rows(&atlas, 2);
        assert_eq!(bands.len(), 2);
        let all: Vec<Sample> = (0..2).flat_map(|b| bands.samples(&atlas, b, 4)).collect();
        for texel in 0..16u32 {
            let (x, y) = (texel % 4, texel / 4);
            let inside = (1..3).contains(&x) && (1..3).contains(&y);
            let n = all.iter().filter(|s| s.texel == texel).count();
            // points on the diagonal count for both: 4 more in the two texels it runs through
            let expected = if inside { if x == y { 20 } else { 16 } } else { 0 };
            assert_eq!(n, expected, "texel {x}, {y}");
        }
    }

    #[test]
    fn samples_lie_where_their_weights_say() {
        let corners = [Vec2::new(0.5, 0.5), Vec2::new(7.0, 2.0), Vec2::new(2.0, 6.5)];
        let atlas = one(corners, 8, 8);
        for s in Bands::of_rows(&atlas, 8).samples(&atlas, 0, 2) {
            let p = corners[0] + s.u * (corners[1] - corners[0]) + s.v * (corners[2] - corners[0]);
            let center = Vec2::new((s.texel % 8) as f32 + 0.5, (s.texel / 8) as f32 + 0.5);
            assert!((p - center).abs().max_element() <= 0.5 + 1e-5);
        }
    }

    #[test]
    fn a_needle_thinner_than_a_texel_leaves_no_gap() {
        // crosses columns 0..8 in row 3 between two sample rows
        let atlas = one([Vec2::new(0.1, 3.6), Vec2::new(7.9, 3.6), Vec2::new(7.9, 3.601)], 8, 8);
        let samples = Bands::of_rows(&atlas, 3).samples(&atlas, 1, 1);
        let texels: Vec<u32> = samples.iter().map(|s| s.texel).collect();
        assert_eq!(texels, (24..32).collect::<Vec<_>>());
    }

    #[test]
    fn a_triangle_without_area_or_within_one_texel_has_a_sample() {
        for corners in
            [[Vec2::splat(2.3); 3], [Vec2::new(2.1, 2.1), Vec2::new(2.2, 2.1), Vec2::new(2.1, 2.2)]]
        {
            let atlas = one(corners, 4, 4);
            let samples = Bands::of_rows(&atlas, 4).samples(&atlas, 0, 1);
            assert_eq!(samples.len(), 1);
            assert_eq!(samples[0].texel, 10);
        }
        // a texture of one texel
        let atlas = one([Vec2::ZERO, Vec2::X, Vec2::Y], 1, 1);
        assert_eq!(Bands::of_rows(&atlas, 1).samples(&atlas, 0, 4).len(), 10);
    }

    #[test]
    fn a_chart_on_the_border_and_a_mirrored_one_are_covered() {
        let border = one([Vec2::ZERO, Vec2::new(4.0, 0.0), Vec2::new(0.0, 4.0)], 4, 4);
        let mirrored = one([Vec2::ZERO, Vec2::new(0.0, 4.0), Vec2::new(4.0, 0.0)], 4, 4);
        let count = |a: &Atlas| Bands::of_rows(a, 4).samples(a, 0, 2).len();
        assert_eq!(count(&border), count(&mirrored));
        assert!(count(&border) > 30);
    }
}

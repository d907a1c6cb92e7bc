//! Watertight ray intersection and nearest-point queries on triangle meshes.
//!
//! A ray aimed exactly at an edge or a vertex of a closed mesh must hit. Three things make it so:
//!
//! - the triangle test of Woop, Benthin, Wald 2013 (*Watertight Ray/Triangle Intersection*, JCGT
//!   2(1)): vertices are moved and sheared by constants of the ray alone, so two triangles compute
//!   the very same numbers for a shared edge `U = Cx·By − Cy·Bx`. Where one of them is exactly 0 in
//!   f32 the decision is repeated in f64, in which the products are exact;
//! - boxes grown by a few ulps of the largest coordinate, which covers the rounding of that test,
//!   and slabs widened after Ize 2013 (*Robust BVH Ray Traversal*, JCGT 2(2)), which covers their
//!   own;
//! - a ray that starts far away is first moved to the mesh in f64, since its own rounding near the
//!   mesh would be larger than the triangles.
//!
//! `obvhs` finds the tree (PLOC with reinsertion). We store it four wide, as Embree does: four
//! boxes or four triangles are met by one SIMD instruction stream. Triangles lie in tree order.

use super::aabb::Aabb;
use super::mesh::Mesh;
use super::ray::{Hit, Ray};
use glam::{DVec3, Vec3, Vec4};
use obvhs::{
    BvhBuildParams,
    bvh2::{Bvh2, builder::build_bvh2},
};
use rayon::prelude::*;
use std::cmp::Ordering;
use std::time::Duration;

/// Rounding of the shear (2.5 ε of the distance) for distances up to five times the largest
/// coordinate, and the 4 ε every coordinate gets.
const BOX_PADDING: f32 = 16.0 * f32::EPSILON;

/// Rays that start farther out than this many times the largest coordinate are moved closer.
const FAR_ORIGIN: f32 = 4.0;

/// Ize 2013: 1 + 2 γ₃, with γ₃ = 3 u / (1 − 3 u) and u = ε/2.
const SLAB_ROUNDING: f32 = 1.0 + 4.0 * f32::EPSILON;

/// Set in a child reference that names a leaf.
const LEAF: u32 = 1 << 31;

/// Deep enough for 10⁷ triangles in a sane tree; deeper trees take their stack from the heap.
const STACK: usize = 64;

/// Four boxes and their children. An absent child has an inverted box, which no ray meets.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct WideNode {
    /// `[low, high][axis]`, one lane a child.
    bounds: [[Vec4; 3]; 2],
    child: [u32; 4],
}

/// Up to four triangles; missing ones repeat the first.
#[derive(Clone, Copy)]
struct Leaf {
    /// `[corner][axis]`, one lane a triangle.
    corners: [[Vec4; 3]; 3],
    triangle: [u32; 4],
}

impl Leaf {
    fn corner(&self, corner: usize, lane: usize) -> Vec3 {
        let c = &self.corners[corner];
        Vec3::new(c[0][lane], c[1][lane], c[2][lane])
    }

    /// Returns how many lanes are not repetitions.
    fn len(&self) -> usize {
        1 + (1..4).filter(|&k| self.triangle[k] != self.triangle[0]).count()
    }
}

/// The nearest point of a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Closest {
    /// Its distance.
    pub distance: f32,
    /// Index into `Mesh::triangles`.
    pub triangle: u32,
    /// Its position.
    pub point: Vec3,
}

/// A tree of boxes over the triangles of a mesh.
///
/// ```
/// use glam::Vec3;
/// use tiface_base::geom::{Bvh, Mesh, Ray};
///
/// let positions = vec![Vec3::ZERO, 2.0 * Vec3::X, 2.0 * Vec3::Y];
/// let bvh = Bvh::new(&Mesh { positions, triangles: vec![[0, 1, 2]], ..Mesh::default() });
/// let ray = Ray::new([0.5, 0.5, 3.0], -Vec3::Z);
/// let hit = bvh.closest_hit(&ray).unwrap();
/// assert_eq!((hit.t, hit.u, hit.v), (3.0, 0.25, 0.25));
/// assert_eq!(bvh.closest_point(-Vec3::X).unwrap().point, Vec3::ZERO);
/// ```
///
/// Holds its own copy of the corners, so the mesh may go. Triangles with a corner that is not
/// finite, or with an index out of range, are left out. Degenerate ones are never hit, but can be
/// nearest.
pub struct Bvh {
    nodes: Vec<WideNode>,
    leaves: Vec<Leaf>,
    bounds: Aabb,
    /// Largest absolute coordinate.
    reach: f32,
    /// Entries the traversal stack may need.
    stack: usize,
}

impl Bvh {
    /// Builds the tree: about 0.1 s for 200 000 triangles on one core, the same on any number.
    pub fn new(mesh: &Mesh) -> Bvh {
        let count = mesh.positions.len();
        let kept: Vec<u32> = (0..mesh.triangles.len() as u32)
            .filter(|&t| {
                mesh.triangles[t as usize].iter().all(|&i| (i as usize) < count)
                    && mesh.corners(t).iter().all(|p| p.is_finite())
            })
            .collect();
        let bounds = Aabb::around(kept.iter().flat_map(|&t| mesh.corners(t)));
        let mut bvh = Bvh { nodes: Vec::new(), leaves: Vec::new(), bounds, reach: 0.0, stack: 1 };
        if kept.is_empty() {
            return bvh;
        }
        bvh.reach = bounds.min.abs().max(bounds.max.abs()).max_element();
        // The builder sees the unit cube: areas of 1e38-sized boxes would overflow.
        let center = 0.5 * (bounds.min.as_dvec3() + bounds.max.as_dvec3());
        let extent = (bounds.max.as_dvec3() - bounds.min.as_dvec3()).max_element();
        let scale = if extent > 0.0 { 1.0 / extent } else { 1.0 };
        let boxes: Vec<obvhs::aabb::Aabb> = kept
            .par_iter()
            .map(|&t| {
                let unit = mesh.corners(t).map(|p| ((p.as_dvec3() - center) * scale).as_vec3());
                let b = Aabb::around(unit);
                obvhs::aabb::Aabb { min: b.min.into(), max: b.max.into() }
            })
            .collect();
        let params = BvhBuildParams {
            max_prims_per_leaf: 4,
            collapse_traversal_cost: 4.0, // a leaf of four costs no more than a leaf of one
            ..BvhBuildParams::medium_build()
        };
        let tree = build_bvh2(&boxes, params, &mut Duration::default());
        bvh.widen(&tree, mesh, &kept);
        bvh
    }

    /// Returns whether the tree has no triangles.
    pub fn is_empty(&self) -> bool {
        self.nodes.is_empty()
    }

    /// Returns the first triangle along the ray with `t_min <= t <= t_max`, from either side; of
    /// triangles at the same `t` (a shared edge), the one with the smallest index. A ray that
    /// starts on the surface meets it at `t = 0`, give or take rounding: pass a small `t_min` to
    /// leave it. `None` for rays with a component that is not finite, or without direction.
    pub fn closest_hit(&self, ray: &Ray) -> Option<Hit> {
        let mut nearest = Nearest(None);
        self.cast(ray, &mut nearest);
        nearest.0
    }

    /// Returns whether the ray hits a triangle with `t_min <= t <= t_max`.
    pub fn any_hit(&self, ray: &Ray) -> bool {
        let mut any = Any(false);
        self.cast(ray, &mut any);
        any.0
    }

    /// Returns all triangles along the ray with `t_min <= t <= t_max`, from either side, in the
    /// order in which [`Self::closest_hit`] would find them. Empty for rays with a component that
    /// is not finite, or without direction.
    pub fn all_hits(&self, ray: &Ray) -> Vec<Hit> {
        let mut all = All(Vec::new());
        self.cast(ray, &mut all);
        all.0
    }

    /// Returns the nearest point of the surface; the smallest triangle index among equals. `None`
    /// for an empty mesh or a query that is not finite.
    pub fn closest_point(&self, query: Vec3) -> Option<Closest> {
        if self.is_empty() || !query.is_finite() {
            return None;
        }
        let p = query.as_dvec3();
        let [px, py, pz] = query.to_array().map(Vec4::splat);
        let mut best = (f64::INFINITY, u32::MAX, DVec3::ZERO);
        let (mut fixed, mut heap) = ([(0u32, 0f32); STACK], Vec::new());
        let stack = self.stack_space(&mut fixed, &mut heap);
        let (mut top, mut current) = (0, 0u32);
        loop {
            if current & LEAF != 0 {
                let leaf = &self.leaves[(current ^ LEAF) as usize];
                for lane in 0..leaf.len() {
                    let [a, b, c] = [0, 1, 2].map(|k| leaf.corner(k, lane).as_dvec3());
                    let point = closest_on_triangle(p, a, b, c);
                    let found = (point.distance_squared(p), leaf.triangle[lane], point);
                    if (found.0, found.1) < (best.0, best.1) {
                        best = found;
                    }
                }
            } else {
                let node = &self.nodes[current as usize];
                let [low, high] = &node.bounds;
                let dx = (low[0] - px).max(px - high[0]).max(Vec4::ZERO);
                let dy = (low[1] - py).max(py - high[1]).max(Vec4::ZERO);
                let dz = (low[2] - pz).max(pz - high[2]).max(Vec4::ZERO);
                // squares of huge coordinates overflow: still a candidate, unlike an absent child
                let near = (dx * dx + dy * dy + dz * dz).min(Vec4::splat(f32::MAX));
                let hits = low[0].cmplt(Vec4::INFINITY).bitmask();
                push_nearest_last(stack, &mut top, hits, near, &node.child);
            }
            loop {
                if top == 0 {
                    let distance = best.0.sqrt() as f32;
                    let point = best.2.as_vec3();
                    return (best.1 != u32::MAX).then_some(Closest { distance, triangle: best.1, point });
                }
                top -= 1;
                if (stack[top].1 as f64) * (1.0 - 1e-6) <= best.0 {
                    current = stack[top].0;
                    break;
                }
            }
        }
    }

    /// Returns a stack of the size this tree needs: on the machine's own unless the tree is
    /// degenerate.
    fn stack_space<'a>(
        &self,
        fixed: &'a mut [(u32, f32); STACK],
        heap: &'a mut Vec<(u32, f32)>,
    ) -> &'a mut [(u32, f32)] {
        if self.stack <= STACK {
            fixed
        } else {
            heap.resize(self.stack, (0, 0.0));
            heap
        }
    }

    /// Traversal with the best instructions this machine has. The arithmetic is the same, without
    /// fused multiply-add, so the answers are too.
    fn cast(&self, ray: &Ray, search: &mut impl Search) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("bmi1") {
            // SAFETY: the machine has both features, detected just above.
            return unsafe { self.cast_avx2(ray, search) };
        }
        self.walk(ray, search)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,bmi1")]
    fn cast_avx2(&self, ray: &Ray, search: &mut impl Search) {
        self.walk(ray, search)
    }

    /// Nearest child first.
    #[inline(always)]
    fn walk(&self, ray: &Ray, search: &mut impl Search) {
        let sane = ray.origin.is_finite() && ray.direction.is_finite() && ray.direction != Vec3::ZERO;
        if self.is_empty() || !sane {
            return;
        }
        let Some((origin, advanced)) = self.approach(ray) else { return };
        let t_min = (ray.t_min as f64 - advanced) as f32;
        let shear = Shear::new(origin, ray.direction);
        let mut end = ((ray.t_max as f64 - advanced) as f32).min(f32::MAX);
        // 1/0 is made finite: 0 · ∞ would be NaN where the ray lies in a slab's plane.
        let inverse = (1.0 / ray.direction).clamp(Vec3::splat(-f32::MAX), Vec3::splat(f32::MAX));
        let near_side = [0, 1, 2].map(|axis| (ray.direction[axis].is_sign_negative()) as usize);
        let [ox, oy, oz] = origin.to_array().map(Vec4::splat);
        let [ix, iy, iz] = inverse.to_array().map(Vec4::splat);
        let start = Vec4::splat(t_min);
        let (mut fixed, mut heap) = ([(0u32, 0f32); STACK], Vec::new());
        let stack = self.stack_space(&mut fixed, &mut heap);
        let (mut top, mut current) = (0, 0u32);
        loop {
            if current & LEAF != 0 {
                let leaf = &self.leaves[(current ^ LEAF) as usize];
                end = shear.meet(leaf, t_min, end, search);
                if search.is_done() {
                    break;
                }
            } else {
                let node = &self.nodes[current as usize];
                let b = &node.bounds;
                let near = ((b[near_side[0]][0] - ox) * ix)
                    .max((b[near_side[1]][1] - oy) * iy)
                    .max((b[near_side[2]][2] - oz) * iz);
                let far = ((b[1 - near_side[0]][0] - ox) * ix)
                    .min((b[1 - near_side[1]][1] - oy) * iy)
                    .min((b[1 - near_side[2]][2] - oz) * iz);
                let near = near.max(start);
                let far = (far * SLAB_ROUNDING).min(Vec4::splat(end));
                let hits = near.cmple(far).bitmask();
                if hits != 0 && hits & (hits - 1) == 0 {
                    current = node.child[hits.trailing_zeros() as usize];
                    continue;
                }
                push_nearest_last(stack, &mut top, hits, near, &node.child);
            }
            loop {
                if top == 0 {
                    return search.finish(advanced);
                }
                top -= 1;
                if stack[top].1 <= end {
                    current = stack[top].0;
                    break;
                }
            }
        }
        search.finish(advanced);
    }

    /// Returns where to start from, and how far along the ray that is. Only far rays move.
    fn approach(&self, ray: &Ray) -> Option<(Vec3, f64)> {
        if ray.origin.abs().max_element() <= FAR_ORIGIN * self.reach {
            return Some((ray.origin, 0.0));
        }
        let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
        let grown = (BOX_PADDING * self.reach).max(f32::MIN_POSITIVE) as f64;
        let (low, high) = (self.bounds.min.as_dvec3() - grown, self.bounds.max.as_dvec3() + grown);
        let (mut enter, mut leave) = (0.0f64, f64::INFINITY);
        for axis in 0..3 {
            if d[axis] == 0.0 {
                if o[axis] < low[axis] || o[axis] > high[axis] {
                    return None;
                }
                continue;
            }
            let (a, b) = ((low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter <= leave).then(|| ((o + enter * d).as_vec3(), enter))
    }
}

impl WideNode {
    const EMPTY: WideNode =
        WideNode { bounds: [[Vec4::INFINITY; 3], [Vec4::NEG_INFINITY; 3]], child: [0; 4] };
}

/// Pushes the children named in `hits` so that the nearest one is popped first.
#[inline(always)]
fn push_nearest_last(stack: &mut [(u32, f32)], top: &mut usize, hits: u32, near: Vec4, child: &[u32; 4]) {
    let (base, near, mut hits) = (*top, near.to_array(), hits);
    while hits != 0 {
        let k = hits.trailing_zeros() as usize;
        hits &= hits - 1;
        let mut at = *top;
        while at > base && stack[at - 1].1 < near[k] {
            stack[at] = stack[at - 1];
            at -= 1;
        }
        stack[at] = (child[k], near[k]);
        *top += 1;
    }
}

/// What a traversal looks for.
trait Search {
    /// Returns whether a triangle that is met at `t`, not behind `end`, counts.
    #[inline(always)]
    fn counts(&self, _t: f32, _triangle: u32, _end: f32) -> bool {
        true
    }

    /// Takes a hit that counts, and returns where the traversal ends from now on.
    fn take(&mut self, hit: Hit, end: f32) -> f32;

    /// Returns whether nothing more is looked for.
    #[inline(always)]
    fn is_done(&self) -> bool {
        false
    }

    /// Ends the search: orders hits, and moves them back by what the ray was advanced.
    fn finish(&mut self, advanced: f64);
}

/// Returns a hit of an advanced ray as one of the ray itself.
fn moved_back(hit: Hit, advanced: f64) -> Hit {
    Hit { t: (hit.t as f64 + advanced) as f32, ..hit }
}

/// The nearest hit; of those at the same place the one with the smallest index.
struct Nearest(Option<Hit>);

impl Search for Nearest {
    #[inline(always)]
    fn counts(&self, t: f32, triangle: u32, end: f32) -> bool {
        t < end || self.0.is_none_or(|best| triangle < best.triangle)
    }

    #[inline(always)]
    fn take(&mut self, hit: Hit, _: f32) -> f32 {
        self.0 = Some(hit);
        hit.t
    }

    fn finish(&mut self, advanced: f64) {
        self.0 = self.0.map(|hit| moved_back(hit, advanced));
    }
}

/// Whether anything is hit.
struct Any(bool);

impl Search for Any {
    #[inline(always)]
    fn take(&mut self, _: Hit, end: f32) -> f32 {
        self.0 = true;
        end
    }

    #[inline(always)]
    fn is_done(&self) -> bool {
        self.0
    }

    fn finish(&mut self, _: f64) {}
}

/// All hits; in order when the search has ended.
struct All(Vec<Hit>);

impl Search for All {
    #[inline(always)]
    fn take(&mut self, hit: Hit, end: f32) -> f32 {
        self.0.push(hit);
        end
    }

    fn finish(&mut self, advanced: f64) {
        let key = |hit: &Hit| (hit.t, hit.triangle);
        self.0.sort_unstable_by(|a, b| key(a).partial_cmp(&key(b)).unwrap_or(Ordering::Equal));
        // leaves repeat triangles
        self.0.dedup_by_key(|hit| hit.triangle);
        self.0.iter_mut().for_each(|hit| *hit = moved_back(*hit, advanced));
    }
}

/// The ray's own coordinates: it looks along z from the origin (Woop, Benthin, Wald 2013, §3).
struct Shear {
    /// Which axes play x, y, z; x and y are swapped for rays against z, to keep the winding.
    axes: [usize; 3],
    /// Ray origin along those axes.
    origin: [Vec4; 3],
    /// x and y per z, and 1 per z.
    shear: [Vec4; 3],
}

impl Shear {
    fn new(origin: Vec3, direction: Vec3) -> Shear {
        let kz = direction.abs().max_position();
        let (mut kx, mut ky) = ((kz + 1) % 3, (kz + 2) % 3);
        if direction[kz] < 0.0 {
            std::mem::swap(&mut kx, &mut ky);
        }
        let z = direction[kz];
        let axes = [kx, ky, kz];
        Shear {
            axes,
            origin: axes.map(|k| Vec4::splat(origin[k])),
            shear: [direction[kx] / z, direction[ky] / z, 1.0 / z].map(Vec4::splat),
        }
    }

    /// Tests four triangles from `t_min` to `end`, and returns the new end.
    #[inline(always)]
    fn meet(&self, leaf: &Leaf, t_min: f32, mut end: f32, search: &mut impl Search) -> f32 {
        let [kx, ky, kz] = self.axes;
        let [a, b, c] = [0, 1, 2].map(|corner| {
            let p = &leaf.corners[corner];
            let z = p[kz] - self.origin[2];
            let x = (p[kx] - self.origin[0]) - self.shear[0] * z;
            let y = (p[ky] - self.origin[1]) - self.shear[1] * z;
            [x, y, z]
        });
        let u = c[0] * b[1] - c[1] * b[0];
        let v = a[0] * c[1] - a[1] * c[0];
        let w = b[0] * a[1] - b[1] * a[0];
        // Products round monotonically, so a sign is right wherever the value is not 0: unlike
        // signs are a sure miss. Comparisons are written so that NaN stays a candidate.
        let unlike = u.min(v).min(w).cmplt(Vec4::ZERO) & u.max(v).max(w).cmpgt(Vec4::ZERO);
        let mut candidates = !unlike.bitmask() & 0xf;
        while candidates != 0 {
            let k = candidates.trailing_zeros() as usize;
            candidates &= candidates - 1;
            let (mut uk, mut vk, mut wk) = (u[k] as f64, v[k] as f64, w[k] as f64);
            let product = u[k] * v[k] * w[k];
            if product == 0.0 || !product.is_finite() {
                let [ax, ay, bx, by, cx, cy] =
                    [a[0][k], a[1][k], b[0][k], b[1][k], c[0][k], c[1][k]].map(f64::from);
                (uk, vk, wk) = (cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax);
                if (uk < 0.0 || vk < 0.0 || wk < 0.0) && (uk > 0.0 || vk > 0.0 || wk > 0.0) {
                    continue;
                }
            }
            let det = uk + vk + wk;
            if det == 0.0 || !det.is_finite() {
                continue; // seen edge on, or degenerate
            }
            let z = uk * a[2][k] as f64 + vk * b[2][k] as f64 + wk * c[2][k] as f64;
            let t = (z / det) as f32 * self.shear[2][k];
            let triangle = leaf.triangle[k];
            if t >= t_min && t <= end && search.counts(t, triangle, end) {
                end = search.take(Hit { t, triangle, u: (vk / det) as f32, v: (wk / det) as f32 }, end);
            }
        }
        end
    }
}

/// Returns the point of triangle abc nearest to `p` (Ericson 2004, §5.1.5), also for degenerate
/// triangles.
fn closest_on_triangle(p: DVec3, a: DVec3, b: DVec3, c: DVec3) -> DVec3 {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let normal = ab.cross(ac).length_squared();
    if normal <= 1e-24 * ab.length_squared() * ac.length_squared() {
        // A line or a point: its three edges.
        return [(a, b), (b, c), (c, a)]
            .map(|(from, to)| {
                let d = to - from;
                let s = (p - from).dot(d) / d.length_squared();
                if s.is_finite() { from + s.clamp(0.0, 1.0) * d } else { from }
            })
            .into_iter()
            .min_by(|x, y| x.distance_squared(p).total_cmp(&y.distance_squared(p)))
            .unwrap_or(a);
    }
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + d1 / (d1 - d3) * ab;
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + d2 / (d2 - d6) * ac;
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b);
    }
    let total = va + vb + vc;
    a + vb / total * ab + vc / total * ac
}

// From the builder's binary tree to the wide one that rays walk.
impl Bvh {
    /// Turns the builder's binary tree into our wide one, with boxes from the real corners.
    fn widen(&mut self, tree: &Bvh2, mesh: &Mesh, kept: &[u32]) {
        // Boxes bottom up: `order` lists parents before children.
        let mut order = vec![0usize];
        let mut next = 0;
        while next < order.len() {
            let node = &tree.nodes[order[next]];
            if !node.is_leaf() {
                order.extend([node.first_index as usize, node.first_index as usize + 1]);
            }
            next += 1;
        }
        let members = |n: usize| {
            let (first, count) = (tree.nodes[n].first_index as usize, tree.nodes[n].prim_count as usize);
            tree.primitive_indices[first..first + count].iter().map(|&p| kept[p as usize])
        };
        let mut boxes = vec![Aabb::EMPTY; tree.nodes.len()];
        for &n in order.iter().rev() {
            let node = &tree.nodes[n];
            boxes[n] = if node.is_leaf() {
                Aabb::around(members(n).flat_map(|t| mesh.corners(t)))
            } else {
                let (a, b) = (boxes[node.first_index as usize], boxes[node.first_index as usize + 1]);
                Aabb { min: a.min.min(b.min), max: a.max.max(b.max) }
            };
        }
        let grown = (BOX_PADDING * self.reach).max(f32::MIN_POSITIVE);
        // Work: which of our nodes stands for which of theirs, and how deep it is.
        let mut work = vec![(0usize, 0usize, 1usize)];
        self.nodes.push(WideNode::EMPTY);
        let mut depth = 1;
        while let Some((ours, theirs, level)) = work.pop() {
            depth = depth.max(level);
            let mut children = vec![theirs];
            // Open the largest box until the node has four children.
            while children.len() < 4 {
                let largest = (0..children.len())
                    .filter(|&k| !tree.nodes[children[k]].is_leaf())
                    .max_by(|&a, &b| half_area(boxes[children[a]]).total_cmp(&half_area(boxes[children[b]])));
                let Some(k) = largest else { break };
                let first = tree.nodes[children[k]].first_index as usize;
                children[k] = first;
                children.insert(k + 1, first + 1);
            }
            for (lane, &n) in children.iter().enumerate() {
                let b = boxes[n].grown(grown);
                for axis in 0..3 {
                    self.nodes[ours].bounds[0][axis][lane] = b.min[axis];
                    self.nodes[ours].bounds[1][axis][lane] = b.max[axis];
                }
                self.nodes[ours].child[lane] = if tree.nodes[n].is_leaf() {
                    // no more than the four that the builder was configured for
                    self.add_leaf(mesh, &members(n).collect::<Vec<u32>>())
                } else {
                    self.nodes.push(WideNode::EMPTY);
                    work.push((self.nodes.len() - 1, n, level + 1));
                    self.nodes.len() as u32 - 1
                };
            }
        }
        self.stack = 3 * (depth + 2) + 1;
    }

    fn add_leaf(&mut self, mesh: &Mesh, triangles: &[u32]) -> u32 {
        let mut leaf = Leaf { corners: [[Vec4::ZERO; 3]; 3], triangle: [triangles[0]; 4] };
        for lane in 0..4 {
            leaf.triangle[lane] = *triangles.get(lane).unwrap_or(&triangles[0]);
            for (k, p) in mesh.corners(leaf.triangle[lane]).into_iter().enumerate() {
                for axis in 0..3 {
                    leaf.corners[k][axis][lane] = p[axis];
                }
            }
        }
        self.leaves.push(leaf);
        LEAF | (self.leaves.len() as u32 - 1)
    }
}

fn half_area(b: Aabb) -> f32 {
    let s = b.size();
    s.x * s.y + s.y * s.z + s.z * s.x
}

#[cfg(test)]
mod tests;

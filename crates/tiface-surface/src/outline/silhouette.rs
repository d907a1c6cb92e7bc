//! Points of a mesh's outline in a photograph, and where the mask's outline lies beside them.

use super::super::appearance::Photograph;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use tiface_base::geom::{Bvh, Mesh, area_vector, bilinear_taps, side_ends, sorted_sides};
use tiface_base::image::Gray;

/// How far from the mesh's outline that of the mask is looked for, pixels.
const REACH: f32 = 3.0;

/// Distance of the places where the mask is looked at, pixels.
const STEP: f32 = 0.25;

/// Number of these places.
const PLACES: usize = (2.0 * REACH / STEP) as usize + 1;

/// Distance from the middle of a ramp, in steps, between which its height is measured: a pixel.
const RAMP: usize = 4;

/// Points of an edge.
const PER_EDGE: usize = 2;

/// Distance from the outline, in pixels, at which rays must meet the mesh inside and pass it
/// outside.
const BESIDE: f32 = 0.35;

/// Maximum depth between an edge and what is hit beside it, as a share of that on a ball of the
/// mesh's size: more is another part of the head.
const DEPTH: f32 = 1.5;

/// An edge between two triangles.
pub(super) struct Edge {
    ends: [u32; 2],
    sides: [u32; 2],
}

/// Returns the edges of exactly two triangles.
pub(super) fn edges(triangles: &[[u32; 3]]) -> Vec<Edge> {
    let sides = sorted_sides(triangles);
    let edge = |run: &[(u64, u32)]| match *run {
        [(_, a), (_, b)] => {
            let (from, to) = side_ends(triangles, a);
            Some(Edge { ends: [from, to], sides: [a / 3, b / 3] })
        }
        _ => None,
    };
    sides.chunk_by(|a, b| a.0 == b.0).filter_map(edge).collect()
}

/// A point of a mesh's outline, seen before the background.
pub(super) struct OutlinePoint {
    /// Distance of the mask's outline, pixels; positive outside of the mesh.
    pub rest: f32,
    /// The vertices of the edge, and by how many pixels the outline moves when each moves by a unit
    /// along its normal.
    pub slopes: [(u32, f32); 2],
    /// Length of outline that the point stands for, in pixels, times the share of opacity that
    /// falls within a pixel of the mask's outline.
    pub weight: f32,
}

/// A mesh that is looked at; its vertices move along `normals`, in units of `unit`.
pub(super) struct Shown<'a> {
    pub mesh: &'a Mesh,
    pub normals: &'a [Vec3],
    pub unit: f32,
    /// Maximum depth between an edge and what is hit beside it.
    depth: f32,
    /// Unit normals of the triangles.
    facing: Vec<Vec3>,
    bvh: Bvh,
}

impl<'a> Shown<'a> {
    pub fn new(mesh: &'a Mesh, normals: &'a [Vec3], unit: f32) -> Shown<'a> {
        let facing = |t: &[u32; 3]| area_vector(t.map(|v| mesh.positions[v as usize])).normalize_or_zero();
        // a ball of diameter d is √(d h) nearer at h inside of its outline
        let longest = mesh.bounds().size().max_element();
        let depth = DEPTH * (longest * BESIDE * unit).sqrt();
        let facing = mesh.triangles.par_iter().map(facing).collect();
        Shown { mesh, normals, unit, depth, facing, bvh: Bvh::new(mesh) }
    }

    /// Returns the points of the outline in a photograph with a mask that say something.
    pub fn outline(&self, edges: &[Edge], photograph: &Photograph) -> Vec<OutlinePoint> {
        let Some(mask) = photograph.mask else { return Vec::new() };
        let eye = photograph.camera.position.as_vec3();
        let toward = |(t, n): (&[u32; 3], &Vec3)| n.dot(self.mesh.positions[t[0] as usize] - eye) < 0.0;
        let toward: Vec<bool> = self.mesh.triangles.par_iter().zip(&self.facing).map(toward).collect();
        let bends = |e: &&Edge| toward[e.sides[0] as usize] != toward[e.sides[1] as usize];
        let points = |e: &Edge| self.of_edge(e, photograph, mask).unwrap_or_default();
        edges.par_iter().filter(bends).flat_map_iter(points).collect()
    }

    fn of_edge(&self, edge: &Edge, photograph: &Photograph, mask: &Gray) -> Option<Vec<OutlinePoint>> {
        let (camera, positions) = (photograph.camera, &self.mesh.positions);
        let at = |p: Vec3| camera.project(p).map(|(at, _)| at);
        let ends = edge.ends.map(|v| positions[v as usize]);
        let (a, b) = (at(ends[0])?, at(ends[1])?);
        let length = a.distance(b);
        if length.is_nan() || length <= 1e-3 {
            return None;
        }
        let across = (b - a).perp() / length;
        let middle = ends[0].midpoint(ends[1]);
        let pixels = |direction: Vec3| Some((at(middle + self.unit * direction)? - at(middle)?).dot(across));
        let outward = edge.sides.map(|t| self.facing[t as usize]);
        let side = pixels((outward[0] + outward[1]).normalize_or_zero())?.signum();
        let across = side * across;
        let slopes = edge.ends.map(|v| pixels(self.normals[v as usize]).map(|s| side * s));
        let slopes = [slopes[0]?, slopes[1]?];
        let point = |k: usize| {
            let share = (k as f32 + 0.5) / PER_EDGE as f32;
            let (p, shares) = (ends[0].lerp(ends[1], share), [1.0 - share, share]);
            let (place, _) = camera.project(p)?;
            if !self.is_outline(photograph, p, place, across) {
                return None;
            }
            let profile = profile(mask, photograph.valid, place, across)?;
            let (rest, ramp) = nearest_fall(&profile)?;
            Some(OutlinePoint {
                rest,
                slopes: [0, 1].map(|e| (edge.ends[e], shares[e] * slopes[e])),
                weight: ramp * length / PER_EDGE as f32,
            })
        };
        Some((0..PER_EDGE).filter_map(point).collect())
    }

    /// Returns whether the background begins at a point of an edge, `place` in the picture.
    fn is_outline(&self, photograph: &Photograph, p: Vec3, place: Vec2, across: Vec2) -> bool {
        let beside = |by: f32| photograph.camera.ray(place + by * across);
        let (Some(outside), Some(inside)) = (beside(BESIDE), beside(-BESIDE)) else { return false };
        let near = |t: f32| (t - p.distance(inside.origin)).abs() < self.depth;
        !self.bvh.any_hit(&outside) && self.bvh.closest_hit(&inside).is_some_and(|hit| near(hit.t))
    }
}

/// Returns the opacities of a mask along a line through `place`, from the inside to the outside;
/// `None` where the picture ends or pixels are not usable.
fn profile(mask: &Gray, valid: Option<&Gray>, place: Vec2, across: Vec2) -> Option<[f32; PLACES]> {
    let size = Vec2::new(mask.width as f32, mask.height as f32);
    let within = |p: Vec2| p.min_element() >= 0.0 && (size - p).min_element() > 0.0;
    if ![-REACH, REACH].iter().all(|by| within(place + *by * across)) {
        return None;
    }
    let mut opacities = [0.0; PLACES];
    for (k, opacity) in opacities.iter_mut().enumerate() {
        let taps = bilinear_taps(place + offset(k as f32) * across - 0.5, [mask.width, mask.height]);
        if valid.is_some_and(|v| taps.iter().any(|&(i, _)| v.values[i as usize] == 0)) {
            return None;
        }
        *opacity = taps.iter().map(|&(i, w)| w * f32::from(mask.values[i as usize])).sum::<f32>() / 255.0;
    }
    Some(opacities)
}

/// Returns the distance of a place of a profile from the mesh's outline.
fn offset(k: f32) -> f32 {
    k * STEP - REACH
}

/// Returns where opacities fall below one half nearest to the middle, and by how much they fall
/// within a pixel of it on both sides.
fn nearest_fall(profile: &[f32; PLACES]) -> Option<(f32, f32)> {
    let fall = |k: usize| {
        let (here, next) = (profile[k], profile[k + 1]);
        (here >= 0.5 && next < 0.5).then(|| (k, offset(k as f32 + (here - 0.5) / (here - next))))
    };
    let (k, rest) = (0..PLACES - 1).filter_map(fall).min_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?;
    let ramp = profile[k.saturating_sub(RAMP)] - profile[(k + 1 + RAMP).min(PLACES - 1)];
    Some((rest, ramp.clamp(0.0, 1.0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a profile that falls evenly from 1 to 0 over `width` pixels around `middle`.
    fn ramp(middle: f32, width: f32) -> [f32; PLACES] {
        std::array::from_fn(|k| (0.5 - (offset(k as f32) - middle) / width).clamp(0.0, 1.0))
    }

    #[test]
    fn the_fall_is_found_between_places_and_soft_ones_count_less() {
        let (rest, hard) = nearest_fall(&ramp(0.63, 1.0)).unwrap();
        assert!((rest - 0.63).abs() < 1e-5 && hard == 1.0, "{rest} {hard}");
        let (rest, soft) = nearest_fall(&ramp(-0.4, 8.0)).unwrap();
        assert!((rest + 0.4).abs() < 1e-5 && (0.2..0.35).contains(&soft), "{rest} {soft}");
        assert_eq!(nearest_fall(&ramp(3.2, 0.3)), None);
        // a rise is no outline
        let mut rise = ramp(0.0, 1.0);
        rise.reverse();
        assert_eq!(nearest_fall(&rise), None);
    }

    #[test]
    fn a_profile_ends_with_the_picture_and_with_what_is_usable() {
        // opaque left of x = 8
        let mask = Gray {
            width: 16,
            height: 16,
            values: (0..256).map(|i| if i % 16 < 8 { 255 } else { 0 }).collect(),
        };
        let (place, across) = (Vec2::new(7.5, 8.0), Vec2::X);
        let (rest, _) = nearest_fall(&profile(&mask, None, place, across).unwrap()).unwrap();
        assert!((rest - 0.5).abs() < 1e-5, "{rest}");
        assert_eq!(profile(&mask, None, Vec2::new(14.0, 8.0), across), None);
        let mut valid = Gray { width: 16, height: 16, values: vec![255; 256] };
        assert!(profile(&mask, Some(&valid), place, across).is_some());
        valid.values[8 * 16 + 9] = 0;
        assert_eq!(profile(&mask, Some(&valid), place, across), None);
    }

    #[test]
    fn edges_of_one_triangle_are_none() {
        // two triangles of a square, and a tetrahedron
        assert_eq!(edges(&[[0, 1, 2], [0, 2, 3]]).len(), 1);
        assert_eq!(edges(&[[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]).len(), 6);
    }
}

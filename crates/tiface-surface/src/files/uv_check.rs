//! Validation and quality of an atlas, for any mesh with texture coordinates, also from other
//! tools.
//!
//! Charts are triangles joined across edges whose two sides have equal uv. With Γ ≥ γ the largest
//! and smallest length that a unit step in the texture has on the surface, both scaled so that
//! texture and surface have the same area in total:
//!
//! - stretch of the atlas: root of the mean of (Γ² + γ²) / 2 over the surface: the L² norm of
//!   Sander, Snyder, Gortler, Hoppe 2001 (*Texture mapping progressive meshes*, §3), as xatlas
//!   reports it; 1 is perfect;
//! - area stretch of a triangle: (Γγ + 1 / Γγ) / 2, its angle stretch: (Γ/γ + γ/Γ) / 2 (the parts
//!   that Degener, Meseth, Klein 2003, §3 split it into); 1 is perfect.
//!
//! Texels are square even if the texture is not: all lengths are measured in texels.

use super::weld::weld_map;
use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashMap;
use std::fmt;
use tiface_base::geom::{
    Atlas, DEFAULT_EFFORT, Mesh, OutlineSide, Sets, nearest_charts, overlaps, shared_area, side_ends,
    sorted_sides, turn,
};
use tiface_base::math::rank::quantile;

/// Triangles below this area, in texels, count as having none: rounding decides their shape.
pub const MIN_AREA_PX: f64 = 1e-6;

/// The result of [`uv_check`].
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct UvReport {
    /// Triangles of the mesh.
    pub triangles: usize,
    /// Triangles with an index out of range, or a corner or coordinate that is not finite; ignored
    /// below. One for each triangle that only the mesh or only the atlas has, too.
    pub invalid: usize,
    /// Flat patches.
    pub charts: usize,
    /// Length on the surface of the edges along which the texture is cut, each counted once, over
    /// √area.
    pub seam_length: f64,
    /// Sander's L² stretch; 1 is perfect.
    pub stretch: f64,
    /// Mean area stretch over the surface; 1 is perfect.
    pub area_stretch: f64,
    /// Median of the area stretch over triangles.
    pub area_stretch_median: f64,
    /// 99th percentile of the area stretch over triangles.
    pub area_stretch_p99: f64,
    /// Median of the angle stretch over triangles.
    pub angle_stretch_median: f64,
    /// 99th percentile of the angle stretch over triangles.
    pub angle_stretch_p99: f64,
    /// Share of the texture that triangles cover; 0..=1 without overlaps.
    pub used: f64,
    /// Triangles that share area with another one. Common sides and corners do not count.
    pub overlapping: usize,
    /// The area they share, in texels, summed over pairs.
    pub overlap_px: f64,
    /// Triangles that were not compared with all that lie near them, because too many do: then the
    /// two above are lower bounds.
    pub overlaps_left: usize,
    /// Triangles wound against the rest of their chart.
    pub flipped: usize,
    /// Charts that show the surface mirrored: clockwise as seen in the image.
    pub mirrored_charts: usize,
    /// Triangles below [`MIN_AREA_PX`], though they have area on the surface or not.
    pub zero_area: usize,
    /// Triangles that reach out of the texture.
    pub outside: usize,
    /// Smallest distance between two charts, in texels; none for a single chart. Up to
    /// [`MAX_CHART_DISTANCE_PX`](UvReport::MAX_CHART_DISTANCE_PX).
    pub chart_distance_px: Option<f64>,
    /// Sides of charts that were not compared with all that lie near them: then the distance is an
    /// upper bound.
    pub chart_distance_left: usize,
    /// Smallest distance of a chart to the texture's border, in texels; negative when it reaches
    /// out.
    pub border_distance_px: f64,
}

impl UvReport {
    /// Charts farther apart than this are not measured.
    pub const MAX_CHART_DISTANCE_PX: f64 = 128.0;

    /// Returns whether every point of the surface has its own texel: no triangle is invalid,
    /// overlapping, flipped, without area or outside.
    pub fn is_sound(&self) -> bool {
        self.overlaps_left == 0
            && self.invalid + self.overlapping + self.flipped + self.zero_area + self.outside == 0
    }

    /// Describes the defects of the atlas for the user.
    pub(super) fn faults(&self) -> String {
        let UvReport { overlapping, flipped, zero_area, outside, invalid, .. } = self;
        let (least, left) = bound("at least ", self.overlaps_left, "triangles");
        format!(
            "{least}{overlapping} triangles overlap{left}, {flipped} flipped, {zero_area} without area, \
             {outside} outside, {invalid} invalid"
        )
    }
}

impl fmt::Display for UvReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let UvReport { charts, mirrored_charts, seam_length, stretch, overlapping, overlap_px, .. } = self;
        let UvReport { flipped, zero_area, outside, invalid, border_distance_px: border, .. } = self;
        let UvReport { area_stretch, area_stretch_median, area_stretch_p99, .. } = self;
        let UvReport { angle_stretch_median, angle_stretch_p99, .. } = self;
        let used = 100.0 * self.used;
        let (least, rest) = bound("at least ", self.overlaps_left, "triangles");
        let (most, left) = bound("at most ", self.chart_distance_left, "sides of charts");
        let apart =
            self.chart_distance_px.map_or("one chart".into(), |d| format!("{most}{d:.2} texels{left}"));
        write!(
            f,
            "\
charts               {charts} ({mirrored_charts} mirrored)
seams                {seam_length:.2} × √area
stretch              {stretch:.4}
area stretch         mean {area_stretch:.4}, median {area_stretch_median:.4}, 99 % below {area_stretch_p99:.4}
angle stretch        median {angle_stretch_median:.4}, 99 % below {angle_stretch_p99:.4}
used                 {used:.1} %
overlapping          {least}{overlapping} triangles, {overlap_px:.3} texels{rest}
broken               {flipped} flipped, {zero_area} without area, {outside} outside, {invalid} invalid
apart                {apart}, from the border {border:.2} texels
"
        )
    }
}

/// Returns the text before and after a figure that is a bound because `left` candidates were not
/// compared.
pub(super) fn bound(which: &'static str, left: usize, of: &str) -> (&'static str, String) {
    if left == 0 { ("", String::new()) } else { (which, format!(" ({left} {of} not compared further)")) }
}

/// Measures an atlas. Never panics, for any mesh and atlas; lengths are those of the mesh.
pub fn uv_check(mesh: &Mesh, atlas: &Atlas) -> UvReport {
    let (count, listed) = (mesh.triangles.len(), atlas.triangles.len());
    let common = count.min(listed);
    let valid: Vec<bool> = (0..common).map(|t| is_valid(mesh, atlas, t)).collect();
    let invalid = valid.iter().filter(|v| !**v).count() + count.max(listed) - common;
    let mut report =
        UvReport { triangles: count, invalid, border_distance_px: f64::INFINITY, ..UvReport::default() };
    let size = DVec2::new(f64::from(atlas.width), f64::from(atlas.height));
    let uv = |t: usize| atlas.triangles[t].map(|i| atlas.uvs[i as usize]);
    let px = |t: usize| uv(t).map(|v| v.as_dvec2() * size);
    let points = |t: usize| mesh.corners(t as u32).map(|p| p.as_dvec3());
    let each = || (0..common).filter(|&t| valid[t]);

    let joined = AtlasCharts::new(mesh, atlas, &valid);
    report.charts = each().filter(|&t| joined.chart[t] == t as u32).count();
    report.seam_length = joined.seam_length(|_, _| true);

    let area = |t: usize| {
        let [a, b, c] = px(t);
        0.5 * (b - a).perp_dot(c - a)
    };
    let mut winding: HashMap<u32, f64> = HashMap::new();
    let mut flat = vec![false; common];
    let mut texture = 0.0;
    for t in each() {
        let area = area(t);
        texture += area.abs();
        flat[t] = area.abs() < MIN_AREA_PX;
        report.zero_area += usize::from(flat[t]);
        *winding.entry(joined.chart[t]).or_default() += area;
        let corners = px(t);
        let out = corners.iter().any(|p| p.cmplt(DVec2::ZERO).any() || p.cmpgt(size).any());
        report.outside += usize::from(out);
        for p in corners {
            let nearest = p.min_element().min((size - p).min_element());
            report.border_distance_px = report.border_distance_px.min(nearest);
        }
    }
    report.mirrored_charts = winding.values().filter(|&&w| w > 0.0).count();
    for t in each().filter(|&t| !flat[t]) {
        let [a, b, c] = uv(t);
        report.flipped += usize::from(f64::from(turn(a, b, c)) * winding[&joined.chart[t]] < 0.0);
    }
    report.used = if size.min_element() > 0.0 { texture / (size.x * size.y) } else { 0.0 };

    let fit: Vec<bool> = (0..common)
        .map(|t| {
            let has_area = |[a, b, c]: [Vec2; 3]| turn(a, b, c) != 0;
            valid[t] && has_area(uv(t))
        })
        .collect();
    let found = overlaps(&atlas.uvs, &atlas.triangles[..common], &fit, DEFAULT_EFFORT);
    report.overlapping = found.covered;
    report.overlaps_left = found.left;
    let shared: Vec<f64> =
        found.pairs.par_iter().map(|&(a, b)| shared_area(px(a as usize), px(b as usize))).collect();
    // a sum of nothing is −0
    report.overlap_px = shared.iter().fold(0.0, |sum, area| sum + area);

    let sides: Vec<OutlineSide> = joined
        .rims
        .iter()
        .map(|&corner| {
            let (t, k) = (corner as usize / 3, corner as usize % 3);
            let p = px(t);
            OutlineSide { chart: joined.chart[t], from: p[k], to: p[(k + 1) % 3] }
        })
        .collect();
    let apart = nearest_charts(&sides, UvReport::MAX_CHART_DISTANCE_PX);
    (report.chart_distance_px, report.chart_distance_left) = (apart.distance, apart.left);
    stretches(&mut report, &each().filter(|&t| !flat[t]).map(|t| (points(t), px(t))).collect::<Vec<_>>());
    report
}

fn is_valid(mesh: &Mesh, atlas: &Atlas, t: usize) -> bool {
    mesh.triangles[t].iter().all(|&i| mesh.positions.get(i as usize).is_some_and(|p| p.is_finite()))
        && atlas.triangles[t].iter().all(|&i| atlas.uvs.get(i as usize).is_some_and(|v| v.is_finite()))
}

/// Returns the length of the seams visible from `front` within 45 degrees, over √area: edges whose
/// two triangles together face that direction, hidden or not.
pub fn seams_facing(mesh: &Mesh, atlas: &Atlas, front: Vec3) -> f64 {
    let valid: Vec<bool> =
        (0..mesh.triangles.len().min(atlas.triangles.len())).map(|t| is_valid(mesh, atlas, t)).collect();
    let joined = AtlasCharts::new(mesh, atlas, &valid);
    let normal = |c: u32| {
        let [a, b, c] = mesh.corners(c / 3);
        (b - a).cross(c - a).normalize_or_zero()
    };
    let faces =
        |n: Vec3| n.normalize_or_zero().dot(front.normalize_or_zero()) > std::f32::consts::FRAC_1_SQRT_2;
    joined.seam_length(|a, b| faces(normal(a) + normal(b)))
}

/// Charts of an atlas: the triangles that the texture joins.
struct AtlasCharts {
    /// The lowest triangle of each triangle's chart.
    chart: Vec<u32>,
    /// Sides that border on no triangle of the chart: `3 t + k` for the side from corner k of
    /// triangle t.
    rims: Vec<u32>,
    /// Edges of the surface where its texture is cut: the two sides and the length.
    cuts: Vec<(u32, u32, f64)>,
    /// Area of the surface.
    surface: f64,
}

impl AtlasCharts {
    /// Returns the length of the cuts between those sides, over √area.
    fn seam_length(&self, between: impl Fn(u32, u32) -> bool) -> f64 {
        let kept = self.cuts.iter().filter(|(a, b, _)| between(*a, *b));
        let length = kept.fold(0.0, |sum, cut| sum + cut.2);
        if self.surface > 0.0 { length / self.surface.sqrt() } else { 0.0 }
    }

    fn new(mesh: &Mesh, atlas: &Atlas, valid: &[bool]) -> AtlasCharts {
        let (weld, _) = weld_map(mesh);
        // any value for invalid triangles
        let welded = |i: u32| weld.get(i as usize).copied().unwrap_or(0);
        let faces: Vec<[u32; 3]> = mesh.triangles[..valid.len()].iter().map(|t| t.map(welded)).collect();
        let mut sides = sorted_sides(&faces);
        sides.retain(|&(_, c)| valid[c as usize / 3]);
        let corner = |c: u32| (c as usize / 3, c as usize % 3);
        // Corner k of a triangle is followed by k + 1 of the same one.
        let next = |c: u32| c / 3 * 3 + (c + 1) % 3;
        let uv = |c: u32| {
            let (t, k) = corner(c);
            atlas.uvs[atlas.triangles[t][k] as usize] + 0.0 // makes −0 and 0 equal
        };
        let mut sets = Sets::new(valid.len());
        let (mut rims, mut cuts) = (Vec::new(), Vec::new());
        let mut keyed: Vec<([[u32; 2]; 2], u32)> = Vec::new();
        for run in sides.chunk_by(|a, b| a.0 == b.0) {
            let low = (run[0].0 >> 32) as u32;
            let ends = |c: u32| {
                let (from, to) = (uv(c), uv(next(c)));
                if side_ends(&faces, c).0 == low { [from, to] } else { [to, from] }
            };
            // sides with equal ends belong together, however many meet in this edge
            keyed.clear();
            let bits = |p: Vec2| p.to_array().map(f32::to_bits);
            keyed.extend(run.iter().map(|&(_, c)| (ends(c).map(bits), c)));
            keyed.sort_unstable();
            let mut single = None;
            for group in keyed.chunk_by(|a, b| a.0 == b.0) {
                group.windows(2).for_each(|pair| sets.join(pair[0].1 / 3, pair[1].1 / 3));
                if let [(_, side)] = *group {
                    rims.push(side);
                    single = Some(single.map_or(side, |s: u32| s.min(side)));
                }
            }
            let other = |a: u32| run.iter().map(|r| r.1).find(|&b| b != a);
            let cut = single.and_then(|a| other(a).map(|b| (a, b)));
            if let Some((a, b)) = cut {
                let [p, q] =
                    [a, next(a)].map(corner).map(|(t, k)| mesh.positions[mesh.triangles[t][k] as usize]);
                cuts.push((a, b, p.as_dvec3().distance(q.as_dvec3())));
            }
        }
        let surface = (0..valid.len()).filter(|&t| valid[t]).map(|t| twice_area(mesh, t) / 2.0).sum();
        AtlasCharts { chart: (0..valid.len() as u32).map(|t| sets.find(t)).collect(), rims, cuts, surface }
    }
}

fn twice_area(mesh: &Mesh, t: usize) -> f64 {
    let [a, b, c] = mesh.corners(t as u32).map(|p| p.as_dvec3());
    (b - a).cross(c - a).length()
}

fn stretches(report: &mut UvReport, triangles: &[([DVec3; 3], [DVec2; 3])]) {
    // (area on the surface, area in the texture, Γ² + γ²), before scaling; slivers without area
    // have none
    let measured: Vec<(f64, f64, f64)> = triangles
        .par_iter()
        .filter_map(|&([p, q, r], [a, b, c])| {
            let surface = 0.5 * (q - p).cross(r - p).length();
            let twice = (b - a).perp_dot(c - a);
            // Sander 2001 eq. (1): the partial derivatives of the surface by s and t
            let s = (p * (b.y - c.y) + q * (c.y - a.y) + r * (a.y - b.y)) / twice;
            let t = (p * (c.x - b.x) + q * (a.x - c.x) + r * (b.x - a.x)) / twice;
            (surface > 0.0).then(|| (surface, 0.5 * twice.abs(), s.length_squared() + t.length_squared()))
        })
        .collect();
    let sum = |f: fn(&(f64, f64, f64)) -> f64| measured.iter().map(f).sum::<f64>();
    let (surface, texture) = (sum(|m| m.0), sum(|m| m.1));
    if measured.is_empty() {
        (report.stretch, report.area_stretch, report.area_stretch_median) = (1.0, 1.0, 1.0);
        (report.area_stretch_p99, report.angle_stretch_median, report.angle_stretch_p99) = (1.0, 1.0, 1.0);
        return;
    }
    let scale = texture / surface; // texels² a unit²
    report.stretch = (sum(|m| 0.5 * m.2 * m.0) / surface * scale).sqrt();
    let area = |m: &(f64, f64, f64)| {
        let ratio = m.1 / (m.0 * scale);
        0.5 * (ratio + 1.0 / ratio)
    };
    report.area_stretch = measured.iter().map(|m| area(m) * m.0).sum::<f64>() / surface;
    let mut areas: Vec<f64> = measured.iter().map(area).collect();
    // Γ/γ + γ/Γ = (Γ² + γ²) / Γγ, and Γγ is the ratio of the areas
    let mut angles: Vec<f64> = measured.iter().map(|m| (0.5 * m.2 * m.1 / m.0).max(1.0)).collect();
    (report.area_stretch_median, report.area_stretch_p99) = quantiles(&mut areas);
    (report.angle_stretch_median, report.angle_stretch_p99) = quantiles(&mut angles);
}

/// Returns the median and 99th percentile of some values, of which there is one at least.
fn quantiles(values: &mut [f64]) -> (f64, f64) {
    let [median, high] = [0.5, 0.99].map(|share| quantile(values, share, f64::total_cmp).unwrap_or(f64::NAN));
    (median, high)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two unit squares of two triangles each, side by side in space; in the texture of 8 × 8
    /// texels at (1, 1)..(3, 3) and, as a chart of its own, at (4, 1)..(6, 3).
    fn two_squares() -> (Mesh, Atlas) {
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        let mesh = Mesh {
            positions: vec![p(0., 0.), p(1., 0.), p(2., 0.), p(0., 1.), p(1., 1.), p(2., 1.)],
            triangles: vec![[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]],
            ..Mesh::default()
        };
        let t = |x: f32, y: f32| Vec2::new(x, 8.0 - y) / 8.0; // y up
        let uvs =
            vec![t(1., 1.), t(3., 1.), t(3., 3.), t(1., 3.), t(4., 1.), t(6., 1.), t(6., 3.), t(4., 3.)];
        let triangles = vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]];
        (mesh, Atlas { uvs, triangles, width: 8, height: 8 })
    }

    #[test]
    fn two_charts_of_a_flat_strip_are_measured_by_hand() {
        let (mesh, atlas) = two_squares();
        let r = uv_check(&mesh, &atlas);
        assert!(r.is_sound(), "{r:?}");
        assert_eq!((r.charts, r.mirrored_charts), (2, 0));
        // one seam of length 1 on an area of 2; 8 of 64 texels; columns 3 to 4; row and column 1
        assert!((r.seam_length - 1.0 / 2f64.sqrt()).abs() < 1e-12);
        assert!((r.used - 8.0 / 64.0).abs() < 1e-12);
        assert_eq!((r.chart_distance_px, r.border_distance_px), (Some(1.0), 1.0));
        for s in [r.stretch, r.area_stretch, r.area_stretch_p99, r.angle_stretch_p99] {
            assert!((s - 1.0).abs() < 1e-9, "{r:?}");
        }
        assert!(r.to_string().contains("charts               2"));
    }

    #[test]
    fn stretch_of_a_chart_twice_as_wide_is_sanders() {
        let (mesh, mut atlas) = two_squares();
        atlas.triangles.truncate(2);
        let mesh = Mesh { triangles: mesh.triangles[..2].to_vec(), ..mesh };
        atlas.uvs[1].x = 5.0 / 8.0;
        atlas.uvs[2].x = 5.0 / 8.0;
        let r = uv_check(&mesh, &atlas);
        // 1 × 1 on 4 × 2 texels: steps on the surface are 1/4 and 1/2, times √8 to have equal
        // areas: 0.707 and 1.414. L² = √((0.5 + 2) / 2) = 1.118; angle (2 + 1/2) / 2 = 1.25;
        // area 1.
        assert!((r.stretch - 1.25f64.sqrt()).abs() < 1e-6, "{r:?}");
        assert!((r.angle_stretch_median - 1.25).abs() < 1e-6 && (r.area_stretch - 1.0).abs() < 1e-6);
        assert_eq!((r.charts, r.chart_distance_px), (1, None));
    }

    #[test]
    fn a_chart_of_half_the_size_stretches_area_only() {
        let (mesh, mut atlas) = two_squares();
        for i in 4..8 {
            let first = atlas.uvs[4];
            atlas.uvs[i] = first + (atlas.uvs[i] - first) / 2.0;
        }
        // 4 and 1 texels for 1 and 1: scaled to the mean 2.5, ratios 1.6 and 0.4; (1.6 + 0.625) /
        // 2 = 1.1125, (0.4 + 2.5) / 2 = 1.45
        let r = uv_check(&mesh, &atlas);
        assert!((r.area_stretch - (1.1125 + 1.45) / 2.0).abs() < 1e-6, "{r:?}");
        assert!((r.angle_stretch_p99 - 1.0).abs() < 1e-6);
    }

    #[test]
    fn planted_faults_are_each_found() {
        let (mesh, atlas) = two_squares();
        // the second chart half over the first: columns 2 to 4, of which 2 to 3, so 2 texels
        let mut a = atlas.clone();
        (4..8).for_each(|i| a.uvs[i].x -= 2.0 / 8.0);
        let r = uv_check(&mesh, &a);
        assert_eq!((r.overlapping, r.flipped, r.chart_distance_px), (4, 0, Some(0.0)));
        assert!((r.overlap_px - 2.0).abs() < 1e-6 && !r.is_sound());
        // a corner pulled through the diagonal: its triangle is flipped and lies on the other one
        let mut a = atlas.clone();
        a.uvs[3] = Vec2::new(2.8, 8.0 - 1.2) / 8.0;
        let r = uv_check(&mesh, &a);
        assert_eq!((r.flipped, r.overlapping), (1, 2));
        // onto the diagonal: no area
        a.uvs[3] = Vec2::new(2.0, 8.0 - 2.0) / 8.0;
        let r = uv_check(&mesh, &a);
        assert_eq!((r.zero_area, r.flipped, r.overlapping), (1, 0, 0));
        // a whole chart the other way round is mirrored, not flipped
        let mut a = atlas.clone();
        (4..8).for_each(|i| a.uvs[i].x = 10.0 / 8.0 - a.uvs[i].x);
        let r = uv_check(&mesh, &a);
        assert_eq!((r.mirrored_charts, r.flipped), (1, 0));
        assert!(r.is_sound());
        let mut a = atlas.clone();
        a.uvs[0].x = -0.25;
        let r = uv_check(&mesh, &a);
        assert_eq!((r.outside, r.border_distance_px), (2, -2.0));
        let mut a = atlas;
        a.uvs[0].x = f32::NAN;
        a.triangles[3][0] = 99;
        a.triangles.push([0, 1, 2]);
        assert_eq!(uv_check(&mesh, &a).invalid, 4); // two with the NaN, the index, the surplus one
    }

    #[test]
    fn vertices_repeated_at_seams_are_one_surface() {
        let (mesh, atlas) = two_squares();
        let apart = Mesh {
            positions: mesh.triangles.iter().flat_map(|t| t.map(|i| mesh.positions[i as usize])).collect(),
            triangles: (0..4).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            ..Mesh::default()
        };
        assert_eq!(uv_check(&apart, &atlas), uv_check(&mesh, &atlas));
    }

    #[test]
    fn seams_that_face_are_within_45_degrees() {
        let (mesh, atlas) = two_squares();
        // one seam of length 1 on an area of 2, looking along +z
        let within = |v: Vec3| seams_facing(&mesh, &atlas, v);
        assert!((within(Vec3::new(0.9, 0.0, 1.0)) - 1.0 / 2f64.sqrt()).abs() < 1e-12);
        assert_eq!([within(Vec3::new(1.1, 0.0, 1.0)), within(-Vec3::Z)], [0.0, 0.0]);
        assert_eq!(uv_check(&Mesh::default(), &Atlas::default()).charts, 0);
    }
}

//! Validation of a mesh. Counts are on vertices welded by equal position, so texture seams do not matter.
//!
//! - closed: every edge in exactly two triangles, oppositely wound;
//! - watertight: closed, and every piece wound outward, except cavities: pieces wound inward that lie inside another;
//! - manifold: no edge in more than two triangles, no vertex with more than one fan;
//! - Euler number `V − E + F`; genus = pieces − Euler/2 for a closed manifold;
//! - self-intersection: an edge that runs from one side of another triangle to the other, through it
//!   or its border, or two triangles of one plane that share area. Sharing a corner or an edge is not
//!   one, nor is resting on another triangle. Signs come from the determinant in f64 with
//!   Shewchuk's error bound (1997); what the bound cannot tell from zero counts as touching.
//! - sliver: quality `4 √3 · area / Σ edge²` below 0.05 (1 for an equilateral triangle).
//!
//! # Texture coordinates
//!
//! Validation and quality of an atlas, for any mesh with texture coordinates, also from other tools.
//!
//! Charts are triangles joined across edges whose two sides have equal uv. With Γ ≥ γ the largest and
//! smallest length that a unit step in the texture has on the surface, both scaled so that texture and
//! surface have the same area in total:
//!
//! - stretch of the atlas: root of the mean of (Γ² + γ²) / 2 over the surface: the L² norm of Sander, Snyder,
//!   Gortler, Hoppe 2001 (*Texture mapping progressive meshes*, §3), as xatlas reports it; 1 is perfect;
//! - area stretch of a triangle: (Γγ + 1 / Γγ) / 2, its angle stretch: (Γ/γ + γ/Γ) / 2 (the parts that Degener,
//!   Meseth, Klein 2003, §3 split it into); 1 is perfect.
//!
//! Texels are square even if the texture is not: all lengths are measured in texels.

use super::file_mesh::places;
use crate::geom::{
    Aabb, Atlas, Boxes, DBox, DEFAULT_EFFORT, Mesh, OutlineSide, Sets, WrongPiece, intersect, nearest_charts,
    overlaps, share_out, shared_area, side_ends, sorted_sides, topology, turn, wrong_pieces,
};
use crate::math::rank::quantile;
use crate::{Error, Result};
use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashMap;
use std::fmt;

/// Triangles worse than this are slivers; an equilateral one has 1.
const SLIVER: f64 = 0.05;

/// Maximum deviation of a normal's length from 1; the Khronos validator's own bound.
const NORMAL_TOLERANCE: f32 = 5e-4;

/// The result of [`check`]. Counts of triangles are of the mesh as given; topology is after welding.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CheckReport {
    /// Vertices as stored.
    pub vertices: usize,
    /// Triangles as stored.
    pub triangles: usize,
    /// Different positions.
    pub welded_vertices: usize,
    /// Triangles with an index out of range or a corner that is not finite; ignored below.
    pub invalid: usize,
    /// Every edge in exactly two triangles, oppositely wound, and nothing invalid.
    pub closed: bool,
    /// Edges with one triangle.
    pub boundary_edges: usize,
    /// Edges with two triangles wound alike.
    pub flipped_edges: usize,
    /// Edges with more than two triangles.
    pub nonmanifold_edges: usize,
    /// Vertices where several fans meet.
    pub nonmanifold_vertices: usize,
    /// No edge with more than two triangles and no vertex with several fans.
    pub manifold: bool,
    /// Connected parts.
    pub pieces: usize,
    /// `V − E + F` of the welded mesh.
    pub euler: i64,
    /// Handles of all pieces together; only for closed manifolds.
    pub genus: Option<i64>,
    /// Triangles that pass through or lie on another.
    pub self_intersections: usize,
    /// Triangles not among them that were not compared with all that lie near them, because too many do: then
    /// their number is a lower bound.
    pub self_intersections_left: usize,
    /// Long thin triangles.
    pub slivers: usize,
    /// Triangles without area.
    pub degenerate: usize,
    /// Lowest corner, in the file's units.
    pub min: [f64; 3],
    /// Highest corner.
    pub max: [f64; 3],
    /// Size of the box in metres.
    pub size_m: [f64; 3],
    /// Enclosed volume in litres, negative when wound inward; an open mesh encloses none.
    pub volume_l: Option<f64>,
    /// Pieces of a closed mesh that are inside out and no cavity of another piece, or that enclose nothing. A piece is what
    /// edges connect.
    pub wrong_pieces: Vec<PieceReport>,
    /// Whether every vertex has a color.
    pub has_colors: bool,
    /// Whether a texture gives the mesh its colors; set by readers, because [`check`] receives only the mesh.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub has_texture: Option<bool>,
    /// Whether every vertex has a normal.
    pub has_normals: bool,
    /// Normals whose length is not 1 within 5e-4.
    pub bad_normals: usize,
    /// The report on its texture coordinates; set by callers of [`uv_check`](super::uv_check()), because [`check`]
    /// sees only the mesh.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub uv: Option<UvReport>,
}

/// A piece of a closed mesh that is wound against the others.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PieceReport {
    /// Triangles of it.
    pub triangles: usize,
    /// Middle of its box, in the file's units.
    pub center: [f64; 3],
    /// Enclosed volume in litres: negative when it is inside out, zero when it encloses nothing.
    pub volume_l: f64,
}

impl PieceReport {
    /// Returns the fault in words.
    fn fault(&self) -> &'static str {
        if self.volume_l < 0.0 { "inside out" } else { "without a volume" }
    }
}

/// Pieces that a sentence names; of more, it states the number.
const NAMED_PIECES: usize = 3;

/// The requirements that [`CheckReport::require`] accepts.
pub const BARS: [&str; 5] = ["watertight", "manifold", "one-piece", "no-self-intersections", "sound-uv"];

impl CheckReport {
    /// Returns whether the mesh is closed and wound outward, but for cavities.
    fn is_watertight(&self) -> bool {
        self.closed && self.wrong_pieces.is_empty()
    }

    /// Returns the pieces that are wound against the others, after a comma.
    fn orientation(&self) -> String {
        match &self.wrong_pieces[..] {
            [whole] if whole.triangles == self.triangles => format!(", {}", whole.fault()),
            wrong => {
                let digits = self.digits();
                let named = wrong.iter().take(NAMED_PIECES).map(|piece| {
                    let PieceReport { triangles, center: [x, y, z], .. } = piece;
                    let fault = piece.fault();
                    format!(
                        ", a piece of {triangles} triangles around ({x:.digits$}, {y:.digits$}, {z:.digits$}) {fault}"
                    )
                });
                let rest = wrong.len().saturating_sub(NAMED_PIECES);
                let rest = (rest > 0).then(|| format!(", and {rest} more"));
                named.chain(rest).collect()
            }
        }
    }

    /// Returns how many decimals show a millionth of the mesh's size.
    fn digits(&self) -> usize {
        let size = (DVec3::from(self.max) - DVec3::from(self.min)).max_element();
        (6.0 - size.log10()).ceil().clamp(0.0, 45.0) as usize
    }

    /// Checks the named bars; see [`BARS`].
    ///
    /// # Errors
    ///
    /// Returns the first bar missed, as [`ErrorKind::BelowBar`](crate::ErrorKind::BelowBar); or an unknown bar, as
    /// [`ErrorKind::Usage`](crate::ErrorKind::Usage).
    pub fn require(&self, bars: &[&str]) -> Result<()> {
        for &bar in bars {
            let (reached, found) = match bar {
                "watertight" => (
                    self.is_watertight(),
                    format!(
                        "{} open edges, {} wound alike, {} in more than two triangles, {} invalid triangles{}",
                        self.boundary_edges,
                        self.flipped_edges,
                        self.nonmanifold_edges,
                        self.invalid,
                        self.orientation()
                    ),
                ),
                "manifold" => (
                    self.manifold,
                    format!(
                        "{} edges in more than two triangles, {} vertices with several fans",
                        self.nonmanifold_edges, self.nonmanifold_vertices
                    ),
                ),
                "one-piece" => (self.pieces == 1, format!("{} pieces", self.pieces)),
                "no-self-intersections" => {
                    let (found, left) = (self.self_intersections, self.self_intersections_left);
                    let (least, rest) = bound("at least ", left, "triangles");
                    (found + left == 0, format!("{least}{found} triangles intersect others{rest}"))
                }
                "sound-uv" => match &self.uv {
                    None => (false, "no texture coordinates".into()),
                    Some(uv) => (uv.is_sound(), uv.faults()),
                },
                _ => {
                    let hint = format!("known are {}", BARS.join(", "));
                    return Err(Error::usage(format!("there is no requirement `{bar}`"), hint));
                }
            };
            if !reached {
                let hint = "`tiface check` without `--require` prints the whole report";
                return Err(Error::below(format!("not {bar}: {found}"), hint));
            }
        }
        Ok(())
    }
}

impl fmt::Display for CheckReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let CheckReport {
            vertices, welded_vertices, triangles, invalid, boundary_edges, flipped_edges, ..
        } = self;
        let CheckReport {
            nonmanifold_edges, nonmanifold_vertices, pieces, euler, slivers, degenerate, ..
        } = self;
        let CheckReport { self_intersections, volume_l, bad_normals, size_m: [x, y, z], .. } = self;
        let yes = |b: bool| if b { "yes" } else { "NO" };
        let [watertight, manifold, normals] =
            [self.is_watertight(), self.manifold, self.has_normals].map(yes);
        let orientation = self.orientation();
        let volume = volume_l.map_or("undefined: the mesh is open".into(), |v| format!("{v:.4} litres"));
        let genus = self.genus.map_or("undefined".into(), |g| g.to_string());
        let (least, left) = bound("at least ", self.self_intersections_left, "triangles");
        let (low, high) = (DVec3::from(self.min), DVec3::from(self.max));
        let digits = self.digits();
        let colors = match (self.has_texture, self.has_colors) {
            (Some(true), true) => "yes, a texture and at the vertices",
            (Some(true), false) => "yes, a texture",
            (_, true) => "yes, at the vertices",
            (Some(false), false) => "NO",
            (None, false) => "NO, not at the vertices",
        };
        write!(
            f,
            "\
vertices             {vertices} ({welded_vertices} after welding)
triangles            {triangles}
watertight           {watertight} ({boundary_edges} open edges, {flipped_edges} wound alike{orientation})
manifold             {manifold} ({nonmanifold_edges} edges, {nonmanifold_vertices} vertices)
pieces               {pieces} (Euler {euler}, genus {genus})
self-intersecting    {least}{self_intersections} triangles{left}
slivers              {slivers} triangles, {degenerate} without area, {invalid} invalid
size                 {x:.4} × {y:.4} × {z:.4} m
box                  {low:.digits$} to {high:.digits$}
volume               {volume}
colors               {colors}
normals              {normals} ({bad_normals} not of unit length)
"
        )
    }
}

/// Examines a mesh whose coordinates are `unit_m` metres each. Never panics, for any mesh.
///
/// # Examples
///
/// ```
/// use glam::Vec3;
/// use tiface::geom::Mesh;
/// use tiface::mesh::files::check;
///
/// let mut tetrahedron = Mesh {
///     positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
///     triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
///     ..Mesh::default()
/// };
/// let report = check(&tetrahedron, 1.0);
/// assert!(report.closed && report.genus == Some(0));
/// assert!(report.require(&["watertight", "one-piece", "no-self-intersections"]).is_ok());
///
/// tetrahedron.triangles.pop();
/// let report = check(&tetrahedron, 1.0);
/// assert_eq!((report.closed, report.boundary_edges, report.genus), (false, 3, None));
/// ```
pub fn check(mesh: &Mesh, unit_m: f64) -> CheckReport {
    check_around(mesh, DVec3::ZERO, unit_m)
}

/// [`check`] of a mesh whose positions are relative to `origin`.
pub fn check_around(mesh: &Mesh, origin: DVec3, unit_m: f64) -> CheckReport {
    let (weld, welded) = places(mesh);
    let valid =
        |t: &[u32; 3]| t.iter().all(|&i| mesh.positions.get(i as usize).is_some_and(|p| p.is_finite()));
    // triangles that remain triangles after welding: their welded corners and their indices
    let (mut faces, mut sources) = (Vec::new(), Vec::new());
    let (mut invalid, mut degenerate, mut slivers, mut volume) = (0, 0, 0, 0.0);
    let mut bounds = Aabb::EMPTY;
    for (i, t) in mesh.triangles.iter().enumerate() {
        if !valid(t) {
            invalid += 1;
            continue;
        }
        let corners = mesh.corners(i as u32);
        bounds = corners.into_iter().fold(bounds, Aabb::with);
        let [a, b, c] = corners.map(|p| p.as_dvec3());
        volume += a.dot(b.cross(c)) / 6.0;
        let area = 0.5 * (b - a).cross(c - a).length();
        let edges = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
        let quality = 4.0 * 3f64.sqrt() * area / edges;
        if quality <= 1e-9 || quality.is_nan() {
            degenerate += 1;
        } else if quality < SLIVER {
            slivers += 1;
        }
        let w = t.map(|i| weld[i as usize]);
        if w[0] != w[1] && w[1] != w[2] && w[2] != w[0] {
            faces.push(w);
            sources.push(i as u32);
        }
    }
    let topology = topology(&welded, &faces);
    let closed = topology.closed && invalid == 0;
    let bad_normal = |n: &&glam::Vec3| (n.length() - 1.0).abs() > NORMAL_TOLERANCE || n.is_nan();
    let [low, high] = [bounds.min, bounds.max].map(|p| if bounds.is_empty() { Vec3::ZERO } else { p });
    let [low, high] = [low, high].map(|p| p.as_dvec3() + origin);
    let count = mesh.positions.len();
    let litres = unit_m.powi(3) * 1000.0;
    let wrong_pieces = if closed { wrong_pieces(&welded, &faces) } else { Vec::new() };
    let reported = |piece: WrongPiece| PieceReport {
        triangles: piece.triangles,
        center: (piece.center + origin).to_array(),
        volume_l: piece.volume * litres,
    };
    let (self_intersections, self_intersections_left) = self_intersections(mesh, &faces, &sources);
    CheckReport {
        vertices: count,
        triangles: mesh.triangles.len(),
        welded_vertices: welded.len(),
        invalid,
        closed,
        boundary_edges: topology.boundary_edges,
        flipped_edges: topology.misoriented_edges,
        nonmanifold_edges: topology.non_manifold_edges,
        nonmanifold_vertices: topology.non_manifold_vertices,
        manifold: topology.manifold,
        pieces: topology.pieces,
        euler: topology.euler,
        genus: topology.genus.filter(|_| closed),
        self_intersections,
        self_intersections_left,
        slivers,
        degenerate,
        min: low.to_array(),
        max: high.to_array(),
        size_m: ((high - low) * unit_m).to_array(),
        volume_l: closed.then_some(volume * litres),
        wrong_pieces: wrong_pieces.into_iter().map(reported).collect(),
        has_colors: count > 0 && mesh.colors.len() == count,
        has_texture: None,
        has_normals: count > 0 && mesh.normals.len() == count,
        bad_normals: mesh.normals.iter().filter(bad_normal).count(),
        uv: None,
    }
}

/// Cost of comparing two triangles, in comparisons of boxes.
const TRIANGLE_TEST_COST: usize = 16;

/// Returns how many triangles pass through or lie on another one, and how many others were not compared with all
/// candidates.
fn self_intersections(mesh: &Mesh, faces: &[[u32; 3]], sources: &[u32]) -> (usize, usize) {
    // Triangles over the same corners lie on each other, so one of them stands for all: a shape that is repeated in
    // one place costs no more than a single one.
    let mut sorted: Vec<([u32; 3], u32)> = (0..faces.len() as u32)
        .into_par_iter()
        .filter_map(|f| {
            let mut ids = faces[f as usize];
            let [a, b, c] = mesh.corners(sources[f as usize]).map(|p| p.as_dvec3());
            ids.sort_unstable();
            ((b - a).cross(c - a) != DVec3::ZERO).then_some((ids, f))
        })
        .collect();
    sorted.par_sort_unstable();
    let mut found = 0;
    let (mut facets, mut alone) = (Vec::new(), Vec::new());
    for copies in sorted.chunk_by(|a, b| a.0 == b.0) {
        let face = copies[0].1 as usize;
        if copies.len() > 1 {
            found += copies.len();
        } else {
            alone.push(facets.len());
        }
        facets.push((mesh.corners(sources[face]).map(|p| p.as_dvec3()), faces[face]));
    }
    let boxes = Boxes::new(facets.iter().map(|f| DBox::around(f.0)));
    let shared = share_out(alone.len(), DEFAULT_EFFORT, |i, effort| {
        let (own, mut meets) = (alone[i], false);
        let (p, ids) = facets[own];
        boxes.meeting(&DBox::around(p), effort, |other, effort| {
            let (q, other_ids) = facets[other as usize];
            if other as usize != own {
                if !effort.spend(TRIANGLE_TEST_COST) {
                    return false;
                }
                meets = intersect(p, ids, q, other_ids);
            }
            !meets
        });
        meets
    });
    found += shared.found.iter().filter(|&&meets| meets).count();
    (found, shared.unfinished.len())
}

/// Triangles below this area, in texels, count as having none: rounding decides their shape.
pub const MIN_AREA_PX: f64 = 1e-6;

/// The result of [`uv_check`].
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct UvReport {
    /// Triangles of the mesh.
    pub triangles: usize,
    /// Triangles with an index out of range, or a corner or coordinate that is not finite; ignored below.
    /// One for each triangle that only the mesh or only the atlas has, too.
    pub invalid: usize,
    /// Flat patches.
    pub charts: usize,
    /// Length on the surface of the edges along which the texture is cut, each counted once, over √area.
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
    /// Triangles that were not compared with all that lie near them, because too many do: then the two above
    /// are lower bounds.
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
    /// Sides of charts that were not compared with all that lie near them: then the distance is an upper bound.
    pub chart_distance_left: usize,
    /// Smallest distance of a chart to the texture's border, in texels; negative when it reaches out.
    pub border_distance_px: f64,
}

impl UvReport {
    /// Charts farther apart than this are not measured.
    pub const MAX_CHART_DISTANCE_PX: f64 = 128.0;

    /// Returns whether every point of the surface has its own texel: no triangle is invalid, overlapping, flipped,
    /// without area or outside.
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

/// Returns the text before and after a figure that is a bound because `left` candidates were not compared.
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

    let joined = Joined::of(mesh, atlas, &valid);
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

/// Returns the length of the seams visible from `front` within 45 degrees, over √area: edges whose two triangles
/// together face that direction, hidden or not.
pub fn seams_facing(mesh: &Mesh, atlas: &Atlas, front: Vec3) -> f64 {
    let valid: Vec<bool> =
        (0..mesh.triangles.len().min(atlas.triangles.len())).map(|t| is_valid(mesh, atlas, t)).collect();
    let joined = Joined::of(mesh, atlas, &valid);
    let normal = |c: u32| {
        let [a, b, c] = mesh.corners(c / 3);
        (b - a).cross(c - a).normalize_or_zero()
    };
    let faces =
        |n: Vec3| n.normalize_or_zero().dot(front.normalize_or_zero()) > std::f32::consts::FRAC_1_SQRT_2;
    joined.seam_length(|a, b| faces(normal(a) + normal(b)))
}

/// Charts of an atlas: the triangles that the texture joins.
struct Joined {
    /// The lowest triangle of each triangle's chart.
    chart: Vec<u32>,
    /// Sides that border on no triangle of the chart: `3 t + k` for the side from corner k of triangle t.
    rims: Vec<u32>,
    /// Edges of the surface where its texture is cut: the two sides and the length.
    cuts: Vec<(u32, u32, f64)>,
    /// Area of the surface.
    surface: f64,
}

impl Joined {
    /// Returns the length of the cuts between those sides, over √area.
    fn seam_length(&self, between: impl Fn(u32, u32) -> bool) -> f64 {
        let kept = self.cuts.iter().filter(|(a, b, _)| between(*a, *b));
        let length = kept.fold(0.0, |sum, cut| sum + cut.2);
        if self.surface > 0.0 { length / self.surface.sqrt() } else { 0.0 }
    }

    fn of(mesh: &Mesh, atlas: &Atlas, valid: &[bool]) -> Joined {
        let (weld, _) = places(mesh);
        let welded = |i: u32| weld.get(i as usize).copied().unwrap_or(0); // any value for invalid triangles
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
        Joined { chart: (0..valid.len() as u32).map(|t| sets.find(t)).collect(), rims, cuts, surface }
    }
}

fn twice_area(mesh: &Mesh, t: usize) -> f64 {
    let [a, b, c] = mesh.corners(t as u32).map(|p| p.as_dvec3());
    (b - a).cross(c - a).length()
}

fn stretches(report: &mut UvReport, triangles: &[([DVec3; 3], [DVec2; 3])]) {
    // (area on the surface, area in the texture, Γ² + γ²), before scaling; slivers without area have none
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
    use crate::ErrorKind;

    /// Returns a box from `low` to `high`, wound outward.
    fn cuboid(low: Vec3, high: Vec3) -> Mesh {
        let at = |i: u32| Vec3::from([0, 1, 2].map(|k| if i >> k & 1 == 1 { high[k] } else { low[k] }));
        let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        Mesh {
            positions: (0..8).map(at).collect(),
            triangles: quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect(),
            ..Mesh::default()
        }
    }

    fn both(mut a: Mesh, b: Mesh) -> Mesh {
        let first = a.positions.len() as u32;
        a.positions.extend(b.positions);
        a.triangles.extend(b.triangles.iter().map(|t| t.map(|i| i + first)));
        a
    }

    #[test]
    fn a_box_is_sound() {
        // 2 × 3 × 4 dm: 24 litres; V − E + F = 8 − 18 + 12 = 2
        let r = check(&cuboid(Vec3::ZERO, Vec3::new(2.0, 3.0, 4.0)), 0.1);
        assert!(r.closed && r.manifold);
        assert_eq!((r.pieces, r.euler, r.genus), (1, 2, Some(0)));
        assert!((r.volume_l.unwrap() - 24.0).abs() < 1e-9);
        assert!((r.size_m[2] - 0.4).abs() < 1e-12);
        assert_eq!((r.self_intersections, r.slivers, r.degenerate), (0, 0, 0));
        assert_eq!(r.require(&BARS[..4]), Ok(()));
        // its texture coordinates have not been measured
        assert!(r.require(&["sound-uv"]).is_err());
        assert!(r.to_string().contains("watertight           yes"));
    }

    #[test]
    fn a_texture_seam_does_not_open_a_mesh() {
        let whole = cuboid(Vec3::ZERO, Vec3::ONE);
        let split = Mesh {
            positions: whole.triangles.iter().flat_map(|t| t.map(|i| whole.positions[i as usize])).collect(),
            triangles: (0..12).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            ..Mesh::default()
        };
        let r = check(&split, 1.0);
        assert_eq!((r.vertices, r.welded_vertices, r.closed, r.euler), (36, 8, true, 2));
    }

    #[test]
    fn holes_turned_faces_and_third_faces_are_told_apart() {
        let mut m = cuboid(Vec3::ZERO, Vec3::ONE);
        m.triangles.pop();
        let r = check(&m, 1.0);
        assert_eq!((r.boundary_edges, r.closed, r.manifold, r.genus), (3, false, true, None));
        let missed = r.require(&["manifold", "watertight"]).unwrap_err();
        assert!(
            missed.kind() == ErrorKind::BelowBar && missed.to_string().starts_with("not watertight: 3 open")
        );
        let mut m = cuboid(Vec3::ZERO, Vec3::ONE);
        m.triangles[0].swap(0, 1);
        let r = check(&m, 1.0);
        assert_eq!((r.flipped_edges, r.closed), (3, false));
        let mut m = cuboid(Vec3::ZERO, Vec3::ONE);
        m.positions.push(Vec3::new(3.0, -1.0, 0.5));
        m.triangles.push([0, 1, 8]);
        let r = check(&m, 1.0);
        assert_eq!((r.nonmanifold_edges, r.boundary_edges, r.manifold), (1, 2, false));
    }

    #[test]
    fn an_inside_out_mesh_is_not_watertight() {
        let mut m = cuboid(Vec3::ZERO, Vec3::ONE);
        m.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        let r = check(&m, 1.0);
        assert!(r.closed && r.volume_l.unwrap() < 0.0);
        let missed = r.require(&["watertight"]).unwrap_err();
        assert!(
            missed.kind() == ErrorKind::BelowBar && missed.to_string().ends_with("inside out"),
            "{missed}"
        );
        assert!(r.to_string().contains("watertight           NO (0 open edges, 0 wound alike, inside out)"));
        // a hollow in a box is wound towards the box's outside, and as it should be
        let hollow = both(cuboid(Vec3::splat(-1.0), Vec3::splat(2.0)), m);
        assert_eq!(check(&hollow, 1.0).require(&["watertight"]), Ok(()));
    }

    #[test]
    fn a_piece_turned_inside_out_beside_another_is_not_watertight() {
        let whole = cuboid(Vec3::splat(-1.0), Vec3::ONE);
        let mut turned = cuboid(Vec3::new(2.0, -0.5, -0.5), Vec3::new(3.0, 0.5, 0.5));
        turned.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        let r = check(&both(whole.clone(), turned), 1.0);
        // 8 m³ − 1 m³: the volume of all does not show it
        assert!(r.closed && r.volume_l.is_some_and(|v| v > 0.0));
        let expected = PieceReport { triangles: 12, center: [2.5, 0.0, 0.0], volume_l: -1000.0 };
        assert_eq!(r.wrong_pieces, [expected]);
        let missed = r.require(&["watertight"]).unwrap_err();
        let named = "a piece of 12 triangles around (2.500000, 0.000000, 0.000000) inside out";
        assert!(missed.kind() == ErrorKind::BelowBar && missed.to_string().contains(named), "{missed}");
        assert!(r.to_string().contains("watertight           NO"), "{r}");
        // one that touches the other at a vertex, where they are welded
        let mut touching = cuboid(Vec3::ONE, Vec3::splat(2.0));
        let sound = check(&both(whole.clone(), touching.clone()), 1.0);
        assert_eq!((sound.pieces, sound.require(&["watertight"])), (1, Ok(())));
        touching.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        assert!(check(&both(whole, touching), 1.0).require(&["watertight"]).is_err());
    }

    #[test]
    fn both_sides_of_a_flat_sheet_are_not_watertight() {
        let m = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            triangles: vec![[0, 1, 2], [0, 2, 1]],
            ..Mesh::default()
        };
        let r = check(&m, 1.0);
        let missed = r.require(&["watertight"]).unwrap_err();
        assert!(r.closed && missed.to_string().ends_with(", without a volume"), "{missed}");
    }

    #[test]
    fn an_open_mesh_has_no_volume_wherever_it_lies() {
        for away in [0.0, 10.0] {
            let mut m = cuboid(Vec3::splat(away), Vec3::splat(away + 1.0));
            m.triangles.pop();
            let r = check(&m, 1.0);
            assert_eq!(r.volume_l, None);
            assert!(r.to_string().contains("volume               undefined: the mesh is open"), "{r}");
        }
    }

    #[test]
    fn the_ends_of_an_edge_of_three_triangles_are_not_manifold() {
        let m = Mesh {
            positions: vec![Vec3::ZERO, Vec3::Z, Vec3::X, Vec3::Y, -Vec3::X],
            triangles: vec![[0, 1, 2], [0, 1, 3], [0, 1, 4]],
            ..Mesh::default()
        };
        // nothing says which two of the three go on into each other: each is a fan of its own at both ends
        let r = check(&m, 1.0);
        assert_eq!((r.nonmanifold_edges, r.nonmanifold_vertices, r.boundary_edges), (1, 2, 6));
    }

    #[test]
    fn two_boxes_touching_at_a_corner_are_closed_but_not_manifold() {
        let m = both(cuboid(Vec3::ZERO, Vec3::ONE), cuboid(Vec3::ONE, Vec3::splat(2.0)));
        let r = check(&m, 1.0);
        assert_eq!((r.closed, r.nonmanifold_vertices, r.pieces, r.self_intersections), (true, 1, 1, 0));
    }

    #[test]
    fn boxes_side_by_side_do_not_intersect_and_overlapping_ones_do() {
        let first = cuboid(Vec3::ZERO, Vec3::ONE);
        let apart = both(first.clone(), cuboid(Vec3::new(2.0, 0.0, 0.0), Vec3::new(3.0, 1.0, 1.0)));
        let r = check(&apart, 1.0);
        assert_eq!((r.pieces, r.self_intersections, r.genus), (2, 0, Some(0)));
        assert!(r.require(&["one-piece"]).is_err());
        // a corner at (0.7, 0.6, 0.4) inside the first box
        let through = both(first.clone(), cuboid(Vec3::new(0.7, 0.6, 0.4), Vec3::new(1.9, 1.8, 1.7)));
        assert!(check(&through, 1.0).self_intersections >= 6);
        // a common wall with other diagonals and corners: the walls overlap in one plane
        let flush = both(first, cuboid(Vec3::new(1.0, 0.2, 0.2), Vec3::new(2.0, 0.8, 0.8)));
        assert!(check(&flush, 1.0).self_intersections >= 4);
    }

    #[test]
    fn folded_and_repeated_triangles_lie_on_each_other() {
        let mut m = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.5, 1.0, 0.0), Vec3::new(0.5, 0.5, 0.0)],
            triangles: vec![[0, 1, 2], [1, 0, 3]], // both on the same side of their edge
            ..Mesh::default()
        };
        assert_eq!(check(&m, 1.0).self_intersections, 2);
        m.positions[3].z = 0.1; // a sharp fold, but a fold
        assert_eq!(check(&m, 1.0).self_intersections, 0);
        m.triangles[1] = [2, 0, 1];
        assert_eq!(check(&m, 1.0).self_intersections, 2);
    }

    #[test]
    fn triangles_sharing_one_corner_may_pierce_each_other() {
        let m = Mesh {
            positions: vec![
                Vec3::ZERO,
                Vec3::new(2.0, -1.0, 0.0),
                Vec3::new(2.0, 1.0, 0.0),
                Vec3::new(1.0, 0.0, -1.0),
                Vec3::new(1.0, 0.0, 1.0),
            ],
            triangles: vec![[0, 1, 2], [0, 3, 4]],
            ..Mesh::default()
        };
        assert_eq!(check(&m, 1.0).self_intersections, 2);
    }

    #[test]
    fn slivers_and_flat_triangles_are_counted() {
        let m = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.5, 0.01, 0.0), Vec3::new(2.0, 0.0, 0.0)],
            // quality 4√3·0.005/1.5 = 0.023; then three points on a line; then one point twice
            triangles: vec![[0, 1, 2], [0, 1, 3], [0, 0, 1]],
            ..Mesh::default()
        };
        let r = check(&m, 1.0);
        assert_eq!((r.slivers, r.degenerate), (1, 2));
    }

    #[test]
    fn rubbish_is_reported_not_followed() {
        let m = Mesh {
            positions: vec![Vec3::NAN, Vec3::splat(3e38), Vec3::splat(-3e38), Vec3::X],
            normals: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::NAN],
            triangles: vec![[0, 1, 2], [7, 8, 9], [1, 2, 3]],
            ..Mesh::default()
        };
        let r = check(&m, 1.0);
        assert_eq!((r.invalid, r.closed, r.bad_normals), (2, false, 2));
        assert_eq!(check(&Mesh::default(), 1.0).pieces, 0);
        let unknown = r.require(&["shiny"]).unwrap_err();
        assert!(unknown.kind() == ErrorKind::Usage && unknown.hint().contains("one-piece"), "{unknown}");
    }
}

#[cfg(test)]
mod uv_tests {
    use super::*;

    /// Two unit squares of two triangles each, side by side in space; in the texture of 8 × 8 texels at
    /// (1, 1)..(3, 3) and, as a chart of its own, at (4, 1)..(6, 3).
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
        // 1 × 1 on 4 × 2 texels: steps on the surface are 1/4 and 1/2, times √8 to have equal areas: 0.707
        // and 1.414. L² = √((0.5 + 2) / 2) = 1.118; angle (2 + 1/2) / 2 = 1.25; area 1.
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
        // 4 and 1 texels for 1 and 1: scaled to the mean 2.5, ratios 1.6 and 0.4; (1.6 + 0.625) / 2 = 1.1125,
        // (0.4 + 2.5) / 2 = 1.45
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

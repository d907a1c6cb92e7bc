//! The result of [`check`](super::check()), its text, and the requirements of
//! `tiface check --require`.

use super::uv_check::{UvReport, bound};
use glam::DVec3;
use serde::Serialize;
use std::fmt;
use tiface_base::{Error, Result};

/// The result of [`check`](super::check()). Counts of triangles are of the mesh as given; topology
/// is after welding.
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
    /// Triangles not among them that were not compared with all that lie near them, because too
    /// many do: then their number is a lower bound.
    pub self_intersections_left: usize,
    /// Long thin triangles.
    pub slivers: usize,
    /// Triangles without area.
    pub degenerate: usize,
    /// Lowest corner, in the file's units.
    pub min: [f64; 3],
    /// Highest corner.
    pub max: [f64; 3],
    /// Size of the box in meters.
    pub size_m: [f64; 3],
    /// Enclosed volume in liters, negative when wound inward; an open mesh encloses none.
    pub volume_l: Option<f64>,
    /// Pieces of a closed mesh that are inside out and no cavity of another piece, or that enclose
    /// nothing. A piece is what edges connect.
    pub wrong_pieces: Vec<PieceReport>,
    /// Whether every vertex has a color.
    pub has_colors: bool,
    /// Whether a texture gives the mesh its colors; set by readers, because
    /// [`check`](super::check()) receives only the mesh.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub has_texture: Option<bool>,
    /// Whether every vertex has a normal.
    pub has_normals: bool,
    /// Normals whose length is not 1 within 5e-4.
    pub bad_normals: usize,
    /// The report on its texture coordinates; set by callers of [`uv_check`](super::uv_check()),
    /// because [`check`](super::check()) sees only the mesh.
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
    /// Enclosed volume in liters: negative when it is inside out, zero when it encloses nothing.
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
pub const REQUIREMENTS: [&str; 5] =
    ["watertight", "manifold", "one-piece", "no-self-intersections", "sound-uv"];

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

    /// Checks the named requirements; see [`REQUIREMENTS`].
    ///
    /// # Errors
    ///
    /// Returns the first requirement missed, as
    /// [`ErrorKind::BelowBar`](tiface_base::ErrorKind::BelowBar); or an unknown requirement, as
    /// [`ErrorKind::Usage`](tiface_base::ErrorKind::Usage).
    pub fn require(&self, requirements: &[&str]) -> Result<()> {
        for &requirement in requirements {
            let (reached, found) = match requirement {
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
                    let hint = format!("known are {}", REQUIREMENTS.join(", "));
                    return Err(Error::usage(format!("there is no requirement `{requirement}`"), hint));
                }
            };
            if !reached {
                let hint = "the whole report says more";
                return Err(Error::below(format!("not {requirement}: {found}"), hint));
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
        let volume = volume_l.map_or("undefined: the mesh is open".into(), |v| format!("{v:.4} liters"));
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

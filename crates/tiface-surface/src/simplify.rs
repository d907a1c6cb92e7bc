//! Fewer triangles for the same surface: edge collapse by quadrics, checked against the field
//! itself.
//!
//! Garland, Heckbert 1997 with the memoryless quadrics of Lindstrom, Turk 1998; see `quadric`.
//! Every collapse keeps the link condition, turns no triangle by more than 60° and leaves none
//! thinner than the thinnest it found, so a closed manifold stays one, of the same genus.
//!
//! The field is a network: thousands of points a call are cheap, single ones are not. So it is
//! evaluated between rounds of collapses: at the vertices and in the middles of triangles, in one
//! batch each (`rounds`). Vertices go to its zero, or where their triangles lie nearest to it; from
//! these positions the next round measures its planes. With an error to keep, a batch at the
//! middles of triangles and edges tells how much each place may still give.
//!
//! Nearest is the default, since it is what accuracy means: a head of 202,276 triangles, itself
//! 0.0155 512ths of the cube off, has a mean error of 0.0199 in 40,000 triangles without the field,
//! 0.0257 with all vertices on its zero (chords lie on one side of a curve), and 0.0090 where they
//! are nearest (`cargo bench --bench simplify`).
//!
//! Self-intersections are searched once, at the end, which costs a tenth of the collapses. If the
//! mesh has any, the work starts over, and every collapse checks for crossings (`crossing`), at
//! seven times the cost. So none is made, and those of the input do not become more.

mod collapse;
mod crossing;
mod quadric;
mod rings;
mod rounds;
mod to_field;

pub(crate) use crossing::without_crossings;

use crate::{Warning, check_count, check_indices, finite, setting};
use crossing::crossings;
use rounds::{bounded, counted};
use serde::{Deserialize, Serialize};
use std::time::Instant;
use tiface_base::geom::{Mesh, SdfField};
use tiface_base::{Monitor, Result};

/// The data shared by all rounds.
#[derive(Clone, Copy)]
struct Task<'a> {
    field: Option<&'a dyn SdfField>,
    config: &'a SimplifyConfig,
    /// Whether collapses are tested for crossings.
    apart: bool,
    monitor: &'a dyn Monitor,
}

/// Simplifies a mesh in place to `config.triangles` or to `config.error`, whichever comes first;
/// colors follow their vertices. A mesh that has no more triangles than `config.triangles` stays as
/// it is.
///
/// With a field, vertices end where the triangles lie nearest to its zero set (with an `error` to
/// keep: on it) and normals are its gradient; without it, or where the gradient is shorter than
/// 1e-6, normals are angle-weighted. Without it the `error` is kept by adding up how far each
/// collapse strays from the planes before it, which is cautious.
///
/// Topology never changes; borders stay borders. Vertices of edges with more than two triangles, or
/// of several fans, are not touched. The same bytes for any number of threads.
///
/// ```
/// use glam::Vec3;
/// use tiface_surface::{SimplifyConfig, Volume, marching, simplify};
///
/// // the distance to a ball at 32³ nodes
/// let at = |i: usize| i as f32 - 15.5;
/// let distance = |i: usize| Vec3::new(at(i % 32), at(i / 32 % 32), at(i / 1024)).length() - 12.0;
/// let values: Vec<f32> = (0..32 * 32 * 32).map(distance).collect();
/// let volume = Volume { dims: [32; 3], values: &values, origin: Vec3::ZERO, spacing: Vec3::ONE };
/// let mut mesh = marching(&volume, true)?.mesh;
/// let config = SimplifyConfig { triangles: 500, ..SimplifyConfig::default() };
/// simplify(&mut mesh, None, &config, &tiface_base::Quiet)?;
/// assert!(mesh.triangles.len() <= 500 && mesh.is_closed());
/// # Ok::<(), tiface_base::Error>(())
/// ```
///
/// # Errors
///
/// A setting out of range, a mesh with a coordinate that is not finite or an index out of range, a
/// field that returns the wrong number of values, a request to stop. The mesh is then as it was.
pub fn simplify(
    mesh: &mut Mesh,
    field: Option<&dyn SdfField>,
    config: &SimplifyConfig,
    monitor: &dyn Monitor,
) -> Result<SimplifyReport> {
    let begin = Instant::now();
    config.check()?;
    finite(mesh)?;
    check_indices(mesh)?;
    let (importance, vertices) = (config.importance.len(), mesh.positions.len());
    let each = importance == 0 || importance == vertices;
    setting(each, "SimplifyConfig::importance", "empty, or of one number a vertex", importance)?;
    // corners are numbered by 32 bits, and rings grow in their pool
    check_count(mesh.positions.len() as u64, 16 * mesh.triangles.len() as u64)?;
    let before = mesh.triangles.len();
    let mut report = SimplifyReport { before, after: before, ..SimplifyReport::default() };
    if before == 0 || config.triangles >= before {
        return Ok(report);
    }

    let mut out = Mesh::default();
    // the second attempt checks for crossings at every collapse
    for apart in [false, true] {
        let again = usize::from(apart);
        report = SimplifyReport { before, again, asked: report.asked, ..SimplifyReport::default() };
        let task = Task { field, config, apart, monitor };
        out = if config.error > 0.0 {
            bounded(mesh, &task, &mut report)?
        } else {
            counted(mesh, &task, &mut report)?
        };
        report.self_intersections = crossings(&out.positions, &out.triangles).len();
        let original = || crossings(&mesh.positions, &mesh.triangles).len();
        if report.self_intersections == 0 || report.self_intersections <= original() {
            break;
        }
    }
    if field.is_none() && !mesh.normals.is_empty() {
        out.normals = out.angle_weighted_normals();
    }
    *mesh = out;
    report.after = mesh.triangles.len();
    report.seconds = begin.elapsed().as_secs_f64();
    Ok(report)
}

/// Options of simplification.
#[derive(Clone, Debug, PartialEq)]
pub struct SimplifyConfig {
    /// Number of triangles to keep; 0 for as few as `error` allows.
    pub triangles: usize,
    /// Maximum distance from the surface, in units of the positions; 0 if only `triangles` limits
    /// the simplification.
    pub error: f32,
    /// Factor of the cost of changes around each vertex, above 0, if only `triangles` limits the
    /// simplification; empty for 1 everywhere.
    pub importance: Vec<f32>,
}

impl Default for SimplifyConfig {
    fn default() -> SimplifyConfig {
        SimplifyConfig { triangles: 200_000, error: 0.0, importance: Vec::new() }
    }
}

impl SimplifyConfig {
    fn check(&self) -> Result<()> {
        setting(
            self.error >= 0.0 && self.error.is_finite(),
            "SimplifyConfig::error",
            "0 or more",
            self.error,
        )?;
        setting(
            self.triangles > 0 || self.error > 0.0,
            "SimplifyConfig::triangles",
            "at least 1, or an `error`",
            0,
        )?;
        let wrong = self.importance.iter().find(|factor| !(**factor > 0.0 && factor.is_finite()));
        setting(wrong.is_none(), "SimplifyConfig::importance", "above 0", wrong.copied().unwrap_or(0.0))
    }
}

/// The result of [`simplify`](super::simplify).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SimplifyReport {
    /// Triangles given.
    pub before: usize,
    /// Triangles left.
    pub after: usize,
    /// Edges collapsed in the attempt that counts.
    pub collapses: usize,
    /// Collapses refused because of topology, turned or thin triangles.
    pub refused: usize,
    /// Collapses refused because triangles would have met.
    pub crossing: usize,
    /// Vertices where the input is not a manifold; they stayed.
    pub held: usize,
    /// Triangles with a repeated vertex, left out.
    pub degenerate: usize,
    /// Vertices that moved less than the field wanted, because a triangle would have been spoiled.
    pub held_back: usize,
    /// Points at which the field was evaluated.
    pub asked: usize,
    /// Number of restarts because of self-intersections.
    pub again: usize,
    /// Triangles that meet others in the result; not more than in the input.
    pub self_intersections: usize,
    /// Largest distance from the surface at corners, middles of edges and triangles; measured only
    /// with a field and an `error`, in units of the positions.
    pub worst: Option<f32>,
    /// Wall time.
    pub seconds: f64,
}

impl SimplifyReport {
    /// Returns what is doubtful of the result.
    pub fn warnings(&self, config: &SimplifyConfig) -> Vec<Warning> {
        let (left, asked) = (self.after, config.triangles);
        [
            (asked > 0 && left > asked && config.error == 0.0)
                .then_some(Warning::TooManyTriangles { left, asked }),
            (self.held > 0).then_some(Warning::NotManifold(self.held)),
            (self.self_intersections > 0).then_some(Warning::Crossing(self.self_intersections)),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

#[cfg(test)]
mod tests;

//! How far to simplify, and what was done.

use crate::Result;
use crate::mesh::input::setting;
use serde::{Deserialize, Serialize};

/// Where vertices lie in the end, when there is a field.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum VertexPlacement {
    /// On the field's zero. Between them the triangles are chords.
    OnSurface,
    /// Where the triangles are nearest to the zero, in the least-squares sense.
    #[default]
    Nearest,
}

/// How far to simplify.
#[derive(Clone, Debug, PartialEq)]
pub struct SimplifyConfig {
    /// Triangles to keep; 0 goes as far as `error` lets it.
    pub triangles: usize,
    /// Most distance from the surface, in units of the positions; 0 goes as far as `triangles` says.
    pub error: f32,
    /// Where vertices lie in the end; with an `error` always on the zero.
    pub placement: VertexPlacement,
    /// Most points in one call of the field; at least 1.
    pub batch: usize,
}

impl Default for SimplifyConfig {
    fn default() -> SimplifyConfig {
        SimplifyConfig {
            triangles: 200_000,
            error: 0.0,
            placement: VertexPlacement::default(),
            batch: 1 << 16,
        }
    }
}

impl SimplifyConfig {
    pub(super) fn check(&self) -> Result<()> {
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
        setting(self.batch > 0, "SimplifyConfig::batch", "at least 1", 0)
    }
}

/// What [`simplify`](super::simplify) did.
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
    /// How often the work began anew because of self-intersections.
    pub again: usize,
    /// Triangles that meet others in the result; not more than in the input.
    pub self_intersections: usize,
    /// Largest distance from the surface at corners, middles of edges and triangles; measured only with
    /// a field and an `error`, in units of the positions.
    pub worst: Option<f32>,
    /// Wall time.
    pub seconds: f64,
}

impl SimplifyReport {
    /// Returns what a person should know, one sentence each.
    pub fn warnings(&self, config: &SimplifyConfig) -> Vec<String> {
        let mut out = Vec::new();
        if config.triangles > 0 && self.after > config.triangles && config.error == 0.0 {
            out.push(format!(
                "{} triangles are left instead of {}: fewer would change the topology, fold the surface or make it cross itself",
                self.after, config.triangles
            ));
        }
        if self.held > 0 {
            out.push(format!("{} vertices are not manifold and stayed as they are", self.held));
        }
        if self.self_intersections > 0 {
            out.push(format!("{} triangles cross others, as in the input", self.self_intersections));
        }
        out
    }
}

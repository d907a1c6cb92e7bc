//! Weights that change smoothly over the head: given at the nodes of a coarse grid of the scene,
//! between them by trilinear interpolation.
//!
//! `w_k(p) = Σ_n φ_n(p) · w_nk`, φ the tents of the grid, `Σ_n φ_n = 1`. Where every node's weights
//! are shares with sum 1, so are those of every point.

use super::EnsembleError;
use super::members::normalised;
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// Nodes along an axis: one for every quarter of the head's box.
pub const NODES: usize = 5;

/// The most nodes along an axis.
pub const MAX_NODES: usize = 16;

/// Weights at the nodes of a grid over the scene box [-1, 1]³, and for pixels without a point.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written")]
pub struct RegionWeights {
    nodes: usize,
    global: Vec<f32>,
    /// `[nodes³][members]`, x runs fastest, then y.
    weights: Vec<Vec<f32>>,
}

/// As it lies in a file, before it is checked.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    nodes: usize,
    global: Vec<f32>,
    weights: Vec<Vec<f32>>,
}

impl TryFrom<Written> for RegionWeights {
    type Error = EnsembleError;

    fn try_from(w: Written) -> Result<RegionWeights, EnsembleError> {
        RegionWeights::new(w.nodes, w.global, w.weights)
    }
}

impl RegionWeights {
    /// Checks that every node has one share for each member. `weights`: `[nodes³][members]`, x runs
    /// fastest; nodes lie at −1, …, 1 along every axis.
    pub fn new(
        nodes: usize,
        global: Vec<f32>,
        weights: Vec<Vec<f32>>,
    ) -> Result<RegionWeights, EnsembleError> {
        let expected = Grid::new(nodes)?.count();
        if weights.len() != expected {
            return Err(EnsembleError::NodeCount { found: weights.len(), expected });
        }
        if global.is_empty() {
            return Err(EnsembleError::NoMembers);
        }
        let global = normalised(&global, global.len())?;
        let weights: Result<_, _> = weights.iter().map(|w| normalised(w, global.len())).collect();
        Ok(RegionWeights { nodes, weights: weights?, global })
    }

    /// How many members.
    pub fn members(&self) -> usize {
        self.global.len()
    }

    /// For pixels without a point.
    pub fn global(&self) -> &[f32] {
        &self.global
    }

    /// The weights at a point in scene coordinates, shares with sum 1.
    ///
    /// Points beyond the box have those of its nearest point, points that are not finite the global
    /// ones.
    pub fn at(&self, point: Vec3) -> Vec<f32> {
        let mut out = vec![0.0; self.members()];
        self.write_at(point, &mut out);
        out
    }

    /// [`RegionWeights::at`] without memory of its own. `out`: `[members]`.
    pub(super) fn write_at(&self, point: Vec3, out: &mut [f32]) {
        let grid = Grid { nodes: self.nodes };
        let Some((cell, tents)) = grid.locate(point) else { return out.copy_from_slice(&self.global) };
        out.fill(0.0);
        for (corner, tent) in tents.iter().enumerate() {
            let node = &self.weights[grid.node(cell, corner)];
            out.iter_mut().zip(node).for_each(|(o, w)| *o += *tent as f32 * w);
        }
    }

    pub(super) fn grid(&self) -> Grid {
        Grid { nodes: self.nodes }
    }

    pub(super) fn node(&self, n: usize) -> &[f32] {
        &self.weights[n]
    }
}

/// Nodes over [-1, 1]³ and the cells between them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Grid {
    nodes: usize,
}

impl Grid {
    pub fn new(nodes: usize) -> Result<Grid, EnsembleError> {
        if (2..=MAX_NODES).contains(&nodes) {
            Ok(Grid { nodes })
        } else {
            Err(EnsembleError::Nodes { found: nodes })
        }
    }

    /// Along an axis.
    pub fn nodes(self) -> usize {
        self.nodes
    }

    /// Of nodes.
    pub fn count(self) -> usize {
        self.nodes.pow(3)
    }

    pub fn cells(self) -> usize {
        (self.nodes - 1).pow(3)
    }

    /// The node at one of a cell's 8 corners: bit 0 of `corner` is x, bit 1 y, bit 2 z.
    pub fn node(self, cell: usize, corner: usize) -> usize {
        let c = self.nodes - 1;
        let [x, y, z] = [cell % c, cell / c % c, cell / (c * c)];
        self.at(x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2))
    }

    pub fn at(self, x: usize, y: usize, z: usize) -> usize {
        x + self.nodes * (y + self.nodes * z)
    }

    /// The nodes beside a node along the axes, 3 to 6 of them.
    pub fn beside(self, n: usize) -> impl Iterator<Item = usize> {
        let strides = [1, self.nodes, self.nodes * self.nodes];
        strides.into_iter().flat_map(move |stride| {
            let place = n / stride % self.nodes;
            let before = (place > 0).then(|| n - stride);
            let after = (place + 1 < self.nodes).then(|| n + stride);
            [before, after].into_iter().flatten()
        })
    }

    /// The cell of a point and the tents of its corners, which have sum 1.
    #[inline]
    pub fn locate(self, point: Vec3) -> Option<(usize, [f64; 8])> {
        if !point.is_finite() {
            return None;
        }
        let c = self.nodes - 1;
        let mut cell = [0usize; 3];
        let mut t = [0f64; 3];
        for axis in 0..3 {
            let u = (point[axis] as f64 + 1.0).clamp(0.0, 2.0) * 0.5 * c as f64;
            cell[axis] = (u as usize).min(c - 1);
            t[axis] = u - cell[axis] as f64;
        }
        let side = |corner: usize, axis: usize| if corner >> axis & 1 == 1 { t[axis] } else { 1.0 - t[axis] };
        let tents = std::array::from_fn(|k| side(k, 0) * side(k, 1) * side(k, 2));
        Some((cell[0] + c * (cell[1] + c * cell[2]), tents))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two members; the second one's share is 0 at x = −1, 1 at x = 1.
    fn ramp() -> RegionWeights {
        let weights = (0..8).map(|n| if n % 2 == 0 { vec![1.0, 0.0] } else { vec![0.0, 1.0] }).collect();
        RegionWeights::new(2, vec![0.3, 0.7], weights).unwrap()
    }

    #[test]
    fn weights_between_two_nodes_are_mixed_and_beyond_the_box_they_stay() {
        let ramp = ramp();
        // x = −0.5 is a quarter of the way
        assert_eq!(ramp.at(Vec3::new(-0.5, 0.2, 0.9)), [0.75, 0.25]);
        assert_eq!(ramp.at(Vec3::new(9.0, -3.0, 0.0)), [0.0, 1.0]);
        assert_eq!(ramp.at(Vec3::new(f32::NAN, 0.0, 0.0)), [0.3, 0.7]);
    }

    #[test]
    fn corners_and_neighbours_are_where_they_are() {
        let grid = Grid::new(3).unwrap();
        // (0.5, −0.5, 1): cell (1, 0, 1) of 2³, its middle in x and y, its far side in z
        let (cell, tents) = grid.locate(Vec3::new(0.5, -0.5, 1.0)).unwrap();
        assert_eq!(cell, 5); // 1 + 2 · 0 + 4 · 1
        assert_eq!(tents, [0.0, 0.0, 0.0, 0.0, 0.25, 0.25, 0.25, 0.25]);
        assert_eq!(grid.node(cell, 0), grid.at(1, 0, 1));
        assert_eq!(grid.node(cell, 7), 23); // (2, 1, 2)
        assert_eq!(grid.beside(0).collect::<Vec<_>>(), [1, 3, 9]);
        assert_eq!(grid.beside(13).count(), 6);
    }

    #[test]
    fn a_file_that_was_edited_badly_is_an_error() {
        let text = serde_json::to_string(&ramp()).unwrap();
        assert_eq!(serde_json::from_str::<RegionWeights>(&text).unwrap(), ramp());
        let wrong = |from: &str, to: &str| {
            serde_json::from_str::<RegionWeights>(&text.replace(from, to)).unwrap_err().to_string()
        };
        assert!(
            wrong("\"nodes\":2", "\"nodes\":3").contains("the weights of 8 nodes are given, expected 27")
        );
        assert!(wrong("\"nodes\":2", "\"nodes\":999999999").contains("2 to 16"));
        assert!(wrong("[1.0,0.0]", "[1.0]").contains("1 weights for 2 members"));
        assert!(wrong("[1.0,0.0]", "[1.0,-1.0]").contains("weight 2 is -1"));
    }
}

//! The grid of nodes on which a field is sampled.

use crate::setting;
use glam::{DVec3, Vec3};
use tiface_base::error::Cause;
use tiface_base::geom::Aabb;
use tiface_base::{Error, Result};

/// Cubic cells over a box.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NodeGrid {
    /// Nodes along x, y, z.
    pub dims: [usize; 3],
    /// Node (0, 0, 0).
    pub origin: Vec3,
    /// Cell edge.
    pub spacing: f32,
}

impl NodeGrid {
    /// `resolution` cells along the longest side; along the others as many as cover the box, the
    /// surplus split between both ends.
    ///
    /// # Errors
    ///
    /// An empty or unbounded box, a resolution outside 2..=8192.
    pub fn fit(bounds: Aabb, resolution: usize) -> Result<NodeGrid> {
        let size = bounds.size();
        if bounds.is_empty() || !size.is_finite() || !bounds.center().is_finite() || size.min_element() <= 0.0
        {
            let Aabb { min, max } = bounds;
            let message = format!("the box to mesh in, {min} to {max}, is empty or not finite");
            return Err(Error::cannot(message, "check the scene box of the capture"));
        }
        check_resolution(resolution, 8192)?;
        let spacing = size.max_element() / resolution as f32;
        // A side a rounding error longer than n cells is n cells long.
        let cells = size.to_array().map(|s| ((s / spacing - 1e-3).ceil() as usize).max(2));
        let half = DVec3::from(cells.map(|c| 0.5 * c as f64 * f64::from(spacing)));
        let origin = (bounds.center().as_dvec3() - half).as_vec3();
        Ok(NodeGrid { dims: cells.map(|c| c + 1), origin, spacing })
    }

    /// Returns the position of a node.
    pub fn point(&self, node: [usize; 3]) -> Vec3 {
        let n = DVec3::new(node[0] as f64, node[1] as f64, node[2] as f64);
        (self.origin.as_dvec3() + n * f64::from(self.spacing)).as_vec3()
    }

    /// Returns the number of nodes.
    pub fn nodes(&self) -> usize {
        self.dims.iter().product()
    }

    /// Returns whether a node lies on the outer faces.
    pub(super) fn on_border(&self, node: [usize; 3]) -> bool {
        (0..3).any(|a| node[a] == 0 || node[a] + 1 == self.dims[a])
    }
}

/// Refuses fewer than 2 cells or nodes along a side, and more than `most`.
pub(super) fn check_resolution(resolution: usize, most: usize) -> Result<()> {
    let expected = format!("2..={most}");
    setting((2..=most).contains(&resolution), "resolution", &expected, resolution)
        .map_err(|e| e.with_cause(Cause::Resolution))
}

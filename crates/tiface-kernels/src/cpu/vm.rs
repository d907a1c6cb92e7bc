//! TensoRF's vector-matrix decomposition (Chen et al. 2022, Eq. 7): planes times lines.
//!
//! A grid of `nx × ny × nz` vertices is three terms; term `i` is a plane over two axes times a line
//! along the third, summed over its channels:
//!
//! ```text
//! term 0: plane (x, y) · line z    term 1: plane (x, z) · line y    term 2: plane (y, z) · line x
//! feature(p) = Σ_i Σ_c plane_i,c(p) · line_i,c(p)
//!              bilinear and linear, vertices on the box's border
//! ```
//!
//! The channels of a vertex are adjacent in memory (channel last). A corner is then one or a few
//! cache lines, which makes lookups seven times faster than with the channel-first storage of the
//! published code.

mod decoder;
mod gather;
pub mod losses;
pub mod mask;
mod penalty;
mod render;
mod resize;

pub use decoder::{DecoderShape, DecoderWeights};
pub use gather::Cell;
pub use penalty::penalize;
#[cfg(feature = "wgpu")]
pub(crate) use penalty::tv_factors;
pub use render::{RAY_WIDTH, Rendered, Shading, VmField, backward, composited, density_at, render};
pub use resize::{cropped, resized};

/// Axes (width, height) of each term's plane; x, y, z are 0, 1, 2.
pub const PLANE_AXES: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];
/// Axis of each term's line.
pub const LINE_AXIS: [usize; 3] = [2, 1, 0];

/// Layout of planes and lines in a flat array: plane 0, 1, 2, each `[height, width, channels]`,
/// then line 0, 1, 2, each `[n, channels]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    /// Vertices along x, y, z; at least 2 each.
    pub size: [usize; 3],
    /// Channels of each term.
    pub rank: [usize; 3],
}

/// One plane or line inside the flat array.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Factor {
    /// Index of the first float.
    pub start: usize,
    /// Vertices along the plane's second axis; 1 for a line.
    pub height: usize,
    /// Vertices along the plane's first axis, or of the line.
    pub width: usize,
    /// Number of floats of a vertex.
    pub channels: usize,
}

impl Factor {
    /// Returns the number of floats.
    pub fn len(&self) -> usize {
        self.height * self.width * self.channels
    }

    /// Returns whether the plane or line has no channels.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the range of the plane or line in the flat array.
    pub fn range(&self) -> std::ops::Range<usize> {
        self.start..self.start + self.len()
    }
}

impl Grid {
    /// Returns the three planes, then the three lines, in storage order.
    pub fn factors(&self) -> [Factor; 6] {
        let mut start = 0;
        std::array::from_fn(|k| {
            let (term, is_plane) = (k % 3, k < 3);
            let (w, h) = PLANE_AXES[term];
            let width = self.size[if is_plane { w } else { LINE_AXIS[term] }];
            let height = if is_plane { self.size[h] } else { 1 };
            let factor = Factor { start, height, width, channels: self.rank[term] };
            start += factor.len();
            factor
        })
    }

    /// Returns the plane of term `i`.
    pub fn plane(&self, i: usize) -> Factor {
        self.factors()[i]
    }

    /// Returns the line of term `i`.
    pub fn line(&self, i: usize) -> Factor {
        self.factors()[3 + i]
    }

    /// Splits a flat array into its planes and lines.
    fn split_mut<'a>(&self, mut flat: &'a mut [f32]) -> [(Factor, &'a mut [f32]); 6] {
        self.factors().map(|f| {
            (f, flat.split_off_mut(..f.len()).expect("the array has the floats of all planes and lines"))
        })
    }

    /// Returns the number of floats of all planes and lines.
    pub fn len(&self) -> usize {
        let last = self.line(2);
        last.start + last.len()
    }

    /// Returns the number of channels of all terms together.
    pub fn channels(&self) -> usize {
        self.rank.iter().sum()
    }
}

/// Returns the number of vertices along each axis for about `voxels` voxels in a box:
/// `floor(extent / (Π extent / V)^(1/3))`, at least 2.
pub fn size_for(extent: [f32; 3], voxels: u64) -> [usize; 3] {
    let product: f32 = extent.iter().product();
    let edge = (product / voxels as f32).cbrt();
    extent.map(|e| ((e / edge) as usize).max(2))
}

/// Returns the length of a march step: `ratio` times the mean distance of vertices over the three
/// axes.
pub fn step_size(extent: [f32; 3], size: [usize; 3], ratio: f32) -> f32 {
    (0..3).map(|a| extent[a] / (size[a] - 1) as f32).sum::<f32>() / 3.0 * ratio
}

/// Returns the number of samples of a ray for inference: enough for the box's diagonal, at most a
/// million.
pub fn samples_across(extent: [f32; 3], step: f32) -> usize {
    let diagonal = extent.iter().map(|e| e * e).sum::<f32>().sqrt();
    ((diagonal / step) as usize).saturating_add(1).min(1_000_000)
}

/// Returns the voxel counts of `steps` upsamplings, with equal ratios from `first` to `last`,
/// computed in f32 as published.
pub fn voxel_schedule(first: u64, last: u64, steps: usize) -> Vec<u64> {
    let (a, b) = ((first as f64).ln() as f32, (last as f64).ln() as f32);
    let at = |k: usize| {
        let x = a as f64 + (b as f64 - a as f64) * k as f64 / steps as f64;
        (x as f32).exp().round() as u64
    };
    (1..=steps).map(at).collect()
}

#[cfg(test)]
#[path = "vm/fixture_tests.rs"]
pub(crate) mod fixture;
#[cfg(test)]
mod tests;

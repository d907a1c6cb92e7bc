//! Least squares for values at the nodes of a surface that are small and smooth where nothing says
//! otherwise.

use super::appearance::Nodes;
use tiface_base::math::cg::{conjugate_gradients, dot};

/// A linear equation for a step: what is missing, and its derivatives by the values at nodes.
pub(crate) type Equation = (f32, Vec<(u32, f32)>);

/// Weights of squared values, and of squared differences along an edge, against the square of one
/// equation's error.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Prior {
    pub ridge: f64,
    pub smooth: f64,
}

impl Prior {
    /// Returns half the derivative of the prior by the value `i` of `x`. Values that are given
    /// count as neighbors, too.
    fn slope(self, nodes: &Nodes, x: &[f64], i: usize) -> f64 {
        let base = i / nodes.len() * nodes.len();
        let near = nodes.near(i - base).iter().map(|&n| x[i] - x[base + n as usize]).sum::<f64>();
        self.ridge * x[i] + self.smooth * near
    }
}

/// Returns the step of Gauss and Newton from the values `x`, one or more blocks of one for each
/// node, found in at most `rounds` rounds of conjugate gradients. A value that is not free stays:
/// `is_free` is asked with its index and with half the derivative of the sum of squares, downwards.
pub(crate) fn step(
    equations: &[Equation],
    nodes: &Nodes,
    x: &[f64],
    prior: Prior,
    is_free: impl Fn(usize, f64) -> bool,
    rounds: usize,
) -> Vec<f64> {
    let mut right: Vec<f64> = (0..x.len()).map(|i| -prior.slope(nodes, x, i)).collect();
    let mut diagonal: Vec<f64> =
        (0..x.len()).map(|i| prior.ridge + prior.smooth * nodes.near(i % nodes.len()).len() as f64).collect();
    for (rest, slopes) in equations {
        for &(at, slope) in slopes {
            right[at as usize] += f64::from(slope * rest);
            diagonal[at as usize] += f64::from(slope).powi(2);
        }
    }
    let free: Vec<bool> = right.iter().enumerate().map(|(i, r)| is_free(i, *r)).collect();
    right.iter_mut().zip(&free).filter(|(_, free)| !**free).for_each(|(r, _)| *r = 0.0);
    let apply = |x: &[f64], out: &mut [f64]| {
        (0..x.len()).for_each(|i| out[i] = prior.slope(nodes, x, i));
        for (_, slopes) in equations {
            let sum: f64 = slopes.iter().map(|&(at, slope)| f64::from(slope) * x[at as usize]).sum();
            slopes.iter().for_each(|&(at, slope)| out[at as usize] += f64::from(slope) * sum);
        }
        out.iter_mut().zip(&free).filter(|(_, free)| !**free).for_each(|(o, _)| *o = 0.0);
    };
    let precondition = |r: &[f64], z: &mut [f64]| {
        z.iter_mut().zip(r).zip(&diagonal).for_each(|((z, r), d)| *z = r / d);
    };
    let first = dot(&right, &right);
    let mut step = vec![0f64; x.len()];
    let done = |round: usize, r: &[f64]| round >= rounds || dot(r, r) <= 1e-6 * first;
    conjugate_gradients(&mut step, right, apply, precondition, done);
    step
}

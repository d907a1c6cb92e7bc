//! The normal equations of a fit, never formed, solved by conjugate gradients.

use super::nodes::Nodes;
use super::rows::{Matrix, Rows};
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::sphharm::{COEFFICIENTS_OF_DEGREE_2, sh16};
use tiface_base::math::cg::{conjugate_gradients, dot};

/// The sum of squares left at which a fit ends, of that at its start.
const TOLERANCE: f64 = 1e-8;

/// Maximum number of steps of conjugate gradients for constant colors: on the man of the results
/// twelve lose 0.005 dB against thirty.
const CONSTANT_STEPS: usize = 12;

/// Maximum number of steps for colors that depend on the view: there twelve lose 0.1 dB against
/// thirty, sixty gain 0.01.
const VIEW_DEPENDENT_STEPS: usize = 30;

/// Weights of the smoothness terms, relative to the squared error of one pixel.
///
/// On a surface the sum of squared differences is the same however fine the nodes are: its weight
/// is the number of pixels that are on average in the area over which a fit is smoothed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Smoothness {
    /// Squares of differences between neighbors, of constant terms.
    pub constant: f32,
    /// The same of all other terms.
    pub others: f32,
    /// Squares of all other terms themselves, per pixel of a node on average.
    pub ridge: f32,
    /// Squares of what is seen from where no photograph looks, per pixel of a node on average.
    pub unseen: f32,
}

/// Directions over the sphere in which what no photograph shows is kept small.
const DIRECTIONS: usize = 96;

/// Cosines of the angle between a direction and the nearest photograph's, from which on it counts
/// as unseen, and at which it does fully: 25° and 37°.
const UNSEEN: [f32; 2] = [0.906, 0.8];

/// Cosine of the angle between a node's normal and a direction below which nothing is seen.
const GRAZING: f32 = 0.1;

/// A linear system: pixels, and the nodes that they show.
pub struct System<'a> {
    /// The pixels.
    pub rows: &'a Rows,
    /// Nodes of each row.
    pub matrix: &'a Matrix,
    /// The nodes.
    pub nodes: &'a Nodes,
    /// Unit normals of nodes whose colors depend on the view, in the coordinates of the harmonics;
    /// else empty.
    pub normals: &'a [Vec3],
}

/// Values of the functions in each direction: the first is 1, the others are [`sh16`]'s.
pub type Functions = [f32; COEFFICIENTS_OF_DEGREE_2];

impl System<'_> {
    /// Returns the values of the functions in the direction of a row.
    pub fn functions(&self, row: usize) -> Functions {
        functions_at(self.rows[row].direction)
    }

    /// Returns the mean products of the functions over the sphere's directions from which a node
    /// could be seen, but no row that `keep` names looks, `[nodes, count, count]`.
    fn unseen(&self, count: usize, keep: &(dyn Fn(u32) -> bool + Sync)) -> Vec<f32> {
        let directions = over_sphere();
        let functions: Vec<Functions> = directions.iter().map(|d| functions_at(*d)).collect();
        let mut out = vec![0f32; self.normals.len() * count * count];
        out.par_chunks_mut(count * count).enumerate().with_min_len(256).for_each(|(node, out)| {
            // one direction a photograph: rows are sorted by them
            let mut seen: Vec<(u32, Vec3)> = Vec::new();
            for row in self.matrix.column(node).iter().map(|&(p, _)| &self.rows[p as usize]) {
                if keep(row.view) && seen.last().is_none_or(|last| last.0 != row.view) {
                    seen.push((row.view, row.direction));
                }
            }
            let front = directions.iter().zip(&functions);
            for (d, y) in front.filter(|(d, _)| self.normals[node].dot(**d) > GRAZING) {
                let nearest = seen.iter().map(|(_, s)| s.dot(*d)).fold(-1.0, f32::max);
                let share = ((UNSEEN[0] - nearest) / (UNSEEN[0] - UNSEEN[1])).clamp(0.0, 1.0);
                for (out, (a, b)) in out.iter_mut().zip(pairs(&y[..count])) {
                    *out += share * a * b / DIRECTIONS as f32;
                }
            }
        });
        out
    }

    /// Returns the product of a row with `x` `[nodes, count]`.
    pub fn shown(&self, row: usize, x: &[[f32; 3]], count: usize) -> [f32; 3] {
        let y = if count > 1 { self.functions(row) } else { [1.0; COEFFICIENTS_OF_DEGREE_2] };
        self.sum(row, x, &y[..count])
    }

    fn sum(&self, row: usize, x: &[[f32; 3]], y: &[f32]) -> [f32; 3] {
        let mut out = [0f32; 3];
        for &(node, w) in self.matrix.row(row) {
            let own = &x[node as usize * y.len()..][..y.len()];
            for (c, y) in own.iter().zip(y) {
                (0..3).for_each(|k| out[k] += w * y * c[k]);
            }
        }
        out
    }

    /// Returns `x` `[nodes, count]` that brings the rows that `keep` names (by photograph) closest
    /// to `target` `[rows]`.
    pub fn solve(
        &self,
        target: &[[f32; 3]],
        count: usize,
        smoothness: &Smoothness,
        keep: &(dyn Fn(u32) -> bool + Sync),
    ) -> Vec<[f32; 3]> {
        let rows = self.rows;
        let weight: Vec<f32> = rows.iter().map(|row| if keep(row.view) { row.weight } else { 0.0 }).collect();
        let harmonics = match count {
            1 => Vec::new(),
            _ => (0..rows.len()).into_par_iter().map(|p| self.functions(p)).collect(),
        };
        let per_node = rows.len() as f32 / self.nodes.len().max(1) as f32;
        let Smoothness { constant, others, ridge, unseen } = *smoothness;
        let mut products = if count > 1 && unseen > 0.0 { self.unseen(count, keep) } else { Vec::new() };
        products.iter_mut().for_each(|product| *product *= per_node * unseen);
        let normal = Normal {
            system: self,
            weight: &weight,
            harmonics,
            count,
            constant: [constant, 0.0],
            others: [others, per_node * ridge],
            unseen: products,
        };
        let right: Vec<[f32; 3]> = target.iter().zip(&weight).map(|(t, w)| t.map(|t| w * t)).collect();
        let mut residual = vec![0f64; self.nodes.len() * count * 3];
        normal.gather(&right, |_, _, _| [0.0; 3], &mut residual);
        let first = dot(&residual, &residual);
        let inverse = normal.inverse_diagonal();
        let mut x = vec![0f64; residual.len()];
        let precondition = |r: &[f64], z: &mut [f64]| {
            let each = z.par_iter_mut().zip(r).enumerate().with_min_len(1 << 14);
            each.for_each(|(i, (z, r))| *z = r * inverse[i / 3]);
        };
        let steps = if count == 1 { CONSTANT_STEPS } else { VIEW_DEPENDENT_STEPS };
        let done = |round: usize, r: &[f64]| round >= steps || dot(r, r) <= TOLERANCE * first;
        conjugate_gradients(&mut x, residual, |v, out| normal.apply(v, out), precondition, done);
        x.as_chunks::<3>().0.iter().map(|c| c.map(|v| v as f32)).collect()
    }
}

/// Returns the values of the functions in a direction.
fn functions_at(direction: Vec3) -> Functions {
    let y = sh16(direction.to_array());
    std::array::from_fn(|k| if k == 0 { 1.0 } else { y[k] })
}

/// Returns all pairs of some values, row by row.
fn pairs(values: &[f32]) -> impl Iterator<Item = (f32, f32)> {
    values.iter().flat_map(move |a| values.iter().map(move |b| (*a, *b)))
}

/// Returns unit vectors in equal areas of the sphere: a spiral by the golden angle.
fn over_sphere() -> Vec<Vec3> {
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    let at = |i: usize| {
        let z = 1.0 - (2 * i + 1) as f32 / DIRECTIONS as f32;
        let (sin, cos) = (golden * i as f32).sin_cos();
        let r = (1.0 - z * z).sqrt();
        Vec3::new(r * cos, r * sin, z)
    };
    (0..DIRECTIONS).map(at).collect()
}

/// The operator `Aᵀ D A` with the smoothness terms.
struct Normal<'a> {
    system: &'a System<'a>,
    weight: &'a [f32],
    /// Values of the functions, `[rows]`; empty where the only one is 1.
    harmonics: Vec<Functions>,
    count: usize,
    /// Weights of differences and of squares, of constant terms.
    constant: [f32; 2],
    /// The same of all others.
    others: [f32; 2],
    /// Weights of products of functions, `[nodes, count, count]`; empty without.
    unseen: Vec<f32>,
}

impl Normal<'_> {
    fn y(&self, row: usize) -> &[f32] {
        self.harmonics.get(row).map_or(&[1.0], |y| &y[..self.count])
    }

    /// Returns the weights of a node's products with a function, `[count]`; empty without.
    fn unseen(&self, node: usize, k: usize) -> &[f32] {
        let first = (node * self.count + k) * self.count;
        self.unseen.get(first..first + self.count).unwrap_or_default()
    }

    /// Writes `Aᵀ values`, and `more` of each node and function.
    fn gather(
        &self,
        values: &[[f32; 3]],
        more: impl Fn(usize, usize, &[u32]) -> [f32; 3] + Sync,
        out: &mut [f64],
    ) {
        out.par_chunks_mut(3 * self.count).enumerate().with_min_len(256).for_each(|(node, out)| {
            let mut own = [[0f32; 3]; COEFFICIENTS_OF_DEGREE_2];
            for &(p, w) in self.system.matrix.column(node) {
                let r = values[p as usize].map(|v| w * v);
                for (own, y) in own.iter_mut().zip(self.y(p as usize)) {
                    (0..3).for_each(|c| own[c] += y * r[c]);
                }
            }
            let near = self.system.nodes.near(node);
            for (k, out) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                let more = more(node, k, near);
                *out = std::array::from_fn(|c| f64::from(own[k][c] + more[c]));
            }
        });
    }

    fn apply(&self, x: &[f64], out: &mut [f64]) {
        let x: Vec<[f32; 3]> = x.as_chunks::<3>().0.par_iter().map(|c| c.map(|v| v as f32)).collect();
        let value = |p: usize| self.system.sum(p, &x, self.y(p)).map(|v| self.weight[p] * v);
        let values: Vec<[f32; 3]> =
            (0..self.weight.len()).into_par_iter().with_min_len(4096).map(value).collect();
        let more = |node: usize, k: usize, near: &[u32]| {
            let [smooth, ridge] = if k == 0 { self.constant } else { self.others };
            let all = &x[node * self.count..][..self.count];
            let own = all[k];
            let mut sum = [0f32; 3];
            for &other in near {
                let theirs = x[other as usize * self.count + k];
                (0..3).for_each(|c| sum[c] += own[c] - theirs[c]);
            }
            let mut out: [f32; 3] = std::array::from_fn(|c| smooth * sum[c] + ridge * own[c]);
            for (w, theirs) in self.unseen(node, k).iter().zip(all) {
                (0..3).for_each(|c| out[c] += w * theirs[c]);
            }
            out
        };
        self.gather(&values, more, out);
    }

    /// One over the diagonal, `[nodes, count]`.
    fn inverse_diagonal(&self) -> Vec<f64> {
        let mut out = vec![0f64; self.system.nodes.len() * self.count];
        out.par_chunks_mut(self.count).enumerate().with_min_len(256).for_each(|(node, out)| {
            let mut own = [0f32; COEFFICIENTS_OF_DEGREE_2];
            for &(p, w) in self.system.matrix.column(node) {
                let w = w * w * self.weight[p as usize];
                own.iter_mut().zip(self.y(p as usize)).for_each(|(own, y)| *own += w * y * y);
            }
            let near = self.system.nodes.near(node).len() as f32;
            for (k, out) in out.iter_mut().enumerate() {
                let [smooth, ridge] = if k == 0 { self.constant } else { self.others };
                let unseen = self.unseen(node, k).get(k).unwrap_or(&0.0);
                *out = 1.0 / f64::from((own[k] + smooth * near + ridge + unseen).max(1e-6));
            }
        });
        out
    }
}

//! The normal equations of a fit, never formed, solved by conjugate gradients.

use super::nodes::Nodes;
use super::rows::{Matrix, Rows};
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::dispatch;
use tiface_base::geom::sphharm::{COEFFICIENTS_OF_DEGREE_2, sh16};
use tiface_base::math::cg::{conjugate_gradients, dot};

/// The sum of squares left at which a fit ends, of that at its start.
const TOLERANCE: f64 = 1e-8;

/// Maximum number of steps of conjugate gradients for constant colors: on the man of the results
/// twelve lose 0.005 dB against thirty.
const CONSTANT_STEPS: usize = 12;

/// Maximum number of steps for colors that depend on the view: there eight lose 0.01 dB against
/// ten, thirty gain 0.002.
const VIEW_DEPENDENT_STEPS: usize = 10;

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
    /// Returns the mean products of the functions over the sphere's directions from which a node
    /// could be seen, but no row that `keep` names looks, `[nodes, count, count]`.
    fn unseen(&self, count: usize, keep: &(dyn Fn(u32) -> bool + Sync)) -> Vec<f32> {
        let directions = over_sphere();
        let functions: Vec<Functions> = directions.iter().map(|d| functions_at(*d)).collect();
        let mut out = vec![0f32; self.normals.len() * count * count];
        out.par_chunks_mut(count * count).enumerate().with_min_len(256).for_each(|(node, out)| {
            // one direction a photograph: rows are sorted by them
            let mut seen: Vec<(u32, Vec3)> = Vec::new();
            for row in self.matrix.column(node).map(|(p, _)| &self.rows[p as usize]) {
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

    /// Returns the products of all rows with `x` `[nodes, count]`.
    pub fn shown(&self, x: &[[f32; 3]], count: usize) -> Vec<[f32; 3]> {
        let x: Vec<Padded> = x.par_iter().map(|&c| padded(c)).collect();
        let out = self.products(&x, &self.harmonics(count), count);
        out.into_iter().map(|[r, g, b, _]| [r, g, b]).collect()
    }

    /// Returns the values of the functions, `[rows]`; none where the only one is 1.
    fn harmonics(&self, count: usize) -> Vec<Functions> {
        match count {
            1 => Vec::new(),
            _ => self.rows.par_iter().with_min_len(4096).map(|row| functions_at(row.direction)).collect(),
        }
    }

    fn products(&self, x: &[Padded], harmonics: &[Functions], count: usize) -> Vec<Padded> {
        let mut out = vec![[0f32; 4]; self.rows.len()];
        out.par_chunks_mut(ROWS).enumerate().for_each(|(i, out)| {
            products(&mut Products { matrix: self.matrix, x, harmonics, count, first: i * ROWS, out });
        });
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
        let per_node = rows.len() as f32 / self.nodes.len().max(1) as f32;
        let Smoothness { constant, others, ridge, unseen } = *smoothness;
        let mut products = if count > 1 && unseen > 0.0 { self.unseen(count, keep) } else { Vec::new() };
        products.iter_mut().for_each(|product| *product *= per_node * unseen);
        let normal = Normal {
            system: self,
            weight: &weight,
            harmonics: self.harmonics(count),
            count,
            constant: [constant, 0.0],
            others: [others, per_node * ridge],
            unseen: products,
        };
        let right: Vec<Padded> = target.iter().zip(&weight).map(|(t, w)| padded(t.map(|t| w * t))).collect();
        let mut residual = vec![0f64; self.nodes.len() * count * 3];
        normal.gather(&right, &|_, _, _| [0.0; 3], &mut residual);
        let first = dot(&residual, &residual);
        let blocks = normal.factored_blocks();
        let mut x = vec![0f64; residual.len()];
        let precondition = |r: &[f64], z: &mut [f64]| {
            let each = z.par_chunks_mut(3 * count).zip(r.par_chunks(3 * count)).enumerate();
            each.with_min_len(1 << 10).for_each(|(node, (z, r))| {
                solve_block(&blocks[node * count * count..][..count * count], count, r, z);
            });
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
    fn gather(&self, values: &[Padded], more: &More, out: &mut [f64]) {
        out.par_chunks_mut(3 * self.count * NODES).enumerate().for_each(|(i, out)| {
            gather(&mut Gather { normal: self, values, more, first: i * NODES, out });
        });
    }

    fn apply(&self, x: &[f64], out: &mut [f64]) {
        let narrow = |c: &[f64; 3]| padded(c.map(|v| v as f32));
        let x: Vec<Padded> = x.as_chunks::<3>().0.par_iter().map(narrow).collect();
        let mut values = self.system.products(&x, &self.harmonics, self.count);
        let weighted = values.par_iter_mut().zip(self.weight).with_min_len(4096);
        weighted.for_each(|(value, weight)| *value = value.map(|v| weight * v));
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
        self.gather(&values, &more, out);
    }

    /// Returns the block of each node on the diagonal, `[nodes, count, count]`, as its lower
    /// triangular Cholesky factor, with one over its diagonal on it.
    ///
    /// A node's functions depend on each other, the more so the fewer photographs show it: with the
    /// diagonal alone thirty steps do not get as far as eight do with blocks.
    fn factored_blocks(&self) -> Vec<f64> {
        let n = self.count;
        let mut out = vec![0f64; self.system.nodes.len() * n * n];
        out.par_chunks_mut(n * n).enumerate().with_min_len(256).for_each(|(node, block)| {
            let mut sums = [[0f32; COEFFICIENTS_OF_DEGREE_2]; COEFFICIENTS_OF_DEGREE_2];
            for (p, w) in self.system.matrix.column(node) {
                let (y, w) = (self.y(p as usize), w * w * self.weight[p as usize]);
                for (sums, a) in sums.iter_mut().zip(y) {
                    sums.iter_mut().zip(y).for_each(|(sum, b)| *sum += w * a * b);
                }
            }
            let near = self.system.nodes.near(node).len() as f32;
            for (k, sums) in sums.iter_mut().enumerate().take(n) {
                let [smooth, ridge] = if k == 0 { self.constant } else { self.others };
                sums.iter_mut().zip(self.unseen(node, k)).for_each(|(sum, unseen)| *sum += unseen);
                sums[k] = (sums[k] + smooth * near + ridge).max(1e-6);
            }
            factor(block, n, |i, j| f64::from(sums[i][j]));
        });
        out
    }
}

/// Writes the lower triangular Cholesky factor of a symmetric matrix, with one over its diagonal on
/// it; `[n, n]`. Pivots are at least a millionth of the diagonal.
fn factor(out: &mut [f64], n: usize, matrix: impl Fn(usize, usize) -> f64) {
    for i in 0..n {
        for j in 0..=i {
            let known: f64 = (0..j).map(|k| out[i * n + k] * out[j * n + k]).sum();
            let left = matrix(i, j) - known;
            out[i * n + j] = match i == j {
                true => 1.0 / left.max(1e-6 * matrix(i, i)).sqrt(),
                false => left * out[j * n + j],
            };
        }
    }
}

/// Solves for three right sides, `[n, 3]`, by a factor of [`factor`].
fn solve_block(factor: &[f64], n: usize, right: &[f64], out: &mut [f64]) {
    for i in 0..n {
        for c in 0..3 {
            let known: f64 = (0..i).map(|k| factor[i * n + k] * out[3 * k + c]).sum();
            out[3 * i + c] = (right[3 * i + c] - known) * factor[i * n + i];
        }
    }
    for i in (0..n).rev() {
        for c in 0..3 {
            let known: f64 = (i + 1..n).map(|k| factor[k * n + i] * out[3 * k + c]).sum();
            out[3 * i + c] = (out[3 * i + c] - known) * factor[i * n + i];
        }
    }
}

/// A color in a vector of four.
type Padded = [f32; 4];

fn padded([r, g, b]: [f32; 3]) -> Padded {
    [r, g, b, 0.0]
}

/// What is added to the sum of a node and a function, by the node's neighbors.
type More<'a> = dyn Fn(usize, usize, &[u32]) -> [f32; 3] + Sync + 'a;

/// Rows whose products are computed together, and nodes whose sums are.
const ROWS: usize = 1 << 14;
const NODES: usize = 256;

/// Products of some rows with `x` `[nodes, count]`.
struct Products<'a> {
    matrix: &'a Matrix,
    x: &'a [Padded],
    /// Values of the functions, `[rows]`; empty where the only one is 1.
    harmonics: &'a [Functions],
    count: usize,
    /// The first row.
    first: usize,
    out: &'a mut [Padded],
}

dispatch! { fn products / products_body(t: &mut Products) }

#[inline(always)]
fn products_body<const HAS_FMA: bool>(t: &mut Products) {
    match t.count {
        1 => products_of::<1>(t),
        4 => products_of::<4>(t),
        _ => products_of::<COEFFICIENTS_OF_DEGREE_2>(t),
    }
}

#[inline(always)]
fn products_of<const COUNT: usize>(t: &mut Products) {
    let x = t.x.as_chunks::<COUNT>().0;
    for (row, out) in (t.first..).zip(t.out.iter_mut()) {
        let mut sums = [[0f32; 4]; COUNT];
        for (node, w) in t.matrix.row(row) {
            for (sum, x) in sums.iter_mut().zip(&x[node as usize]) {
                (0..4).for_each(|c| sum[c] += w * x[c]);
            }
        }
        let y: &[f32] = t.harmonics.get(row).map_or(&[1.0], |y| y);
        for (sum, y) in sums.iter().zip(y) {
            (0..4).for_each(|c| out[c] += y * sum[c]);
        }
    }
}

/// Sums of rows' values at some nodes, `[nodes, count]`.
struct Gather<'a> {
    normal: &'a Normal<'a>,
    /// `[rows]`.
    values: &'a [Padded],
    more: &'a More<'a>,
    /// The first node.
    first: usize,
    out: &'a mut [f64],
}

dispatch! { fn gather / gather_body(t: &mut Gather) }

#[inline(always)]
fn gather_body<const HAS_FMA: bool>(t: &mut Gather) {
    match t.normal.count {
        1 => gather_of::<1>(t),
        4 => gather_of::<4>(t),
        _ => gather_of::<COEFFICIENTS_OF_DEGREE_2>(t),
    }
}

#[inline(always)]
fn gather_of<const COUNT: usize>(t: &mut Gather) {
    let Normal { system, harmonics, .. } = t.normal;
    for (node, out) in (t.first..).zip(t.out.chunks_exact_mut(3 * COUNT)) {
        let mut sums = [[0f32; 4]; COUNT];
        for (p, w) in system.matrix.column(node) {
            let value = t.values[p as usize].map(|v| w * v);
            let y: &[f32] = harmonics.get(p as usize).map_or(&[1.0], |y| y);
            for (sum, y) in sums.iter_mut().zip(y) {
                (0..4).for_each(|c| sum[c] += y * value[c]);
            }
        }
        let near = system.nodes.near(node);
        for (k, out) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let more = (t.more)(node, k, near);
            *out = std::array::from_fn(|c| f64::from(sums[k][c] + more[c]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_solved_by_their_factors() {
        // A = Q Qᵀ + 1/2, right sides of known solutions
        let n = COEFFICIENTS_OF_DEGREE_2;
        let q = |i: usize, j: usize| ((3 * i + 5 * j) as f64).sin();
        let matrix = |i: usize, j: usize| {
            (0..n).map(|k| q(i, k) * q(j, k)).sum::<f64>() + if i == j { 0.5 } else { 0.0 }
        };
        let known = |i: usize, c: usize| (i + n * c) as f64 * 0.1 - 1.0;
        let right: Vec<f64> =
            (0..3 * n).map(|at| (0..n).map(|j| matrix(at / 3, j) * known(j, at % 3)).sum()).collect();
        let (mut block, mut found) = (vec![0.0; n * n], vec![0.0; 3 * n]);
        factor(&mut block, n, matrix);
        solve_block(&block, n, &right, &mut found);
        for (at, found) in found.iter().enumerate() {
            assert!((found - known(at / 3, at % 3)).abs() < 1e-10, "{at}: {found}");
        }
        // where functions cannot be told apart, it stays finite
        factor(&mut block, n, |_, _| 1.0);
        solve_block(&block, n, &right, &mut found);
        assert!(found.iter().all(|v| v.is_finite()));
    }
}

//! Smooth colors all over a surface, from those vertices whose color is trusted.
//!
//! A vertex is of each material by a share. Where the color is trusted, it says which one;
//! elsewhere shares follow the neighbors, and a little what the network guesses (Grady 2006,
//! "Random walks for image segmentation", with priors). Each material then has a color everywhere:
//!
//! ```text
//! min_c  Σ_v t_v (s_v / max_k s_kv)⁸ ‖c_v − own_v‖² + μ Σ_{v ~ w} ‖c_v − c_w‖²
//! ```
//!
//! with trust `t`, share `s` and the largest share of any material at the vertex. So what nobody
//! saw is about as bright as what was seen of its material, and a lamp that the network took for
//! hair is no color of anything.

use super::materials::Materials;
use super::trust::{ROUNDS as TRUST_ROUNDS, Seen};
use crate::appearance::Nodes;
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::{Hit, Mesh};
use tiface_base::math::cg::{conjugate_gradients, dot};

/// Weight of a trusted color's material relative to a difference between neighbors.
const SURE: f64 = 10.0;

/// Length over which the network's guess decides what material is where, relative to the longest
/// side: half as wide as a head, and wider than a glare.
const GUESS: f32 = 0.1;

/// Length over which trusted colors are smoothed, relative to the longest side.
const LENGTH: f32 = 0.015;

/// Power of the shares by which vertices tell the colors of materials, and by which those mix at a
/// point: the border of materials is a line.
const SHARPNESS: i32 = 8;

/// Trust from which on a color tells materials apart.
pub const TRUSTED: f32 = 0.9;

/// Distances from the smooth color, in their mean of trusted vertices of the material, between
/// which what was only glimpsed agrees no longer: it may be a lamp.
const AGREES: [f32; 2] = [2.0, 3.0];

/// Least mean distance that these are held against: plain paint differs by the noise of
/// photographs.
const LEAST_DISTANCE: f32 = 0.02;

/// Most rounds of conjugate gradients, and the sum of squares at which they end, of that at their
/// start.
const ROUNDS: usize = 600;
const TOLERANCE: f64 = 1e-10;

/// Smooth colors of the materials at the vertices of a mesh.
pub struct SmoothColors<'a> {
    triangles: &'a [[u32; 3]],
    /// Share of each material at each vertex, `[materials][vertices]`.
    shares: Vec<Vec<f32>>,
    /// sRGB-coded, `[materials][vertices]`.
    colors: Vec<Vec<[f32; 3]>>,
}

impl SmoothColors<'_> {
    /// Makes colors from each vertex's `own`, its `trust`, 0..=1, and the network's `guess`; colors
    /// are sRGB-coded. `None` where nothing is trusted.
    pub fn new<'a>(
        mesh: &'a Mesh,
        nodes: &Nodes,
        trust: &[f32],
        own: &[[f32; 3]],
        guess: &[[f32; 3]],
    ) -> Option<SmoothColors<'a>> {
        let trusted: Vec<[f32; 3]> =
            own.iter().zip(trust).filter(|(_, t)| **t > TRUSTED).map(|(c, _)| *c).collect();
        if trusted.is_empty() {
            return None;
        }
        let materials = Materials::of(&trusted);
        let (side, edge) = (mesh.bounds().size().max_element(), mean_edge(mesh, nodes));
        let guess_weight = f64::from(edge / (GUESS * side)).powi(2);
        let prior = |v: usize| {
            let (seen, guessed) = (SURE * f64::from(trust[v]), guess_weight * f64::from(1.0 - trust[v]));
            let (p, q) = (materials.probabilities(own[v]), materials.probabilities(guess[v]));
            let value = |k: usize| (seen * p[k] + guessed * q[k]) / (seen + guessed);
            (seen + guessed, (0..materials.len()).map(value).collect::<Vec<f64>>())
        };
        let (weights, priors): (Vec<f64>, Vec<Vec<f64>>) =
            (0..trust.len()).into_par_iter().with_min_len(1024).map(prior).unzip();
        let share = |k: usize| -> Vec<f32> {
            let values: Vec<f64> = priors.iter().map(|p| p[k]).collect();
            membrane(nodes, &weights, &values, 1.0).into_iter().map(|s| (s as f32).clamp(0.0, 1.0)).collect()
        };
        let shares: Vec<Vec<f32>> = (0..materials.len()).into_par_iter().map(share).collect();
        let largest = largest_shares(&shares);
        let smoothness = f64::from(LENGTH * side / edge).powi(2);
        let channel = |i: usize| {
            let (shares, c) = (&shares[i / 3], i % 3);
            // as a power, since a little of many vertices of another material would tint all that
            // is far from its own; relative, since a shade between clusters has no majority
            // anywhere
            let weight = |v: usize| {
                let share = shares[v] / largest[v].1.max(f32::MIN_POSITIVE);
                f64::from(trust[v]) * f64::from(share).powi(SHARPNESS)
            };
            let weights: Vec<f64> = (0..trust.len()).map(weight).collect();
            let values: Vec<f64> = own.iter().map(|own| f64::from(own[c])).collect();
            membrane(nodes, &weights, &values, smoothness)
        };
        let channels: Vec<Vec<f64>> = (0..3 * shares.len()).into_par_iter().map(channel).collect();
        let color = |[r, g, b]: &[Vec<f64>; 3], v: usize| [r[v], g[v], b[v]].map(|x| x as f32);
        let of_material =
            |rgb: &[Vec<f64>; 3]| -> Vec<[f32; 3]> { (0..trust.len()).map(|v| color(rgb, v)).collect() };
        let colors = channels.as_chunks::<3>().0.iter().map(of_material).collect();
        Some(SmoothColors { triangles: &mesh.triangles, shares, colors })
    }

    /// Returns the number of materials.
    pub fn materials(&self) -> usize {
        self.shares.len()
    }

    /// Returns the material that a point is of by the largest share, and that share.
    pub fn material_at(&self, hit: &Hit) -> (usize, f32) {
        let corners = self.triangles[hit.triangle as usize];
        largest((0..self.materials()).map(|k| hit.mix(corners.map(|v| self.shares[k][v as usize]))))
    }

    /// Returns the smooth color of a point.
    pub fn at(&self, hit: &Hit) -> [f32; 3] {
        let corners = self.triangles[hit.triangle as usize].map(|v| v as usize);
        let color = |k: usize| hit.mix(corners.map(|v| Vec3::from(self.colors[k][v]))).to_array();
        self.mixed(|k| hit.mix(corners.map(|v| self.shares[k][v])), color)
    }

    /// Returns the mixture of the materials' colors at a point, by their shares there.
    fn mixed(&self, share: impl Fn(usize) -> f32, color: impl Fn(usize) -> [f32; 3]) -> [f32; 3] {
        let (mut sum, mut total) = ([0f32; 3], 0f32);
        for k in 0..self.materials() {
            let weight = share(k).powi(SHARPNESS);
            total += weight;
            sum.iter_mut().zip(color(k)).for_each(|(sum, c)| *sum += weight * c);
        }
        sum.map(|s| s / total.max(f32::MIN_POSITIVE))
    }

    /// Returns the trust in vertices, `own` color given, with that in what was glimpsed, as far as
    /// it agrees with the smooth color.
    pub fn confirmed(&self, nodes: &Nodes, seen: &Seen, own: &[[f32; 3]]) -> Vec<f32> {
        let materials = self.of_vertices();
        let apart = |v: usize| {
            let plain = self.mixed(|k| self.shares[k][v], |k| self.colors[k][v]);
            plain.iter().zip(own[v]).map(|(a, b)| (a - b).powi(2)).sum::<f32>()
        };
        let squares: Vec<f32> = (0..own.len()).map(apart).collect();
        let mut sums = vec![(0f64, 0usize); self.materials()];
        for (v, square) in squares.iter().enumerate().filter(|(v, _)| seen.trust[*v] > TRUSTED) {
            let (sum, count) = &mut sums[materials[v].0];
            (*sum, *count) = (*sum + f64::from(*square), *count + 1);
        }
        let agrees = |v: usize| {
            let (sum, count) = sums[materials[v].0];
            let mean = ((sum / count.max(1) as f64).sqrt() as f32).max(LEAST_DISTANCE);
            ((AGREES[1] - squares[v].sqrt() / mean) / (AGREES[1] - AGREES[0])).clamp(0.0, 1.0)
        };
        let agrees: Vec<f32> = (0..own.len()).map(agrees).collect();
        // a lamp is wider than what is too bright of it
        let around = |v: usize| nodes.near(v).iter().map(|&n| agrees[n as usize]).fold(agrees[v], f32::min);
        let agrees = nodes.smoothed((0..own.len()).map(around).collect(), TRUST_ROUNDS);
        let glimpsed = seen.trust.iter().zip(&seen.glimpse).zip(agrees);
        glimpsed.map(|((trust, glimpse), agrees)| trust + (glimpse - trust).max(0.0) * agrees).collect()
    }

    /// Returns the material that each vertex is of by the largest share, and that share.
    pub fn of_vertices(&self) -> Vec<(usize, f32)> {
        largest_shares(&self.shares)
    }
}

/// Returns the material with the largest share at each vertex, and that share.
fn largest_shares(shares: &[Vec<f32>]) -> Vec<(usize, f32)> {
    (0..shares[0].len()).map(|v| largest(shares.iter().map(|s| s[v]))).collect()
}

/// Returns which of some shares is the largest, the first of equal ones, and that share.
fn largest(shares: impl Iterator<Item = f32>) -> (usize, f32) {
    shares.enumerate().fold((0, -1.0), |m, s| if s.1 > m.1 { s } else { m })
}

/// Returns the mean length of the edges of a mesh.
fn mean_edge(mesh: &Mesh, nodes: &Nodes) -> f32 {
    let (mut sum, mut count) = (0f64, 0usize);
    for (v, p) in mesh.positions.iter().enumerate() {
        let near = nodes.near(v);
        count += near.len();
        sum += near.iter().map(|&n| f64::from(p.distance(mesh.positions[n as usize]))).sum::<f64>();
    }
    (sum / count.max(1) as f64).max(f64::MIN_POSITIVE) as f32
}

/// Returns the x that minimizes `Σ weight (x − value)² + smoothness Σ (x − x of a neighbor)²`;
/// their mean where nothing has weight.
fn membrane(nodes: &Nodes, weights: &[f64], values: &[f64], smoothness: f64) -> Vec<f64> {
    let total: f64 = weights.iter().sum();
    if total <= 0.0 {
        return vec![values.iter().sum::<f64>() / values.len().max(1) as f64; values.len()];
    }
    let mean = dot(weights, values) / total;
    let mut x = vec![mean; values.len()];
    let residual: Vec<f64> = weights.iter().zip(values).map(|(w, v)| w * (v - mean)).collect();
    let first = dot(&residual, &residual);
    let apply = |x: &[f64], out: &mut [f64]| {
        for (v, out) in out.iter_mut().enumerate() {
            let near = nodes.near(v);
            let others: f64 = near.iter().map(|&n| x[n as usize]).sum();
            *out = weights[v] * x[v] + smoothness * (near.len() as f64 * x[v] - others);
        }
    };
    let precondition = |r: &[f64], z: &mut [f64]| {
        for (v, z) in z.iter_mut().enumerate() {
            *z = r[v] / (weights[v] + smoothness * nodes.near(v).len() as f64).max(f64::MIN_POSITIVE);
        }
    };
    let done = |round: usize, r: &[f64]| round >= ROUNDS || dot(r, r) <= TOLERANCE * first;
    conjugate_gradients(&mut x, residual, apply, precondition, done);
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::testing::ball;

    #[test]
    fn a_membrane_between_two_ends_is_a_line() {
        // a strip of triangles, eight vertices along each side
        let mut mesh = Mesh::default();
        for i in 0..16u32 {
            mesh.positions.push(glam::Vec3::new((i / 2) as f32, (i % 2) as f32, 0.0));
            mesh.triangles.extend((i >= 2).then(|| [i - 2, i - 1, i]));
        }
        let nodes = Nodes::vertices(&mesh);
        let mut weights = vec![0.0; 16];
        let values: Vec<f64> = (0..16).map(|i| if i < 2 { 3.0 } else { 10.0 }).collect();
        [0, 1, 14, 15].iter().for_each(|&i| weights[i] = 1e3);
        let x = membrane(&nodes, &weights, &values, 1.0);
        // each side of the strip by itself runs from 3 to 10 in seven steps; diagonals join them
        for (i, x) in x.iter().enumerate() {
            assert!((x - (3.0 + (i / 2) as f64)).abs() < 0.35, "{i} {x}");
        }
        assert_eq!(membrane(&nodes, &[0.0; 16], &values, 1.0)[0], 9.125);
    }

    /// Skin above and cloth below, on a ball of radius 12; a lamp in the cloth where nobody looked.
    fn painted() -> (Mesh, Vec<f32>, Vec<[f32; 3]>, Vec<[f32; 3]>) {
        let mesh = ball().mesh;
        let paint = |y: f32| if y > 0.0 { [0.8, 0.6, 0.5] } else { [0.2, 0.25, 0.4] };
        let own: Vec<[f32; 3]> = mesh.positions.iter().map(|p| paint(p.y)).collect();
        let trust: Vec<f32> = mesh.positions.iter().map(|p| if p.x < 4.0 { 1.0 } else { 0.0 }).collect();
        let lamp = |p: &glam::Vec3| p.distance(glam::Vec3::new(11.0, -5.0, 0.0)) < 1.2;
        let guess =
            mesh.positions.iter().zip(&own).map(|(p, c)| if lamp(p) { [1.0; 3] } else { *c }).collect();
        (mesh, trust, own, guess)
    }

    #[test]
    fn unseen_vertices_have_their_material_and_its_color_even_under_a_lamp() {
        let (mesh, trust, own, guess) = painted();
        // what was not seen may hold anything
        let seen = |(c, t): (&[f32; 3], &f32)| if *t > 0.0 { *c } else { [0.0, 1.0, 0.0] };
        let hidden: Vec<[f32; 3]> = own.iter().zip(&trust).map(seen).collect();
        let nodes = Nodes::vertices(&mesh);
        let smooth = SmoothColors::new(&mesh, &nodes, &trust, &hidden, &guess).unwrap();
        assert_eq!(smooth.materials(), 2);
        let materials = smooth.of_vertices();
        let above = materials[mesh.positions.iter().position(|p| p.x < 0.0 && p.y > 8.0).unwrap()].0;
        for t in 0..mesh.triangles.len() as u32 {
            let hit = Hit { t: 0.0, triangle: t, u: 1.0 / 3.0, v: 1.0 / 3.0 };
            let p = mesh.point_at(&hit);
            // far from the border between both
            if p.y.abs() < 2.5 {
                continue;
            }
            assert_eq!(smooth.material_at(&hit).0 == above, p.y > 0.0, "{p}");
            let (found, true_color) =
                (smooth.at(&hit), if p.y > 0.0 { [0.8, 0.6, 0.5] } else { [0.2, 0.25, 0.4] });
            assert!((0..3).all(|k| (found[k] - true_color[k]).abs() < 0.02), "{p} {found:?}");
        }
        let nothing = vec![0.0; trust.len()];
        assert!(SmoothColors::new(&mesh, &nodes, &nothing, &hidden, &guess).is_none());
    }

    #[test]
    fn a_shade_between_materials_stays_that_of_its_surroundings() {
        // from dark to bright along y, so that much of it is of no material for the most part; a
        // cap of radius 5 was not seen
        let mesh = ball().mesh;
        let paint = |y: f32| [0.8, 0.6, 0.5].map(|c: f32| c * (0.6 + y / 30.0));
        let own: Vec<[f32; 3]> = mesh.positions.iter().map(|p| paint(p.y)).collect();
        let trust: Vec<f32> = mesh.positions.iter().map(|p| if p.x < 11.0 { 1.0 } else { 0.0 }).collect();
        let nodes = Nodes::vertices(&mesh);
        let smooth = SmoothColors::new(&mesh, &nodes, &trust, &own, &own).unwrap();
        assert!(smooth.of_vertices().iter().any(|(_, share)| *share < 0.5));
        let off = |t: u32| {
            let hit = Hit { t: 0.0, triangle: t, u: 1.0 / 3.0, v: 1.0 / 3.0 };
            let (found, p) = (smooth.at(&hit), mesh.point_at(&hit));
            let off = (0..3).map(|k| (found[k] - paint(p.y)[k]).abs()).fold(0.0, f32::max);
            if p.x < 11.0 { 0.0 } else { off }
        };
        let worst = (0..mesh.triangles.len() as u32).map(off).fold(0.0, f32::max);
        assert!(worst < 0.05, "{worst}");
    }
}

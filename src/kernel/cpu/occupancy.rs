//! Which cells may hold surface: the rule of a band around the zero set, and nerfacc's. A rule is a function of cells and of
//! an evaluation at points.

use super::march::Bitmask;
use super::rng;
use rayon::prelude::*;

/// Every cell is looked at before this step; from it on a quarter of them anywhere, and at most as many of those
/// marched through.
pub const ALL_BELOW: u64 = 256;
/// What is left of a cell's opacity at the next look.
pub const DECAY: f32 = 0.95;
/// Our streams of random numbers: cells anywhere, cells marched through, points in cells.
pub const DRAWS: [u64; 3] = [5, 6, 7];
/// Opacity of a cell of a signed distance that is marched through, unless the mean is less.
pub const OPAQUE: f32 = 1e-3;

/// How wide the band around the zero set is.
#[derive(Clone, Copy, Debug)]
pub struct BandRule {
    /// Half of it, in units of 1 / sharpness.
    pub width: f32,
    /// How many times lower than the sharpest the sharpness may be.
    pub soften: f32,
}

/// A cell stays when the zero set's band (`width` over the local sharpness) may reach it, for gradients up to about
/// one, or when a neighbour's centre lies on the other side, however steep the field is there; what is
/// left of the inside is solid.
///
/// `sdf` evaluates points of `[-radius, radius]³`, `soft` the logarithm of the local sharpness as a share of `inv_s`.
pub fn update_band(
    [occupied, solid]: [&mut Bitmask; 2],
    allowed: &Bitmask,
    radius: f32,
    rule: BandRule,
    inv_s: f32,
    sdf: impl Fn(&[[f32; 3]]) -> Vec<f32>,
    soft: impl Fn(&[[f32; 3]]) -> Vec<f32>,
) {
    let r = allowed.resolution;
    let cell = 2.0 * radius / r as f32;
    let half_diagonal = 0.5 * 3f32.sqrt() * cell;
    let widest = rule.width * rule.soften / inv_s + half_diagonal;
    let cells: Vec<usize> = (0..r * r * r).filter(|&i| allowed.get(i)).collect();
    let center = |i: usize| [i / (r * r), i / r % r, i % r].map(|c| (c as f32 + 0.5) * cell - radius);
    // NaN where nothing was asked: no sign, no neighbour
    let mut f = vec![f32::NAN; r * r * r];
    for cells in cells.chunks(1 << 17) {
        let points: Vec<[f32; 3]> = cells.par_iter().map(|&i| center(i)).collect();
        for (&i, value) in cells.iter().zip(sdf(&points)) {
            f[i] = value;
        }
    }
    // sharpness is evaluated only where the softest surface would reach
    let mut band = vec![rule.width / inv_s + half_diagonal; r * r * r];
    if rule.soften > 1.0 {
        let near: Vec<usize> = cells.iter().copied().filter(|&i| f[i].abs() < widest).collect();
        for near in near.chunks(1 << 17) {
            let points: Vec<[f32; 3]> = near.par_iter().map(|&i| center(i)).collect();
            for (&i, soft) in near.iter().zip(soft(&points)) {
                band[i] = rule.width / (inv_s * soft.exp()) + half_diagonal;
            }
        }
    }
    // softness changes within a cell: the softest of a cell and its neighbours counts, or rays would end in hair
    let widest_near = |i: usize| {
        [1, r, r * r].into_iter().fold(band[i], |most, stride| {
            let at = i / stride % r;
            let before = if at > 0 { band[i - stride] } else { 0.0 };
            let after = if at + 1 < r { band[i + stride] } else { 0.0 };
            most.max(before).max(after)
        })
    };
    occupied.bits.fill(0);
    solid.bits.fill(0);
    for &i in &cells {
        let crossed = [1, r, r * r].into_iter().any(|stride| {
            let at = i / stride % r;
            let other = |j: usize| f[j] * f[i] < 0.0;
            (at > 0 && other(i - stride)) || (at + 1 < r && other(i + stride))
        });
        if f[i].abs() < widest_near(i) || crossed {
            occupied.set(i, true);
        } else if f[i] < 0.0 {
            solid.set(i, true);
        }
    }
}

/// nerfacc's rule (its release 0.3.3) for any opacity of a cell: what is above `threshold`, or above the mean where that is less, is
/// marched through.
///
/// All cells are evaluated below step 256, later a quarter of them at random and at most as many of the occupied ones.
pub fn update_nerfacc(
    (occupied, history): (&mut Bitmask, &mut [f32]),
    allowed: &Bitmask,
    radius: f32,
    (seed, n): (u64, u64),
    threshold: f32,
    opacity: impl Fn(&[[f32; 3]]) -> Vec<f32>,
) {
    let r = occupied.resolution;
    let total = r * r * r;
    let [any, some, jitter] = DRAWS;
    let cells: Vec<usize> = if n < ALL_BELOW {
        (0..total).collect()
    } else {
        let quarter = total as u64 / 4;
        let random = (0..quarter).map(|k| rng::below(seed, n << 4 | any, k, total as u64) as usize);
        let kept_before: Vec<usize> = (0..total).filter(|&i| occupied.get(i)).collect();
        let kept = kept_before.len() as u64;
        let again: Vec<usize> = if kept > quarter {
            (0..quarter).map(|k| kept_before[rng::below(seed, n << 4 | some, k, kept) as usize]).collect()
        } else {
            kept_before
        };
        random.chain(again).collect()
    };
    let cell = 2.0 * radius / r as f32;
    let points: Vec<[f32; 3]> = cells
        .par_iter()
        .enumerate()
        .map(|(k, &i)| {
            let corner = [i / (r * r), i / r % r, i % r];
            std::array::from_fn(|a| {
                let within = rng::uniform(seed, n << 4 | jitter, (3 * k + a) as u64);
                (corner[a] as f32 + within) * cell - radius
            })
        })
        .collect();
    let opacity = opacity(&points);
    let decayed: Vec<(usize, f32)> =
        cells.iter().zip(&opacity).map(|(&i, &o)| (i, (DECAY * history[i]).max(o))).collect();
    for (i, o) in decayed {
        history[i] = o;
    }
    let mean = history.iter().map(|&v| v as f64).sum::<f64>() / total as f64;
    let threshold = (mean as f32).min(threshold);
    for i in 0..total {
        occupied.set(i, allowed.get(i) && history[i] > threshold);
    }
}

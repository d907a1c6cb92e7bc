//! Updates of the occupancy grid, by a band around the zero level set or by nerfacc's rule. The
//! update functions take the field as a function of points.

use super::bricks::set_bits;
use super::pool::Buffer;
use rayon::prelude::*;
use tiface_base::geom::BitGrid;
use tiface_base::math::rng;

/// Number of warm-up steps, in which nerfacc's rule evaluates every cell. Later updates evaluate a
/// random quarter of all cells, and at most as many of the occupied ones.
pub const WARMUP_STEPS: u64 = 256;
/// Factor by which a cell's stored opacity decays at each evaluation of the cell.
pub const DECAY: f32 = 0.95;
/// Random streams of nerfacc's rule: any cells, occupied cells, points within cells.
pub const STREAMS: [u64; 3] = [5, 6, 7];
/// Opacity above which a cell of a signed-distance field is occupied, unless the mean opacity is
/// less.
pub const OPAQUE: f32 = 1e-3;

/// Width of the band around the zero level set.
#[derive(Clone, Copy, Debug)]
pub struct BandRule {
    /// Half width, in units of 1 / sharpness.
    pub width: f32,
    /// Maximum ratio of the global sharpness to a local one; 1 if the sharpness is global.
    pub soften: f32,
}

/// Updates the occupied and solid cells by a band around the zero level set.
///
/// A cell of `allowed` is occupied if the band (`width` over the local sharpness) may reach it, for
/// gradients up to about one, or if the sdf has the other sign at the center of a neighbor, however
/// steep the field is in between. All other cells with a negative sdf are solid.
///
/// `field` evaluates signed distances at points of `[-radius, radius]³`, and the logarithms of the
/// local sharpness divided by `inv_s`.
pub fn update_band(
    [occupied, solid]: [&mut BitGrid; 2],
    allowed: &BitGrid,
    radius: f32,
    rule: BandRule,
    inv_s: f32,
    field: impl Fn(&[[f32; 3]]) -> Vec<[f32; 2]>,
) {
    /// Cells that are filled together.
    const FILLED: usize = 1 << 16;
    enum Kind {
        Occupied,
        Solid,
        Empty,
    }
    let r = allowed.resolution;
    let cell = 2.0 * radius / r as f32;
    let half_diagonal = 0.5 * 3f32.sqrt() * cell;
    let cells: Vec<usize> = set_bits(&allowed.bits).collect();
    let center = |i: usize| [i / (r * r), i / r % r, i % r].map(|c| (c as f32 + 0.5) * cell - radius);
    // cells that are not evaluated are NaN, which has no sign and never differs in sign from a
    // neighbor
    let [mut f, mut band] = [(); 2].map(|()| Buffer::scratch(r * r * r));
    f.par_chunks_mut(FILLED).for_each(|f| f.fill(f32::NAN));
    band.par_chunks_mut(FILLED).for_each(|band| band.fill(rule.width / inv_s + half_diagonal));
    for cells in cells.chunks(1 << 17) {
        let points: Vec<[f32; 3]> = cells.par_iter().map(|&i| center(i)).collect();
        for (&i, [distance, soft]) in cells.iter().zip(field(&points)) {
            f[i] = distance;
            // even the softest surface does not reach farther
            if distance.abs() < rule.width * rule.soften / inv_s + half_diagonal {
                band[i] = rule.width / (inv_s * soft.exp()) + half_diagonal;
            }
        }
    }
    // softness varies within a cell, so the widest band of a cell and its neighbors counts;
    // otherwise rays would end inside hair
    let widest_near = |i: usize| {
        [1, r, r * r].into_iter().fold(band[i], |widest, stride| {
            let position = i / stride % r;
            let before = if position > 0 { band[i - stride] } else { 0.0 };
            let after = if position + 1 < r { band[i + stride] } else { 0.0 };
            widest.max(before).max(after)
        })
    };
    let kind_of = |&i: &usize| {
        let crossed = [1, r, r * r].into_iter().any(|stride| {
            let position = i / stride % r;
            let is_opposite = |j: usize| f[j] * f[i] < 0.0;
            (position > 0 && is_opposite(i - stride)) || (position + 1 < r && is_opposite(i + stride))
        });
        match f[i].abs() < widest_near(i) || crossed {
            true => Kind::Occupied,
            false if f[i] < 0.0 => Kind::Solid,
            false => Kind::Empty,
        }
    };
    let kinds: Vec<Kind> = cells.par_iter().with_min_len(1 << 14).map(kind_of).collect();
    occupied.bits.fill(0);
    solid.bits.fill(0);
    for (&i, kind) in cells.iter().zip(kinds) {
        match kind {
            Kind::Occupied => occupied.set(i, true),
            Kind::Solid => solid.set(i, true),
            Kind::Empty => {}
        }
    }
}

/// Updates the occupied cells by the rule of nerfacc 0.3.3: a cell of `allowed` is occupied if its
/// decaying maximum of the opacity is above `threshold`, or above the mean if that is less.
///
/// Before step [`WARMUP_STEPS`] all cells are evaluated, later a random quarter of them and at most
/// as many of the occupied ones. `history` holds the maximum of each cell, `[cells]`; `seed` and
/// the step `n` determine the draws, and `opacity` evaluates points of `[-radius, radius]³`.
pub fn update_nerfacc(
    (occupied, history): (&mut BitGrid, &mut [f32]),
    allowed: &BitGrid,
    radius: f32,
    (seed, n): (u64, u64),
    threshold: f32,
    opacity: impl Fn(&[[f32; 3]]) -> Vec<f32>,
) {
    let r = occupied.resolution;
    let total = r * r * r;
    let [any_stream, occupied_stream, jitter_stream] = STREAMS;
    let cells: Vec<usize> = if n < WARMUP_STEPS {
        (0..total).collect()
    } else {
        let quarter = total as u64 / 4;
        let random = (0..quarter).map(|k| rng::below(seed, n << 4 | any_stream, k, total as u64) as usize);
        let occupied_cells: Vec<usize> = (0..total).filter(|&i| occupied.get(i)).collect();
        let occupied_count = occupied_cells.len() as u64;
        let redrawn: Vec<usize> = if occupied_count > quarter {
            (0..quarter)
                .map(|k| {
                    occupied_cells[rng::below(seed, n << 4 | occupied_stream, k, occupied_count) as usize]
                })
                .collect()
        } else {
            occupied_cells
        };
        random.chain(redrawn).collect()
    };
    let cell = 2.0 * radius / r as f32;
    let points: Vec<[f32; 3]> = cells
        .par_iter()
        .enumerate()
        .map(|(k, &i)| {
            let corner = [i / (r * r), i / r % r, i % r];
            std::array::from_fn(|a| {
                let within = rng::uniform(seed, n << 4 | jitter_stream, (3 * k + a) as u64);
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

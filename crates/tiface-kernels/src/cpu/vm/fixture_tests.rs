//! A small field that is defined by formulas. Its expected values were computed by independent
//! code.

use super::mask::Lattice;
use super::*;

pub fn grid() -> Grid {
    Grid { size: [5, 6, 7], rank: [2, 1, 1] }
}

/// Returns a field over the published scene box, with step ratio ½: step 0.2918889, 17 samples.
pub fn field() -> VmField {
    let (min, max) = ([-1.5, -1.67, -1.0], [1.5, 1.67, 1.0]);
    let extent = [3.0, 3.34, 2.0];
    VmField {
        density: grid(),
        color: grid(),
        decoder: decoder(),
        lattice: Lattice {
            min,
            max,
            step: step_size(extent, [5, 6, 7], 0.5),
            samples: 17,
            near: 3.5,
            far: 7.0,
        },
        shading: Shading {
            softplus: false,
            shift: -10.0,
            distance_scale: 25.0,
            weight_threshold: 1e-4,
            stop: 0.0,
            group_weight: 0.0,
        },
        mask: None,
    }
}

pub fn decoder() -> DecoderShape {
    DecoderShape { channels: 4, features: 27, hidden: 128, view_frequencies: 0, feature_frequencies: 0 }
}

fn values(plane: impl Fn(f32, f32, f32, f32) -> f32, line: impl Fn(f32, f32, f32) -> f32) -> Vec<f32> {
    let g = grid();
    let mut out = Vec::new();
    for i in 0..3 {
        let f = g.plane(i);
        for h in 0..f.height {
            for w in 0..f.width {
                out.extend((0..f.channels).map(|c| plane(c as f32, i as f32, h as f32, w as f32)));
            }
        }
    }
    for i in 0..3 {
        let f = g.line(i);
        for k in 0..f.width {
            out.extend((0..f.channels).map(|c| line(c as f32, i as f32, k as f32)));
        }
    }
    out
}

pub fn density() -> Vec<f32> {
    values(
        |c, i, h, w| 0.1 * (c + 1.0) * (i + 1.0) + 0.03 * h + 0.01 * w,
        |c, i, k| 0.2 * (c + 1.0) - 0.02 * k * (i + 1.0),
    )
}

pub fn color() -> Vec<f32> {
    values(
        |c, i, h, w| 0.2 * (c + 1.0) * (i + 1.0) - 0.02 * h + 0.05 * w,
        |c, i, k| 0.3 * (c + 1.0) - 0.01 * k * (i + 1.0),
    )
}

/// Returns flat decoder weights.
pub fn network() -> Vec<f32> {
    let mut flat = Vec::new();
    for (p, (out, inputs)) in decoder().shapes().into_iter().enumerate() {
        for o in 0..out {
            for j in 0..inputs {
                let wave = (0.7 * o as f64 + 1.3 * j as f64 + 1.0).sin();
                flat.push(match p {
                    0 => 2.0 * wave,
                    1 | 3 | 5 => 0.4 * wave,
                    _ => 0.01 * (o as f64).cos(),
                } as f32);
            }
        }
    }
    flat
}

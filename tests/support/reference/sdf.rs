//! The signed-distance field: see [`tiface_kernels::cpu::sdf`].

use super::{Real, harmonics, sigmoid};
use std::array::from_fn;
use tiface_kernels::cpu::hash;
use tiface_kernels::cpu::sdf::FieldShape;

/// What the geometry network reads at a point, `[3 + 2 levels]`, position first, and the
/// derivatives of that by the point. The cells are those of the f32 kernel: at their borders
/// derivatives jump.
pub(crate) fn features<R: Real>(shape: &FieldShape, table: &[[R; 2]], x: [f32; 3]) -> (Vec<R>, Vec<[R; 3]>) {
    let r = shape.radius as f64;
    let k = shape.layout().inputs;
    let (mut u, mut du) = (vec![R::of(0.0); k], vec![[R::of(0.0); 3]; k]);
    for a in 0..3 {
        u[a] = R::of(x[a] as f64 / r);
        du[a][a] = R::of(1.0 / r);
    }
    for (l, level) in shape.levels.iter().enumerate().take(shape.active) {
        let x01: [f32; 3] = from_fn(|a| x[a] * (0.5 / shape.radius) + 0.5);
        let mut found = hash::Cells::default();
        hash::cells::<true>(level, &[x01; hash::LANES], &mut found);
        let (index, fraction) = found;
        let f: [f64; 3] = from_fn(|a| {
            let p = level.scale as f64 * (x[a] as f64 * (0.5 / r) + 0.5) + 0.5;
            p - (p - fraction[a][0] as f64).round()
        });
        let slope = level.scale as f64 * 0.5 / r;
        for c in 0..8 {
            let bit = |a: usize| c >> a & 1 == 1;
            let w: [f64; 3] = from_fn(|a| if bit(a) { f[a] } else { 1.0 - f[a] });
            let e = table[level.offset + index[c][0] as usize];
            for j in 0..2 {
                u[3 + 2 * l + j] += R::of(w[0] * w[1] * w[2]) * e[j];
                for a in 0..3 {
                    let sign = if bit(a) { 1.0 } else { -1.0 };
                    let by = sign * slope * w[(a + 1) % 3] * w[(a + 2) % 3];
                    du[3 + 2 * l + j][a] += R::of(by) * e[j];
                }
            }
        }
    }
    (u, du)
}

/// The field's eight outputs at a point seen along `d`; `flat` are the networks' weights.
pub(crate) fn field<R: Real>(
    shape: &FieldShape,
    table: &[[R; 2]],
    flat: &[R],
    x: [f32; 3],
    d: [f32; 3],
) -> [R; 8] {
    let layout = shape.layout();
    let mut start = 0;
    let mats = layout.shapes().map(|(o, i)| {
        start += o * i;
        &flat[start - o * i..start]
    });
    let k = layout.inputs;
    let (u, du) = features(shape, table, x);
    let mut o = [R::of(0.0); 13];
    let mut n = [R::of(0.0); 3];
    o.copy_from_slice(mats[3]);
    for j in 0..64 {
        let z: R = mats[1][j] + (0..k).map(|i| mats[0][j * k + i] * u[i]).sum::<R>();
        let steep = R::of(100.0) * z;
        let h = if steep.value() > 40.0 { z } else { steep.exp().ln_1p() / R::of(100.0) };
        let s = sigmoid(steep);
        for (c, o) in o.iter_mut().enumerate() {
            *o += mats[2][c * 64 + j] * h;
        }
        for a in 0..3 {
            n[a] += mats[2][j] * s * (0..k).map(|i| mats[0][j * k + i] * du[i][a]).sum::<R>();
        }
    }
    let length = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
    let length = if length.value() > 1e-12 { length } else { R::of(1e-12) };
    let mut c0 = o.to_vec();
    c0.extend(harmonics(d.map(f64::from)).map(R::of));
    c0.extend(n.map(|v| v / length));
    if layout.color_skip {
        c0.extend_from_slice(&u[3..]);
    }
    let dense = |m: &[R], v: &[R]| -> Vec<R> {
        m.chunks(v.len()).map(|row| row.iter().zip(v).map(|(a, b)| *a * *b).sum()).collect()
    };
    let relu = |v: Vec<R>| v.into_iter().map(R::relu).collect::<Vec<_>>();
    let rgb = dense(mats[6], &relu(dense(mats[5], &relu(dense(mats[4], &c0)))));
    let soft = R::of(-(shape.soften as f64)) * sigmoid(o[12] - R::of(2.0));
    [o[0], n[0], n[1], n[2], sigmoid(rgb[0]), sigmoid(rgb[1]), sigmoid(rgb[2]), soft]
}

//! Instant-NeRF's field: see [`tiface_kernels::cpu::density`].

use super::sdf::features;
use super::{Real, harmonics, sigmoid};
use tiface_kernels::cpu::density::DensityShape;
use tiface_kernels::cpu::sdf::FieldShape;

/// Density and color at a point seen along `d`; `flat` are the networks' weights.
pub(crate) fn field<R: Real>(
    shape: &DensityShape,
    table: &[[R; 2]],
    flat: &[R],
    x: [f32; 3],
    d: [f32; 3],
) -> (R, [R; 3]) {
    let active = shape.levels.len();
    let grid = FieldShape {
        levels: shape.levels.clone(),
        radius: shape.radius,
        active,
        color_skip: false,
        soften: 0.0,
    };
    let u = features(&grid, table, x).0[3..].to_vec();
    let mut rest = flat;
    let m = shape.shapes().map(|(o, i)| {
        let (own, tail) = rest.split_at(o * i);
        rest = tail;
        own
    });
    let dense = |m: &[R], v: &[R]| -> Vec<R> {
        m.chunks(v.len()).map(|row| row.iter().zip(v).map(|(a, b)| *a * *b).sum()).collect()
    };
    let relu = |v: Vec<R>| v.into_iter().map(R::relu).collect::<Vec<_>>();
    let o = dense(m[1], &relu(dense(m[0], &u)));
    let mut c = o.clone();
    c.extend(harmonics(d.map(f64::from)).map(R::of));
    let rgb = dense(m[4], &relu(dense(m[3], &relu(dense(m[2], &c)))));
    ((o[0] - R::of(1.0)).exp(), [rgb[0], rgb[1], rgb[2]].map(sigmoid))
}

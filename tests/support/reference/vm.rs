//! TensoRF's field and its rays: see [`tiface_kernels::cpu::vm`].

use super::tape::{self, Var};
use super::{Real, sigmoid};
use std::array::from_fn;
use tiface_base::geom::Ray;
use tiface_kernels::cpu::vm::mask::Walk;
use tiface_kernels::cpu::vm::{Grid, LINE_AXIS, PLANE_AXES, RAY_WIDTH, VmField};

/// Plane times line of every channel at a point.
pub(crate) fn products<R: Real>(f: &VmField, grid: &Grid, values: &[R], p: [f64; 3]) -> Vec<R> {
    let l = &f.lattice;
    let cell = |a: usize| {
        let last = (grid.size[a] - 1) as f64;
        let u = (p[a] - l.min[a] as f64) / (l.max[a] as f64 - l.min[a] as f64) * last;
        let u = u.clamp(0.0, last);
        let i = (u as usize).min(grid.size[a] - 2);
        (i, u - i as f64)
    };
    let mut out = Vec::new();
    for i in 0..3 {
        let (pl, li) = (grid.plane(i), grid.line(i));
        let ((x0, fx), (y0, fy)) = (cell(PLANE_AXES[i].0), cell(PLANE_AXES[i].1));
        let (z0, fz) = cell(LINE_AXIS[i]);
        for c in 0..grid.rank[i] {
            let at = |y: usize, x: usize| values[pl.start + (y * pl.width + x) * pl.channels + c];
            let mix = |a: R, b: R, t: f64| R::of(1.0 - t) * a + R::of(t) * b;
            let plane =
                mix(mix(at(y0, x0), at(y0, x0 + 1), fx), mix(at(y0 + 1, x0), at(y0 + 1, x0 + 1), fx), fy);
            let along = |k: usize| values[li.start + k * li.channels + c];
            let line = mix(along(z0), along(z0 + 1), fz);
            out.push(plane * line);
        }
    }
    out
}

/// The density at a point.
pub(crate) fn density<R: Real>(f: &VmField, values: &[R], p: [f64; 3]) -> R {
    let feature: R = products(f, &f.density, values, p).into_iter().sum();
    if !f.shading.softplus {
        return feature.relu();
    }
    let x = feature + R::of(f.shading.shift as f64);
    x.relu() + (-x.abs()).exp().ln_1p()
}

/// The color of a point, from its products.
pub(crate) fn decode<R: Real>(f: &VmField, network: &[R], products: &[R], d: [f32; 3]) -> [R; 3] {
    let s = &f.decoder;
    let mut m = Vec::new();
    let mut rest = network;
    for (o, i) in s.shapes() {
        let (own, tail) = rest.split_at(o * i);
        rest = tail;
        m.push((own, o, i));
    }
    let times = |k: usize, v: &[R]| -> Vec<R> {
        let (w, o, i) = m[k];
        (0..o).map(|r| (0..i).map(|c| w[r * i + c] * v[c]).sum()).collect()
    };
    let a = times(0, products);
    let d = d.map(|v| R::of(v.into()));
    let mut input = [a.clone(), d.to_vec()].concat();
    for (v, n) in [(&a[..], s.feature_frequencies), (&d[..], s.view_frequencies)] {
        for trig in [R::sin, R::cos] {
            input.extend(v.iter().flat_map(|v| (0..n).map(move |k| trig(*v * R::of((1 << k) as f64)))));
        }
    }
    let layer =
        |k: usize, v: &[R]| -> Vec<R> { times(k, v).iter().zip(m[k + 1].0).map(|(y, b)| *y + *b).collect() };
    let relu = |v: Vec<R>| -> Vec<R> { v.into_iter().map(R::relu).collect() };
    let rgb = layer(5, &relu(layer(3, &relu(layer(1, &input)))));
    from_fn(|c| sigmoid(rgb[c]))
}

/// Gradient of Σ g · [`render`] by all weights `x`.
pub(crate) fn gradient(f: &VmField, x: &[f64], (rays, jitter): (&[Ray], &[f32]), g: &[f32]) -> Vec<f64> {
    let loss = |x: &[Var]| {
        render(f, x, rays, jitter).into_iter().zip(g).map(|(out, g)| out * Var::of(f64::from(*g))).sum()
    };
    tape::gradient(x, loss).1
}

/// `[rays, 5]` of the weights `x`: density's grid, appearance's grid, decoder. No ray ends early.
/// `jitter` has one number a ray.
pub(crate) fn render<R: Real>(f: &VmField, x: &[R], rays: &[Ray], jitter: &[f32]) -> Vec<R> {
    let (of_density, rest) = x.split_at(f.density.len());
    let (of_color, network) = rest.split_at(f.color.len());
    let mut all = Vec::new();
    assert_eq!(rays.len(), jitter.len());
    for (ray, &jitter) in rays.iter().zip(jitter) {
        let color_at =
            |p: [f64; 3]| decode(f, network, &products(f, &f.color, of_color, p), ray.direction.to_array());
        let mut light = R::of(1.0);
        let mut out = [R::of(0.0); RAY_WIDTH];
        let mut waiting = (R::of(0.0), None); // weight that has no color yet, and its last point
        let mut color = None;
        let mut walk = Walk::new(&f.lattice, f.mask.as_ref(), ray, jitter);
        while let Some(t) = walk.advance() {
            let p = from_fn(|a| ray.origin[a] as f64 + t as f64 * ray.direction[a] as f64);
            let sigma = density(f, of_density, p);
            let length = f.lattice.step as f64 * f.shading.distance_scale as f64;
            let alpha = R::of(1.0) - (-sigma * R::of(length)).exp();
            let w = light * alpha;
            light = light * (R::of(1.0 + 1e-10) - alpha);
            if w.value() > f.shading.weight_threshold as f64 {
                waiting = (waiting.0 + w, Some(p));
                if waiting.0.value() >= f.shading.group_weight as f64 {
                    let c = color_at(p);
                    (0..3).for_each(|k| out[k] += waiting.0 * c[k]);
                    (waiting, color) = ((R::of(0.0), None), Some(c));
                }
            }
            out[3] += w;
            out[4] += w * R::of(t as f64);
        }
        if let (w, Some(p)) = waiting {
            let c = color.unwrap_or_else(|| color_at(p));
            (0..3).for_each(|k| out[k] += w * c[k]);
        }
        all.extend(out);
    }
    all
}

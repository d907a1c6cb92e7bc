//! TensoRF's field and its rays: see [`crate::kernel::vm`].

use super::sigmoid;
use crate::kernel::march::MarchRay;
use crate::kernel::vm::mask::Walk;
use crate::kernel::vm::{Grid, LINE_AXIS, PLANE_AXES, RAY_WIDTH, VmField};
use std::array::from_fn;

/// Plane times line of every channel at a point.
pub(crate) fn products(f: &VmField, grid: &Grid, values: &[f64], p: [f64; 3]) -> Vec<f64> {
    let l = &f.lattice;
    let place = |a: usize| {
        let last = (grid.size[a] - 1) as f64;
        let u = (p[a] - l.min[a] as f64) / (l.max[a] as f64 - l.min[a] as f64) * last;
        let u = u.clamp(0.0, last);
        let i = (u as usize).min(grid.size[a] - 2);
        (i, u - i as f64)
    };
    let mut out = Vec::new();
    for i in 0..3 {
        let (pl, li) = (grid.plane(i), grid.line(i));
        let ((x0, fx), (y0, fy)) = (place(PLANE_AXES[i].0), place(PLANE_AXES[i].1));
        let (z0, fz) = place(LINE_AXIS[i]);
        for c in 0..grid.rank[i] {
            let at = |y: usize, x: usize| values[pl.start + (y * pl.width + x) * pl.channels + c];
            let plane = (1.0 - fy) * ((1.0 - fx) * at(y0, x0) + fx * at(y0, x0 + 1))
                + fy * ((1.0 - fx) * at(y0 + 1, x0) + fx * at(y0 + 1, x0 + 1));
            let line = (1.0 - fz) * values[li.start + z0 * li.channels + c]
                + fz * values[li.start + (z0 + 1) * li.channels + c];
            out.push(plane * line);
        }
    }
    out
}

/// The density at a point.
pub(crate) fn density(f: &VmField, values: &[f64], p: [f64; 3]) -> f64 {
    let feature: f64 = products(f, &f.density, values, p).iter().sum();
    if !f.shading.softplus {
        return feature.max(0.0);
    }
    let x = feature + f.shading.shift as f64;
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// The color of a point, from its products.
pub(crate) fn decode(f: &VmField, network: &[f64], products: &[f64], d: [f32; 3]) -> [f64; 3] {
    let s = &f.decoder;
    let mut m = Vec::new();
    let mut rest = network;
    for (o, i) in s.shapes() {
        let (own, tail) = rest.split_at(o * i);
        rest = tail;
        m.push((own, o, i));
    }
    let times = |k: usize, v: &[f64]| -> Vec<f64> {
        let (w, o, i) = m[k];
        (0..o).map(|r| (0..i).map(|c| w[r * i + c] * v[c]).sum()).collect()
    };
    let a = times(0, products);
    let d = d.map(f64::from);
    let mut input = [a.clone(), d.to_vec()].concat();
    for (v, n) in [(&a[..], s.feature_frequencies), (&d[..], s.view_frequencies)] {
        for trig in [f64::sin, f64::cos] {
            input.extend(v.iter().flat_map(|v| (0..n).map(move |k| trig(v * (1 << k) as f64))));
        }
    }
    let layer = |k: usize, v: &[f64]| -> Vec<f64> {
        times(k, v).iter().zip(m[k + 1].0).map(|(y, b)| y + b).collect()
    };
    let relu = |v: Vec<f64>| -> Vec<f64> { v.into_iter().map(|v| v.max(0.0)).collect() };
    let rgb = layer(5, &relu(layer(3, &relu(layer(1, &input)))));
    from_fn(|c| sigmoid(rgb[c]))
}

/// `[rays, 5]` of the weights `x`: density's grid, appearance's grid, decoder. No ray ends early.
pub(crate) fn render(f: &VmField, x: &[f64], rays: &[MarchRay]) -> Vec<f64> {
    let (of_density, rest) = x.split_at(f.density.len());
    let (of_color, network) = rest.split_at(f.color.len());
    let mut all = Vec::new();
    for ray in rays {
        let mut light = 1.0;
        let mut out = [0f64; RAY_WIDTH];
        let mut walk = Walk::new(&f.lattice, f.mask.as_ref(), ray);
        while let Some(t) = walk.advance() {
            let p = from_fn(|a| ray.origin[a] as f64 + t as f64 * ray.direction[a] as f64);
            let sigma = density(f, of_density, p);
            let alpha = 1.0 - (-sigma * f.lattice.step as f64 * f.shading.distance_scale as f64).exp();
            let w = light * alpha;
            light *= 1.0 - alpha + 1e-10;
            if w > f.shading.weight_threshold as f64 {
                let c = decode(f, network, &products(f, &f.color, of_color, p), ray.direction);
                (0..3).for_each(|k| out[k] += w * c[k]);
            }
            out[3] += w;
            out[4] += w * t as f64;
        }
        all.extend(out);
    }
    all
}

//! NeuS from the softest to the sharpest surface, forward and backward, against f64; and fields
//! without a direction.

use super::case::{Cases, StabilityCase, relative, worst};
use super::reference::{neus::composite, wide};
use std::array::from_fn;
use tiface::kernel::cpu::neus::{self, ColorRule, Segments};
use tiface::kernel::cpu::sdf::WIDTH;
use tiface::math::rng;

pub(super) fn cases() -> Vec<StabilityCase> {
    let mut cases = Cases::new("sharpness");
    for inv_s in [1e-6f32, 1e-3, 1.0, 20.0, 1e3, 1e5, 1e6] {
        sharp(&mut cases, inv_s);
    }
    directionless(&mut cases);
    ends(&mut cases);
    cases.done
}

/// Samples of a ray.
const SAMPLES: usize = 24;
/// Rays of a case.
const RAYS: usize = 200;

/// Offsets, directions, places and lengths of many rays.
struct Bundle {
    offsets: Vec<i32>,
    direction: Vec<[f32; 3]>,
    t: Vec<f32>,
    dt: Vec<f32>,
}

impl Bundle {
    fn new() -> Bundle {
        let unit = |i: usize| {
            let d: [f32; 3] = from_fn(|a| rng::normal(41, a as u64, i as u64));
            let length = d.iter().map(|c| c * c).sum::<f32>().sqrt();
            d.map(|c| c / length)
        };
        Bundle {
            offsets: (0..=RAYS).map(|r| (r * SAMPLES) as i32).collect(),
            direction: (0..RAYS).map(unit).collect(),
            t: (0..RAYS * SAMPLES).map(|i| 1.0 + 0.02 * (i % SAMPLES) as f32).collect(),
            dt: vec![0.02; RAYS * SAMPLES],
        }
    }

    fn rays(&self) -> Segments<'_> {
        Segments {
            offsets: &self.offsets,
            direction: &self.direction,
            t: &self.t,
            dt: &self.dt,
            colors: ColorRule { min_weight: 0.0, group_weight: 0.0 },
        }
    }

    /// Distances that cross zero somewhere on each ray, on a scale that the sharpness can tell;
    /// drawn gradients and colors.
    fn field(&self, inv_s: f32) -> Vec<f32> {
        let reach = (4.0 / inv_s).clamp(1e-6, 1.0);
        let one = |i: usize| -> [f32; WIDTH] {
            let n = |k: u64| rng::normal(42, k, i as u64);
            let u = |k: u64| rng::uniform(43, k, i as u64);
            let soft = if inv_s > 1e-6 { -u(7) } else { 0.0 }; // no softer than the softest
            [reach * n(0), n(1), n(2), n(3), u(4), u(5), u(6), soft]
        };
        (0..RAYS * SAMPLES).flat_map(one).collect()
    }
}

/// One sharpness: what comes out, its gradients by every value of the field, and by the sharpness.
fn sharp(cases: &mut Cases, inv_s: f32) {
    let bundle = Bundle::new();
    let (rays, field) = (bundle.rays(), bundle.field(inv_s));
    let (wide, s, anneal) = (wide(&field), inv_s as f64, 0.6f32);
    let name = format!("sharpness {inv_s:e}");
    let out = neus::forward(rays, &field, inv_s, anneal);
    let want = composite(rays, &wide, s, anneal as f64);
    cases.add(format!("{name}: composited"), relative(out, &want, 1.0), 5e-6, "absolute");

    let g: Vec<f32> = (0..RAYS * neus::RAY_WIDTH).map(|i| rng::normal(44, 0, i as u64)).collect();
    let (by_field, by_s) = neus::backward(rays, &field, inv_s, anneal, &g);
    let loss = |out: &[f64], r: usize| -> f64 {
        let own = r * neus::RAY_WIDTH..(r + 1) * neus::RAY_WIDTH;
        out[own.clone()].iter().zip(&g[own]).map(|(o, g)| o * *g as f64).sum()
    };
    // one value of the same place on every ray at a time: rays do not know each other
    let mut slopes = vec![0f64; field.len()];
    for at in 0..SAMPLES * WIDTH {
        let h = [1e-5 / s, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-4][at % WIDTH];
        let moved = |h: f64| {
            let mut f = wide.clone();
            (0..RAYS).for_each(|r| f[r * SAMPLES * WIDTH + at] += h);
            composite(rays, &f, s, anneal as f64)
        };
        let (up, down) = (moved(h), moved(-h));
        (0..RAYS)
            .for_each(|r| slopes[r * SAMPLES * WIDTH + at] = (loss(&up, r) - loss(&down, r)) / (2.0 * h));
    }
    // each kind of value on its own scale; near a soft surface, where P and N are about 1/2, their
    // difference is known to 3e-8 beside an ε of 1e-5
    let error = |kinds: std::ops::Range<usize>| {
        let own = |i: &usize| kinds.contains(&(i % WIDTH));
        let size = (0..field.len()).filter(own).map(|i| slopes[i] * slopes[i]).sum::<f64>();
        let off = (0..field.len()).filter(own).map(|i| (slopes[i] - by_field[i] as f64).powi(2)).sum::<f64>();
        (off / size.max(1e-30)).sqrt()
    };
    for (what, kinds, bound) in [("distance", 0..1, 0.02), ("gradient", 1..4, 0.02), ("color", 4..7, 5e-3)] {
        cases.add(format!("{name}: gradient by {what}"), error(kinds), bound, "relative");
    }
    let ln = |h: f64| -> f64 {
        let out = composite(rays, &wide, s * h.exp(), anneal as f64);
        (0..RAYS).map(|r| loss(&out, r)).sum()
    };
    let (slope, got) = ((ln(1e-4) - ln(-1e-4)) / 2e-4, by_s as f64 * s);
    let size = slopes.iter().skip(7).step_by(WIDTH).map(|v| v * v).sum::<f64>().sqrt();
    cases.add(format!("{name}: gradient by itself"), (slope - got).abs() / size, 0.05, "relative");
}

/// Fields whose gradient has no direction, or hardly one.
fn directionless(cases: &mut Cases) {
    let bundle = Bundle::new();
    let g: Vec<f32> = (0..RAYS * neus::RAY_WIDTH).map(|i| rng::normal(45, 0, i as u64)).collect();
    for length in [0.0f32, 1e-38, 1e-20, 1e-7, 1e-5, 1e18] {
        let mut largest = Vec::new();
        for inv_s in [1e-6f32, 1.0, 1e3, 1e6] {
            let mut field = bundle.field(inv_s);
            field.chunks_exact_mut(WIDTH).for_each(|f| (1..4).for_each(|k| f[k] *= length));
            let out = neus::forward(bundle.rays(), &field, inv_s, 1.0);
            let (by_field, by_s) = neus::backward(bundle.rays(), &field, inv_s, 1.0, &g);
            let finite = |v: &f32| if v.is_finite() { v.abs() as f64 } else { f64::NAN };
            largest.push(worst(out.iter().chain(&by_field[..]).chain([&by_s]).map(finite)));
        }
        // a direction's gradient is that of a unit vector by the length; by the distance up to the
        // sharpness
        cases.add(format!("gradient of length {length:e}: largest number"), worst(largest), 1e8, "absolute");
    }
}

/// At the ends of the range in which the variance is kept, the surface is still asked to become
/// softer or sharper.
fn ends(cases: &mut Cases) {
    let bundle = Bundle::new();
    let g: Vec<f32> = (0..RAYS * neus::RAY_WIDTH).map(|i| rng::normal(46, 0, i as u64)).collect();
    for variance in [-1.38f32, 1.38] {
        let inv_s = (10.0 * variance).exp();
        let (_, by_s) = neus::backward(bundle.rays(), &bundle.field(inv_s), inv_s, 1.0, &g);
        let frozen = if by_s.is_finite() && by_s != 0.0 { 0.0 } else { 1.0 };
        cases.add(format!("variance {variance}: a gradient is left"), frozen, 0.0, "freezes");
    }
}

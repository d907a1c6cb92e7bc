//! Fields with known surfaces for the tests and benches of the mesh stage; negative inside.
#![allow(dead_code)]

use glam::Vec3;
use rayon::prelude::*;

/// Polynomial smooth minimum (Quilez): differs from `min` only where |a − b| < k.
fn smooth_min(a: f32, b: f32, k: f32) -> f32 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - h * h * k * 0.25
}

fn ellipsoid(p: Vec3, center: [f32; 3], radii: [f32; 3]) -> f32 {
    let r = Vec3::from(radii);
    let q = p - Vec3::from(center);
    let (k0, k1) = ((q / r).length(), (q / (r * r)).length());
    if k1 > 0.0 { k0 * (k0 - 1.0) / k1 } else { -r.min_element() }
}

fn capsule(p: Vec3, a: [f32; 3], b: [f32; 3], r: f32) -> f32 {
    let (a, b) = (Vec3::from(a), Vec3::from(b));
    let t = ((p - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
    p.distance(a + t * (b - a)) - r
}

/// A head in [-1, 1]³ looking along +z, +y up: skull, jaw, neck, nose, lips, ears, eye sockets and
/// fine wrinkles. One closed piece.
pub fn head(p: Vec3) -> f32 {
    let mirrored = Vec3::new(p.x.abs(), p.y, p.z);
    let mut f = ellipsoid(p, [0.0, 0.22, -0.06], [0.46, 0.52, 0.55]);
    f = smooth_min(f, ellipsoid(p, [0.0, -0.18, 0.10], [0.34, 0.42, 0.40]), 0.15);
    f = smooth_min(f, capsule(p, [0.0, -0.30, -0.12], [0.0, -0.72, -0.16], 0.21), 0.12);
    f = smooth_min(f, capsule(p, [0.0, 0.10, 0.46], [0.0, -0.08, 0.58], 0.06), 0.08);
    f = smooth_min(f, ellipsoid(mirrored, [0.05, -0.11, 0.52], [0.06, 0.04, 0.06]), 0.05);
    f = smooth_min(f, ellipsoid(p, [0.0, -0.245, 0.475], [0.11, 0.025, 0.05]), 0.03);
    f = smooth_min(f, ellipsoid(p, [0.0, -0.305, 0.465], [0.09, 0.03, 0.05]), 0.03);
    // eye sockets: smooth subtraction
    f = -smooth_min(-f, ellipsoid(mirrored, [0.17, 0.12, 0.53], [0.10, 0.07, 0.10]), 0.06);
    f = smooth_min(f, ellipsoid(mirrored, [0.17, 0.12, 0.43], [0.08, 0.08, 0.08]), 0.02);
    // ears: a plate with a bowl
    let ear = ellipsoid(mirrored, [0.48, 0.05, -0.08], [0.05, 0.16, 0.10]);
    let bowl = ellipsoid(mirrored, [0.54, 0.06, -0.06], [0.05, 0.10, 0.06]);
    f = smooth_min(f, -smooth_min(-ear, bowl, 0.03), 0.05);
    f + 0.002 * (60.0 * p.y).sin() * (47.0 * p.x + 11.0 * p.z).sin()
}

/// The head's surface with a gradient norm between about 0.5 and 2, as trained fields have.
pub fn bent_head(p: Vec3) -> f32 {
    let bend = 1.0 + 0.6 * (7.0 * p.x).sin() * (5.0 * p.y + 1.0).cos() + 0.35 * (9.0 * p.z).sin();
    head(p) * bend.max(0.3)
}

/// A gyroid sheet, cut by the box.
pub fn gyroid(p: Vec3) -> f32 {
    let q = 12.0 * p;
    let (s, c) = (Vec3::new(q.x.sin(), q.y.sin(), q.z.sin()), Vec3::new(q.x.cos(), q.y.cos(), q.z.cos()));
    (s.x * c.y + s.y * c.z + s.z * c.x).abs() / 12.0 - 0.03
}

/// `n³` nodes over [-1, 1]³, x fastest; with the node distance.
pub fn grid(field: impl Fn(Vec3) -> f32 + Sync, n: usize) -> (Vec<f32>, f32) {
    let h = 2.0 / (n - 1) as f32;
    let at = |i: usize| (-1.0 + i as f64 * f64::from(h)) as f32;
    let mut values = vec![0.0; n * n * n];
    values.par_chunks_mut(n * n).enumerate().for_each(|(k, plane)| {
        for (i, v) in plane.iter_mut().enumerate() {
            *v = field(Vec3::new(at(i % n), at(i / n), at(k)));
        }
    });
    (values, h)
}

/// Uniform in -1..1 from a counter (SplitMix64).
pub struct Noise(pub u64);

impl Noise {
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    pub fn next(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}

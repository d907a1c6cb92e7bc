//! How the demo head and its background look: albedo, lamps, shine, and the dark room behind.
//!
//! All colors here are linear light. What is *seen* behind the head is a lattice of small round
//! lamps on struts: bright clutter that a reconstruction must not take for the head.

use super::shape::{
    EYE, EYE_RADIUS, HeadMaterial, OFFSET, cloud, combed, lower_lip, noise, smooth, upper_lip,
};
use glam::Vec3;

/// A far lamp: unit direction towards it, its light, whether it throws a shadow.
pub(super) struct Lamp {
    pub towards: Vec3,
    pub light: Vec3,
    pub shadow: bool,
}

/// Returns the lamps that light the head: key from the upper left, fill from the right, one from
/// behind and above, one from below in front.
pub(super) fn lamps() -> [Lamp; 4] {
    let lamp = |x: f32, y: f32, z: f32, light: [f32; 3], shadow| Lamp {
        towards: Vec3::new(x, y, z).normalize(),
        light: light.into(),
        shadow,
    };
    [
        lamp(0.65, -0.75, 0.60, [0.84, 0.80, 0.74], true),
        lamp(-0.85, -0.55, 0.20, [0.38, 0.41, 0.46], true),
        lamp(0.10, 0.80, 0.60, [0.42, 0.40, 0.40], false),
        lamp(0.05, -0.60, -0.70, [0.12, 0.12, 0.12], false),
    ]
}

/// How a surface reflects light at a point.
pub(super) struct Reflectance {
    pub albedo: Vec3,
    /// Strength and exponent of the shine.
    pub shine: (f32, f32),
}

/// Returns the surface at `q` (head coordinates) made of `material`.
pub(super) fn reflectance(q: Vec3, material: HeadMaterial) -> Reflectance {
    match material {
        HeadMaterial::Skin => Reflectance { albedo: skin(q), shine: (0.10, 22.0) },
        HeadMaterial::Eye => Reflectance { albedo: eye(q), shine: (0.55, 160.0) },
        HeadMaterial::Hair => Reflectance { albedo: hair(q), shine: (0.07, 14.0) },
        HeadMaterial::Garment => Reflectance { albedo: garment(q), shine: (0.01, 8.0) },
    }
}

fn skin(q: Vec3) -> Vec3 {
    let s = Vec3::new(q.x.abs(), q.y, q.z);
    let mut c = Vec3::new(0.56, 0.335, 0.235);
    c *= 0.86 + 0.28 * cloud(q * 55.0);
    c *= 0.95 + 0.10 * noise(q * 420.0);
    let freckles = smooth(0.80, 0.92, noise(q * 330.0)) * smooth(0.035, 0.0, (q.z + 0.018).abs());
    c *= Vec3::ONE - 0.35 * freckles * Vec3::new(0.55, 0.75, 0.85);
    let flush = |at: Vec3, radius: f32| smooth(radius, 0.0, s.distance(at));
    let red = 0.8 * flush(Vec3::new(0.040, -0.080, -0.030), 0.034)
        + 0.9 * flush(Vec3::new(0.0, -0.122, -0.032), 0.020)
        + 0.7 * flush(Vec3::new(0.086, 0.020, -0.002), 0.036);
    c *= Vec3::ONE - red.min(1.0) * Vec3::new(0.02, 0.24, 0.22);

    // lips: inside either lip's tube, fading out towards the skin
    let lips = upper_lip(s).min(lower_lip(s)) + 0.0008 * (noise(q * 700.0) - 0.5);
    let lips = smooth(0.0026, 0.0006, lips) * smooth(-0.07, -0.08, q.y);
    c = c
        .lerp(Vec3::new(0.43, 0.135, 0.120) * (0.85 + 0.3 * noise(q * Vec3::new(900.0, 200.0, 200.0))), lips);

    // brows: an arc over each eye, thin towards the temple, of single dark hairs
    let along = ((s.x - 0.012) / 0.040).clamp(0.0, 1.0);
    let arc = 0.0205 + 0.0075 * (std::f32::consts::PI * (0.25 + 0.6 * along)).sin() - 0.004 * along;
    let width = 0.0050 - 0.0032 * along;
    let ragged = 0.0028 * (noise(Vec3::new(q.x * 700.0 + q.z * 500.0, q.z * 160.0, 1.0)) - 0.5);
    let brow = smooth(width, width * 0.35, (s.z - arc).abs() + ragged)
        * smooth(0.0095, 0.0135, s.x)
        * smooth(0.055, 0.050, s.x)
        * smooth(-0.055, -0.065, q.y);
    c = c.lerp(Vec3::new(0.055, 0.030, 0.017), 0.88 * brow);

    // lashes along the edge of the lids, and the darker skin of the sockets
    let rim = (s.distance(EYE) - EYE_RADIUS - 0.0008).abs();
    c *= 1.0 - 0.55 * smooth(0.0010, 0.0, rim) * smooth(-0.083, -0.086, q.y);
    c *= 1.0 - 0.16 * smooth(0.026, 0.012, s.distance(EYE + Vec3::new(0.0, -0.01, 0.0)));

    // a mole, and the shadow of a shaved beard
    c *= 1.0 - 0.75 * smooth(0.0030, 0.0018, q.distance(Vec3::new(-0.0360, -0.0760, -0.0440)));
    let beard = smooth(-0.040, -0.070, q.z)
        * smooth(0.030, 0.0, q.y)
        * smooth(-0.128, -0.112, q.z)
        * (1.0 - lips)
        * (0.45 + 0.55 * smooth(0.40, 0.75, noise(q * 850.0)));
    c.lerp(Vec3::new(0.20, 0.145, 0.125), 0.34 * beard)
}

fn eye(q: Vec3) -> Vec3 {
    // both eyes look straight ahead, the pupils a little towards each other
    let center = Vec3::new(EYE.x * q.x.signum(), EYE.y, EYE.z);
    let gaze = Vec3::new(-0.06 * q.x.signum(), -1.0, 0.02).normalize();
    let d = (q - center).normalize_or_zero();
    let off = d.dot(gaze).clamp(-1.0, 1.0).acos() * EYE_RADIUS;
    let veins = 0.10 * smooth(0.45, 0.8, cloud(q * 500.0));
    let white = Vec3::new(0.66, 0.62 - veins, 0.58 - veins);
    let rays = 0.65 + 0.7 * noise(Vec3::new(d.x * 40.0, d.z * 40.0, 5.0));
    let iris = Vec3::new(0.085, 0.150, 0.150) * rays;
    let mut c = iris.lerp(Vec3::splat(0.02), smooth(0.0048, 0.0060, off));
    c = c.lerp(white, smooth(0.0057, 0.0065, off));
    c.lerp(Vec3::splat(0.008), smooth(0.0027, 0.0021, off))
}

fn hair(q: Vec3) -> Vec3 {
    let (turned, _) = combed(q);
    let strand =
        0.6 * noise((turned * 26.0).extend(q.z * 22.0)) + 0.4 * noise((turned * 60.0).extend(q.z * 30.0));
    Vec3::new(0.105, 0.054, 0.026) * (0.45 + 1.15 * strand)
}

fn garment(q: Vec3) -> Vec3 {
    // ribs run down from the collar
    let around = q.x.atan2(q.y - 0.031);
    let weave = 0.85 + 0.15 * (around * 60.0).sin();
    let worn = 0.75 + 0.5 * cloud(q * 40.0);
    let seam = smooth(0.0016, 0.0008, (q.x - 0.012 * (q.z * 30.0).sin()).abs()) * smooth(0.0, -0.01, q.y);
    Vec3::new(0.030, 0.048, 0.105) * weave * worn * 1.15 + 0.05 * seam
}

/// Radius of the sphere of lamps around the head, meters.
const LAMP_RADIUS: f32 = 1.7;

/// Returns what a ray that misses the head sees.
pub(super) fn background(origin: Vec3, direction: Vec3) -> Vec3 {
    // the far wall: |o + t·d| = R
    let o = origin - OFFSET;
    let b = o.dot(direction);
    let t = -b + (b * b - o.length_squared() + LAMP_RADIUS * LAMP_RADIUS).max(0.0).sqrt();
    let p = o + t * direction;

    // rows of lamps every 20 degrees, staggered; struts join the rows
    let step = 20f32.to_radians();
    let latitude = (p.z / LAMP_RADIUS).clamp(-1.0, 1.0).asin();
    let row = (latitude / step).round();
    let around = LAMP_RADIUS * (row * step).cos();
    let in_row = ((around / LAMP_RADIUS * 18.0).round()).max(1.0);
    let turn = std::f32::consts::TAU / in_row;
    let stagger = 0.5 * (row.rem_euclid(2.0));
    let place = ((p.y.atan2(p.x)) / turn - stagger).round() + stagger;
    let (sin, cos) = (place * turn).sin_cos();
    let lamp = Vec3::new(around * cos, around * sin, LAMP_RADIUS * (row * step).sin());
    let near = p.distance(lamp);
    let glow = smooth(0.034, 0.024, near) + 0.10 * (-(near / 0.07).powi(2)).exp();

    let off_row = LAMP_RADIUS * (latitude - row * step).abs();
    let upright = around * (p.y.atan2(p.x) - place * turn).abs();
    let strut = smooth(0.012, 0.006, off_row).max(smooth(0.009, 0.004, upright));
    let wall = 0.0035 + 0.002 * cloud(p * 3.0);
    Vec3::splat(wall) + 0.030 * strut + glow * Vec3::new(1.25, 1.2, 1.1)
}

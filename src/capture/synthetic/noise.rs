//! Smooth value noise and hashed random numbers: the same bits on every machine.

use glam::{IVec3, Vec3};

/// A uniform number in 0..1, a pure function of its three keys.
pub(super) fn unit(seed: u64, a: u32, b: u32) -> f32 {
    let key = seed ^ ((a as u64) << 32 | b as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    (mix(key) >> 40) as f32 / (1u64 << 24) as f32
}

/// SplitMix64's finalizer (Steele, Lea and Flood 2014).
fn mix(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

fn lattice(x: i32, y: i32, z: i32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x8DA6_B343)
        ^ (y as u32).wrapping_mul(0xD816_3841)
        ^ (z as u32).wrapping_mul(0xCB1A_B31F);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    (h ^ (h >> 15)) as f32 / u32::MAX as f32
}

/// Value noise in 0..=1 over a unit lattice, trilinear in cubic-smoothed coordinates: continuous
/// with its slope, which stays below 1.5 per axis.
pub(super) fn noise(p: Vec3) -> f32 {
    let floor = p.floor();
    let f = p - floor;
    let t = f * f * (3.0 - 2.0 * f);
    let i: IVec3 = floor.as_ivec3();
    trilinear(t, |[x, y, z]| lattice(i.x + x, i.y + y, i.z + z))
}

/// Between the corners (0 or 1 along each axis) of a cell, at `t` inside it.
pub(super) fn trilinear(t: Vec3, corner: impl Fn([i32; 3]) -> f32) -> f32 {
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let edge = |y, z| mix(corner([0, y, z]), corner([1, y, z]), t.x);
    let face = |z| mix(edge(0, z), edge(1, z), t.y);
    mix(face(0), face(1), t.z)
}

/// Three octaves of [`noise`], 0..=1.
pub(super) fn cloud(p: Vec3) -> f32 {
    (4.0 * noise(p) + 2.0 * noise(2.03 * p + Vec3::splat(17.0)) + noise(4.1 * p - Vec3::splat(9.0))) / 7.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_meets_its_lattice_and_is_continuous_across_cells() {
        let at = Vec3::new(3.0, -2.0, 5.0);
        assert_eq!(noise(at), lattice(3, -2, 5));
        let (below, above) = (noise(at - Vec3::splat(1e-4)), noise(at + Vec3::splat(1e-4)));
        assert!((below - above).abs() < 1e-3);
    }

    #[test]
    fn hashed_numbers_spread_evenly_over_the_unit_interval() {
        // the mean of 10 000 uniform numbers is 0.5 ± 0.003 (one sigma)
        let mean = (0..10_000).map(|i| unit(7, i, 0) as f64).sum::<f64>() / 1e4;
        assert!((mean - 0.5).abs() < 0.012, "{mean}");
        assert_ne!(unit(7, 1, 0), unit(8, 1, 0));
    }
}

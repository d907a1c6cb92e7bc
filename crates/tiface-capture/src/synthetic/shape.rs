//! The form of the demo head: a bust as one signed-distance function.
//!
//! Ellipsoids, capsules and spheres joined by quadratic smooth unions and cuts (Quilez, "Smooth
//! minimum"), with a hair cap whose surface is displaced along combed strands. World: meters,
//! +Z up, the face looks along −Y. Chin to crown is [`SyntheticHead::HEAD_HEIGHT`].
//!
//! Displacements, and everything else that is drawn, come from smooth value noise and hashed random
//! numbers: the same bits on every machine.

use glam::{IVec3, Vec2, Vec3};
use tiface_base::geom::Aabb;
use tiface_base::math::rng::mix;

/// The demo head. It has one shape; a capture's seed moves cameras and grain, never the surface.
#[derive(Clone, Copy, Debug, Default)]
pub struct SyntheticHead;

/// Material of the surface at a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum HeadMaterial {
    /// Face, ears, neck.
    Skin,
    /// An eyeball between the lids.
    Eye,
    /// The displaced cap on the skull.
    Hair,
    /// Collar and shoulders.
    Garment,
}

/// The unscaled distance to each material.
#[derive(Clone, Copy, Debug)]
pub(super) struct MaterialDistances {
    pub skin: f32,
    pub eye: f32,
    pub hair: f32,
    pub garment: f32,
}

/// Where the middle of the head stands: off the origin, so that a forgotten transform shows.
pub(super) const OFFSET: Vec3 = Vec3::new(0.03, -0.02, 0.05);

/// At least the largest slope of the unscaled function near its surface (measured at 8000 points:
/// 1.69, in the combed hair). Dividing by it makes every value a safe step for a ray.
const LIPSCHITZ: f32 = 1.75;

/// The middle of an eyeball on the +X side, head coordinates.
pub(super) const EYE: Vec3 = Vec3::new(0.0315, -0.0765, 0.004);
/// Radius of an eyeball, meters.
pub(super) const EYE_RADIUS: f32 = 0.0125;

impl SyntheticHead {
    /// Chin to crown without hair, meters: the yardstick for "per cent of head height".
    pub const HEAD_HEIGHT: f32 = 0.25;

    /// Signed distance, meters, negative inside, scaled to a slope of at most 1: never more than
    /// the true distance, about half of it in places. For measuring use
    /// [`SyntheticHead::distance`].
    pub fn sdf(&self, p: Vec3) -> f32 {
        let parts = parts(p - OFFSET);
        parts.whole() / LIPSCHITZ
    }

    /// Gradient of [`SyntheticHead::sdf`] by differences over 0.2 mm at the corners of a
    /// tetrahedron; not of unit length.
    pub fn gradient(&self, p: Vec3) -> Vec3 {
        const H: f32 = 2e-4;
        const CORNERS: [Vec3; 4] = [
            Vec3::new(1.0, -1.0, -1.0),
            Vec3::new(-1.0, -1.0, 1.0),
            Vec3::new(-1.0, 1.0, -1.0),
            Vec3::new(1.0, 1.0, 1.0),
        ];
        CORNERS.iter().map(|&k| k * self.sdf(p + H * k)).sum::<Vec3>() / (4.0 * H)
    }

    /// Normal and material of a surface point for the price of four evaluations, the normal by
    /// one-sided differences: good enough to look at, not to measure with.
    pub(super) fn normal_and_material(&self, p: Vec3) -> (Vec3, HeadMaterial) {
        const H: f32 = 2e-4;
        let q = p - OFFSET;
        let here = parts(q);
        let rise = [Vec3::X, Vec3::Y, Vec3::Z].map(|axis| parts(q + H * axis).whole() - here.whole());
        (Vec3::from_array(rise).normalize_or_zero(), here.material())
    }

    /// Returns the distance from `p` to the surface, meters, ≥ 0, to first order: `|sdf| / |∇sdf|`.
    /// Good within a few millimeters of the surface, where reconstructions are judged.
    pub fn distance(&self, p: Vec3) -> f32 {
        self.sdf(p).abs() / self.gradient(p).length().max(0.05)
    }

    /// Returns the box around the bust, world.
    pub fn bounds(&self) -> Aabb {
        Aabb { min: OFFSET + Vec3::new(-0.122, -0.126, -0.193), max: OFFSET + Vec3::new(0.122, 0.126, 0.148) }
    }

    /// Returns whether `p` is in the part worth judging: the head above the line from jaw to nape,
    /// without neck and shoulders.
    pub fn is_head(&self, p: Vec3) -> bool {
        above_jaw(p - OFFSET)
    }

    /// `count` points on the surface, the same for the same `seed`: random points of the box,
    /// pulled onto the surface by Newton steps. Denser on strongly curved parts.
    pub fn surface_points(&self, count: usize, seed: u64) -> Vec<Vec3> {
        let bounds = self.bounds();
        let mut points = Vec::with_capacity(count);
        let mut draw = 0u32;
        while points.len() < count {
            let u = Vec3::from_array([0, 1, 2].map(|k| unit(seed, draw, k)));
            draw += 1;
            let mut p = bounds.min + u * bounds.size();
            for _ in 0..12 {
                let g = self.gradient(p);
                p -= g * (self.sdf(p) / g.length_squared().max(0.01)).clamp(-0.05, 0.05);
            }
            if self.sdf(p).abs() < 2e-5 && bounds.contains(p) {
                points.push(p);
            }
        }
        points
    }
}

impl MaterialDistances {
    /// Returns the union of all materials; skin and hair meet without a crack.
    pub fn whole(&self) -> f32 {
        union(self.skin.min(self.eye), self.hair, 0.002).min(self.garment)
    }

    pub fn material(&self) -> HeadMaterial {
        let MaterialDistances { skin, eye, hair, garment } = *self;
        let nearest = skin.min(eye).min(hair).min(garment);
        if nearest == garment {
            HeadMaterial::Garment
        } else if nearest == hair {
            HeadMaterial::Hair
        } else if nearest == eye {
            HeadMaterial::Eye
        } else {
            HeadMaterial::Skin
        }
    }
}

/// Returns whether `q`, in head coordinates, is above the line from under the chin to the nape.
fn above_jaw(q: Vec3) -> bool {
    q.z > -0.128 + 0.55 * (q.y + 0.07).max(0.0)
}

/// Distances to every material at `q`, head coordinates.
pub(super) fn parts(q: Vec3) -> MaterialDistances {
    let s = Vec3::new(q.x.abs(), q.y, q.z); // the features are symmetric, the hair is not
    let skull = ellipsoid(q - Vec3::new(0.0, 0.020, 0.043), Vec3::new(0.0745, 0.094, 0.085));
    MaterialDistances {
        skin: skin(q, s, skull),
        eye: sphere(s - EYE, EYE_RADIUS),
        hair: hair(q, skull),
        garment: garment(q),
    }
}

fn skin(q: Vec3, s: Vec3, skull: f32) -> f32 {
    let mut d = skull;
    // each part is evaluated only where its blend can reach
    if q.z > -0.165 {
        let face = ellipsoid(q - Vec3::new(0.0, -0.030, -0.026), Vec3::new(0.059, 0.063, 0.090));
        d = union(d, face, 0.03);
    }
    if q.z > -0.165 && q.z < 0.035 {
        let jaw = cone(s, Vec3::new(0.050, 0.004, -0.052), Vec3::new(0.015, -0.066, -0.100), 0.018, 0.015);
        d = union(d, jaw, 0.024);
        d = union(d, ellipsoid(q - Vec3::new(0.0, -0.079, -0.102), Vec3::new(0.022, 0.019, 0.017)), 0.018);
        d = union(d, sphere(s - Vec3::new(0.043, -0.062, -0.020), 0.017), 0.028);
    }
    if q.z < 0.035 {
        d = union(d, neck(q), 0.022);
    }
    if q.y < -0.04 && q.z < 0.06 && q.z > -0.12 {
        d = features(s, d);
    }
    if s.distance_squared(EAR) < 0.06 * 0.06 { union(d, ear(s), 0.006) } else { d }
}

/// Brow, sockets, lids, nose, mouth: everything in front. `head` is the distance without them.
fn features(s: Vec3, head: f32) -> f32 {
    let brow = cone(s, Vec3::new(0.008, -0.086, 0.021), Vec3::new(0.046, -0.073, 0.021), 0.008, 0.007);
    let mut d = union(head, brow, 0.022);
    d = cut(d, ellipsoid(s - Vec3::new(0.033, -0.099, 0.002), Vec3::new(0.020, 0.016, 0.012)), 0.014);
    // the lids: a shell around the eyeball with an almond cut out of it
    let lid = sphere(s - EYE, EYE_RADIUS + 0.0016);
    let almond = ellipsoid(s - EYE - Vec3::new(0.0005, -0.012, -0.0008), Vec3::new(0.0120, 0.012, 0.0041));
    d = union(d, cut(lid, almond, 0.0015), 0.005);

    let bridge = cone(s, Vec3::new(0.0, -0.084, 0.018), Vec3::new(0.0, -0.1105, -0.029), 0.0080, 0.0105);
    d = union(d, bridge, 0.018);
    d = union(d, sphere(s - Vec3::new(0.0, -0.1125, -0.0325), 0.0098), 0.008);
    d = union(
        d,
        ellipsoid(s - Vec3::new(0.0128, -0.0985, -0.0360), Vec3::new(0.0080, 0.0110, 0.0078)),
        0.009,
    );
    d = cut(d, ellipsoid(s - Vec3::new(0.0065, -0.1060, -0.0450), Vec3::new(0.0034, 0.0062, 0.0045)), 0.003);

    let mound = ellipsoid(s - Vec3::new(0.0, -0.076, -0.066), Vec3::new(0.036, 0.021, 0.027));
    d = union(d, mound, 0.016);
    d = union(d, upper_lip(s), 0.006);
    d = union(d, lower_lip(s), 0.006);
    let seam = cone(s, Vec3::new(0.0, -0.1035, -0.0672), Vec3::new(0.0255, -0.0890, -0.0668), 0.0005, 0.0005);
    d = cut(d, seam, 0.0032);
    let philtrum = cone(s, Vec3::new(0.0, -0.1065, -0.046), Vec3::new(0.0, -0.1045, -0.057), 0.002, 0.003);
    cut(d, philtrum, 0.005)
}

pub(super) fn upper_lip(s: Vec3) -> f32 {
    cone(s, Vec3::new(0.005, -0.0958, -0.0626), Vec3::new(0.0245, -0.0845, -0.0664), 0.0056, 0.0022)
}

pub(super) fn lower_lip(s: Vec3) -> f32 {
    cone(s, Vec3::new(0.0, -0.0945, -0.0728), Vec3::new(0.0215, -0.0850, -0.0685), 0.0068, 0.0025)
}

/// The middle of the ear on the +X side, head coordinates.
const EAR: Vec3 = Vec3::new(0.0765, 0.020, -0.006);

/// Returns a flat leaf leaning back and out, hollowed from the side, with a lobe.
fn ear(s: Vec3) -> f32 {
    let p = s - EAR;
    // u across the leaf, v back, z up; it leans out by 0.45 rad and back by 0.25
    let (u, v) = (0.900 * p.x - 0.435 * p.y, 0.435 * p.x + 0.900 * p.y);
    let (v, z) = (0.969 * v - 0.247 * p.z, 0.247 * v + 0.969 * p.z);
    let leaf = ellipsoid(Vec3::new(u, v, z), Vec3::new(0.0072, 0.0185, 0.0310));
    let lobe = sphere(Vec3::new(u + 0.001, v + 0.007, z + 0.026), 0.0072);
    let shell = union(leaf, lobe, 0.008);
    let bowl = ellipsoid(Vec3::new(u - 0.0100, v + 0.004, z + 0.004), Vec3::new(0.0105, 0.0100, 0.0150));
    let groove = ellipsoid(Vec3::new(u - 0.0065, v - 0.003, z - 0.016), Vec3::new(0.0060, 0.0085, 0.0095));
    cut(cut(shell, bowl, 0.004), groove, 0.004)
}

/// Ends inside the garment, so that only the garment stands on the ground.
fn neck(q: Vec3) -> f32 {
    cone(q, Vec3::new(0.0, 0.026, -0.050), Vec3::new(0.0, 0.035, -0.135), 0.046, 0.0485)
}

/// Shoulders and a collar, cut level underneath.
fn garment(q: Vec3) -> f32 {
    if q.z > -0.095 {
        return q.z + 0.112; // the collar's highest point: a lower bound spares the rest
    }
    let shoulders = ellipsoid(q - Vec3::new(0.0, 0.038, -0.198), Vec3::new(0.124, 0.078, 0.056));
    let collar = ring(q - Vec3::new(0.0, 0.031, -0.146), 0.0530, 0.0062);
    let folds = 0.0030 * (noise(q * Vec3::new(45.0, 45.0, 20.0)) - 0.5);
    let cloth = union(shoulders, collar, 0.022) + folds;
    intersection(cloth, -0.190 - q.z, 0.012)
}

/// Returns a ring of tube radius `tube` around an axis leaning forward like the neck.
fn ring(p: Vec3, radius: f32, tube: f32) -> f32 {
    let z = 0.96 * p.z - 0.28 * p.y;
    let y = 0.28 * p.z + 0.96 * p.y;
    let out = Vec2::new(p.x, y).length() - radius;
    Vec2::new(out, 0.45 * z).length() - tube
}

/// Returns the cap: the skull grown outward, ended by a ragged hairline, displaced along strands.
fn hair(q: Vec3, skull: f32) -> f32 {
    // hair above a plane rising from the nape over the ears to the forehead; sideburns before the
    // ears hang below it, the ears stay free
    let side = smooth(0.055, 0.072, q.x.abs());
    let burn = side * (smooth(-0.045, -0.028, q.y) - smooth(-0.012, 0.002, q.y));
    let over_ear = side * smooth(0.0, 0.012, q.y) * smooth(0.062, 0.045, q.y);
    let line = 0.66 * (-0.012 - q.y) + 0.751 * (0.034 - q.z) - 0.022 * burn + 0.010 * over_ear;
    // clear of the strands' reach a lower bound is enough and spares the noise
    let clear = (skull - 0.022).max(line - 0.012);
    if clear > 0.006 {
        return clear;
    }
    let thick = 0.0085 + 0.007 * smooth(0.05, 0.13, q.z);
    let cap = skull - thick - strands(q);
    // well above the hairline its rags make no difference
    let line = if line > -0.05 { line + fringe(q) } else { line };
    intersection(cap, line, 0.024)
}

/// Returns how far the hairline is pushed back or let down, meters.
fn fringe(q: Vec3) -> f32 {
    let slant = noise(Vec3::new(q.x * 95.0 + 25.0 * q.z, q.y * 60.0, 3.0));
    0.011 * (slant - 0.5)
}

/// Returns where strands run from the whorl, as a unit vector that is the same along each, and the
/// distance from it, meters.
pub(super) fn combed(q: Vec3) -> (Vec2, f32) {
    let from_whorl = Vec2::new(q.x + 0.010, q.y - 0.055);
    let reach = from_whorl.length();
    let bend = 1.2 * noise(q * 28.0);
    let (sin, cos) = (0.35 * bend + 4.0 * reach).sin_cos();
    (Vec2::new(cos, sin).rotate(from_whorl / reach.max(1e-4)), reach)
}

/// Clumps of hair running away from the whorl, meters outward, 0 at the whorl itself.
fn strands(q: Vec3) -> f32 {
    let (turned, reach) = combed(q);
    let amount = (reach / 0.05).min(1.0);
    let broad = noise((turned * 5.0).extend(q.z * 14.0));
    let fine = noise((turned * 14.0).extend(q.z * 20.0 + 7.0));
    amount * (0.0040 * (broad - 0.5) + 0.0022 * (fine - 0.5))
}

fn sphere(p: Vec3, radius: f32) -> f32 {
    p.length() - radius
}

/// First-order distance to an ellipsoid: exact on the surface, right in sign everywhere.
fn ellipsoid(p: Vec3, radii: Vec3) -> f32 {
    let k0 = (p / radii).length();
    let k1 = (p / (radii * radii)).length();
    if k0 < 1e-3 { -radii.min_element() } else { k0 * (k0 - 1.0) / k1 }
}

/// Returns a capsule from `a` to `b` whose radius goes linearly from `ra` to `rb`.
fn cone(p: Vec3, a: Vec3, b: Vec3, ra: f32, rb: f32) -> f32 {
    let (pa, ba) = (p - a, b - a);
    let h = (pa.dot(ba) / ba.length_squared()).clamp(0.0, 1.0);
    (pa - ba * h).length() - (ra + (rb - ra) * h)
}

/// Smooth union: within `k` of each other the two surfaces flow together.
fn union(a: f32, b: f32, k: f32) -> f32 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - 0.25 * k * h * h
}

/// Smooth intersection.
fn intersection(a: f32, b: f32, k: f32) -> f32 {
    -union(-a, -b, k)
}

/// `a` without `b`.
fn cut(a: f32, b: f32, k: f32) -> f32 {
    intersection(a, -b, k)
}

/// 0 below `a`, 1 above `b`, smooth between; `a > b` turns it round.
pub(super) fn smooth(a: f32, b: f32, x: f32) -> f32 {
    let t = ((x - a) / (b - a)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Returns a uniform number in 0..1, a pure function of its three keys.
pub(super) fn unit(seed: u64, a: u32, b: u32) -> f32 {
    let key = seed ^ ((a as u64) << 32 | b as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    (mix(key.wrapping_add(0x9E37_79B9_7F4A_7C15)) >> 40) as f32 / (1u64 << 24) as f32
}

#[inline(always)]
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
    let at = |x, y, z| lattice(i.x + x, i.y + y, i.z + z);
    let low = [at(0, 0, 0), at(1, 0, 0), at(0, 1, 0), at(1, 1, 0)];
    trilinear(t, low, [at(0, 0, 1), at(1, 0, 1), at(0, 1, 1), at(1, 1, 1)])
}

/// Returns the value at `t` inside a cell, between those of its lower and its upper corners, along
/// x first.
#[inline(always)]
pub(super) fn trilinear(t: Vec3, low: [f32; 4], high: [f32; 4]) -> f32 {
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let face = |[a, b, c, d]: [f32; 4]| mix(mix(a, b, t.x), mix(c, d, t.x), t.y);
    mix(face(low), face(high), t.z)
}

/// Three octaves of [`noise`], 0..=1.
pub(super) fn cloud(p: Vec3) -> f32 {
    (4.0 * noise(p) + 2.0 * noise(2.03 * p + Vec3::splat(17.0)) + noise(4.1 * p - Vec3::splat(9.0))) / 7.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn random_points(count: u32) -> impl Iterator<Item = Vec3> {
        let bounds = SyntheticHead.bounds().grown(0.03);
        (0..count)
            .map(move |i| bounds.min + Vec3::from_array([0, 1, 2].map(|k| unit(11, i, k))) * bounds.size())
    }

    #[test]
    fn near_the_surface_the_slope_is_at_most_one_and_seldom_small() {
        let mut slopes: Vec<f32> = SyntheticHead
            .surface_points(8000, 4)
            .iter()
            .map(|&p| {
                SyntheticHead.gradient(p + 0.0008 * SyntheticHead.gradient(p).normalize_or_zero()).length()
            })
            .collect();
        slopes.sort_by(f32::total_cmp);
        // far below wastes steps
        assert!(slopes[7999] <= 1.0 && slopes[7999] > 0.8, "{}", slopes[7999]);
        assert!(slopes[80] > 0.2, "{}", slopes[80]); // all but the creases: 0.28
    }

    #[test]
    fn the_value_is_never_more_than_the_distance_to_any_surface_point() {
        let surface = SyntheticHead.surface_points(3000, 6);
        for p in random_points(3000) {
            let nearest = surface.iter().map(|s| s.distance(p)).fold(f32::INFINITY, f32::min);
            let sdf = SyntheticHead.sdf(p);
            assert!(sdf <= nearest, "{p}: {sdf} but a surface point lies at {nearest}");
        }
    }

    #[test]
    fn the_head_is_a_quarter_of_a_meter_from_chin_to_crown() {
        // down the middle of the skull, bald: q = (0, 0.02, z) leaves the skull at 0.043 + 0.085 =
        // 0.128
        assert!(parts(Vec3::new(0.0, 0.02, 0.128)).skin.abs() < 2e-3);
        // under the chin: 0.128 − 0.25 = −0.122
        let under = parts(Vec3::new(0.0, -0.078, -0.122)).skin;
        assert!(under.abs() < 4e-3, "{under}");
    }

    #[test]
    fn distance_is_half_a_millimeter_half_a_millimeter_off_the_surface() {
        let points = SyntheticHead.surface_points(1000, 5);
        let mut errors: Vec<f32> = points
            .iter()
            .map(|&p| {
                (SyntheticHead.distance(p + 0.0005 * SyntheticHead.gradient(p).normalize_or_zero()) - 0.0005)
                    .abs()
            })
            .collect();
        errors.sort_by(f32::total_cmp);
        // 19 of 20 points within a tenth; in creases "off the surface" is nearer to the other side
        assert!(errors[950] < 0.00005, "{}", errors[950]);
        assert!(points.iter().all(|&p| SyntheticHead.distance(p) < 1e-4));
    }

    #[test]
    fn the_bounds_hold_the_surface_and_nothing_sticks_out() {
        let bounds = SyntheticHead.bounds();
        let inner = Aabb::around(SyntheticHead.surface_points(4000, 1));
        assert!(bounds.contains(inner.min) && bounds.contains(inner.max));
        assert!((bounds.size() - inner.size()).max_element() < 0.03, "{bounds:?} around {inner:?}");
        // outside the box nothing is inside the head
        let loose = random_points(40_000).filter(|&p| !bounds.contains(p));
        assert!(loose.into_iter().all(|p| SyntheticHead.sdf(p) > 0.0));
    }

    #[test]
    fn every_material_shows() {
        let shown: Vec<_> =
            SyntheticHead.surface_points(6000, 2).into_iter().map(|p| parts(p - OFFSET).material()).collect();
        for material in [HeadMaterial::Skin, HeadMaterial::Eye, HeadMaterial::Hair, HeadMaterial::Garment] {
            assert!(shown.contains(&material), "{material:?}");
        }
    }

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

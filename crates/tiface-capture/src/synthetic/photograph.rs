//! Takes one picture of the demo head: sphere tracing, light, supersampled coverage; and how the
//! head and its background look: albedo, lamps, shine, and the dark room behind.
//!
//! A grid of distances sampled once lets rays and shadows stride through empty air for the price
//! of a lookup; the exact function is only evaluated close to the surface.
//!
//! All colors here are linear light. Four far lamps light the head (two of them with shadows)
//! over an even glow from the many lamps around; shine is Blinn–Phong, so it moves with the
//! camera. What is *seen* behind it is a lattice of small round lamps on struts: bright clutter
//! that a reconstruction must not take for the head.

use super::reflectance::{Lamp, background, lamps, reflectance};
use super::shape::{OFFSET, SyntheticHead, noise, parts, trilinear, unit};
use glam::{UVec3, Vec2, Vec3};
use rayon::prelude::*;
use std::sync::OnceLock;
use tiface_base::geom::{Aabb, Camera};
use tiface_base::image::{Gray, Photo, quantize, srgb_from_linear};

/// One picture with its masks.
pub(super) struct SyntheticPhoto {
    pub photo: Photo,
    /// Share of each pixel that the bust covers.
    pub mask: Gray,
    /// 255 where mostly head (hair, face, ears), without neck and garment.
    pub region: Gray,
}

/// Data shared by all pictures.
pub(super) struct Studio {
    head: SyntheticHead,
    grid: DistanceGrid,
    lamps: [Lamp; 4],
}

/// Result of one ray.
#[derive(Clone, Copy, Default)]
struct RayLight {
    /// Linear light, multiplied by `alpha`.
    color: Vec3,
    alpha: f32,
    head: f32,
}

/// Rays that miss the hair by less than this may meet loose hairs: scaled distance, so about 2 mm.
const FUZZ: f32 = 0.0013;
/// Standard deviation of the sensor's grain, coded 0..=1.
const GRAIN: f32 = 0.004;

impl Studio {
    fn new() -> Studio {
        Studio { head: SyntheticHead, grid: DistanceGrid::new(&SyntheticHead), lamps: lamps() }
    }

    /// Returns the one of this process: its distances take longer than a small photograph.
    pub fn shared() -> &'static Studio {
        static STUDIO: OnceLock<Studio> = OnceLock::new();
        STUDIO.get_or_init(Studio::new)
    }

    /// Photographs the head. `seed` makes the grain; everything else follows from the camera.
    pub fn photograph(&self, camera: &Camera, seed: u64) -> SyntheticPhoto {
        let (w, h) = (camera.width, camera.height);
        let pixels: Vec<([u8; 3], u8, u8)> =
            (0..w * h).into_par_iter().map(|i| self.pixel(camera, i % w, i / w, seed)).collect();
        SyntheticPhoto {
            photo: Photo { width: w, height: h, rgb: pixels.iter().map(|p| p.0).collect(), alpha: None },
            mask: Gray { width: w, height: h, values: pixels.iter().map(|p| p.1).collect() },
            region: Gray { width: w, height: h, values: pixels.iter().map(|p| p.2).collect() },
        }
    }

    /// Color, mask and region of one pixel: 2 × 2 rays, 4 × 4 more where the outline crosses it.
    fn pixel(&self, camera: &Camera, x: u32, y: u32, seed: u64) -> ([u8; 3], u8, u8) {
        let average = |side: u32| {
            let mut sum = RayLight::default();
            for k in 0..side * side {
                let inside = Vec2::new((k % side) as f32 + 0.5, (k / side) as f32 + 0.5) / side as f32;
                let Some(ray) = camera.ray(Vec2::new(x as f32, y as f32) + inside) else { continue };
                let seen = self.look(ray.origin, ray.direction);
                sum.color += seen.color;
                if seen.alpha < 1.0 {
                    sum.color += (1.0 - seen.alpha) * background(ray.origin, ray.direction);
                }
                sum.alpha += seen.alpha;
                sum.head += seen.head;
            }
            let n = (side * side) as f32;
            RayLight { color: sum.color / n, alpha: sum.alpha / n, head: sum.head / n }
        };
        let mut seen = average(2);
        if seen.alpha > 0.0 && seen.alpha < 1.0 {
            seen = average(4);
        }
        let color = [0, 1, 2].map(|k| {
            let draw = |n| unit(seed, y * camera.width + x, 4 * k as u32 + n) - 0.5;
            // four uniform numbers of variance 1/12 each: nearly normal with variance 1/3
            let grain = (draw(0) + draw(1) + draw(2) + draw(3)) * 3f32.sqrt() * GRAIN;
            quantize(srgb_from_linear(seen.color[k]) + grain)
        });
        (color, quantize(seen.alpha), if seen.alpha > 0.5 && seen.head > 0.5 { 255 } else { 0 })
    }

    /// Follows one ray to the head.
    fn look(&self, origin: Vec3, direction: Vec3) -> RayLight {
        let Some((enter, leave)) = self.grid.bounds.intersect(origin, direction) else {
            return RayLight::default();
        };
        let mut t = enter.max(0.0);
        let mut closest = (f32::INFINITY, t); // nearest miss, for loose hairs
        let mut before: Option<(f32, f32)> = None; // the exact distance one step ago
        while t < leave {
            let p = origin + t * direction;
            let air = self.grid.air(p);
            if air > 0.002 {
                before = None;
                t += air;
                continue;
            }
            let d = self.head.sdf(p);
            if d < 3e-5 {
                let t = match before {
                    Some(outside) if d < 0.0 => self.cross(origin, direction, outside, (t, d)),
                    _ => t,
                };
                let p = origin + t * direction;
                let head = if self.head.is_head(p) { 1.0 } else { 0.0 };
                return RayLight { color: self.shade(p, direction), alpha: 1.0, head };
            }
            if d < closest.0 {
                closest = (d, t);
            }
            // the distance is scaled down to be safe: where it falls slowly along this ray, stride
            // nearly as far as its own slope promises
            let slope = before.map_or(1.0, |(t0, d0)| (d0 - d) / (t - t0));
            before = Some((t, d));
            t += if slope > 0.1 { (0.95 * d / slope).clamp(d, 3.0 * d) } else { d };
        }
        self.loose_hair(origin + closest.1 * direction, closest.0, direction)
    }

    /// Returns the crossing between a point outside and one inside, each with its distance, usually
    /// to some micrometers: by straight lines between both, halving the distance of an end that
    /// stays (Dowell, Jarratt 1971, the "Illinois" method).
    fn cross(&self, origin: Vec3, direction: Vec3, outside: (f32, f32), inside: (f32, f32)) -> f32 {
        /// Scaled distance below which a point lies on the surface.
        const NEAR: f32 = 2e-6;
        let (mut ends, mut moved) = ([outside, inside], None);
        let between = |[(s, above), (t, below)]: [(f32, f32); 2]| s + (t - s) * (above / (above - below));
        for _ in 0..6 {
            let t = between(ends);
            let d = self.head.sdf(origin + t * direction);
            if d.abs() < NEAR {
                return t;
            }
            let end = usize::from(d < 0.0);
            ends[end] = (t, d);
            if moved.replace(end) == Some(end) {
                ends[1 - end].1 *= 0.5;
            }
        }
        between(ends)
    }

    /// Returns the color of the fringe of single hairs, for a ray that just misses the hair.
    fn loose_hair(&self, p: Vec3, miss: f32, direction: Vec3) -> RayLight {
        if miss > FUZZ {
            return RayLight::default();
        }
        let q = p - OFFSET;
        let parts = parts(q);
        if parts.hair > parts.skin.min(parts.garment) {
            return RayLight::default();
        }
        let fade = 1.0 - miss / FUZZ;
        let alpha = 0.75 * fade * fade * (0.25 + 0.75 * noise(q * 900.0));
        RayLight { color: alpha * self.shade(p, direction), alpha, head: alpha }
    }

    /// Light leaving `p` against `direction`.
    fn shade(&self, p: Vec3, direction: Vec3) -> Vec3 {
        let (normal, material) = self.head.normal_and_material(p);
        let surface = reflectance(p - OFFSET, material);
        let open = self.openness(p, normal);
        // the even light of the many lamps, a little stronger from above
        let mut light = Vec3::new(0.30, 0.30, 0.31) * open * (0.85 + 0.15 * normal.z);
        let mut shine = 0.0;
        for lamp in &self.lamps {
            let facing = normal.dot(lamp.towards);
            // light wraps a little round skin and hair
            let lit = ((facing + 0.12) / 1.12).max(0.0);
            if lit <= 0.0 {
                continue;
            }
            let clear = if lamp.shadow { self.clearance(p + 0.004 * normal, lamp.towards) } else { open };
            light += lamp.light * (lit * clear);
            let half = (lamp.towards - direction).normalize_or_zero();
            shine += lamp.light.y
                * clear
                * normal.dot(half).max(0.0).powf(surface.shine.1)
                * facing.max(0.0).sqrt();
        }
        surface.albedo * light + Vec3::splat(surface.shine.0 * shine)
    }

    /// How open the surface lies to the air around it: distances along the normal, compared with
    /// those over flat ground (Evans 2006).
    fn openness(&self, p: Vec3, normal: Vec3) -> f32 {
        let mut closed = 0.0;
        let mut weight = 1.0;
        for step in [0.004, 0.009, 0.018, 0.034] {
            closed += weight * (step - self.grid.distance(p + step * normal)).max(0.0) / step;
            weight *= 0.7;
        }
        (1.0 - 0.42 * closed).clamp(0.15, 1.0)
    }

    /// Returns the share of a lamp seen from `p`: 0 behind something, soft beside it.
    fn clearance(&self, p: Vec3, towards: Vec3) -> f32 {
        let Some((_, leave)) = self.grid.bounds.intersect(p, towards) else { return 1.0 };
        let (mut t, mut open) = (0.006f32, 1.0f32);
        while t < leave {
            let d = self.grid.distance(p + t * towards);
            open = open.min(10.0 * d / t + 0.25);
            if open <= 0.0 {
                return 0.0;
            }
            t += d.max(0.003);
        }
        let open = open.clamp(0.0, 1.0);
        open * open * (3.0 - 2.0 * open)
    }
}

/// Distances on a lattice of 3 mm cells.
struct DistanceGrid {
    bounds: Aabb,
    size: UVec3,
    values: Vec<f32>,
}

const CELL: f32 = 0.003;

impl DistanceGrid {
    fn new(head: &SyntheticHead) -> DistanceGrid {
        let bounds = head.bounds().grown(2.0 * CELL);
        let size = (bounds.size() / CELL).ceil().as_uvec3() + 2;
        let values = (0..size.x * size.y * size.z)
            .into_par_iter()
            .map(|i| {
                let at = UVec3::new(i % size.x, i / size.x % size.y, i / (size.x * size.y));
                head.sdf(bounds.min + CELL * at.as_vec3())
            })
            .collect();
        DistanceGrid { bounds, size, values }
    }

    /// Trilinear distance; outside the lattice that of its border.
    fn distance(&self, p: Vec3) -> f32 {
        let g = ((p - self.bounds.min) / CELL).clamp(Vec3::ZERO, self.size.as_vec3() - 1.001);
        let i = g.as_uvec3();
        let f = g - i.as_vec3();
        let (row, layer) = (self.size.x as usize, (self.size.x * self.size.y) as usize);
        let first = i.z as usize * layer + i.y as usize * row + i.x as usize;
        let face = |k: usize| {
            let (near, far) = (&self.values[k..][..2], &self.values[k + row..][..2]);
            [near[0], near[1], far[0], far[1]]
        };
        trilinear(f, face(first), face(first + layer))
    }

    /// Returns a step that cannot cross the surface: the slope is at most 1, so the trilinear value
    /// errs by less than a cell's diagonal.
    fn air(&self, p: Vec3) -> f32 {
        self.distance(p) - 1.75 * CELL
    }
}

#[cfg(test)]
mod tests {
    use super::super::shape::HeadMaterial;
    use super::*;

    #[test]
    fn strides_through_the_air_stop_short_of_the_surface() {
        let studio = Studio::shared();
        let bounds = studio.grid.bounds;
        let surface = SyntheticHead.surface_points(3000, 8);
        for i in 0..3000 {
            let p = bounds.min + Vec3::from_array([0, 1, 2].map(|k| unit(3, i, k))) * bounds.size();
            let nearest = surface.iter().map(|s| s.distance(p)).fold(f32::INFINITY, f32::min);
            assert!(studio.grid.air(p) < nearest, "{p}: {} over {nearest}", studio.grid.air(p));
        }
    }

    #[test]
    fn the_eye_is_a_material_seen_from_the_front() {
        let studio = Studio::shared();
        let eye = OFFSET + super::super::shape::EYE;
        let seen = studio.look(eye - Vec3::Y, Vec3::Y);
        assert_eq!((seen.alpha, seen.head), (1.0, 1.0));
        let t =
            (0..1000).map(|i| i as f32 * 1e-3).find(|&t| studio.head.sdf(eye - Vec3::Y + t * Vec3::Y) < 1e-4);
        let p = eye - Vec3::Y + t.unwrap() * Vec3::Y;
        assert_eq!(parts(p - OFFSET).material(), HeadMaterial::Eye);
    }
}

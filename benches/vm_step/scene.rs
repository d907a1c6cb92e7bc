//! A field with the content of a head, and rays of cameras around it; everything from fixed seeds.

use tiface::geom::Ray;
use tiface::kernel::cpu::vm::mask::{BoxMask, Lattice};
use tiface::kernel::cpu::vm::{self, DecoderShape, Grid, PLANE_AXES, Shading, VmField};
use tiface::math::rng;

/// Extent of the published box, world units.
const EXTENT: [f32; 3] = [3.0, 3.34, 2.0];
/// Semi-axes of the head, as shares of the box's half extents.
const HEAD: f32 = 0.75;
/// Vertices of the alpha mask: the first grid's, as long as training has updated it.
const MASK_SIZE: [usize; 3] = [141, 157, 94];

/// A field, its weights, a batch of rays and what the photographs say about them.
#[derive(Clone)]
pub struct Scene {
    pub field: VmField,
    pub density: Vec<f32>,
    pub color: Vec<f32>,
    pub network: Vec<f32>,
    pub rays: Vec<Ray>,
    pub jitter: Vec<f32>,
    /// `[rays, 3]`
    pub target: Vec<f32>,
    /// `[rays]`: 1 where the matte is empty, else 0.
    pub background: Vec<f32>,
}

/// An ellipsoid of density `peak · max(0, 1 − r²)` with noise, on a grid of `size` vertices.
///
/// `1 − r²` needs two channels of the first term; the other channels keep the published start, 0.1
/// N(0, 1).
pub fn scene(size: [usize; 3], peak: f32, rays: usize) -> Scene {
    let density = Grid { size, rank: [16, 4, 4] };
    let color = Grid { size, rank: [48, 12, 12] };
    let decoder =
        DecoderShape { channels: 72, features: 27, hidden: 128, view_frequencies: 0, feature_frequencies: 0 };
    let step = vm::step_size(EXTENT, size, 0.5);
    let vertices = size.iter().map(|&n| (n * n) as f32).sum::<f32>().sqrt();
    let lattice = Lattice {
        min: EXTENT.map(|e| -0.5 * e),
        max: EXTENT.map(|e| 0.5 * e),
        step,
        samples: (vertices / 0.5) as usize,
        near: 0.0,
        far: 1e6,
    };
    let shading = Shading {
        softplus: false,
        shift: -10.0,
        distance_scale: 25.0,
        weight_threshold: 1e-4,
        stop: 0.0,
        group_weight: 0.0,
    };
    let field = VmField { density, color, decoder, lattice, shading, mask: None };
    let noise = |stream: u64, n: usize, scale: f32| -> Vec<f32> {
        (0..n as u64).map(|i| scale * rng::normal(11, stream, i)).collect()
    };
    let mut values = noise(1, density.len(), 0.1);
    let unit = |a: usize, i: usize| (2.0 * i as f32 / (size[a] - 1) as f32 - 1.0) / HEAD;
    let (plane, line) = (density.plane(0), density.line(0));
    for y in 0..plane.height {
        for x in 0..plane.width {
            let vertex = &mut values[plane.start + (y * plane.width + x) * plane.channels..];
            let (u, v) = (unit(PLANE_AXES[0].0, x), unit(PLANE_AXES[0].1, y));
            vertex[0] = peak * (1.0 - u * u - v * v);
            vertex[1] = -peak;
        }
    }
    for z in 0..line.width {
        let vertex = &mut values[line.start + z * line.channels..];
        let w = unit(2, z);
        (vertex[0], vertex[1]) = (1.0, w * w);
    }
    let network: Vec<f32> = decoder
        .shapes()
        .iter()
        .zip(0..)
        .flat_map(|(&(rows, columns), k)| {
            let bound = 1.0 / (columns.max(27) as f32).sqrt();
            (0..(rows * columns) as u64).map(move |i| bound * (2.0 * rng::uniform(11, 20 + k, i) - 1.0))
        })
        .collect();
    let (rays, [jitter, target, background]) = batch(rays);
    let color = noise(2, color.len(), 0.3);
    let mut s = Scene { field, density: values, color, network, rays, jitter, target, background };
    s.field.mask = Some(alpha_mask(&s));
    s
}

/// The published mask: vertices of alpha ≥ 1e-4 (without the distance scale), those beside them,
/// and the cells around all of these.
fn alpha_mask(s: &Scene) -> BoxMask {
    let (l, n) = (&s.field.lattice, MASK_SIZE);
    let at = |a: usize, i: usize| l.min[a] + (l.max[a] - l.min[a]) * i as f32 / (n[a] - 1) as f32;
    let index = |c: [usize; 3]| (c[0] * n[1] + c[1]) * n[2] + c[2];
    let points: Vec<[f32; 3]> = (0..n[0] * n[1] * n[2])
        .map(|i| [at(0, i / (n[1] * n[2])), at(1, i / n[2] % n[1]), at(2, i % n[2])])
        .collect();
    let sigma = vm::density_at(&s.field, &s.density, &points);
    let alive: Vec<bool> = sigma.iter().map(|s| 1.0 - (-s * l.step).exp() >= 1e-4).collect();
    let mut wider = alive.clone();
    for (i, _) in alive.iter().enumerate().filter(|(_, alive)| **alive) {
        let c = [i / (n[1] * n[2]), i / n[2] % n[1], i % n[2]];
        for k in 0..27 {
            let d = [k / 9, k / 3 % 3, k % 3];
            let near: [usize; 3] = std::array::from_fn(|a| (c[a] + d[a]).clamp(1, n[a]) - 1);
            wider[index(near)] = true;
        }
    }
    BoxMask::from_vertices(l.min, l.max, n, &wider)
}

/// Rays of 24 cameras on a dome, 3.5 half extents from the box's middle, that meet the box; their
/// jitter, targets and backgrounds.
fn batch(count: usize) -> (Vec<Ray>, [Vec<f32>; 3]) {
    let (mut rays, mut jitter) = (Vec::with_capacity(count), Vec::with_capacity(count));
    let (mut target, mut background) = (Vec::new(), Vec::new());
    let half = EXTENT.map(|e| 0.5 * e);
    for i in 0.. {
        if rays.len() == count {
            break;
        }
        let u = |k: u64| rng::uniform(12, 1, 16 * i + k);
        let camera = (24.0 * u(0)) as u64;
        let yaw = 1.2 * (rng::uniform(12, 2, camera) - 0.5);
        let pitch = 0.8 * (rng::uniform(12, 3, camera) - 0.5);
        let away = [yaw.sin() * pitch.cos(), pitch.sin(), yaw.cos() * pitch.cos()];
        let origin = away.map(|c| 3.5 * half[1] * c);
        // pixels of a picture that shows a little more than the box
        let aim = [2.4 * half[0] * (u(1) - 0.5), 2.4 * half[1] * (u(2) - 0.5), 0.0];
        let toward: [f32; 3] = std::array::from_fn(|a| aim[a] - origin[a]);
        let length = toward.iter().map(|c| c * c).sum::<f32>().sqrt();
        let direction = toward.map(|c| c / length);
        let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
        for a in 0..3 {
            let (p, q) = ((-half[a] - origin[a]) / direction[a], (half[a] - origin[a]) / direction[a]);
            (enter, leave) = (enter.max(p.min(q)), leave.min(p.max(q)));
        }
        if enter >= leave {
            continue;
        }
        // the head in coordinates where it is the unit ball
        let scaled = |v: [f32; 3]| -> [f32; 3] { std::array::from_fn(|a| v[a] / (HEAD * half[a])) };
        let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let (o, d) = (scaled(origin), scaled(direction));
        let head = dot(o, d).powi(2) > dot(d, d) * (dot(o, o) - 1.0);
        rays.push(Ray::new(origin, direction));
        jitter.push(u(3));
        background.push(f32::from(!head));
        target.extend((0..3).map(|k| if head { 0.2 + 0.6 * u(4 + k) } else { 0.0 }));
    }
    (rays, [jitter, target, background])
}

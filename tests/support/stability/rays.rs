//! Rays that graze, run along edges and through corners: the ray caster against exact arithmetic,
//! the rasterizer against the ray caster, and marching through boxes and surfaces.

use super::case::{Cases, StabilityCase, worst};
use glam::{DMat3, DVec3, Vec2, Vec3};
use tiface::geom::{BitGrid, Bvh, Camera, Distortion, Mesh, Ray};
use tiface::kernel::cpu::hash;
use tiface::kernel::cpu::march::MarchCells;
use tiface::kernel::cpu::neus::{self, ColorRule, Segments};
use tiface::kernel::cpu::vm::mask::{Lattice, Walk};
use tiface::math::rng;
use tiface::mesh::{Volume, marching};
use tiface::render::{RasterOptions, RasterView, raster};

pub(super) fn cases() -> Vec<StabilityCase> {
    let mut cases = Cases::new("rays");
    for (scale, far) in [(1.0, 0.0), (1e-6, 0.0), (1e6, 0.0), (1.0, 1e3)] {
        caster(&mut cases, scale, far);
    }
    rasterizer(&mut cases);
    boxes(&mut cases);
    spheres(&mut cases);
    levels(&mut cases);
    cases.done
}

/// A ball of radius 0.8 of some 7000 triangles.
fn ball() -> Mesh {
    let n = 32;
    let at = |i: usize| Vec3::from([i % n, i / n % n, i / n / n].map(|c| c as f32 / 15.5 - 1.0));
    let values: Vec<f32> = (0..n * n * n).map(|i| at(i).length() - 0.8).collect();
    let spacing = Vec3::splat(1.0 / 15.5);
    let volume = Volume { dims: [n; 3], values: &values, origin: Vec3::NEG_ONE, spacing };
    marching(&volume, true).map(|s| s.mesh).unwrap_or_default()
}

fn ray(origin: Vec3, direction: Vec3) -> Ray {
    Ray::new(origin, direction)
}

/// Leaks of a ball from within, and what exact arithmetic says of rays that graze it.
fn caster(cases: &mut Cases, scale: f32, far: f32) {
    let mut mesh = ball();
    mesh.positions.iter_mut().for_each(|p| *p = *p * scale + Vec3::splat(far));
    let bvh = Bvh::new(&mesh);
    let count = mesh.triangles.len() as u64;
    let u = |k: u64, i: u64| rng::uniform(21, k, i);
    let leaks = (0..20_000u64)
        .filter(|&i| {
            let [a, b, c] = mesh.corners(rng::below(21, 9, i, count) as u32);
            let target = [a, b.midpoint(c), a.lerp(c, u(1, i))][i as usize % 3];
            let from = Vec3::splat(far) + scale * 0.6 * (Vec3::new(u(2, i), u(3, i), u(4, i)) - 0.5);
            bvh.closest_hit(&ray(from, (target - from).normalize())).is_none()
        })
        .count();
    let name = format!("ball of size {scale:e} at {far:e}");
    cases.add(format!("{name}: rays that leak through corners and edges"), leaks as f64, 0.0, "rays");
    // past the outline, along the edges, and within the planes of triangles
    let (mut missed, mut apart) = (Vec::new(), Vec::new());
    for i in 0..600u64 {
        let t = rng::below(22, 0, i, count) as u32;
        let [a, b, c] = mesh.corners(t);
        let (along, out) = ((b - a).normalize(), (a - Vec3::splat(far)).normalize());
        let aside = out.cross(Vec3::new(u(5, i), u(6, i), u(7, i)) - 0.5).normalize();
        let (through, direction) =
            [(a, aside), (a, along), (a.lerp(b, u(8, i)), aside), ((a + b + c) / 3.0, along)][i as usize % 4];
        let ray = ray(through - 2.0 * scale * direction, direction);
        missed.push(most_missed(&mesh, &bvh, &ray, scale));
        apart.push(bvh.closest_hit(&ray).map_or(0.0, |h| {
            let [a, b, c] = mesh.corners(h.triangle).map(|p| p.as_dvec3());
            let at = a + h.u as f64 * (b - a) + h.v as f64 * (c - a) - ray.origin.as_dvec3();
            at.reject_from(ray.direction.as_dvec3().normalize()).length() / scale as f64
        }));
    }
    let bound = if far > 0.0 { 1e-4 } else { 1e-5 };
    cases.add(
        format!("{name}: hits that grazing rays miss, from the next edge"),
        worst(missed),
        bound,
        "of its size",
    );
    // where a triangle is seen edge-on its weights are known to f32 by what is left of its area
    cases.add(format!("{name}: hits of grazing rays, from the ray"), worst(apart), 1e-3, "of its size");
}

/// How far from the nearest edge, as the ray sees it, f64 finds a hit well before the caster's.
fn most_missed(mesh: &Mesh, bvh: &Bvh, ray: &Ray, scale: f32) -> f64 {
    let (o, d, size) = (ray.origin.as_dvec3(), ray.direction.as_dvec3(), scale as f64);
    let nearest = bvh.closest_hit(ray).map_or(f64::INFINITY, |h| h.t as f64);
    let within = |t: u32| -> f64 {
        // Möller, Trumbore
        let [a, b, c] = mesh.corners(t).map(|p| p.as_dvec3());
        let (e1, e2, s) = (b - a, c - a, o - a);
        let p = d.cross(e2);
        let over = 1.0 / e1.dot(p);
        let q = s.cross(e1);
        let (u, v, t) = (s.dot(p) * over, d.dot(q) * over, e2.dot(q) * over);
        if !(u > 0.0 && v > 0.0 && u + v < 1.0 && t > 0.0 && t < nearest - 1e-3 * size) {
            return 0.0;
        }
        // an edge's height is twice the area that the ray sees by the length that it sees
        let height = |e: DVec3| e1.dot(p).abs() / e.reject_from(d.normalize()).length();
        (u * height(e2)).min(v * height(e1)).min((1.0 - u - v) * height(e2 - e1)) / size
    };
    (0..mesh.triangles.len() as u32).map(within).fold(0.0, f64::max)
}

/// The rasterizer beside the caster, pixel by pixel: other triangles, and depth where they agree.
fn rasterizer(cases: &mut Cases) {
    let look = |position: DVec3, focal: f64| {
        let back = position.normalize();
        let right = DVec3::Y.cross(back).normalize();
        let rotation = DMat3::from_cols(right, back.cross(right), back);
        let (fx, fy, cx, cy) = (focal, focal, 100.0, 100.0);
        let distortion = Distortion::default();
        Camera { width: 200, height: 200, fx, fy, cx, cy, distortion, rotation, position }
    };
    let floor = |n: usize| {
        let at = |i: usize| 8.0 * (i as f32 / n as f32 - 0.5);
        let node = |a: usize, b: usize| (b * (n + 1) + a) as u32;
        let positions =
            (0..(n + 1) * (n + 1)).map(|i| Vec3::new(at(i % (n + 1)), 0.0, at(i / (n + 1)))).collect();
        let faces = |k: usize| {
            let (a, b) = (k % n, k / n);
            [
                [node(a, b), node(a + 1, b + 1), node(a + 1, b)],
                [node(a, b), node(a, b + 1), node(a + 1, b + 1)],
            ]
        };
        Mesh { positions, triangles: (0..n * n).flat_map(faces).collect(), ..Mesh::default() }
    };
    let bent = Distortion { k1: -0.1, k2: 0.02, p1: 1e-3, ..Distortion::default() };
    let table = [
        ("ball in front", ball(), look(DVec3::new(0.9, 0.6, 2.4), 260.0)),
        ("ball from within", ball(), look(DVec3::new(0.1, 0.2, 0.3), 80.0)),
        (
            "ball through a lens",
            ball(),
            Camera { distortion: bent, ..look(DVec3::new(0.9, 0.6, 2.4), 260.0) },
        ),
        ("ball in 0.1 degrees", ball(), look(1000.0 * DVec3::new(0.3, 0.2, 0.9).normalize(), 1.1e5)),
        ("floor at half a degree", floor(40), look(DVec3::new(0.3, 0.04, 4.5), 180.0)),
    ];
    for (name, mesh, camera) in table {
        let bvh = Bvh::new(&mesh);
        let seen = raster(&mesh, None, &camera, &RasterOptions::default(), |h| vec![[1.0; 3]; h.hits.len()]);
        let (mut other, mut depth) = (0usize, Vec::new());
        for i in 0..200 * 200 {
            let pixel = Vec2::new((i % 200) as f32 + 0.5, (i / 200) as f32 + 0.5);
            let Some(ray) = camera.ray(pixel) else { continue };
            let hit = bvh.closest_hit(&ray);
            let same = hit.map_or(RasterView::NOTHING, |h| h.triangle) == seen.triangles[i];
            other += usize::from(!same);
            if let Some(h) = hit.filter(|_| same) {
                let along = (h.t * ray.direction.dot(camera.forward())) as f64;
                depth.push((seen.view.depth.data[i] as f64 - along).abs() / along.max(1.0));
            }
        }
        cases.add(
            format!("{name}: pixels of other triangles, raster and caster"),
            other as f64 / 4e4,
            1e-3,
            "share",
        );
        cases.add(format!("{name}: depth of raster and caster"), worst(depth), 1e-5, "relative");
    }
}

/// Rays of a box: through its middle, along its faces, edges and the walls of its cells, and
/// through its corners.
fn boxes(cases: &mut Cases) {
    let step = 0.013f32;
    let full = BitGrid::filled(16, true);
    let lattice = Lattice { min: [-1.0; 3], max: [1.0; 3], step, samples: 4096, near: 0.0, far: 100.0 };
    let (mut cubic, mut vm) = (Vec::new(), Vec::new());
    for i in 0..3000u64 {
        let u = |k: u64| rng::uniform(31, k, i);
        // places on a lattice that holds borders and walls; directions with exact and nearly zero
        // components
        let place = |k: u64| [-1.0, 1.0, 0.0, 0.25, 2.0 * u(k) - 1.0][rng::below(31, k + 8, i, 5) as usize];
        let slant = |k: u64| [0.0, -0.0, 1e-7, -1e-7, u(k) - 0.5][rng::below(31, k + 16, i, 5) as usize];
        let direction = Vec3::new(slant(3), slant(4), -1.0).normalize();
        let origin = Vec3::new(place(0), place(1), 0.3) - 2.7 * direction;
        let r = Ray::new(origin, direction);
        let chord = chord(origin.as_dvec3(), direction.as_dvec3());
        let want = chord / step as f64;
        cubic.push(
            (MarchCells::new(&full, None).march(1.0, step, &[r], &[], 1 << 20).t.len() as f64 - want).abs(),
        );
        let mut walk = Walk::new(&lattice, None, &r, 0.0);
        let mut n = 0;
        while walk.advance().is_some() {
            n += 1;
        }
        // its published rule lets a ray within a border's plane be outside or inside
        let border = (0..3).any(|a| direction[a].abs() < 1e-6 && origin[a].abs() > 1.0 - 1e-5);
        vm.push(if border { 0.0 } else { (n as f64 - want).abs() });
    }
    cases.add("lattice of a distance field: samples and length", worst(cubic), 2.0, "steps");
    cases.add("lattice of a radiance field: samples and length", worst(vm), 2.0, "steps");
}

/// The length of a line within [-1, 1]³.
fn chord(origin: DVec3, direction: DVec3) -> f64 {
    let (mut enter, mut leave) = (0.0f64, f64::INFINITY);
    for a in (0..3).filter(|&a| direction[a] != 0.0) {
        let (p, q) = ((-1.0 - origin[a]) / direction[a], (1.0 - origin[a]) / direction[a]);
        (enter, leave) = (enter.max(p.min(q)), leave.min(p.max(q)));
    }
    (leave - enter).max(0.0)
}

/// NeuS through a sphere of radius 0.5, ever nearer to its outline: where a ray ends, and that one
/// beside it does not.
fn spheres(cases: &mut Cases) {
    let full = BitGrid::filled(16, true);
    for (inv_s, step) in [(200.0f32, 0.004f32), (2000.0, 0.001), (1e6, 0.001)] {
        let see = |height: f32| {
            let r = Ray::new([height, 0.0, 2.0], [0.0, 0.0, -1.0]);
            let samples = MarchCells::new(&full, None).march(1.0, step, &[r], &[0.37], 1 << 20);
            let (x, _) = samples.points(&[r]);
            let field: Vec<f32> = x
                .iter()
                .flat_map(|p| {
                    let p = Vec3::from(*p);
                    let n = p.normalize_or_zero();
                    [p.length() - 0.5, n.x, n.y, n.z, 0.5, 0.5, 0.5, 0.0]
                })
                .collect();
            let dt = vec![step; samples.t.len()];
            let segments = Segments {
                offsets: &samples.offsets,
                direction: &[r.direction.to_array()],
                t: &samples.t,
                dt: &dt,
                colors: ColorRule { min_weight: 0.0, group_weight: 0.0 },
            };
            let out = neus::forward(segments, &field, inv_s, 1.0);
            (out[3] as f64, (out[4] / out[3]) as f64)
        };
        let inside = (0..100).map(|i| 0.495 * (i as f64 / 99.0).sqrt());
        let error = inside.map(|h| {
            let (opacity, depth) = see(h as f32);
            // what is blurred by 1 / inv_s, seen aslant, cut into steps, and hidden by air: ε gives
            // each step 1e-5
            let slope = (1.0 - 4.0 * h * h).sqrt();
            let blur = step as f64 + 2.0 / (inv_s as f64 * slope) + 0.5e-5 / step as f64;
            if opacity < 0.5 { f64::NAN } else { (depth - (2.0 - (0.25 - h * h).sqrt())).abs() / blur }
        });
        let name = format!("sphere of sharpness {inv_s:e}");
        cases.add(format!("{name}: depth up to its outline"), worst(error), 2.0, "steps and blurs");
        let beside = 0.5 + step + 12.0 / inv_s;
        cases.add(format!("{name}: opacity beside it"), see(beside).0, 0.022, "opacity");
    }
}

/// Rays along the walls of the hash grid's cells: values on both sides of a wall are one.
fn levels(cases: &mut Cases) {
    let levels = hash::levels(12, 16, 1.4, 14);
    let table: Vec<[f32; 2]> = (0..2 * hash::entries(&levels) as u64)
        .step_by(2)
        .map(|i| [rng::normal(33, 0, i), rng::normal(33, 1, i)])
        .collect();
    let mut jumps = Vec::new();
    for (l, level) in levels.iter().enumerate() {
        let wall = |k: u32| ((k as f64 + 0.5) / level.scale as f64) as f32;
        let points: Vec<[f32; 3]> = (0..200u32)
            .flat_map(|i| {
                let x = wall(i % (level.scale as u32));
                let (y, z) = (rng::uniform(34, 0, i as u64), wall(i * 7 % (level.scale as u32)));
                [[x.next_down(), y, z], [x, y, z], [x.next_up(), y, z]]
            })
            .collect();
        let mut value = vec![[0f32; 2]; levels.len() * points.len()];
        hash::gather(&levels, &table, &points, 0.5, &mut value, None);
        let own = &value[l * points.len()..(l + 1) * points.len()];
        let across = |v: &[[f32; 2]]| (v[0][0] - v[1][0]).abs().max((v[2][0] - v[1][0]).abs()) as f64;
        // a step of f32 is so much of a cell
        jumps.push(worst(own.chunks(3).map(across)) / (level.scale as f64 * f32::EPSILON as f64).max(1e-6));
    }
    cases.add("hash grid: steps of f32 across the walls of cells", worst(jumps), 16.0, "slopes");
}

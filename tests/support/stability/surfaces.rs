//! Hard volumes and fields through the extraction, and a mesh at hard scales through the
//! simplification.

use super::case::{Cases, StabilityCase, worst};
use glam::{DVec3, Vec3};
use std::collections::BTreeMap;
use tiface::Quiet;
use tiface::geom::{Aabb, Mesh, SdfField, topology};
use tiface::math::rng;
use tiface::mesh::{ExtractOptions, SimplifyConfig, Volume, extract, marching, simplify};

pub(super) fn cases() -> Vec<StabilityCase> {
    let mut cases = Cases::new("surfaces");
    volumes(&mut cases);
    balls(&mut cases);
    sheets(&mut cases);
    slopes(&mut cases);
    cubes(&mut cases);
    cases.done
}

/// What keeps a mesh from being a closed manifold of numbers; one where there is no triangle.
fn faults(mesh: &Mesh) -> f64 {
    let t = topology(&mesh.positions, &mesh.triangles);
    let found = [
        t.boundary_edges,
        t.non_manifold_edges,
        t.misoriented_edges,
        t.non_manifold_vertices,
        t.non_finite_vertices,
        t.duplicate_triangles,
        usize::from(t.triangles == 0),
    ];
    found.iter().sum::<usize>() as f64
}

/// Volumes of 17³ nodes, their values by the number of the node.
fn volumes(cases: &mut Cases) {
    let u = |i: usize, k: u64| rng::uniform(11, k, i as u64);
    let pick = |i: usize, of: &[f32]| of[rng::below(12, 0, i as u64, of.len() as u64) as usize];
    let checker = |i: usize| if (i % 17 + i / 17 % 17 + i / 289).is_multiple_of(2) { 1.0f32 } else { -1.0 };
    let table: [(&str, &dyn Fn(usize) -> f32); 9] = [
        ("ones and exact zeros", &|i| pick(i, &[-1.0, 0.0, 1.0])),
        ("zeros of both signs", &|i| pick(i, &[-1.0, 0.0, -0.0])),
        ("denormals", &|i| pick(i, &[-1e-40, 1e-45, -1e-45, 1e-40])),
        ("sizes from 1e-40 to 1e30", &|i| pick(i, &[-1.0, 1.0]) * 10f32.powf(70.0 * u(i, 1) - 40.0)),
        ("the largest numbers", &|i| pick(i, &[-f32::MAX, f32::MAX])),
        ("every cell ambiguous", &checker),
        ("every cell ambiguous, sizes drawn", &|i| checker(i) * u(i, 2)),
        ("saddles that tie", &|i| checker(i) * pick(i, &[1.0, 2.0, 4.0])),
        ("noise with NaN and infinities", &|i| {
            pick(i, &[u(i, 3) - 0.5, 0.3 - u(i, 4), f32::NAN, f32::INFINITY, f32::NEG_INFINITY])
        }),
    ];
    for (name, value) in table {
        let values: Vec<f32> = (0..17 * 17 * 17).map(value).collect();
        let volume = Volume { dims: [17; 3], values: &values, origin: Vec3::ZERO, spacing: Vec3::ONE };
        let error = marching(&volume, true).map_or(f64::NAN, |s| {
            let mesh = s.mesh;
            let flat = (0..mesh.triangles.len() as u32).filter(|&t| mesh.area(t) <= 0.0).count();
            faults(&mesh) + flat as f64
        });
        cases.add(format!("volume: {name}"), error, 0.0, "faults");
    }
}

/// Cells along the box of an extraction.
const CELLS: usize = 24;

/// A field and its slope in a box around a center.
struct Shape<F, S> {
    center: DVec3,
    half: f64,
    field: F,
    slope: S,
}

impl<F, S> SdfField for Shape<F, S>
where
    F: Fn(DVec3) -> f64 + Sync,
    S: Fn(DVec3) -> DVec3 + Sync,
{
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        let local = |p: &Vec3| (p.as_dvec3() - self.center) / self.half;
        points.iter().map(|p| (self.half * (self.field)(local(p))) as f32).collect()
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        let local = |p: &Vec3| (p.as_dvec3() - self.center) / self.half;
        (self.sdf(points), points.iter().map(|p| (self.slope)(local(p)).as_vec3()).collect())
    }

    fn colors(&self, _: &[Vec3], _: &[Vec3], _: &[u32], directions: &[Vec3]) -> Vec<[f32; 3]> {
        vec![[0.5; 3]; directions.len()]
    }
}

/// The zero set of `field` in a box around `center`, of half edge `half`, coordinates f64. NaN in
/// the place of the errors where it is refused.
fn extracted(
    center: DVec3,
    half: f64,
    field: impl Fn(DVec3) -> f64 + Sync,
    slope: impl Fn(DVec3) -> DVec3 + Sync,
) -> Option<Mesh> {
    let shape = Shape { center, half, field, slope };
    let bounds = Aabb { min: (center - half).as_vec3(), max: (center + half).as_vec3() };
    let options = ExtractOptions { resolution: CELLS, coarse_step: 2, ..ExtractOptions::default() };
    extract(&shape, bounds, &options, &Quiet).ok().map(|(mesh, _)| mesh)
}

/// The largest |`field`| over the vertices, in cells.
fn off(mesh: &Mesh, center: DVec3, half: f64, field: impl Fn(DVec3) -> f64) -> f64 {
    let local = |p: &Vec3| (p.as_dvec3() - center) / half;
    worst(mesh.positions.iter().map(|p| field(local(p)).abs())) * CELLS as f64 / 2.0
}

/// A ball of 0.7 of half its box, at all scales and far from the origin.
fn balls(cases: &mut Cases) {
    let field = |p: DVec3| p.length() - 0.7;
    for (half, far, bound) in [
        (1.0, 0.0, 1e-3),
        (1e-6, 0.0, 1e-3),
        (1e6, 0.0, 1e-3),
        // beyond 1e-9 and 1e9 squares of areas leave f32, and vertices stay where the cells put
        // them
        (1e-30, 0.0, 0.05),
        (1e15, 0.0, 0.05),
        (1.0, 1e3, 2e-3), // beyond, the steps of f32: 12 cells · 1e5 · 6e-8 = 0.07
        (1e-3, 10.0, 2e-2),
        (1.0, 1e5, 0.2),
    ] {
        let center = DVec3::new(far, -far, 0.5 * far);
        let mesh = extracted(center, half, field, |p| p.normalize_or_zero());
        let name = format!("ball of size {half:e} at {far:e}");
        let of = |error: &dyn Fn(&Mesh) -> f64| mesh.as_ref().map_or(f64::NAN, error);
        cases.add(format!("{name}: topology"), of(&faults), 0.0, "faults");
        cases.add(format!("{name}: distance"), of(&|m| off(m, center, half, field)), bound, "cells");
    }
}

/// Sheets and shells thinner than a cell, and surfaces that meet themselves.
fn sheets(cases: &mut Cases) {
    let cell = 2.0 / CELLS as f64;
    let round = |p: DVec3| p.length() - 0.8;
    let sheet = |z: f64, cells: f64| move |p: DVec3| ((p.z - z).abs() - 0.5 * cells * cell).max(round(p));
    let tilted = |cells: f64| {
        move |p: DVec3| {
            (p.dot(DVec3::new(0.2, 0.31, 0.93).normalize()).abs() - 0.5 * cells * cell).max(round(p))
        }
    };
    let fields: [(&str, Box<dyn Fn(DVec3) -> f64 + Sync>); 7] = [
        ("sheet of 0.01 cells on nodes", Box::new(sheet(0.0, 0.01))),
        ("sheet of 0.4 cells on nodes", Box::new(sheet(0.0, 0.4))),
        ("tilted sheet of 0.3 cells", Box::new(tilted(0.3))),
        ("tilted sheet of 0.9 cells", Box::new(tilted(0.9))),
        ("shell of 0.5 cells", Box::new(move |p| (p.length() - 0.6).abs() - 0.25 * cell)),
        ("two planes that cross", Box::new(move |p| (p.x * p.y).max(round(p)))),
        ("cone to a point", Box::new(move |p| (0.7 * (p.x.hypot(p.y) - p.z.abs())).max(round(p)))),
    ];
    for (name, field) in &fields {
        let slope = |p: DVec3| {
            let along = |d: DVec3| (field(p + 1e-6 * d) - field(p - 1e-6 * d)) / 2e-6;
            DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z))
        };
        let mesh = extracted(DVec3::ZERO, 1.0, field, slope);
        let error = mesh.as_ref().map_or(f64::NAN, faults);
        cases.add(format!("{name}: topology"), error, 0.0, "faults");
        let error = mesh.as_ref().map_or(f64::NAN, |m| off(m, DVec3::ZERO, 1.0, field));
        cases.add(format!("{name}: distance"), error, 1.0, "cells");
    }
}

/// A ball whose field says nothing useful about the way to its surface.
fn slopes(cases: &mut Cases) {
    let ball = |p: DVec3| p.length() - 0.7;
    let table: [(&str, &(dyn Fn(DVec3) -> f64 + Sync), &(dyn Fn(DVec3) -> DVec3 + Sync)); 5] = [
        ("gradient of zero", &ball, &|_| DVec3::ZERO),
        ("gradient that is not a number", &ball, &|_| DVec3::NAN),
        ("gradient of 1e30", &ball, &|p| 1e30 * p),
        ("gradient of 1e-30", &ball, &|p| 1e-30 * p),
        ("field of two values", &|p| ball(p).signum(), &|_| DVec3::ZERO),
    ];
    for (name, field, slope) in table {
        let mesh = extracted(DVec3::ZERO, 1.0, field, slope);
        let error = mesh.as_ref().map_or(f64::NAN, |m| faults(m) + off(m, DVec3::ZERO, 1.0, ball).floor());
        cases.add(format!("{name}: faults, and cells off"), error, 0.0, "faults");
    }
}

/// The quadrics of the simplification: a cube of 1536 triangles loses most of them and stays a
/// cube.
fn cubes(cases: &mut Cases) {
    for (half, far, bound) in [(1.0, 0.0, 1e-5), (1e-6, 0.0, 1e-5), (1e6, 0.0, 1e-5), (1.0, 1e4, 1e-3)] {
        let center = DVec3::splat(far);
        let mut mesh = cube(16);
        mesh.positions.iter_mut().for_each(|p| *p = (center + half * p.as_dvec3()).as_vec3());
        let config = SimplifyConfig { triangles: 200, ..SimplifyConfig::default() };
        let done = simplify(&mut mesh, None, &config, &Quiet);
        let on_cube = |p: &Vec3| (((p.as_dvec3() - center) / half).abs().max_element() - 1.0).abs();
        let kept = if mesh.triangles.len() <= 200 { 0.0 } else { f64::NAN };
        let error =
            done.map_or(f64::NAN, |_| worst(mesh.positions.iter().map(on_cube)) + faults(&mesh) + kept);
        cases.add(format!("cube of size {half:e} at {far:e} simplified"), error, bound, "of its size");
    }
}

/// The surface of [-1, 1]³ in `n × n` squares a side.
fn cube(n: i32) -> Mesh {
    let (mut mesh, mut index) = (Mesh::default(), BTreeMap::new());
    for (axis, sign) in (0..6).map(|side| (side / 2, 2 * (side as i32 % 2) - 1)) {
        let mut at = |a: i32, b: i32| {
            let mut key = [sign * n; 3];
            (key[(axis + 1) % 3], key[(axis + 2) % 3]) = (2 * a - n, 2 * b - n);
            *index.entry(key).or_insert_with(|| {
                mesh.positions.push(Vec3::from(key.map(|k| k as f32 / n as f32)));
                mesh.positions.len() as u32 - 1
            })
        };
        for (a, b) in (0..n * n).map(|k| (k % n, k / n)) {
            let [p, q, r, s] = [at(a, b), at(a + 1, b), at(a + 1, b + 1), at(a, b + 1)];
            let faces = [[p, q, r], [p, r, s]];
            mesh.triangles.extend(faces.map(|f| if sign > 0 { f } else { [f[0], f[2], f[1]] }));
        }
    }
    mesh
}

//! Hard meshes, and ways that fail.

use super::*;
use crate::files::uv_check;
use glam::Vec3;
use std::f32::consts::{PI, TAU};
use std::sync::atomic::{AtomicU64, Ordering};
use tiface_base::Quiet;

fn config(size_px: u32) -> AtlasConfig {
    AtlasConfig { size_px, gutter_px: 4, ..AtlasConfig::default() }
}

/// A sphere of rings and a pole at each end.
pub(super) fn sphere(rings: u32, around: u32) -> Mesh {
    let mut mesh = Mesh { positions: vec![Vec3::Y], ..Mesh::default() };
    for i in 1..rings {
        for j in 0..around {
            let (polar, turn) = (PI * i as f32 / rings as f32, TAU * j as f32 / around as f32);
            mesh.positions.push(Vec3::new(polar.sin() * turn.sin(), polar.cos(), polar.sin() * turn.cos()));
        }
    }
    mesh.positions.push(-Vec3::Y);
    let last = mesh.positions.len() as u32 - 1;
    let at = |i: u32, j: u32| 1 + i * around + j % around;
    for j in 0..around {
        mesh.triangles.push([0, at(0, j), at(0, j + 1)]);
        mesh.triangles.push([last, at(rings - 2, j + 1), at(rings - 2, j)]);
        for i in 0..rings - 2 {
            mesh.triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
            mesh.triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
    }
    mesh
}

/// A grid of quads over `point(u, v)`, u and v in 0..=1, closed where asked.
fn sheet(n: u32, m: u32, close: [bool; 2], point: impl Fn(f32, f32) -> Vec3) -> Mesh {
    let (rows, columns) = (n + u32::from(!close[0]), m + u32::from(!close[1]));
    let mut mesh = Mesh::default();
    for i in 0..rows {
        for j in 0..columns {
            mesh.positions.push(point(i as f32 / n as f32, j as f32 / m as f32));
        }
    }
    let at = |i: u32, j: u32| i % rows * columns + j % columns;
    for i in 0..n {
        for j in 0..m {
            mesh.triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
            mesh.triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
    }
    mesh
}

/// Lays it out, and holds the result to all that is promised.
fn laid(mesh: &Mesh, config: &AtlasConfig) -> (Atlas, AtlasReport) {
    let (atlas, report) = atlas(mesh, config, &Quiet).unwrap();
    let uv = uv_check(mesh, &atlas);
    assert_eq!(uv, report.uv);
    assert!(uv.is_sound() && uv.mirrored_charts == 0, "{uv}");
    let apart = uv.chart_distance_px.unwrap_or(f64::INFINITY).min(uv.border_distance_px);
    assert!(apart >= 2.0 * report.gutter_px - 1e-3, "{uv}");
    assert_eq!(atlas.triangles.len(), mesh.triangles.len());
    (atlas, report)
}

#[test]
fn a_closed_sphere_is_laid_in_few_charts_with_little_stretch() {
    let mesh = sphere(40, 80);
    assert!(mesh.is_closed());
    let (_, r) = laid(&mesh, &config(512));
    assert!(r.fallback.is_none() && r.repaired == 0, "{r:?}");
    assert!((2..=12).contains(&r.uv.charts), "{}", r.uv);
    assert!(r.uv.area_stretch < 1.03 && r.uv.angle_stretch_p99 < 1.05 && r.uv.used > 0.5, "{}", r.uv);
    assert_eq!(r.gutter_px, 4.0);
}

#[test]
fn a_torus_is_laid_flat() {
    let mesh = sheet(40, 20, [true, true], |u, v| {
        let r = 2.0 + 0.7 * (TAU * v).cos();
        Vec3::new(r * (TAU * u).cos(), -r * (TAU * u).sin(), 0.7 * (TAU * v).sin())
    });
    assert!(mesh.is_closed());
    let (_, r) = laid(&mesh, &config(512));
    assert!(r.fallback.is_none() && r.uv.charts >= 2 && r.uv.used > 0.4, "{r:?}");
}

#[test]
fn a_moebius_strip_is_laid_flat() {
    let n = 60;
    let mut mesh = sheet(n, 4, [false, false], |u, v| {
        let (a, w) = (TAU * u, 0.6 * (v - 0.5));
        let r = 1.0 + w * (a / 2.0).cos();
        Vec3::new(r * a.cos(), r * a.sin(), w * (a / 2.0).sin())
    });
    // the last row of vertices is the first one, turned over
    for t in &mut mesh.triangles {
        *t = t.map(|v| if v >= n * 5 { 4 - (v - n * 5) } else { v });
    }
    mesh.positions.truncate(n as usize * 5);
    let (_, r) = laid(&mesh, &config(512));
    assert!(r.fallback.is_none() && r.uv.charts < 20, "{r:?}");
}

#[test]
fn needles_get_a_place_of_their_own_where_they_are_too_thin() {
    // A flat strip whose middle row is a billionth high: all its triangles are thinner than
    // rounding.
    let mesh = sheet(20, 3, [false, false], |u, v| {
        let y = [0.0, 0.1, 0.1 + 1e-9, 0.2][(3.0 * v).round() as usize];
        Vec3::new(u, y, 0.0)
    });
    let (_, r) = laid(&mesh, &config(512));
    assert!(r.fallback.is_none(), "{r:?}");
    assert_eq!(r.repaired, 40);
    assert!(r.warnings()[0].to_string().contains("40 triangles"));
    // Long and thin, but not without width.
    let needles = sheet(1, 200, [false, false], |u, v| Vec3::new(u, 0.002 * v * 200.0, 0.0));
    let (_, r) = laid(&needles, &config(512));
    assert!(r.fallback.is_none() && r.repaired == 0, "{r:?}");
}

#[test]
fn one_triangle_is_one_chart() {
    let mesh = Mesh {
        positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.3, 0.8, 0.1)],
        triangles: vec![[0, 1, 2]],
        ..Mesh::default()
    };
    let (_, r) = laid(&mesh, &config(64));
    assert_eq!((r.uv.charts, r.uv.chart_distance_px, r.fallback), (1, None, None));
    assert!(r.uv.used > 0.15, "{}", r.uv);
}

#[test]
fn triangles_given_twice_each_get_a_place() {
    let mut mesh = sphere(8, 12);
    let again = mesh.triangles.clone();
    mesh.triangles.extend(again.iter().map(|&[a, b, c]| [b, c, a]));
    let (_, r) = laid(&mesh, &config(1024));
    // every edge has four triangles: nothing is joined
    assert!(r.uv.charts == mesh.triangles.len(), "{r:?}");
    assert!(r.fallback.unwrap().contains("charts"));
}

#[test]
fn triangles_without_area_do_not_spoil_a_mesh() {
    let mut mesh = sphere(10, 20);
    mesh.triangles.extend([[0, 0, 1], [3, 4, 3], [7, 7, 7]]);
    let (_, r) = laid(&mesh, &config(512));
    // a triangle as thin as the pole's may go with them
    assert!((3..=8).contains(&r.repaired) && r.fallback.is_none(), "{r:?}");
    // and alone
    mesh.triangles = vec![[0, 0, 1], [7, 7, 7]];
    let (_, r) = laid(&mesh, &config(64));
    assert!(r.fallback.unwrap().contains("no area"));
}

#[test]
fn a_mesh_that_cannot_be_textured_is_a_named_error_with_a_hint() {
    let good = sphere(4, 6);
    let error = |mesh: &Mesh, config: &AtlasConfig| atlas(mesh, config, &Quiet).unwrap_err();
    let mut nan = good.clone();
    nan.positions[5].y = f32::NAN;
    let mut index = good.clone();
    index.triangles[7][1] = 999;
    let all = [
        (error(&Mesh::default(), &config(512)), "no triangles"),
        (
            error(&nan, &config(512)),
            "1 vertices of the mesh have a coordinate that is not finite, the first is vertex 5",
        ),
        (error(&index, &config(512)), "triangle 7 names vertex 999"),
        (
            error(&sphere(60, 60), &AtlasConfig { size_px: 32, gutter_px: 4, ..AtlasConfig::default() }),
            "texture of 32 × 32",
        ),
    ];
    for (e, name) in all {
        assert!(e.to_string().contains(name), "{e} is not {name}");
        assert!(!e.hint().is_empty());
    }
    for (bad, key) in [
        (AtlasConfig { size_px: 8, ..AtlasConfig::default() }, "size_px"),
        (AtlasConfig { gutter_px: 300, ..AtlasConfig::default() }, "gutter_px"),
        (AtlasConfig { front: Some(Vec3::ZERO), ..AtlasConfig::default() }, "front"),
    ] {
        assert!(error(&good, &bad).to_string().contains(key));
    }
    // a NaN that no triangle uses is no matter
    let mut unused = good;
    unused.positions.push(Vec3::NAN);
    laid(&unused, &config(256));
}

#[test]
fn tiny_and_huge_meshes_are_laid_like_any_other() {
    for size in [1e-12f32, 1e-3, 1e6] {
        let mut mesh = sphere(14, 20);
        mesh.positions.iter_mut().for_each(|p| *p = *p * size + Vec3::splat(3.0 * size));
        let (_, r) = laid(&mesh, &config(512));
        assert!(r.fallback.is_none() && r.uv.used > 0.4, "{size}: {r:?}");
    }
}

/// A way that breaks its promise: everything lies in one place.
fn heap(mesh: &Mesh, config: &AtlasConfig) -> AtlasLayout {
    let uvs = vec![glam::Vec2::splat(0.4), glam::Vec2::new(0.4, 0.6), glam::Vec2::splat(0.6)];
    let (width, height) = (config.size_px, config.size_px);
    let atlas = Atlas { uvs, triangles: vec![[0, 1, 2]; mesh.triangles.len()], width, height };
    AtlasLayout { atlas, repaired: 0, gutter_px: 4.0, head: None }
}

#[test]
fn when_a_way_fails_every_triangle_becomes_a_half_square() {
    let mesh = sphere(6, 10);
    type Way = dyn Fn(&Mesh, &AtlasConfig) -> Result<AtlasLayout>;
    let by = |way: &Way| atlas_by(|m, c, _| way(m, c), &mesh, &config(512), &Quiet).map(|r| r.1);
    let r = by(&|_, _| Err(Error::cannot("it broke", ""))).unwrap();
    assert_eq!((r.fallback.as_deref(), r.uv.charts), (Some("it broke"), mesh.triangles.len()));
    assert!(r.uv.is_sound() && r.warnings()[0].to_string().contains("it broke"));
    assert!(by(&|_, _| Err(Error::stopped(""))).unwrap_err().kind().is_stop());
    let r = by(&|mesh, config| Ok(heap(mesh, config))).unwrap();
    assert!(r.uv.is_sound() && r.fallback.unwrap().contains("did not pass"));
}

/// Stops after this many questions.
struct Patience(AtomicU64);

impl Monitor for Patience {
    fn step(&self, _: u64, _: u64, _: &[(&str, f64)]) {}
    fn stop(&self) -> bool {
        self.0.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_err()
    }
}

#[test]
fn it_stops_when_told_to() {
    for patience in [0, 1, 3, 6] {
        let stopped = atlas(&sphere(20, 40), &config(512), &Patience(AtomicU64::new(patience)));
        assert!(stopped.unwrap_err().kind().is_stop(), "{patience}");
    }
}

#[test]
fn one_thread_and_two_make_the_same_bytes() {
    let mesh = sphere(36, 54);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| laid(&mesh, &AtlasConfig { front: Some(Vec3::Z), ..config(512) }).0)
    };
    assert_eq!(with(1), with(2));
}

#[test]
fn the_face_stands_upright_in_the_texture() {
    let mesh = sphere(60, 90);
    for up in [Vec3::Y, Vec3::X, Vec3::new(1.0, -2.0, 0.0).normalize()] {
        let front = AtlasConfig { front: Some(Vec3::Z), up: Some(up), ..config(512) };
        let (atlas, report) = laid(&mesh, &front);
        assert!(report.fallback.is_none());
        // two points of the face, one above the other: v runs down
        let at = |p: Vec3| {
            let near = |t: &usize| mesh.corners(*t as u32).iter().map(|q| q.distance(p)).sum::<f32>();
            let t = (0..mesh.triangles.len()).min_by(|a, b| near(a).total_cmp(&near(b))).unwrap();
            atlas.triangles[t].map(|i| atlas.uvs[i as usize]).iter().sum::<glam::Vec2>() / 3.0
        };
        let step = at((Vec3::Z + 0.2 * up).normalize()) - at((Vec3::Z - 0.2 * up).normalize());
        assert!(step.y < 0.0 && step.x.abs() < 0.15 * -step.y, "{up}: {step}");
    }
}

#[test]
fn the_cap_of_a_head_takes_little_of_the_texture() {
    // a sphere down to 120 degrees from its pole, on a fan: of the surface 0.75 pi of (3 + 0.75) pi
    // is flat
    let mut mesh = sphere(40, 80);
    for p in &mut mesh.positions {
        let polar = p.y.acos() * (40.0 / 39.0) * (2.0 / 3.0);
        *p = Vec3::new(p.x, 0.0, p.z).normalize_or_zero() * polar.sin() + polar.cos() * Vec3::Y;
    }
    let last = mesh.positions.len() - 1;
    mesh.positions[last] = Vec3::new(0.0, -0.5, 0.0);
    let share = |config: &AtlasConfig| {
        let (atlas, _) = laid(&mesh, config);
        let area = |t: usize| {
            let [a, b, c] = atlas.triangles[t].map(|i| atlas.uvs[i as usize]);
            (b - a).perp_dot(c - a).abs()
        };
        let is_flat = |t: &usize| mesh.triangles[*t].contains(&(last as u32));
        let count = mesh.triangles.len();
        (0..count).filter(is_flat).map(area).sum::<f32>() / (0..count).map(area).sum::<f32>()
    };
    let whole = share(&config(512));
    let head = share(&AtlasConfig { front: Some(Vec3::Z), up: Some(Vec3::Y), ..config(512) });
    assert!((whole - 0.2).abs() < 0.02 && head < 0.03, "{whole} {head}");
}

/// A bumpy ball of 200,000 triangles.
#[test]
#[ignore = "long: run by `tools/test.sh all`; a mesh of 200,000 triangles takes seconds"]
fn two_hundred_thousand_triangles_are_laid() {
    let mut mesh = sphere(317, 317);
    for p in &mut mesh.positions {
        *p *= 1.0 + 0.03 * (9.0 * p.x).sin() * (8.0 * p.y + 1.0).sin() * (7.0 * p.z).cos();
    }
    assert!(mesh.triangles.len() > 200_000);
    let (_, r) = laid(&mesh, &AtlasConfig { size_px: 4096, ..AtlasConfig::default() });
    assert!(r.fallback.is_none() && r.uv.charts < 200, "{r:?}");
}

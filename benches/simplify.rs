//! bench
#[path = "../tests/fields/mod.rs"]
mod fields;

use glam::Vec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;
use tiface::geom::Mesh;
use tiface::mesh::{SimplifyConfig, Volume, check, marching, simplify};
use tiface::run::Quiet;

/// CPU seconds of this thread so far; wall time where the system does not tell.
fn cpu_s() -> f64 {
    let spent = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    match spent.and_then(|s| s.split(' ').next().and_then(|s| s.parse::<f64>().ok())) {
        Some(ns) => 1e-9 * ns,
        None => {
            static START: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
            START.get_or_init(Instant::now).elapsed().as_secs_f64()
        }
    }
}

static FIELD_NS: AtomicU64 = AtomicU64::new(0);

/// The head with its gradient from the corners of a small tetrahedron: four values a point.
fn field(points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
    let start = cpu_s();
    const E: f32 = 3e-4;
    const CORNERS: [Vec3; 4] =
        [Vec3::new(1.0, -1.0, -1.0), Vec3::new(-1.0, -1.0, 1.0), Vec3::new(-1.0, 1.0, -1.0), Vec3::ONE];
    let one = |&p: &Vec3| {
        let f = CORNERS.map(|c| fields::head(p + E * c));
        let g = (0..4).map(|k| f[k] * CORNERS[k]).sum::<Vec3>() / (4.0 * E);
        (f.iter().sum::<f32>() / 4.0, g)
    };
    let out = points.par_iter().map(one).unzip();
    FIELD_NS.fetch_add(((cpu_s() - start) * 1e9) as u64, Ordering::Relaxed);
    out
}

/// Mean and worst distance of points of the mesh to the head's surface, in 512ths of the cube, by area.
fn error(mesh: &Mesh) -> (f64, f64) {
    const WHERE: [[f32; 3]; 7] = [
        [1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0],
        [0.6, 0.2, 0.2],
        [0.2, 0.6, 0.2],
        [0.2, 0.2, 0.6],
        [0.1, 0.45, 0.45],
        [0.45, 0.1, 0.45],
        [0.45, 0.45, 0.1],
    ];
    let (mut sum, mut weight, mut worst) = (0.0f64, 0.0f64, 0.0f64);
    for part in (0..mesh.triangles.len() as u32).collect::<Vec<_>>().chunks(10_000) {
        let points: Vec<Vec3> = part
            .iter()
            .flat_map(|&t| {
                let [a, b, c] = mesh.corners(t);
                WHERE.map(|[u, v, w]| u * a + v * b + w * c)
            })
            .collect();
        let mut at = points.clone();
        for _ in 0..4 {
            let (f, g) = field(&at);
            for i in 0..at.len() {
                at[i] -= f[i] / g[i].length_squared() * g[i];
            }
        }
        for (i, &t) in part.iter().enumerate() {
            let [a, b, c] = mesh.corners(t);
            let area = f64::from((b - a).cross(c - a).length());
            for k in 0..WHERE.len() {
                let d = f64::from(points[i * WHERE.len() + k].distance(at[i * WHERE.len() + k])) * 256.0;
                sum += d * area;
                weight += area;
                worst = worst.max(d);
            }
        }
    }
    (sum / weight, worst)
}

fn show(name: &str, ms: f64, field_ms: f64, mesh: &Mesh) {
    let (mean, worst) = error(mesh);
    let r = check::check(mesh, 1.0);
    println!(
        "{name:<28} {:>7} triangles {ms:>7.1} ms ({field_ms:>6.1} in the field)  mean {mean:.4} worst {worst:.3}  slivers {:.3} %  {}  Euler {}  {} intersect",
        mesh.triangles.len(),
        100.0 * r.slivers as f64 / mesh.triangles.len() as f64,
        if r.closed && r.manifold { "manifold" } else { "NOT MANIFOLD" },
        r.euler,
        r.self_intersections
    );
}

fn main() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread pool");
    pool.install(|| {
        for (n, target) in [(245, 40_000)] {
            let (values, h) = fields::grid(fields::head, n);
            let volume =
                Volume { dims: [n; 3], values: &values, origin: Vec3::NEG_ONE, spacing: Vec3::splat(h) };
            let surface = marching(&volume, true).expect("a valid volume");
            let input =
                Mesh { positions: surface.positions, triangles: surface.triangles, ..Mesh::default() };
            show(&format!("head {n}³"), 0.0, 0.0, &input);
            for with in [false, true] {
                let mut best = (f64::INFINITY, 0.0);
                let mut mesh = Mesh::default();
                for _ in 0..3 {
                    mesh = input.clone();
                    FIELD_NS.store(0, Ordering::Relaxed);
                    let start = cpu_s();
                    let config = SimplifyConfig {
                        triangles: target,
                        rounds: std::env::var("ROUNDS").map_or(2, |s| s.parse().unwrap()),
                        placement: if std::env::var("ON").is_ok() {
                            tiface::mesh::Placement::OnSurface
                        } else {
                            Default::default()
                        },
                        ..Default::default()
                    };
                    let report = simplify(&mut mesh, with.then_some(&field as _), &config, &Quiet)
                        .expect("a sound mesh");
                    let ms = 1e3 * (cpu_s() - start);
                    if ms < best.0 {
                        best = (ms, FIELD_NS.load(Ordering::Relaxed) as f64 * 1e-6);
                    }
                    if std::env::var("V").is_ok() {
                        println!("{report:?}");
                    }
                }
                show(if with { "with the field" } else { "without" }, best.0, best.1, &mesh);
            }
        }
    });
}

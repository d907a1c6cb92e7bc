//! CPU milliseconds and accuracy of simplification: the head of `tests/support/fields.rs`, one
//! thread.
//!
//! ```text
//! cargo bench --bench simplify                      202 k to 40 k triangles, 506 k to 100 k
//! cargo bench --bench simplify -- 245 40000         one of them: nodes along an axis, target
//! cargo bench --bench simplify -- --write 245 head  the input as head.vertices, head.triangles
//! cargo bench --bench simplify -- --read a.vertices a.triangles
//!                                                   the accuracy of another tool's result
//! ```
//! Errors are distances of points of the triangles to the true surface, weighted by area, in 512ths
//! of the cube's edge. Raw files are little-endian f32 and u32.

#[path = "../tests/support/fields.rs"]
mod fields;
mod process;

use glam::Vec3;
use process::cpu_s;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};
use tiface::Quiet;
use tiface::geom::{Mesh, SdfField};
use tiface::mesh::files::check;
use tiface::mesh::{SimplifyConfig, Volume, marching, simplify};

/// Runs of which the fastest counts: what else the machine does only ever adds.
const RUNS: usize = 5;

/// CPU seconds of this thread so far; wall time where the system does not tell.
static FIELD_NS: AtomicU64 = AtomicU64::new(0);

/// The head with its gradient from the corners of a small tetrahedron: four values a point.
struct Head;

impl SdfField for Head {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        field(points).0
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        field(points)
    }

    fn colors(&self, _: &[Vec3], _: &[Vec3], _: &[u32], directions: &[Vec3]) -> Vec<[f32; 3]> {
        vec![[0.5; 3]; directions.len()]
    }
}

fn field(points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
    const E: f32 = 3e-4;
    const CORNERS: [Vec3; 4] =
        [Vec3::new(1.0, -1.0, -1.0), Vec3::new(-1.0, -1.0, 1.0), Vec3::new(-1.0, 1.0, -1.0), Vec3::ONE];
    let start = cpu_s();
    let one = |&p: &Vec3| {
        let f = CORNERS.map(|c| fields::head(p + E * c));
        let g = (0..4).map(|k| f[k] * CORNERS[k]).sum::<Vec3>() / (4.0 * E);
        (f.iter().sum::<f32>() / 4.0, g)
    };
    let out = points.par_iter().map(one).unzip();
    FIELD_NS.fetch_add(((cpu_s() - start) * 1e9) as u64, Ordering::Relaxed);
    out
}

/// Mean and worst distance to the head's surface, in 512ths of the cube, found by four Newton
/// steps.
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
            at.iter_mut().zip(f.iter().zip(&g)).for_each(|(p, (f, g))| *p -= *f / g.length_squared() * *g);
        }
        for (i, &t) in part.iter().enumerate() {
            let [a, b, c] = mesh.corners(t);
            let area = f64::from((b - a).cross(c - a).length());
            for k in WHERE.len() * i..WHERE.len() * (i + 1) {
                let d = 256.0 * f64::from(points[k].distance(at[k]));
                sum += d * area;
                weight += area;
                worst = worst.max(d);
            }
        }
    }
    (sum / weight, worst)
}

fn show(name: &str, ms: Option<(f64, f64)>, mesh: &Mesh) {
    let (mean, worst) = error(mesh);
    let r = check(mesh, 1.0);
    let time = ms.map_or(String::new(), |(all, field)| format!("{all:.1} ms ({field:.1} in the field)"));
    println!(
        "{name:<22} {:>7} triangles  {time:<32} mean {mean:.4} worst {worst:.3}  slivers {:.3} %  {}, Euler {}, {} self-intersect",
        mesh.triangles.len(),
        100.0 * r.slivers as f64 / mesh.triangles.len() as f64,
        if r.closed && r.manifold { "manifold" } else { "NOT MANIFOLD" },
        r.euler,
        r.self_intersections
    );
}

fn head(n: usize) -> Mesh {
    let (values, h) = fields::grid(fields::head, n);
    let volume = Volume { dims: [n; 3], values: &values, origin: Vec3::NEG_ONE, spacing: Vec3::splat(h) };
    marching(&volume, true).expect("a valid volume").mesh
}

fn measure(n: usize, triangles: usize) {
    let input = head(n);
    show(&format!("head {n}³"), None, &input);
    let ways = [
        ("without the field", false, 0.0),
        // an error to keep that no triangle reaches
        ("with it, on its zero", true, 1.0),
        ("with it, nearest", true, 0.0),
    ];
    for (name, with, error) in ways {
        let config = SimplifyConfig { triangles, error, ..SimplifyConfig::default() };
        let (mut best, mut mesh) = ((f64::INFINITY, 0.0), Mesh::default());
        for _ in 0..RUNS {
            mesh = input.clone();
            FIELD_NS.store(0, Ordering::Relaxed);
            let start = cpu_s();
            simplify(&mut mesh, with.then_some(&Head as _), &config, &Quiet).expect("a sound mesh");
            let ms = 1e3 * (cpu_s() - start);
            if ms < best.0 {
                best = (ms, FIELD_NS.load(Ordering::Relaxed) as f64 * 1e-6);
            }
        }
        show(name, Some(best), &mesh);
        let report = check(&mesh, 1.0);
        assert!(report.closed && report.manifold, "{name}: the mesh is not closed or not manifold");
    }
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let words: Vec<&str> = args.iter().map(String::as_str).collect();
    let number = |s: &str| s.parse::<usize>().expect("a number");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread pool");
    pool.install(|| match words[..] {
        ["--write", n, path] => {
            let mesh = head(number(n));
            let write = |kind: &str, bytes: &[u8]| {
                std::fs::write(format!("{path}.{kind}"), bytes).expect("a writable path")
            };
            write("vertices", bytemuck::cast_slice(&mesh.positions));
            write("triangles", bytemuck::cast_slice(&mesh.triangles));
        }
        ["--read", vertices, triangles] => {
            let read = |path| std::fs::read(path).expect("a readable path");
            let mesh = Mesh {
                positions: bytemuck::pod_collect_to_vec(&read(vertices)),
                triangles: bytemuck::pod_collect_to_vec(&read(triangles)),
                ..Mesh::default()
            };
            show("read", None, &mesh);
        }
        [n, target] => measure(number(n), number(target)),
        _ => {
            measure(245, 40_000);
            measure(388, 100_000);
        }
    });
}

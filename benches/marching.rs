//! Milliseconds of dense extraction: the head and a gyroid, one thread and two.
//!
//! ```text
//! cargo bench --bench marching                       128³, 256³, 512³
//! cargo bench --bench marching -- 256                one size
//! cargo bench --bench marching -- --write head 256 volume.f32
//! ```
//! `--write` leaves a raw little-endian f32 volume (x fastest) for
//! `tools/reference/flying_edges.py`, and `--read 256 volume.f32` times one, a line a run, so that
//! a script can interleave the two.

#[path = "../tests/support/fields.rs"]
mod fields;
mod process;

use glam::Vec3;
use process::roof::Roof;
use std::time::Instant;
use tiface::geom::Mesh;
use tiface::mesh::{Volume, marching};

fn best_ms(values: &[f32], n: usize, threads: usize, runs: usize) -> (f64, Mesh) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
    let h = 2.0 / (n - 1) as f32;
    let volume = Volume { dims: [n; 3], values, origin: Vec3::NEG_ONE, spacing: Vec3::splat(h) };
    pool.install(|| {
        let (mut best, mut mesh) = (f64::INFINITY, Mesh::default());
        for _ in 0..runs {
            let start = Instant::now();
            let surface = marching(&volume, false).expect("a valid volume");
            best = best.min(start.elapsed().as_secs_f64() * 1e3);
            mesh = surface.mesh;
        }
        (best, mesh)
    })
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let words: Vec<&str> = args.iter().map(String::as_str).collect();
    let shapes: [(&str, fn(Vec3) -> f32); 2] = [("head", fields::head), ("gyroid", fields::gyroid)];
    match words[..] {
        ["--write", shape, n, path] => {
            let n = n.parse().expect("a size");
            let field = shapes.iter().find(|s| s.0 == shape).expect("head or gyroid").1;
            let (values, _) = fields::grid(field, n);
            std::fs::write(path, bytemuck::cast_slice(&values)).expect("a writable path");
        }
        ["--read", n, path] => {
            let n = n.parse().expect("a size");
            let bytes = std::fs::read(path).expect("a readable path");
            let values: Vec<f32> = bytemuck::pod_collect_to_vec(&bytes);
            let (ms, mesh) = best_ms(&values, n, 1, 7);
            println!("tiface {ms:.2} ms, {} triangles", mesh.triangles.len());
        }
        _ => {
            let sizes: Vec<usize> = match words[..] {
                [] => vec![128, 256, 512],
                _ => words.iter().map(|w| w.parse().expect("a size")).collect(),
            };
            let roof = Roof::measure();
            for (name, field) in shapes {
                for &n in &sizes {
                    let (values, _) = fields::grid(field, n);
                    let runs = if n > 300 { 3 } else { 7 };
                    let (one, mesh) = best_ms(&values, n, 1, runs);
                    let (two, same) = best_ms(&values, n, 2, runs);
                    assert!(mesh == same, "two threads give another mesh");
                    // the volume is read, the mesh written
                    let bytes = 4 * values.len() + 12 * (mesh.positions.len() + mesh.triangles.len());
                    println!(
                        "{name} {n}³: {} ms, two threads {two:.2} ms, {} triangles",
                        roof.moved(one, bytes as f64),
                        mesh.triangles.len()
                    );
                }
            }
        }
    }
}

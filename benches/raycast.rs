//! Rays per second on one thread, over a head-like mesh of 200 000 triangles.
//!
//! `cargo bench --bench raycast` prints Mrays/s for primary rays (two views of 724 × 724) and for
//! scattered rays. With `-- --dump DIR` it also writes the mesh and the very same rays there, so
//! that `tools/reference/embree.py DIR` can time Embree on them. A mesh of one's own comes after
//! `--mesh`, as .ply, .obj or .glb.

mod head;

use glam::{DMat3, DVec3, Vec2, Vec3};
use head::head;
use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::time::Instant;
use tiface::geom::{Aabb, Bvh, Camera, Distortion, Ray};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let (mut dump, mut given) = (None::<PathBuf>, None::<PathBuf>);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--dump" => dump = arguments.next().map(PathBuf::from),
            "--mesh" => given = arguments.next().map(PathBuf::from),
            _ => {} // cargo passes --bench
        }
    }
    let mesh = match &given {
        Some(path) => tiface::mesh::files::read(&std::fs::read(path)?, path)?,
        None => head(129),
    };
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global()?;
    let start = Instant::now();
    let bvh = Bvh::new(&mesh);
    println!("{} triangles, built in {:.3} s", mesh.triangles.len(), start.elapsed().as_secs_f64());

    let primary = primary_rays(mesh.bounds());
    let random = random_rays(mesh.bounds(), 1_000_000);
    for (name, rays) in [("primary", &primary), ("random", &random)] {
        let mut hits = 0;
        let seconds = best_of(5, || {
            hits = rays.iter().filter(|r| black_box(bvh.closest_hit(r)).is_some()).count();
        });
        let any = rays.iter().filter(|r| bvh.any_hit(r)).count();
        assert_eq!(any, hits, "a search for any hit finds others");
        println!(
            "{name:8} {:6.2} Mrays/s   {hits} of {} hit",
            rays.len() as f64 * 1e-6 / seconds,
            rays.len()
        );
    }
    let near: Vec<Vec3> = (0..200_000).map(|i| mesh.positions[i * 7 % mesh.positions.len()] * 1.01).collect();
    let mut sum = 0.0;
    let seconds = best_of(3, || {
        sum = near.iter().filter_map(|&p| bvh.closest_point(p)).map(|c| c.distance as f64).sum();
    });
    let mean = sum / near.len() as f64;
    // corners were moved by a hundredth of their distance from the origin
    let moved = near.iter().map(|p| f64::from(p.length())).sum::<f64>() / 101.0 / near.len() as f64;
    assert!((0.0..1.001 * moved).contains(&mean), "{mean} is farther than the mesh, {moved} away");
    println!("closest  {:6.2} Mpoints/s  mean {mean:.6}", near.len() as f64 * 1e-6 / seconds);

    if let Some(folder) = dump {
        std::fs::create_dir_all(&folder)?;
        let ply = tiface::mesh::files::to_ply(&mesh, None, &Default::default())?;
        std::fs::write(folder.join("mesh.ply"), &ply.files[0].1)?;
        write_rays(&folder.join("primary.f32"), &primary)?;
        write_rays(&folder.join("random.f32"), &random)?;
    }
    Ok(())
}

/// The shortest of several times, in seconds: the least disturbed one.
fn best_of(times: usize, mut run: impl FnMut()) -> f64 {
    (0..times)
        .map(|_| {
            let start = Instant::now();
            run();
            start.elapsed().as_secs_f64()
        })
        .fold(f64::INFINITY, f64::min)
}

fn primary_rays(bounds: Aabb) -> Vec<Ray> {
    let (center, size) = (bounds.center().as_dvec3(), bounds.size().max_element() as f64);
    let mut rays = Vec::new();
    for angle in [0.0f64, 2.0] {
        let rotation = DMat3::from_rotation_y(angle);
        let camera = Camera {
            width: 724,
            height: 724,
            fx: 1100.0,
            fy: 1100.0,
            cx: 362.0,
            cy: 362.0,
            distortion: Distortion::default(),
            rotation,
            position: center + rotation * DVec3::new(0.0, 0.0, 2.0 * size),
        };
        for y in 0..724 {
            rays.extend((0..724).filter_map(|x| camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5))));
        }
    }
    rays
}

/// From a ball around the mesh towards points in its box.
fn random_rays(bounds: Aabb, count: usize) -> Vec<Ray> {
    let mut state = 0x2545_f491_4f6c_dd1du64;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u64 << 24) as f32
    };
    let radius = bounds.size().length();
    (0..count)
        .map(|_| {
            let (z, turn) = (2.0 * next() - 1.0, std::f32::consts::TAU * next());
            let flat = (1.0 - z * z).sqrt();
            let origin = bounds.center() + radius * Vec3::new(flat * turn.cos(), flat * turn.sin(), z);
            let target = bounds.min + bounds.size() * Vec3::new(next(), next(), next());
            Ray::new(origin, (target - origin).normalize())
        })
        .collect()
}

fn write_rays(path: &Path, rays: &[Ray]) -> std::io::Result<()> {
    let floats: Vec<[Vec3; 2]> = rays.iter().map(|r| [r.origin, r.direction]).collect();
    std::fs::write(path, bytemuck::cast_slice::<_, u8>(&floats))
}

//! Laying a head into its texture: CPU seconds and what comes out.
//!
//! ```text
//! cargo bench --bench atlas                  20 k and 100 k triangles into 2048²
//! cargo bench --bench atlas -- 4096          another texture
//! ```
//!
//! CPU time (user + system of the process) does not depend on what else the machine does.

#[path = "../tests/support/fields.rs"]
mod fields;
mod process;

use glam::Vec3;
use process::cpu_s;
use tiface::Quiet;
use tiface::geom::{Aabb, Mesh};
use tiface::mesh::files::{seams_facing, uv_check};
use tiface::mesh::{AtlasConfig, ExtractOptions, atlas, extract};

fn head(resolution: usize) -> Mesh {
    let config = ExtractOptions { resolution, ..ExtractOptions::default() };
    extract(&fields::head, Aabb::SCENE, &config, &Quiet).expect("a head").0
}

fn main() {
    let size_px = std::env::args().filter_map(|a| a.parse().ok()).next().unwrap_or(2048);
    for resolution in [78, 172] {
        let mesh = head(resolution);
        for front in [None, Some(Vec3::Z)] {
            let up = front.map(|_| Vec3::Y);
            let config = AtlasConfig { size_px, front, up, ..AtlasConfig::default() };
            // the best of a few: the first one also warms up
            let mut best = f64::INFINITY;
            for _ in 0..4 {
                let start = cpu_s();
                atlas(&mesh, &config, &Quiet).expect("an atlas");
                best = best.min(cpu_s() - start);
            }
            let (atlas, report) = atlas(&mesh, &config, &Quiet).expect("an atlas");
            let start = cpu_s();
            let uv = uv_check(&mesh, &atlas);
            let check = cpu_s() - start;
            let towards = if front.is_some() { ", front +z" } else { "" };
            println!(
                "{} triangles, {size_px}²{towards}: {best:.2} CPU s, of it {check:.2} the check",
                uv.triangles
            );
            println!("repaired {}, fall-back {:?}", report.repaired, report.fallback);
            for part in &report.parts {
                let (name, texels, density) = (&part.part, 100.0 * part.texels, part.density);
                println!("{name:<20} {texels:.1} % of the texels, {density:.0} along a unit");
            }
            println!("seams facing +z      {:.2} × √area", seams_facing(&mesh, &atlas, Vec3::Z));
            println!("{uv}");
            assert!(uv.is_sound(), "the atlas has faults");
        }
    }
}

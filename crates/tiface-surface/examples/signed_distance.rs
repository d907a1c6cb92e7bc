//! Meshes a striped ring, given as a signed distance with colors, to a closed and textured GLB.
//!
//! `cargo run --release -p tiface-surface --example signed_distance -- ring.glb`

use glam::{Mat3, Vec2, Vec3};
use std::path::PathBuf;
use tiface_base::Quiet;
use tiface_base::geom::{Aabb, SdfField};
use tiface_surface::bake::{BakeConfig, bake};
use tiface_surface::files::{ExportOptions, HeadTexture, check, to_glb};
use tiface_surface::{AtlasConfig, ExtractOptions, SimplifyConfig, atlas, extract, simplify};

/// A ring of radius 0.6 around z, whose tube has radius 0.25.
fn ring(p: Vec3) -> f32 {
    Vec2::new(p.truncate().length() - 0.6, p.z).length() - 0.25
}

/// The ring in stripes, the same from everywhere.
struct StripedRing;

impl SdfField for StripedRing {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        ring.sdf(points)
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        ring.sdf_gradient(points)
    }

    fn colors(&self, points: &[Vec3], _: &[Vec3], counts: &[u32], _: &[Vec3]) -> Vec<[f32; 3]> {
        let is_light = |p: &Vec3| (8.0 * p.y.atan2(p.x)).sin() > 0.0;
        let stripe = |p: &Vec3| if is_light(p) { [0.9, 0.6, 0.2] } else { [0.2, 0.3, 0.6] };
        points.iter().zip(counts).flat_map(|(p, n)| vec![stripe(p); *n as usize]).collect()
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| "ring.glb".into()));

    let options = ExtractOptions { resolution: 128, ..ExtractOptions::default() };
    let (mut mesh, report) = extract(&StripedRing, Aabb::SCENE, &options, &Quiet)?;
    let config = SimplifyConfig { triangles: 10_000, ..SimplifyConfig::default() };
    simplify(&mut mesh, Some(&StripedRing), &config, &Quiet)?;
    let (layout, _) = atlas(&mesh, &AtlasConfig { size_px: 1024, ..AtlasConfig::default() }, &Quiet)?;
    let reach = 2.0 * report.cell_size;
    let turned = Mat3::IDENTITY;
    let config = BakeConfig { side: 2, gutter_px: 8, reach, views: 4, lobes: 0, normals: false, turned };
    let baked = bake(&mesh, &layout, &StripedRing, &[], &config, &Quiet)?;

    print!("{}", check(&mesh, 1.0));
    let texture = HeadTexture::new(layout, baked.color.encoded());
    std::fs::write(&path, to_glb(&mesh, Some(&texture), None, &ExportOptions::default())?)?;
    Ok(())
}

//! A head that tests share.

use super::cover::Bands;
use super::fill::fill;
use crate::files::{HeadMesh, HeadTexture, Lobes};
use crate::{AtlasConfig, Volume, atlas, marching};
use glam::{Mat3, Vec3};
use std::sync::OnceLock;
use tiface_base::Quiet;
use tiface_base::geom::{ShellLayer, Shells, Similarity};
use tiface_base::image::{Image, Photo, quantize};

/// Returns a ball of radius 12 whose texture shows the position, with a layer that is opaque above.
pub fn ball() -> HeadMesh {
    static BALL: OnceLock<HeadMesh> = OnceLock::new();
    BALL.get_or_init(make_ball).clone()
}

fn make_ball() -> HeadMesh {
    let at = |i: usize| i as f32 - 15.5;
    let distance = |i: usize| Vec3::new(at(i % 32), at(i / 32 % 32), at(i / 1024)).length() - 12.0;
    let values: Vec<f32> = (0..32 * 32 * 32).map(distance).collect();
    let volume = Volume { dims: [32; 3], values: &values, origin: Vec3::splat(-15.5), spacing: Vec3::ONE };
    let mut mesh = marching(&volume, true).unwrap().mesh;
    mesh.normals = mesh.positions.iter().map(|p| p.normalize()).collect();
    mesh.colors = mesh.positions.iter().map(|p| shown(*p)).collect();
    let config = AtlasConfig { size_px: 512, gutter_px: 4, ..AtlasConfig::default() };
    let layout = atlas(&mesh, &config, &Quiet).unwrap().0;
    let (mut image, mut covered) = (Image::new(512, 512, 3), vec![false; 512 * 512]);
    let bands = Bands::new(&layout, 1);
    for sample in (0..bands.len()).flat_map(|band| bands.samples(&layout, band, 1)) {
        let at = 3 * sample.texel as usize;
        covered[at / 3] = true;
        image.data[at..at + 3].copy_from_slice(&shown(mesh.point_at(&sample.hit())));
    }
    fill(&mut image, &covered, 4);
    let rgb = image.data.as_chunks::<3>().0.iter().map(|c| c.map(quantize)).collect();
    let photo = Photo { width: 512, height: 512, rgb, alpha: None };
    let lobes = Lobes { pictures: vec![photo.clone()], scale: vec![0.254], turned: Mat3::IDENTITY };
    let alphas = mesh.positions.iter().map(|p| if p.y > 0.0 { 1.0 } else { 0.0 }).collect();
    let offsets = mesh.positions.iter().map(|p| 0.1 * p.x).collect();
    let depths = mesh.positions.iter().map(|p| 0.2 + 0.01 * p.x).collect();
    let shells = Some(Shells { layers: vec![ShellLayer { offsets, alphas }], depths });
    let texture = Some(HeadTexture { lobes: Some(lobes), ..HeadTexture::new(layout, photo) });
    HeadMesh { mesh, world_from_scene: Similarity::IDENTITY, texture, harmonics: None, shells }
}

/// Returns the sRGB-coded color at a point.
pub fn shown(p: Vec3) -> [f32; 3] {
    (0.5 + 0.03 * p).to_array()
}

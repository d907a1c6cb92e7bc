//! From the whole extraction to what an artist opens: simplified, laid out, baked.

use super::export::{Export, center};
use super::surface::ClosedSurface;
use crate::capture::scene::Scene;
use crate::config::{ColorSource, Hair, MeshConfig, MeshFrame};
use crate::geom::{Camera, Mesh};
use crate::image::{Image, Photo, linear_from_srgb, quantize, srgb_from_linear};
use crate::mesh::bake::{BakeConfig, Learned, Seams, bake, bake_harmonics, complete, tangent_space};
use crate::mesh::files::{HeadMesh, HeadTexture, Lobes, tangents};
use crate::mesh::{
    AtlasConfig, Colors, Photograph, SimplifyConfig, atlas, fit_appearance, fit_shells, simplify,
};
use crate::{Monitor, Result};
use glam::{Mat3, Vec3};
use serde_json::{Map, Value, json};

/// How far the true surface may lie from a triangle, in cells: the chords of large triangles and half a cell.
pub(super) const REACH: f32 = 2.5;

/// The head mesh, what is to be kept beside it, and what happened.
pub(super) struct FinishedHead {
    /// What an artist opens.
    pub head: HeadMesh,
    /// The baked color, linear.
    pub linear: Option<Image>,
    /// A report per step.
    pub report: Map<String, Value>,
    /// What a person should know.
    pub warnings: Vec<String>,
}

/// Cameras that the network's colors are taken from where photographs say the rest.
const FALLBACK_VIEWS: usize = 3;

/// Finishes a surface in scene coordinates, extracted with cells of `cell`; cameras are in scene coordinates, too.
pub(super) fn finish(
    surface: &Mesh,
    cell: f32,
    closed: &ClosedSurface,
    cameras: &[Camera],
    photographs: &[Photograph],
    scene: &Scene,
    export: &Export,
    c: &MeshConfig,
    monitor: &dyn Monitor,
) -> Result<FinishedHead> {
    let (mut report, mut warnings) = (Map::new(), Vec::new());
    let mut mesh = surface.clone();
    let gradient = |points: &[Vec3]| closed.sdf_gradient(points);
    let fewer = c.triangles > 0 && (c.triangles as usize) < mesh.triangles.len();
    if fewer || c.max_error > 0.0 {
        let config = SimplifyConfig {
            triangles: c.triangles as usize,
            error: c.max_error * cell,
            ..SimplifyConfig::default()
        };
        let done = simplify(&mut mesh, Some(&gradient), &config, monitor)?;
        warnings.extend(done.warnings(&config));
        report.insert("simplify".into(), json!(done));
    }
    let world_from_scene = scene.scene_from_world.inverse();
    // lobes are turned as `Export::files` turns the file; what is in no file is the same in all of them
    let frame = if c.lobes > 0 { export.frame } else { MeshFrame::Dataset };
    let asset_from_world = Export { frame, ..export.clone() }.asset_from_world(&mesh, &world_from_scene);
    let turned = asset_from_world * world_from_scene.rotation_f32();
    let most = if c.lobes > 0 { c.lobes } else { 2 };
    let fits = c.color == ColorSource::Photographs;
    let photographs_say = fits && photographs.iter().any(|p| p.head_pixels() > 0);
    if fits && !photographs_say {
        warnings.push("no photograph shows the head alone: the mesh has the colors of the network".into());
    }
    let mut shells = None;
    if c.hair == Hair::Shells {
        let (found, done) =
            fit_shells(&mesh, &closed.field.sharpness(&mesh.positions), photographs, monitor)?;
        report.insert("shells".into(), json!(done));
        shells = found;
    }
    if c.texture_px == 0 {
        let mut harmonics = None;
        if photographs_say
            && let Some(fitted) = fit_appearance(&mesh, Colors::Vertices, photographs, most, turned, monitor)?
        {
            report.insert("appearance".into(), json!(fitted.report));
            mesh.colors = fitted.vertices;
            harmonics = fitted.harmonics;
        }
        let head = HeadMesh { mesh, world_from_scene, texture: None, harmonics, shells };
        return Ok(FinishedHead { head, linear: None, report, warnings });
    }

    let front = export.front(center(surface, &world_from_scene));
    let front = front.map(|d| scene.scene_from_world.direction(d));
    let up = front.map(|_| scene.scene_from_world.direction(export.up.normalize_or(Vec3::Y)));
    let config = AtlasConfig { size_px: c.texture_px, gutter_px: c.gutter_px, front, up };
    let (layout, done) = atlas(&mesh, &config, monitor)?;
    warnings.extend(done.warnings());
    report.insert("atlas".into(), json!(done));

    let config = BakeConfig {
        // what photographs are to say need not be said exactly
        side: if photographs_say { 1 } else { c.texture_samples },
        views: if photographs_say { FALLBACK_VIEWS } else { usize::MAX },
        gutter_px: c.gutter_px,
        reach: REACH * cell,
        lobes: if photographs_say { 0 } else { c.lobes },
        normals: c.normal_map,
        turned,
    };
    let colors = |p: &[Vec3], n: &[Vec3], counts: &[u32], d: &[Vec3]| closed.colors(p, n, counts, d);
    let learned = Learned { gradient: &gradient, colors: &colors };
    let mut baked = bake(&mesh, &layout, &learned, cameras, &config, monitor)?;
    report.insert("bake".into(), json!(baked.report));
    let mut harmonics = None;
    if photographs_say {
        let mut image = baked.color.clone();
        image.data.iter_mut().for_each(|v| *v = srgb_from_linear(*v));
        let colors = Colors::Texels(&layout, &image);
        if let Some(fitted) = fit_appearance(&mesh, colors, photographs, most, turned, monitor)? {
            report.insert("appearance".into(), json!(fitted.report));
            let (texels, known) = fitted.texels;
            image.data = texels.into_flattened();
            complete(&mut image, &known, c.gutter_px, &Seams::new(&mesh, &layout));
            image.data.iter_mut().for_each(|v| *v = linear_from_srgb(*v));
            baked.color = image;
            mesh.colors = fitted.vertices;
            harmonics = fitted.harmonics;
        }
    }
    let color = coded(&baked.color);
    report.insert("seam_step_255".into(), json!(Seams::new(&mesh, &layout).step(&color)));

    let mut normal = None;
    if let Some(normals) = &baked.normal {
        match tangents(&mesh, &layout) {
            Ok(tangents) => {
                normal = Some(tangent_space(&mesh, &layout, &tangents, normals, c.gutter_px));
            }
            Err(e) => warnings.push(format!("the mesh has no normal map: {e}")),
        }
    }
    if let Some(harmonics) = harmonics.as_ref().filter(|_| c.lobes > 0) {
        baked.lobes = bake_harmonics(&mesh, &layout, harmonics, c.gutter_px);
    }
    let lobes = lobes(&baked.lobes, asset_from_world);
    let texture = Some(HeadTexture { atlas: layout, color, normal, lobes });
    let head = HeadMesh { mesh, world_from_scene, texture, harmonics, shells };
    Ok(FinishedHead { head, linear: c.exr.then_some(baked.color), report, warnings })
}

/// Linear color as a picture, rounded to nearest.
fn coded(image: &Image) -> Photo {
    let texel = |c: &[f32; 3]| c.map(|v| quantize(srgb_from_linear(v)));
    let rgb = image.data.as_chunks::<3>().0.iter().map(texel).collect();
    Photo { width: image.width, height: image.height, rgb, alpha: None }
}

/// Lobes as pictures. Each is scaled by what all but a thousandth of its texels keep within: a few wild texels
/// must not cost the others their precision.
fn lobes(images: &[Image], asset_from_world: Mat3) -> Option<Lobes> {
    if images.is_empty() {
        return None;
    }
    let (mut pictures, mut scale) = (Vec::new(), Vec::new());
    for image in images {
        let mut sizes: Vec<f32> = image.data.iter().map(|v| v.abs()).collect();
        let at = (sizes.len() as f64 * 0.999) as usize;
        let most = if sizes.is_empty() { 0.0 } else { *sizes.select_nth_unstable_by(at, f32::total_cmp).1 };
        let most = most.max(1e-4);
        let byte = |v: f32| (v / most * 127.0 + 128.5).clamp(1.0, 255.0) as u8;
        let rgb = image.data.as_chunks::<3>().0.iter().map(|c| c.map(byte)).collect();
        pictures.push(Photo { width: image.width, height: image.height, rgb, alpha: None });
        scale.push(most);
    }
    Some(Lobes { pictures, scale, asset_from_world })
}

//! A model written back: the binary files, one camera for each lens that differs, no points.

use super::super::lens::LensModel;
use super::pose_of;
use crate::geom::Camera;

/// The files of a model as (name, bytes), or which lens COLMAP has no model for.
pub(in super::super) fn files(images: &[(String, &Camera)]) -> Result<[(&'static str, Vec<u8>); 3], String> {
    let mut lenses: Vec<(i32, u64, u64, Vec<f64>)> = Vec::new();
    let mut listed = (images.len() as u64).to_le_bytes().to_vec();
    for (i, (name, camera)) in images.iter().enumerate() {
        let (model, values) =
            LensModel::of(camera).ok_or_else(|| format!("no model of COLMAP's has the lens of `{name}`"))?;
        let lens = (model.id, camera.width.into(), camera.height.into(), values);
        let number = lenses.iter().position(|known| *known == lens).unwrap_or(lenses.len());
        if number == lenses.len() {
            lenses.push(lens);
        }
        let (quaternion, t) = pose_of(camera.rotation, camera.position);
        listed.extend((i as u32 + 1).to_le_bytes());
        quaternion.iter().chain(&t.to_array()).for_each(|v| listed.extend(v.to_le_bytes()));
        listed.extend((number as u32 + 1).to_le_bytes());
        listed.extend(name.as_bytes());
        listed.push(0);
        listed.extend(0u64.to_le_bytes()); // no points are seen
    }
    let mut cameras = (lenses.len() as u64).to_le_bytes().to_vec();
    for (i, (model, width, height, values)) in lenses.iter().enumerate() {
        cameras.extend((i as u32 + 1).to_le_bytes());
        cameras.extend(model.to_le_bytes());
        cameras.extend([*width, *height].iter().flat_map(|side| side.to_le_bytes()));
        cameras.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    }
    let none = 0u64.to_le_bytes().to_vec();
    Ok([("points3D.bin", none), ("images.bin", listed), ("cameras.bin", cameras)])
}

//! Normals of the true surface as a tangent-space picture: the detail that simplification took.
//!
//! A texel holds `(x, y, z)` with `n = x t + y b + z m`, where `m` is the mesh's interpolated
//! normal, `t` its tangent along u and `b = w · m × t` its bitangent up the picture (MikkTSpace,
//! Mikkelsen 2008; OpenGL's +Y).

use super::cover::Bands;
use super::fill::fill;
use glam::{Mat3, Vec3, Vec4};
use tiface_base::geom::{Atlas, Mesh};
use tiface_base::image::{Image, Photo};

/// Turns a picture of normals in the mesh's coordinates into one in tangent space.
///
/// `tangents` has one per corner of each triangle, w = ±1; `normals` three channels of the atlas's
/// size, unit.
pub fn tangent_space(
    mesh: &Mesh,
    atlas: &Atlas,
    tangents: &[[Vec4; 3]],
    normals: &Image,
    gutter_px: u32,
) -> Photo {
    let (width, height) = (atlas.width, atlas.height);
    let mut out = Image::new(width, height, 3);
    let mut covered = vec![false; width as usize * height as usize];
    let bands = Bands::new(atlas, 1);
    for band in 0..bands.len() {
        for group in bands.samples(atlas, band, 1).chunk_by(|a, b| a.texel == b.texel) {
            let s = group[0];
            let m = mesh.normal_at(&s.hit()).unwrap_or(Vec3::Z);
            let tangent = tangents[s.triangle as usize];
            let t = s.hit().mix(tangent.map(Vec4::truncate));
            // as a renderer does: tangent perpendicular to the normal, bitangent from both
            let t = (t - m * m.dot(t)).normalize_or(m.any_orthonormal_vector());
            let b = tangent[0].w * m.cross(t);
            let at = s.texel as usize;
            let n = Vec3::from_slice(&normals.data[3 * at..3 * at + 3]);
            let local = (Mat3::from_cols(t, b, m).transpose() * n).normalize_or(Vec3::Z);
            covered[at] = true;
            // a renderer lights nothing from behind
            let local = local.with_z(local.z.max(0.05)).normalize();
            out.data[3 * at..3 * at + 3].copy_from_slice(&local.to_array());
        }
    }
    fill(&mut out, &covered, gutter_px);
    let byte = |v: f32| (127.5 * v.clamp(-1.0, 1.0) + 128.0) as u8;
    let rgb = out.data.as_chunks::<3>().0.iter().map(|n| {
        let n = Vec3::from(*n).normalize_or(Vec3::Z);
        [byte(n.x), byte(n.y), byte(n.z)]
    });
    Photo { width, height, rgb: rgb.collect(), alpha: None }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec2;

    #[test]
    fn a_normal_that_leans_along_u_is_red_and_one_up_the_picture_is_green() {
        // a square in the xy plane, u along +x, v down along −y
        let at = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
        let mesh = Mesh {
            positions: at.map(|(x, y)| Vec3::new(x, y, 0.0)).to_vec(),
            normals: vec![Vec3::Z; 4],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        };
        let uvs = at.map(|(x, y)| Vec2::new(x, 1.0 - y)).to_vec();
        let atlas = Atlas { uvs, triangles: mesh.triangles.clone(), width: 4, height: 4 };
        let tangents = crate::files::tangents(&mesh, &atlas).unwrap();
        let picture = |n: Vec3| {
            let data = (0..16).flat_map(|_| n.normalize().to_array()).collect();
            let normals = Image { width: 4, height: 4, channels: 3, data };
            tangent_space(&mesh, &atlas, &tangents, &normals, 1).rgb[5]
        };
        assert_eq!(picture(Vec3::Z), [128, 128, 255]);
        // (0.6, 0, 0.8): 127.5 · 0.6 + 128 = 204.5
        assert_eq!(picture(Vec3::new(0.6, 0.0, 0.8)), [204, 128, 230]);
        assert_eq!(picture(Vec3::new(0.0, 0.6, 0.8)), [128, 204, 230]);
    }
}

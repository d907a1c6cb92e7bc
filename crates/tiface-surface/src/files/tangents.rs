//! Tangents for normal maps, as Mikkelsen's program gives them to Blender, Unreal and every baker:
//! *Simulation of Wrinkled Surfaces Revisited*, 2008, chapter 3.
//!
//! A normal map means nothing without the tangents it was baked for. Bake with these, and the file
//! carries the same ones: `TANGENT` holds the direction of growing u and a sign w, and the
//! bitangent `w · (n × t)` points up the picture (towards smaller v, since our v runs down).

use super::head_texture::check_atlas;
use super::wrong_length;
use crate::check_indices;
use bevy_mikktspace::{Geometry, TangentSpace, generate_tangents};
use glam::{Vec2, Vec3, Vec4};
use tiface_base::Result;
use tiface_base::geom::{Atlas, Mesh};

/// Returns the tangent at each corner of each triangle: `xyz` unit, `w` ±1. Corners of a vertex
/// agree within a chart.
///
/// # Errors
///
/// Fails if the atlas does not belong to the mesh, or if the mesh has no normals.
pub fn tangents(mesh: &Mesh, atlas: &Atlas) -> Result<Vec<[Vec4; 3]>> {
    check_atlas(mesh, atlas)?;
    let (found, vertices) = (mesh.normals.len(), mesh.positions.len());
    if found != vertices {
        return Err(wrong_length(found, "normals", vertices));
    }
    check_indices(mesh)?;
    Ok(tangents_of(&mesh.positions, &mesh.normals, &mesh.triangles, &atlas.uvs, &atlas.triangles))
}

/// Computes [`tangents`] of parts whose indices have been checked.
pub(super) fn tangents_of(
    positions: &[Vec3],
    normals: &[Vec3],
    triangles: &[[u32; 3]],
    uvs: &[Vec2],
    corners: &[[u32; 3]],
) -> Vec<[Vec4; 3]> {
    let found = vec![[Vec4::ZERO; 3]; triangles.len()];
    let mut input = TangentInput { positions, normals, triangles, uvs, corners, found };
    // this fails only if no triangle has an area; remaining zeros are repaired below
    let _ = generate_tangents(&mut input);
    let mut found = input.found;
    for (tangents, vertices) in found.iter_mut().zip(triangles) {
        for (tangent, &vertex) in tangents.iter_mut().zip(vertices) {
            *tangent = repaired(*tangent, normals[vertex as usize]);
        }
    }
    found
}

/// Makes tangents unit and perpendicular to the normal. Triangles without area in the texture have
/// no direction of their own.
fn repaired(tangent: Vec4, normal: Vec3) -> Vec4 {
    let across = tangent.truncate().reject_from(normal);
    let unit = if tangent.is_finite() && across.length() > 1e-4 {
        // twice: the first leaves rounding of the f32 that `reject_from` divides by
        across.normalize().reject_from(normal).normalize()
    } else {
        normal.try_normalize().unwrap_or(Vec3::Y).any_orthonormal_vector()
    };
    (unit + Vec3::ZERO).extend(if tangent.w < 0.0 { -1.0 } else { 1.0 })
}

struct TangentInput<'a> {
    positions: &'a [Vec3],
    normals: &'a [Vec3],
    triangles: &'a [[u32; 3]],
    uvs: &'a [Vec2],
    corners: &'a [[u32; 3]],
    found: Vec<[Vec4; 3]>,
}

impl Geometry for TangentInput<'_> {
    fn num_faces(&self) -> usize {
        self.triangles.len()
    }

    fn num_vertices_of_face(&self, _: usize) -> usize {
        3
    }

    fn position(&self, face: usize, corner: usize) -> [f32; 3] {
        self.positions[self.triangles[face][corner] as usize].to_array()
    }

    fn normal(&self, face: usize, corner: usize) -> [f32; 3] {
        self.normals[self.triangles[face][corner] as usize].to_array()
    }

    /// With v up, as Mikkelsen's program and OpenGL normal maps take it.
    fn tex_coord(&self, face: usize, corner: usize) -> [f32; 2] {
        let uv = self.uvs[self.corners[face][corner] as usize];
        [uv.x, 1.0 - uv.y]
    }

    fn set_tangent(&mut self, tangent: Option<TangentSpace>, face: usize, corner: usize) {
        self.found[face][corner] = tangent.map_or(Vec4::ZERO, |t| Vec4::from_array(t.tangent_encoded()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a square in the plane z = 0 that looks along +Z, with the picture upright or
    /// mirrored.
    fn square(mirrored: bool) -> (Mesh, Atlas) {
        let positions = vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
        // v runs down: the top of the picture, v = 0, is at y = 1
        let uv = |p: &Vec3| Vec2::new(if mirrored { 1.0 - p.x } else { p.x }, 1.0 - p.y);
        let uvs = positions.iter().map(uv).collect();
        let triangles = vec![[0, 1, 2], [0, 2, 3]];
        let atlas = Atlas { uvs, triangles: triangles.clone(), width: 4, height: 4 };
        (Mesh { normals: vec![Vec3::Z; 4], positions, triangles, ..Mesh::default() }, atlas)
    }

    #[test]
    fn an_upright_picture_has_its_tangent_right_and_its_bitangent_up() {
        for (mirrored, right, w) in [(false, Vec3::X, 1.0), (true, -Vec3::X, -1.0)] {
            let (mesh, atlas) = square(mirrored);
            for tangent in tangents(&mesh, &atlas).unwrap().into_iter().flatten() {
                assert_eq!(tangent, right.extend(w));
                // up the picture is +Y of the square
                assert_eq!(w * Vec3::Z.cross(tangent.truncate()), Vec3::Y);
            }
        }
    }

    #[test]
    fn a_chart_without_area_still_gets_unit_tangents() {
        let (mesh, mut atlas) = square(false);
        atlas.uvs = vec![Vec2::splat(0.5); 4];
        for tangent in tangents(&mesh, &atlas).unwrap().into_iter().flatten() {
            assert!((tangent.truncate().length() - 1.0).abs() < 1e-6 && tangent.w.abs() == 1.0);
            assert!(tangent.truncate().dot(Vec3::Z).abs() < 1e-6);
        }
    }

    #[test]
    fn a_mesh_without_normals_has_no_tangents() {
        let (mut mesh, atlas) = square(false);
        mesh.normals.clear();
        assert_eq!(tangents(&mesh, &atlas).unwrap_err().to_string(), "0 normals for 4 vertices");
    }
}

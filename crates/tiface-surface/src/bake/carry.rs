//! What a mesh shows, carried over to a simpler mesh of the same surface.
//!
//! A point of the simpler mesh takes what lies at the nearest point of the original: a vertex its
//! normal, color and soft layers; a texel the texture, with colors averaged in linear light, lobes
//! in their own values and normals as vectors.

use super::cover::Bands;
use super::seams::Seams;
use super::trust::seen_at;
use super::{Texels, on_triangles};
use crate::files::{HeadMesh, HeadTexture, tangents};
use crate::mesh_distance::hit_at;
use glam::{Vec2, Vec3, Vec4};
use rayon::prelude::*;
use tiface_base::geom::{Atlas, Bvh, Hit, Mesh, ShellLayer, Shells, bilinear_taps};
use tiface_base::image::{Image, Photo, linear_from_srgb};
use tiface_base::{Monitor, Result};

/// A head mesh that a simpler one is made from.
pub struct Original<'a> {
    head: &'a HeadMesh,
    bvh: Bvh,
}

/// The pictures of a texture that was carried over; each has the size of the new atlas.
pub struct CarriedTexture {
    /// Linear color, 3 channels.
    pub color: Image,
    /// Lobes, 3 channels each, sRGB-coded differences; one picture a function.
    pub lobes: Vec<Image>,
    /// Unit normals of the original in the mesh's coordinates, 3 channels, if it has a normal map.
    pub normal: Option<Image>,
}

impl<'a> Original<'a> {
    /// Prepares a head mesh for look-ups.
    pub fn new(head: &'a HeadMesh) -> Original<'a> {
        Original { head, bvh: Bvh::new(&head.mesh) }
    }

    /// Gives the vertices of a simpler mesh the original's normals and colors and the number of
    /// cameras that see them, and returns its soft layers on them.
    pub fn carry_vertices(&self, mesh: &mut Mesh) -> Option<Shells> {
        let HeadMesh { mesh: from, shells, .. } = self.head;
        let hits = self.nearest(&mesh.positions);
        if !from.normals.is_empty() {
            mesh.normals = hits.iter().map(|hit| from.shading_normal(hit)).collect();
        }
        if !from.colors.is_empty() {
            mesh.colors = hits.iter().map(|hit| from.color_at(hit)).collect();
        }
        if !from.seen_by.is_empty() {
            mesh.seen_by = hits.iter().map(|hit| seen_at(from, hit)).collect();
        }
        let at = |values: &[f32], hit: &Hit| {
            hit.mix(from.triangles[hit.triangle as usize].map(|v| values[v as usize]))
        };
        let layer = |layer: &ShellLayer| ShellLayer {
            offsets: hits.iter().map(|hit| at(&layer.offsets, hit)).collect(),
            // rounding must not leave the range
            alphas: hits.iter().map(|hit| at(&layer.alphas, hit).clamp(0.0, 1.0)).collect(),
        };
        let Shells { layers, depths } = shells.as_ref()?;
        let depths =
            if depths.is_empty() { Vec::new() } else { hits.iter().map(|hit| at(depths, hit)).collect() };
        Some(Shells { layers: layers.iter().map(layer).collect(), depths })
    }

    /// Carries the original's `texture` over to a simpler mesh that is laid out by `atlas`. `side`
    /// and `gutter_px` are those of [`super::BakeConfig`].
    ///
    /// # Errors
    ///
    /// Fails if the original has a normal map but no tangents, or on a request to stop.
    pub fn carry_texture(
        &self,
        texture: &HeadTexture,
        mesh: &Mesh,
        atlas: &Atlas,
        side: u32,
        gutter_px: u32,
        monitor: &dyn Monitor,
    ) -> Result<CarriedTexture> {
        let lobes = texture.lobes.as_ref().map_or(&[][..], |lobes| &lobes.pictures);
        let steps: Vec<f32> =
            texture.lobes.iter().flat_map(|l| &l.scale).map(|scale| scale / 127.0).collect();
        let linear: Vec<f32> = (0..=255).map(|byte| linear_from_srgb(byte as f32 / 255.0)).collect();
        let bumps = texture.normal.as_ref().map(|normal| {
            tangents(&self.head.mesh, &texture.atlas).map(|tangents| NormalMap { normal, tangents })
        });
        let bumps = bumps.transpose()?;
        let mut texels = Texels::new(atlas, lobes.len(), bumps.is_some());
        let bands = Bands::new(atlas, side);
        for band in 0..bands.len() {
            monitor.check_stop()?;
            let samples = bands.samples(atlas, band, side);
            let hits = self.nearest(&on_triangles(mesh, &samples).positions);
            let mut i = 0;
            for texel in samples.chunk_by(|a, b| a.texel == b.texel) {
                let at = 3 * texel[0].texel as usize;
                texels.covered[at / 3] = true;
                let own = &hits[i..i + texel.len()];
                i += texel.len();
                let mean = |value: &dyn Fn(&Hit) -> Vec3| {
                    (own.iter().map(value).sum::<Vec3>() / own.len() as f32).to_array()
                };
                let look_up = |photo: &Photo, hit: &Hit, value: &dyn Fn(u8) -> f32| {
                    let uv = hit.mix(
                        texture.atlas.triangles[hit.triangle as usize].map(|c| texture.atlas.uvs[c as usize]),
                    );
                    bilinear(photo, uv, value)
                };
                let color = mean(&|hit| look_up(&texture.color, hit, &|byte| linear[byte as usize]));
                texels.color.data[at..at + 3].copy_from_slice(&color);
                for (k, lobe) in lobes.iter().enumerate() {
                    let value = mean(&|hit| look_up(lobe, hit, &|byte| (f32::from(byte) - 128.0) * steps[k]));
                    texels.lobes[k].data[at..at + 3].copy_from_slice(&value);
                }
                if let (Some(bumps), Some(normals)) = (&bumps, &mut texels.normal) {
                    let bump =
                        |hit: &Hit| look_up(bumps.normal, hit, &|byte| (f32::from(byte) - 128.0) / 127.5);
                    let n = Vec3::from(mean(&|hit| bumps.bent(&self.head.mesh, hit, bump(hit))));
                    let n = n.try_normalize().unwrap_or_else(|| self.head.mesh.shading_normal(&own[0]));
                    normals.data[at..at + 3].copy_from_slice(&n.to_array());
                }
            }
            monitor.step(band as u64 + 1, bands.len() as u64, &[]);
        }
        texels.fill(&Seams::new(mesh, atlas), gutter_px);
        let Texels { color, lobes, normal, .. } = texels;
        Ok(CarriedTexture { color, lobes, normal })
    }

    /// Returns the nearest points of the original. `[n]` → `[n]`.
    fn nearest(&self, points: &[Vec3]) -> Vec<Hit> {
        let mesh = &self.head.mesh;
        let one = |point: &Vec3| match self.bvh.closest_point(*point) {
            Some(found) => hit_at(mesh, found.triangle, found.point),
            None => Hit { t: 0.0, triangle: 0, u: 0.0, v: 0.0 },
        };
        points.par_iter().with_min_len(64).map(one).collect()
    }
}

/// A normal map with the tangents that it was made for.
struct NormalMap<'a> {
    normal: &'a Photo,
    tangents: Vec<[Vec4; 3]>,
}

impl NormalMap<'_> {
    /// Returns a normal of the map at a point of the mesh, in the mesh's coordinates; the opposite
    /// of [`super::tangent_space()`].
    fn bent(&self, mesh: &Mesh, hit: &Hit, local: Vec3) -> Vec3 {
        let m = mesh.shading_normal(hit);
        let corners = self.tangents[hit.triangle as usize];
        let t = hit.mix(corners.map(Vec4::truncate));
        let t = (t - m * m.dot(t)).normalize_or(m.any_orthonormal_vector());
        local.x * t + local.y * corners[0].w * m.cross(t) + local.z * m
    }
}

/// Returns the values of a picture at texture coordinates, interpolated bilinearly.
pub(crate) fn bilinear(photo: &Photo, uv: Vec2, value: &dyn Fn(u8) -> f32) -> Vec3 {
    let size = Vec2::new(photo.width as f32, photo.height as f32);
    let taps = bilinear_taps(uv * size - 0.5, [photo.width, photo.height]);
    taps.into_iter().map(|(texel, w)| w * Vec3::from(photo.rgb[texel as usize].map(value))).sum()
}

#[cfg(test)]
mod tests {
    use super::super::fill::fill;
    use super::super::testing::{ball, shown};
    use super::*;
    use crate::{AtlasConfig, SimplifyConfig, atlas, simplify};
    use tiface_base::Quiet;
    use tiface_base::image::srgb_from_linear;

    #[test]
    fn a_simpler_ball_shows_what_the_original_shows_at_the_same_places() {
        let head = ball();
        let mut mesh = head.mesh.clone();
        let config = SimplifyConfig { triangles: 1000, ..SimplifyConfig::default() };
        simplify(&mut mesh, None, &config, &Quiet).unwrap();
        assert!(mesh.triangles.len() <= 1000 && mesh.is_closed());
        let original = Original::new(&head);
        let shells = original.carry_vertices(&mut mesh).unwrap();
        for (v, p) in mesh.positions.iter().enumerate() {
            let n = mesh.normals[v];
            assert!(n.dot(p.normalize()) > 0.999, "{p} {n}");
            // the simplified surface lies a little inside or outside
            assert!((Vec3::from(mesh.colors[v]) - Vec3::from(shown(*p))).abs().max_element() < 0.01);
            let layer = &shells.layers[0];
            assert!((layer.offsets[v] - 0.1 * p.x).abs() < 0.02, "{p} {}", layer.offsets[v]);
            assert!((shells.depths[v] - 0.2 - 0.01 * p.x).abs() < 0.002, "{p} {}", shells.depths[v]);
            let alpha = if p.y > 0.0 { 1.0 } else { 0.0 };
            assert!(p.y.abs() < 1.5 || (layer.alphas[v] - alpha).abs() < 1e-6, "{p} {}", layer.alphas[v]);
        }
        let config = AtlasConfig { size_px: 256, gutter_px: 4, ..AtlasConfig::default() };
        let layout = atlas(&mesh, &config, &Quiet).unwrap().0;
        let texture = head.texture.as_ref().unwrap();
        let carried = original.carry_texture(texture, &mesh, &layout, 2, 4, &Quiet).unwrap();
        assert!(carried.normal.is_none() && carried.lobes.len() == 1);
        let bands = Bands::new(&layout, 1);
        let (mut off, mut lobe_off, mut count) = (0, 0, 0);
        for sample in (0..bands.len()).flat_map(|band| bands.samples(&layout, band, 1)) {
            let (at, p) = (3 * sample.texel as usize, mesh.point_at(&sample.hit()));
            for (k, color) in shown(p).into_iter().enumerate() {
                count += 1;
                off += usize::from((srgb_from_linear(carried.color.data[at + k]) - color).abs() > 0.03);
                // a byte b stands for (b − 128) · 0.254 / 127 = (b − 128) · 0.002
                let lobe = (255.0 * color - 128.0) * 0.002;
                lobe_off += usize::from((carried.lobes[0].data[at + k] - lobe).abs() > 0.015);
            }
        }
        // a texel is 0.2 wide, and the chords of the simpler ball lie up to 0.2 inside: 0.03 · 0.4
        // at the borders of charts texels of both sides mix
        assert!(off * 10 < count && lobe_off * 10 < count, "{off} and {lobe_off} of {count}");
    }

    #[test]
    fn a_normal_map_is_read_as_it_was_written() {
        let mut head = ball();
        let texture = head.texture.as_mut().unwrap();
        let (width, height) = (texture.atlas.width, texture.atlas.height);
        // a field whose normals lean towards +x
        let lean = |p: Vec3| (p.normalize() + 0.3 * Vec3::X).normalize();
        let mut normals = Image::new(width, height, 3);
        let bands = Bands::new(&texture.atlas, 1);
        let mut covered = vec![false; (width * height) as usize];
        for s in (0..bands.len()).flat_map(|band| bands.samples(&texture.atlas, band, 1)) {
            let at = 3 * s.texel as usize;
            covered[at / 3] = true;
            normals.data[at..at + 3].copy_from_slice(&lean(head.mesh.point_at(&s.hit())).to_array());
        }
        fill(&mut normals, &covered, 4);
        let tangents = tangents(&head.mesh, &texture.atlas).unwrap();
        let map = super::super::tangent_space(&head.mesh, &texture.atlas, &tangents, &normals, 4);
        texture.normal = Some(map);
        let texture = head.texture.as_ref().unwrap();
        let same = Original::new(&head);
        let carried = same.carry_texture(texture, &head.mesh, &texture.atlas, 1, 4, &Quiet).unwrap();
        let found = carried.normal.unwrap();
        let mut off = 0;
        for (i, _) in covered.iter().enumerate().filter(|(_, c)| **c) {
            let [is, was] = [&found, &normals].map(|n| Vec3::from_slice(&n.data[3 * i..3 * i + 3]));
            // 8 bits a channel are a hundredth; at the borders of charts texels mix
            off += usize::from(is.dot(was) < 0.999);
        }
        assert!(off * 20 < covered.iter().filter(|c| **c).count(), "{off}");
    }
}

//! Colors from a texture: mip-mapped, filtered in linear light, with lobes for what depends on the view.
//!
//! A level has half the texels of the one before, rounded down, each the mean of the part of the picture that it
//! covers: of three texels by their share where the number is odd (Guthe and Heckbert, *Non-power-of-two
//! mipmapping*, 2005), so that no level is shifted against another.

use super::raycast::RayHits;
use crate::geom::{Atlas, Camera, Mesh};
use crate::image::{Photo, linear_from_srgb, srgb_from_linear};
use crate::kernel::sphharm;
use glam::{Mat3, Vec2};
use std::sync::OnceLock;

/// View-dependent color beside a base color: one picture per spherical-harmonic function, in the order of
/// [`sphharm::sh16`]. A byte `b` of picture `k` stands for the sRGB-coded difference `(b − 128) / 127 · scale[k]`.
pub struct LobePictures<'a> {
    /// Pictures of the atlas's size.
    pub pictures: &'a [Photo],
    /// Scale of each.
    pub scale: &'a [f32],
    /// Turns directions of the mesh's coordinates into those of the harmonics.
    pub turned: Mat3,
}

/// A texture ready to be looked up.
pub struct MeshTexture<'a> {
    atlas: &'a Atlas,
    /// Linear color and then the lobes, level by level; interleaved channels.
    levels: Vec<MipLevel>,
    channels: usize,
    /// Do coordinates leave the picture? It is then repeated.
    repeats: bool,
    turned: Mat3,
    /// Texels per unit of length, per triangle.
    density: Vec<f32>,
}

/// The level for so many texels a pixel, and how far it is on the way to the next: the base-2 logarithm, its fraction by
/// the chord's parabola (off by 0.009).
fn mip_level(texels: f32, levels: usize) -> (usize, f32) {
    let bits = texels.max(1.0).to_bits();
    let (level, m) = ((bits >> 23) as usize - 127, f32::from_bits(bits & 0x7f_ffff | 0x3f80_0000) - 1.0);
    if level + 1 < levels { (level, m + 0.34 * m * (1.0 - m)) } else { (levels - 1, 0.0) }
}

/// Steps of [`srgb_table`]: straight lines between them are off by 2e-5 at most.
const SRGB_STEPS: usize = 4096;

/// sRGB-coded from linear, by [`srgb_table`].
#[inline(always)]
fn coded(table: &[f32; SRGB_STEPS + 1], linear: f32) -> f32 {
    let at = linear.clamp(0.0, 1.0) * (SRGB_STEPS as f32 - 1.0);
    let k = at as usize;
    table[k] + (at - k as f32) * (table[k + 1] - table[k])
}

/// sRGB-coded from linear, and the last value once more.
fn srgb_table() -> &'static [f32; SRGB_STEPS + 1] {
    static TABLE: OnceLock<Box<[f32; SRGB_STEPS + 1]>> = OnceLock::new();
    TABLE.get_or_init(|| {
        let value = |i: usize| srgb_from_linear(i.min(SRGB_STEPS - 1) as f32 / (SRGB_STEPS - 1) as f32);
        Box::new(std::array::from_fn(value))
    })
}

struct MipLevel {
    width: usize,
    height: usize,
    data: Vec<f32>,
}

impl<'a> MeshTexture<'a> {
    /// Prepares the pictures of a mesh; `color` and the lobes have one size of the atlas's shape.
    pub fn new(
        mesh: &Mesh,
        atlas: &'a Atlas,
        color: &Photo,
        lobes: Option<&LobePictures>,
    ) -> MeshTexture<'a> {
        let table: [f32; 256] = std::array::from_fn(|i| linear_from_srgb(i as f32 / 255.0));
        let pictures = lobes.map_or(&[][..], |l| l.pictures);
        // filled up, so that a texel is whole vectors
        let channels = (3 + 3 * pictures.len()).next_multiple_of(4);
        let mut data = Vec::with_capacity(color.rgb.len() * channels);
        for (i, c) in color.rgb.iter().enumerate() {
            data.extend(c.map(|b| table[b as usize]));
            for (k, picture) in pictures.iter().enumerate() {
                let scale = lobes.map_or(0.0, |l| l.scale[k]) / 127.0;
                data.extend(picture.rgb[i].map(|b| (f32::from(b) - 128.0) * scale));
            }
            data.resize((i + 1) * channels, 0.0);
        }
        let mut levels = vec![MipLevel { width: color.width as usize, height: color.height as usize, data }];
        while levels[levels.len() - 1].width.min(levels[levels.len() - 1].height) > 1 {
            levels.push(levels[levels.len() - 1].halved(channels));
        }
        let density = (0..mesh.triangles.len() as u32)
            .map(|t| {
                let [a, b, c] = mesh.corners(t);
                let [p, q, r] = atlas.corners(t);
                let (space, texels) = ((b - a).cross(c - a).length(), (q - p).perp_dot(r - p).abs());
                if space > 0.0 { (texels / space).sqrt() } else { 0.0 }
            })
            .collect();
        let inside = |uv: &Vec2| uv.cmpge(Vec2::ZERO).all() && uv.cmple(Vec2::ONE).all();
        let repeats = !atlas.uvs.iter().all(inside);
        MeshTexture {
            atlas,
            levels,
            channels,
            repeats,
            turned: lobes.map_or(Mat3::IDENTITY, |l| l.turned),
            density,
        }
    }

    /// Returns the sRGB-coded colors of what is seen through the pixels of a camera, between two levels (trilinear).
    pub fn smooth_colors(&self, hits: &RayHits, camera: &Camera) -> Vec<[f32; 3]> {
        let (forward, per_pixel) = (camera.forward(), 1.0 / camera.fx.abs() as f32);
        let table = srgb_table(); // asked for once
        let mut values = vec![0f32; 2 * self.channels];
        let mut one = |i: usize| {
            let hit = &hits.hits[i];
            let corners = self.atlas.triangles[hit.triangle as usize].map(|c| self.atlas.uvs[c as usize]);
            let mut uv = (1.0 - hit.u - hit.v) * corners[0] + hit.u * corners[1] + hit.v * corners[2];
            if self.repeats {
                uv -= uv.floor();
            }
            let footprint = hit.t * hits.directions[i].dot(forward) * per_pixel;
            let texels = footprint * self.density[hit.triangle as usize];
            let (fine, share) = mip_level(texels, self.levels.len());
            let coarse = (fine + 1).min(self.levels.len() - 1);
            if self.channels == 4 {
                // as many channels as the compiler knows of
                let (mut a, mut b) = ([0f32; 4], [0f32; 4]);
                self.levels[fine].look_up(uv, &mut a);
                self.levels[coarse].look_up(uv, &mut b);
                return std::array::from_fn(|k| coded(table, a[k] + share * (b[k] - a[k])));
            }
            let (a, b) = values.split_at_mut(self.channels);
            self.levels[fine].look_up(uv, a);
            self.levels[coarse].look_up(uv, b);
            a.iter_mut().zip(b).for_each(|(a, b)| *a += share * (*b - *a));
            let more = sphharm::combine(a[3..].as_chunks().0, (self.turned * -hits.directions[i]).to_array());
            std::array::from_fn(|k| (coded(table, a[k]) + more[k]).clamp(0.0, 1.0))
        };
        (0..hits.hits.len()).map(&mut one).collect()
    }

    /// Returns the sRGB-coded colors of what rays of a camera met, `samples` of them along each side of a pixel.
    pub fn colors(&self, hits: &RayHits, camera: &Camera, samples: u32) -> Vec<[f32; 3]> {
        let forward = camera.forward();
        let mut values = vec![0f32; self.channels];
        let one = |(i, hit): (usize, &crate::geom::Hit)| {
            let corners = self.atlas.triangles[hit.triangle as usize].map(|c| self.atlas.uvs[c as usize]);
            let uv = (1.0 - hit.u - hit.v) * corners[0] + hit.u * corners[1] + hit.v * corners[2];
            // a ray's share of a pixel on a plane across the view; slanted surfaces stay sharp rather than blur
            let footprint =
                hit.t * hits.directions[i].dot(forward) / (camera.fx.abs() as f32 * samples as f32);
            let texels = footprint * self.density[hit.triangle as usize];
            let level = texels.max(1.0).log2().round().clamp(0.0, (self.levels.len() - 1) as f32);
            self.levels[level as usize].look_up(uv, &mut values);
            let base: [f32; 3] = std::array::from_fn(|k| srgb_from_linear(values[k]));
            if self.channels == 4 {
                return base;
            }
            let d = self.turned * -hits.directions[i];
            let lobes = values[3..].as_chunks::<3>().0;
            let more = sphharm::combine(lobes, d.to_array());
            std::array::from_fn(|k| (base[k] + more[k]).clamp(0.0, 1.0))
        };
        hits.hits.iter().enumerate().map(one).collect()
    }
}

impl MipLevel {
    /// Half the texels each way.
    fn halved(&self, channels: usize) -> MipLevel {
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let (across, down) = (shares(self.width, width), shares(self.height, height));
        let mut data = vec![0f32; width * height * channels];
        for (texel, out) in data.chunks_exact_mut(channels).enumerate() {
            for &(y, wy) in &down[texel / width] {
                for &(x, wx) in across[texel % width].iter().filter(|(_, wx)| wx * wy > 0.0) {
                    let own = &self.data[(y * self.width + x) * channels..][..channels];
                    out.iter_mut().zip(own).for_each(|(sum, v)| *sum += wx * wy * v);
                }
            }
        }
        MipLevel { width, height, data }
    }

    /// Bilinear, clamped at the borders.
    #[inline(always)]
    fn look_up(&self, uv: Vec2, out: &mut [f32]) {
        let at = |u: f32, n: usize| {
            let p = (u * n as f32 - 0.5).clamp(0.0, (n - 1) as f32);
            (p as usize, (p as usize + 1).min(n - 1), p - p as usize as f32)
        };
        let (x0, x1, fx) = at(uv.x, self.width);
        let (y0, y1, fy) = at(uv.y, self.height);
        let channels = out.len();
        let texel = |x: usize, y: usize| &self.data[(y * self.width + x) * channels..][..channels];
        let (a, b, c, d) = (texel(x0, y0), texel(x1, y0), texel(x0, y1), texel(x1, y1));
        for k in 0..channels {
            let (top, bottom) = (a[k] + fx * (b[k] - a[k]), c[k] + fx * (d[k] - c[k]));
            out[k] = top + fy * (bottom - top);
        }
    }
}

/// The texels under each of `n` equal parts of a row of `from`, which has two to three a part, with their shares.
fn shares(from: usize, n: usize) -> Vec<[(usize, f32); 3]> {
    let part = |i: usize| {
        let first = i * from / n;
        // in n-ths of a texel
        std::array::from_fn(|k| {
            let texel = first + k;
            let (low, high) = ((texel * n).max(i * from), ((texel + 1) * n).min((i + 1) * from));
            (texel.min(from - 1), high.saturating_sub(low) as f32 / from as f32)
        })
    };
    (0..n).map(part).collect()
}

#[cfg(test)]
mod tests {
    use super::super::raster::{RasterOptions, raster};
    use super::super::raycast::{RaycastOptions, raycast};
    use super::*;
    use crate::geom::Bvh;
    use glam::Vec3;

    /// A square from −1 to 1 at z = 0, its texture 4 × 4 from red (left) to green (right).
    fn square() -> (Mesh, Atlas, Photo) {
        let at = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
        let mesh = Mesh {
            positions: at.map(|(x, y)| Vec3::new(x, y, 0.0)).to_vec(),
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        };
        // v runs down: the lower edge of the square is the lower row of the picture
        let uvs = at.map(|(x, y)| Vec2::new(0.5 + 0.5 * x, 0.5 - 0.5 * y)).to_vec();
        let atlas = Atlas { uvs, triangles: mesh.triangles.clone(), width: 4, height: 4 };
        let rgb =
            (0..16).map(|i| if i % 4 < 2 { [255, 0, (i / 4 * 60) as u8] } else { [0, 255, 0] }).collect();
        (mesh, atlas, Photo { width: 4, height: 4, rgb, alpha: None })
    }

    fn view(texture: &MeshTexture, mesh: &Mesh, camera: &Camera, samples: u32) -> Vec<[f32; 4]> {
        let bvh = Bvh::new(mesh);
        let options = RaycastOptions { samples, ..RaycastOptions::default() };
        let seen = raycast(&bvh, mesh, None, camera, &options, |s| texture.colors(s, camera, samples));
        seen.color.data.as_chunks::<4>().0.to_vec()
    }

    #[test]
    fn texels_appear_where_they_lie() {
        let (mesh, atlas, photo) = square();
        let texture = MeshTexture::new(&mesh, &atlas, &photo, None);
        // 8 × 8 pixels over the square: focal 8 at distance 2 shows 2 units
        let pixels = view(&texture, &mesh, &Camera::above(8, 8, 8.0, 2.0), 2);
        let near = |p: [f32; 4], c: [f32; 4]| p.iter().zip(c).all(|(a, b)| (a - b).abs() < 1e-4);
        assert!(near(pixels[0], [1.0, 0.0, 0.0, 1.0]) && near(pixels[7], [0.0, 1.0, 0.0, 1.0]));
        // the last row's left texel is 180 / 255 blue
        assert!((pixels[56][2] - 180.0 / 255.0).abs() < 1e-3, "{:?}", pixels[56]);
    }

    #[test]
    fn levels_of_any_size_lie_where_the_picture_lies() {
        let row = |data: &[f32]| MipLevel { width: data.len(), height: 1, data: data.to_vec() };
        // five texels in halves of 2.5: (1 + 2 + 0.5 · 4) / 2.5 and (0.5 · 4 + 8 + 16) / 2.5
        let half = row(&[1.0, 2.0, 4.0, 8.0, 16.0]).halved(1);
        assert_eq!((half.width, half.height), (2, 1));
        assert!((half.data[0] - 2.0).abs() < 1e-6 && (half.data[1] - 10.4).abs() < 1e-6, "{:?}", half.data);
        assert_eq!(row(&[3.0, 6.0, 0.0]).halved(1).data, [3.0]);
        assert_eq!(row(&[1.0, 3.0, 5.0, 9.0]).halved(1).data, [2.0, 7.0]);
        // a bright spot keeps its place and its light on every level: 23 by 37 texels, the spot at (5, 30)
        let (width, height) = (23, 37);
        let mut level = MipLevel { width, height, data: vec![0.0; width * height] };
        level.data[30 * width + 5] = 1.0;
        while level.width.min(level.height) > 1 {
            level = level.halved(1);
            let (w, h) = (level.width as f32, level.height as f32);
            let mut sums = [0f32; 3];
            for (i, v) in level.data.iter().enumerate() {
                let at = [(i % level.width) as f32 + 0.5, (i / level.width) as f32 + 0.5];
                [1.0, at[0] / w, at[1] / h].iter().zip(&mut sums).for_each(|(x, sum)| *sum += x * v);
            }
            assert!((sums[0] / (w * h) * 851.0 - 1.0).abs() < 1e-4, "{w} {h}");
            // within half a texel of the level
            assert!((sums[1] / sums[0] - 5.5 / 23.0).abs() < 0.5 / w, "{w}: {}", sums[1] / sums[0]);
            assert!((sums[2] / sums[0] - 30.5 / 37.0).abs() < 0.5 / h, "{h}: {}", sums[2] / sums[0]);
        }
    }

    #[test]
    fn from_afar_the_mean_of_the_light_is_seen() {
        let (mesh, atlas, mut photo) = square();
        photo.rgb.iter_mut().enumerate().for_each(|(i, c)| *c = [255 * ((i + i / 4) % 2) as u8; 3]);
        let texture = MeshTexture::new(&mesh, &atlas, &photo, None);
        // 2 pixels over the square: every pixel is the mean of 2 × 2 texels, linear 0.5, coded 0.735
        for p in view(&texture, &mesh, &Camera::above(2, 2, 2.0, 2.0), 1) {
            assert!((p[0] - srgb_from_linear(0.5)).abs() < 1e-3, "{p:?}");
        }
    }

    #[test]
    fn lobes_change_with_the_direction_of_view() {
        let (mesh, atlas, mut photo) = square();
        photo.rgb.fill([128; 3]);
        let flat = |b: u8| Photo { rgb: vec![[b, 128, 128]; 16], ..photo.clone() };
        // −0.4886 x is the fourth function: 255 stands for its scale
        let pictures = [flat(128), flat(128), flat(128), flat(255)];
        let scale = [0.1, 0.1, 0.1, 0.2];
        let lobes = LobePictures { pictures: &pictures, scale: &scale, turned: Mat3::IDENTITY };
        let texture = MeshTexture::new(&mesh, &atlas, &photo, Some(&lobes));
        let pixels = view(&texture, &mesh, &Camera::above(9, 9, 9.0, 2.0), 1);
        let middle = pixels[40];
        assert!((middle[0] - 128.0 / 255.0).abs() < 1e-3);
        // the leftmost pixel is seen from the right: its direction to the viewer has x = 0.889 / √(4 + 0.79)
        let x = 8.0 / 9.0 / (4.0f32 + 64.0 / 81.0).sqrt();
        assert!((pixels[36][0] - (128.0 / 255.0 - 0.2 * 0.4886 * x)).abs() < 1e-3, "{:?}", pixels[36]);
        assert!((pixels[36][1] - 128.0 / 255.0).abs() < 1e-3);
    }

    #[test]
    fn between_two_levels_both_are_seen() {
        let (mesh, atlas, mut photo) = square();
        photo.rgb.iter_mut().enumerate().for_each(|(i, c)| *c = [255 * ((i + i / 4) % 2) as u8; 3]);
        let texture = MeshTexture::new(&mesh, &atlas, &photo, None);
        let seen = |texture: &MeshTexture, side: u32| {
            let camera = Camera::above(side, side, f64::from(side), 2.0);
            let options = RasterOptions::default();
            let seen = raster(&mesh, &camera, &options, |hits| texture.smooth_colors(hits, &camera));
            seen.view.color.data.as_chunks::<4>().0.to_vec()
        };
        // four texels on two pixels: the level of means, linear 0.5
        assert!(seen(&texture, 2).iter().all(|p| (p[0] - srgb_from_linear(0.5)).abs() < 1e-3));
        // as many pixels as texels: the texels themselves
        let each = seen(&texture, 4);
        assert!(each.iter().enumerate().all(|(i, p)| (p[0] - ((i + i / 4) % 2) as f32).abs() < 1e-3));
        // a texture that is used outside of its picture is repeated: shifted by a whole picture it is the same
        let shifted =
            Atlas { uvs: atlas.uvs.iter().map(|uv| uv + Vec2::new(3.0, -2.0)).collect(), ..atlas.clone() };
        let again = seen(&MeshTexture::new(&mesh, &shifted, &photo, None), 4);
        assert!(again.iter().zip(&each).all(|(a, b)| (a[0] - b[0]).abs() < 1e-3));
    }

    #[test]
    fn levels_follow_the_logarithm() {
        for texels in [0.3f32, 1.0, 1.2, 1.5, 2.0, 3.1, 7.9, 16.0] {
            let (level, share) = mip_level(texels, 10);
            assert!((level as f32 + share - texels.max(1.0).log2()).abs() < 0.01, "{texels}");
        }
        assert_eq!(mip_level(1e9, 4), (3, 0.0));
        let coded: f32 = (0..=1000)
            .map(|i| i as f32 / 1000.0)
            .map(|v| (coded(srgb_table(), v) - srgb_from_linear(v)).abs())
            .fold(0.0, f32::max);
        assert!(coded < 5e-5, "{coded}");
    }
}

//! Texture lookup: mip-mapped, filtered in linear light, with lobes for view-dependent color.
//!
//! A level has half the texels of the one before, rounded down, each the mean of the part of the
//! picture that it covers: of three texels by their share where the number is odd (Guthe and
//! Heckbert, *Non-power-of-two mipmapping*, 2005), so that no level is shifted against another.
//!
//! Texels are 16-bit integers, half as large as floats and finer than any 8-bit picture: they are
//! decoded once per lookup, after filtering. Lobes have mip maps of their own, for they are coarser
//! than the color.

use super::hits::RayHits;
use crate::files::Lobes;
use glam::{Mat3, Vec2, Vec3, Vec4};
use rayon::prelude::*;
use std::array::from_fn;
use std::sync::OnceLock;
use tiface_base::geom::sphharm;
use tiface_base::geom::{Atlas, Camera, Hit, Mesh};
use tiface_base::image::{Photo, linear_from_srgb, srgb_from_linear};

/// A texture prepared for lookups.
pub struct MeshTexture {
    /// Linear color.
    base: MipMaps,
    lobes: Option<LobeTexture>,
    /// Whether coordinates leave the picture, which is then repeated.
    repeats: bool,
    triangles: Vec<TexturedTriangle>,
}

/// The lobes of a texture.
struct LobeTexture {
    maps: MipMaps,
    /// Texels along a side of the base color to one of the lobes'.
    coarser: f32,
    /// Scale and offset of each channel.
    scale: Vec<Vec4>,
    offset: Vec<Vec4>,
    turned: Mat3,
}

/// Pictures of one size at all mip levels.
struct MipMaps {
    /// `[levels, height, width, groups]`
    texels: Vec<Texel>,
    levels: Vec<MipLevel>,
    /// Groups of four channels a texel.
    groups: usize,
}

/// The texture coordinates of a triangle.
#[derive(Clone, Copy)]
struct TexturedTriangle {
    /// The first corner, and the vectors from it to the others.
    first: Vec2,
    right: Vec2,
    down: Vec2,
    /// Texels of the base color per unit of length.
    density: f32,
}

/// Four channels of a texel.
type Texel = [u16; 4];

/// Steps of a base color's channel from 0 to 1.
const STEPS: f32 = 65535.0;

/// Steps of a lobe's channel between two bytes.
const LOBE_STEPS: u16 = 257;

/// A mip level of a texture.
#[derive(Clone, Copy)]
struct MipLevel {
    /// Index of its first texel among those of all levels.
    first: u32,
    width: f32,
    height: f32,
}

/// Number of hits whose texels are fetched together.
const LANES: usize = 8;

/// Returns the level for this many texels a pixel, and how far it is on the way to the next: the
/// base-2 logarithm, its fraction by the chord's parabola (off by 0.009).
#[inline(always)]
fn mip_level(texels: f32, levels: usize) -> (usize, f32) {
    let bits = texels.max(1.0).to_bits();
    let (level, m) = ((bits >> 23) - 127, f32::from_bits(bits & 0x7f_ffff | 0x3f80_0000) - 1.0);
    let last = levels as u32 - 1;
    (level.min(last) as usize, if level < last { m + 0.34 * m * (1.0 - m) } else { 0.0 })
}

/// Steps of [`srgb_table`]: straight lines between them are off by 2e-5 at most.
const SRGB_STEPS: usize = 4096;

/// sRGB-coded from linear, by [`srgb_table`].
// `clamp` would keep NaN
#[allow(clippy::manual_clamp)]
#[inline(always)]
fn coded(table: &[f32; SRGB_STEPS + 1], linear: f32) -> f32 {
    let at = linear.max(0.0).min(1.0) * (SRGB_STEPS as f32 - 1.0);
    let k = whole(at);
    let (low, high) = (table[k as usize & (SRGB_STEPS - 1)], table[(k as usize & (SRGB_STEPS - 1)) + 1]);
    low + (at - k as i32 as f32) * (high - low)
}

/// Table of sRGB-coded values of linear ones, with the last value repeated.
fn srgb_table() -> &'static [f32; SRGB_STEPS + 1] {
    static TABLE: OnceLock<Box<[f32; SRGB_STEPS + 1]>> = OnceLock::new();
    TABLE.get_or_init(|| {
        let value = |i: usize| srgb_from_linear(i.min(SRGB_STEPS - 1) as f32 / (SRGB_STEPS - 1) as f32);
        Box::new(from_fn(value))
    })
}

impl MipMaps {
    /// Returns all levels of pictures of this size; `fill` gives each texel of the finest its
    /// channels, `[4 · groups]`.
    fn new([width, height]: [u32; 2], groups: usize, fill: impl Fn(usize, &mut [u16]) + Sync) -> MipMaps {
        let (mut width, mut height) = (width as usize, height as usize);
        let mut texels: Vec<Texel> =
            Vec::with_capacity((width * height / 3 * 4 + 2 * (width + height)) * groups);
        texels.resize(width * height * groups, [0; 4]);
        let each = texels.par_chunks_exact_mut(groups).enumerate();
        each.for_each(|(i, texel)| fill(i, texel.as_flattened_mut()));
        let level = |first: usize, width: usize, height: usize| MipLevel {
            first: (first / groups) as u32,
            width: width as f32,
            height: height as f32,
        };
        let (mut levels, mut first) = (vec![level(0, width, height)], 0);
        while width.min(height) > 1 {
            let half = halved(&texels[first..], [width, height], groups);
            first = texels.len();
            texels.extend(half);
            (width, height) = (width / 2, height / 2);
            levels.push(level(first, width, height));
        }
        MipMaps { texels, levels, groups }
    }

    /// Returns the level whose texels are nearest in size to a footprint of this many of the
    /// finest: the base-2 logarithm, rounded.
    fn nearest(&self, texels: f32) -> &MipLevel {
        // half a level more, since whole levels are rounded down
        let (level, _) = mip_level(texels * std::f32::consts::SQRT_2, self.levels.len());
        &self.levels[level]
    }

    /// Interpolates a group of channels bilinearly, in integer steps.
    #[inline(always)]
    fn look_up(&self, texels: [u32; 4], way: Vec2, group: usize) -> Vec4 {
        bilinear(texels.map(|t| floats(self.texels[t as usize * self.groups + group])), way)
    }
}

impl LobeTexture {
    /// Prepares the pictures of lobes beside a base color of this width; `None` without a picture.
    fn new(lobes: &Lobes, width: u32) -> Option<LobeTexture> {
        let Lobes { pictures, scale, turned } = lobes;
        let first = pictures.first()?;
        let groups = (3 * pictures.len()).div_ceil(4); // whole vectors
        let maps = MipMaps::new([first.width, first.height], groups, |i, texel| {
            for (own, picture) in texel.as_chunks_mut::<3>().0.iter_mut().zip(pictures) {
                *own = picture.rgb[i].map(|byte| u16::from(byte) * LOBE_STEPS);
            }
        });
        let mut found = LobeTexture {
            maps,
            coarser: width as f32 / first.width as f32,
            scale: vec![Vec4::ZERO; groups],
            offset: vec![Vec4::ZERO; groups],
            turned: *turned,
        };
        for channel in 0..3 * pictures.len() {
            let step = scale[channel / 3] / 127.0;
            found.scale[channel / 4][channel % 4] = step / f32::from(LOBE_STEPS);
            found.offset[channel / 4][channel % 4] = -128.0 * step;
        }
        Some(found)
    }

    /// Adds to a color what is seen along a direction, away from the camera, where a pixel covers
    /// this many texels of the base color; `values` is memory for the channels. Lobes are smooth:
    /// the nearest level is enough.
    fn add(&self, color: &mut [f32; 3], uv: Vec2, texels: f32, direction: Vec3, values: &mut [Vec4]) {
        let (at, way) = around(self.maps.nearest(texels / self.coarser), uv.x, uv.y);
        for (g, (value, (scale, offset))) in
            values.iter_mut().zip(self.scale.iter().zip(&self.offset)).enumerate()
        {
            *value = self.maps.look_up(at, way, g) * *scale + *offset;
        }
        let lobes = bytemuck::cast_slice::<Vec4, f32>(values).as_chunks::<3>().0;
        let more = sphharm::combine(lobes, (self.turned * -direction).to_array());
        (0..3).for_each(|k| color[k] = (color[k] + more[k]).clamp(0.0, 1.0));
    }
}

impl MeshTexture {
    /// Prepares a base color and the lobes beside it; all pictures have the atlas's shape.
    pub fn new(mesh: &Mesh, atlas: &Atlas, color: &Photo, lobes: Option<&Lobes>) -> MeshTexture {
        let table: [u16; 256] = from_fn(|i| (linear_from_srgb(i as f32 / 255.0) * STEPS).round() as u16);
        let base = MipMaps::new([color.width, color.height], 1, |i, texel| {
            (0..3).for_each(|k| texel[k] = table[color.rgb[i][k] as usize]);
        });
        let size = Vec2::new(color.width as f32, color.height as f32);
        let triangle = |t: u32| {
            let [a, b, c] = mesh.corners(t);
            let [first, p, q] = atlas.triangles[t as usize].map(|i| atlas.uvs[i as usize]);
            let (right, down) = (p - first, q - first);
            let texels = (right * size).perp_dot(down * size).abs();
            let space = (b - a).cross(c - a).length();
            let density = if space > 0.0 { (texels / space).sqrt() } else { 0.0 };
            TexturedTriangle { first, right, down, density }
        };
        let inside = |uv: &Vec2| uv.cmpge(Vec2::ZERO).all() && uv.cmple(Vec2::ONE).all();
        MeshTexture {
            base,
            lobes: lobes.and_then(|lobes| LobeTexture::new(lobes, color.width)),
            repeats: !atlas.uvs.iter().all(inside),
            triangles: (0..mesh.triangles.len() as u32).map(triangle).collect(),
        }
    }

    /// Returns the sRGB-coded colors of a camera's visible hits; base colors are interpolated
    /// between two levels (trilinear).
    pub fn smooth_colors(&self, hits: &RayHits, camera: &Camera) -> Vec<[f32; 3]> {
        let mut colors = Vec::with_capacity(hits.hits.len());
        smooth(self, hits, camera, &mut colors);
        self.add_lobes(hits, camera, 1, &mut colors);
        colors
    }

    /// Returns the sRGB-coded base colors of the hits of a camera's rays, `samples` of them along
    /// each side of a pixel.
    pub fn base_colors(&self, hits: &RayHits, camera: &Camera, samples: u32) -> Vec<[f32; 3]> {
        let table = srgb_table();
        let one = |i: usize| {
            let (uv, texels) = self.footprint(hits, i, camera, samples);
            let (at, way) = around(self.base.nearest(texels), uv.x, uv.y);
            let linear = self.base.look_up(at, way, 0);
            from_fn(|k| coded(table, linear[k] / STEPS))
        };
        (0..hits.hits.len()).map(one).collect()
    }

    /// Adds the lobes to the base colors of hits, if the texture has any.
    pub fn add_lobes(&self, hits: &RayHits, camera: &Camera, samples: u32, colors: &mut [[f32; 3]]) {
        let Some(lobes) = &self.lobes else { return };
        let mut values = vec![Vec4::ZERO; lobes.maps.groups];
        for (i, color) in colors.iter_mut().enumerate() {
            let (uv, texels) = self.footprint(hits, i, camera, samples);
            lobes.add(color, uv, texels, hits.directions[i], &mut values);
        }
    }

    /// Returns the sRGB-coded colors of hits: [`MeshTexture::base_colors`] with the lobes.
    pub fn colors(&self, hits: &RayHits, camera: &Camera, samples: u32) -> Vec<[f32; 3]> {
        let mut colors = self.base_colors(hits, camera, samples);
        self.add_lobes(hits, camera, samples, &mut colors);
        colors
    }

    /// Returns the texture coordinates of a hit, and the number of texels along a side of its ray's
    /// share of a pixel: on a plane across the view, so that slanted surfaces stay sharp rather
    /// than blur.
    fn footprint(&self, hits: &RayHits, i: usize, camera: &Camera, samples: u32) -> (Vec2, f32) {
        let (uv, density) = self.coordinates(&hits.hits[i]);
        let depth = hits.hits[i].t * hits.directions[i].dot(camera.forward());
        (uv, depth / (camera.fx.abs() as f32 * samples as f32) * density)
    }

    /// Returns the texture coordinates of a hit, and the number of texels per unit of length at it.
    #[inline(always)]
    fn coordinates(&self, hit: &Hit) -> (Vec2, f32) {
        let TexturedTriangle { first, right, down, density } = self.triangles[hit.triangle as usize];
        let uv = first + hit.u * right + hit.v * down;
        (if self.repeats { uv - uv.floor() } else { uv }, density)
    }
}

tiface_base::dispatch! {
    /// Interpolates base colors between two levels.
    fn smooth / smooth_all(texture: &MeshTexture, hits: &RayHits, camera: &Camera, colors: &mut Vec<[f32; 3]>)
}

#[inline(always)]
fn smooth_all<const F: bool>(
    texture: &MeshTexture,
    hits: &RayHits,
    camera: &Camera,
    colors: &mut Vec<[f32; 3]>,
) {
    let (forward, per_pixel) = (camera.forward(), 1.0 / camera.fx.abs() as f32);
    let table = srgb_table(); // read once, outside the loop
    let MipMaps { levels, .. } = &texture.base;
    let last = levels.len() - 1;
    for (hits, directions) in hits.hits.chunks(LANES).zip(hits.directions.chunks(LANES)) {
        let (mut u, mut v, mut texels) = ([0f32; LANES], [0f32; LANES], [1f32; LANES]);
        for (l, (hit, direction)) in hits.iter().zip(directions).enumerate() {
            let (uv, density) = texture.coordinates(hit);
            (u[l], v[l]) = (uv.x, uv.y);
            texels[l] = hit.t * direction.dot(forward) * per_pixel * density;
        }
        let (mut level, mut share) = ([0; LANES], [0f32; LANES]);
        for l in 0..LANES {
            (level[l], share[l]) = mip_level(texels[l], last + 1);
        }
        let (fine, coarse) = (level.map(|l| levels[l]), level.map(|l| levels[(l + 1).min(last)]));
        let (mut at, mut way) = ([[[0u32; 4]; LANES]; 2], [[Vec2::ZERO; LANES]; 2]);
        for l in 0..LANES {
            (at[0][l], way[0][l]) = around(&fine[l], u[l], v[l]);
            (at[1][l], way[1][l]) = around(&coarse[l], u[l], v[l]);
        }
        let mut base = [[0f32; LANES]; 3];
        for l in 0..LANES {
            let texel = |level: usize, k: usize| floats(texture.base.texels[at[level][l][k] as usize]);
            let a = bilinear(from_fn(|k| texel(0, k)), way[0][l]);
            let b = bilinear(from_fn(|k| texel(1, k)), way[1][l]);
            let linear = (a + share[l] * (b - a)) * (1.0 / STEPS);
            (base[0][l], base[1][l], base[2][l]) = (linear.x, linear.y, linear.z);
        }
        for values in &mut base {
            for l in 0..LANES {
                values[l] = coded(table, values[l]);
            }
        }
        colors.extend((0..hits.len()).map(|l| base.map(|values| values[l])));
    }
}

/// Converts four 16-bit integers to floats.
#[inline(always)]
fn floats(t: Texel) -> Vec4 {
    Vec4::new(f32::from(t[0]), f32::from(t[1]), f32::from(t[2]), f32::from(t[3]))
}

/// Returns the next level of a picture of this many texels across and down: half as many each way.
fn halved(texels: &[Texel], [across, down]: [usize; 2], groups: usize) -> Vec<Texel> {
    let (width, height) = ((across / 2).max(1), (down / 2).max(1));
    let (columns, rows) = (shares(across, width), shares(down, height));
    let mut half = vec![[0; 4]; width * height * groups];
    half.par_chunks_exact_mut(width * groups).zip(&rows).for_each(|(row, own)| {
        for (out, columns) in row.chunks_exact_mut(groups).zip(&columns) {
            for (g, out) in out.iter_mut().enumerate() {
                let mut sum = Vec4::splat(0.5);
                for &(y, wy) in own {
                    for &(x, wx) in columns.iter().filter(|(_, wx)| wx * wy > 0.0) {
                        sum += wx * wy * floats(texels[(y * across + x) * groups + g]);
                    }
                }
                *out = sum.to_array().map(|v| v as u16);
            }
        }
    });
    half
}

/// Returns the four texels around a place of a level, clamped at its borders, and how far it is on
/// the way between them.
#[inline(always)]
fn around(level: &MipLevel, u: f32, v: f32) -> ([u32; 4], Vec2) {
    let (x, y) = (
        (u * level.width - 0.5).max(0.0).min(level.width - 1.0),
        (v * level.height - 0.5).max(0.0).min(level.height - 1.0),
    );
    let (left, top) = (whole(x), whole(y));
    let (right, bottom) = (whole((x + 1.0).min(level.width - 1.0)), whole((y + 1.0).min(level.height - 1.0)));
    let width = whole(level.width);
    let (above, below) = (level.first + top * width, level.first + bottom * width);
    let way = Vec2::new(x - left as i32 as f32, y - top as i32 as f32);
    ([above + left, above + right, below + left, below + right], way)
}

/// Returns the integer part of a number, 0 if it is negative.
// `clamp` would keep NaN
#[allow(clippy::manual_clamp)]
#[inline(always)]
fn whole(v: f32) -> u32 {
    let v = v.max(0.0).min(1e9);
    // SAFETY: the value is in 0..2³¹, because `max` turns NaN into 0. A checked cast would not be
    // vectorized.
    unsafe { v.to_int_unchecked::<i32>() as u32 }
}

#[inline(always)]
fn bilinear([a, b, c, d]: [Vec4; 4], f: Vec2) -> Vec4 {
    let (top, bottom) = (a + f.x * (b - a), c + f.x * (d - c));
    top + f.y * (bottom - top)
}

/// Returns the texels under each of `n` equal parts of a row of `from`, which has two to three a
/// part, with their shares.
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
    use tiface_base::geom::Bvh;

    /// Returns a square from −1 to 1 at z = 0, its texture 4 × 4 from red (left) to green (right).
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
        let row = |row: &[u16]| {
            let texels: Vec<Texel> = row.iter().map(|v| [*v; 4]).collect();
            halved(&texels, [row.len(), 1], 1).iter().map(|t| t[3]).collect::<Vec<_>>()
        };
        // five texels in halves of 2.5: (100 + 200 + 0.5 · 400) / 2.5 and (0.5 · 400 + 800 + 1600)
        // / 2.5
        assert_eq!(row(&[100, 200, 400, 800, 1600]), [200, 1040]);
        assert_eq!(row(&[3, 6, 0]), [3]);
        assert_eq!(row(&[1, 3, 5, 9]), [2, 7]);
        assert_eq!(row(&[65535, 65535, 0, 1]), [65535, 1]);
        // a bright spot keeps its place and its light on every level: 23 by 37 texels, the spot at
        // (5, 30)
        let (mut width, mut height) = (23, 37);
        let mut texels = vec![[0; 4]; width * height];
        texels[30 * width + 5] = [65535; 4];
        while width.min(height) > 1 {
            texels = halved(&texels, [width, height], 1);
            (width, height) = (width / 2, height / 2);
            let (w, h) = (width as f32, height as f32);
            let mut sums = [0f32; 3];
            for (i, [v, ..]) in texels.iter().enumerate() {
                let at = [(i % width) as f32 + 0.5, (i / width) as f32 + 0.5];
                [1.0, at[0] / w, at[1] / h]
                    .iter()
                    .zip(&mut sums)
                    .for_each(|(x, sum)| *sum += x * f32::from(*v));
            }
            // four texels at the end, each rounded
            assert!((sums[0] / (w * h) * 851.0 / 65535.0 - 1.0).abs() < 0.02, "{w} {h}");
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
        // 2 pixels over the square: every pixel is the mean of 2 × 2 texels, linear 0.5, coded
        // 0.735
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
        let pictures = vec![flat(128), flat(128), flat(128), flat(255)];
        let scale = vec![0.1, 0.1, 0.1, 0.2];
        let lobes = Lobes { pictures, scale, turned: Mat3::IDENTITY };
        let texture = MeshTexture::new(&mesh, &atlas, &photo, Some(&lobes));
        let pixels = view(&texture, &mesh, &Camera::above(9, 9, 9.0, 2.0), 1);
        let middle = pixels[40];
        assert!((middle[0] - 128.0 / 255.0).abs() < 1e-3);
        // the leftmost pixel is seen from the right: its direction to the viewer has x = 0.889 /
        // √(4 + 0.79)
        let x = 8.0 / 9.0 / (4.0f32 + 64.0 / 81.0).sqrt();
        assert!((pixels[36][0] - (128.0 / 255.0 - 0.2 * 0.4886 * x)).abs() < 1e-3, "{:?}", pixels[36]);
        assert!((pixels[36][1] - 128.0 / 255.0).abs() < 1e-3);
    }

    #[test]
    fn lobes_may_be_coarser_than_the_color() {
        let (mesh, atlas, mut photo) = square();
        photo.rgb.fill([128; 3]);
        // 2 × 2 texels of the constant function: less to the left, more to the right
        let rgb = [1, 255, 1, 255].map(|b| [b, 128, 128]).to_vec();
        let pictures = vec![Photo { width: 2, height: 2, rgb, alpha: None }];
        let lobes = Lobes { pictures, scale: vec![0.2], turned: Mat3::IDENTITY };
        let texture = MeshTexture::new(&mesh, &atlas, &photo, Some(&lobes));
        let camera = Camera::above(8, 8, 8.0, 2.0);
        let bvh = Bvh::new(&mesh);
        let options = RasterOptions::default();
        let raster = raster(&mesh, None, &camera, &options, |hits| texture.smooth_colors(hits, &camera));
        for pixels in [view(&texture, &mesh, &camera, 1), raster.view.color.data.as_chunks::<4>().0.to_vec()]
        {
            // the outer quarters are beyond the middles of the coarse texels: all of 0.2 · 0.2821;
            // in the middle they cancel out, half a pixel of eight from it
            let more = |x: usize| pixels[32 + x][0] - 128.0 / 255.0;
            assert!((more(0) + 0.0564).abs() < 1e-3 && (more(7) - 0.0564).abs() < 1e-3, "{}", more(0));
            assert!((more(3) + 0.0564 / 4.0).abs() < 1e-3 && (more(4) - 0.0564 / 4.0).abs() < 1e-3);
            assert!((pixels[32][1] - 128.0 / 255.0).abs() < 1e-3);
        }
        // without them the base color is left
        let plain = raycast(&bvh, &mesh, None, &camera, &RaycastOptions::default(), |hits| {
            texture.base_colors(hits, &camera, 2)
        });
        assert!(plain.color.data.as_chunks::<4>().0.iter().all(|p| (p[0] - 128.0 / 255.0).abs() < 1e-3));
    }

    #[test]
    fn between_two_levels_both_are_seen() {
        let (mesh, atlas, mut photo) = square();
        photo.rgb.iter_mut().enumerate().for_each(|(i, c)| *c = [255 * ((i + i / 4) % 2) as u8; 3]);
        let texture = MeshTexture::new(&mesh, &atlas, &photo, None);
        let seen = |texture: &MeshTexture, side: u32| {
            let camera = Camera::above(side, side, f64::from(side), 2.0);
            let options = RasterOptions::default();
            let seen = raster(&mesh, None, &camera, &options, |hits| texture.smooth_colors(hits, &camera));
            seen.view.color.data.as_chunks::<4>().0.to_vec()
        };
        // four texels on two pixels: the level of means, linear 0.5
        assert!(seen(&texture, 2).iter().all(|p| (p[0] - srgb_from_linear(0.5)).abs() < 1e-3));
        // as many pixels as texels: the texels themselves
        let each = seen(&texture, 4);
        assert!(each.iter().enumerate().all(|(i, p)| (p[0] - ((i + i / 4) % 2) as f32).abs() < 1e-3));
        // a texture that is used outside of its picture is repeated: shifted by a whole picture it
        // is the same
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

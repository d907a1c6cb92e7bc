//! The color of a cut's face: that of its rim, whose influence fades with the distance ([`Cap`]).

use super::face::Face;
use super::{Halved, position};
use crate::bake::{Bands, bilinear};
use crate::extract::{Cap, RimVertex};
use crate::files::HeadTexture;
use glam::{DVec2, UVec2, Vec2, Vec3};
use rayon::prelude::*;
use tiface_base::geom::{Aabb, Atlas, Mesh};
use tiface_base::image::{Photo, linear_from_srgb, quantize, srgb_from_linear};
use tiface_base::{Error, Result};

/// Most points of the rim that give the face its color.
const RIM: usize = 256;

/// Most texels along a unit of the face, in those of the whole: its color changes slowly.
const DENSITY: f64 = 0.5;

/// Fewest texels along the longest side of the face.
const FEWEST_PX: u32 = 4;

/// Returns the rim with the colors of vertices, if the mesh has any.
pub(super) fn rim_of_colors(mesh: &Mesh, halved: &Halved) -> Option<Cap> {
    let color = |vertex: u32, _| {
        let of = |v: u32| Vec3::from(mesh.colors[v as usize]);
        halved.vertices[vertex as usize].value(of, |a, b, t| a.lerp(b, t), |_| Vec3::ZERO)
    };
    (!mesh.colors.is_empty()).then(|| rim(mesh, halved, color))
}

/// Returns the rim with the colors of a texture.
pub(super) fn rim_of_texture(mesh: &Mesh, halved: &Halved, atlas: &Atlas, color: &Photo) -> Cap {
    let linear = |byte: u8| linear_from_srgb(f32::from(byte) / 255.0);
    rim(mesh, halved, |_, uv| bilinear(color, atlas.uvs[uv as usize], &linear).map(srgb_from_linear))
}

/// Returns the rim with colors of its vertices, each with its texture coordinate.
fn rim(mesh: &Mesh, halved: &Halved, color: impl Fn(u32, u32) -> Vec3) -> Cap {
    let step = halved.edges.len().div_ceil(RIM).max(1);
    let one = |&([v, _], uv): &([u32; 2], u32)| RimVertex {
        position: position(mesh, halved.vertices[v as usize]),
        normal: Vec3::ZERO,
        color: color(v, uv).to_array(),
    };
    let ring = halved.edges.iter().step_by(step).map(one).collect();
    Cap { bounds: Aabb::SCENE, near: 0.0, ring }
}

/// The place of a face in a texture.
pub(super) struct FaceChart {
    /// The square that is its own, in texels.
    corner: UVec2,
    side: u32,
    /// Texels along a unit of the face.
    scale: f64,
    /// Least coordinates of the face, in texels.
    low: DVec2,
    /// Texel of the square at which they are.
    inset: f64,
    size: DVec2,
}

impl FaceChart {
    /// Places a face in the largest free square of an atlas of a surface of this area.
    ///
    /// # Errors
    ///
    /// Fails if there is no room.
    pub fn place(atlas: &Atlas, area: f64, face: &Face, gutter_px: u32) -> Result<FaceChart> {
        let size = DVec2::new(f64::from(atlas.width), f64::from(atlas.height));
        let (low, high) = (face.flat.iter())
            .fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), p| (low.min(*p), high.max(*p)));
        let longest = (high - low).max_element();
        let texels: f64 = (0..atlas.triangles.len() as u32)
            .map(|t| {
                let [a, b, c] = atlas.corners(t);
                0.5 * f64::from((b - a).perp_dot(c - a).abs())
            })
            .sum();
        let wanted = (DENSITY * (texels / area).sqrt() * longest).ceil() as u32;
        // what is free is a gutter away from other charts, and the face a gutter within it
        for gutter in [gutter_px, 1] {
            let (corner, room) = largest_square(&free(atlas, gutter), atlas.width as usize);
            let inner = room.saturating_sub(2 * gutter).min(wanted.max(FEWEST_PX));
            if inner >= FEWEST_PX {
                let scale = f64::from(inner) / longest;
                let side = inner + 2 * gutter;
                let low = low * scale;
                return Ok(FaceChart { corner, side, scale, low, inset: f64::from(gutter), size });
            }
        }
        let hint = "make the texture larger, or give the mesh a new one with fewer triangles";
        Err(Error::cannot("the texture has no room for the face that the cut leaves", hint))
    }

    /// Returns the texture coordinate of a point of the face; rows run down, so the picture is not
    /// mirrored as seen from below.
    pub fn uv(&self, flat: DVec2) -> Vec2 {
        let from = self.scale * flat - self.low + self.inset;
        let texel = self.corner.as_dvec2() + DVec2::new(from.x, f64::from(self.side) - from.y);
        (texel / self.size).as_vec2().clamp(Vec2::ZERO, Vec2::ONE)
    }

    /// Returns the point of the face at a texel, which may lie between two.
    fn flat(&self, texel: DVec2) -> DVec2 {
        let from = texel - self.corner.as_dvec2();
        (DVec2::new(from.x, f64::from(self.side) - from.y) - self.inset + self.low) / self.scale
    }

    /// Returns a texture with the face painted: neither light from lobes nor bumps.
    pub fn painted(&self, texture: &HeadTexture, face: &Face, rim: &Cap) -> HeadTexture {
        let mut out = texture.clone();
        self.fill(&mut out.color, |texel| rim.color(face.at(self.flat(texel))).map(quantize));
        // ±0 of a normal map, and 0 of a lobe
        out.normal.iter_mut().for_each(|normal| self.fill(normal, |_| [128, 128, 255]));
        let lobes = out.lobes.iter_mut().flat_map(|lobes| &mut lobes.pictures);
        lobes.for_each(|lobe| self.fill(lobe, |_| [128; 3]));
        out
    }

    /// Fills the square in a picture of any size.
    fn fill(&self, picture: &mut Photo, color: impl Fn(DVec2) -> [u8; 3] + Sync) {
        let step = self.size.x / f64::from(picture.width);
        let range = |from: u32, most: u32| {
            let (first, last) = (f64::from(from) / step, f64::from(from + self.side) / step);
            first.ceil() as usize..(last.floor() as usize).min(most as usize)
        };
        let columns = range(self.corner.x, picture.width);
        let rows = range(self.corner.y, picture.height);
        let width = picture.width as usize;
        let lines = picture.rgb.par_chunks_mut(width).enumerate().filter(|(row, _)| rows.contains(row));
        lines.for_each(|(row, line)| {
            for column in columns.clone() {
                line[column] = color(step * (DVec2::new(column as f64, row as f64) + 0.5));
            }
        });
    }
}

/// Returns which texels are farther than `gutter` from all charts.
fn free(atlas: &Atlas, gutter: u32) -> Vec<bool> {
    let (width, height) = (atlas.width as usize, atlas.height as usize);
    let mut is_free = vec![true; width * height];
    let bands = Bands::new(atlas, 1);
    for sample in (0..bands.len()).flat_map(|band| bands.samples(atlas, band, 1)) {
        is_free[sample.texel as usize] = false;
    }
    // a texel more: charts cover parts of texels beside those whose middles they cover
    let reach = gutter as usize + 1;
    let spread = |line: &mut dyn Iterator<Item = &mut bool>| {
        let mut cells: Vec<&mut bool> = line.collect();
        let taken: Vec<usize> = (0..cells.len()).filter(|&i| !*cells[i]).collect();
        for i in taken {
            let (first, last) = (i.saturating_sub(reach), (i + reach).min(cells.len() - 1));
            cells[first..=last].iter_mut().for_each(|cell| **cell = false);
        }
    };
    is_free.chunks_mut(width).for_each(|row| spread(&mut row.iter_mut()));
    (0..width).for_each(|column| spread(&mut is_free.iter_mut().skip(column).step_by(width)));
    is_free
}

/// Returns the first texel and the side of the largest square of free texels.
fn largest_square(is_free: &[bool], width: usize) -> (UVec2, u32) {
    // sides of the largest squares that end at each texel of the row before, and of this one
    let (mut before, mut best) = (vec![0u32; width], (UVec2::ZERO, 0));
    for (row, line) in is_free.chunks(width).enumerate() {
        let mut here = vec![0u32; width];
        for (column, _) in line.iter().enumerate().filter(|(_, free)| **free) {
            let left = column.checked_sub(1);
            let around = left.map_or(0, |left| before[column].min(here[left]).min(before[left]));
            here[column] = around + 1;
            if here[column] > best.1 {
                let last = UVec2::new(column as u32, row as u32);
                best = (last + 1 - here[column], here[column]);
            }
        }
        before = here;
    }
    best
}

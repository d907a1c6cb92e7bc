//! Photographs that colors are fitted to, and which of their pixels show the head.

use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::Camera;
use tiface_base::image::{Gray, OPAQUE_ALPHA, Photo, eroded};

/// A photograph that colors are fitted to.
#[derive(Clone, Copy)]
pub struct Photograph<'a> {
    /// Its camera, in the mesh's coordinates.
    pub camera: &'a Camera,
    /// Its pixels, sRGB-coded.
    pub photo: &'a Photo,
    /// Soft alpha of the head, same size; `None`: all is head.
    pub mask: Option<&'a Gray>,
    /// Usable pixels (non-zero), same size; `None`: all are.
    pub valid: Option<&'a Gray>,
    /// Whether it is a field's view: no camera took it, so nothing is judged by it.
    pub rendered: bool,
}

impl Photograph<'_> {
    /// Returns whether a pixel shows the head alone. Soft pixels also show the background, and
    /// would paint the outline with it.
    pub(super) fn is_head(&self, at: usize) -> bool {
        self.mask.is_none_or(|m| m.values[at] >= OPAQUE_ALPHA) && self.valid.is_none_or(|v| v.values[at] > 0)
    }

    /// Returns whether a point of the scene falls on a pixel that shows the head alone.
    pub fn shows_head_at(&self, point: Vec3) -> bool {
        let Some(at) = self.camera.project_inside(point) else { return false };
        self.is_head(at.y as usize * self.photo.width as usize + at.x as usize)
    }

    /// Returns the usable pixels within `margin` pixels of the mask's outline.
    pub fn outline(&self, margin: usize) -> Vec<usize> {
        let Some(mask) = self.mask else { return Vec::new() };
        let (w, h) = (mask.width as usize, mask.height as usize);
        // a mask continues beyond its border with the value at the border
        let (wide, high) = (w + 2 * margin, h + 2 * margin);
        let inner = |at: usize, n: usize| at.clamp(margin, margin + n - 1) - margin;
        let side = |head: bool| {
            let of = |i: usize| (mask.values[inner(i / wide, h) * w + inner(i % wide, w)] >= 128) == head;
            let set = eroded((0..wide * high).map(of).collect(), wide, high, margin);
            (0..w * h).map(|i| set[(i / w + margin) * wide + i % w + margin]).collect::<Vec<bool>>()
        };
        let (inside, outside) = (side(true), side(false));
        let usable = |at: &usize| self.valid.is_none_or(|v| v.values[*at] > 0);
        (0..w * h).filter(|&at| !inside[at] && !outside[at]).filter(usable).collect()
    }

    /// Returns how many pixels show the head alone.
    pub fn head_pixels(&self) -> usize {
        (0..self.photo.rgb.len()).into_par_iter().filter(|&at| self.is_head(at)).count()
    }
}

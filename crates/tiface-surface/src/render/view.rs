//! What a camera sees: color, depth and normals.

use tiface_base::image::Image;

/// The view of one camera.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RenderedView {
    /// RGBA: sRGB-coded color premultiplied over black, and coverage.
    pub color: Image,
    /// One channel: distance along the viewing axis in world units at the pixel's center; 0 =
    /// nothing.
    pub depth: Image,
    /// Three channels: unit normal in the world at the pixel's center; 0 = nothing. No pixels at
    /// all if the method has no normals.
    pub normal: Image,
}

impl RenderedView {
    /// Returns an empty view.
    pub fn new(width: u32, height: u32, has_normals: bool) -> RenderedView {
        let [w, h] = if has_normals { [width, height] } else { [0, 0] };
        RenderedView {
            color: Image::new(width, height, 4),
            depth: Image::new(width, height, 1),
            normal: Image::new(w, h, 3),
        }
    }
}

//! The texture of a mesh: its texture coordinates and pictures.

use glam::Mat3;
use tiface_base::geom::sphharm::rotated;
use tiface_base::geom::{Atlas, Mesh};
use tiface_base::image::{Image, Photo, reduce_photo, reduce_to_rows, working_size};
use tiface_base::{Error, Result};

/// The texture of a mesh: its texture coordinates and pictures.
#[derive(Clone, Debug, PartialEq)]
pub struct HeadTexture {
    /// The texture coordinates.
    pub atlas: Atlas,
    /// Base color, sRGB-coded; its alpha is not written.
    pub color: Photo,
    /// Normals in tangent space: linear, +X along u, +Y up the picture (OpenGL), for the tangents
    /// of [`tangents()`](super::tangents()). GLB and USDZ only.
    pub normal: Option<Photo>,
    /// View-dependent color. GLB only.
    pub lobes: Option<Lobes>,
}

/// Texels of a base color along each side of a texel of lobes, which are smooth.
pub const LOBE_TEXEL: u32 = 4;

/// Steps of a lobe from 0 to its largest value. Finer ones take half as many bytes more and bring
/// views 0.01 dB closer to photographs.
const LOBE_LEVELS: f32 = 48.0;

/// View-dependent color of a texture: spherical harmonics of the direction to the viewer.
#[derive(Clone, Debug, PartialEq)]
pub struct Lobes {
    /// One picture per spherical-harmonic function, all of one size and of the atlas's shape; a
    /// byte `b` stands for `(b − 128) / 127 · scale`.
    pub pictures: Vec<Photo>,
    /// Scale of each, sRGB-coded.
    pub scale: Vec<f32>,
    /// Turns directions of the mesh's coordinates into those of the harmonics.
    pub turned: Mat3,
}

impl Lobes {
    /// Returns lobes as pictures, sRGB-coded differences of 3 channels: one a function. The largest
    /// value of each is the one that all but a thousandth of its texels stay below, so that a few
    /// outliers do not cost the others their precision. `None` without a picture.
    pub fn new(images: &[Image], turned: Mat3) -> Option<Lobes> {
        let (mut pictures, mut scale) = (Vec::new(), Vec::new());
        for image in images {
            let mut sizes: Vec<f32> = image.data.iter().map(|v| v.abs()).collect();
            let at = (sizes.len() as f64 * 0.999) as usize;
            let most =
                if sizes.is_empty() { 0.0 } else { *sizes.select_nth_unstable_by(at, f32::total_cmp).1 };
            let most = most.max(1e-4) * 127.0 / LOBE_LEVELS;
            let byte = |v: f32| (v / most * 127.0 + 128.5).clamp(1.0, 255.0) as u8;
            let rgb = image.data.as_chunks::<3>().0.iter().map(|c| c.map(byte)).collect();
            pictures.push(Photo { width: image.width, height: image.height, rgb, alpha: None });
            scale.push(most);
        }
        (!pictures.is_empty()).then_some(Lobes { pictures, scale, turned })
    }

    /// Returns the lobes with pictures whose longest side is at most `px`, averaged.
    pub fn reduced(mut self, px: u32) -> Lobes {
        for picture in &mut self.pictures {
            *picture = reduce_photo(picture, working_size(picture.width, picture.height, px));
        }
        self
    }

    /// Returns the same lobes with harmonics in other coordinates, to which `turned` leads from
    /// those of the mesh; unchanged where they are in these already.
    pub fn in_coordinates(&self, turned: Mat3) -> Option<Lobes> {
        if turned == self.turned {
            return Some(self.clone());
        }
        let matrix = rotated(self.pictures.len(), self.turned * turned.transpose());
        let image = |j: usize| {
            let Photo { width, height, .. } = self.pictures[j];
            let mut image = Image::new(width, height, 3);
            for (k, picture) in self.pictures.iter().enumerate() {
                let step = matrix[k][j] * self.scale[k] / 127.0;
                let bytes = picture.rgb.as_flattened();
                image.data.iter_mut().zip(bytes).for_each(|(sum, &b)| *sum += step * (f32::from(b) - 128.0));
            }
            image
        };
        let images: Vec<Image> = (0..self.pictures.len()).map(image).collect();
        Lobes::new(&images, turned)
    }
}

impl HeadTexture {
    /// Returns a texture of a base color alone.
    pub fn new(atlas: Atlas, color: Photo) -> HeadTexture {
        HeadTexture { atlas, color, normal: None, lobes: None }
    }

    /// Returns the texture with pictures whose longest side is at most `px`, those of lobes at most
    /// `lobe_px`: averaged, colors in linear light.
    pub fn reduced(self, px: u32, lobe_px: u32) -> HeadTexture {
        let size = |photo: &Photo| working_size(photo.width, photo.height, px);
        let color = reduce_to_rows(&self.color, size(&self.color).1);
        let normal = self.normal.map(|normal| reduce_photo(&normal, size(&normal)));
        let lobes = self.lobes.map(|lobes| lobes.reduced(lobe_px));
        let atlas = Atlas { width: color.width, height: color.height, ..self.atlas };
        HeadTexture { atlas, color, normal, lobes }
    }

    /// Returns the pictures of the lobes, if the texture has any.
    pub(super) fn lobe_pictures(&self) -> &[Photo] {
        self.lobes.as_ref().map_or(&[], |l| &l.pictures)
    }

    /// Checks that every picture is complete and has the atlas's aspect ratio; its scale is free,
    /// but lobes have one.
    pub(super) fn check_pictures(&self) -> Result<()> {
        self.check("base color", &self.color)?;
        self.normal.as_ref().map_or(Ok(()), |normal| self.check("normal map", normal))?;
        let lobes = self.lobe_pictures();
        for (k, picture) in lobes.iter().enumerate() {
            let (what, Photo { width, height, .. }) = (format!("texture `lobe {k}`"), &lobes[0]);
            self.check(&what, picture)?;
            if (picture.width, picture.height) != (*width, *height) {
                let found = format!("{} × {} pixels", picture.width, picture.height);
                return Err(wrong_picture(
                    &what,
                    found,
                    &format!("the size of the first, {width} × {height}"),
                ));
            }
        }
        Ok(())
    }

    fn check(&self, what: &str, picture: &Photo) -> Result<()> {
        let (w, h) = (u64::from(picture.width), u64::from(picture.height));
        if w * h == 0 || w * h != picture.rgb.len() as u64 {
            let found = format!("{} pixels for {w} × {h}", picture.rgb.len());
            return Err(wrong_picture(what, found, "one for each, and at least one"));
        }
        if w * u64::from(self.atlas.height) != h * u64::from(self.atlas.width) {
            let expected = format!("the shape of its atlas, {} × {}", self.atlas.width, self.atlas.height);
            return Err(wrong_picture(what, format!("{w} × {h} pixels"), &expected));
        }
        Ok(())
    }
}

/// Checks that the atlas belongs to this mesh and lies within its texture.
pub(super) fn check_atlas(mesh: &Mesh, atlas: &Atlas) -> Result<()> {
    let wrong = |what: String| {
        Err(Error::cannot(what, "the atlas is damaged or belongs to another mesh; unwrap it again"))
    };
    let (found, expected) = (atlas.triangles.len(), mesh.triangles.len());
    if found != expected {
        return wrong(format!("the atlas has {found} triangles, the mesh {expected}"));
    }
    let uvs = atlas.uvs.len();
    for (triangle, t) in atlas.triangles.iter().enumerate() {
        if let Some(index) = t.iter().find(|&&i| i as usize >= uvs) {
            return wrong(format!(
                "triangle {triangle} uses texture coordinate {index}, but there are only {uvs}"
            ));
        }
    }
    let outside = |v: &f32| !(0.0..=1.0).contains(v);
    match atlas.uvs.iter().position(|uv| uv.to_array().iter().any(outside)) {
        Some(index) => wrong(format!(
            "texture coordinate {index} is {}, expected 0 to 1 in both directions",
            atlas.uvs[index]
        )),
        None => Ok(()),
    }
}

/// Returns an error if a picture does not fit its own size or the atlas.
fn wrong_picture(what: &str, found: String, expected: &str) -> Error {
    let hint = "bake it again, for this atlas";
    Error::cannot(format!("the {what} is {found}, expected {expected}"), hint)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lobes_are_as_fine_as_their_largest_value_wants_whatever_a_few_texels_have() {
        let mut image = Image::new(64, 64, 3);
        image.data.iter_mut().enumerate().for_each(|(i, v)| *v = 0.3 * (i as f32 * 0.01).sin());
        image.data[5] = 0.7;
        let lobes = Lobes::new(&[image.clone(), Image::new(64, 64, 3)], Mat3::IDENTITY).unwrap();
        let value = |k: usize, i: usize| {
            (f32::from(lobes.pictures[k].rgb.as_flattened()[i]) - 128.0) / 127.0 * lobes.scale[k]
        };
        // half of a forty-eighth of 0.3, the outlier too
        for (i, v) in image.data.iter().enumerate() {
            assert!((value(0, i) - v).abs() < 0.0032, "{} {v}", value(0, i));
            assert_eq!(value(1, i), 0.0);
        }
        assert!(Lobes::new(&[], Mat3::IDENTITY).is_none());
        assert_eq!(lobes.in_coordinates(Mat3::IDENTITY), Some(lobes.clone()));
    }

    #[test]
    fn a_smaller_texture_averages_light_and_other_values_as_they_are() {
        // columns of black and white, and of lobes and normals of the same bytes
        let photo = Photo {
            width: 4,
            height: 2,
            rgb: (0..8).map(|i| [if i % 2 == 0 { 0 } else { 255 }; 3]).collect(),
            alpha: None,
        };
        let lobes = Lobes { pictures: vec![photo.clone()], scale: vec![0.5], turned: Mat3::IDENTITY };
        let atlas = Atlas { width: 4, height: 2, ..Atlas::default() };
        let texture =
            HeadTexture { atlas, color: photo.clone(), normal: Some(photo.clone()), lobes: Some(lobes) };
        let small = texture.clone().reduced(2, 2);
        // half of the light is 188 in sRGB
        assert_eq!((small.color.width, small.color.height, &small.color.rgb[..]), (2, 1, &[[188; 3]; 2][..]));
        assert_eq!((small.atlas.width, small.atlas.height), (2, 1));
        assert_eq!(small.normal.unwrap().rgb, [[128; 3]; 2]);
        assert_eq!(small.lobes.unwrap().pictures[0].rgb, [[128; 3]; 2]);
        assert_eq!(texture.clone().reduced(4, 9), texture);
    }
}

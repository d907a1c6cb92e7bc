//! Pixels near the outline of a mask that show light from behind rather than the head.
//!
//! A mask is right to a pixel or two at best, and lamps behind hair outshine it through gaps that a
//! mask does not have. Such a pixel, fitted at a steep angle, would paint the back of the head.

use super::photograph::Photograph;
use glam::Vec3;
use tiface_base::image::eroded;

/// Pixels within this many of a pixel that is not the head alone may show what is behind.
const EDGE: usize = 4;

/// Pixels on each side of a pixel over which head and background around it are averaged.
const WINDOW: usize = 8;

/// Byte that all channels of a lamp reach.
const LAMP: u8 = 240;

/// Distance between the colors of head and background, 0..=√3, from which on they tell apart.
const APART: f32 = 0.15;

/// A pixel is background if its distance to it is less than this share of that to the head.
const NEARER: f32 = 0.5;

/// Alpha up to which a pixel shows the background alone.
const CLEAR: u8 = 5;

/// Returns for each pixel whether it counts as the head by the mask, but shows light from behind;
/// in a rendered view none does.
pub(super) fn is_glare(photograph: &Photograph) -> Vec<bool> {
    let photo = photograph.photo;
    let (w, h) = (photo.width as usize, photo.height as usize);
    let Some(mask) = photograph.mask.filter(|_| !photograph.rendered) else { return vec![false; w * h] };
    let head: Vec<bool> = (0..w * h).map(|at| photograph.is_head(at)).collect();
    let inner = eroded(head.clone(), w, h, EDGE);
    let heads = WindowMeans::new(&photo.rgb, [w, h], |at| inner[at]);
    let clear = |at: usize| mask.values[at] <= CLEAR && photograph.valid.is_none_or(|v| v.values[at] > 0);
    let backgrounds = WindowMeans::new(&photo.rgb, [w, h], clear);
    let shows_behind = |at: usize| {
        if photo.rgb[at].iter().all(|&byte| byte >= LAMP) {
            return true;
        }
        let (Some(head), Some(behind)) = (heads.around(at), backgrounds.around(at)) else { return false };
        let own = photo.rgb[at].map(|byte| f32::from(byte) / 255.0);
        let [head, behind, own] = [head, behind, own].map(Vec3::from);
        head.distance(behind) > APART && own.distance(behind) < NEARER * own.distance(head)
    };
    (0..w * h).map(|at| head[at] && !inner[at] && shows_behind(at)).collect()
}

/// Sums of some pixels over all rectangles from the top left corner (Crow 1984).
struct WindowMeans {
    /// `[h + 1][w + 1]`: their number, and their channels.
    sums: Vec<[u64; 4]>,
    size: [usize; 2],
}

impl WindowMeans {
    fn new(rgb: &[[u8; 3]], [w, h]: [usize; 2], counts: impl Fn(usize) -> bool) -> WindowMeans {
        let wide = w + 1;
        let mut sums = vec![[0u64; 4]; wide * (h + 1)];
        for at in 0..w * h {
            let (x, y) = (at % w, at / w);
            let [r, g, b] = rgb[at].map(u64::from);
            let own = if counts(at) { [1, r, g, b] } else { [0; 4] };
            let i = (y + 1) * wide + x + 1;
            let [left, above, both] = [i - 1, i - wide, i - wide - 1].map(|i| sums[i]);
            sums[i] = std::array::from_fn(|k| own[k] + left[k] + above[k] - both[k]);
        }
        WindowMeans { sums, size: [w, h] }
    }

    /// Returns the mean color of those around a pixel; `None` without any.
    fn around(&self, at: usize) -> Option<[f32; 3]> {
        let [w, h] = self.size;
        let range = |i: usize, n: usize| [i.saturating_sub(WINDOW), (i + WINDOW + 1).min(n)];
        let ([x0, x1], [y0, y1]) = (range(at % w, w), range(at / w, h));
        let corner = |x: usize, y: usize| self.sums[y * (w + 1) + x];
        let [a, b, c, d] = [corner(x1, y1), corner(x0, y1), corner(x1, y0), corner(x0, y0)];
        let sum = |k: usize| (a[k] + d[k] - b[k] - c[k]) as f32;
        let count = sum(0);
        (count > 0.0).then(|| [1, 2, 3].map(|k| sum(k) / count / 255.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::geom::Camera;
    use tiface_base::image::{Gray, Photo};

    #[test]
    fn light_from_behind_at_the_outline_is_no_head_but_a_highlight_within_is() {
        // dark hair left of column 20 before a gray wall; the mask reaches two columns too far
        let (w, h) = (40usize, 30usize);
        let mut rgb: Vec<[u8; 3]> =
            (0..w * h).map(|i| if i % w < 20 { [50, 35, 25] } else { [150, 150, 155] }).collect();
        let values = (0..w * h).map(|i| if i % w < 22 { 255 } else { 0 }).collect();
        // a lamp through the hair near the outline, and a highlight deep within
        rgb[15 * w + 19] = [250, 255, 252];
        rgb[15 * w + 5] = [250, 255, 252];
        let photo = Photo { width: w as u32, height: h as u32, rgb, alpha: None };
        let mask = Gray { width: w as u32, height: h as u32, values };
        let camera = Camera::above(w as u32, h as u32, 40.0, 3.0);
        let whole =
            Photograph { camera: &camera, photo: &photo, mask: Some(&mask), valid: None, rendered: false };
        let glare = is_glare(&whole);
        for (i, is) in glare.iter().enumerate() {
            let (x, y) = (i % w, i / w);
            assert_eq!(*is, x == 20 || x == 21 || (x, y) == (19, 15), "{x} {y}");
        }
        assert!(is_glare(&Photograph { mask: None, ..whole }).iter().all(|g| !g));
        assert!(is_glare(&Photograph { rendered: true, ..whole }).iter().all(|g| !g));
    }

    #[test]
    fn a_head_as_bright_as_what_is_behind_it_stays() {
        let photo = Photo { width: 30, height: 30, rgb: vec![[150, 150, 155]; 900], alpha: None };
        let mask = Gray {
            width: 30,
            height: 30,
            values: (0..900).map(|i| if i % 30 < 15 { 255 } else { 0 }).collect(),
        };
        let camera = Camera::above(30, 30, 40.0, 3.0);
        let photograph =
            Photograph { camera: &camera, photo: &photo, mask: Some(&mask), valid: None, rendered: false };
        assert!(is_glare(&photograph).iter().all(|g| !g));
    }
}

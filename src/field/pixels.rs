//! Where training rays come from: random pixels that can tell something about the head.
//!
//! A pixel farther from the mask than the visual hull's cells reach meets no sample and teaches
//! nothing, so only the mask and a margin around it are drawn. Photographs stay 8 bit.

use super::background;
use crate::config::iface::Foreground;
use crate::geom::{Camera, Ray};
use crate::image::{Gray, Photo};
#[cfg(feature = "wgpu")]
use crate::kernel::gpu;
use crate::kernel::march::MarchRay;
use crate::kernel::rng;
use glam::Vec2;
use rayon::prelude::*;

/// One photograph to learn from.
pub struct TrainView {
    /// Its camera, in scene coordinates (the head's box in [-1, 1]³).
    pub camera: Camera,
    /// What it saw.
    pub photo: Photo,
    /// Soft alpha of the head, same size; `None` where there are no masks.
    pub mask: Option<Gray>,
    /// Usable pixels (non-zero), same size.
    pub valid: Option<Gray>,
}

/// Pixels drawn for one step.
pub struct Batch {
    /// Rays in field coordinates.
    pub rays: Vec<MarchRay>,
    /// `[rays, 3]` head over black, sRGB-coded 0..=1: premultiplied by `alpha`.
    pub color: Vec<[f32; 3]>,
    /// `[rays]` soft alpha; 1 where the view has no mask.
    pub alpha: Vec<f32>,
}

/// The drawable pixels of all views.
pub struct Pixels<'a> {
    views: &'a [TrainView],
    /// Per view: what a render over black should show; empty for views without a mask.
    over_black: Vec<Vec<[u8; 3]>>,
    /// Per view: inclusive box of drawable pixels and one bit per pixel.
    drawable: Vec<(u32, u32, u32, u32, Vec<u64>)>,
    /// Running count of drawable pixels.
    cumulative: Vec<u64>,
    radius: f32,
    /// Has any view a mask that says something?
    pub masked: bool,
    published: bool,
    /// How pixels follow each other that are drawn without repetition.
    order: Option<Order>,
}

/// Every drawable pixel once, then again in another order: TensoRF's sampler.
struct Order {
    /// Per view: drawable pixels before each word of its bits.
    before: Vec<Vec<u32>>,
    /// Directions have depth 1 in front of the camera, not length 1.
    depth_directions: bool,
}

impl<'a> Pixels<'a> {
    /// `reach` is how far outside the mask, in scene units, a ray may still meet an occupied cell.
    ///
    /// `foreground` says what a soft pixel's target is. Where some views have a mask, those without one
    /// (or with one that is white all over) are not drawn from: they would teach that all of it is head.
    ///
    /// `published` draws as the published code does: every view as often, any pixel of its frame.
    pub fn new(
        views: &'a [TrainView],
        reach: f32,
        radius: f32,
        foreground: Foreground,
        published: bool,
    ) -> Pixels<'a> {
        let usable = |v: &TrainView| v.mask.as_ref().is_some_and(|m| m.values.iter().any(|&a| a < 255));
        let masked = views.iter().any(usable);
        let reach = if published { f32::INFINITY } else { reach };
        let over_black = views
            .par_iter()
            .map(|v| match (&v.mask, foreground) {
                (Some(mask), Foreground::Estimated) => background::over_black(&v.photo, mask),
                _ => Vec::new(),
            })
            .collect();
        let drawable: Vec<_> = views
            .par_iter()
            .map(|v| drawable(v, if masked && !usable(v) { Reach::Nothing } else { Reach::Within(reach) }))
            .collect();
        let mut sum = 0;
        let cumulative = drawable
            .iter()
            .map(|(.., bits)| {
                sum += bits.iter().map(|b| b.count_ones() as u64).sum::<u64>();
                sum
            })
            .collect();
        Pixels { views, over_black, drawable, cumulative, radius, masked, published, order: None }
    }

    /// Pixels as TensoRF's code draws them: all valid ones whose ray meets the box `bounds` at any distance, in a random
    /// order without repetition, which starts anew where fewer than a batch are left. With `depth_directions` rays
    /// have directions of depth 1 before the camera, as in its loader of forward-facing captures.
    ///
    /// The order is a permutation that is computed, not stored: twenty-four photographs of twelve megapixels would have
    /// a list of two gigabytes.
    pub fn permuted(
        views: &'a [TrainView],
        foreground: Foreground,
        bounds: [[f32; 3]; 2],
        depth_directions: bool,
    ) -> Pixels<'a> {
        let mut pixels = Pixels::new(views, f32::INFINITY, 1.0, foreground, false);
        pixels.drawable.par_iter_mut().zip(views).for_each(|((.., bits), view)| {
            let width = view.photo.width as usize;
            for (i, word) in bits.iter_mut().enumerate() {
                let (mut rest, mut kept) = (*word, 0);
                while rest != 0 {
                    let bit = rest.trailing_zeros() as usize;
                    rest &= rest - 1;
                    let p = 64 * i + bit;
                    let at = Vec2::new((p % width) as f32 + 0.5, (p / width) as f32 + 0.5);
                    let ray = view.camera.ray(at);
                    kept |= u64::from(ray.is_some_and(|ray| meets(bounds, &ray))) << bit;
                }
                *word = kept;
            }
        });
        let mut sum = 0;
        let mut before = Vec::with_capacity(views.len());
        for (total, (.., bits)) in pixels.cumulative.iter_mut().zip(&pixels.drawable) {
            let mut own = 0u32;
            let counted = |b: &u64| {
                own += b.count_ones();
                own - b.count_ones()
            };
            before.push(bits.iter().map(counted).collect());
            sum += u64::from(own);
            *total = sum;
        }
        pixels.order = Some(Order { before, depth_directions });
        pixels
    }

    /// The photographs.
    pub fn views(&self) -> &'a [TrainView] {
        self.views
    }

    /// Drawable pixels of all views.
    pub fn count(&self) -> u64 {
        self.cumulative.last().copied().unwrap_or(0)
    }

    /// `count` random rays of a step: a function of seed and step alone.
    pub fn draw(&self, seed: u64, step: u64, count: usize, jitter: bool) -> Batch {
        let drawn: Vec<(MarchRay, [f32; 3], f32)> = (0..count)
            .into_par_iter()
            .with_min_len(256)
            .filter_map(|i| match &self.order {
                Some(order) => self.draw_next(order, (seed, step), (i as u64, count as u64), jitter),
                None => self.draw_one(seed, step, i as u64, jitter),
            })
            .collect();
        let mut batch = Batch {
            rays: Vec::with_capacity(drawn.len()),
            color: Vec::with_capacity(drawn.len()),
            alpha: Vec::with_capacity(drawn.len()),
        };
        for (ray, color, alpha) in drawn {
            batch.rays.push(ray);
            batch.color.push(color);
            batch.alpha.push(alpha);
        }
        batch
    }

    /// Copies the photographs to a device, where the same rays are drawn from them.
    #[cfg(feature = "wgpu")]
    pub fn on_device(
        &self,
        device: &gpu::Device,
        jitter: bool,
        background: bool,
    ) -> crate::Result<gpu::Photographs> {
        let drawing = gpu::Drawing { every: self.published, jitter, background };
        let views: Vec<gpu::DrawnView> =
            (0..self.views.len()).into_par_iter().map(|v| self.drawn(v)).collect();
        gpu::Photographs::new(device, &views, self.radius, drawing)
    }

    /// Bytes that the photographs take on a device.
    #[cfg(feature = "wgpu")]
    pub fn bytes_on_device(&self) -> u64 {
        let area = |(x0, y0, x1, y1, _): &(u32, u32, u32, u32, Vec<u64>)| match x0 > x1 {
            true => 0,
            false => (x1 - x0 + 1) as u64 * (y1 - y0 + 1) as u64,
        };
        self.drawable.iter().map(|view| 4 * area(view).next_multiple_of(32)).sum()
    }

    /// The drawable part of a view, packed.
    #[cfg(feature = "wgpu")]
    fn drawn(&self, v: usize) -> gpu::DrawnView {
        let view = &self.views[v];
        let over_black = &self.over_black[v];
        let (x0, y0, x1, y1, bits) = &self.drawable[v];
        let [x, y, width, height] = if x0 > x1 { [0; 4] } else { [*x0, *y0, x1 - x0 + 1, y1 - y0 + 1] };
        let mut pixels = Vec::with_capacity((width * height) as usize);
        let mut drawable = vec![0u32; (width * height).div_ceil(32) as usize];
        for row in y..y + height {
            let first = row as usize * view.photo.width as usize;
            for p in first + x as usize..first + (x + width) as usize {
                let [r, g, b] = over_black.get(p).copied().unwrap_or(view.photo.rgb[p]);
                let alpha = view.mask.as_ref().map_or(255, |m| m.values[p]);
                drawable[pixels.len() / 32] |= ((bits[p >> 6] >> (p & 63) & 1) as u32) << (pixels.len() % 32);
                pixels.push(u32::from_le_bytes([r, g, b, alpha]));
            }
        }
        gpu::DrawnView {
            camera: view.camera.clone(),
            part: [x, y, width, height],
            pixels,
            over_black: !over_black.is_empty(),
            drawable,
        }
    }

    /// Pixel `i` of a batch of `count` in the order that all are gone through.
    fn draw_next(
        &self,
        order: &Order,
        (seed, step): (u64, u64),
        (i, count): (u64, u64),
        jitter: bool,
    ) -> Option<(MarchRay, [f32; 3], f32)> {
        let all = self.count();
        let batches = (all / count).max(1);
        let place = step % batches * count + i;
        if place >= all {
            return None; // a batch of more than there are
        }
        let which = permuted(rng::bits(seed, 13, step / batches), place, all);
        let v = self.cumulative.partition_point(|&c| c <= which);
        let rank = (which - if v > 0 { self.cumulative[v - 1] } else { 0 }) as u32;
        let word = order.before[v].partition_point(|&b| b <= rank) - 1;
        let mut bits = self.drawable[v].4[word];
        (order.before[v][word]..rank).for_each(|_| bits &= bits - 1);
        let p = 64 * word + bits.trailing_zeros() as usize;
        let view = &self.views[v];
        let width = view.photo.width as usize;
        let ray = view.camera.ray(Vec2::new((p % width) as f32 + 0.5, (p / width) as f32 + 0.5))?;
        let jitter = if jitter { rng::uniform(seed, (step << 4) + 2, i) } else { 0.0 };
        let depth = if order.depth_directions { ray.direction.dot(view.camera.forward()) } else { 1.0 };
        let (origin, direction) = (ray.origin.to_array(), (ray.direction / depth).to_array());
        let (color, alpha) = self.seen(v, p);
        Some((MarchRay { origin, direction, jitter }, color, alpha))
    }

    /// What pixel `p` of view `v` should show over black, and its alpha.
    fn seen(&self, v: usize, p: usize) -> ([f32; 3], f32) {
        let view = &self.views[v];
        let alpha = view.mask.as_ref().map_or(1.0, |m| m.values[p] as f32 / 255.0);
        let color = match self.over_black[v].get(p) {
            Some(head) => head.map(|c| c as f32 / 255.0),
            None => view.photo.rgb[p].map(|c| alpha * c as f32 / 255.0),
        };
        (color, alpha)
    }

    fn draw_one(&self, seed: u64, step: u64, i: u64, jitter: bool) -> Option<(MarchRay, [f32; 3], f32)> {
        let stream = step << 4;
        let v = if self.published {
            rng::below(seed, stream, i, self.views.len() as u64) as usize
        } else {
            let which = rng::below(seed, stream, i, self.count());
            self.cumulative.partition_point(|&c| c <= which)
        };
        let (x0, y0, x1, y1, bits) = &self.drawable[v];
        if x0 > x1 {
            return None; // a view without a drawable pixel
        }
        let view = &self.views[v];
        let width = view.photo.width;
        // rejection inside the box of drawable pixels: a head fills most of its box
        // (published: a pixel that is not valid is dropped, and the batch shrinks)
        for attempt in 0..if self.published { 1 } else { 256 } {
            let k = i << 9 | attempt << 1;
            let x = x0 + rng::below(seed, stream + 1, k, (x1 - x0 + 1) as u64) as u32;
            let y = y0 + rng::below(seed, stream + 1, k | 1, (y1 - y0 + 1) as u64) as u32;
            let p = y as usize * width as usize + x as usize;
            if bits[p >> 6] >> (p & 63) & 1 == 0 {
                continue;
            }
            let Some(ray) = view.camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)) else { continue };
            let shift = if jitter { rng::uniform(seed, stream + 2, i) } else { 0.0 };
            let march = MarchRay {
                origin: (ray.origin * self.radius).to_array(),
                direction: ray.direction.to_array(),
                jitter: shift,
            };
            let (color, alpha) = self.seen(v, p);
            return Some((march, color, alpha));
        }
        None
    }
}

/// Does the line of a ray meet a box? Zero components of its direction count as 1e-6, as published.
fn meets([low, high]: [[f32; 3]; 2], ray: &Ray) -> bool {
    let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
    for a in 0..3 {
        let d = if ray.direction[a] == 0.0 { 1e-6 } else { ray.direction[a] };
        let (p, q) = ((low[a] - ray.origin[a]) / d, (high[a] - ray.origin[a]) / d);
        (enter, leave) = (enter.max(p.min(q)), leave.min(p.max(q)));
    }
    leave > enter
}

/// Where `i` of `0..n` goes in a random order that `key` names: four rounds of a Feistel network over the next power of
/// four, gone round again until it is within (Black and Rogaway 2002, "Ciphers with arbitrary finite domains").
fn permuted(key: u64, i: u64, n: u64) -> u64 {
    let half = (64 - (n - 1).leading_zeros()).div_ceil(2).max(1);
    let low = (1u64 << half) - 1;
    let mut x = i;
    loop {
        let (mut left, mut right) = (x >> half, x & low);
        for round in 0..4 {
            (left, right) = (right, left ^ (rng::bits(key, round, right) & low));
        }
        x = left << half | right;
        if x < n {
            return x;
        }
    }
}

/// Which pixels of a view are drawn.
#[derive(Clone, Copy)]
enum Reach {
    /// None.
    Nothing,
    /// Those within so many scene units of the mask; all where there is no mask.
    Within(f32),
}

/// Box and bits of the pixels worth drawing in one view.
fn drawable(view: &TrainView, reach: Reach) -> (u32, u32, u32, u32, Vec<u64>) {
    let (w, h) = (view.photo.width as usize, view.photo.height as usize);
    let mut near = vec![!matches!(reach, Reach::Nothing); w * h];
    if let (Some(mask), Reach::Within(reach)) = (&view.mask, reach)
        && reach.is_finite()
    {
        // reach in pixels at the box's distance; the nearest part of the box is at most one unit closer
        let distance = (view.camera.position.length() - 1.0).max(0.2);
        let margin = (reach as f64 * view.camera.fx.max(view.camera.fy) / distance).ceil() as usize + 1;
        near = dilated(&mask.values, w, h, margin);
    }
    if let Some(valid) = &view.valid {
        near.iter_mut().zip(&valid.values).for_each(|(n, &v)| *n &= v != 0);
    }
    let mut bits = vec![0u64; (w * h).div_ceil(64)];
    let (mut x0, mut y0, mut x1, mut y1) = (u32::MAX, u32::MAX, 0, 0);
    for (p, _) in near.iter().enumerate().filter(|(_, n)| **n) {
        bits[p >> 6] |= 1 << (p & 63);
        let (x, y) = ((p % w) as u32, (p / w) as u32);
        (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x), y1.max(y));
    }
    (x0, y0, x1, y1, bits)
}

/// Pixels with a non-zero value within a square of half edge `margin`: two one-dimensional passes.
fn dilated(values: &[u8], w: usize, h: usize, margin: usize) -> Vec<bool> {
    let mut near: Vec<bool> = values.iter().map(|&v| v > 0).collect();
    for (lines, step, n, stride) in [(h, w, w, 1), (w, 1, h, w)] {
        for first in (0..lines).map(|line| line * step) {
            // a marked pixel reaches as far ahead as it does behind; what is done is not done again
            let marked: Vec<usize> = (0..n).filter(|i| near[first + i * stride]).collect();
            let mut done = 0;
            for i in marked {
                let end = (i + margin + 1).min(n);
                (i.saturating_sub(margin).max(done)..end).for_each(|k| near[first + k * stride] = true);
                done = end;
            }
        }
    }
    near
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view() -> TrainView {
        let camera = Camera::above(20, 10, 20.0, 4.0);
        let rgb = (0..200).map(|i| [i as u8, 0, 255]).collect();
        let mut values = vec![0; 200];
        values[5 * 20 + 8] = 255;
        TrainView {
            camera,
            photo: Photo { width: 20, height: 10, rgb, alpha: None },
            mask: Some(Gray { width: 20, height: 10, values }),
            valid: None,
        }
    }

    #[test]
    fn only_pixels_near_the_mask_are_drawn_and_carry_their_own_color() {
        // margin = ceil(0.1 · 20 / 3) + 1 = 2: a square of 5 × 5 around (8, 5)
        let views = [view()];
        let pixels = Pixels::new(&views, 0.1, 1.0, Foreground::Photo, false);
        assert_eq!(pixels.count(), 25);
        let batch = pixels.draw(1, 2, 400, true);
        assert_eq!(batch.rays.len(), 400);
        let mut head = 0;
        for (ray, (color, alpha)) in batch.rays.iter().zip(batch.color.iter().zip(&batch.alpha)) {
            let d = ray.direction;
            let (x, y) = (d[0] / -d[2] * 20.0 + 10.0, d[1] / d[2] * 20.0 + 5.0);
            assert!((x - 8.5).abs() < 2.01 && (y - 5.5).abs() < 2.01, "{x} {y}");
            if *alpha > 0.0 {
                // pixel (8, 5) is number 108 and has red 108
                assert!((x - 8.5).abs() < 1e-3 && (y - 5.5).abs() < 1e-3);
                assert!((color[0] * 255.0 - 108.0).abs() < 1e-3);
                head += 1;
            } else {
                assert_eq!(*color, [0.0; 3]);
            }
        }
        assert!(head > 4 && head < 40, "{head} of 400 should be about 16");
    }

    #[test]
    fn a_view_without_a_mask_teaches_nothing_beside_views_with_one() {
        let mut white = view();
        white.mask.as_mut().unwrap().values.fill(255);
        let views = [view(), TrainView { mask: None, ..view() }, white];
        let pixels = Pixels::new(&views, 0.1, 1.0, Foreground::Photo, false);
        assert_eq!(pixels.count(), 25);
        // alone it is drawn from everywhere
        let alone = [TrainView { mask: None, ..view() }];
        assert_eq!(Pixels::new(&alone, 0.1, 1.0, Foreground::Photo, false).count(), 200);
    }

    #[test]
    fn a_permutation_has_every_number_once_and_another_order_for_every_key() {
        for n in [1, 2, 3, 64, 65, 1000] {
            let all = |key: u64| (0..n).map(|i| permuted(key, i, n)).collect::<Vec<u64>>();
            let mut sorted = all(7);
            sorted.sort_unstable();
            assert_eq!(sorted, (0..n).collect::<Vec<u64>>());
            assert!(n < 64 || all(7) != all(8));
        }
        // no order to be seen: neighbors are a third of 1000 apart on average
        let all: Vec<u64> = (0..1000).map(|i| permuted(3, i, 1000)).collect();
        let apart = all.windows(2).map(|w| w[0].abs_diff(w[1])).sum::<u64>() as f64 / 999.0;
        assert!((apart - 333.0).abs() < 30.0, "{apart}");
    }

    #[test]
    fn an_epoch_has_every_valid_pixel_that_meets_the_box_once_with_directions_of_depth_one() {
        let mut one = view();
        let mut valid = vec![255; 200];
        valid[7 * 20 + 9] = 0;
        one.valid = Some(Gray { width: 20, height: 10, values: valid });
        let views = [one, view()];
        // pixels are 1/20 apart at depth 1. The near face at z = 1 is 3 away: |x − 10| < 1.5 · 20 / 3 = 10 has all
        // columns, |y − 5| < 0.4 · 20 / 3 = 2.67 the six rows with centers 0.5, 1.5 and 2.5 off the middle
        let bounds = [[-1.5, -0.4, -1.0], [1.5, 0.4, 1.0]];
        let pixels = Pixels::permuted(&views, Foreground::Photo, bounds, true);
        assert_eq!(pixels.count(), 2 * 20 * 6 - 1);
        // 239 pixels in batches of 50: four a round, and a tail that is left out
        let mut seen = Vec::new();
        for step in 0..4 {
            let batch = pixels.draw(1, step, 50, false);
            assert_eq!(batch.rays.len(), 50);
            for (ray, color) in batch.rays.iter().zip(&batch.color) {
                assert!((ray.direction[2] + 1.0).abs() < 1e-6, "{ray:?}");
                let (x, y) = (ray.direction[0] * 20.0 + 9.5, 4.5 - ray.direction[1] * 20.0);
                assert!((x - x.round()).abs() < 1e-4 && (2.0..=7.0).contains(&y.round()), "{x} {y}");
                seen.push((y.round() as u64 * 20 + x.round() as u64, *color));
            }
        }
        let count = |p: u64| seen.iter().filter(|(q, _)| *q == p).count();
        assert!((0..200).all(|p| count(p) <= 2) && count(7 * 20 + 9) <= 1 && seen.len() == 200);
        // pixel (8, 5), number 108, is head
        let head = seen.iter().filter(|(p, _)| *p == 108);
        assert!(head.clone().count() > 0 && head.clone().all(|(_, c)| (c[0] * 255.0 - 108.0).abs() < 1e-3));
        let first = pixels.draw(1, 0, 50, false).rays;
        assert!(first == pixels.draw(1, 0, 50, false).rays && first != pixels.draw(1, 4, 50, false).rays);
        // more than there are: all of them, once
        assert_eq!(pixels.draw(1, 9, 1000, false).rays.len(), 239);
    }

    #[test]
    fn published_sampling_draws_the_whole_frame_of_every_view_as_often() {
        let views = [view(), view()];
        let pixels = Pixels::new(&views, 0.1, 1.0, Foreground::Photo, true);
        let batch = pixels.draw(1, 2, 2000, false);
        assert_eq!(batch.rays.len(), 2000);
        let left = batch.rays.iter().filter(|r| r.direction[0] < 0.0).count();
        assert!((900..1100).contains(&left), "{left}");
        // one pixel of 200 is head
        let head = batch.alpha.iter().filter(|&&a| a > 0.0).count();
        assert!((2..25).contains(&head), "{head}");
    }

    #[cfg(feature = "wgpu")]
    #[test]
    fn a_device_draws_the_same_rays() {
        use crate::geom::{Distortion, Projection};
        use crate::kernel::gpu::tests::{agree, device, planes};
        let Some(device) = device() else { return };
        let bent = |distortion: Distortion| {
            let mut view = view();
            view.camera.distortion = distortion;
            view.camera.rotation = glam::DMat3::from_rotation_y(0.4) * glam::DMat3::from_rotation_x(-0.2);
            view.mask.as_mut().unwrap().values.iter_mut().enumerate().for_each(|(i, v)| *v = 40 + i as u8);
            view.valid =
                Some(Gray { width: 20, height: 10, values: (0..200).map(|i| (i % 7 > 1) as u8).collect() });
            view
        };
        let perspective = Distortion {
            k1: -0.2,
            k2: 0.05,
            k4: 0.1,
            p1: 0.01,
            p2: -0.02,
            sx1: 0.003,
            ..Distortion::default()
        };
        let fisheye = Distortion { k1: 0.02, k4: -0.01, projection: Projection::Fisheye, ..perspective };
        let fov = Distortion { omega: 0.9, projection: Projection::Fov, ..Distortion::default() };
        let empty = TrainView { mask: None, ..view() };
        let views = [view(), bent(perspective), empty, bent(fisheye), bent(fov)];
        for (foreground, published) in [(Foreground::Estimated, false), (Foreground::Photo, true)] {
            let pixels = Pixels::new(&views, 0.1, 0.3, foreground, published);
            let there = pixels.on_device(&device, !published, true).unwrap();
            let batch = gpu::Batch::new(&device, 2050);
            let (seed, step) = (77, 1 << 33);
            there.draw(&device, (seed, step), &device.upload(&[2000u32]), &batch);
            let want = pixels.draw(seed, step, 2000, !published);
            let alive = device.read::<u32>(&batch.alive);
            assert!(alive[2000..].iter().all(|&a| a == 0));
            let kept: Vec<usize> = (0..2050).filter(|&r| alive[r] == 1).collect();
            // published: pixels that are not valid leave a gap
            assert_eq!((kept.len(), kept.len() < 2000), (want.rays.len(), published));
            let take = |buffer: &gpu::Buffer, planes: usize| -> Vec<f32> {
                let all = device.read::<f32>(buffer);
                (0..planes)
                    .flat_map(|k| kept.iter().map(move |r| (k, *r)))
                    .map(|(k, r)| all[k * 2050 + r])
                    .collect()
            };
            let n = want.rays.len();
            let turned =
                |f: fn(&MarchRay) -> [f32; 3]| planes(&want.rays.iter().map(f).collect::<Vec<_>>(), n);
            agree("drawn origins", &take(&batch.origin, 3), &turned(|r| r.origin), 1e-6);
            agree("drawn directions", &take(&batch.direction, 3), &turned(|r| r.direction), 1e-5);
            agree("drawn colors", &take(&batch.color, 3), &planes(&want.color, n), 1e-6);
            assert_eq!(take(&batch.alpha, 1), want.alpha);
            assert_eq!(take(&batch.jitter, 1), want.rays.iter().map(|r| r.jitter).collect::<Vec<_>>());
            let behind = device.read::<f32>(&batch.background);
            assert_eq!(behind[2050 + 9], rng::uniform(seed, step << 4 | 3, 3 * 9 + 1));
        }
    }
}

//! Sampling of training rays: random pixels of the photographs that carry information about the
//! head.
//!
//! The ray of a pixel farther from the mask than the visual hull's cells reach meets no sample and
//! contributes nothing, so only the mask and a margin around it are drawn. Photographs stay 8 bit.
//!
//! A photograph counts as large if its pixels are finer than the field's final resolution. While
//! the field is still coarser, a ray of a large photograph stands for a square of pixels: it passes
//! through their middle and has their mean color, as if drawn from a level of an image pyramid.
//! Single pixels would alias and act as noise.

use super::soft_pixels::{SoftPixels, soft_pixels};
use super::training::StepAt;
use crate::config::iface::Foreground;
use glam::Vec2;
use rayon::prelude::*;
use std::collections::VecDeque;
use tiface_base::geom::Ray;
use tiface_base::image::dilated;
use tiface_base::math::rng;
use tiface_capture::LoadedView;
use tiface_kernels::cpu::vm::mask::crossing;
#[cfg(feature = "wgpu")]
use tiface_kernels::gpu;

/// Rays drawn for one step, with the colors and alphas of their pixels.
#[derive(Default)]
pub struct HostBatch {
    /// Rays in field coordinates.
    pub rays: Vec<Ray>,
    /// `[rays]` part of a step by which the samples of a ray are shifted.
    pub jitter: Vec<f32>,
    /// `[rays, 3]` head over black, sRGB-coded 0..=1: premultiplied by `alpha`.
    pub color: Vec<[f32; 3]>,
    /// `[rays]` soft alpha; 1 where the view has no mask.
    pub alpha: Vec<f32>,
    /// `[rays]` number of each ray among those drawn, in increasing order. The numbers of pixels
    /// without a ray are missing.
    pub number: Vec<u32>,
}

impl HostBatch {
    /// Adds the ray with this number, and color and alpha of its pixel.
    fn push(&mut self, number: u64, ray: Ray, jitter: f32, (color, alpha): ([f32; 3], f32)) {
        self.rays.push(ray);
        self.jitter.push(jitter);
        self.color.push(color);
        self.alpha.push(alpha);
        self.number.push(number as u32);
    }

    /// Returns both batches as one, this one first.
    fn followed_by(mut self, next: HostBatch) -> HostBatch {
        self.rays.extend(next.rays);
        self.jitter.extend(next.jitter);
        self.color.extend(next.color);
        self.alpha.extend(next.alpha);
        self.number.extend(next.number);
        self
    }

    /// Drops all rays after the first `count`.
    pub fn truncate(&mut self, count: usize) {
        self.rays.truncate(count);
        self.jitter.truncate(count);
        self.color.truncate(count);
        self.alpha.truncate(count);
        self.number.truncate(count);
    }
}

/// Inclusive box of drawable pixels and one bit per pixel.
type Drawable = (u32, u32, u32, u32, Vec<u64>);

/// The drawable pixels of all views.
pub struct RaySampler<'a> {
    views: &'a [LoadedView],
    /// Per view: target colors over black of the soft pixels; `None` if the target is alpha times
    /// the photograph.
    soft: Vec<Option<SoftPixels>>,
    /// Per view: width of a pixel at the scene's center, scene units; infinite if the photograph is
    /// not large.
    pixel: Vec<f32>,
    /// Per view.
    drawable: Vec<Drawable>,
    /// Running count of drawable pixels.
    cumulative: Vec<u64>,
    radius: f32,
    /// Whether any view has a mask that is not white all over.
    pub has_masks: bool,
    reference_sampling: bool,
    /// Order of drawing without repetition; `None` for independent draws.
    order: Option<Order>,
}

/// Order that draws every drawable pixel once, then all again in another order: TensoRF's sampler.
struct Order {
    /// Per view: drawable pixels before each word of its bits.
    before: Vec<Vec<u32>>,
    /// Whether directions have depth 1 along the optical axis instead of length 1.
    depth_directions: bool,
}

impl<'a> RaySampler<'a> {
    /// Collects the drawable pixels of the views. `reach` is how far outside the mask, in scene
    /// units, a ray may still meet an occupied cell.
    ///
    /// `foreground` selects the target color of soft pixels. If some views have masks, views
    /// without one (or with one that is white all over) are not drawn from: they would label the
    /// whole frame as head.
    ///
    /// `reference_sampling` draws as the published code does: a uniformly random view, then a
    /// uniformly random pixel of its frame.
    pub fn new(
        views: &'a [LoadedView],
        reach: f32,
        radius: f32,
        foreground: Foreground,
        reference_sampling: bool,
    ) -> RaySampler<'a> {
        let usable = |v: &LoadedView| v.mask.as_ref().is_some_and(|m| m.values.iter().any(|&a| a < 255));
        let has_masks = views.iter().any(usable);
        let reach = if reference_sampling { f32::INFINITY } else { reach };
        let soft = views
            .par_iter()
            .map(|v| match (&v.mask, foreground) {
                (Some(mask), Foreground::Estimated) => Some(soft_pixels(&v.photo, mask)),
                _ => None,
            })
            .collect();
        let pixel = vec![f32::INFINITY; views.len()];
        let drawable: Vec<_> = views
            .par_iter()
            .map(|v| drawable(v, if has_masks && !usable(v) { None } else { Some(reach) }))
            .collect();
        let cumulative = cumulative(&drawable);
        let order = None;
        RaySampler { views, soft, pixel, drawable, cumulative, radius, has_masks, reference_sampling, order }
    }

    /// Collects pixels as TensoRF's code draws them: all valid ones whose ray meets the box
    /// `bounds` at any distance, in a random order without repetition, which restarts when less
    /// than a batch is left. With `depth_directions`, ray directions have depth 1 along the optical
    /// axis, as in its loader of forward-facing captures.
    ///
    /// The permutation is computed, not stored: for twenty-four photographs of twelve megapixels
    /// its table would take two gigabytes.
    pub fn permuted(
        views: &'a [LoadedView],
        foreground: Foreground,
        bounds: [[f32; 3]; 2],
        depth_directions: bool,
    ) -> RaySampler<'a> {
        let mut sampler = RaySampler::new(views, f32::INFINITY, 1.0, foreground, false);
        sampler.drawable.par_iter_mut().zip(views).for_each(|((.., bits), view)| {
            let width = view.photo.width as usize;
            for (i, word) in bits.iter_mut().enumerate() {
                let valid = *word;
                for bit in (0..64).filter(|bit| valid >> bit & 1 == 1) {
                    let ray = view.camera.ray(center(64 * i + bit, width));
                    let meets = |ray: Ray| {
                        let (enter, leave) = crossing(bounds, ray.origin.into(), ray.direction.into());
                        leave > enter
                    };
                    if !ray.is_some_and(meets) {
                        *word &= !(1 << bit);
                    }
                }
            }
        });
        sampler.cumulative = cumulative(&sampler.drawable);
        let before = |(.., bits): &Drawable| {
            let mut sum = 0;
            let count = |word: &u64| {
                sum += word.count_ones();
                sum - word.count_ones()
            };
            bits.iter().map(count).collect()
        };
        sampler.order =
            Some(Order { before: sampler.drawable.iter().map(before).collect(), depth_directions });
        sampler
    }

    /// Drops three of five pixels where the photograph is smooth, whose neighbors carry the same
    /// information; this leaves more rays for hair and outlines. What lies beside the head counts
    /// as smooth. Without masks, and in large photographs, every pixel stays.
    pub fn thinned(mut self) -> Self {
        if self.has_masks {
            self.drawable = (0..self.views.len()).into_par_iter().map(|v| self.thinned_view(v)).collect();
            self.cumulative = cumulative(&self.drawable);
        }
        self
    }

    /// Returns the drawable pixels of a view without those that [`RaySampler::thinned`] drops.
    fn thinned_view(&self, v: usize) -> Drawable {
        let (x0, y0, x1, y1, mut bits) = self.drawable[v].clone();
        if x0 > x1 || self.pixel[v].is_finite() {
            return (x0, y0, x1, y1, bits);
        }
        let (w, h) = (self.views[v].photo.width as usize, self.views[v].photo.height as usize);
        let around = |at: usize, n: usize| at.saturating_sub(SMOOTH_PX)..(at + SMOOTH_PX + 1).min(n);
        let (left, right) = (around(x0 as usize, w).start, around(x1 as usize, w).end);
        // color over black and alpha of the columns that windows meet
        let row = |y: usize| -> Vec<[u32; 4]> {
            let values = |p: usize| {
                let ([r, g, b], a) = self.pixel(v, p);
                let share = if self.soft[v].is_some() { 255 } else { u32::from(a) };
                let [r, g, b] = [r, g, b].map(|c| u32::from(c) * share / 255);
                [r, g, b, u32::from(a)]
            };
            (y * w + left..y * w + right).map(values).collect()
        };
        // the rows around the one that is looked at
        let mut rows: VecDeque<Vec<[u32; 4]>> = VecDeque::new();
        let mut read = around(y0 as usize, h).start;
        for y in y0 as usize..=y1 as usize {
            let window = around(y, h);
            while read < window.end {
                rows.push_back(row(read));
                read += 1;
            }
            while rows.len() > window.len() {
                rows.pop_front();
            }
            // of each column, sums of values and of their squares
            let column = |x: usize| {
                let mut sums = [[0u32; 4]; 2];
                for row in &rows {
                    for c in 0..4 {
                        sums[0][c] += row[x][c];
                        sums[1][c] += row[x][c] * row[x][c];
                    }
                }
                sums
            };
            let columns: Vec<[[u32; 4]; 2]> = (0..right - left).map(column).collect();
            for x in (x0 as usize..=x1 as usize).filter(|x| !KEPT[(x + 2 * y) % KEPT.len()]) {
                let near = around(x, w);
                let count = (near.len() * rows.len()) as u32;
                let mut sums = [[0u32; 4]; 2];
                for column in &columns[near.start - left..near.end - left] {
                    for k in 0..2 {
                        (0..4).for_each(|c| sums[k][c] += column[k][c]);
                    }
                }
                let spread = |c: usize| count * sums[1][c] - sums[0][c] * sums[0][c];
                if (0..4).map(spread).sum::<u32>() < SMOOTH * count * count {
                    let p = y * w + x;
                    bits[p >> 6] &= !(1 << (p & 63));
                }
            }
        }
        (x0, y0, x1, y1, bits)
    }

    /// Treats photographs as large whose pixels, at the scene's center, are finer than `finest`,
    /// the field's final resolution in scene units.
    pub fn with_large(mut self, finest: f32) -> Self {
        for (width, view) in self.pixel.iter_mut().zip(self.views) {
            let camera = &view.camera;
            let pixel = (camera.position.length() / camera.fx.max(camera.fy)) as f32;
            *width = if pixel < finest { pixel } else { f32::INFINITY };
        }
        self
    }

    /// Returns the photographs.
    pub fn views(&self) -> &'a [LoadedView] {
        self.views
    }

    /// Returns the number of drawable pixels of all views.
    pub fn count(&self) -> u64 {
        self.cumulative.last().copied().unwrap_or(0)
    }

    /// Draws `count` random rays of a step, which depend on seed and step alone. A ray of a large
    /// photograph stands for a square of pixels, the widest of [`SIDES`] that is at most `detail`
    /// wide, in scene units.
    pub fn draw(&self, seed: u64, step: u64, count: usize, jitter: bool, detail: f32) -> HostBatch {
        let draw = |mut batch: HostBatch, i: usize| {
            let i = i as u64;
            match &self.order {
                Some(order) => self.draw_next(order, (seed, step), (i, count as u64), jitter, &mut batch),
                None => self.draw_one((seed, step), i, jitter, detail, &mut batch),
            }
            batch
        };
        let parts = (0..count).into_par_iter().with_min_len(256).fold(HostBatch::default, draw);
        // in the order of the rays
        parts.reduce(HostBatch::default, HostBatch::followed_by)
    }

    /// Copies the photographs to a device, in buffers of at most `largest` bytes. The device draws
    /// the same rays from them.
    #[cfg(feature = "wgpu")]
    pub fn on_device(
        &self,
        device: &gpu::Device,
        drawing: gpu::SamplingOptions,
        largest: u64,
    ) -> gpu::Photographs {
        let order = match &self.order {
            Some(order) => gpu::PixelOrder::Permuted { depth_directions: order.depth_directions },
            None if self.reference_sampling => gpu::PixelOrder::EachView,
            None => gpu::PixelOrder::Random,
        };
        // Packing one photograph per thread at a time bounds the extra memory: packed photographs
        // are as large as the originals.
        let (count, threads) = (self.views.len(), rayon::current_num_threads());
        let pack = |first: usize| -> Vec<gpu::DrawnView> {
            (first..count.min(first + threads)).into_par_iter().map(|v| self.packed_view(v)).collect()
        };
        let views = (0..count).step_by(threads).flat_map(pack);
        gpu::Photographs::new(device, views, &self.buffers_on_device(largest), self.radius, order, drawing)
    }

    /// Returns how many pixels each buffer of the photographs holds on a device whose buffers have
    /// at most `largest` bytes.
    #[cfg(feature = "wgpu")]
    pub fn buffers_on_device(&self, largest: u64) -> Vec<u64> {
        let mut buffers = vec![0];
        for area in
            self.drawable.iter().map(|view| drawable_box(view)[2] as u64 * drawable_box(view)[3] as u64)
        {
            match buffers.last_mut() {
                Some(last) if 4 * (*last + area) <= largest => *last += area,
                _ => buffers.push(area),
            }
        }
        buffers
    }

    /// Packs the box of a view's drawable pixels for a device.
    #[cfg(feature = "wgpu")]
    fn packed_view(&self, v: usize) -> gpu::DrawnView {
        let view = &self.views[v];
        let (.., bits) = &self.drawable[v];
        let [x, y, width, height] = drawable_box(&self.drawable[v]);
        let mut pixels = Vec::with_capacity((width * height) as usize);
        let mut drawable = vec![0u32; (width * height).div_ceil(32) as usize];
        for row in y..y + height {
            let first = row as usize * view.photo.width as usize;
            for p in first + x as usize..first + (x + width) as usize {
                let ([r, g, b], alpha) = self.pixel(v, p);
                drawable[pixels.len() / 32] |= ((bits[p >> 6] >> (p & 63) & 1) as u32) << (pixels.len() % 32);
                pixels.push(u32::from_le_bytes([r, g, b, alpha]));
            }
        }
        gpu::DrawnView {
            camera: view.camera.clone(),
            part: [x, y, width, height],
            pixels,
            over_black: self.soft[v].is_some(),
            pixel: self.pixel[v],
            drawable,
        }
    }

    /// Draws ray `i` of `count` in the order without repetition into a batch.
    fn draw_next(
        &self,
        order: &Order,
        (seed, step): (u64, u64),
        (i, count): (u64, u64),
        jitter: bool,
        batch: &mut HostBatch,
    ) {
        let Some(which) = rng::Permutation::of_step((seed, step), count, self.count()).get(i) else { return };
        let v = self.cumulative.partition_point(|&c| c <= which);
        let rank = (which - if v > 0 { self.cumulative[v - 1] } else { 0 }) as u32;
        let word = order.before[v].partition_point(|&b| b <= rank) - 1;
        let mut bits = self.drawable[v].4[word];
        (order.before[v][word]..rank).for_each(|_| bits &= bits - 1);
        let p = 64 * word + bits.trailing_zeros() as usize;
        let view = &self.views[v];
        let Some(ray) = view.camera.ray(center(p, view.photo.width as usize)) else { return };
        let jitter = if jitter { rng::uniform(seed, (step << 4) + 2, i) } else { 0.0 };
        let depth = if order.depth_directions { ray.direction.dot(view.camera.forward()) } else { 1.0 };
        let ray = Ray::new(ray.origin, ray.direction / depth);
        batch.push(i, ray, jitter, self.premultiplied_color(v, p));
    }

    /// Returns color and alpha of pixel `p` of view `v`. The color is already over black if the
    /// view has soft pixels.
    fn pixel(&self, v: usize, p: usize) -> ([u8; 3], u8) {
        let view = &self.views[v];
        let alpha = view.mask.as_ref().map_or(255, |m| m.values[p]);
        match (&self.soft[v], &view.mask) {
            (Some(soft), Some(mask)) => (soft.over_black(&view.photo, mask, p), alpha),
            _ => (view.photo.rgb[p], alpha),
        }
    }

    /// Returns the target color over black of pixel `p` of view `v`, and its alpha.
    fn premultiplied_color(&self, v: usize, p: usize) -> ([f32; 3], f32) {
        let (color, alpha) = self.pixel(v, p);
        let alpha = alpha as f32 / 255.0;
        let share = if self.soft[v].is_some() { 1.0 } else { alpha };
        (color.map(|c| share * c as f32 / 255.0), alpha)
    }

    /// Returns the middle of the drawable pixels of the square with its corner at `at`, and their
    /// mean color and alpha.
    fn square(&self, v: usize, at: [u32; 2], side: u32) -> (Vec2, ([f32; 3], f32)) {
        let (.., bits) = &self.drawable[v];
        let photo = &self.views[v].photo;
        let (mut middle, mut color, mut alpha, mut count) = ([0u32; 2], [0u32; 3], 0u32, 0u32);
        for y in at[1]..(at[1] + side).min(photo.height) {
            for x in at[0]..(at[0] + side).min(photo.width) {
                let p = y as usize * photo.width as usize + x as usize;
                if bits[p >> 6] >> (p & 63) & 1 == 1 {
                    let (rgb, a) = self.pixel(v, p);
                    let share = if self.soft[v].is_some() { 255 } else { a as u32 };
                    (0..3).for_each(|c| color[c] += share * rgb[c] as u32);
                    middle = [middle[0] + x - at[0], middle[1] + y - at[1]];
                    alpha += a as u32;
                    count += 1;
                }
            }
        }
        let mean = |sum: u32, whole: u32| sum as f32 / (whole * count) as f32;
        let middle = [0, 1].map(|a| at[a] as f32 + mean(middle[a], 1) + 0.5);
        (Vec2::from(middle), (color.map(|sum| mean(sum, 255 * 255)), mean(alpha, 255)))
    }

    /// Draws ray `i` independently of the others into a batch.
    fn draw_one(&self, (seed, step): (u64, u64), i: u64, jitter: bool, detail: f32, batch: &mut HostBatch) {
        let stream = step << 4;
        let v = if self.reference_sampling {
            rng::below(seed, stream, i, self.views.len() as u64) as usize
        } else {
            let which = rng::below(seed, stream, i, self.count());
            self.cumulative.partition_point(|&c| c <= which)
        };
        let (x0, y0, x1, y1, bits) = &self.drawable[v];
        if x0 > x1 {
            return; // the view has no drawable pixel
        }
        let view = &self.views[v];
        let width = view.photo.width;
        // Rejection sampling in the box of drawable pixels is cheap, because a head fills most of
        // its box. (The published code drops a pixel that is not valid, and the batch shrinks.)
        for attempt in 0..if self.reference_sampling { 1 } else { 256 } {
            let k = i << 9 | attempt << 1;
            let x = x0 + rng::below(seed, stream + 1, k, (x1 - x0 + 1) as u64) as u32;
            let y = y0 + rng::below(seed, stream + 1, k | 1, (y1 - y0 + 1) as u64) as u32;
            let p = y as usize * width as usize + x as usize;
            if bits[p >> 6] >> (p & 63) & 1 == 0 {
                continue;
            }
            let side = side(self.pixel[v], detail);
            let (at, pixel) = if side == 1 {
                (Vec2::new(x as f32 + 0.5, y as f32 + 0.5), self.premultiplied_color(v, p))
            } else {
                self.square(v, [x, y].map(|at| at / side * side), side)
            };
            let Some(ray) = view.camera.ray(at) else { continue };
            let jitter = if jitter { rng::uniform(seed, stream + 2, i) } else { 0.0 };
            return batch.push(i, ray.scaled(self.radius), jitter, pixel);
        }
    }
}

/// Half edge of the window in which a photograph is smooth or not, in pixels.
const SMOOTH_PX: usize = 2;

/// Variance below which a window is smooth: the sum of those of the colors over black and of alpha,
/// in units of 8 bits squared.
const SMOOTH: u32 = 36;

/// Which pixels of a smooth row are kept. Each row is shifted by two against the one before, so
/// that in the frame every dropped pixel has a neighbor in its row that is kept.
const KEPT: [bool; 5] = [true, false, true, false, false];

/// Widest pixel of a large photograph, scene units: a thousandth of the scene's width. Coarser
/// photographs are sampled pixel by pixel from the first step, however coarse the field is.
pub const LARGE: f32 = 2.0 / 1000.0;

/// Possible widths of a square, in pixels.
pub const SIDES: [u32; 4] = [1, 2, 4, 8];

/// Returns the side in pixels of the widest square that is at most `detail` wide, for pixels of
/// width `pixel`; at least 1.
fn side(pixel: f32, detail: f32) -> u32 {
    SIDES.into_iter().rfind(|&side| side as f32 * pixel <= detail).unwrap_or(1)
}

/// Returns the running count of drawable pixels, up to and including each view.
fn cumulative(drawable: &[Drawable]) -> Vec<u64> {
    let mut sum = 0;
    let count = |(.., bits): &Drawable| {
        sum += bits.iter().map(|word| u64::from(word.count_ones())).sum::<u64>();
        sum
    };
    drawable.iter().map(count).collect()
}

/// Returns corner and size of the box of drawable pixels.
#[cfg(feature = "wgpu")]
fn drawable_box(&(x0, y0, x1, y1, _): &Drawable) -> [u32; 4] {
    if x0 > x1 { [0; 4] } else { [x0, y0, x1 - x0 + 1, y1 - y0 + 1] }
}

/// Returns the center of pixel `p`.
fn center(p: usize, width: usize) -> Vec2 {
    Vec2::new((p % width) as f32 + 0.5, (p / width) as f32 + 0.5)
}

/// Returns box and bits of the pixels to draw from in one view: those within `reach` scene units of
/// the mask, or all without a mask; none if `reach` is `None`.
fn drawable(view: &LoadedView, reach: Option<f32>) -> Drawable {
    let (w, h) = (view.photo.width as usize, view.photo.height as usize);
    let mut in_reach = vec![reach.is_some(); w * h];
    if let (Some(mask), Some(reach)) = (&view.mask, reach)
        && reach.is_finite()
    {
        // The reach in pixels is largest at the nearest part of the box, at most one unit closer
        // than its center.
        let distance = (view.camera.position.length() - 1.0).max(0.2);
        let margin = (reach as f64 * view.camera.fx.max(view.camera.fy) / distance).ceil() as usize + 1;
        in_reach = dilated(mask.values.iter().map(|&v| v > 0).collect(), w, h, margin, margin);
    }
    if let Some(valid) = &view.valid {
        in_reach.iter_mut().zip(&valid.values).for_each(|(n, &v)| *n &= v != 0);
    }
    let mut bits = vec![0u64; (w * h).div_ceil(64)];
    let (mut x0, mut y0, mut x1, mut y1) = (u32::MAX, u32::MAX, 0, 0);
    for (p, _) in in_reach.iter().enumerate().filter(|(_, n)| **n) {
        bits[p >> 6] |= 1 << (p & 63);
        let (x, y) = ((p % w) as u32, (p / w) as u32);
        (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x), y1.max(y));
    }
    (x0, y0, x1, y1, bits)
}

/// Returns the background color of each ray, used for both target and render: random colors from
/// the given random stream, or black without one.
pub fn ray_backgrounds(at: StepAt, stream: Option<u64>, rays: usize) -> Vec<[f32; 3]> {
    let Some(stream) = stream else { return vec![[0.0; 3]; rays] };
    let channel = |i: u64| rng::uniform(at.seed, at.step << 4 | stream, i);
    (0..rays as u64).map(|r| std::array::from_fn(|c| channel(3 * r + c as u64))).collect()
}

#[cfg(test)]
#[path = "pixels_tests.rs"]
mod tests;

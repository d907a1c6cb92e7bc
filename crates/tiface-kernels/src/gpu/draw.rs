//! Sampling of random rays from photographs in device memory: 8 bits a channel, cropped to the box
//! of drawable pixels.
//!
//! The pixel of a ray depends on seed, step and the ray's index alone, as on the CPU.

use super::batch::{DeviceBatch, RayArrays};
use super::device::{Buffer, Device, Words, groups, launch};
use super::lens::{number, undistort};
use super::rng::{Wide, below, permuted, stream, uniform, word};
use super::running_counts::{ranked, upper_bound};
use super::vec3::Vec3;
use burn::cubecl::server::Handle;
use burn::cubecl::{self, prelude::*};
use tiface_base::geom::{Camera, Projection};
use tiface_base::math::rng;

const UNITS: u32 = 256;

/// Words that describe a photograph: pixels drawable up to and with it, box, its first pixel and
/// the buffer that holds it, its first word of drawable bits, whether color is over black already,
/// focal lengths, principal point, lens, rotation by columns, position, width of a pixel.
const VIEW: usize = 39;
const FIRST_PIXEL: usize = 5;
const BUFFER: usize = 6;
const FIRST_WORD: usize = 7;
const OVER_BLACK: usize = 8;
/// First word of the camera.
const CAMERA: usize = 9;
const LENS: usize = CAMERA + 4;
const ROTATION: usize = LENS + 13;
const POSITION: usize = ROTATION + 9;
const PIXEL: usize = POSITION + 3;

/// Attempts to draw a drawable pixel from the box before a ray is given up.
const TRIES: u32 = 256;

/// Buffers of pixels: no adapter binds more than 2³¹ bytes at once, however much memory it has.
pub const BUFFERS: usize = 4;

/// A packed photograph to draw from.
pub struct DrawnView {
    /// Camera in scene coordinates.
    pub camera: Camera,
    /// First column and row of the box of drawable pixels, its width and height; a width of 0 means
    /// none.
    pub part: [u32; 4],
    /// The box's pixels, row by row: red, green, blue and alpha, from the lowest byte on.
    pub pixels: Vec<u32>,
    /// Whether the colors are the head's over black already; otherwise they are the photograph's,
    /// to be multiplied by alpha.
    pub over_black: bool,
    /// One bit per pixel of the box, from the lowest of each word: whether the pixel is drawable.
    pub drawable: Vec<u32>,
    /// The width of a pixel at the scene's middle, scene units, where rays may stand for squares of
    /// pixels; else infinite.
    pub pixel: f32,
}

impl DrawnView {
    fn words(&self, cumulative: u32, [pixel, buffer, word]: [usize; 3], radius: f32) -> [u32; VIEW] {
        let (c, d) = (&self.camera, &self.camera.distortion);
        let projection = match d.projection {
            Projection::Perspective => 0u32,
            Projection::Fisheye => 1,
            Projection::Fov => 2,
        };
        let camera = [c.fx, c.fy, c.cx, c.cy].map(|v| v as f32);
        let bends = [d.k1, d.k2, d.k3, d.k4, d.k5, d.k6, d.p1, d.p2, d.sx1, d.sy1, d.omega];
        let mut words = vec![cumulative];
        words.extend(self.part);
        words.extend([pixel, buffer, word].map(|at| u32::try_from(at).expect("fewer than 2³² pixels")));
        words.push(u32::from(self.over_black));
        words.extend(camera.map(f32::to_bits));
        words.extend([projection, u32::from(d.is_none())]);
        words.extend(bends.map(|v| (v as f32).to_bits()));
        words.extend(c.rotation.to_cols_array().map(|v| (v as f32).to_bits()));
        words.extend((c.position.as_vec3() * radius).to_array().map(f32::to_bits));
        words.push(self.pixel.to_bits());
        words.try_into().expect("as many words as a view has")
    }
}

/// Three floats of a view.
#[cube]
fn vector(views: &[u32], view: usize, i: usize) -> Vec3 {
    Vec3::new(number(views, view, i), number(views, view, i + 1), number(views, view, i + 2))
}

/// The photographs as kernels see them; [`Photographs`] documents the arrays.
#[derive(CubeType, CubeLaunch)]
struct PhotographArrays {
    views: Box<[u32]>,
    pixels0: Box<[u32]>,
    pixels1: Box<[u32]>,
    pixels2: Box<[u32]>,
    pixels3: Box<[u32]>,
    drawable: Box<[u32]>,
    before: Box<[u32]>,
}

/// The random numbers of a step: keys of streams, and the permutation of all drawable pixels.
#[derive(CubeType, CubeLaunch)]
struct StepDraws {
    view: Wide,
    pixel: Wide,
    jitter: Wide,
    background: Wide,
    permutation: Wide,
    /// Half the number of bits of a permuted index.
    half_bits: u32,
    /// Place of the step's first ray in the order of the permutation.
    first: u32,
}

/// Sums over the drawable pixels of a square.
#[derive(CubeType, cubecl::CubeTypeMut, Clone, Copy)]
struct Square {
    x: u32,
    y: u32,
    red: u32,
    green: u32,
    blue: u32,
    alpha: u32,
    count: u32,
}

/// Returns whether pixel `at` of a view's box is drawable.
#[cube]
fn is_drawable(photographs: &PhotographArrays, view: usize, at: u32) -> bool {
    let word = photographs.views[view + FIRST_WORD] + (at >> 5);
    (photographs.drawable[word as usize] >> (at & 31)) & 1 == 1
}

/// Returns pixel `at` of a view's box.
#[cube]
fn pixel_at(photographs: &PhotographArrays, view: usize, at: u32) -> u32 {
    let at = (photographs.views[view + FIRST_PIXEL] + at) as usize;
    let buffer = photographs.views[view + BUFFER];
    if buffer == 0 {
        photographs.pixels0[at]
    } else if buffer == 1 {
        photographs.pixels1[at]
    } else if buffer == 2 {
        photographs.pixels2[at]
    } else {
        photographs.pixels3[at]
    }
}

/// Sums the square around a pixel of a view's box, at most `detail` wide; column and row are
/// relative to the box.
#[cube]
fn square(photographs: &PhotographArrays, view: usize, column: u32, row: u32, detail: f32) -> Square {
    let views = &photographs.views;
    let (x0, y0, width, height) = (views[view + 1], views[view + 2], views[view + 3], views[view + 4]);
    let mut side = 1u32;
    for _ in 0..3u32 {
        let wider = f32::cast_from(2 * side) * number(views, view, PIXEL) <= detail;
        side = select(wider, 2 * side, side);
    }
    // squares begin at multiples of their width in the whole photograph
    let (left, top) = ((x0 + column) / side * side, (y0 + row) / side * side);
    let mut sums = Square { x: 0u32, y: 0u32, red: 0u32, green: 0u32, blue: 0u32, alpha: 0u32, count: 0u32 };
    for y in max(top, y0)..min(top + side, y0 + height) {
        for x in max(left, x0)..min(left + side, x0 + width) {
            let at = (y - y0) * width + x - x0;
            if is_drawable(photographs, view, at) {
                let pixel = pixel_at(photographs, view, at);
                let alpha = pixel >> 24;
                let share = select(views[view + OVER_BLACK] == 1, 255u32, alpha);
                sums.x += x;
                sums.y += y;
                sums.red += share * (pixel & 255);
                sums.green += share * ((pixel >> 8) & 255);
                sums.blue += share * ((pixel >> 16) & 255);
                sums.alpha += alpha;
                sums.count += 1;
            }
        }
    }
    sums
}

#[cube(launch)]
fn draw_rays(
    photographs: &PhotographArrays,
    wanted: &[u32],
    mut rays: RayArrays,
    draws: &StepDraws,
    detail: f32,
    #[comptime] order: PixelOrder,
    #[comptime] shifted: bool,
    #[comptime] random: bool,
) {
    let count = rays.jitter.len();
    let r = ABSOLUTE_POS;
    if r < count {
        let views = &photographs.views;
        let i = u32::cast_from(r);
        let all = views.len() / VIEW;
        let pixels = views[(all - 1) * VIEW];
        // Index of the pixel among all drawable ones, unless views are drawn first.
        let mut which = 0u32;
        let mut wanted = i < wanted[0];
        let view = if comptime!(order == PixelOrder::EachView) {
            below(&draws.view, i, u32::cast_from(all)) as usize
        } else {
            if comptime!(order.is_permuted()) {
                // A batch may be larger than the number of drawable pixels.
                wanted = wanted && draws.first + i < pixels;
                which = permuted(&draws.permutation, draws.half_bits, (draws.first + i) % pixels, pixels);
            } else {
                which = below(&draws.view, i, pixels);
            }
            // the first view whose running count exceeds the pixel's index
            upper_bound(views, 0usize, all, which, VIEW)
        };
        let view = view * VIEW;
        let (width, height) = (views[view + 3], views[view + 4]);
        let mut found = false;
        // rejection inside the box: a head fills most of it
        let mut attempt = 0u32;
        let mut last = 0u32;
        if wanted && width > 0 {
            last = comptime!(if order == PixelOrder::Random { TRIES } else { 1u32 }).runtime();
        }
        let mut x = 0.0f32;
        let mut y = 0.0f32;
        let mut sums =
            Square { x: 0u32, y: 0u32, red: 0u32, green: 0u32, blue: 0u32, alpha: 0u32, count: 1u32 };
        while attempt < last {
            let at = if comptime!(order.is_permuted()) {
                let mut rank = which;
                if view > 0 {
                    rank = which - views[view - VIEW];
                }
                let words = (width * height).div_ceil(32u32) as usize;
                let first = views[view + FIRST_WORD] as usize;
                ranked(&photographs.before, &photographs.drawable, first, words, rank)
            } else {
                let k = (i << 9) | (attempt << 1);
                let column = below(&draws.pixel, k, width);
                below(&draws.pixel, k | 1, height) * width + column
            };
            attempt += 1;
            if is_drawable(photographs, view, at) {
                sums = square(photographs, view, at % width, at / width, detail);
                let whole = f32::cast_from(sums.count);
                let (u, v) = (f32::cast_from(sums.x) / whole, f32::cast_from(sums.y) / whole);
                let xd = (u + 0.5f32 - number(views, view, CAMERA + 2)) / number(views, view, CAMERA);
                let yd = (v + 0.5f32 - number(views, view, CAMERA + 3)) / number(views, view, CAMERA + 1);
                // pictures have y down
                let d = undistort(views, view + LENS, xd, yd);
                x = d.x;
                y = -d.y;
                found = d.found;
                last = select(found, 0u32, last);
            }
        }
        let kept = select(found, 1u32, 0u32);
        let full = f32::cast_from(255 * sums.count);
        rays.alive[r] = kept;
        rays.alpha[r] = f32::cast_from(kept * sums.alpha) / full;
        let (red, green, blue) = (kept * sums.red, kept * sums.green, kept * sums.blue);
        let color = Vec3::new(f32::cast_from(red), f32::cast_from(green), f32::cast_from(blue));
        (color / (255.0f32 * full)).write(&mut rays.color, count, r);
        // cameras look along −Z
        let mut over = 1.0f32;
        if comptime!(order != PixelOrder::Permuted { depth_directions: true }) {
            over = 1.0f32 / (x * x + y * y + 1.0f32).sqrt();
        }
        let (right, up) = (vector(views, view, ROTATION), vector(views, view, ROTATION + 3));
        let back = vector(views, view, ROTATION + 6);
        ((right * x + up * y - back) * over).write(&mut rays.direction, count, r);
        vector(views, view, POSITION).write(&mut rays.origin, count, r);
        let mut shift = 0.0f32;
        if shifted {
            shift = uniform(&draws.jitter, i);
        }
        rays.jitter[r] = shift;
        #[unroll]
        for c in 0..3u32 {
            let mut channel = 0.0f32;
            if random {
                channel = uniform(&draws.background, 3 * i + c);
            }
            rays.background[c as usize * count + r] = channel;
        }
    }
}

/// Order in which pixels are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PixelOrder {
    /// Any drawable pixel, each as likely.
    Random,
    /// Every photograph as often, any pixel of its box once: without a ray where that is not
    /// drawable.
    EachView,
    /// Every drawable pixel once, then again in another order.
    Permuted {
        /// Directions have depth 1 in front of the camera, not length 1.
        depth_directions: bool,
    },
}

impl PixelOrder {
    /// Returns whether every pixel is drawn once before any is drawn again.
    pub fn is_permuted(self) -> bool {
        matches!(self, PixelOrder::Permuted { .. })
    }
}

/// Options for drawing rays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SamplingOptions {
    /// Whether each ray's first sample is shifted by a random part of a step.
    pub jitter: bool,
    /// Whether each ray has a random background color, rather than black.
    pub background: bool,
    /// Random stream of the background colors.
    pub background_stream: u64,
}

/// Photographs on a device.
pub struct Photographs {
    views: Buffer,
    pixels: [Buffer; BUFFERS],
    drawable: Buffer,
    /// Drawable pixels of the view before each word of `drawable`; of one word where pixels are not
    /// permuted.
    before: Buffer,
    /// Drawable pixels of all views.
    count: u32,
    order: PixelOrder,
    drawing: SamplingOptions,
}

impl Photographs {
    /// Copies photographs to the device, one after the other, into buffers of the given sizes in
    /// pixels, first fit; the field's coordinates are the scene's times `radius`.
    ///
    /// # Panics
    ///
    /// Panics if no pixel is drawable, if 2³² pixels are, or with more than [`BUFFERS`] buffers.
    pub fn new(
        device: &Device,
        seen: impl Iterator<Item = DrawnView>,
        buffers: &[u64],
        radius: f32,
        order: PixelOrder,
        drawing: SamplingOptions,
    ) -> Photographs {
        assert!(buffers.len() <= BUFFERS, "{} buffers of pixels", buffers.len());
        let pixels: [Buffer; BUFFERS] =
            std::array::from_fn(|b| device.scratch::<u32>(buffers.get(b).map_or(1, |&n| n as usize)));
        let (mut views, mut drawable, mut before) = (Vec::new(), Vec::new(), Vec::new());
        let (mut cumulative, mut buffer, mut first) = (0u32, 0, 0);
        for view in seen {
            let area = (view.part[2] * view.part[3]) as usize;
            assert!(view.pixels.len() == area && view.drawable.len() == area.div_ceil(32));
            if (first + area) as u64 > buffers[buffer] {
                (buffer, first) = (buffer + 1, 0);
            }
            let mut own = 0;
            for word in &view.drawable {
                before.push(own);
                own += word.count_ones();
            }
            cumulative = cumulative.checked_add(own).expect("fewer than 2³² pixels");
            views.extend(view.words(cumulative, [first, buffer, drawable.len()], radius));
            drawable.extend(view.drawable);
            if area > 0 {
                device.write(&pixels[buffer], first, view.pixels);
            }
            first += area;
        }
        assert!(cumulative > 0, "no pixel is drawable");
        before.truncate(if order.is_permuted() { usize::MAX } else { 1 });
        let [views, drawable, before] = [views, drawable, before].map(|words| device.upload_vec(words));
        Photographs { views, pixels, drawable, before, count: cumulative, order, drawing }
    }

    fn arrays(&self) -> [&Buffer; 7] {
        let Photographs { views, pixels: [a, b, c, d], drawable, before, .. } = self;
        [views, a, b, c, d, drawable, before]
    }

    /// Returns the buffers as a kernel argument.
    fn arg(&self) -> PhotographArraysLaunch {
        let [views, a, b, c, d, drawable, before] = self.arrays().map(Words::arg);
        PhotographArraysLaunch::new(views, a, b, c, d, drawable, before)
    }

    /// Returns the handles of the buffers' memory.
    fn handles(&self) -> [&Handle; 7] {
        self.arrays().map(|buffer| &buffer.handle)
    }

    /// Draws the rays of a step, which depend on seed and step alone. A ray of a large photograph
    /// stands for a square of pixels at most `detail` wide.
    ///
    /// # Shapes
    ///
    /// - wanted: `[1]`, number of rays to draw; the remaining rays of `into` are marked inactive
    pub fn draw(
        &self,
        device: &Device,
        (seed, step): (u64, u64),
        wanted: &Buffer,
        into: &DeviceBatch,
        detail: f32,
    ) {
        let [view, pixel, shift, background] =
            [0, 1, 2, self.drawing.background_stream].map(|k| stream(seed, step << 4 | k));
        assert!(into.rays() < 1 << 22, "the number of a try has 32 bits");
        let permutation = rng::Permutation::of_step((seed, step), into.rays() as u64, self.count as u64);
        let (key, first) = (word(permutation.key), permutation.first as u32);
        let draws = StepDrawsLaunch::new(view, pixel, shift, background, key, permutation.half_bits, first);
        launch!(device, draw_rays::launch, groups(into.rays().div_ceil(UNITS as usize)), UNITS;
            self, wanted, into;
            draws, detail, self.order, self.drawing.jitter, self.drawing.background
        );
    }
}

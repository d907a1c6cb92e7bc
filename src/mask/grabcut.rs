//! Clicks → hard mask: GrabCut (Rother, Kolmogorov, Blake 2004) from a Voronoi start.
//!
//! Head and background are mixtures of colors, learned from the labels that the last round gave; a
//! round's labels are the smallest cut of
//!
//! ```text
//! E = Σ_p −ln p(c_p | label) + γ Σ_pq exp(−β ‖c_p − c_q‖²) / |p − q| · [labels differ]
//! β = 1 / (2 ⟨‖Δ‖²⟩)
//! ```
//!
//! over 8 neighbors. At the end only pieces with a click stay, small holes are filled and threads
//! are opened.
//!
//! Definite head are discs around the head's clicks; definite background are discs around the
//! others and margins along the top and the upper part of both sides. Everything else starts as
//! head when it is nearer to the head's clicks, joined by a line, than to definite background: this
//! Voronoi start follows the size of the head, which no fixed radius does.

pub mod maxflow;
pub mod mixture;
pub mod seeds;

use self::maxflow::PixelGraph;
use self::mixture::{Mixture, Rgb};
use self::seeds::{BORDER_MARGIN, Seed, from_clicks, skeleton, start};
use super::clicks::{self, Click};
use super::morphology::{fill_holes, gray, keep_pieces, open};
use tiface_base::image::{Gray, Photo, grow, reduce_to_rows};
use tiface_base::{Error, Result};

/// Rows of the working size; larger photographs are averaged down to it.
pub(super) const ROWS: u32 = 512;
/// Gaussians per mixture (Rother, Kolmogorov, Blake 2004, §3.1).
const GAUSSIANS: usize = 5;
/// γ: cost of a label change between equal colors (§2.2 of the same).
const SMOOTHNESS: f64 = 50.0;
/// λ/γ: cost of contradicting a click or border margin.
const SEED_WEIGHT: f64 = 9.0;
/// Rounds of fitting and cutting from clicks.
pub(super) const ROUNDS: usize = 8;
/// Holes up to this share of the picture are filled.
const MAX_HOLE_SHARE: f64 = 0.01;
/// Distance from the outline, as a share of the height, within which undecided colors count as
/// ambiguous.
const OUTLINE_BAND: f32 = 0.023;
/// Seed of the k-means start.
const SEED: u64 = 42;
/// Whole-number capacities per unit of energy.
const CAPACITY_SCALE: f64 = 1000.0;

/// A hard mask at the working size.
#[derive(Clone, Debug, PartialEq)]
pub struct HardMask {
    /// 255 head, 0 background.
    pub mask: Gray,
    /// Share of the picture, 0..=1, that lies near the outline and has a color that fits both
    /// sides.
    pub ambiguous: f64,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Cuts the head out of one photograph. `view` is its name in messages; clicks are pixels of
/// `photo`.
///
/// # Errors
/// When clicks lie outside, contradict each other or name no head, and when nothing of the clicked
/// head is left.
///
/// # Examples
///
/// A bright square on a dark picture, from one click on it and one beside it:
///
/// ```
/// use tiface::image::Photo;
/// use tiface::mask::Click;
/// use tiface::mask::grabcut::grabcut;
///
/// let inside = |i: u32| (16..48).contains(&(i % 64)) && (16..48).contains(&(i / 64));
/// let color = |i: u32| if inside(i) { [200, 160, 140] } else { [15, 15, 20] };
/// let rgb = (0..64 * 64).map(color).collect();
/// let photo = Photo { width: 64, height: 64, rgb, alpha: None };
/// let clicks = [(32.0, 32.0, true), (4.0, 32.0, false)].map(|(x, y, head)| Click { x, y, head });
/// let cut = grabcut("example", &photo, &clicks)?;
/// assert!((0..64 * 64).all(|i| (cut.mask.values[i as usize] == 255) == inside(i)));
/// # Ok::<(), tiface::Error>(())
/// ```
pub fn grabcut(view: &str, photo: &Photo, clicks: &[Click]) -> Result<HardMask> {
    cut_at(ROWS, view, photo, clicks)
}

fn cut_at(rows: u32, view: &str, photo: &Photo, clicks: &[Click]) -> Result<HardMask> {
    check_size(view, photo.width, photo.height)?;
    clicks::check(&format!("view `{view}`"), clicks, photo.width, photo.height)?;
    let small = reduce_to_rows(photo, rows);
    let (grabcut, mut warnings) =
        Grabcut::new(view, small, (photo.width, photo.height), clicks, BORDER_MARGIN);
    let (head, models) = grabcut.cut_from_clicks();
    let head = grabcut.finish_clicked(head);
    if !head.contains(&true) {
        return Err(empty(view));
    }
    let ambiguous = models.map_or(1.0, |m| grabcut.ambiguous(&head, &m));
    warnings.extend(grabcut.warnings(view, &head));
    Ok(HardMask { mask: gray(&head, grabcut.width, grabcut.height), ambiguous, warnings })
}

/// Returns the error for a view in which nothing of the clicked head was left.
pub(super) fn empty(view: &str) -> Error {
    Error::cannot(
        format!("view `{view}`: the cut left nothing of the head"),
        "click more of the head: its face, hair and each part of the garment, and the background beside it",
    )
}

/// The colors of both sides.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Models {
    pub head: Mixture,
    pub background: Mixture,
}

impl Models {
    /// Fits both mixtures, starting from k-means; `None` if a side has no pixel.
    pub fn fit(head: &[Rgb], background: &[Rgb]) -> Option<Models> {
        Some(Models {
            head: Mixture::fit(head, GAUSSIANS, SEED)?,
            background: Mixture::fit(background, GAUSSIANS, SEED)?,
        })
    }

    /// Returns both mixtures, refitted.
    pub fn refit(&self, head: &[Rgb], background: &[Rgb]) -> Models {
        Models { head: self.head.refit(head), background: self.background.refit(background) }
    }

    /// `ln p(c | head) − ln p(c | background)`.
    pub fn lean(&self, color: &Rgb) -> f64 {
        self.head.log_likelihood(color) - self.background.log_likelihood(color)
    }
}

/// A photograph at its working size, with its definite labels.
pub(super) struct Grabcut {
    pub photo: Photo,
    pub width: usize,
    pub height: usize,
    /// Clicks in working pixels; empty for a view without clicks.
    pub clicks: Vec<Click>,
    /// `[height · width]`.
    pub seeds: Vec<Seed>,
    /// Costs of different labels of a pixel and its right, lower, lower right and lower left
    /// neighbor.
    edges: Vec<[i32; 4]>,
}

/// Directions of [`PixelGraph::join`] with their steps, in the order of `Grabcut::edges`.
const FORWARD: [(usize, isize, isize); 4] = [(0, 1, 0), (2, 0, 1), (4, 1, 1), (6, -1, 1)];

impl Grabcut {
    /// Draws what clicks make certain on a photograph that is reduced to its working size from
    /// `size`, in whose pixels the clicks are; also warnings about the clicks. The border margin is
    /// a share of the height.
    pub fn new(
        view: &str,
        photo: Photo,
        size: (u32, u32),
        clicks: &[Click],
        margin: f32,
    ) -> (Grabcut, Vec<String>) {
        let clicks: Vec<Click> = clicks.iter().map(|c| c.moved(size, (photo.width, photo.height))).collect();
        let (width, height) = (photo.width as usize, photo.height as usize);
        let (seeds, warnings) = from_clicks(view, &clicks, width, height, margin);
        let edges = edges(&photo);
        (Grabcut { photo, width, height, clicks, seeds, edges }, warnings)
    }

    /// GrabCut from the clicks: labels and the colors they end with.
    pub fn cut_from_clicks(&self) -> (Vec<bool>, Option<Models>) {
        let skeleton = skeleton(&self.seeds, &self.clicks, self.width, self.height);
        let [mut head, not_far] = start(&self.seeds, &skeleton, self.width, self.height);
        let mut models = Models::fit(&self.colors(&head).0, &self.colors(&not_far).1);
        for round in 0..ROUNDS {
            if round > 0 {
                let (inside, outside) = self.colors(&head);
                models = models.map(|m| m.refit(&inside, &outside));
            }
            let Some(m) = &models else { break };
            let labels = self.min_cut(m);
            let settled = labels == head;
            head = labels;
            if settled {
                break;
            }
        }
        (head, models)
    }

    /// Returns the colors of the pixels inside and outside a mask.
    pub fn colors(&self, head: &[bool]) -> (Vec<Rgb>, Vec<Rgb>) {
        let of =
            |side: bool| self.photo.rgb.iter().zip(head).filter(move |(_, h)| **h == side).map(|(c, _)| *c);
        (of(true).collect(), of(false).collect())
    }

    /// Returns a minimum cut for given color models.
    pub fn min_cut(&self, models: &Models) -> Vec<bool> {
        let certain = (SEED_WEIGHT * SMOOTHNESS * CAPACITY_SCALE) as i32;
        let mut graph = PixelGraph::new(self.width, self.height);
        for (i, edge) in self.edges.iter().enumerate() {
            let (x, y) = (i % self.width, i / self.width);
            let (as_head, as_background) = match self.seeds[i] {
                Seed::Head => (0, certain),
                Seed::Background => (certain, 0),
                Seed::Unknown => {
                    let lean = (models.lean(&self.photo.rgb[i]) * CAPACITY_SCALE).clamp(-1e8, 1e8) as i32;
                    ((-lean).max(0), lean.max(0))
                }
            };
            graph.add_costs(x, y, as_head, as_background);
            for ((direction, dx, dy), &weight) in FORWARD.into_iter().zip(edge) {
                let (u, v) = (x as isize + dx, y as isize + dy);
                if u >= 0 && u < self.width as isize && v < self.height as isize {
                    graph.join(x, y, direction, weight);
                }
            }
        }
        graph.cut().0
    }

    /// Pieces without a click that are smaller than `min_size` pixels go, small holes are filled,
    /// threads are opened.
    pub fn finish(&self, mut head: Vec<bool>, min_size: f64) -> Vec<bool> {
        let clicked: Vec<bool> = self.seeds.iter().map(|k| *k == Seed::Head).collect();
        keep_pieces(&mut head, &clicked, min_size, self.width, self.height);
        self.smooth(head)
    }

    /// Finishes a mask like [`Grabcut::finish`], and keeps only pieces with a click.
    pub fn finish_clicked(&self, head: Vec<bool>) -> Vec<bool> {
        let mut smooth = self.finish(head, f64::INFINITY);
        let clicked: Vec<bool> = self.seeds.iter().map(|k| *k == Seed::Head).collect();
        // opening may part what a thread held together
        keep_pieces(&mut smooth, &clicked, f64::INFINITY, self.width, self.height);
        smooth
    }

    /// Small holes are filled, threads are opened.
    fn smooth(&self, mut head: Vec<bool>) -> Vec<bool> {
        let background: Vec<bool> = self.seeds.iter().map(|k| *k == Seed::Background).collect();
        let largest = (MAX_HOLE_SHARE * (self.width * self.height) as f64) as usize;
        fill_holes(&mut head, &background, self.width, self.height, largest);
        open(&head, self.width, self.height)
    }

    /// Returns the share of the picture near the outline whose color does not tell the sides apart.
    pub fn ambiguous(&self, head: &[bool], models: &Models) -> f64 {
        let (w, h) = (self.width, self.height);
        let radius = OUTLINE_BAND * h as f32;
        let near = |side: bool| {
            let marked: Vec<bool> = head.iter().map(|&m| m == side).collect();
            grow(&marked, w, h, radius)
        };
        let (near_head, near_background) = (near(true), near(false));
        let open = (0..w * h).filter(|&i| {
            near_head[i] && near_background[i] && {
                let lean = models.lean(&self.photo.rgb[i]);
                // for the other side, or for this one by less than a factor of e
                if head[i] { lean < 1.0 } else { lean > -1.0 }
            }
        });
        open.count() as f64 / (w * h) as f64
    }

    /// Returns warnings about a finished mask.
    pub fn warnings(&self, view: &str, head: &[bool]) -> Vec<String> {
        let mut found = Vec::new();
        for (n, c) in self.clicks.iter().enumerate() {
            let at = |v: f32, size: usize| (v.round().max(0.0) as usize).min(size - 1);
            if head[at(c.y, self.height) * self.width + at(c.x, self.width)] != c.head {
                let (said, is) = if c.head { ("head", "background") } else { ("background", "head") };
                found.push(format!(
                    "view `{view}`: click {} says {said}, but its surroundings made it {is}; click more around it",
                    n + 1
                ));
            }
        }
        found
    }
}

/// `γ exp(−β ‖Δ‖²) / distance` to the four neighbors ahead; 0 at the border.
fn edges(photo: &Photo) -> Vec<[i32; 4]> {
    let (w, h) = (photo.width as usize, photo.height as usize);
    let square = |i: usize, step: (usize, isize, isize)| -> Option<u32> {
        let (x, y) = ((i % w) as isize + step.1, (i / w) as isize + step.2);
        if x < 0 || x >= w as isize || y >= h as isize {
            return None;
        }
        let (a, b) = (photo.rgb[i], photo.rgb[y as usize * w + x as usize]);
        Some((0..3).map(|c| (a[c].abs_diff(b[c]) as u32).pow(2)).sum())
    };
    let (mut sum, mut pairs) = (0u64, 0u64);
    for i in 0..w * h {
        for step in FORWARD {
            if let Some(d) = square(i, step) {
                sum += d as u64;
                pairs += 1;
            }
        }
    }
    // a flat picture has no contrast to go by: every edge costs the same
    let beta = if sum > 0 { pairs as f64 / (2.0 * sum as f64) } else { 0.0 };
    (0..w * h)
        .map(|i| {
            FORWARD.map(|step| {
                let length = if step.1 != 0 && step.2 != 0 { std::f64::consts::SQRT_2 } else { 1.0 };
                let weight =
                    |d: u32| (CAPACITY_SCALE * SMOOTHNESS * (-beta * d as f64).exp() / length) as i32;
                square(i, step).map_or(0, weight)
            })
        })
        .collect()
}

/// Two sides need some pixels each.
pub(super) fn check_size(view: &str, width: u32, height: u32) -> Result<()> {
    if width >= 16 && height >= 16 {
        return Ok(());
    }
    Err(Error::cannot(
        format!("view `{view}`: a photograph of {width} × {height} pixels is too small to be cut"),
        "give a photograph of at least 16 × 16 pixels",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::math::rng;

    /// Returns a noisy disc of two skin-like colors on a dark background with bright lamps; `scale`
    /// enlarges everything.
    fn head(scale: f32) -> (Photo, Vec<bool>) {
        let (width, height) = ((96.0 * scale) as u32, (128.0 * scale) as u32);
        let mut truth = Vec::new();
        let rgb = (0..width * height)
            .map(|i| {
                let (x, y) = (((i % width) as f32 + 0.5) / scale, ((i / width) as f32 + 0.5) / scale);
                let inside = (x - 48.0).hypot(y - 60.0) < 32.0;
                truth.push(inside);
                let noise = (4.0 * rng::normal(1, 1, i as u64)) as i32;
                let base = match (inside, y < 50.0) {
                    (true, true) => [90, 60, 40],
                    (true, false) => [200, 150, 130],
                    _ if (x % 40.0 - 8.0).hypot(y % 40.0 - 8.0) < 4.0 => [250, 250, 250],
                    _ => [15, 15, 18],
                };
                base.map(|c| (c + noise).clamp(0, 255) as u8)
            })
            .collect();
        (Photo { width, height, rgb, alpha: None }, truth)
    }

    fn clicks(scale: f32) -> Vec<Click> {
        [(48.0, 75.0, true), (48.0, 38.0, true), (6.0, 20.0, false), (90.0, 100.0, false)]
            .map(|(x, y, head)| Click { x: x * scale, y: y * scale, head })
            .into()
    }

    fn overlap(mask: &Gray, truth: &[bool]) -> f64 {
        let both = mask.values.iter().zip(truth).filter(|(m, t)| **m > 127 && **t).count();
        let any = mask.values.iter().zip(truth).filter(|(m, t)| **m > 127 || **t).count();
        both as f64 / any as f64
    }

    #[test]
    fn a_disc_of_two_colors_is_cut_out_among_lamps() {
        let (photo, truth) = head(1.0);
        let cut = grabcut("a", &photo, &clicks(1.0)).unwrap();
        assert!(overlap(&cut.mask, &truth) > 0.985, "{}", overlap(&cut.mask, &truth));
        assert!(cut.warnings.is_empty() && cut.ambiguous < 0.03, "{:?} {}", cut.warnings, cut.ambiguous);
    }

    #[test]
    fn a_large_photograph_is_cut_at_the_working_size() {
        let (photo, truth) = head(3.0);
        let cut = cut_at(128, "a", &photo, &clicks(3.0)).unwrap();
        assert_eq!((cut.mask.width, cut.mask.height), (96, 128));
        let large = tiface_base::image::resize_hard(&cut.mask, (photo.width, photo.height));
        assert!(overlap(&large, &truth) > 0.97, "{}", overlap(&large, &truth));
    }

    #[test]
    fn the_same_clicks_cut_the_same_mask_and_flat_pictures_do_not_fail() {
        let (photo, _) = head(1.0);
        let run = || grabcut("a", &photo, &clicks(1.0));
        assert_eq!(run(), run());
        let flat = Photo { rgb: vec![[9, 9, 9]; photo.rgb.len()], ..photo };
        // head and background have the same color: the mask satisfies the clicks, or the result has
        // a warning
        if let Ok(cut) = grabcut("a", &flat, &clicks(1.0)) {
            assert!(cut.ambiguous > 0.0);
        }
    }

    #[test]
    fn photographs_of_one_row_or_of_nothing_are_refused_by_name() {
        let photo = Photo { width: 100, height: 1, rgb: vec![[0; 3]; 100], alpha: None };
        let e = grabcut("a", &photo, &[Click { x: 1.0, y: 0.0, head: true }]);
        assert!(e.unwrap_err().to_string().contains("a photograph of 100 × 1 pixels is too small"));
    }
}

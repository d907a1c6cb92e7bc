//! Space carving: what every silhouette allows, cell by cell (Laurentini's visual hull).
//!
//! A view *keeps* a cell if any masked pixel is in the cell's footprint, and *removes* it if none
//! is although the whole footprint lies inside the frame. An empty footprint that leaves the frame
//! decides nothing if it leaves through a border that the mask touches, since the subject may go on
//! outside; through any other border it leaves the subject too, and the cell is removed. (That
//! takes the subject for one piece that does not leave through one border and come back beside
//! another, as shoulders do not.) Footprints are generous rectangles counted with a summed-area
//! table, so a hair thinner than a cell is never lost.

use glam::{DMat3, DVec3, Vec2};
use rayon::prelude::*;
use tiface_base::geom::Camera;
use tiface_base::image::Gray;

/// A camera prepared for many projections.
pub struct Projector {
    camera: Camera,
    /// Squared ideal radius beyond which the lens model is not trusted: a polynomial folds back.
    reach: f64,
    plain: bool,
}

impl Projector {
    /// Returns a camera with the reach of its lens model, which its borders show.
    pub fn new(camera: &Camera) -> Projector {
        let (w, h) = (camera.width as f64, camera.height as f64);
        let border = (0..=16).flat_map(|i| {
            let t = i as f64 / 16.0;
            [(t * w, 0.0), (t * w, h), (0.0, t * h), (w, t * h)]
        });
        let reach = border
            .filter_map(|(x, y)| {
                let (x, y) = ((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy);
                camera.distortion.undistort(x, y).map(|(x, y)| x * x + y * y)
            })
            .fold(0.0, f64::max);
        Projector { camera: camera.clone(), reach: 1.1 * reach, plain: camera.distortion.is_none() }
    }

    /// Picture position and depth; `None` behind the camera or beyond the lens model's reach.
    // millions of cells are projected by one camera, whose numbers then stay in registers
    #[inline(always)]
    pub fn project(&self, point: DVec3) -> Option<(f64, f64, f64)> {
        let (ideal, depth) = Camera::ideal(self.camera.local(point))?;
        let pixel = match self.plain {
            true => self.camera.pixel_behind_lens(ideal.into()),
            false if ideal.length_squared() > self.reach => return None,
            false => self.camera.pixel(ideal),
        };
        Some((pixel.x, pixel.y, depth))
    }

    /// Returns whether the point is inside the frame.
    pub fn sees(&self, point: DVec3) -> bool {
        let (w, h) = (self.camera.width as f64, self.camera.height as f64);
        self.project(point).is_some_and(|(x, y, _)| x >= 0.0 && y >= 0.0 && x < w && y < h)
    }
}

/// One view's mask, as sums over rectangles.
pub(super) struct SilhouetteTable {
    /// Which view this is.
    pub view: usize,
    projector: Projector,
    width: usize,
    height: usize,
    /// Masked pixels above and left of each corner, `[height + 1, width + 1]`.
    table: Vec<u32>,
    /// Whether the mask comes within two pixels of the left, top, right, bottom border.
    cut: [bool; 4],
}

/// State of a cell's footprint in a silhouette.
enum FootprintState {
    /// A masked pixel is in the footprint.
    Kept,
    /// The footprint is empty, and where it leaves the frame the subject does not.
    Removed,
    /// Empty inside the frame, but the subject may be outside.
    Undecided,
}

impl SilhouetteTable {
    /// Pixels over `threshold` count as masked. A mask of another size than the camera's is taken
    /// for the same picture at that size.
    pub fn new(view: usize, camera: &Camera, mask: &Gray, threshold: u8) -> SilhouetteTable {
        let (width, height) = (mask.width as usize, mask.height as usize);
        let row = width + 1;
        let mut table = vec![0u32; row * (height + 1)];
        for y in 0..height {
            let mut sum = 0;
            for x in 0..width {
                sum += (mask.values[y * width + x] > threshold) as u32;
                table[(y + 1) * row + x + 1] = table[y * row + x + 1] + sum;
            }
        }
        let projector = Projector::new(&camera.resized(mask.width, mask.height));
        let mut silhouette = SilhouetteTable { view, projector, width, height, table, cut: [false; 4] };
        let (w, h, b) = (width, height, 2.min(width).min(height));
        let bands = [(0, 0, b, h), (0, 0, w, b), (w - b, 0, w, h), (0, h - b, w, h)];
        silhouette.cut = bands.map(|(x0, y0, x1, y1)| silhouette.any(x0, y0, x1, y1));
        silhouette
    }

    /// Returns whether a pixel with x0 ≤ x < x1, y0 ≤ y < y1 is masked.
    fn any(&self, x0: usize, y0: usize, x1: usize, y1: usize) -> bool {
        let at = |x: usize, y: usize| self.table[y * (self.width + 1) + x];
        at(x1, y1) + at(x0, y0) > at(x0, y1) + at(x1, y0)
    }

    fn footprint(&self, center: DVec3, radius: f64) -> FootprintState {
        let Some((x, y, depth)) = self.projector.project(center) else { return FootprintState::Undecided };
        let c = &self.projector.camera;
        if depth <= 1.01 * radius {
            return FootprintState::Kept; // the camera stands in the cell
        }
        // the sphere around the cell, with 5 % for what perspective and lens do to its outline
        let reach = |f: f64| 1.05 * f * radius / (depth - radius) + 0.5;
        let (rx, ry) = (reach(c.fx), reach(c.fy));
        let (x0, x1, y0, y1) = (x - rx, x + rx, y - ry, y + ry);
        let (w, h) = (self.width as f64, self.height as f64);
        // inside the frame, where truncation rounds down, without a call of `floor` or `ceil`
        let down = |v: f64, end: f64| v.clamp(0.0, end) as u32;
        let up = |v: f64, end: f64| {
            let v = v.clamp(0.0, end);
            v as u32 + u32::from(v > f64::from(v as u32))
        };
        let (u0, v0) = (down(x0, w) as usize, down(y0, h) as usize);
        let (u1, v1) = (up(x1, w) as usize, up(y1, h) as usize);
        let leaves = [x0 < 0.0, y0 < 0.0, x1 > w, y1 > h];
        if self.any(u0, v0, u1, v1) {
            FootprintState::Kept
        } else if leaves.iter().zip(&self.cut).any(|(l, c)| *l && *c) {
            FootprintState::Undecided
        } else {
            FootprintState::Removed
        }
    }
}

/// A cube of `n³` cells around a center.
#[derive(Clone, Copy, Debug)]
pub struct Cube {
    /// Its middle.
    pub center: DVec3,
    /// Half of its side.
    pub half: f64,
    /// Number of cells along each axis.
    pub n: usize,
}

impl Cube {
    /// Returns the side of a cell.
    #[inline]
    pub fn cell(&self) -> f64 {
        2.0 * self.half / self.n as f64
    }

    /// Returns the center of a cell by its indices.
    #[inline]
    pub fn cell_center(&self, x: usize, y: usize, z: usize) -> DVec3 {
        let at = |i: usize| (i as f64 + 0.5) * self.cell() - self.half;
        self.center + DVec3::new(at(x), at(y), at(z))
    }

    /// Returns where the centers of cells lie along each axis.
    pub fn centers(&self) -> [Vec<f64>; 3] {
        let at = |i: usize| (i as f64 + 0.5) * self.cell() - self.half;
        self.center.to_array().map(|center| (0..self.n).map(|i| center + at(i)).collect())
    }

    /// Returns half the diagonal of a cell.
    pub fn radius(&self) -> f64 {
        0.5 * self.cell() * 3f64.sqrt()
    }
}

/// Remaining cells of a [`Cube`].
pub(super) struct Carved {
    /// How many masks each cell touches; 0 where some view removes it. `[n, n, n]`, x outermost.
    pub support: Vec<u16>,
    /// Per silhouette: cells that it alone removes, while at least half of all, and three, keep
    /// them.
    pub alone: Vec<u64>,
}

impl Carved {
    /// Returns the cells that touch at least `least` masks.
    pub fn touching(&self, least: usize) -> Vec<bool> {
        self.support.iter().map(|&s| s as usize >= least.max(1)).collect()
    }
}

/// Asks every silhouette about every cell.
pub(super) fn carve(cube: &Cube, silhouettes: &[SilhouetteTable]) -> Carved {
    let (n, radius) = (cube.n, cube.radius());
    let centers = cube.centers();
    let slabs: Vec<(Vec<u16>, Vec<u64>)> = (0..n)
        .into_par_iter()
        .map(|x| {
            let mut support = vec![0u16; n * n];
            let mut alone = vec![0u64; silhouettes.len()];
            for y in 0..n {
                for z in 0..n {
                    let center = DVec3::new(centers[0][x], centers[1][y], centers[2][z]);
                    let (mut seen, mut removed, mut by) = (0u16, 0, 0);
                    for (i, s) in silhouettes.iter().enumerate() {
                        match s.footprint(center, radius) {
                            FootprintState::Undecided => {}
                            FootprintState::Kept => seen += 1,
                            FootprintState::Removed => {
                                removed += 1;
                                by = i;
                                if removed == 2 {
                                    break;
                                }
                            }
                        }
                    }
                    support[y * n + z] = if removed == 0 { seen } else { 0 };
                    // against most of the others: where few look, one view rightly decides
                    alone[by] += (removed == 1 && seen >= 3 && 2 * seen as usize >= silhouettes.len()) as u64;
                }
            }
            (support, alone)
        })
        .collect();
    let mut carved = Carved { support: Vec::with_capacity(n * n * n), alone: vec![0; silhouettes.len()] };
    for (support, alone) in slabs {
        carved.support.extend(support);
        carved.alone.iter_mut().zip(alone).for_each(|(sum, a)| *sum += a);
    }
    carved
}

/// Connected pieces of a set of cells or pixels.
pub struct Pieces {
    /// The piece of each element, numbered from 1 in the order of their first elements; 0 outside
    /// the set.
    pub label: Vec<u32>,
    /// How many elements each piece has; 0 for number 0.
    pub size: Vec<usize>,
}

/// Finds the connected pieces of the marked elements; `around` returns the neighbors of an element.
pub fn pieces<I: Iterator<Item = usize>>(marked: &[bool], around: impl Fn(usize) -> I) -> Pieces {
    let mut label = vec![0u32; marked.len()];
    let mut size: Vec<usize> = vec![0];
    let mut stack = Vec::new();
    for start in 0..marked.len() {
        if !marked[start] || label[start] != 0 {
            continue;
        }
        let id = size.len() as u32;
        size.push(0);
        label[start] = id;
        stack.push(start);
        while let Some(i) = stack.pop() {
            size[id as usize] += 1;
            // from inside, nested iterators are plain loops
            around(i).for_each(|j| {
                if marked[j] && label[j] == 0 {
                    label[j] = id;
                    stack.push(j);
                }
            });
        }
    }
    Pieces { label, size }
}

/// Returns the neighbors of a cell of `n³` over faces, or over corners too.
#[inline]
pub fn around([x, y, z]: [usize; 3], n: usize, corners: bool) -> impl Iterator<Item = usize> {
    let span = move |v: usize| v.saturating_sub(1)..(v + 2).min(n);
    span(x).flat_map(move |u| span(y).flat_map(move |v| span(z).map(move |w| (u, v, w)))).filter_map(
        move |(u, v, w)| {
            let steps = u.abs_diff(x) + v.abs_diff(y) + w.abs_diff(z);
            (steps == 1 || (corners && steps > 1)).then_some((u * n + v) * n + w)
        },
    )
}

/// Removes every 26-connected piece smaller than `share` of the largest one; returns how many cells
/// it removed.
pub fn drop_dust(kept: &mut [bool], n: usize, share: f64) -> usize {
    let Pieces { label, size } = pieces(kept, |i| around([i / (n * n), i / n % n, i % n], n, true));
    let least = share * size.iter().copied().max().unwrap_or(0) as f64;
    let mut dropped = 0;
    for (cell, &id) in kept.iter_mut().zip(&label) {
        if *cell && (size[id as usize] as f64) < least {
            *cell = false;
            dropped += 1;
        }
    }
    dropped
}

/// Lowest and highest index of the cells kept along each axis; `None` without any.
pub(super) fn extent(kept: &[bool], n: usize) -> Option<[(usize, usize); 3]> {
    let mut found = [(usize::MAX, 0); 3];
    for (i, _) in kept.iter().enumerate().filter(|(_, k)| **k) {
        for (axis, v) in [i / (n * n), i / n % n, i % n].into_iter().enumerate() {
            found[axis] = (found[axis].0.min(v), found[axis].1.max(v));
        }
    }
    (found[0].0 != usize::MAX).then_some(found)
}

/// Returns the point nearest to all rays, least squares: `Σ (I − ddᵀ)(p − o) = 0`. `None` when they
/// are parallel within about half a degree.
pub fn meeting_point(rays: &[(DVec3, DVec3)]) -> Option<DVec3> {
    // sums relative to one origin: far-away worlds would lose digits
    let base = rays.first()?.0;
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for &(origin, direction) in rays {
        let outer =
            DMat3::from_cols(direction * direction.x, direction * direction.y, direction * direction.z);
        let across = DMat3::IDENTITY - outer;
        a += across;
        b += across * (origin - base);
    }
    let n = rays.len() as f64;
    // for a small spread θ of directions the eigenvalues of A/n are 1, 1 and the variance of θ
    if (a * (1.0 / n)).determinant() < 1e-4 {
        return None;
    }
    Some(base + a.inverse() * b)
}

/// Returns the direction through the middle of a mask's weight, or along the viewing axis without
/// one.
pub(super) fn ray_to(camera: &Camera, mask: Option<&Gray>) -> (DVec3, DVec3) {
    let axis = -camera.rotation.z_axis;
    let Some(mask) = mask else { return (camera.position, axis) };
    let camera = camera.resized(mask.width, mask.height);
    let (mut x, mut y, mut weight) = (0.0, 0.0, 0.0);
    for (i, &v) in mask.values.iter().enumerate() {
        let v = v as f64;
        weight += v;
        x += v * ((i % mask.width as usize) as f64 + 0.5);
        y += v * ((i / mask.width as usize) as f64 + 0.5);
    }
    let middle = Vec2::new((x / weight) as f32, (y / weight) as f32);
    match camera.ray(middle) {
        Some(ray) if weight > 0.0 => (camera.position, ray.direction.as_dvec3()),
        _ => (camera.position, axis),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_where_they_cross_and_parallel_ones_nowhere() {
        let p = DVec3::new(1e6, -2.0, 3.0);
        let rays: Vec<_> = [DVec3::X, DVec3::Y, DVec3::new(0.6, 0.0, 0.8)].map(|d| (p - 4.0 * d, d)).into();
        assert!(meeting_point(&rays).unwrap().distance(p) < 1e-6);
        let parallel = [(DVec3::ZERO, DVec3::X), (DVec3::Y, DVec3::X)];
        assert!(meeting_point(&parallel).is_none());
    }

    #[test]
    fn dust_is_dropped_and_the_large_piece_stays() {
        let n = 5;
        let mut kept = vec![false; n * n * n];
        for i in 0..50 {
            kept[i] = true; // two full slabs
        }
        kept[n * n * n - 1] = true;
        assert_eq!(drop_dust(&mut kept, n, 0.05), 1);
        assert_eq!(kept.iter().filter(|k| **k).count(), 50);
        assert_eq!(extent(&kept, n), Some([(0, 1), (0, 4), (0, 4)]));
        assert_eq!(extent(&[false; 8], 2), None);
    }
}

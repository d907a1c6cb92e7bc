//! Space carving: what every silhouette allows, cell by cell (Laurentini's visual hull).
//!
//! A view *keeps* a cell if any masked pixel is in the cell's footprint, and *removes* it if none
//! is although the whole footprint lies inside the frame. An empty footprint that leaves the frame
//! decides nothing if it leaves through a border that the mask touches, since the subject may go on
//! outside; through any other border it leaves the subject too, and the cell is removed. (That
//! takes the subject for one piece that does not leave through one border and come back beside
//! another, as shoulders do not.) Footprints are generous rectangles counted with a summed-area
//! table, so a hair thinner than a cell is never lost.

use super::projector::Projector;
use glam::DVec3;
use rayon::prelude::*;
use tiface_base::geom::{Camera, CellCube};
use tiface_base::image::Gray;

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

/// Remaining cells of a [`CellCube`].
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
pub(super) fn carve(cube: &CellCube, silhouettes: &[SilhouetteTable]) -> Carved {
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

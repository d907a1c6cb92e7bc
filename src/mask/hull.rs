//! Visual hull of the masks of several views: votes for every cell of a cube, and silhouettes of
//! cells.
//!
//! A mask votes for a cell when the cell's center falls on the head, against it when it falls
//! beside, and not at all outside its frame. A set of cells is drawn back into any view by its
//! surface.

use glam::DVec3;
use rayon::prelude::*;
use tiface_base::geom::{Camera, CellCube, cells_around, meeting_point};
use tiface_base::image::Gray;
use tiface_base::{Error, Result};
use tiface_capture::Projector;

/// The frame of a picture: which of its pixels shows a point.
pub(super) struct ViewFrame {
    projector: Projector,
    pub width: usize,
    pub height: usize,
}

impl ViewFrame {
    /// Returns the camera's whole picture.
    pub fn new(camera: &Camera) -> ViewFrame {
        let (width, height) = (camera.width as usize, camera.height as usize);
        ViewFrame { projector: Projector::new(camera), width, height }
    }

    /// Returns the pixel that shows a point; `None` outside the frame.
    #[inline(always)]
    fn pixel(&self, point: DVec3) -> Option<usize> {
        let (x, y, _) = self.projector.project(point)?;
        let inside = x >= 0.0 && y >= 0.0 && x < self.width as f64 && y < self.height as f64;
        inside.then(|| y as usize * self.width + x as usize)
    }
}

/// Lets every frame vote on every cell:
/// `vote(values of the cell, index of the frame, pixel that shows the cell)`.
///
/// # Shapes
///
/// - output: `[n, n, n, values]` with x outermost
pub(super) fn vote<T: Copy + Default + Send>(
    cube: &CellCube,
    frames: &[&ViewFrame],
    values: usize,
    vote: impl Fn(&mut [T], usize, usize) + Sync,
) -> Vec<T> {
    let n = cube.n;
    let [xs, ys, zs] = cube.centers();
    let mut cells = vec![T::default(); n * n * n * values];
    cells.par_chunks_exact_mut(n * n * values).zip(&xs).for_each(|(slab, x)| {
        for (k, frame) in frames.iter().enumerate() {
            for (row, y) in slab.chunks_exact_mut(n * values).zip(&ys) {
                for (cell, z) in row.chunks_exact_mut(values).zip(&zs) {
                    if let Some(pixel) = frame.pixel(DVec3::new(*x, *y, *z)) {
                        vote(cell, k, pixel);
                    }
                }
            }
        }
    });
    cells
}

/// A hard mask with its camera.
pub(super) struct Voter {
    frame: ViewFrame,
    head: Vec<bool>,
}

impl Voter {
    /// Takes a mask of any size for the camera's whole picture; head from 128.
    pub fn new(camera: &Camera, mask: &Gray) -> Voter {
        Voter { frame: ViewFrame::new(&camera.resized(mask.width, mask.height)), head: mask.inside() }
    }
}

/// Returns how many masks vote against and for every cell: `[n, n, n]` with x outermost.
pub(super) fn count(cube: &CellCube, voters: &[Voter]) -> Vec<[u16; 2]> {
    let frames: Vec<&ViewFrame> = voters.iter().map(|v| &v.frame).collect();
    vote(cube, &frames, 1, |cell: &mut [[u16; 2]], k, pixel| cell[0][voters[k].head[pixel] as usize] += 1)
}

/// Returns the cells with at most `most_negative` votes against and at least `least_positive` for
/// them.
pub(super) fn cells(votes: &[[u16; 2]], most_negative: usize, least_positive: usize) -> Vec<bool> {
    votes.iter().map(|&[no, yes]| no as usize <= most_negative && yes as usize >= least_positive).collect()
}

/// Returns the cube around the point where the viewing axes meet, `margin` times as high as the
/// frames at that point.
pub(super) fn cube(cameras: &[Camera], n: usize, margin: f64) -> Result<CellCube> {
    let alike = |how: &str| {
        Error::cannot(
            format!(
                "the {} cameras {how}, so clicks cannot be propagated from one view to another",
                cameras.len()
            ),
            "click every view, or check that each frame has its own pose and cameras look from different sides",
        )
    };
    let axes: Vec<(DVec3, DVec3)> = cameras.iter().map(|c| (c.position, -c.rotation.z_axis)).collect();
    let center = meeting_point(&axes).ok_or_else(|| alike("look in one direction"))?;
    let reach = |c: &Camera| c.position.distance(center) * c.height as f64 / (2.0 * c.fy);
    let half = margin * cameras.iter().map(reach).fold(0.0, f64::max);
    if !(half.is_finite() && half > 0.0) {
        return Err(alike("stand at one place"));
    }
    Ok(CellCube { center, half, n })
}

/// Returns the centers of the cells of a set that lie at its surface.
pub(super) fn surface(cube: &CellCube, cells: &[bool]) -> Vec<DVec3> {
    let n = cube.n;
    let mut centers = Vec::new();
    for i in (0..cells.len()).filter(|&i| cells[i]) {
        let (x, y, z) = (i / (n * n), i / n % n, i % n);
        let edge = |v: usize| v == 0 || v + 1 == n;
        let surface = edge(x)
            || edge(y)
            || edge(z)
            || !(cells[i - n * n]
                && cells[i + n * n]
                && cells[i - n]
                && cells[i + n]
                && cells[i - 1]
                && cells[i + 1]);
        if surface {
            centers.push(cube.cell_center(x, y, z));
        }
    }
    centers
}

/// Returns the pixels that a set of cells covers in a view. `surface` are the centers of those at
/// its surface: they cover what they surround.
pub(super) fn silhouette(cube: &CellCube, surface: &[DVec3], camera: &Camera) -> Vec<bool> {
    let (w, h) = (camera.width as usize, camera.height as usize);
    let projector = Projector::new(camera);
    let mut covered = vec![false; w * h];
    for &center in surface {
        let Some((u, v, depth)) = projector.project(center) else { continue };
        let (rx, ry) = (0.5 * camera.fx * cube.cell() / depth, 0.5 * camera.fy * cube.cell() / depth);
        let range = |c: f64, r: f64, size: usize| {
            let first = (c - r).floor().clamp(0.0, size as f64) as usize;
            first..(c + r).ceil().clamp(0.0, size as f64) as usize
        };
        for row in range(v, ry, h) {
            let columns = range(u, rx, w);
            covered[row * w + columns.start..row * w + columns.end].fill(true);
        }
    }
    covered
}

/// Returns the cells deeper inside than `share` of the deepest one. Depth counts peeled layers, in
/// turn over faces and over corners, which is near to distance.
pub(super) fn core(cells: &[bool], n: usize, share: f64) -> Vec<bool> {
    let mut depth = vec![0u16; cells.len()];
    let mut front = Vec::new();
    let at = |i: usize| [i / (n * n), i / n % n, i % n];
    // cells beside an outside cell; cells beyond the cube are unknown, so its walls do not peel
    for i in (0..cells.len()).filter(|&i| cells[i]) {
        if cells_around(at(i), n, false).any(|j| !cells[j]) {
            depth[i] = 1;
            front.push(i);
        }
    }
    let mut layer = 1;
    while !front.is_empty() {
        layer += 1;
        let mut next = Vec::new();
        for &i in &front {
            cells_around(at(i), n, layer % 2 == 0).for_each(|j| {
                if cells[j] && depth[j] == 0 {
                    depth[j] = layer;
                    next.push(j);
                }
            });
        }
        front = next;
    }
    let deepest = depth.iter().copied().max().unwrap_or(0) as f64;
    depth.iter().map(|&d| d > 0 && d as f64 > share * deepest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cameras() -> Vec<Camera> {
        // along Z and along X, both 10 away, 1 unit = 20 pixels at the middle
        let front = Camera::above(80, 80, 200.0, 10.0);
        let side = Camera {
            rotation: glam::DMat3::from_rotation_y(std::f64::consts::FRAC_PI_2),
            position: DVec3::new(10.0, 0.0, 0.0),
            ..front.clone()
        };
        vec![front, side]
    }

    /// Returns a square of ± `half` pixels around the middle.
    fn square(half: usize) -> Gray {
        let inside = |v: usize| v >= 40 - half && v < 40 + half;
        let values = (0..6400).map(|i| if inside(i % 80) && inside(i / 80) { 255 } else { 0 }).collect();
        Gray { width: 80, height: 80, values }
    }

    #[test]
    fn the_cube_surrounds_what_the_cameras_look_at() {
        let cube = cube(&cameras(), 16, 1.5).unwrap();
        // frames are 80 · 10 / 200 = 4 high at the middle
        assert!(cube.center.length() < 1e-9 && (cube.half - 3.0).abs() < 1e-9);
        let alike = super::cube(&cameras()[..1], 16, 1.5).unwrap_err();
        assert!(alike.to_string().starts_with("the 1 cameras "), "{alike}");
    }

    #[test]
    fn two_squares_carve_a_box_and_draw_themselves_again() {
        let cameras = cameras();
        let cube = cube(&cameras, 48, 1.0).unwrap();
        let voters: Vec<Voter> = cameras.iter().map(|c| Voter::new(c, &square(20))).collect();
        let votes = count(&cube, &voters);
        let box_cells = cells(&votes, 0, 2);
        // a box of 2 units has 24 cells of 1/12 along each side; perspective moves its walls by a
        // cell or two
        let count = box_cells.iter().filter(|c| **c).count() as f64;
        assert!((count.cbrt() - 24.0).abs() < 2.0, "{count}");
        let drawn = silhouette(&cube, &surface(&cube, &box_cells), &cameras[0]);
        let wrong = (drawn.iter().zip(&square(20).values)).filter(|(d, s)| **d != (**s == 255)).count();
        assert!(wrong < 2 * 4 * 40, "{wrong}"); // two pixels along the outline
        // one forgiven vote lets all cells in that one view keeps: two beams
        assert!(cells(&votes, 1, 0).iter().filter(|c| **c).count() as f64 > 2.0 * count);
    }

    #[test]
    fn the_core_of_a_ball_is_a_smaller_ball() {
        let n = 41;
        let distance = |i: usize| {
            let at = [i / (n * n), i / n % n, i % n].map(|v| v as f64 - 20.0);
            (at[0] * at[0] + at[1] * at[1] + at[2] * at[2]).sqrt()
        };
        let ball: Vec<bool> = (0..n * n * n).map(|i| distance(i) < 16.0).collect();
        let core = core(&ball, n, 0.5);
        for i in (0..core.len()).filter(|&i| core[i]) {
            assert!(distance(i) < 11.0, "{}", distance(i));
        }
        assert!((0..core.len()).filter(|&i| distance(i) < 5.0).all(|i| core[i]));
    }
}

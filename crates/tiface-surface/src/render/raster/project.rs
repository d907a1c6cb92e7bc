//! Projection of triangles: transformed to the camera, clipped to its frustum, snapped to 1/256 of
//! a pixel, and sorted into tiles.

use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;
use tiface_base::geom::{Camera, Mesh};

/// Pixels along each side of a tile.
pub(super) const TILE: usize = 32;

/// Parts of a pixel.
pub(super) const UNIT: i32 = 256;

/// The first and the last place of a sample in a row.
const FIRST_SAMPLE: i32 = 32;
const LAST_SAMPLE: i32 = 224;

/// Number of triangles that are binned together; fixed, so that the result does not depend on the
/// number of threads.
const CHUNK: usize = 4096;

/// Farthest from the picture's corner, 1/256 pixels: products of two distances fit into 64 bits
/// many times over.
const MAX_COORDINATE: f64 = (1 << 23) as f64;

/// Tolerance for a corner made by clipping, which is rounded.
const MAX_CLIPPED_COORDINATE: f64 = MAX_COORDINATE + 8192.0;

/// Nearest to the camera, as a share of the distance to the farthest corner of the mesh's box.
const MIN_DEPTH_SHARE: f32 = 1e-5;

/// Maximum distance of a straight line from its distorted image, pixels.
const MAX_LENS_ERROR_PX: f64 = 1.0 / 64.0;

/// Samples along each side of a picture whose rays determine the field of view of the lens.
const LENS_GRID: usize = 33;

/// A corner of a triangle on the picture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Corner {
    /// 1/256 pixels from the left.
    pub x: i32,
    /// 1/256 pixels from the top.
    pub y: i32,
    /// One over the distance along the viewing axis; 0 for a corner that is not on the picture.
    pub inverse_depth: f32,
}

/// A triangle on the picture, or a piece of one, wound clockwise so that its area is positive.
#[derive(Clone, Copy, Debug)]
pub(super) struct Face {
    pub corners: [Corner; 3],
    pub triangle: u32,
    /// Whether the triangle is a back face.
    pub back: bool,
}

/// Returns twice the area of a triangle, 1/65,536 pixels; positive if it is clockwise.
pub(super) fn area([a, b, c]: [Corner; 3]) -> i64 {
    let to = |p: Corner| (i64::from(p.x) - i64::from(a.x), i64::from(p.y) - i64::from(a.y));
    let ((bx, by), (cx, cy)) = (to(b), to(c));
    bx * cy - by * cx
}

/// The faces of a range of triangles, by tile.
pub(super) struct Bins {
    faces: Vec<Face>,
    /// Faces of all tiles, one tile after the other.
    order: Vec<u32>,
    /// Start of each tile in `order`, and the end of the last one.
    starts: Vec<u32>,
}

impl Bins {
    /// Returns the faces of a tile in the order of their triangles.
    pub fn faces(&self, tile: usize) -> impl ExactSizeIterator<Item = &Face> {
        let (from, to) = (self.starts[tile] as usize, self.starts[tile + 1] as usize);
        self.order[from..to].iter().map(|&face| &self.faces[face as usize])
    }
}

/// A camera prepared for projecting triangles.
pub(super) struct Lens<'a> {
    camera: &'a Camera,
    camera_from_mesh: Mat3,
    origin: Vec3,
    near: f32,
    /// Lowest and highest x and y over depth up to which triangles are kept.
    seen: [f32; 4],
    mirrored: bool,
    across: usize,
    down: usize,
}

/// Triangles to be sorted into tiles.
pub(super) struct Faces<'a> {
    pub positions: &'a [Vec3],
    pub triangles: &'a [[u32; 3]],
    /// Their indices in the mesh; `None` if they are the same.
    pub ids: Option<&'a [u32]>,
    /// The faces that are drawn.
    pub sides: Sides,
}

/// The sides of triangles that are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sides {
    Both,
    Front,
    Back,
}

impl<'a> Lens<'a> {
    /// Returns `None` if no pixel has a ray.
    pub fn new(camera: &'a Camera, mesh: &Mesh) -> Option<Lens<'a>> {
        let origin = camera.position.as_vec3();
        let bounds = mesh.bounds();
        let far = (bounds.min - origin).abs().max((bounds.max - origin).abs()).length();
        let camera_from_mesh = camera.rotation.transpose().as_mat3();
        let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        let size = Vec2::new(camera.width as f32, camera.height as f32);
        for k in 0..LENS_GRID * LENS_GRID {
            let share = Vec2::new((k % LENS_GRID) as f32, (k / LENS_GRID) as f32) / (LENS_GRID - 1) as f32;
            if let Some(ray) = camera.ray(share * size) {
                let d = camera_from_mesh * ray.direction;
                let at = Vec2::new(d.x, -d.y) / -d.z;
                (low, high) = (low.min(at), high.max(at));
            }
        }
        if !(low.cmple(high).all() && far > 0.0) {
            return None;
        }
        let seen = if camera.distortion.is_none() {
            // as far as numbers go: an edge within is then cut in neither of its triangles
            let reach = |focal: f64, middle: f64| {
                let [a, b] = [-1.0, 1.0]
                    .map(|side| ((side * MAX_COORDINATE / f64::from(UNIT) - middle) / focal) as f32);
                (a.min(b), a.max(b))
            };
            let (x, y) = (reach(camera.fx, camera.cx), reach(camera.fy, camera.cy));
            [x.0, x.1, y.0, y.1]
        } else {
            // a tenth more for directions between these samples of a distorted lens; more would
            // reach its fold
            let border = 0.1 * (high - low);
            [low.x - border.x, high.x + border.x, low.y - border.y, high.y + border.y]
        };
        let tiles = |side: u32| (side as usize).div_ceil(TILE);
        Some(Lens {
            camera,
            camera_from_mesh,
            origin,
            near: MIN_DEPTH_SHARE * far,
            seen,
            mirrored: (camera.fx < 0.0) != (camera.fy < 0.0),
            across: tiles(camera.width),
            down: tiles(camera.height),
        })
    }

    /// Sorts triangles into tiles, rows of tiles one after the other.
    pub fn bin(&self, all: &Faces) -> Vec<Bins> {
        let straight = self.camera.distortion.is_none();
        let corners: Vec<Corner> = if straight {
            all.positions
                .par_iter()
                .with_min_len(CHUNK)
                .map(|&p| self.corner(self.ideal(p), MAX_COORDINATE))
                .collect()
        } else {
            Vec::new()
        };
        let chunks = all.triangles.par_chunks(CHUNK).enumerate();
        let bin = |(chunk, triangles): (usize, &[[u32; 3]])| {
            let mut faces = Vec::with_capacity(triangles.len());
            for (i, t) in triangles.iter().enumerate() {
                let index = chunk * CHUNK + i;
                let triangle = all.ids.map_or(index as u32, |ids| ids[index]);
                if straight {
                    let face = t.map(|v| corners[v as usize]);
                    if face.iter().all(|c| c.inverse_depth > 0.0) {
                        self.add(face, triangle, all.sides, &mut faces);
                        continue;
                    }
                }
                self.cut(t.map(|v| self.inside(all.positions[v as usize])), triangle, all.sides, &mut faces);
            }
            self.sort(faces)
        };
        chunks.map(bin).collect()
    }

    /// Returns a point in camera coordinates: right, down and away.
    fn inside(&self, p: Vec3) -> Vec3 {
        let q = self.camera_from_mesh * (p - self.origin);
        Vec3::new(q.x, -q.y, -q.z)
    }

    /// x and y over depth, and one over depth: what is straight in space is straight in these, too.
    fn ideal(&self, p: Vec3) -> Vec3 {
        let q = self.inside(p);
        if q.z >= self.near { Vec3::new(q.x, q.y, 1.0) / q.z } else { Vec3::ZERO }
    }

    /// Returns the pixel position after distortion.
    fn bent(&self, ideal: Vec3) -> (f64, f64) {
        let at = ideal.truncate().as_dvec2();
        let pixel = match self.camera.distortion.is_none() {
            true => self.camera.pixel_behind_lens(at.into()),
            false => self.camera.pixel(at),
        };
        pixel.into()
    }

    /// Snapped; not on the picture where it is too far away from it.
    #[inline(always)]
    fn corner(&self, ideal: Vec3, farthest: f64) -> Corner {
        let (x, y) = self.bent(ideal);
        let (x, y) = (x * f64::from(UNIT), y * f64::from(UNIT));
        if !(x.abs() <= farthest && y.abs() <= farthest) {
            return Corner::default();
        }
        // rounded to nearest: positive before the cast, which cuts off
        let round = |v: f64| (v + (MAX_CLIPPED_COORDINATE + 0.5)) as i32 - MAX_CLIPPED_COORDINATE as i32;
        Corner { x: round(x), y: round(y), inverse_depth: ideal.z }
    }

    /// Clips a triangle, given in camera coordinates, to the picture, and adds the rest.
    ///
    /// A new corner is computed from the end of its edge that is kept, so both triangles at an edge
    /// get the same one.
    fn cut(&self, triangle: [Vec3; 3], id: u32, sides: Sides, out: &mut Vec<Face>) {
        let [left, right, top, bottom] = self.seen;
        let planes: [(Vec3, f32); 5] = [
            (Vec3::Z, self.near),
            (Vec3::new(1.0, 0.0, -left), 0.0),
            (Vec3::new(-1.0, 0.0, right), 0.0),
            (Vec3::new(0.0, 1.0, -top), 0.0),
            (Vec3::new(0.0, -1.0, bottom), 0.0),
        ];
        let mut polygon = triangle.to_vec();
        for (normal, least) in planes {
            let height = |p: Vec3| normal.dot(p) - least;
            if polygon.iter().all(|&p| height(p) >= 0.0) {
                continue;
            }
            let mut kept = Vec::with_capacity(polygon.len() + 1);
            for (i, &p) in polygon.iter().enumerate() {
                let q = polygon[(i + 1) % polygon.len()];
                let (a, b) = (height(p), height(q));
                if a >= 0.0 {
                    kept.push(p);
                }
                if (a >= 0.0) != (b >= 0.0) {
                    let (p, q, a, b) = if a >= 0.0 { (p, q, a, b) } else { (q, p, b, a) };
                    kept.push(p + a / (a - b) * (q - p));
                }
            }
            polygon = kept;
        }
        // rounding may leave a new corner a little before the nearest plane
        let ideal = |p: &Vec3| Vec3::new(p.x, p.y, 1.0) / p.z.max(self.near);
        let polygon: Vec<Vec3> = polygon.iter().map(ideal).collect();
        for k in 2..polygon.len() {
            self.bend([polygon[0], polygon[k - 1], polygon[k]], id, sides, out);
        }
    }

    /// Adds a triangle, halved until its edges are where the lens puts them. Whether an edge is
    /// halved depends on its ends alone, so the triangles at both sides agree.
    fn bend(&self, [a, b, c]: [Vec3; 3], id: u32, sides: Sides, out: &mut Vec<Face>) {
        let mut pieces = vec![([a, b, c], 0)];
        while let Some((piece, depth)) = pieces.pop() {
            let off = |k: usize| {
                let (p, q) = (piece[k], piece[(k + 1) % 3]);
                let ((px, py), (qx, qy), (x, y)) = (self.bent(p), self.bent(q), self.bent(0.5 * (p + q)));
                (0.5 * (px + qx) - x).abs().max((0.5 * (py + qy) - y).abs())
            };
            let worst = (0..3).map(|k| (off(k), k)).max_by(|a, b| a.0.total_cmp(&b.0));
            match worst.filter(|_| !self.camera.distortion.is_none()) {
                // an edge of ten pictures is bent by less than that after sixteen halvings
                Some((most, k)) if most > MAX_LENS_ERROR_PX && depth < 48 => {
                    let [a, b, c] = [0, 1, 2].map(|i| piece[(k + i) % 3]);
                    let middle = 0.5 * (a + b);
                    pieces.push(([a, middle, c], depth + 1));
                    pieces.push(([middle, b, c], depth + 1));
                }
                _ => {
                    let corners = piece.map(|p| self.corner(p, MAX_CLIPPED_COORDINATE));
                    if corners.iter().all(|c| c.inverse_depth > 0.0) {
                        self.add(corners, id, sides, out);
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn add(&self, [a, b, c]: [Corner; 3], triangle: u32, sides: Sides, out: &mut Vec<Face>) {
        let area = area([a, b, c]);
        // y runs down: what is counter-clockwise from outside is so on the picture, and its area is
        // negative
        let back = (area > 0) != self.mirrored;
        if area == 0 || sides == (if back { Sides::Front } else { Sides::Back }) {
            return;
        }
        out.push(Face { corners: if area > 0 { [a, b, c] } else { [a, c, b] }, triangle, back });
    }

    /// Sorts faces into tiles; those that no sample can lie in are left out.
    fn sort(&self, faces: Vec<Face>) -> Bins {
        let mut starts = vec![0u32; self.across * self.down + 2];
        let mut found = Vec::with_capacity(faces.len() * 3 / 2);
        for (i, face) in faces.iter().enumerate() {
            let (x, y) = reach(face);
            let tiles = |(from, to): (i32, i32), side: u32, count: usize| {
                let side = side as i32 - 1;
                // an empty range stays empty
                if from > to || to < 0 || from > side {
                    return 0..0;
                }
                from.max(0) as usize / TILE..(to.min(side) as usize / TILE + 1).min(count)
            };
            for row in tiles(y, self.camera.height, self.down) {
                for column in tiles(x, self.camera.width, self.across) {
                    let tile = row * self.across + column;
                    starts[tile + 2] += 1;
                    found.push((tile as u32, i as u32));
                }
            }
        }
        for tile in 2..starts.len() {
            starts[tile] += starts[tile - 1];
        }
        let mut order = vec![0; found.len()];
        for (tile, face) in found {
            let next = &mut starts[tile as usize + 1];
            order[*next as usize] = face;
            *next += 1;
        }
        Bins { faces, order, starts }
    }
}

/// First and last column, first and last row of pixels in which a face may hold a sample; the first
/// exceeds the last if no such pixel exists.
#[inline(always)]
pub(super) fn reach(face: &Face) -> ((i32, i32), (i32, i32)) {
    let [a, b, c] = face.corners;
    let span = |a: i32, b: i32, c: i32| {
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        ((low - LAST_SAMPLE + UNIT - 1).div_euclid(UNIT), (high - FIRST_SAMPLE).div_euclid(UNIT))
    };
    (span(a.x, b.x, c.x), span(a.y, b.y, c.y))
}

//! The parts of a head that become charts, found from its shape alone: where the face looks and
//! where up is are given, the neck is where it is narrow, the collar where it widens below.
//!
//! ```text
//!        . crown .            face      in front of a line from the crown, behind the ears, down
//!      /    |      \                    the sides of the neck to the collar
//!     | face | scalp |        scalp     behind it, left and right, down to where the neck begins
//!     |   ( ear)     |        nape      behind it, below the scalp
//!      \   | nape| /          garment   below the collar, front and back
//!    ----- collar -----       cap       what closes the shoulders from below
//! ```
//!
//! All lines are drawn on a smooth copy, so that curls and folds do not make them ragged, and a
//! part is one piece: crumbs join the neighbor that they share the longest border with.

use super::divide::{components, joined};
use super::patches::straighten;
use super::smooth::smoothed;
use crate::neck::{find_neck, find_shoulders};
use glam::Vec3;
use tiface_base::geom::{Mesh, area_vector};

/// A part of a head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    Face,
    Left,
    Right,
    Nape,
    Chest,
    Back,
    Cap,
}

impl Part {
    /// All parts.
    pub const ALL: [Part; 7] =
        [Part::Face, Part::Left, Part::Right, Part::Nape, Part::Chest, Part::Back, Part::Cap];

    /// Returns the part's texels along a line, for one of the face: eyes look at a face first, at
    /// hair next, and nowhere at what closes the shoulders.
    pub fn fineness(self) -> f64 {
        match self {
            Part::Face => 1.0,
            Part::Left | Part::Right => 0.65,
            Part::Nape => 0.5,
            Part::Chest | Part::Back => 0.45,
            Part::Cap => 0.12,
        }
    }
}

/// Slices across the up direction in which the width is measured.
const SLICES: usize = 64;

/// A slice is a neck if the surface is this much wider both above and below it.
const NECK: f32 = 1.15;

/// Width, over that of the neck, from which on a slice below it is shoulders.
const COLLAR: f32 = 1.3;

/// Slope by which the line behind the ears leans forward above the middle of the face.
const LEAN: f32 = 0.36;

/// Height of the face over the width of the neck: the depth of the head is measured there.
const FACE_HEIGHT: f32 = 1.6;

/// Directions around a head and slices of it whose reach is compared with their mirror image, and
/// the most turns by half a direction: 45 degrees.
const AROUND: usize = 72;
const SYMMETRY_SLICES: usize = 16;
const MAX_TURN: i32 = 18;

/// Asymmetry, over that of the assumed front, from which on another one is clearly better.
const CLEARLY: f32 = 0.8;

/// Share of the surface below which a region joins a neighbor.
const MIN_REGION_SHARE: f64 = 0.008;

/// Cosine to the down direction from which on a triangle near the lower end may be of the cap.
const CAP_COSINE: f32 = 0.5;

/// A head's shape as far as it is needed to divide it.
pub(super) struct Head<'a> {
    mesh: &'a Mesh,
    adjacent: &'a [[u32; 3]],
    /// The copy that lines are drawn on.
    pub smooth: Mesh,
    /// Height, depth towards the front and place to the left of each triangle.
    at: Vec<[f32; 3]>,
    /// Upward component of the smooth copy's normals.
    rise: Vec<f32>,
    areas: Vec<f64>,
    /// Lowest and highest point.
    ends: [f32; 2],
    /// Where the head is narrowest above the shoulders, if it has such a place.
    neck: Option<f32>,
    /// Where shoulders begin; the lower end where there are none.
    collar: f32,
}

impl<'a> Head<'a> {
    pub fn new(mesh: &'a Mesh, adjacent: &'a [[u32; 3]], front: Vec3, up: Vec3) -> Head<'a> {
        let up = up.normalize();
        let front = front.reject_from_normalized(up).normalize_or(up.any_orthonormal_vector());
        let left = up.cross(front);
        let smooth = smoothed(mesh, smoothing(mesh.triangles.len()));
        let along = |p: Vec3| [p.dot(up), p.dot(front), p.dot(left)];
        let count = mesh.triangles.len() as u32;
        let middle = |t| smooth.corners(t).iter().sum::<Vec3>() / 3.0;
        let at: Vec<[f32; 3]> = (0..count).map(|t| along(middle(t))).collect();
        let rise = (0..count).map(|t| area_vector(smooth.corners(t)).normalize_or_zero().dot(up)).collect();
        let areas = (0..count).map(|t| mesh.area(t)).collect();
        let low = at.iter().fold(f32::INFINITY, |m, a| m.min(a[0]));
        let high = at.iter().fold(f32::NEG_INFINITY, |m, a| m.max(a[0]));
        let mut head =
            Head { mesh, adjacent, smooth, at, rise, areas, ends: [low, high], neck: None, collar: low };
        head.find_neck();
        let (sin, cos) = head.turn_to_symmetry().sin_cos();
        for [_, z, x] in &mut head.at {
            (*z, *x) = (cos * *z + sin * *x, cos * *x - sin * *z);
        }
        head
    }

    /// Returns the angle about the up direction, counter-clockwise from the assumed front, of the
    /// plane in which the head mirrors itself best: cameras may stand more to one side. 0 where no
    /// other plane is clearly better.
    fn turn_to_symmetry(&self) -> f32 {
        let heights = [self.neck.unwrap_or(self.collar), self.ends[1]];
        let Some([z0, x0]) = self.mean(1, heights).zip(self.mean(2, heights)).map(<[f32; 2]>::from) else {
            return 0.0;
        };
        // how far the head reaches from its axis in each direction and height
        let mut reach = [[0f32; AROUND]; SYMMETRY_SLICES];
        let bin = std::f32::consts::TAU / AROUND as f32;
        for &[h, z, x] in self.at.iter().filter(|at| between(at[0], heights)) {
            let share = (h - heights[0]) / (heights[1] - heights[0]);
            let row = ((share * SYMMETRY_SLICES as f32) as usize).min(SYMMETRY_SLICES - 1);
            let column = ((x - x0).atan2(z - z0) / bin).floor() as i32;
            let cell = &mut reach[row][column.rem_euclid(AROUND as i32) as usize];
            *cell = cell.max((x - x0).hypot(z - z0));
        }
        // column c mirrored at an edge of columns, or at the middle of one, is column turn - 1 - c
        let asymmetry = |turn: i32| {
            let mirrored =
                |row: &[f32; AROUND], c: usize| row[(turn - 1 - c as i32).rem_euclid(AROUND as i32) as usize];
            let of =
                |row: &[f32; AROUND]| (0..AROUND).map(|c| (row[c] - mirrored(row, c)).abs()).sum::<f32>();
            reach.iter().map(of).sum::<f32>()
        };
        let best = (-MAX_TURN..=MAX_TURN).min_by(|&a, &b| asymmetry(a).total_cmp(&asymmetry(b))).unwrap_or(0);
        if asymmetry(best) < CLEARLY * asymmetry(0) { 0.5 * bin * best as f32 } else { 0.0 }
    }

    /// Finds neck and collar by the widths of slices.
    fn find_neck(&mut self) {
        let [low, high] = self.ends;
        let slice = |h: f32| (((h - low) / (high - low) * SLICES as f32) as usize).min(SLICES - 1);
        let height = |i: usize| low + (high - low) * (i as f32 + 0.5) / SLICES as f32;
        let mut sides = [[f32::INFINITY, f32::NEG_INFINITY]; SLICES];
        for &[h, _, x] in &self.at {
            let [least, most] = &mut sides[slice(h)];
            (*least, *most) = (least.min(x), most.max(x));
        }
        let width = sides.map(|[least, most]| (most - least).max(0.0));
        let narrow = find_neck(&width, NECK);
        // hair may hide the neck: then shoulders are what is wider than the head
        let mut upper = width[SLICES / 2..].to_vec();
        upper.sort_by(f32::total_cmp);
        let (from, usual) = narrow.map_or((SLICES / 2, upper[upper.len() / 2]), |i| (i, width[i]));
        let shoulders = find_shoulders(&width, from, COLLAR * usual);
        self.neck = narrow.map(height);
        self.collar = shoulders.map_or(low, height);
    }

    /// Returns the area-weighted mean of the triangles' `axis` within `range` of heights.
    fn mean(&self, axis: usize, range: [f32; 2]) -> Option<f32> {
        let mut sums = [0.0f64; 2];
        for (at, area) in self.at.iter().zip(&self.areas).filter(|(at, _)| between(at[0], range)) {
            (sums[0], sums[1]) = (sums[0] + area * f64::from(at[axis]), sums[1] + area);
        }
        (sums[1] > 0.0).then(|| (sums[0] / sums[1]) as f32)
    }

    /// Returns the heights between which the face lies.
    fn face_heights(&self) -> [f32; 2] {
        let [low, high] = self.ends;
        let Some(neck) = self.neck else { return [self.collar, high] };
        let sides = self.at.iter().filter(|at| (at[0] - neck).abs() < (high - low) / SLICES as f32);
        let [least, most] = sides.fold([f32::INFINITY, f32::NEG_INFINITY], |[least, most], at| {
            [least.min(at[2]), most.max(at[2])]
        });
        [neck, high.min(neck + FACE_HEIGHT * (most - least).max(0.0))]
    }

    /// Returns the part of each triangle, with the line behind the ears at `depth` of the head.
    pub fn parts(&self, depth: f32) -> Vec<Part> {
        let [low, high] = self.ends;
        let face = self.face_heights();
        let mut depths: Vec<f32> = self.at.iter().filter(|at| between(at[0], face)).map(|at| at[1]).collect();
        depths.sort_by(f32::total_cmp);
        let rank = |share: f32| depths.get((share * depths.len() as f32) as usize).copied().unwrap_or(0.0);
        let (hindmost, foremost) = (rank(0.03), rank(0.97));
        let ears = foremost - depth * (foremost - hindmost);
        let level = 0.5 * (face[0] + face[1]);
        let slice = (high - low) / SLICES as f32;
        // the neck leans: below the ears the line goes to the middle of its sides
        let throat = self.neck.unwrap_or(self.collar + slice);
        let neck = self.mean(1, [throat - 2.0 * slice, throat + 2.0 * slice]).unwrap_or(ears);
        let line = |h: f32| {
            let share = ((level - h) / (level - throat)).clamp(0.0, 1.0);
            ears + share * (neck - ears) + LEAN * (h - level).max(0.0)
        };
        let middle = self.mean(2, face).unwrap_or(0.0);
        let trunk = self.mean(1, [low, self.collar]).unwrap_or(neck);
        let has_trunk = self.collar > low;
        let cap_below = if has_trunk { low + 0.6 * (self.collar - low) } else { low + 0.1 * (high - low) };
        let part = |(&[h, d, x], &rise): (&[f32; 3], &f32)| match () {
            _ if h < cap_below && rise < -CAP_COSINE => Part::Cap,
            _ if has_trunk && h < self.collar => {
                if d > trunk {
                    Part::Chest
                } else {
                    Part::Back
                }
            }
            _ if d > line(h) => Part::Face,
            _ if self.neck.is_some_and(|neck| h < neck) => Part::Nape,
            _ => {
                if x > middle {
                    Part::Left
                } else {
                    Part::Right
                }
            }
        };
        self.at.iter().zip(&self.rise).map(part).collect()
    }

    /// Returns regions of connected triangles and the part that each is of. The face is one region
    /// and encloses no other.
    pub fn regions(&self, depth: f32) -> (Vec<u32>, Vec<Part>) {
        let mut parts = self.parts(depth);
        straighten(self.adjacent, &mut parts);
        let middle = self.mean(2, self.face_heights()).unwrap_or(0.0);
        let face =
            largest(self.adjacent, &self.areas, &parts.iter().map(|p| *p == Part::Face).collect::<Vec<_>>());
        for (t, part) in parts.iter_mut().enumerate().filter(|(t, part)| **part == Part::Face && !face[*t]) {
            *part = if self.at[t][2] > middle { Part::Left } else { Part::Right };
        }
        let mut region =
            joined(self.mesh, self.adjacent, components(self.adjacent, &parts), MIN_REGION_SHARE);
        let count = region.iter().max().map_or(0, |most| *most as usize + 1);
        let mut areas = vec![[0.0; Part::ALL.len()]; count];
        for (t, &r) in region.iter().enumerate() {
            areas[r as usize][parts[t] as usize] += self.areas[t];
        }
        let most = |a: &[f64; Part::ALL.len()]| {
            (1..a.len()).fold(0, |best, k| if a[k] > a[best] { k } else { best })
        };
        let part: Vec<Part> = areas.iter().map(|a| Part::ALL[most(a)]).collect();
        if let Some(face) = part.iter().position(|p| *p == Part::Face) {
            let mut is_face: Vec<bool> = region.iter().map(|&r| r as usize == face).collect();
            fill(self.adjacent, &self.areas, &mut is_face);
            (0..region.len()).filter(|&t| is_face[t]).for_each(|t| region[t] = face as u32);
        }
        (region, part)
    }
}

/// Gives a region all that it encloses: what is not connected with most of the rest.
fn fill(adjacent: &[[u32; 3]], areas: &[f64], is_within: &mut [bool]) {
    let around = largest(adjacent, areas, &is_within.iter().map(|w| !w).collect::<Vec<_>>());
    is_within.iter_mut().zip(around).for_each(|(within, around)| *within = !around);
}

/// Returns which of the `wanted` triangles are of their largest connected piece.
fn largest(adjacent: &[[u32; 3]], areas: &[f64], wanted: &[bool]) -> Vec<bool> {
    let piece = components(adjacent, wanted);
    let mut sums = vec![0.0; piece.iter().max().map_or(0, |most| *most as usize + 1)];
    (0..wanted.len()).filter(|&t| wanted[t]).for_each(|t| sums[piece[t] as usize] += areas[t]);
    let largest = (0..sums.len()).max_by(|&a, &b| sums[a].total_cmp(&sums[b]));
    piece.iter().zip(wanted).map(|(&p, wanted)| *wanted && Some(p as usize) == largest).collect()
}

fn between(h: f32, [low, high]: [f32; 2]) -> bool {
    low < h && h < high
}

/// Returns the rounds of smoothing for lines: curls are as large on a mesh of many triangles.
fn smoothing(triangles: usize) -> usize {
    (30 * triangles / 50_000).clamp(8, 120)
}

#[cfg(test)]
mod tests {
    use super::super::patches::{NONE, neighbors};
    use super::*;

    #[test]
    fn what_the_face_encloses_is_of_the_face_and_its_islands_are_not() {
        // a strip: 0 of the face, 1 deep, 2 of the face, 3 to 6 behind, 7 apart from all
        let adjacent = [
            [NONE, 1, 2],
            [0, 2, NONE],
            [1, 0, 3],
            [2, 4, NONE],
            [3, 5, NONE],
            [4, 6, NONE],
            [5, NONE, NONE],
            [NONE; 3],
        ];
        let mut is_face = [true, false, true, false, false, false, true, false];
        let main = largest(&adjacent, &[1.0; 8], &is_face);
        assert_eq!(main, [true, false, true, false, false, false, false, false]);
        is_face[6] = false;
        fill(&adjacent, &[1.0; 8], &mut is_face);
        assert_eq!(is_face, [true, true, true, false, false, false, false, true]);
    }

    /// Returns a tube around the y axis with these radii, one a unit of height, closed by its
    /// poles.
    fn vase(radii: &[f32]) -> Mesh {
        let around = 32u32;
        let rows = radii.len() as u32;
        let mut mesh = Mesh::default();
        for (y, r) in radii.iter().enumerate() {
            for j in 0..around {
                let (sin, cos) = (std::f32::consts::TAU * j as f32 / around as f32).sin_cos();
                mesh.positions.push(Vec3::new(r * sin, y as f32, r * cos));
            }
        }
        mesh.positions.extend([Vec3::ZERO, (rows - 1) as f32 * Vec3::Y]);
        let at = |i: u32, j: u32| i * around + j % around;
        let (low, high) = (rows * around, rows * around + 1);
        for j in 0..around {
            mesh.triangles
                .extend([[low, at(0, j + 1), at(0, j)], [high, at(rows - 1, j), at(rows - 1, j + 1)]]);
            for i in 0..rows - 1 {
                mesh.triangles.push([at(i, j), at(i, j + 1), at(i + 1, j + 1)]);
                mesh.triangles.push([at(i, j), at(i + 1, j + 1), at(i + 1, j)]);
            }
        }
        mesh
    }

    /// Radii of a bust: shoulders up to 30, a neck up to 42, a head.
    fn radius(y: f32) -> f32 {
        match y {
            _ if y < 30.0 => 34.0 - 0.4 * y,
            _ if y < 42.0 => 9.0,
            _ => (17f32.powi(2) - (y - 58.0).powi(2)).max(9.0).sqrt().max(3.0),
        }
    }

    #[test]
    fn neck_and_collar_are_where_the_shape_narrows_and_widens() {
        let radii: Vec<f32> = (0..76).map(|y| radius(y as f32)).collect();
        let mesh = vase(&radii);
        assert!(mesh.is_closed() && mesh.signed_volume() > 0.0);
        let adjacent = neighbors(&mesh);
        let head = Head::new(&mesh, &adjacent, Vec3::Z, Vec3::Y);
        assert!((30.0..46.0).contains(&head.neck.unwrap()), "{:?}", head.neck);
        assert!((26.0..33.0).contains(&head.collar), "{}", head.collar);
        let parts = head.parts(0.6);
        let part = |p: Vec3| {
            let distance = |t: usize| (mesh.corners(t as u32).iter().sum::<Vec3>() / 3.0).distance(p);
            parts[(0..parts.len()).min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap()]
        };
        assert_eq!(part(Vec3::new(0.0, 58.0, 17.0)), Part::Face);
        assert_eq!([1.0, -1.0].map(|x| part(Vec3::new(4.0 * x, 58.0, -16.0))), [Part::Left, Part::Right]);
        assert_eq!([1.0, -1.0].map(|z| part(Vec3::new(0.0, 15.0, 28.0 * z))), [Part::Chest, Part::Back]);
        assert_eq!(part(Vec3::ZERO), Part::Cap);
    }

    #[test]
    fn without_shoulders_there_is_no_collar() {
        let radii: Vec<f32> = (0..40).map(|y| radius(36.0 + y as f32)).collect();
        let mesh = vase(&radii);
        let adjacent = neighbors(&mesh);
        let head = Head::new(&mesh, &adjacent, Vec3::Z, Vec3::Y);
        assert!(head.neck.is_none() && head.collar == head.ends[0]);
        let parts = head.parts(0.6);
        assert!(!parts.iter().any(|p| [Part::Chest, Part::Back, Part::Nape].contains(p)));
        // hair down to the shoulders hides a neck, not them
        let radii: Vec<f32> = (0..76).map(|y| radius(y as f32).max(16.0)).collect();
        let mesh = vase(&radii);
        let adjacent = neighbors(&mesh);
        let head = Head::new(&mesh, &adjacent, Vec3::Z, Vec3::Y);
        assert!(head.neck.is_none() && (24.0..34.0).contains(&head.collar), "{}", head.collar);
    }
}

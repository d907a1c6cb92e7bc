//! Measures of a head by its shape alone: where crown, chin, nape and neck are, and the planes that
//! cut it below them.
//!
//! The neck is the height whose horizontal section is smallest beside larger ones above and below
//! ([`find_neck`]).
//! Above it the profile of the middle runs from the neck forward to the chin and up the face: the
//! chin is where it lies farthest before the straight line from the neck to the nose. On the other
//! side the nape is where the back of the profile lies farthest forward.

use crate::cut::Plane;
use crate::neck::{find_neck, find_shoulders};
use crate::{check_indices, finite};
use glam::{DVec2, DVec3, Vec3};
use tiface_base::geom::Mesh;
use tiface_base::{Error, Result};

/// Heights at which a head is measured.
const LEVELS: usize = 400;

/// Share of a neck's section by which what is above and below must be larger.
const NARROWER: f32 = 1.1;

/// Sections of the neck, in its smallest: below, shoulders begin; up to the second, its front is
/// looked for.
const SHOULDERS: [f32; 2] = [1.25, 1.5];

/// Share of its largest distance from the line between neck and nose at which the chin ends.
const CHIN_END: f64 = 0.5;

/// Smallest distance of a chin from that line, in the line's length: 45 mm of 150 would be far.
const FLAT_CHIN: f64 = 0.03;

/// Part of a head's height that a cut leaves below the chin.
const BELOW_CHIN: f64 = 0.03;

/// Largest angle by which a cut rises to the nape, radians: the lower edge of the jaw rises by 25
/// degrees.
const MAX_TILT: f64 = 20.0 * std::f64::consts::PI / 180.0;

/// Where the parts of a head are. Heights are along `up`, all lengths in the mesh's units.
#[derive(Clone, Debug, PartialEq)]
pub struct HeadMeasures {
    /// The up direction, a unit vector.
    pub up: Vec3,
    /// The direction in which the face looks, a unit vector perpendicular to `up`.
    pub front: Vec3,
    /// Height of the highest point, hair and hat included.
    pub crown: f32,
    /// Height of the lower end of the chin.
    pub chin: f32,
    /// Height of the neck's base, below which shoulders begin; `None` of a head without shoulders.
    pub collar: Option<f32>,
    /// The lower end of the chin, in the middle of the face.
    pub chin_point: Vec3,
    /// The point of the nape that lies farthest forward.
    pub nape: Vec3,
}

impl HeadMeasures {
    /// Returns the height of the head, from the chin to the crown.
    pub fn height(&self) -> f32 {
        self.crown - self.chin
    }

    /// Returns the plane that cuts the head off below the chin; it rises towards the nape, by 20
    /// degrees at most.
    pub fn chin_plane(&self) -> Plane {
        let back = self.nape - self.chin_point;
        let (rise, run) = (f64::from(back.dot(self.up)), -f64::from(back.dot(self.front)));
        let (sin, cos) = rise.atan2(run.max(1e-6)).clamp(0.0, MAX_TILT).sin_cos();
        let below = self.chin_point - BELOW_CHIN as f32 * self.height() * self.up;
        Plane { point: below, normal: cos as f32 * self.up + sin as f32 * self.front }
    }

    /// Returns the horizontal plane that cuts the head off at the neck's base, above the shoulders.
    ///
    /// # Errors
    ///
    /// Fails if there are no shoulders.
    pub fn collar_plane(&self) -> Result<Plane> {
        let Some(collar) = self.collar else {
            return Err(Error::usage(
                "the mesh has no shoulders below its neck, so nothing is to be cut off at the collar",
                "leave the cut out, or cut at the chin",
            ));
        };
        Ok(Plane { point: self.nape + (collar - self.nape.dot(self.up)) * self.up, normal: self.up })
    }
}

/// Measures a closed mesh of a head, upright along `up`, whose face looks along `front`; both may
/// have any length but 0.
///
/// # Errors
///
/// Fails if the mesh is damaged, and if the profile of the face has no chin: if the head ends above
/// its neck, or one of the directions is another one.
pub fn measure(mesh: &Mesh, up: Vec3, front: Vec3) -> Result<HeadMeasures> {
    finite(mesh)?;
    check_indices(mesh)?;
    let frame = up.as_dvec3().try_normalize().and_then(|up| {
        let front = front.as_dvec3().reject_from_normalized(up).try_normalize()?;
        Some([front.cross(up), front, up])
    });
    let Some(frame) = frame else {
        return Err(Error::usage(
            format!("{up} and {front} are no directions of a head, up and to the front"),
            "give two directions that are not parallel",
        ));
    };
    let placed = Placed::new(mesh, frame);
    let sections = placed.sections();
    let neck = Neck::find(&sections);
    let middle = placed.middle(neck.narrowest);
    let profile = placed.profile(middle);
    let chin = profile.chin(&sections, &neck)?;
    let at = |p: DVec2| (frame[0] * middle + frame[1] * p.x + frame[2] * p.y).as_vec3();
    let height = |level: usize| placed.height(level) as f32;
    Ok(HeadMeasures {
        up: frame[2].as_vec3(),
        front: frame[1].as_vec3(),
        crown: placed.range[1] as f32,
        chin: chin.lowest.y as f32,
        collar: neck.base.map(height),
        chin_point: at(chin.lowest),
        nape: at(chin.nape),
    })
}

/// A mesh in coordinates of its head: to the left of the face, forward and up.
struct Placed<'a> {
    positions: Vec<DVec3>,
    triangles: &'a [[u32; 3]],
    /// Lowest and highest point.
    range: [f64; 2],
}

impl Placed<'_> {
    fn new(mesh: &Mesh, frame: [DVec3; 3]) -> Placed<'_> {
        let place = |p: &Vec3| DVec3::from(frame.map(|axis| axis.dot(p.as_dvec3())));
        let positions: Vec<DVec3> = mesh.positions.iter().map(place).collect();
        let range = extent(positions.iter().map(|p| p.z));
        Placed { positions, triangles: &mesh.triangles, range }
    }

    /// Returns the height of a level.
    fn height(&self, level: usize) -> f64 {
        let [low, high] = self.range;
        low + (level as f64 + 0.5) / LEVELS as f64 * (high - low)
    }

    /// Returns the levels between two heights.
    fn levels(&self, low: f64, high: f64) -> std::ops::Range<usize> {
        let [least, most] = self.range;
        let level = |h: f64| ((h - least) / (most - least) * LEVELS as f64 - 0.5).ceil().max(0.0) as usize;
        level(low)..level(high).min(LEVELS)
    }

    /// Returns the areas of the horizontal sections, by Gauss's formula over the edges of each.
    fn sections(&self) -> Vec<f32> {
        let mut doubled = vec![0.0; LEVELS];
        for t in self.triangles {
            let corners = t.map(|v| self.positions[v as usize]);
            let [low, high] = extent(corners.iter().map(|p| p.z));
            for level in self.levels(low, high) {
                if let Some([a, b]) = crossed(corners, |p| p.z - self.height(level)) {
                    doubled[level] += a.x * b.y - a.y * b.x;
                }
            }
        }
        doubled.into_iter().map(|area| (0.5 * area.abs()) as f32).collect()
    }

    /// Returns the middle of what is above a level, from the left to the right.
    fn middle(&self, level: usize) -> f64 {
        let height = self.height(level);
        let [left, right] = extent(self.positions.iter().filter(|p| p.z > height).map(|p| p.x));
        0.5 * (left + right)
    }

    /// Returns the profile near the plane through the middle.
    fn profile(&self, middle: f64) -> Profile {
        let mut ends = vec![[f64::NEG_INFINITY, f64::INFINITY]; LEVELS];
        let [low, high] = extent(self.positions.iter().map(|p| p.y));
        // a nose or chin is seldom exactly in the middle
        for aside in [-0.02, -0.01, 0.0, 0.01, 0.02].map(|share| middle + share * (high - low)) {
            for t in self.triangles {
                let corners = t.map(|v| self.positions[v as usize]);
                let Some([a, b]) = crossed(corners, |p| p.x - aside) else { continue };
                let [low, high] = extent([a.z, b.z].into_iter());
                for level in self.levels(low, high) {
                    let y = a.y + (self.height(level) - a.z) / (b.z - a.z) * (b.y - a.y);
                    ends[level] = [ends[level][0].max(y), ends[level][1].min(y)];
                }
            }
        }
        let point =
            |k: usize| move |(level, ends): (usize, &[f64; 2])| DVec2::new(ends[k], self.height(level));
        let side = |k: usize| ends.iter().enumerate().map(point(k)).collect();
        Profile { front: side(0), back: side(1) }
    }
}

/// Returns the points where the sides of a triangle cross a surface of heights: where it goes up
/// first.
fn crossed(corners: [DVec3; 3], height: impl Fn(DVec3) -> f64) -> Option<[DVec3; 2]> {
    let heights = corners.map(height);
    let (mut up, mut down) = (None, None);
    for k in 0..3 {
        let next = (k + 1) % 3;
        let point = || corners[k].lerp(corners[next], heights[k] / (heights[k] - heights[next]));
        match (heights[k] > 0.0, heights[next] > 0.0) {
            (false, true) => up = Some(point()),
            (true, false) => down = Some(point()),
            _ => {}
        }
    }
    Some([up?, down?])
}

/// Returns the least and the largest of some values.
fn extent(values: impl Iterator<Item = f64>) -> [f64; 2] {
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
}

/// The levels of a neck.
struct Neck {
    narrowest: usize,
    /// Where shoulders begin.
    base: Option<usize>,
    /// Lowest level at which the neck's front is looked for.
    floor: usize,
}

impl Neck {
    /// Finds the neck of a head by the areas of its sections.
    fn find(sections: &[f32]) -> Neck {
        let Some(narrowest) = find_neck(sections, NARROWER) else {
            return Neck { narrowest: 0, base: None, floor: 0 };
        };
        let above = |part: f32| {
            let wide = find_shoulders(sections, narrowest, part * sections[narrowest]);
            wide.map_or(0, |level| level + 1)
        };
        let [base, floor] = SHOULDERS.map(above);
        Neck { narrowest, base: Some(base), floor }
    }
}

/// The outline of a head from the side: points forward and up, from the lowest level on.
struct Profile {
    front: Vec<DVec2>,
    back: Vec<DVec2>,
}

/// The lower part of a profile.
struct Chin {
    lowest: DVec2,
    nape: DVec2,
}

impl Profile {
    fn chin(&self, sections: &[f32], neck: &Neck) -> Result<Chin> {
        let none = |why: &str| {
            let hint = "name two points and their distance instead of the head's height, or a plane of your own; \
                        the face must look to the front, and the crown up";
            Error::cannot(format!("the head has no chin to measure it by: {why}"), hint)
        };
        let ends_early = || none("it ends above its neck, or its profile does not recede below the face");
        let front = |range: std::ops::Range<usize>| range.filter(|&k| self.front[k].x.is_finite());
        let widest = sections.iter().copied().fold(0.0, f32::max);
        let foremost = |a: &usize, b: &usize| self.front[*a].x.total_cmp(&self.front[*b].x);
        let nose = front(neck.floor..LEVELS).filter(|&k| sections[k] > 0.05 * widest).max_by(foremost);
        let nose = nose.ok_or_else(ends_early)?;
        let hollow = front(neck.floor..nose).min_by(foremost).ok_or_else(ends_early)?;
        let (most, least) = (self.front[nose].x, self.front[hollow].x);
        let depth = most - extent(self.back.iter().map(|p| p.x))[0];
        if most - least < 0.1 * depth {
            return Err(ends_early());
        }
        // the upper end of where the neck is hollow, and of where the face is foremost
        let is_hollow = |k: &usize| self.front[*k].x < least + 0.05 * (most - least);
        let bottom = front(hollow..nose).take_while(is_hollow).last().unwrap_or(hollow);
        let is_face = |k: &usize| self.front[*k].x > least + 0.9 * (most - least);
        let top = front(nose..LEVELS).take_while(is_face).last().unwrap_or(nose);
        let line = self.front[top] - self.front[bottom];
        let before = |k: usize| -line.normalize_or_zero().perp_dot(self.front[k] - self.front[bottom]);
        let farthest = front(bottom..top).map(before).fold(0.0, f64::max);
        if farthest < FLAT_CHIN * line.length() {
            return Err(none("its profile runs straight from the neck to the nose"));
        }
        let lowest = front(bottom..top).find(|&k| before(k) >= CHIN_END * farthest).ok_or_else(ends_early)?;
        let nape = front(neck.floor..top).max_by(|&a, &b| self.back[a].x.total_cmp(&self.back[b].x));
        let nape = nape.ok_or_else(ends_early)?;
        Ok(Chin { lowest: self.front[lowest], nape: self.back[nape] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ExtractOptions, extract};
    use tiface_base::Quiet;
    use tiface_base::geom::{Aabb, Similarity};

    /// Returns the surface of a field in the scene's box: z is up, and the face looks along −y.
    fn meshed(field: impl Fn(Vec3) -> f32 + Sync) -> Mesh {
        let options = ExtractOptions { resolution: 64, ..ExtractOptions::default() };
        extract(&field, Aabb::SCENE, &options, &Quiet).unwrap().0
    }

    fn ball(p: Vec3, center: Vec3, radii: Vec3) -> f32 {
        (((p - center) / radii).length() - 1.0) * radii.min_element()
    }

    /// Returns a head from 0.9 down to -0.1 on a neck of radius 0.2: an ellipsoid, 0.4 wide and 0.5
    /// deep on each side.
    fn head(p: Vec3) -> f32 {
        let neck = (p.x.hypot(p.y) - 0.2).max(p.z - 0.4).max(-0.9 - p.z);
        ball(p, Vec3::new(0.0, 0.0, 0.4), Vec3::new(0.4, 0.5, 0.5)).min(neck)
    }

    fn bust(p: Vec3) -> f32 {
        let shoulders = Vec3::new(p.x.abs() - 0.8, p.y.abs() - 0.3, (p.z + 0.7).abs() - 0.2);
        head(p).min(shoulders.max_element())
    }

    #[test]
    fn an_ellipsoid_on_a_neck_on_a_box_has_its_chin_collar_and_crown() {
        let mesh = meshed(bust);
        let found = measure(&mesh, Vec3::Z, -Vec3::Y).unwrap();
        assert!((found.crown - 0.9).abs() < 0.01, "{found:?}");
        // the box ends at -0.5
        let collar = found.collar.unwrap();
        assert!((collar + 0.5).abs() < 0.04, "{found:?}");
        // the ellipsoid meets the neck, 0.2 from the middle of 0.5, at 0.4 - 0.5 √(1 - 0.16) =
        // -0.06, and is at 45 degrees at 0.4 - 0.35 = 0.05
        assert!(found.chin > -0.06 && found.chin < 0.1, "{found:?}");
        assert!((found.height() - (found.crown - found.chin)).abs() < 1e-6);
        assert!(found.chin_point.y < -0.25 && found.nape.y > 0.18 && found.nape.y < 0.25, "{found:?}");
        // the same wherever it stands and however it is turned
        let turned = Similarity {
            scale: 1.0,
            rotation: glam::DMat3::from_rotation_x(0.5),
            translation: DVec3::new(3.0, 1.0, 2.0),
        };
        let again = measure(
            &mesh.transformed(&turned),
            7.0 * turned.direction(Vec3::Z),
            turned.direction(Vec3::new(0.0, -1.0, 0.3)),
        );
        let again = again.unwrap();
        assert!((again.height() - found.height()).abs() < 0.01, "{again:?}");
        assert!(again.chin_point.distance(turned.point(found.chin_point)) < 0.02, "{again:?}");
    }

    #[test]
    fn the_planes_part_the_head_from_what_is_below() {
        let mesh = meshed(bust);
        let found = measure(&mesh, Vec3::Z, -Vec3::Y).unwrap();
        let collar = found.collar_plane().unwrap();
        assert!(
            collar.height(Vec3::new(0.5, 0.0, -0.55)) < 0.0 && collar.height(Vec3::new(0.2, 0.0, -0.4)) > 0.0
        );
        let chin = found.chin_plane();
        assert!(chin.height(found.chin_point) > 0.0 && chin.height(found.chin_point) < 0.04);
        // the middle of the neck
        assert!(chin.height(Vec3::new(0.0, 0.0, -0.3)) < 0.0);
        let tilt = chin.normal.normalize().angle_between(Vec3::Z);
        assert!((0.0..=MAX_TILT as f32 + 1e-3).contains(&tilt), "{tilt}");
    }

    #[test]
    fn a_head_that_ends_at_the_neck_has_a_chin_and_no_collar() {
        let mesh = meshed(head);
        let found = measure(&mesh, Vec3::Z, -Vec3::Y).unwrap();
        assert!(found.chin > -0.06 && found.chin < 0.1 && found.collar.is_none(), "{found:?}");
        let e = found.collar_plane().unwrap_err();
        assert!(e.to_string().contains("no shoulders") && e.hint().contains("at the chin"), "{e}");
    }

    #[test]
    fn a_head_without_a_neck_is_refused_by_name() {
        // the upper half of the ellipsoid
        let mesh = meshed(|p| head(p).max(0.4 - p.z));
        let e = measure(&mesh, Vec3::Z, -Vec3::Y).unwrap_err();
        assert!(e.to_string().contains("ends above its neck") && e.hint().contains("two points"), "{e}");
        assert!(measure(&mesh, Vec3::Z, Vec3::Z).unwrap_err().to_string().contains("no directions"));
    }
}

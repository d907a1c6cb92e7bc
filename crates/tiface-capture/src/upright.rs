//! Where up is, by how cameras are held.
//!
//! Of a camera that is held level, the right axis is horizontal, however much it looks down; of one
//! that is held on its side, the up axis is. Up `n` is therefore where each camera's image of it,
//! `(n · right, n · up)`, lies near a multiple of 90°, and is long: a camera that looks along `n`
//! shows nothing of it. Candidates are the normals of any two image axes of two cameras, and those
//! axes themselves; the best one says how each camera is rolled, and cameras that are rolled back
//! give the direction.

use glam::{DMat3, DVec3};

/// Maximum number of cameras whose axes make candidates, and of those that are compared with each.
const SEARCHED: [usize; 2] = [32, 128];

/// Share of cameras that are level where nothing is searched.
const LEVEL: f64 = 0.9;

/// Angle to a multiple of 90° within which a camera is held straight, degrees.
const STRAIGHT: f64 = 25.0;

/// Weight of a camera that is rolled, where one that is not counts 1: most photographs are upright.
const ROLLED: f64 = 0.8;

/// Length of the image of up beyond which more length is no evidence: cameras may look down by 45°.
const LONG: f64 = 0.7;

/// How a direction lies in a camera's picture.
struct Roll {
    /// Quarter turns from the picture's up towards its right, 0 to 3.
    quarters: usize,
    /// Angle to the nearest quarter, degrees.
    off: f64,
    /// Length of its image, 0..=1.
    length: f64,
}

impl Roll {
    fn of(camera: &DMat3, up: DVec3) -> Roll {
        let (x, y) = (camera.x_axis.dot(up), camera.y_axis.dot(up));
        let angle = x.atan2(y).to_degrees();
        let nearest = (angle / 90.0).round();
        let quarters = (nearest as i32).rem_euclid(4) as usize;
        Roll { quarters, off: (angle - 90.0 * nearest).abs(), length: x.hypot(y) }
    }

    fn is_straight(&self) -> bool {
        self.off < STRAIGHT
    }
}

/// Returns up, and how many cameras are rolled by a quarter turn or more.
pub(super) fn upward(cameras: &[DMat3]) -> (DVec3, usize) {
    let level = level_up(cameras.iter().copied());
    let is_level = |camera: &&DMat3| {
        let roll = Roll::of(camera, level);
        (roll.quarters == 0 && roll.is_straight()) || roll.length < 0.2
    };
    if cameras.iter().filter(is_level).count() as f64 >= LEVEL * cameras.len() as f64 {
        return (level, 0);
    }
    let compared = spread(cameras, SEARCHED[1]);
    let mut best = (f64::NEG_INFINITY, level);
    for candidate in candidates(&spread(cameras, SEARCHED[0]), level) {
        let score = score(&compared, candidate);
        if score > best.0 {
            best = (score, candidate);
        }
    }
    let mut up = signed(cameras, best.1);
    for _ in 0..3 {
        let straight = cameras.iter().map(|c| (c, Roll::of(c, up))).filter(|(_, roll)| roll.is_straight());
        let unrolled: Vec<DMat3> = straight.map(|(c, roll)| rolled_back(c, roll.quarters)).collect();
        if unrolled.is_empty() {
            return (level, 0);
        }
        up = level_up(unrolled.iter().copied());
    }
    let is_rolled = |camera: &&DMat3| {
        let roll = Roll::of(camera, up);
        roll.quarters != 0 && roll.is_straight()
    };
    (up, cameras.iter().filter(is_rolled).count())
}

/// Returns at most `count` cameras, evenly spread over all.
fn spread(cameras: &[DMat3], count: usize) -> Vec<DMat3> {
    cameras.iter().step_by(cameras.len().div_ceil(count).max(1)).copied().collect()
}

/// Returns directions that are level up, an image axis, or perpendicular to two of them, each with
/// its opposite.
fn candidates(cameras: &[DMat3], level: DVec3) -> Vec<DVec3> {
    let axes: Vec<DVec3> = cameras.iter().flat_map(|c| [c.x_axis, c.y_axis]).collect();
    let pairs = axes.iter().enumerate().flat_map(|(i, a)| axes[..i].iter().map(|b| a.cross(*b)));
    // axes that are nearly parallel have no direction in common
    let normals = pairs.filter(|n| n.length() > 0.1).map(DVec3::normalize);
    [level].into_iter().chain(axes.iter().copied()).chain(normals).flat_map(|n| [n, -n]).collect()
}

fn score(cameras: &[DMat3], up: DVec3) -> f64 {
    let of = |camera: &DMat3| {
        let roll = Roll::of(camera, up);
        let weight = if roll.quarters == 0 { 1.0 } else { ROLLED };
        weight * (roll.length / LONG).min(1.0) * (1.0 - (roll.off / STRAIGHT).powi(2)).max(0.0)
    };
    cameras.iter().map(of).sum()
}

/// Returns a direction or its opposite: where most cameras are upright. Where none is upright or
/// upside down, up is left in most pictures, as in those of a phone that are stored on their side.
fn signed(cameras: &[DMat3], up: DVec3) -> DVec3 {
    let mut count = [0usize; 4];
    cameras.iter().for_each(|camera| count[Roll::of(camera, up).quarters] += 1);
    let [upright, right, down, left] = count;
    if (upright, left) < (down, right) { -up } else { up }
}

/// Returns a camera that is turned in its picture by so many quarters, so that what lay there is
/// up.
fn rolled_back(camera: &DMat3, quarters: usize) -> DMat3 {
    let (x, y) = (camera.x_axis, camera.y_axis);
    let (x, y) = [(x, y), (-y, x), (-x, -y), (y, -x)][quarters];
    DMat3::from_cols(x, y, camera.z_axis)
}

/// Returns the direction perpendicular to the right axes of cameras: those of a level camera are
/// horizontal, however much it looks down. Where all look the same way, it is the mean of their
/// ups, which is tilted by how much they look down.
fn level_up(cameras: impl Iterator<Item = DMat3> + Clone) -> DVec3 {
    /// Weight of the mean.
    const MEAN: f64 = 0.01;
    let mean: DVec3 = cameras.clone().map(|c| c.y_axis).sum();
    let n = cameras.clone().count() as f64;
    // cameras whose ups cancel say nothing; +Y is what most formats mean
    let Some(mean) = mean.try_normalize().filter(|_| mean.length() > 1e-6 * n) else { return DVec3::Y };
    let square =
        |c: DMat3| DMat3::from_cols(c.x_axis * c.x_axis.x, c.x_axis * c.x_axis.y, c.x_axis * c.x_axis.z);
    let spread = cameras.map(square).fold(MEAN * n * DMat3::IDENTITY, |sum, s| sum + s);
    (spread.inverse() * mean).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    /// A camera at an azimuth that looks down by a pitch and is rolled by quarters, degrees but for
    /// the quarters.
    fn camera(azimuth: f64, pitch: f64, quarters: f64) -> DMat3 {
        let turn = DMat3::from_rotation_y(azimuth.to_radians());
        turn * DMat3::from_rotation_x(-pitch.to_radians()) * DMat3::from_rotation_z(quarters * FRAC_PI_2)
    }

    fn world() -> DMat3 {
        DMat3::from_rotation_x(0.7) * DMat3::from_rotation_z(-0.5)
    }

    /// How far up is off in a world that is turned, degrees, and how many cameras are rolled.
    fn off(cameras: &[DMat3]) -> (f64, usize) {
        let turned: Vec<DMat3> = cameras.iter().map(|camera| world() * *camera).collect();
        let (up, rolled) = upward(&turned);
        (up.angle_between(world() * DVec3::Y).to_degrees(), rolled)
    }

    #[test]
    fn up_is_found_in_any_world_although_cameras_in_front_look_down() {
        let ring: Vec<DMat3> = (-8..=8).map(|i| camera(8.6 * f64::from(i), 25.0, 0.0)).collect();
        assert!(off(&ring).0 < 1.0, "{:?}", off(&ring));
        // the mean of their ups, where nothing else is known
        assert!((off(&[camera(0.0, 25.0, 0.0); 3]).0 - 25.0).abs() < 1e-6);
        // cameras that stand on their heads cancel the others
        let level = level_up([DMat3::IDENTITY, DMat3::from_rotation_z(PI)].into_iter());
        assert_eq!(level, DVec3::Y);
    }

    #[test]
    fn up_is_not_tilted_by_portrait_photographs_among_landscape_ones() {
        for pitch in [0.0, 25.0, 60.0] {
            for (from, to) in [(0.0, 360.0), (-80.0, 80.0)] {
                // every third is rolled, to one side or the other, and one stands on its head
                let quarters = |i: i32| [0.0, 1.0, 0.0, 0.0, 3.0, 0.0][i as usize % 6];
                let azimuth = |i: i32| from + (to - from) * f64::from(i) / 24.0;
                let mut cameras: Vec<DMat3> =
                    (0..24).map(|i| camera(azimuth(i), pitch, quarters(i))).collect();
                cameras[0] = camera(azimuth(0), pitch, 2.0);
                let (off, rolled) = off(&cameras);
                assert!(off < 4.0 && rolled == 9, "pitch {pitch}, {from} to {to}: {off}, {rolled}");
            }
        }
    }

    #[test]
    fn up_is_found_where_most_photographs_are_portrait_and_elevations_differ() {
        let pitch = |i: i32| [-20.0, 0.0, 40.0][i as usize % 3];
        let quarters = |i: i32| if i % 4 == 0 { 0.0 } else { 1.0 };
        let cameras: Vec<DMat3> =
            (0..24).map(|i| camera(15.0 * f64::from(i), pitch(i), quarters(i))).collect();
        let (off, rolled) = off(&cameras);
        assert!(off < 1.0 && rolled == 18, "{off}, {rolled}");
    }

    #[test]
    fn cameras_that_all_lie_on_their_side_have_up_on_the_left_of_their_pictures() {
        let ring = |quarters: f64| {
            let cameras = (0..16).map(|i| camera(22.5 * f64::from(i), 10.0, quarters));
            off(&cameras.collect::<Vec<_>>())
        };
        // three quarters from up towards the right is left; one is right, where up is taken for
        // down
        let ([left, right], all) = ([ring(3.0), ring(1.0)], 16);
        assert!(left.0 < 1.0 && left.1 == all, "{left:?}");
        assert!(right.0 > 179.0 && right.1 == all, "{right:?}");
    }

    #[test]
    fn level_cameras_with_shaky_hands_are_as_before() {
        let shaky = |i: i32| {
            let roll = [0.1, -0.2, 0.15, -0.05][i as usize % 4];
            camera(15.0 * f64::from(i), 20.0, roll)
        };
        let cameras: Vec<DMat3> = (0..24).map(shaky).collect();
        assert_eq!(upward(&cameras), (level_up(cameras.iter().copied()), 0));
        assert_eq!(upward(&[]), (DVec3::Y, 0));
    }
}

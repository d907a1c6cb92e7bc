//! Decides which cameras are to be refined, from the result of an adjustment of all.

use super::adjust::{Track, adjust, median};
use super::{LEAST_SCALE, Rig, distance_px, residuals, sampled, sightings};
use serde::{Deserialize, Serialize};
use tiface_base::geom::Camera;

/// Sightings that a camera needs to be judged at all.
pub const LEAST_SIGHTINGS: usize = 30;

/// Points that a camera must be expected to see for too few sightings to mean that it is wrong.
const LEAST_EXPECTED: usize = 5 * LEAST_SIGHTINGS;

/// Points that must be found for anything to be said.
const LEAST_TRACKS: usize = 100;

/// A camera is not repaired but reported if it has to move farther, pixels: the patches would
/// hardly be found.
const FARTHEST_PX: f64 = 10.0;

/// Patches of a photograph fit somewhere by chance: its camera is lost if its residual stays above
/// this many pixels …
const LOST_PX: f64 = 1.0;

/// … and above this many times that of all.
const LOST_SHARE: f64 = 4.0;

/// All cameras are refined if the residual falls below this share of what it is with the poses
/// given.
const GAIN: f64 = 0.8;

/// Cameras fit in no pose if the residual of all stays above this many pixels, and less than this
/// share of the points that other photographs share is found. Nine of ten are found where
/// photographs and cameras belong together, blurred ones (whose residual is above a pixel) and
/// poses that are 4 px off included; a third to six of ten in a wrong order, and up to eight where
/// every photograph is a neighbor's.
const APART: [(f64, f64); 2] = [(1.0, 0.8), (0.4, 0.65)];

/// A single camera is refined if it has to move at least so far, pixels …
const LEAST_MOVE_PX: f64 = 0.8;

/// … and this many times as far as the median camera.
const STANDS_OUT: f64 = 3.0;

/// Which poses of a rig are to be refined.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PoseDecision {
    /// Too little of the head was found again: poses stay as they are.
    Unchecked,
    /// They fit: poses stay as they are.
    Fit,
    /// Only those that stand out are refined.
    Some,
    /// All are refined.
    All,
    /// They fit in no pose: they belong to other photographs, or what these show has changed.
    Apart,
}

/// Whether the pose of a camera is refined.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraState {
    /// It keeps its pose.
    Stays,
    /// Its pose is refined.
    Refined,
    /// Its photograph does not show what it should: it has too few sightings, though it sees as
    /// much of the head as others, or they fit no pose.
    Lost,
    /// It is too far off to be refined.
    Far,
}

/// Result of the adjustment for one camera.
#[derive(Clone, Debug)]
pub struct CameraFit {
    /// Whether its pose is refined.
    pub state: CameraState,
    /// How many points were found in its photograph.
    pub sightings: usize,
    /// How many points of the last round, all found in other photographs before, were looked up in
    /// it.
    pub expected: usize,
    /// Median distance of these from the projections of free points with the poses given, pixels.
    pub given_px: f64,
    /// The same after the adjustment of all cameras.
    pub adjusted_px: f64,
    /// How far the head moves in its picture from the pose given to the adjusted one, pixels (root
    /// mean square).
    pub moved_px: f64,
    /// The camera with the pose to use.
    pub camera: Camera,
}

/// Decides which poses to refine, given the cameras and tracks of an adjustment of all. `expected`
/// is how many points each camera was expected to see, and `all` asks for all cameras to be
/// refined.
pub(super) fn decide(
    given: &[Camera],
    adjusted: Vec<Camera>,
    tracks: Vec<Track>,
    expected: &[usize],
    all: bool,
) -> Rig {
    let mut at_given = tracks.clone();
    let fixed = vec![false; given.len()];
    let points = sampled(&tracks);
    let refined = residuals(&adjusted, &tracks);
    let adjusted_px = median(&mut refined.concat());
    adjust(given, &mut given.to_vec(), &mut at_given, &fixed, adjusted_px.max(LEAST_SCALE));
    let before = residuals(given, &at_given);
    let given_px = median(&mut before.concat());
    let counts = sightings(&tracks, given.len());
    let fit = |v: usize| CameraFit {
        state: CameraState::Stays,
        sightings: counts[v],
        expected: expected[v],
        given_px: median(&mut before[v].clone()),
        adjusted_px: median(&mut refined[v].clone()),
        moved_px: distance_px(&given[v], &adjusted[v], &points),
        camera: given[v].clone(),
    };
    let cameras = (0..given.len()).map(fit).collect();
    let mut rig = Rig { verdict: PoseDecision::Unchecked, cameras, given_px, adjusted_px, tracks };
    let measured = counts.iter().filter(|&&n| n >= LEAST_SIGHTINGS).count();
    if rig.tracks.len() < LEAST_TRACKS || 2 * measured < given.len() {
        return rig;
    }
    rig.verdict = judge(&mut rig.cameras, adjusted_px, all || adjusted_px < GAIN * given_px);
    if is_apart(&rig.cameras, adjusted_px) {
        rig.verdict = PoseDecision::Apart;
        let refined = rig.cameras.iter_mut().filter(|c| c.state == CameraState::Refined);
        refined.for_each(|c| c.state = CameraState::Stays);
        return rig;
    }
    let poses = match rig.verdict {
        PoseDecision::Some => refine_selected(given, adjusted, &mut rig.tracks, &rig.cameras, adjusted_px),
        _ => adjusted,
    };
    for (camera, pose) in rig.cameras.iter_mut().zip(poses) {
        if camera.state == CameraState::Refined {
            camera.moved_px = distance_px(&camera.camera, &pose, &points);
            camera.camera = pose;
        }
    }
    rig
}

/// Sets the state of each camera and returns the decision for all. `residual` is that of all after
/// the adjustment, and `gains` says whether it falls enough.
fn judge(cameras: &mut [CameraFit], residual: f64, gains: bool) -> PoseDecision {
    let moves = cameras.iter().filter(|c| c.sightings >= LEAST_SIGHTINGS).map(|c| c.moved_px);
    let usual_move = median(&mut moves.collect::<Vec<f64>>());
    for c in cameras.iter_mut() {
        let stands_out = c.moved_px > LEAST_MOVE_PX.max(STANDS_OUT * usual_move);
        c.state = match () {
            // where few points are found in other photographs either, such as in hair, few
            // sightings mean nothing
            () if c.sightings < LEAST_SIGHTINGS && c.expected < LEAST_EXPECTED => CameraState::Stays,
            () if c.sightings < LEAST_SIGHTINGS => CameraState::Lost,
            () if c.adjusted_px > LOST_PX.max(LOST_SHARE * residual) => CameraState::Lost,
            () if c.moved_px > FARTHEST_PX => CameraState::Far,
            () if gains || stands_out => CameraState::Refined,
            () => CameraState::Stays,
        };
    }
    match cameras.iter().any(|c| c.state == CameraState::Refined) {
        _ if gains => PoseDecision::All,
        true => PoseDecision::Some,
        false => PoseDecision::Fit,
    }
}

/// Returns whether cameras fit in no pose, given the residual of all after the adjustment.
fn is_apart(cameras: &[CameraFit], residual: f64) -> bool {
    let total = |count: fn(&CameraFit) -> usize| cameras.iter().map(count).sum::<usize>() as f64;
    let share = total(|c| c.sightings) / total(|c| c.expected).max(1.0);
    APART.iter().any(|&(most_px, least_share)| residual > most_px && share < least_share)
}

/// Returns the poses of the cameras to refine where all others keep theirs, and moves the points of
/// the tracks accordingly.
fn refine_selected(
    given: &[Camera],
    adjusted: Vec<Camera>,
    tracks: &mut [Track],
    fits: &[CameraFit],
    scale: f64,
) -> Vec<Camera> {
    let free: Vec<bool> = fits.iter().map(|c| c.state == CameraState::Refined).collect();
    let pick = |(v, pose): (usize, Camera)| if free[v] { pose } else { given[v].clone() };
    let mut cameras: Vec<Camera> = adjusted.into_iter().enumerate().map(pick).collect();
    for _ in 0..2 {
        adjust(given, &mut cameras, tracks, &free, scale.max(LEAST_SCALE));
    }
    cameras
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_of_other_photographs_are_apart_and_those_of_blurred_ones_are_not() {
        let camera = Camera::above(4, 4, 4.0, 3.0);
        let fit = |sightings: usize| CameraFit {
            state: CameraState::Stays,
            sightings,
            expected: 100,
            given_px: 0.0,
            adjusted_px: 0.0,
            moved_px: 0.0,
            camera: camera.clone(),
        };
        // measured: residual in pixels and sightings of 100 points
        for (residual, found, apart) in [
            (0.3, 90, false), // poses that are off by 4 px, refined
            (0.5, 91, false), // noise, blur and wrong masks besides
            (1.2, 90, false), // blurred photographs
            (0.2, 40, false), // hair
            (1.8, 57, true),  // name order instead of order by number
            (0.6, 58, true),  // the same of small photographs
            (1.65, 77, true), // every photograph its neighbor's
        ] {
            assert_eq!(is_apart(&[fit(found), fit(found)], residual), apart, "{residual} {found}");
        }
    }
}

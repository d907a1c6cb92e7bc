//! Which masks that a network proposes agree with those of other views.
//!
//! A network leaves out parts of the head, a garment or a crown, in some views and shows them in
//! others; it seldom takes background for the head. Therefore [`verdicts`] weighs the two errors
//! differently. The best cell of a pixel's ray is the one that the fewest other views rule out,
//! among the cells that most views see and that a quarter of these have on the head. The views that
//! rule it out share the blame in equal parts; a pixel without such a cell, or whose best cell is
//! ruled out, is an open claim. The view with the largest
//!
//! ```text
//! claims of others that it rules out + ⅓ · its own open claims        in whole masks
//! ```
//!
//! is set aside, and the comparison is repeated without it until no view exceeds the limits. (⅓ is
//! the weight of an open claim relative to one that is ruled out.)

use super::{
    ConsistencyView, Opposition, SilhouetteConstraints, Votes, cells_on_ray, claims_of, oppositions,
};
use tiface_base::Result;
use tiface_base::image::INSIDE;

/// Rows and cells of [`verdicts`], which compares masks that a network proposes.
const PROPOSAL_ROWS: u32 = 96;
const PROPOSAL_CELLS: usize = 96;
/// Share of the views that must see a cell for it to explain a claim: what lies below all frames
/// explains everything.
const MIN_VISIBLE_SHARE: f64 = 0.75;
/// Share of the views that see a cell which must have it on the head.
const MIN_SUPPORT_SHARE: f64 = 0.25;
/// Weight of an open claim relative to one that is ruled out.
const OPEN_CLAIM_WEIGHT: f64 = 1.0 / 3.0;
/// Mean share of the others' masks that a view may rule out.
const MAX_RULED_OUT: f64 = 0.003;
/// Maximum share of its own claims that may be open.
const MAX_OPEN: f64 = 0.05;

/// The verdict on a proposed mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MaskVerdict {
    /// It agrees with the others.
    Agrees,
    /// It leaves out parts that others show; the rest of it is reliable.
    LeavesOut,
    /// It shows parts that no other view shows, or no head at all.
    Unlike,
}

/// The evidence against one mask.
#[derive(Default)]
struct Disagreement {
    /// Open share of its own claims.
    open: f64,
    /// Shares of the others' claims that it rules out, each divided among all views that do.
    taken: f64,
    /// Shares of the others' claims that it rules out, undivided.
    ruled_out: f64,
}

/// Judges masks against each other; a view without one, or with an empty one, is
/// [`MaskVerdict::Unlike`] the others.
///
/// # Errors
/// When the cameras stand at one place or look in one direction.
pub fn verdicts(views: &[ConsistencyView]) -> Result<Vec<MaskVerdict>> {
    let mut out = vec![MaskVerdict::Unlike; views.len()];
    let shows = |v: &ConsistencyView| v.mask.is_some_and(|m| m.values.iter().any(|&v| v >= INSIDE));
    let used: Vec<usize> = (0..views.len()).filter(|&i| shows(&views[i])).collect();
    used.iter().for_each(|&i| out[i] = MaskVerdict::Agrees);
    if used.len() < 2 {
        return Ok(out);
    }
    let (cube, claims) = claims_of(views, &used, PROPOSAL_CELLS, PROPOSAL_ROWS)?;
    let votes = Votes::count(cube, &claims);
    let mut active = vec![true; claims.len()];
    loop {
        let left = active.iter().filter(|a| **a).count();
        let blame = blame(&votes, &claims, &active);
        let weight = |b: &Disagreement| OPEN_CLAIM_WEIGHT * b.open + b.taken;
        let mean = |b: &Disagreement| b.ruled_out / (left.max(2) - 1) as f64;
        // of equals the first
        let worst = (0..claims.len())
            .filter(|&i| active[i] && (blame[i].open > MAX_OPEN || mean(&blame[i]) > MAX_RULED_OUT))
            .rev()
            .max_by(|&a, &b| weight(&blame[a]).total_cmp(&weight(&blame[b])));
        let Some(worst) = worst else { break };
        if left <= 2 {
            // of two masks that contradict each other, neither is known to be right
            active.iter().zip(&used).filter(|(a, _)| **a).for_each(|(_, &i)| out[i] = MaskVerdict::Unlike);
            break;
        }
        active[worst] = false;
        let much = OPEN_CLAIM_WEIGHT * blame[worst].open > blame[worst].taken;
        out[used[worst]] = if much { MaskVerdict::Unlike } else { MaskVerdict::LeavesOut };
    }
    Ok(out)
}

fn blame(votes: &Votes, claims: &[SilhouetteConstraints], active: &[bool]) -> Vec<Disagreement> {
    let costs = votes.costs(active);
    let least_seen = MIN_VISIBLE_SHARE * active.iter().filter(|a| **a).count() as f64;
    // first whether it lacks support, then how many views are against it, then how many are for it
    let key = |&cell: &usize| {
        let (no, yes) = costs[cell];
        let unsupported = yes < 2 || f64::from(yes) < MIN_SUPPORT_SHARE * f64::from(no + yes);
        (unsupported, no, u16::MAX - yes)
    };
    let found = oppositions(votes, claims, active, |claims, pixel| {
        let cells = cells_on_ray(&votes.cube, claims, pixel);
        let seen = cells.filter(|&cell| f64::from(costs[cell].0 + costs[cell].1) >= least_seen);
        seen.min_by_key(key).map(|cell| (key(&cell).0, costs[cell].0, cell))
    });
    let mut out: Vec<Disagreement> = claims.iter().map(|_| Disagreement::default()).collect();
    for (j, opposition) in found.iter().enumerate() {
        let Some(Opposition { open, opposing, .. }) = opposition else { continue };
        out[j].open = *open;
        for (blame, [taken, ruled_out]) in out.iter_mut().zip(opposing) {
            blame.taken += taken;
            blame.ruled_out += ruled_out;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mask::consistency::tests::camera;
    use glam::{DVec3, Vec2};
    use tiface_base::geom::Camera;
    use tiface_base::image::Gray;

    /// Twelve cameras on a ring, looking a little down.
    fn ring() -> Vec<Camera> {
        (0..12).map(|i| camera(i as f64 * std::f64::consts::TAU / 12.0, -0.2)).collect()
    }

    /// Returns a ball with a smaller one on top, or the ball alone.
    fn mask(camera: &Camera, whole: bool) -> Gray {
        let balls = [(DVec3::new(0.0, -0.4, 0.0), 0.9), (DVec3::new(0.0, 0.9, 0.0), 0.6)];
        let hit = |i: u32| {
            let ray = camera.ray(Vec2::new((i % 96) as f32 + 0.5, (i / 96) as f32 + 0.5)).unwrap();
            balls[..1 + whole as usize]
                .iter()
                .any(|(c, r)| (*c - camera.position).cross(ray.direction.as_dvec3()).length() < *r)
        };
        Gray { width: 96, height: 128, values: (0..96 * 128).map(|i| 255 * hit(i) as u8).collect() }
    }

    fn judged(masks: &[Gray]) -> Vec<MaskVerdict> {
        let cameras = ring();
        let views: Vec<ConsistencyView> = cameras
            .iter()
            .zip(masks)
            .map(|(camera, m)| ConsistencyView { name: "v", camera, mask: Some(m) })
            .collect();
        verdicts(&views).unwrap()
    }

    fn masks(without: &[usize]) -> Vec<Gray> {
        ring().iter().enumerate().map(|(i, c)| mask(c, !without.contains(&i))).collect()
    }

    #[test]
    fn two_masks_that_contradict_each_other_both_fail() {
        // all that one view shows lies above everything that the other shows
        let cameras = ring();
        let at = |y: f64, i: usize| {
            let c = DVec3::new(0.0, y, 0.0);
            let hit = |p: u32| {
                let ray = cameras[i].ray(Vec2::new((p % 96) as f32 + 0.5, (p / 96) as f32 + 0.5)).unwrap();
                (c - cameras[i].position).cross(ray.direction.as_dvec3()).length() < 0.5
            };
            Gray { width: 96, height: 128, values: (0..96 * 128).map(|p| 255 * hit(p) as u8).collect() }
        };
        let (high, low) = (at(1.0, 0), at(-1.0, 3));
        let view = |i: usize, mask| ConsistencyView { name: "v", camera: &cameras[i], mask: Some(mask) };
        let found = verdicts(&[view(0, &high), view(3, &low)]).unwrap();
        assert!(!found.contains(&MaskVerdict::Agrees), "{found:?}");
        let same = at(1.0, 3);
        assert_eq!(verdicts(&[view(0, &high), view(3, &same)]).unwrap(), [MaskVerdict::Agrees; 2]);
    }

    #[test]
    fn what_many_views_leave_out_is_missed_in_each_of_them() {
        assert_eq!(judged(&masks(&[])), [MaskVerdict::Agrees; 12]);
        // even if it is seven of twelve
        let without = [0, 1, 3, 5, 6, 8, 10];
        let found = judged(&masks(&without));
        for (i, verdict) in found.into_iter().enumerate() {
            let expected = if without.contains(&i) { MaskVerdict::LeavesOut } else { MaskVerdict::Agrees };
            assert_eq!(verdict, expected, "view {i}");
        }
    }

    #[test]
    fn what_a_single_view_shows_alone_fails() {
        let mut all = masks(&[]);
        all[2].values.fill(255);
        all[7].values.fill(0);
        // beside the head, a quarter of the picture
        (0..96 * 128).filter(|i| i % 96 < 24 && i / 96 > 32).for_each(|i| all[9].values[i] = 255);
        let found = judged(&all);
        for (i, verdict) in found.into_iter().enumerate() {
            let expected = if [2, 7, 9].contains(&i) { MaskVerdict::Unlike } else { MaskVerdict::Agrees };
            assert_eq!(verdict, expected, "view {i}");
        }
    }

    #[test]
    fn one_mask_alone_agrees() {
        let mut all = masks(&[]);
        all[1..].iter_mut().for_each(|m| m.values.fill(0));
        let found = judged(&all);
        assert!(found[0] == MaskVerdict::Agrees && found[1..].iter().all(|b| *b == MaskVerdict::Unlike));
    }
}

//! Which masks may be believed, of masks that a network made by itself.
//!
//! Such a network leaves out what it has no word for, a garment or a crown, in some views and shows it in others; what it
//! takes for head without any is rarer. Where a mask claims a pixel, the best cell of its ray is the one that fewest of
//! the others rule out, of those that most views see and a quarter has on the head. Whoever rules it out takes it away,
//! in equal parts; where there is no such cell, or somebody rules it out, the claim stands open. The view that has
//!
//! ```text
//! taken from others + ⅓ · its own claims that are open        in whole masks
//! ```
//!
//! most of is set aside, and the rest is asked again, until nobody takes much away and nobody claims much alone. (A
//! third: how much less an open claim weighs than what is left out.)

use super::consistency::{ConsistencyView, SilhouetteConstraints, Votes, cells_on_ray, claims_of};
use crate::Result;
use rayon::prelude::*;

/// Rows that masks are reduced to.
const ROWS: u32 = 96;
/// Cells along each side of the cube.
const CELLS: usize = 96;
/// Share of the views that must see a cell for it to explain a claim: what lies below all frames explains everything.
const SEEN: f64 = 0.75;
/// Share of the views that see a cell which must have it on the head.
const SUPPORT: f64 = 0.25;
/// What an open claim weighs, in parts of one that is taken away.
const OWN: f64 = 1.0 / 3.0;
/// Mean share of the others' masks that a view may rule out.
const MOST_RULED_OUT: f64 = 0.003;
/// Share of its own claims that may stand open.
const MOST_OPEN: f64 = 0.05;

/// What is to be made of a mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MaskVerdict {
    /// It agrees with the others.
    Agrees,
    /// It leaves out what others show; what it shows may be believed.
    LeavesOut,
    /// It shows what no other does, or nothing at all.
    Unlike,
}

/// Who stands against whom among the views still believed.
#[derive(Default)]
struct Disagreement {
    /// Open share of its own claims.
    open: f64,
    /// Shares of the others' claims that it rules out, each divided among all who do.
    taken: f64,
    /// The same undivided.
    ruled_out: f64,
}

/// Judges masks against each other; a view without one, or with an empty one, is [`MaskVerdict::Unlike`] the others.
///
/// # Errors
/// When the cameras stand at one place or look in one direction.
pub fn beliefs(views: &[ConsistencyView]) -> Result<Vec<MaskVerdict>> {
    let mut out = vec![MaskVerdict::Unlike; views.len()];
    let shows = |v: &ConsistencyView| v.mask.is_some_and(|m| m.values.iter().any(|&v| v > 127));
    let used: Vec<usize> = (0..views.len()).filter(|&i| shows(&views[i])).collect();
    used.iter().for_each(|&i| out[i] = MaskVerdict::Agrees);
    if used.len() < 2 {
        return Ok(out);
    }
    let (cube, claims) = claims_of(views, &used, CELLS, ROWS)?;
    let votes = Votes::count(cube, &claims);
    let mut active = vec![true; claims.len()];
    loop {
        let left = active.iter().filter(|a| **a).count();
        let blame = blame(&votes, &claims, &active);
        let weight = |b: &Disagreement| OWN * b.open + b.taken;
        let mean = |b: &Disagreement| b.ruled_out / (left.max(2) - 1) as f64;
        // of equals the first
        let worst = (0..claims.len())
            .filter(|&i| active[i] && (blame[i].open > MOST_OPEN || mean(&blame[i]) > MOST_RULED_OUT))
            .rev()
            .max_by(|&a, &b| weight(&blame[a]).total_cmp(&weight(&blame[b])));
        let Some(worst) = worst else { break };
        if left <= 2 {
            // two that contradict each other say nothing of who is right
            active.iter().zip(&used).filter(|(a, _)| **a).for_each(|(_, &i)| out[i] = MaskVerdict::Unlike);
            break;
        }
        active[worst] = false;
        let much = OWN * blame[worst].open > blame[worst].taken;
        out[used[worst]] = if much { MaskVerdict::Unlike } else { MaskVerdict::LeavesOut };
    }
    Ok(out)
}

fn blame(votes: &Votes, claims: &[SilhouetteConstraints], active: &[bool]) -> Vec<Disagreement> {
    let costs = votes.costs(active);
    let least_seen = SEEN * active.iter().filter(|a| **a).count() as f64;
    let found: Vec<(f64, Vec<[f64; 2]>)> = (0..claims.len())
        .into_par_iter()
        .map(|j| {
            let mut takers = vec![[0.0; 2]; claims.len()];
            let (mut open, mut asked) = (0usize, 0usize);
            for &pixel in claims[j].inner.iter().filter(|_| active[j]) {
                let seen = cells_on_ray(&votes.cube, &claims[j], pixel).filter(|&cell| {
                    let (no, yes) = costs[cell];
                    f64::from(no + yes) >= least_seen
                });
                // first whether it lacks support, then who is against it, then who is for it
                let key = |&cell: &usize| {
                    let (no, yes) = costs[cell];
                    let alone = yes < 2 || f64::from(yes) < SUPPORT * f64::from(no + yes);
                    (alone, no, u16::MAX - yes)
                };
                let Some(cell) = seen.min_by_key(key) else { continue };
                asked += 1;
                let (alone, no, _) = key(&cell);
                open += (alone || no > 0) as usize;
                if alone || no == 0 {
                    continue;
                }
                for i in (0..claims.len()).filter(|&i| active[i] && votes.rules_out(i, cell)) {
                    takers[i][0] += 1.0 / f64::from(no);
                    takers[i][1] += 1.0;
                }
            }
            let asked = asked.max(1) as f64;
            takers.iter_mut().flatten().for_each(|t| *t /= asked);
            (open as f64 / asked, takers)
        })
        .collect();
    let mut out: Vec<Disagreement> =
        found.iter().map(|(open, _)| Disagreement { open: *open, ..Disagreement::default() }).collect();
    for (_, takers) in &found {
        for (blame, [taken, ruled_out]) in out.iter_mut().zip(takers) {
            blame.taken += taken;
            blame.ruled_out += ruled_out;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geom::{Camera, Distortion};
    use crate::image::Gray;
    use glam::{DMat3, DVec3, Vec2};

    /// Twelve cameras on a ring, looking a little down.
    fn ring() -> Vec<Camera> {
        (0..12)
            .map(|i| {
                let turn = i as f64 * std::f64::consts::TAU / 12.0;
                let rotation = DMat3::from_rotation_y(turn) * DMat3::from_rotation_x(-0.2);
                Camera {
                    width: 96,
                    height: 128,
                    fx: 300.0,
                    fy: 300.0,
                    cx: 48.0,
                    cy: 64.0,
                    distortion: Distortion::default(),
                    rotation,
                    position: rotation * DVec3::new(0.0, 0.0, 10.0),
                }
            })
            .collect()
    }

    /// A ball with a smaller one on top, or the ball alone.
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
        beliefs(&views).unwrap()
    }

    fn masks(without: &[usize]) -> Vec<Gray> {
        ring().iter().enumerate().map(|(i, c)| mask(c, !without.contains(&i))).collect()
    }

    #[test]
    fn two_masks_that_contradict_each_other_are_both_not_believed() {
        // what one shows lies above everything that the other does
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
        let found = beliefs(&[view(0, &high), view(3, &low)]).unwrap();
        assert!(!found.contains(&MaskVerdict::Agrees), "{found:?}");
        let same = at(1.0, 3);
        assert_eq!(beliefs(&[view(0, &high), view(3, &same)]).unwrap(), [MaskVerdict::Agrees; 2]);
    }

    #[test]
    fn what_many_views_leave_out_is_missed_in_each_of_them() {
        assert_eq!(judged(&masks(&[])), [MaskVerdict::Agrees; 12]);
        // even if it is seven of twelve
        let without = [0, 1, 3, 5, 6, 8, 10];
        let found = judged(&masks(&without));
        for (i, belief) in found.into_iter().enumerate() {
            let expected = if without.contains(&i) { MaskVerdict::LeavesOut } else { MaskVerdict::Agrees };
            assert_eq!(belief, expected, "view {i}");
        }
    }

    #[test]
    fn what_a_single_view_shows_alone_is_not_believed() {
        let mut all = masks(&[]);
        all[2].values.fill(255);
        all[7].values.fill(0);
        // beside the head, a quarter of the picture
        (0..96 * 128).filter(|i| i % 96 < 24 && i / 96 > 32).for_each(|i| all[9].values[i] = 255);
        let found = judged(&all);
        for (i, belief) in found.into_iter().enumerate() {
            let expected = if [2, 7, 9].contains(&i) { MaskVerdict::Unlike } else { MaskVerdict::Agrees };
            assert_eq!(belief, expected, "view {i}");
        }
    }

    #[test]
    fn one_mask_has_nobody_to_disagree_with() {
        let mut all = masks(&[]);
        all[1..].iter_mut().for_each(|m| m.values.fill(0));
        let found = judged(&all);
        assert!(found[0] == MaskVerdict::Agrees && found[1..].iter().all(|b| *b == MaskVerdict::Unlike));
    }
}

//! Fewer triangles for the same surface.
mod collapse;
mod hold;
mod quadric;
mod queue;
mod rings;

use super::MeshError;
use crate::geom::Mesh;
use crate::run::Monitor;
use collapse::{Star, place};
use glam::Vec3;
use queue::{Entry, Queue};
use rings::Rings;

/// config
#[derive(Clone, Debug, PartialEq)]
pub struct SimplifyConfig {
    /// Triangles
    pub triangles: usize,
    /// Error
    pub error: Option<f32>,
}

/// report
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SimplifyReport {
    /// c
    pub collapses: usize,
    /// pops
    pub refused: usize,
}

/// go
pub fn simplify(
    mesh: &mut Mesh,
    _field: Option<&(dyn Fn(&[Vec3]) -> (Vec<f32>, Vec<Vec3>) + Sync)>,
    config: &SimplifyConfig,
    _monitor: &dyn Monitor,
) -> Result<SimplifyReport, MeshError> {
    let mut rings = Rings::new(mesh);
    let mut report = SimplifyReport::default();
    let mut star = Star::new(rings.positions.len());
    reduce(&mut rings, &mut star, config.triangles, &mut report);
    *mesh = rings.into_mesh();
    Ok(report)
}

fn reduce(rings: &mut Rings, star: &mut Star, target: usize, report: &mut SimplifyReport) {
    let mut queue = Queue::new();
    for t in rings.alive() {
        let triangle = rings.triangles[t as usize];
        for k in 0..3 {
            let (a, b) = (triangle[k], triangle[(k + 1) % 3]);
            if a < b || rings.flags[a as usize] & rings.flags[b as usize] & rings::BORDER != 0 {
                push(&mut queue, rings, a, b);
            }
        }
    }
    while rings.count > target {
        let Some((bucket, Entry { a, b, stamp })) = queue.pop() else { break };
        if rings.valence(a) == 0
            || rings.valence(b) == 0
            || rings.stamps[a as usize] + rings.stamps[b as usize] != stamp
        {
            continue;
        }
        let Some((x, cost)) = place(rings, a, b) else { continue };
        let now = Queue::bucket(cost);
        if now > bucket {
            queue.push(now, Entry { a, b, stamp });
            continue;
        }
        if !star.gather(rings, a, b) || !star.fits(rings, x) {
            report.refused += 1;
            continue;
        }
        star.apply(rings, a, b, x);
        report.collapses += 1;
        for i in 0..star.around.len() {
            push(&mut queue, rings, a, star.around[i]);
        }
    }
}

fn push(queue: &mut Queue, rings: &Rings, a: u32, b: u32) {
    if let Some((_, cost)) = place(rings, a, b) {
        let stamp = rings.stamps[a as usize] + rings.stamps[b as usize];
        queue.push(Queue::bucket(cost), Entry { a, b, stamp });
    }
}

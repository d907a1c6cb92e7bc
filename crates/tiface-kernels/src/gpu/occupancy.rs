//! Updates of the occupancy grid on the device, by a band around the zero level set or by nerfacc's
//! rule.

use super::device::{Buffer, Device, Words, groups, launch};
use super::sdf::Sdf;
use super::vec3::Vec3;
use crate::cpu::occupancy::BandRule;
use burn::cubecl::{self, prelude::*};
use tiface_base::Result;
use tiface_base::geom::BitGrid;

mod nerfacc;

pub use nerfacc::Nerfacc;

const UNITS: u32 = 256;

#[cube]
fn center(index: u32, cell: f32, radius: f32) -> f32 {
    (f32::cast_from(index) + 0.5f32) * cell - radius
}

/// Writes the centers of `batch` cells, starting at cell number `first` of the list.
#[cube(launch)]
fn centers(
    cells: &[u32],
    x: &mut [f32],
    count: &mut [u32],
    first: u32,
    batch: u32,
    resolution: u32,
    radius: f32,
) {
    let s = ABSOLUTE_POS;
    let plane = x.len() / 3;
    if s < batch as usize {
        let i = cells[first as usize + s];
        let cell = 2.0f32 * radius / f32::cast_from(resolution);
        let at_x = center(i / (resolution * resolution), cell, radius);
        let at_y = center(i / resolution % resolution, cell, radius);
        Vec3::new(at_x, at_y, center(i % resolution, cell, radius)).write(x, plane, s);
    }
    if s == 0 {
        count[0] = batch;
    }
}

/// Returns the reach of the band around a cell's center, where the local sharpness is `share` times
/// the maximum.
#[cube]
fn reach_at(band: f32, inv_s: f32, share: f32, half: f32) -> f32 {
    band / (clamp(inv_s, 1e-6f32, 1e6f32) * share) + half
}

/// Stores the signed distance and the reach of the evaluated cells. The reach is 0 where even the
/// softest surface would be too far away.
#[cube(launch)]
fn store(
    cells: &[u32],
    field: &[f32],
    inv_s: &[f32],
    value: &mut [f32],
    reach: &mut [f32],
    first: u32,
    batch: u32,
    band: f32,
    soften: f32,
    half: f32,
) {
    let s = ABSOLUTE_POS;
    if s < batch as usize {
        let plane = field.len() / 8;
        let i = cells[first as usize + s] as usize;
        let f = field[s];
        let widest = reach_at(band, inv_s[0], 1.0f32 / soften, half);
        let mut cell_reach = 0.0f32;
        if soften > 1.0f32 && f.abs() < widest {
            cell_reach = reach_at(band, inv_s[0], field[7 * plane + s].exp(), half);
        }
        value[i] = f;
        reach[i] = cell_reach;
    }
}

/// Writes the occupied and solid cells; each thread handles 32 cells, one word of the masks.
#[cube(launch)]
fn decide(
    allowed: &[u32],
    value: &[f32],
    reach: &[f32],
    inv_s: &[f32],
    mask: &mut [u32],
    solid: &mut [u32],
    resolution: u32,
    band: f32,
    half: f32,
) {
    let word = ABSOLUTE_POS;
    if word < mask.len() {
        let narrowest = reach_at(band, inv_s[0], 1.0f32, half);
        let cells = resolution * resolution * resolution;
        let mut kept = 0u32;
        let mut inside = 0u32;
        for bit in 0..32u32 {
            let i = u32::cast_from(word) * 32 + bit;
            if i < cells && (allowed[word] >> bit) & 1 == 1 {
                let f = value[i as usize];
                let mut widest = max(narrowest, reach[i as usize]);
                let mut crossed = false;
                let mut stride = 1u32;
                for _ in 0..3u32 {
                    let at = i / stride % resolution;
                    if at > 0 {
                        let other = (i - stride) as usize;
                        widest = max(widest, reach[other]);
                        crossed = crossed || value[other] * f < 0.0f32;
                    }
                    if at + 1 < resolution {
                        let other = (i + stride) as usize;
                        widest = max(widest, reach[other]);
                        crossed = crossed || value[other] * f < 0.0f32;
                    }
                    stride *= resolution;
                }
                if f.abs() < widest || crossed {
                    kept |= 1u32 << bit;
                } else if f < 0.0f32 {
                    inside |= 1u32 << bit;
                }
            }
        }
        mask[word] = kept;
        solid[word] = inside;
    }
}

/// Masks on a device of the cells of a cubic grid over `[-radius, radius]³` that may contain
/// surface, and of those that are solid.
pub struct Occupancy {
    pub(super) mask: Buffer,
    pub(super) solid: Option<Buffer>,
    pub(super) resolution: usize,
    pub(super) radius: f32,
}

/// Converts 64-bit words to the 32-bit words of a device.
pub(super) fn u32_words(bits: &[u64]) -> Vec<u32> {
    bits.iter().flat_map(|&w| [w as u32, (w >> 32) as u32]).collect()
}

impl Occupancy {
    /// Uploads masks.
    pub fn new(device: &Device, mask: &BitGrid, solid: Option<&BitGrid>, radius: f32) -> Occupancy {
        assert!(solid.is_none_or(|s| s.resolution == mask.resolution));
        let upload = |mask: &BitGrid| device.upload(&u32_words(&mask.bits));
        Occupancy { mask: upload(mask), solid: solid.map(upload), resolution: mask.resolution, radius }
    }

    /// Waits for the device and returns both masks: the occupied cells and the solid ones; the
    /// latter mask is empty if the device holds none.
    pub fn read(&self, device: &Device) -> Result<[BitGrid; 2]> {
        let mut masks = [BitGrid::filled(self.resolution, false), BitGrid::filled(self.resolution, false)];
        for (mask, buffer) in masks.iter_mut().zip([Some(&self.mask), self.solid.as_ref()]) {
            let Some(buffer) = buffer else { continue };
            let words = device.fetch::<u32>(buffer)?;
            mask.bits = words.as_chunks().0.iter().map(|[a, b]| *a as u64 | (*b as u64) << 32).collect();
        }
        Ok(masks)
    }
}

/// Update rule of a band around the zero level set: see [`crate::cpu::occupancy::update_band`].
pub struct BandUpdate {
    cells: Buffer,
    allowed: Buffer,
    value: Buffer,
    reach: Buffer,
    count: Buffer,
    rule: BandRule,
}

impl BandUpdate {
    /// Creates the rule; cells outside `allowed` are never occupied.
    pub fn new(device: &Device, allowed: &BitGrid, rule: BandRule) -> BandUpdate {
        let total = allowed.resolution.pow(3);
        let cells: Vec<u32> = (0..total).filter(|&i| allowed.get(i)).map(|i| i as u32).collect();
        BandUpdate {
            cells: device.upload(&cells),
            allowed: device.upload(&u32_words(&allowed.bits)),
            // cells that are not evaluated stay 0, which has no sign
            value: device.zeros::<f32>(total),
            reach: device.zeros::<f32>(total),
            count: device.zeros::<u32>(2),
            rule,
        }
    }

    /// Evaluates the field at all allowed cells and updates the masks. `x` and `direction` are
    /// planes `[3, capacity]`, of which `x` is overwritten; `inv_s` is `[1]`.
    pub fn update(
        &self,
        device: &Device,
        occupancy: &Occupancy,
        field: &Sdf,
        [table, flat, inv_s]: [&Buffer; 3],
        [x, direction]: [&Buffer; 2],
    ) {
        let (resolution, radius) = (occupancy.resolution as u32, occupancy.radius);
        let half = 0.5 * 3f32.sqrt() * 2.0 * radius / resolution as f32;
        let capacity = x.word_count() / 3;
        let solid = occupancy.solid.as_ref().expect("the rule of a band needs a solid mask");
        for first in (0..self.cells.word_count()).step_by(capacity) {
            let batch = capacity.min(self.cells.word_count() - first);
            let group_count = groups(batch.div_ceil(UNITS as usize));
            launch!(device, centers::launch, group_count.clone(), UNITS;
                self.cells, x, self.count; first as u32, batch as u32, resolution, radius
            );
            let out = field.forward(device, table, flat, x, direction, &self.count);
            launch!(device, store::launch, group_count, UNITS;
                self.cells, out, inv_s, self.value, self.reach;
                first as u32, batch as u32, self.rule.width, self.rule.soften, half
            );
        }
        launch!(device, decide::launch, groups(occupancy.mask.word_count().div_ceil(UNITS as usize)), UNITS;
            self.allowed, self.value, self.reach, inv_s, occupancy.mask, solid;
            resolution, self.rule.width, half
        );
    }
}

//! The training loss of TensoRF's field and its gradients: see [`crate::cpu::vm::losses`].

use super::super::batch::DeviceBatch;
use super::super::device::{Buffer, Device, Words, groups, launch};
use super::super::losses::{BACKGROUND, TALLY, cross_entropy, tally};
use super::super::sum::group_sum;
use super::Vm;
use crate::cpu::vm::RAY_WIDTH;
use crate::cpu::vm::losses::{BackgroundMode, MaskTerm, TERMS, VmFigures};
use burn::cubecl::{self, prelude::*};
use tiface_base::Result;

const UNITS: u32 = 256;

/// Number of words of the results of steps: loss terms, lattice points, evaluated samples, decoded
/// samples, rays, whether a gradient was not finite.
const TOTALS: usize = TERMS + 5;

/// Writes the loss terms of rays, planes `[3, rays]`, and the gradients with respect to the
/// composited values, planes `[5, rays]`.
#[cube(launch)]
fn of_rays(
    composed: &[f32],
    color: &[f32],
    alpha: &[f32],
    background: &[f32],
    alive: &[u32],
    tally: &[u32],
    g_out: &mut [f32],
    terms: &mut [f32],
    lift: f32,
    target_background: f32,
    weight: f32,
    #[comptime] l2: bool,
    #[comptime] ce: bool,
) {
    let rays = alpha.len();
    let r = ABSOLUTE_POS;
    if r < rays {
        let is_alive = f32::cast_from(alive[r]);
        let ray_share = is_alive / max(f32::cast_from(tally[0]), 1.0f32);
        let (opacity, a) = (composed[3 * rays + r], alpha[r]);
        let mut square = 0.0f32;
        let mut g_opacity = 0.0f32;
        #[unroll]
        for c in 0..3usize {
            let b = background[c * rays + r];
            let raw = composed[c * rays + r] + (1.0f32 - opacity) * (b + lift);
            let clamped = clamp(raw, 0.0f32, 1.0f32);
            let e = clamped - (color[c * rays + r] + target_background * (1.0f32 - a) * b);
            square += e * e;
            let g = select(raw == clamped, 2.0f32 * e * ray_share / 3.0f32, 0.0f32);
            g_out[c * rays + r] = g;
            g_opacity -= g * (b + lift);
        }
        let background_share =
            select(a == 0.0f32, is_alive, 0.0f32) / max(f32::cast_from(tally[BACKGROUND]), 1.0f32);
        let empty = opacity * opacity * background_share;
        let mut mask = 0.0f32;
        if l2 {
            mask = empty;
            g_opacity += 2.0f32 * weight * opacity * background_share;
        }
        if ce {
            let entropy = cross_entropy(opacity, select(a == 0.0f32, 0.0f32, 1.0f32), ray_share, weight);
            mask = entropy.value;
            g_opacity += entropy.slope;
        }
        g_out[3 * rays + r] = g_opacity;
        g_out[4 * rays + r] = 0.0f32;
        terms[r] = square * ray_share / 3.0f32;
        terms[rays + r] = mask;
        terms[2 * rays + r] = empty;
    }
}

/// Adds the results of a step to the totals, with one group of threads for each loss term, and one
/// for all counts.
#[cube(launch)]
fn add(
    terms: &[f32],
    points: &[u32],
    looked_up: &[u32],
    decoded: &[u32],
    tally: &[u32],
    non_finite: &[u32],
    totals: &mut [u32],
) {
    let unit = UNIT_POS as usize;
    let term = CUBE_POS_X as usize;
    let rays = points.len();
    let mut sum = 0.0f32;
    let mut lattice_points = 0u32;
    for r in range_stepped(unit, rays, UNITS as usize) {
        if term < TERMS {
            sum += terms[term * rays + r];
        } else {
            lattice_points += points[r];
        }
    }
    let sum = group_sum::<f32>(sum, UNITS as usize);
    let lattice_points = group_sum::<u32>(lattice_points, UNITS as usize);
    if unit == 0 {
        if term < TERMS {
            totals[term] = u32::reinterpret(f32::reinterpret(totals[term]) + sum);
        } else {
            totals[TERMS] += lattice_points;
            totals[comptime!(TERMS + 1)] += looked_up[0];
            totals[comptime!(TERMS + 2)] += decoded[0];
            totals[comptime!(TERMS + 3)] += tally[0];
            totals[comptime!(TERMS + 4)] = non_finite[0];
        }
    }
}

/// The losses of a batch of rays, with the buffers for them.
pub struct VmLosses {
    term: MaskTerm,
    tally: Buffer,
    g_out: Buffer,
    terms: Buffer,
    totals: Buffer,
}

impl VmLosses {
    /// Allocates buffers for `rays` rays.
    pub fn new(device: &Device, rays: usize, term: MaskTerm) -> VmLosses {
        VmLosses {
            term,
            tally: device.scratch::<u32>(TALLY),
            g_out: device.scratch::<f32>(RAY_WIDTH * rays),
            terms: device.scratch::<f32>(TERMS * rays),
            totals: device.zeros::<u32>(TOTALS),
        }
    }

    /// Computes the losses of rays, and returns the gradients with respect to the output of
    /// [`Vm::render`], planes `[5, rays]`.
    pub fn of_rays(
        &self,
        device: &Device,
        composed: &Buffer,
        batch: &DeviceBatch,
        mode: BackgroundMode,
    ) -> &Buffer {
        let (weight, l2, ce) = match self.term {
            MaskTerm::None => (0.0, false, false),
            MaskTerm::L2(weight) => (weight, true, false),
            MaskTerm::Ce(weight) => (weight, false, true),
        };
        let DeviceBatch { color, alpha, background, alive, .. } = batch;
        let one = CubeCount::new_single();
        launch!(device, tally::launch, one, UNITS; alive, alpha, alive, self.tally; false);
        launch!(device, of_rays::launch, groups(alpha.word_count().div_ceil(UNITS as usize)), UNITS;
            composed, color, alpha, background, alive, self.tally, self.g_out, self.terms;
            mode.lift, f32::from(mode.target), weight, l2, ce
        );
        &self.g_out
    }

    /// Returns the gradients of the last call of [`of_rays`](VmLosses::of_rays), planes
    /// `[5, rays]`.
    pub fn gradient(&self) -> &Buffer {
        &self.g_out
    }

    /// Returns the number of rays of the last batch, in the first word.
    pub fn rays(&self) -> &Buffer {
        &self.tally
    }

    /// Adds the results of the last step to the totals that [`fetch`](VmLosses::fetch) returns.
    pub fn add(&self, device: &Device, vm: &Vm, non_finite: &Buffer) {
        let [looked_up, decoded, points] = vm.counts();
        launch!(device, add::launch, CubeCount::new_1d(TERMS as u32 + 1), UNITS;
            self.terms, points, looked_up, decoded, self.tally, non_finite, self.totals
        );
    }

    /// Resets the totals.
    pub fn reset_totals(&mut self, device: &Device) {
        self.totals = device.zeros::<u32>(TOTALS);
    }

    /// Waits for the device and returns the totals of the steps since they were reset.
    pub fn fetch(&self, device: &Device) -> Result<VmFigures> {
        let t = device.fetch::<u32>(&self.totals)?;
        let [lattice, density, color, rays] = [3, 4, 5, 6].map(|i| t[i] as u64);
        let terms = [t[0], t[1], t[2]].map(f32::from_bits);
        Ok(VmFigures { terms, lattice, density, color, rays, non_finite: t[7] != 0 })
    }
}

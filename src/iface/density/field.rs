//! A trained density: values, colors, volume renders.

use super::cpu::march;
use super::{DensityState, FORMAT, parts, shape};
use crate::config::iface::IfaceConfig;
use crate::field::checkpoint::{self, Checkpoint, TrainingProgress};
use crate::iface::occupancy::Occupancy;
use crate::iface::schedule::step_length;
use glam::Vec3;
use std::path::Path;
use tiface_base::Result;
use tiface_base::geom::{Ray, RayResult, SdfField};
use tiface_kernels::cpu::density::{self, DensityShape, DensityWeights};

/// Density of the level set that is taken as the surface.
const LEVEL: f32 = 5.0;

/// The trained field. Positions are in scene units, the box is [-1, 1]³.
pub struct DensityField {
    config: IfaceConfig,
    shape: DensityShape,
    table: Vec<f32>,
    weights: DensityWeights,
    occupancy: Occupancy,
}

impl DensityField {
    pub(super) fn new(config: &IfaceConfig, state: DensityState) -> DensityField {
        let shape = shape(config);
        let DensityState { groups: [table, network], occupancy, .. } = state;
        let [table, ..] = table.state;
        let weights = DensityWeights::new(&shape, network.values());
        DensityField { config: config.clone(), shape, table, weights, occupancy }
    }

    /// Loads the field from the checkpoint in a stage folder. `config` must be the training's.
    pub fn load(dir: &Path, config: &IfaceConfig) -> Result<DensityField> {
        let mut file = Checkpoint::read(&checkpoint::newest(dir), "iface", FORMAT)?;
        TrainingProgress::restore(&file, config.steps)?;
        let state = DensityState::restore(parts(config), config, None, &mut file)?;
        Ok(DensityField::new(config, state))
    }

    fn table(&self) -> &[[f32; 2]] {
        bytemuck::cast_slice(&self.table)
    }

    fn scaled(&self, points: &[Vec3]) -> Vec<[f32; 3]> {
        points.iter().map(|p| (*p * self.config.radius).to_array()).collect()
    }

    fn density(&self, points: &[Vec3]) -> Vec<f32> {
        let look = |points: &[Vec3]| {
            density::evaluate(&self.shape, self.table(), &self.weights, &self.scaled(points), None).density
        };
        points.chunks(1 << 16).flat_map(look).collect()
    }
}

impl SdfField for DensityField {
    /// Returns the surface's density minus the local density, which is negative inside.
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        self.density(points).into_iter().map(|s| LEVEL - s).collect()
    }

    /// Gradients are central differences over a thousandth of the box.
    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        const STEP: f32 = 2e-3;
        let along = |axis: Vec3| -> Vec<f32> {
            let moved =
                |sign: f32| self.density(&points.iter().map(|p| *p + sign * STEP * axis).collect::<Vec<_>>());
            let difference = |(a, b): (f32, f32)| (a - b) / (2.0 * STEP);
            moved(-1.0).into_iter().zip(moved(1.0)).map(difference).collect()
        };
        let [x, y, z] = [Vec3::X, Vec3::Y, Vec3::Z].map(along);
        (self.sdf(points), (0..points.len()).map(|i| Vec3::new(x[i], y[i], z[i])).collect())
    }

    fn colors(&self, points: &[Vec3], _: &[Vec3], counts: &[u32], directions: &[Vec3]) -> Vec<[f32; 3]> {
        let places = self.scaled(points).into_iter().zip(counts);
        let x: Vec<[f32; 3]> = places.flat_map(|(p, n)| std::iter::repeat_n(p, *n as usize)).collect();
        let d: Vec<[f32; 3]> = directions.iter().map(|d| d.to_array()).collect();
        let look = |(x, d): (&[[f32; 3]], &[[f32; 3]])| {
            density::evaluate(&self.shape, self.table(), &self.weights, x, Some(d)).color
        };
        x.chunks(1 << 16).zip(d.chunks(1 << 16)).flat_map(look).collect()
    }
}

impl DensityField {
    /// Renders rays in scene coordinates.
    pub fn render(&self, rays: &[Ray]) -> Vec<RayResult> {
        const PASS: usize = 1 << 10;
        rays.chunks(PASS).flat_map(|rays| self.pass(rays)).collect()
    }

    fn pass(&self, rays: &[Ray]) -> Vec<RayResult> {
        let radius = self.config.radius;
        let rays: Vec<Ray> = rays.iter().map(|r| r.scaled(radius)).collect();
        let field = (&self.shape, self.table(), &self.weights);
        let samples = march(&self.config, &self.occupancy, field, &rays, &[]);
        let (x, d) = samples.points(&rays);
        let found = density::evaluate(&self.shape, self.table(), &self.weights, &x, Some(&d));
        let dt = step_length(&self.config).at(0.0);
        let seen = |own: &[i32]| {
            let own = own[0] as usize..own[1] as usize;
            let weight = density::weights(&found.density[own.clone()], dt);
            let (mut color, mut opacity, mut depth) = ([0f32; 3], 0f32, 0f32);
            for ((w, c), t) in weight.iter().zip(&found.color[own.clone()]).zip(&samples.t[own]) {
                (0..3).for_each(|k| color[k] += w * c[k]);
                (opacity, depth) = (opacity + w, depth + w * t);
            }
            let depth = if opacity > 0.0 { depth / opacity / radius } else { 0.0 };
            RayResult { color, opacity: opacity.min(1.0), depth, normal: Vec3::ZERO }
        };
        samples.offsets.windows(2).map(seen).collect()
    }
}

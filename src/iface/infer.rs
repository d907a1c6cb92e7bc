//! Evaluation of a trained field: distances, normals, colors and volume renders.

use super::model::{parts, shape};
use super::occupancy::Occupancy;
use super::schedule::step_length;
use super::state::{FORMAT, SdfState};
use crate::Result;
use crate::config::iface::{IfaceConfig, OccupancyRule};
use crate::field::checkpoint::{self, Checkpoint, TrainingProgress};
#[cfg(feature = "wgpu")]
use crate::field::{ComputeDevice, GpuField, devices::Gpu};
use crate::geom::{Ray, RayResult, SdfField};
#[cfg(feature = "wgpu")]
use crate::io::Lock;
use crate::kernel::cpu::march::{Bitmask, MarchRay, Samples};
use crate::kernel::cpu::mlp::Weights;
use crate::kernel::cpu::neus::{self, Rays};
use crate::kernel::cpu::sdf::{self, FieldShape, WIDTH};
#[cfg(feature = "wgpu")]
use crate::kernel::gpu::Evaluator;
use glam::Vec3;
use std::path::Path;
#[cfg(feature = "wgpu")]
use std::sync::Arc;

/// Samples evaluated together in a volume render.
const SAMPLES: usize = 1 << 16;

/// The trained field on the host. All positions and distances are in scene units, the box is [-1, 1]³.
pub struct IFace {
    config: IfaceConfig,
    shape: FieldShape,
    table: Vec<f32>,
    weights: Weights,
    inv_s: f32,
    occupancy: Occupancy,
    /// The weights as a flat array, for upload to a device.
    #[cfg(feature = "wgpu")]
    flat: Vec<f32>,
    #[cfg(feature = "wgpu")]
    on_gpu: GpuField<Evaluator>,
    /// Lock of the GPU, held for the field's lifetime.
    #[cfg(feature = "wgpu")]
    _lock: Option<Arc<Lock>>,
}

impl IFace {
    pub(super) fn new(config: &IfaceConfig, state: SdfState) -> IFace {
        let shape = shape(config);
        let (_flat, weights) = state.weights(&shape);
        let inv_s = state.inv_s();
        let SdfState { groups: [table, ..], occupancy, .. } = state;
        let [table, ..] = table.state;
        let mut face = IFace {
            config: config.clone(),
            shape,
            table,
            weights,
            inv_s,
            occupancy,
            #[cfg(feature = "wgpu")]
            flat: _flat,
            #[cfg(feature = "wgpu")]
            on_gpu: GpuField::new(None),
            #[cfg(feature = "wgpu")]
            _lock: None,
        };
        if config.occupancy == OccupancyRule::Band {
            // The surface has moved since the last update of the cells.
            let mut occupancy = face.occupancy.clone();
            let soft = |x: &[[f32; 3]]| sdf::softness(&face.shape, face.table(), &face.weights, x);
            occupancy.update(config, (0, 0), face.inv_s, 0.0, |x| face.raw_sdf(x), soft);
            face.occupancy = occupancy;
        }
        face
    }

    /// Loads the field from the checkpoint in a stage folder. `config` and `hull` must be the training's.
    pub fn load(dir: &Path, config: &IfaceConfig, hull: Option<&Bitmask>) -> Result<IFace> {
        let mut file = Checkpoint::read(&checkpoint::newest(dir), "iface", FORMAT)?;
        TrainingProgress::restore(&file, config.steps)?;
        let state = SdfState::restore(parts(config), config, hull, &mut file)?;
        Ok(IFace::new(config, state))
    }

    /// Evaluates the field on `device` from now on, if it is a GPU that supports the field.
    #[cfg(feature = "wgpu")]
    pub fn on(mut self, device: ComputeDevice) -> IFace {
        let ComputeDevice::Gpu(Gpu { device, lock, .. }) = device else { return self };
        if Evaluator::supports(&self.shape) {
            let band = self.config.occupancy == OccupancyRule::Band;
            let masks = [Some(&self.occupancy.occupied), band.then_some(&self.occupancy.solid)];
            let evaluator = Evaluator::new(device, &self.shape, &self.table, &self.flat, self.inv_s, masks);
            (self.on_gpu, self._lock) = (GpuField::new(Some(evaluator)), lock);
        }
        self
    }

    /// Returns why the GPU is no longer used, if it failed.
    #[cfg(feature = "wgpu")]
    pub fn gpu_failure(&self) -> Option<&str> {
        self.on_gpu.failure()
    }

    /// Returns the sharpness of the trained surface at its sharpest, per scene unit.
    pub fn inv_s(&self) -> f32 {
        self.inv_s * self.config.radius
    }

    fn table(&self) -> &[[f32; 2]] {
        bytemuck::cast_slice(&self.table)
    }

    /// Evaluates channel `column` of the field's output on the GPU, or by `on_cpu`.
    fn output(
        &self,
        x: &[[f32; 3]],
        column: usize,
        on_cpu: fn(&FieldShape, &[[f32; 2]], &Weights, &[[f32; 3]]) -> Vec<f32>,
    ) -> Vec<f32> {
        #[cfg(feature = "wgpu")]
        if let Some(mut planes) = self.on_gpu.ask(|field| field.evaluate(x, None, None, column..column + 1)) {
            return planes.swap_remove(0);
        }
        let _ = column; // only a GPU selects by it
        on_cpu(&self.shape, self.table(), &self.weights, x)
    }

    fn raw_sdf(&self, x: &[[f32; 3]]) -> Vec<f32> {
        self.output(x, 0, sdf::values)
    }

    fn scaled(&self, points: &[Vec3]) -> Vec<[f32; 3]> {
        points.iter().map(|p| (*p * self.config.radius).to_array()).collect()
    }
}

impl SdfField for IFace {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        let mut f = self.raw_sdf(&self.scaled(points));
        if self.config.radius != 1.0 {
            f.iter_mut().for_each(|f| *f /= self.config.radius);
        }
        f
    }

    fn sharpness(&self, points: &[Vec3]) -> Vec<f32> {
        let soft = self.output(&self.scaled(points), WIDTH - 1, sdf::softness);
        soft.iter().map(|soft| self.inv_s() * soft.exp()).collect()
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        let x = self.scaled(points);
        #[cfg(feature = "wgpu")]
        if let Some(planes) = self.on_gpu.ask(|field| field.evaluate(&x, None, None, 0..4)) {
            let [f, nx, ny, nz] = [0, 1, 2, 3].map(|k| &planes[k]);
            let normal = |i: usize| Vec3::new(nx[i], ny[i], nz[i]);
            return (f.iter().map(|f| f / self.config.radius).collect(), (0..x.len()).map(normal).collect());
        }
        let all = sdf::gradients(&self.shape, self.table(), &self.weights, &x);
        all.into_iter().map(|(f, n)| (f / self.config.radius, Vec3::from(n))).unzip()
    }

    fn colors(
        &self,
        points: &[Vec3],
        normals: &[Vec3],
        counts: &[u32],
        directions: &[Vec3],
    ) -> Vec<[f32; 3]> {
        let arrays = |v: &[Vec3]| -> Vec<[f32; 3]> { v.iter().map(|v| v.to_array()).collect() };
        let (x, normals, directions) = (self.scaled(points), arrays(normals), arrays(directions));
        #[cfg(feature = "wgpu")]
        if let Some(rgb) = self.on_gpu.ask(|field| {
            // The GPU evaluates a point once for each of its directions.
            let each = |rows: &[[f32; 3]]| -> Vec<[f32; 3]> {
                let repeated = |(row, &n): (&[f32; 3], &u32)| std::iter::repeat_n(*row, n as usize);
                rows.iter().zip(counts).flat_map(repeated).collect()
            };
            field.evaluate(&each(&x), Some(&directions), Some(&each(&normals)), 4..7)
        }) {
            return (0..directions.len()).map(|i| [rgb[0][i], rgb[1][i], rgb[2][i]]).collect();
        }
        sdf::colors(&self.shape, self.table(), &self.weights, &x, &normals, Some(counts), &directions)
    }
}

impl IFace {
    /// Renders rays in scene coordinates by volume rendering, the reference for faster renderers.
    pub fn render(&self, rays: &[Ray]) -> Vec<RayResult> {
        /// Rays marched together.
        const PASS: usize = 1 << 13;
        rays.chunks(PASS).flat_map(|rays| self.render_pass(rays)).collect()
    }

    fn render_pass(&self, rays: &[Ray]) -> Vec<RayResult> {
        let config = &self.config;
        let dt = step_length(config).at(self.inv_s);
        let marched: Vec<MarchRay> = rays.iter().map(|r| MarchRay::new(r, config.radius, 0.0)).collect();
        #[cfg(feature = "wgpu")]
        if let Some(composited) = self.on_gpu.ask(|field| field.render(&marched, dt)) {
            return composited.iter().map(|o| self.result(o)).collect();
        }
        let samples = self.occupancy.march(config, dt, &marched);
        // Rays are composited in pieces with a bounded number of samples: a sample takes about two kilobytes.
        let mut out = Vec::with_capacity(rays.len());
        let mut first = 0;
        while first < marched.len() {
            let most = samples.offsets[first] as usize + SAMPLES;
            let fits = samples.offsets.partition_point(|&o| o as usize <= most) - 1;
            let last = fits.clamp(first + 1, marched.len());
            out.extend(self.composite(&marched[first..last], &samples, first, dt));
            first = last;
        }
        out
    }

    /// Composites rays `first..first + rays.len()` of a march.
    fn composite(&self, rays: &[MarchRay], samples: &Samples, first: usize, dt: f32) -> Vec<RayResult> {
        let offsets = &samples.offsets[first..=first + rays.len()];
        let start = offsets[0] as usize;
        let t = &samples.t[start..offsets[rays.len()] as usize];
        let offsets: Vec<i32> = offsets.iter().map(|&o| o - start as i32).collect();
        let n = t.len();
        let (x, d) = samples.points(rays, first);
        let field = sdf::forward(&self.shape, self.table(), &self.weights, &x, &d);
        let direction: Vec<[f32; 3]> = rays.iter().map(|r| r.direction).collect();
        let steps = vec![dt; n];
        let bundle = Rays { offsets: &offsets, direction: &direction, t, dt: &steps };
        neus::forward(bundle, field.output(), self.inv_s, 1.0)
            .chunks_exact(neus::RAY_WIDTH)
            .map(|o| self.result(o))
            .collect()
    }

    /// Converts a composited ray to scene units.
    fn result(&self, o: &[f32]) -> RayResult {
        RayResult {
            color: [o[0], o[1], o[2]],
            opacity: o[3],
            depth: if o[3] > 0.0 { o[4] / o[3] / self.config.radius } else { 0.0 },
            normal: Vec3::new(o[5], o[6], o[7]).normalize_or_zero(),
        }
    }
}

//! Evaluation of a trained field: distances, normals, colors and volume renders.

use super::model::{parts, shape};
use super::occupancy::Occupancy;
use super::schedule::step_length;
use super::state::{FORMAT, SdfState};
use crate::config::iface::{IfaceConfig, OccupancyRule};
use crate::field::checkpoint::{self, Checkpoint, TrainingProgress};
use crate::field::{ComputeDevice, GpuField};
use glam::Vec3;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use tiface_base::Result;
use tiface_base::geom::{BitGrid, Ray, RayResult, SdfField};
use tiface_base::io::Lock;
use tiface_kernels::cpu::mlp::Weights;
use tiface_kernels::cpu::neus::{self, ColorRule, Segments};
use tiface_kernels::cpu::sdf::{self, FieldShape, WIDTH};

/// The field on a device. Points, directions and normals are `[n, 3]`, in the network's
/// coordinates.
pub(super) trait DeviceField: Send {
    /// Returns `channels` of the field's output, `[channels, n]`.
    fn evaluate(
        &self,
        points: &[[f32; 3]],
        directions: Option<&[[f32; 3]]>,
        normals: Option<&[[f32; 3]]>,
        channels: Range<usize>,
    ) -> Result<Vec<Vec<f32>>>;

    /// Returns the composited rays of a volume render with samples `dt` apart.
    fn render(&mut self, rays: &[Ray], dt: f32, colors: ColorRule) -> Result<Vec<[f32; neus::RAY_WIDTH]>>;
}

/// The trained field on the host. All positions and distances are in scene units, the box is [-1,
/// 1]³.
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
    on_gpu: GpuField<Box<dyn DeviceField>>,
    /// Lock of the GPU, held for the field's lifetime.
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
            on_gpu: GpuField::new(None),
            _lock: None,
        };
        if config.occupancy == OccupancyRule::Band {
            // The surface has moved since the last update of the cells.
            let mut occupancy = face.occupancy.clone();
            let field =
                |x: &[[f32; 3]]| sdf::values_and_softness(&face.shape, face.table(), &face.weights, x);
            occupancy.update(config, (0, 0), face.inv_s, 0.0, field);
            face.occupancy = occupancy;
        }
        face
    }

    /// Loads the field from the checkpoint in a stage folder. `config` and `hull` must be the
    /// training's.
    pub fn load(dir: &Path, config: &IfaceConfig, hull: Option<&BitGrid>) -> Result<IFace> {
        let mut file = Checkpoint::read(&checkpoint::newest(dir), "iface", FORMAT)?;
        TrainingProgress::restore(&file, config.steps)?;
        let state = SdfState::restore(parts(config), config, hull, &mut file)?;
        Ok(IFace::new(config, state))
    }

    /// Evaluates the field on `device` from now on, if it is a GPU that supports the field.
    pub fn on(self, device: ComputeDevice) -> IFace {
        match device {
            ComputeDevice::Cpu(_) => self,
            #[cfg(feature = "wgpu")]
            ComputeDevice::Gpu(gpu) => {
                use tiface_kernels::gpu::Evaluator;
                if !Evaluator::supports(&self.shape) {
                    return self;
                }
                let band = self.config.occupancy == OccupancyRule::Band;
                let masks = [Some(&self.occupancy.occupied), band.then_some(&self.occupancy.solid)];
                let (shape, inv_s) = (&self.shape, self.inv_s);
                let field = Evaluator::new(gpu.device, shape, &self.table, &self.flat, inv_s, masks);
                let field: Box<dyn DeviceField> = Box::new(field);
                IFace { on_gpu: GpuField::new(Some(field)), _lock: gpu.lock, ..self }
            }
        }
    }

    /// Returns why the GPU is no longer used, if it failed.
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
        if let Some(mut planes) = self.on_gpu.ask(|field| field.evaluate(x, None, None, column..column + 1)) {
            return planes.swap_remove(0);
        }
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

    /// Returns which samples have colors: in a render each has its own, so that rays may be
    /// evaluated in pieces.
    fn color_rule(&self) -> ColorRule {
        ColorRule { min_weight: self.config.min_weight, group_weight: 0.0 }
    }

    fn render_pass(&self, rays: &[Ray]) -> Vec<RayResult> {
        let dt = step_length(&self.config).at(self.inv_s);
        let marched: Vec<Ray> = rays.iter().map(|r| r.scaled(self.config.radius)).collect();
        if let Some(composited) = self.on_gpu.ask(|field| field.render(&marched, dt, self.color_rule())) {
            return composited.iter().map(|o| self.result(o)).collect();
        }
        self.composite(&marched, dt).iter().map(|o| self.result(o)).collect()
    }

    /// Composites the samples of rays. Each round evaluates the next few samples of the rays that
    /// are not opaque yet; a sample takes about two kilobytes.
    fn composite(&self, rays: &[Ray], dt: f32) -> Vec<[f32; neus::RAY_WIDTH]> {
        /// Samples of a ray that are evaluated together.
        const AHEAD: usize = 8;
        /// Light that may be left where a ray ends.
        const OPAQUE: f32 = 1e-4;
        let samples = self.occupancy.march(&self.config, dt, rays, &[]);
        let end = |r: usize| samples.offsets[r + 1] as usize;
        let mut out = vec![[0f32; neus::RAY_WIDTH]; rays.len()];
        let mut open: Vec<(usize, usize)> =
            (0..rays.len()).map(|r| (r, samples.offsets[r] as usize)).filter(|&(r, k)| k < end(r)).collect();
        while !open.is_empty() {
            let (mut x, mut d, mut t, mut offsets) = (Vec::new(), Vec::new(), Vec::new(), vec![0]);
            for &(r, k) in &open {
                let [origin, direction] = [rays[r].origin, rays[r].direction].map(|v| v.to_array());
                for &at in &samples.t[k..end(r).min(k + AHEAD)] {
                    x.push(std::array::from_fn(|a| origin[a] + at * direction[a]));
                    d.push(direction);
                    t.push(at);
                }
                offsets.push(t.len() as i32);
            }
            let mut field = sdf::geometry(&self.shape, self.table(), &self.weights, &x);
            let direction: Vec<[f32; 3]> = open.iter().map(|&(r, _)| rays[r].direction.to_array()).collect();
            let (dt, colors) = (&vec![dt; t.len()], self.color_rule());
            let pieces = Segments { offsets: &offsets, direction: &direction, t: &t, dt, colors };
            let mut weights = neus::weights(pieces, field.output(), self.inv_s, 1.0);
            for (i, &(r, _)) in open.iter().enumerate() {
                let light = 1.0 - out[r][3];
                weights[offsets[i] as usize..offsets[i + 1] as usize].iter_mut().for_each(|w| *w *= light);
            }
            let sources = neus::color_sources(pieces, &weights);
            field.shade(&self.weights, neus::shown(&sources), &d);
            let composited = neus::composite(pieces, field.output(), &weights, &sources);
            let mut pieces = composited.as_chunks::<{ neus::RAY_WIDTH }>().0.iter();
            open.retain_mut(|(r, k)| {
                let out = &mut out[*r];
                for (out, piece) in out.iter_mut().zip(pieces.next().into_iter().flatten()) {
                    *out += piece;
                }
                *k += AHEAD;
                1.0 - out[3] > OPAQUE && *k < end(*r)
            });
        }
        out
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

//! A vector-matrix field and rays to test kernels on.

use super::super::batch::DeviceBatch;
use super::super::device::{Buffer, Device, Words};
use super::super::evaluate::planes;
use super::{Vm, VmValues};
use crate::cpu::vm::mask::{BoxMask, Lattice};
use crate::cpu::vm::{self, DecoderShape, DecoderWeights, Grid, RAY_WIDTH, Rendered, VmField};
use tiface_base::Result;
use tiface_base::geom::Ray;
use tiface_base::math::rng;

/// A field, its values, rays, and gradients of what they see.
pub(super) struct Case {
    pub field: VmField,
    pub density: Vec<f32>,
    pub color: Vec<f32>,
    pub network: Vec<f32>,
    pub rays: Vec<Ray>,
    pub jitter: Vec<f32>,
    pub g: Vec<f32>,
}

/// What differs between cases.
#[derive(Clone, Copy)]
pub(super) struct Shape {
    pub softplus: bool,
    pub hidden: usize,
    pub density: [usize; 3],
    pub color: [usize; 3],
    pub threshold: f32,
    pub stop: f32,
    pub group_weight: f32,
    pub masked: bool,
}

/// Hidden layers of one tile and inputs of two, ranks of whole vectors: those of the preset
/// `draft`, with which T-Face's tests share the compiled kernels. A driver in software takes
/// seconds for each further shape.
pub(super) const NARROW: Shape = Shape {
    softplus: false,
    hidden: 64,
    density: [8, 8, 8],
    color: [24, 24, 24],
    threshold: 1e-3,
    stop: 1e-3,
    group_weight: 0.05,
    masked: true,
};

/// A small field and so many rays through it.
pub(super) fn case(shape: Shape, count: u64) -> Case {
    let size = [9, 12, 7];
    let (min, max) = ([-1.0, -1.5, -0.75], [1.0, 1.5, 0.75]);
    let hit = |c: [usize; 3]| !(c[0] + 3 * c[1] + 5 * c[2]).is_multiple_of(4) && c[2] < 25;
    let mask = BoxMask::new([-1.0, -1.25, -0.75], [1.0, 1.5, 1.0], [19, 20, 29], hit);
    let field = VmField {
        density: Grid { size, rank: shape.density },
        color: Grid { size, rank: shape.color },
        decoder: DecoderShape {
            channels: shape.color.iter().sum(),
            features: 27,
            hidden: shape.hidden,
            view_frequencies: 0,
            feature_frequencies: 0,
        },
        lattice: Lattice { min, max, step: 0.05, samples: 90, near: 0.5, far: 9.0 },
        shading: vm::Shading {
            softplus: shape.softplus,
            shift: -1.0,
            distance_scale: 3.0,
            weight_threshold: shape.threshold,
            stop: shape.stop,
            group_weight: shape.group_weight,
        },
        mask: shape.masked.then_some(mask),
    };
    let normal = |stream: u64, n: usize, scale: f32| -> Vec<f32> {
        (0..n).map(|i| scale * rng::normal(5, stream, i as u64)).collect()
    };
    let mut network = normal(3, field.decoder.len(), 0.3);
    // the basis: features of about one
    network[..field.decoder.channels * field.decoder.features].iter_mut().for_each(|v| *v *= 0.5);
    let density: Vec<f32> = normal(1, field.density.len(), 0.4).iter().map(|v| v + 0.2).collect();
    let jittered = (0..count).map(|i| {
        let u = |k: u64| rng::uniform(5, 4, 8 * i + k) - 0.5;
        let direction = if i == 0 { [0.0, 0.0, -1.0] } else { [0.8 * u(2), 0.8 * u(3), -1.0] };
        (Ray::new([3.0 * u(0), 3.0 * u(1), 3.0], direction), u(4) + 0.5)
    });
    let (rays, jitter) = jittered.unzip();
    Case {
        color: normal(2, field.color.len(), 0.7),
        network,
        rays,
        jitter,
        g: normal(5, count as usize * RAY_WIDTH, 1.0),
        density,
        field,
    }
}

/// Some places more than rays.
pub(super) fn capacity(case: &Case) -> usize {
    case.rays.len() + 3
}

/// Rays and values on a device.
pub(super) struct DeviceCase {
    pub vm: Vm,
    values: [Buffer; 3],
    pub rays: DeviceBatch,
    g_out: Buffer,
}

impl DeviceCase {
    pub fn new(device: &Device, case: &Case) -> DeviceCase {
        let n = capacity(case);
        let vm = Vm::new(device, &case.field, n, true);
        DeviceCase {
            values: [
                vm.density.upload(device, &case.density),
                vm.color.upload(device, &case.color),
                device.upload(&case.network),
            ],
            rays: DeviceBatch::upload(device, &case.rays, &case.jitter, n),
            g_out: device.upload(&planes::<RAY_WIDTH>(case.g.as_chunks().0, n)),
            vm,
        }
    }

    fn values(&self) -> VmValues<'_> {
        VmValues { density: &self.values[0], color: &self.values[1], network: &self.values[2] }
    }

    pub fn render(&self, device: &Device) -> Result<Vec<f32>> {
        device.fetch(self.vm.render(device, self.values(), &self.rays))
    }

    /// Of density, appearance and decoder, after a render.
    pub fn gradients(&self, device: &Device) -> Result<[Vec<f32>; 3]> {
        let [d, c, n] = self.values.each_ref().map(|v| device.zeros::<f32>(v.word_count()));
        let gradients = VmValues { density: &d, color: &c, network: &n };
        let non_finite = device.zeros::<u32>(1);
        self.vm.backward(device, self.values(), &self.rays, &self.g_out, gradients, &non_finite);
        assert_eq!(device.fetch::<u32>(&non_finite)?, [0]);
        let (density, color) = (&self.vm.density, &self.vm.color);
        Ok([density.cut(device.fetch(&d)?), color.cut(device.fetch(&c)?), device.fetch(&n)?])
    }
}

/// What the CPU renders, and gradients of density, appearance and decoder.
pub(super) fn on_cpu(case: &Case) -> (Rendered, [Vec<f32>; 3]) {
    let weights = DecoderWeights::new(case.field.decoder, &case.network);
    let rendered = vm::render(&case.field, &case.density, &case.color, &weights, &case.rays, &case.jitter);
    let (mut d, mut c) = (vec![0.0; case.density.len()], vec![0.0; case.color.len()]);
    let n = vm::backward(&case.field, &case.density, &weights, rendered.clone(), &case.g, &mut d, &mut c);
    (rendered, [d, c, n])
}

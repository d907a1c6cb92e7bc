//! A device, its memory, and what it was asked to do.

use bytemuck::Pod;
use cubecl::device::{WgpuBackend, WgpuDevice, WgpuDeviceKind};
use cubecl::features::AtomicUsage;
use cubecl::ir::{ElemType, FloatKind, Type};
use cubecl::prelude::{BufferArg, Client, CubeCount};
use cubecl::server::Handle;
use std::sync::atomic::{AtomicUsize, Ordering};

/// How threads add to one float.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Atomics {
    /// The device adds floats itself.
    Native,
    /// Compare and exchange until nobody came between: for adapters that cannot.
    Exchange,
    /// Integers of a fixed unit, chosen from a bound on the sum: the same bytes in any order.
    Fixed,
}

/// A device that runs kernels.
pub struct Device {
    client: Client,
    atomics: Atomics,
    launches: AtomicUsize,
    readbacks: AtomicUsize,
}

/// Memory of a device, in words of 32 bits.
#[derive(Clone)]
pub struct Buffer {
    handle: Handle,
    words: usize,
}

impl Buffer {
    /// As an argument of a kernel.
    pub(super) fn arg(&self) -> BufferArg {
        // SAFETY: the handle was allocated with this length.
        unsafe { BufferArg::from_raw_parts(self.handle.clone(), self.words) }
    }

    /// How many words it holds.
    pub fn words(&self) -> usize {
        self.words
    }
}

impl Device {
    /// The adapters of this machine, the fastest kind first; software ones only where asked for.
    pub fn adapters(software: bool) -> Vec<cubecl::Device> {
        use WgpuDeviceKind::{Cpu, DiscreteGpu, IntegratedGpu, VirtualGpu};
        let kinds = [DiscreteGpu(0), IntegratedGpu(0), VirtualGpu(0), Cpu];
        let apis = [WgpuBackend::Vulkan, WgpuBackend::Metal, WgpuBackend::Dx12];
        let like =
            |kind: &WgpuDeviceKind, api| cubecl::Device::from(WgpuDevice::new(kind.clone()).on(api)).to_id();
        let wanted = kinds.iter().filter(|kind| software || **kind != Cpu);
        wanted
            .flat_map(|kind| apis.map(|api| cubecl::Device::enumerate(like(kind, api))))
            .flatten()
            .map(cubecl::Device::from_id)
            .collect()
    }

    /// Opens an adapter, with the atomics it does best.
    pub fn open(adapter: &cubecl::Device) -> Device {
        let client = adapter.client();
        let float = Type::atomic(ElemType::Float(FloatKind::F32));
        let native = client.properties().atomic_type_usage(float).contains(AtomicUsage::Add);
        let atomics = if native { Atomics::Native } else { Atomics::Exchange };
        Device { client, atomics, launches: AtomicUsize::new(0), readbacks: AtomicUsize::new(0) }
    }

    /// As the adapter names itself.
    pub fn name(&self) -> &str {
        &self.client.properties().identity.name
    }

    /// How this device adds.
    pub fn atomics(&self) -> Atomics {
        self.atomics
    }

    /// The same device adding in another way: [`Atomics::Native`] only where it was native before.
    pub fn with_atomics(self, atomics: Atomics) -> Device {
        assert!(
            atomics != Atomics::Native || self.atomics == Atomics::Native,
            "the adapter cannot add floats"
        );
        Device { atomics, ..self }
    }

    /// Copies values to the device.
    pub fn upload<T: Pod>(&self, values: &[T]) -> Buffer {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        Buffer { handle: self.client.create_from_slice(bytes), words: bytes.len() / 4 }
    }

    /// Memory of **arbitrary contents**: a kernel writes it before another reads it.
    pub fn scratch(&self, words: usize) -> Buffer {
        Buffer { handle: self.client.empty(words.max(1) * 4), words }
    }

    /// Memory of zeros.
    pub fn zeros(&self, words: usize) -> Buffer {
        self.upload(&vec![0u32; words.max(1)])
    }

    /// Waits for the device and copies values back.
    pub fn read<T: Pod>(&self, buffer: &Buffer) -> Vec<T> {
        self.readbacks.fetch_add(1, Ordering::Relaxed);
        let bytes = self.client.read_one_unchecked(buffer.handle.clone());
        bytemuck::pod_collect_to_vec(&bytes[..buffer.words * 4])
    }

    /// What the next launch runs on; counts it.
    pub(super) fn launch(&self) -> &Client {
        self.launches.fetch_add(1, Ordering::Relaxed);
        &self.client
    }

    /// Launches and readbacks so far.
    pub fn counts(&self) -> (usize, usize) {
        (self.launches.load(Ordering::Relaxed), self.readbacks.load(Ordering::Relaxed))
    }
}

/// So many groups of threads, beyond 65,535 in two dimensions: a kernel uses its position among all and ignores
/// those that are too many.
pub(super) fn groups(count: usize) -> CubeCount {
    const MOST: usize = 65_535;
    let rows = count.div_ceil(MOST).max(1);
    CubeCount::Static(count.div_ceil(rows) as u32, rows as u32, 1)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A device to test on, a software one too; without any, says so.
    pub fn device() -> Option<Device> {
        let found = Device::adapters(true).first().map(Device::open);
        if found.is_none() {
            println!("skipped: kernels on a GPU, for no adapter is here (Mesa's lavapipe would do)");
        }
        found
    }

    /// Every way of adding that the device has.
    pub fn devices() -> Vec<Device> {
        let ways = [Atomics::Native, Atomics::Exchange, Atomics::Fixed];
        let has = |d: &Device, way: Atomics| way != Atomics::Native || d.atomics() == way;
        ways.into_iter()
            .filter_map(|way| device().filter(|d| has(d, way)).map(|d| d.with_atomics(way)))
            .collect()
    }

    /// Asserts that two arrays agree to `tolerance` of the larger of a value and the mean magnitude.
    pub fn agree(what: &str, got: &[f32], want: &[f32], tolerance: f32) {
        assert_eq!(got.len(), want.len(), "{what}");
        let mean = want.iter().map(|v| v.abs()).sum::<f32>() / want.len().max(1) as f32;
        let error = |(g, w): (&f32, &f32)| (g - w).abs() / w.abs().max(mean).max(f32::MIN_POSITIVE);
        let worst =
            got.iter().zip(want).map(error).fold(0f32, |a, b| if b > a || b.is_nan() { b } else { a });
        println!("{what}: {worst:.1e} of {tolerance:.0e}");
        assert!(worst <= tolerance, "{what}: {worst:.1e}");
    }

    /// Rows `[n, W]` as planes `[W, capacity]`.
    pub fn planes<const W: usize>(rows: &[[f32; W]], capacity: usize) -> Vec<f32> {
        let mut out = vec![0.0; W * capacity];
        for (i, row) in rows.iter().enumerate() {
            (0..W).for_each(|k| out[k * capacity + i] = row[k]);
        }
        out
    }

    #[test]
    fn what_is_copied_there_comes_back() {
        let Some(device) = device() else { return };
        let there = device.upload(&[1.5f32, -2.0, 3.0]);
        assert_eq!(device.read::<f32>(&there), [1.5, -2.0, 3.0]);
        assert_eq!(device.read::<u32>(&device.zeros(5)), [0; 5]);
        assert_eq!(device.counts(), (0, 2));
        println!("{} adds floats: {:?}", device.name(), device.atomics());
    }

    #[test]
    fn many_groups_lie_in_two_dimensions() {
        let size = |n: usize| match groups(n) {
            CubeCount::Static(x, y, z) => [x, y, z],
            _ => [0; 3],
        };
        assert_eq!([size(1), size(65_535), size(65_536)], [[1, 1, 1], [65_535, 1, 1], [32_768, 2, 1]]);
    }
}

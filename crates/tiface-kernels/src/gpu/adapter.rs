//! GPU adapters: what the APIs of this machine list.

use burn::backend::{CubeDevice, WgpuBackend, WgpuDevice, WgpuDeviceKind};
use burn::cubecl::future;
use burn::cubecl::prelude::Client;
use burn::cubecl::wgpu::{
    AutoGraphicsApi, MemoryConfiguration, RuntimeOptions, WgpuInitError, try_init_setup, wgpu,
};
use std::collections::BTreeMap;
use std::sync::{Mutex, OnceLock};

/// A GPU as one API exposes it.
pub struct Adapter {
    pub(super) device: CubeDevice,
    /// Name that the driver reports.
    pub name: String,
    /// PCI address of the card, if known.
    pub card: Option<String>,
    /// `vulkan`, `metal` or `dx12`.
    pub api: &'static str,
    /// `discrete`, `integrated`, `virtual`, `other` (some virtual machines say no more) or
    /// `software`.
    pub kind: &'static str,
    /// Whether the adapter is a software renderer.
    pub software: bool,
    /// Driver and version; empty if the API does not report them.
    pub driver: String,
    /// Bytes of memory; `None` if the API does not report it.
    pub memory: Option<u64>,
    /// Bytes of the largest heap of it that is local to the device, in which every buffer lies.
    pub(super) heap: Option<u64>,
    /// Whether CubeCL has a client of the adapter.
    opened: Mutex<bool>,
}

/// Names of the kinds of adapters, the fastest first.
const KINDS: [&str; 5] = ["discrete", "integrated", "virtual", "other", "software"];

impl Adapter {
    /// Returns every adapter of this machine, the fastest kind first. A card that several APIs
    /// reach is listed once for each. Only the first call of a process queries the drivers.
    pub fn all() -> &'static [Adapter] {
        static ALL: OnceLock<Vec<Adapter>> = OnceLock::new();
        ALL.get_or_init(Adapter::find)
    }

    /// Enumerates the adapters of all APIs through one instance.
    fn find() -> Vec<Adapter> {
        use WgpuDeviceKind::{Cpu, DiscreteGpu, IntegratedGpu, Other, VirtualGpu};
        const APIS: [(wgpu::Backend, WgpuBackend, &str); 3] = [
            (wgpu::Backend::Vulkan, WgpuBackend::Vulkan, "vulkan"),
            (wgpu::Backend::Metal, WgpuBackend::Metal, "metal"),
            (wgpu::Backend::Dx12, WgpuBackend::Dx12, "dx12"),
        ];
        let backends = APIS.iter().fold(wgpu::Backends::empty(), |all, &(api, ..)| all | api.into());
        let descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor { backends, ..descriptor });
        let mut found = Vec::new();
        // CubeCL numbers the adapters of an API and kind in the order of this list
        let mut numbers = BTreeMap::new();
        for adapter in future::block_on(instance.enumerate_adapters(backends)) {
            let info = adapter.get_info();
            let Some(api) = APIS.iter().position(|&(api, ..)| api == info.backend) else { continue };
            let (_, backend, word) = APIS[api];
            let kind = match info.device_type {
                wgpu::DeviceType::DiscreteGpu => 0,
                wgpu::DeviceType::IntegratedGpu => 1,
                wgpu::DeviceType::VirtualGpu => 2,
                wgpu::DeviceType::Other => 3,
                wgpu::DeviceType::Cpu => 4,
            };
            let next = numbers.entry((kind, api)).or_insert(0);
            let number = std::mem::replace(next, *next + 1);
            let like = match kind {
                0 => DiscreteGpu(number),
                1 => IntegratedGpu(number),
                2 => VirtualGpu(number),
                3 => Other(number),
                // CubeCL can open only the first software adapter.
                _ if number > 0 => continue,
                _ => Cpu,
            };
            // DX12 would give identical cards the address of the first one.
            let is_card = info.backend == wgpu::Backend::Vulkan && kind != 4;
            let [memory, heap] = memory_of(&adapter, kind == 1);
            let adapter = Adapter {
                device: CubeDevice::from(WgpuDevice::new(like).on(backend)),
                card: Some(info.device_pci_bus_id).filter(|address| is_card && !address.is_empty()),
                name: info.name,
                api: word,
                kind: KINDS[kind],
                software: kind == 4,
                driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
                memory,
                heap,
                opened: Mutex::new(false),
            };
            found.push(((kind, api, number), adapter));
        }
        found.sort_by_key(|(order, _)| *order);
        found.into_iter().map(|(_, adapter)| adapter).collect()
    }

    /// Returns the client of the adapter, which lives as long as the process. On wgpu each large
    /// buffer gets memory of its own: by default CubeCL carves all buffers from pages as large as
    /// the largest of them, and takes up to such a page more than requested.
    ///
    /// A failure is returned here, since CubeCL panics where it has to open a device itself.
    pub(super) fn client(&self) -> std::result::Result<Client, WgpuInitError> {
        let mut opened = self.opened.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if let (CubeDevice::Wgpu(device), false) = (&self.device, *opened) {
            let memory_config = MemoryConfiguration::ExclusivePages;
            let options = RuntimeOptions { memory_config, ..RuntimeOptions::try_default()? };
            match try_init_setup::<AutoGraphicsApi>(device, options) {
                // it has a client already
                Ok(_) | Err(WgpuInitError::Registration { .. }) => *opened = true,
                Err(e) => return Err(e),
            }
        }
        Ok(self.device.client())
    }

    /// An adapter that is listed, but cannot be opened.
    #[cfg(any(test, feature = "testing"))]
    pub fn absent(name: &str) -> Adapter {
        let like = WgpuDeviceKind::DiscreteGpu(4242);
        Adapter {
            device: CubeDevice::from(WgpuDevice::new(like).on(WgpuBackend::Vulkan)),
            name: name.to_owned(),
            card: None,
            api: "vulkan",
            kind: KINDS[0],
            software: false,
            driver: String::new(),
            memory: None,
            heap: None,
            opened: Mutex::new(false),
        }
    }
}

/// Returns the bytes of an adapter's memory and of its largest local heap, which Vulkan states.
/// WebGPU, whose shaders CubeCL compiles here, does not.
#[cfg(not(target_vendor = "apple"))]
fn memory_of(adapter: &wgpu::Adapter, integrated: bool) -> [Option<u64>; 2] {
    const DEVICE_LOCAL: u32 = 1;
    // SAFETY: nothing is created or destroyed through the handles, which the adapter outlives.
    let properties = unsafe {
        let Some(vulkan) = adapter.as_hal::<wgpu::hal::api::Vulkan>() else { return [None; 2] };
        let instance = vulkan.shared_instance().raw_instance();
        instance.get_physical_device_memory_properties(vulkan.raw_physical_device())
    };
    let heaps = &properties.memory_heaps[..properties.memory_heap_count as usize];
    let heaps = || heaps.iter().map(|heap| (heap.size, heap.flags.as_raw() & DEVICE_LOCAL != 0));
    [memory_of_heaps(heaps(), integrated), memory_of_heaps(heaps(), false)]
}

/// Returns the memory in heaps, given the bytes of each and whether it is local to the device: the
/// largest local one. An integrated GPU has the memory of the CPU, and its local heap may be
/// a small part that the firmware keeps for it; so it has all heaps.
#[cfg(any(test, not(target_vendor = "apple")))]
fn memory_of_heaps(heaps: impl Iterator<Item = (u64, bool)>, integrated: bool) -> Option<u64> {
    if integrated {
        return heaps.map(|(bytes, _)| bytes).reduce(u64::saturating_add);
    }
    heaps.filter(|(_, is_local)| *is_local).map(|(bytes, _)| bytes).max()
}

/// Returns `None`: Metal states no size, but one that it recommends.
#[cfg(target_vendor = "apple")]
fn memory_of(_: &wgpu::Adapter, _: bool) -> [Option<u64>; 2] {
    [None; 2]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_heap_of_an_integrated_gpu_is_not_all_of_its_memory() {
        const GIB: u64 = 1 << 30;
        let memory = |heaps: &[(u64, bool)], integrated| memory_of_heaps(heaps.iter().copied(), integrated);
        // a card, the part of it that the CPU sees, and the CPU's memory
        assert_eq!(memory(&[(8 * GIB, true), (GIB / 4, true), (32 * GIB, false)], false), Some(8 * GIB));
        assert_eq!(memory(&[(32 * GIB, false)], false), None);
        assert_eq!(memory(&[(GIB / 2, true), (15 * GIB, false)], true), Some(31 * GIB / 2));
        // a single buffer lies in the local one
        assert_eq!(memory(&[(GIB / 2, true), (15 * GIB, false)], false), Some(GIB / 2));
        assert_eq!(memory(&[], true), None);
    }
}

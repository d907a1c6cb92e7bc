//! GPU devices: adapters, memory, kernel launches and readbacks.

use burn::backend::tensor::FloatTensor;
use burn::backend::{Cube, CubeDevice, WgpuBackend, WgpuDevice, WgpuDeviceKind};
use burn::cubecl::bytes::Bytes;
use burn::cubecl::features::AtomicUsage;
use burn::cubecl::future;
use burn::cubecl::ir::{ElemType, FloatKind, Type};
use burn::cubecl::prelude::{BufferArg, Client, CubeCount};
use burn::cubecl::server::Handle;
use burn::cubecl::wgpu::{
    AutoGraphicsApi, MemoryConfiguration, RuntimeOptions, WgpuInitError, try_init_setup, wgpu,
};
use burn::tensor::{DType, Element};
use bytemuck::Pod;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;
use std::ops::Range;
use std::panic::{self, AssertUnwindSafe};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, Once, OnceLock};
use tiface_base::{Error, Result};

/// The first error of wgpu, or the first launch refused, since a device was read. CubeCL turns such
/// an error into a panic on a thread of its own, whose launches are lost while reads go on
/// answering.
static WGPU_ERROR: Mutex<Option<String>> = Mutex::new(None);

/// Installs a panic hook that records errors of wgpu instead of printing them.
fn note_errors() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let others = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            let message = info.payload_as_str().and_then(|text| text.strip_prefix("wgpu error: "));
            let Some(message) = message else { return others(info) };
            note(message.to_owned());
        }));
    });
}

/// Records an error, if it is the first since the last readback.
fn note(message: String) {
    let mut noted = WGPU_ERROR.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    noted.get_or_insert(message);
}

/// Returns and clears the error recorded since the last call.
fn noted_error() -> Option<String> {
    WGPU_ERROR.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take()
}

/// Method by which threads add to one float.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Atomics {
    /// The device has native atomic addition of floats.
    Native,
    /// A compare-and-exchange loop, for adapters without atomic addition of floats.
    Exchange,
    /// Fixed-point integers, scaled by a bound on the sum, which give the same bytes in any order.
    Fixed,
}

/// A device that runs kernels.
pub struct Device {
    device: CubeDevice,
    client: Client,
    driver: String,
    atomics: Atomics,
    memory: Option<u64>,
    heap: Option<u64>,
    launches: AtomicUsize,
    readbacks: AtomicUsize,
    /// Names of the kernels that were launched.
    kernels: Mutex<BTreeSet<&'static str>>,
}

/// Memory of a device: burn's one-dimensional tensor of 32-bit elements, the same type for floats
/// and words.
pub type Buffer = FloatTensor<Cube>;

/// A tensor as kernels see it.
pub trait Words {
    /// Returns the number of 32-bit words.
    fn word_count(&self) -> usize;

    /// Returns the buffer as a kernel argument.
    fn arg(&self) -> BufferArg;

    /// Returns the handles of the buffer's memory.
    fn handles(&self) -> [&Handle; 1];
}

impl Words for Buffer {
    fn word_count(&self) -> usize {
        self.meta.num_elements()
    }

    fn arg(&self) -> BufferArg {
        // SAFETY: the handle was allocated with this length.
        unsafe { BufferArg::from_raw_parts(self.handle.clone(), self.word_count()) }
    }

    fn handles(&self) -> [&Handle; 1] {
        [&self.handle]
    }
}

/// Limits of a device.
#[derive(Clone, Copy, Debug)]
pub struct DeviceLimits {
    /// Bytes of memory; `None` if the driver does not report it.
    pub memory: Option<u64>,
    /// Bytes of the largest buffer.
    pub largest_buffer: u64,
    /// Bytes of shared memory of a workgroup.
    pub shared: usize,
}

/// A GPU as one API exposes it.
pub struct Adapter {
    device: CubeDevice,
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
    heap: Option<u64>,
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
    fn client(&self) -> std::result::Result<Client, WgpuInitError> {
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

impl Device {
    /// Opens an adapter with the fastest atomics it supports.
    ///
    /// # Errors
    ///
    /// If the driver refuses it: of kind [`NotNow`](tiface_base::ErrorKind::NotNow) where its
    /// memory is used up, else of kind [`Cannot`](tiface_base::ErrorKind::Cannot).
    pub fn open(adapter: &Adapter) -> Result<Device> {
        note_errors();
        let client = adapter.client().map_err(|why| {
            let problem =
                format!("the device `{}` cannot be opened: {}", adapter.name, on_one_line(&why, 300));
            match &why {
                WgpuInitError::RequestDevice { message } if message.to_lowercase().contains("memory") => {
                    Error::not_now(problem, "close what else uses the device, then repeat the command")
                }
                _ => Error::cannot(problem, "mend the GPU's driver, or use `--device cpu`"),
            }
        })?;
        let device = adapter.device.clone();
        let float = Type::atomic(ElemType::Float(FloatKind::F32));
        let native = client.properties().atomic_type_usage(float).contains(AtomicUsage::Add);
        let atomics = if native { Atomics::Native } else { Atomics::Exchange };
        let memory = client.properties().memory.max_memory().or(adapter.memory);
        let compiles_for = &client.properties().identity.fingerprint;
        let driver = [adapter.driver.as_str(), compiles_for].into_iter().find(|text| !text.is_empty());
        let driver = driver.unwrap_or_default().to_owned();
        let (launches, readbacks) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let kernels = Mutex::default();
        let heap = adapter.heap;
        Ok(Device { device, client, driver, atomics, memory, heap, launches, readbacks, kernels })
    }

    /// Returns the adapter's name.
    pub fn name(&self) -> &str {
        &self.client.properties().identity.name
    }

    /// Returns driver and version, or the compilation target if they are unknown.
    pub fn driver(&self) -> &str {
        &self.driver
    }

    /// Returns the device's limits.
    pub fn limits(&self) -> DeviceLimits {
        let properties = self.client.properties();
        DeviceLimits {
            memory: self.memory,
            // wgpu allocates no buffer that is larger than the heap it lies in
            largest_buffer: properties.memory.max_page_size.min(self.heap.unwrap_or(u64::MAX)),
            shared: properties.hardware.max_shared_memory_size,
        }
    }

    /// Returns the bytes that a training may use: the device's memory minus a reserve for the
    /// driver and other programs, or `u64::MAX` if the driver does not report the memory.
    pub fn available_memory(&self) -> u64 {
        const KEPT: u64 = 512 << 20;
        self.memory.map_or(u64::MAX, |memory| memory.saturating_sub(KEPT))
    }

    /// Returns the kind of atomics in use.
    pub fn atomics(&self) -> Atomics {
        self.atomics
    }

    /// Selects another kind of atomics; [`Atomics::Native`] only if the device has them.
    pub fn with_atomics(self, atomics: Atomics) -> Device {
        assert!(
            atomics != Atomics::Native || self.atomics == Atomics::Native,
            "the adapter cannot add floats"
        );
        Device { atomics, ..self }
    }

    /// Sets the device's memory to `bytes`, less or more than the driver reports.
    pub fn with_memory(self, bytes: u64) -> Device {
        Device { memory: Some(bytes), ..self }
    }

    /// Returns the bytes reserved in the device's memory, by all clients of this process.
    #[cfg(any(test, feature = "testing"))]
    pub fn reserved_memory(&self) -> u64 {
        self.client.memory_report(burn::cubecl::MemoryScope::Device).usage().bytes_reserved
    }

    /// Frees memory that is no longer in use.
    pub fn release_unused(&self) {
        // Memory that cannot be freed now is freed later.
        let _ = self.client.memory_cleanup();
    }

    /// Copies values to the device.
    pub fn upload<T: Element>(&self, values: &[T]) -> Buffer {
        self.upload_vec(values.to_vec())
    }

    /// Copies values to the device as [`Device::upload`] does, without another copy on the host.
    pub fn upload_vec<T: Element>(&self, values: Vec<T>) -> Buffer {
        let words = values.len();
        self.tensor(self.client.create(Bytes::from_elems(values)), words, T::dtype())
    }

    /// Copies values into a buffer, from its word `first` on. They are sent at once: the driver
    /// keeps a copy until then.
    pub(super) fn write<T: Element>(&self, into: &Buffer, first: usize, values: Vec<T>) {
        let behind = into.word_count() - first - values.len();
        let handle = into.handle.clone().offset_start(4 * first as u64).offset_end(4 * behind as u64);
        self.client.write(&handle, Bytes::from_elems(values));
        // A failure here also fails the next read.
        let _ = self.client.flush();
    }

    /// Allocates memory with **arbitrary contents**, which a kernel must write before another reads
    /// it.
    pub fn scratch<T: Element>(&self, words: usize) -> Buffer {
        self.tensor(self.client.empty(words.max(1) * 4), words, T::dtype())
    }

    /// Allocates memory filled with zeros.
    pub fn zeros<T: Element>(&self, words: usize) -> Buffer {
        self.upload_vec(vec![T::zeroed(); words.max(1)])
    }

    fn tensor(&self, handle: Handle, words: usize, dtype: DType) -> Buffer {
        assert_eq!(dtype.size(), 4, "kernels know elements of 32 bits");
        Buffer::new_contiguous(self.client.clone(), self.device.clone(), [words].into(), handle, dtype)
    }

    /// Waits for the device and copies values back.
    ///
    /// # Errors
    ///
    /// Fails if the device does not answer, or an operation since the last call failed. Of kind
    /// [`NotNow`](tiface_base::ErrorKind::NotNow) where it is lost or has no memory left; of kind
    /// [`Cannot`](tiface_base::ErrorKind::Cannot) where its driver refuses a kernel or a launch.
    /// Nothing on the host is harmed.
    pub fn fetch<T: Pod>(&self, buffer: &Buffer) -> Result<Vec<T>> {
        self.readbacks.fetch_add(1, Ordering::Relaxed);
        #[cfg(any(test, feature = "testing"))]
        super::testing::answer().map_err(|e| self.failed(e))?;
        let read = panic::catch_unwind(AssertUnwindSafe(|| self.client.read_one(buffer.handle.clone())));
        if let Some(error) = noted_error() {
            return Err(self.failed(error));
        }
        let bytes = match read {
            Ok(read) => read.map_err(|e| self.failed(format!("{e:?}")))?,
            Err(panic) => panic::resume_unwind(panic),
        };
        Ok(bytemuck::pod_collect_to_vec(&bytes[..buffer.word_count() * 4]))
    }

    /// Reads a part of a buffer's floats as [`Device::fetch`] does.
    pub(super) fn fetch_part(&self, buffer: &Buffer, part: Range<usize>) -> Result<Vec<f32>> {
        let behind = buffer.word_count() - part.end;
        let handle = buffer.handle.clone().offset_start(4 * part.start as u64).offset_end(4 * behind as u64);
        self.fetch(&self.tensor(handle, part.len(), buffer.dtype))
    }

    /// As [`Device::fetch`].
    ///
    /// # Panics
    ///
    /// Where that fails.
    #[cfg(any(test, feature = "testing"))]
    pub fn read<T: Pod>(&self, buffer: &Buffer) -> Vec<T> {
        self.fetch(buffer).expect("the device answers")
    }

    fn failed(&self, why: impl Display) -> Error {
        let why = on_one_line(why, 600);
        let problem = format!("the device `{}` failed: {why}", self.name());
        let has = |all: &[&str]| all.iter().any(|word| why.to_lowercase().contains(word));
        if has(&["out of memory", "outofmemory"]) {
            let hint = "close what else uses the device, or give less with `--memory`; then repeat the command: it goes \
                        on from the last checkpoint";
            return Error::not_now(problem, hint);
        }
        if has(&["validation", "compil", "shader", "pipeline", "launch error", "was refused"]) {
            let hint = "use another driver or device (`tiface doctor` tries them), or `--device cpu`; the last checkpoint \
                        is whole";
            return Error::cannot(problem, hint);
        }
        Error::not_now(problem, "repeat the command: it goes on from the last checkpoint")
    }

    /// Counts a launch and returns the client to launch on.
    pub(super) fn launch(&self) -> &Client {
        self.launches.fetch_add(1, Ordering::Relaxed);
        &self.client
    }

    /// Notes where a kernel's first launch was refused: the error of a later read does not always
    /// name the kernel.
    pub(super) fn launched<'h>(&self, kernel: &'static str, buffers: impl FnOnce() -> Vec<&'h Handle>) {
        let mut kernels = self.kernels.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if kernels.insert(kernel)
            && let Err(e) = self.client.check(buffers())
        {
            note(format!(
                "the launch of `{}` was refused: {e:?}",
                kernel.trim_start_matches("tiface_kernels::gpu::")
            ));
        }
    }

    /// Returns the number of launches and readbacks so far.
    pub fn counts(&self) -> (usize, usize) {
        (self.launches.load(Ordering::Relaxed), self.readbacks.load(Ordering::Relaxed))
    }
}

/// Returns a text on one line, cut after so many characters.
fn on_one_line(text: impl Display, limit: usize) -> String {
    let text = text.to_string();
    let words: Vec<&str> = text.split_whitespace().collect();
    words.join(" ").chars().take(limit).collect()
}

/// Launches a kernel and counts it:
/// `launch!(device, kernel::launch, groups, threads; buffers; scalars)`, with the threads of one
/// group. Unsafe with `kernel::launch_unchecked`. Something else than a buffer takes its place if
/// it has the methods `arg` and `handles` of [`Words`]: several buffers that kernels take as a
/// struct.
macro_rules! launch {
    ($device:expr, $launch:expr, $groups:expr, $threads:expr; $($buffer:expr),+ $(; $($scalar:expr),+)?) => {{
        let device = &$device;
        $launch(
            device.launch(),
            $groups,
            burn::cubecl::prelude::CubeDim::new_1d($threads),
            $($buffer.arg(),)+
            $($($scalar,)+)?
        );
        device.launched(concat!(module_path!(), "::", stringify!($launch)), || {
            [$(&$buffer.handles()[..]),+].concat()
        });
    }};
}
pub(super) use launch;

/// Number of workgroups in one dimension that every adapter can launch.
pub(super) const MAX_GROUPS: u32 = 65_535;

/// Returns the launch size for `count` workgroups, in two dimensions beyond 65,535. Kernels use
/// their absolute position and ignore the excess.
pub(super) fn groups(count: usize) -> CubeCount {
    let rows = count.div_ceil(MAX_GROUPS as usize).max(1);
    CubeCount::Static(count.div_ceil(rows) as u32, rows as u32, 1)
}

#[cfg(test)]
mod tests {
    use super::super::testing::{alone, device};
    use super::*;
    use burn::cubecl::{self, prelude::*};

    #[test]
    fn what_is_copied_there_comes_back() {
        let Some(device) = device() else { return };
        let uploaded = device.upload(&[1.5f32, -2.0, 3.0]);
        assert_eq!(device.read::<f32>(&uploaded), [1.5, -2.0, 3.0]);
        assert_eq!(device.read::<u32>(&device.zeros::<u32>(5)), [0; 5]);
        assert_eq!(device.counts(), (0, 2));
        println!("{} adds floats: {:?}", device.name(), device.atomics());
    }

    #[test]
    fn what_a_driver_refuses_is_an_error_and_nothing_read_after_it_is_trusted() {
        if device().is_some() {
            for test in [
                "a_launch_of_too_many_groups",
                "a_buffer_larger_than_memory",
                "a_kernel_that_does_not_compile",
                "a_group_of_too_many_threads",
                "a_device_that_is_lost",
            ] {
                alone(&format!("gpu::device::tests::{test}"));
            }
        }
    }

    #[cube(launch)]
    fn set(out: &mut [f32]) {
        if ABSOLUTE_POS < out.len() {
            out[ABSOLUTE_POS] = 1.0f32;
        }
    }

    #[test]
    #[ignore = "run by the test above, in a process of its own"]
    fn a_launch_of_too_many_groups() {
        let device = device().unwrap();
        let out = device.zeros::<f32>(64);
        let set = |groups: u32| launch!(device, set::launch, CubeCount::new_1d(groups), 64; out);
        (0..8).for_each(|_| set(1));
        set(70_000);
        (0..8).for_each(|_| set(1));
        let e = device.fetch::<f32>(&out).expect_err("a launch was lost");
        println!("{e}: {}", e.hint());
        assert!(e.kind() as i32 == 1 && e.to_string().contains("65535"), "{e}");
        // what comes after it is done
        set(1);
        assert_eq!(device.fetch::<f32>(&out).unwrap(), [1.0; 64]);
    }

    #[test]
    #[ignore = "run by the test above, in a process of its own"]
    fn a_buffer_larger_than_memory() {
        let device = device().unwrap();
        let pages = std::fs::read_to_string("/proc/self/statm").unwrap();
        let pages: u64 = pages.split(' ').next().unwrap().parse().unwrap();
        let bytes = Some(4096 * pages + (1 << 30));
        let limit = rustix::process::Rlimit { current: bytes, maximum: bytes };
        rustix::process::setrlimit(rustix::process::Resource::As, limit).unwrap();
        let words = device.limits().largest_buffer as usize / 4;
        let all: Vec<Buffer> = (0..64).map(|_| device.scratch::<f32>(words)).collect();
        for out in &all {
            launch!(device, set::launch, CubeCount::new_1d(1), 64; out);
        }
        let e = device.fetch::<f32>(&all[63]).expect_err("64 of the largest buffers do not fit in a GiB");
        println!("{e}: {}", e.hint());
        assert!(e.kind() as i32 == 75 && e.hint().contains("--memory"), "{e}");
    }

    #[cube(launch)]
    fn crowded(out: &mut [f32], #[comptime] words: usize) {
        let mut all = Shared::<[f32]>::new_slice(words);
        all[UNIT_POS as usize] = 1.0f32;
        sync_cube();
        out[ABSOLUTE_POS] = all[words - 1 - UNIT_POS as usize];
    }

    /// A kernel that is refused is an error that names it, and no reason to repeat the command.
    fn is_refused(device: &Device, out: &Buffer, kernel: &str) {
        let e = device.fetch::<f32>(out).expect_err("the kernel cannot run");
        println!("{e}: {}", e.hint());
        assert!(e.kind() as i32 == 1 && e.to_string().to_lowercase().contains(kernel), "{e}");
    }

    #[test]
    #[ignore = "run by the test above, in a process of its own"]
    fn a_kernel_that_does_not_compile() {
        let device = device().unwrap();
        let out = device.zeros::<f32>(64);
        let words = device.limits().shared;
        launch!(device, crowded::launch, CubeCount::new_single(), 64; out; words);
        is_refused(&device, &out, "crowded");
    }

    #[test]
    #[ignore = "run by the test above, in a process of its own"]
    fn a_group_of_too_many_threads() {
        let device = device().unwrap();
        let out = device.zeros::<f32>(64);
        launch!(device, set::launch, CubeCount::new_single(), 1 << 20; out);
        is_refused(&device, &out, "set");
    }

    #[test]
    #[ignore = "run by the test above, in a process of its own"]
    fn a_device_that_is_lost() {
        let adapter = &Adapter::all()[0];
        let CubeDevice::Wgpu(wgpu_device) = &adapter.device else { panic!("not a device of wgpu") };
        let options = RuntimeOptions::try_default().unwrap();
        let setup = try_init_setup::<AutoGraphicsApi>(wgpu_device, options).unwrap();
        let device = Device::open(adapter).unwrap();
        let out = device.zeros::<f32>(64);
        let set = || launch!(device, set::launch, CubeCount::new_single(), 64; out);
        set();
        assert_eq!(device.fetch::<f32>(&out).unwrap(), [1.0; 64]);
        setup.device.destroy();
        // nothing is trusted from then on
        for _ in 0..3 {
            set();
            let e = device.fetch::<f32>(&out).expect_err("the device is lost");
            println!("{e}: {}", e.hint());
            assert!(e.kind() as i32 == 75 && e.hint().contains("repeat"), "{e}");
        }
    }

    #[test]
    fn buffers_take_what_they_are_asked_for() {
        if device().is_some() {
            alone("gpu::device::tests::memory_of_buffers");
        }
    }

    #[test]
    #[ignore = "run by the test above, in a process of its own"]
    fn memory_of_buffers() {
        let device = device().unwrap();
        const MIB: usize = 1 << 18;
        let before = device.reserved_memory();
        let sizes = std::iter::once(30).chain([7; 20]).chain([1; 8]);
        let all: Vec<Buffer> = sizes.map(|mib| device.zeros::<f32>(mib * MIB)).collect();
        device.read::<f32>(&all[all.len() - 1]);
        let requested: usize = all.iter().map(|buffer| 4 * buffer.word_count()).sum();
        let taken = device.reserved_memory() - before;
        println!("{requested} bytes of buffers take {taken}");
        assert!(taken as f64 <= 1.05 * requested as f64, "{taken} of {requested}");
    }

    #[test]
    fn an_adapter_that_cannot_be_opened_is_an_error_each_time() {
        let absent = Adapter::absent("a card that fell out");
        for _ in 0..2 {
            let e = Device::open(&absent).err().unwrap();
            println!("{e}: {}", e.hint());
            assert!(
                e.kind() as i32 == 1 && e.to_string().contains("`a card that fell out` cannot be opened"),
                "{e}"
            );
        }
    }

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

    #[test]
    fn a_user_gives_a_device_more_memory_than_its_driver_states() {
        let Some(device) = device() else { return };
        let device = device.with_memory(1 << 20);
        assert_eq!(device.available_memory(), 0);
        assert_eq!(device.with_memory(1 << 50).available_memory(), (1 << 50) - (512 << 20));
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

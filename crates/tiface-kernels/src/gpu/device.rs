//! GPU devices: memory, kernel launches and readbacks.

use super::adapter::Adapter;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Cube, CubeDevice};
use burn::cubecl::bytes::Bytes;
use burn::cubecl::features::AtomicUsage;
use burn::cubecl::ir::{ElemType, FloatKind, Type};
use burn::cubecl::prelude::{BufferArg, Client, CubeCount};
use burn::cubecl::server::Handle;
use burn::cubecl::wgpu::WgpuInitError;
use burn::tensor::{DType, Element};
use bytemuck::Pod;
use std::collections::BTreeSet;
use std::fmt::Display;
use std::ops::Range;
use std::panic::{self, AssertUnwindSafe};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, Once};
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
mod tests;

//! The GPUs of this machine: which are there, which is chosen, and whether it can be trusted.
//!
//! A device is used by one training at a time: it has a lock, a file in the folder for temporary files. Before `auto`
//! takes a device it compares its kernels with the processor's, once for each adapter and program: what was
//! found is kept in the user's cache.

use crate::config::DeviceChoice;
use crate::io::{self, Limits, Lock, LockError};
use crate::kernel::gpu::{self, Adapter, Check, Device};
use crate::{Error, Result};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError, Weak};

/// A device that was opened for a training.
pub struct Gpu {
    /// It.
    pub device: Device,
    /// Why it was chosen.
    pub why: String,
    /// Nobody else's `auto` takes it while this is held; none where somebody else had it already.
    pub lock: Option<Arc<Lock>>,
    /// Did nobody name it?
    pub auto_selected: bool,
}

/// Opens the GPU that is named: an API (`wgpu` is any) and a number among its adapters. Without a number it is the
/// first one that is no software.
///
/// # Errors
///
/// Where there is none.
pub fn open(choice: &DeviceChoice) -> Result<Gpu> {
    let (api, number) = (choice.name.as_str(), choice.number);
    let name = number.map_or(api.to_string(), |number| format!("{api}:{number}"));
    let adapters: Vec<&Adapter> = Adapter::all().iter().filter(|a| a.api == api || api == "wgpu").collect();
    let chosen: Vec<&Adapter> = match number {
        Some(number) => adapters.get(number).copied().into_iter().collect(),
        None => adapters.iter().copied().filter(|adapter| !adapter.software).collect(),
    };
    let mut in_use = Vec::new();
    for adapter in chosen {
        let device = opened(adapter, choice);
        let lock = taken(lock_file(&device));
        // whoever names one by its number shares it
        if number.is_none() && matches!(lock, Err(LockError::Held { .. })) {
            in_use.push(device.name().to_string());
            continue;
        }
        return Ok(Gpu { device, why: format!("named `{name}`"), lock: lock.ok(), auto_selected: false });
    }
    if in_use.is_empty() {
        return Err(missing(&name, api, &adapters));
    }
    Err(Error::not_now(
        format!("device `{name}`: {} in use by other processes", in_use.join(", ")),
        format!("wait for them, then repeat the command; a number, as in `{api}:0`, shares one with them"),
    ))
}

/// An adapter, used as it is asked to be.
fn opened(adapter: &Adapter, choice: &DeviceChoice) -> Device {
    let mut device = Device::open(adapter);
    if choice.deterministic {
        device = device.with_atomics(gpu::Atomics::Fixed);
    }
    if let Some(gib) = choice.memory_gib {
        device = device.with_memory((gib * (1u64 << 30) as f64) as u64);
    }
    device
}

fn missing(name: &str, api: &str, adapters: &[&Adapter]) -> Error {
    let problem = match adapters {
        [] => format!("device `{name}`: no adapter is here for `{api}`"),
        [only] if only.software => {
            format!("device `{name}`: the only adapter is software, `{api}:0`, slower than `cpu`")
        }
        _ => format!("device `{name}`: there are {} adapters, numbered from 0", adapters.len()),
    };
    Error::usage(
        problem,
        "install the GPU's driver, or choose another with `--device`; `tiface doctor` lists them",
    )
}

/// Opens the first GPU that is no software, that nobody uses and that passes the self-test; says why not where there is
/// none.
pub fn best(choice: &DeviceChoice) -> std::result::Result<Gpu, String> {
    let mut passed_over = Vec::new();
    for adapter in Adapter::all().iter().filter(|a| !a.software) {
        let device = opened(adapter, choice);
        let name = device.name().to_string();
        let lock = match taken(lock_file(&device)) {
            Ok(lock) => Some(lock),
            Err(LockError::Held { .. }) => {
                passed_over.push(format!("{name} is in use"));
                continue;
            }
            // where no lock can be made nobody else has one either
            Err(LockError::Io { .. }) => None,
        };
        match trusted(&device, adapter) {
            Ok(()) => {
                let why = format!(
                    "the first GPU that is free and computes what the processor does ({})",
                    adapter.api
                );
                return Ok(Gpu { device, why, lock, auto_selected: true });
            }
            Err(why) => passed_over.push(format!("{name} {why}")),
        }
    }
    Err(if passed_over.is_empty() { "no GPU is here".into() } else { passed_over.join(", ") })
}

/// Takes the lock of a device, or shares it where this process has it already: its fields are on the same device.
fn taken(file: PathBuf) -> std::result::Result<Arc<Lock>, LockError> {
    static OURS: Mutex<BTreeMap<PathBuf, Weak<Lock>>> = Mutex::new(BTreeMap::new());
    let mut ours = OURS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(lock) = ours.get(&file).and_then(Weak::upgrade) {
        return Ok(lock);
    }
    let lock = Arc::new(Lock::take(&file)?);
    ours.insert(file, Arc::downgrade(&lock));
    Ok(lock)
}

/// The lock of a device: the same for every API that leads to the same card.
fn lock_file(device: &Device) -> PathBuf {
    let card = device.card().unwrap_or_else(|| device.name().to_string());
    let plain: String = card.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
    std::env::temp_dir().join(format!("tiface-{plain}.lock"))
}

/// The file of what self-tests found, by adapter and program.
fn kept_file() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let base = set("XDG_CACHE_HOME").or_else(|| set("HOME").map(|h| h.join(".cache")))?;
    Some(base.join("tiface/devices.json"))
}

fn trusted(device: &Device, adapter: &Adapter) -> std::result::Result<(), String> {
    // another program may have other kernels
    let built = std::env::current_exe().ok().and_then(|exe| io::modified(&exe));
    let release = env!("CARGO_PKG_VERSION");
    let key = format!("{} | {} | {} | {release} {built:?}", device.name(), device.driver(), adapter.api);
    let file = kept_file();
    // a file that cannot be read is as good as none
    let mut kept: BTreeMap<String, bool> =
        file.as_ref().and_then(|file| io::read_typed(file, &Limits::default()).ok()).unwrap_or_default();
    let passed = match kept.get(&key) {
        Some(&passed) => passed,
        None => {
            let checks = gpu::self_test(device).map_err(|e| e.to_string())?;
            let passed = checks.iter().all(Check::passed);
            kept.insert(key, passed);
            if let (Some(file), Ok(text)) = (file, serde_json::to_vec_pretty(&kept))
                && let Some(folder) = file.parent()
                && io::create_folder(folder).is_ok()
            {
                // tested again next time
                let _ = io::write_atomic(&file, &text);
            }
            passed
        }
    };
    if passed { Ok(()) } else { Err("failed the self-test (`tiface doctor` shows it)".into()) }
}

/// What `tiface doctor` says of a device.
#[derive(Debug, Serialize)]
pub struct Found {
    /// What `--device` calls it.
    pub name: String,
    /// As the adapter names itself.
    pub adapter: String,
    /// `discrete`, `integrated`, `virtual`, `other` or `software`.
    pub kind: &'static str,
    /// The driver and its version.
    pub driver: String,
    /// Where it is plugged in, if it is.
    pub card: Option<String>,
    /// How it adds floats: `native` or `exchange`.
    pub atomics: &'static str,
    /// Bytes of memory; none where the driver does not say.
    pub memory: Option<u64>,
    /// Bytes of the largest buffer.
    pub largest_buffer: u64,
    /// Bytes of memory that a group of threads shares.
    pub shared: usize,
    /// Does another training use it?
    pub in_use: bool,
    /// Kernels against the processor's.
    pub checks: Vec<Checked>,
    /// Why that could not be done.
    pub error: Option<String>,
    /// Seconds the self-test took, with the time the driver took to compile.
    pub seconds: f64,
}

/// A kernel of the self-test.
#[derive(Debug, Serialize)]
pub struct Checked {
    /// Which.
    pub kernel: &'static str,
    /// Largest error, relative; not a number where the device computed none.
    pub error: f32,
    /// What it may be.
    pub allowed: f32,
    /// Is it as near as it has to be?
    pub passed: bool,
}

/// Looks at every adapter of this machine, software ones too, and tests it.
pub fn examine() -> Vec<Found> {
    let all = Adapter::all();
    let number = |i: usize| all[..i].iter().filter(|a| a.api == all[i].api).count();
    (0..all.len()).map(|i| examined(&all[i], number(i))).collect()
}

fn examined(adapter: &Adapter, number: usize) -> Found {
    let device = Device::open(adapter);
    let limits = device.limits();
    let in_use = matches!(Lock::take(&lock_file(&device)), Err(LockError::Held { .. }));
    let began = std::time::Instant::now();
    let tested = gpu::self_test(&device);
    let seconds = began.elapsed().as_secs_f64();
    let error = tested.as_ref().err().map(|e| e.to_string());
    let checked =
        |c: Check| Checked { kernel: c.name, error: c.error, allowed: c.allowed, passed: c.passed() };
    Found {
        name: format!("{}:{number}", adapter.api),
        adapter: device.name().into(),
        kind: adapter.kind,
        driver: device.driver().into(),
        card: device.card(),
        atomics: match device.atomics() {
            gpu::Atomics::Native => "native",
            _ => "exchange",
        },
        memory: limits.memory,
        largest_buffer: limits.largest_buffer,
        shared: limits.shared,
        in_use,
        checks: tested.unwrap_or_default().into_iter().map(checked).collect(),
        error,
        seconds,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(word: &str) -> DeviceChoice {
        DeviceChoice::parse(word).unwrap()
    }

    #[test]
    fn a_device_that_is_not_there_is_refused_with_what_is() {
        for name in ["wgpu:99", "vulkan:99", "metal:99"] {
            let e = open(&named(name)).err().unwrap();
            assert!(e.to_string().contains(name) && e.hint().contains("tiface doctor"), "{e}");
            assert_eq!(e.kind(), crate::ErrorKind::Usage);
        }
        let all = Adapter::all();
        if all.iter().all(|a| a.software) {
            // software is taken only where it is named, with its number
            let e = open(&named("wgpu")).err().unwrap();
            assert!(e.to_string().contains(if all.is_empty() { "no adapter" } else { "software" }), "{e}");
            assert_eq!(best(&named("auto")).err().unwrap(), "no GPU is here");
        }
    }

    #[test]
    fn a_device_is_held_while_it_is_used() {
        if Adapter::all().is_empty() {
            println!("skipped: locks of devices, for no adapter is here");
            return;
        }
        let held = open(&named("wgpu:0")).unwrap();
        let again = open(&named("wgpu:0")).unwrap();
        // one process has one lock, however many fields it has there; another process has none
        let file = lock_file(&held.device);
        assert!(held.lock.is_some() && again.lock.is_some());
        assert!(matches!(Lock::take(&file), Err(LockError::Held { .. })));
        // used as it is asked to be
        let asked = open(&named("wgpu:0+deterministic+0.5GiB")).unwrap().device;
        assert_eq!((asked.atomics(), asked.limits().memory), (gpu::Atomics::Fixed, Some(1 << 29)));
    }
}

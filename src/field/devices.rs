//! The GPUs of this machine: which are there, which is chosen, and whether it can be trusted.
//!
//! A device is used by one training at a time: it has a lock, a file in the folder for temporary files. Before `auto`
//! takes a device it compares a training step there with the processor's, once for each adapter, driver, program and
//! field: the verdict is kept in the user's cache.

use super::SelfTest;
use crate::config::DeviceChoice;
use crate::io::{self, Limits, Lock, LockError};
use crate::kernel::gpu::{self, Adapter, Device};
use crate::{Error, Result};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
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

/// Opens the first GPU that is no software, that nobody uses and that passes the tests; says why not where there is none.
pub fn best(choice: &DeviceChoice, tests: &[SelfTest]) -> std::result::Result<Gpu, String> {
    let file = kept_file();
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
        match tests.iter().try_for_each(|test| trusted(&device, adapter, test, file.as_deref())) {
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

/// What was computed of a step, and how far it was from the processor.
#[derive(Debug, Serialize)]
pub struct Check {
    /// Which field, and what of it.
    pub name: String,
    /// Error, relative; not a number where the device computed none.
    pub error: f32,
    /// What it may be.
    pub allowed: f32,
    /// Is it as near as it has to be?
    pub passed: bool,
}

impl Check {
    /// Returns the verdict on an error.
    pub fn new(name: String, error: f32, allowed: f32) -> Check {
        Check { name, error, allowed, passed: error <= allowed }
    }
}

/// What verdicts are kept under: another adapter, driver, API or program is tested afresh.
fn verdict_key(device: &Device, adapter: &Adapter, test: &SelfTest) -> String {
    let built = std::env::current_exe().ok().and_then(|exe| io::modified(&exe));
    let release = env!("CARGO_PKG_VERSION");
    let (name, driver) = (device.name(), device.driver());
    format!("{name} | {driver} | {} | {release} {built:?} | {}", adapter.api, test.field)
}

/// Returns the verdict that is kept in a file.
fn kept_verdict(file: Option<&Path>, key: &str) -> Option<bool> {
    // a file that cannot be read is as good as none
    let kept: BTreeMap<String, bool> = io::read_typed(file?, &Limits::default()).ok()?;
    kept.get(key).copied()
}

/// Keeps a verdict. Where that fails the device is tested again next time.
fn keep_verdict(file: Option<&Path>, key: String, passed: bool) {
    let Some(file) = file else { return };
    let mut kept: BTreeMap<String, bool> = io::read_typed(file, &Limits::default()).unwrap_or_default();
    kept.insert(key, passed);
    if let (Ok(text), Some(folder)) = (serde_json::to_vec_pretty(&kept), file.parent())
        && io::create_folder(folder).is_ok()
    {
        let _ = io::write_atomic(file, &text);
    }
}

/// Tests a device, whatever is known of it, and keeps the verdict.
fn tested(device: &Device, adapter: &Adapter, test: &SelfTest, file: Option<&Path>) -> Result<Vec<Check>> {
    let checks = (test.run)(adapter)?;
    keep_verdict(file, verdict_key(device, adapter, test), checks.iter().all(|check| check.passed));
    Ok(checks)
}

/// Refuses a device that fails a test, which is made where no verdict is kept.
fn trusted(
    device: &Device,
    adapter: &Adapter,
    test: &SelfTest,
    file: Option<&Path>,
) -> std::result::Result<(), String> {
    let passed = match kept_verdict(file, &verdict_key(device, adapter, test)) {
        Some(passed) => passed,
        None => {
            let checks = tested(device, adapter, test, file).map_err(|e| e.to_string())?;
            checks.iter().all(|check| check.passed)
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
    /// Training steps against the processor's.
    pub checks: Vec<Check>,
    /// Why that could not be done.
    pub error: Option<String>,
    /// Seconds the self-test took, with the time the driver took to compile.
    pub seconds: f64,
}

/// Looks at every adapter of this machine, software ones too, and tests it.
pub fn examine(tests: &[SelfTest]) -> Vec<Found> {
    let all = Adapter::all();
    let number = |i: usize| all[..i].iter().filter(|a| a.api == all[i].api).count();
    (0..all.len()).map(|i| examined(&all[i], number(i), tests)).collect()
}

fn examined(adapter: &Adapter, number: usize, tests: &[SelfTest]) -> Found {
    let device = Device::open(adapter);
    let limits = device.limits();
    let in_use = matches!(Lock::take(&lock_file(&device)), Err(LockError::Held { .. }));
    let began = std::time::Instant::now();
    let file = kept_file();
    let all: Result<Vec<Vec<Check>>> =
        tests.iter().map(|test| tested(&device, adapter, test, file.as_deref())).collect();
    let seconds = began.elapsed().as_secs_f64();
    let error = all.as_ref().err().map(|e| e.to_string());
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
        checks: all.unwrap_or_default().into_iter().flatten().collect(),
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
            assert_eq!(best(&named("auto"), &[]).err().unwrap(), "no GPU is here");
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

    /// The program of the tests counts how often a device is tested.
    #[test]
    fn a_verdict_is_kept_until_driver_or_program_change() {
        use std::sync::atomic::{AtomicUsize, Ordering};
        static TESTS: AtomicUsize = AtomicUsize::new(0);
        let Some(adapter) = Adapter::all().first() else { return };
        let test = SelfTest {
            field: "counted",
            run: |_| {
                let passed = TESTS.fetch_add(1, Ordering::SeqCst) == 0;
                Ok(vec![Check::new(String::new(), if passed { 0.0 } else { f32::NAN }, 1.0)])
            },
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("cache/devices.json");
        let device = Device::open(adapter);
        let began = std::time::Instant::now();
        for _ in 0..3 {
            assert!(trusted(&device, adapter, &test, Some(&file)).is_ok());
        }
        assert!(TESTS.load(Ordering::SeqCst) == 1 && began.elapsed().as_secs_f64() < 2.0);
        // another field, or a driver or program that the key names otherwise
        let key = verdict_key(&device, adapter, &test);
        assert!(key.contains(device.driver()) && key.contains(env!("CARGO_PKG_VERSION")));
        assert_eq!(kept_verdict(Some(&file), &key), Some(true));
        assert_eq!(kept_verdict(Some(&file), &key.replace(device.driver(), "a newer one")), None);
        std::fs::write(&file, key.replace(device.driver(), "an older one")).unwrap();
        for _ in 0..2 {
            assert!(trusted(&device, adapter, &test, Some(&file)).unwrap_err().contains("self-test"));
        }
        // failed, and that is kept, too
        assert_eq!(TESTS.load(Ordering::SeqCst), 2);
        assert_ne!(key, verdict_key(&device, adapter, &SelfTest { field: "other", ..test }));
    }
}

//! The GPUs of this machine: enumeration, selection and self-tests.
//!
//! One training uses a device at a time, which a lock file in the temporary folder enforces. Before
//! `auto` selects a device, it compares a training step on the device with the CPU's. The verdict
//! is stored in the user's cache, so the test runs once for each adapter, driver, program and
//! field.

use super::device_report::{Check, DeviceReport, NO_GPU, SelfTest};
use crate::config::DeviceChoice;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use tiface_base::io::{self, Limits, Lock, LockError};
use tiface_base::{Error, Result};
use tiface_kernels::gpu::{self, Adapter, Device};

/// A device opened for a training.
pub struct Gpu {
    /// The opened device.
    pub device: Device,
    /// The reason for choosing the device.
    pub why: String,
    /// Lock that keeps other processes' `auto` from selecting the device; `None` if another process
    /// held it already.
    pub lock: Option<Arc<Lock>>,
    /// Whether `auto` selected the device, rather than the user naming it.
    pub auto_selected: bool,
}

/// Opens the named GPU: an API (`wgpu` stands for any) and an index among its adapters. Without an
/// index, opens the first free adapter that is not a software renderer.
///
/// # Errors
///
/// If no adapter matches, or all matching ones are in use.
pub fn open(choice: &DeviceChoice) -> Result<Gpu> {
    open_locked(choice, &lock_folder())
}

/// Opens the named GPU, with its lock file in a folder.
fn open_locked(choice: &DeviceChoice, locks: &Path) -> Result<Gpu> {
    let (api, number) = (choice.name.as_str(), choice.number);
    let name = number.map_or(api.to_string(), |number| format!("{api}:{number}"));
    let adapters: Vec<&Adapter> = Adapter::all().iter().filter(|a| a.api == api || api == "wgpu").collect();
    let chosen: Vec<&Adapter> = match number {
        Some(number) => adapters.get(number).copied().into_iter().collect(),
        None => adapters.iter().copied().filter(|adapter| !adapter.software).collect(),
    };
    let (mut in_use, mut failure) = (Vec::new(), None);
    for adapter in chosen {
        match take(adapter, choice, locks) {
            Ok((device, lock)) => {
                return Ok(Gpu { device, why: format!("named `{name}`"), lock, auto_selected: false });
            }
            Err(Refusal::InUse) => in_use.push(adapter.name.clone()),
            Err(Refusal::Failed(e)) => failure = failure.or(Some(e)),
        }
    }
    if !in_use.is_empty() {
        return Err(Error::not_now(
            format!("device `{name}`: {} in use by other processes", in_use.join(", ")),
            format!(
                "wait for them, then repeat the command; a number, as in `{api}:0`, shares one with them"
            ),
        ));
    }
    Err(failure.unwrap_or_else(|| no_such_adapter(&name, api, &adapters)))
}

/// Why an adapter was not taken.
enum Refusal {
    InUse,
    Failed(Error),
}

/// Locks an adapter and opens it, with the atomics and the memory of the choice. The lock comes
/// first: a process holds memory on every card that it opens, for as long as it lives.
fn take(
    adapter: &Adapter,
    choice: &DeviceChoice,
    locks: &Path,
) -> std::result::Result<(Device, Option<Arc<Lock>>), Refusal> {
    let lock = match acquire_lock(lock_file(locks, adapter)) {
        Ok(lock) => Some(lock),
        Err(LockError::Held { .. }) if choice.number.is_none() => return Err(Refusal::InUse),
        // A user who gives an adapter's index accepts sharing it with other processes. If no lock
        // file can be created here, no other process holds one either.
        Err(_) => None,
    };
    let mut device = Device::open(adapter).map_err(Refusal::Failed)?;
    if choice.deterministic {
        device = device.with_atomics(gpu::Atomics::Fixed);
    }
    if let Some(gib) = choice.memory_gib {
        device = device.with_memory((gib * (1u64 << 30) as f64) as u64);
    }
    Ok((device, lock))
}

fn no_such_adapter(name: &str, api: &str, adapters: &[&Adapter]) -> Error {
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

/// Opens the first GPU that is not a software renderer, is not in use and passes the tests.
/// Otherwise returns why each adapter was rejected.
pub fn best(choice: &DeviceChoice, tests: &[SelfTest]) -> std::result::Result<Gpu, String> {
    best_of(Adapter::all().iter().filter(|a| !a.software), choice, tests, &lock_folder())
}

fn best_of<'a>(
    adapters: impl Iterator<Item = &'a Adapter>,
    choice: &DeviceChoice,
    tests: &[SelfTest],
    locks: &Path,
) -> std::result::Result<Gpu, String> {
    let file = verdict_file();
    let mut rejected = Vec::new();
    for adapter in adapters {
        let (device, lock) = match take(adapter, choice, locks) {
            Ok(taken) => taken,
            Err(Refusal::InUse) => {
                rejected.push(format!("{} is in use", adapter.name));
                continue;
            }
            Err(Refusal::Failed(e)) => {
                rejected.push(e.to_string());
                continue;
            }
        };
        match tests.iter().try_for_each(|test| require_passed(&device, adapter, test, file.as_deref())) {
            Ok(()) => {
                let why =
                    format!("the first GPU that is free and computes what the CPU does ({})", adapter.api);
                return Ok(Gpu { device, why, lock, auto_selected: true });
            }
            Err(why) => rejected.push(format!("{} {why}", adapter.name)),
        }
    }
    Err(if rejected.is_empty() { NO_GPU.into() } else { rejected.join(", ") })
}

/// Acquires the lock of a device, or shares it if this process holds it already: all fields of a
/// process use the same device.
fn acquire_lock(file: PathBuf) -> std::result::Result<Arc<Lock>, LockError> {
    static HELD: Mutex<BTreeMap<PathBuf, Weak<Lock>>> = Mutex::new(BTreeMap::new());
    let mut held_locks = HELD.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(lock) = held_locks.get(&file).and_then(Weak::upgrade) {
        return Ok(lock);
    }
    let lock = Arc::new(Lock::take(&file)?);
    held_locks.insert(file, Arc::downgrade(&lock));
    Ok(lock)
}

/// Returns the folder of the lock files, in which all processes of this machine look.
fn lock_folder() -> PathBuf {
    std::env::temp_dir()
}

/// Returns the lock file of an adapter, which is the same for every API that reaches the same card.
fn lock_file(folder: &Path, adapter: &Adapter) -> PathBuf {
    let card = adapter.card.as_ref().unwrap_or(&adapter.name);
    let file_name: String = card.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
    folder.join(format!("tiface-{file_name}.lock"))
}

/// Returns the cache file of self-test verdicts.
fn verdict_file() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let base = set("XDG_CACHE_HOME").or_else(|| set("HOME").map(|h| h.join(".cache")))?;
    Some(base.join("tiface/devices.json"))
}

/// Returns the cache key of a verdict. It names adapter, driver, API, program and field, so that a
/// change of any of them runs the test again.
fn verdict_key(device: &Device, adapter: &Adapter, test: &SelfTest) -> String {
    let built = std::env::current_exe().ok().and_then(|exe| io::modified(&exe));
    let release = env!("CARGO_PKG_VERSION");
    let (name, driver) = (device.name(), device.driver());
    format!("{name} | {driver} | {} | {release} {built:?} | {}", adapter.api, test.field)
}

/// Returns the verdict stored in the cache file, if any.
fn cached_verdict(file: Option<&Path>, key: &str) -> Option<bool> {
    // An unreadable cache counts as empty.
    let verdicts: BTreeMap<String, bool> = io::read_typed(file?, &Limits::default()).ok()?;
    verdicts.get(key).copied()
}

/// Stores a verdict in the cache file. If that fails, the device is tested again next time.
fn cache_verdict(file: Option<&Path>, key: String, passed: bool) {
    let Some(file) = file else { return };
    let mut verdicts: BTreeMap<String, bool> = io::read_typed(file, &Limits::default()).unwrap_or_default();
    verdicts.insert(key, passed);
    if let (Ok(text), Some(folder)) = (serde_json::to_vec_pretty(&verdicts), file.parent())
        && io::create_folder(folder).is_ok()
    {
        let _ = io::write_atomic(file, &text);
    }
}

/// Tests a device, ignoring the cache, and stores the verdict.
fn run_self_test(
    device: &Device,
    adapter: &Adapter,
    test: &SelfTest,
    file: Option<&Path>,
) -> Result<Vec<Check>> {
    let checks = (test.run)(adapter)?;
    cache_verdict(file, verdict_key(device, adapter, test), checks.iter().all(|check| check.passed));
    Ok(checks)
}

/// Refuses a device that fails a test. The test runs only if the cache holds no verdict.
fn require_passed(
    device: &Device,
    adapter: &Adapter,
    test: &SelfTest,
    file: Option<&Path>,
) -> std::result::Result<(), String> {
    let passed = match cached_verdict(file, &verdict_key(device, adapter, test)) {
        Some(passed) => passed,
        None => {
            let checks = run_self_test(device, adapter, test, file).map_err(|e| e.to_string())?;
            checks.iter().all(|check| check.passed)
        }
    };
    if passed { Ok(()) } else { Err("failed the self-test (`tiface doctor` shows it)".into()) }
}

/// Tests every adapter of this machine, including software renderers.
pub fn examine_adapters(tests: &[SelfTest]) -> Vec<DeviceReport> {
    let all = Adapter::all();
    let number = |i: usize| all[..i].iter().filter(|a| a.api == all[i].api).count();
    (0..all.len()).map(|i| examine_adapter(&all[i], number(i), tests)).collect()
}

fn examine_adapter(adapter: &Adapter, number: usize, tests: &[SelfTest]) -> DeviceReport {
    let in_use = matches!(Lock::take(&lock_file(&lock_folder(), adapter)), Err(LockError::Held { .. }));
    let mut found = DeviceReport {
        name: format!("{}:{number}", adapter.api),
        adapter: adapter.name.clone(),
        kind: adapter.kind,
        driver: adapter.driver.clone(),
        card: adapter.card.clone(),
        atomics: None,
        memory: adapter.memory,
        largest_buffer: None,
        shared: None,
        in_use,
        checks: Vec::new(),
        error: None,
        seconds: 0.0,
    };
    let began = std::time::Instant::now();
    let device = match Device::open(adapter) {
        Ok(device) => device,
        Err(e) => return DeviceReport { error: Some(e.to_string()), ..found },
    };
    let limits = device.limits();
    found.driver = device.driver().into();
    found.atomics = Some(match device.atomics() {
        gpu::Atomics::Native => "native",
        _ => "exchange",
    });
    found.memory = limits.memory;
    (found.largest_buffer, found.shared) = (Some(limits.largest_buffer), Some(limits.shared));
    let file = verdict_file();
    let all: Result<Vec<Vec<Check>>> =
        tests.iter().map(|test| run_self_test(&device, adapter, test, file.as_deref())).collect();
    found.seconds = began.elapsed().as_secs_f64();
    match all {
        Ok(checks) => found.checks = checks.into_iter().flatten().collect(),
        Err(e) => found.error = Some(e.to_string()),
    }
    found
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
            assert_eq!(e.kind(), tiface_base::ErrorKind::Usage);
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
        // a folder of its own, for other processes of this machine may hold the device
        let folder = tempfile::tempdir().unwrap();
        let open = |word: &str| open_locked(&named(word), folder.path()).unwrap();
        let (held, again) = (open("wgpu:0"), open("wgpu:0"));
        // All fields of a process share one lock, which another process cannot take.
        let file = lock_file(folder.path(), &Adapter::all()[0]);
        assert!(held.lock.is_some() && again.lock.is_some());
        assert!(matches!(Lock::take(&file), Err(LockError::Held { .. })));
        // The options of the choice apply to the opened device.
        let asked = open("wgpu:0+deterministic+0.5GiB").device;
        assert_eq!((asked.atomics(), asked.limits().memory), (gpu::Atomics::Fixed, Some(1 << 29)));
    }

    /// Returns an adapter that cannot be opened, as no other test or process has.
    fn absent(what: &str) -> Adapter {
        Adapter::absent(&format!("{what} of process {}", std::process::id()))
    }

    #[test]
    fn auto_goes_on_with_the_cpu_where_an_adapter_cannot_be_opened_and_says_why() {
        let absent = absent("a card without memory");
        let locks = tempfile::tempdir().unwrap();
        let why = best_of([&absent].into_iter(), &named("auto"), &[], locks.path()).err().unwrap();
        assert!(why.contains(&absent.name) && why.contains("cannot be opened"), "{why}");
        // nor does it end the examination
        let found = examine_adapter(&absent, 3, &[]);
        assert_eq!((found.name.as_str(), found.in_use, found.checks.len()), ("vulkan:3", false, 0));
        assert!(found.error.unwrap().contains("cannot be opened"));
    }

    #[test]
    fn a_card_that_another_process_uses_is_not_even_opened() {
        let absent = absent("a card in use");
        let locks = tempfile::tempdir().unwrap();
        let lock = Lock::take(&lock_file(locks.path(), &absent)).unwrap();
        let why = best_of([&absent].into_iter(), &named("auto"), &[], locks.path()).err().unwrap();
        assert_eq!(why, format!("{} is in use", absent.name));
        let take = |word: &str| take(&absent, &named(word), locks.path());
        assert!(matches!(take("wgpu"), Err(Refusal::InUse)));
        // a number shares it
        assert!(matches!(take("wgpu:0"), Err(Refusal::Failed(_))));
        drop(lock);
        assert!(matches!(take("wgpu"), Err(Refusal::Failed(_))));
    }

    #[test]
    fn one_card_has_one_lock_for_all_apis() {
        let file = |name: &str, address: Option<&str>| {
            let mut adapter = Adapter::absent(name);
            adapter.card = address.map(str::to_owned);
            lock_file(Path::new("locks"), &adapter)
        };
        assert_eq!(file("a card", Some("0000:01:00.0")), file("the card", Some("0000:01:00.0")));
        assert_ne!(file("a card", Some("0000:01:00.0")), file("a card", Some("0000:02:00.0")));
        assert_eq!(file("a card", None), file("a card", None));
    }

    /// The test function counts how often it runs.
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
        let device = Device::open(adapter).unwrap();
        for _ in 0..3 {
            assert!(require_passed(&device, adapter, &test, Some(&file)).is_ok());
        }
        assert_eq!(TESTS.load(Ordering::SeqCst), 1);
        // The key contains driver and program, so another driver has no verdict.
        let key = verdict_key(&device, adapter, &test);
        assert!(key.contains(device.driver()) && key.contains(env!("CARGO_PKG_VERSION")));
        assert_eq!(cached_verdict(Some(&file), &key), Some(true));
        assert_eq!(cached_verdict(Some(&file), &key.replace(device.driver(), "a newer one")), None);
        std::fs::write(&file, key.replace(device.driver(), "an older one")).unwrap();
        for _ in 0..2 {
            assert!(require_passed(&device, adapter, &test, Some(&file)).unwrap_err().contains("self-test"));
        }
        // The failure is cached too, so the test ran only once more.
        assert_eq!(TESTS.load(Ordering::SeqCst), 2);
        assert_ne!(key, verdict_key(&device, adapter, &SelfTest { field: "other", ..test }));
    }
}

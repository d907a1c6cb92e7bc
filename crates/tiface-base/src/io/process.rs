//! Cost of this process, its CPU, and whether other processes run, as far as the system reports it.

use std::path::Path;
use std::sync::OnceLock;

/// Returns the seconds of all threads of this process, user and system; those by the clock where
/// the system does not say.
pub fn cpu_seconds() -> f64 {
    #[cfg(unix)]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
    }
    #[cfg(not(unix))]
    {
        use std::time::Instant;
        static START: std::sync::LazyLock<Instant> = std::sync::LazyLock::new(Instant::now);
        START.elapsed().as_secs_f64()
    }
}

/// Returns the peak memory of this process since [`forget_peak_memory`], bytes; `None` where the
/// system does not say.
pub fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok().map(|kib| kib << 10)
}

/// Resets [`peak_memory`], if the system can.
pub fn forget_peak_memory() {
    // 5: the peak becomes what is held now (proc_pid_clear_refs(5))
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// How the program's allocator gives its free memory back.
static COLLECT: OnceLock<fn()> = OnceLock::new();

/// Sets the function that gives the free memory of the program's allocator back to the system; only
/// the first counts.
pub fn set_memory_collector(collect: fn()) {
    let _ = COLLECT.set(collect);
}

/// Gives free memory back to the system, if the program has said how. Allocators keep it for long
/// otherwise, and a stage would be charged for the memory of the one before.
pub fn give_memory_back() {
    if let Some(collect) = COLLECT.get() {
        collect();
    }
}

/// Returns whether a process of this machine runs and has a file open. Where the system shows no
/// open files (such as of another user's process), whether it runs.
pub fn has_open(pid: u32, file: &Path) -> bool {
    let files = std::fs::read_dir(format!("/proc/{pid}/fd")).ok();
    match (files, file.canonicalize()) {
        (Some(files), Ok(file)) => {
            files.flatten().any(|f| std::fs::read_link(f.path()).is_ok_and(|to| to == file))
        }
        _ => is_running(pid),
    }
}

/// Returns whether a process of this machine has ended: another one, or an earlier one of this
/// one's number.
pub fn has_ended(pid: u32) -> bool {
    pid == std::process::id() || !is_running(pid)
}

#[cfg(unix)]
fn is_running(pid: u32) -> bool {
    use rustix::process::{Pid, test_kill_process};
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
    // a process of another user refuses the signal, so it runs
    pid.is_some_and(|pid| test_kill_process(pid).err().is_none_or(|e| e == rustix::io::Errno::PERM))
}

#[cfg(not(unix))]
fn is_running(_: u32) -> bool {
    true
}

/// Returns the CPU's name as the system reports it; empty if unknown.
pub fn processor() -> String {
    let all = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let line = all.lines().find_map(|l| l.strip_prefix("model name"));
    line.map_or(String::new(), |l| l.trim_start_matches([' ', '\t', ':']).to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    #[test]
    fn the_allocator_is_asked_for_its_free_memory() {
        use std::sync::atomic::{AtomicUsize, Ordering};
        static ASKED: AtomicUsize = AtomicUsize::new(0);
        give_memory_back(); // without an allocator that can
        set_memory_collector(|| {
            ASKED.fetch_add(1, Ordering::Relaxed);
        });
        give_memory_back();
        assert!(ASKED.load(Ordering::Relaxed) > 0);
    }

    #[test]
    fn work_costs_cpu_time_and_memory_shows_as_a_peak() {
        let before = cpu_seconds();
        let start = Instant::now();
        while start.elapsed().as_millis() < 30 {
            std::hint::black_box((0..1000).sum::<u64>());
        }
        assert!(cpu_seconds() > before);
        if let Some(before) = peak_memory() {
            let held = vec![1u8; 256 << 20];
            std::hint::black_box(&held);
            assert!(peak_memory().unwrap() >= before.max(256 << 20));
        }
    }
}

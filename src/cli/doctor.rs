//! `tiface doctor`: devices and features of this machine and build, for the choice of a device and
//! for bug reports.

use super::options::Common;
use super::screen::print;
use crate::field::{DeviceReport, examine_devices};
use serde::Serialize;
use std::fmt::{self, Display};
use tiface_base::{Error, ErrorKind, Result, io};

/// A machine's devices and features.
#[derive(Serialize)]
struct Examination {
    version: &'static str,
    features: Vec<&'static str>,
    system: String,
    processor: String,
    threads: usize,
    devices: Vec<DeviceReport>,
    /// The device that `--device auto` selects.
    auto: String,
}

pub(super) fn run(common: &Common) -> Result<()> {
    let features = [("wgpu", cfg!(feature = "wgpu")), ("matting", cfg!(feature = "matting"))];
    let tests = [crate::iface::SDF_TEST, crate::tface::VM_TEST, crate::iface::DENSITY_TEST];
    let (devices, auto) = examine_devices(&tests)?;
    let auto = match cfg!(feature = "wgpu") {
        true => auto.description(),
        false => "the CPU: this build has no GPU support (`--features wgpu`)".into(),
    };
    let found = Examination {
        version: env!("CARGO_PKG_VERSION"),
        features: features.into_iter().filter(|(_, is_on)| *is_on).map(|(name, _)| name).collect(),
        system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
        processor: io::processor(),
        threads: rayon::current_num_threads(),
        devices,
        auto,
    };
    let text = match common.json {
        true => serde_json::to_string(&found).unwrap_or_default(),
        false => found.to_string(),
    };
    print(&format!("{text}\n"))?;
    if found.is_sound() { Ok(()) } else { Err(Error::already_printed(ErrorKind::Cannot)) }
}

impl Examination {
    /// Returns whether every device passed its self-test against the CPU.
    fn is_sound(&self) -> bool {
        self.devices.iter().all(|d| d.error.is_none() && d.checks.iter().all(|c| c.passed))
    }
}

impl Display for Examination {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "tiface {} ({}), {}", self.version, self.features.join(", "), self.system)?;
        writeln!(f, "cpu           {}, {} threads", self.processor, self.threads)?;
        for d in &self.devices {
            let gib = |bytes: u64| format!("{:.1} GiB", bytes as f64 / (1u64 << 30) as f64);
            let memory = d.memory.map_or("unknown".into(), gib);
            let used = if d.in_use { ", in use" } else { "" };
            writeln!(f, "{:<13} {}, {}{used}", d.name, d.adapter, d.kind)?;
            writeln!(f, "  driver      {}", d.driver)?;
            if let Some(card) = &d.card {
                writeln!(f, "  card        {card}")?;
            }
            write!(f, "  memory      {memory}")?;
            if let (Some(buffer), Some(shared)) = (d.largest_buffer, d.shared) {
                write!(f, "; buffers up to {}; {} KiB a group", gib(buffer), shared / 1024)?;
            }
            writeln!(f)?;
            if let Some(atomics) = d.atomics {
                writeln!(f, "  atomic adds {atomics}")?;
            }
            match &d.error {
                Some(error) => writeln!(f, "  self-test   FAILED: {error}")?,
                None => {
                    let failed = d.checks.iter().filter(|c| !c.passed).count();
                    let verdict = if failed == 0 { "passed".into() } else { format!("FAILED ({failed})") };
                    writeln!(f, "  self-test   {verdict} in {:.1} s; errors and their limits:", d.seconds)?;
                }
            }
            for c in &d.checks {
                let mark = if c.passed { "" } else { "  <- WRONG" };
                writeln!(f, "    {:<48} {:.1e} of {:.0e}{mark}", c.name, c.error, c.allowed)?;
            }
        }
        write!(f, "--device auto is {}", self.auto)
    }
}

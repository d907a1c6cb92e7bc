//! `tiface doctor`: what this machine and this build can do, to choose a device and to paste into a bug report.

use super::options::Common;
use super::stdout::print;
use crate::{Error, ErrorKind, Result, io};
use serde::Serialize;
use std::fmt::{self, Display};

/// What is said of a machine.
#[derive(Serialize)]
struct Examination {
    version: &'static str,
    features: Vec<&'static str>,
    system: String,
    processor: String,
    threads: usize,
    #[cfg(feature = "wgpu")]
    devices: Vec<crate::field::devices::Found>,
    /// What `--device auto` takes.
    auto: String,
}

pub(super) fn run(common: &Common) -> Result<()> {
    let features = [("wgpu", cfg!(feature = "wgpu")), ("matting", cfg!(feature = "matting"))];
    #[cfg(feature = "wgpu")]
    let (devices, auto) = {
        use crate::field::devices::{best, examine};
        let tests = [crate::iface::SDF_TEST, crate::tface::VM_TEST, crate::iface::DENSITY_TEST];
        let devices = examine(&tests);
        let choice = crate::config::DeviceChoice::parse("auto").expect("a device's name");
        let auto = match best(&choice, &tests) {
            Ok(gpu) => format!("{}: {}", gpu.device.name(), gpu.why),
            Err(why) => format!("the processor: {why}"),
        };
        (devices, auto)
    };
    #[cfg(not(feature = "wgpu"))]
    let auto = "the processor: this build knows no GPU (`--features wgpu`)".to_string();
    let found = Examination {
        version: env!("CARGO_PKG_VERSION"),
        features: features.into_iter().filter(|(_, there)| *there).map(|(name, _)| name).collect(),
        system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
        processor: io::processor(),
        threads: rayon::current_num_threads(),
        #[cfg(feature = "wgpu")]
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
    /// Does every device that is here compute what the processor does?
    fn is_sound(&self) -> bool {
        #[cfg(feature = "wgpu")]
        return self.devices.iter().all(|d| d.error.is_none() && d.checks.iter().all(|c| c.passed));
        #[cfg(not(feature = "wgpu"))]
        true
    }
}

impl Display for Examination {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "tiface {} ({}), {}", self.version, self.features.join(", "), self.system)?;
        writeln!(f, "cpu           {}, {} threads", self.processor, self.threads)?;
        #[cfg(feature = "wgpu")]
        for d in &self.devices {
            let gib = |bytes: u64| format!("{:.1} GiB", bytes as f64 / (1u64 << 30) as f64);
            let memory = d.memory.map_or("unknown".into(), gib);
            let used = if d.in_use { ", in use" } else { "" };
            writeln!(f, "{:<13} {}, {}{used}", d.name, d.adapter, d.kind)?;
            writeln!(f, "  driver      {}", d.driver)?;
            if let Some(card) = &d.card {
                writeln!(f, "  card        {card}")?;
            }
            let buffer = gib(d.largest_buffer);
            writeln!(f, "  memory      {memory}; buffers up to {buffer}; {} KiB a group", d.shared / 1024)?;
            writeln!(f, "  atomic adds {}", d.atomics)?;
            match &d.error {
                Some(error) => writeln!(f, "  self-test   FAILED: {error}")?,
                None => {
                    let failed = d.checks.iter().filter(|c| !c.passed).count();
                    let verdict = if failed == 0 { "passed".into() } else { format!("FAILED ({failed})") };
                    writeln!(
                        f,
                        "  self-test   {verdict} in {:.1} s; errors, and what they may be:",
                        d.seconds
                    )?;
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

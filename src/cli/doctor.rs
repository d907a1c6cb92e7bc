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
    let features = [
        ("cpu", cfg!(feature = "cpu")),
        ("wgpu", cfg!(feature = "wgpu")),
        ("cuda", cfg!(feature = "cuda")),
        ("matting", cfg!(feature = "matting")),
    ];
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

/// Refuses a prediction that this build cannot make.
#[cfg(not(feature = "wgpu"))]
pub(super) fn model(_: &Common) -> Result<()> {
    Err(Error::usage("`--model`: this build knows no GPU", "build with `--features wgpu`"))
}

/// What steps of both fields as they are configured would take on GPUs by their data sheets.
#[cfg(feature = "wgpu")]
pub(super) fn model(common: &Common) -> Result<()> {
    use crate::kernel::gpu::cost::{self, GPUS, GpuSheet, KernelCost};
    /// Samples of a ray of T-Face whose density is looked up, and that get color: estimates for a head.
    const LOOKED_UP: f64 = 100.0;
    const COLORED: f64 = 10.0;
    let config = common.resolve(None, None, &[])?;
    let (iface, tface) = (&config.iface, &config.tface);
    let shape = crate::iface::field_shape(iface);
    let memory = cost::memory(&shape, 4 * iface.samples);
    let side = (tface.voxels_final as f64).cbrt();
    let channels: usize = tface.density_rank.iter().chain(&tface.color_rank).sum();
    let floats = channels as f64 * side * (side + 1.0);
    let rays = tface.rays as f64;
    let steps = [
        (
            format!("A step of I-Face, {} samples", iface.samples),
            cost::step_cost(&shape, iface.samples, iface.max_rays),
        ),
        (
            format!("A step of T-Face, {} rays, its last grid", tface.rays),
            cost::vm_step_cost(floats, LOOKED_UP * rays, COLORED * rays),
        ),
    ];
    let on = |gpu: &GpuSheet, kernels: &[KernelCost]| -> Vec<f64> {
        kernels.iter().map(|kernel| cost::predict(kernel, gpu)).collect()
    };
    if common.json {
        let rows = |(name, kernels): &(String, Vec<KernelCost>)| {
            let seconds: Vec<_> =
                GPUS.iter().map(|gpu| serde_json::json!({"gpu": gpu, "seconds": on(gpu, kernels)})).collect();
            serde_json::json!({"step": name, "kernels": kernels, "predicted": seconds})
        };
        let all = serde_json::json!({"steps": steps.each_ref().map(rows), "iface_memory": memory});
        return print(&format!("{all}\n"));
    }
    let mut text = "A prediction from data sheets: nothing here was measured.\n".to_string();
    for (name, kernels) in &steps {
        text += &format!("\n{name:<42} {:>8} {:>8} {:>9}\n", "MB", "GFLOP", "M atomics");
        for k in kernels {
            let [mb, gflop, atomics] = [k.bytes / 1e6, k.flops / 1e9, k.atomics / 1e6];
            text += &format!("  {:<40} {mb:>8.1} {gflop:>8.2} {atomics:>9.1}\n", k.name);
        }
        text += &format!("{:<42} {:>8}  slowest\n", "", "ms");
        for gpu in &GPUS {
            let seconds = on(gpu, kernels);
            let all: f64 = seconds.iter().sum();
            let slowest = (0..kernels.len()).max_by(|&a, &b| seconds[a].total_cmp(&seconds[b])).unwrap_or(0);
            text += &format!("  {:<40} {:>8.2}  {}\n", gpu.name, 1e3 * all, kernels[slowest].name);
        }
    }
    let gib = memory / (1u64 << 30) as f64;
    text += &format!(
        "\nI-Face's memory: {gib:.2} GiB, room for four times the samples; photographs come on top.\n"
    );
    print(&text)
}

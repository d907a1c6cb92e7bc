//! The choice of a device, as a word.

/// Names of devices.
const DEVICES: [&str; 6] = ["auto", "cpu", "wgpu", "vulkan", "metal", "dx12"];

/// A device, and how it is to be used.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceChoice {
    /// `auto`, `cpu`, `wgpu` (Vulkan, Metal or DX12), `vulkan`, `metal` or `dx12`.
    pub name: String,
    /// Which of its adapters, from 0.
    pub number: Option<usize>,
    /// Whether GPU sums are accumulated in fixed point, bitwise reproducible; on the CPU they
    /// always are.
    pub deterministic: bool,
    /// Memory that a training may use, GiB; `None`: all of it.
    pub memory_gib: Option<f64>,
}

impl DeviceChoice {
    /// Returns the choice of a word; none where it is no such word.
    pub fn parse(word: &str) -> Option<DeviceChoice> {
        let mut parts = word.split('+');
        let device = parts.next()?;
        let (name, number) = match device.split_once(':') {
            Some((name, number)) => (name, Some(number.parse().ok()?)),
            None => (device, None),
        };
        if !DEVICES.contains(&name) || (number.is_some() && ["auto", "cpu"].contains(&name)) {
            return None;
        }
        let mut choice = DeviceChoice { name: name.into(), number, deterministic: false, memory_gib: None };
        for part in parts {
            match part.strip_suffix("GiB") {
                Some(gib) => {
                    let gib = gib.parse().ok().filter(|gib: &f64| gib.is_finite() && *gib > 0.0);
                    choice.memory_gib = Some(gib?);
                }
                None if part == "deterministic" => choice.deterministic = true,
                None => return None,
            }
        }
        Some(choice)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_taken_apart_and_others_are_none() {
        let parsed = |word| DeviceChoice::parse(word);
        let plain = parsed("auto").unwrap();
        assert_eq!((plain.name.as_str(), plain.number, plain.deterministic), ("auto", None, false));
        let all = parsed("vulkan:3+deterministic+7.5GiB").unwrap();
        let want = DeviceChoice {
            name: "vulkan".into(),
            number: Some(3),
            deterministic: true,
            memory_gib: Some(7.5),
        };
        assert_eq!(all, want);
        assert_eq!(parsed("dx12:1").unwrap().number, Some(1));
        for wrong in [
            "",
            "gpu",
            "cpu:0",
            "auto:1",
            "wgpu:",
            "wgpu:-1",
            "wgpu+",
            "wgpu+fast",
            "wgpu+0GiB",
            "wgpu+NaNGiB",
            "cuda",
        ] {
            assert_eq!(parsed(wrong), None, "{wrong}");
        }
    }
}

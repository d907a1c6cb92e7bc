//! Any network from a picture to its alpha, with a file of the user: U²-Net (Qin et al. 2020),
//! ISNet (Qin et al. 2022), MODNet (Ke et al. 2022), BiRefNet (Zheng et al. 2024) and what is
//! shaped like them.
//!
//! They take one picture, squeezed into a square, and give its alpha; further outputs are of their
//! training. How colors become numbers is not in the file: the user says it, or
//! `preprocessor_config.json` beside it, or the file's name. What is not within 0..1 are logits.

use super::processor::{self, IMAGENET, Normal};
use super::sam::resized;
use crate::onnx::{NetworkArray, NetworkSession, Role, file_error};
use std::path::Path;
use tiface_base::image::{Gray, Photo, bilinear, quantize};
use tiface_base::{Error, Result};

const ISNET: Normal = Normal { mean: [0.5; 3], std: [1.0; 3] };
const MODNET: Normal = Normal { mean: [0.5; 3], std: [0.5; 3] };

/// Words in file names, lower case, the first match counts: side of the square, colors. As the
/// publishers' own scripts have it.
const KNOWN: [(&str, usize, Normal); 8] = [
    ("u2net", 320, IMAGENET),
    ("silueta", 320, IMAGENET),
    ("modnet", 512, MODNET),
    ("birefnet", 1024, IMAGENET),
    ("rmbg-2", 1024, IMAGENET),
    ("rmbg", 1024, ISNET),
    ("isnet", 1024, ISNET),
    ("ormbg", 1024, ISNET),
];

/// A network from a picture to its alpha.
pub(super) struct AlphaNet {
    pub(super) session: NetworkSession,
    /// Width and height of the network's input.
    pub(super) size: (usize, usize),
    normal: Normal,
}

impl AlphaNet {
    /// Opens the file; `input` is `auto` or `SIDE,MEAN,SCALE`.
    pub(super) fn open(path: &Path, array_bytes: u64, input: &str) -> Result<AlphaNet> {
        let mut session = NetworkSession::open(Role::ALPHA, path, array_bytes)?;
        let name = path.file_name().map(|n| n.to_string_lossy().to_lowercase()).unwrap_or_default();
        let (side, normal) = if input != "auto" {
            parse(input)?
        } else if let Some(beside) = processor::find(path, "")? {
            (beside.side.unwrap_or(1024), beside.normal)
        } else if let Some((_, side, normal)) = KNOWN.iter().find(|(known, ..)| name.contains(known)) {
            (*side, *normal)
        } else {
            let names: Vec<&str> = KNOWN.iter().map(|k| k.0).collect();
            return Err(file_error(
                path,
                "does not say what it is shown",
                format!(
                    "say it: `--set mask.alpha_input=1024,0.5,1` (side, mean, scale), or name the file after its \
                     network: {}",
                    names.join(", ")
                ),
            ));
        };
        let port = session.inputs[0].name.clone();
        let extent = |axis: usize| session.input_extent(&port, axis).unwrap_or(side);
        let size = (extent(3), extent(2));
        session.file.contract +=
            &format!(", shown {} × {}, mean {:?}, scale {:?}", size.0, size.1, normal.mean, normal.std);
        Ok(AlphaNet { session, size, normal })
    }

    /// Returns the alpha of a photograph, at `size`.
    pub(super) fn alpha(&self, photo: &Photo, size: (u32, u32)) -> Result<Gray> {
        let (w, h) = self.size;
        let planes = self.normal.planes(&resized(photo, w, h), w, (w, h), 3);
        let input = NetworkArray::new(&[1, 3, h, w], planes);
        let given = self.session.run(&[(&self.session.inputs[0].name, input)])?;
        let (width, height) = self.session.one_picture(&given[0])?;
        // half precision overshoots 0 and 1 a little; logits of a head and what is around it, by
        // far
        let logits = given[0].values.iter().any(|v| !(-0.5..=1.5).contains(v));
        let coded = |v: f32| quantize(if logits { 1.0 / (1.0 + (-v).exp()) } else { v });
        let from = (width as u32, height as u32);
        let values = bilinear(&given[0].values, from.0, from, size, coded);
        Ok(Gray { width: size.0, height: size.1, values })
    }
}

/// `SIDE,MEAN,SCALE`: pixels of the square, and what is taken from colors in 0..1 before they are
/// divided.
fn parse(input: &str) -> Result<(usize, Normal)> {
    let parts: Vec<&str> = input.split(',').map(str::trim).collect();
    let read = match parts[..] {
        [side, mean, scale] => (|| {
            let (side, mean, scale) = (side.parse().ok()?, mean.parse().ok()?, scale.parse().ok()?);
            Some((side, Normal { mean: [mean; 3], std: [scale; 3] }))
        })(),
        [side, "imagenet"] => side.parse().ok().map(|side| (side, IMAGENET)),
        _ => None,
    };
    read.filter(|(side, normal): &(usize, Normal)| {
        let [mean, scale] = [normal.mean[0], normal.std[0]];
        (32..=4096).contains(side) && (0.0..=1.0).contains(&mean) && (1e-3..=2.0).contains(&scale)
    })
    .ok_or_else(|| {
        Error::usage(
            format!("`mask.alpha_input` is `{input}`"),
            "write auto, SIDE,MEAN,SCALE as 1024,0.5,1, or SIDE,imagenet",
        )
    })
}

#[cfg(test)]
mod tests {
    use crate::config::MaskConfig;
    use crate::mask::networks::Networks;
    use crate::onnx::tests::{config, made};
    use std::fs;
    use tiface_base::image::Photo;

    #[test]
    fn an_alpha_network_sees_a_square_and_its_logits_become_an_alpha() {
        let dir = tempfile::tempdir().unwrap();
        // left half 204, right half 51: 0.8 and 0.2
        let rgb = (0..64 * 48).map(|i| if i % 64 < 32 { [204; 3] } else { [51; 3] }).collect();
        let photo = Photo { width: 64, height: 48, rgb, alpha: None };
        // (c − 0.5) / 0.5 is 0.6 and −0.6
        for (weight, bias, left, right) in [
            (0.5, 0.5, 204, 51),
            // logits 6 and −6: 1 / (1 + e⁻⁶) is 0.9975, of 255
            (10.0, 0.0, 254, 1),
        ] {
            let path = dir.path().join("net.onnx");
            fs::write(&path, made::brightness(32, weight, bias)).unwrap();
            let config = MaskConfig {
                alpha_net: path.to_str().unwrap().into(),
                alpha_input: "512,0.5,0.5".into(), // but the file has a side of its own
                ..config()
            };
            let networks = Networks::open(&config).unwrap().expect("a file is named");
            assert!(networks.files()[0].contract.contains("shown 32 × 32"), "{}", networks.files()[0]);
            networks.prepare(64, 48).unwrap();
            let alpha = networks.propose(&photo, (64, 48)).unwrap().unwrap();
            for (i, &v) in alpha.values.iter().enumerate() {
                match i % 64 {
                    ..29 => assert_eq!(v, left, "{i}"),
                    35.. => assert_eq!(v, right, "{i}"),
                    _ => {}
                }
            }
        }
    }

    #[test]
    fn what_an_alpha_network_is_shown_is_said_by_key_file_or_name() {
        let dir = tempfile::tempdir().unwrap();
        let open = |name: &str, input: &str| {
            let path = dir.path().join(name);
            fs::write(&path, made::brightness(0, 1.0, 0.0)).unwrap();
            let named = MaskConfig {
                alpha_net: path.to_str().unwrap().into(),
                alpha_input: input.into(),
                ..config()
            };
            Networks::open(&named).map(|n| n.unwrap().files()[0].contract.clone())
        };
        assert!(
            open("U2Net_human.onnx", "auto").unwrap().contains("shown 320 × 320, mean [0.485, 0.456, 0.406]")
        );
        assert!(
            open("isnet.onnx", "auto")
                .unwrap()
                .contains("1024 × 1024, mean [0.5, 0.5, 0.5], scale [1.0, 1.0, 1.0]")
        );
        assert!(open("isnet.onnx", "64,imagenet").unwrap().contains("64 × 64, mean [0.485, 0.456, 0.406]"));
        let error = open("x.onnx", "auto").unwrap_err();
        assert!(error.to_string().contains("does not say what it is shown"), "{error}");
        assert!(
            error.hint().contains("mask.alpha_input") && error.hint().contains("u2net"),
            "{}",
            error.hint()
        );
        for wrong in ["64", "64,2,1", "8,0,1", "64,0,0", "64,half", "64,NaN,1"] {
            let said = open("isnet.onnx", wrong).unwrap_err().to_string();
            assert!(said.contains(wrong), "{wrong}: {said}");
        }
        fs::write(
            dir.path().join("preprocessor_config.json"),
            r#"{"image_processor_type": "ViTFeatureExtractor", "image_mean": [0.5, 0.5, 0.5], "size": {"width": 96, "height": 96}}"#,
        )
        .unwrap();
        assert!(
            open("x.onnx", "auto").unwrap().contains("shown 96 × 96, mean [0.5, 0.5, 0.5], scale [0.229")
        );
    }
}

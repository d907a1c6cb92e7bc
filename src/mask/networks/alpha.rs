//! Networks that give an alpha, with a file of the user.
//!
//! Any network from a picture to its alpha: U²-Net (Qin et al. 2020), ISNet (Qin et al. 2022),
//! MODNet (Ke et al. 2022), BiRefNet (Zheng et al. 2024) and what is shaped like them.
//!
//! They take one picture, squeezed into a square, and give its alpha; further outputs are of their
//! training. How colors become numbers is not in the file: the user says it, or
//! `preprocessor_config.json` beside it, or the file's name. What is not within 0..1 are logits.
//!
//! ViTMatte goes from a trimap to a soft alpha (Yao et al. 2024). It sees four channels, color and
//! trimap, at a multiple of 32 pixels. Two conventions exist:
//!
//! | | colors | unknown |
//! | --- | --- | --- |
//! | original code | ImageNet's mean and deviation | exactly 0.5 |
//! | transformers | 0.5 and 0.5 (or as its file says) | 128 / 255 |
//!
//! The file `preprocessor_config.json` beside the network means the second; without it, the first.

use super::processor::{self, IMAGENET, Normal};
use super::sam::resized;
use crate::config::VitmatteColors;
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

/// The picture is padded to a multiple of this: 16 pixels a token, halved once more in the detail
/// head.
const STEP: usize = 32;

/// A ViTMatte network.
pub(super) struct VitMatte {
    pub(super) session: NetworkSession,
    normal: Normal,
    /// Whether the input is the thirds of the original code, instead of the trimap divided by 255.
    thirds: bool,
}

impl VitMatte {
    /// Opens the file; `colors` may override the configuration file beside it.
    pub(super) fn open(path: &Path, array_bytes: u64, colors: VitmatteColors) -> Result<VitMatte> {
        let mut session = NetworkSession::open(Role::VITMATTE, path, array_bytes)?;
        let half = Normal { mean: [0.5; 3], std: [0.5; 3] };
        let normal = match colors {
            VitmatteColors::Imagenet => None,
            VitmatteColors::Half => Some(half),
            VitmatteColors::Auto => processor::find(path, "vitmatte")?.map(|p| p.normal),
        };
        let thirds = normal.is_none();
        let how = if thirds { "as in the original code" } else { "as in transformers" };
        session.file.contract += &format!(", colors {how}");
        Ok(VitMatte { session, normal: normal.unwrap_or(IMAGENET), thirds })
    }

    /// Width and height with padding: the multiple of 32 that holds the photograph, or what the
    /// file fixes.
    pub(super) fn padded(&self, width: usize, height: usize) -> Result<(usize, usize)> {
        let fit = |old: usize, axis: usize| match self.session.input_extent("pixel_values", axis) {
            None => Some(old.next_multiple_of(STEP)),
            Some(fixed) => (fixed >= old && fixed % STEP == 0).then_some(fixed),
        };
        match (fit(width, 3), fit(height, 2)) {
            (Some(w), Some(h)) => Ok((w, h)),
            _ => {
                let (file, shape) =
                    (self.session.file.path.display(), self.session.inputs[0].shape_in_words());
                Err(Error::cannot(
                    format!("the photograph has {width} × {height} pixels, but `{file}` takes only {shape}"),
                    "use the network's file that leaves width and height open",
                ))
            }
        }
    }

    /// Returns the colors and trimap as the network takes them: `[1, 4, h, w]`, zeros right and
    /// below.
    pub(super) fn pixels(&self, photo: &Photo, trimap: &Gray, padded: (usize, usize)) -> NetworkArray {
        let (w, h) = padded;
        let width = photo.width as usize;
        let mut values = self.normal.planes(&photo.rgb, width, padded, 4);
        for (i, &t) in trimap.values.iter().enumerate() {
            let at = i / width * w + i % width;
            values[3 * w * h + at] = match t {
                t if !self.thirds => f32::from(t) / 255.0,
                // a trimap may come from anywhere
                0..85 => 0.0,
                85..170 => 0.5,
                _ => 1.0,
            };
        }
        NetworkArray::new(&[1, 4, h, w], values)
    }

    /// Alpha in 0..=1 of each pixel, `[height · width]`, as the network says it: no cutting near 0
    /// and 1.
    pub(super) fn alpha(&self, photo: &Photo, trimap: &Gray) -> Result<Vec<f32>> {
        let (width, height) = (photo.width as usize, photo.height as usize);
        let (w, h) = self.padded(width, height)?;
        let pixels = self.pixels(photo, trimap, (w, h));
        let given = self.session.run(&[("pixel_values", pixels)])?;
        let alphas = &given[0];
        self.session.expect(0, alphas, &[Some(1), Some(1), Some(h), Some(w)])?;
        if let Some(v) = alphas.values.iter().find(|v| !(-0.01..=1.01).contains(*v)) {
            return Err(self.session.unusable("alphas", format!("it holds {v}, expected 0 to 1")));
        }
        let rows = alphas.values.chunks_exact(w).take(height);
        Ok(rows.flat_map(|row| row[..width].iter().map(|v| v.clamp(0.0, 1.0))).collect())
    }
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

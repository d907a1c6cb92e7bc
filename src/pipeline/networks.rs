//! SAM and ViTMatte for the stage `mask`, where this build has them.

use crate::config::MaskConfig;
#[cfg(feature = "matting")]
use crate::config::VitmatteColors;
use crate::image::{Gray, Photo};
use crate::io;
use crate::mask::Click;
use crate::mask::matting::SoftenOptions;
#[cfg(feature = "matting")]
use crate::mask::networks::{self, MaskNetworkError, VitMatteColours};
use crate::run::Fingerprint;
use crate::{Error, Result};
use serde_json::Value;
use std::path::Path;

/// The networks that the configuration names; without any, nothing is loaded.
pub(super) struct Networks {
    #[cfg(feature = "matting")]
    of: Option<networks::Networks>,
}

#[cfg(feature = "matting")]
fn failure(e: MaskNetworkError) -> Error {
    let hint = e.hint();
    Error::cannot(e, hint)
}

impl Networks {
    /// Digest of a network's file.
    pub fn digest(path: &Path) -> Result<String> {
        let limits = io::Limits { file_bytes: 2 << 30, ..io::Limits::default() };
        Ok(Fingerprint::of_bytes(&io::read_bytes(path, &limits)?))
    }

    /// Opens what is named. An error in a build without networks.
    #[cfg(not(feature = "matting"))]
    pub fn open(config: &MaskConfig) -> Result<Networks> {
        if super::clicks::files(config).is_empty() {
            return Ok(Networks {});
        }
        Err(Error::cannot(
            "this build cannot run networks, but SAM or ViTMatte is named",
            "build with `--features matting`, or leave the files out: clicks work without them",
        ))
    }

    /// Opens what is named.
    #[cfg(feature = "matting")]
    pub fn open(config: &MaskConfig) -> Result<Networks> {
        let named = super::clicks::files(config);
        if named.is_empty() {
            return Ok(Networks { of: None });
        }
        let path = |key: &str| named.iter().find(|(k, _)| *k == key).map(|(_, p)| p.to_path_buf());
        let files = networks::NetworkFiles {
            sam: path("sam"),
            sam_decoder: path("sam_decoder"),
            vitmatte: path("vitmatte"),
            onnxruntime: (!config.onnxruntime.is_empty()).then(|| (&config.onnxruntime).into()),
        };
        let options = networks::NetworkOptions {
            memory_bytes: (config.memory_gib * (1u64 << 30) as f64) as u64,
            colours: match config.vitmatte_colors {
                VitmatteColors::Auto => None,
                VitmatteColors::Imagenet => Some(VitMatteColours::ImageNet),
                VitmatteColors::Half => Some(VitMatteColours::Transformers),
            },
            ..networks::NetworkOptions::default()
        };
        Ok(Networks { of: Some(networks::Networks::open(&files, &options).map_err(failure)?) })
    }

    /// What was loaded, one sentence a file.
    pub fn files(&self) -> Vec<String> {
        #[cfg(feature = "matting")]
        if let Some(of) = &self.of {
            let line = |f: &networks::NetworkFile| {
                let (path, engine) = (f.path.display(), &f.engine);
                format!(
                    "{}: `{path}`, {} bytes, SHA-256 {}, {}; {engine}",
                    f.role, f.bytes, f.sha256, f.contract
                )
            };
            return of.files().iter().map(line).collect();
        }
        Vec::new()
    }

    /// The same for the record of the stage.
    pub fn record(&self) -> Value {
        #[cfg(feature = "matting")]
        if let Some(of) = &self.of {
            return serde_json::to_value(of.files()).unwrap_or(Value::Null);
        }
        Value::Array(Vec::new())
    }

    /// How many photographs of a size may be worked on side by side.
    pub fn at_once(&self, size: (u32, u32), soft: &SoftenOptions, config: &MaskConfig) -> usize {
        let threads = rayon::current_num_threads();
        let memory = (config.memory_gib * (1u64 << 30) as f64) as u64;
        // photograph, alpha and equations
        let bytes = soft.memory_bytes(size.0, size.1) + 8 * u64::from(size.0) * u64::from(size.1);
        // at most a GiB and a half for pictures without networks
        let built_in = (memory.min(3 << 29) / bytes.max(1)).clamp(1, threads as u64) as usize;
        #[cfg(feature = "matting")]
        if let Some(of) = &self.of {
            let (w, h) = crate::mask::scale::working_size(size.0, size.1, soft.side);
            return of.photos_at_once(w, h, memory, threads).min(built_in);
        }
        built_in
    }

    /// Runs the networks once on an empty photograph of a size, so that what cannot be run is refused first.
    #[cfg_attr(not(feature = "matting"), allow(unused_variables))]
    pub fn prepare(&self, (width, height): (u32, u32)) -> Result<()> {
        #[cfg(feature = "matting")]
        if let Some(of) = &self.of {
            of.prepare(width, height).map_err(failure)?;
        }
        Ok(())
    }

    /// Is SAM here?
    pub fn has_sam(&self) -> bool {
        #[cfg(feature = "matting")]
        return self.of.as_ref().is_some_and(|of| of.has_sam());
        #[cfg(not(feature = "matting"))]
        false
    }

    /// Is ViTMatte here?
    pub fn has_vitmatte(&self) -> bool {
        #[cfg(feature = "matting")]
        return self.of.as_ref().is_some_and(|of| of.has_vitmatte());
        #[cfg(not(feature = "matting"))]
        false
    }

    /// SAM's mask of what was clicked, and how good it thinks that is.
    #[cfg_attr(not(feature = "matting"), allow(unused_variables))]
    pub fn segment(&self, photo: &Photo, clicks: &[Click]) -> Result<(Gray, f32)> {
        #[cfg(feature = "matting")]
        if let Some(of) = &self.of {
            return of.segment(photo, clicks).map_err(failure);
        }
        Err(Error::cannot("SAM is not loaded", "name its files: `--sam`, `--sam-decoder`"))
    }

    /// ViTMatte's alpha.
    #[cfg_attr(not(feature = "matting"), allow(unused_variables))]
    pub fn alpha(&self, photo: &Photo, trimap: &Gray) -> Result<Vec<f32>> {
        #[cfg(feature = "matting")]
        if let Some(of) = &self.of {
            return of.alpha(photo, trimap).map_err(failure);
        }
        Err(Error::cannot("ViTMatte is not loaded", "name its file: `--vitmatte`"))
    }
}

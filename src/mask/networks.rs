//! SAM and ViTMatte from files that a user brings (feature `matting`).
//!
//! ```text
//! photograph + clicks ── segment ── hard mask        photograph + trimap ── alpha ── soft alpha
//! ```
//!
//! Files are recognised by their inputs and outputs, looked through before an engine sees them, and recorded
//! with size and SHA-256. Nothing is downloaded, and nothing is read but the files named, the processor
//! file beside a network, and the ONNX Runtime library when one is named.

mod onnx;
mod processor;
mod resample;
mod sam;
mod vitmatte;

pub use self::onnx::MaskNetworkError;
pub use self::vitmatte::VitMatteColours;

use self::onnx::{Contract, Runtime, Session, SessionLimits};
use self::sam::Sam;
use self::vitmatte::VitMatte;
use super::click::Click;
use crate::image::{Gray, Photo};
use std::path::PathBuf;

/// The files a user names.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct NetworkFiles {
    /// SAM's image encoder.
    pub sam: Option<PathBuf>,
    /// SAM's prompt encoder and mask decoder; needed with the encoder.
    pub sam_decoder: Option<PathBuf>,
    /// ViTMatte.
    pub vitmatte: Option<PathBuf>,
    /// The ONNX Runtime library; without it the built-in engine runs the files.
    pub onnxruntime: Option<PathBuf>,
}

/// What may be set about running networks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NetworkOptions {
    /// Bytes of a network's file; a Protocol Buffers message cannot be larger than the default.
    pub file_bytes: u64,
    /// Bytes that the run of one photograph may take, by [`Networks::bytes_per_photo`].
    pub memory_bytes: u64,
    /// Threads of ONNX Runtime inside one run; 0: as many as it likes. The built-in engine uses one.
    pub threads: usize,
    /// How ViTMatte is shown colours, in place of what lies beside its file.
    pub colours: Option<VitMatteColours>,
}

impl Default for NetworkOptions {
    fn default() -> NetworkOptions {
        NetworkOptions { file_bytes: 2 << 30, memory_bytes: 12 << 30, threads: 0, colours: None }
    }
}

/// A file that was loaded, for the record of a run.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct NetworkFile {
    /// "sam", "sam_decoder", "vitmatte" or "onnxruntime": the name of the setting that named it.
    pub role: &'static str,
    /// The file as named.
    pub path: PathBuf,
    /// Its size.
    pub bytes: u64,
    /// Its SHA-256 in hexadecimal.
    pub sha256: String,
    /// What it was recognised as, and how it is fed.
    pub contract: String,
    /// What runs it; of the library, what it says of itself.
    pub engine: String,
}

/// The networks at hand.
pub struct Networks {
    sam: Option<Sam>,
    vitmatte: Option<VitMatte>,
    files: Vec<NetworkFile>,
    memory_bytes: u64,
}

impl Networks {
    /// Opens every file named.
    ///
    /// # Errors
    /// When a file cannot be read, is no sound ONNX file, is refused for what it holds, is of no known form or
    /// of the other network, when encoder and decoder do not fit, or when the engine cannot load it.
    pub fn open(files: &NetworkFiles, options: &NetworkOptions) -> Result<Networks, MaskNetworkError> {
        let runtime = files.onnxruntime.as_deref().map(Runtime::load).transpose()?;
        let runtime = runtime.as_ref();
        let limits = SessionLimits {
            file_bytes: options.file_bytes,
            array_bytes: options.memory_bytes,
            threads: options.threads,
        };
        let sam = match (&files.sam, &files.sam_decoder) {
            (None, None) => None,
            (Some(encoder), Some(decoder)) => Some(Sam::open(encoder, decoder, runtime, &limits)?),
            _ => return Err(missing("SAM's other half", "both of its files")),
        };
        let vitmatte = files
            .vitmatte
            .as_ref()
            .map(|path| VitMatte::open(path, runtime, &limits, options.colours))
            .transpose()?;
        let mut record = Vec::new();
        if let Some(sam) = &sam {
            let side = format!("{} pixels a side", sam.side);
            record.push(recorded("sam", &sam.encoder, &side));
            record.push(recorded("sam_decoder", &sam.decoder, &side));
        }
        if let Some(vitmatte) = &vitmatte {
            let colours = match vitmatte.colours() {
                VitMatteColours::ImageNet => "colours as in the original code",
                VitMatteColours::Transformers => "colours as in transformers",
            };
            record.push(recorded("vitmatte", &vitmatte.session, colours));
        }
        if let Some(runtime) = runtime {
            record.push(NetworkFile {
                role: "onnxruntime",
                path: runtime.path.clone(),
                bytes: runtime.bytes,
                sha256: runtime.sha256.clone(),
                contract: "library".into(),
                engine: runtime.version(),
            });
        }
        Ok(Networks { sam, vitmatte, files: record, memory_bytes: options.memory_bytes })
    }

    /// Is SAM here?
    pub fn has_sam(&self) -> bool {
        self.sam.is_some()
    }

    /// Is ViTMatte here?
    pub fn has_vitmatte(&self) -> bool {
        self.vitmatte.is_some()
    }

    /// What was loaded, in the order of [`NetworkFiles`].
    pub fn files(&self) -> &[NetworkFile] {
        &self.files
    }

    /// Runs the networks once, on an empty photograph of this size, so that a file that cannot be run, or gives what
    /// is no number, is refused before the first photograph. Costs what one photograph does.
    pub fn prepare(&self, width: u32, height: u32) -> Result<(), MaskNetworkError> {
        self.affordable(width, height)?;
        let pixels = width as usize * height as usize;
        let photo = Photo { width, height, rgb: vec![[128; 3]; pixels], alpha: None };
        if self.has_sam() {
            self.segment(&photo, &[Click { x: 0.0, y: 0.0, head: true }])?;
        }
        if self.has_vitmatte() {
            self.alpha(&photo, &Gray { width, height, values: vec![128; pixels] })?;
        }
        Ok(())
    }

    /// SAM's hard mask (0 or 255) of what was clicked, and how good SAM thinks it is (estimated IoU).
    ///
    /// # Errors
    /// Without SAM, without a click on the head, with one outside the photograph or, for a decoder without
    /// labels, on the background; when the network fails or gives what its form does not promise.
    pub fn segment(&self, photo: &Photo, clicks: &[Click]) -> Result<(Gray, f32), MaskNetworkError> {
        let sam = self.sam.as_ref().ok_or_else(|| missing("SAM", "its encoder and decoder"))?;
        sound(photo)?;
        sam.segment(photo, clicks)
    }

    /// ViTMatte's alpha in 0..=1 of each pixel, `[height · width]`, where the trimap (0, 128, 255) is a help
    /// and not a bound: values are as the network gives them.
    pub fn alpha(&self, photo: &Photo, trimap: &Gray) -> Result<Vec<f32>, MaskNetworkError> {
        let vitmatte = self.vitmatte.as_ref().ok_or_else(|| missing("ViTMatte", "its network"))?;
        sound(photo)?;
        if (trimap.width, trimap.height) != (photo.width, photo.height)
            || trimap.values.len() != photo.rgb.len()
        {
            let problem = format!(
                "the photograph has {} × {} pixels, but its trimap {} × {}",
                photo.width, photo.height, trimap.width, trimap.height
            );
            return Err(MaskNetworkError::asked(problem, "make the trimap from this photograph's mask"));
        }
        self.affordable(photo.width, photo.height)?;
        vitmatte.alpha(photo, trimap)
    }

    /// About how much memory one photograph takes at its worst moment, weights included.
    ///
    /// Two measured terms: what grows with the pixels, and attention, which grows with their square: `T²` for
    /// `T` cells of 16 × 16 pixels (SAM ViT-B 2.3 GB at 1024², ViTMatte-S 0.92 GB at 768 × 1024; this says
    /// 3.4 and 1.2). Networks without attention over the whole picture are overestimated.
    pub fn bytes_per_photo(&self, width: u32, height: u32) -> u64 {
        let sam = self.sam.as_ref().map_or(0, |sam| {
            let pixels = (sam.side as u64).pow(2);
            let attention = match sam.encoder.contract {
                // the only such export is MobileSAM, whose attention stays in windows
                Contract::OriginalEncoder { picture: true } => 0,
                _ => 120 * (pixels / 256).pow(2),
            };
            3 * (sam.encoder.bytes + sam.decoder.bytes) + 250 * pixels + attention
        });
        let vitmatte = self.vitmatte.as_ref().map_or(0, |vitmatte| {
            let side = |v: u32| u64::from(v).next_multiple_of(32);
            let pixels = side(width).saturating_mul(side(height));
            let attention = (pixels / 256).saturating_pow(2).saturating_mul(48);
            (3 * vitmatte.session.bytes).saturating_add(500 * pixels).saturating_add(attention)
        });
        sam.max(vitmatte)
    }

    /// How many photographs of this size may be run side by side within `memory_bytes` and `threads`: at
    /// least one. ONNX Runtime takes one at a time and spreads it over the threads itself.
    pub fn photos_at_once(&self, width: u32, height: u32, memory_bytes: u64, threads: usize) -> usize {
        let sessions = self.sam.iter().map(|s| &s.encoder).chain(self.vitmatte.iter().map(|v| &v.session));
        if sessions.into_iter().any(Session::runs_alone) {
            return 1;
        }
        let fit = memory_bytes / self.bytes_per_photo(width, height).max(1);
        usize::try_from(fit).unwrap_or(usize::MAX).min(threads).max(1)
    }

    fn affordable(&self, width: u32, height: u32) -> Result<(), MaskNetworkError> {
        let needs = self.bytes_per_photo(width, height);
        if needs <= self.memory_bytes {
            return Ok(());
        }
        let gib = |bytes: u64| bytes as f64 / f64::from(1u32 << 30);
        let (needs, limit) = (gib(needs), gib(self.memory_bytes));
        Err(MaskNetworkError::asked(
            format!(
                "{width} × {height} pixels need about {needs:.1} GiB in these networks, the limit is {limit:.1}"
            ),
            "make the masks at a longest side of 1024 pixels, or raise the limit",
        ))
    }
}

fn recorded(role: &'static str, session: &Session, how: &str) -> NetworkFile {
    NetworkFile {
        role,
        path: session.path.clone(),
        bytes: session.bytes,
        sha256: session.sha256.clone(),
        contract: format!("{}, {how}", session.contract),
        engine: session.engine().into(),
    }
}

fn missing(what: &'static str, file: &str) -> MaskNetworkError {
    let hint = format!("name {file}; the built-in path needs no file at all");
    MaskNetworkError::asked(format!("no file was given for {what}"), &hint)
}

fn sound(photo: &Photo) -> Result<(), MaskNetworkError> {
    let pixels = u64::from(photo.width) * u64::from(photo.height);
    if pixels == 0 || pixels != photo.rgb.len() as u64 {
        let problem = format!("{} × {} pixels, but {} colours", photo.width, photo.height, photo.rgb.len());
        return Err(MaskNetworkError::asked(problem, "read the photograph again"));
    }
    Ok(())
}

#[cfg(test)]
mod tests;

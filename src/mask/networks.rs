//! SAM, ViTMatte and alpha networks from files that a user brings (feature `matting`).
//!
//! ```text
//! photograph + clicks ── segment ── hard mask
//! photograph + trimap ── alpha ──── soft alpha
//! photograph ─────────── propose ── alpha of the network's foreground
//! ```
//!
//! Files are recognized by their inputs and outputs, looked through before an engine sees them, and
//! recorded with size and SHA-256. Nothing is downloaded, and only the named files and the
//! processor file beside a network are read.

mod alpha;
mod processor;
mod sam;
mod vitmatte;

pub use crate::onnx::NetworkFile;

use self::alpha::AlphaNet;
use self::sam::Sam;
use self::vitmatte::VitMatte;
use super::clicks::Click;
use crate::config::MaskConfig;
use crate::onnx::Contract;
use tiface_base::image::{Gray, Photo};
use tiface_base::{Error, Result};

/// The networks at hand.
pub struct Networks {
    sam: Option<Sam>,
    vitmatte: Option<VitMatte>,
    alpha_net: Option<AlphaNet>,
    files: Vec<NetworkFile>,
    memory_bytes: u64,
}

impl Networks {
    /// Opens every file that the configuration uses; returns `None` where it uses none.
    ///
    /// # Errors
    /// When a file cannot be read, is no valid ONNX file, is refused for its content, is of no
    /// known form or of the other network, when encoder and decoder do not fit, or when the engine
    /// cannot load it.
    pub fn open(config: &MaskConfig) -> Result<Option<Networks>> {
        if !config.with_networks() {
            return Ok(None);
        }
        let memory_bytes = (config.memory_gib * (1u64 << 30) as f64) as u64;
        if config.with_sam() && (config.sam.is_empty() || config.sam_decoder.is_empty()) {
            return Err(Error::cannot(
                "no file was given for SAM's other half",
                "name both of its files; the built-in path needs no file at all",
            ));
        }
        let sam = || Sam::open(config.sam.as_ref(), config.sam_decoder.as_ref(), memory_bytes);
        let sam = config.with_sam().then(sam).transpose()?;
        let vitmatte = || VitMatte::open(config.vitmatte.as_ref(), memory_bytes, config.vitmatte_colors);
        let vitmatte = config.with_vitmatte().then(vitmatte).transpose()?;
        let alpha_net = || AlphaNet::open(config.alpha_net.as_ref(), memory_bytes, &config.alpha_input);
        let alpha_net = config.with_alpha_net().then(alpha_net).transpose()?;
        let networks = sam.iter().flat_map(|sam| [&sam.encoder, &sam.decoder]);
        let networks = networks.chain(vitmatte.iter().map(|v| &v.session));
        let networks = networks.chain(alpha_net.iter().map(|a| &a.session));
        let files = networks.map(|session| session.file.clone()).collect();
        Ok(Some(Networks { sam, vitmatte, alpha_net, files, memory_bytes }))
    }

    /// Returns the loaded files: SAM's encoder and decoder, ViTMatte, the alpha network.
    pub fn files(&self) -> &[NetworkFile] {
        &self.files
    }

    /// Runs the networks once, on an empty photograph of this size, so that a file that cannot be
    /// run, or returns values that are not finite, is refused before the first photograph. Costs as
    /// much as one photograph.
    pub fn prepare(&self, width: u32, height: u32) -> Result<()> {
        self.affordable(width, height)?;
        let pixels = width as usize * height as usize;
        let photo = Photo { width, height, rgb: vec![[128; 3]; pixels], alpha: None };
        self.segment(&photo, &[Click { x: 0.0, y: 0.0, head: true }])?;
        self.alpha(&photo, &Gray { width, height, values: vec![128; pixels] })?;
        self.propose(&photo, (width, height))?;
        Ok(())
    }

    /// Returns the alpha network's alpha of a photograph, at `size`, without clicks; `None` without
    /// such a network.
    ///
    /// # Errors
    /// For a photograph whose size is not that of its colors; when the network fails or gives what
    /// is no picture.
    pub fn propose(&self, photo: &Photo, size: (u32, u32)) -> Result<Option<Gray>> {
        let Some(alpha_net) = &self.alpha_net else { return Ok(None) };
        check_size(photo)?;
        alpha_net.alpha(photo, size).map(Some)
    }

    /// SAM's hard mask (0 or 255) of what was clicked, and how good SAM thinks it is (estimated
    /// IoU); `None` without SAM.
    ///
    /// # Errors
    /// For a photograph whose size is not that of its colors, without a click on the head, with one
    /// outside the photograph or, for a decoder without labels, on the background; when the network
    /// fails or gives what its form does not promise.
    pub fn segment(&self, photo: &Photo, clicks: &[Click]) -> Result<Option<(Gray, f32)>> {
        let Some(sam) = &self.sam else { return Ok(None) };
        check_size(photo)?;
        sam.segment(photo, clicks).map(Some)
    }

    /// ViTMatte's alpha in 0..=1 of each pixel, `[height · width]`, where the trimap (0, 128, 255)
    /// is a help and not a bound: values are as the network gives them. `None` without ViTMatte.
    pub fn alpha(&self, photo: &Photo, trimap: &Gray) -> Result<Option<Vec<f32>>> {
        let Some(vitmatte) = &self.vitmatte else { return Ok(None) };
        check_size(photo)?;
        let (w, h) = (photo.width, photo.height);
        if (trimap.width, trimap.height) != (w, h) || trimap.values.len() != photo.rgb.len() {
            let (tw, th) = (trimap.width, trimap.height);
            return Err(Error::cannot(
                format!("the photograph has {w} × {h} pixels, but its trimap {tw} × {th}"),
                "make the trimap from this photograph's mask",
            ));
        }
        self.affordable(w, h)?;
        vitmatte.alpha(photo, trimap).map(Some)
    }

    /// About how much memory one photograph takes at its worst moment, weights included.
    ///
    /// Two measured terms: what grows with the pixels, and attention, which grows with their
    /// square: `T²` for `T` cells of 16 × 16 pixels (SAM ViT-B 2.3 GB at 1024², ViTMatte-S 0.92 GB
    /// at 768 × 1024; this says 3.4 and 1.2). Networks without attention over the whole picture are
    /// overestimated.
    fn bytes_per_photo(&self, width: u32, height: u32) -> u64 {
        let sam = self.sam.as_ref().map_or(0, |sam| {
            let pixels = (sam.side as u64).pow(2);
            let attention = match sam.encoder.contract {
                // the only such export is MobileSAM, whose attention stays in windows
                Contract::OriginalEncoder { picture: true } => 0,
                _ => 120 * (pixels / 256).pow(2),
            };
            3 * (sam.encoder.file.bytes + sam.decoder.file.bytes) + 250 * pixels + attention
        });
        let vitmatte = self.vitmatte.as_ref().map_or(0, |vitmatte| {
            let side = |v: u32| u64::from(v).next_multiple_of(32);
            let pixels = side(width).saturating_mul(side(height));
            let attention = (pixels / 256).saturating_pow(2).saturating_mul(48);
            (3 * vitmatte.session.file.bytes).saturating_add(500 * pixels).saturating_add(attention)
        });
        let alpha = self.alpha_net.as_ref().map_or(0, |net| {
            let pixels = net.size.0 as u64 * net.size.1 as u64;
            3 * net.session.file.bytes + 1500 * pixels
        });
        sam.max(vitmatte).max(alpha)
    }

    /// Returns how many photographs of this size may be run side by side within the memory and
    /// `threads`: at least one.
    pub fn photos_at_once(&self, width: u32, height: u32, threads: usize) -> usize {
        let fit = self.memory_bytes / self.bytes_per_photo(width, height).max(1);
        usize::try_from(fit).unwrap_or(usize::MAX).min(threads).max(1)
    }

    fn affordable(&self, width: u32, height: u32) -> Result<()> {
        let needs = self.bytes_per_photo(width, height);
        if needs <= self.memory_bytes {
            return Ok(());
        }
        let gib = |bytes: u64| bytes as f64 / f64::from(1u32 << 30);
        let (needs, limit) = (gib(needs), gib(self.memory_bytes));
        Err(Error::cannot(
            format!(
                "{width} × {height} pixels need about {needs:.1} GiB in these networks, the limit is {limit:.1}"
            ),
            "make the masks at a longest side of 1024 pixels, or raise the limit",
        ))
    }
}

/// Checks that a photograph has pixels, and a color for each.
fn check_size(photo: &Photo) -> Result<()> {
    let pixels = u64::from(photo.width) * u64::from(photo.height);
    if pixels == 0 || pixels != photo.rgb.len() as u64 {
        let problem = format!("{} × {} pixels, but {} colors", photo.width, photo.height, photo.rgb.len());
        return Err(Error::cannot(problem, "read the photograph again"));
    }
    Ok(())
}

#[cfg(test)]
mod tests;

//! `[capture]`: what was photographed; `[mask]`: which pixels are the head.

use super::table::table;
use serde::{Deserialize, Serialize};

table! {
    /// How a capture is read.
    pub struct CaptureConfig;
    keys {
        /// Folder of photographs; the run remembers it.
        path: String => String::new();
        /// Photographs are made this many times smaller, by averaging; an integer.
        downscale: u32, 1.0..=64.0 => 1;
        /// Where fields are learned: head (found from cameras and masks), ilsh (published: ±0.45, ±0.501, ±0.3 dataset
        /// units for radiance, ±0.3 for I-Face; head where the head is not there) or six numbers in dataset units,
        /// lowest corner first.
        r#box: String => "head".into(), "head".into(), "ilsh".into();
        /// Metres in one unit of the dataset.
        unit_m: f64, 1e-6..=1e6 => 1.0;
        /// Folder of masks inside the capture, named like the photographs; empty to look for one.
        mask_dir: String => String::new();
        /// Share of the training photographs' pixels that nothing learns from, in small squares, so that the weights
        /// of the blend can be fitted there; 0: none.
        tiles: f64, 0.0..=0.25 => 0.04, 0.04, 0.0;
    }
}

/// Where masks come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskSource {
    /// Clicks or an alpha network, if given; else whatever the capture has: named in its frames, beside the
    /// photographs, or their alpha.
    Auto,
    /// The photographs' own alpha.
    Alpha,
    /// The folder `capture.mask_dir`.
    Folder,
    /// Made from clicks: `mask.prompts` or `mask.point`.
    Clicks,
    /// Made without any: by the network `mask.alpha_net`.
    Network,
    /// None, as is only done when asked for: everything in the picture is reconstructed.
    None,
}

/// What the pixels outside a mask are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskMeaning {
    /// Empty space: nothing of the head is there.
    Empty,
    /// Not looked at, as nerfstudio's `mask_path` means it.
    Ignore,
}

/// How a hard mask comes from clicks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CutMethod {
    /// SAM where its files are named, else GrabCut.
    Auto,
    /// Graph cuts over color mixtures, built in.
    Grabcut,
    /// The network of `mask.sam` and `mask.sam_decoder`.
    Sam,
}

/// How the opacity of the unknown band is found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MattingMethod {
    /// ViTMatte where its file is named, else closed form.
    Auto,
    /// Closed-form matting, built in.
    Closed,
    /// The network of `mask.vitmatte`.
    Vitmatte,
}

/// What ViTMatte is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VitmatteColors {
    /// What lies beside the file says it, else ImageNet's mean and deviation.
    Auto,
    /// ImageNet's mean and deviation, as the original code.
    Imagenet,
    /// 0.5 and 0.5, as transformers' processor.
    Half,
}

table! {
    /// Where masks come from, what they mean, and how they are made from clicks.
    pub struct MaskConfig;
    keys {
        /// Where masks come from: auto (clicks or an alpha network if given, else what the capture has), alpha, folder
        /// (capture.mask_dir), clicks, network or none (go on without: whatever the cameras see is learned).
        source: MaskSource => MaskSource::Auto;
        /// Go on with masks that were found and cannot be right: inverted ones, and those that contradict the others.
        trust: bool => false;
        /// What lies outside a mask: empty (nothing of the head) or ignore (not looked at).
        meaning: MaskMeaning => MaskMeaning::Empty;
        /// Clicks to make masks from: a prompts.json, as `tiface mask --page` saves it.
        prompts: String => String::new();
        /// A list of clicks x,y,label on one photograph (label 1: head, 0: not), for a quick try.
        point: Vec<String> => Vec::new();
        /// The view that `mask.point` is on; empty for the first that is trained on.
        view: String => String::new();
        /// From clicks to a hard mask: auto (sam if its files are named), grabcut (built in) or sam.
        cut: CutMethod => CutMethod::Auto;
        /// From a hard mask to an alpha: auto (vitmatte if its file is named), closed (closed form, built in) or
        /// vitmatte.
        matting: MattingMethod => MattingMethod::Auto;
        /// SAM's image encoder as an ONNX file (needs a build with the feature `matting`).
        sam: String => String::new();
        /// SAM's prompt encoder and mask decoder as an ONNX file.
        sam_decoder: String => String::new();
        /// ViTMatte as an ONNX file (needs a build with the feature `matting`).
        vitmatte: String => String::new();
        /// A network from a picture to its alpha as an ONNX file (U²-Net, ISNet, MODNet, BiRefNet): masks without any
        /// click (needs a build with the feature `matting`).
        alpha_net: String => String::new();
        /// What it is shown: auto (as the file beside it says, else by its name), or SIDE,MEAN,SCALE as 1024,0.5,1, or
        /// SIDE,imagenet.
        alpha_input: String => "auto".into();
        /// The ONNX Runtime library to run networks with; empty for the built-in engine.
        onnxruntime: String => String::new();
        /// What ViTMatte is shown: auto (as the file beside it says, else imagenet), imagenet or half.
        vitmatte_colors: VitmatteColors => VitmatteColors::Auto;
        /// Memory that running networks may take, GiB.
        memory_gib: f64, 0.25..=1024.0 => 12.0;
        /// Longest side that SAM and matting see, pixels.
        side_px: u32, 64.0..=8192.0 => 1024;
        /// Radius of the unknown band to both sides of the outline, share of the height.
        band: f32, 0.0..=0.5 => 0.023;
        /// Side of a square of ones for the band instead, pixels (the paper: 10); 0 for `band`.
        kernel: u32, 0.0..=1000.0 => 0, 0, 10;
        /// How often the square is applied each way (the paper: 5).
        iterations: u32, 0.0..=1000.0 => 5;
    }
}

impl MaskConfig {
    /// Are the masks made, from clicks or by a network?
    pub fn made(&self) -> bool {
        self.clicked() || self.with_alpha_net()
    }

    /// Are the masks made by the alpha network alone?
    pub fn with_alpha_net(&self) -> bool {
        match self.source {
            MaskSource::Network => true,
            MaskSource::Auto => !self.alpha_net.is_empty(),
            _ => false,
        }
    }

    /// Is any network to run?
    pub fn with_networks(&self) -> bool {
        self.with_sam() || self.with_vitmatte() || self.with_alpha_net()
    }

    /// Are the masks made from clicks?
    pub fn clicked(&self) -> bool {
        match self.source {
            MaskSource::Clicks => true,
            MaskSource::Auto => !self.prompts.is_empty() || !self.point.is_empty(),
            _ => false,
        }
    }

    /// Is SAM to cut?
    pub fn with_sam(&self) -> bool {
        match self.cut {
            CutMethod::Auto => !self.sam.is_empty(),
            cut => cut == CutMethod::Sam,
        }
    }

    /// Is ViTMatte to find the alpha?
    pub fn with_vitmatte(&self) -> bool {
        match self.matting {
            MattingMethod::Auto => !self.vitmatte.is_empty(),
            matting => matting == MattingMethod::Vitmatte,
        }
    }

    /// What the ranges of single keys cannot say: a key, its problem, and a suggested fix.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let given = !self.prompts.is_empty() || !self.point.is_empty();
        let problem = |key, problem: &str, hint| Some((key, problem.to_owned(), hint));
        if !self.prompts.is_empty() && !self.point.is_empty() {
            return problem("mask.point", "is given beside `mask.prompts`", "give one of them");
        }
        match self.source {
            MaskSource::Clicks if !given => {
                return problem(
                    "mask.source",
                    "is clicks, but there are none",
                    "name a file: `--prompts prompts.json`",
                );
            }
            MaskSource::Network if self.alpha_net.is_empty() => {
                let hint = "name its file: `--alpha-net FILE.onnx`";
                return problem("mask.source", "is network, but there is none", hint);
            }
            MaskSource::Alpha | MaskSource::Folder | MaskSource::None if given => {
                let hint = "leave out the clicks, or set `mask.source` to clicks";
                return problem("mask.source", "does not make masks, but clicks are given", hint);
            }
            _ => {}
        }
        if given && !self.alpha_net.is_empty() {
            let hint = "leave one of them out: an alpha network needs no clicks";
            return problem("mask.alpha_net", "is named beside clicks", hint);
        }
        let networks = [&self.sam, &self.sam_decoder, &self.vitmatte, &self.alpha_net];
        if !self.made() && networks.iter().any(|file| !file.is_empty()) {
            let hint = "give clicks: `--prompts prompts.json`, or `--alpha-net FILE.onnx`";
            return problem(
                "mask.sam",
                "or `mask.vitmatte` names a network, but there are no clicks to start from",
                hint,
            );
        }
        if self.made() && self.meaning == MaskMeaning::Ignore {
            let hint = "set `mask.meaning` to empty: masks that are made say what is head";
            return problem("mask.meaning", "is ignore, but masks are made", hint);
        }
        if self.with_sam() && (self.sam.is_empty() || self.sam_decoder.is_empty()) {
            let hint = "name both files: `--sam encoder.onnx --sam-decoder decoder.onnx`";
            return problem("mask.cut", "needs both `mask.sam` and `mask.sam_decoder`", hint);
        }
        if !self.sam_decoder.is_empty() && self.sam.is_empty() {
            return problem("mask.sam_decoder", "is named without `mask.sam`", "name SAM's encoder too");
        }
        if self.matting == MattingMethod::Vitmatte && self.vitmatte.is_empty() {
            return problem(
                "mask.matting",
                "is vitmatte, but no file is named",
                "name it: `--vitmatte model.onnx`",
            );
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    #[test]
    fn what_contradicts_itself_is_named() {
        let start = || MaskConfig::preset(Preset::Standard);
        assert_eq!(start().problem(), None);
        assert!(!start().clicked());
        let clicked = MaskConfig { prompts: "p.json".into(), ..start() };
        assert!(clicked.clicked() && clicked.problem().is_none());
        let key = |c: MaskConfig| c.problem().unwrap().0;
        assert_eq!(key(MaskConfig { source: MaskSource::Clicks, ..start() }), "mask.source");
        assert_eq!(key(MaskConfig { source: MaskSource::Folder, ..clicked.clone() }), "mask.source");
        let named = MaskConfig { alpha_net: "a.onnx".into(), ..start() };
        assert!(named.made() && !named.clicked() && named.problem().is_none());
        assert_eq!(key(MaskConfig { prompts: "p.json".into(), ..named }), "mask.alpha_net");
        assert_eq!(key(MaskConfig { source: MaskSource::Network, ..start() }), "mask.source");
        assert_eq!(key(MaskConfig { point: vec!["1,2,1".into()], ..clicked.clone() }), "mask.point");
        assert_eq!(key(MaskConfig { meaning: MaskMeaning::Ignore, ..clicked.clone() }), "mask.meaning");
        assert_eq!(key(MaskConfig { vitmatte: "a.onnx".into(), ..start() }), "mask.sam");
        assert_eq!(key(MaskConfig { sam: "a.onnx".into(), ..clicked.clone() }), "mask.cut");
        assert_eq!(key(MaskConfig { sam_decoder: "a.onnx".into(), ..clicked.clone() }), "mask.sam_decoder");
        assert_eq!(key(MaskConfig { matting: MattingMethod::Vitmatte, ..clicked }), "mask.matting");
    }
}

//! `[mask]`: where head masks come from.

use super::table::table;
use super::{Config, key};
use serde::{Deserialize, Serialize};
use tiface_capture::{MaskHead, MaskMeaning, MaskSource};

/// Method that makes a hard mask from clicks.
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

/// Method that finds the opacity of the unknown band.
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

/// Normalization of the input of ViTMatte.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VitmatteColors {
    /// From the file of settings beside it, or else ImageNet's mean and deviation.
    Auto,
    /// ImageNet's mean and deviation, as the original code.
    Imagenet,
    /// 0.5 and 0.5, as transformers' processor.
    Half,
}

/// Returns whether the run makes masks.
fn made(config: &Config) -> bool {
    config.mask.makes_masks()
}

/// Returns whether masks are those of the capture.
fn read(config: &Config) -> bool {
    !config.mask.makes_masks()
}

table! {
    /// Where masks come from, what they mean, and how they are made from clicks.
    pub struct MaskConfig;
    keys {
        /// Where masks come from: auto (clicks or an alpha network if given, else those of the
        /// capture), alpha, folder (capture.mask_dir), clicks, network or none (no masks:
        /// everything the cameras see is reconstructed).
        source: MaskSource [Masks] => MaskSource::Auto;
        /// Train even with masks that look wrong: inverted ones, and those that contradict the
        /// others.
        trust: bool [nothing] => false;
        /// Meaning of pixels outside a mask: empty (no head) or ignore (unknown).
        meaning: MaskMeaning [Masks] => MaskMeaning::Empty;
        /// Pixels of the capture's mask files that are the head: white (gray is opacity; a single
        /// other color on black is taken for white), not-black, or values and colors, as 1,2,17
        /// (labels) or #5000ff,#ff0000.
        head: MaskHead [Masks if read, Metrics if made] => MaskHead::White;
        /// File of clicks to make masks from: a prompts.json, as `tiface mask --page` saves it.
        #[flag("prompts", File, ["run", "mask"], "Make masks from the clicks in a prompts.json")]
        prompts: String [nothing] => String::new();
        /// List of clicks x,y,label on one photograph (label 1: head, 0: background), for a quick
        /// try.
        #[flag("point", Each("X,Y,LABEL"), ["run", "mask"],
            "Click on one photograph: 1 for the head, 0 for background; repeatable")]
        point: Vec<String> [nothing] => Vec::new();
        /// View of `mask.point`; empty: the first training view.
        #[flag("view", Text("NAME"), ["run", "mask"], "View of --point [default: the first training view]")]
        view: String [nothing] => String::new();
        /// Method for a hard mask: auto (sam if its files are given), grabcut (built in) or sam.
        cut: CutMethod [Masks if made] => CutMethod::Auto;
        /// Method for the alpha: auto (vitmatte if its file is given), closed (closed form, built
        /// in) or vitmatte.
        matting: MattingMethod [Masks if made] => MattingMethod::Auto;
        /// Image encoder of SAM, an ONNX file (needs a build with the feature `matting`).
        #[flag("sam", File, ["run", "mask"], "Image encoder of SAM, an ONNX file; needs --sam-decoder")]
        sam: String [nothing] => String::new();
        /// Prompt encoder and mask decoder of SAM, an ONNX file.
        #[flag("sam-decoder", File, ["run", "mask"])]
        sam_decoder: String [nothing] => String::new();
        /// ViTMatte, an ONNX file (needs a build with the feature `matting`).
        #[flag("vitmatte", File, ["run", "mask"], "ViTMatte, an ONNX file")]
        vitmatte: String [nothing] => String::new();
        /// Network that predicts alpha without clicks (U²-Net, ISNet, MODNet, BiRefNet), an ONNX
        /// file (needs a build with the feature `matting`).
        #[flag("alpha-net", File, ["run", "mask"],
            "Make masks without clicks, by a network that predicts alpha (U²-Net, ISNet, MODNet, BiRefNet), \
             an ONNX file")]
        alpha_net: String [nothing] => String::new();
        /// Size and normalization of its input: auto (from the file beside it, else by its name),
        /// SIDE,MEAN,SCALE as 1024,0.5,1, or SIDE,imagenet.
        alpha_input: String [Masks if |c| c.mask.with_alpha_net()] => "auto".into();
        /// Normalization of the input of ViTMatte: auto (from the file beside it, else imagenet),
        /// imagenet or half.
        vitmatte_colors: VitmatteColors [Masks if made] => VitmatteColors::Auto;
        /// Largest memory for running networks, GiB.
        memory_gib: f64, 0.25..=1024.0 [nothing] => 12.0;
        /// Longest side of the input of SAM and matting, pixels.
        side_px: u32, 64.0..=8192.0 [Masks if made] => 1024;
        /// Half width of the unknown band around the outline, as a share of the height.
        band: f32, 0.0..=0.5 [Masks if made] => 0.023;
        /// Side of the square structuring element that makes the band, pixels (published: 10); 0:
        /// use `band`.
        kernel: u32, 0.0..=1000.0 [Masks if made] => 0, 0, 10;
        /// Number of erosions and dilations with that square (published: 5).
        iterations: u32, 0.0..=1000.0 [Masks if made] => 5;
    }
}

impl MaskConfig {
    /// Returns whether the run makes the masks, from clicks or by a network.
    pub fn makes_masks(&self) -> bool {
        self.clicked() || self.with_alpha_net()
    }

    /// Returns whether the masks are made by the alpha network alone.
    pub fn with_alpha_net(&self) -> bool {
        match self.source {
            MaskSource::Network => true,
            MaskSource::Auto => !self.alpha_net.is_empty(),
            _ => false,
        }
    }

    /// Returns whether any network is used.
    pub fn with_networks(&self) -> bool {
        self.with_sam() || self.with_vitmatte() || self.with_alpha_net()
    }

    /// Returns whether the masks are made from clicks.
    pub fn clicked(&self) -> bool {
        match self.source {
            MaskSource::Clicks => true,
            MaskSource::Auto => !self.prompts.is_empty() || !self.point.is_empty(),
            _ => false,
        }
    }

    /// Returns whether SAM makes the hard masks.
    pub fn with_sam(&self) -> bool {
        match self.cut {
            CutMethod::Auto => !self.sam.is_empty(),
            cut => cut == CutMethod::Sam,
        }
    }

    /// Returns whether ViTMatte makes the alpha.
    pub fn with_vitmatte(&self) -> bool {
        match self.matting {
            MattingMethod::Auto => !self.vitmatte.is_empty(),
            matting => matting == MattingMethod::Vitmatte,
        }
    }

    /// Returns what the ranges of single keys cannot say: a key, its problem, and a suggested fix.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let given = !self.prompts.is_empty() || !self.point.is_empty();
        let problem = |key, problem: &str, hint| Some((key, problem.to_owned(), hint));
        if !self.prompts.is_empty() && !self.point.is_empty() {
            return problem(key!(mask.point), "is given beside `mask.prompts`", "give one of them");
        }
        match self.source {
            MaskSource::Clicks if !given => {
                return problem(
                    key!(mask.source),
                    "is clicks, but there are none",
                    "name a file: `--prompts prompts.json`",
                );
            }
            MaskSource::Network if self.alpha_net.is_empty() => {
                let hint = "name its file: `--alpha-net FILE.onnx`";
                return problem(key!(mask.source), "is network, but there is none", hint);
            }
            MaskSource::Alpha | MaskSource::Folder | MaskSource::None if given => {
                let hint = "leave out the clicks, or set `mask.source` to clicks";
                return problem(key!(mask.source), "does not make masks, but clicks are given", hint);
            }
            _ => {}
        }
        if given && !self.alpha_net.is_empty() {
            let hint = "leave one of them out: an alpha network needs no clicks";
            return problem(key!(mask.alpha_net), "is named beside clicks", hint);
        }
        let networks = [&self.sam, &self.sam_decoder, &self.vitmatte, &self.alpha_net];
        if !self.makes_masks() && networks.iter().any(|file| !file.is_empty()) {
            let hint = "give clicks: `--prompts prompts.json`, or `--alpha-net FILE.onnx`";
            return problem(
                key!(mask.sam),
                "or `mask.vitmatte` names a network, but there are no clicks to start from",
                hint,
            );
        }
        if self.makes_masks() && self.meaning == MaskMeaning::Ignore {
            let hint = "set `mask.meaning` to empty: masks that are made say what is head";
            return problem(key!(mask.meaning), "is ignore, but masks are made", hint);
        }
        if self.with_sam() && (self.sam.is_empty() || self.sam_decoder.is_empty()) {
            let hint = "name both files: `--sam encoder.onnx --sam-decoder decoder.onnx`";
            return problem(key!(mask.cut), "needs both `mask.sam` and `mask.sam_decoder`", hint);
        }
        if !self.sam_decoder.is_empty() && self.sam.is_empty() {
            return problem(key!(mask.sam_decoder), "is named without `mask.sam`", "name SAM's encoder too");
        }
        if self.matting == MattingMethod::Vitmatte && self.vitmatte.is_empty() {
            return problem(
                key!(mask.matting),
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
        assert!(named.makes_masks() && !named.clicked() && named.problem().is_none());
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

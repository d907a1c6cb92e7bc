//! `[mask]`: which pixels are the head.

use super::{Key, Preset};
use serde::{Deserialize, Serialize};

/// Where masks come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskSource {
    /// Clicks, if some are given; else whatever the capture has: named in its frames, beside the
    /// photographs, or their alpha.
    Auto,
    /// The photographs' own alpha.
    Alpha,
    /// The folder `capture.mask_dir`.
    Folder,
    /// Made from clicks: `mask.prompts` or `mask.point`.
    Clicks,
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
    /// Graph cuts over colour mixtures, built in.
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

/// Where masks come from, what they mean, and how they are made from clicks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaskConfig {
    /// Where they come from.
    pub source: MaskSource,
    /// What the rest of the picture is.
    pub meaning: MaskMeaning,
    /// A `prompts.json`; empty for none.
    pub prompts: String,
    /// Clicks as `x,y,label`, for a quick try.
    pub point: Vec<String>,
    /// The view that `point` is on; empty for the first that is trained on.
    pub view: String,
    /// How a hard mask comes from clicks.
    pub cut: CutMethod,
    /// How it becomes an alpha.
    pub matting: MattingMethod,
    /// SAM's image encoder, ONNX.
    pub sam: String,
    /// SAM's prompt encoder and mask decoder, ONNX.
    pub sam_decoder: String,
    /// ViTMatte, ONNX.
    pub vitmatte: String,
    /// The ONNX Runtime library; empty for the built-in engine.
    pub onnxruntime: String,
    /// What ViTMatte is shown.
    pub vitmatte_colors: VitmatteColors,
    /// Memory for networks, GiB.
    pub memory_gib: f64,
    /// Longest side that SAM and matting see, pixels.
    pub side_px: u32,
    /// Rows that are cut.
    pub cut_px: u32,
    /// Gaussians of a mixture.
    pub gaussians: usize,
    /// γ of the cut.
    pub smoothness: f64,
    /// λ/γ of the cut.
    pub certainty: f64,
    /// Rounds of fitting and cutting.
    pub cut_rounds: usize,
    /// Radius of what a click makes certain, share of the height.
    pub seed_radius: f32,
    /// Width of the margins at the borders, share of the height.
    pub border_margin: f32,
    /// How far down the border margins at the sides reach, share of the height.
    pub border_sides: f32,
    /// Cells along each side of the carved cube.
    pub carve_cells: usize,
    /// Rounds of carving and cutting.
    pub carve_rounds: usize,
    /// Distance from the hull's silhouette to definite background, share of the height.
    pub carve_outside: f32,
    /// Depth of the core, share of the deepest cell.
    pub carve_core: f64,
    /// Votes against a cell that are forgiven.
    pub carve_most_negative: usize,
    /// Share of the views that must keep a cell.
    pub carve_least_positive: f64,
    /// Radius of the unknown band, share of the height.
    pub band: f32,
    /// Side of the square of ones instead; 0 for discs.
    pub kernel: u32,
    /// How often the square is applied each way.
    pub iterations: u32,
    /// ε of closed-form matting.
    pub epsilon: f64,
    /// Weight of definite pixels.
    pub constraint_weight: f64,
    /// Weight by which unknown pixels are held to the hard mask.
    pub prior_weight: f64,
    /// Alphas below become 0.
    pub lowest: f32,
    /// Alphas above become 1.
    pub highest: f32,
}

pub(super) const KEYS: &[Key] = &[
    Key::word(
        "source",
        "Where masks come from: auto (clicks if given, else what the capture has), alpha, folder (capture.mask_dir), \
         clicks or none (go on without: whatever the cameras see is learned).",
    ),
    Key::word("meaning", "What lies outside a mask: empty (nothing of the head) or ignore (not looked at)."),
    Key::word("prompts", "Clicks to make masks from: a prompts.json, as `tiface mask --page` saves it."),
    Key::word(
        "point",
        "A list of clicks x,y,label on one photograph (label 1: head, 0: not), for a quick try.",
    ),
    Key::word("view", "The view that `mask.point` is on; empty for the first that is trained on."),
    Key::word(
        "cut",
        "From clicks to a hard mask: auto (sam if its files are named), grabcut (built in) or sam.",
    ),
    Key::word(
        "matting",
        "From a hard mask to an alpha: auto (vitmatte if its file is named), closed (closed form, built in) or \
         vitmatte.",
    ),
    Key::word("sam", "SAM's image encoder as an ONNX file (needs a build with the feature `matting`)."),
    Key::word("sam_decoder", "SAM's prompt encoder and mask decoder as an ONNX file."),
    Key::word("vitmatte", "ViTMatte as an ONNX file (needs a build with the feature `matting`)."),
    Key::word("onnxruntime", "The ONNX Runtime library to run networks with; empty for the built-in engine."),
    Key::word(
        "vitmatte_colors",
        "What ViTMatte is shown: auto (as the file beside it says, else imagenet), imagenet or half.",
    ),
    Key::number("memory_gib", "Memory that running networks may take, GiB.", 0.25, 1024.0),
    Key::number("side_px", "Longest side that SAM and matting see, pixels.", 64.0, 8192.0),
    Key::number("cut_px", "Rows of the picture that GrabCut sees, pixels.", 64.0, 2048.0),
    Key::number("gaussians", "Gaussians of each colour mixture.", 1.0, 16.0),
    Key::number("smoothness", "What an edge between equal colours costs (gamma).", 0.0, 1e4),
    Key::number(
        "certainty",
        "What contradicting a click costs, times the smoothness (lambda / gamma).",
        1.0,
        1e4,
    ),
    Key::number("cut_rounds", "Rounds of fitting colours and cutting.", 1.0, 100.0),
    Key::number("seed_radius", "Radius around a click that is certain, share of the height.", 0.0, 0.5),
    Key::number(
        "border_margin",
        "Width of the border margins at the borders that are no head, share of the height.",
        0.0,
        0.5,
    ),
    Key::number(
        "border_sides",
        "How far down the border margins at the sides reach, share of the height.",
        0.0,
        1.0,
    ),
    Key::number(
        "carve_cells",
        "Cells along each side of the cube carved to carry clicks to other views.",
        16.0,
        512.0,
    ),
    Key::number("carve_rounds", "Rounds of carving and cutting.", 1.0, 20.0),
    Key::number("carve_outside", "How far outside the hull nothing is head, share of the height.", 0.0, 0.5),
    Key::number("carve_core", "How deep inside all is head, share of the deepest cell.", 0.0, 1.0),
    Key::number("carve_most_negative", "Views that may contradict a cell.", 0.0, 1000.0),
    Key::number("carve_least_positive", "Share of the views that must keep a cell.", 0.0, 1.0),
    Key::number(
        "band",
        "Radius of the unknown band to both sides of the outline, share of the height.",
        0.0,
        0.5,
    ),
    Key::number(
        "kernel",
        "Side of a square of ones for the band instead, pixels (the paper: 10); 0 for `band`.",
        0.0,
        1000.0,
    ),
    Key::number("iterations", "How often the square is applied each way (the paper: 5).", 0.0, 1000.0),
    Key::number("epsilon", "Noise of colours in closed-form matting.", 0.0, 1.0),
    Key::number("constraint_weight", "Weight that ties definite pixels in closed-form matting.", 1e-6, 1e9),
    Key::number(
        "prior_weight",
        "Weight that holds unknown pixels to the hard mask in closed-form matting.",
        0.0,
        1e9,
    ),
    Key::number("lowest", "Alphas below this become 0.", 0.0, 1.0),
    Key::number("highest", "Alphas above this become 1.", 0.0, 1.0),
];

impl MaskConfig {
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

    /// What the ranges of single keys cannot say: a key, its problem, and the way out.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let given = !self.prompts.is_empty() || !self.point.is_empty();
        let say = |key, problem: &str, hint| Some((key, problem.to_owned(), hint));
        if !self.prompts.is_empty() && !self.point.is_empty() {
            return say("mask.point", "is given beside `mask.prompts`", "give one of them");
        }
        match self.source {
            MaskSource::Clicks if !given => {
                return say(
                    "mask.source",
                    "is clicks, but there are none",
                    "name a file: `--prompts prompts.json`",
                );
            }
            MaskSource::Alpha | MaskSource::Folder | MaskSource::None if given => {
                let hint = "leave out the clicks, or set `mask.source` to clicks";
                return say("mask.source", "does not make masks, but clicks are given", hint);
            }
            _ => {}
        }
        let networks = [&self.sam, &self.sam_decoder, &self.vitmatte];
        if !self.clicked() && networks.iter().any(|file| !file.is_empty()) {
            let hint = "give clicks: `--prompts prompts.json`";
            return say(
                "mask.sam",
                "or `mask.vitmatte` names a network, but there are no clicks to start from",
                hint,
            );
        }
        if self.clicked() && self.meaning == MaskMeaning::Ignore {
            let hint = "set `mask.meaning` to empty: clicks say what is head";
            return say("mask.meaning", "is ignore, but masks are made from clicks", hint);
        }
        if self.with_sam() && (self.sam.is_empty() || self.sam_decoder.is_empty()) {
            let hint = "name both files: `--sam encoder.onnx --sam-decoder decoder.onnx`";
            return say("mask.cut", "needs both `mask.sam` and `mask.sam_decoder`", hint);
        }
        if !self.sam_decoder.is_empty() && self.sam.is_empty() {
            return say("mask.sam_decoder", "is named without `mask.sam`", "name SAM's encoder too");
        }
        if self.matting == MattingMethod::Vitmatte && self.vitmatte.is_empty() {
            return say(
                "mask.matting",
                "is vitmatte, but no file is named",
                "name it: `--vitmatte model.onnx`",
            );
        }
        if self.lowest >= self.highest {
            return say("mask.lowest", "is not below `mask.highest`", "0.02 and 0.98 are usual");
        }
        None
    }

    /// The values a preset starts with.
    pub fn preset(preset: Preset) -> MaskConfig {
        MaskConfig {
            source: MaskSource::Auto,
            meaning: MaskMeaning::Empty,
            prompts: String::new(),
            point: Vec::new(),
            view: String::new(),
            cut: CutMethod::Auto,
            matting: MattingMethod::Auto,
            sam: String::new(),
            sam_decoder: String::new(),
            vitmatte: String::new(),
            onnxruntime: String::new(),
            vitmatte_colors: VitmatteColors::Auto,
            memory_gib: 12.0,
            side_px: 1024,
            cut_px: 512,
            gaussians: 5,
            smoothness: 50.0,
            certainty: 9.0,
            cut_rounds: 8,
            seed_radius: 0.012,
            border_margin: 0.012,
            border_sides: 0.6,
            carve_cells: 112,
            carve_rounds: 3,
            carve_outside: 0.012,
            carve_core: 0.55,
            carve_most_negative: 2,
            carve_least_positive: 0.1,
            band: 0.023,
            // the paper's band, made for pictures of 1024 rows
            kernel: if preset == Preset::Paper { 10 } else { 0 },
            iterations: 5,
            epsilon: 1e-5,
            constraint_weight: 100.0,
            prior_weight: 3e-3,
            lowest: 0.02,
            highest: 0.98,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        assert_eq!(key(MaskConfig { point: vec!["1,2,1".into()], ..clicked.clone() }), "mask.point");
        assert_eq!(key(MaskConfig { meaning: MaskMeaning::Ignore, ..clicked.clone() }), "mask.meaning");
        assert_eq!(key(MaskConfig { vitmatte: "a.onnx".into(), ..start() }), "mask.sam");
        assert_eq!(key(MaskConfig { sam: "a.onnx".into(), ..clicked.clone() }), "mask.cut");
        assert_eq!(key(MaskConfig { sam_decoder: "a.onnx".into(), ..clicked.clone() }), "mask.sam_decoder");
        assert_eq!(key(MaskConfig { matting: MattingMethod::Vitmatte, ..clicked.clone() }), "mask.matting");
        assert_eq!(key(MaskConfig { lowest: 0.98, ..clicked }), "mask.lowest");
    }
}

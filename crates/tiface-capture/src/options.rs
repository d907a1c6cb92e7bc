//! How a capture is opened, and the choices there are.

use serde::{Deserialize, Serialize};
use std::fmt;
use tiface_base::io::Limits;

/// How what the files of a capture leave open is read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reading {
    /// Photographs that the camera file does not name follow by number (2 before 10), not by the
    /// bytes of their names.
    pub by_number: bool,
    /// So do masks that are paired with photographs by their order.
    pub masks_by_number: bool,
    /// Photographs are turned as EXIF asks, where their size does not say whether they are to be.
    pub turned: bool,
    /// Masks beside these photographs are turned likewise.
    pub masks_turned: bool,
}

/// How to open a capture.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureOptions {
    /// Whole factor by which photographs are averaged down, at least 1.
    pub downscale: u32,
    /// Which masks to use: those of the capture, unless another source is set; none with
    /// [`MaskSource::Clicks`].
    pub masks: MaskSource,
    /// The only folder of masks, relative to the capture; empty to look beside the photographs.
    pub mask_dir: String,
    /// Meaning of the masks' values.
    pub mask_meaning: MaskMeaning,
    /// Which pixels of mask files are the head.
    pub head: MaskHead,
    /// Whether masks that cannot be right are reported as warnings only.
    pub trust_masks: bool,
    /// Whether poses are to be measured.
    pub cameras: CameraPoses,
    /// Whether exposures are to be measured.
    pub exposure: Exposures,
    /// Whether the glare of lamps is to be measured.
    pub glare: Glares,
    /// Meters per dataset unit.
    pub unit_m: f64,
    /// How what the files leave open is read, where that has been decided.
    pub reading: Option<Reading>,
    /// Name of a file that marks folders of results, in which no photograph or mask is searched;
    /// empty if there are none.
    pub result_file: &'static str,
    /// Limits of files.
    pub limits: Limits,
}

impl Default for CaptureOptions {
    fn default() -> CaptureOptions {
        CaptureOptions {
            downscale: 1,
            masks: MaskSource::Auto,
            mask_dir: String::new(),
            mask_meaning: MaskMeaning::Empty,
            head: MaskHead::White,
            trust_masks: false,
            cameras: CameraPoses::Auto,
            exposure: Exposures::Auto,
            glare: Glares::Auto,
            unit_m: 1.0,
            reading: None,
            result_file: "",
            limits: Limits::default(),
        }
    }
}

/// Which poses training views have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraPoses {
    /// Those given, or refined ones where a measurement says that they do not fit.
    Auto,
    /// Refined ones.
    Refine,
    /// Those given, unmeasured.
    Given,
}

/// Which exposure training photographs have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Exposures {
    /// The mean of all where a measurement says that they differ.
    Auto,
    /// Their own, unmeasured.
    Given,
}

/// Which glare of lamps training photographs have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Glares {
    /// None where it can be told from other light.
    Auto,
    /// Their own, unmeasured.
    Given,
}

/// Where masks come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskSource {
    /// Clicks or an alpha network, if given; else whatever the capture has: named in its frames,
    /// beside the photographs, or their alpha.
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

/// Meaning of the pixels outside a mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskMeaning {
    /// Empty space: no part of the head.
    Empty,
    /// Not looked at, as nerfstudio's `mask_path` means it.
    Ignore,
}

/// Which pixels of the capture's mask files are the head.
///
/// ```
/// use tiface_capture::{HeadValue, MaskHead};
///
/// assert_eq!(MaskHead::try_from("not-black".to_string())?, MaskHead::NotBlack);
/// let listed = MaskHead::try_from("1, 17, #5000ff".to_string())?;
/// let values = [HeadValue::Number(1), HeadValue::Number(17), HeadValue::Color([80, 0, 255])];
/// assert_eq!(String::from(listed.clone()), "1,17,#5000ff");
/// assert_eq!(listed, MaskHead::Values(values.into()));
/// assert!(MaskHead::try_from("blue".to_string()).unwrap_err().contains("`white`"));
/// # Ok::<(), String>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum MaskHead {
    /// White ones; gray is opacity. Masks in one other color are read with it for white.
    #[default]
    White,
    /// All that are not black; of a file with transparency, those that are not transparent.
    NotBlack,
    /// Those with one of these values.
    Values(Vec<HeadValue>),
}

/// A value of mask files that means head.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum HeadValue {
    /// A gray value, or a label: in an indexed file with a palette of colors, an index.
    Number(u8),
    /// A color.
    Color([u8; 3]),
}

impl HeadValue {
    fn parse(text: &str) -> Option<HeadValue> {
        let Some(digits) = text.strip_prefix('#') else { return text.parse().ok().map(HeadValue::Number) };
        let is_color = digits.len() == 6 && digits.bytes().all(|b| b.is_ascii_hexdigit());
        let [_, r, g, b] = u32::from_str_radix(digits, 16).ok().filter(|_| is_color)?.to_be_bytes();
        Some(HeadValue::Color([r, g, b]))
    }
}

impl fmt::Display for HeadValue {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            HeadValue::Number(value) => write!(f, "{value}"),
            HeadValue::Color([r, g, b]) => write!(f, "#{r:02x}{g:02x}{b:02x}"),
        }
    }
}

impl TryFrom<String> for MaskHead {
    type Error = String;

    fn try_from(text: String) -> Result<MaskHead, String> {
        match text.trim() {
            "white" => return Ok(MaskHead::White),
            "not-black" => return Ok(MaskHead::NotBlack),
            _ => {}
        }
        let value = |part: &str| {
            let expected = "expected `white`, `not-black`, or values from 0 to 255 and colors as in 1,2,17 or \
                            #5000ff,#ff0000";
            HeadValue::parse(part.trim()).ok_or_else(|| format!("unknown value `{part}`, {expected}"))
        };
        text.split(',').map(value).collect::<Result<_, _>>().map(MaskHead::Values)
    }
}

impl From<MaskHead> for String {
    fn from(head: MaskHead) -> String {
        match head {
            MaskHead::White => "white".into(),
            MaskHead::NotBlack => "not-black".into(),
            MaskHead::Values(values) => values.iter().map(HeadValue::to_string).collect::<Vec<_>>().join(","),
        }
    }
}

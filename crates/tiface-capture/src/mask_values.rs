//! What the values of mask files mean: white, another color in its place, or what `mask.head` says.
//!
//! A single file does not show it: where a view has one label, its mask looks like one drawn in
//! gray. So the values of all files are counted, and one reading holds for the whole capture. Masks
//! with white are opacity. Masks in one other color `C` on black are opacity too,
//! `α = p · C / C · C`. Labels, several colors and photographs say nothing of a head by themselves:
//! [`MaskSurvey::reading`] refuses them.

use super::options::{HeadValue, MaskHead};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::image::{Gray, OPAQUE_ALPHA};
use tiface_base::io::MaskPicture;
use tiface_base::{Error, Result};

/// Maximum of a channel that counts as black in pictures with noise.
pub(super) const MAX_BLACK: u8 = 16;

/// Maximum of what can only be labels, where nothing is brighter: they are exact, and 1 is not
/// black.
const MAX_LABEL: u8 = 40;

/// From this value on, a gray may be white that a program changed a little.
const ALMOST_WHITE: u8 = 235;

/// Maximum difference of the channels of a gray.
const MAX_CHROMA: u8 = 32;

/// Maximum difference of pixels that belong to one even area, which the noise of JPEG leaves.
const EVEN: u8 = 6;

/// Maximum differences from a gray, and from a color, that are the same with the noise of JPEG.
const NOISE: [u8; 2] = [10, 24];

/// Maximum distance of a color from the line between black and another one on which soft edges lie.
const OFF_LINE: f32 = 32.0;

/// Minimum share of the even pixels that one gray or color must have to be taken for white.
const MIN_PLATEAU: f64 = 0.85;

/// Maximum number of values that a message lists.
const LISTED: usize = 6;

/// How the pixels of mask files are read.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskReading {
    /// Luma, or alpha of a file that has any, is opacity.
    #[default]
    White,
    /// This color is opaque, black is not.
    Drawn([u8; 3]),
    /// What has a channel brighter than this is head.
    Above(u8),
    /// These values are head.
    Values(Vec<HeadValue>),
}

impl MaskReading {
    /// Returns the reading that a setting asks for, before the values of any mask are known.
    pub(super) fn asked(head: &MaskHead) -> MaskReading {
        match head {
            MaskHead::White => MaskReading::White,
            MaskHead::NotBlack => MaskReading::Above(MAX_BLACK),
            MaskHead::Values(values) => MaskReading::Values(values.clone()),
        }
    }

    /// Returns whether masks are read as they always were.
    pub(crate) fn is_white(&self) -> bool {
        *self == MaskReading::White
    }

    /// Returns the opacity of the head in a mask file.
    pub(super) fn read(&self, picture: MaskPicture) -> Gray {
        let (width, height, pixels) = (picture.width, picture.height, 0..picture.rgb.len());
        let values = match self {
            MaskReading::White => return picture.gray(),
            MaskReading::Drawn(color) => pixels.map(|i| projected(picture.drawn(i), *color)).collect(),
            // what is transparent is no head; half transparent hair stays half transparent
            MaskReading::Above(black) => match picture.alpha {
                Some(alpha) => alpha,
                None => pixels.map(|i| 255 * u8::from(brightest(picture.rgb[i]) > *black)).collect(),
            },
            MaskReading::Values(values) => {
                let wanted: Vec<([u8; 3], u8)> =
                    values.iter().filter_map(|v| color_of(*v, &picture.palette)).collect();
                let is_head = |color| wanted.iter().any(|(head, noise)| apart(color, *head) <= *noise);
                let is_opaque = |i: usize| picture.alpha.as_ref().is_none_or(|alpha| alpha[i] >= 128);
                pixels.map(|i| 255 * u8::from(is_opaque(i) && is_head(picture.rgb[i]))).collect()
            }
        };
        Gray { width, height, values }
    }
}

/// Returns the color that a value stands for in a file with this palette, and how far off it may
/// be.
fn color_of(value: HeadValue, palette: &[[u8; 3]]) -> Option<([u8; 3], u8)> {
    match value {
        HeadValue::Color(color) => Some((color, NOISE[1])),
        HeadValue::Number(index) if !palette.is_empty() => Some((*palette.get(usize::from(index))?, 0)),
        HeadValue::Number(gray) => Some(([gray; 3], if gray <= MAX_LABEL { 0 } else { NOISE[0] })),
    }
}

/// Returns `p · C / C · C`, where 255 is 1, with the noise of black left out.
fn projected(p: [u8; 3], color: [u8; 3]) -> u8 {
    if brightest(p) <= MAX_BLACK.min(brightest(color) / 2) {
        return 0;
    }
    let dot = |a: [u8; 3]| a.iter().zip(color).map(|(&a, c)| u32::from(a) * u32::from(c)).sum::<u32>();
    let square = dot(color).max(1);
    ((255 * dot(p) + square / 2) / square).min(255) as u8
}

fn brightest(color: [u8; 3]) -> u8 {
    color.into_iter().max().unwrap_or(0)
}

fn chroma(color: [u8; 3]) -> u8 {
    brightest(color) - color.into_iter().min().unwrap_or(0)
}

fn apart(a: [u8; 3], b: [u8; 3]) -> u8 {
    a.into_iter().zip(b).map(|(a, b)| a.abs_diff(b)).max().unwrap_or(0)
}

/// Returns the distance of a color from the line through black and another one.
fn off_line(p: [u8; 3], color: [u8; 3]) -> f32 {
    let [p, line] = [p, color].map(|c| Vec3::from(c.map(f32::from)));
    p.reject_from_normalized(line.try_normalize().unwrap_or(Vec3::X)).length()
}

/// Pixels of nearly one color.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    pixels: u64,
    /// Those like the pixels left of them and above, which soft edges are not.
    even: u64,
    /// Neighbors left of them and above that are black, where they are not.
    edges: u64,
    /// The most frequent exact color, by the vote of Boyer and Moore.
    color: [u8; 3],
    votes: u64,
}

impl Tally {
    fn add(&mut self, other: Tally) {
        (self.pixels, self.even) = (self.pixels + other.pixels, self.even + other.even);
        self.edges += other.edges;
        if self.color == other.color {
            self.votes += other.votes;
        } else if self.votes < other.votes {
            (self.color, self.votes) = (other.color, other.votes - self.votes);
        } else {
            self.votes -= other.votes;
        }
    }

    /// Returns whether all pixels have the very same color, as noise has not.
    fn is_exact(&self) -> bool {
        self.votes == self.pixels
    }
}

/// Returns the tally of a color: one for each gray, one for 8 × 8 × 8 other colors.
fn key([r, g, b]: [u8; 3]) -> u16 {
    if r == g && g == b {
        return u16::from(r);
    }
    [r, g, b].into_iter().fold(0, |key, c| key << 5 | u16::from(c >> 3)) + 256
}

/// The values of one mask file.
#[derive(Clone, Debug)]
pub struct MaskValues {
    tallies: Vec<(u16, Tally)>,
    is_alpha: bool,
    palette: Vec<[u8; 3]>,
}

impl MaskValues {
    /// Counts the values of a file.
    pub fn count(picture: &MaskPicture) -> MaskValues {
        let mut tallies = vec![Tally::default(); 256 + (1 << 15)];
        let width = picture.width as usize;
        let mut run = Tally::default();
        for i in 0..picture.rgb.len() {
            let color = picture.drawn(i);
            let is_inner = i >= width && i % width > 0;
            let beside = if is_inner { [i - 1, i - width].map(|i| picture.drawn(i)) } else { [color; 2] };
            let is_even = is_inner && beside.iter().all(|other| apart(*other, color) <= EVEN);
            let is_edge = |other: &&[u8; 3]| brightest(color) > MAX_BLACK && brightest(**other) <= MAX_BLACK;
            let edges = if is_even { 0 } else { beside.iter().filter(is_edge).count() as u64 };
            if run.pixels > 0 && run.color != color {
                tallies[usize::from(key(run.color))].add(run);
                run = Tally::default();
            }
            run.color = color;
            (run.pixels, run.votes, run.even) =
                (run.pixels + 1, run.votes + 1, run.even + u64::from(is_even));
            run.edges += edges;
        }
        if run.pixels > 0 {
            tallies[usize::from(key(run.color))].add(run);
        }
        let tallies = (0..).zip(tallies).filter(|(_, tally)| tally.pixels > 0).collect();
        MaskValues { tallies, is_alpha: picture.alpha.is_some(), palette: picture.palette.clone() }
    }
}

/// The values of all mask files of a capture.
#[derive(Clone, Debug, Default)]
pub struct MaskSurvey {
    tallies: BTreeMap<u16, Tally>,
    files: usize,
    /// Files whose alpha is the mask.
    with_alpha: usize,
    palette: Vec<[u8; 3]>,
    /// The file with the most values, and how many those are.
    example: (PathBuf, usize),
    /// The first file without white that is drawn in one gray, and that gray.
    gray_file: Option<(PathBuf, u8)>,
    /// Whether any pixel was read as head.
    any_head: bool,
}

impl MaskSurvey {
    /// Adds a file: its path for messages, its values, and the mask that was read of it.
    pub fn add(&mut self, file: &Path, values: MaskValues, mask: Option<&Gray>) {
        let MaskValues { tallies, is_alpha, palette } = values;
        self.files += 1;
        self.with_alpha += usize::from(is_alpha);
        self.any_head |= mask.is_none_or(|mask| mask.values.iter().any(|&v| v > 0));
        if tallies.len() > self.example.1 {
            self.example = (file.into(), tallies.len());
        }
        let own: Vec<Tally> = tallies.iter().map(|(_, tally)| *tally).collect();
        if self.gray_file.is_none() {
            self.gray_file = gray_of(&own).map(|gray| (file.into(), gray));
        }
        for (key, tally) in tallies {
            self.tallies.entry(key).or_default().add(tally);
        }
        if self.palette.is_empty() {
            self.palette = palette;
        }
    }

    /// Returns how all masks are read: as `head` says, if their values allow it.
    ///
    /// # Errors
    ///
    /// Fails if the values do not say what is head, and names them.
    pub fn reading(&self, head: &MaskHead, root: &Path) -> Result<MaskReading> {
        let all: Vec<Tally> = self.tallies.values().copied().collect();
        match head {
            MaskHead::NotBlack => return Ok(MaskReading::Above(max_black(&all))),
            MaskHead::Values(_) if self.any_head || self.files == 0 => return Ok(MaskReading::asked(head)),
            MaskHead::Values(values) => {
                let asked = String::from(MaskHead::Values(values.clone()));
                let problem = format!("no pixel of any mask has a value of `mask.head={asked}`");
                return Err(self.refusal(&all, &problem, root));
            }
            MaskHead::White => {}
        }
        let black = max_black(&all);
        let seen: Vec<Tally> = all.iter().filter(|t| brightest(t.color) > black).copied().collect();
        let count =
            |is: &dyn Fn(&Tally) -> bool| seen.iter().filter(|t| is(t)).map(|t| t.pixels).sum::<u64>();
        let (visible, colored) = (count(&|_| true), count(&|t| chroma(t.color) > MAX_CHROMA));
        if visible == 0 {
            return Ok(MaskReading::White); // that they are empty is said elsewhere
        }
        if has_white(&seen) && 50 * colored <= visible {
            let grays = levels(&seen);
            let are_several = grays.len() > 1 || black == 0;
            return match &self.gray_file {
                Some((file, gray)) if !are_several => {
                    let file = shown(file, root);
                    let problem = format!("masks differ: `{file}` is drawn in gray {gray}, others in white");
                    Err(self.refusal(&all, &problem, root))
                }
                _ if are_several || is_area(&grays, &seen) => {
                    Err(self.refusal(&all, "masks have several values, as labels have", root))
                }
                _ => Ok(MaskReading::White),
            };
        }
        match drawn_in(&all, black) {
            Some(color) => Ok(MaskReading::Drawn(color)),
            None if 50 * colored > visible => {
                Err(self.refusal(&all, "masks are in several colors, and white must be the head", root))
            }
            None => Err(self.refusal(&all, "masks have no white, and white must be the head", root)),
        }
    }

    /// Returns what is worth saying of masks that are read in this way.
    pub fn reasons(&self, reading: &MaskReading) -> Vec<String> {
        let mut said = Vec::new();
        if self.files == 0 {
            return said;
        }
        if self.with_alpha > 0 {
            let files = counted(self.with_alpha, "mask file");
            said.push(format!("the alpha channel of {files} is the mask; colors are ignored"));
        }
        match reading {
            MaskReading::Drawn(color) => {
                let shown = color_text(*color);
                said.push(format!(
                    "masks are drawn in {shown} on black, without white: {shown} is taken for white"
                ));
            }
            MaskReading::Above(_) => {
                said.push("all that is not black in masks is head, by `mask.head`".into())
            }
            MaskReading::Values(values) => {
                let values = String::from(MaskHead::Values(values.clone()));
                said.push(format!("mask values {values} are head, by `mask.head`"));
            }
            MaskReading::White => {}
        }
        said
    }

    /// Returns what may be wrong with masks that are read in this way.
    pub fn warnings(&self, reading: &MaskReading) -> Vec<String> {
        let seen: Vec<Tally> = self.tallies.values().copied().collect();
        let gray = levels(&seen).first().filter(|_| reading.is_white()).map(|t| color_text(t.color));
        let text = |gray| {
            format!(
                "large parts of the masks are {gray}, which is read as that opacity; if it means something else, say \
                 what is head: `--set mask.head=255` or `--set mask.head=not-black`"
            )
        };
        gray.map(text).into_iter().collect()
    }

    fn refusal(&self, all: &[Tally], problem: &str, root: &Path) -> Error {
        let black = max_black(all);
        let mut seen: Vec<Tally> = all.iter().filter(|t| brightest(t.color) > black).copied().collect();
        seen.sort_by_key(|t| std::cmp::Reverse((t.even, t.pixels)));
        let visible: u64 = seen.iter().map(|t| t.pixels).sum();
        let few: Vec<Tally> = seen.iter().take(LISTED).copied().collect();
        let named: Vec<String> = few.iter().map(|t| self.value_text(t.color)).collect();
        let more = seen.len() - few.len();
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        // so many that the most frequent ones are a small part: no drawing
        let drawn: u64 = few.iter().map(|t| t.pixels).sum();
        let kind = if 2 * drawn < visible { ", as photographs have" } else { "" };
        let file = shown(&self.example.0, root);
        let message = format!("{problem}: `{file}` and others hold {}{more}{kind}", named.join(", "));
        let wanted = few.iter().take(2).map(|t| self.setting_text(t.color)).collect::<Vec<_>>().join(",");
        // two of very many values are next to nothing
        let values = match kind.is_empty() {
            true => format!("`--set mask.head={wanted}` (those of the values that are head) or "),
            false => String::new(),
        };
        let hint = format!(
            "say what is head: {values}`--set mask.head=not-black`; or give masks in black and white"
        );
        Error::cannot(message, hint)
    }

    fn index(&self, color: [u8; 3]) -> Option<usize> {
        self.palette.iter().position(|entry| *entry == color)
    }

    fn value_text(&self, color: [u8; 3]) -> String {
        let text = color_text(color);
        self.index(color).map_or(text.clone(), |index| format!("index {index} {text}"))
    }

    fn setting_text(&self, color: [u8; 3]) -> String {
        let number = self.index(color).and_then(|index| u8::try_from(index).ok());
        let gray = (chroma(color) == 0).then_some(color[0]);
        number.or(gray).map_or(HeadValue::Color(color), HeadValue::Number).to_string()
    }
}

/// Returns `gray 128`, or `(80, 0, 255)`.
fn color_text(color: [u8; 3]) -> String {
    let [r, g, b] = color;
    if r == g && g == b { format!("gray {r}") } else { format!("({r}, {g}, {b})") }
}

fn shown(file: &Path, root: &Path) -> String {
    file.strip_prefix(root).unwrap_or(file).display().to_string()
}

/// Returns whether any white shows, more than the noise of JPEG makes of an almost white gray.
fn has_white(tallies: &[Tally]) -> bool {
    let is_white = |t: &&Tally| brightest(t.color) >= OPAQUE_ALPHA && chroma(t.color) <= MAX_CHROMA;
    let white: u64 = tallies.iter().filter(is_white).map(|t| t.pixels).sum();
    let visible: u64 = tallies.iter().filter(|t| brightest(t.color) > MAX_BLACK).map(|t| t.pixels).sum();
    white > 0 && 1000 * white >= visible
}

/// Returns the gray that one file is drawn in instead of white, if it covers a hundredth of the
/// picture.
fn gray_of(tallies: &[Tally]) -> Option<u8> {
    let color = drawn_in(tallies, MAX_BLACK).filter(|color| chroma(*color) <= MAX_CHROMA)?;
    let pixels = |is: &dyn Fn(u8) -> bool| {
        tallies.iter().filter(|t| is(brightest(t.color))).map(|t| t.pixels).sum::<u64>()
    };
    let is_large = 100 * pixels(&|v| v > MAX_BLACK) >= pixels(&|_| true);
    (is_large && brightest(color) < ALMOST_WHITE && !has_white(tallies)).then(|| brightest(color))
}

/// Returns the maximum of a channel that is black: none but 0 among labels.
fn max_black(tallies: &[Tally]) -> u8 {
    let within = |from: u8, to: u8| {
        let all = tallies.iter().filter(move |t| (from..=to).contains(&brightest(t.color)));
        all.map(|t| t.pixels).sum::<u64>()
    };
    let labels = within(1, MAX_LABEL);
    let are_labels = within(MAX_LABEL + 1, OPAQUE_ALPHA - 1) == 0 && labels > within(OPAQUE_ALPHA, 255);
    if are_labels { 0 } else { MAX_BLACK }
}

/// Returns the grays between black and white that fill whole areas, if no soft edges explain them.
fn levels(tallies: &[Tally]) -> Vec<Tally> {
    let between = |t: &&Tally| (MAX_LABEL + 1..ALMOST_WHITE).contains(&brightest(t.color));
    let even: u64 = tallies.iter().filter(|t| brightest(t.color) > MAX_BLACK).map(|t| t.even).sum();
    let large = tallies.iter().filter(between).filter(|t| t.is_exact() && 20 * t.even > even);
    large.copied().collect()
}

/// Returns whether grays between black and white are labels of an area. Unknown pixels of a trimap
/// are a band around all white, which then does not touch black.
fn is_area(grays: &[Tally], seen: &[Tally]) -> bool {
    let white = seen.iter().filter(|t| brightest(t.color) >= ALMOST_WHITE);
    let [gray_edges, white_edges] =
        [grays.iter().map(|t| t.edges).sum::<u64>(), white.map(|t| t.edges).sum::<u64>()];
    let is_band = gray_edges > 10 * white_edges;
    let even = |all: &[Tally]| all.iter().map(|t| t.even).sum::<u64>();
    let least = if is_band { 2 } else { 4 };
    least * even(grays) > even(seen)
}

/// Returns the one gray or color that these are drawn in on black, soft edges and the noise of JPEG
/// allowed.
fn drawn_in(tallies: &[Tally], black: u8) -> Option<[u8; 3]> {
    let seen: Vec<&Tally> = tallies.iter().filter(|t| brightest(t.color) > black).collect();
    let most = seen.iter().max_by_key(|t| (t.pixels, std::cmp::Reverse(t.color)))?;
    let color = most.color;
    if brightest(color) <= MAX_LABEL {
        return (seen.len() == 1 && most.is_exact()).then_some(color); // labels have no soft edges
    }
    let noise = if chroma(color) == 0 { NOISE[0] } else { NOISE[1] };
    let (same, others): (Vec<&Tally>, Vec<&Tally>) =
        seen.iter().copied().partition(|t| apart(t.color, color) <= noise);
    let pixels = |of: &[&Tally]| of.iter().map(|t| t.pixels).sum::<u64>() as f64;
    let even = |of: &[&Tally]| of.iter().map(|t| t.even).sum::<u64>() as f64;
    let (all, all_even) = (pixels(&seen), even(&seen));
    // where a picture is too small for even areas, most pixels must have the color
    let share = if all_even > 0.0 { 0.25 } else { 0.5 };
    if pixels(&same) < share * all || even(&same) < MIN_PLATEAU * all_even {
        return None;
    }
    let (beside, along): (Vec<&Tally>, Vec<&Tally>) =
        others.into_iter().partition(|t| off_line(t.color, color) > OFF_LINE);
    let is_area = |t: &Tally, share: f64| t.even as f64 > share * all_even;
    let has_second = beside.iter().any(|t| t.is_exact() && is_area(t, 0.005))
        || even(&beside) > 0.03 * all_even
        || along.iter().any(|t| is_area(t, 0.04));
    (!has_second).then_some(color)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file of 40 × 40 pixels: a frame of black, then rows of these colors.
    fn file(rows: &[[u8; 3]]) -> MaskPicture {
        let color = |i: usize| {
            let (x, y) = (i % 40, i / 40);
            if (8..32).contains(&x) && (8..32).contains(&y) {
                rows[(y - 8) * rows.len() / 24]
            } else {
                [0; 3]
            }
        };
        let rgb = (0..1600).map(color).collect();
        MaskPicture { width: 40, height: 40, rgb, alpha: None, palette: Vec::new() }
    }

    fn surveyed(files: &[MaskPicture]) -> MaskSurvey {
        let mut survey = MaskSurvey::default();
        for (i, picture) in files.iter().enumerate() {
            survey.add(Path::new(&format!("/a/masks/{i}.png")), MaskValues::count(picture), None);
        }
        survey
    }

    fn reading(files: &[MaskPicture]) -> Result<MaskReading> {
        surveyed(files).reading(&MaskHead::White, Path::new("/a"))
    }

    fn refusal(files: &[MaskPicture]) -> String {
        reading(files).unwrap_err().to_string()
    }

    #[test]
    fn pixels_of_nearly_one_color_vote_for_the_most_frequent_one() {
        let values = MaskValues::count(&file(&[[9; 3], [80, 0, 255], [81, 1, 254], [80, 0, 255]]));
        // 24 columns of 6 rows each: 12 rows of (80, 0, 255), 6 of (81, 1, 254) in one tally
        let (_, color) = values.tallies.iter().find(|(_, t)| brightest(t.color) > 200).unwrap();
        assert_eq!((color.pixels, color.votes, color.color), (24 * 18, 24 * 6, [80, 0, 255]));
        assert!(!color.is_exact() && values.tallies.iter().any(|(key, t)| *key == 9 && t.is_exact()));
    }

    #[test]
    fn one_label_in_each_file_is_no_mask_drawn_in_one_gray() {
        let (one, two) = (file(&[[1; 3]]), file(&[[2; 3]]));
        assert_eq!(reading(std::slice::from_ref(&one)).unwrap(), MaskReading::Drawn([1; 3]));
        assert!(refusal(&[one, two]).contains("gray 1, gray 2"));
    }

    #[test]
    fn grays_and_colors_beside_each_other_are_values_and_soft_edges_are_not() {
        for color in [[80, 0, 255], [128, 128, 128], [0, 64, 0]] {
            let soft: Vec<[u8; 3]> =
                (0..24).map(|y: u16| color.map(|c| (u16::from(c) * (y + 1).min(6) / 6) as u8)).collect();
            assert_eq!(reading(&[file(&[color]), file(&soft)]).unwrap(), MaskReading::Drawn(color));
        }
        for rows in [[[128; 3], [200; 3]], [[128, 0, 0], [0, 128, 0]], [[255; 3], [80, 0, 255]]] {
            assert!(refusal(&[file(&rows)]).contains("`masks/0.png` and others hold"), "{rows:?}");
        }
        let shades: Vec<[u8; 3]> = (0..24).map(|y| [200 - 6 * y, 120 - 3 * y, 90 - 2 * y]).collect();
        assert!(refusal(&[file(&shades)]).contains("as photographs have"));
    }

    /// A white square within a frame of gray so wide, on black.
    fn framed(width: usize) -> MaskPicture {
        let mut picture = file(&[[255; 3]]);
        let depth = |i: usize| (i % 40 - 8).min(31 - i % 40).min((i / 40 - 8).min(31 - i / 40));
        for i in 0..picture.rgb.len() {
            if picture.rgb[i] != [0; 3] && depth(i) < width {
                picture.rgb[i] = [128; 3];
            }
        }
        picture
    }

    #[test]
    fn a_gray_beside_white_that_fills_an_area_is_a_label() {
        // part of the head that is gray, beside one that is white
        for rows in [1, 2, 3] {
            let mut colors = [[128; 3]; 4];
            colors[..rows].fill([255; 3]);
            let is_refused = reading(&[file(&colors)]).is_err();
            assert_eq!(is_refused, rows < 3, "{rows} of 4 are white");
        }
        let text = refusal(&[file(&[[255; 3], [128; 3], [128; 3]])]);
        assert!(text.contains("as labels have") && text.contains("gray 128, gray 255"), "{text}");
        // a part within one that is gray
        assert!(reading(&[framed(8)]).is_err());
    }

    #[test]
    fn of_very_many_values_none_is_offered_as_the_head() {
        let shades: Vec<[u8; 3]> = (0..24).map(|y| [200 - 6 * y, 120 - 3 * y, 90 - 2 * y]).collect();
        let error = reading(&[file(&shades)]).unwrap_err();
        let hint = error.hint();
        assert!(hint.contains("mask.head=not-black") && hint.matches("mask.head").count() == 1, "{hint}");
    }

    #[test]
    fn opacity_beside_white_stays_opacity() {
        let soft: Vec<[u8; 3]> = (0..24).map(|y| [255 - 10 * y; 3]).collect();
        let files = [file(&soft), file(&[[255; 3]]), file(&[[0; 3]])];
        assert_eq!(reading(&files).unwrap(), MaskReading::White);
        let trimap = [framed(3)];
        assert_eq!(reading(&trimap).unwrap(), MaskReading::White);
        let said = surveyed(&trimap).warnings(&MaskReading::White);
        assert!(
            matches!(&said[..], [text] if text.contains("gray 128") && text.contains("=255`")),
            "{said:?}"
        );
        assert!(surveyed(&trimap).reasons(&MaskReading::White).is_empty());
        assert_eq!(reading(&[]).unwrap(), MaskReading::White);
        assert!(
            refusal(&[file(&[[255; 3]]), file(&[[128; 3]])]).contains("`masks/1.png` is drawn in gray 128")
        );
    }

    #[test]
    fn opacity_is_how_far_a_color_lies_towards_the_one_taken_for_white() {
        // (40, 0, 127) · (80, 0, 255) = 35,585 of 71,425: 0.4982 of 255 is 127.04
        assert_eq!(projected([40, 0, 127], [80, 0, 255]), 127);
        assert_eq!(projected([80, 0, 255], [80, 0, 255]), 255);
        assert_eq!((projected([12, 0, 14], [80, 0, 255]), projected([1; 3], [1; 3])), (0, 255));
        assert_eq!(projected([255; 3], [128; 3]), 255);
    }

    #[test]
    fn numbers_are_indices_of_colored_palettes_and_grays_elsewhere() {
        let mut picture = file(&[[128, 0, 0], [0, 128, 0], [1; 3], [7; 3]]);
        let count = |picture: &MaskPicture, values: &str| {
            let asked = MaskReading::asked(&MaskHead::try_from(values.to_string()).unwrap());
            asked.read(picture.clone()).values.iter().filter(|&&v| v == 255).count() / (24 * 6)
        };
        assert_eq!((count(&picture, "1"), count(&picture, "1,7"), count(&picture, "#800000")), (1, 2, 1));
        picture.palette = vec![[0; 3], [128, 0, 0], [0, 128, 0]];
        assert_eq!((count(&picture, "1"), count(&picture, "1,2,9"), count(&picture, "not-black")), (1, 2, 2));
        // what is transparent is no head
        picture.alpha = Some(vec![0; 1600]);
        assert_eq!((count(&picture, "1"), count(&picture, "not-black")), (0, 0));
    }
}

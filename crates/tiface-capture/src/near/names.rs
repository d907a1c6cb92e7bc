//! What names say: their endings, what folders are for, and the words that turn a photograph's name
//! into its mask's.

use std::path::Path;
use unicode_normalization::UnicodeNormalization;

/// Endings of photographs, supported ones first.
pub const PHOTOGRAPHS: [&str; 8] = ["png", "jpg", "jpeg", "tif", "tiff", "heic", "webp", "bmp"];

/// Number of supported endings in [`PHOTOGRAPHS`].
pub const READABLE_FORMATS: usize = 3;

/// Usual folders of photographs.
pub const IMAGE_FOLDERS: [&str; 5] = ["images", "image", "input", "rgb", "photos"];

/// Words that a mask's name has besides the photograph's, longer ones before those that they end
/// with.
const MASK_WORDS: [&str; 10] =
    ["segmentation", "silhouette", "masks", "mask", "mattes", "matte", "matting", "alpha", "seg", "pha"];

/// Further words between those and the photograph's name.
const MASK_DETAILS: [&str; 9] =
    ["head", "person", "foreground", "fg", "binary", "soft", "hard", "sam", "vit"];

/// Words that may stand in a photograph's name only, or in both.
const PHOTO_WORDS: [&str; 7] = ["rgb", "image", "img", "color", "photo", "frame", "im"];

/// Beginnings of words of masks of something else than the whole head; `masked` pictures are
/// photographs.
const OTHER_MASKS: [&str; 22] = [
    "face",
    "facial",
    "hair",
    "skin",
    "bg",
    "background",
    "valid",
    "eye",
    "mouth",
    "parsing",
    "masked",
    "beard",
    "cloth",
    "dynamic",
    "glasses",
    "ignore",
    "invalid",
    "motion",
    "nose",
    "occlu",
    "teeth",
    "tooth",
];

/// Such words that are the beginnings of others, as whole words.
const OTHER_PARTS: [&str; 6] = ["body", "brow", "hand", "lip", "neck", "sky"];

/// Beginnings of the names of folders whose pictures are made from photographs, or were put aside.
const ASIDE: [&str; 26] = [
    "foreground",
    "fg",
    "depth",
    "normal",
    "disp",
    "render",
    "thumb",
    "preview",
    "semantic",
    "flow",
    "confidence",
    "albedo",
    "landmark",
    "output",
    "result",
    "pred",
    "unused",
    "reject",
    "trash",
    "backup",
    "distort",
    "crop",
    "resiz",
    "aligned",
    "warp",
    "blur",
];

/// Beginnings of the names of folders whose pictures show neither photographs nor opacity.
const MEASURED: [&str; 10] =
    ["depth", "normal", "disp", "flow", "thumb", "preview", "albedo", "confidence", "landmark", "uncertain"];

/// Returns a name as names are compared: in small letters and composed.
pub fn fold(name: &str) -> String {
    name.to_lowercase().nfc().collect()
}

/// Returns whether a name has one of these endings, ignoring case.
pub fn has_ending(name: &str, endings: &[&str]) -> bool {
    let found = Path::new(name).extension().and_then(|e| e.to_str()).unwrap_or_default();
    endings.iter().any(|e| e.eq_ignore_ascii_case(found))
}

/// Returns a name without the ending of a picture, and that ending; all of it and nothing where it
/// has none.
pub fn without_ending(name: &str) -> (&str, &str) {
    match name.rsplit_once('.') {
        Some((stem, ending)) if !stem.is_empty() && has_ending(name, &PHOTOGRAPHS) => (stem, ending),
        _ => (name, ""),
    }
}

/// Returns whether two folded endings are of one format.
pub fn is_same_format(a: &str, b: &str) -> bool {
    let short = |ending: &str| match ending {
        "jpeg" => "jpg".into(),
        "tiff" => "tif".into(),
        other => other.to_string(),
    };
    short(a) == short(b)
}

/// Returns whether a folder's name says nothing of what its photographs show.
pub fn is_common_name(name: &str) -> bool {
    let others = [
        "imgs",
        "img",
        "photo",
        "photographs",
        "pictures",
        "pics",
        "frames",
        "color",
        "png",
        "jpg",
        "jpeg",
        "raw",
        "dcim",
    ];
    IMAGE_FOLDERS.iter().chain(&others).any(|common| common.eq_ignore_ascii_case(name))
}

fn words(folded: &str) -> impl Iterator<Item = &str> {
    folded.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty())
}

/// Returns whether a folder with this folded name has masks of heads.
pub fn is_mask_folder(folded: &str) -> bool {
    is_like_masks(folded) && !words(folded).any(is_other)
}

/// Returns whether a folded word, such as `face`, `lips` or `lipmask`, says of something else than
/// a head.
fn is_other(word: &str) -> bool {
    let part = ["masks", "mask"].iter().find_map(|end| word.strip_suffix(end)).unwrap_or(word);
    let single = part.strip_suffix('s').unwrap_or(part);
    OTHER_MASKS.iter().any(|other| word.starts_with(other)) || OTHER_PARTS.contains(&single)
}

/// Returns whether a folder with this folded name has masks, be they of heads or of something else.
pub fn is_like_masks(folded: &str) -> bool {
    words(folded).any(|word| {
        let is_short = ["seg", "segs", "pha", "matting"].contains(&word);
        let begins = ["mask", "matte", "alpha", "silhouette", "segment"];
        let ends = ["mask", "masks", "matte", "mattes"];
        is_short || begins.iter().any(|b| word.starts_with(b)) || ends.iter().any(|e| word.ends_with(e))
    })
}

/// Returns whether no photographs are looked for in a folder with this folded name.
pub fn is_aside(folded: &str) -> bool {
    let is_aside = |word: &str| word == "old" || ASIDE.iter().any(|aside| word.starts_with(aside));
    is_like_masks(folded) || words(folded).any(is_aside)
}

/// Returns whether the pictures of a folder with this folded name are depths, normals and the like.
pub fn is_measured(folded: &str) -> bool {
    words(folded).any(|word| MEASURED.iter().any(|other| word.starts_with(other)))
}

/// Returns the factor of a folder of reduced pictures, and what the folder of the whole ones is
/// called: 4 and `images` of `images_4` and `images_4x`.
pub fn reduced(folded: &str) -> Option<(u32, &str)> {
    let (whole, digits) = folded.rsplit_once('_')?;
    let digits = digits.strip_suffix('x').unwrap_or(digits);
    let factor =
        digits.parse().ok().filter(|factor| (2..=64).contains(factor) && !digits.starts_with('0'))?;
    Some((factor, whole))
}

/// Returns a folded name without ending and without one of these words before or behind it. A word
/// of three letters or more may stand directly at a digit.
fn without_word<'n>(stem: &'n str, all: &[&str]) -> Option<&'n str> {
    const BETWEEN: [char; 5] = ['_', '-', '.', ' ', '+'];
    let is_apart = |word: &str, next: Option<char>| {
        next.is_some_and(|c| BETWEEN.contains(&c) || word.len() > 2 && c.is_ascii_digit())
    };
    let before = |word: &str| {
        let rest = stem.strip_suffix(word).filter(|rest| is_apart(word, rest.chars().next_back()))?;
        Some(rest.trim_end_matches(BETWEEN))
    };
    let behind = |word: &str| {
        let rest = stem.strip_prefix(word).filter(|rest| is_apart(word, rest.chars().next()))?;
        Some(rest.trim_start_matches(BETWEEN))
    };
    let rests = all.iter().flat_map(|word| [before(word), behind(word)]);
    rests.flatten().find(|rest| !rest.is_empty())
}

/// Returns the folded name of the photograph that a mask of this folded name, without ending,
/// belongs to, and whether the name has a word of masks: `000` and true of `000_mask` and
/// `mask-000.jpg`.
pub fn bare(stem: &str) -> (&str, bool) {
    let (mut rest, mut is_named) = (stem, false);
    loop {
        let shorter = without_ending(rest).0;
        let with_word = without_word(shorter, &MASK_WORDS);
        let detail = || without_word(shorter, &MASK_DETAILS).filter(|_| is_named);
        match with_word.or_else(detail) {
            Some(less) => (rest, is_named) = (less, true),
            None => return (shorter, is_named),
        }
    }
}

/// Returns the folded name of the view that a file of valid pixels, `.npy` or a picture, belongs
/// to.
pub fn without_valid(name: &str) -> &str {
    let stem = name.strip_suffix(".npy").unwrap_or(without_ending(name).0);
    without_word(stem, &["valid"]).unwrap_or(stem)
}

/// Returns what is left of [`bare`] without words of photographs.
pub fn without_words(stem: &str) -> &str {
    let bare = bare(stem).0;
    without_word(bare, &PHOTO_WORDS).unwrap_or(bare)
}

/// Returns whether there are digits and nothing else.
pub fn is_number(name: &str) -> bool {
    !name.is_empty() && name.bytes().all(|b| b.is_ascii_digit())
}

/// Returns what is left of [`without_words`] without leading zeros of a number.
pub fn plain(stem: &str) -> &str {
    let plain = without_words(stem);
    if !is_number(plain) {
        return plain;
    }
    let digits = plain.trim_start_matches('0');
    if digits.is_empty() { "0" } else { digits }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_masks_name_leads_to_its_photograph_whatever_word_it_has() {
        for name in [
            "000_mask",
            "000-mask",
            "000.mask",
            "000mask",
            "mask_000",
            "mask000",
            "000_alpha",
            "000_matte",
            "000_seg",
            "000.jpg_mask",
            "000_mask.jpg",
            "000_head_mask",
            "000_fg_mask",
        ] {
            assert_eq!(bare(name), ("000", true), "{name}");
        }
        // words alone, and words that are parts of others, are names
        for name in ["000", "000.jpg", "mask", "offseg", "alphabet_1", "000_fg"] {
            assert_eq!(bare(name), (without_ending(name).0, false), "{name}");
        }
        assert_eq!(
            (plain("rgb_0010"), plain("mask_10"), plain("000"), plain("left")),
            ("10", "10", "0", "left")
        );
    }

    #[test]
    fn folders_say_what_their_pictures_are() {
        for name in
            ["mask", "masks", "mattes", "alpha", "fg_masks", "seg_masks", "matting", "alpha_map", "headmasks"]
        {
            assert!(is_mask_folder(name) && is_aside(name), "{name}");
        }
        for name in ["face_masks", "bg_masks", "images", "masked", "unmasked", "left"] {
            assert!(!is_mask_folder(name), "{name}");
        }
        for name in ["lip_masks", "lipmask", "masks_hands", "dynamic_masks", "neck-mask", "occlusion_masks"] {
            assert!(!is_mask_folder(name) && is_aside(name), "{name}");
        }
        for name in ["somebody_masks", "handmade_masks", "clip_masks", "brown_masks", "skyler_mask"] {
            assert!(is_mask_folder(name), "{name}");
        }
        for (name, is) in [("depth_maps", true), ("normals", true), ("images", false), ("cam 01", false)] {
            assert_eq!(is_aside(name), is, "{name}");
        }
        for (name, is) in [("images_distorted", true), ("undistorted", false), ("old", true), ("gold", false)]
        {
            assert_eq!(is_aside(name), is, "{name}");
        }
        assert!(is_measured("depth_maps") && !is_measured("output") && !is_measured("parsing_masks"));
        assert_eq!((reduced("images_4"), reduced("images_8x")), (Some((4, "images")), Some((8, "images"))));
        assert_eq!((reduced("cam_01"), reduced("images"), reduced("a_1")), (None, None, None));
    }

    #[test]
    fn names_are_compared_composed_and_in_small_letters() {
        assert_eq!(fold("Zoe\u{308}.JPG"), "zo\u{eb}.jpg");
        assert_eq!(without_ending("a.b.Jpeg"), ("a.b", "Jpeg"));
        assert_eq!(without_ending(".png"), (".png", ""));
        assert!(is_same_format("jpeg", "jpg") && !is_same_format("png", "jpg"));
    }
}

//! Errors that several parts of a capture can have.

use crate::Error;
use std::fmt::Display;
use std::path::Path;

/// A camera file lacks what it must have.
pub(super) fn in_file(file: &str, problem: impl Display, hint: impl Into<String>) -> Error {
    Error::cannot(problem, hint).within(format_args!("`{file}`"))
}

/// One frame of a camera file is wrong; it is named by its photograph, or its number if it has none.
pub(super) fn in_frame(file: &str, frame: &str, problem: impl Display) -> Error {
    let place = format_args!("`{file}`, frame `{frame}`");
    Error::cannot(problem, "correct that frame, or remove it").within(place)
}

/// A name leads out of the capture.
pub(super) fn outside(file: &str, name: &str) -> Error {
    Error::cannot(
        format_args!("`{file}` names `{name}`, which is outside the capture"),
        "copy the file into the capture, or give the folder that holds both",
    )
}

/// There is nothing to learn from.
pub(super) fn no_views(root: &Path, found: &str) -> Error {
    Error::cannot(
        format_args!("`{}` has no usable view: {found}", root.display()),
        "put the photographs where the camera file says they are, relative to the capture",
    )
}

/// A picture's size is not the one that `file` declares; the factor between the two is the suggested fix.
pub(super) fn wrong_size(
    picture: &str,
    found: (u32, u32),
    declared: (u32, u32),
    file: &str,
    downscale: u32,
) -> Error {
    let factor = declared.0 / found.0.max(1);
    let hint = if factor > 1 && (declared.0 / factor, declared.1 / factor) == found {
        format!("use the full-size photographs, or set `capture.downscale = {factor}`")
    } else if downscale > 1 {
        format!("use photographs of that size, or smaller by exactly `capture.downscale = {downscale}`")
    } else if (found.1, found.0) == declared {
        "the photograph lies on its side: store it upright, without an EXIF turn".into()
    } else {
        format!("use photographs of that size, or correct `w` and `h` in `{file}`")
    };
    let ((w, h), (dw, dh)) = (found, declared);
    Error::cannot(format_args!("`{picture}` is {w} × {h} pixels, but `{file}` says {dw} × {dh}"), hint)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_photograph_four_times_too_small_is_told_how_to_be_used() {
        let e = wrong_size("images/cam_07.jpg", (750, 1024), (3000, 4096), "transforms_train.json", 1);
        assert_eq!(
            e.to_string(),
            "`images/cam_07.jpg` is 750 × 1024 pixels, but `transforms_train.json` says 3000 × 4096"
        );
        assert_eq!(e.hint(), "use the full-size photographs, or set `capture.downscale = 4`");
    }
}

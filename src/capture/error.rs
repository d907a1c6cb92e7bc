//! What can be wrong with a capture.

use crate::io::ReadError;
use std::path::PathBuf;

/// Why a capture cannot be used as it is.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// A file could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The folder is of no known format.
    #[error("`{}` is not a capture: {seen}", root.display())]
    NotACapture {
        /// The folder.
        root: PathBuf,
        /// What was looked for, or seen instead.
        seen: String,
        /// The way out.
        hint: String,
    },
    /// A camera file lacks what it must have.
    #[error("`{file}`: {problem}")]
    Structure {
        /// The camera file.
        file: String,
        /// What is wrong.
        problem: String,
        /// The way out.
        hint: String,
    },
    /// One frame of a camera file is wrong.
    #[error("`{file}`, frame `{frame}`: {problem}")]
    Frame {
        /// The camera file.
        file: String,
        /// The frame's name, or its number if it has none.
        frame: String,
        /// What is wrong.
        problem: String,
        /// The way out.
        hint: String,
    },
    /// A picture's size is not the declared one.
    #[error(
        "`{picture}` is {} × {} pixels, but `{file}` says {} × {}",
        found.0, found.1, declared.0, declared.1
    )]
    Size {
        /// The picture, relative to the capture.
        picture: String,
        /// Its width and height.
        found: (u32, u32),
        /// What was expected.
        declared: (u32, u32),
        /// Who expects it.
        file: String,
        /// The way out.
        hint: String,
    },
    /// A name leads out of the capture.
    #[error("`{file}` names `{name}`, which is outside the capture")]
    Outside {
        /// The camera file.
        file: String,
        /// The name as written.
        name: String,
    },
    /// Two photographs would give results of the same name.
    #[error("`{file}`: `{first}` and `{second}` would both be called `{name}`")]
    SameName {
        /// The camera file.
        file: String,
        /// The common name.
        name: String,
        /// The first photograph as written.
        first: String,
        /// The second.
        second: String,
    },
    /// The head masks that were asked for are not there.
    #[error("`{}`: {problem}", root.display())]
    NoMasks {
        /// The capture.
        root: PathBuf,
        /// What is missing, and what that means.
        problem: String,
        /// The ways out.
        hint: String,
    },
    /// Nothing to learn from.
    #[error("`{}` has no usable view: {found}", root.display())]
    NoViews {
        /// The capture.
        root: PathBuf,
        /// What there is instead.
        found: String,
    },
    /// Two camera files describe different cameras.
    #[error("`{poses}` and `{json}` disagree about frame `{frame}`: {problem}")]
    PosesDisagree {
        /// The LLFF file.
        poses: String,
        /// The JSON file.
        json: String,
        /// The frame that disagrees most.
        frame: String,
        /// By how much.
        problem: String,
    },
    /// An option makes no sense.
    #[error("{problem}")]
    Option {
        /// Which and why.
        problem: String,
    },
}

crate::error::error_from!(CaptureError, Cannot);

impl CaptureError {
    /// A size that is not the declared one, with the factor between the two as the way out.
    pub(crate) fn size(
        picture: String,
        found: (u32, u32),
        declared: (u32, u32),
        file: String,
        downscale: u32,
    ) -> CaptureError {
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
        CaptureError::Size { picture, found, declared, file, hint }
    }

    /// What of the message is another for each frame or file that has the same problem.
    pub(super) fn subject(&self) -> Option<String> {
        match self {
            CaptureError::Frame { frame, .. } => Some(frame.clone()),
            CaptureError::Size { picture, .. } => Some(picture.clone()),
            CaptureError::Outside { name, .. } => Some(name.clone()),
            CaptureError::Read(e) => Some(e.path().display().to_string()),
            _ => None,
        }
    }

    /// The way out.
    pub fn hint(&self) -> String {
        match self {
            CaptureError::Read(e) => e.hint(),
            CaptureError::NotACapture { hint, .. }
            | CaptureError::Structure { hint, .. }
            | CaptureError::Frame { hint, .. }
            | CaptureError::Size { hint, .. }
            | CaptureError::NoMasks { hint, .. } => hint.clone(),
            CaptureError::Outside { .. } => {
                "copy the file into the capture, or give the folder that holds both".into()
            }
            CaptureError::SameName { .. } => "rename one of the photographs, or remove one frame".into(),
            CaptureError::NoViews { .. } => {
                "put the photographs where the camera file says they are, relative to the capture".into()
            }
            CaptureError::PosesDisagree { poses, .. } => {
                format!("remove the file that is wrong; without `{poses}` the JSON is used alone")
            }
            CaptureError::Option { .. } => "choose a whole factor of at least 1 and a positive unit".into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_photograph_four_times_too_small_is_told_how_to_be_used() {
        let e = CaptureError::size(
            "images/cam_07.jpg".into(),
            (750, 1024),
            (3000, 4096),
            "transforms_train.json".into(),
            1,
        );
        assert_eq!(
            e.to_string(),
            "`images/cam_07.jpg` is 750 × 1024 pixels, but `transforms_train.json` says 3000 × 4096"
        );
        assert_eq!(e.hint(), "use the full-size photographs, or set `capture.downscale = 4`");
    }
}

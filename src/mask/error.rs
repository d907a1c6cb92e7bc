//! What can be wrong with clicks.

/// Why no mask can be cut.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CutError {
    /// A click is not on the photograph.
    #[error(
        "view `{view}`: click {number} at ({x}, {y}) is outside the photograph of {width} × {height} pixels"
    )]
    OutsidePhoto {
        /// The view.
        view: String,
        /// Which click, counted from 1.
        number: usize,
        /// Its column.
        x: f32,
        /// Its row.
        y: f32,
        /// Width of the photograph.
        width: u32,
        /// Height of the photograph.
        height: u32,
    },
    /// There are no clicks.
    #[error("view `{view}` has no clicks")]
    NoClicks {
        /// The view.
        view: String,
    },
    /// All clicks are on views that are held out, which shape no mask but their own.
    #[error("the clicks are all on held-out views ({}), which may not shape the masks of others", .views.join(", "))]
    OnlyHeldOut {
        /// Their names.
        views: Vec<String>,
    },
    /// No click says what the head is.
    #[error("view `{view}`: all {clicks} clicks are on the background, none is on the head")]
    NoHead {
        /// The view.
        view: String,
        /// How many clicks there are.
        clicks: usize,
    },
    /// One pixel is said to be both.
    #[error("view `{view}`: clicks {first} and {second} call the same pixel ({x}, {y}) head and background")]
    Contradiction {
        /// The view.
        view: String,
        /// One click, counted from 1.
        first: usize,
        /// The other.
        second: usize,
        /// Column of the pixel.
        x: u32,
        /// Row of the pixel.
        y: u32,
    },
    /// The photograph is too small to have colours of two things.
    #[error("view `{view}`: a photograph of {width} × {height} pixels is too small to be cut")]
    TooSmall {
        /// The view.
        view: String,
        /// Its width.
        width: u32,
        /// Its height.
        height: u32,
    },
    /// Nothing of the clicked head was left.
    #[error("view `{view}`: the cut left nothing of the head")]
    Empty {
        /// The view.
        view: String,
    },
    /// Nothing says where the cameras look.
    #[error("the {cameras} cameras {how}, so clicks cannot be propagated from one view to another")]
    CamerasAlike {
        /// How many cameras.
        cameras: usize,
        /// What they share.
        how: &'static str,
    },
    /// A photograph is not its camera's.
    #[error("view `{view}`: the photograph is {} × {} pixels, its camera {} × {}", found.0, found.1, camera.0, camera.1)]
    Size {
        /// The view.
        view: String,
        /// The photograph's size.
        found: (u32, u32),
        /// The camera's.
        camera: (u32, u32),
    },
}

crate::error::error_from!(CutError, Cannot);

impl CutError {
    /// The way out.
    pub fn hint(&self) -> &'static str {
        match self {
            CutError::OutsidePhoto { .. } => {
                "coordinates are pixels of the photograph as stored, x right and y down from the top left; were the \
                 clicks made on a photograph of another size?"
            }
            CutError::NoClicks { .. } => {
                "click the face, the hair and each part of the garment (label 1), and twice the background (label 0)"
            }
            CutError::NoHead { .. } => {
                "add clicks on the face, the hair and the garment: label 1 is the head, 0 the background"
            }
            CutError::OnlyHeldOut { .. } => {
                "click on photographs that are trained on; `tiface inspect CAPTURE --json` tells which are"
            }
            CutError::Contradiction { .. } => "remove the wrong one of the two clicks",
            CutError::TooSmall { .. } => "give a photograph of at least 16 × 16 pixels",
            CutError::Empty { .. } => {
                "click more of the head: its face, hair and each part of the garment, and the background beside it"
            }
            CutError::CamerasAlike { .. } => {
                "click every view, or check that each frame has its own pose and cameras look from different sides"
            }
            CutError::Size { .. } => "use photographs of the size their cameras were calibrated for",
        }
    }
}

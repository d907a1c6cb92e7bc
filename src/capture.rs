//! What was photographed, from where: a folder of photographs of one head with calibrated cameras.
//!
//! [`open`] recognizes the format, checks every name, size and pose before anything is trained, and
//! leaves the world as the dataset has it. [`View::load`] brings one photograph with its masks into
//! memory; [`scene`] says where the head is; [`inspect`] reports everything that can be found wrong.
//!
//! ```
//! use tiface::capture::{self, CaptureOptions, Split, synthetic};
//!
//! let folder = tempfile::tempdir()?;
//! let options = synthetic::SyntheticOptions { width: 24, height: 30, train: 4, test: 1, seed: 1 };
//! synthetic::write_capture(folder.path(), &options)?;
//!
//! let capture = capture::open(folder.path(), &CaptureOptions::default())?;
//! assert_eq!(capture.split(Split::Train).count(), 4);
//! let view = &capture.views[0];
//! let pixels = view.load(&Default::default())?;
//! assert_eq!((view.name.as_str(), pixels.photo.width, pixels.photo.height), ("000", 24, 30));
//! assert_eq!(pixels.mask.unwrap().values.len(), 24 * 30);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub(crate) mod carve;
mod colmap;
pub mod convert;
mod folder;
mod format;
mod frame;
mod gather;
pub mod inspect;
mod llff;
mod masks;
mod metashape;
mod neus;
mod realitycapture;
pub mod scene;
pub mod synthetic;
mod transforms;
mod view;

pub use crate::config::{MaskMeaning, MaskSource};
pub use format::is_run;
pub use gather::{has_cameras, open};
pub use masks::{MASK_HINT, coverage, findings, refuse, require_masks};
pub use scene::well_seen;
pub(crate) use transforms::camera_like;
pub use view::{Capture, CaptureOptions, LoadedView, Split, View, ViewMask};

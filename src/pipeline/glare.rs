//! The glare of lamps, measured on the dark background of a light stage, that a run takes out of
//! the training photographs.
//!
//! The stage `mask` measures it and writes `glare.json`, if there is any; later stages read
//! training photographs without it. Held-out photographs, which the metrics compare views with,
//! keep theirs.

use super::rig_photos::RigPhotos;
use std::path::Path;
use tiface_base::Result;
use tiface_base::image::{Glare, Gray, Photo};
use tiface_base::io::{self, Limits, ReadError};
use tiface_capture::{Capture, Split};

/// File name of the measurement, in the folder of the stage `mask`.
pub(super) const GLARE: &str = "glare.json";

/// The finding in words.
pub(super) const FOUND: &str = "lamps behind the head shed glare on it";

/// The largest weight that is believed.
const LARGEST_WEIGHT: f32 = 10.0;

/// Returns the glare of the training photographs, if it can be told from other light, and takes it
/// out of all `photos`. Photographs with unusable pixels are not measured: these may be bright.
pub(super) fn measure(photos: &mut RigPhotos) -> Option<Glare> {
    let whole = photos.views.iter().zip(&photos.pictures).take(photos.train);
    let whole: Vec<(Photo, Gray)> =
        whole.filter(|(view, _)| view.valid.is_none()).map(|(_, picture)| picture.clone()).collect();
    let glare = Glare::measure(&whole).filter(is_believed)?;
    for (photo, mask) in &mut photos.pictures {
        *photo = glare.taken_out(photo.clone(), mask);
    }
    Some(glare)
}

fn is_believed(glare: &Glare) -> bool {
    glare.weights.iter().all(|w| (0.0..=LARGEST_WEIGHT).contains(w))
}

/// Writes the measurement into the folder of the stage `mask`.
pub(super) fn write(glare: &Glare, folder: &Path) -> Result<()> {
    let text = serde_json::to_string_pretty(glare).unwrap_or_default();
    Ok(io::write_atomic(&folder.join(GLARE), format!("{text}\n").as_bytes())?)
}

/// Reads the file of [`write`], if there is one; weights that it cannot have written are refused.
pub(super) fn read(folder: &Path) -> Result<Option<Glare>, ReadError> {
    let path = folder.join(GLARE);
    if !io::is_file(&path) {
        return Ok(None);
    }
    let glare: Glare = io::read_typed(&path, &Limits::default())?;
    if !is_believed(&glare) {
        let expected = format!("numbers from 0 to {LARGEST_WEIGHT}");
        return Err(ReadError::value(&path, "weights", format!("{:?}", glare.weights), &expected));
    }
    Ok(Some(glare))
}

/// Has glare taken out of the training photographs of a capture.
pub(super) fn apply(glare: Glare, capture: &mut Capture) {
    let train = capture.views.iter_mut().filter(|view| view.split == Split::Train);
    train.for_each(|view| view.glare = Some(glare));
}

//! `tiface cameras`: finds the cameras of photographs, or of frames of a video, with COLMAP.

use super::Invocation;
use super::screen::print;
use crate::pipeline::capture_options;
use clap::Args;
use std::path::PathBuf;
use tiface_base::{Error, Result};
use tiface_capture::sfm::{Search, SfmOptions, default_folder};

/// Options of `cameras`.
#[derive(Args, Debug)]
pub(super) struct CamerasOptions {
    /// Folder of photographs, or with photographs in images/ and masks in masks/
    #[arg(required_unless_present = "video")]
    photographs: Option<PathBuf>,
    /// Use frames of a video instead; needs FFmpeg
    #[arg(long, value_name = "FILE", conflicts_with = "photographs")]
    video: Option<PathBuf>,
    /// Keep the sharpest of every N frames of the video
    #[arg(long, value_name = "N", default_value_t = 10, requires = "video")]
    #[arg(value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Calibrate a lens for each photograph, as for a rig [default: one, where sizes and EXIF focal
    /// lengths agree]
    #[arg(long)]
    lens_each: bool,
    /// Map with GLOMAP instead of COLMAP's mapper: COLMAP 4 has it, an older one needs GLOMAP
    /// beside it
    #[arg(long)]
    glomap: bool,
}

pub(super) fn run(invocation: &Invocation, options: &CamerasOptions) -> Result<()> {
    let (common, screen) = (invocation.common, &invocation.screen);
    let capture = capture_options(&common.resolve(None, None, &[])?);
    let named = options.video.as_ref().or(options.photographs.as_ref());
    let from = named.ok_or_else(|| Error::usage("no photographs are named", "name their folder"))?;
    let out = common.out.clone().unwrap_or_else(|| default_folder(from, options.video.is_some()));
    let (shown, source) = (out.display().to_string(), from.display());
    let sfm = SfmOptions {
        out,
        lens_each: options.lens_each,
        glomap: options.glomap,
        limits: capture.limits.clone(),
        say: &|line| screen.note("cameras", line),
        stop: &|| invocation.stop.requested().is_some(),
    };
    let search = match &options.video {
        Some(video) => Search::of_video(video, options.every as usize, &sfm),
        None => Search::of_photographs(from, &capture, &sfm),
    }?;
    let is_done = search.is_done();
    if common.dry_run {
        let text = if is_done {
            format!("`{shown}` is done: nothing would change")
        } else {
            format!("would copy `{source}` to `{shown}`, and run COLMAP in it")
        };
        screen.note("cameras", &text);
        return Ok(());
    }
    let found = search.run().map_err(|e| match invocation.stop.requested() {
        Some(exit) => e.with_kind(exit),
        None => e,
    })?;
    found.warnings.iter().for_each(|text| screen.note("cameras: warning", text));
    if common.json {
        return print(&format!("{}\n", serde_json::to_string(&found).unwrap_or_default()));
    }
    let (registered, photographs, error) = (found.registered, found.photographs, found.error_px);
    let done = if is_done { "done: " } else { "" };
    let text = format!(
        "{done}{registered} of {photographs} photographs, mean reprojection error {error:.2} pixels, scale unknown: \
         next, `tiface inspect {shown}`"
    );
    screen.note("cameras", &text);
    print(&format!("{shown}\n"))
}

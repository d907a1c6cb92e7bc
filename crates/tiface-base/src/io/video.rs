//! Frames of a video, as FFmpeg decodes it.

use super::limits::Limits;
use super::lock::Lock;
use super::program::{Program, ProgramFailure};
use super::read_error::ReadError;
use crate::image::Photo;
use crate::{Error, Result};
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::ChildStdout;

/// The frames of a video in their order, each decoded when it is asked for.
pub struct VideoFrames {
    program: Option<Program>,
    output: BufReader<ChildStdout>,
    video: PathBuf,
    limits: Limits,
}

impl VideoFrames {
    /// Begins to decode a video with `ffmpeg`, whose messages are appended to `log`, in a folder
    /// whose lock is held. The turn that the video asks for is applied.
    pub fn open(
        ffmpeg: &Path,
        video: &Path,
        log: &Path,
        lock: &Lock,
        limits: &Limits,
    ) -> Result<VideoFrames> {
        // counted again and at a fixed rate, so that FFmpeg neither repeats frames nor leaves any
        // out
        let words = "-vf settb=1/25,setpts=N -r 25 -pix_fmt rgb24 -c:v ppm -f image2pipe -";
        let before = "-nostdin -hide_banner -loglevel warning -protocol_whitelist file -i";
        let mut arguments: Vec<OsString> = before.split(' ').map(OsString::from).collect();
        // a name such as `20260101-12:30.mp4` would be the address of a host otherwise
        let mut address = OsString::from("file:");
        address.push(video);
        arguments.push(address);
        arguments.extend(words.split(' ').map(OsString::from));
        let mut program = Program::start(ffmpeg, &arguments, log, lock, true)?;
        let Some(output) = program.child.stdout.take() else {
            return Err(Error::cannot("FFmpeg has no output", ""));
        };
        let output = BufReader::with_capacity(1 << 20, output);
        Ok(VideoFrames { program: Some(program), output, video: video.into(), limits: limits.clone() })
    }
}

impl Iterator for VideoFrames {
    type Item = Result<Photo>;

    fn next(&mut self) -> Option<Result<Photo>> {
        match read_ppm(&mut self.output, &self.video, &self.limits) {
            Ok(Some(photo)) => Some(Ok(photo)),
            Ok(None) => {
                let wrong = self.program.take()?.wait(&|| false);
                let explain = |wrong: ProgramFailure| {
                    let (video, status) = (self.video.display(), wrong.status);
                    let what = format!("`{video}`: FFmpeg cannot decode it to its end ({status})");
                    Error::cannot(
                        what,
                        "its messages are in the log; convert the video, or cut it before that place",
                    )
                };
                wrong.map(|wrong| wrong.map(|w| Err(explain(w)))).unwrap_or_else(|e| Some(Err(e)))
            }
            Err(e) => Some(Err(e.into())),
        }
    }
}

/// Reads one binary PPM picture of 8 bits; `None` where the input ends before it.
fn read_ppm(input: &mut impl BufRead, video: &Path, limits: &Limits) -> Result<Option<Photo>, ReadError> {
    let io = |e| ReadError::io(video, e);
    let bad = |text: &str| ReadError::damaged(video, "PPM", None, text);
    let mut header = Vec::new();
    // `P6`, width and height, the greatest value: as FFmpeg writes it, a line each
    for _ in 0..3 {
        input.by_ref().take(64).read_until(b'\n', &mut header).map_err(io)?;
    }
    if header.is_empty() {
        return Ok(None);
    }
    let words: Vec<&str> = std::str::from_utf8(&header).unwrap_or_default().split_whitespace().collect();
    let side = |k: usize| words.get(k).and_then(|w| w.parse::<u32>().ok()).filter(|&side| side > 0);
    let (Some(&"P6"), Some(width), Some(height), Some(&"255")) =
        (words.first(), side(1), side(2), words.get(3))
    else {
        return Err(bad("FFmpeg's output is no sequence of 8-bit PPM pictures"));
    };
    limits.check_side(video, width.max(height).into())?;
    limits.check_decoded(video, 3 * u64::from(width) * u64::from(height))?;
    let mut rgb = vec![[0; 3]; width as usize * height as usize];
    input.read_exact(rgb.as_flattened_mut()).map_err(io)?;
    Ok(Some(Photo { width, height, rgb, alpha: None }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_follow_each_other_in_a_stream_and_a_cut_one_is_an_error() {
        let bytes = b"P6\n2 1\n255\nabcdefP6\n1 1\n255\nxyzP6\n1 1\n255\nx";
        let (mut input, limits) = (&bytes[..], Limits::default());
        let mut next = || read_ppm(&mut input, Path::new("v.mp4"), &limits);
        let first = next().unwrap().unwrap();
        assert_eq!((first.width, first.height, &first.rgb[..]), (2, 1, &[*b"abc", *b"def"][..]));
        assert_eq!(next().unwrap().unwrap().rgb, [*b"xyz"]);
        assert!(next().is_err());
        for wrong in
            ["P5\n1 1\n255\nx", "P6\n0 1\n255\n", "P6\n1 1\n65535\nabcdef", "P6\n9999999 9999999\n255\n"]
        {
            assert!(read_ppm(&mut wrong.as_bytes(), Path::new("v.mp4"), &limits).is_err(), "{wrong}");
        }
        assert!(read_ppm(&mut &b""[..], Path::new("v.mp4"), &limits).unwrap().is_none());
    }
}

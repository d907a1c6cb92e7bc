//! Other programs: where they are, and how they run with their messages in a log. Frames of a video, as FFmpeg decodes it.

use super::read::{Limits, ReadError};
use crate::image::Photo;
use crate::{Error, Result};
use std::ffi::OsString;
use std::fs::OpenOptions;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::Duration;

/// How often a running program is polled.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Returns the file that a shell would run by this name: the first on `PATH`.
pub fn find_program(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let endings: &[&str] = if cfg!(windows) { &[".exe", ".bat"] } else { &[""] };
    let in_folder = |folder: PathBuf| endings.iter().map(move |e| folder.join(format!("{name}{e}")));
    std::env::split_paths(&path).flat_map(in_folder).find(|file| is_program(file))
}

#[cfg(unix)]
fn is_program(file: &Path) -> bool {
    use rustix::fs::{Access, access};
    super::is_file(file) && access(file, Access::EXEC_OK).is_ok()
}

#[cfg(not(unix))]
fn is_program(file: &Path) -> bool {
    super::is_file(file)
}

/// A running program; it is killed when this is dropped.
pub struct Program(Child);

impl Program {
    /// Starts a program without input. What it prints is appended to `log`; only its messages if its output is `piped`.
    pub fn start(file: &Path, arguments: &[OsString], log: &Path, piped: bool) -> Result<Program> {
        let cannot = |place: &Path, e: std::io::Error| {
            Error::cannot(format!("`{}` cannot be run: {e}", file.display()), "")
                .within(format_args!("`{}`", place.display()))
        };
        let log_file = || OpenOptions::new().append(true).create(true).open(log).map_err(|e| cannot(log, e));
        let output = if piped { Stdio::piped() } else { log_file()?.into() };
        let mut command = Command::new(file);
        // COLMAP is a program with windows, which are not needed for its commands
        command.args(arguments).env("QT_QPA_PLATFORM", "offscreen");
        command.stdin(Stdio::null()).stdout(output).stderr(log_file()?);
        command.spawn().map(Program).map_err(|e| cannot(file, e))
    }

    /// Waits for its end, and returns what is wrong with it, if anything. `stop` ends it.
    pub fn wait(mut self, stop: &dyn Fn() -> bool) -> Result<Option<String>> {
        let stopped = || Err(Error::stopped("before its end").with_hint(""));
        loop {
            match self.0.try_wait() {
                Ok(Some(status)) if status.success() => return Ok(None),
                Ok(Some(status)) => {
                    // Ctrl-C ends both; what asked for the stop may be heard of a little later
                    std::thread::sleep(2 * POLL_INTERVAL);
                    return if stop() { stopped() } else { Ok(Some(status.to_string())) };
                }
                Ok(None) if stop() => return stopped(),
                Ok(None) => std::thread::sleep(POLL_INTERVAL),
                Err(e) => return Err(Error::cannot(format!("a program cannot be waited for: {e}"), "")),
            }
        }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // both fail if it has ended, which is what they are for
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The frames of a video in their order, each decoded when it is asked for.
pub struct VideoFrames {
    program: Option<Program>,
    output: BufReader<ChildStdout>,
    video: PathBuf,
    limits: Limits,
}

impl VideoFrames {
    /// Begins to decode a video with `ffmpeg`, whose messages are appended to `log`. The turn that the video asks for is
    /// applied.
    pub fn open(ffmpeg: &Path, video: &Path, log: &Path, limits: &Limits) -> Result<VideoFrames> {
        // counted anew and at a fixed rate, so that FFmpeg neither repeats frames nor leaves any out
        let words = "-vf settb=1/25,setpts=N -r 25 -pix_fmt rgb24 -c:v ppm -f image2pipe -";
        let mut arguments: Vec<OsString> =
            "-nostdin -hide_banner -loglevel warning -i".split(' ').map(OsString::from).collect();
        arguments.push(video.into());
        arguments.extend(words.split(' ').map(OsString::from));
        let mut program = Program::start(ffmpeg, &arguments, log, true)?;
        let Some(output) = program.0.stdout.take() else {
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
                let explain = |wrong: String| {
                    let what =
                        format!("`{}`: FFmpeg cannot decode it to its end ({wrong})", self.video.display());
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

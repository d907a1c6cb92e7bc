//! Other programs: where they are, and how they run with their messages in a log. Frames of a
//! video, as FFmpeg decodes it.

use super::lock::Lock;
use super::write::WriteError;
use crate::{Error, Result};
use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

/// How often a running program is polled.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// How long the last messages of a program that has ended are waited for.
const MESSAGES_TIMEOUT: Duration = Duration::from_secs(2);

/// How long a program may take to print its help.
const HELP_TIMEOUT: Duration = Duration::from_secs(20);

/// Most bytes of a help that are read.
const MAX_HELP_BYTES: u64 = 1 << 20;

/// Most bytes of a log, whatever a program says, so that it cannot fill a disk.
const MAX_LOG_BYTES: u64 = 32 << 20;

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

/// Returns what a program prints that does nothing else, such as its help, however it ends; `None`
/// where it cannot be run, takes too long, or is to `stop`.
pub fn help_of(file: &Path, arguments: &[&str], stop: &dyn Fn() -> bool) -> Option<String> {
    let (printed, writer) = std::io::pipe().ok()?;
    let mut command = Command::new(file);
    command.args(arguments).env("QT_QPA_PLATFORM", "offscreen");
    command.stdin(Stdio::null()).stdout(writer.try_clone().ok()?).stderr(writer);
    bind(&mut command);
    let mut child = command.spawn().ok()?;
    drop(command); // which has the pipe, so that it would not end
    let (sender, received) = mpsc::channel();
    let read = move || {
        let mut bytes = Vec::new();
        let whole = printed.take(MAX_HELP_BYTES).read_to_end(&mut bytes);
        drop(sender.send(whole.map(|_| bytes)));
    };
    // without a thread the channel is closed
    drop(std::thread::Builder::new().name("help".into()).spawn(read));
    let deadline = Instant::now() + HELP_TIMEOUT;
    let bytes = loop {
        match received.recv_timeout(POLL_INTERVAL) {
            Ok(read) => break read.ok(),
            Err(RecvTimeoutError::Timeout) if Instant::now() < deadline && !stop() => {}
            Err(_) => break None,
        }
    };
    // all fail if it has ended
    kill_group(&child);
    let _ = child.kill();
    let _ = child.wait();
    bytes.map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
}

/// A running program; it is killed when this is dropped, with those that it started.
///
/// On Linux it dies with the thread that started it. Wherever it outlives this process, such as a
/// program that it started, it holds the lock of the folder that it works in.
pub struct Program {
    pub(super) child: Child,
    log: PathBuf,
    /// Receives how the copying of its messages to the log ended.
    copied: Receiver<std::io::Result<()>>,
    has_ended: bool,
}

/// How a program failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProgramFailure {
    /// Its exit status, in words.
    pub status: String,
    /// Whether it was killed or crashed, instead of ending itself.
    pub is_crash: bool,
}

impl From<ExitStatus> for ProgramFailure {
    fn from(status: ExitStatus) -> ProgramFailure {
        // a shell that runs it reports signal n as 128 + n; Windows reports an exception as a
        // negative number
        let is_crash = status.code().is_none_or(|code| code < 0 || (129..=192).contains(&code));
        ProgramFailure { status: status.to_string(), is_crash }
    }
}

impl Program {
    /// Starts a program without input in a folder whose lock is held. What it prints is appended to
    /// `log`; only its messages if its output is `piped`.
    pub fn start(
        file: &Path,
        arguments: &[OsString],
        log: &Path,
        lock: &Lock,
        piped: bool,
    ) -> Result<Program> {
        let cannot =
            |e: std::io::Error| Error::cannot(format!("`{}` cannot be run: {e}", file.display()), "");
        let log_file = open_log(log).map_err(|e| cannot(e).within(format_args!("`{}`", log.display())))?;
        let (messages, writer) = std::io::pipe().map_err(cannot)?;
        let output = if piped { Stdio::piped() } else { writer.try_clone().map_err(cannot)?.into() };
        let mut command = Command::new(file);
        // COLMAP is a program with windows, which are not needed for its commands
        command.args(arguments).env("QT_QPA_PLATFORM", "offscreen");
        command.stdin(lock.as_input().map_err(cannot)?).stdout(output).stderr(writer);
        bind(&mut command);
        let child = command.spawn().map_err(cannot)?;
        let (sender, copied) = mpsc::channel();
        let program = Program { child, log: log.into(), copied, has_ended: false };
        let copy = move || drop(sender.send(copy_messages(messages, log_file, MAX_LOG_BYTES)));
        std::thread::Builder::new().name("messages".into()).spawn(copy).map_err(cannot)?;
        Ok(program)
    }

    /// Waits for its end, and returns how it failed, if it did. `stop` ends it.
    pub fn wait(mut self, stop: &dyn Fn() -> bool) -> Result<Option<ProgramFailure>> {
        let stopped = || Err(Error::stopped("before its end").with_hint(""));
        let status = loop {
            match self.child.try_wait() {
                Ok(Some(status)) => break status,
                Ok(None) if stop() => return stopped(),
                Ok(None) => std::thread::sleep(POLL_INTERVAL),
                Err(e) => return Err(Error::cannot(format!("a program cannot be waited for: {e}"), "")),
            }
        };
        // nothing that it started goes on: that would hold the lock, and write into what follows
        kill_group(&self.child);
        self.has_ended = true;
        if !status.success() {
            // a signal may have ended both; what asked for the stop may be heard of a little later
            std::thread::sleep(2 * POLL_INTERVAL);
            if stop() {
                return stopped();
            }
        }
        // one that left its group may still have the pipe, and is not waited for
        if let Ok(Err(source)) = self.copied.recv_timeout(MESSAGES_TIMEOUT) {
            return Err(WriteError::Io { path: self.log.clone(), source }.into());
        }
        Ok((!status.success()).then(|| status.into()))
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        if self.has_ended {
            return;
        }
        // all fail if it has ended, which is what they are for
        kill_group(&self.child);
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Gives a program a group of its own, which a stop ends as a whole, and lets it die with the
/// thread that starts it.
#[cfg(unix)]
fn bind(command: &mut Command) {
    use std::os::unix::process::CommandExt;
    command.process_group(0);
    #[cfg(target_os = "linux")]
    {
        use rustix::process::{Signal, getpid, getppid, set_parent_process_death_signal};
        let parent = getpid();
        let die_with_parent = move || {
            set_parent_process_death_signal(Some(Signal::KILL))?;
            // the parent may have died before
            if getppid() == Some(parent) { Ok(()) } else { Err(rustix::io::Errno::SRCH.into()) }
        };
        // SAFETY: between fork and exec it makes system calls only; it allocates nothing and takes
        // no lock.
        unsafe { command.pre_exec(die_with_parent) };
    }
}

#[cfg(not(unix))]
fn bind(_: &mut Command) {}

/// Kills what a program started, and itself if it has not ended.
#[cfg(unix)]
fn kill_group(child: &Child) {
    use rustix::process::{Pid, Signal, kill_process_group};
    if let Some(group) = i32::try_from(child.id()).ok().and_then(Pid::from_raw) {
        let _ = kill_process_group(group, Signal::KILL); // fails where nothing of it is left
    }
}

#[cfg(not(unix))]
fn kill_group(_: &Child) {}

/// Opens a log to be appended to; a link is an error, because its target may be any file.
fn open_log(log: &Path) -> std::io::Result<File> {
    if super::is_link(log) {
        return Err(std::io::Error::other("its log is a link, which is not followed here"));
    }
    OpenOptions::new().read(true).write(true).create(true).truncate(false).open(log)
}

/// Appends messages to a log until they end. A log over `limit` bytes loses its older half.
fn copy_messages(mut messages: impl Read, mut log: File, limit: u64) -> std::io::Result<()> {
    let mut length = log.seek(SeekFrom::End(0))?;
    let mut piece = vec![0; 1 << 14];
    let mut copied = Ok(());
    loop {
        let n = match messages.read(&mut piece) {
            Ok(0) => return copied,
            Ok(n) => n,
            Err(e) if e.kind() == ErrorKind::Interrupted => continue,
            Err(e) => return copied.and(Err(e)),
        };
        // what cannot be written is read all the same: a program stands still when nobody reads
        if copied.is_ok() {
            copied = append_within(&mut log, &mut length, &piece[..n], limit);
        }
    }
}

fn append_within(log: &mut File, length: &mut u64, piece: &[u8], limit: u64) -> std::io::Result<()> {
    const CUT: &[u8] = b"(older messages are left out)\n";
    if *length + piece.len() as u64 > limit {
        let mut last = vec![0; (*length).min(limit / 2) as usize];
        log.seek(SeekFrom::End(-(last.len() as i64)))?;
        log.read_exact(&mut last)?;
        log.set_len(0)?;
        log.rewind()?;
        log.write_all(CUT)?;
        log.write_all(&last)?;
        *length = (CUT.len() + last.len()) as u64;
    }
    log.write_all(piece)?;
    *length += piece.len() as u64;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_is_bounded_and_keeps_its_beginning_until_then_and_its_end() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.log");
        let log = || open_log(&path).unwrap();
        copy_messages(&b"first\n"[..], log(), 100).unwrap();
        copy_messages(&b"second\n"[..], log(), 100).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"first\nsecond\n");
        let many: Vec<u8> = (0..100_000).flat_map(|i| format!("{i:05}\n").into_bytes()).collect();
        copy_messages(&many[..], log(), 50_000).unwrap();
        let kept = std::fs::read(&path).unwrap();
        assert!(kept.len() <= 50_000 && kept.len() > 25_000, "{}", kept.len());
        assert!(kept.starts_with(b"(older messages") && kept.ends_with(b"99998\n99999\n"));
    }

    #[test]
    #[cfg(unix)]
    fn a_help_is_read_however_the_program_ends_and_not_waited_for_after_a_stop() {
        let shell = |text: &str, stop: &dyn Fn() -> bool| help_of(Path::new("/bin/sh"), &["-c", text], stop);
        assert_eq!(shell("echo a; echo b >&2; exit 3", &|| false).as_deref(), Some("a\nb\n"));
        assert_eq!(shell("sleep 600 & sleep 600", &|| true), None);
        assert_eq!(help_of(Path::new("/no/program"), &[], &|| false), None);
    }

    #[test]
    #[cfg(unix)]
    fn a_program_that_a_signal_ends_is_told_from_one_that_fails() {
        use std::os::unix::process::ExitStatusExt;
        // as `waitpid` reports them: the exit code in the second byte, a signal in the first; 137
        // is a shell's word for signal 9
        let rows = [(1 << 8, false), (127 << 8, false), (137 << 8, true), (255 << 8, false), (9, true)];
        for (raw, is_crash) in rows {
            assert_eq!(ProgramFailure::from(ExitStatus::from_raw(raw)).is_crash, is_crash, "{raw}");
        }
    }
}

//! The error type of the crate: problem, suggested fix, and exit code.
//!
//! A caller acts on the kind (retry, correct the command, tell a person); a person reads the
//! message and the suggested fix. Modules add no enums of their own unless a caller matches on the
//! variants.

use std::fmt::{self, Display};

/// Kind of an error, by what a caller can do; as a number, the exit code of `tiface`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// Cannot be done as asked: data missing or unsuitable, no space. Do not retry.
    Cannot = 1,
    /// Wrong command line or configuration. Do not retry.
    Usage = 2,
    /// Done, but below a bar that was set.
    BelowBar = 3,
    /// Not now: locked, out of device memory, device lost. Retry.
    NotNow = 75,
    /// A bug in this crate.
    Bug = 101,
    /// Stopped by Ctrl-C after saving. Repeat to continue.
    Interrupted = 130,
    /// Stopped by SIGTERM after saving. Repeat to continue.
    Terminated = 143,
}

impl ErrorKind {
    /// Returns the exit code a shell sees.
    pub fn code(self) -> u8 {
        self as u8
    }

    /// Returns whether the process was stopped by a signal, which is no failure.
    pub fn is_stop(self) -> bool {
        matches!(self, ErrorKind::Interrupted | ErrorKind::Terminated)
    }
}

/// A result whose error is [`Error`] unless said otherwise.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Hint for a stop between steps, for [`Error::stopped`].
pub const COMPLETE_IS_KEPT: &str = "what is complete is kept";

/// What is wrong, for a caller that can suggest a better fix than the code that found it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Cause {
    /// There is no surface: a field is finite nowhere.
    NowhereFinite,
    /// There is no surface: a field is negative everywhere.
    AllInside,
    /// There is no surface: a field is negative nowhere.
    AllOutside,
    /// A mesh has no triangles.
    NoTriangles,
    /// The resolution is out of range, or makes more vertices than indices can name.
    Resolution,
    /// A file that a program wrote for itself is missing, damaged, or of another version.
    Stale,
}

/// An error: its kind, a message that names file and place, and a suggested fix.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error {
    kind: ErrorKind,
    message: String,
    hint: String,
    cause: Option<Cause>,
}

impl Error {
    /// Returns an error of this kind without a suggested fix.
    pub fn new(kind: ErrorKind, message: impl Display) -> Error {
        Error { kind, message: message.to_string(), hint: String::new(), cause: None }
    }

    /// Returns an error of kind [`ErrorKind::Cannot`]; `hint` may be empty.
    pub fn cannot(message: impl Display, hint: impl Into<String>) -> Error {
        Error { hint: hint.into(), ..Error::new(ErrorKind::Cannot, message) }
    }

    /// Returns an error of kind [`ErrorKind::Usage`]; `hint` may be empty.
    pub fn usage(message: impl Display, hint: impl Into<String>) -> Error {
        Error { hint: hint.into(), ..Error::new(ErrorKind::Usage, message) }
    }

    /// Returns an error of kind [`ErrorKind::NotNow`]; `hint` may be empty.
    pub fn not_now(message: impl Display, hint: impl Into<String>) -> Error {
        Error { hint: hint.into(), ..Error::new(ErrorKind::NotNow, message) }
    }

    /// Returns an error of kind [`ErrorKind::BelowBar`]; `hint` may be empty.
    pub fn below(message: impl Display, hint: impl Into<String>) -> Error {
        Error { hint: hint.into(), ..Error::new(ErrorKind::BelowBar, message) }
    }

    /// Returns what is wrong, if the code that found it knows.
    pub fn cause(&self) -> Option<Cause> {
        self.cause
    }

    /// Returns whether a field has no surface, wherever that was found.
    pub fn is_no_surface(&self) -> bool {
        matches!(self.cause, Some(Cause::NowhereFinite | Cause::AllInside | Cause::AllOutside))
    }

    /// Returns the error that ends work on request, with what became of the work. It counts as
    /// [`ErrorKind::Interrupted`] until the signal handler's kind replaces it.
    pub fn stopped(kept: impl Display) -> Error {
        Error { hint: "repeat the command to continue".into(), ..Error::new(ErrorKind::Interrupted, kept) }
    }

    /// Returns the error that only carries the kind: what is wrong has been printed, and nothing is
    /// to be added.
    pub fn already_printed(kind: ErrorKind) -> Error {
        Error::new(kind, "")
    }

    /// Returns whether this is [`Error::already_printed`].
    pub fn is_printed(&self) -> bool {
        self.message.is_empty()
    }

    /// Returns what a caller can do about it.
    pub fn kind(&self) -> ErrorKind {
        self.kind
    }

    /// Returns what to do about it, for a person; may be empty.
    pub fn hint(&self) -> &str {
        &self.hint
    }

    /// Replaces the kind.
    pub fn with_kind(self, kind: ErrorKind) -> Error {
        Error { kind, ..self }
    }

    /// Replaces the suggested fix.
    pub fn with_hint(self, hint: impl Into<String>) -> Error {
        Error { hint: hint.into(), ..self }
    }

    /// Says what is wrong, for [`Error::cause`].
    pub fn with_cause(self, cause: Cause) -> Error {
        Error { cause: Some(cause), ..self }
    }

    /// Puts where it happened before the message: "`a.png`: …".
    pub fn within(self, place: impl Display) -> Error {
        Error { message: format!("{place}: {}", self.message), ..self }
    }
}

impl Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Error {}

/// Returns a number with its noun: `1 view`, `2 views`.
pub fn counted(n: usize, noun: &str) -> String {
    format!("{n} {noun}{}", if n == 1 { "" } else { "s" })
}

/// Lets `?` turn an error enum with a `hint` into an [`Error`] of a kind.
macro_rules! error_from {
    ($enum:ty, $kind:ident) => {
        impl From<$enum> for $crate::Error {
            fn from(e: $enum) -> $crate::Error {
                $crate::Error::new($crate::ErrorKind::$kind, &e).with_hint(e.hint())
            }
        }
    };
}
pub(crate) use error_from;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_not_a_plural() {
        assert_eq!([0, 1, 2].map(|n| counted(n, "view")), ["0 views", "1 view", "2 views"]);
    }

    #[test]
    fn an_error_keeps_kind_and_fix_and_gains_its_place() {
        let e = Error::usage("is not a number", "write one").within("`iface.steps`");
        assert_eq!((e.kind().code(), e.hint()), (2, "write one"));
        assert_eq!(e.to_string(), "`iface.steps`: is not a number");
        let caused = Error::cannot("it is open", "").with_cause(Cause::AllInside);
        assert_eq!((e.cause(), caused.cause()), (None, Some(Cause::AllInside)));
        assert!(caused.within("a").with_hint("close it").is_no_surface() && !e.is_no_surface());
        assert!(Error::already_printed(ErrorKind::BelowBar).is_printed() && !e.is_printed());
        assert!(Error::stopped("x").kind().is_stop() && !e.kind().is_stop());
    }
}

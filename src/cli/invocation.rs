//! What every command works with.

use super::options::Common;
use super::screen::Screen;
use crate::run::Stop;
use std::sync::Arc;

/// One command at work.
pub(super) struct Invocation<'a> {
    /// The options that every command shares.
    pub common: &'a Common,
    /// Where people see what happens.
    pub screen: Arc<Screen>,
    /// Set when somebody asks to stop.
    pub stop: Stop,
}

//! Photographs of a human head, taken by calibrated cameras, become a watertight mesh and novel views.
//!
//! The line, one word per stage: **capture** (what was photographed, from where) → **mask** (which
//! pixels are the head) → **baseline**, **tface** (radiance fields without and with masks), **iface** (a
//! learned signed distance) → **mesh** (its zero level set, closed) → **render** (views by volume rendering and by
//! ray casting) → **ensemble** (they become one) → **metrics**.
//!
//! Modules are declared in the order of that line; what they share stands first.

pub mod error;
pub mod geom;
pub mod image;
pub mod io;
pub mod kernel;
pub mod monitor;

pub use error::{Error, ErrorKind, Result};
pub use monitor::{Monitor, Quiet};

pub mod config;
pub mod run;

pub mod capture;
#[cfg(feature = "cpu")]
pub mod field;
pub mod report;

pub mod mask;

pub mod tface;

#[cfg(feature = "cpu")]
pub mod iface;
pub mod mesh;

pub mod render;

pub mod ensemble;
pub mod metrics;

pub mod pipeline;

pub mod cli;

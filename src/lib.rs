//! Photographs of a human head, taken by calibrated cameras, become a watertight mesh and novel
//! views.
//!
//! ```
//! use tiface::capture::synthetic::{SyntheticOptions, write_capture};
//! use tiface::config::{Config, Preset};
//! use tiface::pipeline::{Session, Stage, reconstruct};
//! use tiface::run::Run;
//!
//! // a small analytic head in the place of photographs
//! let folder = tempfile::tempdir()?;
//! let options = SyntheticOptions { width: 48, height: 60, train: 10, test: 1, seed: 1 };
//! write_capture(folder.path(), &options)?;
//!
//! let mut config = Config::preset(Preset::Draft);
//! config.capture.path = folder.path().into();
//! (config.iface.steps, config.iface.rays, config.iface.samples) = (30, 128, 2048);
//! (config.iface.levels, config.iface.log2_table) = (8, 12);
//! (config.mesh.resolution, config.mesh.triangles, config.mesh.texture_px) = (48, 2000, 128);
//!
//! let run = Run::quiet(&folder.path().join("run"));
//! let session = Session::open(&config, &run)?;
//! let done = reconstruct(&session, Stage::Mesh)?;
//!
//! let (stage, mesh) = &done[2];
//! assert_eq!((*stage, &mesh.summary["closed"]), (Stage::Mesh, &true.into()));
//! assert!(run.path("mesh/head.glb").is_file());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The pipeline, one word per stage: **capture** (what was photographed, from where) → **mask**
//! (which pixels are the head) → **baseline**, **tface** (radiance fields without and with masks),
//! **iface** (a learned signed distance) → **mesh** (its zero level set, closed) → **render**
//! (views by volume rendering, ray casting and rasterization) → **ensemble** (they become one) →
//! **metrics**. [`pipeline`] runs them; every stage leaves a folder of plain files in the [`run`],
//! and is skipped when it is done.
//!
//! Modules are declared in pipeline order, after the modules that they share. The packages below
//! this one can be used alone: `tiface-surface` ([`mesh`], [`render`]) meshes any signed distance
//! and needs no field, `tiface-kernels` ([`kernel`]) computes the fields, `tiface-base` has what
//! all know, with [`io`], which opens every file within limits. [`capture`] reads seven kinds of
//! camera files and names the others. Whatever fails returns [`Error`]: a kind that a caller can
//! act on, a message that names file and place, and a suggested fix.
//!
//! [ARCHITECTURE.md](../../../ARCHITECTURE.md) shows components, data flow, coordinate frames and
//! tensor layouts on one page.

pub use tiface_base::{
    Error, ErrorKind, Fingerprint, Monitor, Quiet, Result, error, geom, image, io, math, monitor,
};
pub use tiface_capture::{self as capture, rig};
pub use tiface_kernels as kernel;
pub use tiface_surface::{self as mesh, render};

pub mod config;
pub mod run;

pub mod field;
#[cfg_attr(not(feature = "matting"), path = "onnx/absent.rs")]
mod onnx;
pub mod report;

pub mod mask;

pub mod tface;

pub mod iface;

pub mod ensemble;
pub mod metrics;

pub mod pipeline;

pub mod cli;

#[cfg(test)]
#[path = "../tests/support/reference/mod.rs"]
pub(crate) mod reference;

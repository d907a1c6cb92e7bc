//! Integration tests: what only the whole program can show, as a user runs it, and readers and
//! files as others write them.
//!
//! What takes minutes is ignored with a reason that begins with `long:`, and run by
//! `tools/test.sh all`.

// what the tests share
mod capture_folder;
#[path = "../support/clicked.rs"]
mod clicked;
mod command;
#[path = "../support/fields.rs"]
mod fields;
mod kept;
mod tiny;
mod zips;

#[cfg(target_os = "linux")]
mod accidents;
mod bench;
mod cameras;
mod captures;
mod clean;
mod cli;
mod colmap;
#[cfg(all(feature = "wgpu", unix))]
mod device;
mod dialects;
mod export;
mod extraction;
#[cfg(target_os = "linux")]
mod faults;
mod finished;
mod foreign_meshes;
mod formats;
mod hostile;
mod hostile_mesh;
mod hostile_npz;
mod house;
mod mask_values;
mod masks;
mod models;
mod names;
mod photographs;
mod preview;
mod raycast_truth;
#[cfg(unix)]
mod resume;
mod round_trips;
mod sightings;
mod stability;
mod supply;
mod trained;

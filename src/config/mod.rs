//! Every knob: defaults, presets, validation.

pub mod iface;

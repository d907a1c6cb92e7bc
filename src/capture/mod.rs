//! What a dataset means.

pub mod synthetic;

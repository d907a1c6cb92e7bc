//! **tface**: the TensoRF vector–matrix radiance field.

pub mod th;

//! Stage · a surface an artist can open.

pub mod check;
pub mod export;
pub mod gltf;
pub mod obj;
pub mod ply;
pub mod read;

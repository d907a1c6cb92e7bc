//! The only module that opens files: every limit and every hostile input is handled here.
//!
//! Readers take a path or bytes together with [`Limits`]. Sizes are multiplied with `checked_mul`
//! and compared with the bytes that follow before anything is reserved; content, not the ending of
//! the name, decides the format; only regular files are opened. Writers go through
//! [`write_atomic`].

mod animation;
mod exr;
mod folder;
mod json;
mod limits;
mod lock;
mod mask_picture;
mod npy;
mod npz;
mod pictures;
mod process;
mod program;
mod read;
mod read_error;
mod tensors;
mod video;
mod write;

pub use self::exr::{ExrImage, read_exr, write_exr, write_exr_rle};
pub use animation::{ANIMATIONS, Animation, Frames, write_animation};
pub use folder::{
    any_file, append, clear_folder, create_folder, exists, file_size, file_sizes, files_below, free_bytes,
    is_file, is_folder, is_link, is_writable, list_files, list_folders, list_hidden, modified, real_path,
    remove_empty_folder, set_modified, similar,
};
pub use json::{parse_json, read_json, read_typed, typed};
pub use limits::Limits;
pub use lock::{Lock, LockError, begins};
pub use mask_picture::{MaskPicture, read_gray, read_mask};
pub use npy::{Npy, NpyValues, npy_bytes, parse_npy, read_npy};
pub use npz::read_npz;
pub use pictures::{
    PictureInfo, jpeg_bytes, parse_photo, parse_picture_info, picture_info, png_bytes, png_gray_bytes,
    read_photo, turned_gray, turned_photo, write_png_gray, write_png_gray16, write_png_rgb, write_png_rgba,
};
pub use process::{
    cpu_seconds, forget_peak_memory, give_memory_back, has_ended, has_open, peak_memory, processor,
    set_memory_collector,
};
pub use program::{Program, ProgramFailure, find_program, help_of};
pub use read::{read_beginning, read_bytes, read_maybe_empty, read_pieces};
pub use read_error::ReadError;
pub use tensors::{TensorValues, Tensors, parse_tensors, read_tensors, tensor_bytes, write_tensors};
pub use video::VideoFrames;
pub use write::{WriteError, copy, remove, remove_leftovers, rename, write_atomic};

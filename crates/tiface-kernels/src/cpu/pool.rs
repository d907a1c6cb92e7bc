//! A pool of reusable buffers.
//!
//! A training step needs tens of megabytes of scratch memory. Memory that is newly allocated is
//! paged in by the system each time, which costs more than the arithmetic; reused buffers avoid
//! that.

use std::ops::{Deref, DerefMut};
use std::sync::Mutex;

static FREE: Mutex<Vec<Vec<f32>>> = Mutex::new(Vec::new());

/// Maximum number of free buffers that the pool keeps.
const MAX_FREE: usize = 64;

/// Frees the buffers that nobody uses. A stage needs others than the one before it.
pub fn clear() {
    // what a panic left locked stays
    if let Ok(mut free) = FREE.lock() {
        *free = Vec::new();
    }
}

/// Returns whether the pool keeps a buffer of this capacity.
#[cfg(any(test, feature = "testing"))]
pub fn keeps(capacity: usize) -> bool {
    FREE.lock().is_ok_and(|free| free.iter().any(|v| v.capacity() == capacity))
}

/// A float buffer that returns to the pool when dropped.
#[derive(Debug, Default)]
pub struct Buffer(Vec<f32>);

impl Buffer {
    /// Returns a buffer of `len` floats with **arbitrary contents**: the caller must write before
    /// it reads.
    pub fn scratch(len: usize) -> Buffer {
        let mut free = FREE.lock().expect("no panic while the pool is locked");
        // take the smallest buffer that fits and is not wastefully large
        let best = (0..free.len())
            .filter(|&i| free[i].capacity() >= len && free[i].capacity() <= 4 * len.max(1024))
            .min_by_key(|&i| free[i].capacity());
        let mut v = match best {
            Some(i) => free.swap_remove(i),
            None => {
                drop(free);
                // the capacity is rounded up, so that the buffer fits a slightly larger batch, too
                let grain = (len.next_power_of_two() / 8).max(1024);
                Vec::with_capacity(len.next_multiple_of(grain))
            }
        };
        v.resize(len, 0.0);
        Buffer(v)
    }

    /// Returns a buffer of `len` zeros.
    pub fn zeroed(len: usize) -> Buffer {
        let mut buffer = Buffer::scratch(len);
        buffer.fill(0.0);
        buffer
    }
}

/// Splits buffers into pieces of `rows` rows; `widths` are the floats per row of each buffer. Each
/// call of the returned function gives the next piece of every buffer, an empty one once a buffer
/// is exhausted.
pub fn pieces<'a, const N: usize>(
    buffers: [&'a mut Buffer; N],
    widths: [usize; N],
    rows: usize,
) -> impl FnMut() -> [&'a mut [f32]; N] {
    let mut widths = widths.into_iter();
    let mut cut = buffers.map(|b| b.chunks_mut(rows * widths.next().unwrap_or(1)));
    move || cut.each_mut().map(|c| c.next().unwrap_or_default())
}

/// Splits the rows of a matrix, which are `width` long, into chunks of columns: for each chunk its
/// part of every row.
pub fn by_chunk<T>(matrix: &mut [T], width: usize, chunk: usize) -> Vec<Vec<&mut [T]>> {
    let mut chunks: Vec<Vec<&mut [T]>> = (0..width.div_ceil(chunk)).map(|_| Vec::new()).collect();
    for row in matrix.chunks_mut(width.max(1)) {
        chunks.iter_mut().zip(row.chunks_mut(chunk)).for_each(|(parts, part)| parts.push(part));
    }
    chunks
}

impl Drop for Buffer {
    fn drop(&mut self) {
        let v = std::mem::take(&mut self.0);
        if v.capacity() == 0 {
            return;
        }
        if let Ok(mut free) = FREE.lock() {
            if free.len() < MAX_FREE {
                free.push(v);
            } else if let Some(smallest) = free.iter_mut().min_by_key(|v| v.capacity())
                && smallest.capacity() < v.capacity()
            {
                *smallest = v;
            }
        }
    }
}

impl Clone for Buffer {
    fn clone(&self) -> Buffer {
        let mut b = Buffer::scratch(self.len());
        b.copy_from_slice(self);
        b
    }
}

impl Deref for Buffer {
    type Target = [f32];
    fn deref(&self) -> &[f32] {
        &self.0
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cleared_pool_keeps_nothing() {
        // rounded up to 6 eighths of 2^20; nobody else has one of this size
        drop(Buffer::scratch(777_777));
        clear();
        assert!(!keeps(6 << 17));
    }

    #[test]
    fn buffers_of_another_length_are_cut_to_it() {
        drop(Buffer::scratch(5000));
        assert_eq!(Buffer::scratch(4999).len(), 4999);
    }

    #[test]
    fn a_buffer_of_zeros_has_nothing_of_its_last_use() {
        Buffer::scratch(5000).fill(1.0);
        assert!(Buffer::zeroed(4998).iter().all(|v| *v == 0.0));
    }
}

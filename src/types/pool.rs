//! Byte buffers that are used again, so that a frame costs no allocation.

use std::{
    ops::{Deref, DerefMut},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

/// Hands out empty buffers and takes them back when they are dropped, on whatever thread.
#[derive(Debug, Clone, Default)]
pub struct BufferPool {
    free: Arc<Mutex<Vec<Vec<u8>>>>,
}

/// Buffers kept beyond this many are given back to the allocator: after a storage stall the memory shrinks again.
const MAX_FREE_BUFFERS: usize = 16;

impl BufferPool {
    /// An empty buffer; its capacity is that of an earlier use.
    pub fn take(&self) -> PooledBytes {
        let bytes = lock(&self.free).pop().unwrap_or_default();
        PooledBytes { bytes, home: self.free.clone() }
    }
}

/// A byte vector that returns to its pool.
#[derive(Debug)]
pub struct PooledBytes {
    bytes: Vec<u8>,
    home: Arc<Mutex<Vec<Vec<u8>>>>,
}

impl From<Vec<u8>> for PooledBytes {
    /// Bytes that came from no pool.
    fn from(bytes: Vec<u8>) -> Self {
        Self { bytes, home: Arc::default() }
    }
}

impl Deref for PooledBytes {
    type Target = Vec<u8>;

    fn deref(&self) -> &Vec<u8> {
        &self.bytes
    }
}

impl DerefMut for PooledBytes {
    fn deref_mut(&mut self) -> &mut Vec<u8> {
        &mut self.bytes
    }
}

impl Drop for PooledBytes {
    fn drop(&mut self) {
        let mut free = lock(&self.home);
        if free.len() < MAX_FREE_BUFFERS {
            let mut bytes = std::mem::take(&mut self.bytes);
            bytes.clear();
            free.push(bytes);
        }
    }
}

/// Whoever panicked while holding the list left it whole: it is only pushed to and popped from.
fn lock(free: &Mutex<Vec<Vec<u8>>>) -> MutexGuard<'_, Vec<Vec<u8>>> {
    free.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_buffer_is_handed_out_again_and_empty() {
        let pool = BufferPool::default();
        let mut buffer = pool.take();
        buffer.extend_from_slice(&[7; 1000]);
        let address = buffer.as_ptr();
        std::thread::spawn(move || drop(buffer)).join().expect("drops");
        let again = pool.take();
        assert_eq!((again.as_ptr(), again.len()), (address, 0));
        assert!(again.capacity() >= 1000);
    }
}

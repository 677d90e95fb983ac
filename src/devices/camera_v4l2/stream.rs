//! The driver's queue of mapped buffers. Whatever happens, it is switched off and unmapped when it is dropped.

use std::{ffi::c_int, os::fd::AsRawFd, ptr::NonNull, time::Duration};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
};
use v4l::{
    v4l_sys::*,
    v4l2::{self, vidioc},
};

use super::{
    super::DeviceError,
    capture::{CaptureQueue, Filled, Waited},
    device::{Argument, CAPTURE, Device},
    stamps::DriverStamp,
};
use crate::types::NS_PER_S;

/// A buffer of the driver in our memory.
struct Mapping {
    start: NonNull<u8>,
    length: usize,
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped by `Stream::map` with this length, and no slice of it outlives its stream. An error, if
        // there could be one, would leave memory mapped and do no other harm.
        let _ = unsafe { v4l2::munmap(self.start.as_ptr().cast(), self.length) };
    }
}

/// Buffers that circulate between the driver and us.
pub(super) struct Stream<'a> {
    device: &'a Device,
    mappings: Vec<Mapping>,
}

impl<'a> Stream<'a> {
    /// Maps the buffers, each of at least `least_bytes`, gives all of them to the driver and switches streaming on.
    pub fn start(device: &'a Device, count: u32, least_bytes: usize) -> Result<Self, DeviceError> {
        let mut request = v4l2_requestbuffers { count, ..request_none() };
        device.ioctl(vidioc::VIDIOC_REQBUFS, &mut request).map_err(|errno| device.fault("REQBUFS", errno))?;
        // From here on dropping it gives back whatever there is.
        let mut stream = Self { device, mappings: Vec::new() };
        if request.count < 2 {
            let what = format!("its driver gave {} buffers, at least 2 are needed", request.count);
            return Err(device.unsupported(what));
        }
        for index in 0..request.count {
            let mapping = stream.map(index, least_bytes)?;
            stream.mappings.push(mapping);
        }
        for index in 0..request.count {
            stream.enqueue(index).map_err(|errno| device.fault("QBUF", errno))?;
        }
        let mut kind = CAPTURE as c_int;
        device.ioctl(vidioc::VIDIOC_STREAMON, &mut kind).map_err(|errno| device.fault("STREAMON", errno))?;
        Ok(stream)
    }

    /// How many the driver gave.
    pub fn buffers(&self) -> u32 {
        self.mappings.len() as u32
    }

    fn map(&self, index: u32, least_bytes: usize) -> Result<Mapping, DeviceError> {
        const PROT_READ: c_int = 1;
        const MAP_SHARED: c_int = 1;
        let device = self.device;
        let mut buffer = v4l2_buffer { index, ..buffer_of_driver() };
        device.ioctl(vidioc::VIDIOC_QUERYBUF, &mut buffer).map_err(|errno| device.fault("QUERYBUF", errno))?;
        let length = buffer.length as usize;
        if length < least_bytes {
            let what = format!("buffers of {length} bytes for images of {least_bytes} bytes");
            return Err(DeviceError::BadData { device: device.path.clone(), what });
        }
        // SAFETY: the kernel chooses a free place; the offset is the driver's own, for memory-mapped buffers.
        let start = unsafe {
            let offset = buffer.m.offset.into();
            v4l2::mmap(std::ptr::null_mut(), length, PROT_READ, MAP_SHARED, device.fd.as_raw_fd(), offset)
        };
        let start = start.map_err(|source| DeviceError::Io { device: device.path.clone(), source })?;
        let start = NonNull::new(start.cast()).ok_or_else(|| device.fault("mmap", Errno::NOMEM))?;
        Ok(Mapping { start, length })
    }
}

impl Drop for Stream<'_> {
    /// Errors are of no use here: the device is closed next, or is gone already.
    fn drop(&mut self) {
        let mut kind = CAPTURE as c_int;
        let _ = self.device.ioctl(vidioc::VIDIOC_STREAMOFF, &mut kind);
        self.mappings.clear();
        let _ = self.device.ioctl(vidioc::VIDIOC_REQBUFS, &mut request_none());
    }
}

impl CaptureQueue for Stream<'_> {
    fn wait(&mut self, at_most: Duration) -> Result<Waited, Errno> {
        let mut waiting = [PollFd::new(&self.device.fd, PollFlags::IN)];
        let timeout = Timespec { tv_sec: at_most.as_secs() as i64, tv_nsec: at_most.subsec_nanos().into() };
        poll(&mut waiting, Some(&timeout))?;
        let ready = waiting[0].revents();
        Ok(if ready.intersects(PollFlags::ERR | PollFlags::HUP | PollFlags::NVAL) {
            Waited::Gone
        } else if ready.contains(PollFlags::IN) {
            Waited::Ready
        } else {
            Waited::Nothing
        })
    }

    fn dequeue(&mut self) -> Result<Filled, Errno> {
        let mut buffer = buffer_of_driver();
        self.device.ioctl(vidioc::VIDIOC_DQBUF, &mut buffer)?;
        if buffer.index as usize >= self.mappings.len() {
            return Err(Errno::INVAL);
        }
        let (seconds, microseconds) = (buffer.timestamp.tv_sec as u64, buffer.timestamp.tv_usec as u64);
        let is = |mask: u32, value: u32| buffer.flags & mask == value;
        Ok(Filled {
            index: buffer.index,
            bytes_used: buffer.bytesused,
            sequence: buffer.sequence,
            stamp: DriverStamp {
                ns: seconds.saturating_mul(NS_PER_S).saturating_add(microseconds.saturating_mul(1000)),
                monotonic: is(V4L2_BUF_FLAG_TIMESTAMP_MASK, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC),
                start_of_exposure: is(V4L2_BUF_FLAG_TSTAMP_SRC_MASK, V4L2_BUF_FLAG_TSTAMP_SRC_SOE),
            },
            marked_damaged: is(V4L2_BUF_FLAG_ERROR, V4L2_BUF_FLAG_ERROR),
        })
    }

    fn bytes(&self, filled: &Filled) -> &[u8] {
        let Mapping { start, length } = &self.mappings[filled.index as usize];
        // SAFETY: mapped with this length until the stream is dropped, and until it is enqueued again the driver does
        // not write to it.
        let mapped = unsafe { std::slice::from_raw_parts(start.as_ptr(), *length) };
        &mapped[..(filled.bytes_used as usize).min(*length)]
    }

    fn enqueue(&mut self, index: u32) -> Result<(), Errno> {
        self.device.ioctl(vidioc::VIDIOC_QBUF, &mut v4l2_buffer { index, ..buffer_of_driver() })
    }
}

fn buffer_of_driver() -> v4l2_buffer {
    v4l2_buffer { type_: CAPTURE, memory: v4l2_memory_V4L2_MEMORY_MMAP, ..v4l2_buffer::zeroed() }
}

fn request_none() -> v4l2_requestbuffers {
    v4l2_requestbuffers { type_: CAPTURE, memory: v4l2_memory_V4L2_MEMORY_MMAP, ..v4l2_requestbuffers::zeroed() }
}

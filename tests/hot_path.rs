//! On the vehicle nothing is allocated for a frame: an allocator may stall, and memory that is cut up does not last.

mod common;

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
    fs,
    path::PathBuf,
};

use common::map::{folder, map};
use omniloc::{
    localize::{FIELDS_IN_MEMORY_BYTES, Localizer, MotionSettings},
    map::OpenMap,
    types::{LocalizationState, NS_PER_S},
};

/// The system's allocator, counted for each thread.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: all work is the system allocator's; the counter is a plain cell of the thread, whose access allocates nothing.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn nothing_is_allocated_for_a_frame() {
    let map = OpenMap::open(Box::new(fs::File::open(map()).expect("a map"))).expect("sound");
    let mut images: Vec<PathBuf> = fs::read_dir(folder().join("dataset/images"))
        .expect("images")
        .map(|entry| entry.expect("an entry").path())
        .collect();
    images.sort();
    let jpegs: Vec<Vec<u8>> = images.iter().map(|path| fs::read(path).expect("readable")).collect();
    let mut localizer =
        Localizer::new(map, MotionSettings::default(), FIELDS_IN_MEMORY_BYTES).expect("a donut within the images");
    let mut localized = 0;
    // Buffers grow with the largest frame: the second time round they have all been seen.
    for (sequence, jpeg) in (0_u32..).zip(jpegs.iter().chain(&jpegs)) {
        let stamp_ns = u64::from(sequence) * NS_PER_S / 10;
        let before = ALLOCATIONS.get();
        let tracked = localizer.take(sequence, stamp_ns, jpeg).expect("decodes");
        let allocated = ALLOCATIONS.get() - before;
        assert!((sequence as usize) < jpegs.len() || allocated == 0, "frame {sequence}: {allocated} allocations");
        localized += usize::from(tracked.estimate.state == LocalizationState::Localized);
    }
    assert!(localized > 0, "the whole path was taken");
}

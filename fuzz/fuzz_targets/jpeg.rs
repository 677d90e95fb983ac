//! Frames as a broken camera sends them: mended, scanned and decoded without a panic.
#![no_main]

use libfuzzer_sys::fuzz_target;
use omniloc::{
    devices::mjpeg::MjpegMender,
    jpeg::{LumaDecoder, scan, with_huffman_tables},
};

fuzz_target!(|bytes: &[u8]| {
    let is_sound = scan(bytes).is_ok();
    let _ = with_huffman_tables(bytes);
    let mut mended = bytes.to_vec();
    let damage = MjpegMender::new(64, 64).mend(&mut mended, false);
    if damage.is_none() {
        assert!(scan(&mended).is_ok(), "a frame without damage has sound headers");
        // Mending what is mended changes nothing.
        let once = mended.clone();
        assert_eq!(MjpegMender::new(64, 64).mend(&mut mended, false), None);
        assert_eq!(mended, once);
    }
    // Large images only cost time here.
    if is_sound && scan(bytes).is_ok_and(|info| info.width_px * info.height_px <= 1 << 16) {
        let _ = LumaDecoder::new().decode(bytes);
    }
});

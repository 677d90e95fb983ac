//! A recorded drive taken through the survey again, as fast as it goes: one order, no wall clock, the same bytes out
//! every time.

use super::survey::{Input, Sink, Survey, Tick};
use crate::{
    devices::{GpioEvent, SerialChunk, SerialEvent, replay::Damages},
    recording::{DeviceRecord, RecordingError, TimedRecord},
    types::{ClockReading, NS_PER_S},
};

/// Plays `records` to their end. `clocks_recorded`: they hold the computer's clocks once a second; otherwise a second
/// passes whenever the stamps say so, and the date is `log_offset_ns` after the stamp.
///
/// Returns the number of records.
pub fn play(
    records: impl Iterator<Item = Result<TimedRecord, RecordingError>>,
    survey: &mut Survey,
    clocks_recorded: bool,
    log_offset_ns: u64,
    out: &mut dyn Sink,
) -> Result<u64, RecordingError> {
    let mut damages = Damages::default();
    let mut next_second_ns = None;
    let mut count = 0;
    for record in records {
        let record = record?;
        count += 1;
        if !clocks_recorded {
            let next_ns = next_second_ns.get_or_insert(record.stamp_ns + NS_PER_S);
            while record.stamp_ns >= *next_ns {
                let clocks = ClockReading { monotonic_ns: *next_ns, realtime_ns: (*next_ns + log_offset_ns) as i64 };
                survey.take(Input::Tick(Tick { clocks: Some(clocks), ..Tick::default() }), out);
                *next_ns += NS_PER_S;
            }
        }
        let TimedRecord { stamp_ns, record } = record;
        match record {
            DeviceRecord::Serial { baud, bytes } => {
                let chunk = SerialChunk { arrival_ns: stamp_ns, baud, bytes };
                survey.take(Input::Serial(SerialEvent::Chunk(chunk)), out);
            }
            DeviceRecord::Pulse => survey.take(Input::Gpio(GpioEvent::Pulse { stamp_ns }), out),
            DeviceRecord::Clock(clocks) => {
                survey.take(Input::Tick(Tick { clocks: Some(clocks), ..Tick::default() }), out);
            }
            record => damages.camera_events(TimedRecord { stamp_ns, record }, stamp_ns, &mut |event| {
                survey.take(Input::Camera(event), out);
            }),
        }
    }
    survey.finish(out);
    Ok(count)
}

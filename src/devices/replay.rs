//! Devices that say again what they said when a drive was recorded, at the pace of a clock.

use std::path::Path;

use super::{
    CameraEvent, CameraFacts, CameraFrame, DeviceError, Lost, Stop, camera_v4l2::capture, mjpeg, pty::TimedBytes,
    wait_until, yuyv,
};
use crate::{
    recording::{DeviceRecord, DeviceRecords, RecordingError, TimedRecord},
    types::Clock,
};

/// All that cameras say about losses.
const LOSSES: [&str; 11] = [
    mjpeg::MARKED_BY_DRIVER,
    mjpeg::NO_START,
    mjpeg::BAD_HEADER,
    mjpeg::WRONG_SIZE,
    mjpeg::NO_END,
    mjpeg::RESTART_GAP,
    mjpeg::STRAY_DATA,
    yuyv::INCOMPLETE,
    capture::SKIPPED,
    capture::EMPTY,
    capture::READ_ERROR,
];
/// Reasons are fixed phrases; one that another version wrote is called this.
pub const OTHER_LOSS: &str = "lost when it was recorded";

/// The camera of a recording.
pub struct ReplayCamera {
    facts: CameraFacts,
    records: DeviceRecords,
    damages: Damages,
}

impl ReplayCamera {
    pub fn open(path: &Path, facts: CameraFacts) -> Result<Self, RecordingError> {
        Ok(Self { facts, records: DeviceRecords::open(path)?, damages: Damages::default() })
    }

    /// The device function. `Ok` at the end of the recording.
    pub fn run(
        &mut self,
        clock: &dyn Clock,
        stop: &Stop,
        emit: &mut dyn FnMut(CameraEvent),
    ) -> Result<(), DeviceError> {
        emit(CameraEvent::Opened(self.facts.clone()));
        for record in &mut self.records {
            let record = record.map_err(unreadable)?;
            if !matches!(record.record, DeviceRecord::Image { .. } | DeviceRecord::CameraLoss { .. }) {
                continue;
            }
            if wait_until(record.stamp_ns, clock, stop) {
                return Ok(());
            }
            self.damages.camera_events(record, clock.monotonic_ns(), emit);
        }
        Ok(())
    }
}

/// A loss with the stamp of the frame after it is that frame's damage.
#[derive(Debug, Default)]
pub struct Damages {
    loss: Option<Lost>,
}

impl Damages {
    /// What the camera said at a record; nothing if it only says something about the next one.
    pub fn camera_events(&mut self, record: TimedRecord, arrival_ns: u64, emit: &mut dyn FnMut(CameraEvent)) {
        let TimedRecord { stamp_ns, record } = record;
        match record {
            DeviceRecord::Image { sequence, jpeg } => {
                let loss = self.loss.take();
                let damage = loss.as_ref().filter(|loss| loss.stamp_ns == stamp_ns).map(|loss| loss.reason);
                if let (Some(loss), None) = (loss, damage) {
                    emit(CameraEvent::Lost(loss));
                }
                emit(CameraEvent::Frame(CameraFrame { sequence, stamp_ns, arrival_ns, jpeg: jpeg.into(), damage }));
            }
            DeviceRecord::CameraLoss { count, reason } => {
                let known = LOSSES.iter().find(|known| **known == reason);
                let loss = Lost { count, reason: known.copied().unwrap_or(OTHER_LOSS), stamp_ns };
                self.loss.replace(loss).into_iter().for_each(|before| emit(CameraEvent::Lost(before)));
            }
            _ => {}
        }
    }
}

/// The bytes of a recording's serial line and when they arrived. Ends early, logged, where the recording cannot be read.
pub fn serial_bytes(path: &Path) -> Result<impl Iterator<Item = TimedBytes> + Send + use<>, RecordingError> {
    let records = DeviceRecords::open(path)?;
    Ok(readable(records).filter_map(|TimedRecord { stamp_ns, record }| match record {
        DeviceRecord::Serial { bytes, .. } => Some(TimedBytes { at_ns: stamp_ns, bytes }),
        _ => None,
    }))
}

/// The stamps of a recording's pulses.
pub fn pulses(path: &Path) -> Result<impl Iterator<Item = u64> + Send + use<>, RecordingError> {
    let records = DeviceRecords::open(path)?;
    Ok(readable(records).filter(|record| record.record == DeviceRecord::Pulse).map(|record| record.stamp_ns))
}

fn readable(records: DeviceRecords) -> impl Iterator<Item = TimedRecord> {
    records.map_while(|record| record.inspect_err(|error| tracing::error!(%error, "the replay ends here")).ok())
}

fn unreadable(error: RecordingError) -> DeviceError {
    DeviceError::BadData { device: "the recording".into(), what: error.to_string() }
}

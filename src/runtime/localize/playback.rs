//! A recorded drive localized as fast as it goes: one order, no clock, the same estimates every time.

use super::session::{Session, SessionError};
use crate::{
    devices::replay::Damages,
    recording::{RecordingError, TimedRecord},
    types::PositionEstimate,
};

#[derive(Debug, thiserror::Error)]
pub enum PlaybackError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error(transparent)]
    Session(#[from] SessionError),
    #[error("cannot write the estimates")]
    Output(#[from] std::io::Error),
}

/// Plays the frames among `records` to their end; `each` is given every estimate.
pub fn play(
    records: impl Iterator<Item = Result<TimedRecord, RecordingError>>,
    session: &mut Session,
    mut each: impl FnMut(&PositionEstimate) -> std::io::Result<()>,
) -> Result<(), PlaybackError> {
    let mut damages = Damages::default();
    for record in records {
        let record = record?;
        let mut outcome = Ok(());
        let stamp_ns = record.stamp_ns;
        damages.camera_events(record, stamp_ns, &mut |event| {
            if outcome.is_ok() {
                outcome = match session.take(&event) {
                    Ok(Some(estimate)) => each(&estimate).map_err(PlaybackError::from),
                    Ok(None) => Ok(()),
                    Err(error) => Err(error.into()),
                };
            }
        });
        outcome?;
    }
    Ok(())
}

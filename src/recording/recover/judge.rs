//! Whether bytes can be the message that was written.

use mcap::records::MessageHeader;
use prost::Message;

use crate::{
    jpeg,
    recording::proto::{foxglove, omniloc},
};

/// How much is known about the bytes at hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Trust {
    /// Found behind damage, by its looks.
    Damaged,
    /// Nothing was wrong so far, but no CRC says so.
    Plain,
    /// A CRC fits.
    Proven,
}

/// Whether a message can be what was written. Nothing can be said of a schema that is not ours.
pub fn is_whole(schema_name: &str, header: &MessageHeader, data: &[u8], trust: Trust) -> bool {
    if trust == Trust::Proven {
        return true;
    }
    let Some(decoded) = decode(schema_name, data) else { return trust == Trust::Plain };
    decoded.is_ok_and(|decoded| trust == Trust::Plain || decoded.fits(header))
}

/// Whether a message is one of this schema of ours and of no other: nothing in it is left over.
pub fn is_exactly(schema_name: &str, header: &MessageHeader, data: &[u8]) -> bool {
    decode(schema_name, data)
        .is_some_and(|decoded| decoded.is_ok_and(|decoded| decoded.is_canonical && decoded.fits(header)))
}

struct Decoded {
    /// Log time as the message states it \[ns\].
    time_ns: Option<i128>,
    /// Encoded again, it is the same.
    is_canonical: bool,
    image_is_whole: bool,
}

impl Decoded {
    fn new(message: &impl Message, timestamp: Option<prost_types::Timestamp>, data: &[u8]) -> Self {
        let time_ns = timestamp.map(|time| i128::from(time.seconds) * 1_000_000_000 + i128::from(time.nanos));
        Self { time_ns, is_canonical: message.encode_to_vec() == data, image_is_whole: true }
    }

    fn fits(&self, header: &MessageHeader) -> bool {
        self.time_ns == Some(header.log_time.into()) && self.image_is_whole
    }
}

/// `None`: not a schema of ours.
fn decode(schema_name: &str, data: &[u8]) -> Option<Result<Decoded, prost::DecodeError>> {
    macro_rules! stamped {
        ($message:ty) => {
            <$message>::decode(data).map(|message| Decoded::new(&message, message.timestamp, data))
        };
    }
    Some(match schema_name {
        "foxglove.CompressedImage" => foxglove::CompressedImage::decode(data).map(|image| Decoded {
            image_is_whole: image.format != "jpeg" || jpeg::scan(&image.data).is_ok(),
            ..Decoded::new(&image, image.timestamp, data)
        }),
        "foxglove.LocationFix" => stamped!(foxglove::LocationFix),
        "foxglove.PoseInFrame" => stamped!(foxglove::PoseInFrame),
        "omniloc.SerialChunk" => stamped!(omniloc::SerialChunk),
        "omniloc.Heading" => stamped!(omniloc::Heading),
        "omniloc.Pulse" => stamped!(omniloc::Pulse),
        "omniloc.SurveyPair" => stamped!(omniloc::SurveyPair),
        "omniloc.ClockOffset" => stamped!(omniloc::ClockOffset),
        "omniloc.Status" => stamped!(omniloc::Status),
        "omniloc.Dropped" => stamped!(omniloc::Dropped),
        "omniloc.PositionEstimate" => stamped!(omniloc::PositionEstimate),
        _ => return None,
    })
}

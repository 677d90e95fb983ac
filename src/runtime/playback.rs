//! A recorded drive taken through the survey again, as fast as it goes: one order, no wall clock, the same bytes out
//! every time.

use super::{
    survey::{Input, Sink, Survey, Tick},
    turn_watch::Sampler,
};
use crate::{
    devices::{CameraEvent, GpioEvent, SerialChunk, SerialEvent, replay::Damages},
    recording::{DeviceRecord, RecordingError, TimedRecord},
    sync::CameraTurns,
    types::{ClockReading, NS_PER_S},
};

/// Plays `records` to their end. `clocks_recorded`: they hold the computer's clocks once a second; otherwise a second
/// passes whenever the stamps say so, and the date is `log_offset_ns` after the stamp. `turns` watches the camera turn.
///
/// Returns the number of records.
pub fn play(
    records: impl Iterator<Item = Result<TimedRecord, RecordingError>>,
    survey: &mut Survey,
    mut turns: Option<CameraTurns>,
    clocks_recorded: bool,
    log_offset_ns: u64,
    out: &mut dyn Sink,
) -> Result<u64, RecordingError> {
    let mut damages = Damages::default();
    let mut sampler = Sampler::default();
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
                let turn = match (&event, &mut turns) {
                    (CameraEvent::Frame(frame), Some(turns)) if sampler.wants(frame.stamp_ns) => {
                        turns.push(frame.stamp_ns, &frame.jpeg)
                    }
                    _ => None,
                };
                survey.take(Input::Camera(event), out);
                turn.into_iter().for_each(|turn| survey.take(Input::Turn(turn), out));
            }),
        }
    }
    survey.finish(out);
    Ok(count)
}

#[cfg(test)]
mod tests {
    use prost::Message;

    use super::*;
    use crate::{
        devices::simulated,
        gnss::DecoderSettings,
        recording::{proto::omniloc::SurveyPair, recorder::Entry, topics},
        sync,
    };

    const START_NS: u64 = 50 * NS_PER_S;
    const START_UTC_NS: i64 = 1_790_000_000_000_000_000;

    /// Keeps pairs.
    #[derive(Default)]
    struct Pairs(Vec<SurveyPair>);

    impl Sink for Pairs {
        fn push(&mut self, entry: Entry) -> bool {
            if let Entry::Message { topic, payload, .. } = entry
                && topic.name == topics::SURVEY_PAIR.name
            {
                self.0.push(SurveyPair::decode(&**payload).expect("a pair"));
            }
            true
        }

        fn mark(&mut self) {}
    }

    /// The receiver has no pulse, and its line is 300 ms late, of which nothing is known.
    #[test]
    fn the_latency_of_the_line_shows_when_the_vehicle_turns() {
        let settings: simulated::Settings = toml::from_str(
            "place = \"town\"\nplace_seed = 3\nduration_s = 110.0\nwidth_px = 320\nheight_px = 180\n\
             frame_rate_hz = 4.0\n[receiver]\nrate_hz = 20.0\nlatency_s = 0.3\njitter_s = 0.02\n\
             position_std_m = 0.0\npulse = false",
        )
        .expect("parses");
        let world = settings.world();
        let simulation = simulated::Simulation::new(&settings, &world, START_NS, START_UTC_NS);
        let mut records: Vec<TimedRecord> = simulation
            .receiver(&world)
            .map(|bytes| {
                let record = DeviceRecord::Serial { baud: 115_200, bytes: bytes.bytes };
                TimedRecord { stamp_ns: bytes.at_ns, record }
            })
            .collect();
        let mut camera = simulation.camera(&world).expect("a camera");
        while let Some(frame) = camera.next_frame() {
            let record = DeviceRecord::Image { sequence: frame.sequence, jpeg: frame.jpeg.to_vec() };
            records.push(TimedRecord { stamp_ns: frame.stamp_ns, record });
        }
        records.sort_by_key(|record| record.stamp_ns);

        let offset_ns = (START_UTC_NS - START_NS as i64) as u64;
        let turns = CameraTurns::new(settings.camera().donut);
        let mut survey =
            Survey::new(&DecoderSettings::default(), &sync::Settings::default(), offset_ns).expect("settings");
        let mut pairs = Pairs::default();
        play(records.into_iter().map(Ok), &mut survey, Some(turns), false, offset_ns, &mut pairs).expect("plays");

        let valid: Vec<_> = pairs.0.iter().filter(|pair| pair.valid).collect();
        let (first, last) = (valid[0], valid[valid.len() - 1]);
        let stated_s = |pair: &SurveyPair| pair.time_std_s.expect("stated");
        assert!(stated_s(first) > 0.1, "nothing is known at first: {}", stated_s(first));
        assert!(stated_s(last) < 0.05, "{}", stated_s(last));
        let latency_s = last.serial_latency_s.expect("an estimate");
        println!("latency {latency_s:.3} s, stated {:.3} s", stated_s(last));
        assert!((latency_s - 0.3).abs() < 0.05, "{latency_s}");
    }
}

//! Sentences of one moment → samples.
//!
//! A receiver says what it knows of a moment, an epoch, in several sentences. A position is passed on as soon as its own
//! sentence is there; what the others say is taken from the last of them that is not older than [`MAX_AGE_NS`]:
//!
//! - standard deviations from GST, speed and course from RMC or VTG, the date from RMC or ZDA. A receiver that sends GST
//!   before GGA, as our Arduino does, gives every position its own.
//! - The same position in several sentences is passed on once: GGA before GNS before RMC, the others only when the better
//!   one has been silent for [`SOURCE_SILENCE_NS`]. The same for headings: PASHR, HDT, HDG, HDM, and true before magnetic.
//! - A heading that states no time belongs to the last timed sentence if it is the first heading since, and the line has
//!   never been idle for [`BURST_IDLE_NS`] in between. Otherwise it has no sample time.

use crate::types::{Fix, GnssSample, Heading, North, SampleTime};

use super::{
    decoder::Arrival,
    nmea::{HeadingSaid, Motion, PositionSaid, Said},
    plausibility::date_is_plausible,
    time::{DayCount, TimeOfDayNs},
};

/// Receivers that send their sentences once a second are the slowest that are used for driving.
const MAX_AGE_NS: u64 = 1_500_000_000;
const SOURCE_SILENCE_NS: u64 = 3_000_000_000;
/// The sentences of an epoch follow each other without a pause.
const BURST_IDLE_NS: u64 = 20_000_000;

/// What was said last, and when.
#[derive(Debug, Clone, Copy)]
struct Lately<T> {
    value: T,
    sample_time: Option<SampleTime>,
    arrival_ns: u64,
}

impl<T: Copy> Lately<T> {
    /// The value if it belongs to a sentence of this time.
    fn for_epoch(&self, sample_time: Option<SampleTime>, arrival_ns: u64) -> Option<T> {
        let age_ns = match (self.sample_time, sample_time) {
            (Some(then), Some(now)) if then.scale == now.scale => then.ns.abs_diff(now.ns),
            _ => arrival_ns.abs_diff(self.arrival_ns),
        };
        (age_ns <= MAX_AGE_NS).then_some(self.value)
    }
}

/// Of several sources of the same thing, the best that is not silent.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Preference {
    /// Rank, 0 is best, and last arrival.
    best: Option<(u8, u64)>,
}

impl Preference {
    /// Whether what comes from a source of this rank is to be passed on.
    pub fn admits(&mut self, rank: u8, arrival_ns: u64) -> bool {
        let is_outranked = self.best.is_some_and(|(best_rank, last_ns)| {
            best_rank < rank && arrival_ns.saturating_sub(last_ns) <= SOURCE_SILENCE_NS
        });
        if !is_outranked {
            self.best = Some((rank, arrival_ns));
        }
        !is_outranked
    }
}

/// Sentences that follow each other without a pause.
#[derive(Debug, Clone, Copy)]
struct Burst {
    last_end_ns: u64,
    /// Of the last timed sentence, until a heading has taken it.
    sample_time: Option<SampleTime>,
}

/// Puts sentences together.
#[derive(Debug, Clone, Default)]
pub(super) struct Epochs {
    days: DayCount,
    deviation: Option<Lately<[f64; 3]>>,
    motion: Option<Lately<Motion>>,
    position_source: Preference,
    heading_source: Preference,
    burst: Option<Burst>,
}

const BAD_DATE: &str =
    "stated date is before 2020 or after 2079: the receiver does not know it yet, or miscounts weeks";

impl Epochs {
    /// Whether the sentence was of use. `emit` gets what follows from it.
    pub fn push(&mut self, said: Said, arrival: Arrival, emit: &mut dyn FnMut(GnssSample)) -> bool {
        let follows = self.burst.filter(|burst| arrival.start_ns.saturating_sub(burst.last_end_ns) <= BURST_IDLE_NS);
        let mut burst = Burst { last_end_ns: arrival.end_ns, sample_time: follows.and_then(|burst| burst.sample_time) };
        let arrival_ns = arrival.end_ns;
        let is_used = match said {
            Said::Position(said) => {
                let sample_time = self.timed(said.time_ns, said.days, arrival_ns, &mut burst, emit);
                self.position(&said, sample_time, arrival_ns, emit)
            }
            Said::Deviation { time_ns, std_m } => {
                let sample_time = self.timed(time_ns, None, arrival_ns, &mut burst, emit);
                self.deviation = std_m.map(|value| Lately { value, sample_time, arrival_ns });
                true
            }
            Said::Motion(value) => {
                self.motion = Some(Lately { value, sample_time: None, arrival_ns });
                true
            }
            Said::Date { time_ns, days } => {
                let sample_time = self.timed(time_ns, days, arrival_ns, &mut burst, emit);
                if let Some(sample_time) = sample_time {
                    emit(GnssSample::Time { arrival_ns, sample_time });
                }
                true
            }
            Said::Heading(said) => {
                let sample_time = match said.time_ns {
                    Some(_) => self.timed(said.time_ns, None, arrival_ns, &mut burst, emit),
                    None => burst.sample_time.take(),
                };
                self.heading(&said, sample_time, arrival_ns, emit)
            }
            Said::Nothing => false,
        };
        self.burst = Some(burst);
        is_used
    }

    /// The sample time of a sentence that states a time of day, and perhaps a date.
    fn timed(
        &mut self,
        time_ns: Option<TimeOfDayNs>,
        days: Option<i64>,
        arrival_ns: u64,
        burst: &mut Burst,
        emit: &mut dyn FnMut(GnssSample),
    ) -> Option<SampleTime> {
        let believed = days.filter(|&days| date_is_plausible(days));
        if days != believed {
            emit(GnssSample::Rejected { arrival_ns, reason: BAD_DATE });
        }
        let sample_time = time_ns.map(|time_ns| self.days.sample_time(time_ns, believed, arrival_ns));
        burst.sample_time = sample_time.or(burst.sample_time);
        sample_time
    }

    fn position(
        &mut self,
        said: &PositionSaid,
        sample_time: Option<SampleTime>,
        arrival_ns: u64,
        emit: &mut dyn FnMut(GnssSample),
    ) -> bool {
        if said.motion != Motion::default() {
            self.motion = Some(Lately { value: said.motion, sample_time, arrival_ns });
        }
        let rank = match said.source {
            "GGA" => 0,
            "GNS" => 1,
            _ => 2,
        };
        if !self.position_source.admits(rank, arrival_ns) {
            // RMC also brings speed and date.
            return said.source == "RMC";
        }
        let Some((position, quality)) = said.place else {
            emit(GnssSample::NoFix { arrival_ns, sample_time });
            return true;
        };
        let motion = self.motion.and_then(|motion| motion.for_epoch(sample_time, arrival_ns)).unwrap_or_default();
        emit(GnssSample::Fix(Fix {
            arrival_ns,
            sample_time,
            position,
            position_std_m: self.deviation.and_then(|deviation| deviation.for_epoch(sample_time, arrival_ns)),
            quality,
            satellites: said.satellites,
            horizontal_dilution: said.horizontal_dilution,
            speed_mps: motion.speed_mps,
            course_rad: motion.course_rad,
            source: said.source,
        }));
        true
    }

    fn heading(
        &mut self,
        said: &HeadingSaid,
        sample_time: Option<SampleTime>,
        arrival_ns: u64,
        emit: &mut dyn FnMut(GnssSample),
    ) -> bool {
        let rank = match (said.north, said.source) {
            (North::True, "PASHR") => 0,
            (North::True, "HDT") => 1,
            (North::True, _) => 2,
            (North::Magnetic, "HDG") => 3,
            (North::Magnetic, _) => 4,
        };
        let Some(yaw_rad) = said.yaw_rad else { return true };
        if !self.heading_source.admits(rank, arrival_ns) {
            return false;
        }
        let HeadingSaid { yaw_std_rad, north, source, .. } = *said;
        emit(GnssSample::Heading(Heading { arrival_ns, sample_time, yaw_rad, yaw_std_rad, north, source }));
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gnss::nmea;

    const MS: u64 = 1_000_000;

    /// Contents of sentences, and when each started and ended \[ms].
    fn samples(sentences: &[(&str, u64, u64)]) -> Vec<GnssSample> {
        let mut epochs = Epochs::default();
        let mut out = Vec::new();
        for &(content, start_ms, end_ms) in sentences {
            let arrival = Arrival { start_ns: start_ms * MS, end_ns: end_ms * MS };
            let said = nmea::parse(content).expect("test sentences are sound");
            epochs.push(said, arrival, &mut |sample| out.push(sample));
        }
        out
    }

    fn fixes(sentences: &[(&str, u64, u64)]) -> Vec<Fix> {
        let fix = |sample| if let GnssSample::Fix(fix) = sample { Some(fix) } else { None };
        samples(sentences).into_iter().filter_map(fix).collect()
    }

    const GGA: &str = "GPGGA,120000.00,4700.0,N,00800.0,E,1,08,0.9,400.0,M,48.0,M,,";
    const RMC: &str = "GPRMC,120000.00,A,4700.0,N,00800.0,E,19.4384,90.0,221126,,,A";

    #[test]
    fn deviation_of_the_same_second_is_taken_and_an_old_one_is_not() {
        let gst = "GPGST,120000.00,,,,,1.5,2.5,4.0";
        let late = "GPGGA,120002.00,4700.0,N,00800.0,E,1,08,0.9,400.0,M,48.0,M,,";
        let found = fixes(&[(gst, 0, 5), (GGA, 5, 10), (late, 2000, 2010)]);
        assert_eq!(found[0].position_std_m, Some([2.5, 1.5, 4.0]), "east is the deviation of the longitude");
        assert_eq!(found[1].position_std_m, None);
    }

    #[test]
    fn rmc_adds_speed_and_date_to_gga_without_a_fix_of_its_own() {
        let found = fixes(&[(RMC, 0, 5), (GGA, 5, 10), (RMC, 1000, 1005), (GGA, 1005, 1010)]);
        // The first RMC cannot know that a GGA will come.
        assert_eq!(found.iter().map(|fix| fix.source).collect::<Vec<_>>(), ["RMC", "GGA", "GGA"]);
        assert!((found[1].speed_mps.expect("from RMC") - 10.0).abs() < 1e-4);
        assert!(found[1].course_rad.expect("from RMC").abs() < 1e-9);
        let utc = found[1].sample_time.expect("both have it");
        assert_eq!((utc.scale, utc.ns), (crate::types::TimeScale::Utc, 1_795_348_800_000_000_000));
    }

    #[test]
    fn rmc_takes_over_when_gga_falls_silent() {
        let found = fixes(&[(GGA, 0, 10), (RMC, 20, 30), (RMC, 4000, 4010)]);
        assert_eq!(found.iter().map(|fix| fix.source).collect::<Vec<_>>(), ["GGA", "RMC"]);
    }

    #[test]
    fn heading_takes_the_time_of_the_burst_it_came_in() {
        let hdt = "HEHDT,90.0,T";
        let times: Vec<_> = samples(&[(GGA, 0, 10), (hdt, 10, 12), (hdt, 14, 16), (GGA, 100, 110), (hdt, 140, 142)])
            .into_iter()
            .filter_map(|sample| if let GnssSample::Heading(heading) = sample { Some(heading) } else { None })
            .map(|heading| heading.sample_time.is_some())
            .collect();
        assert_eq!(times, [true, false, false], "the second is of another moment; the third came after a pause");
    }

    #[test]
    fn magnetic_headings_are_not_mixed_with_true_ones() {
        let sources: Vec<_> = samples(&[
            ("HCHDM,80.0,M", 0, 1),
            ("HEHDT,90.0,T", 10, 11),
            ("HCHDM,80.0,M", 100, 101),
            ("HCHDM,80.0,M", 4000, 4001),
        ])
        .into_iter()
        .filter_map(|sample| if let GnssSample::Heading(heading) = sample { Some(heading.source) } else { None })
        .collect();
        assert_eq!(sources, ["HDM", "HDT", "HDM"]);
    }

    #[test]
    fn a_date_of_a_lost_week_count_is_refused_and_the_position_is_not() {
        let found = samples(&[("GPRMC,120000.00,A,4700.0,N,00800.0,E,,,080407,,,A", 0, 5)]);
        assert!(matches!(found[0], GnssSample::Rejected { .. }), "{found:?}");
        let GnssSample::Fix(fix) = &found[1] else { panic!("{found:?}") };
        assert_eq!(fix.sample_time.map(|time| time.scale), Some(crate::types::TimeScale::UtcOfDay));
    }
}

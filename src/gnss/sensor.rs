//! MTData2 packets of one moment and before → samples.
//!
//! The sample time is UTC when the sensor holds it for valid, otherwise its own clock (sample time fine). The position is
//! that of the sensor's filter; that of its satellite receiver alone is used only while the filter gives none.

use crate::types::{Fix, FixQuality, Geodetic, GnssSample, Heading, North, SampleTime, TimeScale};

use super::{
    epoch::Preference,
    plausibility::date_is_plausible,
    time::NS_PER_DAY,
    xbus::{PacketSaid, ReceiverSaid, Status},
};

/// Ticks of sample time fine are this long: 10 kHz.
pub(super) const NS_PER_TICK: i64 = 100_000;

/// What the satellite receiver (4 Hz) and the status said is taken for later packets up to this age.
const MAX_AGE_NS: u64 = 1_500_000_000;

const FILTER_INVALID: &str = "the sensor's filter is not valid yet";

/// Puts packets together.
#[derive(Debug, Clone, Default)]
pub(super) struct Sensor {
    /// Ticks since the sensor was switched on, counted past the wrap of its 32 bits.
    ticks: Option<i64>,
    counter: Option<u16>,
    pub packets_missed: u64,
    status: Option<(Status, u64)>,
    receiver: Option<(ReceiverSaid, u64)>,
    altitude_m: Option<(f64, u64)>,
    position_source: Preference,
}

fn recent<T: Copy>(value: Option<(T, u64)>, arrival_ns: u64) -> Option<T> {
    value.filter(|&(_, then_ns)| arrival_ns.saturating_sub(then_ns) <= MAX_AGE_NS).map(|(value, _)| value)
}

impl Sensor {
    /// Whether the packet was of use. `emit` gets what follows from it.
    pub fn push(&mut self, said: &PacketSaid, arrival_ns: u64, emit: &mut dyn FnMut(GnssSample)) -> bool {
        if let (Some(now), Some(last)) = (said.counter, self.counter) {
            // Backwards: the sensor was switched off and on.
            let missed = now.wrapping_sub(last).wrapping_sub(1);
            self.packets_missed += u64::from(if missed < 1 << 15 { missed } else { 0 });
        }
        self.counter = said.counter.or(self.counter);
        self.status = said.status.map(|status| (status, arrival_ns)).or(self.status);
        self.receiver = said.receiver.map(|receiver| (receiver, arrival_ns)).or(self.receiver);
        let altitude_m = said.altitude_m.filter(|altitude_m| altitude_m.is_finite());
        self.altitude_m = altitude_m.map(|altitude_m| (altitude_m, arrival_ns)).or(self.altitude_m);

        let sample_time = self.sample_time(said, arrival_ns, emit);
        let has_position = self.position(said, sample_time, arrival_ns, emit);
        let has_heading = self.heading(said, sample_time, arrival_ns, emit);
        if let Some(reason) = said.refused {
            emit(GnssSample::Rejected { arrival_ns, reason });
        }
        if has_position || has_heading {
            return true;
        }
        match sample_time {
            Some(sample_time @ SampleTime { scale: TimeScale::Utc, .. }) => {
                emit(GnssSample::Time { arrival_ns, sample_time });
                true
            }
            _ => said.status.is_some() || said.receiver.is_some(),
        }
    }

    fn sample_time(
        &mut self,
        said: &PacketSaid,
        arrival_ns: u64,
        emit: &mut dyn FnMut(GnssSample),
    ) -> Option<SampleTime> {
        if let Some(now) = said.sample_time_fine {
            self.ticks = Some(match self.ticks {
                // Half of the wrap forwards; backwards only by being switched off and on.
                Some(last) if now.wrapping_sub(last as u32) < 1 << 31 => {
                    last + i64::from(now.wrapping_sub(last as u32))
                }
                _ => i64::from(now),
            });
        }
        if let Some((ns, true)) = said.utc {
            if date_is_plausible(ns.div_euclid(NS_PER_DAY)) {
                return Some(SampleTime { ns, scale: TimeScale::Utc });
            }
            emit(GnssSample::Rejected { arrival_ns, reason: "stated date is before 2020 or after 2079" });
        }
        let ticks = self.ticks.filter(|_| said.sample_time_fine.is_some())?;
        Some(SampleTime { ns: ticks.checked_mul(NS_PER_TICK)?, scale: TimeScale::Device })
    }

    /// Whether the packet says where it is, or that it does not know.
    fn position(
        &mut self,
        said: &PacketSaid,
        sample_time: Option<SampleTime>,
        arrival_ns: u64,
        emit: &mut dyn FnMut(GnssSample),
    ) -> bool {
        let receiver = recent(self.receiver, arrival_ns);
        let (rank, place, velocity) = match (said.coordinates, said.receiver) {
            (Some(coordinates), _) => {
                let altitude_m = recent(self.altitude_m, arrival_ns).unwrap_or(0.0);
                let quality = filter_quality(recent(self.status, arrival_ns));
                let place = quality.map(|quality| (coordinates, altitude_m, quality, "MTData2"));
                (0, place, said.velocity_east_north_mps)
            }
            (None, Some(own)) => {
                let place =
                    receiver_quality(&own).map(|quality| (own.coordinates, own.altitude_m, quality, "GNSS PVT"));
                (1, place, Some(own.velocity_east_north_mps))
            }
            (None, None) if said.status.is_some_and(|status| !status.has_gnss_fix()) => (1, None, None),
            (None, None) => return false,
        };
        if !self.position_source.admits(rank, arrival_ns) {
            return false;
        }
        let Some(((latitude_deg, longitude_deg), altitude_m, quality, source)) = place else {
            emit(GnssSample::NoFix { arrival_ns, sample_time });
            return true;
        };
        emit(GnssSample::Fix(Fix {
            arrival_ns,
            sample_time,
            position: Geodetic { latitude_deg, longitude_deg, altitude_m },
            position_std_m: receiver.and_then(|receiver| position_std_m(&receiver)),
            quality,
            satellites: receiver.map(|receiver| receiver.satellites),
            horizontal_dilution: None,
            speed_mps: velocity.map(|[east, north]| libm::hypot(east, north)),
            course_rad: velocity.map(|[east, north]| libm::atan2(north, east)),
            source,
        }));
        true
    }

    fn heading(
        &self,
        said: &PacketSaid,
        sample_time: Option<SampleTime>,
        arrival_ns: u64,
        emit: &mut dyn FnMut(GnssSample),
    ) -> bool {
        let Some(yaw_rad) = said.yaw_rad else { return false };
        let status = recent(self.status, arrival_ns);
        if status.is_some_and(|status| !status.filter_is_valid()) {
            emit(GnssSample::Rejected { arrival_ns, reason: FILTER_INVALID });
            return true;
        }
        // Without satellites for longer than it can coast, and in sensors that have no receiver, the compass is what is left.
        let is_compass = status.is_some_and(|status| filter_quality(Some(status)).is_none());
        let north = if is_compass { North::Magnetic } else { North::True };
        let (yaw_std_rad, source) = (None, "MTData2");
        emit(GnssSample::Heading(Heading { arrival_ns, sample_time, yaw_rad, yaw_std_rad, north, source }));
        true
    }
}

/// None: the filter has no position. A sensor that sends no status is believed.
fn filter_quality(status: Option<Status>) -> Option<FixQuality> {
    match status {
        Some(status) if !status.filter_is_valid() => None,
        Some(status) if status.has_gnss_fix() => Some(FixQuality::Autonomous),
        Some(status) if status.filter_mode() == Status::COASTING => Some(FixQuality::DeadReckoning),
        Some(_) => None,
        None => Some(FixQuality::Autonomous),
    }
}

fn receiver_quality(receiver: &ReceiverSaid) -> Option<FixQuality> {
    let is_good = receiver.flags & 1 != 0;
    let is_differential = receiver.flags & 2 != 0;
    match (receiver.fix_type, receiver.flags >> 6) {
        _ if !is_good => None,
        (1, _) => Some(FixQuality::DeadReckoning),
        (2..=4, 1) => Some(FixQuality::RtkFloat),
        (2..=4, 2) => Some(FixQuality::RtkFixed),
        (2..=4, _) if is_differential => Some(FixQuality::Differential),
        (2..=4, _) => Some(FixQuality::Autonomous),
        _ => None,
    }
}

/// The horizontal accuracy is that of the distance; half of its square falls to each axis.
fn position_std_m(receiver: &ReceiverSaid) -> Option<[f64; 3]> {
    let horizontal_m = receiver.horizontal_std_m * std::f64::consts::FRAC_1_SQRT_2;
    let std_m = [horizontal_m, horizontal_m, receiver.vertical_std_m];
    std_m.iter().all(|std_m| (1e-4..=1e5).contains(std_m)).then_some(std_m)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gnss::xbus;

    /// A real packet: MTi with GNSS, 2018-08-09 in Gothenburg, ENU, f64; from the tests of github.com/einride/xsens-go
    /// (MIT), with what they say it means.
    const REAL: &str = "10100c29fac3e007e208090d3b04f710200243802033183fb6812e6000000040153a6080000000c0064185a0000000401318bf\
                        82880f200000003f28adfa000000003fb90df24000000040231 8bfecf442800000003f933e01c0000000402392e5e000000040\
                        33183f489e3f000000003f71fa9dc00000003f8bcaa00000000050230840598f1d5d2d99f1504310404cd86b0b41659c4027f1f\
                        e35ec57b8802318bf40a04be0000001bf3b06bf000000003f55729e800000008033203ff0000000000001bec5480f00000000be\
                        c14bff400000003edb73fde0000000c023183fc86a38e00000003fd409f680000000bff34d1da0000000d013183fb29903c0000\
                        0003f8731dc400000003f92861580000000e0200401800047";

    fn bytes(hex: &str) -> Vec<u8> {
        let digits: Vec<u32> = hex.chars().filter_map(|digit| digit.to_digit(16)).collect();
        digits.chunks_exact(2).map(|pair| (pair[0] << 4 | pair[1]) as u8).collect()
    }

    #[test]
    fn a_real_packet_decodes_to_what_its_owner_says() {
        let mut said = xbus::parse(&bytes(REAL)).expect("sound");
        assert_eq!(said.counter, Some(17280));
        // 2018-08-09 13:59:04.7043; before the dates that are believed in a drive.
        assert_eq!(said.utc, Some((1_533_823_144_704_300_000, true)));
        said.utc = None;
        let mut out = Vec::new();
        Sensor::default().push(&said, 7, &mut |sample| out.push(sample));
        let [GnssSample::Fix(fix), GnssSample::Heading(heading)] = &out[..] else { panic!("{out:?}") };
        assert!((fix.position.latitude_deg - 57.69076672).abs() < 1e-8);
        assert!((fix.position.longitude_deg - 11.97264260).abs() < 1e-8);
        assert!((fix.position.altitude_m - 102.23616723).abs() < 1e-8);
        assert!((fix.speed_mps.expect("velocity is there") - 0.07264732_f64.hypot(0.01132557)).abs() < 1e-8);
        assert!((heading.yaw_rad.to_degrees() - -2.78199315).abs() < 1e-8, "ENU yaw is from east");
        assert_eq!(fix.quality, FixQuality::Autonomous);
    }

    #[test]
    fn sample_time_fine_runs_on_past_its_wrap_and_starts_over_after_a_reset() {
        let mut sensor = Sensor::default();
        let mut at = |ticks: u32| {
            let said = PacketSaid { sample_time_fine: Some(ticks), ..PacketSaid::default() };
            sensor.sample_time(&said, 0, &mut |_| {}).expect("is stated").ns / NS_PER_TICK
        };
        assert_eq!(at(u32::MAX), 4_294_967_295);
        assert_eq!(at(99), 4_294_967_395);
        assert_eq!(at(199), 4_294_967_495);
        assert_eq!(at(20), 20);
    }

    #[test]
    fn status_decides_on_the_quality() {
        // Self-test, filter, fix, mode bits; from the real sample 0x01800047.
        for (status, expected) in [
            (0x0180_0047, Some(FixQuality::Autonomous)),
            (0x0080_0043, Some(FixQuality::DeadReckoning)),
            (0x0000_0043, None),
            (0x0180_0045, None),
        ] {
            assert_eq!(filter_quality(Some(Status(status))), expected, "{status:08x}");
        }
        assert_eq!(filter_quality(None), Some(FixQuality::Autonomous));
    }

    #[test]
    fn counter_gaps_are_packets_missed() {
        let mut sensor = Sensor::default();
        for counter in [65_534, 65_535, 0, 1, 5, 5, 2] {
            sensor.push(&PacketSaid { counter: Some(counter), ..PacketSaid::default() }, 0, &mut |_| {});
        }
        assert_eq!(sensor.packets_missed, 3);
    }
}

//! A receiver in the simulated world: the bytes it sends, and when they arrive.

use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{FaultKind, ReceiverProtocol, Simulation};
use crate::{
    devices::pty::{TimedBytes, received_at_rate},
    gnss::encode::{self, Measurement, XbusSensor},
    world::{Receiver, ReceiverSample},
};

/// A receiver at the wrong rate, and the port.
const SENT_BAUD: u32 = 38_400;
const READ_BAUD: u32 = 115_200;
/// How often the sensor passes on what its satellite receiver says, deviations among it.
const SATELLITES_RATE_HZ: f64 = 4.0;
/// What a receiver under open sky states.
const SATELLITES: u8 = 11;
const HORIZONTAL_DILUTION: f64 = 0.9;

/// The bytes of a drive in the order they arrive: an iterator.
pub struct SimulatedReceiver {
    simulation: Simulation,
    samples: Receiver,
    sensor: XbusSensor,
    random: ChaCha8Rng,
    tick: u64,
    /// A line delivers in order: nothing arrives before what was sent before it.
    last_arrival_ns: u64,
}

impl SimulatedReceiver {
    pub fn new(simulation: Simulation, samples: Receiver) -> Self {
        Self {
            random: ChaCha8Rng::seed_from_u64(simulation.settings.drive_seed ^ 0x5e71a1),
            simulation,
            samples,
            sensor: XbusSensor::default(),
            tick: 0,
            last_arrival_ns: 0,
        }
    }

    fn measurement(&self, sample: &ReceiverSample, stamp_ns: u64) -> Measurement {
        Measurement {
            utc_ns: self.simulation.utc_ns(stamp_ns),
            position: sample.has_fix.then_some(sample.position),
            position_std_m: sample.position_std_m,
            velocity_mps: sample.velocity_enu_mps,
            roll_rad: 0.0,
            pitch_rad: 0.0,
            yaw_rad: sample.yaw_rad,
            yaw_std_rad: sample.yaw_std_rad,
            satellites: SATELLITES,
            horizontal_dilution: HORIZONTAL_DILUTION,
        }
    }

    fn write(&mut self, measured: &Measurement, on_for_ns: i64, bytes: &mut Vec<u8>) {
        match self.simulation.settings.receiver.protocol {
            ReceiverProtocol::Nmea => encode::write_arduino_tick(self.tick, measured, bytes),
            ReceiverProtocol::Xbus => {
                let rate_hz = self.simulation.settings.receiver.rate_hz;
                let with_receiver = self.tick.is_multiple_of((rate_hz / SATELLITES_RATE_HZ).round().max(1.0) as u64);
                self.sensor.write(measured, on_for_ns, with_receiver, bytes);
            }
        }
    }
}

impl Iterator for SimulatedReceiver {
    type Item = TimedBytes;

    fn next(&mut self) -> Option<TimedBytes> {
        loop {
            let sample = self.samples.next()?;
            if sample.time_s >= self.simulation.duration_s() {
                return None;
            }
            let stamp_ns = self.simulation.stamp_ns(sample.time_s);
            let measured = self.measurement(&sample, stamp_ns);
            let mut bytes = Vec::with_capacity(256);
            self.write(&measured, (stamp_ns - self.simulation.start_ns) as i64, &mut bytes);
            self.tick += 1;

            let receiver = &self.simulation.settings.receiver;
            let jitter_s = -receiver.jitter_s * (1.0 - self.random.random::<f64>()).ln();
            let arrival_ns = stamp_ns + ((receiver.latency_s + jitter_s) * 1e9) as u64;
            self.last_arrival_ns = self.last_arrival_ns.max(arrival_ns);

            let has = |kind| self.simulation.settings.has(kind, sample.time_s);
            if has(FaultKind::ReceiverSilent) || has(FaultKind::ReceiverUnplugged) {
                continue;
            }
            if has(FaultKind::ReceiverGarbage) {
                self.random.fill_bytes(&mut bytes);
            } else if has(FaultKind::ReceiverWrongBaud) {
                bytes = received_at_rate(&bytes, SENT_BAUD, READ_BAUD);
            }
            return Some(TimedBytes { at_ns: self.last_arrival_ns, bytes });
        }
    }
}

//! A simulated Xsens MTi: measures, and answers configuration messages as the real one does.

use omniloc::gnss::{
    Protocol,
    encode::{AxesSense, Measurement, Precision, XbusFormat, XbusSensor, write_packet},
    framing::{Framed, Framer},
};

pub const TICK_MS: u64 = 10;

const GO_TO_MEASUREMENT: u8 = 0x10;
const GO_TO_CONFIG: u8 = 0x30;
const WAKE_UP: u8 = 0x3E;
const ERROR: u8 = 0x42;
const OUTPUT_CONFIGURATION: u8 = 0xC0;
const INVALID_PARAMETER: u8 = 0x21;
const EVERY_PACKET: u16 = 0xFFFF;

/// What a sensor sends: item, and how often a second.
pub type Outputs = Vec<(u16, u16)>;

/// As our own simulated sensor sends it: everything with every packet, but what the satellite receiver says.
pub fn everything() -> Outputs {
    let mut outputs =
        [0x1010, 0x1020, 0x1060, 0x2030, 0x5023, 0x5043, 0xD010, 0xE020].map(|item| (item, EVERY_PACKET)).to_vec();
    outputs.push((0x7010, 4));
    outputs
}

/// Nothing that a position could be made of: rate of turn and acceleration.
pub fn factory() -> Outputs {
    vec![(0x4020, 100), (0x8020, 100)]
}

pub struct Mti {
    pub outputs: Outputs,
    pub is_measuring: bool,
    /// Its receive line is wired.
    pub hears: bool,
    /// Messages that it does not answer, of those to come.
    pub ignored: u32,
    /// Items that its firmware does not have: it refuses a configuration with them.
    pub unknown_items: Vec<u16>,
    /// Every message that it has heard.
    pub heard: Vec<u8>,
    framer: Framer,
    sensor: XbusSensor,
    /// Since it was switched on.
    ticks: u64,
}

impl Mti {
    pub fn new(outputs: Outputs) -> Self {
        Self {
            outputs,
            is_measuring: true,
            hears: true,
            ignored: 0,
            unknown_items: Vec::new(),
            heard: Vec::new(),
            framer: Framer::new(Protocol::Xbus),
            sensor: XbusSensor::default(),
            ticks: 0,
        }
    }

    /// Says that it has been switched on.
    pub fn wake_up(&mut self) -> Vec<u8> {
        let mut bytes = Vec::new();
        write_packet(WAKE_UP, &[], &mut bytes);
        self.ticks = 0;
        bytes
    }

    /// One hundredth of a second: hears `bytes` and says what it has to say. `measured` is what it measures now.
    pub fn tick(&mut self, bytes: &[u8], measured: &Measurement) -> Vec<u8> {
        let mut messages = Vec::new();
        for &byte in bytes {
            self.framer.push(byte, &mut |framed, _| {
                let Framed::Packet { message_id, data } = framed else { panic!("{framed:?}") };
                messages.push((message_id, data.to_vec()));
            });
        }
        let mut said = Vec::new();
        for (message_id, data) in messages {
            self.answer(message_id, &data, &mut said);
        }
        if self.is_measuring {
            self.measure(measured, &mut said);
        }
        self.ticks += 1;
        said
    }

    fn answer(&mut self, message_id: u8, data: &[u8], said: &mut Vec<u8>) {
        if !self.hears {
            return;
        }
        self.heard.push(message_id);
        if self.ignored > 0 {
            self.ignored -= 1;
            return;
        }
        let reply = message_id + 1;
        match message_id {
            GO_TO_CONFIG => {
                self.is_measuring = false;
                write_packet(reply, &[], said);
            }
            // All others are for the configuration state only.
            _ if self.is_measuring => write_packet(ERROR, &[4], said),
            GO_TO_MEASUREMENT => {
                self.is_measuring = true;
                write_packet(reply, &[], said);
            }
            OUTPUT_CONFIGURATION => {
                let asked: Outputs = data.chunks(4).map(|entry| (word(entry), word(&entry[2..]))).collect();
                if asked.iter().any(|(item, _)| self.unknown_items.contains(item)) {
                    write_packet(ERROR, &[INVALID_PARAMETER], said);
                    return;
                }
                if !asked.is_empty() {
                    self.outputs = asked;
                }
                let list: Vec<u8> = self
                    .outputs
                    .iter()
                    .flat_map(|(item, rate_hz)| [item.to_be_bytes(), rate_hz.to_be_bytes()].concat())
                    .collect();
                write_packet(reply, &list, said);
            }
            _ => write_packet(ERROR, &[4], said),
        }
    }

    /// Our own encoder's packet with the items that are configured.
    fn measure(&mut self, measured: &Measurement, said: &mut Vec<u8>) {
        let precision = |kind: u16| {
            let found = self.outputs.iter().find(|(item, _)| item & 0xFFF0 == kind);
            Precision::ALL[usize::from(found.map_or(0, |(item, _)| item & 3))]
        };
        let axes = self.outputs.iter().find(|(item, _)| item & 0xFFF0 == 0x2030).map_or(0, |(item, _)| item >> 2 & 3);
        self.sensor.format = XbusFormat {
            attitude: precision(0x2030),
            position: precision(0x5040),
            axes: AxesSense::ALL[usize::from(axes)],
        };
        let mut all = Vec::new();
        self.sensor.write(measured, (self.ticks * TICK_MS * 1_000_000) as i64, true, &mut all);
        let mut data = Vec::new();
        let header_bytes = if all[3] == 0xFF { 6 } else { 4 };
        let mut rest = &all[header_bytes..all.len() - 1];
        while !rest.is_empty() {
            let (entry, behind) = rest.split_at(3 + usize::from(rest[2]));
            self.item_if_due(entry, &mut data);
            rest = behind;
        }
        for (item, content) in [(0x8830, dilutions()), (0x8840, solution(measured))] {
            let entry = [&[(item >> 8) as u8, item as u8, content.len() as u8], &content[..]].concat();
            self.item_if_due(&entry, &mut data);
        }
        if !data.is_empty() {
            write_packet(0x36, &data, said);
        }
    }

    fn item_if_due(&self, entry: &[u8], data: &mut Vec<u8>) {
        let kind = word(entry) & 0xFFF0;
        let rate_hz = self.outputs.iter().find(|(item, _)| item & 0xFFF0 == kind).map(|&(_, rate_hz)| rate_hz);
        let is_due = rate_hz.is_some_and(|rate_hz| match rate_hz {
            EVERY_PACKET => true,
            0 => false,
            rate_hz => self.ticks.is_multiple_of((100 / u64::from(rate_hz)).max(1)),
        });
        if is_due {
            data.extend(entry);
        }
    }
}

fn word(bytes: &[u8]) -> u16 {
    u16::from_be_bytes([bytes[0], bytes[1]])
}

/// North, east, vertical and position as the old firmware states them: 0.6, 0.8, 2.4 and 2.6.
fn dilutions() -> Vec<u8> {
    let mut content = vec![0; 4];
    content.extend([300_u16, 260, 100, 240, 100, 60, 80].iter().flat_map(|dilution| dilution.to_be_bytes()));
    content
}

/// Accuracy in space and satellites as the old firmware states them.
fn solution(measured: &Measurement) -> Vec<u8> {
    let mut content = vec![0; 52];
    content[10] = if measured.position.is_some() { 3 } else { 0 };
    content[11] = u8::from(measured.position.is_some());
    content[24..28].copy_from_slice(&OLD_ACCURACY_CM.to_be_bytes());
    content[47] = measured.satellites;
    content
}

/// With its dilutions: deviations of 1.2, 1.6 and 4.8 m.
const OLD_ACCURACY_CM: u32 = 520;

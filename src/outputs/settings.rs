//! The table `[outputs]` of a configuration.

use std::{
    collections::BTreeSet,
    net::{IpAddr, SocketAddr},
    ops::RangeInclusive,
    path::PathBuf,
};

use serde::{Deserialize, Deserializer, Serialize, de};

use super::nmea::{MAX_SENTENCE_BYTES, Sentence};

/// Where estimates go; each is independent of the others.
#[derive(Debug, Clone, PartialEq, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// JSON lines on stdout.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stdout: Option<StdoutSettings>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nmea_tcp: Vec<TcpSettings>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nmea_udp: Vec<UdpSettings>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nmea_serial: Vec<SerialSettings>,
}

#[derive(Debug, Clone, PartialEq, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct StdoutSettings {
    /// Absent: every frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_rate_hz: Option<f64>,
}

/// A server for programs such as gpsd (`tcp://127.0.0.1:10110`) and OpenCPN.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct TcpSettings {
    /// `127.0.0.1:10110` for this computer only, `0.0.0.0:10110` for everybody. 10110 is registered for NMEA 0183.
    pub listen: Address,
    #[serde(default = "default_max_clients")]
    pub max_clients: usize,
    #[serde(default = "all_sentences")]
    pub sentences: Vec<Sentence>,
    /// Absent: every frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_rate_hz: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct UdpSettings {
    /// A computer, a broadcast address or a multicast group.
    pub target: Address,
    #[serde(default = "all_sentences")]
    pub sentences: Vec<Sentence>,
    /// Absent: every frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_rate_hz: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SerialSettings {
    /// A name that does not change when it is plugged in again, such as one in `/dev/serial/by-id`.
    pub port: PathBuf,
    /// 4800 is what NMEA 0183 says, 38400 its high-speed variant.
    pub baud: u32,
    #[serde(default = "all_sentences")]
    pub sentences: Vec<Sentence>,
    #[serde(default = "default_serial_rate_hz")]
    pub max_rate_hz: f64,
}

fn default_max_clients() -> usize {
    8
}

fn all_sentences() -> Vec<Sentence> {
    Sentence::ALL.to_vec()
}

/// All sentences fit 4800 baud.
fn default_serial_rate_hz() -> f64 {
    1.0
}

/// An IP address and a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(transparent)]
pub struct Address(pub SocketAddr);

impl<'de> Deserialize<'de> for Address {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        const EXPECTED: &str = "an IP address and a port such as \"127.0.0.1:10110\"";
        let text = String::deserialize(deserializer)?;
        let address = text.parse().ok().filter(|address: &SocketAddr| address.port() != 0);
        address.map(Self).ok_or_else(|| de::Error::invalid_value(de::Unexpected::Str(&text), &EXPECTED))
    }
}

const RATES_HZ: RangeInclusive<f64> = 0.01..=1000.0;

impl Settings {
    /// Whether any of them needs the map's origin.
    pub fn has_nmea(&self) -> bool {
        !(self.nmea_tcp.is_empty() && self.nmea_udp.is_empty() && self.nmea_serial.is_empty())
    }

    pub fn check(&self) -> Result<(), String> {
        if let Some(stdout) = &self.stdout {
            check_rate(stdout.max_rate_hz).map_err(|what| format!("stdout.{what}"))?;
        }
        check_each("nmea_tcp", &self.nmea_tcp, TcpSettings::check)?;
        check_each("nmea_udp", &self.nmea_udp, UdpSettings::check)?;
        check_each("nmea_serial", &self.nmea_serial, SerialSettings::check)?;
        let ports = self.nmea_tcp.iter().map(|tcp| tcp.listen.0.port());
        refuse_twice(ports, |port| format!("nmea_tcp: two listen on port {port}"))?;
        refuse_twice(self.nmea_udp.iter().map(|udp| udp.target.0), |target| format!("nmea_udp: two send to {target}"))?;
        let lines = self.nmea_serial.iter().map(|serial| &serial.port);
        refuse_twice(lines, |port| format!("nmea_serial: two use port {port:?}"))
    }
}

impl TcpSettings {
    fn check(&self) -> Result<(), String> {
        if !(1..=1000).contains(&self.max_clients) {
            return Err(format!("max_clients is {}, expected 1 to 1000", self.max_clients));
        }
        check_sentences(&self.sentences)?;
        check_rate(self.max_rate_hz)
    }
}

impl UdpSettings {
    fn check(&self) -> Result<(), String> {
        if self.target.0.ip().is_unspecified() {
            let found = self.target.0;
            return Err(format!("target is \"{found}\", expected a computer, a broadcast or a multicast address"));
        }
        check_sentences(&self.sentences)?;
        check_rate(self.max_rate_hz)
    }

    /// The address to send from: any, of the same kind.
    pub(super) fn local(&self) -> SocketAddr {
        let any = match self.target.0.ip() {
            IpAddr::V4(_) => IpAddr::from([0; 4]),
            IpAddr::V6(_) => IpAddr::from([0; 16]),
        };
        SocketAddr::new(any, 0)
    }
}

impl SerialSettings {
    fn check(&self) -> Result<(), String> {
        if !self.port.is_absolute() {
            return Err(format!("port is {:?}, expected a path such as \"/dev/ttyUSB0\"", self.port));
        }
        if !(1200..=4_000_000).contains(&self.baud) {
            return Err(format!("baud is {}, expected 1200 to 4000000", self.baud));
        }
        check_sentences(&self.sentences)?;
        check_rate(Some(self.max_rate_hz))?;
        // Eight data bits between a start and a stop bit.
        let line_bytes_per_s = f64::from(self.baud) / 10.0;
        let estimate_bytes = (self.sentences.len() * MAX_SENTENCE_BYTES) as f64;
        if estimate_bytes * self.max_rate_hz > line_bytes_per_s {
            let fits_hz = line_bytes_per_s / estimate_bytes;
            return Err(format!(
                "max_rate_hz is {}, but {} baud carry {} sentences at most {fits_hz:.2} times a second",
                self.max_rate_hz,
                self.baud,
                self.sentences.len()
            ));
        }
        Ok(())
    }
}

fn check_each<T>(name: &str, tables: &[T], check: fn(&T) -> Result<(), String>) -> Result<(), String> {
    tables.iter().try_for_each(|table| check(table).map_err(|what| format!("{name}.{what}")))
}

fn check_rate(max_rate_hz: Option<f64>) -> Result<(), String> {
    match max_rate_hz {
        Some(rate_hz) if !RATES_HZ.contains(&rate_hz) => {
            Err(format!("max_rate_hz is {rate_hz}, expected {} to {}", RATES_HZ.start(), RATES_HZ.end()))
        }
        _ => Ok(()),
    }
}

fn check_sentences(sentences: &[Sentence]) -> Result<(), String> {
    let distinct: BTreeSet<_> = sentences.iter().collect();
    if sentences.is_empty() || distinct.len() != sentences.len() {
        return Err("sentences is empty or names one twice, expected some of \"gst\", \"gga\", \"pgrme\", \"rmc\", \
                    \"hdt\""
            .into());
    }
    Ok(())
}

fn refuse_twice<T: Ord + Copy>(items: impl Iterator<Item = T>, what: impl Fn(T) -> String) -> Result<(), String> {
    let mut seen = BTreeSet::new();
    for item in items {
        if !seen.insert(item) {
            return Err(what(item));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Settings, String> {
        let settings: Settings = toml::from_str(text).map_err(|error| error.message().to_owned())?;
        settings.check().map(|()| settings)
    }

    const ALL: &str = "[stdout]\n[[nmea_tcp]]\nlisten = \"127.0.0.1:10110\"\n[[nmea_tcp]]\nlisten = \"[::]:10111\"\n\
        max_clients = 2\nsentences = [\"rmc\"]\nmax_rate_hz = 5.0\n[[nmea_udp]]\ntarget = \"239.2.1.1:10110\"\n\
        [[nmea_serial]]\nport = \"/dev/ttyUSB0\"\nbaud = 4800\n";

    #[test]
    fn what_is_left_out_has_a_default_and_is_written_out() {
        let settings = read(ALL).expect("sound");
        assert_eq!(settings.nmea_tcp[0].sentences, Sentence::ALL);
        assert_eq!((settings.nmea_tcp[0].max_clients, settings.nmea_serial[0].max_rate_hz), (8, 1.0));
        let resolved = toml::to_string(&settings).expect("tables");
        assert_eq!(read(&resolved).expect("loads again"), settings, "{resolved}");
        assert_eq!(read(""), Ok(Settings::default()));
    }

    #[test]
    fn the_documented_example_is_sound() {
        #[derive(Deserialize)]
        struct File {
            outputs: Settings,
        }
        let document = include_str!("../../docs/outputs.md");
        let example = document.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).expect("is there");
        let File { outputs } = toml::from_str(example).expect("loads");
        assert_eq!(outputs.check(), Ok(()));
        assert!(outputs.stdout.is_some());
        let counts = [outputs.nmea_tcp.len(), outputs.nmea_udp.len(), outputs.nmea_serial.len()];
        assert_eq!(counts, [1; 3]);
    }

    #[test]
    fn what_cannot_be_is_refused_with_what_is_expected() {
        for (text, expected) in [
            ("[stdout]\nmax_rate_hz = 0.0", "stdout.max_rate_hz is 0, expected 0.01 to 1000"),
            ("[stdout]\nformat = \"json\"", "unknown field `format`"),
            ("[[nmea_tcp]]\n", "missing field `listen`"),
            ("[[nmea_tcp]]\nlisten = \"localhost:10110\"", "an IP address and a port such as \"127.0.0.1:10110\""),
            ("[[nmea_tcp]]\nlisten = \"127.0.0.1:0\"", "an IP address and a port"),
            ("[[nmea_tcp]]\nlisten = \"127.0.0.1:1\"\nmax_clients = 0", "nmea_tcp.max_clients is 0"),
            ("[[nmea_tcp]]\nlisten = \"127.0.0.1:1\"\nsentences = []", "nmea_tcp.sentences is empty"),
            ("[[nmea_tcp]]\nlisten = \"127.0.0.1:1\"\nsentences = [\"rmc\", \"rmc\"]", "names one twice"),
            ("[[nmea_tcp]]\nlisten = \"127.0.0.1:1\"\nsentences = [\"vtg\"]", "unknown variant `vtg`"),
            ("[[nmea_tcp]]\nlisten = \"127.0.0.1:1\"\n[[nmea_tcp]]\nlisten = \"0.0.0.0:1\"", "two listen on port 1"),
            ("[[nmea_udp]]\ntarget = \"0.0.0.0:1\"", "nmea_udp.target is \"0.0.0.0:1\""),
            ("[[nmea_serial]]\nport = \"ttyUSB0\"\nbaud = 4800", "nmea_serial.port is \"ttyUSB0\""),
            ("[[nmea_serial]]\nport = \"/dev/ttyUSB0\"\nbaud = 300", "nmea_serial.baud is 300"),
            (
                "[[nmea_serial]]\nport = \"/dev/ttyUSB0\"\nbaud = 4800\nmax_rate_hz = 10",
                "4800 baud carry 5 sentences at most 1.17 times a second",
            ),
        ] {
            let error = read(text).expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}

//! The receiver: what speaks on its line, is there a position, is there a yaw?

use std::{path::Path, sync::Arc, time::Duration};

use super::{Finding, advice, fault, look_at};
use crate::{
    devices::{DeviceError, SerialEvent},
    gnss::{DecoderCounters, DecoderSettings, GnssDecoder},
    runtime::live::DeviceRun,
    types::{Clock, ClockReading, Fix, GnssSample, Heading, NS_PER_S, North, TimeScale},
};

/// The speed of the line is looked for within this, and then a position.
const LIMIT: Duration = Duration::from_secs(15);
/// Once everything has come, this much more shows at what rate.
const SETTLED_NS: u64 = 3 * NS_PER_S;
/// Positions that come more seldom make gaps that nothing is interpolated over.
const LEAST_FIX_HZ: f64 = 1.5;
/// Worse than this on an axis is no ground truth for a map \[m\].
const POOR_STD_M: f64 = 5.0;
/// Realtime may be so far from the receiver's \[s\].
const CLOCK_S: f64 = 2.0;

/// What was heard of the receiver.
#[derive(Debug, Default)]
pub struct Look {
    pub opened: Option<(String, u32)>,
    pub bytes: usize,
    pub counters: DecoderCounters,
    pub fix: Option<Fix>,
    pub heading: Option<Heading>,
    /// Arrivals of the first and the last fix, and of the first and the last heading.
    pub fixes_ns: Option<[u64; 2]>,
    pub headings_ns: Option<[u64; 2]>,
    /// Realtime minus the receiver's UTC \[s\].
    pub clock_ahead_s: Option<f64>,
    pub error: Option<DeviceError>,
}

impl Look {
    pub fn at(receiver: DeviceRun<SerialEvent>, decoder: &DecoderSettings, clock: &Arc<dyn Clock>) -> Self {
        let mut look = Self::default();
        let mut decoder = GnssDecoder::new(decoder);
        let mut samples = Vec::new();
        let outcome = look_at(receiver, clock, LIMIT, |event, clocks| {
            match event {
                SerialEvent::Opened { port, baud } => look.opened = Some((port.display().to_string(), baud)),
                SerialEvent::Chunk(chunk) => {
                    look.bytes += chunk.bytes.len();
                    decoder.push(&chunk, &mut samples);
                    samples.drain(..).for_each(|sample| look.take(sample, clocks));
                }
            }
            !look.is_settled(clocks.monotonic_ns)
        });
        look.counters = decoder.counters();
        look.error = outcome.err();
        look
    }

    fn take(&mut self, sample: GnssSample, clocks: ClockReading) {
        let since = |times: &mut Option<[u64; 2]>, now_ns| times.get_or_insert([now_ns; 2])[1] = now_ns;
        match sample {
            GnssSample::Fix(fix) => {
                since(&mut self.fixes_ns, fix.arrival_ns);
                if let Some(time) = fix.sample_time.filter(|time| time.scale == TimeScale::Utc) {
                    self.clock_ahead_s = Some((clocks.realtime_ns - time.ns) as f64 * 1e-9);
                }
                self.fix = Some(fix);
            }
            GnssSample::Heading(heading) => {
                since(&mut self.headings_ns, heading.arrival_ns);
                self.heading = Some(heading);
            }
            _ => {}
        }
    }

    fn is_settled(&self, now_ns: u64) -> bool {
        let first_ns = self.fixes_ns.zip(self.headings_ns).map(|(fixes, headings)| fixes[0].max(headings[0]));
        first_ns.is_some_and(|first_ns| now_ns > first_ns + SETTLED_NS)
    }
}

fn rate_hz(count: u64, times_ns: Option<[u64; 2]>) -> Option<f64> {
    let [first_ns, last_ns] = times_ns?;
    (last_ns > first_ns).then(|| (count - 1) as f64 * NS_PER_S as f64 / (last_ns - first_ns) as f64)
}

/// `port`: of a real line.
pub fn findings(look: &Look, port: Option<&Path>) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Some(error) = &look.error {
        let list = Path::new("/dev/serial/by-id");
        findings.push(Finding::problem("receiver", fault(error), advice(error, "port", list)));
    }
    let Some((opened, baud)) = &look.opened else {
        if findings.is_empty() {
            let found =
                format!("nothing comes on {}", port.map_or("the line".into(), |port| port.display().to_string()));
            let what = "is it powered, is the right port named in [gnss], are its wires on the right pins?";
            findings.push(Finding::problem("receiver", found, what));
        }
        return findings;
    };
    let counters = &look.counters;
    let understood = counters.fixes + counters.headings + counters.no_fixes + counters.times + counters.ignored;
    let damaged = counters.framing.refused();
    let line = format!("{opened} at {baud} baud: {} bytes, {understood} messages, {damaged} damaged", look.bytes);
    if understood == 0 {
        let what = "nothing of it is NMEA or Xbus: check `baud` and `protocol` in [gnss], and what the receiver is set to send";
        findings.push(Finding::problem("receiver", line, what));
        return findings;
    }
    if understood == counters.ignored {
        let what = "the Arduino is well and its sensor says nothing: the MTi's power, its wires to pins 19 and 18, the level \
                    shifter; or the receiver is not set to send GGA and HDT, MTData2 and the like";
        let found = format!("{line}, of which none says a position, a yaw or a time");
        findings.push(Finding::warning("receiver", found, what));
        return findings;
    }
    findings.push(match damaged * 20 > understood {
        true => Finding::warning("receiver", line, "shorter or better wires, a common ground, the right level shifter"),
        false => Finding::ok("receiver", line),
    });
    findings.push(fix(look));
    findings.push(yaw(look));
    findings.extend(clock(look));
    findings
}

fn fix(look: &Look) -> Finding {
    let Some(fix) = &look.fix else {
        let found = match look.counters.rejected {
            0 => "no position yet".into(),
            rejected => format!("{rejected} positions came that cannot be believed"),
        };
        return Finding::warning(
            "position",
            found,
            "the antenna needs a free view of the sky; the first fix may take minutes",
        );
    };
    let std_m = fix.position_std_m.map(|[east_m, north_m, _]| east_m.max(north_m));
    let rate_hz = rate_hz(look.counters.fixes, look.fixes_ns);
    let mut found = format!("{:?} from {}", fix.quality, fix.source);
    if let Some(satellites) = fix.satellites {
        found += &format!(", {satellites} satellites");
    }
    if let Some(std_m) = std_m {
        found += &format!(", to {std_m:.1} m");
    }
    if let Some(rate_hz) = rate_hz {
        found += &format!(", {rate_hz:.1} a second");
    }
    if std_m.is_some_and(|std_m| std_m > POOR_STD_M) {
        return Finding::warning("position", found, "wait until it has settled, under a free sky");
    }
    if rate_hz.is_some_and(|rate_hz| rate_hz < LEAST_FIX_HZ) {
        let what = "set the receiver to at least 2 positions a second, or raise sync.max_gap_s";
        return Finding::warning("position", found, what);
    }
    Finding::ok("position", found)
}

fn yaw(look: &Look) -> Finding {
    let Some(heading) = &look.heading else {
        let what = "maps get no heading without it: have the receiver send HDT, HDM, PHTRO or MTData2 with yaw";
        return Finding::warning("yaw", "none", what);
    };
    let rate =
        rate_hz(look.counters.headings, look.headings_ns).map_or(String::new(), |hz| format!(", {hz:.1} a second"));
    let found = format!("{:.1} deg from {}{rate}", heading.yaw_rad.to_degrees(), heading.source);
    match heading.north {
        North::True => Finding::ok("yaw", found),
        North::Magnetic => Finding::warning(
            "yaw",
            format!("{found}, against magnetic north"),
            "set sync.magnetic_declination_deg to that of the place",
        ),
    }
}

fn clock(look: &Look) -> Option<Finding> {
    let ahead_s = look.clock_ahead_s?;
    Some(match ahead_s.abs() > CLOCK_S {
        true => Finding::warning(
            "date",
            format!("the computer's clock is {ahead_s:+.0} s from the receiver's"),
            "recordings keep the receiver's time, so nothing is lost; a clock with a battery or a network would set it",
        ),
        false => Finding::ok("date", format!("the computer's clock is {ahead_s:+.2} s from the receiver's")),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        doctor::Verdict,
        types::{FixQuality, Geodetic},
    };

    fn look() -> Look {
        let fix = Fix {
            arrival_ns: 9 * NS_PER_S,
            sample_time: None,
            position: Geodetic { latitude_deg: 51.0, longitude_deg: 7.0, altitude_m: 100.0 },
            position_std_m: Some([1.0, 1.2, 2.0]),
            quality: FixQuality::Autonomous,
            satellites: Some(9),
            horizontal_dilution: None,
            speed_mps: None,
            course_rad: None,
            source: "GGA",
        };
        let heading = Heading {
            arrival_ns: 9 * NS_PER_S,
            sample_time: None,
            yaw_rad: 1.0,
            yaw_std_rad: None,
            north: North::True,
            source: "HDT",
        };
        Look {
            opened: Some(("/dev/ttyACM0".into(), 115_200)),
            bytes: 1000,
            counters: DecoderCounters { fixes: 13, headings: 13, ..DecoderCounters::default() },
            fix: Some(fix),
            heading: Some(heading),
            fixes_ns: Some([6 * NS_PER_S, 9 * NS_PER_S]),
            headings_ns: Some([6 * NS_PER_S, 9 * NS_PER_S]),
            clock_ahead_s: Some(0.1),
            error: None,
        }
    }

    fn verdicts(look: &Look) -> Vec<(&'static str, Verdict)> {
        findings(look, None).iter().map(|finding| (finding.check, finding.verdict)).collect()
    }

    #[test]
    fn a_good_receiver_is_well() {
        let names = ["receiver", "position", "yaw", "date"];
        assert_eq!(verdicts(&look()), names.map(|name| (name, Verdict::Ok)));
        let found = findings(&look(), None)[1].found.clone();
        assert_eq!(found, "Autonomous from GGA, 9 satellites, to 1.2 m, 4.0 a second");
    }

    #[test]
    fn what_is_wrong_is_found() {
        let cases: [(Look, &str, Verdict); 8] = [
            (Look { opened: None, ..look() }, "receiver", Verdict::Problem),
            (Look { counters: DecoderCounters::default(), ..look() }, "receiver", Verdict::Problem),
            (
                Look { counters: DecoderCounters { ignored: 30, ..DecoderCounters::default() }, ..look() },
                "receiver",
                Verdict::Warning,
            ),
            (Look { fix: None, ..look() }, "position", Verdict::Warning),
            (Look { fixes_ns: Some([0, 13 * NS_PER_S]), ..look() }, "position", Verdict::Warning),
            (Look { heading: None, ..look() }, "yaw", Verdict::Warning),
            (Look { clock_ahead_s: Some(-1.6e9), ..look() }, "date", Verdict::Warning),
            (
                Look { error: Some(DeviceError::Busy { device: "x".into() }), opened: None, ..look() },
                "receiver",
                Verdict::Problem,
            ),
        ];
        for (look, check, verdict) in cases {
            assert!(verdicts(&look).contains(&(check, verdict)), "{check}: {:?}", verdicts(&look));
        }
    }
}

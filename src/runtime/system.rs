//! What the computer says about itself: processor time, memory, temperature, throttling. What it does not say is absent.

use std::fs;

use crate::types::NS_PER_S;

/// One look at this process and the board it runs on.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SystemStatus {
    /// Processor time since the look before; 1 is one core.
    pub cpu_cores: f64,
    /// Resident memory of the process.
    pub resident_bytes: u64,
    pub temperature_celsius: Option<f64>,
    /// The Raspberry Pi's `get_throttled` bits.
    pub throttled: Option<u32>,
}

/// Remembers the look before.
#[derive(Debug, Default)]
pub struct SystemMonitor {
    last: Option<(u64, u64)>,
}

impl SystemMonitor {
    /// `now_ns` on the monotonic clock.
    pub fn look(&mut self, now_ns: u64) -> SystemStatus {
        let used_ns = cpu_time_ns();
        let cpu_cores = match self.last.replace((now_ns, used_ns)) {
            Some((last_ns, last_used_ns)) if now_ns > last_ns => {
                used_ns.saturating_sub(last_used_ns) as f64 / (now_ns - last_ns) as f64
            }
            _ => 0.0,
        };
        SystemStatus {
            cpu_cores,
            resident_bytes: resident_bytes(),
            temperature_celsius: read_number::<i64>("/sys/class/thermal/thermal_zone0/temp").map(|m| m as f64 * 1e-3),
            throttled: fs::read_to_string("/sys/devices/platform/soc/soc:firmware/get_throttled")
                .ok()
                .and_then(|text| u32::from_str_radix(text.trim().trim_start_matches("0x"), 16).ok()),
        }
    }
}

fn read_number<T: std::str::FromStr>(path: &str) -> Option<T> {
    fs::read_to_string(path).ok()?.trim().parse().ok()
}

/// Processor time of all threads of this process.
fn cpu_time_ns() -> u64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as u64 * NS_PER_S + time.tv_nsec as u64
}

fn resident_bytes() -> u64 {
    let pages = fs::read_to_string("/proc/self/statm")
        .ok()
        .and_then(|text| text.split_whitespace().nth(1).and_then(|pages| pages.parse::<u64>().ok()));
    pages.unwrap_or(0) * rustix::param::page_size() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processor_time_and_memory_are_those_of_this_process() {
        let mut monitor = SystemMonitor::default();
        monitor.look(0);
        let (_, before_ns) = monitor.last.expect("has looked");
        let mut sum = 0u64;
        while cpu_time_ns() < before_ns + 20_000_000 {
            sum = std::hint::black_box(sum + 1);
        }
        let status = monitor.look(NS_PER_S);
        assert!(status.cpu_cores >= 0.02, "{status:?}");
        assert!(status.resident_bytes > 1 << 20, "{status:?}");
    }
}

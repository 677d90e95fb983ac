//! What the computer says about itself: processor time, memory, temperature, throttling. What it does not say is absent.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::LazyLock,
};

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
            throttled: THROTTLED
                .as_ref()
                .and_then(|path| fs::read_to_string(path).ok())
                .and_then(|text| u32::from_str_radix(text.trim().trim_start_matches("0x"), 16).ok()),
        }
    }
}

/// Realtime before this, 2020, is that of a computer that was never told the date.
const LEAST_REALTIME_NS: i64 = 1_577_836_800_000_000_000;

/// A clock with a battery agrees with realtime to this: one whose battery is empty, or was never put in, starts in 1970 \[s\].
const BATTERY_CLOCK_S: u64 = 3600;

/// Whether realtime may be taken for UTC. Without a battery clock a computer starts with the date at which it was switched
/// off, until systemd-timesyncd, where that keeps the time, has heard a better one.
pub fn knows_date(realtime_ns: i64) -> bool {
    realtime_ns >= LEAST_REALTIME_NS && is_kept(Path::new("/"), realtime_ns)
}

fn is_kept(root: &Path, realtime_ns: i64) -> bool {
    let clock = root.join("sys/class/rtc/rtc0");
    let read = |name: &str| fs::read_to_string(clock.join(name)).ok().and_then(|text| text.trim().parse::<i64>().ok());
    let has_battery = read("hctosys") == Some(1)
        && read("since_epoch").is_some_and(|s| (realtime_ns / NS_PER_S as i64).abs_diff(s) <= BATTERY_CLOCK_S);
    let timesync = root.join("run/systemd/timesync");
    has_battery || !timesync.exists() || timesync.join("synchronized").exists()
}

static THROTTLED: LazyLock<Option<PathBuf>> = LazyLock::new(|| find_throttled(Path::new("/sys/devices/platform")));

/// What a Raspberry Pi says of its voltage: `soc/soc:firmware/get_throttled`, on a Pi 5 below `soc@107c000000:firmware`.
fn find_throttled(platform: &Path) -> Option<PathBuf> {
    let inside = |folder: &Path| {
        let mut paths: Vec<PathBuf> =
            fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
        paths.sort();
        paths
    };
    let of_soc = inside(platform).into_iter().filter(|path| name_of(path).starts_with("soc"));
    let firmware =
        of_soc.flat_map(|soc| [inside(&soc), vec![soc]].concat()).filter(|path| name_of(path).ends_with(":firmware"));
    firmware.map(|path| path.join("get_throttled")).find(|path| path.exists())
}

fn name_of(path: &Path) -> &str {
    path.file_name().and_then(|name| name.to_str()).unwrap_or_default()
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
    fn what_a_pi_says_of_its_voltage_is_found_on_every_kind() {
        for firmware in ["soc/soc:firmware", "soc@107c000000:firmware", "axi/soc:firmware"] {
            let platform = tempfile::tempdir().expect("a folder");
            assert_eq!(find_throttled(platform.path()), None);
            let folder = platform.path().join(firmware);
            fs::create_dir_all(&folder).expect("a folder");
            assert_eq!(find_throttled(platform.path()), None, "no such file");
            let file = folder.join("get_throttled");
            fs::write(&file, "0\n").expect("writes");
            let expected = (!firmware.starts_with("axi")).then_some(file);
            assert_eq!(find_throttled(platform.path()), expected);
        }
    }

    #[test]
    fn the_date_of_the_last_switching_off_is_no_date() {
        const NOW_NS: i64 = 1_790_000_000 * NS_PER_S as i64;
        let root = tempfile::tempdir().expect("a folder");
        let write = |path: &str, text: &str| {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
            fs::write(path, text).expect("writes");
        };
        assert!(is_kept(root.path(), NOW_NS), "by something else than systemd-timesyncd");
        fs::create_dir_all(root.path().join("run/systemd/timesync")).expect("a folder");
        assert!(!is_kept(root.path(), NOW_NS), "it has heard of none yet");
        write("sys/class/rtc/rtc0/hctosys", "0\n");
        assert!(!is_kept(root.path(), NOW_NS), "a clock that the kernel did not take the time of");
        write("run/systemd/timesync/synchronized", "");
        assert!(is_kept(root.path(), NOW_NS));
        fs::remove_file(root.path().join("run/systemd/timesync/synchronized")).expect("removes");
        write("sys/class/rtc/rtc0/hctosys", "1\n");
        write("sys/class/rtc/rtc0/since_epoch", "40\n");
        assert!(!is_kept(root.path(), NOW_NS), "a clock without a battery");
        write("sys/class/rtc/rtc0/since_epoch", "1789999990\n");
        assert!(is_kept(root.path(), NOW_NS), "a clock with a battery");
        assert!(!knows_date(LEAST_REALTIME_NS - 1));
    }

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

//! How a drive was recorded, as the recording itself says: losses, processor, memory, disk.

use std::collections::BTreeMap;

use super::proto::omniloc::{Dropped, Status};

/// What `/status` and `/dropped` add up to.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DriveHealth {
    /// Seconds with a status.
    pub seconds: u64,
    /// Lost messages by topic and reason.
    pub lost: BTreeMap<(String, String), u64>,
    /// Processor time of the program, 1 is one core: mean and largest over a second.
    pub mean_cpu_cores: f64,
    pub max_cpu_cores: f64,
    /// Resident memory without what waited for the disk: largest in the first minute, and after it.
    pub first_minute_resident_bytes: u64,
    pub later_resident_bytes: Option<u64>,
    /// Most that waited for the disk, and the longest wait.
    pub max_queue_bytes: u64,
    pub max_disk_stall_s: f64,
    pub max_temperature_celsius: Option<f64>,
    /// Seconds in which camera, receiver or disk said that something is wrong.
    pub troubles: BTreeMap<String, u64>,
}

const FIRST_MINUTE_S: u64 = 60;

impl DriveHealth {
    pub(super) fn add_status(&mut self, status: &Status) {
        self.seconds += 1;
        // A running mean: m ← m + (x − m) / n.
        self.mean_cpu_cores += (status.cpu_cores - self.mean_cpu_cores) / self.seconds as f64;
        self.max_cpu_cores = self.max_cpu_cores.max(status.cpu_cores);
        let resident_bytes = status.resident_bytes.saturating_sub(status.queue_bytes);
        if self.seconds <= FIRST_MINUTE_S {
            self.first_minute_resident_bytes = self.first_minute_resident_bytes.max(resident_bytes);
        } else {
            self.later_resident_bytes = self.later_resident_bytes.max(Some(resident_bytes));
        }
        self.max_queue_bytes = self.max_queue_bytes.max(status.queue_bytes);
        self.max_disk_stall_s = self.max_disk_stall_s.max(status.disk_stall_s);
        let hottest = [self.max_temperature_celsius, status.temperature_celsius].into_iter().flatten();
        self.max_temperature_celsius = hottest.reduce(f64::max);
        let devices = [("camera", &status.camera_health), ("gnss", &status.gnss_health), ("disk", &status.disk_health)];
        let is_trouble = |health: &str| !["ok", "waiting", "stopped", ""].contains(&health);
        for (device, health) in devices.into_iter().filter(|(_, health)| is_trouble(health)) {
            *self.troubles.entry(format!("{device} {health}")).or_default() += 1;
        }
    }

    pub(super) fn add_loss(&mut self, loss: Dropped) {
        *self.lost.entry((loss.topic, loss.reason)).or_default() += loss.count;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_of_the_first_minute_is_kept_apart_and_what_waits_is_not_counted() {
        let mut health = DriveHealth::default();
        for second in 0..100 {
            health.add_status(&Status {
                cpu_cores: if second % 2 == 0 { 0.2 } else { 0.4 },
                resident_bytes: 30_000_000 + second * 1000,
                queue_bytes: second * 1000,
                camera_health: if second < 3 { "silent" } else { "ok" }.into(),
                gnss_health: "waiting".into(),
                ..Status::default()
            });
        }
        assert_eq!(health.first_minute_resident_bytes, 30_000_000);
        assert_eq!(health.later_resident_bytes, Some(30_000_000));
        assert!((health.mean_cpu_cores - 0.3).abs() < 1e-12);
        assert_eq!((health.max_cpu_cores, health.max_queue_bytes), (0.4, 99_000));
        assert_eq!(health.troubles, BTreeMap::from([("camera silent".into(), 3)]));
        for _ in 0..2 {
            health.add_loss(Dropped { topic: "/camera/image".into(), count: 3, ..Dropped::default() });
        }
        assert_eq!(health.lost.values().sum::<u64>(), 6);
    }
}

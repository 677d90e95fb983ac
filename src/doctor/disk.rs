//! The disk: is there room, and how long does it keep one waiting?

use std::{
    fs::File,
    io::{self, Write},
    path::Path,
    time::{Duration, Instant},
};

use rustix::fs::{StatVfs, statvfs};

use super::Finding;
use crate::recording::recorder::Settings;

/// What a camera of 30 frames a second sends, unless this one has been looked at.
const BYTES_PER_S: f64 = 4e6;
/// Pieces that are written and synced, as the recorder does.
const WRITES: usize = 40;
/// At most so long.
const LIMIT: Duration = Duration::from_secs(20);
/// A drive of this length should have room \[h\].
const LEAST_HOURS: f64 = 1.0;
/// The queue bridges longer ones, but a disk that does this often wears out.
const LONG: Duration = Duration::from_secs(1);

pub fn examine(settings: &Settings, bytes_per_s: Option<f64>) -> Vec<Finding> {
    let bytes_per_s = bytes_per_s.unwrap_or(BYTES_PER_S);
    let found = |error: &io::Error| format!("{}: {error}", settings.folder.display());
    let folder = existing(&settings.folder);
    let space = match statvfs(folder) {
        Ok(space) => self::space(settings, &space, bytes_per_s),
        Err(error) => Finding::problem("disk", found(&error.into()), "check the file system"),
    };
    let piece = (bytes_per_s * settings.sync_interval_ms as f64 * 1e-3) as usize;
    let writes = match measure(folder, piece) {
        Ok(waits) => stalls(&waits, piece, bytes_per_s),
        Err(error) => {
            let advice = "this user must be able to write there: sudo chown, or another `folder` in [recorder]; for the \
                          services: systemctl edit, ReadWritePaths=";
            Finding::problem("disk writes", found(&error), advice)
        }
    };
    vec![space, writes]
}

/// The folder, or the one in which recording will make it.
fn existing(folder: &Path) -> &Path {
    let found = folder.ancestors().find(|path| path.exists()).unwrap_or(folder);
    if found.as_os_str().is_empty() { Path::new(".") } else { found }
}

fn space(settings: &Settings, space: &StatVfs, bytes_per_s: f64) -> Finding {
    let (free, total) = (space.f_bavail * space.f_frsize, space.f_blocks * space.f_frsize);
    let kept =
        (settings.min_free_mib << 20).min(total / 2).max((settings.min_free_percent * 0.01 * total as f64) as u64);
    let hours = free.saturating_sub(kept) as f64 / bytes_per_s / 3600.0;
    let found = format!(
        "{}: {:.1} of {:.1} GB free, {hours:.1} h until the oldest recordings are deleted",
        settings.folder.display(),
        free as f64 * 1e-9,
        total as f64 * 1e-9
    );
    match hours < LEAST_HOURS {
        true => Finding::warning("disk", found, "fetch recordings and delete them here, or use a larger disk"),
        false => Finding::ok("disk", found),
    }
}

/// How long each of some pieces took to be on the disk for good.
fn measure(folder: &Path, piece: usize) -> io::Result<Vec<Duration>> {
    let mut file: File = tempfile::tempfile_in(folder)?;
    let bytes: Vec<u8> = (0..piece as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let started = Instant::now();
    let mut waits = Vec::with_capacity(WRITES);
    while waits.len() < WRITES && started.elapsed() < LIMIT {
        let before = Instant::now();
        file.write_all(&bytes)?;
        file.sync_data()?;
        waits.push(before.elapsed());
    }
    Ok(waits)
}

fn stalls(waits: &[Duration], piece: usize, bytes_per_s: f64) -> Finding {
    let mut sorted = waits.to_vec();
    sorted.sort_unstable();
    let at =
        |percent: usize| sorted.get((sorted.len() * percent / 100).min(sorted.len() - 1)).copied().unwrap_or_default();
    let total: Duration = sorted.iter().sum();
    let rate = (piece * sorted.len()) as f64 / total.as_secs_f64().max(1e-9);
    let ms = |wait: Duration| wait.as_secs_f64() * 1e3;
    let found = format!(
        "{:.0} kB at a time: half within {:.0} ms, 99 % within {:.0} ms, at most {:.0} ms; {:.1} MB a second, {:.1} needed",
        piece as f64 * 1e-3,
        ms(at(50)),
        ms(at(99)),
        ms(at(100)),
        rate * 1e-6,
        bytes_per_s * 1e-6
    );
    if rate < bytes_per_s {
        let advice = "a faster card (A2, U3) or an SSD on USB 3; or a lower frame rate";
        return Finding::problem("disk writes", found, advice);
    }
    if at(100) > LONG || rate < 2.0 * bytes_per_s {
        return Finding::warning("disk writes", found, "a faster card (A2, U3) or an SSD on USB 3");
    }
    Finding::ok("disk writes", found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;

    #[test]
    fn slow_disks_are_told_from_fast_ones() {
        let waits = |ms: u64, longest_ms: u64| {
            let mut waits = vec![Duration::from_millis(ms); 39];
            waits.push(Duration::from_millis(longest_ms));
            waits
        };
        let verdict = |waits: &[Duration]| stalls(waits, 2_000_000, 4e6).verdict;
        assert_eq!(verdict(&waits(40, 90)), Verdict::Ok);
        assert_eq!(verdict(&waits(40, 3000)), Verdict::Warning);
        assert_eq!(verdict(&waits(400, 400)), Verdict::Warning);
        assert_eq!(verdict(&waits(700, 900)), Verdict::Problem);
        let found = stalls(&waits(40, 90), 2_000_000, 4e6).found;
        assert!(
            found.starts_with("2000 kB at a time: half within 40 ms, 99 % within 90 ms, at most 90 ms;"),
            "{found}"
        );
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_a_problem() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let file = folder.path().join("file");
        std::fs::write(&file, "no folder").expect("writes");
        let findings = examine(&Settings::new(file.join("recordings")), None);
        assert_eq!((findings[1].check, findings[1].verdict), ("disk writes", Verdict::Problem));
    }

    #[test]
    fn a_folder_that_is_not_there_is_not_made() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let findings = examine(&Settings::new(folder.path().join("new/recordings")), Some(1e5));
        assert_eq!(findings.iter().map(|finding| finding.check).collect::<Vec<_>>(), ["disk", "disk writes"]);
        assert!(!folder.path().join("new").exists());
    }
}

//! The disk: is there room, and how long does it keep one waiting?

use std::{
    fs::File,
    io::{self, Seek, Write},
    path::Path,
    time::{Duration, Instant},
};

use rustix::fs::{StatVfs, statfs, statvfs};

use super::Finding;
use crate::recording::recorder::Settings;

/// What a camera of 30 frames a second sends, unless this one has been looked at.
const BYTES_PER_S: f64 = 4e6;
/// Pieces that are written and synced, as the recorder does: enough for 99 of a hundred to say something.
const WRITES: usize = 200;
/// After so many the file begins anew: a disk that is nearly full is not filled.
const PIECES_KEPT: usize = 20;
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
            let advice = match error.kind() {
                io::ErrorKind::StorageFull => "fetch recordings and delete them here, or use a larger disk",
                io::ErrorKind::ReadOnlyFilesystem => "mount it for writing: after an error, fsck and start again",
                _ => {
                    "this user must be able to write there: sudo chown, or another `folder` in [recorder]; for the services: \
                     systemctl edit, ReadWritePaths="
                }
            };
            Finding::problem("disk writes", found(&error), advice)
        }
    };
    [Some(space), in_memory(folder), Some(writes)].into_iter().flatten().collect()
}

/// The folder, or the one in which recording will make it.
fn existing(folder: &Path) -> &Path {
    let here = |path| if path == Path::new("") { Path::new(".") } else { path };
    folder.ancestors().map(here).find(|path| path.exists()).unwrap_or(folder)
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
        if waits.len().is_multiple_of(PIECES_KEPT) {
            file.set_len(0)?;
            file.rewind()?;
        }
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
    let finding = match () {
        () if rate < bytes_per_s => {
            let advice = "a faster card (A2, U3) or an SSD on USB 3; or a lower frame rate";
            Finding::problem("disk writes", found, advice)
        }
        () if at(100) > LONG || rate < 2.0 * bytes_per_s => {
            Finding::warning("disk writes", found, "a faster card (A2, U3) or an SSD on USB 3")
        }
        () => Finding::ok("disk writes", found),
    };
    let us = |wait: Duration| wait.as_micros() as u64;
    let figures = [
        ("piece_bytes", piece as u64),
        ("pieces", sorted.len() as u64),
        ("p50_us", us(at(50))),
        ("p99_us", us(at(99))),
        ("longest_us", us(at(100))),
        ("written_bytes_per_s", rate as u64),
        ("needed_bytes_per_s", bytes_per_s as u64),
    ];
    Finding { figures: figures.into(), ..finding }
}

/// File systems that are gone with the power: tmpfs and ramfs, and overlayfs, which a read-only root has its changes in.
const IN_MEMORY: [i64; 3] = [0x0102_1994, 0x8584_58f6, 0x794c_7630];

fn in_memory(folder: &Path) -> Option<Finding> {
    let kind = statfs(folder).ok()?.f_type as i64;
    IN_MEMORY.contains(&kind).then(|| {
        let found = format!("{}: on tmpfs, or an overlay that may be in memory", folder.display());
        let advice = "recordings would be gone with the power: a partition of its own, and overlayroot=tmpfs:recurse=0";
        Finding::warning("disk", found, advice)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;

    #[test]
    fn slow_disks_are_told_from_fast_ones() {
        let waits = |ms: u64, longest_ms: u64| {
            let mut waits = vec![Duration::from_millis(ms); 199];
            waits.push(Duration::from_millis(longest_ms));
            waits
        };
        let verdict = |waits: &[Duration]| stalls(waits, 2_000_000, 4e6).verdict;
        assert_eq!(verdict(&waits(40, 90)), Verdict::Ok);
        assert_eq!(verdict(&waits(40, 3000)), Verdict::Warning);
        assert_eq!(verdict(&waits(400, 400)), Verdict::Warning);
        assert_eq!(verdict(&waits(700, 900)), Verdict::Problem);
        let Finding { found, figures, .. } = stalls(&waits(40, 90), 2_000_000, 4e6);
        assert_eq!([figures["p50_us"], figures["p99_us"], figures["longest_us"]], [40_000, 40_000, 90_000]);
        assert!(
            found.starts_with("2000 kB at a time: half within 40 ms, 99 % within 40 ms, at most 90 ms;"),
            "{found}"
        );
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_a_problem() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let file = folder.path().join("file");
        std::fs::write(&file, "no folder").expect("writes");
        let findings = examine(&Settings::new(file.join("recordings")), None);
        let last = findings.last().expect("several");
        assert_eq!((last.check, last.verdict), ("disk writes", Verdict::Problem));
    }

    #[test]
    fn a_folder_that_is_not_there_is_not_made() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let findings = examine(&Settings::new(folder.path().join("new/recordings")), Some(1e5));
        let last = findings.last().expect("several");
        assert!(last.check == "disk writes" && last.figures["p50_us"] <= last.figures["p99_us"], "{findings:?}");
        assert!(!folder.path().join("new").exists());
    }
}

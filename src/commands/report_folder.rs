//! The folder of a report: what is in it is only replaced by a report, whole, and only when told.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use tempfile::TempDir;

use super::BadArgument;

const PAGE: &str = "index.html";
const JSON: &str = "report.json";
const FIGURES: &str = "figures";
/// The new report is drawn in a folder of such a name within the old one: surely on the same disk, even where the folder is
/// one of its own (a mount), and the old report stays as it is until the new one is whole.
const DRAWING: &str = ".drawing-";

/// A folder that can be written to.
pub struct ReportFolder {
    path: PathBuf,
    /// Made when drawing begins, removed when dropped.
    drawing: Option<TempDir>,
    /// Made for this report: removed again if nothing comes of it.
    is_new: bool,
}

impl ReportFolder {
    /// Makes the folder if it is not there.
    ///
    /// # Errors
    /// It holds anything but a report, or a report and `force` is not given; it cannot be made or written to.
    pub fn open(path: &Path, force: bool) -> anyhow::Result<Self> {
        check(path, force)?;
        let is_new = !path.exists();
        let cannot = |what: &str, error: std::io::Error| {
            BadArgument(format!("--report {}: cannot {what} this folder: {error}", path.display()))
        };
        if is_new {
            fs::create_dir(path).map_err(|error| cannot("make", error))?;
        }
        remove_left_over(path, None);
        // Evaluating takes long: whether it can be written to is tried now, but nothing is left there meanwhile.
        new_drawing(path).map_err(|error| {
            if is_new {
                _ = fs::remove_dir(path);
            }
            cannot("write to", error)
        })?;
        Ok(Self { path: path.into(), drawing: None, is_new })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where the new report is drawn from now on.
    pub fn drawing(&mut self) -> std::io::Result<PathBuf> {
        let drawing = match self.drawing.take() {
            Some(drawing) => drawing,
            None => new_drawing(&self.path)?,
        };
        Ok(self.drawing.insert(drawing).path().into())
    }

    /// Puts what was drawn in the place of what was there; returns the page.
    pub fn show(mut self) -> anyhow::Result<PathBuf> {
        let drawing = self.drawing()?;
        let old = drawing.join("old");
        fs::create_dir(&old).with_context(|| format!("making the folder {}", old.display()))?;
        // The page goes first and comes last: where there is one, there is everything it refers to.
        let mut away = [PAGE, JSON, FIGURES].into_iter();
        let mut here = [FIGURES, JSON, PAGE].into_iter();
        let replaced = away
            .try_for_each(|name| move_if_there(&self.path.join(name), &old.join(name)))
            .and_then(|()| here.try_for_each(|name| move_if_there(&drawing.join(name), &self.path.join(name))));
        if replaced.is_err() {
            for name in [FIGURES, JSON, PAGE].into_iter().filter(|name| old.join(name).exists()) {
                _ = move_if_there(&self.path.join(name), &drawing.join(name));
                _ = move_if_there(&old.join(name), &self.path.join(name));
            }
        }
        replaced?;
        self.is_new = false;
        remove_left_over(&self.path, Some(&drawing));
        Ok(self.path.join(PAGE))
    }
}

impl Drop for ReportFolder {
    fn drop(&mut self) {
        if self.is_new {
            drop(self.drawing.take());
            // Not if anything else has come into it.
            _ = fs::remove_dir(&self.path);
        }
    }
}

fn new_drawing(folder: &Path) -> std::io::Result<TempDir> {
    tempfile::Builder::new().prefix(DRAWING).tempdir_in(folder)
}

fn move_if_there(from: &Path, to: &Path) -> anyhow::Result<()> {
    match fs::rename(from, to) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("moving {} to {}", from.display(), to.display()))
        }
        _ => Ok(()),
    }
}

/// Removes what reports that were cut off have left in `folder`, but for `kept`.
fn remove_left_over(folder: &Path, kept: Option<&Path>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for path in entries.flatten().map(|entry| entry.path()).filter(|path| is_left_over(path) && Some(&**path) != kept) {
        _ = fs::remove_dir_all(path);
    }
}

fn is_left_over(path: &Path) -> bool {
    path.is_dir() && path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(DRAWING))
}

/// Refuses a folder that holds anything but a report, and a report unless `force` is given.
fn check(folder: &Path, force: bool) -> anyhow::Result<()> {
    let bad = |what: String| Err(BadArgument(format!("--report {}: {what}", folder.display())).into());
    let Ok(facts) = fs::metadata(folder) else {
        let parent = folder.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        return if parent.is_dir() { Ok(()) } else { bad(format!("there is no folder {}", parent.display())) };
    };
    if !facts.is_dir() {
        return bad("exists and is not a folder; choose another name".into());
    }
    let is_ours = |path: &Path| match path.file_name().and_then(|name| name.to_str()) {
        Some(PAGE | JSON) => path.is_file(),
        Some(FIGURES) => {
            fs::read_dir(path).is_ok_and(|entries| entries.flatten().all(|entry| is_figure(&entry.path())))
        }
        _ => false,
    };
    let entries = fs::read_dir(folder).with_context(|| format!("reading the folder {}", folder.display()))?;
    let entries: Vec<PathBuf> =
        entries.flatten().map(|entry| entry.path()).filter(|path| !is_left_over(path)).collect();
    if let Some(foreign) = entries.iter().find(|path| !is_ours(path)) {
        let name = foreign.file_name().unwrap_or_default().to_string_lossy().into_owned();
        return bad(format!("holds {name}, which is no part of a report; choose another name"));
    }
    if !entries.is_empty() && !force {
        return bad("holds a report already; give --force to replace it".into());
    }
    Ok(())
}

fn is_figure(path: &Path) -> bool {
    path.is_file() && path.extension().is_some_and(|extension| extension == "svg" || extension == "png")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(folder: &Path, figure: &str, page: &str) {
        fs::create_dir_all(folder.join(FIGURES)).expect("a folder");
        fs::write(folder.join(FIGURES).join(figure), "").expect("writes");
        fs::write(folder.join(JSON), "{}").expect("writes");
        fs::write(folder.join(PAGE), page).expect("writes");
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).expect("readable");
        let mut names: Vec<String> =
            entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    #[test]
    fn only_reports_are_replaced_and_only_when_told() {
        let temporary = tempfile::tempdir().expect("a temporary folder");
        let folder = temporary.path().join("report");
        assert!(check(&folder, false).is_ok(), "not there yet");
        write(&folder, "old.svg", "old");
        let refused = check(&folder, false).expect_err("it is there");
        assert!(refused.to_string().contains("--force"), "{refused}");
        assert!(check(&folder, true).is_ok());
        fs::write(folder.join("thesis.tex"), "").expect("writes");
        let refused = check(&folder, true).expect_err("it is not ours");
        assert!(refused.to_string().contains("thesis.tex"), "{refused}");
        let refused = check(&temporary.path().join("no/folder"), true).expect_err("nowhere");
        assert!(refused.to_string().contains("there is no folder"), "{refused}");
    }

    #[test]
    fn the_old_report_stays_until_the_new_one_is_whole() {
        let temporary = tempfile::tempdir().expect("a temporary folder");
        let folder = temporary.path().join("report");
        write(&folder, "old.svg", "old");
        // Of a run that was cut off.
        fs::create_dir(folder.join(".drawing-abc")).expect("a folder");
        let mut failed = ReportFolder::open(&folder, true).expect("it can be replaced");
        assert_eq!(names(&folder), [FIGURES, PAGE, JSON], "nothing is left over, and nothing drawn yet");
        write(&failed.drawing().expect("it can be written to"), "new.svg", "new");
        drop(failed);
        assert_eq!(fs::read(folder.join(PAGE)).expect("readable"), b"old");

        let mut replaced = ReportFolder::open(&folder, true).expect("it can be replaced");
        write(&replaced.drawing().expect("it can be written to"), "new.svg", "new");
        let page = replaced.show().expect("replaces");
        assert_eq!(fs::read(page).expect("readable"), b"new");
        assert_eq!(names(&folder), [FIGURES, PAGE, JSON]);
        assert_eq!(names(&folder.join(FIGURES)), ["new.svg"]);
    }

    #[test]
    fn a_folder_that_comes_to_nothing_is_not_left() {
        let temporary = tempfile::tempdir().expect("a temporary folder");
        let folder = temporary.path().join("report");
        let mut failed = ReportFolder::open(&folder, false).expect("it can be made");
        write(&failed.drawing().expect("it can be written to"), "new.svg", "new");
        assert!(folder.is_dir());
        drop(failed);
        assert!(!folder.exists());
    }
}

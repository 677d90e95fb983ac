//! Simulated drives through the whole program.

#![allow(dead_code, reason = "each test program uses a part")]

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    thread,
    time::Duration,
};

use omniloc::recording::{proto::omniloc as proto, topics};
use prost::Message;
use rustix::process::Pid;

use super::omniloc_path;

/// Longer than any drive here, by far.
pub const PATIENCE: Duration = Duration::from_secs(240);

/// Writes a configuration; `faults` are `(kind, at_s, lasts_s)`.
pub fn configure(folder: &Path, simulation: &str, faults: &[(&str, f64, f64)]) -> PathBuf {
    let mut toml = format!(
        "[vehicle]\nname = \"test car\"\n[camera]\ndriver = \"simulated\"\n[gnss]\ndriver = \"simulated\"\n\
         [recorder]\nfolder = \"recordings\"\nmin_free_mib = 64\nmin_free_percent = 0.0\n\
         [simulation]\nplace = \"corridor\"\nwidth_px = 320\nheight_px = 180\nframe_rate_hz = 5.0\n{simulation}\n"
    );
    if !simulation.contains("[simulation.receiver]") {
        toml += "[simulation.receiver]\nrate_hz = 50.0\n";
    }
    for (kind, at_s, lasts_s) in faults {
        toml += &format!("[[simulation.faults]]\nkind = \"{kind}\"\nat_s = {at_s:.1}\nlasts_s = {lasts_s:.1}\n");
    }
    let path = folder.join("drive.toml");
    fs::write(&path, toml).expect("writes");
    path
}

pub fn start(config: &Path) -> Child {
    command(config).spawn().expect("starts")
}

pub fn command(config: &Path) -> Command {
    let mut command = Command::new(omniloc_path());
    command.arg("record").arg("--config").arg(config).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

pub fn wait(child: Child) -> Output {
    let pid = Pid::from_child(&child);
    let watchdog = thread::spawn(move || {
        thread::park_timeout(PATIENCE);
        pid
    });
    let output = child.wait_with_output().expect("ends");
    watchdog.thread().unpark();
    output
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

pub fn finished(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(folder.join("recordings")).expect("readable").map(|entry| entry.expect("entry").path()).collect();
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "mcap"));
    paths.sort();
    paths
}

/// Everything of one topic in a recording.
pub fn messages<M: Message + Default>(path: &Path, topic: &topics::Topic) -> Vec<(u64, M)> {
    let bytes = fs::read(path).expect("readable");
    let of_topic = mcap::MessageStream::new(&bytes).expect("a recording").map(|message| message.expect("sound"));
    of_topic
        .filter(|message| message.channel.topic == topic.name)
        .map(|message| (message.publish_time, M::decode(&*message.data).expect("decodes")))
        .collect()
}

/// Words that `/status` said, from the second after the first frame on.
pub fn health(statuses: &[(u64, proto::Status)], word: impl Fn(&proto::Status) -> &str) -> BTreeSet<String> {
    let started = statuses.iter().filter(|(_, status)| status.frames > 0 && status.serial_bytes > 0);
    started.map(|(_, status)| word(status).to_owned()).collect()
}

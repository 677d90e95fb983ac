//! What systemd hears of the program.

mod common;

use std::{
    os::unix::net::UnixDatagram,
    path::Path,
    process::{Child, Command, Stdio},
    time::Duration,
};

use common::{
    drive::{configure, stderr, wait},
    omniloc_path,
};
use rustix::process::{Pid, Signal, kill_process};

/// systemd's end of the line.
struct Manager {
    socket: UnixDatagram,
}

impl Manager {
    fn new(folder: &Path) -> Self {
        let socket = UnixDatagram::bind(folder.join("notify")).expect("binds");
        socket.set_read_timeout(Some(Duration::from_secs(120))).expect("a time limit");
        Self { socket }
    }

    fn start(&self, folder: &Path, config: &Path) -> Child {
        Command::new(omniloc_path())
            .args(["record", "--config"])
            .arg(config)
            .env("NOTIFY_SOCKET", folder.join("notify"))
            .env("WATCHDOG_USEC", "30000000")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("starts")
    }

    /// The next message.
    fn hear(&self) -> String {
        let mut bytes = [0; 4096];
        let length = self.socket.recv(&mut bytes).expect("says something");
        String::from_utf8(bytes[..length].to_vec()).expect("text")
    }

    /// Messages up to one that begins like this, and that.
    fn hear_until(&self, begin: &str) -> Vec<String> {
        let mut heard = Vec::new();
        while heard.last().is_none_or(|last: &String| !last.starts_with(begin)) {
            heard.push(self.hear());
        }
        heard
    }
}

/// The watchdog is fed while everything flows, starves while the camera is stuck, and is fed again.
#[test]
fn the_watchdog_is_fed_by_what_flows() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let manager = Manager::new(folder.path());
    let config = configure(folder.path(), "duration_s = 3600.0", &[("camera-stalled", 6.0, 12.0)]);
    let child = manager.start(folder.path(), &config);
    assert!(manager.hear_until("READY=1").len() == 1, "ready is the first word");
    manager.hear_until("WATCHDOG=1");
    // Every second a status line; the food comes right after it.
    let mut fed: Vec<(bool, String)> = Vec::new();
    let mut line = manager.hear_until("STATUS=").pop().expect("a line");
    let is_back = |fed: &[(bool, String)]| {
        let starved = fed.iter().position(|(is_fed, _)| !is_fed);
        starved.is_some_and(|at| fed[at..].iter().filter(|(is_fed, _)| *is_fed).count() > 3)
    };
    while !is_back(&fed) {
        let next = manager.hear();
        let is_fed = next.starts_with("WATCHDOG=1");
        fed.push((is_fed, line));
        line = if is_fed { manager.hear_until("STATUS=").pop().expect("a line") } else { next };
    }
    for (is_fed, line) in &fed {
        assert_eq!(*is_fed, line.contains("camera ok") && line.contains("gnss ok"), "{line}");
    }
    assert!(fed.iter().any(|(_, line)| line.contains("camera silent")), "{fed:?}");

    kill_process(Pid::from_child(&child), Signal::TERM).expect("runs");
    manager.hear_until("STOPPING=1");
    let output = wait(child);
    assert!(output.status.code().is_some(), "{}", stderr(&output));
}

/// Whoever is unplugged is waited for; a new start would not bring it back.
#[test]
fn a_device_that_is_not_there_starves_nothing() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let manager = Manager::new(folder.path());
    let config = configure(folder.path(), "duration_s = 3600.0", &[("camera-unplugged", 3.0, 600.0)]);
    let child = manager.start(folder.path(), &config);
    let mut fed_without = 0;
    while fed_without < 4 {
        let line = manager.hear_until("STATUS=").pop().expect("a line");
        if line.contains("camera disconnected") || line.contains("camera not present") {
            assert!(manager.hear().starts_with("WATCHDOG=1"), "{line}");
            fed_without += 1;
        }
    }
    kill_process(Pid::from_child(&child), Signal::TERM).expect("runs");
    let output = wait(child);
    assert!(output.status.code().is_some(), "{}", stderr(&output));
}

/// What systemd itself says of the units.
#[test]
fn the_units_are_sound_and_tight() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd");
    for unit in ["omniloc-record.service", "omniloc-localize.service"] {
        let output = Command::new("systemd-analyze")
            .args(["security", "--offline=true", "--threshold=15"])
            .arg(folder.join(unit))
            .output()
            .expect("systemd-analyze is installed");
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{unit}: {}", said.lines().last().unwrap_or_default());
    }
    let verify = Command::new("systemd-analyze")
        .args(["verify", "--man=no"])
        .args(["omniloc-record.service", "omniloc-localize.service", "omniloc.target"].map(|unit| folder.join(unit)))
        .output()
        .expect("systemd-analyze is installed");
    let said = String::from_utf8_lossy(&verify.stderr);
    // Where the package is not installed its program is missing, which is another matter.
    let faults: Vec<&str> = said.lines().filter(|line| !line.contains("is not executable")).collect();
    assert!(faults.is_empty(), "{faults:?}");
}

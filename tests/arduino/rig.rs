//! The sketch, compiled and running: on an emulated board, or its logic on this computer.

use std::{
    collections::HashMap,
    io::{BufRead, BufReader, Write},
    path::{Path, PathBuf},
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
    sync::OnceLock,
};

pub const CYCLES_PER_MS: u64 = 16_000;

/// Both programs take the same lines: see `simavr.c`.
pub struct Rig {
    child: Child,
    stdin: ChildStdin,
    stdout: BufReader<ChildStdout>,
}

/// What the sketch has sent in a turn.
pub struct Sent {
    pub to_computer: Vec<u8>,
    pub to_sensor: Vec<u8>,
}

impl Rig {
    /// On the emulated ATmega2560.
    pub fn board() -> Self {
        static BUILT: OnceLock<(PathBuf, PathBuf, String)> = OnceLock::new();
        let (runner, elf, loop_address) = BUILT.get_or_init(|| {
            let folder = folder("board");
            let runner = folder.join("simavr");
            checked(command("arduino/build").arg(&folder));
            checked(
                command("cc")
                    .args(["-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-I/usr/include/simavr"])
                    .args(["tests/arduino/simavr.c", "-lsimavr", "-lelf", "-o"])
                    .arg(&runner),
            );
            let elf = folder.join("omniloc_bridge.elf");
            let symbols = checked(command("avr-nm").arg(&elf));
            let is_loop = |line: &&str| line.ends_with(" T loop");
            let line = symbols.lines().find(is_loop).expect("the sketch has a loop");
            let address = line.split(' ').next().expect("an address").to_owned();
            (runner, elf, address)
        });
        Self::start(command(runner).arg(elf).arg(loop_address))
    }

    /// Its logic as a program of this computer, with what finds reads and shifts that are none.
    pub fn native() -> Self {
        static BUILT: OnceLock<PathBuf> = OnceLock::new();
        let runner = BUILT.get_or_init(|| {
            let runner = folder("native").join("native");
            let sources = ["bridge", "device", "lines", "xbus", "fixed"].map(|name| format!("{SKETCH}/{name}.cpp"));
            checked(
                command("c++")
                    .args(["-std=c++11", "-O1", "-Wall", "-Wextra", "-Werror"])
                    .args(["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-I", SKETCH])
                    .arg("tests/arduino/native.cpp")
                    .args(sources)
                    .arg("-o")
                    .arg(&runner),
            );
            runner
        });
        Self::start(&mut command(runner))
    }

    fn start(command: &mut Command) -> Self {
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("the rig starts");
        let stdin = child.stdin.take().expect("is piped");
        let stdout = BufReader::new(child.stdout.take().expect("is piped"));
        Self { child, stdin, stdout }
    }

    /// The sensor sends `bytes`, back to back, while so much time goes by.
    pub fn run(&mut self, ms: u64, bytes: &[u8]) -> Sent {
        self.turn("run", ms, bytes)
    }

    /// The same with stop bits missing.
    pub fn noise(&mut self, ms: u64, bytes: &[u8]) -> Sent {
        self.turn("noise", ms, bytes)
    }

    pub fn pulse(&mut self, level: bool) {
        self.ask(&format!("pulse {}\n", u8::from(level)));
    }

    /// Counts of the emulation.
    pub fn stats(&mut self) -> HashMap<String, u64> {
        let answer = self.ask("stats\n");
        let words: Vec<_> = answer.split_whitespace().collect();
        words.chunks(2).map(|pair| (pair[0].to_owned(), pair[1].parse().expect("a count"))).collect()
    }

    fn turn(&mut self, what: &str, ms: u64, bytes: &[u8]) -> Sent {
        let bytes: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        let answer = self.ask(&format!("{what} {} {bytes}-\n", ms * CYCLES_PER_MS));
        let (to_computer, to_sensor) = answer.trim_end().split_once(' ').expect("two answers");
        Sent { to_computer: from_hex(to_computer), to_sensor: from_hex(to_sensor) }
    }

    fn ask(&mut self, line: &str) -> String {
        self.stdin.write_all(line.as_bytes()).expect("the rig listens");
        let mut answer = String::new();
        self.stdout.read_line(&mut answer).expect("the rig answers");
        assert!(answer.ends_with('\n'), "the rig has ended; what it said is above");
        answer
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

const SKETCH: &str = "arduino/omniloc_bridge";

fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("arduino").join(name);
    std::fs::create_dir_all(&folder).expect("a folder");
    folder
}

fn command(program: impl AsRef<Path>) -> Command {
    let program = program.as_ref();
    // A relative path would be looked up before the folder is changed.
    let is_ours = program.starts_with("arduino");
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut command = Command::new(if is_ours { here.join(program) } else { program.to_owned() });
    command.current_dir(here);
    command
}

/// Its output.
fn checked(command: &mut Command) -> String {
    const PACKAGES: &str =
        "g++ gcc-avr avr-libc binutils-avr arduino-core-avr libsimavr-dev libelf-dev: tests/run installs them";
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}; needs {PACKAGES}"));
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {said}\nneeds {PACKAGES}");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn from_hex(text: &str) -> Vec<u8> {
    let digit = |byte: u8| char::from(byte).to_digit(16).expect("a digit") as u8;
    text.trim_end_matches('-').as_bytes().chunks(2).map(|pair| digit(pair[0]) << 4 | digit(pair[1])).collect()
}

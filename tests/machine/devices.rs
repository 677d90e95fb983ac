//! What the emulated machine's devices are fed with, for tests/machine/run.
//!
//! ```text
//! devices receiver           a pseudo-terminal, whose name is printed, on which the simulated MTi drives through the town
//! devices pictures OUT N     N pictures of a drive as YUYV, one after the other; where each was taken, east and north of
//!                            the town's origin [m], is printed, after the origin itself [deg]
//! ```

use std::{
    env,
    fs::File,
    io::{BufWriter, Write},
    path::Path,
};

use anyhow::bail;
use omniloc::{
    devices::{
        Stop,
        pty::{Pace, Pty},
        simulated::{Settings, Simulation},
    },
    jpeg::LumaDecoder,
    types::{Clock, SystemClock},
    world::{Day, Renderer},
};
use rustix::{
    fs::{Mode, OFlags},
    io::ioctl_fionread,
    termios::{QueueSelector, tcflush},
};

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["receiver"] => receiver(),
        ["pictures", out, count] => pictures(Path::new(out), count.parse()?),
        _ => bail!("usage: devices receiver | devices pictures OUT COUNT"),
    }
}

/// Sends what the Arduino would, for a day at most. Bytes that nobody reads are lost, as on a line: a pseudo-terminal that the
/// emulator holds open while nothing is plugged in would keep them, and begin with where the vehicle was long ago.
fn receiver() -> anyhow::Result<()> {
    /// What an adapter holds, generously \[bytes]: two tenths of a second of what is sent.
    const HELD_BYTES: u64 = 2048;
    let settings: Settings = toml::from_str("place = 'town'\nduration_s = 86400.0")?;
    let pty = Pty::open(None)?;
    println!("{}", pty.path().display());
    std::io::stdout().flush()?;
    let world = settings.world();
    let now = SystemClock.read();
    let simulation = Simulation::new(&settings, &world, now.monotonic_ns, now.realtime_ns);
    let line = rustix::fs::open(pty.path(), OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
    let bytes = simulation.receiver(&world).inspect(|_| {
        if ioctl_fionread(&line).is_ok_and(|unread_bytes| unread_bytes > HELD_BYTES) {
            tcflush(&line, QueueSelector::IFlush).expect("a terminal's unread bytes can be dropped");
        }
    });
    pty.play(bytes, Pace::Clock, &SystemClock, &Stop::default())?;
    Ok(())
}

/// Every fifth of a second of a stretch of another day's drive: other light, other traffic, another lane than in the survey
/// of `omniloc demo`. Gray, as the program looks at nothing but luma.
fn pictures(out: &Path, count: u32) -> anyhow::Result<()> {
    const INTERVAL_S: f64 = 0.2;
    /// Of the stretch, from the start of the drive: the vehicle is on its way.
    const FROM_S: f64 = 20.0;
    /// No colour.
    const GRAY: u8 = 128;
    let settings: Settings = toml::from_str("place = 'town'\nday_seed = 2\ndrive_seed = 2\nlane_shift_m = 0.4")?;
    // BT.601: luma is 16 to 235.
    let levels: [u8; 256] = std::array::from_fn(|level| (16.0 + level as f64 * 219.0 / 255.0).round() as u8);
    let world = settings.world();
    let simulation = Simulation::new(&settings, &world, 0, 0);
    let mut renderer = Renderer::new(&world, &Day::new(settings.day_seed), &settings.camera())?;
    let mut decoder = LumaDecoder::new();
    let (mut jpeg, mut file) = (Vec::new(), BufWriter::new(File::create(out)?));
    println!("{} {}", world.origin.latitude_deg, world.origin.longitude_deg);
    for number in 0..count {
        let time_s = FROM_S + INTERVAL_S * f64::from(number);
        let pose = simulation.pose_at((time_s * 1e9) as u64);
        renderer.render_jpeg(&pose, time_s, &mut jpeg);
        let luma = &decoder.decode(&jpeg)?.pixels;
        file.write_all(&luma.iter().flat_map(|&luma| [levels[usize::from(luma)], GRAY]).collect::<Vec<u8>>())?;
        let [east_m, north_m] = pose.position_m;
        println!("{east_m:.3} {north_m:.3}");
    }
    file.flush()?;
    Ok(())
}

"""The package on an emulated Raspberry Pi: installed, recording, cut off, recording again, localizing.

What is real: the package, the program in it, its units and their sandbox, Debian's systemd and kernel with its camera,
USB and serial interfaces. What is not: the processor is emulated, and so slow that times say little of a Pi. The camera
is the kernel's `vivid`, whose test picture is recorded. The receiver is the simulated MTi, whose bytes come from a
pseudo-terminal of this computer through an emulated USB serial adapter. To localize, pictures of a drive through the
simulated town are sent through a second camera of vivid's, which shows what it is given; the map is learned from a drive
on another day. The pins are a Raspberry Pi 4's: the kernel has its driver for them, and the program its own, as on a Pi;
behind the registers that both write, where the hardware would be, is the test.
"""

import argparse
import contextlib
import functools
import itertools
import json
import math
import operator
import random
import re
import select
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from machine import Failure, Machine

RECORD, LOCALIZE = "omniloc-record", "omniloc-localize"
RECORD_CONFIG, LOCALIZE_CONFIG = "/etc/omniloc/record.toml", "/etc/omniloc/localize.toml"
RECORDINGS = "/var/lib/omniloc/recordings"
# In the machine: the camera with the test picture, and the two ends of the one that shows what it is given.
CAMERA, SHOWN, TO_BE_SHOWN = "/dev/video0", "/dev/video1", "/dev/video2"
# Pins, as the README has them, and of /dev/gpiomem the device that the device tree makes.
BUTTON, LAMP, PULSE = 17, 27, 18
GPIOMEM = "/sys/bus/platform/devices/7ff00000.gpiomem"
# How many pulses there are, the simulated receiver's latency, and how far from it the measured one may be: an emulated
# processor is late for an edge, and for a byte.
PULSES, LATENCY_MS, LATENCY_LIMIT_MS = 10, 60, 50
# The most that systemd may find exposed of a unit, and that a power cut may cost [s].
EXPOSURE_LIMIT, LOSS_LIMIT_S = 1.5, 1.0
# Farthest that a position may lie from the stretch that was driven [m]: the survey's receiver erred by 0.6 m an axis, alike
# for many seconds, and the map has cells of a metre.
POSITION_LIMIT_M = 4.0
# Pictures that there are to be shown, and how many positions are enough.
PICTURES, POSITIONS = 60, 20
# Before a camera of vivid's shows what it is given, it wants so many.
PICTURES_AHEAD = 4
PICTURE_SIZE = (1280, 720)

started_s = time.monotonic()


def begin(what: str) -> None:
    print(f"-- {what} ({time.monotonic() - started_s:.0f} s)", flush=True)


def tell(what: str) -> None:
    print(f"   {what}", flush=True)


def check(holds: bool, what: str) -> None:
    if not holds:
        raise Failure(f"not so: {what}")


def free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]


# What recording says of itself, once a second.


def wait_for_status(machine: Machine, pattern: str, timeout_s: float = 90) -> float:
    """Waits until the status line of the recording service fits; how long that took [s]."""
    # `tee`, so that the last line that did not fit can be told.
    script = f"systemctl show --property=StatusText --value {RECORD} | tee /dev/stderr | grep -qE '{pattern}'"
    return machine.wait_until(f"{RECORD} says {pattern}", script, timeout_s)


RECORDING = "camera ok .*gnss ok .*pairs [1-9]"


def pairs(machine: Machine) -> int:
    line = machine.property(RECORD, "StatusText")
    found = re.search(r"pairs (\d+)", line)
    check(found is not None, f"a status with pairs: {line}")
    return int(found[1])


def main_pid(machine: Machine, unit: str = RECORD) -> int:
    return int(machine.property(unit, "MainPID"))


def finding(findings: list[dict], check_name: str) -> dict:
    found = [one for one in findings if one["check"] == check_name]
    check(len(found) == 1, f"doctor has a finding `{check_name}`: {findings}")
    return found[0]


def configure(machine: Machine, file: str, settings: dict) -> None:
    """Sets keys that the file has, each once."""
    changes = " ".join(f"-e 's|^{key} = .*|{key} = {value}|'" for key, value in settings.items())
    machine.sh(f"sed -i {changes} {file}")


# The parts of the drive.


def install(machine: Machine, package: Path) -> None:
    begin("first start, nothing plugged in")
    machine.power_on(plugged=False)
    begin("installing the package")
    machine.put("/root/omniloc.deb", package.read_bytes())
    machine.sh("DEBIAN_FRONTEND=noninteractive apt-get install --yes /root/omniloc.deb", 240)
    tell(machine.sh("dpkg-query --show --showformat '${Package} ${Version} ${Architecture}: ${Status}' omniloc"))
    check(machine.sh("systemctl is-enabled omniloc.target").strip() == "enabled", "omniloc.target is enabled")
    for unit in (RECORD, LOCALIZE):
        check(machine.try_sh(f"systemctl is-enabled {unit}")[1].strip() == "disabled", f"{unit} is left to be enabled")
    groups = set(machine.sh("id -nG omniloc").split())
    check(groups == {"omniloc", "video", "dialout", "gpio"}, f"the user's groups: {groups}")
    # An emulated processor encodes no 30 frames of 1280 x 720 a second.
    settings = {"width_px": 320, "height_px": 180, "frame_rate_hz": 10, "device": f'"{CAMERA}"', "port": '"/dev/ttyUSB0"'}
    configure(machine, RECORD_CONFIG, settings)


def examine_without_devices(machine: Machine) -> None:
    begin("doctor, nothing plugged in")
    status, out, err = machine.try_sh(f"omniloc doctor --config {RECORD_CONFIG} --json", 180)
    check(status == 1, f"exit status 1 where recording cannot work, not {status}: {out}{err}")
    findings = json.loads(out)["findings"]
    for name in ("camera", "receiver"):
        one = finding(findings, name)
        check(one["verdict"] == "problem" and one["advice"], f"{name} is missed, with advice: {one}")
        tell(f"{name}: {one['found']} -> {one['advice']}")


def start_without_devices(machine: Machine) -> None:
    machine.sh(f"systemctl enable {RECORD}")
    machine.shut_down()
    begin("second start, nothing plugged in: the service waits")
    machine.power_on(plugged=False)
    wait_for_status(machine, "camera not present .*gnss not present")
    check(machine.property("omniloc.target", "ActiveState") == "active", "omniloc.target is reached")
    check(machine.property(RECORD, "SubState") == "running", f"{RECORD} runs")
    check(machine.property(RECORD, "NRestarts") == "0", f"{RECORD} was not restarted")


def plug_in(machine: Machine) -> None:
    begin("camera and receiver are plugged in")
    machine.sh("modprobe vivid")
    machine.plug_receiver()
    tell(f"recording pairs after {wait_for_status(machine, RECORDING):.0f} s")
    pid = main_pid(machine)
    facts = machine.sh(f"cat /proc/{pid}/status; ls -l /proc/{pid}/fd")
    open_devices = set(re.findall(r"/dev/(?:video|ttyUSB)\d", facts))
    check(open_devices == {CAMERA, "/dev/ttyUSB0"}, f"both devices are open: {open_devices}")
    for key, value in (("Seccomp", "2"), ("NoNewPrivs", "1"), ("CapEff", "0" * 16)):
        check(re.search(rf"^{key}:\t{value}$", facts, re.M) is not None, f"{key} is {value}")
    check(re.search(r"^Uid:\t0\t", facts, re.M) is None, "it is not root")
    for unit in (RECORD, LOCALIZE):
        said = machine.sh(f"systemd-analyze security --no-pager {unit}")
        exposure = float(re.search(r"Overall exposure level for .*: ([\d.]+)", said)[1])
        tell(f"{unit}: exposure {exposure}")
        check(exposure <= EXPOSURE_LIMIT, f"exposure of {unit} at most {EXPOSURE_LIMIT}")


def name_of_arduino(machine: Machine) -> None:
    begin("the name of the Arduino's line")
    # The kernel's USB device with the Mega's numbers, in a port of its own.
    machine.sh("modprobe dummy_hcd && modprobe g_serial idVendor=0x2341 idProduct=0x0042")
    machine.wait_until("/dev/omniloc/receiver is there", "test -c /dev/omniloc/receiver")
    tell(machine.sh("readlink -f /dev/omniloc/receiver").strip())
    machine.sh("rmmod g_serial")
    machine.wait_until("/dev/omniloc/receiver is gone", "! test -e /dev/omniloc/receiver")


def disturb(machine: Machine) -> None:
    pid = main_pid(machine)
    begin("camera unplugged and plugged in again")
    machine.sh("echo vivid.0 >/sys/bus/platform/drivers/vivid/unbind")
    wait_for_status(machine, "camera (not present|disconnected) .*gnss ok")
    machine.sh("echo vivid.0 >/sys/bus/platform/drivers/vivid/bind")
    tell(f"back after {wait_for_status(machine, 'camera ok .*gnss ok'):.0f} s")

    begin("camera disconnected by its driver, and a damaged frame")
    # Not the failure itself: one that is the same as a moment ago is not told again.
    count = f"journalctl --unit {RECORD} | grep -c 'camera opened'"
    before = int(machine.sh(count))
    machine.sh(f"v4l2-ctl --device {CAMERA} --set-ctrl disconnect=1")
    machine.wait_until("the camera is opened anew", f"test $({count}) -gt {before}")
    wait_for_status(machine, "camera ok .*gnss ok")
    machine.sh(f"v4l2-ctl --device {CAMERA} --set-ctrl inject_v4l2_buf_flag_error=1")

    begin("receiver unplugged and plugged in again")
    machine.unplug_receiver()
    wait_for_status(machine, "camera ok .*gnss (not present|disconnected)")
    machine.plug_receiver()
    tell(f"back after {wait_for_status(machine, 'camera ok .*gnss ok'):.0f} s")

    before = pairs(machine)
    time.sleep(5)
    check(pairs(machine) > before, "pairs again")
    check(main_pid(machine) == pid, "all that without a new start of the program")


def segments(machine: Machine) -> set[str]:
    return set(machine.sh(f"ls {RECORDINGS}").split())


def cut_power(machine: Machine) -> tuple[str, int]:
    """Cuts the power while it records; the open segment, and what the machine's clock said at that moment."""
    machine.sh("sleep 2")
    open_segment = [name for name in segments(machine) if name.endswith(".part")]
    check(len(open_segment) == 1, f"one open segment: {open_segment}")
    there_ns, here_s = machine.agent.realtime_ns()
    machine.power_off()
    return open_segment[0].removesuffix(".part"), there_ns + int((time.monotonic() - here_s) * 1e9)


def check_mended(machine: Machine, segment: str, cut_ns: int) -> float:
    """The segment that was cut off is whole, and ends not long before the cut; how long [s]."""
    machine.wait_until(f"{segment} is mended", f"test -e {RECORDINGS}/{segment}")
    check(f"{segment}.part" not in segments(machine), "the cut segment is gone")
    tell(machine.sh(f"omniloc check {RECORDINGS}/{segment}", 180).strip())
    topics = json.loads(machine.sh(f"omniloc info --json {RECORDINGS}/{segment}", 180))["topics"]
    losses_s = {topic: (cut_ns - topics[topic]["last_ns"]) * 1e-9 for topic in ("/camera/image", "/gnss/raw")}
    for topic, loss_s in losses_s.items():
        tell(f"lost by the power cut: the last {loss_s:.2f} s of {topic}")
    loss_s = max(losses_s.values())
    check(loss_s <= LOSS_LIMIT_S, f"at most {LOSS_LIMIT_S} s are lost")
    return loss_s


def start_with_devices(machine: Machine) -> None:
    machine.power_on(plugged=True)
    wait_for_status(machine, RECORDING)


def first_pair(machine: Machine) -> None:
    """From power on to the first pair, and how much of it is ours. Called while everything was recorded since the start."""
    begin("from power on to the first pair")
    offset_ns, here_s = machine.agent.realtime_ns()
    to_host_s = here_s - offset_ns * 1e-9
    boot_id = machine.sh("cut -c 1-8 /proc/sys/kernel/random/boot_id").strip()
    machine.sh(f"systemctl stop {RECORD}", 60)
    first = min(name for name in segments(machine) if name.startswith(boot_id))
    info = json.loads(machine.sh(f"omniloc info --json {RECORDINGS}/{first}", 180))
    check(info["usable_frames"] > 0, f"{first} has pairs: {info['topics']}")
    pair_s = info["topics"]["/survey/pose"]["first_ns"] * 1e-9 + to_host_s
    clock = machine.sh("echo $(date +%s%N) $(cut -d ' ' -f 1 /proc/uptime)").split()
    kernel_s = float(clock[0]) * 1e-9 - float(clock[1]) + to_host_s
    program_s = kernel_s + int(machine.property(RECORD, "ExecMainStartTimestampMonotonic")) * 1e-6
    for what, instant_s in (("the kernel", kernel_s), ("the program", program_s), ("the first pair", pair_s)):
        tell(f"from power on to {what}: {instant_s - machine.powered_on_s:.1f} s")
    tell(f"of it ours: {pair_s - program_s:.1f} s, from the start of the program, with the mending of what was cut off")
    tell(machine.sh("systemd-analyze time").strip().replace("\n", "; "))


# Pins of a Raspberry Pi 4. Program, unit and sandbox are as they are shipped: what stands for a Pi is made outside of them.


@contextlib.contextmanager
def pins_configured(machine: Machine):
    """With the keys of the pins in the settings, and with /dev/gpiomem; both are taken back unless something failed."""
    driver = "/sys/bus/platform/drivers/simple-framebuffer"
    device = GPIOMEM.rpartition("/")[2]
    machine.sh(f"echo simple-framebuffer >{GPIOMEM}/driver_override && echo {device} >{driver}/bind")
    number = machine.sh("cat /sys/class/graphics/fb0/dev").strip().replace(":", " ")
    # As udev would have it, which knows it by its driver.
    machine.sh(f"mknod --mode=660 /dev/gpiomem c {number} && chgrp gpio /dev/gpiomem")
    machine.sh(f"cp --preserve {RECORD_CONFIG} /root/record.toml")
    changes = r"""-e 's|^driver = "none"|driver = "rppal"|' -e 's|^# \([a-z_]*_pin = \)|\1|'"""
    machine.sh(f"sed -i {changes} {RECORD_CONFIG}")
    yield
    machine.sh(f"mv /root/record.toml {RECORD_CONFIG}")
    machine.sh(f"rm /dev/gpiomem && echo {device} >{driver}/unbind")


def check_pins_taken(machine: Machine) -> None:
    """Whether the program has the pins from the kernel and from the registers, as it should."""
    header, pid = machine.header, main_pid(machine)
    facts = machine.sh(f"ls -l /proc/{pid}/fd; cat /proc/{pid}/maps; gpioinfo gpiochip0")
    used = set(re.findall(r"/dev/gpio\w+", facts))
    check(used == {"/dev/gpiochip0", "/dev/gpiomem"}, f"edges and registers are used: {used}")
    taken = set(re.findall(r"line +(\d+):.*\"RPPAL\"", facts))
    check(taken == {str(BUTTON), str(PULSE)}, f"the kernel waits for edges of both inputs: {taken}")
    check(header.function(LAMP) == header.OUTPUT, "the lamp's pin is an output")
    check(header.pull(BUTTON) == header.PULLED_UP, "the button's pin is pulled up")
    check(header.pull(PULSE) == header.PULLED_DOWN, "the pulse's pin is pulled down")


def lamp_changes(machine: Machine, within_s: float) -> int:
    """How often the lamp goes on or off in this time."""
    seen = []
    deadline_s = time.monotonic() + within_s
    while time.monotonic() < deadline_s:
        seen.append(machine.header.is_driven_high(LAMP))
    return sum(one != next_one for one, next_one in itertools.pairwise(seen))


def look_at_lamp(machine: Machine) -> None:
    check(lamp_changes(machine, 3) == 0 and machine.header.is_driven_high(LAMP), "the lamp is on while it records")
    machine.unplug_receiver()
    wait_for_status(machine, "camera ok .*gnss (not present|disconnected)")
    time.sleep(1)
    changes = lamp_changes(machine, 5)
    tell(f"without the receiver the lamp changes {changes} times in 5 s")
    check(8 <= changes <= 12, "it blinks once a second while a device is waited for")
    machine.plug_receiver()
    wait_for_status(machine, "camera ok .*gnss ok")


def press_button(machine: Machine) -> None:
    """Once, with contacts that bounce."""
    begin("the button is pressed")
    count = f"journalctl --unit {RECORD} | grep -c 'button pressed'"
    names = segments(machine)
    check(not any(name.endswith(".keep") for name in names), "nothing is marked yet")
    current = [name.removesuffix(".mcap.part") for name in names if name.endswith(".part")]
    for high in (False, True, False, True, False):
        machine.header.put(BUTTON, high)
    time.sleep(0.3)
    for high in (True, False, True):
        machine.header.put(BUTTON, high)
    machine.wait_until("it is told", f"test $({count}) -gt 0")
    machine.wait_until("the segment is marked", f"ls {RECORDINGS}/*.keep")
    names = segments(machine)
    check(current and {f"{name}.keep" for name in current} <= names, f"what was being recorded is marked: {names}")
    check(machine.sh(count).strip() == "1", "it counts as pressed once")


def pulse(machine: Machine) -> None:
    """Starts some seconds, of this computer's clock, which is the receiver's."""
    begin("the receiver's pulse")
    assumed = machine.property(RECORD, "StatusText")
    for _ in range(PULSES):
        time.sleep(1 - time.time() % 1)
        machine.header.put(PULSE, True)
        machine.header.put(PULSE, False)
    time.sleep(2)
    measured = machine.property(RECORD, "StatusText")
    said = [re.search(r"gnss ok \d+/s -(\d+) ms", line) for line in (assumed, measured)]
    check(all(said), f"the latency is said: {assumed} ... {measured}")
    assumed_ms, measured_ms = (int(one[1]) for one in said)
    tell(f"latency of the serial line: assumed {assumed_ms} ms, by the pulse {measured_ms} ms, {LATENCY_MS} ms in truth")
    check(abs(measured_ms - LATENCY_MS) <= LATENCY_LIMIT_MS, f"the pulse shows the latency to {LATENCY_LIMIT_MS} ms")


def use_pins(machine: Machine) -> None:
    begin("button, lamp and pulse, inside the sandbox")
    before = segments(machine)
    machine.header.put(BUTTON, True)
    with pins_configured(machine):
        machine.sh(f"systemctl start {RECORD}", 120)
        wait_for_status(machine, RECORDING)
        check_pins_taken(machine)
        look_at_lamp(machine)
        press_button(machine)
        pulse(machine)
        check(machine.header.is_driven_high(LAMP), "the lamp is on")
        machine.sh(f"systemctl stop {RECORD}", 60)
        check(machine.header.is_cleared(LAMP), "the lamp is off at the end")
    files = [name for name in segments(machine) - before if name.endswith(".mcap")]
    drives = [json.loads(machine.sh(f"omniloc info --json {RECORDINGS}/{name}", 180)) for name in files]
    pulses = [drive["topics"]["/gnss/pulse"] for drive in drives if "/gnss/pulse" in drive["topics"]]
    check(sum(one["messages"] for one in pulses) == PULSES, f"every pulse is recorded, once: {pulses}")
    span_s = (max(one["last_ns"] for one in pulses) - min(one["first_ns"] for one in pulses)) * 1e-9
    tell(f"{PULSES} pulses, the last {span_s:.3f} s after the first")
    check(abs(span_s - (PULSES - 1)) < 0.1, "they are stamped when they came")
    said = machine.sh(f"journalctl --boot --unit {RECORD}")
    check("not on the monotonic clock" not in said, "edges have the kernel's stamps")
    # Marks are removed by hand.
    machine.sh(f"rm {RECORDINGS}/*.keep")
    machine.sh(f"systemctl start {RECORD}", 120)


def bite(machine: Machine) -> None:
    begin("the program hangs: the watchdog bites")
    wait_for_status(machine, RECORDING)
    pid = main_pid(machine)
    machine.sh(f"kill -STOP {pid}")
    took_s = machine.wait_until("a new start", f"test \"$(systemctl show --property=NRestarts --value {RECORD})\" = 1", 120)
    check("Watchdog timeout" in machine.sh(f"journalctl --unit {RECORD}"), "it was the watchdog")
    wait_for_status(machine, RECORDING)
    check(main_pid(machine) != pid, "another process")
    tell(f"started anew {took_s:.0f} s after it hung, and records")


def check_recordings(machine: Machine) -> list[tuple]:
    """What was lost on the way: topic, reason, count."""
    begin("every recording is whole")
    machine.sh(f"systemctl stop {RECORD}", 60)
    names = segments(machine)
    check(names and all(name.endswith(".mcap") for name in names), f"nothing is left open: {names}")
    for name in sorted(names):
        machine.sh(f"omniloc check {RECORDINGS}/{name}", 180)
    drives = [json.loads(machine.sh(f"omniloc info --json {RECORDINGS}/{name}", 180)) for name in sorted(names)]
    lost = [tuple(entry) for drive in drives if drive["drive"] for entry in drive["drive"]["lost"]]
    frames = sum(drive["usable_frames"] for drive in drives)
    tell(f"{len(names)} segments with {frames} usable frames; lost: {lost}")
    facts = machine.sh(f"stat -c '%U:%G %a' {RECORDINGS}/{min(names)}").strip()
    check(facts == "omniloc:omniloc 660", f"the group may fetch and remove recordings: {facts}")
    return lost


def examine_with_devices(machine: Machine) -> None:
    begin("doctor, as the services' user")
    status, out, err = machine.try_sh(f"runuser -u omniloc -- omniloc doctor --config {RECORD_CONFIG} --json", 240)
    check(status == 0, f"exit status 0 where recording can work, not {status}: {out}{err}")
    for one in json.loads(out)["findings"]:
        tell(f"{one['verdict']:8} {one['check']:12} {one['found']}")


def examine_refused(machine: Machine) -> None:
    begin("doctor, in a sandbox without the devices")
    properties = "--property=User=omniloc --property=DevicePolicy=closed --property=NoNewPrivileges=yes"
    command = f"systemd-run --quiet --pipe --wait {properties} omniloc doctor --config {RECORD_CONFIG} --json"
    status, out, err = machine.try_sh(command, 240)
    check(status == 1, f"exit status 1 where recording cannot work, not {status}: {out}{err}")
    findings = json.loads(out)["findings"]
    for name in ("camera", "receiver"):
        one = finding(findings, name)
        said = f"{one['found']} {one['advice']}"
        check(one["verdict"] == "problem" and "DeviceAllow=" in said, f"{name} is refused, with advice: {one}")
        tell(f"{name}: {said}")


# Localizing.


def metres_from(origin_deg: tuple[float, float], latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """East and north of a place some hundred metres away, on a sphere of the Earth's radius at the equator."""
    metres_per_deg = 6_378_137.0 * math.pi / 180
    return (
        (longitude_deg - origin_deg[1]) * metres_per_deg * math.cos(math.radians(origin_deg[0])),
        (latitude_deg - origin_deg[0]) * metres_per_deg,
    )


class Pictures:
    """The pictures of a stretch of another day's drive, and where they were taken."""

    def __init__(self, devices: Path, folder: Path):
        file = folder / "pictures.yuyv"
        command = [str(devices), "pictures", str(file), str(PICTURES)]
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split("\n")
        numbers = [tuple(float(word) for word in line.split()) for line in said if line]
        self.origin_deg, self.places_m = numbers[0], numbers[1:]
        check(len(self.places_m) == PICTURES, f"{PICTURES} pictures: {len(self.places_m)}")
        self.unseen = open(file, "rb")

    def plug_in(self, machine: Machine) -> None:
        """From now on the second camera shows what it is given."""
        # Before anybody listens there: a line that ends nowhere has an end.
        self.line = socket.socket(socket.AF_UNIX)
        self.line.connect(str(machine.folder / "pictures"))
        # 24 frames a second instead of 60, of which four in five are left out, without vivid's own letters in them.
        machine.sh(f"for end in {SHOWN} {TO_BE_SHOWN}; do v4l2-ctl --device $end --set-dv-bt-timings index=3; done")
        for control in ("loop_video=1", "osd_text_mode=2", "percentage_of_dropped_buffers=80"):
            machine.sh(f"v4l2-ctl --device {SHOWN} --set-ctrl {control}")
        size = f"width={PICTURE_SIZE[0]},height={PICTURE_SIZE[1]},pixelformat=YUYV"
        machine.sh(
            f"systemd-run --unit=pictures sh -c 'exec v4l2-ctl --device {TO_BE_SHOWN} --set-fmt-video-out={size} "
            "--stream-out-mmap --stream-from=- </dev/virtio-ports/pictures'"
        )
        for _ in range(PICTURES_AHEAD):
            self.show_next()

    def show_next(self) -> bool:
        """Whether there was one more."""
        picture = self.unseen.read(PICTURE_SIZE[0] * PICTURE_SIZE[1] * 2)
        self.line.sendall(picture)
        return bool(picture)


def sentences(port: int, within_s: float):
    """NMEA sentences that the machine says over TCP, each whole and with its right checksum, for so long."""
    deadline_s = time.monotonic() + within_s
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        text = b""
        while (left_s := deadline_s - time.monotonic()) > 0:
            if not select.select([connection], [], [], left_s)[0]:
                return
            received = connection.recv(4096)
            check(bool(received), "the NMEA connection stays")
            *lines, text = (text + received).split(b"\n")
            for line in lines:
                body, _, checksum = line.strip().removeprefix(b"$").partition(b"*")
                check(functools.reduce(operator.xor, body) == int(checksum, 16), f"checksum of {line!r}")
                yield body.decode().split(",")


def angle_deg(value: str, hemisphere: str) -> float:
    degrees, minutes = divmod(float(value), 100)
    return (degrees + minutes / 60) * (-1 if hemisphere in "SW" else 1)


def localize(machine: Machine, map_file: Path, pictures: Pictures) -> None:
    begin("a map is copied in; localizing ends recording")
    machine.sh(f"systemctl start {RECORD}", 120)
    machine.put("/var/lib/omniloc/maps/area.map", map_file.read_bytes())
    configure(machine, LOCALIZE_CONFIG, {"device": f'"{SHOWN}"', "listen": '"0.0.0.0:10110"'})
    pictures.plug_in(machine)
    machine.sh(f"systemctl start {LOCALIZE}", 120)
    check(machine.property(RECORD, "ActiveState") == "inactive", f"{RECORD} is off while {LOCALIZE} is on")
    pid = main_pid(machine, LOCALIZE)
    open_devices = set(re.findall(r"/dev/video\d", machine.sh(f"ls -l /proc/{pid}/fd")))
    tell(f"{LOCALIZE} has {open_devices} open")

    begin("positions over TCP")
    shown, without = [], 0
    # A picture an estimate, however long the machine takes for one.
    for fields in sentences(machine.port, 300):
        if not fields[0].endswith("GGA"):
            continue
        if fields[6] == "0":
            without += 1
        else:
            latitude_deg, longitude_deg = angle_deg(fields[2], fields[3]), angle_deg(fields[4], fields[5])
            shown.append(metres_from(pictures.origin_deg, latitude_deg, longitude_deg))
        if len(shown) == POSITIONS or not pictures.show_next():
            break
    tell(machine.property(LOCALIZE, "StatusText"))
    check(len(shown) >= 5, f"positions were said: {len(shown)}, and {without} times that there is none yet")
    nearest = [min((math.dist(place, one), index) for index, place in enumerate(pictures.places_m)) for one in shown]
    errors_m = sorted(distance for distance, _ in nearest)
    tell(
        f"{len(shown)} positions, {without} times none yet; median distance from the stretch driven "
        f"{errors_m[len(errors_m) // 2]:.1f} m, at most {errors_m[-1]:.1f} m"
    )
    check(errors_m[-1] <= POSITION_LIMIT_M, f"no position is farther than {POSITION_LIMIT_M} m from the stretch driven")
    check(nearest[-1][1] > nearest[0][1], f"they go the way that was driven: {[index for _, index in nearest]}")

    begin("recording ends localizing")
    machine.sh(f"systemctl start {RECORD}", 120)
    check(machine.property(LOCALIZE, "ActiveState") == "inactive", f"{LOCALIZE} is off while {RECORD} is on")


def remove(machine: Machine) -> None:
    begin("the package again, removed, and purged")
    # The one that is being recorded is ended on the way.
    recordings = lambda: {name.removesuffix(".part") for name in segments(machine)}
    before = recordings()
    machine.sh("DEBIAN_FRONTEND=noninteractive dpkg --install /root/omniloc.deb", 240)
    check(machine.property(RECORD, "ActiveState") == "active", "what recorded before records on")
    machine.sh("dpkg --remove omniloc", 120)
    check(machine.try_sh(f"systemctl is-active {RECORD}")[0] != 0, "nothing records any more")
    check(machine.try_sh(f"test -e {RECORD_CONFIG}")[0] == 0, "the configuration is kept")
    machine.sh("dpkg --purge omniloc", 120)
    check(machine.try_sh("test -e /etc/omniloc")[0] != 0, "the configuration is gone")
    check(before <= recordings(), f"no recording is gone: {before}")


def drive(machine: Machine, package: Path, devices: Path, map_file: Path) -> str:
    """Everything once."""
    pictures = Pictures(devices, machine.folder)
    install(machine, package)
    examine_without_devices(machine)
    start_without_devices(machine)
    plug_in(machine)
    name_of_arduino(machine)
    disturb(machine)
    begin("power off without warning, and on again")
    cut = cut_power(machine)
    start_with_devices(machine)
    check_mended(machine, *cut)
    first_pair(machine)
    use_pins(machine)
    bite(machine)
    lost = check_recordings(machine)
    reasons = {reason for _, reason, _ in lost}
    check("marked damaged by the driver" in reasons, f"the damaged frame is counted: {lost}")
    # The receiver is on its way all the time: a line that is plugged in again must not begin with where it was before.
    check(not any("jumped" in reason for reason in reasons), f"no position jumped: {lost}")
    examine_with_devices(machine)
    examine_refused(machine)
    localize(machine, map_file, pictures)
    remove(machine)
    machine.shut_down()
    return "everything as it should be"


def power_offs(machine: Machine, package: Path, count: int) -> str:
    """The power goes again and again, at moments that are random but the same every time."""
    install(machine, package)
    machine.sh(f"systemctl enable {RECORD}")
    machine.shut_down()
    moments = random.Random(6)
    losses_s = []
    cut = None
    for number in range(count + 1):
        begin(f"start with {number} power cuts so far")
        start_with_devices(machine)
        if cut:
            losses_s.append(check_mended(machine, *cut))
        if number < count:
            time.sleep(moments.uniform(2, 12))
            cut = cut_power(machine)
    check_recordings(machine)
    machine.shut_down()
    return f"{count} power cuts cost the last {statistics.median(losses_s):.2f} s, at most {max(losses_s):.2f} s"


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("image", "package", "devices"):
        parser.add_argument(name, type=lambda path: Path(path).resolve())
    campaigns = parser.add_subparsers(required=True)
    campaign = campaigns.add_parser("drive", help=drive.__doc__)
    campaign.add_argument("map", type=lambda path: Path(path).resolve())
    campaign.set_defaults(run=lambda machine, options: drive(machine, options.package, options.devices, options.map))
    campaign = campaigns.add_parser("power-off", help=power_offs.__doc__)
    campaign.add_argument("count", type=int)
    campaign.set_defaults(run=lambda machine, options: power_offs(machine, options.package, options.count))
    options = parser.parse_args()

    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="omniloc-machine-")))
        receiver = subprocess.Popen([str(options.devices), "receiver"], stdout=subprocess.PIPE, text=True)
        stack.callback(receiver.kill)
        machine = Machine(options.image, folder, receiver.stdout.readline().strip(), free_port())
        stack.callback(machine.power_off)
        try:
            outcome = options.run(machine, options)
        except Failure as failure:
            print(f"tests/machine: FAILED: {failure}", file=sys.stderr)
            with contextlib.suppress(Failure, OSError):
                print(machine.try_sh(f"journalctl --no-pager --lines 60 -u {RECORD} -u {LOCALIZE}")[1], file=sys.stderr)
            print((folder / "console.log").read_text(errors="replace")[-2000:], file=sys.stderr)
            sys.exit(1)
    print(f"tests/machine: {outcome}, in {time.monotonic() - started_s:.0f} s")


if __name__ == "__main__":
    # Told to end, the machine ends too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    main()

"""A Raspberry Pi that is not there: QEMU's aarch64 machine, its plugs and switches, and commands inside it.

What the machine boots is made by tests/machine/image. Commands run through QEMU's guest agent, plugs and the power switch
through QEMU's monitor; both speak JSON over a socket. Its pins are behind QEMU's test line, which reaches memory and
interrupts from outside.
"""

import base64
import contextlib
import json
import select
import shlex
import socket
import subprocess
import time
from pathlib import Path


class Failure(Exception):
    """Something that the test looks at is not as it should be, or the machine does not do what it is told."""


class Lines:
    """One line of text after the other, over a socket of QEMU's."""

    def __init__(self, path: Path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(str(path))
        self.unread = b""

    def say_line(self, line: str) -> None:
        self.socket.sendall(line.encode() + b"\n")

    def hear_line(self, timeout_s: float) -> str | None:
        """The next line, or nothing within this time."""
        deadline_s = time.monotonic() + timeout_s
        while b"\n" not in self.unread:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0 or not select.select([self.socket], [], [], left_s)[0]:
                return None
            try:
                received = self.socket.recv(1 << 16)
            except ConnectionError:
                received = b""
            if not received:
                raise Failure("the machine went off")
            self.unread += received
        line, self.unread = self.unread.split(b"\n", 1)
        return line.decode()

    def close(self) -> None:
        self.socket.close()


class Conversation(Lines):
    """JSON, one object a line."""

    def say(self, message: dict) -> None:
        self.say_line(json.dumps(message))

    def hear(self, timeout_s: float) -> dict | None:
        """The next object, or nothing within this time."""
        line = self.hear_line(timeout_s)
        return None if line is None else json.loads(line)


class Monitor(Conversation):
    """QEMU's own: plugs and events."""

    def __init__(self, path: Path):
        super().__init__(path)
        self.hear(30)
        self.ask("qmp_capabilities")

    def ask(self, command: str, **arguments) -> dict:
        self.say({"execute": command, "arguments": arguments})
        while answer := self.hear(30):
            if "return" in answer:
                return answer["return"]
            if "error" in answer:
                raise Failure(f"QEMU refuses {command}: {answer['error']['desc']}")
        raise Failure(f"QEMU does not answer {command}")

    def wait_for(self, event: str, timeout_s: float = 30) -> None:
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            if (said := self.hear(left_s)) and said.get("event") == event:
                return
        raise Failure(f"QEMU did not report {event} within {timeout_s} s")


class Agent(Conversation):
    """The guest agent inside: what a root shell there would do."""

    # What the agent takes in one piece [bytes].
    PIECE = 1 << 20

    def wait_until_up(self, timeout_s: float) -> None:
        deadline_s = time.monotonic() + timeout_s
        number = 0
        while time.monotonic() < deadline_s:
            number += 1
            self.say({"execute": "guest-sync", "arguments": {"id": number}})
            # Answers to questions of before it was up come first.
            while answer := self.hear(2):
                if answer.get("return") == number:
                    return
        raise Failure(f"the machine did not come up within {timeout_s:.0f} s")

    def ask(self, command: str, **arguments):
        self.say({"execute": command, "arguments": arguments})
        answer = self.hear(60)
        if answer is None:
            raise Failure(f"the machine does not answer {command}")
        if "error" in answer:
            raise Failure(f"the machine refuses {command}: {answer['error']['desc']}")
        return answer["return"]

    def run(self, script: str, timeout_s: float) -> tuple[int, str, str]:
        """Exit status, stdout and stderr of a script."""
        started = self.ask("guest-exec", path="/bin/sh", arg=["-c", script], **{"capture-output": True})
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            status = self.ask("guest-exec-status", pid=started["pid"])
            if status["exited"]:
                said = [base64.b64decode(status.get(key, "")).decode(errors="replace") for key in ("out-data", "err-data")]
                return status.get("exitcode", 128 + status.get("signal", 0)), *said
            time.sleep(0.2)
        raise Failure(f"not done within {timeout_s} s: {script}")

    def put(self, path: str, content: bytes) -> None:
        handle = self.ask("guest-file-open", path=path, mode="w")
        for start in range(0, len(content), self.PIECE):
            piece = base64.b64encode(content[start : start + self.PIECE]).decode()
            self.ask("guest-file-write", handle=handle, **{"buf-b64": piece})
        self.ask("guest-file-close", handle=handle)

    def realtime_ns(self) -> tuple[int, float]:
        """What the clock in the machine said, and the host's monotonic clock [s] then; of several tries the quickest."""
        tries = []
        for _ in range(5):
            before_s = time.monotonic()
            there_ns = self.ask("guest-get-time")
            after_s = time.monotonic()
            tries.append((after_s - before_s, there_ns, (before_s + after_s) / 2))
        _, there_ns, here_s = min(tries)
        return there_ns, here_s


class Header(Lines):
    """The pins of a Raspberry Pi 4, from outside: behind the registers that the kernel's driver and the program write.

    Registers are memory, see pins.dts: nothing happens by itself when one is written, and it keeps what was written. For a
    press the level goes into its register and the edge into that of events, and then the interrupt is raised, as the
    hardware would; what was written last to set or clear an output stays until it is wiped here.
    """

    # "BCM2711 ARM Peripherals", 5.2.
    ADDRESS = 0x7FF0_0000
    FUNCTIONS, SET, CLEAR, LEVELS, EVENTS, RISING, FALLING, PULLS = 0x00, 0x1C, 0x28, 0x34, 0x40, 0x4C, 0x58, 0xE4
    OUTPUT, PULLED_UP, PULLED_DOWN = 1, 1, 2
    INTERRUPT = 113

    def __init__(self, path: Path, interrupts: str):
        """`interrupts`: the controller, as QEMU calls it."""
        super().__init__(path)
        self.interrupts = interrupts

    def ask(self, command: str) -> str:
        self.say_line(command)
        answer = self.hear_line(30)
        if answer is None or not answer.startswith("OK"):
            raise Failure(f"QEMU does not do {command}: {answer}")
        return answer.removeprefix("OK").strip()

    def read(self, register: int) -> int:
        return int(self.ask(f"readl {self.ADDRESS + register:#x}"), 16)

    def write(self, register: int, value: int) -> None:
        self.ask(f"writel {self.ADDRESS + register:#x} {value:#x}")

    def function(self, pin: int) -> int:
        return self.read(self.FUNCTIONS + 4 * (pin // 10)) >> 3 * (pin % 10) & 7

    def pull(self, pin: int) -> int:
        return self.read(self.PULLS + 4 * (pin // 16)) >> 2 * (pin % 16) & 3

    def put(self, pin: int, high: bool) -> None:
        """Puts an input on a level. The kernel's driver hears of it if it watches such edges."""
        bit, levels = 1 << pin, self.read(self.LEVELS)
        self.write(self.LEVELS, levels | bit if high else levels & ~bit)
        if self.read(self.RISING if high else self.FALLING) & bit:
            self.write(self.EVENTS, bit)
            for level in (1, 0):
                self.ask(f"set_irq_in {self.interrupts} unnamed-gpio-in {self.INTERRUPT} {level}")

    def is_set(self, pin: int) -> bool:
        """Whether somebody has driven an output high since this was wiped."""
        return bool(self.read(self.SET) >> pin & 1)

    def is_cleared(self, pin: int) -> bool:
        """The same for low."""
        return bool(self.read(self.CLEAR) >> pin & 1)

    def is_driven_high(self, pin: int) -> bool:
        """To which level somebody drives an output, who writes it again and again; wipes what was written before."""
        for _ in range(100):
            self.write(self.SET, 0)
            self.write(self.CLEAR, 0)
            time.sleep(0.05)
            is_set = self.is_set(pin)
            # Both: it changed meanwhile.
            if is_set != self.is_cleared(pin):
                return is_set
        raise Failure(f"pin {pin} is driven by nobody")


class Machine:
    """One machine with one disk, which keeps what is on it from one start to the next.

    `image`: the folder that tests/machine/image made; `folder`: where the disk and the sockets go; `receiver`: a
    pseudo-terminal on which the receiver speaks; `port`: of this computer, behind which the NMEA port in the machine is.
    """

    BOOT_LIMIT_S = 400
    QEMU = "qemu-system-aarch64 -nodefaults -display none -machine virt,gic-version=3 -cpu cortex-a53 -smp 2 -m 1024".split()

    def __init__(self, image: Path, folder: Path, receiver: str, port: int):
        self.image, self.folder, self.receiver, self.port = image, folder, receiver, port
        self.process: subprocess.Popen | None = None
        self.powered_on_s = 0.0
        self.disk = folder / "disk.qcow2"
        create = ["qemu-img", "create", "-q", "-f", "qcow2", "-F", "raw", "-b", str(image / "root.img"), str(self.disk)]
        subprocess.run(create, check=True)
        self.tree = folder / "pi.dtb"
        self.describe()

    def describe(self) -> None:
        """Makes the device tree: QEMU's own, and what pins.dts makes of it."""
        own = self.folder / "qemu.dtb"
        subprocess.run([*self.QEMU, "-machine", f"dumpdtb={own}"], check=True, capture_output=True)
        source = subprocess.run(["dtc", "-q", "-I", "dtb", "-O", "dts", str(own)], check=True, capture_output=True).stdout
        source += Path(__file__).with_name("pins.dts").read_bytes()
        subprocess.run(["dtc", "-q", "-I", "dts", "-O", "dtb", "-o", str(self.tree)], input=source, check=True)

    def power_on(self, plugged: bool) -> None:
        """Switches it on, with camera and receiver there from the start or not, and waits until it takes commands."""
        self.agent = self.monitor = self.header = None
        for name in ("agent", "monitor", "pins", "pictures"):
            (self.folder / name).unlink(missing_ok=True)
        kernel = "console=ttyAMA0 quiet panic=-1 systemd.show_status=0 net.ifnames=0"
        # The last MiB of the memory is not the kernel's, but the registers of the pins; no text is to be shown in them.
        kernel += " mem=1023M fbcon=map:9"
        if plugged:
            kernel += " modules_load=vivid,ftdi_sio"
        command = [
            *self.QEMU,
            *"-accel tcg,thread=multi -no-reboot".split(),
            *("-serial", f"file:{self.folder}/console.log"),
            *("-kernel", f"{self.image}/vmlinuz", "-initrd", f"{self.image}/initrd.gz", "-append", kernel),
            *("-dtb", str(self.tree)),
            *("-qmp", f"unix:{self.folder}/monitor,server=on,wait=off"),
            *("-qtest", f"unix:{self.folder}/pins,server=on,wait=off", "-qtest-log", "none"),
            *("-drive", f"if=none,id=disk,file={self.disk},format=qcow2,cache=writeback"),
            *("-device", "virtio-blk-pci,drive=disk"),
            *("-netdev", f"user,id=net,restrict=on,hostfwd=tcp:127.0.0.1:{self.port}-10.0.2.15:10110"),
            *("-device", "virtio-net-pci,netdev=net,romfile="),
            *("-device", "virtio-serial-pci"),
            *("-chardev", f"socket,id=agent,path={self.folder}/agent,server=on,wait=off"),
            *("-device", "virtserialport,chardev=agent,name=org.qemu.guest_agent.0"),
            *("-chardev", f"socket,id=pictures,path={self.folder}/pictures,server=on,wait=off"),
            *("-device", "virtserialport,chardev=pictures,name=pictures"),
            *("-device", "qemu-xhci,id=usb"),
            *("-chardev", f"serial,id=receiver,path={self.receiver}"),
        ]
        if plugged:
            command += ["-device", "usb-serial,chardev=receiver,id=receiver"]
        self.powered_on_s = time.monotonic()
        with open(self.folder / "qemu.log", "ab") as log:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        while not all((self.folder / name).exists() for name in ("agent", "monitor", "pins")):
            if self.process.poll() is not None:
                raise Failure(f"QEMU ended: {(self.folder / 'qemu.log').read_text()}")
            time.sleep(0.05)
        self.monitor = Monitor(self.folder / "monitor")
        self.agent = Agent(self.folder / "agent")
        parts = self.monitor.ask("qom-list", path="/machine/unattached")
        interrupts = next((part["name"] for part in parts if part["type"] == "child<arm-gicv3>"), None)
        if interrupts is None:
            raise Failure(f"QEMU's machine has no interrupt controller: {parts}")
        self.header = Header(self.folder / "pins", f"/machine/unattached/{interrupts}")
        self.agent.wait_until_up(self.BOOT_LIMIT_S)

    def power_off(self) -> None:
        """Without warning: what the machine has in its memory is gone; what it has handed to its disk is not."""
        if self.process and self.process.poll() is None:
            self.process.kill()
            self.process.wait()
            self.hang_up()

    def hang_up(self) -> None:
        for line in (self.agent, self.monitor, self.header):
            if line:
                line.close()

    def shut_down(self) -> None:
        """As `poweroff` does."""
        # It may be off before it has said that it heard.
        with contextlib.suppress(Failure):
            self.sh("systemctl poweroff --no-block")
        self.process.wait(timeout=120)
        self.hang_up()

    def plug_receiver(self) -> None:
        self.monitor.ask("device_add", driver="usb-serial", chardev="receiver", id="receiver")

    def unplug_receiver(self) -> None:
        self.monitor.ask("device_del", id="receiver")
        self.monitor.wait_for("DEVICE_DELETED")

    def try_sh(self, script: str, timeout_s: float = 60) -> tuple[int, str, str]:
        if not self.agent:
            raise Failure("the machine is not on")
        return self.agent.run(script, timeout_s)

    def sh(self, script: str, timeout_s: float = 60) -> str:
        """What a script says that must succeed."""
        status, out, err = self.try_sh(script, timeout_s)
        if status != 0:
            raise Failure(f"exit status {status} of: {script}\n{out}{err}")
        return out

    def put(self, path: str, content: bytes) -> None:
        self.agent.put(path, content)

    def wait_until(self, what: str, script: str, timeout_s: float = 60) -> float:
        """Runs a script until it succeeds; how long that took [s]."""
        started_s = time.monotonic()
        while True:
            status, out, err = self.try_sh(script)
            elapsed_s = time.monotonic() - started_s
            if status == 0:
                return elapsed_s
            if elapsed_s > timeout_s:
                raise Failure(f"not within {timeout_s:.0f} s: {what}\n{out}{err}")
            time.sleep(0.5)

    def property(self, unit: str, name: str) -> str:
        return self.sh(f"systemctl show --property={shlex.quote(name)} --value {shlex.quote(unit)}").strip()

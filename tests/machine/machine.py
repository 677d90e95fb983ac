"""A Raspberry Pi that is not there: QEMU's aarch64 machine, its plugs and switches, and commands inside it.

What the machine boots is made by tests/machine/image. Commands run through QEMU's guest agent, plugs and the power switch
through QEMU's monitor; both speak JSON over a socket.
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


class Conversation:
    """JSON, one object a line, over a socket of QEMU's."""

    def __init__(self, path: Path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(str(path))
        self.unread = b""

    def say(self, message: dict) -> None:
        self.socket.sendall(json.dumps(message).encode() + b"\n")

    def hear(self, timeout_s: float) -> dict | None:
        """The next object, or nothing within this time."""
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
        return json.loads(line)

    def close(self) -> None:
        self.socket.close()


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


class Machine:
    """One machine with one disk, which keeps what is on it from one start to the next.

    `image`: the folder that tests/machine/image made; `folder`: where the disk and the sockets go; `receiver`: a
    pseudo-terminal on which the receiver speaks; `port`: of this computer, behind which the NMEA port in the machine is.
    """

    BOOT_LIMIT_S = 400

    def __init__(self, image: Path, folder: Path, receiver: str, port: int):
        self.image, self.folder, self.receiver, self.port = image, folder, receiver, port
        self.process: subprocess.Popen | None = None
        self.powered_on_s = 0.0
        self.disk = folder / "disk.qcow2"
        create = ["qemu-img", "create", "-q", "-f", "qcow2", "-F", "raw", "-b", str(image / "root.img"), str(self.disk)]
        subprocess.run(create, check=True)

    def power_on(self, plugged: bool) -> None:
        """Switches it on, with camera and receiver there from the start or not, and waits until it takes commands."""
        for name in ("agent", "monitor", "pictures"):
            (self.folder / name).unlink(missing_ok=True)
        kernel = "console=ttyAMA0 quiet panic=-1 systemd.show_status=0 net.ifnames=0"
        if plugged:
            kernel += " modules_load=vivid,ftdi_sio"
        command = [
            *"qemu-system-aarch64 -machine virt,gic-version=3 -cpu cortex-a53 -smp 2 -m 1024".split(),
            *"-accel tcg,thread=multi".split(),
            *"-nodefaults -display none -no-reboot".split(),
            *("-serial", f"file:{self.folder}/console.log"),
            *("-kernel", f"{self.image}/vmlinuz", "-initrd", f"{self.image}/initrd.gz", "-append", kernel),
            *("-qmp", f"unix:{self.folder}/monitor,server=on,wait=off"),
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
        while not (self.folder / "agent").exists() or not (self.folder / "monitor").exists():
            if self.process.poll() is not None:
                raise Failure(f"QEMU ended: {(self.folder / 'qemu.log').read_text()}")
            time.sleep(0.05)
        self.monitor = Monitor(self.folder / "monitor")
        self.agent = Agent(self.folder / "agent")
        self.agent.wait_until_up(self.BOOT_LIMIT_S)

    def power_off(self) -> None:
        """Without warning: what the machine has in its memory is gone; what it has handed to its disk is not."""
        if self.process and self.process.poll() is None:
            self.process.kill()
            self.process.wait()
            self.agent.close()
            self.monitor.close()

    def shut_down(self) -> None:
        """As `poweroff` does."""
        # It may be off before it has said that it heard.
        with contextlib.suppress(Failure):
            self.sh("systemctl poweroff --no-block")
        self.process.wait(timeout=120)
        self.agent.close()
        self.monitor.close()

    def plug_receiver(self) -> None:
        self.monitor.ask("device_add", driver="usb-serial", chardev="receiver", id="receiver")

    def unplug_receiver(self) -> None:
        self.monitor.ask("device_del", id="receiver")
        self.monitor.wait_for("DEVICE_DELETED")

    def try_sh(self, script: str, timeout_s: float = 60) -> tuple[int, str, str]:
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

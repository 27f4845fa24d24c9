"""``dexkit bringup`` on a real pseudo-terminal: the dead-man key, and what it refuses."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import select
import subprocess
import termios
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dexkit.child_processes import command_line
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.drivers.dex3_usb.discovery import parse_server
from dexkit.drivers.dex3_usb.settings import format_places
from dexkit.drivers.dex3_usb.stored import Store
from dexkit.emulators.dex3_mcu import Dex3Hands, Firmware, Wiring
from dexkit.errors import HandRefused, UsageError
from dexkit.hand import HandCommand, Side
from dexkit.models import DEX3_1
from tests import hostile
from tests.patience import PATIENCE

PATIENT = ("--set", "timeout=5", "--set", "send_timeout=5")


class Person:
    """``dexkit bringup`` on a terminal of its own, and whoever sits there."""

    def __init__(self, *arguments: object) -> None:
        self.master, slave = pty.openpty()
        self.slave = slave
        self.before = termios.tcgetattr(slave)
        self.text = ""
        self.process = subprocess.Popen(
            command_line("bringup", *map(str, arguments)),
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )

    def type(self, data: bytes) -> None:
        os.write(self.master, data)

    def until(self, condition: Callable[[], object], key: bytes = b"") -> None:
        """Read until it is so; hold a key meanwhile."""
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, self.text
            assert self.process.poll() is None, self.text
            if key:
                self.type(key)
            # as often as a held key repeats
            if select.select([self.master], [], [], 0.03)[0]:
                self.text += os.read(self.master, 65536).decode(errors="replace")

    def end(self) -> int:
        while self.process.poll() is None:
            if select.select([self.master], [], [], 0.05)[0]:
                self.text += os.read(self.master, 65536).decode(errors="replace")
        return self.process.wait(PATIENCE)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def emulated(tmp_path: Path) -> Iterator[Dex3Hands]:
    with Dex3Hands(wiring=Wiring.random(4), log=tmp_path / "log") as hands:
        yield hands


def commands(tmp_path: Path) -> list[dict[str, object]]:
    """The emulator's log of motor commands."""
    text = (tmp_path / "log").read_text()
    return [json.loads(line) for line in text.splitlines() if line.endswith("}")]


def test_a_released_key_stops_the_motor(emulated: Dex3Hands, tmp_path: Path) -> None:
    config = tmp_path / "dex3.json"
    person = Person(
        "dex3-usb", "--side", "left",
        "--set", f"usb={emulated.url}", "--set", f"config={config}", *PATIENT,
        "--speed", 0.1,
    )  # fmt: skip
    try:
        person.until(lambda: "hold SPACE" in person.text)
        assert commands(tmp_path) == []
        person.type(b" ")
        person.type(b"x ")  # a touch is not held
        person.until(lambda: "hold SPACE" in person.text)
        person.until(lambda: len(commands(tmp_path)) > 5, key=b" ")
        person.until(lambda: "released: locked" in person.text)
        person.until(lambda: not commands(tmp_path)[-1]["driven"])
        stopped = len(commands(tmp_path))
        again = time.monotonic()
        person.text = ""
        person.until(lambda: len(commands(tmp_path)) > stopped + 3, key=b" ")
        log = commands(tmp_path)
        # the emulator's clock is this machine's: nothing was driven between the two holds
        assert float(str(log[stopped]["t"])) > again
        assert len({entry["motor"] for entry in log}) == 1
        assert all(entry["protected"] for entry in log if entry["driven"])
        person.type(b"q")  # any other key stops, too
        person.until(lambda: "released: locked" in person.text)
        person.until(lambda: "Which joint" in person.text, key=b" ")
        assert not commands(tmp_path)[-1]["driven"]
        moved = commands(tmp_path)[-1]["joint"]
        person.type(b"\n" + str(moved).encode() + b"\n")
        person.until(lambda: "Which way" in person.text)
        person.type(b"\x03")
        assert person.end() == 130
        assert termios.tcgetattr(person.slave) == person.before
    finally:
        person.close()
    record = json.loads(config.read_text())["2024061800"]
    assert record["found"]["hand"]["device_version"] == "1.00"
    assert record["answers"] == {"motor 0.0 joint": moved}
    assert emulated.failure is None


def test_the_driver_uses_the_findings(tmp_path: Path) -> None:
    """A wiring in the file is the one in which the driver drives, whatever it assumes otherwise."""
    wiring, config = Wiring.random(6), tmp_path / "dex3.json"
    texts = {
        "motors": format_places(wiring.bus_map.motors),
        "sensors": format_places(wiring.bus_map.sensors),
        "signs": ",".join("+" if sign > 0 else "-" for sign in wiring.mounting.signs),
        "offsets": ",".join(map(str, wiring.mounting.offsets)),
        "ratios": ",".join(map(str, wiring.mounting.ratios)),
        "limits": ",".join(f"{j.q_min:.4f}:{j.q_max / 2:.4f}" for j in DEX3_1.joints[Side.LEFT]),
    }
    Store(config).write("2024061800", {"settings": texts})
    with Dex3Hands(wiring=wiring, firmware=Firmware(sensors_polled=True)) as hands:
        server = parse_server(hands.url)[0]
        plain = Dex3Settings(server=server, timeout=5.0, send_timeout=5.0)
        with Dex3Usb(Side.LEFT, replace(plain, config=config)) as hand:
            mechanics = hands.device().mechanics
            state = hand.exchange(HandCommand.brake(7))
            assert state.q == pytest.approx(mechanics.q, abs=1e-3)
            assert state.pressure is not None
            assert np.isfinite(state.pressure).sum() == 33
            goal = [0.9, 0.4, 0.8, -0.5, -0.6, -0.7, -0.8]
            end = time.monotonic() + PATIENCE
            while abs(mechanics.q[0] - 1.0472 / 2) > 0.01 or abs(mechanics.q[6] + 0.8) > 0.01:
                hand.exchange(HandCommand.position(goal, kp=1.5, kd=0.1))
                assert time.monotonic() < end
            assert hand.spec.q_max[0] == pytest.approx(1.0472 / 2)
        with pytest.raises(HandRefused, match="no state of the motor"):
            Dex3Usb(Side.LEFT, plain).open()
        Store(config).write("2024061800", {"settings": {"signs": "+"}})
        with pytest.raises(UsageError, match=r"dex3\.json: 2024061800: signs"):
            Dex3Usb(Side.LEFT, replace(plain, config=config)).open()


def test_unattended_bringup_refuses_real_hands(emulated: Dex3Hands, tmp_path: Path) -> None:
    (tmp_path / "answers.json").write_text('{"motor 0.0 joint": "thumb"}')
    (tmp_path / "none.json").write_text("[1]")
    place = ["bringup", "dex3-usb", "--side", "left", "--set", f"usb={emulated.url}", *PATIENT]
    answers = ["--answers", str(tmp_path / "answers.json")]
    for arguments, said in (
        (place, "needs a terminal"),
        ([*place, *answers], "needs a terminal"),
        ([*place, "--unattended"], "needs --answers"),
        ([*place, "--answers", str(tmp_path / "none.json"), "--unattended"], "no answers"),
        (["bringup", "sim-dex3", "--side", "left"], "has no bring-up"),
        (["bringup", "dex3-usb", "--side", "both"], "one hand at a time"),
    ):
        code, _, err = hostile.run_command(arguments)
        assert code == 2
        assert said in err
    assert commands(tmp_path) == []
    code, out, err = hostile.run_command(
        [*place, *answers, "--unattended", "--set", f"config={tmp_path / 'c'}", "--speed", "2"]
    )
    assert code == 2
    assert "'thumb' is not a valid answer" in err
    assert "sensors answer: by themselves" in out
    assert not commands(tmp_path)[-1]["driven"]


def test_the_plan_is_printed_and_nothing_opened() -> None:
    code, out, _ = hostile.run_command(
        ["bringup", "dex3-usb", "--side", "right", "--dry-run", "--set", "usb=usbip://127.0.0.1:1"]
    )
    assert code == 0
    for joint in DEX3_1.joints[Side.RIGHT]:
        assert joint.name in out
    assert "0.25 N·m and 0.2 rad/s" in out

"""``dexkit monitor`` on a real pseudo-terminal, whose screen a terminal emulator shows."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import pytest

from dexkit.child_processes import command_line
from dexkit.messages import message_type
from dexkit.traces import open_trace
from tests.dds_helpers import DdsNode, free_domain
from tests.patience import PATIENCE
from tests.watch_helpers import STATE, dex3_state

pyte = pytest.importorskip("pyte")

COLOUR = re.compile(rb"\x1b\[[0-9;]*(3[0-7]|38;|9[0-7])[0-9;]*m")


class Session:
    """``dexkit monitor`` in a session of its own, on a terminal; killed at the end."""

    def __init__(
        self, *arguments: object, columns: int, lines: int, folder: Path, **environment: str
    ) -> None:
        self.master, self._slave = pty.openpty()
        self.screen = pyte.Screen(columns, lines)
        self._stream = pyte.ByteStream(self.screen)
        self.raw = b""
        self._set_size(columns, lines)
        self.before = termios.tcgetattr(self._slave)
        clean = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "COLUMNS", "LINES")}
        self.process = subprocess.Popen(
            command_line("monitor", *map(str, arguments)),
            stdin=self._slave,
            stdout=self._slave,
            stderr=self._slave,
            cwd=folder,
            env={**clean, "TERM": "xterm-256color", "LC_ALL": "C.UTF-8", **environment},
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self._slave)

    @property
    def text(self) -> str:
        return "\n".join(self.screen.display)

    def _set_size(self, columns: int, lines: int) -> None:
        fcntl.ioctl(self.master, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

    def resize(self, columns: int, lines: int) -> None:
        self.screen.resize(lines, columns)
        self._set_size(columns, lines)

    def press(self, data: bytes) -> None:
        os.write(self.master, data)

    def _read(self) -> None:
        if select.select([self.master], [], [], 0.02)[0]:
            data = os.read(self.master, 65536)
            self.raw += data
            self._stream.feed(data)

    def until(self, condition: Callable[[], bool], meanwhile: Callable[[], object]) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, self.text
            assert self.process.poll() is None, self.text
            meanwhile()
            self._read()

    def end(self) -> int:
        """Its exit code."""
        end = time.monotonic() + PATIENCE
        while self.process.poll() is None and time.monotonic() < end:
            self._read()
        for _ in range(3):
            self._read()
        return self.process.wait(PATIENCE)

    @property
    def restored(self) -> bool:
        """Whether the terminal is as it was: its modes, screen, cursor and line breaks."""
        ends = (b"\x1b[?1049l", b"\x1b[?25h", b"\x1b[?7h")
        starts = (b"\x1b[?1049h", b"\x1b[?25l", b"\x1b[?7l")
        return termios.tcgetattr(self._slave) == self.before and all(
            self.raw.rfind(end) > self.raw.rfind(start) >= 0
            for start, end in zip(starts, ends, strict=True)
        )


class Hand:
    """Publishes states of a hand, one each time it is called."""

    def __init__(self, node: DdsNode) -> None:
        self._writer = node.writer("rt/dex3/left/state", message_type(STATE))
        self._payload = dex3_state([0.2] * 7, faults={1: 1})

    def __call__(self) -> None:
        self._writer.write_raw(self._payload)


def test_small_terminal_without_colours_is_resized_and_interrupted(tmp_path: Path) -> None:
    domain = free_domain()
    with DdsNode(domain) as node, Session(
        "--domain", domain, columns=80, lines=24, folder=tmp_path, NO_COLOR="1"
    ) as session:  # fmt: skip
        hand = Hand(node)
        session.until(
            lambda: (
                "! thumb_1: overcurrent" in session.text
                and session.screen.display[23].startswith("q quit")  # drawn last
            ),
            hand,
        )
        assert session.screen.display[0].startswith(f"dexkit monitor  domain {domain} on lo")
        assert "●" in session.text
        assert not COLOUR.search(session.raw)
        session.resize(120, 40)
        session.until(lambda: session.screen.display[39].startswith("q quit"), hand)
        assert "! thumb_1: overcurrent" in session.text
        session.resize(30, 8)
        session.until(lambda: session.screen.display[7].startswith("q quit"), hand)
        session.press(b"\x03")
        assert session.end() == 0
        assert session.restored


@pytest.mark.soak
def test_monitor_reacts_to_keys_and_records(tmp_path: Path) -> None:
    domain = free_domain()
    with DdsNode(domain) as node, Session(
        "--domain", domain, "--record", "a.mcap", columns=100, lines=30, folder=tmp_path,
        LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0",
    ) as session:  # fmt: skip
        hand = Hand(node)
        session.until(lambda: "thumb_0" in session.text, hand)
        assert COLOUR.search(session.raw)
        assert session.text.isascii()
        session.press(b"r")
        session.until(lambda: re.search(r"REC a.mcap [1-9]", session.text) is not None, hand)
        session.press(b" ")
        session.until(lambda: "PAUSED" in session.text, hand)
        session.press(b"r")
        session.until(lambda: "0 dropped" in session.text, hand)
        session.press(b"c")
        session.until(lambda: "events" not in session.text.split("clear")[0], hand)
        session.press(b"q")
        assert session.end() == 0
        assert session.restored
    assert open_trace(tmp_path / "a.mcap").message_count > 0


@pytest.mark.soak
def test_recording_is_whole_when_the_connection_goes(tmp_path: Path) -> None:
    domain = free_domain()
    with DdsNode(domain) as node, Session(
        "--domain", domain, "--record", "a.mcap", columns=80, lines=24, folder=tmp_path
    ) as session:  # fmt: skip
        hand = Hand(node)
        session.until(lambda: "thumb_0" in session.text, hand)
        session.press(b"r")
        session.until(lambda: re.search(r"REC a.mcap [1-9]", session.text) is not None, hand)
        session.process.send_signal(signal.SIGHUP)
        session.end()
    trace = open_trace(tmp_path / "a.mcap")
    assert trace.message_count > 0
    assert not trace.damage


@pytest.mark.soak
@pytest.mark.parametrize("as_json", [True, False])
def test_without_a_terminal_lines_are_printed(as_json: bool) -> None:
    domain = free_domain()
    options = ["--json"] if as_json else []
    process = subprocess.Popen(
        command_line("monitor", "--domain", str(domain), "--period", "0.2", *options),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TERM": "dumb"},
    )
    assert process.stdout is not None
    try:
        with DdsNode(domain) as node:
            hand = Hand(node)
            for line in process.stdout:
                hand()
                assert "\x1b" not in line
                if as_json and any(s["faults"] for s in json.loads(line)["subjects"]):
                    break
                if "left Dex3-1 hand: thumb_1: overcurrent" in line:
                    break
                if line.startswith("ready"):
                    wait_and_publish(hand)
        process.send_signal(signal.SIGINT)
        process.stdout.read()
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def wait_and_publish(hand: Hand) -> None:
    for _ in range(100):
        hand()
        time.sleep(0.02)

"""The commands of the documents do what the documents say, in the order in which they are shown.

Each document's commands run in a network of their own, in a folder with the files that a reader
has; a gripper on a serial port is an emulated one. Services run until they are ready and stay for
the rest of their block; other commands run to their end.
"""

from __future__ import annotations

import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from dexkit.emulators.mx64 import emulated_ezgripper
from dexkit.traces import sample_path
from tests.docs_commands import ROOT, Shown, shown_commands
from tests.namespaces import Host, Link, network, unavailable
from tests.patience import PATIENCE

pytest.importorskip("cyclonedds", reason="DDS needs cyclonedds 0.10: dexkit setup-dds")
pytestmark = pytest.mark.soak

SERVICES = {"serve", "emulate", "bridge", "record", "monitor", "view"}
"""Commands that print ``ready:`` and run until they are stopped."""
WITH_FINDINGS = {"check", "compare", "diff", "doctor", "audit", "selftest"}
"""Commands whose exit code 1 is a finding."""
ELSEWHERE = (
    (r"\bmy_?(package|pkg|hand|-|\b)", "the reader's own hand: tests/test_vendor_examples.py"),
    (r"s3://|head:6379", "a store and a cluster: tests/test_audit.py, tests/test_audit_ray.py"),
    (r"^setup-dds", "downloads, or needs sources: tests/test_setup_dds.py"),
    (r"^install-service ezgripper", "as root: tests/test_install_service.py"),
    (r"DEXKIT_PEERS|--interface (wlan0|192)", "other machines: tests/test_networks.py"),
    (
        r"ttyUSB1|(dex1|inspire|revo2)-serial .*--device /dev|--device 192|"
        r"(calibrate|selftest) dex1",
        "other devices: tests/test_dex1_serial.py, tests/test_inspire_modbus.py",
    ),
    (r"ids[= ]1,2", "two servos on a line: tests/test_ezgripper_pair.py"),
    (r"^serve (dex1-serial|dex3-usb) --side (left|both)$", "looks for a device of this machine"),
    (r"^bringup (?!.*--dry-run)", "a person holds a key: tests/test_bringup_cli.py"),
    (r"--rerun|--foxglove", "other viewers: tests/test_view_forward.py"),
    (r"--require DEX3USB", "a recording with USB: tests/test_conformance_usb.py"),
)
"""Patterns of what is not run here, and why."""


def _commands() -> Mapping[str, list[Shown]]:
    shown = [s for s in shown_commands() if s.program == "dexkit"]
    shown = [s for s in shown if not any(re.search(p, " ".join(s.words)) for p, _ in ELSEWHERE)]
    return {name: list(of) for name, of in itertools.groupby(shown, lambda s: s.document)}


@pytest.fixture(scope="module")
def host() -> Iterator[Host]:
    if why := unavailable():
        pytest.skip(why)
    with network(Link("reader", "eth0", "10.9.0.1", "robot", "eth0", "10.9.0.2")) as found:
        yield found["reader"]


@pytest.fixture(scope="module")
def files(host: Host, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What readers have: recordings and results."""
    folder = tmp_path_factory.mktemp("reader")
    dexkit = [*host.enter, sys.executable, "-m", "dexkit"]
    suite = [*host.enter, sys.executable, "-m", "pytest", "-q", "--pyargs", "dexkit.conformance"]

    def run(*command: object) -> None:
        done = subprocess.run(
            list(map(str, command)), cwd=folder, env=_environment(), check=False, text=True,
            capture_output=True,
        )  # fmt: skip
        assert done.returncode == 0, (command, done.stdout, done.stderr)

    for name in ("session.mcap", "baseline.mcap"):
        shutil.copy(sample_path("dex1_pick_place"), folder / name)
    for name in ("recordings", "archive"):
        (folder / name).mkdir()
        shutil.copy(sample_path("dex3_pinch"), folder / name)
    robot = _Service([*dexkit, "emulate", "g1"], folder)
    assert not robot.wait_ready()
    run(*dexkit, "record", "walk.mcap", "--duration", 2)
    assert not robot.stop()
    shutil.copy(folder / "walk.mcap", folder / "robot.mcap")
    run(*suite, "--backend", "sim-dex1", "--quick", "--recording", "run.mcap",
        "--result", "result.json", "--report", "report.html")  # fmt: skip
    for name in ("before", "after", "v1.0", "v1.1", "a", "b", "c"):
        shutil.copy(folder / "result.json", folder / f"{name}.json")
    (folder / "capabilities.toml").write_text("[claims]\nforce = true\n")
    return folder


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


class _Service:
    """A command that runs until it is stopped."""

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        self.process = subprocess.Popen(
            command,
            cwd=folder,
            env=_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.lines: list[str] = []
        self._ready = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line)
            if line.startswith(("ready:", "{")):  # --json prints facts instead
                self._ready.set()
        self._ready.set()  # nothing more will come

    def wait_ready(self) -> str:
        """Why it is not ready, or an empty string."""
        if self._ready.wait(PATIENCE) and self.process.poll() is None:
            return ""
        return f"not ready: {''.join(self.lines)[-800:]}"

    def stop(self) -> str:
        """Interrupt it; what was wrong with its end, or an empty string."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            code = self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return "does not end with SIGINT"
        self._reader.join(PATIENCE)
        text = "".join(self.lines)
        # 1: recorded nothing; 130: interrupted before its work was done
        if code not in (0, 1, 130) or "Traceback" in text:
            return f"ended with {code}: {text[-800:]}"
        return ""


def _run(command: Sequence[str], folder: Path, words: Sequence[str]) -> str:
    done = subprocess.run(
        command,
        cwd=folder,
        env=_environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    allowed = (0, 1) if words[0] in WITH_FINDINGS else (0,)
    if done.returncode in allowed and "Traceback" not in done.stderr:
        return ""
    return f"exit code {done.returncode}: {(done.stderr or done.stdout)[-800:]}"


def _adapted(words: Sequence[str], folder: Path, device: str) -> list[str]:
    """The words with this machine's device and folder, and what a person would answer."""
    adapted = [re.sub(r"^/tmp/", f"{folder}/", w) for w in words]
    adapted = [w.replace("/dev/ttyUSB0", device) for w in adapted]
    if words[0] == "record":
        adapted[1] = f"new-{words[1]}"  # the reader's own is in use
    if tuple(words[:2]) == ("serve", "ezgripper") and "--device" in words:
        adapted += ["--set", "calibrate=yes"]
    if words[0] == "calibrate" and "--dry-run" not in words:
        adapted.append("--yes")
    return adapted


def _kind(words: Sequence[str]) -> str:
    """Of services with the same kind one runs at a time."""
    hands = words[0] == "serve" or words[:2] == ["emulate", "all"]
    return "hands" if hands else " ".join(words[: 2 if words[0] == "emulate" else 1])


def _run_block(block: Sequence[Shown], host: Host, folder: Path, device: str) -> Iterator[str]:
    services: dict[str, _Service] = {}
    with ExitStack() as stack:
        for shown in block:
            words = _adapted(shown.words, folder, device)
            command = [*host.enter, sys.executable, "-m", "dexkit", *words]
            if words[0] not in SERVICES or "--dry-run" in words:
                if words[0] == "install-service" and "--dry-run" not in words:
                    continue
                if words[0] == "install-service" and os.geteuid() == 0:
                    words = [*words, "--user", "root"]
                wrong = _run(command, folder, words)
            else:
                kind = _kind(words)
                if kind in services and (why := services.pop(kind).stop()):
                    yield f"{shown}: the one before it {why}"
                service = services[kind] = _Service(command, folder)
                stack.callback(service.stop)
                wrong = service.wait_ready()
            if wrong:
                yield f"{shown}: {wrong}"
        for name, service in services.items():
            if why := service.stop():
                yield f"{block[0].document}: dexkit {name} {why}"


@pytest.mark.parametrize("document", list(_commands()))
def test_commands_of_a_document_run(document: str, host: Host, files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "reader"
    shutil.copytree(files, folder)
    wrong: list[str] = []
    with emulated_ezgripper() as gripper:
        for _, block in itertools.groupby(_commands()[document], lambda s: s.block):
            wrong += _run_block(list(block), host, folder, str(gripper.path))
    assert not wrong, "\n".join(wrong)


def test_commands_that_are_not_run_are_in_the_documents() -> None:
    shown = [" ".join(s.words) for s in shown_commands() if s.program == "dexkit"]
    for pattern, why in ELSEWHERE:
        assert any(re.search(pattern, s) for s in shown), (pattern, why)

"""The examples for vendors: the made-up Acme gripper, and a service without dexkit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dexkit.backends import BackendOptions
from dexkit.conformance.kit.suite_run import SuiteOptions
from dexkit.errors import HandLost, HandNotFound
from dexkit.hand import Hand, HandCommand, Side
from tests.conformance_helpers import SUITE
from tests.dds_helpers import free_domain
from tests.process_helpers import started

if TYPE_CHECKING:
    import socketserver
    from types import ModuleType

EXAMPLES = Path(__file__).parent.parent / "examples"
ACME = EXAMPLES / "acme-gripper"
SERVICE = EXAMPLES / "external-service" / "gripper_service.py"


# ------------------------------------------------------------------------- the Acme gripper


@pytest.fixture
def acme(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(str(ACME))
    import acme_gripper.hand

    yield acme_gripper
    for name in [n for n in sys.modules if n.partition(".")[0] == "acme_gripper"]:
        del sys.modules[name]


@contextmanager
def emulated(acme: ModuleType, object_at: float | None = None) -> Iterator[str]:
    """An emulated gripper; its address."""
    import acme_gripper.emulator as emulator

    server: socketserver.TCPServer = emulator.serve(object_at=object_at)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def opened(acme: ModuleType, address: str, **settings: str) -> Hand:
    hand: Hand = acme.hand.backend.create(BackendOptions(Side.LEFT, address, settings))
    # time-outs are not the subject, and its emulator is a thread of a busy machine
    hand._spec = replace(hand.spec, exchange_timeout=5.0)  # type: ignore[attr-defined]
    hand.open()
    return hand


def drive(hand: Hand, command: HandCommand, until: float) -> float:
    """Exchange until q is there or stands still; the last tau_est."""
    while True:
        before = hand.exchange(command)
        for _ in range(20):
            state = hand.exchange(command)
        if abs(state.q[0] - until) < 0.02:
            return float(state.tau_est[0])
        if state.dq[0] == 0 and state.q[0] == before.q[0] and state.tau_est[0] != 0:
            return float(state.tau_est[0])


def test_example_hand_uses_dex1_units(acme: ModuleType) -> None:
    with emulated(acme) as address:
        hand = opened(acme, address)
        state = hand.exchange(HandCommand.brake(1))
        assert state.q == pytest.approx([0.2 * 5.4])
        assert state.temperature == pytest.approx([31.2])
        assert np.isnan(state.voltage).all()  # not known, so not reported
        assert drive(hand, HandCommand.position([2.7]), 2.7) == 0.0
        hand.close()
        hand.close()


def test_example_hand_stops_at_an_object_with_the_set_force(acme: ModuleType) -> None:
    with emulated(acme, object_at=40.0) as address:
        hand = opened(acme, address, force="12")
        drive(hand, HandCommand.position([4.0]), 4.0)
        assert drive(hand, HandCommand.position([0.5]), 0.5) == pytest.approx(-12 * 0.09 / 5.4)
        limp = HandCommand.position([0.5], kp=0.0, kd=0.0)
        while hand.exchange(limp).tau_est[0] != 0.0:
            pass
        assert hand.exchange(limp).q == pytest.approx([0.4 * 5.4])
        hand.close()


def test_disconnected_gripper_is_lost_and_reopened(acme: ModuleType) -> None:
    with emulated(acme) as address:
        hand = opened(acme, address)
        hand._socket.shutdown(2)  # type: ignore[attr-defined]
        with pytest.raises(HandLost):
            hand.exchange(HandCommand.brake(1))
        hand.close()
        hand.open()
        hand.exchange(HandCommand.brake(1))
        hand.close()
    with pytest.raises(HandLost, match="not open"):
        hand.exchange(HandCommand.brake(1))
    with pytest.raises(HandNotFound) as caught:
        hand.open()
    assert "switched on" in caught.value.hint


@pytest.mark.parametrize(
    "quick", [True, pytest.param(False, marks=pytest.mark.soak)], ids=["quick", "full"]
)
def test_the_gripper_of_the_guide_meets_what_its_maker_claims(
    acme: ModuleType, tmp_path: Path, quick: bool
) -> None:
    """The guide's own command, with the claims that the example ships."""
    with emulated(acme) as left, emulated(acme, object_at=37.0) as right:
        result = tmp_path / "result.json"
        run = subprocess.run(
            [
                *(*SUITE, "-q", "--pyargs", "dexkit.conformance"),
                *("--backend", "acme_gripper.hand:make", "--domain", str(free_domain())),
                *("--device", f"left={left}", "--device", f"right={right}"),
                *("--object", "right=37", "--capabilities", str(ACME / "capabilities.toml")),
                *("--result", str(result), *(["--quick"] if quick else [])),
            ],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
            env={**os.environ, "NO_COLOR": "1", "PYTHONPATH": str(ACME)},
        )
    assert run.returncode in (0, 2), run.stdout + run.stderr  # 2: this machine was too busy to tell
    rows = json.loads(result.read_text())["results"]
    found = {(row["id"], row["side"]): row["verdict"] for row in rows}
    assert not {k: v for k, v in found.items() if v in ("fail", "error")}, run.stdout
    assert list(found.values()).count("pass") > 30


def test_the_document_shows_the_hand_as_it_is() -> None:
    document = (EXAMPLES.parent / "docs" / "certify-your-gripper.md").read_text()
    source = (ACME / "acme_gripper" / "hand.py").read_text()
    for begin, indent in (("def exchange", "    "), ("def make", "")):
        shown = document[document.index(begin) :]
        assert textwrap.indent(shown[: shown.index("```")].strip(), indent) in source
    claims = (ACME / "capabilities.toml").read_text()
    shown = document[document.index("[hand]") :]
    assert shown[: shown.index("```")].strip() in claims


# ------------------------------------------------------------- a service without dexkit


@contextmanager
def service(domain: int) -> Iterator[subprocess.Popen[str]]:
    """The left gripper, once it serves."""
    with started([sys.executable, SERVICE, "left", "--domain", domain]) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready: ")
        yield process
        process.terminate()


def judged(domain: int, folder: Path, *arguments: str) -> dict[str, str]:
    """Verdict by requirement, of the suite's result file."""
    result = folder / "result.json"
    run = subprocess.run(
        [
            *(*SUITE, "-q"),
            *("--pyargs", "dexkit.conformance", "--backend", "external", "--side", "left"),
            *("--domain", str(domain), "--result", str(result), *arguments),
        ],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "NO_COLOR": "1"},
    )
    assert run.returncode == 0, run.stdout + run.stderr
    document = json.loads(result.read_text())
    return {row["id"]: row["verdict"] for row in document["results"]}


def test_example_service_does_not_import_dexkit() -> None:
    assert "dexkit" not in SERVICE.read_text().partition('"""\n')[2].replace("dexkit:", "", 1)


def test_a_service_without_dexkit_is_judged(tmp_path: Path) -> None:
    domain = free_domain()
    with service(domain) as process:
        verdicts = judged(domain, tmp_path, "--require", "DEX1-TOPIC", "--require", "DEX1-MOVE-02")
        assert process.poll() is None
    assert verdicts == dict.fromkeys(("DEX1-TOPIC-01", "DEX1-TOPIC-02", "DEX1-MOVE-02"), "pass")


@pytest.mark.soak
def test_a_service_without_dexkit_meets_every_must(tmp_path: Path) -> None:
    domain = free_domain()
    with service(domain):
        verdicts = judged(domain, tmp_path)
    assert set(verdicts.values()) <= {"pass", "not applicable"}
    assert list(verdicts.values()).count("pass") > 30


# --------------------------------------------------------------------- the suite at a vendor's


def test_a_hand_class_needs_no_name_to_be_judged() -> None:
    options = SuiteOptions.make(backend="tests.service_helpers:ScriptedHand", side="left")
    assert options.dialect.name == "unitree_go"
    assert {r.model for r in options.requirements} == {"dex1-1"}


IN_PLACE_OF_A_RUN = "import dexkit.conformance.kit.suite_run as session\n"
BUG = "def run_suite(*args): raise IndexError('a bug of the kit')\n"
DROPOUT = """
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.traces import open_trace, sample_path
view = Recording.decode(open_trace(sample_path('dex1_hand_dropout')))
def run_suite(options, *args): return judge(view, requirements=options.requirements)
"""


@pytest.mark.parametrize(
    ("instead", "code", "texts"),
    [
        (BUG, 2, ["the kit itself has failed, which says nothing about", "a bug of the kit"]),
        (DROPOUT, 1, ["DEX1-RATE-03 ", "FAIL: a MUST is not met"]),
    ],
    ids=["bug", "failure"],
)
def test_suite_prints_a_failure_once_and_has_its_exit_code(
    instead: str, code: int, texts: list[str], tmp_path: Path
) -> None:
    (tmp_path / "instead.py").write_text(
        f"{IN_PLACE_OF_A_RUN}{instead}session.run_suite = run_suite\n"
    )
    run = subprocess.run(
        [*SUITE, "-p", "instead", "--pyargs", "dexkit.conformance", "--backend", "sim-dex1"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "NO_COLOR": "1"},
    )
    assert run.returncode == code, run.stdout + run.stderr
    places = [run.stdout.index(text) for text in texts]
    assert places == sorted(places)
    assert run.stdout.count("a bug of the kit") <= 2  # the exception, and its source line
    assert "FAILED" not in run.stdout

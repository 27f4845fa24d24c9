"""``dexkit doctor`` beside hands of position servos that move, on DDS: what is wrong, by name."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from dexkit.child_processes import command_line
from dexkit.dds import DdsNode
from dexkit.doctor.dds import observe_domains
from dexkit.doctor.observations import Observations
from dexkit.doctor.rules import diagnose
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import dialect, model
from dexkit.teleop.client import JointCommand
from dexkit.teleop.client_codec import ClientCodec
from tests.dds_helpers import free_domain
from tests.patience import PATIENCE
from tests.process_helpers import started

WAYS = {"DDS-REVERSED", "DDS-SIDES-SWAPPED"}
LEFT, RIGHT = Side.LEFT, Side.RIGHT


@contextmanager
def served(backend: str, name: str) -> Iterator[int]:
    """Both hands of a backend on a domain of their own, by ``dexkit serve``."""
    domain = free_domain()
    arguments = ("serve", backend, "--side", "both", "--domain", str(domain), "--quiet")
    with started(command_line(*arguments)) as process:
        assert process.stdout is not None
        for _ in {dialect(name).topics(side) for side in Side}:
            assert process.stdout.readline().startswith("ready: ")
        yield domain
        process.terminate()


@contextmanager
def operated(domain: int, name: str) -> Iterator[None]:
    """A client that moves the hands to and fro in eight seconds, the right one two seconds late."""
    spoken, ended = dialect(name), threading.Event()
    wire, joints = ClientCodec(spoken), len(model(spoken.model).joints[LEFT])

    def operate() -> None:
        began = time.monotonic()
        while not ended.wait(0.01):
            part = (time.monotonic() - began) / 4.0
            targets = {LEFT: to_and_fro(part), RIGHT: to_and_fro(part - 0.5)}
            commands = {s: [JointCommand(0, q, 1.0, 0, 0, 0)] * joints for s, q in targets.items()}
            for topic, payload in wire.encode(commands):
                writers[topic].write_raw(payload)

    with DdsNode(domain, "lo") as node:
        topics = dict.fromkeys(wire.command_topics.values())
        writers = {t: node.writer(t, message_type(spoken.cmd_type)) for t in topics}
        for topic in dict.fromkeys(wire.state_topics.values()):
            node.reader(topic, message_type(spoken.state_type))
        client = threading.Thread(target=operate)
        client.start()
        try:
            yield
        finally:
            ended.set()
            client.join()


def to_and_fro(part: float) -> float:
    """From 0.1 to 0.9 of the travel and back while the part goes from 0 to 2."""
    return 0.1 + 0.8 * min(part % 2.0, 2.0 - part % 2.0)


def findings(domain: int, seconds: float = 1.2) -> set[str]:
    return {f.id for f in diagnose(Observations(tuple(observe_domains([domain], seconds=seconds))))}


@pytest.mark.parametrize(
    ("backend", "name", "expected"),
    [
        ("brainco_reversed", "brainco", "DDS-REVERSED"),
        pytest.param("dfx_swapped", "inspire_dfx", "DDS-SIDES-SWAPPED", marks=pytest.mark.soak),
        pytest.param("ftp_swapped", "inspire_ftp", "DDS-SIDES-SWAPPED", marks=pytest.mark.slow),
    ],
)
def test_a_wrong_hand_is_named(backend: str, name: str, expected: str) -> None:
    with served(f"tests.wrong_servos:{backend}", name) as domain, operated(domain, name):
        found: set[str] = set()
        end = time.monotonic() + PATIENCE
        while (
            expected not in found and time.monotonic() < end
        ):  # the hands turn round in some looks
            found = findings(domain) & WAYS
    assert expected in found


@pytest.mark.soak
@pytest.mark.parametrize(
    ("backend", "name"),
    [
        ("sim-brainco", "brainco"),
        ("sim-inspire-dfx", "inspire_dfx"),
        ("sim-inspire-ftp", "inspire_ftp"),
    ],
)
def test_doctor_reports_a_client_of_another_model_only(backend: str, name: str) -> None:
    other = "inspire_dfx" if name == "brainco" else "brainco"
    with served(backend, name) as domain:
        with operated(domain, name):
            for _ in range(4):
                assert not findings(domain) & (WAYS | {"DDS-OTHER-HAND"})
        with operated(domain, other):
            assert "DDS-OTHER-HAND" in findings(domain)

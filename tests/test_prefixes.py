"""Hands under a prefix, as those of two robots on one domain: ``rt/r2/dex3/left/cmd``."""

from __future__ import annotations

import json
import subprocess
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from dexkit.child_processes import Tool, command_line
from dexkit.cli import cli
from dexkit.conformance.kit.decoding import recording_of
from dexkit.doctor import diagnose, readiness, verdict
from dexkit.doctor.observations import DomainView
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.topics import checked_prefix, split_prefix, under_prefix
from dexkit.traces import open_trace
from dexkit.traces.samples import sample_path
from dexkit.traces.writer import RecordingWriter
from tests.patience import PATIENCE
from tests.test_doctor_rules import GOOD, _seen


@pytest.mark.parametrize(
    ("topic", "prefix", "bare"),
    [
        ("rt/r2/dex3/left/cmd", "r2", "rt/dex3/left/cmd"),
        ("rt/lab/r2/dex1/right/state", "lab/r2", "rt/dex1/right/state"),
        ("rt/r2/lf/dex3/left/state", "r2", "rt/lf/dex3/left/state"),
        ("rt/lf/dex3/left/state", "", "rt/lf/dex3/left/state"),
        ("rt/lf/dex1/left/state", "", "rt/lf/dex1/left/state"),  # no robot is called lf
        ("rt/dex3/left/cmd", "", "rt/dex3/left/cmd"),
        ("rt/r2/lowstate", "", "rt/r2/lowstate"),
        ("usb/left/in", "", "usb/left/in"),
    ],
)
def test_a_topic_is_split(topic: str, prefix: str, bare: str) -> None:
    assert split_prefix(topic) == (prefix, bare)
    if prefix:
        assert under_prefix(bare, prefix) == topic


@pytest.mark.parametrize("text", ["", "rt", "2", "a b", "r2//x", "*"])
def test_what_cannot_be_one(text: str) -> None:
    with pytest.raises(UsageError):
        checked_prefix(text)


# ----------------------------------------------------------------------------------- recordings


def _moved(target: Path, *prefixes: str) -> Path:
    """Three seconds of a sample, whose hands are under one prefix or several."""
    trace = open_trace(sample_path("dex3_pinch"))
    with RecordingWriter(target) as writer:
        channels = {
            (key, prefix): writer.add_channel(replace(d, topic=under_prefix(d.topic, prefix)))
            for key, d in trace.definitions.items()
            for prefix in prefixes
        }
        for m in trace.messages():
            if m.log_time_ns < trace.first_ns + 3 * 10**9:
                for prefix in prefixes:
                    number = channels[(m.topic, m.type_name), prefix]
                    writer.put(number, m.data, m.log_time_ns, m.publish_time_ns)
    return target


def test_the_only_prefix_of_a_recording_is_found(tmp_path: Path) -> None:
    plain = recording_of(open_trace(_moved(tmp_path / "plain.mcap", "")), None, ())
    moved = recording_of(open_trace(_moved(tmp_path / "moved.mcap", "r2")), None, ())
    assert moved.judged == plain.judged == (Side.LEFT, Side.RIGHT)
    for side in plain.judged:
        assert len(moved.sides[side].states) == len(plain.sides[side].states) > 0
        assert moved.sides[side].states.topic == plain.sides[side].states.topic
    assert any("rt/r2/..." in note for note in moved.notes)


def test_several_robots_are_chosen_from(tmp_path: Path) -> None:
    trace = open_trace(_moved(tmp_path / "two.mcap", "r1", "r2"))
    with pytest.raises(UsageError, match="hands of several robots: r1, r2"):
        recording_of(trace, None, ())
    with pytest.raises(UsageError, match="no hand has the prefix r3"):
        recording_of(trace, None, (), "r3")
    chosen = recording_of(trace, None, (), "r2")
    assert any("not judged: r1" in note for note in chosen.notes)
    both = open_trace(_moved(tmp_path / "both.mcap", "", "r2"))
    assert any("not judged: r2" in note for note in recording_of(both, None, ()).notes)


def test_check_has_the_option(tmp_path: Path) -> None:
    path = _moved(tmp_path / "two.mcap", "r1", "r2")
    done = CliRunner().invoke(cli, ["check", str(path)], catch_exceptions=True)
    assert isinstance(done.exception, UsageError)
    plain = CliRunner().invoke(cli, ["check", str(_moved(tmp_path / "plain.mcap", ""))])
    chosen = CliRunner().invoke(cli, ["check", str(path), "--prefix", "r1"])
    assert chosen.exit_code == plain.exit_code


# --------------------------------------------------------------------------------------- doctor


def _under(view: DomainView, prefix: str, kinds: tuple[str, ...]) -> DomainView:
    moved = {e.key for e in view.endpoints if e.kind in kinds}
    return replace(
        view,
        endpoints=tuple(
            replace(e, topic=under_prefix(e.topic, prefix)) if e.key in moved else e
            for e in view.endpoints
        ),
        streams=tuple(
            replace(s, topic=under_prefix(s.topic, prefix)) if s.writer in moved else s
            for s in view.streams
        ),
    )


def test_a_healthy_robot_under_a_prefix_is_healthy() -> None:
    plain = _seen(GOOD)
    seen = _seen(_under(GOOD, "r2", ("reader", "writer")))
    found = diagnose(seen)
    assert [f.id for f in found if f.id != "DDS-PREFIX"] == [f.id for f in diagnose(plain)]
    assert [str(f.severity) for f in found if f.id == "DDS-PREFIX"] == ["note"]
    assert verdict(seen, found).healthy
    assert [r.prefix for r in readiness(seen)] == ["r2"] * len(readiness(plain))


def test_a_client_without_the_prefix_is_told() -> None:
    told = [f for f in diagnose(_seen(_under(GOOD, "r2", ("writer",)))) if f.id == "DDS-PREFIX"]
    assert [str(f.severity) for f in told] == ["error"]
    assert "a client waits for rt/" in told[0].seen


# ----------------------------------------------------------------------------------- live


@pytest.mark.slow
def test_a_hand_is_served_recorded_and_watched_under_a_prefix(tmp_path: Path) -> None:
    helpers = pytest.importorskip("tests.dds_helpers")
    domain = ("--domain", str(helpers.free_domain()))
    out = tmp_path / "a.mcap"
    with Tool("serve", "sim-dex3", "--side", "left", "--prefix", "r2", "--quiet", *domain) as hand:
        hand.wait_ready(threading.Event())
        watched = subprocess.run(
            command_line("monitor", "--json", "--period", "0.5", "--duration", "2", *domain),
            capture_output=True, text=True, check=True, timeout=PATIENCE,
        )  # fmt: skip
        subprocess.run(
            command_line("record", str(out), "--prefix", "r2", "--duration", "2", *domain),
            check=True, timeout=PATIENCE,
        )  # fmt: skip
    subjects = [s for line in watched.stdout.splitlines() for s in json.loads(line)["subjects"]]
    assert {(s["prefix"], s["subject"]) for s in subjects} == {("r2", "left")}
    topics = open_trace(out).topics
    assert "rt/r2/dex3/left/state" in topics
    assert {topic.split("/")[1] for topic in topics} == {"r2"}
    assert recording_of(open_trace(out), None, ()).judged == (Side.LEFT,)

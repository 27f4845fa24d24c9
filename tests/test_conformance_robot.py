"""Test conformance of robots: the reference passes, wrong robots fail, and a run on DDS."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from dexkit.cli.check import command
from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.faults.robot import CdrCrc
from dexkit.conformance.kit.backend_processes import RigOptions
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.live import LiveOptions, record_run
from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.kit.requirements import Level, catalogue, select
from dexkit.conformance.kit.results import Overall, RunResult, Stage, Verdict
from dexkit.conformance.kit.robot import (
    WRONG_CRCS,
    RobotMotorCodec,
    robot_dialect,
    robot_in,
    robot_recording,
)
from dexkit.conformance.kit.stimulus_record import Stimulus
from dexkit.conformance.kit.suite_run import SuiteOptions
from dexkit.conformance.stimuli import Plan, phases_for, script_class
from dexkit.conformance.virtual import MemoryTrace, Sample, run_virtual
from dexkit.conformance.virtual.robot import Orders, ReferenceRobot
from dexkit.errors import ConformanceError, UsageError
from dexkit.hand import ROBOT, Side
from dexkit.messages import decode
from dexkit.robots import G1, H1, ROBOTS, RobotModel
from dexkit.traces import Recorder, TraceEndpoint, open_trace
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.low_level import crc_of, verify_payload
from tests.conformance_helpers import copy_of, short_run
from tests.dds_helpers import free_domain
from tests.each import each
from tests.test_conformance_schema import validate

NAMES = list(ROBOTS)


def plan(name: str, phases: Iterable[str]) -> Plan:
    return Plan(robot_dialect(name), (ROBOT,), phases=frozenset(phases))


def everything(name: str) -> frozenset[str]:
    return phases_for(catalogue(name, "robot"))


@cache
def listened(name: str, service: type[ReferenceRobot] = ReferenceRobot) -> MemoryTrace:
    """Run a robot through the phases listen and hold."""
    return run_virtual(plan(name, ()), service)


def judged(trace: MemoryTrace, name: str) -> RunResult:
    return judge(robot_recording(trace, name))


# ----------------------------------------------------------------------------------- the wire


@each("model", ROBOTS.values(), ids=NAMES)
def test_robot_commands_are_decoded_by_the_codec(model: RobotModel) -> None:
    codec = RobotMotorCodec(robot_dialect(model.name))
    motors = [Motor(0.1 * i, 0.2, 0.3, 4.0, 0.5, i % 3) for i in range(model.slots)]
    payload = codec.encode_low_command(motors, 7)
    assert verify_payload(model.cmd_type, payload)
    message = decode(model.cmd_type, payload)
    read = [(m.mode, m.q, m.dq, m.tau, m.kp, m.kd) for m in message.motor_cmd]
    sent = [(m.mode, *np.float32((m.q, m.dq, m.tau, m.kp, m.kd)).tolist()) for m in motors]
    assert read == sent
    if model is G1:
        assert message.mode_machine == 7
    else:
        assert (*message.head, message.level_flag) == (0xFE, 0xEF, 0xFF)


@each("kind", WRONG_CRCS)
def test_damaged_commands_differ_only_in_crc(kind: str) -> None:
    codec = RobotMotorCodec(robot_dialect("h1"))
    motors = [Motor(q=0.5)] * 20
    good, bad = codec.encode_low_command(motors, 0), codec.encode_low_command(motors, 0, kind)
    assert good[:-4] == bad[:-4]
    assert not verify_payload(H1.cmd_type, bad)
    right = crc_of(decode(H1.cmd_type, good))
    wrong = {"bit": right ^ 0x10, "zero": 0, "cdr": crc32_words(good[4:-4])}[kind]
    assert int.from_bytes(bad[-4:], "little") == wrong


# ---------------------------------------------------------------------------------- its teeth


@pytest.mark.parametrize("name", ["h1", pytest.param("g1", marks=pytest.mark.soak)])
def test_reference_robot_passes_every_requirement(name: str) -> None:
    result = judged(run_virtual(plan(name, everything(name)), ReferenceRobot), name)
    bad = [r.explain() for r in result.results if r.verdict is not Verdict.PASS]
    assert not bad, "\n".join(bad)
    assert result.overall is Overall.PASS
    assert [r.requirement.id for r in result.results] == [r.id for r in catalogue(name, "robot")]
    assert result.stage == {"robot": Stage.MOVING}


def blamed(robot: type[ReferenceRobot], model: str, *phases: str) -> set[str]:
    plan = replace(plan_for(model), phases=frozenset(phases))
    bad = (Verdict.FAIL, Verdict.WARN, Verdict.ERROR)
    return {r.requirement.id for r in run_mutant(robot, plan).results if r.verdict in bad}


@each("name", NAMES)
def test_needed_stimuli_exist(name: str) -> None:
    script = script_class(name)(plan(name, everything(name)))
    assert 15 < script.length() < 40
    assert everything(name) <= {p.name for p in script.phases}


# ------------------------------------------------------------------------------ single findings


def test_script_ends_early_without_state() -> None:
    class Mute(ReferenceRobot):
        """Publishes no state."""

        def publish(self) -> list[object]:  # type: ignore[override]
            return []

    trace = run_virtual(plan("h1", everything("h1")), Mute)
    assert Stimulus.from_metadata(trace.metadata["dexkit.stimulus"]).phases[-1].name == "listen"
    result = judged(trace, "h1")
    assert result.overall is Overall.FAIL
    assert result.stage == {"robot": Stage.TYPE_MATCHED}
    failed = {r.requirement.id for r in result.results if r.verdict is Verdict.FAIL}
    assert failed == {"H1-TOPIC-01"}


class DiesOfNaN(ReferenceRobot):
    """Ends with the first NaN."""

    dead = False

    def accepts(self, orders: Orders) -> bool:
        self.dead = self.dead or not self.finite(orders)
        return super().accepts(orders)

    def publish(self) -> list[Sample]:
        return [] if self.dead else super().publish()


class Hiccup(ReferenceRobot):
    """Publishes nothing for 0.2 s after a NaN."""

    since = math.inf

    def accepts(self, orders: Orders) -> bool:
        if not self.finite(orders):
            self.since = min(self.since, self.now)
        return super().accepts(orders)

    def publish(self) -> list[Sample]:
        return [] if self.since <= self.now < self.since + 0.25 else super().publish()


def test_robot_that_stops_publishing_fails_and_late_one_is_not_judged() -> None:
    assert "H1-SAFE-01" in blamed(DiesOfNaN, "h1", "nan")
    assert blamed(Hiccup, "h1", "nan") == set()


# --------------------------------------------------------------------------------- recordings


def write(trace: MemoryTrace, path: Path, *, bare: bool = False) -> Path:
    """Write a trace to a file; with ``bare`` without the kit's metadata."""
    with Recorder(path) as recorder:
        for (topic, kind), rows in trace.rows.items():
            for log, sent, data in rows:
                recorder.put(topic, kind, data, log, sent)
        if not bare:
            for name, record in trace.metadata.items():
                recorder.add_metadata(name, record)
    return path


@pytest.mark.parametrize("name", NAMES)
def test_recording_is_judged_from_its_file(name: str, tmp_path: Path) -> None:
    path = write(listened(name), tmp_path / "run.mcap")
    files = [f"{option}={tmp_path / file}" for option, file in FILES.items()]
    result = CliRunner().invoke(command, [str(path), *files])
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "result.json").read_text())
    validate(found)
    assert found["subject"]["model"] == name
    assert found["overall"] == "pass"
    assert found["counts"]["pass"] >= 15
    page = (tmp_path / "report.html").read_text()
    assert f"{ROBOTS[name].title}" in page
    assert f"{name.upper()}-CRC-01-robot" in (tmp_path / "junit.xml").read_text()


FILES = {"--result": "result.json", "--html": "report.html", "--junit": "junit.xml"}


def test_recording_without_stimulus_is_judged_in_part(tmp_path: Path) -> None:
    path = write(listened("g1", CdrCrc), tmp_path / "session.mcap", bare=True)
    result = CliRunner().invoke(command, [str(path)])
    assert result.exit_code == 1
    assert "G1-CRC-01" in result.output
    (failed,) = [line for line in result.output.splitlines() if " FAIL " in line]
    assert failed.startswith("G1-CRC-01")
    trace = open_trace(path)
    assert robot_in(trace) is G1
    memory = MemoryTrace(rows={("rt/lowcmd", H1.cmd_type): [(0, 0, b"")]})
    assert robot_in(memory) is H1
    memory.endpoints.append(TraceEndpoint("rt/lowstate", "writer", "", type_name=G1.state_type))
    assert robot_in(memory) is G1
    assert recording_of(trace, None, ()).dialect.name == "g1"
    other = CliRunner().invoke(command, [str(path), "--dialect", "h1"])
    assert other.exit_code == 1
    assert "wrong type" in other.output
    with pytest.raises(ConformanceError, match="no topic of the H1 robot"):
        robot_recording(MemoryTrace(), "h1")


def test_recording_with_hands_and_robot_judges_hands_and_mentions_robot(tmp_path: Path) -> None:
    whole = copy_of(short_run())
    whole.rows.update(listened("g1").rows)
    path = write(whole, tmp_path / "robot.mcap", bare=True)
    hands = CliRunner().invoke(command, [str(path)])
    assert "DEX1-RATE-01" in hands.output
    assert "there is a robot, too: judge it with --dialect g1" in hands.output
    robot = CliRunner().invoke(command, [str(path), "--dialect", "g1"])
    assert robot.exit_code == 0
    assert "G1-CRC-01" in robot.output
    assert "DEX1" not in robot.output
    with pytest.raises(UsageError, match="no sides"):
        recording_of(open_trace(path), "g1", (Side.LEFT,))


# ------------------------------------------------------------------------------------ live runs


def test_hand_options_are_refused_for_robots() -> None:
    options = SuiteOptions.make(backend="sim-g1")
    assert (options.sides, options.dialect.name) == ((ROBOT,), "g1")
    assert {r.layer for r in options.requirements} == {"robot"}
    quick = SuiteOptions.make(backend="sim-h1", quick=True).requirements
    assert {r.level for r in quick} == {Level.MUST}
    assert 10 < len(quick) < len(options.requirements)
    for wrong in ({"side": "left"}, {"devices": ["/dev/null"]}, {"settings": ["a=b"]}):
        with pytest.raises(UsageError, match="for hands only"):
            SuiteOptions.make(backend="sim-h1", **wrong)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="sim-h1 has no dialect g1"):
        SuiteOptions.make(backend="sim-h1", dialect_name="g1")
    with pytest.raises(UsageError, match="sim-dex1 has no dialect h1"):
        SuiteOptions.make(backend="sim-dex1", dialect_name="h1")
    assert SuiteOptions.make(backend="external", dialect_name="h1").domain == 0


def test_emulated_robot_passes_on_dds(tmp_path: Path) -> None:
    wanted = select(catalogue("g1", "robot"), prefixes=["G1-LIFE-01", "G1-CRC-01", "G1-TOPIC"])
    rig = RigOptions("sim-g1", (ROBOT,), robot_dialect("g1"), free_domain())
    path = tmp_path / "run.mcap"
    assert record_run(LiveOptions(rig, phases_for(wanted)), path)
    result = judge(robot_recording(open_trace(path), "g1"), requirements=wanted)
    bad = [r.explain() for r in result.results if r.verdict not in (Verdict.PASS, Verdict.BLOCKED)]
    assert not bad, "\n".join(bad)

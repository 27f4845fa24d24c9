"""The self-test of a hand, on emulated hands and a virtual clock."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from dexkit.cli import cli
from dexkit.clock import ManualClock
from dexkit.conformance.report.selftest import findings, render_selftest
from dexkit.conformance.selftest.external import ExternalHandCodec
from dexkit.conformance.selftest.joint_motion import LEAD, Setup
from dexkit.conformance.selftest.live import run
from dexkit.conformance.selftest.procedure import Procedure
from dexkit.conformance.selftest.result import (
    Condition,
    ElementResponse,
    SelfTestResult,
    Verdict,
    result_of,
)
from dexkit.conformance.selftest.result_file import SelfTestFile, as_document, write_json
from dexkit.conformance.selftest.supervision import End, SelfTest
from dexkit.emulators.sim_brainco import SimBrainCo
from dexkit.emulators.sim_dex1 import SimHand
from dexkit.emulators.sim_dex3 import SimDex3
from dexkit.emulators.sim_dex5 import SimDex5
from dexkit.emulators.sim_inspire import SimInspireDfx
from dexkit.emulators.simulated_hand import SimulatedHand
from dexkit.errors import HandLost, HandTimeout, UsageError
from dexkit.hand import Hand, HandCommand, HandSpec, HandState, JointMode, MotorError, Side
from dexkit.messages import message_type
from dexkit.models import BUILT_IN, Dialect, model
from dexkit.records import as_plain, to_record
from dexkit.service.dialects import StateView, dialect_map
from tests.each import each

WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=timezone.utc)
HANDS: dict[str, Callable[[ManualClock], SimulatedHand]] = {
    "dex1": lambda clock: SimHand(Side.LEFT, clock=clock),
    "dex3": lambda clock: SimDex3(Side.LEFT, clock=clock),
    "dex5": lambda clock: SimDex5(Side.LEFT, clock=clock),
    "brainco": lambda clock: SimBrainCo(Side.LEFT, clock=clock),
    "inspire-dfx": lambda clock: SimInspireDfx(Side.LEFT, clock=clock),
}


class Over:
    """A hand around a hand; ``change`` sees every command and state."""

    def __init__(self, inner: Hand, change: Callable[[HandCommand, HandState], HandState]) -> None:
        self.inner, self.change = inner, change
        self.alter: Callable[[HandCommand, HandState], HandCommand] | None = None
        self.commands: list[HandCommand] = []
        self.last: HandState | None = None

    @property
    def spec(self) -> HandSpec:
        return self.inner.spec

    def open(self) -> None:
        self.inner.open()

    def close(self) -> None:
        self.inner.close()

    def exchange(self, command: HandCommand) -> HandState:
        self.commands.append(command)
        if self.alter is not None and self.last is not None:
            command = self.alter(command, self.last)
        self.last = self.inner.exchange(command)
        return self.change(command, self.last)


def same(command: HandCommand, state: HandState) -> HandState:
    return state


class Loaded(ManualClock):
    """A clock of a machine that often comes back late."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self._random = random.Random(seed)

    def sleep_until(self, deadline: float) -> None:
        late = 0.0
        if self._random.random() < 0.01:
            late = self._random.choice((0.004, 0.02, 0.06, 0.15))
        super().sleep_until(deadline + late)


def examined(
    name: str,
    *,
    joints: Sequence[int] | None = None,
    touch: bool = False,
    clock: ManualClock | None = None,
    change: Callable[[HandCommand, HandState], HandState] = same,
    turn: Callable[[SelfTest], object] = lambda test: None,
    alter: Callable[[HandCommand, HandState], HandCommand] | None = None,
    slow: bool = False,
) -> tuple[SelfTest, Over]:
    clock = clock or ManualClock(7.0)
    inner = HANDS[name](clock)
    if slow:
        limits = inner._mechanics.limits  # type: ignore[attr-defined]
        inner._mechanics.limits = replace(limits, dq_max=0.2 * limits.dq_max)  # type: ignore[attr-defined]
    hand = Over(inner, change)
    hand.alter = alter
    hand.open()
    setup = Setup.from_spec(hand.spec, rate=100.0)
    speed = 1.0 if setup.servo else 0.25
    test = SelfTest(Procedure(setup, joints=joints, speed=speed, touch=touch))
    run(hand, test, clock=clock, turn=turn)
    return test, hand


@cache
def good() -> SelfTestResult:
    return result_of(examined("dex1")[0], {"name": "a"}, now=WHEN)


# ------------------------------------------------------------------------------------- hands


def test_a_new_gripper_has_nothing_wrong() -> None:
    result = good()
    assert result.verdict is Verdict.GOOD
    assert not findings(result)
    (joint,) = result.joints
    figures = {f.name: f.value for f in joint.figures}
    assert figures["range"] == pytest.approx(5.4, abs=0.02)
    assert figures["speed+"] == pytest.approx(6.0, rel=0.05)


def _unpowered(command: HandCommand, state: HandState) -> HandCommand:
    return HandCommand.brake(len(command.q))


def _blocked(command: HandCommand, state: HandState) -> HandState:
    return replace(state, q=np.minimum(state.q, 4.8))


@each(
    "fault, figures",
    [
        ({"alter": _unpowered}, ["condition"]),
        ({"change": _blocked}, ["range"]),
        ({"slow": True}, ["speed+", "speed-"]),
    ],
)
def test_each_fault_changes_only_its_figures(fault: dict[str, Any], figures: list[str]) -> None:
    result = result_of(examined("dex1", **fault)[0], {})
    (joint,) = result.joints
    assert joint.faulty == figures
    assert result.verdict is Verdict.FAULTY
    assert len(findings(result)) == len(figures)


def test_no_figure_depends_on_load() -> None:
    check_load("dex1", 0)


def check_load(name: str, seed: int, joints: Sequence[int] | None = None) -> None:
    """A figure of a machine that is often late is that of an idle one, or there is none."""
    before = good() if name == "dex1" else result_of(examined(name, joints=joints)[0], {})
    busy, _ = examined(name, joints=joints, clock=Loaded(seed))
    after = result_of(busy, {})
    assert busy.end is End.DONE
    lost = 0
    for was, now in zip(before.joints, after.joints, strict=True):
        assert now.condition is was.condition
        for old, new in zip(was.figures, now.figures, strict=True):
            lost += math.isnan(new.value) and not math.isnan(old.value)
            same = new.value == pytest.approx(old.value, rel=0.05, nan_ok=True)
            assert same or math.isnan(new.value), (seed, now.name, old, new)
    assert (lost > 0) <= bool(after.spoiled)
    spoiled = [n for j in after.joints for n in j.notes if "spoiled by pauses" in n]
    assert len(spoiled) == after.spoiled


def test_no_motor_gives_more_than_its_lead_allows() -> None:
    setup = Setup.from_spec(SimHand().spec)
    most = float(setup.kp[0]) * LEAD
    state: HandState | None = None

    def watch(command: HandCommand, now: HandState) -> HandState:
        nonlocal state
        if state is not None and command.mode[0]:
            # both by where the hand is when the command comes, one period after its last state
            pull = command.kp[0] * (command.q[0] - now.q[0])
            assert abs(pull) <= most + command.kp[0] * 0.12
        state = now
        return now

    def stop(test: SelfTest) -> None:
        if test.now - test.begin > 8.0:
            test.stop(End.STOPPED, "enough")

    test, hand = examined("dex1", change=watch, turn=stop)
    assert test.end is End.STOPPED
    assert hand.commands[-1].is_brake, "it is left at rest"


def test_a_joint_that_moves_the_wrong_way_is_left_alone() -> None:
    def mirrored(command: HandCommand, state: HandState) -> HandState:
        return replace(state, q=5.4 - state.q, dq=-state.dq)

    def driven_back(command: HandCommand, state: HandState) -> HandCommand:
        return replace(command, q=2 * state.q - command.q)

    for change, alter in ((mirrored, None), (same, driven_back)):
        test, hand = examined("dex1", change=change, alter=alter)
        result = result_of(test, {})
        assert result.joints[0].condition is Condition.REVERSED
        assert result.verdict is Verdict.FAULTY
        driven = [c for c in hand.commands if not c.is_brake and c.kp[0] > 0]
        assert len(driven) < 120, "it is not driven any more"


def test_crossed_joints_are_named() -> None:
    crossed = [1, 0, 2, 3, 4, 5]

    def swap(command: HandCommand, state: HandState) -> HandState:
        return replace(state, q=state.q[crossed], dq=state.dq[crossed])

    test, _ = examined("brainco", joints=[0, 1], change=swap)
    result = result_of(test, {})
    assert [j.condition for j in result.joints[:2]] == [Condition.OTHER] * 2
    assert result.joints[0].moves == ("thumb_aux",)


def test_every_element_is_found_by_touch() -> None:
    dead = {(5, 8), (7, 0)}
    test = None

    def remember(now: SelfTest) -> None:
        nonlocal test
        test = now

    def pressed(command: HandCommand, state: HandState) -> HandState:
        assert state.pressure is not None
        assert test is not None
        if not test.procedure.question:
            return state
        asked = [e for e in test.procedure.found.elements if e.answered is False]
        missing = [e for e in asked if (e.packet, e.slot) not in dead]
        if not missing:
            test.procedure.skip()  # the person presses Enter
            return state
        values = state.pressure.copy()
        values[missing[0].packet, missing[0].slot] += 4000.0
        return replace(state, pressure=values)

    found, _ = examined("dex3", joints=[], touch=True, change=pressed, turn=remember)
    result = result_of(found, {})
    lacking = {(e.packet, e.slot) for e in result.elements if e.touch is ElementResponse.DEAD}
    assert lacking == dead
    assert sum(e.touch is ElementResponse.ANSWERS for e in result.elements) == 33 - len(dead)
    assert "index tip, element 5.8" in render_selftest(result)


# ------------------------------------------------------------------------------------- supervision


def _raise(error: Exception) -> HandState:
    raise error


@each(
    "name, what, reason",
    [
        (
            "fault",
            lambda s: replace(s, fault=np.array([MotorError.OVERCURRENT], np.uint32)),
            "gripper reports overcurrent",
        ),
        ("hot", lambda s: replace(s, temperature=np.array([95.0])), "gripper is at 95"),
        ("nan", lambda s: replace(s, q=np.array([math.nan])), "reports no positions"),
        ("lost", lambda s: _raise(HandLost("unplugged")), "unplugged"),
        ("silent", lambda s: _raise(HandTimeout("no answer")), "no answer"),
    ],
)
def test_the_hand_is_left_at_rest_whatever_happens(
    name: str, what: Callable[[HandState], HandState], reason: str
) -> None:
    def change(command: HandCommand, state: HandState) -> HandState:
        return what(state) if state.stamp > 9.0 else state

    test, hand = examined("dex1", change=change)
    assert test.end is End.FAULT
    assert reason in test.reason
    assert result_of(test, {}).verdict is Verdict.FAULTY
    if name in ("fault", "hot"):
        assert all(command.is_brake for command in hand.commands[-10:])


def test_a_failure_of_the_caller_leaves_the_hand_at_rest() -> None:
    def fail(test: SelfTest) -> None:
        if test.now - test.begin > 3.0:
            raise KeyboardInterrupt

    clock = ManualClock(7.0)
    hand = Over(HANDS["dex1"](clock), same)
    hand.open()
    test = SelfTest(Procedure(Setup.from_spec(hand.spec)))
    with pytest.raises(KeyboardInterrupt):
        run(hand, test, clock=clock, turn=fail)
    assert hand.commands[-1].is_brake


# ------------------------------------------------------------------------------------- the file


def test_file_of_a_result_has_its_form(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    result = result_of(examined("dex1", alter=_unpowered)[0], {})
    write_json(result, path)
    document = json.loads(path.read_text())
    assert as_plain(to_record(document, SelfTestFile, path)) == as_document(result)
    assert document["verdict"] == "faulty"
    assert document["joints"][0]["figures"]["range"]["value"] is None


def test_selftest_without_measurements_is_incomplete() -> None:
    test, _ = examined("dex1", joints=[], turn=lambda t: None)
    empty = replace(result_of(test, {}), joints=())
    assert empty.verdict is Verdict.INCOMPLETE
    stopped = replace(good(), ended=End.STOPPED)
    assert stopped.verdict is Verdict.INCOMPLETE
    assert replace(good(), spoiled=1).verdict is Verdict.INCOMPLETE


# ------------------------------------------------------------------------------------- on DDS


def test_a_dialect_that_commands_both_hands_is_refused() -> None:
    for spoken in (d for m in BUILT_IN for d in m.dialects if d.commands_both):
        with pytest.raises(UsageError, match="moves both hands"):
            ExternalHandCodec(spoken, Side.LEFT)


@each("spoken", [d for m in BUILT_IN for d in m.dialects if not d.commands_both])
def test_the_wire_of_every_dialect(spoken: Dialect) -> None:
    profile = model(spoken.model)
    spec = profile.spec(Side.LEFT, io_rate=100.0)
    n = spec.n_joints
    wire, service = ExternalHandCodec(spoken, Side.LEFT), dialect_map(spoken, {Side.LEFT: spec})
    q = spec.q_min + 0.4 * (spec.q_max - spec.q_min)
    kp, kd = np.array(profile.gains).T
    dq = 0.2 * np.array([j.dq_max for j in spec.joints])
    command = replace(HandCommand.position(q, dq=dq, kp=kp, kd=kd), tau=np.zeros(n))
    sent = message_type(spoken.cmd_type).decode(wire.encode(command, q))
    got = service.command(sent, Side.LEFT)
    assert got is not None
    np.testing.assert_allclose(got.q, q, atol=1e-5, err_msg=spoken.name)
    if spoken.gains_are_used:
        np.testing.assert_allclose(got.kp, kp, rtol=1e-5)
    if "dq" in spoken.command_fields:
        np.testing.assert_allclose(got.dq, dq, rtol=1e-5)
    braked = message_type(spoken.cmd_type).decode(wire.encode(HandCommand.brake(n), q))
    stay = service.command(braked, Side.LEFT)
    assert stay is not None
    np.testing.assert_allclose(stay.q, q, atol=1e-5, err_msg="a brake moves nothing")
    # of the state itself: tactile areas have a topic of their own
    pressure = np.full((len(profile.sensors), 12), math.nan)
    for row, sensor in zip(pressure, profile.sensors, strict=True):
        row[list(sensor.slots)] = 1500.0
    state = HandState.from_values(
        q,
        stamp=3.0,
        dq=dq,
        tau_est=0.1,
        temperature=40.0,
        mode=JointMode.FOC,
        fault=[int(MotorError.OVERCURRENT)] + [0] * (n - 1),
        pressure=pressure if profile.sensors else None,
    )
    view = StateView(state, tuple(state.fault.tolist()))
    back = wire.decode(service.encode({Side.LEFT: view}), 3.0)
    assert back is not None
    np.testing.assert_allclose(back.q, q, atol=1e-5, err_msg=spoken.name)
    if message_type(spoken.state_type).motor_place("dq", 0):
        np.testing.assert_allclose(back.dq, dq, rtol=1e-5)
    np.testing.assert_allclose(back.tau_est, 0.1, rtol=1e-5)
    np.testing.assert_allclose(back.temperature, 40.0)
    assert back.fault.tolist() == state.fault.tolist()
    if profile.sensors:
        np.testing.assert_allclose(np.asarray(back.pressure), pressure)


# ------------------------------------------------------------------------------------- as a user


LEFT = ["--side", "left"]


@each(
    "arguments, text",
    [
        (LEFT, "name one hand"),
        (["sim-dex1", "--external", *LEFT], "name one hand"),
        (["sim-dex1"], "--side"),
        (["--external", *LEFT], "--external needs --dialect"),
        (["sim-dex1", *LEFT, "--dialect", "unitree_go"], "without DDS"),
        (["--external", *LEFT, "--dialect", "dex3", "--device", "x"], "for a backend"),
        (["sim-dex1", *LEFT, "--joint", "thumb"], "no joint 'thumb'"),
        (["sim-dex3", *LEFT], "there is no terminal"),
        (["sim-dex1", *LEFT, "--fraction", "2"], "--fraction"),
        (["ezgripper", *LEFT, "--device", "/dev/ttyUSB0"], "whether the hand is free"),
        (["--external", *LEFT, "--dialect", "unitree_go"], "whether the hand is free"),
        (["sim-dex1", *LEFT, "--set", "guesses=accept"], "no setting 'guesses'"),
    ],
)
def test_wrong_usage_is_refused_before_anything_moves(arguments: list[str], text: str) -> None:
    found = CliRunner().invoke(cli, ["selftest", *arguments])
    assert found.exit_code != 0
    assert text in found.output + str(getattr(found.exception, "message", found.exception))


@pytest.mark.soak
@pytest.mark.parametrize("name", list(HANDS))
def test_every_emulated_hand_is_good_and_independent_of_load(name: str) -> None:
    result = result_of(examined(name)[0], {})
    assert result.verdict is Verdict.GOOD, findings(result)
    for seed in range(3):
        check_load(name, seed, joints=[0])

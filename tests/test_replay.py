"""Sessions are checked, cured and played on hands with care: ``dexkit replay``, without DDS."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.cli import cli
from dexkit.command_age import PAUSE, SETTLE
from dexkit.conformance.virtual.rehearsal import rehearse
from dexkit.errors import SessionError, UsageError
from dexkit.hand import MotorError, Side
from dexkit.messages import message_type
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_, MotorState_, MotorStates_
from dexkit.messages.unitree_hg import HandCmd_, HandState_
from dexkit.messages.unitree_hg import MotorCmd_ as HgCmd
from dexkit.messages.unitree_hg import MotorState_ as HgState
from dexkit.models import DEX3_1, ModeByte, dialect
from dexkit.models import model as model_by_name
from dexkit.teleop.client import JointCommand
from dexkit.traces import open_trace, sample_path
from dexkit.traces.replay import prepare as preparation
from dexkit.traces.replay.commands import (
    HandCommands,
    RecordedCommands,
    read_session,
    read_trace,
)
from dexkit.traces.replay.machine import HOLD, End, Guards, Phase, ReplayMachine
from dexkit.traces.replay.prepare import (
    Finding,
    Level,
    Plan,
    Prepared,
    ReplayOptions,
    Track,
    prepare,
)
from dexkit.traces.replay.states import DecodedHand, HandStateCodec
from dexkit.traces.sessions.finger_order import Order, finger_orders
from tests.each import each
from tests.session_helpers import dexkit, document, episode, hand_waves, whole
from tests.test_sessions_import import NAMES, dataset
from tests.trace_helpers import CMD, CMD_TYPE, STATE, STATE_TYPE, T0, Row, mcap_bytes, write

LEFT, RIGHT = Side.LEFT, Side.RIGHT
GO, DEX3 = dialect("unitree_go"), dialect("dex3")
HAND_CMD, HAND_STATE = DEX3.cmd_type, DEX3.state_type
DEX3_LEFT, DEX3_STATE = DEX3.topics(LEFT)


# -- small sessions


def gripper(
    q: Any, *, hz: float = 200.0, kp: float = 5.0, sent: Any = None, topic: str = CMD
) -> list[Row]:
    """Commands to a gripper at a rate; ``sent`` are the source timestamps, ns."""
    kind = message_type(CMD_TYPE)
    return [
        (
            topic,
            T0 + round(i * 1e9 / hz),
            T0 + round(i * 1e9 / hz) if sent is None else int(sent[i]),
            kind.encode(MotorCmds_([MotorCmd_(q=float(x), kp=kp, kd=0.05)])),
        )
        for i, x in enumerate(q)
    ]


def fingers(
    q: np.ndarray, *, hz: float = 100.0, kp: float = 1.5, mode: int | None = None,
    topic: str = DEX3_LEFT,
) -> list[Row]:  # fmt: skip
    """Commands to a hand of several joints."""
    kind = message_type(HAND_CMD)
    rows = []
    for i, pose in enumerate(q.tolist()):
        motors = [
            HgCmd(mode=0x10 | j if mode is None else mode, q=x, kp=kp, kd=0.2)
            for j, x in enumerate(pose)
        ]
        at = T0 + round(i * 1e9 / hz)
        rows.append((topic, at, at, kind.encode(HandCmd_(motors))))
    return rows


def session(tmp_path: Path, rows: list[Row], **settings: Any) -> RecordedCommands:
    types = {CMD: CMD_TYPE, STATE: STATE_TYPE, "rt/dex1/right/cmd": CMD_TYPE}
    types |= {DEX3.topics(s)[0]: HAND_CMD for s in Side} | {DEX3_STATE: HAND_STATE}
    used = {row[0] for row in rows}
    data = mcap_bytes(rows, types={t: k for t, k in types.items() if t in used}, **settings)
    path = write(tmp_path / "session.mcap", data)
    return read_trace(open_trace(path), path.name)


def slow_wave(n: int = 400) -> np.ndarray:
    return 2.7 + 1.5 * np.sin(np.arange(n) / 60)


def named(found: Prepared) -> dict[str, Finding]:
    return {f.name: f for f in found.findings}


def levels(found: Prepared) -> dict[str, str]:
    return {f.name: str(f.level) for f in found.findings}


# -- findings and cures


def test_genuine_sessions_are_found_fit_to_be_played() -> None:
    for name in ("dex1_pick_place", "dex1_legacy_v1_1", "dex3_pinch"):
        found = prepare(read_session(sample_path(name)))
        assert found.findings == []
        assert found.plan is not None
        assert found.plan.sides == (LEFT, RIGHT)


def test_a_session_without_force_is_refused_and_never_given_any(tmp_path: Path) -> None:
    """No motion (unitree_lerobot 79): without gains, or with motors locked by their mode."""
    waves = hand_waves("dex3-1", LEFT, 300, 0.0)
    for name, rows in (
        ("zero-gains", gripper(slow_wave(), kp=0.0)),
        ("locked", fingers(waves, mode=0)),
    ):
        (tmp_path / name).mkdir()
        idle = session(tmp_path / name, rows)
        found = prepare(idle)
        assert levels(found) == {name: "refused"}
        assert "no motion" in found.findings[0].text
        assert found.cures == []
        assert found.findings[0].advice.startswith(f"--accept {name}")
        for options in (ReplayOptions(accept=[name]), ReplayOptions(gains="model")):
            plan = prepare(idle, options).plan
            assert plan is not None
            assert not plan.tracks[LEFT].follows.any()
            assert max(f.moved for f in rehearse(plan).figures()[LEFT]) < 0.1


def test_a_hand_that_moved_without_force_commanded_is_played_by_its_states(tmp_path: Path) -> None:
    kind = message_type(STATE_TYPE)
    q = slow_wave()
    states = [
        (STATE, T0 + i * 5_000_000, 0, kind.encode(MotorStates_([MotorState_(q=float(x))])))
        for i, x in enumerate(q)
    ]
    taught = session(tmp_path, sorted(gripper(q, kp=0.0) + states, key=lambda row: row[1]))
    found = prepare(taught)
    assert levels(found) == {"zero-gains": "refused"}
    assert found.cures == ["--set play=states"]
    played = prepare(taught, ReplayOptions(states=True))
    assert not played.refused
    assert played.plan is not None
    assert played.plan.tracks[LEFT].q[:, 0] == pytest.approx(q, abs=1e-6)


def test_a_stop_at_the_end_is_played_as_a_stop(tmp_path: Path) -> None:
    """Clients end with kp = kd = 0 and q = 0: nothing may drive the hand there."""
    end = T0 + 400 * 5_000_000
    stop = [(topic, end + i * 5_000_000, end + i * 5_000_000, data)
            for i, (topic, _, _, data) in enumerate(gripper([0.0] * 5, kp=0.0))]  # fmt: skip
    stopped = session(tmp_path, gripper(slow_wave()) + stop)
    found = prepare(stopped)
    assert levels(found) == {"stop": "note"}
    for options in (
        ReplayOptions(),
        ReplayOptions(gains="model", jumps="stretch", limit="clamp", invalid="drop"),
        ReplayOptions(resample=1000.0),
        ReplayOptions(dialect="unitree_hg"),
    ):
        plan = prepare(stopped, options).plan
        assert plan is not None
        track = plan.tracks[LEFT]
        scale = plan.dialect.q_open / 5.4
        assert track.q.min() >= slow_wave().min() * scale - 1e-6, options
        assert track.kp[-1] == 0
        assert track.q[-1, 0] == pytest.approx(slow_wave()[-1] * scale, abs=1e-6)


def test_session_with_high_gains_and_thin_rate_is_refused_and_corrected(tmp_path: Path) -> None:
    """Loud motors (unitree_lerobot 79): steps of a thin rate, made strong by high gains."""
    waves = hand_waves("dex3-1", LEFT, 90, 0.0)
    loud = session(tmp_path, fingers(waves, hz=30.0, kp=20.0))
    found = prepare(loud)
    assert levels(found) == {"high-gains": "refused", "thin-rate": "refused"}
    assert found.cures == ["--set gains=model", "--set rate=100"]
    assert all("loud motors" in f.text for f in found.findings)
    half = prepare(loud, ReplayOptions(gains="model"))
    assert levels(half) == {"high-gains": "cured", "thin-rate": "refused"}
    cured = prepare(loud, ReplayOptions(gains="model", resample=100.0))
    assert not cured.refused
    assert found.plan is not None
    assert cured.plan is not None
    before, after = found.plan.tracks[LEFT], cured.plan.tracks[LEFT]
    torque = [float((np.abs(np.diff(t.q, axis=0)) * t.kp[1:]).max()) for t in (before, after)]
    assert torque[1] < torque[0] / 30
    ripple = [rehearse(p).figures()[LEFT] for p in (found.plan, cured.plan)]
    assert max(f.ripple for f in ripple[0]) > 10 * max(f.ripple for f in ripple[1])
    # on a straight line between the frames, and with both ends
    at = np.array([np.interp(after.t, before.t, c) for c in before.q.T]).T
    assert after.q == pytest.approx(at, abs=1e-6)
    assert (after.t[0], after.t[-1]) == (before.t[0], before.t[-1])


def test_faster_than_recorded_is_refused_unless_it_is_accepted(tmp_path: Path) -> None:
    calm = session(tmp_path, gripper(slow_wave()))
    assert levels(prepare(calm, ReplayOptions(pace=2.0))) == {"pace": "refused"}
    assert levels(prepare(calm, ReplayOptions(pace=2.0, accept=["pace"]))) == {"pace": "accepted"}


def test_positions_outside_the_limits_are_refused_or_clamped(tmp_path: Path) -> None:
    wide = session(tmp_path, gripper(2.7 + 3.2 * np.sin(np.arange(800) / 150)))
    found = prepare(wide)
    assert levels(found) == {"limits": "refused"}
    assert "gripper" in found.findings[0].text
    assert "limits 0 to 5.4" in found.findings[0].text
    plan = prepare(wide, ReplayOptions(limit="clamp")).plan
    assert plan is not None
    q = plan.tracks[LEFT].q
    assert (q.min(), q.max()) == (0.0, 5.4)


def test_postures_of_real_hands_beyond_the_limits_are_played(tmp_path: Path) -> None:
    """Real Dex3-1 rest up to 0.085 rad beyond them (docs/sources/real-hands.md)."""
    beyond = np.array([0.0, 0.5, -0.085, -1.647, -1.827, -1.647, -1.827])
    poses = np.linspace(beyond, hand_waves("dex3-1", LEFT, 1, 0.0)[0], 200)
    kind = message_type(HAND_STATE)
    rows = [
        (DEX3_STATE, T0 + i * 10_000_000, 0, kind.encode(HandState_([HgState(q=x) for x in q])))
        for i, q in enumerate(poses.tolist())
    ]
    commands = fingers(poses)
    both = session(tmp_path, sorted(rows + commands, key=lambda row: row[1]))
    for options in (ReplayOptions(), ReplayOptions(states=True)):
        found = prepare(both, options)
        assert not found.refused
        assert found.plan is not None
        limits = preparation.joint_limits(DEX3, LEFT)
        q = found.plan.tracks[LEFT].q
        assert ((limits.low <= q) & (q <= limits.high)).all()
    far = prepare(session(tmp_path, fingers(poses - 0.2)))
    assert "limits" in {f.name for f in far.refused}


def test_motion_tells_whether_the_fingers_of_a_session_are_exchanged(tmp_path: Path) -> None:
    """Public programs of real Dex3-1 disagree about middle and index of the right hand."""
    waves = np.array(hand_waves("dex3-1", LEFT, 300, 0.0))
    waves[:, 3:5] = -0.1  # only the last finger moves
    kind = message_type(HAND_STATE)
    alike = np.full(waves.shape, -0.1)
    for name, seen, asked, order in (
        ("same", waves, waves, Order.SAME),
        ("exchanged", waves[:, [0, 1, 2, 5, 6, 3, 4]], waves, Order.EXCHANGED),
        ("alike", alike, alike, Order.UNKNOWN),
    ):
        rows = [
            (DEX3_STATE, T0 + i * 10_000_000, 0, kind.encode(HandState_([HgState(q=x) for x in q])))
            for i, q in enumerate(seen.tolist())
        ]
        (tmp_path / name).mkdir()
        both = session(tmp_path / name, sorted(rows + fingers(asked), key=lambda row: row[1]))
        (found,) = finger_orders(open_trace(tmp_path / name / "session.mcap")).values()
        assert found.order is order, (name, found.text)
        assert ("order" in levels(prepare(both))) is (order is Order.EXCHANGED)
        _, said = dexkit("info", tmp_path / name / "session.mcap")
        assert "order of the fingers, left hand: " in said
        if order is not Order.EXCHANGED:
            assert "cannot" in said  # which finger is which, it never says


def test_steps_of_position_servos_are_no_jumps(tmp_path: Path) -> None:
    """FTP, DFX and Revo2 go to a goal at their own speed."""
    for name in ("inspire-dfx", "inspire-ftp", "brainco-revo2"):
        hand = model_by_name(name)
        q = np.where(np.arange(60)[:, None] < 30, 0.1, 0.9) * np.ones(6)
        commands = preparation._from_states(np.arange(60) / 30, q, hand)
        servo = RecordedCommands("t", "recording", hand.dialects[0], {LEFT: commands}, {})
        assert prepare(servo).findings == [], name


def test_jumps_are_refused_or_given_time(tmp_path: Path) -> None:
    q = np.where(np.arange(400) < 200, 0.5, 5.0)
    jumping = session(tmp_path, gripper(q))
    found = prepare(jumping)
    assert levels(found) == {"jumps": "refused"}
    assert "1 place" in found.findings[0].text
    plan = prepare(jumping, ReplayOptions(jumps="stretch")).plan
    assert plan is not None
    track = plan.tracks[LEFT]
    assert plan.duration == pytest.approx(399 / 200 - 0.005 + 4.5 / 24.0, abs=1e-3)
    assert _fastest(track) <= 24.0 * (1 + 1e-6)
    assert np.diff(track.q[:, 0]).max() < 0.2


def _fastest(track: Track) -> float:
    return float((np.abs(np.diff(track.q, axis=0)) / np.diff(track.t)[:, None]).max())


def test_the_pose_is_held_in_pauses(tmp_path: Path) -> None:
    rows = gripper(slow_wave())
    moved = [(t, log + (3_000_000_000 if i >= 200 else 0), 0, d) for i, (t, log, _, d) in
             enumerate(rows)]  # fmt: skip
    paused = session(tmp_path, moved)
    found = prepare(paused, ReplayOptions(resample=200.0))
    assert levels(found) == {"gaps": "note"}
    assert found.plan is not None
    track = found.plan.tracks[LEFT]
    held = (track.t > 1.0) & (track.t < 3.9)
    assert np.ptp(track.q[held]) < 1e-6
    shorter = prepare(paused, ReplayOptions(max_gap=0.5)).plan
    assert shorter is not None
    assert shorter.duration == pytest.approx(399 / 200 - 0.005 + 0.5, abs=1e-3)


def test_a_session_of_the_other_hand_is_recognised(tmp_path: Path) -> None:
    """A mirrored hand: what closes one is out of reach of the other."""
    wrong = session(tmp_path, fingers(hand_waves("dex3-1", RIGHT, 300, 0.0)))
    found = prepare(wrong)
    assert named(found)["side"].level is Level.REFUSED
    assert levels(found) == {"side": "refused"}
    assert found.cures == ["--set swap-sides=yes"]
    again = prepare(wrong, ReplayOptions(accept=["side"], swap_sides=False))
    assert levels(again) == {"side": "accepted"}
    swapped = prepare(wrong, ReplayOptions(swap_sides=True))
    assert not swapped.refused
    assert swapped.plan is not None
    assert swapped.plan.sides == (RIGHT,)


def test_unsendable_commands_are_refused_or_left_out(tmp_path: Path) -> None:
    q = slow_wave()
    good = gripper(q)
    nan = list(good)
    nan[7] = gripper(np.where(np.arange(8) == 7, np.nan, 2.7))[7]
    late = [(t, log, sent - (400_000_000 if 100 <= i < 110 else 0), d)
            for i, (t, log, sent, d) in enumerate(good)]  # fmt: skip
    back = [(t, log, sent - (6_000_000 if i == 50 else 0), d)
            for i, (t, log, sent, d) in enumerate(good)]  # fmt: skip
    empty = list(good)
    empty[9] = (CMD, good[9][1], good[9][2], message_type(CMD_TYPE).encode(MotorCmds_([])))
    for name, rows, dropped in (
        ("not-finite", nan, 1),
        ("stale", late, 10),
        ("backwards", back, 1),
        ("joints", empty, 1),
    ):
        folder = tmp_path / name
        folder.mkdir()
        broken = session(folder, rows)
        found = prepare(broken)
        assert found.cures == ["--set invalid=drop"], (name, found.findings)
        assert name in levels(found)
        cured = prepare(broken, ReplayOptions(invalid="drop"))
        assert not cured.refused, name
        assert cured.plan is not None
        assert len(cured.plan.tracks[LEFT]) == len(q) - dropped, name
        assert np.isfinite(cured.plan.tracks[LEFT].q).all()


def test_commands_to_a_hand_with_other_joints_are_refused(tmp_path: Path) -> None:
    six = session(tmp_path, fingers(hand_waves("dex3-1", LEFT, 50, 0.0)[:, :6]))
    found = prepare(six)
    assert levels(found) == {"joints": "refused"}
    assert "6 motors in 50 messages, and a Dex3-1 hand has 7" in found.findings[0].text
    assert found.plan is None
    assert found.cures == []


def test_another_model_is_refused(tmp_path: Path) -> None:
    found = prepare(session(tmp_path, gripper(slow_wave())), ReplayOptions(dialect="dex3"))
    assert levels(found) == {"model": "refused"}
    assert found.plan is None


def test_a_session_of_states_is_refused_or_played(tmp_path: Path) -> None:
    kind = message_type(STATE_TYPE)
    rows = [
        (STATE, T0 + i * 5_000_000, 0, kind.encode(MotorStates_([MotorState_(q=float(x))])))
        for i, x in enumerate(slow_wave())
    ]
    states = session(tmp_path, rows)
    found = prepare(states)
    assert levels(found) == {"only-states": "refused"}
    assert found.cures == ["--set play=states"]
    played = prepare(states, ReplayOptions(states=True))
    assert not played.refused
    assert played.plan is not None
    assert played.plan.tracks[LEFT].q[:, 0] == pytest.approx(slow_wave(), abs=1e-6)
    assert played.plan.tracks[LEFT].kp == pytest.approx(5.0)


def test_sessions_without_a_hand_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="no commands to a hand"):
        prepare(session(tmp_path, []))
    inspire = episode(tmp_path / "e", whole(document(20, 6)))
    with pytest.raises(SessionError, match=r"left_hand \(6 joints\)"):
        prepare(read_session(inspire))
    left = session(tmp_path, gripper(slow_wave()))
    with pytest.raises(UsageError, match="nothing to play on the right hand"):
        prepare(left, ReplayOptions(sides=(RIGHT,)))


# -- what the cures do

SHORT = {"dex1-1": GO, "dex3-1": DEX3}
OPTIONS: dict[str, dict[str, Any]] = {
    "--set gains=model": {"gains": "model"},
    "--set jumps=stretch": {"jumps": "stretch"},
    "--set limit=clamp": {"limit": "clamp"},
    "--set invalid=drop": {"invalid": "drop"},
    "--set play=states": {"states": True},
    "--set swap-sides=yes": {"swap_sides": True},
    **{f"--set rate={hz}": {"resample": float(hz)} for hz in (100, 200)},
}
"""What an option that a finding prints stands for."""
KINDS = ("drive", "limp", "locked", "loud", "weak", "damped")


def recorded_phases(
    name: str, phases: list[tuple[str, int, float]], cut: tuple[int, int], period: float
) -> tuple[RecordedCommands, np.ndarray]:
    """A session whose first joint is commanded in phases, cut; and where its joints were.

    The hand that was recorded follows at once what has force, and stays otherwise.
    """
    hand, spoken = model_by_name(name), SHORT[name]
    pose = np.array(hand.rest_q[LEFT])
    joint = hand.joints[LEFT][-1]
    kinds = np.array([k for k, n, _ in phases for _ in range(n)])
    q = np.tile(pose, (len(kinds), 1))
    goals = np.concatenate([np.full(n, goal) for _, n, goal in phases])
    q[:, -1] = joint.q_min + joint.stroke * goals
    table = preparation._from_states(np.arange(len(q)) * period, q, hand)
    kp, kd, driven = np.array(table.kp), np.array(table.kd), np.array(table.driven)
    kp[np.isin(kinds, ["limp", "damped"]), -1] = 0.0
    kd[kinds == "limp", -1] = 0.0
    kp[kinds == "loud", -1] *= 10
    kp[kinds == "weak", -1] *= 0.01
    driven[kinds == "locked", -1] = spoken.mode_byte is ModeByte.UNUSED
    states = np.array(q)
    follows = driven & (kp > 0)
    for i in range(len(q)):
        states[i] = np.where(follows[i], q[i], states[i - 1] if i else pose)
    tables = {**vars(table), "kp": kp, "kd": kd, "driven": driven}
    kept = slice(*cut)
    commands = {LEFT: HandCommands(**{n: t[kept] for n, t in tables.items()})}
    seen = {LEFT: (table.t[kept], states[kept])}
    return RecordedCommands("test", "recording", spoken, commands, seen), states[kept]


@given(
    name=st.sampled_from(sorted(SHORT)),
    phases=st.lists(
        st.tuples(st.sampled_from(KINDS), st.integers(1, 25), st.floats(0.0, 1.0)),
        min_size=1,
        max_size=6,
    ),
    cut=st.tuples(st.integers(0, 40), st.integers(1, 100)),
    period=st.sampled_from([0.005, 0.01, 0.05]),
)
@settings(max_examples=60, deadline=None)
def test_no_cure_makes_a_hand_do_what_the_recorded_one_did_not(
    name: str, phases: list[tuple[str, int, float]], cut: tuple[int, int], period: float
) -> None:
    total = sum(n for _, n, _ in phases)
    begin = min(cut[0], total - 1)
    session, states = recorded_phases(name, phases, (begin, begin + cut[1]), period)
    (commands,) = session.commands.values()
    chosen: dict[str, Any] = {}
    found = prepare(session)
    while found.refused and found.cures:
        for option in found.cures:
            chosen |= OPTIONS[option]
        found = prepare(session, ReplayOptions(**chosen))
        assert len(chosen) <= len(OPTIONS)
    if found.refused:  # nothing cures it: what it is accepted with moves nothing either
        found = prepare(session, ReplayOptions(**chosen, accept=[f.name for f in found.refused]))
        assert not found.refused
    assert found.plan is not None
    limits = preparation.joint_limits(found.plan.dialect, LEFT)
    low, high = states.min(axis=0) - 1e-6, states.max(axis=0) + 1e-6
    jumped = np.abs(np.diff(commands.q, axis=0)).max(axis=0, initial=0.0)
    machine = ReplayMachine(found.plan, Guards(ramp_speed=5.0))
    now, q = 100.0, states[0] + 0.0
    soft = np.maximum(0.05 * limits.stroke, 5.0 * HOLD) + 1e-6
    sent_kp = np.zeros(len(q))
    follows = np.zeros(len(q), dtype=bool)
    while machine.phase is not Phase.END:
        now = machine.wakes_at(now)
        machine.receive(now, LEFT, DecodedHand(tuple(q.tolist()), (0.0,) * len(q)))
        phase = machine.phase
        for motors in machine.step(now).values():
            for j, c in enumerate(motors):
                drives = machine._drives(c, j)
                if not drives:
                    continue
                assert low[j] <= c.q <= high[j], (phase, j, c.q)
                step = abs(c.q - q[j])
                if not follows[j]:  # from where the hand is, however it came there
                    assert step <= soft[j], (phase, j, step)
                assert step <= max(jumped[j] + 1e-6, soft[j]), (phase, j, step)
                # at the end it holds what had force, where it is
                if not chosen.get("states") and phase is not Phase.LEAVE:
                    assert c.kp <= commands.kp[:, j].max() + 1e-9
                    assert (commands.driven & (commands.kp > 0))[:, j].any()
            follows = np.array([machine._drives(c, j) for j, c in enumerate(motors)])
            q = np.where(follows, [c.q for c in motors], q)
            sent_kp = np.array([c.kp for c in motors])
    assert machine.end is End.DONE, machine.reason
    if not chosen.get("states") and not commands.kp[-1].any():
        assert not sent_kp.any()


# -- the machine


def plan_of(q: Any, hz: float = 200.0, kp: float = 5.0) -> Plan:
    table = np.array([[float(x)] for x in q])
    shape = table.shape
    track = Track(
        t=np.arange(len(table)) / hz,
        q=table,
        dq=np.zeros(shape),
        tau=np.zeros(shape),
        kp=np.full(shape, kp),
        kd=np.full(shape, 0.05),
        driven=np.ones(shape, dtype=np.bool_),
    )
    return Plan("test", GO, {LEFT: track})


class Drive:
    """Steps a machine; the hand is where it was last commanded, if it follows."""

    def __init__(self, plan: Plan, guards: Guards = Guards(), q: float = 1.0) -> None:  # noqa: B008
        self.machine = ReplayMachine(plan, guards)
        self.now, self.q = 100.0, q
        self.follows = self.answers = True
        self.seen = DecodedHand((q,), (0.0,), (0,))
        self.sent: list[tuple[float, Phase, JointCommand]] = []

    def turn(self, delay: float = 0.0) -> list[JointCommand]:
        machine = self.machine
        self.now = machine.wakes_at(self.now) + delay
        if self.answers:
            machine.receive(self.now, LEFT, DecodedHand((self.q,), (0.0,), self.seen.fault))
        phase = machine.phase
        found = [motors[0] for motors in machine.step(self.now).values()]
        for sent in found:
            self.sent.append((self.now, phase, sent))
            if self.follows and sent.kp > 0:
                self.q = sent.q
        return found

    def until(self, *phases: Phase) -> None:
        for _ in range(20_000):
            if self.machine.phase in phases:
                return
            self.turn()
        raise AssertionError(f"never {phases}")

    def in_phase(self, phase: Phase) -> Iterator[JointCommand]:
        return (c for _, p, c in self.sent if p is phase)


def test_replay_ramps_to_the_first_pose_and_ends_at_rest() -> None:
    drive = Drive(plan_of(slow_wave()), Guards(ramp_speed=0.5), q=0.5)
    drive.until(Phase.END)
    machine = drive.machine
    assert (machine.end, machine.progress.passes) == (End.DONE, 1)
    ramp = [c.q for c in drive.in_phase(Phase.RAMP)]
    assert ramp[0] == pytest.approx(0.5, abs=0.01)
    assert ramp[-1] == pytest.approx(2.7)
    assert max(np.abs(np.diff(ramp))) <= 0.5 * HOLD + 1e-9
    times = [t for t, p, _ in drive.sent if p is Phase.RAMP]
    assert times[-1] - times[0] == pytest.approx(2.2 / 0.5 + 0.3, abs=0.02)
    played = list(dict.fromkeys(c.q for c in drive.in_phase(Phase.PLAY)))
    assert played == list(dict.fromkeys(slow_wave().tolist()))
    parting = list(drive.in_phase(Phase.LEAVE))
    assert {c.q for c in parting} == {drive.q}
    assert (parting[0].kp, parting[0].mode) == (5.0, 0)


def test_fingers_are_locked_at_the_end() -> None:
    q = np.repeat([DEX3_1.rest_q[LEFT]], 20, axis=0)
    shape = q.shape
    track = Track(np.arange(20) / 100, q, np.zeros(shape), np.zeros(shape), np.full(shape, 1.5),
                  np.full(shape, 0.2), np.ones(shape, dtype=np.bool_))  # fmt: skip
    machine = ReplayMachine(Plan("test", DEX3, {LEFT: track}))
    now, modes = 0.0, []
    while machine.phase is not Phase.END:
        now = machine.wakes_at(now)
        machine.receive(now, LEFT, DecodedHand(DEX3_1.rest_q[LEFT], (0.0,) * 7, (0,) * 7))
        phase = machine.phase
        modes += [(phase, [m.mode for m in x]) for x in machine.step(now).values()]
    assert (Phase.PLAY, [0x10 | i for i in range(7)]) in modes
    assert modes[-1] == (Phase.LEAVE, list(range(7)))


def test_nothing_is_sent_before_a_state_and_none_that_is_no_state() -> None:
    machine = ReplayMachine(plan_of(slow_wave()))
    assert machine.step(0.0) == {}
    machine.receive(0.1, LEFT, DecodedHand((math.nan,), (0.0,)))
    assert (machine.step(0.1), machine.missing) == ({}, (LEFT,))
    fingers_machine = ReplayMachine(
        Plan("test", DEX3, {LEFT: Track(*(np.zeros((1, 7)) for _ in range(7)))})  # type: ignore[arg-type]
    )
    fingers_machine.receive(0.0, LEFT, DecodedHand((0.0,) * 7, (0.0,) * 7))
    assert fingers_machine.missing == (LEFT,)  # clients take all 0 for no state
    machine.stop(End.ASKED, "stopped")
    assert machine.phase is Phase.END


def test_fault_silence_or_distance_stops_the_replay() -> None:
    def fault(drive: Drive) -> None:
        drive.seen = DecodedHand((drive.q,), (0.0,), (int(MotorError.OVERCURRENT),))

    def silence(drive: Drive) -> None:
        drive.answers = False

    def stuck(drive: Drive) -> None:
        drive.follows = False

    for hurt, end, text, within in (
        (fault, End.FAULT, "gripper reports overcurrent", 0.02),
        (silence, End.SILENT, "no state for 0.2", PAUSE + 0.03),
        (stuck, End.DISTANCE, "more than 0.30 rad from its command", 2.5),
    ):
        drive = Drive(plan_of(2.7 + 2 * np.sin(np.arange(2000) / 100)), Guards(max_distance=0.3))
        drive.until(Phase.PLAY)
        for _ in range(20):
            drive.turn()
        begin = drive.now
        hurt(drive)
        drive.until(Phase.LEAVE)
        assert drive.machine.end is end
        assert text in drive.machine.reason, drive.machine.reason
        assert drive.now - begin < within
        drive.until(Phase.END)
        last = drive.sent[-1]
        assert last[1] is Phase.LEAVE
        # of a hand that is silent the pose is not known: no command draws it anywhere
        assert last[2].kp == (0.0 if end is End.SILENT else 5.0)
        if end is not End.SILENT:
            assert last[2].q == drive.q


def test_a_hand_with_a_fault_is_not_moved_at_all() -> None:
    drive = Drive(plan_of(slow_wave()))
    drive.seen = DecodedHand((1.0,), (0.0,), (int(MotorError.MOS_TEMPERATURE),))
    drive.until(Phase.END)
    assert drive.sent == []
    assert drive.machine.end is End.FAULT


@settings(max_examples=20, deadline=None)
@given(
    delays=st.lists(
        st.sampled_from([0.0, 0.0, 0.0, 0.001, 0.03, 0.2, 0.24, 0.6, 5.0]), min_size=5, max_size=80
    ),
    q=st.floats(0.0, 5.4),
)
def test_pause_of_the_program_causes_no_jump_of_commands(delays: list[float], q: float) -> None:
    """Whatever holds the program up: commands follow each other as in the session or the ramp.

    After a pause the first command is where the hand is now, and no state from before counts.
    """
    wave = slow_wave(100)
    drive = Drive(plan_of(wave), Guards(ramp_speed=0.5, max_distance=10.0), q=q)
    step = max(0.5 * HOLD, float(np.abs(np.diff(wave)).max()) * HOLD * 200)
    before: float | None = None
    at = drive.now
    for i in range(2000):
        if drive.machine.phase is Phase.END:
            break
        delay = delays[i % len(delays)]
        if delay > PAUSE:
            drive.q += 0.5 if drive.q < 3 else -0.5  # the hand is moved meanwhile
        sent = drive.turn(delay)
        if drive.now - at > PAUSE:
            assert sent == []  # made before the pause
            paused = drive.now
            before = None
        at = drive.now
        for motor in sent:
            if before is None and drive.sent[:-1]:
                assert drive.now >= paused + SETTLE - 1e-9 or drive.machine.phase is Phase.LEAVE
            if before is not None and drive.sent[-1][1] is not Phase.LEAVE:
                assert abs(motor.q - before) <= step + 1e-9
            before = motor.q
    else:
        assert any(d > HOLD for d in delays)  # it may take long
    played = list(dict.fromkeys(c.q for c in drive.in_phase(Phase.PLAY)))
    positions = {x: i for i, x in enumerate(wave.tolist())}
    order = [positions[x] for x in played]
    assert order == sorted(order)
    assert all(b - a <= HOLD * 200 + 1 for a, b in itertools.pairwise(order))


def test_a_loop_ramps_back_to_the_first_pose() -> None:
    drive = Drive(plan_of(np.linspace(1.0, 4.0, 200)), Guards(loop=True, max_distance=9.0))
    while drive.machine.progress.passes < 2:
        drive.turn()
    assert max(np.abs(np.diff([c.q for _, _, c in drive.sent]))) < 0.5 * HOLD + 0.31
    drive.machine.stop(End.ASKED, "stopped")
    drive.until(Phase.END)
    assert drive.sent[-1][1] is Phase.LEAVE


def test_states_of_each_dialect_are_read() -> None:
    wire = HandStateCodec(DEX3)
    motors = [HgState(mode=0x10 | i, q=0.1 * i, tau_est=0.2) for i in range(7)]
    motors[2].motorstate = int(MotorError.WINDING_OVERTEMPERATURE)
    motors[4].mode |= 0x80
    data = message_type(HAND_STATE).encode(HandState_(motors))
    seen = wire.seen(DEX3_STATE, data)[LEFT]
    names = [j.name for j in DEX3_1.joints[LEFT]]
    assert seen.q[1] == pytest.approx(0.1)
    assert seen.problem(names) == "thumb_2 reports winding_overtemperature"
    assert (
        DecodedHand(seen.q, seen.tau, (), seen.tripped).problem(names).endswith("stopped middle_1")
    )
    short = message_type(HAND_STATE).encode(HandState_(motors[:6]))
    assert wire.seen(DEX3_STATE, short) == {}
    actuator = HandStateCodec(dialect("unitree_actuator"))
    both = MotorStates_([MotorState_(q=1.0), MotorState_(q=2.0, reserve=(4, 0))])
    found = actuator.seen("rt/unitree_actuator/state", message_type(STATE_TYPE).encode(both))
    assert (found[RIGHT].q, found[LEFT].q) == ((1.0,), (2.0,))
    assert found[LEFT].problem(["gripper"]) == "gripper reports overvoltage"


# -- the command


def test_every_source_that_import_knows_is_replayed(tmp_path: Path) -> None:
    """An episode, JSON lines, LeRobot, a bag, tables, and a recording of it."""
    made = episode(tmp_path / "episode_0001", whole(document(40, "dex3-1")))
    recording = tmp_path / "imported.mcap"
    assert dexkit("import", made, recording)[0] in (0, 1)
    lines = tmp_path / "lines.jsonl"
    items = document(40, "dex3-1")["data"]
    lines.write_text("".join(json.dumps(x | {"timestamp_ns": T0 + i * 33_333_333}) + "\n"
                             for i, x in enumerate(items)))  # fmt: skip
    matrix = np.concatenate(
        [np.zeros((40, 14)), *(hand_waves("dex3-1", s, 40, 1.0 * i) for i, s in enumerate(Side))],
        axis=1,
    )
    lerobot = dataset(tmp_path / "lerobot", "v2.1", NAMES, matrix)
    for form in ("rosbag2", "parquet"):
        assert dexkit("export", recording, "--to", form, "--out", tmp_path / form)[0] in (0, 1)
    for source, more in (
        (made, ()),
        (tmp_path / "episode_0001" / "data.json", ()),
        (lines, ()),
        (lerobot, ()),
        (tmp_path / "rosbag2", ()),
        (tmp_path / "parquet", ()),
        (recording, ()),
    ):
        code, output = dexkit("rehearse", source, *more, "--check")
        assert code == 1, output
        assert "thin-rate" in output
        assert "--set rate=100" in output
        code, output = dexkit("rehearse", source, *more, "--check", "--set", "rate=100")
        assert code == 0, output
        assert "Dex3-1 hand, left, right (dex3)" in output
    page = tmp_path / "page.html"
    cured = ("--set", "rate=100", "--set", "ramp-speed=2", "--report", page)
    code, output = dexkit("rehearse", made, *cured)
    assert code == 0, output
    assert "played to the end" in output
    text = page.read_text()
    assert "It can be played" in text
    assert "left thumb_1: command and emulated position" in text
    assert "http" not in text.replace("http-equiv", "")


def test_a_refused_session_is_rehearsed_nevertheless(tmp_path: Path) -> None:
    session(tmp_path, gripper(slow_wave(), kp=0.0))
    page = tmp_path / "page.html"
    code, output = dexkit("rehearse", tmp_path / "session.mcap", "--report", page)
    assert code == 1
    assert "refused: zero-gains" in output
    assert "--accept zero-gains" in output
    assert "cured by" not in output
    assert "It is refused" in page.read_text()
    told = CliRunner().invoke(cli, ["rehearse", str(tmp_path / "session.mcap"), "--json"])
    found = json.loads(told.stdout)
    assert [f["name"] for f in found["findings"] if f["level"] == "refused"] == ["zero-gains"]
    assert found["refused"]
    assert {joint["side"] for joint in found["joints"]} <= {"left", "right"}


def test_options_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    session(tmp_path, gripper(slow_wave()))
    source = tmp_path / "session.mcap"
    for arguments, text in (
        ((source, "--check", "--report", tmp_path / "x.html"), "leave out --check"),
        ((source, "--set", "gains=own"), "gains=own"),
        ((source, "--set", "gain=model"), "no setting 'gain'"),
        ((source, "--set", "rate=100", "--set", "rate=200"), "rate is given twice"),
        ((source, "--check", "--side", "right"), "nothing to play on the right hand"),
        ((tmp_path, "--check"), "holds no session"),
        ((source, "--report", source), "is also an"),
    ):
        code, output = dexkit("rehearse", *arguments)
        assert (code, text in output) == (2, True), output


def test_several_sessions_need_a_choice(tmp_path: Path) -> None:
    for i in range(2):
        episode(tmp_path / "task" / f"episode_000{i}", whole(document(20, "dex3-1")))
    code, output = dexkit("rehearse", tmp_path / "task", "--check")
    assert (code, "dexkit import" in output) == (2, True)
    code, output = dexkit("rehearse", tmp_path / "task" / "episode_0001", "--check")
    assert (code, "thin-rate" in output) == (1, True)


@each("name", ["dex1-1", "dex3-1", "dex5-1"])
def test_every_model_is_rehearsed(name: str) -> None:
    """The rehearsal drives the reference of each model through a ramp and a session."""
    hand = model_by_name(name)
    spoken = hand.dialects[0]
    q = np.array([hand.rest_q[LEFT]]).repeat(30, axis=0) * np.linspace(1.0, 0.6, 30)[:, None]
    commands = preparation._from_states(np.arange(30) / hand.command_rate, q, hand)
    found = prepare(RecordedCommands("test", "recording", spoken, {LEFT: commands}, {}))
    assert not found.refused, found.findings
    assert found.plan is not None
    done = rehearse(found.plan)
    assert done.machine.end is End.DONE
    last = done.hands[LEFT].q[-1]
    assert last == pytest.approx(q[-1], abs=0.25)
    assert [p for p, _, _ in done.phases] == list(Phase)

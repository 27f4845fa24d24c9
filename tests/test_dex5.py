"""Test the Dex5-1: joints, dialect, simulated hand, client and synthetic session.

``python -m tests.test_dex5`` writes the session and its labels to traces/samples again.
"""

from __future__ import annotations

import json
import math
import re
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.clock import ManualClock
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.results import Overall, Verdict
from dexkit.emulators.sim_dex5 import SimDex5
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, HandState, Side
from dexkit.messages import message_type, unitree_hg
from dexkit.models import DEX5_1, dialect
from dexkit.service.dialects import DialectMap, Fill, StateView, dialect_map
from dexkit.teleop import Operator, client_for, profile
from dexkit.teleop.client_codec import ClientCodec
from dexkit.traces import Recorder, open_trace, sample_path, samples

ROOT = Path(__file__).parent.parent
DEX5 = dialect("dex5")
STATES, COMMANDS = message_type(DEX5.state_type), message_type(DEX5.cmd_type)
LEFT, RIGHT = Side.LEFT, Side.RIGHT
N, THUMB = 20, slice(16, 20)
KP, KD = np.array(DEX5_1.gains).T

EPOCH_NS = 1_795_000_000_000_000_000
PROFILE = "sine"
MOST = {Side.RIGHT: 0.6}  # of the profile: clear of where the conformance kit puts an object
STATE_NS = 2_000_000
CLIENT_STEPS = 5  # of the state's period
CLIENT_STARTS = 0.5  # seconds after the hands


# --------------------------------------------------------------------------------------- the model


def test_joints_match_urdf_in_client_order() -> None:
    names = [j.name for j in DEX5_1.joints[LEFT]]
    fingers = [f"{'Roll' if i == 1 else 'Pitch'}_{f}{i}" for f in (2, 3, 4, 5) for i in range(1, 5)]
    assert names == [*fingers, "Yaw_11", "Roll_12", "Pitch_13", "Pitch_14"]
    assert [j.name for j in DEX5_1.joints[RIGHT]] == names
    assert [j.urdf for j in DEX5_1.joints[RIGHT]] == [f"{name}R" for name in names]
    odd = {j.urdf for j in DEX5_1.joints[LEFT]} - {f"{name}L" for name in names}
    assert odd == {"Link_41L"}


def test_only_the_thumbs_roll_is_mirrored() -> None:
    for left, right in zip(DEX5_1.joints[LEFT], DEX5_1.joints[RIGHT], strict=True):
        if left.name == "Roll_12":
            assert (left.q_min, left.q_max, left.closing) == (-1.8151, 0.0, -1)
            assert (right.q_min, right.q_max, right.closing) == (0.0, 1.8151, 1)
        else:
            assert (left.q_min, left.q_max, left.closing) == (
                right.q_min,
                right.q_max,
                right.closing,
            )


def test_thumb_has_other_gains_and_outer_joints_share_motors() -> None:
    assert KP.tolist() == [0.10] * 16 + [1.0] * 4
    assert KD.tolist() == [0.001] * 16 + [0.02] * 4
    assert len(DEX5_1.motors) == 16
    assert sorted(i for group in DEX5_1.motors for i in group) == list(range(N))


# --------------------------------------------------------------------------------------- dialect


def mapping(fill: Fill = Fill.KNOWN, side: Side = LEFT) -> DialectMap:
    return dialect_map(DEX5, {side: DEX5_1.spec(side, io_rate=500.0)}, fill)


def message(modes: list[int], **fields: float) -> unitree_hg.HandCmd_:
    return unitree_hg.HandCmd_([unitree_hg.MotorCmd_(mode=m, **fields) for m in modes])  # type: ignore[arg-type]


@given(st.lists(st.integers(0, 255), min_size=N, max_size=N))
def test_only_mode_1_drives(modes: list[int]) -> None:
    command = mapping().command(message(modes), LEFT)
    assert command is not None
    assert command.mode.tolist() == [int(m == 1) for m in modes]
    assert command.timeout is None  # the service's own time-out holds for all
    odd = [r.counter for r in mapping().remarks(message(modes), LEFT)]
    assert odd == (["unknown_status"] if any(m > 1 for m in modes) else [])


def test_dex3_mode_byte_is_reported() -> None:
    (remark,) = mapping().remarks(message([0x10 | i for i in range(16)] + [1] * 4), LEFT)
    assert "no RIS_Mode with ids, as a Dex3-1 has; send 1 to drive it" in remark.text


def test_seven_joints_of_a_default_message_hold_no_command() -> None:
    assert mapping().command(message([1] * 7), LEFT) is None


def test_torques_are_in_two_units() -> None:
    command = mapping().command(message([1] * N, tau=500.0, kp=0.25), LEFT)
    assert command is not None
    assert command.tau.tolist() == pytest.approx([0.5] * 16 + [500.0] * 4)
    assert command.kp.tolist() == [0.25] * N


@given(st.lists(st.floats(-0.93, 0.93), min_size=N, max_size=N), st.sampled_from(Fill))
def test_state_has_twenty_joints_and_no_unknown_members(tau: list[float], fill: Fill) -> None:
    modes = [i % 2 for i in range(N)]
    state = HandState.from_values(DEX5_1.rest_q[LEFT], tau_est=tau, mode=modes, stamp=0.0)
    data = mapping(fill).encode({LEFT: StateView(state, (0,) * N)})
    assert len(data) == 1220  # docs/sources/unitree-dex.md#a4
    sent = STATES.decode(data)
    assert [m.mode for m in sent.motor_state] == modes
    assert [m.q for m in sent.motor_state] == pytest.approx(DEX5_1.rest_q[LEFT])
    units = [1e-3] * 16 + [1.0] * 4
    found = [m.tau_est * unit for m, unit in zip(sent.motor_state, units, strict=True)]
    assert found == pytest.approx(tau, abs=1e-6)
    assert sent.press_sensor_state == []
    assert math.hypot(*sent.imu_state.quaternion) == 0.0


# --------------------------------------------------------------------------- client and recording


def test_client_sends_same_commands_as_genuine_client() -> None:
    client = client_for("dex5")
    rest = {s: DEX5_1.rest_q[s] for s in Side}
    assert client.step(0.0, {LEFT: (0.0,) * N, RIGHT: rest[RIGHT]}, {}) == {}
    assert client.missing == {LEFT: "every q is exactly 0"}
    commands = client.step(0.01, rest, dict.fromkeys(Side, (0.2,) * N))
    for motors in commands.values():
        assert {m.mode for m in motors} == {1}
        assert [(m.q, m.kp, m.kd) for m in motors] == [(0.2, kp, kd) for kp, kd in DEX5_1.gains]
    assert {m.mode for m in client.final_command(rest[LEFT])} == {0}
    with pytest.raises(UsageError, match="the client of a Dex5-1 hand is the same"):
        client_for("dex5", simulated=True)


def write(path: Path, seconds: float = 6.0) -> None:
    """The synthetic session, or the beginning of it.

    Neither a client of a Dex5-1 nor such a hand could be recorded. dexkit's model of the client, an
    operator profile and the simulated hands run on one virtual clock; no DDS takes part, so that
    there are no endpoints either.
    """
    dialect = DEX5_1.dialects[0]
    clock = ManualClock()
    hands = {s: SimDex5(s, clock=clock) for s in Side}
    maps = {s: dialect_map(dialect, {s: hand.spec}) for s, hand in hands.items()}
    client, wire = client_for(dialect), ClientCodec(dialect)
    operator = Operator(profile(PROFILE, DEX5_1.name), dialect, most=MOST)
    decode = message_type(dialect.cmd_type).decode
    commands = {s: HandCommand.brake(hand.spec.n_joints) for s, hand in hands.items()}
    about = {
        "controller_commit": "none: dexkit's model of xr_teleoperate's Dex5_1_Controller",
        "states": "dexkit's simulated hands (sim-dex5)",
        "operator": f"dexkit's profile {PROFILE!r}",
        "network": "none: one virtual clock",
    }
    with Recorder(path, overwrite=True) as recorder:
        recorder.add_metadata("provenance", about)
        for hand in hands.values():
            hand.open()
        for step in range(round(seconds * 1e9 / STATE_NS)):
            now_ns = EPOCH_NS + step * STATE_NS
            states = {}
            for s, hand in hands.items():
                state = hand.exchange(commands[s])
                states[s] = tuple(state.q.tolist())
                payload = maps[s].encode({s: StateView(state, (0,) * len(state.q))})
                recorder.put(
                    wire.state_topics[s], dialect.state_type, payload, now_ns + 200_000, now_ns
                )
            now = clock.now() - CLIENT_STARTS
            if now >= 0.0 and step % CLIENT_STEPS == 0:
                sent = client.step(now, states, operator.inputs(now, Side))
                for topic, payload in wire.encode(sent):
                    recorder.put(
                        topic, dialect.cmd_type, payload, now_ns + 500_000, now_ns + 300_000
                    )
                for s, (_, payload) in zip(sent, wire.encode(sent), strict=True):
                    command = maps[s].command(decode(payload), s)
                    assert command is not None
                    commands[s] = command
            clock.advance(STATE_NS / 1e9)
        for hand in hands.values():
            hand.close()


def test_synthetic_session_matches_its_generator(tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    write(path, 1.2)
    again = [(m.topic, m.log_time_ns, m.data) for m in open_trace(path).messages()]
    shipped = open_trace(sample_path("dex5_synthetic"))
    assert len(again) > 1000
    kept = islice(shipped.messages(), len(again))
    assert again == [(m.topic, m.log_time_ns, m.data) for m in kept]
    assert "none" in shipped.metadata["provenance"]["controller_commit"]


def test_synthetic_session_is_judged_as_dex5() -> None:
    recording = Recording.decode(open_trace(sample_path("dex5_synthetic")))
    assert recording.dialect is DEX5
    result = judge(recording)
    assert result.overall is Overall.PASS
    passed = {r.requirement.id for r in result.results if r.verdict is Verdict.PASS}
    assert {"DEX5-FIELD-01", "DEX5-FIELD-03", "DEX5-TRACK-01", "DEX5-FORCE-02"} <= passed
    # the fingers' mN m are N m to the checks
    assert np.nanmax(np.abs(recording.sides[LEFT].states.tau[:, :16])) < 0.5


def test_files_of_the_hand_are_those_of_the_document() -> None:
    text = (ROOT / "docs/other-hands.md").read_text(encoding="utf-8")
    own = re.findall(r"`([^`]+)`", " ".join(re.findall(r"^\| (`.*?) \|", text, re.MULTILINE)))
    assert len(own) > 10
    for file in own:
        assert b"dex5" in (ROOT / file).read_bytes().lower(), file


if __name__ == "__main__":
    session = Path(samples.__file__).with_name("dex5_synthetic.mcap")
    write(session)
    labels = session.with_name("labels.json")
    every = json.loads(labels.read_text())
    operator_starts = CLIENT_STARTS + profile(PROFILE, DEX5_1.name).lead_in
    every[session.name] = {
        "first_message_ns": open_trace(session).first_ns,
        "operator_zero_ns": EPOCH_NS + round(operator_starts * 1e9),
        "events": [],
    }
    labels.write_text(json.dumps(every, indent=1) + "\n")

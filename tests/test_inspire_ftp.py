"""Test Inspire's FTP hands: lists of integers on the wire, profile, registers, client, doctor."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.backends import backend
from dexkit.cli import cli
from dexkit.clock import ManualClock
from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.kit.motor_messages import Motor, MotorCodec
from dexkit.conformance.kit.results import Verdict
from dexkit.conformance.virtual.inspire import FtpHand, FtpService
from dexkit.emulators.sim_inspire import SimInspireFtp, sim_inspire_ftp
from dexkit.errors import EncodeError, OversizeError, TruncatedError
from dexkit.hand import HandCommand, HandState, MotorError, Side
from dexkit.messages import message_type
from dexkit.messages.inspire import inspire_hand_ctrl, inspire_hand_state
from dexkit.messages.layout import IdlError, parse
from dexkit.models import INSPIRE_DFX, INSPIRE_FTP, dialect
from dexkit.service.dialects import DialectMap, StateView, dialect_map
from dexkit.service.ftp_map import FtpMap
from dexkit.teleop import client_for
from dexkit.teleop.client_codec import ClientCodec
from dexkit.topics import roles
from dexkit.traces.names import dds_type
from dexkit.watch.fields import parts_of
from tests.each import each

FTP = dialect("inspire_ftp")
STATE, CTRL = message_type(FTP.state_type), message_type(FTP.cmd_type)
LEFT, RIGHT = Side.LEFT, Side.RIGHT
N = 6
FULL_SPEED = INSPIRE_FTP.joints[Side.LEFT][0].dq_max


# ------------------------------------------------------------------------------------ on the wire


def test_each_list_begins_at_a_multiple_of_four() -> None:
    # lengths 6, 6, 1 and 0 of 16-bit numbers: two bytes of padding after the third
    data = CTRL.encode(inspire_hand_ctrl([1] * 6, [2] * 6, [-3], [], 5))
    assert data.hex() == (
        "00010000" "06000000" + "0100" * 6 + "06000000" + "0200" * 6
        + "01000000" "fdff" "0000" "00000000" "05"
    )  # fmt: skip
    assert CTRL.decode(data) == CTRL.decode(data + bytes(3))
    rows = CTRL.columns([data, data[:-1]])
    assert rows["force_set[0]"][0] == -3
    assert rows.count("speed_set").tolist() == [0, -1]
    assert rows["mode"][0] == 5


def test_bounds_and_ranges_are_kept() -> None:
    for bad in ({"angle_set": [0] * 7}, {"angle_set": [40000]}, {"mode": 128}):
        with pytest.raises(EncodeError, match=f"inspire_hand_ctrl.{next(iter(bad))}"):
            CTRL.encode(inspire_hand_ctrl(**bad))
    with pytest.raises(OversizeError, match="at most 6"):
        CTRL.decode(b"\0\1\0\0" + b"\7\0\0\0" + bytes(40))
    with pytest.raises(TruncatedError):
        CTRL.decode(b"\0\1\0\0" + b"\6\0\0\0" + bytes(8))


@each(
    ("member", "why"),
    [
        ("sequence<int16> a;", "only sequences of structs or bytes"),
        ("sequence<int16, 0> a;", "only sequences of structs or bytes"),
        ("sequence<int16, 4000> a;", "at most 1024 numbers"),
        ("sequence<int16, x> a;", "is no length"),
        ("sequence<int16, 6> a[2];", "only sequences of structs or bytes"),
        ("sequence<boolean, 6> a;", "only sequences of structs or bytes"),
        ("sequence<int16, 6> a; int64 b;", "only numbers of 4 bytes"),
        ("sequence<int16, 6> a; string b;", "only numbers of 4 bytes"),
    ],
)
def test_other_sequences_of_numbers_are_refused(member: str, why: str) -> None:
    with pytest.raises(IdlError, match=why):
        parse(f"module a {{ @final struct S {{ {member} }}; }};")


def test_names_outside_the_modules_of_ros_are_kept() -> None:
    for spelling in ("inspire::inspire_hand_ctrl", "inspire.inspire_hand_ctrl", CTRL.ros_name):
        assert dds_type(spelling) == "inspire::inspire_hand_ctrl"
    assert CTRL.ros_name == "inspire/msg/inspire_hand_ctrl"
    assert "int16[<=6] angle_set" in CTRL.ros2msg
    assert "sequence<short, 6> angle_set;" in CTRL.omgidl


def test_ftp_state_converts_to_motors_and_back() -> None:
    message = inspire_hand_state(
        [0] * N, [0, 1, 500, 999, 1000, 7], [100] * N, [0] * N, [1] * N, [2] * N, [31] * N
    )
    motors = STATE.motors(message)
    assert [m.q for m in motors] == [0.0, 0.001, 0.5, 0.999, 1.0, 0.007]
    assert (motors[0].tau_est, motors[0].temperature) == (-0.1, 31)
    assert motors[0].reserve == (MotorError.LOCKED, 0)
    assert STATE.of_motors(motors).angle_act == message.angle_act
    columns = STATE.columns([STATE.encode(message)])
    assert STATE.motor_table(columns, "q", [2, 4]).tolist() == [[0.5, 1.0]]
    assert STATE.motor_table(columns, "dq", [2, 4]).tolist() == [[0.0, 0.0]]


# --------------------------------------------------------------------------------------- the model


def test_topics_have_the_side_as_a_letter() -> None:
    assert FTP.topics(LEFT) == ("rt/inspire_hand/ctrl/l", "rt/inspire_hand/state/l")
    (state,) = roles("rt/inspire_hand/state/r")
    assert (state.kind, state.dialect.name, state.sides) == ("state", "inspire_ftp", (RIGHT,))
    assert not FTP.shared
    assert INSPIRE_FTP.joints == INSPIRE_DFX.joints


def test_lists_and_their_topics_are_described() -> None:
    text = CliRunner().invoke(cli, ["models", "inspire-ftp"]).output
    assert "rt/inspire_hand/ctrl/{l,r}" in text
    assert "rt/inspire_hand/touch/{l,r}" in text
    (part,) = parts_of("rt/inspire_hand/state/l", FTP.state_type)
    (q, *_) = [f for f in part.fields if f.quantity == "q"]
    assert (q.path, q.factor, q.unit) == ("angle_act[0]", 0.001, "full travel")
    assert {f.quantity for f in part.fields} == {"q", "tau", "temperature"}


# ---------------------------------------------------------------------------------- the simulated


def test_simulated_hand_measures_angles_and_forces() -> None:
    assert backend("sim-inspire-ftp") is sim_inspire_ftp
    clock = ManualClock()
    hand = SimInspireFtp(RIGHT, clock=clock, object_at=60.0)
    hand.open()
    command = HandCommand.position([0.1] * N, dq=[FULL_SPEED] * N)
    for _ in range(100):
        clock.advance(0.01)
        state = hand.exchange(command)
    assert np.allclose(state.q, 0.4)
    sent = mapping(RIGHT).state({RIGHT: StateView(state, (0,) * N)})
    assert sent.angle_act == [400] * N
    assert min(sent.force_act) > 900  # a grip is positive
    assert sent.status == [3] * N  # the limit of force is reached


# --------------------------------------------------------------------------------------- dialect


def mapping(side: Side = LEFT) -> DialectMap:
    return dialect_map(FTP, {side: INSPIRE_FTP.spec(side, io_rate=100.0)})


def ctrl(angles: list[int], mode: int = 1, **lists: list[int]) -> inspire_hand_ctrl:
    return inspire_hand_ctrl(angle_set=angles, mode=mode, **lists)


@given(st.lists(st.integers(0, 1000), min_size=N, max_size=N))
@settings(max_examples=20, deadline=None)
def test_angles_are_thousandths_both_ways(angles: list[int]) -> None:
    sent = CTRL.decode(CTRL.encode(ctrl(angles)))
    command = mapping().command(sent, LEFT)
    assert command is not None
    assert np.allclose(command.q, np.array(angles) / 1000)
    assert command.dq.tolist() == [FULL_SPEED] * N
    view = StateView(HandState.from_values(command.q, stamp=0.0), (0,) * N)
    assert STATE.decode(mapping().encode({LEFT: view})).angle_act == angles


@each(
    ("messages", "q", "dq"),
    [
        ([ctrl([300] * N, 0)], None, None),
        ([ctrl([300] * N, 2)], None, None),  # actuator positions are not used
        ([ctrl([300] * 5)], None, None),
        ([ctrl([], 8, speed_set=[500] * N)], None, None),  # no goal yet
        ([ctrl([300] * 5 + [-1])], None, None),
        ([ctrl([], 8, speed_set=[500] * N), ctrl([300] * N)], [0.3] * N, FULL_SPEED / 2),
        ([ctrl([300] * N), ctrl([-1] * 3 + [700] * 3)], [0.3] * 3 + [0.7] * 3, FULL_SPEED),
        ([ctrl([300] * N), ctrl([], 8, speed_set=[2000] * N)], [0.3] * N, FULL_SPEED),
        ([ctrl([300] * N, 9, speed_set=[0] * N)], [0.3] * N, 0.0),
    ],
)
def test_unwritten_registers_keep_their_value(
    messages: list[inspire_hand_ctrl], q: list[float] | None, dq: float | None
) -> None:
    spoken = mapping()
    for message in messages:
        command = spoken.command(message, LEFT)
    if q is None:
        assert command is None
        return
    assert command is not None
    assert np.allclose(command.q, q)
    assert command.dq.tolist() == [dq] * N


def test_unused_mode_bits_are_remarked() -> None:
    assert not mapping().remarks(ctrl([1] * N, 9), LEFT)
    (remark,) = mapping().remarks(ctrl([1] * N, 5), LEFT)
    assert "force" not in remark.text.partition("bits")[0]


def test_faults_are_the_bits_of_err() -> None:
    view = StateView(HandState.from_values([0.5] * N, stamp=0.0), (MotorError.LOCKED, *[0] * 5))
    sent: Any = mapping().state({LEFT: view})
    assert (sent.err, sent.status) == ([1, 0, 0, 0, 0, 0], [7, 2, 2, 2, 2, 2])
    assert isinstance(mapping(), FtpMap)


# ----------------------------------------------------------------------------------------- clients


def test_client_waits_for_either_hand_and_begins_open() -> None:
    client = client_for("inspire_ftp")
    client.receive(0.0, {LEFT: (0.0,) * N, RIGHT: (0.0,) * N})
    assert client.step(0.01, {}, {}) == {}
    assert set(client.missing) == set(Side)
    client.receive(0.02, {LEFT: (0.0,) * N, RIGHT: (0.5,) * N})
    commands = client.step(0.03, {}, {})
    sent = dict(ClientCodec(FTP).encode(commands))
    assert set(sent) == {"rt/inspire_hand/ctrl/l", "rt/inspire_hand/ctrl/r"}
    for payload in sent.values():
        # as the genuine client: every list is there
        assert CTRL.decode(payload) == inspire_hand_ctrl([0] * N, [1000] * N, [0] * N, [0] * N, 1)


def test_kit_encodes_and_reads_for_itself() -> None:
    codec = MotorCodec(FTP)
    ((topic, payload),) = codec.encode(
        {LEFT: [Motor(0.25), *[Motor(float("nan"))] * 4, Motor(1e9)]}
    )
    assert topic == "rt/inspire_hand/ctrl/l"
    assert CTRL.decode(payload).angle_set == [250, -1, -1, -1, -1, 32767]
    read = codec.read_command(payload, LEFT)
    assert read is not None
    assert read[0].q == 0.25
    assert codec.read_command(CTRL.encode(ctrl([1] * N, 0)), LEFT) is None


# ------------------------------------------------------------------------------------ conformance


@pytest.mark.soak
def test_hand_with_the_speed_of_the_manual_passes() -> None:
    """The profile has the 0.8 s of the DFX for the full travel, the manual 0.6 s."""

    class Quick(FtpHand):
        def __init__(self, side: Side, touch: float | None = None) -> None:
            super().__init__(side, touch)
            self.full = np.full(N, 1.0 / 0.6)

    class Service(FtpService):
        hand = Quick

    result = run_mutant(Service, plan_for("inspire_ftp"))
    assert {r.verdict for r in result.results} == {Verdict.PASS, Verdict.NOT_APPLICABLE}

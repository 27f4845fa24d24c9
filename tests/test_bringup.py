"""The bring-up on virtual time: dead-man key, one joint at a time, faults, wirings, files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.bringup import DeadMan, Drive, Effort, Findings, Reading, Snapshot
from dexkit.bringup.dead_man import ARM, PAUSE, RELEASE
from dexkit.bringup.motion import End, Go, Mover
from dexkit.drivers.dex3_usb.settings import Dex3Settings, with_stored
from dexkit.drivers.dex3_usb.stored import Store
from dexkit.emulators.dex3_mcu import Firmware, Wiring
from dexkit.errors import HandFault, HandRefused, HandTimeout, UsageError
from dexkit.hand import HandCommand, HandState, MotorError, Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import (
    COMMAND_LAYOUTS,
    HandCodec,
    Mounting,
    parse_command,
)
from tests.bringup_helpers import Bring
from tests.each import each

REPEAT = 0.033
FAST = Effort(torque=0.5, speed=2.0)
"""The most that a bring-up may: what takes ten minutes with a person takes a second here."""


def hold(key: DeadMan, start: float, seconds: float) -> float:
    """Call it every 10 ms while the key repeats; return the time of the last repeat."""
    now = start
    due, last = start, start
    while now < start + seconds:
        data = b""
        if now >= due:
            data, due, last = b" ", due + REPEAT, now
        key.held(now, data)
        now += 0.01
    return last


def test_one_press_is_not_held_and_silence_releases() -> None:
    key = DeadMan()
    assert not key.held(0.0, b"")
    assert not key.held(0.01, b" ")
    last = hold(key, 0.02, ARM * REPEAT + 0.3)
    assert key.held(last + 0.01, b"")
    now = last + 0.01
    while key.held(now, b""):
        now += 0.01
    assert RELEASE < now - last <= RELEASE + 0.011


@each(
    "data, gap",
    [(b"x", 0.01), (b" x ", 0.01), (b"\x1b[A", 0.01), (b" " * 60, PAUSE + 0.01)],
    ids=["another key", "among spaces", "an arrow", "a pause with old presses"],
)
def test_other_key_or_pause_releases_the_dead_man_key(data: bytes, gap: float) -> None:
    key = DeadMan()
    last = hold(key, 0.0, 1.0)
    assert key.held(last + 0.011, b" ")
    assert not key.held(last + 0.011 + gap, data)
    assert not key.held(last + 0.022 + gap, b" ")  # it has to be held anew


def test_a_burst_of_presses_counts_as_one() -> None:
    key = DeadMan()
    key.held(0.0, b"")
    assert not key.held(0.01, b" " * 100)


def found_wiring(bring: Bring) -> Dex3Settings:
    return with_stored(Dex3Settings(), bring.bench.settings(bring.session.findings))


def check_wiring(seed: int, tmp_path: Path, effort: Effort) -> None:
    """Find a random wiring behind a firmware of a random reading."""
    wiring, side = Wiring.random(seed), (Side.LEFT, Side.RIGHT)[seed % 2]
    frame = (None, 734, 1234)[seed % 3]
    firmware = Firmware(
        unaddressed_motors_answer=bool(seed & 1),
        answer_bad_frame=bool(seed & 2),
        sensors_polled=bool(seed & 4),
        frame=frame,
        head=(None, b"\xfc\xfd", b"\xeb\x90")[seed // 3 % 3],
    )
    bring = Bring(tmp_path, side=side, wiring=wiring, firmware=firmware, effort=effort)
    bring.run()
    bring.bench.store(bring.session.findings)
    found = found_wiring(bring)
    assert found.bus_map == wiring.bus_map
    assert found.signs == wiring.mounting.signs
    assert found.ratios == wiring.mounting.ratios
    assert found.offsets == pytest.approx(wiring.mounting.offsets, abs=0.01)
    assert found.poll_sensors is firmware.sensors_polled
    assert found.layout.size == (frame or COMMAND_LAYOUTS[0].size)
    assert found.head == (firmware.head or found.head)
    joints = DEX3_1.joints[side]
    assert found.limits == tuple(
        (pytest.approx(j.q_min, abs=0.02), pytest.approx(j.q_max, abs=0.02)) for j in joints
    )
    assert all(t.confirmed for t in bring.session.findings.travel.values())
    assert len(bring.session.findings.answers) == 7 * 4 + 9, "each question has a key of its own"
    # never two joints at once
    by_time: dict[float, set[int]] = {}
    for time, joint in bring.driven:
        by_time.setdefault(time, set()).add(joint)
    assert by_time
    assert all(len(joints) == 1 for joints in by_time.values())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3])
def test_bringup_finds_a_random_wiring(seed: int, tmp_path: Path) -> None:
    check_wiring(seed, tmp_path, FAST)


@pytest.mark.soak
@pytest.mark.parametrize("part", range(20))
def test_bringup_finds_two_hundred_random_wirings(part: int, tmp_path: Path) -> None:
    for seed in range(10 * part, 10 * part + 10):
        (tmp_path / str(seed)).mkdir()
        check_wiring(seed, tmp_path / str(seed), FAST)


# ------------------------------------------------------------------------------ stopping


@pytest.fixture
def moving(tmp_path: Path) -> Bring:
    """A bring-up in the middle of its first motion."""
    bring = Bring(tmp_path, wiring=Wiring.random(1))
    while bring.drive is None:
        bring.cycle()
    for _ in range(4):
        bring.cycle()
    assert bring.drive is not None
    assert bring.mcu.mechanics.mode.count(1) == 1
    return bring


def test_release_locks_every_motor_within_a_cycle(moving: Bring) -> None:
    moving.cycle(held=False)
    assert moving.drive is None
    sent = len(moving.driven)
    moving.cycle(held=False)
    assert moving.mcu.mechanics.mode == [0] * 7
    for _ in range(50):
        moving.cycle(held=False)
    assert len(moving.driven) == sent
    q = moving.mcu.mechanics.q
    moving.cycle()
    moving.cycle()
    assert moving.mcu.mechanics.q == pytest.approx(q, abs=0.05), "it starts gently again"
    assert moving.until_question() is not None


def test_fault_ends_the_bringup_for_good(moving: Bring) -> None:
    moving.mcu.mechanics.fail(6, MotorError.OVERCURRENT)
    with pytest.raises(HandFault, match="overcurrent"):
        moving.cycles(3)
    moving.mcu.mechanics.recover(6, MotorError.OVERCURRENT)
    moving.drive = None
    sent = len(moving.driven)
    for _ in range(10):
        with pytest.raises(HandFault, match="overcurrent"):
            moving.cycle()
    assert len(moving.driven) == sent


def _step(mover: Mover, now: float, q: float) -> Drive | End | None:
    return mover.step(now, Snapshot({"1": Reading(q, 0, 30.0)}), True)


def test_a_motion_begins_once_the_motor_has_come_to_rest() -> None:
    """A motor that runs on after a motion is no motor that moves against the next one."""
    mover = Mover(Go("1", 0.0, "back"), FAST, 1.0)
    running_on = [0.5, 0.54, 0.57, 0.59, 0.6]
    for n, q in enumerate(running_on):
        assert _step(mover, 0.02 * n, q) is None
    assert isinstance(_step(mover, 0.1, 0.6), Drive)


def test_a_motor_that_never_comes_to_rest_is_judged_all_the_same() -> None:
    mover = Mover(Go("1", 0.0, "back"), FAST, 1.0)
    n = 0
    while _step(mover, 0.02 * n, 0.5 + 0.03 * n) is None:
        n += 1
    assert 0.02 * n == pytest.approx(1.0, abs=0.05)
    _step(mover, 0.02 * n + 0.02, 0.53 + 0.03 * n)
    with pytest.raises(HandFault, match="moves against its command"):
        _step(mover, 0.02 * n + 0.06, 0.59 + 0.03 * n)


def test_motion_of_another_motor_ends_the_bringup(moving: Bring) -> None:
    active = next(i for i, mode in enumerate(moving.mcu.mechanics.mode) if mode)
    other = (active + 1) % 7
    moving.mcu.mechanics.joints[other].q += 0.3
    with pytest.raises(HandFault, match=r"moves while only"):
        moving.cycle()


def test_hot_silent_or_blocked_motor_ends_the_bringup(tmp_path: Path) -> None:
    hot = Bring(tmp_path)
    hot.mcu.mechanics.heat(2, 65.0)
    with pytest.raises(HandFault, match=r"is at \d+ °C"):
        hot.cycle()
    gone = Bring(tmp_path)
    while gone.drive is None:
        gone.cycle()
    for motor in gone.mcu._motors:
        motor.silent = True
    with pytest.raises(HandFault, match="no longer answers"):
        gone.cycles(10)
    stuck = Bring(tmp_path)
    for joint in range(7):
        stuck.mcu.mechanics.jam(joint, True)
    with pytest.raises(HandFault, match="moves in neither direction"):
        stuck.until_question()


def test_unseen_motion_ends_the_bringup(tmp_path: Path) -> None:
    bring = Bring(tmp_path)
    question = bring.until_question()
    assert question is not None
    with pytest.raises(UsageError, match="not a valid answer"):
        bring.session.answer("the small one")
    with pytest.raises(HandFault, match="operator saw none"):
        bring.session.answer("nothing")
    with pytest.raises(HandFault, match="operator saw none"):
        bring.cycle()


def test_answer_again_repeats_the_motion(tmp_path: Path) -> None:
    bring = Bring(tmp_path)
    for _ in range(2):
        question = bring.until_question()
        assert question is not None
        assert question.key == "motor 0.0 joint"
        bring.session.answer("again")
    assert bring.session.findings.answers == {}


def test_a_torque_is_never_exceeded(moving: Bring) -> None:
    """What blocks a joint feels at most the torque that was asked for."""
    active = next(i for i, mode in enumerate(moving.mcu.mechanics.mode) if mode)
    moving.mcu.mechanics.jam(active, True)
    most = 0.0
    for _ in range(100):
        moving.cycle()
        most = max(most, float(np.abs(moving.mcu.mechanics.tau).max()))
        if moving.session.question is not None:
            break
    assert 0.02 < most <= moving.effort.torque + 1e-3


# ------------------------------------------------------------------------------ resuming, files


def test_bringup_resumes_where_it_was(tmp_path: Path) -> None:
    bring = Bring(tmp_path, wiring=Wiring.random(2))
    answered = 0
    while answered < 5:
        question = bring.until_question()
        assert question is not None
        bring.session.answer(bring.look(question))
        bring.bench.store(bring.session.findings)
        answered += 1
    found = bring.bench.load()
    assert found == bring.session.findings
    assert len(found.motors) == 2
    bring.begin(found)
    question = bring.until_question()
    assert question is not None
    assert question.key == f"motor {bring.bench.motors[2]} joint"
    record = json.loads((tmp_path / "dex3.json").read_text())["left"]
    assert set(record) == {"settings", "found", "answers"}
    assert {"at", "by", "hand", "details"} == set(record["found"])
    assert record["found"]["hand"]["sensors_answer"] == "by themselves"
    assert "motors" not in record["settings"], "half a map is none"


@each("document", [{"motors": 1}, {"motors": {"0.0": {}}}, {"travel": {"x": {"ratio": "y"}}}])
def test_damaged_findings_are_refused(document: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="the findings of a bring-up: "):
        Findings.from_document(document, {})


@each(
    "content, said",
    [
        ("[]", "JSON object"),
        ('{"SN1": 1}', "SN1 must be an object"),
        ('{"SN1": {"settings": []}}', "settings must be an object"),
        ('{"SN1": {"settings": {"signs": 1}}}', "signs must be text"),
    ],
)
def test_a_damaged_settings_file_is_refused(content: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "dex3.json"
    path.write_text(content)
    with pytest.raises(UsageError, match=said):
        Store(path).section("SN1", "settings")


def test_a_hand_that_answers_nothing_is_named(tmp_path: Path) -> None:
    mute = Firmware(frame=5, answer_bad_frame=False)
    with pytest.raises(HandTimeout, match="no command frame"):
        Bring(tmp_path, firmware=mute)
    deaf = Firmware(head=b"??", unaddressed_motors_answer=True)
    with pytest.raises(HandRefused, match="no motor obeys"):
        Bring(tmp_path, firmware=deaf)


# ------------------------------------------------------------------------------ mounting, polling

_SIGN = st.sampled_from((1, -1))


@settings(max_examples=10)
@given(
    signs=st.tuples(*[_SIGN] * 7),
    offsets=st.tuples(*[st.floats(-3, 3)] * 7),
    q=st.tuples(*[st.floats(-2, 2)] * 7),
    dq=st.tuples(*[st.floats(-5, 5)] * 7),
    poll=st.booleans(),
)
def test_mounting_round_trips(
    signs: tuple[int, ...],
    offsets: tuple[float, ...],
    q: tuple[float, ...],
    dq: tuple[float, ...],
    poll: bool,
) -> None:
    joints = DEX3_1.joints[Side.LEFT]
    ratios = (189.0, *[108.0] * 6)
    codec = HandCodec(joints, mounting=Mounting(signs, offsets, ratios), poll_sensors=poll)
    command = HandCommand.position(q, dq=dq, tau=0.1, kp=1.5, kd=0.2)
    data = codec.encode(command)
    decoded = codec.decode_command(data).command
    assert decoded.q == pytest.approx(command.q, abs=1e-5)
    assert decoded.dq == pytest.approx(command.dq, abs=0.03)
    assert decoded.tau == pytest.approx(command.tau, abs=1e-3)
    assert decoded.kp == pytest.approx(command.kp, abs=0.05)
    polled = parse_command(data).sensors
    assert [(b, p.id) for b, p in polled] == (list(codec.bus_map.sensors) if poll else [])
    state = HandState.from_values(q, dq=dq, tau_est=0.2, stamp=0.0, temperature=25.0, voltage=24.0)
    back = codec.decode(codec.encode_state(state), 0.0)
    assert back.q == pytest.approx(state.q, abs=1e-5)
    assert back.dq == pytest.approx(state.dq, abs=0.03)
    assert back.tau_est == pytest.approx(state.tau_est, abs=1e-3)
    raw = codec.mounting.motor(0, q[0])
    assert codec.mounting.joint(0, raw) == pytest.approx(q[0])


@each(
    "texts, said",
    [
        ({"signs": "+,+"}, "7"),
        ({"signs": "+,+,+,+,+,+,?"}, "neither"),
        ({"offsets": "nan,0,0,0,0,0,0"}, "finite"),
        ({"offsets": "99,0,0,0,0,0,0"}, "offset"),
        ({"ratios": "0,1,1,1,1,1,1"}, "ratio"),
        ({"limits": "1,1,1,1,1,1,1"}, "LOW:HIGH"),
        ({"poll_sensors": "maybe"}, "auto"),
        ({"usb": "auto"}, "no setting of a single hand"),
        ({"timeout": "1"}, "no setting of a single hand"),
    ],
)
def test_wrong_settings_of_a_hand_are_refused(texts: dict[str, str], said: str) -> None:
    with pytest.raises(UsageError) as refused:
        with_stored(Dex3Settings(), texts)
    assert said in f"{refused.value.message} {refused.value.hint}"


def test_limits_may_only_be_narrower() -> None:
    limits = [(j.q_min, j.q_max) for j in DEX3_1.joints[Side.LEFT]]
    narrow = Dex3Settings(limits=((-0.5, 0.5), *limits[1:]))
    assert narrow.joints(Side.LEFT)[0].q_max == 0.5
    wide = Dex3Settings(limits=((-2.0, 0.5), *limits[1:]))
    with pytest.raises(UsageError, match="thumb_0"):
        wide.joints(Side.LEFT)


def test_given_settings_are_not_replaced_by_those_of_the_file() -> None:
    given_one = Dex3Settings(head=b"\x01\x02", given=frozenset({"head"}))
    both = with_stored(given_one, {"head": "fcfd", "signs": "-,+,+,+,+,+,+"})
    assert both.head == b"\x01\x02"
    assert both.signs[0] == -1

"""The predictive estimator (docs/sources/mx64-ezgripper.md#d8): what it guarantees, and what
happens at an obstacle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dexkit.errors import UsageError
from dexkit.hand import HandCommand, HandState, JointSpec, Side
from dexkit.models import DEX1_1
from dexkit.service.estimator import CORRECTION, STALL_THRESHOLD, JointEstimator, StateEstimator
from tests.each import each

STROKE = 5.4
JOINT = JointSpec("gripper", q_min=0.0, q_max=STROKE, dq_max=24.0, tau_max=15.0, closing=-1)
EPS = 1e-9


@dataclass(frozen=True)
class Advance:
    dt: float


@dataclass(frozen=True)
class Command:
    q: float | None


@dataclass(frozen=True)
class Measure:
    """As a fraction of the stroke away from the model's prediction, or absolute."""

    offset: float


positions = st.floats(-1.0, 7.0)
events = st.lists(
    st.one_of(
        st.builds(Advance, st.floats(1e-4, 0.05)),
        st.builds(Command, st.one_of(st.none(), positions)),
        st.builds(Measure, st.floats(-0.3, 0.3)),
    ),
    max_size=60,
)
speeds = st.tuples(st.floats(0.5, 30.0), st.floats(0.5, 30.0))


@given(speeds, st.floats(0.0, STROKE), events)
def test_estimate_never_jumps_overshoots_or_reverses(
    speed: tuple[float, float], start: float, script: list[Advance | Command | Measure]
) -> None:
    e = JointEstimator(JOINT, speed)
    now = 0.0
    e.measure(start, now)
    assert e.q == start
    target: float | None = None
    for event in script:
        before = e.q
        if isinstance(event, Command):
            e.follow(event.q, now)
            target = None if event.q is None else min(max(event.q, 0.0), STROKE)
            assert e.q == before  # a command by itself moves nothing
        elif isinstance(event, Measure):
            resyncs, blocked = e.resyncs, e.stalled
            measured = e.q + event.offset * STROKE
            e.measure(measured, now)
            if e.resyncs > resyncs or blocked:
                assert e.q == measured
            else:
                assert e.q == before  # a correction shows only as time passes
        else:
            travelling = e.travelling
            now += event.dt
            after = e.predict(now)
            moved = after - before
            limit = (speed[0] if moved > 0 else speed[1]) * event.dt
            assert abs(moved) <= limit + EPS  # V
            if travelling:
                assert target is not None
                way = math.copysign(1.0, target - before)
                if e.travelling:
                    assert moved * way >= -EPS  # R
                assert (after - target) * way <= EPS or moved == 0  # O


@given(st.floats(0.0, STROKE), positions, speeds)
@settings(deadline=None)
def test_estimate_without_measurements_is_the_model_of_the_source(
    start: float, command: float, speed: tuple[float, float]
) -> None:
    """The loop of docs/sources/mx64-ezgripper.md#d8-1, 200 Hz, written out."""
    e = JointEstimator(JOINT, speed)
    e.measure(start, 0.0)
    e.follow(command, 0.0)
    commanded = min(max(command, 0.0), STROKE)
    predicted = start
    for step in range(1, 100):
        dt = 1 / 200
        error = commanded - predicted
        max_delta = speed[0 if error > 0 else 1] * dt
        if abs(error) <= max_delta:
            predicted = commanded
        else:
            predicted += math.copysign(max_delta, error)
        assert e.predict(step * dt) == pytest.approx(predicted, abs=1e-6)


def test_model_step_is_4_76_percent_at_200_hz() -> None:
    speed = 952.43 / 100 * STROKE
    e = JointEstimator(JOINT, (speed, speed))
    e.measure(0.0, 0.0)
    e.follow(STROKE, 0.0)
    assert e.predict(0.005) / STROKE == pytest.approx(0.0476, abs=5e-5)


def test_each_direction_has_its_speed() -> None:
    e = JointEstimator(JOINT, (2.0, 1.0))
    e.measure(1.0, 0.0)
    e.follow(5.0, 0.0)
    assert e.predict(1.0) == pytest.approx(3.0)
    assert e.dq == pytest.approx(2.0)
    e.follow(0.0, 1.0)
    assert e.predict(2.0) == pytest.approx(2.0)
    assert e.dq == pytest.approx(-1.0)


@given(st.floats(0.01, 0.099), st.sampled_from([-1, 1]))
@settings(deadline=None)
def test_a_small_difference_is_corrected_by_a_tenth(fraction: float, side: int) -> None:
    """At rest nothing else moves the prediction, so the tenth is all there is."""
    e = JointEstimator(JOINT, (5.0, 5.0))
    e.measure(2.7, 0.0)
    e.follow(2.7, 0.0)
    measured = 2.7 + side * fraction * STROKE
    e.measure(measured, 1.0)
    assert e.predict(2.0) == pytest.approx(2.7 + CORRECTION * (measured - 2.7))
    assert e.resyncs == 0


@given(st.floats(STALL_THRESHOLD + 1e-3, 0.5), st.sampled_from([-1, 1]))
@settings(deadline=None)
def test_a_large_difference_puts_it_on_the_measurement(fraction: float, side: int) -> None:
    e = JointEstimator(JOINT, (5.0, 5.0))
    e.measure(2.7, 0.0)
    e.follow(2.7, 0.0)
    measured = 2.7 + side * fraction * STROKE
    e.measure(measured, 1.0)
    assert e.q == measured
    assert e.resyncs == 1


def test_prediction_waits_for_a_lagging_hand_without_reversing() -> None:
    e = JointEstimator(JOINT, (5.0, 5.0))
    e.measure(0.0, 0.0)
    e.follow(STROKE, 0.0)
    e.predict(0.2)
    ahead = e.q
    e.measure(ahead - 0.05 * STROKE, 0.2)
    seen = [e.predict(0.2 + 0.001 * i) for i in range(1, 100)]
    assert seen[0] == ahead
    assert seen == sorted(seen)
    # it resumes once the corrected model (a tenth of 5 % back) has come up to it
    wait = CORRECTION * 0.05 * STROKE / 5.0
    resumed = next(i for i, q in enumerate(seen, 1) if q > ahead)
    assert 0.001 * resumed == pytest.approx(wait, abs=0.002)


def test_an_object_stops_the_prediction_at_the_object() -> None:
    """A client that always asks for a little more (xr_teleoperate) must not see it creep."""
    contact = 2.0
    e = JointEstimator(JOINT, (9.0, 9.0))
    e.measure(3.0, 0.0)
    now, reported = 0.0, []
    for tick in range(1, 2000):
        now = tick / 500
        if tick % 3 == 0:
            e.follow(e.q - 0.18, now)
        if tick % 100 == 0:  # 5 Hz
            e.measure(contact, now)
        reported.append(e.predict(now))
    assert e.stalled
    assert set(reported[200:]) == {contact}
    # the hand is seen to move again: prediction goes on
    e.measure(contact - 0.02 * STROKE, now)
    assert not e.stalled
    e.follow(0.0, now)
    assert e.predict(now + 0.1) < contact - 0.02 * STROKE


def test_a_stalled_prediction_shows_in_tau_est_if_that_is_wanted() -> None:
    spec = DEX1_1.spec(Side.LEFT, io_rate=10.0)
    for wanted, measured, seen in ((0.0, 0.0, 0.0), (0.7, 0.0, -0.7), (0.7, -0.9, -0.9)):
        e = StateEstimator(spec, [(9.0, 9.0)], stall_tau=wanted)
        state = HandState.from_values(3.0, tau_est=measured, stamp=0.0)
        e.measure(state, 0.0)
        free = e.predict(0.01)
        assert free is not None
        assert free.tau_est[0] == measured
        e.follow(HandCommand.position(0.0), 0.02)
        for tick in range(1, 4):  # it does not move on its way to 0
            e.measure(replace(state, stamp=0.2 * tick), 0.2 * tick)
        stalled = e.predict(0.7)
        assert stalled is not None
        assert stalled.tau_est[0] == pytest.approx(seen)


def test_opposite_goal_ends_a_stall() -> None:
    e = JointEstimator(JOINT, (5.0, 5.0))
    e.measure(2.0, 0.0)
    e.follow(0.0, 0.0)
    e.measure(2.0, 0.3)
    assert e.stalled
    e.follow(0.5, 0.3)
    assert e.stalled
    assert e.predict(0.5) == 2.0
    e.follow(3.0, 0.5)
    assert not e.stalled
    assert e.predict(0.6) == pytest.approx(2.5)


def test_a_speed_that_is_too_high_is_not_a_stall() -> None:
    """952 %/s (docs/sources/mx64-ezgripper.md#d8-3) is impossible
    (docs/sources/mx64-ezgripper.md#d10-6): the hand is slow, not stuck.
    """
    e = JointEstimator(JOINT, (952.43 / 100 * STROKE,) * 2)
    true, v = 0.0, 1.0 * STROKE  # 100 %/s
    e.measure(true, 0.0)
    e.follow(STROKE, 0.0)
    for i in range(1, 8):
        true = v * i * 0.1
        e.measure(true, i * 0.1)
        assert not e.stalled
        assert e.q == true


@given(st.lists(st.floats(0.0, STROKE), min_size=5, max_size=5))
def test_estimate_converges_on_a_hand_at_rest(start: list[float]) -> None:
    assume(abs(start[0] - start[1]) > 0.01)
    e = JointEstimator(JOINT, (5.0, 5.0))
    e.measure(start[0], 0.0)
    e.follow(start[1], 0.0)
    rest = start[2]
    for i in range(1, 120):
        e.measure(rest, 0.2 * i)
    q = e.predict(60.0)
    # not past the command, otherwise where the hand is
    direction = start[1] - start[0]
    expected = {rest, start[1]} if (rest - start[1]) * direction > 0 else {rest}
    assert min(abs(q - x) for x in expected) < 0.01


@each("speed", [(0.0, 1.0), (1.0, -1.0), (math.inf, 1.0), (math.nan, 1.0)])
def test_speeds_must_be_positive(speed: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="speeds"):
        JointEstimator(JOINT, speed)


class TestStateEstimator:
    spec = DEX1_1.spec(Side.LEFT, io_rate=5.0)

    def test_predicted_state_is_marked_and_keeps_other_fields(self) -> None:
        e = StateEstimator(self.spec, [(2.0, 2.0)])
        assert e.predict(0.0) is None
        e.measure(HandState.from_values(1.0, stamp=0.0, tau_est=-0.5, temperature=31.0), 0.0)
        e.follow(HandCommand.position(4.0), 0.0)
        state = e.predict(0.5)
        assert state is not None
        assert state.q == pytest.approx(2.0)
        assert state.dq == pytest.approx(2.0)
        assert not state.measured
        assert state.stamp == 0.0
        assert (state.tau_est[0], state.temperature[0]) == (-0.5, 31.0)

    @pytest.mark.parametrize(
        "command", [HandCommand.brake(1), HandCommand.position(4.0, kp=0.0)], ids=["brake", "limp"]
    )
    def test_brake_and_limp_move_nothing(self, command: HandCommand) -> None:
        e = StateEstimator(self.spec, [(2.0, 2.0)])
        e.measure(HandState.from_values(1.0, stamp=0.0), 0.0)
        e.follow(command, 0.0)
        state = e.predict(1.0)
        assert state is not None
        assert np.array_equal(state.q, [1.0])

    def test_wrong_number_of_joint_speeds_is_refused(self) -> None:
        with pytest.raises(UsageError, match="2 pairs"):
            StateEstimator(self.spec, [(1.0, 1.0), (1.0, 1.0)])

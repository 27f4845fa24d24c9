"""The model of Unitree's teleoperation clients against their recordings, without I/O."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.conformance.kit.recording import Recording
from dexkit.errors import UsageError
from dexkit.hand import Floats, Side
from dexkit.models import BUILT_IN, DEX3_1, DIALECTS, MODELS
from dexkit.teleop import (
    Dex1Client,
    JointCommand,
    Operator,
    Pose,
    Profile,
    Release,
    StateReceiver,
    StickyFilter,
    client_for,
    profile,
    profiles_for,
    recorded,
    tracking_figures,
)
from dexkit.teleop.client import LEAD, PINCH_MAX, PINCH_MIN, POLL_PAUSE
from dexkit.teleop.client_codec import ClientCodec
from dexkit.traces import open_trace, sample_path
from tests.each import each

LEFT, RIGHT = Side.LEFT, Side.RIGHT
GO = DIALECTS["unitree_go"]
SHIPPED = [each for hand in BUILT_IN for each in profiles_for(hand.name)]
angles = st.floats(0.0, 5.4)
pinches = st.floats(0.0, 12.0)


@cache
def recording(name: str) -> Recording:
    return Recording.decode(open_trace(sample_path(name)))


def q_of(commands: Mapping[Side, tuple[JointCommand, ...]], side: Side) -> float:
    return commands[side][0].q


# ------------------------------------------------------------------------ the receiving thread


def test_states_are_read_left_then_right_and_kept_until_both_are_there() -> None:
    receiver = StateReceiver([(LEFT,), (RIGHT,)])
    receiver.receive(0.0, {RIGHT: (1.0,)})
    assert receiver.latest == {}
    receiver.receive(0.5, {LEFT: (2.0,)})
    assert receiver.latest == {LEFT: (2.0,), RIGHT: (1.0,)}
    assert receiver.wakes_at == 0.5 + POLL_PAUSE


def test_receiver_pauses_after_both_sides_and_takes_the_newest() -> None:
    receiver = StateReceiver([(LEFT,), (RIGHT,)])
    receiver.receive(0.0, {LEFT: (0.0,)})
    receiver.receive(0.0, {RIGHT: (0.0,)})
    for i in (1, 2, 3):  # within the pause; of these the last one is kept
        receiver.receive(0.0005 * i, {LEFT: (float(i),)})
        receiver.receive(0.0005 * i, {RIGHT: (10.0 * i,)})
    assert receiver.latest[LEFT] == (0.0,)
    receiver.advance(POLL_PAUSE)
    assert receiver.latest == {LEFT: (3.0,), RIGHT: (30.0,)}


def test_silent_side_freezes_the_other_side() -> None:
    receiver = StateReceiver([(LEFT,), (RIGHT,)])
    receiver.receive(0.0, {LEFT: (1.0,)})
    receiver.receive(0.0, {RIGHT: (1.0,)})
    for i in range(1, 100):
        receiver.receive(i * 0.01, {RIGHT: (1.0 + i,)})
    assert receiver.latest == {LEFT: (1.0,), RIGHT: (1.0,)}
    receiver.receive(1.0, {LEFT: (2.0,)})
    assert receiver.latest == {LEFT: (2.0,), RIGHT: (100.0,)}


def test_left_state_is_old_after_silence_of_the_right_side() -> None:
    receiver = StateReceiver([(LEFT,), (RIGHT,)])
    receiver.receive(0.0, {LEFT: (1.0,)})
    receiver.receive(0.0, {RIGHT: (1.0,)})
    for i in range(1, 100):
        receiver.receive(i * 0.01, {LEFT: (1.0 + i,)})
    receiver.receive(1.0, {RIGHT: (5.0,)})
    assert receiver.latest == {LEFT: (2.0,), RIGHT: (5.0,)}


@given(
    st.lists(st.tuples(st.floats(0.0, 0.004), st.sampled_from([LEFT, RIGHT]), angles), max_size=60)
)
def test_states_read_were_published_and_are_in_order(
    arrivals: list[tuple[float, Side, float]],
) -> None:
    receiver = StateReceiver([(LEFT,), (RIGHT,)])
    now, count = 0.0, {LEFT: 0, RIGHT: 0}
    before = {LEFT: 0.0, RIGHT: 0.0}
    for wait, side, _ in arrivals:
        now += wait
        count[side] += 1
        receiver.receive(now, {side: (float(count[side]),)})
        for s, (number,) in receiver.latest.items():
            assert before[s] <= number <= count[s]
            before[s] = number
        assert bool(receiver.latest) <= (count[LEFT] > 0 and count[RIGHT] > 0)


# ----------------------------------------------------------------------------------- the filter


def test_filter_weights_the_newest_value_most() -> None:
    smooth = StickyFilter()
    assert smooth((1.0,)) == (1.0,)
    assert smooth((2.0,)) == (2.0,)
    assert smooth((3.0,)) == pytest.approx((0.5 * 3 + 0.3 * 2 + 0.2 * 1,))


def test_filter_ignores_repeated_values() -> None:
    smooth = StickyFilter()
    values = [smooth((x,)) for x in (2.4, 2.6, 2.7, 2.7, 2.7, 2.7)]
    assert values[-1] == values[2] != (2.7,)


def test_filter_is_updated_for_both_hands_when_one_moves() -> None:
    smooth = StickyFilter()
    for x in (0.0, 1.0, 2.0, 3.0, 4.0):
        out = smooth((min(x, 2.0), x))
    assert out[0] == pytest.approx(2.0)


@given(st.lists(st.tuples(angles, angles), min_size=1, max_size=40))
def test_the_filter_stays_between_the_last_three_different_values(
    values: list[tuple[float, float]],
) -> None:
    smooth = StickyFilter()
    distinct: list[tuple[float, float]] = []
    for value in values:
        out = smooth(value)
        if not distinct or value != distinct[-1]:
            distinct.append(value)
        for column, y in zip(zip(*distinct[-3:], strict=True), out, strict=True):
            assert min(column) - 1e-9 <= y <= max(column) + 1e-9


# ----------------------------------------------------------------------------- the Dex1 client


def ready(client: Dex1Client, left: float = 1.0, right: float = 1.0, now: float = 0.0) -> None:
    client.receive(now, {LEFT: (left,)})
    client.receive(now, {RIGHT: (right,)})


def test_no_command_before_both_states_arrived() -> None:
    client = Dex1Client()
    assert client.missing == {LEFT: "", RIGHT: ""}
    assert client.step(0.0, {LEFT: (1.0,)}, {}) == {}
    assert client.missing == {RIGHT: ""}
    assert not client.ready
    assert set(client.step(0.01, {RIGHT: (0.0,)}, {})) == {LEFT, RIGHT}  # 0 is good enough
    assert client.missing == {}


def test_target_is_mid_stroke_before_any_input() -> None:
    client = Dex1Client()
    ready(client, 2.6, 0.0)
    commands = client.step(0.01, {}, {})
    assert q_of(commands, LEFT) == 2.7  # within the lead
    assert q_of(commands, RIGHT) == LEAD


def test_client_leaves_an_end_stop_although_targets_near_it_mean_the_end() -> None:
    """In unitree_hg the lead from an end alone would stay where it means that end."""
    hg = DIALECTS["unitree_hg"]
    (closed, opened), q_open = hg.ends, hg.q_open
    for rest in (-0.02, 0.0, closed, opened, q_open, q_open + 0.05):
        client = Dex1Client(hg, [LEFT])
        pinch, goal = (PINCH_MAX, q_open) if rest <= closed else (PINCH_MIN, 0.0)
        away = PINCH_MIN if rest <= closed else PINCH_MAX
        here, now = rest, 0.0
        for step in range(400):  # at rest for a while, then 1.5 s to the other end
            now += client.period
            wanted = pinch if step >= 100 else away
            command = q_of(client.step(now, {LEFT: (here,)}, {LEFT: (wanted,)}), LEFT)
            obeyed = 0.0 if command <= closed else q_open if command >= opened else command
            # what its filter keeps of a rest lets it leave with the first command that it counts
            assert step != 100 or abs(obeyed - rest) > 0.05
            if step >= 100:
                here += min(max(obeyed - here, -0.05), 0.05)
        assert here == pytest.approx(goal, abs=1e-9)


def test_only_q_and_the_gains_are_set() -> None:
    client = Dex1Client()
    ready(client)
    (command,) = client.step(0.01, {}, {})[LEFT]
    assert (command.mode, command.dq, command.tau) == (0, 0.0, 0.0)
    assert (command.kp, command.kd) == (5.0, 0.05)


def test_input_of_one_hand_closes_the_other() -> None:
    client = Dex1Client()
    ready(client)
    client.step(0.01, {}, {LEFT: (PINCH_MAX,)})
    assert client.targets == {LEFT: 5.4, RIGHT: 0.0}


def test_target_is_kept_when_input_ends() -> None:
    client = Dex1Client()
    ready(client)
    client.step(0.01, {}, {LEFT: (6.5,), RIGHT: (6.0,)})
    before = dict(client.targets)
    client.step(0.02, {}, {LEFT: None, RIGHT: None})
    assert client.targets == before == {LEFT: pytest.approx(4.05), RIGHT: pytest.approx(2.7)}


def test_newest_release_holds_position_without_input() -> None:
    client = Dex1Client(release=Release.NEWEST)
    ready(client, 4.0, 0.5)
    commands = client.step(0.01, {}, {})
    assert (q_of(commands, LEFT), q_of(commands, RIGHT)) == (4.0, 0.5)


def test_release_1_1_waits_for_a_position_that_is_not_zero() -> None:
    client = Dex1Client(DIALECTS["unitree_actuator"])
    assert client.release is Release.V1_1
    client.receive(0.0, {LEFT: (0.0,), RIGHT: (0.0,)})
    assert client.missing == {LEFT: "every q is exactly 0", RIGHT: "every q is exactly 0"}
    client.receive(0.01, {LEFT: (0.0,), RIGHT: (0.1,)})
    assert client.ready


def test_simulation_mode_neither_clips_nor_filters() -> None:
    client = Dex1Client(simulated=True)
    ready(client)
    commands = client.step(0.01, {}, {LEFT: (PINCH_MAX,), RIGHT: (PINCH_MIN,)})
    assert (q_of(commands, LEFT), q_of(commands, RIGHT)) == (5.4, 0.0)


def test_one_sided_client_waits_for_that_side_only() -> None:
    client = Dex1Client(sides=[RIGHT])
    assert set(client.step(0.0, {RIGHT: (0.3,)}, {})) == {RIGHT}


@given(st.lists(st.tuples(angles, angles, pinches, pinches), min_size=1, max_size=40))
def test_a_command_is_within_the_lead_of_the_last_three_states(
    steps: list[tuple[float, float, float, float]],
) -> None:
    client = Dex1Client()
    seen: list[tuple[float, float]] = []
    for i, (left, right, *pinch) in enumerate(steps):
        ready(client, left, right, now=0.005 * i)
        commands = client.step(
            0.005 * i, {}, {s: (p,) for s, p in zip((LEFT, RIGHT), pinch, strict=True)}
        )
        seen.append((client.receiver.latest[LEFT][0], client.receiver.latest[RIGHT][0]))
        for k, side in enumerate((LEFT, RIGHT)):
            states = [pair[k] for pair in seen]
            low, high = min(states) - LEAD, max(states) + LEAD
            assert low - 1e-9 <= q_of(commands, side) <= high + 1e-9
            assert 0.0 <= client.targets[side] <= 5.4


# --------------------------------------------------- value for value against the genuine client


def test_commands_equal_the_recorded_ones_before_any_input() -> None:
    """The first seven seconds of the startle recording, where the input is known to be 0.

    Which recorded state the genuine client had at each step is not in the recording, so it is any
    of the last 20 ms; everything else must follow. 1300 pairs of commands, to float32's accuracy.
    """
    rec = recording("dex1_idle_then_startle")
    views = {s: rec.sides[s] for s in (LEFT, RIGHT)}
    smooth = StickyFilter()
    worst = 0.0
    count = int(np.searchsorted(views[LEFT].commands.t, views[LEFT].commands.t[0] + 6.9))
    for i in range(count):
        goals: list[list[float]] = []
        for view in views.values():
            t = view.commands.t[i]
            rows = view.states.between(t - 0.02, t)
            states = np.unique(view.states.q[rows, 0])
            goals.append(sorted({float(min(max(2.7, q - LEAD), q + LEAD)) for q in states}))
        sent = [float(view.commands.q[i, 0]) for view in views.values()]
        best: tuple[float, StickyFilter] | None = None
        for left in goals[0]:
            for right in goals[1]:
                trial = copy.deepcopy(smooth)
                out = trial((left, right))
                error = max(abs(a - b) for a, b in zip(out, sent, strict=True))
                if best is None or error < best[0]:
                    best = (error, trial)
        assert best is not None
        worst, smooth = max(worst, best[0]), best[1]
    assert count > 1300
    assert worst < 5e-7


def test_commands_equal_the_recorded_ones_for_the_recorded_states() -> None:
    """The same with the model's own receiving thread; one state earlier or later is 0.013 rad."""
    rec = recording("dex1_idle_then_startle")
    events: list[tuple[float, int, Side | int, float]] = []
    for side in (LEFT, RIGHT):
        states = rec.sides[side].states
        events += [(t, 0, side, float(q)) for t, q in zip(states.t, states.q[:, 0], strict=True)]
    commands = {s: rec.sides[s].commands for s in (LEFT, RIGHT)}
    end = commands[LEFT].t[0] + 6.9
    events += [(float(t) - 2e-4, 1, i, 0.0) for i, t in enumerate(commands[LEFT].t) if t < end]
    client = Dex1Client()
    errors: list[float] = []
    for t, kind, what, q in sorted(events, key=lambda e: e[:2]):
        if kind == 0:
            assert isinstance(what, Side)
            client.receive(t, {what: (q,)})
            continue
        assert isinstance(what, int)
        sent, last = client.step(t, {}, {}), what
        errors += [abs(q_of(sent, s) - float(commands[s].q[what, 0])) for s in (LEFT, RIGHT)]
    found = np.array(errors)
    assert len(found) > 2600
    assert (found < 1e-6).mean() > 0.9  # measured 0.954
    assert found.max() < 0.015
    # it sticks where the genuine one stuck, not at the target of 2.7
    assert q_of(sent, LEFT) == pytest.approx(float(commands[LEFT].q[last, 0]), abs=1e-6)
    assert q_of(sent, LEFT) != pytest.approx(2.7, abs=1e-4)


def test_a_silent_hand_freezes_both_commands_as_recorded() -> None:
    """The dropout recording: two distinct values of each command in 1.5 s without left state.

    The operator's input of that recording is not known; what it cannot change is that both
    states stand still, so that a constant input gives one value, and each new one at most one.
    """
    rec = recording("dex1_hand_dropout")
    client = Dex1Client()
    events: list[tuple[float, Side, float]] = []
    for side in (LEFT, RIGHT):
        states = rec.sides[side].states
        events += [(t, side, float(q)) for t, q in zip(states.t, states.q[:, 0], strict=True)]
    events.sort(key=lambda e: e[0])
    resumes = max(t for t, s, _ in events if s is LEFT and t < 11.5 and t > 9.0)
    gap = np.diff(rec.sides[LEFT].states.t)
    begin = float(rec.sides[LEFT].states.t[int(gap.argmax())])
    assert gap.max() > 1.4
    assert resumes > begin
    sent: list[Pose] = []
    next_step = begin + 0.1
    for t, side, q in events:
        client.receive(t, {side: (q,)})
        while next_step <= t and next_step < begin + 1.4:
            out = client.step(next_step, {}, {LEFT: (5.2,), RIGHT: (6.8,)})
            sent.append((q_of(out, LEFT), q_of(out, RIGHT)))
            next_step += 0.005
    assert len(sent) > 250
    assert len(set(sent)) == 1
    for side in (LEFT, RIGHT):
        recorded_q = rec.sides[side].commands
        inside = (recorded_q.t > begin + 0.1) & (recorded_q.t < begin + 1.4)
        assert len(np.unique(recorded_q.q[inside, 0])) <= 2


# ----------------------------------------------------------------------------- the Dex3 client


def pose(value: float) -> tuple[float, ...]:
    return (0.0,) * 6 + (value,)


def test_a_dex3_client_waits_for_a_position_that_is_not_zero_on_both_sides() -> None:
    client = client_for("dex3")
    client.receive(0.0, {LEFT: pose(0.0)})
    client.receive(0.0, {RIGHT: pose(0.1)})
    assert client.missing == {LEFT: "every q is exactly 0"}
    assert client.step(0.01, {}, {}) == {}
    client.receive(0.02, {LEFT: pose(1e-4)})
    client.receive(0.02, {RIGHT: pose(0.1)})
    assert client.ready


def test_dex3_commands_are_the_targets_independent_of_the_state() -> None:
    client = client_for("dex3")
    client.receive(0.0, {LEFT: pose(0.1)})
    client.receive(0.0, {RIGHT: pose(0.1)})
    first = client.step(0.01, {}, {LEFT: pose(9.0)})  # one hand alone is no input
    assert [m.q for m in first[LEFT]] == [0.0] * 7
    targets = {s: tuple(0.1 * i for i in range(7)) for s in Side}
    commands = client.step(0.02, {}, targets)
    assert [m.mode for m in commands[RIGHT]] == list(range(0x10, 0x17))
    assert tuple(m.q for m in commands[RIGHT]) == targets[RIGHT]
    assert {(m.dq, m.tau, m.kp, m.kd) for m in commands[LEFT]} == {(0.0, 0.0, 1.5, 0.2)}
    assert client.step(0.03, {}, {}) == commands


def test_the_recorded_dex3_commands_are_those_of_the_model() -> None:
    rec = recording("dex3_pinch")
    wire = ClientCodec(DIALECTS["dex3"])
    for side in (LEFT, RIGHT):
        topic = wire.command_topics[side]
        payloads = open_trace(sample_path("dex3_pinch")).load([topic])[topic].payloads
        client = client_for("dex3", [side])
        client.receive(0.0, {side: pose(0.1)})
        for i in range(0, len(payloads), 50):
            targets = tuple(float(x) for x in rec.sides[side].commands.q[i])
            ((_, data),) = wire.encode(client.step(0.01 * i, {}, {side: targets}))
            assert data == payloads[i]


def test_the_recorded_dex1_commands_are_encoded_alike() -> None:
    wire = ClientCodec(GO)
    topic = wire.command_topics[LEFT]
    payloads = open_trace(sample_path("dex1_pick_place")).load([topic])[topic].payloads
    q = recording("dex1_pick_place").sides[LEFT].commands.q[:, 0]
    client = Dex1Client(sides=[LEFT], simulated=True)
    client.receive(0.0, {LEFT: (1.0,)})
    for i in range(0, len(payloads), 200):
        pinch = PINCH_MIN + float(q[i]) / 5.4 * (PINCH_MAX - PINCH_MIN)
        (command,) = client.step(0.01 * i, {}, {LEFT: (pinch,)})[LEFT]
        assert command.q == pytest.approx(float(q[i]), abs=1e-6)
        ((_, data),) = wire.encode({LEFT: [command._replace(q=float(q[i]))]})
        assert data == payloads[i]


@each("name", list(DIALECTS))
def test_positions_are_decoded(name: str) -> None:
    from dexkit.conformance.kit.motor_messages import MotorCodec

    spoken = DIALECTS[name]
    joints = len(MODELS[spoken.model].joints[LEFT])
    kit, wire = MotorCodec(spoken), ClientCodec(spoken)
    wanted: dict[Side, Sequence[float]] = {
        LEFT: [0.25 * (i + 1) for i in range(joints)],
        RIGHT: [2.0 + 0.25 * i for i in range(joints)],
    }
    groups = [(LEFT, RIGHT)] if kit.shared else [(LEFT,), (RIGHT,)]
    found: dict[Side, Pose] = {}
    for sides in groups:
        data = kit.state_payload({s: [{"q": q} for q in wanted[s]] for s in sides})
        found |= wire.positions(kit.state_topics[sides[0]], data)
    assert found == {s: tuple(q) for s, q in wanted.items()}


# ----------------------------------------------------------------------- operators and profiles


@each("chosen", SHIPPED, ids=lambda p: f"{p.model}-{p.name}")
def test_a_profile_stays_within_the_limits_and_begins_without_input(chosen: object) -> None:
    assert isinstance(chosen, Profile)
    spoken = MODELS[chosen.model].dialects[0]
    operator = Operator(chosen, spoken)
    assert operator.inputs(0.0, Side) == {LEFT: None, RIGHT: None}
    moved: dict[Side, set[Pose]] = {LEFT: set(), RIGHT: set()}
    for i in range(int(chosen.duration / 0.01)):
        for side in Side:
            wanted = operator.intent(i * 0.01, side)
            if wanted is None:
                assert i * 0.01 < chosen.lead_in
                continue
            moved[side].add(wanted)
            limits = [(j.q_min, j.q_max) for j in MODELS[chosen.model].joints[side]]
            assert len(wanted) == len(limits)
            assert all(a - 1e-9 <= q <= b + 1e-9 for q, (a, b) in zip(wanted, limits, strict=True))
    assert len(moved[LEFT]) >= 2
    assert len(moved[RIGHT]) >= 2


def test_the_client_gets_the_input_at_thirty_hertz() -> None:
    operator = Operator(profile("sine", "dex1-1"), GO)
    values = {operator.inputs(0.5 + i * 0.001, [LEFT])[LEFT] for i in range(1000)}
    assert 29 <= len(values) <= 31


def test_object_limits_the_stroke_of_a_profile() -> None:
    operator = Operator(profile("full-stroke", "dex1-1"), GO, most={RIGHT: 0.5})
    assert operator.intent(0.6, LEFT) == (0.0,)
    assert operator.intent(0.6, RIGHT) == pytest.approx((2.7,))
    assert operator.intent(2.6, RIGHT) == (5.4,)


def test_a_recording_is_a_profile() -> None:
    series = {LEFT: ([0.0, 1.0], [(1.0,), (2.0,)])}
    operator = Operator(recorded("mine", GO, series), GO)
    assert operator.intent(0.4, LEFT) is None
    assert operator.intent(0.6, LEFT) == (1.0,)
    assert operator.intent(1.6, LEFT) == (2.0,)
    assert operator.intent(1.6, RIGHT) is None
    with pytest.raises(UsageError):
        recorded("nothing", GO, {})


def test_profile_of_another_model_is_refused_and_names_are_listed() -> None:
    with pytest.raises(UsageError, match="no profile"):
        profile("fist", "dex1-1")
    with pytest.raises(UsageError) as caught:
        Operator(profile("fist", "dex3-1"), GO)
    assert "is for a Dex3-1 hand" in caught.value.message
    assert {p.name for p in profiles_for(DEX3_1.name)} >= {"pinch", "fist", "startle"}
    with pytest.raises(UsageError):
        client_for("dex3", simulated=True)


# ---------------------------------------------------------------------------------- the figures


def first_order(
    wanted: Callable[[float], float], *, delay: float, tau: float, end: float
) -> tuple[Floats, Floats]:
    """Times and positions of a hand that follows with a delay and a time constant."""
    t: Floats = np.asarray(np.arange(0.0, end, 0.002))
    q: Floats = np.empty_like(t)
    here = 0.0
    for i, now in enumerate(t):
        goal = wanted(float(now) - delay)
        here += (goal - here) * 0.002 / tau if tau else goal - here
        q[i] = here
    return t, q


def test_stroke_time_of_a_first_order_hand() -> None:
    def wanted(t: float) -> float:
        return 5.4 if t >= 1.0 else 0.0

    found = tracking_figures(*first_order(wanted, delay=0.0, tau=0.1, end=3.0), wanted, 5.4)
    # from 5 to 95 % of the way: ln(0.95 / 0.05) time constants
    assert found.stroke_s == pytest.approx(0.1 * math.log(19), abs=0.01)
    assert found.overshoot == 0.0
    assert found.stuck < 1e-3
    assert math.isnan(found.lag_s)


def test_delay_is_measured_as_lag_and_reaction() -> None:
    def slow(t: float) -> float:
        return 2.7 + 2.0 * math.sin(1.5 * t)

    found = tracking_figures(*first_order(slow, delay=0.12, tau=0.0, end=6.0), slow, 5.4)
    assert found.lag_s == pytest.approx(0.12, abs=0.004)

    def step(t: float) -> float:
        return 4.0 if t >= 1.0 else 0.0

    found = tracking_figures(*first_order(step, delay=0.12, tau=0.01, end=3.0), step, 5.4)
    assert found.reaction_s == pytest.approx(0.12, abs=0.01)


def test_reaction_of_a_joint_that_is_still_on_its_way_is_when_it_has_turned() -> None:
    """A tenth of the range after the operator: it goes on for 0.06 s, and brakes for 0.02 s."""
    t: Floats = np.asarray(np.arange(0.0, 2.0, 0.002))
    q = np.interp(t, [0.0, 0.9, 1.06, 1.08, 2.0], [2.0, 2.0, 3.6, 3.6, 2.0])
    found = tracking_figures(t, q, lambda x: 2.0 if x >= 1.0 else 4.0, 5.4)
    turned = 1.08 - 1.0 + 0.02 * 5.4 / (1.6 / 0.92)
    assert found.steps[-1].reaction_s == pytest.approx(turned, abs=0.004)


def test_hand_at_rest_has_infinite_stroke_time_and_lag() -> None:
    t: Floats = np.asarray(np.arange(0.0, 4.0, 0.002))
    still = tracking_figures(t, np.zeros_like(t), lambda x: 5.4 if x > 1 else 0.0, 5.4)
    assert still.stroke_s == math.inf
    assert math.isnan(still.reaction_s)
    assert still.stuck == pytest.approx(5.4)
    moving = tracking_figures(t, np.zeros_like(t), lambda x: 2.7 + math.sin(3 * x), 5.4)
    assert math.isinf(moving.lag_s)
    assert math.isnan(moving.lag_rms)


@given(st.lists(st.floats(-10, 10), min_size=0, max_size=50), st.floats(0.1, 6.0))
def test_figures_are_never_negative(values: list[float], goal: float) -> None:
    t: Floats = np.asarray(np.arange(len(values)) * 0.05)
    found = tracking_figures(t, np.array(values), lambda x: goal if x > 0.5 else None, 5.4)
    assert all(x >= 0.0 for x in found.figures().values())


# --------------------------------------------------------------- what the rate of states does


@pytest.mark.parametrize(
    ("rate", "seconds"), [(30.0, 2.24), (200.0, 0.565)], ids=["30 Hz", "200 Hz"]
)
def test_stroke_time_equals_the_published_measurement(rate: float, seconds: float) -> None:
    """The emulated EZGripper behind the service, in virtual time; docs/service.md."""
    feedback = pytest.importorskip("benchmarks.bench_feedback")
    from dexkit.clock import ManualClock
    from dexkit.hand import HandCommand
    from dexkit.models import DEX1_1
    from dexkit.service.hand_core import Estimation, HandCore

    clock = ManualClock()
    gripper = feedback.VirtualGripper(clock)
    spec = DEX1_1.spec(LEFT, io_rate=rate)
    core = HandCore(spec, DEX1_1, clock, estimation=Estimation.OFF, soft_start=False)
    core.opened(spec, None)
    client = Dex1Client(sides=[LEFT])
    client.receive(clock.now(), {LEFT: (gripper.q,)})
    every = {hz: round(1.0 / hz / feedback._TICK) for hz in (rate, DEX1_1.state_rate, client.rate)}

    def step(i: int) -> None:
        if i % every[rate] == 0:
            core.measured(gripper.exchange(core.next_command()))
        if i % every[DEX1_1.state_rate] == 0:
            view = core.view()
            assert view is not None
            client.receive(clock.now(), {LEFT: tuple(view.state.q.tolist())})
        if i % every[client.rate] == 0:
            command = client.step(clock.now(), {}, {LEFT: (PINCH_MAX,)})[LEFT][0]
            core.submit(HandCommand.position(command.q))

    assert feedback._stroke_time(clock, gripper, step) == pytest.approx(seconds, abs=0.03)

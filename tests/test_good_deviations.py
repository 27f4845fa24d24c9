"""Test that the deviations of generated good hands break no requirement themselves."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest

from dexkit.conformance.faults import generated
from dexkit.conformance.faults.generated import Fault, Generated, dialects, parse
from dexkit.conformance.faults.generated.good import DEVIATIONS, GROUPS
from dexkit.conformance.faults.generated.rig import Faulty, Part, Report, What, compose
from dexkit.conformance.faults.generated.times import WHENS
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.virtual import Sample
from dexkit.errors import UsageError
from dexkit.hand import Floats, Side
from dexkit.models import Dialect, dialect, model
from tests.each import each

TIMING = [("", *GROUPS["state"]), ("", *GROUPS["latency"])]
"""The groups that change when commands are obeyed and states leave."""
SOME = 4
"""One combination in so many is tried in a short run of the tests."""
RESTARTS = 40
"""Lives of a service, each a state longer than the one before."""
LONG_S = 5.2
"""Seconds of the last life: there are two pauses in it."""


def combinations(spoken: Dialect) -> Iterator[Generated]:
    """All hands with deviations of timing, in both orders of the names."""
    for chosen in product(*TIMING):
        whats = [Fault(w) for w in chosen if w]
        for faults in (whats, whats[::-1]) if len(whats) > 1 else (whats,) if whats else ():
            yield Generated(spoken, tuple(faults))


def started(hand: Generated) -> Faulty:
    return hand.service()(hand.dialect, tuple(Side), {})


def timed(hand: Generated) -> type[Faulty]:
    """A hand's service with empty states, which are made much sooner."""

    class Empty(hand.service()):  # type: ignore[misc]
        def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
            return b""

        def live(self, dt: float) -> None:
            for side in self.sides:
                self._refresh(side)

    return Empty


def states(found: list[tuple[float, Sample]], topic: str) -> tuple[Floats, Floats]:
    """Source and receive times of a topic's states, s."""
    mine = [(s.sent, now) for now, s in found if s.topic == topic]
    return np.array([sent for sent, _ in mine]), np.array([now for _, now in mine])


def lives(hand: Generated) -> tuple[list[tuple[float, Sample]], float]:
    """All that a service publishes which is ended and started again many times, with the time of
    each sample; and when the last life begins.
    """
    found: list[tuple[float, Sample]] = []
    now = 0.0
    made = timed(hand)
    for periods in range(1, RESTARTS + 1):
        service = made(hand.dialect, tuple(Side), {})
        service.begin(now)
        for _ in range(periods * round(service.period / service.tick)):
            found += [(service.now, s) for s in service.advance(service.tick)]
        found += [(service.now, s) for s in service.end()]
        now = service.now + 0.01
    service = made(hand.dialect, tuple(Side), {})
    service.begin(now)
    for _ in range(round(LONG_S / service.tick)):
        found += [(service.now, s) for s in service.advance(service.tick)]
    return found, now


@pytest.mark.parametrize(
    "one_in", [SOME, pytest.param(1, marks=pytest.mark.soak)], ids=["some", "all"]
)
@pytest.mark.parametrize("spoken", dialects(), ids=lambda d: f"{d.model}-{d.name}")
def test_states_leave_in_order_and_often_enough(spoken: Dialect, one_in: int) -> None:
    """Over all deviations of timing and their combinations, also where a service ends."""
    tolerances: dict[str, float] = {}
    for requirement in catalogue(spoken.model):
        if "-RATE-" in requirement.id:
            tolerances |= {
                k: float(v)
                for k, v in requirement.tolerances.items()
                if k in ("max_gap_s", "max_interval_s", "max_count", "max_p99_s")
            }
    slowest = model(spoken.model).min_state_rate
    first = dialects().index(spoken) % one_in  # others for each dialect
    for hand in list(combinations(spoken))[first::one_in]:
        found, begin = lives(hand)
        for side in Side:
            sent, received = states(found, spoken.topics(side)[1])
            assert (np.diff(sent) > 0).all(), hand.name
            assert (np.diff(received) >= 0).all(), hand.name
            assert (sent <= received).all(), hand.name
            for clock in (sent, received):
                clock = clock[received >= begin]
                steps = np.diff(clock)
                assert steps.max() <= tolerances["max_gap_s"], hand.name
                if clock is sent:
                    assert np.percentile(steps, 99) <= tolerances["max_p99_s"], hand.name
                ends = np.searchsorted(clock, clock + 1.0)
                counts = (ends - np.arange(len(clock)))[ends < len(clock)]
                assert counts.min() >= slowest, hand.name
                late = clock[1:][steps > tolerances["max_interval_s"]]
                in_a_second = np.searchsorted(late, late + 1.0) - np.arange(len(late))
                assert in_a_second.max(initial=0) <= tolerances["max_count"], hand.name


@pytest.mark.parametrize("spoken", dialects(), ids=lambda d: f"{d.model}-{d.name}")
@pytest.mark.parametrize(("what", "late"), [("state-late-6", 0.006), ("state-late-10", 0.01)])
def test_a_late_state_is_late_once(spoken: Dialect, what: str, late: float) -> None:
    """Also where one message holds both hands."""
    seen: list[float] = []
    reference = under_test(spoken.model).reference.load()

    class Measures(reference):  # type: ignore[misc, valid-type]
        def sample(self, topic: str, sides: tuple[Side, ...]) -> Sample:
            if topic == spoken.topics(Side.RIGHT)[1]:
                seen.append(self.now)
            return Sample(topic, self.state_type, b"", self.now)

    service = compose("x", "", Measures, [Fault(what).part()])(spoken, tuple(Side), {})
    found: list[tuple[float, Sample]] = []
    while len(found) < 200:
        found += [(service.now, s) for s in service.advance(service.tick)]
    _, received = states(found, spoken.topics(Side.RIGHT)[1])
    delays = received - np.array(seen[: len(received)])
    assert (delays > late - 1e-6).all()
    assert (delays < late + service.period).all()


@each("what", ["state-late-10+pauses", "jitter-5", "state-late-6"])
def test_low_rate_copies_are_of_published_states(what: str) -> None:
    hand = parse(f"dex3-1/dex3:{what}")
    service = started(hand)
    topic, low_rate = (
        t.format(side=Side.RIGHT) for t in (hand.dialect.state_topic, hand.dialect.low_rate_topic)
    )
    last, copies = b"", 0
    for _ in range(10_000):
        for sample in service.advance(service.tick):
            if sample.topic == topic:
                last = sample.payload
            elif sample.topic == low_rate:
                assert (sample.payload, sample.sent) == (last, service.now)
                copies += 1
        if service.now > 2.7:
            break
    assert copies > 20


@pytest.mark.parametrize("spoken", dialects(), ids=lambda d: f"{d.model}-{d.name}")
@pytest.mark.parametrize(("what", "part"), [("jitter-2", 0.02), ("jitter-5", 0.05)])
@pytest.mark.parametrize("other", GROUPS["latency"])
def test_a_part_of_the_states_is_a_period_late(
    spoken: Dialect, what: str, part: float, other: str
) -> None:
    faults = sorted((what, other), key=lambda w: DEVIATIONS[w].turn)
    hand = Generated(spoken, tuple(map(Fault, faults)))
    service = timed(hand)(spoken, tuple(Side), {})
    found: list[tuple[float, Sample]] = []
    for _ in range(2000 * round(service.period / service.tick)):
        found += [(service.now, s) for s in service.advance(service.tick)]
    sent, received = states(found, spoken.topics(Side.RIGHT)[1])
    late = received - sent > 0.5 * service.period
    assert 0.5 * part < late.mean() < 1.5 * part
    assert (received - sent < 1.5 * service.period).all()


def test_late_states_are_held_back_when_they_leave() -> None:
    for hand in generated.sample_good(1000, 3, dialects()):
        turns = [f.made.turn for f in hand.faults]
        assert turns == sorted(turns), hand.name


# ----------------------------------------------------------------------------- measurement


@pytest.mark.parametrize("what", ["noise-dq", "noise-tau", "brake-coast"])
def test_a_hand_has_no_noise_on_what_it_does_not_measure(what: str) -> None:
    with pytest.raises(UsageError, match=f"inspire-dfx cannot have '{what}'"):
        parse(f"inspire-dfx/inspire_dfx:{what}")


def test_no_hand_of_a_sample_has_noise_on_what_it_does_not_measure() -> None:
    for hand in generated.sample_good(1000, 4, dialects()):
        measured = under_test(hand.dialect.model).reference.load().measured_members
        assert all(not f.made.needs or f.made.needs in measured for f in hand.faults), hand.name
    needs = {w.needs for w in DEVIATIONS.values()}
    assert needs == {"", "dq", "tau_est"}


class _Adds(What):
    """Adds to every value of a state."""

    def report(self, joint: int, values: Report) -> None:
        values.dq += 1.0
        values.ddq += 1.0
        values.tau += 1.0
        values.mode += 1


def test_what_is_added_to_an_unmeasured_value_is_not_added_to_the_next_state() -> None:
    spoken = dialect("inspire_dfx")
    reference = under_test(spoken.model).reference.load()
    always = Part(_Adds, tuple(Side), None, (WHENS["always"],))
    service = compose("x", "", reference, [always])(spoken, tuple(Side), {})
    service.advance(service.tick)
    payloads = [service.payload(tuple(Side)) for _ in range(50)]
    assert set(payloads) == {payloads[0]}
    found = service.codec.read_state(payloads[0], Side.RIGHT)
    assert found is not None
    assert found[1] == (1.0,) * 6


@pytest.mark.parametrize("name", ["brainco", "inspire_dfx", "unitree_go"])
def test_prediction_goes_on_with_the_speed_of_q(name: str) -> None:
    """Also where dq is a part of the full speed, or is not reported."""
    spoken = dialect(name)
    service = started(Generated(spoken, (Fault("predicts-100"),)))
    predicts, _ = service.whats[Side.RIGHT][0]
    joint, speed = 0, 0.8
    service.velocities = lambda side: (speed,) * 6  # type: ignore[method-assign]
    for step in range(4):
        service.now = 0.002 * step
        values = Report(0.1, 0.5, 0.0, 0.0, 0)
        predicts.report(joint, values)
        assert values.q == pytest.approx(0.1 + speed * service.now)
        assert values.dq == 0.5

"""Test that the deviations of generated good hands break no requirement themselves."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest

from dexkit.conformance.faults.generated import Fault, Generated, dialects, parse
from dexkit.conformance.faults.generated.choices import GROUPS
from dexkit.conformance.faults.generated.rig import Faulty
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.virtual import Sample
from dexkit.errors import UsageError
from dexkit.hand import Floats, Side
from dexkit.models import Dialect, model

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
    "one_in",
    [pytest.param(SOME, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.soak)],
    ids=["some", "all"],
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


# ----------------------------------------------------------------------------- measurement


@pytest.mark.parametrize("what", ["noise-dq", "noise-tau", "brake-coast"])
def test_a_hand_has_no_noise_on_what_it_does_not_measure(what: str) -> None:
    with pytest.raises(UsageError, match=f"inspire-dfx cannot have '{what}'"):
        parse(f"inspire-dfx/inspire_dfx:{what}")

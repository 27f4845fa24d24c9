"""A script that plays to a service in memory sees the time that it has waited for."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dexkit.conformance.faults import plan_for
from dexkit.conformance.stimuli import Send
from dexkit.conformance.virtual.gripper import ReferenceService
from dexkit.conformance.virtual.topic_run import ORIGIN_NS, _Player


@given(
    seconds=st.floats(0, 1000),
    waits=st.lists(st.integers(0, 10_000_000), min_size=1, max_size=20),
)
def test_a_wait_ends_at_its_time_or_later(seconds: float, waits: list[int]) -> None:
    """Otherwise a script that waits for a time again, until it has come, never ends."""
    player = _Player(plan_for(), ReferenceService)
    player.now = seconds  # no multiple of anything
    until = ORIGIN_NS + round(seconds * 1e9)
    for wait in waits:
        until += wait
        seen = player.carry_out(Send([], until)).now_ns
        assert seen >= until
        assert seen - until <= ReferenceService.tick * 1e9 + 1


def test_a_clock_just_short_of_the_time_is_there() -> None:
    player = _Player(plan_for(), ReferenceService)
    player.now = 573.3949999994
    until = ORIGIN_NS + 573_395_000_000
    assert player.carry_out(Send([], until)).now_ns == until

"""Clients of the conformance kit send no burst after a pause."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from dexkit.conformance.kit.motor_messages import MotorCodec
from dexkit.conformance.stimuli import Action, CommandSession, Observation, Plan, Send, script_for
from dexkit.hand import Side
from dexkit.models import DEX1_1
from dexkit.teleop import Dex1Client

GO = DEX1_1.dialects[0]
BOTH = (Side.LEFT, Side.RIGHT)


def driven(phase: str, after: int) -> Iterator[tuple[str, int, Send]]:
    """The script against hands that are where they should be; the kit stands still for 3 s.

    :param phase: in which that happens, after so many of its commands.
    """
    plan = Plan(
        dialect=GO,
        sides=BOTH,
        session=CommandSession.default(GO.model),
        phases=frozenset({"replay"}),
    )
    script = script_for(plan)
    codec = MotorCodec(GO)
    steps = script.run()
    now, count = 0, 0
    q: dict[Side, tuple[float, ...]] = dict.fromkeys(BOTH, (0.0,))
    action: Action = next(steps)
    while True:
        if isinstance(action, Send):
            last = script.phases[-1] if script.phases else None
            name = last.name if last is not None and not last.end_ns else ""
            if action.payloads:
                yield name, now, action
                for topic, payload in action.payloads:
                    side = Side.LEFT if "left" in topic else Side.RIGHT
                    q[side] = (codec.command.decode(payload).cmds[0].q,)
                if name == phase:
                    count += 1
                    if count == after:
                        now += 3_000_000_000
            now = max(now, action.until_ns)
        try:
            action = steps.send(Observation(now, dict(q), dict.fromkeys(BOTH, (0.0,))))
        except StopIteration:
            return


def positions(rows: list[tuple[str, int, Send]], side: str) -> list[float]:
    codec = MotorCodec(GO)
    return [
        float(codec.command.decode(payload).cmds[0].q)
        for _, _, send in rows
        for topic, payload in send.payloads
        if side in topic
    ]


def test_conformance_run_waits_during_a_pause() -> None:
    rows = [row for row in driven("replay", 100) if row[0] == "replay"]
    times = [now for _, now, _ in rows]
    calm = [row for row in driven("replay", -1) if row[0] == "replay"]
    assert len(rows) == len(calm)
    expected = [b - a for (_, a, _), (_, b, _) in itertools.pairwise(calm)]
    found = [b - a for a, b in itertools.pairwise(times)]
    assert [i for i, (a, b) in enumerate(zip(expected, found, strict=True)) if a != b] in ([99], [])
    assert sum(found) >= sum(expected) + 2_900_000_000


def test_approach_of_the_conformance_run_is_limited_in_speed() -> None:
    rows = [row for row in driven("approach", 20) if row[0] == "approach"]
    for side in ("left", "right"):
        q = positions(rows, side)
        assert max(abs(b - a) for a, b in itertools.pairwise(q)) <= 0.6 * 5.4 * 0.25 + 1e-6


def test_restarted_client_forgets_its_earlier_state() -> None:
    client = Dex1Client()
    for k in range(10):
        client.receive(k * 0.01, {Side.LEFT: (0.3,)})
        client.receive(k * 0.01, {Side.RIGHT: (0.3,)})
        client.step(k * 0.01, {}, {Side.LEFT: (5.0 + k / 10,), Side.RIGHT: (5.0 + k / 10,)})
    client.begin_again()
    assert not client.ready
    assert client.step(3.0, {}, {}) == {}
    client.receive(3.1, {Side.LEFT: (5.0,)})
    assert client.step(3.1, {}, {}) == {}
    client.receive(3.2, {Side.RIGHT: (4.0,)})
    commands = client.step(3.2, {}, {})
    assert commands[Side.LEFT][0].q == pytest.approx(5.0 - 0.18)
    assert commands[Side.RIGHT][0].q == pytest.approx(4.0 - 0.18)

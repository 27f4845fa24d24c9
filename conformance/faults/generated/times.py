"""When a fault is there: the conditions of generated hands."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from dexkit.conformance.faults.generated.rig import Faulty, Track, When
from dexkit.hand import Side

__all__ = ["WHENS"]

_LATE = 25.0
"""Seconds after which a fault of the condition ``later`` begins: half of a run."""
_WARM = 5.0
"""Seconds of motion after which a motor counts as warm: some thirty strokes of a gripper."""

_found: dict[str, When] = {}


def _when(
    title: str,
    summary: str,
    test: Callable[[Faulty, Side], bool],
    areas: str = "",
    *,
    both: bool = False,
) -> None:
    _found[title] = When(title, summary, test, frozenset(areas.split()), both)


def _on(test: Callable[[Track, float], bool]) -> Callable[[Faulty, Side], bool]:
    """A condition on the side's own track and the time."""
    return lambda rig, side: test(rig.tracks[side], rig.now)


def _on_other(test: Callable[[Track, float], bool]) -> Callable[[Faulty, Side], bool]:
    """A condition on the other side's."""

    def asked(rig: Faulty, side: Side) -> bool:
        other = rig.other(side)
        return other is not None and test(rig.tracks[other], rig.now)

    return asked


def _near_end(rig: Faulty, side: Side) -> bool:
    def near(joint: int, q: float) -> bool:
        low, high = rig.limits(side, joint)
        return not low + 0.1 * (high - low) < q < high - 0.1 * (high - low)

    return any(near(i, q) for i, q in enumerate(rig.positions(side)))


def _held(rig: Faulty, side: Side) -> bool:
    track = rig.tracks[side]
    return rig.driven(side) and rig.now - track.rest_since > 0.2 and not rig.touching(side)


def _limp(rig: Faulty, side: Side) -> bool:
    motors = rig.tracks[side].motors
    return rig.driven(side) and motors is not None and all(m.kp == 0 for m in motors)


def _two_clients(track: Track, now: float) -> bool:
    return sum(now - t < 0.05 for t in track.client_heard.values()) > 1


_when("always", "always", lambda rig, side: True)
_when("at-first", "in the first 6 s", _on(lambda t, now: now - t.began < 6.0))
_when("later", "after 25 s", _on(lambda t, now: t.began >= 0 and now - t.began > _LATE))
_when("unled", "before the first command", _on(lambda t, now: t.commands == 0), "START")
_when("not-first", "never in the first two motions", _on(lambda t, now: t.motions > 2))
_when("from-8th", "from the eighth motion on", _on(lambda t, now: t.motions >= 8))
_when(
    "once",
    "once, for a second of the fifth motion",
    _on(lambda t, now: t.motions == 5 and now - t.motion_at < 1.0),
)
_when("every-3rd", "in every third motion", _on(lambda t, now: t.motions % 3 == 2))
_when("seldom", "for 0.4 s every 7 s", lambda rig, side: rig.now % 7.0 > 6.6)
_when("moving", "only while it moves", _on(lambda t, now: t.moving))
_when("resting", "only at rest", _on(lambda t, now: now - t.rest_since > 0.2))
_when("contact", "only in contact", lambda rig, side: rig.touching(side), "FORCE SENS HOLD")
_when("held", "only while it is held without contact", _held, "HOLD")
_when("driven", "only while it is driven", lambda rig, side: rig.driven(side))
_when("limp", "only with zero gains", _limp, "GAIN")
_when("near-end", "only near an end of the range", _near_end)
_when(
    "silent",
    "only in silence",
    _on(lambda t, now: t.commands > 0 and now - t.heard > 0.3),
    "WDOG GUARD HOLD",
)
_when("after-silence", "after a silence", _on(lambda t, now: t.silences > 0), "WDOG GUARD")
_when(
    "resuming",
    "for 1.5 s after a silence",
    _on(lambda t, now: now - t.silence_ended < 1.5),
    "WDOG GUARD",
)
_when(
    "after-nan", "after a command that was not finite", _on(lambda t, now: t.not_finite > 0), "SAFE"
)
_when(
    "after-rejected",
    "after a command of another length",
    _on(lambda t, now: t.malformed > 0),
    "SAFE",
)
_when("after-far", "after a command far out of range", _on(lambda t, now: t.far > 0), "SAFE")
_when("after-limp", "after zero gains", _on(lambda t, now: t.limp > 0), "GAIN")
_when("after-foreign", "after a message of another type", _on(lambda t, now: t.foreign > 0), "SAFE")
_when("after-brake", "after it has braked", _on(lambda t, now: t.brakes > 0), "WDOG GUARD MODE")
_when(
    "new-client",
    "for a client that is not the first",
    _on(lambda t, now: t.client != t.first_client),
    "LIFE SAFE",
)
_when("two-clients", "while two clients are there", _on(_two_clients), "SAFE LIFE")
_when(
    "after-restart", "after a restart of the service", lambda rig, side: rig.restarted, "LIFE START"
)
_when(
    "loaded",
    "with more than 300 commands a second",
    _on(lambda t, now: len(t.arrivals) == 32 and now - t.arrivals[0] < 0.107),
    "LOAD",
)
_when(
    "other-moves",
    "while the other hand moves",
    _on_other(lambda t, now: t.moving),
    "SIDE",
    both=True,
)
_when(
    "other-rests",
    "while the other hand rests",
    _on_other(lambda t, now: now - t.rest_since > 0.2),
    "SIDE",
    both=True,
)
_when("warm", "when it is warm", _on(lambda t, now: t.moved > _WARM))

WHENS: Mapping[str, When] = _found
"""Every condition, by name."""

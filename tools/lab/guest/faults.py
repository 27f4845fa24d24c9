"""A fault on a hand that moves: what is seen, how long it takes, and whether anything strays.

The client commands the hand far away, the fault strikes on the way, and the client falls silent at
the same moment. From then on the joints may be between where they were and the far end of the same
motion without a fault, which was seen before, and nowhere else; and after the device is back, no
set-point may reach a motor before the client commands again. The host's record of the emulated
motors says so (:mod:`tools.lab.devices`).
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from tools.lab.guest.bench import Bench, Failed, Serve, wait_for
from tools.lab.guest.client import Client

__all__ = ["Outcome", "Subject", "table"]

_PAUSE = 0.5  # seconds in which nothing may move
_LEARNINGS = 3


@dataclass(frozen=True)
class Outcome:
    """One fault.

    :ivar lost: seconds until the client saw that the device is gone; None if it stayed.
    :ivar back: seconds from the repair to measured states.
    :ivar strayed: the largest motion that nobody commanded, in the record's ``unit``.
    :ivar said: what the service said first.
    """

    lost: float | None
    back: float
    strayed: float
    unit: str
    said: str


@dataclass(frozen=True)
class _Pose:
    """A pose that is commanded (rad), and what the host sees of it, in the record's unit.

    :ivar furthest: the far end of the motion there from the other pose, overshoot included.
    """

    target: Sequence[float]
    rest: Sequence[float]
    furthest: Sequence[float]


@dataclass
class Subject:
    """A served hand, as the faults need it.

    :param device: name of its record on the host.
    :param near: one of the poses it is commanded to, rad.
    :param far: the other; it moves to the one that is farther away.
    :param still: the largest change that is no motion, in the record's unit.
    :param within: how near to a target is there, rad.
    :param unit: the record's, for the report.
    """

    bench: Bench
    service: Serve
    client: Client
    device: str
    near: Sequence[float]
    far: Sequence[float]
    still: float = 0.02
    within: float = 0.15
    unit: str = "rad"
    poses: list[_Pose] = field(default_factory=list, init=False)
    _rests: bool = field(default=False, init=False)  # seen at the end of the last fault

    def move(self, target: Sequence[float]) -> float:
        """Command ``target`` until the hand is there; seconds."""
        self._rests = False
        self.client.go(target)
        return wait_for(
            lambda: self.client.arrived(target, self.within), f"{self.device} does not obey"
        )

    def _settle(self) -> None:
        """Wait until nothing moves. The host says so: states are predicted in between."""

        def still() -> bool:
            begin = self.bench.ask(do="now", device=self.device)["t"]
            time.sleep(_PAUSE)
            seen = self.bench.ask(do="since", device=self.device, t=begin)
            spans = [high - low for low, high in zip(seen["low"], seen["high"], strict=True)]
            return max(spans) < self.still / 2 and not seen["setpoints"]

        wait_for(still, f"{self.device} does not come to rest")

    def _distance(self, place: Sequence[float]) -> float:
        """How far the joints really are from a place, in the record's unit."""
        now: list[float] = self.bench.ask(do="now", device=self.device)["q"]
        return max(abs(q - there) for q, there in zip(now, place, strict=True))

    def learn(self) -> list[_Pose]:
        """See on the host where the hand goes and rests when its poses are commanded.

        A pause of the guest can stop a hand on its way, by its watchdog: the places count only if
        the hand comes to one of them twice.

        :raises Failed: it does not.
        """
        for _ in range(_LEARNINGS):
            places = self._places()
            apart, again = (
                max(abs(a - b) for a, b in zip(places[0]["q"], other["q"], strict=True))
                for other in places[1:]
            )
            if again < 2 * self.still and apart > 3 * self.still:
                return self._poses(places)
        raise Failed(f"{self.device} does not rest where it is commanded to, {_LEARNINGS} times")

    def _places(self) -> list[dict[str, Any]]:
        ask, places = self.bench.ask, []
        for target in (self.near, self.far, self.near):
            start = ask(do="now", device=self.device)["t"]
            self.move(target)
            self._settle()
            places.append(ask(do="since", device=self.device, t=start))
        return places

    def _poses(self, places: Sequence[dict[str, Any]]) -> list[_Pose]:
        poses = []
        for before, after, target in zip(places, places[1:], (self.far, self.near), strict=False):
            # the motion's extreme beyond the place of rest is its overshoot
            furthest = [
                high if to > was else low
                for was, to, low, high in zip(
                    before["q"], after["q"], after["low"], after["high"], strict=True
                )
            ]
            poses.append(_Pose(target, after["q"], furthest))
        return poses

    def begin(self) -> _Pose:
        """Have the hand move, from rest; where it is commanded to."""
        wait_for(lambda: self.client.linked, "the device is not there before the fault")
        if not self.poses:
            self.poses = self.learn()
        if not self._rests:
            self._settle()
        pose = max(self.poses, key=lambda one: self._distance(one.rest))
        start = self.bench.ask(do="now", device=self.device)["q"]
        self._rests = False
        self.client.go(pose.target)
        wait_for(lambda: self._distance(start) > 3 * self.still, f"{self.device} does not move")
        return pose

    def strike(
        self,
        fault: Callable[[], object],
        mend: Callable[[], object] = lambda: None,
        *,
        survived: bool = False,
    ) -> Outcome:
        """Have ``fault`` while it moves, then ``mend``.

        :param survived: the device stays; without it, the client must see that it is gone.
        :raises Failed: it moved uncommanded, or did not come back.
        """
        ask, client = self.bench.ask, self.client
        pose = self.begin()
        begin = self.service.mark()
        at = ask(do="now", device=self.device)
        fault()
        client.silent()
        lost = None if survived else wait_for(lambda: not client.linked, "the loss is not seen")
        mended = time.monotonic()
        mend()
        try:
            wait_for(lambda: client.linked, "the device does not come back")
        except Failed as error:
            raise Failed(f"{error}; {self.service.text(begin)[-600:]}") from error
        back = time.monotonic() - mended
        if survived:
            self._settle()  # the service still ends the motion that was commanded
        seen = ask(do="since", device=self.device, t=at["t"])
        astray = max(
            max(min(q, to) - low, high - max(q, to))
            for q, to, low, high in zip(
                at["q"], pose.furthest, seen["low"], seen["high"], strict=True
            )
        )
        again = ask(do="now", device=self.device)
        time.sleep(_PAUSE)
        after = ask(do="since", device=self.device, t=again["t"])
        moved = max(high - low for low, high in zip(after["low"], after["high"], strict=True))
        said = self.service.said(begin, r"^(WARNING|ERROR)")
        if after["setpoints"] or max(moved, astray) > self.still:
            raise Failed(
                f"uncommanded motion ({self.unit}): {moved:.3f} and {after['setpoints']} "
                f"set-points {after['last']} after the return, {astray:.3f} astray before; {said}"
            )
        self._rests = moved < self.still / 2
        return Outcome(lost, back, max(moved, astray, 0.0), self.unit, said)


def table(outcomes: Sequence[Outcome]) -> str:
    """The outcomes in a line."""
    losses = [o.lost for o in outcomes if o.lost is not None]
    parts = [f"loss seen by the client after {_spread(losses)} s"] if losses else []
    if losses:
        back = _spread([o.back for o in outcomes])
        parts.append(f"measured states {back} s after the repair")
    return (
        "; ".join(parts)
        + f"{'; ' * bool(parts)}uncommanded motion {max(o.strayed for o in outcomes):.4f} "
        f"{outcomes[0].unit} at most, no set-point before a new command; "
        f"it says: {outcomes[0].said or 'nothing'}"
    )


def _spread(values: Sequence[float]) -> str:
    if len(values) == 1:
        return f"{values[0]:.2f}"
    return f"{statistics.median(values):.2f} (median; at most {max(values):.2f})"

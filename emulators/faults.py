"""Faults that an emulated device can be told to have, at a time or at once.

A fault is written ``KIND[@TIME][:KEY=VALUE[,KEY=VALUE...]]``::

    overload@3s                 after 3 s, until the servo is rebooted
    drop:p=0.05                 from the start, each answer is lost with probability 0.05
    corrupt:p=0.01,for=10s      for 10 s, a bit of each answer flips with probability 0.01
    delay@1s:ms=30              from 1 s on, answers come 30 ms late
    unplug@5s:for=2s            the port vanishes at 5 s and comes back 2 s later
    brown-out@4s:volts=8,for=1s

Times count from the moment the emulator is ready. ``for`` limits a fault that can end by
itself; ``id`` picks one servo of several. Chance is seeded, so a run can be repeated.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from dexkit.errors import UsageError

__all__ = ["FAULT_KINDS", "Fault", "FaultKind", "FaultSchedule", "parse_fault"]


@dataclass(frozen=True)
class FaultKind:
    """One kind of fault.

    :param keys: its own keys with their default values.
    :param lasting: it goes on until ``for`` has passed; otherwise it happens once and the
        device keeps the damage.
    :param targets_device: ``id`` picks a device; otherwise it strikes the line.
    """

    name: str
    summary: str
    keys: dict[str, float] = field(default_factory=dict)
    lasting: bool = False
    targets_device: bool = False


FAULT_KINDS: dict[str, FaultKind] = {
    k.name: k
    for k in (
        FaultKind("drop", "answers are lost with probability p", {"p": 1.0}, lasting=True),
        FaultKind("corrupt", "a bit of answers flips with probability p", {"p": 1.0}, lasting=True),
        FaultKind("delay", "answers come ms late", {"ms": 20.0, "p": 1.0}, lasting=True),
        FaultKind("unplug", "the port vanishes", lasting=True),
        FaultKind("overload", "overload error", targets_device=True),
        FaultKind("overheat", "the servo is at c degrees Celsius", {"c": 85.0}, False, True),
        FaultKind("encoder", "motor encoder error", targets_device=True),
        FaultKind("shock", "electrical shock error", targets_device=True),
        FaultKind("stuck", "the mechanism jams", lasting=True, targets_device=True),
        FaultKind("brown-out", "the supply falls to volts", {"volts": 8.0}, True, True),
    )
}

_SPEC = re.compile(r"(?P<kind>[a-z-]+)(?:@(?P<time>[^:]+))?(?::(?P<args>.*))?", re.DOTALL)
_DURATION = re.compile(r"(\d+(?:\.\d*)?|\.\d+)(ms|s)?")


def grammar() -> str:
    """The grammar and the kinds, as help text."""
    kinds = []
    for kind in FAULT_KINDS.values():
        keys = [f"{key}={value:g}" for key, value in kind.keys.items()]
        keys += ["for=TIME"] if kind.lasting else []
        keys += ["id=N"] if kind.targets_device else []
        kinds.append(kind.name + (f" ({', '.join(keys)})" if keys else ""))
    return "KIND[@TIME][:KEY=VALUE,...] with TIME like 3s or 500ms; kinds: " + "; ".join(kinds)


@dataclass(frozen=True)
class Fault:
    """One fault, parsed.

    :param at: seconds after the start.
    :param duration: seconds, or None for ever.
    :param params: the kind's own keys.
    :param device: id of the device it strikes, or None for all.
    """

    kind: str
    at: float = 0.0
    duration: float | None = None
    params: dict[str, float] = field(default_factory=dict)
    device: int | None = None

    def __getitem__(self, key: str) -> float:
        return self.params[key]


def _fail(text: str, why: str) -> UsageError:
    return UsageError(f"fault {text!r}: {why}", hint=grammar())


def _duration(text: str, value: str) -> float:
    match = _DURATION.fullmatch(value.strip())
    if match is None:
        raise _fail(text, f"{value!r} is not a time")
    return float(match[1]) * (1e-3 if match[2] == "ms" else 1.0)


def parse_fault(text: str) -> Fault:
    """The fault that ``text`` describes.

    :raises UsageError: it does not follow the grammar, which the hint states.
    """
    match = _SPEC.fullmatch(text.strip())
    if match is None:
        raise _fail(text, "cannot be read")
    kind = FAULT_KINDS.get(match["kind"])
    if kind is None:
        raise _fail(text, f"there is no kind {match['kind']!r}")
    at = _duration(text, match["time"]) if match["time"] is not None else 0.0
    params = dict(kind.keys)
    duration: float | None = None
    device: int | None = None
    for part in match["args"].split(",") if match["args"] is not None else ():
        key, equals, value = (s.strip() for s in part.partition("="))
        if not equals:
            raise _fail(text, f"{part.strip()!r} is not KEY=VALUE")
        if key == "for" and kind.lasting:
            duration = _duration(text, value)
        elif key == "id" and kind.targets_device:
            if not value.isdecimal() or int(value) > 252:
                raise _fail(text, f"{value!r} is not an id")
            device = int(value)
        elif key in params:
            try:
                params[key] = float(value)
            except ValueError:
                raise _fail(text, f"{key}={value} is not a number") from None
        else:
            raise _fail(text, f"{kind.name} has no key {key!r}")
    if not 0.0 <= params.get("p", 0.0) <= 1.0:
        raise _fail(text, f"p={params['p']:g} is not a probability")
    if not all(0.0 <= v < 1e6 for v in params.values()):
        raise _fail(text, "a value is out of range")
    return Fault(kind.name, at, duration, params, device)


class FaultSchedule:
    """Says which faults begin and end as time passes.

    :param faults: to come, their times counted from ``start``.
    :param start: seconds on the caller's clock.

    :ivar active: faults that are on now.
    """

    def __init__(self, faults: Iterable[Fault] = (), *, start: float = 0.0) -> None:
        self.active: list[Fault] = []
        self._begins: list[tuple[float, Fault]] = []
        self._ends: list[tuple[float, Fault]] = []
        for fault in faults:
            self.add(fault, start)

    def add(self, fault: Fault, start: float) -> None:
        """Plan another fault, its time counted from ``start``."""
        self._begins.append((start + fault.at, fault))
        self._begins.sort(key=lambda entry: entry[0])

    @property
    def next_time(self) -> float | None:
        """When something begins or ends next, or None."""
        times = [time for time, _ in (self._begins[:1] + self._ends[:1])]
        return min(times, default=None)

    def poll(self, now: float) -> list[tuple[Fault, bool]]:
        """What began (True) or ended (False) up to ``now``, in order of time."""
        events: list[tuple[Fault, bool]] = []
        while True:
            following = self.next_time
            if following is None or following > now:
                return events
            if self._ends and self._ends[0][0] <= following:
                _, fault = self._ends.pop(0)
                self.active.remove(fault)
                events.append((fault, False))
                continue
            time, fault = self._begins.pop(0)
            events.append((fault, True))
            if FAULT_KINDS[fault.kind].lasting:
                self.active.append(fault)
                if fault.duration is not None:
                    self._ends.append((time + fault.duration, fault))
                    self._ends.sort(key=lambda entry: entry[0])

    def of(self, kind: str) -> list[Fault]:
        """The active faults of a kind."""
        return [fault for fault in self.active if fault.kind == kind]

"""Faults that can be injected into an emulated device, now or at a given time.

A fault is written ``KIND[@TIME][:KEY=VALUE[,KEY=VALUE...]]``::

    overload@3s                 after 3 s, until the servo is rebooted
    drop:p=0.05                 from the start, each answer is lost with probability 0.05
    corrupt:p=0.01,for=10s      for 10 s, a bit of each answer flips with probability 0.01
    delay@1s:ms=30              from 1 s on, answers come 30 ms late
    unplug@5s:for=2s            the port vanishes at 5 s and comes back 2 s later
    brown-out@4s:volts=8,for=1s

Times count from the moment the emulator is ready. ``for`` limits a fault that can end by
itself; ``id`` picks one servo of several, or one motor of a hand, and ``side`` one hand of two.
Random numbers are seeded, so a run can be repeated.

The fault kinds of each device family: :data:`MX64_FAULTS`, :data:`DEX3_FAULTS`,
:data:`M4010_FAULTS`, :data:`RH56_FAULTS`, :data:`RH56_TCP_FAULTS`, :data:`REVO2_FAULTS`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from dexkit.errors import UsageError
from dexkit.escaping import one_line
from dexkit.hand import Side

__all__ = [
    "DEX3_FAULTS",
    "M4010_FAULTS",
    "MX64_FAULTS",
    "REVO2_FAULTS",
    "RH56_FAULTS",
    "RH56_TCP_FAULTS",
    "Fault",
    "FaultFamily",
    "FaultKind",
    "FaultSchedule",
    "grammar",
    "parse_fault",
]


@dataclass(frozen=True)
class FaultKind:
    """One kind of fault.

    :param keys: its own keys with their default values.
    :param lasting: it lasts until ``for`` has passed; otherwise it happens once and the device
        stays damaged.
    :param targets_device: ``id`` selects a device; otherwise the fault affects the line.
    """

    name: str
    summary: str
    keys: dict[str, float] = field(default_factory=dict)
    lasting: bool = False
    targets_device: bool = False


@dataclass(frozen=True)
class FaultFamily:
    """The faults that one family of emulated devices can have.

    :param kinds: in the order of the help text.
    :param max_id: largest ``id`` that a fault can select.
    :param sided: ``side`` selects one of two devices, for every kind.
    """

    name: str
    kinds: tuple[FaultKind, ...]
    max_id: int
    sided: bool = False

    def kind(self, name: str) -> FaultKind | None:
        """The kind called ``name``, or None."""
        return next((kind for kind in self.kinds if kind.name == name), None)


_DROP = FaultKind("drop", "answers are lost with probability p", {"p": 1.0}, lasting=True)
_CORRUPT = FaultKind("corrupt", "a bit of answers flips with probability p", {"p": 1.0}, True)
_DELAY = FaultKind("delay", "answers come ms late", {"ms": 20.0, "p": 1.0}, lasting=True)
_UNPLUG = FaultKind("unplug", "the port vanishes", lasting=True)
_STUCK = FaultKind("stuck", "the mechanism jams", lasting=True, targets_device=True)

MX64_FAULTS = FaultFamily(
    "mx64",
    (
        _DROP,
        _CORRUPT,
        _DELAY,
        _UNPLUG,
        FaultKind("overload", "overload error", targets_device=True),
        FaultKind("overheat", "the servo is at c degrees Celsius", {"c": 85.0}, False, True),
        FaultKind("encoder", "motor encoder error", targets_device=True),
        FaultKind("shock", "electrical shock error", targets_device=True),
        _STUCK,
        FaultKind("brown-out", "the supply falls to volts", {"volts": 8.0}, True, True),
    ),
    max_id=252,
)
"""Faults of an emulated MX-64; ``id`` is that of a servo on the line."""

DEX3_FAULTS = FaultFamily(
    "dex3",
    (
        _DROP,
        _CORRUPT,
        _DELAY,
        FaultKind("stall", "the bulk IN endpoint halts until the host clears it"),
        FaultKind("stall-out", "the bulk OUT endpoint halts until the host clears it"),
        _UNPLUG,
        FaultKind("silent", "a motor is off its bus: no state, no commands", {}, True, True),
        FaultKind(
            "overheat", "a motor's winding is at c degrees Celsius", {"c": 140.0}, True, True
        ),
        FaultKind("overcurrent", "a motor reports overcurrent", {}, True, True),
        _STUCK,
        FaultKind(
            "press",
            "a pressure sensor, by its place in the state, is pressed with n newtons",
            {"sensor": 0.0, "n": 10.0},
            lasting=True,
        ),
    ),
    max_id=6,
    sided=True,
)
"""Faults of an emulated Dex3-1; ``id`` is a motor's index in the IDL, 0 thumb_0 to 6 index_1."""

M4010_FAULTS = FaultFamily(
    "m4010",
    (
        _DROP,
        _CORRUPT,
        _DELAY,
        FaultKind("short", "answers end after some bytes", {"bytes": 20.0, "p": 1.0}, lasting=True),
        FaultKind(
            "pause",
            "answers pause for ms after some bytes",
            {"ms": 30.0, "bytes": 13.0, "p": 1.0},
            lasting=True,
        ),
        FaultKind(
            "stray",
            "bytes that are nobody's come before and after answers",
            {"before": 1.0, "after": 0.0, "p": 1.0},
            lasting=True,
        ),
        _UNPLUG,
        FaultKind("silent", "a motor is off the line: no data, no commands", {}, True, True),
        FaultKind(
            "overheat", "a motor's winding is at c degrees Celsius", {"c": 140.0}, True, True
        ),
        FaultKind("overcurrent", "a motor reports overcurrent", {}, True, True),
        FaultKind("encoder", "a motor reports an error of its output encoder", {}, True, True),
        _STUCK,
        FaultKind("brown-out", "a motor's supply falls to volts", {"volts": 10.0}, True, True),
    ),
    max_id=1,
)
"""Faults of the Dex1-1's motor; ``id`` is its own, 0 right, 1 left. ``short``, ``pause`` and
``stray`` are those that put the vendor's library out of step (docs/sources/unitree-dex.md#g)."""

RH56_FAULTS = FaultFamily(
    "rh56",
    (
        _DROP,
        _CORRUPT,
        _DELAY,
        _UNPLUG,
        FaultKind("locked", "every joint reports a locked rotor until that is cleared"),
    ),
    max_id=0,
)
"""Faults of an emulated Inspire RH56."""

RH56_TCP_FAULTS = FaultFamily(
    "rh56-tcp", tuple(kind for kind in RH56_FAULTS.kinds if kind is not _CORRUPT), max_id=0
)
"""Faults of an RH56 on TCP, which never delivers corrupted bytes."""

REVO2_FAULTS = FaultFamily("revo2", (_DROP, _CORRUPT, _DELAY, _UNPLUG), max_id=0)
"""Faults of an emulated BrainCo Revo2."""

_SPEC = re.compile(r"(?P<kind>[a-z-]+)(?:@(?P<time>[^:]+))?(?::(?P<args>.*))?", re.DOTALL)
_DURATION = re.compile(r"([0-9]+(?:\.[0-9]*)?|\.[0-9]+)(ms|s)?")
_LONGEST = 1e6
"""Largest time of a planned fault, seconds: eleven days."""


def grammar(family: FaultFamily = MX64_FAULTS) -> str:
    """The grammar and the kinds of a family, as help text."""
    kinds = []
    for kind in family.kinds:
        keys = [f"{key}={value:g}" for key, value in kind.keys.items()]
        keys += ["for=TIME"] if kind.lasting else []
        keys += ["id=N"] if kind.targets_device else []
        kinds.append(kind.name + (f" ({', '.join(keys)})" if keys else ""))
    sides = "; each also side=left|right" if family.sided else ""
    return (
        "KIND[@TIME][:KEY=VALUE,...] with TIME like 3s or 500ms; kinds: " + "; ".join(kinds) + sides
    )


@dataclass(frozen=True)
class Fault:
    """One fault, parsed.

    :param at: seconds after the start.
    :param duration: seconds, or None for no end.
    :param params: the kind's own keys.
    :param device: id of the device that it affects, or None for all.
    :param lasting: it goes on until ``duration`` has passed (:class:`FaultKind`).
    :param side: which of two hands it affects, or None for both.
    """

    kind: str
    at: float = 0.0
    duration: float | None = None
    params: dict[str, float] = field(default_factory=dict)
    device: int | None = None
    lasting: bool = False
    side: Side | None = None

    def __getitem__(self, key: str) -> float:
        return self.params[key]


def _duration(value: str) -> float:
    match = _DURATION.fullmatch(value.strip())
    if match is None:
        raise _Bad(f"{one_line(value, 40)!r} is not a time")
    seconds = float(match[1]) * (1e-3 if match[2] == "ms" else 1.0)
    if seconds > _LONGEST:
        raise _Bad(f"{one_line(value, 40)} is longer than {_LONGEST:g} s")
    return seconds


def parse_fault(text: str, family: FaultFamily = MX64_FAULTS) -> Fault:
    """The fault that ``text`` describes.

    :param family: of the device to be disturbed.
    :raises UsageError: it does not follow the grammar, which the hint states.
    """
    try:
        return _parse(text, family)
    except _Bad as error:
        raise UsageError(f"fault {one_line(text, 80)!r}: {error}", hint=grammar(family)) from None


class _Bad(Exception):
    """Why a specification cannot be read."""


def _parse(text: str, family: FaultFamily) -> Fault:
    match = _SPEC.fullmatch(text.strip())
    if match is None:
        raise _Bad("cannot be read")
    kind = family.kind(match["kind"])
    if kind is None:
        raise _Bad(f"there is no kind {match['kind']!r}")
    at = _duration(match["time"]) if match["time"] is not None else 0.0
    params = dict(kind.keys)
    duration: float | None = None
    device: int | None = None
    side: Side | None = None
    for part in match["args"].split(",") if match["args"] is not None else ():
        key, equals, value = (s.strip() for s in part.partition("="))
        if not equals:
            raise _Bad(f"{part.strip()!r} is not KEY=VALUE")
        if key == "for" and kind.lasting:
            duration = _duration(value)
        elif key == "id" and kind.targets_device:
            # int() rejects digits of other scripts, and thousands of digits
            if not re.fullmatch("[0-9]{1,3}", value) or int(value) > family.max_id:
                raise _Bad(f"{one_line(value, 40)!r} is not an id (0 to {family.max_id})")
            device = int(value)
        elif key == "side" and family.sided:
            try:
                side = Side(value)
            except ValueError:
                raise _Bad(f"{value!r} is not a side") from None
        elif key in params:
            try:
                params[key] = float(value)
            except ValueError:
                raise _Bad(f"{key}={value} is not a number") from None
        else:
            raise _Bad(f"{kind.name} has no key {key!r}")
    if not 0.0 <= params.get("p", 0.0) <= 1.0:
        raise _Bad(f"p={params['p']:g} is not a probability")
    if not all(0.0 <= v < 1e6 for v in params.values()):
        raise _Bad("a value is out of range")
    return Fault(kind.name, at, duration, params, device, kind.lasting, side)


class FaultSchedule:
    """Determines which faults begin and end as time passes.

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
        """Schedule another fault, its time counted from ``start``."""
        self._begins.append((start + fault.at, fault))
        self._begins.sort(key=lambda entry: entry[0])

    @property
    def next_time(self) -> float | None:
        """Time at which a fault begins or ends next, or None."""
        if not self._begins and not self._ends:
            return None
        return min(time for time, _ in (self._begins[:1] + self._ends[:1]))

    def poll(self, now: float) -> list[tuple[Fault, bool]]:
        """The faults that began (True) or ended (False) up to ``now``, in order of time."""
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
            if fault.lasting:
                self.active.append(fault)
                if fault.duration is not None:
                    self._ends.append((time + fault.duration, fault))
                    self._ends.sort(key=lambda entry: entry[0])

    def active_of(self, kind: str) -> list[Fault]:
        """The active faults of a kind."""
        return [fault for fault in self.active if fault.kind == kind]

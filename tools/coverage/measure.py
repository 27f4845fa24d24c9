"""Note what each check of a model reads of a run of its reference."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, cast

import numpy as np

from dexkit.conformance.checks import Context, check_of
from dexkit.conformance.faults.trials import plan_for
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.motor_messages import MotorCodec
from dexkit.conformance.kit.recording import Commands, Recording, SideView, States
from dexkit.conformance.kit.requirements import Requirement, catalogue
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.virtual import run_virtual
from dexkit.hand import Subject
from dexkit.messages import message_type
from dexkit.messages.columns import Columns
from dexkit.messages.layout import Struct
from dexkit.models import Dialect

__all__ = ["COMMANDED", "STATE", "Covered", "Measured", "Sent", "measure"]

STATE = ("t", "sent", "length", "q", "dq", "ddq", "tau", "mode")
"""What is decoded of a state: reception, source timestamp, motors in the sequence, their fields."""
COMMANDED = ("q", "dq", "tau", "kp", "kd")

_MOTOR = ("q", "dq", "ddq", "tau_est", "mode")


@dataclass(frozen=True)
class Covered:
    """What a check has read.

    :param phases: of the stimulus; empty for one that looks at the whole recording.
    :param members: names of :data:`STATE`, or paths of other members of the state.
    """

    requirement: Requirement
    phases: frozenset[str]
    members: frozenset[str]


@dataclass(frozen=True)
class Sent:
    """The commands of a phase.

    :param filled: the fields of :data:`COMMANDED` that are other than 0 in some command.
    :param modes: the mode bytes.
    :param hertz: commands a second of one side, the median; NaN for one or none.
    """

    filled: frozenset[str]
    modes: frozenset[int]
    hertz: float


@dataclass(frozen=True)
class Measured:
    """What was found of a dialect.

    :param sent: by phase, in their order.
    :param unread: paths of the state's numbers that no check reads, those of a list as one.
    """

    dialect: Dialect
    covered: Sequence[Covered]
    sent: Mapping[str, Sent]
    unread: Sequence[str]


def measure(dialect: Dialect) -> Measured:
    """Play a run of the dialect's reference, and let each check judge it."""
    plan = plan_for(dialect.name)
    trace = run_virtual(plan, under_test(dialect.model).reference.load())
    recording = recording_of(trace, dialect.name, plan.sides)
    every = [r for r in catalogue(dialect.model) if dialect.name in r.dialects]
    covered = [_read_by(r, recording) for r in every]
    read = {name for each in covered for name in each.members}
    paths = {_open(path) for path in read | _decoded(recording, read)}
    members = _members(message_type(dialect.state_type).layout)
    unread = [path for path in members if _open(path) not in paths]
    return Measured(dialect, covered, _sent(recording), unread)


def _decoded(recording: Recording, read: Iterable[str]) -> set[str]:
    """The paths from which the columns of these names are decoded."""
    codec, paths = MotorCodec(recording.dialect), set[str]()
    for view in recording.sides.values():
        if view.states.columns is not None:
            columns = cast("Columns", _NotedColumns(view.states.columns, paths))
            for name in {"tau_est" if n == "tau" else n for n in read} & set(_MOTOR):
                codec.column(columns, view.side, codec.state, name)
    return paths


def _open(path: str) -> str:
    """A path without the numbers of its elements."""
    return re.sub(r"\[\d*\]", "", path)


def _members(kind: Struct, before: str = "") -> list[str]:
    paths = []
    for member in kind.fields:
        many = "[]" if member.sequence or member.array is not None else ""
        if isinstance(member.type, Struct):
            paths += _members(member.type, f"{before}{member.name}{many}.")
        else:
            paths.append(f"{before}{member.name}{many}")
    return paths


def _read_by(requirement: Requirement, recording: Recording) -> Covered:
    phases = set(requirement.phases)
    members: set[str] = set()
    for subject in recording.judged:
        views: dict[Subject, SideView] = {
            side: SideView(side, _noted(view.states, members), view.commands, view.joints)
            for side, view in recording.sides.items()
        }
        values = {f.name: getattr(recording, f.name) for f in fields(Recording)}
        watched = _NotedRecording(**{**values, "sides": views})
        object.__setattr__(watched, "noted", phases)
        check_of(requirement)(Context(watched, views[subject], requirement))
    return Covered(requirement, frozenset(phases), frozenset(members))


def _sent(recording: Recording) -> dict[str, Sent]:
    found: dict[str, Sent] = {}
    for phase in recording.stimulus.phases if recording.stimulus else ():
        for view in recording.sides.values():
            one = _sent_in(phase, recording, view.commands)
            known = found.get(phase.name, Sent(frozenset(), frozenset(), np.nan))
            found[phase.name] = Sent(
                known.filled | one.filled,
                known.modes | one.modes,
                float(np.fmax(known.hertz, one.hertz)),
            )
    return found


def _sent_in(phase: Phase, recording: Recording, commands: Commands) -> Sent:
    begin, end = recording.seconds(phase.begin_ns), recording.seconds(phase.end_ns)
    rows = (commands.t >= begin) & (commands.t < end)
    filled = frozenset(
        name for name in COMMANDED if np.nan_to_num(getattr(commands, name)[rows]).any()
    )
    modes = commands.mode[rows]
    gaps = np.diff(commands.t[rows])
    gaps = gaps[gaps > 0]
    hertz = 1 / float(np.median(gaps)) if len(gaps) else np.nan
    return Sent(filled, frozenset(int(m) for m in np.unique(modes[np.isfinite(modes)])), hertz)


# ---------------------------------------------------------------------------------- what is noted


def _noted(states: States, members: set[str]) -> States:
    values = {f.name: getattr(states, f.name) for f in fields(States)}
    if states.columns is not None:
        values["columns"] = cast("Columns", _NotedColumns(states.columns, members))
    made = _NotedStates(**values)
    object.__setattr__(made, "noted", members)
    return made


class _NotedStates(States):
    """States that note what is read."""

    def __getattribute__(self, name: str) -> Any:
        if name in STATE:
            noted = object.__getattribute__(self, "__dict__").get("noted")
            if noted is not None:
                noted.add(name)
        return super().__getattribute__(name)


class _NotedRecording(Recording):
    """A recording that notes which phases are asked for."""

    def phases(self, name: str, side: Any = None) -> list[Phase]:
        """As in a recording."""
        self.__dict__["noted"].add(name)
        return super().phases(name, side)


class _NotedColumns:
    """Columns that note which paths are read; all else is the columns' own."""

    def __init__(self, columns: Columns, noted: set[str]) -> None:
        self._columns, self._noted = columns, noted

    def __len__(self) -> int:
        return len(self._columns)

    def __getitem__(self, path: str) -> Any:
        return self._of(self._columns.__getitem__)(path)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._columns, name)
        return self._of(found) if name in ("extremes", "constant", "table", "count") else found

    def _of(self, read: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def noting(paths: Any) -> Any:
            self._noted.update([paths] if isinstance(paths, str) else paths)
            return read(paths)

        return noting

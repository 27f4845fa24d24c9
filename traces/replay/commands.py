"""Read the commands to hands from a session of any format, as tables over time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import SessionError, TraceUnsupported
from dexkit.hand import Floats, JointMode, Side
from dexkit.messages import Columns, message_type
from dexkit.models import Dialect, HandModel, ModeByte, model
from dexkit.temporary_folder import TemporaryFolder
from dexkit.topics import Role, roles
from dexkit.traces.names import SESSION
from dexkit.traces.reader import SampleArray, Trace, open_trace
from dexkit.traces.sessions.episodes import DATA, DEFAULT
from dexkit.traces.sessions.imported import NOMINAL, import_record
from dexkit.traces.sessions.sources import choose, find
from dexkit.traces.sessions.streams import COMMAND, HAND, Stream, streams_of

__all__ = ["HandCommands", "RecordedCommands", "counted", "read_session", "read_trace"]

Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class HandCommands:
    """The commands to one hand, in order of time.

    :param t: seconds from the session's first command, ascending, shape (n,).
    :param q: rad; ``dq`` rad/s, ``tau`` N·m, ``kp`` N·m/rad, ``kd`` N·m·s/rad; shape (n, joints).
        NaN where a message lacks a joint or contains NaN.
    :param driven: whether the mode byte drives the joint, shape (n, joints).
    :param counts: motors in each message, shape (n,).
    :param late: seconds by which a command was received later than its writer's usually are, shape
        (n,); 0 where source timestamps are unknown.
    :param backwards: messages whose source timestamp is before that of an earlier message.
    """

    t: Floats
    q: Floats
    dq: Floats
    tau: Floats
    kp: Floats
    kd: Floats
    driven: Flags
    counts: NDArray[np.intp]
    late: Floats
    backwards: Flags

    def __len__(self) -> int:
        return len(self.t)

    def rows(self, chosen: NDArray[np.intp] | Flags) -> HandCommands:
        """Some of the commands."""
        return HandCommands(**{name: table[chosen] for name, table in vars(self).items()})


@dataclass(frozen=True, eq=False)
class RecordedCommands:
    """A session's commands, and positions, of the hands of one model.

    :param name: for messages.
    :param form: of the source: ``recording``, or the format it was imported from.
    :param nominal_rate: frames a second that were asked for, where the source has no times; else 0.
    :param first_ns: time of the first command, ns since the epoch; 0 where it is unknown.
    :param states: (t, q) of each hand, in the same seconds.
    :param others: other contents, which are not played.
    :param corrections: what an import has changed; ``problems``: what it could not import.
    :param damage: of the file.
    """

    name: str
    form: str
    dialect: Dialect | None
    commands: Mapping[Side, HandCommands]
    states: Mapping[Side, tuple[Floats, Floats]]
    nominal_rate: float = 0.0
    first_ns: int = 0
    others: tuple[str, ...] = ()
    corrections: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    damage: tuple[str, ...] = field(default=())

    @property
    def model(self) -> HandModel:
        """The hands' model.

        :raises SessionError: there is no hand in the session.
        """
        if self.dialect is None:
            has = f"; it has: {', '.join(self.others)}" if self.others else ""
            raise SessionError(
                f"{self.name} has no commands to a hand that dexkit knows{has}",
                hint="'dexkit publish' publishes the command topics of a recording as they are"
                if self.form == "recording"
                else "'dexkit import --set hand=MODEL' states the hands' model",
            )
        return model(self.dialect.model)


def read_session(source: Path) -> RecordedCommands:
    """The commands in a recording, or in a session of any format that ``dexkit import`` reads.

    :raises SessionError: there is no session, or it cannot be read.
    :raises UsageError: the source has several sessions.
    :raises TraceError: the recording cannot be read.
    """
    if _is_recording(source):
        return read_trace(open_trace(source), source.name)
    (entry,) = choose(source, find(source, None, DEFAULT), (), one=True)
    with TemporaryFolder("replay") as folder:
        path = folder / "session.mcap"
        report = entry.convert(path, False, False)
        found = read_trace(open_trace(path), f"{source.name}/{entry.name}")
        return RecordedCommands(
            **{
                **vars(found),
                "form": report.form,
                "corrections": tuple(report.corrections),
                "problems": tuple(report.problems),
            }
        )


def _is_recording(source: Path) -> bool:
    """Whether to read it as a recording; so are unknown formats, for the error message."""
    return source.is_file() and not (
        source.suffix in (".jsonl", ".ndjson", ".db3") or source.name == DATA
    )


def read_trace(trace: Trace, name: str) -> RecordedCommands:
    """The commands in a recording.

    :raises SessionError: it commands hands of several dialects.
    :raises TraceUnsupported: a hand's commands cannot be decoded.
    """
    topics = [c.topic for c in trace.channels if c.message_count and _wanted(c.topic, c.type_name)]
    for channel in trace.channels:
        hand = roles(channel.topic, channel.type_name)
        if channel.problem and channel.message_count and hand:
            raise TraceUnsupported(f"{channel.topic} cannot be played: {channel.problem}")
    streams = streams_of(trace, list(dict.fromkeys(topics))) if topics else []
    hands = [s for s in streams if s.model and s.part.endswith(HAND) and s.samples is not None]
    commanded = [s for s in hands if s.kind == COMMAND] or hands
    spoken = {r.dialect.name: r.dialect for s in commanded if (r := _role(s))}
    if len(spoken) > 1:
        raise SessionError(
            f"{name} has commands of several dialects: {', '.join(sorted(spoken))}",
            hint="cut one out of it: dexkit cut IN.mcap OUT.mcap --topic ...",
        )
    dialect = next(iter(spoken.values()), None)
    mine = [s for s in hands if (r := _role(s)) and r.dialect == dialect]
    first_ns = min((int(s.times_ns[0]) for s in commanded), default=0)
    imported = import_record(trace)
    nominal = imported.clock == NOMINAL
    return RecordedCommands(
        name=name,
        form=imported.format,
        dialect=dialect,
        commands={_side(s): _commands(s, first_ns) for s in mine if s.kind == COMMAND},
        states={_side(s): ((s.times_ns - first_ns) / 1e9, s.q) for s in mine if s.kind != COMMAND},
        nominal_rate=imported.rate_hz if nominal else 0.0,
        first_ns=0 if nominal and imported.first_ns is None else first_ns,
        others=_others(trace, streams, mine),
        damage=tuple(trace.damage),
    )


def _wanted(topic: str, type_name: str) -> bool:
    group = topic.startswith(SESSION) and topic.endswith(("/cmd", "/state"))
    return group or any(r.kind in ("cmd", "state") for r in roles(topic, type_name))


def _role(stream: Stream) -> Role | None:
    assert stream.samples is not None
    return next(iter(roles(stream.topic, stream.samples.type_name)), None)


def _side(stream: Stream) -> Side:
    return Side(stream.part.removesuffix(HAND))


def _others(trace: Trace, streams: Sequence[Stream], mine: Sequence[Stream]) -> tuple[str, ...]:
    """Describe what else is commanded."""
    played = {s.topic for s in mine}
    found = [
        f"{s.part} ({len(s.joints)} joints)"
        for s in streams
        if s.kind == COMMAND and s.topic not in played
    ]
    known = {s.topic for s in streams}
    found += [
        c.topic
        for c in trace.channels
        if c.message_count and c.topic.endswith("cmd") and c.topic not in known
    ]
    return tuple(dict.fromkeys(found))


def _commands(stream: Stream, first_ns: int) -> HandCommands:
    samples = stream.samples
    assert samples is not None
    role = _role(stream)
    assert role is not None
    columns = samples.columns()
    sequence = message_type(samples.type_name).motor_sequence
    first = role.dialect.index[_side(stream)]
    shape = stream.q.shape
    hand = model(role.dialect.model)
    # fields missing in the source get the values of the model's own client
    missing = {
        "dq": np.zeros(shape),
        "tau": np.zeros(shape),
        "kp": np.broadcast_to([kp for kp, _ in hand.gains], shape),
        "kd": np.broadcast_to([kd for _, kd in hand.gains], shape),
    }
    tables = {f: stream.values.get(f, table) for f, table in missing.items()}
    late, backwards = _ages(samples)
    return HandCommands(
        t=(stream.times_ns - first_ns) / 1e9,
        q=stream.q,
        driven=_driven(columns, role.dialect, f"{sequence}[{{}}].mode", first, shape),
        counts=columns.count(sequence) - first,
        late=late,
        backwards=backwards,
        **{f: np.array(table, dtype=np.float64) for f, table in tables.items()},
    )


def _driven(
    columns: Columns, dialect: Dialect, path: str, first: int, shape: tuple[int, ...]
) -> Flags:
    """Whether the mode byte drives each joint."""
    if dialect.mode_byte is ModeByte.UNUSED:
        return np.ones(shape, dtype=np.bool_)
    modes = columns.table([path.format(first + i) for i in range(shape[1])])
    status: NDArray[np.intp] = np.nan_to_num(modes).astype(np.intp)
    if dialect.mode_byte is ModeByte.RIS:
        status = status >> 4 & 7
    return np.asarray(status == JointMode.FOC)


def _ages(samples: SampleArray) -> tuple[Floats, Flags]:
    """How late each message was received, and whether its source timestamp goes back."""
    sent, n = samples.publish_time_ns.astype(np.int64), len(samples)
    known = sent > 0
    late, backwards = np.zeros(n), np.zeros(n, dtype=np.bool_)
    if known.any():
        delay = (samples.log_time_ns.astype(np.int64) - sent)[known] / 1e9
        late[known] = delay - delay.min()
        newest = np.maximum.accumulate(sent[known])
        backwards[known] = sent[known] < newest
    return late, backwards


def counted(counts: NDArray[np.intp]) -> str:
    """Describe numbers of motors and how often each occurs."""
    found = Counter(counts.tolist())
    return ", ".join(f"{n} motors in {k} messages" for n, k in sorted(found.items()))

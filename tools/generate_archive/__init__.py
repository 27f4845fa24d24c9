"""Make an archive of recorded sessions whose faults are known, to score an audit with.

Sessions are the shipped samples, a part of each again and again until the asked length, with
seeded variations: which sample, when, which robot and operator, how late each message was
received. Some have a fault. ``answers.json`` beside them says which file has which, and what an
audit must find.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from dexkit.conformance.kit.requirements import catalogue
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import HandModel, model
from dexkit.topics import roles
from dexkit.traces import open_trace, sample_path

__all__ = ["ANSWERS", "FAULTS", "Answer", "Fault", "Session", "generate"]

ANSWERS = "answers.json"
_SAMPLES = ("dex1_pick_place", "dex1_idle_then_startle", "dex3_pinch")
_FIRST = 1_790_000_000_000_000_000  # ns: September 2026
_DAY_NS = 86_400 * 10**9
_ROBOTS, _OPERATORS = 5, 4
_SENTINEL = np.float32(1.2345678e11)


@dataclass
class Topic:
    """The messages of a topic: payloads of one length, shape (n, bytes)."""

    name: str
    type_name: str
    log: NDArray[np.int64]
    publish: NDArray[np.int64]
    payloads: NDArray[np.uint8]
    cut: dict[int, bytes] = field(default_factory=dict)

    def member(self, name: str, joint: int = 0) -> NDArray[np.float32]:
        """A member of a motor in each message, as a view that can be changed."""
        kind = message_type(self.type_name)
        message = kind.decode(self.payloads[0].tobytes())
        setattr(getattr(message, kind.motor_sequence)[joint], name, float(_SENTINEL))
        at = kind.encode(message).index(_SENTINEL.tobytes())
        return self.payloads[:, at : at + 4].view(np.float32)[:, 0]

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Keep some of the messages."""
        self.log, self.publish = self.log[which], self.publish[which]
        self.payloads = np.ascontiguousarray(self.payloads[which])


@dataclass
class Session:
    """A session of one hand model in memory."""

    model: HandModel
    topics: dict[str, Topic]

    @property
    def joints(self) -> int:
        """Joints of a hand."""
        return len(self.model.joints[Side.LEFT])

    def ids(self, names: Sequence[str]) -> tuple[str, ...]:
        """Ids of requirements of its model, of their names without the prefix (``RATE-03``)."""
        prefix = catalogue(self.model.name)[0].id.partition("-")[0]
        return tuple(f"{prefix}-{name}" for name in names)

    def topic(self, side: str, what: str) -> Topic:
        """The states or commands of a side."""
        return next(t for n, t in self.topics.items() if f"/{side}/" in n and n.endswith(what))

    def write(self, compression: CompressionType, labels: Mapping[str, str]) -> bytes:
        """The session as the bytes of an mcap file."""
        out = io.BytesIO()
        writer = Writer(out, compression=compression)
        writer.start(profile="ros2", library="tools.generate_archive")
        writer.add_metadata("session", dict(labels))
        channels, rows = [], []
        for number, topic in enumerate(self.topics.values()):
            kind = message_type(topic.type_name)
            schema = writer.register_schema(kind.ros_name, "ros2msg", kind.ros2msg.encode())
            metadata = {"dds.type": kind.name}
            channels.append(writer.register_channel(topic.name, "cdr", schema, metadata))
            rows.append(np.stack([topic.log, np.full(len(topic.log), number)], axis=1))
        every = np.concatenate(rows)
        places = np.concatenate([np.arange(len(t.log)) for t in self.topics.values()])
        order = np.argsort(every[:, 0], kind="stable")
        given = list(self.topics.values())
        data = [t.payloads.tobytes() for t in given]
        for (log, number), at in zip(every[order].tolist(), places[order].tolist(), strict=True):
            topic, size = given[number], given[number].payloads.shape[1]
            payload = topic.cut.get(at) or data[number][at * size : (at + 1) * size]
            writer.add_message(channels[number], log, payload, int(topic.publish[at]))
        writer.finish()  # type: ignore[no-untyped-call]
        return out.getvalue()


def load(sample: str, seconds: float) -> Session:
    """A sample, of which a part is played again and again until the session has that length."""
    trace = open_trace(sample_path(sample))
    topics = {}
    for name, samples in trace.load().items():
        payloads = np.frombuffer(b"".join(samples.payloads), np.uint8)
        log, publish = (t - trace.first_ns for t in (samples.log_time_ns, samples.publish_time_ns))
        topics[name] = Topic(
            name, samples.type_name, log, publish, payloads.reshape(len(samples), -1).copy()
        )
    session = Session(_model_of(topics), topics)
    missing = seconds * 1e9 - (trace.last_ns - trace.first_ns)
    if missing > 0.0:
        begin, end = _loop(session)
        _repeat(session, begin, end, round(missing / (end - begin)))
    return session


def _model_of(topics: Mapping[str, Topic]) -> HandModel:
    """The model whose topics these are."""
    found = [r for name, t in topics.items() for r in roles(name, t.type_name)]
    return model(found[0].dialect.model)


def _loop(session: Session) -> tuple[int, int]:
    """Begin and end, ns, of a part after which the hands and their commands are where they were
    at its begin, so that it can be played twice without a jump.
    """
    last = min(int(t.log[-1]) for t in session.topics.values())
    grid = np.arange(1_500_000_000, last - 200_000_000, 20_000_000)
    columns = []
    for topic in session.topics.values():
        rows = np.searchsorted(topic.log, grid) - 1
        for joint in range(session.joints):
            columns.append(topic.member("q", joint)[rows])
            columns.append(topic.member("dq", joint)[rows] * np.float32(0.02))
    worst = np.zeros((len(grid), len(grid)), dtype=np.float32)
    for column in columns:
        np.maximum(worst, np.abs(column[:, None] - column), out=worst)
    worst[grid[None, :] - grid[:, None] < 5_000_000_000] = np.inf
    first, second = np.unravel_index(int(np.argmin(worst)), worst.shape)
    return int(grid[first]), int(grid[second])


def _repeat(session: Session, begin: int, end: int, times: int) -> None:
    """Play the part from ``begin`` to ``end``, ns, so many times more."""
    for topic in session.topics.values():
        first, second = np.searchsorted(topic.log, [begin, end]).tolist()
        again = np.tile(np.arange(first, second), times)
        rows = np.concatenate([np.arange(second), again, np.arange(second, len(topic.log))])
        turns = np.repeat(np.arange(1, times + 1), second - first)
        rest = np.full(len(topic.log) - second, times)
        later = np.concatenate([np.zeros(second, np.int64), turns, rest]) * (end - begin)
        topic.log, topic.publish = topic.log[rows] + later, topic.publish[rows] + later
        topic.payloads = topic.payloads[rows]


Random = np.random.Generator


@dataclass(frozen=True)
class Fault:
    """A fault, and the expected result of an audit of a file that has it.

    :param apply: changes a session, on one side; for a fault of the file, its bytes.
    :param find: requirements of which at least one must fail or warn, without the prefix.
    :param also: what else may fail as a consequence.
    :param state: what the audit must make of the file instead: ``truncated``, ``damaged`` or a
        state of the record.
    """

    name: str
    apply: Callable[[Session, str, Random], None] | None = None
    find: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    spoil: Callable[[bytes, Random], bytes] | None = None
    state: str = ""


def _stretch(times: NDArray[np.int64], random: Random, seconds: float) -> NDArray[np.bool_]:
    """A stretch in the middle of a session."""
    begin, end = int(times[0]), int(times[-1])
    first = begin + int(random.uniform(0.2, 0.7) * (end - begin))
    return (times >= first) & (times < first + round(seconds * 1e9))


def _moving(topic: Topic, random: Random, seconds: float) -> slice:
    """Rows of a stretch of states in which the first joint moves by a good part of its range."""
    q = topic.member("q")
    rows = int(seconds * 500)
    starts = np.arange(rows, len(q) - 2 * rows, rows // 4)
    moves = np.abs(q[starts + rows] - q[starts])
    some = starts[moves > 0.5 * moves.max()]
    begin = int(some[int(random.integers(len(some)))])
    return slice(begin, begin + rows)


def _gap(session: Session, side: str, random: Random) -> None:
    states = session.topic(side, "/state")
    states.keep(~_stretch(states.log, random, float(random.uniform(0.3, 2.0))))


def _slow(session: Session, side: str, random: Random) -> None:
    states = session.topic(side, "/state")
    states.keep(np.arange(len(states.log)) % int(random.integers(6, 10)) == 0)


def _nan(session: Session, side: str, random: Random) -> None:
    q = session.topic(side, "/state").member("q")
    q[random.integers(0, len(q), 5)] = np.nan


def _out_of_stroke(session: Session, side: str, random: Random) -> None:
    states = session.topic(side, "/state")
    q = states.member("q")
    q[_stretch(states.log, random, 3.0)] += np.float32(random.choice([-9.0, 9.0]))


def _frozen(session: Session, side: str, random: Random) -> None:
    states = session.topic(side, "/state")
    rows = _moving(states, random, 0.5)
    for joint in range(session.joints):
        for name in ("q", "dq", "tau_est"):
            values = states.member(name, joint)
            values[rows] = values[rows.start]


def _order(session: Session, side: str, random: Random) -> None:
    states = session.topic(side, "/state")
    for at in random.integers(10, len(states.log) - 10, 4).tolist():
        states.publish[[at, at + 1]] = states.publish[[at + 1, at]]


def _turned(session: Session, side: str, random: Random) -> None:
    for joint in range(session.joints):
        session.topic(side, "/state").member("dq", joint)[:] *= -1


def _short(session: Session, side: str, random: Random) -> None:
    states = session.topic(side, "/state")
    kind = message_type(states.type_name)
    for at in random.integers(0, len(states.log), 3).tolist():
        message = kind.decode(states.payloads[at].tobytes())
        setattr(message, kind.motor_sequence, kind.motors(message)[:-1])
        states.cut[at] = kind.encode(message)


def _late(session: Session, side: str, random: Random) -> None:
    """Every fiftieth state is published 46 ms late, and those that follow catch up."""
    states = session.topic(side, "/state")
    late = np.arange(len(states.log)) % 50 < 23
    for times in (states.log, states.publish):
        held = times.copy()
        held[late] = np.maximum.accumulate(np.where(late, np.roll(times, -23), 0))[late]
        times[:] = np.maximum.accumulate(held) + np.arange(len(times)) % 50


def _strong(session: Session, side: str, random: Random) -> None:
    states = session.topic(side, "/state")
    tau = states.member("tau_est")
    tau[_stretch(states.log, random, 1.0)] = 400.0


def _cut(data: bytes, random: Random) -> bytes:
    return data[: int(random.uniform(0.3, 0.9) * len(data))]


def _damage(data: bytes, random: Random) -> bytes:
    at = int(random.uniform(0.2, 0.8) * len(data))
    return data[:at] + random.bytes(64) + data[at + 64 :]


FAULTS = (
    # TRACK-01: where q is missing or wrong, the hand seems not to follow
    Fault("gap", _gap, ("RATE-03",), ("FIELD-15", "TRACK-01")),
    Fault("slow", _slow, ("RATE-01",), ("FRESH-01", "RATE-03")),
    Fault("nan", _nan, ("FIELD-01",)),
    Fault(
        "out-of-stroke",
        _out_of_stroke,
        ("FIELD-03",),
        ("FIELD-15", "FIELD-17", "TRACK-01"),
    ),
    Fault(
        "frozen",
        _frozen,
        ("FRESH-02", "FIELD-15", "FRESH-01"),
        ("FIELD-16", "FIELD-17", "TRACK-01"),
    ),
    Fault("order", _order, ("ORDER-01",)),
    Fault("turned", _turned, ("FIELD-04", "FIELD-16"), ("FIELD-17",)),
    Fault("short", _short, ("FIELD-01",)),
    Fault("late", _late, ("RATE-03",), ("RATE-01", "FRESH-01", "FIELD-17")),
    Fault("strong", _strong, ("FORCE-04", "FORCE-02"), ("FORCE-07",)),
    Fault("cut", spoil=_cut, state="truncated"),
    Fault("damage", spoil=_damage, state="damaged"),
    Fault("not a recording", spoil=lambda data, random: data[1000:5000], state="unreadable"),
)
"""Every fault that a generated file may have."""


@dataclass(frozen=True)
class Answer:
    """The known facts of a generated file.

    :param find: ids of which one must fail or warn, on ``side``; ``also`` may fail, too.
    """

    file: str
    sample: str
    seconds: float
    fault: str = ""
    side: str = ""
    find: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    state: str = ""


def generate(
    folder: Path,
    files: int,
    faulty: int,
    *,
    seconds: float = 60.0,
    seed: int = 1,
    samples: Sequence[str] = _SAMPLES,
) -> list[Answer]:
    """Write the files and their answers; the same arguments write the same files.

    :param faulty: how many of them have a fault.
    """
    random = np.random.default_rng(seed)
    with_fault = set(random.permutation(files)[:faulty].tolist())
    bases = {name: load(name, seconds) for name in samples}
    answers, turn = [], 0
    for number in range(files):
        random = np.random.default_rng([seed, number])
        sample = samples[int(random.integers(len(samples)))]
        begin = _FIRST + number * 30 * _DAY_NS // files + int(random.integers(10**9))
        session = _varied(bases[sample], begin, random)
        name = f"day{number * 30 // files + 1:02}/session{number:05}.mcap"
        answer = Answer(name, sample, round(seconds, 1))
        fault = None
        if number in with_fault:
            fault = FAULTS[turn % len(FAULTS)]
            turn += 1
            answer = _answer(answer, fault, session, random)
        data = session.write(
            CompressionType.LZ4 if random.random() < 0.2 else CompressionType.ZSTD,
            {
                "robot": f"g1-{int(random.integers(_ROBOTS)) + 1}",
                "operator": f"operator {int(random.integers(_OPERATORS)) + 1}",
            },
        )
        if fault is not None and fault.spoil is not None:
            data = fault.spoil(data, random)
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        answers.append(answer)
    text = json.dumps([asdict(a) for a in answers], indent=1)
    (folder / ANSWERS).write_text(text + "\n")
    return answers


def _varied(base: Session, begin: int, random: Random) -> Session:
    """A session of another time, received a little later or earlier."""
    topics = {}
    for name, topic in base.topics.items():
        jitter = random.integers(0, 100_000, len(topic.log))  # ns
        log = np.maximum.accumulate(topic.log + begin + jitter)
        topics[name] = replace(
            topic, log=log, publish=topic.publish + begin, payloads=topic.payloads.copy(), cut={}
        )
    return Session(base.model, topics)


def _answer(answer: Answer, fault: Fault, session: Session, random: Random) -> Answer:
    side = ("left", "right")[int(random.integers(2))]
    if fault.apply is None:
        return replace(answer, fault=fault.name, state=fault.state)
    fault.apply(session, side, random)
    find, also = session.ids(fault.find), session.ids(fault.also)
    return replace(answer, fault=fault.name, side=side, find=find, also=also)

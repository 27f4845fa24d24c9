"""Intermediate form of an imported session: frames of parts, pictures and other data.

Importers make a :class:`Session`, :func:`write` makes a recording of it:

* a hand of a known model goes to the topics of that model, so that all tools for recordings apply;
* other groups of joints go to ``rt/session/PART/state`` and ``.../cmd`` as JointState;
* pictures are referenced by path and time, or embedded as they are;
* everything else goes, as JSON, to ``rt/session/frame/rest``, so that nothing is lost.

The metadata record :data:`~dexkit.traces.sessions.imported.RECORD` names the source of the session,
whether its times were measured, what was corrected, and which fields are 0 because the source does
not have them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit import __version__
from dexkit.errors import SessionError
from dexkit.hand import Floats, JointMode, Side
from dexkit.messages import MessageType, message_type
from dexkit.models import DIALECTS, Dialect, HandModel, ModeByte, model
from dexkit.traces.sessions import ros_types
from dexkit.traces.sessions.carried import format_of
from dexkit.traces.sessions.imported import MEASURED, NOMINAL, RECORD, absent_key
from dexkit.traces.sessions.streams import COMMAND, FIELDS, HAND, MEMBERS, STATE, may_be_radians
from dexkit.traces.writer import RecordingWriter, definition

__all__ = [
    "MEASURED",
    "REST_TOPIC",
    "Camera",
    "Part",
    "Problems",
    "Session",
    "messages",
    "models_by_joints",
    "picture_topic",
    "record_of",
    "reference_topic",
    "write",
]

REST_TOPIC = ros_types.group_topic("frame", "rest")
_REFERENCE, _PICTURE = "reference", "compressed"
_FLOAT32_MAX = float(np.finfo(np.float32).max)
# Problems that are listed one by one.
_MOST = 200


class Problems:
    """Problems of a source as sentences; equal problems at several places are counted."""

    def __init__(self) -> None:
        self._places: dict[str, list[str]] = {}

    def add(self, what: str, place: str = "") -> None:
        """Add a problem.

        :param place: where; given for the first, the others are counted.
        """
        if what in self._places or len(self._places) < _MOST:
            self._places.setdefault(what, []).append(place)

    def __bool__(self) -> bool:
        return bool(self._places)

    def sentences(self) -> list[str]:
        """One sentence for each problem."""
        found = []
        for what, places in self._places.items():
            more = f", and {len(places) - 1} more" if len(places) > 1 else ""
            found.append(f"{what} ({places[0]}{more})" if places[0] else what + more)
        if len(self._places) == _MOST:
            found.append("and more, which is not listed")
        return found


@dataclass(frozen=True, eq=False)
class Part:
    """A hand or a group of joints over the frames of a session.

    :param name: ``left_hand``, ``right_hand``, or a group's: ``left_arm``.
    :param joints: names, in the order of the columns.
    :param values: by kind and field of :data:`~dexkit.traces.sessions.streams.FIELDS`; shape
        (frames, joints), a row of NaN where the frame has none. A field that the source does not
        have is missing.
    :param model: the hand's; None for a group without a profile.
    """

    name: str
    joints: tuple[str, ...]
    values: Mapping[str, Mapping[str, Floats]]
    model: HandModel | None = None

    @property
    def side(self) -> Side:
        """Of a hand."""
        return Side(self.name.removesuffix(HAND))


@dataclass(frozen=True, eq=False)
class Camera:
    """Pictures of one camera over the frames of a session.

    :param name: ``color_0``.
    :param paths: relative to the session's folder; empty where the frame has none.
    :param group: ``colors`` or ``depths``.
    :param seconds: of a video, the time within the file at each frame; None for single pictures.
    :param load: of pictures without files of their own, the picture of a frame; they are embedded.
    :param begin_s: of a video, the time within the file at which the session begins, as the source
        states it; ``end_s`` at which it ends, None where it does not say.
    """

    name: str
    paths: tuple[str, ...]
    group: str = "colors"
    seconds: tuple[float, ...] | None = None
    load: Callable[[int], bytes | None] | None = None
    begin_s: float = 0.0
    end_s: float | None = None


@dataclass(eq=False)
class Session:
    """One session.

    :param source: the file or folder it was read from.
    :param form: name of the format with its version.
    :param times_ns: of the frames, ns since the epoch, strictly ascending, shape (frames,).
    :param clock: :data:`~dexkit.traces.sessions.imported.NOMINAL` or :data:`MEASURED`.
    :param rate: frames a second, nominal or measured.
    :param folder: to which the paths of pictures are relative.
    :param below: that folder, relative to the source that was named.
    :param first_ns: of a nominal clock, the time of frame 0; None where times are measured.
    :param rest: per frame, what neither a part nor a camera holds, as JSON; empty texts where it is
        the same as in the frame before.
    :param about: further facts for the metadata record.
    :param corrections: what was changed and why.
    :param problems: what could not be imported.
    :param stamps: the times of the frames as the source has them, s, shape (frames,); None without.
    :param numbers: the numbers that it gives its frames, likewise.
    :param stated_rate: frames a second that the source states, where its times say something else.
    :param features: of a dataset, its columns of joints by name, shape (frames, elements).
    :param touches: of a dataset, the pressures of each hand's elements, by its part.
    """

    source: Path
    form: str
    times_ns: NDArray[np.int64]
    clock: str
    rate: float
    parts: list[Part]
    folder: Path
    cameras: list[Camera] = field(default_factory=list)
    rest: Sequence[str] = ()
    first_ns: int | None = None
    about: dict[str, str] = field(default_factory=dict)
    corrections: list[str] = field(default_factory=list)
    problems: Problems = field(default_factory=Problems)
    name: str = ""
    below: str = "."
    stamps: Floats | None = None
    numbers: Floats | None = None
    stated_rate: float | None = None
    features: Mapping[str, Floats] = field(default_factory=dict)
    touches: Mapping[str, Floats] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.times_ns)


def models_by_joints(count: int) -> list[HandModel]:
    """The hand models in radians with this number of joints.

    Hands with q in parts of their travel cannot be detected this way: Inspire's and BrainCo's both
    have six joints from 0 to 1, which count in opposite directions.
    """
    names = dict.fromkeys(d.model for d in DIALECTS.values())
    hands = [m for m in map(model, names) if m.unit == "rad"]
    return [m for m in hands if len(m.joints[Side.LEFT]) == count]


def reference_topic(camera: str) -> str:
    """The topic of the references to a camera's pictures."""
    return ros_types.group_topic(camera, _REFERENCE)


def picture_topic(camera: str) -> str:
    """The topic of a camera's embedded pictures."""
    return ros_types.group_topic(camera, _PICTURE)


def write(session: Session, out: Path, *, embed: bool = False, overwrite: bool = False) -> int:
    """Write a session as a recording.

    :param embed: put single pictures into it, as their files are; those that cannot be read go to
        the session's problems.
    :returns: the number of messages.
    :raises UsageError: ``out`` exists.
    :raises TraceError: it cannot be written.
    """
    with RecordingWriter(out, overwrite=overwrite) as writer:
        for time_ns, channel, data in messages(session, writer, embed=embed):
            writer.put(channel, data, time_ns, time_ns)
        writer.add_metadata(RECORD, record_of(session, embed=embed))
        return writer.written


def messages(
    session: Session, writer: RecordingWriter, *, embed: bool = False
) -> Iterator[tuple[int, int, bytes]]:
    """The messages of a session in order of time: time, channel, payload.

    Adds channels to the recording, and facts for the metadata record to the session.

    :raises SessionError: a time cannot be written.
    """
    if session.times_ns.min() < 0 or session.times_ns.max() >= ros_types.LAST_NS:
        raise SessionError(f"{session.source} has times before 1970 or after January 2038")
    sources: list[tuple[int, Callable[[int], bytes | None]]] = []
    for kind in (STATE, COMMAND):
        hands: dict[str, list[Part]] = {}
        for part in session.parts:
            if kind in part.values and part.model is None:
                sources.append(_group_channel(writer, session, part, kind))
            elif kind in part.values:
                hands.setdefault(_hand_topic(part, kind), []).append(part)
        sources += [
            _hands_channel(writer, session, topic, parts, kind) for topic, parts in hands.items()
        ]
    for camera in session.cameras:
        if camera.load is None:
            sources.append(_reference_channel(writer, camera))
        if camera.load is not None or (embed and camera.seconds is None):
            sources.append(_picture_channel(writer, session, camera))
    if any(session.rest):
        channel = writer.add_channel(ros_types.STRING.definition(REST_TOPIC))
        sources.append((channel, lambda i: _rest(session, i)))
    for i, time_ns in enumerate(session.times_ns.tolist()):
        for channel, encode in sources:
            data = encode(i)
            if data is not None:
                yield time_ns, channel, data


def record_of(session: Session, *, embed: bool = False) -> dict[str, str]:
    """The contents of the metadata record; call it after all messages were made."""
    record = {
        "version": __version__,
        "format": session.form,
        "source": session.source.name,
        "clock": session.clock,
        "rate_hz": f"{session.rate:g}",
        "frames": str(len(session)),
        "pictures": "embedded" if embed else "referenced",
        "pictures_folder": session.below,
        "cameras": json.dumps({c.name: c.group for c in session.cameras}),
        **({} if session.first_ns is None else {"first_ns": str(session.first_ns)}),
        **session.about,
    }
    if session.clock == NOMINAL:
        record["clock_note"] = (
            "the source has no times: those of this recording are frame number / rate_hz"
        )
    for number, text in enumerate(session.corrections, 1):
        record[f"correction {number}"] = text
    for number, text in enumerate(session.problems.sentences(), 1):
        record[f"problem {number}"] = text
    return record


def _rest(session: Session, i: int) -> bytes | None:
    return ros_types.encode_string(session.rest[i]) if session.rest[i] else None


def _group_channel(
    writer: RecordingWriter, session: Session, part: Part, kind: str
) -> tuple[int, Callable[[int], bytes | None]]:
    values = part.values[kind]
    if not may_be_radians(values["q"]):
        session.problems.add(
            f"{part.name}: its {kind}s reach {np.nanmax(np.abs(values['q'])):.4g}, which is no "
            "angle in rad; are they degrees? They are kept as they are, without a unit"
        )
    topic = ros_types.group_topic(part.name, "cmd" if kind == COMMAND else "state")
    channel = writer.add_channel(ros_types.JOINT_STATE.definition(topic))
    return channel, lambda i: _joint_state(session, part, values, i)


def _hand_topic(part: Part, kind: str) -> str:
    assert part.model is not None
    cmd, state = part.model.dialects[0].topics(part.side)
    return cmd if kind == COMMAND else state


def _hands_channel(
    writer: RecordingWriter, session: Session, topic: str, parts: Sequence[Part], kind: str
) -> tuple[int, Callable[[int], bytes | None]]:
    """The channel of a topic: one hand's, or that of both hands where they share it."""
    hand = parts[0].model
    assert hand is not None
    dialect = hand.dialects[0]
    type_name = dialect.cmd_type if kind == COMMAND else dialect.state_type
    channel = writer.add_channel(definition(topic, message_type(type_name)))
    session.about[absent_key(topic)] = " ".join(_absent(session.form, dialect, parts, kind))
    if kind == COMMAND:
        session.about[f"filled {topic}"] = "kp, kd and mode, as xr_teleoperate sends them"
    encode = _motor_encoder(dialect, hand, kind)
    for part in parts:
        if not _is_near_limits(part, kind):
            session.problems.add(
                f"{part.name}: its {kind}s reach {np.nanmax(np.abs(part.values[kind]['q'])):.4g}, "
                f"far beyond a {hand.name}, whose joints count in {hand.unit}; they are kept as "
                "they are"
            )
        _note_losses(session, part, kind, message_type(type_name))
    values = {part.side: part.values[kind] for part in parts}
    places = {part.side: f"{part.name} {kind}" for part in parts}

    def encode_row(i: int) -> bytes | None:
        rows = {side: {name: table[i] for name, table in v.items()} for side, v in values.items()}
        bad = [side for side, row in rows.items() if not _is_whole(row)]
        if bad and len(bad) < len(rows):
            session.problems.add(
                f"{topic}: frames that lack one of the hands are left out, as one message has both",
                f"frame {i}, {places[bad[0]]}",
            )
        return None if bad else encode(rows)

    return channel, encode_row


def _is_near_limits(part: Part, kind: str) -> bool:
    """Whether positions can be those of the hand: no further beyond than its limits are apart."""
    assert part.model is not None
    joints = part.model.joints[part.side]
    low, high = np.array([[j.q_min, j.q_max] for j in joints]).T
    with np.errstate(invalid="ignore"):
        q = part.values[kind]["q"]
        return not ((q < 2 * low - high) | (q > 2 * high - low)).any()


def _absent(form: str, dialect: Dialect, parts: Sequence[Part], kind: str) -> Iterator[str]:
    """What the messages of a topic have, and the source does not: see :func:`absent_fields`."""
    room = format_of(form).fields[kind]
    sides = [s for s in Side if _topic_of(dialect, s, kind) == _hand_topic(parts[0], kind)]
    given = {p.side: p.values[kind] for p in parts}
    for name in FIELDS[kind]:
        lacking = [s for s in sides if name not in room or name not in given.get(s, {})]
        if len(lacking) == len(sides):
            yield name
        else:
            yield from (f"{side}.{name}" for side in lacking)


def _topic_of(dialect: Dialect, side: Side, kind: str) -> str:
    return dialect.topics(side)[0 if kind == COMMAND else 1]


def _is_whole(row: Mapping[str, Floats]) -> bool:
    return all(np.isfinite(v).all() and (np.abs(v) <= _FLOAT32_MAX).all() for v in row.values())


def _note_losses(session: Session, part: Part, kind: str, mt: MessageType) -> None:
    """Say what a message cannot hold of a hand's values: fields, and digits of a number."""
    for name, table in part.values[kind].items():
        with np.errstate(over="ignore", invalid="ignore"):
            sent = mt.motor_values_sent(MEMBERS[kind][name], table)
            if sent is None:
                session.problems.add(
                    f"{part.name}: {name} of its {kind}s is left out: {mt.name} has no place for it"
                )
                continue
            worst = np.nanmax(np.abs(sent - table), initial=0.0)
            is_float = np.array_equal(sent, table.astype(np.float32), equal_nan=True)
        if worst > 0 and not is_float:
            text = (
                f"{part.name}: {name} of its {kind}s is rounded to the whole numbers of {mt.name}"
            )
            session.corrections.append(f"{text}, by at most {worst:.3g}")
        elif worst > 0:
            session.about[f"rounded {part.name} {kind} {name}"] = (
                f"to the float32 of the wire, by at most {worst:.3g}"
            )


def _joint_state(
    session: Session, part: Part, values: Mapping[str, Floats], i: int
) -> bytes | None:
    if not np.isfinite(values["q"][i]).all():
        return None
    columns = [tuple(values[f][i].tolist()) if f in values else () for f in ("q", "dq", "tau")]
    return ros_types.encode_joint_state(
        ros_types.JointState(int(session.times_ns[i]), part.joints, *columns)
    )


_Rows = Mapping[Side, Mapping[str, Floats]]
"""By side and field, the values of a hand's joints."""


def _motor_encoder(dialect: Dialect, hand: HandModel, kind: str) -> Callable[[_Rows], bytes]:
    """Encodes the joints of the hands of a topic as a message of their dialect.

    The motors of a hand of the topic that is not given are 0.
    """
    mt = message_type(dialect.cmd_type if kind == COMMAND else dialect.state_type)
    motor = mt.motor_type.cls
    gains = hand.gains
    units = dialect.torque_units or (1.0,) * len(gains)
    tau_name = "tau" if kind == COMMAND else "tau_est"

    def encode(rows: _Rows) -> bytes:
        shared = {
            s
            for s in Side
            for r in rows
            if _topic_of(dialect, s, kind) == _topic_of(dialect, r, kind)
        }
        motors = [motor()] * (max(dialect.index[s] for s in shared) + len(gains))
        for side, row in rows.items():
            for j in range(len(gains)):
                given: dict[str, float] = {"q": float(row["q"][j])}
                if "dq" in row:
                    given["dq"] = float(row["dq"][j])
                if "tau" in row:
                    given[tau_name] = float(row["tau"][j]) / units[j]
                if kind == COMMAND:
                    given["kp"], given["kd"] = gains[j]
                    given["mode"] = _mode(dialect, j)
                motors[dialect.index[side] + j] = motor(**given)
        return mt.encode(mt.of_motors(motors))

    return encode


def _mode(dialect: Dialect, joint: int) -> int:
    """The mode byte of a driving command."""
    if dialect.mode_byte is ModeByte.RIS:
        return joint | int(JointMode.FOC) << 4
    return int(JointMode.FOC) if dialect.mode_byte is ModeByte.STATUS else 0


def _reference_channel(
    writer: RecordingWriter, camera: Camera
) -> tuple[int, Callable[[int], bytes | None]]:
    channel = writer.add_channel(ros_types.STRING.definition(reference_topic(camera.name)))

    def encode(i: int) -> bytes | None:
        if not camera.paths[i]:
            return None
        reference: dict[str, Any] = {"path": camera.paths[i]}
        if camera.seconds is not None:
            reference["seconds"] = camera.seconds[i]
        return ros_types.encode_string(json.dumps(reference))

    return channel, encode


def _picture_channel(
    writer: RecordingWriter, session: Session, camera: Camera
) -> tuple[int, Callable[[int], bytes | None]]:
    from dexkit.traces.sessions.pictures import Picture, parse_picture, read_picture

    channel = writer.add_channel(ros_types.COMPRESSED_IMAGE.definition(picture_topic(camera.name)))

    def load(i: int) -> tuple[Picture | None, str]:
        if camera.load is None:
            return read_picture(session.folder, camera.paths[i])
        data = camera.load(i)
        picture = parse_picture(data) if data is not None else None
        return picture, "are missing, or neither JPEG nor PNG"

    def encode(i: int) -> bytes | None:
        if not camera.paths[i]:
            return None
        picture, why = load(i)
        if picture is None:
            session.problems.add(f"{camera.name}: pictures that {why}", camera.paths[i])
            return None
        return ros_types.encode_compressed_image(
            ros_types.CompressedImage(
                int(session.times_ns[i]), camera.name, picture.form, picture.data
            )
        )

    return channel, encode

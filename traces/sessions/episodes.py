"""Read episodes of xr_teleoperate: ``data.json`` of every published version of its writer.

All versions write ``1.0.0``; they are told apart by their contents
(docs/sources/sessions.md#a1): ``left_hand`` for ``left_ee`` before v1.0, joint names of the left
arm before v1.4, a file that is written item by item since v1.3. An interrupted file is salvaged up
to its last whole item.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dexkit.documents import limit_depth, read_bytes
from dexkit.errors import SessionError
from dexkit.hand import Floats, Side
from dexkit.models import HandModel, model
from dexkit.traces.sessions.imported import EPOCH_NS, NOMINAL
from dexkit.traces.sessions.model import (
    MEASURED,
    Camera,
    Part,
    Problems,
    Session,
    models_by_joints,
)
from dexkit.traces.sessions.paths import below
from dexkit.traces.sessions.ros_types import LAST_NS
from dexkit.traces.sessions.sides import swap_states, swapped_sides
from dexkit.traces.sessions.streams import COMMAND, HAND, STATE
from dexkit.traces.sessions.typed import MOST_JOINTS, Count, Rate, Vector, to_record, typed

__all__ = [
    "DATA",
    "DEFAULT",
    "Document",
    "Options",
    "episode_folders",
    "parse_document",
    "read_document",
    "read_episode",
    "session_of",
    "whole_number",
]

DATA = "data.json"
_LARGEST = 1 << 30
_DIRECTIONS = {"states": STATE, "actions": COMMAND}
_COLUMNS = {"q": "qpos", "dq": "qvel", "tau": "torque"}
_PICTURES = ("colors", "depths")
_STAMPS = ("timestamp_ns", "timestamp", "time", "t")  # the first in ns, the others in seconds
_HANDS = {f"{side}_{end}": f"{side}{HAND}" for side in Side for end in ("ee", "hand")}
_HAND_PARTS = frozenset(_HANDS.values())
_AS_ZERO = bytes.maketrans(b"123456789", b"000000000")
_LONG_NUMBER = b"0" * 21
_NS = 10**9
_DAY = 86_400 * _NS
# Share of samples that must lie within a model's limits, and how far beyond they may lie, rad.
_WITHIN, _BEYOND = 0.99, 0.35
_VERSIONS = {
    "old": "xr_teleoperate before v1.0 (left_hand, right_hand)",
    "whole": "xr_teleoperate v1.0 to v1.2 (written at the end)",
    "streamed": "xr_teleoperate v1.3 or later (written item by item)",
}


_Nanoseconds = Annotated[int, msgspec.Meta(ge=0, lt=LAST_NS)]
_Seconds = Annotated[float, msgspec.Meta(ge=0, lt=LAST_NS / _NS)]


class _Image(msgspec.Struct):
    fps: Rate


@dataclass(frozen=True)
class Options:
    """How to import.

    :param rate: frames per second instead of the file's; None to use the file's.
    :param hand: the model's name; ``"none"`` for no model; None to detect it by the number of
        joints.
    :param correct: exchange sides where version and data say that they are swapped.
    """

    rate: float | None = None
    hand: str | None = None
    correct: bool = True


DEFAULT = Options()
"""Default options: everything as in the source."""


@dataclass
class Document:
    """The contents of a ``data.json``.

    :param items: the frames, unchecked.
    :param streamed: it was written item by item.
    :param whole: it ends as it should.
    :param foreign: byte of the first character that is no UTF-8; None without.
    """

    info: dict[str, Any] = field(default_factory=dict)
    text: dict[str, Any] = field(default_factory=dict)
    items: list[Any] = field(default_factory=list)
    streamed: bool = False
    whole: bool = True
    foreign: int | None = None
    rest: dict[str, Any] = field(default_factory=dict)


# -- reading the file
# ------------------------------------------------------------------------------------


def read_document(path: Path) -> Document:
    """Read a ``data.json``.

    :raises SessionError: it cannot be read, or no item in it is whole.
    """
    data = read_bytes(below(path.parent, path.name), _LARGEST, error=SessionError)
    # an interrupted file may end inside a character
    document = parse_document(data.decode("utf-8-sig", "replace"), str(path))
    if document.whole:
        document.foreign = _foreign_character(data)
    return document


def _foreign_character(data: bytes) -> int | None:
    """Where the first byte is that is no UTF-8; None without."""
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        return error.start
    return None


def parse_document(text: str, origin: str) -> Document:
    """Read the text of a ``data.json``, up to the last whole item if it is cut.

    :param origin: what to call it.
    :raises SessionError: there is no whole item in it.
    """
    found, whole = _parsed(text, origin)
    if not isinstance(found, dict) or not isinstance(found.get("data"), list):
        raise SessionError(
            f"{origin} is not an episode: " + ("it has no list 'data'" if whole else "no JSON")
        )
    if not found["data"]:
        raise SessionError(f"{origin} has no whole item")
    head = {k: v for k, v in found.items() if k != "data"}
    try:
        limit_depth(head)
    except ValueError as error:
        raise SessionError(f"{origin}: {error}") from error
    for key in ("info", "text"):
        head[key] = to_record(head.get(key, {}), dict[str, Any], f"{origin}: {key}")
    return Document(
        info=head.pop("info"),
        text=head.pop("text"),
        items=found["data"],
        # whole documents are indented below the brace, streamed ones are not
        streamed=re.match(r'\s*\{\s*\n"', text) is not None,
        whole=whole,
        rest=head,
    )


def _parsed(text: str, origin: str) -> tuple[Any, bool]:
    """The document, and whether it is whole."""
    digits = text.encode("utf-8", "surrogatepass").translate(_AS_ZERO)
    if _LONG_NUMBER not in digits:  # of more digits than whole_number keeps
        with contextlib.suppress(ValueError, RecursionError):
            return msgspec.json.decode(text), True  # three times as quick, and strict
    try:
        return json.loads(text, parse_int=whole_number), True
    except ValueError:
        return _salvage(text), False
    except RecursionError:
        raise SessionError(f"{origin} is nested too deeply") from None


def whole_number(text: str) -> int | float:
    """A whole number of a JSON text; one of more than 64 bits as a float, infinity if need be."""
    return int(text) if len(text) <= 20 else float(text)


def _salvage(text: str) -> dict[str, Any]:
    """Recover the complete members and ``data`` items at the beginning of a document."""
    decoder = json.JSONDecoder(parse_int=whole_number)
    space = re.compile(r"[\s,]*")
    found: dict[str, Any] = {}

    def skip(at: int) -> int:
        match = space.match(text, at)
        return match.end() if match else at

    at = skip(0)
    if text[at : at + 1] != "{":
        return found
    at = skip(at + 1)
    try:
        while text[at : at + 1] == '"':
            key, at = decoder.raw_decode(text, at)
            at = skip(at)
            if text[at : at + 1] != ":":
                break
            at = skip(at + 1)
            if key == "data" and text[at : at + 1] == "[":
                items: list[Any] = []
                found["data"] = items
                at = skip(at + 1)
                while text[at : at + 1] == "{":
                    item, at = decoder.raw_decode(text, at)
                    items.append(item)
                    at = skip(at)
                if text[at : at + 1] != "]":
                    break
                at = skip(at + 1)
            else:
                found[key], at = decoder.raw_decode(text, at)
                at = skip(at)
    except (ValueError, RecursionError):
        pass
    return found


def episode_folders(source: Path) -> list[Path]:
    """The folders with an episode below ``source``, or itself, in order.

    :raises SessionError: it cannot be read.
    """
    if source.name == DATA and source.is_file():
        return [source.parent]
    try:
        if (source / DATA).exists():
            return [source]
        found: list[Path] = []

        def unreadable(error: OSError) -> None:
            found.append(Path(os.fsdecode(error.filename)))  # told when it is read

        for folder, names, files in os.walk(source, onerror=unreadable):
            names.sort()
            if DATA in files:
                found.append(Path(folder))
                names.clear()
        return found
    except OSError as error:
        raise SessionError(f"cannot read {source}: {error.strerror}") from error


def read_episode(folder: Path, options: Options = DEFAULT, *, joints_only: bool = False) -> Session:
    """Read one episode.

    :param joints_only: without the data that are neither joints nor pictures, and without looking
        for swapped hands.
    :raises SessionError: no frame in it can be used.
    """
    document = read_document(folder / DATA)
    form = _VERSIONS[_layout(document)]
    session = session_of(document, folder / DATA, folder, form, options, joints_only=joints_only)
    session.name = folder.name
    return session


def _layout(document: Document) -> str:
    for item in document.items:
        states = item.get("states") if isinstance(item, dict) else None
        if isinstance(states, dict) and ("left_hand" in states or "right_hand" in states):
            return "old"
    return "streamed" if document.streamed else "whole"


# -- building the frames
# ----------------------------------------------------------------------------------


def session_of(
    document: Document,
    source: Path,
    folder: Path,
    form: str,
    options: Options = DEFAULT,
    *,
    joints_only: bool = False,
) -> Session:
    """Make a session from frames of xr_teleoperate.

    :param joints_only: as of :func:`read_episode`.
    :raises SessionError: no frame can be used.
    """
    problems = Problems()
    if not document.whole:
        problems.add("the file is cut or damaged; it is read up to its last whole item")
    if document.foreign is not None:
        problems.add(f"the file is not UTF-8 text (at byte {document.foreign})")
    items = []
    for i, item in enumerate(document.items):
        if not isinstance(item, dict):
            problems.add("items that are no objects are left out", f"item {i}")
        else:
            items.append(item)
    if not items:
        raise SessionError(f"{source} has no frame that can be used")
    stated = _rate(document, options, problems)
    times, clock, rate, first = _times(document, items, stated, problems)
    parts, carried = _parts(items, problems)
    if not parts:
        raise SessionError(
            f"{source} has no frame with joint positions", hint="; ".join(problems.sentences()[:3])
        )
    parts = [_as_hand(p, options, problems) for p in parts]
    session = Session(
        source=source,
        form=form,
        times_ns=times,
        clock=clock,
        rate=rate,
        parts=parts,
        folder=folder,
        cameras=list(_cameras(items, folder, problems)),
        problems=problems,
        first_ns=first,
        stated_rate=stated,
    )
    indexes = [_index(item) for item in items]
    if None not in indexes:
        session.numbers = np.array(indexes, dtype=np.float64)
    cameras = {c.name for c in session.cameras}
    if not joints_only:
        session.rest = _rest(items, carried, cameras, first is not None, problems)
    session.about = {
        "info": json.dumps(document.info, ensure_ascii=False),
        "text": json.dumps(document.text, ensure_ascii=False),
        "rest": json.dumps(document.rest, ensure_ascii=False),
        "task": typed(document.text.get("goal"), str) or "",
        "names": json.dumps(_names(items)),
    }
    if not joints_only:
        correct_sides(session, form, options)
    return session


def _rate(document: Document, options: Options, problems: Problems) -> float:
    if options.rate is not None:
        return options.rate
    if (image := typed(document.info.get("image"), _Image)) is not None:
        return image.fps
    problems.add("the file states no rate (info.image.fps); 30 Hz are assumed")
    return 30.0


def _times(
    document: Document, items: list[dict[str, Any]], rate: float, problems: Problems
) -> tuple[NDArray[np.int64], str, float, int | None]:
    """Times, kind of clock, rate, and the time of frame 0 if the clock is nominal."""
    stamps = [_stamp(item) for item in items]
    if all(s is not None for s in stamps):
        times = [s for s in stamps if s is not None]
        if all(a < b for a, b in pairwise(times)):
            found = np.array(times, dtype=np.int64)
            period = float(np.median(np.diff(found))) if len(found) > 1 else _NS / rate
            return found, MEASURED, _NS / period, None
        problems.add("the times of the frames do not ascend; nominal ones are used")
    elif any(key in item for item in items for key in _STAMPS):
        places = [_place(item) for item, s in zip(items, stamps, strict=True) if s is None]
        for place in places:
            problems.add("frames whose time is missing or none; nominal ones are used", place)
    indexes = [_index(item) for item in items]
    numbers = [n for n in indexes if n is not None]
    if len(numbers) < len(items) or any(a >= b for a, b in pairwise(numbers)):
        problems.add("the numbers of the frames (idx) do not ascend; they are counted instead")
        numbers = list(range(len(items)))
    first = _day(document.info.get("date"))
    if first + numbers[-1] * _NS / rate >= LAST_NS:
        problems.add("the numbers of the frames (idx) are too large; they are counted instead")
        numbers = list(range(len(items)))
    times_ns = np.array([first + round(n * _NS / rate) for n in numbers], dtype=np.int64)
    return times_ns, NOMINAL, rate, first


def _index(item: Mapping[str, Any]) -> int | None:
    """The number of a frame, where the source has one."""
    return typed(item.get("idx"), Count)


def _stamp(item: Mapping[str, Any]) -> int | None:
    """The time of a frame, ns since the epoch, where the source has one."""
    if (value := typed(item.get(_STAMPS[0]), _Nanoseconds)) is not None:
        return value
    for key in _STAMPS[1:]:
        if (seconds := typed(item.get(key), _Seconds)) is not None:
            return round(seconds * _NS)
    return None


def _day(date: object) -> int:
    """Midnight of the file's date, UTC, in ns; :data:`EPOCH_NS` where it has none."""
    try:
        found = datetime.strptime(str(date), "%Y-%m-%d").replace(tzinfo=timezone.utc)
        day = int(found.timestamp()) * _NS
        return day if EPOCH_NS <= day < LAST_NS - _DAY else EPOCH_NS
    except (ValueError, OverflowError):
        return EPOCH_NS


Carried = dict[tuple[str, str, str], set[int]]
"""By direction, part and column of the source: the frames that a part carries."""


def _parts(items: Sequence[dict[str, Any]], problems: Problems) -> tuple[list[Part], Carried]:
    names: dict[str, None] = {}
    for item in items:
        for key in _DIRECTIONS:
            group = item.get(key)
            if isinstance(group, dict):
                names.update(dict.fromkeys(n for n in group if n in names or _is_name(n, problems)))
            elif group is not None:
                problems.add(f"'{key}' is no object", _place(item))
    parts: list[Part] = []
    carried = Carried()
    for name in names:
        if (part := _HANDS.get(name, name)) in {p.name for p in parts}:
            problems.add(f"{name} is kept as JSON only: there is a {part}")
            continue
        values: dict[str, dict[str, Floats]] = {}
        count = 0
        for key, kind in _DIRECTIONS.items():
            columns, frames, width = _table(items, key, name, problems)
            if columns:
                values[kind] = columns
                carried.update(frames)
                count = width
        widths = {v["q"].shape[1] for v in values.values()}
        if len(widths) > 1:
            problems.add(
                f"{name}: states have {values[STATE]['q'].shape[1]} joints and actions "
                f"{values[COMMAND]['q'].shape[1]}; they are kept as two groups"
            )
            for kind, columns in values.items():
                width = columns["q"].shape[1]
                parts.append(Part(f"{name}_{kind}", _joint_names(name, width), {kind: columns}))
        elif values:
            parts.append(Part(part, _joint_names(name, count), values))
    return parts, carried


def _is_name(name: str, problems: Problems) -> bool:
    """Whether it can be a part of a topic."""
    if re.fullmatch(r"\w{1,64}", name, re.ASCII):
        return True
    problems.add(
        "parts and cameras whose names are no words are kept as JSON only", repr(name[:40])
    )
    return False


def _joint_names(part: str, count: int) -> tuple[str, ...]:
    return tuple(f"{part}_{i}" for i in range(count))


def _table(
    items: Sequence[dict[str, Any]], key: str, name: str, problems: Problems
) -> tuple[dict[str, Floats], Carried, int]:
    """The columns of a part in one direction, the frames that have them, and their width."""
    if (quick := _whole_table(items, key, name)) is not None:
        if not quick:
            return {}, {}, 0
        there = set(range(len(items)))
        frames = {(key, name, _COLUMNS[field_]): there for field_ in quick}
        return quick, frames, quick["q"].shape[1]
    rows: dict[str, list[list[float] | None]] = {f: [] for f in _COLUMNS}
    for item in items:
        group = item.get(key)
        entry = group.get(name) if isinstance(group, dict) else None
        for field_, column in _COLUMNS.items():
            value = entry.get(column) if isinstance(entry, dict) else None
            numbers = typed(value, Vector)
            if numbers is None and value is not None:
                problems.add(
                    f"{key}.{name}.{column} is no list of numbers, {MOST_JOINTS} at most",
                    _place(item),
                )
            if numbers and not np.isfinite(numbers).all():
                problems.add(f"{key}.{name}.{column} has values that are not finite", _place(item))
                numbers = None
            rows[field_].append(numbers or None)
    widths = Counter(len(r) for r in rows["q"] if r)
    if not widths:
        return {}, {}, 0
    width = widths.most_common(1)[0][0]
    found: dict[str, Floats] = {}
    frames = Carried()
    for field_, column in _COLUMNS.items():
        table = np.full((len(items), width), np.nan)
        there = set()
        for i, row in enumerate(rows[field_]):
            if row and len(row) == width:
                table[i] = row
                there.add(i)
            elif row:
                problems.add(
                    f"{key}.{name}.{column}: frames with {len(row)} values instead of {width} are "
                    "left out",
                    _place(items[i]),
                )
        if field_ != "q" and there and not there >= _present(found["q"]):
            problems.add(f"{key}.{name}.{column} is not in every frame; it is kept as JSON only")
            continue
        if there:
            found[field_] = table
            frames[key, name, column] = there
    return found, frames, width


def _whole_table(items: Sequence[dict[str, Any]], key: str, name: str) -> dict[str, Floats] | None:
    """The columns of a part in one direction, if every frame has all of its values or none."""
    try:
        entries = [item[key][name] for item in items]
        found = {}
        for field_, column in _COLUMNS.items():
            values = [entry.get(column) for entry in entries]
            if any(values):
                rows = typed(values, list[Vector])
                if rows is None:
                    return None
                found[field_] = np.array(rows, dtype=np.float64)
    except (KeyError, TypeError, AttributeError, ValueError):
        return None
    if not found:
        return {}
    good = "q" in found and all(np.isfinite(table).all() for table in found.values())
    shapes = {table.shape for table in found.values()}
    return found if good and len(shapes) == 1 and len(next(iter(shapes))) == 2 else None


def _present(table: Floats) -> set[int]:
    return set(np.flatnonzero(np.isfinite(table).all(axis=1)).tolist())


def _place(item: Mapping[str, Any]) -> str:
    return f"item {item['idx']}" if isinstance(item.get("idx"), int) else "an item without idx"


def _as_hand(part: Part, options: Options, problems: Problems) -> Part:
    """The part as a hand of a model, if it is one."""
    if part.name not in _HAND_PARTS or options.hand == "none":
        return part
    count = len(part.joints)
    if options.hand is not None:
        hand = model(options.hand)
        if len(hand.joints[Side.LEFT]) != count:
            problems.add(f"{part.name} has {count} joints, which is no {hand.name}")
            return part
        return _named(part, hand)
    fitting = [m for m in models_by_joints(count) if _within_limits(part, m)]
    if len(fitting) == 1:
        return _named(part, fitting[0])
    if fitting:
        names = ", ".join(m.name for m in fitting)
        problems.add(f"{part.name} may be one of {names}; it is kept as a group of joints")
    elif candidates := models_by_joints(count):
        names = ", ".join(m.name for m in candidates)
        problems.add(
            f"{part.name} has as many joints as {names}, but positions far outside its limits; "
            "it is kept as a group of joints"
        )
    return part


def _named(part: Part, hand: HandModel) -> Part:
    joints = hand.joints[part.side]
    return Part(part.name, tuple(j.name for j in joints), part.values, hand)


def _within_limits(part: Part, hand: HandModel) -> bool:
    joints = hand.joints[part.side]
    low = np.array([j.q_min for j in joints]) - _BEYOND
    high = np.array([j.q_max for j in joints]) + _BEYOND
    for columns in part.values.values():
        q = columns["q"][np.isfinite(columns["q"]).all(axis=1)]
        if len(q) and ((q >= low) & (q <= high)).mean() < _WITHIN:
            return False
    return True


def _cameras(items: Sequence[dict[str, Any]], folder: Path, problems: Problems) -> Iterator[Camera]:
    names: dict[tuple[str, str], None] = {}
    for item in items:
        for key in _PICTURES:
            group = item.get(key)
            if isinstance(group, dict):
                names.update(dict.fromkeys((key, n) for n in group if _is_name(n, problems)))
    for key, name in names:
        paths = []
        for item in items:
            group = item.get(key)
            path = group.get(name) if isinstance(group, dict) else None
            if not isinstance(path, str) or not path:
                problems.add(f"{key}.{name}: frames without a picture", _place(item))
                paths.append("")
                continue
            try:
                file = below(folder, path)
            except SessionError as error:
                problems.add(f"{key}.{name}: pictures are left out: {error.message}")
                paths.append("")
                continue
            if not file.exists():
                problems.add(f"{key}.{name}: pictures that are missing", path)
            paths.append(path)
        if any(paths):
            yield Camera(name, tuple(paths), key)


def _rest(
    items: Sequence[dict[str, Any]],
    carried: Carried,
    cameras: Iterable[str],
    numbered: bool,
    problems: Problems,
) -> list[str]:
    """Data of each frame outside of parts and cameras, as JSON; empty where they do not change.

    :param numbered: the number of a frame follows from its time.
    """
    found: list[str] = []
    before: str | None = None
    for i, item in enumerate(items):
        rest = {k: v for k, v in item.items() if k != "idx" or not numbered}
        for key in _DIRECTIONS:
            if isinstance(rest.get(key), dict):
                rest[key] = {
                    name: {
                        c: v for c, v in entry.items() if i not in carried.get((key, name, c), ())
                    }
                    if isinstance(entry, dict)
                    else entry
                    for name, entry in rest[key].items()
                }
        for key in _PICTURES:
            if isinstance(rest.get(key), dict):
                rest[key] = {
                    n: v for n, v in rest[key].items() if n not in cameras or not isinstance(v, str)
                }
        try:
            limit_depth(rest)
        except ValueError as error:
            problems.add(f"what an item has beside joints is left out: {error}", _place(item))
            rest = {}
        text = json.dumps(rest, ensure_ascii=False, sort_keys=False)
        found.append("" if text == before else text)
        before = text
    return found


def _names(items: Sequence[dict[str, Any]]) -> dict[str, str]:
    """The source's name of each hand: ``{"left_hand": "left_ee"}``."""
    found = {}
    for item in items:
        for key in _DIRECTIONS:
            group = item.get(key)
            if isinstance(group, dict):
                found.update({_HANDS[n]: n for n in group if n in _HANDS})
    return found


def correct_sides(session: Session, form: str, options: Options) -> None:
    """Exchange the hands' states where the data show that they are swapped."""
    evidence = swapped_sides(session.parts, session.rate)
    if evidence is None or not evidence.swapped:
        return
    hands = [p for p in session.parts if p.name in _HAND_PARTS]
    six = all(len(p.joints) == 6 for p in hands)
    why = (
        "xr_teleoperate v1.0 and v1.1 record the states of Inspire hands so"
        if six
        else "the program that wrote it mixed up the order of the two hands"
    )
    if options.correct:
        session.parts = swap_states(session.parts)
        session.corrections.append(
            f"states of left and right hand exchanged: in the source, {evidence}; {why}"
        )
    else:
        session.problems.add(f"left and right hand look swapped: {evidence}; left as they are")

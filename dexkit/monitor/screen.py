"""The screen of ``dexkit monitor`` as lines of text, of any width and height; sans IO."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rich.cells import cell_len, set_cell_size
from rich.text import Text

from dexkit.escaping import one_line
from dexkit.monitor.bars import ASCII, UNICODE, Signs, bar
from dexkit.watch import Picture, SubjectView, TopicView
from dexkit.watch.events import Event
from dexkit.watch.number_format import number, seconds, subject_name

__all__ = ["Shown", "hand_lines", "screen", "summary", "topic_lines"]

_COLUMN = 39
"""Cells that a hand needs; two fit 80 columns."""
_Q, _TAU = 6, 6
_LEAST_BAR = 9
_MOVING = 0.05  # rad/s
_STYLES = {"info": "", "warn": "yellow", "bad": "bold red"}
_KEYS = "q quit  space pause  r record  c clear events  up/down scroll"


@dataclass(frozen=True)
class Shown:
    """Contents of the screen besides the picture.

    :param title: domain and interface.
    :param clock: the time of day.
    :param recording: what the recorder says, or empty.
    :param scroll: lines of the hands that are above the screen.
    :param unicode: whether the terminal shows more than ASCII.
    """

    title: str
    clock: str
    recording: str = ""
    paused: bool = False
    scroll: int = 0
    unicode: bool = True

    @property
    def signs(self) -> Signs:
        """Characters of the bars."""
        return UNICODE if self.unicode else ASCII


def screen(
    picture: Picture,
    events: Sequence[tuple[str, Event]],
    shown: Shown,
    width: int,
    height: int,
) -> list[Text]:
    """Exactly ``height`` lines of at most ``width`` cells.

    Topics and events have their place at the bottom; the hands have the rest, and are scrolled.

    :param events: oldest first, each with its time of day.
    """
    hands = _body(picture.subjects, shown, width)
    topics = topic_lines(picture.topics, width)
    left = max(0, height - 2)
    least = min(len(events) + 1, 4) if left > 12 else 0
    most_topics = max(2, left // 3) if left > 4 else 0
    if len(topics) > most_topics and len(hands) + len(topics) + least > left:
        rest = len(topics) - most_topics + 1
        topics = [*topics[: most_topics - 1], Text(f"  and {rest} more", "dim")][:most_topics]
    room = max(0, left - len(topics) - least)
    body = _scrolled(hands, room, shown.scroll)
    told = [_event_line(clock, event) for clock, event in events]
    space = left - len(body) - len(topics)
    if space > 0 and told:
        told = [Text("events", "bold"), *told[-(space - 1) :]] if space > 1 else told[-1:]
    else:
        told = []
    filler = [Text("")] * (left - len(body) - len(topics) - len(told))
    lines = [_title(shown, width), *body, *topics, *told, *filler, Text(_KEYS, "dim")][:height]
    for line in lines:
        line.truncate(width, overflow="crop")
    return lines


def _title(shown: Shown, width: int) -> Text:
    line = Text("dexkit monitor", "bold")
    line.append(f"  {one_line(shown.title)}  ", "none")
    line.append(shown.clock, "dim")
    if shown.paused:
        line.append("  PAUSED", "bold yellow")
    if shown.recording:
        line.append(f"  {one_line(shown.recording)}", "bold red")
    return line


def _scrolled(lines: list[Text], room: int, scroll: int) -> list[Text]:
    """The visible lines, with notes of how many are hidden above and below."""
    if len(lines) <= room:
        return lines
    if room < 3:
        return lines[:room]
    first = min(max(0, scroll), len(lines) - room)
    seen = lines[first : first + room]
    if first:
        seen[0] = Text(f"  {first + 1} lines above", "dim")
    if below := len(lines) - first - room:
        seen[-1] = Text(f"  {below + 1} lines below", "dim")
    return seen


def _body(views: Sequence[SubjectView], shown: Shown, width: int) -> list[Text]:
    if not views:
        return [Text("No hand has been seen here yet.", "dim")]
    columns = max(1, (width + 1) // (_COLUMN + 1))
    lines: list[Text] = []
    row: list[list[Text]] = []
    small = [v for v in views if len(v.joints) <= _MOST_JOINTS]
    for view in small:
        row.append(hand_lines(view, shown.signs, _cells(width, min(columns, len(small)))))
        if len(row) == columns:
            lines += _beside(row, _cells(width, columns))
            row = []
    if row:
        lines += _beside(row, _cells(width, min(columns, len(small))))
    for view in views:
        if len(view.joints) > _MOST_JOINTS:
            lines += _spread(view, shown.signs, width, columns)
    return lines


_MOST_JOINTS = 20
"""A hand or robot with more joints takes the whole width."""


def _cells(width: int, columns: int) -> int:
    return max(1, (width - (columns - 1)) // columns)


def _spread(view: SubjectView, signs: Signs, width: int, columns: int) -> list[Text]:
    """A robot: its joints in all columns, below one head."""
    cells = _cells(width, columns)
    head = _head(view)
    joints = [_joint(view, i, signs, cells) for i in range(len(view.joints))]
    rows = -(-len(joints) // columns)
    return [*head, *_beside([joints[i : i + rows] for i in range(0, len(joints), rows)], cells)]


def _beside(blocks: Iterable[list[Text]], cells: int) -> list[Text]:
    blocks = list(blocks)
    lines = []
    for i in range(max(map(len, blocks))):
        line = Text()
        for k, block in enumerate(blocks):
            part = block[i].copy() if i < len(block) else Text()
            part.truncate(cells, overflow="crop", pad=k < len(blocks) - 1)
            line.append_text(part)
            if k < len(blocks) - 1:
                line.append(" ")
        lines.append(line)
    return lines


def hand_lines(view: SubjectView, signs: Signs, width: int) -> list[Text]:
    """A hand: ages, who commands, faults, a line for each joint, and its fingers' pressures."""
    joints = [_joint(view, i, signs, width) for i in range(len(view.joints))]
    return [*_head(view), *joints, *_touch(view)]


def _touch(view: SubjectView) -> list[Text]:
    """What touches each finger: counts, three a line, or the change of pressure since rest."""
    if not len(view.touch):
        changes = [
            f"{one_line(name)} {'+' if v >= 0 else ''}{number(v, 0)}"
            for name, v in view.touched.items()
        ]
        return [Text(f"touch {'  '.join(changes)}  from rest", "dim")] if changes else []
    told = [f"{one_line(name)} {number(count, 0)}" for name, count in view.touched.items()]
    return [
        Text(f"{'' if i else 'touch':6}{'  '.join(told[i : i + 3])}", "dim")
        for i in range(0, len(told), 3)
    ]


def _head(view: SubjectView) -> list[Text]:
    first = Text(subject_name(view), "bold")
    if not math.isfinite(view.age):
        first.append("  no state", _STYLES["bad"])
    else:
        first.append(f"  state {seconds(view.age)}", _STYLES["bad"] if view.stale else "none")
    if math.isfinite(view.command_age):
        old = view.command_age > view.command_timeout
        first.append(f"  cmd {seconds(view.command_age)}", "dim" if old else "none")
    lines = [first]
    who = ", ".join(one_line(p) for p in view.commanders if p != "?") or "a process without a name"
    many = len(view.commanders)
    if not many:
        lines.append(Text("  nobody commands", "dim"))
    else:
        text = f"  commanded by {f'{many}: ' if many > 1 else ''}{who}"
        lines.append(Text(text, _STYLES["warn"] if many > 1 else "dim"))
    lines += [Text(f"! {text}", _STYLES["bad"]) for text in view.faults[:2]]
    if len(view.faults) > 2:
        lines.append(Text(f"! and {len(view.faults) - 2} more faults", _STYLES["bad"]))
    return lines


def _joint(view: SubjectView, i: int, signs: Signs, width: int) -> Text:
    joint = view.joints[i]
    bad, near = bool(view.fault[i]), int(view.near[i])
    style = "dim" if view.stale else _STYLES["bad" if bad else "warn" if near else "info"]
    kinds = {"line": "dim", "ghost": "cyan", "measured": style or "green"}
    names = [_short(j.name) for j in view.joints]
    most = max(4, width - _Q - _TAU - 2 - _LEAST_BAR)
    cells_of_name = min(max(map(cell_len, names)), most)
    cells = max(3, width - cells_of_name - _Q - _TAU - 2)
    line = Text(set_cell_size(names[i], cells_of_name) + " ", style or "none")
    for text, kind in bar(
        signs, cells, joint.q_min, joint.q_max, float(view.q[i]), float(view.target[i])
    ):
        line.append(text, kinds[kind])
    mark = "!" if bad else "<" if near < 0 else ">" if near > 0 else " "
    line.append(f"{number(float(view.q[i])):>{_Q}}{mark}", style or "none")
    tau = number(float(view.tau[i]), 2)
    line.append(f"{tau:>{_TAU}}", _STYLES["warn"] if view.torque_part[i] > 0.9 else "dim")
    return line


def _short(name: str) -> str:
    """A joint's name for a narrow column: ``r_shoulder_pitch``."""
    for side in ("left", "right"):
        if name.startswith(f"{side}_"):
            return one_line(f"{side[0]}_{name[len(side) + 1 :]}")
    return one_line(name)


def topic_lines(views: Sequence[TopicView], width: int) -> list[Text]:
    """A table of the topics: rate, the vendor's, age, gaps, missed cycles, publishers."""
    if not views:
        return []
    longest = max(cell_len(one_line(v.name)) for v in views)
    name = max(8, min(longest, width - 50))
    head = (
        f"{'topic':{name}} {'Hz':>5} {'of':>5} {'age':>7} {'gaps':>5} {'missed':>6} {'longest':>7}"
    )
    lines = [Text(f"{head}  by", "bold")]
    order = sorted(views, key=lambda v: (v.role == "other", v.name))
    lines += [_topic(view, name) for view in order]
    return lines


def _topic(view: TopicView, name: int) -> Text:
    old = not view.age <= 1.0
    slow = view.expected > 0 and view.rate < 0.9 * view.expected and view.samples > 1
    line = Text(set_cell_size(one_line(view.name), name), "dim" if old else "none")
    line.append(f" {view.rate:5.0f}", _STYLES["warn"] if slow else "none")
    line.append(f" {view.expected:5.0f}" if view.expected else " " * 6, "dim")
    line.append(f" {seconds(view.age):>7}", _STYLES["bad"] if old and view.samples else "none")
    some = _STYLES["warn"] if view.gaps else "dim"
    line.append(f" {view.gaps:5} {view.missed:6}", some)
    line.append(f" {seconds(view.longest) if view.gaps else '':>7}", "dim")
    if view.undecodable:
        line.append(f"  {view.undecodable} undecodable", _STYLES["bad"])
    who = ", ".join(one_line(p) for p in view.publishers) or "nobody"
    many = view.writers > 1
    line.append(f"  {who}", _STYLES["bad"] if many else "dim")
    return line


def _event_line(clock: str, event: Event) -> Text:
    return Text.assemble(
        (f"{clock} ", "dim"), (one_line(event.text), _STYLES[event.kind] or "none")
    )


def summary(view: SubjectView) -> str:
    """A hand or robot in one line, for a log."""
    what = "no state" if view.stale else "moves" if _moves(view) else "rests"
    parts = [f"{subject_name(view)}: {what}"]
    parts.append(f"state {seconds(view.age)}, cmd {seconds(view.command_age)}")
    if len(view.joints) <= _MOST_JOINTS:
        parts.append("q " + " ".join(number(float(q)) for q in view.q))
    parts += view.faults
    return one_line("; ".join(parts))


def _moves(view: SubjectView) -> bool:
    return bool((abs(view.dq) > _MOVING).any())

"""Curves of recordings as HTML: commands and states of every joint, rates and gaps of topics.

Several recordings are drawn beside each other on equal axes, or two over each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.report.pages import document
from dexkit.conformance.report.svg_charts import Level, Line, chart
from dexkit.conformance.report.tables import no_wrap, table
from dexkit.escaping import html as escape
from dexkit.hand import Floats, JointSpec, Side
from dexkit.models import MODELS
from dexkit.robots import ROBOTS
from dexkit.traces import Trace
from dexkit.traces.sessions.streams import COMMAND, HAND, STATE, Stream, streams_of

__all__ = ["Recorded", "beside", "over_each_other", "page", "recorded"]

_WINDOW = 0.5  # seconds over which a rate is counted
_LEAST = 3  # messages of a topic whose rate is drawn


@dataclass(frozen=True, eq=False)
class Recorded:
    """Data of a recording for drawing.

    :param name: for people.
    :param begin_ns: log time of second 0.
    :param seconds: length of the time line.
    :param times: of the messages of each topic, ns since the epoch.
    """

    name: str
    begin_ns: int
    seconds: float
    streams: tuple[Stream, ...]
    times: Mapping[str, NDArray[np.int64]]

    def find(self, part: str, kind: str) -> Stream | None:
        """A stream, or None."""
        return next((s for s in self.streams if (s.part, s.kind) == (part, kind)), None)

    def t(self, times_ns: NDArray[np.int64]) -> Floats:
        """Seconds on the time line."""
        return np.asarray((times_ns - self.begin_ns) / 1e9)


def recorded(trace: Trace, name: str = "", begin_ns: int | None = None) -> Recorded:
    """Read the curves of a recording.

    :param begin_ns: log time of second 0; None for the first message.
    :raises TraceUnreadable: the file cannot be read.
    """
    begin = trace.first_ns if begin_ns is None else begin_ns
    return Recorded(
        name or trace.path.name,
        begin,
        max((trace.last_ns - begin) / 1e9, 0.1),
        tuple(streams_of(trace)),
        {topic: some.log_time_ns for topic, some in trace.load(payloads=False).items()},
    )


def page(recordings: Sequence[Recorded]) -> str:
    """A page about recordings, beside each other."""
    title = ", ".join(r.name for r in recordings)
    content = [f"<h1>{escape(title)}</h1>", beside(recordings), topics(recordings)]
    return document(title, "".join(content))


def beside(recordings: Sequence[Recorded]) -> str:
    """Every joint: a chart for each recording, on equal axes."""
    sections = [_key()]
    for part in _parts(recordings):
        joints = _joints(recordings, part)
        sections.append(f"<h2>{escape(_title(part))}</h2>")
        for name in joints:
            sections.append(f'<p class="joint"><b>{escape(name)}</b></p>')
            curves = [_curves(r, part, name) for r in recordings]
            reach = _reach(part, name, recordings, curves)
            span = 0.0, max(r.seconds for r in recordings)
            charts = [
                chart(
                    f"{r.name}, {_title(part)}, {name}: command and state",
                    lines,
                    y_unit="rad",
                    span=span,
                    height=130,
                    include=reach,
                    legend=False,
                    titled=False,
                )
                for r, lines in zip(recordings, curves, strict=True)
            ]
            sections.append(_row(recordings, charts))
    if len(sections) == 1:
        sections.append("<p>No joints of hands or robots are in it.</p>")
    return "".join(sections)


def over_each_other(
    one: Recorded, other: Recorded, order: Sequence[tuple[str, str, str, str]]
) -> str:
    """Joints of two recordings on one clock, in one chart each.

    :param order: (part, kind, joint, what is said of it) of each chart.
    """
    sections = [
        f'<p class="key"><span><i class="state"></i>{escape(one.name)}</span>'
        f'<span><i class="other"></i>{escape(other.name)}</span></p>'
    ]
    span = 0.0, max(one.seconds, other.seconds)
    for part, kind, name, text in order:
        lines = [
            Line(r.name, css, *_column(r, part, kind, name))
            for r, css in ((one, "state"), (other, "other"))
        ]
        sections.append(
            f'<p class="joint"><b>{escape(name)}</b> {escape(kind)}: {escape(text)}</p>'
        )
        sections.append(
            chart(
                f"{name}, {kind}",
                [line for line in lines if len(line.x)],
                y_unit="rad",
                span=span,
                height=150,
                legend=False,
                titled=False,
            )
        )
    return "".join(sections)


def topics(recordings: Sequence[Recorded]) -> str:
    """Rates and gaps of every topic: a table, and charts over time."""
    sections = ["<h2>Rates and gaps</h2>"]
    names = sorted({t for r in recordings for t in r.times})
    rows = [
        (no_wrap(escape(topic)), *(_counts(r.times.get(topic)) for r in recordings))
        for topic in names
    ]
    sections.append(table(("topic", *(escape(r.name) for r in recordings)), rows))
    span = 0.0, max(r.seconds for r in recordings)
    for topic in names:
        if max(len(r.times.get(topic, ())) for r in recordings) < _LEAST:
            continue
        sections.append(f'<p class="joint"><b>{escape(topic)}</b></p>')
        charts = [_timing(r, topic, span) for r in recordings]
        most = max((float(i.max(initial=0.0)) for _, i in charts), default=0.0)
        drawn = [
            chart(
                f"{r.name}, {topic}: interval since the message before",
                [Line("interval", "state", t, intervals)],
                y_unit="ms",
                span=span,
                height=110,
                include=(0.0, most),
                legend=False,
                titled=False,
            )
            + _rate_chart(r, topic, span)
            for r, (t, intervals) in zip(recordings, charts, strict=True)
        ]
        sections.append(_row(recordings, drawn))
    return "".join(sections)


# ---------------------------------------------------------------------------------------- pieces


def _row(recordings: Sequence[Recorded], charts: Sequence[str]) -> str:
    many = len(recordings) > 1
    cells = "".join(
        f"<div>{f'<p class=dim>{escape(r.name)}</p>' if many else ''}{drawn}</div>"
        for r, drawn in zip(recordings, charts, strict=True)
    )
    return f'<div class="beside">{cells}</div>'


def _key() -> str:
    return (
        '<p class="key"><span><i class="cmd"></i>command: the commanded position</span>'
        '<span><i class="state"></i>state: the reported position</span></p>'
    )


def _parts(recordings: Sequence[Recorded]) -> list[str]:
    return list(dict.fromkeys(s.part for r in recordings for s in r.streams))


def _joints(recordings: Sequence[Recorded], part: str) -> list[str]:
    """Joints of a part that moved or were commanded anywhere, in their order."""
    found: dict[str, None] = {}
    for r in recordings:
        for stream in r.streams:
            if stream.part == part:
                found.update(dict.fromkeys(stream.joints))
    return list(found)


def _column(r: Recorded, part: str, kind: str, joint: str) -> tuple[Floats, Floats]:
    stream = r.find(part, kind)
    if stream is not None:
        for names in (stream.joints, stream.names):
            if joint in names:
                return r.t(stream.times_ns), stream.q[:, names.index(joint)]
    empty: Floats = np.empty(0)
    return empty, empty


def _curves(r: Recorded, part: str, joint: str) -> list[Line]:
    found = [
        Line(kind, css, *_column(r, part, kind, joint))
        for kind, css in ((COMMAND, "cmd"), (STATE, "state"))
    ]
    return [line for line in found if len(line.x)]


def _reach(
    part: str, joint: str, recordings: Sequence[Recorded], curves: Sequence[Sequence[Line]]
) -> tuple[float, ...]:
    """Values that each chart of the joint reaches: its limits, and what any of them shows."""
    values = [line.y[np.isfinite(line.y)] for lines in curves for line in lines]
    found = [float(f) for v in values if len(v) for f in (v.min(), v.max())]
    spec = _spec(part, joint, recordings)
    if spec is not None:
        found += [spec.q_min, spec.q_max]
    return tuple(found)


def _spec(part: str, joint: str, recordings: Sequence[Recorded]) -> JointSpec | None:
    name = next((s.model for r in recordings for s in r.streams if s.part == part), "")
    specs: Sequence[JointSpec] = ()
    if name in MODELS and part.endswith(HAND):
        hand = MODELS[name]
        # a gripper's dialects scale its joint
        specs = () if len(hand.joints[Side.LEFT]) == 1 else hand.joints[Side(part[: -len(HAND)])]
    elif name in ROBOTS:
        specs = [ROBOTS[name].joint(i) for i in ROBOTS[name].used]
    return next((s for s in specs if s.name == joint), None)


def _title(part: str) -> str:
    return part.replace("_", " ")


def _counts(times: NDArray[np.int64] | None) -> str:
    if times is None or not len(times):
        return "none"
    if len(times) < 2 or times[-1] == times[0]:
        return f"{len(times)} messages"
    gaps = np.diff(times) / 1e6
    rate = (len(times) - 1) * 1e9 / float(times[-1] - times[0])
    return (
        f"{rate:.1f} Hz, {len(times)} messages; intervals {np.median(gaps):.2f} ms, "
        f"99 % {np.percentile(gaps, 99):.2f} ms, longest {gaps.max():.1f} ms"
    )


def _timing(r: Recorded, topic: str, span: tuple[float, float]) -> tuple[Floats, Floats]:
    times = r.times.get(topic, np.empty(0, dtype=np.int64))
    return r.t(times[1:]), np.asarray(np.diff(times) / 1e6)


def _rate_chart(r: Recorded, topic: str, span: tuple[float, float]) -> str:
    t = r.t(r.times.get(topic, np.empty(0, dtype=np.int64)))
    edges = np.arange(0.0, r.seconds, _WINDOW)
    if len(edges) < 3:
        return ""
    counts, _ = np.histogram(t, bins=edges)
    mean = len(t) / r.seconds
    return chart(
        f"{r.name}, {topic}: messages a second",
        [Line("rate", "force", np.asarray(edges[1:] - _WINDOW / 2), np.asarray(counts / _WINDOW))],
        y_unit="Hz",
        span=span,
        height=90,
        include=(0.0, mean),
        levels=[Level(mean, f"mean {mean:.1f} Hz")],
        legend=False,
        titled=False,
    )

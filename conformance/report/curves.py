"""Curves of recordings: commands and states of every joint, rates and gaps of topics.

Several recordings are drawn beside each other on equal axes, or two over each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.report.charts import Chart, Level, Line
from dexkit.conformance.report.pages import fill
from dexkit.hand import Floats, JointSpec, Side
from dexkit.models import MODELS
from dexkit.robots import ROBOTS
from dexkit.traces import Trace
from dexkit.traces.sessions.streams import COMMAND, HAND, STATE, Stream, streams_of

__all__ = ["Recorded", "Row", "beside", "difference_page", "page", "recorded"]

_WINDOW = 0.5  # seconds over which a rate is counted
_LEAST = 3  # messages of a topic whose rate is drawn
_NO_TIMES = np.empty(0, dtype=np.int64)


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

    def t(self, times_ns: NDArray[np.int64]) -> Floats:
        """Seconds on the time line."""
        return np.asarray((times_ns - self.begin_ns) / 1e9)

    def times_of(self, topic: str) -> NDArray[np.int64]:
        """Those of a topic's messages; none if it is not in the recording."""
        return self.times.get(topic, _NO_TIMES)

    def joint(self, part: str, kind: str, name: str, css: str, label: str) -> Line:
        """The curve of a joint; an empty one if the recording has none."""
        for stream in self.streams:
            if (stream.part, stream.kind) == (part, kind):
                for names in (stream.joints, stream.names):
                    if name in names:
                        q = stream.q[:, names.index(name)]
                        return Line(label, css, self.t(stream.times_ns), q)
        return Line(label, css, np.empty(0), np.empty(0))


@dataclass(frozen=True, eq=False)
class Row:
    """Charts of a joint or a topic.

    :param charts: of each recording, beside each other.
    """

    name: str
    charts: Sequence[Sequence[Chart]]
    text: str = ""


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
    return _page(title, recordings, parts=beside(recordings))


def difference_page(
    title: str,
    texts: Sequence[str],
    one: Recorded,
    other: Recorded,
    order: Sequence[tuple[str, str, str, str]],
) -> str:
    """A page about joints of two recordings on one clock, in one chart each.

    :param texts: paragraphs below the title.
    :param order: (part, kind, joint, what is said of it) of each chart.
    """
    rows = []
    for part, kind, name, text in order:
        lines = [
            one.joint(part, kind, name, "state", one.name),
            other.joint(part, kind, name, "other", other.name),
        ]
        chart = Chart(f"{name}, {kind}", lines, _span((one, other)), "rad", height=150, bare=True)
        rows.append(Row(name, [[chart]], f" {kind}: {text}"))
    return _page(title, (one, other), texts=texts, rows=rows)


def _page(
    title: str,
    recordings: Sequence[Recorded],
    *,
    texts: Sequence[str] = (),
    parts: Mapping[str, Sequence[Row]] | None = None,
    rows: Sequence[Row] = (),
) -> str:
    """A page about recordings.

    :param parts: rows of joints, by hand or robot; None for a page of ``rows``.
    """
    topics = sorted({t for r in recordings for t in r.times})
    return fill(
        "recordings.html",
        title=title,
        texts=texts,
        names=[r.name for r in recordings],
        parts=parts,
        rows=rows,
        counts=[(topic, *(_counts(r.times_of(topic)) for r in recordings)) for topic in topics],
        timing=list(_timing(recordings, topics)),
    )


def beside(recordings: Sequence[Recorded]) -> dict[str, list[Row]]:
    """Every joint of each hand or robot: a chart for each recording, on equal axes."""
    found: dict[str, list[Row]] = {}
    for part in dict.fromkeys(s.part for r in recordings for s in r.streams):
        title = part.replace("_", " ")
        joints = [j for r in recordings for s in r.streams if s.part == part for j in s.joints]
        for name in dict.fromkeys(joints):
            curves = [
                [
                    r.joint(part, kind, name, css, kind)
                    for kind, css in ((COMMAND, "cmd"), (STATE, "state"))
                ]
                for r in recordings
            ]
            reach = _reach(_spec(part, name, recordings), curves)
            charts = [
                Chart(
                    f"{r.name}, {title}, {name}: command and state",
                    lines,
                    _span(recordings),
                    "rad",
                    include=reach,
                    height=130,
                    bare=True,
                )
                for r, lines in zip(recordings, curves, strict=True)
            ]
            found.setdefault(title, []).append(Row(name, [[chart] for chart in charts]))
    return found


def _span(recordings: Sequence[Recorded]) -> tuple[float, float]:
    return 0.0, max(r.seconds for r in recordings)


def _reach(spec: JointSpec | None, curves: Sequence[Sequence[Line]]) -> tuple[float, ...]:
    """Values that each chart of a joint reaches: its limits, and what any of them shows."""
    values = [line.y[np.isfinite(line.y)] for lines in curves for line in lines]
    found = [float(f) for v in values if len(v) for f in (v.min(), v.max())]
    return (*found, spec.q_min, spec.q_max) if spec is not None else tuple(found)


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


def _counts(times: NDArray[np.int64]) -> str:
    if not len(times):
        return "none"
    if len(times) < 2 or times[-1] == times[0]:
        return f"{len(times)} messages"
    gaps = np.diff(times) / 1e6
    rate = (len(times) - 1) * 1e9 / float(times[-1] - times[0])
    return (
        f"{rate:.1f} Hz, {len(times)} messages; intervals {np.median(gaps):.2f} ms, "
        f"99 % {np.percentile(gaps, 99):.2f} ms, longest {gaps.max():.1f} ms"
    )


def _timing(recordings: Sequence[Recorded], topics: Sequence[str]) -> Iterator[Row]:
    """Intervals between the messages of each topic, and their rate."""
    for topic in topics:
        if max(len(r.times_of(topic)) for r in recordings) >= _LEAST:
            steps = [np.diff(r.times_of(topic)) / 1e6 for r in recordings]
            most = max(float(s.max(initial=0.0)) for s in steps)
            yield Row(
                topic,
                [
                    [
                        Chart(
                            f"{r.name}, {topic}: interval since the message before",
                            [Line("interval", "state", r.t(r.times_of(topic)[1:]), intervals)],
                            _span(recordings),
                            "ms",
                            include=(0.0, most),
                            height=110,
                            bare=True,
                        ),
                        *_rates(r, topic, _span(recordings)),
                    ]
                    for r, intervals in zip(recordings, steps, strict=True)
                ],
            )


def _rates(r: Recorded, topic: str, span: tuple[float, float]) -> Iterator[Chart]:
    """Messages a second; no chart of a short recording."""
    t, edges = r.t(r.times_of(topic)), np.arange(0.0, r.seconds, _WINDOW)
    if len(edges) >= 3:
        counts, _ = np.histogram(t, bins=edges)
        mean = len(t) / r.seconds
        yield Chart(
            f"{r.name}, {topic}: messages a second",
            [
                Line(
                    "rate",
                    "force",
                    np.asarray(edges[1:] - _WINDOW / 2),
                    np.asarray(counts / _WINDOW),
                )
            ],
            span,
            "Hz",
            levels=[Level(mean, f"mean {mean:.1f} Hz")],
            include=(0.0,),
            height=90,
            bare=True,
        )

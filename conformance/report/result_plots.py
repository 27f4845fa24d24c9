"""Draw the plots that a result names (:mod:`dexkit.conformance.kit.plots`) from its recording.

Most are curves over time: what each shows stands in a table, :data:`_CURVES`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from dexkit.conformance.behaviours.operator import OPERATOR, operator_of
from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.conformance.kit.recording import Recording, SideView
from dexkit.conformance.kit.requirements import Requirement
from dexkit.conformance.kit.results import Result
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.report.charts import Band, Chart, Level, Line, Range, histogram
from dexkit.conformance.report.labels import whose
from dexkit.conformance.report.pages import fill
from dexkit.conformance.report.usb_plots import usb_plots
from dexkit.errors import UsageError
from dexkit.hand import Floats, Side, Subject
from dexkit.pressure import known, resting_pressure

__all__ = ["command_and_state", "followed", "phase_bands", "plots_of"]

_PHASES = {
    "approach": "to mid",
    "step": "steps",
    "joint": "joint by joint",
    "nan": "NaN",
    "short": "too short",
    "long": "too long",
    "limp": "zero gains",
    "unlike": "other gains",
    "soft": "low gains",
    "lock": "locked",
    "replay": "replayed session",
    "beside-grip": "beside a grip",
    "drive": "velocity",
    "regrip": "last grip",
    "guard": "time-out",
    "guard-latch": "latched",
    "guard-clear": "cleared",
}
"""Names of phases in reports; other phases appear under their own name."""
_LONGEST = 32.0
"""Seconds of a plot that is about no place."""
_MOST_ROWS = 24
_MOST_ELEMENTS = 12  # of an array, in one plot
_FIELDS = {"dq": "rad/s", "ddq": "rad/s²", "tau_est": "N m"}
Span = tuple[float, float]


def plots_of(result: Result, view: Recording) -> list[Markup]:
    """The plots that the result names, as HTML; plots without data are left out.

    For a hand without any state the endpoints from discovery are shown instead.
    """
    if result.requirement.layer == "usb":
        return usb_plots(result, view.usb) if view.usb is not None else []
    side = next((s for s in view.sides if str(s) == result.side), None)
    if side is None:
        return []
    scene = _Scene(result, view, view.sides[side])
    if not len(scene.hand.states):
        return [_endpoints(scene)]
    return [drawn for plot in result.plots if (drawn := _drawn(scene, plot))]


def _drawn(scene: _Scene, plot: Plot) -> Markup:
    """One plot; empty if the recording holds nothing to draw."""
    if plot.kind is PlotKind.ENDPOINTS:
        return _endpoints(scene)
    if plot.kind in _CURVES:
        charts = _CURVES[plot.kind].charts(scene, plot.member)
    else:
        charts = _OTHERS[plot.kind](scene)
    return Markup("").join(charts)


@dataclass(frozen=True)
class _Scene:
    """A result, the recording, and the hand that it is about."""

    result: Result
    view: Recording
    hand: SideView

    @property
    def need(self) -> Requirement:
        return self.result.requirement

    @property
    def places(self) -> list[Span]:
        """The places that the check names, as (begin, end) in seconds."""
        return [(e.time_s, e.end_s or e.time_s) for e in self.result.evidence]

    @property
    def phases(self) -> list[Phase]:
        return [p for name in self.need.phases for p in self.view.phases(name, self.hand.side)]

    def span_of(self, phase: Phase) -> Span:
        return self.view.seconds(phase.begin_ns), self.view.seconds(phase.end_ns)

    @property
    def whole(self) -> Span:
        return 0.0, max(self.view.duration, 0.1)

    def window(self, pad: float = 0.6) -> Span:
        """Time to show: about the first place, or the phases, or everything."""
        spans = self.places[:1] or [self.span_of(p) for p in self.phases]
        if not spans:
            return self.whole
        begin, end = min(a for a, _ in spans), max(b for _, b in spans)
        begin, end = max(0.0, begin - pad), min(self.view.duration, end + pad)
        if not self.places:
            end = min(end, begin + _LONGEST)
        return begin, max(end, begin + 0.1)

    def bands(self, span: Span, *, phases: bool = True) -> list[Band]:
        """Where the kit's machine was busy, the phases, and the places of a plot."""
        named = phase_bands(self.view, self.hand.side) if phases else []
        alarms = [Band("here", a, b, "alarm") for a, b in self.places]
        shown = [b for b in alarms if b.end - b.begin < 0.85 * (span[1] - span[0])]
        return [*_busy(self.view, span), *named, *shown]

    def joints(self, span: Span) -> list[int]:
        """Two joints that the finding is about, or that move most in ``span``."""
        joints = self.hand.joints
        if self.result.joints or len(joints) == 1:
            return [j for j in self.result.joints or (0,) if j < len(joints)][:2]
        q = self.hand.states.q[self.hand.states.between(*span)]
        if not len(q):
            return [0]
        filled = np.where(np.isfinite(q), q, 0.0)
        moved = np.ptp(filled, axis=0) / np.array([j.stroke for j in joints])
        return [int(i) for i in np.argsort(-moved, kind="stable")[:2]]


# ------------------------------------------------------------------------ curves over time


@dataclass(frozen=True)
class _Limit:
    """A tolerance that a plot shows as a level.

    :param text: of the tolerance as ``{0}`` and of the level as ``{1}``.
    :param at: the level of the tolerance.
    """

    name: str
    text: str
    at: Callable[[float], float] = float


_PERIODS = (
    _Limit("min_rate_hz", "{0:g} Hz: {1:.2g} ms", lambda hz: 1e3 / hz),
    _Limit("max_rate_hz", "{0:g} Hz: {1:.2g} ms", lambda hz: 1e3 / hz),
    _Limit("usual_min_hz", "usual {0:g} Hz: {1:.2g} ms", lambda hz: 1e3 / hz),
    _Limit("usual_max_hz", "to {0:g} Hz: {1:.2g} ms", lambda hz: 1e3 / hz),
    _Limit("max_gap_s", "longest gap allowed: {1:g} ms", lambda s: 1e3 * s),
)
_RATES = (
    _Limit("min_rate_hz", "at least {0:g} Hz"),
    _Limit("max_rate_hz", "at most {0:g} Hz"),
    _Limit("usual_min_hz", "usual from {0:g} Hz"),
    _Limit("usual_max_hz", "to {0:g} Hz"),
)
_TORQUES = (
    _Limit("min_tau_nm", "at least {0:g} N m in size"),
    _Limit("min_tau_nm", "at least {0:g} N m in size", float.__neg__),
    _Limit("max_tau_nm", "at most {0:g} N m in size"),
    _Limit("max_tau_nm", "at most {0:g} N m in size", float.__neg__),
)


def _levels(need: Requirement, limits: tuple[_Limit, ...]) -> list[Level]:
    found = [(x, need.tolerances[x.name]) for x in limits if x.name in need.tolerances]
    return [Level(x.at(v), x.text.format(v, x.at(v))) for x, v in found]


@dataclass(frozen=True)
class _Curves:
    """Curves over time.

    :param title: what they show; ``{name}`` is the name of the first one.
    :param lines: the curves; no plot if there are none.
    :param unit: ``position``, ``torque`` or ``member`` for that of the hand.
    :param pad: seconds shown before and after the place; None for the whole run.
    :param zero: whether 0 is in the plot.
    """

    title: str
    lines: Callable[[_Scene, str], list[Line]]
    unit: str = ""
    pad: float | None = None
    limits: tuple[_Limit, ...] = ()
    zero: bool = True

    def charts(self, scene: _Scene, member: str) -> Iterator[Chart]:
        """The chart, if there is something to draw."""
        span = scene.whole if self.pad is None else scene.window(self.pad)
        if lines := self.lines(scene, member):
            units = {
                "position": scene.view.unit,
                "torque": scene.view.model.torque_unit,
                "member": _FIELDS.get(member, "").replace("rad", scene.view.unit),
            }
            yield Chart(
                f"{whose(scene.hand.side)}: {self.title.format(name=lines[0].label)}",
                lines,
                span,
                units.get(self.unit, self.unit),
                bands=scene.bands(span, phases=self.pad is not None),
                levels=_levels(scene.need, self.limits),
                include=(0.0,) if self.zero else (),
                height=150,
            )


def _periods(label: str, css: str, t: Floats, draw: str) -> list[Line]:
    """The time from each message to the next."""
    return [Line(label, css, t[1:], np.diff(t) * 1e3, draw)] if len(t) > 1 else []


def _rate(scene: _Scene, _: str) -> list[Line]:
    """Rate in windows of half a second."""
    clock = scene.hand.states.clock
    edges = np.arange(float(clock[0]), float(clock[-1]), 0.5)
    if len(edges) < 3:
        return []
    counts, _edges = np.histogram(clock, edges)
    middles = np.asarray((edges[1:] + edges[:-1]) / 2)
    return [Line("rate, each half second", "state", middles, np.asarray(counts / 0.5))]


def _samples(scene: _Scene, _: str) -> list[Line]:
    """Single samples, which show values that are sent again."""
    states, joint = scene.hand.states, scene.joints(scene.window())[0]
    return [Line(_called(scene.hand, joint), "state", states.t, states.q[:, joint], "dots")]


def _both_sides(scene: _Scene, _: str) -> list[Line]:
    lines, joint = [], scene.joints(scene.window())[0]
    for view in scene.view.sides.values():
        command, state = command_and_state(view, joint)
        mine, name = view.side is scene.hand.side, whose(view.side)
        lines.append(Line(name, "state" if mine else "other", state.x, state.y))
        if not mine:
            lines.append(Line(f"command to the {name}", "cmd", command.x, command.y))
    return lines


def _torque(scene: _Scene, _: str) -> list[Line]:
    states = scene.hand.states
    joints = scene.joints(scene.window())
    return [Line("tau_est", "force", states.t, states.tau[:, j]) for j in joints]


def _pressure(scene: _Scene, _: str) -> list[Line]:
    """Change of pressure of each sensor packet since rest: the sum over its elements."""
    states, lines = scene.hand.states, []
    if states.columns is not None:
        count = int(states.columns.count("press_sensor_state").max(initial=0))
        for i in range(count):
            values = states.columns[f"press_sensor_state[{i}].pressure"]
            change = known(values) - resting_pressure(states.t, values)
            change = np.where(np.isfinite(change), change, 0.0)
            lines.append(Line("each packet", "force", states.t, change.sum(axis=1)))
    return lines


def _member(scene: _Scene, member: str) -> list[Line]:
    """A member of the state."""
    states = scene.hand.states
    by_joint = {"dq": states.dq, "ddq": states.ddq, "tau_est": states.tau, "mode": states.mode}
    if member == "length":
        length = np.asarray(states.length, dtype=np.float64)
        return [Line("motors in the sequence", "force", states.t, length)]
    if member in by_joint:
        values = by_joint[member][:, [scene.joints(scene.window())[0]]]
    else:
        values = _column(scene, member)
    return [Line(member, "force", states.t, column) for column in values.T[:_MOST_ELEMENTS]]


def _column(scene: _Scene, path: str) -> Floats:
    """A member of every state, or one element of it; a table without columns if there is none."""
    columns = scene.hand.states.columns
    head, _, index = path.removesuffix("]").rpartition("[")
    if columns is not None:
        with suppress(UsageError):
            values = columns[path]
            return values.reshape(len(values), -1)
        with suppress(UsageError, ValueError):
            values = columns[head]
            return values.reshape(len(values), -1)[:, int(index) :][:, :1]
    return np.empty((0, 0))


_INTERVALS = "time from each state to the next"
_CURVES: Mapping[PlotKind, _Curves] = {
    PlotKind.RATE: _Curves("rate of the state over time", _rate, "Hz", limits=_RATES),
    PlotKind.INTERVALS: _Curves(
        _INTERVALS,
        lambda scene, _: _periods("each state", "state", scene.hand.states.clock, "dots"),
        "ms",
        limits=_PERIODS,
    ),
    PlotKind.GAP: _Curves(
        _INTERVALS,
        lambda scene, _: _periods("each state", "state", scene.hand.states.clock, "stems"),
        "ms",
        pad=1.0,
        limits=_PERIODS,
    ),
    PlotKind.COMMAND_INTERVALS: _Curves(
        "time from each command to the next",
        lambda scene, _: _periods("each command", "cmd", scene.hand.commands.t, "dots"),
        "ms",
        limits=_PERIODS,
    ),
    PlotKind.SAMPLES: _Curves(
        "each sample of the state while it moves", _samples, "position", pad=0.1, zero=False
    ),
    PlotKind.BOTH_SIDES: _Curves(
        "both hands, while only the other one is to move",
        _both_sides,
        "position",
        pad=0.6,
        zero=False,
    ),
    PlotKind.TORQUE: _Curves("torque (tau_est)", _torque, "torque", pad=0.6, limits=_TORQUES),
    PlotKind.PRESSURE: _Curves(
        "change of pressure since rest, summed over each sensor packet", _pressure, pad=0.6
    ),
    PlotKind.MEMBER: _Curves("{name}", _member, "member", pad=0.3),
}


def phase_bands(view: Recording, side: Subject, *, label: bool = True) -> list[Band]:
    """The phases of the stimulus, neighbours of one name joined."""
    merged: list[Band] = []
    for phase in view.stimulus.phases if view.stimulus else ():
        if side not in phase.sides:
            continue
        name = _PHASES.get(phase.name, phase.name.replace("-", " "))
        a, b = view.seconds(phase.begin_ns), view.seconds(phase.end_ns)
        if merged and merged[-1].label == name and a - merged[-1].end < 0.05:
            merged[-1] = Band(name, merged[-1].begin, b)
        else:
            merged.append(Band(name, a, b))
    return merged if label else [Band("", b.begin, b.end) for b in merged]


def _busy(view: Recording, span: Span) -> list[Band]:
    """Intervals in which the kit's machine was short of processor time.

    Intervals that a plot of ``span`` cannot show separately are joined.
    """
    least = max(0.02, (span[1] - span[0]) / 300)
    merged: list[Band] = []
    for stall in view.stimulus.stalls if view.stimulus else ():
        a, b = view.seconds(stall.begin_ns), view.seconds(stall.end_ns)
        if b < span[0] or a > span[1]:
            continue
        if merged and a - merged[-1].end < least:
            merged[-1] = Band("", merged[-1].begin, max(b, merged[-1].end), "busy")
        else:
            merged.append(Band("", a, b, "busy"))
    return merged


# ------------------------------------------------------------------------- command and state


def command_and_state(hand: SideView, joint: int) -> list[Line]:
    """Two curves of a joint: commanded and reported position.

    Commands far outside the joint's range, which would flatten the rest, are cut off.
    """
    commands, states, spec = hand.commands, hand.states, hand.joints[joint]
    margin = 0.1 * spec.stroke
    sent = np.asarray(np.clip(commands.q[:, joint], spec.q_min - margin, spec.q_max + margin))
    return [
        Line("command", "cmd", commands.t, sent),
        Line("state", "state", states.t, states.q[:, joint]),
    ]


def _called(hand: SideView, joint: int) -> str:
    return "position" if len(hand.joints) == 1 else hand.joints[joint].name


def followed(
    view: Recording, hand: SideView, joint: int, span: Span, bands: Sequence[Band]
) -> Chart:
    """Command and state of a joint, and what the modelled operator wants where there is one.

    The plot is at least a tenth of the stroke high, so that noise does not fill it.
    """
    q = hand.states.q[hand.states.between(*span), joint]
    q = q[np.isfinite(q)]
    middle, room = float(np.median(q)) if len(q) else 0.0, 0.05 * hand.joints[joint].stroke
    return Chart(
        f"{whose(hand.side)}, {_called(hand, joint)}: command and state, "
        f"{span[0]:.1f} to {span[1]:.1f} s",
        [*_wish(view, hand, joint, span), *command_and_state(hand, joint)],
        span,
        view.unit,
        bands=bands,
        include=(middle - room, middle + room),
        height=180,
    )


def _wish(view: Recording, hand: SideView, joint: int, span: Span) -> Iterator[Line]:
    """The modelled operator's target for a joint, in a plot of that phase."""
    side = hand.side
    for phase in view.phases(OPERATOR, side)[:1]:
        begin, end = view.seconds(phase.begin_ns), view.seconds(phase.end_ns)
        if isinstance(side, Side) and begin < span[1] and end > span[0]:
            operator = operator_of(phase, view.dialect)
            t = np.asarray(np.arange(begin, end, 0.01), dtype=np.float64)
            poses = [operator.intent(float(x) - begin, side) for x in t]
            q = np.array([np.nan if pose is None else pose[joint] for pose in poses])
            yield Line("where the operator wants it", "other", t, q)


def _position(scene: _Scene) -> Iterator[Chart]:
    """Command and state about the place."""
    span = scene.window()
    for joint in scene.joints(span):
        yield followed(scene.view, scene.hand, joint, span, scene.bands(span))


# ------------------------------------------------------------------------ not over the time


def _histogram(scene: _Scene) -> Iterator[Chart]:
    steps = np.diff(scene.hand.states.clock) * 1e3
    if len(steps := steps[steps > 0]) >= 10:
        title = f"{whose(scene.hand.side)}: how often which interval between states"
        yield histogram(title, steps, "ms", _levels(scene.need, _PERIODS))


def _torque_by_position(scene: _Scene) -> Iterator[Chart]:
    hand, span = scene.hand, scene.window(0.0)
    joint = scene.joints(span)[0]
    spec, here = hand.joints[joint], hand.states.between(*span)
    q, tau = hand.states.q[:, joint], hand.states.tau[:, joint]
    if (np.isfinite(q) & np.isfinite(tau)).sum() < 5:
        return
    touch = scene.view.stimulus.objects.get(hand.side) if scene.view.stimulus else None
    held = touch is not None and len(hand.joints) == 1
    yield Chart(
        f"{whose(hand.side)}, {_called(hand, joint)}: torque over position",
        [
            Line("each state of the run", "force", q, tau, "dots"),
            Line("here", "bad", q[here], tau[here], "dots"),
        ],
        (spec.q_min - 0.05 * spec.stroke, spec.q_max + 0.05 * spec.stroke),
        scene.view.model.torque_unit,
        scene.view.unit,
        bands=[Band("object", spec.q_min, touch)] if held and touch is not None else [],
        include=(0.0,),
        height=150,
    )


def _steps(scene: _Scene) -> Iterator[Chart]:
    """All steps laid over each other, as the distance to their targets."""
    hand, limits = scene.hand, scene.need.tolerances
    lines = []
    longest = 0.1
    for phase in scene.phases:
        begin, end = scene.span_of(phase)
        rows = hand.states.between(begin, end)
        before = hand.states.q[hand.states.between(begin - 0.1, begin)]
        longest = max(longest, end - begin)
        guilty = any(a < end and b > begin for a, b in scene.places)
        named = scene.joints((begin, end))[0] if guilty else -1
        for joint, target in phase.targets.get(hand.side, {}).items():
            t, q = hand.states.t[rows], hand.states.q[rows, joint]
            if len(t) < 2 or not np.isfinite(q).any():
                continue
            start = float(np.nanmedian(before[:, joint])) if len(before) else float(q[0])
            stroke = hand.joints[joint].stroke
            if not abs(target - start) > 0.02 * stroke:
                continue
            left = 100 * (q - target) * np.sign(target - start) / stroke
            if "max_ripple_stroke" in limits:  # small compared with the step: only its end is shown
                left = np.where(left < -1500 * limits["max_ripple_stroke"] / 2, np.nan, left)
            bad = guilty and joint == named
            name, css = ("the step in question", "bad") if bad else ("other steps", "faint")
            lines.append(Line(name, css, t - begin, left))
    if not lines:
        return
    count = f"{len(lines)} steps" if len(lines) > 1 else "1 step"
    half = {"max_error_stroke": 100.0, "max_ripple_stroke": 50.0}
    texts = {"max_error_stroke": "tolerance", "max_ripple_stroke": "ripple allowed"}
    yield Chart(
        f"{whose(hand.side)}, {count} laid over each other: distance to the target, "
        "in % of the stroke (above 0: beyond it), over seconds after the step",
        sorted(lines, key=lambda line: line.css == "bad"),
        (0.0, longest),
        "%",
        ranges=[
            Range(-size * limits[name], size * limits[name], texts[name])
            for name, size in half.items()
            if name in limits
        ],
        include=(0.0,),
        height=230,
    )


_OTHERS: Mapping[PlotKind, Callable[[_Scene], Iterator[Chart]]] = {
    PlotKind.POSITION: _position,
    PlotKind.STEPS: _steps,
    PlotKind.INTERVAL_HISTOGRAM: _histogram,
    PlotKind.TORQUE_BY_POSITION: _torque_by_position,
}


def _endpoints(scene: _Scene) -> Markup:
    """Table of the endpoints that a client needs, and of those that discovery saw."""
    dialect, side = scene.view.dialect, scene.hand.side
    command, state = dialect.topics(side)
    other = {t for s in Side if s is not side for t in dialect.topics(s)}
    other -= {command, state}  # one topic for both sides in some dialects
    seen = {
        ("seen", e.kind, e.topic, e.type_name, f"{e.reliability} {e.durability}".strip())
        for e in scene.view.endpoints
        if e.topic not in other
    }
    rows = [
        ("wanted", "writer", state, dialect.state_type, ""),
        ("wanted", "reader", command, dialect.cmd_type, ""),
        *(sorted(seen)[:_MOST_ROWS] or [("seen", "discovery saw no endpoint", "", "", "")]),
    ]
    caption = "On the network: what a client needs, and what discovery saw (the kit's own among it)"
    return Markup(
        fill("seen.html", caption=caption, heads=("", "kind", "topic", "type", "QoS"), rows=rows)
    )

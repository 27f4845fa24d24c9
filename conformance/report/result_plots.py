"""Draw the plots that a result names (:mod:`dexkit.conformance.kit.plots`) from its recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.conformance.kit.recording import Recording, SideView
from dexkit.conformance.kit.requirements import Requirement
from dexkit.conformance.kit.results import Result
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.report.labels import whose
from dexkit.conformance.report.svg_charts import Band, Level, Line, Range, chart, histogram
from dexkit.conformance.stimuli.operator import OPERATOR, operator_of
from dexkit.conformance.usb.record import Transfer
from dexkit.conformance.usb.recording import UsbRecording, UsbSide
from dexkit.errors import UsageError
from dexkit.escaping import html as escape
from dexkit.hand import Floats, JointSpec, Side, Subject
from dexkit.pressure import known, resting_pressure

__all__ = ["PHASES", "command_and_state", "operated", "phase_bands", "plots_of"]

PHASES = {
    "listen": "listen",
    "approach": "to mid",
    "step": "steps",
    "joint": "joint by joint",
    "nan": "NaN",
    "out-of-range": "out of range",
    "empty": "empty",
    "short": "too short",
    "long": "too long",
    "wrong-id": "wrong id",
    "recover": "recover",
    "limp": "zero gains",
    "unlike": "other gains",
    "soft": "low gains",
    "lock": "locked",
    "replay": "replayed session",
    "operator": "operator",
    "late-joiner": "late joiner",
    "squeeze": "squeeze",
    "beside-grip": "beside a grip",
    "drive": "velocity",
    "regrip": "last grip",
    "silence": "silence",
    "resume": "resume",
    "restart": "restart",
    "guard": "time-out",
    "guard-latch": "latched",
    "guard-clear": "cleared",
}
"""Names of phases in reports; other phases appear under their own name."""
_LONGEST = 8.0
"""Seconds of a plot about a place in the recording."""
_MOST_ROWS = 24
_MOST_ELEMENTS = 12  # of an array, in one plot
_FIELDS = {"dq": "rad/s", "ddq": "rad/s²", "tau_est": "N m"}


def plots_of(result: Result, view: Recording) -> list[str]:
    """The plots that the result names, as HTML; plots without data are left out.

    For a hand without any state the endpoints from discovery are shown instead.
    """
    if result.requirement.layer == "usb":
        return _usb_plots(result, view.usb) if view.usb is not None else []
    side = next((s for s in view.sides if str(s) == result.side), None)
    if side is None:
        return []
    scene = _Scene(result, view, view.sides[side])
    if not len(scene.hand.states):
        return [_endpoints(scene)]
    return [figure for plot in result.plots if (figure := _drawn(scene, plot))]


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
    def places(self) -> list[tuple[float, float]]:
        """The places that the check names, as (begin, end) in seconds."""
        return [(e.time_s, e.end_s or e.time_s) for e in self.result.evidence]

    @property
    def alarms(self) -> list[Band]:
        return [Band("here", a, b, "alarm") for a, b in self.places]

    @property
    def phases(self) -> list[Phase]:
        return self.view.phases(self.need.phase or "", self.hand.side)

    def span_of(self, phase: Phase) -> tuple[float, float]:
        return self.view.seconds(phase.begin_ns), self.view.seconds(phase.end_ns)

    def window(self, *, pad: float = 0.6) -> tuple[float, float]:
        """Time to show: about the first place, or the phases, or everything."""
        spans = self.places[:1] or [self.span_of(p) for p in self.phases]
        if not spans:
            return 0.0, max(self.view.duration, 0.1)
        begin, end = min(a for a, _ in spans), max(b for _, b in spans)
        begin, end = max(0.0, begin - pad), min(self.view.duration, end + pad)
        if not self.places and end - begin > 4 * _LONGEST:
            end = begin + 4 * _LONGEST
        return begin, max(end, begin + 0.1)

    def joints(self, span: tuple[float, float], most: int = 2) -> list[int]:
        """The joints that the finding is about, or those that move most in ``span``."""
        joints = self.hand.joints
        if len(joints) == 1:
            return [0]
        if self.result.joints:
            return [j for j in self.result.joints if j < len(joints)][:most]
        q = self.hand.states.q[self.hand.states.between(*span)]
        if not len(q):
            return [0]
        filled = np.where(np.isfinite(q), q, 0.0)
        moved = np.ptp(filled, axis=0) / np.array([j.stroke for j in joints])
        return [int(i) for i in np.argsort(-moved, kind="stable")[:most]]

    def chart(
        self,
        what: str,
        lines: Sequence[Line],
        unit: str,
        span: tuple[float, float] | None = None,
        *,
        bands: Sequence[Band] | None = None,
        levels: Sequence[Level] = (),
    ) -> str:
        """A low chart of the hand, with 0 in it.

        :param span: by default the whole run.
        :param bands: by default where the kit's machine was busy, and the places.
        """
        span = span or (0.0, max(self.view.duration, 0.1))
        return chart(
            f"{whose(self.hand.side)}: {what}",
            lines,
            y_unit=unit,
            span=span,
            bands=_busy(self.view, span) + self.alarms if bands is None else bands,
            levels=levels,
            include=(0.0,),
            height=150,
        )


def _drawn(scene: _Scene, plot: Plot) -> str:
    """One plot; empty if the recording holds nothing to draw."""
    return _member(scene, plot.member) if plot.kind is PlotKind.MEMBER else _DRAWN[plot.kind](scene)


# ------------------------------------------------------------------------------- curves


def phase_bands(view: Recording, side: Subject, *, label: bool = True) -> list[Band]:
    """The phases of the stimulus, neighbours of one name joined."""
    if view.stimulus is None:
        return []
    merged: list[Band] = []
    for phase in view.stimulus.phases:
        if side not in phase.sides:
            continue
        name = PHASES.get(phase.name, phase.name.replace("-", " "))
        a, b = view.seconds(phase.begin_ns), view.seconds(phase.end_ns)
        if merged and merged[-1].label == name and a - merged[-1].end < 0.05:
            merged[-1] = Band(name, merged[-1].begin, b)
        else:
            merged.append(Band(name, a, b))
    return merged if label else [Band("", b.begin, b.end) for b in merged]


def _busy(view: Recording, span: tuple[float, float]) -> list[Band]:
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


def wish(view: Recording, hand: SideView, joint: int) -> Line | None:
    """The modelled operator's target for a joint, or None without such a phase."""
    side = hand.side
    phases = view.phases(OPERATOR, side)
    if not phases or not isinstance(side, Side):
        return None
    begin, end = view.seconds(phases[0].begin_ns), view.seconds(phases[0].end_ns)
    operator = operator_of(phases[0], view.dialect)
    t = np.asarray(np.arange(begin, end, 0.01), dtype=np.float64)
    poses = [operator.intent(float(x) - begin, side) for x in t]
    q = np.array([np.nan if pose is None else pose[joint] for pose in poses])
    return Line("where the operator wants it", "other", t, q)


def operated(view: Recording, hand: SideView, joint: int, span: tuple[float, float]) -> str:
    """The operator's target, the client's commands, and the hand's position."""
    wanted = wish(view, hand, joint)
    return chart(
        f"{whose(hand.side)}, {_called(hand, joint)}: driven by Unitree's teleoperation client",
        [*([wanted] if wanted else []), *command_and_state(hand, joint)],
        y_unit=view.unit,
        span=span,
        bands=_busy(view, span),
        height=190,
        include=_room(hand, joint, span),
    )


def _operated(scene: _Scene) -> str:
    span = scene.window(pad=0.3)
    return "".join(operated(scene.view, scene.hand, joint, span) for joint in scene.joints(span))


def _clipped(values: Floats, joint: JointSpec) -> Floats:
    """``values`` limited to the joint's range and a tenth of it: commands far outside would flatten
    the rest of the plot.
    """
    margin = 0.1 * joint.stroke
    return np.asarray(np.clip(values, joint.q_min - margin, joint.q_max + margin))


def command_and_state(hand: SideView, joint: int) -> list[Line]:
    """Two curves of a joint: commanded and reported position."""
    commands, states = hand.commands, hand.states
    return [
        Line("command", "cmd", commands.t, _clipped(commands.q[:, joint], hand.joints[joint])),
        Line("state", "state", states.t, states.q[:, joint]),
    ]


def _called(hand: SideView, joint: int) -> str:
    return "position" if len(hand.joints) == 1 else hand.joints[joint].name


def _follow(scene: _Scene, span: tuple[float, float] | None = None) -> str:
    """Command and state about the place."""
    if span is None:
        span = scene.window()
    hand = scene.hand
    bands = _busy(scene.view, span) + phase_bands(scene.view, hand.side)
    bands += [b for b in scene.alarms if b.end - b.begin < 0.85 * (span[1] - span[0])]
    return "".join(
        chart(
            f"{whose(hand.side)}, {_called(hand, joint)}: command and state, "
            f"{span[0]:.1f} to {span[1]:.1f} s",
            command_and_state(hand, joint),
            y_unit=scene.view.unit,
            span=span,
            bands=bands,
            height=180,
            include=_room(hand, joint, span),
        )
        for joint in scene.joints(span)
    )


def _room(hand: SideView, joint: int, span: tuple[float, float]) -> list[float]:
    """Values that make a plot at least a tenth of the stroke high, so noise does not fill it."""
    q = hand.states.q[hand.states.between(*span), joint]
    q = q[np.isfinite(q)]
    middle = float(np.median(q)) if len(q) else 0.0
    return [middle - 0.05 * hand.joints[joint].stroke, middle + 0.05 * hand.joints[joint].stroke]


def _both_sides(scene: _Scene) -> str:
    """Both hands, while only the other one is to move."""
    hand = scene.hand
    phases = [p for p in scene.view.phases(scene.need.phase or "") if hand.side not in p.sides]
    spans = scene.places[:1] or [scene.span_of(p) for p in phases[:1]]
    if not spans:
        return _follow(scene)
    span = (max(0.0, spans[0][0] - 0.6), spans[0][1] + 0.6)
    lines = []
    joint = scene.joints(span)[0]
    for view in scene.view.sides.values():
        mine = view.side is hand.side
        t, q = view.states.t, view.states.q
        if len(t):
            lines.append(Line(f"{whose(view.side)}", "state" if mine else "other", t, q[:, joint]))
        if not mine and len(view.commands):
            goal = _clipped(view.commands.q[:, joint], view.joints[joint])
            lines.insert(
                0, Line(f"command to the {whose(view.side)}", "cmd", view.commands.t, goal)
            )
    return chart(
        f"both hands, {_called(hand, joint)}, while only the other one is to move",
        lines,
        y_unit=scene.view.unit,
        span=span,
        bands=scene.alarms,
        include=_room(hand, joint, span),
    )


def _steps(scene: _Scene) -> str:
    """All steps laid over each other, as the distance to their targets."""
    hand, limits = scene.hand, scene.need.tolerances
    pairs = []
    longest = 0.1
    for phase in scene.phases:
        begin, end = scene.span_of(phase)
        rows = hand.states.between(begin, end)
        before = hand.states.q[hand.states.between(begin - 0.1, begin)]
        longest = max(longest, end - begin)
        guilty = any(a < end and b > begin for a, b in scene.places)
        named = scene.joints((begin, end), 1)[0] if guilty else -1
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
            pairs.append((guilty and joint == named, Line("", "", t - begin, left)))
    if not pairs:
        return ""
    lines = [
        Line("the step in question" if bad else "other steps", "bad" if bad else "faint", s.x, s.y)
        for bad, s in sorted(pairs, key=lambda p: p[0])
    ]
    count = f"{len(lines)} steps" if len(lines) > 1 else "1 step"
    ranges = []
    for name, text in (("max_error_stroke", "tolerance"), ("max_ripple_stroke", "ripple allowed")):
        if name in limits:
            half = 100 * limits[name] / (1 if name == "max_error_stroke" else 2)
            ranges.append(Range(-half, half, text))
    if "max_overshoot_stroke" in limits:
        ranges.append(Range(-np.inf, 100 * limits["max_overshoot_stroke"], "overshoot allowed"))
    return chart(
        f"{whose(hand.side)}, {count} laid over each other: distance to the target, "
        "in % of the stroke (above 0: beyond it), over seconds after the step",
        lines,
        y_unit="%",
        span=(0.0, longest),
        ranges=[r for r in ranges if np.isfinite(r.low)],
        levels=[Level(r.high, r.label) for r in ranges if not np.isfinite(r.low)],
        include=(0.0,),
        height=230,
    )


def _session(scene: _Scene) -> str:
    """The whole replayed session, and the first place closer."""
    spans = [scene.span_of(p) for p in scene.view.phases("replay", scene.hand.side)]
    t = scene.hand.commands.t
    span = spans[0] if spans else (float(t[0]), float(t[-1])) if len(t) else scene.window()
    figures = [_follow(scene, span)]
    for a, b in scene.places[:1]:
        if b - a < 0.5 * (span[1] - span[0]):
            figures.append(_follow(scene, (max(span[0], a - 1.5), min(span[1], b + 1.5))))
    return "".join(figures)


# ---------------------------------------------------------------------------- timing


def _milliseconds(scene: _Scene) -> tuple[Floats, Floats]:
    clock = scene.hand.states.clock
    return clock[1:], np.diff(clock) * 1e3


def _interval_levels(need: Requirement) -> list[Level]:
    limits = need.tolerances
    found = [
        Level(1e3 / limits[n], f"{limits[n]:g} Hz: {1e3 / limits[n]:.2g} ms")
        for n in ("min_rate_hz", "max_rate_hz")
        if n in limits
    ]
    found += [
        Level(1e3 * limits[n], f"{text}: {1e3 * limits[n]:g} ms")
        for n, text in (("max_p99_s", "99 % below"), ("max_gap_s", "longest gap allowed"))
        if n in limits
    ]
    return found


def _intervals(scene: _Scene, span: tuple[float, float] | None) -> str:
    """Time from each state to the next, over time."""
    t, steps = _milliseconds(scene)
    if not len(t):
        return ""
    lines = [Line("each state", "state", t, steps, "stems" if span else "dots")]
    levels = _interval_levels(scene.need)
    return scene.chart("time from each state to the next", lines, "ms", span, levels=levels)


def _command_intervals(scene: _Scene) -> str:
    """Time from each command to the next, over the whole run."""
    t = scene.hand.commands.t
    if len(t) < 2:
        return ""
    lines = [Line("each command", "cmd", t[1:], np.diff(t) * 1e3, "dots")]
    levels = _interval_levels(scene.need)
    return scene.chart("time from each command to the next", lines, "ms", levels=levels)


def _interval_histogram(scene: _Scene) -> str:
    _, steps = _milliseconds(scene)
    steps = steps[steps > 0]
    if len(steps) < 10:
        return ""
    return histogram(
        f"{whose(scene.hand.side)}: how often which interval between states",
        steps,
        unit="ms",
        levels=_interval_levels(scene.need),
    )


def _rates(scene: _Scene) -> str:
    """Rate in windows of half a second, with the required rate."""
    clock, limits = scene.hand.states.clock, scene.need.tolerances
    if len(clock) < 2 or "max_p99_s" in limits:
        return ""
    edges = np.arange(float(clock[0]), float(clock[-1]), 0.5)
    if len(edges) < 3:
        return ""
    counts, _ = np.histogram(clock, edges)
    line = Line("rate, each half second", "state", (edges[1:] + edges[:-1]) / 2, counts / 0.5)
    levels = [
        Level(limits[n], f"{text} {limits[n]:g} Hz")
        for n, text in (("min_rate_hz", "at least"), ("max_rate_hz", "at most"))
        if n in limits
    ]
    return scene.chart("rate of the state over time", [line], "Hz", bands=(), levels=levels)


def _samples(scene: _Scene) -> str:
    """Single samples, which show values that are sent again."""
    hand = scene.hand
    middle = scene.places[0] if scene.places else (_fastest(hand),) * 2
    span = (max(0.0, middle[0] - 0.05), middle[1] + 0.25)
    joint = scene.joints(span, 1)[0]
    return chart(
        f"{whose(hand.side)}, {_called(hand, joint)}: each sample of the state while it moves",
        [Line("each state", "state", hand.states.t, hand.states.q[:, joint], "dots")],
        y_unit=scene.view.unit,
        span=span,
        bands=scene.alarms,
    )


def _fastest(hand: SideView) -> float:
    """The time at which the first joint is fastest."""
    dq = hand.states.dq[:, 0]
    return float(hand.states.t[int(np.argmax(np.abs(np.where(np.isfinite(dq), dq, 0.0))))])


# ----------------------------------------------------------------------- force and fields


def _torque(scene: _Scene) -> str:
    hand, span = scene.hand, scene.window()
    levels = [
        Level(sign * value, f"at {'least' if name[:3] == 'min' else 'most'} {value:g} N m in size")
        for name, value in scene.need.tolerances.items()
        if name in ("min_tau_nm", "max_tau_nm")
        for sign in (1, -1)
    ]
    lines = [
        Line("tau_est", "force", hand.states.t, hand.states.tau[:, j]) for j in scene.joints(span)
    ]
    bands = phase_bands(scene.view, hand.side) + scene.alarms
    unit = scene.view.model.torque_unit
    return scene.chart("torque (tau_est)", lines, unit, span, bands=bands, levels=levels)


def _torque_by_position(scene: _Scene) -> str:
    hand, span = scene.hand, scene.window(pad=0.0)
    joint = scene.joints(span, 1)[0]
    q, tau = hand.states.q[:, joint], hand.states.tau[:, joint]
    good = np.isfinite(q) & np.isfinite(tau)
    if good.sum() < 5:
        return ""
    here = good.copy()
    here[: hand.states.between(*span).start] = False
    here[hand.states.between(*span).stop :] = False
    spec = hand.joints[joint]
    touch = scene.view.stimulus.objects.get(hand.side) if scene.view.stimulus else None
    held = touch is not None and len(hand.joints) == 1
    return chart(
        f"{whose(hand.side)}, {_called(hand, joint)}: torque over position",
        [
            Line("each state of the run", "force", q[good], tau[good], "dots"),
            Line("here", "bad", q[here], tau[here], "dots"),
        ],
        y_unit=scene.view.model.torque_unit,
        x_unit=scene.view.unit,
        span=(spec.q_min - 0.05 * spec.stroke, spec.q_max + 0.05 * spec.stroke),
        bands=[Band("object", spec.q_min, touch)] if held and touch is not None else [],
        include=(0.0,),
        height=150,
    )


def _member(scene: _Scene, member: str) -> str:
    """A member of the state about the place."""
    states, span = scene.hand.states, scene.window(pad=0.3)
    by_joint = {"dq": states.dq, "ddq": states.ddq, "tau_est": states.tau, "mode": states.mode}
    values: Floats | None
    if member == "length":
        values, member = np.asarray(states.length, dtype=np.float64), "motors in the sequence"
    elif member in by_joint:
        values = by_joint[member][:, scene.joints(scene.window(), 1)[0]]
    else:
        values = _column(scene, member)
    if values is None:
        return ""
    table = values.reshape(len(values), -1)[:, :_MOST_ELEMENTS]
    lines = [Line(member, "force", states.t, column) for column in table.T]
    unit = _FIELDS.get(member, "").replace("rad", scene.view.unit)
    return scene.chart(member, lines, unit, span)


def _pressure(scene: _Scene) -> str:
    """Change of pressure of each sensor packet since rest: the sum over its elements."""
    hand, span = scene.hand, scene.window()
    if hand.states.columns is None:
        return ""
    count = int(hand.states.columns.count("press_sensor_state").max(initial=0))
    lines = []
    for i in range(count):
        values = hand.states.columns[f"press_sensor_state[{i}].pressure"]
        change = known(values) - resting_pressure(hand.states.t, values)
        change = np.where(np.isfinite(change), change, 0.0)
        lines.append(Line("each packet", "force", hand.states.t, change.sum(axis=1)))
    if not lines:
        return ""
    what = f"change of pressure since rest, summed over each of {count} sensor packets"
    bands = phase_bands(scene.view, hand.side) + scene.alarms
    return scene.chart(what, lines, "", span, bands=bands)


def _column(scene: _Scene, path: str) -> Floats | None:
    """A member of every state, or one element of it; None if the states have no such member."""
    columns = scene.hand.states.columns
    if columns is None:
        return None
    try:
        return columns[path]
    except UsageError:
        pass
    head, _, index = path.removesuffix("]").rpartition("[")
    try:
        values = columns[head] if head and index.isdecimal() else None
    except UsageError:
        return None
    if values is None:
        return None
    table = values.reshape(len(values), -1)
    return table[:, int(index)] if int(index) < table.shape[1] else None


# -------------------------------------------------------------------------------- network


def _endpoints(scene: _Scene) -> str:
    """Table of the endpoints that a client needs, and of those that discovery saw."""
    dialect, side = scene.view.dialect, scene.hand.side
    wanted = [
        (dialect.topics(side)[1], dialect.state_type, "writer"),
        (dialect.topics(side)[0], dialect.cmd_type, "reader"),
    ]
    rows = [
        f"<tr><td>wanted</td><td>{kind}</td><td><code>{escape(topic)}</code></td>"
        f"<td><code>{escape(name)}</code></td><td></td></tr>"
        for topic, name, kind in wanted
    ]
    other = {t for s in Side if s is not side for t in dialect.topics(s)}
    other -= set(dialect.topics(side))  # one topic for both sides in some dialects
    seen = dict.fromkeys(
        (e.kind, e.topic, e.type_name, f"{e.reliability} {e.durability}".strip())
        for e in scene.view.endpoints
        if e.topic not in other
    )
    rows += [
        f"<tr><td>seen</td><td>{escape(kind)}</td><td><code>{escape(topic)}</code></td>"
        f"<td><code>{escape(name)}</code></td><td>{escape(qos)}</td></tr>"
        for kind, topic, name, qos in sorted(seen)[:_MOST_ROWS]
    ]
    if not seen:
        rows.append('<tr><td>seen</td><td colspan="4">discovery saw no endpoint</td></tr>')
    return _table(
        "On the network: what a client needs, and what discovery saw (the kit's own among it)",
        ("", "kind", "topic", "type", "QoS"),
        rows,
    )


def _table(caption: str, heads: Sequence[str], rows: Sequence[str]) -> str:
    head = "".join(f"<th>{escape(h)}</th>" for h in heads)
    return (
        f'<div class="seen"><table><caption>{escape(caption)}</caption><thead><tr>{head}</tr>'
        f"</thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


_DRAWN: Mapping[PlotKind, Callable[[_Scene], str]] = {
    PlotKind.ENDPOINTS: _endpoints,
    PlotKind.POSITION: _follow,
    PlotKind.BOTH_SIDES: _both_sides,
    PlotKind.STEPS: _steps,
    PlotKind.SESSION: _session,
    PlotKind.OPERATOR: _operated,
    PlotKind.SAMPLES: _samples,
    PlotKind.RATE: _rates,
    PlotKind.INTERVAL_HISTOGRAM: _interval_histogram,
    PlotKind.INTERVALS: lambda scene: _intervals(scene, None),
    PlotKind.GAP: lambda scene: _intervals(scene, scene.window(pad=1.0)),
    PlotKind.COMMAND_INTERVALS: _command_intervals,
    PlotKind.TORQUE: _torque,
    PlotKind.TORQUE_BY_POSITION: _torque_by_position,
    PlotKind.PRESSURE: _pressure,
}


# ------------------------------------------------------------------------------------ USB


def _usb_plots(result: Result, usb: UsbRecording) -> list[str]:
    hand = next((h for s, h in usb.sides.items() if str(s) == result.side), None)
    if hand is None:
        return []
    drawn = (_USB_DRAWN[p.kind](result, hand) for p in result.plots if p.kind in _USB_DRAWN)
    return [figure for figure in drawn if figure]


def _descriptors(_: Result, hand: UsbSide) -> str:
    device = hand.device
    rows = {
        "idVendor:idProduct": f"{device.vendor:04X}:{device.product:04X}",
        "bcdDevice": f"{device.release >> 8:x}.{device.release & 0xFF:02x}",
        "strings": f"{device.manufacturer!r}, {device.name!r}, serial {device.serial!r}",
        "endpoints of interface 0": ", ".join(
            f"{e.address:#04x} {'bulk' if e.bulk else 'not bulk'} {e.size} bytes"
            for e in device.endpoints
        )
        or "none",
    }
    return _table(
        f"{whose(hand.side)}: descriptors of the device",
        ("", ""),
        [f"<tr><td>{escape(k)}</td><td>{escape(v)}</td></tr>" for k, v in rows.items()],
    )


def _bytes_at(result: Result, hand: UsbSide) -> str:
    """The beginning of the transfer at the first place, if that has no end."""
    if not result.evidence or result.evidence[0].end_s is not None:
        return ""
    place = result.evidence[0]
    inward = place.topic.endswith("/in")

    def distance(transfer: Transfer) -> int:
        time = transfer.done_ns if inward else transfer.submitted_ns
        return abs(time - hand.origin_ns - round(place.time_s * 1e9))

    there = [t for t in hand.transfers if t.inward is inward]
    if not there:
        return ""
    transfer = min(there, key=distance)
    data, head = transfer.data, 96
    whole = len(data) <= head + 16
    rows = [_hex(data, at) for at in range(0, len(data) if whole else head, 8)]
    if not whole:
        last = (len(data) - 9) // 8 * 8  # the CRC of a frame is at its end
        rows += [f"... {len(data)} bytes in all", *(_hex(data, a) for a in (last, last + 8))]
    way = "from the hand" if inward else "to the hand"
    return (
        f'<figure class="plot"><pre class="bytes">{chr(10).join(rows) or "no bytes"}</pre>'
        f"<figcaption>transfer {way} at {hand.seconds(transfer.done_ns):.4f} s"
        f"</figcaption></figure>"
    )


def _hex(data: bytes, at: int) -> str:
    return f"{at:04x}  {data[at : at + 8].hex(' ')}"


def _answers(result: Result, hand: UsbSide) -> str:
    """Joint positions in the answers about the first place, if that has an end."""
    if not result.evidence or result.evidence[0].end_s is None:
        return ""
    place = result.evidence[0]
    span = (max(0.0, place.time_s - 0.3), (place.end_s or place.time_s) + 0.3)
    answers = [a for a in hand.answers if span[0] <= a.t <= span[1]]
    if len(answers) < 2:
        return ""
    t = np.array([a.t for a in answers])
    q = np.array([hand.q(a) for a in answers])
    names = [j.name for j in hand.joints]
    moved = np.ptp(np.where(np.isfinite(q), q, 0.0), axis=0)
    shown = result.joints or np.argsort(-moved, kind="stable")[:2].tolist()
    bands = [Band(p.name, *hand.span(p)) for p in hand.record.phases if hand.span(p)[1] > span[0]]
    marks = [Band("here", e.time_s, e.end_s or e.time_s, "alarm") for e in result.evidence]
    return chart(
        f"{whose(hand.side)}: joint positions in the answers",
        [
            Line(names[i], css, t, q[:, i])
            for i, css in zip(shown[:3], ("state", "force", "cmd"), strict=False)
        ],
        y_unit="rad",
        span=span,
        bands=bands + marks,
        height=170,
    )


def _latency(result: Result, hand: UsbSide) -> str:
    """From each command to its answer."""
    found = [
        (x.t, (x.answer.transfer.done_ns - x.command.submitted_ns) / 1e6)
        for phase in hand.phases(result.requirement.phase or "")
        for x in hand.exchanges(phase)
        if x.answer is not None
    ]
    if len(found) < 10:
        return ""
    limits = result.requirement.tolerances
    levels = []
    if "max_s" in limits:
        levels.append(Level(1e3 * limits["max_s"], f"at most {1e3 * limits['max_s']:g} ms"))
    if "min_rate_hz" in limits:
        levels.append(Level(1e3 / limits["min_rate_hz"], f"{limits['min_rate_hz']:g} Hz"))
    return histogram(
        f"{whose(hand.side)}: from command to answer",
        np.array([ms for _, ms in found]),
        unit="ms",
        levels=levels,
    )


_USB_DRAWN: Mapping[PlotKind, Callable[[Result, UsbSide], str]] = {
    PlotKind.DESCRIPTORS: _descriptors,
    PlotKind.BYTES: _bytes_at,
    PlotKind.ANSWERS: _answers,
    PlotKind.LATENCY: _latency,
}

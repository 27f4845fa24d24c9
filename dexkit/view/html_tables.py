"""The tables of the page, as HTML. Everything that comes from the wire is escaped."""

from __future__ import annotations

import math
from collections.abc import Sequence

from dexkit.escaping import html as escape
from dexkit.watch import SubjectView, TopicView
from dexkit.watch.number_format import number, seconds

__all__ = ["hand_table", "time_strip", "topics_table"]

_STYLE = (
    "<style>.dk{font:12px/1.35 system-ui,sans-serif;padding:0 10px;overflow-x:auto}"
    ".dk table{border-collapse:collapse;width:100%}"
    ".dk td,.dk th{padding:1px 5px 1px 0;text-align:left;white-space:nowrap;font-weight:400}"
    ".dk th{color:#868e96}.dk .n{text-align:right;font-variant-numeric:tabular-nums}"
    ".dk h4{margin:6px 0 2px;font-size:13px}.dk .bad{color:#e03131;font-weight:600}"
    ".dk .warn{color:#c77700}.dk .dim{color:#868e96}.dk p{margin:2px 0}</style>"
)
_WIDTH, _HEIGHT = 92, 12


def _cell(text: str, kind: str = "") -> str:
    return f'<td class="{kind}">{text}</td>'


def hand_table(view: SubjectView, title: str) -> str:
    """The joints of a hand: position between the limits with the commanded one, torque, faults."""
    rows = []
    for i, joint in enumerate(view.joints):
        bad = int(view.fault[i]) != 0
        near = int(view.near[i])
        celsius = float(view.temperature[i])
        rows.append(
            "<tr>"
            + _cell(escape(joint.name), "bad" if bad else "warn" if near else "")
            + _cell(_bar(view, i))
            + _cell(number(float(view.q[i])), "n warn" if near else "n")
            + _cell(number(float(view.target[i])), "n dim")
            + _cell(_torque(view, i))
            + _cell(number(float(view.tau[i])), "n")
            + _cell(f"{celsius:.0f}" if math.isfinite(celsius) and celsius else "", "n dim")
            + "</tr>"
        )
    faults = view.faults
    told = "".join(f'<p class="bad">{escape(text)}</p>' for text in faults[:8])
    if len(faults) > 8:
        told += f'<p class="bad">and {len(faults) - 8} more faults</p>'
    near_names = [
        f"{joint.name} {'upper' if n > 0 else 'lower'}"
        for joint, n in zip(view.joints, view.near.tolist(), strict=True)
        if n
    ]
    if near_names:
        more = f" and {len(near_names) - 6} more" if len(near_names) > 6 else ""
        told += f'<p class="warn">at a limit: {escape(", ".join(near_names[:6]))}{more}</p>'
    return (
        f'{_STYLE}<div class="dk"><h4>{escape(title)}</h4><p>{_ages(view)}</p>{told}'
        '<table><tr><th>joint</th><th>between its limits</th><th class="n">'
        f"q {view.model.unit}</th>"
        '<th class="n">cmd</th><th>torque</th><th class="n">'
        f'{view.model.torque_unit.replace("N m", "N·m")}</th><th class="n">°C</th></tr>'
        f"{''.join(rows)}</table>{_touch(view)}</div>"
    )


def _touch(view: SubjectView) -> str:
    """The most that each finger's tactile areas count."""
    told = " · ".join(f"{escape(name)} {number(count, 0)}" for name, count in view.touched.items())
    return f"<p>touch, most of each finger, counts: {told}</p>" if told else ""


def _ages(view: SubjectView) -> str:
    if not math.isfinite(view.age):
        state = '<span class="bad">no state yet</span>'
    elif view.stale:
        state = f'<span class="bad">the state is {seconds(view.age)} old</span>'
    else:
        state = f"state {seconds(view.age)} old"
    if not math.isfinite(view.command_age):
        return f'{state} · <span class="dim">nobody commands</span>'
    who = ", ".join(view.commanders) or "unknown process"
    if all(name == "?" for name in view.commanders):
        who = "a process that does not say its name"
    style = "dim" if view.command_age > view.command_timeout else ""
    many = len(view.commanders) > 1
    return (
        f'{state} · <span class="{style}">command {seconds(view.command_age)} old</span>'
        f' · <span class="{"warn" if many else "dim"}">'
        f"{'commanded by ' + str(len(view.commanders)) + ': ' if many else 'by '}"
        f"{escape(who)}</span>"
    )


def _bar(view: SubjectView, i: int) -> str:
    joint = view.joints[i]

    def x(q: float) -> float:
        return min(max((q - joint.q_min) / joint.stroke, -0.02), 1.02) * (_WIDTH - 4) + 2

    parts = [f'<rect y="4" width="{_WIDTH}" height="4" rx="2" fill="#adb5bd" opacity=".45"/>']
    if joint.q_min < 0 < joint.q_max:
        parts.append(f'<rect x="{x(0):.1f}" y="3" width="1" height="6" fill="#868e96"/>')
    target, q = float(view.target[i]), float(view.q[i])
    if math.isfinite(target):
        parts.append(
            f'<rect x="{x(target) - 1.5:.1f}" width="3" height="{_HEIGHT}" fill="#4dabf7"'
            ' opacity=".8"/>'
        )
    if math.isfinite(q):
        color = "#e03131" if view.fault[i] else "#f08c00" if view.near[i] else "#2f9e44"
        parts.append(f'<circle cx="{x(q):.1f}" cy="6" r="4" fill="{color}"/>')
    return f'<svg width="{_WIDTH}" height="{_HEIGHT}">{"".join(parts)}</svg>'


def _torque(view: SubjectView, i: int) -> str:
    part = float(view.torque_part[i])
    color = "#e03131" if part > 0.9 else "#f08c00" if part > 0.6 else "#868e96"
    return (
        '<svg width="34" height="12"><rect y="4" width="34" height="4" fill="#adb5bd"'
        f' opacity=".45"/><rect y="3" width="{34 * part:.1f}" height="6" fill="{color}"/></svg>'
    )


def topics_table(views: Sequence[TopicView], title: str) -> str:
    """Rates, ages, gaps and missed cycles, and who publishes."""
    rows = []
    for view in views:
        slow = view.expected > 0 and view.rate < 0.9 * view.expected and view.samples > 1
        old = not view.age <= 1.0
        lines = [", ".join(view.publishers) or "nobody publishes it"]
        if view.writers > 1:
            lines.append(f"{view.writers} writers at once")
        if view.undecodable:
            lines.append(f"{view.undecodable} cannot be decoded")
        wrong = view.writers > 1 or view.undecodable > 0
        rows.append(
            "<tr>"
            + _cell(escape(view.name), "dim" if old else "")
            + _cell(f"{view.rate:.0f}", "n warn" if slow else "n")
            + _cell(f"{view.expected:.0f}" if view.expected else "", "n dim")
            + _cell(seconds(view.age), "n bad" if old and view.samples else "n")
            + _cell(str(view.gaps), "n warn" if view.gaps else "n dim")
            + _cell(str(view.missed), "n warn" if view.missed else "n dim")
            + _cell(seconds(view.longest) if view.gaps else "", "n dim")
            + "</tr>"
            + f'<tr><td colspan="7" class="{"bad" if wrong else "dim"}"'
            f' style="padding-left:10px;white-space:normal">{escape(" · ".join(lines))}</td></tr>'
        )
    if not rows:
        rows.append('<tr><td class="dim" colspan="7">nothing has been seen here yet</td></tr>')
    return (
        f'{_STYLE}<div class="dk"><h4>{escape(title)}</h4>'
        '<table><tr><th>topic</th><th class="n">Hz</th><th class="n">of</th>'
        '<th class="n">age</th><th class="n">gaps</th><th class="n">missed</th>'
        f'<th class="n">longest</th></tr>{"".join(rows)}</table></div>'
    )


def time_strip(
    marks: Sequence[tuple[float, float, str, str]], end: float, at: float, title: str
) -> str:
    """Phases, verdicts and the moment that is shown, over the time line.

    :param marks: (begin, end, kind, title) of each, seconds.
    """
    width, scale = 1000, 1000 / end if end > 0 else 0.0
    colors = ("#748ffc", "#63e6be")
    parts = [f'<rect y="4" width="{width}" height="10" fill="#adb5bd" opacity=".3"/>']
    phases = [m for m in marks if m[2] == "phase"]
    for i, (begin, stop, _, name) in enumerate(phases):
        parts.append(
            f'<rect x="{begin * scale:.1f}" y="4" width="{max(1.0, (stop - begin) * scale):.1f}"'
            f' height="10" fill="{colors[i % 2]}" opacity=".7"><title>{escape(name)}</title></rect>'
        )
    for begin, _, kind, name in marks:
        if kind == "phase":
            continue
        color = "#e03131" if kind == "fail" else "#f08c00"
        parts.append(
            f'<rect x="{begin * scale - 2:.1f}" width="5" height="18" fill="{color}">'
            f"<title>{escape(name)}</title></rect>"
        )
    parts.append(f'<rect x="{at * scale - 2:.1f}" width="4" height="18" fill="currentColor"/>')
    current = next((m[3] for m in phases if m[0] <= at <= m[1]), "")
    return (
        f'{_STYLE}<div class="dk"><p>{escape(title)} <b>{at:.2f} s</b> of {end:.2f} s'
        f' <span class="dim">{escape(current)}</span></p>'
        f'<svg viewBox="0 0 {width} 18" preserveAspectRatio="none" '
        f'style="width:100%;height:16px">{"".join(parts)}</svg></div>'
    )

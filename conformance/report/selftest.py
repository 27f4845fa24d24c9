"""The page of a self-test, and its summary in the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexkit.conformance.report.curves import STYLE
from dexkit.conformance.report.html import document, utc
from dexkit.conformance.report.svg_charts import Level, Line, chart
from dexkit.conformance.report.tables import no_wrap, table
from dexkit.conformance.selftest.figure_limits import BY_NAME, KINDS, Figure, Unit, Wear
from dexkit.conformance.selftest.joint_motion import Series
from dexkit.conformance.selftest.result import (
    Condition,
    ElementResponse,
    ElementResult,
    JointResult,
    SelfTestResult,
    Verdict,
)
from dexkit.escaping import html as escape
from dexkit.hand import Floats, JointSpec, Side
from dexkit.models import HandModel, model

__all__ = ["Finding", "findings", "print_selftest", "render_selftest"]

_TITLES = {
    Verdict.GOOD: ("ok", "Nothing is wrong"),
    Verdict.INCOMPLETE: ("open", "Incomplete"),
    Verdict.WORN: ("bad", "Worn"),
    Verdict.FAULTY: ("bad", "Faulty"),
}
_WRONG = {
    Condition.DEAD: "does not move",
    Condition.REVERSED: "moves against its commands",
    Condition.OTHER: "its commands move another joint",
}
_PLOT = 200  # pixels across a plot where several are side by side
_TRAVEL, _FORCE = "full travel", "full force"  # units of a profile
_EFFORTS = {"A": "current", _FORCE: "force"}  # what a hand reports in the place of torques, by unit
_LACKS = {
    ElementResponse.DEAD: "does not answer to touch",
    ElementResponse.NO_VALUE: "has no value",
}


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    :param where: joint or tactile element.
    :param worn: worse than in the earlier run; else wrong by the model.
    """

    where: str
    what: str
    worn: bool


def findings(result: SelfTestResult) -> list[Finding]:
    """Faults of a hand and changes for the worse, without duplicates."""
    profile = model(result.hand["model"])
    found: list[Finding] = []
    for joint in result.joints:
        for name in dict.fromkeys([*joint.worn, *joint.faulty]):
            worn = name in joint.worn
            if name == "condition":
                text = _WRONG[joint.condition]
                if joint.condition is Condition.OTHER:
                    text += f": {', '.join(joint.moves)}"
                found.append(Finding(joint.name, text + _since(worn), worn))
                continue
            figure = next(f for f in joint.figures if f.name == name)
            found.append(Finding(joint.name, _sentence(figure, profile), worn))
    for e in result.elements:
        if e.faulty or e.worn:
            text = _LACKS.get(e.touch, f"is noisier than before: {e.noise:.0f} Pa")
            found.append(Finding(_element(e), text + _since(e.worn and e.faulty), e.worn))
    return found


def _since(worn: bool) -> str:
    return ", and did in the earlier run" if worn else ""


def _element(e: ElementResult) -> str:
    return f"{e.place}, element {e.packet}.{e.slot}"


def _sentence(figure: Figure, profile: HandModel) -> str:
    kind = BY_NAME[figure.name]
    text = f"{_titled(kind.title, profile)} {_value(figure, profile)}"
    if figure.wear is Wear.WORN:
        text += f", was {_value(figure, profile, before=True)}"
    if not figure.good:
        word = "at least" if kind.worse < 0 else "at most"
        limit = Figure(figure.name, kind.limit * figure.scale, figure.scale, good=True)
        text += f" ({word} {_value(limit, profile)})"
    return text


def _titled(text: str, profile: HandModel) -> str:
    """A title, of a current or a force where the hand reports that."""
    return text.replace("torque", _EFFORTS.get(profile.torque_unit, "torque"))


def _torque_unit(profile: HandModel) -> str:
    return profile.torque_unit.replace("N m", "N·m")


def _value(figure: Figure, profile: HandModel, *, before: bool = False) -> str:
    value = figure.before if before else figure.value
    if not math.isfinite(value):
        return "-"
    unit = BY_NAME[figure.name].unit
    if unit is Unit.SECONDS:
        return f"{1e3 * value:.0f} ms"
    if unit is Unit.KELVIN:
        return f"{value:.1f} K"
    of_travel = profile.unit == _TRAVEL
    if unit is Unit.SPEED:
        return f"{100 * value:.0f} %/s" if of_travel else f"{value:.2f} {profile.unit}/s"
    of_force = profile.torque_unit == _FORCE
    if (unit is Unit.Q and of_travel) or (unit is Unit.TORQUE and of_force):
        return f"{100 * value + 0.0:.2f} %"
    name = _torque_unit(profile) if unit is Unit.TORQUE else profile.unit
    digits = 4 if abs(value) < 0.1 else 3
    return f"{round(value, digits) + 0.0:.{digits}f} {name}"  # without -0.0000


# ---------------------------------------------------------------------------------------- the page


def render_selftest(result: SelfTestResult, baseline: SelfTestResult | None = None) -> str:
    """The page as text; it loads nothing.

    :param baseline: the earlier run, whose curves are drawn beside.
    """
    profile = model(result.hand["model"])
    old = {j.name: j for j in baseline.joints} if baseline else {}
    specs = {s.name: s for s in profile.joints[Side(result.hand["side"])]}
    sections = [
        STYLE,
        _head(result, profile),
        _facts(result),
        _findings(result),
        _joints(result, profile),
        _elements(result),
        *(
            _joint(j, specs[j.name], profile, old.get(j.name))
            for j in result.joints
            if j.curves and j.name in specs
        ),
        _meaning(result, profile),
    ]
    _, title = _TITLES[result.verdict]
    return document(f"{title}: {_name(result)} (self-test)", "".join(sections))


def _name(result: SelfTestResult) -> str:
    hand = result.hand
    title = f"{hand['side']} {model(hand['model']).title}"
    return f"{title} {hand['name']}" if hand.get("name") else title


def _head(result: SelfTestResult, profile: HandModel) -> str:
    css, title = _TITLES[result.verdict]
    wrong = sum(len(j.faulty) for j in result.joints) + sum(e.faulty for e in result.elements)
    worn = sum(len(j.worn) for j in result.joints) + sum(e.worn for e in result.elements)
    texts = []
    if wrong:
        texts.append(f"{_count(wrong, 'figure')} outside what the model says")
    if worn:
        texts.append(
            f"{_count(worn, 'figure')} worse than on {utc(result.baseline['recorded_at'])}"
        )
    if str(result.ended) != "done":
        texts.append(f"the test ended early: {result.reason}")
    if result.spoiled:
        texts.append(
            f"{_count(result.spoiled, 'measurement')} spoiled by pauses of the testing machine; "
            "run it again on an idle one"
        )
    if not texts and result.verdict is Verdict.INCOMPLETE:
        texts.append("not everything that was asked for was measured")
    compared = "; nothing became worse" if result.baseline and not worn else ""
    text = "; ".join(texts) or f"Every joint that was tested does what the model says{compared}"
    return (
        f'<header class="verdict {css}"><p class="question">Self-test of a hand</p>'
        f"<h1>{title}<small>{escape(_name(result))}</small></h1>"
        f"<p>{escape(text[:1].upper() + text[1:])}.</p></header>"
    )


def _count(n: int, what: str) -> str:
    return f"{n} {what} is" if n == 1 else f"{n} {what}s are"


def _facts(result: SelfTestResult) -> str:
    baseline = result.baseline
    rows = {
        "hand": ", ".join(v for k, v in result.hand.items() if v),
        "recorded": f"{utc(result.recorded_at)}, {result.duration_s:.0f} s",
        "limits": f"{result.options['speed']:.0%} of the full speed; a command at most "
        f"{result.options['lead']:g} ahead of its joint; {result.options['rate']:.0f} exchanges/s",
        "compared with": f"{baseline['file']} of {utc(baseline['recorded_at'])}"
        if baseline
        else "no earlier run",
        "ended": result.reason,
        "dexkit": result.dexkit,
    }
    cells = "".join(f"<dt>{name}</dt><dd>{escape(value)}</dd>" for name, value in rows.items())
    return f'<dl class="facts">{cells}</dl>'


def _findings(result: SelfTestResult) -> str:
    rows = [
        (
            no_wrap(escape(f.where)),
            f'<b class="bad">{"worse than before" if f.worn else "outside the model"}</b>',
            escape(f.what),
        )
        for f in findings(result)
    ]
    notes = [(no_wrap(escape(j.name)), "note", escape(n)) for j in result.joints for n in j.notes]
    if not rows and not notes:
        return ""
    return "<h2>Findings</h2>" + table(("where", "verdict", "what"), [*rows, *notes])


def _joints(result: SelfTestResult, profile: HandModel) -> str:
    columns: dict[str, list[str]] = {}
    for kind in KINDS:
        if any(_has(j, kind.name) for j in result.joints):
            title = _titled(kind.title, profile)
            columns.setdefault(title.partition(",")[0], []).append(kind.name)
    rows = []
    rest = [j.name for j in result.joints if j.condition is Condition.UNTESTED]
    for joint in result.joints:
        if joint.name in rest:
            continue
        css = "bad" if "condition" in joint.faulty else "ok"
        moves = f'<b class="{css}">{no_wrap(escape(str(joint.condition)))}</b>'
        cells = ["".join(_cell(joint, n, profile) for n in names) for names in columns.values()]
        rows.append((no_wrap(escape(joint.name)), moves, *cells))
    both = any(len(names) > 1 for names in columns.values())
    about = "<p>Of two figures, the first is with q rising.</p>" if both else ""
    if profile.unit == _TRAVEL:
        of_force = " and forces" if profile.torque_unit == _FORCE else ""
        about += f"<p>Positions{of_force} are percent of the full ones.</p>"
    about += f"<p>Not tested: {escape(', '.join(rest))}.</p>" if rest else ""
    heads = ("joint", "moves", *map(escape, columns))
    return f"<h2>Joints</h2>{about}" + table(heads, rows)


def _has(joint: JointResult, name: str) -> bool:
    return any(f.name == name and math.isfinite(f.value) for f in joint.figures)


def _cell(joint: JointResult, name: str, profile: HandModel) -> str:
    figure = next((f for f in joint.figures if f.name == name), None)
    if figure is None or not math.isfinite(figure.value):
        return "<div>-</div>"
    bad = not figure.good or figure.wear is Wear.WORN
    css = "bad" if bad else "ok" if figure.wear is Wear.BETTER else ""
    text = no_wrap(escape(_value(figure, profile)))
    if bad:
        text = f'<b class="{css}">{text}</b>'
    if math.isfinite(figure.before):
        text += f"<span>was {no_wrap(escape(_value(figure, profile, before=True)))}</span>"
    return f"<div>{text}</div>"


def _elements(result: SelfTestResult) -> str:
    if not result.elements:
        return ""
    heads = ("element", "touch", "at rest", "noise", "pressed")
    rows = []
    for e in result.elements:
        css = "bad" if e.faulty or e.worn else "na" if e.touch is ElementResponse.UNTESTED else "ok"
        rows.append(
            (
                no_wrap(escape(_element(e))),
                f'<span class="{css}">{e.touch}</span>',
                *(_pascal(v) for v in (e.rest, e.noise, e.peak)),
            )
        )
    if not (result.touched or any(e.faulty or e.worn for e in result.elements)):
        most = max(e.noise for e in result.elements)
        return (
            "<h2>Tactile elements</h2><p>Nobody was asked to press them. At rest all "
            f"{len(rows)} have a value; noise at most {_pascal(most)}.</p>"
        )
    return "<h2>Tactile elements</h2>" + table(heads, rows)


def _pascal(value: float) -> str:
    return no_wrap(f"{value:.0f} Pa") if math.isfinite(value) else "-"


# --------------------------------------------------------------------------- curves of a joint


def _joint(joint: JointResult, spec: JointSpec, profile: HandModel, old: JointResult | None) -> str:
    before = old.curves if old else {}
    unit, torque = profile.unit, _torque_unit(profile)
    force = _titled("torque", profile)
    charts = [
        _effort(joint, spec, before.get("sweep"), unit, torque, force),
        *(
            _over_time(joint, name, title, before.get(name), unit)
            for name, title in (
                ("step", "a small step"),
                ("speed+", "the fastest run, q rising"),
                ("speed-", "the fastest run, q falling"),
            )
        ),
        *(
            _start(joint, name, title, before.get(name), torque, force)
            for name, title in (("start+", "rising"), ("start-", "falling"))
        ),
    ]
    drawn = "".join(f"<div>{c}</div>" for c in charts if c)
    return f'<h2>{escape(joint.name)}</h2><div class="beside">{drawn}</div>'


def _effort(
    joint: JointResult, spec: JointSpec, before: Series | None, unit: str, torque: str, force: str
) -> str:
    s = joint.curves.get("sweep")
    if s is None or not np.isfinite(s.tau).any():
        return ""
    lines = [Line(f"earlier run, {w}", "other", x, y) for w, x, y in _ways(before)]
    css = {"q rising": "state", "q falling": "cmd"}
    lines += [Line(way, css[way], x, y) for way, x, y in _ways(s)]
    return chart(
        f"{joint.name}: {force} over its range, moved slowly",
        lines,
        y_unit=torque,
        x_unit=unit,
        span=(spec.q_min, spec.q_max),
        height=170,
        width=_PLOT,
        include=(0.0,),
    )


def _ways(s: Series | None) -> list[tuple[str, Floats, Floats]]:
    """(name, q, torque) of the way up and the way down."""
    if s is None or len(s.q) < 3:
        return []
    # a servo that positions itself is commanded to the end at once, and stays commanded there
    top = int(np.flatnonzero(s.command == s.command.max())[-1]) + 1
    return [("q rising", s.q[:top], s.tau[:top]), ("q falling", s.q[top:], s.tau[top:])]


def _over_time(joint: JointResult, name: str, title: str, before: Series | None, unit: str) -> str:
    s = joint.curves.get(name)
    if s is None:
        return ""
    lines = [Line("earlier run", "other", before.t, before.q)] if before else []
    lines += [Line("command", "cmd", s.t, s.command), Line("q", "state", s.t, s.q)]
    return chart(
        f"{joint.name}: {title}",
        lines,
        y_unit=unit,
        span=(0.0, float(s.t[-1]) or 1.0),
        height=170,
        width=_PLOT,
    )


def _start(
    joint: JointResult, name: str, title: str, before: Series | None, torque: str, force: str
) -> str:
    s = joint.curves.get(name)
    if s is None or not np.isfinite(s.tau).any():
        return ""
    lines = [Line("earlier run", "other", before.t, before.tau)] if before else []
    lines.append(Line(force, "force", s.t, s.tau))
    figure = next((f for f in joint.figures if f.name == name), None)
    sign = 1 if name.endswith("+") else -1
    known = figure is not None and math.isfinite(figure.value)
    levels = [Level(sign * figure.value, f"{force} to start")] if known and figure else []
    return chart(
        f"{joint.name}: {force} under a command that creeps away, q {title}",
        lines,
        y_unit=torque,
        span=(0.0, float(s.t[-1]) or 1.0),
        height=170,
        width=_PLOT,
        levels=levels,
        include=(0.0,),
    )


def _meaning(result: SelfTestResult, profile: HandModel) -> str:
    items = "".join(
        f"<li><b>{escape(_titled(k.title, profile))}</b>: {escape(f'{k.help}. {_limits(k.name)}')}"
        "</li>"
        for k in KINDS
    )
    return (
        f"<h2>What the figures are</h2><ul>{items}</ul>"
        '<p class="dim">All figures are of what the hand reports: a position sensor in front of '
        "the gearing does not see play behind it, and which finger really moved is not seen at "
        "all. Torque and speed depend on the limits of the test: figures of other limits are not "
        "compared.</p>"
    )


def _limits(name: str) -> str:
    kind = BY_NAME[name]
    of = {
        Unit.Q: "of the stroke",
        Unit.TORQUE: "of the most that the test allows",
        Unit.SPEED: "of the speed that was asked for",
    }.get(kind.unit)
    word = "at least" if kind.worse < 0 else "at most"

    def scaled(value: float) -> str:
        return f"{value:.3g} {kind.unit}" if of is None else f"{100 * value:.3g} % {of}"

    limit = f"Good: {word} {scaled(kind.limit)}. " if math.isfinite(kind.limit) else ""
    both = [f"{kind.part:.0%} of the earlier figure"] * bool(kind.part)
    both += [scaled(kind.least)] * bool(kind.least)
    return f"{limit}Worn: worse by more than {' and '.join(both)}."


# ------------------------------------------------------------------------------------ the terminal


def print_selftest(result: SelfTestResult) -> None:
    """Print the figures of every joint, the faults, and the verdict."""
    from rich.table import Table

    from dexkit.console import Console, markup

    profile = model(result.hand["model"])
    console = Console()
    shown = [
        k
        for k in KINDS
        if k.name in ("range", "start+", "start-", "play", "lag", "speed+", "speed-")
        and any(_has(j, k.name) for j in result.joints)
    ]
    heads = {"start+": "start +", "start-": "start -", "speed+": "speed +", "speed-": "speed -"}
    view = Table(box=None, pad_edge=False, header_style="bold")
    view.add_column("joint", no_wrap=True)
    view.add_column("", no_wrap=True)
    for kind in shown:
        view.add_column(heads.get(kind.name, kind.name), justify="right", no_wrap=True)
    for joint in result.joints:
        if joint.condition is Condition.UNTESTED:
            continue
        cells = []
        for kind in shown:
            figure = next(f for f in joint.figures if f.name == kind.name)
            bad = not figure.good or figure.wear is Wear.WORN
            text = markup(_value(figure, profile))
            cells.append(f"[bold red]{text}[/]" if bad else text)
        style = "bold red" if "condition" in joint.faulty else "green"
        view.add_row(markup(joint.name), f"[{style}]{joint.condition}[/]", *cells)
    Console(width=max(console.width, 118)).print(view)
    if result.touched:
        counts = {t: sum(e.touch is t for e in result.elements) for t in ElementResponse}
        texts: Sequence[str] = [
            f"{n} {'answer' if t is ElementResponse.ANSWERS else t}" for t, n in counts.items() if n
        ]
        console.print(f"tactile elements: {', '.join(texts)}")
    for f in findings(result):
        console.print(
            f"[bold red]{'worn' if f.worn else 'fault'}[/] {markup(f.where)}: {markup(f.what)}",
            soft_wrap=True,
        )
    for joint in result.joints:
        for note in joint.notes:
            console.print(f"note {markup(joint.name)}: {markup(note)}", soft_wrap=True)
    css, title = _TITLES[result.verdict]
    style = {"ok": "green", "bad": "red", "open": "magenta"}[css]
    why = "" if str(result.ended) == "done" else f": {markup(result.reason)}"
    if result.spoiled:
        why += f": {_count(result.spoiled, 'measurement')} spoiled by pauses of this machine"
    console.print(f"[bold {style}]{title}[/]{why}", soft_wrap=True)

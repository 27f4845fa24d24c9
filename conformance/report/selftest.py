"""The page of a self-test, and its summary in the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dexkit import __version__
from dexkit.conformance.report.curves import STYLE
from dexkit.conformance.report.html import utc
from dexkit.conformance.report.pages import document
from dexkit.conformance.report.svg_charts import Line, chart
from dexkit.conformance.report.tables import no_wrap, table
from dexkit.conformance.selftest.result import (
    FIGURES,
    Condition,
    ElementResponse,
    ElementResult,
    Figure,
    JointResult,
    SelfTestResult,
    Verdict,
)
from dexkit.escaping import html as escape
from dexkit.models import HandModel, model

__all__ = ["Finding", "findings", "print_selftest", "render_selftest"]

_TITLES = {
    Verdict.GOOD: ("ok", "Nothing is wrong"),
    Verdict.INCOMPLETE: ("open", "Incomplete"),
    Verdict.FAULTY: ("bad", "Faulty"),
}
_WRONG = {
    Condition.DEAD: "does not move",
    Condition.REVERSED: "moves against its commands",
    Condition.OTHER: "its commands move another joint",
}
_PLOT = 200  # pixels across a plot where several are side by side
_TRAVEL = "full travel"  # unit of a profile
_LACKS = {
    ElementResponse.DEAD: "does not answer to touch",
    ElementResponse.NO_VALUE: "has no value",
}
_MEANING = (
    "<h2>What the figures are</h2><ul>"
    "<li><b>range</b>: from end to end, led there slowly. Good: at least 95 % of the stroke.</li>"
    "<li><b>speed</b>: reached in mid range, each way. Good: at least 80 % of the speed that was "
    "asked for.</li></ul>"
    '<p class="dim">All figures are of what the hand reports: which finger really moved is not '
    "seen.</p>"
)


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    :param where: joint or tactile element.
    """

    where: str
    what: str


def findings(result: SelfTestResult) -> list[Finding]:
    """Faults of a hand."""
    profile = model(result.hand["model"])
    found: list[Finding] = []
    for joint in result.joints:
        if "condition" in joint.faulty:
            text = _WRONG[joint.condition]
            if joint.condition is Condition.OTHER:
                text += f": {', '.join(joint.moves)}"
            found.append(Finding(joint.name, text))
        found += [
            Finding(
                joint.name,
                f"{FIGURES[f.name]} {_value(f.name, f.value, profile)} "
                f"(at least {_value(f.name, f.least, profile)})",
            )
            for f in joint.figures
            if not f.good
        ]
    return found + [Finding(_element(e), _LACKS[e.touch]) for e in result.elements if e.faulty]


def _element(e: ElementResult) -> str:
    return f"{e.place}, element {e.packet}.{e.slot}"


def _value(name: str, value: float, profile: HandModel) -> str:
    if not math.isfinite(value):
        return "-"
    of_travel = profile.unit == _TRAVEL
    if name.startswith("speed"):
        return f"{100 * value:.0f} %/s" if of_travel else f"{value:.2f} {profile.unit}/s"
    return f"{100 * value:.2f} %" if of_travel else f"{value:.3f} {profile.unit}"


# ---------------------------------------------------------------------------------------- the page


def render_selftest(result: SelfTestResult) -> str:
    """The page as text; it loads nothing."""
    profile = model(result.hand["model"])
    sections = [
        STYLE,
        _head(result),
        _facts(result),
        _findings(result),
        _joints(result, profile),
        _elements(result),
        *(_curves(j, profile.unit) for j in result.joints if j.curves),
        _MEANING,
    ]
    _, title = _TITLES[result.verdict]
    return document(f"{title}: {_name(result)} (self-test)", "".join(sections))


def _name(result: SelfTestResult) -> str:
    hand = result.hand
    title = f"{hand['side']} {model(hand['model']).title}"
    return f"{title} {hand['name']}" if hand.get("name") else title


def _head(result: SelfTestResult) -> str:
    css, title = _TITLES[result.verdict]
    wrong = sum(len(j.faulty) for j in result.joints) + sum(e.faulty for e in result.elements)
    texts = []
    if wrong:
        texts.append(f"{_count(wrong, 'figure')} outside what the model says")
    if str(result.ended) != "done":
        texts.append(f"the test ended early: {result.reason}")
    if result.spoiled:
        texts.append(
            f"{_count(result.spoiled, 'measurement')} spoiled by pauses of the testing machine; "
            "run it again on an idle one"
        )
    if not texts and result.verdict is Verdict.INCOMPLETE:
        texts.append("not everything that was asked for was measured")
    text = "; ".join(texts) or "Every joint that was tested does what the model says"
    return (
        f'<header class="verdict {css}"><p class="question">Self-test of a hand</p>'
        f"<h1>{title}<small>{escape(_name(result))}</small></h1>"
        f"<p>{escape(text[:1].upper() + text[1:])}.</p></header>"
    )


def _count(n: int, what: str) -> str:
    return f"{n} {what} is" if n == 1 else f"{n} {what}s are"


def _facts(result: SelfTestResult) -> str:
    rows = {
        "hand": ", ".join(v for k, v in result.hand.items() if v),
        "recorded": f"{utc(result.recorded_at)}, {result.duration_s:.0f} s",
        "limits": f"{result.options['speed']:.0%} of the full speed; a command at most "
        f"{result.options['lead']:g} ahead of its joint; {result.options['rate']:.0f} exchanges/s",
        "ended": result.reason,
        "dexkit": __version__,
    }
    cells = "".join(f"<dt>{name}</dt><dd>{escape(value)}</dd>" for name, value in rows.items())
    return f'<dl class="facts">{cells}</dl>'


def _findings(result: SelfTestResult) -> str:
    rows = [
        (
            no_wrap(escape(f.where)),
            '<b class="bad">outside the model</b>',
            escape(f.what),
        )
        for f in findings(result)
    ]
    notes = [(no_wrap(escape(j.name)), "note", escape(n)) for j in result.joints for n in j.notes]
    if not rows and not notes:
        return ""
    return "<h2>Findings</h2>" + table(("where", "verdict", "what"), [*rows, *notes])


def _joints(result: SelfTestResult, profile: HandModel) -> str:
    rows = []
    for joint in result.joints:
        if joint.condition is Condition.UNTESTED:
            continue
        css = "bad" if "condition" in joint.faulty else "ok"
        moves = f'<b class="{css}">{no_wrap(escape(str(joint.condition)))}</b>'
        cells = [_cell(figure, profile) for figure in joint.figures]
        rows.append((no_wrap(escape(joint.name)), moves, *cells))
    about = "<p>Positions are percent of the full ones.</p>" if profile.unit == _TRAVEL else ""
    rest = [j.name for j in result.joints if j.condition is Condition.UNTESTED]
    about += f"<p>Not tested: {escape(', '.join(rest))}.</p>" if rest else ""
    return f"<h2>Joints</h2>{about}" + table(("joint", "moves", *FIGURES.values()), rows)


def _cell(figure: Figure, profile: HandModel) -> str:
    text = no_wrap(escape(_value(figure.name, figure.value, profile)))
    return text if figure.good else f'<b class="bad">{text}</b>'


def _elements(result: SelfTestResult) -> str:
    if not result.elements:
        return ""
    heads = ("element", "touch", "at rest", "noise", "pressed")
    rows = []
    for e in result.elements:
        css = "bad" if e.faulty else "na" if e.touch is ElementResponse.UNTESTED else "ok"
        rows.append(
            (
                no_wrap(escape(_element(e))),
                f'<span class="{css}">{e.touch}</span>',
                *(_pascal(v) for v in (e.rest, e.noise, e.peak)),
            )
        )
    if not (result.touched or any(e.faulty for e in result.elements)):
        most = max(e.noise for e in result.elements)
        return (
            "<h2>Tactile elements</h2><p>Nobody was asked to press them. At rest all "
            f"{len(rows)} have a value; noise at most {_pascal(most)}.</p>"
        )
    return "<h2>Tactile elements</h2>" + table(heads, rows)


def _pascal(value: float) -> str:
    return no_wrap(f"{value:.0f} Pa") if math.isfinite(value) else "-"


def _curves(joint: JointResult, unit: str) -> str:
    titles = {
        "range": "over its range, led slowly",
        "speed+": "the fastest run, q rising",
        "speed-": "the fastest run, q falling",
    }
    charts = [
        chart(
            f"{joint.name}: {titles[name]}",
            [Line("command", "cmd", s.t, s.command), Line("q", "state", s.t, s.q)],
            y_unit=unit,
            span=(0.0, float(s.t[-1]) or 1.0),
            height=170,
            width=_PLOT,
        )
        for name, s in joint.curves.items()
    ]
    drawn = "".join(f"<div>{c}</div>" for c in charts)
    return f'<h2>{escape(joint.name)}</h2><div class="beside">{drawn}</div>'


# ------------------------------------------------------------------------------------ the terminal


def print_selftest(result: SelfTestResult) -> None:
    """Print the figures of every joint, the faults, and the verdict."""
    from rich.table import Table

    from dexkit.console import Console, markup

    profile = model(result.hand["model"])
    console = Console()
    view = Table(box=None, pad_edge=False, header_style="bold")
    view.add_column("joint", no_wrap=True)
    view.add_column("", no_wrap=True)
    for title in FIGURES.values():
        view.add_column(title, justify="right", no_wrap=True)
    for joint in result.joints:
        if joint.condition is Condition.UNTESTED:
            continue
        cells = []
        for figure in joint.figures:
            text = markup(_value(figure.name, figure.value, profile))
            cells.append(text if figure.good else f"[bold red]{text}[/]")
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
        console.print(f"[bold red]fault[/] {markup(f.where)}: {markup(f.what)}", soft_wrap=True)
    for joint in result.joints:
        for note in joint.notes:
            console.print(f"note {markup(joint.name)}: {markup(note)}", soft_wrap=True)
    css, title = _TITLES[result.verdict]
    style = {"ok": "green", "bad": "red", "open": "magenta"}[css]
    why = "" if str(result.ended) == "done" else f": {markup(result.reason)}"
    if result.spoiled:
        why += f": {_count(result.spoiled, 'measurement')} spoiled by pauses of this machine"
    console.print(f"[bold {style}]{title}[/]{why}", soft_wrap=True)

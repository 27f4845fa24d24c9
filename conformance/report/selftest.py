"""The page of a self-test, and its summary in the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dexkit import __version__
from dexkit.conformance.report.charts import Chart, Line
from dexkit.conformance.report.html import utc
from dexkit.conformance.report.pages import fill
from dexkit.conformance.selftest.result import (
    FIGURES,
    Condition,
    ElementResponse,
    ElementResult,
    JointResult,
    SelfTestResult,
    Verdict,
)
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
    css, verdict = _TITLES[result.verdict]
    untested = [j.name for j in result.joints if j.condition is Condition.UNTESTED]
    return fill(
        "selftest.html",
        title=f"{verdict}: {_name(result)} (self-test)",
        result=result,
        css=css,
        verdict=verdict,
        name=_name(result),
        about=_about(result),
        known=_facts(result),
        findings=[
            *((f.where, "outside the model", f.what) for f in findings(result)),
            *((j.name, "note", note) for j in result.joints for note in j.notes),
        ],
        of_travel=profile.unit == _TRAVEL,
        untested=untested,
        tested=[j for j in result.joints if j.name not in untested],
        FIGURES=FIGURES,
        value=lambda figure: _value(figure.name, figure.value, profile),
        element=_element,
        curves=lambda joint: _curves(joint, profile.unit),
    )


def _name(result: SelfTestResult) -> str:
    hand = result.hand
    title = f"{hand['side']} {model(hand['model']).title}"
    return f"{title} {hand['name']}" if hand.get("name") else title


def _about(result: SelfTestResult) -> str:
    """What the verdict rests on, in one sentence."""
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
    return text[:1].upper() + text[1:]


def _count(n: int, what: str) -> str:
    return f"{n} {what} is" if n == 1 else f"{n} {what}s are"


def _facts(result: SelfTestResult) -> dict[str, str]:
    return {
        "hand": ", ".join(v for k, v in result.hand.items() if v),
        "recorded": f"{utc(result.recorded_at)}, {result.duration_s:.0f} s",
        "limits": f"{result.options['speed']:.0%} of the full speed; a command at most "
        f"{result.options['lead']:g} ahead of its joint; {result.options['rate']:.0f} exchanges/s",
        "ended": result.reason,
        "dexkit": __version__,
    }


def _curves(joint: JointResult, unit: str) -> list[Chart]:
    titles = {
        "range": "over its range, led slowly",
        "speed+": "the fastest run, q rising",
        "speed-": "the fastest run, q falling",
    }
    return [
        Chart(
            f"{joint.name}: {titles[name]}",
            [Line("command", "cmd", s.t, s.command), Line("q", "state", s.t, s.q)],
            span=(0.0, float(s.t[-1]) or 1.0),
            y_unit=unit,
            height=170,
            width=_PLOT,
        )
        for name, s in joint.curves.items()
    ]


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

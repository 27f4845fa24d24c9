"""Render a result as a self-contained HTML page: no network, no script; light, dark, phone, print.

The page needs the result only. With the recording that was judged it also shows plots of the
evidence of each failure and of the whole run.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

from dexkit.conformance.recording import Recording
from dexkit.conformance.report.card import (
    Blocked,
    Card,
    Fact,
    blocked_groups,
    cards,
    near_limits,
)
from dexkit.conformance.report.labels import (
    ANSWERS,
    VERDICTS,
    about_harness,
    answer_of,
    catch_sentence,
    device_kind,
    hand_name,
    model_title,
    part,
    quantity,
    subject,
    utc_date,
    whose,
)
from dexkit.conformance.report.result_plots import plots_of
from dexkit.conformance.report.run_plots import run_plots
from dexkit.conformance.requirements import CAPABILITIES, Kind, Requirement
from dexkit.conformance.results import (
    Evidence,
    Grade,
    Overall,
    Result,
    RunResult,
    Stage,
    Verdict,
    grouped,
    overall_of,
    worst,
)
from dexkit.conformance.stimuli.operator import OPERATOR
from dexkit.documents import write_file
from dexkit.escaping import html as escape

__all__ = ["document", "render", "utc", "write_html"]

_STYLE = Path(__file__).with_name("report.css")
_PLOT_BUDGET = 1_000_000
"""Bytes of plots on a page; the failures after that have none."""
_BUSY = 0.2
"""Part of a run with programs waiting for a processor from which on the page reports it."""
_RECORDED_WITH = ("dexkit", "python", "numpy", "cyclonedds", "processor", "kernel", "seed")
_TROUBLE = (Verdict.FAIL, Verdict.ERROR, Verdict.WARN, Verdict.BLOCKED)
_REALITY = {
    "emulated": "No real hand was involved: the device was an emulator at the far end of a wire. "
    "What an emulator does not show: wear, heat, backlash, the noise of real sensors.",
    "simulated": "No real hand was involved: it was a simulation in software.",
    "recorded": "A recording was judged, not a hand that could be provoked: what only a "
    "provocation shows was left out, and who made the recording vouches for it.",
}


def write_html(
    result: RunResult,
    view: Recording | None,
    path: Path,
    *,
    recording: Path | None = None,
    catalogue: str = "",
) -> None:
    """Write the page.

    :param view: the recording that was judged, or None: no plots then.
    :param recording: its file, which the page links to; None for the name that the result has.
    :param catalogue: address of the requirements' pages, as :func:`render` takes it.
    """
    link = result.subject.get("recording", "")
    if recording is not None:
        link = Path(os.path.relpath(recording.absolute(), path.absolute().parent)).as_posix()
    write_file(path, render(result, view, link=link, catalogue=catalogue))


def document(title: str, content: str) -> str:
    """Return a page with the reports' style. Its content security policy forbids loading files."""
    policy = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        '<meta name="referrer" content="no-referrer">'
        f"<title>{escape(title)}</title><style>{_STYLE.read_text(encoding='utf-8')}</style></head>"
        f"<body><main>{content}</main></body></html>\n"
    )


def render(
    result: RunResult, view: Recording | None = None, *, link: str = "", catalogue: str = ""
) -> str:
    """Return the page as text.

    :param link: where the recording is, relative to the page; empty where it is not kept.
    :param catalogue: address of the folder with a page for each requirement (``make docs-site``
        makes them), which the page links to; empty for no links.
    """
    sections = [
        _verdict(result),
        _facts(result),
        _areas(result),
        _troubles(result, view, link),
        _operator(result),
        run_plots(result, view) if view is not None else "",
        _requirements(result, link, catalogue),
        _client(result, link, catalogue),
        _what(result),
        _glossary(result),
        _environment(result),
    ]
    answers = ", ".join(f"{k} {answer_of(result.grade(k)).text.lower()}" for k in Kind)
    about = "client" if result.client_only else answers
    title = f"{ANSWERS[result.overall].text} ({about}): {hand_name(result)}"
    return document(f"{title} as {model_title(result)}", "".join(sections))


# ------------------------------------------------------------------------------- the verdict


def _verdict(result: RunResult) -> str:
    """The grade as a drop-in, then that in safety: one header each."""
    grade = result.grade(Kind.DROP_IN)
    answer = ANSWERS[result.overall] if result.client_only else answer_of(grade)
    counts = result.counts()
    sentence = _sentence(grade, subject(result))
    real = device_kind(result)
    badge = f' <span class="chip real">{real}</span>' if real else ""
    chips = "".join(
        f'<span class="chip {VERDICTS[v].css}">{n} {VERDICTS[v].text}</span>'
        for v, n in counts.items()
        if n
    )
    caution = ""
    if result.starved > _BUSY:
        caution = (
            f"<p><b>The testing machine was busy</b>: {escape(about_harness(result))}. What "
            "this can have caused is blocked, not failed; run again on an idle machine.</p>"
        )
    if near := near_limits(result):
        items = "".join(f"<li>{escape(text)}</li>" for text in near)
        caution += f"<p><b>Nearer to a limit than the kit can measure</b>:</p><ul>{items}</ul>"
    if of := part(result):
        caution = f"<p><b>{of}</b>: this does not prove a drop-in.</p>{caution}"
    question = f"Is this a drop-in for Unitree's {escape(model_title(result))}?"
    if result.client_only:
        question = f"Is this a client for Unitree's {escape(model_title(result))}?"
        sentence = f"Only {result.client_sentence()}."
    elif overall_of(result.client) is Overall.FAIL or result.spoiled_by:
        caution += (
            "<p><b>The client that commanded it is at fault</b>, which is no failure of the "
            f'{subject(result)}: see <a href="#client">the client</a>.</p>'
        )
    stages = "".join(_stage(side, stage) for side, stage in result.stage.items())
    return (
        f'<header class="verdict {answer.css}">'
        f"<p class='question'>{question}</p>"
        f"<h1>{answer.text}<small>{escape(hand_name(result))}{badge}</small></h1>"
        f"<p>{escape(sentence)}</p>{caution}</header>"
        f"{'' if result.client_only else _safety(result)}"
        f'<div class="chips">{chips}</div><div class="stages">{stages}</div>'
        f'<p class="dim">{escape(catch_sentence(result))}</p>'
    )


def _safety(result: RunResult) -> str:
    """The grade in safety, and what was not met there, beside what the original does."""
    grade, what = result.grade(Kind.SAFETY), subject(result)
    answer = answer_of(grade)
    rows = "".join(
        f"<li><a href='#{escape(need.id)}'>{escape(need.title)}</a>: "
        f"{escape(', '.join(f'{r.side} {r.figure or r.verdict}' for r in group))}. "
        f"The original: {escape(need.original)}</li>"
        for need, group in result.by_requirement()
        if need.kind is Kind.SAFETY
        and worst(r.verdict for r in group) in (Verdict.FAIL, Verdict.WARN)
    )
    return (
        f'<section class="verdict {answer.css}">'
        f"<p class='question'>Is it safer than the original with bad input and when it ends?</p>"
        f"<h1>{answer.text}<small>safety</small></h1><p>{escape(_sentence(grade, what))}</p>"
        + (f"<ul>{rows}</ul>" if rows else "")
        + "</section>"
    )


def _sentence(grade: Grade, what: str) -> str:
    """A grade in words, for readers who do not know the kit.

    :param what: hand or robot.
    """
    if not grade.judged:
        return f"Nothing of this could be tested, so nothing can be said of the {what} here."
    text = {
        Overall.PASS: f"This {what} did everything that it must and that could be tested here.",
        Overall.FAIL: f"This {what} broke at least one rule that it must keep.",
        Overall.INCONCLUSIVE: "A rule that must be kept could not be tested: this is not a pass.",
    }[grade.overall]
    if grade.overall is Overall.PASS and (n := grade.counts[Verdict.WARN]):
        text += f" {n} recommendation{'s are' if n > 1 else ' is'} not met."
    return text


def _stage(side: str, stage: Stage) -> str:
    """The stage that a hand reached, as a row of steps."""
    steps = list(Stage)
    reached = steps.index(stage)
    marks = "".join(
        f'<i class="{"done" if i <= reached else ""}" title="{step}"></i>'
        for i, step in enumerate(steps)
        if i
    )
    css = "ok" if stage is Stage.MOVING else "open" if reached >= 4 else "bad"
    return (
        f'<p class="stage {css}"><span><b>{escape(whose(side))}</b> reached: <b>{stage}</b> '
        f'({reached} of {len(steps) - 1})</span><span class="steps" aria-hidden="true">{marks}'
        "</span></p>"
    )


def _facts(result: RunResult) -> str:
    about = dict(result.subject)
    rows = [(k.replace("_", " ").replace("sha256", "SHA-256"), v) for k, v in about.items() if v]
    rows.append(("recorded", f"{utc(result.recorded_at)}, {result.duration_s:.1f} s"))
    if result.claims is not None:
        has = [name for name, claimed in result.claims.items() if claimed]
        lacks = [name for name in CAPABILITIES if name not in has]
        rows.append(("claimed units", ", ".join(has) or "none"))
        rows.append(("not claimed", ", ".join(lacks) or "none"))
    if harness := about_harness(result):
        rows.append(("test machine", harness))
    return _definitions(rows)


def utc(text: str) -> str:
    """An ISO time for readers."""
    try:
        return datetime.fromisoformat(text).strftime("%Y-%m-%d %H:%M:%S UTC")
    except ValueError:
        return text or "at an unknown time"


def _definitions(rows: Sequence[tuple[str, str]]) -> str:
    return (
        '<dl class="facts short">'
        + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows)
        + "</dl>"
    )


def _areas(result: RunResult) -> str:
    """The verdicts of each area, as a table with bars."""
    if not result.results:
        return ""
    groups: dict[str, list[Verdict]] = {}
    for requirement, group in result.by_requirement():
        groups.setdefault(requirement.area, []).append(worst(r.verdict for r in group))
    most = max(len(v) for v in groups.values())
    rows = []
    for area, verdicts in groups.items():
        counts = [(v, verdicts.count(v)) for v in _ORDER if v in verdicts]
        bar = "".join(
            f'<i class="{VERDICTS[v].css}" style="width:{100 * n / most:.1f}%"></i>'
            for v, n in counts
        )
        summary = ", ".join(
            f'<span class="{VERDICTS[v].css}">{n} {VERDICTS[v].text}</span>' for v, n in counts
        )
        rows.append(
            f'<tr><th scope="row"><a href="#{_anchor(area)}">{escape(area)}</a></th>'
            f'<td><div class="tally"><span class="bar" aria-hidden="true">{bar}</span>'
            f"<span>{summary}</span></div></td></tr>"
        )
    return (
        '<h2>By area</h2><table class="areas"><thead class="hidden"><tr><th scope="col">area</th>'
        f'<th scope="col">requirements</th></tr></thead><tbody>{"".join(rows)}</tbody></table>'
    )


_ORDER = (
    Verdict.FAIL,
    Verdict.ERROR,
    Verdict.BLOCKED,
    Verdict.WARN,
    Verdict.PASS,
    Verdict.NOT_APPLICABLE,
    Verdict.NOT_CLAIMED,
)


def _anchor(text: str) -> str:
    return "area-" + "".join(c if c.isalnum() else "-" for c in text.lower())


# -------------------------------------------------------------------------------- the cards


def _troubles(result: RunResult, view: Recording | None, link: str) -> str:
    """A card for each requirement that is not met, then the blocked requirements."""
    found = cards(result, _TROUBLE)
    blocked = [group for group in blocked_groups(result.results) if group.before]
    if not found and not blocked:
        return ""
    plots = _Plots(view)
    worst_of_all = worst(card.verdict for card in found) if found else Verdict.BLOCKED
    head = {
        Verdict.WARN: "What could be better, and what to try",
        Verdict.BLOCKED: "What could not be judged",
    }.get(worst_of_all, "What is wrong, and what to try")
    parts = [f"<h2>{head}</h2>", *(_card(card, plots, link) for card in found)]
    parts += [_blocked(group) for group in blocked]
    if view is None and found:
        parts.append(
            '<p class="dim">Plots of the evidence need the recording: '
            "<code>dexkit report RESULT.json --recording RUN.mcap --report REPORT.html</code></p>"
        )
    return "".join(parts)


class _Plots:
    """Draws plots of evidence up to a maximum size of the page."""

    def __init__(self, view: Recording | None) -> None:
        self._view = view
        self._left = _PLOT_BUDGET

    def figures_for(self, result: Result) -> str:
        if self._view is None:
            return ""
        if self._left <= 0:
            return '<p class="dim">No plot: this page has as many as it can hold.</p>'
        figures = "".join(plots_of(result, self._view))
        self._left -= len(figures)
        return figures


def _card(card: Card, plots: _Plots, link: str) -> str:
    need, word = card.requirement, VERDICTS[card.verdict]
    facts = "".join(
        f"<dt>{_label(fact)}</dt><dd>"
        + (_place(fact.place, link) if fact.place is not None else escape(fact.text))
        + "</dd>"
        for fact in card.facts()
    )
    figures = "".join(plots.figures_for(result) for result in card.results)
    if figures and card.verdict is Verdict.BLOCKED:
        figures = f"<details><summary>What was seen</summary>{figures}</details>"
    whom = " of the client" if need.about_client else ""
    return (
        f'<article class="card {word.css}" id="card-{escape(need.id)}">'
        f'<h3><b class="{word.css}">{word.text}</b>{whom} {escape(need.title)} '
        f'<code>{escape(need.id)}</code> <span class="dim">{escape(card.sides)}</span></h3>'
        f'<dl class="facts">{facts}</dl>{figures}</article>'
    )


def _label(fact: Fact) -> str:
    return f"{fact.item.label}, {escape(fact.sides)}" if fact.sides else fact.item.label


def _place(place: Evidence, link: str) -> str:
    """The place in the recording, as text that can be copied."""
    until = f" to {place.end_s:.3f} s" if place.end_s is not None else ""
    when = utc_date(place.log_time_ns).isoformat(timespec="milliseconds")
    file = f' in <a href="{escape(quote(link))}">{escape(Path(link).name)}</a>' if link else ""
    return (
        f'<div class="place"><code>{escape(place.topic)}</code> at {place.time_s:.3f} s{until}'
        f'{file}, log time <code class="copy" title="{when}">'
        f"{place.log_time_ns}</code></div>"
    )


def _blocked(blocked: Blocked) -> str:
    before = escape(blocked.before)
    rows = "".join(
        f"<li><a href='#{escape(card.requirement.id)}'><code>{escape(card.requirement.id)}</code>"
        f"</a> {escape(card.requirement.title)} "
        f'<span class="dim">{escape(", ".join(r.side for r in card.results))}</span></li>'
        for card in blocked.cards
    )
    return (
        f'<article class="card open"><h3><b class="open">blocked</b> by '
        f"<a href='#{before}'><code>{before}</code></a></h3>"
        "<p>Not judged, because that has to be right first:</p>"
        f"<ul>{rows}</ul></article>"
    )


def _operator(result: RunResult) -> str:
    """The figures of the modelled operator, if there was one."""
    rows = [
        (need.title, " · ".join(f"{r.side} {r.figure or VERDICTS[r.verdict].text}" for r in group))
        for need, group in result.by_requirement()
        if need.phase == OPERATOR and any(r.verdict.judged for r in group)
    ]
    if not rows:
        return ""
    return (
        "<h2>What an operator would notice</h2><p>A model of Unitree's teleoperation client drove "
        "the hand: it sends no command further than 0.18 rad from the last state, so that a hand "
        f"which reports late is slow.</p>{_definitions(rows)}"
    )


# ------------------------------------------------------------------------ every requirement


def _requirements(result: RunResult, link: str, catalogue: str) -> str:
    if not result.results:
        return ""
    choices = [
        ("all", "all"),
        ("attention", "not met"),
        ("passed", "passed"),
        ("open", "not judged"),
    ]
    radios = "".join(
        f'<input type="radio" name="show" id="show-{key}"{" checked" if key == "all" else ""}>'
        f'<label for="show-{key}">{text}</label>'
        for key, text in choices
    )
    parts = [
        "<h2>Every requirement</h2><p class='dim'>MUST decides the verdict; SHOULD only warns. "
        "Open a row for the observation, the rationale and the source.</p>"
        f'<div class="filter" role="radiogroup" aria-label="requirements to show">{radios}</div>'
    ]
    area = ""
    for need, group in result.by_requirement():
        if need.area != area:
            area = need.area
            parts.append(f'<h3 class="area-head" id="{_anchor(area)}">{escape(area)}</h3>')
        parts.append(_requirement(need, group, link, catalogue))
    return f'<section class="every">{"".join(parts)}</section>'


def _client(result: RunResult, link: str, catalogue: str) -> str:
    """The requirements about the client; empty where the kit was the client."""
    if not result.client:
        return ""
    rows = "".join(
        _requirement(need, group, link, catalogue) for need, group in grouped(result.client)
    )
    sentence = result.client_sentence()
    return (
        '<h2 id="client">The client</h2><p class="dim">Judged by the commands in the recording. '
        "They say nothing of the hands; what a client at fault does not allow to judge is "
        f'blocked.</p><p>{escape(sentence[:1].upper() + sentence[1:])}.</p><section class="every">'
        f"{rows}</section>"
    )


def _requirement(need: Requirement, group: list[Result], link: str, catalogue: str) -> str:
    verdict = worst(r.verdict for r in group)
    css = VERDICTS[verdict].css
    cells = "".join(_cell(r) for r in group)
    card = Card.from_results(group)
    seen = "".join(_seen(card, r, link) for r in group)
    trouble = (
        f'<p><a href="#card-{escape(need.id)}">What is wrong, and what to try</a></p>'
        if any(r.verdict in _TROUBLE and not r.blocked_by for r in group)
        else ""
    )
    kind = f", {need.kind}" if need.kind is Kind.SAFETY else ""
    original = f"<p>The original: {escape(need.original)}</p>" if need.original else ""
    page = f"{catalogue.rstrip('/')}/{quote(need.id)}.html" if catalogue else ""
    more = f'<p><a href="{escape(page)}">{escape(need.id)} in the catalogue</a></p>' if page else ""
    return (
        f'<details class="req {css}" id="{escape(need.id)}"><summary>'
        f'<span class="id {css}">{escape(need.id)}</span>'
        f'<span class="title">{escape(need.title)} '
        f'<span class="dim">{need.level}{kind}</span></span>'
        f"{cells}</summary>"
        f'<div class="more"><p><b>{escape(need.sentence)}</b></p>{seen}{trouble}'
        f"<p>{escape(need.rationale)}</p>{original}"
        f'<p class="dim">Source: {escape(card.source)}</p>'
        f"{more}</div></details>"
    )


def _cell(result: Result) -> str:
    word = VERDICTS[result.verdict]
    figure = f"<span>{escape(result.figure)}</span>" if result.figure else ""
    return (
        f'<span class="v {word.css}"><i>{escape(result.side)}</i> <b>{word.text}</b>{figure}</span>'
    )


def _seen(card: Card, result: Result, link: str) -> str:
    facts = list(card.findings(result))
    text = ". ".join(f.text for f in facts if f.place is None) or result.figure
    figures = "".join(
        f"<span>{escape(name)} <b>{escape(text)}</b></span>"
        for name, text in (quantity(k, v) for k, v in result.values.items())
    )
    return (
        f"<p><b>{escape(result.side)}:</b> {escape(text)}</p>"
        + (f'<p class="figures">{figures}</p>' if figures else "")
        + "".join(_place(f.place, link) for f in facts if f.place is not None)
    )


# ---------------------------------------------------------------------------- at the end


def _what(result: RunResult) -> str:
    text = [
        "<h2>What was done</h2><p>A Unitree robot talks to its hands over a network in small "
        "messages: it sends <em>commands</em> (go there) 100 or 200 times a second and gets "
        "<em>state</em> back (this is where I am) 500 to 1000 times a second. Another hand "
        "can take the original's place only if it speaks and behaves the same. "
    ]
    if subject(result) == "robot":
        text = [
            "<h2>What was done</h2><p>A program leads a Unitree robot joint by joint: "
            "it sends <em>commands</em> (positions, speeds, torques and gains of all motors) some "
            "hundred times a second and gets <em>state</em> back 500 times a second. A simulator "
            "can take the robot's place only if it speaks and behaves the same. "
        ]
    if "backend" in result.subject and result.partial:
        text.append(
            f"Here a test program led the {subject(result)} with only those commands that the "
            "selected requirements need, and recorded everything. The verdicts were read off the "
            "recording.</p>"
        )
    elif "backend" in result.subject and subject(result) == "robot":
        text.append(
            "Here a test program led it: it listened, moved each joint, sent broken commands, fell "
            "silent and came back. Everything was recorded, and the verdicts were read off the "
            "recording.</p>"
        )
    elif "backend" in result.subject:
        text.append(
            "Here a test program took the robot's role: it listened, moved each hand, sent "
            "broken commands, fell silent, came back, and replayed a recorded teleoperation "
            "session. Everything was recorded, and the verdicts were read off the recording.</p>"
        )
    else:
        text.append("Here the recording of a session was judged.</p>")
    if real := _REALITY.get(device_kind(result)):
        text.append(f'<p class="reality">{real}</p>')
    return "".join(text)


def _glossary(result: RunResult) -> str:
    terms = [
        (
            "topic",
            "a named channel on the network (DDS); a program with another name gets nothing.",
        ),
        ("q, rad", "position of a joint as the angle of its motor, in radians."),
        ("tau_est, N m", "torque that the motor reports; the only sign of touch without sensors."),
        ("not applicable", "the recording does not show it; the row gives the reason."),
        ("docs/sources", "pages of dexkit with the facts, documents and measurements, by section."),
        ("blocked", "something more basic failed first, or the testing machine itself was late."),
    ]
    if result.claims is not None:
        terms.append(("not claimed", "the vendor does not claim that the hand has this unit."))
    return f"<h2>Words</h2>{_definitions(terms)}"


def _environment(result: RunResult) -> str:
    notes = "".join(f"<li>{escape(n)}</li>" for n in result.notes)
    rows = list(result.environment.items())
    rows += [(f"recorded with {k}", result.run[k]) for k in _RECORDED_WITH if k in result.run]
    return (
        f"<h2>Made with</h2>{_definitions(rows)}"
        + (f"<p>Notes on the recording:</p><ul>{notes}</ul>" if notes else "")
        + '<p class="dim">Times are seconds of the recording; log times are nanoseconds since '
        "1970, as the recording has them. It opens in Foxglove and PlotJuggler, and "
        "<code>dexkit check</code> judges it again.</p>"
    )

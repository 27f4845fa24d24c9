"""The result as one self-contained page: no network, no script; light, dark, phone and print."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np

from dexkit.conformance.report.plots import Band, Line, histogram, time_plot
from dexkit.conformance.results import Overall, Result, RunResult, Verdict, worst
from dexkit.conformance.view import Recording, SideView
from dexkit.hand import JointSpec, Side
from dexkit.models import MODELS

__all__ = ["render", "write_html"]

_NAMES = {
    Verdict.PASS: ("pass", "ok"),
    Verdict.FAIL: ("fail", "bad"),
    Verdict.WARN: ("warn", "warn"),
    Verdict.NOT_CLAIMED: ("not claimed", "na"),
    Verdict.NOT_APPLICABLE: ("not judged", "na"),
    Verdict.BLOCKED: ("blocked", "open"),
    Verdict.ERROR: ("kit error", "open"),
}
_HEADS = {
    Overall.PASS: ("Pass", "ok", "This hand did everything that could be tested here."),
    Overall.FAIL: ("Fail", "bad", "This hand broke at least one rule that it must keep."),
    Overall.INCONCLUSIVE: (
        "Inconclusive",
        "open",
        "A rule that must be kept could not be tested: this is not a pass.",
    ),
}
_PHASES = {
    "listen": "listen",
    "approach": "to mid",
    "step": "steps",
    "nan": "NaN",
    "out-of-range": "out of range",
    "empty": "empty",
    "recover": "recover",
    "limp": "zero gains",
    "replay": "replayed session",
    "late-joiner": "late joiner",
    "squeeze": "squeeze",
    "drive": "velocity",
    "silence": "silence",
    "resume": "resume",
    "restart": "restart",
}

_STYLE = Path(__file__).with_name("report.css")


def write_html(result: RunResult, view: Recording, path: Path) -> None:
    """Write the page."""
    path.write_text(render(result, view), encoding="utf-8")


def render(result: RunResult, view: Recording) -> str:
    """The page as text."""
    head, css, sentence = _HEADS[result.overall]
    about = result.subject.get("backend") or result.subject.get("recording", "recording")
    body = [
        f"<h1>Is this a drop-in for Unitree's {escape(_title(result))}?</h1>",
        f'<div class="verdict {css}"><b>{head}</b><p>{escape(sentence)}</p></div>',
        _chips(result),
        _facts(result),
        _what(result, view),
        _troubles(result),
        _pictures(result, view),
        _table(result),
        _glossary(),
        _environment(result),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{head}: {escape(about)} as {escape(_title(result))}</title>"
        f"<style>{_STYLE.read_text(encoding='utf-8')}</style></head><body><main>{''.join(body)}</main></body></html>\n"
    )


def _title(result: RunResult) -> str:
    known = MODELS.get(result.subject.get("model", ""))
    return known.title if known else "hand"


def _chips(result: RunResult) -> str:
    counts = result.counts()
    chips = [
        f'<span class="chip {_NAMES[v][1]}">{n} {_NAMES[v][0]}</span>'
        for v, n in counts.items()
        if n
    ]
    return f'<div class="chips">{"".join(chips)}</div>'


def _facts(result: RunResult) -> str:
    rows = {
        **result.subject,
        "recorded": f"{result.recorded_at}, {result.duration_s:.1f} s",
        **{f"{side} hand": str(stage) for side, stage in result.stage.items()},
        "machine": f"short of processor time for {result.starved:.0%} of the run",
    }
    return (
        '<dl class="facts">'
        + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows.items())
        + "</dl>"
    )


def _what(result: RunResult, view: Recording) -> str:
    emulated = result.subject.get("device") == "emulated"
    text = [
        "<h2>What was done</h2><p>A Unitree robot talks to its hands over a network in small "
        "messages: it sends <em>commands</em> (go there) 100 or 200 times a second and gets "
        "<em>state</em> back (this is where I am) 500 to 1000 times a second. Another hand "
        "can take the original's place only if it speaks and behaves the same. "
    ]
    if view.stimulus is not None:
        text.append(
            "Here a test program took the robot's role: it listened, moved each hand, sent "
            "broken commands, fell silent, came back, and replayed a recorded teleoperation "
            "session. Everything was recorded, and the verdicts below were read off the "
            "recording."
        )
    else:
        text.append(
            "Here a recording of a session was judged. What can only be seen by provoking the "
            "hand was left out."
        )
    text.append("</p>")
    if emulated:
        text.append(
            '<p class="dim">No real gripper was involved: the device was an emulator at the far '
            "end of a serial line. What an emulator does not show: wear, heat, backlash, the "
            "noise of real sensors.</p>"
        )
    return "".join(text)


def _troubles(result: RunResult) -> str:
    bad = [r for r in result.results if r.verdict in (Verdict.FAIL, Verdict.ERROR)]
    warned = [r for r in result.results if r.verdict is Verdict.WARN]
    blocked = [r for r in result.results if r.verdict is Verdict.BLOCKED]
    if not (bad or warned or blocked):
        return ""
    cards = [_card(r) for r in bad + warned]
    if blocked:
        names = ", ".join(
            f"<code>{escape(r.requirement.id)}</code> {escape(r.side)} ({escape(r.reason)})"
            for r in blocked
        )
        cards.append(f'<div class="card open"><b>Not judged because of this:</b> {names}</div>')
    return f"<h2>What is wrong, and what to try</h2>{''.join(cards)}"


def _card(result: Result) -> str:
    need = result.requirement
    name, css = _NAMES[result.verdict]
    where = "".join(
        f"<dt>where</dt><dd><code>{escape(e.topic)}</code> at {e.time_s:.3f} s"
        + (f" to {e.end_s:.3f} s" if e.end_s is not None else "")
        + f" (log time {e.log_time_ns})</dd>"
        for e in result.evidence
    )
    return (
        f'<div class="card {css}"><b class="{css}">{name}</b> <code>{escape(need.id)}</code> '
        f"{escape(result.side)} hand: {escape(need.title)}"
        f'<dl class="facts"><dt>required</dt><dd>{escape(need.sentence)}</dd>'
        f"<dt>observed</dt><dd>{escape(result.observed or result.reason)}</dd>{where}"
        f"<dt>try</dt><dd>{escape(need.advice)}</dd>"
        f"<dt>source</dt><dd>{escape(need.source)} ({escape(need.confidence)})</dd></dl></div>"
    )


def _pictures(result: RunResult, view: Recording) -> str:
    parts = [
        "<h2>What the hands did</h2>",
        '<p class="key"><i class="cmd"></i>command: where the hand is told to go'
        '<i class="state"></i>state: where it says it is'
        '<i class="force"></i>the force that it feels</p>',
    ]
    for side in view.judged:
        parts.append(_pictures_of(result, view, view.sides[side]))
    return "".join(parts)


def _pictures_of(result: RunResult, view: Recording, hand: SideView) -> str:
    states, commands = hand.states, hand.commands
    if not len(states):
        return f"<h3>{hand.side} hand</h3><p>No state of this hand was received.</p>"
    span = (0.0, max(view.duration, 0.1))
    bands = _bands(view, hand.side) + _alarms(result, hand.side)
    touch = view.stimulus.objects.get(hand.side) if view.stimulus else None
    gripper = len(hand.joints) == 1
    # of a gripper it is an angle; of a hand with fingers a percentage of closing, at no one angle
    felt = [(touch, "object")] if touch is not None and gripper else []
    opening = f": opening (0 closed, {hand.joints[0].stroke:.2f} open)" if gripper else ""
    parts = [f"<h3>{str(hand.side).capitalize()} hand{opening}</h3>"]
    replay = view.phases("replay", hand.side)
    for index, joint in enumerate(hand.joints):
        height = 220 if gripper else 150
        name = "position" if gripper else joint.name
        if not gripper:
            parts.append(f"<p><b>{escape(joint.name)}</b>{_way(joint)}</p>")
        margin = 0.1 * joint.stroke  # wild commands would squash the rest
        lines = [
            Line(
                "command",
                "cmd",
                commands.t,
                np.clip(commands.q[:, index], joint.q_min - margin, joint.q_max + margin),
            ),
            Line("state", "state", states.t, states.q[:, index]),
        ]
        include = (0.0, joint.stroke) if gripper else (joint.q_min, joint.q_max)
        parts.append(
            _plot(
                time_plot(
                    f"{hand.side} hand, {name}",
                    lines,
                    unit="rad",
                    span=span,
                    bands=bands,
                    height=height,
                    include=include,
                    limits=felt,
                )
            )
        )
        if replay and gripper:
            a, b = view.seconds(replay[0].begin_ns), view.seconds(replay[0].end_ns)
            session = replay[0].params.get("session", "session")
            parts.append(f"<p>The replayed session <code>{escape(session)}</code>, closer:</p>")
            parts.append(
                _plot(
                    time_plot(
                        f"{hand.side} hand, replayed session",
                        lines,
                        unit="rad",
                        span=(a, b),
                        include=include,
                        limits=felt,
                    )
                )
            )
    if gripper:
        held = f" There is something between its fingers, felt at {touch:.2f} rad." if felt else ""
        parts.append(f"<p>Force (tau_est): negative is closing.{held}</p>")
    else:
        held = (
            f" There is something between its fingers, at {touch:g} % of closing." if touch else ""
        )
        parts.append(f"<p>Torque (tau_est) of each joint.{held}</p>")
    parts.append(
        _plot(
            time_plot(
                f"{hand.side} hand, force",
                [
                    Line("force", "force", states.t, states.tau[:, index])
                    for index in range(len(hand.joints))
                ],
                unit="N m",
                span=span,
                bands=_bands(view, hand.side, label=False),
                height=150,
                include=(0.0,),
            )
        )
    )
    intervals = np.diff(states.clock) * 1e3
    if len(intervals) > 10 and (intervals > 0).any():
        limits = [(5.0, "5 ms: 200 Hz")]
        parts.append(
            "<p>Time from each state to the next. A good hand has one tall bar; the count "
            "axis is logarithmic, so that single late ones show.</p>"
        )
        parts.append(
            _plot(
                histogram(
                    f"{hand.side} hand, intervals",
                    intervals[intervals > 0],
                    unit="ms",
                    limits=limits,
                )
            )
        )
        parts.append(
            _plot(
                time_plot(
                    f"{hand.side} hand, intervals over time",
                    [
                        Line(
                            "interval",
                            "state",
                            states.clock[1:],
                            np.where(intervals > 0, intervals, np.nan),
                        )
                    ],
                    unit="ms",
                    span=span,
                    height=130,
                    include=(0.0, 5.0),
                )
            )
        )
    return "".join(parts)


def _way(joint: JointSpec) -> str:
    closing = {1: ", closes upwards", -1: ", closes downwards", 0: ""}[joint.closing]
    return f" ({joint.q_min:.2f} to {joint.q_max:.2f} rad{closing})"


def _plot(svg: str) -> str:
    return f'<div class="card scroll">{svg}</div>'


def _bands(view: Recording, side: Side, *, label: bool = True) -> list[Band]:
    if view.stimulus is None:
        return []
    merged: list[Band] = []
    for phase in view.stimulus.phases:
        name = _PHASES.get(phase.name)
        if name is None or side not in phase.sides:
            continue
        a, b = view.seconds(phase.begin_ns), view.seconds(phase.end_ns)
        if merged and merged[-1].label == name and a - merged[-1].end < 0.05:
            merged[-1] = Band(name, merged[-1].begin, b)
        else:
            merged.append(Band(name, a, b))
    return merged if label else [Band("", b.begin, b.end) for b in merged]


def _alarms(result: RunResult, side: Side) -> list[Band]:
    """Where something went wrong, in red."""
    return [
        Band(r.requirement.id, e.time_s, e.end_s, "alarm")
        for r in result.results
        if r.side == str(side) and r.verdict is Verdict.FAIL
        for e in r.evidence
        if e.end_s is not None
    ]


def _table(result: RunResult) -> str:
    sides = list(dict.fromkeys(r.side for r in result.results))
    parts = [
        "<h2>Every requirement</h2><p class='dim'>MUST decides the verdict; SHOULD only warns. "
        "Open a row for the reason behind it, what was seen, and who says so.</p>"
    ]
    area = ""
    for requirement, group in result.by_requirement():
        if requirement.area != area:
            if area:
                parts.append("</tbody></table></div>")
            area = requirement.area
            heads = "".join(f"<th>{escape(s)}</th>" for s in sides)
            parts.append(
                f"<h3>{escape(area)}</h3><div class='card'><table><thead><tr><th>id</th>"
                f"<th>requirement</th>{heads}</tr></thead><tbody>"
            )
        css = _NAMES[worst(r.verdict for r in group)][1]
        seen = "".join(
            f"<p><b>{escape(r.side)}:</b> {escape(r.observed or r.reason)}</p>" for r in group
        )
        cells = "".join(_verdict_cell(r) for r in group)
        parts.append(
            f'<tr><td class="id {css}">{escape(requirement.id)}</td>'
            f"<td><details><summary>{escape(requirement.sentence)} "
            f'<span class="dim">{requirement.level}</span></summary>{seen}'
            f"<p>{escape(requirement.rationale)}</p>"
            f'<p class="dim">{escape(requirement.source)} ({escape(requirement.confidence)})</p>'
            f"</details></td>{cells}</tr>"
        )
    parts.append("</tbody></table></div>" if area else "")
    return "".join(parts)


def _verdict_cell(result: Result) -> str:
    name, css = _NAMES[result.verdict]
    figure = f"<span>{escape(result.figure)}</span>" if result.figure else ""
    return f'<td class="v {css}" data-side="{escape(result.side)}"><b>{name}</b>{figure}</td>'


def _glossary() -> str:
    terms = {
        "Dex1-1": "Unitree's two-finger gripper for its humanoid robots.",
        "topic": "a named channel on the network (DDS); who uses another name is not heard.",
        "q, rad": "opening of the gripper as the angle of its motor, in radians.",
        "tau_est, N m": "torque that the motor feels: what the gripper knows of touch.",
        "not judged": "this recording or hand gave no occasion for it; the row says why.",
        "blocked": "something more basic failed first, or the testing machine itself was late.",
    }
    rows = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in terms.items())
    return f'<h2>Words</h2><dl class="facts">{rows}</dl>'


def _environment(result: RunResult) -> str:
    rows = "".join(
        f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in result.environment.items()
    )
    notes = "".join(f"<li>{escape(n)}</li>" for n in result.notes)
    return (
        f'<h2>Made with</h2><dl class="facts">{rows}</dl>'
        + (f"<p>Notes on the recording:</p><ul>{notes}</ul>" if notes else "")
        + '<p class="dim">The times above are seconds of the recording; the recording opens in '
        "Foxglove and PlotJuggler, and <code>dexkit check</code> judges it again.</p>"
    )

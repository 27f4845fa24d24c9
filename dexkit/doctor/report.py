"""The doctor's report: on a terminal, and as data."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from dexkit.console import Console
from dexkit.console import markup as escape
from dexkit.doctor.awaited_topics import AWAITED
from dexkit.doctor.catalogue import Finding, Severity
from dexkit.doctor.observations import DomainView, Endpoint, Link, Observations
from dexkit.doctor.rules import Readiness, Verdict
from dexkit.doctor.topic_spelling import short
from dexkit.escaping import LONGEST
from dexkit.robots import ROBOTS
from dexkit.topics import roles, split_prefix

__all__ = ["SCHEMA_VERSION", "as_data", "print_report"]

SCHEMA_VERSION = 1
"""Version of the JSON report; incremented when a field changes its meaning or is removed."""

_BODY_TOPICS = {
    topic
    for robot in ROBOTS.values()
    for topic in (robot.cmd_topic, robot.state_topic, robot.arm_topic, robot.remote_topic)
}
_COLOUR = {Severity.ERROR: "red", Severity.WARNING: "yellow", Severity.NOTE: "dim"}


def as_data(
    seen: Observations, findings: list[Finding], result: Verdict, states: list[Readiness]
) -> dict[str, Any]:
    """The report as JSON data; docs/doctor.md describes it."""
    return {
        "version": SCHEMA_VERSION,
        "healthy": result.healthy,
        "verdict": result.text,
        "ready": [dataclasses.asdict(state) for state in states],
        "findings": [
            {
                "id": f.id,
                "severity": str(f.severity),
                "title": f.diagnosis.title,
                "seen": f.seen,
                "why": f.diagnosis.why,
                "fix": f.fix,
                "where": f.where,
            }
            for f in findings
        ],
        "observations": _finite(dataclasses.asdict(seen)),
    }


def _finite(value: Any) -> Any:
    """JSON has no infinity; no deadline is null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def print_report(
    console: Console,
    seen: Observations,
    findings: list[Finding],
    result: Verdict,
    states: list[Readiness],
) -> None:
    """Print the verdict, the findings with remedies, then the participants and topics found."""
    colour = "green" if result.healthy else "red"
    console.print(f"[bold {colour}]{escape(result.text)}[/]")
    for finding in findings:
        colour = _COLOUR[finding.severity]
        console.print(f"\n[{colour}]{finding.severity}[/] [bold]{finding.id}[/]")
        console.print(f"  seen: {escape(finding.seen)}", highlight=False)
        console.print(f"  why:  {escape(finding.diagnosis.why)}", highlight=False)
        console.print(f"  do:   [bold]{escape(finding.fix)}[/]", highlight=False)
    if seen.link is not None:
        console.print()
        for line in _link_text(seen.link).splitlines():
            console.print(escape(line), highlight=False)
    for state in states:
        does = "a client waits" if state.waiting else "a client would wait"
        text = "a client gets past its wait" if state.ready else f"{does}: {state.missing}"
        console.print(f"\ndomain {state.domain}, {state.name}: {escape(text)}", highlight=False)
    lines = _topic_lines(seen)
    if lines:
        console.print()
    for line in lines:
        # topics are compared letter for letter, so they are never cut, nor is a line folded
        console.print(escape(line, LONGEST), highlight=False, soft_wrap=True)
    looked = ", ".join(str(view.number) for view in seen.domains)
    if looked:
        console.print(f"\n[dim]looked at domains {looked} on {', '.join(seen.examined)}[/dim]")


def _link_text(link: Link) -> str:
    """The figures of a link in a few lines."""

    def ms(seconds: float) -> str:
        return f"{1000 * seconds:.1f} ms" if math.isfinite(seconds) else "unknown"

    multicast = {True: "works", False: "does not work", None: "unknown (no participant there)"}
    estimate = link.rtt_95 - link.rtt_min / 2
    command = link.command_age_95
    lines = [
        f"link to {link.host} ({link.address}) by {link.interface}, {link.method}:",
        f"  round trip     {ms(link.rtt_median)} median, {ms(link.rtt_min)} least, "
        f"{ms(link.rtt_95)} 95 %",
        f"  loss           {link.sent - link.received} of {link.sent} echoes, {link.lost} of "
        f"{link.samples + link.lost} samples",
        f"  age of states  {ms(link.state_age_95)} (95 %, on arrival here)",
        f"  of commands    {ms(command)} (95 %, on arrival here)"
        if math.isfinite(command)
        else f"  of commands    {ms(estimate)} (95 %, estimated from the round trips)",
        f"  multicast      {multicast[link.multicast]}",
        "  clock there    "
        + (f"{link.clock_offset:+.3f} s" if math.isfinite(link.clock_offset) else "unknown"),
        f"  receive buffer {link.rmem_max} bytes at most, {link.dropped} datagrams dropped",
    ]
    return "\n".join(lines)


def _topic_lines(seen: Observations) -> list[str]:
    """Each topic in one line, with the numbers of those who publish and read it; then those."""
    numbers: dict[tuple[int, str], int] = {}

    def who(view: DomainView, endpoints: list[Endpoint]) -> str:
        keys = dict.fromkeys((view.number, e.participant) for e in endpoints)
        found = [numbers.setdefault(key, len(numbers) + 1) for key in keys]
        return ",".join(map(str, sorted(found))) or "-"

    rows = [("dom", "topic", "type", "Hz", "who > who reads")]
    for view in seen.domains:
        topics: dict[tuple[str, str], list[Endpoint]] = {}
        for endpoint in view.endpoints:
            topics.setdefault((endpoint.topic, endpoint.type_name), []).append(endpoint)
        for (topic, type_name), ends in topics.items():
            writers, readers = ([e for e in ends if e.kind == k] for k in ("writer", "reader"))
            known = roles(split_prefix(topic)[1]) or topic in _BODY_TOPICS or topic in AWAITED
            told = f"{who(view, writers)} > {who(view, readers)}" + ("" if known else "  (unknown)")
            kind = short(type_name).replace("unitree_", "")
            rows.append((str(view.number), topic, kind, _rates(view, writers), told))
    most = [min(max(len(row[i]) for row in rows), widest) for i, widest in enumerate(_WIDEST)]
    lines = [
        "  ".join(c.ljust(n) for c, n in zip(row, (*most, 0), strict=True)).rstrip() for row in rows
    ]
    silent = [
        (view.number, p.key)
        for view in seen.domains
        for p in view.participants
        if (view.number, p.key) not in numbers
    ]
    for key in silent:
        numbers[key] = len(numbers) + 1
    names = {
        (view.number, p.key): p.name + ("" if (view.number, p.key) not in silent else _NO_TOPIC)
        for view in seen.domains
        for p in view.participants
    }
    for key, number in numbers.items():
        at = f" (domain {key[0]})" if len({domain for domain, _ in numbers}) > 1 else ""
        lines.append(f"{number:>3}  {names.get(key, 'an unknown process')}{at}")
    return lines if numbers else []


_WIDEST = (3, 25, 15, 5)
"""Widest columns of the topics, so that a line of usual ones fits into 80 characters."""
_NO_TOPIC = ", without a topic"


def _rates(view: DomainView, writers: list[Endpoint]) -> str:
    """How often each of the writers that were watched publishes."""
    streams = [s for e in writers if (s := view.stream(e)) is not None]
    return "+".join(f"{s.rate:.0f}" if s.samples else "0" for s in streams)

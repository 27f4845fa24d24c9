"""The doctor's report: on a terminal, and as data."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from rich.table import Column, Table

from dexkit.console import Console
from dexkit.console import markup as escape
from dexkit.doctor.awaited_topics import AWAITED
from dexkit.doctor.catalogue import Finding, Severity
from dexkit.doctor.observations import DomainView, Endpoint, Link, Observations
from dexkit.doctor.rules import Readiness, Verdict
from dexkit.doctor.topic_spelling import short
from dexkit.escaping import LONGEST
from dexkit.robots import ROBOTS
from dexkit.topics import roles

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
        text = "a client gets past its wait" if state.ready else f"a client waits: {state.missing}"
        console.print(f"\ndomain {state.domain}, {state.dialect}: {escape(text)}", highlight=False)
    # topics are compared letter for letter, so they are never cut: other columns give way
    table = Table(
        "domain",
        Column("topic", no_wrap=True),
        Column("type", overflow="fold"),
        Column("what", no_wrap=True),
        Column("Hz", no_wrap=True),
        Column("process", overflow="fold"),
        box=None,
        padding=(0, 2, 0, 0),
    )
    for view in seen.domains:
        for endpoint in view.endpoints:
            table.add_row(*(escape(cell, LONGEST) for cell in _row(view, endpoint)))
        if view.participants and not view.endpoints:
            for participant in view.participants:
                table.add_row(
                    str(view.number), "-", "-", "-", "", escape(participant.name, LONGEST)
                )
    if table.row_count:
        console.print()
        console.print(table)
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


def _row(view: DomainView, endpoint: Endpoint) -> tuple[str, ...]:
    stream = view.stream(endpoint)
    rate = f"{stream.rate:.0f}" if stream and stream.samples else ("0" if stream else "")
    known = roles(endpoint.topic) or endpoint.topic in _BODY_TOPICS or endpoint.topic in AWAITED
    mark = "" if known else " (not known)"
    kind = "publishes" if endpoint.kind == "writer" else "reads"
    return (
        str(view.number),
        endpoint.topic + mark,
        short(endpoint.type_name),
        kind,
        rate,
        view.owner(endpoint),
    )

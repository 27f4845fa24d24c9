"""``dexkit view``: hands on a page in the browser, live or from a recording."""

from __future__ import annotations

import contextlib
import os
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    FILE,
    dds_options,
    host_option,
    port_option,
    topic_option,
)
from dexkit.cli.remarks import remark
from dexkit.cli.status_line import StatusLine
from dexkit.errors import ConformanceError, TraceUnsupported, UsageError
from dexkit.escaping import REMARK, one_line
from dexkit.hand import ROBOT, JointSpec, Side
from dexkit.redaction import redact
from dexkit.stop_signals import stop_on_signals

if TYPE_CHECKING:
    from dexkit.kinematics import Skeleton
    from dexkit.traces import Trace
    from dexkit.view.sources import Source
    from dexkit.watch import Mark

__all__ = ["command", "recorded"]


@click.command(
    "view",
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C or SIGTERM",
        2: "wrong usage, an unusable recording, or a missing package",
    },
)
@click.argument("recordings", type=FILE, nargs=-1, metavar="[RECORDING]...")
@click.option(
    "--live", is_flag=True, help="Show the live domain beside a recording, as its baseline."
)
@topic_option("Listen to", "every topic of a known type, also those that appear later")
@dds_options(default_domain=None, domain_default_text="where hands are: 1, else 0")
@host_option(
    "Bind the page to this address. It has no password: anyone on the network could see it."
)
@port_option("TCP port of the page; 0 for any.  [default: the first free one from 8720]")
@click.option(
    "--allow-origin",
    "origins",
    multiple=True,
    metavar="ORIGIN",
    help="Also answer web pages of this origin, such as https://viewer.example:8443, and requests "
    "to its host; may be repeated.  [default: the page itself; Foxglove's with --foxglove]",
)
@click.option(
    "--open/--no-open",
    "open_browser",
    default=None,
    help="Open the page in a browser.  [default: where there is a display]",
)
@click.option(
    "--urdf",
    "urdfs",
    multiple=True,
    metavar="[SIDE=]FILE",
    help="Draw the hand of this side by a URDF of yours (boxes, cylinders and spheres; no "
    "meshes); SIDE is left, right or robot; may be repeated.",
)
@click.option(
    "--foxglove",
    is_flag=True,
    help="Show it in Foxglove instead of on dexkit's page: it connects to ws://127.0.0.1:8765 "
    "(--host, --port).",
)
@click.option(
    "--rerun",
    metavar="FILE.rrd|URL",
    help="Show it in Rerun instead: write this file, or send to a viewer that is running "
    "(rerun+http://127.0.0.1:9876/proxy).",
)
def command(
    recordings: tuple[Path, ...],
    live: bool,
    topics: tuple[str, ...],
    domain: int | None,
    interface: str,
    host: str,
    port: int | None,
    origins: tuple[str, ...],
    open_browser: bool | None,
    urdfs: tuple[str, ...],
    foxglove: bool,
    rerun: str | None,
) -> None:
    """Show hands and robots on a page in the browser: motion, faults and events.

    Without RECORDING it shows the live DDS domain; it only listens and publishes nothing. Without
    --domain that is where hands are: 1, that of simulations, or 0, the robot's. For a
    RECORDING there is a time line with the phases of a conformance run and the failed requirements;
    two recordings are shown side by side. Ctrl-C ends it.

    Needs the extra 'view': pip install 'dexkit[view]'. The page loads nothing from the network.
    --rerun and --foxglove need the extra of that name instead.
    """
    if len(recordings) + live > 2:
        raise UsageError("at most two recordings can be shown at once")
    if rerun is not None and foxglove:
        raise UsageError("--rerun and --foxglove exclude each other")
    if rerun is not None and origins:
        raise UsageError("--allow-origin is for what listens; --rerun does not")
    on_page = rerun is None and not foxglove
    from dexkit.view.forward import forward

    # names the extra before anything else is done
    if on_page:
        from dexkit.view.browser_page import Page
    elif rerun is not None:
        from dexkit.view.rerun_viewer import RerunViewer
    else:
        from dexkit.view.foxglove_viewer import DEFAULT_PORT, FoxgloveViewer

    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(stop_on_signals())
        sources: list[Source] = [recorded(path, on_page) for path in recordings]
        if live or not recordings:
            sources.insert(0, _live(stack, domain, interface, topics))
        skeletons = _skeletons(urdfs)
        what = " beside ".join(one_line(s.title) for s in sources)
        if on_page:
            page = stack.enter_context(
                Page(sources, host=host, port=port, origins=origins, skeletons=skeletons)
            )
            click.echo(f"ready: {page.url} shows {what}")
            _open(page.url, open_browser)
            page.run(stop.event)
        elif rerun is not None:
            status = stack.enter_context(contextlib.closing(_Written()))
            viewer = stack.enter_context(contextlib.closing(RerunViewer(rerun)))
            click.echo(f"ready: {what} to {redact(rerun, rerun)}")
            paced = "://" in rerun
            forward(
                sources, viewer, stop.event, skeletons=skeletons, paced=paced, progress=status.show
            )
        else:
            chosen = DEFAULT_PORT if port is None else port
            served = stack.enter_context(contextlib.closing(FoxgloveViewer(host, chosen, origins)))
            click.echo(f"ready: {served.url} shows {what}")
            while not stop.event.is_set():  # a recording begins again
                forward(sources, served, stop.event, skeletons=skeletons)
    click.echo("stopped")


class _Written:
    """Show the progress of writing a recording on the status line."""

    def __init__(self) -> None:
        self._line = StatusLine(quiet=False)

    def show(self, at: float, end: float) -> None:
        if self._line:
            self._line.show(f"{at:.1f} of {end:.1f} s")

    def close(self) -> None:
        self._line.clear()


def _open(url: str, wished: bool | None) -> None:
    """Open the page in a browser, if that is wished or there is a display."""
    if wished is None:
        wished = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if wished and not webbrowser.open(url):
        click.echo("warning: no browser could be opened", err=True)


def _live(
    stack: contextlib.ExitStack, domain: int | None, interface: str, topics: Sequence[str]
) -> Source:
    from dexkit.dds import DdsNode
    from dexkit.doctor.hand_domains import listening_domain
    from dexkit.traces.names import dds_topic
    from dexkit.view.sources import Live
    from dexkit.watch import Collector
    from dexkit.watch.listener import Listener

    chosen, why = listening_domain(domain, interface)
    if why:
        remark("note", why)
    node = stack.enter_context(DdsNode(domain=chosen, interface=interface))
    patterns = [dds_topic(t) for t in topics] or None
    listener = stack.enter_context(Listener(node, Collector(), patterns))
    return Live(f"domain {chosen} on {node.interface}", listener)


def recorded(path: Path, judge: bool) -> Source:
    """A recording as a source of the page, with its phases and failures if it can be judged."""
    from dexkit.traces import open_trace
    from dexkit.traces.watched import feed
    from dexkit.view.sources import Recorded

    trace = open_trace(path)
    for text in trace.warnings:
        click.echo(one_line(f"warning: {path}: {text}", REMARK), err=True)
    if not trace.message_count:
        raise UsageError(f"{path} holds no messages")
    return Recorded(path.name, feed(trace), _marks(trace, judge))


def _marks(trace: Trace, judge: bool) -> list[Mark]:
    """Phases and verdicts; a recording that cannot be judged is shown all the same."""
    from dexkit.conformance.kit.decoding import recording_of
    from dexkit.conformance.kit.judge import judge as verdict_on
    from dexkit.conformance.kit.recording_marks import phase_marks, verdict_marks
    from dexkit.conformance.kit.run_record import recorded_claims

    try:
        marks = phase_marks(trace)
        if judge:
            view = recording_of(trace, None, ())
            marks += verdict_marks(verdict_on(view, claims=recorded_claims(view.run)))
    except (ConformanceError, TraceUnsupported) as error:
        click.echo(one_line(f"warning: not judged: {error}", REMARK), err=True)
        return []
    return marks


def _skeletons(urdfs: Sequence[str]) -> dict[tuple[str, str], Skeleton]:
    """The skeletons of ``--urdf``, by model and subject.

    A file is for the hand or robot that has most of its joints.

    :raises UsageError: a file is no URDF, or none of a hand or robot that is known.
    """
    from dexkit.models import MODELS
    from dexkit.robots import ROBOTS
    from dexkit.urdf import read_urdf
    from dexkit.view.skeletons import skeleton_of

    known: dict[tuple[str, str], Sequence[JointSpec]] = {
        (m.name, str(side)): m.joints[side] for m in MODELS.values() for side in Side
    }
    known |= {(r.name, str(ROBOT)): [r.joint(i) for i in r.used] for r in ROBOTS.values()}
    found: dict[tuple[str, str], Skeleton] = {}
    for text in urdfs:
        prefix, equals, rest = text.partition("=")
        subjects = [str(s) for s in (*Side, ROBOT)]
        wanted, path = (prefix, Path(rest)) if equals and prefix in subjects else ("", Path(text))
        best: dict[tuple[str, str], Skeleton] = {}
        most, problem = 0, None
        for key, joints in known.items():
            if wanted not in ("", key[1]):
                continue
            owner = ROBOTS.get(key[0]) or MODELS[key[0]]
            side = Side(key[1]) if key[1] != ROBOT else None
            try:
                made = read_urdf(path, joints, skeleton_of(owner, side).mount)
            except UsageError as error:
                problem = error
                continue
            count = len({s.joint for s in made.segments if s.joint is not None})
            if count >= most:
                best = {**best, key: made} if count == most else {key: made}
                most = count
        if not best:
            assert problem is not None
            raise problem
        found |= best
    return found

"""``dexkit monitor``: hands and topics in the terminal, or as lines of JSON."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    Number,
    dds_options,
    duration_option,
    json_option,
    prefix_option,
    prefixed_topics,
    record_option,
    topic_option,
)
from dexkit.errors import DexkitError, UsageError
from dexkit.escaping import REMARK, one_line
from dexkit.other_interfaces import other_interface
from dexkit.stop_signals import StopRequest, stop_on_signals

if TYPE_CHECKING:
    from dexkit.dds import DdsNode
    from dexkit.doctor.hand_domains import HandsElsewhere
    from dexkit.traces import Recorder
    from dexkit.traces.dds_recording import DdsRecording
    from dexkit.watch import Picture
    from dexkit.watch.events import Event
    from dexkit.watch.listener import Listener

__all__ = ["command"]

_POLL = 0.1  # seconds between looks at what has come
_PERIODS = {"terminal": 0.2, "json": 1.0, "lines": 10.0}
_PAGE = 10  # lines


@click.command(
    "monitor",
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C, SIGTERM or --duration",
        1: "a recording is incomplete",
    },
)
@topic_option("Listen to", "every topic of a known type, also those that appear later")
@prefix_option("Only topics under rt/NAME/, as rt/r2/dex3/left/cmd for r2.")
@dds_options(default_domain=None, domain_default_text="where hands are: 1, else 0")
@json_option("Print a line of JSON each period instead (docs/monitor.md).")
@click.option(
    "--period",
    type=Number(min=0.05, max=3600),
    metavar="S",
    help="Seconds between updates.  [default: 0.2 on a terminal, 1 with --json, else 10]",
)
@record_option("File that the key r records to.  [default: monitor-DATE-TIME.mcap]")
@duration_option()
def command(
    topics: tuple[str, ...],
    prefix: str,
    domain: int | None,
    interface: str,
    as_json: bool,
    period: float | None,
    record_path: Path | None,
    duration: float | None,
) -> int:
    """Show hands, robots and topics in the terminal: joints, rates, ages, gaps, faults, events.

    Use it over ssh: it needs no display and no browser. It only listens, and publishes nothing.
    Without --domain it looks where hands are: on 1, that of simulations, or on 0, the robot's.
    Keys: q quits, space freezes the display, r starts and stops a recording (mcap), c clears the
    events, arrows and page keys scroll.

    Without a terminal it prints events as lines, and every ten seconds a line for each hand.
    """
    if record_path is not None and record_path.exists():
        raise UsageError(f"{record_path} exists", hint="choose another name for the recording")
    from dexkit.dds import DdsNode
    from dexkit.doctor.hand_domains import HandsElsewhere, listening_domain
    from dexkit.monitor.terminal import has_terminal
    from dexkit.traces.names import dds_topic
    from dexkit.watch import Collector
    from dexkit.watch.listener import Listener

    topics = prefixed_topics(topics, prefix)
    mode = "json" if as_json else "terminal" if has_terminal() else "lines"
    patterns = [dds_topic(t) for t in topics] or None
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(stop_on_signals())
        chosen, remark = listening_domain(domain, interface)
        node = stack.enter_context(DdsNode(domain=chosen, interface=interface))
        listener = stack.enter_context(Listener(node, Collector(), patterns))
        recording = stack.enter_context(_Log(record_path, chosen, node.interface, topics))
        elsewhere = HandsElsewhere(chosen, node.interface)
        watch = _Watch(listener, recording, period or _PERIODS[mode], duration, elsewhere)
        where = f"domain {chosen} on {node.interface}"
        if remark:
            watch.note(remark)
        if mode == "terminal":
            watch.draw(where, stop)
        else:
            watch.print(where, stop, as_json)
    for text in recording.told:
        click.echo(one_line(text, REMARK), err=True)
    return 1 if recording.incomplete else 0


class _Watch:
    """Polls the listener, and shows the collected state."""

    def __init__(
        self,
        listener: Listener,
        recording: _Log,
        period: float,
        duration: float | None,
        elsewhere: HandsElsewhere,
    ) -> None:
        from dexkit.watch.events import Events

        self._listener = listener
        self._recording = recording
        self._period = period
        self._end = None if duration is None else time.monotonic() + duration
        self._events = Events(listener.collector)
        self._elsewhere = elsewhere
        self._notes: list[Event] = []
        self._seen_unknown: set[str] = set()

    def _over(self, stop: StopRequest) -> bool:
        return bool(stop) or (self._end is not None and time.monotonic() >= self._end)

    def _picture(self) -> tuple[Picture, list[Event]]:
        self._listener.poll()
        collector = self._listener.collector
        picture = collector.picture(max(0.0, collector.seconds(time.time_ns())))
        if not picture.topics and (where := self._elsewhere.look()):
            self.note(where)
        for topic in sorted(self._listener.unknown.keys() - self._seen_unknown):
            self._seen_unknown.add(topic)
            if what := other_interface(topic):
                self.note(f"{topic}: {what}")
        notes, self._notes = self._notes, []
        return picture, notes + self._events.update(picture)

    def draw(self, where: str, stop: StopRequest) -> None:
        """Draw on the terminal until it is enough."""
        from dexkit.monitor.screen import Shown, screen
        from dexkit.monitor.terminal import Terminal

        paused, scroll, due = False, 0, 0.0
        picture, _ = self._picture()
        with Terminal() as terminal:
            while not self._over(stop):
                pressed = terminal.keys(_POLL)
                if not terminal.has_keyboard:
                    stop.wait(_POLL)
                for key in pressed:
                    if key == "q":
                        return
                    if key == " ":
                        paused = not paused
                    elif key == "r":
                        self.note(self._recording.toggle())
                    elif key == "c":
                        self._events.recent.clear()
                    elif key == "\x0c":  # Ctrl-L
                        terminal.redraw()
                    else:
                        scroll = max(0, scroll + _SCROLL.get(key, 0))
                now, _ = self._picture()
                if not paused:
                    picture = now
                if not pressed and time.monotonic() < due:
                    continue
                due = time.monotonic() + self._period
                shown = Shown(
                    where,
                    time.strftime("%H:%M:%S"),
                    self._recording.status,
                    paused,
                    scroll,
                    terminal.unicode,
                )
                size = terminal.size
                told = [(self._clock(event), event) for event in self._events.recent]
                terminal.show(screen(picture, told, shown, *size), size)

    def print(self, where: str, stop: StopRequest, as_json: bool) -> None:
        """Print lines until it is enough."""
        from dexkit.monitor.json_lines import json_line
        from dexkit.monitor.screen import summary

        if not as_json:
            click.echo(f"ready: {where}")
        new: list[Event] = []
        due = time.monotonic() + self._period
        while not self._over(stop):
            left = due - time.monotonic()
            stop.wait(max(0.0, min(_POLL, left)))
            picture, found = self._picture()
            if as_json:
                new += found
            else:
                for event in found:
                    click.echo(f"{self._clock(event)} {one_line(event.text, REMARK)}")
            if time.monotonic() < due:
                continue
            due += self._period
            if as_json:
                click.echo(json_line(picture, new, time.time_ns()))
                new = []
            else:
                for view in picture.subjects:
                    click.echo(f"{time.strftime('%H:%M:%S')} {summary(view)}")
            sys.stdout.flush()

    def note(self, text: str) -> None:
        """Show a remark among the events."""
        from dexkit.watch.events import Event

        event = Event(self._listener.collector.seconds(time.time_ns()), "info", text)
        self._events.recent.append(event)
        self._notes.append(event)

    def _clock(self, event: Event) -> str:
        moment = self._listener.collector.origin_ns / 1e9 + event.at
        return time.strftime("%H:%M:%S", time.localtime(moment or time.time()))


_SCROLL = {"up": -1, "k": -1, "down": 1, "j": 1, "page up": -_PAGE, "page down": _PAGE}


class _Log:
    """Recordings that a key begins and ends; a context manager.

    Each has readers of its own, so that nothing is missing while the screen is drawn.

    :ivar told: what is to be said of them at the end.
    :ivar incomplete: whether one lacks something.
    """

    def __init__(
        self, path: Path | None, domain: int, interface: str, topics: Sequence[str]
    ) -> None:
        self._path, self._domain, self._interface = path, domain, interface
        self._topics = list(topics) or None
        self._running: tuple[DdsNode, Recorder, DdsRecording] | None = None
        self._count = 0
        self.told: list[str] = []
        self.incomplete = False

    def __enter__(self) -> _Log:
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop()

    @property
    def status(self) -> str:
        """For the screen; empty while nothing is recorded."""
        if self._running is None:
            return ""
        recorder = self._running[1]
        lost = f", {recorder.dropped} dropped" if recorder.dropped else ""
        return f"REC {recorder.path} {recorder.written} messages{lost}"

    def toggle(self) -> str:
        """Begin or end a recording; returns the text for the status line."""
        return self._stop() if self._running is not None else self._start()

    def _start(self) -> str:
        from dexkit.dds import DdsNode
        from dexkit.traces import Recorder
        from dexkit.traces.dds_recording import DdsRecording

        with contextlib.ExitStack() as stack:
            try:
                recorder = Recorder(self._next_path(), keep_empty=False)
                node = stack.enter_context(DdsNode(domain=self._domain, interface=self._interface))
                stack.enter_context(recorder)
                recording = DdsRecording(node, recorder, self._topics)
                recording.start()
            except DexkitError as error:
                return f"not recorded: {error.message}"
            stack.pop_all()
        self._running = (node, recorder, recording)
        return f"recording to {recorder.path}"

    def _stop(self) -> str:
        if self._running is None:
            return ""
        (node, recorder, recording), self._running = self._running, None
        try:
            recording.stop()
            recorder.close()
        except DexkitError as error:
            text = f"recording failed: {error.message}"
            self.incomplete = True
        else:
            lacks = "; ".join((*recording.losses.describe(), *filter(None, [recorder.displaced])))
            self.incomplete |= bool(lacks or recorder.dropped)
            text = f"{recorder.path}: {recorder.written} messages, {recorder.dropped} dropped"
            text += f"; {lacks}" if lacks else ""
            if not recorder.written:
                text = f"nothing came, so there is no {recorder.path}"
        finally:
            node.close()
        self.told.append(text)
        return text

    def _next_path(self) -> Path:
        self._count += 1
        if self._path is None:
            return Path(time.strftime("monitor-%Y%m%d-%H%M%S.mcap"))
        if self._count == 1:
            return self._path
        return self._path.with_name(f"{self._path.stem}-{self._count}{self._path.suffix}")

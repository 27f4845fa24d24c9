"""``dexkit publish``: publish the payloads of a recording as they are, with their timing."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dexkit.cli.command_help import Command
from dexkit.cli.consent import Consent
from dexkit.cli.options import (
    FILE,
    dds_options,
    force_option,
    loop_option,
    pace_option,
    topic_option,
    wait_option,
)
from dexkit.cli.stop_keys import keys
from dexkit.clock import RealClock
from dexkit.command_age import PauseWatch
from dexkit.errors import DdsError, TraceUnsupported
from dexkit.escaping import REMARK, one_line
from dexkit.interpreter import timely_threads
from dexkit.single_publisher import NodeTopics, SolePublisher
from dexkit.stop_signals import StopRequest, stop_on_signals
from dexkit.threads import Worker

if TYPE_CHECKING:
    from dexkit.dds import DdsNode, Writer
    from dexkit.traces import Player, Trace, TraceMessage

__all__ = ["command"]

# Seconds from a match seen here to the first message, for the other side to see it too: what comes
# before is lost to it. Unitree's SDK sleeps as long after making a writer
# (docs/sources/unitree-dex.md#a6).
_SETTLE = 0.2
# Seconds for the other side's readers after the last message, before the writers vanish.
_LINGER = 0.1


@click.command(
    "publish",
    cls=Command,
    exit_codes={
        0: "published, or a loop was stopped",
        1: "the recording is damaged, suspended without a terminal, or the topics are not free",
        2: "it cannot be read or published",
        130: "stopped",
    },
)
@click.argument("file", type=FILE, metavar="IN.mcap")
@topic_option("Publish", "those that end in /cmd")
@pace_option()
@loop_option()
@dds_options()
@wait_option("Wait up to S seconds for a subscriber of each topic; 0 starts at once.")
@force_option()
def command(
    file: Path,
    topics: tuple[str, ...],
    pace: float,
    loop: bool,
    domain: int,
    interface: str,
    wait: float,
    force: bool,
) -> int:
    """Publish the messages of a recording as they are, with their timing.

    Nothing is checked, there is no ramp and no supervision: 'dexkit replay' plays a session on a
    hand with care. The default domain is 1, the simulation's.

    If this program was suspended for more than a second, it asks before it goes on; without a
    terminal it ends.
    """
    from dexkit.dds import DdsNode
    from dexkit.traces import Player, open_trace

    trace = open_trace(file)
    try:
        player = Player(trace, topics or None, speed=pace, loop=loop)
    finally:  # more may be found while the messages are read
        for warning in trace.warnings:
            click.echo(one_line(f"warning: {warning}", REMARK), err=True)
    _check_types(trace, player)
    click.echo(
        f"{file}: {len(player)} messages of {', '.join(map(one_line, player.topics))}, "
        f"{player.duration:.1f} s" + (", looped" if loop else "")
    )
    with (
        stop_on_signals() as stop,
        DdsNode(domain=domain, interface=interface) as node,
        keys() as pressed,
    ):
        consent = Consent(pressed, stop)
        # a hand must have one source of commands: a recording gives way to any other
        sole = SolePublisher(
            [NodeTopics(node, player.topics)],
            hint="stop that publisher, choose another --domain, or play anyway with --force",
            force=force,
            yields=True,
        )
        sole.search()
        claim = sole.announce()
        writers = {
            topic: node.writer(topic, name, user_data=claim)
            for topic, name in player.topics.items()
        }
        sole.settle()
        if wait:
            _wait_for_readers(node, writers, wait, stop, consent)
            stop.wait(_SETTLE)
        if stop:
            return consent.explain() or 130
        click.echo(f"ready: playing on domain {domain}, {interface}")
        with timely_threads(), _status(player):

            def send(message: TraceMessage) -> object:
                # stamped first: a command that a stop holds back here is old, and is seen to be
                now_ns = time.time_ns()
                sole.poll()
                return writers[message.topic].write_raw(message.data, now_ns)

            def paused(seconds: float) -> None:
                if not consent(seconds):
                    stop.set()
                    return
                click.echo(
                    f"this program was paused for {seconds:.2f} s; the recording goes on where it "
                    "was left",
                    err=True,
                )
                stop.wait(_SETTLE)  # publishers that started meanwhile are discovered first

            stats = player.play(send, stop=stop.event, paused=paused)
        time.sleep(_LINGER)
    click.echo(
        f"sent {stats.sent} messages in {stats.duration:.1f} s"
        + (f", {stats.passes} passes" if loop else "")
        + f"; late by {stats.error_p50 * 1e3:.3f} ms (p50), {stats.error_p99 * 1e3:.3f} ms (p99), "
        f"{stats.error_max * 1e3:.3f} ms (max)"
        + (f"; paused {stats.pauses} times" if stats.pauses else "")
    )
    if consent.missing:
        return consent.explain()
    # for a loop, being stopped is the ordinary end
    if stats.stopped and not loop:
        return 130
    return 1 if trace.damage else 0


def _check_types(trace: Trace, player: Player) -> None:
    for channel in trace.channels:
        chosen = player.topics.get(channel.topic) == channel.type_name
        if chosen and channel.problem and channel.message_count:
            raise TraceUnsupported(
                f"{channel.topic} cannot be played: {channel.problem}",
                hint="choose other topics with --topic",
            )


def _wait_for_readers(
    node: DdsNode,
    writers: dict[str, Writer],
    patience: float,
    stop: StopRequest,
    consent: Consent,
) -> None:
    """Return when each topic is subscribed, or the user gives up.

    :raises DdsError: a topic is still not subscribed after ``patience`` seconds.
    """
    end = time.monotonic() + patience
    watch = PauseWatch(RealClock())
    missing = [t for t, w in writers.items() if not w.matched]
    if missing:
        names = ", ".join(map(one_line, missing))
        click.echo(f"waiting for a subscriber of {names} ...", err=True)
    while missing and not stop and time.monotonic() < end:
        if (away := watch.measure_pause()) and not consent(away):
            stop.set()
            return
        watch.restart()
        writers[missing[0]].wait_matched(timeout=0.1)
        missing = [t for t, w in writers.items() if not w.matched]
    if missing and not stop:
        from dexkit.doctor.hand_domains import elsewhere_hint

        raise DdsError(
            f"no process subscribes to {', '.join(missing)} on domain {node.domain}, "
            f"{node.interface} (waited {patience:g} s)",
            hint=elsewhere_hint(node)
            or "start the hand first ('dexkit serve'), check --domain and --interface, or publish "
            "anyway with --wait 0",
        )


@contextmanager
def _status(player: Player) -> Iterator[None]:
    """Show the progress in one line, on a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    done = threading.Event()

    def show() -> None:
        while not done.wait(0.5):
            passes, within = divmod(player.sent, len(player))
            part = f"{100 * within / len(player):3.0f} %"
            text = f"{part}  {player.sent:,} messages" + (f"  pass {passes + 1}" if passes else "")
            click.echo(f"\r\033[K{text}", nl=False, err=True)

    thread = Worker("status", show)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        click.echo("\r\033[K", nl=False, err=True)

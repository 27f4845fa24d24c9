"""``dexkit replay``: play a session on hands, checked and supervised."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import dds_options, force_option, loop_option, wait_option
from dexkit.cli.replay_session import checked_session, guards, print_refusal, session_to_play
from dexkit.cli.settings import Settings
from dexkit.errors import DdsError
from dexkit.escaping import REMARK, one_line

if TYPE_CHECKING:
    from dexkit.cli.consent import Consent
    from dexkit.traces.replay.live import LiveReplay
    from dexkit.traces.replay.machine import Guards, ReplayMachine
    from dexkit.traces.replay.prepare import Prepared

__all__ = ["command"]


@click.command(
    "replay",
    cls=Command,
    exit_codes={
        0: "played, or a loop was stopped",
        1: "refused, stopped by the supervision, suspended without a terminal, damaged, or the "
        "hand is not free",
        2: "it cannot be read",
        130: "stopped",
    },
)
@session_to_play()
@loop_option()
@dds_options()
@wait_option("Wait up to S seconds for the hands.")
@force_option()
def command(
    source: Path,
    settings: Settings,
    loop: bool,
    domain: int,
    interface: str,
    wait: float,
    force: bool,
    **given: Any,
) -> int:
    """Replay a session on hands, checked and supervised.

    SOURCE is a recording, or a session of any format that 'dexkit import' reads. It is checked
    first; findings are printed, and the session is refused unless a setting cures them. The hands
    move slowly from their present pose to the first one, then the session is played. The hands are
    brought to rest at its end, on a fault, without states, too far from the commands, and on
    Ctrl-C, space or q. 'dexkit rehearse' shows all of that without a hand; 'dexkit publish'
    publishes a recording as it is.

    The default domain is 1, the simulation's: --domain 0 with a robot's interface moves real hands.

    If this program was suspended for more than a second, it asks before it moves the hands on;
    without a terminal it ends.
    """
    session, prepared = checked_session(source, settings=settings, **given)
    if prepared.refused:
        print_refusal(prepared)
        return 1
    play = _play(
        prepared,
        guards(settings, loop=loop),
        domain=domain,
        interface=interface,
        wait=wait,
        force=force,
    )
    return play or (1 if session.damage else 0)


def _play(
    prepared: Prepared, guards: Guards, *, domain: int, interface: str, wait: float, force: bool
) -> int:
    from dexkit.cli.consent import Consent
    from dexkit.cli.stop_keys import is_stop, keys
    from dexkit.dds import DdsNode
    from dexkit.interpreter import timely_threads
    from dexkit.stop_signals import stop_on_signals
    from dexkit.traces.replay.live import LiveReplay
    from dexkit.traces.replay.machine import End, ReplayMachine

    assert prepared.plan is not None
    machine = ReplayMachine(prepared.plan, guards)
    with (
        stop_on_signals() as stop,
        DdsNode(domain=domain, interface=interface) as node,
        keys() as pressed,
    ):
        consent = Consent(pressed, stop)
        live = LiveReplay(node, machine, force=force, resume=consent)
        waiting = _Waiting(live, wait)
        if not live.wait_ready(stop.event, waiting):
            return consent.explain() or 130
        click.echo(f"ready: playing on domain {domain}, {interface}; space, q or Ctrl-C stops")
        with timely_threads(), _status() as show:

            def turn(machine: ReplayMachine) -> None:
                show(machine)
                if stop or is_stop(pressed()):
                    machine.stop(End.ASKED, "stopped")

            live.play(turn)
    return _print_end(machine, consent)


def _print_end(machine: ReplayMachine, consent: Consent) -> int:
    from dexkit.traces.replay.machine import End

    done = machine.progress
    text = f"played {machine.at:.1f} s, sent {done.sent} commands"
    if machine.guards.loop:
        text += f", {done.passes} passes"
    for side, (away, joint, at) in done.farthest.items():
        name = machine.names(side)[joint]
        unit = machine.unit(side)
        text += f"; {side} at most {away:.2f} {unit} from its command ({name}, {at:.1f} s)"
    if done.held > 0.1:
        text += f"; held for {done.held:.1f} s by this machine"
    if done.pauses:
        text += f"; paused {done.pauses} times"
    click.echo(one_line(text, REMARK))
    if machine.end is End.DONE:
        return 0
    if machine.end is End.ASKED:
        return 0 if machine.guards.loop else 130
    if machine.end is End.SUSPENDED:
        return consent.explain()
    click.echo(one_line(f"stopped: {machine.reason}", REMARK), err=True)
    return 1


class _Waiting:
    """Prints the missing hands while the command waits for them, and ends the wait."""

    def __init__(self, live: LiveReplay, patience: float) -> None:
        self._live, self._patience = live, patience
        self._told = False

    def __call__(self, seconds: float) -> None:
        """Still waiting.

        :raises DdsError: for longer than the user wants to.
        """
        from dexkit.doctor.hand_domains import elsewhere_hint

        live = self._live
        node, missing = live.node, live.machine.missing
        if live.unsubscribed:
            topics = ", ".join(map(one_line, live.unsubscribed))
            waits, lacks = f"a subscriber of {topics}", f"no process subscribes to {topics}"
        else:
            sides = " and ".join(map(str, missing))
            waits = f"state of the {sides} hand"
            lacks = f"no usable state of the {sides} hand"
        if seconds >= self._patience:
            raise DdsError(
                f"{lacks} on domain {node.domain}, {node.interface} (waited {self._patience:g} s)",
                hint=elsewhere_hint(node) or live.advice(),
            )
        if not self._told and seconds > 0.2:
            self._told = True
            click.echo(f"waiting for {waits} ...", err=True)


@contextmanager
def _status() -> Iterator[Any]:
    """Show the progress in one line, on a terminal."""
    if not sys.stderr.isatty():
        yield lambda machine: None
        return
    shown = 0.0

    def show(machine: ReplayMachine) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - shown >= 0.5:
            shown = now
            text = f"{machine.phase}  {machine.at:.1f} of {machine.plan.duration:.1f} s"
            click.echo(f"\r\033[K{text}", nl=False, err=True)

    try:
        yield show
    finally:
        click.echo("\r\033[K", nl=False, err=True)

"""``dexkit bridge``: translate between Dex1 dialects."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    DOMAIN,
    dds_options,
    force_option,
    found_interface,
    side_option,
)
from dexkit.cli.status_line import MOST_REMARKS, log_to_stderr
from dexkit.errors import DexkitError, TopicConflict
from dexkit.hand import Side
from dexkit.models import DEX1_1, dialect
from dexkit.service import prepare_process
from dexkit.service import real_time as real_time_priority
from dexkit.stop_signals import StopRequest, stop_on_signals

if TYPE_CHECKING:
    from dexkit.bridge import Bridge

__all__ = ["command"]

_log = logging.getLogger("dexkit.bridge")

_STATUS_PERIOD = 0.5  # seconds
_LONELY = 5.0  # seconds without a peer before a hint
_DIALECTS = click.Choice([d.name for d in DEX1_1.dialects])


@click.command(
    "bridge",
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C or SIGTERM",
        1: "it failed while it ran, or another program publishes the same topics",
    },
)
@click.argument("client", type=_DIALECTS, metavar="CLIENT")
@click.argument("gripper", type=_DIALECTS, metavar="GRIPPER")
@side_option("Grippers to translate for.", default="both")
@dds_options()
@click.option(
    "--to-domain",
    type=DOMAIN,
    help="DDS domain of the gripper.  [default: that of the client]",
)
@click.option(
    "--to-interface",
    metavar="IF",
    help="Network interface of the gripper.  [default: that of the client]",
)
@force_option()
def command(
    client: str,
    gripper: str,
    sides: tuple[Side, ...],
    domain: int,
    interface: str,
    to_domain: int | None,
    to_interface: str | None,
    force: bool,
) -> int:
    """Translate between Dex1 dialects: commands from a client to a Dex1-1, and states back.

    CLIENT and GRIPPER are the dialects of the two sides.

    \b
    client xr_teleoperate v1.1 (--sim), gripper with today's service:
      dexkit bridge unitree_actuator unitree_go
    today's client on domain 1, gripper of the DDS specification on the robot:
      dexkit bridge unitree_go unitree_hg --to-domain 0 --to-interface eth0

    Prints "ready: ..." when the topics are up. No message is repeated: when the client stops, the
    gripper gets no commands and brakes (docs/bridge.md).
    """  # noqa: D301 - click wants the character, not a backslash
    from dexkit.bridge import Bridge, BridgeEnd
    from dexkit.dds import DdsNode

    status = sys.stderr.isatty()
    log_to_stderr(False, status, "dexkit.bridge.counters")
    far_domain = domain if to_domain is None else to_domain
    far_interface = interface
    if to_interface is not None:
        far_interface = found_interface(click.get_current_context(), to_interface)
    with (
        # before any thread is started: they inherit it
        real_time_priority(),
        stop_on_signals() as stop,
        ExitStack() as nodes,
    ):
        near = nodes.enter_context(DdsNode(domain=domain, interface=interface))
        far = near
        if (far_domain, far_interface) != (domain, interface):
            far = nodes.enter_context(DdsNode(domain=far_domain, interface=far_interface))
        bridge = Bridge(
            BridgeEnd(near, dialect(client)),
            BridgeEnd(far, dialect(gripper)),
            sides=sides,
            force=force,
        )
        prepare_process()
        with bridge:
            click.echo(
                f"ready: {bridge.client} -> {bridge.gripper}, "
                f"{' and '.join(map(str, bridge.sides))}"
            )
            sys.stdout.flush()
            trouble = _watch(bridge, stop, status, force)
        bridge.log_counters()
    if isinstance(bridge.failure, TopicConflict):
        raise bridge.failure
    if bridge.failure is not None:
        raise DexkitError(f"the bridge failed: {bridge.failure}")
    if trouble:
        raise TopicConflict(trouble, hint=Bridge.CONFLICT_HINT)
    return 0


def _watch(bridge: Bridge, stop: StopRequest, status: bool, force: bool) -> str | None:
    """Print a status line and hints, until asked to stop.

    :returns: the program that started and made the bridge a loop; then the bridge ends, too.
    """
    started = time.monotonic()
    logged: set[str] = set()
    rates = _rates(bridge)
    while not stop.wait(_STATUS_PERIOD):
        if bridge.failure is not None:
            break
        if not force and (found := bridge.reverse_bridge()):
            return found
        for text in _hints(bridge, time.monotonic() - started):
            if text not in logged and len(logged) < MOST_REMARKS:
                logged.add(text)
                _log.warning("%s", text)
        line = next(rates)
        if status:
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
    if status:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    return None


def _hints(bridge: Bridge, elapsed: float) -> Iterator[str]:
    commands, states = bridge.commands, bridge.states
    for direction, who in ((commands, "client"), (states, "gripper")):
        counts, topics = direction.counts, " and ".join(direction.inputs)
        for count, what in (
            (counts.undecodable, "undecodable messages"),
            (counts.rejected, "NaN or infinity"),
            (counts.short, "messages with too few motors"),
        ):
            if count:
                yield f"{topics}: the {who} sends {what}; not forwarded (counted, logged once)"
    for side in states.silent(time.monotonic()):
        yield f"the state of the {side} gripper has stopped"
    if elapsed < _LONELY:
        return
    missing = states.missing()
    if missing:
        names = " and ".join(map(str, missing))
        yield (
            f"no state of the {names} gripper yet on {' and '.join(states.inputs)}, "
            f"{bridge.gripper}"
            + (
                "; its place in the message is all 0, as where there is no gripper"
                if states.counts.blank
                else "; with one gripper only, give --side; 'dexkit doctor' checks the domain"
            )
        )
    if not bridge.clients and not commands.counts.received:
        yield f"no client yet on {bridge.client}"


def _rates(bridge: Bridge) -> Iterator[str]:
    """Format the rates for the status line."""
    directions = {"cmd": bridge.commands, "state": bridge.states}
    before: dict[tuple[str, Side], int] = {}
    last = time.monotonic()
    while True:
        now = time.monotonic()
        pieces = []
        for side in bridge.sides:
            texts = []
            for name, direction in directions.items():
                count = direction.parts[side]
                rate = (count - before.get((name, side), 0)) / max(now - last, 1e-3)
                before[name, side] = count
                texts.append(f"{name} {rate:.0f}/s")
            pieces.append(f"{side} {' '.join(texts)}")
        last = now
        yield f"{', '.join(pieces)}; clients {bridge.clients}, grippers {bridge.grippers}"

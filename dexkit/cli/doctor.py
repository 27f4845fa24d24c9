"""``dexkit doctor``: find out why a client and a hand do not connect."""

from __future__ import annotations

import json
import re
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    Number,
    devices_option,
    dialect_option,
    domain_option,
    found_interface,
    interfaces_option,
    json_option,
)
from dexkit.errors import UsageError
from dexkit.models import DIALECTS
from dexkit.open_file_limit import require_open_files
from dexkit.stop_signals import StopRequest, stop_on_signals

if TYPE_CHECKING:
    from dexkit.doctor import Finding, Observations, Readiness, Verdict
    from dexkit.doctor.observations import DomainView, Environment, Link

__all__ = ["command"]

_REFRESH = 1.0  # seconds between looks
_FILES = 16  # descriptors beside one a domain and interface


def _scan(ctx: click.Context, parameter: click.Parameter, text: str) -> list[int]:
    """``0-10``, ``0,1,5-7`` or ``none``."""
    if text == "none":
        return []
    found: list[int] = []
    for part in text.split(","):
        low, dash, high = part.partition("-")
        # int() knows fewer digits than isdigit()
        if not all(re.fullmatch("[0-9]{1,3}", end) for end in (low, *([high] if dash else []))):
            raise click.BadParameter("write 0-10, or 0,1,5-7, or none")
        first, last = int(low), int(high if dash else low)
        if not 0 <= first <= last <= 230:
            raise click.BadParameter("domains are 0 to 230")
        found += range(first, last + 1)
    return found


@click.command(
    "doctor",
    cls=Command,
    exit_codes={
        0: "healthy; Ctrl-C ends --watch with the code of the last complete examination",
        1: "problems found",
        2: "the examination failed",
    },
)
@domain_option(
    "Domain of the client: 0 is the robot, 1 xr_teleoperate's simulation.  [default: any]"
)
@click.option(
    "--scan",
    default="0-10",
    show_default=True,
    callback=_scan,
    metavar="RANGE",
    help="Also examine these domains; none for no others.",
)
@interfaces_option(
    "Examine this network interface (name, address or prefix) as well as lo; may be repeated."
)
@click.option(
    "--ping",
    metavar="HOST",
    help="Also measure the link to this machine: latency, loss, jitter, multicast, clock.",
)
@dialect_option("Only this dialect.  [default: any]")
@devices_option("Also examine a serial port and ask for servos on it, 'usb', or usbip://HOST:PORT.")
@json_option("Print JSON (docs/doctor.md).")
@click.option("--watch", is_flag=True, help="Repeat the examination until Ctrl-C.")
@click.option(
    "--seconds",
    type=Number(0.2, 600),
    default=2.0,
    show_default=True,
    help="Seconds of observation.",
)
def command(
    domain: int | None,
    scan: list[int],
    interfaces: tuple[str, ...],
    ping: str | None,
    dialect: str | None,
    devices: tuple[str, ...],
    as_json: bool,
    watch: bool,
    seconds: float,
) -> int:
    """Find out why a client and a hand do not connect, and what to do.

    Use it when a client hangs at "Waiting to subscribe dds...". It observes DDS domains without
    publishing any topic and without CycloneDDS, checks this Python environment, and checks the
    device if one is named. Traffic stays on this machine unless --interface names a network. On a
    named serial port only ids and models of servos are read.
    """
    from dexkit.doctor import Scope, diagnose, readiness, verdict
    from dexkit.doctor.environment import environment
    from dexkit.interface_names import interface_towards, named_peers, resolve_peers

    if domain is None and not scan:
        raise UsageError("no domain to examine", hint="give --domain or --scan")
    dialects = () if dialect is None else (DIALECTS[dialect],)
    scope = Scope(domain, dialects, bool(devices) and domain is None)
    ctx = click.get_current_context()
    peers = named_peers()
    target = None
    if ping is not None:
        (address,) = resolve_peers([ping])
        target = (ping, address, interface_towards(address))
        interfaces = tuple(dict.fromkeys((*interfaces, target[2])))
    interfaces = tuple(dict.fromkeys(found_interface(ctx, text) for text in interfaces))
    if peers and not interfaces:
        interfaces = tuple(dict.fromkeys(interface_towards(peer) for peer in peers))
    windows = len({*scan, *([] if domain is None else [domain])}) * len({"lo", *interfaces})
    require_open_files(windows + _FILES, f"examining {windows} domain(s)")
    with stop_on_signals() as stop, ThreadPoolExecutor(1) as beside:
        env = beside.submit(environment)  # it starts processes, which takes a second
        last: int | None = None
        before = ""
        while True:
            seen = _observe(
                sorted({*scan, *([] if domain is None else [domain])}),
                tuple(dict.fromkeys(("lo", *interfaces))),
                peers,
                devices,
                seconds,
                env.result,
                stop,
                target,
                _progress(quiet=as_json or last is not None),
            )
            if stop:
                return 130 if last is None else last
            findings = diagnose(seen, scope)
            states = readiness(seen, scope)
            result = verdict(seen, findings, scope)
            if as_json:
                from dexkit.doctor.report import as_data

                click.echo(
                    json.dumps(as_data(seen, findings, result, states), indent=None if watch else 2)
                )
                sys.stdout.flush()
            else:
                key = json.dumps([[f.id, f.where] for f in findings] + [str(s) for s in states])
                if key != before:
                    _print(seen, findings, result, states, watch=watch, first=last is None)
                before = key
            last = 0 if result.healthy else 1
            if not watch:
                return last
            stop.wait(_REFRESH)


def _observe(
    domains: list[int],
    interfaces: tuple[str, ...],
    peers: tuple[str, ...],
    devices: tuple[str, ...],
    seconds: float,
    env: Callable[[], Environment],
    stop: StopRequest,
    target: tuple[str, str, str] | None,
    progress: Callable[[str], object],
) -> Observations:
    from dexkit.cli import doctor_devices
    from dexkit.doctor import Observations, dds, network, usb

    known = network.interfaces()
    ports = [] if devices else doctor_devices.ports()
    hands = list(usb.devices())
    for device in devices:
        if device == "usb":
            pass  # looked at in any case; that none is there is a finding if it was asked for
        elif device.startswith("usbip:"):
            hands += doctor_devices.on_server(device)
        else:
            ports.append(doctor_devices.inspect_port(device, progress=progress))
    link = None
    if target is None:
        views = dds.observe_domains(
            domains, interfaces, seconds=seconds, peers=peers, stop=stop.event, progress=progress
        )
    else:
        views, link = _measure_link(
            target, domains, interfaces, peers, seconds, stop.event, progress
        )
    progress("")
    return Observations(
        domains=views,
        examined=interfaces,
        seconds=seconds,
        interfaces=known,
        sockets=network.dds_sockets(domains),
        environment=env(),
        serial=tuple(ports),
        usb=tuple(hands),
        usb_wanted="usb" in devices,
        link=link,
    )


def _measure_link(
    target: tuple[str, str, str],
    domains: list[int],
    interfaces: tuple[str, ...],
    peers: tuple[str, ...],
    seconds: float,
    stop: threading.Event,
    progress: Callable[[str], object],
) -> tuple[tuple[DomainView, ...], Link]:
    """Observe the domains by multicast, then by unicast too while echoes are sent."""
    from dexkit.doctor import dds
    from dexkit.doctor.link import link_to, measure_round_trips
    from dexkit.doctor.network import address_of
    from dexkit.socket_losses import receive_buffer_errors

    host, address, interface = target
    progress(f"measuring the link to {host}")
    before = receive_buffer_errors()
    plain = dds.observe_domains(domains, (interface,), seconds=0.0, stop=stop)
    with ThreadPoolExecutor(1) as beside:
        echoes = beside.submit(measure_round_trips, address, address_of(interface), seconds, stop)
        views = dds.observe_domains(
            *(domains, interfaces), seconds=seconds, peers=(*peers, address), stop=stop
        )
        trips = echoes.result()
    dropped = receive_buffer_errors() - before
    return views, link_to(host, address, interface, trips, plain, views, dropped=dropped)


def _progress(*, quiet: bool) -> Callable[[str], object]:
    if quiet or not sys.stderr.isatty():
        return lambda text: None
    return lambda text: click.echo(f"\r\x1b[K{text}", err=True, nl=False)


def _print(
    seen: Observations,
    findings: list[Finding],
    result: Verdict,
    states: list[Readiness],
    *,
    watch: bool,
    first: bool,
) -> None:
    from dexkit.console import Console
    from dexkit.doctor.report import print_report

    console = Console(soft_wrap=True)
    if watch:
        if not first:
            console.print()
        ready = any(s.ready for s in states)
        console.rule(time.strftime("%H:%M:%S") + (": a client would now start" if ready else ""))
    print_report(console, seen, findings, result, states)
    sys.stdout.flush()

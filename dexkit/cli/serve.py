"""``dexkit serve``: publish and subscribe Unitree's topics for a hand."""

from __future__ import annotations

import logging
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from types import FrameType

import click

from dexkit.backends import BackendOptions, backend
from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    Number,
    dds_options,
    devices_by_side,
    devices_option,
    dialect_option,
    force_option,
    prefix_option,
    quiet_option,
    real_time_option,
    side_option,
    view_option,
    wait_for_interface_option,
)
from dexkit.cli.settings import key_and_value, set_option
from dexkit.cli.status_line import MOST_REMARKS, StatusLine, log_to_stderr
from dexkit.errors import DexkitError, TopicConflict, UsageError
from dexkit.hand import Hand, Side
from dexkit.models import MODELS, Dialect
from dexkit.models import dialect as dialect_by_name
from dexkit.models import model as model_by_name
from dexkit.sd_notify import notify, watchdog
from dexkit.service import Estimation, Fill, HandService, Publisher, diagnose, prepare_process
from dexkit.service import real_time as real_time_priority
from dexkit.stop_signals import StopRequest, stop_on_signals

__all__ = ["command"]

log = logging.getLogger("dexkit.serve")

_STATUS_PERIOD = 0.5  # seconds
_PHASE = 0.15  # of a period: publishing has ended, exchanges may begin
_LONELY = 10.0  # seconds without a client before a hint


@click.command(
    "serve",
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C or SIGTERM",
        1: "it failed while it ran, or another program publishes the same topics",
    },
)
@click.argument("backend_name", metavar="BACKEND")
@side_option("Hand to serve; both needs a device for each.", required=True)
@devices_option("Path or serial number of the device; with --side both left=PATH and right=PATH.")
@set_option(
    "Setting of the backend, e.g. object=40; left.object=40 is for one hand. 'dexkit backends' "
    "lists the settings."
)
@dialect_option(
    "Topics, types and units.  [default: the model's first: "
    + ", ".join(f"{m.dialects[0].name} ({m.name})" for m in MODELS.values())
    + "]",
)
@prefix_option("Serve on rt/NAME/..., for one of several robots: rt/r2/dex3/left/cmd for r2.")
@dds_options(default_domain=None, domain_default_text="0 for a device, else 1")
@wait_for_interface_option("Wait up to S seconds for a network interface that is not up yet.")
@click.option(
    "--state-rate",
    type=Number(1, 1000),
    metavar="HZ",
    help="States published per second.  [default: the model's, "
    + ", ".join(f"{m.state_rate:g} ({m.name})" for m in MODELS.values())
    + "]",
)
@click.option(
    "--estimator",
    type=click.Choice([e.value for e in Estimation]),
    default=Estimation.AUTO.value,
    show_default=True,
    help="Predict positions between measurements: auto does below 200 measurements a second.",
)
@click.option(
    "--stall-tau",
    type=Number(0, 100),
    default=0.0,
    metavar="NM",
    help="Least tau_est of a joint whose prediction has stopped at an object; for hands that "
    "measure no current.  [default: as measured]",
)
@click.option(
    "--fill",
    type=click.Choice([f.value for f in Fill]),
    default=Fill.KNOWN.value,
    show_default=True,
    help="Fields of a state: all that is known, or only those the vendor's service fills.",
)
@click.option(
    "--wait-for-device", is_flag=True, help="Wait for a device that is not connected yet."
)
@force_option()
@real_time_option()
@view_option()
@quiet_option()
def command(
    backend_name: str,
    sides: tuple[Side, ...],
    devices: tuple[str, ...],
    settings: tuple[str, ...],
    dialect: str | None,
    prefix: str,
    domain: int | None,
    interface: str,
    wait_for_interface: float,
    state_rate: float | None,
    estimator: str,
    stall_tau: float,
    fill: str,
    wait_for_device: bool,
    force: bool,
    real_time: bool,
    view: bool,
    quiet: bool,
) -> int:
    """Serve a hand on Unitree's topics until Ctrl-C or SIGTERM.

    BACKEND is a name from 'dexkit backends' or package.module:Class. Prints "ready: ..." when
    the topics are up. SIGUSR1 logs the counters.

    Without --domain, a device is served on domain 0 (the robot's) and everything else on
    domain 1 (that of xr_teleoperate's simulation mode).
    """
    status = StatusLine(quiet)
    log_to_stderr(quiet, status.on_terminal, "dexkit.service.counters")
    kind = backend(backend_name)
    by_side = devices_by_side(devices, sides)
    values = _settings(settings, sides)
    hands = [kind.create(BackendOptions(side, by_side.get(side), values[side])) for side in sides]
    # a backend that needs something is a device, even where it finds it by itself
    chosen = domain if domain is not None else (0 if by_side or kind.needs else 1)
    language = _dialect(hands, dialect)
    if prefix:
        language = language.under(prefix)
    groups = _groups(hands, language)

    from dexkit.dds import DdsNode
    from dexkit.view.viewer_process import viewer

    with (
        stop_on_signals() as stop,
        # at ordinary priority: it must not wait for the service, nor the service for it
        viewer(chosen, interface, stop.event, click.echo) if view else nullcontext(),
        # before any thread of the service is started: they inherit it
        real_time_priority() if real_time else nullcontext(True) as granted,
        DdsNode(domain=chosen, interface=interface) as node,
    ):
        if not granted:
            log.info("no real-time priority: this user has no rtprio limit (docs/service.md)")
        publisher = Publisher(state_rate or model_by_name(language.model).state_rate)
        services = [
            HandService(
                group,
                node=node,
                domain=chosen,
                dialect=language,
                publisher=publisher,
                phase=_PHASE + (1 - _PHASE) * i / len(groups),
                estimation=Estimation(estimator),
                fill=Fill(fill),
                stall_tau=stall_tau,
                wait_for_device=wait_for_device,
                force=force,
            )
            for i, group in enumerate(groups)
        ]
        prepare_process(len(hands))
        with ExitStack() as running:
            _on_sigusr1(running, services)
            for service in services:
                running.enter_context(service)
            for service, group in zip(services, groups, strict=True):
                names = " and ".join(str(hand.spec.side) for hand in group)
                touch = f", touch on {service.touch_topic}" if service.touch_topic else ""
                click.echo(
                    f"ready: {backend_name} {names} on {service.cmd_topic} and "
                    f"{service.state_topic}{touch} ({language.name}), {service.state_rate:g} Hz, "
                    f"domain {chosen}, {interface}"
                )
            sys.stdout.flush()
            # from the state loop: a service that is alive and publishes nothing is restarted
            if (alive := watchdog(time.monotonic)) is not None:
                publisher.add(alive)
                running.callback(publisher.remove, alive)
            notify("READY=1", f"STATUS=serving {', '.join(s.state_topic for s in services)}")
            _watch(services, stop, status)
            notify("STOPPING=1")
        for service in services:
            service.log_counters()
    for service in services:
        if isinstance(service.failure, TopicConflict):
            raise service.failure
        if service.failure is not None:
            raise DexkitError(f"the service failed: {service.failure}")
    return 0


def _settings(texts: Sequence[str], sides: Sequence[Side]) -> dict[Side, dict[str, str]]:
    """The settings of each hand."""
    values: dict[Side, dict[str, str]] = {side: {} for side in sides}
    for text in texts:
        key, value = key_and_value(text)
        prefix, dot, rest = key.partition(".")
        if dot and prefix in [str(s) for s in Side]:
            if Side(prefix) not in values:
                raise UsageError(f"--set {text}, but only the {sides[0]} hand is served")
            values[Side(prefix)][rest] = value
        else:
            for one in values.values():
                one[key] = value
    return values


def _dialect(hands: Sequence[Hand], name: str | None) -> Dialect:
    """The dialect called ``name``, or the first of the hand model."""
    model = model_by_name(hands[0].spec.model)
    if name is None:
        return model.dialects[0]
    chosen = dialect_by_name(name)
    if chosen.model != model.name:
        raise UsageError(
            f"a {model.name} has no dialect {name}",
            hint=f"its dialects: {', '.join(d.name for d in model.dialects)}",
        )
    return chosen


def _groups(hands: list[Hand], dialect: Dialect) -> list[list[Hand]]:
    """The hands by topic pair."""
    groups: dict[tuple[str, str], list[Hand]] = {}
    for hand in hands:
        groups.setdefault(dialect.topics(hand.spec.side), []).append(hand)
    return list(groups.values())


def _on_sigusr1(running: ExitStack, services: Sequence[HandService]) -> None:
    def handle(signum: int, frame: FrameType | None) -> None:
        for service in services:
            service.log_counters()

    running.callback(signal.signal, signal.SIGUSR1, signal.signal(signal.SIGUSR1, handle))


def _watch(services: Sequence[HandService], stop: StopRequest, status: StatusLine) -> None:
    """Until asked to stop, show a status line, and log hints about clients that do not match."""
    started = time.monotonic()
    logged: set[str] = set()
    rates = [_Rate(lambda s=service: s.counters.published) for service in services]  # type: ignore[misc]
    lonely = True
    while not stop.wait(_STATUS_PERIOD):
        if any(service.failure is not None for service in services):
            return
        for service in services:
            for text in _mismatches(service):
                if text not in logged and len(logged) < MOST_REMARKS:
                    logged.add(text)
                    log.warning("%s", text)
        lonely = lonely and not any(service.clients for service in services)
        if lonely and time.monotonic() - started > _LONELY:
            lonely = False
            topics = ", ".join(service.state_topic for service in services)
            log.info("no client reads %s yet; is it on the same domain and interface?", topics)
        if status:
            lines = [_line(service, rate()) for service, rate in zip(services, rates, strict=True)]
            status.show(*(" | ".join(texts) for texts in zip(*lines, strict=True)))
    status.clear()


def _mismatches(service: HandService) -> list[str]:
    if service.node is None:
        return []
    return diagnose(service.node.endpoints(), service.dialect, list(service.cores))


class _Rate:
    """Counts a second since the last call."""

    def __init__(self, count: Callable[[], int]) -> None:
        self._count = count
        self._last = (time.monotonic(), count())

    def __call__(self) -> float:
        now = (time.monotonic(), self._count())
        (t0, n0), self._last = self._last, now
        return (now[1] - n0) / (now[0] - t0) if now[0] > t0 else 0.0


def _line(service: HandService, rate: float) -> tuple[str, str]:
    """The status of a service, and its short form."""
    hands = []
    brief = []
    for side, core in service.cores.items():
        q = ""
        if core.spec.n_joints == 1:  # seven would not fit
            view = core.view()
            q = "q ? " if view is None else f"q {float(view.state.q[0]):.2f} "
        what = "driven" if core.driving else "brake"
        if core.holding:
            what = "held"
        elif not core.connected:
            what = "lost"
        if core.connected and core.predicting:
            what += ", predicted"
        hands.append(f"{side} {q}{what} {core.measured_rate:.0f}/s")
        brief.append(f"{side} {q}{what}")
    clients = f"{service.clients} client{'' if service.clients == 1 else 's'}"
    return (
        f"{', '.join(hands)}; state {rate:.0f} Hz, {clients}",
        f"{', '.join(brief)} {rate:.0f} Hz",
    )

"""``dexkit teleop``: drive a hand as xr_teleoperate does, and measure its response."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.consent import Consent
from dexkit.cli.options import (
    dds_options,
    dialect_option,
    duration_option,
    force_option,
    json_option,
    record_option,
    side_option,
    wait_option,
)
from dexkit.cli.stop_keys import keys
from dexkit.errors import DexkitError
from dexkit.hand import Side
from dexkit.models import DEX1_1, DIALECTS, MODELS, Dialect
from dexkit.models import dialect as dialect_by_name
from dexkit.models import model as model_by_name
from dexkit.stop_signals import stop_on_signals
from dexkit.teleop import (
    Operator,
    Pose,
    Profile,
    Release,
    client_for,
    profile,
    profiles_for,
    recorded,
)

if TYPE_CHECKING:
    from dexkit.dds import DdsNode
    from dexkit.teleop.live import TeleopSession

__all__ = ["command"]

_HINT_AFTER = 5.0  # seconds of waiting
_SILENT = 1.0  # seconds without state at the end: the command time-out of the family
_SLOW = 0.9
"""Part of the nominal rate below which the figures are not the hand's."""
_MS = 1e3


@click.command(
    "teleop",
    cls=Command,
    exit_codes={
        0: "done",
        1: "the hand gave no state, fell silent, or is commanded by another program, or this "
        "program was suspended without a terminal",
    },
)
@click.argument("profile_name", metavar="PROFILE", required=False)
@dialect_option(
    "Dialect of the hands: "
    + "; ".join(f"{', '.join(d.name for d in m.dialects)} ({m.name})" for m in MODELS.values())
    + ".",
    default=DEX1_1.dialects[0].name,
)
@dds_options()
@side_option("Hands to drive. The genuine client drives both, and waits for both.", default="both")
@duration_option(
    "Drive for S seconds, repeating the profile.  [default: once through it]", least=0.5
)
@wait_option(
    "Wait up to S seconds for states.  [default: no limit, as the genuine client]", default=None
)
@click.option(
    "--release",
    "release_name",
    type=click.Choice([str(r) for r in Release]),
    help="Release of xr_teleoperate whose Dex1-1 client is imitated.  "
    "[default: 1.4; 1.1 for unitree_actuator]",
)
@click.option(
    "--sim",
    "simulated",
    is_flag=True,
    help="Do not clip the commands of a Dex1-1, as xr_teleoperate --sim.",
)
@record_option("Also record the hands' topics, for 'dexkit check'.")
@force_option()
@json_option("Print the measurements as JSON (docs/teleop.md).")
def command(
    profile_name: str | None,
    dialect: str,
    domain: int,
    interface: str,
    sides: tuple[Side, ...],
    duration: float | None,
    wait: float | None,
    release_name: str | None,
    simulated: bool,
    record_path: Path | None,
    force: bool,
    as_json: bool,
) -> int:
    """Drive a hand as xr_teleoperate does, and measure its response: delay, lag, overshoot.

    PROFILE names a motion of the operator (without it they are listed), or is a recording FILE.mcap
    whose commands are the operator's targets. The client waits for the state of both hands,
    clips each Dex1-1 command to 0.18 rad of the last state and smooths it, as the genuine one
    does. The default domain is 1, the simulation's:
    --domain 0 with a robot's interface moves real hands.

    At the end, on Ctrl-C too, the hands are commanded to hold their position. If this program was
    suspended for more than a second, it asks before it moves them on; without a terminal it ends.
    """
    if profile_name is None:
        _list()
        return 0
    spoken = dialect_by_name(dialect)
    chosen = _profile(profile_name, spoken)
    client = client_for(
        spoken,
        sides,
        release=Release(release_name) if release_name else None,
        simulated=simulated,
    )
    operator = Operator(chosen, spoken)
    seconds = duration or chosen.duration

    from dexkit.dds import DdsNode
    from dexkit.teleop.live import LiveClient

    with stop_on_signals() as stop, ExitStack() as stack:
        if record_path is not None:
            _record(stack, record_path, spoken, domain, interface)
        node = stack.enter_context(DdsNode(domain=domain, interface=interface))
        consent = Consent(stack.enter_context(keys()), stop)
        live = LiveClient(node, client, force=force, resume=consent)
        waiting = _WaitReport(node, spoken, wait)
        if not live.wait_ready(stop.event, waiting):
            return consent.explain() or 130
        _print_to_stderr(
            f"ready: {chosen.name} on {spoken.name}, domain {domain}, {interface}, {seconds:g} s"
        )
        show = _Progress(seconds)
        try:
            session = live.perform(operator, seconds, stop.event, show)
        finally:
            show.clear()
            live.leave()
        stopped = bool(stop)
    for at, seconds_away in session.pauses:
        _print_to_stderr(
            f"this program was paused for {seconds_away:.2f} s, {at:.1f} s after the beginning; "
            "figures of then are not the hand's"
        )
    _report(session, operator, 1 / client.period, as_json=as_json)
    if code := consent.explain():
        return code
    silent = [] if stopped else _silent_sides(session, seconds)
    for side in silent:
        _print_to_stderr(
            f"{side}: no state in the end; the genuine client goes on with what it last read"
        )
    return 130 if stopped else int(bool(silent))


def _print_to_stderr(text: str) -> None:
    click.echo(text, err=True)


def _list() -> None:
    for hand in MODELS.values():
        click.echo(f"{hand.title} (--dialect {', '.join(d.name for d in hand.dialects)})")
        for each in profiles_for(hand.name):
            click.echo(f"  {each.name:12} {each.duration:4.1f} s  {each.summary}")


def _profile(name: str, spoken: Dialect) -> Profile:
    """A profile by name, or the commands of a recording.

    :raises UsageError: no such profile.
    :raises DexkitError: the recording cannot be used.
    """
    if not name.endswith(".mcap"):
        return profile(name, spoken.model)
    from dexkit.conformance.stimuli import CommandSession

    found = CommandSession.load(Path(name)).for_hand(spoken)
    scale = 1.0 if found.dialect.name == spoken.name else spoken.q_open / found.dialect.q_open
    series: dict[Side, tuple[list[float], list[Pose]]] = {
        side: (
            [float(t) for t in commands.t],
            [tuple(float(x) * scale for x in row) for row in commands.q],
        )
        for side, commands in found.commands.items()
    }
    return recorded(Path(name).stem, spoken, series)


def _record(stack: ExitStack, path: Path, spoken: Dialect, domain: int, interface: str) -> None:
    """Record the hands' topics until the stack is closed."""
    from dexkit.dds import DdsNode
    from dexkit.traces.dds_recording import DdsRecording
    from dexkit.traces.recorder import Recorder

    recorder = stack.enter_context(Recorder(path))
    node = stack.enter_context(DdsNode(domain=domain, interface=interface))
    topics = {
        topic: kind
        for s in Side
        for topic, kind in zip(spoken.topics(s), (spoken.cmd_type, spoken.state_type), strict=True)
    }
    stack.enter_context(DdsRecording(node, recorder, list(topics), types=topics))


class _WaitReport:
    """Prints what the client waits for, as xr_teleoperate does, and a hint after a while."""

    def __init__(self, node: DdsNode, spoken: Dialect, wait: float | None) -> None:
        from dexkit.doctor.hand_domains import HandsElsewhere

        self._node = node
        self._spoken = spoken
        self._patience = wait
        self._reported: Mapping[Side, str] | None = None
        self._helped = False
        self._elsewhere = HandsElsewhere(node.domain, node.interface)

    def __call__(self, missing: Mapping[Side, str], seconds: float) -> None:
        """Still waiting.

        :raises DexkitError: for longer than the user wants to.
        """
        from dexkit.doctor.hand_domains import elsewhere_hint

        what = ", ".join(f"{s} ({why})" if why else str(s) for s, why in missing.items())
        if self._patience is not None and seconds >= self._patience:
            error = DexkitError(
                f"no usable state of {what} after {seconds:.0f} s on domain {self._node.domain}",
                hint=elsewhere_hint(self._node) or self._advice,
            )
            error.exit_code = 1
            raise error
        if missing and missing != self._reported:
            _print_to_stderr(f"waiting for state of {what} ...")
            self._reported = dict(missing)
        if seconds >= _HINT_AFTER and not self._helped:
            self._helped = True
            _print_to_stderr(f"  {self._advice}")
        if where := self._elsewhere.look():  # in the background: a wait is a pause to the client
            _print_to_stderr(f"  there is {where}")

    @property
    def _advice(self) -> str:
        seen = {(e.topic, e.type_name) for e in self._node.endpoints() if e.kind == "writer"}
        others = [
            d.name
            for d in DIALECTS.values()
            if d != self._spoken and any((d.topics(s)[1], d.state_type) in seen for s in Side)
        ]
        if others:
            return f"there are hands with the dialect {', '.join(others)}: --dialect {others[0]}"
        where = "" if self._node.interface == "lo" else f" --interface {self._node.interface}"
        return f"'dexkit doctor --domain {self._node.domain}{where}' reports what is wrong"


class _Progress:
    """Shows the progress in one line, on a terminal."""

    def __init__(self, duration: float) -> None:
        self._duration = duration
        self._tty = sys.stderr.isatty()

    def __call__(self, seconds: float, session: TeleopSession) -> None:
        if self._tty:
            rates = ", ".join(f"{s} {session.command_rate(s):.0f} Hz" for s in session.sides)
            click.echo(
                f"\r\033[K{seconds:5.1f} of {self._duration:g} s  {rates}", nl=False, err=True
            )

    def clear(self) -> None:
        """Remove the line."""
        if self._tty:
            click.echo("\r\033[K", nl=False, err=True)


def _silent_sides(session: TeleopSession, end: float) -> list[Side]:
    last = {s: rows[-1][0] for s, rows in session.states.items() if rows}
    return [s for s in session.sides if last.get(s, -math.inf) < end - _SILENT]


def _report(session: TeleopSession, operator: Operator, nominal: float, *, as_json: bool) -> None:
    model = model_by_name(operator.dialect.model)
    found: dict[str, Any] = {}
    for side in session.sides:
        figures = session.tracking(operator, side)
        joints = {model.joints[side][i].name: f.figures() for i, f in figures.items()}
        found[str(side)] = {"client_hz": session.command_rate(side), "joints": joints}
    if as_json:
        data = {
            "profile": operator.profile.name,
            "dialect": operator.dialect.name,
            "seconds": session.duration,
            "sides": found,
        }
        click.echo(json.dumps(_finite(data), indent=2))
        return
    for name_of_side, measured in found.items():
        hertz = measured["client_hz"]
        note = (
            "" if hertz > _SLOW * nominal else f" of {nominal:.0f}: what follows is this machine's"
        )
        click.echo(f"{name_of_side}: the client ran at {hertz:.0f} Hz{note}")
        if not measured["joints"]:
            click.echo("  no occasion to measure anything")
        for name, values in measured["joints"].items():
            text = sentence(values, model.unit) or "no occasion to measure anything"
            click.echo(f"  {text}" if len(model.joints[Side.LEFT]) == 1 else f"  {name}: {text}")


def _finite(value: Any) -> Any:
    """JSON knows no infinity: null."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def sentence(values: Mapping[str, float], unit: str = "rad") -> str:
    """The figures of a joint in a line; ``unit`` is that of q."""
    formats: dict[str, Callable[[float], str]] = {
        "stroke_s": lambda x: f"full stroke {x:.2f} s" if math.isfinite(x) else "hardly moves",
        "reaction_s": lambda x: f"reacts after {x * _MS:.0f} ms",
        "overshoot": lambda x: f"overshoots by {x:.3f} {unit}",
        "stuck": lambda x: f"rests {x:.3f} {unit} off",
        "lag_s": lambda x: (
            f"lags {x * _MS:.0f} ms" if math.isfinite(x) else "follows no slow motion"
        ),
    }
    return ", ".join(
        format_figure(values[name]) for name, format_figure in formats.items() if name in values
    )

"""``dexkit selftest``: test the joints and sensors of one hand."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.consent import Consent
from dexkit.cli.options import (
    Number,
    dds_options,
    device_option,
    dialect_option,
    force_option,
    html_option,
    one_side_option,
    result_option,
    wait_option,
    yes_option,
)
from dexkit.cli.settings import key_and_value, set_option
from dexkit.cli.status_line import StatusLine
from dexkit.cli.stop_keys import Keys, is_enter, is_stop, keys
from dexkit.errors import DdsError, UsageError
from dexkit.escaping import REMARK, one_line
from dexkit.hand import Hand, Side
from dexkit.models import Dialect
from dexkit.models import dialect as dialect_by_name
from dexkit.models import model as model_by_name

if TYPE_CHECKING:
    from dexkit.conformance.selftest.result import SelfTestResult
    from dexkit.conformance.selftest.supervision import SelfTest
    from dexkit.stop_signals import StopRequest

__all__ = ["command"]

_SPEED = 0.25
"""Part of the full speed, which needs much less than the torque that is allowed. Position servos,
whose client asks for all of it, are tried at it."""


@click.command(
    "selftest",
    cls=Command,
    exit_codes={
        0: "no fault found",
        1: "a fault, a failed measurement, or suspended without a terminal",
        2: "the test cannot begin",
        130: "stopped",
    },
)
@click.argument("backend_name", metavar="[BACKEND]", required=False)
@click.option("--external", is_flag=True, help="Test a hand that is already served on DDS.")
@one_side_option("Hand to test.", required=True)
@device_option("Path or serial number of the device.")
@set_option("Setting of the backend; 'dexkit backends' lists them.")
@dialect_option("With --external: the dialect of the hand.")
@click.option(
    "--joint",
    "joints",
    multiple=True,
    metavar="NAME",
    help="Test only this joint; may be repeated.  [default: all]",
)
@click.option(
    "--fraction",
    type=Number(0.05, 1.0),
    metavar="F",
    help="Largest test speed, as a fraction of the full speed.  "
    "[default: 0.25; 1 for position servos]",
)
@click.option(
    "--touch/--no-touch",
    default=True,
    help="Ask for each tactile element to be pressed, where the model has some.  [default: touch]",
)
@result_option("Where to write the result.  [default: selftest-MODEL-SIDE-TIME.json]")
@html_option()
@dds_options()
@wait_option("With --external: wait up to S seconds for the hand.")
@force_option()
@yes_option("whether the hand is free to move")
def command(backend_name: str | None, **given: Any) -> int:
    """Test one hand: its joints one by one, and its tactile elements.

    BACKEND is a name from 'dexkit backends' or package.module:Class; the hand is driven directly.
    Every joint MOVES over its whole range, slowly at first: keep the hand free. It asks first,
    except for a simulated hand; without a terminal it needs --yes. Space, q or Ctrl-C stops and
    leaves the hand at rest. If this program was suspended for more than a second, it asks before it
    goes on; without a terminal it ends.

    Writes a page and a JSON file.
    """
    if (backend_name is None) == (not given["external"]):
        raise UsageError(
            "name one hand: a backend, or --external", hint="'dexkit backends' lists the backends"
        )
    if given["external"] and (given["device"] or given["settings"]):
        raise UsageError("--device and --set are for a backend, not for --external")
    if backend_name is not None and given["dialect"]:
        raise UsageError("--dialect is for --external: a backend is driven without DDS")
    if given["external"] and given["dialect"] is None:
        raise UsageError("--external needs --dialect", hint="e.g. --dialect unitree_go")
    from dexkit.conformance.selftest.joint_motion import Setup
    from dexkit.conformance.selftest.live import run
    from dexkit.conformance.selftest.procedure import Procedure
    from dexkit.conformance.selftest.result import result_of
    from dexkit.conformance.selftest.supervision import End, SelfTest
    from dexkit.documents import check_output_paths
    from dexkit.stop_signals import stop_on_signals

    with ExitStack() as stack:
        stop = stack.enter_context(stop_on_signals())
        hand, spoken = _hand(stack, backend_name, given, stop)
        spec = hand.spec
        about = {
            "backend": backend_name or "external",
            "device": given["device"] or "",
        }
        json_path, page = _outputs(given, spec.model)
        check_output_paths([json_path, page], [])
        joints = _joints([joint.name for joint in spec.joints], given["joints"])
        touch = _touch(spec.model, given["touch"])
        _ask(backend_name, given["yes"], spec.side)
        try:
            hand.open()
        except DdsError:
            if stop:  # while it waited for the hand
                return 130
            raise
        stack.callback(hand.close)
        setup = Setup.from_spec(
            hand.spec,  # opening may have refined its rate
            dialect=spoken,
            joint_speeds=getattr(hand, "joint_speeds", None),
        )
        speed = given["fraction"] or (1.0 if setup.servo else _SPEED)
        test = SelfTest(Procedure(setup, joints=joints, speed=speed, touch=touch))
        count = len(joints) if joints is not None else spec.n_joints
        click.echo(
            f"ready: testing {count} joint{'s' if count > 1 else ''} of the {spec.side} "
            f"{model_by_name(spec.model).title}; space, q or Ctrl-C stops",
            err=True,
        )
        pressed = stack.enter_context(keys())
        consent = Consent(pressed, stop)
        with _turn(stop, pressed) as turn:
            run(hand, test, turn=turn, resume=consent)
    if consent.missing:
        return consent.explain()
    if test.end is End.STOPPED:
        click.echo("stopped; the hand is at rest, and nothing was written", err=True)
        return 130
    return _finish(result_of(test, about), json_path, page)


def _hand(
    stack: ExitStack, name: str | None, given: dict[str, Any], stop: StopRequest
) -> tuple[Hand, Dialect | None]:
    """The hand, not opened yet, and the dialect that it is commanded in; None for a backend."""
    side = Side(given["side"])
    if name is not None:
        from dexkit.backends import BackendOptions, backend

        kind = backend(name)
        settings = dict(map(key_and_value, given["settings"]))
        return kind.create(BackendOptions(side, given["device"], settings)), None
    from dexkit.conformance.selftest.external import ExternalHand
    from dexkit.dds import DdsNode
    from dexkit.doctor.hand_domains import elsewhere_hint

    spoken = dialect_by_name(given["dialect"])
    node = stack.enter_context(DdsNode(domain=given["domain"], interface=given["interface"]))

    def waiting(seconds: float) -> None:
        if seconds >= given["wait"]:
            raise DdsError(
                f"no {side} hand on {spoken.topics(side)[1]}, domain {node.domain}, "
                f"{node.interface} (waited {given['wait']:g} s)",
                hint=elsewhere_hint(node)
                or "start it first ('dexkit serve'); check --domain, --interface and --dialect",
            )

    hand = ExternalHand(node, spoken, side, stop=stop.event, waiting=waiting, force=given["force"])
    return hand, spoken


def _ask(name: str | None, yes: bool, side: Side) -> None:
    """Ask whether the hand may move, unless it is simulated or ``--yes`` was given.

    :raises UsageError: there is no terminal to ask at.
    """
    from dexkit.conformance.kit.known_backends import SIMULATED

    if yes or name in SIMULATED:
        return
    if not sys.stdin.isatty():
        raise UsageError("cannot ask whether the hand is free: no terminal", hint="give --yes")
    if not click.confirm(
        f"Every joint of the {side} hand will move over its whole range. Is it free to move?"
    ):
        raise click.Abort


def _joints(names: list[str], chosen: tuple[str, ...]) -> list[int] | None:
    """Indices of the joints of ``--joint``; None for all.

    :raises UsageError: there is no such joint.
    """
    for name in chosen:
        if name not in names:
            raise UsageError(f"no joint {one_line(name)!r}", hint=f"it has {', '.join(names)}")
    return sorted({names.index(name) for name in chosen}) if chosen else None


def _touch(name: str, wanted: bool) -> bool:
    """Whether elements are to be pressed.

    :raises UsageError: there is no terminal to ask at.
    """
    if not wanted or not model_by_name(name).sensors:
        return False
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise UsageError(
            f"a {model_by_name(name).title} has tactile elements, and there is no terminal to ask "
            "an operator to press them",
            hint="--no-touch tests the joints alone",
        )
    return True


def _outputs(given: dict[str, Any], model: str) -> tuple[Path, Path]:
    """Paths of result and page; an earlier run is overwritten only if a name is given."""
    stem = f"selftest-{model}-{given['side']}-{datetime.now():%Y%m%d-%H%M%S}"
    json_path, page = given["result_path"], given["html_path"]
    if json_path is None:
        json_path = Path(f"{stem}.json") if page is None else page.with_suffix(".json")
    return json_path, page or json_path.with_suffix(".html")


@contextmanager
def _turn(stop: StopRequest, pressed: Keys) -> Iterator[Callable[[SelfTest], None]]:
    """Shows progress and questions, and takes keys, in each turn of a test."""
    from dexkit.conformance.selftest.supervision import End

    status = StatusLine(quiet=False)
    said = ""

    def turn(test: SelfTest) -> None:
        nonlocal said
        procedure = test.procedure
        keyed = pressed()
        if stop or is_stop(keyed):
            test.stop(End.STOPPED, "stopped")
        elif procedure.question and is_enter(keyed):
            procedure.skip()
        now = procedure.question or procedure.doing
        if now == said:
            return
        said = now
        text = f"{procedure.part:4.0%}  {now}"
        if procedure.question:
            text = f"touch: {now}; Enter goes on without"
        if status:
            status.show(one_line(text, REMARK))
        else:
            click.echo(one_line(text, REMARK), err=True)

    try:
        yield turn
    finally:
        status.clear()


def _finish(result: SelfTestResult, json_path: Path, page: Path) -> int:
    """Write and print the result; returns the exit code."""
    from dexkit.conformance.report.selftest import print_selftest, render_selftest
    from dexkit.conformance.selftest.result import Verdict
    from dexkit.conformance.selftest.result_file import write_json
    from dexkit.documents import write_file

    write_json(result, json_path)
    write_file(page, render_selftest(result))
    print_selftest(result)
    click.echo(f"result: {json_path}")
    click.echo(f"page: {page}")
    return 0 if result.verdict is Verdict.GOOD else 1

"""``dexkit bringup``: find out how a hand is wired, one joint at a time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import click

from dexkit import documents
from dexkit.backends import BackendOptions, backend, list_backends
from dexkit.bringup import Bench, BringupSession, Drive, Effort, Findings, Question, Snapshot
from dexkit.bringup.script import describe
from dexkit.cli.command_help import Command
from dexkit.cli.held_key import Terminal
from dexkit.cli.options import (
    FILE,
    Number,
    device_option,
    dry_run_option,
    side_option,
)
from dexkit.cli.remarks import remark
from dexkit.cli.settings import key_and_value, set_option
from dexkit.clock import Rate, RealClock
from dexkit.errors import HandTimeout, UsageError
from dexkit.escaping import one_line
from dexkit.hand import Side
from dexkit.stop_signals import StopRequest, stop_on_signals

__all__ = ["command"]

_RATE = 100.0
"""Frames a second while something moves: a released key stops it within a hundredth."""
_LOST_ANSWERS = 3


@click.command(
    "bringup",
    cls=Command,
    exit_codes={
        0: "everything is found and stored",
        1: "the hand is gone or has a fault; what was found is stored",
    },
)
@click.argument("backend_name", metavar="BACKEND")
@side_option("Hand to bring up.", required=True)
@device_option("Serial number, address or port of the device.")
@set_option("Setting of the backend, e.g. config=FILE; 'dexkit backends' lists the settings.")
@click.option(
    "--torque",
    type=Number(0.01, 3.0),
    metavar="NM",
    help="Largest torque at a joint; motion begins with a quarter of it.  [default: the "
    "backend's, shown by --dry-run]",
)
@click.option(
    "--speed",
    type=Number(0.02, 2.0),
    metavar="RAD/S",
    help="Speed of every motion.  [default: the backend's]",
)
@dry_run_option("Only print the plan; open and move nothing.")
@click.option("--restart", is_flag=True, help="Forget what an earlier bring-up has found.")
@click.option(
    "--answers",
    "answers_path",
    type=FILE,
    metavar="FILE",
    help="Take answers from a file written by --save-answers; missing ones are asked.",
)
@click.option(
    "--save-answers", type=FILE, metavar="FILE", help="Write the answers of this session."
)
@click.option(
    "--unattended",
    is_flag=True,
    help="Move without the dead-man key: only emulated hands (on a USB/IP server of this machine "
    "or a pseudo-terminal), and only with --answers.",
)
def command(
    backend_name: str,
    sides: tuple[Side, ...],
    device: str | None,
    settings: tuple[str, ...],
    torque: float | None,
    speed: float | None,
    dry_run: bool,
    restart: bool,
    answers_path: Path | None,
    save_answers: Path | None,
    unattended: bool,
) -> None:
    """Find out how a hand is wired, and store the result as its settings.

    The hand MOVES, one joint at a time, slowly, and only while you hold the space bar. Releasing
    it, or any other key, stops the hand. After each motion you are asked what you saw. Run the same
    command again to continue after a stop. Read docs/first-contact.md before the first real hand.
    """
    if len(sides) != 1:
        raise UsageError("one hand at a time", hint="--side left or --side right")
    if unattended and answers_path is None:
        raise UsageError("--unattended needs --answers FILE: there is no operator to ask")
    documents.check_output_paths([save_answers], [answers_path])
    kind = backend(backend_name)
    if kind.bringup is None:
        having = [b.name for b in list_backends() if b.backend and b.backend.bringup]
        raise UsageError(
            f"the backend {backend_name} has no bring-up", hint=f"these have: {', '.join(having)}"
        )
    options = BackendOptions(sides[0], device, _settings(settings))
    options.refuse_unknown(kind.settings)
    bench: Bench = kind.bringup.load()(options)
    effort = Effort.from_plan(bench.plan, torque, speed)
    if dry_run:
        _print_plan(bench, effort, (), attended=not unattended)
        return
    known = {} if answers_path is None else _read_answers(answers_path)
    terminal = None if unattended else Terminal()
    with stop_on_signals() as stop:
        try:
            bench.open()
            if unattended and not bench.emulated:
                raise UsageError(
                    "--unattended is not for this hand: it is neither behind a USB/IP server of "
                    "this machine nor on a pseudo-terminal",
                    hint="leave it out, and hold the space bar",
                )
            findings = Findings() if restart else bench.load()
            _print_facts(bench)
            _print_plan(bench, effort, bench.motors, attended=not unattended)
            session = BringupSession(bench.plan, bench.motors, findings, effort)
            _Run(bench, session, terminal, known, stop).run()
            _print_result(bench, session)
        finally:
            bench.close()
    if save_answers is not None:
        documents.write_file(save_answers, json.dumps(session.findings.answers, indent=2) + "\n")


def _settings(texts: tuple[str, ...]) -> dict[str, str]:
    values: dict[str, str] = {}
    for text in texts:
        key, value = key_and_value(text)
        if key in values:
            raise UsageError(f"{key} is given twice")
        values[key] = value
    return values


def _read_answers(path: Path) -> dict[str, str]:
    """Answers by key.

    :raises UsageError: it is no such file.
    """
    content = documents.read_json(path)
    if not isinstance(content, dict) or not all(isinstance(v, str) for v in content.values()):
        raise UsageError(
            f"{path} holds no answers", hint='a JSON object: {"motor 0.0 joint": "thumb_0", ...}'
        )
    return content


class _Run:
    """The loop of one bring-up: exchanges at 100 Hz, questions in between."""

    def __init__(
        self,
        bench: Bench,
        session: BringupSession,
        terminal: Terminal | None,
        answers: Mapping[str, str],
        stop: StopRequest,
    ) -> None:
        self._bench, self._session = bench, session
        self._terminal, self._stop = terminal, stop
        self._answers = dict(answers)
        self._snapshot = Snapshot({})
        self._lost = 0
        self._exchange(None)

    def run(self) -> None:
        """Until everything is found.

        :raises HandError: a fault, or the hand is gone; what was found is stored.
        :raises click.Abort: a signal, or the terminal has gone.
        """
        session = self._session
        while not session.done:
            if session.question is not None:
                session.answer(self._answer(session.question))
                self._bench.store(session.findings)
            else:
                self._act()
        self._bench.store(session.findings)

    def _act(self) -> None:
        """Everything until the next question."""
        session, clock = self._session, RealClock()
        rate = Rate(_RATE, clock)
        said, moving = "", False
        with self._keys() as held:
            while session.question is None and not session.done:
                rate.wait()
                self._check_stop()
                if session.doing != said:
                    said = session.doing
                    if said:
                        how = "hold SPACE: " if session.moves and self._terminal else ""
                        click.echo(f"{how}{said}")
                now = time.monotonic()
                key = held(clock.since_boot())  # a key from before a sleep of the machine is old
                # an old state is none to drive by: after a lost answer all is locked until the next
                drive = session.step(now, self._snapshot, key) if not self._lost else None
                if moving and drive is None and session.moves and session.doing == said:
                    click.echo("  released: locked")
                moving = drive is not None
                self._exchange(drive)
        self._exchange(None)

    def _exchange(self, drive: Drive | None) -> None:
        try:
            self._snapshot = self._bench.exchange(drive)
            self._lost = 0
        except HandTimeout:
            self._lost += 1
            if self._lost >= _LOST_ANSWERS:
                raise

    @contextmanager
    def _keys(self) -> Iterator[Callable[[float], bool]]:
        if self._terminal is None:
            yield lambda now: True
            return
        with self._terminal.keys() as held:
            yield held

    def _check_stop(self) -> None:
        if self._stop:
            raise click.Abort

    def _answer(self, question: Question) -> str:
        text = self._answers.pop(question.key, None)
        if text is not None:
            if text not in question.choices:
                raise UsageError(
                    f"{question.key}: {one_line(text, 40)!r} is not a valid answer",
                    hint=f"{question.text} {', '.join(question.choices)}",
                )
            click.echo(f"{question.text} {text}")
            return text
        if self._terminal is None:
            raise UsageError(
                f"no answer to {question.key!r} is left: {question.text}",
                hint=f"one of {', '.join(question.choices)}",
            )

        def meanwhile() -> None:
            self._check_stop()
            self._exchange(None)

        return self._terminal.ask(question, meanwhile)


def _print_facts(bench: Bench) -> None:
    for name, value in bench.facts.items():
        shown = ", ".join(map(str, value)) if isinstance(value, list) else value
        click.echo(f"{name.replace('_', ' ')}: {one_line(shown, 200)}")


def _print_plan(bench: Bench, effort: Effort, motors: tuple[str, ...], *, attended: bool) -> None:
    condition = ", only while SPACE is held" if attended else ""
    click.echo(
        f"plan: one joint at a time, at most {effort.torque:g} N·m and {effort.speed:g} rad/s"
        f"{condition}"
    )
    for number, line in enumerate(describe(bench.plan, motors), 1):
        click.echo(f"  {number}. {line}")
    click.echo(f"  what is found goes to {bench.where}")


def _print_result(bench: Bench, session: BringupSession) -> None:
    click.echo("found:")
    for name, text in bench.settings(session.findings).items():
        click.echo(f"  {name}={text}")
    for joint, travel in session.findings.travel.items():
        if not travel.confirmed:
            remark("warning", f"the zero of {joint} was not confirmed: correct its offset by hand")
    skipped = [place for place, address in session.findings.sensors.items() if address is None]
    if skipped:
        remark("warning", f"sensors are left as assumed: {', '.join(skipped)} skipped")
    click.echo(f"stored in {bench.where}; 'dexkit serve' reads it")

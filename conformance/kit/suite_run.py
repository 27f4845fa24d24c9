"""Run the conformance suite: check options, do the live run, judge it, write result files."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.backend_processes import RigOptions
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.known_backends import (
    EXTERNAL,
    ROBOT_EMULATORS,
    SIMULATED,
    emulator_of,
    has_usb_requirements,
)
from dexkit.conformance.kit.recording import Recording, sides_of
from dexkit.conformance.kit.requirements import Requirement, catalogue, select
from dexkit.conformance.kit.result_file import write_json
from dexkit.conformance.kit.results import RunResult, grouped
from dexkit.conformance.kit.robot import robot_dialect
from dexkit.conformance.kit.run_queue import MOST_FILES
from dexkit.conformance.kit.selection import RunKind
from dexkit.conformance.stimuli import phases_for
from dexkit.conformance.stimuli.recorded_session import CommandSession
from dexkit.digests import sha256_of_file
from dexkit.documents import write_file
from dexkit.errors import ConformanceError, UsageError
from dexkit.hand import ROBOT, Side, Subject
from dexkit.interpreter import pause_collection
from dexkit.models import DEX1_1, Dialect, dialect, model
from dexkit.open_file_limit import require_open_files
from dexkit.robots import ROBOTS
from dexkit.temporary_folder import TemporaryFolder
from dexkit.view.viewer_process import viewer

if TYPE_CHECKING:
    import pytest

    from dexkit.conformance.kit.live import LiveOptions

__all__ = ["SuiteOptions", "judge_recording", "live_options", "run_suite", "selection"]

T = TypeVar("T")
# descriptors of a run: DDS, recording, the pipes of its processes; and what watches these
_FILES = 48 + MOST_FILES
_NAMED = 3  # requirements named, of those that were open in a run that is done again


@dataclass(frozen=True)
class SuiteOptions:
    """The options of a run of the suite.

    :param domain: None for a free one.
    :param thorough: every stimulus again and again, as :class:`RunKind` says.
    :param view: show the run on a page in the browser.
    """

    backend: str
    sides: tuple[Subject, ...]
    dialect: Dialect
    domain: int | None
    interface: str
    devices: Mapping[Side, str]
    objects: Mapping[Side, float]
    settings: tuple[str, ...]
    trace: Path | None
    requirements: tuple[Requirement, ...]
    claims: Claims = field(default_factory=Claims)
    thorough: bool = False
    result: Path | None = None
    report: Path | None = None
    markdown: Path | None = None
    recording: Path | None = None
    view: bool = False

    @classmethod
    def from_pytest(cls, config: pytest.Config) -> SuiteOptions:
        """Read the options from pytest's command line.

        :raises UsageError: options that make no sense together.
        :raises BackendError: no such backend.
        """

        def get(name: str) -> Any:
            return config.getoption(f"dexkit_{name}")

        def path(name: str) -> Path | None:
            value = get(name)
            return Path(value) if value else None

        return cls.make(
            backend=get("backend"),
            side=get("side"),
            dialect_name=get("dialect"),
            domain=get("domain"),
            interface=get("interface"),
            devices=get("device"),
            objects=get("object"),
            settings=get("set"),
            trace=path("trace"),
            require=get("require"),
            level=get("level"),
            quick=get("quick"),
            thorough=get("thorough"),
            capabilities=path("capabilities"),
            result=path("result"),
            report=path("report"),
            markdown=path("markdown"),
            recording=path("recording"),
            view=get("view"),
        )

    @classmethod
    def make(
        cls,
        *,
        backend: str,
        side: str | None = None,
        dialect_name: str | None = None,
        domain: int | None = None,
        interface: str = "lo",
        devices: Sequence[str] = (),
        objects: Sequence[str] = (),
        settings: Sequence[str] = (),
        trace: Path | None = None,
        require: Sequence[str] = (),
        level: str | None = None,
        quick: bool = False,
        thorough: bool = False,
        capabilities: Path | None = None,
        result: Path | None = None,
        report: Path | None = None,
        markdown: Path | None = None,
        recording: Path | None = None,
        view: bool = False,
    ) -> SuiteOptions:
        """Check a user's options and fill in defaults.

        :raises UsageError: options that make no sense together.
        :raises BackendError: no such backend.
        """
        if quick and thorough:
            raise UsageError("--quick and --thorough exclude each other")
        of_robot = _robot_of(backend, dialect_name)
        if of_robot:
            _refuse_for_robots(
                side=side,
                device=devices,
                object=objects,
                set=settings,
                trace=trace,
                thorough=thorough,
            )
        one_device = len(devices) == 1 and "=" not in devices[0]
        hands = sides_of(side or ("left" if one_device else "both"))
        if one_device and len(hands) > 1:
            raise UsageError(
                "one --device for two hands", hint="--device left=PATH --device right=PATH"
            )
        named = _by_side(devices, hands, str, "--device")
        sides: tuple[Subject, ...] = hands
        if of_robot:
            sides, chosen = (ROBOT,), robot_dialect(of_robot)
        else:
            chosen = _dialect(backend, dialect_name, hands[0], named, settings)
        touch = [o for o in objects if o != "none"]
        by_side = _by_side(touch, hands, float, "--object")
        low, high, of_what = (5, 60, "opening") if chosen.q_open > 0 else (55, 75, "closing")
        for pct in by_side.values():
            if not low <= pct <= high:
                raise UsageError(
                    f"--object {pct:g}: the object must be at {low} to {high} % of {of_what}",
                    hint="elsewhere the hand has no room to move on one of its sides",
                )
        started = backend in SIMULATED or emulator_of(backend) is not None
        if not objects and started and not devices:
            by_side = {s: p for s, p in under_test(chosen.model).objects.items() if s in sides}
        if domain is None and (backend == EXTERNAL or devices):
            domain = 0
        if domain is not None and not 0 <= domain <= 230:
            raise UsageError(f"a DDS domain is 0 to 230, not {domain}")
        if trace is not None and not trace.exists():
            raise UsageError(f"no such file: {trace}")
        for file in (result, report, markdown, recording):
            if file is not None and not file.absolute().parent.is_dir():
                raise UsageError(f"cannot write {file}: there is no such directory")
            if file is not None and file.is_dir():
                raise UsageError(f"cannot write {file}: it is a directory")
            if file is not None and not os.access(file.absolute().parent, os.W_OK):
                raise UsageError(f"cannot write {file}: its directory is read-only")
        every = catalogue(chosen.model, "robot" if of_robot else "dds")
        if has_usb_requirements(backend):
            every += catalogue(chosen.model, "usb")
        claims = Claims.load(capabilities, chosen.model)
        requirements = select(claims.apply(every), prefixes=require, level=level)
        if quick:
            requirements = RunKind.QUICK.requirements(requirements)
        if not requirements:
            raise UsageError("no requirement is left by --require, --level and --quick together")
        options = cls(
            backend=backend,
            sides=sides,
            dialect=chosen,
            domain=domain,
            interface=interface,
            devices=named,
            objects=by_side,
            settings=tuple(settings),
            trace=trace,
            requirements=requirements,
            claims=claims,
            thorough=thorough,
            result=result,
            report=report,
            markdown=markdown,
            recording=recording,
            view=view,
        )
        options.rig(0).check()
        return options

    def rig(self, domain: int) -> RigOptions:
        """The options of the backend's processes, on that domain."""
        return RigOptions(
            backend=self.backend,
            sides=self.sides,
            dialect=self.dialect,
            domain=domain,
            interface=self.interface,
            devices=self.devices,
            objects=self.objects,
            settings=self.settings,
        )


def selection(config: pytest.Config) -> tuple[Requirement, ...]:
    """The requirements that the command line selects; of every model where it names no hand.

    :raises UsageError: options that make no sense together.
    """
    if config.getoption("dexkit_backend"):
        return SuiteOptions.from_pytest(config).requirements
    name = config.getoption("dexkit_dialect")
    model_name = name if name in ROBOTS else dialect(name).model if name else None
    path = config.getoption("dexkit_capabilities")
    claims = Claims.load(Path(path) if path else None, model_name)
    every = catalogue(model_name or claims.hand.get("model"), None)
    # the suite is the client itself
    found = select(
        claims.apply(r for r in every if not r.about_client),
        prefixes=config.getoption("dexkit_require"),
        level=config.getoption("dexkit_level"),
    )
    return RunKind.QUICK.requirements(found) if config.getoption("dexkit_quick") else found


def _robot_of(backend: str, dialect_name: str | None) -> str:
    """Name of the robot to be judged; empty for a hand.

    :raises UsageError: a backend and a dialect of two of them.
    """
    started = ROBOT_EMULATORS.get(backend, "")
    wanted = dialect_name if dialect_name in ROBOTS else ""
    if (started and dialect_name and wanted != started) or (
        wanted and not started and backend != EXTERNAL
    ):
        raise UsageError(
            f"{backend} has no dialect {dialect_name}",
            hint=f"robots: --backend {' or '.join(ROBOT_EMULATORS)}, or external with --dialect "
            f"{' or '.join(ROBOTS)}",
        )
    return started or wanted or ""


def _refuse_for_robots(**given: Any) -> None:
    wrong = [f"--{name}" for name, value in given.items() if value]
    if wrong:
        raise UsageError(f"{', '.join(wrong)}: for hands only, and this run judges a robot")


def _dialect(
    name: str,
    wanted: str | None,
    side: Side,
    devices: Mapping[Side, str],
    settings: Sequence[str],
) -> Dialect:
    """Choose the dialect: the one that was given, or the first of the backend's model.

    The model is an attribute of a hand object: one is created, and not opened.

    :raises UsageError: the backend needs a device, or its model does not have that dialect.
    :raises BackendError: it makes no hand.
    """
    if name == EXTERNAL:
        return dialect(wanted) if wanted else DEX1_1.dialects[0]
    from dexkit.backends import BackendOptions, backend

    found = backend(name)
    if found.needs_device and not devices and found.emulator is None:
        raise UsageError(f"the backend {name} needs a device", hint=f"give {found.needs}")
    values = dict(s.partition("=")[::2] for s in settings)
    its_model = model(found.model_of(BackendOptions(side, devices.get(side), values)))
    spoken = its_model.dialects
    chosen = dialect(wanted) if wanted else spoken[0]
    if chosen not in spoken:
        raise UsageError(
            f"{name} is a {its_model.title}, which has no dialect {chosen.name}",
            hint=f"--dialect {' or '.join(d.name for d in spoken)}",
        )
    return chosen


def _by_side(
    values: Sequence[str], sides: Sequence[Side], kind: Callable[[str], T], option: str
) -> dict[Side, T]:
    """Parse ``left=X`` and ``right=X``, or one value for all sides."""
    found: dict[Side, T] = {}
    for value in values:
        name, equals, rest = value.partition("=")
        named = [s for s in Side if equals and s.value == name]
        try:
            for side in named or sides:
                found[side] = kind(rest if named else value)
        except ValueError:
            raise UsageError(f"{option} {value}: not a number") from None
    return found


def live_options(options: SuiteOptions, domain: int) -> LiveOptions:
    """The live run that the options ask for, on that domain.

    :raises TraceError: the session to be replayed cannot be read.
    """
    from dexkit.conformance.kit.live import LiveOptions

    phases = phases_for(r for r in options.requirements if r.layer != "usb")
    session = None
    if "replay" in phases:
        session = (
            CommandSession.load(options.trace)
            if options.trace
            else CommandSession.default(options.dialect.model)
        ).for_hand(options.dialect)
    usb = any(r.layer == "usb" for r in options.requirements)
    run = RunKind.THOROUGH if options.thorough else RunKind.DEFAULT
    return LiveOptions(
        options.rig(domain),
        phases,
        session,
        usb=usb,
        rounds=run.rounds,
        requirements=options.requirements,
        claims=options.claims,
    )


def run_suite(
    options: SuiteOptions,
    report: Callable[[str], None] = lambda text: None,
    stop: threading.Event | None = None,
    *,
    attempts: int = 2,
) -> RunResult:
    """Do the live run, judge it, write the files that were asked for.

    :param attempts: a run in which the machine was too busy is done again, so many in all.
    :raises ConformanceError: the hand cannot be started or died, or the run was stopped;
        nothing is said of it.
    :raises TopicConflict: somebody else commands it.
    :raises DdsError: DDS cannot be used here.
    """
    from dexkit.conformance.kit.live import record_run
    from dexkit.domains import reserve_free_domain
    from dexkit.traces import open_trace

    require_open_files(_FILES, "a conformance run")
    result: RunResult | None = None
    while result is None or (result.disturbed_by and attempts > 0):
        if result is not None:
            report(_why_again(result))
        attempts -= 1
        with contextlib.ExitStack() as stack:
            folder = stack.enter_context(TemporaryFolder())
            if (domain := options.domain) is None:
                domain = stack.enter_context(reserve_free_domain(options.interface)).domain
            if options.view:
                stack.enter_context(viewer(domain, options.interface, stop, report))
            path = options.recording or folder / "run.mcap"
            if not record_run(live_options(options, domain), path, report=report, stop=stop):
                raise ConformanceError("the run was stopped; nothing is judged")
            report("judging the recording")
            stack.enter_context(pause_collection())
            trace = open_trace(path)
            view = recording_of(trace, options.dialect.name, options.sides)
            if trace.damage:
                raise ConformanceError(
                    f"the run's recording is damaged, nothing is judged: {trace.damage[0]}",
                    hint=f"check the disk that holds {path}",
                )
            result = judge_recording(options, view)
    return result


def _why_again(result: RunResult) -> str:
    """What was open in a run that is done again."""
    groups = [group for _, group in grouped(result.disturbed_by)]
    rows = [f"{group[0].requirement.id} ({group[0].reason})" for group in groups[:_NAMED]]
    more = len(groups) - len(rows)
    what = "; ".join(rows) + (f"; and {more} more" if more else "")
    return f"this machine was too busy to be fair to the hand: {what}; the run is done once more"


def judge_recording(options: SuiteOptions, view: Recording) -> RunResult:
    """Judge the run's recording and write the files that were asked for."""
    subject = {}  # the rest is in the run record, so that any judging of the recording has it
    if options.recording:
        subject["recording"] = options.recording.name
        if options.recording.is_file():
            subject["recording_sha256"] = sha256_of_file(options.recording)
    result = judge(view, requirements=options.requirements, claims=options.claims, subject=subject)
    if options.result:
        write_json(result, options.result)
    if options.report:
        from dexkit.conformance.report.html import write_html

        write_html(result, view, options.report, recording=options.recording)
    if options.markdown:
        from dexkit.conformance.report.markdown import render_markdown

        write_file(options.markdown, render_markdown(result))
    return result

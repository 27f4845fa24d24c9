"""Start the processes of a live run: emulated devices, services, emulated robots.

They are started by their ``dexkit`` commands; no backend runs in the kit's own process.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from dexkit import child_processes
from dexkit.backends import Emulator
from dexkit.backends import backend as find_backend
from dexkit.conformance.kit.known_backends import EXTERNAL, ROBOT_EMULATORS, SIMULATED, emulator_of
from dexkit.conformance.kit.run_queue import Watched
from dexkit.errors import ConformanceError, UsageError
from dexkit.hand import Side, Subject
from dexkit.models import Dialect
from dexkit.redaction import redact
from dexkit.temporary_folder import TemporaryFolder

__all__ = ["Rig", "RigOptions", "Tool"]


class Tool(child_processes.Tool):
    """A ``dexkit`` command in its own process; a context manager.

    :raises ConformanceError: it ends, or says nothing, before it is ready; its last words are
        in the message.
    """

    error = ConformanceError


def _is_emulated(device: str) -> bool:
    """Whether a device is a pseudo-terminal, as emulators make: no adapter has one."""
    return os.path.realpath(device).startswith("/dev/pts/")


@dataclass(frozen=True)
class RigOptions:
    """The backend's processes and their options.

    :param backend: name, ``module:Class``, or :data:`EXTERNAL`.
    :param devices: path or serial number by side; empty for an emulated one.
    :param objects: where a side touches an object, percent of opening of a gripper, of closing of
        other hands. Started emulators get such an object; for a device it says what was put
        between its fingers.
    """

    backend: str
    sides: tuple[Subject, ...]
    dialect: Dialect
    domain: int
    interface: str = "lo"
    devices: Mapping[Side, str] = field(default_factory=dict)
    objects: Mapping[Side, float] = field(default_factory=dict)
    settings: tuple[str, ...] = ()

    @property
    def hands(self) -> tuple[Side, ...]:
        """The hands among the subjects: none where a robot is judged."""
        return tuple(s for s in self.sides if isinstance(s, Side))

    @property
    def emulator(self) -> Emulator | None:
        """How the kit emulates the device; None where there is a real one, or none."""
        return None if self.devices else emulator_of(self.backend)

    @property
    def subject(self) -> dict[str, str]:
        """Backend, device and object, for the run record and a result's ``subject``."""
        about = {"backend": self.backend}
        if self.devices and all(map(_is_emulated, self.devices.values())):
            about["device"] = "emulated"
        elif self.devices:
            about["device"] = ", ".join(f"{s} {redact(d)}" for s, d in self.devices.items())
        elif emulator_of(self.backend) is not None:
            about["device"] = "emulated"
        if self.objects:
            about["object"] = ", ".join(f"{s} at {p:g} %" for s, p in self.objects.items())
        return about

    @property
    def usb_server(self) -> str:
        """USB/IP server named by a setting, or empty."""
        settings = dict(s.partition("=")[::2] for s in self.settings)
        return settings.get("usb", "")

    def check(self) -> None:
        """Check that the options fit together.

        :raises UsageError: they do not; its hint says what to do.
        """
        if self.backend == EXTERNAL and (self.devices or self.settings):
            raise UsageError(
                "--backend external starts nothing, so --device and --set have no meaning",
                hint="give them to the service that you start yourself",
            )
        if self.devices and set(self.devices) != set(self.sides):
            raise UsageError(
                "a device is needed for each side",
                hint="--side left --device PATH, or --device left=PATH --device right=PATH",
            )
        self.dialect.check_sides(self.sides)
        for side in self.objects:
            if side not in self.sides:
                raise UsageError(f"an object for the {side} hand, which is not under test")


class Rig:
    """The processes of a live run; a context manager.

    Entering it starts the emulated devices, :meth:`start_services` the services on them.

    :param stop: ends the wait for a process that is starting.
    """

    def __init__(self, options: RigOptions, stop: threading.Event) -> None:
        options.check()
        self.options = options
        self._stop = stop
        self._stack = contextlib.ExitStack()
        self.tools: list[Tool] = []
        self._watched: dict[Tool, Watched] = {}
        self._on_terminals = False
        self._services: list[Tool] = []
        self._ended: set[Tool] = set()
        self._poses: Path | None = None
        self.devices: dict[Side, str] = dict(options.devices)
        """The device of each side: the value of ``--device``."""

    def __enter__(self) -> Rig:
        try:
            self._start_devices()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End all processes, the services before the devices. May be called twice."""
        self.end_services()
        self._stack.close()

    def _start_devices(self) -> None:
        options = self.options
        described = find_backend(options.backend) if options.backend in SIMULATED else None
        if described is not None and "pose" in described.settings:
            self._poses = self._stack.enter_context(TemporaryFolder("poses"))
        emulator = options.emulator
        if emulator is None:
            return
        self._on_terminals = emulator.linked
        folder = self._stack.enter_context(TemporaryFolder("hands"))
        tools = {}
        for s in options.hands:
            command = emulator.command(s, folder / f"hand-{s}")
            tools[s] = self._tool(f"the emulated {s} device", [s], *command, *_object(options, s))
        for s, tool in tools.items():
            tool.wait_ready(self._stop)
            self.devices[s] = str(folder / f"hand-{s}") if emulator.linked else tool.place

    def start_services(self) -> None:
        """Start the services, without waiting for them."""
        options = self.options
        if options.backend == EXTERNAL or self._stop.is_set():
            return
        if options.backend in ROBOT_EMULATORS:
            self._services = [self._start_robot(ROBOT_EMULATORS[options.backend])]
        else:
            self._services = self._start_hands()

    def wait_ready(self) -> None:
        """Wait until the services are ready, or the run is stopped.

        :raises ConformanceError: one does not get ready.
        """
        if self._stop.is_set():
            return
        for tool in self._services:
            tool.wait_ready(self._stop)

    def _start_robot(self, emulator: str) -> Tool:
        arguments = ("emulate", emulator, *self._place_on_dds)
        return self._tool("the emulated robot", self.options.sides, *arguments)

    def _start_hands(self) -> list[Tool]:
        options = self.options
        settings = list(options.settings)
        if (emulator := options.emulator) is not None:
            given = {s.partition("=")[0] for s in settings}
            settings += [f"{k}={v}" for k, v in emulator.settings.items() if k not in given]
        return [self._serve(group, settings) for group in self._groups()]

    def end_services(self) -> bool | None:
        """Ask all services to end, at once.

        :returns: whether they did; None where there are none of the kit's.
        """
        if not self._services:
            return None
        self._ended.update(self._services)
        with ThreadPoolExecutor(len(self._services)) as pool:
            return all(pool.map(Tool.stop, self._services))

    def _groups(self) -> list[tuple[Side, ...]]:
        """The sides of each service: one service a side, or one for both on shared topics."""
        hands = self.options.hands
        topics = {self.options.dialect.topics(s) for s in hands}
        return [(s,) for s in hands] if len(topics) == len(hands) else [hands]

    @property
    def _place_on_dds(self) -> tuple[str, ...]:
        """The options for the DDS domain and interface."""
        return "--domain", str(self.options.domain), "--interface", self.options.interface

    def _serve(self, sides: Sequence[Side], settings: Sequence[str]) -> Tool:
        options = self.options
        arguments = ["serve", options.backend, "--side"]
        arguments.append(str(sides[0]) if len(sides) == 1 else "both")
        for side in sides:
            if side in self.devices:
                place = f"{side}=" if len(sides) > 1 else ""
                arguments += ["--device", f"{place}{self.devices[side]}"]
        own = list(settings)
        if options.backend in SIMULATED:
            keep = None if any(s.partition("=")[0].endswith("pose") for s in own) else self._poses
            for side in sides:
                place = f"{side}." if len(sides) > 1 else ""
                if side in options.objects:
                    own.append(f"{place}object={options.objects[side]:g}")
                if keep:  # its mechanics end with the service: the next one finds it there
                    own.append(f"{place}pose={keep / f'{side}.json'}")
        for setting in own:
            arguments += ["--set", setting]
        of = f"the {sides[0]} hand" if len(sides) == 1 else "both hands"
        return self._tool(
            f"the service of {of}",
            sides,
            *arguments,
            *("--dialect", options.dialect.name),
            *self._place_on_dds,
        )

    def _tool(self, what: str, subjects: Sequence[Subject], *arguments: str) -> Tool:
        tool = Tool(*arguments)
        self._stack.enter_context(tool)
        self.tools.append(tool)
        self._watched[tool] = Watched(what, tool.pid, tuple(subjects))
        return tool

    def watched(self) -> list[Watched]:
        """The processes that the hands or the robot consist of, as far as the kit started them."""
        found = [w for tool, w in self._watched.copy().items() if tool not in self._ended]
        if self._on_terminals:
            found.append(Watched("the kernel's terminal workers", 0, self.options.hands))
        return found

    def dead(self) -> Tool | None:
        """A process that has ended although the run did not stop it, or None."""
        return next((t for t in self.tools if not t.running and t not in self._ended), None)


def _object(options: RigOptions, side: Side) -> tuple[str, ...]:
    touch = options.objects.get(side)
    return () if touch is None else ("--set", f"object={touch:g}")

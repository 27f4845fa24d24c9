"""Run emulated Dex3-1 hands in a thread or in a child process."""

from __future__ import annotations

import contextlib
import errno
import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import IO

from dexkit.clock import Clock, RealClock
from dexkit.emulators.dex3_mcu.command import MotorCommand
from dexkit.emulators.dex3_mcu.device import Dex3Mcu
from dexkit.emulators.dex3_mcu.server import Server
from dexkit.emulators.dex3_mcu.settings import Firmware
from dexkit.emulators.dex3_mcu.usb import IN_ENDPOINT, OUT_ENDPOINT, Dex3Usb
from dexkit.emulators.dex3_mcu.wiring import Wiring
from dexkit.emulators.dex3_mechanics import Dex3Mechanics
from dexkit.emulators.faults import DEX3_FAULTS, parse_fault
from dexkit.emulators.process import EmulatorProcess
from dexkit.errors import UsageError
from dexkit.escaping import output_error
from dexkit.hand import Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import PRODUCT_ID, VENDOR_ID

__all__ = ["Dex3Hands", "Dex3Process", "emulated_dex3"]


class Dex3Hands:
    """One or two hands behind one server in a thread of this process.

    :param sides: which; the first is at bus id 1-1, the second at 1-2.
    :param serials: serial numbers in the order of ``sides``; the defaults of
        :data:`~dexkit.emulators.dex3_mcu.usb.SERIAL` where none is given.
    :param object_pct: how far the fingers close until they touch an object, percent.
    :param start: how far they are closed at first, percent; None for the pose at rest.
    :param faults: specifications, see :mod:`dexkit.emulators.faults`.
    :param wiring: of every hand; by default as dexkit assumes.
    :param log: file that gets a line of JSON for each command that drives a motor, and when the
        motor stops being driven.
    :raises EmulatorError: the port cannot be opened.
    :raises OutputError: the log cannot be written.
    :raises UsageError: an option is invalid.

    Reading a device while a client talks to it gives a snapshot only.
    """

    def __init__(
        self,
        sides: Sequence[Side] = (Side.LEFT,),
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        serials: Sequence[str] = (),
        object_pct: float | None = None,
        start: float | None = None,
        out_endpoint: int = OUT_ENDPOINT,
        in_endpoint: int = IN_ENDPOINT,
        faults: Sequence[str] = (),
        firmware: Firmware | None = None,
        wiring: Wiring | None = None,
        log: Path | None = None,
        clock: Clock | None = None,
        seed: int = 0,
    ) -> None:
        if not sides or len(set(sides)) != len(sides):
            raise UsageError("give one hand for each side, and at least one")
        if len(serials) > len(sides):
            raise UsageError(f"{len(serials)} serial numbers for {len(sides)} hand(s)")
        plan = [parse_fault(spec, DEX3_FAULTS) for spec in faults]
        clock = clock or RealClock()
        self._usb = {
            side: Dex3Usb(
                Dex3Mcu(
                    side,
                    mechanics=Dex3Mechanics(side, object_at=object_pct, start=start),
                    clock=clock,
                    firmware=firmware,
                    wiring=wiring,
                    faults=plan,
                    seed=seed + index,
                ),
                clock,
                serial=serials[index] if index < len(serials) else None,
                out_endpoint=out_endpoint,
                in_endpoint=in_endpoint,
            )
            for index, side in enumerate(sides)
        }
        self._log = None if log is None else _open_log(log)
        if self._log is not None:
            for side, usb in self._usb.items():
                usb.mcu.on_drive = partial(_write_log, self._log, side)
        self._server = Server(list(self._usb.values()), host=host, port=port, clock=clock)
        self._server.start()

    @property
    def url(self) -> str:
        """URL for drivers: ``usbip://HOST:PORT``."""
        return self._server.url

    @property
    def port(self) -> int:
        """TCP port of the server."""
        return self._server.port

    @property
    def busids(self) -> list[str]:
        """Bus id of each hand."""
        return [str(usb.device.busid) for usb in self._usb.values()]

    @property
    def ready_lines(self) -> list[str]:
        """One line for each hand: URL and serial number."""
        return [
            f"ready: {self.url} {side} {VENDOR_ID:04x}:{PRODUCT_ID[side]:04x} "
            f"serial={usb.serial} busid={usb.device.busid}"
            for side, usb in self._usb.items()
        ]

    @property
    def error(self) -> BaseException | None:
        """The error that ended the server, or None."""
        return self._server.error

    @property
    def failure(self) -> Exception | None:
        """The first exception on a client's message, which the server has survived, if any."""
        return self._server.failure

    def device(self, side: Side = Side.LEFT) -> Dex3Mcu:
        """The hand's processor."""
        return self._usb[side].mcu

    def inject(self, spec: str) -> None:
        """Inject a fault now (or at its ``@TIME`` from now)."""
        fault = parse_fault(spec, DEX3_FAULTS)
        for usb in self._usb.values():
            self._server.call(partial(usb.mcu.inject, fault))

    def summaries(self) -> list[str]:
        """The counters of each hand."""
        return [
            f"{side}: {usb.mcu.counters.summary() or 'nothing was sent'}"
            for side, usb in self._usb.items()
        ]

    def close(self) -> None:
        """Disconnect clients and free the port. May be called twice."""
        self._server.close()
        if self._log is not None:
            self._log.close()

    def __enter__(self) -> Dex3Hands:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _open_log(path: Path) -> IO[str]:
    try:
        return path.open("w", encoding="utf-8")
    except (OSError, ValueError) as error:
        found = error if isinstance(error, OSError) else OSError(errno.EINVAL, str(error))
        raise output_error(path, found) from error


def _write_log(
    log: IO[str], side: Side, now: float, joint: int, command: MotorCommand | None
) -> None:
    line: dict[str, object] = {"t": round(now, 6), "side": str(side), "motor": joint}
    line["joint"] = DEX3_1.joints[side][joint].name
    if command is None:
        line["driven"] = False
    else:
        values = zip(("q", "dq", "tau", "kp", "kd"), command[3:], strict=True)
        line |= {"driven": True, "protected": command[2]}
        line |= {name: round(value, 5) for name, value in values}
    # whoever reads it while the hand runs gets whole lines
    log.write(json.dumps(line) + "\n")
    log.flush()


class Dex3Process(EmulatorProcess):
    """``dexkit emulate dex3-usb`` in its own process.

    :param arguments: of that command.
    :raises EmulatorError: it did not become ready.

    :ivar url: what a driver opens.
    """

    def __init__(self, arguments: Sequence[str], *, timeout: float = 20.0) -> None:
        super().__init__("dex3-usb", arguments, DEX3_FAULTS, timeout=timeout)
        self.url = self.ready_line.split()[1]

    @property
    def port(self) -> int:
        """TCP port of the server."""
        return int(self.url.rsplit(":", 1)[1])


@contextlib.contextmanager
def emulated_dex3(
    sides: Sequence[Side] = (Side.LEFT,),
    *,
    process: bool = False,
    object_pct: float | None = None,
    serials: Sequence[str] = (),
    port: int = 0,
    out_endpoint: int = OUT_ENDPOINT,
    in_endpoint: int = IN_ENDPOINT,
    faults: Sequence[str] = (),
    firmware: Firmware | None = None,
) -> Iterator[Dex3Hands | Dex3Process]:
    """Emulated Dex3-1 hands at ``.url``, that take faults by ``.inject``.

    :param process: run them as ``dexkit emulate dex3-usb`` in a process of its own instead of a
        thread of this one. A client in the same process competes with the thread for the
        interpreter, so rates are measured against a process; a thread's hands can be looked into
        (``.device(side)``).
    :param firmware: only in a thread.

    The other parameters are those of :class:`Dex3Hands`.

    :raises EmulatorError: it did not become ready.
    :raises UsageError: an option is invalid.
    """
    hands: Dex3Hands | Dex3Process
    if process:
        if firmware is not None:
            raise UsageError("firmware can be given to a thread only")
        hands = Dex3Process(
            [
                f"--side={sides[0] if len(sides) == 1 else 'both'}",
                f"--link=usbip://127.0.0.1:{port}",
                f"--set=out-endpoint={out_endpoint}",
                f"--set=in-endpoint={in_endpoint}",
                *([f"--set=serial={','.join(serials)}"] if serials else []),
                *(f"--fault={spec}" for spec in faults),
                *([] if object_pct is None else [f"--set=object={object_pct:g}"]),
            ]
        )
    else:
        hands = Dex3Hands(
            sides,
            port=port,
            serials=serials,
            object_pct=object_pct,
            out_endpoint=out_endpoint,
            in_endpoint=in_endpoint,
            faults=faults,
            firmware=firmware,
        )
    try:
        yield hands
    finally:
        hands.close()

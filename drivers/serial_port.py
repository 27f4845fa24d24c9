"""What drivers on a serial port share: finding it, and one meaning for its many failures."""

from __future__ import annotations

import errno
import math
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import serial
from serial.tools import list_ports

from dexkit.errors import HandLost, HandNotFound, HandRefused, HandTimeout

__all__ = [
    "Device",
    "exchange_period",
    "find_device",
    "latency_timer",
    "latency_warning",
    "open_failed",
    "port_errors",
]


@dataclass(frozen=True)
class Device:
    """A serial port.

    :param path: as given, or as the system names it.
    :param serial_number: of the USB adapter, or None where there is none (a pseudo-terminal).
    """

    path: str
    serial_number: str | None

    @property
    def key(self) -> str:
        """What names this device in the configuration file."""
        return self.serial_number or self.path


def find_device(name: str) -> Device:
    """The port that is meant by a device path or a USB serial number.

    :raises HandNotFound: there is no such port; names those that there are.
    """
    ports = list_ports.comports()
    path = Path(name)
    if "/" in name or path.exists():
        # /dev/serial/by-id/... and other links lead to the name that the system lists
        resolved = str(path.resolve())
        for port in ports:
            if port.device in (name, resolved):
                return Device(name, port.serial_number)
        if not path.exists():
            raise HandNotFound(f"there is no device {name}", hint=_known(ports))
        return Device(str(path.absolute()), None)
    matches = [port for port in ports if port.serial_number == name]
    if len(matches) == 1:
        return Device(matches[0].device, name)
    if matches:
        found = ", ".join(port.device for port in matches)
        raise HandNotFound(
            f"serial number {name} is that of more than one port: {found}", hint="give the path"
        )
    raise HandNotFound(f"no adapter has the serial number {name}", hint=_known(ports))


def _known(ports: list[list_ports.ListPortInfo]) -> str:  # type: ignore[name-defined]
    if not ports:
        return "there are no serial ports at all: is the adapter plugged in?"
    listed = ", ".join(
        f"{port.device} (serial number {port.serial_number or 'none'})" for port in ports
    )
    return f"there are: {listed}"


def latency_timer(path: str, sysfs: Path = Path("/sys")) -> int | None:
    """Milliseconds of the latency timer of a USB-serial adapter, or None where it has none."""
    name = Path(path).resolve().name
    try:
        return int((sysfs / "bus/usb-serial/devices" / name / "latency_timer").read_text())
    except (OSError, ValueError):
        return None


def exchange_period(line_time: float, latency_timer: float, turnaround: float = 0.0) -> float:
    """Seconds from one exchange to the next of a host that asks again as soon as it can.

    The latency timer runs freely: the adapter hands over what has come at the ticks ``k * T`` of
    its timer, whenever that came. So a host gets an answer at a tick; call it 0. The host sends
    the next request at ``h`` (turnaround), the answer is complete at ``h + t`` (line time), and is
    handed over at the first tick that is not earlier::

        period = ceil((h + t) / T) * T          T > 0
        period = h + t                          no timer

    That is a tick again, so every following period is the same. It grows with ``h``: with
    ``h = 0`` it is the shortest that the line allows, and 1 / period an upper bound of the rate
    whatever the host. It is shorter than ``h + t + T``, what an exchange takes at most that begins
    at any moment. Of the first exchange nothing is known but ``t``, so ``n`` in a row take
    ``t + (n - 1) * period`` at least.

    It holds for one answer in an exchange that fits into one USB packet (62 bytes of an FTDI
    chip: a full packet leaves at once). ``tests/test_line_time.py`` compares it with the
    emulated line.

    :param line_time: seconds from the first bit of the request to the last of the answer: the
        bytes at the baud rate, and what the device waits before it answers.
    :param latency_timer: seconds; 0 for an adapter without one.
    :param turnaround: seconds that the host needs from an answer to the next request.
    """
    busy = line_time + turnaround
    if latency_timer <= 0:
        return busy
    # a multiple of the timer may come out a rounding error above itself
    return max(1, math.ceil(busy / latency_timer - 1e-9)) * latency_timer


def latency_warning(path: str, sysfs: Path = Path("/sys")) -> str:
    """What to tell the user of the latency timer, or an empty text when it is well set.

    An FTDI chip holds a short answer back until the next tick of its timer; at the usual 16 ms
    that leaves 62 exchanges a second at most (docs/sources/mx64-ezgripper.md#c2). Nothing is
    changed here.
    """
    milliseconds = latency_timer(path, sysfs)
    if milliseconds is None or milliseconds <= 1:
        return ""
    name = Path(path).resolve().name
    return (
        f"the latency timer of {path} is {milliseconds} ms, which allows at most "
        f"{1000 // milliseconds} exchanges a second; set it to 1 ms: "
        f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer, or for good with "
        'the udev rule: ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", '
        'ATTR{latency_timer}="1"'
    )


@contextmanager
def port_errors(path: str) -> Iterator[None]:
    """One exception for the many faces of an unplugged adapter."""
    try:
        yield
    except (serial.SerialException, termios.error) as error:
        raise HandLost(
            f"the port {path} has gone away: {error}", hint="check the cable and the power"
        ) from error
    except OSError as error:
        if isinstance(error, HandLost | HandTimeout):
            raise
        raise HandLost(
            f"the port {path} has gone away: {error}", hint="check the cable and the power"
        ) from error


def open_failed(path: str, error: Exception) -> Exception:
    """What pyserial's failure to open a port means."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return HandNotFound(
            f"there is no device {path}",
            hint="is it plugged in? 'python -m serial.tools.list_ports -v' lists the adapters",
        )
    if number in (errno.EACCES, errno.EPERM):
        return HandNotFound(
            f"no permission to open {path}",
            hint="add yourself to the group of the device: sudo usermod -a -G dialout $USER, "
            "then log in again",
        )
    if number in (errno.EBUSY, errno.EWOULDBLOCK) or "exclusively lock" in str(error):
        return HandRefused(
            f"another program is using {path}",
            hint="stop it first (lsof or fuser on the device names it); a line has one master",
        )
    # pyserial wraps a failing tcgetattr without its number
    if number in (errno.ENOTTY, errno.EINVAL, errno.EISDIR) or "configure port" in str(error):
        return HandNotFound(f"{path} is not a serial port: {error}")
    return HandLost(f"cannot open {path}: {error}", hint="check the cable and the power")

"""Find serial ports and translate pyserial's errors, for the drivers on a serial port."""

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
    "is_pseudo_terminal",
    "latency_timer",
    "latency_warning",
    "open_failed",
    "port_errors",
]


@dataclass(frozen=True)
class Device:
    """A serial port.

    :param path: path as given, or as the system lists it.
    :param serial_number: serial number of the USB adapter; None without one (a pseudo-terminal).
    """

    path: str
    serial_number: str | None

    @property
    def key(self) -> str:
        """Key of this device in the calibration file."""
        return self.serial_number or self.path


def find_device(name: str) -> Device:
    """Find a port by its device path or USB serial number.

    :raises HandNotFound: there is no such port; the hint lists the ports.
    """
    ports = list_ports.comports()
    path = Path(name)
    if "/" in name or path.exists():
        # /dev/serial/by-id/... and other links resolve to the name that the system lists
        resolved = str(path.resolve())
        for port in ports:
            if port.device in (name, resolved):
                return Device(name, port.serial_number)
        if not path.exists():
            raise HandNotFound(f"there is no device {name}", hint=_list_known_ports(ports))
        return Device(str(path.absolute()), None)
    matches = [port for port in ports if port.serial_number == name]
    if len(matches) == 1:
        return Device(matches[0].device, name)
    if matches:
        found = ", ".join(port.device for port in matches)
        raise HandNotFound(
            f"serial number {name} is that of more than one port: {found}", hint="give the path"
        )
    raise HandNotFound(f"no adapter has the serial number {name}", hint=_list_known_ports(ports))


def is_pseudo_terminal(path: str) -> bool:
    """Whether a port is a pseudo-terminal, which only emulated devices have."""
    return str(Path(path).resolve()).startswith("/dev/pts/")


def _list_known_ports(ports: list[list_ports.ListPortInfo]) -> str:  # type: ignore[name-defined]
    if not ports:
        return "there are no serial ports at all: is the adapter plugged in?"
    listed = ", ".join(
        f"{port.device} (serial number {port.serial_number or 'none'})" for port in ports
    )
    return f"there are: {listed}"


def latency_timer(path: str, sysfs: Path = Path("/sys")) -> int | None:
    """Read the latency timer of a USB-serial adapter, ms; None if it has none."""
    name = Path(path).resolve().name
    try:
        return int((sysfs / "bus/usb-serial/devices" / name / "latency_timer").read_text())
    except (OSError, ValueError):
        return None


def exchange_period(line_time: float, latency_timer: float, turnaround: float = 0.0) -> float:
    """Return the period of back-to-back exchanges through a USB-serial adapter, seconds.

    The latency timer runs freely: the adapter delivers received bytes at the ticks ``k * T`` of its
    timer. So a host gets an answer at a tick; call it 0. The host sends the next request at ``h``
    (turnaround), the answer is complete at ``h + t`` (line time), and the adapter delivers it at
    the first tick that is not earlier::

        period = ceil((h + t) / T) * T          T > 0
        period = h + t                          no timer

    That is a tick again, so all following periods are equal. The period grows with ``h``; with
    ``h = 0``, 1 / period is an upper bound of the rate for any host. An exchange that begins at any
    time takes at most ``h + t + T``. The first exchange takes at least ``t``, so ``n`` in a row
    take at least ``t + (n - 1) * period``.

    This holds for one answer per exchange that fits into one USB packet (62 bytes of an FTDI chip,
    which sends a full packet at once). ``tests/test_line_time.py`` compares it with the emulated
    line.

    :param line_time: seconds from the first bit of the request to the last of the answer: the bytes
        at the baud rate, and the device's return delay.
    :param latency_timer: seconds; 0 for an adapter without one.
    :param turnaround: seconds from an answer to the host's next request.
    """
    busy = line_time + turnaround
    if latency_timer <= 0:
        return busy
    # rounding must not turn an exact multiple of the timer into the next one
    return max(1, math.ceil(busy / latency_timer - 1e-9)) * latency_timer


def latency_warning(path: str, sysfs: Path = Path("/sys")) -> str:
    """Return a warning for a latency timer above 1 ms; empty if the timer is well set.

    An FTDI chip delays a short answer until the next tick of its timer; the default of 16 ms allows
    at most 62 exchanges a second (docs/sources/mx64-ezgripper.md#c2). The setting is not changed.
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
    """Raise ``HandLost`` for each of the exceptions with which pyserial reports a lost adapter."""
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
    """Translate pyserial's failure to open a port to an error of dexkit."""
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

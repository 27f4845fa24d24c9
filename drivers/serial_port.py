"""What drivers on a serial port share: finding it, and one meaning for its many failures."""

from __future__ import annotations

import errno
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


def latency_warning(path: str, sysfs: Path = Path("/sys")) -> str:
    """What to tell the user of the latency timer, or an empty text when it is well set.

    An FTDI chip holds a short answer back until its timer ends; at the usual 16 ms that leaves
    some 60 exchanges a second (facts/mx64 C2). Nothing is changed here.
    """
    milliseconds = latency_timer(path, sysfs)
    if milliseconds is None or milliseconds <= 1:
        return ""
    name = Path(path).resolve().name
    return (
        f"the latency timer of {path} is {milliseconds} ms, which allows about "
        f"{1000 // (milliseconds + 1)} exchanges a second; set it to 1 ms: "
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

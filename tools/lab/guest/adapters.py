"""The emulated USB-serial adapters, as the guest's kernel has them."""

from __future__ import annotations

from pathlib import Path

from tools.lab.guest.bench import Bench, attach, detach, wait_for

__all__ = ["Adapters"]

_BUSID = {"mx64": "1-1", "dex1": "1-2"}
_SERIAL = {"mx64": "DKLAB001", "dex1": "DKLAB002"}  # of tools.lab.devices
_PORTS = Path("/sys/bus/usb-serial/devices")


class Adapters:
    """Plugs them in and out. A device is ``mx64`` or ``dex1``."""

    def __init__(self, bench: Bench) -> None:
        self._server = bench.words["adapters"]
        self._places: dict[str, int] = {}

    def plug(self, device: str) -> str:
        """Attach a device's adapter; its port's path, once it is there."""
        self._places[device] = attach(self._server, _BUSID[device])
        wait_for(lambda: self.path(device), f"no port for the {device}'s adapter")
        return self.path(device)

    def unplug(self, device: str) -> None:
        """Pull its cable."""
        detach(self._places.pop(device))

    def replug(self, device: str) -> str:
        """Pull its cable and plug it in again; its port's path."""
        self.unplug(device)
        return self.plug(device)

    def close(self) -> None:
        """Unplug all of them."""
        for device in list(self._places):
            self.unplug(device)

    def serial(self, device: str) -> str:
        """The adapter's serial number."""
        return _SERIAL[device]

    def path(self, device: str) -> str:
        """The path of its port; empty while there is none."""
        for port in _PORTS.glob("ttyUSB*"):
            try:
                number = (port.resolve().parents[1] / "serial").read_text().strip()
            except OSError:  # it has just gone
                continue
            node = Path("/dev") / port.name
            if number == _SERIAL[device] and node.exists():
                return str(node)
        return ""

    def interface(self, device: str) -> Path:
        """The kernel's folder of its USB interface."""
        return (_PORTS / Path(self.path(device)).name).resolve().parent

    def set_timer(self, device: str, milliseconds: int) -> None:
        """Set its latency timer."""
        name = Path(self.path(device)).name
        (_PORTS / name / "latency_timer").write_text(str(milliseconds))

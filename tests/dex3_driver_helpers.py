"""Devices on USB/IP whose answers a test writes, and a backend that raises what libusb raises."""

from __future__ import annotations

import errno
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import usb.backend
from usb.core import USBError
from usbip.core import SPEED_HIGH
from usbip.device import In, Out, USBDevice
from usbip.function import Interface

from dexkit.emulators.dex3_mcu.server import Server
from dexkit.hand import HandState, JointMode, MotorError, Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import (
    DEFAULT_BUS_MAP,
    MANUFACTURER,
    PRODUCT,
    PRODUCT_ID,
    VENDOR_ID,
    HandCodec,
)

Answer = list[tuple[float, bytes]]
"""What a device sends after a command: (seconds later, bytes)."""


class RawDevice:
    """A USB device with two bulk endpoints; ``script`` says what it answers."""

    def __init__(
        self,
        script: Callable[[bytes], Answer],
        *,
        side: Side = Side.LEFT,
        serial: str | None = "SN1",
        vendor: int = VENDOR_ID,
        endpoints: tuple[int, int] = (0x02, 0x81),
    ) -> None:
        class Pipes(Interface):
            out = Out(endpoints[0], "bulk", mps=512)
            into = In(endpoints[1], "bulk", mps=512)

            def on_out(pipes, endpoint: Any, data: bytes) -> None:  # noqa: N805
                self._received(bytes(data))

        self.script = script
        self.received: list[bytes] = []
        self.plugged = True
        self.attachments = 0
        self.device = USBDevice(
            vendor,
            PRODUCT_ID[side],
            manufacturer=MANUFACTURER,
            product=PRODUCT[side],
            serial=serial,
        )
        self.device.set_speed(SPEED_HIGH)
        self.pipes = Pipes()
        self.device.add(self.pipes)
        self._due: Answer = []

    def _received(self, data: bytes) -> None:
        self.received.append(data)
        now = time.monotonic()
        for late, answer in self.script(data):
            if late or self._due:  # answers keep their order
                due = max(now + late, self._due[-1][0]) if self._due else now + late
                self._due.append((due, answer))
            else:
                self.pipes.into.write(answer)

    def advance(self) -> float | None:
        now = time.monotonic()
        for entry in [e for e in self._due if e[0] <= now]:
            self._due.remove(entry)
            self.pipes.into.write(entry[1])
        return min((at for at, _ in self._due), default=None)

    def attached(self) -> None:
        self.attachments += 1
        self.device.reset_io()


@contextmanager
def serving(*devices: RawDevice) -> Iterator[Server]:
    """A USB/IP server with these devices, in a thread."""
    with Server(devices, port=0) as server:
        server.start()
        yield server
    assert server.error is None


class FakeHand:
    """Answers each command with a state whose first q counts the commands, for :class:`RawDevice`.

    :ivar tripped: the motors report that their protection tripped.
    :ivar silent: motors that do not answer.
    """

    def __init__(self, side: Side = Side.LEFT) -> None:
        self.codec = HandCodec(DEX3_1.joints[side], DEFAULT_BUS_MAP)
        self.n = len(DEX3_1.joints[side])
        self.count = 0
        self.tripped = np.zeros(self.n, np.bool_)
        self.fault = np.zeros(self.n, np.uint32)
        self.silent: Sequence[int] = ()
        self.spoil: Callable[[bytes], bytes] = lambda answer: answer

    def q(self, count: int) -> float:
        return round(-0.5 + count * 0.01, 2)

    def state(self) -> bytes:
        self.count += 1
        q = np.full(self.n, 0.1)
        q[0] = self.q(self.count)
        bits = np.where(self.tripped, int(MotorError.MOTOR_SAW_HOST_TIMEOUT), 0)
        state = HandState.from_values(
            q,
            stamp=0.0,
            temperature=30.0,
            voltage=24.0,
            mode=[JointMode.FOC] * self.n,
            fault=[int(b) for b in (bits | self.fault)],
            pressure=np.full((9, 12), np.nan),
            sensor_temperature=np.full((9, 12), 25.0),
        )
        motors = [i for i in range(self.n) if i not in self.silent]
        return self.spoil(self.codec.encode_state(state, motors=motors))

    def __call__(self, data: bytes) -> Answer:
        return [(0.0, self.state())]


class FakeBackend(usb.backend.IBackend):  # type: ignore[misc]
    """A PyUSB backend over no USB: one device, every call noted, any call may be made to fail.

    :ivar fail: what a call raises, by its name.
    """

    def __init__(self, script: Callable[[bytes], Answer]) -> None:
        self.script = script
        self.fail: dict[str, BaseException] = {}
        self.calls: list[str] = []
        self.kernel_driver = False
        self.configuration = 1
        self.serial = "SN1"
        self.pending: list[bytes] = []
        self.endpoints = [(0x83, 3), (0x02, 2), (0x81, 2), (0x04, 2), (0x85, 2)]

    def _call(self, name: str) -> None:
        self.calls.append(name)
        if name in self.fail:
            raise self.fail[name]

    def enumerate_devices(self) -> list[str]:
        return ["device"]

    def get_device_descriptor(self, dev: Any) -> Any:
        return SimpleNamespace(
            idVendor=VENDOR_ID, idProduct=PRODUCT_ID[Side.LEFT], bus=1, address=8
        )

    def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> Any:
        return SimpleNamespace(bNumEndpoints=len(self.endpoints))

    def get_endpoint_descriptor(self, dev: Any, ep: int, intf: int, alt: int, config: int) -> Any:
        address, attributes = self.endpoints[ep]
        return SimpleNamespace(bEndpointAddress=address, bmAttributes=attributes)

    def open_device(self, dev: Any) -> str:
        self._call("open_device")
        return "handle"

    def close_device(self, dev_handle: Any) -> None:
        self._call("close_device")

    def get_configuration(self, dev_handle: Any) -> int:
        self._call("get_configuration")
        return self.configuration

    def set_configuration(self, dev_handle: Any, config_value: int) -> None:
        self._call("set_configuration")
        self.configuration = config_value

    def claim_interface(self, dev_handle: Any, intf: int) -> None:
        self._call("claim_interface")

    def release_interface(self, dev_handle: Any, intf: int) -> None:
        self._call("release_interface")

    def is_kernel_driver_active(self, dev_handle: Any, intf: int) -> bool:
        self._call("is_kernel_driver_active")
        return self.kernel_driver

    def detach_kernel_driver(self, dev_handle: Any, intf: int) -> None:
        self._call("detach_kernel_driver")
        self.kernel_driver = False

    def attach_kernel_driver(self, dev_handle: Any, intf: int) -> None:
        self._call("attach_kernel_driver")
        self.kernel_driver = True

    def clear_halt(self, dev_handle: Any, ep: int) -> None:
        self._call("clear_halt")

    def ctrl_transfer(
        self,
        dev_handle: Any,
        bmRequestType: int,  # noqa: N803
        bRequest: int,  # noqa: N803
        wValue: int,  # noqa: N803
        wIndex: int,  # noqa: N803
        data: Any,
        timeout: int,
    ) -> int:
        self._call("ctrl_transfer")
        text = self.serial.encode("utf-16-le")
        answers = {
            0x0100: bytes(16) + b"\x03\x01",
            0x0300: b"\x04\x03\x09\x04",
            0x0303: bytes([len(text) + 2, 3]) + text,
        }
        answer = answers[wValue]
        data[: len(answer)] = array("B", answer)
        return len(answer)

    def bulk_write(self, dev_handle: Any, ep: int, intf: int, data: Any, timeout: int) -> int:
        self._call("bulk_write")
        assert timeout >= 1
        assert ep == 0x02
        self.pending += [answer for _, answer in self.script(data.tobytes())]
        return len(data)

    def bulk_read(self, dev_handle: Any, ep: int, intf: int, buff: Any, timeout: int) -> int:
        assert timeout >= 1
        assert ep == 0x81
        if not self.pending:  # as libusb: USBTimeoutError is a USBError
            raise usb_error(errno.ETIMEDOUT)
        self._call("bulk_read")
        answer = self.pending.pop(0)
        if len(answer) > len(buff):
            raise usb_error(errno.EOVERFLOW)
        buff[: len(answer)] = array("B", answer)
        return len(answer)


def usb_error(number: int) -> USBError:
    """As PyUSB's libusb backend makes it."""
    from usb.backend import libusb1
    from usb.core import USBTimeoutError

    for code, found in libusb1._libusb_errno.items():
        if found == number:
            kind = USBTimeoutError if number == errno.ETIMEDOUT else USBError
            return kind(libusb1._str_error_map[code], code, number)
    raise AssertionError(f"libusb has no {number}")

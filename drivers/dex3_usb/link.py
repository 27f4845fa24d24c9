"""Exchange frames with a Dex3-1 on its USB bulk endpoints: one OUT transfer, one IN transfer.

It calls PyUSB's backend interface (:class:`usb.backend.IBackend`) directly, because
:class:`usb.core.Device` repeats checks in each ``write`` and ``read`` (about a fifth of the
processor time of an exchange). This module alone translates errors of libusb and of the USB/IP
client to :class:`~dexkit.errors.HandError`.
"""

from __future__ import annotations

import array
import errno
import logging
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from dexkit.command_age import WriteDeadline
from dexkit.errors import HandError, HandLost, HandRefused, HandTimeout

__all__ = ["Backend", "Endpoints", "LinkStatistics", "UsbLink", "hand_error", "read_serial"]

log = logging.getLogger(__name__)

Backend: TypeAlias = Any
"""A :class:`usb.backend.IBackend`; PyUSB has no types."""

_INTERFACE = 0
_BULK, _TYPE_MASK, _DIRECTION_IN = 0x02, 0x03, 0x80
_ANSWER_BUFFER_SIZE = 2048
"""Bytes of an IN transfer: more than an answer has (1270), in whole packets of 512, so that an
answer that is too long is received and rejected by its length instead of as a USB overflow."""
_STRING_TIMEOUT = 500  # ms
_DRAIN_TIMEOUT = 1  # ms: the shortest that libusb supports (0 means no time-out)
_LATE_ANSWER_WAIT = 0.02
"""Seconds to wait for a late answer after a time-out, before the next command is sent."""
_LATE_ANSWER_WATCH = 0.5
"""Seconds after a time-out in which each exchange checks for a second, newer answer."""

UDEV_RULE = "packaging/70-dexkit-dex3.rules"
UDEV_HINT = (
    "install the udev rule and plug the hand in again: sudo cp "
    f"{UDEV_RULE} /etc/udev/rules.d/ && sudo udevadm control --reload && sudo udevadm trigger"
    " (or, without the file, see docs/dex3-usb.md)"
)

_LOST_ERRNOS = frozenset(
    {
        errno.ENODEV,
        errno.ENOENT,
        errno.ENXIO,
        errno.EIO,  # a cable pulled during a transfer
        errno.EPROTO,
        errno.ESHUTDOWN,
        errno.ECONNREFUSED,
        errno.ECONNRESET,
        errno.ECONNABORTED,
        errno.EHOSTUNREACH,
        errno.ENETUNREACH,
    }
)
_TIMEOUT_ERRNOS = frozenset({errno.ETIMEDOUT, errno.EINTR, errno.EAGAIN})


def hand_error(error: Exception, what: str) -> HandError:
    """Translate a :class:`usb.core.USBError` or another :class:`OSError` to an error of the hand.

    :param what: the operation, for the message: ``"opening the left hand"``.
    """
    number = error.errno if isinstance(error, OSError) else None
    text = f"{what}: {error.strerror or error if isinstance(error, OSError) else error}"
    if number in (errno.EACCES, errno.EPERM):
        return HandRefused(f"{what}: no permission to use the USB device", hint=UDEV_HINT)
    if number == errno.EBUSY:
        return HandRefused(
            f"{what}: another program holds its USB interface",
            hint="another dexkit, the vendor's hand service, or a virtual machine that took the "
            "device over? See: sudo lsof /dev/bus/usb/*/*; over USB/IP: another client of its "
            "server",
        )
    if number in _TIMEOUT_ERRNOS or isinstance(error, TimeoutError):
        return HandTimeout(text)
    if number in _LOST_ERRNOS or isinstance(error, ConnectionError):
        return HandLost(text, hint="is the hand plugged in and powered?")
    return HandError(text)


@dataclass(frozen=True)
class Endpoints:
    """Addresses of the bulk endpoints; bit 7 is set in the one that the host reads."""

    out: int
    into: int


@dataclass
class LinkStatistics:
    """Counters of a link since it was opened.

    :ivar exchanges: answers received, intact or not.
    :ivar timeouts: commands without an answer in time.
    :ivar late: answers that came after their time-out and were discarded.
    :ivar stalls: endpoint halts that were cleared.
    """

    exchanges: int = 0
    timeouts: int = 0
    late: int = 0
    stalls: int = 0


class UsbLink:
    """An open USB device whose interface 0 is claimed.

    :param backend: PyUSB backend.
    :param device: one of the backend's devices.
    :param name: for messages.
    :param out_endpoint: address; None for the first bulk OUT endpoint of the interface.
    :param in_endpoint: likewise IN.
    :raises HandRefused: no permission, another program uses it, no such endpoints.
    :raises HandLost, HandTimeout: it goes away or does not answer while it is opened.
    """

    def __init__(
        self,
        backend: Backend,
        device: Any,
        name: str,
        *,
        out_endpoint: int | None = None,
        in_endpoint: int | None = None,
    ) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self._backend = backend
        self._handle: Any = None
        self._claimed = self._detached = False
        self._drain_first = True  # the last host may have left an unread answer
        self._pending_answers = 0  # answers that timed out and may still arrive
        self._watch_until = 0.0
        self._passed_over = 0  # late answers that the USB/IP client has dropped itself
        self._buffer = array.array("B", bytes(_ANSWER_BUFFER_SIZE))
        self._exchange = getattr(backend, "exchange", None)
        try:
            self._handle = backend.open_device(device)
            self._claim_interface()
            self.endpoints = _find_endpoints(backend, device, name, out_endpoint, in_endpoint)
            self.serial = _read_serial_or_empty(backend, self._handle)
        except (OSError, NotImplementedError) as error:
            self.close()
            raise hand_error(error, f"opening {name}") from error
        except BaseException:
            self.close()
            raise

    def _claim_interface(self) -> None:
        backend, handle = self._backend, self._handle
        if _has_kernel_driver(backend, handle):
            backend.detach_kernel_driver(handle, _INTERFACE)
            self._detached = True
        if not backend.get_configuration(handle):
            # only if needed: setting it resets the device's endpoints and data toggles
            backend.set_configuration(handle, 1)
        backend.claim_interface(handle, _INTERFACE)
        self._claimed = True

    def close(self) -> None:
        """Release the interface and close the device. May be called twice."""
        handle, self._handle = self._handle, None
        if handle is None:
            return
        steps: list[tuple[Callable[..., object], tuple[Any, ...]]] = []
        if self._claimed:
            steps.append((self._backend.release_interface, (handle, _INTERFACE)))
        if self._detached:
            steps.append((self._backend.attach_kernel_driver, (handle, _INTERFACE)))
        steps.append((self._backend.close_device, (handle,)))
        for step, arguments in steps:
            try:
                step(*arguments)
            except (OSError, NotImplementedError) as error:  # a device that is gone
                log.debug("closing %s: %s", self.name, error)

    def exchange(
        self,
        data: bytes,
        send_timeout: float,
        timeout: float,
        before: WriteDeadline | None = None,
    ) -> bytes:
        """Send one command frame and return the answer.

        :param data: a whole command frame.
        :param send_timeout: seconds that the device may take to accept it.
        :param timeout: seconds until the answer.
        :param before: checked right before the frame is sent.
        :raises HandTimeout: no answer in time, a stalled endpoint, which was cleared, or
            ``before`` raises it.
        :raises HandLost: the device has gone away.
        :raises HandRefused, HandError: any other error of libusb.
        """
        if self._handle is None:
            raise HandLost(f"not connected to {self.name}", hint="call open() first")
        if self._drain_first:
            self._wait_for_late()
        if before is not None:
            before.check()
        try:
            answer = self._transfer(data, send_timeout, timeout)
        except HandError:
            raise
        except BaseException:  # Ctrl-C, perhaps between the command and its answer
            self._expect_late()
            raise
        if self._pending_answers:
            self._count_dropped_answers()
            answer = self._newest_answer(answer)
        self.statistics.exchanges += 1
        return answer

    def resynchronise(self) -> None:
        """Discard pending data of the device before the next command."""
        self._drain_first = True

    # -- details

    def _transfer(self, data: bytes, send_timeout: float, timeout: float) -> bytes:
        endpoints = self.endpoints
        endpoint = endpoints.out
        try:
            if self._exchange is not None:
                answer: bytes = self._exchange(
                    self._handle,
                    endpoints.out,
                    data,
                    endpoints.into,
                    _ANSWER_BUFFER_SIZE,
                    _milliseconds(send_timeout),
                    _milliseconds(timeout),
                )
                return answer
            count = self._backend.bulk_write(
                self._handle,
                endpoint,
                _INTERFACE,
                array.array("B", data),
                _milliseconds(send_timeout),
            )
            if count != len(data):
                raise self._late_answer_error(f"took {count} of the {len(data)} bytes of a command")
            endpoint = endpoints.into
            return self._read(_milliseconds(timeout))
        except HandError:  # HandTimeout is an OSError too
            raise
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise self._clear_stall(getattr(error, "endpoint", endpoint)) from error
            raise self._exchange_error(error) from error

    def _read(self, timeout: int) -> bytes:
        count = self._backend.bulk_read(
            self._handle, self.endpoints.into, _INTERFACE, self._buffer, timeout
        )
        return self._buffer[:count].tobytes()

    def _wait_for_late(self) -> None:
        self._drain_first = False
        deadline = time.monotonic() + _LATE_ANSWER_WAIT
        while (
            self._read_late() is not None or self._pending_answers
        ) and time.monotonic() < deadline:
            pass

    def _newest_answer(self, answer: bytes) -> bytes:
        """Return ``answer``, or a newer one: then ``answer`` belonged to an earlier command."""
        while self._pending_answers and (following := self._read_late()) is not None:
            answer = following
        if time.monotonic() > self._watch_until:
            self._pending_answers = 0  # they were lost
        return answer

    def _read_late(self) -> bytes | None:
        try:
            data = self._read(_DRAIN_TIMEOUT)
        except OSError as error:
            if error.errno in _TIMEOUT_ERRNOS:
                self._count_dropped_answers()
                return None
            raise self._exchange_error(error) from error
        self._count_late(1)
        return data

    def _count_dropped_answers(self) -> None:
        """Count answers that the USB/IP client dropped because they arrived after an unlink."""
        before, self._passed_over = self._passed_over, getattr(self._handle, "passed_over", 0)
        self._count_late(self._passed_over - before)

    def _count_late(self, count: int) -> None:
        self.statistics.late += count
        self._pending_answers = max(0, self._pending_answers - count)

    def _late_answer_error(self, what: str) -> HandTimeout:
        self.statistics.timeouts += 1
        self._expect_late()
        return HandTimeout(f"{self.name} {what}")

    def _expect_late(self) -> None:
        """Note that an answer may still arrive. Answers arrive in order and do not name their
        command, so one late answer would shift all later ones by one command.
        """
        self._drain_first = True
        self._pending_answers += 1
        self._watch_until = time.monotonic() + _LATE_ANSWER_WATCH

    def _exchange_error(self, error: OSError) -> HandError:
        translated = hand_error(error, f"exchanging with {self.name}")
        if isinstance(translated, HandTimeout):
            return self._late_answer_error("does not answer")
        return translated

    def _clear_stall(self, endpoint: int) -> HandError:
        name = "IN" if endpoint & _DIRECTION_IN else "OUT"
        try:
            self._backend.clear_halt(self._handle, endpoint)
        except OSError as error:
            return hand_error(error, f"clearing the stalled {name} endpoint of {self.name}")
        self.statistics.stalls += 1
        self._expect_late()
        return HandTimeout(f"{self.name} stalled its {name} endpoint {endpoint:#04x}; cleared")


def _milliseconds(seconds: float) -> int:
    return max(1, round(seconds * 1000))  # 0 would mean no time-out


def _read_serial_or_empty(backend: Backend, handle: Any) -> str:
    try:
        return read_serial(backend, handle)
    except (OSError, NotImplementedError) as error:
        log.debug("no serial number: %s", error)  # it is not needed to drive the hand
        return ""


def _has_kernel_driver(backend: Backend, handle: Any) -> bool:
    try:
        return bool(backend.is_kernel_driver_active(handle, _INTERFACE))
    except NotImplementedError:  # the operating system has no such call
        return False


def _find_endpoints(
    backend: Backend, device: Any, name: str, out: int | None, into: int | None
) -> Endpoints:
    """Find the first bulk endpoints of interface 0; the manual does not give their addresses
    (docs/sources/unitree-dex.md#c1).
    """
    interface = backend.get_interface_descriptor(device, _INTERFACE, 0, 0)
    found = [
        backend.get_endpoint_descriptor(device, index, _INTERFACE, 0, 0)
        for index in range(interface.bNumEndpoints)
    ]
    bulk = [e.bEndpointAddress for e in found if e.bmAttributes & _TYPE_MASK == _BULK]
    for direction, chosen in ((0, out), (_DIRECTION_IN, into)):
        if chosen is not None and (chosen not in bulk or chosen & _DIRECTION_IN != direction):
            raise HandRefused(
                f"{name} has no bulk {'IN' if direction else 'OUT'} endpoint {chosen:#04x}",
                hint=f"its bulk endpoints: {', '.join(f'{a:#04x}' for a in bulk) or 'none'}",
            )
    outs = [a for a in bulk if not a & _DIRECTION_IN] if out is None else [out]
    ins = [a for a in bulk if a & _DIRECTION_IN] if into is None else [into]
    if not outs or not ins:
        raise HandRefused(
            f"{name} has no bulk OUT and IN endpoint on interface {_INTERFACE}",
            hint="is it a Dex3-1? See: lsusb -v -d 34b7:",
        )
    return Endpoints(outs[0], ins[0])


def read_serial(backend: Backend, handle: Any) -> str:
    """Read the serial number string of an open device; empty if it has none.

    The string index is read from the device: the USB/IP client's device descriptor comes from the
    server's list, which has no string indices.

    :raises OSError: from libusb.
    """

    def descriptor(kind: int, index: int, language: int, size: int) -> bytes:
        data = array.array("B", bytes(size))
        count = backend.ctrl_transfer(
            handle, 0x80, 0x06, kind << 8 | index, language, data, _STRING_TIMEOUT
        )
        return data[:count].tobytes()

    index = descriptor(1, 0, 0, 18)[16:17]
    if not index or not index[0]:
        return ""
    languages = descriptor(3, 0, 0, 255)
    if len(languages) < 4:
        raise OSError(errno.EPROTO, "a device whose strings have no language")
    (language,) = struct.unpack_from("<H", languages, 2)
    text = descriptor(3, index[0], language, 255)
    return text[2 : text[0] if text else 0].decode("utf-16-le", errors="replace")

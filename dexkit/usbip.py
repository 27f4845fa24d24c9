"""USB/IP client, a PyUSB backend: for a hand that is served by another process or machine.

The Dex3-1 driver and the USB conformance both use it. The package ``pyusb-usbip-backend`` lists and
imports devices and parses their descriptors; the transfers are done here, because a control loop
needs of them what that package does not promise:

* a time-out is kept to the millisecond (there, two seconds are added to each);
* a transfer that timed out is cancelled as the Linux client cancels it (CMD_UNLINK), and its
  answer, should it still come, is never taken for that of another: replies are told apart by
  their sequence numbers;
* a connection that broke stays broken and says so (there, it is opened again in silence);
* closing the device closes the connection, so that the server knows;
* one exchange is one message out and one answer back, where a write and then a read take two.

A backend object lists the server's devices once: make a new one for each connection.
"""

from __future__ import annotations

import errno
import math
import socket
import struct
import time
from typing import Any

from usb.core import USBError, USBTimeoutError
from usbip_backend.backend import USBIPBackend

__all__ = ["Connection", "UsbIpBackend"]

# linux/Documentation/usb/usbip_protocol.rst; all fields big-endian
_SUBMIT = struct.Struct(">IIIIIIiiii8s")
_UNLINK = struct.Struct(">IIIIII24x")
_REPLY = struct.Struct(">II12xii20x")  # command, seqnum, status, actual_length
_TIMEVAL = struct.Struct("@ll")
_CMD_SUBMIT, _CMD_UNLINK, _RET_SUBMIT, _RET_UNLINK = 1, 2, 3, 4
_OUT, _IN = 0, 1
_NO_SETUP = bytes(8)
_CONNECT_TIMEOUT = 1.0  # seconds, unless the caller says otherwise
_GREETING = 3.0  # seconds for all of a list, or all of an import
_CONTROL_TIMEOUT = 1000  # milliseconds of a control transfer that names no time-out
_LATE_LOOKS = 8  # chunks of the receive buffer
_LARGEST = 1 << 16  # bytes of an answer; the largest descriptor that there can be


class Connection:
    """One imported device: its socket and the transfers under way.

    The keyword arguments of :meth:`submit` are those of the package's own connection, whose
    place it takes.

    :ivar passed_over: answers that came while their read was being cancelled.
    """

    def __init__(self, sock: socket.socket, devid: int) -> None:
        # The time-outs are the kernel's: with Python's own, each call waits twice, and gives the
        # interpreter away twice, which a process that serves two hands feels.
        sock.settimeout(None)
        self._waits: dict[int, int] = {}
        self._sock = sock
        self._devid = devid
        self._seq = 0
        self._reads: dict[int, int] = {}  # IN transfers under way: seqnum, bytes asked for
        self._unlinks: dict[int, int] = {}  # seqnum of a cancellation, of what it cancels
        self._buffer = bytearray(_LARGEST + 2 * _REPLY.size)
        self._view = memoryview(self._buffer)
        self._begin = self._end = 0  # of what was received and not yet looked at
        self._broken = ""
        self._late = 0  # times that bytes were taken after the deadline of what is waited for
        self.passed_over = 0

    def close(self) -> None:
        """Give the device back. May be called twice."""
        self._broken = self._broken or "it was closed"
        self._sock.close()

    def submit(
        self,
        *,
        direction: int,
        ep: int,
        setup: bytes,
        transfer_buffer_length: int,
        out_payload: bytes = b"",
        timeout_ms: int | None = None,
        settle_ms: int = 0,
    ) -> tuple[int, bytes]:
        """One transfer: (status, data).

        :param settle_ms: how long to wait for the server to confirm that it has cancelled the
            transfer after a time-out. If the transfer was done meanwhile, its result is returned.
            0 does not wait.
        :raises USBTimeoutError: no answer in time; the transfer is cancelled.
        :raises USBError: the connection broke (ENODEV).
        """
        deadline = _deadline(_CONTROL_TIMEOUT if timeout_ms is None else timeout_ms)
        if direction == _IN:
            seq, message = self._read(ep, setup, transfer_buffer_length)
        else:
            seq, message = self._write(ep, setup, out_payload)
        self._send(message, deadline)
        try:
            while True:
                number, status, data = self._reply(deadline)
                if number == seq:
                    return status, data
                self.passed_over += bool(data)
        except USBTimeoutError:
            unlink = self._cancel(seq, ep, direction)
            result = self._settle(seq, unlink, settle_ms) if settle_ms else None
            if result is None:
                raise
            return result

    def exchange(
        self, out_ep: int, data: bytes, in_ep: int, length: int, send_ms: int, timeout_ms: int
    ) -> tuple[int, int, bytes]:
        """Write and read in one go: (status of the write, of the read, data). Raises as submit.

        Both are under way at once, as with asynchronous transfers of libusb. If the write
        fails, the read is cancelled.
        """
        deadline = _deadline(send_ms)
        write, first = self._write(out_ep, _NO_SETUP, data)
        read, second = self._read(in_ep, _NO_SETUP, length)
        self._send(first + second, deadline)
        try:
            while True:
                number, status, answer = self._reply(deadline)
                if number == read:
                    return 0, status, answer
                if number == write:
                    if status:
                        self._cancel(read, in_ep, _IN)
                        return status, 0, b""
                    deadline = _deadline(timeout_ms)
                else:
                    self.passed_over += bool(answer)
        except USBTimeoutError:
            self._cancel(write, out_ep, _OUT)
            self._cancel(read, in_ep, _IN)
            raise

    # -- messages

    def _next(self) -> int:
        self._seq = self._seq % 0xFFFFFFFF + 1
        return self._seq

    def _write(self, ep: int, setup: bytes, data: bytes) -> tuple[int, bytes]:
        seq = self._next()
        header = _SUBMIT.pack(_CMD_SUBMIT, seq, self._devid, _OUT, ep, 0, len(data), 0, 0, 0, setup)
        return seq, header + data

    def _read(self, ep: int, setup: bytes, length: int) -> tuple[int, bytes]:
        seq = self._next()
        self._reads[seq] = length
        return seq, _SUBMIT.pack(_CMD_SUBMIT, seq, self._devid, _IN, ep, 0, length, 0, 0, 0, setup)

    def _cancel(self, seq: int, ep: int, direction: int) -> int:
        """Cancel a transfer; what still comes of it is passed over. Returns the seqnum."""
        number = self._next()
        self._unlinks[number] = seq
        message = _UNLINK.pack(_CMD_UNLINK, number, self._devid, direction, ep, seq)
        self._send(message, _deadline(_CONTROL_TIMEOUT))
        return number

    def _settle(self, seq: int, unlink: int, timeout_ms: int) -> tuple[int, bytes] | None:
        """Wait for the answer to a cancellation; the transfer's result, if it was done before."""
        deadline = _deadline(timeout_ms)
        result = None
        try:
            while True:
                command, number, status, data = self._receive(deadline)
                if command == _RET_SUBMIT:
                    if number == seq:
                        result = status, data
                    continue
                self._reads.pop(self._unlinks.pop(number, 0), None)
                if number == unlink:
                    return result
        except USBTimeoutError as error:
            raise self._break("the server does not cancel a transfer") from error

    def _reply(self, deadline: float) -> tuple[int, int, bytes]:
        """The next answer to a transfer, cancelled ones among them: seqnum, status, data."""
        while True:
            command, number, status, data = self._receive(deadline)
            if command == _RET_SUBMIT:
                return number, status, data
            self._reads.pop(self._unlinks.pop(number, 0), None)

    # -- bytes

    def _send(self, message: bytes, deadline: float) -> None:
        self._check()
        try:
            self._limit(socket.SO_SNDTIMEO, deadline)
            self._sock.sendall(message)
        except OSError as error:  # a part may be on its way: what follows would be misread
            raise self._break(f"the connection broke: {error}") from error

    def _receive(self, deadline: float) -> tuple[int, int, int, bytes]:
        """The next whole reply: command, seqnum, status, data."""
        while True:
            have = self._end - self._begin
            if have >= _REPLY.size:
                command, seq, status, actual = _REPLY.unpack_from(self._buffer, self._begin)
                size = _REPLY.size
                if command == _RET_SUBMIT and seq in self._reads:
                    if not 0 <= actual <= self._reads[seq]:
                        raise self._break(f"the server sent {actual} bytes, more than asked for")
                    size += actual
                elif command not in (_RET_SUBMIT, _RET_UNLINK):
                    raise self._break(f"the server sent command {command:#x}")
                if have >= size:
                    data = bytes(self._view[self._begin + _REPLY.size : self._begin + size])
                    self._begin += size
                    if command == _RET_SUBMIT:
                        self._reads.pop(seq, None)
                    return command, seq, status, data
            self._fill(deadline)

    def _fill(self, deadline: float) -> None:
        self._check()
        # what is there already is looked at, for this process may be late; but not for ever
        self._late = self._late + 1 if time.monotonic() > deadline else 0
        if self._late > _LATE_LOOKS:
            self._late = 0
            raise USBTimeoutError("no answer over USB/IP", errno=errno.ETIMEDOUT)
        if self._begin == self._end:
            self._begin = self._end = 0
        elif self._begin:
            rest = bytes(self._view[self._begin : self._end])
            self._begin, self._end = 0, len(rest)
            self._view[: self._end] = rest
        try:
            self._limit(socket.SO_RCVTIMEO, deadline)
            count = self._sock.recv_into(self._view[self._end :])
        except BlockingIOError as error:
            raise USBTimeoutError("no answer over USB/IP", errno=errno.ETIMEDOUT) from error
        except OSError as error:
            raise self._break(f"the connection broke: {error}") from error
        if not count:
            raise self._break("the server closed the connection")
        self._end += count

    def _limit(self, option: int, deadline: float) -> None:
        """Set the socket's time-out to ``deadline``, a millisecond at least."""
        wait = max(1, math.ceil((deadline - time.monotonic()) * 1000))
        if self._waits.get(option) != wait:
            self._sock.setsockopt(
                socket.SOL_SOCKET, option, _TIMEVAL.pack(wait // 1000, wait % 1000 * 1000)
            )
            self._waits[option] = wait

    def _check(self) -> None:
        if self._broken:
            raise USBError(f"USB/IP: {self._broken}", errno=errno.ENODEV)

    def _break(self, why: str) -> USBError:
        self._broken = why
        self._sock.close()
        return USBError(f"USB/IP: {why}", errno=errno.ENODEV)


class UsbIpBackend(USBIPBackend):  # type: ignore[misc]  # the package has no types
    """PyUSB backend for the devices that a USB/IP server exports.

    What cannot be reached or breaks raises :class:`OSError`, most of it as
    :class:`usb.core.USBError`.

    :param timeout: seconds to connect, and for each piece of a list or an import.
    """

    def __init__(self, host: str, port: int, timeout: float = _CONNECT_TIMEOUT) -> None:
        super().__init__(host, port, timeout)
        self._deadline = math.inf  # of a list or an import

    def enumerate_devices(self) -> list[Any]:
        """The devices that the server lists."""
        self._deadline = time.monotonic() + _GREETING
        try:
            return list(super().enumerate_devices())
        finally:
            self._deadline = math.inf

    def _recv_exact(self, sock: socket.socket, size: int) -> bytes:
        """Bytes of a list or an import: all of it within a time, however slowly it comes."""
        received = bytearray()
        while len(received) < size:
            if time.monotonic() > self._deadline:
                raise USBTimeoutError("the USB/IP server is too slow", errno=errno.ETIMEDOUT)
            piece = sock.recv(size - len(received))
            if not piece:
                raise USBError("the USB/IP server closed the connection", errno=errno.ECONNRESET)
            received += piece
        return bytes(received)

    def _get_config_data(self, dev: Any, config_index: int) -> Any:
        try:
            return super()._get_config_data(dev, config_index)
        except (ValueError, IndexError, struct.error) as error:
            raise USBError(f"an invalid USB configuration: {error}", errno=errno.EPROTO) from error

    def _import_device(self, dev: Any) -> Connection:
        self._deadline = time.monotonic() + _GREETING
        try:
            imported = super()._import_device(dev)
        except USBError as error:
            if "import failed" in str(error):  # it is listed, but not to be had
                raise USBError(str(error), errno=errno.EBUSY) from error
            raise
        finally:
            self._deadline = math.inf
        return Connection(imported.sock, dev.devid)

    def close_device(self, dev_handle: Connection) -> None:
        """Close the connection; the server then has the device back."""
        for key, connection in list(self._conns.items()):
            if connection is dev_handle:
                del self._conns[key]
        dev_handle.close()

    def exchange(
        self,
        dev_handle: Connection,
        out_ep: int,
        data: bytes,
        in_ep: int,
        size: int,
        send_timeout: int,
        timeout: int,
    ) -> bytes:
        """Bulk write and bulk read in one message.

        :param send_timeout: ms for the write.
        :param timeout: ms for the read, from when the write is done.
        :raises USBTimeoutError: no answer in time.
        :raises USBError: one of the transfers failed, EPIPE where its endpoint is stalled;
            attribute ``endpoint`` says which.
        """
        written, read, answer = dev_handle.exchange(
            out_ep & 0x0F, data, in_ep & 0x0F, size, send_timeout, timeout
        )
        if written or read:
            error = USBError(
                f"USB/IP transfer failed with status {written or read}",
                errno=abs(written or read),
            )
            error.endpoint = out_ep if written else in_ep
            raise error
        return answer


def _deadline(timeout_ms: int) -> float:
    return time.monotonic() + timeout_ms * 1e-3

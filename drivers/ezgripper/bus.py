"""DYNAMIXEL Protocol 2.0 transactions with servos on a serial port.

:mod:`dexkit.wire.dynamixel` encodes and decodes the packets. The port blocks in ``select`` until
bytes arrive or the deadline passes, so waiting costs no processor time and does not hold the GIL
against the thread that publishes state. pyserial reports a vanished device as SerialException,
OSError or termios.error; all become :class:`~dexkit.errors.HandLost`.

dynamixel-sdk is not used (docs/sources/mx64-ezgripper.md#a3, docs/sources/mx64-ezgripper.md#c3): it
polls the port while it waits, does not stuff what it sends, damages some of what it receives, and
reads the CRC of a short error status as data. Tests of the emulated servo use it as the client.
"""

from __future__ import annotations

import os
import termios
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import serial

from dexkit.command_age import WriteDeadline
from dexkit.descriptors import wait_readable, wait_writable
from dexkit.drivers.serial_port import open_failed, port_errors
from dexkit.errors import HandLost, HandRefused, HandTimeout, UsageError
from dexkit.wire import dynamixel, mx64
from dexkit.wire.dynamixel import BROADCAST_ID, Instruction, Packet, PacketParser

__all__ = [
    "BITS_PER_BYTE",
    "BusStatistics",
    "DevicePort",
    "Ping",
    "ServoBus",
    "ServoError",
    "ServoSilent",
]

T = TypeVar("T")

BITS_PER_BYTE = 10
"""8N1: start bit, eight data bits, stop bit."""

_ADAPTER_BUFFER_TIME = 0.1
"""Seconds that a USB adapter may buffer bytes after the kernel has handed them over."""
_STATUS = 11
"""Bytes of a status packet without data."""
_LONGEST_REQUEST = 64
"""Bytes that may still be in the transmit buffer when the wait for the answer begins."""
_PING_DATA = 3  # model number (2), firmware (1)
_SILENT = "does not answer"


@dataclass
class BusStatistics:
    """Counters of the line since it was opened.

    :ivar transactions: instructions sent that expect a status packet, retries included.
    :ivar timeouts: transactions without a status packet.
    :ivar corrupt: transactions with a damaged or wrong status packet.
    :ivar retries: instructions sent again because of that.
    """

    transactions: int = 0
    timeouts: int = 0
    corrupt: int = 0
    retries: int = 0


@dataclass(frozen=True)
class _Problem:
    """Why an attempt has no answer: servos, and what they do."""

    who: int | str
    what: str


@dataclass(frozen=True)
class Ping:
    """Model and firmware in a servo's answer to a ping."""

    id: int
    model: int
    firmware: int


class ServoError(HandRefused):
    """The servo refuses an instruction.

    :param number: error number of the status packet (docs/sources/mx64-ezgripper.md#a4).
    """

    def __init__(self, message: str, number: int, *, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.number = number


class ServoSilent(HandTimeout):
    """A servo gives no intact answer to any attempt."""


class DevicePort:
    """A serial port whose reads block until bytes arrive or a deadline passes.

    :param path: device path.
    :param timeout: seconds after which a write is given up.
    """

    def __init__(self, path: str, timeout: float) -> None:
        self.path = path
        self.timeout = timeout
        self._port: serial.Serial | None = None

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    def open(self, baudrate: int) -> None:
        """Open or reopen the port with an exclusive lock. Raises as :class:`serial.Serial`."""
        self.close()
        self._port = serial.Serial(self.path, baudrate, timeout=0, exclusive=True)

    def close(self) -> None:
        """Close the port, even if it has gone away."""
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except (OSError, termios.error):
                pass

    def clear(self) -> None:
        """Discard received bytes."""
        self._opened().reset_input_buffer()

    def flush(self) -> None:
        """Wait until the kernel has passed on the written bytes."""
        self._opened().flush()

    def read(self, deadline: float) -> bytes:
        """Return received bytes, or nothing once the deadline (monotonic seconds) has passed.

        The port is read after the deadline, too: the process may have been scheduled late.
        """
        fd = self._opened().fileno()
        while True:
            remaining = max(0.0, deadline - time.monotonic())
            if not wait_readable([fd], remaining):
                return b""
            try:
                data = os.read(fd, 4096)
            except BlockingIOError:
                continue
            if not data:
                raise serial.SerialException("the device reports data but has none")
            return data

    def write(self, data: bytes) -> bool:
        """Write; return False if the port does not accept all bytes within the time-out."""
        fd = self._opened().fileno()
        deadline = time.monotonic() + self.timeout
        sent = 0
        while sent < len(data):
            try:
                sent += os.write(fd, data[sent:])
            except BlockingIOError:
                remaining = deadline - time.monotonic()
                if remaining <= 0 or not wait_writable(fd, remaining):
                    return False
        return True

    def _opened(self) -> serial.Serial:
        if self._port is None:
            raise serial.SerialException("the port is closed")
        return self._port


class ServoBus:
    """Transactions with servos on one line.

    :param path: device path.
    :param baudrate: bits a second.
    :param timeout: seconds to wait for a reply beyond the time of its bytes.
    :param retries: how often a transaction without an intact status is sent again. Repeating is
        safe: all transactions here read or set absolute values.
    """

    def __init__(
        self, path: str, baudrate: int, *, timeout: float = 0.05, retries: int = 2
    ) -> None:
        if timeout <= 0 or retries < 0:
            raise UsageError(f"timeout {timeout} and retries {retries} must not be negative")
        self.path = path
        self.baudrate = baudrate
        self.timeout = timeout
        self.retries = retries
        self.statistics = BusStatistics()
        self._port = DevicePort(path, timeout)
        self._parser = PacketParser(keep_bad=True)
        self._queued = b""  # written together with the next packet
        self._before: WriteDeadline | None = None

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port.is_open

    def open(self) -> None:
        """Open the port.

        :raises HandNotFound: no such device, no permission, or not a serial port.
        :raises HandRefused: another program has it.
        :raises HandLost: it cannot be opened for another reason.
        :raises UsageError: no servo has this baud rate.
        """
        self.set_baudrate(self.baudrate)

    def set_baudrate(self, baudrate: int) -> None:
        """Open or reopen the port at another baud rate. Raises as :meth:`open`."""
        if baudrate not in mx64.BAUD_RATES.values():
            raise UsageError(
                f"baud rate {baudrate} is none of a servo's",
                hint="use " + ", ".join(str(b) for b in mx64.BAUD_RATES.values()),
            )
        self._queued, self._before = b"", None
        self.baudrate = baudrate
        try:
            self._port.open(baudrate)
        except (serial.SerialException, OSError, termios.error, ValueError) as error:
            self.close()
            raise open_failed(self.path, error) from error

    def drain(self) -> None:
        """Wait until the written bytes have left the adapter's buffer.

        :raises HandLost: the port has gone away.
        """
        with port_errors(self.path):
            self._port.flush()
        time.sleep(_ADAPTER_BUFFER_TIME)

    def close(self) -> None:
        """Close the port; may be called twice."""
        self._port.close()

    def wire_time(self, n_bytes: int) -> float:
        """Seconds that ``n_bytes`` take on the line."""
        return n_bytes * BITS_PER_BYTE / self.baudrate

    def ping(self, servo_id: int, *, retries: int | None = None) -> Ping:
        """Read model and firmware of a servo.

        :raises HandTimeout: no servo with that id answers at this baud rate.
        :raises HandLost: the port has gone away.
        """
        _, data = self._transact(servo_id, Instruction.PING, b"", _PING_DATA, retries=retries)
        return _parse_ping(servo_id, data)

    def ping_all(self) -> list[Ping]:
        """Ping all servos by broadcast; takes about a second
        (docs/sources/mx64-ezgripper.md#c3).

        :raises HandLost: the port has gone away.
        """
        every = dynamixel.MAX_ID * (self.wire_time(_STATUS + _PING_DATA) + 0.003)
        found = {}
        with port_errors(self.path):
            self._send(dynamixel.encode(BROADCAST_ID, Instruction.PING))
            deadline = time.monotonic() + every + 0.016
            parser = PacketParser()
            while data := self._port.read(deadline):
                for packet in parser.feed(data):
                    if packet.is_status and len(packet.params) == 1 + _PING_DATA:
                        found[packet.id] = _parse_ping(packet.id, packet.data)
        return [found[number] for number in sorted(found)]

    def ping_protocol_1(self, servo_id: int) -> int | None:
        """Return the model number of a servo with Protocol 1.0 firmware, or None.

        :raises HandLost: the port has gone away.
        """
        body = bytes((servo_id, 4, Instruction.READ, 0, 2))  # the model number is at address 0
        received = b""
        with port_errors(self.path):
            self._send(b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)))
            deadline = self._deadline(8)
            while data := self._port.read(deadline):
                received = (received + data)[-4096:]
                at = received.find(bytes((0xFF, 0xFF, servo_id, 4)))
                answer = received[at + 2 : at + 8] if at >= 0 else b""
                if len(answer) == 6 and sum(answer) & 0xFF == 0xFF:
                    return int.from_bytes(answer[3:5], "little")
        return None

    def read(self, servo_id: int, address: int, length: int) -> tuple[bytes, bool]:
        """Read ``length`` bytes from ``address``; also whether the alert bit is set.

        :raises HandTimeout: no (intact) answer.
        :raises HandLost: the port has gone away.
        :raises ServoError: the servo refuses.
        """
        params = address.to_bytes(2, "little") + length.to_bytes(2, "little")
        alert, data = self._transact(servo_id, Instruction.READ, params, length)
        return data, alert

    def read_item(self, servo_id: int, item: mx64.Item) -> int:
        """Read one item. Raises as :meth:`read`."""
        return item.decode(self.read(servo_id, item.address, item.size)[0])

    def write(self, servo_id: int, address: int, data: bytes) -> bool:
        """Write and wait for the status; return the alert bit. Raises as :meth:`read`."""
        params = address.to_bytes(2, "little") + data
        return self._transact(servo_id, Instruction.WRITE, params, 0)[0]

    def write_item(self, servo_id: int, item: mx64.Item, value: int) -> None:
        """Write one item. Raises as :meth:`read`."""
        self.write(servo_id, item.address, item.encode(value))

    def write_unacknowledged(
        self,
        servo_id: int,
        address: int,
        data: bytes,
        *,
        with_next: bool = False,
        before: WriteDeadline | None = None,
    ) -> None:
        """Write to one servo without a status packet. As :meth:`sync_write`."""
        self.sync_write(address, {servo_id: data}, with_next=with_next, before=before)

    def sync_write(
        self,
        address: int,
        data: Mapping[int, bytes],
        *,
        with_next: bool = False,
        before: WriteDeadline | None = None,
    ) -> None:
        """Write to several servos in one packet, without a status packet.

        :param data: of each servo, by id; all of one length.
        :param with_next: send it together with the next transaction: one system call and, on a USB
            adapter, one transfer instead of two.
        :param before: checked right before the bytes are written. What it raises comes from here,
            or from the next transaction.
        :raises HandLost: the port has gone away or takes no more bytes.
        """
        size = len(next(iter(data.values())))
        params = bytes((address & 0xFF, address >> 8, size & 0xFF, size >> 8))
        params += b"".join(bytes((servo_id,)) + part for servo_id, part in data.items())
        packet = dynamixel.encode(BROADCAST_ID, Instruction.SYNC_WRITE, params)
        self._before = before
        if with_next:
            self._queued = packet
            return
        with port_errors(self.path):
            self._send(packet)

    def sync_read(self, servo_ids: Sequence[int], address: int, length: int) -> dict[int, bytes]:
        """Read ``length`` bytes from ``address`` of several servos with one instruction.

        :raises ServoSilent: one of them gives no intact answer.
        :raises HandLost: the port has gone away.
        :raises ServoError: one refuses.
        """
        params = address.to_bytes(2, "little") + length.to_bytes(2, "little") + bytes(servo_ids)
        request = dynamixel.encode(BROADCAST_ID, Instruction.SYNC_READ, params)

        def receive(deadline: float) -> dict[int, bytes] | _Problem:
            found = self._receive_all(servo_ids, length, deadline)
            missing = [servo_id for servo_id in servo_ids if servo_id not in found]
            if not missing:
                return found
            self.statistics.timeouts += 1
            return _Problem(" and ".join(map(str, missing)), _SILENT)

        expected = len(servo_ids) * (_STATUS + length)
        return self._ask(request, expected, receive, 1 + self.retries)

    def _receive_all(
        self, servo_ids: Sequence[int], length: int, deadline: float
    ) -> dict[int, bytes]:
        """Data of the servos' intact answers, by id, until all are there or the deadline."""
        parser = self._parser
        parser.reset()
        found: dict[int, bytes] = {}
        late = False
        while not late and len(found) < len(servo_ids):
            late = time.monotonic() >= deadline
            data = self._port.read(deadline)
            if not data:
                break
            for packet in parser.feed(data):
                if not packet.is_status or packet.id not in servo_ids:
                    continue
                number = packet.error_number if packet.crc_ok and packet.params else 0
                if number and number != dynamixel.ErrorNumber.CRC:
                    refusal = _describe_refusal(packet.id, Instruction.SYNC_READ, b"", number)
                    raise ServoError(refusal, number)
                if packet.crc_ok and packet.params and len(packet.data) == length:
                    found[packet.id] = packet.data
                else:
                    self.statistics.corrupt += 1
        parser.reset()
        return found

    def reboot(self, servo_id: int) -> None:
        """Reboot the servo; it does not answer until it has booted.

        :raises HandTimeout: no status packet.
        :raises HandLost: the port has gone away.
        """
        self._transact(servo_id, Instruction.REBOOT, b"", 0, retries=0)

    def _transact(
        self,
        servo_id: int,
        instruction: Instruction,
        params: bytes,
        answer: int,
        *,
        retries: int | None = None,
    ) -> tuple[bool, bytes]:
        """Send an instruction, with retries; return (alert bit, data of length ``answer``)."""

        def receive(deadline: float) -> tuple[bool, bytes] | _Problem:
            packet = self._receive(servo_id, deadline)
            if packet is None:
                self.statistics.timeouts += 1
                return _Problem(servo_id, _SILENT)
            if not packet.crc_ok:
                self.statistics.corrupt += 1
                return _Problem(servo_id, "answers with damaged packets")
            number = packet.error_number
            if not number:
                data = packet.data
                if len(data) == answer:
                    return packet.alert, data
            elif number != dynamixel.ErrorNumber.CRC:
                raise ServoError(_describe_refusal(servo_id, instruction, params, number), number)
            self.statistics.corrupt += 1
            if number:
                return _Problem(servo_id, "receives damaged packets")
            # for example a late answer to an earlier instruction
            return _Problem(servo_id, "answers with packets of the wrong length")

        request = dynamixel.encode(servo_id, instruction, params)
        attempts = 1 + (self.retries if retries is None else retries)
        return self._ask(request, _STATUS + answer, receive, attempts)

    def _ask(
        self, request: bytes, size: int, receive: Callable[[float], T | _Problem], attempts: int
    ) -> T:
        """Send ``request`` until its answer is intact.

        :param size: bytes of the whole answer.
        :param receive: takes the answer until a deadline (monotonic seconds), and counts what is
            wrong with it.
        :raises ServoSilent: no attempt had an intact answer.
        :raises HandLost: the port has gone away.
        """
        statistics = self.statistics
        problem = None
        for attempt in range(attempts):
            with port_errors(self.path):
                self._send(request)
                # not before: a command that is too old by now is not sent
                statistics.transactions += 1
                statistics.retries += attempt > 0
                answer = receive(self._deadline(size))
            if not isinstance(answer, _Problem):
                return answer
            problem = answer
        assert problem is not None, "at least one attempt"
        raise ServoSilent(
            f"servo {problem.who} on {self.path} {problem.what} "
            f"({attempts} attempt(s) at {self.baudrate} baud)",
            hint="check power, cable, id and baud rate",
        )

    def _send(self, packet: bytes) -> None:
        """Write queued bytes and ``packet`` at once, after discarding received bytes."""
        data, self._queued = self._queued + packet, b""
        before, self._before = self._before, None
        self._port.clear()
        if before is not None:
            before.check()
        if not self._port.write(data):
            raise HandLost(f"the port {self.path} takes no more bytes")

    def _deadline(self, answer: int) -> float:
        """Return the deadline of an answer of ``answer`` bytes, monotonic seconds."""
        return time.monotonic() + self.wire_time(answer + _LONGEST_REQUEST) + self.timeout

    def _receive(self, servo_id: int, deadline: float) -> Packet | None:
        """Return the servo's status, a damaged packet (``crc_ok`` False), or None at a time-out."""
        parser = self._parser
        parser.reset()
        skipped = parser.skipped
        late = False
        while not late:
            late = time.monotonic() >= deadline
            data = self._port.read(deadline)
            if not data:
                break
            for packet in parser.feed(data):
                if not packet.is_status:
                    continue
                if not packet.crc_ok or not packet.params:
                    return _DAMAGED
                if packet.id == servo_id:
                    return packet
        parser.reset()
        return _DAMAGED if parser.skipped > skipped else None


_DAMAGED = Packet(0, Instruction.STATUS, crc_ok=False)


def _parse_ping(servo_id: int, data: bytes) -> Ping:
    return Ping(servo_id, int.from_bytes(data[:2], "little"), data[2])


def _describe_refusal(servo_id: int, instruction: Instruction, params: bytes, number: int) -> str:
    try:
        name = dynamixel.ErrorNumber(number).name.replace("_", " ").lower()
    except ValueError:
        name = f"error {number}"
    what = instruction.name.lower()
    if instruction in (Instruction.READ, Instruction.WRITE):
        address = int.from_bytes(params[:2], "little")
        item = mx64.TABLE.get(address)
        what += f" of {item.name}({address})" if item else f" of address {address}"
    return f"servo {servo_id} refuses {what}: {name} (0x{number:02X})"
